"""Region of interest, TRI3 mesh and pixel map."""

from rgbmidic.mesh.pixel_map import PixelMap
from rgbmidic.mesh.region import Region
from rgbmidic.mesh.tri3 import Tri3Mesh

__all__ = ["PixelMap", "Region", "Tri3Mesh"]
