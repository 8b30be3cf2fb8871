"""Fixed pattern and defects of the sensor: DSNU, PRNU, hot and dead pixels (EMVA standard 1288, sections 4 and 8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from rgbmidic.illumination.camera_noise import Quantity
from rgbmidic.typing import BoolArray
from rgbmidic_calibration.stacks import TemporalStack

__all__ = ["FixedPattern", "fixed_pattern"]


WINDOW = 7
"""Side (samples of a plane) of the neighbourhood whose mean is taken out: shading and dirt are wider than this."""

HOT = 8.0
"""Robust standard deviations above the neighbourhood's median that make a pixel hot in the dark."""
HOT_SHARE = 0.005
"""Share of the full scale that a hot pixel exceeds its neighbourhood by at least."""
DEAD_SHARE = 0.5
"""Response relative to the neighbourhood's median below which a pixel is dead."""

TEXTURED = 0.05
"""Local variation of the response above which the target, not the sensor, is uneven."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedPattern:
    """DSNU in DN, PRNU in %, defects (row, column, kind) and warnings."""

    dsnu: Quantity
    prnu: Quantity
    defects: tuple[tuple[int, int, str], ...]
    warnings: tuple[str, ...] = ()


def fixed_pattern(dark: TemporalStack, flats: Sequence[TemporalStack], saturation: Quantity) -> FixedPattern:
    """Fixed pattern from the mean dark frame and the mean flat frame nearest to half of saturation.

    The variance of the temporal noise that remains in a mean over n frames, its n-th part, is taken out.
    """
    dsnu, prnu, defects, textured = [], [], [], []
    for plane, name in enumerate(dark.names):
        hot = _hot(dark, plane)
        level = _spread(dark.mean[plane], dark.variance[plane] / dark.count, ~hot)
        dsnu.append(level)
        flat = min(flats, key=lambda f: abs(float(f.strength[:, plane].mean()) - saturation.value[plane] / 2))
        response, dead = _response(dark, flat, plane, hot)
        if response is not None and response[0] > TEXTURED:
            textured.append(f"{name} {100 * response[0]:.0f} %")
            response, dead = None, np.zeros_like(hot)
        prnu.append((100 * response[0], 100 * response[1]) if response else (np.nan, np.nan))
        defects += [*_places(dark, plane, hot, "hot"), *_places(dark, plane, dead & ~hot, "dead")]
    values, uncertainties = np.array(dsnu).T
    responses, response_uncertainties = np.array(prnu).T
    return FixedPattern(
        dsnu=Quantity(values, uncertainties),
        prnu=Quantity(responses, response_uncertainties),
        defects=tuple(sorted(defects)),
        warnings=_texture_warning(textured),
    )


def _texture_warning(planes: Sequence[str]) -> tuple[str, ...]:
    if not planes:
        return ()
    return (
        f"the target is textured or the lamp uneven (local variation {', '.join(planes)}): PRNU and dead pixels need a "
        "plain white target out of focus",
    )


def _hot(dark: TemporalStack, plane: int) -> BoolArray:
    excess = dark.mean[plane] - ndimage.median_filter(dark.mean[plane], 5)
    spread = float(np.median(np.abs(excess))) / 0.6745
    floor = HOT_SHARE * (dark.white - float(dark.black[plane]))
    return np.asarray(excess > max(HOT * spread, floor))


def _response(
    dark: TemporalStack, flat: TemporalStack, plane: int, hot: BoolArray
) -> tuple[tuple[float, float] | None, BoolArray]:
    """Relative spread of the response with its uncertainty, None where it cannot be told; dead pixels."""
    signal = flat.mean[plane] - dark.mean[plane]
    around = ndimage.median_filter(signal, 5)
    usable = ~hot & ~flat.clipped[plane]
    dead = usable & (signal < DEAD_SHARE * around) & (around > 0.02 * (flat.white - flat.black[plane]))
    level = float(signal[usable].mean()) if usable.any() else 0.0
    if level < 0.02 * (flat.white - float(flat.black[plane])):
        return None, np.zeros_like(dead)
    temporal = flat.variance[plane] / flat.count + dark.variance[plane] / dark.count
    local = np.maximum(ndimage.uniform_filter(signal, 4 * WINDOW), 1e-3 * level)
    return _spread(signal / local, temporal / local**2, usable & ~dead), dead


def _spread(
    mean: npt.NDArray[np.floating], temporal: npt.NDArray[np.floating], usable: BoolArray
) -> tuple[float, float]:
    """Spatial standard deviation about the neighbourhood's mean, temporal noise taken out, and its uncertainty."""
    filled = np.where(usable, mean, np.median(mean[usable]))
    smooth = ndimage.uniform_filter(filled, WINDOW, mode="nearest")
    inner = (slice(WINDOW, -WINDOW), slice(WINDOW, -WINDOW))
    shrink = 1 - 1 / WINDOW**2
    square = (((filled - smooth) ** 2) / shrink - temporal)[inner]
    keep = usable[inner]
    variance = float(square[keep].mean(dtype=np.float64))
    # Neighbouring residuals share their mean; the plain standard error is good within a few per cent.
    error = float(square[keep].std(dtype=np.float64)) / np.sqrt(max(int(keep.sum()), 1))
    value = np.sqrt(max(variance, 0.0))
    return float(value), float(error / (2 * value)) if variance > error else float(np.sqrt(error))


def _places(stack: TemporalStack, plane: int, marked: BoolArray, kind: str) -> list[tuple[int, int, str]]:
    row, column = stack.origins[plane]
    return [(int(r) * stack.step + row, int(c) * stack.step + column, kind) for r, c in np.argwhere(marked)]
