"""A finite-element result that a measurement is compared with, read from files, and levelled.

Levelling applies the fit and the recovery of a measurement's mesh to a simulated displacement.
"""

from __future__ import annotations

import csv
import logging
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from rgbmidic.disk import require_regular_file
from rgbmidic.errors import InputError
from rgbmidic.fields.interpolation import MeshPoints
from rgbmidic.frames.names import NamedFiles
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.recovery import Recovery
from rgbmidic.renamed import refuse_old_names, state_new_names
from rgbmidic.results.result import Result
from rgbmidic.results.result_in_units import rectification_of
from rgbmidic.settings import LENGTH_UNITS, ScaleSettings
from rgbmidic.tools.finite_elements.files import read_mesh
from rgbmidic.tools.finite_elements.mesh import FiniteElementMesh
from rgbmidic.tools.finite_elements.mesh_source import placement_of
from rgbmidic.tools.finite_elements.placement import Placement
from rgbmidic.typing import BoolArray, FloatArray, IntArray

logger = logging.getLogger(__name__)

_FIELDS = ("displacement", "displacements", "u", "disp")
"""Names, in small letters, under which a displacement is written: by ParaView and CalculiX, by Abaqus, by others."""
_COMPONENTS = tuple(
    re.compile(rf"(?:{name})(?:_(mm|m|um|inch))?", re.IGNORECASE) for name in ("u|u_?[x1]", "v|u_?[y2]")
)
"""Names of the columns of a table: the displacement along the first and the second axis, and its unit."""
_TIMES = {"time": 1.0, "time_s": 1.0, "time_ms": 1e-3, "time_us": 1e-6}


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Simulation:
    """Displacement that a simulation has at its nodes, over time.

    Attributes
    ----------
    mesh
        Its mesh.
    displacement : ndarray, shape (S, M, 2)
        Of S states, in mm along the mesh's axes; NaN where a table has no row for a node.
    times : ndarray, shape (S,), or None
        In seconds (or in frames, where these have no times), rising; None for one state without a time.
    name : str
        The file or folder, for messages.

    Examples
    --------
    >>> mesh = FiniteElementMesh(
    ...     name="plate",
    ...     points=np.array([[0, 0], [10, 0], [10, 8], [0, 8]]),
    ...     node_numbers=np.array([1, 2, 3, 4]),
    ...     elements=np.array([[0, 1, 2], [0, 2, 3]]),
    ...     element_numbers=np.array([11, 12]),
    ... )
    >>> Simulation(mesh=mesh, displacement=np.zeros((1, 4, 2))).interpolate(0.0).shape
    (4, 2)
    """

    mesh: FiniteElementMesh
    displacement: FloatArray
    times: FloatArray | None = None
    name: str = "simulation"

    @classmethod
    def read(
        cls,
        path: Path | str,
        *,
        mesh: FiniteElementMesh | None = None,
        unit: str = "mm",
        field: str | None = None,
        interval: float | None = None,
        offset: float = 0.0,
    ) -> Self:
        """Read a simulation.

        Parameters
        ----------
        path
            One state as a mesh file with a nodal displacement (such as ``.vtu``); a ``.pvd`` that names such files with
            their times, or a folder with one; a folder of such files, whose last number counts them; or a ``.csv``
            with the columns ``node``, ``u``, ``v`` and, of several states, ``time_s``.
        mesh
            Of the nodes of a ``.csv``.
        unit
            Unit of length of the files.
        field
            Name of the displacement in the files; None: the first of displacement, u, disp.
        interval
            Time between the numbers of the files of a folder.
        offset
            Added to the simulation's times.

        Raises
        ------
        InputError
            A file is missing, not readable, or has no displacement; its nodes differ from the first one's; the times do
            not rise.
        """
        path = Path(path)
        table = path.suffix.lower() == ".csv"
        if interval is not None and not path.is_dir():
            raise InputError(f"`interval` is the time between the files of a folder, and {path} is none")
        if field is not None and table:
            raise InputError(f"`field` names a field of a mesh file; the columns of {path} have names of their own")
        if table:
            if mesh is None:
                raise InputError(f"{path} has numbers of nodes only: state the `mesh` that they belong to")
            values, times = _read_table(path, mesh, unit)
        else:
            clock, files = zip(*_list_states(path, interval), strict=True)
            mesh, *other_meshes = meshes = [read_mesh(file, unit=unit) for file in files]
            for other_mesh in other_meshes:
                if not np.array_equal(mesh.node_numbers, other_mesh.node_numbers):
                    raise InputError(
                        f"{other_mesh.name} has other nodes than {mesh.name}: the states must have one mesh"
                    )
            values = np.stack([_displacement(state_mesh, field) for state_mesh in meshes])
            times = None if None in clock else np.array(clock, dtype=np.float64)
        if times is not None and not (np.diff(times) > 0).all():
            raise InputError(f"the times of the simulation {path} must rise, not {times[:5].tolist()} ...")
        if offset and (times is None or len(times) == 1):
            raise InputError(
                f"`offset` shifts the times of several states; {path} is one, and is compared with every frame"
            )
        return cls(mesh=mesh, displacement=values, times=None if times is None else times + offset, name=str(path))

    def interpolate(self, time: float) -> FloatArray:
        """Interpolate the displacement (M, 2) linearly between the states before and after a time within theirs."""
        if self.times is None or len(self.times) == 1:
            return np.asarray(self.displacement[0])
        upper = int(np.clip(np.searchsorted(self.times, time), 1, len(self.times) - 1))
        fraction = (time - self.times[upper - 1]) / (self.times[upper] - self.times[upper - 1])
        return np.asarray((1 - fraction) * self.displacement[upper - 1] + fraction * self.displacement[upper])


