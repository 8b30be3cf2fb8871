"""The weighting threshold of a set-up, found as in paper section 3.2 from the first measurement without weights.

Where the perturbation is half as large again as elsewhere, the reflection disturbs. The grey level of the blurred image
on the contour of that zone is the level above which the light is excluded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.typing import FloatArray
from rgbmidic.weights.threshold import blurred

__all__ = ["DisturbedZone", "SetUpThreshold", "disturbed_zone", "set_up_threshold"]


DISTURBED = 1.5
"""The zone ends where P has fallen to this multiple of its value on an unaffected zone (paper: 150 %)."""
MARGIN = 0.03
"""Share of the dynamic range by which the threshold lies below the level on the contour (paper: 69 % and 66 %)."""
RING = 40.0
"""Width (px) of the rings over which P is taken; the disc in their middle holds eight elements of 25 px."""
_FAR = 0.6
"""The unaffected zone, where none is given: rings farther from the reflection than this share of the farthest."""
_NEAR = 0.5
"""The disturbance is looked for nearer than this share of the farthest pixel."""


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
        Largest P of the rings near the centre over that on the unaffected zone. The paper's zone stands out 4 times;
        the contour of one that hardly reaches 1.5 is an accident of noise.
    """

    centre: tuple[float, float]
    radius: float
    unaffected: float
    radii: FloatArray
    profile: FloatArray
    contrast: float


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
    """

    zone: DisturbedZone
    contour: float
    value: float


def disturbed_zone(high_passed: FloatArray, centre: tuple[float, float]) -> DisturbedZone:
    """Find how far from a reflection the displacement is disturbed.

    Parameters
    ----------
    high_passed
        `rgbmidic.fields.high_pass` of a displacement measured without weights, shape (H, W); NaN where not measured.
    centre
        Middle of the reflection, (x, y) in px.

    Raises
    ------
    InputError
        The measured field is too small to tell.
    """
    rows, columns = np.nonzero(np.isfinite(high_passed))
    distance = np.hypot(columns - centre[0], rows - centre[1])
    if not rows.size or distance.max() < 3 * RING:
        raise InputError(f"the measured field does not reach {3 * RING:g} px from the reflection at {centre}")
    radii, profile = _ring_profile(distance, high_passed[rows, columns])
    unaffected = float(np.median(profile[radii > _FAR * distance.max()]))
    near = max(1, int((radii < _NEAR * distance.max()).sum()))
    peak = int(profile[:near].argmax())
    return DisturbedZone(
        centre=centre,
        radius=_first_crossing(radii, profile, DISTURBED * unaffected, peak),
        unaffected=unaffected,
        radii=radii,
        profile=profile,
        contrast=float(profile[peak] / unaffected),
    )


def set_up_threshold(
    high_passed: FloatArray, images: IlluminationImages, *, light: int = 0, blur: float = 10.0
) -> SetUpThreshold:
    """The weighting threshold of a set-up, from a measurement with one light and without weights.

    The middle of the reflection is the brightest point, where there is a measurement, of the image blurred twice as
    much as for the weights.

    Parameters
    ----------
    high_passed
        `rgbmidic.fields.high_pass` of its displacement at a small motion, shape (H, W).
    images
        The reference images; `light` is the one that was used.
    blur
        Standard deviation (px) of the blur that the weights will use.

    Raises
    ------
    InputError
        The displacement is nowhere disturbed: the set-up needs no weights, or the motion is too small to show it.
    """
    image = blurred(images, blur)[light].astype(np.float64) / images.full_scale
    smooth = np.where(np.isfinite(high_passed), blurred(images, 2 * blur)[light], -np.inf)
    row, column = np.unravel_index(int(smooth.argmax()), smooth.shape)
    zone = disturbed_zone(high_passed, (float(column), float(row)))
    if not zone.radius > 0:
        raise InputError(
            f"no disturbed zone around {zone.centre}: P is {zone.contrast * zone.unaffected:.2g} px there and "
            f"{zone.unaffected:.2g} px away from it, less than {DISTURBED:g} times as much"
        )
    level = _mean_on_circle(image, zone)
    return SetUpThreshold(zone=zone, contour=level, value=level - MARGIN)


def _ring_profile(distance: FloatArray, ripple: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean radius and root mean square of the rings that hold enough pixels to tell."""
    index = (distance / RING).astype(int)
    count = np.bincount(index)
    full = count >= RING**2
    radii = np.bincount(index, weights=distance)[full] / count[full]
    return radii, np.sqrt(np.bincount(index, weights=ripple**2)[full] / count[full])


def _first_crossing(radii: FloatArray, profile: FloatArray, limit: float, peak: int) -> float:
    """Radius beyond the peak at which the profile first falls below a limit; 0 where the peak does not exceed it."""
    if not profile[peak] > limit:
        return 0.0
    for inner in range(peak, len(profile) - 1):
        here, following = profile[inner], profile[inner + 1]
        if following <= limit:
            share = (here - limit) / (here - following)
            return float(radii[inner] + share * (radii[inner + 1] - radii[inner]))
    return float(radii[-1])


def _mean_on_circle(image: FloatArray, zone: DisturbedZone) -> float:
    """Mean of an image over the part of the zone's perimeter that lies inside it."""
    from scipy.ndimage import map_coordinates

    angle = np.linspace(0, 2 * np.pi, max(16, int(2 * np.pi * zone.radius)), endpoint=False)
    place = [zone.centre[1] + zone.radius * np.sin(angle), zone.centre[0] + zone.radius * np.cos(angle)]
    return float(np.nanmean(map_coordinates(image, place, order=1, mode="constant", cval=np.nan)))
