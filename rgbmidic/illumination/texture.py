"""Autocorrelation of the speckle: a model, its fit to products of samples, and the speckle's size.

A DIC speckle is black on white, so one texture a(x) is common to all lights. Its autocorrelation is read from products
of samples of *different* colours, in which neither camera noise nor the sparkle of a reflection takes part, and is
fitted by a sum of Gaussians with positive weights, which keeps it positive definite and gives its value at distance 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.arguments import checked
from rgbmidic.errors import InputError
from rgbmidic.typing import FloatArray, FloatImage

LAGS = np.array(
    [(i, j) for i in range(5) for j in range(-4, 5) if (i, j) > (0, 0) and np.hypot(i, j) <= 4.3], dtype=np.int64
)
"""Distances (rows, columns) at which products of samples are taken: those farther apart (px) depend on the spacing of
the speckles, not on their edges."""
WIDTHS: FloatArray = np.asarray(0.6 * 1.3 ** np.arange(12), dtype=np.float64)
"""Standard deviations (px) of the Gaussians: the narrowest is what a square pixel lets through."""
COLOURED = 0.5
"""Below this mean correlation of any two colours they do not show the same texture."""

_BINOMIAL = np.array([1, 5, 10, 10, 5, 1]) / 16
_OFFSETS = np.array([-2, -1, 0, 1, 2, 3])
WHITE_ENERGY = float((_BINOMIAL[::2] ** 2).sum() ** 2)
"""Second moment of a low-passed plane for white noise of variance 1."""


class BandEnergy(NamedTuple):
    """Second moments of the planes' low-passed contrast, `plane_products` of the kernels, for unit texture.

    Attributes
    ----------
    same
        Of a plane with itself.
    adjacent
        Of planes that are neighbours along a row or column: red and green, blue and green.
    diagonal
        Of planes that are diagonal neighbours: red and blue.
    """

    same: float
    adjacent: float
    diagonal: float


@dataclass(frozen=True, kw_only=True)
class TextureModel:
    """Autocorrelation of the common texture: ``C(r) = c + sum_m w_m exp(-r^2 / (2 s_m^2))``, C(0) = 1.

    Attributes
    ----------
    weights, widths : tuple of float
        w_m and s_m (px).
    offset : float
        c: the loss by the removal of the local mean; not positive.
    specific : float
        Fraction (0 to 1) of the channel-specific component that is as coarse as the speckle: 0 for the sparkle of
        reflections, towards 1 for a coloured specimen.
    correlation : float
        Mean correlation of the two colours that agree best, about 1 for a black and white speckle.
    common : bool
        Whether the samples bear out that the lights have the texture in common as far as their contrast says: those
        left out are predicted better so than if each light had as much of its own. False: a print of sharp edges, or a
        lens that blurs one light more than another; the separation then takes each channel by itself.
    """

    weights: tuple[float, ...]
    widths: tuple[float, ...]
    offset: float = 0.0
    specific: float = 0.0
    correlation: float = 1.0
    common: bool = True

    def __post_init__(self) -> None:
        """Check the values."""
        w, s = np.asarray(self.weights, float), np.asarray(self.widths, float)
        if w.ndim != 1 or w.shape != s.shape or not (w >= 0).all() or not w.sum() > 0 or not (s > 0).all():
            raise InputError(f"a texture needs weights >= 0 and widths > 0, equally many; given are {w} and {s}")
        if not (0 <= self.specific <= 1 and self.offset <= 0 and abs(w.sum() + self.offset - 1) < 1e-6):
            raise InputError(
                "weights and offset of a texture sum to 1, its channel-specific fraction lies in 0 to 1; given are a "
                f"sum of {w.sum() + self.offset} and {self.specific}"
            )

    @classmethod
    def of_speckle(cls, diameter: float) -> TextureModel:
        """Return a texture of dark discs whose autocorrelation has about this full width at half maximum (px)."""
        if not diameter > 0:
            raise InputError(f"the diameter of a speckle must be positive, not {diameter!r}")
        widths = np.maximum(np.array([0.26, 0.36, 0.51]) * diameter, WIDTHS[0])
        return cls(weights=(0.1, 0.3, 0.6), widths=tuple(widths.tolist()))

    def __call__(self, distance: npt.ArrayLike) -> FloatArray:
        """Return C at distances in px."""
        r = np.asarray(distance, dtype=np.float64)[..., None]
        gaussians = np.exp(-0.5 * (r / np.asarray(self.widths)) ** 2)
        return np.asarray(gaussians @ np.asarray(self.weights) + self.offset)

    def spectrum(self, frequency: npt.ArrayLike) -> FloatArray:
        """Return the power spectrum (px^2) at distances from frequency 0 in cycles per px, without the offset."""
        f = np.asarray(frequency, dtype=np.float64)[..., None]
        # a Gaussian's transform; of widths of 0.6 px and more hardly anything folds back
        widths = np.asarray(self.widths)
        gaussians = 2 * np.pi * widths**2 * np.exp(-2 * (np.pi * widths * f) ** 2)
        return np.asarray(gaussians @ np.asarray(self.weights))

    @cached_property
    def diameter(self) -> float:
        """Speckle size in px: the full width at half maximum of the autocorrelation."""
        r = np.linspace(0, 64, 6401)
        below = np.flatnonzero(self(r) < 0.5)
        return float(2 * r[below[0]]) if below.size else float("inf")

    @cached_property
    def gradient_gain(self) -> float:
        """Slope of a low-passed plane by regression on its central difference over two cells, both per cell."""
        weights = np.asarray(self.weights)
        ends, span = (
            weights @ _plane_moments(self.widths, d) + self.offset for d in (np.array([1.9, 2.1]), [0.0, 4.0])
        )
        return float(-20 * (ends[1] - ends[0]) / (span[0] - span[1]))

    @cached_property
    def plane_displacement(self) -> float:
        """Displacement (px) that the low-passed plane of the samples in even columns, or rows, shows at rest.

        That of odd ones shows it with the other sign: each has three of the six weights of the binomial.
        """
        weights = np.asarray(self.weights)
        moments = _line(self.widths, 0, 1, [2.0, -2.0]) * (_line(self.widths, 0, 0) + _line(self.widths, 1, 1))[:, None]
        near, far = weights @ _plane_moments(self.widths, np.array([1.9, 2.1]))
        ahead, behind = weights @ moments / 2
        return float((ahead - behind) / (20 * (near - far)))

    @cached_property
    def band(self) -> BandEnergy:
        """Second moments of the low-passed planes of a Bayer mosaic for this texture."""
        return BandEnergy(*(np.asarray(self.weights) @ _band_energies(self.widths) + self.offset).tolist())


def _line(widths: tuple[float, ...], p: int, q: int, distance: npt.ArrayLike = 0.0) -> FloatArray:
    """Second moments (M, ...) along one axis of planes of parity p and q, `distance` px apart: Gaussians factorise."""
    distances = _OFFSETS[p::2, None] - _OFFSETS[q::2] + np.asarray(distance, dtype=np.float64)[..., None, None]
    gaussians = np.exp(-0.5 * (distances / np.asarray(widths).reshape(-1, *[1] * distances.ndim)) ** 2)
    return np.asarray(_BINOMIAL[p::2] @ gaussians @ _BINOMIAL[q::2])


def _band_energies(widths: tuple[float, ...]) -> FloatArray:
    """Return the moments (M, 3) own, adjacent and diagonal of the low-passed planes for Gaussian autocorrelations."""
    same, opposite = (_line(widths, 0, 0) + _line(widths, 1, 1)) / 2, _line(widths, 0, 1)
    return np.stack([same * same, same * opposite, opposite * opposite], axis=1)


def _plane_moments(widths: tuple[float, ...], distance: npt.ArrayLike) -> FloatArray:
    """Return the moments (M, D) of a plane with itself some px farther along one axis."""
    at_rest, displaced = ((_line(widths, 0, 0, d) + _line(widths, 1, 1, d)) / 2 for d in ([0.0], distance))
    return np.asarray(at_rest * displaced)


DISPLACEMENTS = np.linspace(0, 2, 41)
"""Of a plane (px, modulo its lattice) at which `registered_lines` is tabulated."""


def _lanczos(fraction: FloatArray) -> FloatArray:
    """Return the weights (8, F) of the neighbours of places between the middle two (Duchon 1979), of unit sum."""
    cells = np.arange(-3, 5)[:, None] - fraction
    weights = np.sinc(cells) * np.sinc(cells / 4)
    return np.asarray(weights / weights.sum(axis=0))


def lanczos_weights(steps: int = 256) -> FloatImage:
    """Return the weights (8, F) of `register_planes` of the kernels, at the middle of each of the steps."""
    return _lanczos((np.arange(steps) + 0.5) / steps).astype(np.float32)


@lru_cache(maxsize=8)
def registered_lines(widths: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Second moments of two low-passed planes along one axis, each read where it shows the texture displaced.

    They take .4 s and are kept for the last eight sets of widths, 320 kB each: a test has one or two.

    Parameters
    ----------
    widths
        Standard deviations (px) of M Gaussian autocorrelations.

    Returns
    -------
    tuple of ndarray, shape (M, D, D)
        Of planes of the same and of different parity, by the `DISPLACEMENTS` of both.
    """

    def samples(parity: int) -> tuple[FloatArray, FloatArray]:
        """Weights and places (D, S) of the samples that Lanczos interpolation and the binomial take."""
        cells, shape = np.arange(-3, 5) - DISPLACEMENTS[:, None] / 2, (len(DISPLACEMENTS), -1)
        weights = _lanczos(DISPLACEMENTS / 2).T[:, :, None] * _BINOMIAL[parity::2]
        return weights.reshape(shape), (2 * cells[:, :, None] + _OFFSETS[parity::2]).reshape(shape)

    def line(p: int, q: int) -> FloatArray:
        (first, x), (second, y) = samples(p), samples(q)
        square = (x[:, None, :, None] - y[None, :, None, :]) ** 2
        moments = [
            np.einsum("as,bt,abst->ab", first, second, np.exp(-0.5 * square / s**2), optimize=True) for s in widths
        ]
        return np.array(moments)

    return (line(0, 0) + line(1, 1)) / 2, (line(0, 1) + line(1, 0)) / 2


