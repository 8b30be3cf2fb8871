"""Phantom movies: written ones come back bit for bit, real ones with their known values and as ffmpeg decodes them."""

from __future__ import annotations

import subprocess
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cine_files import SETUP_LENGTH, even_times, write_cine
from real_files import RealData, count

from rgbmidic.errors import FrameError
from rgbmidic.frames import ChannelFrame, FrameSource, Mosaic, open_series, open_source
from rgbmidic.settings import FrameSettings
from rgbmidic.tools.formats.cine import _LINEAR

ANY = FrameSettings(path=("movie",))
BEFORE_LEVELS, BEFORE_NS, BEFORE_COLOURS = 5732, 1568, 808


def _frames(bits: int, depth: int = 0, shape: tuple[int, int] = (12, 16), count: int = 3) -> Any:
    return np.random.default_rng(bits).integers(0, 2 ** (depth or bits), (count, *shape))


def _movie(path: Path, frames: Any, **options: Any) -> FrameSource:
    write_cine(path, frames, count=len(frames), **options)
    return open_source(path, ANY)


@pytest.mark.parametrize("cfa", [None, "GBRG", "RGGB"])
@pytest.mark.parametrize(("bits", "depth"), [(8, 8), (16, 9), (16, 10), (16, 12), (16, 14), (16, 16), (12, 12)])
def test_frames_come_back_bit_for_bit_in_any_order(tmp_path: Path, bits: int, depth: int, cfa: str | None) -> None:
    frames = _frames(bits, depth)
    levels = (4, 254) if depth == 8 else (2**depth // 64, 2**depth - 32)
    source = _movie(tmp_path / "f.cine", frames, bits=bits, depth=depth, cfa=cfa, levels=levels)
    assert (len(source), source.shape, source.recording.bit_depth) == (3, (12, 16), depth)
    for index in (2, 0, 1):
        frame = source.read(index)
        np.testing.assert_array_equal(frame.values.reshape(12, 16), frames[index])
        assert (set(frame.black_level.ravel()), frame.white_level) == ({levels[0]}, levels[1])
        assert getattr(frame, "cfa", None) == cfa
        assert isinstance(frame, Mosaic if cfa else ChannelFrame)


@pytest.mark.parametrize("shape", [(12, 16), (5, 7), (3, 1)])
@pytest.mark.parametrize("bits", [10, 12])
def test_packed_frames_of_any_size(tmp_path: Path, bits: int, shape: tuple[int, int]) -> None:
    codes = _frames(bits, shape=shape, count=2)
    source = _movie(tmp_path / "f.cine", codes, bits=bits)
    expected = _LINEAR[codes] if bits == 10 else codes
    np.testing.assert_array_equal([source.read(index).values[0] for index in range(2)], expected)


@pytest.mark.parametrize("levels", [(64, 1014), (64, 4064)])
def test_codes_of_packed_10_bit_are_linearised_and_so_are_levels_of_10_bit(
    tmp_path: Path, levels: tuple[int, int]
) -> None:
    codes = np.arange(1024).reshape(1, 32, 32)
    source = _movie(tmp_path / "f.cine", codes, bits=10, cfa="GBRG", levels=levels)
    frame = source.read(0)
    values = frame.values.ravel()
    assert (values[64], values[1014], values[0], values[1023]) == (64, 4064, 2, 4095)
    assert (np.diff(values.astype(int)) >= 0).all()
    assert (set(frame.black_level.ravel()), frame.white_level, source.recording.bit_depth) == ({64}, 4064, 12)


def test_ten_bits_in_a_container_are_not_packed_and_linear(tmp_path: Path) -> None:
    frames = _frames(16, depth=10)
    source = _movie(tmp_path / "f.cine", frames, bits=16, depth=10, levels=(64, 1014))
    np.testing.assert_array_equal(source.read(0).values[0], frames[0])
    assert source.read(0).white_level == 1014


@pytest.mark.parametrize("rows", [12, 13])
@pytest.mark.parametrize("top_down", [False, True])
def test_the_pattern_holds_for_the_first_row_however_rows_are_stored(tmp_path: Path, rows: int, top_down: bool) -> None:
    greens_first = np.fromfunction(lambda row, column: 100 + (row % 2) * 50 + column % 2, (rows, 16))
    source = _movie(tmp_path / "f.cine", greens_first[None], cfa="GBRG", top_down=top_down)
    frame = source.read(0)
    assert isinstance(frame, Mosaic)
    np.testing.assert_array_equal(frame.values, greens_first)
    assert frame.cfa == "GBRG"


@pytest.mark.parametrize("version", [0, 1])
def test_when_frames_were_taken_and_which_are_lost(tmp_path: Path, version: int) -> None:
    times = even_times(20, 1e6, first=-7, lost=(3, 4, 11))
    frames = _frames(8, count=20)
    path = tmp_path / "f.cine"
    source = _movie(path, frames, bits=8, first=-7, rate=1e6, exposure_ns=300, times_ns=times, version=version)
    recording = source.recording
    assert recording.times_ns is not None
    assert recording.times_ns.dtype == np.int64
    np.testing.assert_allclose(recording.times_ns, times, atol=1)
    assert (recording.trigger, recording.frame_rate, recording.exposure_ns, recording.n_lost) == (7, 1e6, 300, 3)
    series = open_series(FrameSettings(path=("f.cine",)), tmp_path)
    assert list(series.numbers[2:5]) == [2, 5, 6]
    assert series.n_lost == 3


@pytest.mark.parametrize("length", [BEFORE_COLOURS, 900, BEFORE_NS, BEFORE_LEVELS, 10392, SETUP_LENGTH, 11000])
def test_only_what_the_settings_of_an_old_camera_store_is_read(tmp_path: Path, length: int) -> None:
    frames = _frames(16, depth=12)
    path = tmp_path / "f.cine"
    source = _movie(path, frames, setup_length=length, exposure_ns=7000, rate=2000.5, levels=(70, 4000))
    frame = source.read(1)
    np.testing.assert_array_equal(frame.values[0], frames[1])
    told = length > BEFORE_LEVELS
    assert (frame.black_level[0], frame.white_level) == ((70, 4000) if told else (0, 4095))
    assert source.recording.frame_rate == (2000.5 if length >= SETUP_LENGTH else 2000)
    assert source.recording.exposure_ns == 7000
    stated = open_source(path, FrameSettings(path=("f",), black_level=64))
    if told:
        with pytest.raises(FrameError, match="black_level is stated as 64, but"):
            stated.read(0)
    else:
        assert stated.read(0).black_level[0] == 64


def test_a_colour_movie_without_a_pattern_needs_it_stated(tmp_path: Path) -> None:
    path = tmp_path / "f.cine"
    source = _movie(path, _frames(8), bits=8, compression=2, levels=(0, 254))
    with pytest.raises(FrameError, match=r"f\.cine does not state its colour filter array: state cfa"):
        source.read(0)
    frame = open_source(path, FrameSettings(path=("f",), cfa="BGGR")).read(0)
    assert isinstance(frame, Mosaic)
    assert frame.cfa == "BGGR"


@pytest.mark.parametrize("levels", [(64, 254), (0, 0), (300, 100), (64, 70000)])
def test_levels_that_do_not_fit_the_samples_are_not_used(tmp_path: Path, levels: tuple[int, int]) -> None:
    source = _movie(tmp_path / "f.cine", _frames(16, depth=12), levels=levels)
    frame = source.read(0)
    assert (frame.black_level[0], frame.white_level) == (0, 4095)
    assert bool(source.recording.remarks) == any(levels)


def test_flips_of_the_viewer_are_left_to_it_and_told(tmp_path: Path) -> None:
    frames = _frames(16, depth=12)
    source = _movie(tmp_path / "f.cine", frames, cfa="GBRG", changed={"bFlipV": 1})
    np.testing.assert_array_equal(source.read(0).values, frames[0])
    assert "flip vertically" in source.recording.remarks[0]


@pytest.mark.parametrize(
    ("place", "value", "reason"),
    [
        (4, 1, r"compressed \(JPEG\): its samples are no longer the sensor's"),
        (4, 9, "kind of compression 9"),
        (6, 7, "version 7"),
        (20, 0, "announces 0 frames"),
        (20, 2**31, "announces 2147483648 frames"),
        (20, 2**20, "goes on to byte .* behind the end of the file"),
        (32, 2**31, "goes on to byte .* behind the end of the file"),
        (28, 2**30, "goes on to byte"),
        (28, 3, "not where they should be"),
        (48, 0, "12 rows of 0 pixels"),
        (48, 2**30, "MB of samples; allowed are"),
        (58, 24, r"processed \(interpolated\) colour: its samples are no longer the sensor's"),
        (58, 48, "processed"),
        (60, 5, "packed in the way 5, which is unknown"),
        (84 + 808, 1, "colour filter array 1 of old cameras, which is no Bayer"),
        (84 + 808, 0x80000002, "grey and colour heads"),
        (0, 0, "is no Phantom movie"),
    ],
)
def test_what_cannot_be_read_is_said_in_one_line(tmp_path: Path, place: int, value: int, reason: str) -> None:
    path = tmp_path / "f.cine"
    _movie(path, _frames(16, depth=12), cfa="GBRG")
    content = bytearray(path.read_bytes())
    width = 4 if place in (20, 28, 32, 48, 60, 892) else 2
    content[place : place + width] = value.to_bytes(width, "little")
    path.write_bytes(content)
    tracemalloc.start()
    with pytest.raises(FrameError, match=reason) as raised:
        open_source(path, ANY).read(0)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 2**20
    assert "\n" not in str(raised.value)
    assert "f.cine" in str(raised.value)


@pytest.mark.parametrize("annotation", [b"", b"time and place"])
def test_a_truncated_movie_is_read_up_to_its_last_whole_frame(tmp_path: Path, annotation: bytes) -> None:
    path = tmp_path / "f.cine"
    frames = _frames(16, depth=12, count=9)
    _movie(path, frames, annotation=annotation)
    content, size = path.read_bytes(), 12 * 16 * 2
    path.write_bytes(content[: -3 * (size + 8 + len(annotation)) - 100])
    source = open_source(path, ANY)
    assert len(source) == 9
    for index in range(5):
        np.testing.assert_array_equal(source.read(index).values[0], frames[index])
    for index in range(5, 9):
        with pytest.raises(
            FrameError, match=r"f\.cine: the file ends after frame 4 of 9 \(0 to 8\): truncated or still being"
        ):
            source.read(index)
    path.write_bytes(content)  # the rest is written: nothing of the shorter file is remembered
    np.testing.assert_array_equal(source.read(8).values[0], frames[8])


def test_pointers_that_are_not_yet_written(tmp_path: Path) -> None:
    path = tmp_path / "f.cine"
    _movie(path, _frames(16, depth=12), setup_length=5740)
    content = bytearray(path.read_bytes())
    table = int.from_bytes(content[32:36], "little")
    content[table : table + 24] = bytes(24)
    path.write_bytes(content)
    with pytest.raises(FrameError, match="ends before the first frame of 3"):
        open_source(path, ANY).read(0)


def test_one_frame_of_a_large_movie_is_read_at_a_time(tmp_path: Path) -> None:
    path, shape = tmp_path / "f.cine", (64, 64)
    frames = 2000
    write_cine(path, (np.full(shape, index) for index in range(frames)), count=frames)
    source = open_source(path, ANY)
    source.read(0)
    tracemalloc.start()
    assert [int(source.read(index).values[0, 0, 0]) for index in range(0, frames, 37)] == list(range(0, frames, 37))
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 20 * 64 * 64 * 2


def _by_ffmpeg(path: Path, pixels: str) -> Any:
    ffmpeg: Any = pytest.importorskip("imageio_ffmpeg")
    command = [ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", pixels, "-"]
    decoded = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(decoded, dtype=np.uint8 if pixels.endswith("8") or pixels == "gray" else np.uint16)


def test_a_real_colour_movie(real_data: RealData) -> None:
    path = real_data("cine_color_packed10") / "chart1.cine"
    source = open_source(path, ANY)
    frame = source.read(0)
    assert isinstance(frame, Mosaic)
    assert (len(source), source.shape, frame.cfa) == (1, (1080, 2048), "GBRG")
    assert (int(frame.values.min()), int(frame.values.max())) == (98, 4095)
    assert (set(frame.black_level.ravel()), frame.white_level) == ({64}, 4064)
    assert (source.recording.frame_rate, source.recording.trigger) == (25, 123)
    assert source.recording.exposure_ns == pytest.approx(20e6, rel=1e-3)


@pytest.mark.parametrize(("folder", "name"), [("cine_color_packed10", "chart1"), ("cine_mono_set", "packed_12bpp")])
def test_packed_codes_are_those_of_ffmpeg(real_data: RealData, folder: str, name: str) -> None:
    """It shows a code in the upper bits, its highest bits repeated below, and knows nothing of the linearisation."""
    path = real_data(folder) / f"{name}.cine"
    source = open_source(path, ANY)
    shown = np.arange(1024) << 6 | np.arange(1024) >> 4
    decoded = _by_ffmpeg(path, "bayer_gbrg16le" if "color" in folder else "gray16le")
    assert np.isin(decoded, shown).all()
    values = np.array([source.read(index).values for index in range(len(source))])
    np.testing.assert_array_equal(_LINEAR[np.searchsorted(shown, decoded)], values.ravel())


@pytest.mark.parametrize(
    ("name", "pixels", "numbers"),
    [
        ("phantom_v1610_16bpp", "gray12le", (12, 64, 4064, 100, 3e6, 85, -844_701_095)),
        ("phantom_v7_raw_16bpp", "gray12le", (12, 0, 4064, 80, 12e6, -238_292, 4_067_947_000)),
        ("phantom_v9_raw_16bpp", "gray", (8, 0, 254, 300, 1e6, -237_439, 4_247_823_000)),
        ("packed_12bpp", "", (12, 64, 4064, 100, 99e3, -60, 606_142_040)),
    ],
)
def test_real_grey_movies(real_data: RealData, name: str, pixels: str, numbers: tuple[float, ...]) -> None:
    path = real_data("cine_mono_set") / f"{name}.cine"
    source = open_source(path, ANY)
    frames = [source.read(index) for index in range(len(source))]
    recording = source.recording
    assert (len(source), source.shape, recording.n_lost) == (count(path.parent, 6), (128, 256), 0)
    depth, black, white, rate, exposure_ns, trigger, first_ns = numbers
    assert (recording.bit_depth, frames[0].black_level[0], frames[0].white_level) == (depth, black, white)
    assert (recording.frame_rate, recording.trigger) == (rate, trigger)
    assert recording.exposure_ns == pytest.approx(exposure_ns, rel=1e-3)
    assert recording.times_ns is not None
    assert recording.times_ns[0] == first_ns
    np.testing.assert_allclose(np.diff(recording.times_ns), 1e9 / rate, rtol=2e-4)
    if pixels:
        values = np.array([frame.values for frame in frames])
        np.testing.assert_array_equal(_by_ffmpeg(path, pixels), values.ravel())


@pytest.mark.parametrize("name", ["packed_12bpp", "phantom_v1610_16bpp", "phantom_v9_raw_16bpp"])
def test_the_gold_files_of_dice_are_proportional_to_the_linear_values(real_data: RealData, name: str) -> None:
    folder = real_data("cine_mono_set")
    source = open_source(folder / f"{name}.cine", ANY)
    content = (folder / f"{name}_d_0.rawi").read_bytes()
    columns, rows, _ = np.frombuffer(content, "<i4", 3)
    gold = np.frombuffer(content, "<f8", offset=12).reshape(rows, columns)
    values = source.read(0).values[0, :rows]
    scale = 1 if source.recording.bit_depth == 8 else 255 / 4095
    np.testing.assert_allclose(gold, values * scale, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize(
    ("bits", "cfa", "pixels"),
    [
        (8, None, "gray"),
        (16, None, "gray16le"),
        (8, "GBRG", "bayer_gbrg8"),
        (16, "RGGB", "bayer_rggb16le"),
        (10, "GBRG", "bayer_gbrg16le"),
    ],
)
def test_written_movies_are_read_by_ffmpeg_and_us_alike(
    tmp_path: Path, bits: int, cfa: str | None, pixels: str
) -> None:
    path = tmp_path / "f.cine"
    frames = _frames(bits, shape=(16, 32))
    source = _movie(path, frames, bits=bits, depth=bits, cfa=cfa, levels=(1, 254) if bits == 8 else (64, 1014))
    decoded = _by_ffmpeg(path, pixels).reshape(frames.shape)
    np.testing.assert_array_equal(decoded, frames << 6 | frames >> 4 if bits == 10 else frames)
    values = np.array([source.read(index).values.reshape(16, 32) for index in range(3)])
    np.testing.assert_array_equal(values, _LINEAR[frames] if bits == 10 else frames)
