"""Figures over time: what the nodes of a test tell frame by frame.

Pictures of what probes read off a result: one panel for each kind of quantity, over time, with its uncertainty.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.report.setup import Course, NoiseFloor
from rgbmidic.report.style import GAP, LEGEND, LINES, NUMBERS, draw_figure, finish_plot, literal, time_unit
from rgbmidic.results import QUANTITIES, Histories, HistoryColumn
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rgbmidic.results.physical import Physical

__all__ = ["course_figure", "history_figure", "status_figure", "uncertainty_figure"]

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#999999")
"""Of Okabe and Ito, which everybody tells apart."""
_MARKED = 40
"""Points up to which each gets a mark of its own."""


def course_figure(told: Physical, course: Course) -> Figure:
    """Displacement and strain over the frames: median of the nodes as a line, 5 to 95 % of them as a band."""
    length = told.units.length
    panels = {f"displacement ({length})": ("u", "v"), f"strain ({told.measure_name})": ("exx", "eyy", "exy")}

    def draw(axes: list[Axes]) -> None:
        for axis, (label, names) in zip(axes, panels.items(), strict=True):
            times, unit = _times(told, course)
            for name, colour, line in zip(names, _COLOURS, LINES, strict=False):
                low, middle, high = course.quantiles[name].T
                axis.fill_between(times, low, high, color=colour, alpha=0.18, linewidth=0)
                axis.plot(times, middle, line, color=colour, linewidth=1.2, label=name, **_marks(times))
            axis.legend(loc="best")
            finish_plot(axis, unit, label, whole=not told.units.timed)

    return draw_figure(draw, count=2, aspect=0.75, beside=NUMBERS)


def uncertainty_figure(told: Physical, course: Course, floor: NoiseFloor | None) -> Figure:
    """Stated uncertainty over the frames, median of the nodes, and the noise floor of static frames as thin lines."""
    panels = {
        f"standard uncertainty ({told.units.length})": ("u", "v"),
        "standard uncertainty of strain": ("exx", "eyy", "exy"),
    }

    def draw(axes: list[Axes]) -> None:
        for axis, (label, names) in zip(axes, panels.items(), strict=True):
            times, unit = _times(told, course)
            for name, colour, line in zip(names, _COLOURS, LINES, strict=False):
                middle = course.quantiles[f"{name}_std"][:, 1]
                axis.plot(times, middle, line, color=colour, linewidth=1.2, label=f"{name}_std", **_marks(times))
                if floor is not None:
                    axis.axhline(floor.measured[name], color=colour, linestyle=line, linewidth=0.6)
            axis.set_ylim(bottom=0)
            axis.legend(loc="best")
            finish_plot(axis, unit, label, whole=not told.units.timed)

    return draw_figure(draw, count=2, aspect=0.75, beside=NUMBERS)


def status_figure(told: Physical, course: Course) -> Figure:
    """Share of the nodes with each status over the frames."""

    def draw(axes: list[Axes]) -> None:
        times, unit = _times(told, course)
        colours = ("#56b4e9", "#333333", "#d55e00", "#f0e442")
        shown = [code for code, share in enumerate(course.shares.T) if code == 0 or share.any()]
        words = QUANTITIES["node_status"].codes
        axes[0].stackplot(
            times,
            course.shares[:, shown].T,
            labels=[words[code] for code in shown],
            colors=[colours[code] for code in shown],
        )
        axes[0].set_ylim(0, 1)
        axes[0].legend(loc="lower left", frameon=True)
        finish_plot(axes[0], unit, "share of the nodes", whole=not told.units.timed)

    return draw_figure(draw, count=1, aspect=0.35, beside=GAP)


def _times(told: Physical, course: Course) -> tuple[FloatArray, str]:
    """The frames' times in a unit that suits them, and the name of the axis."""
    if not told.units.timed:
        return told.result.number[list(course.frames)].astype(np.float64), "frame"
    factor, unit = time_unit(course.times)
    return factor * course.times, f"time ({unit})"


def _marks(times: FloatArray) -> dict[str, Any]:
    return {"marker": "o", "markersize": 2.5} if len(times) <= _MARKED else {}


_MARKERS = 60
"""Known values up to which each gets a marker."""
_PANEL = 2.4
"""Height of a panel in inches, its numbers included."""
_KINDS = ("velocity", "acceleration", "strain_rate", "rate", "strain", "extension", "direction", "stress")


def history_figure(histories: Histories) -> Figure:
    """Every quantity over the time, or the frames where no time is known; two standard uncertainties are shaded.

    Where a stress is known a last panel shows it over the strain.
    """
    panels: dict[tuple[str, str], list[HistoryColumn]] = {}
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


def _kind(told: HistoryColumn) -> str:
    """What stands on the axis: quantities of one kind and unit share a panel, other channels have one each."""
    if told.std is None and told.name != "stress":
        return told.name
    name = told.name.removesuffix("_before").removesuffix("_after")
    kind = next((kind for kind in _KINDS if name.endswith(f"_{kind}") or name == kind), "")
    if kind:
        return kind.replace("_", " ")
    return {"deg": "rotation", "": "strain"}.get(told.unit, "displacement")


def _line(axis: Axes, over: FloatArray, told: HistoryColumn) -> None:
    marker = "o" if np.isfinite(told.values).sum() <= _MARKERS else None
    (line,) = axis.plot(over, told.values, marker=marker, markersize=2.5, linewidth=1, label=literal(told.name))
    if told.std is not None:
        low, high = told.values - 2 * told.std, told.values + 2 * told.std
        axis.fill_between(over, low, high, color=line.get_color(), alpha=0.2, linewidth=0)


def _limit(axis: Axes, quantities: list[HistoryColumn]) -> None:
    """Let the values, and not the widest uncertainty among them, say what is shown."""
    known = np.concatenate([told.values[np.isfinite(told.values)] for told in quantities])
    if known.size and np.ptp(known) > 0:
        axis.set_ylim(known.min() - 0.1 * np.ptp(known), known.max() + 0.1 * np.ptp(known))