@dataclass(frozen=True, slots=True, kw_only=True)
class LagProducts:
    """Products of samples at `LAGS` in n squares of a mosaic, in each of which the lights are about equally far apart.

    Attributes
    ----------
    sums, counts : ndarray, shape (n, L, 6)
        As `lag_products` of the kernels gives them, of contrast divided by the square root of the low-passed planes'
        own moments.
    correlations : ndarray, shape (n, 3)
        Mean correlation of the low-passed planes with the lights in register, red-green, red-blue, green-blue.
    displacement : ndarray, shape (n, k, 2)
        Place (x, y) at which each light shows the texture, px.
    light_fraction : ndarray, shape (3, k)
        Fraction of each light in the slope of each channel.
    """

    sums: FloatArray
    counts: FloatArray
    correlations: FloatArray
    displacement: FloatArray
    light_fraction: FloatArray


PAIRS = ((0, 1), (0, 2), (1, 2))
"""Of channels."""


def fit_texture(products: LagProducts, agreement: float) -> TextureModel:
    """Fit a texture to the products of samples at `LAGS`.

    Parameters
    ----------
    products
        Of the mosaic.
    agreement
        Correlation that low-passed planes which are neighbours along a row or column reach where no colour shows
        anything of its own: what it lacks to 1 is texture too fine for one colour's lattice.

    Returns
    -------
    TextureModel
    """
    sums, counts, correlations = products.sums.sum(axis=0), products.counts.sum(axis=0), products.correlations
    overall = correlations.mean(axis=0)
    best, distance = float(overall.max()), np.hypot(*LAGS.T)
    if best < COLOURED:
        met = counts[:, :3] > 0
        # one colour's samples are two pixels apart and show nothing of what is finer
        coarse = WIDTHS[WIDTHS > 1]
        r = np.broadcast_to(distance[:, None], met.shape)[met]
        gaussians, product = np.exp(-0.5 * (r[:, None] / coarse) ** 2), sums[:, :3][met] / counts[:, :3][met]
        importance = 1 / (1 + r)
        system = np.column_stack([gaussians, -np.ones(product.size)]) * importance[:, None]
        return _mixture(system, product * importance, coarse, correlation=best, specific=1.0)
    energies = _band_energies(tuple(WIDTHS.tolist()))
    rows = []
    for pair, kind in enumerate((1, 2, 1)):
        weight = products.counts[..., 3 + pair] * correlations[:, pair, None]
        # neighbours along a row or column are an odd number of rows and columns apart
        met = (weight > 0) & ((LAGS.sum(axis=1) + kind) % 2 == 0)
        # products come in units of the band's energy, which the same unknown weights make up
        unit = np.broadcast_to(energies[:, kind], (met.sum(), len(WIDTHS)))
        product = products.sums[..., 3 + pair][met] / weight[met]
        rows.append((_gaussians(products, pair)[met], product, unit, weight[met], np.nonzero(met)[1]))
    gaussians, product, unit, weight, lag = (np.concatenate(column) for column in zip(*rows, strict=True))
    importance = np.sqrt(weight / np.bincount(lag, weight)[lag]) / (1 + distance[lag])
    # what a lattice cannot see is hardly in the products: the fit would extrapolate it to distance 0
    finest, coarsest = (energies[:, 1] / energies[:, 0])[[0, -1]]
    ratio = float(np.clip(agreement, finest, coarsest))
    fine = np.append(energies[:, 1] - ratio * energies[:, 0], ratio - 1)
    system = np.column_stack([gaussians - product[:, None] * unit, product - 1]) * importance[:, None]
    sum_to_one = np.append(np.ones(len(WIDTHS)), -1.0)
    # short distances hardly distinguish a constant from a wide Gaussian: an offset of 1 costs an error (of products) of
    # .05; the true one is -0.02 to -0.15
    small_offset = np.append(np.zeros(len(WIDTHS)), 0.05)
    system = np.vstack([system, 1e3 * sum_to_one, 1e3 * fine, small_offset])
    target = np.concatenate([np.zeros(product.size), [1e3, 0.0, 0.0]])
    model = _mixture(system, target, WIDTHS, correlation=best)
    return replace(model, specific=_coarse_fraction(model, sums, counts, overall))


