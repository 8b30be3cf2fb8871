"""Files of one picture: PNG, TIFF and headerless samples in, plain 16-bit TIFF and raw Bayer DNG out.

PNG is decoded by OpenCV, with every checksum verified. The DNG tags follow the Adobe DNG specification 1.4, chapter 4;
LibRaw reads the frames back bit by bit.
TIFF images are grey or RGB, 8 or 16 bit; the reading of a page serves files of several, too.

Camera raw files (DNG, NEF, CR2, ARW, ...) through LibRaw.
"""

from __future__ import annotations

import logging
import lzma
import math
import os
import re
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import FrameError, InputError
from rgbmidic.frames.data import ChannelFrame, Mosaic, cfa_channels
from rgbmidic.frames.source import FrameSource
from rgbmidic.frames.stored import CHECKED_FROM, StoredFrame, check_size, complaints, damaged
from rgbmidic.frames.tiff_pages import (
    UNCOMPRESSED,
    RawStructure,
    cfa_pattern,
    is_stored_as_is,
    missing_data,
    tag,
    tiff_pages,
)
from rgbmidic.settings import BAYER_PATTERNS, FrameSettings, regular
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    import rawpy
    from tifffile import TiffPage

logger = logging.getLogger(__name__)

_PLACE = re.compile(r"^\[ERROR\S*\] global \S+ \S+ ")
"""Where in OpenCV a line of its log comes from."""


def decode(content: bytes, path: Path) -> AnyArray:
    """Decode a picture with OpenCV.

    Parameters
    ----------
    content
        The file's bytes.
    path
        The file, for messages.

    Returns
    -------
    ndarray, shape (H, W) or (H, W, C)
        Samples as stored; three channels in the order R, G, B.

    Raises
    ------
    FrameError
        OpenCV cannot decode them.
    """
    import cv2

    # OpenCV 4 has it at its top, OpenCV 5 in a module
    set_log_level = cv2.setLogLevel if hasattr(cv2, "setLogLevel") else cv2.utils.logging.setLogLevel
    previous = set_log_level(2)  # LOG_LEVEL_ERROR
    try:
        with complaints(b"libpng error", b"libpng warning", b"[ERROR", b"> ") as lines:
            # OpenCV opens no non-ASCII names on Windows, hence decoding from memory
            image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    finally:
        set_log_level(previous)
    errors = [line for line in lines if not line.startswith("libpng warning")]  # of parts that are not used
    if image is None or errors:  # libtiff's errors do not always keep OpenCV from giving a picture
        raise damaged(path, _PLACE.sub("", errors[0]) if errors else "its image data cannot be decoded")
    return image[..., ::-1] if image.ndim == 3 and image.shape[2] == 3 else image


_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3}
"""Channels of the colour types that are read: grey and RGB."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PngFile(FrameSource):
    """A PNG file; every chunk's checksum is verified."""

    def _shape(self) -> tuple[int, int]:
        with self.path.open("rb") as file:
            head = file.read(33)
        if len(head) < 33 or head[:8] != _SIGNATURE or head[12:16] != b"IHDR":
            raise damaged(self.path, "it has no PNG header")
        columns, rows, bits, colour = struct.unpack(">IIBB", head[16:26])
        if bits not in (8, 16) or colour not in _CHANNELS:
            raise FrameError(
                f"{self.path} is not a plain image; allowed are grey or RGB PNGs of 8 or 16 bit without alpha"
            )
        needed = rows * columns * _CHANNELS[colour] * bits // 8
        check_size(self.path, needed=needed, stored=self.path.stat().st_size)
        return rows, columns

    def _stored(self, index: int) -> StoredFrame:
        self._shape()
        content = self.path.read_bytes()
        _check_chunks(content, self.path)
        return StoredFrame.plain(decode(content, self.path), self.path)


