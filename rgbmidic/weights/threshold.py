"""Weights by a threshold: where a light is bright it reflects, and is excluded (paper, section 3.2).

The paper's second method: blur the image so that the speckle vanishes, and exclude what is brighter than a fraction of
the dynamic range.

The threshold of a set-up is found as there, from the first measurement without weights. Where the perturbation P is
half as large again as elsewhere, the reflection disturbs; the grey level of the blurred image on the contour of that
zone is the level above which the light is excluded. `rgbmidic.tools.preparation.automatic_threshold` measures it on the
frames of a test.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.special import chdtri

from rgbmidic.errors import InputError
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.settings import ELEMENT_SIZE
from rgbmidic.typing import FloatArray, FloatImage

FALLBACK = 2 / 3
"""Threshold where no reflection disturbs the first deformed frame: the paper's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdWeights:
    """One threshold for all lights and frames; a `LightWeights`.

    Attributes
    ----------
    threshold, blur
        As in `threshold_weights`.
    notes
        The threshold, where it was found from the test's own frames.
    """

    threshold: float
    blur: float
    notes: Mapping[str, float] = field(default_factory=dict)

    def reference(self, images: IlluminationImages) -> FloatImage:
        """Binary weights (k, H, W)."""
        return threshold_weights(images, threshold=self.threshold, blur=self.blur)

    def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
        """Binary weights (k, H, W)."""
        return threshold_weights(images, threshold=self.threshold, blur=self.blur)


def threshold_weights(images: IlluminationImages, *, threshold: float = FALLBACK, blur: float = 10.0) -> FloatImage:
    """Binary weights: 0 where the blurred image exceeds a fraction of the dynamic range, 1 elsewhere.

    Parameters
    ----------
    images
        Illumination images of one state, shape (k, H, W).
    threshold
        Fraction of the camera's dynamic range (`images.full_scale`); the paper finds and uses 2/3.
    blur
        Standard deviation of the Gaussian blur in px, several speckles wide.

    Returns
    -------
    ndarray, shape (k, H, W), float32
        Invalid (saturated) pixels count as full scale in the blur and have weight 0.

    Examples
    --------
    >>> values = np.full((1, 40, 60), 100.0)
    >>> values[:, :, 40:] = 900
    >>> images = IlluminationImages(values=values, valid=values > 0, names=("red",), full_scale=1000.0)
    >>> threshold_weights(images, blur=2.0)[0, 20, [0, 59]].tolist()
    [1.0, 0.0]
    """
    bright = blurred(images, blur) > threshold * images.full_scale
    return (images.valid & ~bright).astype(np.float32)


def blurred(images: IlluminationImages, blur: float) -> FloatImage:
    """Gaussian blur (k, H, W) of each light's image, invalid pixels taken as full scale.

    Parameters
    ----------
    images
        One image a light.
    blur
        Standard deviation in px.

    Returns
    -------
    ndarray, shape (k, H, W), float32

    Examples
    --------
    >>> values = np.full((1, 40, 60), 100.0)
    >>> images = IlluminationImages(values=values, valid=values > 0, names=("red",), full_scale=1000.0)
    >>> blurred(images, 2.0)[0, 20, 30].round(3)
    np.float32(100.0)
    """
    filled = np.where(images.valid, images.values, np.float32(images.full_scale))
    return np.stack([cv2.GaussianBlur(image, (0, 0), blur, borderType=cv2.BORDER_REFLECT_101) for image in filled])


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneConstants:
    """Constants by which a disturbed zone and its threshold are found.

    Attributes
    ----------
    disturbed
        The zone ends where P has fallen to this multiple of its value on an unaffected zone (paper: 150 %).
    margin
        Fraction of the dynamic range by which the threshold lies below the level on the contour (paper: 69 % and 66 %).
    ring
        Width (px) of the rings over which P is taken; the disc in their middle holds eight elements of 25 px.
    far
        The unaffected zone: rings farther from the reflection than this fraction of the farthest.
    near
        The disturbance is looked for nearer than this fraction of the farthest pixel.
    accident
        Probability of a disturbed zone where there is none. Chosen.
    independent
        Independent values in an element, whose neighbours are correlated: with twice as many, 1 of 40 shots of a mat
        sphere showed a zone (measured).
    """

    disturbed: float = 1.5
    margin: float = 0.03
    ring: float = 40.0
    far: float = 0.6
    near: float = 0.5
    accident: float = 1e-3
    independent: float = 0.5


