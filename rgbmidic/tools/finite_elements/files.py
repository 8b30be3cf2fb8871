"""Finite-element meshes from files: the plane of them that is measured, as triangles."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from rgbmidic.arguments import checked
from rgbmidic.disk import require_regular_file
from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.mesh.outline_mesh import cross
from rgbmidic.settings import LENGTH_UNITS
from rgbmidic.tools.finite_elements.abaqus import read_abaqus
from rgbmidic.tools.finite_elements.gmsh import read_gmsh
from rgbmidic.tools.finite_elements.mesh import ROUNDING, FiniteElementMesh
from rgbmidic.tools.finite_elements.mesh_file import MeshContent
from rgbmidic.tools.finite_elements.meshio_formats import FORMATS, read_with_meshio
from rgbmidic.tools.finite_elements.nastran import read_nastran
from rgbmidic.tools.finite_elements.vtu import read_vtu
from rgbmidic.typing import FloatArray, IntArray

logger = logging.getLogger(__name__)

_PLANAR = {"triangle": ((0, 1, 2),), "quad": ((0, 1, 2, 3),)}
_SOLID = {
    "tetra": ((0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3)),
    "hexahedron": ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    "wedge": ((0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "pyramid": ((0, 1, 2, 3), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}
"""Corners of the sides of cells, in VTK's order, which all formats have here."""
_READERS: Mapping[str, Callable[[Path], MeshContent]] = {
    **{".inp": read_abaqus, ".msh": read_gmsh, ".vtu": read_vtu},
    **dict.fromkeys((".bdf", ".nas", ".fem"), read_nastran),
    **{ending: partial(read_with_meshio, kind=kind) for ending, kind in FORMATS.items()},
}


@checked
def read_mesh(path: Path | str, *, unit: str = "mm", part: str | None = None) -> FiniteElementMesh:
    r"""Read the planar part of a finite-element mesh.

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
        Only the elements of this set: an Abaqus element set, a gmsh physical group, a Nastran property. None: all.

    Returns
    -------
    FiniteElementMesh

    Raises
    ------
    InputError
        The file is missing, not readable, larger than what is read or at odds with itself (a number that is stated
        twice or not at all, elements that overlap); meshio is missing; or there is no plane.

    Examples
    --------
    >>> from pathlib import Path
    >>> from rgbmidic import read_mesh
    >>> text = "*NODE\n1, 0, 0\n2, 10, 0\n3, 0, 10\n*ELEMENT, TYPE=CPS3\n7, 1, 2, 3\n"
    >>> _ = Path("plate.inp").write_text(text)
    >>> mesh = read_mesh("plate.inp")
    >>> mesh.element_numbers.tolist(), mesh.areas.tolist()
    ([7], [50.0])
    >>> Path("plate.inp").unlink()
    """
    path = Path(path)
    if unit not in LENGTH_UNITS:
        raise InputError(f'the unit of {path} must be one of {", ".join(LENGTH_UNITS)}, not "{unit}"')
    try:
        if (reader := _READERS.get(path.suffix.lower())) is None:
            raise InputError(f'{path} has the ending "{path.suffix}"; meshes are read from {", ".join(_READERS)}')
        if not require_regular_file(path).exists():
            raise InputError(f"mesh file not found: {path}")
        content = reader(path)
    except RgbmidicError as error:
        raise InputError(str(error) if str(path) in str(error) else f"{path} is not a readable mesh: {error}") from None
    except Exception as error:  # the last resort: whatever a damaged file leads to is one line
        message = str(error) if isinstance(error, OSError) else str(error)[:120]  # the latter may quote the file
        raise InputError(f"{path} is not a readable mesh: {message or 'it ends early'}") from None
    faces, numbers = _faces(content, path, part)
    axes, selected = _select_plane(content.points, faces, path)
    corners, numbers = _triangles(content.points[:, axes], faces[selected], numbers[selected], path)
    used_nodes, index = np.unique(corners, return_inverse=True)
    mesh = FiniteElementMesh(
        name=str(path),
        points=content.points[used_nodes][:, axes] * LENGTH_UNITS[unit],
        node_numbers=content.numbers[used_nodes],
        elements=index.reshape(-1, 3).astype(np.int32),
        element_numbers=numbers,
        fields={key: values[used_nodes] for key, values in content.fields.items()},
        axes=axes,
        unit_mm=LENGTH_UNITS[unit],
        numbering=content.numbering,
    )
    if (overlapping := mesh.overlap()) is not None:
        raise InputError(
            f"elements {overlapping[0]} and {overlapping[1]} of {path} overlap: measure one set of them (mesh.part)"
        )
    return mesh


