"""Offset between the clocks of a recorder and of the frames: where a channel correlates best with a history."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.typing import FloatArray

MIN_FRAMES, MIN_CORRELATION = 8, 0.7
"""Frames that an alignment needs at least, and the correlation coefficient: half of the variance explained (chosen)."""
_CONSTANT = 1e-10
"""Fraction of a channel's variance up to which a part of it counts as constant: recorders write five digits."""
_MAX_OFFSETS = 2**25
"""Offsets that are tried at most: they take some 4 GB of memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """A channel and a history that agree but for the zero of the clock, a factor and a constant.

    Attributes
    ----------
    times, values : ndarray, shape (n,)
        Of the channel; NaN where it has no value.
    variance
        Of the channel's noise: from the median of its second differences, which its events do not shift.
    frame_times, history : ndarray, shape (T,)
        Finite.
    """

    times: FloatArray
    values: FloatArray
    variance: float
    frame_times: FloatArray
    history: FloatArray

    @classmethod
    def from_series(
        cls, times: FloatArray, values: FloatArray, frame_times: FloatArray, history: FloatArray
    ) -> Alignment:
        """Average a channel that is faster than the frames over their interval, which suppresses its noise."""
        noise = np.nanmedian(np.abs(np.diff(values, 2))) / 0.6745  # of a normal distribution the quartile
        count = int(np.median(np.diff(frame_times)) / np.median(np.diff(times)))
        if 1 < count < len(times) // 2:
            times, values = (np.convolve(series, np.full(count, 1 / count), "valid") for series in (times, values))
        return cls(
            times=times,
            values=values,
            variance=float(noise**2 / 6 / max(count, 1)),
            frame_times=frame_times,
            history=history,
        )

    @cached_property
    def intervals(self) -> tuple[float, float]:
        """Intervals of the channel and of the frames, s."""
        return float(np.median(np.diff(self.times))), float(np.median(np.diff(self.frame_times)))

    @cached_property
    def independent_count(self) -> float:
        """Number of frames, or of the channel's values within their times where these are fewer."""
        return len(self.history) / max(1, self.intervals[0] / self.intervals[1])

    @cached_property
    def constant_variance(self) -> float:
        """Variance up to which a part of the channel counts as constant."""
        return _CONSTANT * float(np.nanvar(self.values))

    @cached_property
    def min_overlap(self) -> int:
        """Number of frames that must lie within the times of the channel: half of them."""
        return max(len(self.history) // 2, MIN_FRAMES)

    def coefficients(self) -> tuple[FloatArray, FloatArray]:
        """Return offsets half an interval apart and the correlation at each, 0 where too few frames have a value.

        The sums over the frames are convolutions on a grid of times.

        Raises
        ------
        InputError
            There are too many offsets.
        """
        from scipy.signal import oaconvolve  # half a second to import

        step = max(self.intervals) / 2
        channel_steps, frame_steps = (int(np.ptp(array) / step) for array in (self.times, self.frame_times))
        if channel_steps + frame_steps > _MAX_OFFSETS:
            raise InputError(
                f"to align the channel with the history, {channel_steps + frame_steps} offsets would have to be tried, "
                f"{step:g} s apart; at most {_MAX_OFFSETS} are: state channels.offset"
            )
        sampled = np.interp(self.times[0] + step * np.arange(channel_steps + 1), self.times, self.values)
        weight = np.isfinite(sampled).astype(np.float64)
        sampled = np.nan_to_num((sampled - np.nanmean(sampled)) / np.nanstd(sampled))
        history = (self.history - self.history.mean()) / self.history.std()
        frames = np.rint((self.frame_times - self.frame_times[0]) / step).astype(np.int64)
        powers = [np.bincount(frames, history**power, frame_steps + 2)[::-1] for power in range(3)]
        overlap = np.maximum(np.rint(oaconvolve(weight, powers[0])), 1)
        x, xx, y, yy, xy = (
            oaconvolve(array, powers[power]) / overlap
            for array, power in ((sampled, 0), (sampled**2, 0), (weight, 1), (weight, 2), (sampled, 1))
        )
        variances = xx - x**2, yy - y**2
        varies = np.logical_and(*(array > _CONSTANT for array in variances)) & (overlap >= self.min_overlap)
        offsets = self.frame_times[0] - self.times[0] + step * (frame_steps + 1 - np.arange(len(overlap)))
        return offsets, np.where(varies, xy - x * y, 0) / np.sqrt(np.where(varies, variances[0] * variances[1], 1))

    def correlation(self, offset: float) -> float:
        """Return the correlation coefficient at an offset (s) of the channel's times, by `_values`; 0 if too few."""
        shifted = self._values(offset)
        valid = np.isfinite(shifted)
        values, history = shifted[valid], self.history[valid]
        if len(values) < self.min_overlap or not np.var(values) > self.constant_variance or not np.ptp(history):
            return 0.0
        return float(np.corrcoef(values, history)[0, 1])

    def std(self, offset: float) -> float:
        """Return the standard uncertainty of an offset in seconds: least squares for it, a factor and a constant.

        What the fit leaves is noise, independent from frame to frame, or from value to value of a slower channel. It
        moves the offset by the slope of the channel with its noise, and the slope without is the information; that is a
        difference over the interval at which it is the most certain. Infinite where the slope is not above its noise,
        or where a shift in time is not distinct from another factor and constant.
        """
        shifted = self._values(offset)
        valid = np.isfinite(shifted)
        design, history = np.stack([np.ones(len(shifted)), shifted], axis=1), self.history[valid]
        (_, factor), residual = (fit := np.linalg.lstsq(design[valid], history)[0]), history - design[valid] @ fit
        noise = residual @ residual / (len(history) - 3) * len(self.history) / self.independent_count
        squares, information = [], 0.0
        for half_width in [self.intervals[0] / 2, *(max(self.intervals) * 2.0 ** np.arange(6))]:
            slope = (self._values(offset - half_width) - self._values(offset + half_width)) / (2 * half_width)
            valid_slopes = valid & np.isfinite(slope)
            noise_level = _CONSTANT * slope[valid_slopes] @ slope[valid_slopes] + valid_slopes.sum() * self.variance / (
                2 * half_width**2
            )
            slope = (
                slope[valid_slopes]
                - design[valid_slopes] @ np.linalg.lstsq(design[valid_slopes], slope[valid_slopes])[0]
            )
            squares.append(slope @ slope)
            information = max(information, squares[-1] - noise_level)
        return (
            math.sqrt(noise * max(squares[0], information)) / information / abs(factor) if information > 0 else math.inf
        )

    def _values(self, offset: float) -> FloatArray:
        """Interpolate the channel at the frames, its times shifted by an offset; NaN where it has no value."""
        return np.interp(self.frame_times - offset, self.times, self.values, np.nan, np.nan)

    def refine_offset(self, offset: float, reach: float) -> float:
        """Return the offset of the best correlation (absolute) within some reach of one, both in s."""
        from scipy.optimize import minimize_scalar

        grid = offset + reach * np.linspace(-1, 1, 17)
        best = grid[np.argmax([abs(self.correlation(candidate)) for candidate in grid])]
        bounds = best - reach / 8, best + reach / 8
        return float(
            minimize_scalar(lambda candidate: -abs(self.correlation(candidate)), bounds=bounds, method="bounded").x
        )

    def rival_offsets(self, offsets: FloatArray, coefficients: FloatArray) -> FloatArray:
        """Select offsets apart from the best that correlate as well as those beside it.

        That is within two standard uncertainties of the difference of two values of Fisher's z.
        """
        scores = np.minimum(np.abs(coefficients), 1 - 1e-9)
        best, weak_indices = int(np.argmax(scores)), np.flatnonzero(scores < MIN_CORRELATION)
        threshold = np.arctanh(scores[max(best - 1, 0) : best + 2].min()) - 2 * math.sqrt(2 / (len(self.history) - 3))
        lower, upper = np.searchsorted(weak_indices, [best, best])
        scores[
            (weak_indices[lower - 1] if lower else 0) : (weak_indices[upper] if upper < len(weak_indices) else None)
        ] = 0
        return np.asarray(offsets[np.arctanh(scores) > threshold])
