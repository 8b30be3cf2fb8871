"""Nodal fields: the covariance of nodes and of frames, rigid motion.

The solve is a least-squares fit of linear elements, whose covariance is the inverse of a Hessian: for a texture that is
alike everywhere the inverse of the mesh's mass matrix. The displacement at a node is then that of a quadratic through
the nodes around it, a linear function of theirs. Where the texture, the weights or the noise vary, the stated
uncertainty of each node reports by how much; its correlation with the others is taken as the mesh's alone, but for the
part that the lights' bias leaves.

The frames of a test have the noise of the reference in common, which cancels in differences and rates. The displacement
of frame t has the error ``b_t - r``: that of the frame's own noise, less the mean of the same for the n frames of the
reference. With equal noise in all frames the variance stated for t is ``(1 + 1/n) Var(b)``, of which the fraction
``1 / (1 + n)`` is the reference's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import scipy.sparse as sp
from numpy.polynomial import Chebyshev, Polynomial
from scipy.spatial.transform import Rotation

from rgbmidic.arguments import checked
from rgbmidic.errors import InputError
from rgbmidic.field import Displacement, Field
from rgbmidic.illumination.displacement import BIAS_CORRELATION_RANGE
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.recovery import Recovery
from rgbmidic.renamed import state_new_names
from rgbmidic.typing import BoolArray, FloatArray, IntArray

_ABOUT_AXES = -np.array([[[(i - j) * (j - k) * (k - i) / 2 for j in range(3)] for i in range(3)] for k in range(3)])
"""Of each axis of space the matrix whose product with an arm is the velocity of a rotation about it."""
_LOW, _HIGH = 0.5, 2.0
"""Bounds of the eigenvalues of a TRI3 mass matrix over its diagonal, on any mesh (Wathen, IMA J Numer Anal 7, 1987)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationErrors:
    """Errors that M independent causes of unit variance of a calibration make at n nodes, at all of them together.

    Attributes
    ----------
    surface : ndarray, shape (M, c, n)
        Of the places of the nodes.
    gain : ndarray, shape (M, c, c, n)
        Of each component of a displacement, over each component of it: nothing of what does not move.

    Examples
    --------
    >>> scale = 1e-3 * np.eye(3)[None, :, :, None]  # all lengths are off by a thousandth: one cause, one node
    >>> errors = CalibrationErrors(surface=np.zeros((1, 3, 1)), gain=scale)
    >>> errors.at_nodes(np.array([[2.0], [0.0], [-1.0]])).ravel().tolist()
    [0.002, 0.0, -0.001]
    """

    surface: FloatArray
    gain: FloatArray

    def at_nodes(self, values: FloatArray) -> FloatArray:
        """Return the errors of displacements of the nodes.

        Parameters
        ----------
        values : ndarray, shape (c, n)
            Displacements; NaN where a node has no data.

        Returns
        -------
        ndarray, shape (M, c, n)
            NaN where the displacements are.
        """
        return np.asarray(np.einsum("mijn,jn->min", self.gain, values))

    def subset(self, nodes: IntArray) -> Self:
        """Return the errors of some nodes alone.

        Parameters
        ----------
        nodes : ndarray, shape (m,), int
            Their indices.

        Returns
        -------
        CalibrationErrors
        """
        return replace(self, surface=self.surface[..., nodes], gain=self.gain[..., nodes])

    def of_sums(self, weights: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the errors of weighted sums of the nodes' places and of their displacements.

        Parameters
        ----------
        weights : ndarray, shape (..., S, n)
            Of the nodes.
        values : ndarray, shape (c, ..., n)
            Displacements; NaN only where the weight is 0.

        Returns
        -------
        surface, displacement : ndarray, shape (M, ..., c, S)
        """
        weighted = weights * np.nan_to_num(values)[..., None, :]
        return (
            np.einsum("...sn,min->m...is", weights, self.surface, optimize=True),
            np.einsum("j...sn,mijn->m...is", weighted, self.gain, optimize=True),
        )


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True)
class NodalCovariance:
    """Covariance of the errors of one displacement component between nodes; u and v are not correlated.

    A nodal error is that of the fit, correlated by the mesh, and what the bias of the lights leaves, which is alike
    over the window in which the lights are compared. Either correlation is kept as a factor ``F F^T``: an error is
    ``F z`` with independent z of unit variance, and no combination of nodes has a negative variance.

    Attributes
    ----------
    mesh
        The mesh.
    fit : csr_matrix, shape (n, R)
        Factor of the correlation of the fit's errors between the n nodes.
    bias : csr_matrix, shape (n, S)
        Factor of the correlation ``exp(-d^2 / (4 r^2))`` of the lights' bias at a distance d, with r its range: windows
        ``exp(-d^2 / (2 r^2))`` at places r apart have it to 1e-4.
    surface : ndarray, shape (n, 3), or None
        Places of the n nodes in space, in the unit of a displacement in space; None: it is in the mesh's plane.
    surface_covariance : ndarray, shape (3, 3, n), or None
        Covariance of each of these places; None: not known.
    calibration
        Errors of the calibration; None: there are none, or a scale has them.

    Examples
    --------
    >>> from rgbmidic.mesh import Region
    >>> mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 80, 60), shape=(80, 100)), element_size=20)
    >>> covariance = NodalCovariance.from_mesh(mesh)
    >>> covariance.fit.shape[0] == len(mesh.nodes)
    True
    """

    mesh: Tri3Mesh
    fit: sp.csr_matrix
    bias: sp.csr_matrix
    surface: FloatArray | None = None
    surface_covariance: FloatArray | None = None
    calibration: CalibrationErrors | None = None

    @classmethod
    def from_mesh(cls, mesh: Tri3Mesh, image_nodes: FloatArray | None = None) -> Self:
        """Propagate the covariance of the linear fit (inverse mass matrix) through the recovery of the nodal values.

        Parameters
        ----------
        mesh
            N nodes, E elements.
        image_nodes : ndarray, shape (N, 2)
            The nodes in px of the image, in which the lights' bias has its range; None: those of the mesh.

        Returns
        -------
        NodalCovariance
        """
        mass = mesh.mass_matrix
        scale = sp.diags(1 / np.sqrt(mass.diagonal()))
        everywhere = np.ones(len(mesh.elements), dtype=bool)
        recovery = Recovery.over(mesh, everywhere).value
        fit = recovery @ scale @ _inverse_root(sp.csr_matrix(scale @ mass @ scale))
        return cls(mesh=mesh, fit=unit_rows(fit), bias=_windows(mesh.nodes if image_nodes is None else image_nodes))

    @property
    def points(self) -> FloatArray:
        """Places of the mesh's nodes, in space where they are known there."""
        return self.mesh.nodes if self.surface is None else self.surface

    @property
    def correlation(self) -> sp.csr_matrix:
        """Correlation (n, n) of the fit's errors."""
        return sp.csr_matrix(self.fit @ self.fit.T)

    def factor(self, std: FloatArray, bias: FloatArray | float = 0.0) -> sp.csr_matrix:
        """Return the factor F (n, R + S) of the covariance ``F F^T`` of nodal values.

        Parameters
        ----------
        std : ndarray, shape (n,)
            Their standard uncertainty.
        bias : ndarray, shape (n,)
            The part of it that the lights' bias leaves.

        Returns
        -------
        csr_matrix, shape (n, R + S)
        """
        shared = np.minimum(bias, std)
        blocks = sp.diags(np.sqrt(std**2 - shared**2)) @ self.fit, sp.diags(shared) @ self.bias
        return sp.csr_matrix(sp.hstack(blocks))

    def errors(self, weights: FloatArray, std: FloatArray, bias: FloatArray | float = 0.0) -> FloatArray:
        """Resolve the errors of weighted sums of nodal values into independent errors of unit variance.

        The covariance of two sums is the product of their coefficients, the variance of one the sum of their squares.

        Parameters
        ----------
        weights : ndarray, shape (..., n)
            Of the nodes. Nodes of the weight 0 take no part, their uncertainty may be NaN.
        std : ndarray, shape (..., n)
            Standard uncertainty of the nodal values.
        bias : ndarray, shape (..., n)
            The part of it that the lights' bias leaves.

        Returns
        -------
        ndarray, shape (..., R + S)
        """
        weights, std = np.asarray(weights), np.asarray(std)
        shared = np.minimum(bias, std)
        stds = np.sqrt(std**2 - shared**2), shared
        weighted_stds = [np.where(weights != 0, weights * array, 0.0) for array in stds]
        shape = weighted_stds[0].shape[:-1]
        factors = zip(weighted_stds, (self.fit, self.bias), strict=True)
        flat = [array.reshape(-1, array.shape[-1]) @ factor for array, factor in factors]
        return np.concatenate(flat, axis=1).reshape(*shape, -1)

    def variance(self, weights: FloatArray, field: Field) -> FloatArray:
        """Compute the variance of weighted sums of nodal values.

        Parameters
        ----------
        weights : ndarray, shape (..., n)
            As of `errors`.
        field
            Of the n nodes, shape (..., n).

        Returns
        -------
        ndarray, shape (...)
        """
        return np.asarray((self.errors(weights, field.uncertainty, field.bias_std) ** 2).sum(axis=-1))

    def of_sums(self, weights: FloatArray, displacement: Displacement) -> FloatArray:
        """Compute the covariance of S weighted sums of each of the c components of a displacement.

        Parameters
        ----------
        weights : ndarray, shape (..., S, n)
            Of the nodes.
        displacement
            Of the n nodes, shape (c, ..., n).

        Returns
        -------
        ndarray, shape (..., c S, c S)
            Sums of the first component, then those of the next.
        """
        factor = displacement.error_factor[..., None, :]
        bias = np.zeros_like(factor)
        bias[np.diag_indices(len(factor))] = np.nan_to_num(displacement.bias_std)[..., None, :]
        rows = [
            [self.errors(weights * np.sign(part), np.abs(part), shared) for part, shared in zip(*pair, strict=True)]
            for pair in zip(factor, bias, strict=True)
        ]
        errors = np.concatenate([np.concatenate(row, axis=-1) for row in rows], axis=-2)
        return np.asarray(errors @ np.swapaxes(errors, -1, -2))

    def relative(self, matrices: Sequence[sp.csr_matrix]) -> Self:
        """Return the covariance of quantities (n,), each over its standard uncertainty.

        Parameters
        ----------
        matrices : length c, of csr_matrix, shape (n, N)
            A quantity is the sum of so many displacement components, each weighted over the nodes by one of them.

        Returns
        -------
        NodalCovariance
        """
        fit, bias = (unit_rows(sp.hstack([matrix @ root for matrix in matrices])) for root in (self.fit, self.bias))
        return replace(self, fit=fit, bias=bias)

    def moved(self, displacement: Displacement) -> Self:
        """Return the covariance with the nodes at their deformed places; those without data stay.

        Parameters
        ----------
        displacement
            Of the N nodes, in the unit of their `points`, shape (c, N).

        Returns
        -------
        NodalCovariance
        """
        deformed = self.points + np.nan_to_num(displacement.values.T)
        if self.surface is not None:
            return replace(self, surface=deformed)
        return replace(self, mesh=Tri3Mesh(nodes=deformed, elements=self.mesh.elements))

    def subset(self, nodes: IntArray) -> Self:
        """Return the covariance of some nodes alone.

        Parameters
        ----------
        nodes : ndarray, shape (m,)
            Their indices.

        Returns
        -------
        NodalCovariance
        """
        fit, bias = (factor[nodes] for factor in (self.fit, self.bias))
        part = replace(self, fit=fit[:, np.unique(fit.indices)], bias=bias[:, np.unique(bias.indices)])
        if self.surface is not None:
            part = replace(part, surface=self.surface[nodes])
        if self.surface_covariance is not None:
            part = replace(part, surface_covariance=self.surface_covariance[..., nodes])
        if self.calibration is not None:
            part = replace(part, calibration=self.calibration.subset(nodes))
        return part


