"""Pictures of what probes read off a result: one panel for each kind of quantity, over time, with its uncertainty."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rgbmidic.report.style import draw_figure, finish_plot
from rgbmidic.results import Histories, Told

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["history_figure"]

_MARKERS = 60
"""Frames up to which each gets a marker."""
_KINDS = ("velocity", "acceleration", "strain_rate", "rate", "strain", "extension", "direction", "stress")


def history_figure(histories: Histories) -> Figure:
    """Every quantity over the time, or the frames where no time is known; two standard uncertainties are shaded.

    Where a stress is known a last panel shows it over the strain.
    """
    panels: dict[tuple[str, str], list[Told]] = {}
    for told in histories.quantities:
        panels.setdefault((_kind(told), told.unit), []).append(told)
    timed = histories.times is not None
    over, label = (histories.times, "time (s)") if timed else (histories.frames, "frame")

    def draw(figure: Figure, axes: list[Axes]) -> None:
        for axis, ((kind, unit), quantities) in zip(axes, panels.items(), strict=False):
            for told in quantities:
                _line(axis, np.asarray(over, dtype=np.float64), told)
            finish_plot(axis, label, f"{kind} ({unit})" if unit else kind, whole=not timed)
            axis.legend(loc="best", fontsize=7)
        if histories.stress_strain is not None:
            strain, stress = (histories[name] for name in histories.stress_strain)
            axes[-1].plot(strain.values, stress.values, marker="o", markersize=2.5, linewidth=1)
            finish_plot(axes[-1], strain.name, f"{stress.name} ({stress.unit})", whole=False)

    count = len(panels) + (histories.stress_strain is not None)
    return draw_figure(draw, count=count, aspect=0.45, colour_bars=False, tall=True)


def _kind(told: Told) -> str:
    """What stands on the axis: quantities of one kind and unit share a panel, other channels have one each."""
    if told.std is None and told.name != "stress":
        return told.name
    kind = next((kind for kind in _KINDS if told.name.endswith(f"_{kind}") or told.name == kind), "")
    if kind:
        return kind.replace("_", " ")
    return {"deg": "rotation", "": "strain"}.get(told.unit, "displacement")


def _line(axis: Axes, over: np.ndarray[tuple[int], np.dtype[np.float64]], told: Told) -> None:
    marker = "o" if len(over) <= _MARKERS else None
    (line,) = axis.plot(over, told.values, marker=marker, markersize=2.5, linewidth=1, label=told.name)
    if told.std is not None:
        low, high = told.values - 2 * told.std, told.values + 2 * told.std
        axis.fill_between(over, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
