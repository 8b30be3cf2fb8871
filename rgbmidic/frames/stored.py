"""Samples as they are stored in a file, checked against what its header, the user and a calibration state of them.

First what readers share: limits of what is unpacked, frames at even distances, packed samples, the messages of C
libraries. Then the one place where the statements of file, user and calibration meet (`raw_frame`).
"""

from __future__ import annotations

import math
import os
import tempfile
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

import numpy as np

from rgbmidic.errors import FrameError, InputError, RgbmidicError, first_line
from rgbmidic.frames.data import ChannelFrame, Mosaic, Recording, shift_cfa
from rgbmidic.settings import BAYER_PATTERNS, FrameKind, FrameSettings
from rgbmidic.typing import AnyArray, FloatArray

# What readers share

MAXIMUM_BYTES = 2 * 2**30
"""Largest frame that is unpacked: 1 Gpx of 16 bit, where large sensors have 150 Mpx, or 400 Mpx by shifting."""

CHECKED_FROM, _COMPRESSION = 32 * 2**20, 100
"""Frames of more bytes than the first are refused when stored in less than their hundredth.

Deflate stores real frames of 8 bit in a quarter (coins in the dark, 4.1), pure noise of .3 DN on a black level of zero
in a seventeenth, but empty pictures, which bombs are, in a thousandth.
"""

MAXIMUM_FRAMES = 2_000_000
"""Most frames that a header may announce: a camera of 64 GB holds so many of 128x128 pixels of 16 bit."""


def damaged(path: Path, reason: object) -> FrameError:
    """Return the error for a file that cannot be read whole."""
    return FrameError(f"{path} is damaged or truncated: {reason}")


@contextmanager
def faults_of(path: Path, *passed: type[Exception]) -> Iterator[None]:
    """Turn what another library raises over a damaged file, in many kinds, into a FrameError; but for `passed`."""
    try:
        yield
    except Exception as error:
        if isinstance(error, (RgbmidicError, *passed)):
            raise
        raise damaged(path, first_line(error)) from None


def check_size(path: Path, *, needed: int, stored: int) -> None:
    """Refuse, before anything is unpacked, a header that announces more than a camera's frame.

    Parameters
    ----------
    path
        The file, for messages.
    needed
        Bytes of the unpacked samples.
    stored
        Bytes that they are stored in.

    Raises
    ------
    FrameError
        They exceed `MAXIMUM_BYTES`, or no frame of a camera can be compressed so much.
    """
    if max(needed, stored) > MAXIMUM_BYTES:
        size = f"{max(needed, stored) / 1e6:.0f} MB of samples; allowed are {MAXIMUM_BYTES / 1e6:.0f} MB"
        raise FrameError(f"{path} announces {size}")
    if needed > max(CHECKED_FROM, _COMPRESSION * stored):
        size = f"{needed / 1e6:.0f} MB of samples in {stored / 1e6:.3g} MB"
        raise FrameError(f"{path} announces {size}: no frame of a camera can be compressed so much")


def check_count(path: Path, count: int) -> None:
    """Refuse a header that announces no frames or more than a camera's.

    Raises
    ------
    FrameError
        So it does.
    """
    if not 1 <= count <= MAXIMUM_FRAMES:
        raise FrameError(f"{path} announces {count} frames; allowed are 1 to {MAXIMUM_FRAMES}")


def cut_short(path: Path, *, whole: int, count: int) -> FrameError:
    """Return the error for a frame behind the end of a file that holds only the first `whole` of its `count` frames."""
    where = f"after frame {whole - 1} of {count}" if whole else f"before the first frame of {count}"
    return FrameError(f"{path}: the file ends {where} (0 to {count - 1}): truncated or still being written")


