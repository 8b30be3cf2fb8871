"""Physical units of what a result states: millimetres through the image scale, seconds through the frames' times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.settings import ScaleSettings
from rgbmidic.typing import FloatArray

__all__ = ["Units", "column"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Units:
    """In what a result is told; the store keeps px and frames.

    Attributes
    ----------
    mm_per_pixel
        Millimetres on the specimen for a pixel; None where not known: lengths are told in px.
    mm_per_pixel_std
        Its standard uncertainty. It is a part of that of every length in mm, and the same factor in all of them.
    timed
        Whether the frames' times are known; else a frame is the unit of time.
    """

    mm_per_pixel: float | None = None
    mm_per_pixel_std: float = 0.0
    timed: bool = False

    @classmethod
    def of(cls, scale: ScaleSettings, *, timed: bool) -> Self:
        """As ``[scale]`` states them."""
        return cls(mm_per_pixel=scale.mm_per_pixel, mm_per_pixel_std=scale.mm_per_pixel_std, timed=timed)

    @classmethod
    def from_points(
        cls, points: Sequence[Sequence[float]], length: float, *, length_std: float = 0.0, point_std: float = 0.5
    ) -> Self:
        """The scale from two points (x, y) in px on an image and their distance in mm.

        Along either axis a point is as uncertain as `point_std`: half a pixel where it is read off an image by eye.

        Raises
        ------
        InputError
            The points are not two different ones, the length is not positive, or an uncertainty is negative.
        """
        ends = np.asarray(points, dtype=np.float64)
        distance = float(np.hypot(*(ends[1] - ends[0]))) if ends.shape == (2, 2) else 0.0
        if not (math.isfinite(distance) and distance > 0):
            raise InputError(f"a scale needs two different points (x, y) in px, not {np.asarray(points).tolist()}")
        if not (math.isfinite(length) and length > 0):
            raise InputError(f"the length between the points must be above 0 mm, not {length:g}")
        if not (length_std >= 0 and point_std >= 0):
            raise InputError(f"uncertainties must be at least 0, not {length_std:g} mm and {point_std:g} px")
        scale = length / distance
        relative = math.hypot(length_std / length, math.sqrt(2) * point_std / distance)
        return cls(mm_per_pixel=scale, mm_per_pixel_std=scale * relative)

    @property
    def length(self) -> str:
        """``"mm"`` or ``"px"``."""
        return "px" if self.mm_per_pixel is None else "mm"

    @property
    def time(self) -> str:
        """``"s"`` or ``"frame"``."""
        return "s" if self.timed else "frame"

    def per_time(self, unit: str, power: int = 1) -> str:
        """A unit by the time or its square, such as ``"mm/s"``, ``"mm/s²"`` or, of no unit, ``"1/s"``."""
        return f"{unit or '1'}/{self.time}" + ("²" if power == 2 else "")

    def lengths(self, values: FloatArray, std: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Lengths and their standard uncertainty in px, or by time, in mm where the scale is known."""
        if self.mm_per_pixel is None:
            return values, std
        return self.mm_per_pixel * values, np.hypot(self.mm_per_pixel * std, self.mm_per_pixel_std * values)


def column(name: str, unit: str) -> str:
    """Name of a column with its unit in plain letters: `u` in ``"mm/s²"`` is ``"u_mm_per_s2"``."""
    plain = unit.replace("²", "2")
    over, _, below = plain.partition("/")
    words = [part for part in ("" if over == "1" else over, f"per_{below}" if below else "") if part]
    return "_".join([name, *words])
