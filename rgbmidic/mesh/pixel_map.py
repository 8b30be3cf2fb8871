"""The pixel map: each pixel of the region is owned by exactly one element, and stored with its element."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.grid import block_index, from_image, to_image
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

    def __post_init__(self) -> None:
        top, left = int(self.rows.min()), int(self.columns.min())
        size = int(self.rows.max()) - top + 1, int(self.columns.max()) - left + 1
        object.__setattr__(self, "bounds", (top, left, *size))
        first = _run_starts(self.rows, self.columns, self.offsets)
        length = np.diff(first, append=self.rows.size)
        runs = np.stack([first, length, self.local_x[first], self.local_y[first]], axis=1).astype(np.int32)
        object.__setattr__(self, "runs", runs)
        object.__setattr__(self, "run_offsets", np.searchsorted(first, self.offsets).astype(np.int64))

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

    def blocks(self, side: int) -> tuple[npt.NDArray[np.int32], tuple[int, int]]:
        """Number of the block of `side` px in which each owned pixel lies (P,), and the grid of blocks (rows,
        columns) over `bounds`."""
        return _blocks(self, side)

    def from_blocks(self, grids: FloatImage, side: int) -> FloatImage:
        """Grids (n, rows, columns) of such blocks interpolated between their centres at the owned pixels (n, P)."""
        size = grids.shape[2] * side, grids.shape[1] * side
        out = np.empty((len(grids), self.rows.size), dtype=np.float32)
        for grid, values in zip(grids.astype(np.float32), out, strict=True):
            values[:] = self.from_window(cv2.resize(grid, size, interpolation=cv2.INTER_LINEAR)[None])[0]
        return out

    def window(self, values: FloatImage, side: int = 1) -> FloatImage:
        """`values` (n, P) as images of the rectangle `bounds`, grown to whole blocks of `side` px on the right and
        below; 0 where no pixel is owned."""
        top, left, height, width = self.bounds
        images = np.zeros((len(values), -(-height // side) * side, -(-width // side) * side), dtype=np.float32)
        to_image(self.runs, self.rows, self.columns, top, left, values, images)
        return images

    def from_window(self, images: FloatImage) -> FloatImage:
        """Such images (n, h, w) at the owned pixels (n, P)."""
        top, left, _, _ = self.bounds
        out = np.empty((len(images), self.rows.size), dtype=np.float32)
        from_image(self.runs, self.rows, self.columns, top, left, images, out)
        return out

    def block_means(self, values: FloatImage, side: int) -> FloatImage:
        """Sums of `values` (P,) over such blocks, over the pixels of a block, shape (rows, columns)."""
        image = self.window(values[None], side)[0]
        size = image.shape[1] // side, image.shape[0] // side
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float32)

    def scatter(self, values: FloatImage, fill: float = 0.0) -> FloatImage:
        """Image (H, W) with `values` (P,) at the owned pixels and `fill` elsewhere."""
        image = np.full(self.shape, fill, dtype=np.float32)
        image[self.rows, self.columns] = values
        return image


@lru_cache(maxsize=2)
def _blocks(pixels: PixelMap, side: int) -> tuple[npt.NDArray[np.int32], tuple[int, int]]:
    """Kept for the two sides that every frame of a test needs."""
    top, left, height, width = pixels.bounds
    grid = -(-height // side), -(-width // side)
    index = np.empty(pixels.rows.size, dtype=np.int32)
    block_index(pixels.rows, pixels.columns, top, left, side, grid[1], index)
    return index, grid


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
