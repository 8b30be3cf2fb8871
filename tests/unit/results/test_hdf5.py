"""The HDF5 export: what h5py, MATLAB, xarray and ParaView's reader find in one file."""

from __future__ import annotations

import json
import os
import resource
import shutil
from collections import namedtuple
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from results import LIGHTS, MESH, NODES, make_origin, make_result

from rgbmidic.errors import ResultError
from rgbmidic.results import FrameRecord, Result, ResultStore, export_result
from rgbmidic.settings import ScaleSettings
from rgbmidic.typing import FloatArray

X, Y = MESH.nodes.T
SCALE = ScaleSettings(mm_per_pixel=0.05, frame_rate=1000.0)
GRADIENT = np.array([[0.01, 0.02], [-0.004, 0.03]])
"""Of the displacement in the last frame; half of it in the one before, none in the first."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A linear field that grows over three frames, and its export; a corner node is not measured in the last one."""
    path = tmp_path_factory.mktemp("hdf5")
    with ResultStore.create(path / "result", make_origin(3)) as store:
        for index in range(3):
            store.write_frame(index, linear_record(index))
    export_result(Result.open(path / "result"), "hdf5", path / "a.vtkhdf", scale=SCALE)
    return path


def linear_record(index: int) -> FrameRecord:
    u, v = index / 2 * GRADIENT @ MESH.nodes.T
    std = np.full(NODES, 0.01)
    status = np.zeros(NODES, dtype=np.uint8)
    if index == 2:
        u[0] = v[0] = std[0] = np.nan
        status[0] = 1
    shares = np.arange(NODES)[:, None] + np.arange(len(LIGHTS)) / 10
    values = {"u": u, "v": v, "u_std": std, "v_std": std, "node_status": status, "light_fraction": shares}
    return FrameRecord.from_values(
        nodes=NODES, lights=len(LIGHTS), number=10 + index, status=0, misfit=X + index, **values
    )


@pytest.fixture
def file(folder: Path) -> Any:
    with h5py.File(folder / "a.vtkhdf") as opened:
        yield opened


def strain() -> FloatArray:
    """Green-Lagrange strain of the last frame."""
    f = np.eye(2) + GRADIENT
    return (f.T @ f - np.eye(2)) / 2


def test_the_arrays_are_in_millimetres_and_seconds(file: h5py.File) -> None:
    np.testing.assert_allclose(file["time"], [0.010, 0.011, 0.012])
    assert file["time"].attrs["units"] == "s"
    for name, values in {"x": X, "y": Y, "u": np.stack([i / 2 * GRADIENT[0] @ MESH.nodes.T for i in range(3)])}.items():
        expected = 0.05 * values
        if name == "u":
            expected[2, 0] = np.nan
        np.testing.assert_allclose(file[name], expected, rtol=1e-12)
        assert file[name].attrs["units"] == "mm"
    np.testing.assert_array_equal(file["elements"], MESH.elements)
    assert [name.decode() for name in file["name"]] == ["frame 0", "frame 1", "frame 2"]
    assert json.loads(file["provenance"][()])["schema"] == "rgbmidic-result"
    assert "y down" in file.attrs["axes"]


def test_strain_is_finite_and_blank_beside_what_is_not_measured(file: h5py.File) -> None:
    e, blank = strain(), MESH.adjacent_nodes(np.arange(NODES) == 0)
    for name, value in {"exx": e[0, 0], "eyy": e[1, 1], "exy": e[0, 1]}.items():
        np.testing.assert_array_equal(np.isnan(file[name][2]), blank)
        np.testing.assert_allclose(file[name][2][~blank], value, rtol=1e-5)
        assert file[name].attrs["measure"] == "green-lagrange"
        assert file[name].attrs["gauge"].endswith(" mm")
    assert np.nanmax(np.abs(file["exx"][0])) < 1e-12
    assert {file[name].attrs["measure"] for name in ("equivalent", "equivalent_std")} == {"hencky"}


def test_the_virtual_fields_method_has_strain_place_and_area_of_every_element(file: h5py.File) -> None:
    """The virtual work of a linear field: the sum of strain times area is the strain times the area of the region."""
    area, e, known = file["area"][:], strain(), (MESH.elements != 0).all(axis=1)
    assert area.sum() == pytest.approx(100 * 70 * 0.05**2)
    for name, value in {"exx": e[0, 0], "eyy": e[1, 1], "exy": e[0, 1]}.items():
        part = file[f"{name}_element"][2]
        np.testing.assert_array_equal(np.isfinite(part), known)
        assert (part * area)[known].sum() == pytest.approx(value * area[known].sum(), rel=1e-5)
    middle = np.stack([file["x_element"][:], file["y_element"][:]], axis=1)
    np.testing.assert_allclose(area @ middle / area.sum(), 0.05 * np.array([60, 40]))


