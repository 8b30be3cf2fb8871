"""The residual f - g(x + u) of every light at a displacement, and the change of brightness between the states.

The grey-level correction brings the deformed images to the brightness of the reference (paper, section 2.2;
`rgbmidic.correlation.brightness`). The brightness change is reported for every light: lamps flicker, shutters jitter, a
light goes out. What the residual shows of the motion beyond an initial guess brings that nearer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from scipy.spatial import cKDTree

from rgbmidic._kernels.correlation import compare_states, element_squares, find_changed_weights
from rgbmidic._kernels.owned_pixels import correct_brightness
from rgbmidic.correlation.blocks import BlockTable
from rgbmidic.correlation.brightness import GainFit, gain_and_offset, inverse_gains
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.robust_fit import robust_fit
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import FloatArray, FloatImage
from rgbmidic.weights.precision import Precision


@dataclass(frozen=True, slots=True, kw_only=True)
class Residual:
    """Both states at the owned pixels of the reference.

    Attributes
    ----------
    reference
        The reference state.
    weights : ndarray, shape (k, P), float32
        Weights given, warped by the displacement; 0 where g is not known.
    difference : ndarray, shape (k, P), float32
        f - g(x + u) with the brightness of g corrected, in units of the local mean of f.
    moments : ndarray, shape (k, E, 6)
        Sums of w, w f, w g, w f f, w f g, w g g over the pixels of each element.
    gain_fit
        Of the local gains of g over f; None where the gain is one number.

    Examples
    --------
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> region = Region.from_rectangle((0, 0, 59, 39), shape=(40, 60))
    >>> images = np.random.default_rng(0).uniform(50, 200, (1, 40, 60)).astype(np.float32)
    >>> reference = Reference.prepare(images, region, mesh=Tri3Mesh.from_region(region, element_size=20))
    >>> residual = Residual.at(reference, Deformed.prepare(images), [np.zeros_like(reference.mesh.nodes)])
    >>> bool(np.abs(residual.difference).max() < 1e-4)  # both states are the same
    True
    """

    reference: Reference
    weights: FloatImage
    difference: FloatImage
    moments: FloatArray
    gain_fit: GainFit | None = None

    @classmethod
    def at(
        cls,
        reference: Reference,
        deformed: Deformed,
        displacements: Sequence[FloatArray],
        last: Residual | None = None,
    ) -> Residual:
        """At one nodal displacement (N, 2) per light.

        Parameters
        ----------
        reference, deformed
            Images of both states.
        displacements : sequence of ndarray, shape (N, 2)
            Nodal displacement of every light in px.
        last
            Residual whose weights it takes, if they stay as they are.

        Returns
        -------
        Residual
        """
        values, pixels, shape = reference.values, reference.pixels, deformed.weights.shape[1:]
        moments, difference = np.empty((len(values), len(reference.mesh.elements), 6)), np.empty_like(values)
        is_changed, warps = np.zeros(moments.shape[:2], dtype=bool), list(reference.warps(deformed, displacements))
        weights, fit = (reference.pixel_weights, reference.gain_fit) if last is None else (last.weights, last.gain_fit)
        if last is None:
            for lights, warp in warps:
                find_changed_weights(deformed.nonuniform_weight_blocks[lights], *shape, *warp, is_changed[lights])
        if is_changed.any():
            weights = weights.copy()
        for lights, warp in warps:
            states = deformed.coefficients[lights], deformed.weights[lights], values[lights]
            reference_weights = reference.pixel_weights[lights], is_changed[lights]
            outputs = difference[lights], weights[lights], moments[lights]
            compare_states(*states, *reference_weights, *warp, pixels.offsets, *outputs)
        height, width = pixels.bounds[2:]
        if fit is not None and is_changed.any():
            fit = GainFit.over(values, weights, pixels, fit.sigma)
        gain, offset = np.ones(len(values)), np.zeros((len(values), 3))
        if reference.brightness != "none":
            centres = reference.mesh.centres - pixels.bounds[1::-1]
            gain, offset = gain_and_offset(moments, centres, reference.constants.min_gain_correlation)
        scales = inverse_gains(difference, gain, offset, fit, (height, width), reference.constants.least_gain)
        rows = pixels.lines, pixels.run_offsets, pixels.offsets
        correct_brightness(values, reference.inverse_level, *scales, offset, *rows, difference)
        return cls(reference=reference, weights=weights, difference=difference, moments=moments, gain_fit=fit)

    @property
    def contrast(self) -> float:
        """Weighted variance of the reference's grey levels over their squared mean, of the lights together."""
        total, f, _, ff, _, _ = self.moments.sum(axis=1).T
        mean = f / np.maximum(total, 1e-30)
        relative = np.divide(ff / np.maximum(total, 1e-30), mean * mean, out=np.ones_like(mean), where=mean != 0) - 1
        return max(float(relative.mean()), 0.0)

    def squares(self, weights: FloatImage) -> FloatArray:
        """Sum w r^2, w and the pixels with weight over each element, for the solve's `weights` (k, P).

        The result has the shape (k, E, 3).

        Parameters
        ----------
        weights : ndarray, shape (k, P)
            Weights of the solve.

        Returns
        -------
        ndarray, shape (k, E, 3)
        """
        pixels = self.reference.pixels
        out = np.empty((len(weights), len(pixels.origin), 3))
        element_squares(self.difference, weights, pixels.offsets, out)
        return out

    def with_values(self, values: FloatImage) -> Residual:
        """Return it for other grey levels (k, P) of the reference, with the brightness as it is.

        Parameters
        ----------
        values : ndarray, shape (k, P), float32
            Such as those of a reference before `Reference.filtered_as`.

        Returns
        -------
        Residual
        """
        if values is self.reference.values:
            return self
        difference = values - self.reference.values
        difference *= self.reference.inverse_level
        difference += self.difference
        return replace(self, difference=difference)

    def design_effect(self, difference: FloatImage, weight: FloatImage) -> FloatImage:
        """Return the variance of a residual's scores over what white noise of the same variance would give, (P,).

        Parameters
        ----------
        difference : ndarray, shape (P,), float32
            The residual, such as the mean of several lights'; its gradient is that of their common texture.
        weight : ndarray, shape (P,), float32
            Its inverse variance.

        Returns
        -------
        ndarray, shape (P,), float32
        """
        mean, texture = replace(self, difference=difference[None]), self.reference.texture.texture[:, None]
        table = BlockTable.of(mean, weight[None], gradient=texture)
        xx, _, yy = table.design_effect()[0]
        # at least 0.01: of images without noise it is not 0 (up to twice of it nothing changes)
        fraction = np.maximum(xx + yy, 0.01)
        return np.asarray(self.reference.pixels.from_blocks(fraction[None], table.side)[0])

    @property
    def smooth_fraction(self) -> float:
        """Fraction of the squares that is alike over blocks of the gain's window; 0 where the gain is one number."""
        if (fit := self.gain_fit) is None:
            return 0.0
        smooth, total = fit.block_sums(self.difference).astype(np.float64), fit.totals
        squares = float(self.squares(self.weights)[..., 0].sum())
        return float((smooth**2 / np.maximum(total, 1e-30)).sum()) / max(squares, 1e-300)


