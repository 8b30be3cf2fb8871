"""Photron movies: all samples, levels, times, and what is refused with its reason."""

from __future__ import annotations

import logging
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mraw_files import pack_bits, write_mraw
from real_files import RealData, count

from rgbmidic.errors import FrameError
from rgbmidic.frames import FrameSeries, Mosaic, open_series, open_source
from rgbmidic.frames.metadata import unpack_bits
from rgbmidic.frames.source import FrameSource
from rgbmidic.settings import FrameSettings
from rgbmidic.tools.formats import movies as mraw

SHAPE = (12, 16)


def _frames(bits: int, count: int = 5) -> np.ndarray[Any, Any]:
    return np.random.default_rng(bits).integers(0, 2**bits, (count, *SHAPE)).astype(np.uint16)


def _source(path: Path, **stated: Any) -> FrameSource:
    return open_source(path, FrameSettings(path=("frame",), **(stated or {"kind": "monochrome"})))


def _series(path: Path) -> FrameSeries:
    return open_series(FrameSettings(path=(str(path),), kind="monochrome"))


@pytest.mark.parametrize("ending", [".cihx", ".cih"])
@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_all_samples_come_back_in_any_order(tmp_path: Path, bits: int, ending: str) -> None:
    frames = _frames(bits)
    source = _source(write_mraw(tmp_path, frames, bits=bits, ending=ending, **{"EffectiveBit Depth": bits}))
    assert (len(source), source.shape, source.recording.bit_depth) == (5, SHAPE, bits)
    for index in (4, 0, 2, 1, 3):
        frame = source.read(index)
        np.testing.assert_array_equal(frame.values[0], frames[index])
        assert frame.white_level == 2**bits - 1
    with pytest.raises(IndexError):
        source.read(5)


@given(bits=st.sampled_from([10, 12]), groups=st.integers(1, 9), seed=st.integers(0, 2**32 - 1))
def test_unpacking_undoes_packing(bits: int, groups: int, seed: int) -> None:
    values = np.random.default_rng(seed).integers(0, 2**bits, 4 * groups).astype(np.uint16)
    np.testing.assert_array_equal(unpack_bits(pack_bits(values, bits), bits), values)


def test_bits_in_packed_samples_come_highest_first() -> None:
    assert unpack_bits(bytes([0xAB, 0xCD, 0xEF]), 12).tolist() == [0xABC, 0xDEF]
    assert unpack_bits(bytes([0xFF, 0xC0, 0x00, 0x00, 0x01]), 10).tolist() == [1023, 0, 0, 1]


def test_samples_at_the_upper_side_of_16_bits_come_down(tmp_path: Path) -> None:
    frames = _frames(12)
    path = write_mraw(tmp_path, frames << 4, bits=16, **{"EffectiveBit Side": "Higher"})
    frame = _source(path).read(1)
    np.testing.assert_array_equal(frame.values[0], frames[1])
    assert frame.white_level == 4095


