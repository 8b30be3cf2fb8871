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

from rgbmidic.errors import FrameError, InputError, damaged_file
from rgbmidic.frames.data import ChannelFrame, Mosaic, Recording, shift_cfa
from rgbmidic.settings import BAYER_PATTERNS, FrameKind, FrameSettings
from rgbmidic.typing import AnyArray, FloatArray

# What readers share

MAX_BYTES = 2 * 2**30
"""Largest frame that is unpacked: 1 Gpx of 16 bit, where large sensors have 150 Mpx, or 400 Mpx by shifting."""

CHECKED_BYTES, _COMPRESSION = 32 * 2**20, 100
"""Frames of more bytes than the first are refused when stored in less than their hundredth.

Deflate stores real frames of 8 bit in a quarter (coins in the dark, 4.1), pure noise of .3 DN on a black level of zero
in a seventeenth, but empty pictures, which bombs are, in a thousandth.
"""

MAX_FRAMES = 2_000_000
"""Most frames that a header may announce: a camera of 64 GB holds so many of 128x128 pixels of 16 bit."""


def check_size(path: Path, *, unpacked: int, stored: int) -> None:
    """Refuse, before anything is unpacked, a header that announces more than a camera's frame.

    Parameters
    ----------
    path
        The file, for messages.
    unpacked
        Bytes of the unpacked samples.
    stored
        Bytes that they are stored in.

    Raises
    ------
    FrameError
        They exceed `MAX_BYTES`, or no frame of a camera can be compressed so much.
    """
    if max(unpacked, stored) > MAX_BYTES:
        size = f"{max(unpacked, stored) / 1e6:.0f} MB of samples; allowed are {MAX_BYTES / 1e6:.0f} MB"
        raise FrameError(f"{path} announces {size}")
    if unpacked > max(CHECKED_BYTES, _COMPRESSION * stored):
        size = f"{unpacked / 1e6:.0f} MB of samples in {stored / 1e6:.3g} MB"
        raise FrameError(f"{path} announces {size}: no frame of a camera can be compressed so much")


def check_count(path: Path, count: int) -> None:
    """Refuse a header that announces no frames or more than a camera's.

    Raises
    ------
    FrameError
        So it does.
    """
    if not 1 <= count <= MAX_FRAMES:
        raise FrameError(f"{path} announces {count} frames; allowed are 1 to {MAX_FRAMES}")