def _list_states(path: Path, interval: float | None) -> list[tuple[float | None, Path]]:
    """Return time and file of every state; None for the time of a single file."""
    if path.is_dir():
        indices = sorted(path.glob("*.pvd"))
        if len(indices) > 1:
            raise InputError(f"{path} holds {len(indices)} .pvd files: name one of them")
        if not indices:
            return _list_numbered_states(path, interval)
        path = indices[0]
    if path.suffix.lower() != ".pvd":
        return [(None, path)]
    try:
        datasets = list(ElementTree.fromstring(require_regular_file(path).read_bytes()).iter("DataSet"))
        states: list[tuple[float | None, Path]] = [
            (float(element.attrib["timestep"]), path.parent / element.attrib["file"]) for element in datasets
        ]
    except (OSError, ElementTree.ParseError, KeyError, ValueError) as error:
        raise InputError(f"{path} is not a readable .pvd file: {error}") from None
    if not states:
        raise InputError(f"{path} names no file: a .pvd has a DataSet with timestep and file for each state")
    return states


def _list_numbered_states(path: Path, interval: float | None) -> list[tuple[float | None, Path]]:
    """Return the files of a folder by the last number in their names, times the `interval`."""
    files = NamedFiles.from_files([file for file in path.iterdir() if file.suffix.lower() in (".vtu", ".vtk")])
    if not files.paths or not all(files.numbers):
        raise InputError(f"{path} must hold one .pvd file, or .vtu or .vtk files with a number in their names")
    if interval is None or not interval > 0:
        raise InputError(
            f"the times of the files in {path} are not known: state `interval`, the time between two numbers (above 0)"
        )
    return sorted(
        (interval * float(numbers[-1]), file) for numbers, file in zip(files.numbers, files.paths, strict=True)
    )


def _displacement(mesh: FiniteElementMesh, field: str | None) -> FloatArray:
    """Return the displacement (M, 2) in mm of a mesh's nodal data."""
    names = {name.lower(): name for name in mesh.fields}
    name = field if field is not None else next((names[entry] for entry in _FIELDS if entry in names), None)
    values = None if name is None else mesh.fields.get(name)
    if values is None or values.ndim != 2 or values.shape[1] <= max(mesh.axes):
        available = ", ".join(f"{name} {entry.shape[1:]}" for name, entry in mesh.fields.items()) or "none"
        requested = f'"{field}"' if field is not None else f"one of {', '.join(_FIELDS)}"
        raise InputError(f"{mesh.name} has no nodal vector {requested} (`field`); its nodal data: {available}")
    return np.asarray(values[:, mesh.axes], dtype=np.float64) * mesh.unit_mm


