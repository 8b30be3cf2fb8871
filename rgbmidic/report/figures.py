"""Figures of a result. Each function gives a matplotlib `Figure`; `save_figure` writes it. No display is needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError, ResultError
from rgbmidic.results import QUANTITIES, REFLECTING, Result
from rgbmidic.typing import AnyArray, FloatArray, FloatImage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "brightness_figure",
    "convergence_figure",
    "displacement_figure",
    "mask_figure",
    "reflection_figure",
    "residual_figure",
    "save_figure",
    "share_figure",
    "uncertainty_figure",
]

_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "legend.frameon": False,
}
_WIDTH = 7.5
"""Width of a figure in inches."""
_CLIPPED, _WILD = 0.5, 0.1
"""Colours span all values but this percentage at each end, and what lies within this share of that span beyond."""
_RASTER = 600
"""Points along the longer side of a map."""
_LIGHT_COLOURS = {"red": "#c8102e", "green": "#1a7f37", "blue": "#1f5fbf"}
_MANY_FRAMES = 8


def displacement_figure(result: Result, frame: int, image: AnyArray | None = None) -> Figure:
    """Maps of u and v of one frame, in px, over the reference image; blank where not measured.

    Parameters
    ----------
    result
        The result.
    frame
        Index of the frame.
    image : ndarray, shape (H, W), optional
        Reference image, shown in grey below.

    Raises
    ------
    InputError
        There is no such frame.
    ResultError
        The frame's file is damaged.
    """
    record = result.frame(frame)
    fields = {"u": record.u, "v": record.v}
    return _maps(result, fields, "px", "viridis", _frame_title(result, frame), image)


def uncertainty_figure(result: Result, frame: int, image: AnyArray | None = None) -> Figure:
    """Maps of the standard uncertainty of u and v of one frame, in px; the rest as `displacement_figure`."""
    record = result.frame(frame)
    fields = {"std of u": record.u_std, "std of v": record.v_std}
    return _maps(result, fields, "px", "magma", _frame_title(result, frame), image)


def mask_figure(images: npt.ArrayLike, weights: npt.ArrayLike, names: Sequence[str]) -> Figure:
    """Each light's image with the zones shaded that its weight excludes.

    Parameters
    ----------
    images : array, shape (k, H, W)
        Illumination images in grey levels; NaN where unknown.
    weights : array, shape (k, h, w)
        Weights from 0 (excluded, fully shaded) to 1; reduced pictures of them will do.
    names : k texts
        The lights' names.

    Raises
    ------
    InputError
        The numbers of images, weights and names differ.
    """
    images, weights = np.asarray(images, dtype=np.float32), np.asarray(weights, dtype=np.float32)
    if images.ndim != 3 or weights.ndim != 3 or not len(images) == len(weights) == len(names):
        raise InputError(
            f"masks need k images, k weights and k names; given are shapes {images.shape}, {weights.shape} and "
            f"{len(names)} names"
        )
    titles = [f"{name}: {1 - weight.mean():.1%} excluded" for name, weight in zip(names, weights, strict=True)]
    return _shaded(images, 1 - weights, titles)


def share_figure(result: Result, frame: int, image: AnyArray | None = None) -> Figure:
    """Maps of each light's share in what determines the nodes of one frame; the rest as `displacement_figure`."""
    record = result.frame(frame)
    seen = record.light_share.sum(axis=1) > 0
    fields = {
        f"share of {light}": np.where(seen, share, np.nan)
        for light, share in zip(result.lights, record.light_share.T, strict=True)
    }
    return _maps(result, fields, "", "cividis", _frame_title(result, frame), image, limits=(0, 1))


def reflection_figure(result: Result, frame: int, images: AnyArray) -> Figure | None:
    """Each light's reflection index in one frame, shaded over its reference image (k, H, W); None where the separation
    did not tell it."""
    index = result.frame(frame).reflection_thumbnail / 255
    if not index.size:
        return None
    titles = [
        f"{light}: reflects on {(i > REFLECTING).mean():.1%}" for light, i in zip(result.lights, index, strict=True)
    ]
    title = f"reflection index, {_frame_title(result, frame)}"
    return _shaded(np.asarray(images, dtype=np.float32), index, titles, title)


def brightness_figure(result: Result) -> Figure:
    """Gain and offset of every light against the reference over the frames."""

    def draw(figure: Figure, axes: list[Axes]) -> None:
        for axis, values, label in zip(axes, result.brightness.T, ("gain", "offset (grey levels)"), strict=True):
            for light, series in zip(result.lights, values, strict=True):
                axis.plot(series, marker="o", markersize=2.5, linewidth=1, label=light, color=_LIGHT_COLOURS.get(light))
            _finish_plot(axis, "frame", label)
        top = np.nanmax(result.brightness[..., 0], initial=1.0)
        axes[0].set_ylim(0, 1.1 * float(top))
        axes[0].legend(loc="lower left")

    return _figure(draw, count=2, aspect=0.75, colour_bars=False)


