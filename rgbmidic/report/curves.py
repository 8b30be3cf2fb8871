"""Figures over time: quantiles of the nodal fields over the frames, and what probes read off a result."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.report.style import (
    GAP,
    LEGEND,
    LINES,
    MARKERS,
    NUMBERS,
    OKABE_ITO,
    STATUS_COLOURS,
    add_colour_bar,
    colour_range,
    draw_figure,
    finish_plot,
    literal,
    ordinary_values,
    time_axis,
    time_unit,
)
from rgbmidic.report.summary import NoiseFloor, TimeHistory
from rgbmidic.results import QUANTITIES, Histories, HistoryColumn, Profile, Wave, uncertain
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rgbmidic.results.physical import Physical

logger = logging.getLogger(__name__)

_COLOURS = [OKABE_ITO[name] for name in ("blue", "vermillion", "green")]
_STATUS = QUANTITIES["node_status"].codes
_MARKED, _MARKED_OF_PROBE = 40, 60
"""Points up to which each gets a marker, in a panel of half the width and of the whole width: more would touch."""
_PANEL = 2.4
"""Height of a panel of `history_figure` in inches, its numbers included: four fill a page."""
_PANELS = 24
"""Most panels of a picture of histories: two screens high. Chosen."""
_NAMED = 14
"""Most quantities of a panel that its legend names: more lines of 7 pt are higher than it; a crack has one a node."""
_KNOWN_DIRECTION = 45.0
"""Two standard uncertainties (degrees) of a principal direction from which it is not drawn: it may be any. Chosen."""
_KINDS = (
    "velocity",
    "acceleration",
    "strain_rate",
    "rate",
    "strain",
    "extension",
    "opening",
    "sliding",
    "direction",
    "stress",
)
_KIND_OF_UNIT = {"deg": "rotation", "": "strain", "MPa √m": "K", "MPa": "T-stress"}


def field_history_figure(physical: Physical, history: TimeHistory) -> Figure:
    """Draw displacement and strain over the frames: median of the nodes as a line, 5 to 95 % of them as a band."""

    def band(axis: Axes, name: str, style: dict[str, Any]) -> None:
        low, _, high = history.quantiles[name].T
        axis.fill_between(history.axis[0], low, high, color=style["color"], alpha=0.18, linewidth=0)

    panels = {f"displacement ({physical.units.length})": ("u", "v")}
    return _medians({**panels, f"strain ({physical.measure_name})": ("exx", "eyy", "exy")}, history, band)


def uncertainty_figure(physical: Physical, history: TimeHistory, floor: NoiseFloor | None) -> Figure:
    """Draw the stated uncertainty over the frames, median of the nodes; the noise floor as thin lines."""

    def level(axis: Axes, name: str, style: dict[str, Any]) -> None:
        if floor is not None:
            axis.axhline(floor.measured[name.removesuffix("_std")], linewidth=0.6, **style)
        axis.set_ylim(bottom=0)

    panels = {f"standard uncertainty ({physical.units.length})": ("u_std", "v_std")}
    return _medians({**panels, "standard uncertainty of strain": ("exx_std", "eyy_std", "exy_std")}, history, level)


def _medians(
    panels: Mapping[str, Sequence[str]], history: TimeHistory, add: Callable[[Axes, str, dict[str, Any]], None]
) -> Figure:
    """Draw the median over the nodes of quantities over the frames, a panel for each label; `add` adds to each line."""
    times, label_of_times = history.axis
    marker = "o" if len(times) <= _MARKED else None

    def draw(axes: list[Axes]) -> None:
        for axis, (label, names) in zip(axes, panels.items(), strict=True):
            for name, colour, line in zip(names, _COLOURS, LINES, strict=False):
                style: dict[str, Any] = {"color": colour, "linestyle": line}
                median = history.quantiles[name][:, 1]
                axis.plot(times, median, linewidth=1.2, label=name, marker=marker, markersize=2.5, **style)
                add(axis, name, style)
            axis.legend(loc="best")
            finish_plot(axis, label_of_times, label, whole=not history.timed)

    return draw_figure(draw, count=2, aspect=0.75, beside=NUMBERS)


def status_figure(history: TimeHistory) -> Figure:
    """Draw the fraction of the nodes with each status over the frames."""

    def draw(axes: list[Axes]) -> None:
        (axis,), (times, label_of_times) = axes, history.axis
        shown = [code for code, part in enumerate(history.fractions.T) if code == 0 or part.any()]
        names, colours = ([source[code] for code in shown] for source in (_STATUS, STATUS_COLOURS))
        axis.stackplot(times, history.fractions[:, shown].T, labels=names, colors=colours)
        axis.set_ylim(0, 1)
        axis.legend(loc="lower left", frameon=True)
        finish_plot(axis, label_of_times, "fraction of the nodes", whole=not history.timed)

    return draw_figure(draw, count=1, aspect=0.35, beside=GAP)


def history_figure(histories: Histories) -> Figure:
    """Draw what probes read, over the time, or over the frames where no time is known.

    Quantities of one kind and unit share a panel; two standard uncertainties on both sides are shaded. Where a stress
    is known, a last panel shows it over the strain. Of many kinds the first 24 are shown, and a warning says so.

    Parameters
    ----------
    histories
        What the probes read off a result (`rgbmidic.results.histories.read_histories`).

    Returns
    -------
    Figure
        The figure, which `save_figure` writes.
    """
    panels: dict[tuple[str, str], list[HistoryColumn]] = {}
    for quantity in histories.quantities:
        panels.setdefault((_kind(quantity), quantity.unit), []).append(quantity)
    if len(panels) > _PANELS:
        words = "the picture shows %d of %d kinds of quantities, in their order; the table has them all"
        logger.warning(words, _PANELS, len(panels))
        panels = dict(islice(panels.items(), _PANELS))
    times, label_of_times = time_axis(histories.times, histories.frames)

    def draw(axes: list[Axes]) -> None:
        for axis, ((kind, unit), quantities) in zip(axes, panels.items(), strict=False):
            step = -(-len(quantities) // _NAMED)
            colours: dict[str, Any] = {}
            for number, quantity in enumerate(quantities):
                known = np.isfinite(quantity.values).sum()
                marker = MARKERS[number % len(MARKERS)] if known <= _MARKED_OF_PROBE else None
                shown: dict[str, Any] = {"marker": marker, "markersize": 3, "linestyle": LINES[number % len(LINES)]}
                shown["label"] = "_" if number % step else literal(quantity.name)
                of = quantity.name.removesuffix("_before").removesuffix("_after")
                if of in colours:  # both sides of a kink are single points of the rate
                    shown |= {"label": "_", "color": colours[of], "linestyle": "none", "marker": "D", "markersize": 4}
                values, std = quantity.values, quantity.std
                if std is not None and quantity.name.endswith("direction"):
                    values = np.where(2 * std < _KNOWN_DIRECTION, values, np.nan)
                (line,) = axis.plot(times, values, linewidth=1, **shown)
                colours[quantity.name] = line.get_color()
                if std is not None:
                    low, high = values - 2 * std, values + 2 * std
                    axis.fill_between(times, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
            values = np.concatenate([quantity.values[np.isfinite(quantity.values)] for quantity in quantities])
            if values.size and np.ptp(values) > 0:  # the values set the limits, not the widest uncertainty among them
                axis.set_ylim(values.min() - 0.1 * np.ptp(values), values.max() + 0.1 * np.ptp(values))
            label = literal(f"{kind} ({unit})" if unit else kind)
            finish_plot(axis, label_of_times, label, whole=histories.times is None)
            axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7)
        if histories.stress_strain is not None:
            strain, stress = (histories[name] for name in histories.stress_strain)
            axes[-1].plot(strain.values, stress.values, marker="o", markersize=2.5, linewidth=1)
            finish_plot(axes[-1], literal(strain.name), literal(f"{stress.name} ({stress.unit})"), whole=False)

    count = len(panels) + (histories.stress_strain is not None)
    return draw_figure(draw, count=count, aspect=0.45, beside=LEGEND, tallest=_PANEL * count + 1)


def profile_figure(profile: Profile, wave: Wave | None = None, shown: Sequence[int] = ()) -> Figure:
    """Draw a profile: position against time with the field as colour, and below it curves along the line.

    Parameters
    ----------
    profile
        A field along a line.
    wave
        Its arrival times are drawn as points, the line through them as a line.
    shown
        Rows of the profile that are drawn as curves; none: six, evenly spaced where the field is largest.

    Returns
    -------
    Figure
        The figure.
    """
    times, label_of_times = time_axis(profile.times, profile.numbers)
    factor = 1.0 if profile.times is None else time_unit(profile.times)[0]
    position = f"position ({profile.units.length})"
    rows = list(shown) or _rows_shown(profile.values)
    colours = "plasma" if profile.field.kind == "positive" else "viridis"

    def draw(axes: list[Axes]) -> None:
        from matplotlib.colors import Normalize

        above, below = axes
        known = ordinary_values(profile.values, profile.std)
        low, high = profile.field.ends or colour_range(known)
        shape: dict[str, Any] = {"cmap": colours, "vmin": low, "vmax": high, "rasterized": True, "shading": "nearest"}
        above.pcolormesh(times, profile.positions, profile.values.T, **shape)
        add_colour_bar(above, Normalize(low, high), colours, beyond=(bool(known.min() < low), bool(known.max() > high)))
        if wave is not None:
            used = wave.front.used
            points = factor * wave.arrivals.times[used], profile.positions[used]
            bars = 2 * factor * wave.arrivals.std[used]
            above.errorbar(*points, xerr=bars, fmt="o", ms=2.5, color="w", mec="k", mew=0.5, ecolor="k", elinewidth=0.8)
            ends = profile.positions[[0, -1]]
            above.plot(factor * (wave.front.start + ends / wave.front.speed), ends, "r-", linewidth=1)
            above.set_title(wave_text(profile, wave))
            above.set_xlim(times[0], times[-1])
        else:
            above.set_title(literal(profile.field.label))
        finish_plot(above, label_of_times, position, whole=profile.times is None)
        above.grid(visible=False)
        below.set_title(profile.how, pad=15, fontsize=8)  # above the power of ten of the numbers
        for row, shade in zip(rows, np.linspace(0, 0.85, len(rows)), strict=True):
            look: dict[str, Any] = {"color": colormaps["plasma"](shade), "linewidth": 1.1}
            name = (
                f"frame {profile.numbers[row]}" if profile.times is None else f"{times[row]:.5g} {label_of_times[6:-1]}"
            )
            (line,) = below.plot(profile.positions, profile.values[row], label=name, **look)
            edges = (profile.values[row] + side * 2 * profile.std[row] for side in (-1, 1))
            below.fill_between(profile.positions, *edges, color=line.get_color(), alpha=0.2, linewidth=0)
        finish_plot(below, position, literal(profile.field.label), whole=False)
        below.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7)

    from matplotlib import colormaps

    return draw_figure(draw, count=2, aspect=0.45, beside=LEGEND / 1.6)


def _rows_shown(values: FloatArray) -> list[int]:
    """Choose six rows of a profile (T, P), evenly spaced over the frames in which its extreme lies above half."""
    size = np.nan_to_num(np.abs(values)).max(axis=1)
    busy = np.flatnonzero(size > 0.5 * size.max(initial=0))
    return sorted({int(busy[int(i)]) for i in np.linspace(0, len(busy) - 1, 6).round()}) if len(busy) else [0]


def wave_text(profile: Profile, wave: Wave) -> str:
    """Return the speed of a wave with its uncertainty and chi-square as text.

    Parameters
    ----------
    profile
        The profile that the wave travels along.
    wave
        The wave.

    Returns
    -------
    str
    """
    front, unit = wave.front, f"{profile.units.length}/{profile.units.time}"
    speed, std = front.speed, front.speed_std
    if unit == "mm/s":
        speed, std, unit = speed / 1000, std / 1000, "m/s"
    fit = f"chi-square {front.chi_square:.3g} of {front.freedom}"
    return f"{wave.what} of {profile.field.symbol}: {uncertain(speed, std, unit)} ({fit})"


def _kind(quantity: HistoryColumn) -> str:
    """Name the panel of a quantity: its kind, or the name of a channel that is not a probe's."""
    if quantity.std is None and quantity.name != "stress":
        return quantity.name
    name = quantity.name.removesuffix("_before").removesuffix("_after")
    kind = next((kind for kind in _KINDS if name.endswith(f"_{kind}") or name == kind), "")
    return kind.replace("_", " ") or _KIND_OF_UNIT.get(quantity.unit, "displacement")
