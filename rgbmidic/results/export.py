"""A result in other programs' formats: npz, csv, and HDF5 for h5py, MATLAB, xarray and ParaView.

The arrays of the HDF5 file lie at the root, as netCDF has it: uncompressed, the frames as first axis, every axis named
by a dimension scale, the units as attributes. The group ``/VTKHDF`` (Kitware's VTKHDF 2.0, temporal unstructured grid)
shows them to ParaView: one mesh that all steps share, and the root's arrays as virtual datasets, which hold no copy.
Only what changes its sign with the direction of y is there a second time: images have y down, ParaView has it up.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from rgbmidic.arguments import checked
from rgbmidic.disk import check_file, write_complete, write_table
from rgbmidic.errors import InputError
from rgbmidic.field import column
from rgbmidic.fields.quantity import ResultQuantity
from rgbmidic.results.quantities import MESH_LABELS, QUANTITIES, SHARED
from rgbmidic.results.result import Result
from rgbmidic.results.result_in_units import ResultInUnits
from rgbmidic.settings import ScaleSettings
from rgbmidic.text import format_times
from rgbmidic.typing import AnyArray

if TYPE_CHECKING:
    import h5py

_AXES = "x to the right, y down; (0, 0) is the centre of the image's top-left pixel"
_AXES_UP = "x to the right, y up: y, v, shears and directions are those of the file's root times -1"
_SIGN_CHANGING = ("exy", "direction")
"""Nodal quantities of one number that change their sign with the direction of y; u and v become a vector."""


def write_hdf5(physical: ResultInUnits, file: BinaryIO) -> None:
    """Write the measured frames of a result, one after the other: the memory that is needed is that of one frame.

    HDF5 writes through the open file: what the disk refuses is then Python's error. With a file of its own, h5py 3
    crashes where the disk is full.

    Parameters
    ----------
    physical
        The result, in its units.
    file
        Open file on the disk, empty, that can be read and written.

    Raises
    ------
    ResultError
        A frame of the result is damaged.
    OSError
        The disk is full or refuses.
    """
    frames = np.flatnonzero(physical.finished)
    sizes = {"node": len(physical.mesh.nodes), "element": len(physical.mesh.elements)}
    sizes["light"] = len(physical.result.lights)
    frame_bytes = sum(entry.unmeasured(sizes).nbytes for entry in physical.columns.values())
    # more than enough: y up has a vector of three numbers, a shear and a direction in single precision; 200 bytes of
    # each frame, node, element and light in what all frames share; what HDF5 writes of the arrays themselves
    frame_bytes += 20 * sizes["node"]
    shared_bytes = 200 * (len(frames) + sum(sizes.values())) + 1_000_000
    if shutil.disk_usage(Path(file.name).parent).free < frame_bytes * len(frames) + shared_bytes:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # before HDF5 itself meets a full disk
    import h5py

    with h5py.File(file, "w") as out:
        _write_shared(out, physical)
        for entry in physical.columns.values():
            _declare(out, physical, entry)
        _declare_grid(out.create_group("VTKHDF"), physical)
        arrays, nodes = {name: out[name] for name in physical.columns}, sizes["node"]
        upward_arrays = {name: out[f"VTKHDF/PointData/{name}"] for name in ("displacement", *_SIGN_CHANGING)}
        for row, frame in enumerate(frames.tolist()):
            values, rows = physical.frame(frame), slice(row * nodes, (row + 1) * nodes)
            for name, array in arrays.items():
                array[row] = values[name]
            for name in _SIGN_CHANGING:
                upward_arrays[name][rows] = -values[name]
            u, v = values["u"], values["v"]
            upward_arrays["displacement"][rows] = np.stack([u, -v, np.where(np.isfinite(u), 0.0, np.nan)], axis=1)


def _write_shared(out: h5py.File, physical: ResultInUnits) -> None:
    """Write what all frames have in common: axes, mesh, names and provenance."""
    import h5py

    frames, result = np.flatnonzero(physical.finished), physical.result
    mesh, units, text = physical.mesh, physical.units, h5py.string_dtype()
    out.attrs.update({**physical.file_attributes, "axes": _AXES})
    out.create_dataset("provenance", data=json.dumps(dict(result.provenance)), dtype=text)
    time_description = "time of the frame" if units.timed else "place of the frame, counted from 0"
    (x, y), element = physical.length * mesh.centres.T, ("element",)
    shared: list[tuple[ResultQuantity, AnyArray | None]] = [
        (ResultQuantity("time", (), units.time, "", time_description), physical.times[frames]),
        (
            ResultQuantity("node", (), "", "", "index of the node, as in elements"),
            np.arange(len(mesh.nodes), dtype=np.int32),
        ),
        (ResultQuantity("element", (), "", "", "index of the element"), np.arange(len(mesh.elements), dtype=np.int32)),
        (ResultQuantity("corner", (), "", "", "corner of the element"), np.arange(3, dtype=np.int32)),
        (ResultQuantity("light", (), "", "", "name of the light"), np.array(result.lights, dtype=text)),
        (ResultQuantity("name", ("time",), "", "", "name of the frame"), np.array(result.names, dtype=text)[frames]),
        *physical.coordinates,
        *((SHARED[name], getattr(result, name)) for name in ("node_number", "element_number")),
        (
            ResultQuantity("elements", ("element", "corner"), "", "", "nodes of the element, counted from 0"),
            mesh.elements,
        ),
        (ResultQuantity("x_element", element, units.length, "", "middle of the element, to the right"), x),
        (ResultQuantity("y_element", element, units.length, "", "middle of the element, down"), y),
        (
            ResultQuantity("area", element, f"{units.length}^2", "", "area of the element"),
            physical.length**2 * mesh.areas,
        ),
    ]
    for entry, array in shared:
        if array is not None:
            _add(out, entry, entry.axes, data=array)


def _add(out: h5py.File, entry: ResultQuantity, axes: Sequence[str | int], **content: Any) -> h5py.Dataset:
    """Create the array of a quantity along axes whose scales are there; without axes it is itself the scale of one."""
    dataset = out.create_dataset(entry.name, **content)
    dataset.attrs.update(entry.attributes)
    for axis, name in zip(dataset.dims, axes, strict=False):
        axis.attach_scale(out[name])
    if not axes:
        dataset.make_scale(entry.name)
    return dataset


def _declare(out: h5py.File, physical: ResultInUnits, entry: ResultQuantity) -> None:
    """Create the array of a quantity for all frames, still without content."""
    axes = tuple(axis if isinstance(axis, str) else f"part_of_{axis}" for axis in entry.axes)
    for name, axis in zip(axes, entry.axes, strict=True):
        if name not in out:  # an axis of a fixed length gets its scale when it is first met
            _add(out, ResultQuantity(name, (), "", "", "index"), (), data=np.arange(int(axis), dtype=np.int32))
    shape = (len(out["time"]), *(len(out[axis]) for axis in axes))
    dataset = _add(out, entry, ("time", *axes), shape=shape, dtype=np.dtype(entry.dtype).newbyteorder("<"))
    if physical.is_strain(entry.name):
        length = f"{physical.gauges.length * physical.length:.6g} {physical.units.length}"
        dataset.attrs["measure"] = "hencky" if entry.name.startswith("equivalent") else physical.measure
        dataset.attrs["gauge"] = "element" if "element" in axes else length


def _declare_grid(group: h5py.Group, physical: ResultInUnits) -> None:
    """Write the group that VTK's reader looks for: the mesh, the steps, and the nodal quantities."""
    import h5py

    mesh, times = physical.mesh, group.file["time"][...]
    frames = len(times)
    nodes, elements = len(mesh.nodes), len(mesh.elements)
    group.attrs["Version"] = np.array((2, 0), dtype=np.int64)  # the first with time steps: ParaView 5.12 and later
    group.attrs.create("Type", b"UnstructuredGrid", dtype=h5py.string_dtype("ascii", len("UnstructuredGrid")))
    group.attrs["axes"] = _AXES_UP
    x, y = physical.length * mesh.nodes.T
    group["Points"] = np.stack([x, -y, np.zeros(nodes)], axis=1)
    # y up turns the triangles over: without the exchange of two corners they would be seen from behind
    group["Connectivity"] = mesh.elements[:, [0, 2, 1]].astype(np.int64).ravel()
    group["Offsets"] = 3 * np.arange(elements + 1, dtype=np.int64)
    group["Types"] = np.full(elements, 5, dtype=np.uint8)  # VTK's number of a triangle
    for name, count in {"Points": nodes, "Cells": elements, "ConnectivityIds": 3 * elements}.items():
        group[f"NumberOf{name}"] = np.array([count], dtype=np.int64)
    data, steps, zeros = group.create_group("PointData"), group.create_group("Steps"), np.zeros(frames, dtype=np.int64)
    steps.attrs["NSteps"] = frames
    steps["Values"] = times
    steps["NumberOfParts"] = zeros + 1
    for name, shape in {"Part": (-1,), "Point": (-1,), "Cell": (-1, 1), "ConnectivityId": (-1, 1)}.items():
        steps[f"{name}Offsets"] = zeros.reshape(shape)
    data.create_dataset("displacement", (frames * nodes, 3), "<f4")
    for entry in physical.columns.values():
        if entry.axes[:1] == ("node",) and entry.name not in ("u", "v"):
            _declare_nodal(data, group.file[entry.name], flip_sign=entry.name in _SIGN_CHANGING)
    for name in data:
        steps[f"PointDataOffsets/{name}"] = nodes * np.arange(frames, dtype=np.int64)
    if (result := physical.result).node_number is not None:  # the same at every step
        data["node_number"], steps["PointDataOffsets/node_number"] = result.node_number, zeros
        group.create_group("CellData")["element_number"] = result.element_number
        steps["CellDataOffsets/element_number"] = zeros


