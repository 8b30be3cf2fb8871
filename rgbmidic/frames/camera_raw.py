"""Camera raw files (DNG, NEF, CR2, ARW, ...) through LibRaw."""

from __future__ import annotations

import ctypes
import logging
import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rgbmidic.disk import require_regular_file
from rgbmidic.errors import FrameError, damaged_file
from rgbmidic.frames.metadata import BROKEN_JPEG, StoredFrame, captured_stderr, check_size
from rgbmidic.frames.source import FrameSource
from rgbmidic.frames.tiff_pages import Tag, has_uncompressed_data, missing_data, oversized_jpeg, tag, tiff_pages
from rgbmidic.settings import BAYER_PATTERNS, FrameKind
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    import rawpy
    import tifffile

logger = logging.getLogger(__name__)

_NAMES = "3fr arw cr2 cr3 dcr dng erf fff iiq kdc mef mos mrw nef nrw orf pef raf rw2 rwl sr2 srf srw x3f"
CAMERA_RAW_ENDINGS = tuple(f".{name}" for name in _NAMES.split())

_CAMERA_HEADERS = (
    *(b"II*\0", b"MM\0*"),  # TIFF: DNG, NEF, CR2, ARW, PEF, KDC, ...
    *(b"IIU\0", b"IIRO", b"IIRS", b"MMOR"),  # Panasonic, Olympus
    *(b"II\x1a\0", b"IIII", b"MMMM"),  # Canon CRW, Phase One
    *(b"\0MRM", b"FUJIFILM", b"FOVb"),  # Minolta, Fujifilm, Sigma
)
_CR3_HEADER = b"ftypcrx "
_HARMLESS_JPEG = ("Invalid SOS parameters", "Unknown Adobe color transform code", "Warning: unknown JFIF revision")
"""Beginnings of libjpeg's warnings of headers that it can read all the same."""

