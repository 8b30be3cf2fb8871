"""Photron's movies: the samples in .mraw and, beside it, what the camera tells of them in .cih or .cihx.

No layout is published. The names are those of headers that FASTCAM Viewer 3 (.cih, text) and 4 (.cihx, XML inside a
binary file) wrote; samples of 12 bit are packed as in a file of a Nova S16, those of 10 bit are taken to be so, too.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.layout import Layout, unpack_bits
from rgbmidic.frames.recording import Integers, Recording, even_times
from rgbmidic.frames.source import Movie, remembered
from rgbmidic.frames.stored import StoredFrame, damaged
from rgbmidic.typing import AnyArray

logger = logging.getLogger(__name__)

__all__ = ["MRAW_ENDINGS", "MrawFile"]

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

_HEADER_BYTES = 4 * 2**20
"""Most bytes that are read of a header; those seen have 9 and 19 kB."""

_NUMBER = re.compile(r"[0-9]{1,9}(\.[0-9]{1,6}|/[0-9]{1,9})?")
_LARGEST = 2**40
"""Largest frame number: 12 days at a million frames a second."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MrawFile(Movie):
    """A movie of a Photron camera, named by its samples or by its header, of monochrome or raw samples.

    The header does not tell the Bayer pattern: its colour type "Raw" occurs on monochrome cameras, too.
    """

    def __post_init__(self) -> None:
        if self.path.suffix.lower() != ".mraw":
            object.__setattr__(self, "path", _beside(self.path, ".mraw") or self.path.with_suffix(".mraw"))

    def _recording(self) -> Recording:
        return self._header().recording

    def _shape(self) -> tuple[int, int]:
        return self._header().shape

    def _stored(self, index: int) -> StoredFrame:
        return self._rows(index, range(self._shape()[0]))

    def _rows(self, index: int, rows: range) -> StoredFrame:
        header = self._header()
        values = header.samples(header.layout.read(self.path, index, rows, header.shape[0]))
        return StoredFrame(values=values, bits=header.bits)

    def _header(self) -> _Header:
        found = _beside(self.path, *MRAW_ENDINGS[1:])
        if found is None:
            raise FrameError(f"{self.path} needs its header {self.path.stem}.cihx or {self.path.stem}.cih beside it")
        return _header(found)


def _beside(path: Path, *endings: str) -> Path | None:
    """The file of the same name with the first of these endings that exists, in lower or upper case."""
    spelled = (path.with_suffix(text) for ending in endings for text in (ending, ending.upper()))
    return next((other for other in spelled if other.is_file()), None)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Header:
    """What is known of the frames; `bits` of a sample are stored `shift` above the lowest of `stored_bits`."""

    shape: tuple[int, int]
    stored_bits: int
    bits: int
    shift: int
    layout: Layout
    recording: Recording

    def samples(self, data: bytes) -> AnyArray:
        if self.stored_bits in (8, 16):
            values: AnyArray = np.frombuffer(data, dtype=f"<u{self.stored_bits // 8}")
        else:
            values = unpack_bits(data, self.stored_bits)
        return (values >> self.shift).reshape(-1, self.shape[1])


