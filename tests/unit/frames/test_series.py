"""The frames of a test: which, in which order, of one size, with names and hashes."""

from __future__ import annotations

import hashlib
import os
import pickle
import socket
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from frames import noisy_mosaic
from hypothesis import given
from hypothesis import strategies as st
from real_files import RealData
from seq_files import write_seq

from rgbmidic.errors import ConfigurationError, FrameError
from rgbmidic.frames import FrameSeries, FrameSource, file_hash, formats, list_frames, open_series
from rgbmidic.frames.data import ChannelFrame
from rgbmidic.frames.formats import FrameFormat
from rgbmidic.frames.images import write_dng, write_tiff
from rgbmidic.frames.metadata import StoredFrame
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.settings import FrameSettings, TestSettings


def _write(folder: Path, names: list[str], shape: tuple[int, int] = (24, 30)) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(names):
        write_tiff(folder / name, noisy_mosaic(shape, seed=seed))


def _names(files: tuple[Path, ...]) -> list[str]:
    return [file.name for file in files]


def test_natural_order(tmp_path: Path) -> None:
    for name in ("f10.tif", "f9.tif", "f1_20.tif", "f1_3.tif", "g².tif", "F2.tif"):
        (tmp_path / name).touch()
    assert _names(list_frames("*.tif", tmp_path)) == ["f1_3.tif", "f1_20.tif", "F2.tif", "f9.tif", "f10.tif", "g².tif"]


@given(numbers=st.lists(st.integers(0, 10**6), unique=True, min_size=1, max_size=20))
def test_numbered_names_come_in_the_order_of_their_numbers(
    tmp_path_factory: pytest.TempPathFactory, numbers: list[int]
) -> None:
    folder = tmp_path_factory.mktemp("numbers")
    for number in numbers:
        (folder / f"frame {number}.png").touch()
    assert _names(list_frames(folder, ".")) == [f"frame {number}.png" for number in sorted(numbers)]


def test_folder_pattern_file_and_absolute_pattern(tmp_path: Path) -> None:
    folder = tmp_path / "run [1]"
    _write(folder, ["a1.tif", "a2.tif"])
    (folder / "notes.txt").touch()
    (folder / ".a0.tif").touch()
    (folder / "sub.tif").mkdir()
    assert _names(list_frames("run [1]", tmp_path)) == ["a1.tif", "a2.tif"]
    assert _names(list_frames("run [1]/a2.tif", tmp_path)) == ["a2.tif"]
    assert _names(list_frames("*/a*.tif", tmp_path)) == ["a1.tif", "a2.tif"]
    assert _names(list_frames("**/a*.tif", tmp_path)) == ["a1.tif", "a2.tif"]
    assert _names(list_frames(str(tmp_path / "*" / "*.tif"), "elsewhere")) == ["a1.tif", "a2.tif"]


def test_nothing_found_names_the_pattern_and_the_place(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match=rf"dark/\*\.tif.*{tmp_path}"):
        list_frames("dark/*.tif", tmp_path)
    with pytest.raises(FrameError, match="folder without frames"):
        list_frames(".", tmp_path)


def test_a_series_gives_frames_names_and_fingerprints(tmp_path: Path) -> None:
    _write(tmp_path, ["f2.tif", "f10.tif"])
    series = open_series(FrameSettings(path=("*.tif",), cfa="RGGB", white_level=4095), tmp_path)
    assert (len(series), series.name(0), series.name(1)) == (2, "f2.tif", "f10.tif")
    (frame,) = series.read(1)
    np.testing.assert_array_equal(frame.values, noisy_mosaic((24, 30), seed=1).values)
    assert frame.white_level == 4095
    assert series.inputs(0) == {
        str(tmp_path / "f2.tif"): hashlib.sha256((tmp_path / "f2.tif").read_bytes()).hexdigest()
    }
    for index in (-1, 2):
        with pytest.raises(IndexError):
            series.read(index)


def _series(folder: Path, names: Sequence[str], **options: Any) -> FrameSeries:
    _write(folder, list(names))
    return open_series(FrameSettings(path=(str(folder),), cfa="RGGB"), **options)