def _check_chunks(content: bytes, path: Path) -> None:
    """Refuse a file with a wrong checksum up to IEND, or that ends before it."""
    start, name, whole = len(_SIGNATURE), b"", memoryview(content)
    while name != b"IEND":
        if start + 12 > len(content):
            raise damaged(path, "it ends before its end mark")
        length, name = struct.unpack(">I4s", whole[start : start + 8])
        end = start + 8 + length
        if end + 4 > len(content):
            raise damaged(path, "it ends before its end mark")
        if zlib.crc32(whole[start + 4 : end]) != int.from_bytes(whole[end : end + 4], "big"):
            raise damaged(path, f"the checksum of its {name.decode(errors='replace')} part is wrong")
        start = end + 4


def is_headerless(path: Path, stated: FrameSettings) -> bool:
    """Return whether a file has no header: .bin, and .raw whose shape is stated, as some cameras' .raw have one."""
    return path.suffix.lower() == ".bin" or (path.suffix.lower() == ".raw" and stated.shape is not None)


@dataclass(frozen=True, slots=True, kw_only=True)
class HeaderlessFile(FrameSource):
    """A file without a header: shape and sample type are stated."""

    def _shape(self) -> tuple[int, int]:
        if self.stated.shape is None or self.stated.dtype is None:
            raise FrameError(f"{self.path} has no header: both its shape (rows, columns) and its dtype must be stated")
        return self.stated.shape

    def _stored(self, index: int) -> StoredFrame:
        return self._rows(index, range(self._shape()[0]))

    def _rows(self, index: int, rows: range) -> StoredFrame:
        shape, dtype = self._shape(), np.dtype("<u2" if self.stated.dtype == "uint16" else self.stated.dtype)
        channels = 3 if self.stated.kind == "rgb" else 1
        needed, size = math.prod(shape) * channels * dtype.itemsize, self.path.stat().st_size
        if size != needed:
            raise FrameError(
                f"{self.path} has {size} bytes; {shape[0]} rows of {shape[1]} {self.stated.dtype} samples with "
                f"{channels} channel(s) need {needed}"
            )
        row = shape[1] * channels
        values = np.fromfile(self.path, dtype=dtype, count=len(rows) * row, offset=rows.start * row * dtype.itemsize)
        return StoredFrame.plain(values.reshape(len(rows), shape[1], channels), self.path)


MINIMUM_DNG_SIZE = 22
"""Rows and columns below which LibRaw refuses a raw image."""

_XYZ_TO_SRGB = (3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570)
_ILLUMINANT_D65 = 21
_PHOTOMETRIC_CFA = 32803


def write_dng(path: Path | str, mosaic: Mosaic, *, white_balance: Sequence[float] | None = None) -> None:
    """Write a raw Bayer frame as an uncompressed DNG.

    Values, pattern, black level of each position of the cell and white level come back from LibRaw exactly as given.
    An existing file is replaced, once the new one is complete.

    Parameters
    ----------
    path
        File to write.
    mosaic
        Frame with at least 22 rows and columns; black and white levels are whole numbers.
    white_balance
        Factors that make a white surface grey, for R, G and B: only viewers use them. None: all 1.

    Raises
    ------
    InputError
        The frame is too small, a level is not a whole number, or a factor is not positive.
    """
    if min(mosaic.values.shape) < MINIMUM_DNG_SIZE:
        raise InputError(
            f"a DNG needs at least {MINIMUM_DNG_SIZE} rows and columns (LibRaw refuses smaller ones), "
            f"not {mosaic.values.shape}: {path}"
        )
    balance = (1.0, 1.0, 1.0) if white_balance is None else white_balance
    tags = [*_cfa_tags(mosaic, path), *_colour_tags(balance)]
    _write(path, mosaic.values, photometric=_PHOTOMETRIC_CFA, extratags=tags, rowsperstrip=mosaic.values.shape[0])


def write_tiff(path: Path | str, frame: Mosaic | ChannelFrame) -> None:
    """Write a frame as an uncompressed 16-bit TIFF: (H, W) for a mosaic or monochrome frame, (H, W, 3) for RGB.

    A TIFF holds neither pattern nor levels: whoever reads it states them. An existing file is replaced, once the
    new one is complete.

    Parameters
    ----------
    path
        File to write.
    frame
        The raw frame.
    """
    if isinstance(frame, ChannelFrame) and len(frame.values) == 3:
        _write(path, np.ascontiguousarray(np.moveaxis(frame.values, 0, -1)), photometric="rgb")
    else:
        _write(path, frame.values.reshape(frame.values.shape[-2:]), photometric="minisblack")


