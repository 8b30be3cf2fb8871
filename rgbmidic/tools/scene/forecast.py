"""Displacement uncertainty expected before a test, in closed form: nothing is solved.

The covariance of the nodes is ``M^-1 S M^-1`` with M the Hessian of the weighted sum over the lights and S the
covariance of its right-hand side; with equal white noise it is the well-known ``2 sigma^2 M^-1``. Per pixel, M has the
density `information` = energy of the speckle's gradient x precision x contrast, with the precision of a light its
contrast over the variance of its residual (`light_precision`; the solve takes the residuals' covariance); S has the
density `score` of the errors of the images times the precisions. From the two densities follows the uncertainty of an
inner node of a regular mesh (`nodal_variance_factor`), or of every node of a mesh over which they vary
(`expected_std`).

The densities come from a scene (`Instrument`, here) or from a frame (`rgbmidic.tools.lab.inspection.prediction`). Those
of a scene are integrals of the speckle's gradient spectrum: of the texture alone for M, of its product with the
spectrum of the errors for S:

- camera noise of both states, through demosaicing and unmixing (the crosstalk's amplification of noise);
- the trace of the mosaic that demosaicing leaves in the images, which stays with the sensor while the texture moves;
- the erratic part of the reflections, which changes as facets and droplets turn in and out of the mirror direction.

A plain Gaussian law is taken for the slopes of the wrinkles.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from rgbmidic.correlation.assembly import Assembly
from rgbmidic.correlation.constants import USUAL
from rgbmidic.illumination.crosstalk import NEGLIGIBLE
from rgbmidic.illumination.linear import QUANTISATION
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.mesh.recovery import Recovery, functional_std
from rgbmidic.settings import ELEMENT_SIZE
from rgbmidic.tools.scene.camera import Floating
from rgbmidic.tools.scene.scene import Scene
from rgbmidic.tools.scene.speckle import SpecklePatch, SpeckleSpectrum, cross_spectra, separation_spectra
from rgbmidic.tools.scene.zones import Zones, facet_variance, slope_variance
from rgbmidic.typing import BoolArray, FloatArray, FloatImage


@cache
def nodal_variance_factor() -> float:
    """Return the variance of an inner node's value per unit of white noise density and element area: about 1.1.

    `expected_std` of a regular mesh: the linear fit has the inverse of the consistent mass matrix (2.6 on its
    diagonal); the recovery of the nodal values reduces it.
    """
    side = 16
    mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 10 * side, 10 * side), (10 * side + 1,) * 2), 10)
    (std,) = expected_std(mesh, *np.ones((2, len(mesh.elements))))
    # an even number of rows and columns: as many nodes with eight triangles as with four
    inner = (np.abs(mesh.nodes / 10 - side / 2 + 0.5) < side / 4).all(axis=1)
    return float((std[inner] ** 2).mean() * mesh.size**2)


def light_precision(contrast: npt.NDArray[Floating], residual: npt.NDArray[Floating]) -> npt.NDArray[Floating]:
    """Return the contrast of each light over the variance of its residual: its weight in the displacement.

    Parameters
    ----------
    contrast, residual : ndarray, shape (k, ...)
        Contrast of the texture, 0 where the light does not see; variance of the residual in its unit squared.

    Returns
    -------
    ndarray, shape (k, ...)
        0 where the residual is 0 or unknown.
    """
    return np.asarray(np.divide(contrast, residual, out=np.zeros_like(contrast), where=residual > 0))


def expected_std(mesh: Tri3Mesh, information: FloatArray, *scores: FloatArray) -> FloatArray:
    """Return the standard uncertainty (n, N) of a displacement component at the nodes, px; NaN where unseen.

    Parameters
    ----------
    mesh
        The mesh.
    information, *scores : ndarray, shape (E,)
        Per pixel of each element: of the Hessian, and n variances of the right-hand side.
    """
    area = mesh.to_nodes(mesh.areas)
    density = mesh.to_nodes(information * mesh.areas) / area
    positive = density[density > 0]
    is_visible = density > USUAL.min_texture * np.median(positive) if positive.size else np.zeros(len(density), bool)
    if not is_visible.any():
        return np.full((len(scores), len(density)), np.nan)
    assembly = Assembly.from_mesh(mesh)
    mass = ((1 + np.eye(3)) / 12)[..., None] * np.array([1.0, 0.0, 1.0])

    def assemble(values: FloatArray) -> sp.csc_matrix:
        return assembly.matrix((values * mesh.areas)[:, None, None, None] * mass)

    # elements that no light sees must not make the system singular
    solve = assembly.factorise(
        assemble(np.maximum(information, 1e-3 * USUAL.min_texture * np.median(density[is_visible])))
    )
    is_used = np.asarray(is_visible[mesh.elements].all(axis=1))
    recovery = Recovery.over(mesh, is_used, information)
    along_x = [((recovery.value, None), is_visible)]
    std = np.stack([functional_std(solve, assemble(score), mesh, along_x)[:, 0] for score in scores])
    return np.where(is_visible & (std < USUAL.max_std), std, np.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class Forecast:
    """Uncertainty expected of a measurement between two states; NaN where no light sees.

    Attributes
    ----------
    std : ndarray, shape (...)
        Standard uncertainty (px) of u, and of v, at an inner node, from random errors.
    bias : ndarray, shape (...)
        Root mean square, per component, of the apparent displacement (px) by the droplets' domes: their lit sides
        change when a reflection moves.
    """

    std: FloatArray
    bias: FloatArray


@dataclass(frozen=True, slots=True)
class Energies:
    """Variance, of a pixel or of the right-hand side, that image errors of unit strength add.

    Attributes
    ----------
    noise : ndarray, shape (C, k, k)
        Between the lights' images, of noise of unit variance in the samples of each colour (DN squared).
    mosaic : ndarray, shape (3, k, k)
        Of the trace of demosaicing in one image at each carrier of the mosaic (alternating along x, along y, along
        both), for lights of equal brightness, in units of their means.
    erratic
        Of an error that is white before lens and pixel, with a spectrum of 1 px^2.
    dome
        Of the slope of the droplets' domes along a random direction.
    contrast
        Of a change of the texture's contrast.
    """

    noise: FloatArray
    mosaic: FloatArray
    erratic: float
    dome: float
    contrast: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Instrument:
    """Paint, camera, colours of the lights, processing and mesh, reduced to the numbers that the forecast needs.

    Attributes
    ----------
    scene
        Its paint, camera and colours of the lights; positions of lamps and body do not enter.
    element_size
        px.
    energy
        Mean square of the speckle's gradient along x, px^-2.
    residual, score
        Of a pixel, and of the right-hand side per pixel.
    dome_gradient_product
        Mean product of the gradients of texture and domes, px^-1.
    wrinkle_area
        Area over which the erratic part of a reflection is correlated, in units of the wrinkles' spacing squared
        (measured, see the tests, at a lobe of 4 and slopes of 6 degrees; 0.06 at 3 and 8 degrees, 0.11 at 6 and 4).
    saturation
        Fraction of full scale from which the white paint is taken to saturate a channel: noise does the rest.
    """

    scene: Scene
    element_size: float
    energy: float
    residual: Energies
    score: Energies
    dome_gradient_product: float
    wrinkle_area: float = 0.085
    saturation: float = 0.98

    @classmethod
    def of(
        cls, scene: Scene, *, element_size: float = ELEMENT_SIZE, demosaic: str = "malvar", prefilter: str = "binomial"
    ) -> Instrument:
        """Reduce a scene.

        Parameters
        ----------
        scene
            Paint, camera and lights.
        element_size
            Of the TRI3 mesh, px.
        demosaic
            Method for a Bayer camera (`rgbmidic.illumination.separation.DEMOSAICERS`).
        prefilter
            Of the solve (`rgbmidic.correlation.images.PREFILTERS`).

        Returns
        -------
        Instrument

        Raises
        ------
        InputError
            The paint has no droplets, hence no texture.
        """
        camera = scene.camera
        spectrum = SpeckleSpectrum.of(scene.surface, pixel=scene.pixel, blur=camera.lens_blur, prefilter=prefilter)
        patch = SpecklePatch.of(scene, len(spectrum.frequency))
        relief = cross_spectra(np.stack([patch.texture, patch.domes]))
        if camera.kind == "bayer":
            noise, mosaic = separation_spectra(scene, patch.texture, demosaic)
        else:
            unmixing = np.linalg.pinv(_channel_mixing(scene))
            noise = np.einsum("jc,kc->cjk", unmixing, unmixing)[..., None, None]
            mosaic = np.zeros((3, *noise.shape[1:]))

        def energies(measure: Callable[[FloatArray], FloatArray], contrast: float) -> Energies:
            erratic, dome = measure(spectrum.optics), measure(spectrum.slope * relief[1, 1])
            return Energies(measure(noise), measure(mosaic), float(erratic), float(dome), contrast)

        return cls(
            scene=scene,
            element_size=element_size,
            energy=spectrum.energy,
            residual=energies(spectrum.residual, spectrum.variance),
            score=energies(spectrum.score, spectrum.contrast_score(element_size)),
            dome_gradient_product=spectrum.gradient_product(relief[0, 1]),
        )

    def forecast(self, reference: Zones, deformed: Zones, change: FloatArray) -> Forecast:
        """Return the uncertainty between two states, at the points at which their zones were predicted.

        Parameters
        ----------
        reference, deformed
            Predictions at the same material points.
        change : ndarray, shape (3, ...)
            Of the mosaic's trace between them (`trace_change`), as a mean over the elements of a node.

        Returns
        -------
        Forecast
            At these points.
        """
        residual, score = (
            self._covariance(energies, reference, deformed, change) for energies in (self.residual, self.score)
        )
        variance = np.einsum("jj...->j...", residual)
        contrast = np.where(
            self._is_visible(variance, reference, deformed), 1 - (reference.fraction + deformed.fraction) / 2, 0.0
        )
        precision = light_precision(contrast, variance)
        total = (self.energy * precision * contrast).sum(axis=0)
        dome_offset = np.nan_to_num(
            (self._dome_factor(deformed) - self._dome_factor(reference)) * precision[:, None]
        ).sum(axis=0)
        square = np.einsum("jk...,j...,k...->...", np.nan_to_num(score), precision, precision)
        with np.errstate(invalid="ignore", divide="ignore"):
            std = np.sqrt(nodal_variance_factor() * square) / (self.element_size * total)
            bias = self.dome_gradient_product * np.sqrt((dome_offset**2).sum(axis=0) / 2) / total
        return Forecast(std=np.where(total > 0, std, np.nan), bias=np.where(total > 0, bias, np.nan))

    def weights(self, reference: Zones, deformed: Zones, *, motion_known: bool = True) -> FloatImage:
        """Return weights in [0, 1] for the solve: the inverse variance of each light's part in the displacement.

        The best light at the best point has 1; a light that does not see or saturates has 0.

        Parameters
        ----------
        reference, deformed
            Predictions at the same material points.
        motion_known
            Whether the motion between the states is known to them. If not, the reflections are taken to have changed
            wholly.

        Returns
        -------
        ndarray, shape (k, ...), float32
        """
        change = np.full((3, *reference.fraction.shape[1:]), 2.0)
        covariance = self._covariance(self.score, reference, deformed, change, common=float(motion_known))
        variance = np.einsum("jj...->j...", covariance)
        is_visible = self._is_visible(variance, reference, deformed)
        inverse = np.where(is_visible, 1 / np.where(is_visible, variance, 1.0), 0.0)
        return (inverse / max(float(inverse.max()), 1e-30)).astype(np.float32)

    def light_variance(self, light: int, reference: Zones, deformed: Zones, brightness: FloatArray) -> FloatArray:
        """Return the variance (n, ...) of one light's part that is tried in n places, the others as bright as they are.

        Parameters
        ----------
        light
            Its index.
        reference, deformed
            Predictions of this light alone in its n places.
        brightness : ndarray, shape (k,)
            Mean grey level of every light, for the noise that crosstalk brings.

        Returns
        -------
        ndarray, shape (n, ...)
            In units of the local mean.
        """
        variance = (
            self._reflections(self.score, reference, deformed, 1.0) + 2 * self.score.mosaic[:, light, light].sum()
        )
        mixing = _channel_mixing(self.scene)
        other_levels = mixing @ np.where(np.arange(len(brightness)) == light, 0.0, brightness)
        for zones in (reference, deformed):
            for colour, factor in enumerate(self.score.noise[:, light, light]):
                samples = self.scene.camera.noise.variance(other_levels[colour] + mixing[colour, light] * zones.level)
                variance += factor * (samples + QUANTISATION) / zones.level**2
        return np.asarray(variance)

    def _covariance(
        self, energies: Energies, reference: Zones, deformed: Zones, change: FloatArray, common: float = 1.0
    ) -> FloatArray:
        """Return the covariance (k, k, ...) of the changes of the lights' images, in units of their local means.

        `common` is 1 where the two states share their reflections as predicted, 0 where they have nothing in common.
        """
        covariance = np.einsum("cjk,c...->jk...", energies.mosaic, change)
        for zones in (reference, deformed):
            levels = _channel_levels(_channel_mixing(self.scene), zones.level)
            samples = self.scene.camera.noise.variance(levels) + QUANTISATION  # of each colour at the mean, DN squared
            covariance += np.einsum("cjk,c...->jk...", energies.noise, samples) / (zones.level[:, None] * zones.level)
        lights = range(len(covariance))
        covariance[lights, lights] += self._reflections(energies, reference, deformed, common)
        return np.asarray(covariance)

    def _reflections(self, energies: Energies, reference: Zones, deformed: Zones, common: float) -> FloatArray:
        """Variance (k, ...) that comes from a change of the reflections; between the lights it is independent."""
        first, second = self._dome_factor(reference), self._dome_factor(deformed)
        domes = (first**2 + second**2 - 2 * common * first * second).sum(axis=1)
        contrast = reference.fraction**2 + deformed.fraction**2 - 2 * common * reference.fraction * deformed.fraction
        erratic = self._erratic(reference, deformed, common)
        return np.asarray(energies.erratic * erratic + energies.dome * domes + energies.contrast * contrast)

    def _erratic(self, reference: Zones, deformed: Zones, common: float) -> FloatArray:
        """Spectrum (px^2) of the erratic part of the change of each light's image (k, ...), in units of its mean.

        Facets with Gaussian slopes of variance a^2 per axis reflect ``q = exp(-|s - h|^2/(2 b^2))``; the covariance of
        q between the half-way slopes h of two states is an integral of Gaussians. The part linear in the slopes is
        finer than the pixel and is left out: wrinkles have no slope on average.
        """
        covariances = [
            _facet_covariance(first.slopes, second.slopes, *self._roughness) * first.fraction * second.fraction
            for first, second in ((reference, reference), (deformed, deformed), (reference, deformed))
        ]
        area = self.wrinkle_area * (self.scene.surface.white.spacing / self.scene.pixel) ** 2
        return np.asarray(area * np.maximum(covariances[0] + covariances[1] - 2 * common * covariances[2], 0))

    def _dome_factor(self, zones: Zones) -> FloatArray:
        """Return the effect (k, 3, ...) of a unit slope of a droplet's dome on the light's image, in units of its mean.

        A slope s changes the reflection at the half-way slope h by the factor exp(h.s/(a^2 + b^2)); its linear part is
        taken.
        """
        return np.asarray(zones.fraction[:, None] * zones.slopes / sum(self._roughness))

    @property
    def _roughness(self) -> tuple[float, float]:
        """Variances per axis of the wrinkles' slopes and of the facets' lobe, mean of both paints."""
        surface, cover = self.scene.surface, self.scene.surface.coverage
        slope = (1 - cover) * slope_variance(surface.white) + cover * slope_variance(surface.black)
        return slope, (1 - cover) * facet_variance(surface.white) + cover * facet_variance(surface.black)

    def _is_visible(self, variance: FloatArray, reference: Zones, deformed: Zones) -> BoolArray:
        """Return True (k, ...) where a light reaches the surface and saturates nothing in both states."""
        return np.isfinite(variance) & ~self.is_saturated(reference) & ~self.is_saturated(deformed)

    def is_saturated(self, zones: Zones) -> BoolArray:
        """Return True (k, ...) where white paint is expected to saturate a channel that the light needs."""
        mixing = _channel_mixing(self.scene)
        is_full = _channel_levels(mixing, self.white_level(zones)) > self.saturation * self.scene.camera.full_scale
        unmixing = np.abs(np.linalg.pinv(mixing))
        is_needed = unmixing > NEGLIGIBLE * unmixing.max(axis=1, keepdims=True)
        return np.asarray(np.einsum("jc,c...->j...", is_needed.astype(float), is_full.astype(float)) > 0)

    def white_level(self, zones: Zones) -> FloatArray:
        """Return the grey level (k, ...) of the white paint under each light, DN above black."""
        return zones.irradiance * (self.scene.surface.white.albedo * zones.lambert + zones.specular)


def trace_change(displacement: FloatArray) -> FloatArray:
    """Return the mean square change (3, ...) of the three carriers of the mosaic under a displacement (2, ...) in px.

    The trace stays with the sensor: it differs most where the texture has moved by an odd number of pixels.
    """
    x, y = np.cos(np.pi * displacement)
    return np.asarray(2 * (1 - np.stack([x, y, x * y])))


def _channel_mixing(scene: Scene) -> FloatArray:
    """Return the camera samples from lights, (C, k); before a monochrome camera every light has a frame of its own."""
    if scene.camera.kind == "monochrome":
        return np.eye(len(scene.lights))
    return scene.camera.mixing(scene.lights)


def _channel_levels(mixing: FloatArray, levels: FloatArray) -> FloatArray:
    """Return the levels (C, ...) of the channels; a light that does not reach a point adds nothing."""
    return np.asarray(np.einsum("cj,j...->c...", mixing, np.nan_to_num(levels)))


def _facet_covariance(first: FloatArray, second: FloatArray, a2: float, b2: float) -> FloatArray:
    """Covariance of the facets' reflections at two half-way slopes (k, 3, ...), relative to the product of the means.

    The part that is linear in the facets' slopes is left out.
    """
    squares, product = (first**2 + second**2).sum(axis=1), (first * second).sum(axis=1)
    means = 2 * math.log(b2 / (a2 + b2)) - squares / (2 * (a2 + b2))
    difference_square, mean_square = squares - 2 * product, (squares + 2 * product) / 4
    log_product = math.log(b2 / (2 * a2 + b2)) - difference_square / (4 * b2) - mean_square / (2 * a2 + b2)
    return np.asarray(np.exp(np.minimum(log_product - means, 50.0)) - 1 - product * a2 / (a2 + b2) ** 2)
