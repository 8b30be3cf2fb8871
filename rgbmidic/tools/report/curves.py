"""Curves over time: quantiles of the nodal fields over the frames, what probes read off a result, and channels."""

from __future__ import annotations

import csv
import logging
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.renamed import state_new_names
from rgbmidic.results import QUANTITIES, Channels, Field, Histories, Maps, Profile, Wave
from rgbmidic.text import format_with_std
from rgbmidic.tools.report import style
from rgbmidic.tools.report.figures import field_colours, select_evenly
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rgbmidic.results.result_in_units import ResultInUnits

logger = logging.getLogger(__name__)

Panel = tuple[str, Sequence[Field]]
"""Label of a panel and the quantities that it shows over the time; without a label: one over the other."""
_KIND_PATTERN = re.compile(
    "(?:^|_)(velocity|acceleration|strain_rate|rate|strain|extension|opening|sliding|direction|stress)(_before|_after)?$"
)
_KIND_OF_UNIT = {"deg": "rotation", "": "strain", "MPa √m": "K", "MPa": "T-stress"}


class TimeHistory:
    """Quantiles over the nodes of the fields of some frames, read one frame after the other.

    Parameters
    ----------
    physical
        The result in the units of its scale.
    frames
        Indices of the frames in the result.

    Attributes
    ----------
    frames : tuple of int, length F
        Indices of the frames in the result.
    axis : tuple of ndarray, shape (F,), and str
        Times, or numbers of the frames where no time is known, and the label of the axis.
    has_times : bool
        Whether the times are known.
    fields : dict
        What each quantity is.
    components, component_stds : tuple of str
        Names of the components of the displacement, and of their standard uncertainties.
    quantiles : dict
        Of each quantity the 5 %, 50 % and 95 % quantile over the nodes, shape (F, 3); NaN where nothing is measured.
    fractions : ndarray, shape (F, S)
        Fraction of the nodes with each `node_status`.
    fastest : float
        Largest velocity of a node between two neighbouring ones of these frames, px per unit of time; 0 where unknown.

    Raises
    ------
    ResultError
        A frame is damaged.
    """

    def __init__(self, physical: ResultInUnits, frames: Sequence[int]) -> None:
        self.frames, self.has_times, times = tuple(frames), physical.units.timed, physical.times[list(frames)]
        self.components = physical.components
        self.component_stds = tuple(f"{name}_std" for name in self.components)
        names = (*self.components, *self.component_stds, "exx", "eyy", "exy", "exx_std", "eyy_std", "exy_std", "misfit")
        self.axis = style.time_axis(times if self.has_times else None, physical.result.number[list(frames)])
        self.fields = Maps(physical=physical).quantities
        self.quantiles = {name: np.full((len(times), 3), np.nan) for name in names}
        self.fractions = np.empty((len(times), len(QUANTITIES["node_status"].codes)))
        self.fastest, previous = 0.0, np.array(np.nan)
        for row, frame in enumerate(frames):
            values = physical.frame(frame)
            for name, quantiles in self.quantiles.items():
                if (finite := values[name][np.isfinite(values[name])]).size:
                    quantiles[row] = np.quantile(finite, (0.05, 0.5, 0.95))
            codes = range(self.fractions.shape[1])
            self.fractions[row] = [(values["node_status"] == code).mean() for code in codes]
            displacement = np.stack([values[name] for name in self.components]) / physical.length
            if row:
                step = np.linalg.norm(displacement - previous, axis=0) / (times[row] - times[row - 1])
                self.fastest = max(self.fastest, float(np.nan_to_num(step).max(initial=0)))
            previous = displacement

    def typical(self, name: str) -> FloatArray:
        """Return the quantiles over the nodes of a quantity, medians of the frames (3,); NaN where it is in none."""
        rows = self._measured_quantiles(name)
        return np.asarray(np.median(rows, axis=0)) if len(rows) else np.full(3, np.nan)

    def extreme(self, name: str) -> float:
        """Return the value farthest from 0 of a quantity's median over the nodes; NaN where nothing is measured."""
        return float(max(self._measured_quantiles(name)[:, 1], key=abs, default=np.nan))

    def _measured_quantiles(self, name: str) -> FloatArray:
        rows = self.quantiles[name]
        return np.asarray(rows[np.isfinite(rows).all(axis=1)])

    def key_frames(self, count: int) -> tuple[int, ...]:
        """Select frames between which the field changes by about as much: its quantiles' path in equal parts."""
        fields = np.stack([self.quantiles[name] for name in self.components])
        measured_rows = np.flatnonzero(np.isfinite(fields).all(axis=(0, 2)))
        if not len(measured_rows):
            return ()
        path = np.cumsum(np.abs(np.diff(fields[:, measured_rows], axis=1, prepend=0)).sum(axis=(0, 2)))  # from rest
        rows = np.searchsorted(path, path[-1] * np.arange(1, count + 1) / count * (1 - 1e-9))
        return tuple(self.frames[measured_rows[row]] for row in sorted({*rows.tolist()}))

    @property
    def farthest(self) -> int:
        """The frame whose median displacement is the largest."""
        length = np.linalg.norm([self.quantiles[name][:, 1] for name in self.components], axis=0)
        return self.frames[int(np.nan_to_num(length).argmax())]


