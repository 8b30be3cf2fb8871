"""A part of a frame is the same part of the whole frame, of every format, and little else is read where that can be."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import tifffile
from cine_files import write_cine
from frames import noisy_mosaic
from mraw_files import write_mraw
from seq_files import write_seq

from rgbmidic.errors import FrameError
from rgbmidic.frames import Window, open_series, write_dng
from rgbmidic.settings import FrameSettings

SHAPE = (132, 150)
FRAMES = np.random.default_rng(1).integers(0, 1024, (3, *SHAPE)).astype(np.uint16)
COLOUR = np.random.default_rng(2).integers(0, 65536, (*SHAPE, 3)).astype(np.uint16)
MIDDLE = Window.around_points(np.array([[50.0, 70.0], [60.0, 75.0]]), 5, SHAPE)
CORNER = Window.around_points(np.array([[120.0, 110.0]]), 90, SHAPE)


def _tiff(values: Any = FRAMES[0], **options: Any) -> Callable[[Path], object]:
    return lambda path: tifffile.imwrite(path, values, **({"photometric": "minisblack"} | options))


def _cine(**options: Any) -> Callable[[Path], object]:
    return lambda path: write_cine(path, FRAMES % 256 if options["bits"] == 8 else FRAMES, count=3, **options)


def _one_page(path: Path) -> None:
    with tifffile.TiffWriter(path, imagej=True) as writer:
        writer.write(FRAMES, truncate=True, metadata={"axes": "TYX"}, photometric="minisblack")


def _hdf5(**options: Any) -> Callable[[Path], object]:
    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            file.create_dataset("data", data=FRAMES, **options)

    return write


GREY, RGB, RAW = {"kind": "monochrome"}, {"kind": "rgb"}, {"kind": "monochrome", "shape": SHAPE}
FORMATS: dict[str, tuple[Callable[[Path], object], dict[str, Any]]] = {
    "strips.tif": (_tiff(rowsperstrip=7), GREY),
    "swapped.tif": (_tiff(byteorder=">"), GREY),
    "white.tif": (_tiff(photometric="miniswhite"), GREY),
    "tiles.tif": (_tiff(tile=(16, 32)), GREY),
    "zip.tif": (_tiff(compression="zlib"), GREY),
    "rgb.tif": (_tiff(COLOUR, photometric="rgb"), RGB),
    "planes.tif": (_tiff(np.moveaxis(COLOUR, -1, 0), photometric="rgb", planarconfig="separate"), RGB),
    "pages.tif": (_tiff(FRAMES), GREY),
    "zipped_pages.tif": (_tiff(FRAMES, compression="zlib"), GREY),
    "one_page.tif": (_one_page, GREY),
    "grey.png": (lambda path: cv2.imwrite(str(path), FRAMES[0]), GREY),
    "bayer.dng": (lambda path: write_dng(path, noisy_mosaic(SHAPE)), {}),
    "samples.raw": (lambda path: FRAMES[0].tofile(path), RAW | {"dtype": "uint16"}),
    "colour.raw": (lambda path: COLOUR.tofile(path), {"kind": "rgb", "shape": SHAPE, "dtype": "uint16"}),
    "m.npy": (lambda path: np.save(path, FRAMES), GREY),
    "plain.h5": (_hdf5(), GREY),
    "chunks.h5": (_hdf5(chunks=(2, 50, 40), compression="gzip"), GREY),
    "movie.seq": (lambda path: write_seq(path, FRAMES, bits=12), GREY),
    "movie.mraw": (lambda path: write_mraw(path.parent, FRAMES, bits=12), GREY),
    "movie.cihx": (lambda path: write_mraw(path.parent, FRAMES, bits=10), GREY),
    "m8.cine": (_cine(bits=8), {}),
    "m16.cine": (_cine(bits=16, cfa="GBRG"), {}),
    "m10.cine": (_cine(bits=10), {}),
    "m12.cine": (_cine(bits=12, cfa="RGGB"), {}),
}
WHOLE = ("tiles", "zip", "planes", "zipped_pages", "grey", "bayer", "chunks")
"""Those that are decoded whole and then cut."""


@pytest.mark.parametrize("name", FORMATS)
def test_a_part_is_the_same_part_of_the_whole(tmp_path: Path, name: str) -> None:
    write, stated = FORMATS[name]
    write(tmp_path / name)
    series = open_series(FrameSettings(path=(str(tmp_path / name),), **stated))
    (whole,) = series.read(len(series) - 1)
    for window in (MIDDLE, CORNER, Window.of_frame(SHAPE)):
        (part,) = series.read(len(series) - 1, window)
        rows, columns = window.slices_in(Window.of_frame(SHAPE))
        np.testing.assert_array_equal(part.values, whole.values[..., rows, columns])
        assert getattr(part, "cfa", "") == getattr(whole, "cfa", "")
        np.testing.assert_array_equal(part.black_level, whole.black_level)
        assert part.white_level == whole.white_level


def test_windows_begin_on_a_grid_and_hold_their_points_with_the_margin() -> None:
    assert (MIDDLE.origin, MIDDLE.shape) == ((32, 64), (32, 64))
    assert (CORNER.origin, CORNER.shape) == ((0, 0), SHAPE)
    assert CORNER.is_whole
    beside = Window.around_points(np.array([[-500.0, 300.0]]), 10, SHAPE)
    assert (beside.origin, beside.shape) == ((0, 128), (4, 32))


@pytest.mark.parametrize("name", ["strips.tif", "pages.tif", "samples.raw", "m.npy", "plain.h5", "movie.seq",
                                  "movie.mraw", "m16.cine"])  # fmt: skip
def test_little_else_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    shape = (4000, 1000)
    monkeypatch.setitem(globals(), "SHAPE", shape)
    monkeypatch.setitem(globals(), "FRAMES", np.zeros((2, *shape), dtype=np.uint16))
    writers = {"strips.tif": lambda path: tifffile.imwrite(path, FRAMES[0], rowsperstrip=100),
               "pages.tif": lambda path: tifffile.imwrite(path, FRAMES, photometric="minisblack")}  # fmt: skip
    path = tmp_path / name
    writers.get(name, FORMATS[name][0])(path)
    stated = FORMATS[name][1] | ({"shape": shape} if name == "samples.raw" else {})
    series = open_series(FrameSettings(path=(str(path),), **stated))
    window = Window.around_points(np.array([[500.0, 2000.0]]), 50, shape)
    series.read(0, window)
    tracemalloc.start()
    series.read(0, window)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.2 * FRAMES[0].nbytes


def test_a_frame_of_another_size_is_refused(tmp_path: Path) -> None:
    for index in range(2):
        tifffile.imwrite(tmp_path / f"f{index}.tif", FRAMES[index])
    series = open_series(FrameSettings(path=("*.tif",), kind="monochrome"), tmp_path)
    tifffile.imwrite(tmp_path / "f1.tif", FRAMES[1, :, :149])
    with pytest.raises(FrameError, match=r"f1\.tif has 132 rows of 149 pixels, the frames of the test 132 of 150"):
        series.read(1, MIDDLE)
    stated = open_series(FrameSettings(path=("f0.tif",), kind="monochrome", shape=(9, 9)), tmp_path)
    with pytest.raises(FrameError, match=r"shape is stated as \(9, 9\)"):
        stated.read(0, MIDDLE)
