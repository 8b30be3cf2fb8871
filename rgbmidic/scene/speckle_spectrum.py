"""Spectrum of a speckle in closed form: a Boolean model of discs seen through pixel aperture, lens and prefilter."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rgbmidic.correlation.images import PREFILTERS
from rgbmidic.errors import InputError
from rgbmidic.scene.surface import Surface
from rgbmidic.typing import FloatArray

__all__ = ["SpeckleSpectrum", "cover_covariance"]


_SQRT6 = math.sqrt(6.0)
_FINE = 4
"""Samples per pixel on which the droplets' covariance is tabulated."""


def cover_covariance(surface: Surface, distance: FloatArray) -> FloatArray:
    """Covariance of the black cover (0 or 1) at two points, by their distance (mm).

    Boolean model of discs of random radius R and number density n: ``(1 - coverage)^2 (exp(n E[overlap]) - 1)``, with
    the overlap of two equal discs at that distance.
    """
    size = np.linspace(-1, 1, 61)[1:-1]
    law = (1 - abs(size)) / (1 - abs(size)).sum()
    overlap = np.zeros_like(distance)
    for value, share in zip(size, law, strict=True):
        radius = surface.droplet / 2 * math.exp(surface.spread * _SQRT6 * value)
        x = np.clip(distance / (2 * radius), 0, 1)
        overlap += share * 2 * radius**2 * (np.arccos(x) - x * np.sqrt(1 - x * x))
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
    def of(cls, surface: Surface, *, pixel: float, blur: float, prefilter: str) -> SpeckleSpectrum:
        """Spectrum of a painted surface; `pixel` in mm, `blur` the lens blur in px."""
        if not surface.coverage > 0:
            raise InputError("a surface without droplets (coverage 0) has no texture to correlate")
        widest = surface.droplet * math.exp(_SQRT6 * surface.spread) / pixel
        n = int(np.clip(2 ** math.ceil(math.log2(6 * widest)), 128, 1024))
        step = np.fft.fftfreq(n * _FINE, 1 / n)
        distance = pixel * np.hypot(step[:, None], step)
        fine = np.maximum(np.fft.fft2(cover_covariance(surface, distance)).real, 0) / _FINE**2
        inside = np.r_[: n // 2, -(n // 2) : 0]
        frequency = np.asarray(np.fft.fftfreq(n), dtype=np.float64)
        edge = surface.softness / pixel / math.sqrt(20)  # standard deviation of a smooth step's derivative
        filtered = _outer(_prefilter_transfer(prefilter, frequency))
        texture = _contrast(surface) ** 2 * fine[np.ix_(inside, inside)] * _optics(frequency, math.hypot(blur, edge))
        return cls(frequency=frequency, texture=texture, optics=_optics(frequency, blur), prefilter=filtered)

    @property
    def energy(self) -> float:
        """Mean square of the texture's gradient along x after the prefilter, px^-2."""
        return float((self._gradient * self.prefilter).mean())

    @property
    def variance(self) -> float:
        """Variance of the texture after the prefilter."""
        return float((self.texture * self.prefilter).mean())

    def contrast_score(self, element_size: float) -> float:
        """Variance density of the right-hand side under a unit change of the texture's contrast.

        The integral of ``phi t dt/dx = phi/2 d(t^2)/dx`` is ``-1/2 integral t^2 dphi/dx``: with the spectrum of t^2 at
        zero frequency, ``2 integral C^2`` for a Gaussian texture, and ``integral (dphi/dx)^2 = 4/h^2 integral phi^2``.
        """
        return float(2 * ((self.texture * self.prefilter) ** 2).mean() / element_size**2)

    def score(self, disturbance: FloatArray) -> FloatArray:
        """Variance density of the right-hand side under disturbances with power spectra (..., n, n) before the
        prefilter."""
        return np.asarray((self._gradient * self.prefilter**2 * disturbance).mean(axis=(-2, -1)))

    def residual(self, disturbance: FloatArray) -> FloatArray:
        """Variance at a pixel, after the prefilter, of disturbances with power spectra (..., n, n)."""
        return np.asarray((self.prefilter * disturbance).mean(axis=(-2, -1)))

    def pull(self, cross: FloatArray) -> float:
        """Mean product of the gradients along x, after the prefilter, of the texture and of a field with which it has
        the cross spectrum (n, n)."""
        return float(((2 * np.pi * self.frequency) ** 2 * self.prefilter * cross).mean())

    @property
    def slope(self) -> FloatArray:
        """Squared transfer (n, n) from a height to its slope along a random direction."""
        square = (2 * np.pi * self.frequency) ** 2
        return np.asarray((square + square[:, None]) / 2)

    @property
    def _gradient(self) -> FloatArray:
        return np.asarray((2 * np.pi * self.frequency) ** 2 * self.texture)


def _contrast(surface: Surface) -> float:
    white, black, cover = surface.white.albedo, surface.black.albedo, surface.coverage
    return (white - black) / max(white + cover * (black - white), 1e-9)


def _optics(frequency: FloatArray, blur: float) -> FloatArray:
    return _outer(np.sinc(frequency) ** 2 * np.exp(-4 * (np.pi * blur * frequency) ** 2))


def _prefilter_transfer(name: str, frequency: FloatArray) -> FloatArray:
    taps = PREFILTERS[name]
    place = np.arange(len(taps)) - len(taps) // 2
    return np.asarray((taps @ np.cos(2 * np.pi * place[:, None] * frequency)) ** 2)


def _outer(line: FloatArray) -> FloatArray:
    return np.outer(line, line)
