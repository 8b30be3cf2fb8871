"""Finite-element meshes from files (Abaqus, gmsh, Nastran, VTU and more), and where they lie on the image.

meshio reads all formats but two: of Abaqus' it keeps neither the labels nor more than the last ``*NODE`` block, of
gmsh's no labels, and with numpy 2 it fails on some. A placement is a similarity of the mesh's plane to the image, or
a rigid motion of it to the plane of a calibrated camera, fitted to pairs of points (Umeyama, IEEE Transactions on
Pattern Analysis and Machine Intelligence 13, 1991).
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
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
        Labels of the elements in the file that the triangles are from.
    fields : mapping of str to ndarray, shape (N, ...)
        Nodal data of the file (none of Abaqus and of gmsh in text), in its own unit and components: a vector's
        component along x is ``[:, axes[0]]``.
    axes : tuple of int
        Which coordinates (0, 1, 2) of the file are x and y.
    unit_mm : float
        Millimetres in a length of 1 of the file, which a displacement in `fields` is multiplied with.
    numbering : str
        Where the numbers are from, in words.
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
    """Where a mesh in mm lies on the image.

    Attributes
    ----------
    matrix : ndarray, shape (2, 2)
        From the mesh's mm to px, or to mm on the camera's plane where there is a `camera`.
    shift : ndarray, shape (2,)
        Where the mesh's origin lies, in the same unit.
    camera
        Lens and plane; None: the image is a similarity of the mesh.
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
        decide, the mesh's y axis points up (and the image's down). The log states a doubt, and a pair that is farther
        from where the others place it than their residuals explain.

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
            distance = np.hypot(*(part[:, None] - part[None]).transpose(2, 0, 1)) + np.diag(np.full(len(part), np.inf))
            if not distance.min() > 0:
                raise InputError(f"{where}: pairs {np.argwhere(distance == 0)[0].tolist()} are one point {what}")
        up, down = (cls._fitted(given, camera, reflected) for reflected in (True, False))
        rms_up, rms_down = up.rms, down.rms
        if len(given) == 2:
            up._report_residuals(where)
            return up
        if max(rms_up, rms_down) < _DECIDED * max(min(rms_up, rms_down), _POINTING):
            logger.warning(
                "%s does not decide whether the image shows the mesh or its mirror image (residuals of %.2g px with "
                "its y axis up, %.2g px with it down): up is taken; add a pair off the line of the others",
                where,
                rms_up,
                rms_down,
            )
            best = up
        else:
            best = min(up, down, key=lambda one: one.rms)
        best._report_residuals(where)
        best._report_outlier(where)
        return best

    @classmethod
    def _fitted(cls, pairs: FloatArray, camera: Plane | None, reflected: bool) -> Self:
        """Fit one of both senses of rotation, in complex numbers: ``w = a z + b`` of z or its conjugate."""
        image = pairs[:, 2:] if camera is None else camera.to_mm(pairs[:, 2:])
        sign = -1.0 if reflected else 1.0
        z, w = pairs[:, 0] + sign * 1j * pairs[:, 1], image[:, 0] + 1j * image[:, 1]
        a = np.vdot(z - z.mean(), w - w.mean()) / np.vdot(z - z.mean(), z - z.mean())
        if camera is not None:
            stretch = float(np.std(w) / np.std(z))
            if not 1 / _STRETCHED < stretch < _STRETCHED:
                raise InputError(
                    f"the pairs of mesh.points lie {stretch:.4g} times as far apart on the camera's plane as on the "
                    "mesh, where both are in mm: look at mesh.unit, the points and the calibration"
                )
            a /= abs(a)
        b = w.mean() - a * z.mean()
        matrix = np.array([[a.real, -sign * a.imag], [a.imag, sign * a.real]])
        return cls(matrix=matrix, shift=np.array([b.real, b.imag]), camera=camera, pairs=pairs)

    def _report_residuals(self, where: str) -> None:
        """Warn of residuals that are more than those of points set by hand."""
        if self.rms > _DECIDED * _POINTING:
            each = ", ".join(f"{length:.1f}" for length in np.hypot(*self.residuals.T))
            logger.warning("%s leaves residuals of %.1f px rms (its pairs: %s px)", where, self.rms, each)

    def _report_outlier(self, where: str) -> None:
        """Warn of the pair that lies farthest from where the others place it, if they do not explain it.

        The squared distance over the variance of the others' residuals is a quantile of Fisher's distribution (Cook and
        Weisberg, Residuals and Influence in Regression, 1982, section 2.2.2).
        """
        from scipy.stats import f as fisher

        free = 2 * (len(self.pairs) - 1) - (3 if self.camera is not None else 4)
        if free < 1:
            return
        reflected = self.reflected
        worst, largest = 0, 0.0
        for number in range(len(self.pairs)):
            others = np.delete(self.pairs, number, axis=0)
            fit = self._fitted(others, self.camera, reflected)
            centre = others[:, :2].mean(axis=0)
            spread = ((others[:, :2] - centre) ** 2).sum()
            leverage = 1 + 1 / len(others) + ((self.pairs[number, :2] - centre) ** 2).sum() / spread
            off = fit.to_px(self.pairs[number : number + 1, :2])[0] - self.pairs[number, 2:]
            variance = max(float((fit.residuals**2).sum()) / free, _POINTING**2)
            excess = float((off**2).sum() / (2 * variance * leverage))
            if excess > largest:
                worst, largest, distance = number, excess, float(np.hypot(*off))
        if fisher.sf(largest, 2, free) < _UNLIKELY / len(self.pairs):
            logger.warning(
                "%s[%d] = %s lies %.1f px from where the other pairs place it, which their residuals do not explain: "
                "check it",
                where,
                worst,
                self.pairs[worst].tolist(),
                distance,
            )

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

    @property
    def axes(self) -> FloatArray:
        """The mesh's axes (2, 2), row by row, in those of the image, or of the camera's plane: an orthogonal matrix Q.

        A tensor T, such as a strain, of those axes is ``Q @ T @ Q.T`` in the mesh's.
        """
        back = np.linalg.inv(self.matrix)
        return np.asarray(back / np.sqrt(abs(np.linalg.det(back))))

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
_UNLIKELY = 0.01
"""Probability of naming any pair as an outlier where none is one (chosen)."""


