"""TIFF, PNG and headerless frames: what is read, and what is refused with its reason."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from frames import noisy_mosaic
from hypothesis import given, settings
from hypothesis import strategies as st
from real_files import RealData

from rgbmidic.cli import app as cli
from rgbmidic.cli.command import execute
from rgbmidic.errors import FrameError, InputError
from rgbmidic.frames import FrameFormat, FrameSource, StoredFrame, formats, open_series, open_source, read_frame
from rgbmidic.frames.data import ChannelFrame, Mosaic, Window
from rgbmidic.frames.formats import frame_formats
from rgbmidic.settings import FrameSettings

STATED = FrameSettings(path=("frame",))
MONO = FrameSettings(path=("frame",), kind="monochrome")
GREY = noisy_mosaic((31, 45)).values
RGB = np.random.default_rng(1).integers(0, 65536, (31, 45, 3)).astype(np.uint16)


def _png(path: Path, values: np.ndarray[Any, Any]) -> Path:
    assert cv2.imwrite(str(path), values[..., ::-1] if values.ndim == 3 else values)
    return path


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"byteorder": ">"},
        {"compression": "zlib"},
        {"compression": "zlib", "predictor": True},
        {"tile": (16, 16)},
        {"rowsperstrip": 3},
        {"bigtiff": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_tiff_of_any_layout(tmp_path: Path, options: dict[str, Any], dtype: Any) -> None:
    values = (GREY % 256).astype(dtype) if dtype is np.uint8 else GREY
    tifffile.imwrite(tmp_path / "f.tif", values, photometric="minisblack", **options)
    frame = read_frame(tmp_path / "f.tif", cfa="GBRG")
    assert isinstance(frame, Mosaic)
    np.testing.assert_array_equal(frame.values, values)
    assert (frame.cfa, frame.white_level, frame.black_level.max()) == ("GBRG", np.iinfo(dtype).max, 0)
    assert open_source(tmp_path / "f.tif", STATED).shape == GREY.shape


@pytest.mark.parametrize("values", [GREY, RGB], ids=["grey", "rgb"])
def test_lzw_tiff_and_png_from_opencv_keep_values_and_colour_order(
    tmp_path: Path, values: np.ndarray[Any, Any]
) -> None:
    kind = "monochrome" if values.ndim == 2 else None
    for name in ("f.tif", "f.png"):
        frame = read_frame(_png(tmp_path / name, values), kind=kind)
        assert isinstance(frame, ChannelFrame)
        np.testing.assert_array_equal(np.moveaxis(frame.values, 0, -1).squeeze(), values)
        assert open_source(tmp_path / name, STATED).shape == values.shape[:2]


def test_planes_one_after_the_other(tmp_path: Path) -> None:
    planes = np.ascontiguousarray(np.moveaxis(RGB, -1, 0))
    tifffile.imwrite(tmp_path / "f.tif", planes, photometric="rgb", planarconfig="separate")
    np.testing.assert_array_equal(read_frame(tmp_path / "f.tif").values, planes)


def test_bytes_whose_lowest_bit_comes_first(tmp_path: Path) -> None:
    values = np.arange(256, dtype=np.uint8).reshape(8, 32)
    turned = np.packbits(np.unpackbits(values), bitorder="little").reshape(values.shape)
    tifffile.imwrite(tmp_path / "f.tif", turned, photometric="minisblack", extratags=[(274, "H", 1, 2, True)])
    content = (tmp_path / "f.tif").read_bytes()  # tifffile writes no FillOrder: the tag of the orientation becomes one
    (tmp_path / "f.tif").write_bytes(content.replace(struct.pack("<HH", 274, 3), struct.pack("<HH", 266, 3)))
    source = open_source(tmp_path / "f.tif", FrameSettings(path=("frame",), kind="monochrome"))
    np.testing.assert_array_equal(source.read(0).values[0], values)
    part = Window(origin=(0, 4), shape=(4, 32), frame=(8, 32))
    np.testing.assert_array_equal(source.read(0, part).values[0], values[4:])


def test_tiff_that_names_its_pattern(tmp_path: Path) -> None:
    tags = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, b"\x01\x00\x02\x01", True)]
    tifffile.imwrite(tmp_path / "f.tif", GREY, photometric=32803, extratags=tags)
    frame = read_frame(tmp_path / "f.tif")
    assert isinstance(frame, Mosaic)
    assert frame.cfa == "GRBG"
    with pytest.raises(FrameError, match=r"cfa is stated as RGGB.*states GRBG"):
        read_frame(tmp_path / "f.tif", cfa="RGGB")


def test_min_is_white_is_turned_round(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "f.tif", GREY, photometric="miniswhite")
    np.testing.assert_array_equal(read_frame(tmp_path / "f.tif", kind="monochrome").values[0], 65535 - GREY)


def test_grey_table_is_read_and_a_colour_table_refused(tmp_path: Path) -> None:
    values = (GREY % 256).astype(np.uint8)
    ramp = np.tile(np.arange(256, dtype=np.uint16) * 257, (3, 1))
    tifffile.imwrite(tmp_path / "grey.tif", values, photometric="palette", colormap=ramp)
    np.testing.assert_array_equal(read_frame(tmp_path / "grey.tif", kind="monochrome").values[0], values)
    tifffile.imwrite(tmp_path / "colour.tif", values, photometric="palette", colormap=ramp[:, ::-1])
    with pytest.raises(FrameError, match=r"colour\.tif.*table"):
        read_frame(tmp_path / "colour.tif", kind="monochrome")


def test_what_is_no_raw_frame_is_refused(tmp_path: Path) -> None:
    alpha = np.dstack([RGB, RGB[..., :1]])
    cases: dict[str, tuple[dict[str, Any], np.ndarray[Any, Any]]] = {
        "32": ({}, GREY.astype(np.float32)),
        "int16": ({}, GREY.astype(np.int16)),
        "samples of shape": ({"photometric": "rgb"}, alpha),
    }
    for reason, (options, values) in cases.items():
        tifffile.imwrite(tmp_path / "f.tif", values, **options)
        with pytest.raises(FrameError, match=rf"f\.tif .*{reason}"):
            read_frame(tmp_path / "f.tif", kind="monochrome")
    _png(tmp_path / "f.png", (alpha[..., [2, 1, 0, 3]] // 256).astype(np.uint8))
    with pytest.raises(FrameError, match="without alpha"):
        read_frame(tmp_path / "f.png")


def test_colour_pictures_are_grey_only_where_that_is_stated(tmp_path: Path) -> None:
    file = _png(tmp_path / "f.png", np.repeat(GREY[..., None], 3, axis=2))
    assert len(read_frame(file).values) == 3
    np.testing.assert_array_equal(read_frame(file, kind="monochrome").values[0], GREY)
    other = _png(tmp_path / "g.png", RGB)
    np.testing.assert_array_equal(read_frame(other, kind="monochrome").values[0], RGB[..., 1])
    with pytest.raises(FrameError, match=r"kind is stated as bayer, but .*rgb"):
        read_frame(other, kind="bayer", cfa="RGGB")


def test_a_mosaic_needs_its_pattern(tmp_path: Path) -> None:
    file = _png(tmp_path / "f.png", GREY)
    with pytest.raises(FrameError, match=r"f\.png does not state .*RGGB, BGGR, GRBG, GBRG.*monochrome"):
        read_frame(file)
    with pytest.raises(InputError, match=r"^cfa.*RGGB, BGGR, GRBG, GBRG.*RGBG"):
        read_frame(file, cfa="RGBG")
    for kind in ("monochrome", "rgb"):
        with pytest.raises(FrameError, match=r"cfa|kind"):
            read_frame(file, kind=kind, cfa="RGGB")


def _pack(values: np.ndarray, bits: int) -> np.ndarray:
    """Rows of samples without a gap between them, the highest bit first."""
    single = values[..., None] >> np.arange(bits)[::-1] & 1
    return np.packbits(single.reshape(len(values), -1).astype(np.uint8), axis=1)


@pytest.mark.parametrize("bits", [10, 12, 14])
@pytest.mark.parametrize(("rows_per_strip", "columns"), [(31, 45), (7, 45), (7, 44)])
def test_packed_samples_of_a_tiff(tmp_path: Path, bits: int, rows_per_strip: int, columns: int) -> None:
    values, path = GREY[:, :columns] % 2**bits, tmp_path / "f.tif"
    for kind, shown in (("minisblack", values), ("miniswhite", 2**bits - 1 - values)):
        tifffile.imwrite(path, _pack(values, bits), photometric=kind, rowsperstrip=rows_per_strip, metadata=None)
        with tifffile.TiffFile(path, mode="r+") as tiff:
            tiff.pages.first.tags["ImageWidth"].overwrite(columns)
            tiff.pages.first.tags["BitsPerSample"].overwrite(bits)
        frame = read_frame(path, kind="monochrome")
        np.testing.assert_array_equal(frame.values[0], shown)
        assert frame.white_level == 2**bits - 1
        window = Window(origin=(0, 8), shape=(16, columns), frame=values.shape)
        np.testing.assert_array_equal(open_source(path, MONO).read(0, window).values[0], shown[8:24])
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(FrameError, match=r"f\.tif is damaged or truncated"):
        read_frame(path, kind="monochrome")


def test_packed_samples_that_are_not_read_are_named(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "f.tif", _pack(GREY, 12), metadata=None)
    for tag, value, reason in (
        ("BitsPerSample", 13, "13-bit samples; allowed are unsigned 8 or 16 bit, and uncompressed 10, 12 or 14 bit"),
        ("BitsPerSample", 4, "4-bit samples; allowed"),
        ("Compression", 5, "12-bit samples; allowed"),
    ):
        tifffile.imwrite(tmp_path / "f.tif", _pack(GREY, 12), metadata=None)
        with tifffile.TiffFile(tmp_path / "f.tif", mode="r+") as tiff:
            tiff.pages.first.tags["BitsPerSample"].overwrite(12)
            tiff.pages.first.tags[tag].overwrite(value)
        with pytest.raises(FrameError, match=reason):
            read_frame(tmp_path / "f.tif", kind="monochrome")


@pytest.mark.parametrize(
    ("largest", "white"), [(255, 255), (4095, 4095), (65535, 65535), (1000, 1000), (200, 200), (1, 1)]
)
def test_pgm(tmp_path: Path, largest: int, white: float) -> None:
    values, path = (GREY.astype(int) % (largest + 1)).astype(">u2" if largest > 255 else "u1"), tmp_path / "f.pgm"
    path.write_bytes(b"P5 # by a camera\n45 31\n#\n%d\n" % largest + values.tobytes())
    frame = read_frame(path, kind="monochrome")
    np.testing.assert_array_equal(frame.values[0], values)
    assert frame.white_level == white
    window = Window(origin=(0, 8), shape=(16, 45), frame=values.shape)
    np.testing.assert_array_equal(open_source(path, MONO).read(0, window).values[0], values[8:24])
    content = path.read_bytes()
    for damaged in (content[:-1], content + b"\0", content.replace(b"45 31", b"45 0 "), content[:12]):
        path.write_bytes(damaged)
        with pytest.raises(FrameError, match=r"f\.pgm"):
            read_frame(path, kind="monochrome")
    path.write_bytes(b"P2 45 31 255 0 0")
    with pytest.raises(FrameError, match=r"f\.pgm is no binary grey picture \(P5\)"):
        read_frame(path, kind="monochrome")


@pytest.mark.parametrize("columns", [44, 45])
def test_grey_and_coloured_bmp(tmp_path: Path, columns: int) -> None:
    grey, path = (GREY[:, :columns] % 256).astype(np.uint8), tmp_path / "f.bmp"
    assert cv2.imwrite(str(path), grey)
    frame = read_frame(path, kind="monochrome")
    np.testing.assert_array_equal(frame.values[0], grey)
    assert frame.white_level == 255
    content = bytearray(path.read_bytes())
    top_down = content[:22] + struct.pack("<i", -31) + content[26:]
    path.write_bytes(top_down)
    np.testing.assert_array_equal(read_frame(path, kind="monochrome").values[0], grey[::-1])
    content[54 + 4 * 7] = 200  # the table's entry of 7
    path.write_bytes(content)
    with pytest.raises(FrameError, match=r"f\.bmp shows its grey levels through a colour table"):
        read_frame(path, kind="monochrome")
    path.write_bytes(top_down[:-1])
    with pytest.raises(FrameError, match=r"f\.bmp is damaged or truncated"):
        read_frame(path, kind="monochrome")
    assert cv2.imwrite(str(path), (RGB[:, :columns] % 256).astype(np.uint8)[..., ::-1])
    np.testing.assert_array_equal(read_frame(path, kind="rgb").values, np.moveaxis(RGB[:, :columns] % 256, -1, 0))
    assert cv2.imwrite(str(path), np.repeat(grey[..., None], 3, axis=2))
    np.testing.assert_array_equal(read_frame(path, kind="monochrome").values[0], grey)


def test_levels_must_fit_the_samples(tmp_path: Path) -> None:
    file = _png(tmp_path / "f.png", (GREY % 256).astype(np.uint8))
    with pytest.raises(FrameError, match=r"4095.*f\.png.* 255"):
        read_frame(file, cfa="RGGB", white_level=4095)
    with pytest.raises(FrameError, match=r"f\.png: .*300"):
        read_frame(file, cfa="RGGB", black_level=300)
    with pytest.raises(FrameError, match=r"dtype is stated as uint16, but .*uint8"):
        read_frame(file, cfa="RGGB", dtype="uint16")
    with pytest.raises(FrameError, match=r"shape is stated as \(1, 2\), but .*\(31, 45\)"):
        read_frame(file, cfa="RGGB", shape=(1, 2))


@pytest.mark.parametrize(("dtype", "stored"), [("uint8", "u1"), ("uint16", "<u2"), (">u2", ">u2")])
def test_headerless(tmp_path: Path, dtype: Any, stored: str) -> None:
    values = GREY % 256
    for name in ("f.raw", "f.bin"):
        values.astype(stored).tofile(tmp_path / name)
        frame = read_frame(tmp_path / name, cfa="BGGR", shape=GREY.shape, dtype=dtype)
        np.testing.assert_array_equal(frame.values, values)
        with pytest.raises(FrameError, match=r"bytes; 30 rows of 45"):
            read_frame(tmp_path / name, cfa="BGGR", shape=(30, 45), dtype=dtype)
    RGB.astype("<u2").tofile(tmp_path / "rgb.bin")
    three = read_frame(tmp_path / "rgb.bin", kind="rgb", shape=GREY.shape, dtype="uint16")
    np.testing.assert_array_equal(three.values, np.moveaxis(RGB, -1, 0))
    with pytest.raises(FrameError, match=r"f\.bin has no header"):
        read_frame(tmp_path / "f.bin", cfa="BGGR", shape=GREY.shape)


def test_missing_empty_and_foreign_files(tmp_path: Path) -> None:
    (tmp_path / "empty.tif").touch()
    (tmp_path / "text.txt").write_text("no frame")
    (tmp_path / "text.tif").write_text("no frame")
    (tmp_path / "text.png").write_text("no frame")
    for name, reason in {
        "nothing.tif": "not found",
        "empty.tif": "empty",
        "text.txt": "camera raws",
        "text.tif": "not a TIFF",
        "text.png": "no PNG header",
        ".": "folder",
    }.items():
        with pytest.raises(FrameError, match=reason):
            read_frame(tmp_path / name, cfa="RGGB")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("whole")
    tifffile.imwrite(folder / "plain.tif", GREY)
    tifffile.imwrite(folder / "zip.tif", GREY, compression="zlib", rowsperstrip=4)
    _png(folder / "lzw.tif", GREY)
    _png(folder / "grey.png", GREY)
    return {file.name: file for file in folder.iterdir()}


def test_a_jpeg_in_a_tiff_that_libjpeg_fills_up_is_refused(tmp_path: Path) -> None:
    path, values = tmp_path / "f.tif", np.random.default_rng(0).integers(0, 200, (64, 96)).astype(np.uint8)
    assert cv2.imwrite(str(path), values, [cv2.IMWRITE_TIFF_COMPRESSION, 7])
    assert read_frame(path, kind="monochrome").values.shape == (1, 64, 96)
    with tifffile.TiffFile(path) as tiff:
        start, length = tiff.pages.first.dataoffsets[0], tiff.pages.first.databytecounts[0]
    content = bytearray(path.read_bytes())
    content[start + length // 2 : start + length - 2] = bytes(length - 2 - length // 2)
    path.write_bytes(content)
    with pytest.raises(FrameError, match=r"f\.tif is damaged .*Corrupt JPEG data"):
        read_frame(path, kind="monochrome")


@pytest.mark.parametrize("name", ["plain.tif", "zip.tif", "lzw.tif", "grey.png"])
@given(share=st.floats(0, 1, exclude_max=True))
@settings(max_examples=40)
def test_a_truncated_file_is_refused_or_read_whole(whole: dict[str, Path], name: str, share: float) -> None:
    content = whole[name].read_bytes()
    cut = whole[name].with_name(f"cut_{name}")
    cut.write_bytes(content[: int(share * len(content))])
    try:
        values = read_frame(cut, kind="monochrome").values[0]
    except FrameError:
        return
    np.testing.assert_array_equal(values, GREY)


@given(position=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
@settings(max_examples=40)
def test_a_changed_byte_in_a_png_is_noticed(whole: dict[str, Path], position: float, flip: int) -> None:
    content = bytearray(whole["grey.png"].read_bytes())
    content[int(position * len(content))] ^= flip
    bad = whole["grey.png"].with_name("bad.png")
    bad.write_bytes(content)
    with pytest.raises(FrameError, match=r"bad\.png"):
        read_frame(bad, kind="monochrome")


NIKON = {
    "DSC_1339_768x512_rggb.raw": ((512, 768), [2140.4, 1739.5, 1740.2, 1152.6], (616, 16383)),
    "DSC_1339_256x192_rggb.raw": ((192, 256), [3387.65, 1632.37, 1617.38, 1246.18], (654, 16383)),
}
"""Shape, means of the four places of a cell, extremes of the whole file and of the crop."""


def test_a_headerless_mosaic(real_data: RealData) -> None:
    (file,) = real_data("mosaic16_nikon").glob("*.raw")
    shape, places, extremes = NIKON[file.name]
    nikon = read_frame(file, cfa="RGGB", shape=shape, dtype="uint16")
    means = [nikon.values[row::2, column::2].mean() for row in (0, 1) for column in (0, 1)]
    assert means == pytest.approx(places, abs=0.05)
    assert (nikon.values.min(), nikon.values.max()) == extremes


@pytest.mark.parametrize(
    ("folder", "count", "least"),
    [
        ("dic_rigid_shift", 5, (224, 224)),
        ("dic_challenge_sample12", 3, (764, 265)),
        ("dic_challenge_sample14", 3, (200, 2048)),
        ("dic_challenge2_wave", 2, (180, 1000)),
        ("dic_real_tension_mudic", 3, (700, 240)),
    ],
)
def test_real_dic_images_agree_with_opencv(
    real_data: RealData, folder: str, count: int, least: tuple[int, int]
) -> None:
    files = list(real_data(folder).glob("*.tif*"))
    assert len(files) >= count
    for file in files:
        frame = read_frame(file, kind="monochrome")
        expected = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert (np.array(expected.shape) >= least).all()
        np.testing.assert_array_equal(frame.values, expected[None])


def test_a_list_of_images_that_leads_back_to_itself_is_noticed(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "f.tif", np.stack([GREY, GREY]), photometric="minisblack", metadata=None)
    content = bytearray((tmp_path / "f.tif").read_bytes())
    with tifffile.TiffFile(tmp_path / "f.tif") as tiff:
        first, second = (page.aspage() for page in tiff.pages)
        next_offset = second.offset + 2 + 12 * len(second.tags)
    content[next_offset : next_offset + 4] = first.offset.to_bytes(4, "little")
    (tmp_path / "f.tif").write_bytes(content)
    with pytest.raises(FrameError, match="leads back"):
        read_frame(tmp_path / "f.tif", kind="monochrome")


def test_every_ending_belongs_to_one_format() -> None:
    endings = [ending for known in frame_formats() for ending in (*known.endings, *known.movies) if ending != ".raw"]
    assert len(set(endings)) == len(endings)


def test_a_source_is_opened_before_its_file_exists_and_has_one_frame(tmp_path: Path) -> None:
    source = open_source(tmp_path / "f.tif", FrameSettings(path=("frame",), kind="monochrome"))
    with pytest.raises(FrameError, match="not found"):
        _ = source.shape
    tifffile.imwrite(tmp_path / "f.tif", GREY)
    np.testing.assert_array_equal(source.read(0).values[0], GREY)
    assert (len(source), source.name(0)) == (1, "f.tif")
    for index in (-1, 1):
        with pytest.raises(IndexError, match=r"f\.tif"):
            source.read(index)


def test_levels_that_contradict_each_other_are_no_fault_of_the_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^white_level must be above black_level 64"):
        read_frame(tmp_path / "f.tif", black_level=64, white_level=10)


MOVIES = ("mp4", "avi", "MOV", "mkv", "wmv")


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        *((f"f.{ending}", "demosaiced, so .* no longer the sensor's: give the camera's own file") for ending in MOVIES),
        ("f.jpg", "no raw frame: let the camera record DNG"),
        ("f.RAW", "header: state its `shape` and `dtype` .*frames.shape and frames.dtype"),
    ],
)
def test_a_file_that_is_not_read_says_what_to_do(tmp_path: Path, name: str, advice: str) -> None:
    (tmp_path / name).write_bytes(bytes(100))
    with pytest.raises(FrameError, match=advice):
        read_frame(tmp_path / name)


def _one_strip(path: Path, shape: tuple[int, int], data: bytes, compression: int) -> Path:
    """A TIFF of 8 bit whose header may say anything."""
    tags = {256: shape[1], 257: shape[0], 258: 8, 259: compression, 262: 1, 273: 8, 277: 1, 278: shape[0]}
    entries = b"".join(struct.pack("<HHII", code, 4, 1, value) for code, value in {**tags, 279: len(data)}.items())
    path.write_bytes(struct.pack("<4sI", b"II*\0", 8 + len(data)) + data + struct.pack("<H", 9) + entries + bytes(4))
    return path


def _png_of_zeros(path: Path, side: int) -> Path:
    packer, lines = zlib.compressobj(9), bytes(side + 1)
    data = b"".join(packer.compress(lines) for _ in range(side)) + packer.flush()
    head = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", data), (b"IEND", b""))
    packed = (
        struct.pack(">I", len(part)) + name + part + struct.pack(">I", zlib.crc32(name + part)) for name, part in parts
    )
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(packed))
    return path


def test_a_small_file_never_unpacks_to_a_huge_frame(tmp_path: Path) -> None:
    side, small = 12_000, 3_000
    packer = zlib.compressobj(9)
    zeros = b"".join(packer.compress(bytes(10**6)) for _ in range(side**2 // 10**6)) + packer.flush()
    bombs = {
        "no frame of a camera": _one_strip(tmp_path / "deflate.tif", (side, side), zeros, 8),
        "unpacks to more than": _one_strip(tmp_path / "strip.tif", (small, small), zeros, 8),
        r"allowed are 2147 MB": _one_strip(tmp_path / "header.tif", (60_000, 60_000), zeros, 8),
        "0.14 MB: no frame": _png_of_zeros(tmp_path / "zeros.png", side),
    }
    for reason, path in bombs.items():
        tracemalloc.start()
        with pytest.raises(FrameError, match=reason):
            read_frame(path, kind="monochrome")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 100e6, f"{path.name} took {peak / 1e6:.0f} MB"


@pytest.mark.parametrize("strips", [1, 4])
def test_data_for_fewer_rows_than_the_header_says_are_no_frame(tmp_path: Path, strips: int) -> None:
    rows = -(-31 // strips)
    tifffile.imwrite(tmp_path / "f.tif", GREY, compression="zlib", rowsperstrip=rows)
    with tifffile.TiffFile(tmp_path / "f.tif", mode="r+") as tiff:
        tiff.pages.first.tags[257].overwrite(31 + rows)
    with pytest.raises(FrameError, match="too few for its size"):
        read_frame(tmp_path / "f.tif", kind="monochrome")


def test_a_header_without_samples_is_refused_in_whole_and_in_part(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "f.tif", GREY, photometric="minisblack")
    with tifffile.TiffFile(tmp_path / "f.tif", mode="r+") as tiff:
        tiff.pages.first.tags["SamplesPerPixel"].overwrite(0)
    source = open_source(tmp_path / "f.tif", FrameSettings(path=("f.tif",), kind="monochrome"))
    for window in (None, Window(origin=(0, 0), shape=(4, 4), frame=GREY.shape)):
        with pytest.raises(FrameError, match=r"f\.tif is damaged .* 31 rows of 45 pixels with 0 samples"):
            source.read(0, window)


def test_what_a_damaged_file_puts_into_a_message_keeps_it_one_line(tmp_path: Path) -> None:
    path = _png(tmp_path / "f.png", GREY)
    path.write_bytes(path.read_bytes().replace(b"IDAT", b"I\n\x1bT"))
    with pytest.raises(FrameError) as raised:
        read_frame(path, kind="monochrome")
    assert str(raised.value) == rf"{path} is damaged or truncated: the checksum of its I\n\x1bT part is wrong"


def test_an_empty_frame_of_usual_size_is_read(tmp_path: Path) -> None:
    values = np.zeros((4000, 4000), dtype=np.uint16)
    tifffile.imwrite(tmp_path / "f.tif", values, compression="zlib")
    assert not read_frame(tmp_path / "f.tif", kind="monochrome").values.any()


def test_packbits_is_read_whole_or_refused(tmp_path: Path) -> None:
    runs = b"".join(bytes([257 - 45, level]) for level in range(31))
    values = read_frame(_one_strip(tmp_path / "f.tif", (31, 45), runs, 32773), kind="monochrome").values[0]
    np.testing.assert_array_equal(values, np.repeat(np.arange(31)[:, None], 45, axis=1))
    with pytest.raises(FrameError, match=r"damaged.*PackBits"):
        read_frame(_one_strip(tmp_path / "f.tif", (31, 45), runs[:-8], 32773), kind="monochrome")


def test_what_opencv_would_turn_round_is_refused(tmp_path: Path) -> None:
    """OpenCV inverts compressed min-is-white samples of 8 bit, and those of 16 bit not."""
    path = _png(tmp_path / "f.tif", (GREY % 256).astype(np.uint8))
    with tifffile.TiffFile(path, mode="r+") as tiff:
        tiff.pages.first.tags[262].overwrite(0)
    with pytest.raises(FrameError, match=r"not read \(LZW\); save it as a plain uncompressed TIFF"):
        read_frame(path, kind="monochrome")
    with pytest.raises(FrameError, match=r"not read \(.*\); save it as"):
        read_frame(_one_strip(path, (31, 45), bytes(100), 50000), kind="monochrome")


class _Level(FrameSource):
    """A format of another package: a frame of one grey level, the number in the file."""

    def _shape(self) -> tuple[int, int]:
        return 24, 30

    def _stored(self, index: int) -> StoredFrame:
        return StoredFrame(values=np.full((24, 30), int(self.path.read_text()), dtype=np.uint16))


level = FrameFormat(
    name="level files", endings=(".level",), recognises=lambda path, _: path.suffix == ".level", source=_Level
)


NO_FORMAT = ()


def test_formats_of_other_packages_join_by_an_entry_point(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    points = [
        EntryPoint(name=name, value=f"{__name__}:{what}", group=formats.ENTRY_POINTS)
        for name, what in (("level", "level"), ("gone", "not_there"), ("other", "NO_FORMAT"))
    ]
    monkeypatch.setattr(formats, "entry_points", lambda group: [one for one in points if one.group == group])
    formats._added_formats.cache_clear()
    try:
        for number in (7, 8):
            (tmp_path / f"{number}.level").write_text(str(number))
        series = open_series(FrameSettings(path=(str(tmp_path),), kind="monochrome"))
        assert [int(series.read(index)[0].values[0, 0, 0]) for index in (0, 1)] == [7, 8]
        assert execute(cli.app, ["frames", "--formats"]) == 0
        listed = capsys.readouterr().out.splitlines()
        assert listed[-1] == "level files: .level"
        assert len(listed) == len(frame_formats())
        warnings = [record.message for record in caplog.records]
        assert len(warnings) == 2
        assert "gone" in warnings[0]
        assert "not_there" in warnings[0]
        assert "it is a tuple, not a rgbmidic.frames.FrameFormat" in warnings[1]
    finally:
        formats._added_formats.cache_clear()
