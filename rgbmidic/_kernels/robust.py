"""Compiled loops over the owned pixels that make weights and scores from the lights' residuals."""

import numpy as np

from rgbmidic._kernels.compilation import compiled
from rgbmidic._kernels.interpolation import _FAST
from rgbmidic._kernels.threads import over_ranges

__all__ = ["best_mean", "robust_weights", "scores"]

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_CHUNK = 4096
"""Pixels at a time: what a core's fastest cache holds."""


@over_ranges("share", axis=1, grain=_CHUNK)
@compiled(fastmath=_FAST)
def best_mean(start, stop, share, weights, difference, mean, used):
    """Turn `share` (k, P) into the shares of the lights in a mean: none below 0 or without weight, their sum 1.

    `mean` (P,) receives that of `difference` (k, P), `used` (P,) 1 where a light has a share and else 0.
    """
    for first in range(start, stop, _CHUNK):
        chunk = slice(first, min(first + _CHUNK, stop))
        total, result = used[chunk], mean[chunk]
        total[:] = 0
        result[:] = 0
        for light in range(len(share)):
            own, weight = share[light, chunk], weights[light, chunk]
            for i in range(np.uint64(total.size)):
                own[i] = max(own[i], _ZERO) if weight[i] > _ZERO else _ZERO
                total[i] += own[i]
        for light in range(len(share)):
            own, value = share[light, chunk], difference[light, chunk]
            for i in range(np.uint64(total.size)):
                own[i] = own[i] / total[i] if total[i] > _ZERO else _ZERO
                result[i] += own[i] * value[i]
        for i in range(np.uint64(total.size)):
            total[i] = _ONE if total[i] > _ZERO else _ZERO


@over_ranges("share", axis=1, grain=_CHUNK)
@compiled(fastmath=_FAST)
def robust_weights(start, stop, mean, variance, trusted, unit, freedom, share, bend):
    """Multiply `share` (k, P) by the robust weight of the lights' `mean` residual (P,); the loss's `bend` (P,).

    Its `variance` (P,) is that around the pixel, `trusted` (P,) the part of it that counts, in units of `unit`; the
    weight is its inverse to the power .75 times that of a Student distribution of so many degrees of `freedom`.
    """
    factor = np.empty(_CHUNK, dtype=np.float32)
    for first in range(start, stop, _CHUNK):
        chunk = slice(first, min(first + _CHUNK, stop))
        value, around, reliable, curved = mean[chunk], variance[chunk], trusted[chunk], bend[chunk]
        for i in range(np.uint64(value.size)):
            ratio = value[i] * value[i] / around[i]
            precision = unit / reliable[i]
            curved[i] = (freedom - ratio) / (freedom + ratio)
            factor[i] = np.sqrt(precision * np.sqrt(precision)) * (freedom + _ONE) / (freedom + ratio)
        for light in range(len(share)):
            own = share[light, chunk]
            for i in range(np.uint64(own.size)):
                own[i] *= factor[i]


@over_ranges("out", axis=1, grain=_CHUNK)
@compiled(fastmath=_FAST)
def scores(start, stop, residual, weights, gradient_x, gradient_y, out):
    """Sums over the lights of ``w r gx``, ``w r gy`` and ``w (gx gx + gy gy)``, and 1 where one of them has weight,
    else 0: ``out`` (4, P) from fields (k, P)."""
    for first in range(start, stop, _CHUNK):
        chunk = slice(first, min(first + _CHUNK, stop))
        x, y, information, used = out[0, chunk], out[1, chunk], out[2, chunk], out[3, chunk]
        out[:, chunk] = 0
        for light in range(len(weights)):
            r, w = residual[light, chunk], weights[light, chunk]
            gx, gy = gradient_x[light, chunk], gradient_y[light, chunk]
            # loops that write to one place each: a loop over many arrays is not vectorised
            for i in range(np.uint64(x.size)):
                x[i] += w[i] * r[i] * gx[i]
            for i in range(np.uint64(x.size)):
                y[i] += w[i] * r[i] * gy[i]
            for i in range(np.uint64(x.size)):
                information[i] += w[i] * (gx[i] * gx[i] + gy[i] * gy[i])
            for i in range(np.uint64(x.size)):
                used[i] = max(used[i], _ONE if w[i] > _ZERO else _ZERO)
