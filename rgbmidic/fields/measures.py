"""Finite strain of a displacement gradient, its principal values and its uncertainty; and rigid motion.

With the deformation gradient ``F = I + H`` and the stretch ``U = sqrt(F^T F)``: Green-Lagrange ``(U^2 - I) / 2``,
Hencky ``ln U``, Biot ``U - I``, engineering (small strain) ``(H + H^T) / 2``. All are in the axes of the reference. The
first three are functions of ``C = F^T F`` alone, hence independent of rotation, and have its eigenvectors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.fields.nodal import NodalCovariance
from rgbmidic.typing import FloatArray

_Function = Callable[[FloatArray], FloatArray]
_OF_STRETCH: dict[str, tuple[_Function, _Function]] = {
    "green-lagrange": (lambda c: (c - 1) / 2, lambda c: np.full_like(c, 0.5)),
    "hencky": (lambda c: np.log(c) / 2, lambda c: 0.5 / c),
    "biot": (lambda c: np.sqrt(c) - 1, lambda c: 0.5 / np.sqrt(c)),
}
"""Each measure as a function of an eigenvalue of C, and its derivative."""
MEASURES = (*_OF_STRETCH, "engineering")
"""Names of the strain measures; the first is the default."""
_SMALL = np.array([[1, 0, 0, 0], [0, 0, 0, 1], [0, 0.5, 0.5, 0]])
"""Derivative of the small exx, eyy, exy by the gradient."""
_LARGEST_ANGLE = np.degrees(np.pi / np.sqrt(12))
"""Standard uncertainty (degrees) of a direction of which nothing is known."""
_EQUIVALENT = np.array([[4 / 3, 2 / 3, 0], [2 / 3, 4 / 3, 0], [0, 0, 4 / 3]])
"""``e^T A e`` for the Hencky strain e = (exx, eyy, exy) is the square of the von Mises equivalent at constant volume:
only there is constant volume ``e1 + e2 + e3 = 0``, so that the third principal strain is known."""
EQUIVALENT = "von Mises equivalent of the Hencky strain, for a material of constant volume"
"""Description of the equivalent strain wherever it is stated."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Strain:
    """Strain at some places, in the axes x, y of the reference; NaN where it is not measured.

    Attributes
    ----------
    measure
        One of `MEASURES`.
    components, components_std : ndarray, shape (..., 3)
        exx, eyy, exy (tensor shear) and their standard uncertainty.
    principal, principal_std : ndarray, shape (..., 2)
        The larger and the smaller principal strain, in the plane.
    direction_deg, direction_std_deg : ndarray, shape (...)
        Direction of the larger one on the reference, from x towards y, between -90 and 90 degrees. Where both are the
        same within their uncertainty it means nothing, and the uncertainty tends to 52 degrees; NaN without strain.
    equivalent, equivalent_std : ndarray, shape (...)
        Von Mises equivalent of the Hencky strain at constant volume, ``sqrt(4/3 (h1^2 + h1 h2 + h2^2))``, whatever
        `measure` is: ``ln`` of the stretch in a tensile test. Where the volume changes it is another number: in tension
        with a Poisson ratio of .3 it is 2.6 % too large. Being positive, it is more than 0 in noise alone, by about
        its uncertainty.
    shear, shear_std : ndarray, shape (...)
        Largest shear angle in the plane, ``e1 - e2``: engineering shear, twice the tensor's. Positive, see `length_of`.
    """

    measure: str
    components: FloatArray
    components_std: FloatArray
    principal: FloatArray
    principal_std: FloatArray
    direction_deg: FloatArray
    direction_std_deg: FloatArray
    equivalent: FloatArray
    equivalent_std: FloatArray
    shear: FloatArray
    shear_std: FloatArray


