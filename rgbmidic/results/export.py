"""A result as one HDF5 file that h5py, MATLAB (`h5read`), xarray and ParaView open alike.

The arrays lie at the root, as netCDF has it: uncompressed, the frames as first axis, every axis named by a dimension
scale, the units as attributes. The group ``/VTKHDF`` (Kitware's VTKHDF 2.0, temporal unstructured grid) shows them to
ParaView: one mesh that all steps share, and the root's arrays as virtual datasets, which hold no copy. Only what
changes its sign with the direction of y is there a second time: images have y down, ParaView has it up.

Results in other programs' formats.
"""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np

from rgbmidic._version import __version__
from rgbmidic.errors import InputError
from rgbmidic.results.files import check_file, write_complete
from rgbmidic.results.physical import Physical
from rgbmidic.results.quantities import QUANTITIES, ResultQuantity
from rgbmidic.results.result import Result
from rgbmidic.settings import ScaleSettings
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    import h5py

    from rgbmidic.results.physical import Physical

__all__ = ["EXPORT_FORMATS", "export_result", "write_hdf5"]

_VERSION = (2, 0)
"""Of VTKHDF: the first with time steps, which ParaView reads from 5.12 on."""
_TRIANGLE = 5
"""VTK's number of a cell with three corners."""
_HEADERS = 1_000_000
"""Bytes, more than enough, for what HDF5 writes of the arrays themselves."""
_AXES = "x to the right, y down; (0, 0) is the centre of the image's top-left pixel"
_AXES_UP = "x to the right, y up: y, v, shears and directions are those of the file's root times -1"
_TURNED = ("exy", "direction")
"""Nodal quantities of one number that change their sign with the direction of y; u and v become a vector."""


def write_hdf5(told: Physical, file: BinaryIO) -> None:
    """Write all frames of a result, one after the other: the memory that is needed is that of one frame.

    HDF5 lays the file out, with the room for all frames, and says where each array begins; the numbers are then written
    there as into any file. A disk that fills up is an ordinary error so, of which HDF5 would not recover.

    Parameters
    ----------
    told
        The result, in its units.
    file
        Open file on the disk, empty.

    Raises
    ------
    ResultError
        A frame of the result is damaged.
    OSError
        The disk is full or refuses.
    """
    _check_room(told, Path(file.name).parent)
    arrays, turned = _lay_out(told, file.name)
    for index in range(len(told.result)):
        values = told.frame(index)
        for name, rows in arrays.items():
            rows.write(file, index, values[name])
        for name, rows in turned.items():
            rows.write(file, index, _upward(values) if name == "displacement" else -values[name])


def _lay_out(told: Physical, name: str) -> tuple[dict[str, _Rows], dict[str, _Rows]]:
    """Write all but what belongs to a frame; gives the place of each array of the root, and of VTK's group."""
    import h5py

    try:
        with h5py.File(name, "w") as out:
            _write_shared(out, told)
            for entry in told.quantities.values():
                _declare(out, told, entry)
            group = out.create_group("VTKHDF")
            _declare_grid(group, told)
            arrays = {name: _Rows.of(out[name]) for name in told.quantities}
            return arrays, {name: _Rows.of(group["PointData"][name]) for name in ("displacement", *_TURNED)}
    except OSError as error:  # whose text is HDF5's, in several lines
        raise OSError(error.errno, os.strerror(error.errno)) if error.errno else error from None