def residual_figure(result: Result) -> Figure:
    """Weighted rms residual of every light, and its share in what determines the nodes, over the frames."""

    def draw(figure: Figure, axes: list[Axes]) -> None:
        labels = ("residual", "mean share in the nodes")
        for axis, values, label in zip(axes, (result.residual, result.mean_share), labels, strict=True):
            for light, series in zip(result.lights, values.T, strict=True):
                axis.plot(series, marker="o", markersize=2.5, linewidth=1, label=light, color=_LIGHT_COLOURS.get(light))
            axis.set_ylim(bottom=0)
            _finish_plot(axis, "frame", label)
        axes[1].legend(loc="lower left")

    return _figure(draw, count=2, aspect=0.75, colour_bars=False)


def convergence_figure(result: Result) -> Figure:
    """Largest motion of a node in each iteration, one line per frame, with the tolerance where it is known."""
    tolerance = result.provenance.get("settings", {}).get("solver", {}).get("tolerance")

    def draw(figure: Figure, axes: list[Axes]) -> None:
        axis = axes[0]
        colours = _colour_per_frame(figure, axis, len(result))
        for name, history, colour in zip(result.names, result.each("history"), colours, strict=True):
            iterations = np.arange(1, len(history) + 1)
            axis.plot(iterations, history, marker="o", markersize=2.5, linewidth=1, color=colour, label=name)
        if tolerance is not None:
            axis.axhline(tolerance, color="0.4", linewidth=0.8, linestyle="--", label="tolerance")
        axis.set_yscale("log")
        _finish_plot(axis, "iteration", "largest motion of a node (px)")
        if len(result) <= _MANY_FRAMES:
            figure.legend(loc="outside right upper")

    return _figure(draw, count=1, aspect=0.6, colour_bars=False)


def save_figure(figure: Figure, path: Path | str, *, dpi: int = 150) -> None:
    """Write a figure; the ending of the name states the format (png, pdf, svg).

    Raises
    ------
    ResultError
        The file cannot be written or the ending is unknown.
    """
    try:
        figure.savefig(path, dpi=dpi, bbox_inches="tight", pad_inches=0.08)
    except (OSError, ValueError) as error:
        raise ResultError(f"{path} cannot be written: {error}") from None


def _figure(
    draw: Callable[[Figure, list[Axes]], None], *, count: int, aspect: float, colour_bars: bool, title: str = ""
) -> Figure:
    """A figure of `count` panels whose height is `aspect` times their width: side by side, or stacked when flat."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    stacked = aspect < 0.5 and count > 1
    rows, columns = (count, 1) if stacked else (1, count)
    width = min(_WIDTH, max(6.0, 4.5 * columns)) / columns
    height = (width * (0.8 if colour_bars else 0.9) * aspect + 0.55) * rows + (0.3 if title else 0)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(width * columns, min(height, 9.5)), layout="compressed")
        axes = list(figure.subplots(rows, columns, squeeze=False).flat)
        draw(figure, axes)
        if title:
            figure.suptitle(title, fontsize=10)
    return figure


def _shaded(images: FloatImage, shade: AnyArray, titles: Sequence[str], title: str = "") -> Figure:
    """Images (k, H, W) side by side, each shaded by a reduced picture (k, h, w) from 0 to 1."""
    rows, columns = images.shape[1:]

    def draw(figure: Figure, axes: list[Axes]) -> None:
        for axis, image, over, name in zip(axes, images, shade, titles, strict=True):
            _show_image(axis, image)
            _shade(axis, over, (rows, columns))
            axis.set_title(name)
            _finish_picture(axis, (-0.5, columns - 0.5), (-0.5, rows - 0.5), first=axis is axes[0])

    return _figure(draw, count=len(images), aspect=rows / columns, colour_bars=False, title=title)


def _maps(
    result: Result,
    fields: dict[str, FloatArray],
    unit: str,
    colour_map: str,
    title: str,
    image: AnyArray | None,
    limits: tuple[float, float] | None = None,
) -> Figure:
    """One map per nodal field, over the image where there is one."""
    low, high = result.nodes.min(axis=0), result.nodes.max(axis=0)
    margin = 0.03 * float((high - low).max())
    x, y = (low[0] - margin, high[0] + margin), (low[1] - margin, high[1] + margin)
    if image is not None:
        x, y = (-0.5, image.shape[1] - 0.5), (-0.5, image.shape[0] - 0.5)

    def draw(figure: Figure, axes: list[Axes]) -> None:
        for axis, (name, values) in zip(axes, fields.items(), strict=True):
            if image is not None:
                _show_image(axis, image)
            _show_field(figure, axis, result, values, colour_map, limits, opaque=image is None)
            axis.set_title(f"{name} ({unit})" if unit else name)
            _finish_picture(axis, x, y, first=axis is axes[0])

    return _figure(draw, count=len(fields), aspect=(y[1] - y[0]) / (x[1] - x[0]), colour_bars=True, title=title)


def _show_field(
    figure: Figure,
    axis: Axes,
    result: Result,
    values: FloatArray,
    colour_map: str,
    limits: tuple[float, float] | None,
    *,
    opaque: bool,
) -> None:
    """A nodal field with its colour bar; blank where a node of the element is not measured."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    known = values[np.isfinite(values)]
    if not known.size:
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85}
        axis.text(0.5, 0.5, "nothing measured", transform=axis.transAxes, ha="center", va="center", bbox=box)
        return
    low, high = limits or _limits(known)
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[known.min() < low, known.max() > high]
    norm = Normalize(low, high)
    picture, extent = _raster(result, values)
    axis.imshow(
        picture, extent=extent, cmap=colour_map, norm=norm, alpha=1 if opaque else 0.75, interpolation="nearest"
    )
    bar = figure.colorbar(ScalarMappable(norm, colour_map), ax=axis, extend=extend, aspect=25, pad=0.03)
    bar.outline.set_linewidth(0.6)