def _gaussians(products: LagProducts, pair: int) -> FloatArray:
    """Return what each of the `WIDTHS` gives (n, L, M) for the products of two channels, which see displaced lights."""
    first, second = PAIRS[pair]
    total = np.zeros((*products.sums.shape[:2], len(WIDTHS)))
    for a, b in np.ndindex(products.displacement.shape[1], products.displacement.shape[1]):
        offset = (products.displacement[:, a] - products.displacement[:, b])[:, None]
        fraction = products.light_fraction[first, a] * products.light_fraction[second, b] / 2
        for sign in (1, -1):  # a lag begins at either of the two
            square = ((LAGS[:, ::-1] + sign * offset) ** 2).sum(axis=2)
            total += fraction * np.exp(-0.5 * square[..., None] / WIDTHS**2)
    return total


def _mixture(
    system: FloatArray, target: FloatArray, widths: FloatArray, *, correlation: float, specific: float = 0.0
) -> TextureModel:
    """Fit weights w >= 0 and offset c <= 0 of a texture by least squares: ``system @ (w, -c) = target``.

    The first is up to a factor where the system does not say that ``sum w + c = 1``.
    """
    from scipy.optimize import nnls  # half a second to import

    solution = nnls(system, target)[0]
    total = solution[:-1].sum() - solution[-1]
    if not total > 0.1 * solution[:-1].sum():
        return TextureModel.of_speckle(4.0)
    positive = solution[:-1] > 0
    weights = solution[:-1][positive] / total
    model = TextureModel(
        weights=tuple(weights.tolist()),
        widths=tuple(widths[positive].tolist()),
        offset=min(float(1 - weights.sum()), 0.0),
        specific=specific,
        correlation=correlation,
    )
    # of noise alone nothing is known
    return model if model.band.diagonal > 0 else TextureModel.of_speckle(4.0)


