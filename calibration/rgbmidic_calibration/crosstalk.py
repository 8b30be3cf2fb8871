"""The crosstalk matrix A from captures with one light on at a time: camera channels = A . lights.

For each light the channel that sees it best is the reference; the entries of the other channels are ratios to it,
estimated from block averages (`rgbmidic_calibration.captures.block_means`). The covariance of A adds to the scatter of
the blocks the error of the dark level, which is common to all blocks and all lights, and the scatter of the captures
beyond their noise. The fitted columns are then checked against the names of the lights and against each other. The
difference of a mosaic's two greens is fitted as a fourth channel.

*Ratios of sums.* With x the reference channel's block average, y another channel's and phi the Legendre products over
the field, the entry a(position) = sum_t a_t phi_t solves

    sum over blocks of  w phi (y - x sum_t a_t phi_t) = 0,

an instrumental-variable estimate: the instrument is the position, which carries no noise, so noise in x does not
attenuate a as it does in least squares (Fuller, Measurement Error Models, 1987, section 1.4). The covariance is the
cluster sandwich: the scatter of the score over neighbouring blocks, whatever causes it (noise, the texture's aliasing).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from rgbmidic.errors import CalibrationError
from rgbmidic.illumination.checks import Check, warning
from rgbmidic.illumination.crosstalk import Crosstalk, CrosstalkField, legendre_products
from rgbmidic.typing import BoolArray, FloatArray
from rgbmidic_calibration.captures import BlockMeans
from rgbmidic_calibration.plausibility import CHECKS, capture_checks, collect_warnings

CHANNELS = ("R", "G", "B")
COLOURS = ("red", "green", "blue")


@dataclass(frozen=True, slots=True, kw_only=True)
class CrosstalkConstants:
    """Constants of `estimate_crosstalk`.

    Attributes
    ----------
    black_level_std
        Standard uncertainty (DN) of a black level that no series of dark frames measured: rounded to whole grey levels.
    automatic_order
        Largest degree that the data may ask for: shading by lens and filters is a slope and a curvature.
    largest_order
        Largest degree that may be stated: 15 coefficients per entry. Chosen; higher ones only follow the noise of
        blocks.
    significance
        Significance level of the test for variation over the field. With 4999 random signs p is at least 2e-4.
    tolerance
        Variation of an entry over the field (rms), or between captures, that is accepted, however significant: it leaks
        0.05 % at most.
    checkerboard
        Checkerboard in a separated light, as a fraction of the light's level, about which nothing is reported: a third
        of what `check` allows (`verify.Limits.checkerboard`).
    """

    black_level_std: float = 0.3
    automatic_order: int = 2
    largest_order: int = 4
    significance: float = 1e-3
    tolerance: float = 5e-4
    checkerboard: float = 1e-3


LIMITS = CrosstalkConstants()


GREENS = 3
"""Channel of the difference of the greens (`BlockMeans.signals`)."""


@dataclass(frozen=True, slots=True)
class LightSignal:
    """Block averages of the captures of one light.

    Attributes
    ----------
    name : str
    values : ndarray, shape (N, C, R, S)
        Above dark, of N captures: R, G, B and, of a mosaic, the difference of the greens (`BlockMeans.signals`).
    valid : ndarray, shape (N, R, S), bool
        Blocks without saturated samples.
    reference : int
        Channel that sees the light best: the others are compared with it.
    """

    name: str
    values: FloatArray
    valid: BoolArray
    reference: int

    @classmethod
    def of(cls, name: str, captures: Sequence[BlockMeans], dark: FloatArray) -> LightSignal:
        """Return the averages of captures above the dark level."""
        values = np.stack([frame.signals for frame in captures]) - dark
        valid = ~np.stack([frame.saturated for frame in captures])
        return cls(name, values, valid, int(np.median(values[:, :3].transpose(0, 2, 3, 1)[valid], axis=0).argmax()))

    @property
    def base(self) -> FloatArray:
        """Block averages (N, R, S) of the reference channel."""
        return self.values[:, self.reference]

    @property
    def other_channels(self) -> list[int]:
        """The channels R, G, B but the reference."""
        return [c for c in range(3) if c != self.reference]

    def residual(self, design: FloatArray, coefficients: FloatArray) -> FloatArray:
        """Return the residuals y - a x, (N, C, R, S)."""
        return np.asarray(self.values - np.einsum("rst,tc->crs", design, coefficients) * self.base[:, None])


@dataclass(frozen=True, slots=True, kw_only=True)
class LightFit:
    """A light's column of A as a polynomial over the field.

    Attributes
    ----------
    signal : LightSignal
        What it was fitted to.
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
    """

    signal: LightSignal
    coefficients: FloatArray
    covariance: FloatArray
    leverage: FloatArray
    weights: FloatArray
    residual: FloatArray

    @property
    def mass(self) -> FloatArray:
        """Sum (N,) of the reference channel over the blocks used, per capture."""
        return np.asarray((self.weights * self.signal.base).sum(axis=(1, 2)))

    @property
    def level(self) -> float:
        """Mean grey level (DN above dark) of the reference channel in the blocks used."""
        return float(self.mass.sum() / self.weights.sum(axis=(1, 2)).sum())

    @property
    def rejected_fraction(self) -> float:
        """Fraction of the blocks that were left out as outliers."""
        return float((self.signal.valid & (self.weights == 0)).mean())

    @property
    def intensity_drift(self) -> float:
        """Range of the light's strength over the captures, relative to its mean."""
        strength = self.mass / np.maximum(self.weights.sum(axis=(1, 2)), 1)
        return float(np.ptp(strength) / strength.mean())