class PrecisionMethod(Protocol):
    """A method of weighting that learns from the residual; `rgbmidic.weights.Statistics` is the package's own.

    Examples
    --------
    >>> class EqualLights:
    ...     def precision(self, residual: Residual) -> Precision:
    ...         factor = np.ones_like(residual.weights)
    ...         return Precision(factor=factor, loss_curvature=factor[0])
    >>> method: PrecisionMethod = EqualLights()
    """

    def precision(self, residual: Residual) -> Precision | None:
        """Precision of the lights for the next pass; None leaves the weights as they are given.

        Parameters
        ----------
        residual
            Of the pass before.

        Returns
        -------
        Precision or None
        """
        ...


def curved_deviation(
    mesh: Tri3Mesh, barycentric: FloatArray, nodal_offset: FloatArray, curvature: FloatArray
) -> FloatImage:
    """Polynomials of what a curved field has over its own linear fit in every element.

    Along an edge the second derivative is the mean of its ends. Over its linear interpolant the field has the
    continuous ``-1/2 sum_{a<b} phi_a phi_b (x_a - x_b)^T H_ab (x_a - x_b)``.

    Parameters
    ----------
    mesh
        N nodes, E elements.
    barycentric : ndarray, shape (E, 3, 3)
        Shape functions, see `PixelMap`.
    nodal_offset : ndarray, shape (N, 2)
        What the linear fit has at the nodes beyond the field, px.
    curvature : ndarray, shape (N, 2, 3)
        Second derivatives xx, xy, yy of the field at the nodes, 1/px.

    Returns
    -------
    ndarray, shape (E, 2, 6), float32
        Coefficients of 1, x, y, x^2, x y, y^2 of the local position.
    """
    first, second = mesh.elements, np.roll(mesh.elements, -1, axis=1)
    (x, y), second_derivative = (
        np.moveaxis(mesh.nodes[first] - mesh.nodes[second], -1, 0),
        curvature[first] + curvature[second],
    )
    sag = -0.25 * (second_derivative @ np.stack([x * x, 2 * x * y, y * y], axis=-1)[..., None])[..., 0]
    (a0, a1, a2), (b0, b1, b2) = (np.moveaxis(phi, -1, 0) for phi in (barycentric, np.roll(barycentric, -1, axis=1)))
    products = np.stack([a0 * b0, a0 * b1 + a1 * b0, a0 * b2 + a2 * b0, a1 * b1, a1 * b2 + a2 * b1, a2 * b2], axis=-1)
    deviation = sag.transpose(0, 2, 1) @ products
    deviation[..., :3] -= nodal_offset[first].transpose(0, 2, 1) @ barycentric
    return np.asarray(deviation, dtype=np.float32)


