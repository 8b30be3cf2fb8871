"""Result folders: what is kept comes back, damage is told, nothing foreign is touched."""

from __future__ import annotations

import json
import pickle
import zipfile
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from results import LIGHTS, MESH, NODES, make_origin, make_result, random_record

from rgbmidic._version import __version__
from rgbmidic.correlation import NodeStatus, Solution, Status
from rgbmidic.errors import InputError, ResultError
from rgbmidic.results import QUANTITIES, UNKNOWN_TIME, FrameRecord, Result, ResultStore
from rgbmidic.results.records import QuantityAttributes
from rgbmidic.settings import CalibrationSettings, FrameSettings, RegionSettings, TestSettings


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> ResultStore:
    return _create(tmp_path_factory.mktemp("records") / "out", 2)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_record_written_and_read_is_the_same(store: ResultStore, seed: int) -> None:
    record = random_record(seed)
    store.write_frame(0, record)
    back = Result.open(store.path, partial=True).frame(0)
    for name, quantity in QUANTITIES.items():
        np.testing.assert_equal(getattr(back, name), getattr(record, name))
        if quantity.axes:
            assert getattr(back, name).dtype.type is quantity.dtype


def test_result_gives_every_frame_back(tmp_path: Path) -> None:
    result = make_result(tmp_path / "out", frames=4)
    records = [random_record(index) for index in range(4)]
    assert len(result) == 4
    np.testing.assert_array_equal(result.nodes, MESH.nodes)
    np.testing.assert_array_equal(result.elements, MESH.elements)
    stackable = [name for name, quantity in QUANTITIES.items() if quantity.is_stackable]
    assert {"u", "v", "u_std", "v_std", "status", "node_status", "iterations", "residual"} <= set(stackable)
    for name in stackable:
        expected = np.array([getattr(record, name) for record in records])
        np.testing.assert_array_equal(getattr(result, name), expected, err_msg=name)
        assert getattr(result, name).dtype == QUANTITIES[name].dtype, name
    np.testing.assert_array_equal(result.nodal_strain[..., 2], result.nodal_exy)
    np.testing.assert_array_equal(result.nodal_strain_std[..., 0], result.nodal_exx_std)
    for record, history in zip(records, result.iterate("history"), strict=True):
        np.testing.assert_array_equal(history, record.history)
    assert result.reasons == tuple(record.reason for record in records)
    assert result.names == ("frame 0", "frame 1", "frame 2", "frame 3")
    assert result.u.shape == (4, NODES)


def test_frames_may_come_in_any_order_and_twice(tmp_path: Path) -> None:
    store = _create(tmp_path / "out", 3)
    for index in (2, 0, 1, 0):
        store.write_frame(index, random_record(index))
    np.testing.assert_array_equal(Result.open(tmp_path / "out").frame(2).u, random_record(2).u)
    store.finish()
    assert not list((tmp_path / "out").rglob("*.part"))


def test_provenance(tmp_path: Path) -> None:
    (tmp_path / "calibration.json").write_text("{}")
    test = TestSettings(
        frames=FrameSettings(path=("*.dng",)),
        region=RegionSettings(rectangle=(0, 0, 9, 9)),
        calibration=CalibrationSettings(file=tmp_path / "calibration.json"),
        base=tmp_path,
    )
    result = make_result(tmp_path / "out", settings=test, notes={"frame_rate": 1e6}, inputs={"shot.cine": "ab"})
    document = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert document["settings"] == test.to_mapping()
    assert document["calibration"]["sha256"].startswith("44136fa355b3678a")
    assert result.inputs == {"/data/0.dng": "00", "/data/1.dng": "01"}
    assert document["lights"] == list(LIGHTS)
    assert document["frame_rate"] == 1e6
    assert document["inputs"] == {"shot.cine": "ab"}
    assert document["frames"]["count"] == 2
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
    assert left == [
        "frames.json",
        "mesh.npz",
        "notes.txt",
        "provenance.json",
        "solution/000000.npz",
        "solution/notes.txt",
    ]


def test_foreign_files_are_never_replaced(tmp_path: Path) -> None:
    for name, content in {"provenance.json": "{}", "mesh.npz": "", "reference.npz": "", "frames.json": ""}.items():
        out = tmp_path / name.partition(".")[0]
        out.mkdir()
        (out / name).write_text(content)
        with pytest.raises(ResultError, match=name):
            _create(out, 1, overwrite=True)
        assert (out / name).read_text() == content
        with pytest.raises(ResultError, match=name):
            ResultStore.join(out, make_origin(1))
    (tmp_path / "photos" / "solution").mkdir(parents=True)
    (tmp_path / "photos" / "solution" / "000000.npz").touch()
    with pytest.raises(ResultError, match=r"holds a 000000\.npz that is not of a result"):
        make_result(tmp_path / "photos", frames=1)


