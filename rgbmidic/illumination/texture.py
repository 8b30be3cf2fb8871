"""The speckle's autocorrelation: what one sample of the paint tells of its neighbours.

A DIC speckle is black on white, so one texture a(x) is common to all lights. Its autocorrelation is read from products of
samples of *different* colours, in which neither camera noise nor the sparkle of a reflection takes part, and is fitted by
a sum of Gaussians with positive weights, which keeps it positive definite and tells its value at distance 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from rgbmidic.errors import InputError

__all__ = ["LAGS", "WHITE_ENERGY", "BandEnergy", "TextureModel", "fit_texture"]

Floats = npt.NDArray[np.float64]

LAGS = np.array([(i, j) for i in range(5) for j in range(-4, 5) if (i, j) > (0, 0)], dtype=np.int64)
"""Distances (rows, columns) at which products of samples are taken."""
FARTHEST = 4.3
"""Products farther apart (px) do not enter: they tell of the spacing of the speckles, not of their edges."""
NARROWEST = 0.6
"""Standard deviation (px) of the narrowest Gaussian: what a square pixel lets through."""
MOST_FINE = 0.05
"""Most of the texture's variance that is taken to be too fine to be seen in products of samples."""
WIDTHS = NARROWEST * 1.3 ** np.arange(12)
COLOURED = 0.5
"""Below this mean correlation of any two colours they do not show the same texture."""

_BINOMIAL = np.array([1, 5, 10, 10, 5, 1]) / 16
_OFFSETS = np.array([-2, -1, 0, 1, 2, 3])
WHITE_ENERGY = float((_BINOMIAL[::2] ** 2).sum() ** 2)
"""Second moment of a low-passed plane for white noise of variance 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BandEnergy:
    """Second moments of the planes' low-passed contrast (`rgbmidic._kernels.texture.cell_moments`) for unit texture.

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
    """Autocorrelation of the common texture: ``C(r) = sum_m w_m exp(-r^2 / (2 s_m^2))``, C(0) = 1.

    Attributes
    ----------
    weights, widths : tuple of float
        w_m and s_m (px).
    private
        Share (0 to 1) of what a colour shows of its own that is as coarse as the speckle: 0 for the sparkle of reflections,
        towards 1 for a coloured specimen.
    correlation
        Mean correlation of the two colours that agree best, about 1 for a black and white speckle.
    """

    weights: tuple[float, ...]
    widths: tuple[float, ...]
    private: float = 0.0
    correlation: float = 1.0

    def __post_init__(self) -> None:
        w, s = np.asarray(self.weights, float), np.asarray(self.widths, float)
        if w.ndim != 1 or w.shape != s.shape or not (w >= 0).all() or not w.sum() > 0 or not (s > 0).all():
            raise InputError(f"a texture needs weights >= 0 and widths > 0, equally many; given are {w} and {s}")

    @classmethod
    def of_speckle(cls, diameter: float) -> TextureModel:
        """A texture of dark discs of about this diameter (px): C falls to one half at half the diameter."""
        if not diameter > 0:
            raise InputError(f"the diameter of a speckle must be positive, not {diameter!r}")
        unit = np.array([0.30, 0.42, 0.60])
        return cls(weights=(0.1, 0.3, 0.6), widths=tuple(float(w) for w in np.maximum(unit * diameter, NARROWEST)))

    def __call__(self, distance: npt.ArrayLike) -> Floats:
        """C at distances in px."""
        r = np.asarray(distance, dtype=np.float64)[..., None]
        w = np.asarray(self.weights) / np.sum(self.weights)
        return np.asarray((w * np.exp(-0.5 * (r / np.asarray(self.widths)) ** 2)).sum(axis=-1))

    @cached_property
    def diameter(self) -> float:
        """Speckle size in px: the full width at half maximum of the autocorrelation."""
        r = np.linspace(0, 64, 6401)
        below = np.flatnonzero(self(r) < 0.5)
        return float(2 * r[below[0]]) if below.size else float("inf")

    @cached_property
    def band(self) -> BandEnergy:
        """What the low-passed planes of a Bayer mosaic show of this texture."""
        taps = [(_BINOMIAL[p::2], _OFFSETS[p::2]) for p in (0, 1)]
        planes = [(np.outer(taps[p][0], taps[q][0]).ravel(), taps[p][1], taps[q][1]) for p in (0, 1) for q in (0, 1)]
        weights = [w for w, _, _ in planes]
        points = [np.stack(np.meshgrid(i, j, indexing="ij"), -1).reshape(-1, 2) for _, i, j in planes]

        def moment(p: int, q: int) -> float:
            apart = np.linalg.norm(points[p][:, None] - points[q][None], axis=-1)
            return float(weights[p] @ self(apart) @ weights[q])

        return BandEnergy(
            own=float(np.mean([moment(p, p) for p in range(4)])),
            adjacent=float(np.mean([moment(0, 1), moment(0, 2), moment(1, 3), moment(2, 3)])),
            diagonal=float(np.mean([moment(0, 3), moment(1, 2)])),
        )


