"""NorPix sequences as their published description says: samples, pattern, stamps, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from seq_files import change_header, write_seq

from rgbmidic.errors import FrameError
from rgbmidic.frames import Mosaic, open_series, open_source
from rgbmidic.frames.source import FrameSource
from rgbmidic.settings import FrameSettings

FRAMES = np.random.default_rng(4).integers(0, 1024, (5, 12, 17)).astype(np.uint16)


def _source(path: Path, **stated: Any) -> FrameSource:
    return open_source(path, FrameSettings(path=("frame",), **stated))


@pytest.mark.parametrize("version", [3, 5])
@pytest.mark.parametrize(("dtype", "bits"), [("u1", 8), ("<u2", 10), ("<u2", 16)])
def test_all_samples_and_times_come_back(tmp_path: Path, version: int, dtype: str, bits: int) -> None:
    frames = (FRAMES % 2 ** min(bits, 10)).astype(dtype)
    path = write_seq(tmp_path / "m.seq", frames, bits=bits, version=version)
    source = _source(path, kind="monochrome")
    assert (len(source), source.shape) == (5, (12, 17))
    for index in (3, 0, 4, 1, 2):
        frame = source.read(index)
        np.testing.assert_array_equal(frame.values[0], frames[index])
        assert frame.white_level == 2**bits - 1
    recording = source.recording
    assert recording.times_ns is not None
    assert recording.times_ns.tolist() == [0, 10**6, 2 * 10**6, 3 * 10**6, 4 * 10**6]
    assert (recording.frame_rate, recording.bit_depth, recording.trigger) == (1000, bits, None)


@pytest.mark.parametrize(
    ("form", "store"),
    [(112, lambda v: v << 6), (113, lambda v: v << 6), (114, lambda v: (v << 6).astype(">u2")), (101, lambda v: v)],
)
def test_levels_of_samples_at_the_upper_side(tmp_path: Path, form: int, store: Any) -> None:
    path = write_seq(tmp_path / "m.seq", store(FRAMES), bits=10, image_format=form)
    frame = _source(path, cfa="RGGB").read(2)
    np.testing.assert_array_equal(frame.values, FRAMES[2])
    assert frame.white_level == 1023


@pytest.mark.parametrize(("code", "cfa"), [(1, "GRBG"), (2, "BGGR"), (3, "RGGB")])
def test_the_header_tells_the_pattern_of_raw_frames(tmp_path: Path, code: int, cfa: str) -> None:
    path = write_seq(tmp_path / "m.seq", FRAMES, bits=10, image_format=101, bayer_pattern=code)
    frame = _source(path).read(0)
    assert isinstance(frame, Mosaic)
    assert frame.cfa == cfa
    with pytest.raises(FrameError, match=f"cfa is stated as GBRG.*states {cfa}"):
        _source(path, cfa="GBRG").read(0)


def test_no_pattern_in_the_header_is_to_be_stated(tmp_path: Path) -> None:
    path = write_seq(tmp_path / "m.seq", FRAMES, bits=10, image_format=101, bayer_pattern=0)
    with pytest.raises(FrameError, match="state cfa"):
        _source(path).read(0)
    grey = write_seq(tmp_path / "g.seq", FRAMES, bits=10, image_format=100, bayer_pattern=2)
    assert _source(grey, kind="monochrome").read(0).values.shape == (1, 12, 17)


def test_a_gap_in_the_stamps_is_a_lost_frame(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_seq(tmp_path / "m.seq", FRAMES, bits=10, times_us=[0, 501, 999, 2000, 2500])
    series = open_series(FrameSettings(path=("m.seq",), kind="monochrome"), tmp_path)
    assert (list(series.numbers), series.n_lost, series.recording.n_lost) == ([0, 1, 2, 4, 5], 1, 1)
    assert "1 in the numbering, 3;" in caplog.text
    assert series.time_ns(3) == 2_000_000


def test_stamps_that_do_not_grow_tell_no_times(tmp_path: Path) -> None:
    path = write_seq(tmp_path / "m.seq", FRAMES, bits=10, times_us=[7, 7, 7, 7, 7])
    assert _source(path).recording.times_ns is None


def test_a_loop_begins_with_its_oldest_frame(tmp_path: Path) -> None:
    path = write_seq(tmp_path / "m.seq", FRAMES, bits=10, oldest_frame=3, times_us=[20, 30, 40, 0, 10])
    source = _source(path, kind="monochrome")
    for index, place in enumerate([3, 4, 0, 1, 2]):
        np.testing.assert_array_equal(source.read(index).values[0], FRAMES[place])
    assert source.recording.times_ns is not None
    assert source.recording.times_ns.tolist() == [0, 10_000, 20_000, 30_000, 40_000]


def test_a_sequence_that_ends_early_gives_its_whole_frames(tmp_path: Path) -> None:
    path = write_seq(tmp_path / "m.seq", FRAMES, bits=10)
    path.write_bytes(path.read_bytes()[: 8192 + 3 * 8192 + 20])
    source = _source(path, kind="monochrome")
    assert (len(source), source.recording.times_ns) == (5, None)
    np.testing.assert_array_equal(source.read(2).values[0], FRAMES[2])
    for index in (3, 4):
        with pytest.raises(
            FrameError, match=r"m\.seq: the file ends after frame 2 of 5 \(0 to 4\): truncated or still"
        ):
            source.read(index)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"compression": 1}, r"is compressed \(method 1\) and is not read: export it uncompressed"),
        ({"image_format": 200}, r"holds colours \(format 200\): its samples are no longer the sensor's"),
        ({"image_format": 132}, r"holds packed samples \(format 132\)"),
        ({"bit_depth": 12}, "10 of 12 bits"),
        ({"columns": 0}, "12 rows of 0"),
        ({"columns": 18}, "408 bytes for 12 rows of 18"),
        ({"true_image_size": 100}, "408 bytes, 100 apart"),
        ({"allocated_frames": 2**32 - 1}, "announces 4294967295 frames"),
        ({"oldest_frame": 9}, "damaged"),
    ],
    ids=str,
)
def test_what_is_not_read_is_told_with_its_reason(tmp_path: Path, fields: dict[str, int], reason: str) -> None:
    size = {"true_image_size": 8192, **fields}
    path = write_seq(tmp_path / "m.seq", FRAMES, bits=10)
    change_header(path, size)
    with pytest.raises(FrameError, match=rf"m\.seq .*{reason}"):
        len(_source(path))


def test_another_file_with_the_ending(tmp_path: Path) -> None:
    (tmp_path / "m.seq").write_bytes(bytes(2000))
    with pytest.raises(FrameError, match="does not begin as a NorPix sequence"):
        len(_source(tmp_path / "m.seq"))
