"""How well a measured and a simulated field agree, and the fit of one to the other."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from rgbmidic.typing import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """How one quantity of a frame agrees with the simulation.

    Attributes
    ----------
    values
        Their number n: nodes with data, of the displacement those of u and v.
    mean, rms
        Of the differences, measured minus simulated.
    std
        Median standard uncertainty.
    beyond_2
        Fraction of the differences above two standard uncertainties; .046 is ordinary.
    chi_square
        Per degree of freedom: 1 is expected where the simulation is right.
    degrees_of_freedom
        Of chi-square.
    probability
        Of a larger chi-square where the simulation is right.
    """

    values: int
    mean: float = math.nan
    rms: float = math.nan
    std: float = math.nan
    beyond_2: float = math.nan
    chi_square: float = math.nan
    degrees_of_freedom: float = math.nan
    probability: float = math.nan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """Multiple of the levelled simulation that fits a measured displacement best, with any shift and rotation.

    Where the loads are stated, a modulus that is too large by 3 % reads as a scale of 1.03.

    Attributes
    ----------
    scale, scale_std
        NaN where the simulation is no more than a rigid motion.
    rigid, rigid_std : ndarray, shape (3,)
        Shift (mm) of the middle of the measured nodes, and rotation (degrees, from x towards y), measured minus
        simulated.
    chi_square
        Of what the best multiple, shift and rotation leave, per degree of freedom.
    template : ndarray, shape (2, N)
        The simulation without a rigid motion over the standard uncertainty, at the measurement's nodes.
    projection, information
        Sums of the template times the measured displacement over its uncertainty, and times itself: their quotient is
        the scale.
    """

    template: FloatArray
    scale: float = math.nan
    scale_std: float = math.nan
    rigid: FloatArray = field(default_factory=lambda: np.full(3, math.nan))
    rigid_std: FloatArray = field(default_factory=lambda: np.full(3, math.nan))
    chi_square: float = math.nan
    projection: float = 0.0
    information: float = 0.0
