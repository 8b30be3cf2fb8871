"""Formats that frames are read from, each declared once, and the reading of a single frame."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Literal, NoReturn, TypedDict, Unpack

from rgbmidic.arguments import checked
from rgbmidic.errors import ConfigurationError, FrameError, InputError
from rgbmidic.extensions import FRAME_FORMATS
from rgbmidic.frames.camera_raw import CAMERA_RAW_ENDINGS, CameraRaw, has_camera_header
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.images import HeaderlessFile, PngFile
from rgbmidic.frames.metadata import CameraMetadata
from rgbmidic.frames.source import FrameSource, split_dataset
from rgbmidic.frames.stacks import HDF5_ENDINGS, Hdf5File, NpyFile
from rgbmidic.frames.tiff import TIFF_ENDINGS, TiffFile, TiffStack, is_tiff_stack
from rgbmidic.frames.tiff_pages import is_dng
from rgbmidic.settings import FrameKind, FrameSettings

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameFormat:
    """A format of frame files.

    Attributes
    ----------
    name
        What messages call it.
    endings
        Endings (lower case) of its files in a folder.
    movies
        Endings of its files that are named by themselves: a folder does not stand for movies.
    recognises
        Whether a file, with what the user states of it, is read as this format; it raises nothing for any file. None:
        by its ending.
    source
        Its reader; built with `path` and `user_metadata`, it reads nothing yet.

    Examples
    --------
    >>> from pathlib import Path
    >>> text_format = FrameFormat(name="text", endings=(".txt",), source=FrameSource)
    >>> text_format.reads(Path("frame.txt"), FrameSettings(path="frame.txt"))
    True
    """

    name: str
    endings: tuple[str, ...] = ()
    recognises: Callable[[Path, FrameSettings], bool] | None = None
    source: type[FrameSource]
    movies: tuple[str, ...] = ()

    def reads(self, path: Path, user_metadata: FrameSettings) -> bool:
        """Report whether it reads a file of which the user states this.

        Parameters
        ----------
        path
            The file.
        user_metadata
            What the user states of it.

        Returns
        -------
        bool
        """
        if self.recognises is None:
            return path.suffix.lower() in self.endings + self.movies
        return self.recognises(path, user_metadata)


def _is_headerless(path: Path, user_metadata: FrameSettings) -> bool:
    """Return whether a file has no header: .bin, and .raw whose shape is stated, as some cameras' .raw have one."""
    return path.suffix.lower() == ".bin" or (path.suffix.lower() == ".raw" and user_metadata.shape is not None)


def _is_tiff(path: Path, _: FrameSettings) -> bool:
    return path.suffix.lower() in TIFF_ENDINGS and not is_dng(path)


def _is_tiff_stack(path: Path, _: FrameSettings) -> bool:
    return path.suffix.lower() in TIFF_ENDINGS and is_tiff_stack(path) and not is_dng(path)


FORMATS = (
    FrameFormat(
        name="headerless .raw and .bin files whose shape and dtype are stated",
        endings=(".raw", ".bin"),
        recognises=_is_headerless,
        source=HeaderlessFile,
    ),
    FrameFormat(name="PNG", endings=(".png",), source=PngFile),
    FrameFormat(name="TIFF stacks", recognises=_is_tiff_stack, source=TiffStack),
    FrameFormat(name="TIFF", endings=TIFF_ENDINGS, recognises=_is_tiff, source=TiffFile),
    FrameFormat(
        name="camera raws (DNG, NEF, CR2, ARW, ...)",
        endings=CAMERA_RAW_ENDINGS,
        recognises=lambda path, _: has_camera_header(path),
        source=CameraRaw,
    ),
    FrameFormat(name="stacks in .npy files", movies=(".npy",), source=NpyFile),
    FrameFormat(
        name="stacks in HDF5 files",
        movies=HDF5_ENDINGS,
        recognises=lambda path, _: Path(split_dataset(path)[0]).suffix.lower() in HDF5_ENDINGS,
        source=Hdf5File,
    ),
)
"""The first that recognises a file reads it."""

ENTRY_POINTS = "rgbmidic.frame_formats"
"""Group of the entry points by which other packages add formats; each names a `FrameFormat`."""


@cache
def _added_formats() -> tuple[FrameFormat, ...]:
    """Return the formats of tools and of other packages; one that cannot be loaded is left out with a warning."""
    formats = [frame_format for load in FRAME_FORMATS.values() for frame_format in load()]
    for point in entry_points(group=ENTRY_POINTS):
        try:
            frame_format = point.load()
            if not isinstance(frame_format, FrameFormat):
                raise TypeError(f"it is a {type(frame_format).__name__}, not a rgbmidic.frames.FrameFormat")
            formats.append(frame_format)
        except Exception as error:  # of whatever package it is
            logger.warning("the frame format %s (%s) is left out: %s", point.name, point.value, error)
    return tuple(formats)


def frame_formats() -> tuple[FrameFormat, ...]:
    """Return all formats, the package's own first: the first that recognises a file reads it.

    Returns
    -------
    tuple of FrameFormat

    Examples
    --------
    >>> any(".dng" in frame_format.endings for frame_format in frame_formats())
    True
    """
    return (*FORMATS, *_added_formats())