def test_interrupted_run_keeps_what_was_finished(tmp_path: Path) -> None:
    store = _create(tmp_path / "out", 4)
    assert not Result.open(tmp_path / "out", partial=True).finished.any()
    for index in (0, 3):
        store.write_frame(index, random_record(index))
    with pytest.raises(ResultError, match=r"of 4 frames are missing 1 \(frame 1\), 2 \(frame 2\);"):
        Result.open(tmp_path / "out")
    with pytest.raises(ResultError, match=r"of 4 frames are missing 1 \(frame 1\)"):
        store.finish()
    result = Result.open(tmp_path / "out", partial=True)
    assert len(result) == 4
    assert result.finished.tolist() == [True, False, False, True]
    np.testing.assert_array_equal(result.u[[0, 3]], [random_record(0).u, random_record(3).u])
    assert np.isnan(result.u[1:3]).all()
    assert result.reasons[1:3] == ("not measured yet",) * 2
    assert result.frame(1).time_ns == UNKNOWN_TIME


def test_a_growing_result_is_seen_to_grow(tmp_path: Path) -> None:
    with _create(tmp_path / "out", 3) as store:
        first = Result.open(tmp_path / "out", partial=True)
        for index in (1, 2, 0):
            store.write_frame(index, random_record(index))
        store.finish()
    second = first.refresh()
    assert first.finished.tolist() == [False] * 3
    assert second.finished.all()
    np.testing.assert_array_equal(second.u[1], random_record(1).u)
    make_result(tmp_path / "out", frames=2, overwrite=True)
    with pytest.raises(ResultError, match="another result"):
        second.refresh()


@given(share=st.floats(0, 1, exclude_max=True))
@settings(max_examples=40)
def test_a_truncated_file_loses_its_frame_only(five: Path, share: float) -> None:
    file = five / "solution" / "000003.npz"
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    result = Result.open(five, partial=True)
    read = [result.frame(index).u for index in range(5)]
    file.write_bytes(content)
    assert result.finished.tolist() == [True, True, True, False, True]
    assert result.reasons[3] == "damaged"
    for index in (0, 1, 2, 4):
        np.testing.assert_array_equal(read[index], random_record(2 * index).u)


