"""Small raw frames for tests of reading and writing."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tifffile
from hypothesis import strategies as st

from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.images import _dng_tags, write_dng
from rgbmidic.settings import BAYER_PATTERNS

_ACTIVE_AREA = 50829


def noisy_mosaic(shape: tuple[int, int] = (40, 50), *, seed: int = 0, cfa: str = "RGGB", black: Any = 64) -> Mosaic:
    """A 12-bit mosaic of random grey levels."""
    values = np.random.default_rng(seed).integers(70, 4000, shape).astype(np.uint16)
    return Mosaic(values=values, cfa=cfa, black_level=black, white_level=4095)


@st.composite
def mosaics(draw: st.DrawFn) -> Mosaic:
    """Mosaics of any phase, odd and even sizes, any whole-numbered levels."""
    shape = draw(st.tuples(st.integers(22, 60), st.integers(22, 60)))
    black = draw(st.lists(st.integers(0, 4000), min_size=4, max_size=4))
    white = draw(st.integers(max(black) + 1, 65535))
    values = np.random.default_rng(draw(st.integers(0, 2**32 - 1))).integers(1, 65536, shape)
    return Mosaic(
        values=values.astype(np.uint16),
        cfa=draw(st.sampled_from(BAYER_PATTERNS)),
        black_level=np.reshape(black, (2, 2)).astype(np.float64),
        white_level=white,
    )


@st.composite
def channel_frames(draw: st.DrawFn) -> ChannelFrame:
    """Monochrome and three-channel frames of any size."""
    shape = (draw(st.sampled_from([1, 3])), draw(st.integers(1, 40)), draw(st.integers(1, 40)))
    values = np.random.default_rng(draw(st.integers(0, 2**32 - 1))).integers(0, 65536, shape)
    return ChannelFrame(values=values.astype(np.uint16), black_level=np.zeros(shape[0]), white_level=65535)


def colour_mosaic(shape: tuple[int, int], cfa: str) -> npt.NDArray[np.uint16]:
    """Grey levels that say the colour and the position in the cell: 1000 (channel + 1) + 2 (row % 2) + column % 2."""
    rows, columns = np.indices(shape) % 2
    channels = np.array(["RGB".index(letter) for letter in cfa]).reshape(2, 2)[rows, columns]
    return (1000 * (channels + 1) + 2 * rows + columns).astype(np.uint16)


def write_cropped_dng(
    path: Path, active: npt.NDArray[np.uint16], *, top: int, left: int, cfa: str, black: Any, extra: Any = ()
) -> None:
    """A DNG whose `active` area, with the pattern `cfa`, lies inside masked margins; `extra` tags replace others."""
    rows, columns = active.shape
    full = np.full((rows + top + 2, columns + left + 3), 50, dtype=np.uint16)
    full[top : top + rows, left : left + columns] = active
    mosaic = Mosaic(values=full, cfa=cfa, black_level=black, white_level=4095)
    area = (_ACTIVE_AREA, "I", 4, (top, left, top + rows, left + columns), True)
    tags = [
        *(one for one in _dng_tags(mosaic, (1, 1, 1), path) if one[0] not in {new[0] for new in extra}),
        area,
        *extra,
    ]
    tifffile.imwrite(path, full, photometric=32803, extratags=tags, metadata=None, rowsperstrip=len(full))


def write_monochrome_dng(path: Path, values: npt.NDArray[np.uint16], *, linear_rgb: bool = False) -> None:
    """A linear raw DNG: one channel as monochrome cameras give, or three as a demosaiced picture."""
    tags = [
        (50706, "B", 4, b"\x01\x04\x00\x00", True),
        (50708, "s", 0, "test", True),
        (50714, "I", 3 if linear_rgb else 1, (64,) * 3 if linear_rgb else 64, True),
        (50717, "I", 3 if linear_rgb else 1, (4095,) * 3 if linear_rgb else 4095, True),
    ]
    if linear_rgb:
        values = np.repeat(values[..., None], 3, axis=2)
        tifffile.imwrite(path, values, photometric=34892, planarconfig="contig", extratags=tags, metadata=None)
        return
    tifffile.imwrite(path, values, photometric="minisblack", extratags=tags, metadata=None)
    with tifffile.TiffFile(path, mode="r+") as tiff:  # tifffile writes a linear raw of one channel only in this way
        tiff.pages.first.tags[262].overwrite(34892)


def write_lossless_dng(path: Path, mosaic: Mosaic) -> None:
    """A DNG whose samples are one lossless JPEG (ITU-T T.81, annex H), as cameras and Adobe's converter write."""
    write_dng(path, mosaic)
    jpeg = _lossless_jpeg(mosaic.values)
    with tifffile.TiffFile(path, mode="r+") as tiff:
        page = tiff.pages.first
        page.tags["Compression"].overwrite(7)
        page.tags["StripByteCounts"].overwrite(len(jpeg))
        tiff.filehandle.seek(page.dataoffsets[0])  # the last thing in the file
        tiff.filehandle.write(jpeg)
        os.truncate(path, page.dataoffsets[0] + len(jpeg))


def _lossless_jpeg(values: npt.NDArray[np.uint16]) -> bytes:
    """One component of 16 bit, predicted from the sample before; every category has a code of 5 bit, its number."""
    rows, columns = values.shape
    frame = b"\x00\x0b\x10" + rows.to_bytes(2) + columns.to_bytes(2) + b"\x01\x01\x11\x00"
    codes = b"\x00\x24\x00" + bytes([0, 0, 0, 0, 17]) + bytes(11) + bytes(range(17))
    samples = values.astype(int)
    first = np.concatenate([[1 << 15], samples[:-1, 0]])[:, None]
    steps = ((np.diff(samples, prepend=first, axis=1) + (1 << 15)) % (1 << 16) - (1 << 15)).ravel().tolist()
    bits = "".join(f"{(size := abs(one).bit_length()):05b}{_additional(one, size)}" for one in steps)
    bits += "1" * (-len(bits) % 8)
    data = int(bits, 2).to_bytes(len(bits) // 8).replace(b"\xff", b"\xff\x00")
    return (
        b"\xff\xd8\xff\xc3"
        + frame
        + b"\xff\xc4"
        + codes
        + b"\xff\xda\x00\x08\x01\x01\x00\x01\x00\x00"
        + data
        + b"\xff\xd9"
    )


def _additional(step: int, size: int) -> str:
    return f"{step if step > 0 else step + (1 << size) - 1:0{size}b}" if 0 < size < 16 else ""
