"""Topography of a speckle: form taken off, local slopes, distance between wrinkles.

Paper, section 2.4: a height map of the painted surface and its intensity map, from a confocal sensor.
"""

from __future__ import annotations

import math
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["detrend", "local_slope", "paint_classes", "rms_slope", "slope_uncertainty", "wrinkle_spacing"]


_OCTAVE = 0.1
"""Standard deviation, in the logarithm of the frequency, of the window that smooths the spectrum."""
_BLOCKS = 3
"""The map is cut into this many blocks along each side to find the uncertainty of the spacing."""


def detrend(height: npt.ArrayLike, order: int = 4) -> FloatArray:
    """Return a height map minus the best bipolynomial: all x^i y^j with i and j up to `order` (paper, Fig. 10: 4).

    Parameters
    ----------
    height : array_like, shape (H, W)
        NaN where not measured.
    order
        Of the polynomial in x and in y.

    Returns
    -------
    ndarray, shape (H, W)
        In the unit of the height; NaN stays NaN.

    Raises
    ------
    InputError
        The map is not two-dimensional or has fewer points than the polynomial has terms.
    """
    from numpy.polynomial.legendre import legvander

    values = _as_map(height)
    known = np.isfinite(values)
    if order < 0 or known.sum() <= (order + 1) ** 2:
        raise InputError(f"a bipolynomial of order {order} needs more than {(order + 1) ** 2} measured heights")
    along_y, along_x = (legvander(np.linspace(-1, 1, n), order) for n in values.shape)
    terms = (order + 1) ** 2
    normal, right = np.zeros((terms, terms)), np.zeros(terms)
    for row, line, measured in zip(along_y, values, known, strict=True):
        basis = (row[:, None] * along_x[measured, None, :]).reshape(-1, terms)
        normal += basis.T @ basis
        right += basis.T @ line[measured]
    coefficients = np.linalg.lstsq(normal, right, rcond=None)[0].reshape(order + 1, order + 1)
    return np.asarray(values - along_y @ coefficients @ along_x.T)


def local_slope(height: npt.ArrayLike, pitch: float) -> FloatArray:
    """Local slope arctan|grad h| by central differences.

    Parameters
    ----------
    height, pitch
        Height map (H, W) and distance between its points, in one unit.

    Returns
    -------
    ndarray, shape (H, W)
        Degrees; NaN beside gaps.

    Raises
    ------
    InputError
        The pitch is not positive, or the height is no map.
    """
    values = _as_map(height)
    if not (pitch > 0 and math.isfinite(pitch)):
        raise InputError(f"the pitch of a height map is positive, not {pitch!r}")
    along_y, along_x = np.gradient(values, pitch)
    return np.asarray(np.degrees(np.arctan(np.hypot(along_x, along_y))))


def slope_uncertainty(height_std: float, pitch: float) -> float:
    """Return the standard uncertainty of a small local slope: that of a central difference, ``std / (sqrt(2) pitch)``.

    It holds where the slope is well above it; where it is not, the slope, being positive, is biased upwards.

    Parameters
    ----------
    height_std, pitch
        Standard uncertainty of a height and distance between the points, in one unit.

    Returns
    -------
    float
        Degrees.
    """
    return math.degrees(math.atan(height_std / (math.sqrt(2) * pitch)))


def paint_classes(intensity: npt.ArrayLike) -> BoolArray:
    """White and black paint of an intensity map, by Otsu's threshold.

    Parameters
    ----------
    intensity : array_like, shape (H, W)
        NaN, where not measured, counts as black.

    Returns
    -------
    ndarray, shape (H, W), bool
        True on white.

    Raises
    ------
    InputError
        The map is of one level.
    """
    values = _as_map(intensity)
    known = np.isfinite(values)
    if not known.any() or np.ptp(values[known]) == 0:
        raise InputError("the intensity map shows no two paints: it is of one level")
    low, high = np.percentile(values[known], [0.5, 99.5])
    grey = np.clip(255 * (np.where(known, values, low) - low) / max(high - low, 1e-300), 0, 255).astype(np.uint8)
    level = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[0]
    return np.asarray(known & (grey > level))