def _write(path: Path | str, values: np.ndarray[Any, np.dtype[np.uint16]], **options: Any) -> None:
    import tifffile

    path = Path(path)
    temporary = path.with_name(path.name + ".part")
    try:
        tifffile.imwrite(temporary, values, metadata=None, byteorder="<", software="rgbmidic", **options)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _cfa_tags(mosaic: Mosaic, path: Path | str) -> list[tuple[Any, ...]]:
    black = [_whole(level, "black", path) for level in mosaic.black_level.ravel()]
    channels = bytes(int(channel) for channel in cfa_channels(mosaic.cfa).ravel())
    return [
        (50706, "B", 4, b"\x01\x04\x00\x00", True),  # DNGVersion
        (50707, "B", 4, b"\x01\x01\x00\x00", True),  # DNGBackwardVersion
        (50708, "s", 0, "rgbmidic", True),  # UniqueCameraModel
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, channels, True),  # CFAPattern
        (50710, "B", 3, b"\x00\x01\x02", True),  # CFAPlaneColor
        (50711, "H", 1, 1, True),  # CFALayout: rectangular
        (50713, "H", 2, (2, 2), True),  # BlackLevelRepeatDim
        (50714, "I", 4, black, True),  # BlackLevel, by position
        (50717, "I", 1, _whole(mosaic.white_level, "white", path), True),  # WhiteLevel
    ]


def _colour_tags(white_balance: Sequence[float]) -> list[tuple[Any, ...]]:
    if len(white_balance) != 3 or not all(np.isfinite(factor) and factor > 0 for factor in white_balance):
        raise InputError(f"white_balance is three positive factors (R, G, B), not {white_balance!r}")
    neutral = [min(white_balance) / factor for factor in white_balance]
    return [
        (50721, "2i", 9, _rationals(_XYZ_TO_SRGB), True),  # ColorMatrix1
        (50728, "2I", 3, _rationals(neutral), True),  # AsShotNeutral
        (50778, "H", 1, _ILLUMINANT_D65, True),  # CalibrationIlluminant1
    ]


def _rationals(numbers: Iterable[float]) -> list[int]:
    fractions = [Fraction(number).limit_denominator(10_000) for number in numbers]
    return [part for fraction in fractions for part in (fraction.numerator, fraction.denominator)]


def _whole(level: float, name: str, path: Path | str) -> int:
    if level != int(level) or level > 65535:
        raise InputError(f"a DNG holds a {name} level that is a whole number up to 65535, not {level}: {path}")
    return int(level)


TIFF_ENDINGS = (".tif", ".tiff")

_BY_TIFFFILE: dict[int, Any] = {8: zlib.decompressobj, 32946: zlib.decompressobj, 34925: lzma.LZMADecompressor}
"""Compressions (deflate, LZMA) that tifffile undoes, without a limit, and what undoes them up to one."""
_BY_OPENCV = (5, 7, 32773)
"""LZW, JPEG, PackBits."""
_MIN_IS_WHITE, _PALETTE = 0, 3
_COLOUR_MAP, _ORIENTATION = 320, 274


@dataclass(frozen=True, slots=True, kw_only=True)
class TiffFile(FrameSource):
    """A TIFF file of one image with 1 or 3 channels; a table of colours is refused."""

    packages = ("tifffile",)

    def _shape(self) -> tuple[int, int]:
        with _only_page(self.path) as page:
            return int(page.imagelength), int(page.imagewidth)

    def _stored(self, index: int) -> StoredFrame:
        with _only_page(self.path) as page:
            samples = _by_opencv(page, self.path) if page.compression in _BY_OPENCV else None
            return page_frame(page, self.path, samples)

    def _rows(self, index: int, rows: range) -> StoredFrame:
        with _only_page(self.path) as page:
            if (samples := page_rows(page, self.path, rows)) is not None:
                return page_frame(page, self.path, samples)
        return FrameSource._rows(self, index, rows)


