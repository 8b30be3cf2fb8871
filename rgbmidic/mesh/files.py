"""Finite-element meshes from files (Abaqus, gmsh, Nastran, VTU and more), and where they lie on the image.

meshio reads all formats but two: of Abaqus' it keeps neither the labels nor more than the last ``*NODE`` block, of
gmsh's no labels, and with numpy 2 it fails on some. A placement is a similarity of the mesh's plane to the image, or
a rigid motion of it to the plane of a calibrated camera, fitted to pairs of points (Umeyama, IEEE Transactions on
Pattern Analysis and Machine Intelligence 13, 1991).
"""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.mesh import claim_pixels
from rgbmidic.command import optional
from rgbmidic.errors import InputError, RegionError, RgbmidicError, first_line
from rgbmidic.mesh.region import Region
from rgbmidic.mesh.tri3 import Tri3Mesh
from rgbmidic.settings import LENGTH_UNITS, regular
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["FiniteElementMesh", "Placement", "Plane", "on_image", "read_mesh"]

logger = logging.getLogger(__name__)

_FLAT = 1e-4
"""Distance of nodes from a plane, as a fraction of the mesh's extent, under which they lie on it: single precision and
the eight columns of Nastran leave 1e-6 to 1e-5 (derived)."""

IntArray = npt.NDArray[np.int64]
_Nodes = dict[int, list[float]]
_Elements = dict[str, dict[int, list[int]]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FiniteElementMesh:
    """The planar part of a finite-element mesh, as three-node triangles.

    Attributes
    ----------
    name : str
        The file.
    points : ndarray, shape (N, 2), float64
        Nodes in mm, in the mesh's own axes: the coordinates `axes` of the file.
    node_numbers : ndarray, shape (N,), int64
        Labels of the nodes in the file.
    elements : ndarray, shape (E, 3), int32
        Triangles, counter-clockwise in the mesh's axes; a quadrilateral gives two, and only corner nodes are kept.
    element_numbers : ndarray, shape (E,), int64
        Labels, in the file, of the elements that the triangles come from.
    fields : mapping of str to ndarray, shape (N, ...)
        Nodal data of the file (none of Abaqus and of gmsh in text), in its own unit and components: a vector's
        component along x is ``[:, axes[0]]``.
    axes : tuple of int
        Which coordinates (0, 1, 2) of the file are x and y.
    unit_mm : float
        Millimetres per unit of length of the file; multiply a displacement in `fields` by it.
    numbering : str
        Origin of the numbers, in words.
    """

    name: str
    points: FloatArray
    node_numbers: IntArray
    elements: npt.NDArray[np.int32]
    element_numbers: IntArray
    fields: Mapping[str, FloatArray] = field(default_factory=dict)
    axes: tuple[int, int] = (0, 1)
    unit_mm: float = 1.0
    numbering: str = "labels of the file"

    def __post_init__(self) -> None:
        """Check the arrays, convert them to their types and order the corners."""
        points, elements = np.array(self.points, dtype=np.float64), np.array(self.elements, dtype=np.int32)
        if points.ndim != 2 or points.shape[1] != 2 or elements.ndim != 2 or elements.shape[1] != 3:
            raise InputError(
                f"{self.name}: points are (N, 2) and elements (E, 3), not {points.shape}, {elements.shape}"
            )
        if not np.isfinite(points).all() or not len(elements) or elements.min() < 0 or elements.max() >= len(points):
            raise InputError(f"{self.name}: points must be finite and elements must name existing ones")
        area = _cross(points, elements)
        if not (np.abs(area) > 1e-12 * np.ptp(points, axis=0).max() ** 2).all():
            number = np.asarray(self.element_numbers)[np.argmin(np.abs(area))]
            raise InputError(f"{self.name}: element {number} has no area")
        elements[area < 0] = elements[area < 0][:, [0, 2, 1]]
        for key, values, count in (
            ("points", points, len(points)),
            ("elements", elements, len(elements)),
            ("node_numbers", np.array(self.node_numbers, dtype=np.int64), len(points)),
            ("element_numbers", np.array(self.element_numbers, dtype=np.int64), len(elements)),
        ):
            if len(values) != count:
                raise InputError(f"{self.name}: {key} needs {count} entries, not {len(values)}")
            values.setflags(write=False)
            object.__setattr__(self, key, values)

    def part(self, chosen: BoolArray) -> Self:
        """Return the chosen triangles (E,), and their nodes."""
        used, index = np.unique(self.elements[chosen], return_inverse=True)
        return replace(
            self,
            points=self.points[used],
            node_numbers=self.node_numbers[used],
            elements=index.reshape(-1, 3).astype(np.int32),
            element_numbers=self.element_numbers[chosen],
            fields={key: values[used] for key, values in self.fields.items()},
        )

    @property
    def areas(self) -> FloatArray:
        """Area (E,) of every triangle, square mm."""
        return _cross(self.points, self.elements) / 2


class Plane(Protocol):
    """Map between px of the image and mm on a plane: `rgbmidic.CameraCalibration`."""

    def to_mm(self, points: FloatArray) -> FloatArray:
        """Return mm on the plane (N, 2) of points (N, 2) in px."""

    def to_px(self, points: FloatArray) -> FloatArray:
        """Return px of points (N, 2) in mm on the plane."""

    def jacobian(self, points: FloatArray) -> FloatArray:
        """Return the derivative (N, 2, 2) of `to_mm` at points (N, 2) in px: ``[n, mm axis, px axis]``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Placement:
    """Position of a mesh in mm on the image.

    Attributes
    ----------
    matrix : ndarray, shape (2, 2)
        Maps the mesh's mm to px, or to mm on the camera's plane if there is a `camera`.
    shift : ndarray, shape (2,)
        Position of the mesh's origin, in the same unit.
    camera
        Lens and plane; None: the image is similar to the mesh (rotated, shifted and scaled).
    pairs : ndarray, shape (n, 4)
        The pairs (x_mm, y_mm, x_px, y_px) that it was fitted to.
    """

    matrix: FloatArray
    shift: FloatArray
    camera: Plane | None = None
    pairs: FloatArray = field(default_factory=lambda: np.empty((0, 4)))

    @classmethod
    def fit(cls, pairs: npt.ArrayLike, camera: Plane | None = None, *, where: str = "mesh.points") -> Self:
        """Fit a placement to pairs of points by least squares.

        Without a camera it is a similarity: shift, rotation and scale. With one it is a rigid motion, for both have mm.
        Whether the image shows the mesh or its mirror image is what fits three or more pairs better; where they do not
        decide, the mesh's y axis points up (and the image's down). The log states a doubt, and residuals beyond those
        of points set by hand.

        Parameters
        ----------
        pairs : array_like, shape (n, 4)
            (x_mm, y_mm, x_px, y_px), two or more.
        camera
            Lens and plane.
        where
            Name of the pairs in messages.

        Raises
        ------
        InputError
            Fewer than two pairs, or two at one place.
        """
        given = np.array(pairs, dtype=np.float64)
        if given.ndim != 2 or given.shape[1] != 4 or len(given) < 2 or not np.isfinite(given).all():
            raise InputError(f"{where} is two or more pairs [x_mm, y_mm, x_px, y_px] of finite numbers, not {pairs!r}")
        for part, what in ((given[:, :2], "on the mesh"), (given[:, 2:], "on the image")):
            same = np.argwhere(np.triu((part[:, None] == part).all(axis=2), 1))
            if len(same):
                raise InputError(f"{where}: pairs {same[0].tolist()} are one point {what}")
        if camera is not None:
            on_plane, on_mesh = (part - part.mean(axis=0) for part in (camera.to_mm(given[:, 2:]), given[:, :2]))
            stretch = np.linalg.norm(on_plane) / np.linalg.norm(on_mesh)
            if not 1 / _STRETCHED < stretch < _STRETCHED:
                raise InputError(
                    f"the pairs of {where} lie {stretch:.4g} times as far apart on the camera's plane as on the mesh, "
                    "where both are in mm: look at mesh.unit, the points and the calibration"
                )
        best, other = (cls._fitted(given, camera, reflected) for reflected in (True, False))
        if len(given) > 2 and max(best.rms, other.rms) < _DECIDED * max(min(best.rms, other.rms), _POINTING):
            logger.warning(
                "%s does not decide whether the image shows the mesh or its mirror image: up is taken", where
            )
        elif len(given) > 2 and other.rms < best.rms:
            best = other
        if best.rms > _DECIDED * _POINTING:
            off = np.hypot(*best.residuals.T)
            text = "%s leaves residuals of %.1f px rms, the largest, %.1f px, at %s[%d]: check the pairs"
            logger.warning(text, where, best.rms, off.max(), where, off.argmax())
        return best

    @classmethod
    def _fitted(cls, pairs: FloatArray, camera: Plane | None, reflected: bool) -> Self:
        """Fit one of both senses of rotation, in complex numbers: ``w = a z + b`` of z or its conjugate."""
        image = pairs[:, 2:] if camera is None else camera.to_mm(pairs[:, 2:])
        sign = -1.0 if reflected else 1.0
        z, w = pairs[:, 0] + sign * 1j * pairs[:, 1], image[:, 0] + 1j * image[:, 1]
        a = np.vdot(z - z.mean(), w - w.mean()) / np.vdot(z - z.mean(), z - z.mean())
        a /= 1 if camera is None else abs(a)
        b = w.mean() - a * z.mean()
        matrix = np.array([[a.real, -sign * a.imag], [a.imag, sign * a.real]])
        return cls(matrix=matrix, shift=np.array([b.real, b.imag]), camera=camera, pairs=pairs)

    @property
    def reflected(self) -> bool:
        """Whether a counter-clockwise turn of the mesh (x right, y up) is one on the screen, where y points down."""
        return bool(np.linalg.det(self.matrix) < 0)

    @property
    def residuals(self) -> FloatArray:
        """Distance (n, 2) in px from the image's point of every pair to where the mesh's is placed."""
        return self.to_px(self.pairs[:, :2]) - self.pairs[:, 2:]

    @property
    def rms(self) -> float:
        """Root mean square length of the residuals, px."""
        return float(np.sqrt((self.residuals**2).sum(axis=1).mean()))

    @property
    def mm_per_pixel(self) -> float | None:
        """Millimetres of the mesh in a px; None with a camera, which has a scale of its own at every pixel."""
        return None if self.camera is not None else float(1 / np.sqrt(abs(np.linalg.det(self.matrix))))

    @property
    def mm_per_pixel_std(self) -> float:
        """Standard uncertainty of `mm_per_pixel` from the residuals; 0 where two pairs leave none, or with a camera."""
        free = 2 * len(self.pairs) - 4
        if self.camera is not None or free < 1 or self.mm_per_pixel is None:
            return 0.0
        spread = ((self.pairs[:, 2:] - self.pairs[:, 2:].mean(axis=0)) ** 2).sum()
        return float(self.mm_per_pixel * np.sqrt((self.residuals**2).sum() / free / spread))

    def to_px(self, points: FloatArray) -> FloatArray:
        """Return where points (N, 2) of the mesh, in mm, lie on the image, px."""
        places = points @ self.matrix.T + self.shift
        return places if self.camera is None else self.camera.to_px(places)

    def to_mm(self, points: FloatArray) -> FloatArray:
        """Return points (N, 2) of the image, in px, in mm in the mesh's axes."""
        places = points if self.camera is None else self.camera.to_mm(points)
        return np.asarray((places - self.shift) @ np.linalg.inv(self.matrix).T)

    def jacobian(self, points: FloatArray) -> FloatArray:
        """Derivative (N, 2, 2) of `to_mm` at points (N, 2) in px: ``[n, mesh axis, px axis]``, mm per px."""
        back = np.linalg.inv(self.matrix)
        if self.camera is None:
            return np.broadcast_to(back, (len(points), 2, 2)).copy()
        return np.asarray(back @ self.camera.jacobian(points))

    def vectors_to_mm(self, points: FloatArray, vectors: FloatArray) -> FloatArray:
        """Displacements (N, 2) in mm in the mesh's axes, of `vectors` (N, 2) in px from `points` (N, 2) in px."""
        return self.to_mm(points + vectors) - self.to_mm(points)

    def vectors_to_px(self, points: FloatArray, vectors: FloatArray) -> FloatArray:
        """Displacements (N, 2) in px, of `vectors` (N, 2) in mm from `points` (N, 2) in mm, in the mesh's axes."""
        return self.to_px(points + vectors) - self.to_px(points)

    def to_document(self) -> dict[str, Any]:
        """Return all but the camera in plain values, as the provenance of a result holds it."""
        return {name: getattr(self, name).tolist() for name in ("matrix", "shift", "pairs")}

    @classmethod
    def from_document(cls, document: Mapping[str, Any], camera: Plane | None = None) -> Self:
        """Return the placement of such values, and the `camera` that it was fitted with."""
        values = {name: np.array(document[name], dtype=np.float64) for name in ("matrix", "shift", "pairs")}
        return cls(**values, camera=camera)

    def summary(self) -> str:
        """Return what it is, in words."""
        turned = np.degrees(np.arctan2(self.matrix[1, 0], self.matrix[0, 0]))
        scale = (
            "" if self.mm_per_pixel is None else f"{self.mm_per_pixel:.6g} ± {self.mm_per_pixel_std:.2g} mm per px, "
        )
        fit = f"{len(self.pairs)} pairs, residuals {self.rms:.2g} px rms"
        return f"{scale}x axis at {turned:.2f} degrees, y axis {'up' if self.reflected else 'down'}; {fit}"


