"""Samples of one frame before anything is demosaiced: the part looked at, its channels, speckle size and noise.

A channel of a mosaic is an image (H, W) with NaN where another channel was sampled.

Displacement uncertainty expected from one frame: `rgbmidic.scene.forecast` with images of the frame's errors.

Contrast and energy of the speckle's gradient follow from the frame; the errors are drawn (`SeparationErrors`). The
reflection-aware model of the frame (local means, slope of each channel on the common texture, channel-specific
component, autocorrelation of the speckle) describes a random frame with the statistics of the one given. Such a frame
is drawn with all its channels at every pixel and separated as the test does, behind the four phases of the colour
filter array: what is the same in all of them moves with the specimen, the rest stays with the sensor.
Camera noise goes the same way. Filtered with the root of the speckle's gradient spectrum, the mean square of the errors
is the variance of the right-hand side.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter
from scipy.optimize import nnls

from rgbmidic.correlation.images import apply_prefilter
from rgbmidic.frames.data import Window, sampled_channels
from rgbmidic.illumination.colour_factors import BLOCK, LEAST, MEAN_BLOCK, enlarged
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.demosaicing import SPARKLE_VARIANCE, Reconstruction
from rgbmidic.illumination.images import DARK, IlluminationImages, local_mean
from rgbmidic.illumination.linear import LinearChannels, LinearMosaic, NoiseModel
from rgbmidic.illumination.separation import separate
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.mesh import PixelMap, Region, Tri3Mesh
from rgbmidic.scene.camera import mosaic_samples
from rgbmidic.scene.forecast import expected_std, light_pull
from rgbmidic.scene.speckle import SpeckleSpectrum, separated_phases
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

MEAN_WIDTH = 20.0
"""Standard deviation (px) of the local mean that the contrast is taken against; wide, so as to keep coarse speckle."""
FARTHEST = 24
"""Largest distance (px) of the autocorrelation: speckle of up to half of it is found."""
_WIDTHS = 0.5 * 1.25 ** np.arange(17)
"""Standard deviations (px) of the Gaussians that are fitted to it."""
_REGRESSED, _FLATTEST = 20_000, 0.05
"""Samples that are looked at, and the fraction of them, with the flattest surroundings, for the
regression; chosen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """One camera channel as it was sampled.

    Attributes
    ----------
    name : str
    values : ndarray, shape (H, W), float32
        DN above black; NaN where another channel was sampled.
    saturated : ndarray, shape (H, W), bool
    step : int
        Distance (px) of neighbouring samples along a row: 2 on the lattice of a mosaic, else 1.
    """

    name: str
    values: FloatImage
    saturated: BoolArray
    step: int


def channels_of(frames: list[LinearMosaic | LinearChannels]) -> list[Channel]:
    """Return the channels of a frame, or of the frames of lights fired in succession."""
    channels: list[Channel] = []
    for number, frame in enumerate(frames, start=1):
        if isinstance(frame, LinearMosaic):
            site = sampled_channels(frame.cfa, frame.values.shape)
            for colour, name in enumerate("RGB"):
                values = np.where(site == colour, frame.values, np.float32(np.nan))
                saturated = frame.saturated & (site == colour)
                channels.append(Channel(name=name, values=values, saturated=saturated, step=2))
            continue
        names = ("R", "G", "B") if len(frame.values) == 3 else (f"M{number}" if len(frames) > 1 else "M",)
        for name, values, valid in zip(names, frame.values, frame.valid, strict=True):
            channels.append(Channel(name=name, values=values, saturated=~valid, step=1))
    return channels