@pytest.mark.parametrize(
    ("names", "numbers", "missing"),
    [
        (["f0", "f1", "f2", "f4"], [0, 1, 2, 4], "3"),
        (["f_098", "f_099", "f_100", "f_103"], [0, 1, 2, 5], "101, 102"),
        (["f0", "f10", "f20", "f40"], [0, 1, 2, 4], "30"),
        (["a3_2", "a3_3", "a3_5"], [0, 1, 3], "4"),
        (["f0", "f1", "f1000000000000"], [0, 1, 10**12], ""),
        (["f1", "f2", "f3"], [0, 1, 2], ""),
        (["load_0", "load_10", "load_20"], [0, 1, 2], ""),
        (["cfrp_00", "cfrp_04", "cfrp_11"], [0, 4, 11], ""),
        (["def_1", "def_5", "ref"], [0, 1, 2], ""),
        (["f1_t100", "f2_t250", "f3_t900"], [0, 1, 2], ""),
        (["f1", "f01", "f4"], [0, 1, 2], ""),
        (["frame"], [0], ""),
    ],
)
def test_a_number_missing_in_the_names_is_told_and_kept_as_a_gap(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, names: list[str], numbers: list[int], missing: str
) -> None:
    series = _series(tmp_path, [f"{name}.tif" for name in names])
    assert list(series.numbers) == numbers
    told = [text for text in caplog.messages if "frames are missing" in text]
    assert [message.split("in the numbering, ")[1].split(";")[0] for message in told] == ([missing] if missing else [])


@pytest.mark.parametrize(
    ("names", "numbers", "doubt"),
    [
        ("shot_-00002 shot_-00001 shot_000000 shot_+00001", range(4), ""),
        ("shot-2 shot-1 shot0 shot1 shot3", (0, 1, 2, 3, 5), ""),
        ("foo_-002 foo_-001 foo_0000 foo_0001", range(4), ""),
        ("DSC_9997 DSC_9998 DSC_9999 DSC_0001 DSC_0002 DSC_0004", (0, 1, 2, 3, 4, 6), "counter seems to begin again"),
        ("IMG_170431 IMG_170431(1) IMG_170431(2) IMG_170431(10)", range(4), "several forms"),
        ("test test-1 test-2 test-10", range(4), "several forms"),
        ("load_0kN load_0.25kN load_0.5kN load_0.75kN load_1kN load_1.5kN", (0, 1, 2, 3, 4, 6), ""),
        ("load_-1,5 load_-1 load_0 load_0,5", (0, 1, 3, 4), ""),
        ("plate_0.25 plate_0.5 plate_0.75", range(3), "may be counters"),
        ("run1.1 run1.2 run1.9 run1.10", (0, 1, 8, 9), ""),
        ("run1.0 run1.5 run2.0", range(3), ""),
        ("scan-1 scan-2 scan-10", (0, 1, 9), ""),
        ("2026-11-09_1 2026-11-10_1 2026-11-10_2", range(3), ""),
        ("f0001 f0002 f9998", (0, 1, 9997), ""),
        ("f0002 f0500 f9000", (0, 249, 4499), ""),
        ("x001 x98 x99", (0, 97, 98), ""),
        ("ref_1 ref_2 stage_1", range(3), "several forms"),
    ],
)
def test_signs_and_fractions_count_where_the_series_has_them(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, names: str, numbers: Sequence[int], doubt: str
) -> None:
    ordered = [f"{name}.tif" for name in names.split()]
    _write(tmp_path, sorted(ordered, key=lambda name: hashlib.sha256(name.encode()).digest()))
    series = open_series(FrameSettings(path=("*.tif",), cfa="RGGB"), tmp_path)
    assert [series.name(index) for index in range(len(series))] == ordered
    assert list(series.numbers) == list(numbers)
    doubts = [text for text in caplog.messages if "order of *.tif is uncertain" in text]
    assert len(doubts) == bool(doubt)
    assert all(doubt in text and f"taken as {ordered[0]}, {ordered[1]}" in text for text in doubts)


def test_a_frame_in_two_formats_is_not_measured_twice(tmp_path: Path) -> None:
    _write(tmp_path, ["f1.tif", "f2.tif"])
    for index in (1, 2):
        write_dng(tmp_path / f"f{index}.dng", noisy_mosaic((24, 30), seed=index))
    with pytest.raises(FrameError, match=r"f1\.dng and f1\.tif: is that one frame in two files\? .*\*\.dng"):
        open_series(FrameSettings(path=(str(tmp_path),), cfa="RGGB"))
    assert len(open_series(FrameSettings(path=("*.dng",)), tmp_path)) == 2
    assert len(open_series(FrameSettings(path=("*.dng", "*.tif"), kind="monochrome"), tmp_path)) == 2


