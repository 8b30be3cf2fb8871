"""A small piece of a scene's speckle, and what it tells that no formula does.

Its droplets' domes, and what a Bayer mosaic does to the lights' images: the noise that it passes and the trace that it
leaves. The piece goes through the real demosaicing and unmixing, so any method of `rgbmidic.illumination.separate` is
described, linear or not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.render import PLATE
from rgbmidic.frames.data import sampled_channels, shift_cfa
from rgbmidic.illumination.linearise import LinearMosaic
from rgbmidic.illumination.separate import separate
from rgbmidic.scene.scene import Scene
from rgbmidic.typing import FloatArray

__all__ = ["SpecklePatch", "cross_spectra", "mosaic_disturbances"]


_LEVEL = 0.25
"""Fraction of full scale of the mean of each light's image: no sample saturates."""
_NOISE = 0.005
"""Standard deviation of the probing noise, in units of full scale."""
_RIM = 8
"""Pixels at the edge of the piece that are left out."""
_SUBSAMPLES = 3
_CARRIERS = ((1, -1, 1, -1), (1, 1, -1, -1), (1, -1, -1, 1))
"""Signs of the parts that alternate along x, along y and along both, in the phases (0, 0), (0, 1), (1, 0), (1, 1)."""


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
    def of(cls, scene: Scene, size: int) -> SpecklePatch:
        """A piece of `size` x `size` px of a scene's paint, faced at the distance of the body's front point."""
        camera, surface = scene.camera, scene.surface
        pixel = scene.body.front[2] / camera.focal_px
        smooth = replace(
            surface, white=replace(surface.white, slope_deg=0.0), black=replace(surface.black, slope_deg=0.0)
        )
        place = (np.arange(size * _SUBSAMPLES) + 0.5) / _SUBSAMPLES * pixel
        x, y = np.meshgrid(place, place)
        points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        cover, height, _ = smooth.sample(points, np.array([PLATE, 0.0, np.inf, np.inf]))
        albedo = surface.white.albedo + cover * (surface.black.albedo - surface.white.albedo)
        texture = _seen(albedo, size, camera.lens_blur)
        return cls(texture=texture / texture.mean(), domes=_seen(height / pixel, size, camera.lens_blur))


def _seen(fine: FloatArray, size: int, blur: float) -> FloatArray:
    """Fine samples (flat) averaged over the pixels and blurred by the lens."""
    whole = fine.reshape(size, _SUBSAMPLES, size, _SUBSAMPLES).mean(axis=(1, 3))
    line = np.exp(-2 * (np.pi * blur * np.fft.fftfreq(size)) ** 2)
    return np.asarray(np.fft.ifft2(np.fft.fft2(whole) * np.outer(line, line)).real)


def mosaic_disturbances(scene: Scene, texture: FloatArray, demosaic: str) -> tuple[FloatArray, FloatArray]:
    """Cross spectra of what disturbs the lights' images.

    Parameters
    ----------
    scene
        Bayer camera and lights.
    texture : ndarray, shape (n, n)
        Of a `SpecklePatch`.
    demosaic
        Method of `rgbmidic.illumination.separate`.

    Returns
    -------
    noise : ndarray, shape (3, k, k, n, n)
        Of noise of unit variance in the samples of R, G or B.
    trace : ndarray, shape (3, k, k, n, n)
        Of what stays with the mosaic when the texture moves, for its three carriers (alternating along x, along y, and
        along both), in units of each light's mean; lights of equal brightness.
    """
    camera, crosstalk = scene.camera, scene.camera.true_crosstalk(scene.lights)
    colours = sampled_channels(camera.cfa, texture.shape)
    level = _LEVEL * camera.full_scale
    samples = level * crosstalk.matrix.sum(axis=1)[colours] * texture

    def lights(values: FloatArray, cfa: str) -> FloatArray:
        mosaic = LinearMosaic(
            values=values.astype(np.float32),
            saturated=np.zeros(values.shape, dtype=bool),
            cfa=cfa,
            full_scale=camera.full_scale,
            noise=camera.noise,
        )
        return separate(mosaic, crosstalk, demosaic).values.astype(np.float64)

    noise = _noise(lights, samples, colours, camera.cfa, _NOISE * camera.full_scale)
    return noise, _trace(lights, crosstalk.matrix, texture, camera.cfa, level)


def _noise(
    lights: Callable[[FloatArray, str], FloatArray],
    samples: FloatArray,
    colours: npt.NDArray[np.intp],
    cfa: str,
    amplitude: float,
) -> FloatArray:
    random = np.random.default_rng(0)
    quiet = lights(samples, cfa)
    spectra = []
    for colour in range(3):
        disturbed = samples + np.where(colours == colour, random.normal(scale=amplitude, size=samples.shape), 0)
        spectra.append(cross_spectra((lights(disturbed, cfa) - quiet) / amplitude))
    return np.stack(spectra)


def _trace(
    lights: Callable[[FloatArray, str], FloatArray], matrix: FloatArray, texture: FloatArray, cfa: str, level: float
) -> FloatArray:
    """The texture under the four phases of the mosaic: what is the same in all of them moves with the texture."""
    phases = []
    for rows, columns in np.ndindex(2, 2):
        name = shift_cfa(cfa, rows, columns)
        phases.append(lights(level * matrix.sum(axis=1)[sampled_channels(name, texture.shape)] * texture, name) / level)
    parts = [np.tensordot(np.array(signs) / 4, phases, axes=1) for signs in _CARRIERS]
    return np.stack([cross_spectra(part) for part in parts])


def cross_spectra(fields: FloatArray) -> FloatArray:
    """Cross spectra (k, k, n, n) of fields (k, n, n), their rims faded out."""
    size = fields.shape[-1]
    ramp = np.clip((np.arange(size) + 0.5 - _RIM) / _RIM, 0, 1)
    line = np.sin(np.pi / 2 * np.minimum(ramp, ramp[::-1])) ** 2
    window = np.outer(line, line)
    transform = np.fft.fft2(np.nan_to_num(fields - np.nanmean(fields, axis=(1, 2), keepdims=True)) * window)
    products = transform[:, None] * transform[None].conj()
    return np.asarray(products.real / (window**2).sum())
