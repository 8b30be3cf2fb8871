"""The pixel map, in which each pixel of the region is owned by one element, and means in a window around them."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.mesh import claim_pixels
from rgbmidic._kernels.owned_pixels import block_sums, from_image, product_sums, to_image, weighted_block_sums
from rgbmidic.errors import RegionError
from rgbmidic.mesh.region import Region
from rgbmidic.mesh.tri3 import Tri3Mesh
from rgbmidic.typing import AnyArray, BoolArray, FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PixelMap:
    """The P owned pixels, element after element.

    Attributes
    ----------
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
        First slot, number of pixels, row and column in `bounds` of every run.
    positions : tuple
        Local x and y, offsets and shape functions: where the owned pixels lie, for kernels.

    Examples
    --------
    >>> from rgbmidic import Region, Tri3Mesh
    >>> region = Region.from_rectangle((10, 10, 90, 70), shape=(80, 120))
    >>> pixels = PixelMap.from_mesh(Tri3Mesh.from_region(region, element_size=20), region)
    >>> pixels.offsets[-1] == region.mask.sum()
    np.True_
    """

    offsets: npt.NDArray[np.int64]
    origin: npt.NDArray[np.int64]
    local_x: FloatImage
    local_y: FloatImage
    barycentric: FloatArray
    shape: tuple[int, int]
    runs: npt.NDArray[np.int32]
    run_offsets: npt.NDArray[np.int64]
    bounds: tuple[int, int, int, int]
    lines: npt.NDArray[np.int32]
    positions: tuple[FloatImage, FloatImage, npt.NDArray[np.int64], FloatArray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Hold what kernels take together."""
        object.__setattr__(self, "positions", (self.local_x, self.local_y, self.offsets, self.barycentric))

    @classmethod
    def from_mesh(cls, mesh: Tri3Mesh, region: Region) -> PixelMap:
        """Give every pixel of `region` to the first triangle that covers it.

        Pixels that the chords of a curved outline leave out go with their nearest covered pixel, up to 3 px away.

        Parameters
        ----------
        mesh
            N nodes, E elements.
        region
            The pixels to measure.

        Returns
        -------
        PixelMap

        Raises
        ------
        RegionError
            No pixel of the region lies in the mesh.
        """
        owner = np.subtract(region.mask, np.int32(2), dtype=np.int32)
        claim_pixels(mesh.nodes, mesh.elements, owner)
        if (owner == -1).any():
            _claim_rim(owner)
        element, row, column, length = _owned_rows(owner)
        if not element.size:
            raise RegionError("no pixel of the region of interest lies in the mesh")
        first_row, first_column = int(row.min()), int(column.min())
        size = int(row.max()) - first_row + 1, int((column + length).max()) - first_column
        corners = mesh.nodes[mesh.elements]
        origin = np.round(corners.mean(axis=1)).astype(np.int64)
        first, local = np.cumsum(length) - length, (column - origin[element, 0], row - origin[element, 1])
        runs = np.stack([first, length, *local], axis=1).astype(np.int32)
        run_offsets = np.searchsorted(element, np.arange(len(origin) + 1))
        # the position along x of every pixel: its slot less that of the run's first, and that one's position
        local_x = np.arange(length.sum(), dtype=np.int32)
        local_x -= np.repeat(runs[:, 0] - runs[:, 2], runs[:, 1])
        # the linear shape functions of the triangles: 1 at their own corner, 0 at the others
        (x1, y1), (x2, y2) = (np.moveaxis(np.roll(corners - origin[:, None], turn, axis=1), 2, 0) for turn in (-1, 1))
        twice_areas = np.stack([x1 * y2 - x2 * y1, y1 - y2, x2 - x1], axis=2)
        return cls(
            offsets=np.append(runs[:, 0], local_x.size)[run_offsets],
            origin=origin,
            local_x=local_x.astype(np.float32),
            local_y=np.repeat(runs[:, 3].astype(np.float32), runs[:, 1]),
            barycentric=twice_areas / twice_areas[..., 0].sum(axis=1)[:, None, None],
            shape=region.mask.shape,
            runs=runs,
            run_offsets=run_offsets,
            bounds=(first_row, first_column, *size),
            lines=np.stack([first, length, row - first_row, column - first_column], axis=1).astype(np.int32),
        )

    @property
    def rows(self) -> npt.NDArray[np.int64]:
        """Row of every owned pixel in the image (P,)."""
        return self.element_pixels(np.ones(len(self.origin), dtype=bool))[2]

    @property
    def columns(self) -> npt.NDArray[np.int64]:
        """Column of every owned pixel in the image (P,)."""
        return self.element_pixels(np.ones(len(self.origin), dtype=bool))[1]

    def element_pixels(
        self, selected: BoolArray
    ) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return the slots, columns and rows (n,) of the pixels of the chosen elements (E,).

        Parameters
        ----------
        selected : ndarray, shape (E,), bool
            The elements.

        Returns
        -------
        slots, columns, rows : ndarray, shape (n,), int64
        """
        counts = np.diff(self.offsets)
        slots = np.flatnonzero(np.repeat(selected, counts))
        x, y = np.repeat(self.origin[selected].T, counts[selected], axis=1)
        return slots, self.local_x[slots].astype(np.int64) + x, self.local_y[slots].astype(np.int64) + y

    def gather(self, image: FloatImage) -> FloatImage:
        """Return the values of an image (..., H, W) at the owned pixels, shape (..., P).

        Parameters
        ----------
        image : ndarray, shape (..., H, W)
            One image or several.

        Returns
        -------
        ndarray, shape (..., P), float32
        """
        out = np.empty((*image.shape[:-2], self.local_x.size), dtype=np.float32)
        images = np.ascontiguousarray(image, dtype=np.float32).reshape(-1, *image.shape[-2:])
        from_image(self.lines, images, *self.bounds[:2], out.reshape(len(images), -1))
        return out

    def grid(self, side: int) -> tuple[int, int]:
        """Return the rows and columns of the blocks of `side` px that cover `bounds`.

        Parameters
        ----------
        side
            Side of the blocks in px.

        Returns
        -------
        rows, columns : int
        """
        _, _, height, width = self.bounds
        return -(-height // side), -(-width // side)

    def block_sums(self, values: FloatImage, side: int) -> FloatImage:
        """Sum `values` (n, P) over such blocks, shape (n, rows, columns).

        Parameters
        ----------
        values : ndarray, shape (n, P), float32
            Fields at the owned pixels.
        side
            Side of the blocks in px.

        Returns
        -------
        ndarray, shape (n, rows, columns), float32
        """
        out = np.empty((len(values), *self.grid(side)), dtype=np.float32)
        block_sums(values, self.lines, self.run_offsets, side, out)
        return out

    def weighted_block_sums(
        self, values: FloatImage, weights: FloatImage, side: int, *, with_weights: bool = False
    ) -> FloatImage:
        """Sum `values` (k, P) times their `weights` (k, P) over such blocks, and then the weights where asked for.

        Parameters
        ----------
        values : ndarray, shape (k, P), float32
            Fields at the owned pixels.
        weights : ndarray, shape (k, P), float32
            Their weights.
        side
            Side of the blocks in px.
        with_weights
            Whether the sums of the weights are returned, too.

        Returns
        -------
        ndarray, shape (k or 2 k, rows, columns), float32
        """
        out = np.empty((len(values) * (1 + with_weights), *self.grid(side)), dtype=np.float32)
        weighted_block_sums(values, weights, self.lines, self.run_offsets, side, out)
        return out

    def from_blocks(self, grids: FloatImage, side: int, interpolation: int = cv2.INTER_LINEAR) -> FloatImage:
        """Interpolate grids (n, rows, columns) of such blocks between their centres at the owned pixels (n, P).

        Parameters
        ----------
        grids : ndarray, shape (n, rows, columns)
            Values at the centres of the blocks.
        side
            Side of the blocks in px.
        interpolation
            One of OpenCV's.

        Returns
        -------
        ndarray, shape (n, P), float32
        """
        out = np.empty((len(grids), self.local_x.size), dtype=np.float32)
        size = grids.shape[2] * side, grids.shape[1] * side
        for grid, values in zip(grids.astype(np.float32, copy=False), out, strict=True):
            image = np.asarray(cv2.resize(grid, size, interpolation=interpolation))
            from_image(self.lines, image[None], 0, 0, values[None])
        return out

    def scatter(self, values: FloatImage, fill: float = 0.0) -> FloatImage:
        """Return the image (H, W) with `values` (P,) at the owned pixels and `fill` elsewhere.

        Parameters
        ----------
        values : ndarray, shape (P,)
            Field at the owned pixels.
        fill
            Value of all other pixels.

        Returns
        -------
        ndarray, shape (H, W), float32
        """
        image = np.full(self.shape, fill, dtype=np.float32)
        to_image(self.lines, np.asarray(values, dtype=np.float32)[None], *self.bounds[:2], image[None])
        return image


def _owned_rows(owner: npt.NDArray[np.int32]) -> tuple[npt.NDArray[np.int32], ...]:
    """Return owner, row, first column and length of every row of pixels that one element owns, element by element."""
    begins = np.ones(owner.shape, dtype=bool)
    np.not_equal(owner[:, 1:], owner[:, :-1], out=begins[:, 1:])
    start = np.flatnonzero(begins).astype(np.int32)
    length, element = np.diff(start, append=np.int32(owner.size)), owner.ravel()[start]
    order = np.argsort(element, kind="stable")[int((element < 0).sum()) :]
    return element[order], *np.divmod(start[order], np.int32(owner.shape[1])), length[order]


def _claim_rim(owner: npt.NDArray[np.int32]) -> None:
    """Give free pixels of the region near an owned one to its element, in place.

    The polygon of an outline is within 0.06 elements of it (`outline_mesh`): 3 px for elements of 50 px.
    """
    free = (owner < 0).astype(np.uint8)
    distance, label = cv2.distanceTransformWithLabels(free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    owned = owner >= 0
    element_of_label = np.full(int(label.max()) + 1, -1, dtype=np.int32)
    element_of_label[label[owned]] = owner[owned]
    rim = (owner == -1) & (np.asarray(distance) <= 3.0)
    owner[rim] = element_of_label[label[rim]]


def window_means(grids: AnyArray, sigma: float) -> AnyArray:
    """Average grids (..., h, w) over a Gaussian window of `sigma` blocks; beyond them there is 0."""
    means = np.empty(grids.shape, grids.dtype)  # whose grids are contiguous, whatever those given are
    for index in np.ndindex(grids.shape[:-2]):
        cv2.GaussianBlur(grids[index], (0, 0), sigma, dst=means[index], borderType=cv2.BORDER_CONSTANT)
    return means


@dataclass(frozen=True, slots=True, kw_only=True)
class SlidingWindow:
    """Gaussian window for means of fields around the owned pixels, applied on a grid of blocks.

    Attributes
    ----------
    sigma
        Its standard deviation, px: its 800 px, 4 pi times the square, give a variance to 5 % (derived), and it is
        narrow beside a reflection. Chosen; with half or twice of it in the weights lights under one differ by 3e-3 px
        at most, beside a gap by 6e-3 px, their uncertainty by 8 % (benchmarks/constants.py).
    step
        Side of the blocks, px: half the standard deviation, to which it adds 1 %.
    """

    sigma: float = 8.0
    step: int = 4

    def ratios(self, pixels: PixelMap, fields: FloatImage) -> FloatImage:
        """Sums of fields (n, P) around each block of the grid over that of the last one, (n - 1, h, w)."""
        sums = pixels.block_sums(fields, self.step)
        return self._means(sums[:-1], sums[-1:])

    def covariance(self, pixels: PixelMap, fields: FloatImage, weights: FloatImage) -> FloatImage:
        """Average the products of each two fields (k, P) around each block of the grid, (k, k, h, w).

        Their weight is the geometric mean of the fields' weights (k, P).
        """
        count = len(fields)
        sums = np.empty((count * (count + 1), *pixels.grid(self.step)), dtype=np.float32)
        product_sums(fields, weights, pixels.lines, pixels.run_offsets, pixels.offsets, self.step, sums)
        means = np.empty((count, count, *sums.shape[1:]), dtype=np.float32)
        first, second = np.tril_indices(count)
        means[first, second] = means[second, first] = self._means(sums[::2], sums[1::2])
        return means

    def _means(self, totals: FloatImage, weights: FloatImage) -> FloatImage:
        """Divide sums (n, h, w) by those of their weights (n, h, w) or (1, h, w), both blurred."""
        sigma = self.sigma / self.step
        means, weight_means = (window_means(grids, sigma) for grids in (totals, weights))
        means /= np.maximum(weight_means, np.float32(1e-6), out=weight_means)
        return np.asarray(means, dtype=np.float32)


WINDOW = SlidingWindow()
"""The window that is used by default."""
