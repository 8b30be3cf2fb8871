"""Controls of the channels recorded beside a test: their clock, and what is drawn of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from bokeh.events import PanEnd, PanStart

from rgbmidic.view.curves import CurvePanel
from rgbmidic.view.models import ResultControls
from rgbmidic.view.shown import ShownFields


class ChannelControls:
    """Channels and curves that can be chosen.

    Parameters
    ----------
    parts
        Controls of the page.
    curves
        The curves.
    shown
        The fields in view.
    base
        Folder that the paths of the view are relative to.
    read
        Reads the curves anew.
    """

    def __init__(
        self, parts: ResultControls, curves: CurvePanel, shown: ShownFields, base: Path, read: Callable[[], None]
    ) -> None:
        self._parts, self._curves, self._shown, self._base, self._read = parts, curves, shown, base, read

    def offer(self) -> None:
        """Offer channels and curves as they are now, and the controls of the chosen clock."""
        p, view, curves = self._parts, self._shown.view, self._curves
        names = [] if curves.channels is None else list(curves.channels.values)
        quantities = [] if curves.histories is None else [one.name for one in curves.histories.quantities]
        read = [name for name in quantities if name not in names]
        for entry, first, known in (
            ("trigger", "choose", names), ("align", "choose", names), ("force", "the only one in N or kN", names),
            ("beside", "none", names), ("align_to", "choose", read), ("along", "time", quantities),
        ):  # fmt: skip
            stated = getattr(view, entry)
            p.of[entry].options = [("", first), *dict.fromkeys([*known, *([stated] if stated else [])])]
        p.of["trigger"].visible = view.clock == "trigger"
        p.of["align"].visible = p.of["align_to"].visible = view.clock == "correlation"
        p.of["offset"].visible = view.clock == "offset"

    def change(self) -> None:
        """Take what is stated of the channels, and what is drawn of them."""
        view, curves = self._shown.view, self._curves
        if (curves.histories is None) == bool(view.channels):
            self._read()
            return
        stated = view.channel_settings(self._base)
        curves.along, curves.beside = view.along, view.beside
        if stated != curves.stated:
            curves.stated = stated
            curves.combine()
        self.offer()
        curves.draw()
        curves.point(view.frame)

    def drag(self, event: Any) -> None:
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