def test_every_axis_has_its_dimension_scale(file: h5py.File) -> None:
    """As netCDF has it: so xarray opens the file, every array with its coordinates."""
    for name, dataset in file.items():
        if not isinstance(dataset, h5py.Dataset) or not dataset.shape or dataset.is_scale:
            continue
        for axis, size in zip(dataset.dims, dataset.shape, strict=True):
            assert len(axis) == 1, name
            assert axis[0].is_scale
            assert axis[0].shape == (size,)
        assert "units" in dataset.attrs
    assert [axis[0].name for axis in file["light_fraction"].dims] == ["/time", "/node", "/light"]
    assert file["light"].asstr()[:].tolist() == list(LIGHTS)


def test_matlab_finds_plain_arrays_under_its_own_names(file: h5py.File) -> None:
    """Numbers without filters, one after the other, little-endian, and texts: what h5read takes at any version."""
    for name, dataset in file.items():
        if isinstance(dataset, h5py.Dataset):
            assert name.isidentifier()
            assert not dataset.is_virtual
            assert dataset.chunks is None
            text = h5py.check_string_dtype(dataset.dtype)
            assert text is not None or (dataset.dtype.kind in "fiu" and dataset.dtype.str[0] in "<|"), name


def test_the_group_of_vtk_shows_the_same_numbers_with_y_up(file: h5py.File) -> None:
    group, data = file["VTKHDF"], file["VTKHDF/PointData"]
    assert group.attrs["Type"] == b"UnstructuredGrid"
    assert group.attrs["Version"].tolist() == [2, 0]
    np.testing.assert_allclose(group["Points"], 0.05 * np.stack([X, -Y, 0 * X], axis=1))
    for name, dataset in data.items():
        rows = dataset[:].reshape(3, NODES, -1)
        if name == "displacement":
            moved = np.stack([file["u"][:], -file["v"][:]], axis=-1)
            np.testing.assert_allclose(rows[..., :2], moved, rtol=1e-6)
            np.testing.assert_array_equal(rows[..., 2], np.where(np.isnan(moved[..., 0]), np.nan, 0))
        else:
            sign = -1 if name in ("exy", "direction") else 1
            np.testing.assert_array_equal(rows, sign * file[name][:].reshape(rows.shape), err_msg=name)
            assert dataset.is_virtual == (sign == 1), "no copy of what is the same"
    assert {"u_std", "exx", "e1", "equivalent", "misfit", "node_status", "light_fraction"} <= data.keys()