def page_rows(page: TiffPage, path: Path, rows: range) -> AnyArray | None:
    """Read the samples (n, W, C) of some rows of a checked page; None where it must be unpacked as a whole."""
    in_planes = page.planarconfig == 2 and page.samplesperpixel > 1
    if not is_stored_as_is(page) or not page.is_contiguous or in_planes:
        return None
    shape = len(rows), page.imagewidth, page.samplesperpixel
    dtype = np.dtype(page.dtype)
    start = page.dataoffsets[0] + rows.start * math.prod(shape[1:]) * dtype.itemsize
    stored = dtype.newbyteorder(page.parent.byteorder)
    samples = np.fromfile(path, dtype=stored, count=math.prod(shape), offset=start)
    return samples.astype(dtype, copy=False).reshape(shape)


def page_frame(page: TiffPage, path: Path, samples: AnyArray | None = None) -> StoredFrame:
    """Return the frame of a checked page, from its `samples` where they were read already.

    Raises
    ------
    FrameError
        They are damaged, or stored in a way that is not read.
    """
    values = _samples(page, path) if samples is None else samples
    if page.photometric == _PALETTE:
        table = np.asarray(page.tags[_COLOUR_MAP].value, dtype=np.int64).reshape(3, -1)
        # some cameras' software writes grey images with a table that changes nothing, of 257 i or of 256 i
        if values.dtype != np.uint8 or not (table // 256 == np.arange(table.shape[1])).all():
            raise FrameError(f"{path} shows its grey levels through a colour table; save it as a plain grey image")
    elif page.photometric == _MIN_IS_WHITE:
        values = np.iinfo(values.dtype).max - values
    return StoredFrame.plain(values, path, cfa_pattern(page))


@contextmanager
def _only_page(path: Path) -> Iterator[TiffPage]:
    with tiff_pages(path) as pages:
        if not pages:
            raise damaged(path, "its header leads to no image")
        if len(pages) > 1:
            raise FrameError(f"{path} holds {len(pages)} frames; allowed is one frame per TIFF file")
        checked_page(pages[0], path)
        yield pages[0]


def checked_page(page: TiffPage, path: Path) -> None:
    """Refuse a page whose samples are no raw frame's or not all there, before anything is unpacked.

    Raises
    ------
    FrameError
        So they are.
    """
    if page.dtype is None or page.dtype.name not in ("uint8", "uint16"):
        kind = page.dtype or f"{page.bitspersample}-bit"
        raise FrameError(f"{path} has {kind} samples; allowed are unsigned 8 or 16 bit")
    if not (page.imagelength and page.imagewidth and page.samplesperpixel):  # an entry that is damaged counts as 0
        told = f"{page.imagelength} rows of {page.imagewidth} pixels with {page.samplesperpixel} samples"
        raise damaged(path, f"its header announces {told}")
    size = path.stat().st_size
    if reason := missing_data(page, size):
        raise damaged(path, reason)
    stored = sum(page.databytecounts)
    if page.compression == UNCOMPRESSED and not is_stored_as_is(page):
        raise damaged(path, f"its header announces {stored} bytes of image data, too few for its size")
    check_size(path, needed=page.nbytes, stored=min(stored, size))


def _samples(page: TiffPage, path: Path) -> AnyArray:
    """Read the samples of a page as they are stored, (H, W) or (H, W, C)."""
    if page.compression not in (UNCOMPRESSED, *_BY_TIFFFILE):
        name = getattr(page.compression, "name", page.compression)
        raise FrameError(f"{path} is stored in a way that is not read ({name}); save it as a plain uncompressed TIFF")
    if page.compression in _BY_TIFFFILE:
        _check_unpacked(page, path)
    values = np.asarray(page.asarray())
    one_plane_after_the_other = values.ndim == 3 and page.planarconfig == 2
    return np.moveaxis(values, 0, -1) if one_plane_after_the_other else values


def _by_opencv(page: TiffPage, path: Path) -> AnyArray:
    """Read the samples of the only page of a file."""
    turned = (tag(page, _ORIENTATION) or (1,)) != (1,) or page.photometric in (_MIN_IS_WHITE, _PALETTE)
    if turned:  # OpenCV turns such samples, some more than others
        return _samples(page, path)  # which refuses them
    values = decode(path.read_bytes(), path)
    if (*values.shape[:2], values.dtype) != (page.imagelength, page.imagewidth, page.dtype):
        raise damaged(path, f"its header announces another image than its data hold, {values.shape} {values.dtype}")
    return values


def _check_unpacked(page: TiffPage, path: Path) -> None:
    """Refuse parts that unpack to more than the whole image, and all of them to less: tifffile fills up with zeros."""
    limit, total = max(page.nbytes, CHECKED_FROM), 0
    with path.open("rb") as file:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            file.seek(offset)
            unpacked = len(_BY_TIFFFILE[page.compression]().decompress(file.read(count), limit + 1))
            if unpacked > limit:
                raise damaged(path, f"a part of its image data unpacks to more than {limit} bytes")
            total += unpacked
    if total < page.nbytes:
        raise damaged(path, f"its image data unpack to {total} bytes, too few for its size")


_NAMES = "3fr arw cr2 cr3 dcr dng erf fff iiq kdc mef mos mrw nef nrw orf pef raf rw2 rwl sr2 srf srw x3f"
CAMERA_RAW_ENDINGS = tuple(f".{name}" for name in _NAMES.split())

MAXIMUM_FLAT_ROWS = 0.01
"""Fraction of rows without any noise above which a camera raw counts as not decoded: defective rows may exist."""

_CAMERA_HEADERS = (
    *(b"II*\0", b"MM\0*"),  # TIFF: DNG, NEF, CR2, ARW, PEF, KDC, ...
    *(b"IIU\0", b"IIRO", b"IIRS", b"MMOR"),  # Panasonic, Olympus
    *(b"II\x1a\0", b"IIII", b"MMMM"),  # Canon CRW, Phase One
    *(b"\0MRM", b"FUJIFILM", b"FOVb"),  # Minolta, Fujifilm, Sigma
)
_CR3_HEADER = b"ftypcrx "
_BROKEN_JPEG = ("Corrupt JPEG data", "Premature end of JPEG file", "Inconsistent progression sequence")
"""How libjpeg's warnings begin (JWRN in its jerror.h) after which it goes on with invented samples."""
_ODD_JPEG = ("Invalid SOS parameters", "Unknown Adobe color transform code", "Warning: unknown JFIF revision")
"""And those of headers that it can read all the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRaw(FrameSource):
    """The visible part of a camera raw: the mosaic of a Bayer camera or the image of a monochrome one.

    Orientation and default crop of the file are not applied: pixels stay where they are on the sensor. Refused are
    files that LibRaw cannot decode, images already demosaiced, and colour filter arrays that are no Bayer pattern.
    """

    packages = ("rawpy",)

    def _shape(self) -> tuple[int, int]:
        with _libraw(self.path) as raw:
            return int(raw.sizes.height), int(raw.sizes.width)

    def _stored(self, index: int) -> StoredFrame:
        structure = RawStructure.read(self.path)
        with _libraw(self.path) as raw:
            cell = _colour_cell(raw, self.path)
            values = np.array(raw.raw_image_visible, dtype=np.uint16)
            black = np.asarray(raw.black_level_per_channel, dtype=np.float64)[cell]
            white, sizes, names = float(raw.white_level), raw.sizes, _names(raw, cell)
            monochrome = raw.num_colors == 1
        if values.shape != (sizes.height, sizes.width):
            raise damaged(self.path, f"its visible part ({sizes.height} x {sizes.width}) reaches beyond its samples")
        if structure and (stated := structure.black_level(sizes.top_margin, sizes.left_margin)) is not None:
            black = stated
        _check_filled(values, black, white, stored_as_is=bool(structure and structure.stored_as_is), path=self.path)
        return StoredFrame(
            values=values,
            kind="monochrome" if monochrome else "bayer",
            cfa=None if monochrome else names,
            black_level=black,
            white_level=white,
        )


@contextmanager
def _libraw(path: Path) -> Iterator[rawpy.RawPy]:
    """Open the file by LibRaw; what LibRaw raises while it is open becomes a FrameError, what it prints a warning.

    Where libjpeg, which unpacks some, reports that the data are broken, that is a FrameError, too.
    """
    import rawpy

    try:
        starts = (os.fsencode(path), *(start.encode() for start in _BROKEN_JPEG + _ODD_JPEG))
        with complaints(*starts) as lines, rawpy.imread(str(path)) as raw:
            needed = 2 * raw.sizes.raw_height * raw.sizes.raw_width
            check_size(path, needed=needed, stored=path.stat().st_size)
            yield raw
    except rawpy.LibRawFileUnsupportedError:
        raise FrameError(f"{path} is a camera raw that LibRaw does not know") from None
    except NotImplementedError:  # rawpy's answer to filters that repeat neither after 2x2 nor after 6x6 pixels
        raise _not_bayer(path, "that is no mosaic of 2x2 pixels") from None
    except rawpy.LibRawError as error:
        reason = error.args[0] if error.args else type(error).__name__
        reason = reason.decode(errors="replace") if isinstance(reason, bytes) else reason
        raise damaged(path, f"LibRaw reports: {reason}") from None
    for line in lines:
        if line.startswith(_BROKEN_JPEG):
            raise damaged(path, f"libjpeg reports: {line}")
        logger.warning("LibRaw reports: %s", line)


def has_camera_header(path: Path) -> bool:
    """Return whether the file starts as camera raws do.

    LibRaw takes a file without a header for some camera's by its length alone, and so gives a wrong picture.
    """
    try:
        with regular(path).open("rb") as file:
            head = file.read(12)
    except OSError:  # reported by whoever reads the file
        return False
    return head.startswith(_CAMERA_HEADERS) or head[4:] == _CR3_HEADER


def _not_bayer(path: Path, what: str) -> FrameError:
    allowed = ", ".join(BAYER_PATTERNS)
    return FrameError(f"{path} has a colour filter array {what}; allowed are the Bayer patterns {allowed}")


def _colour_cell(raw: rawpy.RawPy, path: Path) -> AnyArray:
    """Return the colour numbers of the first visible 2x2 cell; only sensors of one plane, Bayer or mono, have one."""
    pattern = raw.raw_pattern
    if raw.raw_type.name != "Flat" or pattern is None:
        raise FrameError(
            f"{path} holds an image that is already demosaiced (linear raw); needed is the mosaic as the sensor "
            "recorded it"
        )
    if raw.num_colors == 1:
        return np.zeros((2, 2), dtype=np.intp)
    top, left = raw.sizes.top_margin, raw.sizes.left_margin  # `raw_colors_visible` would fill the whole frame
    cell = np.array([[raw.raw_color(top + row, left + column) for column in (0, 1)] for row in (0, 1)])
    if pattern.shape != (2, 2) or _names(raw, cell) not in BAYER_PATTERNS:
        rows, columns = pattern.shape
        raise _not_bayer(path, f"of {rows}x{columns} pixels with the colours {_names(raw, pattern)}")
    return cell


def _names(raw: rawpy.RawPy, colours: AnyArray) -> str:
    return "".join(raw.color_desc.decode()[colour] for colour in colours.ravel())


def _check_filled(
    values: npt.NDArray[np.uint16], black: FloatArray, white: float, *, stored_as_is: bool, path: Path
) -> None:
    """Refuse a mosaic that LibRaw filled with zeros because the file's data ended.

    A row of a real sensor has noise, even in the dark: rows of one single value are not measured unless they are
    saturated. Where the samples are stored uncompressed and the file is complete, such rows may be real (a computed
    frame), except zeros below a positive black level, which no sensor gives.
    """
    lowest, highest = values.min(axis=1), values.max(axis=1)
    flat = (lowest == highest) & (highest < white)
    if stored_as_is:
        flat &= (highest == 0) & (black.min() > 0)
    fraction = float(flat.mean())
    if flat[-1] or fraction > MAXIMUM_FLAT_ROWS:
        raise damaged(path, f"{fraction:.1%} of its rows are empty (one single value, {highest[flat][-1]} in the last)")