def on_image(
    finite_elements: FiniteElementMesh, placement: Placement, shape: tuple[int, int], inside: Region | None = None
) -> tuple[FiniteElementMesh, Tri3Mesh, Region]:
    """Place a mesh on images of `shape` (H, W); the log states how much of it is left out.

    Parameters
    ----------
    finite_elements, placement
        The mesh, and where it lies.
    shape
        Rows and columns of the images.
    inside
        Only triangles whose centre lies in it.

    Returns
    -------
    tuple
        The part of the mesh that is measured, wholly within the image; the same in px; and the pixels that it covers.

    Raises
    ------
    RegionError
        No element is left.
    """
    corners = placement.to_px(finite_elements.points)[finite_elements.elements]
    last = np.array([shape[1] - 1, shape[0] - 1])
    within = np.asarray(((corners >= 0) & (corners <= last)).all(axis=(1, 2)), dtype=bool).reshape(-1)
    kept = within.copy()
    if inside is not None:
        column, row = np.clip(np.round(corners[within].mean(axis=1)).astype(int), 0, last).T
        kept[within] = inside.mask[row, column]
    if not kept.any():
        low, high = np.nanmin(corners, axis=(0, 1)), np.nanmax(corners, axis=(0, 1))
        raise RegionError(
            f"no element of {finite_elements.name} lies in the {'region' if within.any() else 'image'}: mesh.points "
            f"place it at x {low[0]:.0f} to {high[0]:.0f}, y {low[1]:.0f} to {high[1]:.0f} px of an image of "
            f"{shape[1]} x {shape[0]} px"
        )
    every = len(kept)
    for count, where in ((every - int(within.sum()), "the image"), (int((within & ~kept).sum()), "the region")):
        if count:
            logger.warning("%s: %d of %d triangles lie outside %s: left out", finite_elements.name, count, every, where)
    part = finite_elements.part(kept)
    mesh = Tri3Mesh(nodes=placement.to_px(part.points), elements=part.elements)
    owner = np.full(shape, -1, dtype=np.int32)
    claim_pixels(mesh.nodes, mesh.elements, owner)
    return part, mesh, Region.from_mask(owner >= 0)


