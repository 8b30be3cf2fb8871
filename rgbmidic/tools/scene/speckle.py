"""The speckle of a scene: its spectrum in closed form, and a rendered piece of it where no formula exists.

The spectrum is that of a Boolean model of discs seen through pixel aperture, lens and prefilter. The rendered piece
gives the droplets' domes and, taken through the real demosaicing and unmixing, what a Bayer mosaic does to the lights'
images: the noise that it passes and the trace that it leaves. So any method of `rgbmidic.illumination.separation` is
described, linear or not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rgbmidic.correlation.images import PREFILTERS
from rgbmidic.errors import InputError
from rgbmidic.frames.data import sampled_channels, shift_cfa
from rgbmidic.illumination.linear import LinearMosaic
from rgbmidic.illumination.separation import separate
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.tools.scene.camera import Floating, mosaic_samples
from rgbmidic.tools.scene.scene import Scene
from rgbmidic.tools.scene.surface import BOUND, Surface
from rgbmidic.typing import FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class SpecklePatch:
    """A square piece of speckle as the camera sees it.

    Attributes
    ----------
    texture : ndarray, shape (n, n)
        Grey levels with mean 1.
    domes : ndarray, shape (n, n)
        Height of the droplets above the white paint, px; without the wrinkles.
    """

    texture: FloatArray
    domes: FloatArray

    @classmethod
    def of(cls, scene: Scene, size: int, subsamples: int = 3) -> SpecklePatch:
        """Return a piece of `size` x `size` px of a scene's paint, faced at the distance of the body's front point."""
        camera, surface = scene.camera, scene.surface
        white, black = (replace(paint, slope_deg=0.0) for paint in (surface.white, surface.black))
        coordinates = (np.arange(size * subsamples) + 0.5) / subsamples * scene.pixel
        cover, height = replace(surface, white=white, black=black).on_plate(coordinates, coordinates)
        albedo = surface.white.albedo + cover * (surface.black.albedo - surface.white.albedo)
        texture = _image_fine_samples(albedo, size, camera.lens_blur)
        return cls(
            texture=texture / texture.mean(), domes=_image_fine_samples(height / scene.pixel, size, camera.lens_blur)
        )


def _image_fine_samples(fine: FloatArray, size: int, blur: float) -> FloatArray:
    """Return the fine samples averaged over the pixels and blurred by the lens."""
    pixel_means = fine.reshape(size, len(fine) // size, size, -1).mean(axis=(1, 3))
    line = np.exp(-2 * (np.pi * blur * np.fft.fftfreq(size)) ** 2)
    return np.asarray(np.fft.ifft2(np.fft.fft2(pixel_means) * np.outer(line, line)).real)


def separation_spectra(scene: Scene, texture: FloatArray, demosaic: str) -> tuple[FloatArray, FloatArray]:
    """Return the cross spectra of the errors that demosaicing and unmixing leave in the lights' images.

    Parameters
    ----------
    scene
        Bayer camera and lights; the greens count as equal, the lens as without lateral colour.
    texture : ndarray, shape (n, n)
        Of a `SpecklePatch`.
    demosaic
        Method of `rgbmidic.illumination.separation`.

    Returns
    -------
    noise : ndarray, shape (3, k, k, n, n)
        Of noise of unit variance in the samples of R, G or B.
    trace : ndarray, shape (3, k, k, n, n)
        Of the part that stays with the mosaic when the texture moves, for its three carriers (alternating along x, y
        and both), in units of each light's mean; lights of equal brightness.
    """
    camera, crosstalk = scene.camera, replace(scene.camera.true_crosstalk(scene.lights), green_difference=None)
    level, amplitude = 0.25 * camera.full_scale, 0.005 * camera.full_scale  # no sample saturates
    channels = level * crosstalk.matrix.sum(axis=1)[:, None, None] * texture

    def lights(samples: FloatArray, cfa: str) -> FloatArray:
        mosaic = LinearMosaic(
            values=samples.astype(np.float32),
            saturated=np.zeros(samples.shape, dtype=bool),
            cfa=cfa,
            full_scale=camera.full_scale,
            noise=camera.noise,
        )
        return separate(mosaic, crosstalk, demosaic).values.astype(np.float64)

    phases = separate_phases(channels, camera.cfa, lights)
    samples, colours = mosaic_samples(channels, camera.cfa), sampled_channels(camera.cfa, texture.shape)
    random, noise = np.random.default_rng(0), []
    for colour in range(3):
        noisy = samples + np.where(colours == colour, random.normal(scale=amplitude, size=samples.shape), 0)
        noise.append(cross_spectra((lights(noisy, camera.cfa) - phases[0]) / amplitude))
    # signs, in the four phases, of the parts that alternate along x, along y and along both
    signs = np.array([[1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]])
    carriers = np.tensordot(signs / 4, phases / level, axes=1)
    return np.stack(noise), np.stack([cross_spectra(carrier) for carrier in carriers])


def separate_phases(
    channels: npt.NDArray[Floating],
    cfa: str,
    lights: Callable[[npt.NDArray[Floating], str], npt.NDArray[Floating]],
) -> npt.NDArray[Floating]:
    """Return the lights separated from a state behind the four phases of a colour filter array.

    What is the same in all four moves with the specimen; the rest stays with the sensor.

    Parameters
    ----------
    channels : ndarray, shape (3, H, W) or (4, H, W)
        The state with all its channels, or kinds of sites, at every pixel.
    cfa
        Pattern of the first phase.
    lights
        Separates a mosaic (H, W) with its pattern into lights (k, H, W).

    Returns
    -------
    ndarray, shape (4, k, H, W)
        In the order of the shifts (row, column) = (0, 0), (0, 1), (1, 0), (1, 1).
    """
    patterns = [shift_cfa(cfa, row, column) for row, column in np.ndindex(2, 2)]
    return np.stack([lights(mosaic_samples(channels, pattern), pattern) for pattern in patterns])


def cross_spectra(fields: FloatArray, rim: int = 8) -> FloatArray:
    """Cross spectra (k, k, n, n) of fields (k, n, n), their rims of so many pixels left out and as many faded out."""
    size = fields.shape[-1]
    ramp = np.clip((np.arange(size) + 0.5 - rim) / rim, 0, 1)
    line = np.sin(np.pi / 2 * np.minimum(ramp, ramp[::-1])) ** 2
    window = np.outer(line, line)
    transform = np.fft.fft2(np.nan_to_num(fields - np.nanmean(fields, axis=(1, 2), keepdims=True)) * window)
    products = transform[:, None] * transform[None].conj()
    return np.asarray(products.real / (window**2).sum())


def cover_covariance(surface: Surface, distance: FloatArray) -> FloatArray:
    """Return the covariance of the black cover (0 or 1) at two points, by their distance (mm).

    Boolean model of discs of random radius R and number density n: ``(1 - coverage)^2 (exp(n E[overlap]) - 1)``, with
    the overlap of two equal discs at that distance.
    """
    size = np.linspace(-1, 1, 61)[1:-1]
    law = (1 - abs(size)) / (1 - abs(size)).sum()
    overlap = np.zeros_like(distance)
    for value, fraction in zip(size, law, strict=True):
        radius = surface.droplet / 2 * math.exp(surface.spread * BOUND * value)
        x = np.clip(distance / (2 * radius), 0, 1)
        overlap += fraction * 2 * radius**2 * (np.arccos(x) - x * np.sqrt(1 - x * x))
    return np.asarray((1 - surface.coverage) ** 2 * np.expm1(surface.droplets_per_area * overlap))


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeckleSpectrum:
    """Power spectra on the frequencies of a square of n x n px, in px^2; their sum over n^2 is a variance.

    Attributes
    ----------
    frequency : ndarray, shape (n,)
        Cycles per px, in the order of `numpy.fft`.
    texture : ndarray, shape (n, n)
        Of the locally normalised image, without prefilter.
    optics : ndarray, shape (n, n)
        Squared transfer of lens and pixel aperture.
    prefilter : ndarray, shape (n, n)
        Squared transfer of the prefilter.
    """

    frequency: FloatArray
    texture: FloatArray
    optics: FloatArray
    prefilter: FloatArray

    @classmethod
    def of(cls, surface: Surface, *, pixel: float, blur: float, prefilter: str, samples: int = 4) -> SpeckleSpectrum:
        """Return the spectrum of a painted surface; `pixel` in mm, `blur` the lens blur in px.

        The droplets' covariance is tabulated on so many `samples` per pixel.
        """
        if not surface.coverage > 0:
            raise InputError("a surface without droplets (coverage 0) has no texture to correlate")
        widest = surface.droplet * math.exp(BOUND * surface.spread) / pixel
        n = int(np.clip(2 ** math.ceil(math.log2(6 * widest)), 128, 1024))
        step = np.fft.fftfreq(n * samples, 1 / n)
        distance = pixel * np.hypot(step[:, None], step)
        fine = np.maximum(np.fft.fft2(cover_covariance(surface, distance)).real, 0) / samples**2
        inside = np.r_[: n // 2, -(n // 2) : 0]
        frequency = np.asarray(np.fft.fftfreq(n), dtype=np.float64)
        edge = surface.softness / pixel / math.sqrt(20)  # standard deviation of a smooth step's derivative
        white, black, cover = surface.white.albedo, surface.black.albedo, surface.coverage
        contrast = (white - black) / max(white + cover * (black - white), 1e-9)
        texture = contrast**2 * fine[np.ix_(inside, inside)] * _optics(frequency, math.hypot(blur, edge))
        return cls(
            frequency=frequency,
            texture=texture,
            optics=_optics(frequency, blur),
            prefilter=_prefilter_transfer(prefilter, frequency),
        )

    @classmethod
    def of_texture(cls, texture: TextureModel, *, size: int, prefilter: str) -> SpeckleSpectrum:
        """Spectrum of unit variance of a texture as images show it (its optics count as 1), on `size` frequencies."""
        frequency = np.asarray(np.fft.fftfreq(size), dtype=np.float64)
        spectrum = texture.spectrum(np.hypot(frequency[:, None], frequency))
        transfer = _prefilter_transfer(prefilter, frequency)
        return cls(frequency=frequency, texture=spectrum, optics=np.ones_like(spectrum), prefilter=transfer)

    @property
    def energy(self) -> float:
        """Mean square of the texture's gradient along x after the prefilter, px^-2."""
        return float((self._gradient * self.prefilter).mean())

    @property
    def variance(self) -> float:
        """Variance of the texture after the prefilter."""
        return float((self.texture * self.prefilter).mean())

    def contrast_score(self, element_size: float) -> float:
        """Return the variance density of the right-hand side under a unit change of the texture's contrast.

        The integral of ``phi t dt/dx = phi/2 d(t^2)/dx`` is ``-1/2 integral t^2 dphi/dx``: with the spectrum of t^2 at
        zero frequency, ``2 integral C^2`` for a Gaussian texture, and ``integral (dphi/dx)^2 = 4/h^2 integral phi^2``.
        """
        return float(2 * ((self.texture * self.prefilter) ** 2).mean() / element_size**2)

    def score(self, errors: FloatArray) -> FloatArray:
        """Variance density of the right-hand side under errors with power spectra (..., n, n) before the prefilter."""
        return np.asarray((self._gradient * self.prefilter**2 * errors).mean(axis=(-2, -1)))

    def residual(self, errors: FloatArray) -> FloatArray:
        """Return the variance at a pixel, after the prefilter, of errors with power spectra (..., n, n)."""
        return np.asarray((self.prefilter * errors).mean(axis=(-2, -1)))

    def gradient_product(self, cross: FloatArray) -> float:
        """Return the mean product of the gradients along x, after the prefilter, of the texture and of another field.

        `cross` (n, n) is their cross spectrum.
        """
        return float(((2 * np.pi * self.frequency) ** 2 * self.prefilter * cross).mean())

    def score_kernel(self, reach: int) -> FloatImage:
        """Return kernel (2 reach + 1, 2 reach + 1) that filters errors, before the prefilter, into the right-hand side.

        The mean square of the filtered image is `score` of the spectrum of the errors.
        """
        kernel = np.fft.fftshift(np.fft.ifft2(np.sqrt(self.slope * self.texture) * self.prefilter).real)
        central = slice(len(kernel) // 2 - reach, len(kernel) // 2 + reach + 1)
        return kernel[central, central].astype(np.float32)

    @property
    def slope(self) -> FloatArray:
        """Squared transfer (n, n) from a height to its slope along a random direction."""
        square = (2 * np.pi * self.frequency) ** 2
        return np.asarray((square + square[:, None]) / 2)

    @property
    def _gradient(self) -> FloatArray:
        return np.asarray((2 * np.pi * self.frequency) ** 2 * self.texture)


def _optics(frequency: FloatArray, blur: float) -> FloatArray:
    return _outer_square(np.sinc(frequency) ** 2 * np.exp(-4 * (np.pi * blur * frequency) ** 2))


def _prefilter_transfer(name: str, frequency: FloatArray) -> FloatArray:
    taps = PREFILTERS[name]
    tap_offset = np.arange(len(taps)) - len(taps) // 2
    return _outer_square((taps @ np.cos(2 * np.pi * tap_offset[:, None] * frequency)) ** 2)


def _outer_square(line: FloatArray) -> FloatArray:
    return np.outer(line, line)