def test_fewer_bits_than_the_camera_has(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    frames = _frames(8)
    upper = _source(write_mraw(tmp_path, frames, bits=8, **{"EffectiveBit Side": "Higher"}))
    np.testing.assert_array_equal(upper.read(0).values[0], frames[0])
    assert (upper.read(0).white_level, upper.recording.bit_depth, caplog.records) == (255, 12, [])
    with caplog.at_level(logging.WARNING):
        lower = _source(write_mraw(tmp_path, frames, bits=8, **{"EffectiveBit Side": "Lower "}))
        assert lower.read(0).white_level == 255
    assert "lower 8 of 12 bits: brighter samples are lost" in caplog.text


def test_a_lower_white_level_may_be_stated_and_a_higher_one_not(tmp_path: Path) -> None:
    path = write_mraw(tmp_path, _frames(12), bits=12)
    assert _source(path, kind="monochrome", white_level=4000).read(0).white_level == 4000
    with pytest.raises(FrameError, match=r"white_level is stated as 5000.*movie\.mraw end at 4095"):
        _source(path, kind="monochrome", white_level=5000).read(0)


def test_the_pattern_is_stated(tmp_path: Path) -> None:
    path = write_mraw(tmp_path, _frames(12), bits=12)
    frame = _source(path, cfa="GRBG").read(0)
    assert isinstance(frame, Mosaic)
    assert frame.cfa == "GRBG"
    with pytest.raises(FrameError, match="state cfa"):
        open_source(path, FrameSettings(path=("frame",))).read(0)


@pytest.mark.parametrize(
    ("rate", "first", "step", "trigger", "times"),
    [
        ("30000", 52, 1, -52, [1733333, 1766667, 1800000]),
        ("30000", -2, 1, 2, [-66667, -33333, 0]),
        ("15000", 0, 100, 0, [0, 6666667, 13333333]),
        ("1000000", -1, 1, 1, [-1000, 0, 1000]),
        ("59.94", 0, 1, 0, [0, 16683350, 33366700]),
    ],
)
def test_times_are_whole_nanoseconds_from_the_trigger(
    tmp_path: Path, rate: str, first: int, step: int, trigger: int, times: list[int]
) -> None:
    entries = {"Record Rate(fps)": rate, "Start Frame": first, "Save Step": step}
    series = _series(write_mraw(tmp_path, _frames(12, 3), bits=12, **entries))
    recording = series.recording
    assert recording.times_ns is not None
    assert recording.times_ns.tolist() == [series.time_ns(index) for index in range(3)] == times
    assert (recording.trigger, recording.frame_rate, recording.exposure_ns) == (trigger, float(rate), 20000)
    assert (recording.n_lost, list(series.numbers)) == (0, [0, 1, 2])


def test_a_million_frames_a_second_stay_exact_after_hours(tmp_path: Path) -> None:
    first = 10**11  # 27 hours at 10^6 frames a second
    recording = _source(
        write_mraw(tmp_path, _frames(12, 2), bits=12, **{"Record Rate(fps)": 10**6, "Start Frame": first})
    ).recording
    assert recording.times_ns is not None
    assert recording.times_ns.tolist() == [10**14, 10**14 + 1000]


def test_shutter_as_a_fraction_of_a_second(tmp_path: Path) -> None:
    entries = {"Shutter Type2(nsec)": None, "Shutter Speed(s)": "1/15371"}
    path = write_mraw(tmp_path, _frames(12), bits=12, ending=".cih", **entries)
    assert _source(path).recording.exposure_ns == 65058


@pytest.mark.parametrize("name", ["movie.mraw", "movie.cihx", "movie.*", "movie.c*"])
def test_either_file_names_the_movie(tmp_path: Path, name: str) -> None:
    write_mraw(tmp_path, _frames(12), bits=12)
    series = open_series(FrameSettings(path=(name,), kind="monochrome"), tmp_path)
    assert (len(series), series.name(4)) == (5, "movie.mraw frame 4")
    assert list(series.inputs(0)) == [str(tmp_path / "movie.mraw")]


def test_a_missing_companion_is_named(tmp_path: Path) -> None:
    path = write_mraw(tmp_path, _frames(12), bits=12)
    path.rename(tmp_path / "other.mraw")
    with pytest.raises(FrameError, match=r"not found: .*movie\.mraw$"):
        _series(tmp_path / "movie.cihx")
    with pytest.raises(FrameError, match=r"other\.mraw needs its header other\.cihx or other\.cih beside it"):
        _series(tmp_path / "other.mraw")


@pytest.mark.parametrize("ending", [".cihx", ".cih"])
def test_a_bayer_movie_is_no_monochrome_one(tmp_path: Path, ending: str) -> None:
    frames = _frames(12)
    path = write_mraw(tmp_path, frames, bits=12, ending=ending, **{"Color Type": "Bayer"})
    np.testing.assert_array_equal(open_source(path, FrameSettings(path=("m",), cfa="GRBG")).read(1).values, frames[1])
    for stated, reason in (({}, "does not state its colour filter array"), ({"kind": "monochrome"}, "states bayer")):
        with pytest.raises(FrameError, match=reason):
            open_source(path, FrameSettings(path=("m",), **stated)).read(0)


def test_a_movie_that_goes_on_behind_its_frames_says_so(tmp_path: Path) -> None:
    path = write_mraw(tmp_path, _frames(8), bits=8)
    path.write_bytes(path.read_bytes() + bytes(7))
    told = "bytes more than the 5 frames that its header announces"
    assert _series(path).remarks == (f"movie.mraw: it has 7 {told}",)
    np.save(tmp_path / "m.npy", _frames(8))
    assert _series(tmp_path / "m.npy").remarks == ()
    (tmp_path / "m.npy").write_bytes((tmp_path / "m.npy").read_bytes() + bytes(3))
    assert _series(tmp_path / "m.npy").remarks == (
        "m.npy: it has 3 bytes more than the 5 frames that its header announces",
    )


def test_a_folder_with_movies_only_names_one(tmp_path: Path) -> None:
    write_mraw(tmp_path, _frames(12), bits=12)
    with pytest.raises(FrameError, match=r"folder without frames.*movie\.cihx is a movie .*name the movie itself"):
        _series(tmp_path)


def test_the_header_is_read_once_until_it_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parsed: list[int] = []
    lines = mraw._lines
    monkeypatch.setattr(mraw, "_lines", lambda content: parsed.append(len(content)) or lines(content))
    source = _source(write_mraw(tmp_path, _frames(8), bits=8, ending=".cih"))
    for index in range(5):
        source.read(index)
    assert len(parsed) == 1
    write_mraw(tmp_path, _frames(8, 11), bits=8, ending=".cih")
    assert (len(source), len(parsed)) == (11, 2)


def test_a_movie_of_many_gigabytes_is_read_frame_by_frame(tmp_path: Path) -> None:
    path = write_mraw(tmp_path, np.zeros((1, 1024, 1024), dtype=np.uint16), bits=12, **{"Total Frame": 20_000})
    with path.open("r+b") as file:
        file.seek(19_999 * 3 * 2**19)  # 31 GB, a hole in the disk
        file.write(pack_bits(np.full(2**20, 0xABC), 12))
    tracemalloc.start()
    assert (_source(path).read(19_999).values == 0xABC).all()
    assert tracemalloc.get_traced_memory()[1] < 30e6
    tracemalloc.stop()


def test_a_movie_that_ends_early_gives_its_whole_frames(tmp_path: Path) -> None:
    frames = _frames(12)
    path = write_mraw(tmp_path, frames, bits=12)
    size = path.stat().st_size // 5
    for held, where in ((3.5, "after frame 2 of 5"), (0.5, "before the first frame of 5")):
        path.write_bytes(b"".join(pack_bits(frame, 12) for frame in frames)[: int(held * size)])
        source = _source(path)
        assert len(source) == 5
        for index in range(5):
            if index + 1 <= held:
                np.testing.assert_array_equal(source.read(index).values[0], frames[index])
            else:
                with pytest.raises(FrameError, match=rf"movie\.mraw: the file ends {where}.*still being written"):
                    source.read(index)


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ({"Color Type": "Color", "Color Bit": 24}, "24 bit .*no longer the sensor's"),
        ({"Color Bit": 48}, "48 bit .*no longer the sensor's"),
        ({"Color Bit": 14}, "14 bit; allowed are 8, 10, 12 and 16"),
        ({"Image Width": 0}, "announces 12 rows of 0 samples"),
        ({"Image Width": 10**9, "Image Height": 10**9}, "announces .* MB"),
        ({"Total Frame": 4 * 10**9}, r"announces 4000000000 frames; allowed are 1 to 2000000"),
        ({"Total Frame": 0}, "announces 0 frames"),
        ({"Total Frame": None}, 'does not state "Total Frame"'),
        ({"Start Frame": "9" * 30}, '"Start Frame" is "9'),
        ({"EffectiveBit Side": "Middle"}, '12 effective bits, "middle"; allowed are lower and higher'),
        ({"Record Rate(fps)": "0.000001", "Start Frame": 2**39}, "announces frames up to number"),
    ],
    ids=lambda value: str(value)[:30],
)
@pytest.mark.parametrize("ending", [".cihx", ".cih"])
def test_what_no_camera_records_is_refused(tmp_path: Path, ending: str, entries: dict[str, Any], reason: str) -> None:
    write_mraw(tmp_path, _frames(8), bits=8, ending=ending, **entries)
    with pytest.raises(FrameError, match=rf"movie{ending} .*{reason}"):
        _series(tmp_path / "movie.mraw")