def _limits(known: FloatArray) -> tuple[float, float]:
    """Ends of the colour bar: all values, but for a few wild ones that would hide the field."""
    core = np.percentile(known, [_CLIPPED, 100 - _CLIPPED])
    reach = _WILD * np.ptp(core)
    low, high = float(max(known.min(), core[0] - reach)), float(min(known.max(), core[1] + reach))
    return (low, high) if high > low else (low - 1e-9, low + 1e-9)


def _raster(
    result: Result, values: FloatArray
) -> tuple[np.ma.MaskedArray[Any, Any], tuple[float, float, float, float]]:
    """A nodal field on a fine grid, linear inside each element as in the solve, with its extent for `imshow`."""
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    blank = ~np.isfinite(values)[result.elements].all(axis=1)
    grid = Triangulation(result.nodes[:, 0], result.nodes[:, 1], triangles=result.elements, mask=blank)
    low, high = result.nodes.min(axis=0), result.nodes.max(axis=0)
    step = float((high - low).max()) / _RASTER
    x, y = (np.arange(start + step / 2, end, step) for start, end in zip(low, high, strict=True))
    picture = LinearTriInterpolator(grid, np.nan_to_num(values))(*np.meshgrid(x, y))
    return picture, (low[0], low[0] + step * len(x), low[1] + step * len(y), low[1])


def _show_image(axis: Axes, image: AnyArray) -> None:
    """An image in grey, with the extreme percent at either end clipped."""
    finite = image[np.isfinite(image)]
    low, high = np.percentile(finite, [1, 99]) if finite.size else (0, 1)
    axis.imshow(image, cmap="gray", vmin=low, vmax=max(high, low + 1e-6), interpolation="antialiased")


def _shade(axis: Axes, excluded: FloatImage, shape: tuple[int, int]) -> None:
    """Cover what is excluded, the more the less its weight."""
    from matplotlib.colors import to_rgb

    cover = np.empty((*excluded.shape, 4), dtype=np.float32)
    cover[..., :3] = to_rgb("#e8590c")
    cover[..., 3] = 0.65 * np.clip(excluded, 0, 1)
    axis.imshow(cover, extent=(-0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5), interpolation="nearest")


def _finish_picture(axis: Axes, x: tuple[float, float], y: tuple[float, float], *, first: bool) -> None:
    """Pixel axes, y down, one scale in both directions."""
    axis.set_aspect("equal")
    axis.set_xlim(*x)
    axis.set_ylim(y[1], y[0])
    axis.set_xlabel("x (px)")
    if first:
        axis.set_ylabel("y (px)")
    axis.locator_params(nbins=5)


def _finish_plot(axis: Axes, x: str, y: str) -> None:
    from matplotlib.ticker import MaxNLocator

    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.grid(linewidth=0.4, color="0.88")
    axis.spines[["top", "right"]].set_visible(False)


def _colour_per_frame(figure: Figure, axis: Axes, count: int) -> list[Any]:
    """A few frames get distinct colours and a legend, many a colour bar."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    if count <= _MANY_FRAMES:
        return [f"C{index}" for index in range(count)]
    colours = colormaps["viridis"]
    figure.colorbar(ScalarMappable(Normalize(0, count - 1), colours), ax=axis, label="frame", aspect=25)
    return [colours(index / (count - 1)) for index in range(count)]


def _frame_title(result: Result, frame: int) -> str:
    """Frame, file and how it ended, in words."""
    record = result.frame(frame)
    end = QUANTITIES["status"].codes[record.status]
    blank = np.isnan(record.u).mean()
    missing = f", {blank:.1%} of the nodes not measured" if blank else ""
    return f"frame {frame}: {result.names[frame]} ({end}, {record.iterations} iterations{missing})"