def test_captures_in_no_order_have_no_gaps(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    series = _series(tmp_path, ["f0.tif", "f1.tif", "f3.tif"], in_order=False)
    assert list(series.numbers) == [0, 1, 2]
    assert not caplog.records


def test_lights_that_lack_different_frames_are_refused(tmp_path: Path) -> None:
    _write(tmp_path / "left", ["1.tif", "2.tif", "4.tif"])
    _write(tmp_path / "right", ["1.tif", "3.tif", "4.tif"])
    with pytest.raises(FrameError, match=r"same frames.*left: 0, 1, 3; right: 0, 2, 3"):
        open_series(FrameSettings(path=("left", "right"), kind="monochrome"), tmp_path)


@pytest.mark.parametrize("absolute", [False, True])
def test_brackets_in_the_name_of_a_folder_are_no_pattern(tmp_path: Path, absolute: bool) -> None:
    _write(tmp_path / "run[1]" / "cam*", ["a1.tif", "a2.tif"])
    _write(tmp_path / "run1" / "cam", ["other.tif"])
    start = str(tmp_path) + "/" if absolute else ""
    for pattern in ("run[1]/cam*/*.tif", "run[1]/cam*/a[12].tif", "run[1]/**/*.tif", "run[1]/cam*"):
        files = list_frames(start + pattern, "elsewhere" if absolute else tmp_path)
        assert files == (tmp_path / "run[1]/cam*/a1.tif", tmp_path / "run[1]/cam*/a2.tif")


@pytest.mark.parametrize("pattern", ["*.tif", "."])
def test_a_link_to_nothing_keeps_its_place_and_is_told(tmp_path: Path, pattern: str) -> None:
    _write(tmp_path, ["f1.tif", "f3.tif"])
    (tmp_path / "f2.tif").symlink_to(tmp_path / "gone.tif")
    series = open_series(FrameSettings(path=(pattern,), cfa="RGGB"), tmp_path)
    assert [series.name(index) for index in range(3)] == ["f1.tif", "f2.tif", "f3.tif"]
    with pytest.raises(FrameError, match=r"f2\.tif is a link to .*gone\.tif, which does not exist"):
        series.read(1)


def test_a_folder_without_frames_says_what_to_do_with_what_it_holds(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    (tmp_path / "test.cine").touch()
    with pytest.raises(FrameError, match=r"without frames.*test\.cine is a movie or a stack: .* name the movie itself"):
        list_frames(tmp_path)


def test_lights_in_succession_come_together(tmp_path: Path) -> None:
    _write(tmp_path / "left", ["1.tif", "2.tif"])
    _write(tmp_path / "right", ["1.tif", "2.tif"])
    settings = FrameSettings(path=("left", "right"), kind="monochrome")
    series = open_series(settings, tmp_path)
    frames = series.read(0)
    assert len(series) == 2
    assert [type(frame) for frame in frames] == [ChannelFrame, ChannelFrame]
    assert len(series.inputs(0)) == 2
    assert series.name(1) == "2.tif + 2.tif"
    (tmp_path / "right" / "2.tif").unlink()
    with pytest.raises(FrameError, match="left: 2, right: 1"):
        open_series(settings, tmp_path)


def test_odd_frame_is_named(tmp_path: Path) -> None:
    _write(tmp_path, ["f1.tif", "f2.tif"])
    _write(tmp_path, ["f3.tif"], shape=(24, 31))
    with pytest.raises(FrameError, match=r"f3\.tif has 24 rows of 31 pixels, .*f1\.tif has 24 of 30"):
        open_series(FrameSettings(path=("*.tif",), cfa="RGGB"), tmp_path)


def test_one_damaged_file_does_not_stop_the_others(tmp_path: Path) -> None:
    for index in range(3):
        write_dng(tmp_path / f"f{index}.dng", noisy_mosaic(seed=index))
    (tmp_path / "f1.dng").write_bytes((tmp_path / "f1.dng").read_bytes()[:600])
    series = open_series(FrameSettings(path=("*.dng",)), tmp_path)
    assert series.read(2)[0].values.shape == (40, 50)
    with pytest.raises(FrameError, match=r"f1\.dng"):
        series.read(1)


@pytest.mark.parametrize("ending", [".tif", ".dng"])
def test_a_file_without_permission_does_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    for index in range(3):
        write_dng(tmp_path / f"f{index}.dng", noisy_mosaic(seed=index))
        write_tiff(tmp_path / f"f{index}.tif", noisy_mosaic((40, 50), seed=index))
    opened = Path.open

    def refused(path: Path, *given: Any, **options: Any) -> Any:  # the user who runs the tests may read everything
        if path.stem == "f1":
            raise PermissionError(13, "Permission denied", str(path))
        return opened(path, *given, **options)

    monkeypatch.setattr(Path, "open", refused)
    series = open_series(FrameSettings(path=(f"*{ending}",), cfa="RGGB"), tmp_path)
    assert series.fingerprint() == series.fingerprint()
    assert series.read(2)[0].values.shape == (40, 50)
    with pytest.raises(FrameError, match=rf"f1\{ending} cannot be read: Permission denied"):
        series.read(1)


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in folders")
@pytest.mark.parametrize("make", [_pipe, _socket, _device])
@pytest.mark.parametrize("ending", [".tif", ".dng"])
def test_what_is_no_regular_file_is_refused_without_opening_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], None], ending: str
) -> None:
    monkeypatch.chdir(tmp_path)  # a socket's path is short
    write_dng(tmp_path / "f0.dng", noisy_mosaic())
    write_tiff(tmp_path / "f0.tif", noisy_mosaic((40, 50)))
    make(Path(f"f1{ending}"))
    series = open_series(FrameSettings(path=(f"*{ending}",), cfa="RGGB"), tmp_path)
    assert [series.name(index) for index in range(2)] == [f"f0{ending}", f"f1{ending}"]
    assert series.fingerprint()
    with pytest.raises(FrameError, match=rf"f1\{ending} cannot be read: it is not a regular file"):
        series.read(1)


