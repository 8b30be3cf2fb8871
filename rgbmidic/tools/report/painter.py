"""A field painted over an image: part of the image that a screen shows, colours, pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from rgbmidic.results import Maps, Result, ResultQuantity
from rgbmidic.tools.report.kernels import paint_field
from rgbmidic.tools.report.style import STATUS_COLOURS
from rgbmidic.typing import AnyArray, FloatArray

Picture = npt.NDArray[np.uint8]
"""A grey picture (H, W)."""
Pixels = npt.NDArray[np.uint32]
"""Red, green, blue and an opacity of 255, the lowest byte first."""

OUTSIDE_GREY = {False: 235, True: 30}
"""Grey level outside the image, by whether the page is dark."""
_HATCH_COLOURS, _HATCH_SPACING = ("#010203", "#ffffff"), 8
"""Colours of what lies below and above 0, of which the first is no grey, and pixels from one hatch to the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageWindow:
    """The part of the image that the screen shows.

    Attributes
    ----------
    x_min, y_min, x_max, y_max
        Edges in px of the image, where the centre of the first pixel is (0, 0).
    width, height
        Pixels of the screen.
    """

    x_min: float
    y_min: float
    x_max: float
    y_max: float
    width: int
    height: int

    @property
    def edges(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom."""
        return self.x_min, self.y_min, self.x_max, self.y_max

    def fit_aspect(self) -> ImageWindow:
        """Widen the window to as many screen pixels per px in both directions, about the same centre."""
        step = max(self.steps)
        x, y = (self.x_min + self.x_max) / 2, (self.y_min + self.y_max) / 2
        half_x, half_y = step * self.width / 2, step * self.height / 2
        return replace(self, x_min=x - half_x, y_min=y - half_y, x_max=x + half_x, y_max=y + half_y)

    def limited(self, max_pixels: int) -> ImageWindow:
        """Return the same part of the image on at most so many pixels."""
        shrink = max(1.0, (self.width * self.height / max_pixels) ** 0.5)
        return replace(self, width=max(int(self.width / shrink), 2), height=max(int(self.height / shrink), 2))

    @property
    def steps(self) -> tuple[float, float]:
        """Px of the image to a pixel of the screen, along x and y."""
        return (self.x_max - self.x_min) / self.width, (self.y_max - self.y_min) / self.height

    def to_picture(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return column and row of points (N, 2) on the screen."""
        x_step, y_step = self.steps
        return (points[:, 0] - self.x_min) / x_step - 0.5, (points[:, 1] - self.y_min) / y_step - 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlay:
    """A nodal field as it is painted over an image.

    Attributes
    ----------
    nodes : ndarray, shape (N, 2)
        Places of the nodes in px.
    elements : ndarray, shape (E, 3)
        Nodes of the triangles.
    values : ndarray, shape (N,)
        Values at the nodes; triangles with a NaN are not painted.
    colour_range
        Values of the first and the last colour.
    colours
        As ``"#rrggbb"``.
    opacity
        Opacity of the field, from 0 to 1.
    stepped
        Whether values between those of two nodes mean nothing.
    hatch_margin : ndarray, shape (N,), or None
        What is hatched where it is below 0; None: nothing.
    """

    nodes: FloatArray
    elements: npt.NDArray[np.int32]
    values: FloatArray
    colour_range: tuple[float, float]
    colours: tuple[str, ...]
    opacity: float = 1.0
    stepped: bool = False
    hatch_margin: FloatArray | None = None

    @classmethod
    def of_field(cls, maps: Maps, field: ResultQuantity, nodes: FloatArray, values: FloatArray, **look: Any) -> Self:
        """Return a field with values (N,) at nodes (N, 2), in the triangles of `Maps.triangulate`, and its look."""
        vertices, elements = maps.triangulate(field, np.column_stack([nodes, values]))
        positions, corner_values = vertices[:, :2], np.ascontiguousarray(vertices[:, 2])
        return cls(nodes=positions, elements=elements, values=corner_values, stepped=field.stepped, **look)


def paint(window: ImageWindow, picture: AnyArray, overlay: Overlay | None = None, outside_grey: int = 40) -> Pixels:
    """Paint a grey picture, and a field over it, as the window shows them.

    Parameters
    ----------
    window
        Part of the image and size of the screen.
    picture : ndarray, shape (H, W), uint8
        The image.
    overlay
        The field; None: the picture alone.
    outside_grey
        Grey level outside the image.

    Returns
    -------
    ndarray, shape (rows, columns), uint32
        Red, green, blue, 255, the lowest byte first; the first row is the top.
    """
    steps, size = window.steps, (window.height, window.width)
    origin = (window.x_min + steps[0] / 2, window.y_min + steps[1] / 2)
    grey = _resample(picture, steps, origin, size, outside_grey)
    if overlay is None:
        return grey * np.uint32(0x010101) | np.uint32(0xFF000000)
    x, y = window.to_picture(overlay.nodes)

    def painted(values: FloatArray, limits: tuple[float, float], colours: tuple[str, ...], opacity: float) -> Pixels:
        out, grey_part = np.empty(size, dtype=np.uint32), round(256 * (1 - opacity))
        ends, is_stepped = map(float, limits), overlay.stepped and values is overlay.values
        paint_field(out, grey, x, y, overlay.elements, values, *ends, pack(colours, grey_part), grey_part, is_stepped)
        return out

    out = painted(overlay.values, overlay.colour_range, overlay.colours, overlay.opacity)
    if overlay.hatch_margin is not None:
        reach = float(np.nanmax(np.abs(overlay.hatch_margin), initial=0)) or 1.0
        is_hatched = painted(overlay.hatch_margin, (-reach, reach), _HATCH_COLOURS, 1.0) == pack(_HATCH_COLOURS, 0)[0]
        out[is_hatched & (sum(np.indices(size)) % _HATCH_SPACING < 2)] = 0xFF000000
    return out


@cache
def pack(colours: tuple[str, ...], grey_part: int) -> Pixels:
    """Return colours as `paint_field` takes them, where a grey picture counts so many 256ths."""
    rgb = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in colours], dtype=np.uint32)
    red, green, blue = (rgb * (256 - grey_part) >> 8).T
    return np.asarray(red | green << 8 | blue << 16 | 0xFF000000, dtype=np.uint32)


