"""Figures over time: what the nodes of a test tell frame by frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.report.facts import Course, NoiseFloor
from rgbmidic.report.style import GAP, LINES, NUMBERS, draw_figure, finish_plot, time_unit
from rgbmidic.results import QUANTITIES
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rgbmidic.results.physical import Physical

__all__ = ["course_figure", "status_figure", "uncertainty_figure"]

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
