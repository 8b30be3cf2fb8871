"""The main job: raw frames in, displacement fields out."""

from rgbmidic.pipeline.frame import measure_frame
from rgbmidic.pipeline.pair import correlate
from rgbmidic.pipeline.plan import Plan, read_region
from rgbmidic.pipeline.run import measure, measure_sequence
from rgbmidic.pipeline.separation import LightSeparation, Separation, correlated
from rgbmidic.pipeline.source import FrameSequence

__all__ = [
    "FrameSequence",
    "LightSeparation",
    "Plan",
    "Separation",
    "correlate",
    "correlated",
    "measure",
    "measure_frame",
    "measure_sequence",
    "read_region",
]
