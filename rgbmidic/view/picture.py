"""Picture of a field on the screen: window of the image, resampling, colours and their range, elements, images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.picture import paint_field
from rgbmidic.errors import FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.series import FrameSeries, open_series
from rgbmidic.report.style import STATUS_COLOURS, colour_range, ordinary_values, resampled
from rgbmidic.results import MapValues, Profile, Result
from rgbmidic.settings import TestSettings
from rgbmidic.typing import AnyArray, FloatArray
from rgbmidic.view.constants import VIEWER

Picture = npt.NDArray[np.uint8]
"""A grey picture (H, W)."""

AROUND = {False: 235, True: 30}
"""Grey level outside the image, by whether the page is dark."""
_SIDES, _APART = ("#010203", "#ffffff"), 8
"""Colours of what lies below and above 0, of which the first is no grey, and pixels from one hatch to the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """The part of the image that the screen shows.

    Attributes
    ----------
    left, top, right, bottom
        Edges in px of the image, where the centre of the first pixel is (0, 0).
    width, height
        Pixels of the screen.
    """

    left: float
    top: float
    right: float
    bottom: float
    width: int
    height: int

    @property
    def edges(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom."""
        return self.left, self.top, self.right, self.bottom

    def fitted(self) -> Window:
        """Widen the window to as many screen pixels per px in both directions, about the same centre."""
        step = max((self.right - self.left) / self.width, (self.bottom - self.top) / self.height)
        x, y = (self.left + self.right) / 2, (self.top + self.bottom) / 2
        half_x, half_y = step * self.width / 2, step * self.height / 2
        return replace(self, left=x - half_x, top=y - half_y, right=x + half_x, bottom=y + half_y)

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the picture."""
        shrink = max(1.0, (self.width * self.height / VIEWER.picture_pixels) ** 0.5)
        return max(int(self.height / shrink), 2), max(int(self.width / shrink), 2)

    @property
    def steps(self) -> tuple[float, float]:
        """Px of the image to a pixel of the picture, along x and y."""
        rows, columns = self.size
        return (self.right - self.left) / columns, (self.bottom - self.top) / rows

    def place(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return column and row of points (N, 2) in the picture."""
        across, down = self.steps
        return (points[:, 0] - self.left) / across - 0.5, (points[:, 1] - self.top) / down - 0.5


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
    ends
        Values of the first and the last colour.
    colours
        As ``"#rrggbb"``.
    opacity
        Opacity of the field, from 0 to 1.
    stepped
        Whether values between those of two nodes mean nothing.
    beyond : ndarray, shape (N,), or None
        What is hatched where it is below 0; None: nothing.
    """

    nodes: FloatArray
    elements: npt.NDArray[np.int32]
    values: FloatArray
    ends: tuple[float, float]
    colours: tuple[str, ...]
    opacity: float = 1.0
    stepped: bool = False
    beyond: FloatArray | None = None


def paint(window: Window, picture: AnyArray, over: Overlay | None = None, around: int = 40) -> npt.NDArray[np.uint32]:
    """Paint a grey picture, and a field over it, as the window shows them.

    Parameters
    ----------
    window
        Part of the image and size of the screen.
    picture : ndarray, shape (H, W), uint8
        The image.
    over
        The field; None: the picture alone.
    around
        Grey level outside the image.

    Returns
    -------
    ndarray, shape (rows, columns), uint32
        Red, green, blue, 255, the lowest byte first; the first row is the top.
    """
    first = (window.left + window.steps[0] / 2, window.top + window.steps[1] / 2)
    grey = resampled(picture, window.steps, first, window.size, around, nearest=min(window.steps) <= 0.5)
    if over is None:
        return grey * np.uint32(0x010101) | np.uint32(0xFF000000)
    out = np.empty(grey.shape, dtype=np.uint32)
    (x, y), grey_part = window.place(over.nodes), round(256 * (1 - over.opacity))
    packed = _packed(over.colours, grey_part)
    paint_field(out, grey, x, y, over.elements, over.values, *map(float, over.ends), packed, grey_part, over.stepped)
    if over.beyond is not None:
        below, lines = np.empty_like(out), sum(np.indices(out.shape)) % _APART < 2
        reach = float(np.nanmax(np.abs(over.beyond), initial=0)) or 1.0
        paint_field(below, grey, x, y, over.elements, over.beyond, -reach, reach, _packed(_SIDES, 0), 0, False)
        out[lines & (below == _packed(_SIDES, 0)[0])] = 0xFF000000
    return out


@cache
def _packed(colours: tuple[str, ...], grey_part: int) -> npt.NDArray[np.uint32]:
    rgb = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in colours], dtype=np.uint32)
    red, green, blue = (rgb * (256 - grey_part) >> 8).T
    return np.asarray(red | green << 8 | blue << 16 | 0xFF000000, dtype=np.uint32)