def fit_column(signal: LightSignal, design: FloatArray) -> LightFit:
    """Fit one light's column of A by ratios of sums (equation of the module), without outliers.

    Parameters
    ----------
    signal
        Captures of the light.
    design : ndarray, shape (R, S, T)
        Legendre products at the blocks' centres; T = 1 for a constant column.
    """
    weights, coefficients = _fit_without_outliers(signal, design)
    residual = weights[:, None] * signal.residual(design, coefficients)
    inverse = np.linalg.inv(_moment(weights * signal.base, design))
    sums = _cluster_sums(np.einsum("ncrs,rst->tcrs", residual, design))
    count = max(len(sums), 2)
    terms, channels = coefficients.shape
    spread = (sums.T @ sums * count / (count - 1)).reshape(terms, channels, terms, channels)
    total = np.einsum("nrs,rst->t", weights, design)
    lever = np.einsum("tu,u,cd->tcd", inverse, total, np.eye(channels))
    lever[:, :, signal.reference] -= inverse @ _moment(weights, design) @ coefficients
    return LightFit(
        signal=signal,
        coefficients=coefficients,
        covariance=np.einsum("tu,ucvd,wv->tcwd", inverse, spread, inverse),
        leverage=lever,
        weights=weights,
        residual=residual,
    )


def _moment(weights: FloatArray, design: FloatArray) -> FloatArray:
    flat = design.reshape(-1, design.shape[-1])
    return np.asarray((flat * weights.sum(axis=0).reshape(-1, 1)).T @ flat)


