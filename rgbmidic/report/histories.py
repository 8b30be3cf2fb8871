"""Pictures of what probes read off a result: one panel for each kind of quantity, over time, with its uncertainty."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rgbmidic.report.style import LEGEND, draw_figure, finish_plot, literal, time_unit
from rgbmidic.results import Histories, Told
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["history_figure"]

_MARKERS = 60
"""Known values up to which each gets a marker."""
_PANEL = 2.4
"""Height of a panel in inches, its numbers included."""
_KINDS = ("velocity", "acceleration", "strain_rate", "rate", "strain", "extension", "direction", "stress")


def history_figure(histories: Histories) -> Figure:
    """Every quantity over the time, or the frames where no time is known; two standard uncertainties are shaded.

    Where a stress is known a last panel shows it over the strain.
    """
    panels: dict[tuple[str, str], list[Told]] = {}
    for told in histories.quantities:
        panels.setdefault((_kind(told), told.unit), []).append(told)
    timed = histories.times is not None
    over = np.asarray(histories.times if timed else histories.frames, dtype=np.float64)
    factor, unit_of_time = time_unit(over) if timed else (1.0, "")
    over, along = factor * over, f"time ({unit_of_time})" if timed else "frame"

    def draw(axes: list[Axes]) -> None:
        for axis, ((kind, unit), quantities) in zip(axes, panels.items(), strict=False):
            for told in quantities:
                _line(axis, over, told)
            _limit(axis, quantities)
            finish_plot(axis, along, literal(f"{kind} ({unit})" if unit else kind), whole=not timed)
            axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7)
        if histories.stress_strain is not None:
            strain, stress = (histories[name] for name in histories.stress_strain)
            axes[-1].plot(strain.values, stress.values, marker="o", markersize=2.5, linewidth=1)
            finish_plot(axes[-1], literal(strain.name), literal(f"{stress.name} ({stress.unit})"), whole=False)

    count = len(panels) + (histories.stress_strain is not None)
    return draw_figure(draw, count=count, aspect=0.45, beside=LEGEND, tallest=_PANEL * count + 1)


def _kind(told: Told) -> str:
    """What stands on the axis: quantities of one kind and unit share a panel, other channels have one each."""
    if told.std is None and told.name != "stress":
        return told.name
    name = told.name.removesuffix("_before").removesuffix("_after")
    kind = next((kind for kind in _KINDS if name.endswith(f"_{kind}") or name == kind), "")
    if kind:
        return kind.replace("_", " ")
    return {"deg": "rotation", "": "strain"}.get(told.unit, "displacement")


def _line(axis: Axes, over: FloatArray, told: Told) -> None:
    marker = "o" if np.isfinite(told.values).sum() <= _MARKERS else None
    (line,) = axis.plot(over, told.values, marker=marker, markersize=2.5, linewidth=1, label=literal(told.name))
    if told.std is not None:
        low, high = told.values - 2 * told.std, told.values + 2 * told.std
        axis.fill_between(over, low, high, color=line.get_color(), alpha=0.2, linewidth=0)


def _limit(axis: Axes, quantities: list[Told]) -> None:
    """Let the values, and not the widest uncertainty among them, say what is shown."""
    known = np.concatenate([told.values[np.isfinite(told.values)] for told in quantities])
    if known.size and np.ptp(known) > 0:
        axis.set_ylim(known.min() - 0.1 * np.ptp(known), known.max() + 0.1 * np.ptp(known))
