"""What all pages have: a player of the frames, scripts of the browser, errors that are shown, work beside the page."""

from __future__ import annotations

import html
import logging
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, TypeVar

import bokeh.models as bk
from bokeh.core.properties import Int, String
from bokeh.document import Document
from bokeh.layouts import row
from bokeh.model import DataModel

from rgbmidic.errors import RgbmidicError
from rgbmidic.tools.view.constants import VIEWER

logger = logging.getLogger(__name__)

T = TypeVar("T")
LIVE_REGION = {"aria-live": "polite"}
"""Attributes of a text whose changes screen readers read out."""


def page_file(name: str) -> str:
    """Return the text of a file of the page that lies beside this module."""
    return files("rgbmidic.tools.view").joinpath(name).read_text(encoding="utf-8")


def script(name: str, **parts: Any) -> bk.CustomJS:
    """Call a function of page.js in the browser with parts of the page, and plain values, by their names."""
    return bk.CustomJS(args=parts, code=f"rgbmidic.{name}({{{', '.join(parts)}}})")


def aria_group(label: str) -> dict[str, str]:
    """Return HTML attributes of a group of controls with the label that screen readers read out."""
    return {"role": "group", "aria-label": label}


def warning(text: str) -> str:
    """Return a remark as HTML that stands out."""
    return f'<b style="color:var(--warn)">{html.escape(text)}</b>'


def run_guarded(action: Callable[[], object], report: Callable[[str], None]) -> None:
    """Call `action`; an error is reported in one line by `report`, and the page goes on."""
    try:
        action()
    except (RgbmidicError, OSError) as error:
        report(str(error))
    except Exception as error:  # the last resort of a page
        logger.exception("the page failed")
        report(f"{type(error).__name__}: {error}")


def is_watched(document: Document) -> bool:
    """Return whether a browser shows the page: one that was left exists for a while, and shall do nothing more."""
    session = document.session_context.session if document.session_context else None
    return session is None or session.connection_count > 0


def call_periodically(
    milliseconds: int, document: Document, action: Callable[[], None], report: Callable[[str], None]
) -> None:
    """Call `action`, as `run_guarded`, again and again while a browser shows the page."""
    document.add_periodic_callback(lambda: run_guarded(action, report) if is_watched(document) else None, milliseconds)


class Background:
    """Work for a page in another thread, one task after the other, of which only the last that was asked for counts.

    Parameters
    ----------
    document
        Document of the page.
    """

    def __init__(self, document: Document) -> None:
        self._document, self._thread, self._task = document, ThreadPoolExecutor(1), Future[Any]()
        document.on_session_destroyed(lambda context: self._thread.shutdown(wait=False, cancel_futures=True))

    def cancel(self) -> None:
        """Forget the task that was asked for."""
        self._task.cancel()
        self._task = Future()

    def submit(self, work: Callable[[], T], receive: Callable[[Callable[[], T]], None]) -> None:
        """Start a task; `receive` gets a function that returns its result or raises its error, in the page's thread."""
        self.cancel()
        task = self._task = self._thread.submit(work)
        deliver = lambda: receive(task.result) if task is self._task else None  # noqa: E731
        task.add_done_callback(lambda _: self._document.add_next_tick_callback(deliver))


class SharedState(DataModel):  # type: ignore[misc]  # see pyproject.toml
    """State that browser and server share: frame asked for, frame shown, rest of the address, files to keep."""

    requested_frame = Int(0)
    displayed_frame = Int(0)
    query = String("")
    csv = String("")
    png = String("")


@dataclass(frozen=True, slots=True)
class Control:
    """A control: its kind of widget, and the properties of that, which limit the value of an entry of the view."""

    widget: type[bk.UIElement]
    options: Mapping[str, Any]


def choice(title: str, options: Iterable[Any] | None = None) -> Control:
    """Return a list of which one is chosen."""
    return Control(bk.Select, {"title": title, **({} if options is None else {"options": list(options)})})


