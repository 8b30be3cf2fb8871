"""Two runs never write into one folder; a dead one does not keep it."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from results import LIGHTS, MESH, make_result, random_record

from rgbmidic.errors import ResultError
from rgbmidic.results import Result, ResultStore

LOCK = "in_use.json"


def _create(path: Path, **options: bool) -> ResultStore:
    return ResultStore.create(
        path, nodes=MESH.nodes, elements=MESH.elements, names=["f0", "f1"], lights=LIGHTS, **options
    )


def _write_lock(path: Path, process: int, host: str) -> None:
    path.mkdir(exist_ok=True)
    (path / LOCK).write_text(json.dumps({"process": process, "host": host}))


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
    assert not (tmp_path / "out" / LOCK).exists()
    with pytest.raises(ResultError, match="already holds a result"):
        _create(tmp_path / "out")
    assert not (tmp_path / "out" / LOCK).exists()


def test_only_the_lock_of_a_dead_process_of_this_host_is_taken_over(tmp_path: Path) -> None:
    alive, dead, here = os.getppid(), _dead_process(), socket.gethostname()
    _write_lock(tmp_path / "dead", dead, here)
    assert len(make_result(tmp_path / "dead")) == 2
    assert not (tmp_path / "dead" / LOCK).exists()
    for name, process, host in (("alive", alive, here), ("elsewhere", dead, "elsewhere")):
        _write_lock(tmp_path / name, process, host)
        with pytest.raises(ResultError, match=f"in use by process {process} on {host}"):
            _create(tmp_path / name)
    (tmp_path / "alive" / LOCK).write_text("half a li")
    with pytest.raises(ResultError, match=f"delete {tmp_path / 'alive' / LOCK}"):
        _create(tmp_path / "alive")


def test_the_lock_of_another_is_never_released(tmp_path: Path) -> None:
    store = _create(tmp_path / "out")
    _write_lock(tmp_path / "out", os.getppid(), socket.gethostname())
    store.finish()
    assert (tmp_path / "out" / LOCK).exists()
