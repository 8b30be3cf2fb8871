"""Channels of one frame before anything is demosaiced: the part looked at, samples, speckle size and noise.

A channel of a mosaic is an image (H, W) with NaN where another channel was sampled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.optimize import nnls

from rgbmidic.frames.data import Window, sampled_channels
from rgbmidic.illumination.images import local_mean
from rgbmidic.illumination.linear import LinearChannels, LinearMosaic, NoiseModel
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.mesh import Region
from rgbmidic.typing import BoolArray, FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectionConstants:
    """Constants of an inspection.

    Attributes
    ----------
    margin
        Surroundings (px) of the region that are looked at with it: three times `smoothing_width`.
    mean_width
        Standard deviation (px) of the local mean that the speckle's contrast is taken against; wide, so as to keep
        coarse speckle.
    max_lag
        Largest distance (px) of the autocorrelation: speckle of up to half of it is found.
    min_width, width_ratio, n_widths
        Standard deviation (px) of the narrowest of the Gaussians that are fitted to it, of each to the one before, and
        their number.
    max_samples, flat_fraction
        Samples that are looked at, and the fraction of them, with the flattest surroundings, for the regression that
        finds unknown noise; chosen.
    smoothing_width
        Standard deviation (px) of the window over which the model of the frame is averaged once more.
    median_window
        Side (blocks) of the square over which the channel-specific variance is taken by its median.
    n_frequencies, kernel_reach
        Frequencies on which the kernel of the speckle's gradient is computed, and the distance (px) to which it is
        kept: gradients are correlated over a speckle or two.
    min_agreement
        Agreement of neighbouring colours below which the speckle is too fine for the colour lattice (docs: inspect).
    min_speckle
        Size (px) of speckle whose colours agree so.
    max_negative
        Fraction of the pixels where a light is negative from which a warning is given; chosen, as the next two.
    min_level
        Fraction of the full scale that the 95 % quantile of a channel must reach.
    max_green_difference
        Largest difference between the two greens of a mosaic, as a fraction of their mean.
    """

    margin: int = 96
    mean_width: float = 20.0
    max_lag: int = 24
    min_width: float = 0.5
    width_ratio: float = 1.25
    n_widths: int = 17
    max_samples: int = 20_000
    flat_fraction: float = 0.05
    smoothing_width: float = 32.0
    median_window: int = 9
    n_frequencies: int = 64
    kernel_reach: int = 16
    min_agreement: float = 0.75
    min_speckle: float = 2.0
    max_negative: float = 0.01
    min_level: float = 0.1
    max_green_difference: float = 0.05


CONSTANTS = InspectionConstants()


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


def frame_channels(frames: list[LinearMosaic | LinearChannels]) -> list[Channel]:
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
    """Return the autocorrelation of a channel's contrast; None without one that ends within the farthest distance.

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
    is_zero_lag = distance == 0
    if noise is not None:
        product[is_zero_lag] -= float((noise.variance(mean[usable]) / mean[usable] ** 2).mean())
    is_used = (count > 0.05 * count.max()) & (~is_zero_lag if noise is None else True)
    narrowest = 0.0 if noise is not None else channel.step / 2  # narrower ones cannot be distinguished from noise
    widths = CONSTANTS.min_width * CONSTANTS.width_ratio ** np.arange(CONSTANTS.n_widths, dtype=np.float64)
    return _fit_gaussians(distance[is_used], product[is_used], widths[narrowest < widths])