_MALLOPT = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
"""Sets what allocated memory is filled with; only glibc has it."""
_PERTURB = -6
"""The option of `mallopt` that does so (M_PERTURB in malloc.h)."""
_MARKS = (0xFE, 0x53)
"""Bytes that memory is filled with before a raw is decoded into it; samples of two such bytes are rare."""


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
        is_uncompressed, black_by_tags, _ = _tags(self.path)
        values, black, white, cfa, margin = self._decode(_MARKS[0])
        if _MALLOPT is None or (values == 257 * _MARKS[0]).any():
            # LibRaw returns from some damage without an error: what it did not write is what memory held
            is_undecoded = values != self._decode(_MARKS[1])[0]
            if is_undecoded.any():
                raise damaged_file(self.path, f"LibRaw does not decode {is_undecoded.mean():.2%} of its samples")
        if black_by_tags is not None:
            # LibRaw moves odd margins to the next even row and column without moving the black levels along
            black = np.roll(black_by_tags, margin, axis=(0, 1))
        _refuse_filled_rows(values, black, white, is_uncompressed=is_uncompressed, path=self.path)
        kind: FrameKind = "bayer" if cfa else "monochrome"
        return StoredFrame(values=values, kind=kind, cfa=cfa, black_level=black, white_level=white)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Doubts about the black levels."""
        try:
            _, _, spread = _tags(self.path)
        except FrameError:  # reported when it is read
            return ()
        remark = "its black level varies from row to row, column to column or over more than 2x2 pixels by {:.3g} DN"
        return (f"{remark.format(spread)}: the mean of each position is taken",) if spread > 1 else ()

    def _decode(self, mark: int) -> tuple[AnyArray, FloatArray, float, str | None, tuple[int, int]]:
        """Decode the samples into memory filled with the byte `mark`: samples, levels, pattern, minus the margins."""
        with _libraw(self.path) as raw:
            with _filled_memory(mark):
                raw.unpack()
            cell = _colour_cell(raw, self.path)
            values, sizes = np.array(raw.raw_image_visible, dtype=np.uint16), raw.sizes
            black = np.asarray(raw.black_level_per_channel, dtype=np.float64)[cell]
            white, cfa = float(raw.white_level), None if raw.num_colors == 1 else _colour_names(raw, cell)
            if _MALLOPT is None:
                raw.raw_image[...] = ~raw.raw_image  # the next raw of this size is mostly decoded into this memory
        if values.shape != (sizes.height, sizes.width):
            raise damaged_file(
                self.path, f"its visible part ({sizes.height} x {sizes.width}) reaches beyond its samples"
            )
        return values, black, white, cfa, (-sizes.top_margin, -sizes.left_margin)


@contextmanager
def _filled_memory(byte: int) -> Iterator[None]:
    """Have the memory that is allocated inside filled with a byte, where the C library can."""
    if _MALLOPT is None:
        yield
        return
    _MALLOPT(_PERTURB, byte ^ 0xFF)  # glibc fills with the complement
    try:
        yield
    finally:
        _MALLOPT(_PERTURB, 0)


def _tags(path: Path) -> tuple[bool, FloatArray | None, float]:
    """Read what the TIFF tags of a raw state beyond what LibRaw gives, and check that its image data are all there.

    Returns
    -------
    is_uncompressed : bool
        Whether the samples are uncompressed and all there, so that zeros in them are real.
    black : ndarray, shape (2, 2), or None
        DNG black level by position from the sensor's first pixel on, the mean where it varies further; None where no
        tag states it, in files that are not TIFF inside, or that only LibRaw can follow.
    spread : float
        By how many DN the black level of a position varies over the sensor.

    Raises
    ------
    FrameError
        Image data that the header announces is not in the file.
    """
    try:
        with tiff_pages(path) as pages:
            raw = [page for page in pages if page.photometric in (32803, 34892)] or pages  # CFA, linear raw
            page = max(raw, key=lambda page: page.imagewidth * page.imagelength)
            first_row, first_column, *_ = tag(page, Tag.ACTIVE_AREA) or (0, 0)
            is_uncompressed, (black, spread) = has_uncompressed_data(page), _black_cell(page)
            missing = [reason for page in raw if (reason := missing_data(page, path.stat().st_size))]
            missing += [reason for page in raw if (reason := oversized_jpeg(page, path))]
            black = None if black is None else np.roll(black, (first_row, first_column), axis=(0, 1))
    except FrameError:
        return False, None, 0.0
    if missing:
        raise damaged_file(path, missing[0])
    return is_uncompressed, black, spread


def _black_cell(page: tifffile.TiffPage) -> tuple[FloatArray | None, float]:
    """Return the mean black level (2, 2) of each position of a page's active area, and by how much it varies there.

    The levels of a cell of any size, and what is added by column and by row (DNG 1.4, BlackLevelDeltaH and -V).
    """
    rows, columns = tag(page, Tag.BLACK_REPEAT) or (1, 1)
    levels = _reals(page, Tag.BLACK)
    if levels is None or levels.size != rows * columns:
        return None, 0.0
    cell = np.tile(levels.reshape(rows, columns), (math.lcm(rows, 2) // rows, math.lcm(columns, 2) // columns))
    positions = [[cell[row::2, column::2] for column in (0, 1)] for row in (0, 1)]
    black = np.array([[levels_at.mean() for levels_at in line] for line in positions])
    spread = max(float(np.ptp(levels_at)) for line in positions for levels_at in line)
    for code, shape in ((Tag.BLACK_DELTA_H, (1, 2)), (Tag.BLACK_DELTA_V, (2, 1))):
        if (deltas := _reals(page, code)) is not None and deltas.size > 1:
            black = black + np.array([deltas[0::2].mean(), deltas[1::2].mean()]).reshape(shape)
            spread += max(float(np.ptp(deltas[0::2])), float(np.ptp(deltas[1::2])))
    return black, spread


def _reals(page: tifffile.TiffPage, code: int) -> FloatArray | None:
    """Return the numbers of a tag; rationals come as numerator, denominator."""
    values = tag(page, code)
    if values is None:
        return None
    numbers = np.array(values, dtype=np.float64)
    with np.errstate(all="ignore"):  # levels that are not finite are refused where the frame is checked
        return numbers[::2] / numbers[1::2] if page.tags[code].dtype in (5, 10) else numbers


@contextmanager
def _libraw(path: Path) -> Iterator[rawpy.RawPy]:
    """Open the file by LibRaw; what LibRaw raises while it is open becomes a FrameError, what it prints a warning.

    Where libjpeg, which unpacks some, reports that the data are broken, that is a FrameError, too.
    """
    import rawpy

    try:
        prefixes = (os.fsencode(path), *(start.encode() for start in BROKEN_JPEG + _HARMLESS_JPEG))
        with captured_stderr(*prefixes) as lines, rawpy.imread(str(path)) as raw:
            n_bytes = 2 * raw.sizes.raw_height * raw.sizes.raw_width
            check_size(path, unpacked=n_bytes, stored=path.stat().st_size)
            yield raw
    except rawpy.LibRawFileUnsupportedError:
        raise FrameError(f"{path} is a camera raw that LibRaw does not know") from None
    except NotImplementedError:  # rawpy's answer to filters that repeat neither after 2x2 nor after 6x6 pixels
        raise _not_bayer(path, "that is no mosaic of 2x2 pixels") from None
    except rawpy.LibRawError as error:
        reason = error.args[0] if error.args else type(error).__name__
        reason = reason.decode(errors="replace") if isinstance(reason, bytes) else reason
        raise damaged_file(path, f"LibRaw reports: {reason}") from None
    for line in lines:
        if line.startswith(BROKEN_JPEG):
            raise damaged_file(path, f"libjpeg reports: {line}")
        logger.warning("LibRaw reports: %s", line)


def has_camera_header(path: Path) -> bool:
    """Return whether the file starts as camera raws do.

    LibRaw takes a file without a header for some camera's by its length alone, and so gives a wrong picture.
    """
    try:
        with require_regular_file(path).open("rb") as file:
            head = file.read(12)
    except OSError:  # reported by whoever reads the file
        return False
    return head.startswith(_CAMERA_HEADERS) or head[4:] == _CR3_HEADER


def _not_bayer(path: Path, description: str) -> FrameError:
    allowed = ", ".join(BAYER_PATTERNS)
    return FrameError(f"{path} has a colour filter array {description}; allowed are the Bayer patterns {allowed}")


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
    # `raw_colors_visible` would fill the whole frame
    first_row = raw.sizes.top_margin
    first_column = raw.sizes.left_margin
    cell = np.array([[raw.raw_color(first_row + row, first_column + column) for column in (0, 1)] for row in (0, 1)])
    if pattern.shape != (2, 2) or _colour_names(raw, cell) not in BAYER_PATTERNS:
        rows, columns = pattern.shape
        raise _not_bayer(path, f"of {rows}x{columns} pixels with the colours {_colour_names(raw, pattern)}")
    return cell


def _colour_names(raw: rawpy.RawPy, colours: AnyArray) -> str:
    return "".join(raw.color_desc.decode()[colour] for colour in colours.ravel())


def _refuse_filled_rows(
    values: npt.NDArray[np.uint16], black: FloatArray, white: float, *, is_uncompressed: bool, path: Path
) -> None:
    """Refuse a mosaic that LibRaw filled with zeros because the file's data ended.

    A row of a real sensor has noise, even in the dark: rows of one single value are not measured unless they are
    saturated. Where the samples are stored uncompressed and the file is complete, such rows may be real (a computed
    frame), except zeros below a positive black level, which no sensor gives.
    """
    lowest, highest = values.min(axis=1), values.max(axis=1)
    is_constant = (lowest == highest) & (highest < white)
    if is_uncompressed:
        is_constant &= (highest == 0) & (black.min() > 0)
    fraction = float(is_constant.mean())
    if is_constant[-1] or fraction > 0.01:  # defective rows may exist
        raise damaged_file(
            path, f"{fraction:.1%} of its rows are empty (one single value, {highest[is_constant][-1]} in the last)"
        )