@remembered
def _header(path: Path) -> _Header:
    with path.open("rb") as file:
        content = file.read(_HEADER_BYTES)
    entries = _Entries(path=path, found=_xml(content, path) if path.suffix.lower() == ".cihx" else _lines(content))
    rows, columns = entries.whole("Image Height"), entries.whole("Image Width")
    stored_bits = _stored_bits(entries)
    depth = entries.whole("EffectiveBit Depth", stored_bits)
    size, rest = divmod(rows * columns * stored_bits, 8)
    if min(rows, columns) < 1 or rest:
        raise damaged(path, f"it announces {rows} rows of {columns} samples of {stored_bits} bit")
    count = entries.whole("Total Frame")
    return _Header(
        shape=(rows, columns),
        stored_bits=stored_bits,
        bits=min(stored_bits, depth),
        shift=_shift(entries, stored_bits, depth),
        layout=Layout.checked(path, count=count, start=0, size=size),
        recording=_recording(entries, count, depth),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Entries:
    """The entries of a header under their names in .cih."""

    path: Path
    found: Mapping[str, str]

    def whole(self, name: str, default: int | None = None) -> int:
        text = self.found.get(name, "" if default is None else str(default))
        if not re.fullmatch(r"-?[0-9]{1,13}", text) or abs(int(text)) > _LARGEST:
            raise damaged(self.path, f'its "{name}" is "{text}"' if text else f'it does not tell "{name}"')
        return int(text)

    def number(self, name: str) -> Fraction | None:
        """A positive number; None where there is none."""
        text = self.found.get(name, "")
        if not _NUMBER.fullmatch(text) or re.search("/0+$", text):
            return None
        return Fraction(text) or None


def _lines(content: bytes) -> dict[str, str]:
    """Entries "name : value" of the first header: a movie that was saved again carries the older ones behind."""
    found: dict[str, str] = {}
    for line in content.decode("latin-1").splitlines():
        name, colon, value = line.partition(":")
        if colon:
            found.setdefault(name.strip(), value.strip())
    return found


def _xml(content: bytes, path: Path) -> dict[str, str]:
    begin, end = content.find(b"<cih>"), content.rfind(b"</cih>")
    if begin < 0 or end < begin:
        raise damaged(path, "it holds no <cih> element")
    try:
        root = ElementTree.fromstring(content[begin : end + len(b"</cih>")].decode(errors="replace"))
    except ElementTree.ParseError as error:
        raise damaged(path, error) from None
    texts = {name: root.findtext(place) for name, place in _NAMES.items()}
    return {name: text.strip() for name, text in texts.items() if text and text.strip()}


def _stored_bits(entries: _Entries) -> int:
    kind, bits = entries.found.get("Color Type", ""), entries.whole("Color Bit")
    if kind.lower() not in ("mono", "raw") or bits in (24, 30, 36, 48):
        raise FrameError(
            f'{entries.path} tells {bits} bit of colour type "{kind}": its samples are no longer the sensor\'s; save '
            "the movie as raw (Bayer) or monochrome"
        )
    if bits not in (8, 10, 12, 16):
        raise damaged(entries.path, f"it announces samples of {bits} bit; allowed are 8, 10, 12 and 16")
    return bits


def _shift(entries: _Entries, stored_bits: int, depth: int) -> int:
    """Bits of a stored sample below those that the camera's converter gave."""
    side = entries.found.get("EffectiveBit Side", "Lower").lower()
    if side not in ("lower", "higher", "upper") or not 8 <= depth <= 16:
        raise damaged(entries.path, f'it announces {depth} effective bits, "{side}"; allowed are lower and higher')
    if side == "lower" and depth > stored_bits:
        logger.warning("%s holds the lower %d of %d bits: brighter samples are lost", entries.path, stored_bits, depth)
    return 0 if side == "lower" else max(stored_bits - depth, 0)


def _recording(entries: _Entries, count: int, depth: int) -> Recording:
    """Frames count from the trigger, and every `step`-th is stored."""
    step = max(entries.whole("Save Step", 1), 1)
    first = entries.whole("Start Frame", 0) - entries.whole("Correct Trigger Frame", 0)
    rate, shutter = entries.number("Record Rate(fps)"), entries.number("Shutter Speed(s)")
    exposure = entries.number("Shutter Type2(nsec)") or (10**9 * shutter if shutter else None)
    return Recording(
        count=count,
        bit_depth=depth,
        frame_rate=None if rate is None else float(rate),
        exposure_ns=None if exposure is None else round(exposure),
        trigger=-first // step,
        times_ns=None if rate is None else _times_ns(range(first, first + count * step, step), rate, entries.path),
    )


def _times_ns(numbers: range, rate: Fraction, path: Path) -> Integers:
    try:
        return even_times(numbers, 1 / rate)
    except OverflowError:
        raise damaged(path, f"it announces frames up to number {numbers[-1]} at {float(rate)} per second") from None