_POINTING = 0.5
"""Residuals (px) that a point set by hand may have, and that decide nothing: a click is on a whole pixel (chosen)."""
_DECIDED = 3.0
"""How many times larger the residuals of the other sense must be for pairs to decide (chosen: beyond any scatter)."""
_STRETCHED = 1.05
"""Ratio of lengths on the mesh and on a camera's plane beyond which they contradict each other (chosen: a wrong unit is
25 or more, a scale that is known to 5 % is no calibration)."""


def _cross(points: FloatArray, elements: npt.NDArray[np.integer]) -> FloatArray:
    """Twice the signed area (...) of triangles (..., 3)."""
    first, second = (points[elements[..., corner]] - points[elements[..., 0]] for corner in (1, 2))
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


@dataclass(frozen=True, slots=True, kw_only=True)
class _File:
    """What a file holds: nodes, blocks of cells (shape, indices of their corners, numbers), and sets of the numbers."""

    points: FloatArray
    numbers: IntArray
    blocks: Sequence[tuple[str, IntArray, IntArray]]
    sets: Mapping[str, Collection[int]]
    fields: Mapping[str, FloatArray] = field(default_factory=dict)
    numbering: str = "labels of the file"

    @classmethod
    def of(cls, nodes: _Nodes, elements: _Elements, sets: Mapping[str, Collection[int]]) -> Self:
        """Take nodes and elements by their labels."""
        index, blocks = {label: i for i, label in enumerate(nodes)}, []
        for shape, cells in elements.items():
            if lost := [(cell, node) for cell, corners in cells.items() for node in corners if node not in index]:
                raise InputError(f"element {lost[0][0]} has node {lost[0][1]}, which the file does not state")
            corners = np.array([[index[node] for node in corners] for corners in cells.values()])
            blocks.append((shape, corners, np.array(list(cells))))
        points = np.array(list(nodes.values()), dtype=np.float64)
        return cls(points=points, numbers=np.array(list(nodes)), blocks=blocks, sets=sets)