def _cross(points: FloatArray, elements: npt.NDArray[np.integer]) -> FloatArray:
    """Twice the signed area (E,) of triangles."""
    first, second = (points[elements[:, corner]] - points[elements[:, 0]] for corner in (1, 2))
    return np.asarray(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Block:
    """Cells of one shape: their nodes (m, k) as indices of points, and their numbers (m,)."""

    kind: str
    nodes: IntArray
    numbers: IntArray
    sets: Mapping[str, BoolArray] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class _File:
    """What a file holds."""

    points: FloatArray
    numbers: IntArray
    blocks: Sequence[_Block]
    fields: Mapping[str, FloatArray] = field(default_factory=dict)
    numbering: str = "labels of the file"


_SIDES: dict[str, tuple[tuple[int, ...], ...]] = {
    "tetra": ((0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3)),
    "hexahedron": ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    "wedge": ((0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "pyramid": ((0, 1, 2, 3), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}
"""Corners of the sides of solids, in VTK's order, which meshio has for all formats and Abaqus' own is."""
_CORNERS = {"triangle": 3, "quad": 4, "tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}


def read_mesh(path: Path | str, *, unit: str = "mm", part: str | None = None) -> FiniteElementMesh:
    """Read the planar part of a finite-element mesh.

    Shells and plane elements are taken, or where there are none the free faces of solids. Of several planes across an
    axis of the file the one with the largest area is measured, and of equal ones that with the largest coordinate; the
    log states what was left out.

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
        present = regular(path).is_file()
    except OSError as error:
        raise InputError(f"mesh file {path}: {error}") from None
    if not present:
        raise InputError(f"mesh file not found: {path}")
    try:
        content = _read_abaqus(path) if path.suffix.lower() == ".inp" else _read_meshio(path)
    except RgbmidicError as error:
        raise InputError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
    except (ValueError, KeyError, IndexError, AssertionError, OSError, EOFError) as error:
        raise InputError(f"{path} is not a readable mesh: {error}") from None
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
    names = sorted({name for block in content.blocks for name in block.sets})
    blocks = list(content.blocks)
    if part is not None:
        known = {name.lower(): name for name in names}
        if part.lower() not in known:
            raise InputError(f'{path} has no set "{part}" of elements; it has {", ".join(names) or "none"}')
        inside = [block.sets.get(known[part.lower()], np.zeros(len(block.nodes), dtype=bool)) for block in blocks]
        blocks = [
            _Block(kind=block.kind, nodes=block.nodes[mask], numbers=block.numbers[mask])
            for block, mask in zip(blocks, inside, strict=True)
        ]
    flat = [block for block in blocks if block.kind in ("triangle", "quad") and len(block.nodes)]
    solid = [block for block in blocks if block.kind in _SIDES and len(block.nodes)]
    if flat:
        sides = [(block.nodes[:, (0, 1, 2, 2) if block.kind == "triangle" else (0, 1, 2, 3)], block) for block in flat]
    elif solid:
        sides = [(block.nodes[:, (*side, side[-1])[:4]], block) for block in solid for side in _SIDES[block.kind]]
    else:
        of_part = "" if part is None else f' in the set "{part}"'
        raise InputError(f"{path} has no triangles, quadrilaterals or solids{of_part}")
    faces = np.concatenate([corners for corners, _ in sides])
    numbers = np.concatenate([block.numbers for _, block in sides])
    if flat:
        return faces, numbers
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    free = np.sort(first[count == 1])
    return faces[free], numbers[free]


def _plane(points: FloatArray, faces: IntArray, path: Path) -> tuple[tuple[int, int], IntArray]:
    """Return the axes of the plane that is measured, and its faces; the log states which, if there are others."""
    corners = points[faces]
    area = np.linalg.norm(np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]), axis=1) / 2
    reach = _FLAT * float(np.ptp(points[np.unique(faces)], axis=0).max())
    planes: list[tuple[float, int, float, IntArray]] = []
    for axis in range(3):
        across = np.flatnonzero(np.ptp(corners[..., axis], axis=1) <= reach)
        height = corners[across, :, axis].mean(axis=1)
        order = np.argsort(height)
        groups = np.split(order, np.flatnonzero(np.diff(height[order]) > reach) + 1)
        planes += [(float(area[across[g]].sum()), axis, float(height[g].mean()), across[g]) for g in groups if len(g)]
    largest = max((plane[0] for plane in planes), default=0.0)
    curved = np.setdiff1d(np.arange(len(faces)), np.concatenate([np.empty(0, dtype=int), *(p[3] for p in planes)]))
    if float(area[curved].sum()) > largest or largest <= 0:
        nodes = points[np.unique(faces[curved])] if len(curved) else points
        centred = nodes - nodes.mean(axis=0)
        normal = np.linalg.svd(centred, full_matrices=False)[2][2]
        off, tilt = float(np.abs(centred @ normal).max()), float(np.degrees(np.arccos(np.abs(normal).max())))
        shape = (
            f"lies on a plane {tilt:.3g} degrees from the nearest across an axis: turn it in its program"
            if off <= reach
            else f"is not planar: nodes lie up to {off:.4g} (in the file's unit) off its mean plane"
        )
        raise InputError(f"the mesh of {path} must lie on a plane across one of its axes, but most of it {shape}")
    _, axis, height, chosen = max((p for p in planes if p[0] > _SAME * largest), key=lambda plane: plane[1:3])
    if len(chosen) < len(faces):
        logger.warning(
            "%s: measured is its plane %s = %.6g with %d of %d faces, the largest%s",
            path,
            "xyz"[axis],
            height,
            len(chosen),
            len(faces),
            "" if sum(p[0] > _SAME * largest for p in planes) == 1 else " and, of several as large, the farthest along",
        )
    return ((1, 2), (0, 2), (0, 1))[axis], np.sort(chosen)


_SAME = 0.999
"""Fraction of the largest plane's area from which another is as large: front and back of a plate (chosen)."""


def _triangles(places: FloatArray, faces: IntArray, numbers: IntArray) -> tuple[IntArray, IntArray]:
    """Split quadrilaterals (m, 4) along a diagonal within them, the shorter one, every other one of squares.

    A corner that is there twice makes a face a triangle.
    """

    def split(first: int) -> tuple[IntArray, FloatArray]:
        both = np.stack([np.roll(faces, -first, axis=1)[:, k] for k in ([0, 1, 2], [0, 2, 3])], axis=1)
        return both, np.stack([_cross(places, both[:, k]) for k in (0, 1)], axis=1)

    (one, area), (other, other_area) = split(0), split(1)
    turn = np.sign(area.sum(axis=1))[:, None]
    worst, other_worst = ((turn * part).min(axis=1) for part in (area, other_area))
    length, other_length = (np.hypot(*(places[faces[:, k]] - places[faces[:, k + 2]]).T) for k in (0, 1))
    near = np.abs(length - other_length) < _FLAT * length
    shorter = np.where(near, np.arange(len(faces)) % 2 == 1, other_length < length)
    swap = (faces[:, 2] != faces[:, 3]) & np.where(np.minimum(worst, other_worst) <= 0, other_worst > worst, shorter)
    corners = np.where(swap[:, None, None], other, one).reshape(-1, 3)
    labels = np.repeat(numbers, 2)
    proper = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    return corners[proper], labels[proper]


_FORMATS = {
    ".msh": "gmsh",
    ".vtu": "vtu",
    ".vtk": "vtk",
    ".bdf": "nastran",
    ".nas": "nastran",
    ".fem": "nastran",
    ".xdmf": "xdmf",
    ".mesh": "medit",
    ".avs": "avsucd",
    ".vol": "netgen",
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
    sizes = [len(block.data) for block in mesh.cells]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    numbers, labels, numbering = _labels(kind, mesh, len(points), int(starts[-1]))
    sets: dict[str, list[BoolArray]] = {}
    for name, members in mesh.cell_sets.items():
        sets[name] = [np.isin(np.arange(size), np.asarray(m)) for size, m in zip(sizes, members, strict=False)]
    tags = {int(tag): name for name, (tag, dimension) in mesh.field_data.items() if int(dimension) == 2}
    for key in ("gmsh:physical", "nastran:ref", "medit:ref", "cell_tags"):
        for tag in np.unique(np.concatenate(mesh.cell_data[key])) if key in mesh.cell_data else ():
            name = tags.get(int(tag), str(int(tag)))
            sets.setdefault(name, [np.asarray(block) == tag for block in mesh.cell_data[key]])
    blocks = [
        _Block(
            kind=re.sub(r"\d+$", "", block.type),
            nodes=np.asarray(block.data, dtype=np.int64),
            numbers=labels[starts[i] : starts[i + 1]],
            sets={name: masks[i] for name, masks in sets.items() if len(masks) == len(sizes)},
        )
        for i, block in enumerate(mesh.cells)
        if len(block.data)
    ]
    fields = {
        key: np.asarray(values, dtype=np.float64) for key, values in mesh.point_data.items() if key not in _NUMBERS
    }
    return _File(points=points, numbers=numbers, blocks=blocks, fields=fields, numbering=numbering)


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


def _read_gmsh(path: Path) -> _File | None:
    """Read a gmsh file in text, versions 2 and 4, which numpy 2 keeps meshio from; None of one in binary."""
    lines = iter(path.read_text(encoding="utf-8", errors="replace").splitlines())
    version, names = 0.0, dict[tuple[int, int], str]()
    groups = dict[tuple[int, int], list[int]]()  # physical groups of the entities of version 4
    nodes = dict[int, list[float]]()
    cells = dict[str, list[tuple[int, list[int], list[tuple[int, int]]]]]()

    def add(kind: int, tag: int, corners: Sequence[int], member: list[tuple[int, int]]) -> None:
        if kind in _GMSH:
            shape = _GMSH[kind]
            cells.setdefault(shape, []).append((tag, list(corners[: _CORNERS[shape]]), member))

    for line in lines:
        section = line.strip()
        if section == "$MeshFormat":
            number, is_binary, *_ = next(lines).split()
            version = float(number)
            if int(is_binary):
                return None
        elif section == "$PhysicalNames":
            for _ in range(int(next(lines))):
                axis, number, title = next(lines).split(maxsplit=2)
                names[int(axis), int(number)] = title.strip().strip('"')
        elif section == "$Entities":
            for dimension, count in enumerate(map(int, next(lines).split())):
                for _ in range(count):
                    entity, *about = next(lines).split()
                    at = 3 if dimension == 0 else 6
                    groups[dimension, int(entity)] = [abs(int(n)) for n in about[at + 1 : at + 1 + int(about[at])]]
        elif section == "$Nodes" and version < 4:
            for _ in range(int(next(lines))):
                label, *place = next(lines).split()
                nodes[int(label)] = [float(x) for x in place]
        elif section == "$Nodes":
            for _ in range(int(next(lines).split()[0])):
                count = int(next(lines).split()[3])
                labels = [int(next(lines)) for _ in range(count)]
                nodes.update((label, [float(x) for x in next(lines).split()[:3]]) for label in labels)
        elif section == "$Elements" and version < 4:
            for _ in range(int(next(lines))):
                tag, kind, width, *rest = map(int, next(lines).split())
                add(kind, tag, rest[width:], [(-1, rest[0])] if width else [])
        elif section == "$Elements":
            for _ in range(int(next(lines).split()[0])):
                level, entity_tag, kind, count = map(int, next(lines).split())
                member = [(level, group) for group in groups.get((level, entity_tag), ())]
                for _ in range(count):
                    tag, *corners = map(int, next(lines).split())
                    add(kind, tag, corners, member)
    index = {label: i for i, label in enumerate(nodes)}
    blocks = []
    for shape, every in cells.items():
        sets: dict[str, BoolArray] = {}
        for row, (_, _, member) in enumerate(every):
            for dimension, group in member:
                flat = 2 if shape in ("triangle", "quad") else 3
                name = names.get((flat if dimension < 0 else dimension, group), str(group))
                sets.setdefault(name, np.zeros(len(every), dtype=bool))[row] = True
        connected = np.array([[index[node] for node in corners] for _, corners, _ in every])
        blocks.append(_Block(kind=shape, nodes=connected, numbers=np.array([tag for tag, _, _ in every]), sets=sets))
    return _File(points=np.array(list(nodes.values())), numbers=np.array(list(nodes)), blocks=blocks)


_GMSH = {
    **dict.fromkeys((2, 9, 20, 21), "triangle"),
    **dict.fromkeys((3, 10, 16, 36), "quad"),
    **dict.fromkeys((4, 11), "tetra"),
    **dict.fromkeys((5, 12, 17), "hexahedron"),
    **dict.fromkeys((6, 13, 18), "wedge"),
    **dict.fromkeys((7, 14, 19), "pyramid"),
}
"""Shapes of gmsh's numbers of element types, of first to third order (its manual, "Node ordering")."""
_PLANES = {
    "CPS",
    "CPE",
    "CPEG",
    "CAX",
    "CGAX",
    "S",
    "STRI",
    "M3D",
    "R3D",
    "SFM3D",
    "DC2D",
    "DCAX",
    "DS",
    "AC2D",
    "ACAX",
}
_SOLIDS = {"C3D", "DC3D", "AC3D", "SC"}
"""Families of Abaqus' elements that have faces; the others (beams, springs, cohesive ones) are not read."""
_ABAQUS = {
    **dict.fromkeys(("3", "6", "65"), "triangle"),
    **dict.fromkeys(("4", "8", "9"), "quad"),
}
_ABAQUS_SOLIDS = {
    **dict.fromkeys(("4", "10"), "tetra"),
    **dict.fromkeys(("5", "13"), "pyramid"),
    **dict.fromkeys(("6", "15"), "wedge"),
    **dict.fromkeys(("8", "20", "27"), "hexahedron"),
}
"""Shapes by the number in an element's name, which is that of its nodes (STRI65: six, with five unknowns)."""
_GENERATED = {"NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM"}


def _read_abaqus(path: Path) -> _File:
    """Read nodes, elements and element sets of an input file, of its one part that has elements, or without parts."""
    scopes: dict[str, _Scope] = {}
    part = ""
    for keyword, options, rows in _abaqus_cards(path):
        if keyword in _GENERATED or (keyword == "NODE" and options.get("SYSTEM", "R").upper() != "R"):
            raise InputError(
                f"{path}: *{keyword} is not read: write nodes and elements out, in rectangular coordinates"
            )
        if keyword == "PART":
            part = options["NAME"]
        elif keyword == "END PART":
            part = ""
        elif keyword in ("NODE", "ELEMENT", "ELSET"):
            scopes.setdefault(part, _Scope()).take(keyword, options, rows)
    meshed = {name: scope for name, scope in scopes.items() if scope.elements}
    if len(meshed) > 1:
        raise InputError(f"{path} has parts that number their nodes alike ({', '.join(meshed)}): write one of them")
    if not meshed:
        raise InputError(f"{path} has no elements that are read: plane ones, shells, membranes or solids")
    return next(iter(meshed.values())).content()


class _Scope:
    """Nodes, elements and sets of a part of an Abaqus file while it is read."""

    def __init__(self) -> None:
        self.nodes: dict[int, list[float]] = {}
        self.elements: dict[str, dict[int, list[int]]] = {}
        self.sets: dict[str, set[int]] = {}

    def take(self, keyword: str, options: Mapping[str, str], rows: Sequence[list[str]]) -> None:
        """Add what one keyword's rows state."""
        if keyword == "NODE":
            for label, *place in rows:
                self.nodes[int(label)] = [float(x) if x else 0.0 for x in (*place[:3], "", "")[:3]]
        elif keyword == "ELSET":
            given = self.sets.setdefault(options["ELSET"], set())
            for row in rows:
                if "GENERATE" in options:
                    first, last, *step = map(int, filter(None, row))
                    given.update(range(first, last + 1, *step[:1]))
                else:
                    for name in filter(None, row):
                        given.update([int(name)] if name.isdigit() else self.sets.get(name, ()))
        else:
            found = re.match(r"([A-Z]+?(?:[23]D)?)(\d+)", options["TYPE"].upper())
            family, size = found.groups() if found else ("", "")
            shapes = _ABAQUS if family in _PLANES else _ABAQUS_SOLIDS if family in _SOLIDS else {}
            if size not in shapes:
                return
            width = 1 + (6 if size == "65" else int(size))
            every = [int(number) for row in rows for number in filter(None, row)]
            if len(every) % width:
                raise InputError(f"elements of type {options['TYPE']} have {width - 1} nodes")
            labels = every[::width]
            kept = self.elements.setdefault(shapes[size], {})
            kept.update((every[i], every[i + 1 : i + width]) for i in range(0, len(every), width))
            if "ELSET" in options:
                self.sets.setdefault(options["ELSET"], set()).update(labels)

    def content(self) -> _File:
        """Return all of it with nodes as indices."""
        index = {label: i for i, label in enumerate(self.nodes)}
        blocks = []
        for kind, elements in self.elements.items():
            corners = _CORNERS[kind]
            for label, nodes in elements.items():
                if lost := [node for node in nodes[:corners] if node not in index]:
                    raise InputError(f"element {label} has node {lost[0]}, which the file does not state")
            numbers = np.array(list(elements), dtype=np.int64)
            blocks.append(
                _Block(
                    kind=kind,
                    nodes=np.array([[index[node] for node in nodes[:corners]] for nodes in elements.values()]),
                    numbers=numbers,
                    sets={name: np.isin(numbers, list(labels)) for name, labels in self.sets.items()},
                )
            )
        return _File(
            points=np.array(list(self.nodes.values()), dtype=np.float64),
            numbers=np.array(list(self.nodes), dtype=np.int64),
            blocks=blocks,
        )


def _abaqus_cards(path: Path) -> Iterator[tuple[str, dict[str, str], list[list[str]]]]:
    """Keyword, options and rows of data of every card of an Abaqus file, in its order, with included files."""
    card: tuple[str, dict[str, str], list[list[str]]] | None = None
    for line in regular(path).read_text(encoding="utf-8", errors="replace").splitlines():
        text = line.strip()
        if not text or text.startswith("**"):
            continue
        if not text.startswith("*"):
            if card is not None:
                card[2].append([entry.strip() for entry in text.split(",")])
            continue
        if card is not None:
            yield card
        keyword, *given = (entry.strip() for entry in text[1:].split(","))
        options = {key.strip().upper(): value.strip() for key, _, value in (entry.partition("=") for entry in given)}
        card = keyword.upper(), options, []
        if keyword.upper() == "INCLUDE":
            yield from _abaqus_cards(path.parent / options["INPUT"])
            card = None
    if card is not None:
        yield card