def truncated_file(path: Path, *, n_complete: int, count: int) -> FrameError:
    """Return the error for a frame behind the end of a file that holds only `n_complete` of `count` frames."""
    position = f"after frame {n_complete - 1} of {count}" if n_complete else f"before the first frame of {count}"
    return FrameError(f"{path}: the file ends {position} (0 to {count - 1}): truncated or still being written")


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
        n_below = -(begin + bits) % 8
        bits_read: AnyArray = groups[..., byte].astype(np.uint16 if begin + bits <= 16 else np.uint32)
        for following in range(byte + 1, byte + (begin + bits + n_below) // 8):
            bits_read = bits_read << 8 | groups[..., following]
        values[..., sample] = bits_read >> n_below & (2**bits - 1)
    return values.reshape(*lines.shape[:-1], -1)


BROKEN_JPEG = ("Corrupt JPEG data", "Premature end of JPEG file", "Inconsistent progression sequence")
"""Beginnings of libjpeg's warnings (JWRN in its jerror.h) after which it goes on with invented samples."""

_LOCK = threading.Lock()


@contextmanager
def captured_stderr(*prefixes: bytes) -> Iterator[list[str]]:
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
                if line.startswith(prefixes):
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

    Examples
    --------
    >>> StoredFrame(values=np.zeros((40, 60), dtype=np.uint16), bits=12).bits
    12
    """

    values: AnyArray = field(default_factory=lambda: np.empty((0, 0), dtype=np.uint16))
    kind: FrameKind | None = None
    cfa: str | None = None
    black_level: FloatArray | None = None
    white_level: float | None = None
    bits: int | None = None

    @classmethod
    def from_samples(cls, values: AnyArray, path: Path, cfa: str | None = None) -> StoredFrame:
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
    """Header of a movie: the properties that all its frames share.

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
    metadata
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
    metadata: StoredFrame = field(default_factory=StoredFrame)
    oldest: int = 0

    @property
    def size(self) -> int:
        """Bytes of the samples of a frame."""
        return math.prod((*self.shape, *self.channels)) * self.stored_bits // 8

    def frame_offset(self, index: int) -> int:
        """Return the byte at which a frame begins."""
        return self.start + (index + self.oldest) % self.recording.count * (self.size + self.gap)

    def require_plausible(self, path: Path) -> Self:
        """Return the header itself, unless it announces what no camera records, which is a FrameError."""
        check_count(path, self.recording.count)
        if self.gap < 0:
            raise damaged_file(path, f"its header announces frames of {self.size} bytes, {self.size + self.gap} apart")
        check_size(path, unpacked=self.size, stored=self.size)
        return self

    def with_rest_noted(self, size: int) -> Self:
        """Return the header with a remark where a file of `size` bytes goes on behind its frames."""
        if (n_extra := size - self.start - self.recording.count * (self.size + self.gap)) <= 0:
            return self
        remark = f"it has {n_extra} bytes more than the {self.recording.count} frames that its header announces"
        return replace(self, recording=replace(self.recording, remarks=(*self.recording.remarks, remark)))

    def read(self, path: Path, index: int, rows: range) -> StoredFrame:
        """Read some rows of a frame."""
        with path.open("rb") as file:
            begin, end = self.frame_offset(index), file.seek(0, 2)
            if end < begin + self.size:
                n_complete = (end - self.start - self.size) // (self.size + self.gap) + 1
                raise truncated_file(path, n_complete=max(n_complete, 0), count=self.recording.count)
            first, last = (self.size * row // self.shape[0] for row in (rows.start, rows.stop))
            file.seek(begin + first)
            content = file.read(last - first)
        if self.stored_bits in (8, 16):
            dtype = np.dtype(f"{self.order}u{self.stored_bits // 8}")
            values = np.frombuffer(content, dtype).astype(dtype.newbyteorder("="), copy=False)
        else:
            values = unpack_bits(content, self.stored_bits)
        if self.shift:
            values = values >> self.shift
        return replace(self.metadata, values=values.reshape(len(rows), -1, *self.channels))


class CameraMetadata(Protocol):
    """Properties of the camera that frames come from, as a `Calibration` states them; None where unknown."""

    @property
    def name(self) -> str:
        """Name of the camera in messages."""

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
    user_metadata: FrameSettings,
    path: Path,
    camera: CameraMetadata | None = None,
    shape: tuple[int, int] | None = None,
) -> Mosaic | ChannelFrame:
    """Return the checked frame from what the file, the user and a calibration state.

    Every frame passes here, and nowhere else do the three meet: docs: test-file has the table. Each fills in what
    those before it leave open.

    Parameters
    ----------
    stored
        Samples, with what the file states.
    user_metadata
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
    dtype = user_metadata.dtype and np.dtype(user_metadata.dtype).newbyteorder("=").name
    _common_value("shape", [(None, user_metadata.shape), (path, shape)])
    _common_value("dtype", [(None, dtype), (path, stored.values.dtype.name)])
    kinds = camera.kinds if camera else ()
    if (user_metadata.kind or (kinds[0] if len(kinds) == 1 else None)) in (
        "bayer",
        "monochrome",
    ) and stored.kind == "rgb":
        first = stored.values[..., :1]
        if (stored.values == first).all():  # one channel that was saved as three
            stored = StoredFrame(values=first[..., 0], bits=stored.bits)
        elif user_metadata.kind == "monochrome":  # a colour picture under one white light
            stored = StoredFrame(values=stored.values[..., 1], bits=stored.bits)
    kind = _common_value("kind", [(None, user_metadata.kind), (path, stored.kind)])
    if camera and kind and kind not in kinds:
        raise _contradiction(
            "kind", (path if user_metadata.kind is None else None, kind), (camera.name, " or ".join(kinds))
        )
    kind = kind or (*kinds, "bayer")[0]
    if (kind == "rgb") != (stored.values.ndim == 3):
        source = None if user_metadata.kind or camera is None else camera.name
        channels = "one channel" if kind == "rgb" else "three"
        raise FrameError(f"{_sentence(source, 'kind', kind)}, but {path} has {channels}")
    if kind != "bayer" and user_metadata.cfa is not None:
        reason = f"{path} is read as {kind}, which has no colour filter array"
        raise FrameError(f"cfa is stated as {user_metadata.cfa}, but {reason}")
    cfa = _pattern(stored, user_metadata, path, camera, shape) if kind == "bayer" else None
    white = _white_level(stored, user_metadata, path, camera)
    black = _black_level(stored, user_metadata, path, camera)
    try:
        if cfa is not None:
            return Mosaic(values=stored.values, cfa=cfa, black_level=black, white_level=white)
        values = np.moveaxis(np.atleast_3d(stored.values), -1, 0)
        return ChannelFrame(values=values, black_level=black.mean(), white_level=white)
    except InputError as error:
        raise FrameError(f"{path}: {error}") from None


def _common_value(name: str, statements: Sequence[_Statement[_T]]) -> _T | None:
    """Return what all statements that there are agree on."""
    stated_values = [(source, value) for source, value in statements if value is not None]
    for first, second in combinations(stated_values, 2):
        if first[1] != second[1]:
            raise _contradiction(name, first, second)
    return stated_values[0][1] if stated_values else None


def _contradiction(name: str, first: _Statement[Any], second: _Statement[Any]) -> FrameError:
    return FrameError(f"{_sentence(first[0], name, first[1])}, but {second[0]} states {_in_words(second[1])}")


def _sentence(source: Path | str | None, name: str, value: Any) -> str:
    return f"{name} is stated as {_in_words(value)}" if source is None else f"{source} states {name} {_in_words(value)}"


def _in_words(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return ", ".join(map(_in_words, (np.unique(value) if np.ptp(value) == 0 else value.ravel()).tolist()))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _white_level(stored: StoredFrame, user_metadata: FrameSettings, path: Path, camera: CameraMetadata | None) -> float:
    statements: list[_Statement[float]] = [(None, user_metadata.white_level), (path, stored.white_level)]
    statements += [(camera.name, camera.white_level)] if camera else []
    white = _common_value("white_level", statements)
    largest = float(2**stored.bits - 1 if stored.bits else np.iinfo(stored.values.dtype).max)
    if white is not None and white > largest:
        source = next(source for source, value in statements if value is not None)
        raise FrameError(f"{_sentence(source, 'white_level', white)}, but the samples of {path} end at {largest:.0f}")
    return largest if white is None else white


def _black_level(
    stored: StoredFrame, user_metadata: FrameSettings, path: Path, camera: CameraMetadata | None
) -> FloatArray:
    # a file's black levels differ by position, and LibRaw rounds some; less than a grey level (DN) is no contradiction
    tolerance = 1.0
    file_level = stored.black_level
    user_level = user_metadata.black_level
    calibrated = camera.black_level if camera else None
    if file_level is not None and user_level is not None and not (np.abs(file_level - user_level) < tolerance).all():
        raise _contradiction("black_level", (None, user_level), (path, file_level))
    if camera and calibrated is not None:
        if user_level is not None and abs(user_level - calibrated) >= tolerance:
            raise _contradiction("black_level", (None, user_level), (camera.name, calibrated))
        if (
            file_level is not None and abs(file_level.mean() - calibrated) > tolerance
        ):  # captures and frames may be rounded apart
            raise _contradiction("black_level", (path, file_level), (camera.name, calibrated))
    level = next((value for value in (user_level, calibrated) if value is not None), 0.0)
    return np.full((1, 1), level) if file_level is None else file_level


def _pattern(
    stored: StoredFrame, user_metadata: FrameSettings, path: Path, camera: CameraMetadata | None, shape: tuple[int, int]
) -> str:
    """Return the Bayer pattern of a mosaic of `shape`; a camera's holds where the frames begin in its own."""
    calibrated = camera.cfa if camera else None
    source = camera.name if camera else ""
    origin = user_metadata.crop_origin
    is_located = origin is not None or camera is None or camera.shape in (None, shape)
    if calibrated is not None and origin is not None:
        calibrated = shift_cfa(calibrated, origin[1], origin[0])
        source = f"{source}, at frames.crop_origin = {list(origin)},"
    hint = "" if is_located else "; if the camera cropped the frames, state frames.crop_origin = [x, y]"
    try:
        cfa = _common_value("cfa", [(None, user_metadata.cfa), (path, stored.cfa), (source, calibrated)])
    except FrameError as error:
        raise FrameError(f"{error}{hint}") from None
    if cfa is None or not (is_located or user_metadata.cfa or stored.cfa):
        raise FrameError(
            f"{path} does not state its colour filter array: state cfa ({', '.join(BAYER_PATTERNS)}), or kind "
            f'"monochrome" where the camera has none{hint}'
        )
    return cfa
