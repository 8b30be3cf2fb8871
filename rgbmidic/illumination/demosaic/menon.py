"""Demosaicing along the direction in which the colour differences vary less (Menon, Andriani, Calvagno 2007)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import correlate, correlate1d

from rgbmidic.frames.data import cfa_channels
from rgbmidic.illumination.demosaic.base import check_mosaic
from rgbmidic.illumination.linearise import LinearChannels, LinearMosaic
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["MenonDemosaicer"]


_ALONG, _ACROSS = 1, 0
_GREEN = np.array([-0.25, 0.5, 0.5, 0.5, -0.25])
_NEIGHBOURS = np.array([0.5, 0.0, 0.5])
_THREE = np.full(3, 1 / 3)
# differences D at x are |C(x) - C(x + 2)|: the columns are those symmetrical about the centre
_VARIATION = np.array([[1.0, 0, 1, 0, 0], [0, 1, 0, 0, 0], [3, 0, 3, 0, 0], [0, 1, 0, 0, 0], [1, 0, 1, 0, 0]])


@dataclass(frozen=True, slots=True, kw_only=True)
class MenonDemosaicer:
    """Green along the better direction, red and blue through the colour differences, then refined.

    The sharpest of the usual methods where the channels share their texture, and no better than Malvar where they do
    not. Choosing a direction pixel by pixel makes it non-linear: its noise depends on the texture.

    References
    ----------
    D. Menon, S. Andriani, G. Calvagno, Demosaicing with directional filtering and a posteriori decision, IEEE
    Transactions on Image Processing 16 (2007) 132-141.
    """

    refine: bool = True

    def __call__(self, mosaic: LinearMosaic) -> LinearChannels:
        """Demosaic; see `Demosaicer`. A value that a saturated sample took part in is NaN."""
        check_mosaic(mosaic)
        values = np.where(mosaic.saturated, np.float32(np.nan), mosaic.values).astype(np.float32)
        rows, columns = values.shape
        site = np.tile(cfa_channels(mosaic.cfa), (-(-rows // 2), -(-columns // 2)))[:rows, :columns]
        green, along = _green(values, site)
        channels = _complete(values, green, site, along)
        if self.refine:
            channels = _refined(channels, site, along)
        return LinearChannels(
            values=channels, valid=np.isfinite(channels), full_scale=mosaic.full_scale, noise=mosaic.noise
        )


def _filtered(image: FloatImage, taps: FloatArray, axis: int) -> FloatImage:
    return np.asarray(correlate1d(image, taps, axis=axis, mode="mirror"))


def _green(values: FloatImage, site: npt.NDArray[np.intp]) -> tuple[FloatImage, BoolArray]:
    """Green everywhere, and where the direction along the row was the better one."""
    is_green = site == 1
    candidates, variations = [], []
    for axis in (_ALONG, _ACROSS):
        green = np.where(is_green, values, _filtered(values, _GREEN, axis))
        difference = np.where(is_green, np.float32(0), values - green)
        step = np.abs(difference - np.roll(np.pad(difference, 2, mode="reflect"), -2, axis=axis)[2:-2, 2:-2])
        variations.append(correlate(step, _VARIATION if axis == _ALONG else _VARIATION.T, mode="mirror"))
        candidates.append(green)
    along = variations[1] >= variations[0]
    return np.where(along, candidates[0], candidates[1]), along


def _complete(values: FloatImage, green: FloatImage, site: npt.NDArray[np.intp], along: BoolArray) -> FloatImage:
    """All three channels from the samples and the full green."""
    out = np.stack([np.where(site == 0, values, 0), green, np.where(site == 2, values, 0)]).astype(np.float32)
    for colour in (0, 2):
        plane = out[colour]
        in_row = (site == colour).any(axis=1)[:, None]
        for axis, where in ((_ALONG, in_row), (_ACROSS, ~in_row)):
            value = green + _filtered(plane, _NEIGHBOURS, axis) - _filtered(green, _NEIGHBOURS, axis)
            plane = np.where((site == 1) & where, value, plane)
        out[colour] = plane
    first, last = out[0].copy(), out[2].copy()
    for colour, plane, other in ((0, first, last), (2, last, first)):
        step = plane - other
        value = other + np.where(along, _filtered(step, _NEIGHBOURS, _ALONG), _filtered(step, _NEIGHBOURS, _ACROSS))
        out[colour] = np.where(site == 2 - colour, value, plane)
    return out


def _refined(channels: FloatImage, site: npt.NDArray[np.intp], along: BoolArray) -> FloatImage:
    """Colour differences averaged along the chosen direction, first for green, then for red and blue."""
    red, green, blue = channels
    for colour, plane in ((0, red), (2, blue)):
        green = np.where(site == colour, plane - _directed(plane - channels[1], along), green)
    refined = []
    for colour, plane in ((0, red), (2, blue)):
        difference, in_row = plane - green, (site == colour).any(axis=1)[:, None]
        near = np.where(in_row, _filtered(difference, _NEIGHBOURS, _ALONG), _filtered(difference, _NEIGHBOURS, _ACROSS))
        refined.append(np.where(site == 1, green + near, plane))
    red, blue = refined
    smooth = _directed(red - blue, along)
    red, blue = np.where(site == 2, blue + smooth, red), np.where(site == 0, red - smooth, blue)
    return np.stack([red, green, blue]).astype(np.float32)


def _directed(image: FloatImage, along: BoolArray) -> FloatImage:
    return np.where(along, _filtered(image, _THREE, _ALONG), _filtered(image, _THREE, _ACROSS))
