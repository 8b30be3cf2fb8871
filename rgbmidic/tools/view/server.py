"""Server of the viewer: for this machine only, at an address with a random token, without any other file."""

from __future__ import annotations

import asyncio
import gc
import html
import logging
import re
import secrets
import webbrowser
from collections.abc import Callable, Mapping
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.core.templates import get_env
from bokeh.document import Document
from bokeh.model import Model
from bokeh.models import Div
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop
from tornado.web import ErrorHandler

from rgbmidic.errors import ConfigurationError, InputError, ResultError, RgbmidicError
from rgbmidic.extensions import RESULTS
from rgbmidic.results import Maps, Result
from rgbmidic.results.provenance import PROVENANCE, find_marker
from rgbmidic.settings import read_table, read_toml
from rgbmidic.tools.report.page import render
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.page import ResultPage
from rgbmidic.tools.view.setup import SetupPage
from rgbmidic.tools.view.setup_panel import DraftFrames, Run
from rgbmidic.tools.view.test_file_editor import Draft
from rgbmidic.tools.view.time_line import FrameProgress
from rgbmidic.tools.view.url_state import ViewState
from rgbmidic.tools.view.widgets import page_file

_HOST = "127.0.0.1"


class _Site(Application):  # type: ignore[misc]  # see pyproject.toml
    """Builder of the pages of an address, which serves others between two pages that are freed.

    Bokeh frees all pages that were left in a row, and collects garbage twice for each: measured, 0.1 to 0.3 s a time.
    """

    async def on_session_destroyed(self, session_context: Any) -> None:
        await super().on_session_destroyed(session_context)
        await asyncio.sleep(VIEWER.breath_s)


class _Application(BokehTornado):  # type: ignore[misc]  # see pyproject.toml
    """Bokeh's server, whose pages load only the scripts that they need, a third of all."""

    def resources(self, absolute_url: str | bool | None = None) -> Any:
        return super().resources(absolute_url).clone(components=["bokeh", "bokeh-widgets"])


def serve(
    path: Path,
    *,
    port: int = 0,
    browser: bool = True,
    report_address: Callable[[str], None] = print,
    statement: Mapping[str, Any] | None = None,
) -> None:
    """Show a result in the browser until the process is interrupted.

    Parameters
    ----------
    path
        Result folder, to which a run may still add; a TEST.toml or frames to set a test up; or a folder of these.
    port
        0: any that is free.
    browser
        Whether to open the browser.
    report_address
        Called with the address.
    statement
        Keys of ``[frames]`` that the files of frames do not state.

    Raises
    ------
    ResultError
        The folder is not a result, or is damaged.
    InputError
        The port is in use; or `statement` is not empty and `path` is something else than frames.

    Examples
    --------
    >>> def stop(address):  # else it answers until Ctrl-C
    ...     raise SystemExit
    >>> serve(Path("my_result"), browser=False, report_address=stop)
    Traceback (most recent call last):
    SystemExit
    """
    for library in ("bokeh", "tornado"):  # their messages on a malformed request are for programmers
        logging.getLogger(library).setLevel(logging.CRITICAL)
    server, address = start_server(path, port=port, statement=statement)
    gc.collect()
    gc.freeze()  # what is there now stays: two thirds of what each collection would go through
    report_address(address)
    if browser:
        server.io_loop.add_callback(webbrowser.open, address)
    try:
        server.io_loop.start()
    finally:
        server.stop()


def start_server(path: Path, *, port: int = 0, statement: Mapping[str, Any] | None = None) -> tuple[BaseServer, str]:
    """Start a server, which answers once its loop runs; return it and its address. Errors as `serve`."""
    pages = _pages(path, statement or {})
    token = secrets.token_urlsafe(24)
    try:
        sockets, port = bind_sockets(_HOST, port)
    except OSError as error:
        raise InputError(
            f"port {port} of {_HOST} cannot be used ({error.strerror or error}): state another `port`, or none"
        ) from None
    application = _Application(
        {route: _Site(FunctionHandler(page)) for route, page in pages.items()},
        prefix=f"/{token}",
        sign_sessions=True,
        secret_key=secrets.token_bytes(32),
        extra_websocket_origins=[f"{_HOST}:{port}"],
        unused_session_lifetime_milliseconds=VIEWER.forgotten_ms,
        check_unused_sessions_milliseconds=VIEWER.forgotten_ms,
        include_headers=[],
        include_cookies=[],
    )
    application.add_handlers(".*", [(".*%00.*", ErrorHandler, {"status_code": 404})])  # no name of a file
    # another name of this machine is one that a page of the web gave it, to be taken for the same origin
    application.add_handlers(rf"(?!{re.escape(_HOST)}$).*", [(".*", ErrorHandler, {"status_code": 403})])
    http = HTTPServer(application)
    http.add_sockets(sockets)
    server = BaseServer(IOLoop.current(), application, http)
    server.start()
    return server, f"http://{_HOST}:{port}/{token}/"