def _read_table(path: Path, mesh: FiniteElementMesh, unit: str) -> tuple[FloatArray, FloatArray | None]:
    """Read a table of node numbers, displacements and times onto a mesh."""
    try:
        lines = require_regular_file(path).read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}") from None
    names = [name.strip() for name in next(csv.reader(lines[:1]), [])]
    components = [[match for name in names if (match := pattern.fullmatch(name))] for pattern in _COMPONENTS]
    clocks = [name for name in names if name.lower() in _TIMES]
    if names.count("node") != 1 or [len(matches) for matches in components] != [1, 1] or len(clocks) > 1:
        raise InputError(
            f'{path} needs a header line with one column each "node", "u_mm" and "v_mm" (and "time_s"), not {names}'
        )
    columns = [names.index(name) for name in ("node", *(match.string for (match,) in components), *clocks)]
    rows = []
    for number, row in enumerate(csv.reader(lines[1:]), 2):
        try:
            rows.append([float(row[column]) for column in columns])
        except (ValueError, IndexError):
            raise InputError(f"row {number} of {path} is not numbers: {row}") from None
    table = np.array(rows, dtype=np.float64).reshape(-1, len(columns))
    if mesh.numbering.startswith("counted"):
        logger.warning("%s: the nodes of %s are %s: those of the table must be, too", path, mesh.name, mesh.numbering)
    indices = label_indices(mesh.node_numbers, table[:, 0])
    valid = indices >= 0
    if not valid.any():
        raise InputError(f"{path} has no row for a node of {mesh.name}")
    if not valid.all():
        logger.warning("%s: %d rows name nodes that %s does not have", path, int((~valid).sum()), mesh.name)
        table, indices = table[valid], indices[valid]
    times = table[:, 3] * _TIMES[clocks[0].lower()] if clocks else np.zeros(len(table))
    steps, state = np.unique(times, return_inverse=True)
    cells, count = np.unique(state * len(mesh.points) + indices, return_counts=True)
    if (count > 1).any():
        node = mesh.node_numbers[cells[count.argmax()] % len(mesh.points)]
        raise InputError(f"{path} has two rows or more for node {node} at one time: several states need a time_s")
    values = np.full((len(steps), len(mesh.points), 2), np.nan)
    values[state, indices] = table[:, 1:3] * [LENGTH_UNITS[(match[1] or unit).lower()] for (match,) in components]
    return values, steps if clocks else None


def label_indices(numbers: IntArray, labels: npt.NDArray[Any]) -> IntArray:
    """Return the index of each label among some numbers; -1 where it is none of them.

    Examples
    --------
    >>> label_indices(np.array([7, 3, 5]), np.array([5, 7, 4])).tolist()
    [2, 0, -1]
    """
    positions = {number: position for position, number in enumerate(numbers.tolist())}
    return np.array([positions.get(number, -1) for number in labels.tolist()], dtype=np.int64)


def require_plane(result: Result) -> None:
    """Refuse a result of a surface in space, which a simulation in a plane is not compared with."""
    if (components := result.in_units().components) != ("u", "v"):
        raise InputError(
            f"{result.path} has the displacements {', '.join(components)}; a simulation is compared with u and v, "
            "those that one camera measures in a plane: take its result"
        )


def find_placement(
    result: Result, *, scale: ScaleSettings | None = None, point_pairs: Sequence[Sequence[float]] = ()
) -> Placement:
    """Place a simulation's mesh on the image of a result.

    Parameters
    ----------
    result
        The result.
    scale
        It replaces the ``[scale]`` that was kept with the result; None: that one.
    point_pairs
        Points (x_mm, y_mm, x_px, y_px), two or more; none: ``mesh.points`` of the result.

    Raises
    ------
    InputError
        No points are known, or they place no mesh; or the result is of a surface in space.

    Examples
    --------
    >>> placement = find_placement(Result.open("my_result"), point_pairs=[(0, 0, 40, 240), (10, 0, 240, 240)])
    >>> round(placement.mm_per_pixel, 6)
    0.05
    """
    require_plane(result)
    points, source = point_pairs, "`point_pairs`"
    if not points and (stored_placement := placement_of(result)) is not None:
        points, source = stored_placement.pairs.tolist(), "mesh.points"
    if not points:
        raise InputError(
            f"where the simulation's mesh lies on the image of {result.path} is not known: state two points or more, "
            "each in mm and in px (`point_pairs`)"
        )
    placement = Placement.fit(points, rectification_of(result, scale, "mm").camera, label=source)
    mm_per_pixel = (scale or result.scale).mm_per_pixel  # half a pixel at each end of 100 px is .7 % of it
    if (
        placement.mm_per_pixel is not None
        and mm_per_pixel is not None
        and abs(placement.mm_per_pixel / mm_per_pixel - 1) > 0.01
    ):
        text = "%s state %.6g mm per px, scale.mm_per_pixel %.6g: the former is taken"
        logger.warning(text, source, placement.mm_per_pixel, mm_per_pixel)
    return placement


