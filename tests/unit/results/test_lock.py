"""Two runs never write the same frames of one folder; a dead one does not keep them."""

from __future__ import annotations

import json
import os
import pickle
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import Barrier

import numpy as np
import pytest
from results import make_origin, make_result, random_record

from rgbmidic.errors import InputError, ResultError
from rgbmidic.results import Result, ResultStore, finish_result
from rgbmidic.results.lock import FrameLock


def _create(path: Path, *, overwrite: bool = False) -> ResultStore:
    return ResultStore.create(path, make_origin(2), overwrite=overwrite)


def _claims(path: Path) -> list[Path]:
    return list(path.glob("in_use.*"))


def _write_claim(path: Path, process: int, host: str) -> Path:
    path.mkdir(exist_ok=True)
    file = path / "in_use.other.json"
    file.write_text(json.dumps({"process": process, "host": host, "first": 0, "stop": 9}))
    return file


def _dead_process() -> int:
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    return done.pid


def test_second_run_is_refused_and_the_first_goes_on(tmp_path: Path) -> None:
    make_result(tmp_path / "out")
    with _create(tmp_path / "out", overwrite=True) as store:
        store.write_frame(0, random_record(0))
        with pytest.raises(ResultError, match=rf"in use by process {os.getpid()} on {socket.gethostname()}"):
            _create(tmp_path / "out", overwrite=True)
        store.write_frame(1, random_record(1))
        store.finish()
    assert len(Result.open(tmp_path / "out")) == 2
    assert len(make_result(tmp_path / "out", overwrite=True)) == 2


def test_the_folder_is_free_after_an_exception(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), _create(tmp_path / "out"):
        raise KeyboardInterrupt
    assert not _claims(tmp_path / "out")
    with pytest.raises(ResultError, match="already holds a result"):
        _create(tmp_path / "out")
    assert not _claims(tmp_path / "out")


def test_only_the_claim_of_a_dead_process_of_this_host_is_taken_over(tmp_path: Path) -> None:
    alive, dead, here = os.getppid(), _dead_process(), socket.gethostname()
    _write_claim(tmp_path / "dead", dead, here)
    assert len(make_result(tmp_path / "dead")) == 2
    assert not _claims(tmp_path / "dead")
    for name, process, host in (("alive", alive, here), ("elsewhere", dead, "elsewhere")):
        file = _write_claim(tmp_path / name, process, host)
        with pytest.raises(ResultError, match=f"in use by process {process} on {host}.*delete {file}"):
            _create(tmp_path / name)
        assert file.exists()
    file.write_text("half a li")
    with pytest.raises(ResultError, match=f"delete {file}"):
        _create(tmp_path / "elsewhere")


def test_a_claim_is_released_by_who_holds_it_only(tmp_path: Path) -> None:
    FrameLock(file=_write_claim(tmp_path, 1, "elsewhere"), process=os.getpid() + 1).release()
    assert _claims(tmp_path)


def test_parts_are_written_side_by_side_and_exclude_only_each_other(tmp_path: Path) -> None:
    origin, out = make_origin(4), tmp_path / "out"
    with (
        ResultStore.join(out, origin, frames=range(2, 9)) as second,
        ResultStore.join(out, origin, frames=range(2)) as first,
    ):
        for frames in (range(1, 3), None):
            with pytest.raises(ResultError, match="in use"):
                ResultStore.join(out, origin, frames=frames)
        with pytest.raises(ResultError, match="in use"):
            ResultStore.create(out, origin, overwrite=True)
        with pytest.raises(InputError, match="no frame 4 in a result of 4"):
            first.write_frame(4, random_record(2))
        for store, index in ((second, 3), (first, 1), (first, 2), (second, 2)):  # one needs a frame of the other
            store.write_frame(index, random_record(index))
        with pytest.raises(ResultError, match="frame 0"):
            finish_result(out)
        first.write_frame(0, random_record(0))
    finish_result(out)
    np.testing.assert_array_equal(Result.open(out).u, [random_record(index).u for index in range(4)])


@pytest.mark.parametrize("other", [True, False], ids=["another result", "nothing"])
def test_a_result_in_the_place_of_that_of_a_running_test_is_not_written_into(tmp_path: Path, other: bool) -> None:
    path = tmp_path / "out"
    with _create(path) as store:
        store.write_frame(0, random_record(0))
        path.rename(tmp_path / "moved")
        kept = make_result(path) if other else None
        content = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
        for write in (partial(store.write_frame, 1, random_record(1)), partial(store.discard, [0]), store.finish):
            with pytest.raises(ResultError, match=r"was replaced or emptied while|cannot be written"):
                write()
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == content
    assert kept is None or kept.refresh().finished.all()


def test_a_folder_replaced_between_the_check_and_the_end_of_a_record_is_not_written_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "out"

    def check(claim: FrameLock) -> None:
        monkeypatch.undo()
        claim.check()
        path.rename(tmp_path / "moved")
        make_result(path)

    with _create(path) as store:
        monkeypatch.setattr(FrameLock, "check", check)
        with pytest.raises(ResultError, match="cannot be written"):
            store.write_frame(0, random_record(5))
    np.testing.assert_array_equal(Result.open(path).frame(0).u, random_record(0).u)


def test_threads_of_one_process_write_parts_of_one_result(tmp_path: Path) -> None:
    origin, count = make_origin(24), 6
    barrier = Barrier(count)

    def write(first: int) -> None:
        barrier.wait()
        with ResultStore.join(tmp_path / "out", origin, frames=range(first, first + 4)) as store:
            for index in range(first, first + 4):
                store.write_frame(index, random_record(index))

    with ThreadPoolExecutor(count) as pool:
        list(pool.map(write, range(0, 24, 4)))
    finish_result(tmp_path / "out")
    assert not list((tmp_path / "out").glob("*.part"))


def test_a_copy_in_another_process_writes_into_the_same_result(tmp_path: Path) -> None:
    with _create(tmp_path / "out") as store:
        store.write_frame(0, random_record(0))
        pickle.loads(pickle.dumps(store)).write_frame(1, random_record(1))
        store.write_frame(0, random_record(0))
    np.testing.assert_array_equal(Result.open(tmp_path / "out").u, [random_record(0).u, random_record(1).u])
