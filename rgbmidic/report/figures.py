"""Figures of a result: maps of its fields, and quantities over frames and iterations; `save_figure` writes them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.report.style import (
    BAR,
    GAP,
    LIGHT_COLOURS,
    LINES,
    NUMBERS,
    add_colour_bar,
    colour_scale,
    draw_figure,
    finish_picture,
    finish_plot,
    literal,
    ordinary_values,
    shade,
    show_image,
    view_limits,
)
from rgbmidic.results import QUANTITIES, REFLECTING, FrameRecord, Result, scale_of
from rgbmidic.results.physical import Physical
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

__all__ = [
    "MAPS",
    "brightness_figure",
    "convergence_figure",
    "field_figure",
    "fraction_figure",
    "map_figure",
    "mask_figure",
    "measured_frames",
    "reflection_figure",
    "residual_figure",
    "shown_frames",
    "spread",
]

MAPS = {
    "displacement": ("u", "v"),
    "uncertainty": ("u_std", "v_std"),
    "strain": ("exx", "eyy", "exy"),
    "misfit": ("misfit",),
}
"""Quantities of each kind of map."""
_POSITIVE = ("uncertainty", "misfit")
_FAILED = QUANTITIES["status"].codes.index("failed")
_EQUAL = 1e-9
"""Fraction of the colour range by which a value may exceed it by rounding alone."""
_RASTER = 600
"""Points along the longer side of a map: a panel of 4.5 inches has as many pixels at 130 dpi."""
_MANY_FRAMES = 8
"""Frames up to which a legend names each: it fills half the height of a panel."""
_MOST_LINES = 100
"""Frames of which lines are drawn at most; more cover each other. Chosen; only the picture depends on it."""


def shown_frames(result: Result) -> tuple[int, ...]:
    """Select the deformed frames that are measured; else all that are measured; else all of the test."""
    finished = result.finished
    deformed = tuple(index for index in result.deformed if finished[index])
    return deformed or tuple(np.flatnonzero(finished).tolist()) or tuple(range(len(result)))


def measured_frames(result: Result) -> tuple[int, ...]:
    """Select those of `shown_frames` that did not fail; all of them where all failed."""
    shown = shown_frames(result)
    ends = zip(shown, result.each("status", shown), strict=True)
    return tuple(frame for frame, end in ends if end != _FAILED) or shown


def spread(frames: Sequence[int], most: int) -> tuple[int, ...]:
    """Select at most `most` of the frames, evenly spaced up to the last one."""
    return tuple(sorted({frames[int(i)] for i in np.linspace(len(frames) - 1, 0, min(most, len(frames))).round()}))


def map_figure(result: Result, frame: int, kind: str) -> Figure:
    """Draw maps of nodal quantities of one frame over the reference image; blank where not measured.

    Displacements are in mm where the scale is known.

    Parameters
    ----------
    result
        The result.
    frame
        Index of the frame.
    kind
        One of `MAPS`.

    Returns
    -------
    Figure
        The figure, one panel per quantity.

    Raises
    ------
    InputError
        There is no such frame.
    ResultError
        The frame is damaged.
    """
    record = result.frame(frame)
    unit, lengths = _lengths(result, record)
    known, maps = {**record.values, **lengths}, {}
    for name in MAPS[kind]:
        std = known.get(f"{name}_std", np.zeros(len(record.u)))
        label = f"{name} ({unit})" if name in lengths else name
        maps[label] = known[name], std
    return field_figure(result, frame, maps, positive=kind in _POSITIVE)


def field_figure(
    result: Result, frame: int, fields: Mapping[str, tuple[FloatArray, FloatArray]], *, positive: bool = False
) -> Figure:
    """Draw maps of nodal fields of one frame, as `map_figure` does.

    Parameters
    ----------
    result
        The result.
    frame
        Index of the frame.
    fields
        Values (N,) and their uncertainties (N,) by their labels; nodes of large uncertainty do not set the colours.
    positive
        Whether the values are positive, and their colours logarithmic.

    Returns
    -------
    Figure
        The figure, one panel per field.

    Raises
    ------
    InputError, ResultError
        As `map_figure`.
    """
    maps = {}
    for label, (values, std) in fields.items():
        known = ordinary_values(values, std)
        maps[label] = values, colour_scale(known, positive=positive) if known.size else None
    return _maps(result, maps, "plasma" if positive else "viridis", _frame_title(result, frame, result.frame(frame)))


def fraction_figure(result: Result, frame: int) -> Figure:
    """Draw maps of the fraction of each light in what determines the nodes of one frame.

    Parameters
    ----------
    result
        The result.
    frame
        Index of the frame.

    Returns
    -------
    Figure
        The figure, one panel per light.

    Raises
    ------
    InputError, ResultError
        As `map_figure`.
    """
    from matplotlib.colors import Normalize

    record = result.frame(frame)
    fractions = np.where(record.light_fraction.sum(axis=1, keepdims=True) > 0, record.light_fraction, np.nan)
    titles = [literal(f"fraction of {light}") for light in result.lights]
    maps = {title: (part, Normalize(0, 1)) for title, part in zip(titles, fractions.T, strict=True)}
    return _maps(result, maps, "cividis", _frame_title(result, frame, record))


def mask_figure(result: Result, frame: int) -> Figure | None:
    """Draw what the weights of one frame exclude of each light before the solve.

    Parameters
    ----------
    result
        The result.
    frame
        Index of the frame.

    Returns
    -------
    Figure or None
        The figure, one panel per light; None where they exclude nothing, or no reference image was kept.

    Raises
    ------
    InputError, ResultError
        As `map_figure`.
    """
    record = result.frame(frame)
    excluded = 1 - record.weights_thumbnail / 255
    if not excluded.any():
        return None
    return _shaded(result, frame, record, excluded, lambda part: f"{part.mean():.1%} excluded")


def reflection_figure(result: Result, frame: int) -> Figure | None:
    """Draw the reflection index of each light in one frame.

    Parameters
    ----------
    result
        The result.
    frame
        Index of the frame.

    Returns
    -------
    Figure or None
        The figure, one panel per light; None where the separation did not estimate it, or no reference image was kept.

    Raises
    ------
    InputError, ResultError
        As `map_figure`.
    """
    record = result.frame(frame)
    index = record.reflection_thumbnail / 255
    if not index.size:
        return None
    return _shaded(result, frame, record, index, lambda part: f"reflects on {(part > REFLECTING).mean():.1%}")


def brightness_figure(result: Result) -> Figure:
    """Draw gain and offset of every light against the reference over the deformed frames.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    Figure
        The figure, one line per light.
    """
    gain, offset = np.moveaxis(result.brightness, -1, 0)
    return _over_frames(result, {"gain": gain, "offset (grey levels)": offset})


def residual_figure(result: Result) -> Figure:
    """Draw the weighted rms residual of every light, and its mean fraction in the nodes, over the deformed frames.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    Figure
        The figure, one line per light.
    """
    return _over_frames(result, {"residual": result.residual, "mean fraction in the nodes": result.mean_light_fraction})


def convergence_figure(result: Result) -> Figure:
    """Draw the largest motion of a measured node in each iteration, and the tolerance where it is known.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    Figure
        The figure, one line per deformed frame.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    shown = shown_frames(result)
    frames = shown[:: math.ceil(len(shown) / _MOST_LINES)]

    def draw(axes: list[Axes]) -> None:
        (axis,) = axes
        colours: list[Any] = [f"C{index}" for index in range(len(frames))]
        if len(frames) > _MANY_FRAMES:  # no legend, but a colour bar
            norm = Normalize(frames[0], frames[-1])
            colours = [colormaps["viridis"](norm(frame)) for frame in frames]
            add_colour_bar(axis, ScalarMappable(norm, "viridis"), label="frame")
        for frame, history, colour in zip(frames, result.each("history", frames), colours, strict=True):
            steps, name = np.arange(1, len(history) + 1), literal(result.names[frame])
            axis.plot(steps, history, marker="o", markersize=2.5, linewidth=1, color=colour, label=name)
        if (tolerance := result.setting("solver", "tolerance")) is not None:
            axis.axhline(tolerance, color="0.4", linewidth=0.8, linestyle="--", label="tolerance")
        axis.set_yscale("log")
        finish_plot(axis, "iteration", "largest motion of a measured node (px)")
        if len(frames) <= _MANY_FRAMES:
            axis.legend(loc="upper right")

    return draw_figure(draw, count=1, aspect=0.6, beside=BAR if len(frames) > _MANY_FRAMES else GAP)