def _declare_nodal(data: h5py.Group, source: h5py.Dataset, *, flip_sign: bool) -> None:
    """Declare a nodal quantity (T, N, ...) of the root as VTK has it, (T N, ...): the same values or `flip_sign`."""
    import h5py

    name, shape = source.name.strip("/"), (source.shape[0] * source.shape[1], *source.shape[2:])
    if flip_sign:
        data.create_dataset(name, shape, source.dtype)
        return
    layout = h5py.VirtualLayout(shape, source.dtype)
    layout[...] = h5py.VirtualSource(".", source.name, source.shape, source.dtype)
    data.create_virtual_dataset(name, layout)


@checked
def export_result(
    result: Result, to: str, out: Path | str, *, scale: ScaleSettings | None = None, overwrite: bool = False
) -> None:
    """Write the measured frames of a result into one file.

    ``"npz"`` is the store, in px, with all frames, those that are not measured blank: nodes (N, 2), elements (E, 3),
    names (T,), lights (k,), of a mesh of ``mesh.file`` node_number (N,), element_number (E,) and node_mm (N, 2), and
    every quantity of `rgbmidic.results.QUANTITIES` that has one shape in all frames, the frames as first axis.
    ``"csv"`` and ``"hdf5"`` are for engineers: seconds, millimetres where the scale is known, Green-Lagrange
    strain over the shortest virtual strain gauge. csv has a header line, whose names hold the units, and a row per node
    and frame with the quantities that are one number per node.
    x is to the right, y down (up in ParaView's part of hdf5); NaN (an empty field in csv) where not measured.

    Parameters
    ----------
    result
        The result.
    to
        One of `EXPORT_FORMATS`.
    out
        File to write; it appears once it is complete.
    scale
        It replaces the ``[scale]`` that was kept with the result; None: that one. npz is in px in any case.
    overwrite
        Whether an existing file may be replaced.

    Raises
    ------
    InputError
        The format is unknown, the file's ending is that of another one, or no frame is measured yet.
    ResultError
        The file exists, its folder does not, or a frame of the result is damaged.

    Examples
    --------
    >>> export_result(Result.open("my_result"), "csv", "fields.csv", overwrite=True)
    >>> Path("fields.csv").read_text().split(",")[:3]
    ['frame', 'number', 'name']
    """
    out = Path(out)
    if to not in EXPORT_FORMATS:
        raise InputError(f'unknown export format "{to}"; allowed are {", ".join(EXPORT_FORMATS)}')
    if (ending := _ENDINGS.get(out.suffix.lower(), to)) != to:
        raise InputError(f"{out} ends as a file of the format {ending}, and {to} is what is written (`to`): choose one")
    check_file(out, overwrite=overwrite)
    if not result.finished.any():
        raise InputError(f"no frame of {result.path} is measured yet")
    physical = ResultInUnits.from_result(result, scale)
    if (exporter := physical.exporter) is not None:
        write_complete(out, lambda file: exporter(to, file))
    else:
        write_complete(out, lambda file: _WRITERS[to](physical, file))


