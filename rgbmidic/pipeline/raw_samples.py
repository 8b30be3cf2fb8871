"""Why a state cannot be measured: no texture, no light, too much, wrong levels, speckle too coarse for the elements."""

from __future__ import annotations

import logging
from itertools import combinations

import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.camera_noise import QUANTISATION
from rgbmidic.illumination.normalise import DARK, local_mean
from rgbmidic.pipeline.separation import RawState
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["HARDLY_ENOUGH", "check_texture", "exposure_fault", "neighbour_correlation", "too_small"]

logger = logging.getLogger(__name__)

NO_TEXTURE = 0.05
"""Correlation of neighbouring samples under which nothing can be measured: with speckle of 2 to 5 px no element matched
at a contrast of .3 times the noise, where it is .02 to .05 (tests/truth/test_texture_check.py)."""
FAINT_TEXTURE = 0.2
"""Correlation under which the result is poor: in the same simulation displacements were wrong by .2 to .7 px (rms) at a
contrast of .5 to .7 times the noise, where it is .08 to .23. Speckle in focus has .5 to .95."""
HARDLY_ENOUGH, _ENOUGH = 1.3, 2.0
"""Speckles on the side of an element. Of 150 pairs of simulated images (speckle of 2.6 to 8.4 px and +-600 DN, noise of
8, 40 and 80 DN, .4 % strain) 13 of the 46 with fewer than 1.3 did not converge, some with most of their nodes lost, 1
of the 36 with 1.3 to 1.85, and none of the 68 with more, which lost 2 % of the nodes at most."""
_MEAN_WIDTH = 5.0
"""Standard deviation, in samples, of the local mean that is taken off: shading is no texture."""


def check_texture(state: RawState, inside: BoolArray, name: str) -> None:
    """Refuse a reference without texture, and warn of one with little.

    Parameters
    ----------
    state
        Raw frames of the reference; its name in messages is `name`.
    inside : ndarray, shape (H, W)
        The region.

    Raises
    ------
    FrameError
        No frame shows anything in the region that noise would not.
    """
    shown = [neighbour_correlation(frame, inside) for frame in state]
    told = f"neighbouring samples of the reference ({name}) correlate by {min(shown):.2f} in the region"
    if max(shown) < NO_TEXTURE:
        raise FrameError(
            f"{told}, where noise gives 0 and speckle .4 or more: there is no texture above the noise to measure with"
        )
    if min(shown) < FAINT_TEXTURE:
        logger.warning("%s, where speckle gives .4 or more: its contrast is hardly above the noise", told)


def neighbour_correlation(frame: Mosaic | ChannelFrame, inside: BoolArray) -> float:
    """Correlation of neighbouring raw samples less their local mean: 0 for camera noise, towards 1 for texture.

    The noise of a raw sample is its own, so what neighbours have in common is texture. Neighbours are samples of one
    channel or of two, whichever agree better: lights may show different textures, and a mosaic samples a channel only
    at every other pixel. Variance below that of rounding to grey levels counts as noise.
    """
    planes = _planes(frame, inside)
    energy = [max(float((plane**2).sum()), QUANTISATION * plane.size) for plane in planes]
    own = sum(float((p[:, 1:] * p[:, :-1]).sum() + (p[1:] * p[:-1]).sum()) / 2 for p in planes) / sum(energy)
    pairs = list(combinations(range(len(planes)), 2))
    total = sum(float(np.sqrt(energy[a] * energy[b])) for a, b in pairs)
    return max(own, sum(float((planes[a] * planes[b]).sum()) for a, b in pairs) / total if pairs else 0.0)


def _planes(frame: Mosaic | ChannelFrame, inside: BoolArray) -> list[FloatArray]:
    """Samples of each channel on their own lattice, less their local mean; 0 outside and where saturated."""
    step = 2 if isinstance(frame, Mosaic) else 1
    usable = inside & (frame.values < frame.white_level)
    known = np.where(usable, frame.values, np.nan).astype(np.float32).reshape(-1, *inside.shape)
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    # a cell of a mosaic is any 2 x 2 samples, wherever the region begins
    height, width = (int(index[-1] + 1 - index[0]) // step * step for index in (rows, columns))
    window = known[:, rows[0] : rows[0] + height, columns[0] : columns[0] + width]
    planes = [channel[p::step, q::step] for channel in window for p in range(step) for q in range(step)]
    return [np.nan_to_num(plane - local_mean(plane, _MEAN_WIDTH)).astype(np.float64) for plane in planes]


def exposure_fault(state: RawState, inside: BoolArray) -> str | None:
    """What is wrong with the exposure or the stated levels of raw frames in a region (H, W); None: nothing evident."""
    faults = [_fault(frame, inside) for frame in state]
    told = [f"light {i + 1}: {fault}" if len(state) > 1 else fault for i, fault in enumerate(faults) if fault]
    return "; ".join(told) or None


def _fault(frame: Mosaic | ChannelFrame, inside: BoolArray) -> str | None:
    samples, white, black = frame.values[..., inside], frame.white_level, float(frame.black_level.mean())
    bits = int(np.bitwise_or.reduce(samples, axis=None))
    step = bits & -bits  # all samples are multiples of it
    largest = int(samples.max())
    if step > 2 and largest > white:
        return (
            f"the samples reach {largest} and are all multiples of {step}, as of a camera whose levels lie in the high "
            f"bits; white_level is {white:g}: should it be {65536 - step}?"
        )
    saturated, dark = (samples >= white).mean(), (samples < black + DARK * (white - black)).mean()
    if saturated > 0.5:
        return f"{saturated:.0%} of the samples in the region are saturated (white_level {white:g})"
    if dark > 0.5:
        return (
            f"{dark:.0%} of the samples in the region are dark: within {DARK:.0%} of the dynamic range from the black "
            f"level {black:g}; the largest is {largest}, white_level is {white:g}"
        )
    return None


def too_small(element_size: float, speckle: float | None, least: float = _ENOUGH) -> str:
    """What is wrong with elements (px) that have fewer than `least` speckles (px) on a side, in words; else nothing."""
    if speckle is None or element_size >= least * speckle:
        return ""
    return (
        f"elements of {element_size:g} px are too small for speckles of {speckle:.1f} px: with fewer than {least:g} "
        "speckles on a side nodes are lost and frames may not converge; set mesh.element_size to "
        f"{np.ceil(_ENOUGH * speckle):.0f} or more"
    )
