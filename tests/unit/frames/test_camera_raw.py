"""Camera raws: margins, black levels by position, and files that LibRaw opens although they hold no frame."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import rawpy
import tifffile
from frames import colour_mosaic, noisy_mosaic, write_cropped_dng, write_lossless_dng, write_monochrome_dng
from hypothesis import given, settings
from hypothesis import strategies as st
from real_files import CROPS, RealData

from rgbmidic.errors import FrameError
from rgbmidic.frames import camera_raw, open_series, open_source, read_frame
from rgbmidic.frames.data import ChannelFrame, Mosaic, cfa_channels
from rgbmidic.frames.images import write_dng
from rgbmidic.settings import BAYER_PATTERNS, FrameSettings

STATED = FrameSettings(path=("frame",))


@pytest.fixture(scope="module")
def dng(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("raw") / "whole.dng"
    write_dng(path, noisy_mosaic())
    return path


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
@pytest.mark.parametrize("margin", [(0, 0), (1, 0), (0, 1), (1, 1), (2, 3), (4, 2)])
def test_pattern_and_black_levels_follow_odd_margins(tmp_path: Path, cfa: str, margin: tuple[int, int]) -> None:
    path = tmp_path / "cropped.dng"
    black = np.array([[60, 61], [62, 63]])
    write_cropped_dng(path, colour_mosaic((39, 41), cfa), top=margin[0], left=margin[1], cfa=cfa, black=black)
    frame = read_frame(path)
    assert isinstance(frame, Mosaic)
    cell = frame.values[:2, :2]
    np.testing.assert_array_equal(cell // 1000 - 1, cfa_channels(frame.cfa))
    np.testing.assert_array_equal(cell % 1000 + 60, frame.black_level)
    assert frame.values.min() >= 1000, "a masked margin is in the frame"
    assert open_source(path, STATED).shape == frame.values.shape


@pytest.mark.parametrize("margin", [(0, 0), (1, 2), (3, 1)])
def test_black_levels_that_vary_are_averaged_by_position_with_a_word(tmp_path: Path, margin: tuple[int, int]) -> None:
    top, left, shape = *margin, (40, 44)
    by_row, by_column = np.arange(40) % 2 * 4.0 + np.arange(40) / 4, np.arange(44) % 2 * -2.0
    rows, columns = ([int(part) for one in line for part in (round(4 * one), 4)] for line in (by_row, by_column))
    added = [(50715, "2i", 44, columns, True), (50716, "2i", 40, rows, True)]
    cell = [(50713, "H", 2, (1, 4), True), (50714, "I", 4, (60, 61, 62, 63), True)]
    path = tmp_path / "varies.dng"
    for extra, exact in (
        (added, 64 + by_row[:, None] + by_column),
        (cell, np.tile([60, 61, 62, 63], (40, 11))),
        ([*added, *cell], by_row[:, None] + by_column + np.tile([60, 61, 62, 63], (40, 11))),
    ):
        write_cropped_dng(path, noisy_mosaic(shape).values, top=top, left=left, cfa="RGGB", black=64, extra=extra)
        frame = read_frame(path)
        expected = [[exact[row::2, column::2].mean() for column in (0, 1)] for row in (0, 1)]
        # LibRaw moves an odd margin to the next row or column
        np.testing.assert_allclose(frame.black_level, np.roll(expected, (-top, -left), axis=(0, 1)), atol=1e-9)
        (remark,) = open_series(FrameSettings(path=(str(path),))).remarks
        spread = max(np.ptp(exact[row::2, column::2]) for column in (0, 1) for row in (0, 1))
        assert remark.startswith("varies.dng: its black level varies")
        assert f"by {spread:.3g} DN" in remark
    write_cropped_dng(path, noisy_mosaic(shape).values, top=top, left=left, cfa="RGGB", black=64)
    assert open_series(FrameSettings(path=(str(path),))).remarks == ()


def test_monochrome_camera_raw_is_one_channel(tmp_path: Path) -> None:
    values = noisy_mosaic().values
    write_monochrome_dng(tmp_path / "mono.dng", values)
    frame = read_frame(tmp_path / "mono.dng", kind="monochrome")
    assert isinstance(frame, ChannelFrame)
    np.testing.assert_array_equal(frame.values, values[None])
    assert (frame.black_level.tolist(), frame.white_level) == ([64.0], 4095.0)
    with pytest.raises(FrameError, match=r"bayer.*mono\.dng.*monochrome"):
        read_frame(tmp_path / "mono.dng", kind="bayer")


def test_demosaiced_raw_is_refused(tmp_path: Path) -> None:
    write_monochrome_dng(tmp_path / "linear.dng", noisy_mosaic().values, linear_rgb=True)
    with pytest.raises(FrameError, match=r"linear\.dng.*already demosaiced"):
        read_frame(tmp_path / "linear.dng")


def test_every_file_that_must_be_rejected_is(real_data: RealData) -> None:
    files = [file for file in real_data("raw_must_reject").iterdir() if file.suffix != ".txt"]
    assert files
    for file in files:
        with pytest.raises(FrameError, match=r"demosaiced|damaged"):
            read_frame(file)


def test_colour_chart(real_data: RealData) -> None:
    folder = real_data("raw_colorchart_dng")
    frame = read_frame(folder / "colorchart.dng")
    shape, brightest = ((128, 488), 5415) if folder.parent == CROPS else ((1156, 1734), 12128)
    assert isinstance(frame, Mosaic)
    assert (frame.values.shape, frame.cfa, frame.white_level) == (shape, "RGGB", 15000)
    assert frame.black_level.tolist() == [[2056, 2056], [2056, 2056]]
    assert frame.values.max() == brightest


def test_kodak_with_a_non_ascii_name(real_data: RealData) -> None:
    (file,) = real_data("raw_kodak_kdc").glob("*.KDC")
    frame = read_frame(file)
    assert isinstance(frame, Mosaic)
    assert (frame.values.shape, frame.cfa, frame.white_level) == ((512, 768), "GRBG", 16383)
    assert (frame.black_level == 0).all()
    assert (frame.values.min(), frame.values.max()) == (23, 16383)


@given(share=st.floats(0, 1, exclude_max=True))
@settings(max_examples=60)
def test_truncated_dng_is_refused_at_any_length(dng: Path, share: float) -> None:
    content = dng.read_bytes()
    path = dng.with_name("cut.dng")
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(FrameError, match=r"cut\.dng"):
        read_frame(path)


@pytest.mark.parametrize("folder", ["raw_colorchart_dng", "raw_kodak_kdc"])
def test_truncated_real_raws_are_refused(tmp_path: Path, real_data: RealData, folder: str) -> None:
    (file,) = (file for file in real_data(folder).iterdir() if file.suffix != ".txt")
    content, cut = file.read_bytes(), tmp_path / f"cut{file.suffix}"
    for kept, zeros in itertools.product((0.1, 0.5, 0.9, 0.99), (False, True)):
        length = int(kept * len(content))
        cut.write_bytes(content[:length] + bytes(len(content) - length if zeros else 0))
        with pytest.raises(FrameError, match="damaged"):
            read_frame(cut)


def test_an_active_area_beyond_the_samples_is_told(tmp_path: Path) -> None:
    write_cropped_dng(tmp_path / "f.dng", colour_mosaic((39, 41), "RGGB"), top=2, left=3, cfa="RGGB", black=60)
    with tifffile.TiffFile(tmp_path / "f.dng", mode="r+") as tiff:
        tiff.pages.first.tags[50829].overwrite((2, 30, 41, 75))
    with pytest.raises(FrameError, match=r"visible part \(39 x 45\) reaches beyond its samples"):
        read_frame(tmp_path / "f.dng")


@pytest.mark.parametrize("header", [b"II\x1a\0", b"IIRO", b"IIRS", b"IIU\0"], ids=str)
def test_raws_that_begin_like_tiff_but_are_none_are_left_to_libraw(tmp_path: Path, dng: Path, header: bytes) -> None:
    """Headers of Canon CRW, Olympus and Panasonic; LibRaw follows the directory of a DNG behind any of them."""
    path = tmp_path / "f.raw"
    path.write_bytes(header + dng.read_bytes()[4:])
    np.testing.assert_array_equal(read_frame(path).values, read_frame(dng).values)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(FrameError, match="damaged"):
        read_frame(path)


def test_a_canon_crw_is_what_libraw_makes_of_it(tmp_path: Path, dng: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "CRW_0001.CRW"
    path.write_bytes(b"II\x1a\0\0\0HEAPCCDR\2\0\1\0" + bytes(1000))
    with pytest.raises(FrameError, match=r"CRW_0001\.CRW"):
        read_frame(path)
    opened, imread = [], rawpy.imread
    monkeypatch.setattr(rawpy, "imread", lambda name: opened.append(name) or imread(str(dng)))
    np.testing.assert_array_equal(read_frame(path).values, read_frame(dng).values)
    assert opened[0] == str(path)


def test_a_skeleton_that_only_libraw_can_follow_is_left_to_it(
    dng: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise ValueError("unknown kind of tag")

    whole = read_frame(dng)
    monkeypatch.setattr(tifffile, "TiffFile", fails)
    np.testing.assert_array_equal(read_frame(dng).values, whole.values)


def test_what_libraw_prints_comes_as_one_warning(
    dng: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    imread = rawpy.imread

    def talks(name: str) -> rawpy.RawPy:
        os.write(2, f"{name}: data corrupted at 1378\nprogress of another thread\n".encode())
        return imread(name)

    monkeypatch.setattr(rawpy, "imread", talks)
    read_frame(dng)
    assert [record.getMessage() for record in caplog.records] == [f"LibRaw reports: {dng}: data corrupted at 1378"]
    assert capfd.readouterr().err == "progress of another thread\n"


def test_what_libjpeg_prints_makes_a_raw_damaged(
    dng: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    imread = rawpy.imread

    def talks(name: str) -> rawpy.RawPy:
        os.write(2, b"Corrupt JPEG data: bad Huffman code\n")
        return imread(name)

    monkeypatch.setattr(rawpy, "imread", talks)
    with pytest.raises(
        FrameError, match=r"whole\.dng is damaged .*: libjpeg reports: Corrupt JPEG data: bad Huffman code"
    ):
        read_frame(dng)
    assert capfd.readouterr().err == ""


def test_a_damaged_jpeg_in_a_raw_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_monochrome_dng(tmp_path / "lossy.dng", noisy_mosaic((64, 64)).values, linear_rgb=True)
    jpeg = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8))[1].tobytes()
    with tifffile.TiffFile(tmp_path / "lossy.dng", mode="r+") as tiff:
        page = tiff.pages.first
        page.tags["Compression"].overwrite(34892)
        page.tags["BitsPerSample"].overwrite((8, 8, 8))
        tiff.filehandle.seek(page.dataoffsets[0])
        tiff.filehandle.write(jpeg[: len(jpeg) // 2] + b"\xff\xd9")  # its end in its middle
    with pytest.raises(FrameError, match="already demosaiced"):
        read_frame(tmp_path / "lossy.dng")
    assert capfd.readouterr().err == ""


def test_a_real_truncated_raw_is_told_in_one_line(real_data: RealData, capfd: pytest.CaptureFixture[str]) -> None:
    name = "exiftool_Nikon_truncated.nef"
    folder = real_data("raw_must_reject", name)
    with pytest.raises(FrameError, match="damaged"):
        read_frame(folder / name)
    assert capfd.readouterr().err == ""


def test_zeros_below_a_positive_black_level_are_no_frame_but_a_computed_dark_frame_is(tmp_path: Path) -> None:
    values = noisy_mosaic().values.copy()
    values[-1] = 0
    write_dng(tmp_path / "hole.dng", Mosaic(values=values, cfa="RGGB", black_level=64, white_level=4095))
    with pytest.raises(FrameError, match="empty"):
        read_frame(tmp_path / "hole.dng")
    for level in (0, 64):
        dark = Mosaic(values=np.full((40, 40), level), cfa="RGGB", black_level=level, white_level=4095)
        write_dng(tmp_path / "dark.dng", dark)
        assert (read_frame(tmp_path / "dark.dng").values == level).all()


def test_saturated_frame_is_a_frame(tmp_path: Path) -> None:
    bright = Mosaic(values=np.full((40, 40), 4095), cfa="RGGB", black_level=64, white_level=4095)
    write_dng(tmp_path / "bright.dng", bright)
    assert (read_frame(tmp_path / "bright.dng").values == 4095).all()


def test_headerless_file_is_not_taken_for_a_camera_raw_by_its_length(tmp_path: Path) -> None:
    # LibRaw alone opens whatever has this length as a 768x1024 frame of 8 bit
    content = np.random.default_rng(0).integers(600, 16384, 512 * 768).astype("<u2").tobytes()
    for name in ("frame.raw", "frame.nef"):
        (tmp_path / name).write_bytes(content)
        assert rawpy.imread(str(tmp_path / name)).raw_image.shape == (768, 1024)
        with pytest.raises(FrameError, match=r"shape\W+ and \W+dtype|shape and dtype"):
            read_frame(tmp_path / name)


def test_what_a_camera_raw_tells_need_not_be_stated_but_must_not_be_contradicted(dng: Path) -> None:
    stated = {"kind": "bayer", "cfa": "rggb", "black_level": 64, "white_level": 4095, "shape": (40, 50)}
    np.testing.assert_array_equal(read_frame(dng, **stated).values, read_frame(dng).values)
    wrong = {"kind": "rgb", "cfa": "GRBG", "black_level": 60, "white_level": 1023, "shape": (50, 40)}
    for name, value in wrong.items():
        with pytest.raises(FrameError, match=rf"{name} is stated as .*whole\.dng states"):
            read_frame(dng, **{**stated, name: value})


def test_dng_with_a_tiff_name_is_read_as_dng(dng: Path) -> None:
    named = dng.with_suffix(".tif")
    named.write_bytes(dng.read_bytes())
    frame = read_frame(named)
    assert isinstance(frame, Mosaic)
    assert (frame.cfa, frame.white_level, frame.black_level.min()) == ("RGGB", 4095, 64)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_damaged_header_never_gives_another_error(dng: Path, seed: int) -> None:
    random = np.random.default_rng(seed)
    content = bytearray(dng.read_bytes())
    for position in random.integers(0, 700, 3):
        content[position] = random.integers(256)
    bad = dng.with_name("bad.dng")
    bad.write_bytes(content)
    try:
        read_frame(bad)
    except FrameError as error:
        message = str(error)
        assert "bad.dng" in message


@pytest.mark.parametrize(("black", "fill"), [(0, 0), (64, 0), (64, 64), (64, 128)])
def test_rows_without_noise_mean_that_nothing_was_decoded(black: int, fill: int) -> None:
    """Compressed raws whose data end early: LibRaw leaves rows of one value (a truncated Panasonic, a Sony)."""
    values = noisy_mosaic((200, 50)).values.copy()
    level = np.full((2, 2), float(black))
    for damage, refused in (
        (slice(0, 0), False),
        (slice(7, 8), False),
        (slice(100, 110), True),
        (slice(198, 200), True),
    ):
        broken = values.copy()
        broken[damage] = fill
        if refused:
            with pytest.raises(FrameError, match="empty"):
                camera_raw._refuse_filled_rows(broken, level, 4095.0, is_uncompressed=False, path=Path("x.rw2"))
        else:
            camera_raw._refuse_filled_rows(broken, level, 4095.0, is_uncompressed=False, path=Path("x.rw2"))


@pytest.mark.parametrize("fills_memory", [True, False], ids=["glibc", "another C library"])
@pytest.mark.parametrize("shape", [(40, 50), (300, 320)], ids=str)
def test_a_raw_that_libraw_does_not_decode_is_refused_whatever_memory_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int], fills_memory: bool
) -> None:
    """A lossless JPEG without its start of scan: LibRaw raises nothing, and its buffer holds the file read before."""
    if not fills_memory:
        monkeypatch.setattr(camera_raw, "_MALLOPT", None)
    whole, bad = tmp_path / "whole.dng", tmp_path / "bad.dng"
    values = noisy_mosaic(shape).values.copy()
    values[:, :7] = 257 * camera_raw._MARKS[0]  # grey levels, too
    write_lossless_dng(whole, Mosaic(values=values, cfa="RGGB", black_level=64, white_level=65535))
    np.testing.assert_array_equal(read_frame(whole).values, values)
    content = bytearray(whole.read_bytes())
    content[content.index(b"\xff\xda")] = 191
    bad.write_bytes(content)
    for _ in range(3):
        read_frame(whole)
        with pytest.raises(FrameError, match=r"bad\.dng is damaged or truncated"):
            read_frame(bad)


def test_a_jpeg_that_announces_more_than_its_tile_is_not_decoded(tmp_path: Path) -> None:
    """LibRaw works for minutes on 65504 rows of 65490 samples, which it makes up."""
    path = tmp_path / "large.dng"
    write_lossless_dng(path, noisy_mosaic((31, 45)))
    content = bytearray(path.read_bytes())
    begin = content.index(b"\xff\xc3") + 5
    content[begin : begin + 4] = b"\xff\xe0\xff\xd2"
    path.write_bytes(content)
    with pytest.raises(FrameError, match=r"large\.dng is damaged .* announce 65504 rows of 65490 x 1 samples"):
        read_frame(path)
