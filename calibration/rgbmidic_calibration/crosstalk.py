"""The crosstalk matrix A from captures with one light on at a time: camera channels = A . lights.

For each light the channel that sees it best is the reference; the entries of the other channels are ratios to it,
estimated from block averages (`rgbmidic_calibration.ratio`). The covariance of A adds to the scatter of the blocks the
error of the dark level, which is common to all blocks and all lights, and the scatter of the captures beyond their
noise. The fitted columns are then checked against the names of the lights and against each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rgbmidic.errors import CalibrationError
from rgbmidic.illumination.checks import Check, warning
from rgbmidic.illumination.crosstalk import Crosstalk, CrosstalkField, legendre_products
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.plausibility import CHECKS, capture_checks, judged
from rgbmidic_calibration.ratio import (
    BlockMeans,
    ColumnFit,
    LightSignal,
    Variation,
    block_centres,
    capture_scatter,
    fit_column,
    offsets_left,
    variation,
)

CHANNELS = ("R", "G", "B")
COLOURS = ("red", "green", "blue")


@dataclass(frozen=True, slots=True, kw_only=True)
class CrosstalkConstants:
    """Constants of `estimate_crosstalk`.

    Attributes
    ----------
    black_level_std
        Standard uncertainty (DN) of a black level that no series of dark frames measured: rounded to whole grey levels.
    least_blocks
        Unsaturated blocks per capture at least: as many as the smallest frame has, 3 x 3 (`block_means`).
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
    """

    black_level_std: float = 0.3
    least_blocks: int = 9
    automatic_order: int = 2
    largest_order: int = 4
    significance: float = 1e-3
    tolerance: float = 5e-4


LIMITS = CrosstalkConstants()


@dataclass(frozen=True, slots=True, kw_only=True)
class LightFit:
    """Fit of one light's column of A, with its diagnostics.

    Attributes
    ----------
    name : str
    reference : int
        Channel that sees the light best.
    column : ndarray, shape (C,)
        Column of A; 1 in the reference channel.
    signal : float
        Mean grey level (DN above dark) of the reference channel in the blocks used.
    used, rejected : float
        Fractions of the blocks that were used, and left out as outliers.
    intensity_drift : float
        Range of the light's strength over the captures, relative to its mean.
    colour_drift : float
        Largest scatter (standard deviation) of an entry between captures beyond their noise.
    offset, offset_std : ndarray, shape (C,)
        Grey level that remains where the light is absent, and its uncertainty (`ratio.offsets_left`).
    variation : Variation
        The test whether the column varies over the field.
    captures : int
    """

    name: str
    reference: int
    column: FloatArray
    signal: float
    used: float
    rejected: float
    intensity_drift: float
    colour_drift: float
    offset: FloatArray
    offset_std: FloatArray
    variation: Variation
    captures: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CrosstalkEstimate:
    """Result of `estimate_crosstalk`: the matrix, the fit of every light, and what the user should know."""

    crosstalk: Crosstalk
    lights: tuple[LightFit, ...]
    warnings: tuple[str, ...]


def estimate_crosstalk(
    lights: Mapping[str, Sequence[BlockMeans]],
    dark: Sequence[BlockMeans] = (),
    *,
    order: int | None = None,
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
    order
        Degree of the polynomial by which A varies over the field; None: the lowest up to 2 that the data ask for, 0
        unless the variation is both significant and larger than the tolerance.
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
    if unknown := sorted(set(allow) - set(CHECKS)):
        raise CalibrationError(f"unknown check {', '.join(unknown)}; those that can be waived are {', '.join(CHECKS)}")
    if order is not None and not 0 <= order <= LIMITS.largest_order:
        raise CalibrationError(f"the degree of the field is 0 to {LIMITS.largest_order}, not {order}")
    warnings = judged(capture_checks(lights, dark, labels or {}), allow)
    like = next(iter(lights.values()))[0]
    shape, centres = like.camera.shape, block_centres(like.camera.shape, like.block)
    level, of_mean, of_frame = np.zeros_like(like.channels), LIMITS.black_level_std**2 * np.eye(3), np.zeros((3, 3))
    if dark:
        frames = np.stack([frame.channels for frame in dark])
        level = frames.mean(axis=0)
        of_frame = np.cov(frames.mean(axis=(2, 3)), rowvar=False) if len(frames) > 1 else of_mean
        of_mean = of_frame / len(frames)
    signals = [_above_dark(name, captures, level) for name, captures in lights.items()]
    asked = legendre_products(centres, shape, LIMITS.automatic_order)
    tests = [_needed_degree(signal, asked) for signal in signals]
    order = max(needed for needed, _ in tests) if order is None else order
    design = legendre_products(centres, shape, order)
    columns = [fit_column(signal, design) for signal in signals]
    fits = tuple(
        _summary(signal, column, test, design)
        for signal, column, (_, test) in zip(signals, columns, tests, strict=True)
    )
    warnings += judged(matrix_checks(fits), allow)
    matrices = np.stack([fit.coefficients for fit in columns], axis=-1)
    covariance = _covariance(columns, of_mean, of_frame)
    field, size = None, matrices[0].size
    if order:
        std = np.sqrt(np.einsum("tcktck->tck", covariance))
        field = CrosstalkField(order=order, coefficients=matrices[1:], shape=shape, std=std[1:])
    crosstalk = Crosstalk(
        matrix=matrices[0], lights=tuple(lights), covariance=covariance[0, :, :, 0].reshape(size, size), field=field
    )
    return CrosstalkEstimate(crosstalk=crosstalk, lights=fits, warnings=tuple(warnings))


def _above_dark(name: str, captures: Sequence[BlockMeans], dark: FloatArray) -> LightSignal:
    values = np.stack([frame.channels for frame in captures]) - dark
    valid = ~np.stack([frame.saturated for frame in captures])
    if valid.sum() < LIMITS.least_blocks * len(captures):
        raise CalibrationError(
            f"light {name}: {100 * (1 - valid.mean()):.0f} % of the blocks hold saturated samples; "
            "shorten the exposure until none does"
        )
    return LightSignal(name, values, valid, int(np.median(values.transpose(0, 2, 3, 1)[valid], axis=0).argmax()))


def _needed_degree(signal: LightSignal, design: FloatArray) -> tuple[int, Variation]:
    """Degree that the light's captures ask for, and the test of all terms that are not constant."""
    tests: list[Variation] = []
    for order in range(LIMITS.automatic_order):
        tests.append(variation(signal, design, (order + 1) * (order + 2) // 2))
        if tests[-1].p_value >= LIMITS.significance or tests[-1].rms <= LIMITS.tolerance:
            return order, tests[0]
    return LIMITS.automatic_order, tests[0]


def _summary(signal: LightSignal, fit: ColumnFit, found: Variation, design: FloatArray) -> LightFit:
    count = fit.weights.sum(axis=(1, 2))
    strength = fit.mass / np.maximum(count, 1)
    offset, offset_std = offsets_left(signal, fit.weights, design)
    return LightFit(
        name=signal.name,
        reference=signal.reference,
        column=fit.coefficients[0],
        signal=float(fit.mass.sum() / count.sum()),
        used=float((fit.weights > 0).mean()),
        rejected=float((signal.valid & (fit.weights == 0)).mean()),
        intensity_drift=float(np.ptp(strength) / strength.mean()),
        colour_drift=float(np.sqrt(capture_scatter(fit).max())),
        offset=offset,
        offset_std=offset_std,
        variation=found,
        captures=len(signal.values),
    )


def _covariance(columns: Sequence[ColumnFit], of_mean: FloatArray, of_frame: FloatArray) -> FloatArray:
    """Covariance (T, C, k, T, C, k) of all coefficients.

    The error of the dark frames' mean (covariance `of_mean`) is common to all blocks and lights, that of one frame's
    own offset (`of_frame`) to the blocks of a frame.
    """
    terms, channels = columns[0].coefficients.shape
    full = np.zeros((terms, channels, len(columns), terms, channels, len(columns)))
    for i, first in enumerate(columns):
        for j, second in enumerate(columns):
            shared = of_mean + (of_frame / len(first.mass) if i == j else 0)
            full[:, :, i, :, :, j] = np.einsum("tcx,xy,udy->tcud", first.leverage, shared, second.leverage)
        full[:, :, i, :, :, i] += first.covariance
        full[0, :, i, 0, :, i] += np.diag(capture_scatter(first) / len(first.mass))
    return full


def matrix_checks(fits: Sequence[LightFit]) -> Iterator[Check]:
    """Check the fitted columns: the right channel for each light's name, one light per channel, quiet lamps.

    The condition number of three LEDs on nine measured cameras is 1.6 to 2.5 (calibration/README.md).
    """
    lower = [fit.name.lower() for fit in fits]
    if all(name in (*COLOURS, "r", "g", "b") for name in lower):  # single letters count where all names are colours
        lower = [COLOURS["rgb".index(name[0])] for name in lower]
    for fit, name in zip(fits, lower, strict=True):
        if name in COLOURS and name != COLOURS[fit.reference]:
            text = (
                f"light {fit.name} is seen best by the {COLOURS[fit.reference]} channel: are the captures of two "
                "lights swapped, or is the colour filter array (--cfa) another one?"
            )
            yield Check("name", text)
    for index, fit in enumerate(fits):
        for twin in [other for other in fits[:index] if other.reference == fit.reference][:1]:
            text = (
                f"lights {twin.name} and {fit.name} are both seen best by the {COLOURS[fit.reference]} channel: did "
                "the same lamp shine in both captures?"
            )
            yield Check("same-channel", text)
    for fit in fits:
        yield from _fit_checks(fit)
    condition = float(np.linalg.cond(np.column_stack([fit.column for fit in fits])))
    text = (
        f"the matrix has condition number {condition:.1f}: unmixing amplifies noise strongly. Are two lamps close in "
        "colour, or did a second lamp or daylight shine in the captures of one?"
    )
    yield warning(text, condition, above=6.0)
    unseen = [colour for c, colour in enumerate(COLOURS) if c not in {fit.reference for fit in fits}]
    text = (
        f"no light is seen best by the {' and '.join(unseen)} channel: if such a lamp shines during the test it must "
        "be calibrated too"
    )
    yield warning(text, len(unseen) if len(fits) < 3 else 0)


def _fit_checks(fit: LightFit) -> Iterator[Check]:
    light = f"light {fit.name}: "
    text = (
        f"its strength differs by {100 * fit.intensity_drift:.1f} % between captures: let the lamp warm up (the matrix "
        "does not suffer)"
    )
    # captures that differ by 30 % are an exposure series, which is meant
    yield warning(light + text, fit.intensity_drift if fit.intensity_drift < 0.30 else 0.0, above=0.05)
    text = (
        f"its colour drifts between captures (entries scatter by {fit.colour_drift:.2g} beyond noise); the stated "
        "uncertainty covers it"
    )
    yield warning(light + text, fit.colour_drift, above=LIMITS.tolerance)
    # .2 % of the signal leaks as much, of the order of what `check` allows (`verify.Limits.leakage`)
    left = np.abs(fit.offset)
    left = np.where((left > 5 * fit.offset_std) & (left > 0.002 * fit.signal), left, 0)
    channel = int(left.argmax())
    text = (
        f"the {COLOURS[channel]} channel keeps {fit.offset[channel]:+.1f} DN where the light is absent: dark frames of "
        "other settings or another ambient light, or a camera that is not linear"
    )
    yield warning(light + text, left[channel])
    # of normal noise less than 1e-5 of the blocks are outliers
    text = f"{100 * fit.rejected:.0f} % of the blocks are outliers: coloured or fluorescent spots on the target?"
    yield warning(light + text, fit.rejected, above=0.05)