_FITTED_PAIRS = 12
"""Pairs to which the motion around a node is fitted: four times the three that determine an affine motion. With half or
twice of it results differ by 5e-6 px at most (measured)."""


def interpolate_motion(points: FloatArray, motion: FloatArray, mesh: Tri3Mesh, scale: float) -> FloatArray:
    """Interpolate motion (P, 2) of points (P, 2) at the nodes (N, 2): one affine field, and what a local one adds.

    Both are robust fits, with Cauchy weights of `scale` px. Around a node it is that of the nearest `_FITTED_PAIRS`
    points, around the nodes at a crack of those on their own side.
    """
    nodes = mesh.nodes
    middle, size = points.mean(axis=0), np.ptp(points, axis=0).max() + 1.0
    basis, at_nodes = (np.c_[np.ones(len(positions)), (positions - middle) / size] for positions in (points, nodes))
    affine = robust_fit(basis[None], motion[None], 1e-6, 4 * scale)[0]
    remainder = motion - basis @ affine
    distance, near = map(
        np.asarray, cKDTree(points).query(mesh.observation_points, k=[*range(1, min(_FITTED_PAIRS, len(points)) + 1)])
    )
    step = (points[near] - nodes[:, None]) / np.maximum(distance[:, -1:, None], 1.0)
    local = np.concatenate([np.ones((*step.shape[:2], 1)), step], axis=2)
    return np.asarray(at_nodes @ affine + robust_fit(local, remainder[near], 0.3, scale)[:, 0])


