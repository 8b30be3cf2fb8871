"""Slow, obvious twins of the demosaicing kernels."""

import numpy as np

from rgbmidic.frames.data import cfa_channels


def site_channels(shape, cfa):
    """Channel sampled at every pixel."""
    cell = cfa_channels(cfa)
    return np.array([[cell[i % 2, j % 2] for j in range(shape[1])] for i in range(shape[0])])


def mirrored(index, size):
    """Whole-sample mirror of an index outside the image."""
    while not 0 <= index < size:
        index = -index if index < 0 else 2 * (size - 1) - index
    return index


def sample(values, i, j):
    return values[mirrored(i, values.shape[0]), mirrored(j, values.shape[1])]


def bilinear(values, cfa):
    """Average of the nearest samples of each channel; a NaN sample spreads to what it takes part in."""
    channels = site_channels(values.shape, cfa)
    out = np.empty((3, *values.shape))
    for (i, j), own in np.ndenumerate(channels):
        for channel in range(3):
            if channel == own:
                out[channel, i, j] = values[i, j]
                continue
            near = [(di, dj) for di in (-1, 0, 1) for dj in (-1, 0, 1) if sample(channels, i + di, j + dj) == channel]
            closest = min(abs(di) + abs(dj) for di, dj in near)
            near = [(di, dj) for di, dj in near if abs(di) + abs(dj) == closest]
            out[channel, i, j] = np.mean([sample(values, i + di, j + dj) for di, dj in near])
    return out


GREEN = np.array([[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]]) / 8
ACROSS = np.array([[0, 0, 1, 0, 0], [0, -2, 0, -2, 0], [-2, 8, 10, 8, -2], [0, -2, 0, -2, 0], [0, 0, 1, 0, 0]]) / 16
DIAGONAL = np.array([[0, 0, -3, 0, 0], [0, 4, 0, 4, 0], [-3, 0, 12, 0, -3], [0, 4, 0, 4, 0], [0, 0, -3, 0, 0]]) / 16


def malvar(values, cfa):
    """Figure 2 of Malvar, He, Cutler (2004), filter by filter; zero coefficients touch nothing."""
    channels = site_channels(values.shape, cfa)
    out = np.empty((3, *values.shape))
    for (i, j), own in np.ndenumerate(channels):
        for channel in range(3):
            if channel == own:
                out[channel, i, j] = values[i, j]
                continue
            if channel == 1:
                taps = GREEN
            elif own != 1:
                taps = DIAGONAL
            else:
                taps = ACROSS if sample(channels, i, j + 1) == channel else ACROSS.T
            terms = [taps[a, b] * sample(values, i + a - 2, j + b - 2) for a, b in np.argwhere(taps)]
            out[channel, i, j] = np.sum(terms)
    return out
