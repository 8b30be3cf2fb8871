"""Figures of the samples and of the lights in a region, from which an inspection is made up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbmidic.frames.data import sampled_channels
from rgbmidic.illumination.images import REFLECTING, IlluminationImages
from rgbmidic.illumination.linearise import LinearMosaic, NoiseModel
from rgbmidic.illumination.normalise import DARK, local_mean
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.lab.inspection.results import BLIND, ChannelFacts, LightFacts, Spread
from rgbmidic.lab.inspection.samples import Channel, noise_estimate, speckle_texture
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["SampleFacts", "contrast_window", "green_difference", "hidden", "level_and_contrast", "light_facts"]

CONTRAST_WIDTH = (10.0, 40.0)
"""Least and largest standard deviation (px) of the window in which local contrast is taken: 2.5 speckles between."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleFacts:
    """What the samples of the channels tell: figures, the camera noise, and the autocorrelation of the speckle."""

    facts: tuple[ChannelFacts, ...]
    noise: NoiseModel
    texture: TextureModel | None

    @classmethod
    def of(
        cls, channels: list[Channel], inside: BoolArray, calibrated: NoiseModel | None, full_scale: float
    ) -> SampleFacts:
        """Of the samples inside the region; `calibrated` is the noise where it is known."""
        textures = [speckle_texture(channel, inside, calibrated) for channel in channels]
        estimates = noise_estimate(channels, inside) if calibrated is None else []
        known = [estimate for estimate in estimates if np.isfinite(estimate)]
        typical = float(np.sqrt(np.mean(np.square(known)))) if known else 0.0
        noise = calibrated or NoiseModel(gain=float("inf"), read_noise=typical)
        facts = []
        for number, channel in enumerate(channels):
            samples = channel.values[inside & np.isfinite(channel.values)] / full_scale
            low, high = np.quantile(samples, [0.05, 0.95])
            level, texture = float(samples.mean()), textures[number]
            facts.append(
                ChannelFacts(
                    name=channel.name,
                    mean=level,
                    low=float(low),
                    high=float(high),
                    saturated=float(channel.saturated[inside].sum() / samples.size),
                    speckle_px=float("nan") if texture is None else texture.diameter,
                    noise_dn=estimates[number]
                    if estimates
                    else float(noise.variance(np.array(level * full_scale))) ** 0.5,
                )
            )
        sharpest = sorted((texture for texture in textures if texture), key=lambda texture: texture.diameter)
        return cls(facts=tuple(facts), noise=noise, texture=sharpest[len(sharpest) // 2] if sharpest else None)


def contrast_window(channels: tuple[ChannelFacts, ...]) -> float:
    """Standard deviation (px) of a window that holds many speckles."""
    sizes = [channel.speckle_px for channel in channels if np.isfinite(channel.speckle_px)]
    return float(np.clip(2.5 * np.median(sizes) if sizes else 0.0, *CONTRAST_WIDTH))


def level_and_contrast(images: IlluminationImages, window: float) -> tuple[FloatImage, FloatImage]:
    """Local mean of each light (k, H, W), and its local standard deviation over it, 0 where it is dark or unknown."""
    level, contrast = np.zeros((2, *images.values.shape), dtype=np.float32)
    for image, mean, relative in zip(images.values, level, contrast, strict=True):
        mean[:] = np.nan_to_num(local_mean(image, window))
        lit = np.isfinite(image) & (mean > DARK * images.full_scale)
        square = local_mean(image**2, window)
        relative[lit] = np.sqrt(np.maximum(square[lit] - mean[lit] ** 2, 0)) / mean[lit]
    return level, contrast


def hidden(contrast: FloatImage, inside: BoolArray) -> BoolArray:
    """Where (H, W) no light has half the contrast that is usual in the region."""
    best = contrast.max(axis=0)
    return np.asarray(best < BLIND * np.quantile(best[inside], 0.9))


def light_facts(
    images: IlluminationImages,
    contrast: FloatImage,
    index: FloatImage | None,
    alone: Sequence[FloatArray],
    inside: BoolArray,
) -> tuple[LightFacts, ...]:
    """Figures of each light in the region, from its contrast, its reflection index and its uncertainty alone."""
    facts = []
    for j, light in enumerate(images.names):
        values, valid = images.values[j][inside], images.valid[j][inside]
        mean = local_mean(images.values[j], CONTRAST_WIDTH[0])[inside]
        facts.append(
            LightFacts(
                name=light,
                mean=float(values[valid].mean() / images.full_scale) if valid.any() else float("nan"),
                contrast=float(np.median(contrast[j][inside])),
                reflecting=None if index is None else float((index[j][inside] > REFLECTING).mean()),
                valid=float(valid.mean()),
                negative=float((mean < -0.002 * images.full_scale).mean()),
                alone=Spread.of(alone[j]),
            )
        )
    return tuple(facts)


def green_difference(mosaic: LinearMosaic) -> float:
    """Difference of the means of the two greens of a mosaic over their mean."""
    green = sampled_channels(mosaic.cfa, mosaic.values.shape) == 1
    first, second = (float(mosaic.values[row::2][green[row::2]].mean()) for row in (0, 1))
    return abs(first - second) / max((first + second) / 2, 1e-6)
