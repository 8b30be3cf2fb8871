"""Slow, obvious twins of the demosaicing kernels, and a method to compare with."""

import numpy as np

from rgbmidic.frames.data import cfa_channels, shift_cfa


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


REACH = 5
"""Pixels around from which `colour_by_colour` takes samples."""
WIDTHS = (3.0, 2.0, 3.0)
"""Standard deviation (px) of the autocorrelation that each colour is predicted with: what its lattice resolves."""


def colour_by_colour(values, cfa):
    """Every colour (3, H, W) predicted from its own samples alone: no leak between colours, coarse lattices."""
    out = np.empty((3, *values.shape))
    offset = np.arange(-REACH, REACH + 1)
    points = np.stack(np.meshgrid(offset, offset, indexing="ij"), -1).reshape(-1, 2)
    padded = np.pad(values, REACH, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * REACH + 1,) * 2)
    for row, column, colour in np.ndindex(2, 2, 3):
        site = site_channels((2 * REACH + 2,) * 2, shift_cfa(cfa, (row - REACH) % 2, (column - REACH) % 2))
        own = (site[:-1, :-1] == colour).ravel()
        apart = np.linalg.norm(points[own][:, None] - points[own][None], axis=-1)
        # an unknown mean of large variance makes the coefficients sum to one
        covariance = np.exp(-0.5 * (apart / WIDTHS[colour]) ** 2) + 10 + 1e-4 * np.eye(own.sum())
        wanted = np.exp(-0.5 * (np.linalg.norm(points[own], axis=-1) / WIDTHS[colour]) ** 2) + 10
        taps = np.linalg.solve(covariance, wanted)
        samples = windows[row::2, column::2].reshape(*windows[row::2, column::2].shape[:2], -1)[..., own]
        out[colour, row::2, column::2] = samples @ (taps / taps.sum())
    return out