def test_the_steps_share_one_mesh_of_triangles_seen_from_the_front(file: h5py.File) -> None:
    group = file["VTKHDF"]
    steps, count = group["Steps"], group["NumberOfCells"][0]
    assert steps.attrs["NSteps"] == 3
    np.testing.assert_array_equal(steps["Values"], file["time"])
    for name in ("PointOffsets", "CellOffsets", "ConnectivityIdOffsets", "PartOffsets"):
        assert not steps[name][:].any()
    for name in group["PointData"]:
        assert steps["PointDataOffsets"][name][:].tolist() == [0, NODES, 2 * NODES]
    assert (group["NumberOfPoints"][0], count) == (NODES, len(MESH.elements))
    assert group["Offsets"][:].tolist() == list(range(0, 3 * count + 1, 3))
    assert set(group["Types"][:]) == {5}
    a, b, c = np.moveaxis(group["Points"][:][group["Connectivity"][:].reshape(-1, 3)], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_a_strain_with_y_up_is_that_of_the_field_with_y_up(file: h5py.File) -> None:
    """In ParaView's axes the displacement is linear too: its gradient there gives exx, eyy and exy of the group."""
    points, data = file["VTKHDF/Points"][:, :2], file["VTKHDF/PointData"]
    last = slice(2 * NODES + 1, 3 * NODES)
    fit = np.linalg.lstsq(np.c_[points[1:], np.ones(NODES - 1)], data["displacement"][last, :2], rcond=None)[0]
    f = np.eye(2) + fit[:2].T
    e = (f.T @ f - np.eye(2)) / 2
    for name, value in {"exx": e[0, 0], "eyy": e[1, 1], "exy": e[0, 1]}.items():
        assert np.nanmedian(data[name][last]) == pytest.approx(value, rel=1e-4)
    along = np.radians(np.nanmedian(data["direction"][last]))
    towards = np.array([np.cos(along), np.sin(along)])
    np.testing.assert_allclose(e @ towards, np.linalg.eigvalsh(e)[1] * towards, atol=1e-6)


def test_without_scale_and_times_it_is_in_px_and_frames(tmp_path: Path) -> None:
    with ResultStore.create(tmp_path / "result", make_origin(2)) as store:
        for index in range(2):
            store.write_frame(index, linear_record(index))
    export_result(Result.open(tmp_path / "result"), "hdf5", tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert (file["time"].attrs["units"], file["u"].attrs["units"]) == ("frame", "px")
        assert file["time"][:].tolist() == file["VTKHDF/Steps/Values"][:].tolist() == [0, 1]
        np.testing.assert_array_equal(file["x"], X)
        assert "mm_per_pixel" not in file.attrs


def test_a_disk_that_is_too_small_is_told_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(2_000_000, 1_000_000, 1_000_000))
    result = make_result(tmp_path / "result")
    with pytest.raises(ResultError, match=r"a\.h5 cannot be written: No space left on device"):
        export_result(result, "hdf5", tmp_path / "a.h5")
    assert [file.name for file in tmp_path.iterdir()] == ["result"]


@pytest.mark.skipif(os.name == "nt", reason="no limits")
@pytest.mark.parametrize("share", [0.02, 0.5, 0.99])
def test_a_disk_that_fills_up_leaves_nothing(tmp_path: Path, share: float) -> None:
    """A file that may not grow, as the system says it in the middle of a write; the process goes on to write others."""
    result, sizes = make_result(tmp_path / "result"), resource.getrlimit(resource.RLIMIT_FSIZE)
    export_result(result, "hdf5", tmp_path / "whole.h5")
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * (tmp_path / "whole.h5").stat().st_size), sizes[1]))
        with pytest.raises(ResultError, match=r"a\.h5 cannot be written: File too large"):
            export_result(result, "hdf5", tmp_path / "a.h5")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, sizes)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["result", "whole.h5"]
    export_result(result, "hdf5", tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file, h5py.File(tmp_path / "whole.h5") as whole:
        np.testing.assert_array_equal(file["u"], whole["u"])


def test_vtk_reads_every_step(folder: Path, file: h5py.File) -> None:
    """ParaView's own reader; vtk takes 560 MB of disk, so it is no part of the test extra."""
    reading = pytest.importorskip("vtkmodules.vtkIOHDF", reason="vtk is not installed: 560 MB, not in the test extra")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    reader = reading.vtkHDFReader()
    reader.SetFileName(str(folder / "a.vtkhdf"))
    assert reader.CanReadFile(str(folder / "a.vtkhdf"))
    reader.UpdateInformation()
    data = file["VTKHDF/PointData"]
    for index, time in enumerate(file["time"][:]):
        reader.UpdateTimeStep(time)
        grid = reader.GetOutput()
        assert (grid.GetNumberOfPoints(), grid.GetNumberOfCells()) == (NODES, len(MESH.elements))
        for name in data:
            read = vtk_to_numpy(grid.GetPointData().GetArray(name))
            np.testing.assert_array_equal(read, data[name][index * NODES : (index + 1) * NODES], err_msg=name)


@pytest.mark.parametrize("engine", ["h5netcdf", "netcdf4"])
def test_xarray_opens_it_with_coordinates(folder: Path, file: h5py.File, engine: str) -> None:
    xarray = pytest.importorskip("xarray", reason="xarray is not installed: not in the test extra")
    pytest.importorskip({"netcdf4": "netCDF4"}.get(engine, engine), reason=f"{engine} is not installed")
    with xarray.open_dataset(folder / "a.vtkhdf", engine=engine) as dataset:
        assert dataset.u.dims == ("time", "node")
        np.testing.assert_array_equal(dataset.u, file["u"])
        green = dataset.light_fraction.sel(light="green").isel(time=0)
        np.testing.assert_array_equal(green, file["light_fraction"][0, :, 1])
        assert dataset.u.attrs["units"] == "mm"
