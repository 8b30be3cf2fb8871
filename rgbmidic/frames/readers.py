"""One frame file in, one checked raw frame out: what the file tells and what the user states are brought together."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from rgbmidic.errors import FrameError, InputError
from rgbmidic.frames.camera_raw import camera_raw_shape, has_camera_header, read_camera_raw
from rgbmidic.frames.contents import FileContents, damaged
from rgbmidic.frames.data import BAYER_PATTERNS, ChannelFrame, Mosaic, cfa_channels
from rgbmidic.frames.pictures import png_shape, read_headerless, read_png, read_tiff, tiff_shape
from rgbmidic.frames.tiff_structure import is_dng
from rgbmidic.settings import FrameKind
from rgbmidic.typing import AnyArray, FloatArray

__all__ = ["FRAME_SUFFIXES", "frame_shape", "read_frame", "tells_camera"]

SampleType = Literal["uint8", "uint16", ">u2"]
_T = TypeVar("_T")

_TIFF, _PNG, _HEADERLESS = (".tif", ".tiff"), (".png",), (".raw", ".bin")
_CAMERA_RAW_NAMES = "3fr arw cr2 cr3 dcr dng erf fff iiq kdc mef mos mrw nef nrw orf pef raf rw2 rwl sr2 srf srw x3f"
_CAMERA_RAW = tuple(f".{name}" for name in _CAMERA_RAW_NAMES.split())
FRAME_SUFFIXES = (*_TIFF, *_PNG, *_HEADERLESS, *_CAMERA_RAW)
"""Endings (lower case) of the files that count as frames when a folder is listed."""

_BLACK_TOLERANCE = 1.0


def read_frame(
    path: Path | str,
    *,
    kind: FrameKind | None = None,
    cfa: str | None = None,
    black_level: float | None = None,
    white_level: float | None = None,
    shape: tuple[int, int] | None = None,
    dtype: SampleType | None = None,
) -> Mosaic | ChannelFrame:
    """Read one raw frame.

    Camera raws (LibRaw) tell everything themselves. TIFF and PNG tell size and number of channels; headerless ``.raw``
    and ``.bin`` files tell nothing. What is stated and also told by the file must agree.

    Parameters
    ----------
    path
        Frame file.
    kind
        None: what the file tells (three channels: ``"rgb"``), else ``"bayer"``.
    cfa
        Bayer pattern of the first visible pixels; needed for a mosaic whose file does not tell it.
    black_level, white_level
        Grey levels (DN); where neither stated nor told 0 and the largest value of the sample type.
    shape, dtype
        Rows and columns, and sample type (``"uint8"``, ``"uint16"`` little-endian, ``">u2"`` big-endian) of headerless
        files.

    Returns
    -------
    Mosaic or ChannelFrame
        A mosaic for ``"bayer"``; (1, H, W) for ``"monochrome"``; (3, H, W) for ``"rgb"``.

    Raises
    ------
    FrameError
        The file is missing, damaged, truncated, already demosaiced, or contradicts a statement (both are named).
    InputError
        `cfa` is not a Bayer pattern.
    """
    path = Path(path)
    if cfa is not None:
        cfa_channels(cfa)
    contents = _read(path, kind, shape, dtype)
    _check_layout(contents.values, shape, dtype, path)
    contents = _grey_saved_as_colour(contents, kind)
    kind = _agreed("kind", kind, contents.kind, path) or "bayer"
    white = _white_level(contents, white_level, path)
    black = _black_level(contents, black_level, path)
    try:
        return _frame(contents, kind, cfa and cfa.upper(), black, white, path)
    except InputError as error:
        raise FrameError(f"{path}: {error}") from None


def frame_shape(path: Path | str, shape: tuple[int, int] | None = None) -> tuple[int, int]:
    """Rows and columns of a frame file from its header alone; of a headerless file the stated `shape`."""
    path = Path(path)
    _check_exists(path)
    if _is_headerless(path, shape) and shape is not None:
        return shape
    return _from_disk({"tiff": tiff_shape, "png": png_shape, "camera raw": camera_raw_shape}[_format(path)], path)


def tells_camera(path: Path | str) -> bool:
    """Whether the file tells pattern and levels itself, as camera raws do; TIFF, PNG and headerless do not."""
    path = Path(path)
    return _format(path) == "camera raw" and _from_disk(has_camera_header, path)


def _read(path: Path, kind: FrameKind | None, shape: tuple[int, int] | None, dtype: SampleType | None) -> FileContents:
    _check_exists(path)
    if _is_headerless(path, shape):
        if shape is None or dtype is None:
            raise FrameError(f"{path} has no header: both its shape (rows, columns) and its dtype must be stated")
        return _from_disk(lambda path: read_headerless(path, shape, dtype, 3 if kind == "rgb" else 1), path)
    return _from_disk({"tiff": read_tiff, "png": read_png, "camera raw": read_camera_raw}[_format(path)], path)


def _format(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix in _PNG:
        return "png"
    return "tiff" if suffix in _TIFF and not is_dng(path) else "camera raw"


def _is_headerless(path: Path, shape: tuple[int, int] | None) -> bool:
    # cameras of several makers write .raw files with a header: those come without a stated shape
    return path.suffix.lower() == ".bin" or (path.suffix.lower() == ".raw" and shape is not None)


def _check_exists(path: Path) -> None:
    if not path.is_file():
        raise FrameError(f"not a file but a folder: {path}" if path.exists() else f"frame file not found: {path}")
    if path.stat().st_size == 0:
        raise damaged(path, "it is empty")


def _from_disk(read: Callable[[Path], _T], path: Path) -> _T:
    try:
        return read(path)
    except OSError as error:
        raise FrameError(f"{path} cannot be read: {error.strerror or error}") from None


def _check_layout(values: AnyArray, shape: tuple[int, int] | None, dtype: SampleType | None, path: Path) -> None:
    """Shape and sample type are for headerless files; stated for another file they must be true."""
    _agreed("shape", shape and tuple(shape), values.shape[:2], path)
    if _format(path) != "camera raw":
        _agreed("dtype", dtype and np.dtype(dtype).newbyteorder("=").name, values.dtype.name, path)


def _agreed(name: str, stated: _T | None, told: _T | None, path: Path) -> _T | None:
    if stated is not None and told is not None and stated != told:
        raise FrameError(f"{name} is stated as {stated}, but {path} says {told}")
    return told if stated is None else stated


def _grey_saved_as_colour(contents: FileContents, kind: FrameKind | None) -> FileContents:
    """One channel out of three identical ones, where the user states that the frame has only one."""
    first = contents.values[..., :1]
    if kind not in ("bayer", "monochrome") or contents.kind != "rgb" or not (contents.values == first).all():
        return contents
    return FileContents(values=first[..., 0])


def _white_level(contents: FileContents, stated: float | None, path: Path) -> float:
    white = _agreed("white_level", stated, contents.white_level, path)
    largest = float(np.iinfo(contents.values.dtype).max)
    if white is not None and white > largest:
        raise FrameError(f"white_level is stated as {white}, but the samples of {path} end at {largest:.0f}")
    return largest if white is None else white


def _black_level(contents: FileContents, stated: float | None, path: Path) -> FloatArray:
    told = contents.black_level
    if told is None:
        return np.full((1, 1), 0.0 if stated is None else stated)
    # the file's levels differ by position, and LibRaw rounds some: less than one grey level is no contradiction
    if stated is not None and not (np.abs(told - stated) < _BLACK_TOLERANCE).all():
        raise FrameError(f"black_level is stated as {stated}, but {path} says {told.ravel().tolist()}")
    return told


def _frame(
    contents: FileContents, kind: FrameKind, cfa: str | None, black: FloatArray, white: float, path: Path
) -> Mosaic | ChannelFrame:
    values = contents.values
    if kind == "bayer":
        cfa = _agreed("cfa", cfa, contents.cfa, path)
        if cfa is None:
            raise FrameError(
                f"{path} does not tell its colour filter array: state cfa ({', '.join(BAYER_PATTERNS)}), or kind "
                '"monochrome" where the camera has none'
            )
        return Mosaic(values=values, cfa=cfa, black_level=black, white_level=white)
    if cfa is not None:
        raise FrameError(f"cfa is stated as {cfa}, but {path} is read as {kind}, which has no colour filter array")
    if (kind == "rgb") != (values.ndim == 3):
        raise FrameError(
            f'kind is stated as "{kind}", but {path} has {"three channels" if values.ndim == 3 else "one"}'
        )
    channels = values[None] if values.ndim == 2 else np.moveaxis(values, -1, 0)
    return ChannelFrame(values=channels, black_level=black.mean(), white_level=white)
