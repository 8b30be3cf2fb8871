"""What is kept of a test: one record per frame, the folder that holds them, and other programs' formats."""

from rgbmidic.illumination.images import REFLECTING
from rgbmidic.results.export import EXPORT_FORMATS, export_result
from rgbmidic.results.measures import frame_times, reference_frames, shared_part, units_of
from rgbmidic.results.physical import Physical
from rgbmidic.results.provenance import Origin
from rgbmidic.results.quantities import QUANTITIES, UNKNOWN_TIME, Quantity
from rgbmidic.results.record import FrameRecord
from rgbmidic.results.result import Result
from rgbmidic.results.store import ResultStore, finish_result

__all__ = [
    "EXPORT_FORMATS",
    "QUANTITIES",
    "REFLECTING",
    "UNKNOWN_TIME",
    "FrameRecord",
    "Origin",
    "Physical",
    "Quantity",
    "Result",
    "ResultStore",
    "export_result",
    "finish_result",
    "frame_times",
    "reference_frames",
    "shared_part",
    "units_of",
]
