"""Movies whose samples lie uncompressed at even distances: Photron's .mraw and NorPix StreamPix's .seq.

Photron publishes no layout of .mraw. The names are those of headers that FASTCAM Viewer 3 (.cih, text) and 4 (.cihx,
XML inside a binary file) wrote; samples of 12 bit are packed as in a file of a Nova S16, and those of 10 bit are taken
to be so, too.

The layout of .seq is that of NorPix, "The NorPix Sequence File Format (.seq)", 2015. Before version 5 of the header the
frames begin behind its 1024 bytes, and time stamps have no microseconds. The 118 frames of a camera's file that pims
tests with are read as by pims.
"""

from __future__ import annotations

import logging
import math
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree

import numpy as np

from rgbmidic.errors import FrameError, damaged_file
from rgbmidic.frames.data import SECOND, Integers, Recording, even_times, parse_fraction
from rgbmidic.frames.metadata import EvenFrames, StoredFrame
from rgbmidic.frames.source import MovieSource, cache_by_file

logger = logging.getLogger(__name__)


# Photron .mraw

MRAW_ENDINGS = (".mraw", ".cihx", ".cih")

_NAMES = {
    "Image Width": "imageDataInfo/resolution/width",
    "Image Height": "imageDataInfo/resolution/height",
    "Color Type": "imageDataInfo/colorInfo/type",
    "Color Bit": "imageDataInfo/colorInfo/bit",
    "EffectiveBit Depth": "imageDataInfo/effectiveBit/depth",
    "EffectiveBit Side": "imageDataInfo/effectiveBit/side",
    "Total Frame": "frameInfo/totalFrame",
    "Start Frame": "frameInfo/startFrame",
    "Save Step": "frameInfo/skipFrame",
    "Correct Trigger Frame": "frameInfo/adjustTriggerPoint",
    "Record Rate(fps)": "recordInfo/recordRate",
    "Shutter Type2(nsec)": "recordInfo/shutterSpeedNsec",
}
"""Names in .cih, and where .cihx holds the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MrawFile(MovieSource):
    """A movie of a Photron camera, named by its samples or by its header, of monochrome or raw samples.

    The header does not state the Bayer pattern: its colour type "Raw" occurs on monochrome cameras, too.
    """

    def __post_init__(self) -> None:
        """Take the file of the samples where the header is named."""
        if self.path.suffix.lower() != ".mraw":
            object.__setattr__(self, "path", _companion(self.path, ".mraw") or self.path.with_suffix(".mraw"))

    def _header(self) -> EvenFrames:
        header_path = _companion(self.path, *MRAW_ENDINGS[1:])
        if header_path is None:
            raise FrameError(f"{self.path} needs its header {self.path.stem}.cihx or {self.path.stem}.cih beside it")
        return _mraw_header(header_path).with_rest_noted(self.path.stat().st_size)


def _companion(path: Path, *endings: str) -> Path | None:
    """Find the file of the same name with the first of these endings that exists, in lower or upper case."""
    candidates = (path.with_suffix(text) for ending in endings for text in (ending, ending.upper()))
    return next((candidate for candidate in candidates if candidate.is_file()), None)


@cache_by_file
def _mraw_header(path: Path) -> EvenFrames:
    with path.open("rb") as file:
        content = file.read(4 * 2**20)  # those seen have 9 and 19 kB
    entries = _xml(content, path) if path.suffix.lower() == ".cihx" else _lines(content)
    read_int = partial(_read_int, path, entries)
    rows, columns, stored_bits = map(read_int, ("Image Height", "Image Width", "Color Bit"))
    kind = entries.get("Color Type", "")
    if kind.lower() not in ("mono", "raw", "bayer") or stored_bits in (24, 30, 36, 48):
        raise FrameError(
            f'{path} states {stored_bits} bit of colour type "{kind}": its samples are no longer the sensor\'s; save '
            "the movie as raw (Bayer) or monochrome"
        )
    if stored_bits not in (8, 10, 12, 16):
        raise damaged_file(path, f"it announces samples of {stored_bits} bit; allowed are 8, 10, 12 and 16")
    depth, side = read_int("EffectiveBit Depth", stored_bits), entries.get("EffectiveBit Side", "Lower").lower()
    if min(rows, columns) < 1 or rows * columns * stored_bits % 8:
        raise damaged_file(path, f"it announces {rows} rows of {columns} samples of {stored_bits} bit")
    count = read_int("Total Frame")
    if side not in ("lower", "higher", "upper") or not 8 <= depth <= 16:
        raise damaged_file(path, f'it announces {depth} effective bits, "{side}"; allowed are lower and higher')
    if side == "lower" and depth > stored_bits:
        logger.warning("%s holds the lower %d of %d bits: brighter samples are lost", path, stored_bits, depth)
    header = EvenFrames(
        shape=(rows, columns),
        recording=Recording(count=count),
        stored_bits=stored_bits,
        shift=0 if side == "lower" else max(stored_bits - depth, 0),
        metadata=StoredFrame(kind="bayer" if kind.lower() == "bayer" else None, bits=min(stored_bits, depth)),
    ).require_plausible(path)
    return replace(header, recording=_recording(path, entries, count, depth))


def _read_int(path: Path, entries: Mapping[str, str], name: str, default: int | None = None) -> int:
    """Return a whole number that a header states."""
    text = entries.get(name, "" if default is None else str(default))
    largest = 2**40  # the number of a frame after 12 days at a million a second
    if not re.fullmatch(r"-?[0-9]{1,13}", text) or abs(int(text)) > largest:
        raise damaged_file(path, f'its "{name}" is "{text}"' if text else f'it does not state "{name}"')
    return int(text)


def _lines(content: bytes) -> dict[str, str]:
    """Find the entries "name : value" of the first header: a movie that was saved again carries the older ones too."""
    entries: dict[str, str] = {}
    for line in content.decode("latin-1").splitlines():
        name, colon, value = line.partition(":")
        if colon:
            entries.setdefault(name.strip(), value.strip())
    return entries


def _xml(content: bytes, path: Path) -> dict[str, str]:
    begin, end = content.find(b"<cih>"), content.rfind(b"</cih>")
    if begin < 0 or end < begin:
        raise damaged_file(path, "it holds no <cih> element")
    try:
        root = ElementTree.fromstring(content[begin : end + len(b"</cih>")].decode(errors="replace"))
    except ElementTree.ParseError as error:
        raise damaged_file(path, error) from None
    texts = {name: root.findtext(element_path) for name, element_path in _NAMES.items()}
    return {name: text.strip() for name, text in texts.items() if text and text.strip()}


def _recording(path: Path, entries: Mapping[str, str], count: int, depth: int) -> Recording:
    """Return how the frames were recorded: they count from the trigger, and every `step`-th is stored."""
    step = max(_read_int(path, entries, "Save Step", 1), 1)
    first = _read_int(path, entries, "Start Frame", 0) - _read_int(path, entries, "Correct Trigger Frame", 0)
    numbers = range(first, first + count * step, step)
    rate, shutter, exposure = (
        parse_fraction(entries.get(name, ""))
        for name in ("Record Rate(fps)", "Shutter Speed(s)", "Shutter Type2(nsec)")
    )
    exposure = exposure or (SECOND * shutter if shutter else None)
    try:
        times = even_times(numbers, 1 / rate) if rate else None
    except OverflowError:
        text = f"it announces frames up to number {numbers[-1]} at {float(rate or 0)} per second"
        raise damaged_file(path, text) from None
    return Recording(
        count=count,
        bit_depth=depth,
        frame_rate=float(rate) if rate else None,
        exposure_ns=round(exposure) if exposure else None,
        trigger=-first // step,
        saved_every=step,
        times_ns=times,
    )


# NorPix .seq

_SEQ_FIELDS = struct.Struct("<I24xi4x512x6I3Id16xi8xI32xI364x")
"""Magic; version; width, height, bits stored, bits used, bytes, format; frames, origin, distance; rate; pattern;
compression; oldest frame."""

_RAW = dict.fromkeys((100, 101), ("<", False))
_RAW |= dict.fromkeys((112, 113), ("<", True)) | dict.fromkeys((114, 115), (">", True))
"""Monochrome (even) and raw Bayer (odd) formats: byte order, and whether a sample's highest bit is its type's."""
_PACKED = range(131, 135)
_PATTERNS = {1: "GRBG", 2: "BGGR", 3: "RGGB"}
"""By NorPix's `eHBayerPatternOrigin`; 0, green beside blue, is also what a header holds that states no pattern."""