@cache
def palette(name: str, levels: int = 256) -> tuple[str, ...]:
    """Return so many colours of a palette, up to 256 as a screen has levels, as ``"#rrggbb"``."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    positions = np.linspace(0, 1, min(max(levels, 2), 256))
    return STATUS_COLOURS if name == "codes" else tuple(map(to_hex, colormaps[name](positions)))


def reference_picture(result: Result, background: int = 60) -> Picture:
    """Return the mean of the lights' reference images that a result keeps; `background` is grey where none was kept."""
    images, (column, row) = result.reference, result.reference_origin
    columns, rows = np.ceil(result.nodes.max(axis=0) + 1).astype(int)
    picture = np.full(result.frame_shape or (rows, columns), background, dtype=np.uint8)
    if images is not None:
        picture[row : row + images.shape[1], column : column + images.shape[2]] = images.mean(axis=0)
    return picture


def _resample(
    image: AnyArray, step: tuple[float, float], start: tuple[float, float], size: tuple[int, int], background: int
) -> Picture:
    """Resample an image on `size` (rows, columns) pixels, `step` (x, y) px apart from the place `start` (x, y) on.

    It is reduced by a whole factor first, against moiré; pixels that are enlarged keep their edges. Beyond the image
    lies the grey level `background`.
    """
    import cv2

    factor = max(1, int(min(step)))
    small: AnyArray = np.asarray(image, dtype=np.uint8)
    if factor > 1:
        height, width = (length // factor * factor for length in small.shape)
        reduced = (width // factor, height // factor)
        small = cv2.resize(small[:height, :width], reduced, interpolation=cv2.INTER_AREA)
    shift, (x_step, y_step), (x, y) = (factor - 1) / 2, step, start
    to_image = np.array([[x_step, 0, x - shift], [0, y_step, y - shift]], dtype=np.float64) / factor
    flags = (cv2.INTER_NEAREST if min(step) <= 0.5 else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(small, to_image, size[::-1], flags=flags, borderValue=float(background)), np.uint8)