_PLANAR = {"triangle": ((0, 1, 2),), "quad": ((0, 1, 2, 3),)}
_SOLID = {
    "tetra": ((0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3)),
    "hexahedron": ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    "wedge": ((0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "pyramid": ((0, 1, 2, 3), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}
"""Corners of the sides of cells, in VTK's order, which meshio has for all formats and Abaqus' own is."""
_CORNERS = {"triangle": 3, "quad": 4, "tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}


def read_mesh(path: Path | str, *, unit: str = "mm", part: str | None = None) -> FiniteElementMesh:
    """Read the planar part of a finite-element mesh.

    Shells and plane elements are used; if there are none, the free faces of solids. Of several planes normal to an axis
    of the file, the one with the largest area is measured; of equal ones, that with the largest coordinate. The log
    states what was left out.

    Parameters
    ----------
    path
        Abaqus (``.inp``), gmsh (``.msh``), Nastran (``.bdf``, ``.nas``, ``.fem``), VTK (``.vtu``, ``.vtk``), XDMF
        (``.xdmf``), Medit (``.mesh``), AVS-UCD (``.avs``) or Netgen (``.vol``).
    unit
        Unit of length of the file, one of `rgbmidic.settings.LENGTH_UNITS`.
    part
        Only the elements of this set: an Abaqus element set or part, a gmsh physical group. None: all.

    Raises
    ------
    InputError
        The file is missing or not readable, meshio is missing, or there is no plane.
    """
    path = Path(path)
    if unit not in LENGTH_UNITS:
        raise InputError(f'the unit of {path} must be one of {", ".join(LENGTH_UNITS)}, not "{unit}"')
    try:
        if not path.is_file():
            raise InputError(f"mesh file not found: {path}")
        content = _read_abaqus(path) if path.suffix.lower() == ".inp" else _read_meshio(path)
    except RgbmidicError as error:
        raise InputError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
    except (ValueError, LookupError, AssertionError, OSError, EOFError, StopIteration, RecursionError) as error:
        raise InputError(f"{path} is not a readable mesh: {str(error) or 'it ends early'}") from None
    faces, numbers = _faces(content, path, part)
    axes, chosen = _plane(content.points, faces, path)
    corners, numbers = _triangles(content.points[:, axes], faces[chosen], numbers[chosen])
    used, index = np.unique(corners, return_inverse=True)
    return FiniteElementMesh(
        name=str(path),
        points=content.points[used][:, axes] * LENGTH_UNITS[unit],
        node_numbers=content.numbers[used],
        elements=index.reshape(-1, 3).astype(np.int32),
        element_numbers=numbers,
        fields={key: values[used] for key, values in content.fields.items()},
        axes=axes,
        unit_mm=LENGTH_UNITS[unit],
        numbering=content.numbering,
    )


def _faces(content: _File, path: Path, part: str | None) -> tuple[IntArray, IntArray]:
    """Return the corners (m, 4) of the faces, a triangle's last one twice, and their elements' numbers (m,)."""
    blocks = content.blocks
    if part is not None:
        known = {name.lower(): list(numbers) for name, numbers in content.sets.items()}
        if part.lower() not in known:
            there = ", ".join(sorted(content.sets)) or "none"
            raise InputError(f'{path} has no set "{part}" of elements; it has {there}')
        inside = [np.isin(numbers, known[part.lower()]) for *_, numbers in blocks]
        blocks = [(shape, nodes[m], numbers[m]) for (shape, nodes, numbers), m in zip(blocks, inside, strict=True)]
    for table in (_PLANAR, _SOLID):
        sides = [
            (nodes[:, (*side, side[-1])[:4]], numbers)
            for shape, nodes, numbers in blocks
            for side in table.get(shape, ())
            if len(nodes)
        ]
        if sides:
            faces, numbers = (np.concatenate(parts) for parts in zip(*sides, strict=True))
            break
    else:
        of_part = "" if part is None else f' in the set "{part}"'
        raise InputError(f"{path} has no triangles, quadrilaterals or solids{of_part}")
    if table is _PLANAR:
        return faces, numbers
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    free = np.sort(first[count == 1])
    return faces[free], numbers[free]


def _plane(points: FloatArray, faces: IntArray, path: Path) -> tuple[tuple[int, int], IntArray]:
    """Return the axes of the plane that is measured, and its faces; the log states which, if there are others."""
    corners, nodes = points[faces], points[np.unique(faces)]
    area = np.linalg.norm(np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]), axis=1) / 2
    reach, curved = _FLAT * float(np.ptp(nodes, axis=0).max()), np.ones(len(faces), dtype=bool)
    planes: list[tuple[float, int, float, IntArray]] = []
    for axis in range(3):
        across = np.flatnonzero(np.ptp(corners[..., axis], axis=1) <= reach)
        curved[across] = False
        height = corners[across, :, axis].mean(axis=1)
        order = np.argsort(height)
        groups = np.split(order, np.flatnonzero(np.diff(height[order]) > reach) + 1)
        planes += [(float(area[across[g]].sum()), axis, float(height[g].mean()), across[g]) for g in groups if len(g)]
    largest = max((plane[0] for plane in planes), default=0.0)
    if area[curved].sum() >= largest:
        centred = nodes - nodes.mean(axis=0)
        normal = np.linalg.svd(centred, full_matrices=False)[2][2]
        off, tilt = float(np.abs(centred @ normal).max()), float(np.degrees(np.arccos(np.abs(normal).max())))
        raise InputError(
            f"the mesh of {path} must lie on a plane across one of its axes, but most of it lies on one {tilt:.3g} "
            f"degrees from the nearest of these, with nodes up to {off:.4g} (in the file's unit) off its mean plane"
        )
    alike = [plane for plane in planes if plane[0] > _SAME * largest]
    _, axis, height, chosen = max(alike, key=lambda plane: plane[1:3])
    if len(chosen) < len(faces):
        which = "the largest" if len(alike) == 1 else "the largest and, of several as large, the farthest along"
        where = f"{'xyz'[axis]} = {height:.6g}"
        logger.warning(
            "%s: measured is its plane %s with %d of %d faces, %s", path, where, len(chosen), len(faces), which
        )
    return ((1, 2), (0, 2), (0, 1))[axis], np.sort(chosen)


_SAME = 0.999
"""Fraction of the largest plane's area from which another is as large: front and back of a plate (chosen)."""


def _triangles(places: FloatArray, faces: IntArray, numbers: IntArray) -> tuple[IntArray, IntArray]:
    """Split quadrilaterals (m, 4) along a diagonal within them, the shorter one, every other one of squares.

    A corner that is there twice makes a face a triangle.
    """
    both = faces[:, [[[0, 1, 2], [0, 2, 3]], [[1, 2, 3], [1, 3, 0]]]]
    area = _cross(places, both)
    worst = (np.sign(area[:, :1].sum(axis=2, keepdims=True)) * area).min(axis=2)
    length, other = np.linalg.norm(places[faces[:, :2]] - places[faces[:, 2:]], axis=2).T
    row = np.arange(len(faces))
    shorter = np.where(np.abs(length - other) < _FLAT * length, row % 2 == 1, other < length)
    swap = (faces[:, 2] != faces[:, 3]) & np.where(worst.min(axis=1) <= 0, worst[:, 1] > worst[:, 0], shorter)
    corners = both[row, swap.astype(int)].reshape(-1, 3)
    proper = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    return corners[proper], np.repeat(numbers, 2)[proper]


_FORMATS = {
    **{".msh": "gmsh", ".vtu": "vtu", ".vtk": "vtk", ".xdmf": "xdmf", ".mesh": "medit", ".avs": "avsucd"},
    **{".bdf": "nastran", ".nas": "nastran", ".fem": "nastran", ".vol": "netgen"},
}
"""Formats by the files' endings: those of meshio's that were tried with numpy 2 (med and cgns fail, some never end)."""
_NUMBERS = ("GlobalNodeId", "node_number", "node_id", "NodeId", "GlobalElementId", "element_number", "element_id")
"""Names under which VTK files keep labels: ParaView's of both, this package's own, and those of converters."""


def _read_meshio(path: Path) -> _File:
    """Read a file with meshio, and the labels that it leaves out."""
    kind = _FORMATS.get(path.suffix.lower())
    if kind is None:
        known = ", ".join([".inp", *_FORMATS])
        raise InputError(f'{path} has the ending "{path.suffix}"; meshes are read from {known}')
    if kind == "gmsh":
        with path.open("rb") as file:
            if not file.read(200).lstrip().startswith(b"$"):
                raise InputError(f"{path} is not a gmsh file: it does not begin with a section such as $MeshFormat")
        if (text := _read_gmsh(path)) is not None:
            return text
    reader = optional(f"meshio.{kind}", "fe")
    try:
        mesh = reader.read(str(path))
    except Exception as error:  # of meshio's readers any may come, from text that is no mesh
        raise InputError(f"{path} is not a readable mesh ({kind}: {first_line(error)})") from None
    points = np.zeros((len(mesh.points), 3))
    points[:, : np.shape(mesh.points)[1]] = mesh.points
    ends = np.cumsum([len(block.data) for block in mesh.cells])
    numbers, labels, numbering = _labels(kind, mesh, len(points), int(ends[-1]) if len(ends) else 0)
    by_block = np.split(labels, ends[:-1])
    sets: dict[str, Collection[int]] = {}
    for name, members in mesh.cell_sets.items():
        given = [part[np.isin(np.arange(len(part)), m)] for part, m in zip(by_block, members, strict=False)]
        sets[name] = np.concatenate(given)
    tags = {int(tag): name for name, (tag, dimension) in mesh.field_data.items() if int(dimension) == 2}
    for key in {"gmsh:physical", "nastran:ref", "medit:ref", "cell_tags"} & set(mesh.cell_data):
        values = np.concatenate(mesh.cell_data[key])
        for tag in np.unique(values):
            sets.setdefault(tags.get(int(tag), str(int(tag))), labels[values == tag])
    blocks = [
        (re.sub(r"\d+$", "", block.type), np.asarray(block.data, dtype=np.int64), part)
        for block, part in zip(mesh.cells, by_block, strict=False)
    ]
    fields = {key: np.asarray(x, dtype=np.float64) for key, x in mesh.point_data.items() if key not in _NUMBERS}
    return _File(points=points, numbers=numbers, blocks=blocks, sets=sets, fields=fields, numbering=numbering)


def _labels(kind: str, mesh: Any, nodes: int, cells: int) -> tuple[IntArray, IntArray, str]:
    """Return the labels of points and cells, and where they are from."""
    if hasattr(mesh, "points_id"):  # Nastran
        return np.asarray(mesh.points_id, dtype=np.int64), np.concatenate(mesh.cells_id), "labels of the file"
    first = 0 if kind in ("vtu", "vtk", "xdmf") else 1
    numbers, labels = np.arange(first, first + nodes), np.arange(first, first + cells)
    stated = f"counted from {first} in the order of the file, which has no labels that can be read"
    for name in _NUMBERS:
        if name in mesh.point_data:
            numbers, stated = np.asarray(mesh.point_data[name]).astype(np.int64).ravel(), f'point data "{name}"'
        if name in mesh.cell_data:
            labels = np.concatenate(mesh.cell_data[name]).astype(np.int64).ravel()
    return numbers, labels, stated


_GMSH = {
    **dict.fromkeys((2, 9, 20, 21), "triangle"),
    **dict.fromkeys((3, 10, 16, 36), "quad"),
    **dict.fromkeys((4, 11), "tetra"),
    **dict.fromkeys((5, 12, 17), "hexahedron"),
    **dict.fromkeys((6, 13, 18), "wedge"),
    **dict.fromkeys((7, 14, 19), "pyramid"),
}
"""Shapes of gmsh's numbers of element types, of first to third order (its manual, "Node ordering")."""


def _read_gmsh(path: Path) -> _File | None:
    """Read a gmsh file in text, versions 2 and 4.1, with its tags; None of one in binary."""
    lines = iter(path.read_text(encoding="utf-8", errors="replace").splitlines())
    version, names = 0.0, dict[tuple[int, int], str]()
    groups = dict[tuple[int, int], list[int]]()  # physical groups of the entities of version 4
    nodes, elements, sets = _Nodes(), _Elements(), dict[str, set[int]]()

    def rows(count: str | int) -> list[list[str]]:
        return [next(lines).split() for _ in range(int(count))]

    def add(kind: int, tag: int, corners: list[int], members: Sequence[int]) -> None:
        if (shape := _GMSH.get(kind)) is not None:
            elements.setdefault(shape, {})[tag] = corners[: _CORNERS[shape]]
            for group in members:
                sets.setdefault(names.get((2 if shape in _PLANAR else 3, group), str(group)), set()).add(tag)

    for line in lines:
        section = line.strip()
        if section == "$MeshFormat":
            number, is_binary, *_ = next(lines).split()
            version = float(number)
            if int(is_binary):
                return None
        elif section == "$PhysicalNames":
            for axis, number, *title in rows(next(lines)):
                names[int(axis), int(number)] = " ".join(title).strip('"')
        elif section == "$Entities":
            for dimension, count in enumerate(next(lines).split()):
                for entity, *about in rows(count):
                    at = 3 if dimension == 0 else 6
                    groups[dimension, int(entity)] = [abs(int(n)) for n in about[at + 1 : at + 1 + int(about[at])]]
        elif section == "$Nodes" and version < 4:
            nodes.update((int(label), [float(x) for x in place]) for label, *place in rows(next(lines)))
        elif section == "$Nodes":
            for _ in range(int(next(lines).split()[0])):
                count = next(lines).split()[3]
                labels = [int(label) for (label,) in rows(count)]
                nodes.update(
                    (label, [float(x) for x in place[:3]]) for label, place in zip(labels, rows(count), strict=True)
                )
        elif section == "$Elements" and version < 4:
            for row in rows(next(lines)):
                tag, kind, width, *rest = map(int, row)
                add(kind, tag, rest[width:], rest[: min(width, 1)])
        elif section == "$Elements":
            for _ in range(int(next(lines).split()[0])):
                level, tag, kind, many = map(int, next(lines).split())
                members = groups.get((level, tag), ())
                for row in rows(many):
                    tag, *corners = map(int, row)
                    add(kind, tag, corners, members)
    return _File.of(nodes, elements, sets)


_ELEMENT = re.compile(
    r"(?:(CPS|CPE|CPEG|CAX|CGAX|S|STRI|M3D|R3D|SFM3D|DC2D|DCAX|DS|AC2D|ACAX)|C3D|DC3D|AC3D|SC)(\d+)", re.IGNORECASE
)
"""Abaqus' elements that have faces: planar ones or solids; others (beams, springs, cohesive ones) are not read."""
_ABAQUS = {"3": "triangle", "6": "triangle", "65": "triangle", "4": "quad", "8": "quad", "9": "quad"}
_ABAQUS_SOLIDS = {
    **{"4": "tetra", "10": "tetra", "5": "pyramid", "13": "pyramid", "6": "wedge", "15": "wedge"},
    **dict.fromkeys(("8", "20", "27"), "hexahedron"),
}
"""Shapes by the number in an element's name, which is that of its nodes (STRI65: six, with five unknowns)."""
_GENERATED = {"NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM"}


def _read_abaqus(path: Path) -> _File:
    """Read nodes, elements and element sets of an input file, of its one part that has elements, or without parts."""
    parts, sets = dict[str, tuple[_Nodes, _Elements]](), dict[str, set[int]]()
    part = ""
    for keyword, options, rows in _abaqus_cards(path):
        nodes, elements = parts.setdefault(part, ({}, {}))
        if keyword in _GENERATED or (keyword == "NODE" and options.get("SYSTEM", "R").upper() != "R"):
            raise InputError(
                f"{path}: *{keyword} is not read: write nodes and elements out, in rectangular coordinates"
            )
        if keyword in ("PART", "END PART"):
            part = options.get("NAME", "")
        elif keyword == "INSTANCE" and any(float(x or 0) for row in rows for x in row):
            logger.warning("%s: the translation of an *INSTANCE is not applied: nodes lie as in their part", path)
        elif keyword == "NODE":
            for label, *place in rows:
                nodes[int(label)] = [float(x) if x else 0.0 for x in (*place[:3], "", "")[:3]]
        elif keyword == "ELEMENT":
            shape, cells = _abaqus_elements(options["TYPE"], rows)
            if shape is not None:
                elements.setdefault(shape, {}).update(cells)
                sets.setdefault(options.get("ELSET", ""), set()).update(cells)
        elif keyword == "ELSET":
            members = sets.setdefault(options["ELSET"], set())
            for row in rows:
                if "GENERATE" in options:
                    first, last, *step = map(int, filter(None, row))
                    members.update(range(first, last + 1, *step[:1]))
                else:
                    for name in filter(None, row):
                        members.update([int(name)] if name.isdigit() else sets.get(name, ()))
    meshed = {name: found for name, found in parts.items() if found[1]}
    if len(meshed) > 1:
        raise InputError(f"{path} has parts that number their nodes alike ({', '.join(meshed)}): write one of them")
    if not meshed:
        raise InputError(f"{path} has no elements that are read: plane ones, shells, membranes or solids")
    sets.pop("", None)
    return _File.of(*next(iter(meshed.values())), sets)


def _abaqus_elements(name: str, rows: Sequence[list[str]]) -> tuple[str | None, dict[int, list[int]]]:
    """Shape of a type of elements, None of one that is not read, and the corners of each by its label."""
    planar, size = found.groups() if (found := _ELEMENT.match(name)) else (None, "")
    if (shape := (_ABAQUS if planar else _ABAQUS_SOLIDS).get(size)) is None:
        return None, {}
    width = 1 + (6 if size == "65" else int(size))
    every = [int(number) for row in rows for number in filter(None, row)]
    if len(every) % width:
        raise InputError(f"elements of type {name} have {width - 1} nodes")
    return shape, {every[i]: every[i + 1 : i + 1 + _CORNERS[shape]] for i in range(0, len(every), width)}


def _abaqus_cards(path: Path) -> Iterator[tuple[str, dict[str, str], list[list[str]]]]:
    """Keyword, options and rows of data of every card of an Abaqus file, in its order, with included files."""
    text = re.sub(r"^\s*\*\*.*", "", regular(path).read_text(encoding="utf-8", errors="replace"), flags=re.MULTILINE)
    for card in re.split(r"^\s*\*", text, flags=re.MULTILINE)[1:]:
        (keyword, *given), *rows = (
            [entry.strip() for entry in line.split(",")] for line in card.splitlines() if line.strip()
        )
        options = {key.strip().upper(): value.strip() for key, _, value in (entry.partition("=") for entry in given)}
        if keyword.upper() == "INCLUDE":
            yield from _abaqus_cards(path.parent / options["INPUT"])
        else:
            yield keyword.upper(), options, rows