def _inverse_root(matrix: sp.csr_matrix, degree: int = 4) -> sp.csr_matrix:
    """Approximate the inverse root of a matrix with eigenvalues in the bounds above by a polynomial of a `degree`.

    That through the root's values at Chebyshev's points: within .3 % of it. The degree is the number of edges from a
    node up to which its row is kept.
    """
    root = Chebyshev.interpolate(lambda x: x**-0.5, degree, domain=[_LOW, _HIGH]).convert(kind=Polynomial)
    unit: Any = sp.eye(matrix.shape[0], format="csr")
    total = 0 * unit
    for coefficient in root.coef[::-1]:
        total = total @ matrix + coefficient * unit
    return sp.csr_matrix(total)


def _windows(nodes: FloatArray) -> sp.csr_matrix:
    """Gaussian windows around places a range of the lights' bias apart, at nodes (N, 2) in px of the image, (N, S)."""
    at = nodes / BIAS_CORRELATION_RANGE
    near = np.round(at - at.min(axis=0)).astype(np.int64)[:, :, None] + np.arange(7)  # three on either side
    x, y = np.exp(-((at[:, :, None] - at.min(axis=0)[:, None] + 3 - near) ** 2) / 2).swapaxes(0, 1)
    centre_index = near[:, 1, :, None] * (near[:, 0].max() + 1) + near[:, 0, None]
    heights = y[:, :, None] * x[:, None]
    node, row, column = np.nonzero(heights > 0.007)  # of 1: the correlation is right to .01
    return unit_rows(sp.csr_matrix((heights[node, row, column], (node, centre_index[node, row, column]))))


