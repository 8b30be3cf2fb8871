"""What all figures share: size, colours, axes, colour ranges. No display is needed."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rgbmidic.results.files import writing
from rgbmidic.typing import AnyArray, FloatArray, FloatImage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colorbar import Colorbar
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

__all__ = [
    "BAR",
    "GAP",
    "LIGHT_COLOURS",
    "LINES",
    "NUMBERS",
    "STYLE",
    "add_colour_bar",
    "colour_range",
    "colour_scale",
    "draw_figure",
    "embedded",
    "finish_picture",
    "finish_plot",
    "literal",
    "save_figure",
    "shade",
    "show_image",
    "time_unit",
]

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titley": 1.0,  # else every drawing measures all numbers about the axes to place the title
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "legend.frameon": False,
}
LIGHT_COLOURS = {"red": "#c8102e", "green": "#1a7f37", "blue": "#1f5fbf"}
LINES = ("-", "--", "-.", ":")
"""Line styles in turn: who does not tell colours apart tells the lines apart by these."""
_PNG = {"compress_level": 3}
"""In half the time of the usual 6 the same sizes of files, within 2 %."""
_WIDTH, _TALLEST = 9.0, 9.5
"""Largest width and height of a figure in inches."""
NUMBERS, BAR, GAP, LEGEND = 0.65, 0.95, 0.15, 2.2
"""Inches: room left of a panel for its numbers, right of it for a colour bar, for nothing or for names of lines."""
_BELOW, _ABOVE = 0.52, 0.3
"""Inches: room for the numbers below a panel, and for its title."""
_CLIPPED, _WILD = 0.5, 0.1
"""Colours span all values but this percentage at each end, and what lies within this share of that span beyond."""
_SHOWN = 800
"""Most pixels along a side of an image in a figure."""
_LETTER, _BETWEEN = 0.075, 0.12
"""Inches: width of a digit of the numbers along an axis, at the style's size of letters; room between two numbers."""
_LONGEST = 60
"""Letters of a name that are shown: a title has room for twice as many."""
_SPAN = 4.0
"""Colours of a positive quantity end at its median over this and times this: else outliers turn the bulk black."""


def draw_figure(
    draw: Callable[[list[Axes]], None],
    *,
    count: int,
    aspect: float,
    beside: float,
    title: str = "",
    tallest: float = _TALLEST,
) -> Figure:
    """A figure of `count` panels whose height is `aspect` times their width: side by side, or stacked when flat.

    `beside` is the room right of each panel, in inches: `BAR`, `NUMBERS`, `GAP` or `LEGEND`.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    # placed by numbers: matplotlib's layout engines draw every text several times to find the same
    columns = 1 if aspect < 0.5 and count > 1 else count
    rows = count // columns
    total = min(_WIDTH, max(6.0, 4.5 * columns))
    width = (total - NUMBERS) / columns - beside
    height = min(width * aspect, (tallest - 2 * GAP) / rows - _BELOW - _ABOVE)
    heading = 2 * GAP if title else 0.0
    whole = rows * (height + _BELOW + _ABOVE) + heading
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(total, whole))
        boxes = [
            (NUMBERS + column * (width + beside), whole - heading - (row + 1) * (height + _ABOVE) - row * _BELOW)
            for row in range(rows)
            for column in range(columns)
        ]
        axes = [figure.add_axes((x / total, y / whole, width / total, height / whole)) for x, y in boxes]
        draw(axes)
        if title:
            figure.suptitle(title, fontsize=10, y=1 - 0.5 * heading / whole, va="center")
    return figure


def literal(text: str) -> str:
    """A name as matplotlib draws it as it is: ``$`` is no formula, a leading ``_`` hides nothing from a legend.

    Letters that its font has not, East Asian ones and line breaks, appear as their escapes; a long name without its
    middle.
    """
    from matplotlib.font_manager import findfont, get_font

    font = get_font(findfont("DejaVu Sans"))
    seen = [c if font.get_char_index(ord(c)) else ascii(c)[1:-1] for c in text]
    if len(seen) > _LONGEST:
        seen = [*seen[: _LONGEST // 2], "…", *seen[1 - _LONGEST // 2 :]]
    shown = "".join(seen).replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown


def time_unit(seconds: FloatArray) -> tuple[float, str]:
    """The unit that suits times, ``"s"``, ``"ms"``, ``"µs"`` or ``"ns"``, and how many of it a second has."""
    reach = float(np.abs(seconds[np.isfinite(seconds)]).max(initial=0))
    units = ((1.0, "s"), (1e3, "ms"), (1e6, "µs"), (1e9, "ns"))
    return next((pair for pair in units if reach * pair[0] >= 1), units[0])


def save_figure(figure: Figure, path: Path | str, *, dpi: int = 150) -> None:
    """Write a figure; the ending of the name states the format (png, pdf, svg).

    Raises
    ------
    ResultError
        The file cannot be written.
    """
    with writing(path):
        options: dict[str, Any] = {"pil_kwargs": _PNG} if Path(path).suffix == ".png" else {}
        figure.savefig(path, dpi=dpi, **options)


def embedded(figure: Figure, *, dpi: int = 130) -> str:
    """A figure as an address that holds the picture itself, for pages without files beside them."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi, pil_kwargs=_PNG)
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"


