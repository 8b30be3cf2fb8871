"""Cracks of a mesh: the displacement jump across them.

The jump is that of the two nodes at one place, the left side's displacement less the right side's for who walks along
the crack, in axes along and across the crack **as deformed**: a rigid motion of the body has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic.arguments import checked
from rgbmidic.errors import InputError
from rgbmidic.field import Displacement, Field
from rgbmidic.fields.history import of_probe
from rgbmidic.fields.nodal import NodalCovariance
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.outline_mesh import edge_keys
from rgbmidic.typing import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Jump:
    """Displacement jump at the pairs of nodes along a crack, px; NaN where one of the nodes around is not measured.

    Attributes
    ----------
    distance : ndarray, shape (P,)
        Of the pairs along the crack from its first point, px on the reference.
    points : ndarray, shape (P, 2)
        Their places on the reference, px.
    opening
        Jump across the deformed crack, positive where it is open, shape (T, P).
    sliding
        Jump along it, positive where the left side is ahead.

    Examples
    --------
    >>> none = Field(name="opening", unit="px", dims=("frame", "pair"), values=np.zeros((1, 3)), std=np.zeros((1, 3)))
    >>> jump = Jump(distance=np.zeros(3), points=np.zeros((3, 2)), opening=none, sliding=none)
    >>> jump.opening.values.shape
    (1, 3)
    """

    distance: FloatArray
    points: FloatArray
    opening: Field
    sliding: Field


class JumpAlong:
    """A probe of the jump across a crack of the mesh, from its point x0, y0 to x1, y1, px.

    Raises
    ------
    InputError
        The mesh has no crack, a point is not on one, or no pair of nodes lies between them.
    """

    def __init__(self, covariance: NodalCovariance, name: str, *place: float) -> None:
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import dijkstra

        mesh, faces = covariance.mesh, crack_faces(covariance.mesh)
        merged_nodes = mesh.merged_index[faces]
        ends = [nearest_node(mesh, name, merged_nodes.ravel(), np.array(place[i : i + 2])) for i in (0, 2)]
        length = np.hypot(*(mesh.nodes[faces[:, 1]] - mesh.nodes[faces[:, 0]]).T)
        graph = csr_matrix((length, merged_nodes.T), shape=(len(mesh.nodes),) * 2)
        before = dijkstra(graph, directed=False, indices=np.array(ends[0]), return_predecessors=True)[1]
        path = [ends[1]]
        while before[path[-1]] >= 0:
            path.append(int(before[path[-1]]))
        path.reverse()
        if path[0] != ends[0] or len(path) < 2:
            raise InputError(
                f"{name} needs two different points of one crack of the mesh, not {comma_separated(place)} px"
            )
        # an element is on the right of its sides as these run: the image has y down
        face = dict(zip(map(tuple, merged_nodes.tolist()), faces.tolist(), strict=True))
        steps = np.array([(face[end, start][::-1], face[start, end]) for start, end in pairwise(path)])
        arrives = np.concatenate([steps[:1, :, 0], steps[:, :, 1]])
        leaves = np.concatenate([steps[:, :, 0], steps[-1:, :, 1]])
        is_single = (arrives == leaves).all(axis=1)  # else another crack branches off here
        # sides (n, 2): node on the left and on the right of each of `points`, as place in `nodes`; the same at a tip.
        # `stencil` (P, 6): those of each pair and of the points before and after it
        self.pairs = np.flatnonzero(is_single & (arrives[:, 0] != arrives[:, 1]))
        if not len(self.pairs):
            raise InputError(
                f"no pair of nodes lies on the crack between the points {comma_separated(place)} px of {name}"
            )
        self.name, self.points = name, mesh.nodes[path]
        self.nodes, index = np.unique(arrives, return_inverse=True)
        sides = index.reshape(-1, 2)
        self.stencil = sides[np.stack([self.pairs, *self._beside], axis=1)].reshape(-1, 6)
        self.covariances = [covariance.subset(self.nodes[row]) for row in self.stencil]

    @property
    def _beside(self) -> tuple[IntArray, IntArray]:
        """Places on the crack before and after each pair."""
        return np.maximum(self.pairs - 1, 0), np.minimum(self.pairs + 1, len(self.points) - 1)

    def read(self, displacement: Displacement) -> Jump:
        """Compute the jump from the displacements of the `nodes`; its uncertainty is that to first order."""
        previous, following = self._beside
        across, along = np.array([1, -1, 0, 0, 0, 0]), np.array([0, 0, -0.5, -0.5, 0.5, 0.5])
        u = displacement.values[..., self.stencil]
        jump, arm = u @ across, (self.points[following] - self.points[previous]).T[:, None] + u @ along
        length = np.hypot(*arm)
        tangent = arm / length
        normal = np.stack([tangent[1], -tangent[0]])
        opening, sliding = (jump * normal).sum(axis=0), (jump * tangent).sum(axis=0)

        def jump_field(name: str, values: FloatArray, axis: FloatArray, turn: FloatArray) -> Field:
            coefficients = axis[..., None] * across + turn[..., None] * along
            pairs = enumerate(zip(self.covariances, self.stencil, strict=True))
            square = [
                covariance.variance(coefficients[:, :, p], displacement.isel(node=row)).sum(axis=0)
                for p, (covariance, row) in pairs
            ]
            errors = np.sqrt(np.stack(square, axis=1))
            return Field(name=name, unit="px", dims=("frame", "pair"), values=values, std=errors)

        # the axes turn with the crack: d(normal) = tangent d(angle), d(angle) = -normal . d(arm) / length
        steps = np.hypot(*np.diff(self.points, axis=0, prepend=self.points[:1]).T)
        return Jump(
            distance=np.cumsum(steps)[self.pairs],
            points=self.points[self.pairs],
            opening=jump_field("opening", opening, normal, -sliding / length * normal),
            sliding=jump_field("sliding", sliding, tangent, opening / length * normal),
        )

    def histories(self, displacement: Displacement) -> list[Field]:
        """Compute opening and sliding of every pair in px."""
        jump = self.read(displacement)
        positions = ", ".join(f"{distance:.4g}" for distance in jump.distance)
        note = (
            f"{self.name}: jump of the left side against the right one, across and along the deformed crack, at its "
            f"pairs of nodes 1 to {len(self.pairs)}, which are {positions} px from its first point"
        )
        return [
            history
            for field in (jump.opening, jump.sliding)
            for pair in range(len(self.pairs))
            for history in of_probe(f"{self.name}_{pair + 1}", [field.isel(pair=pair)], note)
        ]


def comma_separated(numbers: Any) -> str:
    """Numbers with commas between them."""
    return ", ".join(f"{number:g}" for number in numbers)


def crack_faces(mesh: Tri3Mesh) -> IntArray:
    """Both sides of the pieces of cracks as nodes (F, 2), in the order of their elements."""
    sides = mesh.elements[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    return sides[np.isin(edge_keys(sides, len(mesh.nodes)), edge_keys(mesh.crack_edges, len(mesh.nodes)))].astype(int)


def nearest_node(mesh: Tri3Mesh, name: str, nodes: IntArray, point: FloatArray, description: str = "on a crack") -> int:
    """Return the one of some nodes at a stated point, px."""
    if not len(nodes):
        raise InputError(
            f"{name}: no node of this result is {description}; cracks are stated in [mesh] cracks before the run"
        )
    nodes = np.unique(nodes)
    distance = np.hypot(*(mesh.nodes[nodes] - point).T)
    nearest = int(nodes[np.argmin(distance)])
    near = 0.5 * mesh.size  # where a path of `[mesh] cracks` is moved, it is by as much
    if distance.min() > near:
        raise InputError(
            f"{name} at ({comma_separated(point)}) px is not {description} of the mesh; the nearest node that is "
            f"lies at ({comma_separated(mesh.nodes[nearest].round(1))}) px, {distance.min():.3g} px away; {near:.3g} "
            "px count"
        )
    return nearest


@checked
def crack_jump(
    nodes: FloatArray,
    elements: npt.NDArray[np.int32],
    displacement: Displacement,
    start: tuple[float, float],
    end: tuple[float, float],
) -> Jump:
    """Compute the displacement jump along a crack of a mesh, between two of its points.

    Parameters
    ----------
    nodes : ndarray, shape (N, 2)
        In px on the reference.
    elements : ndarray, shape (E, 3)
        Node indices.
    displacement
        Of all nodes, shape (2, T, N), px.
    start, end
        Points (x, y) on the crack, px: left and right are those of who walks from one to the other.

    Returns
    -------
    Jump

    Raises
    ------
    InputError
        The mesh has no crack, a point is not on one, or no pair of nodes lies between them.

    Examples
    --------
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> region = Region.from_rectangle((0, 0, 80, 60), shape=(80, 100))
    >>> mesh = Tri3Mesh.from_region(region, element_size=10, cracks=[[(0, 30), (40, 30)]])
    >>> zero = np.zeros((1, len(mesh.nodes)))
    >>> still = Displacement.in_plane(zero, zero, zero + 0.01, zero + 0.01)
    >>> crack_jump(mesh.nodes, mesh.elements, still, (5, 30), (35, 30)).opening.values.tolist()
    [[0.0, 0.0, 0.0, 0.0]]
    """
    covariance = NodalCovariance.from_mesh(Tri3Mesh(nodes=nodes, elements=elements))
    probe = JumpAlong(covariance, "the crack", *start, *end)
    return probe.read(displacement.isel(node=probe.nodes))