@cache
def palette(name: str, levels: int = 256) -> tuple[str, ...]:
    """Return so many colours of a palette, up to 256 as a screen has levels, as ``"#rrggbb"``."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    places = np.linspace(0, 1, min(max(levels, 2), 256))
    return STATUS_COLOURS if name == "codes" else tuple(map(to_hex, colormaps[name](places)))


def grey_picture(frame: Mosaic | ChannelFrame) -> Picture:
    """Return a raw frame as one stretched picture: the mean of its channels, or of the cell around each sample."""
    if isinstance(frame, Mosaic):
        return stretched(cv2.blur(frame.values.astype(np.float32), (2, 2)))
    return stretched(frame.values.mean(axis=0, dtype=np.float32))


@dataclass(frozen=True, kw_only=True, eq=False)
class RawPictures:
    """Pictures of the raw frames of a result, read where they still exist; picklable until the first is read.

    Attributes
    ----------
    result
        The result.
    """

    result: Result

    @cached_property
    def _series(self) -> FrameSeries:
        provenance = self.result.provenance
        if "settings" not in provenance:
            raise FrameError(
                f"{self.result.path} does not state where its raw frames are: it was not measured from files"
            )
        settings = TestSettings.from_mapping(provenance["settings"], provenance["base"])
        return open_series(settings.frames, settings.base)

    def __call__(self, index: int) -> Picture:
        """Read the frame of an index in the result; errors as those of the frames' reader."""
        return grey_picture(self._series.read(self._series.chosen[index])[0])


def reference_picture(result: Result) -> Picture:
    """Return the mean of the lights' reference images that a result keeps, grey where none was kept."""
    images, (left, top) = result.reference, result.reference_origin
    columns, rows = np.ceil(result.nodes.max(axis=0) + 1).astype(int)
    picture = np.full(result.frame_shape or (rows, columns), 60, dtype=np.uint8)
    if images is not None:
        picture[top : top + images.shape[1], left : left + images.shape[2]] = images.mean(axis=0)
    return picture


def stretched(image: AnyArray) -> Picture:
    """Stretch an image (H, W) between its 1 % and 99 % quantiles, of every fourth pixel, to 0 to 255; NaN is 0."""
    finite = image[::4, ::4][np.isfinite(image[::4, ::4])]
    low, high = np.percentile(finite, [1, 99]) if finite.size else (0.0, 1.0)
    return np.asarray(np.clip(255 * (np.nan_to_num(image) - low) / max(high - low, 1e-6), 0, 255), dtype=np.uint8)


def element_at(
    nodes: FloatArray, elements: npt.NDArray[np.int32], x: float, y: float
) -> tuple[npt.NDArray[np.int32], FloatArray] | None:
    """Return the nodes (3,) of the element that holds a point, and their shape functions (3,); None outside."""
    a, b, c = (nodes[elements[:, corner]] for corner in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        area = _cross(b - a, c - a)
        second, third = _cross(np.array([x, y]) - a, c - a) / area, _cross(b - a, np.array([x, y]) - a) / area
        inside = np.flatnonzero(np.minimum(np.minimum(second, third), 1 - second - third) >= -1e-9)
    if not len(inside):
        return None
    e = inside[0]
    return elements[e], np.array([1 - second[e] - third[e], second[e], third[e]])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def robust_range(read: MapValues | Profile) -> tuple[float, float] | None:
    """Return the colour range of what was read without doubtful nodes and outliers; None where nothing is measured."""
    ordinary = ordinary_values(read.values, read.std)
    return colour_range(ordinary) if ordinary.size else None
