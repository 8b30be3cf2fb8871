"""The pixel map, in which each pixel of the region is owned by one element, and quadratic fits to nodal values.

The fits give value, slope and curvature at every node (the recovery of Zhang and Naga, SIAM J. Sci. Comput. 26, 2005,
with weights that fall with the distance), and between the nodes at the owned pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from rgbmidic._kernels.mesh import claim_pixels
from rgbmidic._kernels.owned_pixels import block_sums, from_grid, from_image, to_image
from rgbmidic.errors import RegionError
from rgbmidic.mesh.region import Region
from rgbmidic.mesh.tri3 import Tri3Mesh, with_data
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

_RIM = 3.0
"""Farthest (px) that a pixel of the region may lie from the element that owns it: the polygon of an outline is within
0.06 elements of it (`outline_mesh`), 3 px for elements of 50 px."""


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
        First slot, number of pixels, row and column in `bounds` of every run, in the order of rows and columns.
    line_offsets : ndarray, shape (height + 1,), int64
        Row r of `bounds` has the lines ``line_offsets[r]:line_offsets[r + 1]``.
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
    line_offsets: npt.NDArray[np.int64]

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
        order = np.argsort(element, kind="stable")
        first = np.empty_like(length)
        first[order] = np.cumsum(length[order]) - length[order]
        top, left = int(row.min()), int(column.min())
        size = int(row.max()) - top + 1, int((column + length).max()) - left
        lines = np.stack([first, length, row - top, column - left], axis=1)
        corners = mesh.nodes[mesh.elements]
        origin = np.round(corners.mean(axis=1)).astype(np.int64)
        from_origin = column - origin[element, 0], row - origin[element, 1]
        runs = np.take(np.stack([first, length, *from_origin], axis=1).astype(np.int32), order, axis=0)
        run_offsets = np.searchsorted(element[order], np.arange(len(origin) + 1))
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
            bounds=(top, left, *size),
            lines=lines,
            line_offsets=np.searchsorted(lines[:, 2], np.arange(size[0] + 1)),
        )

    @property
    def positions(self) -> tuple[FloatImage, FloatImage, npt.NDArray[np.int64], FloatArray]:
        """Local x and y, offsets and shape functions: where the owned pixels lie, for kernels."""
        return self.local_x, self.local_y, self.offsets, self.barycentric

    @property
    def rows(self) -> npt.NDArray[np.int64]:
        """Row of every owned pixel in the image (P,)."""
        return self.of_elements(np.ones(len(self.origin), dtype=bool))[2]

    @property
    def columns(self) -> npt.NDArray[np.int64]:
        """Column of every owned pixel in the image (P,)."""
        return self.of_elements(np.ones(len(self.origin), dtype=bool))[1]

    def of_elements(
        self, chosen: BoolArray
    ) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Slots, columns and rows (n,) of the pixels of the chosen elements (E,).

        Parameters
        ----------
        chosen : ndarray, shape (E,), bool
            The elements.

        Returns
        -------
        slots, columns, rows : ndarray, shape (n,), int64
        """
        counts = np.diff(self.offsets)
        slots = np.flatnonzero(np.repeat(chosen, counts))
        x, y = np.repeat(self.origin[chosen].T, counts[chosen], axis=1)
        return slots, self.local_x[slots].astype(np.int64) + x, self.local_y[slots].astype(np.int64) + y

    def gather(self, image: FloatImage) -> FloatImage:
        """Values of an image (..., H, W) at the owned pixels, shape (..., P).

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
        """Rows and columns of the blocks of `side` px that cover `bounds`.

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
        block_sums(values, self.lines, self.line_offsets, side, out)
        return out

    def from_blocks(self, grids: FloatImage, side: int) -> FloatImage:
        """Interpolate grids (n, rows, columns) of such blocks between their centres at the owned pixels (n, P).

        Parameters
        ----------
        grids : ndarray, shape (n, rows, columns)
            Values at the centres of the blocks.
        side
            Side of the blocks in px.

        Returns
        -------
        ndarray, shape (n, P), float32
        """
        out = np.empty((len(grids), self.local_x.size), dtype=np.float32)
        from_grid(self.lines, self.line_offsets, np.ascontiguousarray(grids, dtype=np.float32), side, out)
        return out

    def window(self, values: FloatImage) -> FloatImage:
        """`values` (n, P) as images of the rectangle `bounds`; 0 where no pixel is owned.

        Parameters
        ----------
        values : ndarray, shape (n, P), float32
            Fields at the owned pixels.

        Returns
        -------
        ndarray, shape (n, height, width), float32
        """
        images = np.zeros((len(values), *self.bounds[2:]), dtype=np.float32)
        to_image(self.lines, values, 0, 0, images)
        return images

    def scatter(self, values: FloatImage, fill: float = 0.0) -> FloatImage:
        """Image (H, W) with `values` (P,) at the owned pixels and `fill` elsewhere.

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
    """Return owner, row, first column and length of every row of pixels that one element owns, in image order."""
    begins = np.ones(owner.shape, dtype=bool)
    np.not_equal(owner[:, 1:], owner[:, :-1], out=begins[:, 1:])
    start = np.flatnonzero(begins).astype(np.int32)
    length, element = np.diff(start, append=np.int32(owner.size)), owner.ravel()[start]
    owned = element >= 0
    return element[owned], *np.divmod(start[owned], np.int32(owner.shape[1])), length[owned]


def _claim_rim(owner: npt.NDArray[np.int32]) -> None:
    """Give free pixels of the region near an owned one to its element, in place."""
    free = (owner < 0).astype(np.uint8)
    distance, label = cv2.distanceTransformWithLabels(free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    owned = owner >= 0
    element_of_label = np.full(int(label.max()) + 1, -1, dtype=np.int32)
    element_of_label[label[owned]] = owner[owned]
    rim = (owner == -1) & (np.asarray(distance) <= _RIM)
    owner[rim] = element_of_label[label[rim]]


Index = npt.NDArray[np.intp]

TERMS = ("value", "x", "y", "xx", "xy", "yy")
"""Results of the operators of `quadratic_fit`: the value, its first and its second derivatives."""
_WIDTH = 0.58
"""Standard deviation of the weights around an inner node, in sides of an element. Waves of 3, 4 and 6 elements then
have .95 to 1.02, .99 to 1.01 and 1.00 of their height at the nodes, at a third less noise than the linear fit's; with
.45 1.05 and with .7 .86 of it at 3 elements (regular and outlined meshes, waves along the mesh and at 45 degrees).
Its square goes with the inverse of the angle that the mesh fills: with .58 everywhere corners scattered 2 times as much
as the linear fit's, and waves at an edge were seen no better."""
_TIP = 0.8
"""Fraction of the full angle from which a corner of the mesh counts as a crack's tip: an opening of 70 degrees."""
_RIDGE = np.array([1e-9, 1e-9, 1e-6, 1e-6, 1e-6])
"""Weight with which slopes and curvatures are held at 0, where too few nodes determine them: the second derivatives of
waves of 5 to 6 elements, crack tips among them, change by 2e-5 of the largest at most (measured)."""


