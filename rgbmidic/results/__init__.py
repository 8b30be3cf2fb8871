"""What is kept of a test: one record per frame, the folder that holds them, and other programs' formats."""

from rgbmidic.field import Field
from rgbmidic.fields.quantity import ResultQuantity
from rgbmidic.illumination.images import REFLECTING
from rgbmidic.illumination.texture import speckle_diameter
from rgbmidic.renamed import refuse_old_names
from rgbmidic.results.channels import Channels
from rgbmidic.results.export import EXPORT_FORMATS, export_result
from rgbmidic.results.histories import Histories, history_rows, write_histories
from rgbmidic.results.maps import Maps
from rgbmidic.results.profiles import Profile, Wave, read_profile, write_profile
from rgbmidic.results.provenance import Origin
from rgbmidic.results.quantities import QUANTITIES, UNKNOWN_TIME
from rgbmidic.results.records import FrameRecord
from rgbmidic.results.result import Result, finish_result
from rgbmidic.results.result_in_units import common_variance_fraction, frame_times
from rgbmidic.results.store import ResultStore

__all__ = [
    "EXPORT_FORMATS",
    "QUANTITIES",
    "REFLECTING",
    "UNKNOWN_TIME",
    "Channels",
    "Field",
    "FrameRecord",
    "Histories",
    "Maps",
    "Origin",
    "Profile",
    "Result",
    "ResultQuantity",
    "ResultStore",
    "Wave",
    "common_variance_fraction",
    "export_result",
    "finish_result",
    "frame_times",
    "history_rows",
    "read_profile",
    "speckle_diameter",
    "write_histories",
    "write_profile",
]


__getattr__ = refuse_old_names(__name__)
