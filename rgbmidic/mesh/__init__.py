"""Region of interest, TRI3 mesh and pixel map, and where a mesh is from that is not made here."""

from rgbmidic.mesh.pixel_map import PixelMap
from rgbmidic.mesh.region import Region
from rgbmidic.mesh.source import MeshLabels, MeshSource
from rgbmidic.mesh.tri3 import Tri3Mesh

__all__ = ["MeshLabels", "MeshSource", "PixelMap", "Region", "Tri3Mesh"]