def colour_range(known: FloatArray) -> tuple[float, float]:
    """Ends of the colour bar: all values, but for a few wild ones that would hide the field."""
    core = np.percentile(known, [_CLIPPED, 100 - _CLIPPED])
    reach = _WILD * np.ptp(core)
    low, high = float(max(known.min(), core[0] - reach)), float(min(known.max(), core[1] + reach))
    return (low, high) if high > low else (low - 1e-9, low + 1e-9)


def colour_scale(known: FloatArray, *, positive: bool = False) -> Normalize:
    """Colours over `colour_range`; for a positive quantity logarithmic, around its median."""
    from matplotlib.colors import LogNorm, Normalize

    if not positive:
        return Normalize(*colour_range(known))
    logarithms = np.log(np.maximum(known, np.finfo(float).tiny))
    middle, reach = np.median(logarithms), np.log(_SPAN)
    return LogNorm(*np.exp(np.clip(colour_range(logarithms), middle - reach, middle + reach)))


def show_image(axis: Axes, image: AnyArray, origin: tuple[int, int] = (0, 0)) -> None:
    """An image in grey, reduced to what a page shows, with the extreme percent at either end clipped; its first pixel
    is at column and row `origin`."""
    step = -(-max(image.shape) // _SHOWN)
    rows, columns = (size // step for size in image.shape)
    reduced = image[: rows * step, : columns * step].reshape(rows, step, columns, step).mean(axis=(1, 3))
    finite = reduced[np.isfinite(reduced)]
    low, high = np.percentile(finite, [1, 99]) if finite.size else (0, 1)
    extent = _extent(origin, columns * step, rows * step)
    axis.imshow(reduced, cmap="gray", vmin=low, vmax=max(high, low + 1e-6), extent=extent, interpolation="antialiased")


def _extent(origin: tuple[int, int], columns: int, rows: int) -> tuple[float, float, float, float]:
    left, top = origin[0] - 0.5, origin[1] - 0.5
    return left, left + columns, top + rows, top


def add_colour_bar(axis: Axes, shown: ScalarMappable, **options: Any) -> Colorbar:
    """A colour bar beside a panel of `draw_figure`, as high as the panel's picture."""
    figure = cast("Figure", axis.figure)
    width = axis.get_position().width * figure.get_figwidth()
    bar = figure.colorbar(shown, cax=axis.inset_axes((1 + 0.08 / width, 0, 0.12 / width, 1)), **options)
    bar.outline.set_linewidth(0.6)
    return bar


def shade(axis: Axes, cover: FloatImage, step: int = 1, origin: tuple[int, int] = (0, 0)) -> None:
    """Cover an image that begins at `origin` by a picture from 0 (clear) to 1, of which one pixel is `step` pixels of
    the image."""
    from matplotlib.colors import to_rgb

    colours = np.empty((*cover.shape, 4), dtype=np.float32)
    colours[..., :3] = to_rgb("#e8590c")
    colours[..., 3] = 0.65 * np.clip(cover, 0, 1)
    rows, columns = (step * size for size in cover.shape)
    axis.imshow(colours, extent=_extent(origin, columns, rows), interpolation="nearest")


def finish_picture(axis: Axes, x: tuple[float, float], y: tuple[float, float], *, first: bool) -> None:
    """Pixel axes, y down, one scale in both directions."""
    axis.set_aspect("equal")
    axis.set_xlim(*x)
    axis.set_ylim(y[1], y[0])
    axis.set_xlabel("x (px)")
    if first:
        axis.set_ylabel("y (px)")
    axis.tick_params(labelleft=first)
    axis.locator_params(nbins=5)
    _space_out(axis, 5, whole=False)


def finish_plot(axis: Axes, x: str, y: str, *, whole: bool = True) -> None:
    """Named axes, `whole` numbers along x, no more of them than there is room for, a light grid."""
    from matplotlib.ticker import ScalarFormatter

    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.ticklabel_format(axis="x", style="plain", useOffset=False)
    if isinstance(axis.yaxis.get_major_formatter(), ScalarFormatter):
        axis.ticklabel_format(axis="y", scilimits=(-2, 3))  # long numbers would reach into the axis' name
    _space_out(axis, 8, whole=whole)
    axis.grid(linewidth=0.4, color="0.88")
    axis.spines[["top", "right"]].set_visible(False)


def _space_out(axis: Axes, most: int, *, whole: bool) -> None:
    """Set as many numbers along x as there is room for, at most `most`."""
    from matplotlib.ticker import MaxNLocator

    box, (width, height) = axis.get_position(), cast("Figure", axis.figure).get_size_inches()
    room = box.width * width
    if axis.get_aspect() != "auto":
        room = min(room, box.height * height * abs(np.ptp(axis.get_xlim()) / np.ptp(axis.get_ylim())))
    for count in range(most, 0, -1):
        axis.xaxis.set_major_locator(MaxNLocator(count, integer=whole))
        numbers = axis.xaxis.get_major_formatter().format_ticks(list(axis.xaxis.get_majorticklocs()))
        if sum(len(number) * _LETTER + _BETWEEN for number in numbers) < room:
            break
