"""Columns of the crosstalk matrix A from the block averages of single-light captures.

*Block averages.* The samples of different channels of a Bayer mosaic lie at different points of the target, so on a
speckled target their ratio pixel by pixel is meaningless. Averages over a block are comparable, provided that every
plane's average is taken about the same point: the window is a box convolved with [1 2 1] in rows and columns. Its
transfer function has a triple zero at the carriers of the 2x2 cell, hence the four planes see the mean, the slope and
the curvature of the picture alike.

*Ratios of sums.* With x the reference channel's block average, y another channel's and phi the Legendre products over
the field, the entry a(position) = sum_t a_t phi_t solves

    sum over blocks of  w phi (y - x sum_t a_t phi_t) = 0,

an instrumental-variable estimate: the instrument is the position, which carries no noise, so noise in x does not
attenuate a as it does in least squares (Fuller, Measurement Error Models, 1987, section 1.4). The covariance is the
cluster sandwich: the scatter of the score over neighbouring blocks, whatever causes it (noise, the texture's aliasing).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import fdtri

from rgbmidic.errors import CalibrationError
from rgbmidic.frames.data import ChannelFrame, Mosaic, cfa_channels, planes_of
from rgbmidic.typing import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockMeans:
    """Block averages of one frame above the stated black level.

    Attributes
    ----------
    planes : ndarray, shape (P, R, S), float64
        Mean grey level (DN above black) of each colour plane in each of R x S blocks.
    saturated : ndarray, shape (R, S), bool
        True where any sample of any plane is saturated.
    camera : Sampling
        How the frame was sampled.
    block : int
        Side of a block in px.
    detail : float
        Mean square second difference over the square of the mean, in the brightest plane: how sharp the picture is.
    piled_at : float or None
        Grey level (DN) below the white level at which samples pile up as they do at saturation; None: nowhere.
    """

    planes: FloatArray
    saturated: BoolArray
    camera: Sampling
    block: int
    detail: float
    piled_at: float | None = None

    @property
    def channels(self) -> FloatArray:
        """Block averages of the channels R, G, B, shape (3, R, S): the two greens of a mosaic averaged."""
        if len(self.planes) == 3:
            return self.planes
        return np.stack([self.planes[0], 0.5 * (self.planes[1] + self.planes[2]), self.planes[3]])


@dataclass(frozen=True, slots=True)
class Sampling:
    """How a camera samples its frames.

    Attributes
    ----------
    names : tuple of str, length P
        Colour planes: R, G1, G2, B of a mosaic (G1 is the first green met row by row); R, G, B; or M.
    shape : tuple of int
        Rows and columns of the frames.
    black : tuple of float, length P
        Stated black levels (DN).
    white : float
        White level (DN).
    origins : tuple of (int, int), length P
        Row and column of each plane's first sample.
    step : int
        Distance of a plane's samples in the frame, px: 2 for a mosaic.
    """

    names: tuple[str, ...]
    shape: tuple[int, int]
    black: tuple[float, ...]
    white: float
    origins: tuple[tuple[int, int], ...]
    step: int

    @classmethod
    def of(cls, frame: Mosaic | ChannelFrame) -> Sampling:
        """How the camera of a frame samples."""
        names, _, black = planes_of(frame)
        origins, step = ((0, 0),) * len(names), 1
        if isinstance(frame, Mosaic):
            order = np.argsort(cfa_channels(frame.cfa).ravel(), kind="stable")
            origins, step = tuple((int(position) // 2, int(position) % 2) for position in order), 2
        shape = frame.values.shape[-2], frame.values.shape[-1]
        return cls(names, shape, tuple(black.tolist()), frame.white_level, origins, step)

    @property
    def full_scale(self) -> float:
        """Grey level of a just saturated sample (DN above black)."""
        return self.white - float(np.mean(self.black))

    def matches(self, other: Sampling) -> bool:
        """The frames have the same size, planes and range; each may state its own black level."""
        mine, its = ((one.shape, one.names, one.full_scale) for one in (self, other))
        return mine == its

    def __str__(self) -> str:
        planes = f"{self.shape[1]} x {self.shape[0]} px with planes {' '.join(self.names)}"
        return f"{planes} and a range of {self.full_scale:g} DN from black to white level {self.white:g}"


def block_means(frame: Mosaic | ChannelFrame, *, block: int = 16) -> BlockMeans:
    """Average every colour plane of a frame in blocks.

    Parameters
    ----------
    frame
        Raw frame, Bayer or 3-CCD.
    block
        Side of a block in px; even.

    Raises
    ------
    CalibrationError
        The frame is monochrome, or too small for 3 x 3 blocks.
    """
    _, planes, black = planes_of(frame)
    camera = Sampling.of(frame)
    shape, step = camera.shape, camera.step
    if camera.names == ("M",):
        raise CalibrationError("a monochrome frame has no colour channels: there is no crosstalk to calibrate")
    if block < 2 or block % 2:
        raise CalibrationError(f"a block has an even number of pixels, at least 2, not {block}")
    if min(shape) < 3 * block + 4:
        raise CalibrationError(
            f"frames of {shape[1]} x {shape[0]} px are too small for calibration in blocks of {block} px "
            f"(at least {3 * block + 4} px on each side)"
        )
    means = np.stack(
        [
            _window(shape[0], len(plane), block, step, row)
            @ plane
            @ _window(shape[1], len(plane.T), block, step, col).T
            - dark
            for plane, dark, (row, col) in zip(planes, black, camera.origins, strict=True)
        ]
    )
    brightest = int(means.mean(axis=(1, 2)).argmax())
    picture = planes[brightest].astype(np.float32)
    level = max(float(picture.mean()) - float(black[brightest]), 1.0)
    clipped = np.atleast_3d(frame.white_level <= frame.values.T).any(axis=2).T.astype(np.float32)
    # the window is positive on the block and its rim of one pixel, 0 elsewhere
    over_rows, over_columns = (_window(side, side, block, 1, 0) for side in shape)
    saturated = over_rows @ clipped @ over_columns.T > 0
    return BlockMeans(
        planes=means,
        saturated=saturated,
        camera=camera,
        block=block,
        detail=float(((picture[:, 2:] - 2 * picture[:, 1:-1] + picture[:, :-2]) ** 2).mean()) / level**2,
        piled_at=saturation_pile(planes[brightest], frame.white_level),
    )


def block_centres(shape: tuple[int, int], block: int) -> FloatArray:
    """Centres (x, y) in px of the blocks of a frame, shape (R, S, 2)."""
    rows, columns = (_starts(side, block) + (block - 1) / 2 for side in shape)
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def _starts(side: int, block: int) -> npt.NDArray[np.intp]:
    # Two pixels at each border stay unused: the window reaches one pixel beyond its block.
    return np.arange(2, side - side % 2 - block - 1, block)


def _window(side: int, length: int, block: int, step: int, offset: int) -> FloatArray:
    """Weights (blocks, samples) that average the samples at offset + step * n with the window of the module."""
    position = offset + step * np.arange(length)
    distance = position[None, :] - _starts(side, block)[:, None]
    edges = np.array([-2, -1, 0, 1, block - 2, block - 1, block, block + 1])
    weights = np.interp(distance, edges, [0, 1, 3, 4, 4, 3, 1, 0], left=0.0, right=0.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), dtype=np.float64)


def saturation_pile(plane: npt.NDArray[np.uint16], white: float) -> float | None:
    """Largest value of a plane where it occurs far more often than the values just below it."""
    top = int(plane.max())
    if top >= white or top < 8:
        return None
    count, below = int((plane == top).sum()), int(((plane < top) & (plane >= top - 4)).sum())
    return float(top) if count > 20 and count > 2 * below else None


@dataclass(frozen=True, slots=True)
class LightSignal:
    """Block averages of the captures of one light.

    Attributes
    ----------
    name : str
    values : ndarray, shape (N, C, R, S)
        Above dark, of N captures.
    valid : ndarray, shape (N, R, S), bool
        Blocks without saturated samples.
    reference : int
        Channel that sees the light best: the others are compared with it.
    """

    name: str
    values: FloatArray
    valid: BoolArray
    reference: int

    @property
    def base(self) -> FloatArray:
        """Block averages (N, R, S) of the reference channel."""
        return self.values[:, self.reference]

    @property
    def others(self) -> list[int]:
        """The channels but the reference."""
        return [c for c in range(self.values.shape[1]) if c != self.reference]

    def residual(self, design: FloatArray, coefficients: FloatArray) -> FloatArray:
        """Residuals y - a x, (N, C, R, S)."""
        return np.asarray(self.values - np.einsum("rst,tc->crs", design, coefficients) * self.base[:, None])


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnFit:
    """A column of A as a polynomial over the field.

    Attributes
    ----------
    coefficients : ndarray, shape (T, C)
        Per Legendre product and channel; (1, 0, 0 ...) in the reference channel.
    covariance : ndarray, shape (T, C, T, C)
        From the scatter of the blocks.
    leverage : ndarray, shape (T, C, C)
        Change of the coefficients per grey level that all blocks of a channel (last axis) have too much.
    weights : ndarray, shape (N, R, S)
        1 for the blocks used, 0 for the others.
    residual : ndarray, shape (N, C, R, S)
        y - a x of the blocks used, 0 elsewhere.
    mass : ndarray, shape (N,)
        Sum of the reference channel over the blocks used, per capture.
    """

    coefficients: FloatArray
    covariance: FloatArray
    leverage: FloatArray
    weights: FloatArray
    residual: FloatArray
    mass: FloatArray


def fit_column(signal: LightSignal, design: FloatArray) -> ColumnFit:
    """Fit one light's column of A by ratios of sums (equation of the module), without outliers.

    Parameters
    ----------
    signal
        Captures of the light.
    design : ndarray, shape (R, S, T)
        Legendre products at the blocks' centres; T = 1 for a constant column.
    """
    weights, coefficients = _without_outliers(signal, design)
    residual = weights[:, None] * signal.residual(design, coefficients)
    inverse = np.linalg.inv(_moment(weights * signal.base, design))
    sums = _cluster_sums(np.einsum("ncrs,rst->tcrs", residual, design))
    count = max(len(sums), 2)
    terms, channels = coefficients.shape
    spread = (sums.T @ sums * count / (count - 1)).reshape(terms, channels, terms, channels)
    total = np.einsum("nrs,rst->t", weights, design)
    lever = np.einsum("tu,u,cd->tcd", inverse, total, np.eye(channels))
    lever[:, :, signal.reference] -= inverse @ _moment(weights, design) @ coefficients
    return ColumnFit(
        coefficients=coefficients,
        covariance=np.einsum("tu,ucvd,wv->tcwd", inverse, spread, inverse),
        leverage=lever,
        weights=weights,
        residual=residual,
        mass=(weights * signal.base).sum(axis=(1, 2)),
    )


def _moment(weights: FloatArray, design: FloatArray) -> FloatArray:
    flat = design.reshape(-1, design.shape[-1])
    return np.asarray((flat * weights.sum(axis=0).reshape(-1, 1)).T @ flat)


def _without_outliers(signal: LightSignal, design: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights and coefficients, iterated from the median of the blocks' ratios.

    Every channel's residual is compared with its median spread times the square root of x (shot noise). Beyond 5 robust
    standard deviations a block is left out: a fluorescent spot, a label, a hot cluster. Of normal noise 6e-7 are
    beyond, less than one block of a calibration. Weights between 0 and 1 would need a correction of the sandwich and
    would cost efficiency.
    """
    base, valid = signal.base, signal.valid
    root = np.sqrt(np.maximum(base, 1e-3 * np.median(base[valid])))
    ratios = signal.values / np.where(base > 0, base, np.inf)[:, None]
    coefficients = np.zeros((design.shape[-1], signal.values.shape[1]))
    coefficients[0] = np.median(ratios.transpose(0, 2, 3, 1)[valid], axis=0)
    weights = valid.astype(np.float64)
    for _ in range(20):
        scaled = signal.residual(design, coefficients) / root[:, None]
        spread = np.median(np.abs(scaled.transpose(0, 2, 3, 1)[valid]), axis=0) / 0.6745
        limit = np.where(spread > 0, 5.0 * spread, np.inf)[:, None, None]
        weights = (valid & (np.abs(scaled) <= limit).all(axis=1)).astype(np.float64)
        right = np.einsum("crs,rst->tc", (weights[:, None] * signal.values).sum(axis=0), design)
        before, coefficients = coefficients, np.linalg.solve(_moment(weights * base, design), right)
        if np.abs(coefficients - before).max() < 1e-10:
            break
    coefficients[:, signal.reference] = np.eye(len(coefficients))[0]
    return weights, coefficients


