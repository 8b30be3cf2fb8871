"""Checks of a frame, of captures and of a calibration: a figure, its limits, and the sentence that it gives rise to."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from math import inf, isnan


@dataclass(frozen=True, slots=True)
class Check:
    """A figure against its limits; its size counts, not its sign.

    Attributes
    ----------
    name : str
        By which a user accepts that it fails (`--allow`, `calibration.accept`); in a verdict, what the figure is.
    text : str
        What was found, what was expected, and what the cause may be.
    value : float
        The figure; infinite where the sentence is all there is.
    limit : float
        Largest size that passes.
    doubtful : float
        Size up to which nothing is reported; between it and `limit` the sentence is a warning.
    std, unit : float, str
        Standard uncertainty and unit of the figure.
    """

    name: str
    text: str
    value: float = inf
    limit: float = 0.0
    doubtful: float = inf
    std: float = 0.0
    unit: str = ""

    @property
    def passed(self) -> bool:
        """The figure keeps its limit; one that is not a number does not."""
        return bool(abs(self.value) <= self.limit)


def warning(text: str, value: float = inf, above: float = 0.0) -> Check:
    """Check that never fails: a warning where the figure exceeds `above`, or in any case; NaN says nothing."""
    return Check("", text, 0.0 if isnan(value) else value, limit=inf, doubtful=above)


def reported(checks: Iterable[Check]) -> list[Check]:
    """Those that fail or are doubtful."""
    return [check for check in checks if not check.passed or abs(check.value) > check.doubtful]


def refused(checks: Iterable[Check], accepted: Collection[str]) -> list[Check]:
    """Those that fail and whose names are not accepted."""
    return [check for check in checks if not check.passed and check.name not in accepted]