def unpack_bits(packed: bytes | AnyArray, bits: int) -> AnyArray:
    """Unpack samples of 9 to 15 bits that follow one another without a gap, the highest bit of each first.

    Parameters
    ----------
    packed : bytes, or ndarray, shape (..., B), uint8
        Bytes; every line of an array begins with a sample of its own.
    bits
        Bits of a sample, an even number.

    Returns
    -------
    ndarray, shape (..., N), uint16
        Groups of samples that end with a byte: 5 bytes hold 4 samples of 10 bits, 3 two of 12, 7 four of 14. A line
        that ends within a group is filled up with zeros.
    """
    lines = np.frombuffer(packed, dtype=np.uint8) if isinstance(packed, bytes) else packed
    group = math.lcm(bits, 8)
    if missing := -lines.shape[-1] % (group // 8):
        lines = np.pad(lines, [*[(0, 0)] * (lines.ndim - 1), (0, missing)])
    groups = lines.reshape(*lines.shape[:-1], -1, group // 8)
    values = np.empty((*groups.shape[:-1], group // bits), dtype=np.uint16)
    for sample in range(group // bits):
        byte, begin = divmod(sample * bits, 8)
        over = -(begin + bits) % 8
        joined: AnyArray = groups[..., byte].astype(np.uint16 if begin + bits <= 16 else np.uint32)
        for part in range(byte + 1, byte + (begin + bits + over) // 8):
            joined = joined << 8 | groups[..., part]
        values[..., sample] = joined >> over & (2**bits - 1)
    return values.reshape(*lines.shape[:-1], -1)


BROKEN_JPEG = ("Corrupt JPEG data", "Premature end of JPEG file", "Inconsistent progression sequence")
"""How libjpeg's warnings begin (JWRN in its jerror.h) after which it goes on with invented samples."""

_LOCK = threading.Lock()


@contextmanager
def complaints(*starts: bytes) -> Iterator[list[str]]:
    """Collect what C libraries write to standard error: the lines with one of these starts.

    The list holds them afterwards; other lines (of threads) are passed on.

    Neither rawpy nor OpenCV lets the handlers of LibRaw and libpng be replaced, hence the redirection.
    """
    lines: list[str] = []
    with _LOCK, tempfile.TemporaryFile() as file:
        try:
            terminal = os.dup(2)
        except OSError:  # a program without standard error: nothing can reach the user
            yield lines
            return
        os.dup2(file.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(terminal, 2)
            file.seek(0)
            for line in file:
                if line.startswith(starts):
                    lines.append(line.decode(errors="replace").strip())
                elif line.strip():
                    os.write(terminal, line)
            os.close(terminal)


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredFrame:
    """The samples of one frame with what its file states; None where the file does not state it.

    Attributes
    ----------
    values : ndarray, shape (H, W) or (H, W, 3), uint8 or uint16
        Raw grey levels (DN); three channels are R, G, B. Empty in a header, which states the rest of all frames.
    kind
        ``"rgb"`` where the file has three channels; ``"bayer"`` or ``"monochrome"`` only where the file states it.
    cfa
        Bayer pattern valid for ``values[0, 0]``.
    black_level : ndarray, shape (2, 2), or None
        Black level (DN) of each position of the 2x2 cell.
    white_level
        Grey level (DN) of a saturated sample.
    bits
        Bits of a sample where they are fewer than those of its type.
    """

    values: AnyArray = field(default_factory=lambda: np.empty((0, 0), dtype=np.uint16))
    kind: FrameKind | None = None
    cfa: str | None = None
    black_level: FloatArray | None = None
    white_level: float | None = None
    bits: int | None = None

    @classmethod
    def plain(cls, values: AnyArray, path: Path, cfa: str | None = None) -> StoredFrame:
        """Return samples (H, W) or (H, W, C) of a picture that states neither levels nor, as a rule, its pattern.

        Parameters
        ----------
        values : ndarray, shape (H, W) or (H, W, C), uint8 or uint16
            Grey levels (DN).
        path
            The file, for messages.
        cfa
            Bayer pattern where the file states it.

        Returns
        -------
        StoredFrame

        Raises
        ------
        FrameError
            There are neither one nor three channels.
        """
        if values.ndim == 3 and values.shape[2] == 1:
            values = values[..., 0]
        if values.ndim == 2:
            return cls(values=values, kind="bayer" if cfa else None, cfa=cfa)
        if values.ndim != 3 or values.shape[2] != 3:
            raise FrameError(f"{path} has samples of shape {values.shape}; allowed are one channel or three (RGB)")
        return cls(values=values, kind="rgb")


@dataclass(frozen=True, slots=True, kw_only=True)
class MovieHeader(ABC):
    """What the header of a movie states of all its frames.

    Attributes
    ----------
    shape
        Rows and columns of every frame.
    recording
        Number, times and settings of the frames.
    """

    shape: tuple[int, int]
    recording: Recording = field(default_factory=Recording)

    @abstractmethod
    def read(self, path: Path, index: int, rows: range) -> StoredFrame:
        """Read some rows of a frame, the first of which is a whole multiple of 4."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvenFrames(MovieHeader):
    """Frames of one size that lie uncompressed at even distances in a file.

    Attributes
    ----------
    start
        Byte at which the first begins.
    gap
        Bytes from the end of one to the next.
    channels
        ``(3,)`` of colour pictures, whose samples lie pixel after pixel.
    stored_bits, order
        Bits in which a sample is stored, 8 or 16 in the byte order of numpy, else packed; `shift` of them lie below it.
    stated
        What the header states of every frame, without samples.
    oldest
        Place in the file of the frame that was recorded first.
    """

    start: int = 0
    gap: int = 0
    channels: tuple[int, ...] = ()
    stored_bits: int
    order: str = "<"
    shift: int = 0
    stated: StoredFrame = field(default_factory=StoredFrame)
    oldest: int = 0

    @property
    def size(self) -> int:
        """Bytes of the samples of a frame."""
        return math.prod((*self.shape, *self.channels)) * self.stored_bits // 8

    def begin(self, index: int) -> int:
        """Return the byte at which a frame begins."""
        return self.start + (index + self.oldest) % self.recording.count * (self.size + self.gap)

    def checked(self, path: Path) -> Self:
        """Return the header itself, unless it announces what no camera records, which is a FrameError."""
        check_count(path, self.recording.count)
        if self.gap < 0:
            raise damaged(path, f"its header announces frames of {self.size} bytes, {self.size + self.gap} apart")
        check_size(path, needed=self.size, stored=self.size)
        return self

    def noting_rest(self, size: int) -> Self:
        """Return the header with a remark where a file of `size` bytes goes on behind its frames."""
        if (rest := size - self.start - self.recording.count * (self.size + self.gap)) <= 0:
            return self
        remark = f"it has {rest} bytes more than the {self.recording.count} frames that its header announces"
        return replace(self, recording=replace(self.recording, remarks=(*self.recording.remarks, remark)))

    def read(self, path: Path, index: int, rows: range) -> StoredFrame:
        """Read some rows of a frame."""
        with path.open("rb") as file:
            begin, end = self.begin(index), file.seek(0, 2)
            if end < begin + self.size:
                whole = (end - self.start - self.size) // (self.size + self.gap) + 1
                raise cut_short(path, whole=max(whole, 0), count=self.recording.count)
            first, last = (self.size * row // self.shape[0] for row in (rows.start, rows.stop))
            file.seek(begin + first)
            content = file.read(last - first)
        if self.stored_bits in (8, 16):
            stored = np.dtype(f"{self.order}u{self.stored_bits // 8}")
            values = np.frombuffer(content, stored).astype(stored.newbyteorder("="), copy=False)
        else:
            values = unpack_bits(content, self.stored_bits)
        if self.shift:
            values = values >> self.shift
        return replace(self.stated, values=values.reshape(len(rows), -1, *self.channels))


class Camera(Protocol):
    """What is known of the camera that frames come from, as by a `Calibration`; None where it is not known."""

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def kinds(self) -> tuple[FrameKind, ...]:
        """The kinds of frames that it may be of."""

    @property
    def cfa(self) -> str | None:
        """Bayer pattern of the first pixels of its own frames."""

    @property
    def black_level(self) -> float | None:
        """Black level in DN, the mean over the positions."""

    @property
    def white_level(self) -> float | None:
        """White level in DN."""

    @property
    def shape(self) -> tuple[int, int] | None:
        """Rows and columns of its own frames."""


# Statements of the file, the user and a calibration

_T = TypeVar("_T")
_Statement = tuple[Path | str | None, _T | None]
"""Who states something, None for the user (in TEST.toml or an option), and what; None: nothing."""


def raw_frame(
    stored: StoredFrame,
    stated: FrameSettings,
    path: Path,
    camera: Camera | None = None,
    shape: tuple[int, int] | None = None,
) -> Mosaic | ChannelFrame:
    """Return the checked frame from what the file, the user and a calibration state.

    Every frame passes here, and nowhere else do the three meet: docs: test-file has the table. Each fills in what
    those before it leave open.

    Parameters
    ----------
    stored
        Samples, with what the file states.
    stated
        What the user states.
    path
        The file, for messages.
    camera
        What a calibration states.
    shape
        Rows and columns of the frame where `stored` is a part of it.

    Returns
    -------
    Mosaic or ChannelFrame

    Raises
    ------
    FrameError
        Two of them state something and do not agree, or something needed is stated by none.
    """
    shape = shape or (stored.values.shape[0], stored.values.shape[1])
    dtype = stated.dtype and np.dtype(stated.dtype).newbyteorder("=").name
    _agreed("shape", [(None, stated.shape), (path, shape)])
    _agreed("dtype", [(None, dtype), (path, stored.values.dtype.name)])
    known = camera.kinds if camera else ()
    if (stated.kind or (known[0] if len(known) == 1 else None)) in ("bayer", "monochrome") and stored.kind == "rgb":
        first = stored.values[..., :1]
        if (stored.values == first).all():  # one channel that was saved as three
            stored = StoredFrame(values=first[..., 0], bits=stored.bits)
        elif stated.kind == "monochrome":  # a colour picture under one white light
            stored = StoredFrame(values=stored.values[..., 1], bits=stored.bits)
    kind = _agreed("kind", [(None, stated.kind), (path, stored.kind)])
    if camera and kind and kind not in known:
        raise _differ("kind", (path if stated.kind is None else None, kind), (camera.name, " or ".join(known)))
    kind = kind or (*known, "bayer")[0]
    if (kind == "rgb") != (stored.values.ndim == 3):
        who = None if stated.kind or camera is None else camera.name
        channels = "one channel" if kind == "rgb" else "three"
        raise FrameError(f"{_sentence(who, 'kind', kind)}, but {path} has {channels}")
    if kind != "bayer" and stated.cfa is not None:
        reason = f"{path} is read as {kind}, which has no colour filter array"
        raise FrameError(f"cfa is stated as {stated.cfa}, but {reason}")
    cfa = _pattern(stored, stated, path, camera, shape) if kind == "bayer" else None
    white = _white_level(stored, stated, path, camera)
    black = _black_level(stored, stated, path, camera)
    try:
        if cfa is not None:
            return Mosaic(values=stored.values, cfa=cfa, black_level=black, white_level=white)
        values = np.moveaxis(np.atleast_3d(stored.values), -1, 0)
        return ChannelFrame(values=values, black_level=black.mean(), white_level=white)
    except InputError as error:
        raise FrameError(f"{path}: {error}") from None


def _agreed(name: str, statements: Sequence[_Statement[_T]]) -> _T | None:
    """Return what all statements that there are agree on."""
    there = [(who, value) for who, value in statements if value is not None]
    for first, second in combinations(there, 2):
        if first[1] != second[1]:
            raise _differ(name, first, second)
    return there[0][1] if there else None


def _differ(name: str, first: _Statement[Any], second: _Statement[Any]) -> FrameError:
    return FrameError(f"{_sentence(first[0], name, first[1])}, but {second[0]} states {_in_words(second[1])}")


def _sentence(who: Path | str | None, name: str, value: Any) -> str:
    return f"{name} is stated as {_in_words(value)}" if who is None else f"{who} states {name} {_in_words(value)}"


def _in_words(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return ", ".join(map(_in_words, (np.unique(value) if np.ptp(value) == 0 else value.ravel()).tolist()))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _white_level(stored: StoredFrame, stated: FrameSettings, path: Path, camera: Camera | None) -> float:
    statements: list[_Statement[float]] = [(None, stated.white_level), (path, stored.white_level)]
    statements += [(camera.name, camera.white_level)] if camera else []
    white = _agreed("white_level", statements)
    largest = float(2**stored.bits - 1 if stored.bits else np.iinfo(stored.values.dtype).max)
    if white is not None and white > largest:
        who = next(who for who, value in statements if value is not None)
        raise FrameError(f"{_sentence(who, 'white_level', white)}, but the samples of {path} end at {largest:.0f}")
    return largest if white is None else white


def _black_level(stored: StoredFrame, stated: FrameSettings, path: Path, camera: Camera | None) -> FloatArray:
    # a file's black levels differ by position, and LibRaw rounds some; less than a grey level (DN) is no contradiction
    tolerance = 1.0
    in_file, user, known = stored.black_level, stated.black_level, camera.black_level if camera else None
    if in_file is not None and user is not None and not (np.abs(in_file - user) < tolerance).all():
        raise _differ("black_level", (None, user), (path, in_file))
    if camera and known is not None:
        if user is not None and abs(user - known) >= tolerance:
            raise _differ("black_level", (None, user), (camera.name, known))
        if in_file is not None and abs(in_file.mean() - known) > tolerance:  # captures and frames may be rounded apart
            raise _differ("black_level", (path, in_file), (camera.name, known))
    level = next((value for value in (user, known) if value is not None), 0.0)
    return np.full((1, 1), level) if in_file is None else in_file


def _pattern(
    stored: StoredFrame, stated: FrameSettings, path: Path, camera: Camera | None, shape: tuple[int, int]
) -> str:
    """Return the Bayer pattern of a mosaic of `shape`; a camera's holds where the frames begin in its own."""
    known, who, origin = camera.cfa if camera else None, camera.name if camera else "", stated.crop_origin
    placed = origin is not None or camera is None or camera.shape in (None, shape)
    if known is not None and origin is not None:
        known, who = shift_cfa(known, origin[1], origin[0]), f"{who}, at frames.crop_origin = {list(origin)},"
    hint = "" if placed else "; if the camera cropped the frames, state frames.crop_origin = [x, y]"
    try:
        cfa = _agreed("cfa", [(None, stated.cfa), (path, stored.cfa), (who, known)])
    except FrameError as error:
        raise FrameError(f"{error}{hint}") from None
    if cfa is None or not (placed or stated.cfa or stored.cfa):
        raise FrameError(
            f"{path} does not state its colour filter array: state cfa ({', '.join(BAYER_PATTERNS)}), or kind "
            f'"monochrome" where the camera has none{hint}'
        )
    return cfa
