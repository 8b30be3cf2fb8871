"""Phantom movies (.cine): frames as the sensor gave them, each read by itself.

The format is Vision Research's ("The Cine File Format"). Samples come as 8 bit, as 8 to 16 bit in 16-bit containers, or
packed: 12 bit, or 10 bit in a code that is not linear.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import FrameError
from rgbmidic.frames.cine_header import CineHeader, read_header
from rgbmidic.frames.recording import Recording
from rgbmidic.frames.source import Movie, remembered
from rgbmidic.frames.stored import StoredFrame, damaged
from rgbmidic.typing import AnyArray

__all__ = ["CINE_ENDINGS", "CineFile"]

CINE_ENDINGS = (".cine", ".cin", ".cci")

_STEPS = (
    "311111111111101111111111111111011111111111111101111111111111110111111111111111101111111111111110111111111111"
    "111101111111111111110111111111111011111111111111111211111111121111112111121112111211121121121121121211212121"
    "121212121212122121221212212212212212221222122212222212222222122222222222222222222222322222223222223222322232"
    "223223223223223232322323232323232323323232332332332332333233323332333332333333332333333333333333333343333333"
    "343333433334333433433343343433434334343434343434343443434434434434434443444344443444444344444444444444444444"
    "444444544444544445444544454454454454454545445454545454554545455455455455455545554555545555554555555555555555"
    "555555555565555556555565556555655655655656556565656565656565656656656566566656665666566665666666665666666666"
    "666667666666667666676666766676676676676766767676767676767676776767767767776777677767777767777777777767777787"
    "777777777787777787777877787787787787787878778787878788787878878878878878887888878888878888888888888888888888"
    "888988888988889888988988988988989898898988"
)
_LINEAR = np.full(1024, 4095, dtype=np.uint16)
_LINEAR[: len(_STEPS) + 1] = np.cumsum([2, *map(int, _STEPS)])
"""Grey level (12 bit) of each code of packed 10 bit: appendix 1 of the format's description, as hypercine publishes it.

Stored as the steps from one code to the next; the codes above 1014, white, are saturated.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class CineFile(Movie):
    """A Phantom .cine file. Flips and rotation are settings of the camera's viewer and left to it."""

    def _recording(self) -> Recording:
        return _header(self.path).recording

    def _shape(self) -> tuple[int, int]:
        return _header(self.path).shape

    def _stored(self, index: int) -> StoredFrame:
        return self._rows(index, range(self._shape()[0]))

    def _rows(self, index: int, rows: range) -> StoredFrame:
        header = _header(self.path)
        height = header.shape[0]
        stored = range(height - rows.stop, height - rows.start) if header.bottom_up else rows
        values = _samples(header, *self._lines(header, index, stored))
        if header.coded:
            values = _LINEAR[values]
        return StoredFrame(
            values=values[::-1] if header.bottom_up else values,
            kind=header.kind,
            cfa=header.cfa,
            black_level=None if header.black_level is None else np.full((2, 2), float(header.black_level)),
            white_level=float(header.white_level),
        )

    def _lines(self, header: CineHeader, index: int, rows: range) -> tuple[npt.NDArray[np.uint8], range]:
        """The lines (n, bytes) that some rows of a frame are stored in, behind its annotation, and the rows in them."""
        start = int(header.pointers[index])
        with self.path.open("rb") as file:
            if start < header.first_byte or start + 8 > header.size:
                raise self._ends(header, index)
            file.seek(start)
            annotation = int.from_bytes(file.read(4), "little")
            if annotation < 8 or start + annotation > header.size:
                raise damaged(self.path, f"the annotation of frame {index} has {annotation} bytes")
            file.seek(start + annotation - 4)
            lines = header.lines(int.from_bytes(file.read(4), "little"))
            if lines is None:
                raise damaged(self.path, f"frame {index} has not the size that its header announces")
            if start + annotation + lines[0] * lines[1] > header.size:
                raise self._ends(header, index)
            if lines[0] == 1:  # all samples in a row
                return np.fromfile(file, dtype=np.uint8, count=lines[1]).reshape(lines), rows
            file.seek(rows.start * lines[1], 1)
            part = np.fromfile(file, dtype=np.uint8, count=len(rows) * lines[1])
            return part.reshape(len(rows), lines[1]), range(len(rows))

    def _ends(self, header: CineHeader, index: int) -> FrameError:
        last = min(header.last_whole, index - 1)
        place = f"after frame {last}" if last >= 0 else "before the first frame"
        return FrameError(
            f"{self.path} ends {place} of {len(self)} (0 to {len(self) - 1}): truncated or still being written"
        )


@remembered
def _header(path: Path) -> CineHeader:
    header = read_header(path)
    if not header.coded or header.white_level >= len(_LINEAR):
        return header
    # levels of 10 bit are codes as the samples are
    black = None if header.black_level is None else int(_LINEAR[header.black_level])
    return replace(header, black_level=black, white_level=int(_LINEAR[header.white_level]))


def _samples(header: CineHeader, lines: npt.NDArray[np.uint8], rows: range) -> AnyArray:
    """Samples (n, W), uint8 or uint16, of some of the rows in the lines that they are stored in."""
    columns = header.shape[1]
    if header.bits in (8, 16):
        samples: AnyArray = lines.view("u1" if header.bits == 8 else "<u2")
    else:
        samples = _unpack(lines, header.bits)
    if len(lines) == 1 and header.shape[0] > 1:
        return samples[0, rows.start * columns : rows.stop * columns].reshape(len(rows), columns)
    return samples[:, :columns]


def _unpack(lines: npt.NDArray[np.uint8], bits: int) -> npt.NDArray[np.uint16]:
    """Samples of 10 or 12 bit that follow one another without gaps, the first in the highest bits; lines start anew."""
    size = bits // 2
    padded = np.pad(lines, ((0, 0), (0, -lines.shape[1] % size)))
    groups = padded.reshape(len(lines), -1, size).astype(np.uint16)
    samples = np.empty((*groups.shape[:2], 8 * size // bits), dtype=np.uint16)
    for place in range(samples.shape[2]):
        byte, bit = divmod(place * bits, 8)
        samples[..., place] = (groups[..., byte] << 8 | groups[..., byte + 1]) >> (16 - bit - bits) & (2**bits - 1)
    return samples.reshape(len(lines), -1)
