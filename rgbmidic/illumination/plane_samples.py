"""The raw samples of a colour plane: in the rectangle of the region, and the histogram of their grey levels.

The histogram shows where they pile up, and levels that are missing or doubled.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic.frames.data import ChannelFrame, Mosaic, colour_planes
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.typing import BoolArray, FloatArray

Frame = Mosaic | ChannelFrame

SIGNIFICANCE = 6.0
"""Standard errors beyond which a departure is not chance: 24 planes and levels are looked at."""
WINDOW = 9
"""Grey levels over which the histogram is smooth (a parabola) where noise has a standard deviation of `SMOOTHED`."""
SMOOTHED = 2.0


@dataclass(frozen=True, slots=True)
class PlaneSamples:
    """The P colour planes of a frame in the rectangle of the region."""

    names: tuple[str, ...]
    stored: npt.NDArray[np.uint16]  # (P, h, w)
    black: FloatArray  # (P,)
    values: npt.NDArray[np.float32]  # DN above black
    usable: BoolArray  # in the region, neither saturated nor cut off at 0
    noise: tuple[NoiseModel | None, ...]
    red_row: int  # of a cell of the pattern

    @classmethod
    def of(cls, frame: Frame, calibration: Calibration, inside: BoolArray, window: tuple[slice, slice]) -> PlaneSamples:
        """Cut the colour planes in a window out of the frame."""
        step = 2 if isinstance(frame, Mosaic) else 1
        names, planes, black = colour_planes(replace(frame, values=frame.values[..., *window]))
        stored = np.stack(planes)
        height, width = stored.shape[1:]
        inner = inside[window][: step * height : step, : step * width : step]
        noise = dict.fromkeys("RGBM", calibration.noise)
        if (figures := calibration.camera_noise) is not None:  # of a colour, since cropping exchanges the greens
            for colour in {name[0] for name in figures.planes}:
                same = [index for index, name in enumerate(figures.planes) if name[0] == colour]
                gain, read_noise = figures.gain.value[same].mean(), figures.read_noise.value[same].mean()
                noise[colour] = NoiseModel(gain=float(gain), read_noise=float(read_noise))
        return cls(
            names=names,
            stored=stored,
            black=black,
            values=stored.astype(np.float32) - black.astype(np.float32)[:, None, None],
            usable=inner & (stored < frame.white_level) & (stored > 0),
            noise=tuple(noise[name[0]] for name in names),
            red_row=int("R" in frame.cfa[2:]) if isinstance(frame, Mosaic) else 0,
        )

    @property
    def middle(self) -> tuple[slice, ...]:
        """At most 288 x 288 samples in the middle, from even ones on: 4 planes of them are looked at in 30 ms."""
        max_side = 288
        return tuple(slice(max(side - max_side, 0) // 4 * 2, (side + max_side) // 2) for side in self.stored.shape[1:])


def saturation_pile(samples: npt.NDArray[np.integer[Any]], white: float) -> float | None:
    """Find the level below white at which samples pile up as they do at saturation.

    Parameters
    ----------
    samples
        Raw samples.
    white
        Their white level.

    Returns
    -------
    float or None
        Their largest value, where it occurs more than twice as often as the four levels below it, which noise would
        make as frequent; None: it does not. A constant piles up: a plane that is saturated as a whole.
    """
    top = int(samples.max(initial=0))
    if top >= white or top < 8 or (count := np.count_nonzero(samples == top)) <= 20:
        return None
    bits = int(np.bitwise_or.reduce(samples, axis=None))
    step = bits & -bits  # all samples are multiples of it
    below = np.count_nonzero(samples >= top - 4 * step) - count
    return float(top) if count > 2 * below else None


def unevenness(
    samples: npt.NDArray[np.uint16], noise: NoiseModel | None = None, black: float = 0.0, step: int = 1
) -> float:
    """Return the relative variance of the histogram of raw samples about its smooth course, less that of counting.

    It is 0 where the histogram is smooth over `WINDOW` levels as noise makes it, .05 where every 21st level is missing,
    about 2 where every other one is; NaN where too few samples, or too little noise, leave it open.

    Parameters
    ----------
    samples
        Of one colour plane, none saturated.
    noise
        Calibrated noise: only levels at which it smooths the histogram are looked at; None: all.
    black
        Their black level.
    step
        What all samples of the frame are multiples of.

    Returns
    -------
    float
    """
    if samples.size < 1000:
        return float("nan")
    count = np.bincount(samples // step).astype(np.float64)
    if count.size < 30:
        return float("nan")
    count[: np.flatnonzero(count)[0] + 1] = 0  # what is clipped at the bottom
    smooth_count = np.convolve(count, np.full(WINDOW, 1 / WINDOW), mode="same")
    usable = smooth_count >= 8
    if noise is not None:
        usable &= noise.variance(step * np.arange(count.size) - black) >= (SMOOTHED * step) ** 2
    if usable.sum() < 30:
        return float("nan")
    middle = np.linalg.pinv(np.vander(np.arange(WINDOW) - WINDOW // 2, 3))[-1]  # of the parabola through a window
    residual_fraction = 1 - middle[WINDOW // 2]  # of the variance of counting, by the residual of the parabola
    square = (count - np.convolve(count, middle, mode="same"))[usable] ** 2 / residual_fraction
    chance = SIGNIFICANCE * np.sqrt(2 * usable.sum())
    if (square / smooth_count[usable]).sum() - usable.sum() < chance:
        return 0.0
    return float((square.sum() - smooth_count[usable].sum()) / (smooth_count[usable] ** 2).sum())
