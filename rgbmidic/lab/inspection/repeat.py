"""A repeat of a frame, simulated: what separating a frame like this one gets wrong, anew each time.

The reflection-aware model of the frame (local means, each channel's slope on the common texture, what is private to
each channel, the speckle's autocorrelation) describes a random frame with the statistics of the one given. Such a frame
is drawn with all its channels at every pixel, sampled behind the colour filter array, given camera noise and separated
as the test does; what comes out minus what was drawn is an error like those of the frame itself, with its correlation
between pixels and lights. This is done in two states, the second moved by a fraction of the colour filter array: what
the separation gets wrong in both alike moves with the specimen and does no harm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter, shift

from rgbmidic.frames.data import cfa_channels
from rgbmidic.illumination.colour_factors import BLOCK, LEAST, MEAN_BLOCK
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.demosaic import Reconstruction
from rgbmidic.illumination.demosaic.prediction import SPARKLE_VARIANCE
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.linearise import LinearChannels, LinearMosaic, NoiseModel
from rgbmidic.illumination.separate import _enlarged, separate
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.illumination.unmix import unmix
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["MOTION", "BayerRepeat", "gaussian_states", "noise_difference"]


SETTLED = 32.0
"""Standard deviation (px) of the window over which the model of the frame is averaged once more."""
TYPICAL = 9
"""Side (blocks) of the square over which what is private to a channel is taken by its median."""
MOTION = (1.3, 0.6)
"""Motion (x, y) in px between the two states: neither phase of the colour filter array nor pixel is met again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BayerRepeat:
    """Draws what the separation of two states of a frame gets wrong.

    Attributes
    ----------
    mosaic : LinearMosaic
        The frame.
    model : Reconstruction
        What the reflection-aware method found out about it.
    crosstalk : Crosstalk
    method : str
        How the test separates its frames (`rgbmidic.illumination.separate`).
    noise : NoiseModel or None
        Camera noise to draw; `mosaic` holds the noise that the separation knows of.
    """

    mosaic: LinearMosaic
    model: Reconstruction
    crosstalk: Crosstalk
    method: str
    noise: NoiseModel | None

    def draw(self, random: np.random.Generator) -> tuple[FloatImage, FloatImage]:
        """Difference (k, H, W) in DN between a second and a first state, on the grid of the first, that separation
        makes, and the part of it that camera noise makes."""
        first, second = (self._error(channels, random) for channels in self._states(random))
        whole, noise = (_back(later) - earlier for earlier, later in zip(first, second, strict=True))
        return whole, noise

    def _error(self, channels: FloatImage, random: np.random.Generator) -> tuple[FloatImage, FloatImage]:
        """Lights (k, H, W) found minus those drawn, and what noise does to them."""
        clean = np.take_along_axis(channels, _sites(self.mosaic)[None], axis=0)[0]
        valid = np.ones(channels.shape, dtype=bool)
        drawn = LinearChannels(values=channels, valid=valid, full_scale=self.mosaic.full_scale)
        lights, quiet = unmix(drawn, self.crosstalk).values, self._separate(clean)
        if self.noise is None:
            return quiet - lights, np.zeros_like(lights)
        found = self._separate(clean + _noise(self.noise, clean, random))
        return found - lights, found - quiet

    def _separate(self, values: FloatImage) -> FloatImage:
        nowhere = np.zeros(values.shape, dtype=bool)
        drawn = replace(self.mosaic, values=values.astype(np.float32), saturated=nowhere)
        return np.nan_to_num(separate(drawn, self.crosstalk, self.method, texture=self.model.texture).values)

    def _states(self, random: np.random.Generator) -> tuple[FloatImage, FloatImage]:
        """Channels (3, H, W) of two states with the frame's statistics, DN; the second is moved by `MOTION`."""
        shape, factors, texture = self.mosaic.values.shape, self.model.factors, self.model.texture
        mean = _enlarged(_settled(self.model.mean, MEAN_BLOCK), MEAN_BLOCK, shape)
        slope = _enlarged(_settled(factors.slope, BLOCK), BLOCK, shape)
        deviation = np.sqrt(_enlarged(_typical(factors.private - LEAST), BLOCK, shape))
        sparkle = TextureModel(weights=(1.0,), widths=(float(np.sqrt(2 * SPARKLE_VARIANCE)),))
        common = gaussian_states(texture, shape, random)
        states = np.repeat(common[:, None], 3, axis=1)
        for channel in range(3):
            if deviation[channel].any():
                coarse, fine = (gaussian_states(one, shape, random) for one in (texture, sparkle))
                own = np.sqrt(texture.private) * coarse + np.sqrt(1 - texture.private) * fine
                states[:, channel] += deviation[channel] * own
        first, second = (mean + slope * state for state in states)
        return first.astype(np.float32), second.astype(np.float32)