def speckle_texture(channel: Channel, inside: BoolArray, noise: NoiseModel | None) -> TextureModel | None:
    """Return the autocorrelation of a channel's contrast; None without a texture, or one that ends within `FARTHEST`.

    The contrast is the sample over the local mean, less 1. Products of samples of this channel alone enter, so that
    demosaicing has no part in it. The noise is a peak at distance 0, where its variance is subtracted; with unknown
    noise distance 0 is left out, and speckle that is finer than the lattice goes unseen. A sum of Gaussians fitted to
    the products bridges the distances that the lattice does not have.

    References
    ----------
    G. Crammond, S. W. Boyd, J. M. Dulieu-Barton, Speckle pattern quality assessment for digital image correlation,
    Optics and Lasers in Engineering 51 (2013) 1368-1378; M. A. Sutton, J.-J. Orteu, H. Schreier, Image Correlation for
    Shape, Motion and Deformation Measurements, Springer 2009, section 5 (speckle size from the autocorrelation).
    """
    mean = _mean(channel)
    usable = np.isfinite(channel.values) & ~channel.saturated & inside & (mean > 0)
    if usable.sum() < 64:
        return None
    contrast = np.where(usable, channel.values / np.where(usable, mean, np.float32(1)) - 1, np.float32(0))
    distance, product, count = _autocorrelation(contrast, usable)
    at_zero = distance == 0
    if noise is not None:
        product[at_zero] -= float((noise.variance(mean[usable]) / mean[usable] ** 2).mean())
    kept = (count > 0.05 * count.max()) & (~at_zero if noise is None else True)
    narrowest = 0.0 if noise is not None else channel.step / 2  # narrower ones cannot be distinguished from noise
    return _fitted(distance[kept], product[kept], np.asarray(_WIDTHS[narrowest < _WIDTHS], dtype=np.float64))


