"""Style of all figures: sizes, colours, axes, colour ranges and units of time; no display is needed."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rgbmidic.disk import write_complete
from rgbmidic.errors import InputError
from rgbmidic.text import format_times
from rgbmidic.typing import AnyArray, FloatArray, FloatImage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.figure import Figure

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titley": 1.0,  # else every drawing measures all numbers about the axes to place the title
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
}
LIGHT_COLOURS = {"red": "#c8102e", "green": "#1a7f37", "blue": "#1f5fbf"}
OKABE_ITO = {
    "orange": "#e69f00",
    "sky blue": "#56b4e9",
    "green": "#009e73",
    "purple": "#cc79a7",
    "vermillion": "#d55e00",
    "blue": "#0072b2",
    "yellow": "#f0e442",
    "grey": "#999999",
}
"""Colours that the colour-blind distinguish (Okabe and Ito, Color Universal Design, 2008)."""
STATUS_COLOURS = (OKABE_ITO["sky blue"], "#333333", OKABE_ITO["vermillion"], OKABE_ITO["yellow"])
"""Colours of the codes of `node_status` in their order, in every picture."""
CURVES = tuple(OKABE_ITO[name] for name in ("blue", "vermillion", "green", "purple", "orange", "sky blue", "grey"))
"""Colours of curves in turn; yellow is too pale for a line."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
"""Markers in turn, as many as `CURVES`."""
LINES = ("-", "--", "-.", ":")
"""Line styles in turn: readers who do not distinguish the colours distinguish the lines by these."""
_PNG = {"compress_level": 1}
"""Measured on maps: three quarters of the time of 3, a third of zlib's usual 6; the files are 12 % larger than of 3."""
DPI, PAGE_DPI = 150, 130
"""Pixels per inch of a file and of a picture in a page: one of 9 inches fills most screens, or the page's 64 rem."""
NUMBERS, BAR, GAP, LEGEND = 0.75, 0.95, 0.15, 2.2
"""Inches: room left of a panel for its numbers, right of it for a colour bar, for nothing or for names of lines; the
text's extent at 9 points."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FigureConstants:
    """Sizes of figures and what they leave out.

    Attributes
    ----------
    width, max_height
        Largest width and height of a figure in inches: with text of 9 points it stays legible on a page of A4.
    axis_room, title_room
        Inches: room for the numbers below a panel, and for its title; two lines and one line of 9 points.
    min_panel
        Inches of a panel that still shows something: 3 mm of a page, 20 px of a movie of 960.
    margin
        What is shown around the mesh, as a fraction of its longer side. Chosen: the edge of the mesh stays visible.
    clip_percent, outlier_margin
        Colours span all values but this percentage at each end, and what lies within this fraction of that span
        beyond. Chosen: a single outlier in a field of 200 nodes does not set the range.
    max_std_ratio
        Values whose uncertainty exceeds this multiple of the median do not set the colours: the usual three sigma.
    span
        Colours of a positive quantity end at its median over this and times this: else outliers turn the bulk black.
    max_name
        Letters of a name that are shown: a title has room for twice as many.
    """

    width: float = 9.0
    max_height: float = 9.5
    axis_room: float = 0.52
    title_room: float = 0.3
    min_panel: float = 0.2
    margin: float = 0.06
    clip_percent: float = 0.5
    outlier_margin: float = 0.1
    max_std_ratio: float = 3.0
    span: float = 4.0
    max_name: int = 60


FIGURES = FigureConstants()


def draw_figure(
    draw: Callable[[list[Axes]], None],
    *,
    count: int,
    aspect: float,
    right_room: float,
    title: str = "",
    max_height: float = FIGURES.max_height,
) -> Figure:
    """Draw a figure of panels, side by side, or one below the other when they are flat.

    Parameters
    ----------
    draw
        Draws into the axes of the panels.
    count
        Number of panels.
    aspect
        Height of a panel over its width.
    right_room
        Room right of each panel, in inches: `BAR`, `NUMBERS`, `GAP` or `LEGEND`.
    title
        Title of the figure.
    max_height
        Largest height of the figure in inches.

    Returns
    -------
    Figure
        The figure, which `save_figure` writes.

    Raises
    ------
    InputError
        There is no room for so many panels.
    """
    import matplotlib as mpl
    from matplotlib import rcsetup
    from matplotlib.figure import Figure

    # placed by numbers: matplotlib's layout engines draw every text several times to find the same
    columns = 1 if aspect < 0.5 and count > 1 else count
    rows = count // columns
    total, panel_margin = min(FIGURES.width, max(6.0, 4.5 * columns)), FIGURES.axis_room + FIGURES.title_room
    width = (total - NUMBERS) / columns - right_room
    max_panel_height = (max_height - 2 * GAP) / rows - panel_margin
    if min(width, max_panel_height) < FIGURES.min_panel:
        free_width = (FIGURES.width - NUMBERS) / (right_room + FIGURES.min_panel)
        max_panels = free_width if rows == 1 else (max_height - 2 * GAP) / (FIGURES.min_panel + panel_margin)
        raise InputError(
            f"one picture has room for {int(max_panels)} panels of this shape, not for {count}: show fewer"
        )
    height = min(width * aspect, max_panel_height)
    heading = 2 * GAP if title else 0.0
    total_height = rows * (height + panel_margin) + heading
    with mpl.rc_context({**STYLE, "axes.prop_cycle": rcsetup.cycler(color=CURVES)}):
        figure = Figure(figsize=(total, total_height))
        for panel_index in range(count):
            x = NUMBERS + panel_index % columns * (width + right_room)
            y = total_height - heading - (panel_index // columns + 1) * (height + panel_margin) + FIGURES.axis_room
            figure.add_axes((x / total, y / total_height, width / total, height / total_height))
        draw(figure.axes)
        if title:
            figure.suptitle(title, fontsize=10, y=1 - 0.5 * heading / total_height, va="center")
    return figure


def literal(text: str) -> str:
    """Return a name that matplotlib draws as it is: ``$`` starts no formula, ``_`` hides nothing from a legend.

    Characters that the font lacks, such as East Asian ones and line breaks, appear as their escapes; a name of more
    than 60 characters loses its middle.
    """
    from matplotlib.font_manager import findfont, get_font

    font = get_font(findfont("DejaVu Sans"))
    characters = [character if font.get_char_index(ord(character)) else ascii(character)[1:-1] for character in text]
    if len(characters) > FIGURES.max_name:
        characters = [*characters[: FIGURES.max_name // 2], "…", *characters[1 - FIGURES.max_name // 2 :]]
    escaped = "".join(characters).replace("$", r"\$")
    return f" {escaped}" if escaped.startswith("_") else escaped


def time_unit(seconds: FloatArray) -> tuple[float, str]:
    """Return how many of the unit that suits times (T,) a second has, and the unit: ``s``, ``ms``, ``µs`` or ``ns``."""
    reach = float(np.abs(seconds[np.isfinite(seconds)]).max(initial=0))
    units = ((1.0, "s"), (1e3, "ms"), (1e6, "µs"), (1e9, "ns"))
    return next((unit for unit in units if reach * unit[0] >= 1), units[0])


def time_text(seconds: float, scale: FloatArray) -> str:
    """Return a time with the unit that suits the times `scale` (T,) of which it is one."""
    factor, unit = time_unit(scale)
    return f"{format_times([*(factor * scale), factor * seconds], digits=6)[-1]} {unit}"


def time_axis(seconds: FloatArray | None, frames: AnyArray) -> tuple[FloatArray, str]:
    """Return the times (T,) in a unit that suits them, or the frames' numbers where seconds is None, and the label."""
    if seconds is None:
        return np.asarray(frames, dtype=np.float64), "frame"
    factor, unit = time_unit(seconds)
    return factor * seconds, f"time ({unit})"


