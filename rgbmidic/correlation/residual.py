"""What the two states differ by at a displacement: f - g(x + u) of every light at the owned pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["Residual"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Residual:
    """Both states at the owned pixels of the reference.

    Attributes
    ----------
    reference
        The reference state.
    values : ndarray, shape (k, P), float32
        Grey levels f of the reference, corrected for brightness.
    warped : ndarray, shape (k, P), float32
        Grey levels g(x + u); NaN outside the image.
    weights : ndarray, shape (k, P), float32
        Weights given, brought back by the displacement.
    difference : ndarray, shape (k, P), float32
        f - g(x + u); 0 where g is not known.
    """

    reference: Reference
    values: FloatImage
    warped: FloatImage
    weights: FloatImage
    difference: FloatImage = field(init=False)

    def __post_init__(self) -> None:
        difference = self.values - self.warped
        difference[np.isnan(difference)] = 0
        object.__setattr__(self, "difference", difference)

    @classmethod
    def at(
        cls, reference: Reference, deformed: Deformed, values: FloatImage, displacements: Sequence[FloatArray]
    ) -> Residual:
        """At one nodal displacement (N, 2) per light, for reference grey levels `values` (k, P)."""
        warped, weights = np.empty_like(values), np.empty_like(values)
        for light, displacement in enumerate(displacements):
            reference.bring_back(deformed, light, displacement, warped[light], weights[light])
        return cls(reference=reference, values=values, warped=warped, weights=weights)

    def without(self, deviation: FloatImage) -> Residual:
        """The same, less what a displacement known to be missing (2, P), in px, leaves in it."""
        x, y = self.reference.gradient_x * deviation[0], self.reference.gradient_y * deviation[1]
        return replace(self, values=self.values - x - y)
