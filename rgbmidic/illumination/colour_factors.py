"""Slope of each colour on the common texture, and its channel-specific variance, block by block, from a single mosaic.

A site of kind s at y records ``sum_l A_sl L_l(y)``. Light l shows the texture a of the specimen where the lens puts it,
``L_l(y) = mean_l + alpha_l a(y - d_l(y)) + e_l(y)``: the displacement d_l is the calibrated lateral colour, and e_l the
light's own component, the erratic part of a reflection. The two kinds of green differ by what leaks into them
(`MosaicModel`).

A sample of camera channel c is ``m_c = mean_c + alpha_c a + e_c``. alpha_c, the slope on the common texture a, is
smooth; e_c is the channel-specific component, the erratic part of a reflection and camera noise. Low-passed to the
band that all colours resolve, two channels have the moment ``alpha_c alpha_c'`` in common and nothing else, so three
channels give three slopes (``alpha_1^2 = M_12 M_13 / M_23``, a one-factor analysis), free of the bias that noise gives
a regression; what a channel's own moment has beyond that is the variance of e_c.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels import texture as kernels
from rgbmidic._kernels.illumination import common_slopes
from rgbmidic.errors import InputError
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.illumination.texture import (
    DISPLACEMENTS,
    LAGS,
    PAIRS,
    WHITE_ENERGY,
    LagProducts,
    TextureModel,
    fit_texture,
    lanczos_weights,
    registered_lines,
)
from rgbmidic.typing import FloatArray, FloatImage

Number = TypeVar("Number", bound=np.floating)
BLOCK = 8
"""Side of the blocks (px) of the grid."""
CHANNEL = (0, 1, 1, 2)
"""Channel of each kind of site: red, green in red rows, green in blue rows, blue."""
FAINTEST = 0.02
"""Least contrast of a light, relative to the largest one: what a filter is made for."""
_COARSE = 4
"""Blocks over which the displacement changes so little that the energy of registered planes is interpolated."""
MEAN_BLOCK = 4
"""Side of the blocks (px) of the local means."""
MEAN_WIDTH, MOMENT_WIDTH = 8.0, 14.0
"""Standard deviation (px) of the windows over which means and moments are taken: several speckles wide."""
MIN_SPECIFIC = 0.001
"""Least channel-specific variance: how well two colours can agree."""
_BETWEEN = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
EQUALLY_APART = 0.2
"""Range (px) of the lights' displacement within the squares whose products of samples are taken together."""


def channel_means(sites: npt.NDArray[Number]) -> npt.NDArray[Number]:
    """Return what the channels have (3, ...) from what the sites have (4, ...): green is the mean of its two."""
    return np.stack([sites[0], (sites[1] + sites[2]) / sites.dtype.type(2), sites[3]])