class _Rows(NamedTuple):
    """An array in the file, of which each frame has a row: where it begins, its type, the bytes of a row."""

    first: int
    dtype: np.dtype[Any]
    size: int

    @classmethod
    def of(cls, dataset: h5py.Dataset) -> _Rows:
        frames = dataset.file["time"].size
        return cls(dataset.id.get_offset(), dataset.dtype, dataset.nbytes // frames)

    def write(self, file: BinaryIO, index: int, values: Any) -> None:
        file.seek(self.first + index * self.size)
        file.write(np.asarray(values, dtype=self.dtype).tobytes())


def _check_room(told: Physical, folder: Path) -> None:
    """Refuse a disk that is too small before anything is written: what HDF5 itself writes must find room."""
    sizes = {"node": len(told.mesh.nodes), "element": len(told.mesh.elements), "light": len(told.result.lights)}
    frame = sum(entry.unmeasured(sizes).nbytes for entry in told.quantities.values()) + 20 * sizes["node"]
    shared = 200 * (len(told.result) + sum(sizes.values())) + _HEADERS
    if shutil.disk_usage(folder).free < frame * len(told.result) + shared:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _upward(values: Mapping[str, Any]) -> FloatArray:
    """Displacement (N, 3) with y up."""
    u, v = values["u"], values["v"]
    return np.stack([u, -v, np.where(np.isfinite(u), 0.0, np.nan)], axis=1)


def _room(out: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any) -> h5py.Dataset:
    """An array without content, with its place in the file."""
    import h5py

    made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    made.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    made.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    return out.create_dataset(name, shape, np.dtype(dtype).newbyteorder("<"), dcpl=made)


def _write_shared(out: h5py.File, told: Physical) -> None:
    """What all frames have in common: axes, mesh, names, and where the result comes from."""
    import h5py

    result, mesh, units, text = told.result, told.mesh, told.units, h5py.string_dtype()
    out.attrs.update({"title": f"result {result.path.name}", "source": f"rgbmidic {__version__}", "axes": _AXES})
    if units.mm_per_pixel is not None:
        out.attrs.update({"mm_per_pixel": units.mm_per_pixel, "mm_per_pixel_std": units.mm_per_pixel_std})
    out.create_dataset("provenance", data=json.dumps(dict(result.provenance)), dtype=text)
    scales: dict[str, tuple[AnyArray, str, str]] = {
        "time": (told.times, units.time, "time of the frame" if units.timed else "place of the frame, counted from 0"),
        "node": (np.arange(len(mesh.nodes), dtype=np.int32), "1", "index of the node, as in elements"),
        "element": (np.arange(len(mesh.elements), dtype=np.int32), "1", "index of the element"),
        "corner": (np.arange(3, dtype=np.int32), "1", "corner of the element"),
        "light": (np.array(result.lights, dtype=text), "1", "name of the light"),
    }
    for name, (values, unit, meaning) in scales.items():
        _add(out, name, values, (), unit, meaning).make_scale(name)
    x, y = told.length * mesh.nodes.T
    x_element, y_element = told.length * mesh.nodes[mesh.elements].mean(axis=1).T
    node, element = ("node",), ("element",)
    _add(out, "name", np.array(result.names, dtype=text), ("time",), "1", "name of the frame")
    _add(out, "x", x, node, units.length, "position of the node on the reference image, to the right")
    _add(out, "y", y, node, units.length, "position of the node on the reference image, down")
    _add(out, "elements", mesh.elements, ("element", "corner"), "1", "nodes of the element, counted from 0")
    _add(out, "x_element", x_element, element, units.length, "middle of the element, to the right")
    _add(out, "y_element", y_element, element, units.length, "middle of the element, down")
    _add(out, "area", told.length**2 * mesh.areas, element, f"{units.length}^2", "area of the element")


def _add(out: h5py.File, name: str, values: AnyArray, axes: tuple[str, ...], unit: str, meaning: str) -> h5py.Dataset:
    return _describe(out, out.create_dataset(name, data=values), axes, unit, meaning)


def _describe(out: h5py.File, dataset: h5py.Dataset, axes: tuple[str, ...], unit: str, meaning: str) -> h5py.Dataset:
    dataset.attrs.update({"units": unit or "1", "long_name": meaning})
    for axis, name in zip(dataset.dims, axes, strict=False):
        axis.attach_scale(out[name])
    return dataset


def _declare(out: h5py.File, told: Physical, entry: ResultQuantity) -> None:
    """An array for all frames of a quantity, still without content."""
    axes = tuple(_axis(out, axis) for axis in entry.axes)
    shape = (len(told.result), *(len(out[axis]) for axis in axes))
    dataset = _room(out, entry.name, shape, entry.dtype)
    _describe(out, dataset, ("time", *axes), entry.unit, entry.meaning)
    if entry.codes:
        words = " ".join(code.replace(" ", "_") for code in entry.codes)
        dataset.attrs.update({"flag_values": np.arange(len(entry.codes), dtype=entry.dtype), "flag_meanings": words})
    if told.is_strain(entry.name):
        dataset.attrs["measure"] = "hencky" if entry.name.startswith("equivalent") else told.measure
        gauge = "element" if "element" in axes else f"{told.gauges.length * told.length:.6g} {told.units.length}"
        dataset.attrs["gauge"] = gauge


def _axis(out: h5py.File, axis: str | int) -> str:
    """Name of the dimension scale of an axis; one of a fixed length gets its scale when it is first met."""
    name = axis if isinstance(axis, str) else f"part_of_{axis}"
    if name not in out:
        _add(out, name, np.arange(int(axis), dtype=np.int32), (), "1", "index").make_scale(name)
    return name


def _declare_grid(group: h5py.Group, told: Physical) -> None:
    """The group that VTK's reader looks for: the mesh, the steps, and the nodal quantities."""
    import h5py

    mesh, frames = told.mesh, len(told.result)
    nodes, elements = len(mesh.nodes), len(mesh.elements)
    group.attrs["Version"] = np.array(_VERSION, dtype=np.int64)
    group.attrs.create("Type", b"UnstructuredGrid", dtype=h5py.string_dtype("ascii", len("UnstructuredGrid")))
    group.attrs["axes"] = _AXES_UP
    x, y = told.length * mesh.nodes.T
    group["Points"] = np.stack([x, -y, np.zeros(nodes)], axis=1)
    # y up turns the triangles over: without the exchange of two corners they would be seen from behind
    group["Connectivity"] = mesh.elements[:, [0, 2, 1]].astype(np.int64).ravel()
    group["Offsets"] = 3 * np.arange(elements + 1, dtype=np.int64)
    group["Types"] = np.full(elements, _TRIANGLE, dtype=np.uint8)
    for name, count in {"Points": nodes, "Cells": elements, "ConnectivityIds": 3 * elements}.items():
        group[f"NumberOf{name}"] = np.array([count], dtype=np.int64)
    data, steps, first = group.create_group("PointData"), group.create_group("Steps"), np.zeros(frames, dtype=np.int64)
    steps.attrs["NSteps"] = frames
    steps["Values"] = told.times
    steps["NumberOfParts"] = first + 1
    for name, shape in {
        "Part": (frames,),
        "Point": (frames,),
        "Cell": (frames, 1),
        "ConnectivityId": (frames, 1),
    }.items():
        steps[f"{name}Offsets"] = first.reshape(shape)
    _room(data, "displacement", (frames * nodes, 3), np.float32)
    for entry in told.quantities.values():
        if entry.axes[:1] == ("node",) and entry.name not in ("u", "v"):
            _declare_nodal(data, group.file[entry.name], turned=entry.name in _TURNED)
    for name in data:
        steps[f"PointDataOffsets/{name}"] = nodes * np.arange(frames, dtype=np.int64)


def _declare_nodal(data: h5py.Group, source: h5py.Dataset, *, turned: bool) -> None:
    """A nodal quantity (T, N, ...) of the root as VTK has it, (T N, ...): the same numbers unless `turned`."""
    import h5py

    name, shape = source.name.strip("/"), (source.shape[0] * source.shape[1], *source.shape[2:])
    if turned:
        _room(data, name, shape, source.dtype)
        return
    layout = h5py.VirtualLayout(shape, source.dtype)
    layout[...] = h5py.VirtualSource(".", source.name, source.shape, source.dtype)
    data.create_virtual_dataset(name, layout)


def export_result(
    result: Result, to: str, out: Path | str, *, scale: ScaleSettings | None = None, overwrite: bool = False
) -> None:
    """Write all frames of a result into one file.

    ``"npz"`` is the store, in px: nodes (N, 2), elements (E, 3), names (T,), lights (k,) and every quantity of
    `rgbmidic.results.QUANTITIES` that has one shape in all frames, the frames as first axis.
    ``"csv"`` and ``"hdf5"`` are for engineers: seconds, millimetres where the scale is known, Green-Lagrange
    strain over the shortest virtual strain gauge. csv has a header line, whose names hold the units, and a row per node
    and frame with the quantities that are one number per node.
    x is to the right, y down (ParaView's part of hdf5: up); NaN (an empty field in csv) where not measured.

    Parameters
    ----------
    result
        The result.
    to
        One of `EXPORT_FORMATS`.
    out
        File to write; it appears once it is complete.
    scale
        Stands in place of the ``[scale]`` that was kept with the result; None: that one. npz knows none.
    overwrite
        Whether an existing file may be replaced.

    Raises
    ------
    InputError
        The format is unknown.
    ResultError
        The file exists, its folder does not, or a frame of the result is damaged.
    """
    out = Path(out)
    if to not in _WRITERS:
        raise InputError(f'unknown export format "{to}"; allowed are {", ".join(EXPORT_FORMATS)}')
    check_file(out, overwrite=overwrite)
    from rgbmidic.results.physical import Physical  # numba comes with it

    told = Physical.of(result, scale)
    write_complete(out, lambda file: _WRITERS[to](told, file))


def _write_npz(told: Physical, file: BinaryIO) -> None:
    result = told.result
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("nodes", "elements", "names", "lights"):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(getattr(result, name)), allow_pickle=False)
        for quantity in QUANTITIES.values():
            if quantity.stackable:
                with archive.open(f"{quantity.name}.npy", "w", force_zip64=True) as member:
                    _write_frames(result, quantity, member)


