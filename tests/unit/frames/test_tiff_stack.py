"""TIFF files of several frames: all layouts, times, endless lists, and what is refused with its reason."""

from __future__ import annotations

import re
import struct
import time
import tracemalloc
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from rgbmidic.errors import FrameError
from rgbmidic.frames import FrameSeries, file_fingerprint, open_series, open_source, read_frame
from rgbmidic.frames.source import FrameSource
from rgbmidic.settings import FrameSettings

FRAMES = np.random.default_rng(2).integers(0, 65536, (6, 12, 17)).astype(np.uint16)
STATED = FrameSettings(path=("frame",), kind="monochrome")


def _write(path: Path, frames: Any = FRAMES, **options: Any) -> Path:
    path.parent.mkdir(exist_ok=True)
    tifffile.imwrite(path, frames, **{"photometric": "minisblack", **options})
    return path


def _open(path: Path) -> FrameSource:
    return open_source(path, STATED)


def _series(path: Path) -> FrameSeries:
    return open_series(FrameSettings(path=(str(path),), kind="monochrome"))


def _behind_one_page(path: Path, frames: Any = FRAMES, **metadata: Any) -> Path:
    """As ImageJ stores more than 4 GB."""
    with tifffile.TiffWriter(path, imagej=True) as writer:
        writer.write(frames, truncate=True, metadata={"axes": "TYX", **metadata}, photometric="minisblack")
    return path


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"byteorder": ">"},
        {"bigtiff": True},
        {"bigtiff": True, "byteorder": ">"},
        {"compression": "zlib", "predictor": True},
        {"rowsperstrip": 5},
        {"tile": (16, 16)},
        {"imagej": True, "metadata": {"axes": "TYX"}},
        {"ome": True, "metadata": {"axes": "TYX"}},
        {"photometric": "miniswhite"},
    ],
    ids=str,
)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_every_page_is_a_frame(tmp_path: Path, options: dict[str, Any], dtype: Any) -> None:
    frames = (FRAMES % 256).astype(dtype) if dtype is np.uint8 else FRAMES
    source = _open(_write(tmp_path / "m.tif", frames, **options))
    assert (len(source), source.shape, source.name(5)) == (6, (12, 17), "m.tif frame 5")
    inverted = options.get("photometric") == "miniswhite"
    for index in (5, 0, 3):
        expected = np.iinfo(dtype).max - frames[index] if inverted else frames[index]
        np.testing.assert_array_equal(source.read(index).values[0], expected)
    assert source.fingerprint == file_fingerprint(tmp_path / "m.tif")


@pytest.mark.parametrize("planar", ["contig", "separate"])
def test_colour_pages(tmp_path: Path, planar: str) -> None:
    frames = np.random.default_rng(5).integers(0, 65536, (3, 12, 17, 3)).astype(np.uint16)
    stored = np.moveaxis(frames, -1, 1) if planar == "separate" else frames
    path = _write(tmp_path / "m.tif", np.ascontiguousarray(stored), photometric="rgb", planarconfig=planar)
    values = open_source(path, FrameSettings(path=("frame",))).read(2).values
    np.testing.assert_array_equal(np.moveaxis(values, 0, -1), frames[2])


def test_frames_behind_one_page(tmp_path: Path) -> None:
    source = _open(_behind_one_page(tmp_path / "m.tif", finterval=0.25))
    assert len(source) == 6
    for index in (5, 0, 2):
        np.testing.assert_array_equal(source.read(index).values[0], FRAMES[index])
    content = (tmp_path / "m.tif").read_bytes()
    (tmp_path / "m.tif").write_bytes(content[: len(content) - 100])
    source = _open(tmp_path / "m.tif")
    assert len(source) == 6
    np.testing.assert_array_equal(source.read(4).values[0], FRAMES[4])
    with pytest.raises(
        FrameError, match=r"m\.tif: the file ends after frame 4 of 6 \(0 to 5\): truncated or still being"
    ):
        source.read(5)


