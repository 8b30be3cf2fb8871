"""Camera files mutated at random: every frame, whole and in part, is read in its shape or refused with our error.

``python tests/mutations.py 1000 [SEED] [FILE ...]`` mutates every small written file as often, in a process of its own
with limited memory and time, and prints what became of them; a FILE is of `WRITERS` or one of a camera.
"""

from __future__ import annotations

import glob
import logging
import multiprocessing
import os
import resource
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from shutil import copy
from typing import Any

import cv2
import h5py
import numpy as np
import tifffile
from cine_files import write_cine
from frames import noisy_mosaic, write_lossless_dng
from mraw_files import write_mraw
from seq_files import write_seq

from rgbmidic.errors import RgbmidicError
from rgbmidic.frames import ChannelFrame, FrameSeries, Mosaic, Window, open_series, write_dng
from rgbmidic.settings import FrameSettings

SHAPE = (31, 45)
GREY = noisy_mosaic(SHAPE)
FRAMES = np.random.default_rng(3).integers(0, 4096, (5, 12, 16)).astype(np.uint16)
FILE, STATED = FrameSettings(path=("frame",)), FrameSettings(path=("frame",), kind="monochrome")
MOST_FRAMES = 40
"""More are not read of a movie whose header was made to announce them."""
MEMORY, SECONDS, HANGS, LINES = 4 * 2**30, 2.0, 20.0, 10
"""Bytes of address space; s of processor time and of waiting; lines of the log: more of a file are a failure."""


def _tiff(values: Any = GREY.values, **options: Any) -> Callable[[Path], object]:
    return lambda path: tifffile.imwrite(path, values, photometric="minisblack", **options)


def _by_opencv(path: Path) -> None:
    assert cv2.imwrite(str(path), GREY.values)


def _cine(**options: Any) -> Callable[[Path], object]:
    """Three small frames, and of the camera's settings what an old one stores: most mutations hit what is read."""
    frames = np.random.default_rng(3).integers(0, 256, (3, 6, 8))
    return lambda path: write_cine(path, frames, count=3, setup_length=902, times_ns=[-1000, 0, 3000], **options)


def _behind_one_page(path: Path) -> None:
    with tifffile.TiffWriter(path, imagej=True) as writer:
        writer.write(FRAMES, truncate=True, metadata={"axes": "TYX", "finterval": 0.1}, photometric="minisblack")


def _mraw(bits: int, ending: str) -> Callable[[Path], object]:
    return lambda path: write_mraw(path.parent, FRAMES >> max(12 - bits, 0), bits=bits, ending=ending)


def _hdf5(**options: Any) -> Callable[[Path], object]:
    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            file.create_dataset("entry/data", data=FRAMES, **options).attrs["frame_rate"] = 1e3

    return write


WRITERS: dict[str, tuple[Callable[[Path], object], FrameSettings]] = {
    "plain.tif": (_tiff(rowsperstrip=8), STATED),
    "tiles.tif": (_tiff(tile=(16, 16)), STATED),
    "deflate.tif": (_tiff(compression="zlib", predictor=True, tile=(16, 16)), STATED),
    "lzw.tif": (_by_opencv, STATED),
    "big.tif": (_tiff(bigtiff=True), STATED),
    "pages.tif": (_tiff(FRAMES), STATED),
    "ome.tif": (_tiff(FRAMES, ome=True, metadata={"axes": "TYX", "TimeIncrement": 0.1}), STATED),
    "zip.tif": (_tiff(FRAMES, bigtiff=True, compression="zlib"), STATED),
    "one_page.tif": (_behind_one_page, STATED),
    "grey.png": (_by_opencv, STATED),
    "grey.bmp": (lambda path: cv2.imwrite(str(path), GREY.values.astype(np.uint8)), STATED),
    "grey.pgm": (lambda path: path.write_bytes(b"P5\n45 31\n4095\n" + GREY.values.astype(">u2").tobytes()), STATED),
    "bayer.dng": (lambda path: write_dng(path, GREY), FILE),
    "lossless.dng": (lambda path: write_lossless_dng(path, GREY), FILE),
    "samples.raw": (lambda path: GREY.values.tofile(path), replace(STATED, shape=SHAPE, dtype="uint16")),
    "grey.cine": (_cine(bits=8), FILE),
    "colour.cine": (_cine(bits=16, cfa="GBRG", annotation=b"noted"), FILE),
    "packed.cine": (_cine(bits=10, cfa="RGGB"), FILE),
    "packed_12.cine": (_cine(bits=12, version=0), FILE),
    **{f"{bits}/movie.mraw": (_mraw(bits, ".cihx"), STATED) for bits in (8, 12, 16)},
    **{f"{bits}/movie.cihx": (_mraw(bits, ".cihx"), STATED) for bits in (8, 12, 16)},
    **{f"{bits}/movie.cih": (_mraw(bits, ".cih"), STATED) for bits in (8, 12, 16)},
    "movie.seq": (lambda path: write_seq(path, FRAMES, bits=12), STATED),
    "movie.npy": (lambda path: np.save(path, FRAMES), STATED),
    "plain.h5": (_hdf5(), STATED),
    "bare_chunks.h5": (_hdf5(chunks=(1, 5, 7)), STATED),
    "chunks.h5": (_hdf5(chunks=(2, 12, 16), compression="gzip"), STATED),
}


