"""Goniometry: grey level of chosen pixels against the angle of the light, and the reflection fitted to it.

Paper, section 2.3 and Fig. 9: a fixed specimen before a fixed camera, and a light that turns about it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["Goniometry", "Lobe", "fit_lobe", "goniometry", "pixel_levels"]


VISIBLE = 0.05
"""The reflection is erratic where the pixels' spread exceeds this fraction of the white paint's diffuse level."""
_GROUPS = 10
"""Groups of pixels left out in turn to find the lobe's uncertainty."""
_BEYOND = 2.5
"""Beyond this many standard deviations of the lobe the light is taken to be diffuse."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lobe:
    """Diffuse light and a specular lobe: ``level(a) = diffuse cos(a) + specular exp(-(a - centre)^2/(2 width^2))``.

    Attributes
    ----------
    diffuse, specular
        Grey levels at normal incidence and at the lobe's peak.
    centre_deg, width_deg
        Light angle of the peak, and standard deviation of the lobe.
    std
        Standard uncertainties of the four, in this order.
    """

    diffuse: float
    specular: float
    centre_deg: float
    width_deg: float
    std: tuple[float, float, float, float]

    def __call__(self, angles_deg: npt.ArrayLike) -> FloatArray:
        """Grey level at light angles in degrees from the surface's normal."""
        values = (self.diffuse, self.specular, self.centre_deg, self.width_deg)
        return _lobe(np.asarray(angles_deg, dtype=np.float64), *values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Goniometry:
    """Grey levels against the light angle.

    Attributes
    ----------
    angles_deg : ndarray, shape (n,)
        Angle between the light and the surface's normal; positive on the side of the reflection.
    levels : ndarray, shape (n, m)
        Grey level of every pixel.
    white : ndarray, shape (m,), bool
        The pixels of the brighter bundle (paint of high diffuse reflectance).
    lobe
        Fitted to the mean of the pixels; its uncertainty is that of choosing these pixels among others.
    spread : ndarray, shape (n,)
        Standard deviation, between the pixels of a bundle, of the light that is not diffuse.
    band
        Light angles (first, last) between which the reflection is erratic; NaN where it is nowhere.
    """

    angles_deg: FloatArray
    levels: FloatArray
    white: BoolArray
    lobe: Lobe
    spread: FloatArray
    band: tuple[float, float]


def pixel_levels(frames: Sequence[npt.ArrayLike], pixels: npt.ArrayLike) -> FloatArray:
    """Grey levels (n, m) of chosen pixels in n frames.

    Parameters
    ----------
    frames
        Images (H, W) of one size, proportional to light.
    pixels : array_like, shape (m, 2)
        (x, y) of whole pixels.

    Returns
    -------
    ndarray, shape (n, m)
        In the unit of the frames.

    Raises
    ------
    InputError
        Pixels that are not whole numbers, or lie outside a frame.
    """
    chosen = np.asarray(pixels)
    if chosen.ndim != 2 or chosen.shape[1] != 2 or chosen.dtype.kind not in "iu":
        raise InputError(f"pixels are whole numbers (x, y) of shape (m, 2), not {chosen.dtype} {chosen.shape}")
    levels = []
    for number, frame in enumerate(frames):
        image = np.asarray(frame, dtype=np.float64)
        if image.ndim != 2 or (chosen < 0).any() or (chosen >= image.shape[::-1]).any():
            raise InputError(f"frame {number} of shape {image.shape} does not hold all the pixels chosen")
        levels.append(image[chosen[:, 1], chosen[:, 0]])
    return np.array(levels)


def fit_lobe(angles_deg: npt.ArrayLike, levels: npt.ArrayLike, std: npt.ArrayLike | None = None) -> Lobe:
    """Fit a diffuse part and a specular lobe to grey levels.

    Parameters
    ----------
    angles_deg, levels : array_like, shape (n,)
        Light angles and mean grey levels.
    std : array_like, shape (n,), optional
        Standard uncertainty of the levels; None: equal and unknown, taken from the residual.

    Returns
    -------
    Lobe

    Raises
    ------
    InputError
        Fewer than 8 angles under 90 degrees, or no lobe can be fitted.
    """
    from scipy.optimize import curve_fit

    angles, values = np.asarray(angles_deg, dtype=np.float64), np.asarray(levels, dtype=np.float64)
    if angles.ndim != 1 or angles.shape != values.shape or (np.isfinite(values) & (abs(angles) < 90)).sum() < 8:
        raise InputError(f"a lobe is fitted to at least 8 angles below 90 degrees; given are {angles.shape}")
    used = np.isfinite(values) & (abs(angles) < 90)
    angles, values = angles[used], values[used]
    errors = None if std is None else np.maximum(np.asarray(std, dtype=np.float64)[used], 1e-9 * np.ptp(values))
    oblique = abs(angles) > np.quantile(abs(angles), 0.6)
    diffuse = float(np.median(values[oblique] / np.cos(np.radians(angles[oblique]))))
    excess = values - diffuse * np.cos(np.radians(angles))
    guess = (diffuse, max(float(excess.max()), 1e-6), float(angles[excess.argmax()]), 10.0)
    try:
        best, covariance = curve_fit(
            _lobe, angles, values, guess, sigma=errors, bounds=([0, 0, -90, 0.1], [np.inf, np.inf, 90, 90])
        )
    except RuntimeError as error:
        raise InputError(f"no lobe fits the grey levels: {error}") from None
    diffuse, specular, centre, width = map(float, best)
    a, b, c, d = map(float, np.sqrt(np.diag(covariance)))
    return Lobe(diffuse=diffuse, specular=specular, centre_deg=centre, width_deg=width, std=(a, b, c, d))


def goniometry(angles_deg: npt.ArrayLike, levels: npt.ArrayLike, *, visible: float = VISIBLE) -> Goniometry:
    """Diffuse light, specular lobe and erratic band of a series of grey levels.

    Every pixel has its own diffuse level, found where the light is far from the reflection; the excess over it is
    reflection. A smooth reflection would be the same at every pixel of one paint: the spread between the pixels is the
    erratic part.

    Parameters
    ----------
    angles_deg : array_like, shape (n,)
        Angle (degrees) between the light and the surface's normal, positive on the side of the reflection.
    levels : array_like, shape (n, m)
        Grey levels of m pixels (`pixel_levels`).
    visible
        The band is where the spread exceeds this fraction of the white paint's diffuse level.

    Returns
    -------
    Goniometry

    Raises
    ------
    InputError
        Shapes that do not fit, or no angles clear of the reflection.
    """
    angles, values = np.asarray(angles_deg, dtype=np.float64), np.asarray(levels, dtype=np.float64)
    if values.ndim != 2 or angles.shape != values.shape[:1]:
        raise InputError(f"levels (n, m) belong to n angles; given are {values.shape} and {angles.shape}")
    order = np.argsort(angles)
    angles, values = angles[order], values[order]
    cosine = np.maximum(np.cos(np.radians(angles)), 0)
    lobe = _lobe_of_pixels(angles, values)
    clear = (abs(angles - lobe.centre_deg) > _BEYOND * lobe.width_deg) & (cosine > 0)
    if clear.sum() < 3:
        raise InputError(
            "fewer than 3 of the angles lie clear of the reflection: the diffuse light cannot be separated"
        )
    diffuse = cosine[clear] @ values[clear] / (cosine[clear] @ cosine[clear])
    white = diffuse > (np.quantile(diffuse, 0.1) + np.quantile(diffuse, 0.9)) / 2
    excess = values - cosine[:, None] * diffuse
    spread = np.sqrt(np.mean([excess[:, group].var(axis=1) for group in (white, ~white) if group.any()], axis=0))
    # the run of angles around the largest spread on which it is visible
    hidden, peak = np.flatnonzero(~(spread > visible * float(diffuse[white].mean()))), int(spread.argmax())
    band = (float("nan"), float("nan"))
    if peak not in hidden:
        first, last = hidden[hidden < peak].max(initial=-1) + 1, hidden[hidden > peak].min(initial=len(angles)) - 1
        band = (float(angles[first]), float(angles[last]))
    return Goniometry(angles_deg=angles, levels=values, white=white, lobe=lobe, spread=spread, band=band)


def _lobe_of_pixels(angles: FloatArray, levels: FloatArray) -> Lobe:
    """Lobe of the mean of m pixels; its uncertainty from leaving out groups of them (jackknife).

    The residual of the fit does not show it: a pixel's deviation is the same at neighbouring angles.
    """
    whole = fit_lobe(angles, levels.mean(axis=1))
    groups = min(_GROUPS, levels.shape[1])
    if groups < 2:
        return whole
    members = np.arange(levels.shape[1]) % groups
    trials = [fit_lobe(angles, levels[:, members != group].mean(axis=1)) for group in range(groups)]
    values = np.array([(one.diffuse, one.specular, one.centre_deg, one.width_deg) for one in trials])
    a, b, c, d = map(float, np.hypot(values.std(axis=0) * np.sqrt(groups - 1), whole.std))
    return replace(whole, std=(a, b, c, d))


def _lobe(angles: FloatArray, diffuse: float, specular: float, centre: float, width: float) -> FloatArray:
    lambert = np.maximum(np.cos(np.radians(angles)), 0)
    return np.asarray(diffuse * lambert + specular * np.exp(-((angles - centre) ** 2) / (2 * width**2)))
