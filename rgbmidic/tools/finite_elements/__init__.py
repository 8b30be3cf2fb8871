"""Finite elements: meshes of files and where they lie on the image, comparison with a simulation."""

from rgbmidic.tools.finite_elements.files import read_mesh
from rgbmidic.tools.finite_elements.mesh import FiniteElementMesh
from rgbmidic.tools.finite_elements.mesh_source import measured_mesh, placement_of
from rgbmidic.tools.finite_elements.placement import Placement

__all__ = ["FiniteElementMesh", "Placement", "measured_mesh", "placement_of", "read_mesh"]
