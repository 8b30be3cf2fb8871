"""Formats of frame files beside those of the core: movies of high-speed cameras, and bitmaps."""

from rgbmidic.frames import FrameFormat
from rgbmidic.tools.formats.bitmaps import BmpFile, PgmFile
from rgbmidic.tools.formats.cine import CINE_ENDINGS, CineFile
from rgbmidic.tools.formats.movies import MRAW_ENDINGS, MrawFile, SeqFile

FORMATS = (
    FrameFormat(name="Phantom .cine", movies=CINE_ENDINGS, source=CineFile),
    FrameFormat(name="Photron .mraw with .cihx or .cih", movies=MRAW_ENDINGS, source=MrawFile),
    FrameFormat(name="NorPix .seq", movies=(".seq",), source=SeqFile),
    FrameFormat(name="PGM", endings=(".pgm",), source=PgmFile),
    FrameFormat(name="BMP", endings=(".bmp",), source=BmpFile),
)
"""Each is recognised by its ending."""