def _faces(content: MeshContent, path: Path, element_set: str | None) -> tuple[IntArray, IntArray]:
    """Return the corners (m, 4) of the faces, a triangle's last one twice, and their elements' numbers (m,)."""
    blocks = content.blocks
    if element_set is not None:
        matches = [name for name in content.sets if name.lower() == element_set.lower()]
        if element_set not in matches and len(matches) != 1:
            available = ", ".join(sorted(matches or content.sets)) or "none"
            raise InputError(f'{path} has no set "{element_set}" of elements; it has {available}')
        members = content.sets[element_set if element_set in matches else matches[0]]
        is_member = [np.isin(numbers, list(members)) for *_, numbers in blocks]
        blocks = [(shape, nodes[m], numbers[m]) for (shape, nodes, numbers), m in zip(blocks, is_member, strict=True)]
    for table in (_PLANAR, _SOLID):
        sides = [
            (nodes[:, (*side, side[-1])[:4]], numbers)
            for shape, nodes, numbers in blocks
            for side in table.get(shape, ())
            if len(nodes)
        ]
        if sides:
            faces, numbers = (np.concatenate(arrays) for arrays in zip(*sides, strict=True))
            break
    else:
        set_note = "" if element_set is None else f' in the set "{element_set}"'
        raise InputError(f"{path} has no triangles, quadrilaterals or solids{set_note}")
    omitted = {*content.unread, *(shape for shape, nodes, _ in blocks if shape not in table and len(nodes))}
    if omitted:
        logger.warning("%s: elements are left out: %s", path, ", ".join(sorted(omitted)))
    if table is _PLANAR:
        return faces, numbers
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    if count.max() > 2 or not (count == 1).any():
        raise InputError(f"the solids of {path} overlap, element {numbers[first[count.argmax()]]} among them")
    free = np.sort(first[count == 1])
    return faces[free], numbers[free]


def _select_plane(points: FloatArray, faces: IntArray, path: Path) -> tuple[tuple[int, int], IntArray]:
    """Return the axes of the plane that is measured, and its faces; the log states which, if there are others."""
    corners, nodes = points[faces], points[np.unique(faces)]
    area = np.linalg.norm(np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]), axis=1) / 2
    tolerance, is_oblique = ROUNDING * float(np.ptp(nodes, axis=0).max()), np.ones(len(faces), dtype=bool)
    planes: list[tuple[float, int, float, IntArray]] = []
    for axis in range(3):
        in_plane = np.flatnonzero(np.ptp(corners[..., axis], axis=1) <= tolerance)
        is_oblique[in_plane] = False
        height = corners[in_plane, :, axis].mean(axis=1)
        order = np.argsort(height)
        groups = np.split(order, np.flatnonzero(np.diff(height[order]) > tolerance) + 1)
        planes += [
            (float(area[in_plane[g]].sum()), axis, float(height[g].mean()), in_plane[g]) for g in groups if len(g)
        ]
    largest = max((plane[0] for plane in planes), default=0.0)
    if area[is_oblique].sum() >= largest:
        centred = nodes - nodes.mean(axis=0)
        normal = np.linalg.svd(centred, full_matrices=False)[2][2]
        deviation, tilt = float(np.abs(centred @ normal).max()), float(np.degrees(np.arccos(np.abs(normal).max())))
        raise InputError(
            f"the mesh of {path} must lie on a plane across one of its axes, but most of it lies on one {tilt:.3g} "
            f"degrees from the nearest of these, with nodes up to {deviation:.4g} (in the file's unit) off its mean "
            "plane"
        )
    candidates = [plane for plane in planes if plane[0] > 0.999 * largest]  # front and back of a plate
    _, axis, height, selected = max(candidates, key=lambda plane: plane[1:3])
    if len(selected) < len(faces):
        reason = "the largest" if len(candidates) == 1 else "the largest and, of several as large, the farthest along"
        position = f"{'xyz'[axis]} = {height:.6g}"
        logger.warning(
            "%s: measured is its plane %s with %d of %d faces, %s", path, position, len(selected), len(faces), reason
        )
    return ((1, 2), (0, 2), (0, 1))[axis], np.sort(selected)


def _triangles(points: FloatArray, faces: IntArray, numbers: IntArray, path: Path) -> tuple[IntArray, IntArray]:
    """Split quadrilaterals (m, 4) along a diagonal within them, the shorter one, every other one of squares.

    A corner that is there twice makes a face a triangle.
    """
    splits = faces[:, [[[0, 1, 2], [0, 2, 3]], [[1, 2, 3], [1, 3, 0]]]]
    area = cross(points, splits)
    worst = (np.sign(area[:, :1].sum(axis=2, keepdims=True)) * area).min(axis=2)
    length, other_length = np.linalg.norm(points[faces[:, :2]] - points[faces[:, 2:]], axis=2).T
    row = np.arange(len(faces))
    shorter = np.where(np.abs(length - other_length) < ROUNDING * length, row % 2 == 1, other_length < length)
    swap = (faces[:, 2] != faces[:, 3]) & np.where(worst.min(axis=1) <= 0, worst[:, 1] > worst[:, 0], shorter)
    corners = splits[row, swap.astype(int)].reshape(-1, 3)
    proper = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    if not (has_area := proper.reshape(-1, 2).any(axis=1)).all():
        raise InputError(
            f"element {numbers[~has_area][0]} of {path} has no area: its corners are fewer than three nodes"
        )
    return corners[proper], np.repeat(numbers, 2)[proper]