@pytest.fixture(scope="module")
def five(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("truncated") / "out"
    with _create(path, 5) as store:
        for index in range(5):
            store.write_frame(index, random_record(2 * index))
    return path


def test_a_record_is_an_npz_file(tmp_path: Path) -> None:
    """As numpy and every zip program read it: no array is missing, all checksums are right."""
    record = random_record(2)
    make_result(tmp_path / "out", frames=3)
    file = tmp_path / "out" / "solution" / "000002.npz"
    with zipfile.ZipFile(file) as archive:
        assert archive.testzip() is None
    with np.load(file) as arrays:
        assert list(arrays) == [entry.file_name for entry in QUANTITIES.values()]
        for name, entry in QUANTITIES.items():
            np.testing.assert_array_equal(arrays[entry.file_name], getattr(record, name), err_msg=name)


def test_a_result_of_the_last_schema_is_refused_in_one_line_and_can_be_overwritten(tmp_path: Path) -> None:
    """It held the frames in files of 500."""
    out = make_result(tmp_path / "out", frames=1).path
    document = json.loads((out / "provenance.json").read_text())
    (out / "provenance.json").write_text(
        json.dumps({**document, "schema_version": 10, "versions": {"rgbmidic": "0.0"}})
    )
    (out / "solution" / "000000.npz").rename(out / "solution" / "000000.frames")
    with pytest.raises(ResultError) as told:
        Result.open(out)
    assert str(told.value) == (
        f"{out} has schema version 10, written by rgbmidic 0.0; this rgbmidic {__version__} reads schema version 13: "
        "read it with the version that wrote it, or measure the test again"
    )
    make_result(out, frames=1, overwrite=True)
    assert [file.name for file in (out / "solution").iterdir()] == ["000000.npz"]


def test_a_quantity_is_read_once_and_kept_a_record_is_not(tmp_path: Path) -> None:
    result = make_result(tmp_path / "out", frames=3)
    assert result.u is result.u
    assert result.frame(1) is not result.frame(1)
    result.frame(1).u[:] = 0  # a record is its reader's own
    np.testing.assert_array_equal(result.frame(1).u, random_record(1).u)


def test_the_deformed_frames_are_those_that_are_no_reference(tmp_path: Path) -> None:
    assert make_result(tmp_path / "two", frames=4, references=(1, 2)).deformed == (0, 3)
    assert make_result(tmp_path / "none", frames=2, references=()).deformed == (0, 1)
    result = make_result(tmp_path / "untold", frames=3)
    assert result.deformed == (1, 2)
    assert [u[0] for u in result.iterate("u", result.deformed)] == pytest.approx(result.u[1:, 0].tolist(), nan_ok=True)


def test_result_and_record_have_the_attributes_that_the_table_declares() -> None:
    stacked = {name for name, one in QUANTITIES.items() if one.is_stackable or one.is_estimated}
    assert {name for name in vars(QuantityAttributes) if name[0] != "_"} == stacked
    assert {name for one in FrameRecord.__mro__ for name in vars(one)} >= QUANTITIES.keys()


def test_only_what_stacks_is_an_attribute(tmp_path: Path) -> None:
    result = make_result(tmp_path / "out")
    assert {"u", "nodal_exy_std", "brightness", "nodes"} <= set(dir(result))
    for name in ("history", "weights_thumbnail", "reason", "bogus"):
        assert name not in dir(result)
        with pytest.raises(AttributeError, match=name):
            getattr(result, name)


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
    assert "schema version 14" in damaged("provenance.json", b'{"schema": "rgbmidic-result", "schema_version": 14}')
    assert "schema version 3" in damaged("provenance.json", b'{"schema": "rgbmidic-result", "schema_version": 3}')
    whole = make_result(tmp_path / "whole").provenance
    for part, odd in {"frames": [1], "lights": [1], "settings": {"a": 1}, "references": ["a"], "inputs": None}.items():
        assert "was changed after it was written" in damaged(
            "provenance.json", json.dumps({**whole, part: odd}).encode()
        )
    assert "frames.json is missing" in damaged("frames.json", None)
    assert "frames.json is damaged" in damaged("frames.json", b'["frame 0", "frame 2"]')
    assert "mesh.npz is missing" in damaged("mesh.npz", None)
    assert "mesh.npz is damaged" in damaged("mesh.npz", b"PK")
    assert "is damaged: of 2 frames are lost 0 (frame 0);" in damaged("solution/000000.npz", None)
    assert "000000.npz is damaged in frame 0: its directory" in damaged("solution/000000.npz", bytes(30_000))
    assert "000000.npz is damaged in frame 0: its directory" in damaged("solution/000000.npz", b"")


def test_frame_of_another_mesh_is_refused(tmp_path: Path) -> None:
    store = _create(tmp_path / "out", 1)
    other = FrameRecord.failed("no light", nodes=NODES + 1, lights=len(LIGHTS))
    with pytest.raises(InputError, match=f"sizes.*{NODES + 1}"):
        store.write_frame(0, other)
    with pytest.raises(InputError, match="no frame 1"):
        store.write_frame(1, random_record(0))
    store.write_frame(0, random_record(0))
    np.savez(tmp_path / "out" / "mesh.npz", nodes=MESH.nodes[:-1], elements=MESH.elements)
    with pytest.raises(ResultError, match=r"mesh\.npz is damaged or of another result"):
        Result.open(tmp_path / "out")


def test_failed_record_measures_nothing_and_says_why() -> None:
    record = FrameRecord.failed("file damaged", nodes=5, lights=2)
    measured = [name for name, quantity in QUANTITIES.items() if quantity.axes == ("node",) and name != "node_status"]
    assert all(np.isnan(getattr(record, name)).all() for name in measured)
    assert (record.node_status == NodeStatus.NOT_SEEN).all()
    assert (record.status, record.reason, record.iterations) == (Status.FAILED, "file damaged", 0)
    assert record.history.shape == (0,)
    assert record.reflection_thumbnail.shape == (2, 0, 0)


@pytest.mark.parametrize("name", ["u", "rigid", "history"])
def test_record_of_wrong_shape_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=name):
        FrameRecord.from_values(nodes=3, lights=2, **{name: np.zeros((3, 4, 5))})


def test_record_of_an_unknown_quantity_is_refused() -> None:
    with pytest.raises(InputError, match="unknown: w"):
        FrameRecord.from_values(nodes=3, lights=2, w=np.zeros(3))
    with pytest.raises(AttributeError, match="'w'"):
        _ = FrameRecord.failed("", nodes=3, lights=2).w


