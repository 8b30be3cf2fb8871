"""Description of the pages in a TIFF file: ImageJ's hyperstacks, OME-TIFF, tifffile's own.

The times of a test are one axis of a hyperstack; its channels and slices are planes of one time, such as images of
several lights. A file that has slices or channels alone, as ImageJ imports sequences and tifffile writes stacks, has
them in time.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Self
from xml.etree import ElementTree

import numpy as np

from rgbmidic.frames.data import SECOND, Integers, even_times, parse_fraction

_UNITS = {"s": 1, "sec": 1, "seconds": 1}
_UNITS |= {"ms": 10**3, "msec": 10**3, "µs": 10**6, "us": 10**6, "usec": 10**6, "ns": SECOND}
"""Units of time, by their number in a second."""
_Plane = tuple[int, int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Hyperstack:
    """Axes of the pages of a file.

    Attributes
    ----------
    sizes
        Number of times, slices and channels.
    order
        Axes of the pages, the slowest first, as in ``"TZC"``.
    interval
        Seconds from one time to the next.
    plane_times, pages
        Seconds of the planes that have a time, and pages of those that state theirs, by (time, slice, channel).
    by_imagej
        Whether ImageJ wrote it, which stores more than 4 GB behind one page.
    """

    sizes: tuple[int, int, int]
    order: str = "TZC"
    interval: Fraction | None = None
    plane_times: Mapping[_Plane, Fraction] = field(default_factory=dict)
    pages: Mapping[_Plane, int] = field(default_factory=dict)
    by_imagej: bool = False

    @classmethod
    def parse(cls, text: str, page_samples: int) -> Self | None:
        """Return what the text of a file states whose pages have so many samples; None where it is none of these."""
        if text.startswith("ImageJ="):
            return cls._from_imagej(text)
        if "<OME" in text[:1000] and "<!ENTITY" not in text:
            return cls._from_ome(text)
        if text.startswith('{"shape": ['):
            return cls._from_tifffile(text, page_samples)
        return None

    @property
    def count(self) -> int:
        """Number of planes."""
        return math.prod(self.sizes)

    @property
    def has_times(self) -> bool:
        """True where its planes are those of several times."""
        return self.sizes[0] > 1

    @property
    def planes(self) -> int:
        """Number of planes of one time."""
        times, slices, channels = self.sizes
        return slices * channels if times > 1 else channels if slices > 1 else 1

    @property
    def planes_description(self) -> str:
        """Description of the planes of one time."""
        _, slices, channels = self.sizes
        words = [f"{channels} channels"] * (channels > 1) + [f"{slices} slices"] * (slices > 1 and self.has_times)
        return " of ".join(words)

    @property
    def page_order(self) -> list[int]:
        """Index of the page that holds each plane, time after time."""
        if self.order == "TZC" and not self.pages:
            return list(range(self.count))
        axes = ["TZC".index(axis) for axis in self.order]
        pages = np.arange(self.count).reshape([self.sizes[axis] for axis in axes]).transpose(np.argsort(axes))
        planes = np.ndindex(self.sizes)
        return [self.pages.get(plane, page) for plane, page in zip(planes, pages.ravel().tolist(), strict=True)]

    @property
    def times_ns(self) -> Integers | None:
        """Time of each plane in ns; None where not all are stated, or more than 292 years lie between them."""
        stamps = self.plane_times
        if not self.has_times or not (self.interval or stamps):
            return None
        try:
            if self.interval:
                return np.repeat(even_times(range(self.sizes[0]), self.interval), self.planes)
            seconds = [stamps.get(plane) or stamps[plane[0], 0, 0] for plane in np.ndindex(self.sizes)]
            return np.array([round(time * SECOND) for time in seconds], dtype=np.int64)
        except (OverflowError, KeyError):
            return None

    @classmethod
    def _from_imagej(cls, text: str) -> Self | None:
        entries = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
        images, channels, slices, frames = (
            int(entries[name]) if re.fullmatch("[0-9]{1,9}", entries.get(name, "")) else 0
            for name in ("images", "channels", "slices", "frames")
        )
        sizes = (frames or 1, slices or 1, channels or 1)
        if math.prod(sizes) == 1 < images:  # neither axis is stated
            sizes = (images, 1, 1)
        interval = _seconds(entries.get("finterval", ""), entries.get("tunit", "s"))
        if not images or math.prod(sizes) != images:
            sizes, interval = (1, images or 1, 1), None
        return cls(sizes=sizes, interval=interval, by_imagej=True)

    @classmethod
    def _from_ome(cls, text: str) -> Self | None:
        try:
            pixels = ElementTree.fromstring(text.encode()).find(".//{*}Pixels")
        except ElementTree.ParseError:
            return None
        order = "" if pixels is None else pixels.get("DimensionOrder", "XYCZT")[2:]
        if pixels is None or sorted(order) != ["C", "T", "Z"]:
            return None
        numbers = [_parse_count(pixels.get(f"Size{axis}", "1")) for axis in "TZC"]
        samples = [_parse_count(channel.get("SamplesPerPixel", "1")) for channel in pixels.iterfind("{*}Channel")]
        if len(samples) and sum(samples) == numbers[2]:  # colours lie in one plane
            numbers[2] = len(samples)
        if not all(numbers):
            return None
        interval = _seconds(pixels.get("TimeIncrement", ""), pixels.get("TimeIncrementUnit", "s"))
        stamps = {
            _position(plane, "The"): time
            for plane in pixels.iterfind("{*}Plane")
            if (time := _seconds(plane.get("DeltaT", ""), plane.get("DeltaTUnit", "s"))) is not None
        }
        elements = (
            element
            for element in pixels.iterfind("{*}TiffData")
            if element.get("PlaneCount", "1") == "1" and element.get("IFD")
        )
        pages = {_position(element, "First"): _parse_count(element.get("IFD", "")) for element in elements}
        sizes = (numbers[0], numbers[1], numbers[2])
        return cls(sizes=sizes, order=order[::-1], interval=interval, plane_times=stamps, pages=pages)

    @classmethod
    def _from_tifffile(cls, text: str, page_samples: int) -> Self | None:
        try:
            pages, remainder = divmod(math.prod(map(int, json.loads(text)["shape"])), page_samples)
        except (ValueError, TypeError, KeyError, ArithmeticError, RecursionError):
            return None
        return cls(sizes=(1, pages, 1)) if remainder == 0 < pages else None


def _parse_count(text: str) -> int:
    return int(text) if re.fullmatch("[0-9]{1,9}", text) else 0


def _position(element: ElementTree.Element[Any], prefix: str) -> _Plane:
    t, z, c = (_parse_count(element.get(prefix + axis, "0")) for axis in "TZC")
    return t, z, c


def _seconds(text: str, unit: str) -> Fraction | None:
    number = parse_fraction(text)
    return None if number is None or unit not in _UNITS else number / _UNITS[unit]
