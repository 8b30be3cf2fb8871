"""Damaged files: a frame of the announced shape or an error of ours comes out, and nothing reaches standard error."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from mutations import WRITERS, mutated, read_all

COPIES, CINE_COPIES = 40, 150


@pytest.mark.parametrize("name", WRITERS)
def test_a_damaged_file_gives_frames_of_its_shape_or_our_error(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path, (write, stated) = tmp_path / name, WRITERS[name]
    path.parent.mkdir(exist_ok=True)
    write(path)
    content, random, told, read = path.read_bytes(), np.random.default_rng(19), set(), 0
    for number in range(CINE_COPIES if name.endswith(".cine") else COPIES):
        path.write_bytes(mutated(content, random))
        os.utime(path, ns=(number, number))  # copies written within one tick of the clock are different files
        started = time.process_time()
        frames, messages = read_all(path, stated)
        assert time.process_time() - started < 5  # of the processor: .05 at most
        read += frames
        told.update(messages)
    assert told
    assert read
    assert all(path.stem in message and "\n" not in message for message in told)
    assert capfd.readouterr().err == ""
