"""Sections of a result's controls that change more than one entry of the view: probes' names, channels, TEST.toml."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from bokeh.events import Pan, PanEnd, PanStart

from rgbmidic.errors import InputError
from rgbmidic.settings import PROBE_NAME, ProbeSettings, read_section
from rgbmidic.view.address import SCALE, Mark, ViewState, probe_marks
from rgbmidic.view.curves import CurvePanel, marks_of, probes
from rgbmidic.view.draft import Confirmation, Draft, channel_section, probe_section, scale_section
from rgbmidic.view.models import WRITTEN, ResultControls, warning
from rgbmidic.view.shown import ShownFields


class ProbeNames:
    """Choice of a probe and the field with its name.

    Parameters
    ----------
    parts
        Controls of the page.
    take
        Called with the marks of which one has another name.
    """

    def __init__(self, parts: ResultControls, take: Callable[[tuple[Mark, ...]], None]) -> None:
        self._parts, self._take, self._marks = parts, take, tuple[Mark, ...]()
        parts.name.on_change("value", lambda attr, old, new: self._rename(new.strip()))
        parts.probe.on_change("value", lambda attr, old, new: self._show())

    def offer(self, marks: tuple[Mark, ...]) -> None:
        """Offer the probes that marks make."""
        probe, self._marks = self._parts.probe, marks
        probe.options = list(probe_marks(marks))
        if probe.value not in probe.options:
            probe.value = next(iter(probe.options), "")
        self._show()

    def _show(self) -> None:
        marks = probe_marks(self._marks).get(self._parts.probe.value)
        self._parts.name.value = marks[0].name if marks else ""

    def _rename(self, name: str) -> None:
        """Give the chosen probe a name; empty: its kind and number."""
        p, marks = self._parts, self._marks
        found = probe_marks(marks).get(p.probe.value)
        if found is None or name == found[0].name:
            return
        if name and (not PROBE_NAME.fullmatch(name) or any(mark.name == name for mark in marks)):
            p.message.text = warning(
                f'a name has letters, digits, spaces, "." and "-", and no other probe has it; not "{name}"'
            )
            self._show()
            return
        self._take(tuple(replace(mark, name=name) if mark is found[0] else mark for mark in marks))
        p.probe.value = name or next(key for key, own in probe_marks(self._marks).items() if own[1:] == found[1:])


class ChannelControls:
    """Channels and curves that can be chosen, and the channels' clock.

    Parameters
    ----------
    parts
        Controls of the page.
    curves
        The curves.
    """

    def __init__(self, parts: ResultControls, curves: CurvePanel) -> None:
        self._parts, self._curves = parts, curves
        for event in (PanStart, PanEnd, Pan):
            curves.plot.on_event(event, self._drag)

    def offer(self, view: ViewState) -> None:
        """Offer channels and curves as they are now."""
        p, curves = self._parts, self._curves
        names = [] if curves.channels is None else list(curves.channels.values)
        quantities = [] if curves.histories is None else [one.name for one in curves.histories.quantities]
        read = [name for name in quantities if name not in names]
        for entry, first, known in (
            ("trigger", "choose", names), ("align", "choose", names), ("force", "the one in N or kN", names),
            ("beside", "none", names), ("align_to", "choose", read), ("along", "time", quantities),
        ):  # fmt: skip
            stated = getattr(view, entry)
            p.of[entry].options = [("", first), *dict.fromkeys([*known, *([stated] if stated else [])])]
        shown = {"trigger": "trigger", "align": "correlation", "align_to": "correlation", "offset": "offset"}
        for entry, clock in shown.items():
            p.of[entry].visible = view.clock == clock

    def _drag(self, event: Any) -> None:
        """Move the channels along the time with the pointer; their offset is stated where it lets go."""
        if not self._parts.drag.active or event.x is None:
            return
        if isinstance(event, PanStart):
            self._curves.grab(event.x)
        offset = self._curves.drag(event.x)
        if offset is None:
            return
        self._parts.drag.label = f"Offset {offset:.6g} s"
        if isinstance(event, PanEnd):
            self._parts.of["clock"].value, self._parts.of["offset"].value = "offset", float(f"{offset:.9g}")


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
        lengths = {length for *_, length in stated.strain_gauges}
        if len(lengths) > 1:
            raise InputError(f"the strain gauges of {draft.file} have different lengths; the page has one for all")
        if lengths:
            self._parts.of["gauge"].value = lengths.pop()
        self._parts.written.text = f"{len(stated.places)} probes are read from {html.escape(str(draft.file))}."
        return (*marks_of(stated), *(mark for mark in self._shown.view.marks if mark.kind == SCALE))