def medians_figure(
    history: TimeHistory,
    panels: Mapping[str, Sequence[str]],
    *,
    band: bool = False,
    floor: Mapping[str, float] | None = None,
) -> Figure:
    """Draw the median over the nodes of quantities over the frames, a panel for each label.

    Either with a band of 5 to 95 % of the nodes, or, of standard uncertainties, with the noise floor as thin lines.
    """
    times, label_of_times = history.axis
    marker = "o" if len(times) <= 40 else None  # more would touch in half the width

    def draw(axes: list[Axes]) -> None:
        for axis, (label, names) in zip(axes, panels.items(), strict=True):
            for name, colour, line in zip(names, ("blue", "vermillion", "green"), style.LINES, strict=False):
                look: dict[str, Any] = {"color": style.OKABE_ITO[colour], "linestyle": line}
                low, median, high = history.quantiles[name].T
                axis.plot(
                    times,
                    median,
                    linewidth=1.2,
                    label=history.fields[name].symbol,
                    marker=marker,
                    markersize=2.5,
                    **look,
                )
                if band:
                    axis.fill_between(times, low, high, color=look["color"], alpha=0.18, linewidth=0)
                if floor:
                    axis.axhline(floor[name.removesuffix("_std")], linewidth=0.6, **look)
            if not band:
                axis.set_ylim(bottom=0)
            axis.legend(loc="best")
            style.finish_plot(axis, label_of_times, label, integer_ticks=not history.has_times)

    return style.draw_figure(draw, count=2, aspect=0.75, right_room=style.NUMBERS)


def status_figure(history: TimeHistory) -> Figure:
    """Draw the fraction of the nodes with each status over the frames."""

    def draw(axes: list[Axes]) -> None:
        (axis,), (times, label_of_times) = axes, history.axis
        codes = [code for code, fraction in enumerate(history.fractions.T) if code == 0 or fraction.any()]
        statuses = QUANTITIES["node_status"].codes
        names, colours = ([source[code] for code in codes] for source in (statuses, style.STATUS_COLOURS))
        axis.stackplot(times, history.fractions[:, codes].T, labels=names, colors=colours)
        axis.set_ylim(0, 1)
        axis.legend(loc="lower left", frameon=True)
        style.finish_plot(axis, label_of_times, "fraction of the nodes", integer_ticks=not history.has_times)

    return style.draw_figure(draw, count=1, aspect=0.35, right_room=style.GAP)