CONSTANTS = ZoneConstants()


@dataclass(frozen=True, slots=True, kw_only=True)
class DisturbedZone:
    """The circular region that a reflection disturbs.

    Attributes
    ----------
    centre
        (x, y) in px.
    radius
        px; 0 where nothing is disturbed.
    unaffected
        P (px) on the unaffected zone.
    radii, profile : ndarray, shape (n,)
        Mean radius (px) and P (px) of rings about the centre.
    contrast
        Largest P of the rings near the centre over that on the unaffected zone. The paper's zone stands out 4 times.
    chance
        The contrast that noise alone reaches in that ring in one of a thousand measurements.

    Examples
    --------
    >>> y, x = np.mgrid[:300, :300]
    >>> disturbance = 0.2 * np.exp(-((x - 150) ** 2 + (y - 150) ** 2) / 2 / 15**2)
    >>> field = np.random.default_rng(0).normal(size=(300, 300)) * (0.01 + disturbance)
    >>> zone = disturbed_zone(field, (150.0, 150.0))
    >>> zone.centre, zone.contrast > zone.chance
    ((150.0, 150.0), True)
    """

    centre: tuple[float, float]
    radius: float
    unaffected: float
    radii: FloatArray
    profile: FloatArray
    contrast: float
    chance: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SetUpThreshold:
    """The weighting threshold of a set-up.

    Attributes
    ----------
    zone
        The disturbed zone.
    contour
        Mean grey level of the blurred image on its perimeter, as a fraction of the dynamic range.
    value
        The threshold for `rgbmidic.weights.threshold.threshold_weights` and ``weights.threshold`` of a TEST.toml.

    Examples
    --------
    >>> y, x = np.mgrid[:300, :300]
    >>> reflection = np.exp(-((x - 150) ** 2 + (y - 150) ** 2) / 2 / 15**2)
    >>> values = 1000 + 3000 * reflection[None]
    >>> images = IlluminationImages(values=values, valid=values > 0, names=("red",), full_scale=4095.0)
    >>> field = np.random.default_rng(0).normal(size=(300, 300)) * (0.01 + 0.2 * reflection)
    >>> found = set_up_threshold(field, images)
    >>> found.zone.radius > 0
    True
    """

    zone: DisturbedZone
    contour: float
    value: float


def disturbed_zone(
    high_passed: FloatArray, centre: tuple[float, float], element_size: float = ELEMENT_SIZE
) -> DisturbedZone:
    """Find how far from a reflection the displacement is disturbed.

    Parameters
    ----------
    high_passed
        `rgbmidic.fields.high_pass` of a displacement measured without weights, shape (H, W); NaN where not measured.
    centre
        Middle of the reflection, (x, y) in px.
    element_size
        Of the measurement, px: its P² has the distribution of chi square.

    Returns
    -------
    DisturbedZone

    Raises
    ------
    InputError
        The measured field is too small to tell.

    Examples
    --------
    >>> y, x = np.mgrid[:300, :300]
    >>> disturbance = 0.2 * np.exp(-((x - 150) ** 2 + (y - 150) ** 2) / 2 / 15**2)
    >>> field = np.random.default_rng(0).normal(size=(300, 300)) * (0.01 + disturbance)
    >>> zone = disturbed_zone(field, (150.0, 150.0))
    >>> 58 < zone.radius < 62  # px
    True
    """
    rows, columns = np.nonzero(np.isfinite(high_passed))
    distance = np.hypot(columns - centre[0], rows - centre[1])
    farthest, width = distance.max(initial=0), CONSTANTS.ring
    if farthest < 3 * width:
        raise InputError(f"the measured field does not reach {3 * width:g} px from the reflection at {centre}")
    ring = (distance / width).astype(int)
    count = np.bincount(ring)
    full = count >= width**2  # rings that hold enough pixels to tell
    radii = np.bincount(ring, weights=distance)[full] / count[full]
    profile = np.sqrt(np.bincount(ring, weights=high_passed[rows, columns] ** 2)[full] / count[full])
    unaffected = float(np.median(profile[radii > CONSTANTS.far * farthest]))
    near = max(1, int((radii < CONSTANTS.near * farthest).sum()))
    peak = int(profile[:near].argmax())
    independent = CONSTANTS.independent * count[full][peak] / element_size**2
    return DisturbedZone(
        centre=centre,
        radius=_first_crossing(radii, profile, CONSTANTS.disturbed * unaffected, peak),
        unaffected=unaffected,
        radii=radii,
        profile=profile,
        contrast=float(profile[peak] / unaffected),
        chance=float(np.sqrt(chdtri(independent, CONSTANTS.accident / near) / independent)),
    )