def quadratic_fit(
    mesh: Tri3Mesh,
    used: BoolArray,
    *,
    information: FloatArray | None = None,
    offset: FloatArray | None = None,
    first: int | None = None,
) -> tuple[sp.csr_matrix, ...]:
    """Linear operators (N, N), one for each of `TERMS`, from nodal values to those of the polynomial at each node.

    The polynomial is fitted to the nodes within two edges, reached over `used` elements only: not across a crack or a
    hole. Quadratic fields are reproduced, at edges too; what too few nodes determine is 0.

    Parameters
    ----------
    mesh
        N nodes, E elements.
    used : ndarray, shape (E,), bool
        Elements over which nodes are reached.
    information : ndarray, shape (N,), optional
        How well each node is known (inverse variance, any unit): one that is known badly counts little elsewhere.
    offset : ndarray, shape (N, 3), optional
        Excess of the given values over a field whose second derivative xx, xy or yy is 1, square px; 0 without.
    first
        Fit the polynomials of so many first nodes only; None: of all.

    Returns
    -------
    tuple of csr_matrix, shape (N, N) or (`first`, N)
        In the order of `TERMS`, per px and square px.
    """
    other, known, weight, structure = _window(mesh, used.tobytes())
    basis = _basis(mesh, used.tobytes(), None if offset is None else offset.tobytes())
    if first is not None:
        other, weight, basis, structure = other[:first], weight[:first], basis[:first], structure[:first]
        known = known[: structure.nnz]
    if information is not None:
        own, theirs = np.broadcast_to(information[: len(other), None], other.shape), information[other]
        weight = weight * np.divide(theirs, own + theirs, out=np.full(other.shape, 0.5), where=own + theirs > 0)
    weighted = weight[:, None] * basis
    normal = weighted @ basis.transpose(0, 2, 1)
    normal[:, range(1, 6), range(1, 6)] += _RIDGE
    fits = (
        np.linalg.inv(normal) / (mesh.sizes[: len(other), None] ** np.array([0, 1, 1, 2, 2, 2]))[:, :, None]
    ) @ weighted
    return tuple(with_data(structure, fits[:, term].ravel()[known]) for term in range(6))


