"""Fixed pattern of a sensor (DSNU, PRNU) and its hot and dead pixels (EMVA standard 1288, sections 4 and 8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from rgbmidic.illumination.linear import Quantity
from rgbmidic.typing import BoolArray
from rgbmidic_calibration.captures import TemporalStack

Defects = tuple[tuple[int, int, str], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedPatternConstants:
    """Constants of `fixed_pattern`.

    Attributes
    ----------
    window
        Side (samples of a plane) of the neighbourhood whose mean is taken out: shading and dirt are wider than this.
    hot
        Robust standard deviations above the neighbourhood's median that make a pixel hot in the dark: of normal noise
        one sample in 1e15 lies there; from 6 to 10 the virtual camera has no false one.
    hot_fraction
        Fraction of the full scale by which a hot pixel exceeds its neighbourhood at least: 20 DN of 12 bit, seven times
        the dark noise of the virtual camera, which has no false one from .002 to .01.
    dead_fraction
        Response relative to the neighbourhood's median below which a pixel is dead: half, as far from a live pixel as
        from a black one; from .3 to .7 the virtual camera has no false one.
    lit_fraction
        Signal over the full scale below which neither is determined (chosen).
    textured
        Local variation of the response above which the target, not the sensor, is uneven: from .03 to .08 the virtual
        camera's white card is judged alike.
    """

    window: int = 7
    hot: float = 8.0
    hot_fraction: float = 0.005
    dead_fraction: float = 0.5
    lit_fraction: float = 0.02
    textured: float = 0.05


LIMITS = FixedPatternConstants()


def fixed_pattern(
    dark: TemporalStack, flats: Sequence[TemporalStack], saturation: Quantity
) -> tuple[Quantity, Quantity, Defects, list[str]]:
    """Fixed pattern from the mean dark frame and the mean flat frame nearest to half of saturation.

    The variance of the temporal noise that remains in a mean over n frames, its n-th part, is taken out.

    Returns
    -------
    dsnu, prnu : Quantity
        In DN and in %.
    defects : tuple of (int, int, str)
        Row, column and kind of hot and dead pixels.
    warnings : list of str
    """
    dsnu, prnu, defects, textured = [], [], [], []
    for plane, name in enumerate(dark.camera.names):
        excess = dark.mean[plane] - ndimage.median_filter(dark.mean[plane], 5)
        floor = LIMITS.hot_fraction * (dark.camera.white - dark.camera.black[plane])
        hot = excess > max(LIMITS.hot * float(np.median(np.abs(excess))) / 0.6745, floor)
        dsnu.append(_spread(dark.mean[plane], dark.variance[plane] / dark.count, ~hot))
        flat = min(flats, key=lambda f: abs(float(f.strength[:, plane].mean()) - saturation.value[plane] / 2))
        response, dead = _response(dark, flat, plane, hot)
        if response[0] > LIMITS.textured:
            textured.append(f"{name} {100 * response[0]:.0f} %")
            response, dead = (np.nan, np.nan), np.zeros_like(hot)
        prnu.append((100 * response[0], 100 * response[1]))
        row, column = dark.camera.origins[plane]
        defects += [
            (int(r) * dark.camera.step + row, int(c) * dark.camera.step + column, kind)
            for kind, marked in (("hot", hot), ("dead", dead & ~hot))
            for r, c in np.argwhere(marked)
        ]
    warning = (
        f"the target is textured or the lamp uneven (local variation {', '.join(textured)}): PRNU and dead pixels need "
        "a plain white target out of focus"
    )
    figures = Quantity(*np.array(dsnu).T), Quantity(*np.array(prnu).T)
    return *figures, tuple(sorted(defects)), [warning] if textured else []


def _response(
    dark: TemporalStack, flat: TemporalStack, plane: int, hot: BoolArray
) -> tuple[tuple[float, float], BoolArray]:
    """Relative spread of the response with its uncertainty, NaN where it cannot be determined; dead pixels."""
    lit = LIMITS.lit_fraction * (flat.camera.white - flat.camera.black[plane])
    signal = flat.mean[plane] - dark.mean[plane]
    around = ndimage.median_filter(signal, 5)
    usable = ~hot & ~flat.clipped[plane]
    dead = usable & (signal < LIMITS.dead_fraction * around) & (around > lit)
    level = float(signal[usable].mean()) if usable.any() else 0.0
    if level < lit:
        return (np.nan, np.nan), np.zeros_like(dead)
    temporal = flat.variance[plane] / flat.count + dark.variance[plane] / dark.count
    local = np.maximum(ndimage.uniform_filter(signal, 4 * LIMITS.window), 1e-3 * level)
    return _spread(signal / local, temporal / local**2, usable & ~dead), dead


def _spread(
    mean: npt.NDArray[np.floating], temporal: npt.NDArray[np.floating], usable: BoolArray
) -> tuple[float, float]:
    """Spatial standard deviation about the neighbourhood's mean, temporal noise taken out, and its uncertainty."""
    window = LIMITS.window
    filled = np.where(usable, mean, np.median(mean[usable]))
    smooth = ndimage.uniform_filter(filled, window, mode="nearest")
    inner = (slice(window, -window), slice(window, -window))
    square = ((filled - smooth) ** 2 / (1 - 1 / window**2) - temporal)[inner][usable[inner]]
    variance = float(square.mean(dtype=np.float64))
    # Neighbouring residuals share their mean; the plain standard error is good within a few per cent.
    error = float(square.std(dtype=np.float64)) / np.sqrt(max(square.size, 1))
    value = np.sqrt(max(variance, 0.0))
    return float(value), float(error / (2 * value)) if variance > error else float(np.sqrt(error))
