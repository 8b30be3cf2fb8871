"""From the lights' residuals to their weights, and the gradient of the other lights."""

import numpy as np

from rgbmidic._kernels.threads import FAST, compiled

BLOCK = 4096
"""Pixels at a time: what a core's fastest cache holds."""
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)


@compiled("mean", axis=1, grain=BLOCK, fastmath=FAST)
def gradient_of_others(start, stop, gradient, weights, light, fewest, mean, products):
    """Mean gradient of the lights other than `light`, and its products with that light's own.

    For gradients (2, k, P) and weights (k, P): `mean` (2, P) receives the mean of the others that have weight; where
    they are fewer than `fewest`, that of all that have. `products` (4, P) receives own times mean, mean times mean, own
    times own and 1, all 0 where the light has no weight.
    """
    count, less, total = np.empty((3, BLOCK), dtype=np.float32)
    own, lights = np.uint64(light), np.uint64(len(weights))
    for block in range(start, stop, BLOCK):
        first, number = np.uint64(block), np.uint64(min(BLOCK, stop - block))
        count[:] = 0
        for j in range(lights):
            for i in range(number):
                count[i] += _ONE if weights[j, first + i] > _ZERO else _ZERO
        for i in range(number):
            seen = _ONE if weights[own, first + i] > _ZERO else _ZERO
            less[i] = seen if count[i] - seen >= fewest else _ZERO
            products[3, first + i] = seen
        for axis in range(np.uint64(2)):
            total[:] = 0
            for j in range(lights):
                for i in range(number):
                    total[i] += gradient[axis, j, first + i] if weights[j, first + i] > _ZERO else _ZERO
            for i in range(number):
                slope = gradient[axis, own, first + i]
                mean[axis, first + i] = (total[i] - less[i] * slope) / max(count[i] - less[i], _ONE)
        for i in range(number):
            seen, x, y = products[3, first + i], gradient[0, own, first + i], gradient[1, own, first + i]
            u, v = mean[0, first + i], mean[1, first + i]
            products[0, first + i] = seen * (x * u + y * v)
            products[1, first + i] = seen * (u * u + v * v)
            products[2, first + i] = seen * (x * x + y * y)


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