def number(title: str, **limits: float) -> Control:
    """Return the field of a real number."""
    return Control(bk.NumericInput, {"title": title, "mode": "float", **limits})


def count(title: str, **limits: int) -> Control:
    """Return the field of a whole number."""
    return Control(bk.Spinner, {"title": title, **limits})


def check(label: str, *, active: bool = False) -> Control:
    """Return a box that is checked or not."""
    return Control(bk.Checkbox, {"label": label, "active": active})


def text(title: str, value: str = "") -> Control:
    """Return the field of a text."""
    return Control(bk.TextInput, {"title": title, "value": value})


def button(label: str, **look: str) -> Control:
    """Return a button."""
    return Control(bk.Button, {"label": label, **look})


def group(label: str, labels: Iterable[str], active: int | None = 0) -> Control:
    """Return buttons of which one is pressed, with a label for screen readers."""
    look = {"labels": list(labels), "html_attributes": aria_group(label)}
    return Control(bk.RadioButtonGroup, {**look, "active": active})


NOTE = Control(bk.Div, {})
"""A text that the page sets."""


class Controls:
    """Controls of a page: by their names those of a table, and what every page has: texts, theme, player of frames.

    Parameters
    ----------
    table
        Controls of the page, in rows.
    last_frame
        Index of the last frame.
    frame
        Index of the frame in view at first.
    dark
        Whether the page is dark.

    Attributes
    ----------
    small, wide
        Options of a control of fixed width, and of one as wide as its column.
    player
        The row of play button, step and slider.
    """

    def __init__(self, table: Iterable[Mapping[str, Control]], last_frame: int, frame: int, *, dark: bool) -> None:
        styles = ("widgets.css", "dark.css") if dark else ("widgets.css",)
        self.small: dict[str, Any] = {"stylesheets": [bk.InlineStyleSheet(css=page_file(name)) for name in styles]}
        self.wide = wide = {**self.small, "sizing_mode": "stretch_width"}
        other_theme, max_frame = "light" if dark else "dark", max(last_frame, 1)
        self._models: dict[str, Any] = {}
        for name, control in (item for controls in table for item in controls.items()):
            look = self.small if control.widget is bk.Checkbox else wide
            self._models[name] = control.widget(name={"field": "quantity"}.get(name, name), **control.options, **look)
        self.head, self.message = bk.Div(**wide), self["message"]
        self.description = bk.Div(name="description", html_attributes=LIVE_REGION, **wide)
        self.theme = bk.Button(label=f"{other_theme.capitalize()} page", **wide)
        self.theme.js_on_click(script("turn", theme=other_theme))
        self.frame = bk.Slider(
            title="Frame", name="frame", start=0, end=max_frame, step=1, value=frame, disabled=last_frame < 1, **wide
        )
        self.play = bk.Toggle(label="▶ Play", name="play", width=90, **self.small)
        label = aria_group("frames that Play and the arrow keys go on by")
        self.step = bk.Spinner(
            name="step", low=1, high=max_frame, value=1, width=70, html_attributes=label, **self.small
        )
        self.player = row(self.play, self.step, self.frame, sizing_mode="stretch_width")

    def __getitem__(self, name: str) -> Any:
        """Return the widget of a control."""
        return self._models[name]

    def lines(self, table: Iterable[Mapping[str, Control]]) -> list[Any]:
        """Return the widgets of rows of controls, one below the other."""
        rows = [[self[name] for name in controls] for controls in table]
        return [row(*models, sizing_mode="stretch_width") if len(models) > 1 else models[0] for models in rows]

    def request_frames(self, state: SharedState) -> None:
        """Let the slider ask for frames, and play them."""
        request = script("pump", state=state, slider=self.frame, play=self.play, step=self.step, wait=VIEWER.play_ms)
        self.frame.js_on_change("value", request)
        self.play.js_on_change("active", request)
        state.js_on_change("displayed_frame", request)