@dataclass(frozen=True, slots=True, kw_only=True)
class MosaicModel:
    """The response of the sites to the lights, and the displacement at which each light shows the texture.

    Attributes
    ----------
    sites : ndarray, shape (4, k)
        Response A of red, green in red rows, green in blue rows and blue to each light.
    displacement : ndarray, shape (k, 2, h, w)
        Place (x, y) at which a light shows the texture, from the mean place of all, px on the grid of `BLOCK` px.
    """

    sites: FloatArray
    displacement: FloatArray

    @classmethod
    def of(cls, crosstalk: Crosstalk | None, registration: Registration | None, shape: tuple[int, ...]) -> MosaicModel:
        """Return the model of frames of `shape` (rows, columns).

        Parameters
        ----------
        crosstalk
            None: each channel sees a light of its own.
        registration
            None: all lights show the texture at the same place.
        shape
            Rows and columns of the frame.

        Returns
        -------
        MosaicModel

        Raises
        ------
        InputError
            Crosstalk and registration are of different numbers of lights.
        """
        sites = np.eye(3)[list(CHANNEL)] if crosstalk is None else crosstalk.sites
        rows, columns = (-(-side // BLOCK) for side in shape)
        displacement = np.zeros((sites.shape[1], 2, rows, columns))
        if registration is not None:
            if len(registration.lights) != sites.shape[1]:
                raise InputError(
                    f"the registration is of {len(registration.lights)} lights, the crosstalk of {sites.shape[1]}"
                )
            y, x = np.mgrid[:rows, :columns].reshape(2, -1) * BLOCK + (BLOCK - 1) / 2
            positions = registration.displacement(np.stack([x, y], axis=1)).reshape(-1, rows, columns, 2)
            displacement = np.moveaxis(positions - positions.mean(axis=0), 3, 1)
        return cls(sites=sites, displacement=displacement)

    @property
    def matrix(self) -> FloatArray:
        """Response (3, k) of the channels."""
        return channel_means(self.sites)

    @property
    def in_register(self) -> bool:
        """Tell whether all lights show the texture at one place, and the greens are alike."""
        return not self.displacement.any() and np.array_equal(self.sites[1], self.sites[2])

    def light_fraction(self, contrast: FloatArray) -> FloatArray:
        """Return the fraction (4, k) of each light in the slope of each site's channel on the texture.

        Parameters
        ----------
        contrast : ndarray, shape (k,)
            Slopes alpha of the lights. They are rounded to an eighth of an octave, so that frames share filters.

        Returns
        -------
        ndarray, shape (4, k)
        """
        relative = np.maximum(contrast / max(contrast.max(), 1e-12), FAINTEST)
        rounded = np.exp2(np.round(8 * np.log2(relative)) / 8)
        return np.asarray(self.sites * rounded / (self.matrix @ rounded)[list(CHANNEL), None])

    def registered_energy(self, texture: TextureModel) -> FloatArray:
        """Second moments (k, k, h, w) of the lights' planes read at one place, over those of lights not displaced.

        A plane is a lattice of one sample in 2 x 2 px, and interpolation takes the finest of its texture.
        """
        fractions = np.linalg.pinv(self.sites) * self.sites.T  # of a light's plane, what each site contributes
        count, rows, columns = len(fractions), *self.displacement.shape[2:]
        size = -(-columns // _COARSE), -(-rows // _COARSE)
        coarse = [
            [cv2.resize(d, size, interpolation=cv2.INTER_AREA) for d in light_displacement]
            for light_displacement in self.displacement
        ]
        entry = np.round(np.mod(coarse, 2) / DISPLACEMENTS[1]).astype(np.intp)
        lines, weights = registered_lines(texture.widths), np.asarray(texture.weights)
        # whether two sites lie in different columns, and rows, of the cell
        kinds = [[(int(s % 2 != t % 2), int(s // 2 != t // 2)) for t in range(4)] for s in range(4)]
        energy = np.empty((count, count, rows, columns))
        for a, b in zip(*np.triu_indices(count), strict=True):
            fraction, registered, energy_at_rest = np.zeros((2, 2)), np.zeros(size[::-1]), 0.0
            np.add.at(fraction, tuple(np.moveaxis(np.array(kinds), 2, 0)), np.outer(fractions[a], fractions[b]))
            for (x, y), weight in np.ndenumerate(fraction):
                products = lines[x][:, entry[a, 0], entry[b, 0]] * lines[y][:, entry[a, 1], entry[b, 1]]
                registered += weight * (np.tensordot(weights, products, axes=1) + texture.offset)
                energy_at_rest += weight * float(weights @ (lines[x][:, 0, 0] * lines[y][:, 0, 0]) + texture.offset)
            energy[a, b] = energy[b, a] = cv2.resize(
                registered / energy_at_rest, (columns, rows), interpolation=cv2.INTER_LINEAR
            )
        return energy


@dataclass(frozen=True, slots=True, kw_only=True)
class Moments:
    """Local means and moments of a mosaic, from which its texture is learnt.

    Attributes
    ----------
    mean : (4, h, w) float32
        Local mean of each kind of site on a grid of `MEAN_BLOCK` px.
    contrast : (H, W) float32
        Samples minus their site's local mean; NaN where not known.
    variance, covariance : (3, h, w) float64
        Local moments of the low-passed planes on a grid of `BLOCK` px, as they would be with the lights in register and
        one kind of green: red², green², blue² without camera noise, and red green, red blue, green blue.
    greens : (h, w) float64
        Shared moment of the two green planes: what a colour that agrees with itself shows of the coarse lattice.
    noise : (3, h, w) float64
        Variance of the camera noise of one sample of each channel (DN²).
    red : (int, int)
        Position of red in the 2x2 cell.
    lights : (k, H // 2, W // 2) float32
        Low-passed planes of the lights, in register.
    """

    mean: FloatImage
    contrast: FloatImage
    variance: FloatArray
    covariance: FloatArray
    greens: FloatArray
    noise: FloatArray
    red: tuple[int, int]
    lights: FloatImage

    @property
    def channel_mean(self) -> FloatImage:
        """Local mean (3, h, w) of each channel."""
        return channel_means(self.mean)


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourFactors:
    """The slopes of channels and lights on the common texture, and what they show beside it, on a grid of `BLOCK` px.

    Attributes
    ----------
    slope : (3, h, w) float64
        alpha_c in DN per standard deviation of the texture.
    specific : (3, h, w) float64
        Variance of e_c without camera noise, relative to alpha_c².
    noise : (3, h, w) float64
        Variance of the camera noise, relative to alpha_c².
    light_slope, light_specific : (k, h, w) float64
        The same of the lights.
    light_fraction : (4, k) float64
        Fraction of each light in the slope of each site's channel, over the frame.
    """

    slope: FloatArray
    specific: FloatArray
    noise: FloatArray
    light_slope: FloatArray
    light_specific: FloatArray
    light_fraction: FloatArray

    @property
    def spread(self) -> FloatArray:
        """Standard deviation (3, h, w) of each channel's contrast without camera noise, DN."""
        return np.asarray(self.slope * np.sqrt(1 + self.specific))


def gather_moments(
    values: FloatImage,
    red: tuple[int, int],
    noise: NoiseModel | None,
    model: MosaicModel,
    texture: TextureModel | None = None,
) -> Moments:
    """Return local means, contrast and local moments of a mosaic.

    Parameters
    ----------
    values : (H, W) float32
        Linearised samples, NaN where saturated.
    red
        Position of red in the 2x2 cell.
    noise
        Camera noise; None: it counts as channel-specific.
    model
        How the sites see the lights, and where each shows the texture.
    texture
        With which what the lattices cannot see of displaced lights is taken into account; None: it is not.

    Returns
    -------
    Moments
    """
    mean = local_means(values, red)
    contrast = np.empty_like(values)
    kernels.subtract_mean(values, interleave_bayer(mean, MEAN_BLOCK, values.shape[1], red), MEAN_BLOCK, contrast)
    height, width = (-(-side // BLOCK) for side in values.shape)
    to_lights = np.asarray(np.linalg.pinv(model.sites), dtype=np.float64)
    half = (values.shape[0] // 2, values.shape[1] // 2)
    planes, lights = np.empty((4, *half), dtype=np.float32), np.empty((len(to_lights), *half), dtype=np.float32)
    kernels.low_passed_planes(contrast, np.argsort(_planes(red)), to_lights.astype(np.float32), planes, lights)
    by_site = _second_moments(planes, (height, width))
    moments = _channel_moments(by_site)
    if not model.in_register:
        by_light = _transformed(to_lights, by_site)
        unregistered = _transformed(model.sites, by_light)
        if model.displacement.any():
            registered = np.empty_like(lights)
            kernels.register_planes(lights, model.displacement / 2, lanczos_weights(), registered)
            lights, by_light = registered, _second_moments(registered, (height, width))
            if texture is not None:
                by_light /= model.registered_energy(texture)
        rows = model.matrix[list(CHANNEL)]
        moments += _channel_moments(_transformed(rows, by_light) - unregistered)
    level = [cv2.resize(m, (width, height), interpolation=cv2.INTER_AREA) for m in channel_means(mean)]
    noise_variance = np.zeros((3, height, width))
    if noise is not None:
        noise_variance = np.asarray(noise.variance(np.stack(level).astype(np.float64)))
    # where nothing is seen but noise, a third of it stands for the contrast that there may be
    floor = np.maximum(noise_variance * (WHITE_ENERGY / 3), 1e-6 * moments[:3].max() + 1e-12)
    return Moments(
        mean=mean,
        contrast=contrast,
        variance=np.maximum(moments[:3] - noise_variance * WHITE_ENERGY, floor),
        covariance=moments[3:6],
        greens=moments[6],
        noise=noise_variance,
        red=red,
        lights=lights,
    )


def _transformed(matrix: FloatArray, moments: FloatArray) -> FloatArray:
    """Return the moments (m, m, h, w) of what a matrix (m, n) makes of planes of moments (n, n, h, w)."""
    rows, shape = len(matrix), moments.shape[2:]
    return np.asarray((np.kron(matrix, matrix) @ moments.reshape(matrix.shape[1] ** 2, -1)).reshape(rows, rows, *shape))


def _second_moments(planes: FloatImage, grid: tuple[int, int]) -> FloatArray:
    """Return the local moments (n, n, h, w) of any two of n low-passed planes."""
    count = len(planes)
    sums = np.empty((count * (count + 1) // 2 + 1, *grid), dtype=np.float32)
    kernels.plane_products(planes, kernels.CELLS, sums)
    # the binomial weights of a plane sum to 256 in the kernel
    moments = _smooth(sums[:-1], sums[-1:], MOMENT_WIDTH / BLOCK).astype(np.float64) / 256**2
    pairs = np.zeros((count, count), dtype=np.intp)
    pairs[np.triu_indices(count)] = np.arange(len(moments))
    return np.asarray(moments[np.maximum(pairs, pairs.T)])


def upsample(grid: npt.NDArray[np.floating], block: int, shape: tuple[int, ...], step: int = 1) -> FloatImage:
    """Interpolate a grid (n, h, w) of blocks to every `step`-th pixel of a frame of `shape` (H, W)."""
    wide = upsample_rows(grid, block, shape[1])[:, :, ::step]
    position = np.clip((np.arange(0, shape[0], step) + 0.5) / block - 0.5, 0, grid.shape[1] - 1)
    low = position.astype(np.intp)
    fraction = (position - low).astype(np.float32)[:, None]
    above, below = wide[:, low], wide[:, np.minimum(low + 1, grid.shape[1] - 1)]
    below -= above
    below *= fraction
    return np.asarray(np.add(above, below, out=below))


def upsample_rows(grid: npt.NDArray[np.floating], block: int, columns: int) -> FloatImage:
    """Interpolate the rows of a grid (n, h, w) of blocks to the columns of a frame, (n, h, W)."""
    out = np.empty((*grid.shape[:2], columns), dtype=np.float32)
    for layer, wide in zip(grid, out, strict=True):
        size = grid.shape[2] * block, grid.shape[1]
        wide[:] = cv2.resize(layer.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)[:, :columns]
    return out


def interleave_bayer(grid: npt.NDArray[np.floating], block: int, columns: int, red: tuple[int, int]) -> FloatImage:
    """Interpolate a grid (4, h, w) of the sites to the columns of a mosaic, for its even and odd rows, (2, h, W).

    At each column it is the grid of the site there. A grid (3, h, w) is of the channels.
    """
    wide = upsample_rows(grid, block, columns)
    out = np.empty((2, *wide.shape[1:]), dtype=np.float32)
    for site, plane in enumerate(_planes(red)):
        row, column = divmod(plane, 2)
        out[row, :, column::2] = wide[site if len(grid) == 4 else CHANNEL[site], :, column::2]
    return out


def local_means(values: FloatImage, red: tuple[int, int]) -> FloatImage:
    """Return the local mean (4, h, w) of each site of a mosaic, NaN if not known, on a grid of `MEAN_BLOCK` px."""
    sums = np.empty((8, *(-(-side // MEAN_BLOCK) for side in values.shape)), dtype=np.float32)
    kernels.block_sums(values, MEAN_BLOCK, sums)
    order = list(_planes(red))
    means = _smooth(sums[:4][order], sums[4:][order], MEAN_WIDTH / MEAN_BLOCK)
    for plane, mean in zip(order, means, strict=True):  # from the middle of a site's samples to that of the block
        row, column = np.array(divmod(plane, 2)) - 0.5
        shift = np.array([[1, 0, -column / MEAN_BLOCK], [0, 1, -row / MEAN_BLOCK]])
        mean[:] = cv2.warpAffine(mean, shift, mean.shape[::-1], flags=_BETWEEN, borderMode=cv2.BORDER_REPLICATE)
    return means


def _planes(red: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return the planes ``2 a + b`` of red, of green in red rows, of green in blue rows and of blue."""
    row, column = red
    return 2 * row + column, 2 * row + 1 - column, 2 - 2 * row + column, 3 - 2 * row - column


def _channel_moments(sites: FloatArray) -> FloatArray:
    """Return the moments of the channels (7, h, w) from those of any two sites (4, 4, h, w).

    red², green², blue², red green, red blue, green blue, the greens averaged after multiplying, and the product of the
    two greens.
    """
    (rr, rg, rh, rb), (_, gg, gh, gb), (_, _, hh, hb), (*_, bb) = sites
    return np.stack([rr, (gg + hh) / 2, bb, (rg + rh) / 2, rb, (gb + hb) / 2, gh])


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
    for total, weight, has_entries, target in zip(sums, weights, enough, out, strict=True):
        np.divide(smooth(total), weight, out=target, where=has_entries)
    if not enough.all():
        overall = sums.sum(axis=(1, 2)) / np.maximum(counts.sum(axis=(1, 2)), 1)
        np.copyto(out, overall[:, None, None], where=~enough)
    return out


def learn_texture(moments: Moments, model: MosaicModel, *, samples: int = 80_000) -> TextureModel:
    """Learn the texture of a specimen from one mosaic; about `samples` pixels are looked at."""
    root = np.sqrt(moments.variance)
    padded = normalise_contrast(moments, (1 / root).astype(np.float32), pad=0)
    local = np.stack([moments.covariance[n] / (root[a] * root[b]) for n, (a, b) in enumerate(PAIRS)])
    # red and blue, diagonal neighbours as the two greens, lack 1.85 to 1.95 times as much; the best pair of each place
    # is free of reflections, and of the specimen's colour where it is the greens
    greens = moments.greens / moments.variance[1]
    lacking = np.min([1 - local[0], (1 - local[1]) / 1.9, 1 - local[2], (1 - greens) / 1.9], axis=0)
    # whole blocks, of some 64 px at least
    extent = float(np.ptp(model.displacement, axis=(2, 3)).max())
    side = max(8, int(max(local.shape[1:]) * min(EQUALLY_APART / max(extent, 1e-9), 1.0)))
    corners = [(i, j) for i in range(0, local.shape[1], side) for j in range(0, local.shape[2], side)]
    sums, counts = np.zeros((2, len(corners), len(LAGS), 6))
    step, correlations, displacement = max(1, padded.size // samples), [], []
    for (i, j), total, number in zip(corners, sums, counts, strict=True):
        square = padded[BLOCK * i : BLOCK * (i + side), BLOCK * j : BLOCK * (j + side)]
        kernels.lag_products(np.ascontiguousarray(square), *moments.red, LAGS, step, total, number)
        correlations.append(np.maximum(local[:, i : i + side, j : j + side].mean(axis=(1, 2)), 1e-3))
        displacement.append(model.displacement[:, :, i : i + side, j : j + side].mean(axis=(2, 3)))
    products = LagProducts(
        sums=sums,
        counts=counts,
        correlations=np.array(correlations),
        displacement=np.array(displacement),
        light_fraction=channel_means(model.light_fraction(_light_levels(moments, model))),
    )
    return fit_texture(products, 1 - float(np.median(lacking)))


def _light_levels(moments: Moments, model: MosaicModel) -> FloatArray:
    """Return the mean grey level (k,) of each light: their contrasts are about as these."""
    levels = np.linalg.pinv(model.sites) @ moments.mean.mean(axis=(1, 2), dtype=np.float64)
    return np.asarray(np.maximum(levels, FAINTEST * levels.max()))


def normalise_contrast(moments: Moments, scale: FloatImage, *, pad: int, width: int | None = None) -> FloatImage:
    """Return contrast times `scale` (3, h, w), mirrored by `pad` px; `width` asks for more columns, which are 0."""
    rows, columns = moments.contrast.shape
    out = np.empty((rows + 2 * pad, max(columns, width or 0) + 2 * pad), dtype=np.float32)
    kernels.scaled_contrast(moments.contrast, interleave_bayer(scale, BLOCK, columns, moments.red), BLOCK, pad, out)
    return out


def colour_factors(moments: Moments, texture: TextureModel, model: MosaicModel) -> ColourFactors:
    """Return the slopes of channels and lights on the common texture and their specific variances.

    Parameters
    ----------
    moments
        See `gather_moments`.
    texture
        Its `band` gives the second moments of low-passed planes of unit texture; on a coloured specimen no colour shows
        the common texture alone.
    model
        One light's sparkle is seen by all channels, which is taken out of their moments.

    Returns
    -------
    ColourFactors
    """
    crosstalk, band = model.matrix, texture.band
    energy = np.array([band.adjacent, band.diagonal, band.adjacent])
    channel_variance = moments.variance / band.same
    # own moment beyond the common one, relative to it, that the aliasing of the coarse colour lattices may cause
    allowed = 0.05 * (1 - texture.specific)
    to_lights, to_pairs = np.linalg.pinv(crosstalk**2), np.stack([crosstalk[a] * crosstalk[b] for a, b in PAIRS])
    sparkle = np.ascontiguousarray(band.same * to_lights)
    square, specific = np.empty_like(channel_variance), np.empty_like(channel_variance)
    # what the lights' sparkle adds to the moments of two channels, given each channel's own
    common_slopes(channel_variance, moments.covariance, energy, allowed, sparkle, to_pairs, square, specific)
    # as if all of it were sparkle: a specimen's colour lies within the band and is trusted too little, the safe side;
    # the window cannot tell .003 from none
    variance = np.maximum(specific * (band.same / WHITE_ENERGY) - 0.003, 0)
    lights = np.maximum(np.tensordot(to_lights, variance * square, axes=1), 0)
    # every channel sees at least what its crosstalk lets through of the lights that sparkle
    variance = np.maximum(variance, np.tensordot(crosstalk**2, lights, axes=1) / square) + MIN_SPECIFIC
    slope = np.sqrt(square)
    light_slope = np.tensordot(np.linalg.pinv(crosstalk), slope, axes=1)
    least_slope = np.maximum(light_slope, FAINTEST * light_slope.max(axis=0))
    return ColourFactors(
        slope=slope,
        specific=variance,
        noise=moments.noise / square,
        light_slope=light_slope,
        light_specific=lights / least_slope**2 + MIN_SPECIFIC,
        light_fraction=model.light_fraction(np.median(least_slope, axis=(1, 2))),
    )