def test_a_name_that_is_not_utf_8_becomes_text(tmp_path: Path) -> None:
    try:
        _write(tmp_path, [os.fsdecode(b"fr\xe4me 1.tif"), os.fsdecode(b"fr\xe4me 2.tif")])
    except OSError:
        pytest.skip("a file system of names in UTF-8")
    series = open_series(FrameSettings(path=("*.tif",), cfa="RGGB"), tmp_path)
    assert series.name(1) == "fr\\xe4me 2.tif"
    assert list(series.inputs(0)) == [f"{tmp_path}/fr\\xe4me 1.tif"]
    assert series.fingerprint()
    (tmp_path / os.fsdecode(b"fr\xe4me 1.tif")).unlink()
    with pytest.raises(FrameError, match=r"fr\\xe4me 1\.tif"):
        series.read(0)


def test_reference_must_exist(tmp_path: Path) -> None:
    _write(tmp_path, ["f1.tif", "f2.tif"])
    with pytest.raises(FrameError, match=r"reference names frame 2, but there are 2 \(0 to 1\)"):
        open_series(FrameSettings(path=("*.tif",), cfa="RGGB", reference=(0, 2)), tmp_path)


GREYS = np.arange(10, 130, 10)
"""Grey level of each frame of a stack."""


def _in_turn(folder: Path, lost: Sequence[int] = (), **stated: Any) -> FrameSeries:
    """A monochrome camera's stack, frame i of grey level 10 (i + 1), without some frames but with their times."""
    kept = [index for index in range(len(GREYS)) if index not in lost]
    frames = np.broadcast_to(GREYS[kept, None, None], (len(kept), 12, 16)).astype(np.uint8)
    write_seq(folder / "m.seq", frames, bits=8, times_us=[250 * index for index in kept])
    return open_series(FrameSettings(path=("m.seq",), kind="monochrome", **stated), folder)


def _levels(series: FrameSeries) -> list[list[int]]:
    return [[int(frame.values[0, 0, 0]) for frame in series.read(index)] for index in range(len(series))]


def test_lights_that_fire_in_turn_share_one_series(tmp_path: Path) -> None:
    series = _in_turn(tmp_path, lights=2)
    assert _levels(series) == GREYS.reshape(-1, 2).tolist()
    assert (list(series.numbers), series.n_lost, list(series.selected)) == ([0, 1, 2, 3, 4, 5], 0, [0, 1, 2, 3, 4, 5])
    assert (series.name(1), series.time_ns(1)) == ("m.seq frame 2 + m.seq frame 3", 500_000)
    assert _levels(_in_turn(tmp_path, lights=3)) == GREYS.reshape(-1, 3).tolist()
    assert len(_in_turn(tmp_path, lights=5)) == 2  # two frames are left over
    with pytest.raises(FrameError, match="13 lights in turn, but no 13 frames make a state"):
        _in_turn(tmp_path, lights=13)


