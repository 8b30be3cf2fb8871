"""A statement of the paper and what became of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["Claim", "Verdict", "verdict"]

Verdict = Literal["reproduced", "in part", "not reproduced", "not measured"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A statement and what became of it.

    Attributes
    ----------
    figure
        Where the paper makes it.
    scene
        On which virtual scene it was tested; empty: on the flat specimen.
    statement
        The paper's words, shortened.
    measured
        The figures of the virtual experiment.
    verdict
        The outcome.
    reason
        Why it differs, where it does and where a reason was found.
    """

    figure: str
    scene: str
    statement: str
    measured: str
    verdict: Verdict
    reason: str = ""


def verdict(holds: bool) -> Verdict:
    """Reproduced, or not."""
    return "reproduced" if holds else "not reproduced"
