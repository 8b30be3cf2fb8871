"""A measurement at the nodes of a simulation: values there, their noise, and how it is correlated."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from rgbmidic.errors import InputError
from rgbmidic.fields import Displacement, MeshPoints, NodalCovariance, StrainGauges
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.tools.finite_elements.simulation import Simulation, label_indices
from rgbmidic.typing import BoolArray, FloatArray, IntArray

COMPARED_QUANTITIES = ("u", "v", "exx", "eyy", "exy")
"""What is compared: displacement in mm and Green-Lagrange strain, along the axes of the simulation's mesh."""
NODE_TOLERANCE = 1e-6
"""Distance over the size of an element under which two nodes are one: rounding of a placement (derived)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulationNodes:
    """Nodes of a simulation at which a measurement is read.

    Attributes
    ----------
    simulation
        The simulation, of M nodes.
    mesh
        Mesh of the measurement, of N nodes, in mm in the axes of the simulation's.
    covariance
        Covariance of the measurement's nodes.
    node_numbers : ndarray, shape (N,), or None
        Labels of the measurement's nodes in the simulation's file.
    """

    simulation: Simulation
    mesh: Tri3Mesh
    covariance: NodalCovariance
    node_numbers: IntArray | None = None

    @cached_property
    def _matching_nodes(self) -> IntArray:
        """Node (M,) of the measurement that is each of the simulation's, by number and place; -1 where there is none.

        All are -1 where the measurement has nodes of its own.
        """
        points, numbers = self.simulation.mesh.points, self.node_numbers
        nodes = np.arange(len(points)) if len(points) == len(self.mesh.nodes) else np.full(len(points), -1)
        if numbers is not None:
            nodes = label_indices(numbers, self.simulation.mesh.node_numbers)
        distance = np.abs(self.mesh.nodes[nodes] - points).max(axis=1)
        nodes = np.where(distance < NODE_TOLERANCE * self.mesh.size, nodes, -1)
        return nodes if len(np.unique(nodes[nodes >= 0])) == len(self.mesh.nodes) else np.full(len(points), -1)

    @cached_property
    def _simulation_points(self) -> MeshPoints:
        """The simulation's nodes in the measurement's mesh."""
        points = MeshPoints.of(self.mesh, self.simulation.mesh.points)
        if not points.inside.any():
            raise InputError(f"no node of {self.simulation.name} lies in the region that was measured")
        return points

    def _sampling_matrix(self, has_data: BoolArray | None = None) -> tuple[sp.csr_matrix, BoolArray]:
        """Return the matrix (M, N) that reads nodes (N,) with data at the simulation's, and a mask (M,) of these."""
        valid = np.ones(len(self.mesh.nodes), dtype=bool) if has_data is None else has_data
        if (has_node := self._matching_nodes >= 0).any():
            entries = np.ones(has_node.sum()), (np.flatnonzero(has_node), self._matching_nodes[has_node])
            return sp.csr_matrix(entries, shape=(len(has_node), len(valid))), has_node & valid[self._matching_nodes]
        return self._simulation_points.weights(valid), self._simulation_points.measured(valid)

    @cached_property
    def gauges(self) -> tuple[StrainGauges, sp.csr_matrix]:
        """The shortest strain gauges, and the matrix (M, G) that gives each node of the simulation its own."""
        sampling, is_inside = self._sampling_matrix()
        if (self._matching_nodes >= 0).any():
            return StrainGauges.at_nodes(self.covariance), sampling
        gauges = StrainGauges.at_points(self.covariance, self.simulation.mesh.points[is_inside])
        return gauges, sp.eye(len(is_inside), format="csr")[:, is_inside]

    @cached_property
    def correlations(self) -> list[tuple[list[sp.csr_matrix], list[sp.csr_matrix]]]:
        """Correlations C and K (M, M) between nodes of each of the `COMPARED_QUANTITIES`: of fit and lights' bias.

        With them their products C C, 2 C K and K K, entry by entry.
        """
        sampling, (gauges, selection) = self._sampling_matrix()[0], self.gauges
        x, y = (selection @ slope for slope in gauges.slopes)
        correlations = []
        for matrices in ([sampling], [x], [y], [x, y]):
            relative = self.covariance.relative(matrices)
            fit, bias = (sp.csr_matrix(root @ root.T) for root in (relative.fit, relative.bias))
            products = [
                sp.csr_matrix(product) for product in (fit.multiply(fit), 2 * fit.multiply(bias), bias.multiply(bias))
            ]
            correlations.append(([fit, bias], products))
        return [correlations[0], *correlations]

    def read(self, displacement: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return displacement (2, N) and its strain at the simulation's nodes, (5, M), and their noise, (2, 5, M)."""
        has_data = np.asarray(np.isfinite(displacement + noise[0]).all(axis=0))
        sampling, is_measured = self._sampling_matrix(has_data)
        values, *noise_std = np.full((3, len(COMPARED_QUANTITIES), len(is_measured)), np.nan)
        (gauges, selection), bias = self.gauges, noise[1]
        node, gauge = selection.nonzero()
        noise_cases = [(noise_std[0], noise), (noise_std[1], np.stack([bias, bias]))]
        noise_std[1][:] = 0.0
        for std, stds in noise_cases if (bias > 0).any() else noise_cases[:1]:
            for row, (component, *errors) in enumerate(zip(displacement, *stds, strict=True)):
                factor = sampling @ self.covariance.factor(*np.where(has_data, errors, 0))
                values[row] = np.where(is_measured, sampling @ np.where(has_data, component, 0), np.nan)
                variance = np.asarray(factor.multiply(factor).sum(axis=1)).ravel()
                std[row] = np.where(is_measured, np.sqrt(variance), np.nan)
            strain = gauges.strain(Displacement(values=displacement, std=stds[0], bias=stds[1]))
            for row, name in enumerate(("exx", "eyy", "exy"), start=2):
                values[row, node], std[row, node] = strain[name].values[gauge], strain[name].uncertainty[gauge]
        return values, np.stack(noise_std)
