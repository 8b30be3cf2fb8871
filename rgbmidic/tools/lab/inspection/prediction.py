"""Displacement uncertainty expected from one frame: `rgbmidic.tools.scene.forecast` with images of the frame's errors.

Contrast and energy of the speckle's gradient follow from the frame; the errors are drawn (`separate_with_errors`). The
reflection-aware model of the frame (local means, slope of each light on the common texture, light-specific
component, autocorrelation of the speckle) describes a random frame with the statistics of the one given. Such a frame
is drawn with all its channels at every pixel and separated as the test does, behind the four phases of the colour
filter array: what is the same in all of them moves with the specimen, the rest stays with the sensor.
Camera noise goes the same way. Filtered with the root of the speckle's gradient spectrum, the mean square of the errors
is the variance of the right-hand side.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt
from scipy.fft import fftfreq, irfft2, next_fast_len, rfft2, rfftfreq
from scipy.ndimage import median_filter

from rgbmidic._kernels.splines import PAD, bspline_coefficients, sample_with_gradient
from rgbmidic.correlation.images import apply_prefilter
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.colour_factors import BLOCK, CHANNEL, MEAN_BLOCK, MIN_SPECIFIC, upsample
from rgbmidic.illumination.contrast import LocalContrast
from rgbmidic.illumination.crosstalk import Crosstalk, unmix
from rgbmidic.illumination.demosaicing import SPARKLE_VARIANCE, Reconstruction, reconstruct
from rgbmidic.illumination.images import IlluminationImages, local_mean
from rgbmidic.illumination.linear import LinearChannels, LinearMosaic, NoiseModel
from rgbmidic.illumination.separation import DEFAULT_METHOD, reconstructed_lights, separate
from rgbmidic.illumination.texture import COLOURED, TextureModel
from rgbmidic.mesh import PixelMap, Region, Tri3Mesh
from rgbmidic.tools.lab.inspection.channels import CONSTANTS
from rgbmidic.tools.scene.camera import mosaic_samples
from rgbmidic.tools.scene.forecast import expected_std, light_precision
from rgbmidic.tools.scene.speckle import SpeckleSpectrum, separate_phases
from rgbmidic.typing import BoolArray, FloatArray, FloatImage


class ErrorDraw(Protocol):
    """Draws errors of the separation of a state whose lights are so many times as strong."""

    def __call__(self, random: np.random.Generator, strength: FloatArray, /) -> tuple[FloatImage, FloatImage]:
        """Draw the errors.

        Parameters
        ----------
        random
            Source of random numbers.
        strength : ndarray, shape (k,)
            Of each light, relative to the frame's; those of a coloured specimen are not changed.

        Returns
        -------
        tuple of ndarray, shapes (1, k, H, W) and (4, k, H, W), float32
            Draw of the lights' change by the camera noise, DN; difference of the lights behind each phase of the colour
            filter array from the mean of the four, none for a camera that has all channels at every pixel.
        """
        ...


def separate_with_errors(
    frames: Sequence[LinearMosaic | LinearChannels],
    test_calibration: Calibration,
    method: str,
    noise: NoiseModel,
) -> tuple[IlluminationImages, ErrorDraw]:
    """Separate a state as the test would, and return what draws the errors of that.

    Reflection index and speckle of a mosaic are those of the default method.

    Parameters
    ----------
    frames
        Of one state: one, or one per light in succession; with the noise that the separation reckons with.
    test_calibration
        The calibration; without crosstalk the channels are used as lights.
    method
        How the test separates its mosaics (`rgbmidic.illumination.separation`).
    noise
        Camera noise to draw.

    Returns
    -------
    images
        The lights.
    draw
        See `ErrorDraw`.
    """
    first, crosstalk = frames[0], test_calibration.crosstalk or Crosstalk.identity(("red", "green", "blue"))
    if isinstance(first, LinearMosaic):
        calibration = replace(test_calibration, crosstalk=crosstalk)
        model = reconstruct(first, crosstalk, registration=test_calibration.registration)
        images = reconstructed_lights(model, crosstalk)
        if method not in ("auto", DEFAULT_METHOD):
            separated_lights = separate(first, crosstalk, method)
            images = replace(images, values=separated_lights.values, valid=separated_lights.valid)

        def separate_values(values: FloatImage, cfa: str) -> FloatImage:
            draw_channels = replace(first, values=values, cfa=cfa, saturated=np.zeros(values.shape, dtype=bool))
            lights = separate(draw_channels, calibration, method, texture=model.texture)
            return np.nan_to_num(lights.on_first_light().values)

        def draw_mosaic(random: np.random.Generator, strength: FloatArray) -> tuple[FloatImage, FloatImage]:
            sites = _draw_sites(model, strength if model.texture.specific < COLOURED else np.ones(3), random)
            phases = separate_phases(sites, first.cfa, separate_values)
            noisy = separate_values(_add_noise(mosaic_samples(sites, first.cfa), noise, random), first.cfa)
            return (noisy - phases[0])[None], phases - phases.mean(axis=0)

        return images, draw_mosaic
    full = [frame for frame in frames if isinstance(frame, LinearChannels)]
    names = test_calibration.registration.lights if test_calibration.registration else ()

    def separate_state(state: Sequence[LinearChannels]) -> IlluminationImages:
        single = len(state[0].values) == 1
        return IlluminationImages.in_succession(state, names) if single else unmix(state[0], crosstalk)

    images = separate_state(full)

    def draw_channels(random: np.random.Generator, strength: FloatArray) -> tuple[FloatImage, FloatImage]:
        added = (strength[:, None, None] - 1) * np.nan_to_num(images.values)
        if len(full) == 1 and len(images.names) > 1:
            added = np.tensordot(crosstalk.matrix, added, axes=1)[None]
        state = [replace(frame, values=frame.values + addition) for frame, addition in zip(full, added, strict=True)]
        noisy = separate_state(
            [replace(frame, values=_add_noise(frame.values, noise, random)) for frame in state]
        ).values
        change = np.nan_to_num(noisy - separate_state(state).values)[None]
        return change, change[:0]

    return images, draw_channels


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """Standard uncertainty of u, and of v, at the nodes (N,), px; NaN where a node is not measured.

    Attributes
    ----------
    std
        Of all lights together.
    noise, mosaic
        The parts of it from camera noise, and from samples that the mosaic lacks.
    single_light : tuple of ndarray
        Of every light alone.
    """

    std: FloatArray
    noise: FloatArray
    mosaic: FloatArray
    single_light: tuple[FloatArray, ...]


def predict(
    mesh: Tri3Mesh,
    region: Region,
    lights: LocalContrast,
    errors: tuple[FloatImage, FloatImage],
    *,
    texture: TextureModel | None,
    prefilter: str,
) -> Prediction:
    """Return the standard uncertainty expected of the displacement from a frame to a second state.

    Parameters
    ----------
    mesh, region
        Mesh of the measurement and its region, in px of the images.
    lights
        Their local means and contrasts.
    errors
        Draws of camera noise and mosaic of one state, DN; those of the other state are as large and independent.
    texture
        The speckle's autocorrelation; None: there is none, and nothing can be measured.
    prefilter
        Of the solve (`rgbmidic.correlation.images.PREFILTERS`).

    Returns
    -------
    Prediction
    """
    level, contrast = lights.level, np.where(lights.background(region.mask), np.float32(0), lights.contrast)
    if texture is None:
        unknown = np.full(len(mesh.nodes), np.nan)
        return Prediction(std=unknown, noise=unknown, mosaic=unknown, single_light=(unknown,) * len(contrast))
    light = contrast > 0
    spectrum = SpeckleSpectrum.of_texture(texture, size=CONSTANTS.n_frequencies, prefilter=prefilter)
    kernel = spectrum.score_kernel(CONSTANTS.kernel_reach)

    def filtered(draws: FloatImage, change: Callable[[FloatImage], FloatImage]) -> Iterator[FloatImage]:
        """Draws (n, k, H, W) relative to the level of the light, one (k, H, W) after the other, every image changed."""
        for draw in draws:
            relative = np.divide(draw, level, out=np.zeros_like(draw), where=light)
            yield np.stack([change(image) for image in relative])

    def variance(change: Callable[[FloatImage], FloatImage]) -> FloatImage:
        """Return the local mean square (k, H, W) of all errors of one state."""
        total = np.zeros_like(contrast)
        for draws in errors:
            for images in filtered(draws, change):
                total += images**2 / np.float32(len(draws))
        return _smooth(total, region.mask, mesh.size)

    texture_contrast = np.sqrt(np.maximum(contrast**2 - variance(lambda image: image), 0) * light)
    residual = variance(lambda image: apply_prefilter(image, prefilter))
    precision = light_precision(texture_contrast, residual)
    pixels = PixelMap.from_mesh(mesh, region)

    def scores(draws: FloatImage) -> FloatArray:
        """Return the score (1 + k, E) of all lights together and of each alone, between two states."""
        total = np.zeros((1 + len(precision), *precision.shape[1:]), dtype=np.float32)
        for images in filtered(draws, lambda image: np.asarray(cv2.filter2D(image, -1, kernel), dtype=np.float32)):
            images *= precision
            total[0] += images.sum(axis=0) ** 2 / np.float32(len(draws))
            total[1:] += images**2 / np.float32(len(draws))
        return 2 * _element_means(_smooth(total, region.mask, mesh.size), pixels)

    noise, mosaic = (scores(draws) for draws in errors)
    information = spectrum.energy * _element_means(precision * texture_contrast, pixels)
    combined = expected_std(mesh, information.sum(axis=0), noise[0] + mosaic[0], noise[0], mosaic[0])
    single_light = [
        expected_std(mesh, info, score)[0] for info, score in zip(information, (noise + mosaic)[1:], strict=True)
    ]
    return Prediction(std=combined[0], noise=combined[1], mosaic=combined[2], single_light=tuple(single_light))


def gaussian_field(texture: TextureModel, shape: tuple[int, ...], random: np.random.Generator) -> FloatImage:
    """Return a Gaussian random image (H, W) with the autocorrelation of `texture`, its offset aside."""
    rows, columns = (next_fast_len(side, real=True) for side in shape)
    frequency = np.hypot(fftfreq(rows).astype(np.float32)[:, None], rfftfreq(columns).astype(np.float32))
    table = np.linspace(0, 0.71, 4096)
    spectrum = rfft2(random.standard_normal((rows, columns), dtype=np.float32))
    spectrum *= np.interp(frequency, table, np.sqrt(texture.spectrum(table))).astype(np.float32)
    return np.asarray(irfft2(spectrum, s=(rows, columns))[: shape[0], : shape[1]], dtype=np.float32)


def _draw_sites(model: Reconstruction, strength: FloatArray, random: np.random.Generator) -> FloatImage:
    """Samples (4, H, W) that each kind of site would take everywhere of a random state with the frame's statistics.

    Every light shows the texture where the registration says that it does, and a component of its own.
    """
    factors, texture, sites = model.factors, model.texture, model.model
    shape = model.mosaic.values.shape
    displacement = upsample(sites.displacement.reshape(-1, *sites.displacement.shape[2:]), BLOCK, shape)
    margin = int(np.ceil(np.abs(displacement).max())) + 2
    common = gaussian_field(texture, (shape[0] + 2 * margin, shape[1] + 2 * margin), random)
    sparkle = TextureModel(weights=(1.0,), widths=(float(np.sqrt(2 * SPARKLE_VARIANCE)),))
    # by the median around: variances are cut off at zero, so that a mean would be too large
    size = 1, CONSTANTS.median_window, CONSTANTS.median_window
    typical = median_filter(factors.light_specific - MIN_SPECIFIC, size=size, mode="reflect")
    deviation = np.sqrt(upsample(np.maximum(typical, 0), BLOCK, shape))
    slope = upsample(_smooth_blocks(factors.light_slope, BLOCK), BLOCK, shape)
    mean = upsample(_smooth_blocks(model.moments.channel_mean, MEAN_BLOCK), MEAN_BLOCK, shape)
    response = sites.sites * strength
    # each green sees the lights' means in its own proportion
    response_beyond = (response - sites.matrix[list(CHANNEL)]) @ np.linalg.pinv(sites.matrix)
    samples = mean[list(CHANNEL)] + np.tensordot(response_beyond.astype(np.float32), mean, axes=1)
    for light, (x, y) in enumerate(displacement.reshape(-1, 2, *shape)):
        contrast = _displace(common, x, y, margin)
        if deviation[light].any():
            coarse, fine = (gaussian_field(kind, shape, random) for kind in (texture, sparkle))
            specific = np.sqrt(texture.specific) * coarse + np.sqrt(1 - texture.specific) * fine
            contrast += deviation[light] * specific
        samples += response[:, light, None, None].astype(np.float32) * (slope[light] * contrast)
    return np.asarray(samples, dtype=np.float32)


def _displace(image: FloatImage, x: FloatImage, y: FloatImage, margin: int) -> FloatImage:
    """Return the image less a margin, displaced by fields x and y (H, W)."""
    rows, columns = x.shape
    if not (x.any() or y.any()):
        return image[margin : margin + rows, margin : margin + columns].copy()
    spline = np.empty((image.shape[0] + 2 * PAD, image.shape[1] + 2 * PAD), dtype=np.float32)
    bspline_coefficients(image, spline)
    row, column = np.mgrid[margin : margin + rows, margin : margin + columns].astype(np.float64)
    sampled = np.empty((3, x.size), dtype=np.float32)
    sample_with_gradient(spline, (column - x).ravel(), (row - y).ravel(), *sampled)
    return np.asarray(sampled[0].reshape(x.shape))


def _smooth_blocks(grid: npt.NDArray[np.floating], block: int) -> FloatArray:
    """Return a grid (n, h, w) of blocks smoothed once more, without the scatter of few speckles per window.

    The scatter differs from channel to channel, and a frame with a ratio of the channels that scatters would be harder
    to separate than a real one.
    """
    return np.stack(
        [cv2.GaussianBlur(layer.astype(np.float64), (0, 0), CONSTANTS.smoothing_width / block) for layer in grid]
    )


def _add_noise(values: FloatImage, noise: NoiseModel, random: np.random.Generator) -> FloatImage:
    white = random.standard_normal(values.shape, dtype=np.float32)
    return np.asarray(values + white * np.sqrt(noise.variance(values)), dtype=np.float32)


def _smooth(images: FloatImage, inside: BoolArray, width: float) -> FloatImage:
    """Return the local means of images (n, H, W) inside the region, over about an element and its neighbours."""
    return np.stack([np.nan_to_num(local_mean(np.where(inside, image, np.float32(np.nan)), width)) for image in images])


def _element_means(images: FloatImage, pixels: PixelMap) -> FloatArray:
    """Return the means (n, E) of images (n, H, W) over the pixels of each element; 0 for one without pixels."""
    total = np.cumsum(pixels.gather(images), axis=1, dtype=np.float64)
    ends = np.pad(total, ((0, 0), (1, 0)))[:, pixels.offsets]
    return np.asarray(np.diff(ends, axis=1) / np.maximum(np.diff(pixels.offsets), 1))
