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
from rgbmidic.results import Maps
from rgbmidic.settings import PROBE_NAME, ChannelSettings, ProbeSettings, ScaleSettings, read_section, to_plain
from rgbmidic.tools.report import FieldMovie, write_movie
from rgbmidic.tools.view.controls import WRITABLE_SECTIONS, ResultControls
from rgbmidic.tools.view.fields import FieldsInView
from rgbmidic.tools.view.marks import KINDS, SCALE, Mark, common_gauge, marks_of_probes, probe_marks, settings_of_marks
from rgbmidic.tools.view.picture import RawPictures
from rgbmidic.tools.view.test_file_editor import Confirmation, Draft
from rgbmidic.tools.view.widgets import warning


class ProbeNames:
    """Choice of a probe and the field with its name.

    Parameters
    ----------
    controls
        Controls of the page.
    fields
        The fields in view, with the marks.
    take_marks
        Called with the marks of which one has another name.
    """

    def __init__(
        self, controls: ResultControls, fields: FieldsInView, take_marks: Callable[[tuple[Mark, ...]], None]
    ) -> None:
        self._controls, self._fields, self._take_marks = controls, fields, take_marks
        controls["name"].on_change("value", lambda attr, old, new: self._rename(new.strip()))
        controls["probe"].on_change("value", lambda attr, old, new: self.offer_probes())

    def offer_probes(self) -> None:
        """Offer the probes that marks make, and the name of the one that is chosen."""
        probe, probes = self._controls["probe"], probe_marks(self._fields.view.marks)
        probe.options = list(probes)
        if probe.value not in probes:
            probe.value = next(iter(probes), "")
        self._controls["name"].value = probes[probe.value][0].name if probes else ""

    def _rename(self, name: str) -> None:
        """Give the chosen probe a name; empty: its kind and number."""
        controls, marks = self._controls, self._fields.view.marks
        group = probe_marks(marks).get(controls["probe"].value)
        if group is None or name == group[0].name:
            return
        if name and (not PROBE_NAME.fullmatch(name) or any(mark.name == name for mark in marks)):
            controls.message.text = warning(
                f'a name has letters, digits, spaces, "." and "-", and no other probe has it; not "{name}"'
            )
            self.offer_probes()
            return
        self._take_marks(tuple(replace(mark, name=name) if mark is group[0] else mark for mark in marks))
        renamed = probe_marks(self._fields.view.marks)
        controls["probe"].value = name or next(
            key for key, renamed_group in renamed.items() if renamed_group[1:] == group[1:]
        )


class FileButtons:
    """Sections of a TEST.toml for what is in view, and the probes that it states.

    Parameters
    ----------
    controls
        Controls of the page.
    fields
        The fields in view.
    """

    def __init__(self, controls: ResultControls, fields: FieldsInView) -> None:
        self._controls, self._fields, self._confirmation = controls, fields, Confirmation()

    def write(self) -> None:
        """Write the chosen sections into a TEST.toml, which must be confirmed where it exists."""
        controls, fields = self._controls, self._fields
        draft = Draft.from_result(fields.result, Path(controls["file"].value))
        probe_settings = settings_of_marks(
            fields.view.marks, fields.gauge, fields.result.section(ProbeSettings), fields.measure
        )
        section_makers: dict[str, Callable[[], dict[str, Any]]] = {
            "probes": lambda: probe_section(draft, probe_settings),
            "channels": lambda: channel_section(draft, fields.channels),
            "scale": lambda: scale_section(draft, fields.scale),
        }
        names = [WRITABLE_SECTIONS[index] for index in sorted(controls["sections_to_write"].active)]
        if not names:
            raise InputError(f"choose what is written: {', '.join(WRITABLE_SECTIONS)}")
        edited = draft.with_values({name: section_makers[name]() for name in names})
        edited.check()
        sections = " and ".join(f"[{name}]" for name in names)
        if question := self._confirmation.question([draft.file], f"{sections} in it"):
            controls["save_status"].text = warning(question)
            return
        edited.write()
        controls["save_status"].text = html.escape(
            f"{sections} of {draft.file} {'is' if len(names) == 1 else 'are'} written."
        )

    def read_probes(self) -> tuple[Mark, ...]:
        """Return the marks of the probes that a TEST.toml states, and those of the scale; sets the gauge."""
        draft = Draft.from_result(self._fields.result, Path(self._controls["file"].value))
        settings = read_section(ProbeSettings, "probes", draft.section("probes"))
        if (gauge := common_gauge(settings)) is None:
            raise InputError(f"the strain gauges of {draft.file} have different lengths; the page has one for all")
        if gauge:
            self._controls["gauge"].value = gauge
        self._controls[
            "save_status"
        ].text = f"{len(settings.kind_coordinates)} probes are read from {html.escape(str(draft.file))}."
        return (*marks_of_probes(settings), *(mark for mark in self._fields.view.marks if mark.kind == SCALE))


