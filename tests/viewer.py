"""A headless Chromium, and what tests do with the page of a result in it."""

from __future__ import annotations

import asyncio
import os
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Queue

_ABSENT = [name for name in ("chromium", "chromedriver") if not shutil.which(name)]
if "RGBMIDIC_BROWSER" not in os.environ:
    MISSING = "two minutes in a browser: set RGBMIDIC_BROWSER=1 (needs the extra browser, chromium, chromium-driver)"
else:
    MISSING = f"{_ABSENT[0]} is not installed (Debian: chromium, chromium-driver)" if _ABSENT else ""
"""Why there are no tests in a browser; empty: there are."""
_FLAGS = (
    "--headless=new --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --disable-dev-shm-usage --window-size=1280,940"
)
_MODEL = "const model = (name) => Bokeh.documents[0].get_model_by_name(name);"
_PATIENCE = 30.0
_TWO_CLICKS = 0.4
"""Seconds that make two clicks of what would be a double click: Bokeh's 300 ms and some."""
_CLICK = """
const label = arguments[0];
const press = (root) => root.querySelectorAll("*").forEach((one) => {
  if (one.tagName === "BUTTON" && one.textContent.trim() === label) one.click();
  if (one.shadowRoot) press(one.shadowRoot);
});
press(document);
"""


@contextmanager
def chromium() -> Iterator[object]:
    """A browser with a profile of its own."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for flag in _FLAGS.split():
        options.add_argument(flag)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    try:
        yield driver
    finally:
        driver.quit()


@contextmanager
def serving(path: Path, **statement: object) -> Iterator[str]:
    """A viewer in a thread of its own; its address."""
    from tornado.ioloop import IOLoop

    from rgbmidic.tools.view.server import start_server

    told: Queue = Queue()

    def run() -> None:
        asyncio.set_event_loop(asyncio.new_event_loop())
        server, address = start_server(path, statement=statement)
        told.put((IOLoop.current(), address))
        IOLoop.current().start()
        server.stop()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    loop, address = told.get(timeout=_PATIENCE)
    try:
        yield address
    finally:
        loop.add_callback(loop.stop)
        thread.join(_PATIENCE)


def click(label: str) -> tuple[str, str]:
    """A script that clicks a button, and its argument."""
    return _CLICK, label


class Page:
    """An opened page.

    Parameters
    ----------
    driver
        The browser.
    address
        Of the page.
    """

    def __init__(self, driver: object, address: str) -> None:
        self.driver = driver
        driver.get(address)
        self.until("model('plot') && model('plot').renderers[0].data_source.data.image.length")
        self.until("model('plot').inner_width > 100")

    def run(self, script: str) -> object:
        """What a script in the page gives; ``model(name)`` is a part of it."""
        return self.driver.execute_script(f"{_MODEL} return ({script})")

    def do(self, script: str) -> None:
        """Run a script in the page."""
        self.driver.execute_script(f"{_MODEL} {script}")

    def until(self, script: str, *, patience: float = _PATIENCE) -> object:
        """Wait until a script gives something that is true, and give it."""
        end = time.monotonic() + patience
        while time.monotonic() < end:
            try:
                if value := self.run(script):
                    return value
            except Exception as error:
                if "JavascriptException" not in type(error).__name__:
                    raise
            time.sleep(0.03)
        raise AssertionError(f"never: {script}; the page says: {self.run('document.body.innerText')}")

    def place(self, x: float, y: float, plot: str = "plot") -> tuple[int, int]:
        """Where a point of the image, or of another plot, is in the browser's window."""
        script = f"""(() => {{
            const view = Bokeh.index.get_one(model("{plot}")), box = view.el.getBoundingClientRect();
            return [box.x + view.frame.x_scale.compute({x}), box.y + view.frame.y_scale.compute({y})];
        }})()"""
        left, top = self.run(script)
        return round(left), round(top)

    def pointer(self, *steps: tuple[str, float, float], plot: str = "plot") -> None:
        """``("move" | "click" | "press" | "release", x, y)`` at points of the image, or of another plot."""
        from selenium.webdriver.common.action_chains import ActionBuilder

        actions = ActionBuilder(self.driver, duration=50)
        for what, x, y in steps:
            actions.pointer_action.move_to_location(*self.place(x, y, plot))
            if what == "click":
                actions.pointer_action.pause(_TWO_CLICKS)
                actions.pointer_action.click()
            elif what == "press":
                actions.pointer_action.pointer_down()
            elif what == "release":
                actions.pointer_action.pointer_up()
        actions.perform()

    def keys(self, *keys: str) -> None:
        """Press keys."""
        from selenium.webdriver.common.action_chains import ActionChains

        for key in keys:
            ActionChains(self.driver).send_keys(key).perform()