def set_up_threshold(
    high_passed: FloatArray,
    images: IlluminationImages,
    *,
    light: int = 0,
    blur: float = 10.0,
    element_size: float = ELEMENT_SIZE,
) -> SetUpThreshold:
    """The weighting threshold of a set-up, from a measurement with one light and without weights.

    The middle of the reflection is the brightest point, where there is a measurement, of the image blurred twice as
    much as for the weights.

    Parameters
    ----------
    high_passed
        `rgbmidic.fields.high_pass` of its displacement at a small motion, shape (H, W).
    images
        The reference images.
    light
        Index of the light that was used.
    blur
        Standard deviation (px) of the blur that the weights will use.
    element_size
        Of the measurement, px.

    Returns
    -------
    SetUpThreshold

    Raises
    ------
    InputError
        The displacement is nowhere disturbed beyond chance: the set-up needs no weights, or the motion is too small to
        show it.

    Examples
    --------
    >>> y, x = np.mgrid[:300, :300]
    >>> reflection = np.exp(-((x - 150) ** 2 + (y - 150) ** 2) / 2 / 15**2)
    >>> values = 1000 + 3000 * reflection[None]
    >>> images = IlluminationImages(values=values, valid=values > 0, names=("red",), full_scale=4095.0)
    >>> field = np.random.default_rng(0).normal(size=(300, 300)) * (0.01 + 0.2 * reflection)
    >>> round(set_up_threshold(field, images).value, 2)
    0.22
    """
    from scipy.ndimage import map_coordinates

    image = blurred(images, blur)[light].astype(np.float64) / images.full_scale
    smooth = np.where(np.isfinite(high_passed), blurred(images, 2 * blur)[light], -np.inf)
    row, column = np.unravel_index(int(smooth.argmax()), smooth.shape)
    zone = disturbed_zone(high_passed, (float(column), float(row)), element_size)
    if zone.contrast <= (min_contrast := max(CONSTANTS.disturbed, zone.chance)):
        raise InputError(
            f"no disturbed zone around {zone.centre}: P is {zone.contrast * zone.unaffected:.2g} px there and "
            f"{zone.unaffected:.2g} px away from it, less than {min_contrast:.2g} times as much"
        )
    # the mean over the part of the zone's perimeter that lies inside the image
    angle = np.linspace(0, 2 * np.pi, max(16, int(2 * np.pi * zone.radius)), endpoint=False)
    perimeter = [zone.centre[1] + zone.radius * np.sin(angle), zone.centre[0] + zone.radius * np.cos(angle)]
    level = float(np.nanmean(map_coordinates(image, perimeter, order=1, mode="constant", cval=np.nan)))
    return SetUpThreshold(zone=zone, contour=level, value=level - CONSTANTS.margin)


def _first_crossing(radii: FloatArray, profile: FloatArray, limit: float, peak: int) -> float:
    """Radius beyond the peak at which the profile first falls below a limit; 0 where the peak does not exceed it."""
    if not profile[peak] > limit:
        return 0.0
    below = np.flatnonzero(profile[peak:] <= limit)
    if not below.size:
        return float(radii[-1])
    outer = peak + int(below[0])
    (last_above, first_below), (near, far) = profile[outer - 1 : outer + 1], radii[outer - 1 : outer + 1]
    return float(near + (last_above - limit) / (last_above - first_below) * (far - near))
