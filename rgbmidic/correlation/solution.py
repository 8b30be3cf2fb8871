"""The solution: a displacement field with its uncertainty and status, and the filling of nodes without data.

Nodes are filled from those around by a smooth field, for users who ask for it. The field minimises the squared graph
Laplacian over the nodes without data after a quadratic trend of the measured ones is taken off (a thin plate that bends
as little as it can). The uncertainty is that of the nearest measured node plus what neighbouring nodes differ from that
trend by, growing with the square root of the number of elements crossed, like a random walk.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from rgbmidic.mesh import Tri3Mesh
from rgbmidic.text import HtmlRepr, format_value, format_with_std
from rgbmidic.typing import BoolArray, FloatArray

NO_MATCH = "the images do not match anywhere in the region"
"""Reason of a frame in which nothing was found."""


DISPUTED = 0.1
"""Uncertainty (px) by the lights' bias from which, at 1 % of the nodes, they are said to disagree. Chosen."""


class Status(IntEnum):
    """Status of a frame.

    Examples
    --------
    >>> import numpy as np
    >>> from rgbmidic import Status, correlate
    >>> correlate(np.zeros((60, 60)), np.zeros((60, 60))).status is Status.FAILED
    True
    """

    CONVERGED = 0
    NOT_CONVERGED = 1
    FAILED = 2


