"""The file of a result in three dimensions: HDF5 that ParaView, h5py, MATLAB and xarray read.

The arrays lie at the root as netCDF has them, every axis named by a dimension scale; the group ``/VTKHDF`` (Kitware's
VTKHDF 2.0, temporal unstructured grid) shows ParaView the undeformed surface in space, which all steps share, and the
root's arrays as virtual datasets. Points are in the axes of the result as they are: nothing is mirrored.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from rgbmidic.results import ResultQuantity
from rgbmidic.tools.stereo.camera_pair import PAIR_PARAMETERS
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    import h5py

    from rgbmidic.tools.stereo.shape import Shape

STEREO_FILE = "stereo.vtkhdf"
SCHEMA, VERSION = "rgbmidic-stereo-result", 3
_NODE, _STATUS = ("node",), ("measured", "not seen", "decorrelated", "filled")
_DOUBLE: dict[str, Any] = {"dtype": np.float64}


def _with_std(names: Iterable[str], unit: str, text: str, **changes: Any) -> list[ResultQuantity]:
    values = [ResultQuantity(name, _NODE, unit, "", text.format(name), symbol=name, **changes) for name in names]
    return [entry for value in values for entry in (value, replace(value.uncertainty, dtype=np.float32))]


_PARAMETERS = len(PAIR_PARAMETERS)
_ERRORS = "errors of x, y, z by independent errors of unit variance of the calibration, part of shape_covariance"
_GAIN = "errors of u, v, w by the same, over u, v and w (the second axis), part of displacement_covariance"
_BIAS = "part of {}_std left by the bias of the lights, alike over some 24 px; 0 where there is none"
SHARED = [
    ResultQuantity("x_left", _NODE, "px", "", "node in the left reference, to the right", **_DOUBLE),
    ResultQuantity("y_left", _NODE, "px", "", "node in the left reference, down", **_DOUBLE),
    ResultQuantity("x_right", _NODE, "px", "", "node in the right reference, to the right", **_DOUBLE),
    ResultQuantity("y_right", _NODE, "px", "", "node in the right reference, down", **_DOUBLE),
    ResultQuantity("left_node", _NODE, "", "", "index of the node in the left result", dtype=np.int32),
    *_with_std("xyz", "mm", "coordinate {} of the undeformed surface", **_DOUBLE),
    ResultQuantity("shape_covariance", ("node", 3, 3), "mm^2", "", "covariance of x, y, z"),
    ResultQuantity("shape_errors", ("node", 3, _PARAMETERS), "mm", "", _ERRORS),
    ResultQuantity("displacement_gain", ("node", 3, 3, _PARAMETERS), "", "", _GAIN),
    *_with_std(["epipolar_common"], "px", "epipolar residual of the reference states, common to all frames"),
]
"""Quantities that all frames share."""
_OUTCOMES = ("converged", "not converged", "failed")
_OF_FRAMES = [
    ResultQuantity("number", (), "", "", "number of the frame; missing frames leave gaps", dtype=np.int64, blank=-1),
    ResultQuantity("status", (), "", "", "the worse one of both cameras", dtype=np.int64, blank=2, codes=_OUTCOMES),
    ResultQuantity("reference", (), "", "", "1 for a frame of the reference", dtype=np.uint8, blank=0),
    *_with_std("uvw", "mm", "displacement {} of the surface", **_DOUBLE),
    ResultQuantity("displacement_covariance", ("node", 3, 3), "mm^2", "", "covariance of u, v, w"),
    *(ResultQuantity(f"{name}_bias_std", _NODE, "mm", "", _BIAS.format(name), kind="positive") for name in "uvw"),
    *_with_std(["exx", "eyy", "exy"], "", "surface strain {} in the tangent plane"),
    *_with_std(["e1", "e2"], "", "principal surface strain {}"),
    *_with_std(["direction"], "degree", "direction of e1 in the tangent plane, from x towards y"),
    ResultQuantity("normal", ("node", 3), "", "", "unit normal of the deformed surface"),
    *_with_std(["tilt"], "degree", "angle between the normals of the undeformed and of the deformed surface"),
    *_with_std(["epipolar_change"], "px", "epipolar residual less that of the reference states"),
    ResultQuantity("left_status", _NODE, "", "", "node in the left test", dtype=np.uint8, blank=1, codes=_STATUS),
    ResultQuantity("right_status", _NODE, "", "", "node in the right test", dtype=np.uint8, blank=1, codes=_STATUS),
]
"""Quantities of every frame."""
QUANTITIES = {entry.name: entry for entry in (*SHARED, *_OF_FRAMES)}
"""Every quantity of a stereo result by its name."""


def dimensions(entry: ResultQuantity) -> tuple[str, ...]:
    """Return the names of the dimensions of a quantity, as the file has it."""
    axes = ("row", "column", "parameter")
    names = [
        axis if isinstance(axis, str) else axes[2 if axis > 3 else place - 1] for place, axis in enumerate(entry.axes)
    ]
    return (*(() if entry in SHARED else ("time",)), *names)


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
        out.attrs.update({"schema": SCHEMA, "schema_version": VERSION, **attributes})
        out["time"] = np.arange(count, dtype=np.float64) if times is None else times
        out["time"].attrs["units"] = "1" if times is None else "s"
        out["node"] = np.arange(len(meshes.nodes), dtype=np.int32)
        out["element"] = np.arange(len(meshes.left.elements), dtype=np.int32)
        for name, length in {"corner": 3, "row": 3, "column": 3, "parameter": _PARAMETERS}.items():
            out[name] = np.arange(length, dtype=np.int32)
        for name in ("time", "node", "element", "corner", "row", "column", "parameter"):
            out[name].make_scale(name)
        out.create_dataset("name", data=np.array(list(names), dtype=text)).dims[0].attach_scale(out["time"])
        out["elements"] = meshes.left.elements
        for axis, name in zip(out["elements"].dims, ("element", "corner"), strict=True):
            axis.attach_scale(out[name])
        for name, array in _shared_values(shape).items():
            _add(out, QUANTITIES[name], data=array.astype(QUANTITIES[name].dtype))
        for entry in _OF_FRAMES:
            size = (count, *(len(meshes.nodes) if axis == "node" else axis for axis in entry.axes))
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
    errors = shape.calibration.errors
    for name, array in {"shape_errors": errors.surface, "displacement_gain": errors.gain}.items():
        by_node = np.moveaxis(array, (0, -1), (-1, 0))
        values[name] = np.pad(by_node, [(0, 0)] * (array.ndim - 1) + [(0, _PARAMETERS - len(array))])
    values |= {"epipolar_common": triangulated.residual, "epipolar_common_std": triangulated.residual_std}
    for side, mesh in (("left", meshes.left), ("right", meshes.right)):
        values |= {f"x_{side}": mesh.nodes[:, 0], f"y_{side}": mesh.nodes[:, 1]}
    for column_index, name in enumerate("xyz"):
        values |= {name: shape.points[:, column_index], f"{name}_std": std[:, column_index]}
    return values


def _add(out: h5py.File, entry: ResultQuantity, **content: Any) -> None:
    dataset = out.create_dataset(entry.name, **content)
    dataset.attrs.update(entry.attributes)
    for axis, name in zip(dataset.dims, dimensions(entry), strict=True):
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
        is_shared = entry in SHARED
        shape = source.shape if is_shared else (frames * nodes, *source.shape[2:])
        layout = h5py.VirtualLayout(shape, source.dtype)
        layout[...] = h5py.VirtualSource(".", source.name, source.shape, source.dtype)
        data.create_virtual_dataset(entry.name, layout)
        steps[f"PointDataOffsets/{entry.name}"] = zeros if is_shared else nodes * np.arange(frames, dtype=np.int64)
