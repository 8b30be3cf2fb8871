"""What separating a frame gets wrong, drawn from the frame's own statistics.

The reflection-aware model of a frame (local means, each channel's slope on the common texture, what is private to each
channel, the speckle's autocorrelation) describes a random frame with the statistics of the one given. Such a frame is
drawn with all its channels at every pixel and separated as the test does, behind the four phases of the colour filter
array: what is the same in all of them moves with the specimen and does no harm, the rest stays with the sensor. Camera
noise goes the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter

from rgbmidic.frames.data import sampled_channels, shift_cfa
from rgbmidic.illumination.colour_factors import BLOCK, LEAST, MEAN_BLOCK, enlarged
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.demosaic import Reconstruction
from rgbmidic.illumination.demosaic.prediction import SPARKLE_VARIANCE
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.linearise import LinearChannels, LinearMosaic, NoiseModel
from rgbmidic.illumination.separate import separate
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["Disturbances", "gaussian_field"]


SETTLED = 32.0
"""Standard deviation (px) of the window over which the model of the frame is averaged once more."""
TYPICAL = 9
"""Side (blocks) of the square over which what is private to a channel is taken by its median."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbances:
    """Images of what disturbs the lights of one state.

    Attributes
    ----------
    noise : ndarray, shape (k, H, W), float32
        What the camera noise does to the lights, DN.
    mosaic : ndarray, shape (4, k, H, W), float32
        What behind each phase of the colour filter array differs from the mean of the four, DN; shape (0, k, H, W) for
        a camera that has all channels at every pixel.
    """

    noise: FloatImage
    mosaic: FloatImage

    @classmethod
    def of_mosaic(
        cls,
        mosaic: LinearMosaic,
        model: Reconstruction,
        crosstalk: Crosstalk,
        method: str,
        noise: NoiseModel,
        random: np.random.Generator,
    ) -> Disturbances:
        """Draw those of a raw mosaic.

        Parameters
        ----------
        mosaic
            The frame; it holds the noise that the separation knows of.
        model
            What the reflection-aware method found out about it.
        crosstalk, method
            How the test separates its frames (`rgbmidic.illumination.separate`).
        noise
            Camera noise to draw.
        random
            Source of chance.
        """
        channels = _drawn_channels(model, mosaic.values.shape, random)

        def lights(values: FloatImage, cfa: str) -> FloatImage:
            drawn = replace(mosaic, values=values, cfa=cfa, saturated=np.zeros(values.shape, dtype=bool))
            return np.nan_to_num(separate(drawn, crosstalk, method, texture=model.texture).values)

        phases = [shift_cfa(mosaic.cfa, row, column) for row, column in np.ndindex(2, 2)]
        images = np.stack([lights(_sampled(channels, cfa), cfa) for cfa in phases])
        noisy = lights(_noisy(_sampled(channels, mosaic.cfa), noise, random), mosaic.cfa)
        return cls(noise=noisy - images[0], mosaic=images - images.mean(axis=0))

    @classmethod
    def of_channels(
        cls,
        frames: Sequence[LinearChannels],
        lights: Callable[[Sequence[LinearChannels]], IlluminationImages],
        noise: NoiseModel,
        random: np.random.Generator,
    ) -> Disturbances:
        """Draw those of a camera with all channels at every pixel, where noise is all there is.

        `lights` separates the frames of one state.
        """
        quiet = lights(frames).values
        noisy = lights([replace(frame, values=_noisy(frame.values, noise, random)) for frame in frames]).values
        return cls(noise=np.nan_to_num(noisy - quiet), mosaic=np.empty((0, *quiet.shape), dtype=np.float32))


def gaussian_field(texture: TextureModel, shape: tuple[int, ...], random: np.random.Generator) -> FloatImage:
    """A Gaussian random image (H, W) with the autocorrelation of `texture`, its offset aside."""
    from scipy.fft import fftfreq, irfft2, next_fast_len, rfft2, rfftfreq

    rows, columns = (next_fast_len(side, real=True) for side in shape)
    frequency = np.hypot(fftfreq(rows).astype(np.float32)[:, None], rfftfreq(columns).astype(np.float32))
    table = np.linspace(0, 0.71, 4096)
    spectrum = rfft2(random.standard_normal((rows, columns), dtype=np.float32))
    spectrum *= np.interp(frequency, table, np.sqrt(texture.spectrum(table))).astype(np.float32)
    return np.asarray(irfft2(spectrum, s=(rows, columns))[: shape[0], : shape[1]], dtype=np.float32)


def _drawn_channels(model: Reconstruction, shape: tuple[int, ...], random: np.random.Generator) -> FloatImage:
    """Channels (3, H, W) of a random state with the frame's statistics, DN."""
    factors, texture = model.factors, model.texture
    sparkle = TextureModel(weights=(1.0,), widths=(float(np.sqrt(2 * SPARKLE_VARIANCE)),))
    channels = np.repeat(gaussian_field(texture, shape, random)[None], 3, axis=0)
    deviation = np.sqrt(enlarged(_typical(factors.private - LEAST), BLOCK, shape))
    for channel in range(3):
        if deviation[channel].any():
            coarse, fine = (gaussian_field(kind, shape, random) for kind in (texture, sparkle))
            private = np.sqrt(texture.private) * coarse + np.sqrt(1 - texture.private) * fine
            channels[channel] += deviation[channel] * private
    mean = enlarged(_settled(model.mean, MEAN_BLOCK), MEAN_BLOCK, shape)
    return np.asarray(mean + enlarged(_settled(factors.slope, BLOCK), BLOCK, shape) * channels, dtype=np.float32)


def _sampled(channels: FloatImage, cfa: str) -> FloatImage:
    """The mosaic (H, W) that a colour filter array makes of channels (3, H, W)."""
    return np.asarray(np.take_along_axis(channels, sampled_channels(cfa, channels.shape[1:])[None], axis=0)[0])


def _settled(grid: npt.NDArray[np.floating], block: int) -> FloatArray:
    """A grid (n, h, w) of blocks without what chance, a handful of speckles in a window, makes of it.

    The channels' chance differs, and a frame in which their ratio wobbled would be harder to separate than a real one.
    """
    return np.stack([cv2.GaussianBlur(layer.astype(np.float64), (0, 0), SETTLED / block) for layer in grid])


def _typical(private: FloatArray) -> FloatArray:
    """Private variance (n, h, w) by its median around: chance is cut off at zero, so that a mean would be too large."""
    return np.maximum(median_filter(private, size=(1, TYPICAL, TYPICAL), mode="reflect"), 0)


def _noisy(values: FloatImage, noise: NoiseModel, random: np.random.Generator) -> FloatImage:
    white = random.standard_normal(values.shape, dtype=np.float32)
    return np.asarray(values + white * np.sqrt(noise.variance(values)), dtype=np.float32)
