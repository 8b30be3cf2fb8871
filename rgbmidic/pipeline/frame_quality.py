"""Why a state cannot be measured, or hardly: no texture, no light, too much of it, wrong levels, coarse speckle."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import label, maximum, maximum_position

from rgbmidic.errors import FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.checks import Check
from rgbmidic.illumination.colour_factors import BLOCK
from rgbmidic.illumination.contrast import LocalContrast
from rgbmidic.illumination.displacement import LightDisplacement
from rgbmidic.illumination.images import DARK, IlluminationImages, local_mean
from rgbmidic.illumination.linear import QUANTISATION, NoiseModel
from rgbmidic.illumination.plane_samples import saturation_pile
from rgbmidic.illumination.separation import RawState
from rgbmidic.illumination.texture import speckle_diameter
from rgbmidic.mesh import MeshLabels, Region, Tri3Mesh
from rgbmidic.typing import AnyArray, BoolArray, FloatArray

logger = logging.getLogger(__name__)

SPECKLES = 3.0
"""Least number of speckles on the side of an element (iDICs Good Practices Guide, for subsets)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SuitabilityConstants:
    """Limits beyond which a state cannot be measured, or hardly.

    Attributes
    ----------
    no_texture
        Correlation of neighbouring samples under which nothing can be measured: with speckle of 2 to 5 px no element
        matched at a contrast of .3 times the noise, where it is .02 to .05 (tests/truth/test_texture_check.py).
    faint_texture
        Correlation under which the result is poor: in the same simulation displacements were wrong by .2 to .7 px (rms)
        at a contrast of .5 to .7 times the noise, where it is .08 to .23. Speckle in focus has .5 to .95.
    hardly_enough, enough
        Speckles on the side of an element. Of 150 pairs of simulated images (speckle of 2.6 to 8.4 px and +-600 DN,
        noise of 8, 40 and 80 DN, .4 % strain) 13 of the 46 with fewer than 1.3 did not converge, some with most of
        their nodes lost, 1 of the 36 with 1.3 to 1.85, and none of the 68 with more, which lost 2 % of the nodes at
        most.
    clipped
        Fraction of the samples of a reference that are saturated from which a warning is given; chosen.
    saturated
        Fraction of the samples in the region that are saturated, beyond that of the reference, from which a frame is
        over-exposed. Chosen: reflections saturate a few per cent; three times the exposure saturates a fifth and more.
    repeated
        Correlation of the texture with itself, displaced by more than a speckle, from which it repeats itself. Of 360
        random speckles of 2 to 10 px in regions of 70 to 300 px none exceeds .35; dots on a grid reach 1, with a jitter
        of a tenth of their pitch .7 (tests/unit/pipeline/test_frame_quality.py).
    enough_speckles
        Number of speckles in the overlap of the texture with itself from which their correlation counts: it then
        scatters by .1.
    motion
        Motion (px) of the reference frames against each other from which a warning is given; chosen.
    shake
        Motion (px) from which the difference of two reference frames is more than noise: that of speckle of 300 DN/px
        is 3 DN, a third of usual camera noise.
    lateral, unregistered
        Displacement (px, rms over the region) of a light's texture from the first light's, smooth over the field, from
        which a warning is given: beyond a calibrated registration, and without one. On eight rendered scenes that lie
        in register, or are registered, it is .04 px at most, raised droplets and glare included.
    blur
        Motion (px) during the exposure from which a warning is given: the speckle's gradient is resolved to 1 px.
    """

    no_texture: float = 0.05
    faint_texture: float = 0.2
    hardly_enough: float = 1.3
    enough: float = 2.0
    clipped: float = 0.01
    saturated: float = 0.1
    repeated: float = 0.5
    enough_speckles: float = 50.0
    motion: float = 0.05
    shake: float = 0.01
    lateral: float = 0.1
    unregistered: float = 0.15
    blur: float = 1.0


SUITABILITY = SuitabilityConstants()


def light_levels(images: IlluminationImages, region: Region) -> dict[str, float]:
    """Median grey level of each light in the region, as a fraction of the full scale; 0 where nothing is usable."""
    finite_samples = (light[np.isfinite(light)] for light in images.values[:, region.mask])
    usable = images.full_scale > 0
    medians = (
        float(np.median(light)) / images.full_scale if light.size and usable else 0.0 for light in finite_samples
    )
    return dict(zip(images.names, medians, strict=True))


