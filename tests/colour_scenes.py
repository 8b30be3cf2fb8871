"""Quick synthetic colour frames for the demosaicing tests: exact texture, reflections as channel-specific sparkle."""

from functools import cache

import numpy as np
from naive_demosaic import colour_by_colour
from scipy.ndimage import gaussian_filter

from rgbmidic.frames.data import cfa_channels
from rgbmidic.illumination.crosstalk import Crosstalk, unmix
from rgbmidic.illumination.linear import LinearChannels, LinearMosaic, NoiseModel
from rgbmidic.illumination.separation import DEMOSAICERS, separate

A = np.array([[1, 0.10, 0.02], [0.14, 1, 0.16], [0.03, 0.12, 1]])
CROSSTALK = Crosstalk(matrix=A, lights=("red", "green", "blue"))
FULL_SCALE = 4031.0
NOISE = NoiseModel(gain=4.0, read_noise=3.0)


@cache
def speckle(shape, *, diameter=4.2, seed=0, blur=0.5):
    """Dark discs on white, covering about half, drawn 4 times finer and averaged: values about 0.1 to 0.8."""
    rng, fine = np.random.default_rng(seed), 4
    height, width = (fine * n for n in shape)
    number = int(0.6 * shape[0] * shape[1] / (np.pi / 4 * diameter**2))
    centres = rng.uniform(0, 1, (number, 2)) * [height, width]
    canvas = np.full((height, width), 0.8, dtype=np.float32)
    radius = fine * diameter / 2
    reach = int(radius) + 1
    di, dj = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    for y, x in centres:
        i, j = di + int(y), dj + int(x)
        inside = ((i - y) ** 2 + (j - x) ** 2 < radius**2) & (i >= 0) & (j >= 0) & (i < height) & (j < width)
        canvas[i[inside], j[inside]] = 0.1
    canvas = gaussian_filter(canvas, blur * fine)
    image = canvas.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))
    image.flags.writeable = False  # it is that of every other caller, too
    return image


def sparkle(shape, strength, seed):
    """A reflection: mean `strength`, erratic at the pixel scale."""
    rng = np.random.default_rng(seed)
    rough = gaussian_filter(rng.normal(size=shape), 0.5)
    return strength * np.clip(1 + 0.35 * rough / rough.std(), 0, None)


def mosaic_of(lights, *, cfa="RGGB", seed=0, noise=NOISE, full_scale=FULL_SCALE, matrix=A):
    """The raw frame of lights (3, H, W) in DN, with camera noise and saturation."""
    channels = np.tensordot(matrix, lights, axes=1)
    rows, columns = lights.shape[1:]
    site = np.tile(cfa_channels(cfa), (-(-rows // 2), -(-columns // 2)))[:rows, :columns]
    values = np.take_along_axis(channels, site[None], axis=0)[0]
    if noise is not None:
        rng = np.random.default_rng(seed)
        values = values + rng.normal(size=values.shape) * np.sqrt(noise.variance(values))
    values = np.minimum(values, full_scale).astype(np.float32)
    return LinearMosaic(values=values, saturated=values >= full_scale, cfa=cfa, full_scale=full_scale, noise=noise)


def separated(mosaic, method):
    """The lights by one of `DEMOSAICERS`, by a method of colour-demosaicing, or "colour by colour"."""
    if method in DEMOSAICERS:
        return separate(mosaic, CROSSTALK, method)
    if method == "colour by colour":
        values = colour_by_colour(mosaic.values.astype(float), mosaic.cfa)
    else:
        import colour_demosaicing

        channels = getattr(colour_demosaicing, f"demosaicing_CFA_Bayer_{method}")(mosaic.values, mosaic.cfa)
        values = np.moveaxis(channels, -1, 0)
    valid = np.ones(values.shape, dtype=bool)
    return unmix(LinearChannels(values=values, valid=valid, full_scale=mosaic.full_scale), CROSSTALK)


def error(images, lights, margin=8):
    """Rms error (3,) of the lights found, DN, where they are valid, without the border."""
    inside = np.s_[:, margin:-margin, margin:-margin]
    difference = images.values[inside] - lights[inside]
    return np.sqrt(np.nanmean(difference**2, axis=(1, 2)))
