"""A run that is killed goes on where it was; nobody goes on with another test's result."""

from __future__ import annotations

import importlib.metadata
import multiprocessing
import os
import resource
import time
from contextlib import nullcontext
from ctypes import c_int
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from results import MESH, make_origin, make_result, random_record

from rgbmidic.errors import ResultError
from rgbmidic.results import Result, ResultStore, finish_result, provenance
from rgbmidic.settings import (
    CalibrationSettings,
    FrameSettings,
    MeshSettings,
    ProbeSettings,
    RegionSettings,
    ScaleSettings,
    SolverSettings,
    TestSettings,
)

FRAMES = 600
KILLS = 20
RECORDS = [random_record(seed) for seed in range(20)] * (FRAMES // 20)
_FORK = multiprocessing.get_context("fork") if hasattr(os, "fork") else None
forking = pytest.mark.skipif(_FORK is None, reason="no fork")


def _write(out: Path, written: c_int | None = None) -> None:
    """All frames that are missing; with `written`, which counts them, a part of them, and then wait to be killed."""
    with ResultStore.join(out, make_origin(FRAMES)) as store:
        for index in np.flatnonzero(~store.finished())[::-1]:
            store.write_frame(index, RECORDS[index])
            if written is not None:
                written.value += 1
                time.sleep(3e-4 if written.value < FRAMES // KILLS - 1 else 1000)


@forking
def test_killed_at_any_moment_it_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    """Every other time while it writes frames, else perhaps before."""
    assert _FORK is not None
    out, random, finished = tmp_path / "out", np.random.default_rng(0), [np.zeros(FRAMES, dtype=bool)]
    for kill in range(KILLS):
        written = _FORK.RawValue("i", 0)
        process = _FORK.Process(target=_write, args=(out, written))
        process.start()
        wanted = random.integers(1, FRAMES // KILLS) if kill % 2 else 0
        while written.value < wanted:
            assert process.is_alive()
            time.sleep(1e-4)
        time.sleep(random.uniform(0, 0.03))
        process.kill()
        process.join()
        if (out / "mesh.npz").exists():
            finished.append(Result.open(out, partial=True).finished)
            assert finished[-1][finished[-2]].all()
    assert len({int(there.sum()) for there in finished} - {0, FRAMES}) >= KILLS // 2
    left = [part.name.split(".")[-2] for part in out.rglob("*.npz.*.part")]
    assert len(set(left)) == len(left), "a process writes one frame at a time"
    _write(out)  # which removes what the killed ones left, also those that were killed before they removed it
    finish_result(out)
    assert not list(out.rglob("*.part"))
    result = Result.open(out)
    for index, record in enumerate(RECORDS):
        np.testing.assert_equal(dict(result.frame(index).values), dict(record.values))


@forking
def test_all_who_join_at_once_write_one_result(tmp_path: Path) -> None:
    assert _FORK is not None
    count = 12
    barrier = _FORK.Barrier(count)

    def write(index: int) -> None:
        origin = make_origin(count)
        barrier.wait()
        with ResultStore.join(tmp_path / "out", origin, frames=range(index, index + 1)) as store:
            store.write_frame(index, RECORDS[index])

    runs = [_FORK.Process(target=write, args=(index,)) for index in range(count)]
    for run in runs:
        run.start()
    for run in runs:
        run.join()
    assert [run.exitcode for run in runs] == [0] * count
    np.testing.assert_array_equal(Result.open(tmp_path / "out").u, [record.u for record in RECORDS[:count]])
    assert not list((tmp_path / "out").glob("*.part"))


def _settings(folder: Path, tolerance: float) -> TestSettings:
    (folder / "calibration.json").write_text("{}")
    return TestSettings(
        frames=FrameSettings(path=("*.dng",)),
        region=RegionSettings(rectangle=(0, 0, 9, 9)),
        solver=SolverSettings(tolerance=tolerance),
        calibration=CalibrationSettings(file=folder / "calibration.json"),
        base=folder,
    )


def test_the_result_of_another_test_is_refused_with_the_difference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, inputs = tmp_path / "out", {"shot.cine": "abc", "lamps": "def"}
    origin = make_origin(3, settings=_settings(tmp_path, 0.001), inputs=inputs)
    with ResultStore.create(out, origin) as store:
        store.write_frame(1, random_record(1))
    with ResultStore.resume(out, origin) as store:
        assert store.finished().tolist() == [False, True, False]
    nodes = MESH.nodes + 1
    for told, changed in {
        "solver.tolerance was 0.001, now 0.002": {"settings": _settings(tmp_path, 0.002)},
        'the input shot.cine was "abc", now "xyz"; give': {"inputs": {**inputs, "shot.cine": "xyz"}},
        'the input lamps was "def", now nothing': {"inputs": {"shot.cine": "abc"}},
        "the list of frames was": {"names": ["a", "b", "c"]},
        "the number of frames was 3, now 2": {"names": ["a", "b"]},
        "the mesh was": {"nodes": nodes},
        r'lights was \["red", "green", "blue"\], now \["r", "g", "b"\]': {"lights": ["r", "g", "b"]},
        r"references was \[0\], now \[\]": {"references": ()},
    }.items():
        for enter in (ResultStore.resume, ResultStore.join):
            with pytest.raises(ResultError, match=told):
                enter(out, replace(origin, **changed))
    (tmp_path / "calibration.json").write_text("{ }")
    with pytest.raises(ResultError, match="the calibration was"):
        ResultStore.resume(out, origin)
    (tmp_path / "calibration.json").write_text("{}")
    monkeypatch.setattr(provenance, "__version__", "0.0.1")
    with pytest.raises(ResultError, match=r'the version of rgbmidic was .*, now "0\.0\.1"'):
        ResultStore.resume(out, origin)
    assert not list(out.glob("in_use.*"))
    np.testing.assert_array_equal(Result.open(out, partial=True).frame(1).u, random_record(1).u)


def test_a_frame_number_is_no_true(tmp_path: Path) -> None:
    settings = replace(_settings(tmp_path, 0.001), mesh=MeshSettings(refine=True))
    ResultStore.create(tmp_path / "out", make_origin(3, settings=settings)).release()
    with pytest.raises(ResultError, match=r"mesh\.refine was true, now 1; give"):
        ResultStore.resume(tmp_path / "out", make_origin(3, settings=replace(settings, mesh=MeshSettings(refine=1))))


@pytest.mark.parametrize(("readers", "refused"), [((), False), (("tifffile",), False), (("rawpy",), True)])
def test_only_versions_of_what_reads_the_frames_decide(
    readers: tuple[str, ...], refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    origin = make_origin(3, readers=readers)
    ResultStore.create(tmp_path / "out", origin).release()
    known = importlib.metadata.version
    monkeypatch.setattr("importlib.metadata.version", lambda name: "0.0.1" if name == "rawpy" else known(name))
    with pytest.raises(ResultError, match="the version of rawpy was") if refused else nullcontext():
        ResultStore.resume(tmp_path / "out", origin).release()


def test_another_processor_is_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    origin = make_origin(3)
    ResultStore.create(tmp_path / "out", origin).release()
    ResultStore.resume(tmp_path / "out", origin).release()
    assert not caplog.records
    was = provenance.read_provenance(tmp_path / "out")["machine"]
    monkeypatch.setattr(provenance, "machine", lambda: "abacus, by hand")
    ResultStore.resume(tmp_path / "out", origin).release()
    assert f"begun with {was}, and goes on with abacus, by hand" in caplog.text


def test_how_a_result_is_read_may_change_while_it_is_measured(tmp_path: Path) -> None:
    settings = _settings(tmp_path, 0.001)
    with ResultStore.create(tmp_path / "out", make_origin(3, settings=settings)):
        pass
    read_otherwise = replace(settings, scale=ScaleSettings(mm_per_pixel=0.1), probes=ProbeSettings(points=((1, 2),)))
    with ResultStore.resume(tmp_path / "out", make_origin(3, settings=read_otherwise)) as store:
        assert not store.finished().any()


def test_only_a_result_is_gone_on_with(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="is not a result folder"):
        ResultStore.resume(tmp_path / "none", make_origin(2))
    assert not (tmp_path / "none").exists()


def test_a_start_that_was_killed_is_completed(tmp_path: Path) -> None:
    """The provenance comes first; whatever follows it is made good by whoever comes next."""
    images = np.random.default_rng(0).normal(1000, 100, (3, 20, 30))
    for missing in ("frames.json", "mesh.npz", "reference.npz"):
        out = tmp_path / missing
        make_result(out, reference=images)
        (out / missing).unlink()
        with ResultStore.resume(out, make_origin(2, reference=images)):
            pass
        result = Result.open(out)
        assert result.reference is not None
        np.testing.assert_array_equal(result.u[1], random_record(1).u)


@pytest.mark.skipif(os.name == "nt", reason="no limits")
def test_a_full_disk_is_told_and_the_frames_before_are_kept(tmp_path: Path) -> None:
    """A file that may not grow, as the system says it in the middle of a write: nothing is left of the frame."""
    sizes = resource.getrlimit(resource.RLIMIT_FSIZE)
    with ResultStore.create(tmp_path / "out", make_origin(40)) as store:
        folder = tmp_path / "out" / "solution"
        for index in range(20):
            store.write_frame(index, random_record(1))
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (3000, sizes[1]))
            for frame in (20, 3):  # a new one, and one that is there
                with pytest.raises(ResultError) as told:
                    store.write_frame(frame, random_record(2))
                assert str(told.value) == f"{folder / f'{frame:06d}.npz'} cannot be written: File too large"
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, sizes)
        assert sorted(file.name for file in folder.iterdir()) == [f"{index:06d}.npz" for index in range(20)]
        assert Result.open(tmp_path / "out", partial=True).finished.tolist() == [True] * 20 + [False] * 20
        for later in range(20, 40):  # when there is room again
            store.write_frame(later, random_record(1))
        store.finish()
    np.testing.assert_array_equal(Result.open(tmp_path / "out").u, [random_record(1).u] * 40)
