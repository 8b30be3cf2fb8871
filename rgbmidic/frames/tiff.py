"""TIFF files: grey or RGB, 8 or 16 bit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.opencv import decode
from rgbmidic.frames.source import FrameSource
from rgbmidic.frames.stored import StoredFrame, damaged
from rgbmidic.frames.tiff_pages import cfa_pattern, is_stored_as_is, tag, tiff_pages
from rgbmidic.typing import AnyArray

if TYPE_CHECKING:
    from tifffile import TiffPage

__all__ = ["TiffFile"]

_MIN_IS_WHITE, _PALETTE = 0, 3
_COLOUR_MAP, _ORIENTATION = 320, 274


@dataclass(frozen=True, slots=True, kw_only=True)
class TiffFile(FrameSource):
    """A TIFF file of one image with 1 or 3 channels; a table of colours is refused."""

    def _shape(self) -> tuple[int, int]:
        with tiff_pages(self.path) as pages:
            page = _single_page(pages, self.path)
            return int(page.imagelength), int(page.imagewidth)

    def _stored(self, index: int) -> StoredFrame:
        with tiff_pages(self.path) as pages:
            page = _single_page(pages, self.path)
            values = _decode_page(page, self.path)
            if page.photometric == _PALETTE:
                _check_grey_table(page, values.dtype, self.path)
            elif page.photometric == _MIN_IS_WHITE:
                values = np.iinfo(values.dtype).max - values
            return StoredFrame.plain(values, self.path, cfa_pattern(page))


def _single_page(pages: list[TiffPage] | None, path: Path) -> TiffPage:
    if pages is None:
        raise damaged(path, "it is not a TIFF file")
    if not pages:
        raise damaged(path, "its header leads to no image")
    if len(pages) > 1:
        raise FrameError(f"{path} holds {len(pages)} frames; allowed is one frame per TIFF file")
    page = pages[0]
    if page.dtype is None or page.dtype.name not in ("uint8", "uint16"):
        kind = page.dtype or f"{page.bitspersample}-bit"
        raise FrameError(f"{path} has {kind} samples; allowed are unsigned 8 or 16 bit")
    if page.compression == 1 and not is_stored_as_is(page):
        raise damaged(
            path, f"its header announces {sum(page.databytecounts)} bytes of image data, too few for its size"
        )
    return page


def _decode_page(page: TiffPage, path: Path) -> AnyArray:
    """Samples of a page, (H, W) or (H, W, C); by OpenCV where tifffile lacks the decompressor (LZW, JPEG)."""
    try:
        values = np.asarray(page.asarray())
    except Exception as error:  # tifffile meets damaged data with many kinds of error
        decoded = decode(path) if (tag(page, _ORIENTATION) or (1,)) == (1,) else None
        if decoded is None or decoded.dtype != page.dtype:
            raise damaged(path, error) from None
        return decoded
    if values.ndim == 3 and page.planarconfig == 2:  # one plane after the other
        values = np.moveaxis(values, 0, -1)
    return values


def _check_grey_table(page: TiffPage, dtype: np.dtype[Any], path: Path) -> None:
    """Some cameras' software writes grey images with a colour table that changes nothing; others are refused."""
    table = np.asarray(page.tags[_COLOUR_MAP].value, dtype=np.int64).reshape(3, -1)
    ramp = np.arange(table.shape[1])
    # entries run to 65535: of 257 i and 256 i both are in use
    if dtype != np.uint8 or not (table // 256 == ramp).all():
        raise FrameError(f"{path} shows its grey levels through a colour table; save it as a plain grey image")
