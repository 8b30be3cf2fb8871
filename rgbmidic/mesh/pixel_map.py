"""The pixel map: each pixel of the region is owned by exactly one element, and stored with its element."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.grid import block_sums, from_grid, from_image, to_image
from rgbmidic._kernels.mesh import claim_pixels, list_pixels
from rgbmidic.errors import RegionError
from rgbmidic.mesh.region import Region
from rgbmidic.mesh.tri3 import Tri3Mesh
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["PixelMap"]

_RIM = 3.0
"""Farthest (px) that a pixel of the region may lie from the element that owns it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PixelMap:
    """The P owned pixels, element after element.

    Attributes
    ----------
    rows, columns : ndarray, shape (P,), int32
        Image position of each pixel.
    offsets : ndarray, shape (E + 1,), int64
        Element e owns the slots ``offsets[e]:offsets[e + 1]``.
    origin : ndarray, shape (E, 2), int64
        Pixel (x, y) to which the local positions of an element refer.
    local_x, local_y : ndarray, shape (P,), float32
        Position of each pixel relative to its element's origin, px.
    barycentric : ndarray, shape (E, 3, 3), float64
        Shape function a of element e at a local position: ``b[e, a, 0] + b[e, a, 1] x + b[e, a, 2] y``.
    shape : tuple of int
        Image size (H, W).
    runs : ndarray, shape (R, 4), int32
        First slot, number of pixels and local position (x, y) of the first, of every row of pixels of an element.
    run_offsets : ndarray, shape (E + 1,), int64
        Element e owns the runs ``run_offsets[e]:run_offsets[e + 1]``.
    bounds : tuple of int
        First row, first column, height and width of the smallest rectangle around the owned pixels.
    lines : ndarray, shape (R, 4), int32
        First slot, number of pixels, row and column in `bounds` of every run, in the order of rows and columns.
    line_offsets : ndarray, shape (height + 1,), int64
        Row r of `bounds` has the lines ``line_offsets[r]:line_offsets[r + 1]``.
    """

    rows: npt.NDArray[np.int32]
    columns: npt.NDArray[np.int32]
    offsets: npt.NDArray[np.int64]
    origin: npt.NDArray[np.int64]
    local_x: FloatImage
    local_y: FloatImage
    barycentric: FloatArray
    shape: tuple[int, int]
    runs: npt.NDArray[np.int32] = field(init=False)
    run_offsets: npt.NDArray[np.int64] = field(init=False)
    bounds: tuple[int, int, int, int] = field(init=False)
    lines: npt.NDArray[np.int32] = field(init=False)
    line_offsets: npt.NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        top, left = int(self.rows.min()), int(self.columns.min())
        size = int(self.rows.max()) - top + 1, int(self.columns.max()) - left + 1
        object.__setattr__(self, "bounds", (top, left, *size))
        first = _run_starts(self.rows, self.columns, self.offsets)
        length = np.diff(first, append=self.rows.size)
        runs = np.stack([first, length, self.local_x[first], self.local_y[first]], axis=1).astype(np.int32)
        object.__setattr__(self, "runs", runs)
        object.__setattr__(self, "run_offsets", np.searchsorted(first, self.offsets).astype(np.int64))
        lines = np.stack([first, length, self.rows[first] - top, self.columns[first] - left], axis=1)
        lines = lines[np.lexsort((lines[:, 3], lines[:, 2]))].astype(np.int32)
        object.__setattr__(self, "lines", lines)
        object.__setattr__(self, "line_offsets", np.searchsorted(lines[:, 2], np.arange(size[0] + 1)))

    @classmethod
    def from_mesh(cls, mesh: Tri3Mesh, region: Region) -> PixelMap:
        """Give every pixel of `region` to the first triangle that covers it.

        Pixels that the chords of a curved outline leave out go with their nearest covered pixel, up to 3 px away.

        Raises
        ------
        RegionError
            No pixel of the region lies in the mesh.
        """
        owner = np.where(region.mask, np.int32(-1), np.int32(-2))
        counts = np.zeros(len(mesh.elements), dtype=np.int64)
        claim_pixels(mesh.nodes, mesh.elements, owner, counts)
        if (owner == -1).any():
            counts = _claim_rim(owner, counts)
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        if offsets[-1] == 0:
            raise RegionError("no pixel of the region of interest lies in the mesh")
        rows = np.empty(offsets[-1], dtype=np.int32)
        columns = np.empty_like(rows)
        list_pixels(owner, offsets[:-1].copy(), rows, columns)
        corners = mesh.nodes[mesh.elements]
        origin = np.round(corners.mean(axis=1)).astype(np.int64)
        per_pixel = np.repeat(np.arange(len(counts)), counts)
        return cls(
            rows=rows,
            columns=columns,
            offsets=offsets,
            origin=origin,
            local_x=(columns - origin[per_pixel, 0]).astype(np.float32),
            local_y=(rows - origin[per_pixel, 1]).astype(np.float32),
            barycentric=_shape_functions(corners - origin[:, None]),
            shape=region.mask.shape,
        )

    def gather(self, image: FloatImage) -> FloatImage:
        """Values of an image (..., H, W) at the owned pixels, shape (..., P)."""
        place = self.rows.astype(np.int64) * self.shape[1] + self.columns
        return np.take(image.reshape(*image.shape[:-2], -1), place, axis=-1)

    def by_element(self, values: FloatImage) -> FloatArray:
        """Sum of values (P,) over the pixels of each element, shape (E,)."""
        sums = np.zeros(len(self.origin))
        filled = self.offsets[:-1] < self.offsets[1:]
        sums[filled] = np.add.reduceat(values, self.offsets[:-1][filled], dtype=np.float64)
        return sums

    def grid(self, side: int) -> tuple[int, int]:
        """Rows and columns of the blocks of `side` px that cover `bounds`."""
        _, _, height, width = self.bounds
        return -(-height // side), -(-width // side)

    def blocks(self, side: int) -> npt.NDArray[np.int32]:
        """Number of the block of `side` px in which each owned pixel lies (P,), row after row of that grid."""
        top, left, _, _ = self.bounds
        return (self.rows - top) // side * self.grid(side)[1] + (self.columns - left) // side

    def block_sums(self, values: FloatImage, side: int) -> FloatImage:
        """Sums of `values` (n, P) over such blocks, shape (n, rows, columns)."""
        out = np.empty((len(values), *self.grid(side)), dtype=np.float32)
        block_sums(values, self.lines, self.line_offsets, side, out)
        return out

    def from_blocks(self, grids: FloatImage, side: int) -> FloatImage:
        """Grids (n, rows, columns) of such blocks interpolated between their centres at the owned pixels (n, P)."""
        out = np.empty((len(grids), self.rows.size), dtype=np.float32)
        from_grid(self.lines, self.line_offsets, np.ascontiguousarray(grids, dtype=np.float32), side, out)
        return out

    def window(self, values: FloatImage) -> FloatImage:
        """`values` (n, P) as images of the rectangle `bounds`; 0 where no pixel is owned."""
        images = np.zeros((len(values), *self.bounds[2:]), dtype=np.float32)
        to_image(self.lines, values, images)
        return images

    def from_window(self, images: FloatImage) -> FloatImage:
        """Such images (n, h, w) at the owned pixels (n, P)."""
        out = np.empty((len(images), self.rows.size), dtype=np.float32)
        from_image(self.lines, images, out)
        return out

    def scatter(self, values: FloatImage, fill: float = 0.0) -> FloatImage:
        """Image (H, W) with `values` (P,) at the owned pixels and `fill` elsewhere."""
        image = np.full(self.shape, fill, dtype=np.float32)
        image[self.rows, self.columns] = values
        return image


def _run_starts(
    rows: npt.NDArray[np.int32], columns: npt.NDArray[np.int32], offsets: npt.NDArray[np.int64]
) -> npt.NDArray[np.intp]:
    """Slots at which the pixel before is not the neighbour on the left, or belongs to another element."""
    begins = np.ones(rows.size, dtype=bool)
    begins[1:] = (rows[1:] != rows[:-1]) | (columns[1:] != columns[:-1] + 1)
    begins[offsets[:-1][np.diff(offsets) > 0]] = True
    return np.flatnonzero(begins)


def _claim_rim(owner: npt.NDArray[np.int32], counts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Give free pixels of the region near an owned one to its element, in place; the new number of each element."""
    free = (owner < 0).astype(np.uint8)
    distance, label = cv2.distanceTransformWithLabels(free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    owned = owner >= 0
    element_of_label = np.full(int(label.max()) + 1, -1, dtype=np.int32)
    element_of_label[label[owned]] = owner[owned]
    rim = (owner == -1) & (np.asarray(distance) <= _RIM)
    owner[rim] = element_of_label[label[rim]]
    return np.bincount(owner[owner >= 0], minlength=len(counts)).astype(np.int64)


def _shape_functions(corners: FloatArray) -> FloatArray:
    """Coefficients of the linear shape functions of triangles (E, 3, 2): 1 at their own corner, 0 at the others."""
    system = np.concatenate([np.ones((len(corners), 3, 1)), corners], axis=2)
    return np.ascontiguousarray(np.linalg.inv(system).transpose(0, 2, 1))
