"""Measures by which the paper judges a set-up and a specimen, for any data: perturbation, goniometry, topography.

Perturbation P (paper, section 2.2): the displacement minus its Gaussian-filtered copy, and its standard deviation over
areas; beside it the residual in percent of the dynamic range. Goniometry (section 2.3 and Fig. 9): grey level of chosen
pixels of a fixed specimen before a fixed camera against the angle of a light that turns about it. Topography (section
2.4): form taken off a height map of a confocal sensor, local slopes, distance between wrinkles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import pairwise, product

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.fields import SIGMA, high_pass
from rgbmidic.typing import BoolArray, FloatArray

AREA_SIZE = (50.0, 100.0)
"""Width and height (px) of the paper's areas."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureArea:
    """A rectangle of the reference image over which the perturbation is assessed.

    Attributes
    ----------
    name
        For instance ``"A0"``.
    centre
        (x, y) in px.
    size
        (width, height) in px.
    """

    name: str
    centre: tuple[float, float]
    size: tuple[float, float] = AREA_SIZE

    @property
    def rectangle(self) -> tuple[float, float, float, float]:
        """(x0, y0, x1, y1) in px."""
        (x, y), (width, height) = self.centre, self.size
        return x - width / 2, y - height / 2, x + width / 2, y + height / 2

    def cut(self, image: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        """Return the pixels of an image whose centres lie in the area.

        Parameters
        ----------
        image
            Shape (..., H, W).

        Returns
        -------
        ndarray, shape (..., h, w)

        Raises
        ------
        InputError
            The area is not wholly inside the image.
        """
        height, width = image.shape[-2:]
        x0, y0, x1, y1 = self.rectangle
        if not (0 <= x0 < x1 <= width - 1 and 0 <= y0 < y1 <= height - 1):
            raise InputError(f"area {self.name} {self.rectangle} does not lie in the image of {width} x {height} px")
        return image[..., int(np.ceil(y0)) : int(y1) + 1, int(np.ceil(x0)) : int(x1) + 1]


def areas_along_x(
    first: tuple[float, float], *, pitch: float = 100.0, count: int = 5, size: tuple[float, float] = AREA_SIZE
) -> tuple[MeasureArea, ...]:
    """Return the areas A0, A1, ... in a row along x, as on the paper's Fig. 4.

    Parameters
    ----------
    first
        Centre (x, y) of A0 in px.
    pitch
        Distance between the centres in px; a negative one runs to the left.
    count
        How many.
    size
        (width, height) of each in px.

    Returns
    -------
    tuple of Area
    """
    if not 0 < count <= 10_000:
        raise InputError(f"there are 1 to 10,000 areas, not {count}")
    return tuple(MeasureArea(name=f"A{i}", centre=(first[0] + i * pitch, first[1]), size=size) for i in range(count))


def perturbation(field: npt.ArrayLike, areas: Sequence[MeasureArea], *, sigma: float = SIGMA) -> FloatArray:
    """Perturbation P (paper, section 2.2): standard deviation in each area of a displacement without its long waves.

    Parameters
    ----------
    field : array_like, shape (H, W)
        A component of the displacement in px, NaN where not measured (`rgbmidic.fields.at_pixels`).
    areas
        Where P is assessed.
    sigma
        Standard deviation in px of the Gaussian of `rgbmidic.fields.high_pass`.

    Returns
    -------
    ndarray, shape (n,)
        P in px; NaN where less than half of the area is measured.

    Raises
    ------
    InputError
        An area does not lie in the image, or there is nothing to filter.
    """
    return area_stds(high_pass(field, sigma), areas)


def residual_percent(reference: npt.ArrayLike, deformed: npt.ArrayLike, displacement: FloatArray) -> float:
    """Return the residual of a measurement in % of the effective dynamic range (paper, section 2.2).

    Standard deviation of the difference between the reference image and the deformed image warped by the
    displacement (cubic spline interpolation), over the largest minus the smallest grey level of the two images.

    Parameters
    ----------
    reference, deformed
        Images (H, W) of one light; NaN where invalid.
    displacement
        (u, v) in px at the pixels of the reference image, shape (2, H, W); NaN where not measured.

    Returns
    -------
    float
        %.

    Raises
    ------
    InputError
        The shapes do not fit, or nothing is measured.
    """
    from scipy.ndimage import map_coordinates

    f, g = np.asarray(reference, dtype=np.float64), np.asarray(deformed, dtype=np.float64)
    fits = f.ndim == 2 and f.shape == g.shape and displacement.shape == (2, *f.shape)
    rows, columns = np.nonzero(np.isfinite(displacement[0]) & np.isfinite(f)) if fits else (np.empty(0), np.empty(0))
    if not rows.size:
        raise InputError(f"images and displacement do not fit: {f.shape}, {g.shape}, {displacement.shape}")
    displacement_at = displacement[:, rows, columns]
    is_missing = ~np.isfinite(g)
    coordinates = np.stack([rows + displacement_at[1], columns + displacement_at[0]])
    warped_levels = map_coordinates(
        np.where(is_missing, np.nanmean(g), g), coordinates, order=3, mode="constant", cval=np.nan
    )
    if is_missing.any():
        warped_levels[map_coordinates(is_missing.astype(np.float32), coordinates, order=1) > 0] = np.nan
    reference_levels = f[rows, columns]
    span = max(reference_levels.max(), np.nanmax(warped_levels)) - min(reference_levels.min(), np.nanmin(warped_levels))
    return float(100 * np.nanstd(warped_levels - reference_levels) / span)


def _area_statistics(image: FloatArray, areas: Sequence[MeasureArea], statistic: Callable[..., float]) -> FloatArray:
    cuts = [area.cut(image) for area in areas]
    return np.array([statistic(cut) if np.isfinite(cut).mean() >= 0.5 else np.nan for cut in cuts], dtype=np.float64)


def area_stds(high_passed: FloatArray, areas: Sequence[MeasureArea]) -> FloatArray:
    """Return the standard deviation of an image in each area.

    Parameters
    ----------
    high_passed : ndarray, shape (H, W)
        For P: `rgbmidic.fields.high_pass` of a displacement in px; NaN where not measured.
    areas
        n areas.

    Returns
    -------
    ndarray, shape (n,)
        In the unit of the image; NaN where less than half of the area is measured.
    """
    return _area_statistics(high_passed, areas, np.nanstd)


def area_means(field: FloatArray, areas: Sequence[MeasureArea]) -> FloatArray:
    """Return the mean of an image in each area.

    Parameters
    ----------
    field : ndarray, shape (H, W)
        NaN where not measured.
    areas
        n areas.

    Returns
    -------
    ndarray, shape (n,)
        In the unit of the image; NaN where less than half of the area is measured.
    """
    return _area_statistics(field, areas, np.nanmean)


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
        """Return the grey level at light angles in degrees from the surface's normal."""
        return _lobe(np.asarray(angles_deg, dtype=np.float64), *astuple(self)[:4])


@dataclass(frozen=True, slots=True, kw_only=True)
class Goniometry:
    """Grey levels against the light angle.

    Attributes
    ----------
    angles_deg : ndarray, shape (n,)
        Angle between the light and the surface's normal; positive on the side of the reflection.
    levels : ndarray, shape (n, m)
        Grey level of every pixel.
    is_white : ndarray, shape (m,), bool
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
    is_white: BoolArray
    lobe: Lobe
    spread: FloatArray
    band: tuple[float, float]


def pixel_levels(frames: Sequence[npt.ArrayLike], pixels: npt.ArrayLike) -> FloatArray:
    """Return the grey levels (n, m) of chosen pixels in n frames.

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
    positions = np.asarray(pixels)
    if positions.ndim != 2 or positions.shape[1] != 2 or positions.dtype.kind not in "iu":
        raise InputError(f"pixels are whole numbers (x, y) of shape (m, 2), not {positions.dtype} {positions.shape}")
    levels = []
    for number, frame in enumerate(frames):
        image = np.asarray(frame, dtype=np.float64)
        if image.ndim != 2 or (positions < 0).any() or (positions >= image.shape[::-1]).any():
            raise InputError(f"frame {number} of shape {image.shape} does not hold all the pixels chosen")
        levels.append(image[positions[:, 1], positions[:, 0]])
    return np.array(levels)


def fit_lobe(angles_deg: npt.ArrayLike, levels: npt.ArrayLike) -> Lobe:
    """Fit a diffuse part and a specular lobe to grey levels.

    Parameters
    ----------
    angles_deg, levels : array_like, shape (n,)
        Light angles and mean grey levels, whose standard uncertainty is equal and taken from the residual.

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
    is_valid = np.isfinite(values) & (abs(angles) < 90) if angles.shape == values.shape else np.zeros(0, dtype=bool)
    if angles.ndim != 1 or is_valid.sum() < 8:
        raise InputError(f"a lobe is fitted to at least 8 angles below 90 degrees; given are {angles.shape}")
    angles, values = angles[is_valid], values[is_valid]
    oblique = abs(angles) > np.quantile(abs(angles), 0.6)
    diffuse = float(np.median(values[oblique] / np.cos(np.radians(angles[oblique]))))
    excess = values - diffuse * np.cos(np.radians(angles))
    guess = (diffuse, max(float(excess.max()), 1e-6), float(angles[excess.argmax()]), 10.0)
    try:
        bounds = [0, 0, -90, 0.1], [np.inf, np.inf, 90, 90]
        best, covariance = curve_fit(_lobe, angles, values, guess, bounds=bounds)
    except RuntimeError as error:
        raise InputError(f"no lobe fits the grey levels: {error}") from None
    diffuse, specular, centre, width = map(float, best)
    a, b, c, d = map(float, np.sqrt(np.diag(covariance)))
    return Lobe(diffuse=diffuse, specular=specular, centre_deg=centre, width_deg=width, std=(a, b, c, d))


def goniometry(angles_deg: npt.ArrayLike, levels: npt.ArrayLike, *, min_spread: float = 0.05) -> Goniometry:
    """Return the diffuse light, specular lobe and erratic band of a series of grey levels.

    Every pixel has its own diffuse level, found where the light is far from the reflection; the excess over it is
    reflection. A smooth reflection would be the same at every pixel of one paint: the spread between the pixels is the
    erratic part.

    Parameters
    ----------
    angles_deg : array_like, shape (n,)
        Angle (degrees) between the light and the surface's normal, positive on the side of the reflection.
    levels : array_like, shape (n, m)
        Grey levels of m pixels (`pixel_levels`).
    min_spread
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
    clear = (abs(angles - lobe.centre_deg) > 2.5 * lobe.width_deg) & (cosine > 0)  # 4 % of the lobe's peak and less
    if clear.sum() < 3:
        raise InputError(
            "fewer than 3 of the angles lie clear of the reflection: the diffuse light cannot be separated"
        )
    diffuse = cosine[clear] @ values[clear] / (cosine[clear] @ cosine[clear])
    white = diffuse > (np.quantile(diffuse, 0.1) + np.quantile(diffuse, 0.9)) / 2
    excess = values - cosine[:, None] * diffuse
    spread = np.sqrt(np.mean([excess[:, group].var(axis=1) for group in (white, ~white) if group.any()], axis=0))
    # the run of angles around the largest spread on which it is visible
    is_invisible, peak = np.flatnonzero(~(spread > min_spread * float(diffuse[white].mean()))), int(spread.argmax())
    band = (float("nan"), float("nan"))
    if peak not in is_invisible:
        first, last = (
            is_invisible[is_invisible < peak].max(initial=-1) + 1,
            is_invisible[is_invisible > peak].min(initial=len(angles)) - 1,
        )
        band = (float(angles[first]), float(angles[last]))
    return Goniometry(angles_deg=angles, levels=values, is_white=white, lobe=lobe, spread=spread, band=band)


def _lobe_of_pixels(angles: FloatArray, levels: FloatArray, max_groups: int = 10) -> Lobe:
    """Return the lobe of the mean of m pixels; its uncertainty from leaving out groups of them in turn (jackknife).

    The residual of the fit does not show it: a pixel's deviation is the same at neighbouring angles.
    """
    full_fit = fit_lobe(angles, levels.mean(axis=1))
    groups = min(max_groups, levels.shape[1])
    if groups < 2:
        return full_fit
    members = np.arange(levels.shape[1]) % groups
    trials = [fit_lobe(angles, levels[:, members != group].mean(axis=1)) for group in range(groups)]
    values = np.array([astuple(lobe)[:4] for lobe in trials])
    a, b, c, d = map(float, np.hypot(values.std(axis=0) * np.sqrt(groups - 1), full_fit.std))
    return replace(full_fit, std=(a, b, c, d))


def _lobe(angles: FloatArray, diffuse: float, specular: float, centre: float, width: float) -> FloatArray:
    lambert = np.maximum(np.cos(np.radians(angles)), 0)
    return np.asarray(diffuse * lambert + specular * np.exp(-((angles - centre) ** 2) / (2 * width**2)))


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
    is_measured = np.isfinite(values)
    if order < 0 or is_measured.sum() <= (order + 1) ** 2:
        raise InputError(f"a bipolynomial of order {order} needs more than {(order + 1) ** 2} measured heights")
    along_y, along_x = (legvander(np.linspace(-1, 1, n), order) for n in values.shape)
    terms = (order + 1) ** 2
    normal, right = np.zeros((terms, terms)), np.zeros(terms)
    for row, line, measured in zip(along_y, values, is_measured, strict=True):
        basis = (row[:, None] * along_x[measured, None, :]).reshape(-1, terms)
        normal += basis.T @ basis
        right += basis.T @ line[measured]
    coefficients = np.linalg.lstsq(normal, right, rcond=None)[0].reshape(order + 1, order + 1)
    return np.asarray(values - along_y @ coefficients @ along_x.T)


def local_slope(height: npt.ArrayLike, pitch: float) -> FloatArray:
    """Return the local slope arctan|grad h| by central differences.

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
    _check_pitch(pitch)
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
    _check_pitch(pitch)
    return math.degrees(math.atan(height_std / (math.sqrt(2) * pitch)))


def _check_pitch(pitch: float) -> None:
    if not pitch > 0:
        raise InputError(f"the pitch of a height map is positive, not {pitch!r}")


def paint_classes(intensity: npt.ArrayLike) -> BoolArray:
    """Classify white and black paint of an intensity map, by Otsu's threshold.

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
    is_measured = np.isfinite(values)
    if not is_measured.any() or np.ptp(values[is_measured]) == 0:
        raise InputError("the intensity map shows no two paints: it is of one level")
    low, high = np.percentile(values[is_measured], [0.5, 99.5])
    grey = np.clip(255 * (np.where(is_measured, values, low) - low) / max(high - low, 1e-300), 0, 255).astype(np.uint8)
    level = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[0]
    return np.asarray(is_measured & (grey > level))


def rms_slope(height: npt.ArrayLike, on_paint: BoolArray, pitch: float, *, height_std: float = 0.0) -> float:
    """Return the root mean square local slope of one paint in degrees, measurement noise taken off.

    Parameters
    ----------
    height
        Height map without its form (`detrend`).
    on_paint
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
    if on_paint.shape != values.shape or on_paint.dtype != bool:
        raise InputError(f"points of a map {values.shape} are bool of its shape, not {on_paint.dtype} {on_paint.shape}")
    is_valid = (on_paint & np.isfinite(values)).astype(np.uint8)
    slope = local_slope(values, pitch)[cv2.erode(is_valid, np.ones((3, 3), np.uint8), borderValue=0).astype(bool)]
    slope = slope[np.isfinite(slope)]
    if not slope.size:
        raise InputError("no measured height lies on this paint")
    square = float((np.tan(np.radians(slope)) ** 2).mean() - np.square(np.float64(height_std) / pitch))
    return math.degrees(math.atan(math.sqrt(max(square, 0))))


def wrinkle_spacing(height: npt.ArrayLike, pitch: float, *, longest: float = 0.06) -> tuple[float, float]:
    """Return the distance between wrinkles: where the spectrum of the height, summed over all directions, has its peak.

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
    _check_pitch(pitch)
    if min(values.shape) * pitch < 10 * longest or longest < 4 * pitch:
        raise InputError(
            f"a map of {values.shape} points {pitch} apart does not show wrinkles up to {longest}: it must be at least "
            f"10 times as long and {longest / 4} or finer"
        )
    blocks = 3  # along each side, for the uncertainty
    rows, columns = (pairwise(np.linspace(0, n, blocks + 1).astype(int)) for n in values.shape)
    maps = [values, *(values[a:b, c:d] for (a, b), (c, d) in product(rows, columns))]
    spacing, *spacings = (1 / _peak(*_ring_spectrum(map_part, pitch, longest)) for map_part in maps)
    return spacing, float(np.std(spacings, ddof=1) / blocks)


def _as_map(values: npt.ArrayLike) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or min(array.shape) < 3:
        raise InputError(f"a map has at least 3 x 3 points in two dimensions, not shape {array.shape}")
    return array


def _ring_spectrum(values: FloatArray, pitch: float, longest: float) -> tuple[FloatArray, FloatArray]:
    """Return the frequencies and the power summed over the rings of these frequencies (Hann window)."""
    is_measured = np.isfinite(values)
    centred = np.where(is_measured, values - values[is_measured].mean(), 0.0)
    window = np.hanning(values.shape[0])[:, None] * np.hanning(values.shape[1])
    power = np.abs(np.fft.fft2(centred * window)) ** 2
    radius = np.hypot(np.fft.fftfreq(values.shape[0], pitch)[:, None], np.fft.fftfreq(values.shape[1], pitch))
    width = 2 / (min(values.shape) * pitch)
    index = (radius / width).astype(int).ravel()
    frequency = (np.arange(index.max() + 1) + 0.5) * width
    ring = np.bincount(index, weights=power.ravel())
    in_range = (frequency >= 1 / longest) & (frequency <= 0.5 / pitch)
    return frequency[in_range], ring[in_range]


def _peak(frequency: FloatArray, power: FloatArray, width: float = 0.1) -> float:
    """Return the peak of a noisy spectrum: vertex of the parabola through its logarithm.

    It is smoothed over `width`, a standard deviation in the logarithm of the frequency.
    """
    position = np.log(frequency)
    kernel = np.exp(-0.5 * ((position[:, None] - position) / width) ** 2)
    smooth = kernel @ power / kernel.sum(axis=1)
    top = int(smooth.argmax())
    is_near = np.abs(position - position[top]) <= width
    if is_near.sum() < 3:
        return float(frequency[top])
    curvature, slope, _ = np.polyfit(position[is_near] - position[top], np.log(smooth[is_near] + 1e-300), 2)
    shift = -slope / (2 * curvature) if curvature < 0 else 0.0
    return float(frequency[top] * np.exp(np.clip(shift, -width, width)))
