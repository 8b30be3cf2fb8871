"""A result as an xarray Dataset holds what the result holds, and reads no more than it is asked for."""

from __future__ import annotations

import json
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
from results import LIGHTS, MESH, NODES, corrupt, make_origin, make_result, random_record

from rgbmidic.errors import InputError, ResultError
from rgbmidic.results import QUANTITIES, FrameRecord, Result, ResultStore
from rgbmidic.results.result_in_units import ResultInUnits
from rgbmidic.settings import ScaleSettings

xr = pytest.importorskip("xarray")
STRAIN = [name + end for end in ("", "_std") for name in ("exx", "eyy", "exy")]


@pytest.fixture
def result(tmp_path: Path) -> Result:
    return make_result(tmp_path / "result", frames=5)


def test_every_stackable_quantity_is_there_in_its_unit(result: Result) -> None:
    data = result.to_xarray()
    sizes = {"frame": 5, "node": NODES, "light": 3, "element": len(MESH.elements), "corner": 3, "component": 3}
    assert sizes.items() <= dict(data.sizes).items()
    for name, entry in QUANTITIES.items():
        if entry.is_stackable and entry.file_name not in STRAIN and name != "time_ns":
            np.testing.assert_array_equal(data[name], getattr(result, name), err_msg=name)
            assert data[name].attrs["units"] == (entry.unit or "1")
            assert data[name].attrs["long_name"] == entry.description
            assert data[name].dims[0] == "frame"
    for end in ("", "_std"):
        for name in ("exx", "eyy", "exy"):
            values = [ResultInUnits.from_result(result).frame(frame)[name + end] for frame in range(5)]
            np.testing.assert_array_equal(data[f"strain{end}"].sel(component=name), np.float32(values))
    np.testing.assert_array_equal(data.elements, result.elements)
    np.testing.assert_array_equal(data.x, result.nodes[:, 0])
    assert data.status.attrs["flag_meanings"].split() == ["converged", "not_converged", "failed"]
    assert data.light_fraction.sel(light="green").dims == ("frame", "node")
    assert data.light.values.tolist() == list(LIGHTS)
    assert data.name.values.tolist() == list(result.names)


def test_coordinates_are_in_px_mm_and_s_where_these_are_known(result: Result, tmp_path: Path) -> None:
    assert result.to_xarray(ScaleSettings(mm_per_pixel=0.02, unit="px")).identical(result.to_xarray())
    plain, scaled = result.to_xarray(), result.to_xarray(ScaleSettings(mm_per_pixel=0.02, mm_per_pixel_std=0.001))
    assert (plain.x.units, plain.u.units) == ("px", "px")
    assert "mm_per_pixel" not in plain.attrs
    np.testing.assert_allclose(scaled.y, 0.02 * result.nodes[:, 1])
    np.testing.assert_allclose(scaled.u, 0.02 * result.u, rtol=1e-6)
    assert (scaled.x.units, scaled.u.units, scaled.u_std.units, scaled.time.units) == ("mm", "mm", "mm", "s")
    np.testing.assert_allclose(scaled.time, np.arange(5) * 1.000003e-3)
    with ResultStore.create(tmp_path / "untimed", make_origin(1)) as store:
        store.write_frame(0, FrameRecord.from_values(nodes=NODES, lights=len(LIGHTS)))
    untimed = Result.open(tmp_path / "untimed").to_xarray()
    assert not {"time", "time_ns"} & {*untimed.variables}


@pytest.mark.parametrize(
    "key",
    [
        {"frame": 3},
        {"frame": slice(None, None, -2)},
        {"frame": [4, 0, 4], "node": [7, 2]},
        {"frame": slice(0, 0)},
        {"frame": 1, "node": 5, "component": 2},
        {"frame": slice(1, 4), "node": slice(3, 1, -1), "component": [2, 0]},
    ],
)
def test_a_part_is_the_part_of_the_array(result: Result, key: dict[str, object]) -> None:
    physical = ResultInUnits.from_result(result)
    frames = [np.stack([physical.frame(frame)[name] for name in ("exx", "eyy", "exy")], axis=-1) for frame in range(5)]
    whole = xr.Variable(("frame", "node", "component"), np.float32(frames))
    part = result.to_xarray().strain.isel(key)
    assert part.dtype == np.float32
    np.testing.assert_array_equal(part.values, whole.isel(key).values)


def test_pairs_of_frame_and_node_are_read_point_by_point(result: Result) -> None:
    pairs = {"frame": xr.Variable("pair", [4, 0]), "node": xr.Variable("pair", [7, 2])}
    np.testing.assert_array_equal(result.to_xarray().u.isel(pairs), result.u[[4, 0], [7, 2]])


def test_only_the_frames_asked_for_are_read(result: Result) -> None:
    data = result.to_xarray()
    corrupt(result, 2)
    np.testing.assert_array_equal(data.u.isel(frame=[0, 1, 3, 4]).values, [result.frame(i).u for i in (0, 1, 3, 4)])
    with pytest.raises(ResultError, match="frame 2"):
        data.u.load()


def test_frames_that_are_not_measured_yet_are_without_data(tmp_path: Path) -> None:
    with ResultStore.create(tmp_path / "out", make_origin(3)) as store:
        store.write_frame(0, random_record(0))
        data = Result.open(tmp_path / "out", partial=True).to_xarray()
        assert data.status.values.tolist() == [0, 2, 2]
        assert np.isnan(data.u[1:]).all()
        store.write_frame(1, random_record(1))
        store.write_frame(2, random_record(2))


def test_it_survives_netcdf_and_being_sent_to_a_process(result: Result, tmp_path: Path) -> None:
    data = result.to_xarray(ScaleSettings(mm_per_pixel=0.02))
    data.to_netcdf(tmp_path / "result.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "result.nc") as back:
        xr.testing.assert_allclose(back, data)
        assert json.loads(back.attrs["versions"]) == result.provenance["versions"]
    xr.testing.assert_identical(pickle.loads(pickle.dumps(data)), data)
    np.testing.assert_allclose(data.chunk(frame=2).u.mean("frame"), data.u.mean("frame"))


def test_without_xarray_the_error_says_what_to_install(result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    monkeypatch.delitem(sys.modules, "rgbmidic.results.dataset", raising=False)
    with pytest.raises(InputError, match=r'xarray: pip install "rgbmidic\[xarray\]"'):
        result.to_xarray()