def _autocorrelation(contrast: FloatImage, usable: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return distances (px) up to the farthest, the mean product of samples so far apart, and how many there are."""
    farthest = CONSTANTS.max_lag
    size = [next_fast_len(side + farthest + 1, real=True) for side in contrast.shape]
    sums, pairs = (
        irfft2(np.abs(rfft2(image, s=size)) ** 2, s=size)
        for image in (contrast.astype(np.float64), usable.astype(float))
    )
    lag = np.arange(-farthest, farthest + 1)
    square = np.minimum(lag[:, None] ** 2 + lag**2, farthest**2 + 1)
    totals, counts = (
        np.bincount(square.ravel(), weights=image[np.ix_(lag, lag)].ravel())[:-1] for image in (sums, np.round(pairs))
    )
    lags_present = np.flatnonzero(counts > 0)
    return (
        np.sqrt(lags_present.astype(np.float64)),
        np.asarray(totals[lags_present] / counts[lags_present]),
        counts[lags_present].astype(np.float64),
    )


def _fit_gaussians(distance: FloatArray, product: FloatArray, widths: FloatArray) -> TextureModel | None:
    """Return ``sum w exp(-r^2/2s^2) - c`` with w, c >= 0, fitted to the products."""
    importance = 1 / (1 + distance)
    system = np.column_stack([np.exp(-0.5 * (distance[:, None] / widths) ** 2), -np.ones(distance.size)])
    scale = float(np.abs(product).max()) or 1.0
    solution = nnls(system * importance[:, None], product / scale * importance)[0]
    total, is_positive = solution[:-1].sum() - solution[-1], solution[:-1] > 0
    if not total > 0:
        return None
    weights = solution[:-1][is_positive] / total
    offset = min(1 - float(weights.sum()), 0.0)
    model = TextureModel(weights=tuple(weights.tolist()), widths=tuple(widths[is_positive].tolist()), offset=offset)
    return model if model.diameter < 2 * CONSTANTS.max_lag else None


def estimate_noise(channels: list[Channel], inside: BoolArray) -> list[float]:
    """Return the standard deviation (DN) of the noise of a sample of each channel, estimated from a single frame.

    Where its surroundings are bright and flattest, a sample's contrast is predicted from the 24 samples around it, of
    any channel, by linear regression, one for each position in the cell of the mosaic. The residual holds the
    sample's own noise, that of its neighbours through the regression, and texture that they do not predict: fair where
    paint is flat over five samples, too high for finer speckle and in reflections (docs: inspect). Its scale is
    1.4826 times the median absolute value.
    """
    means = [_mean(channel) for channel in channels]
    images = [channel.values / mean - 1 for channel, mean in zip(channels, means, strict=True)]
    if channels[0].step > 1:  # the channels of a mosaic make one image
        images = [np.fmax.reduce(images)] * len(channels)
    estimates = []
    for channel, mean, image in zip(channels, means, images, strict=True):
        lattice = inside & np.isfinite(channel.values) & ~channel.saturated
        phases = [(p, q) for p in range(channel.step) for q in range(channel.step)]
        residuals = [_regression_residual(image, lattice, phase, channel.step) for phase in phases]
        residual = np.concatenate(
            [values_part for values_part in residuals if values_part.size] or [np.full(1, np.nan)]
        )
        level = float(np.nanmean(mean[lattice])) if lattice.any() else float("nan")
        estimates.append(1.4826 * float(np.median(np.abs(residual))) * level)
    return estimates


def _mean(channel: Channel) -> FloatImage:
    mean = local_mean(np.where(channel.saturated, np.float32(np.nan), channel.values), CONSTANTS.mean_width)
    return np.where(mean > 0, mean, np.float32(np.nan))


def _regression_residual(image: FloatImage, lattice: BoolArray, phase: tuple[int, int], step: int) -> FloatImage:
    """Return the residual (flat) of the samples of one phase after a regression on the 5 x 5 samples around each."""
    rows, columns = np.nonzero(lattice[2:-2, 2:-2])
    in_phase = ((rows + 2) % step == phase[0]) & ((columns + 2) % step == phase[1])
    rows, columns = rows[in_phase], columns[in_phase]
    stride = max(1, rows.size // CONSTANTS.max_samples)
    patches = np.lib.stride_tricks.sliding_window_view(image, (5, 5))[rows[::stride], columns[::stride]].reshape(-1, 25)
    patches = patches[np.isfinite(patches).all(axis=1)].astype(np.float64)
    # the sample itself takes no part in the choice; dark places would be flattest, but have less photon noise
    patches = patches[np.delete(patches, 12, axis=1).mean(axis=1) >= 0]
    if len(patches) < 100:
        return np.empty(0, dtype=np.float32)
    spread = np.delete(patches, 12, axis=1).std(axis=1)
    flattest = min(max(CONSTANTS.flat_fraction, 250 / len(patches)), 1.0)
    patches = patches[spread <= np.quantile(spread, flattest)]
    neighbours = np.delete(patches, 12, axis=1)
    system = np.column_stack([neighbours, np.ones(len(neighbours))])
    coefficients = np.linalg.lstsq(system, patches[:, 12], rcond=None)[0]
    freedom = np.sqrt(len(patches) / max(len(patches) - system.shape[1], 1))
    return np.asarray((patches[:, 12] - system @ coefficients) * freedom, dtype=np.float32)


def roi_window(region: Region) -> Window:
    """Return the part of the frame that is looked at: the region and a margin around.

    It begins at an even column and row, so that the pattern of a mosaic stays the same.
    """
    spans = [np.flatnonzero(region.mask.any(axis=axis)) for axis in (1, 0)]
    first = [max(int(span[0]) - CONSTANTS.margin, 0) // 2 * 2 for span in spans]
    last = [
        min(int(span[-1]) + 1 + CONSTANTS.margin, side) for span, side in zip(spans, region.mask.shape, strict=True)
    ]
    shape = last[0] - first[0], last[1] - first[1]
    return Window(origin=(first[1], first[0]), shape=shape, frame=region.mask.shape)