def freeze_axes(figure: Figure, dpi: int) -> None:
    """Replace the axes of a figure and what they show by their picture: drawn again, they cost more than a map does.

    The figure must then be written with as many pixels per inch; what is drawn into the axes later lies above.
    """
    from matplotlib.artist import Artist
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    class Picture(Artist):
        """The pixels as they are: matplotlib's figimage resamples them."""

        def draw(self, renderer: Any) -> None:
            renderer.draw_image(renderer.new_gc(), 0, 0, pixels)

    figure.set_dpi(dpi)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.array(canvas.buffer_rgba())[::-1]
    for axis in figure.axes:
        axis.set_axis_off()
        for image in axis.images:
            image.remove()
    figure.add_artist(Picture()).set_zorder(-1)


def save_figure(figure: Figure, path: Path | str, *, dpi: int = DPI) -> None:
    """Write a figure to a file.

    Parameters
    ----------
    figure
        The figure.
    path
        File to write; the ending of its name states the format (png, pdf, svg).
    dpi
        Pixels per inch.

    Raises
    ------
    InputError
        There is no such format.
    ResultError
        The file cannot be written.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> figure = Figure()
    >>> save_figure(figure, "empty.png", dpi=10)
    >>> Path("empty.png").unlink()
    """
    path = Path(path)
    extension, formats = path.suffix[1:], figure.canvas.get_supported_filetypes()
    if extension not in formats:
        raise InputError(f"{path} cannot be written: a figure is one of .{', .'.join(formats)}")
    options: dict[str, Any] = {"pil_kwargs": _PNG} if extension == "png" else {}
    write_complete(path, lambda file: figure.savefig(file, format=extension, dpi=dpi, **options))