def _autocorrelation(contrast: FloatImage, usable: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distances (px) up to `FARTHEST`, the mean product of samples so far apart, and how many there are."""
    from scipy.fft import irfft2, next_fast_len, rfft2

    size = [next_fast_len(side + FARTHEST + 1, real=True) for side in contrast.shape]
    sums, pairs = (
        irfft2(np.abs(rfft2(image, s=size)) ** 2, s=size)
        for image in (contrast.astype(np.float64), usable.astype(float))
    )
    lag = np.arange(-FARTHEST, FARTHEST + 1)
    square = np.minimum(lag[:, None] ** 2 + lag**2, FARTHEST**2 + 1)
    totals, counts = (
        np.bincount(square.ravel(), weights=image[np.ix_(lag, lag)].ravel())[:-1] for image in (sums, np.round(pairs))
    )
    met = np.flatnonzero(counts > 0)
    return np.sqrt(met.astype(np.float64)), np.asarray(totals[met] / counts[met]), counts[met].astype(np.float64)


def _fitted(distance: FloatArray, product: FloatArray, widths: FloatArray) -> TextureModel | None:
    """``sum w exp(-r^2/2s^2) - c`` with w, c >= 0, fitted to the products."""
    importance = 1 / (1 + distance)
    system = np.column_stack([np.exp(-0.5 * (distance[:, None] / widths) ** 2), -np.ones(distance.size)])
    scale = float(np.abs(product).max()) or 1.0
    solution = nnls(system * importance[:, None], product / scale * importance)[0]
    total, kept = solution[:-1].sum() - solution[-1], solution[:-1] > 0
    if not total > 0:
        return None
    weights = solution[:-1][kept] / total
    offset = min(1 - float(weights.sum()), 0.0)
    model = TextureModel(weights=tuple(weights.tolist()), widths=tuple(widths[kept].tolist()), offset=offset)
    return model if model.diameter < 2 * FARTHEST else None


def noise_estimate(channels: list[Channel], inside: BoolArray) -> list[float]:
    """Return the standard deviation (DN) of the noise of a sample of each channel, estimated from a single frame.

    Where its surroundings are bright and flattest, a sample's contrast is predicted from the 24 samples around it, of
    any channel, by linear regression, one for each position in the cell of the mosaic. The residual holds the
    sample's own noise, that of its neighbours through the regression, and texture that they do not predict: fair where
    paint is flat over five samples, too high for finer speckle and in reflections (docs: inspect). Its scale is
    1.4826 times the median absolute value.
    """
    means = [_mean(channel) for channel in channels]
    if channels[0].step == 1:
        images = [channel.values / mean - 1 for channel, mean in zip(channels, means, strict=True)]
    else:
        total = np.full(inside.shape, np.nan, dtype=np.float32)
        for channel, mean in zip(channels, means, strict=True):
            total = np.where(np.isfinite(channel.values), channel.values / mean - 1, total)
        images = [total] * len(channels)
    estimates = []
    for channel, mean, image in zip(channels, means, images, strict=True):
        lattice = inside & np.isfinite(channel.values) & ~channel.saturated
        phases = [(p, q) for p in range(channel.step) for q in range(channel.step)]
        left = [_unpredicted(image, lattice, phase, channel.step) for phase in phases]
        rest = np.concatenate([part for part in left if part.size] or [np.full(1, np.nan)])
        level = float(np.nanmean(mean[lattice])) if lattice.any() else float("nan")
        estimates.append(1.4826 * float(np.median(np.abs(rest))) * level)
    return estimates


def _mean(channel: Channel) -> FloatImage:
    mean = local_mean(np.where(channel.saturated, np.float32(np.nan), channel.values), MEAN_WIDTH)
    return np.where(mean > 0, mean, np.float32(np.nan))


def _unpredicted(image: FloatImage, lattice: BoolArray, phase: tuple[int, int], step: int) -> FloatImage:
    """Residual (flat) of the samples of one phase after a regression on the 5 x 5 samples around each."""
    rows, columns = np.nonzero(lattice[2:-2, 2:-2])
    kept = ((rows + 2) % step == phase[0]) & ((columns + 2) % step == phase[1])
    rows, columns = rows[kept], columns[kept]
    every = max(1, rows.size // _REGRESSED)
    patches = np.lib.stride_tricks.sliding_window_view(image, (5, 5))[rows[::every], columns[::every]].reshape(-1, 25)
    patches = patches[np.isfinite(patches).all(axis=1)].astype(np.float64)
    if len(patches) < 100:
        return np.empty(0, dtype=np.float32)
    # the sample itself takes no part in the choice; dark places would be flattest, but have less photon noise
    others = np.delete(patches, 12, axis=1)
    patches, others = (part[others.mean(axis=1) >= 0] for part in (patches, others))
    if len(patches) < 100:
        return np.empty(0, dtype=np.float32)
    spread = others.std(axis=1)
    patches = patches[spread <= np.quantile(spread, min(max(_FLATTEST, 250 / len(patches)), 1.0))]
    around = np.delete(patches, 12, axis=1)
    system = np.column_stack([around, np.ones(len(around))])
    coefficients = np.linalg.lstsq(system, patches[:, 12], rcond=None)[0]
    freedom = np.sqrt(len(patches) / max(len(patches) - system.shape[1], 1))
    return np.asarray((patches[:, 12] - system @ coefficients) * freedom, dtype=np.float32)


MARGIN = 96
"""Surroundings (px) of the region that are looked at with it: three standard deviations of the window over which the
model of the frame is averaged (`rgbmidic.lab.inspection.prediction.SETTLED`)."""


def surroundings(region: Region) -> Window:
    """Return the part of the frame that is looked at: the region and `MARGIN` px around.

    It begins at an even column and row, so that the pattern of a mosaic stays the same.
    """
    spans = [np.flatnonzero(region.mask.any(axis=axis)) for axis in (1, 0)]
    first = [max(int(span[0]) - MARGIN, 0) // 2 * 2 for span in spans]
    last = [min(int(span[-1]) + 1 + MARGIN, side) for span, side in zip(spans, region.mask.shape, strict=True)]
    shape = last[0] - first[0], last[1] - first[1]
    return Window(origin=(first[1], first[0]), shape=shape, frame=region.mask.shape)


_GRID, _REACH = 64, 16
"""Frequencies on which the kernel is computed, and the distance (px) to which it is kept: speckle's gradients are
correlated over a speckle or two."""
SETTLED = 32.0
"""Standard deviation (px) of the window over which the model of the frame is averaged once more."""
TYPICAL = 9
"""Side (blocks) of the square over which the channel-specific variance is taken by its median."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeparationErrors:
    """Images of the errors of the lights of one state.

    Attributes
    ----------
    noise : ndarray, shape (k, H, W), float32
        Change of the lights by the camera noise, DN.
    mosaic : ndarray, shape (4, k, H, W), float32
        Difference of the lights behind each phase of the colour filter array from the mean of the four, DN; shape
        (0, k, H, W) for a camera that has all channels at every pixel.
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
    ) -> SeparationErrors:
        """Errors drawn for a raw mosaic.

        Parameters
        ----------
        mosaic
            The frame, with the noise that the separation reckons with.
        model
            Model of the frame that the reflection-aware method fitted.
        crosstalk, method
            How the test separates its frames (`rgbmidic.illumination.separation`).
        noise
            Camera noise to draw.
        random
            Source of random numbers.
        """
        channels = _drawn_channels(model, mosaic.values.shape, random)

        def lights(values: FloatImage, cfa: str) -> FloatImage:
            drawn = replace(mosaic, values=values, cfa=cfa, saturated=np.zeros(values.shape, dtype=bool))
            return np.nan_to_num(separate(drawn, crosstalk, method, texture=model.texture).values)

        images = separated_phases(channels, mosaic.cfa, lights)
        noisy = lights(_noisy(mosaic_samples(channels, mosaic.cfa), noise, random), mosaic.cfa)
        return cls(noise=noisy - images[0], mosaic=images - images.mean(axis=0))

    @classmethod
    def of_channels(
        cls,
        frames: Sequence[LinearChannels],
        lights: Callable[[Sequence[LinearChannels]], IlluminationImages],
        noise: NoiseModel,
        random: np.random.Generator,
    ) -> SeparationErrors:
        """Errors drawn for a camera with all channels at every pixel: those of noise alone.

        Parameters
        ----------
        frames
            Of one state: one, or one per light in succession.
        lights
            Separates them.
        noise, random
            Camera noise to draw; source of random numbers.
        """
        quiet = lights(frames).values
        noisy = lights([replace(frame, values=_noisy(frame.values, noise, random)) for frame in frames]).values
        return cls(noise=np.nan_to_num(noisy - quiet), mosaic=np.empty((0, *quiet.shape), dtype=np.float32))


CONTRAST_WIDTH = (10.0, 40.0)
"""Least and largest standard deviation (px) of the window in which local contrast is taken: 2.5 speckles between."""
BLIND = 0.5
"""Fraction of the usual contrast that no light reaches where the specimen cannot be seen; chosen."""
SHADE = 0.25
"""Fraction of the brightness of the brightest tenth below which an image is dark. Chosen: the background of the DIC
Challenge's open-hole specimen has 0.1; the parts of a specimen that are lit less keep their contrast."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalContrast:
    """Local statistics of the lights.

    Those of what is lit and of what lies in the dark, such as the background beside a specimen, are taken apart: the
    edge between them is no texture.

    Attributes
    ----------
    level : ndarray, shape (k, H, W), float32
        Local mean, DN.
    contrast : ndarray, shape (k, H, W), float32
        Local standard deviation in units of that mean, 0 where the light is dark or unknown.
    lit : ndarray, shape (k, H, W), bool
        Where the paint around is as bright as in the rest of the image (`SHADE`).
    """

    level: FloatImage
    contrast: FloatImage
    lit: BoolArray

    @classmethod
    def of(
        cls, images: IlluminationImages, speckles: Sequence[float], inside: BoolArray, noise: NoiseModel
    ) -> LocalContrast:
        """Statistics in windows that hold many speckles, of which the sizes (px) are known or NaN, for a region.

        In the dark, where it would look like texture, camera noise is subtracted.
        """
        sizes = [size for size in speckles if np.isfinite(size)]
        window = float(np.clip(2.5 * np.median(sizes) if sizes else 0.0, *CONTRAST_WIDTH))
        level, contrast = np.zeros((2, *images.values.shape), dtype=np.float32)
        lit = np.zeros(images.values.shape, dtype=bool)
        closing = np.ones((round(window), round(window)), dtype=np.uint8)  # wider than dark speckle
        for image, mean, relative, bright in zip(images.values, level, contrast, lit, strict=True):
            filled = np.nan_to_num(image, nan=images.full_scale)  # what is not known is saturated
            paint = cv2.morphologyEx(filled, cv2.MORPH_CLOSE, closing)
            bright[:] = paint >= SHADE * np.quantile(paint[inside], 0.9)
            core = cv2.erode((~bright).astype(np.uint8), closing) > 0  # without the blurred rim of what is lit
            for part, sampled in ((bright, bright), (~bright, core)):
                if not part.any():
                    continue
                values = np.where(sampled, image, np.float32(np.nan))
                mean[part] = np.nan_to_num(local_mean(values, window))[part]
                square = local_mean(values**2, window)
                seen = part & np.isfinite(image) & (mean > DARK * images.full_scale)
                variance = square[seen] - mean[seen] ** 2
                if sampled is core:
                    variance -= noise.variance(mean[seen])
                relative[seen] = np.sqrt(np.maximum(variance, 0)) / mean[seen]
        return cls(level=level, contrast=contrast, lit=lit)

    def hidden(self, inside: BoolArray) -> BoolArray:
        """Where (H, W) no light has half the contrast that is usual in the lit part of the region."""
        best, lit = self.contrast.max(axis=0), inside & self.lit.any(axis=0)
        return np.asarray(best < BLIND * np.quantile(best[lit if lit.any() else inside], 0.9))

    def background(self, inside: BoolArray) -> BoolArray:
        """Where (H, W) there is neither texture nor light: nothing can be measured."""
        return np.asarray(self.hidden(inside) & ~self.lit.any(axis=0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """Standard uncertainty of u, and of v, at the nodes (N,), px; NaN where a node is not measured.

    Attributes
    ----------
    std
        Of all lights together.
    noise, mosaic
        The parts of it from camera noise, and from samples that the mosaic lacks.
    alone : tuple of ndarray
        Of every light alone.
    """

    std: FloatArray
    noise: FloatArray
    mosaic: FloatArray
    alone: tuple[FloatArray, ...]


def predict(
    mesh: Tri3Mesh,
    region: Region,
    lights: LocalContrast,
    errors: SeparationErrors,
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
        Of one state, DN; those of the other state are as large and independent.
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
        return Prediction(std=unknown, noise=unknown, mosaic=unknown, alone=(unknown,) * len(contrast))
    light = contrast > 0
    spectrum = SpeckleSpectrum.of_texture(texture, size=_GRID, prefilter=prefilter)
    kernel = spectrum.score_kernel(_REACH)

    def filtered(draws: FloatImage, change: Callable[[FloatImage], FloatImage]) -> Iterator[FloatImage]:
        """Draws (n, k, H, W) relative to the level of the light, one (k, H, W) after the other, every image changed."""
        for draw in draws:
            relative = np.divide(draw, level, out=np.zeros_like(draw), where=light)
            yield np.stack([change(image) for image in relative])

    def variance(change: Callable[[FloatImage], FloatImage]) -> FloatImage:
        """Local mean square (k, H, W) of all errors of one state."""
        total = np.zeros_like(contrast)
        for draws in parts:
            for images in filtered(draws, change):
                total += images**2 / np.float32(len(draws))
        return _smooth(total, region.mask, mesh.size)

    parts = errors.noise[None], errors.mosaic
    texture_contrast = np.sqrt(np.maximum(contrast**2 - variance(lambda image: image), 0) * light)
    residual = variance(lambda image: apply_prefilter(image, prefilter))
    pull = light_pull(texture_contrast, residual)
    pixels = PixelMap.from_mesh(mesh, region)

    def scores(draws: FloatImage) -> FloatArray:
        """Score (1 + k, E) of all lights together and of each alone, between two states."""
        total = np.zeros((1 + len(pull), *pull.shape[1:]), dtype=np.float32)
        for images in filtered(draws, lambda image: np.asarray(cv2.filter2D(image, -1, kernel), dtype=np.float32)):
            images *= pull
            total[0] += images.sum(axis=0) ** 2 / np.float32(len(draws))
            total[1:] += images**2 / np.float32(len(draws))
        return 2 * _element_means(_smooth(total, region.mask, mesh.size), pixels)

    noise, mosaic = (scores(draws) for draws in parts)
    information = spectrum.energy * _element_means(pull * texture_contrast, pixels)
    together = expected_std(mesh, information.sum(axis=0), noise[0] + mosaic[0], noise[0], mosaic[0])
    alone = [expected_std(mesh, info, score)[0] for info, score in zip(information, (noise + mosaic)[1:], strict=True)]
    return Prediction(std=together[0], noise=together[1], mosaic=together[2], alone=tuple(alone))


def gaussian_field(texture: TextureModel, shape: tuple[int, ...], random: np.random.Generator) -> FloatImage:
    """Return a Gaussian random image (H, W) with the autocorrelation of `texture`, its offset aside."""
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
    # by the median around: variances are cut off at zero, so that a mean would be too large
    typical = median_filter(factors.specific - LEAST, size=(1, TYPICAL, TYPICAL), mode="reflect")
    deviation = np.sqrt(enlarged(np.maximum(typical, 0), BLOCK, shape))
    for channel in range(3):
        if deviation[channel].any():
            coarse, fine = (gaussian_field(kind, shape, random) for kind in (texture, sparkle))
            specific = np.sqrt(texture.specific) * coarse + np.sqrt(1 - texture.specific) * fine
            channels[channel] += deviation[channel] * specific
    mean = enlarged(_settled(model.mean, MEAN_BLOCK), MEAN_BLOCK, shape)
    return np.asarray(mean + enlarged(_settled(factors.slope, BLOCK), BLOCK, shape) * channels, dtype=np.float32)


def _settled(grid: npt.NDArray[np.floating], block: int) -> FloatArray:
    """Return a grid (n, h, w) of blocks smoothed over `SETTLED` px, without the scatter of few speckles per window.

    The scatter differs from channel to channel, and a frame with a ratio of the channels that scatters would be harder
    to separate than a real one.
    """
    return np.stack([cv2.GaussianBlur(layer.astype(np.float64), (0, 0), SETTLED / block) for layer in grid])


def _noisy(values: FloatImage, noise: NoiseModel, random: np.random.Generator) -> FloatImage:
    white = random.standard_normal(values.shape, dtype=np.float32)
    return np.asarray(values + white * np.sqrt(noise.variance(values)), dtype=np.float32)


def _smooth(images: FloatImage, inside: BoolArray, width: float) -> FloatImage:
    """Local means of images (n, H, W) inside the region, over about an element and its neighbours."""
    return np.stack([np.nan_to_num(local_mean(np.where(inside, image, np.float32(np.nan)), width)) for image in images])


def _element_means(images: FloatImage, pixels: PixelMap) -> FloatArray:
    """Means (n, E) of images (n, H, W) over the pixels of each element; 0 for one without pixels."""
    total = np.cumsum(pixels.gather(images), axis=1, dtype=np.float64)
    ends = np.pad(total, ((0, 0), (1, 0)))[:, pixels.offsets]
    return np.asarray(np.diff(ends, axis=1) / np.maximum(np.diff(pixels.offsets), 1))