class NodeStatus(IntEnum):
    """Status of a node.

    Examples
    --------
    >>> from rgbmidic.results import Result
    >>> result = Result.open("my_result")
    >>> measured = result.node_status[1] == NodeStatus.MEASURED
    >>> measured.shape == (len(result.nodes),)
    True
    """

    MEASURED = 0
    NOT_SEEN = 1
    """No light sees enough texture around the node, in the reference or in the deformed image."""
    DECORRELATED = 2
    """The images around the node do not match at the displacement found."""
    FILLED = 3
    """Not measured; the value is carried over from measured nodes within the distance asked for."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution(HtmlRepr):
    """Displacement field of one frame.

    Attributes
    ----------
    nodes : ndarray, shape (N, 2), float64
        Node positions (x, y) in px on the reference image.
    elements : ndarray, shape (E, 3), int32
    displacement : ndarray, shape (N, 2), float64
        (u, v) in px at the nodes, recovered from the best linear fit (`recovery`); NaN where not measured.
    displacement_std : ndarray, shape (N, 2), float64
        Standard uncertainty of the nodal values in px, from the residual (noise, demosaicing, irregular reflections,
        deviations from a quadratic); NaN where not measured.
    bias_std : ndarray, shape (N, 2), float64
        Part of it in px that the bias of the lights leaves (`light_bias`), alike over some 24 px: the variance beside
        it, ``displacement_std**2 - bias_std**2``, follows the mesh. 0 with a single light; NaN where not measured.
    edge_std : ndarray, shape (N, 2), float64
        Part of it in px that the recovery misses near free boundaries (`with_one_sided_error`); NaN where not measured.
    strain, strain_std : ndarray, shape (N, 3), float64
        Small strain (exx, eyy, exy), tensor shear, and its standard uncertainty: slopes of the quadratic through the
        neighbouring nodes; NaN where the node or a neighbour is not measured.
    displacement_error, strain_error : ndarray, shape (N, 2), (N, 3), float64
        What mesh and recovery leave out of both, as standard deviations (`discretisation_error`); NaN where not asked
        for or not known.
    node_status : ndarray, shape (N,), uint8
        See `NodeStatus`.
    light_fraction : ndarray, shape (N, k), float64
        Fraction of each light in the information that determines the node.
    misfit : ndarray, shape (N,), float64
        Weighted rms residual around the node over its median: 1 is typical; a value far above 1 is suspicious.
    status : Status
    reason : str
        Why the frame is not converged; empty otherwise.
    rigid : ndarray, shape (k, m), float64
        Coefficients beta of the rigid functions of each light (0 for the first, NaN for a light that sees nothing):
        shift in x and y in px, then rotation in rad about the middle of the mesh.
    residual : ndarray, shape (k,), float64
        Weighted rms of ``f - g(x + u)`` of each light, corrected for brightness, over the local mean of f; NaN where a
        light has no weight.
    weight_fraction : ndarray, shape (k,), float64
        Mean over the pixels of the region of each light's fraction of the sum of the weights; adds up to the part of
        the region that any light sees.
    history : ndarray, shape (iterations,), float64
        Largest motion of a measured node in each iteration, px.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> from rgbmidic import correlate
    >>> speckle = 1000 + 3000 * gaussian_filter(np.random.default_rng(0).normal(size=(80, 80)), 1.5)
    >>> solution = correlate(speckle, np.roll(speckle, 1, axis=1), element_size=40)
    >>> solution.displacement.shape == solution.displacement_std.shape == (len(solution.nodes), 2)
    True
    >>> bool(solution.displacement_std[solution.measured].max() < 0.05)
    True
    """

    nodes: FloatArray
    elements: npt.NDArray[np.int32]
    displacement: FloatArray
    displacement_std: FloatArray
    bias_std: FloatArray
    edge_std: FloatArray
    strain: FloatArray
    strain_std: FloatArray
    displacement_error: FloatArray
    strain_error: FloatArray
    node_status: npt.NDArray[np.uint8]
    light_fraction: FloatArray
    misfit: FloatArray
    status: Status
    reason: str
    rigid: FloatArray
    residual: FloatArray
    weight_fraction: FloatArray
    history: FloatArray

    def __repr__(self) -> str:
        """Return how the solve ended and what was found, in a few lines."""
        measured = self.node_status == NodeStatus.MEASURED
        lines = [
            f"<rgbmidic.Solution {self.status.name.lower()}, {len(self.history)} iterations>",
            f"mesh:   {len(self.nodes)} nodes, {len(self.elements)} elements; "
            f"{measured.mean():.1%} of the nodes measured",
            f"lights: {self.light_fraction.shape[1]}",
        ]
        if self.reason:
            lines.insert(1, f"reason: {self.reason}")
        for name, values, std in zip("uv", self.displacement.T, self.displacement_std.T, strict=True):
            if (finite := values[np.isfinite(values)]).size:
                spread = float(np.median(std[np.isfinite(std)])) if np.isfinite(std).any() else np.nan
                minimum, maximum = format_value(finite.min(), spread), format_with_std(finite.max(), spread, "px")
                lines.append(f"{name}:      {minimum} to {maximum} (median)")
        return "\n".join(lines)

    @property
    def disagreement(self) -> str:
        """Report where the lights show displacements that their agreement does not settle; empty if they do not."""
        mainly = self.bias_std**2 > 0.8 * self.displacement_std**2  # twice of all else together
        std, measured = np.where(mainly, self.bias_std, 0).max(axis=1), int(self.measured.sum())
        disputed, (x, y) = int((std > DISPUTED).sum()), self.nodes[std.argmax()]
        if disputed <= 0.01 * measured:
            return ""
        return (
            f"the lights show different displacements at {disputed} of {measured} nodes, most at x {x:.0f}, y {y:.0f}, "
            f"and which is right is not known: their uncertainty holds it ({std.max():.2g} px at most)"
        )

    @classmethod
    def failed(cls, mesh: Tri3Mesh, lights: int, reason: str, history: FloatArray) -> Solution:
        """Return a solution where nothing can be measured: NaN everywhere, and the reason.

        Parameters
        ----------
        mesh
            N nodes, E elements.
        lights
            Number of lights.
        reason
            Why nothing is measured.
        history : ndarray, shape (iterations,)
            Norms of the steps that were made, px.

        Returns
        -------
        Solution
        """
        count = len(mesh.nodes)
        return cls(
            nodes=mesh.nodes,
            elements=mesh.elements,
            displacement=np.full((count, 2), np.nan),
            displacement_std=np.full((count, 2), np.nan),
            bias_std=np.full((count, 2), np.nan),
            edge_std=np.full((count, 2), np.nan),
            strain=np.full((count, 3), np.nan),
            strain_std=np.full((count, 3), np.nan),
            displacement_error=np.full((count, 2), np.nan),
            strain_error=np.full((count, 3), np.nan),
            node_status=np.full(count, NodeStatus.NOT_SEEN, dtype=np.uint8),
            light_fraction=np.zeros((count, lights)),
            misfit=np.full(count, np.nan),
            status=Status.FAILED,
            reason=reason,
            rigid=np.zeros((lights, 0)),
            residual=np.full(lights, np.nan),
            weight_fraction=np.zeros(lights),
            history=history,
        )

    @property
    def iterations(self) -> int:
        """Number of Gauss-Newton iterations."""
        return len(self.history)

    @property
    def measured(self) -> BoolArray:
        """True for each measured node, shape (N,)."""
        return np.asarray(self.node_status == NodeStatus.MEASURED)

    @property
    def unmeasured_fraction(self) -> float:
        """Fraction of the nodes that are not measured."""
        return float((self.node_status != NodeStatus.MEASURED).mean())


_UNSETTLED = 0.02
"""Fraction of the nodes whose loss is as bad as iterations that did not converge. Chosen: at the rim of a fragment that
turns some nodes in a thousand may swing for good, while a solve that converges elsewhere has lost all of it."""


def rank(status: int, node_status: npt.NDArray[np.uint8]) -> tuple[bool, float]:
    """Rank of a solve among several of one frame; the smallest is the best.

    Parameters
    ----------
    status
        `Status` of the frame.
    node_status : ndarray, shape (N,)
        `NodeStatus` of its nodes.

    Returns
    -------
    tuple
        Whether it failed; the fraction of the nodes without data, more where the iterations did not converge.
    """
    without = float((node_status != NodeStatus.MEASURED).mean())
    return status == Status.FAILED, without + _UNSETTLED * (status == Status.NOT_CONVERGED)


def fill(mesh: Tri3Mesh, solution: Solution, longest: float) -> Solution:
    """Fill the displacement of nodes without data near measured ones.

    Filled nodes get `NodeStatus.FILLED` and a larger `displacement_std`; strains are left as they are.

    Parameters
    ----------
    mesh
        Of the solution.
    solution
        To fill.
    longest
        Distance in px along the mesh up to which a node is filled from a measured one.

    Returns
    -------
    Solution

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> from rgbmidic import correlate
    >>> speckle = 1000 + 3000 * gaussian_filter(np.random.default_rng(0).normal(size=(80, 80)), 1.5)
    >>> speckle[25:55, 25:55] = np.nan
    >>> solution = correlate(speckle, np.roll(speckle, 1, axis=1), element_size=12)
    >>> filled = fill(Tri3Mesh(nodes=solution.nodes, elements=solution.elements), solution, longest=40.0)
    >>> np.isnan(solution.displacement).any(), np.isnan(filled.displacement).any()
    (np.True_, np.False_)
    """
    measured = solution.measured
    if measured.all() or measured.sum() < 6:
        return solution
    distance, nearest = mesh.nearest_nodes(measured)
    filled = ~measured & (distance <= longest)
    if not filled.any():
        return solution
    trend, remainder = _quadratic_trend(mesh.nodes, solution.displacement, measured)
    i, j = mesh.neighbours[measured[mesh.neighbours].all(axis=1)].T
    step = np.sqrt(np.mean((remainder[i] - remainder[j]) ** 2, axis=0)) if len(i) else np.zeros(2)
    size = float(np.sqrt(2 * mesh.areas.mean()))
    std = np.hypot(solution.displacement_std[nearest], step * np.sqrt(np.minimum(distance, longest) / size)[:, None])
    displacement = trend + _smooth(mesh, remainder, measured)
    return replace(
        solution,
        displacement=np.where(filled[:, None], displacement, solution.displacement),
        displacement_std=np.where(filled[:, None], std, solution.displacement_std),
        node_status=np.where(filled, np.uint8(NodeStatus.FILLED), solution.node_status),
    )


def _quadratic_trend(nodes: FloatArray, displacement: FloatArray, measured: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Quadratic least-squares fit at all nodes (N, 2), and what the measured ones leave (0 elsewhere)."""
    scaled = (nodes - nodes.mean(axis=0)) / np.ptp(nodes, axis=0).max()
    x, y = scaled.T
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    trend = basis @ np.linalg.lstsq(basis[measured], displacement[measured], rcond=1e-9)[0]
    return trend, np.where(measured[:, None], displacement - trend, 0.0)


def _smooth(mesh: Tri3Mesh, values: FloatArray, measured: BoolArray) -> FloatArray:
    """`values` (N, 2) at the measured nodes, and the field of least squared Laplacian through them elsewhere."""
    from scipy.sparse.linalg import spsolve

    count = len(mesh.nodes)
    i, j = mesh.neighbours.T
    adjacency = sp.csr_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
    adjacency = adjacency + adjacency.T
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    laplacian = sp.eye(count, format="csr") - sp.diags(1 / np.maximum(degree, 1)) @ adjacency
    energy = sp.csc_matrix(laplacian.T @ laplacian + 1e-8 * sp.eye(count))
    free, fixed = np.flatnonzero(~measured), np.flatnonzero(measured)
    out = values.copy()
    right = -(energy[free][:, fixed] @ values[fixed])
    out[free] = np.asarray(spsolve(energy[free][:, free].tocsc(), right)).reshape(-1, 2)
    return out