def unit_rows(matrix: sp.csr_matrix) -> sp.csr_matrix:
    """Scale rows to unit length; those of zeros or NaN become zeros."""
    length = np.sqrt(np.asarray(matrix.multiply(matrix).sum(axis=1)).ravel())
    unit = sp.csr_matrix(sp.diags(np.divide(1, length, out=np.zeros_like(length), where=length > 0)) @ matrix)
    unit.data = np.nan_to_num(unit.data)
    return unit


@checked
def reference_fraction(count: int) -> float:
    """Return the fraction of a frame's variance that comes from the mean of `count` reference frames, common to all.

    Parameters
    ----------
    count
        Number of reference frames.

    Returns
    -------
    float

    Raises
    ------
    InputError
        There is no reference frame.

    Examples
    --------
    >>> reference_fraction(1), reference_fraction(4)
    (0.5, 0.2)
    """
    if count < 1:
        raise InputError(f"a reference is of one frame or more, not {count}")
    return 1 / (1 + count)


@checked
def frame_covariance(std: FloatArray, common_fraction: float, references: Sequence[bool] | BoolArray) -> FloatArray:
    """Compute the covariance between frames of a quantity that is measured in each.

    Two frames have the reference's part in common, `common_fraction` of the smaller of their variances: where one of
    them is less certain, because it sees fewer lights or has changed more, the excess is independent (the covariance
    of an estimate with the best one is the variance of the best). A frame of the reference, whose own noise is a part
    of the mean that is subtracted, has nothing in common with the others: the only one is 0 without uncertainty, n of
    them are correlated by ``-1/(n - 1)``.

    Parameters
    ----------
    std : ndarray, shape (T, ...)
        Standard uncertainty in each frame.
    common_fraction
        See `reference_fraction`.
    references : (T,), bool
        Which of the frames belong to the reference.

    Returns
    -------
    ndarray, shape (T, T, ...)

    Raises
    ------
    InputError
        The fraction is not in 0 to 1/2, or not every frame has a statement of its reference.

    Examples
    --------
    >>> frame_covariance(np.array([0.0, 0.1, 0.1]), 0.5, [True, False, False]).round(6).tolist()
    [[0.0, 0.0, 0.0], [0.0, 0.01, 0.005], [0.0, 0.005, 0.01]]
    """
    variance, reference = np.asarray(std, dtype=np.float64) ** 2, np.asarray(references, dtype=bool)
    if not 0 < common_fraction <= 0.5 or reference.ndim != 1 or variance.shape[:1] != reference.shape:
        raise InputError(
            "frames have 1/2 of their variance in common or less, above 0, and each belongs to the reference or not; "
            f"given are {common_fraction:g}, and {reference.shape} for {variance.shape}"
        )
    either_reference, both_references = reference[:, None] | reference[None], reference[:, None] & reference[None]
    count = round(1 / common_fraction) - 1
    factor = np.where(both_references, -1 / max(count - 1, 1), np.where(either_reference, 0.0, common_fraction))
    np.fill_diagonal(factor, 1.0)
    factor = factor.reshape(factor.shape + (1,) * (variance.ndim - 1))
    return np.asarray(factor * np.minimum(variance[:, None], variance[None]))