def test_more_than_four_gigabytes_behind_one_page_take_no_memory(tmp_path: Path) -> None:
    frame = np.random.default_rng(7).integers(0, 65536, (64, 64)).astype(np.uint16)
    path, count = _behind_one_page(tmp_path / "m.tif", np.stack([frame, frame])), 600_000
    with tifffile.TiffFile(path) as tiff:
        begin = tiff.pages.first.dataoffsets[0]
    _description(path, f"ImageJ=1.54\nimages={count}\nframes={count}\n")
    with path.open("r+b") as file:
        file.seek(begin + (count - 1) * frame.nbytes)  # the hole before takes no place on the disk
        file.write(frame.tobytes())
        assert file.tell() > 2**32
    tracemalloc.start()
    source = _open(path)
    np.testing.assert_array_equal(source.read(count - 1).values[0], frame)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10e6


def _description(path: Path, text: str) -> Path:
    """Another description in the place of the first."""
    with tifffile.TiffFile(path, mode="r+") as tiff:
        tiff.pages.first.tags[270].overwrite(text)
    return path


@pytest.mark.parametrize(
    ("options", "times"),
    [
        ({"imagej": True, "metadata": {"axes": "TYX", "finterval": 0.01}}, [0, 10**7, 2 * 10**7]),
        ({"imagej": True, "metadata": {"axes": "TYX", "finterval": 2.5, "tunit": "ms"}}, [0, 2500000, 5000000]),
        ({"imagej": True, "metadata": {"axes": "CYX", "finterval": 0.01}}, None),
        ({"ome": True, "metadata": {"axes": "TYX", "TimeIncrement": 20, "TimeIncrementUnit": "µs"}}, [0, 20000, 40000]),
        ({"ome": True, "metadata": {"axes": "TYX", "Plane": {"DeltaT": [0.5, 1, 2]}}}, [500000000, 10**9, 2 * 10**9]),
        ({"ome": True, "metadata": {"axes": "TYX"}}, None),
        ({}, None),
    ],
    ids=str,
)
def test_times_where_the_file_tells_them(tmp_path: Path, options: dict[str, Any], times: list[int] | None) -> None:
    recording = _open(_write(tmp_path / "m.tif", FRAMES[:3], **options)).recording
    assert (None if recording.times_ns is None else recording.times_ns.tolist()) == times


def test_a_list_of_pages_that_ends_early_gives_the_frames_before(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "m.tif") as writer:
        for frame in FRAMES:
            writer.write(frame, contiguous=False, photometric="minisblack", metadata=None)
    with tifffile.TiffFile(tmp_path / "m.tif") as tiff:
        fifth = tiff.pages[4].offset
    content = (tmp_path / "m.tif").read_bytes()
    (tmp_path / "m.tif").write_bytes(content[:fifth])
    series = _series(tmp_path / "m.tif")
    np.testing.assert_array_equal(series.read(3)[0].values[0], FRAMES[3])
    assert len(series) == 5
    with pytest.raises(FrameError, match=r"m\.tif: its list of frames ends after 3: truncated or still being written"):
        series.read(4)


def test_a_page_of_another_size_is_named(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "m.tif") as writer:
        for frame in (FRAMES[0], FRAMES[1][:, :-1]):
            writer.write(frame, photometric="minisblack", metadata=None)
    series = _series(tmp_path / "m.tif")
    assert series.read(0)[0].values.shape == (1, 12, 17)
    with pytest.raises(FrameError, match=r"m\.tif: frame 1 has 12 rows of 16 pixels, the first 12 of 17"):
        series.read(1)


def test_thumbnails_are_no_frames(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "m.tif") as writer:
        for frame in FRAMES[:2]:
            writer.write(frame, photometric="minisblack", metadata=None)
            writer.write(frame[::4, ::4], photometric="minisblack", metadata=None, subfiletype=1)
    source = _open(tmp_path / "m.tif")
    assert len(source) == 2
    np.testing.assert_array_equal(source.read(1).values[0], FRAMES[1])


