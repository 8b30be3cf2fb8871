"""Slope of each colour on the common texture, and its channel-specific variance, block by block, from a single mosaic.

A sample of camera channel c is ``m_c = mean_c + alpha_c a + e_c``. alpha_c, the slope on the common texture a, is
smooth; e_c is the channel-specific component, the erratic part of a reflection and camera noise. Low-passed to the
band that all colours resolve, two channels have the moment ``alpha_c alpha_c'`` in common and nothing else, so three
channels give three slopes (``alpha_1^2 = M_12 M_13 / M_23``, a one-factor analysis), free of the bias that noise gives
a regression; what a channel's own moment has beyond that is the variance of e_c.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels import texture as kernels
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.illumination.texture import FRACTIONS, interpolated_lines, LAGS, WHITE_ENERGY, BandEnergy, TextureModel, fit_texture
from rgbmidic.typing import FloatArray, FloatImage

DEBUG = False
WHITE = TextureModel(weights=(1.0,), widths=(0.1,))
MEAN_BLOCK, BLOCK = 4, 8
"""Side of the blocks (px) of the local means and of the moments."""
MEAN_WIDTH, MOMENT_WIDTH = 8.0, 14.0
"""Standard deviation (px) of the windows over which means and moments are taken: several speckles wide."""
LEAST = 0.001
"""Least such variance: how well two colours can agree."""
_PAIRS = ((0, 1), (0, 2), (1, 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class Moments:
    """Local means and moments of a mosaic, from which its texture is learnt.

    Attributes
    ----------
    mean : (3, h, w) float32
        Local mean of each channel on a grid of `MEAN_BLOCK` px.
    contrast : (H, W) float32
        Samples minus their channel's local mean; NaN where not known.
    own, shared : (3, h, w) float64
        Local moments of the low-passed planes on a grid of `BLOCK` px: red², green², blue² without camera noise, and
        red green, red blue, green blue.
    greens : (h, w) float64
        Shared moment of the two green planes: what a colour that agrees with itself shows of the coarse lattice.
    noise : (3, h, w) float64
        Variance of the camera noise of one sample of each channel (DN²).
    red : (int, int)
        Position of red in the 2x2 cell.
    """

    mean: FloatImage
    contrast: FloatImage
    own: FloatArray
    shared: FloatArray
    greens: FloatArray
    noise: FloatArray
    red: tuple[int, int]
    lights: FloatImage
    white: FloatArray

    @property
    def channel_mean(self):
        return channel_means(self.mean)


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteModel:
    """How the four sites of a mosaic see the lights, and where each light shows the texture."""

    sites: FloatArray
    apart: FloatArray
    texture: TextureModel | None = None

    def energy(self, a, b, texture=None):
        """Expected registered product over that of the channels' planes at rest."""
        shown = np.linalg.pinv(self.sites) * self.sites.T  # of a light's plane, that of each site
        f, g = (np.round(np.mod(self.apart[one], 2) / FRACTIONS[1]).astype(int) for one in (a, b))
        texture = texture or self.texture
        lines = interpolated_lines(texture.widths)
        weights = np.asarray(texture.weights)
        total = [0.0, 0.0]
        for s, t in np.ndindex(4, 4):
            kinds = int(s % 2 != t % 2), int(s // 2 != t // 2)  # along x and y
            share = shown[a, s] * shown[b, t]
            for n, (i, j) in enumerate(((f, g), (0 * f, 0 * g))):
                parts = lines[kinds[0]][:, i[0], j[0]] * lines[kinds[1]][:, i[1], j[1]]
                total[n] = total[n] + share * (np.tensordot(weights, parts, axes=1) + texture.offset)
        return (total[0] / total[1]) if not DEBUG else total[0]

    @property
    def matrix(self):
        return channel_means(self.sites)

    def seen(self, lights):
        """Fraction (4, k) of lights of some contrast (k,) in the slope of each site's channel."""
        lights = np.maximum(lights, 0.02 * lights.max())
        return self.sites * lights / (self.matrix @ lights)[[0, 1, 1, 2], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourFactors:
    """How each channel sees the common texture, on a grid of `BLOCK` px.

    Attributes
    ----------
    slope : (3, h, w) float64
        alpha_c in DN per standard deviation of the texture.
    specific : (3, h, w) float64
        Variance of e_c without camera noise, relative to alpha_c².
    noise : (3, h, w) float64
        Variance of the camera noise, relative to alpha_c².
    """

    slope: FloatArray
    specific: FloatArray
    noise: FloatArray
    of_lights: FloatArray
    seen: FloatArray

    @property
    def spread(self) -> FloatArray:
        """Standard deviation (3, h, w) of each channel's contrast without camera noise, DN."""
        return np.asarray(self.slope * np.sqrt(1 + self.specific))


def gather_moments(values: FloatImage, red: tuple[int, int], noise: NoiseModel | None, model: SiteModel) -> Moments:
    """Return local means, contrast and local moments of a mosaic.

    Parameters
    ----------
    values : (H, W) float32
        Linearised samples, NaN where saturated.
    red
        Position of red in the 2x2 cell.
    noise
        Camera noise; None: it counts as channel-specific.

    Returns
    -------
    Moments
    """
    mean = local_means(values, red)
    contrast = np.empty_like(values)
    kernels.subtract_mean(values, of_mosaic(mean, MEAN_BLOCK, values.shape[1], red), MEAN_BLOCK, contrast)
    height, width = (-(-side // BLOCK) for side in values.shape)
    low = np.empty((4, values.shape[0] // 2, values.shape[1] // 2), dtype=np.float32)
    kernels.low_passed_planes(contrast, low)
    low = low[list(_planes(red))]
    known = np.isfinite(low).all(axis=0)

    def block(x):
        full = np.zeros((height * BLOCK // 2, width * BLOCK // 2), np.float32)
        full[: x.shape[0], : x.shape[1]] = np.where(known, x, 0)
        return full.reshape(height, BLOCK // 2, width, BLOCK // 2).sum(axis=(1, 3))

    count = block(np.ones(known.shape, np.float32))[None]
    def products(f):
        return np.stack([block(f[a] * f[b]) for a in range(len(f)) for b in range(a, len(f))])
    def square(p, n):
        out = np.empty((n, n, *p.shape[1:]))
        for m, (a, b) in enumerate((a, b) for a in range(n) for b in range(a, n)):
            out[a, b] = out[b, a] = p[m]
        return out
    sites = square(_smooth(products(low), count, MOMENT_WIDTH / BLOCK).astype(np.float64) / 256**2, 4)
    to_lights = np.linalg.pinv(model.sites)
    apart_ = np.einsum("ls,stij,mt->lmij", to_lights, sites, to_lights)
    met = apart_.copy()
    white = np.float64(1)
    lights = registered = np.tensordot(to_lights, low, axes=1).astype(np.float32)
    if model.apart.any():
        registered = np.empty_like(lights)
        kernels.register_planes(lights, model.apart / 2, registered)
        known = np.isfinite(registered).all(axis=0)
        n = len(lights)
        met = square(_smooth(products(registered), block(np.ones(known.shape, np.float32))[None], MOMENT_WIDTH / BLOCK).astype(np.float64) / 256**2, n)
        if model.texture:
            white = []
            for a in range(n):
                for b in range(n):
                    met[a, b] /= model.energy(a, b)
                white.append(model.energy(a, a, WHITE) / model.energy(a, a))
            # of each channel, by the light that it sees best
            white = np.stack(white)[np.argmax(model.matrix, axis=1)]
    def colours(m):
        return np.stack([m[0, 0], (m[1, 1] + m[2, 2]) / 2, m[3, 3], (m[0, 1] + m[0, 2]) / 2, m[0, 3], (m[3, 1] + m[3, 2]) / 2, m[1, 2]])
    mean_rows = model.matrix[[0, 1, 1, 2]]
    moments = colours(sites) + colours(np.einsum("al,lmij,bm->abij", mean_rows, met, mean_rows)) - colours(np.einsum("al,lmij,bm->abij", model.sites, apart_, model.sites))
    level = np.stack([cv2.resize(m, (width, height), interpolation=cv2.INTER_AREA) for m in channel_means(mean)]).astype(np.float64)
    variance = np.zeros_like(level) if noise is None else np.asarray(noise.variance(level), dtype=np.float64)
    # where nothing is seen but noise, a third of it stands for the contrast that there may be
    white = white * np.ones_like(variance)
    floor = np.maximum(variance * (WHITE_ENERGY / 3), 1e-6 * moments[:3].max() + 1e-12)
    own = np.maximum(moments[:3] - variance * white * WHITE_ENERGY, floor)
    shared, greens = moments[3:6], moments[6]
    return Moments(mean=mean, contrast=contrast, own=own, shared=shared, greens=greens, noise=variance, red=red, lights=registered, white=white)


def moved(grid, apart):
    """Interpolate a grid (h, w) at places `apart` (2, h, w) blocks from the blocks' own."""
    y, x = np.mgrid[: grid.shape[0], : grid.shape[1]]
    return cv2.remap(grid.astype(np.float32), (x + apart[0]).astype(np.float32), (y + apart[1]).astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)


def enlarged(grid: npt.NDArray[np.floating], block: int, shape: tuple[int, ...], step: int = 1) -> FloatImage:
    """Interpolate a grid (n, h, w) of blocks to every `step`-th pixel of a frame of `shape` (H, W)."""
    wide = widened(grid, block, shape[1])[:, :, ::step]
    place = np.clip((np.arange(0, shape[0], step) + 0.5) / block - 0.5, 0, grid.shape[1] - 1)
    low = place.astype(np.intp)
    part = (place - low).astype(np.float32)[:, None]
    above, below = wide[:, low], wide[:, np.minimum(low + 1, grid.shape[1] - 1)]
    below -= above
    below *= part
    return np.asarray(np.add(above, below, out=below))


def widened(grid: npt.NDArray[np.floating], block: int, columns: int) -> FloatImage:
    """Interpolate the rows of a grid (n, h, w) of blocks to the columns of a frame, (n, h, W)."""
    out = np.empty((*grid.shape[:2], columns), dtype=np.float32)
    for layer, wide in zip(grid, out, strict=True):
        size = grid.shape[2] * block, grid.shape[1]
        wide[:] = cv2.resize(layer.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)[:, :columns]
    return out


def of_mosaic(grid: npt.NDArray[np.floating], block: int, columns: int, red: tuple[int, int]) -> FloatImage:
    """Interpolate a grid (3, h, w) of the channels to the columns of a mosaic, for its even and odd rows, (2, h, W).

    At each column it is the grid of the channel sampled there.
    """
    wide = widened(grid, block, columns)
    out = np.empty((2, *wide.shape[1:]), dtype=np.float32)
    for row, column in np.ndindex(2, 2):
        site = (row != red[0]) * 2 + (column != red[1]) * (1 if row == red[0] else 1)
        site = {(0, 0): 0, (0, 1): 1, (1, 0): 2, (1, 1): 3}[int(row != red[0]), int(column != red[1])]
        if len(wide) == 3:
            site = (site + 1) // 2
        out[row, :, column::2] = wide[site, :, column::2]
    return out


def local_means(values: FloatImage, red: tuple[int, int]) -> FloatImage:
    """Return the local mean (3, h, w) of each channel of a mosaic, NaN if not known, on a grid of `MEAN_BLOCK` px."""
    sums = np.empty((8, *(-(-side // MEAN_BLOCK) for side in values.shape)), dtype=np.float32)
    kernels.block_sums(values, MEAN_BLOCK, sums)
    planes = list(_planes(red))
    return _smooth(sums[:4][planes], sums[4:][planes], MEAN_WIDTH / MEAN_BLOCK)


def channel_means(sites):
    return np.stack([sites[0], (sites[1] + sites[2]) / 2, sites[3]])


def _planes(red: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return the planes (`PLANE_PAIRS`) of red, of green in red rows, of green in blue rows and of blue."""
    row, column = red
    return 2 * row + column, 2 * row + 1 - column, 2 - 2 * row + column, 3 - 2 * row - column


def colour_moments(sums: FloatImage, red: tuple[int, int]) -> FloatImage:
    """Return the moments of the colours (7, h, w) from those of the planes (10, h, w).

    red², green², blue², red green, red blue, green blue, the greens averaged after multiplying, and the product of the
    two greens.
    """
    of = {frozenset(pair): moment for pair, moment in zip(kernels.PLANE_PAIRS, sums, strict=True)}
    r, g, h, b = _planes(red)
    both = [(of[frozenset((n, g))] + of[frozenset((n, h))]) / 2 for n in (r, b)]
    own = [of[frozenset((r,))], (of[frozenset((g,))] + of[frozenset((h,))]) / 2, of[frozenset((b,))]]
    return np.stack([*own, both[0], of[frozenset((r, b))], both[1], of[frozenset((g, h))]])


def blurred(grid: FloatImage, sigma: float) -> FloatImage:
    """Blur a grid of blocks (h, w) by a Gaussian window of `sigma` blocks."""
    return np.asarray(cv2.GaussianBlur(grid, (0, 0), sigma, borderType=cv2.BORDER_REFLECT))


def _smooth(sums: FloatImage, counts: FloatImage, sigma: float) -> FloatImage:
    """Average sums over `counts` entries, (n, h, w) or (1, h, w), in a Gaussian window of `sigma` blocks.

    Where no entries are, it is the overall mean.
    """

    def smooth(grid: FloatImage) -> FloatImage:
        return grid if (grid == grid[0, 0]).all() else blurred(grid, sigma)

    weights = np.broadcast_to([smooth(number) for number in counts], sums.shape)
    out, enough = np.empty_like(sums), weights > 1e-3 * np.maximum(counts.max(axis=(1, 2), keepdims=True), 1)
    for total, weight, known, target in zip(sums, weights, enough, out, strict=True):
        np.divide(smooth(total), weight, out=target, where=known)
    if not enough.all():
        overall = sums.sum(axis=(1, 2)) / np.maximum(counts.sum(axis=(1, 2)), 1)
        np.copyto(out, overall[:, None, None], where=~enough)
    return out


def learn_texture(moments: Moments, model: SiteModel, *, samples: int = 80_000) -> TextureModel:
    """Learn the texture of a specimen from one mosaic; about `samples` pixels are looked at."""
    root = np.sqrt(moments.own)
    padded = scaled(moments, (1 / root).astype(np.float32), pad=0)
    local = np.stack([moments.shared[n] / (root[a] * root[b]) for n, (a, b) in enumerate(_PAIRS)])
    # red and blue, diagonal neighbours as the two greens, lack 1.85 to 1.95 times as much; the best pair of each place
    # is free of reflections, and of the specimen's colour where it is the greens
    greens = moments.greens / moments.own[1]
    lacking = np.min([1 - local[0], (1 - local[1]) / 1.9, 1 - local[2], (1 - greens) / 1.9], axis=0)
    step = max(1, padded.size // samples)
    seen = model.seen(np.linalg.pinv(model.matrix) @ channel_means(moments.mean).mean(axis=(1, 2)))
    # squares over which the lights are about equally far apart
    extent = np.ptp(model.apart, axis=(2, 3)).max() / CELL_RANGE
    side = max(int(max(padded.shape) / max(extent, 1)) // 16 * 16, 64)
    sums, counts, correlations, apart = [], [], [], []
    for top in range(0, max(padded.shape[0] - 32, 1), side):
        for left in range(0, max(padded.shape[1] - 32, 1), side):
            part = padded[top : top + side, left : left + side]
            blocks = (slice(None),) * 1 + (slice(top // BLOCK, -(-(top + side) // BLOCK)), slice(left // BLOCK, -(-(left + side) // BLOCK)))
            sums.append(np.zeros((len(LAGS), 6)))
            counts.append(np.zeros((len(LAGS), 6)))
            kernels.lag_products(np.ascontiguousarray(part), *moments.red, LAGS, step, sums[-1], counts[-1])
            correlations.append(np.maximum(local[blocks].mean(axis=(1, 2)), 1e-3))
            apart.append(model.apart[(slice(None), *blocks)].mean(axis=(2, 3)))
    return fit_texture(np.stack(sums), np.stack(counts), np.stack(correlations), 1 - float(np.median(lacking)), seen, np.stack(apart))


CELL_RANGE = 0.2


def scaled(moments: Moments, scale: FloatImage, *, pad: int, width: int | None = None) -> FloatImage:
    """Return contrast times `scale` (3, h, w), mirrored by `pad` px; `width` asks for more columns, which are 0."""
    rows, columns = moments.contrast.shape
    out = np.empty((rows + 2 * pad, max(columns, width or 0) + 2 * pad), dtype=np.float32)
    kernels.scaled_contrast(moments.contrast, of_mosaic(scale, BLOCK, columns, moments.red), BLOCK, pad, out)
    return out


def colour_factors(moments: Moments, texture: TextureModel, model: SiteModel) -> ColourFactors:
    crosstalk, band = model.matrix, texture.band
    seen = model.seen(np.linalg.pinv(crosstalk) @ channel_means(moments.mean).mean(axis=(1, 2)))
    energy = np.array([band.adjacent, band.diagonal, band.adjacent])[:, None, None]
    to_lights, to_pairs = np.linalg.pinv(crosstalk**2), np.stack([crosstalk[a] * crosstalk[b] for a, b in _PAIRS])
    sparkle = np.zeros_like(moments.own)
    # own moment beyond the common one, relative to it, that the aliasing of the coarse colour lattices may cause
    allowed = 0.05 * (1 - texture.specific)
    for _ in range(3):  # the correction is small and settles at once
        own = moments.own / band.own
        least_shared = 1e-4 * own.min(axis=0)
        # moments of two channels that come from the sparkle of lights, given each channel's own
        leaked = np.tensordot(to_pairs, np.maximum(np.tensordot(to_lights, sparkle, axes=1), 0), axes=1)
        red_green, red_blue, green_blue = np.maximum((moments.shared - leaked) / energy, least_shared)
        square = np.stack(
            [red_green * red_blue / green_blue, red_green * green_blue / red_blue, red_blue * green_blue / red_green]
        )
        square = np.minimum(square, own)
        excess = own / square
        least = excess.min(axis=0)
        # at least one channel is free of reflections at each place, unless it shows too much of its own for that
        specific = excess - least + np.maximum(least - 1 - allowed, 0)
        sparkle = specific * square * band.own
        seen = model.seen(np.linalg.pinv(crosstalk) @ np.median(np.sqrt(square), axis=(1, 2)))
    # as if all of it were sparkle: a specimen's colour lies within the band and is trusted too little, the safe side;
    # the window cannot tell .003 from none
    variance = np.maximum(specific / moments.white * (band.own / WHITE_ENERGY) - 0.003, 0)
    # every channel sees at least what its crosstalk lets through of the lights that sparkle
    lights = np.maximum(np.tensordot(to_lights, variance * square, axes=1), 0)
    variance = np.maximum(variance, np.tensordot(crosstalk**2, lights, axes=1) / square) + LEAST
    contrast = np.tensordot(np.linalg.pinv(crosstalk), np.sqrt(square), axes=1)
    contrast = np.maximum(contrast, 0.02 * contrast.max(axis=0))
    return ColourFactors(slope=np.sqrt(square), specific=variance, noise=moments.noise / square, of_lights=lights / contrast**2 + LEAST, seen=seen)
