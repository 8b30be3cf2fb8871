"""The part of a frame that an inspection looks at: the region and its surroundings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.mesh import Region

__all__ = ["Frame", "View"]

Frame = Mosaic | ChannelFrame

MARGIN = 96
"""Surroundings (px) of the region that are looked at with it: three standard deviations of the window over which the
model of the frame is averaged (`rgbmidic.lab.inspection.disturbances.SETTLED`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """The part of a frame that is looked at.

    Attributes
    ----------
    origin
        Its first column and row, both even, so that the pattern of a mosaic stays what it is.
    shape
        Its rows and columns.
    """

    origin: tuple[int, int]
    shape: tuple[int, int]

    @classmethod
    def around(cls, region: Region) -> View:
        """A region with its surroundings."""
        spans = [np.flatnonzero(region.mask.any(axis=axis)) for axis in (1, 0)]
        first = [max(int(span[0]) - MARGIN, 0) // 2 * 2 for span in spans]
        last = [min(int(span[-1]) + 1 + MARGIN, side) for span, side in zip(spans, region.mask.shape, strict=True)]
        return cls(origin=(first[1], first[0]), shape=(last[0] - first[0], last[1] - first[1]))

    def frame(self, frame: Frame) -> Frame:
        """The part of a frame."""
        return replace(frame, values=np.ascontiguousarray(frame.values[..., *self._slices]))

    def region(self, region: Region) -> Region:
        """The region in it."""
        return region.part(*self._slices)

    def crosstalk(self, crosstalk: Crosstalk) -> Crosstalk:
        """The crosstalk in it."""
        return crosstalk.cropped(self.origin, self.shape)

    @property
    def _slices(self) -> tuple[slice, slice]:
        (x, y), (rows, columns) = self.origin, self.shape
        return slice(y, y + rows), slice(x, x + columns)
