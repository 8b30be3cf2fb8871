"""Units that a result is read in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.field import Field
from rgbmidic.typing import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Units:
    """Units that a result is stated in; the store keeps px and frames.

    Attributes
    ----------
    mm_per_pixel
        Millimetres on the specimen for a pixel; None where not known: lengths are stated in px.
    mm_per_pixel_std
        Its standard uncertainty. It contributes to that of every length in mm, as the same factor in all of them.
    timed
        Whether the frames' times are known; else a frame is the unit of time.

    Examples
    --------
    >>> units = Units(mm_per_pixel=0.05, timed=True)
    >>> units.length, units.time
    ('mm', 's')
    """

    mm_per_pixel: float | None = None
    mm_per_pixel_std: float = 0.0
    timed: bool = False

    @classmethod
    def from_points(
        cls,
        points: Sequence[Sequence[float]] | FloatArray,
        length: float,
        *,
        length_std: float = 0.0,
        point_std: float = 0.5,
        factor: FloatArray | None = None,
    ) -> Self:
        """Find the scale from two points on an image and their distance.

        Parameters
        ----------
        points : shape (2, 2)
            Both points (x, y) in px.
        length
            Their distance in mm.
        length_std
            Its standard uncertainty in mm.
        point_std
            Standard uncertainty of a point along either axis in px: half a pixel where it is read off by eye.
        factor : ndarray, shape (2, 2, P), optional
            Errors of both points per unit of P independent errors that they have in common, px
            (`rgbmidic.illumination.calibration.TargetLights.on_first_light`).

        Returns
        -------
        Units

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
        along = (ends[1] - ends[0]) / distance
        common = 0.0 if factor is None else float(np.linalg.norm(along @ (factor[1] - factor[0])))
        relative = math.hypot(length_std / length, math.sqrt(2) * point_std / distance, common / distance)
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
        """Write a unit over the time or its square, such as ``"mm/s"``, ``"mm/s²"`` or, of no unit, ``"1/s"``.

        Parameters
        ----------
        unit
            What is divided; empty for a quantity without unit.
        power
            Power of the time.

        Returns
        -------
        str
        """
        return f"{unit or '1'}/{self.time}" + ("²" if power == 2 else "")

    def convert(self, field: Field) -> Field:
        """Convert lengths in px, and their standard uncertainty, to mm where the scale is known.

        Parameters
        ----------
        field
            Of any unit.

        Returns
        -------
        Field
            In mm, or as it was where its unit is not px or the scale is not known.
        """
        if field.unit != "px" or self.mm_per_pixel is None:
            return field
        scale, values = self.mm_per_pixel, field.values
        scaled = replace(field.with_arrays(lambda array: scale * array), unit="mm")
        if scaled.std is None:
            return scaled
        return replace(scaled, std=np.hypot(scaled.std, self.mm_per_pixel_std * values))