def _write_npz(physical: ResultInUnits, file: BinaryIO) -> None:
    result = physical.result
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        label_names = MESH_LABELS if result.node_number is not None else ()
        for name in ("nodes", "elements", "names", "lights", *label_names):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(getattr(result, name)), allow_pickle=False)
        times = physical.seconds
        with archive.open("time_s.npy", "w") as member:
            np.lib.format.write_array(member, np.full(len(result), np.nan) if times is None else times)
        for quantity in QUANTITIES.values():
            if not quantity.is_stackable or quantity.name == "time_ns":
                continue
            blank = quantity.unmeasured(result.table.sizes)
            head = {"descr": blank.dtype.str, "fortran_order": False, "shape": (len(result), *blank.shape)}
            with archive.open(f"{quantity.file_name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, head)
                for value in result.iterate(quantity.name):  # one frame at a time is in memory
                    member.write(np.asarray(value, dtype=blank.dtype).tobytes())


def _write_csv(physical: ResultInUnits, file: BinaryIO) -> None:
    result, coordinates, has_times = physical.result, physical.coordinates, physical.units.timed
    fields = {name: entry.unit for name, entry in physical.columns.items() if entry.axes == ("node",)}
    del fields["node_status"]  # a whole number
    label = [] if result.node_number is None else [result.node_number.tolist()]
    head = ["frame", "number", "name", *(["time_s"] if has_times else []), "status", "node"]
    head += [*(["node_number"] if label else []), "node_status"]
    head += [column(entry.name, entry.unit) for entry, _ in coordinates]
    head += [column(name, unit) for name, unit in fields.items()]

    def rows() -> Iterator[list[object]]:
        frames = np.flatnonzero(physical.finished)
        for index, time in zip(frames.tolist(), format_times(physical.times[frames].tolist()), strict=True):
            values = physical.frame(index)
            frame_cells = [index, values["number"], result.names[index], *([time] if has_times else [])]
            numbers = np.column_stack(
                [*(coordinate for _, coordinate in coordinates), *(values[name] for name in fields)]
            )
            for node, (code, row) in enumerate(zip(values["node_status"].tolist(), numbers.tolist(), strict=True)):
                yield [
                    *frame_cells,
                    values["status"],
                    node,
                    *(node_numbers[node] for node_numbers in label),
                    code,
                    *row,
                ]

    write_table(file, head, rows())


_WRITERS: dict[str, Callable[[ResultInUnits, BinaryIO], None]] = {
    "npz": _write_npz,
    "csv": _write_csv,
    "hdf5": write_hdf5,
}
_ENDINGS = {".npz": "npz", ".csv": "csv", ".h5": "hdf5", ".hdf5": "hdf5", ".vtkhdf": "hdf5"}
EXPORT_FORMATS = tuple(_WRITERS)
"""Names of the formats that `export_result` writes."""