def _write_frames(result: Result, quantity: ResultQuantity, file: IO[bytes]) -> None:
    """One array of all frames, of which one frame at a time is in memory."""
    one = quantity.unmeasured(result.table.layout.sizes)
    head = {"descr": one.dtype.str, "fortran_order": False, "shape": (len(result), *one.shape)}
    np.lib.format.write_array_header_1_0(file, head)
    for value in result.each(quantity.name):
        file.write(np.asarray(value, dtype=one.dtype).tobytes())


def _write_csv(told: Physical, file: BinaryIO) -> None:
    from rgbmidic.fields.history import column

    result, text = told.result, io.TextIOWrapper(file, encoding="utf-8", newline="")
    fields = {name: entry.unit for name, entry in told.quantities.items() if entry.axes == ("node",)}
    del fields["node_status"]  # a whole number
    length, writer = told.units.length, csv.writer(text)
    places = [column(name, length) for name in ("x", "y")]
    time = ["time_s"] if told.units.timed else []
    head = ["frame", "number", "name", *time, "status", "node", "node_status"]
    writer.writerow([*head, *places, *(column(name, unit) for name, unit in fields.items())])
    for index, seconds in enumerate(told.times.tolist()):
        values = told.frame(index)
        one = [index, values["number"], result.names[index], *([f"{seconds:.12g}"] if time else []), values["status"]]
        numbers = np.column_stack([told.length * result.nodes, *(values[name] for name in fields)])
        writer.writerows(_csv_rows(one, values["node_status"], numbers))
    text.detach()  # leaves the file open for whoever opened it


def _csv_rows(one: list[Any], status: AnyArray, numbers: FloatArray) -> Iterator[list[Any]]:
    """What belongs to the frame, then node, its status and numbers, which are empty where they are not known."""
    for node, (code, row) in enumerate(zip(status.tolist(), numbers.tolist(), strict=True)):
        yield [*one, node, code, *("" if number != number else f"{number:.9g}" for number in row)]


def _write_hdf5(told: Physical, file: BinaryIO) -> None:
    from rgbmidic.results.export import write_hdf5

    write_hdf5(told, file)


_WRITERS: dict[str, Callable[[Physical, BinaryIO], None]] = {"npz": _write_npz, "csv": _write_csv, "hdf5": _write_hdf5}
EXPORT_FORMATS = tuple(_WRITERS)
"""Names of the formats that `export_result` writes."""
