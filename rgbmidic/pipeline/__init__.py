"""The main job: raw frames in, displacement fields out."""

from rgbmidic.illumination.separation import LightSeparation, Separation
from rgbmidic.pipeline.frame import measure_frame
from rgbmidic.pipeline.plan import Plan
from rgbmidic.pipeline.run import measure
from rgbmidic.pipeline.sequence import correlate, measure_sequence
from rgbmidic.pipeline.user_objects import FrameSequence

__all__ = [
    "FrameSequence",
    "LightSeparation",
    "Plan",
    "Separation",
    "correlate",
    "measure",
    "measure_frame",
    "measure_sequence",
]
