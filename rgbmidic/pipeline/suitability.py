"""Why a state cannot be measured, or hardly: no texture, no light, too much of it, wrong levels, coarse speckle."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.images import DARK, IlluminationImages, local_mean
from rgbmidic.illumination.linear import QUANTISATION
from rgbmidic.illumination.separation import RawState
from rgbmidic.illumination.texture import speckle_diameter
from rgbmidic.mesh import FiniteElementMesh, Region, Tri3Mesh
from rgbmidic.typing import AnyArray, BoolArray, FloatArray

logger = logging.getLogger(__name__)

SPECKLES = 3.0
"""Least number of speckles on the side of an element (iDICs Good Practices Guide, for subsets)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SuitabilityConstants:
    """From where on a state cannot be measured, or hardly.

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
    saturated
        Fraction of the samples in the region that are saturated, beyond that of the reference, from which a frame is
        over-exposed. Chosen: reflections saturate a few per cent; three times the exposure saturates a fifth and more.
    """

    no_texture: float = 0.05
    faint_texture: float = 0.2
    hardly_enough: float = 1.3
    enough: float = 2.0
    saturated: float = 0.1


SUITABILITY = SuitabilityConstants()


def light_levels(images: IlluminationImages, region: Region) -> dict[str, float]:
    """Median grey level of each light in the region, as a fraction of the full scale; 0 where nothing is usable."""
    known = (light[np.isfinite(light)] for light in images.values[:, region.mask])
    usable = images.full_scale > 0
    medians = (float(np.median(light)) / images.full_scale if light.size and usable else 0.0 for light in known)
    return dict(zip(images.names, medians, strict=True))


def tell_small(mesh: Tri3Mesh, speckle: float | None, finite_elements: FiniteElementMesh) -> None:
    """Warn of finite elements that are small for the speckle, with the uncertainty to expect.

    It goes with the inverse of the element's side (`rgbmidic.scene.forecast.node_constant`).
    """
    sides = np.sqrt(2 * mesh.areas)
    few = SPECKLES * (speckle or 0.0)
    if not (small := sides < few).any():
        return
    least = int(np.argmin(sides))
    typical = float(np.median(sides[small]))
    text = (
        f"{int(small.sum())} of {sides.size} triangles have sides under {SPECKLES:g} speckles of {speckle:.1f} px, "
        f"{typical:.1f} px in the median (element {finite_elements.element_numbers[least]}: {sides[least]:.1f} px): "
        f"expect {few / typical:.1f} times ({few / sides[least]:.1f} times) the uncertainty of elements of "
        f"{SPECKLES:g} speckles; with fewer than {SUITABILITY.enough:g} nodes are lost"
    )
    logger.warning("%s: %s", finite_elements.name, text)


def speckle_size(images: IlluminationImages, region: Region) -> float | None:
    """Size of the speckle (px), the median over the lights that are on, in the middle of the region; None: unknown."""
    side = 256  # px: a thousand speckles of 8 px
    ends = []
    for axis in (1, 0):
        inside = np.flatnonzero(region.mask.any(axis=axis))
        first = max(int(np.median(inside)) - side // 2, int(inside[0]))
        ends.append(slice(first, min(first + side, int(inside[-1]) + 1)))
    levels = light_levels(images, region).values()
    lit = [level >= DARK for level in levels] if max(levels) >= DARK else [True] * len(images.names)
    pictures = images.values[lit][:, *ends]
    known = [np.where(np.isfinite(one), one, np.nanmean(one)) for one in pictures if np.isfinite(one).any()]
    sizes = [size for one in known if (size := speckle_diameter(one.astype(np.float64))) is not None]
    return float(np.median(sizes)) if sizes else None


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
    shown = [neighbour_correlation(frame, inside) for frame in frames]
    told = f"neighbouring samples of the reference ({name}) correlate by {min(shown):.2f} in the region"
    if max(shown) < SUITABILITY.no_texture:
        raise FrameError(
            f"{told}, where noise gives 0 and speckle .4 or more: there is no texture above the noise to measure with"
        )
    if min(shown) < SUITABILITY.faint_texture:
        logger.warning("%s, where speckle gives .4 or more: its contrast is hardly above the noise", told)


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
    own = sum(float((p[:, 1:] * p[:, :-1]).sum() + (p[1:] * p[:-1]).sum()) / 2 for p in planes) / sum(energy)
    pairs = list(combinations(range(len(planes)), 2))
    total = sum(float(np.sqrt(energy[a] * energy[b])) for a, b in pairs)
    return max(own, sum(float((planes[a] * planes[b]).sum()) for a, b in pairs) / total if pairs else 0.0)


def _planes(frame: Mosaic | ChannelFrame | IlluminationImages, inside: BoolArray) -> list[FloatArray]:
    """Samples of each channel on their own lattice, less their local mean (shading); 0 outside and where saturated."""
    step = 2 if isinstance(frame, Mosaic) else 1
    usable = inside & (frame.valid if isinstance(frame, IlluminationImages) else frame.values < frame.white_level)
    known = np.where(usable, frame.values, np.nan).astype(np.float32).reshape(-1, *inside.shape)
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    # a cell of a mosaic is any 2 x 2 samples, wherever the region begins
    height, width = (int(index[-1] + 1 - index[0]) // step * step for index in (rows, columns))
    window = known[:, rows[0] : rows[0] + height, columns[0] : columns[0] + width]
    planes = [channel[p::step, q::step] for channel in window for p in range(step) for q in range(step)]
    return [np.nan_to_num(plane - local_mean(plane, 5.0)).astype(np.float64) for plane in planes]


def exposure_fault(state: RawState, inside: BoolArray) -> str | None:
    """What is wrong with the exposure or the stated levels of raw frames in a region (H, W); None: nothing evident."""
    if isinstance(state, IlluminationImages):  # no samples of a camera
        return None
    faults = [_fault(frame, inside) for frame in state]
    told = [f"light {i + 1}: {fault}" if len(state) > 1 else fault for i, fault in enumerate(faults) if fault]
    return "; ".join(told) or None


def saturated_fraction(state: RawState, inside: BoolArray) -> float:
    """Fraction of the raw samples in a region (H, W) that are saturated; 0 for images of the lights."""
    if isinstance(state, IlluminationImages):
        return 0.0
    samples = np.count_nonzero(inside) / inside.size
    counts = [np.count_nonzero((frame.values >= frame.white_level) & inside) / frame.values.size for frame in state]
    return float(np.mean(counts) / samples)


def shifted_levels(samples: AnyArray, white: float) -> str | None:
    """What is wrong with samples of which the lowest bits are all 0, and the `white` level not that of the others."""
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


def too_small(element_size: float, speckle: float | None, least: float = SUITABILITY.enough) -> str:
    """What is wrong with elements (px) that have fewer than `least` speckles (px) on a side, in words; else nothing."""
    if speckle is None or element_size >= least * speckle:
        return ""
    return (
        f"elements of {element_size:g} px are too small for speckles of {speckle:.1f} px: with fewer than {least:g} "
        "speckles on a side nodes are lost and frames may not converge; set mesh.element_size to "
        f"{np.ceil(SUITABILITY.enough * speckle):.0f} or more"
    )
