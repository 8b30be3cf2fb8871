"""What the page writes into a TEST.toml, and the probes that it takes from one."""

from __future__ import annotations

import html
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rgbmidic.errors import InputError
from rgbmidic.fields import MEASURES
from rgbmidic.results import probes_of
from rgbmidic.settings import ProbeSettings, read_section
from rgbmidic.view.address import SCALE, Mark
from rgbmidic.view.curves import marks_of, probes
from rgbmidic.view.draft import Confirmation, Draft, channel_section, probe_section, scale_section
from rgbmidic.view.models import WRITTEN, ResultControls
from rgbmidic.view.picture import warning
from rgbmidic.view.shown import ShownFields


class FileButtons:
    """Sections of a TEST.toml for what is in view.

    Parameters
    ----------
    parts
        Controls of the page.
    shown
        The fields in view.
    base
        Folder that the paths of the view are relative to.
    """

    def __init__(self, parts: ResultControls, shown: ShownFields, base: Path) -> None:
        self._parts, self._shown, self._base, self._confirmation = parts, shown, base, Confirmation()

    def write(self) -> None:
        """Write the chosen sections into a TEST.toml, which must be confirmed where it exists."""
        p, shown, view = self._parts, self._shown, self._shown.view
        draft = Draft.of_result(shown.result, Path(p.file.value))
        measure = view.measure if view.measure != MEASURES[0] else None
        made = probes(view.marks, shown.gauge, probes_of(shown.result), measure)
        ready: dict[str, Callable[[], dict[str, Any]]] = {
            "probes": lambda: probe_section(draft, made),
            "channels": lambda: channel_section(draft, view.channel_settings(self._base)),
            "scale": lambda: scale_section(draft, shown.scale),
        }
        names = [WRITTEN[at] for at in sorted(p.what.active)]
        if not names:
            raise InputError(f"choose what is written: {', '.join(WRITTEN)}")
        draft = draft.changed({name: ready[name]() for name in names})
        draft.check()
        sections = " and ".join(f"[{name}]" for name in names)
        if asked := self._confirmation.question([draft.file], f"{sections} in it"):
            p.written.text = warning(asked)
            return
        draft.write()
        p.written.text = html.escape(f"{sections} of {draft.file} {'is' if len(names) == 1 else 'are'} written.")

    def probes(self) -> tuple[Mark, ...]:
        """Return the marks of the probes that a TEST.toml states, and those of the scale; sets the gauge."""
        draft = Draft.of_result(self._shown.result, Path(self._parts.file.value))
        stated = read_section(ProbeSettings, "probes", draft.section("probes"))
        lengths = {length for *_, length in stated.strain_gauges}
        if len(lengths) > 1:
            raise InputError(f"the strain gauges of {draft.file} have different lengths; the page has one for all")
        if lengths:
            self._parts.of["gauge"].value = lengths.pop()
        self._parts.written.text = f"{len(stated.places)} probes are read from {html.escape(str(draft.file))}."
        return (*marks_of(stated), *(mark for mark in self._shown.view.marks if mark.kind == SCALE))
