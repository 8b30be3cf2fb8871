"""The crosstalk matrix A from captures with one light on at a time: camera channels = A . lights.

For each light the channel that sees it best is the reference; the entry of another channel is the ratio of the two
channels' block averages, estimated from sums of both (an estimating equation with the position as instrument), which
noise in the reference channel does not attenuate as it does a least-squares slope. Outlying blocks are left out. The
covariance is the cluster sandwich over the field, plus the error of the dark level common to all blocks, plus the
scatter between captures beyond their noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import CalibrationError
from rgbmidic.illumination.calibration import Crosstalk
from rgbmidic_calibration.blocks import BlockMeans
from rgbmidic_calibration.plausibility import CHECKS, check_captures, check_matrix

__all__ = ["CHANNELS", "CrosstalkEstimate", "LightFit", "estimate_crosstalk"]

Floats = npt.NDArray[np.float64]

CHANNELS = ("R", "G", "B")

BLACK_LEVEL_STD = 0.3
"""Standard uncertainty (DN) of a black level that no series of dark frames measured: rounded to whole grey levels."""

OUTLIER = 5.0
"""Robust standard deviations beyond which a block is left out: a fluorescent spot, a label, a hot cluster."""
MIN_BLOCKS = 9
DRIFT_SIGNIFICANCE = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class LightFit:
    """What was found for one light.

    Attributes
    ----------
    name : str
    reference : int
        Channel that sees the light best.
    column : ndarray, shape (C,)
        Column of A; 1 in the reference channel.
    signal : float
        Mean grey level (DN above dark) of the reference channel in the blocks used.
    used, saturated, rejected : float
        Shares of the blocks that were used, left out as saturated, and given no weight as outliers.
    intensity_drift : float
        Range of the light's strength over the captures, relative to its mean.
    colour_drift : float
        Largest scatter (standard deviation) of an entry between captures beyond their noise.
    captures : int
    """

    name: str
    reference: int
    column: Floats
    signal: float
    used: float
    saturated: float
    rejected: float
    intensity_drift: float
    colour_drift: float
    captures: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CrosstalkEstimate:
    """Result of `estimate_crosstalk`: the matrix, one fit per light, and what the user should know about it."""

    crosstalk: Crosstalk
    lights: tuple[LightFit, ...]
    dark: Floats
    dark_std: Floats
    warnings: tuple[str, ...] = field(default=())


@dataclass(frozen=True, slots=True)
class _Dark:
    level: Floats  # (C, R, S) mean dark signal above the stated black level
    mean_covariance: Floats  # (C, C) of the error of that mean, common to all blocks
    frame_covariance: Floats  # (C, C) of one frame's own offset


def estimate_crosstalk(
    lights: Mapping[str, Sequence[BlockMeans]],
    dark: Sequence[BlockMeans] = (),
    *,
    allow: Sequence[str] = (),
    labels: Mapping[str, Sequence[str]] | None = None,
) -> CrosstalkEstimate:
    """Estimate the crosstalk matrix from block averages of single-light captures.

    Parameters
    ----------
    lights
        Block averages (`block_means`) of the captures of each light, by the light's name; the order of the names is
        the order of the columns of A.
    dark
        Block averages of the captures with all lights off. Without any, the stated black level is the dark level.
    allow
        Names of plausibility checks (`CHECKS`) that the user waives.
    labels
        File names of the captures, for messages; by light, and ``"dark"``.

    Raises
    ------
    CalibrationError
        The captures cannot give a trustworthy matrix: too dark, saturated, of different sizes, of another light than
        named, of a wrong colour filter array, or contradicting each other.
    """
    unknown = sorted(set(allow) - set(CHECKS))
    if unknown:
        raise CalibrationError(f"unknown check {', '.join(unknown)}; those that can be waived are {', '.join(CHECKS)}")
    warnings = check_captures(lights, dark, allow=allow, labels=labels or {})
    offset = _dark_level(dark, next(iter(lights.values()))[0])
    fits = [_fit_light(name, captures, offset) for name, captures in lights.items()]
    matrix = np.column_stack([fit.column for fit, _ in fits])
    covariance = _total_covariance(fits, offset)
    warnings += check_matrix(tuple(fit for fit, _ in fits), allow=allow)
    crosstalk = Crosstalk(matrix=matrix, lights=tuple(lights), covariance=covariance)
    return CrosstalkEstimate(
        crosstalk=crosstalk,
        lights=tuple(fit for fit, _ in fits),
        dark=offset.level.mean(axis=(1, 2)),
        dark_std=np.sqrt(np.diag(offset.mean_covariance)),
        warnings=tuple(warnings),
    )


def _dark_level(dark: Sequence[BlockMeans], like: BlockMeans) -> _Dark:
    if not dark:
        covariance = BLACK_LEVEL_STD**2 * np.eye(3)
        return _Dark(np.zeros_like(like.channels), covariance, np.zeros((3, 3)))
    frames = np.stack([frame.channels for frame in dark])
    known = len(frames) > 1
    drift = np.cov(frames.mean(axis=(2, 3)), rowvar=False) if known else BLACK_LEVEL_STD**2 * np.eye(3)
    return _Dark(frames.mean(axis=0), drift / len(frames), drift)


@dataclass(frozen=True, slots=True)
class _Influence:
    scatter: Floats  # (C, C) covariance of the column from block scatter and drift between captures
    leverage: Floats  # (C, C) change of the column per common offset of each channel
    captures: int


def _fit_light(name: str, captures: Sequence[BlockMeans], dark: _Dark) -> tuple[LightFit, _Influence]:
    signal = np.stack([frame.channels for frame in captures]) - dark.level
    valid = ~np.stack([frame.saturated for frame in captures])
    if valid.sum() < MIN_BLOCKS * len(captures):
        raise CalibrationError(
            f"light {name}: {100 * (1 - valid.mean()):.0f} % of the blocks hold saturated samples; "
            "shorten the exposure until none does"
        )
    reference = int(np.median(signal.transpose(0, 2, 3, 1)[valid], axis=0).argmax())
    weights, column = _robust_ratio(signal, valid, reference)
    scatter = _sandwich(signal, weights, column, reference)
    drift, per_capture = _drift(signal, weights, column, reference)
    mass = (weights * signal[:, reference]).sum()
    leverage = (np.eye(3) - np.outer(column, np.eye(3)[reference])) * weights.sum() / mass
    strength = [float((w * s).sum() / w.sum()) for w, s in zip(weights, signal[:, reference], strict=True)]
    fit = LightFit(
        name=name,
        reference=reference,
        column=column,
        signal=float(mass / weights.sum()),
        used=float((weights > 0).mean()),
        saturated=float(1 - valid.mean()),
        rejected=float((valid & (weights == 0)).mean()),
        intensity_drift=float(np.ptp(strength) / np.mean(strength)),
        colour_drift=per_capture,
        captures=len(captures),
    )
    own_offset = leverage @ dark.frame_covariance @ leverage.T / len(captures)
    return fit, _Influence(scatter + drift + own_offset, leverage, len(captures))


def _robust_ratio(signal: Floats, valid: npt.NDArray[np.bool_], reference: int) -> tuple[Floats, Floats]:
    """Weights (N, R, S) 1 or 0 of the blocks and column (C,): ratio of sums, iterated from the median of the ratios.

    Every channel's residual y - a x is compared with its median spread times the square root of x (shot noise). Weights
    between 0 and 1 would need a correction of the sandwich and would cost efficiency.
    """
    weights = valid.astype(np.float64)
    base = signal[:, reference]
    root = np.sqrt(np.maximum(base, 1e-3 * np.median(base[valid])))
    ratios = signal / np.where(base > 0, base, np.inf)[:, None]
    column = np.median(ratios.transpose(0, 2, 3, 1)[valid], axis=0)
    for _ in range(20):
        scaled = (signal - column[:, None, None] * base[:, None]) / root[:, None]
        spread = np.median(np.abs(scaled.transpose(0, 2, 3, 1)[valid]), axis=0) / 0.6745
        limit = np.where(spread > 0, OUTLIER * spread, np.inf)[:, None, None]
        weights = (valid & (np.abs(scaled) <= limit).all(axis=1)).astype(np.float64)
        update = (weights[:, None] * signal).sum(axis=(0, 2, 3)) / (weights * base).sum()
        done = np.abs(update - column).max() < 1e-10
        column = update
        if done:
            break
    column[reference] = 1.0
    return weights, column


def _sandwich(signal: Floats, weights: Floats, column: Floats, reference: int) -> Floats:
    """Covariance (C, C) of the column from the scatter of the residuals, summed over captures in clusters of blocks."""
    base = signal[:, reference]
    residual = weights[:, None] * (signal - column[:, None, None] * base[:, None])
    sums = _clusters(residual.sum(axis=0))
    count = max(len(sums), 2)
    return np.asarray(sums.T @ sums * count / (count - 1) / (weights * base).sum() ** 2)


def _clusters(residual: Floats) -> Floats:
    """Sums (clusters, C) over 2 x 2 neighbouring blocks: what spills over a block's border stays within a cluster."""
    rows, columns = residual.shape[1:]
    step = 2 if rows * columns >= 64 else 1
    summed = np.add.reduceat(
        np.add.reduceat(residual, np.arange(0, rows, step), axis=1), np.arange(0, columns, step), axis=2
    )
    return np.asarray(summed.reshape(len(residual), -1).T)


