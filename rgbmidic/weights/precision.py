"""Precision of the lights at each pixel, which a method of weighting learns from a residual."""

from __future__ import annotations

from dataclasses import dataclass

from rgbmidic.renamed import state_new_names
from rgbmidic.typing import FloatImage


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True)
class Precision:
    """Precision of the lights, from their residuals.

    Attributes
    ----------
    factor : ndarray, shape (k, P), float32
        Factor on the weights that are given, in any unit.
    loss_curvature : ndarray, shape (P,), float32
        Second derivative of the robust loss over `factor`, 1 for a loss that is not robust.

    Examples
    --------
    >>> import numpy as np
    >>> Precision(factor=np.ones((3, 100), np.float32), loss_curvature=np.ones(100, np.float32)).factor.shape
    (3, 100)
    """

    factor: FloatImage
    loss_curvature: FloatImage
