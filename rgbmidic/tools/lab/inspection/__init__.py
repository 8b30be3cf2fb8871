"""Inspection of one frame before a test: exposure, lights, reflections, speckle, noise, uncertainty to expect."""

from rgbmidic.tools.lab.inspection.inspect import inspect_files, inspect_frame, state_frames
from rgbmidic.tools.lab.inspection.results import Inspection, Spread

__all__ = ["Inspection", "Spread", "inspect_files", "inspect_frame", "state_frames"]
