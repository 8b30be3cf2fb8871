"""From the lights' residuals to their weights, and the gradient of the other lights."""

import numpy as np

from rgbmidic._kernels.threads import FAST, compiled

BLOCK = 4096
"""Pixels at a time: what a core's fastest cache holds."""
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)


@compiled("fraction", axis=1, grain=BLOCK, fastmath=FAST)
def best_mean(start, stop, fraction, weights, difference, mean, used):
    """Turn `fraction` (k, P) into the fractions of the lights in a mean: none below 0 or without weight, their sum 1.

    `mean` (P,) receives that of `difference` (k, P), and `used` (P,) 1 where a light has a fraction, else 0.
    """
    for first in range(start, stop, BLOCK):
        chunk = slice(first, min(first + BLOCK, stop))
        total, result = used[chunk], mean[chunk]
        total[:] = 0
        result[:] = 0
        for light in range(len(fraction)):
            own, weight = fraction[light, chunk], weights[light, chunk]
            for i in range(np.uint64(total.size)):
                own[i] = max(own[i], _ZERO) if weight[i] > _ZERO else _ZERO
                total[i] += own[i]
        for light in range(len(fraction)):
            own, value = fraction[light, chunk], difference[light, chunk]
            for i in range(np.uint64(total.size)):
                own[i] = own[i] / total[i] if total[i] > _ZERO else _ZERO
                result[i] += own[i] * value[i]
        for i in range(np.uint64(total.size)):
            total[i] = _ONE if total[i] > _ZERO else _ZERO


@compiled("fraction", axis=1, grain=BLOCK, fastmath=FAST)
def robust_weights(start, stop, mean, variance, displacing, unit, freedom, fraction, bend):
    """Multiply `fraction` (k, P) by the robust weight of the lights' `mean` residual (P,); the loss's `bend` (P,).

    Its `variance` (P,) is that around the pixel, `displacing` (P,) the fraction of it that counts, in units of `unit`;
    the weight is its inverse to the power .75 times that of a Student distribution of so many degrees of `freedom`.
    """
    factor = np.empty(BLOCK, dtype=np.float32)
    for first in range(start, stop, BLOCK):
        chunk = slice(first, min(first + BLOCK, stop))
        value, around, part, curved = mean[chunk], variance[chunk], displacing[chunk], bend[chunk]
        for i in range(np.uint64(value.size)):
            ratio = value[i] * value[i] / around[i]
            precision = unit / (part[i] * around[i])
            curved[i] = (freedom - ratio) / (freedom + ratio)
            factor[i] = np.sqrt(precision * np.sqrt(precision)) * (freedom + _ONE) / (freedom + ratio)
        for light in range(len(fraction)):
            own = fraction[light, chunk]
            for i in range(np.uint64(own.size)):
                own[i] *= factor[i]
