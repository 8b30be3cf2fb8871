"""Region of interest, TRI3 mesh and pixel map, and finite-element meshes of files with their placement."""

from rgbmidic.mesh.files import read_mesh
from rgbmidic.mesh.finite_elements import FiniteElementMesh
from rgbmidic.mesh.pixel_map import PixelMap
from rgbmidic.mesh.placement import Placement
from rgbmidic.mesh.region import Region
from rgbmidic.mesh.tri3 import Tri3Mesh

__all__ = ["FiniteElementMesh", "PixelMap", "Placement", "Region", "Tri3Mesh", "read_mesh"]
