"""Raw frames and where they come from: readers, the series of a test's frames, writers."""

from rgbmidic.frames.data import ChannelFrame, Mosaic, Recording, Window, cfa_channels
from rgbmidic.frames.formats import FrameFormat, frame_formats, open_source, read_frame
from rgbmidic.frames.images import write_dng, write_tiff
from rgbmidic.frames.masks import read_mask
from rgbmidic.frames.metadata import StoredFrame
from rgbmidic.frames.names import list_frames
from rgbmidic.frames.series import FrameSeries, open_series
from rgbmidic.frames.source import FrameSource, MovieSource, file_fingerprint, file_hash
from rgbmidic.renamed import refuse_old_names

__all__ = [
    "ChannelFrame",
    "FrameFormat",
    "FrameSeries",
    "FrameSource",
    "Mosaic",
    "MovieSource",
    "Recording",
    "StoredFrame",
    "Window",
    "cfa_channels",
    "file_fingerprint",
    "file_hash",
    "frame_formats",
    "list_frames",
    "open_series",
    "open_source",
    "read_frame",
    "read_mask",
    "write_dng",
    "write_tiff",
]

__getattr__ = refuse_old_names(__name__)