class SeqFile(MovieSource):
    """An uncompressed sequence of StreamPix, of monochrome or raw samples with a time stamp behind each frame."""

    def _header(self) -> EvenFrames:
        return _seq_header(self.path)


@cache_by_file
def _seq_header(path: Path) -> EvenFrames:
    with path.open("rb") as file:
        content = file.read(_SEQ_FIELDS.size)
        if len(content) < _SEQ_FIELDS.size or int.from_bytes(content[:4], "little") != 0xFEED:
            raise damaged_file(path, "it does not begin as a NorPix sequence")
        _, version, columns, rows, stored_bits, bits, size, sample_format, *remaining = _SEQ_FIELDS.unpack(content)
        count, _, stride, rate, pattern, compression, oldest = remaining
        if compression or sample_format not in _RAW:
            problem = f"holds colours (format {sample_format}): its samples are no longer the sensor's, and it"
            problem = f"holds packed samples (format {sample_format})" if sample_format in _PACKED else problem
            problem = f"is compressed (method {compression})" if compression else problem
            advice = "export it uncompressed, 8 or 16 bit, monochrome or raw Bayer"
            raise FrameError(f"{path} {problem} and is not read: {advice}")
        if not columns or not rows or stored_bits not in (8, 16) or not 1 <= bits <= stored_bits:
            raise damaged_file(path, f"it announces {rows} rows of {columns} samples, {bits} of {stored_bits} bits")
        if size != rows * columns * stored_bits // 8 or oldest >= max(count, 1):
            raise damaged_file(
                path, f"it announces {size} bytes for {rows} rows of {columns} samples of {stored_bits} bits"
            )
        order, in_upper_bits = _RAW[sample_format]
        cfa = _PATTERNS.get(pattern) if sample_format % 2 else None
        header = EvenFrames(
            shape=(rows, columns),
            recording=Recording(
                count=count, bit_depth=bits, frame_rate=rate if math.isfinite(rate) and rate > 0 else None
            ),
            start=8192 if version >= 5 else 1024,
            gap=stride - size,
            stored_bits=stored_bits,
            order=order,
            shift=stored_bits - bits if in_upper_bits else 0,
            metadata=StoredFrame(kind="bayer" if cfa else None, cfa=cfa, bits=bits),
            oldest=oldest,
        ).require_plausible(path)
        times = _stamps_ns(file, header, "<iHH" if version >= 5 else "<iH")
    return replace(header, recording=replace(header.recording, times_ns=times))


def _stamps_ns(file: BinaryIO, header: EvenFrames, stamp: str) -> Integers | None:
    """Read the time of every frame from the first; None where the file ends before the last."""
    size, count, end = struct.calcsize(stamp), header.recording.count, file.seek(0, 2)
    if header.gap < size or end < header.start + count * (header.size + header.gap) - header.gap + size:
        return None
    times = np.empty(count, dtype=np.int64)
    for index in range(count):
        file.seek(header.frame_offset(index) + header.size)
        seconds, *fractions = struct.unpack(stamp, file.read(size))
        times[index] = seconds * SECOND + sum(
            value * 10**power for value, power in zip(fractions, (6, 3), strict=False)
        )
    return np.asarray(times - times[0])