def history_panels(histories: Histories) -> list[Panel]:
    """Sort what probes read into panels: quantities of one kind and unit share one.

    Where a stress is known, a last panel has it and the strain.
    """
    panels: dict[str, list[Field]] = {}
    for quantity in histories.quantities:
        kind = quantity.name  # of a channel that is not a probe's
        if quantity.std is not None or quantity.name == "stress":
            match = _KIND_PATTERN.search(quantity.name)
            kind = match[1].replace("_", " ") if match else _KIND_OF_UNIT.get(quantity.unit, "displacement")
        panels.setdefault(f"{kind} ({quantity.unit})" if quantity.unit else kind, []).append(quantity)
    stress_panel = [("", [histories[name] for name in histories.stress_strain])] if histories.stress_strain else []
    return [*panels.items(), *stress_panel]


def history_figure(histories: Histories, panels: Sequence[Panel] = (), *, max_kinds: int = 24) -> Figure:
    """Draw what probes read, over the time, or over the frames where no time is known.

    Quantities of one kind and unit share a panel; two standard uncertainties on both sides are shaded. Where a stress
    is known, a last panel shows it over the strain. Of many kinds the first are shown, and a warning says so.

    Parameters
    ----------
    histories
        What the probes read off a result (`rgbmidic.results.histories.read_histories`).
    panels
        Those of its panels that are drawn; none: all.
    max_kinds
        Kinds of quantities that are shown at most: two screens high.

    Returns
    -------
    Figure
        The figure, which `save_figure` writes.

    Examples
    --------
    >>> from rgbmidic import Result, read_histories
    >>> from rgbmidic.settings import ProbeSettings
    >>> result = Result.open("my_result")
    >>> histories = read_histories(result, ProbeSettings(points=(tuple(result.nodes.mean(axis=0)),)))
    >>> len(history_figure(histories).axes)
    1
    """
    panels = panels or history_panels(histories)
    kinds = sum(bool(label) for label, _ in panels)
    if kinds > max_kinds:
        words = "the picture shows %d of %d kinds of quantities, in their order; the table has them all"
        logger.warning(words, max_kinds, kinds)
        panels = [*panels[:max_kinds], *panels[kinds:]]
    times, label_of_times = style.time_axis(histories.times, histories.frames)

    def draw(axes: list[Axes]) -> None:
        for axis, (label, quantities) in zip(axes, panels, strict=True):
            if label:
                _draw_quantities(axis, times, quantities)
                style.finish_plot(axis, label_of_times, style.literal(label), integer_ticks=histories.times is None)
                _draw_legend(axis, len(quantities))
            else:
                strain, stress = quantities
                axis.plot(strain.values, stress.values, marker="o", markersize=2.5, linewidth=1)
                label = f"{stress.name} ({stress.unit})"
                style.finish_plot(axis, style.literal(strain.name), style.literal(label), integer_ticks=False)

    tallest = 2.4 * len(panels) + 1  # inches: four panels fill a page
    return style.draw_figure(draw, count=len(panels), aspect=0.45, right_room=style.LEGEND, max_height=tallest)


_MAX_NAMES = 14
"""Names beside a panel at most: with 5 points they are as high as it is."""


def _draw_legend(axis: Axes, count: int) -> None:
    """Draw the names of `count` lines beside a panel, in letters that fit; where some are left out, say so."""
    size, step = 7.0 * min(1.0, 10 / min(count, _MAX_NAMES)), -(-count // _MAX_NAMES)
    title = f"{-(-count // step)} of {count} lines are named" if step > 1 else None
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=size, title=title, title_fontsize=size)