def _coarse_fraction(model: TextureModel, sums: FloatArray, counts: FloatArray, correlations: FloatArray) -> float:
    """Return the fraction of the channel-specific component as coarse as the speckle, from products 2 px apart."""
    distance = np.abs(LAGS)
    two = (distance.max(axis=1) == 2) & (distance.min(axis=1) == 0) & (counts[:, :3] > 0).all(axis=1)
    band = model.band
    measured = (sums[two, :3].sum(axis=0) / counts[two, :3].sum(axis=0)).mean()
    common = np.clip(correlations / (np.array([band.adjacent, band.diagonal, band.adjacent]) / band.same), 0, 1).mean()
    # what of the channel-specific fraction is still seen two pixels away, shrunk to 0 where that fraction is nearly
    # nothing: under .02 products do not show whether it is coarse
    coarse = measured / max(float(model(2.0)) / band.same, 1e-3) - common
    return float(np.clip(coarse * (1 - common) / ((1 - common) ** 2 + 0.02**2), 0, 1))


@checked
def speckle_diameter(picture: FloatArray, *, background: float = 20.0) -> float | None:
    """Return the size of the speckle in a picture, without the peak that white noise has at distance 0.

    Parameters
    ----------
    picture : ndarray, shape (H, W)
        Finite at all pixels.
    background
        Standard deviation (px) of the local mean over which speckle stands out.

    Returns
    -------
    float or None
        Full width at half maximum of the autocorrelation, averaged over all directions, px; None without a texture.

    Raises
    ------
    InputError
        It is no picture, or the width is not positive.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> picture = gaussian_filter(np.random.default_rng(0).normal(size=(128, 128)), 2)
    >>> 6 < speckle_diameter(picture) < 7.5
    True
    """
    if picture.ndim != 2 or min(picture.shape) < 2 or not 0 < background < 1e6:
        raise InputError(f"a picture (H, W) and a width above 0 px are needed, not {picture.shape}, {background:g}")
    texture = picture - cv2.GaussianBlur(picture, (0, 0), background)
    power = np.abs(np.fft.rfft2(texture, s=[2 * side for side in texture.shape])) ** 2
    reach = min(int(2 * background), *(side - 1 for side in texture.shape))
    lag = np.arange(-reach, reach + 1)
    pairs = np.multiply.outer(*(1 - np.abs(lag) / side for side in texture.shape))
    mean, radius = np.fft.irfft2(power)[np.ix_(lag, lag)] / pairs, np.hypot(lag[:, None], lag)
    ring = radius.round().astype(int).ravel()
    product, distance = (np.bincount(ring, values.ravel()) / np.bincount(ring) for values in (mean, radius))
    if not (len(product) > 2 and product[0] > 0):
        return None
    if product[1] > product[2] > 0:  # at 0 a Gaussian through the next two, without the peak of white noise there
        fall = np.log(product[1] / product[2]) / (distance[2] ** 2 - distance[1] ** 2)
        product[0] = min(product[1] * np.exp(fall * distance[1] ** 2), product[0])
    below = np.flatnonzero(product < 0.5 * product[0])
    if not below.size:
        return None
    ends = slice(below[0], below[0] - 2 if below[0] > 1 else None, -1)
    return float(2 * np.interp(0.5 * product[0], product[ends], distance[ends]))