def _fit_without_outliers(signal: LightSignal, design: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the weights and coefficients, iterated from the median of the blocks' ratios.

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
        previous, coefficients = coefficients, np.linalg.solve(_moment(weights * base, design), right)
        if np.abs(coefficients - previous).max() < 1e-10:
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


def variation(
    signal: LightSignal, design: FloatArray, n_null_terms: int, channels: Sequence[int] | None = None
) -> Variation:
    """Test whether the Legendre products after the first `n_null_terms` ones are needed in any channel.

    A score test with random signs: the model of the first terms is fitted, its residuals are correlated with the other
    terms in clusters of blocks, and the sum is compared with those of 4999 random choices of the clusters' signs. It
    keeps its level with few clusters and with heavy tails, which a Wald test with a sandwich covariance does not
    (Cameron, Gelbach & Miller, Review of Economics and Statistics 90, 414, 2008).

    Parameters
    ----------
    signal, design
        See `fit_column`; `design` has all terms.
    n_null_terms
        How many of the terms the null hypothesis has.
    channels
        Channels that are tested together; None: R, G, B but the reference.
    """
    channels = signal.other_channels if channels is None else channels
    null = fit_column(signal, design[..., :n_null_terms])
    moment = _moment(null.weights * signal.base, design)
    # What the fitted terms cannot imitate of the others.
    extra = design[..., n_null_terms:] - design[..., :n_null_terms] @ np.linalg.solve(
        moment[:n_null_terms, :n_null_terms], moment[:n_null_terms, n_null_terms:]
    )
    sums = _cluster_sums(np.einsum("crs,rst->ctrs", null.residual[:, channels].sum(axis=0), extra))
    inverse = np.linalg.pinv(sums.T @ sums)
    flips = np.random.default_rng(0).choice((-1.0, 1.0), (4999, len(sums))) @ sums
    flipped = ((flips @ inverse) * flips).sum(axis=1)
    observed = sums.sum(axis=0) @ inverse @ sums.sum(axis=0)
    coefficients = fit_column(signal, design).coefficients[n_null_terms:, channels]
    norms = (design[..., n_null_terms:] ** 2).mean(axis=(0, 1))
    return Variation(
        p_value=float((1 + (flipped >= observed).sum()) / (1 + len(flipped))),
        rms=float(np.sqrt((coefficients**2 * norms[:, None]).sum(axis=0)).max()),
    )


def capture_scatter(fit: LightFit, significance: float = 0.01) -> FloatArray:
    """Return the variance (C,) of the entries between captures beyond their noise; zero where an F test finds none.

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


def residual_offsets(fit: LightFit, design: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the grey level (C,) that every channel keeps where the light is absent, and its standard uncertainty.

    ``y = x a + o`` with the other captures' x as instrument for the slope: their noise is independent. NaN for fewer
    than two captures. The offset of a dark level that is right is zero; on a plain target it is poorly determined.
    """
    signal = fit.signal
    count, channels = signal.values.shape[:2]
    offset, std = np.full((2, channels), np.nan)
    if count < 2:
        return offset, std
    base = signal.base
    other_means = (base.sum(axis=0) - base) / (count - 1)
    instruments = [np.broadcast_to(design, (count, *design.shape)), other_means[..., None]]
    instrument_matrix = fit.weights[..., None] * np.concatenate(instruments, axis=-1)
    regressors = np.concatenate([base[..., None] * design, np.ones((*base.shape, 1))], axis=-1)
    inverse = np.linalg.inv(np.einsum("nrsi,nrsj->ij", instrument_matrix, regressors))
    for channel in signal.other_channels:
        solution = inverse @ np.einsum("nrsi,nrs->i", instrument_matrix, signal.values[:, channel])
        score = (instrument_matrix * (signal.values[:, channel] - regressors @ solution)[..., None]).sum(axis=0)
        sums = _cluster_sums(score.transpose(2, 0, 1)) @ inverse.T
        offset[channel], std[channel] = solution[-1], np.sqrt((sums[:, -1] ** 2).sum())
    return offset, std


@dataclass(frozen=True, slots=True, kw_only=True)
class CrosstalkEstimate:
    """Result of `estimate_crosstalk`.

    Attributes
    ----------
    crosstalk : Crosstalk
        The matrix.
    lights : tuple of LightFit
        The fit of every light.
    variations : tuple of Variation
        The test of every light whether its column varies over the field.
    warnings : tuple of str
        What the user should know.
    """

    crosstalk: Crosstalk
    lights: tuple[LightFit, ...]
    variations: tuple[Variation, ...]
    warnings: tuple[str, ...]


def estimate_crosstalk(
    lights: Mapping[str, Sequence[BlockMeans]],
    dark: Sequence[BlockMeans] = (),
    *,
    order: int | None = None,
    allow: Sequence[str] = (),
) -> CrosstalkEstimate:
    """Estimate the crosstalk matrix from block averages of single-light captures.

    Parameters
    ----------
    lights
        Block averages (`block_means`) of the captures of each light, by the light's name; the order of the names is
        the order of the columns of A.
    dark
        Block averages of the captures with all lights off. Without any, the stated black level is the dark level.
    order
        Degree of the polynomial by which A varies over the field; None: the lowest up to 2 that the data ask for, 0
        unless the variation is both significant and larger than the tolerance.
    allow
        Names of plausibility checks (`CHECKS`) that the user waives.

    Raises
    ------
    CalibrationError
        The captures cannot give a trustworthy matrix: too dark, saturated, of different sizes, of another light than
        named, of a wrong colour filter array, or contradicting each other.
    """
    if unknown := sorted(set(allow) - set(CHECKS)):
        raise CalibrationError(f"unknown check {', '.join(unknown)}; those that can be waived are {', '.join(CHECKS)}")
    if order is not None and not 0 <= order <= LIMITS.largest_order:
        raise CalibrationError(f"the degree of the field is 0 to {LIMITS.largest_order}, not {order}")
    warnings = collect_warnings(capture_checks(lights, dark), allow)
    first_means = next(iter(lights.values()))[0]
    shape, centres = first_means.camera.shape, first_means.centres
    count = len(first_means.signals)
    level, frame_covariance = np.zeros((count, *first_means.saturated.shape)), np.zeros((count, count))
    mean_covariance = LIMITS.black_level_std**2 * np.eye(count)
    if dark:
        frames = np.stack([frame.signals for frame in dark])
        level = frames.mean(axis=0)
        frame_covariance = np.cov(frames.mean(axis=(2, 3)), rowvar=False) if len(frames) > 1 else mean_covariance
        mean_covariance = frame_covariance / len(frames)
    signals = [LightSignal.of(name, captures, level) for name, captures in lights.items()]
    full_design = legendre_products(centres, shape, LIMITS.automatic_order)
    degrees, variations = zip(*(_needed_degree(signal, full_design) for signal in signals), strict=True)
    order = max(degrees) if order is None else order
    design = legendre_products(centres, shape, order)
    fits = tuple(fit_column(signal, design) for signal in signals)
    warnings += collect_warnings(matrix_checks(fits, design), allow)
    matrices = np.stack([fit.coefficients for fit in fits], axis=-1)
    covariance = _covariance(fits, mean_covariance, frame_covariance)
    std = np.sqrt(np.einsum("tcktck->tck", covariance))
    field, size = None, matrices[0, :3].size
    if order:
        field = CrosstalkField(order=order, coefficients=matrices[1:, :3], shape=shape, std=std[1:, :3])
    greens = {"green_difference": matrices[0, GREENS], "green_difference_std": std[0, GREENS]} if count > 3 else {}
    crosstalk = Crosstalk(
        matrix=matrices[0, :3],
        lights=tuple(lights),
        covariance=covariance[0, :3, :, 0, :3].reshape(size, size),
        field=field,
        light_levels=np.array([signal.base[signal.valid].mean() for signal in signals]),
        **greens,
    )
    if count > 3:
        warnings += collect_warnings(_green_checks(signals, full_design, crosstalk))
    return CrosstalkEstimate(crosstalk=crosstalk, lights=fits, variations=variations, warnings=tuple(warnings))


def _green_checks(signals: Sequence[LightSignal], design: FloatArray, crosstalk: Crosstalk) -> Iterator[Check]:
    """Check that the mean of the greens' difference over the field is enough."""
    tests = [variation(signal, design, 1, [GREENS]) for signal in signals]
    amplitudes = np.abs(crosstalk.checkerboard(np.array([test.rms for test in tests]))).max(axis=0)
    for signal, test, amplitude in zip(signals, tests, amplitudes, strict=True):
        text = (
            f"light {signal.name}: the difference of the greens varies over the field; its mean, which is used, leaves "
            f"a checkerboard of {100 * amplitude:.2g} % rms of the light's level"
        )
        yield warning(text, amplitude if test.p_value < LIMITS.significance else 0.0, above=LIMITS.checkerboard)


def _needed_degree(signal: LightSignal, design: FloatArray) -> tuple[int, Variation]:
    """Return the degree that the light's captures ask for, and the test of all terms that are not constant."""
    tests: list[Variation] = []
    for order in range(LIMITS.automatic_order):
        tests.append(variation(signal, design, (order + 1) * (order + 2) // 2))
        if tests[-1].p_value >= LIMITS.significance or tests[-1].rms <= LIMITS.tolerance:
            return order, tests[0]
    return LIMITS.automatic_order, tests[0]


def _covariance(columns: Sequence[LightFit], mean_covariance: FloatArray, frame_covariance: FloatArray) -> FloatArray:
    """Return the covariance (T, C, k, T, C, k) of all coefficients.

    The error of the dark frames' mean (covariance `mean_covariance`) is common to all blocks and lights, that of one
    frame's own offset (`frame_covariance`) to the blocks of a frame.
    """
    terms, channels = columns[0].coefficients.shape
    full = np.zeros((terms, channels, len(columns), terms, channels, len(columns)))
    for i, first in enumerate(columns):
        for j, second in enumerate(columns):
            common = mean_covariance + (frame_covariance / len(first.mass) if i == j else 0)
            full[:, :, i, :, :, j] = np.einsum("tcx,xy,udy->tcud", first.leverage, common, second.leverage)
        full[:, :, i, :, :, i] += first.covariance
        full[0, :, i, 0, :, i] += np.diag(capture_scatter(first) / len(first.mass))
    return full


def matrix_checks(fits: Sequence[LightFit], design: FloatArray) -> Iterator[Check]:
    """Check the fitted columns: the right channel for each light's name, one light per channel, quiet lamps.

    The condition number of three LEDs on nine measured cameras is 1.6 to 2.5 (calibration/README.md).
    """
    signals = [fit.signal for fit in fits]
    lower = [signal.name.lower() for signal in signals]
    if all(name in (*COLOURS, "r", "g", "b") for name in lower):  # single letters count where all names are colours
        lower = [COLOURS["rgb".index(name[0])] for name in lower]
    for signal, name in zip(signals, lower, strict=True):
        if name in COLOURS and name != COLOURS[signal.reference]:
            text = (
                f"light {signal.name} is seen best by the {COLOURS[signal.reference]} channel: are the captures of two "
                "lights swapped, or is the colour filter array (`cfa`) another one?"
            )
            yield Check("name", text)
    for index, signal in enumerate(signals):
        for twin in [earlier for earlier in signals[:index] if earlier.reference == signal.reference][:1]:
            text = (
                f"lights {twin.name} and {signal.name} are both seen best by the {COLOURS[signal.reference]} channel: "
                "did the same lamp shine in both captures?"
            )
            yield Check("same-channel", text)
    for fit in fits:
        yield from _fit_checks(fit, design)
    condition = float(np.linalg.cond(np.column_stack([fit.coefficients[0, :3] for fit in fits])))
    text = (
        f"the matrix has condition number {condition:.1f}: unmixing amplifies noise strongly. Are two lamps close in "
        "colour, or did a second lamp or daylight shine in the captures of one?"
    )
    yield warning(text, condition, above=6.0)
    unseen = [colour for c, colour in enumerate(COLOURS) if c not in {signal.reference for signal in signals}]
    text = (
        f"no light is seen best by the {' and '.join(unseen)} channel: if such a lamp shines during the test it must "
        "be calibrated too"
    )
    yield warning(text, len(unseen) if len(fits) < 3 else 0)


def _fit_checks(fit: LightFit, design: FloatArray) -> Iterator[Check]:
    light = f"light {fit.signal.name}: "
    drift, scatter = fit.intensity_drift, float(np.sqrt(capture_scatter(fit).max()))
    text = (
        f"its strength differs by {100 * drift:.1f} % between captures: let the lamp warm up (the matrix does not "
        "suffer)"
    )
    # captures that differ by 30 % are an exposure series, which is meant
    yield warning(light + text, drift if drift < 0.30 else 0.0, above=0.05)
    text = (
        f"its colour drifts between captures (entries scatter by {scatter:.2g} beyond noise); the stated uncertainty "
        "covers it"
    )
    yield warning(light + text, scatter, above=LIMITS.tolerance)
    # .2 % of the signal leaks as much, of the order of what `check` allows (`verify.Limits.leakage`)
    offset, std = residual_offsets(fit, design)
    significant = np.where((np.abs(offset) > 5 * std) & (np.abs(offset) > 0.002 * fit.level), np.abs(offset), 0)
    channel = int(significant.argmax())
    text = (
        f"the {COLOURS[channel]} channel keeps {offset[channel]:+.1f} DN where the light is absent: dark frames of "
        "other settings or another ambient light, or a camera that is not linear"
    )
    yield warning(light + text, significant[channel])
    # of normal noise less than 1e-5 of the blocks are outliers
    text = (
        f"{100 * fit.rejected_fraction:.0f} % of the blocks are outliers: coloured or fluorescent spots on the target?"
    )
    yield warning(light + text, fit.rejected_fraction, above=0.05)