def _drift(signal: Floats, weights: Floats, column: Floats, reference: int) -> tuple[Floats, float]:
    """Covariance (C, C) that the scatter between captures adds beyond their noise, and its largest standard deviation.

    Zero unless an F test finds the scatter of the captures' own ratios larger than their noise, which is taken from
    the residuals' departures from the mean over the captures (the target's texture cancels there).
    """
    from scipy.stats import f as fisher

    count, channels = len(signal), len(column)
    none = np.zeros((channels, channels))
    if count < 2:
        return none, 0.0
    base = signal[:, reference]
    mass = (weights * base).sum(axis=(1, 2))
    ratios = (weights[:, None] * signal).sum(axis=(2, 3)) / mass[:, None]
    residual = (signal - ratios[:, :, None, None] * base[:, None]) / mass[:, None, None, None]
    own = (weights[:, None] * (residual - residual.mean(axis=0))).transpose(1, 0, 2, 3).reshape(channels, -1)
    noise = (own**2).sum(axis=1) / (count - 1)
    scatter = ratios.var(axis=0, ddof=1)
    limit = fisher.isf(DRIFT_SIGNIFICANCE / channels, count - 1, max(own.shape[1], 2))
    excess = np.where(scatter > limit * noise, scatter - noise, 0.0)
    excess[reference] = 0.0
    return np.diag(excess) / count, float(np.sqrt(excess.max()))


def _total_covariance(fits: Sequence[tuple[LightFit, _Influence]], dark: _Dark) -> Floats:
    """Covariance (C k, C k) of A row by row: the error of the dark mean is common to all lights."""
    count = len(fits)
    full = np.zeros((3, count, 3, count))
    for i, (_, first) in enumerate(fits):
        for j, (_, second) in enumerate(fits):
            full[:, i, :, j] = first.leverage @ dark.mean_covariance @ second.leverage.T
        full[:, i, :, i] += first.scatter
    return full.reshape(3 * count, 3 * count)
