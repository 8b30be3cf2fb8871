"""TIFF files: of one image, grey or RGB, 8 or 16 bit; or of several, one frame a page.

ImageJ's hyperstacks and OME-TIFF are read as they store their frames and times.
"""

from __future__ import annotations

import lzma
import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.disk import require_regular_file
from rgbmidic.errors import FrameError, damaged_file
from rgbmidic.frames.data import Integers, Recording
from rgbmidic.frames.hyperstacks import Hyperstack
from rgbmidic.frames.images import decode
from rgbmidic.frames.metadata import CHECKED_BYTES, EvenFrames, MovieHeader, StoredFrame, check_count, unpack_bits
from rgbmidic.frames.source import FrameSource, MovieSource, cache_by_file
from rgbmidic.frames.tiff_pages import (
    PACKED_BITS,
    UNCOMPRESSED,
    PageList,
    Tag,
    check_page,
    only_page,
    open_tiff,
    tag,
)
from rgbmidic.typing import AnyArray

if TYPE_CHECKING:
    import tifffile

TIFF_ENDINGS = (".tif", ".tiff")

_DECOMPRESSORS: dict[int, Any] = {8: zlib.decompressobj, 32946: zlib.decompressobj, 34925: lzma.LZMADecompressor}
"""Compressions (deflate, LZMA) that tifffile undoes, without a limit, and what undoes them up to one."""
_MIN_IS_WHITE, _PALETTE = 0, 3
_MISSING = -1
"""In place of the offset of a page that is announced, and that the list of pages does not lead to."""


