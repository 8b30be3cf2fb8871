"""Single-light captures with known truth for the calibration tests: target x lamp x A, shot and read noise, 12 bit."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from textures import sum_of_cosines

from rgbmidic.frames.data import ChannelFrame, Mosaic, cfa_channels

GAIN, READ, BLACK, WHITE = 4.0, 3.0, 64.0, 4095.0

MATRICES = {  # by rounded condition number
    1.5: np.array([[1, 0.10, 0.02], [0.14, 1, 0.16], [0.03, 0.12, 1]]),
    3.0: np.array([[1, 0.33, 0.10], [0.06, 1, 0.48], [0.01, 0.46, 1]]),
    6.0: np.array([[1, 0.58, 0.12], [0.34, 1, 0.64], [0.06, 0.53, 1]]),
}


def white_target(shape, rng):
    """White card under a lamp from one side: a smooth slope and vignetting, between about 0.5 and 1."""
    y, x = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]
    a, b = rng.uniform(-0.12, 0.12, 2)
    return 0.8 * (1 + a * x + b * y - 0.15 * (x**2 + y**2))


def speckle_target(shape, rng, size=4.2):
    """Black droplets on white paint (albedo 0.1 and 0.8), soft edges, 45 % covered."""
    field = ndimage.gaussian_filter(rng.standard_normal(shape), size / 2.2)
    field = (field - np.quantile(field, 0.45)) / field.std()
    return ndimage.gaussian_filter(0.1 + 0.7 / (1 + np.exp(-12 * field)), 0.5)


def expose(
    picture, column, rng, cfa="RGGB", *, gain=GAIN, read=READ, black=BLACK, white=WHITE, kind="bayer", offset=0.0
):
    """One raw frame of a light whose picture (H, W), or (C, H, W) for one per channel, is in DN of its best channel.

    A column of four entries is that of the sites R, G in rows with red, G in rows with blue, B.
    """
    channels = (
        np.reshape(np.asarray(column, float), (-1, *([1] * (picture.ndim if picture.ndim == 2 else 2)))) * picture
    )
    if kind == "bayer":
        cell = cfa_channels(cfa)
        if len(column) == 4:
            cell = cell + (cell == 2) + ((cell == 1) & (cell == 2).any(axis=1, keepdims=True))
        y, x = np.indices(channels.shape[1:])
        channels = np.take_along_axis(channels, cell[y % 2, x % 2][None], axis=0)[0]
    electrons = rng.poisson(np.maximum(channels, 0) * gain) + rng.normal(0, read * gain, channels.shape)
    values = np.clip(np.rint(electrons / gain + black + offset), 0, white).astype(np.uint16)
    if kind == "bayer":
        return Mosaic(values=values, cfa=cfa, black_level=black, white_level=white)
    return ChannelFrame(values=values, black_level=black, white_level=white)


def captures(
    matrix, rng, *, shape=(256, 256), count=4, target=white_target, level=2500.0, darks=4, cfa="RGGB", **camera
):
    """Captures of every light and dark frames: ({name: frames}, frames)."""
    names = ("red", "green", "blue")[: matrix.shape[1]]
    albedo = target(shape, rng)
    lights = {}
    for index, name in enumerate(names):
        lamp = white_target(shape, rng) / 0.8 if target is not white_target else 1.0
        picture = level * albedo * lamp
        lights[name] = [expose(picture, matrix[:, index], rng, cfa, **camera) for _ in range(count)]
    dark = [expose(np.zeros(shape), matrix[:, 0], rng, cfa, **camera) for _ in range(darks)]
    return lights, dark


def wave_texture(x, y, rng, size=4.2, count=160):
    """A speckle that is known between the pixels too: a sum of waves at points x, y (px), albedo 0.1 to 0.8."""
    wave_x, wave_y = rng.normal(0, 1 / (0.9 * size), (2, count))
    phase = rng.uniform(0, 2 * np.pi, count)
    total = sum_of_cosines(x, y, np.stack([wave_x, wave_y], axis=1), phase)
    return 0.1 + 0.7 / (1 + np.exp(-3 * total / np.sqrt(count / 2)))


def registered_pictures(registration, shape, seed):
    """The target as each light sees it: light j sees at x + rho_j(x) what the first sees at x."""
    y, x = np.indices(shape, dtype=float)
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    pictures = []
    for light in range(len(registration.lights)):
        origin = points
        for _ in range(4):
            origin = points - registration.displacement(origin)[light]
        pictures.append(wave_texture(*origin.T.reshape(2, *shape), np.random.default_rng(seed)))
    return pictures