def probe_section(draft: Draft, new_probes: ProbeSettings) -> dict[str, Any]:
    """Return the keys of ``[probes]`` for probes set with the pointer, to a thousandth of a pixel; others stay."""
    stored = read_section(ProbeSettings, "probes", draft.section("probes"))
    keys = {
        f"{kind}s": [[round(value, 3) for value in position] for position in getattr(new_probes, f"{kind}s")]
        for kind in KINDS
    }
    names = [list(pair) for pair in stored.names if pair[0].rpartition("_")[0] not in KINDS]
    names += [list(pair) for pair in new_probes.names]
    measure = {"measure": new_probes.measure} if new_probes.measure != stored.measure else {}
    return {**{key: value or None for key, value in keys.items()}, "names": names or None, **measure}


def channel_section(draft: Draft, settings: ChannelSettings) -> dict[str, Any]:
    """Return the keys of ``[channels]``, the file relative to the TEST.toml where it is beside it.

    Raises
    ------
    ConfigurationError
        No file is stated.
    """
    if settings.file is None:
        raise ConfigurationError("state the channels' file first (channels.file)")
    keys = {**to_plain(settings), "file": _path(draft, settings.file)}
    return {key: value or None for key, value in keys.items()}


def scale_section(draft: Draft, settings: ScaleSettings | None) -> dict[str, Any]:
    """Return the keys of ``[scale]``, the scale rounded as `rgbmidic scale` prints it.

    Raises
    ------
    ConfigurationError
        No scale is stated.
    """
    if settings is None:
        raise ConfigurationError("set two points and state their distance in mm, or name the camera file")
    keys: dict[str, Any] = dict.fromkeys(("mm_per_pixel", "mm_per_pixel_std", "camera"))
    if settings.camera is not None:
        return {**keys, "camera": _path(draft, settings.camera)}
    std = float(f"{settings.mm_per_pixel_std:.2g}")
    return {**keys, "mm_per_pixel": float(f"{settings.mm_per_pixel:.6g}"), "mm_per_pixel_std": std}


def _path(draft: Draft, file: Path) -> str:
    """Return the path of a file as a TEST.toml states it: its name where it is beside it."""
    return file.name if file.resolve().parent == draft.file.parent else str(file.resolve())


class MovieButton:
    """Movies of the fields in view.

    Parameters
    ----------
    controls
        Controls of the page, with the button and what is said of the movie.
    fields
        The fields in view.
    """

    def __init__(self, controls: ResultControls, fields: FieldsInView) -> None:
        self._controls, self._fields, self._out = controls, fields, Path()
        self._process: Any = None
        self._reports: Any = None

    def press(self) -> None:
        """Write a movie of what is in view, into a file that is not there yet; or stop the one that is written."""
        if not self._controls.movie.active:
            if self._process is not None:
                self.stop(f"{self._out.name} was stopped; no file is left")
            return
        fields, view, names = self._fields, self._fields.view, self._fields.names
        limited_fields = {"test": names, "hand": names[:1]}.get(view.range, [])
        maps = fields.maps
        options = {
            "limits": {name: fields.colour_range(name) for name in limited_fields},
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
        self._show_status(f"{html.escape(self._out.name)}: starting")

    def poll(self) -> None:
        """Show how far the movie is, where its file is, or why there is none."""
        try:
            while self._process is not None and self._reports.poll():
                self._show_status(*self._reports.recv())
        except EOFError:
            self.stop(f"no {self._out.name}: its process was ended")

    def stop(self, text: str) -> None:
        """End the process, which leaves nothing of its file, and show why."""
        if self._process is not None:
            self._process.terminate()
            self._process.join()
        self._show_status(warning(text), ended=True)

    def _show_status(self, text: str, ended: bool = False) -> None:
        controls = self._controls
        controls.movie_status.text, controls.movie_status.visible = text, True
        controls.movie.label = "Movie" if ended else "■ Movie"
        if ended:
            self._process, controls.movie.active = None, False


def _write(send: Any, maps: Maps, out: Path, fields: list[str], options: dict[str, Any]) -> None:
    """Write a movie, and report each hundredth of it and its end, as HTML."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # what is begun is removed

    def progress(done: int, total: int, _: str) -> None:
        if 100 * done // total > 100 * (done - 1) // total:
            send.send((f"{html.escape(out.name)}: {done} of {total} frames",))

    try:
        write_movie(FieldMovie(maps=maps, fields=fields, **options), out, progress=progress)
        gif = ' (a .gif; for .mp4: pip install "rgbmidic[movie]")' if out.suffix == ".gif" else ""
        send.send((f"written: {html.escape(str(out))}{gif}", True))
    except (RgbmidicError, OSError) as error:
        send.send((warning(f"no {out.name}: {error}"), True))
    except Exception as error:  # the page says it, whatever it is; its traceback goes to the terminal
        send.send((warning(f"no {out.name}: unexpected error: {type(error).__name__}: {error}"), True))
        raise
