"""Stacks in .npy and HDF5 files: one frame at a time, and what is refused with its reason."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from rgbmidic.errors import FrameError
from rgbmidic.frames import FrameSeries, open_series, open_source
from rgbmidic.settings import FrameSettings

FRAMES = np.random.default_rng(2).integers(0, 65536, (6, 12, 17)).astype(np.uint16)
COLOUR = np.random.default_rng(3).integers(0, 256, (4, 12, 17, 3)).astype(np.uint8)


def _series(path: Path | str, kind: Any = "monochrome") -> FrameSeries:
    return open_series(FrameSettings(path=(str(path),), kind=kind))


def _npy(path: Path, values: Any) -> Path:
    np.save(path, values)
    return path


def _h5(path: Path, **datasets: Any) -> Path:
    with h5py.File(path, "w") as file:
        for name, (values, options) in datasets.items():
            dataset = file.create_dataset(name.replace("__", "/"), data=values, **options.get("store", {}))
            dataset.attrs.update(options.get("attributes", {}))
    return path


def _check(series: FrameSeries, frames: np.ndarray[Any, Any]) -> None:
    assert (len(series), series.shape) == (len(frames), frames.shape[1:3])
    for index in (len(frames) - 1, 0, len(frames) // 2):
        (frame,) = series.read(index)
        np.testing.assert_array_equal(np.moveaxis(frame.values, 0, -1).squeeze(), frames[index])
        assert frame.white_level == np.iinfo(frames.dtype).max


@pytest.mark.parametrize("frames", [FRAMES, FRAMES.astype(np.uint8), COLOUR], ids=["uint16", "uint8", "rgb"])
@pytest.mark.parametrize("form", ["npy", "big-endian npy", "h5", "chunks.h5"])
def test_stacks_come_back(tmp_path: Path, frames: np.ndarray[Any, Any], form: str) -> None:
    kind = "rgb" if frames.ndim == 4 else "monochrome"
    if form.endswith("npy"):
        path = _npy(tmp_path / "m.npy", frames.astype(frames.dtype.newbyteorder(">")) if "big" in form else frames)
    else:
        chunks = (2, 7, 9, 3)[: frames.ndim]
        store = {"chunks": chunks, "compression": "gzip"} if "chunks" in form else {}
        path = _h5(tmp_path / "m.h5", entry__data=(frames, {"store": store}))
    series = _series(path, kind)
    _check(series, frames)
    assert series.name(1) == f"{path.name} frame 1"


def test_one_frame_alone(tmp_path: Path) -> None:
    for path in (_npy(tmp_path / "m.npy", FRAMES[0]), _h5(tmp_path / "m.h5", frame=(FRAMES[0], {}))):
        _check(_series(path), FRAMES[:1])
    _check(_series(_npy(tmp_path / "rgb.npy", COLOUR[0]), "rgb"), COLOUR[:1])


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (FRAMES.astype(np.float32), r"type float32; allowed are \(frames, rows, columns\)"),
        (FRAMES.astype(np.int16), "type int16"),
        (np.asfortranarray(FRAMES), r"Fortran order; save it with .*ascontiguousarray"),
        (FRAMES[0, 0], r"shape \(17,\)"),
        (FRAMES[None], r"shape \(1, 6, 12, 17\)"),
        (FRAMES[:0], r"shape \(0, 12, 17\)"),
        (np.array(["no", "frame"], dtype=object), "type object"),
    ],
    ids=["float", "signed", "fortran", "1d", "4d", "empty", "objects"],
)
def test_an_array_that_is_no_stack(tmp_path: Path, values: Any, reason: str) -> None:
    with pytest.raises(FrameError, match=rf"m\.npy .*{reason}"):
        _series(_npy(tmp_path / "m.npy", values))


def test_an_npy_stack_that_ends_early(tmp_path: Path) -> None:
    path = _npy(tmp_path / "m.npy", FRAMES)
    path.write_bytes(path.read_bytes()[:-800])
    series = _series(path)
    assert len(series) == 6
    np.testing.assert_array_equal(series.read(3)[0].values[0], FRAMES[3])
    for index in (4, 5):
        with pytest.raises(
            FrameError, match=r"m\.npy: the file ends after frame 3 of 6 \(0 to 5\): truncated or still being"
        ):
            series.read(index)


def test_a_stack_larger_than_memory_is_read_frame_by_frame(tmp_path: Path) -> None:
    shape = (20_000, 1024, 640)  # 26 GB, a hole in the disk
    with (tmp_path / "m.npy").open("wb") as file:
        header = {"descr": "<u2", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_2_0(file, header)
        file.seek(2 * np.prod(shape[1:]) * (shape[0] - 1), 1)
        file.write(np.full(shape[1:], 7, dtype=np.uint16).tobytes())
    tracemalloc.start()
    series = _series(tmp_path / "m.npy")
    assert (series.read(shape[0] - 1)[0].values == 7).all()
    assert tracemalloc.get_traced_memory()[1] < 60e6  # the numbers of the frames included
    tracemalloc.stop()


def test_a_dataset_is_named_or_the_only_one(tmp_path: Path) -> None:
    other = FRAMES[::-1].copy()
    path = _h5(tmp_path / "m.h5", entry__data=(FRAMES, {}), dark=(other, {}), mask=(FRAMES[0], {}), log=([1.5], {}))
    _check(_series(f"{path}:/entry/data"), FRAMES)
    _check(_series(f"{tmp_path}/*.h5:dark"), other)
    assert _series(f"{path}:dark").name(2) == "m.h5:dark frame 2"
    with pytest.raises(FrameError, match=r'several datasets of frames, .*name one, as in "m\.h5:/'):
        _series(path)
    with pytest.raises(FrameError, match=r"no dataset of frames /none; those there are: .*/dark, .*/entry/data"):
        _series(f"{path}:none")
    alone = _h5(tmp_path / "n.nxs", entry__data=(FRAMES, {}), mask=(FRAMES[0], {}))
    _check(_series(alone), FRAMES)
    with pytest.raises(FrameError, match="holds no dataset of shape"):
        _series(_h5(tmp_path / "o.hdf5", log=([1.5], {})))
    with pytest.raises(FrameError, match=r"no file matches: .*gone\.h5 "):
        _series(tmp_path / "gone.h5")


@pytest.mark.parametrize(
    ("attributes", "rate", "times"),
    [
        ({"frame_rate": 30000}, 30000, [0, 33333, 66667]),
        ({"frame_rate": 1e6, "times_ns": np.array([-1000, 0, 1001])}, 1e6, [-1000, 0, 1001]),
        ({"frame_rate": -1.0}, None, None),
        ({"frame_rate": "fast", "times_ns": np.array([1, 2])}, None, None),
        ({}, None, None),
    ],
    ids=["rate", "times", "negative", "text", "none"],
)
def test_times_from_attributes(tmp_path: Path, attributes: dict[str, Any], rate: Any, times: Any) -> None:
    recording = _series(_h5(tmp_path / "m.h5", data=(FRAMES[:3], {"attributes": attributes}))).recording
    told = None if recording.times_ns is None else recording.times_ns.tolist()
    assert (recording.frame_rate, told) == (rate, times)


def test_chunks_that_were_never_written_are_no_black_frames(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "m.h5", "w") as file:
        data = file.create_dataset("data", (6, 12, 17), np.uint16, chunks=(1, 12, 17))
        data[:4] = FRAMES[:4]
        file.create_dataset("flat", (6, 12, 17), np.uint16)
    series = _series(tmp_path / "m.h5:data")
    np.testing.assert_array_equal(series.read(3)[0].values[0], FRAMES[3])
    with pytest.raises(FrameError, match=r"m\.h5: frame 4 of 6 is not all there: truncated or still being written"):
        series.read(4)
    with pytest.raises(FrameError, match=r"m\.h5: the file ends before the first frame of 6"):
        _series(tmp_path / "m.h5:flat").read(0)


@pytest.mark.parametrize(("old", "new"), [((70, 0), (60, 0)), ((70, 0), (0, 0))])
def test_a_chunk_of_another_size_is_no_frame(tmp_path: Path, old: tuple[int, int], new: tuple[int, int]) -> None:
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file.create_dataset("data", data=np.ones((2, 10, 14), dtype=np.uint16), chunks=(1, 5, 7), shuffle=True)
    content = (tmp_path / "m.h5").read_bytes()
    entry = struct.pack("<IIQ", *old, 0)  # size and mask of a chunk, and its first index
    (tmp_path / "m.h5").write_bytes(content.replace(entry, struct.pack("<IIQ", *new, 0), 1))
    series = open_series(FrameSettings(path=(str(tmp_path / "m.h5"),), kind="monochrome"))
    with pytest.raises(FrameError, match=rf"m\.h5 is damaged .* frame 0 has {new[0]} bytes; needed are 70"):
        series.read(0)
    series.read(1)


@pytest.mark.parametrize("options", [{}, {"compression": "gzip"}])
def test_a_chunk_that_a_damaged_index_does_not_lead_to_is_missed(tmp_path: Path, options: dict[str, Any]) -> None:
    frames = np.random.default_rng(3).integers(1, 4096, (5, 12, 16)).astype(np.uint16)
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file.create_dataset("data", data=frames, chunks=(1, 5, 7), **options)
    content = (tmp_path / "m.h5").read_bytes()
    entry, other = (struct.pack("<QQQQ", frame, 5, 14, 0) for frame in (2, 0))
    assert content.count(entry) == 1
    (tmp_path / "m.h5").write_bytes(content.replace(entry, other))
    series, missed = open_series(FrameSettings(path=(str(tmp_path / "m.h5"),), kind="monochrome")), 0
    for index, frame in enumerate(frames):
        try:
            (read,) = series.read(index)
        except FrameError:
            missed += 1
        else:
            np.testing.assert_array_equal(read.values[0], frame)
    assert missed


def test_a_header_that_announces_gigabytes_takes_none(tmp_path: Path) -> None:
    (tmp_path / "m.npy").write_bytes(b"\x93NUMPY\2\0" + struct.pack("<I", 2**32 - 1) + bytes(500))
    tracemalloc.start()
    with pytest.raises(FrameError, match=r"m\.npy is damaged .* expected 4294967295 bytes got 500"):
        open_series(FrameSettings(path=(str(tmp_path / "m.npy"),), kind="monochrome"))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_samples_in_other_files_are_refused(tmp_path: Path) -> None:
    _h5(tmp_path / "part.h5", data=(FRAMES, {}))
    layout = h5py.VirtualLayout(shape=FRAMES.shape, dtype=np.uint16)
    layout[:] = h5py.VirtualSource(tmp_path / "part.h5", "data", shape=FRAMES.shape)
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file.create_virtual_dataset("data", layout)
    with pytest.raises(FrameError, match=r"m\.h5: the samples of /data lie in other files"):
        _series(tmp_path / "m.h5").read(0)


def test_absurd_sizes_are_refused_before_anything_is_allocated(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file.create_dataset("frame", (2, 60000, 60000), np.uint16, chunks=(1, 100, 100), compression="gzip")
        file.create_dataset("count", (10**9, 2, 2), np.uint8, chunks=(1000, 2, 2))
    header = {"descr": "|u1", "fortran_order": False, "shape": (2, 10**6, 10**6)}
    with (tmp_path / "m.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
    tracemalloc.start()
    for path, reason in (
        ("m.h5:frame", "announces 7200 MB"),
        ("m.h5:count", "announces 1000000000 frames"),
        ("m.npy", "announces 1000000 MB"),
    ):
        with pytest.raises(FrameError, match=reason):
            open_source(tmp_path / path, FrameSettings(path=("frame",), kind="monochrome")).read(0)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


def test_a_folder_with_stacks_only_names_one(tmp_path: Path) -> None:
    _npy(tmp_path / "m.npy", FRAMES)
    with pytest.raises(FrameError, match=r"folder without frames.*m\.npy is a movie or a stack.*name the movie itself"):
        _series(tmp_path)
