"""The server of the viewer: for this machine only, behind an address that nobody guesses, without any other file."""

from __future__ import annotations

import secrets
import webbrowser
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.core.templates import get_env
from bokeh.document import Document
from bokeh.models import Div
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop

from rgbmidic.errors import InputError, ResultError
from rgbmidic.results import Result
from rgbmidic.view.address import Look
from rgbmidic.view.fields import Fields
from rgbmidic.view.page import ResultPage

__all__ = ["serve", "start"]

_HOST = "127.0.0.1"
_FORGOTTEN = 15_000
"""Ms after which what a closed page held is let go."""
_THEMES = {"dark": "dark_minimal"}


def serve(path: Path, *, port: int = 0, browser: bool = True, tell: Callable[[str], None] = print) -> None:
    """Show a result in the browser until the process is interrupted.

    Parameters
    ----------
    path
        Result folder; a run may still add to it.
    port
        0: any that is free.
    browser
        Whether to open the browser.
    tell
        Is given the address.

    Raises
    ------
    ResultError
        The folder is not a result, or is damaged.
    InputError
        The port is in use.
    """
    server, address = start(path, port=port)
    tell(address)
    if browser:
        server.io_loop.add_callback(webbrowser.open, address)
    try:
        server.io_loop.start()
    finally:
        server.stop()


def start(path: Path, *, port: int = 0, loop: Any = None) -> tuple[BaseServer, str]:
    """A server that answers once its loop runs, and its address; errors as `serve`."""
    result = Result.open(path, partial=True)
    token = secrets.token_urlsafe(24)
    try:
        sockets, port = bind_sockets(_HOST, port)
    except OSError as error:
        raise InputError(f"port {port} of {_HOST} cannot be used ({error.strerror or error}): state another --port, or none") from None
    application = BokehTornado(
        {"/": Application(FunctionHandler(lambda document: _open(document, result)))},
        prefix=f"/{token}",
        extra_websocket_origins=[f"{_HOST}:{port}"],
        unused_session_lifetime_milliseconds=_FORGOTTEN,
        check_unused_sessions_milliseconds=_FORGOTTEN,
        include_headers=[],
        include_cookies=[],
    )
    http = HTTPServer(application)
    http.add_sockets(sockets)
    server = BaseServer(loop or IOLoop.current(), application, http)
    server.start()
    return server, f"http://{_HOST}:{port}/{token}/"


def _open(document: Document, result: Result) -> None:
    """The page of a visitor: the result as it is now, looked at as the address says."""
    try:
        result = result.refresh()
    except ResultError as error:
        _refuse(document, str(error))
        return
    there = np.flatnonzero(result.finished)
    last = int(there[-1]) if len(there) else 0
    context = document.session_context
    query = {} if context is None or context.request is None else context.request.arguments
    look = Look.from_query(query, frames=len(result), names=list(Fields.of(result).all), frame=last)
    page = ResultPage(document, result, look)
    roots = page.roots
    for name, root in roots.items():
        root.name = name
        document.add_root(root)
    if look.theme in _THEMES:
        document.theme = _THEMES[look.theme]
    _dress(document, f"rgbmidic: {result.path.name}", look.theme, list(roots))


def _refuse(document: Document, text: str) -> None:
    document.add_root(Div(name="head", text=text))
    _dress(document, "rgbmidic", "", ["head"])


def _dress(document: Document, title: str, theme: str, areas: list[str]) -> None:
    """The frame of the page, its style and its keys."""
    document.title = title
    page, style, script = (
        files("rgbmidic.view").joinpath(name).read_text(encoding="utf-8") for name in ("page.html", "page.css", "keys.js")
    )
    document.template = get_env().from_string(page)
    document.template_variables.update(theme=theme, areas=areas, style=style, script=script)