@pytest.mark.parametrize(
    ("lost", "levels", "numbers"),
    [
        ((4,), [[10, 20], [30, 40], [70, 80], [90, 100], [110, 120]], [0, 1, 3, 4, 5]),
        ((5,), [[10, 20], [30, 40], [70, 80], [90, 100], [110, 120]], [0, 1, 3, 4, 5]),
        ((5, 6), [[10, 20], [30, 40], [90, 100], [110, 120]], [0, 1, 4, 5]),
        ((4, 5), [[10, 20], [30, 40], [70, 80], [90, 100], [110, 120]], [0, 1, 3, 4, 5]),
    ],
)
def test_a_lost_frame_drops_its_state_and_shifts_no_light(
    tmp_path: Path, lost: tuple[int, ...], levels: list[list[int]], numbers: list[int]
) -> None:
    series = _in_turn(tmp_path, lost, lights=2)
    assert (_levels(series), list(series.numbers)) == (levels, numbers)
    assert series.n_lost == 6 - len(levels)


def test_with_lights_in_turn_all_keys_count_states(tmp_path: Path) -> None:
    series = _in_turn(tmp_path, lights=2, first=1, last=5, step=2, reference=(0, 5))
    assert list(series.selected) == [1, 3, 5]
    with pytest.raises(FrameError, match=r"frames\.last names frame 6, but there are 6 \(0 to 5\)"):
        _in_turn(tmp_path, lights=2, last=6)
    with pytest.raises(FrameError, match=r"frames\.reference names frame 5, but there are 5 \(0 to 4\)"):
        _in_turn(tmp_path, (4,), lights=2, reference=(0, 5))


def test_first_last_and_step_choose_frames(tmp_path: Path) -> None:
    assert list(_in_turn(tmp_path).selected) == list(range(12))
    chosen = _in_turn(tmp_path, first=3, last=9, step=3)
    assert (list(chosen.selected), len(chosen), chosen.n_lost) == ([3, 6, 9], 12, 0)
    assert list(_in_turn(tmp_path, first=10).selected) == [10, 11]
    assert _in_turn(tmp_path, (7,), first=4).n_lost == 1
    assert _in_turn(tmp_path, (7,), last=4).n_lost == 0
    for key in ("first", "last"):
        with pytest.raises(FrameError, match=rf"frames\.{key} names frame 12, but there are 12 \(0 to 11\)"):
            _in_turn(tmp_path, **{key: 12})


def test_the_reference_may_be_a_range(tmp_path: Path) -> None:
    _in_turn(tmp_path)
    for text, frames in (("0:5", (0, 1, 2, 3, 4)), (" 7 : 9 ", (7, 8))):
        document = {"frames": {"path": "m.seq", "kind": "monochrome", "reference": text}}
        stated = TestSettings.from_mapping({**document, "region": {"rectangle": [2, 2, 9, 9]}}, tmp_path).frames
        assert stated.reference == frames
        assert len(open_series(stated, tmp_path)) == 12
    with pytest.raises(FrameError, match="reference names frame 12, but there are 12"):
        open_series(replace(stated, reference=tuple(range(5, 13))), tmp_path)
    with pytest.raises(ConfigurationError, match=r"reference names 30000000 frames; at most 100000"):
        TestSettings.from_mapping({"frames": {"path": "m.seq", "reference": "0:30000000"}}, tmp_path)
    for text in ("5:5", "5", "a:b", "-1:3", "0:5:2"):
        with pytest.raises(ConfigurationError, match=r"frames\.reference must be a range such as \"0:20\" \(0 to 19\)"):
            TestSettings.from_mapping(
                {"frames": {"path": "m.seq", "reference": text}, "region": {"rectangle": [2, 2, 9, 9]}}, tmp_path
            )


