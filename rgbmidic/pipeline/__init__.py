"""The main job: raw frames in, displacement fields out."""

from rgbmidic.pipeline.frame import correlate, measure_frame
from rgbmidic.pipeline.plan import Plan, read_region
from rgbmidic.pipeline.run import measure, measure_sequence
from rgbmidic.pipeline.source import FrameSequence, LightSeparation, Separation, correlated

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
