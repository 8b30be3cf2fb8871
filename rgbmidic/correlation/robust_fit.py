"""Least squares with Cauchy weights, many small fits at once (Holland and Welsch 1977)."""

from __future__ import annotations

import numpy as np

from rgbmidic.typing import FloatArray


def robust_fit(basis: FloatArray, values: FloatArray, ridge: float, scale: float) -> FloatArray:
    """Fit values by functions of which the first is 1, by least squares with Cauchy weights.

    Parameters
    ----------
    basis : ndarray, shape (T, K, 3)
        The functions at the K points of T fits.
    values : ndarray, shape (T, K, c)
        Their c components.
    ridge
        Holds the slopes back where the points do not determine them.
    scale
        Of the weights, in the unit of the values.

    Returns
    -------
    ndarray, shape (T, 3, c)
        Coefficients.
    """
    basis, values = (np.ascontiguousarray(array.T) for array in (basis, values))  # one fit beside the other in memory
    functions, weight, held = np.concatenate([basis, values]), np.ones(basis.shape[1:]), np.diag([1e-6, ridge, ridge])
    for _ in range(5):  # until the weights have settled: twice as many change results by 1e-11 px
        # no BLAS, whose sums may depend on the number of threads
        sums = np.einsum("akt,bkt->tab", basis * weight, functions)
        coefficients = np.linalg.solve(sums[..., :3] + held, sums[..., 3:])
        fitted = np.einsum("akt,tac->ckt", basis, coefficients)
        weight = 1 / (1 + ((values - fitted) ** 2).sum(axis=0) / scale**2)
    return np.asarray(coefficients)