def length_of(parts: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute the length of vectors and its standard uncertainty: first order where long, else that of noise alone.

    A length is positive: of nothing but noise it is as large as the noise, where the first order fails. By as much as
    its square exceeds the noise's, the first order counts.

    Parameters
    ----------
    parts : ndarray, shape (..., d)
        Components of the vectors.
    covariance : ndarray, shape (..., d, d)
        Of the components.

    Returns
    -------
    length, std : ndarray, shape (...)
    """
    square, noise = (parts**2).sum(axis=-1), np.einsum("...aa->...", covariance)
    over = np.where(square > 0, square, 1.0)
    first = np.einsum("...a,...ab,...b->...", parts, covariance, parts) / over
    long = np.maximum(square - noise, 0) / over
    return np.sqrt(square), np.sqrt(np.maximum(long * first + (1 - long) * noise, 0))


def strain_of_gradient(gradient: FloatArray, covariance: FloatArray, measure: str = MEASURES[0]) -> Strain:
    """Compute the strain of displacement gradients and, to first order, its standard uncertainty.

    Parameters
    ----------
    gradient : ndarray, shape (..., 2, 2)
        ``H[c, d]``: derivative of the displacement c by the coordinate d.
    covariance : ndarray, shape (..., 4, 4)
        Of ``H`` row by row: du/dx, du/dy, dv/dx, dv/dy.
    measure
        One of `MEASURES`.

    Returns
    -------
    Strain
        Of the shape (...).

    Raises
    ------
    InputError
        The measure is unknown.
    """
    if measure not in MEASURES:
        raise InputError(f'unknown strain measure "{measure}"; allowed are {", ".join(MEASURES)}')
    shape = gradient.shape[:-2]
    h, spread = gradient.reshape(-1, 2, 2), covariance.reshape(-1, 4, 4)
    hencky = _of_stretch(h, *_OF_STRETCH["hencky"])
    if measure == "engineering":
        tensor, slopes = (h + h.transpose(0, 2, 1)) / 2, _SMALL
    else:
        tensor, slopes = hencky if measure == "hencky" else _of_stretch(h, *_OF_STRETCH[measure])
    covariance, of_hencky = (slope @ spread @ np.swapaxes(slope, -1, -2) for slope in (slopes, hencky[1]))
    principal, vectors = _eigen(tensor)
    c, s = vectors[:, 0, 0], vectors[:, 1, 0]
    along, across = np.stack([c * c, s * s, 2 * c * s], axis=1), np.stack([s * s, c * c, -2 * c * s], axis=1)
    turn = np.stack([-c * s, c * s, c * c - s * s], axis=1)
    split = np.array([[1.0, -1.0, 0.0], [0.0, 0.0, 2.0]])  # exx - eyy and 2 exy, whose length is e1 - e2
    shear, shear_std = length_of(_components(tensor) @ split.T, split @ covariance @ split.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        equivalent, equivalent_std = _equivalent(_components(hencky[0]), of_hencky)
        apart = principal[:, 0] - principal[:, 1]
        direction_std = np.degrees(_deviation(turn, covariance) / apart)
    parts = {
        "components": _components(tensor),
        "components_std": np.sqrt(np.maximum(np.einsum("naa->na", covariance), 0)),
        "principal": principal,
        "principal_std": np.stack([_deviation(along, covariance), _deviation(across, covariance)], axis=1),
        "direction_deg": np.where(apart > 0, (np.degrees(np.arctan2(s, c)) + 90) % 180 - 90, np.nan),
        "direction_std_deg": np.minimum(direction_std, _LARGEST_ANGLE),
        "equivalent": equivalent,
        "equivalent_std": equivalent_std,
        "shear": shear,
        "shear_std": shear_std,
    }
    return Strain(measure=measure, **{name: part.reshape((*shape, *part.shape[1:])) for name, part in parts.items()})


def _of_stretch(gradient: FloatArray, function: _Function, derivative: _Function) -> tuple[FloatArray, FloatArray]:
    """Compute a function of C (n, 2, 2) and the derivative (n, 3, 4) of xx, yy, xy by H (Daleckii and Krein)."""
    f = np.eye(2) + gradient
    values, vectors = _eigen(f.transpose(0, 2, 1) @ f)
    values = np.maximum(values, np.finfo(float).tiny)
    at = function(values)
    gap, mean = values[:, 1] - values[:, 0], values.mean(axis=1)
    close = np.abs(gap) < 1e-6  # an error of 1e-10 at most
    across = np.where(close, derivative(mean), (at[:, 1] - at[:, 0]) / np.where(close, 1, gap))
    along = derivative(values)
    # what a change of H[c, d] alone makes of C along the axes a and b of C: F_ca V_db + V_da F_cb, F turned by V
    turned = f @ vectors
    change = [turned[:, :, None, a] * vectors[:, None, :, b] for a in (0, 1) for b in (0, 1)]
    parts = [2 * change[0] * along[:, 0, None, None], 2 * change[3] * along[:, 1, None, None]]
    parts.append((change[1] + change[2]) * across[:, None, None])
    first, second, shear = (part.reshape(-1, 4) for part in parts)
    slope = np.empty((len(f), 3, 4))
    for row, (i, j) in enumerate(((0, 0), (1, 1), (0, 1))):
        (vi, wi), (vj, wj) = vectors[:, i].T[..., None], vectors[:, j].T[..., None]
        slope[:, row] = vi * vj * first + wi * wj * second + (vi * wj + wi * vj) * shear
    return (vectors * at[:, None]) @ vectors.transpose(0, 2, 1), slope


def _eigen(tensor: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute eigenvalues (n, 2), the larger first, and eigenvectors (n, 2, 2) in columns; NaN for NaN."""
    half, shear = (tensor[:, 0, 0] - tensor[:, 1, 1]) / 2, tensor[:, 0, 1]
    middle, radius, angle = half + tensor[:, 1, 1], np.hypot(half, shear), np.arctan2(shear, half) / 2
    c, s = np.cos(angle), np.sin(angle)
    vectors = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    return np.stack([middle + radius, middle - radius], axis=1), vectors


def _components(tensor: FloatArray) -> FloatArray:
    return np.stack([tensor[:, 0, 0], tensor[:, 1, 1], tensor[:, 0, 1]], axis=1)


def _deviation(direction: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.maximum(np.einsum("na,nab,nb->n", direction, covariance, direction), 0)))


