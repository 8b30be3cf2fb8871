"""The main job: raw frames in, displacement fields out."""

from rgbmidic.pipeline.run import Start, Weigher, measure, read_region, texture, track
from rgbmidic.pipeline.separator import Separator, average

__all__ = ["Separator", "Start", "Weigher", "average", "measure", "read_region", "texture", "track"]
