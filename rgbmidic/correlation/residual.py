"""What the two states differ by at a displacement: f - g(x + u) of every light at the owned pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rgbmidic._kernels.correlation import element_squares, subtract_quadratic
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["Residual", "curved_deviation"]

_ROUNDING = 2e-7
"""Share of the sum of squares below which their sum beyond the mean is that of rounding, in single precision."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Residual:
    """Both states at the owned pixels of the reference.

    Attributes
    ----------
    reference
        The reference state.
    values : ndarray, shape (k, P), float32
        Grey levels f of the reference, corrected for brightness.
    weights : ndarray, shape (k, P), float32
        Weights given, brought back by the displacement; 0 where g is not known.
    difference : ndarray, shape (k, P), float32
        f - g(x + u); 0 where g is not known.
    moments : ndarray, shape (k, E, 6)
        Sums of w, w f, w g, w f f, w f g, w g g over the pixels of each element.
    """

    reference: Reference
    values: FloatImage
    weights: FloatImage
    difference: FloatImage
    moments: FloatArray

    @classmethod
    def at(
        cls, reference: Reference, deformed: Deformed, values: FloatImage, displacements: Sequence[FloatArray]
    ) -> Residual:
        """At one nodal displacement (N, 2) per light, for reference grey levels `values` (k, P)."""
        difference, weights = np.empty_like(values), np.empty_like(values)
        moments = np.empty((len(values), len(reference.mesh.elements), 6))
        for light, displacement in enumerate(displacements):
            out = difference[light], weights[light], moments[light]
            reference.bring_back(deformed, light, values[light], displacement, *out)
        return cls(reference=reference, values=values, weights=weights, difference=difference, moments=moments)

    @property
    def warped(self) -> FloatImage:
        """Grey levels g(x + u), (k, P); those of f where it is not known."""
        return self.values - self.difference

    def difference_from(self, values: FloatImage) -> FloatImage:
        """The same difference for other reference grey levels (k, P)."""
        return self.difference if values is self.values else self.difference + (values - self.values)

    def squares(self, weights: FloatImage) -> FloatArray:
        """Sums over each element of w r^2, of w and of the pixels with weight, for the solve's `weights` (k, P);
        shape (k, E, 3)."""
        out = np.empty((len(weights), len(self.reference.mesh.elements), 3))
        element_squares(self.difference, weights, self.reference.pixels.offsets, out)
        return out

    def centred_products(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Sums f g, f f and g g over each element, of what f and g are beyond their means in it, (k, E)."""
        total, f, g, ff, fg, gg = np.moveaxis(self.moments, -1, 0)
        total = np.maximum(total, 1e-30)
        beyond_f, beyond_g = (
            np.where(beyond > _ROUNDING * square, beyond, 0.0)
            for beyond, square in ((ff - f * f / total, ff), (gg - g * g / total, gg))
        )
        return fg - f * g / total, beyond_f, beyond_g

    def without(self, carried: FloatArray, curvature: FloatArray) -> Residual:
        """The same, less what a curved field has over its own linear fit.

        Parameters
        ----------
        carried : ndarray, shape (N, 2)
            What the fit has at the nodes beyond the field, px.
        curvature : ndarray, shape (N, 2, 3)
            Second derivatives xx, xy, yy of the field at the nodes, 1/px.
        """
        known, pixels, out = self.reference, self.reference.pixels, np.empty_like(self.difference)
        images = self.difference, known.gradient_x, known.gradient_y
        deviation = curved_deviation(known.material, pixels.barycentric, carried, curvature)
        subtract_quadratic(*images, deviation, pixels.local_x, pixels.local_y, pixels.offsets, out)
        return replace(self, difference=out)


def curved_deviation(mesh: Tri3Mesh, barycentric: FloatArray, carried: FloatArray, curvature: FloatArray) -> FloatImage:
    """What a curved field has over its own linear fit: (E, 2, 6), coefficients of 1, x, y, x^2, x y, y^2 of the local
    position in every element, whose shape functions are `barycentric` (E, 3, 3).

    Along an edge the second derivative is the mean of its ends. Over its linear interpolant the field has the
    continuous ``-1/2 sum_{a<b} phi_a phi_b (x_a - x_b)^T H_ab (x_a - x_b)``; its linear fit has `carried` (N, 2) more
    than the field at the nodes.
    """
    first, second = mesh.elements, np.roll(mesh.elements, -1, axis=1)
    (x, y), bend = np.moveaxis(mesh.nodes[first] - mesh.nodes[second], -1, 0), curvature[first] + curvature[second]
    sag = -0.25 * (bend @ np.stack([x * x, 2 * x * y, y * y], axis=-1)[..., None])[..., 0]
    (a0, a1, a2), (b0, b1, b2) = (np.moveaxis(phi, -1, 0) for phi in (barycentric, np.roll(barycentric, -1, axis=1)))
    products = np.stack([a0 * b0, a0 * b1 + a1 * b0, a0 * b2 + a2 * b0, a1 * b1, a1 * b2 + a2 * b1, a2 * b2], axis=-1)
    deviation = sag.transpose(0, 2, 1) @ products
    deviation[..., :3] -= carried[first].transpose(0, 2, 1) @ barycentric
    return np.asarray(deviation, dtype=np.float32)