def _cluster_sums(values: FloatArray) -> FloatArray:
    """Sums (clusters, Q) of (..., R, S) over 2 x 2 blocks: what spills over a block's border stays within a cluster."""
    values = values.reshape(-1, *values.shape[-2:])
    rows, columns = values.shape[1:]
    step = 2 if rows * columns >= 64 else 1
    by_rows = np.add.reduceat(values, np.arange(0, rows, step), axis=1)
    return np.asarray(np.add.reduceat(by_rows, np.arange(0, columns, step), axis=2).reshape(len(values), -1).T)


@dataclass(frozen=True, slots=True, kw_only=True)
class Variation:
    """Result of `variation`: whether a column varies over the field by certain terms.

    Attributes
    ----------
    p_value : float
        Probability of scores this large without that variation.
    rms : float
        Root mean square over the field of these terms as fitted, of the channel where it is largest.
    """

    p_value: float
    rms: float


def variation(signal: LightSignal, design: FloatArray, known: int) -> Variation:
    """Test whether the Legendre products after the first `known` ones are needed in any channel.

    A score test with random signs: the model of the first terms is fitted, its residuals are correlated with the other
    terms in clusters of blocks, and the sum is compared with those of 4999 random choices of the clusters' signs. It
    keeps its level with few clusters and with heavy tails, which a Wald test with a sandwich covariance does not
    (Cameron, Gelbach & Miller, Review of Economics and Statistics 90, 414, 2008).

    Parameters
    ----------
    signal, design
        See `fit_column`; `design` has all terms.
    known
        How many of the terms the null hypothesis has.
    """
    null = fit_column(signal, design[..., :known])
    moment = _moment(null.weights * signal.base, design)
    # What the fitted terms cannot imitate of the others.
    extra = design[..., known:] - design[..., :known] @ np.linalg.solve(moment[:known, :known], moment[:known, known:])
    sums = _cluster_sums(np.einsum("crs,rst->ctrs", null.residual[:, signal.others].sum(axis=0), extra))
    inverse = np.linalg.pinv(sums.T @ sums)
    flips = np.random.default_rng(0).choice((-1.0, 1.0), (4999, len(sums))) @ sums
    flipped = ((flips @ inverse) * flips).sum(axis=1)
    observed = sums.sum(axis=0) @ inverse @ sums.sum(axis=0)
    coefficients = fit_column(signal, design).coefficients[known:, signal.others]
    norms = (design[..., known:] ** 2).mean(axis=(0, 1))
    return Variation(
        p_value=float((1 + (flipped >= observed).sum()) / (1 + len(flipped))),
        rms=float(np.sqrt((coefficients**2 * norms[:, None]).sum(axis=0)).max()),
    )


