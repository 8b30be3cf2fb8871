"""The crosstalk matrix A from captures with one light on at a time: camera channels = A . lights.

For each light the channel that sees it best is the reference; the entries of the other channels are ratios to it,
estimated from block averages (`rgbmidic_calibration.ratio`). The covariance of A adds to the scatter of the blocks the
error of the dark level, which is common to all blocks and all lights, and the scatter of the captures beyond their
noise. The fitted columns are then checked against the names of the lights and against each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rgbmidic.errors import CalibrationError
from rgbmidic.illumination.crosstalk import Crosstalk, CrosstalkField, legendre_products
from rgbmidic.typing import BoolArray, FloatArray
from rgbmidic_calibration.plausibility import CHECKS, check_captures
from rgbmidic_calibration.ratio import (
    BlockMeans,
    ColumnFit,
    Variation,
    block_centres,
    capture_scatter,
    fit_column,
    offsets_left,
    variation,
)

CHANNELS = ("R", "G", "B")

BLACK_LEVEL_STD = 0.3
"""Standard uncertainty (DN) of a black level that no series of dark frames measured: rounded to whole grey levels."""

MIN_BLOCKS = 9
"""Unsaturated blocks per capture at least: as many as the smallest frame has, 3 x 3 (`block_means`)."""
AUTOMATIC_ORDER = 2
"""Largest degree that the data may ask for: shading by lens and filters is a slope and a curvature."""
LARGEST_ORDER = 4
"""Largest degree that may be stated: 15 coefficients per entry. Chosen; higher ones only follow the noise of blocks."""
FIELD_SIGNIFICANCE = 1e-3
"""Significance level of the test for variation over the field. With 4999 random signs p is at least 2e-4."""
FIELD_TOLERANCE = 5e-4
"""Variation of an entry over the field (rms) that is accepted, however significant: it leaks 0.05 % at most."""
COLOURS = ("red", "green", "blue")

INTENSITY_WARNING, DELIBERATE = 0.05, 0.30
"""Range of the strengths, relative to their mean, between which the lamp is reported as drifting. Chosen; captures that
differ by more are an exposure series, which is meant."""
COLOUR_DRIFT_WARNING = 5e-4
"""Scatter of an entry between captures: as `FIELD_TOLERANCE`, it leaks 0.05 %."""
OFFSET_WARNING, OFFSET_SIGNIFICANCE = 0.002, 5.0
"""Fraction of the signal, and standard uncertainties, from which an offset is reported: it leaks 0.2 %, of the order of
what `check` allows (`rgbmidic_calibration.verify.Limits.leakage`)."""
CONDITION_WARNING = 6.0
"""Chosen: three LEDs on nine measured cameras give 1.6 to 2.5 (calibration/README.md). It decides on a warning only."""
REJECTED_WARNING = 0.05
"""Fraction of the blocks left out as outliers; of normal noise it is below 1e-5. It decides on a warning only."""


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


@dataclass(frozen=True, slots=True)
class _Dark:
    """Dark level of the channels, with the covariances of its error."""

    level: FloatArray  # (C, R, S) mean dark signal above the stated black level
    mean_covariance: FloatArray  # (C, C) of the error of that mean, common to all blocks
    frame_covariance: FloatArray  # (C, C) of one frame's own offset


@dataclass(frozen=True, slots=True)
class _Light:
    """Captures of one light above dark (N, C, R, S), the unsaturated blocks, and the channel that sees it best."""

    name: str
    signal: FloatArray
    valid: BoolArray
    reference: int


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
        unless the variation is both significant and larger than `FIELD_TOLERANCE`.
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
    if order is not None and not 0 <= order <= LARGEST_ORDER:
        raise CalibrationError(f"the degree of the field is 0 to {LARGEST_ORDER}, not {order}")
    warnings = check_captures(lights, dark, allow=allow, labels=labels or {})
    like = next(iter(lights.values()))[0]
    centres = block_centres(like.shape, like.block)
    offset = _dark_level(dark, like)
    prepared = [_prepare(name, captures, offset) for name, captures in lights.items()]
    tests = [_variation(light, legendre_products(centres, like.shape, AUTOMATIC_ORDER)) for light in prepared]
    order = max(needed for needed, _ in tests) if order is None else order
    design = legendre_products(centres, like.shape, order)
    columns = [fit_column(light.signal, light.valid, light.reference, design) for light in prepared]
    fits = tuple(
        _summary(light, column, test, design) for light, column, (_, test) in zip(prepared, columns, tests, strict=True)
    )
    warnings += check_matrix(fits, allow=allow)
    matrices, covariance = np.stack([fit.coefficients for fit in columns], axis=-1), _covariance(columns, offset)
    field, size = None, matrices[0].size
    if order:
        std = np.sqrt(np.einsum("tcktck->tck", covariance))
        field = CrosstalkField(order=order, coefficients=matrices[1:], shape=like.shape, std=std[1:])
    crosstalk = Crosstalk(
        matrix=matrices[0], lights=tuple(lights), covariance=covariance[0, :, :, 0].reshape(size, size), field=field
    )
    return CrosstalkEstimate(crosstalk=crosstalk, lights=fits, warnings=tuple(warnings))


def _dark_level(dark: Sequence[BlockMeans], like: BlockMeans) -> _Dark:
    unknown = BLACK_LEVEL_STD**2 * np.eye(3)
    if not dark:
        return _Dark(np.zeros_like(like.channels), unknown, np.zeros((3, 3)))
    frames = np.stack([frame.channels for frame in dark])
    drift = np.cov(frames.mean(axis=(2, 3)), rowvar=False) if len(frames) > 1 else unknown
    return _Dark(frames.mean(axis=0), drift / len(frames), drift)


def _prepare(name: str, captures: Sequence[BlockMeans], dark: _Dark) -> _Light:
    signal = np.stack([frame.channels for frame in captures]) - dark.level
    valid = ~np.stack([frame.saturated for frame in captures])
    if valid.sum() < MIN_BLOCKS * len(captures):
        raise CalibrationError(
            f"light {name}: {100 * (1 - valid.mean()):.0f} % of the blocks hold saturated samples; "
            "shorten the exposure until none does"
        )
    reference = int(np.median(signal.transpose(0, 2, 3, 1)[valid], axis=0).argmax())
    return _Light(name, signal, valid, reference)


def _variation(light: _Light, design: FloatArray) -> tuple[int, Variation]:
    """Degree that the light's captures ask for, and the test of all terms that are not constant."""
    needed, overall = 0, Variation(p_value=1.0, rms=0.0)
    for order in range(AUTOMATIC_ORDER):
        found = variation(light.signal, light.valid, light.reference, design, (order + 1) * (order + 2) // 2)
        overall = found if order == 0 else overall
        if found.p_value >= FIELD_SIGNIFICANCE or found.rms <= FIELD_TOLERANCE:
            break
        needed = order + 1
    return needed, overall


def _summary(light: _Light, fit: ColumnFit, found: Variation, design: FloatArray) -> LightFit:
    count = fit.weights.sum(axis=(1, 2))
    strength = fit.mass / np.maximum(count, 1)
    offset, offset_std = offsets_left(light.signal, fit.weights, light.reference, design)
    return LightFit(
        name=light.name,
        reference=light.reference,
        column=fit.coefficients[0],
        signal=float(fit.mass.sum() / count.sum()),
        used=float((fit.weights > 0).mean()),
        rejected=float((light.valid & (fit.weights == 0)).mean()),
        intensity_drift=float(np.ptp(strength) / strength.mean()),
        colour_drift=float(np.sqrt(capture_scatter(fit).max())),
        offset=offset,
        offset_std=offset_std,
        variation=found,
        captures=len(light.signal),
    )


def _covariance(columns: Sequence[ColumnFit], dark: _Dark) -> FloatArray:
    """Covariance (T, C, k, T, C, k) of all coefficients: the error of the dark mean is common to all lights."""
    terms, channels = columns[0].coefficients.shape
    full = np.zeros((terms, channels, len(columns), terms, channels, len(columns)))
    for i, first in enumerate(columns):
        for j, second in enumerate(columns):
            shared = dark.mean_covariance + (dark.frame_covariance / len(first.mass) if i == j else 0)
            full[:, :, i, :, :, j] = np.einsum("tcx,xy,udy->tcud", first.leverage, shared, second.leverage)
        full[:, :, i, :, :, i] += first.covariance
        drift = capture_scatter(first) / len(first.mass)
        full[0, :, i, 0, :, i] += np.diag(drift)
    return full


def check_matrix(fits: Sequence[LightFit], *, allow: Sequence[str]) -> list[str]:
    """Check the fitted columns: the right channel for each light's name, one light per channel, quiet lamps.

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    CalibrationError
        A light is seen best by another channel than its name states, or two by the same, and that is not waived.
    """
    lower = [fit.name.lower() for fit in fits]
    if all(name in (*COLOURS, "r", "g", "b") for name in lower):  # single letters count where all names are colours
        lower = [COLOURS["rgb".index(name[0])] for name in lower]
    for fit, name in zip(fits, lower, strict=True):
        if "name" not in allow and name in COLOURS and name != COLOURS[fit.reference]:
            raise CalibrationError(
                f"light {fit.name} is seen best by the {COLOURS[fit.reference]} channel: are the captures of two "
                "lights swapped, or is the colour filter array (--cfa) another one? (--allow name goes on all the same)"
            )
    for index, fit in enumerate(fits):
        twin = next((other for other in fits[:index] if other.reference == fit.reference), None)
        if twin is not None and "same-channel" not in allow:
            raise CalibrationError(
                f"lights {twin.name} and {fit.name} are both seen best by the {COLOURS[fit.reference]} channel: did "
                "the same lamp shine in both captures? (--allow same-channel goes on all the same)"
            )
    warnings = [message for fit in fits for message in _fit_warnings(fit)]
    condition = float(np.linalg.cond(np.column_stack([fit.column for fit in fits])))
    if condition > CONDITION_WARNING:
        warnings.append(
            f"the matrix has condition number {condition:.1f}: unmixing amplifies noise strongly. Are two lamps close "
            "in colour, or did a second lamp or daylight shine in the captures of one?"
        )
    unseen = [COLOURS[c] for c in range(3) if c not in {fit.reference for fit in fits}]
    if len(fits) < 3 and unseen:
        warnings.append(
            f"no light is seen best by the {' and '.join(unseen)} channel: if such a lamp shines during the test it "
            "must be calibrated too"
        )
    return warnings


def _fit_warnings(fit: LightFit) -> list[str]:
    warnings = []
    if INTENSITY_WARNING < fit.intensity_drift < DELIBERATE:
        warnings.append(
            f"light {fit.name}: its strength differs by {100 * fit.intensity_drift:.1f} % between captures: let the "
            "lamp warm up (the matrix does not suffer)"
        )
    if fit.colour_drift > COLOUR_DRIFT_WARNING:
        warnings.append(
            f"light {fit.name}: its colour drifts between captures (entries scatter by {fit.colour_drift:.2g} beyond "
            "noise); the stated uncertainty covers it"
        )
    left = np.abs(fit.offset)
    if (clear := (left > OFFSET_SIGNIFICANCE * fit.offset_std) & (left > OFFSET_WARNING * fit.signal)).any():
        channel = int(np.where(clear, left, 0).argmax())
        warnings.append(
            f"light {fit.name}: the {COLOURS[channel]} channel keeps {fit.offset[channel]:+.1f} DN where the light is "
            "absent: dark frames of other settings or another ambient light, or a camera that is not linear"
        )
    if fit.rejected > REJECTED_WARNING:
        warnings.append(
            f"light {fit.name}: {100 * fit.rejected:.0f} % of the blocks are outliers: coloured or fluorescent "
            "spots on the target?"
        )
    return warnings
