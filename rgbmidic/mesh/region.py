"""The region of interest: the pixels to measure."""

from __future__ import annotations

import hashlib
import logging
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.errors import RegionError
from rgbmidic.renamed import state_new_names
from rgbmidic.typing import BoolArray, FloatArray, as_numbers

logger = logging.getLogger(__name__)

MAX_COORDINATE = 1_000_000
"""Coordinates of images are within so many px: OpenCV's fixed-point ones end at 8 million."""


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True)
class Region:
    """The pixels to measure.

    Attributes
    ----------
    mask : ndarray, shape (H, W), bool
    rectangle : tuple (x0, y0, x1, y1) in px, or None
        Stated if the region is a rectangle with sides along the axes; it includes the pixels whose centres lie on it.
    origin : tuple of int
        Column and row of the first pixel of the mask in the frame.

    Examples
    --------
    >>> from rgbmidic import Region
    >>> region = Region.from_rectangle((10, 10, 90, 70), shape=(80, 120))
    >>> region.width, int(region.mask.sum())
    (61, 4941)
    >>> int(region.without([[(20, 20), (40, 20), (40, 40)]]).mask.sum())
    4710
    """

    mask: BoolArray
    rectangle: tuple[float, float, float, float] | None = None
    origin: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        """Check the mask."""
        mask = np.ascontiguousarray(self.mask, dtype=bool)
        if mask.ndim != 2:
            raise RegionError(f"a region mask is one (H, W) image, not an array of shape {mask.shape}")
        if not mask.any():
            raise RegionError("the region of interest is empty: no pixel of the image lies in it")
        object.__setattr__(self, "mask", mask)

    def describe(self) -> str:
        """Return the number of pixels and their checksum: what a result keeps of a region that a script gave.

        Returns
        -------
        str
        """
        digest = hashlib.sha256(np.packbits(self.mask).tobytes()).hexdigest()[:16]
        return f"{int(self.mask.sum())} of {self.mask.shape[1]} x {self.mask.shape[0]} px, {digest}"

    @property
    def width(self) -> int:
        """Diameter in px of the largest disc within the region."""
        if self.rectangle is not None:
            x0, y0, x1, y1 = self.rectangle
            return int(min(np.floor(x1) - np.ceil(x0), np.floor(y1) - np.ceil(y0))) + 1
        distance = cv2.distanceTransform(np.pad(self.mask, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        return round(2 * float(np.max(distance))) - 1

    @classmethod
    def from_rectangle(cls, rectangle: Sequence[float], shape: tuple[int, int]) -> Region:
        """Return the rectangle (x0, y0, x1, y1) in px, clipped to the image of `shape` (H, W).

        Parameters
        ----------
        rectangle
            Corners x0, y0, x1, y1 in px.
        shape
            Rows and columns of the image.

        Returns
        -------
        Region

        Raises
        ------
        RegionError
            Not four finite numbers with x0 < x1 and y0 < y1, or no overlap with the image.
        """
        requirement = "a rectangle is four finite numbers (x0, y0, x1, y1) in px"
        corners = as_numbers(rectangle, requirement, (4,), error=RegionError)
        x0, y0, x1, y1 = corners.tolist()
        height, width = shape = image_shape(shape)
        if not (x0 < x1 and y0 < y1):
            raise RegionError(f"a rectangle (x0, y0, x1, y1) needs x0 < x1 and y0 < y1; given is {rectangle!r}")
        clipped = (max(x0, 0.0), max(y0, 0.0), min(x1, width - 1.0), min(y1, height - 1.0))
        if clipped[0] >= clipped[2] or clipped[1] >= clipped[3]:
            raise RegionError(
                f"the region's rectangle {rectangle!r} does not overlap the image of {width} x {height} px"
            )
        _warn_clipped("rectangle", corners.reshape(2, 2), shape)
        mask = np.zeros(shape, dtype=bool)
        first_column, first_row = (int(np.ceil(value)) for value in clipped[:2])
        mask[first_row : int(clipped[3]) + 1, first_column : int(clipped[2]) + 1] = True
        return cls(mask=mask, rectangle=clipped)

    @classmethod
    def from_polygon(cls, corners: npt.ArrayLike, shape: tuple[int, int]) -> Region:
        """Return the polygon with corners (x, y) in px, shape (M, 2), on an image of `shape` (H, W).

        Parameters
        ----------
        corners : array_like, shape (M, 2)
            Corners (x, y) in px.
        shape
            Rows and columns of the image.

        Returns
        -------
        Region

        Raises
        ------
        RegionError
            Fewer than three finite corners, or no overlap with the image.
        """
        points, shape = _polygon(corners), image_shape(shape)
        mask = _fill_polygon(points, shape)
        if not mask.any():
            raise RegionError(
                f"the region's polygon {points.tolist()} does not overlap the image of {shape[1]} x {shape[0]} px"
            )
        _warn_clipped("polygon", points, shape)
        return cls(mask=mask)

    def without(self, holes: Sequence[npt.ArrayLike]) -> Region:
        """Return the region without the pixels of some polygons.

        Parameters
        ----------
        holes
            Corners (x, y) of each in px, shape (M, 2).

        Returns
        -------
        Region

        Raises
        ------
        RegionError
            A polygon is not three finite corners or more, or nothing is left.
        """
        if not np.iterable(holes):
            raise RegionError(f"holes are polygons with corners (x, y) in px; given is {holes!r}")
        if not len(holes):
            return self
        inside = [_fill_polygon(_polygon(corners), self.mask.shape) for corners in holes]
        return Region(mask=self.mask & ~np.logical_or.reduce(inside))

    def crop(self, rows: slice, columns: slice) -> Region:
        """Return the same region on a part of the image that holds it.

        Parameters
        ----------
        rows, columns
            Rows and columns of the part in the image.

        Returns
        -------
        Region
        """
        corners = None
        if self.rectangle is not None:
            (x0, y0, x1, y1), x, y = self.rectangle, columns.start, rows.start
            corners = x0 - x, y0 - y, x1 - x, y1 - y
        origin = self.origin[0] + columns.start, self.origin[1] + rows.start
        return Region(mask=self.mask[rows, columns].copy(), rectangle=corners, origin=origin)

    @classmethod
    def from_mask(cls, mask: npt.ArrayLike, shape: tuple[int, int] | None = None) -> Region:
        """Return the non-zero pixels of a mask image (H, W); `shape`, where given, is the size it must have.

        Parameters
        ----------
        mask : array_like, shape (H, W)
            Not zero where the region is.
        shape
            Rows and columns of the images.

        Returns
        -------
        Region

        Raises
        ------
        RegionError
            The mask is empty or of another size.
        """
        pixels = np.asarray(mask)
        if shape is not None and pixels.shape != (shape := image_shape(shape)):
            raise RegionError(f"the mask is {pixels.shape[::-1]} px (width, height), the images are {shape[::-1]}")
        return cls(mask=pixels != 0)


def _polygon(corners: npt.ArrayLike) -> FloatArray:
    """Return the corners (M, 2) of a polygon.

    Raises
    ------
    RegionError
        They are not three or more, or beyond what fixed-point coordinates hold.
    """
    requirement = f"a polygon is at least three finite corners (x, y) in px, within {MAX_COORDINATE} px"
    points = as_numbers(corners, requirement, (None, 2), error=RegionError)
    if len(points) < 3 or np.abs(points).max() > MAX_COORDINATE:
        raise RegionError(f"{requirement}; given is {reprlib.repr(corners)}")
    return points


def image_shape(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the shape (H, W) of an image as integers; one that is none is a `RegionError`."""
    requirement = "the shape of an image is its numbers of rows and columns"
    height, width = as_numbers(cast(Any, shape), requirement, (2,), dtype=np.int64, error=RegionError).tolist()
    if not (0 < height <= MAX_COORDINATE and 0 < width <= MAX_COORDINATE):
        raise RegionError(f"{requirement}; given is {shape!r}")
    return height, width


def _fill_polygon(points: FloatArray, shape: tuple[int, ...]) -> BoolArray:
    """Return the pixels (H, W) of a polygon with corners (M, 2)."""
    mask = np.zeros(shape, dtype=np.uint8)
    shift = 8  # fixed-point bits of OpenCV's coordinates
    cv2.fillPoly(mask, [np.round(points * 2**shift).astype(np.int32)], 1, shift=shift)
    return mask.astype(bool)


def _warn_clipped(outline_name: str, points: FloatArray, shape: tuple[int, int]) -> None:
    """Warn of corners (M, 2) that lie more than a pixel outside an image."""
    last = np.array(shape[::-1]) - 1
    if (points < -1).any() or (points > last + 1).any():
        logger.warning(
            "the %s %s reaches outside the image of %d x %d px: clipped", outline_name, points.tolist(), *(last + 1)
        )
