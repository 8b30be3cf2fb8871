"""What is written is read back, bit by bit."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import rawpy
from frames import channel_frames, mosaics, noisy_mosaic
from hypothesis import given, settings

from rgbmidic.errors import InputError
from rgbmidic.frames import read_frame
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.images import write_dng, write_tiff
from rgbmidic.illumination.calibration import write_document
from rgbmidic.settings import BAYER_PATTERNS


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("written")


@given(mosaic=mosaics())
@settings(max_examples=60)
def test_dng_written_and_read_is_the_same_frame(folder: Path, mosaic: Mosaic) -> None:
    write_dng(folder / "frame.dng", mosaic)
    back = read_frame(folder / "frame.dng")
    assert isinstance(back, Mosaic)
    assert back.cfa == mosaic.cfa
    assert back.white_level == mosaic.white_level
    np.testing.assert_array_equal(back.black_level, mosaic.black_level)
    np.testing.assert_array_equal(back.values, mosaic.values)


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
def test_libraw_alone_reads_the_dng_back(tmp_path: Path, cfa: str) -> None:
    mosaic = noisy_mosaic((41, 57), cfa=cfa, black=[[60, 61], [62, 63]])
    write_dng(tmp_path / "frame.dng", mosaic)
    with rawpy.imread(str(tmp_path / "frame.dng")) as raw:
        colours = raw.raw_colors_visible[:2, :2]
        np.testing.assert_array_equal(raw.raw_image_visible, mosaic.values)
        assert "".join(raw.color_desc.decode()[colour] for colour in colours.ravel()) == cfa
        np.testing.assert_array_equal(np.array(raw.black_level_per_channel)[colours], mosaic.black_level)
        assert raw.white_level == mosaic.white_level


def test_white_balance_reaches_viewers(tmp_path: Path) -> None:
    write_dng(tmp_path / "frame.dng", noisy_mosaic(), white_balance=(2.0, 1.0, 1.6))
    with rawpy.imread(str(tmp_path / "frame.dng")) as raw:
        assert raw.camera_whitebalance[:3] == pytest.approx([2.0, 1.0, 1.6], rel=1e-3)


@given(mosaic=mosaics())
@settings(max_examples=30)
def test_tiff_mosaic_written_and_read_is_the_same(folder: Path, mosaic: Mosaic) -> None:
    write_tiff(folder / "mosaic.tif", mosaic)
    back = read_frame(folder / "mosaic.tif", cfa=mosaic.cfa, white_level=mosaic.white_level)
    assert isinstance(back, Mosaic)
    np.testing.assert_array_equal(back.values, mosaic.values)


@given(frame=channel_frames())
@settings(max_examples=30)
def test_tiff_channels_written_and_read_are_the_same(folder: Path, frame: ChannelFrame) -> None:
    write_tiff(folder / "channels.tif", frame)
    back = read_frame(folder / "channels.tif", kind="monochrome" if len(frame.values) == 1 else "rgb")
    assert isinstance(back, ChannelFrame)
    np.testing.assert_array_equal(back.values, frame.values)


def test_what_a_dng_cannot_hold_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    small = Mosaic(values=np.ones((21, 40)), cfa="RGGB", black_level=0, white_level=9)
    broken = Mosaic(values=np.ones((40, 40)), cfa="RGGB", black_level=64.5, white_level=4095)
    for mosaic, word in ((small, "22"), (broken, "64.5")):
        with pytest.raises(InputError, match=word):
            write_dng(tmp_path / "frame.dng", mosaic)
    with pytest.raises(InputError, match="white_balance"):
        write_dng(tmp_path / "frame.dng", noisy_mosaic(), white_balance=(1.0, 0.0, 1.0))
    assert not list(tmp_path.iterdir())


def test_a_frame_is_replaced_only_as_a_whole(tmp_path: Path) -> None:
    for seed in (0, 1):
        write_dng(tmp_path / "frame.dng", noisy_mosaic(seed=seed))
    np.testing.assert_array_equal(read_frame(tmp_path / "frame.dng").values, noisy_mosaic(seed=1).values)
    assert [file.name for file in tmp_path.iterdir()] == ["frame.dng"]


def test_threads_that_write_the_same_file_leave_a_whole_one_and_nothing_else(tmp_path: Path) -> None:
    frames = [noisy_mosaic((64, 64), seed=seed) for seed in range(4)]

    def write(frame: Mosaic) -> None:
        for _ in range(5):
            write_tiff(tmp_path / "frame.tif", frame)
            write_document(tmp_path / "document.json", {"sum": int(frame.values.sum())})

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, frames))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["document.json", "frame.tif"]
    found = read_frame(tmp_path / "frame.tif", kind="bayer", cfa="RGGB", black_level=0).values
    assert any(np.array_equal(found, frame.values) for frame in frames)
    assert json.loads((tmp_path / "document.json").read_text())["sum"] in [int(frame.values.sum()) for frame in frames]
