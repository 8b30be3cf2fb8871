"""From one sample per pixel to one image per camera channel."""

from rgbmidic.illumination.demosaic.base import Demosaicer, check_mosaic
from rgbmidic.illumination.demosaic.malvar import MalvarDemosaicer
from rgbmidic.illumination.demosaic.normalised import NormalisedMosaic
from rgbmidic.illumination.demosaic.reflection_aware import Reconstruction, ReflectionAwareDemosaicer

__all__ = [
    "Demosaicer",
    "MalvarDemosaicer",
    "NormalisedMosaic",
    "Reconstruction",
    "ReflectionAwareDemosaicer",
    "check_mosaic",
]
