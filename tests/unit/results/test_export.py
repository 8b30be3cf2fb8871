"""Exports hold what the result holds."""

from __future__ import annotations

import csv
from pathlib import Path

import h5py
import numpy as np
import pytest
from results import LIGHTS, NODES, make_origin, make_result, random_record

from rgbmidic.errors import InputError, ResultError
from rgbmidic.results import (
    EXPORT_FORMATS,
    QUANTITIES,
    FrameRecord,
    Origin,
    Result,
    ResultQuantity,
    ResultStore,
    export_result,
)
from rgbmidic.settings import ScaleSettings
from rgbmidic.typing import AnyArray


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def column(rows: list[dict[str, str]], name: str) -> AnyArray:
    return np.array([float(row[name] or "nan") for row in rows]).reshape(-1, NODES)


@pytest.fixture
def result(tmp_path: Path) -> Result:
    return make_result(tmp_path / "result", frames=3)


def test_npz_holds_every_array(result: Result, tmp_path: Path) -> None:
    export_result(result, "npz", tmp_path / "fields.out")
    with np.load(tmp_path / "fields.out", allow_pickle=False) as archive:
        assert archive["u"].shape == archive["v_std"].shape == (3, NODES)
        assert archive["names"].tolist() == ["frame 0", "frame 1", "frame 2"]
        assert archive["lights"].tolist() == list(LIGHTS)
        stackable = {
            entry.file_name: name for name, entry in QUANTITIES.items() if entry.is_stackable and name != "time_ns"
        }
        assert set(archive.files) == {"nodes", "elements", "names", "lights", "time_s"} | stackable.keys()
        for name in {*archive.files} - {"time_s"}:
            np.testing.assert_array_equal(archive[name], getattr(result, stackable.get(name, name)), err_msg=name)
        np.testing.assert_allclose(archive["time_s"], result.time_ns * 1e-9)


def test_csv_has_one_row_per_node_and_frame(result: Result, tmp_path: Path) -> None:
    export_result(result, "csv", tmp_path / "fields.csv")
    rows = read_csv(tmp_path / "fields.csv")
    assert len(rows) == 3 * NODES
    for name, unit in {"u": "_px", "v": "_px", "u_std": "_px", "v_std": "_px", "misfit": ""}.items():
        np.testing.assert_allclose(column(rows, f"{name}{unit}"), getattr(result, name), rtol=1e-8, err_msg=name)
    x, y = (np.array([float(row[name]) for row in rows[:NODES]]) for name in ("x_px", "y_px"))
    np.testing.assert_allclose(np.stack([x, y], axis=1), result.nodes, rtol=1e-8)
    assert [row["status"] for row in rows[::NODES]] == ["0", "1", "0"]
    assert {(row["u_px"] == "") == (row["node_status"] == "1") for row in rows} == {True}
    np.testing.assert_allclose([float(row["time_s"]) for row in rows[::NODES]], [0, 1.000003e-3, 2.000006e-3])


def test_csv_is_in_millimetres_where_the_scale_is_known(result: Result, tmp_path: Path) -> None:
    scale = ScaleSettings(mm_per_pixel=0.02, mm_per_pixel_std=0.001)
    export_result(result, "csv", tmp_path / "fields.csv", scale=scale)
    rows = read_csv(tmp_path / "fields.csv")
    assert not any("px" in name for name in rows[0])
    np.testing.assert_allclose(column(rows, "u_mm"), 0.02 * result.u, rtol=1e-8)
    np.testing.assert_allclose(column(rows, "x_mm")[0], 0.02 * result.nodes[:, 0], rtol=1e-8)
    spread = np.hypot(0.02 * result.u_std, 0.001 * result.u)
    np.testing.assert_allclose(column(rows, "u_std_mm"), spread, rtol=1e-6)