def fit_texture(sums: Floats, counts: Floats, correlations: Floats, agreement: float) -> TextureModel:
    """Texture from the products of samples at `LAGS`.

    Parameters
    ----------
    sums, counts : ndarray, shape (L, 6)
        As `rgbmidic._kernels.texture.lag_products` gives them, of contrast divided by the square root of the low-passed
        planes' own moments.
    correlations : ndarray, shape (3,)
        Mean over the field of the low-passed planes' correlation, red-green, red-blue, green-blue.
    agreement
        Correlation that low-passed planes which are neighbours along a row or column reach where no colour shows
        anything of its own: what it lacks to 1 is texture too fine for one colour's lattice.

    Returns
    -------
    TextureModel
    """
    best = float(np.max(correlations))
    distance = np.hypot(*LAGS.T)
    near = distance <= FARTHEST
    if best < COLOURED:
        return _fit_own(sums[near, :3], counts[near, :3], distance[near], best)
    pairs = counts[:, 3:] * correlations
    adjacent, diagonal = pairs[:, 0] + pairs[:, 2], pairs[:, 1]
    odd = near & (LAGS.sum(axis=1) % 2 == 1) & (adjacent > 0)
    even = near & (LAGS.sum(axis=1) % 2 == 0) & (diagonal > 0) & (correlations[1] > 0)
    r = np.concatenate([distance[odd], distance[even]])
    kind = np.concatenate([np.ones(odd.sum(), bool), np.zeros(even.sum(), bool)])
    product = np.concatenate([(sums[odd, 3] + sums[odd, 5]) / adjacent[odd], sums[even, 4] / diagonal[even]])
    model = TextureModel.of_speckle(4.0)
    for _ in range(6):  # the products come in units of the band's energy, which depends on the texture: settles in 4
        band = model.band
        model = _mixture(r, product * np.where(kind, band.adjacent, band.diagonal), correlation=best)
        model = _with_fine_part(model, agreement)
    return model


def _with_fine_part(model: TextureModel, agreement: float) -> TextureModel:
    """The texture with as much of the narrowest Gaussian more as makes neighbouring planes agree no better.

    Products of samples a pixel apart and more hardly tell it: the sum of Gaussians extrapolates to distance 0.
    """
    band, fine = model.band, TextureModel(weights=(1.0,), widths=(NARROWEST,)).band
    missing = band.adjacent - agreement * band.own
    part = float(np.clip(missing / max(agreement * fine.own - fine.adjacent, 1e-6), 0, MOST_FINE))
    if part == 0:
        return model
    weights = np.append(np.asarray(model.weights) / np.sum(model.weights), part)
    return replace(model, weights=tuple((weights / weights.sum()).tolist()), widths=(*model.widths, NARROWEST))


def _fit_own(sums: Floats, counts: Floats, distance: Floats, best: float) -> TextureModel:
    """Texture of a specimen whose colours differ, from products of samples of one colour."""
    seen = counts > 0
    r = np.broadcast_to(distance[:, None], sums.shape)[seen]
    return _mixture(r, sums[seen] / counts[seen], correlation=best, private=1.0)


def _mixture(r: Floats, product: Floats, *, correlation: float, private: float = 0.0) -> TextureModel:
    # a constant of either sign takes up what the removal of the local mean has shifted
    basis = np.concatenate(
        [np.exp(-0.5 * (r[:, None] / WIDTHS) ** 2), np.ones((r.size, 1)), -np.ones((r.size, 1))], axis=1
    )
    importance = 1 / (1 + r)
    weights = nnls(basis * importance[:, None], product * importance)[0][:-2]
    if not weights.sum() > 0:
        return TextureModel.of_speckle(4.0)
    kept = weights > 0
    return TextureModel(
        weights=tuple((weights[kept] / weights.sum()).tolist()),
        widths=tuple(WIDTHS[kept].tolist()),
        private=private,
        correlation=correlation,
    )