def mutated(content: bytes, random: np.random.Generator) -> bytes:
    """A copy changed in one of ten ways at a place that is as often among the first 10 bytes as the next 90."""
    kind, size = int(random.integers(10)), len(content)
    start = min(int(size ** random.random()) - 1, size - 1) if random.random() < 0.7 else int(random.integers(size))
    if random.random() < 0.1:  # some files end with their tables
        start = size - 1 - start
    end, copied = start + int(random.integers(1, 65)), bytearray(content)
    if kind == 0:  # bits
        for place in (start, *random.integers(0, size, random.integers(3))):
            copied[place] ^= 1 << int(random.integers(8))
    elif kind == 1:  # bytes around
        for place in random.integers(start, min(end, size), random.integers(1, 6)):
            copied[place] = (0, 1, 127, 255, int(random.integers(256)))[random.integers(5)]
    elif kind in (2, 3):  # a field: another number in a place of 1, 2, 4 or 8 bytes
        width = int(2 ** random.integers(4))
        near = int.from_bytes(content[start : start + width], "little") + int(random.choice([-1, 1]))
        number = (near, near, 0, 1, -1, 2 ** int(random.integers(8 * width)), -near)[random.integers(7)]
        copied[start : start + width] = (number % 256**width).to_bytes(width, random.choice(["little", "big"]))
    elif kind == 4:  # a run of any bytes
        copied[start:end] = random.bytes(len(copied[start:end]))
    elif kind == 5:  # zeros
        copied[start:end] = bytes(len(copied[start:end]))
    elif kind == 6:  # cut short
        del copied[start:]
    elif kind == 7:  # longer
        copied += (random.bytes(end - start), bytes(end - start), content)[random.integers(3)]
    elif kind == 8:  # a piece lost
        del copied[start:end]
    else:  # a piece doubled
        copied[end:end] = content[start:end]
    return _with_sums(bytes(copied)) if random.random() < 0.5 else bytes(copied)


def _with_sums(content: bytes) -> bytes:
    """A PNG with the checksums of its chunks made right again, so that a mutation is seen behind them."""
    copied, place = bytearray(content), 8 if content.startswith(b"\x89PNG") else len(content)
    while (end := place + 8 + int.from_bytes(copied[place : place + 4])) < len(content):
        copied[end : end + 4] = zlib.crc32(copied[place + 4 : end]).to_bytes(4)
        place = end + 4
    return bytes(copied)