def _over_frames(result: Result, panels: Mapping[str, FloatArray]) -> Figure:
    """Draw a panel per quantity (T, k), with one line per light over the deformed frames."""
    frames = list(shown_frames(result))

    def draw(axes: list[Axes]) -> None:
        for axis, (label, values) in zip(axes, panels.items(), strict=True):
            for light, line, series in zip(result.lights, cycle(LINES), values[frames].T, strict=False):
                style: dict[str, Any] = {"linestyle": line, "color": LIGHT_COLOURS.get(light)}
                style |= {"marker": "o", "markersize": 2.5, "linewidth": 1, "label": literal(light)}
                axis.plot(result.number[frames], series, **style)
            if np.nanmin(values, initial=0) >= 0:
                axis.set_ylim(bottom=0)
            finish_plot(axis, "frame", label)
        axes[-1].legend(loc="best")

    return draw_figure(draw, count=len(panels), aspect=0.75, beside=NUMBERS)


def _lengths(result: Result, record: FrameRecord) -> tuple[str, dict[str, FloatArray]]:
    """Return the unit of lengths, mm where the scale is known, and the displacements with their uncertainties in it."""
    scale, values = scale_of(result), {name: record.values[name] for name in ("u", "v", "u_std", "v_std")}
    if scale.mm_per_pixel is None:
        return "px", values
    units = Physical.untimed(result, scale).units
    for name in ("u", "v"):
        values[name], values[f"{name}_std"] = units.lengths(values[name], values[f"{name}_std"])
    return units.length, values