class TiffFile(FrameSource):
    """A TIFF file of one image with 1 or 3 channels; a table of colours is refused."""

    packages = ("tifffile",)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks of the header for the user."""
        try:
            return _stack(self.path).recording.remarks
        except FrameError:  # reported when it is read
            return ()

    def _shape(self) -> tuple[int, int]:
        with only_page(self.path) as page:
            return int(page.imagelength), int(page.imagewidth)

    def _rows(self, index: int, rows: slice) -> StoredFrame:
        with only_page(self.path) as page:
            values = _stored_rows(page, self.path, range(page.imagelength)[rows])
            return _to_stored_frame(
                _unpack_with_opencv(page, self.path)[rows] if values is None else values, page, self.path
            )


def _stored_rows(page: tifffile.TiffPage, path: Path, rows: range, index: int = 0, count: int = 1) -> AnyArray | None:
    """Read some rows (n, W, C) of a checked page, or of frame `index` of `count` that lie one behind the other from it.

    None where they must be unpacked, all at once.
    """
    if not page.is_final or (page.planarconfig == 2 and page.samplesperpixel > 1):
        return None
    frames = EvenFrames(
        shape=(page.imagelength, page.imagewidth),
        recording=Recording(count=count),
        start=page.dataoffsets[0],
        channels=(page.samplesperpixel * page.imagedepth,),
        stored_bits=page.bitspersample,
        order=page.parent.byteorder,
    )
    return frames.require_plausible(path).read(path, index, rows).values


def _to_stored_frame(values: AnyArray, page: tifffile.TiffPage, path: Path) -> StoredFrame:
    """Return samples of a page as its tags state that they are shown; a colour table that changes them is refused."""
    if page.photometric == _PALETTE:
        table = np.asarray(page.tags[Tag.COLOUR_MAP].value, dtype=np.int64).reshape(3, -1)
        # some cameras' software writes grey images with a table that changes nothing, of 257 i or of 256 i
        if values.dtype != np.uint8 or not (table // 256 == np.arange(table.shape[1])).all():
            raise FrameError(f"{path} shows its grey levels through a colour table; save it as a plain grey image")
    elif page.photometric == _MIN_IS_WHITE:
        values = values.dtype.type(2**page.bitspersample - 1) - values
    pattern = tag(page, Tag.CFA_PATTERN) or ()
    is_bayer = tag(page, Tag.CFA_REPEAT) == (2, 2) and set(pattern) <= {0, 1, 2}
    frame = StoredFrame.from_samples(values, path, "".join("RGB"[channel] for channel in pattern if is_bayer) or None)
    return replace(frame, bits=page.bitspersample) if page.bitspersample in PACKED_BITS else frame


def _unpack(page: tifffile.TiffPage, path: Path) -> AnyArray:
    """Unpack the samples of a page, (H, W) or (H, W, C)."""
    if page.compression not in (UNCOMPRESSED, *_DECOMPRESSORS):
        name = getattr(page.compression, "name", page.compression)
        raise FrameError(f"{path} is stored in a way that is not read ({name}); save it as a plain uncompressed TIFF")
    if page.bitspersample in PACKED_BITS:
        return _unpack_bits(page, path)
    if page.compression in _DECOMPRESSORS:
        _check_unpacked(page, path)
    values = np.asarray(page.asarray())
    # where one plane lies after the other
    return np.moveaxis(values, 0, -1) if values.ndim == 3 and page.planarconfig == 2 else values


def _unpack_bits(page: tifffile.TiffPage, path: Path) -> AnyArray:
    """Unpack samples (H, W, C) of 10, 12 or 14 bit, the highest bit first; every row begins with a byte (TIFF 6.0)."""
    columns = page.imagewidth * page.samplesperpixel
    line = -(-columns * page.bitspersample // 8)
    if page.is_tiled or page.fillorder != 1 or (page.planarconfig == 2 and page.samplesperpixel > 1):
        layout = "in tiles, in planes or from the lowest bit on"
        raise FrameError(f"{path} has packed samples of {page.bitspersample} bit {layout}, which is not read")
    n_bytes, content = page.imagelength * line, b""
    with path.open("rb") as file:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            file.seek(offset)
            content += file.read(min(count, page.rowsperstrip * line, n_bytes - len(content)))
    if len(content) < n_bytes:
        raise damaged_file(path, f"its image data have {len(content)} bytes, too few for its size")
    lines = np.frombuffer(content, dtype=np.uint8).reshape(page.imagelength, line)
    values = unpack_bits(lines, page.bitspersample)[:, :columns]
    return values.reshape(page.imagelength, page.imagewidth, page.samplesperpixel)


def _unpack_with_opencv(page: tifffile.TiffPage, path: Path) -> AnyArray:
    """Unpack the samples of the only page of a file, by OpenCV what tifffile cannot."""
    # OpenCV turns such samples, some more than others
    is_transformed = (tag(page, Tag.ORIENTATION) or (1,)) != (1,) or page.photometric in (_MIN_IS_WHITE, _PALETTE)
    if is_transformed or page.compression not in (5, 7, 32773):  # LZW, JPEG, PackBits
        return _unpack(page, path)
    values = decode(path.read_bytes(), path)
    if (*values.shape[:2], values.dtype) != (page.imagelength, page.imagewidth, page.dtype):
        raise damaged_file(
            path, f"its header announces another image than its data hold, {values.shape} {values.dtype}"
        )
    return values


def _check_unpacked(page: tifffile.TiffPage, path: Path) -> None:
    """Refuse parts that unpack to more than the whole image, and all of them to less: tifffile fills up with zeros."""
    limit, total = max(page.nbytes, CHECKED_BYTES), 0
    with path.open("rb") as file:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            file.seek(offset)
            unpacked = len(_DECOMPRESSORS[page.compression]().decompress(file.read(count), limit + 1))
            if unpacked > limit:
                raise damaged_file(path, f"a part of its image data unpacks to more than {limit} bytes")
            total += unpacked
    if total < page.nbytes:
        raise damaged_file(path, f"its image data unpack to {total} bytes, too few for its size")


class TiffStack(MovieSource):
    """A TIFF file of several frames of one size, in the order of the file."""

    packages = ("tifffile",)

    def _header(self) -> _Pages:
        return _stack(self.path)


def is_tiff_stack(path: Path) -> bool:
    """Return whether a TIFF file holds several frames; False for what cannot be read."""
    try:
        return _stack(path).recording.count > 1
    except (OSError, FrameError):
        return False


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pages(MovieHeader):
    """Offsets of the pages (one, where ImageJ stored all frames behind it), of which the first has the `shape`."""

    offsets: Integers

    def read(self, path: Path, index: int, rows: range) -> StoredFrame:
        """Read some rows of a frame."""
        count, readable = self.recording.count, int((self.offsets != _MISSING).sum())
        is_contiguous = len(self.offsets) == 1 and self.recording.count_is_certain  # as ImageJ stores more than 4 GB
        if not is_contiguous and (index >= len(self.offsets) or self.offsets[index] == _MISSING):
            raise FrameError(f"{path}: its list of frames ends after {readable - 1}: truncated or still being written")
        with _page_at(path, int(self.offsets[0 if is_contiguous else index])) as page:
            check_page(page, path)
            if (page.imagelength, page.imagewidth) != self.shape:
                size_text = f"{page.imagelength} rows of {page.imagewidth} pixels"
                raise FrameError(f"{path}: frame {index} has {size_text}, the first {self.shape[0]} of {self.shape[1]}")
            values = _stored_rows(page, path, rows, *((index, count) if is_contiguous else ()))
            if values is None:
                if is_contiguous:
                    reason = "has one page, whose samples are compressed or in pieces"
                    raise FrameError(f"{path} announces {count} frames but {reason}")
                values = _unpack(page, path)[rows.start : rows.stop]
            return _to_stored_frame(values, page, path)


@cache_by_file
def _stack(path: Path) -> _Pages:
    with require_regular_file(path).open("rb") as file:
        pages = PageList(file, path)
        offsets, ends_early = pages.offsets(path)
        entries, _ = pages.page(offsets[0]) or ({}, 0)
        text = pages.text(entries, Tag.DESCRIPTION)
        shape = (pages.value(entries, Tag.ROWS), pages.value(entries, Tag.COLUMNS))
        samples = math.prod(shape) * (pages.value(entries, Tag.SAMPLES_PER_PIXEL) or 1)
        frame_bytes = sum(pages.segments(entries)[1])
        has_room = 0 < frame_bytes * (len(offsets) + 1) < pages.size
        n_unlisted = pages.unlisted_bytes(offsets) if has_room and not ends_early else 0
    stack, count, remarks = Hyperstack.parse(text, samples), len(offsets) + ends_early, list[str]()
    if stack is None and "<OME" in text[:1000]:
        remarks.append("its OME description cannot be read")
    if (
        stack
        and stack.by_imagej
        and len(offsets) == 1 < stack.count
        and (n_fitting := _frames_that_fit(path, offsets[0]))
    ):
        count = stack.count
        if n_fitting > count:
            remarks.append(f"its text announces {count} images, and it has room for {n_fitting}")
    elif stack and ends_early and stack.count > len(offsets):
        count, ends_early = stack.count, False
        offsets += [_MISSING] * (count - len(offsets))
    check_count(path, count)
    order = stack.page_order if stack and len(offsets) == stack.count else [0]
    if stack and (stack.count != count or sorted(order) != list(range(len(offsets)))):
        remark = f"its text announces {stack.count} images, it holds {count}: the text is not used"
        stack, order, remarks = None, list(range(len(offsets))), remarks if ends_early else [*remarks, remark]
    if not (stack or remarks) and n_unlisted >= frame_bytes > 0:
        remarks.append(
            f"{n_unlisted} bytes of it belong to none of its {count} frames, the first of which takes {frame_bytes}: "
            "was its list of frames cut?"
        )
    recording = Recording(count=count, count_is_certain=not ends_early, remarks=tuple(remarks))
    if stack:
        times, planes = stack.times_ns, stack.planes
        recording = replace(recording, times_ns=times, planes=planes, planes_description=stack.planes_description)
        offsets = [offsets[page] for page in order]
    return _Pages(shape=shape, recording=recording, offsets=np.array(offsets))


def _frames_that_fit(path: Path, offset: int) -> int:
    """Return for how many frames there is room from the samples of the only page on, as ImageJ stores more than 4 GB.

    0 where none follows: ImageJ writes a page before its samples, and they end with the file.
    """
    with _page_at(path, offset) as page:
        first_byte, size = min(page.dataoffsets, default=0), path.stat().st_size
        return (
            -(-(size - first_byte) // page.nbytes)
            if offset < first_byte and size > first_byte + page.nbytes > first_byte
            else 0
        )


@contextmanager
def _page_at(path: Path, offset: int) -> Iterator[tifffile.TiffPage]:
    import tifffile

    with open_tiff(path) as tiff:
        tiff.filehandle.seek(offset)
        yield tifffile.TiffPage(tiff, index=0)
