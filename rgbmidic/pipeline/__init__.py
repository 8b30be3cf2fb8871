"""The main job: raw frames in, displacement fields out."""

from rgbmidic.pipeline.run import Weigher, measure, read_region, texture
from rgbmidic.pipeline.separator import Separator, average

__all__ = ["Separator", "Weigher", "average", "measure", "read_region", "texture"]