def warn_small_elements(mesh: Tri3Mesh, speckle: float | None, labels: MeshLabels) -> None:
    """Warn of elements of a mesh that are small for the speckle, with the uncertainty to expect.

    It goes with the inverse of the element's side (`rgbmidic.tools.scene.forecast.nodal_variance_factor`).
    """
    sides = np.sqrt(2 * mesh.areas)
    min_side = SPECKLES * (speckle or 0.0)
    if not (small := sides < min_side).any():
        return
    smallest = int(np.argmin(sides))
    typical = float(np.median(sides[small]))
    text = (
        f"{int(small.sum())} of {sides.size} triangles have sides under {SPECKLES:g} speckles of {speckle:.1f} px, "
        f"{typical:.1f} px in the median (element {labels.element_number[smallest]}: {sides[smallest]:.1f} "
        f"px): expect {min_side / typical:.1f} times ({min_side / sides[smallest]:.1f} times) the uncertainty of "
        f"elements of {SPECKLES:g} speckles; with fewer than {SUITABILITY.enough:g} nodes are lost"
    )
    logger.warning("%s: %s", labels.name, text)


def _middle(inside: BoolArray, side: int = 256) -> tuple[slice, slice]:
    """Rows and columns of the middle of a region (H, W), `side` px at most: a thousand speckles of 8 px."""
    ends = []
    for axis in (1, 0):
        index = np.flatnonzero(inside.any(axis=axis))
        first = max(int(np.median(index)) - side // 2, int(index[0])) // 2 * 2  # at a whole cell of a mosaic
        ends.append(slice(first, min(first + side, int(index[-1]) + 1)))
    return ends[0], ends[1]


def _images_of_lit_lights(images: IlluminationImages, region: Region) -> list[FloatArray]:
    """Images of the lights that are on, in the middle of the region; the mean where a pixel is not valid."""
    levels = light_levels(images, region).values()
    is_on = [level >= DARK for level in levels] if max(levels) >= DARK else [True] * len(images.names)
    pictures = images.values[is_on][:, *_middle(region.mask)].astype(np.float64)
    return [np.where(np.isfinite(image), image, np.nanmean(image)) for image in pictures if np.isfinite(image).any()]


def speckle_size(images: IlluminationImages, region: Region) -> float | None:
    """Size of the speckle (px), the median over the lights that are on, in the middle of the region; None: unknown."""
    sizes = [size for image in _images_of_lit_lights(images, region) if (size := speckle_diameter(image)) is not None]
    return float(np.median(sizes)) if sizes else None


def repetition(images: IlluminationImages, region: Region, speckle: float | None) -> str | None:
    """Find out whether the texture repeats itself in the middle of the region.

    Parameters
    ----------
    images
        One image a light.
    region
        What is measured.
    speckle
        Size of the speckle, px; None: not known.

    Returns
    -------
    str or None
        The distance and how well it agrees with itself there, in words; None: it does not repeat itself.
    """
    if speckle is None or not (pictures := _images_of_lit_lights(images, region)):
        return None
    size = [next_fast_len(2 * side, real=True) for side in pictures[0].shape]
    power = np.zeros((size[0], size[1] // 2 + 1))
    for picture in pictures:
        texture = picture - local_mean(picture.astype(np.float32), 4 * speckle)
        power += np.abs(rfft2(texture / max(float(texture.std()), 1e-6), s=size)) ** 2 / len(pictures)
    reach = [side // 2 for side in pictures[0].shape]
    lags = np.ix_(*(np.arange(-far, far + 1) for far in reach))
    overlap = np.multiply(*(side - np.abs(lag) for side, lag in zip(pictures[0].shape, lags, strict=True)))
    correlation = irfft2(power, s=size)[lags] / overlap
    correlation[overlap < SUITABILITY.enough_speckles * speckle**2] = 0
    # camera noise counts at distance 0 only: texture alone is what neighbours have in common
    unit = max(float(correlation[reach[0] + 1, reach[1]]), float(correlation[reach[0], reach[1] + 1]), 1e-6)
    peaks, count = label(correlation > SUITABILITY.repeated * unit)
    best = maximum(correlation, peaks, range(1, count + 1)) if count else []
    other_peaks = [number for number in range(1, count + 1) if number != peaks[reach[0], reach[1]]]
    clear = [number for number in other_peaks if best[number - 1] > 0.9 * max(best[peak - 1] for peak in other_peaks)]
    if not clear:
        return None
    displacements = [np.subtract(maximum_position(correlation, peaks, number), reach) for number in clear]
    row, column = min(displacements, key=lambda displacement: float(np.hypot(*displacement)))
    agreement = min(float(correlation[reach[0] + row, reach[1] + column]) / unit, 1.0)
    return (
        f"the texture repeats itself: displaced by ({abs(column)}, {abs(row)}) px it agrees with itself to "
        f"{agreement:.2f}, so that displacements may be wrong by this distance; use a random speckle, or steps of less "
        "than half of it from frame to frame"
    )


def separation_doubts(images: IlluminationImages, region: Region) -> list[Check]:
    """Return what a separated frame contradicts: the registration of the lights, or that they show one texture.

    Parameters
    ----------
    images
        One image a light, each where the lens put it, with what its separation found.
    region
        What is measured.

    Returns
    -------
    list of Check
        None for lights that were not separated by the reflection-aware method.
    """
    doubts = []
    if images.displacement is not None and (text := _describe_misregistration(images, images.displacement, region)):
        doubts.append(Check("lights apart", text))
    if images.texture is not None and not images.texture.common:
        doubts.append(
            Check(
                "no common texture",
                "the samples contradict one texture common to the lights, as prints of dots with sharp edges do, or a "
                "lens that blurs one light more than another: each channel is demosaiced by itself (malvar), without "
                "what the others see, and inspect expects too little uncertainty (a half to a quarter on printed "
                "disks); the same focus for all lights, or a softer print",
            )
        )
    return doubts


def _describe_misregistration(images: IlluminationImages, displacement: LightDisplacement, region: Region) -> str:
    """Which lights show the texture apart from the first one, how far, and what to do; else nothing."""
    shape = displacement.std.shape[1:]
    cells = np.zeros((shape[0] * BLOCK, shape[1] * BLOCK), dtype=np.float32)
    cells[: images.shape[0], : images.shape[1]] = region.mask
    inside = cells.reshape(shape[0], BLOCK, shape[1], BLOCK).mean(axis=(1, 3)) > 0.5
    if not inside.any():
        return ""
    distance = np.sqrt((displacement.lateral(inside) ** 2).sum(axis=2))
    registered = images.registration is not None
    min_distance = SUITABILITY.lateral if registered else SUITABILITY.unregistered
    rms = np.sqrt((distance**2).mean(axis=1))
    lights = [
        f"{name} lies {mean:.2f} px (up to {largest:.2f} px)"
        for name, mean, largest in zip(images.names, rms, distance.max(axis=1), strict=True)
        if mean > min_distance
    ]
    if not lights:
        return ""
    text = f"{' and '.join(lights)} from {images.names[0]}"
    if registered:
        return f"beyond the calibrated registration {text}: it is not of this set-up; rgbmidic-calibrate registration"
    return (
        f"no registration is calibrated, but {text}: at half a pixel errors are 1.2 to 1.8 times as large, most under "
        "strain; rgbmidic-calibrate registration"
    )


def background_fraction(
    images: IlluminationImages, region: Region, speckle: float | None, noise: NoiseModel | None
) -> float:
    """Fraction of the region that is dark background: neither texture nor light (`LocalContrast.background`).

    Of large regions some 2 million pixels are looked at, in rows and columns as far apart.
    """
    rows, columns = (np.flatnonzero(region.mask.any(axis=axis)) for axis in (1, 0))
    step = int(np.ceil(np.sqrt(len(rows) * len(columns) / 2e6)))
    window = slice(rows[0], rows[-1] + 1, step), slice(columns[0], columns[-1] + 1, step)
    inside = region.mask[*window]
    box = replace(images, values=images.values[:, *window], valid=images.valid[:, *window])
    contrast = LocalContrast.of(box, [] if speckle is None else [speckle / step], inside, noise)
    return float(contrast.background(inside)[inside].mean())


class ReferenceMotion:
    """Motion of reference frames against the first of them, in the middle of the region, as they are read.

    Attributes
    ----------
    largest : float
        Largest shift of a frame so far, px.
    """

    def __init__(self, inside: BoolArray) -> None:
        """Take the region (H, W)."""
        self.largest, self._window = 0.0, _middle(inside)
        self._first: FloatArray | None = None

    def watch(self, states: Iterable[RawState]) -> Iterator[RawState]:
        """Give back the states, one after the other, after a look at each."""
        for state in states:
            picture, step = self._picture(state)
            if self._first is None:
                self._first = picture
            else:
                self.largest = max(self.largest, step * _shift(self._first, picture))
            yield state

    def _picture(self, state: RawState) -> tuple[FloatArray, int]:
        """Picture of a state, and the side of its pixels; the colours of a mosaic's cell are added."""
        frame = state if isinstance(state, IlluminationImages) else state[0]
        values = frame.values[..., *self._window].astype(np.float64)
        if isinstance(frame, Mosaic):
            rows, columns = (side // 2 * 2 for side in values.shape)
            return values[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2).mean(axis=(1, 3)), 2
        return np.nan_to_num(values).mean(axis=0), 1


def unsteady(motion: float) -> str:
    """State what reference frames that move by so many px against each other mean."""
    return (
        f"the reference frames move against each other by up to {motion:.2g} px: their mean is blurred, and counts as "
        "being at rest; state frames at rest as frames.reference, or one"
    )


def _shift(first: FloatArray, second: FloatArray) -> float:
    """Length of the shift between two pictures in their pixels: of the best correlation, below a pixel by gradients."""
    # of Gaussians of 2 px the differences are gradients, and little of them is noise
    first_filtered, second_filtered = (
        cv2.GaussianBlur(picture, (0, 0), 2.0) - cv2.GaussianBlur(picture, (0, 0), 20.0) for picture in (first, second)
    )
    size = [next_fast_len(2 * side, real=True) for side in first.shape]
    correlation = irfft2(rfft2(second_filtered, s=size) * np.conj(rfft2(first_filtered, s=size)), s=size)
    best = np.unravel_index(int(correlation.argmax()), correlation.shape)
    distance = np.linalg.norm([(int(at) + side // 2) % side - side // 2 for at, side in zip(best, size, strict=True)])
    if distance > 1.5:
        return float(distance)
    along_y, along_x = np.gradient((first_filtered + second_filtered) / 2)
    system = np.stack([term.ravel() for term in (along_x, along_y, second_filtered, np.ones_like(second_filtered))])
    return float(np.hypot(*(np.linalg.pinv(system @ system.T) @ (system @ first_filtered.ravel()))[:2]))


def check_texture(state: RawState, inside: BoolArray, name: str) -> None:
    """Refuse a reference without texture, and warn of one with little.

    Parameters
    ----------
    state
        Raw frames of the reference.
    inside : ndarray, shape (H, W)
        The region.
    name
        Name of the reference in messages.

    Raises
    ------
    FrameError
        No frame shows anything in the region that noise would not.
    """
    frames = [state] if isinstance(state, IlluminationImages) else state
    correlations = [neighbour_correlation(frame, inside) for frame in frames]
    message = f"neighbouring samples of the reference ({name}) correlate by {min(correlations):.2f} in the region"
    if max(correlations) < SUITABILITY.no_texture:
        raise FrameError(
            f"{message}, where noise gives 0 and speckle .4 or more: there is no texture above the noise to measure "
            "with"
        )
    if min(correlations) < SUITABILITY.faint_texture:
        logger.warning("%s, where speckle gives .4 or more: its contrast is hardly above the noise", message)


def neighbour_correlation(frame: Mosaic | ChannelFrame | IlluminationImages, inside: BoolArray) -> float:
    """Correlation of neighbouring raw samples less their local mean: 0 for camera noise, towards 1 for texture.

    The noise of a raw sample is its own, so what neighbours have in common is texture. Neighbours are samples of one
    channel or of two, whichever agree better: lights may show different textures, and a mosaic samples a channel only
    at every other pixel. Variance below that of rounding to grey levels counts as noise. Noise of separated lights may
    have been smoothed: what is certain of raw frames is less so there.
    """
    planes = _planes(frame, inside)
    rounding = float(np.finfo(np.float32).tiny) if isinstance(frame, IlluminationImages) else QUANTISATION
    energy = [max(float((plane**2).sum()), rounding * plane.size) for plane in planes]
    within_channel = sum(float((p[:, 1:] * p[:, :-1]).sum() + (p[1:] * p[:-1]).sum()) / 2 for p in planes) / sum(energy)
    pairs = list(combinations(range(len(planes)), 2))
    total = sum(float(np.sqrt(energy[a] * energy[b])) for a, b in pairs)
    return max(within_channel, sum(float((planes[a] * planes[b]).sum()) for a, b in pairs) / total if pairs else 0.0)


def _planes(frame: Mosaic | ChannelFrame | IlluminationImages, inside: BoolArray) -> list[FloatArray]:
    """Samples of each channel on their own lattice, less their local mean (shading); 0 outside and where saturated."""
    step = 2 if isinstance(frame, Mosaic) else 1
    usable = inside & (frame.valid if isinstance(frame, IlluminationImages) else frame.values < frame.white_level)
    samples = np.where(usable, frame.values, np.nan).astype(np.float32).reshape(-1, *inside.shape)
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    # a cell of a mosaic is any 2 x 2 samples, wherever the region begins
    height, width = (int(index[-1] + 1 - index[0]) // step * step for index in (rows, columns))
    window = samples[:, rows[0] : rows[0] + height, columns[0] : columns[0] + width]
    planes = [channel[p::step, q::step] for channel in window for p in range(step) for q in range(step)]
    return [np.nan_to_num(plane - local_mean(plane, 5.0)).astype(np.float64) for plane in planes]


def exposure_fault(state: RawState, inside: BoolArray) -> str | None:
    """State what is wrong with the exposure or levels of raw frames in a region (H, W); None: nothing evident."""
    if isinstance(state, IlluminationImages):  # no samples of a camera
        return None
    faults = [_fault(frame, inside) for frame in state]
    texts = [f"light {i + 1}: {fault}" if len(state) > 1 else fault for i, fault in enumerate(faults) if fault]
    return "; ".join(texts) or None


def saturated_fraction(state: RawState, inside: BoolArray) -> float:
    """Fraction of the raw samples in a region (H, W) that are saturated; 0 for images of the lights."""
    if isinstance(state, IlluminationImages):
        return 0.0
    samples = np.count_nonzero(inside) / inside.size
    counts = [np.count_nonzero((frame.values >= frame.white_level) & inside) / frame.values.size for frame in state]
    return float(np.mean(counts) / samples)


def clipping(state: RawState) -> tuple[float, str] | None:
    """Level at which samples of raw frames pile up below their white level, and what it means; None: they do not."""
    frames = () if isinstance(state, IlluminationImages) else state
    for frame in frames:
        level = saturation_pile(frame.values, frame.white_level)
        if level is not None and np.ptp(frame.values) > 0:  # a constant has no texture to be clipped
            return level, (
                f"samples pile up at {level:.0f} DN, below white_level {frame.white_level:g}, as where a camera "
                f"saturates: clipped samples count as measured; state white_level = {level:.0f}"
            )
    return None


def shifted_levels(samples: AnyArray, white: float) -> str | None:
    """State what is wrong with samples whose lowest bits are all 0, and the `white` level not that of the others."""
    bits, largest = int(np.bitwise_or.reduce(samples, axis=None)), int(samples.max())
    step = bits & -bits  # all samples are multiples of it
    if not (step > 2 and largest > white and white * step <= 65536):
        return None
    return (
        f"the samples reach {largest} and are all multiples of {step}, as of a camera whose levels lie in the high "
        f"bits; white_level is {white:g}: should it be {65536 - step}?"
    )


def _fault(frame: Mosaic | ChannelFrame, inside: BoolArray) -> str | None:
    samples, white, black = frame.values[..., inside], frame.white_level, float(frame.black_level.mean())
    if shifted := shifted_levels(samples, white):
        return shifted
    largest = int(samples.max())
    over, dark = (samples >= white).mean(), (samples < black + DARK * (white - black)).mean()
    if over > 0.5:
        above = f"; the largest is {largest}" if largest > white else ""
        return f"{over:.0%} of the samples in the region are saturated (white_level {white:g}{above})"
    if dark > 0.5:
        return (
            f"{dark:.0%} of the samples in the region are dark: within {DARK:.0%} of the dynamic range from the black "
            f"level {black:g}; the largest is {largest}, white_level is {white:g}"
        )
    return None


def too_small(element_size: float, speckle: float | None, min_speckles: float = SUITABILITY.enough) -> str:
    """State what is wrong with elements (px) of fewer than `min_speckles` speckles (px) on a side; else nothing."""
    if speckle is None or element_size >= min_speckles * speckle:
        return ""
    return (
        f"elements of {element_size:g} px are too small for speckles of {speckle:.1f} px: with fewer than "
        f"{min_speckles:g} speckles on a side nodes are lost and frames may not converge; set mesh.element_size to "
        f"{np.ceil(SUITABILITY.enough * speckle):.0f} or more"
    )
