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

__all__ = ["CHANNELS", "CrosstalkEstimate", "LightFit", "check_matrix", "estimate_crosstalk"]

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
    used, saturated, rejected : float
        Fractions of the blocks that were used, left out as saturated, and left out as outliers.
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
    saturated: float
    rejected: float
    intensity_drift: float
    colour_drift: float
    offset: FloatArray
    offset_std: FloatArray
    variation: Variation
    captures: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CrosstalkEstimate:
    """Result of `estimate_crosstalk`.

    Attributes
    ----------
    crosstalk : Crosstalk
    lights : tuple of LightFit
    dark, dark_std : ndarray, shape (C,)
        Mean dark signal above the stated black level and its uncertainty, in DN.
    warnings : tuple of str
    """

    crosstalk: Crosstalk
    lights: tuple[LightFit, ...]
    dark: FloatArray
    dark_std: FloatArray
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Dark:
    """Dark level of the channels, with the covariances of its error."""

    level: FloatArray  # (C, R, S) mean dark signal above the stated black level
    mean_covariance: FloatArray  # (C, C) of the error of that mean, common to all blocks
    frame_covariance: FloatArray  # (C, C) of one frame's own offset


@dataclass(frozen=True, slots=True)
class _Light:
    """Captures of one light above dark, the blocks that are not saturated, and the channel that sees it best."""

    name: str
    captures: Sequence[BlockMeans]
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
    offset = _dark_level(dark, like)
    prepared = [_prepare(name, captures, offset) for name, captures in lights.items()]
    tests = [_variation(light, like) for light in prepared]
    order = max(needed for needed, _ in tests) if order is None else order
    design = legendre_products(block_centres(like.shape, like.block), like.shape, order)
    columns = [fit_column(light.signal, light.valid, light.reference, design) for light in prepared]
    fits = tuple(
        _summary(light, column, test, design) for light, column, (_, test) in zip(prepared, columns, tests, strict=True)
    )
    warnings += check_matrix(fits, allow=allow)
    return CrosstalkEstimate(
        crosstalk=_assemble(tuple(lights), columns, offset, order, like.shape),
        lights=fits,
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


def _prepare(name: str, captures: Sequence[BlockMeans], dark: _Dark) -> _Light:
    signal = np.stack([frame.channels for frame in captures]) - dark.level
    valid = ~np.stack([frame.saturated for frame in captures])
    if valid.sum() < MIN_BLOCKS * len(captures):
        raise CalibrationError(
            f"light {name}: {100 * (1 - valid.mean()):.0f} % of the blocks hold saturated samples; "
            "shorten the exposure until none does"
        )
    reference = int(np.median(signal.transpose(0, 2, 3, 1)[valid], axis=0).argmax())
    return _Light(name, captures, signal, valid, reference)


def _variation(light: _Light, like: BlockMeans) -> tuple[int, Variation]:
    """Degree that the light's captures ask for, and the test of all terms that are not constant."""
    design = legendre_products(block_centres(like.shape, like.block), like.shape, AUTOMATIC_ORDER)
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
        saturated=float(1 - light.valid.mean()),
        rejected=float((light.valid & (fit.weights == 0)).mean()),
        intensity_drift=float(np.ptp(strength) / strength.mean()),
        colour_drift=float(np.sqrt(capture_scatter(fit).max())),
        offset=offset,
        offset_std=offset_std,
        variation=found,
        captures=len(light.captures),
    )


def _assemble(
    lights: tuple[str, ...], columns: Sequence[ColumnFit], dark: _Dark, order: int, shape: tuple[int, int]
) -> Crosstalk:
    matrices = np.stack([fit.coefficients for fit in columns], axis=-1)
    covariance = _covariance(columns, dark)
    field = None
    if order:
        std = np.sqrt(np.einsum("tcktck->tck", covariance))
        field = CrosstalkField(order=order, coefficients=matrices[1:], shape=shape, std=std[1:])
    size = matrices[0].size
    return Crosstalk(
        matrix=matrices[0], lights=lights, covariance=covariance[0, :, :, 0].reshape(size, size), field=field
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
        A light is seen best by another channel than its name says, or two by the same, and that is not waived.
    """
    for fit, expected in zip(fits, _expected_channels([fit.name for fit in fits]), strict=True):
        if "name" not in allow and expected not in (None, fit.reference):
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


def _expected_channels(names: Sequence[str]) -> list[int | None]:
    """Channel that each name promises; single letters count only where all names are colours."""
    lower = [name.lower() for name in names]
    if all(name in (*COLOURS, "r", "g", "b") for name in lower):
        return ["rgb".index(name[0]) for name in lower]
    return [COLOURS.index(name) if name in COLOURS else None for name in lower]


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
