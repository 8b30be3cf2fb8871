"""The frames of a test: which, in which order, of one size, with names and hashes."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from frames import noisy_mosaic
from hypothesis import given
from hypothesis import strategies as st

from rgbmidic.errors import FrameError
from rgbmidic.frames.data import ChannelFrame
from rgbmidic.frames.series import FrameFile, FrameSequence, list_frames, open_frames
from rgbmidic.frames.writers import write_dng, write_tiff
from rgbmidic.settings import FrameSettings


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


def test_sequence_reads_names_and_hashes(tmp_path: Path) -> None:
    _write(tmp_path, ["f2.tif", "f10.tif"])
    sequence = open_frames(FrameSettings(path=("*.tif",), cfa="RGGB", white_level=4095), tmp_path)
    assert (len(sequence), sequence.name(0), sequence.name(1)) == (2, "f2.tif", "f10.tif")
    (frame,) = sequence.read(1)
    np.testing.assert_array_equal(frame.values, noisy_mosaic((24, 30), seed=1).values)
    assert frame.white_level == 4095
    assert sequence.hashes(0) == {
        str(tmp_path / "f2.tif"): hashlib.sha256((tmp_path / "f2.tif").read_bytes()).hexdigest()
    }
    for index in (-1, 2):
        with pytest.raises(IndexError):
            sequence.read(index)


def test_lights_in_succession_come_together(tmp_path: Path) -> None:
    _write(tmp_path / "left", ["1.tif", "2.tif"])
    _write(tmp_path / "right", ["1.tif", "2.tif"])
    settings = FrameSettings(path=("left", "right"), kind="monochrome")
    sequence = open_frames(settings, tmp_path)
    frames = sequence.read(0)
    assert len(sequence) == 2
    assert [type(frame) for frame in frames] == [ChannelFrame, ChannelFrame]
    assert len(sequence.hashes(0)) == 2
    assert sequence.name(1) == "2.tif + 2.tif"
    (tmp_path / "right" / "2.tif").unlink()
    with pytest.raises(FrameError, match="left: 2, right: 1"):
        open_frames(settings, tmp_path)


def test_odd_frame_is_named(tmp_path: Path) -> None:
    _write(tmp_path, ["f1.tif", "f2.tif"])
    _write(tmp_path, ["f3.tif"], shape=(24, 31))
    with pytest.raises(FrameError, match=r"f3\.tif has 24 rows of 31 pixels, .*f1\.tif has 24 of 30"):
        open_frames(FrameSettings(path=("*.tif",), cfa="RGGB"), tmp_path)


def test_one_damaged_file_does_not_stop_the_others(tmp_path: Path) -> None:
    for index in range(3):
        write_dng(tmp_path / f"f{index}.dng", noisy_mosaic(seed=index))
    (tmp_path / "f1.dng").write_bytes((tmp_path / "f1.dng").read_bytes()[:600])
    sequence = open_frames(FrameSettings(path=("*.dng",)), tmp_path)
    assert sequence.read(2)[0].values.shape == (40, 50)
    with pytest.raises(FrameError, match=r"f1\.dng"):
        sequence.read(1)


def test_reference_must_exist(tmp_path: Path) -> None:
    _write(tmp_path, ["f1.tif", "f2.tif"])
    with pytest.raises(FrameError, match=r"reference names frame 2, but there are 2 \(0 to 1\)"):
        open_frames(FrameSettings(path=("*.tif",), cfa="RGGB", reference=(0, 2)), tmp_path)


class _Film:
    """A file of several frames, as a later camera format would give."""

    def __init__(self, path: Path, count: int) -> None:
        self.path, self.count, self.shape = path, count, (24, 30)

    def __len__(self) -> int:
        return self.count

    def name(self, index: int) -> str:
        return f"{self.path.name}:{index}"

    def read(self, index: int) -> ChannelFrame:
        values = np.full((1, *self.shape), index, dtype=np.uint16)
        return ChannelFrame(values=values, black_level=np.zeros(1), white_level=255)


def test_files_of_several_frames_fit_in(tmp_path: Path) -> None:
    _write(tmp_path, ["single.tif"])
    single = FrameFile(path=tmp_path / "single.tif", settings=FrameSettings(path=("single.tif",), cfa="RGGB"))
    sequence = FrameSequence(lights=((_Film(tmp_path / "a", 3), single, _Film(tmp_path / "b", 2)),))
    assert [sequence.name(index) for index in range(len(sequence))] == ["a:0", "a:1", "a:2", "single.tif", "b:0", "b:1"]
    assert [int(sequence.read(index)[0].values[0, 0, 0]) for index in (2, 5)] == [2, 1]


def test_real_series(shared_data: Path) -> None:
    settings = FrameSettings(path=("dic_rigid_shift/*.tif",), kind="monochrome")
    sequence = open_frames(settings, shared_data)
    assert [sequence.name(i) for i in range(5)] == ["def_1.tif", "def_5.tif", "def_10.tif", "def_15.tif", "ref.tif"]
