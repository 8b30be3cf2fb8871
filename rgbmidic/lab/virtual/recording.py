"""What the camera of a scene records: colour filter array, shot and read noise, quantisation, saturation."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.frames.data import ChannelFrame, Mosaic, cfa_channels
from rgbmidic.scene.camera import Camera
from rgbmidic.scene.light import Light
from rgbmidic.typing import FloatImage

__all__ = ["record"]


def record(
    images: npt.NDArray[np.floating],
    camera: Camera,
    lights: tuple[Light, ...],
    *,
    seed: int,
    on: Collection[str] | None = None,
) -> Mosaic | ChannelFrame:
    """The raw frame that the camera takes.

    Electrons = Poisson(gain x signal) + normal(read noise); DN = round(electrons/gain + black), clipped at saturation.

    Parameters
    ----------
    images : (k, H, W)
        What each light alone gives (`rgbmidic.lab.virtual.render`).
    camera
        The camera.
    lights
        The k lights of the images.
    seed
        Of the noise; the same seed gives the same frame.
    on
        Names of the lights that shine; None: all together, () a dark frame.

    Returns
    -------
    Mosaic (Bayer camera) or ChannelFrame (3 channels, or 1 for a monochrome camera)
    """
    signal = _channel_signal(_lit(np.asarray(images), lights, on), camera, lights)
    values = _expose(signal, camera, np.random.default_rng(seed))
    black = np.array(float(camera.black_level))
    if camera.kind == "bayer":
        return Mosaic(values=values, cfa=camera.cfa, black_level=black, white_level=camera.white_level)
    return ChannelFrame(values=values, black_level=black, white_level=camera.white_level)


def _lit(
    images: npt.NDArray[np.floating], lights: tuple[Light, ...], on: Collection[str] | None
) -> npt.NDArray[np.floating]:
    """The images with those of the lights that are off set to nothing."""
    if images.ndim != 3 or len(images) != len(lights):
        raise InputError(f"{len(lights)} lights give as many images (k, H, W), not an array of shape {images.shape}")
    if on is None:
        return images
    names = [light.name for light in lights]
    if unknown := set(on) - set(names):
        raise InputError(f"no light {', '.join(sorted(unknown))}; there are {', '.join(names)}")
    return np.asarray(images * np.array([name in on for name in names], dtype=images.dtype)[:, None, None])


def _channel_signal(images: npt.NDArray[np.floating], camera: Camera, lights: tuple[Light, ...]) -> FloatImage:
    """Noise-free DN above black: (H, W) behind a colour filter array, else (C, H, W)."""
    matrix = camera.mixing(lights)
    channels: FloatImage = np.einsum("cl,lyx->cyx", matrix.astype(np.float32), images.astype(np.float32, copy=False))
    if camera.kind != "bayer":
        return channels
    mosaic = np.empty(channels.shape[1:], dtype=np.float32)
    for (row, column), channel in np.ndenumerate(cfa_channels(camera.cfa)):
        mosaic[row::2, column::2] = channels[channel, row::2, column::2]
    return mosaic


def _expose(signal: FloatImage, camera: Camera, generator: np.random.Generator) -> npt.NDArray[np.uint16]:
    electrons = generator.poisson(np.maximum(signal, 0) * camera.gain).astype(np.float64)
    if camera.read_noise > 0:
        electrons += generator.normal(scale=camera.read_noise, size=signal.shape)
    levels = np.rint(electrons / camera.gain + camera.black_level)
    return np.clip(levels, 0, camera.white_level).astype(np.uint16)