def test_every_quantity_of_a_solution_is_taken_from_it() -> None:
    nodes, values = 4, np.random.default_rng(0)
    solution = Solution(
        nodes=values.random((nodes, 2)),
        elements=np.array([[0, 1, 2]], dtype=np.int32),
        displacement=values.random((nodes, 2)),
        displacement_std=values.random((nodes, 2)),
        bias_std=values.random((nodes, 2)),
        edge_std=values.random((nodes, 2)),
        strain=values.random((nodes, 3)),
        strain_std=values.random((nodes, 3)),
        displacement_error=values.random((nodes, 2)),
        strain_error=values.random((nodes, 3)),
        node_status=np.arange(nodes).astype(np.uint8),
        light_fraction=values.random((nodes, 2)),
        misfit=values.random(nodes),
        status=Status.NOT_CONVERGED,
        reason="why",
        rigid=values.random((2, 3)),
        residual=values.random(2),
        weight_fraction=values.random(2),
        history=values.random(6),
    )
    brightness = values.random((2, 2))
    quantities: dict[str, Any] = {
        "number": 7,
        "time_ns": None,
        "warnings": ["dark"],
        "inputs": {"a": "b"},
        "machine": "a processor",
        "checksum": 5,
        "match": 0.9,
        "best_match": 0.95,
        "reference_updates": (2, 4),
        "brightness": brightness,
        "weights_thumbnail": np.full((2, 3, 4), 255, dtype=np.uint8),
        "reflection_thumbnail": None,
    }
    record = pickle.loads(pickle.dumps(FrameRecord.from_solution(solution, **quantities)))
    np.testing.assert_array_equal(np.stack([record.u, record.v], axis=1), solution.displacement)
    single = {name: getattr(solution, name).astype(np.float32) for name in ("displacement_std", "strain", "strain_std")}
    np.testing.assert_array_equal(np.stack([record.u_std, record.v_std], axis=1), single["displacement_std"])
    np.testing.assert_array_equal(
        np.stack([record.nodal_exx, record.nodal_eyy, record.nodal_exy], axis=1), single["strain"]
    )
    np.testing.assert_array_equal(
        np.stack([record.nodal_exx_std, record.nodal_eyy_std, record.nodal_exy_std], 1), single["strain_std"]
    )
    np.testing.assert_array_equal(record.v_bias_std, solution.bias_std[:, 1].astype(np.float32))
    np.testing.assert_array_equal(record.v_edge_std, solution.edge_std[:, 1].astype(np.float32))
    np.testing.assert_array_equal(record.v_mesh_error, solution.displacement_error[:, 1].astype(np.float32))
    np.testing.assert_array_equal(record.nodal_exy_mesh_error, solution.strain_error[:, 2].astype(np.float32))
    for name in ("node_status", "light_fraction", "misfit", "rigid", "residual", "weight_fraction", "history"):
        single = np.asarray(getattr(solution, name), dtype=QUANTITIES[name].dtype)
        np.testing.assert_array_equal(getattr(record, name), single, err_msg=name)
    assert (record.status, record.reason, record.iterations) == (1, "why", 6)
    np.testing.assert_array_equal(record.brightness, brightness.astype(np.float32))
    assert record.inputs.tolist() == [["a", "b"]]
    assert (record.number, record.time_ns, record.warnings.tolist()) == (7, UNKNOWN_TIME, ["dark"])
    assert (record.machine, record.checksum, record.reference_updates.tolist()) == ("a processor", 5, [2, 4])
    assert (record.match, record.best_match) == (np.float32(0.9), np.float32(0.95))
    np.testing.assert_array_equal(record.weights_thumbnail, quantities["weights_thumbnail"])
    assert record.reflection_thumbnail.size == 0
    unprovided = QUANTITIES.keys() - quantities - {name for name, entry in QUANTITIES.items() if entry.source}
    assert unprovided == {"unread", "tries", "seconds"}  # of frames that failed, of the schedule, of timed runs


@pytest.mark.parametrize(("name", "codes"), [("status", Status), ("node_status", NodeStatus)])
def test_the_words_of_a_status_are_the_solvers(name: str, codes: type[IntEnum]) -> None:
    assert QUANTITIES[name].codes == tuple(code.name.lower().replace("_", " ") for code in codes)


def test_reference_is_kept_as_pictures(tmp_path: Path) -> None:
    images = np.random.default_rng(0).normal(1000, 100, (3, 20, 30))
    images[0, 0, 0] = np.nan
    pictures = make_result(tmp_path / "out", reference=images).reference
    assert pictures is not None
    assert (pictures.shape, pictures.dtype, pictures[0, 0, 0]) == ((3, 20, 30), np.uint8, 0)
    assert np.corrcoef(pictures[1].ravel(), images[1].ravel())[0, 1] > 0.99
    assert make_result(tmp_path / "none").reference is None


def _create(path: Path, frames: int, **options: Any) -> ResultStore:
    return ResultStore.create(path, make_origin(frames), **options)
