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
    weight, held = np.ones(basis.shape[1:]), np.diag([1e-6, ridge, ridge])
    for _ in range(5):  # until the weights have settled: twice as many change results by 1e-11 px
        # no BLAS, whose sums may depend on the number of threads
        sums = np.array([[(function * side).sum(axis=0) for side in (*basis, *values)] for function in basis * weight])
        coefficients = np.linalg.solve(sums[:, :3].T + held, sums[:, 3:].transpose(2, 0, 1))
        fitted = sum(
            function * slope[:, None] for function, slope in zip(basis, coefficients.transpose(1, 2, 0), strict=True)
        )
        weight = 1 / (1 + ((values - fitted) ** 2).sum(axis=0) / scale**2)
    return coefficients
