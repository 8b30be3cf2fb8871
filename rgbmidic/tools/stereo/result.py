"""The result in three dimensions: one HDF5 file, which ParaView, h5py, MATLAB and xarray read.

The arrays lie at the root as netCDF has them, every axis named by a dimension scale; the group ``/VTKHDF`` (Kitware's
VTKHDF 2.0, temporal unstructured grid) shows ParaView the undeformed surface in space, which all steps share, and the
root's arrays as virtual datasets. Points are in the axes of the result as they are: nothing is mirrored.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Self

import numpy as np

from rgbmidic.errors import InputError, ResultError, import_optional
from rgbmidic.field import column
from rgbmidic.results import ResultQuantity
from rgbmidic.results.files import check_file, write_complete, write_errors, write_table
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    import h5py
    import xarray as xr
    from matplotlib.figure import Figure

    from rgbmidic.tools.stereo.shape import Shape

STEREO_FILE = "stereo.vtkhdf"
_SCHEMA, _VERSION = "rgbmidic-stereo-result", 1
_NODE, _STATUS = ("node",), ("measured", "not seen", "decorrelated", "filled")
_DIMENSIONS = ("node", "row", "column")
_DOUBLE: dict[str, Any] = {"dtype": np.float64}


def _with_std(names: Iterable[str], unit: str, text: str, **changes: Any) -> list[ResultQuantity]:
    values = [ResultQuantity(name, _NODE, unit, "", text.format(name), symbol=name, **changes) for name in names]
    return [entry for value in values for entry in (value, replace(value.uncertainty, dtype=np.float32))]


_SHARED = [
    ResultQuantity("x_left", _NODE, "px", "", "node in the left reference, to the right", **_DOUBLE),
    ResultQuantity("y_left", _NODE, "px", "", "node in the left reference, down", **_DOUBLE),
    ResultQuantity("x_right", _NODE, "px", "", "node in the right reference, to the right", **_DOUBLE),
    ResultQuantity("y_right", _NODE, "px", "", "node in the right reference, down", **_DOUBLE),
    ResultQuantity("left_node", _NODE, "", "", "index of the node in the left result", dtype=np.int32),
    *_with_std("xyz", "mm", "coordinate {} of the undeformed surface", **_DOUBLE),
    ResultQuantity("shape_covariance", ("node", 3, 3), "mm^2", "", "covariance of x, y, z"),
    *_with_std(["epipolar_common"], "px", "epipolar residual of the reference states, common to all frames"),
]
"""Quantities that all frames share."""
_OF_FRAMES = [
    *_with_std("uvw", "mm", "displacement {} of the surface", **_DOUBLE),
    ResultQuantity("displacement_covariance", ("node", 3, 3), "mm^2", "", "covariance of u, v, w"),
    *_with_std(["exx", "eyy", "exy"], "", "surface strain {} in the tangent plane"),
    *_with_std(["e1", "e2"], "", "principal surface strain {}"),
    *_with_std(["direction"], "degree", "direction of e1 in the tangent plane, from x towards y"),
    ResultQuantity("normal", ("node", 3), "", "", "unit normal of the deformed surface"),
    *_with_std(["epipolar_change"], "px", "epipolar residual less that of the reference states"),
    ResultQuantity("left_status", _NODE, "", "", "node in the left test", dtype=np.uint8, blank=1, codes=_STATUS),
    ResultQuantity("right_status", _NODE, "", "", "node in the right test", dtype=np.uint8, blank=1, codes=_STATUS),
]
"""Quantities of every frame."""
QUANTITIES = {entry.name: entry for entry in (*_SHARED, *_OF_FRAMES)}
"""Every quantity of a stereo result by its name."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoResult:
    """A result in three dimensions, read quantity by quantity, each when it is asked for.

    Attributes
    ----------
    path
        The HDF5 file.
    attributes
        Attributes of the file: axes, gauge, measure, uncertainty of the calibration.
    names
        Name of each frame.
    elements : ndarray, shape (E, 3)
        Nodes of the triangles.
    time : ndarray, shape (T,)
        s, or the number of the frame where times are not known.
    """

    path: Path
    attributes: Mapping[str, Any]
    names: tuple[str, ...]
    elements: AnyArray
    time: FloatArray

    @classmethod
    def open(cls, path: Path | str) -> Self:
        """Open the result that ``rgbmidic stereo`` wrote.

        Parameters
        ----------
        path
            Its folder, or the HDF5 file.

        Returns
        -------
        StereoResult

        Raises
        ------
        ResultError
            There is none, or it is damaged or of another version.
        """
        import h5py

        file = Path(path)
        file = file / STEREO_FILE if file.is_dir() else file
        if not file.is_file():
            raise ResultError(f"{path} is no stereo result: it has no {STEREO_FILE} (rgbmidic stereo writes it)")
        try:
            with h5py.File(file, "r") as content:
                attributes = dict(content.attrs)
                if (attributes.get("schema"), int(attributes.get("schema_version", 0))) != (_SCHEMA, _VERSION):
                    raise ResultError(f"{file} is no stereo result of this version of rgbmidic")
                names = tuple(content["name"].asstr()[...].tolist())
                return cls(
                    path=file,
                    attributes=attributes,
                    names=names,
                    elements=content["elements"][...],
                    time=content["time"][...],
                )
        except (OSError, KeyError, ValueError, TypeError) as error:
            if isinstance(error, ResultError):
                raise
            raise ResultError(f"{file} is damaged: {error}") from None

    def __len__(self) -> int:
        """Return the number of frames T."""
        return len(self.names)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about calibration, match and frames."""
        return tuple(json.loads(self.attributes["warnings"]))

    def __getitem__(self, name: str) -> AnyArray:
        """Read a quantity of `QUANTITIES`: (N, ...) of the shape, (T, N, ...) of frames; NaN where there is no data."""
        import h5py

        if name not in QUANTITIES:
            raise InputError(f"a stereo result has no {name!r}; it has {', '.join(QUANTITIES)}")
        try:
            with h5py.File(self.path, "r") as content:
                return np.asarray(content[name][...])
        except (OSError, KeyError) as error:
            raise ResultError(f"{self.path} is damaged: {error}") from None

    def to_xarray(self) -> xr.Dataset:
        """Return all quantities with named dimensions, coordinates and units.

        Returns
        -------
        xarray.Dataset
            Dimensions `time`, `node`, `row`, `column`; coordinates x, y, z of the nodes and the frames' times.

        Raises
        ------
        InputError
            The package xarray is not installed (extra ``xarray``).
        """
        xarray = import_optional("xarray", "xarray")
        variables = {}
        for name, entry in QUANTITIES.items():
            frames = () if entry in _SHARED else ("time",)
            variables[name] = ((*frames, *_DIMENSIONS[: len(entry.axes)]), self[name], entry.attributes)
        coordinates = {"time": self.time, "name": ("time", list(self.names))}
        dataset: xr.Dataset = xarray.Dataset(variables, coordinates, dict(self.attributes))
        return dataset.set_coords(["x", "y", "z"])

    def write_csv(self, folder: Path | str, *, overwrite: bool = False) -> None:
        """Write a CSV file for each frame: a row per node, names of the columns with their units.

        Parameters
        ----------
        folder
            Folder of the files ``000000.csv`` and so on; it is made.
        overwrite
            Whether existing files may be replaced.

        Raises
        ------
        ResultError
            A file exists or cannot be written.
        """
        folder = Path(folder)
        entries = [entry for entry in QUANTITIES.values() if entry.axes == _NODE]
        with write_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        head = ["node", *(column(entry.name, entry.unit) for entry in entries)]
        arrays = {entry.name: self[entry.name] for entry in entries}
        for frame in range(len(self)):
            columns = [arrays[entry.name] if entry in _SHARED else arrays[entry.name][frame] for entry in entries]
            rows = ([node, *values] for node, values in enumerate(zip(*(c.tolist() for c in columns), strict=True)))
            file = folder / f"{frame:06d}.csv"
            check_file(file, overwrite=overwrite)
            write_complete(file, lambda stream, rows=rows: write_table(stream, head, rows))  # type: ignore[misc]

    def figure(self, name: str, frame: int = -1) -> Figure:
        """Draw a quantity over the left reference.

        Parameters
        ----------
        name
            Quantity with one number a node.
        frame
            Index of the frame; from the end where negative.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        InputError
            There is no such quantity with one number a node, or no such frame.
        """
        from matplotlib.figure import Figure
        from matplotlib.tri import Triangulation

        if name not in QUANTITIES or QUANTITIES[name].axes != _NODE:
            allowed = [entry.name for entry in QUANTITIES.values() if entry.axes == _NODE]
            raise InputError(f"no map of {name!r}; there are {', '.join(allowed)}")
        if not -len(self) <= frame < len(self):
            raise InputError(f"there is no frame {frame} in a result of {len(self)} frames")
        entry = QUANTITIES[name]
        values = np.asarray(self[name] if entry in _SHARED else self[name][frame], dtype=np.float64)
        figure = Figure(layout="constrained")
        axes = figure.subplots()
        x, y, triangles = self["x_left"], self["y_left"], self.elements
        is_shown = np.isfinite(values)[triangles].all(axis=1)
        if is_shown.any():
            grid = Triangulation(x, y, triangles[is_shown])
            picture = axes.tripcolor(grid, np.nan_to_num(values), shading="gouraud")
            figure.colorbar(picture, label=entry.label)
        axes.set(aspect="equal", xlabel="x, left reference (px)", ylabel="y, left reference (px)")
        axes.set_title(entry.description if entry in _SHARED else f"{entry.description}: {self.names[frame]}")
        axes.invert_yaxis()
        return figure


def write_stereo(
    file: BinaryIO,
    shape: Shape,
    *,
    names: Sequence[str],
    times: FloatArray | None,
    frames: Iterable[Mapping[str, AnyArray]],
    attributes: Mapping[str, Any],
) -> list[str]:
    """Write the frames of a stereo result one after the other, and return the doubts about it.

    Parameters
    ----------
    file
        Open file on the disk, empty, that can be read and written.
    shape
        The undeformed surface.
    names
        Name of each frame.
    times : ndarray, shape (T,)
        Time of each in s; None: not known.
    frames
        Quantities of each, see `Shape.frame`.
    attributes
        Further attributes of the file.

    Returns
    -------
    list of str
    """
    import h5py

    count, meshes, text = len(names), shape.carried_mesh, h5py.string_dtype()
    changes, expected = np.full((2, count), np.nan)
    with h5py.File(file, "w") as out:
        out.attrs.update({"schema": _SCHEMA, "schema_version": _VERSION, **attributes})
        out["time"] = np.arange(count, dtype=np.float64) if times is None else times
        out["time"].attrs["units"] = "1" if times is None else "s"
        out["node"] = np.arange(len(meshes.nodes), dtype=np.int32)
        out["element"] = np.arange(len(meshes.left.elements), dtype=np.int32)
        for name, length in {"corner": 3, "row": 3, "column": 3}.items():
            out[name] = np.arange(length, dtype=np.int32)
        for name in ("time", "node", "element", "corner", "row", "column"):
            out[name].make_scale(name)
        out.create_dataset("name", data=np.array(list(names), dtype=text)).dims[0].attach_scale(out["time"])
        out["elements"] = meshes.left.elements
        for axis, name in zip(out["elements"].dims, ("element", "corner"), strict=True):
            axis.attach_scale(out[name])
        for name, array in _shared_values(shape).items():
            _add(out, QUANTITIES[name], data=array.astype(QUANTITIES[name].dtype))
        for entry in _OF_FRAMES:
            size = (count, len(meshes.nodes), *(axis for axis in entry.axes if isinstance(axis, int)))
            _add(out, entry, shape=size, dtype=entry.dtype)
        _declare_grid(out, shape.points, out["time"][...])
        for index, values in enumerate(frames):
            for name, array in values.items():
                out[name][index] = array
            measured = np.isfinite(values["epipolar_change"])
            if measured.any():
                changes[index] = np.sqrt(np.mean(values["epipolar_change"][measured] ** 2))
                expected[index] = np.sqrt(np.mean(values["epipolar_change_std"][measured] ** 2))
            rows = slice(index * len(meshes.nodes), (index + 1) * len(meshes.nodes))
            out["VTKHDF/PointData/displacement"][rows] = np.stack([values[name] for name in "uvw"], axis=1)
        doubts = [*meshes.warnings, *shape.doubts(changes, expected)]
        out.attrs["warnings"] = json.dumps(doubts)
    return doubts


def _shared_values(shape: Shape) -> dict[str, AnyArray]:
    """Return the quantities that all frames share."""
    meshes, triangulated = shape.carried_mesh, shape.triangulation
    std = np.sqrt(np.maximum(np.diagonal(shape.covariance, axis1=1, axis2=2), 0))
    values: dict[str, AnyArray] = {"left_node": meshes.nodes, "shape_covariance": shape.covariance}
    values |= {"epipolar_common": triangulated.residual, "epipolar_common_std": triangulated.residual_std}
    for side, mesh in (("left", meshes.left), ("right", meshes.right)):
        values |= {f"x_{side}": mesh.nodes[:, 0], f"y_{side}": mesh.nodes[:, 1]}
    for column_index, name in enumerate("xyz"):
        values |= {name: shape.points[:, column_index], f"{name}_std": std[:, column_index]}
    return values


def _add(out: h5py.File, entry: ResultQuantity, **content: Any) -> None:
    dataset = out.create_dataset(entry.name, **content)
    dataset.attrs.update(entry.attributes)
    frames = () if entry in _SHARED else ("time",)
    for axis, name in zip(dataset.dims, (*frames, *_DIMENSIONS[: len(entry.axes)]), strict=True):
        axis.attach_scale(out[name])


def _declare_grid(out: h5py.File, points: FloatArray, times: FloatArray) -> None:
    """Write the group that VTK's reader looks for: the undeformed surface, the steps, and the nodal quantities."""
    import h5py

    group, elements, nodes, frames = out.create_group("VTKHDF"), out["elements"][...], len(points), len(times)
    group.attrs["Version"] = np.array((2, 0), dtype=np.int64)
    group.attrs.create("Type", b"UnstructuredGrid", dtype=h5py.string_dtype("ascii", len("UnstructuredGrid")))
    group["Points"] = points
    group["Connectivity"] = elements.astype(np.int64).ravel()
    group["Offsets"] = 3 * np.arange(len(elements) + 1, dtype=np.int64)
    group["Types"] = np.full(len(elements), 5, dtype=np.uint8)  # VTK's number of a triangle
    for name, count in {"Points": nodes, "Cells": len(elements), "ConnectivityIds": 3 * len(elements)}.items():
        group[f"NumberOf{name}"] = np.array([count], dtype=np.int64)
    data, steps, zeros = group.create_group("PointData"), group.create_group("Steps"), np.zeros(frames, dtype=np.int64)
    steps.attrs["NSteps"] = frames
    steps["Values"], steps["NumberOfParts"] = times, zeros + 1
    for name, shape in {"Part": (-1,), "Point": (-1,), "Cell": (-1, 1), "ConnectivityId": (-1, 1)}.items():
        steps[f"{name}Offsets"] = zeros.reshape(shape)
    data.create_dataset("displacement", (frames * nodes, 3), "<f4")
    steps["PointDataOffsets/displacement"] = nodes * np.arange(frames, dtype=np.int64)
    for entry in QUANTITIES.values():
        if entry.axes not in (_NODE, ("node", 3)) or entry.name in "xyzuvw":
            continue
        source = out[entry.name]
        is_shared = entry in _SHARED
        shape = source.shape if is_shared else (frames * nodes, *source.shape[2:])
        layout = h5py.VirtualLayout(shape, source.dtype)
        layout[...] = h5py.VirtualSource(".", source.name, source.shape, source.dtype)
        data.create_virtual_dataset(entry.name, layout)
        steps[f"PointDataOffsets/{entry.name}"] = zeros if is_shared else nodes * np.arange(frames, dtype=np.int64)