def read_all(path: Path, stated: FrameSettings) -> tuple[int, list[str]]:
    """Number of frames that can be read, and what is said of the others.

    Raises
    ------
    AssertionError
        A frame has another shape than was announced, or its part is another than that of the whole.
    """
    read, told = 0, []
    try:
        series = open_series(replace(stated, path=(str(path),)))
        (rows, columns), _ = series.shape, (series.recording.n_lost, series.fingerprint())
    except RgbmidicError as error:
        return 0, [str(error)]
    window = Window.around_points(np.array([[columns // 2, rows // 2]]), min(rows, columns) // 8, (rows, columns))
    for index in range(min(len(series), MOST_FRAMES)):
        whole, part = _read(series, index), _read(series, index, window)
        if isinstance(whole, str):
            told.append(whole)
            continue
        assert not isinstance(part, str), f"of a frame that can be read no part can: {part}"
        assert whole.values.shape[-2:] == (rows, columns), f"{whole.values.shape} for {rows} x {columns}"
        inside = window.slices_in(Window.of_frame((rows, columns)))
        np.testing.assert_array_equal(part.values, whole.values[(..., *inside)])
        assert series.name(index)
        assert series.inputs(index, window)
        series.time_ns(index)
        read += 1
    return read, told


def _read(series: FrameSeries, index: int, window: Window | None = None) -> Mosaic | ChannelFrame | str:
    """The frame, or the message of our error."""
    try:
        return series.read(index, window)[0]
    except RgbmidicError as error:
        return str(error)


def _work(path: Path, stated: FrameSettings, numbers: Iterable[int], seed: int, out: Connection) -> None:
    """Mutate a file, in a process of its own, and tell before each number and after it what became of it."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    content, lines = path.read_bytes(), Counter[str]()
    logging.getLogger("rgbmidic").handlers = [handler := logging.Handler()]
    handler.emit = lambda record: lines.update(["log"])  # type: ignore[method-assign]
    with tempfile.TemporaryFile() as errors:
        os.dup2(errors.fileno(), 2)
        for number in numbers:
            path.write_bytes(mutated(content, np.random.default_rng((seed, number))))
            os.utime(path, ns=(number, number))  # copies written within one tick of the clock are different files
            out.send(number)
            lines.clear()
            began, failure, written = time.process_time(), "", errors.seek(0, 2)
            try:
                with warnings.catch_warnings(record=True) as warned:
                    warnings.simplefilter("always")
                    read, told = read_all(path, stated)
                if unnamed := [text for text in told if path.stem not in text or "\n" in text]:
                    failure = f"a message without the file's name or of several lines: {unnamed[0]}"
                end = "whole" if not told else "in part" if read else "refused"
                failure = failure or (f"warns: {warned[0]}" if warned else "")
            except BaseException as error:  # whatever it is, it is a failure
                end, failure = (
                    "failed",
                    f"{type(error).__name__}: {error} at {traceback.extract_tb(error.__traceback__)[-1]}",
                )
            if (spent := time.process_time() - began) > SECONDS:
                failure = failure or f"takes {spent:.1f} s"
            if errors.seek(0, 2) > written or lines["log"] > LINES:
                failure = failure or f"writes {errors.seek(0, 2) - written} bytes, {lines['log']} lines of the log"
            out.send((number, "failed" if failure else end, failure))
        out.send(None)


def campaign(path: Path, stated: FrameSettings, count: int, seed: int) -> tuple[Counter[str], list[str]]:
    """Mutate a file `count` times; how often it ended how, and the failures, each with the number of its mutation."""
    ends, failures, number, content = Counter[str](), [], 0, path.read_bytes()
    apart = multiprocessing.get_context("spawn")  # LibRaw's threads do not bear a fork
    while number < count:
        path.write_bytes(content)
        receiver, sender = apart.Pipe(duplex=False)
        process = apart.Process(target=_work, args=(path, stated, range(number, count), seed, sender))
        process.start()
        sender.close()
        told: Any = number
        while told is not None:
            try:
                told = receiver.recv() if receiver.poll(HANGS) else "hangs"
            except EOFError:
                process.join()
                told = f"dies with {process.exitcode}"
            if isinstance(told, str):
                ends["failed"] += 1
                failures.append(f"{number}: {told}")
                break
            if isinstance(told, tuple):
                ends[told[1]] += 1
                failures += [f"{told[0]}: {told[2]}"] if told[2] else []
            elif told is not None:
                number = told
        process.kill()
        process.join()
        number += 1
    path.write_bytes(content)
    return ends, failures


if __name__ == "__main__":
    count, seed = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
    for name in sys.argv[3:] or WRITERS:
        with tempfile.TemporaryDirectory() as made:
            path, began = Path(made, name if name in WRITERS else Path(name).name), time.perf_counter()
            path.parent.mkdir(exist_ok=True)
            if name in WRITERS:
                write, stated = WRITERS[name]
                write(path)
            else:  # of a camera, with the other file of its movie
                stated = STATED if path.suffix in (".tif", ".tiff", ".png", ".mraw", ".cih", ".cihx") else FILE
                for other in Path(name).parent.glob(f"{glob.escape(path.stem)}.*"):
                    copy(other, path.parent)
            ends, failures = campaign(path, stated, count, seed + zlib.crc32(name.encode()))
        print(f"{name}: {dict(ends)}, {time.perf_counter() - began:.0f} s", flush=True)  # noqa: T201
        for failure in failures:
            print(f"    {failure}", flush=True)  # noqa: T201