def capture_scatter(fit: ColumnFit, significance: float = 0.01) -> FloatArray:
    """Variance (C,) of the entries between captures beyond their noise; zero where an F test finds none.

    The noise comes from the residuals' departures from the mean over the captures, where the target's texture cancels.
    At the default level one calibration in a hundred gets a needless addition to its covariance.
    """
    count, channels = fit.residual.shape[:2]
    if count < 2:
        return np.zeros(channels)
    relative = fit.residual / fit.mass[:, None, None, None]
    departures = (relative - relative.mean(axis=0)).transpose(1, 0, 2, 3).reshape(channels, -1)
    noise = (departures**2).sum(axis=1) / (count - 1)
    scatter = relative.sum(axis=(2, 3)).var(axis=0, ddof=1)
    limit = fdtri(count - 1, departures.shape[1], 1 - significance / channels)
    return np.where(scatter > limit * noise, scatter - noise, 0.0)


def offsets_left(signal: LightSignal, weights: FloatArray, design: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Grey level (C,) that every channel keeps where the light is absent, and its standard uncertainty.

    ``y = x a + o`` with the other captures' x as instrument for the slope: their noise is independent. NaN for fewer
    than two captures. The offset of a dark level that is right is zero; on a plain target it is poorly determined.
    """
    count, channels = signal.values.shape[:2]
    offset, std = np.full((2, channels), np.nan)
    if count < 2:
        return offset, std
    base = signal.base
    others = (base.sum(axis=0) - base) / (count - 1)
    instruments = [np.broadcast_to(design, (count, *design.shape)), others[..., None]]
    left = weights[..., None] * np.concatenate(instruments, axis=-1)
    right = np.concatenate([base[..., None] * design, np.ones((*base.shape, 1))], axis=-1)
    inverse = np.linalg.inv(np.einsum("nrsi,nrsj->ij", left, right))
    for channel in signal.others:
        solution = inverse @ np.einsum("nrsi,nrs->i", left, signal.values[:, channel])
        score = (left * (signal.values[:, channel] - right @ solution)[..., None]).sum(axis=0)
        sums = _cluster_sums(score.transpose(2, 0, 1)) @ inverse.T
        offset[channel], std[channel] = solution[-1], np.sqrt((sums[:, -1] ** 2).sum())
    return offset, std
