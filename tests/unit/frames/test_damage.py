"""Damaged files: a frame of the announced shape or an error of ours comes out, and nothing reaches standard error."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from cine_files import write_cine
from frames import noisy_mosaic

from rgbmidic.errors import FrameError
from rgbmidic.frames import open_source, write_dng
from rgbmidic.settings import FrameSettings

SHAPE = (31, 45)
GREY = noisy_mosaic(SHAPE)
STATED = FrameSettings(path=("frame",), kind="monochrome")
COPIES, MOVIE_COPIES = 150, 510
HEADER = 600


def _tiff(**options: Any) -> Callable[[Path], object]:
    return lambda path: tifffile.imwrite(path, GREY.values, photometric="minisblack", **options)


def _by_opencv(path: Path) -> None:
    assert cv2.imwrite(str(path), GREY.values)


def _cine(**options: Any) -> Callable[[Path], object]:
    """Three small frames, and of the camera's settings what an old one stores: most damage hits what is read."""
    frames = np.random.default_rng(3).integers(0, 256, (3, 6, 8))
    return lambda path: write_cine(path, frames, count=3, setup_length=902, times_ns=[-1000, 0, 3000], **options)


WRITERS: dict[str, tuple[Callable[[Path], object], FrameSettings]] = {
    "plain.tif": (_tiff(rowsperstrip=8), STATED),
    "deflate.tif": (_tiff(compression="zlib", predictor=True, tile=(16, 16)), STATED),
    "lzw.tif": (_by_opencv, STATED),
    "big.tif": (_tiff(bigtiff=True), STATED),
    "grey.png": (_by_opencv, STATED),
    "bayer.dng": (lambda path: write_dng(path, GREY), FrameSettings(path=("frame",))),
    "samples.raw": (
        lambda path: GREY.values.tofile(path),
        FrameSettings(path=("frame",), kind="monochrome", shape=SHAPE, dtype="uint16"),
    ),
    "grey.cine": (_cine(bits=8), FrameSettings(path=("frame",))),
    "colour.cine": (_cine(bits=16, cfa="GBRG", annotation=b"noted"), FrameSettings(path=("frame",))),
    "packed.cine": (_cine(bits=10, cfa="RGGB"), FrameSettings(path=("frame",))),
    "packed_12.cine": (_cine(bits=12, version=0), FrameSettings(path=("frame",))),
}


def _damaged(content: bytes, random: np.random.Generator) -> bytes:
    """A copy with some bytes of its header or anywhere changed, cut short, or with a piece zeroed, lost or doubled."""
    kind, start = random.integers(6), int(random.integers(len(content)))
    end = start + int(random.integers(1, 64))
    if kind < 2:
        copy = bytearray(content)
        for position in random.integers(0, min(HEADER, len(copy)) if kind == 0 else len(copy), random.integers(1, 6)):
            copy[position] = random.choice([0, 1, 127, 255, random.integers(256)])
        return bytes(copy)
    middle = {2: b"", 3: bytes(end - start), 4: b"", 5: 2 * content[start:end]}[int(kind)]
    return content[:start] + middle + (b"" if kind == 2 else content[end:])


@pytest.mark.parametrize("name", WRITERS)
def test_a_damaged_file_gives_frames_of_its_shape_or_our_error(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    write, stated = WRITERS[name]
    write(tmp_path / name)
    content, random, told = (tmp_path / name).read_bytes(), np.random.default_rng(19), set()
    for number in range(MOVIE_COPIES if name.endswith(".cine") else COPIES):
        path = tmp_path / f"{number}_{name}"  # a new name: what is remembered of a file is that of its path
        path.write_bytes(_damaged(content, random))
        source, started = open_source(path, stated), time.perf_counter()
        try:
            frames = [source.read(index) for index in range(min(len(source), 4))]
            assert source.recording.lost is not None
        except FrameError as error:
            told.add(str(error))
        else:
            assert {frame.values.shape[-2:] for frame in frames} == {source.shape}
        assert time.perf_counter() - started < 5
    assert told
    assert all(name in message for message in told)
    assert capfd.readouterr().err == ""
