"""The main job over many frames: any number of workers, interrupted, in parts, with workers that die: the same bits."""

from __future__ import annotations

import json
import logging
import pickle
import shutil
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from threading import Barrier, Lock
from typing import Any

import numpy as np
import pytest
from results import corrupt
from textures import Affine, Texture

from rgbmidic._kernels.threads import set_threads, threads
from rgbmidic.correlation import Status, TrackingState
from rgbmidic.errors import ConfigurationError, FrameError, InputError, ResultError, RgbmidicError
from rgbmidic.fields import CameraCalibration
from rgbmidic.frames import read_frame, write_tiff
from rgbmidic.frames.data import ChannelFrame
from rgbmidic.pipeline import Plan, engine, frame, measure, run
from rgbmidic.pipeline.plan import ProcessState
from rgbmidic.results import Maps, Result, finish_result
from rgbmidic.results.result_in_units import ResultInUnits
from rgbmidic.settings import ScaleSettings, TestSettings

COUNT, SHAPE = 36, (72, 80)
in_order = partial(measure, workers=1)


@pytest.fixture(scope="module")
def movie(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plate that swings under a monochrome camera; frame 20 cannot be read, frames 31 and 32 show nothing."""
    folder = tmp_path_factory.mktemp("movie")
    texture, rng = Texture.random(3, contrast=35.0), np.random.default_rng(5)
    for index in range(COUNT):
        motion = Affine.strain_and_rotation(2e-4 * index, 0.0, (3 * np.sin(0.5 * index), 0.1 * index))
        image = texture.image(SHAPE, motion)
        values = np.clip(np.round(image + rng.normal(0, 1.5, SHAPE)), 0, 255)
        if index in (31, 32):
            values = np.full(SHAPE, 20) + rng.integers(0, 2, SHAPE)
        frame = ChannelFrame(values=values.astype(np.uint8)[None], black_level=0.0, white_level=255.0)
        write_tiff(folder / f"f{index:03d}.tif", frame)
    (folder / "f020.tif").write_bytes((folder / "f020.tif").read_bytes()[:900])
    return folder


def settings(movie: Path, **frames: Any) -> TestSettings:
    return TestSettings.from_mapping(
        {
            "frames": {"path": "*.tif", "kind": "monochrome", "white_level": 255, **frames},
            "region": {"rectangle": [12, 12, 66, 58]},
            "mesh": {"element_size": 18.0},
        },
        movie,
    )


@pytest.fixture(scope="module")
def whole(movie: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    """Measured at one go by this process."""
    return measure(settings(movie), tmp_path_factory.mktemp("whole") / "result")


def same(one: Result, other: Result) -> None:
    assert one.names == other.names
    for index in range(len(one)):
        np.testing.assert_equal(one.frame(index).values, other.frame(index).values, err_msg=f"frame {index}")


def test_every_frame_is_measured_or_says_why_not(whole: Result) -> None:
    failed = [20, 31, 32]
    assert np.flatnonzero(whole.status == Status.FAILED).tolist() == failed
    assert "f020.tif" in whole.frame(20).reason
    good = np.setdiff1d(np.arange(COUNT), failed)
    assert (whole.node_status[good] == 0).mean() > 0.99
    assert np.abs(whole.u[good].mean(axis=1) - 3 * np.sin(0.5 * good)).max() < 0.1


def test_two_workers_give_the_same_bits(movie: Path, whole: Result, tmp_path: Path, caplog: Any) -> None:
    with caplog.at_level(logging.WARNING):
        same(measure(settings(movie), tmp_path / "result", workers=2), whole)
    assert "f020.tif" in caplog.text


def test_a_frame_that_kills_every_worker_of_a_cluster_fails_and_the_rest_goes_on(
    movie: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Dying(engine.Threads):
        def submit(self, index: int, start: TrackingState, updated: Any = ()) -> Future[engine.Outcome]:
            if index != 5:
                return super().submit(index, start, updated)
            dead: Future[engine.Outcome] = Future()
            dead.set_exception(RuntimeError("the cluster gave up"))  # as distributed's KilledWorker
            return dead

    monkeypatch.setattr(run, "open_workers", lambda plan, *_: Dying(plan, 1))
    result = measure(settings(movie, last=9), tmp_path / "result")
    assert result.frame(5).reason == "its worker died: RuntimeError"
    assert (result.status[[4, 6, 9]] == Status.CONVERGED).all()


def test_frames_share_the_threads_that_share_a_kernel(movie: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen, both = list[int](), Barrier(2)

    def watched(plan: Plan, index: int, *_: Any) -> Any:
        both.wait(60)  # two frames are being measured
        seen.append(threads())
        both.wait(60)
        return measured

    plan = Plan.from_settings(settings(movie))
    measured = frame.measure_frame_safely(plan, 0, TrackingState(displacement=None))
    before = threads()
    set_threads(4)
    monkeypatch.setattr(engine, "measure_frame_safely", watched)
    try:
        with closing(engine.Threads(plan, 2)) as pool:
            running = [pool.submit(index, TrackingState(displacement=None)) for index in range(2)]
            assert all(one.result(60) is measured for one in running)
        assert seen == [2, 2]
        assert threads() == 4
    finally:
        set_threads(before)


def test_frames_are_read_by_one_thread_at_a_time(movie: Path, whole: Result, tmp_path: Path) -> None:
    names, reading, most = sorted(movie.glob("*.tif")), Lock(), list[bool]()

    class Source:
        def __len__(self) -> int:
            return len(names)

        def __getitem__(self, index: int) -> Any:
            most.append(reading.acquire(blocking=False))
            time.sleep(0.002)
            reading.release()
            return read_frame(names[index], kind="monochrome").values[0]

    stated = settings(movie, path=[], white_level=255)
    measure(stated, tmp_path / "result", source=Source(), workers=3)
    assert all(most)


def test_the_frames_of_chains_are_measured_in_step(
    movie: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the end of a test no chain is left alone, which one worker would measure while the others wait."""
    order = list[int]()

    class Watching(engine.Threads):
        def submit(self, index: int, start: TrackingState, updated: Any = ()) -> Future[engine.Outcome]:
            order.append(index)
            return super().submit(index, start, updated)

    def two(plan: Plan, *_: Any) -> engine.Threads:
        found = Watching(plan, 1)
        found.slots = 2
        return found

    monkeypatch.setattr(run, "open_workers", two)
    measure(settings(movie), tmp_path / "result")
    assert set(order) == set(range(COUNT))
    assert max(order.index(16), order.index(32)) < order.index(5)  # three chains for two workers


def test_threads_of_a_process_make_an_updated_reference_once() -> None:
    process, made = ProcessState(), list[object]()

    def make() -> Any:
        time.sleep(0.05)
        made.append(object())
        return made[-1]

    with ThreadPoolExecutor(8) as threads:
        got = list(threads.map(lambda _: process.reference_update((1, 2), make), range(8)))
    assert got == made * 8
    assert pickle.loads(pickle.dumps(process)).reference_update((1, 2), make) is not got[0]
    assert len(made) == 2


def test_a_dask_scheduler_that_is_killed_ends_the_run_in_one_line_and_the_bits_are_the_same(
    movie: Path, whole: Result, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("distributed", reason="dask and distributed are not installed")
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--dashboard-address", ":0"]
    where = tmp_path / "scheduler.json"
    scheduler = subprocess.Popen([*command, "--scheduler-file", where], stderr=subprocess.DEVNULL)
    worker = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", where, "--nthreads", "1"],
        stderr=subprocess.DEVNULL,
    )

    def kill(done: int, total: int, line: str) -> None:
        if done == 3:
            scheduler.kill()
            # what it logs when it looks for its scheduler again
            logging.getLogger("distributed.client").error("Traceback (most recent call last):")

    logging.getLogger("distributed.client").setLevel(logging.WARNING)  # as its configuration does
    try:
        end = time.monotonic() + 60
        while not where.exists() and time.monotonic() < end:
            assert scheduler.poll() is None
            time.sleep(0.1)
        address = json.loads(where.read_text())["address"]
        with pytest.raises(RgbmidicError, match=r"no longer answer; .* `resume=True`"):
            measure(settings(movie), tmp_path / "result", scheduler=address, progress=kill)
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()
    partial = Result.open(tmp_path / "result", partial=True)
    assert 3 <= partial.finished.sum() < COUNT
    for index in np.flatnonzero(partial.finished).tolist():  # of a worker that is another process
        np.testing.assert_equal(partial.frame(index).values, whole.frame(index).values)
    assert not [record for record in caplog.records if record.name.startswith("distributed")]


@pytest.mark.parametrize("stop", [13, 35])
def test_an_interrupted_run_goes_on_to_the_same_bits(movie: Path, whole: Result, tmp_path: Path, stop: int) -> None:
    def interrupt(done: int, total: int, line: str) -> None:
        if done == stop:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure(settings(movie), tmp_path / "result", progress=interrupt)
    partial = Result.open(tmp_path / "result", partial=True)
    assert partial.finished.sum() == stop
    assert partial.frame(COUNT - 1).reason == "not measured yet"
    same(measure(settings(movie), tmp_path / "result", resume=True), whole)


def test_parts_in_any_order_make_the_whole(movie: Path, whole: Result, tmp_path: Path) -> None:
    out = tmp_path / "result"
    for part in (range(17, 36), range(17)):
        with pytest.raises(ResultError, match=r"not a result|are missing"):
            finish_result(out)
        measure(settings(movie), out, frames=part)
    finish_result(out)
    same(Result.open(out), whole)


def copied(movie: Path, folder: Path) -> Path:
    return Path(shutil.copytree(movie, folder / "movie"))


def counted(measured: list[str]) -> Any:
    return lambda done, total, line: measured.append(line.partition(".")[0])


@pytest.mark.parametrize("away", [(6, 7, 8, 9, 15, 16), (18, 19)])
def test_frames_that_were_away_for_a_moment_are_measured_when_they_are_back(
    movie: Path, whole: Result, tmp_path: Path, away: tuple[int, ...], caplog: Any
) -> None:
    """Whatever started from before them comes back to the bits of a run without an outage, also if interrupted."""
    folder, out = copied(movie, tmp_path), tmp_path / "result"
    files = [folder / f"f{index:03d}.tif" for index in away]

    def outage(done: int, total: int, line: str) -> None:
        for file in files if done in (4, 30) else ():
            file.rename(file.with_suffix(".away")) if done == 4 else file.with_suffix(".away").rename(file)

    result = in_order(settings(folder), out, progress=outage)
    assert np.flatnonzero(result.unread).tolist() == sorted((*away, 20))
    assert np.flatnonzero(result.status == Status.FAILED).tolist() == sorted((*away, 20, 31, 32))
    measured: list[str] = []

    def interrupt(done: int, total: int, line: str) -> None:
        measured.append(line)
        if len(measured) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        in_order(settings(folder), out, resume=True, progress=interrupt)
    assert f"since it can be read now: {away[0]} " in caplog.text
    again = in_order(settings(folder), out, resume=True, progress=counted(measured))
    assert len(measured) == COUNT - away[0]  # what lies before does not depend on them
    for index in range(COUNT):  # f020.tif is named with its folder
        expected = {**whole.frame(index).values, "inputs": None, "reason": None}
        np.testing.assert_equal({**again.frame(index).values, "inputs": None, "reason": None}, expected)


def test_a_file_that_could_not_be_read_from_the_start_is_measured_when_it_can_be(
    movie: Path, whole: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, out = copied(movie, tmp_path), tmp_path / "result"
    opened = Path.open

    def refused(self: Path, *arguments: Any, **named: Any) -> Any:
        if self.name == "f003.tif":
            raise PermissionError(13, "Permission denied")
        return opened(self, *arguments, **named)

    with monkeypatch.context() as away:
        away.setattr(Path, "open", refused)
        before = measure(settings(folder, last=6), out)
    assert np.flatnonzero(before.unread).tolist() == [3]
    after = measure(settings(folder, last=6), out, resume=True)
    assert not after.unread.any()
    np.testing.assert_array_equal(after.u, whole.u[:7])
    (folder / "f005.tif").write_bytes((folder / "f004.tif").read_bytes())
    with pytest.raises(ResultError, match=r"the input .* was"):
        measure(settings(folder, last=6), out, resume=True)


@pytest.mark.parametrize("kind", ["folder", "movie"])
def test_a_source_that_vanishes_stops_the_run_and_fails_no_frame(
    movie: Path, whole: Result, tmp_path: Path, kind: str
) -> None:
    folder, out = copied(movie, tmp_path), tmp_path / "result"
    chosen, told = settings(folder), r"frames are gone: .*f000\.tif and all 36 files.*`resume=True`"
    if kind == "movie":
        frames = [read_frame(folder / f"f{index:03d}.tif", kind="monochrome").values[0] for index in range(12)]
        np.save(folder / "stack.npy", np.stack(frames))
        chosen, told = settings(folder, path="stack.npy"), r"frames are gone: .*stack\.npy.*`resume=True`"

    def vanish(done: int, total: int, line: str) -> None:
        if done == 10:
            folder.rename(tmp_path / "elsewhere")

    with pytest.raises(FrameError, match=told):
        in_order(chosen, out, progress=vanish)
    partial = Result.open(out, partial=True)
    assert partial.finished.sum() == 10
    assert (partial.status[:10] == Status.CONVERGED).all()
    (tmp_path / "elsewhere").rename(folder)
    resumed = in_order(chosen, out, resume=True)
    np.testing.assert_array_equal(resumed.u, whole.u[: len(resumed)])


def test_a_finished_result_is_gone_on_with_only_where_it_is_damaged(
    movie: Path, whole: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    out = Path(shutil.copytree(whole.path, tmp_path / "result"))
    kept = (out / "provenance.json").read_bytes()
    monkeypatch.setattr("rgbmidic.results.result.current_time", lambda: "later")
    measured: list[str] = []
    same(in_order(settings(movie), out, resume=True, progress=counted(measured)), whole)
    assert "is finished and whole: nothing is left to be measured" in caplog.text
    assert ((out / "provenance.json").read_bytes(), measured) == (kept, [])
    corrupt(Result.open(out), 12)
    (out / "solution" / "000025.npz").unlink()
    with pytest.raises(ResultError, match=r"damaged: of 36 frames are lost 25 \(f025\.tif\); .*--res"):
        Result.open(out)
    same(in_order(settings(movie), out, resume=True, progress=counted(measured)), whole)
    assert "lost to damage and measured again: 12 (f012.tif), 25 (f025.tif)" in caplog.text
    assert measured == ["f012", *(f"f{index:03d}" for index in range(25, COUNT))]  # nobody knows that 25 had not failed
    assert Result.open(out).provenance["finished"] == "later"


def test_frames_that_failed_otherwise_are_measured_again_where_that_is_asked(
    movie: Path, whole: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(plan: Any, index: int, start: TrackingState, updated: Any) -> Any:
        failed = (frame.failed_frame(plan, index, "out of memory"), None)
        return failed if index == 33 else frame.measure_frame_safely(plan, index, start, updated)

    with monkeypatch.context() as patched:
        patched.setattr("rgbmidic.pipeline.engine.measure_frame_safely", failing)
        measure(settings(movie), tmp_path / "result")
    measured: list[str] = []
    result = measure(settings(movie), tmp_path / "result", resume=True, progress=counted(measured))
    assert (result.frame(33).reason, measured) == ("out of memory", [])
    with pytest.raises(InputError, match="`retry_failed` goes with `resume`"):
        measure(settings(movie), tmp_path / "result", retry_failed=True)
    same(measure(settings(movie), tmp_path / "result", resume=True, retry_failed=True), whole)


def test_how_a_result_is_read_is_stated_anew_by_going_on_with_it(movie: Path, whole: Result, tmp_path: Path) -> None:
    out = Path(shutil.copytree(whole.path, tmp_path / "result"))
    text = (out / "provenance.json").read_text()
    (out / "provenance.json").write_text(text.replace('"element_size": 18.0', '"element_size": 19.0'))
    with pytest.raises(ResultError, match=r"provenance\.json was changed after it was written.*--test TEST\.toml"):
        Result.open(out)
    (out / "provenance.json").write_text(text)
    scaled = TestSettings.from_mapping({**settings(movie).to_mapping(), "scale": {"mm_per_pixel": 0.02}}, movie)
    result = measure(scaled, out, resume=True)
    assert (whole.section(ScaleSettings).mm_per_pixel, result.section(ScaleSettings).mm_per_pixel) == (None, 0.02)
    assert result.provenance["finished"] == whole.provenance["finished"]
    same(result, whole)
    camera = CameraCalibration(shape=SHAPE[-2:], homography=np.diag([0.02, 0.02, 1]))
    camera.write(tmp_path / "camera.json")
    plane = TestSettings.from_mapping(
        {**settings(movie).to_mapping(), "scale": {"camera": str(tmp_path / "camera.json")}}, movie
    )
    (u,), (again,) = (
        np.array([ResultInUnits.from_result(one).frame(3)["u"]]) for one in (result, measure(plane, out, resume=True))
    )
    np.testing.assert_allclose(again, u, rtol=1e-6, atol=1e-9)


def test_going_on_with_something_else_is_refused_by_name(movie: Path, whole: Result, tmp_path: Path) -> None:
    with pytest.raises(ResultError, match=r"frames\.first.*was.*now"):
        measure(settings(movie, first=1), whole.path, resume=True)
    with pytest.raises(ResultError, match="not a result folder"):
        measure(settings(movie), tmp_path / "nothing", resume=True)
    with pytest.raises(FrameError, match="`frames` are 30 to 39; the test has the frames 0 to 35"):
        measure(settings(movie), tmp_path / "nothing", frames=range(30, 40))
    assert not (tmp_path / "nothing").exists()


def test_chosen_frames_keep_their_numbers_and_the_reference_may_lie_outside(
    movie: Path, whole: Result, tmp_path: Path
) -> None:
    result = measure(settings(movie, first=4, last=14, step=5, reference=[0]), tmp_path / "result")
    assert result.names == ("f004.tif", "f009.tif", "f014.tif")
    assert result.number.tolist() == [4, 9, 14]
    assert result.deformed == (0, 1, 2)
    np.testing.assert_allclose(result.u, whole.u[4:15:5], atol=0.03)  # they start from elsewhere: half of u_std


def test_a_key_frame_that_is_lost_is_measured_from_the_frame_before_it(
    movie: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts: list[tuple[int, float]] = []

    def watched(plan: Any, index: int, start: TrackingState, updated: Any) -> Any:
        moved = np.inf if start.displacement is None else float(start.displacement[:, 1].mean())
        starts.append((index, moved))
        lost = (frame.failed_frame(plan, index, "lost"), None)
        return lost if index == 16 and len(starts) == 17 else frame.measure_frame_safely(plan, index, start, updated)

    monkeypatch.setattr("rgbmidic.pipeline.engine.measure_frame_safely", watched)
    result = in_order(settings(movie, last=18), tmp_path / "result")
    tries = [moved for index, moved in starts if index == 16]
    assert tries == pytest.approx([0.0, 1.5], abs=0.1)
    assert (result.status == Status.CONVERGED).all()


def test_a_dask_cluster_gives_the_same_bits(movie: Path, whole: Result, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="dask and distributed are not installed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None, memory_limit=0
    ) as cluster:
        same(measure(settings(movie), tmp_path / "result", scheduler=cluster.scheduler_address), whole)


def renewing_test(folder: Path, motions: list[Affine], worn_deg: float, noise: float) -> TestSettings:
    """A test that renews its reference, of paint that gives way to another by an angle per frame."""
    old, new, rng = Texture.random(3, contrast=35.0), Texture.random(4, contrast=35.0), np.random.default_rng(1)
    for index, motion in enumerate(motions):
        worn = np.radians(worn_deg * index)
        image = 200 + np.cos(worn) * (old.image(SHAPE, motion) - 200) + np.sin(worn) * (new.image(SHAPE, motion) - 200)
        values = np.clip(np.round(image + rng.normal(0, noise, SHAPE)), 0, 255).astype(np.uint8)
        frame = ChannelFrame(values=values[None], black_level=0.0, white_level=255.0)
        write_tiff(folder / f"f{index:03d}.tif", frame)
    document = {**settings(folder, update_reference=True).to_mapping(), "region": {"rectangle": [22, 18, 58, 54]}}
    return TestSettings.from_mapping(document, folder)


def check_last(result: Result, motion: Affine, largest_rms: float) -> None:
    last = result.frame(19)
    assert (last.node_status == 0).all()
    error = np.stack([last.u, last.v], axis=1) - motion.displacement(result.nodes, SHAPE)
    assert np.sqrt((error**2).mean()) < largest_rms
    assert 0.5 < np.sqrt(((error / np.stack([last.u_std, last.v_std], axis=1)) ** 2).mean()) < 2


def test_a_rotation_is_followed_without_a_new_reference(tmp_path: Path) -> None:
    motions = [Affine.strain_and_rotation(0.0, 3.0 * index) for index in range(20)]
    result = measure(renewing_test(tmp_path, motions, 0.0, 1.0), tmp_path / "result")
    assert len(result.frame(19).reference_updates) == 0
    check_last(result, motions[-1], 0.1)


def test_paint_that_wears_off_is_followed_by_renewed_references_to_the_same_bits(tmp_path: Path) -> None:
    motions = [Affine(shift=(0.1 * index, 0.0)) for index in range(20)]
    chosen = renewing_test(tmp_path, motions, 0.9, 2.0)

    def interrupt(done: int, total: int, line: str) -> None:
        if done == 18:
            raise KeyboardInterrupt

    renewing = measure(chosen, tmp_path / "renewing")
    assert len(renewing.frame(19).reference_updates) >= 1
    check_last(renewing, motions[-1], 1.0)  # a third of the paint is another one
    with pytest.raises(KeyboardInterrupt):
        measure(chosen, tmp_path / "resumed", progress=interrupt)
    same(measure(chosen, tmp_path / "resumed", resume=True), renewing)


def test_the_discretisation_error_is_kept_where_it_is_asked_for(movie: Path, tmp_path: Path) -> None:
    document = settings(movie, first=0, last=17).to_mapping()
    kept = {}
    for asked in (False, "key", True):
        document["mesh"]["error"] = asked
        result = kept[asked] = measure(TestSettings.from_mapping(document, movie), tmp_path / str(asked))
        known = [bool(values.size) for values in result.iterate("u_mesh_error")]
        assert known == [asked is True or (asked == "key" and frame in (0, 16, 17)) for frame in range(18)]
    assert np.array_equal(kept[True].u, kept[False].u, equal_nan=True)
    assert kept["key"].nodal_exx_mesh_error.shape == kept["key"].u.shape
    maps, plain = Maps.from_result(kept[True]), Maps.from_result(kept[False])
    assert "finer_mesh" not in plain.quantities
    total, error = (maps.read(f"u_{name}", 17).values for name in ("total", "mesh_error"))
    assert np.allclose(total, np.hypot(error, kept[True].u_std[17]), equal_nan=True)
    assert np.isfinite(maps.read("finer_mesh", 17).values).any()


@pytest.mark.parametrize(
    ("mesh", "frames", "message"),
    [
        ({"error": "all"}, {}, "mesh.error"),
        ({"error": True, "element_size": 6}, {}, "mesh.element_size must be 8 px or more for it, not 6"),
        ({"error": True}, {"update_reference": True}, "frames.update_reference makes others"),
    ],
)
def test_a_discretisation_error_that_cannot_be_known_is_refused(
    movie: Path, mesh: dict[str, Any], frames: dict[str, Any], message: str
) -> None:
    document = settings(movie, **frames).to_mapping()
    document["mesh"] |= mesh
    with pytest.raises(ConfigurationError, match=message):
        TestSettings.from_mapping(document, movie)
