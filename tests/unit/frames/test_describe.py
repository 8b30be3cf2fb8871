"""What a reader sees of files, folders and patterns, and the frames that are saved from them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from cine_files import even_times, write_cine
from frames import noisy_mosaic
from real_files import RealData, count
from seq_files import write_seq

from rgbmidic.errors import FrameError, InputError
from rgbmidic.frames import write_dng, write_tiff
from rgbmidic.frames.data import Recording
from rgbmidic.results import UNKNOWN_TIME
from rgbmidic.settings import FrameSettings
from rgbmidic.tools.lab.inspection.frame_files import describe, description_text, save_frame

KEYS = [
    *("reader", "count", "shape", "cfa", "bit_depth", "black_level", "white_level"),
    *("frame_rate", "exposure", "trigger", "lost_frames"),
]


def _seen(path: Path, **stated: Any) -> dict[str, Any]:
    told: dict[str, Any] = json.loads(json.dumps(describe(FrameSettings(path=(str(path),), **stated))))
    assert set(KEYS) < set(told)
    return told


def _movie(path: Path, **options: Any) -> Any:
    frames = np.random.default_rng(1).integers(0, 4096, (6, 12, 16))
    times = even_times(6, 2000, first=-2, lost=(1, 4))
    write_cine(path, frames, count=6, first=-2, rate=2000, times_ns=times, exposure_ns=250_000, **options)
    return frames


def test_a_movie_tells_all(tmp_path: Path) -> None:
    _movie(tmp_path / "f.cine", cfa="GBRG")
    description = _seen(tmp_path / "f.cine")
    values = ["Phantom .cine", 6, [12, 16], "GBRG", 12, 64, 4064, 2000, 0.00025, 2, 2]
    assert [description[key] for key in KEYS] == values
    assert description["kind"] == "bayer"
    assert (description["first_time_ns"], description["last_time_ns"]) == pytest.approx((-1_000_000, 2_500_000), abs=1)
    assert description["warnings"] == []


def test_what_nobody_tells_is_null_and_what_is_stated_is_told(tmp_path: Path) -> None:
    write_tiff(tmp_path / "f.tif", noisy_mosaic((24, 30)))
    description = _seen(tmp_path / "f.tif")
    assert [description[key] for key in KEYS] == ["TIFF", 1, [24, 30], None, 16, 0.0, 65535.0, None, None, None, None]
    stated = _seen(tmp_path / "f.tif", cfa="BGGR", black_level=64.0, white_level=4000.0)
    assert (stated["cfa"], stated["kind"], stated["black_level"], stated["white_level"]) == ("BGGR", "bayer", 64, 4000)
    assert _seen(tmp_path / "f.tif", kind="monochrome")["kind"] == "monochrome"


def test_a_folder_and_a_pattern_are_counted_with_what_is_lost(tmp_path: Path) -> None:
    for number in (1, 2, 5):
        write_dng(tmp_path / f"f{number}.dng", noisy_mosaic((24, 30), black=np.array([[60, 61], [62, 63]])))
    for path in (tmp_path, tmp_path / "*.dng"):
        description = _seen(path)
        assert (description["count"], description["shape"], description["lost_frames"]) == (3, [24, 30], 2)
        assert (description["cfa"], description["black_level"], description["white_level"]) == (
            "RGGB",
            [60, 61, 62, 63],
            4095,
        )


def test_text_has_a_line_for_what_is_known(tmp_path: Path) -> None:
    _movie(tmp_path / "f.cine")
    lines = description_text(describe(FrameSettings(path=(str(tmp_path / "f.cine"),)))).splitlines()
    assert lines[:3] == ["reader         Phantom .cine", "count          6", "shape          12, 16"]
    assert not any(line.startswith("cfa") for line in lines)


def test_a_truncated_movie_is_described_and_its_end_told(tmp_path: Path) -> None:
    path = tmp_path / "f.cine"
    _movie(path)
    path.write_bytes(path.read_bytes()[:-400])
    description = _seen(path)
    assert description["count"] == 6
    assert "ends after frame 3 of 6 (0 to 5): truncated or still being written" in description["warnings"][0]


def test_what_is_stated_must_agree_with_the_file(tmp_path: Path) -> None:
    _movie(tmp_path / "f.cine", cfa="GBRG")
    with pytest.raises(FrameError, match="cfa is stated as RGGB, but"):
        _seen(tmp_path / "f.cine", cfa="RGGB")


@pytest.mark.parametrize("options", [{}, {"cfa": "GBRG"}, {"compression": 2}])
def test_a_saved_frame_has_the_raw_values(tmp_path: Path, options: dict[str, Any]) -> None:
    frames = _movie(tmp_path / "f.cine", **options)
    settings = FrameSettings(path=(str(tmp_path / "f.cine"),))
    save_frame(settings, 4, tmp_path / "frame.tif")
    saved = tifffile.imread(tmp_path / "frame.tif")
    assert saved.dtype == np.uint16
    np.testing.assert_array_equal(saved, frames[4])


def test_a_frame_is_saved_over_another_only_where_told(tmp_path: Path) -> None:
    frames = _movie(tmp_path / "f.cine")
    settings, out = FrameSettings(path=(str(tmp_path / "f.cine"),)), tmp_path / "frame.tif"
    save_frame(settings, 0, out)
    with pytest.raises(InputError, match=r"frame\.tif exists already; `overwrite=True` replaces it"):
        save_frame(settings, 1, out)
    save_frame(settings, 1, out, overwrite=True)
    np.testing.assert_array_equal(tifffile.imread(out), frames[1])


@pytest.mark.parametrize(
    ("index", "name", "reason"),
    [
        (6, "a.tif", r"no frame 6: .*f\.cine holds 6 \(0 to 5\)"),
        (-1, "a.tif", "no frame -1"),
        (0, "a.png", r"saved as \.tif, not as .*a\.png"),
        (0, "none/a.tif", "there is no folder .*none"),
    ],
)
def test_what_cannot_be_saved_is_said(tmp_path: Path, index: int, name: str, reason: str) -> None:
    _movie(tmp_path / "f.cine")
    with pytest.raises(InputError, match=reason):
        save_frame(FrameSettings(path=(str(tmp_path / "f.cine"),)), index, tmp_path / name)


def test_real_files(real_data: RealData) -> None:
    folder = real_data("cine_mono_set")
    grey = _seen(folder / "packed_12bpp.cine")
    levels = [None, 12, 64, 4064, 100]
    assert [grey[key] for key in KEYS[:8]] == ["Phantom .cine", count(folder, 6), [128, 256], *levels]
    assert (grey["trigger"], grey["lost_frames"]) == (-60, 0)
    assert grey["exposure"] == pytest.approx(99e-6, rel=1e-3)
    dng = _seen(real_data("raw_colorchart_dng"))
    assert (dng["count"], dng["kind"]) == (1, "bayer")


@pytest.mark.parametrize(
    ("times", "remark"),
    [
        ([0, 0, 0, 0], "its time stamps do not rise (at frame 1): they are not used"),
        ([0, 10, 20, 15], "its time stamps do not rise (at frame 3): they are not used"),
        ([0, 10, 10, 20], "its time stamps do not rise (at frame 2): they are not used"),
        ([UNKNOWN_TIME, 10, 20, 30], "its time stamps do not rise (at frame 1): they are not used"),
        ([0, 10, 20, UNKNOWN_TIME], "its time stamps do not rise (at frame 3): they are not used"),
        ([0, 30, 60, 90], "it states 100 frames per second, its time stamps 33.3333: these are taken"),
        ([0, 10, 20, 30], ""),
        ([-5, 6, 14, 25], ""),
    ],
)
def test_times_that_cannot_be_are_left_out_with_a_word(times: list[int], remark: str) -> None:
    stamps = np.array([one if one == UNKNOWN_TIME else one * 10**6 for one in times])
    recording = Recording(count=4, frame_rate=100.0, times_ns=stamps)
    assert recording.remarks == ((remark,) if remark else ())
    assert (recording.times_ns is None) == ("not used" in remark)
    assert recording.relative_numbers.tolist() == [0, 1, 2, 3]


def test_movies_whose_times_do_not_rise_say_so_once(tmp_path: Path) -> None:
    frames, stamps = np.random.default_rng(1).integers(0, 4096, (6, 12, 16)).astype(np.uint16), [0, 10, 20, 20, 30, 40]
    write_cine(tmp_path / "m.cine", frames, count=6, rate=100, times_ns=[one * 10**6 for one in stamps])
    write_seq(tmp_path / "m.seq", frames, bits=12, times_us=[one * 1000 for one in stamps])
    plane = {"Plane": {"DeltaT": [one * 1e-3 for one in stamps], "DeltaTUnit": ["s"] * 6}}
    tifffile.imwrite(tmp_path / "m.ome.tif", frames, metadata={"axes": "TYX", **plane}, photometric="minisblack")
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file.create_dataset("d", data=frames).attrs["times_ns"] = np.array(stamps) * 10**6
    for name in ("m.cine", "m.seq", "m.ome.tif", "m.h5"):
        description = _seen(tmp_path / name, kind="monochrome")
        assert description["warnings"] == [f"{name}: its time stamps do not rise (at frame 3): they are not used"]
        assert (description["first_time_ns"], description["last_time_ns"]) == (None, None)


def test_a_frame_rate_that_is_not_that_of_the_time_stamps_is_reported(tmp_path: Path) -> None:
    frames = np.random.default_rng(1).integers(0, 4096, (6, 12, 16)).astype(np.uint16)
    write_seq(tmp_path / "m.seq", frames, bits=12, frame_rate=10.0, times_us=list(range(0, 6 * 33_784, 33_784)))
    told = "m.seq: it states 10 frames per second, its time stamps 29.5998: these are taken"
    assert _seen(tmp_path / "m.seq", kind="monochrome")["warnings"] == [told]


def test_planes_of_one_time_are_described(tmp_path: Path) -> None:
    frames = np.random.default_rng(1).integers(0, 4096, (6, 2, 12, 16)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "m.tif", frames, imagej=True, metadata={"axes": "TCYX", "finterval": 0.5})
    description = _seen(tmp_path / "m.tif")
    assert (description["count"], description["last_time_ns"]) == (6, 2_500_000_000)
    assert description["warnings"] == ["it holds 2 channels of each time: frames.lights = 2"]
