"""Result folders: what is kept comes back, damage is told, nothing foreign is touched."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from results import LIGHTS, MESH, NODES, make_result, random_record

from rgbmidic.errors import InputError, ResultError
from rgbmidic.results.record import read_record, write_record
from rgbmidic.results.store import FrameRecord, Result, ResultStore
from rgbmidic.settings import FrameSettings, RegionSettings, TestSettings


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("records")


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_record_written_and_read_is_the_same(folder: Path, seed: int) -> None:
    record = random_record(seed)
    write_record(folder / "frame_000000.npz", record)
    back = read_record(folder / "frame_000000.npz")
    for name in FrameRecord.__slots__:
        np.testing.assert_equal(getattr(back, name), getattr(record, name))


def test_result_gives_every_frame_back(tmp_path: Path) -> None:
    result = make_result(tmp_path / "out", frames=4)
    records = [random_record(index) for index in range(4)]
    assert len(result) == 4
    np.testing.assert_array_equal(result.nodes, MESH.nodes)
    np.testing.assert_array_equal(result.elements, MESH.elements)
    for name, expected in {
        "u": [record.displacement[:, 0] for record in records],
        "v": [record.displacement[:, 1] for record in records],
        "u_std": [record.displacement_std[:, 0] for record in records],
        "v_std": [record.displacement_std[:, 1] for record in records],
        "status": [record.status for record in records],
        "node_status": [record.node_status for record in records],
        "iterations": [len(record.history) for record in records],
        "residual": [record.residual for record in records],
        "weight_share": [record.weight_share for record in records],
    }.items():
        np.testing.assert_array_equal(getattr(result, name), expected, err_msg=name)
    assert result.reasons == tuple(record.reason for record in records)
    assert result.names == ("frame 0", "frame 1", "frame 2", "frame 3")
    assert result.u.shape == (4, NODES)


def test_frames_may_come_in_any_order_and_twice(tmp_path: Path) -> None:
    store = _create(tmp_path / "out", 3)
    for index in (2, 0, 1, 0):
        store.write_frame(index, random_record(index))
    np.testing.assert_array_equal(Result.open(tmp_path / "out").frame(2).displacement, random_record(2).displacement)
    assert not list((tmp_path / "out").rglob("*.part"))


def test_provenance(tmp_path: Path) -> None:
    (tmp_path / "calibration.json").write_text("{}")
    test = TestSettings(
        frames=FrameSettings(path=("*.dng",)),
        region=RegionSettings(rectangle=(0, 0, 9, 9)),
        calibration_file=tmp_path / "calibration.json",
        base=tmp_path,
    )
    result = make_result(tmp_path / "out", settings=test, notes={"note": "n"})
    document = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert document["settings"] == test.to_mapping()
    assert document["calibration"]["sha256"].startswith("44136fa355b3678a")
    assert document["inputs"] == result.inputs == {"/data/0.dng": "00", "/data/1.dng": "01"}
    assert document["lights"] == list(LIGHTS)
    assert document["note"] == "n"
    assert {"rgbmidic", "python", "numpy", "numba"} <= set(document["versions"])
    assert document["created"] <= document["finished"]


def test_existing_result_is_kept_unless_overwriting_is_allowed(tmp_path: Path) -> None:
    before = make_result(tmp_path / "out", frames=3).u
    with pytest.raises(ResultError, match="already holds a result"):
        _create(tmp_path / "out", 2)
    np.testing.assert_array_equal(Result.open(tmp_path / "out").u, before)
    (tmp_path / "out" / "notes.txt").write_text("mine")
    (tmp_path / "out" / "solution" / "notes.txt").write_text("mine")
    assert len(make_result(tmp_path / "out", frames=1, overwrite=True)) == 1
    left = sorted(str(file.relative_to(tmp_path / "out")) for file in (tmp_path / "out").rglob("*") if file.is_file())
    assert left == ["mesh.npz", "notes.txt", "provenance.json", "solution/frame_000000.npz", "solution/notes.txt"]


def test_foreign_files_are_never_replaced(tmp_path: Path) -> None:
    for name, content in {"provenance.json": "{}", "mesh.npz": "", "reference.npz": ""}.items():
        out = tmp_path / name.partition(".")[0]
        out.mkdir()
        (out / name).write_text(content)
        with pytest.raises(ResultError, match=name):
            _create(out, 1, overwrite=True)
        assert (out / name).read_text() == content
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "frame_000000.tif").touch()
    make_result(tmp_path / "photos", frames=1)
    assert (tmp_path / "photos" / "frame_000000.tif").exists()


def test_interrupted_run_keeps_what_was_finished(tmp_path: Path) -> None:
    store = _create(tmp_path / "out", 4)
    with pytest.raises(ResultError, match="incomplete"):
        Result.open(tmp_path / "out", partial=True)
    for index in (0, 1, 3):
        store.write_frame(index, random_record(index))
    with pytest.raises(ResultError, match=r"frame 2 \(frame 2\) of 4 is missing"):
        Result.open(tmp_path / "out")
    assert Result.open(tmp_path / "out", partial=True).u.shape == (2, NODES)


@given(share=st.floats(0, 1, exclude_max=True))
@settings(max_examples=40, deadline=None)
def test_truncated_frame_file_is_told(folder: Path, share: float) -> None:
    write_record(folder / "frame_000000.npz", random_record(0))
    content = (folder / "frame_000000.npz").read_bytes()
    (folder / "frame_000001.npz").write_bytes(content[: int(share * len(content))])
    with pytest.raises(ResultError, match=r"frame_000001\.npz is damaged"):
        read_record(folder / "frame_000001.npz")


def test_damage_of_each_part_is_told(tmp_path: Path) -> None:
    def damaged(name: str, content: bytes | None) -> str:
        out = tmp_path / str(len(list(tmp_path.iterdir())))
        make_result(out, frames=2)
        (out / name).unlink() if content is None else (out / name).write_bytes(content)
        with pytest.raises(ResultError) as caught:
            Result.open(out).u.sum()
        return str(caught.value)

    assert "not a result folder" in damaged("provenance.json", None)
    assert "damaged" in damaged("provenance.json", b"{")
    assert "schema" in damaged("provenance.json", b"[]")
    assert "schema version 9" in damaged("provenance.json", b'{"schema": "rgbmidic-result", "schema_version": 9}')
    assert "is missing" in damaged("provenance.json", b'{"schema": "rgbmidic-result", "schema_version": 2}')
    assert "mesh.npz is missing" in damaged("mesh.npz", None)
    assert "mesh.npz is damaged" in damaged("mesh.npz", b"PK")
    assert "frame 1 (frame 1) of 2 is missing" in damaged("solution/frame_000001.npz", None)
    assert "frame_000001.npz is damaged" in damaged("solution/frame_000001.npz", bytes(3000))


def test_frame_of_another_mesh_is_refused(tmp_path: Path) -> None:
    store = _create(tmp_path / "out", 1)
    other = FrameRecord.failed("no light", nodes=NODES + 1, lights=len(LIGHTS))
    with pytest.raises(InputError, match=f"{NODES + 1} nodes"):
        store.write_frame(0, other)
    with pytest.raises(InputError, match="no frame 1"):
        store.write_frame(1, random_record(0))
    write_record(tmp_path / "out" / "solution" / "frame_000000.npz", other)
    with pytest.raises(ResultError, match="does not belong to this mesh"):
        Result.open(tmp_path / "out").frame(0)


def test_failed_record_measures_nothing_and_says_why() -> None:
    record = FrameRecord.failed("file damaged", nodes=5, lights=2)
    assert np.isnan(record.displacement).all()
    assert np.isnan(record.displacement_std).all()
    assert (record.node_status > 0).all()
    assert (record.status, record.reason, record.iterations) == (2, "file damaged", 0)


@pytest.mark.parametrize("name", ["displacement", "rigid", "history"])
def test_record_of_wrong_shape_is_refused(name: str) -> None:
    record = random_record(0)
    content = {slot: getattr(record, slot) for slot in FrameRecord.__slots__}
    with pytest.raises(InputError, match=name):
        FrameRecord(**{**content, name: np.zeros((3, 4, 5))})


def test_reference_is_kept_as_pictures(tmp_path: Path) -> None:
    images = np.random.default_rng(0).normal(1000, 100, (3, 20, 30))
    images[0, 0, 0] = np.nan
    pictures = make_result(tmp_path / "out", reference=images).reference
    assert pictures is not None
    assert (pictures.shape, pictures.dtype, pictures[0, 0, 0]) == ((3, 20, 30), np.uint8, 0)
    assert np.corrcoef(pictures[1].ravel(), images[1].ravel())[0, 1] > 0.99
    assert make_result(tmp_path / "none").reference is None


def _create(path: Path, frames: int, **options: Any) -> ResultStore:
    names = [f"frame {index}" for index in range(frames)]
    return ResultStore.create(path, nodes=MESH.nodes, elements=MESH.elements, names=names, lights=LIGHTS, **options)
