"""Standard error of C libraries: their lines are caught, those of others pass, and it is there again afterwards."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import pytest

from rgbmidic.frames.metadata import captured_stderr


def test_lines_are_caught_by_their_start_and_the_others_pass(capfd: pytest.CaptureFixture[str]) -> None:
    with captured_stderr(b"libpng ", b"[ERROR") as lines:
        os.write(2, b"libpng error: x\n\nfrom elsewhere\n[ERROR:0] y\n")
    assert lines == ["libpng error: x", "[ERROR:0] y"]
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "from elsewhere\nafter\n"


def test_threads_at_once_leave_standard_error_as_it_was(capfd: pytest.CaptureFixture[str]) -> None:
    def talk(number: int) -> list[str]:
        with captured_stderr(b"line ") as lines:
            os.write(2, f"line {number}\n".encode())
        return lines

    with ThreadPoolExecutor(8) as threads:
        assert list(threads.map(talk, range(200))) == [[f"line {number}"] for number in range(200)]
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"


@captured_stderr(b"line ")
def _fails() -> None:
    os.write(2, b"line 1\nkept\n")
    raise ZeroDivisionError


def test_an_error_inside_comes_out_and_standard_error_is_back(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ZeroDivisionError):
        _fails()
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "kept\nafter\n"