def blended(mesh: Tri3Mesh, pixels: PixelMap, polynomials: Sequence[FloatArray]) -> FloatImage:
    """Evaluate the nodes' polynomials at the owned pixels, each weighted by its shape function: (C, P), continuous.

    Parameters
    ----------
    mesh, pixels
        N nodes, P owned pixels.
    polynomials : sequence of ndarray, shape (N, C)
        Values of each of `TERMS`.
    """
    value, x, y, xx, xy, yy = polynomials
    element = np.repeat(np.arange(len(mesh.elements)), np.diff(pixels.offsets))
    out = np.zeros((value.shape[1], pixels.local_x.size), dtype=np.float32)
    for corner in range(3):
        node = mesh.elements[element, corner]
        constant, slope_x, slope_y = pixels.barycentric[element, corner].T
        shape_function = constant + slope_x * pixels.local_x + slope_y * pixels.local_y
        dx, dy = pixels.columns - mesh.nodes[node, 0], pixels.rows - mesh.nodes[node, 1]
        for c in range(len(out)):
            bent = xx[node, c] * dx * dx / 2 + xy[node, c] * dx * dy + yy[node, c] * dy * dy / 2
            out[c] += shape_function * (value[node, c] + x[node, c] * dx + y[node, c] * dy + bent)
    return out


@lru_cache(maxsize=2)  # of a mesh and of its halves
def _window(mesh: Tri3Mesh, used: bytes) -> tuple[Index, Index, FloatArray, sp.csr_matrix]:
    """Return the nodes that the polynomial of each node is fitted to.

    The last result is kept, for most frames use all elements.

    Returns
    -------
    tuple
        The nodes around each, itself where a row has fewer, (N, W); the places of those that are no such filling; their
        weights (N, W); and the matrix of these nodes.
    """
    elements = np.frombuffer(used, dtype=bool)
    surrounded = _surrounded(mesh, elements)
    reach = _reached(mesh, elements, surrounded)
    number = np.diff(reach.indptr)
    known = np.arange(number.max()) < number[:, None]
    other = np.repeat(np.arange(number.size)[:, None], known.shape[1], axis=1)
    other[known] = reach.indices
    square = sum((axis[other] - axis[:, None]) ** 2 for axis in mesh.nodes.T) / mesh.sizes[:, None] ** 2
    # at an edge the window holds as much of the mesh as inside
    weight = np.where(known, np.exp(-square * surrounded[:, None] / (2 * _WIDTH**2)), 0.0)
    return other, np.flatnonzero(known), weight, reach


def _surrounded(mesh: Tri3Mesh, used: BoolArray) -> FloatArray:
    """Return the fraction (N,) of the full angle around each node that `used` elements fill; 1 where there are none."""
    corners = mesh.nodes[mesh.elements]
    ahead, back = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    across = ahead[..., 0] * back[..., 1] - ahead[..., 1] * back[..., 0]
    angle = np.arctan2(across, (ahead * back).sum(axis=-1)) * used[:, None]
    fraction = np.bincount(mesh.elements.ravel(), weights=angle.ravel(), minlength=len(mesh.nodes)) / (2 * np.pi)
    return np.asarray(np.where(fraction > 0, fraction, 1.0))


@lru_cache(maxsize=4)  # with and without the offset
def _basis(mesh: Tri3Mesh, used: bytes, offset: bytes | None) -> FloatArray:
    """Evaluate 1, x, y, xx/2, xy, yy/2 about each node at those around it, in sides of an element: (N, 6, W)."""
    other = _window(mesh, used)[0]
    sizes = mesh.sizes[:, None]
    x, y = ((axis[other] - axis[:, None]) / sizes for axis in mesh.nodes.T)
    basis = np.stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2], axis=1)
    if offset is not None:
        for term, beyond in enumerate(np.frombuffer(offset).reshape(-1, 3).T):
            basis[:, 3 + term] += beyond[other] / sizes**2
    return basis


def _reached(mesh: Tri3Mesh, used: BoolArray, surrounded: FloatArray) -> sp.csr_matrix:
    """Return the nodes at most two edges of `used` elements away from each, itself included, as the entries of its row.

    No way leads round the tip of a crack to its other side.
    """
    corners, itself = mesh.elements[used], np.arange(len(mesh.nodes))
    rows = np.concatenate([np.repeat(corners, 3, axis=1).ravel(), itself])
    columns = np.concatenate([np.tile(corners, 3).ravel(), itself])
    beside = sp.csr_matrix((np.ones(rows.size, dtype=bool), (rows, columns)), shape=(itself.size, itself.size))
    row = np.repeat(itself, np.diff(beside.indptr))
    through = with_data(beside, (~(mesh.on_boundary & (surrounded > _TIP)))[row] | (beside.indices == row))
    reached = sp.csr_matrix(beside @ through)
    reached.sort_indices()  # or scipy might, later, in one of the matrices that share them
    return reached
