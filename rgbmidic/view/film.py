"""The button that writes a movie of what is in view, in a process of its own, and stops the one being written."""

from __future__ import annotations

import html
import multiprocessing
import signal
import sys
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

from rgbmidic.errors import RgbmidicError
from rgbmidic.report import Movie, write_movie
from rgbmidic.results import Maps
from rgbmidic.view.models import ResultControls, warning
from rgbmidic.view.picture import RawPictures
from rgbmidic.view.shown import ShownFields


class FilmButton:
    """Movies of the fields in view.

    Parameters
    ----------
    parts
        Controls of the page, with the button and what is said of the movie.
    shown
        The fields in view.
    """

    def __init__(self, parts: ResultControls, shown: ShownFields) -> None:
        self._parts, self._shown, self._out = parts, shown, Path()
        self._process: Any = None
        self._reports: Any = None

    def press(self) -> None:
        """Write a movie of what is in view, into a file that is not there yet; or stop the one that is written."""
        if not self._parts.movie.active:
            if self._process is not None:
                self.stop(f"{self._out.name} was stopped; no file is left")
            return
        shown, view, names = self._shown, self._shown.view, self._shown.names
        limited = {"test": names, "hand": names[:1]}.get(view.range, [])
        maps = shown.maps
        options = {
            "limits": {name: shown.ends(name) for name in limited},
            "opacity": view.opacity,
            "colours": (view.palette if len(names) == 1 else "") or None,
            "images": RawPictures(result=maps.result) if view.over == "deformed" else None,
        }
        ending = ".mp4" if find_spec("imageio_ffmpeg") else ".gif"
        name = f"movie_{'_'.join(names)}".replace(" ", "_")
        files = (maps.result.path / f"{name}{f'_{number}' if number > 1 else ''}{ending}" for number in count(1))
        self._out = next(file for file in files if not file.exists())
        context = multiprocessing.get_context("spawn")
        self._reports, send = context.Pipe(duplex=False)
        self._process = context.Process(target=_write, args=(send, maps, self._out, names, options), daemon=True)
        self._process.start()
        send.close()
        self._tell(f"{html.escape(self._out.name)}: starting")

    def tell(self) -> None:
        """Show how far the movie is, where its file is, or why there is none."""
        try:
            while self._process is not None and self._reports.poll():
                self._tell(*self._reports.recv())
        except EOFError:
            self.stop(f"no {self._out.name}: its process was ended")

    def stop(self, text: str) -> None:
        """End the process, which leaves nothing of its file, and show why."""
        if self._process is not None:
            self._process.terminate()
            self._process.join()
        self._tell(warning(text), ended=True)

    def _tell(self, text: str, ended: bool = False) -> None:
        p = self._parts
        p.said.text, p.said.visible = text, True
        p.movie.label = "Movie" if ended else "■ Movie"
        if ended:
            self._process, p.movie.active = None, False


def _write(send: Any, maps: Maps, out: Path, fields: list[str], options: dict[str, Any]) -> None:
    """Write a movie, and report each hundredth of it and its end, as HTML."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # what is begun is removed

    def progress(done: int, total: int, _: str) -> None:
        if 100 * done // total > 100 * (done - 1) // total:
            send.send((f"{html.escape(out.name)}: {done} of {total} frames",))

    try:
        write_movie(Movie(maps=maps, fields=fields, **options), out, progress=progress)
        gif = ' (a .gif; for .mp4: pip install "rgbmidic[movie]")' if out.suffix == ".gif" else ""
        send.send((f"written: {html.escape(str(out))}{gif}", True))
    except (RgbmidicError, OSError) as error:
        send.send((warning(f"no {out.name}: {error}"), True))
    except Exception as error:  # the page says it, whatever it is; its traceback goes to the terminal
        send.send((warning(f"no {out.name}: unexpected error: {type(error).__name__}: {error}"), True))
        raise
