"""The probes that are marked: which one is chosen, and its name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from rgbmidic.settings import PROBE_NAME
from rgbmidic.view.address import Mark, probe_marks
from rgbmidic.view.models import ResultControls
from rgbmidic.view.picture import warning


class ProbeNames:
    """Choice of a probe and the field with its name.

    Parameters
    ----------
    parts
        Controls of the page.
    take
        Called with the marks of which one has another name; it offers them.
    """

    def __init__(self, parts: ResultControls, take: Callable[[tuple[Mark, ...]], None]) -> None:
        self._parts, self._take, self._marks = parts, take, tuple[Mark, ...]()
        parts.name.on_change("value", lambda attr, old, new: self.rename(new))
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

    def rename(self, name: str) -> None:
        """Give the chosen probe a name; empty: its kind and number."""
        p, (name, marks) = self._parts, (name.strip(), self._marks)
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
