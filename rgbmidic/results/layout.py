"""One frame's record as bytes: a head with the checksum of every quantity, then the quantities themselves.

The head holds, as unsigned 32-bit numbers, the CRC-32 of each quantity and, of each quantity that is not stackable, its
shape and its size in bytes. What has one shape in all frames follows raw, the smallest first; then what has not: texts
as JSON, pictures packed by zlib, other arrays raw. All numbers are little-endian.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, takewhile
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from rgbmidic.errors import ResultError
from rgbmidic.results.quantities import QUANTITIES, Quantity

__all__ = ["RecordLayout"]

_AHEAD = 1024
"""Bytes read where one quantity is asked for: head and plain numbers lie in them."""
_FAST = 1
"""zlib's quickest level."""

_NUMBER = struct.Struct("<I")
_RATIO = 1032
"""How many times its size packed content can have at most (zlib's technical details, "Maximum Compression Factor")."""


class _Fixed(NamedTuple):
    """Where a quantity lies that has one shape in all frames: first byte, size, checksum in the head, type, shape."""

    first: int
    size: int
    check: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]


class _Open(NamedTuple):
    """Where the head tells of another quantity: its checksum, its shape, its size in bytes."""

    check: int
    shape: range
    size: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordLayout:
    """Where each quantity of a record lies.

    Attributes
    ----------
    sizes
        Number of nodes (``"node"``) and of lights (``"light"``) of every frame.
    head
        Bytes of the head.
    fixed, open
        The quantities in the order in which they lie: those of one shape in all frames, then the others.
    length
        Bytes of head and fixed quantities.
    """

    sizes: Mapping[str, int]
    head: int
    fixed: Mapping[str, _Fixed]
    open: Mapping[str, _Open]
    length: int

    @classmethod
    def of(cls, sizes: Mapping[str, int]) -> RecordLayout:
        """The layout of records with these sizes."""
        blank = {name: entry.unmeasured(sizes) for name, entry in QUANTITIES.items() if entry.stackable}
        fixed, count, open_ = sorted(blank, key=lambda name: blank[name].nbytes), len(QUANTITIES), {}
        for check, name in enumerate((name for name in QUANTITIES if name not in blank), start=len(fixed)):
            axes = len(QUANTITIES[name].axes)
            open_[name] = _Open(check, range(count, count + axes), count + axes)
            count += axes + 1
        head = count * _NUMBER.size
        sums = accumulate((blank[name].nbytes for name in fixed), initial=head)
        places = {
            name: _Fixed(first, blank[name].nbytes, check, _stored(QUANTITIES[name]), blank[name].shape)
            for check, (name, first) in enumerate(zip(fixed, sums, strict=False))
        }
        length = head + sum(one.size for one in places.values())
        return cls(sizes=dict(sizes), head=head, fixed=places, open=open_, length=length)

    def encode(self, values: Mapping[str, Any]) -> tuple[bytes, int]:
        """A record's bytes, and the checksum of its head."""
        parts = [np.asarray(values[name], dtype=one.dtype).tobytes() for name, one in self.fixed.items()]
        packed = {name: _packed(QUANTITIES[name], values[name]) for name in self.open}
        parts += packed.values()
        numbers = [zlib.crc32(part) for part in parts]
        for name, part in packed.items():
            numbers += [*np.shape(values[name]), len(part)]
        head = struct.pack(f"<{len(numbers)}I", *numbers)
        return b"".join([head, *parts]), zlib.crc32(head)

    def decode(
        self, file: BinaryIO, start: int, length: int, check: int, names: Iterable[str] | None = None
    ) -> dict[str, Any]:
        """The named quantities (None: all) of the record at `start` of a file, every checksum verified.

        Raises
        ------
        ResultError
            The record is damaged, or has other sizes.
        """
        file.seek(start)
        block = file.read(length if names is None or length < _AHEAD else _AHEAD)
        if length < self.length or zlib.crc32(block[: self.head]) != check:
            raise ResultError("its head is damaged, or of another mesh or other lights")
        values = {}
        for name in (*self.fixed, *self.open) if names is None else names:
            first, size = self._place(name, block)
            if first + size <= len(block):
                part = block[first : first + size]
            else:
                file.seek(start + first)
                part = file.read(min(size, length))
            values[name] = self._value(name, block, part)
        return values

    def _place(self, name: str, head: bytes) -> tuple[int, int]:
        """First byte and size of a quantity."""
        if name in self.fixed:
            return self.fixed[name][:2]
        before = takewhile(lambda other: other != name, self.open)
        first = self.length + sum(_number(head, self.open[other].size) for other in before)
        return first, _number(head, self.open[name].size)

    def _value(self, name: str, head: bytes, part: bytes) -> Any:
        fixed = self.fixed.get(name)
        if zlib.crc32(part) != _number(head, (fixed or self.open[name]).check):
            raise ResultError(f"the checksum of {name} is wrong")
        entry = QUANTITIES[name]
        if fixed is None:
            shape = [_number(head, place) for place in self.open[name].shape]
            return entry.convert(_unpacked(entry, part, shape), self.sizes)
        array = np.frombuffer(part, dtype=fixed.dtype)
        return array.reshape(fixed.shape).astype(entry.dtype) if fixed.shape else array.item()


def _number(head: bytes, place: int) -> int:
    number: int = _NUMBER.unpack_from(head, _NUMBER.size * place)[0]
    return number


def _stored(entry: Quantity) -> np.dtype[Any]:
    return np.dtype(entry.dtype).newbyteorder("<")


def _packed(entry: Quantity, value: Any) -> bytes:
    if entry.dtype is np.str_:
        return json.dumps(np.asarray(value).tolist()).encode("ascii")
    raw = np.asarray(value, dtype=_stored(entry)).tobytes()
    return zlib.compress(raw, _FAST) if entry.dtype is np.uint8 else raw


def _unpacked(entry: Quantity, part: bytes, shape: Sequence[int]) -> Any:
    """What `_packed` packed; what a head promises beyond that is an error before it is memory."""
    if entry.dtype is np.str_:
        return np.array(json.loads(part), dtype=np.str_).reshape(shape)
    promised = math.prod(shape) * _stored(entry).itemsize
    if entry.dtype is np.uint8:
        part = zlib.decompressobj().decompress(part, min(promised, _RATIO * len(part)) + 1)
    if len(part) != promised:
        raise ResultError(f"the head promises {promised} bytes of {entry.name}, there are {len(part)}")
    return np.frombuffer(part, dtype=_stored(entry)).reshape(shape).astype(entry.dtype)
