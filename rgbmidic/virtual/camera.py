"""The virtual camera: pin-hole projection, lens blur, colour channels, sensor noise and quantisation."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.illumination.calibration import Crosstalk
from rgbmidic.illumination.mosaic import ChannelFrame, Mosaic, NoiseModel, cfa_channels
from rgbmidic.virtual.light import Light
from rgbmidic.virtual.spectra import Sensitivities, spectral_response

__all__ = ["Camera", "record"]

CameraKind = Literal["bayer", "rgb", "monochrome"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """A camera at the origin that looks along +z, x to the right and y downwards.

    Attributes
    ----------
    shape
        Rows and columns of the frame.
    focal_px
        Focal length in px: distance / (mm per px at that distance).
    lens_blur
        Standard deviation of the Gaussian lens blur (px), on top of the pixel's square aperture.
    kind
        ``"bayer"``: one colour per pixel; ``"rgb"``: all three at every pixel (3-CCD); ``"monochrome"``.
    cfa
        Bayer pattern.
    crosstalk
        A in channels = A . lights, shape (3, k), or (1, k) for a monochrome camera. None: from `sensitivities` and the
        lights' spectra, or without these the identity (all ones for a monochrome camera).
    sensitivities
        Spectral sensitivities, for a crosstalk that follows from physics.
    exposure
        Fraction of full scale that an ideal white gives under a light of power 1 at its nominal distance, in the
        channel that sees the light best.
    bits, black_level
        Depth of the analogue-digital converter; grey level of a dark sample. Saturation is at 2**bits - 1.
    gain
        Electrons per grey level.
    read_noise
        Standard deviation in electrons.
    samples
        Rays per pixel and direction: ``samples**2`` rays per pixel. None: as many as the paint needs
        (`rgbmidic.virtual.rendering.samples_needed`).
    exposure_time
        Seconds; a body with a velocity is blurred over it.
    """

    shape: tuple[int, int]
    focal_px: float = 600 / 0.055
    lens_blur: float = 0.45
    kind: CameraKind = "bayer"
    cfa: str = "RGGB"
    crosstalk: npt.NDArray[np.float64] | None = None
    sensitivities: Sensitivities | None = None
    exposure: float = 0.5
    bits: int = 12
    black_level: int = 64
    gain: float = 4.0
    read_noise: float = 12.0
    samples: int | None = None
    exposure_time: float = 0.0

    def __post_init__(self) -> None:
        if not (len(self.shape) == 2 and min(self.shape) >= 2):
            raise InputError(f"a frame has at least 2 rows and 2 columns, not {self.shape}")
        if self.kind not in ("bayer", "rgb", "monochrome"):
            raise InputError(f"unknown camera kind {self.kind!r}; allowed are bayer, rgb, monochrome")
        cfa_channels(self.cfa)
        if not (8 <= self.bits <= 16 and 0 <= self.black_level < 2**self.bits - 1):
            raise InputError(f"bits lie in 8 to 16 and black_level below saturation: {self.bits}, {self.black_level}")
        if not (self.focal_px > 0 and 0 <= self.lens_blur <= 20 and (self.samples is None or 1 <= self.samples <= 64)):
            raise InputError(
                f"focal_px is positive, lens_blur 0 to 20 px, samples 1 to 64; given are {self.focal_px}, "
                f"{self.lens_blur}, {self.samples}"
            )
        if not (self.gain > 0 and self.read_noise >= 0 and self.exposure > 0 and self.exposure_time >= 0):
            raise InputError(
                f"gain and exposure are positive, read_noise and exposure_time not negative; given are {self.gain}, "
                f"{self.exposure}, {self.read_noise}, {self.exposure_time}"
            )
        if self.crosstalk is not None:
            object.__setattr__(self, "crosstalk", np.asarray(self.crosstalk, dtype=np.float64))

    @property
    def centre(self) -> tuple[float, float]:
        """Principal point (x, y) in px: the middle of the frame."""
        return (self.shape[1] - 1) / 2, (self.shape[0] - 1) / 2

    @property
    def channels(self) -> int:
        """Number of colour channels."""
        return 1 if self.kind == "monochrome" else 3

    @property
    def white_level(self) -> int:
        """Grey level at which samples saturate."""
        return int(2**self.bits - 1)

    @property
    def full_scale(self) -> float:
        """Saturation above black, DN."""
        return float(self.white_level - self.black_level)

    @property
    def noise(self) -> NoiseModel:
        """The noise in the terms of the rest of rgbmidic; read noise in DN, quantisation not included."""
        return NoiseModel(gain=self.gain, read_noise=self.read_noise / self.gain)

    def response(self, lights: tuple[Light, ...]) -> npt.NDArray[np.float64]:
        """Response (C, k) of each channel to each light; its largest entry is 1.

        Raises
        ------
        InputError
            The crosstalk does not fit the lights, or a light lacks its spectrum.
        """
        matrix = self._matrix(lights)
        if matrix.shape != (self.channels, len(lights)) or not np.isfinite(matrix).all() or matrix.min() < 0:
            raise InputError(
                f"the crosstalk of a {self.kind} camera under {len(lights)} lights is a matrix of shape "
                f"({self.channels}, {len(lights)}) of numbers not negative, not {matrix.tolist()}"
            )
        if not (matrix.max(axis=0) > 0).all():
            raise InputError(f"the camera does not see every light: crosstalk {matrix.tolist()}")
        return np.asarray(matrix / matrix.max())

    def _matrix(self, lights: tuple[Light, ...]) -> npt.NDArray[np.float64]:
        if self.crosstalk is not None:
            return self.crosstalk
        if self.sensitivities is not None:
            spectra = tuple(light.spectrum for light in lights if light.spectrum is not None)
            if len(spectra) != len(lights):
                raise InputError("camera sensitivities are given, so every light needs its spectrum")
            matrix = spectral_response(self.sensitivities, spectra)
            return matrix.mean(axis=0, keepdims=True) if self.kind == "monochrome" else matrix
        if self.kind == "monochrome":
            return np.ones((1, len(lights)))
        return np.eye(3)[:, : len(lights)]

    def mixing(self, lights: tuple[Light, ...]) -> npt.NDArray[np.float64]:
        """A (C, k) in channels = A . light images; every column's largest entry is 1."""
        matrix = self.response(lights)
        return np.asarray(matrix / matrix.max(axis=0))

    def true_crosstalk(self, lights: tuple[Light, ...]) -> Crosstalk:
        """The crosstalk that a perfect calibration would find."""
        return Crosstalk(matrix=self.mixing(lights), lights=tuple(light.name for light in lights))


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
        What each light alone gives (`rgbmidic.virtual.render`).
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


def _channel_signal(
    images: npt.NDArray[np.floating], camera: Camera, lights: tuple[Light, ...]
) -> npt.NDArray[np.float32]:
    """Noise-free DN above black: (H, W) behind a colour filter array, else (C, H, W)."""
    matrix = camera.mixing(lights)
    channels: npt.NDArray[np.float32] = np.einsum(
        "cl,lyx->cyx", matrix.astype(np.float32), images.astype(np.float32, copy=False)
    )
    if camera.kind != "bayer":
        return channels
    mosaic = np.empty(channels.shape[1:], dtype=np.float32)
    for (row, column), channel in np.ndenumerate(cfa_channels(camera.cfa)):
        mosaic[row::2, column::2] = channels[channel, row::2, column::2]
    return mosaic


def _expose(signal: npt.NDArray[np.float32], camera: Camera, generator: np.random.Generator) -> npt.NDArray[np.uint16]:
    electrons = generator.poisson(np.maximum(signal, 0) * camera.gain).astype(np.float64)
    if camera.read_noise > 0:
        electrons += generator.normal(scale=camera.read_noise, size=signal.shape)
    levels = np.rint(electrons / camera.gain + camera.black_level)
    return np.clip(levels, 0, camera.white_level).astype(np.uint16)
