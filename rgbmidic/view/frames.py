"""The pictures that a field lies over: the reference that the result keeps, and the frames, where they still are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import RgbmidicError
from rgbmidic.frames.series import FrameSeries, open_series
from rgbmidic.results import Result
from rgbmidic.settings import TestSettings
from rgbmidic.view.picture import grey_picture

__all__ = ["Pictures"]

Picture = npt.NDArray[np.uint8]
_KEPT = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Pictures:
    """The pictures of a result.

    Attributes
    ----------
    result
        The result.
    """

    result: Result

    @cached_property
    def reference(self) -> Picture:
        """Mean of the lights' reference images, plain beside the part of the frames that was read; plain where none was
        kept."""
        kept, (left, top) = self.result.reference, self.result.reference_origin
        columns, rows = np.ceil(self.result.nodes.max(axis=0) + 1).astype(int)
        picture = np.full(self.result.frame_shape or (rows, columns), 60, dtype=np.uint8)
        if kept is not None:
            picture[top : top + kept.shape[1], left : left + kept.shape[2]] = kept.mean(axis=0)
        return picture

    def frame(self, place: int) -> tuple[Picture, str]:
        """The raw frame of a place in the result; the reference, and why, where it cannot be read."""
        try:
            return self._read(place), ""
        except (RgbmidicError, OSError, IndexError, KeyError) as error:
            return self.reference, f"the raw frame cannot be shown ({error}): this is the reference image"

    @cached_property
    def _read(self) -> Callable[[int], Picture]:
        return lru_cache(_KEPT)(lambda place: grey_picture(self._series.read(self._series.chosen[place])[0]))

    @cached_property
    def _series(self) -> FrameSeries:
        provenance = self.result.provenance
        settings = TestSettings.from_mapping(provenance["settings"], provenance["base"])
        return open_series(settings.frames, settings.base)
