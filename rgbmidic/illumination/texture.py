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

from rgbmidic.errors import InputError
from rgbmidic.typing import FloatArray

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
    """Second moments of the planes' low-passed contrast, `cell_moments` of the kernels, for unit texture.

    Attributes
    ----------
    own
        Of a plane with itself.
    adjacent
        Of planes that are neighbours along a row or column: red and green, blue and green.
    diagonal
        Of planes that are diagonal neighbours: red and blue.
    """

    own: float
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
    """

    weights: tuple[float, ...]
    widths: tuple[float, ...]
    offset: float = 0.0
    specific: float = 0.0
    correlation: float = 1.0

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
        """Slope of a plane over its central difference, both per cell, by regression."""
        taps = [(_BINOMIAL[p::2], _OFFSETS[p::2]) for p in (0, 1)]

        def correlation(x):
            total = 0.0
            for t, o in taps:
                for u, q in taps:
                    apart = o[:, None] - o
                    lines = [np.einsum("i,mij,j->m", t, np.exp(-0.5 * ((apart + x) / np.asarray(self.widths)[:, None, None]) ** 2), t), np.einsum("i,mij,j->m", u, np.exp(-0.5 * ((q[:, None] - q) / np.asarray(self.widths)[:, None, None]) ** 2), u)]
                    total += 0.25 * (np.asarray(self.weights) @ (lines[0] * lines[1]) + self.offset)
            return total
        slope = (correlation(2.1) - correlation(1.9)) / 0.1  # per cell
        return -slope / (correlation(0.0) - correlation(4.0)) * 2

    @cached_property
    def band(self) -> BandEnergy:
        """Second moments of the low-passed planes of a Bayer mosaic for this texture."""
        return BandEnergy(*(np.asarray(self.weights) @ _band_energies(self.widths) + self.offset).tolist())


@lru_cache(maxsize=64)
def _band_energies(widths: tuple[float, ...]) -> FloatArray:
    """Return the moments (M, 3) own, adjacent and diagonal of the low-passed planes for Gaussian autocorrelations."""
    taps = [(_BINOMIAL[p::2], _OFFSETS[p::2]) for p in (0, 1)]

    def line(p: int, q: int) -> FloatArray:
        """Sum along one axis, over planes of parity p and q: Gaussians factorise."""
        apart = taps[p][1][:, None] - taps[q][1][None]
        gaussians = np.exp(-0.5 * (apart[None] / np.asarray(widths)[:, None, None]) ** 2)
        return np.asarray(np.einsum("i,mij,j->m", taps[p][0], gaussians, taps[q][0]))

    same, other = (line(0, 0) + line(1, 1)) / 2, line(0, 1)
    return np.stack([same * same, same * other, other * other], axis=1)


FRACTIONS = np.linspace(0, 2, 41)


@lru_cache(maxsize=64)
def interpolated_lines(widths: tuple[float, ...]):
    """Along one axis: product of a plane with another, shown d px farther on and brought back by cubic interpolation."""
    taps = [(_BINOMIAL[p::2], _OFFSETS[p::2]) for p in (0, 1)]

    def positions(p, d):
        x = np.arange(-3, 5) - d / 2
        h = np.sinc(x) * np.sinc(x / 4)
        return np.outer(h / h.sum(), taps[p][0]).ravel(), (2 * x[:, None] + taps[p][1]).ravel()

    def line(p, q):
        out = np.zeros((len(widths), FRACTIONS.size, FRACTIONS.size))
        for i, d in enumerate(FRACTIONS):
            a, x = positions(p, d)
            for j, e in enumerate(FRACTIONS):
                b, y = positions(q, e)
                out[:, i, j] = np.exp(-0.5 * ((x[:, None] - y) / np.asarray(widths)[:, None, None]) ** 2) @ b @ a
        return out

    return (line(0, 0) + line(1, 1)) / 2, (line(0, 1) + line(1, 0)) / 2


def fit_texture(
    sums: FloatArray, counts: FloatArray, correlations: FloatArray, agreement: float, seen: FloatArray, apart: FloatArray
) -> TextureModel:
    """Fit; sums, counts (cells, L, 6), correlations (cells, 3), seen (4, k), apart (cells, k, 2)."""
    distance = np.hypot(*LAGS.T)
    met = counts[..., :3].sum(axis=0) > 0
    r = np.broadcast_to(distance[:, None], met.shape)[met]
    # one colour's samples are two pixels apart and show nothing of what is finer
    coarse = WIDTHS[WIDTHS > 1]
    w = np.stack([seen[0], (seen[1] + seen[2]) / 2, seen[3]])
    count = seen.shape[1]

    whole = correlations.mean(axis=0)
    best = float(np.max(whole))
    if best < COLOURED:
        return _mixture(r, (sums.sum(axis=0)[:, :3][met] / counts.sum(axis=0)[:, :3][met]), best, widths=coarse, specific=1.0)
    parity = LAGS.sum(axis=1) % 2 == 1
    energies = _band_energies(tuple(WIDTHS.tolist()))
    rows = []
    for pair, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        lags = parity if pair != 1 else ~parity
        kind = 1 if pair != 1 else 2
        for cell in range(len(sums)):
            use = lags & (counts[cell, :, 3 + pair] > 0)
            if not use.any():
                continue
            product = sums[cell, use, 3 + pair] / (counts[cell, use, 3 + pair] * correlations[cell, pair])
            gaussians = np.zeros((use.sum(), len(WIDTHS)))
            for l in range(count):
                for m in range(count):
                    share = w[a, l] * w[b, m]
                    shift = apart[cell, l] - apart[cell, m]
                    # which of the two samples a lag begins at is either
                    for sign in (1, -1):
                        x, y = LAGS[use, 1] + sign * shift[0], LAGS[use, 0] + sign * shift[1]
                        gaussians += share / 2 * np.exp(-0.5 * (x**2 + y**2)[:, None] / WIDTHS**2)
            unit = energies[:, kind]
            weight = counts[cell, use, 3 + pair] * correlations[cell, pair]
            rows.append((gaussians, np.tile(unit, (use.sum(), 1)), product, distance[use], weight, np.flatnonzero(use)))
    gaussians, unit, product, r, weight, lag = (np.concatenate(part) for part in zip(*rows))
    importance = np.sqrt(weight / np.bincount(lag, weight, minlength=len(LAGS))[lag]) / (1 + r)
    # what a lattice cannot see is hardly in the products: the fit would extrapolate it to distance 0
    finest, coarsest = (energies[:, 1] / energies[:, 0])[[0, -1]]
    between = float(np.clip(agreement, finest, coarsest))
    fine = np.append(energies[:, 1] - between * energies[:, 0], between - 1)
    model = _mixture(r, product, best, band=(unit, fine), gaussians=gaussians, importance=importance)
    return replace(model, specific=_coarse_fraction(model, sums.sum(axis=0), counts.sum(axis=0), whole))


def _mixture(
    r: FloatArray,
    product: FloatArray,
    correlation: float,
    *,
    widths: FloatArray = WIDTHS,
    band: tuple[FloatArray, FloatArray] | None = None,
    specific: float = 0.0,
    gaussians=None,
    importance=None,
) -> TextureModel:
    """Fit weights w >= 0 and offset c <= 0 of a texture by least squares.

    ``sum w g(r) + c = product`` up to a factor, or, with unit (R, M) and fine (M + 1,) of the `band`,
    ``sum w (g(r) - product unit) + c (1 - product) = 0`` with ``sum w + c = 1`` and ``fine . (w, -c) = 0``.
    """
    if gaussians is None:
        gaussians = np.exp(-0.5 * (r[:, None] / widths) ** 2)
        importance = 1 / (1 + r)
    if band is None:
        system = np.column_stack([gaussians, -np.ones(r.size)]) * importance[:, None]
        wanted = product * importance
    else:
        unit, fine = band
        system = np.column_stack([gaussians - product[:, None] * unit, product - 1]) * importance[:, None]
        sum_to_one = np.append(np.ones(len(widths)), -1.0)
        # short distances hardly distinguish a constant from a wide Gaussian: an offset of 1 costs an error (of
        # products) of .05; the true one is -0.02 to -0.15
        small_offset = np.append(np.zeros(len(widths)), 0.05)
        system = np.vstack([system, 1e3 * sum_to_one, 1e3 * fine, small_offset])
        wanted = np.concatenate([np.zeros(r.size), [1e3, 0.0, 0.0]])
    from scipy.optimize import nnls  # half a second to import

    solution = nnls(system, wanted)[0]
    total = solution[:-1].sum() - solution[-1]
    if not total > 0.1 * solution[:-1].sum():
        return TextureModel.of_speckle(4.0)
    kept = solution[:-1] > 0
    weights = solution[:-1][kept] / total
    model = TextureModel(
        weights=tuple(weights.tolist()),
        widths=tuple(widths[kept].tolist()),
        offset=min(float(1 - weights.sum()), 0.0),
        specific=specific,
        correlation=correlation,
    )
    # of noise alone nothing is known
    return model if model.band.diagonal > 0 else TextureModel.of_speckle(4.0)


def _coarse_fraction(model: TextureModel, sums: FloatArray, counts: FloatArray, correlations: FloatArray) -> float:
    """Return the fraction of the channel-specific component as coarse as the speckle, from products 2 px apart."""
    apart = np.abs(LAGS)
    two = (apart.max(axis=1) == 2) & (apart.min(axis=1) == 0) & (counts[:, :3] > 0).all(axis=1)
    band = model.band
    measured = (sums[two, :3].sum(axis=0) / counts[two, :3].sum(axis=0)).mean()
    common = np.clip(correlations / (np.array([band.adjacent, band.diagonal, band.adjacent]) / band.own), 0, 1).mean()
    # what of the channel-specific fraction is still seen two pixels away, shrunk to 0 where that fraction is nearly
    # nothing: under .02 products do not show whether it is coarse
    coarse = measured / max(float(model(2.0)) / band.own, 1e-3) - common
    return float(np.clip(coarse * (1 - common) / ((1 - common) ** 2 + 0.02**2), 0, 1))


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
    """
    texture = picture - cv2.GaussianBlur(picture, (0, 0), background)
    power = np.abs(np.fft.rfft2(texture, s=[2 * side for side in texture.shape])) ** 2
    reach = min(int(2 * background), *(side - 1 for side in texture.shape))
    lag = np.arange(-reach, reach + 1)
    pairs = np.multiply.outer(*(1 - np.abs(lag) / side for side in texture.shape))
    mean, away = np.fft.irfft2(power)[np.ix_(lag, lag)] / pairs, np.hypot(lag[:, None], lag)
    ring = away.round().astype(int).ravel()
    product, distance = (np.bincount(ring, part.ravel()) / np.bincount(ring) for part in (mean, away))
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