@checked
def difference_std(first: FloatArray, second: FloatArray, common_fraction: float) -> FloatArray:
    """Compute the standard uncertainty of a quantity's difference between two frames that are no reference.

    Parameters
    ----------
    first, second : ndarray
        Standard uncertainty in either frame.
    common_fraction
        See `reference_fraction`.

    Returns
    -------
    ndarray

    Raises
    ------
    InputError
        The uncertainties are not of one shape.

    Examples
    --------
    >>> difference_std(np.array([0.02]), np.array([0.02]), common_fraction=0.5).round(6).tolist()
    [0.02]
    """
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if 1 not in (first.size, second.size) and first.shape != second.shape:
        raise InputError(f"uncertainties of one quantity have one shape, not {first.shape} and {second.shape}")
    shared = common_fraction * np.minimum(first, second) ** 2
    return np.asarray(np.sqrt(first**2 + second**2 - 2 * shared))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigidMotion:
    """Shift and rotation that fit a displacement field best, by least squares over its measured nodes.

    Attributes
    ----------
    centre : ndarray, shape (c,)
        Middle of the measured nodes on the reference: the shift is that of this point.
    shift
        In the unit of the displacement, shape (c,).
    rotation
        In rad: in the plane from x towards y, a number; in space the rotation vector, shape (3,).
    back : ndarray, shape (c, c)
        Rotation by the opposite angle.

    Examples
    --------
    >>> from rgbmidic.mesh import Region
    >>> mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 80, 60), shape=(80, 100)), element_size=20)
    >>> zero = np.zeros(len(mesh.nodes))
    >>> shifted = Displacement.in_plane(zero + 1, zero, zero + 0.01, zero + 0.01)
    >>> motion = RigidMotion.of(NodalCovariance.from_mesh(mesh), shifted)
    >>> motion.shift.values.round(6).tolist()
    [1.0, 0.0]
    """

    centre: FloatArray
    shift: Field
    rotation: Field
    back: FloatArray

    @classmethod
    def of(cls, covariance: NodalCovariance, displacement: Displacement) -> Self:
        """Fit shift and rotation of any size (Kabsch, Acta Cryst A32, 1976).

        Parameters
        ----------
        covariance
            Of the mesh.
        displacement
            Of its N nodes in one frame, shape (c, N); NaN where not measured.

        Returns
        -------
        RigidMotion

        Raises
        ------
        InputError
            Fewer than two nodes are measured.
        """
        nodes, is_measured, unit = covariance.points, displacement.is_measured, displacement.unit
        if is_measured.sum() < 2:
            raise InputError("a rigid motion needs two measured nodes or more")
        centre = nodes[is_measured].mean(axis=0)
        arm, values = nodes[is_measured] - centre, displacement.values.T[is_measured]
        shift = values.mean(axis=0)
        left, _, right = np.linalg.svd(arm.T @ (arm + values - shift))
        right[-1] *= np.sign(np.linalg.det(left @ right))  # no reflection
        back = left @ right
        # an error of the rotation is the sum of the levers, the turned arms across the axes, times the errors
        turned, count = arm @ back, len(centre)
        axes = _ABOUT_AXES if count == 3 else _ABOUT_AXES[2:, :2, :2]
        normal = np.einsum("kij,lih,nj,nh->kl", axes, axes, turned, turned)
        by_sums = np.zeros((count + len(axes), count, 1 + count))
        by_sums[:count, :, 0] = np.eye(count)
        by_sums[count:, :, 1:] = np.einsum("kl,lij->kij", np.linalg.pinv(normal), axes)
        weights = np.zeros((1 + count, len(nodes)))
        weights[:, is_measured] = np.vstack([np.full(len(arm), 1 / len(arm)), turned.T])
        flat = by_sums.reshape(count + len(axes), -1)
        std = np.sqrt(np.einsum("ka,ab,kb->k", flat, covariance.of_sums(weights, displacement), flat))
        rotation = Rotation.from_matrix(back.T).as_rotvec() if count == 3 else np.arctan2(back[0, 1], back[0, 0])
        shift_field = Field(name="rigid", unit=unit, dims=("component",), values=shift, std=std[:count])
        rotation_field = Field(
            name="rigid_rotation",
            unit="rad",
            dims=("component",)[: np.ndim(rotation)],
            values=np.asarray(rotation),
            std=std[count:].reshape(np.shape(rotation)),
        )
        if covariance.calibration is not None:
            of_places, of_motion = covariance.calibration.of_sums(weights, displacement.values)
            shift_field = shift_field.with_common(of_motion[:, :, 0])
            turning = of_motion - (back.T - np.eye(count)) @ of_places
            rotation_field = rotation_field.with_common(np.einsum("kij,mij->mk", by_sums[count:], turning))
        return cls(centre=centre, shift=shift_field, rotation=rotation_field, back=back)

    def removed(self, nodes: FloatArray, displacement: Displacement) -> Displacement:
        """Subtract the rigid motion from a displacement field: the field in axes that move with the body.

        The remaining displacements are rotated back, so that lengths and strains stay as they are.

        Parameters
        ----------
        nodes : ndarray, shape (N, c)
            On the reference, in the unit of the displacement.
        displacement
            Of the shape (c, N). The uncertainty of the rigid motion itself is not added: it is the less, the more nodes
            there are.

        Returns
        -------
        Displacement
        """
        arm, covariance = nodes - self.centre, displacement.covariance
        turned = replace(displacement, covariance=None).with_arrays(lambda std: np.sqrt(self.back**2 @ std**2))
        if covariance is not None:
            covariance = np.einsum("ia,abn,jb->ijn", self.back, covariance, self.back)
            turned = replace(turned, covariance=covariance, std=np.sqrt(np.einsum("iin->in", covariance)))
        remaining = (arm + displacement.values.T - self.shift.values) @ self.back.T - arm
        return replace(turned, values=remaining.T)

    def removed_gradient(self, gradient: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Turn displacement gradients back by the rotation; those in tangent planes of a surface in space do not turn.

        Parameters
        ----------
        gradient : ndarray, shape (G, 2, 2)
            ``H[c, d]``: derivative of the displacement c by the coordinate d.
        covariance : ndarray, shape (G, 4, 4)
            Of each gradient row by row.

        Returns
        -------
        gradient, covariance : ndarray
        """
        if len(self.back) == 3:
            return gradient, covariance
        wide = np.kron(self.back, np.eye(2))
        return self.back @ (np.eye(2) + gradient) - np.eye(2), wide @ covariance @ wide.T

    @property
    def components(self) -> tuple[Field, ...]:
        """Shift along each axis, and rotation in degrees, about each axis of space."""
        degrees = replace(self.rotation.with_arrays(np.degrees), unit="deg")
        parts = [(f"rigid_{name}", self.shift, row) for row, name in enumerate("uvw"[: len(self.centre)])]
        if not degrees.values.ndim:
            return (*(replace(field.isel(component=row), name=name) for name, field, row in parts), degrees)
        parts += [(f"rigid_rotation_{name}", degrees, row) for row, name in enumerate("xyz")]
        return tuple(replace(field.isel(component=row), name=name) for name, field, row in parts)

    def at(self, points: FloatArray) -> FloatArray:
        """Compute the displacement (P, c) of points (P, c) by the rigid motion alone.

        Parameters
        ----------
        points : ndarray, shape (P, c)
            Points on the reference, in the unit of the displacement.

        Returns
        -------
        ndarray, shape (P, c)
        """
        return np.asarray((points - self.centre) @ (self.back - np.eye(len(self.centre))) + self.shift.values)
