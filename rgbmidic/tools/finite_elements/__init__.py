"""Finite elements: meshes of files and where they lie on the image, comparison with a simulation, crack tips."""

from rgbmidic.tools.finite_elements.crack_tip import StressIntensity, Williams, stress_intensity
from rgbmidic.tools.finite_elements.files import read_mesh
from rgbmidic.tools.finite_elements.mesh import FiniteElementMesh
from rgbmidic.tools.finite_elements.mesh_source import measured_mesh, placement_of
from rgbmidic.tools.finite_elements.placement import Placement

__all__ = [
    "FiniteElementMesh",
    "Placement",
    "StressIntensity",
    "Williams",
    "measured_mesh",
    "placement_of",
    "read_mesh",
    "stress_intensity",
]
