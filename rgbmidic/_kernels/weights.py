"""From the lights' residuals to their weights, and the gradient of the other lights."""

import numpy as np

from rgbmidic._kernels.threads import FAST, compiled

BLOCK = 4096
"""Pixels at a time: what a core's fastest cache holds."""
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)


@compiled("fraction", axis=1, grain=BLOCK, fastmath=FAST)
def best_mean(start, stop, fraction, weights, difference, rim, mean, has_weight):
    """Turn `fraction` (k, P) into the fractions of the lights in a mean: none below 0 or without weight, their sum 1.

    `mean` (P,) receives that of `difference` (k, P). Where a light has a fraction the first of `has_weight` (2, P)
    receives 1 less the `rim` (P,), and the second the rim; else 0.
    """
    for first in range(start, stop, BLOCK):
        chunk = slice(first, min(first + BLOCK, stop))
        total, at_rim, result, edge = has_weight[0, chunk], has_weight[1, chunk], mean[chunk], rim[chunk]
        total[:] = 0
        result[:] = 0
        for light in range(len(fraction)):
            light_fraction, weight = fraction[light, chunk], weights[light, chunk]
            for i in range(np.uint64(total.size)):
                light_fraction[i] = max(light_fraction[i], _ZERO) if weight[i] > _ZERO else _ZERO
                total[i] += light_fraction[i]
        for light in range(len(fraction)):
            light_fraction, value = fraction[light, chunk], difference[light, chunk]
            for i in range(np.uint64(total.size)):
                light_fraction[i] = light_fraction[i] / total[i] if total[i] > _ZERO else _ZERO
                result[i] += light_fraction[i] * value[i]
        for i in range(np.uint64(total.size)):
            total[i] = _ONE if total[i] > _ZERO else _ZERO
            at_rim[i] = total[i] * edge[i]
            total[i] -= at_rim[i]


@compiled("fraction", axis=1, grain=BLOCK, fastmath=FAST)
def robust_weights(start, stop, mean, variance, displacing, unit, freedom, fraction, loss_curvature):
    """Multiply `fraction` (k, P) by the robust weight of the lights' `mean` residual (P,); fill `loss_curvature` (P,).

    Its `variance` (P,) is that around the pixel, `displacing` (P,) the fraction of it that counts, in units of `unit`;
    the weight is its inverse to the power .75 times that of a Student distribution of so many degrees of `freedom`.
    """
    factor = np.empty(BLOCK, dtype=np.float32)
    for first in range(start, stop, BLOCK):
        chunk = slice(first, min(first + BLOCK, stop))
        value, local_variance = mean[chunk], variance[chunk]
        counted_fraction, curvature = displacing[chunk], loss_curvature[chunk]
        for i in range(np.uint64(value.size)):
            ratio = value[i] * value[i] / local_variance[i]
            precision = unit / (counted_fraction[i] * local_variance[i])
            curvature[i] = (freedom - ratio) / (freedom + ratio)
            factor[i] = np.sqrt(precision * np.sqrt(precision)) * (freedom + _ONE) / (freedom + ratio)
        for light in range(len(fraction)):
            light_fraction = fraction[light, chunk]
            for i in range(np.uint64(light_fraction.size)):
                light_fraction[i] *= factor[i]