def test_a_file_of_one_page_stays_one_frame(tmp_path: Path) -> None:
    path = _write(tmp_path / "m.tif", FRAMES[0])
    content = path.read_bytes()
    assert (len(_open(path)), _open(path).name(0)) == (1, "m.tif")
    for cut in (0, 4, 100, len(content) // 2):
        path.write_bytes(content[:cut])
        series = _series(path)
        assert len(series) == 1
        with pytest.raises(FrameError, match=r"m\.tif"):
            series.read(0)


def test_a_folder_of_stacks_is_one_series(tmp_path: Path) -> None:
    for number, part in enumerate((FRAMES[:4], FRAMES[4:])):
        _write(tmp_path / f"part_{number}.tif", part)
    series = _series(tmp_path)
    assert (len(series), series.name(4)) == (6, "part_1.tif frame 0")
    np.testing.assert_array_equal(series.read(5)[0].values[0], FRAMES[5])
    np.testing.assert_array_equal(read_frame(tmp_path / "part_1.tif", kind="monochrome").values[0], FRAMES[4])


def test_a_way_of_storing_that_is_not_read(tmp_path: Path) -> None:
    path = _write(tmp_path / "m.tif")
    with tifffile.TiffFile(path, mode="r+") as tiff:
        tiff.pages[2].aspage().tags[259].overwrite(5)
    assert _open(path).read(1).values.shape == (1, 12, 17)
    with pytest.raises(FrameError, match=r"m\.tif is stored in a way that is not read \(LZW\)"):
        _open(path).read(2)


def test_absurd_pages_are_refused_before_anything_is_allocated(tmp_path: Path) -> None:
    path = _write(tmp_path / "m.tif")
    with tifffile.TiffFile(path, mode="r+") as tiff:
        page = tiff.pages[1].aspage()
        page.tags[256].overwrite(60000)
        page.tags[257].overwrite(60000)
    tracemalloc.start()
    with pytest.raises(FrameError, match=r"m\.tif"):
        _open(path).read(1)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()
    with pytest.raises(FrameError, match="announces 3000000 frames"):
        _check(_description(_behind_one_page(tmp_path / "n.tif"), "ImageJ=1.54\nimages=3000000\n"))


def _check(path: Path) -> None:
    from rgbmidic.frames.tiff import TiffStack

    len(TiffStack(path=path, user_metadata=STATED))


def _write_pages(path: Path, count: int) -> None:
    """`count` pages of 2x2 samples whose value is the page's number."""
    codes = (256, 257, 258, 259, 262, 273, 277, 278, 279)
    entry = np.dtype([("code", "<u2"), ("kind", "<u2"), ("number", "<u4"), ("value", "<u4")])
    page = np.dtype([("count", "<u2"), ("entries", entry, len(codes)), ("next", "<u4"), ("samples", "u1", 4)])
    pages, starts = np.zeros(count, dtype=page), 8 + np.arange(count) * page.itemsize
    pages["count"], pages["entries"]["code"], pages["entries"]["kind"], pages["entries"]["number"] = 9, codes, 4, 1
    pages["entries"]["value"] = (2, 2, 8, 1, 1, 0, 1, 2, 4)
    pages["entries"]["value"][:, 5] = starts + page.itemsize - 4
    pages["next"][:-1] = starts[1:]
    pages["samples"] = (np.arange(count) % 251)[:, None]
    path.write_bytes(struct.pack("<4sI", b"II*\0", 8) + pages.tobytes())


OPENING_S = 5.0
"""Of processor time; measured .6 s for 100,000 pages. tifffile would follow the list for each frame anew."""


def test_a_hundred_thousand_pages_are_followed_once(tmp_path: Path) -> None:
    _write_pages(tmp_path / "m.tif", 100_000)
    begin = time.process_time()
    source = _open(tmp_path / "m.tif")
    assert len(source) == 100_000
    assert time.process_time() - begin < OPENING_S
    begin = time.process_time()
    for index in (99_999, 0, 50_000):
        assert (source.read(index).values == index % 251).all()
    assert time.process_time() - begin < 1.0


def _planes(path: Path, order: str, **options: Any) -> np.ndarray:
    """Three times of two planes, stored in the order of the axes; the samples say time and plane."""
    frames = np.empty((3, 2, 12, 17), dtype=np.uint16)
    frames[...] = np.arange(6).reshape(3, 2, 1, 1)
    stored = frames.swapaxes(0, 1) if order.endswith("TYX") else frames
    tifffile.imwrite(path, np.ascontiguousarray(stored), photometric="minisblack", metadata={"axes": order}, **options)
    return frames


@pytest.mark.parametrize(
    ("order", "options", "planes"),
    [
        ("TCYX", {"imagej": True}, "2 channels of 3 times"),
        ("TZYX", {"imagej": True}, "2 slices of 3 times"),
        ("TCYX", {"ome": True}, "2 channels of 3 times"),
        ("CTYX", {"ome": True}, "2 channels of 3 times"),
        ("ZTYX", {"ome": True}, "2 slices of 3 times"),
    ],
    ids=str,
)
def test_planes_of_one_time_are_lights_and_no_frames(
    tmp_path: Path, order: str, options: dict[str, Any], planes: str
) -> None:
    frames = _planes(tmp_path / "m.tif", order, **options)
    with pytest.raises(FrameError, match=rf"m\.tif holds {planes}: state frames\.lights = 2"):
        _series(tmp_path / "m.tif")
    with pytest.raises(FrameError, match=r"lights is 3"):
        open_series(FrameSettings(path=(str(tmp_path / "m.tif"),), kind="monochrome", lights=3))
    series = open_series(FrameSettings(path=(str(tmp_path / "m.tif"),), kind="monochrome", lights=2))
    assert len(series) == 3
    for index in range(3):
        read = np.stack([frame.values[0] for frame in series.read(index)])
        np.testing.assert_array_equal(read, frames[index])


def test_pages_lie_where_ome_states(tmp_path: Path) -> None:
    _planes(tmp_path / "m.tif", "TCYX", ome=True)
    places = {(time, channel): page for page, (channel, time) in enumerate(np.ndindex(2, 3))}  # channel after channel
    parts = "".join(
        f'<TiffData IFD="{page}" FirstT="{time}" FirstC="{channel}" PlaneCount="1"/>'
        for (time, channel), page in places.items()
    )
    with tifffile.TiffFile(tmp_path / "m.tif") as tiff:
        text = re.sub(r"<TiffData[^>]*/>", parts, tiff.ome_metadata)
    _description(tmp_path / "m.tif", text)
    series = open_series(FrameSettings(path=(str(tmp_path / "m.tif"),), kind="monochrome", lights=2))
    assert [[int(frame.values[0, 0, 0]) for frame in series.read(index)] for index in range(3)] == [
        [0, 3],
        [1, 4],
        [2, 5],
    ]


@pytest.mark.parametrize("axes", ["CYX", "ZYX", "TYX"])
def test_the_only_axis_of_a_stack_is_time(tmp_path: Path, axes: str) -> None:
    path = _write(tmp_path / "m.tif", imagej=True, metadata={"axes": axes})
    assert len(_series(path)) == 6


def test_one_page_with_the_text_of_a_stack_is_one_frame(tmp_path: Path) -> None:
    """As programs that split a stack leave it."""
    for number, text in enumerate(("ImageJ=1.54\nimages=5\nframes=5\n", '{"shape": [5, 12, 17]}')):
        _write(tmp_path / f"one_{number}.tif", FRAMES[number], metadata=None, description=text)
    series = _series(tmp_path)
    assert (len(series), list(series.numbers)) == (2, [0, 1])
    np.testing.assert_array_equal(series.read(1)[0].values[0], FRAMES[1])
    _description(_write(tmp_path / "m.tif", FRAMES[:3]), "ImageJ=1.54\nimages=5\nframes=5\nfinterval=0.1\n")
    source = _open(tmp_path / "m.tif")
    assert (len(source), source.recording.times_ns) == (3, None)
    assert source.recording.remarks == ("its text announces 5 images, it holds 3: the text is not used",)
    assert series.remarks == ("one_0.tif: its text announces 5 images, it holds 1: the text is not used",)


def test_what_is_lost_of_a_description_is_reported(tmp_path: Path) -> None:
    path = _description(_behind_one_page(tmp_path / "m.tif"), "ImageJ=1.54\nimages=4\nframes=4\n")
    assert _series(path).remarks == ("m.tif: its text announces 4 images, and it has room for 6",)
    path = _description(_write(tmp_path / "o.tif"), '<OME><Image><Pixels SizeT="6"')
    assert _series(path).remarks == ("o.tif: its OME description cannot be read",)
    for number, frames in enumerate((FRAMES, FRAMES, FRAMES)):
        _write(tmp_path / "several" / f"{number}.tif", frames)
    with tifffile.TiffFile(tmp_path / "several" / "1.tif") as tiff:
        following = tiff.pages[1].offset
    content = (tmp_path / "several" / "1.tif").read_bytes()
    (tmp_path / "several" / "1.tif").write_bytes(content.replace(struct.pack("<I", following), bytes(4), 1))
    remark = "1.tif: its text announces 6 images, it holds 1: the text is not used"
    assert _series(tmp_path / "several").remarks == (remark,)


@pytest.mark.parametrize("options", [{}, {"metadata": None}, {"imagej": True, "metadata": {"axes": "TYX"}}], ids=str)
def test_a_stack_that_is_cut_anywhere_loses_no_frame_in_silence(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, options: dict[str, Any]
) -> None:
    for number in range(3):
        _write(tmp_path / f"{number}.tif", **options)
    content, opened = (tmp_path / "1.tif").read_bytes(), 0
    for length in np.linspace(16, len(content) - 1, 40).astype(int):
        (tmp_path / "1.tif").write_bytes(content[:length])
        try:
            series = _series(tmp_path)
        except FrameError as error:
            assert re.search(r"1\.tif is (damaged|truncated)", str(error))  # noqa: PT017
            continue
        opened += 1
        assert len(series) == 18
        for index in (0, 5, 6, 7, 11, 12, 17):
            with suppress(FrameError) if 6 <= index < 12 else nullcontext():
                np.testing.assert_array_equal(series.read(index)[0].values[0], FRAMES[index % 6])
    assert opened > (0 if options.get("metadata", "") is None else 10)
    assert not [record for record in caplog.records if record.name.startswith("rgbmidic")]
    (tmp_path / "1.tif").write_bytes(content[: len(content) // 2])
    alone = _series(tmp_path / "1.tif")
    with pytest.raises(FrameError, match=r"1\.tif.* truncated"):
        alone.read(len(alone) - 1)


@pytest.mark.parametrize("options", [{}, {"rowsperstrip": 7}, {"compression": "zlib"}, {"tile": (16, 16)}], ids=str)
def test_a_list_of_pages_that_ends_before_the_file_does_is_reported(tmp_path: Path, options: dict[str, Any]) -> None:
    path = tmp_path / "m.tif"
    with tifffile.TiffWriter(path) as writer:
        for frame in FRAMES:
            writer.write(frame, metadata=None, contiguous=False, photometric="minisblack", **options)
    assert _series(path).remarks == ()
    with tifffile.TiffFile(path) as tiff:
        offsets = [page.offset for page in tiff.pages]
    content = path.read_bytes()
    for listed in (1, 5):
        path.write_bytes(content.replace(struct.pack("<I", offsets[listed]), bytes(4), 1))
        (remark,) = _series(path).remarks
        missing, count, frame_bytes = (int(number) for number in re.findall(r"\d+", remark.removeprefix("m.tif")))
        assert count == listed
        assert 0.8 < missing / ((6 - listed) * frame_bytes) < 3  # compressed frames differ, pages lie between them