def test_a_rate_that_is_no_number_tells_no_times(tmp_path: Path) -> None:
    for rate in ("1e999999999", "fast", "0", "1/0", None):
        recording = _source(write_mraw(tmp_path, _frames(8), bits=8, **{"Record Rate(fps)": rate})).recording
        assert (recording.times_ns, recording.frame_rate) == (None, None)


def test_a_header_without_its_xml(tmp_path: Path) -> None:
    path = write_mraw(tmp_path, _frames(8), bits=8)
    for content in (b"no xml", b"<cih><frameInfo></cih>"):
        path.with_suffix(".cihx").write_bytes(content)
        with pytest.raises(FrameError, match=r"movie\.cihx is damaged"):
            _series(path)


def test_known_answers_of_real_movies(real_data: RealData) -> None:
    ball, beam = real_data("mraw_12bit_cihx"), real_data("mraw_8bit_cih")
    nova = open_series(FrameSettings(path=("ball_12bit.cihx",), kind="monochrome"), ball)
    (frame,) = nova.read(0)
    assert (len(nova), nova.shape, frame.values.min(), frame.values.max()) == (
        *(count(ball, 15), (384, 384), 105, 4095),
    )
    steps = [np.abs(np.diff(frame.values[0].astype(int), axis=axis)).mean() for axis in (0, 1)]
    assert max(steps) < 40  # nibbles the other way round: 145 and 359
    assert (frame.white_level, nova.recording.trigger, nova.time_ns(0)) == (4095, -52, 1733333)
    showcase = open_series(FrameSettings(path=("*.mraw",), kind="monochrome"), beam)
    stored = np.fromfile(beam / "data_showcase.mraw", dtype=np.uint8).reshape(-1, 40, 640)
    assert (len(showcase), showcase.shape, showcase.recording.bit_depth) == (count(beam, 75), (40, 640), 12)
    np.testing.assert_array_equal([frame.values[0] for (frame,) in map(showcase.read, range(len(showcase)))], stored)
