"""What the quadratic polynomials of the recovery miss near a free boundary, where they see the field from one side.

Inside, third-order terms cancel over the window of a fit; at a boundary they do not. The recovery is linear, so that
what it makes of a cubic is known from the mesh alone. A cubic is fitted to the recovered displacements, each of its
third-order terms with what the recovery makes of it; its coefficients say by how much the recovered values and slopes
are off (error estimation by order, Zienkiewicz and Zhu, Int. J. Numer. Meth. Eng. 33, 1992). Because the fit knows the
operators that it judges, its result has a fifth of the noise of the displacement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from rgbmidic.correlation.solution import Solution
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.recovery import Recovery, angle_fraction, at_free_boundary
from rgbmidic.mesh.tri3 import with_data
from rgbmidic.typing import BoolArray, FloatArray

_POWERS = np.array([(i, n - i) for n in range(4) for i in range(n, -1, -1)])


@dataclass(frozen=True, slots=True, kw_only=True)
class OneSidedConstants:
    """Constants of the estimate.

    Attributes
    ----------
    width
        Standard deviation of the weights of the fits, in sides of an element as inside. With 1.3 they have less noise,
        a twentieth of the displacement's instead of a fifth, but find half of the error in waves of 4 elements.
    factor
        Error over what the cubic makes of it: 1.03 to 1.3 in waves of 15 to 6 elements, 1.5 at 4, for values and
        slopes, at straight and round edges and at holes (without noise).
    noise
        Variance of the noise of an operator over that of independent nodes: 1.0 to 1.4 (derived on such meshes).
    angle
        Fraction of the full angle from which a boundary is concave.
    departure
        Error of values, and of slopes times the side of an element, over `_BoundaryFits.departure` of a concave
        boundary: elsewhere, beside and at it. At the rim of a hole in tension strain falls off within an element or
        two, which no order of polynomials follows: 1.6 to 2.9 and 6 to 9, beside it 0.17 to 0.4 and 0.6 to 1 (elements
        of 0.08 to 0.3 of its diameter).
    departure_noise
        Variance of the noise of `_BoundaryFits.departure` over that of independent nodes: 0.34 to 0.56 (derived).
    significance
        Mean square over that by noise from which it is not taken for noise: in affine fields the uncertainty of strain
        is then 1.03 times as large, at the rim of a hole 1.1 times at most (measured).
    unresolved
        Errors of displacement and of strain over their noise from which strain is called unresolved: with less a hole
        at rest is called so by chance (measured: 1 of 10 frames with 1 and 4).
    negligible
        Error of strain that is not reported, whatever the noise: a hundredth of a per mille. Chosen.
    min_nodes
        Number of nodes of which less are not spoken of. Chosen.
    """

    width: float = 0.8
    factor: float = 1.3
    noise: float = 1.2
    angle: float = 0.52
    departure: tuple[tuple[float, float], ...] = ((0.0, 0.0), (0.27, 0.8), (2.1, 7.5))
    departure_noise: float = 0.5
    significance: float = 2.5
    unresolved: tuple[float, float] = (1.3, 4.0)
    negligible: float = 1e-5
    min_nodes: int = 3


_CONSTANTS = OneSidedConstants()


def cubic_fit_offset(mesh: Tri3Mesh) -> FloatArray:
    """Evaluate at each node n the best linear fit of x^3, x^2 y, x y^2, y^3 about n, (N, 4) in cubic px."""
    point, weight = (values / 2 for values in np.polynomial.legendre.leggauss(3))
    first, second = (values.ravel() for values in np.meshgrid(point + 0.5, point + 0.5, indexing="ij"))
    barycentric = np.stack([1 - first, first * (1 - second), first * second], axis=1)  # conical product, degree 4
    weights = 2 * np.outer(weight, weight).ravel() * first
    nodes = mesh.nodes - mesh.nodes.mean(axis=0)
    x, y = np.einsum("qc,ecd->deq", barycentric, nodes[mesh.elements])
    cubics = np.stack([x**3, x * x * y, x * y * y, y**3])
    moments = np.einsum("q,qc,teq,e->tec", weights, barycentric, cubics, mesh.areas).reshape(4, -1)
    right = np.stack([np.bincount(mesh.elements.ravel(), values, len(nodes)) for values in moments], axis=1)
    fitted = splu(mesh.mass_matrix.tocsc()).solve(right)
    x, y = nodes.T
    return np.asarray(fitted - _fitted_cubics(x, y, mesh.linear_fit_offset, np.zeros((len(nodes), 4))))


def _fitted_cubics(x: FloatArray, y: FloatArray, quadratic: FloatArray, cubic: FloatArray) -> FloatArray:
    """Evaluate the best linear fit of cubics about a point from which a node is (x, y) away, there: (..., 4).

    `quadratic` (..., 3) and `cubic` (..., 4) are what it has at the node of quadratics (`Tri3Mesh.linear_fit_offset`)
    and of cubics about it.
    """
    xx, xy, yy = np.moveaxis(quadratic, -1, 0) * np.reshape([2, 1, 2], (3, *[1] * x.ndim))
    terms = x**3 + 3 * x * xx, x * x * y + 2 * x * xy + y * xx, x * y * y + 2 * y * xy + x * yy, y**3 + 3 * y * yy
    return np.stack(terms, axis=-1) + cubic


def _recovered_cubics(mesh: Tri3Mesh, operator: sp.csr_matrix, nodes: BoolArray) -> FloatArray:
    """Apply the rows of some `nodes` (N,) of a recovery's operator (N, N) to cubics about each, (N, 4)."""
    row = np.repeat(np.arange(len(nodes)), np.diff(operator.indptr))
    selected = nodes[row]
    row, column = row[selected], operator.indices[selected]
    x, y = (mesh.nodes[column] - mesh.nodes[row]).T
    fitted = _fitted_cubics(x, y, mesh.linear_fit_offset[column], mesh.derive(cubic_fit_offset)[column])
    products = (operator.data[selected, None] * fitted).T
    return np.stack([np.bincount(row, values, len(nodes)) for values in products], axis=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _BoundaryFits:
    """Operators (N, N) from recovered displacements to what they miss near the boundary; other rows are empty.

    Attributes
    ----------
    value, slope_x, slope_y
        What values and slopes miss of the cubic.
    departure
        Value of a cubic through the recovered displacements, as if they missed nothing, less these, at concave
        boundaries.
    mean
        Over the nodes up to two edges away, those at the boundary and those beside it apart.
    concave_mean
        Over the nodes up to four edges away that have a `departure`, the nearer ones more.
    factors : ndarray, shape (N, 2)
        Those of `OneSidedConstants.departure`.
    """

    value: sp.csr_matrix
    slope_x: sp.csr_matrix
    slope_y: sp.csr_matrix
    departure: sp.csr_matrix
    mean: sp.csr_matrix
    concave_mean: sp.csr_matrix
    factors: FloatArray


def _boundary_fits(mesh: Tri3Mesh, active: bytes) -> _BoundaryFits:
    """Fit cubics to the nodes up to three edges of `active` elements away."""
    elements, count = np.frombuffer(active, dtype=bool), len(mesh.nodes)
    corners = mesh.elements[elements]
    ends = np.repeat(corners, 3, axis=1).ravel(), np.tile(corners, 3).ravel()
    beside = sp.csr_matrix((np.ones(len(ends[0]), dtype=bool), ends), shape=(count, count))
    edge = at_free_boundary(mesh, elements)
    nodes = np.flatnonzero(edge | (beside @ edge))
    reach = sp.csr_matrix(beside[nodes] @ beside @ beside)
    enough = np.diff(reach.indptr) >= len(_POWERS)
    nodes, reach = nodes[enough], reach[enough]
    number, size = np.diff(reach.indptr), mesh.sizes[nodes, None]
    has_node = np.arange(number.max(initial=1)) < number[:, None]
    neighbours = np.repeat(nodes[:, None], has_node.shape[1], axis=1)
    neighbours[has_node] = reach.indices
    x, y = ((axis[neighbours] - axis[nodes, None]) / size for axis in mesh.nodes.T)
    basis = np.stack([x**i * y**j for i, j in _POWERS], axis=1)
    angle = angle_fraction(mesh, elements)[nodes, None]
    weight = np.where(has_node, np.exp(-(x**2 + y**2) * angle / (2 * _CONSTANTS.width**2)), 0)[:, None]
    departure = np.where(
        edge[nodes, None] & (angle > _CONSTANTS.angle), _fits(weight, basis)[:, 0] - (neighbours == nodes[:, None]), 0
    )
    recovery, required = Recovery.over(mesh, elements), np.zeros((2, count), dtype=bool)
    required[0, reach.indices] = required[1, nodes] = True
    missed = [
        _recovered_cubics(mesh, operator, required[min(order, 1)])
        for order, operator in enumerate((recovery.value, recovery.slope_x, recovery.slope_y))
    ]
    basis[:, 6:] += np.moveaxis(missed[0][neighbours], -1, 1) / size[:, None] ** 3
    third = _fits(weight, basis)[:, 6:] / size[:, None] ** 3
    indices = np.repeat(nodes, number), reach.indices
    coefficients = *(np.einsum("nt,ntw->nw", operator[nodes], third) for operator in missed), departure
    *operators, departing = (
        sp.csr_matrix((values[has_node], indices), shape=(count, count)) for values in coefficients
    )
    departing.eliminate_zeros()
    level = np.zeros(count, dtype=np.intp)
    level[nodes] = 1 + edge[nodes]
    rows, columns = sp.csr_matrix(beside @ beside).nonzero()
    same_level = (level[rows] == level[columns]) & (level[rows] > 0)
    departs = (level[rows] > 0) & (np.diff(departing.indptr) > 0)[columns]
    concave_mean = _mean(rows[departs], columns[departs], count)
    return _BoundaryFits(
        **dict(zip(("value", "slope_x", "slope_y"), operators, strict=True)),
        departure=departing,
        mean=_mean(rows[same_level], columns[same_level], count),
        concave_mean=sp.csr_matrix(concave_mean @ concave_mean),
        factors=np.array(_CONSTANTS.departure)[level],
    )


def _mean(rows: npt.NDArray[np.integer], columns: npt.NDArray[np.integer], count: int) -> sp.csr_matrix:
    """Average over the columns of each row."""
    number = np.bincount(rows, minlength=count)
    return sp.csr_matrix((1 / number[rows], (rows, columns)), shape=(count, count))


def _fits(weight: FloatArray, basis: FloatArray) -> FloatArray:
    """Solve weighted fits (n, terms, W) of a basis (n, terms, W)."""
    weighted = weight * basis
    normal = weighted @ basis.transpose(0, 2, 1)
    normal += np.diag([0, *[1e-6] * (len(_POWERS) - 1)])  # as of the recovery: 0 where nodes do not determine it
    return np.asarray(np.linalg.solve(normal, weighted))


def one_sided_error(mesh: Tri3Mesh, active: BoolArray, displacement: FloatArray, std: FloatArray) -> FloatArray:
    """Estimate what a recovered field misses at the nodes of `at_free_boundary` and at those beside them.

    Parameters
    ----------
    mesh
        N nodes, E elements.
    active : ndarray, shape (E,), bool
        Elements over which nodes are reached, up to three edges away.
    displacement, std : ndarray, shape (N, 2)
        u and v, and their standard uncertainty by noise; NaN at nodes without data.

    Returns
    -------
    ndarray, shape (N, 5)
        Error of u, v, exx, eyy, exy as a standard deviation: the root of a mean square over some elements
        along the boundary, beyond noise. 0 at other nodes.
    """
    fits = mesh.derive(_boundary_fits, active.tobytes())
    u, v = fields = tuple(zip(np.nan_to_num(displacement).T, np.nan_to_num(std**2).T, strict=True))
    half_x, half_y = (with_data(slope, slope.data / 2) for slope in (fits.slope_x, fits.slope_y))
    single_terms = ((fits.value, u), (fits.value, v), (fits.slope_x, u), (fits.slope_y, v))
    squares = [_square_and_noise(fits.mean, *terms) for terms in (*zip(single_terms), ((half_y, u), (half_x, v)))]
    square, noise = np.stack(squares, axis=-1)
    smooth = _CONSTANTS.factor * _excess_rms(square, _CONSTANTS.noise * noise)
    square, noise = np.stack(
        [_square_and_noise(fits.concave_mean, (fits.departure, field)) for field in fields], axis=-1
    )
    rough = _excess_rms(square, _CONSTANTS.departure_noise * noise)
    slopes = np.hypot(*rough.T)[:, None] * [np.sqrt(0.5), np.sqrt(0.5), 0.5] / mesh.sizes[:, None]
    of_values, of_slopes = fits.factors.T[:, :, None]
    return np.asarray(np.maximum(smooth, np.column_stack([of_values * rough, of_slopes * slopes])))


def _square_and_noise(mean: sp.csr_matrix, *terms: tuple[sp.csr_matrix, tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Average the square of a sum of operators on nodal values, and its part by independent noise, (2, N)."""
    total = np.sum([operator @ values for operator, (values, _) in terms], axis=0)
    noise = np.sum([operator.power(2) @ variance for operator, (_, variance) in terms], axis=0)
    return np.stack([mean @ total**2, mean @ noise])


def _excess_rms(square: FloatArray, noise: FloatArray) -> FloatArray:
    """Root of what a mean square has beyond noise, 0 where it may be noise."""
    return np.sqrt(np.where(square > _CONSTANTS.significance * noise, square - noise, 0))


def with_one_sided_error(mesh: Tri3Mesh, solution: Solution) -> Solution:
    """Add what the recovery misses near free boundaries to the stated uncertainty of a solution.

    Parameters
    ----------
    mesh
        The mesh of the solution.
    solution
        With the uncertainty of its noise.

    Returns
    -------
    Solution

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> from rgbmidic import correlate
    >>> speckle = 1000 + 3000 * gaussian_filter(np.random.default_rng(0).normal(size=(80, 80)), 1.5)
    >>> solution = correlate(speckle, np.roll(speckle, 1, axis=1), element_size=20)
    >>> complete = with_one_sided_error(Tri3Mesh(nodes=solution.nodes, elements=solution.elements), solution)
    >>> (complete.displacement_std >= solution.displacement_std)[solution.measured].all()
    np.True_
    """
    active = np.asarray(solution.measured[mesh.elements].all(axis=1))
    error = one_sided_error(mesh, active, solution.displacement, solution.displacement_std)
    return replace(
        solution,
        displacement_std=np.hypot(solution.displacement_std, error[:, :2]),
        edge_std=np.where(solution.measured[:, None], error[:, :2], np.nan),
        strain_std=np.hypot(solution.strain_std, error[:, 2:]),
    )


def unresolved_strain(mesh: Tri3Mesh, solution: Solution, with_error: Solution) -> str:
    """Say by how much the strain at free boundaries is not resolved; empty where it is.

    Parameters
    ----------
    mesh
        N nodes.
    solution, with_error
        As `solve` returned it, and with what `with_one_sided_error` or `discretisation_error` adds.

    Returns
    -------
    str
        The error is rounded to 1, 2 or 5 of its decade, so that the frames of a test have few texts.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> from rgbmidic import correlate
    >>> speckle = 1000 + 3000 * gaussian_filter(np.random.default_rng(0).normal(size=(80, 80)), 1.5)
    >>> solution = correlate(speckle, np.roll(speckle, 1, axis=1), element_size=20)
    >>> mesh = Tri3Mesh(nodes=solution.nodes, elements=solution.elements)
    >>> unresolved_strain(mesh, solution, with_one_sided_error(mesh, solution))
    ''
    """
    before, noise = (np.column_stack([result.displacement_std, result.strain_std]) for result in (solution, with_error))
    missed = np.column_stack([with_error.displacement_error, with_error.strain_error])
    if not np.isfinite(missed).any():
        noise, missed = before, np.sqrt(np.maximum(noise**2 - before**2, 0))
    is_large = missed > np.repeat(_CONSTANTS.unresolved, [2, 3]) * noise
    is_large[:, 2:] &= missed[:, 2:] > _CONSTANTS.negligible
    unresolved = at_free_boundary(mesh) & is_large[:, :2].any(axis=1) & is_large[:, 2:].any(axis=1)
    if unresolved.sum() < _CONSTANTS.min_nodes:
        return ""
    max_error = np.where(is_large[unresolved, 2:], missed[unresolved, 2:], 0).max() * (1 + 1e-9)
    decade = 10 ** np.floor(np.log10(max_error))
    largest = decade * max(step for step in (1, 2, 5) if step * decade <= max_error)
    return (
        f"the strain at edges of the region is not resolved: it may be off by {largest:.1g} or more, over "
        f"{_CONSTANTS.unresolved[1]:g} times its noise; its uncertainty holds that, smaller elements or mesh.refine "
        "resolve more"
    )
