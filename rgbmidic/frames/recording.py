"""How and when the frames of a file were recorded, and which are lost between them."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import numpy.typing as npt

__all__ = ["Recording", "even_times", "frame_numbers"]

_EVEN = 0.1
"""Share of a period by which stamps may miss whole periods: a clock of 1 MHz does at 100,000 frames a second."""

Integers = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """What a file tells of its frames as a sequence; None where it does not tell.

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
    remarks
        What else in the header a user should know.
    """

    count: int = 1
    bit_depth: int | None = None
    frame_rate: float | None = None
    exposure_ns: int | None = None
    trigger: int | None = None
    times_ns: Integers | None = None
    numbers: Integers | None = None
    remarks: tuple[str, ...] = ()

    @property
    def numbered(self) -> Integers:
        """Number (count,) of every frame from the first, which has 0; with gaps where frames are lost."""
        if self.numbers is not None:
            return np.asarray(self.numbers - self.numbers[0])
        if self.times_ns is not None:
            return frame_numbers(self.times_ns)
        return np.arange(self.count)

    @property
    def lost(self) -> int:
        """Number of frames lost between the first and the last."""
        return int(self.numbered[-1]) + 1 - self.count


def frame_numbers(times_ns: Integers) -> Integers:
    """Number of each frame from the first, from when they were taken: whole periods between even stamps.

    Frames that are not taken at even intervals are numbered through: a gap between them tells nothing.
    """
    if len(times_ns) < 3:
        return np.arange(len(times_ns))
    steps = np.diff(times_ns)
    period = float(np.median(steps))
    periods = np.round(steps / max(period, 1.0))
    if (periods < 1).any() or (np.abs(steps - periods * period) > _EVEN * period * np.sqrt(periods)).any():
        return np.arange(len(times_ns))
    return np.concatenate([[0], np.cumsum(periods)]).astype(np.int64)


def even_times(numbers: range, interval: Fraction) -> Integers:
    """When frames with these numbers were taken, in ns from number 0, `interval` seconds apart: rounded whole numbers.

    Raises
    ------
    OverflowError
        More than 292 years lie between them.
    """
    above, below = 10**9 * interval.numerator, interval.denominator
    return np.fromiter(((2 * number * above + below) // (2 * below) for number in numbers), np.int64, len(numbers))