def _pages(path: Path, statement: Mapping[str, Any]) -> dict[str, Callable[[Document], None]]:
    """Return the pages: a result, a test to set up and the result of its run, or the list of those in a folder.

    Bad input is reported at once. `statement` holds keys of ``[frames]``; for frames only.
    """
    shared: dict[tuple[Path, str], FrameProgress] = {}
    runs: list[Run] = []

    def make_page(source_path: Path) -> Callable[[Document], None]:
        if find_marker(source_path):
            Result.open(source_path, partial=True, check=False)
            return partial(_fill_result, source_path, shared)
        DraftFrames(Draft.from_path(source_path, statement))

        def setup(document: Document) -> None:
            dark = _query_value(document, "theme") == "dark"
            page = SetupPage(document, Draft.from_path(source_path, statement), runs, dark=dark)
            _place_page(document, page.roots, f"rgbmidic: {source_path.name}")

        return setup

    def listed_page(document: Document) -> None:
        name = _query_value(document, "path")
        if (entry_path := {str(file.relative_to(path)): file for file in _find_tests(path)}.get(name)) is None:
            raise InputError(f"{path} has no result and no test {name!r}")
        make_page(entry_path)(document)
        document.template_variables["back"] = True

    def result(document: Document) -> None:
        if not runs:
            raise ResultError("no run was started yet")
        _fill_result(runs[-1].out, shared, document)

    finished = find_marker(path) is not None
    several = not finished and path.is_dir() and any(_find_tests(path))
    if statement and (finished or several or path.suffix.lower() == ".toml"):
        description = "a result" if finished else "a folder of results and tests" if several else "a TEST.toml"
        options = ", ".join(f"--{key.replace('_', '-')}" for key in statement)
        raise InputError(f"{options}: for raw frames only, which do not state it; {path} is {description}")
    pages: dict[str, Callable[[Document], None]]
    pages = {"/": partial(_fill_list, path), "/open": listed_page} if several else {"/": make_page(path)}
    return {route: partial(_or_error, page) for route, page in {**pages, "/result": result}.items()}


def _find_tests(folder: Path) -> dict[Path, float]:
    """Return the results and TEST.toml files in a folder and two levels below with the time of change, newest first."""
    times, markers = dict[Path, float](), (PROVENANCE, *RESULTS)
    for pattern in ("", "*/", "*/*/"):
        for file in (file for name in (*markers, "*.toml") for file in folder.glob(f"{pattern}{name}")):
            try:
                if file.name in markers or "path" in read_table(read_toml(file, "settings file"), "frames"):
                    times[file.parent if file.name in markers else file] = file.stat().st_mtime
            except (ConfigurationError, OSError):  # of another program, or gone by now
                continue
    return dict(sorted(times.items(), key=lambda item: item[1], reverse=True)[: VIEWER.max_listed_tests])


def _fill_list(folder: Path, document: Document) -> None:
    """Fill the page that lists the results and tests of a folder."""
    rows = []
    for file, modified in _find_tests(folder).items():
        description = "test to set up or run"
        if file.suffix != ".toml":
            try:
                result = Result.open(file, partial=True, check=False)
                description = (
                    f"result: {int(result.finished.sum())} of {len(result)} frames, {', '.join(result.lights)}"
                )
            except RgbmidicError as error:
                description = f"result that cannot be opened: {error}"
        rows.append((file.relative_to(folder), description, f"{datetime.fromtimestamp(modified):%Y-%m-%d %H:%M}"))
    name = folder.resolve().name
    table = render("list.html", Path(__file__).parent, heading=name, rows=rows)
    _place_page(document, {"list": Div(text=table, sizing_mode="stretch_width")}, f"rgbmidic: {name}")


def _or_error(fill: Callable[[Document], None], document: Document) -> None:
    """Fill a page, or report an error in one line of it."""
    try:
        fill(document)
    except RgbmidicError as error:
        document.clear()
        _place_page(document, {"head": Div(text=html.escape(str(error)))}, "rgbmidic")


def _query(document: Document) -> dict[str, list[bytes]]:
    context = document.session_context
    return {} if context is None or context.request is None else context.request.arguments


def _query_value(document: Document, key: str) -> str:
    return _query(document).get(key, [b""])[-1].decode("utf-8", "replace")


def _fill_result(path: Path, shared: dict[tuple[Path, str], FrameProgress], document: Document) -> None:
    """Fill the page of a result as it is now, with the view of the address."""
    result = Result.open(path, partial=True, check=False)
    finished_frames = np.flatnonzero(result.finished)
    last_frame = int(finished_frames[-1]) if len(finished_frames) else 0
    names = list(Maps.from_result(result).quantities)
    view = ViewState.from_query(_query(document), frames=len(result), names=names, frame=last_frame)
    progress = shared.setdefault((path, result.provenance["created"]), FrameProgress(len(result)))
    page = ResultPage(document, result, view, progress)
    _place_page(document, page.roots, f"rgbmidic: {result.path.name}")


def _place_page(document: Document, roots: Mapping[str, Model], title: str) -> None:
    """Place the parts of a page in its template, with its style, its keys and the theme of its address."""
    theme = _query_value(document, "theme")
    with document.models.freeze():  # else all models are counted anew for each
        for name, root in roots.items():
            root.name = name
            document.add_root(root)
    if theme == "dark":
        document.theme = "dark_minimal"
    document.title = title
    page, style, script = map(page_file, ("page.html", "page.css", "page.js"))
    document.template = get_env().from_string(page)
    document.template_variables.update(
        theme=theme if theme in ("light", "dark") else "", areas=list(roots), style=style, script=script
    )
