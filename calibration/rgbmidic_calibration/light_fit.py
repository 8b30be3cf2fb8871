"""What is found for one light, and whether all of them together can be true."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbmidic.errors import CalibrationError
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.ratio import Variation

__all__ = ["LightFit", "check_matrix"]

COLOURS = ("red", "green", "blue")

INTENSITY_WARNING, DELIBERATE = 0.05, 0.30
"""Captures whose strengths differ by more than the second are meant to: an exposure series."""
COLOUR_DRIFT_WARNING = 5e-4
OFFSET_WARNING, OFFSET_SIGNIFICANCE = 0.002, 5.0
CONDITION_WARNING = 6.0


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
        Shares of the blocks that were used, left out as saturated, and left out as outliers.
    intensity_drift : float
        Range of the light's strength over the captures, relative to its mean.
    colour_drift : float
        Largest scatter (standard deviation) of an entry between captures beyond their noise.
    offset, offset_std : ndarray, shape (C,)
        Grey level that is left where the light is absent, and its uncertainty (`ratio.offsets_left`).
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
    if fit.rejected > 0.05:
        warnings.append(
            f"light {fit.name}: {100 * fit.rejected:.0f} % of the blocks are outliers: coloured or fluorescent "
            "spots on the target?"
        )
    return warnings