def rms_slope(height: npt.ArrayLike, where: BoolArray, pitch: float, *, height_std: float = 0.0) -> float:
    """Root mean square local slope of one paint in degrees, measurement noise taken off.

    Parameters
    ----------
    height
        Height map without its form (`detrend`).
    where
        The paint's points, shape (H, W).
    pitch
        Distance between the points, in the unit of the height.
    height_std
        Standard uncertainty of a height; its part in the slope is taken off.

    Returns
    -------
    float
        Degrees.

    Raises
    ------
    InputError
        No measured height lies on the paint, with its neighbours.
    """
    values = _as_map(height)
    used = (where & np.isfinite(values)).astype(np.uint8)
    slope = local_slope(values, pitch)[cv2.erode(used, np.ones((3, 3), np.uint8), borderValue=0).astype(bool)]
    slope = slope[np.isfinite(slope)]
    if not slope.size:
        raise InputError("no measured height lies on this paint")
    square = float((np.tan(np.radians(slope)) ** 2).mean() - height_std**2 / pitch**2)
    return math.degrees(math.atan(math.sqrt(max(square, 0))))


def wrinkle_spacing(height: npt.ArrayLike, pitch: float, *, longest: float = 0.06) -> tuple[float, float]:
    """Distance between wrinkles: where the spectrum of the height, summed over all directions, has its peak.

    Parameters
    ----------
    height
        Height map (H, W); gaps are filled with the mean.
    pitch
        Distance between the points.
    longest
        Waves longer than this (relief of the droplets) are not looked at; in the unit of `pitch`.

    Returns
    -------
    tuple
        Spacing, in the unit of `pitch`, and its standard uncertainty (from parts of the map).

    Raises
    ------
    InputError
        The map is smaller than ten times `longest`, or too coarse for it.
    """
    values = _as_map(height)
    if min(values.shape) * pitch < 10 * longest or longest < 4 * pitch:
        raise InputError(
            f"a map of {values.shape} points {pitch} apart does not show wrinkles up to {longest}: it must be at least "
            f"10 times as long and {longest / 4} or finer"
        )
    frequency, power = _ring_spectrum(values, pitch, longest)
    peak = _peak(frequency, power)
    rows, columns = (np.linspace(0, n, _BLOCKS + 1).astype(int) for n in values.shape)
    parts = [
        _peak(*_ring_spectrum(values[a:b, c:d], pitch, longest))
        for a, b in pairwise(rows)
        for c, d in pairwise(columns)
    ]
    return 1 / peak, float(np.std(1 / np.array(parts), ddof=1) / _BLOCKS)


def _as_map(values: npt.ArrayLike) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or min(array.shape) < 3:
        raise InputError(f"a map has at least 3 x 3 points in two dimensions, not shape {array.shape}")
    return array


def _ring_spectrum(values: FloatArray, pitch: float, longest: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies and the power summed over the rings of these frequencies (Hann window)."""
    known = np.isfinite(values)
    centred = np.where(known, values - values[known].mean(), 0.0)
    window = np.hanning(values.shape[0])[:, None] * np.hanning(values.shape[1])
    power = np.abs(np.fft.fft2(centred * window)) ** 2
    radius = np.hypot(np.fft.fftfreq(values.shape[0], pitch)[:, None], np.fft.fftfreq(values.shape[1], pitch))
    width = 2 / (min(values.shape) * pitch)
    index = (radius / width).astype(int).ravel()
    frequency = (np.arange(index.max() + 1) + 0.5) * width
    ring = np.bincount(index, weights=power.ravel())
    seen = (frequency >= 1 / longest) & (frequency <= 0.5 / pitch)
    return frequency[seen], ring[seen]


def _peak(frequency: FloatArray, power: FloatArray) -> float:
    """Peak of a noisy spectrum: vertex of the parabola through its logarithm, smoothed over `_OCTAVE` of frequency."""
    position = np.log(frequency)
    kernel = np.exp(-0.5 * ((position[:, None] - position) / _OCTAVE) ** 2)
    smooth = kernel @ power / kernel.sum(axis=1)
    top = int(smooth.argmax())
    near = np.abs(position - position[top]) <= _OCTAVE
    if near.sum() < 3:
        return float(frequency[top])
    bend, slope, _ = np.polyfit(position[near] - position[top], np.log(smooth[near] + 1e-300), 2)
    shift = -slope / (2 * bend) if bend < 0 else 0.0
    return float(frequency[top] * np.exp(np.clip(shift, -_OCTAVE, _OCTAVE)))