def _equivalent(e: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute the equivalent strain (n,) and its uncertainty: first order where large, else that of noise alone."""
    square = np.einsum("na,ab,nb->n", e, _EQUIVALENT, e)
    noise = np.einsum("ab,nab->n", _EQUIVALENT, covariance)
    slope = e @ _EQUIVALENT
    first = np.einsum("na,nab,nb->n", slope, covariance, slope) / np.where(square > 0, square, np.inf)
    large = square / (square + noise)
    return np.sqrt(square), np.sqrt(large * first + (1 - large) * noise)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigidMotion:
    """Shift and rotation that fit a displacement field best, by least squares over its measured nodes.

    Attributes
    ----------
    centre : ndarray, shape (2,)
        Middle of the measured nodes on the reference, px: the shift is that of this point.
    shift, shift_std : ndarray, shape (2,)
        In px.
    rotation, rotation_std : float
        In rad, from x towards y.
    """

    centre: FloatArray
    shift: FloatArray
    shift_std: FloatArray
    rotation: float
    rotation_std: float

    @classmethod
    def of(
        cls, covariance: NodalCovariance, u: FloatArray, v: FloatArray, u_std: FloatArray, v_std: FloatArray
    ) -> Self:
        """Fit shift and rotation of any size (Kabsch, Acta Cryst A32, 1976).

        Parameters
        ----------
        covariance
            Of the mesh.
        u, v, u_std, v_std : ndarray, shape (N,)
            In px; NaN where not measured.

        Returns
        -------
        RigidMotion

        Raises
        ------
        InputError
            Fewer than two nodes are measured.
        """
        nodes, known = covariance.mesh.nodes, np.isfinite(u + v + u_std + v_std)
        if known.sum() < 2:
            raise InputError("a rigid motion needs two measured nodes or more")
        centre = nodes[known].mean(axis=0)
        arm, moved = nodes[known] - centre, np.stack([u, v], axis=1)[known]
        shift = moved.mean(axis=0)
        there = arm + moved - shift
        along, turned = (arm * there).sum(), (arm[:, 0] * there[:, 1] - arm[:, 1] * there[:, 0]).sum()
        even = known / known.sum()
        lever = np.zeros((2, len(nodes)))
        angle = float(np.arctan2(turned, along))
        # d(angle) = sum of (arm, turned along) x d(moved) / (arm . there)
        c, s = np.cos(angle), np.sin(angle)
        lever[:, known] = np.stack([-(s * arm[:, 0] + c * arm[:, 1]), c * arm[:, 0] - s * arm[:, 1]]) / np.hypot(
            along, turned
        )
        variance = [covariance.variance(even, part) for part in (u_std, v_std)]
        turning = covariance.variance(lever[0], u_std) + covariance.variance(lever[1], v_std)
        return cls(
            centre=centre,
            shift=shift,
            shift_std=np.sqrt(np.array(variance)),
            rotation=angle,
            rotation_std=float(np.sqrt(turning)),
        )

    def removed(self, nodes: FloatArray, field: FloatArray) -> FloatArray:
        """Subtract the rigid motion from a displacement field: the field in axes that move with the body.

        The remaining displacements are rotated back, so that lengths and strains stay as they are.

        Parameters
        ----------
        nodes : ndarray, shape (N, 2)
            In px on the reference.
        field : ndarray, shape (4, N)
            u, v and their standard uncertainty, px. That of the rigid motion itself is not added: it is the less, the
            more nodes there are.

        Returns
        -------
        ndarray, shape (4, N)
            As `field`.
        """
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        back = np.array([[c, s], [-s, c]])
        arm = nodes - self.centre
        left = (arm + field[:2].T - self.shift) @ back.T - arm
        return np.concatenate([left.T, np.sqrt(back**2 @ field[2:] ** 2)])

    def at(self, points: FloatArray) -> FloatArray:
        """Compute the displacement (P, 2) in px of points (P, 2) by the rigid motion alone.

        Parameters
        ----------
        points : ndarray, shape (P, 2)
            Points (x, y) on the reference, px.

        Returns
        -------
        ndarray, shape (P, 2)
        """
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        return np.asarray((points - self.centre) @ (np.array([[c, -s], [s, c]]) - np.eye(2)).T + self.shift)