def refine_by_patch_matching(residual: Residual, displacement: FloatArray) -> FloatArray:
    """Bring an initial guess to within some tenths of a pixel by matching patches around the nodes.

    Both states are compared as the residual holds them, in the reference's axes, so that turn and strain of the guess
    are no hindrance. What the patches move by beyond the guess is followed as in `interpolate_motion`: nodes whose
    patch is not found move as those around them.

    Parameters
    ----------
    residual
        At the initial guess.
    displacement : ndarray, shape (N, 2)
        The guess, at most 8 px away in x and y.

    Returns
    -------
    ndarray, shape (N, 2)
        px; the guess itself where too few patches are found.
    """
    # Pictures are reduced: a speckle of 4 px keeps 2, and they cost 16 times less. A patch reaches so many pixels to
    # each side of its node there: 26 px hold some 40 speckles, of which chance reaches a correlation of .3 in 81 places
    # (derived). Its largest shift is 8 px of the image, two speckles: twice as many cost 3 times as much. It has been
    # found from a correlation coefficient as in `Search.confidence`.
    reduction, half, max_shift, min_score = 2, 6, 4, 0.5
    mesh, pixels, reach = residual.reference.mesh, residual.reference.pixels, half + max_shift
    f, g = _reduced(residual, reduction, reach)
    first_row, first_column = pixels.bounds[:2]
    at = np.round((mesh.nodes - (first_column, first_row) - (reduction - 1) / 2) / reduction).astype(int) + reach
    at = np.clip(at, reach, np.array(f.shape)[::-1] - reach - 1)
    scores = np.zeros((len(at), 2 * max_shift + 1, 2 * max_shift + 1), dtype=np.float32)
    for out, (x, y) in zip(scores, at, strict=True):
        patch = f[y - half : y + half + 1, x - half : x + half + 1]
        if patch.min() < patch.max():  # of a blank patch OpenCV says that it is everywhere
            search_window = g[y - reach : y + reach + 1, x - reach : x + reach + 1]
            out[:] = cv2.matchTemplate(search_window, patch, cv2.TM_CCOEFF_NORMED)
    score, (i, j) = scores.max(axis=(1, 2)), np.divmod(scores.reshape(len(at), -1).argmax(axis=1), 2 * max_shift + 1)
    node = np.flatnonzero((score >= min_score) & (i > 0) & (i < 2 * max_shift) & (j > 0) & (j < 2 * max_shift))
    if len(node) < _FITTED_PAIRS:
        return displacement
    i, j, peak = i[node], j[node], score[node]
    shift = np.stack([j, i], axis=1) - float(max_shift)
    for axis, (di, dj) in enumerate(((0, 1), (1, 0))):
        previous_score, next_score = scores[node, i - di, j - dj], scores[node, i + di, j + dj]
        curvature = previous_score - 2 * peak + next_score
        # the crest of the parabola through three values, of which the middle one is the largest
        shift[:, axis] += np.divide(
            (previous_score - next_score) / 2, curvature, out=np.zeros_like(curvature), where=curvature < 0
        )
    shift *= reduction
    motion = shift + np.einsum("nij,nj->ni", mesh.nodal_gradient(displacement)[node], shift)
    return displacement + interpolate_motion(mesh.nodes[node], motion, mesh, 1.0)


def _reduced(residual: Residual, side: int, border: int) -> FloatImage:
    """Return reduced pictures (2, h, w) of both states: the lights' deviations from their means, added; 0 around."""
    pixels, weights = residual.reference.pixels, residual.weights
    count = pixels.block_sums(weights, side)
    level = count.sum(axis=(1, 2), dtype=np.float64)[:, None, None]
    pictures = []
    f = residual.reference.values * residual.reference.inverse_level
    for values in (f, f - residual.difference):
        sums = pixels.block_sums(values * weights, side)
        mean = sums.sum(axis=(1, 2), dtype=np.float64)[:, None, None] / np.maximum(level, 1e-30)
        total = (sums - mean.astype(np.float32) * count).sum(axis=0)
        pictures.append(np.pad(total / np.maximum(count.sum(axis=0), np.float32(1e-6)), border))
    return np.stack(pictures)