def test_an_unknown_time_is_left_out_of_csv_and_nan_in_npz(tmp_path: Path) -> None:
    with ResultStore.create(tmp_path / "out", make_origin(1)) as store:
        store.write_frame(0, FrameRecord.from_values(nodes=NODES, lights=len(LIGHTS)))
    export_result(Result.open(tmp_path / "out"), "csv", tmp_path / "fields.csv")
    assert "time" not in (tmp_path / "fields.csv").read_text(encoding="utf-8")
    export_result(Result.open(tmp_path / "out"), "npz", tmp_path / "fields.npz")
    assert np.isnan(np.load(tmp_path / "fields.npz")["time_s"]).all()


def test_only_measured_frames_are_exported_with_their_times(tmp_path: Path) -> None:
    with ResultStore.create(tmp_path / "out", make_origin(4)) as store:
        with pytest.raises(InputError, match=r"no frame of .*out is measured yet"):
            export_result(Result.open(store.path, partial=True), "csv", tmp_path / "a.csv")
        for index in (0, 3):
            store.write_frame(index, random_record(index))
        result = Result.open(store.path, partial=True)
    export_result(result, "csv", tmp_path / "a.csv")
    times = {row["frame"]: row["time_s"] for row in read_csv(tmp_path / "a.csv")}
    assert times == {"0": "0", "3": "0.003000009"}
    export_result(result, "hdf5", tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["name"].asstr()[...].tolist() == ["frame 0", "frame 3"]
        np.testing.assert_allclose(file["time"], [0, 3.000009e-3])
        np.testing.assert_array_equal(file["u"], result.u[[0, 3]])


def test_a_quantity_of_the_table_is_kept_read_and_exported_by_its_entry_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(QUANTITIES, "depth", ResultQuantity("depth", ("node",), "px", "", "how deep"))
    depth = np.arange(3.0)
    origin = Origin(nodes=np.eye(3)[:, :2], elements=[[0, 1, 2]], names=["only"], lights=["one"])
    with ResultStore.create(tmp_path / "out", origin) as store:
        store.write_frame(0, FrameRecord.from_values(nodes=3, lights=1, depth=depth))
    result = Result.open(tmp_path / "out")
    np.testing.assert_array_equal(result.stack("depth"), [depth])
    for to in ("npz", "csv", "hdf5"):
        export_result(result, to, tmp_path / to)
    np.testing.assert_array_equal(np.load(tmp_path / "npz")["depth"], [depth])
    assert [row["depth_px"] for row in read_csv(tmp_path / "csv")] == ["0", "1", "2"]
    with h5py.File(tmp_path / "hdf5") as file:
        np.testing.assert_array_equal(file["depth"], [depth])
        np.testing.assert_array_equal(file["VTKHDF/PointData/depth"], depth)


@pytest.mark.parametrize("to", ["npz", "csv", "hdf5"])
def test_existing_file_is_kept_unless_overwriting_is_allowed(result: Result, tmp_path: Path, to: str) -> None:
    out = tmp_path / "fields"
    out.write_text("mine")
    with pytest.raises(ResultError, match="already exists"):
        export_result(result, to, out)
    assert out.read_text() == "mine"
    export_result(result, to, out, overwrite=True)
    assert out.stat().st_size > 1000


def test_what_cannot_be_exported_leaves_nothing(result: Result, tmp_path: Path) -> None:
    with pytest.raises(InputError, match='"xls"; allowed are npz, csv, hdf5'):
        export_result(result, "xls", tmp_path / "a")
    with pytest.raises(InputError, match=r"a\.csv ends as a file of the format csv, and npz is what is written"):
        export_result(result, "npz", tmp_path / "a.csv")
    with pytest.raises(ResultError, match="no folder"):
        export_result(result, "npz", tmp_path / "none" / "a")
    with pytest.raises(ResultError, match="already exists"):
        export_result(result, "npz", tmp_path, overwrite=True)
    file = result.path / "solution" / "000000.npz"
    file.write_bytes(bytes(file.stat().st_size))
    for to in EXPORT_FORMATS:
        with pytest.raises(ResultError, match="damaged"):
            export_result(Result.open(result.path), to, tmp_path / "b")
    assert [file.name for file in tmp_path.iterdir()] == ["result"]
