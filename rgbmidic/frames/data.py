"""Raw frames as the camera recorded them, the first step of docs: conventions, and how and when it recorded them."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from rgbmidic.arguments import check_fields
from rgbmidic.errors import InputError
from rgbmidic.renamed import state_new_names
from rgbmidic.settings import BAYER_PATTERNS
from rgbmidic.typing import FloatArray

SECOND = 10**9
"""Nanoseconds in a second."""


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """The part of a frame that is read and worked on.

    Attributes
    ----------
    origin
        Its first column and row.
    shape
        Its rows and columns.
    frame
        Rows and columns of the frame.
    is_whole
        True where it is all of the frame.

    Examples
    --------
    >>> window = Window.of_frame((40, 60))
    >>> window.origin, window.is_whole
    ((0, 0), True)
    """

    origin: tuple[int, int]
    shape: tuple[int, int]
    frame: tuple[int, int]
    is_whole: bool = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Compare the shapes."""
        object.__setattr__(self, "is_whole", self.shape == self.frame)

    @classmethod
    def of_frame(cls, frame: tuple[int, int]) -> Window:
        """Return the window that is all of a frame.

        Parameters
        ----------
        frame
            Rows and columns of the frame.

        Returns
        -------
        Window
        """
        return cls(origin=(0, 0), shape=frame, frame=frame)

    @classmethod
    def around_points(cls, points: FloatArray, margin: float, frame: tuple[int, int]) -> Window:
        """Return what lies within `margin` px of points (N, 2) in x and y, and little more.

        Parameters
        ----------
        points : ndarray, shape (N, 2)
            Points (x, y) of the frame, px.
        margin
            Distance from them, px.
        frame
            Rows and columns of the frame.

        Returns
        -------
        Window
        """
        # of whole multiples: a mosaic's pattern, packed samples of 10 bit (4 rows) and the blocks of the separation (at
        # most 16 px) then lie as in the whole frame
        size, grid = np.array(frame[::-1]), 32
        low = np.clip(np.floor(points.min(axis=0) - margin), 0, size - 1).astype(int) // grid * grid
        last = np.clip(np.ceil(points.max(axis=0) + margin), low, size - 1).astype(int)
        high = np.minimum((last // grid + 1) * grid, size)
        (first_column, first_row), (columns, rows) = low.tolist(), (high - low).tolist()
        return cls(origin=(first_column, first_row), shape=(rows, columns), frame=frame)

    def slices_in(self, outer: Window) -> tuple[slice, slice]:
        """Return where it lies, rows and columns, in a window that holds all of it.

        Parameters
        ----------
        outer
            Window that holds all of this one.

        Returns
        -------
        rows, columns : slice
        """
        (first_column, first_row), (x, y), (rows, columns) = self.origin, outer.origin, self.shape
        return slice(first_row - y, first_row - y + rows), slice(first_column - x, first_column - x + columns)


def cfa_channels(cfa: str) -> npt.NDArray[np.intp]:
    """Return the channel index (R 0, G 1, B 2) of each position of the 2x2 cell of a Bayer pattern.

    Parameters
    ----------
    cfa
        One of `BAYER_PATTERNS`; upper or lower case.

    Returns
    -------
    ndarray, shape (2, 2)
        ``channels[row % 2, column % 2]`` is the channel sampled at that pixel.

    Raises
    ------
    InputError
        The name is not a Bayer pattern.

    Examples
    --------
    >>> cfa_channels("RGGB").tolist()
    [[0, 1], [1, 2]]
    """
    name = cfa.upper() if isinstance(cfa, str) else ""
    if name not in BAYER_PATTERNS:
        raise InputError(f"unknown colour filter array {cfa!r}; allowed are {', '.join(BAYER_PATTERNS)}")
    return np.array(["RGB".index(letter) for letter in name], dtype=np.intp).reshape(2, 2)


def sampled_channels(cfa: str, shape: tuple[int, ...]) -> npt.NDArray[np.intp]:
    """Return the channel index (H, W) that a mosaic of `shape` samples at each pixel."""
    rows, columns = shape
    return np.tile(cfa_channels(cfa), (-(-rows // 2), -(-columns // 2)))[:rows, :columns]


def shift_cfa(cfa: str, rows: int, columns: int) -> str:
    """Return the Bayer pattern seen after the first rows and columns are cropped away.

    Parameters
    ----------
    cfa
        One of `BAYER_PATTERNS`.
    rows, columns
        How many are cropped away.

    Returns
    -------
    str
        One of `BAYER_PATTERNS`.

    Examples
    --------
    >>> shift_cfa("RGGB", 1, 0)
    'GBRG'
    """
    cell = np.array(list(cfa.upper())).reshape(2, 2)
    return "".join(np.roll(cell, (-rows, -columns), axis=(0, 1)).ravel())


@dataclass(frozen=True, slots=True, kw_only=True)
class Mosaic:
    """One raw frame behind a Bayer colour filter array.

    Attributes
    ----------
    values : ndarray, shape (H, W), uint16
        Raw grey levels (DN).
    cfa : str
        One of `BAYER_PATTERNS`, valid for ``values[0, 0]``.
    black_level : ndarray, shape (2, 2), float64
        Black level (DN) of each position of the 2x2 cell.
    white_level : float
        Smallest grey level (DN) that counts as saturated.

    Examples
    --------
    >>> values = np.full((40, 60), 100, dtype=np.uint16)
    >>> Mosaic(values=values, cfa="RGGB", black_level=16, white_level=4095).black_level.tolist()
    [[16.0, 16.0], [16.0, 16.0]]
    """

    values: npt.NDArray[np.uint16]
    cfa: str
    black_level: FloatArray
    white_level: float

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        check_fields(self)
        values = np.asarray(self.values)
        if values.ndim != 2:
            raise InputError(f"a mosaic is one (H, W) image, not an array of shape {values.shape}")
        cfa_channels(self.cfa)
        object.__setattr__(self, "cfa", self.cfa.upper())
        _convert(self, (2, 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelFrame:
    """One frame with all its channels at every pixel: monochrome (1 channel) or 3-CCD colour (3 channels).

    Attributes
    ----------
    values : ndarray, shape (C, H, W), uint16
        Raw grey levels (DN).
    black_level : ndarray, shape (C,), float64
        Black level (DN) of each channel.
    white_level : float
        Smallest grey level (DN) that counts as saturated.

    Examples
    --------
    >>> values = np.full((3, 40, 60), 100, dtype=np.uint16)
    >>> ChannelFrame(values=values, black_level=np.zeros(3), white_level=4095.0).values.shape
    (3, 40, 60)
    """

    values: npt.NDArray[np.uint16]
    black_level: FloatArray
    white_level: float

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        check_fields(self)
        values = np.asarray(self.values)
        if values.ndim != 3 or values.shape[0] not in (1, 3):
            raise InputError(f"a channel frame has shape (1 or 3, H, W), not {values.shape}")
        _convert(self, values.shape[:1])


def _convert(frame: Mosaic | ChannelFrame, levels: tuple[int, ...]) -> None:
    """Convert a frame to its types, black levels to the shape `levels`; refuse values and levels that cannot be."""
    black, white = np.asarray(frame.black_level, dtype=np.float64), frame.white_level
    try:
        black = np.broadcast_to(black, levels).copy()
    except ValueError:
        raise InputError(f"black levels are one or of shape {levels}, not {black.shape}") from None
    if frame.values.dtype != np.uint16 and not ((frame.values >= 0) & (frame.values < 2**16)).all():
        raise InputError("raw grey levels are whole numbers from 0 to 65535")
    if not (np.isfinite(black).all() and np.isfinite(white) and black.min() >= 0 and white > black.max()):
        raise InputError(
            f"black and white level must be finite with 0 <= black < white; given are black {black.tolist()}, "
            f"white {white}"
        )
    object.__setattr__(frame, "values", np.ascontiguousarray(frame.values, dtype=np.uint16))
    object.__setattr__(frame, "black_level", black)
    object.__setattr__(frame, "white_level", float(white))


def colour_planes(frame: Mosaic | ChannelFrame) -> tuple[tuple[str, ...], list[npt.NDArray[np.uint16]], FloatArray]:
    """Return the colour planes of a frame: their names, their samples and their black levels.

    Parameters
    ----------
    frame
        A mosaic gives its four planes (H/2, W/2) as views in the order R, G1, G2, B; the last row or column of an odd
        frame is left out. A 3-CCD frame gives R, G, B; a monochrome frame M.
    """
    if isinstance(frame, ChannelFrame):
        names = ("R", "G", "B") if len(frame.values) == 3 else ("M",)
        return names, list(frame.values), frame.black_level
    height, width = (side - side % 2 for side in frame.values.shape)
    order = np.argsort(cfa_channels(frame.cfa).ravel(), kind="stable")
    values = frame.values[:height, :width]
    planes = [values[position // 2 :: 2, position % 2 :: 2] for position in order]
    return ("R", "G1", "G2", "B"), planes, frame.black_level.ravel()[order]


Integers = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """Number, times and settings of the frames of a file; None where it does not state them.

    Attributes
    ----------
    count
        Number of frames.
    bit_depth
        Bits that the camera's converter gave a sample.
    frame_rate
        Frames per second, as the camera was set.
    exposure_ns
        Time in ns that each frame collects light.
    trigger
        Index of the frame at the trigger; it may lie before the first or behind the last.
    times_ns : ndarray, shape (count,), int64, or None
        When each frame was taken, in ns from the trigger. Whole numbers: as seconds since an epoch, in double precision
        they would be off by a quarter of a frame at a million frames a second.
    numbers : ndarray, shape (count,), int64, or None
        The camera's own numbers, with gaps where frames are lost.
    saved_every
        Of how many frames that the camera took one is in the file, as the file states.
    planes
        Number of frames that belong to one time, such as the channels of a hyperstack, each an image of one light.
    planes_description
        What these are.
    count_is_certain
        Whether the file holds no other frames: False where the list of them leads out of it.
    remarks
        What else in the header a user should know. Times that do not rise from frame to frame are left out, with a
        remark; so is one made of a frame rate that is not theirs.

    Examples
    --------
    >>> Recording(count=3, frame_rate=100_000.0).count
    3
    """

    count: int = 1
    bit_depth: int | None = None
    frame_rate: float | None = None
    exposure_ns: int | None = None
    trigger: int | None = None
    times_ns: Integers | None = None
    numbers: Integers | None = None
    saved_every: int = 1
    planes: int = 1
    planes_description: str = ""
    count_is_certain: bool = True
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Leave out times that cannot be."""
        times = None if self.times_ns is None else np.asarray(self.times_ns)[:: self.planes]
        if times is None or len(times) < 2:
            return
        if (is_falling := (times[1:] <= times[:-1]) | (times[:-1] == np.iinfo(np.int64).min)).any():
            frame_index = self.planes * (int(np.argmax(is_falling)) + 1)
            remark = f"its time stamps do not rise (at frame {frame_index}): they are not used"
            object.__setattr__(self, "times_ns", None)
        elif rate := self.frame_rate:
            periods = int(self.relative_numbers[-1]) if self.planes == 1 else len(times) - 1
            stamped_rate = self.saved_every * periods * SECOND / float(times[-1] - times[0])
            if abs(rate / stamped_rate - 1) <= max(0.01, rate * 1e-6):  # stamps may be whole microseconds
                return
            remark = f"it states {rate:g} frames per second, its time stamps {stamped_rate:.6g}: these are taken"
        else:
            return
        object.__setattr__(self, "remarks", (*self.remarks, remark))

    @property
    def relative_numbers(self) -> Integers:
        """Number (count,) of every frame from the first, which has 0; with gaps where frames are lost.

        They are the camera's, else whole periods between even time stamps. Frames that are not taken at even intervals
        are numbered through: a gap between them means nothing.
        """
        if self.numbers is not None:
            return np.asarray(self.numbers - self.numbers[0])
        if self.times_ns is not None and self.count > 2 and self.planes == 1:
            steps = np.diff(self.times_ns)
            period = float(np.median(steps))
            periods = np.round(steps / max(period, 1.0))
            tolerance = 0.1 * period * np.sqrt(np.abs(periods))  # a clock of 1 MHz at 100,000 frames a second
            if (periods >= 1).all() and (np.abs(steps - periods * period) <= tolerance).all():
                return np.concatenate([[0], np.cumsum(periods)]).astype(np.int64)
        return np.arange(self.count)

    @property
    def n_lost(self) -> int:
        """Number of frames lost between the first and the last."""
        return int(self.relative_numbers[-1]) + 1 - self.count


def even_times(numbers: range, interval: Fraction) -> Integers:
    """Return when frames with these numbers were taken, in ns from number 0, `interval` seconds apart, rounded.

    Raises
    ------
    OverflowError
        More than 292 years lie between them.
    """
    numerator, denominator = SECOND * interval.numerator, interval.denominator
    return np.fromiter(
        ((2 * number * numerator + denominator) // (2 * denominator) for number in numbers), np.int64, len(numbers)
    )


_NUMBER = re.compile(r"[0-9]{1,9}(/0{0,8}[1-9][0-9]{0,8}|(\.[0-9]{1,15})?([eE]-?[0-9])?)")


def parse_fraction(text: str) -> Fraction | None:
    """Return the number that a header states as text, such as "0.25", "1/500" or "2.5e-3"; None where it is none."""
    return Fraction(text) if _NUMBER.fullmatch(text) else None