class Levelling:
    """Fit and recovery of a measurement's mesh, applied to a simulated displacement field.

    The solve is a least-squares fit of linear elements, in which the texture counts alike everywhere on average, and
    the nodal values are recovered from it by quadratics. Both are applied here.

    Parameters
    ----------
    mesh
        The measurement's mesh.
    simulated
        The simulation's, in the same axes and unit.

    Raises
    ------
    InputError
        The simulation covers no element of the measurement.
    """

    def __init__(self, mesh: Tri3Mesh, simulated: Tri3Mesh) -> None:
        # the simulation is averaged over elements of half its own, 3 to 12 along a side: the error falls as the square
        # of their number, and is 1 % of what levelling changes at 3 (derived)
        sub_points = _subcentroids(int(np.clip(math.ceil(2 * mesh.size / simulated.size), 3, 12)))
        points = np.einsum("qc,ecd->eqd", sub_points, mesh.nodes[mesh.elements])
        points_in_simulation = MeshPoints.of(simulated, points.reshape(-1, 2))
        # it is continued linearly by half an element: the outline of a region drawn by hand differs by some px (chosen)
        depth: FloatArray = np.asarray(points_in_simulation.barycentric.min(axis=1)).reshape(points.shape[:2])
        is_covered: BoolArray = np.asarray((depth > -0.5).all(axis=1))
        if not is_covered.any():
            raise InputError("the simulation's mesh covers no element of the measurement's: check where it is placed")
        row = np.arange(depth.size)
        # the simulation is linear in its elements
        entries = (
            points_in_simulation.barycentric.ravel(),
            (np.repeat(row, 3), simulated.elements[points_in_simulation.element].ravel()),
        )
        sampling = sp.csr_matrix(entries, shape=(len(row), len(simulated.nodes)))
        columns, values = (
            np.repeat(mesh.elements, len(sub_points), axis=0),
            np.tile(sub_points, (len(mesh.elements), 1)),
        )
        shape = sp.csr_matrix((values.ravel(), (np.repeat(row, 3), columns.ravel())), shape=(len(row), len(mesh.nodes)))
        weighted = sp.csr_matrix(
            sp.diags(np.repeat(is_covered * mesh.areas / len(sub_points), len(sub_points))) @ shape
        ).T
        self._covered: BoolArray = np.asarray(mesh.to_nodes(np.asarray(is_covered, dtype=np.float64)) > 0)
        self._factors = splu(sp.csc_matrix(weighted @ shape + sp.diags(1.0 * ~self._covered)))
        self._moments = sp.csr_matrix(weighted @ sampling)
        self._recovery = Recovery.over(mesh, is_covered)

    def __call__(self, displacement: FloatArray) -> FloatArray:
        """Return the displacement (2, N) at the measurement's nodes of a simulated one (M, 2); NaN outside its mesh."""
        moments = self._moments @ np.nan_to_num(displacement)
        unknown: FloatArray = np.asarray(np.isnan(displacement).any(axis=1), dtype=np.float64)
        touches_unknown = np.asarray(abs(self._moments) @ unknown) > 0
        recovered = (self._recovery.value @ self._factors.solve(moments)).T
        return np.where(self._covered & ~touches_unknown, recovered, np.nan)


def _subcentroids(divisions: int) -> FloatArray:
    """Return barycentric coordinates (divisions^2, 3) of the centroids of equal triangles in a triangle."""
    up = [(i + 1 / 3, j + 1 / 3) for i in range(divisions) for j in range(divisions - i)]
    down = [(i + 2 / 3, j + 2 / 3) for i in range(divisions - 1) for j in range(divisions - 1 - i)]
    first_coordinate, second_coordinate = np.array(up + down).T / divisions
    return np.stack([first_coordinate, second_coordinate, 1 - first_coordinate - second_coordinate], axis=1)


__getattr__ = refuse_old_names(__name__)
