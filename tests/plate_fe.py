"""A finite-element simulation that tests compare with: a plate with a hole in tension, linear-elastic plane stress."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from renders import kept
from results import make_result
from scipy.sparse.linalg import spsolve
from textures import Texture

from rgbmidic import FiniteElementMesh, Placement, Region, Tri3Mesh, correlate
from rgbmidic.fields.interpolation import MeshPoints
from rgbmidic.results import FrameRecord
from rgbmidic.tools.finite_elements.comparison import Comparison, FrameComparison
from rgbmidic.tools.finite_elements.simulation import Simulation
from rgbmidic.typing import FloatArray

SHAPE, MM_PER_PIXEL = (210, 190), 0.05
RADIUS, CENTRE = 30.0, (95.0, 105.0)
EDGES = (12.0, 12.0, 178.0, 198.0)
PLACEMENT = Placement.fit([[0, 0, 12, 198], [8.3, 0, 178, 198], [0, 9.3, 12, 12], [8.3, 9.3, 178, 12]])
"""The mesh's origin is the plate's lower left corner, y up."""


def plane_stress(
    points: FloatArray, elements: np.ndarray, *, modulus: float, poisson: float, traction: float
) -> FloatArray:
    """Displacement (N, 2) of a plate of three-node triangles that is pulled along y, mm.

    Zienkiewicz and Taylor, The Finite Element Method, volume 1, chapters 2 and 4. The lowest nodes do not move along y,
    the first of them not along x; the `traction` (MPa) acts on the highest edge.
    """
    mesh = Tri3Mesh(nodes=points, elements=elements)
    slopes, count = mesh.shape_gradients(), len(points)
    strain = np.zeros((len(mesh.elements), 3, 6))
    strain[:, 0, 0::2], strain[:, 1, 1::2] = slopes[..., 0], slopes[..., 1]
    strain[:, 2, 0::2], strain[:, 2, 1::2] = slopes[..., 1], slopes[..., 0]
    law = np.array([[1, poisson, 0], [poisson, 1, 0], [0, 0, (1 - poisson) / 2]]) * modulus / (1 - poisson**2)
    blocks = strain.transpose(0, 2, 1) @ law @ strain * mesh.areas[:, None, None]
    freedom = (2 * mesh.elements[..., None] + np.arange(2)).reshape(-1, 6)
    rows, columns = np.repeat(freedom, 6, axis=1).ravel(), np.tile(freedom, 6).ravel()
    stiffness = sp.csr_matrix((blocks.ravel(), (rows, columns)), shape=(2 * count, 2 * count))
    x, y = points.T
    force, top = np.zeros(2 * count), np.flatnonzero(y > y.max() - 1e-9)
    top = top[np.argsort(x[top])]
    for a, b in pairwise(top):
        force[[2 * a + 1, 2 * b + 1]] += traction * (x[b] - x[a]) / 2
    bottom = np.flatnonzero(y < y.min() + 1e-9)
    free = np.ones(2 * count, dtype=bool)
    free[2 * bottom + 1] = free[2 * bottom[np.argmin(x[bottom])]] = False
    moved = np.zeros(2 * count)
    moved[free] = spsolve(stiffness[free][:, free].tocsc(), force[free])
    return moved.reshape(-1, 2)


@dataclass(frozen=True, kw_only=True)
class Plate:
    """The simulated plate, and photographs of it whose truth is the simulated field.

    Attributes
    ----------
    mesh
        The simulation's mesh.
    displacement : ndarray, shape (N, 2)
        Of its nodes, mm.
    """

    mesh: FiniteElementMesh
    displacement: FloatArray

    @classmethod
    def of(cls, size: float, *, modulus: float = 70e3, strain: float = 4e-3, name: str = "plate") -> Plate:
        """Elements of `size` px, and a traction that strains a plate without hole of 70 GPa by `strain`."""
        drawn = Tri3Mesh.from_region(cls.region(), size)
        mesh = FiniteElementMesh(
            name=name,
            points=PLACEMENT.to_mm(drawn.nodes),
            node_numbers=100 + 3 * np.arange(len(drawn.nodes)),
            elements=drawn.elements,
            element_numbers=1 + np.arange(len(drawn.elements)),
        )
        moved = plane_stress(mesh.points, mesh.elements, modulus=modulus, poisson=0.33, traction=70e3 * strain)
        return cls(mesh=mesh, displacement=moved)

    @staticmethod
    def region() -> Region:
        """The pixels of the plate."""
        x0, y0, x1, y1 = EDGES
        angle = np.linspace(0, 2 * np.pi, 41)[:-1]
        hole = np.array(CENTRE) + RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return Region.from_polygon([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], SHAPE).without([hole])

    @property
    def nodes(self) -> FloatArray:
        """Nodes (N, 2) on the image, px."""
        return PLACEMENT.to_px(self.mesh.points)

    @property
    def moved(self) -> FloatArray:
        """Displacement (N, 2) of the nodes on the image, px."""
        return PLACEMENT.vectors_to_px(self.mesh.points, self.displacement)

    def image(self, texture: Texture, amount: float) -> FloatArray:
        """Grey levels (H, W) of the plate at a fraction of its load; the hole shows what the nearest element does."""
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
        spatial = np.stack([x.ravel(), y.ravel()], axis=1)
        drawn, material = Tri3Mesh(nodes=self.nodes, elements=self.mesh.elements), spatial
        for _ in range(3 if amount else 0):  # the strain is 1e-2: each step gains two digits
            places = MeshPoints.of(drawn, material)
            values = amount * self.moved[drawn.elements[places.element]]
            material = spatial - np.einsum("pc,pcd->pd", places.barycentric, values)
        return texture.at(*material.T).reshape(SHAPE)


@kept
def compared_plates(
    *, draws: int, moduli: Sequence[float], texture: int = 3, element_size: float = 30
) -> dict[float, list[FrameComparison]]:
    """Compare pairs of noisy photographs of a plate with its simulation, and with one whose modulus is a multiple."""
    plate, painted, random = Plate.of(10), Texture.random(texture, waves=150), np.random.default_rng(1)
    pair = [plate.image(painted, amount) for amount in (0.0, 1.0)]
    solutions = [
        correlate(
            *(image + random.normal(0, 4.0, image.shape) for image in pair),
            region=plate.region(),
            element_size=element_size,
        )
        for _ in range(draws)
    ]
    nodes = solutions[0].nodes

    def record(index: int) -> FrameRecord:
        (u, v), (u_std, v_std) = solutions[index].displacement.T, solutions[index].displacement_std.T
        edge_std = solutions[index].edge_std
        stated = {"u_std": u_std, "v_std": v_std} | dict(zip(("u_edge_std", "v_edge_std"), edge_std.T, strict=True))
        return FrameRecord.from_values(nodes=len(nodes), lights=3, number=index, status=0, u=u, v=v, **stated)

    mesh = {"nodes": nodes, "elements": solutions[0].elements, "references": []}
    simulation = Simulation(mesh=plate.mesh, displacement=plate.displacement[None])
    made = {}
    with tempfile.TemporaryDirectory() as folder:
        result = make_result(Path(folder) / "result", frames=draws, record=record, **mesh)
        for modulus in moduli:
            wrong = replace(simulation, displacement=simulation.displacement / modulus)
            made[modulus] = list(Comparison(result, wrong, PLACEMENT, frames=range(draws)).iterate())
    return made
