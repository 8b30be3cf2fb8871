"""From one sample per pixel to one image per camera channel."""

from rgbmidic.illumination.demosaic.base import Demosaicer, check_mosaic
from rgbmidic.illumination.demosaic.linear import BilinearDemosaicer, MalvarDemosaicer

__all__ = ["BilinearDemosaicer", "Demosaicer", "MalvarDemosaicer", "check_mosaic"]
