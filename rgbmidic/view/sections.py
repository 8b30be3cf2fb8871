"""Controls of a result that do more than change an entry of the view: probes' names, TEST.toml, the movie."""

from __future__ import annotations

import html
import multiprocessing
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

from rgbmidic.errors import ConfigurationError, InputError, RgbmidicError
from rgbmidic.report import Movie, write_movie
from rgbmidic.results import Maps
from rgbmidic.settings import PROBE_NAME, ChannelSettings, ProbeSettings, ScaleSettings, read_section, to_plain
from rgbmidic.view.address import KINDS, SCALE, Mark, common_gauge, marks_of, probe_marks, probes
from rgbmidic.view.draft import Confirmation, Draft
from rgbmidic.view.models import WRITTEN, ResultControls, warning
from rgbmidic.view.picture import RawPictures
from rgbmidic.view.shown import ShownFields


class ProbeNames:
    """Choice of a probe and the field with its name.

    Parameters
    ----------
    parts
        Controls of the page.
    shown
        The fields in view, with the marks.
    take
        Called with the marks of which one has another name.
    """

    def __init__(self, parts: ResultControls, shown: ShownFields, take: Callable[[tuple[Mark, ...]], None]) -> None:
        self._parts, self._shown, self._take = parts, shown, take
        parts.name.on_change("value", lambda attr, old, new: self._rename(new.strip()))
        parts.probe.on_change("value", lambda attr, old, new: self.offer())

    def offer(self) -> None:
        """Offer the probes that marks make, and the name of the one that is chosen."""
        probe, probes = self._parts.probe, probe_marks(self._shown.view.marks)
        probe.options = list(probes)
        if probe.value not in probes:
            probe.value = next(iter(probes), "")
        self._parts.name.value = probes[probe.value][0].name if probes else ""

    def _rename(self, name: str) -> None:
        """Give the chosen probe a name; empty: its kind and number."""
        p, marks = self._parts, self._shown.view.marks
        found = probe_marks(marks).get(p.probe.value)
        if found is None or name == found[0].name:
            return
        if name and (not PROBE_NAME.fullmatch(name) or any(mark.name == name for mark in marks)):
            p.message.text = warning(
                f'a name has letters, digits, spaces, "." and "-", and no other probe has it; not "{name}"'
            )
            self.offer()
            return
        self._take(tuple(replace(mark, name=name) if mark is found[0] else mark for mark in marks))
        renamed = probe_marks(self._shown.view.marks)
        p.probe.value = name or next(key for key, own in renamed.items() if own[1:] == found[1:])


class FileButtons:
    """Sections of a TEST.toml for what is in view, and the probes that it states.

    Parameters
    ----------
    parts
        Controls of the page.
    shown
        The fields in view.
    """

    def __init__(self, parts: ResultControls, shown: ShownFields) -> None:
        self._parts, self._shown, self._confirmation = parts, shown, Confirmation()

    def write(self) -> None:
        """Write the chosen sections into a TEST.toml, which must be confirmed where it exists."""
        p, shown = self._parts, self._shown
        draft = Draft.of_result(shown.result, Path(p.file.value))
        made = probes(shown.view.marks, shown.gauge, shown.result.section(ProbeSettings), shown.measure)
        ready: dict[str, Callable[[], dict[str, Any]]] = {
            "probes": lambda: probe_section(draft, made),
            "channels": lambda: channel_section(draft, shown.channels),
            "scale": lambda: scale_section(draft, shown.scale),
        }
        names = [WRITTEN[at] for at in sorted(p.what.active)]
        if not names:
            raise InputError(f"choose what is written: {', '.join(WRITTEN)}")
        changed = draft.changed({name: ready[name]() for name in names})
        changed.check()
        sections = " and ".join(f"[{name}]" for name in names)
        if asked := self._confirmation.question([draft.file], f"{sections} in it"):
            p.written.text = warning(asked)
            return
        changed.write()
        p.written.text = html.escape(f"{sections} of {draft.file} {'is' if len(names) == 1 else 'are'} written.")

    def probes(self) -> tuple[Mark, ...]:
        """Return the marks of the probes that a TEST.toml states, and those of the scale; sets the gauge."""
        draft = Draft.of_result(self._shown.result, Path(self._parts.file.value))
        stated = read_section(ProbeSettings, "probes", draft.section("probes"))
        if (gauge := common_gauge(stated)) is None:
            raise InputError(f"the strain gauges of {draft.file} have different lengths; the page has one for all")
        if gauge:
            self._parts.of["gauge"].value = gauge
        self._parts.written.text = (
            f"{len(stated.kind_coordinates)} probes are read from {html.escape(str(draft.file))}."
        )
        return (*marks_of(stated), *(mark for mark in self._shown.view.marks if mark.kind == SCALE))


def probe_section(draft: Draft, made: ProbeSettings) -> dict[str, Any]:
    """Return the keys of ``[probes]`` for probes set with the pointer, to a thousandth of a pixel; others stay."""
    kept = read_section(ProbeSettings, "probes", draft.section("probes"))
    keys = {f"{kind}s": [[round(value, 3) for value in place] for place in getattr(made, f"{kind}s")] for kind in KINDS}
    names = [list(pair) for pair in kept.names if pair[0].rpartition("_")[0] not in KINDS]
    names += [list(pair) for pair in made.names]
    measure = {"measure": made.measure} if made.measure != kept.measure else {}
    return {**{key: value or None for key, value in keys.items()}, "names": names or None, **measure}


def channel_section(draft: Draft, stated: ChannelSettings) -> dict[str, Any]:
    """Return the keys of ``[channels]``, the file relative to the TEST.toml where it is beside it.

    Raises
    ------
    ConfigurationError
        No file is stated.
    """
    if stated.file is None:
        raise ConfigurationError("state the channels' file first (channels.file)")
    keys = {**to_plain(stated), "file": _path(draft, stated.file)}
    return {key: value or None for key, value in keys.items()}


def scale_section(draft: Draft, stated: ScaleSettings | None) -> dict[str, Any]:
    """Return the keys of ``[scale]``, the scale rounded as `rgbmidic scale` prints it.

    Raises
    ------
    ConfigurationError
        No scale is stated.
    """
    if stated is None:
        raise ConfigurationError("set two points and state their distance in mm, or name the camera file")
    keys: dict[str, Any] = dict.fromkeys(("mm_per_pixel", "mm_per_pixel_std", "camera"))
    if stated.camera is not None:
        return {**keys, "camera": _path(draft, stated.camera)}
    std = float(f"{stated.mm_per_pixel_std:.2g}")
    return {**keys, "mm_per_pixel": float(f"{stated.mm_per_pixel:.6g}"), "mm_per_pixel_std": std}


def _path(draft: Draft, file: Path) -> str:
    """Return the path of a file as a TEST.toml states it: its name where it is beside it."""
    return file.name if file.resolve().parent == draft.file.parent else str(file.resolve())


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