def _maps(
    result: Result, maps: Mapping[str, tuple[FloatArray, Normalize | None]], colour_map: str, title: str
) -> Figure:
    """Draw one map per nodal field, over the reference where there is one."""
    x, y = _view(result, result.nodes)
    reference = None if result.reference is None else result.reference.mean(axis=0, dtype=np.float32)

    def draw(axes: list[Axes]) -> None:
        for axis, (label, (values, norm)) in zip(axes, maps.items(), strict=True):
            if reference is not None:
                show_image(axis, reference, result.reference_origin)
            if norm is not None and np.isfinite(values).any():
                _show_field(axis, result, values, norm, colour_map)
            else:
                box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85}
                axis.text(0.5, 0.5, "nothing measured", transform=axis.transAxes, ha="center", va="center", bbox=box)
            axis.set_title(label)
            finish_picture(axis, x, y, first=axis is axes[0])

    return draw_figure(draw, count=len(maps), aspect=np.ptp(y) / np.ptp(x), beside=BAR, title=title)


def _show_field(axis: Axes, result: Result, values: FloatArray, norm: Normalize, colour_map: str) -> None:
    """Show a nodal field with its colour bar; blank where a node of the element is not measured."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.ticker import FormatStrFormatter, MaxNLocator, NullFormatter

    picture, extent = _raster(result, values)
    axis.imshow(picture, extent=extent, cmap=colour_map, norm=norm, interpolation="nearest")
    scaled = norm(values[np.isfinite(values)])
    extend = ("neither", "min", "max", "both")[int(scaled.min() < -_EQUAL) + 2 * int(scaled.max() > 1 + _EQUAL)]
    bar = add_colour_bar(axis, ScalarMappable(norm, colour_map), extend=extend)
    bar.ax.yaxis.set_major_locator(MaxNLocator(6))
    bar.ax.yaxis.set_major_formatter(FormatStrFormatter("%.4g"))
    bar.ax.yaxis.set_minor_formatter(NullFormatter())


def _raster(
    result: Result, values: FloatArray
) -> tuple[np.ma.MaskedArray[Any, Any], tuple[float, float, float, float]]:
    """Sample a nodal field on a fine grid, linear inside each element as in the solve; return it and its extent."""
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    blank = ~np.isfinite(values)[result.elements].all(axis=1)
    grid = Triangulation(result.nodes[:, 0], result.nodes[:, 1], triangles=result.elements, mask=blank)
    low, high = result.nodes.min(axis=0), result.nodes.max(axis=0)
    step = float((high - low).max()) / _RASTER
    x, y = (np.arange(start + step / 2, end, step) for start, end in zip(low, high, strict=True))
    picture = LinearTriInterpolator(grid, np.nan_to_num(values))(*np.meshgrid(x, y))
    return picture, (low[0], low[0] + step * len(x), low[1] + step * len(y), low[1])


def _shaded(
    result: Result, frame: int, record: FrameRecord, cover: FloatArray, title_of: Callable[[FloatArray], str]
) -> Figure | None:
    """Show the reference of each light around the mesh, shaded by a reduced picture (k, h, w) of one frame.

    `title_of` describes the part of a light's picture that is shown. None where no reference was kept.
    """
    if (reference := result.reference) is None:
        return None
    step, origin = -(-reference.shape[1] // cover.shape[1]), result.reference_origin
    moved = result.nodes + np.stack([record.u, record.v], axis=1)
    x, y = _view(result, np.concatenate([result.nodes, moved[np.isfinite(moved).all(axis=1)]]))
    columns, rows = (
        slice(int((low - first + 0.5) // step), math.ceil((high - first + 0.5) / step))
        for (low, high), first in zip((x, y), origin, strict=True)
    )

    def draw(axes: list[Axes]) -> None:
        for axis, image, part, light in zip(axes, reference, cover, result.lights, strict=True):
            show_image(axis, image, origin)
            shade(axis, part, step, origin)
            axis.set_title(literal(f"{light}: {title_of(part[rows, columns])}"))
            finish_picture(axis, x, y, first=axis is axes[0])

    title = f"{_frame_title(result, frame, record)}, over the reference image"
    return draw_figure(draw, count=len(cover), aspect=np.ptp(y) / np.ptp(x), beside=GAP, title=title)


def _view(result: Result, points: FloatArray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the limits in x and in y of a picture around points (N, 2), inside the image."""
    low, high = view_limits(points)
    if result.reference is not None:
        first, size = np.array(result.reference_origin), np.array(result.reference.shape[:0:-1])
        low, high = (np.clip(end, first - 0.5, first + size - 0.5) for end in (low, high))
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def _frame_title(result: Result, frame: int, record: FrameRecord) -> str:
    """Return the title of a frame: number, file, status, iterations, fraction of nodes without data."""
    blank = np.isnan(record.u).mean()
    missing = f", {blank:.1%} of the nodes not measured" if blank else ""
    end = QUANTITIES["status"].codes[record.status]
    return f"frame {frame}: {literal(result.names[frame])} ({end}, {record.iterations} iterations{missing})"