_MOVIE = "a movie or a stack: a folder stands for frames in files of their own; name the movie itself, or a pattern"
_ADVICE = (
    (
        (".mp4", ".avi", ".mov", ".mkv", ".wmv"),
        "a movie whose frames are compressed or demosaiced, so that its samples are no longer the sensor's: give the "
        "camera's own file, or export from it DNG or 16-bit TIFF, without demosaicing",
    ),
    (
        (".jpg", ".jpeg", ".gif", ".heic", ".webp"),
        "a picture that is no raw frame: let the camera record DNG or 16-bit TIFF, without demosaicing",
    ),
    (
        (".raw", ".bin"),
        "a file without a camera's header: state its `shape` and `dtype` (frames.shape and frames.dtype)",
    ),
)
"""By endings, what files are that are no frames, and what to do."""


def advice(path: Path) -> str:
    """Return what a file is that is no frame, and what to do; empty where that is not known."""
    ending = path.suffix.lower()
    if any(ending in frame_format.movies for frame_format in frame_formats()):
        return _MOVIE
    return next((text for endings, text in _ADVICE if ending in endings), "")


class _UnknownFile(FrameSource):
    """A file that no format recognises: reading it raises an error that lists the formats."""

    def _shape(self) -> NoReturn:
        if text := advice(self.path):
            raise FrameError(f"{self.path} is {text}")
        with self.path.open("rb"):  # one that cannot be opened is told as that
            allowed = ", ".join(frame_format.name for frame_format in frame_formats())
        raise FrameError(f"{self.path} is not a frame that rgbmidic reads; allowed are {allowed}")

    def _stored(self, index: int) -> NoReturn:
        self._shape()


def open_source(path: Path | str, user_metadata: FrameSettings, camera: CameraMetadata | None = None) -> FrameSource:
    """Return the file as a source of frames; a missing or damaged one is reported when it is read.

    Parameters
    ----------
    path
        Frame file.
    user_metadata
        What the user states of it (`path` and `reference` are not used); it must agree with what the file states.
    camera
        What a calibration states of it; it must agree with both, and fills in what neither states.

    Returns
    -------
    FrameSource
        Of the first of `FORMATS` that recognises the file.

    Examples
    --------
    >>> from rgbmidic.frames import list_frames
    >>> path = list_frames("frames")[0]
    >>> open_source(path, FrameSettings(path=str(path))).read(0).cfa
    'RGGB'
    """
    path = Path(path)
    source = next(
        (frame_format.source for frame_format in frame_formats() if frame_format.reads(path, user_metadata)),
        _UnknownFile,
    )
    return source(path=path, user_metadata=user_metadata, camera=camera)


class FrameMetadata(TypedDict, total=False):
    """Properties of a frame that the caller of `read_frame` states; None: as the file states."""

    kind: FrameKind | None
    cfa: str | None
    black_level: float | None
    white_level: float | None
    shape: tuple[int, int] | None
    dtype: Literal["uint8", "uint16", ">u2"] | None


@checked
def read_frame(path: Path | str, **metadata: Unpack[FrameMetadata]) -> Mosaic | ChannelFrame:
    """Read one raw frame.

    Camera raw files (LibRaw) state everything. TIFF and PNG state size and number of channels; headerless ``.raw`` and
    ``.bin`` files state nothing. The statements of the caller and of the file must agree.

    Parameters
    ----------
    path
        Frame file.
    **metadata
        Properties of the frame. ``kind``: None means as the file states (three channels: ``"rgb"``), else ``"bayer"``.
        ``cfa``: Bayer pattern of the first visible pixels; needed for a mosaic whose file does not state it.
        ``black_level``, ``white_level``: grey levels (DN); if they are not stated, 0 and the largest value of the
        sample type. ``shape``, ``dtype``: rows and columns, and sample type (``"uint8"``, ``"uint16"`` little-endian,
        ``">u2"`` big-endian) of headerless files.

    Returns
    -------
    Mosaic or ChannelFrame
        A mosaic for ``"bayer"``; (1, H, W) for ``"monochrome"``; (3, H, W) for ``"rgb"``.

    Raises
    ------
    FrameError
        The file is missing, damaged, truncated, already demosaiced, or contradicts a statement (both are named).
    InputError
        A stated property is not allowed.

    Examples
    --------
    >>> import numpy as np
    >>> from rgbmidic import read_frame
    >>> from rgbmidic.frames import Mosaic, write_tiff
    >>> values = np.full((4, 6), 100, dtype=np.uint16)
    >>> write_tiff("frame.tif", Mosaic(values=values, cfa="RGGB", black_level=np.array(16.0), white_level=1023.0))
    >>> frame = read_frame("frame.tif", cfa="RGGB", black_level=16, white_level=1023)
    >>> frame.values.shape, frame.cfa, frame.white_level
    ((4, 6), 'RGGB', 1023.0)
    >>> Path("frame.tif").unlink()
    """
    if unknown := metadata.keys() - FrameMetadata.__annotations__:
        raise TypeError(f"read_frame takes {', '.join(FrameMetadata.__annotations__)}, not {', '.join(unknown)}")
    try:
        settings = FrameSettings(path=(str(path),), **metadata)
    except ConfigurationError as error:
        raise InputError(str(error).replace("frames.", "")) from None
    return open_source(path, settings).read(0)