def noise_difference(
    frames: Sequence[LinearChannels],
    noise: NoiseModel,
    lights: Callable[[Sequence[LinearChannels]], IlluminationImages],
    random: np.random.Generator,
) -> FloatImage:
    """The same as `BayerRepeat.draw` for cameras with all channels at every pixel, where noise is all there is.

    `lights` separates the frames of one state.
    """
    quiet, errors = lights(frames).values, []
    for _ in range(2):
        noisy = [replace(one, values=one.values + _noise(noise, one.values, random)) for one in frames]
        errors.append(np.nan_to_num(lights(noisy).values - quiet))
    return np.asarray(_back(errors[1]) - errors[0])


def gaussian_states(texture: TextureModel, shape: tuple[int, ...], random: np.random.Generator) -> FloatImage:
    """A Gaussian random image with the autocorrelation of `texture` (its offset aside), periodic, and the same moved
    by `MOTION`: (2, H, W)."""
    from scipy.fft import fftfreq, irfft2, next_fast_len, rfft2, rfftfreq

    rows, columns = (next_fast_len(side, real=True) for side in shape)
    in_y, in_x = fftfreq(rows)[:, None].astype(np.float32), rfftfreq(columns).astype(np.float32)
    square = in_y**2 + in_x**2
    power = np.zeros_like(square)
    for weight, width in zip(texture.weights, texture.widths, strict=True):
        # a Gaussian's transform; of widths of 0.6 px and more hardly anything folds back
        power += weight * 2 * np.pi * width**2 * np.exp(-2 * np.pi**2 * width**2 * square)
    spectrum = rfft2(random.standard_normal((rows, columns), dtype=np.float32)) * np.sqrt(power)
    moved = spectrum * np.exp(np.complex64(-2j * np.pi) * (in_y * MOTION[1] + in_x * MOTION[0]))
    both = [irfft2(one, s=(rows, columns))[: shape[0], : shape[1]] for one in (spectrum, moved)]
    return np.asarray(both, dtype=np.float32)


def _back(images: FloatImage) -> FloatImage:
    """Images (k, H, W) of the moved state brought back by `MOTION` with the solver's interpolation."""
    return np.stack([shift(image, (-MOTION[1], -MOTION[0]), order=3, mode="mirror") for image in images])


def _settled(grid: npt.NDArray[np.floating], block: int) -> FloatArray:
    """A grid (n, h, w) of blocks without what chance, a handful of speckles in a window, makes of it.

    The channels' chance differs, and a frame in which their ratio wobbled would be harder to separate than a real one.
    """
    return np.stack([cv2.GaussianBlur(one.astype(np.float64), (0, 0), SETTLED / block) for one in grid])


def _typical(private: FloatArray) -> FloatArray:
    """Private variance (n, h, w) by its median around: chance is cut off at zero, so that a mean would be too large."""
    return np.maximum(median_filter(private, size=(1, TYPICAL, TYPICAL), mode="reflect"), 0)


def _noise(noise: NoiseModel, values: FloatImage, random: np.random.Generator) -> FloatImage:
    white = random.standard_normal(values.shape, dtype=np.float32)
    return np.asarray(white * np.sqrt(noise.variance(values)), dtype=np.float32)


def _sites(mosaic: LinearMosaic) -> npt.NDArray[np.intp]:
    rows, columns = mosaic.values.shape
    return np.tile(cfa_channels(mosaic.cfa), (-(-rows // 2), -(-columns // 2)))[:rows, :columns]
