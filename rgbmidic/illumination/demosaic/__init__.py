"""From one sample per pixel to one image per camera channel."""

from rgbmidic.illumination.demosaic.base import Demosaicer, check_mosaic
from rgbmidic.illumination.demosaic.linear import BilinearDemosaicer, MalvarDemosaicer
from rgbmidic.illumination.demosaic.menon import MenonDemosaicer
from rgbmidic.illumination.demosaic.per_colour import BandLimitedDemosaicer, NormalisedMosaic
from rgbmidic.illumination.demosaic.reflection_aware import Reconstruction, ReflectionAwareDemosaicer

__all__ = [
    "BandLimitedDemosaicer",
    "BilinearDemosaicer",
    "Demosaicer",
    "MalvarDemosaicer",
    "MenonDemosaicer",
    "NormalisedMosaic",
    "Reconstruction",
    "ReflectionAwareDemosaicer",
    "check_mosaic",
]