class _Film(FrameSource):
    """A file of several frames, as a camera's own format gives."""

    counted: ClassVar[list[Path]] = []

    def __len__(self) -> int:
        self.counted.append(self.path)
        return self.path.stat().st_size

    def name(self, index: int) -> str:
        return f"{self.path.name}:{index}"

    def _shape(self) -> tuple[int, int]:
        return 24, 30

    def _stored(self, index: int) -> StoredFrame:
        return StoredFrame(values=np.full((24, 30), self.path.read_bytes()[index], dtype=np.uint16))


def test_a_format_of_several_frames_joins_by_a_class_and_one_entry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    film = FrameFormat(name="film", endings=(".film",), recognises=lambda path, _: path.suffix == ".film", source=_Film)
    monkeypatch.setattr(formats, "FORMATS", (film, *formats.FORMATS))
    _write(tmp_path, ["b.tif"])
    (tmp_path / "a.film").write_bytes(bytes([5, 6, 7]))
    (tmp_path / "c.film").write_bytes(bytes([8, 9]))
    series = open_series(FrameSettings(path=("*.*",), cfa="RGGB"), tmp_path)
    names = [series.name(index) for index in range(len(series))]
    assert names == ["a.film:0", "a.film:1", "a.film:2", "b.tif", "c.film:0", "c.film:1"]
    assert [int(series.read(index)[0].values[0, 0]) for index in (5, 2, 0)] == [9, 7, 5]
    assert series.inputs(4) == {str(tmp_path / "c.film"): file_hash(tmp_path / "c.film")}
    assert series.shape == (24, 30)


def test_the_frames_of_all_files_are_counted_once(tmp_path: Path) -> None:
    settings = FrameSettings(path=("frame",))
    for name in "ab":
        (tmp_path / name).write_bytes(bytes(10))
    series = FrameSeries(lights=(tuple(_Film(path=tmp_path / name, user_metadata=settings) for name in "ab"),))
    _Film.counted.clear()
    assert [series.name(index) for index in range(len(series))][9:11] == ["a:9", "b:0"]
    assert not _Film.counted


def test_a_series_goes_to_another_process_and_reads_the_same(tmp_path: Path) -> None:
    _write(tmp_path, ["f1.tif", "f2.tif"])
    series = open_series(FrameSettings(path=("*.tif",), cfa="RGGB"), tmp_path)
    unpickled = pickle.loads(pickle.dumps(series))
    assert unpickled == series
    np.testing.assert_array_equal(unpickled.read(1)[0].values, series.read(1)[0].values)


def test_a_file_is_hashed_once_until_it_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hashed = []
    digest = hashlib.file_digest
    monkeypatch.setattr(hashlib, "file_digest", lambda file, name: hashed.append(file.name) or digest(file, name))
    path = tmp_path / "film.cine"
    path.write_bytes(b"one")
    first = {file_hash(path) for _ in range(5)}
    path.write_bytes(b"other")
    assert (len(hashed), first) == (1, {hashlib.sha256(b"one").hexdigest()})
    assert file_hash(path) == hashlib.sha256(b"other").hexdigest()
    path.unlink()
    with pytest.raises(FrameError, match=r"film\.cine cannot be read"):
        file_hash(path)


def test_the_camera_fills_in_what_neither_the_file_nor_the_user_tells(tmp_path: Path) -> None:
    write_tiff(tmp_path / "f.tif", noisy_mosaic((24, 30)))

    def read(camera: Calibration, **stated: Any) -> Any:
        (frame,) = open_series(FrameSettings(path=("f.tif",), **stated), tmp_path, camera).read(0)
        return frame

    frame = read(Calibration(cfa="GBRG", black_level=16, white_level=4000))
    assert (frame.cfa, frame.black_level.tolist(), frame.white_level) == ("GBRG", [[16, 16], [16, 16]], 4000)
    assert read(Calibration(cfa="GBRG", shape=(24, 30)), white_level=4095).white_level == 4095
    assert read(Calibration(cfa="GBRG", shape=(48, 60)), crop_origin=(3, 2)).cfa == "BGGR"
    channel = read(Calibration(kind="monochrome", black_level=16, white_level=4000))
    assert (channel.values.shape, channel.black_level.tolist(), channel.white_level) == ((1, 24, 30), [16], 4000)


def test_real_series(real_data: RealData) -> None:
    settings = FrameSettings(path=("*.tif",), kind="monochrome")
    series = open_series(settings, real_data("dic_rigid_shift"))
    assert [series.name(i) for i in range(5)] == ["def_1.tif", "def_5.tif", "def_10.tif", "def_15.tif", "ref.tif"]
