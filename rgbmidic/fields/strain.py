"""Strain: finite strain of a displacement gradient with its uncertainty, and that over virtual strain gauges.

With the deformation gradient ``F = I + H`` and the stretch ``U = sqrt(F^T F)``: Green-Lagrange ``(U^2 - I) / 2``,
Hencky ``ln U``, Biot ``U - I``, engineering (small strain) ``(H + H^T) / 2``. All are in the axes of the reference. The
first three are functions of ``C = F^T F`` alone, hence independent of rotation, and have its eigenvectors.

In a gauge a plane is fitted to the displacements of the nodes around a place. No new measurement is needed: gauges of
any length follow from the stored displacements. The length of a virtual strain gauge is the diameter of a circle. A
node stands for as much as an element is wide and counts by the part of that within the circle, so that, as in the iDICs
good practice guide, the length is that of the window of points plus one of them.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from rgbmidic.arguments import checked
from rgbmidic.errors import InputError
from rgbmidic.field import Displacement, Field
from rgbmidic.fields.interpolation import MeshPoints
from rgbmidic.fields.nodal import NodalCovariance
from rgbmidic.fields.quantity import ResultQuantity
from rgbmidic.fields.tangent_plane import gradient_errors, in_tangent_plane
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.renamed import state_new_names
from rgbmidic.settings.schema import STRAIN_MEASURES
from rgbmidic.typing import AnyArray, BoolArray, FloatArray, IntArray

SHORTEST = 3.0
"""Length of the shortest gauge in elements: a node and those around it."""
_MARGIN = SHORTEST - 2 * np.sqrt(2)
"""Elements by which a gauge is longer than to the farthest node of the elements around its centre: nothing on a regular
mesh, where that is at the root of 2. At an edge, a gauge that did not hold these would hold the nodes of a line."""
MEASURES = tuple(STRAIN_MEASURES)
"""Names of the strain measures; the first is the default."""
_LARGEST_ANGLE = np.degrees(np.pi / np.sqrt(12))
"""Standard uncertainty (degrees) of a direction of which nothing is known."""
_SMALL = np.array([[1, 0, 0, 0], [0, 0, 0, 1], [0, 0.5, 0.5, 0]])
"""Derivative of the small exx, eyy, exy by the gradient."""
_SPLIT = np.array([[1.0, -1.0, 0.0], [0.0, 0.0, 2.0]])
"""exx - eyy and 2 exy, whose length is e1 - e2."""
_EQUIVALENT = np.array([[4 / 3, 2 / 3, 0], [2 / 3, 4 / 3, 0], [0, 0, 4 / 3]])
"""``e^T A e`` for the Hencky strain e = (exx, eyy, exy) is the square of the von Mises equivalent at constant volume:
only there is constant volume ``e1 + e2 + e3 = 0``, so that the third principal strain is known."""
EQUIVALENT = "von Mises equivalent of the Hencky strain, for a material of constant volume"
"""Description of the equivalent strain wherever it is stated."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Tensors:
    """Strain tensors (n) of which the quantities are functions.

    Attributes
    ----------
    components, covariance : ndarray, shape (n, 3) and (n, 3, 3)
        exx, eyy, exy in the stated measure.
    hencky, hencky_covariance
        The same of the Hencky strain.
    principal : ndarray, shape (n, 2)
        The larger and the smaller one.
    cosine, sine : ndarray, shape (n,)
        Of the angle from x to the direction of the larger one.
    """

    components: FloatArray
    covariance: FloatArray
    hencky: FloatArray
    hencky_covariance: FloatArray
    principal: FloatArray
    cosine: FloatArray
    sine: FloatArray

    def component(self, index: int) -> tuple[FloatArray, FloatArray]:
        """Return exx, eyy or exy."""
        return self.components[:, index], np.sqrt(np.maximum(self.covariance[:, index, index], 0))

    def principal_strain(self, index: int) -> tuple[FloatArray, FloatArray]:
        """Return e1 or e2."""
        c, s = (self.cosine, self.sine) if index == 0 else (-self.sine, self.cosine)
        return self.principal[:, index], _deviation(np.stack([c * c, s * s, 2 * c * s], axis=1), self.covariance)

    def direction(self) -> tuple[FloatArray, FloatArray]:
        """Return the direction of e1 in degrees."""
        c, s, difference = self.cosine, self.sine, self.principal[:, 0] - self.principal[:, 1]
        turn = np.stack([-c * s, c * s, c * c - s * s], axis=1)
        degrees = np.where(difference > 0, (np.degrees(np.arctan2(s, c)) + 90) % 180 - 90, np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            std = np.degrees(_deviation(turn, self.covariance) / difference)
        return degrees, np.minimum(std, _LARGEST_ANGLE)

    def shear(self) -> tuple[FloatArray, FloatArray]:
        """Return e1 - e2."""
        return length_of(self.components @ _SPLIT.T, _SPLIT @ self.covariance @ _SPLIT.T)

    def equivalent(self) -> tuple[FloatArray, FloatArray]:
        """Return the equivalent strain; its uncertainty is first order where large, else that of noise alone."""
        e, covariance = self.hencky, self.hencky_covariance
        square, slope = np.einsum("na,ab,nb->n", e, _EQUIVALENT, e), e @ _EQUIVALENT
        noise = np.einsum("ab,nab->n", _EQUIVALENT, covariance)
        with np.errstate(divide="ignore", invalid="ignore"):
            first = np.einsum("na,nab,nb->n", slope, covariance, slope) / np.where(square > 0, square, np.inf)
            large = square / (square + noise)
            return np.sqrt(square), np.sqrt(large * first + (1 - large) * noise)


def _entry(name: str, symbol: str, description: str, **more: Any) -> ResultQuantity:
    return ResultQuantity(name, ("node",), more.pop("unit", ""), "", description, symbol=symbol, group="Strain", **more)


_Function = Callable[[_Tensors], tuple[FloatArray, FloatArray]]
_QUANTITIES: tuple[tuple[ResultQuantity, _Function], ...] = (
    (_entry("exx", "εxx", "strain in x"), lambda tensors: tensors.component(0)),
    (_entry("eyy", "εyy", "strain in y"), lambda tensors: tensors.component(1)),
    (_entry("exy", "εxy", "strain, tensor shear"), lambda tensors: tensors.component(2)),
    (_entry("e1", "ε₁", "larger principal strain in the plane"), lambda tensors: tensors.principal_strain(0)),
    (_entry("e2", "ε₂", "smaller principal strain in the plane"), lambda tensors: tensors.principal_strain(1)),
    (_entry("direction", "θ₁", "direction of e1, from x towards y", unit="deg", kind="angle"), _Tensors.direction),
    (_entry("shear", "γmax", "largest engineering shear in the plane, e1 - e2", kind="positive"), _Tensors.shear),
    (_entry("equivalent", "εeq (Hencky)", EQUIVALENT, kind="positive"), _Tensors.equivalent),
)
"""Every quantity of a strain, with its value and standard uncertainty (n,): records, histories, maps and exports have
them all, in this order."""
STRAIN: dict[str, ResultQuantity] = {entry.name: entry for entry, _ in _QUANTITIES}
"""What the quantities of a strain are, by name."""
TENSOR = ("exx", "eyy", "exy")
"""Names of the components of the tensor."""
PRINCIPAL = ("e1", "e2")
"""Names of the principal strains."""


class Strain(dict[str, Field]):
    """Strain at some places, in the axes x, y of the reference: each quantity of `STRAIN` by its name.

    exx, eyy, exy (tensor shear); e1 and e2, the larger and the smaller principal strain, in the plane; ``direction`` of
    the larger one on the reference, from x towards y, between -90 and 90 degrees: where both are the same within their
    uncertainty it means nothing, and the uncertainty tends to 52 degrees; NaN without strain. ``shear``, the largest
    shear angle in the plane, ``e1 - e2``: engineering shear, twice the tensor's; positive, see `length_of`.
    ``equivalent``, the von Mises equivalent of the Hencky strain at constant volume,
    ``sqrt(4/3 (h1^2 + h1 h2 + h2^2))``, whatever the measure is: ``ln`` of the stretch in a tensile test. Where the
    volume changes it is another number: in tension with a Poisson ratio of .3 it is 2.6 % too large. Being positive,
    it is more than 0 in noise alone, by about its uncertainty. NaN where the strain is not measured.

    Examples
    --------
    >>> stretch = np.array([[0.1, 0.0], [0.0, -0.03]])
    >>> strain = strain_of_gradient(stretch, np.zeros((4, 4)), "engineering")
    >>> strain.components.round(6).tolist(), strain["e1"].values.round(6).tolist()
    ([0.1, -0.03, 0.0], 0.1)
    """

    @property
    def components(self) -> FloatArray:
        """Values of exx, eyy and exy, shape (..., 3)."""
        return np.stack([self[name].values for name in TENSOR], axis=-1)

    @property
    def components_std(self) -> FloatArray:
        """Standard uncertainties of exx, eyy and exy, shape (..., 3)."""
        return np.stack([self[name].uncertainty for name in TENSOR], axis=-1)


def length_of(components: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute the length of vectors and its standard uncertainty: first order where long, else that of noise alone.

    A length is positive: of nothing but noise it is as large as the noise, where the first order fails. By as much as
    its square exceeds the noise's, the first order counts.

    Parameters
    ----------
    components : ndarray, shape (..., d)
        Components of the vectors.
    covariance : ndarray, shape (..., d, d)
        Of the components.

    Returns
    -------
    length, std : ndarray, shape (...)
    """
    square, noise = (components**2).sum(axis=-1), np.einsum("...aa->...", covariance)
    over = np.where(square > 0, square, 1.0)
    first = np.einsum("...a,...ab,...b->...", components, covariance, components) / over
    long = np.maximum(square - noise, 0) / over
    return np.sqrt(square), np.sqrt(np.maximum(long * first + (1 - long) * noise, 0))


@checked
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

    Examples
    --------
    >>> gradient = np.array([[0.1, 0.0], [0.0, 0.0]])
    >>> strain_of_gradient(gradient, np.zeros((4, 4)))["exx"].values.round(6)  # Green-Lagrange
    np.float64(0.105)
    """
    if measure not in MEASURES:
        raise InputError(f'unknown strain measure "{measure}"; allowed are {", ".join(MEASURES)}')
    shape = gradient.shape[:-2]
    if gradient.shape != (*shape, 2, 2) or covariance.shape != (*shape, 4, 4):
        raise InputError(
            f"gradients (..., 2, 2) and their covariance (..., 4, 4) are needed, not {gradient.shape} and "
            f"{covariance.shape}"
        )
    return unchecked_strain(gradient, covariance, measure)


def unchecked_strain(gradient: FloatArray, covariance: FloatArray, measure: str) -> Strain:
    """Compute `strain_of_gradient` of what is checked."""
    shape = gradient.shape[:-2]
    h, spread = gradient.reshape(-1, 2, 2), covariance.reshape(-1, 4, 4)
    stated, hencky = (_strain_tensor(h, STRAIN_MEASURES[name]) for name in (measure, "hencky"))
    (components, e_covariance), (hencky_components, hencky_covariance) = (
        (np.stack([tensor[:, 0, 0], tensor[:, 1, 1], tensor[:, 0, 1]], axis=1), slope @ spread @ slope.swapaxes(-1, -2))
        for tensor, slope in (stated, hencky)
    )
    principal, vectors = _eigen(stated[0])
    tensors = _Tensors(
        components=components,
        covariance=e_covariance,
        hencky=hencky_components,
        hencky_covariance=hencky_covariance,
        principal=principal,
        cosine=vectors[:, 0, 0],
        sine=vectors[:, 1, 0],
    )
    dims = ("frame", "node")[2 - len(shape) :]
    strain = Strain()
    for entry, function in _QUANTITIES:
        values, std = (array.reshape(shape) for array in function(tensors))
        strain[entry.name] = Field(name=entry.name, unit=entry.unit, dims=dims, values=values, std=std)
    return strain


def _strain_tensor(gradient: FloatArray, power: float | None) -> tuple[FloatArray, FloatArray]:
    """Compute the strain (n, 2, 2) of gradients, and the derivative (n, 3, 4) of xx, yy, xy by H (Daleckii and Krein).

    It is ``(C^m - I) / (2 m)`` with the power m of `STRAIN_MEASURES`, in the limit of 0 ``ln(C) / 2``; None: small.
    """
    if power is None:
        return (gradient + gradient.transpose(0, 2, 1)) / 2, _SMALL
    f = np.eye(2) + gradient
    values, vectors = _eigen(f.transpose(0, 2, 1) @ f)
    values = np.maximum(values, np.finfo(float).tiny)
    at = (values**power - 1) / (2 * power) if power else np.log(values) / 2
    gap, mean = values[:, 1] - values[:, 0], values.mean(axis=1)
    close = np.abs(gap) < 1e-6  # an error of 1e-10 at most
    across = np.where(close, 0.5 * mean ** (power - 1), (at[:, 1] - at[:, 0]) / np.where(close, 1, gap))
    along = 0.5 * values ** (power - 1)
    # what a change of H[c, d] alone makes of C along the axes a and b of C: F_ca V_db + V_da F_cb, F turned by V
    turned = f @ vectors
    change = [turned[:, :, None, a] * vectors[:, None, :, b] for a in (0, 1) for b in (0, 1)]
    terms = [2 * change[0] * along[:, 0, None, None], 2 * change[3] * along[:, 1, None, None]]
    terms.append((change[1] + change[2]) * across[:, None, None])
    first, second, shear = (term.reshape(-1, 4) for term in terms)
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


def _deviation(direction: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.maximum(np.einsum("na,nab,nb->n", direction, covariance, direction), 0)))


def shortest_gauge(mesh: Tri3Mesh) -> float:
    """Return the length in px of the shortest virtual strain gauge on a mesh.

    Parameters
    ----------
    mesh
        N nodes, E elements.

    Returns
    -------
    float
        In px.

    Examples
    --------
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 80, 60), shape=(80, 100)), element_size=20)
    >>> round(shortest_gauge(mesh), 6)
    60.0
    """
    return SHORTEST * mesh.size


def strain_of(
    nodes: FloatArray,
    elements: npt.NDArray[np.int32],
    u: FloatArray,
    v: FloatArray,
    *std: FloatArray,
    gauge: float | None = None,
    measure: str = MEASURES[0],
) -> Strain:
    """Compute the strain at the nodes of a mesh from the displacements of one frame.

    For many frames or gauges make a `StrainGauges` once.

    Parameters
    ----------
    nodes : ndarray, shape (N, 2)
        In px on the reference.
    elements : ndarray, shape (E, 3)
        Node indices.
    u, v, *std : ndarray, shape (N,)
        As of `Displacement.in_plane`.
    gauge
        Length of the virtual strain gauge in px; None: the shortest, three elements.
    measure
        ``"green-lagrange"``, ``"hencky"``, ``"biot"`` or ``"engineering"``.

    Returns
    -------
    Strain
        NaN at nodes that are not measured and beside them.

    Raises
    ------
    InputError
        The gauge is too short, the measure unknown, or no uncertainty is given.

    Examples
    --------
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 80, 60), shape=(80, 100)), element_size=20)
    >>> u, zero = 0.01 * mesh.nodes[:, 0], np.zeros(len(mesh.nodes))
    >>> strain = strain_of(mesh.nodes, mesh.elements, u, zero, zero + 0.01, zero + 0.01, measure="engineering")
    >>> strain.components.round(6)[0].tolist()
    [0.01, 0.0, 0.0]
    """
    if len(std) not in (2, 4):
        raise InputError(f"a strain needs u_std and v_std, and may have u_bias and v_bias; {len(std)} arrays are given")
    covariance = NodalCovariance.from_mesh(Tri3Mesh(nodes=nodes, elements=elements))
    return StrainGauges.at_nodes(covariance, gauge).strain(Displacement.in_plane(u, v, *std), measure)


@state_new_names
class StrainGauges:
    """Virtual strain gauges of one length at some places.

    Parameters
    ----------
    covariance
        Of the mesh.
    centres : ndarray, shape (G, 2)
        In px on the reference.
    length
        In px; None: the shortest, three elements. On a graded mesh each gauge has three elements as they are around it,
        and this length where that is more and the length is stated; if it is not, `length` is that of elements of the
        mesh's size. A gauge that would not hold the elements around its centre, which are stretched, is as much longer.
    needed : csr_matrix, shape (G, N)
        Nodes that must have data, else the gauge has none: the centre and those beside it.

    Attributes
    ----------
    points : ndarray, shape (N, 2)
        The nodes.
    rows, nodes : ndarray, shape (M,), int
        Gauge and node of every pair of them: nodes within the gauge's circle that hang together in it, so that none
        lies across a crack or a hole.
    fractions : ndarray, shape (M,)
        Part of each node that is within the gauge's circle.
    full_weights : ndarray, shape (2, M)
        Weight of every node in the slopes along x and y where all are measured.
    slopes : list of csr_matrix, shape (G, N)
        The same as matrices.
    inflation : ndarray, shape (G, 3)
        Variance of the slopes along x and y, and their covariance, over what independent nodes would give: of the fit's
        errors, whose correlation reaches over some elements. That of the lights' bias is taken as it is.

    Raises
    ------
    InputError
        The gauge is too short.

    Examples
    --------
    >>> from rgbmidic.mesh import Region
    >>> mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 80, 60), shape=(80, 100)), element_size=20)
    >>> gauges = StrainGauges.at_nodes(NodalCovariance.from_mesh(mesh))
    >>> u, zero = 0.01 * mesh.nodes[:, 0], np.zeros(len(mesh.nodes))
    >>> strain = gauges.strain(Displacement.in_plane(u, zero, zero + 0.01, zero + 0.01))
    >>> strain.components.round(6)[0].tolist()
    [0.01005, 0.0, 0.0]
    """

    def __init__(
        self, covariance: NodalCovariance, centres: FloatArray, length: float | None, needed: sp.csr_matrix
    ) -> None:
        mesh, shortest = covariance.mesh, shortest_gauge(covariance.mesh)
        self.length = shortest if length is None else float(length)
        self.centres, self.needed, self.points = centres, needed, mesh.nodes
        # the sides of a mesh's elements differ by some percent from the size asked for
        if not (np.isfinite(self.length) and self.length >= 0.9 * shortest):
            raise InputError(
                f"a strain gauge must be at least {shortest:.4g} px long, {SHORTEST:g} elements; given are "
                f"{self.length:g} px"
            )
        lengths = np.full(len(centres), self.length)
        if mesh.is_graded:
            mean_size = (needed @ mesh.sizes) / np.asarray(needed.sum(axis=1)).ravel()
            lengths = np.maximum(SHORTEST * mean_size, length or 0)
        far = np.zeros(len(centres))
        row, node = needed.nonzero()
        np.maximum.at(far, row, np.hypot(*(mesh.nodes[node] - centres[row]).T) + _MARGIN / 2 * mesh.sizes[node])
        lengths = np.maximum(lengths, 2 * far)
        pattern = _reach(mesh, centres, lengths / 2, needed)
        self.starts, self.bias = pattern.indptr, covariance.bias
        self.surface, self.calibration = covariance.surface, covariance.calibration
        self.rows = np.repeat(np.arange(len(centres)), np.diff(self.starts))
        self.nodes = pattern.indices.astype(np.int64)
        distance = np.hypot(*(mesh.nodes[self.nodes] - centres[self.rows]).T)
        self.fractions = np.clip((lengths[self.rows] / 2 - distance) / mesh.sizes[self.nodes], 0, 1)
        self.full_weights = self.weights(np.ones(len(mesh.nodes), dtype=bool))
        self.slopes = self._matrices(self.full_weights)
        independent = [_products(slope, slope) for slope in self.slopes]
        correlated = [_products(matrix, matrix) for matrix in (slope @ covariance.fit for slope in self.slopes)]
        along, across = (a / np.where(b > 0, b, 1) for a, b in zip(correlated, independent, strict=True))
        self.inflation = np.stack([along, across, np.sqrt(along * across)], axis=1)

    @classmethod
    def at_nodes(cls, covariance: NodalCovariance, length: float | None = None) -> Self:
        """Lay a gauge around every node; errors as `strain_of`.

        Parameters
        ----------
        covariance
            Of the mesh.
        length
            Length of the gauges in px; None: the shortest.

        Returns
        -------
        StrainGauges
        """
        return cls(covariance, covariance.mesh.nodes, length, _ring(covariance.mesh))

    @classmethod
    def at_points(cls, covariance: NodalCovariance, points: FloatArray, length: float | None = None) -> Self:
        """Lay gauges around points (G, 2) within the mesh.

        Parameters
        ----------
        covariance
            Of the mesh.
        points : ndarray, shape (G, 2)
            Middles of the gauges in px on the reference.
        length
            Their length in px; None: the shortest.

        Returns
        -------
        StrainGauges

        Raises
        ------
        InputError
            A point is outside the mesh, or the gauge is too short.
        """
        mesh = covariance.mesh
        mesh_points = MeshPoints.of(mesh, points)
        mesh_points.check("the strain gauge")
        row, nodes = np.repeat(np.arange(len(points)), 3), mesh.elements[mesh_points.element].ravel()
        needed = sp.csr_matrix((np.ones(len(row)), (row, nodes)), shape=(len(points), len(mesh.nodes)))
        return cls(covariance, mesh_points.points, length, needed)

    def of_nodes(self, nodes: IntArray) -> Self:
        """Return the gauges for the fields of some nodes alone, all of theirs among them.

        Parameters
        ----------
        nodes : ndarray, shape (n,)
            Indices of the nodes, rising.

        Returns
        -------
        StrainGauges
        """
        gauges = copy(self)
        gauges.points, gauges.needed, gauges.bias = self.points[nodes], self.needed[:, nodes], self.bias[nodes]
        gauges.surface = None if self.surface is None else self.surface[nodes]
        gauges.calibration = None if self.calibration is None else self.calibration.subset(nodes)
        gauges.nodes, gauges.slopes = np.searchsorted(nodes, self.nodes), [matrix[:, nodes] for matrix in self.slopes]
        return gauges

    def gradient(self, displacement: Displacement) -> tuple[FloatArray, FloatArray]:
        """Fit the planes to the displacements of one frame.

        Parameters
        ----------
        displacement
            Of all nodes, shape (c, N); NaN where a node has no data.

        Returns
        -------
        gradient : ndarray, shape (G, 2, 2)
            ``H[c, d]``: derivative of the displacement c by the coordinate d; of a displacement in space that in the
            tangent plane of the surface, see `in_tangent_plane`.
        covariance : ndarray, shape (G, 4, 4)
            Of the gradient row by row.
        """
        gradient, covariance = self._gradient(displacement)
        return gradient, covariance + self._calibration_covariance(displacement, displacement)

    def shared_covariance(self, first: Displacement, second: Displacement, fraction: float) -> FloatArray:
        """Return the covariance (G, 4, 4) between the gradients of two frames.

        Parameters
        ----------
        first, second
            Of the frames, with data at the same nodes.
        fraction
            Part of the smaller one of the variances of their noise that both have in common.

        Returns
        -------
        ndarray, shape (G, 4, 4)
        """
        noise = self._gradient(first.smaller(second))[1]
        return np.asarray(fraction * noise + self._calibration_covariance(first, second))

    def _gradient(self, displacement: Displacement) -> tuple[FloatArray, FloatArray]:
        """Return the `gradient` with the covariance that the nodes' noise leaves."""
        slopes, covariance = self.slopes_of(displacement)
        if self.surface is None:
            return slopes, covariance
        return in_tangent_plane(self.tangents(displacement.is_measured), slopes, covariance)

    def _calibration_covariance(self, first: Displacement, second: Displacement) -> FloatArray:
        """Return what the calibration adds to the covariance between the gradients of two frames."""
        if self.calibration is None:
            return np.zeros(1)
        errors = [
            gradient_errors(self.tangents(one.is_measured), self.slopes_of(one)[0], *self.slope_errors(one))
            for one in (first, second)
        ]
        return np.asarray(np.einsum("mga,mgb->gab", *errors))

    def slope_errors(self, displacement: Displacement) -> tuple[FloatArray, FloatArray]:
        """Fit the planes to the errors that the calibration makes in one frame.

        Parameters
        ----------
        displacement
            As of `gradient`, in space.

        Returns
        -------
        surface, displacement : ndarray, shape (M, G, 3, 2)
            Of the `tangents` and of the slopes of the displacement; empty without a calibration.
        """
        measured, nodal = displacement.is_measured, np.zeros((2, 0, *displacement.values.shape))
        if self.calibration is not None:
            nodal = np.stack([self.calibration.surface, self.calibration.at_nodes(displacement.values)])
        surface, moved = (self.fit(np.moveaxis(one, -1, 0), measured).swapaxes(0, 1) for one in nodal)
        return surface, moved

    def tangents(self, measured: BoolArray) -> FloatArray:
        """Fit the planes to the nodes in space, as to the displacements of those of them that have data.

        Parameters
        ----------
        measured : ndarray, shape (N,), bool
            Nodes that have data.

        Returns
        -------
        ndarray, shape (G, 3, 2)
        """
        assert self.surface is not None
        return self.fit(self.surface, measured)

    def fit(self, values: FloatArray, measured: BoolArray) -> FloatArray:
        """Fit the planes to nodal values of any shape.

        Parameters
        ----------
        values : ndarray, shape (N, ...)
            Of all nodes; those that have no data do not count.
        measured : ndarray, shape (N,), bool
            Nodes that have data.

        Returns
        -------
        ndarray, shape (G, ..., 2)
            Their slopes along x and y of the mesh.
        """
        matrices = self.slopes if measured.all() else self._matrices(self.weights(measured))
        flat = np.where(measured[:, None], values.reshape(len(values), -1), 0.0)
        slopes = _slopes(matrices, flat)
        return slopes.reshape(len(slopes), *values.shape[1:], 2)

    def slopes_of(self, displacement: Displacement) -> tuple[FloatArray, FloatArray]:
        """Fit the planes to each component of the displacements of one frame.

        Parameters
        ----------
        displacement
            As of `gradient`.

        Returns
        -------
        slopes : ndarray, shape (G, c, 2)
            Derivative of the displacement c by the coordinate d of the mesh.
        covariance : ndarray, shape (G, 2 c, 2 c)
            Of the slopes row by row.
        """
        measured, count = displacement.is_measured, len(displacement.values)
        weights = self.full_weights if measured.all() else self.weights(measured)
        matrices = self.slopes if measured.all() else self._matrices(weights)
        arrays = displacement.values, displacement.bias_std, displacement.error_factor
        values, bias, factor = (np.where(measured, array, 0.0) for array in arrays)
        gradient = _slopes(matrices, values.T)
        spread, products = np.zeros((len(gradient), count, 2, count, 2)), weights[[0, 1, 0]] * weights[[0, 1, 1]]
        for i, j in combinations_with_replacement(range(count), 2):
            square = (factor[i] * factor[j]).sum(axis=0)
            square = np.maximum(square - bias[i] ** 2, 0) if i == j else square
            if i != j and not square.any():
                continue
            sums = np.stack([self._sum(array * square[self.nodes]) for array in products], axis=1) * self.inflation
            if i == j and bias[i].any():
                x, y = (slope @ (sp.diags(bias[i]) @ self.bias) for slope in matrices)
                sums += np.stack([_products(x, x), _products(y, y), _products(x, y)], axis=1)
            spread[:, i, :, j] = spread[:, j, :, i] = sums[:, [[0, 2], [2, 1]]]
        return gradient, spread.reshape(-1, 2 * count, 2 * count)

    def strain(self, displacement: Displacement, measure: str = MEASURES[0]) -> Strain:
        """Compute the strain of every gauge from the displacements of one frame; errors as `strain_of`.

        Parameters
        ----------
        displacement
            As of `gradient`.
        measure
            Strain measure, as of `strain_of`.

        Returns
        -------
        Strain
        """
        return unchecked_strain(*self.gradient(displacement), measure)

    def _matrices(self, weights: FloatArray) -> list[sp.csr_matrix]:
        return [sp.csr_matrix((w, self.nodes, self.starts), shape=self.needed.shape) for w in weights]

    def weights(self, measured: BoolArray) -> FloatArray:
        """Compute the weight of every node of each gauge in its slopes.

        Parameters
        ----------
        measured : ndarray, shape (N,), bool
            Nodes that have data.

        Returns
        -------
        ndarray, shape (2, M)
            NaN where a node that it needs has no data, or its nodes lie on a line.
        """
        use = measured[self.nodes] * self.fractions
        arm = (self.points[self.nodes] - self.centres[self.rows]).T
        count = np.maximum(self._sum(use), np.finfo(float).tiny)
        x, y = (array - (self._sum(use * array) / count)[self.rows] for array in arm)
        xx, xy, yy = (self._sum(use * a * b) for a, b in ((x, x), (x, y), (y, y)))
        determinant = xx * yy - xy * xy
        # a hundredth of the second moment across as along: the nodes lie on a line
        determinant = np.where(determinant > 1e-2 * ((xx + yy) / 2) ** 2, determinant, np.nan)
        determinant[self.needed @ (~measured * 1.0) > 0] = np.nan
        xx, xy, yy = (array[self.rows] / determinant[self.rows] for array in (xx, xy, yy))
        return np.stack([use * (yy * x - xy * y), use * (xx * y - xy * x)])

    def _sum(self, values: AnyArray) -> FloatArray:
        sums = np.bincount(self.rows, weights=values, minlength=len(self.centres))
        return np.asarray(sums, dtype=np.float64)


def _slopes(matrices: list[sp.csr_matrix], values: FloatArray) -> FloatArray:
    """Slopes (G, c, 2) of nodal values (n, c) along x and y."""
    return np.stack([slope @ values for slope in matrices], axis=-1)


def _products(first: sp.csr_matrix, second: sp.csr_matrix) -> FloatArray:
    """Scalar products of the rows of two matrices."""
    return np.asarray(first.multiply(second).sum(axis=1)).ravel()


def _ring(mesh: Tri3Mesh) -> sp.csr_matrix:
    """Mark every node and those of the same elements, (N, N)."""
    i, j = mesh.neighbours.T
    count = len(mesh.nodes)
    edges = sp.coo_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
    return sp.csr_matrix(edges + edges.T + sp.eye(count))


def _reach(mesh: Tri3Mesh, centres: FloatArray, radius: FloatArray, needed: sp.csr_matrix) -> sp.csr_matrix:
    """Find the nodes (G, N) within its `radius` (G,) px of each centre that are joined with it inside the circle."""
    from scipy.spatial import cKDTree

    near = cKDTree(mesh.nodes).query_ball_point(centres, radius)
    starts = np.cumsum([0, *map(len, near)])
    columns = np.concatenate([np.asarray(indices, dtype=np.int64) for indices in near])
    inside = sp.csr_matrix((np.ones(len(columns)), columns, starts), shape=needed.shape)
    ring, reached = _ring(mesh), sp.csr_matrix(needed > 0) * 1.0
    while True:
        grown = sp.csr_matrix((((reached @ ring).multiply(inside) + reached) > 0) * 1.0)
        if grown.nnz == reached.nnz:
            grown.sort_indices()
            return grown
        reached = grown