def _draw_quantities(axis: Axes, times: FloatArray, quantities: Sequence[Field]) -> None:
    """Draw quantities over the times (T,), with bands of two standard uncertainties; their values set the limits."""
    colours, finite_values = dict[str, Any](), list[FloatArray]()
    step = -(-len(quantities) // _MAX_NAMES)  # a crack has a quantity a node
    for number, quantity in enumerate(quantities):
        values, std = quantity.values, quantity.std
        has_markers = np.isfinite(values).sum() <= 60  # more markers would touch
        marker = style.MARKERS[number % len(style.MARKERS)] if has_markers else None
        look: dict[str, Any] = {"marker": marker, "markersize": 3, "linestyle": style.LINES[number % len(style.LINES)]}
        look["label"] = "_" if number % step else style.literal(quantity.name)
        base_name = quantity.name.removesuffix("_before").removesuffix("_after")
        if base_name in colours:  # both sides of a kink are single points of the rate
            look |= {"label": "_", "color": colours[base_name], "linestyle": "none", "marker": "D", "markersize": 4}
        if std is not None and quantity.name.endswith("direction"):
            values = np.where(2 * std < 45, values, np.nan)  # degrees, from which it may be any
        (line,) = axis.plot(times, values, linewidth=1, **look)
        colours[quantity.name] = line.get_color()
        finite_values.append(values[np.isfinite(values)])
        if std is not None:
            axis.fill_between(times, values - 2 * std, values + 2 * std, color=line.get_color(), alpha=0.2, linewidth=0)
    named_count = sum(not str(line.get_label()).startswith("_") for line in axis.lines)
    if step > 1:
        axis.plot([], [], linestyle="none", label=f"and {len(colours) - named_count} more")
    all_values = np.concatenate(finite_values)
    if all_values.size and np.ptp(all_values) > 0:
        axis.set_ylim(all_values.min() - 0.1 * np.ptp(all_values), all_values.max() + 0.1 * np.ptp(all_values))


def profile_figure(profile: Profile, wave: Wave | None = None, curve_rows: Sequence[int] = ()) -> Figure:
    """Draw a profile: position against time with the field as colour, and below it curves along the line.

    Parameters
    ----------
    profile
        A field along a line.
    wave
        Its arrival times are drawn as points, the line through them as a line.
    curve_rows
        Rows of the profile that are drawn as curves; none: six, the first and the last among them, the others
        evenly spaced where the field is largest.

    Returns
    -------
    Figure
        The figure.

    Examples
    --------
    >>> from rgbmidic.results import Maps, Result, read_profile
    >>> profile = read_profile(Maps.from_result(Result.open("my_result")), "u", (100, 150, 200, 150))
    >>> len(profile_figure(profile).axes)
    2
    """
    from matplotlib import colormaps
    from matplotlib.colors import Normalize

    has_times, (times, label_of_times) = profile.times is not None, style.time_axis(profile.times, profile.numbers)
    factor = 1.0 if profile.times is None else style.time_unit(profile.times)[0]
    position, field = f"position ({profile.units.length})", style.literal(profile.field.label)
    rows = list(curve_rows) or _select_rows(profile.values)
    colours = field_colours(profile.field)
    finite_values = style.ordinary_values(profile.values, profile.std)
    norm = Normalize(*(profile.field.fixed_range or style.colour_range(finite_values)))

    def draw(axes: list[Axes]) -> None:
        map_axis, curve_axis = axes
        look: dict[str, Any] = {"cmap": colours, "norm": norm, "rasterized": True, "shading": "nearest"}
        map_axis.pcolormesh(times, profile.positions, profile.values.T, **look)
        style.add_colour_bar(map_axis, norm, colours, values=finite_values)
        map_axis.set_title(field)
        if wave is not None:
            used_positions = wave.front.is_fitted
            points = factor * wave.arrivals.times.values[used_positions], profile.positions[used_positions]
            bars = 2 * factor * wave.arrivals.times.uncertainty[used_positions]
            map_axis.errorbar(
                *points, xerr=bars, fmt="o", ms=2.5, color="w", mec="k", mew=0.5, ecolor="k", elinewidth=0.8
            )
            line_ends = profile.positions[[0, -1]]
            map_axis.plot(factor * (wave.front.start + line_ends / wave.front.speed), line_ends, "r-", linewidth=1)
            map_axis.set_title(wave_text(profile, wave))
            map_axis.set_xlim(times[0], times[-1])
        style.finish_plot(map_axis, label_of_times, position, integer_ticks=not has_times)
        map_axis.grid(visible=False)
        curve_axis.set_title(profile.processing_note, pad=15, fontsize=8)  # above the power of ten of the numbers
        for row, shade in zip(rows, np.linspace(0, 0.85, len(rows)), strict=True):
            name = f"{times[row]:.5g} {label_of_times[6:-1]}" if has_times else f"frame {profile.numbers[row]}"
            colour, values, reach = colormaps["plasma"](shade), profile.values[row], 2 * profile.std[row]
            curve_axis.plot(profile.positions, values, label=name, color=colour, linewidth=1.1)
            curve_axis.fill_between(
                profile.positions, values - reach, values + reach, color=colour, alpha=0.2, linewidth=0
            )
        style.finish_plot(curve_axis, position, field, integer_ticks=False)
        legend_title = f"{len(rows)} of {len(times)} frames"
        curve_axis.legend(
            loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7, title=legend_title, title_fontsize=7
        )

    return style.draw_figure(draw, count=2, aspect=0.45, right_room=style.LEGEND / 1.6)


def _select_rows(values: FloatArray) -> list[int]:
    """Choose rows of a profile (T, P): all of up to six, else the first, the last, and four of the busy ones between.

    Busy is a row whose extreme lies above half of the largest.
    """
    size, last_row = np.nan_to_num(np.abs(values)).max(axis=1), len(values) - 1
    if last_row < 6:
        return list(range(last_row + 1))
    busy_rows = np.flatnonzero(size > 0.5 * size.max())
    return sorted({0, last_row, *select_evenly(busy_rows[(busy_rows > 0) & (busy_rows < last_row)].tolist(), 4)})


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
    level = f" at {wave.level}" if wave.feature == "front" else ""
    return f"{wave.feature} of {profile.field.symbol}{level}: {format_with_std(speed, std, unit)} ({fit})"


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve:
    """A quantity over time that is shown beside the maps.

    Attributes
    ----------
    name
        Label of its axis.
    times : ndarray, shape (n,)
        In seconds; indices of frames where `has_times` is false.
    values : ndarray, shape (n,)
    has_times
        Whether `times` are seconds.

    Examples
    --------
    >>> np.savetxt("force.csv", [[0, 0], [0.1, 20]], delimiter=",", header="time_s,force_N", comments="")
    >>> curve = Curve.read("force.csv")
    >>> curve.name, curve.values.tolist()
    ('force_N', [0.0, 20.0])
    >>> Path("force.csv").unlink()
    """

    name: str
    times: FloatArray
    values: FloatArray
    has_times: bool

    @classmethod
    def read(cls, path: Path | str, column: str | None = None, offset: float = 0.0) -> Curve:
        """Read a column of a file that ``rgbmidic history`` wrote, or a channel of a file of channels.

        Parameters
        ----------
        path
            CSV file.
        column
            Its name; None: the first that holds a quantity.
        offset
            Seconds that are added to the times of channels.

        Returns
        -------
        Curve

        Raises
        ------
        InputError
            The file is no such table or has no such column, or an offset is stated for a history.
        """
        path = Path(path)
        with suppress(OSError, UnicodeDecodeError), path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.reader(file)
            head = next(rows, [])
            if head[:3] == ["frame", "number", "status"]:
                has_times = "time_s" in head
                names = [name for name in head[3:] if name != "time_s" and not name.endswith("_std")]
                name = _select_column(path, column, names)
                columns = [head.index("time_s" if has_times else "frame"), head.index(name)]
                try:
                    table = np.array([[float(row[index] or "nan") for index in columns] for row in rows]).reshape(-1, 2)
                except (ValueError, IndexError):
                    raise InputError(f"the table {path} is damaged: a row is not numbers") from None
                if offset:
                    raise InputError(f"an offset is of channels; {path} is a history, by the frames' own clock")
                return cls(name=name, times=table[:, 0], values=table[:, 1], has_times=has_times)
        channels = Channels.read(path, offset)
        name = _select_column(path, column, list(channels.values))
        return cls(name=name, times=channels.times, values=channels.values[name], has_times=True)


def _select_column(path: Path, column: str | None, names: list[str]) -> str:
    if column not in (None, *names) or not names:
        raise InputError(f'{path} has no column "{column}"; it has {", ".join(names) or "none"}')
    return column or names[0]
