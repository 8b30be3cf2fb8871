"""Slow, obvious twins of the kernels that gather the colours' common texture and predict from it."""

import numpy as np
from naive_demosaic import mirrored, site_channels


def between(grid, row, column, block):
    """Grid of block values at a pixel: linear between the blocks' centres, constant beyond the outermost."""
    position = [min(max((p + 0.5) / block - 0.5, 0), n - 1) for p, n in zip((row, column), grid.shape, strict=True)]
    low = [int(p) for p in position]
    high = [min(p + 1, n - 1) for p, n in zip(low, grid.shape, strict=True)]
    part = [p - q for p, q in zip(position, low, strict=True)]
    upper = grid[low[0], low[1]] * (1 - part[1]) + grid[low[0], high[1]] * part[1]
    lower = grid[high[0], low[1]] * (1 - part[1]) + grid[high[0], high[1]] * part[1]
    return upper * (1 - part[0]) + lower * part[0]


def block_sums(values, block):
    shape = (4, *(-(-n // block) for n in values.shape))
    sums, counts = np.zeros(shape), np.zeros(shape)
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            sums[2 * (i % 2) + j % 2, i // block, j // block] += value
            counts[2 * (i % 2) + j % 2, i // block, j // block] += 1
    return sums, counts


def subtract_mean(values, mean, cfa, block):
    channels = site_channels(values.shape, cfa)
    out = np.empty(values.shape)
    for (i, j), value in np.ndenumerate(values):
        out[i, j] = value - between(mean[channels[i, j]], i, j, block)
    return out


def scaled_contrast(contrast, scale, cfa, block, pad, width):
    rows, columns = contrast.shape
    channels = site_channels(contrast.shape, cfa)
    out = np.zeros((rows + 2 * pad, width))
    for p in range(rows + 2 * pad):
        for q in range(columns + 2 * pad):
            i, j = mirrored(p - pad, rows), mirrored(q - pad, columns)
            out[p, q] = contrast[i, j] * between(scale[channels[i, j]], i, j, block)
    return out


def cell_moments(contrast, cfa, block):
    """At the middle of each cell, each plane's samples within 2.5 px weighted by the binomial of their distance."""
    rows, columns = contrast.shape
    channels = site_channels(contrast.shape, cfa)
    weight = {-2: 1, -1: 5, 0: 10, 1: 10, 2: 5, 3: 1}
    red_row = 0 if 0 in channels[0] else 1
    shape = (-(-rows // block), -(-columns // block))
    sums, counts = np.zeros((7, *shape)), np.zeros(shape)
    for i in range(2, rows - 3, 2):
        for j in range(2, columns - 3, 2):
            planes = np.zeros(4)
            for di, wi in weight.items():
                for dj, wj in weight.items():
                    channel = channels[i + di, j + dj]
                    plane = {0: 0, 2: 3}.get(channel, 1 if (i + di) % 2 == red_row else 2)
                    planes[plane] += wi * wj * contrast[i + di, j + dj]
            if not np.isfinite(planes).all():
                continue
            r, g1, g2, b = planes
            g = (g1 + g2) / 2
            own, greens = [r * r, (g1 * g1 + g2 * g2) / 2, b * b], g1 * g2
            sums[:, i // block, j // block] += [*own, r * g, r * b, g * b, greens]
            counts[i // block, j // block] += 1
    return sums, counts


def lag_products(contrast, cfa, lags, step):
    channels = site_channels(contrast.shape, cfa)
    rows, columns = contrast.shape
    sums, counts = np.zeros((len(lags), 6)), np.zeros((len(lags), 6))
    for n, (di, dj) in enumerate(lags):
        for i in range(2 * (rows // 2)):
            if (i // 2) % step or i + di >= rows:
                continue
            for j in range(columns):
                if not 0 <= j + dj < columns:
                    continue
                a, b = sorted((channels[i, j], channels[i + di, j + dj]))
                kind = a if a == b else {(0, 1): 3, (0, 2): 4, (1, 2): 5}[a, b]
                product = contrast[i, j] * contrast[i + di, j + dj]
                if np.isfinite(product):
                    sums[n, kind] += product
                    counts[n, kind] += 1
    return sums, counts


def predict(padded, index, taps, size, scale, scale_block, mean, mean_block, shape, tile):
    out = np.empty((taps.shape[2], *shape))
    for n, i, j in np.ndindex(out.shape):
        filters = taps[index[i // tile, j // tile], i % 2, n, :, j % tile].reshape(size, size)
        value = (filters * padded[i : i + size, j : j + size]).sum()
        out[n, i, j] = between(mean[n], i, j, mean_block) + between(scale[n], i, j, scale_block) * value
    return out


def common_slopes(variance, covariance, energy, allowed, to_lights, to_pairs):
    """Squares of the channels' slopes on the common texture, and their own variances relative to them."""
    sparkle, least = np.zeros_like(variance), 1e-4 * variance.min(axis=0)
    for _ in range(2):
        leaked = np.tensordot(to_pairs, np.maximum(np.tensordot(to_lights, sparkle, axes=1), 0), axes=1)
        rg, rb, gb = np.maximum((covariance - leaked) / energy[:, None, None], least)
        square = np.minimum(np.stack([rg * rb / gb, rg * gb / rb, rb * gb / rg]), variance)
        excess = variance / square
        specific = excess - excess.min(axis=0) + np.maximum(excess.min(axis=0) - 1 - allowed, 0)
        sparkle = specific * square
    return square, specific