def data_url(figure: Figure, *, dpi: int = PAGE_DPI) -> str:
    """Return a figure as a data URL (PNG), for pages without files beside them."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi, pil_kwargs=_PNG)
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"


def colour_range(values: FloatArray) -> tuple[float, float]:
    """Return the ends of the colour bar for finite values (N,): all of them but a few outliers.

    The range spans the 0.5 % to 99.5 % quantiles, and what lies within 10 % of that span beyond.
    """
    core = np.percentile(values, [FIGURES.clip_percent, 100 - FIGURES.clip_percent])
    reach = FIGURES.outlier_margin * np.ptp(core)
    low, high = float(max(values.min(), core[0] - reach)), float(min(values.max(), core[1] + reach))
    return (low, high) if high > low else (low - 1e-9, low + 1e-9)


def ordinary_values(values: FloatArray, std: FloatArray) -> FloatArray:
    """Select from values (N,) with uncertainties (N,) the finite ones that set the colour range.

    Values whose uncertainty exceeds three times the median are left out, unless none would be left.
    """
    finite = np.isfinite(values)
    has_std = finite & np.isfinite(std)
    if not has_std.any():
        return values[finite]
    selected = finite & ~(std > FIGURES.max_std_ratio * np.median(std[has_std]))
    return values[selected if selected.any() else finite]


def view_limits(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and the highest (x, y) of a view of points (N, 2) with a margin."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = FIGURES.margin * float((high - low).max())
    return low - margin, high + margin


def colour_scale(values: FloatArray, *, positive: bool = False) -> Normalize:
    """Return colours over `colour_range`; for a positive quantity logarithmic, around its median."""
    from matplotlib.colors import LogNorm, Normalize

    if not positive:
        return Normalize(*colour_range(values))
    logarithms = np.log(np.maximum(values, np.finfo(float).tiny))
    middle, reach = np.median(logarithms), np.log(FIGURES.span)
    return LogNorm(*np.exp(np.clip(colour_range(logarithms), middle - reach, middle + reach)))


def show_image(axis: Axes, image: AnyArray, origin: tuple[int, int] = (0, 0)) -> None:
    """Show an image (H, W) in grey, reduced to what a page shows, with the extreme percent at either end clipped.

    Its first pixel is at column and row `origin`.
    """
    import cv2

    max_pixels = axis.get_position().width * cast("Figure", axis.figure).get_figwidth() * DPI
    scale = min(max_pixels / max(image.shape), 1.0)
    reduced = cv2.resize(np.asarray(image, dtype=np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    finite = reduced[np.isfinite(reduced)]
    low, high = np.percentile(finite, [1, 99]) if finite.size else (0, 1)
    extent = _extent(origin, image.shape[1], image.shape[0])
    axis.imshow(reduced, cmap="gray", vmin=low, vmax=max(high, low + 1e-6), extent=extent, interpolation="nearest")


def _extent(origin: tuple[int, int], columns: int, rows: int) -> tuple[float, float, float, float]:
    x_min, y_min = origin[0] - 0.5, origin[1] - 0.5
    return x_min, x_min + columns, y_min + rows, y_min


def add_colour_bar(
    axis: Axes,
    norm: Normalize,
    colour_map: str | Colormap,
    *,
    label: str = "",
    values: FloatArray | None = None,
    names: tuple[str, ...] = (),
) -> None:
    """Add a colour bar beside a panel of `draw_figure`, pointed where values `values` are below or above its colours.

    Where the values are codes, `names` stand in place of the numbers from 0 on.

    It is made of a few artists of the panel: matplotlib's own is a second set of axes, at three times the time.
    """
    from matplotlib.image import BboxImage
    from matplotlib.patches import Polygon
    from matplotlib.ticker import MaxNLocator
    from matplotlib.transforms import Bbox, TransformedBbox

    width = axis.get_position().width * cast("Figure", axis.figure).get_figwidth()
    bar_left, bar_middle, bar_right = (1 + inches / width for inches in (0.08, 0.14, 0.20))
    limits = np.asarray([norm.vmin, norm.vmax], dtype=np.float64)
    normalised = norm(limits if values is None or not values.size else values)
    pointed = normalised.min() < -1e-9, normalised.max() > 1 + 1e-9  # by more than rounding
    low, high = (0.045 * end for end in pointed)  # of the height are points, as matplotlib's
    outline = [
        (bar_left, low),
        (bar_middle, 0),
        (bar_right, low),
        (bar_right, 1 - high),
        (bar_middle, 1),
        (bar_left, 1 - high),
    ]
    bar = Polygon(outline, transform=axis.transAxes, fill=False, linewidth=0.6, clip_on=False)
    axis.add_patch(bar)
    bar_box = TransformedBbox(Bbox([[bar_left, 0], [bar_right, 1]]), axis.transAxes)
    colours = BboxImage(bar_box, cmap=colour_map, origin="lower", interpolation="nearest")
    colours.set_data((np.linspace(-low, 1 - low, 256) / (1 - low - high)).clip(0, 1)[:, None])
    colours.set_clip_path(bar)
    axis.add_artist(colours)
    numbers = np.arange(len(names)) if names else MaxNLocator(6).tick_values(*limits)
    numbers = numbers[(numbers >= limits[0]) & (numbers <= limits[1])]
    heights = low + (1 - low - high) * np.asarray(norm(numbers))
    largest = float(np.abs(numbers).max(initial=0))
    power = 3 * math.floor(math.log10(largest) / 3) if largest and not 0.01 <= largest < 1e5 and not names else 0
    if power:  # one for all numbers, as along an axis
        axis.text(bar_right, 1.03, rf"$\times 10^{{{power}}}$", transform=axis.transAxes, ha="right")
    end = bar_right + 3.5 / 72 / width  # matplotlib's length of a tick
    ticks = np.tile([bar_right, end, np.nan], len(numbers)), np.repeat(heights, 3)
    axis.plot(*ticks, "k", linewidth=0.6, transform=axis.transAxes, clip_on=False)
    for number, height in zip(numbers, heights, strict=True):
        text = names[int(number)] if names else f"{number / 10.0**power:.4g}"
        look: dict[str, Any] = {"va": "center_baseline", "fontsize": 6.5 if names else None}
        axis.text(2 * end - bar_right, height, text, transform=axis.transAxes, **look)
    if label:
        axis.text(bar_right + 0.55 / width, 0.5, label, transform=axis.transAxes, rotation=90, va="center")


def shade(
    axis: Axes, cover: FloatImage, step: int = 1, origin: tuple[int, int] = (0, 0), colour: str | None = None
) -> None:
    """Cover an image that begins at `origin` by a picture from 0 (clear) to 1, in the colour of a light or orange.

    One pixel of the picture covers `step` pixels of the image.
    """
    from matplotlib.colors import to_rgb

    colours = np.empty((*cover.shape, 4), dtype=np.float32)
    colours[..., :3] = to_rgb(colour or "#e8590c")
    colours[..., 3] = 0.65 * np.clip(cover, 0, 1)
    rows, columns = (step * size for size in cover.shape)
    axis.imshow(colours, extent=_extent(origin, columns, rows), interpolation="nearest")


def finish_picture(
    axis: Axes,
    x: tuple[float, float],
    y: tuple[float, float],
    *,
    has_y_label: bool,
    unit: str = "px",
    factor: float = 1.0,
) -> None:
    """Set the limits of axes at one scale in both directions, y down where y[0] < y[1].

    The numbers along the axes are in a `unit` of which what is drawn, such as px, has `factor`.
    """
    from matplotlib.ticker import FixedLocator

    axis.set_aspect("equal")
    axis.set_xlim(*x)
    axis.set_ylim(y[1], y[0])
    axis.set_xlabel(f"x ({unit})")
    if has_y_label:
        axis.set_ylabel(f"y ({unit})")
    axis.tick_params(labelleft=has_y_label)
    axis.yaxis.set_major_locator(FixedLocator(_round_numbers(5, y, factor)))
    for coordinate_axis in (axis.xaxis, axis.yaxis) if factor != 1 else ():
        coordinate_axis.set_major_formatter(lambda value, _: f"{factor * value:.6g}")
    _space_out(axis, 5, integer_ticks=False, factor=factor)


def finish_plot(axis: Axes, x: str, y: str, *, integer_ticks: bool = True) -> None:
    """Label the axes of a plot, set as many numbers along x as there is room for, and a light grid.

    Parameters
    ----------
    axis
        Axes of the plot, with its data drawn.
    x, y
        Labels.
    integer_ticks
        Whether the numbers along x are whole.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> figure = Figure()
    >>> axis = figure.subplots()
    >>> _ = axis.plot([0, 1, 2], [0.0, 0.1, 0.3])
    >>> finish_plot(axis, "frame", "u in px")
    >>> axis.get_ylabel()
    'u in px'
    """
    from matplotlib.ticker import ScalarFormatter

    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.ticklabel_format(axis="x", style="plain", useOffset=False)
    if isinstance(axis.yaxis.get_major_formatter(), ScalarFormatter):
        axis.ticklabel_format(axis="y", scilimits=(-2, 3))  # long numbers would reach into the axis' name
    _space_out(axis, 8, integer_ticks=integer_ticks)
    axis.grid(linewidth=0.4, color="0.88")
    axis.spines[["top", "right"]].set_visible(False)


def _space_out(axis: Axes, max_ticks: int, *, integer_ticks: bool, factor: float = 1.0) -> None:
    """Set as many round numbers along x, of what is `factor` times the axis' own, as there is room for."""
    from matplotlib.ticker import FixedLocator

    box, (width, height) = axis.get_position(), cast("Figure", axis.figure).get_size_inches()
    room = box.width * width
    if axis.get_aspect() != "auto":
        room = min(room, box.height * height * abs(np.ptp(axis.get_xlim()) / np.ptp(axis.get_ylim())))
    for count in range(max_ticks, 0, -1):
        ticks = _round_numbers(count, axis.get_xlim(), factor, integer_ticks=integer_ticks)
        axis.xaxis.set_major_locator(FixedLocator(ticks))
        numbers = axis.xaxis.get_major_formatter().format_ticks(ticks)
        if sum(0.075 * len(number) + 0.12 for number in numbers) < room:  # inches of a digit, and between two numbers
            break


def _round_numbers(
    max_ticks: int, limits: tuple[float, float], factor: float, *, integer_ticks: bool = False
) -> list[float]:
    """Return at most so many round numbers from end to end, of what is `factor` times the axis' own."""
    from matplotlib.ticker import MaxNLocator

    low, high = sorted(factor * limit for limit in limits)
    return [float(number) / factor for number in MaxNLocator(max_ticks, integer=integer_ticks).tick_values(low, high)]
