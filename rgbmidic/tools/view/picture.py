"""Images under the fields: raw frames and the reference, as grey pictures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.series import FrameSeries, open_series
from rgbmidic.results import Result
from rgbmidic.settings import TestSettings
from rgbmidic.tools.report.painter import Picture
from rgbmidic.typing import AnyArray


def grey_picture(frame: Mosaic | ChannelFrame) -> Picture:
    """Return a raw frame as one stretched picture: the mean of its channels, or of the cell around each sample."""
    if isinstance(frame, Mosaic):
        return stretch_to_uint8(cv2.blur(frame.values.astype(np.float32), (2, 2)))
    return stretch_to_uint8(frame.values.mean(axis=0, dtype=np.float32))


@dataclass(frozen=True, kw_only=True, eq=False)
class RawPictures:
    """Pictures of the raw frames of a result, read where they still exist; picklable until the first is read.

    Attributes
    ----------
    result
        The result.
    """

    result: Result

    @cached_property
    def _series(self) -> FrameSeries:
        provenance = self.result.provenance
        if "settings" not in provenance:
            raise FrameError(
                f"{self.result.path} does not state where its raw frames are: it was not measured from files"
            )
        settings = TestSettings.from_mapping(provenance["settings"], provenance["base"])
        return open_series(settings.frames, settings.base)

    def __call__(self, index: int) -> Picture:
        """Read the frame of an index in the result; errors as those of the frames' reader."""
        return grey_picture(self._series.read(self._series.selected[index])[0])


def stretch_to_uint8(image: AnyArray) -> Picture:
    """Stretch an image (H, W) between its 1 % and 99 % quantiles, of every fourth pixel, to 0 to 255; NaN is 0."""
    finite = image[::4, ::4][np.isfinite(image[::4, ::4])]
    low, high = np.percentile(finite, [1, 99]) if finite.size else (0.0, 1.0)
    return np.asarray(np.clip(255 * (np.nan_to_num(image) - low) / max(high - low, 1e-6), 0, 255), dtype=np.uint8)
