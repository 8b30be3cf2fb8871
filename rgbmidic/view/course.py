"""What became of each frame of a result that may still grow: its end, and how many nodes it measures."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import ResultError
from rgbmidic.results import Result
from rgbmidic.typing import FloatArray

__all__ = ["DAMAGED", "Course"]

_AT_ONCE = 200
"""Frames that are looked at before the page is served again: 20 to 50 ms."""
_NOT_YET = -1
DAMAGED = 3
"""Status of a frame whose record cannot be read."""


class Course:
    """The time line, which `advance` fills a part at a time, so that the page answers in between.

    Attributes
    ----------
    status : ndarray, shape (T,), int8
        End of each frame, or `DAMAGED`; -1 where it was not looked at, or is not measured yet.
    share : ndarray, shape (T,)
        Part of the nodes that it measures; NaN where not known.
    """

    def __init__(self, frames: int) -> None:
        self.status: npt.NDArray[np.int8] = np.full(frames, _NOT_YET, dtype=np.int8)
        self.share: FloatArray = np.full(frames, np.nan)

    def advance(self, result: Result) -> bool:
        """Look at some frames more; False where there is nothing new."""
        frames = np.flatnonzero(result.finished & (self.status == _NOT_YET))[:_AT_ONCE]
        for frame in frames.tolist():
            try:
                values = next(result.table.each(["status", "node_status"], [frame]))
            except ResultError:
                values = {"status": DAMAGED, "node_status": np.ones(1)}
            self.status[frame], self.share[frame] = values["status"], np.mean(values["node_status"] == 0)
        return len(frames) > 0

    def words(self) -> str:
        """How many frames ended how."""
        known = int((self.status != _NOT_YET).sum())
        counts = {
            word: int((self.status == code).sum())
            for code, word in ((1, "not converged"), (2, "failed"), (DAMAGED, "damaged"))
        }
        told = [f"{known} of {len(self.status)} frames measured"]
        return ", ".join(told + [f"{count} {word}" for word, count in counts.items() if count])
