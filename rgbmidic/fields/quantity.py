"""A quantity of a result: what its name stands for, its axes and how it is written; and the units it is read in."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, Literal, Self

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.field import Field
from rgbmidic.renamed import state_new_names
from rgbmidic.text import format_value, format_with_std
from rgbmidic.typing import FloatArray

Kind = Literal["displacement", "strain", "positive", "fraction", "angle", "codes"]
ESTIMATED = ("estimated node",)
"""Axes of a quantity that only frames have of which it was requested."""


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


@state_new_names
@dataclass(frozen=True, slots=True)
class ResultQuantity:
    """An entry of the table: what a name stands for, of every frame or of all together, kept or derived.

    Attributes
    ----------
    name
        Name in records, files, exports and maps. A fraction in a map is named by its light; a standard uncertainty
        ends in ``_std``.
    axes
        Axes in one frame: ``"node"`` and ``"light"`` have the result's sizes, a number is a size itself, and any other
        word is open: its size may differ from frame to frame. Without axes it is a plain number or text.
    unit
        Empty where there is none; ``"px"`` becomes the reader's unit of lengths (`with_units`).
    source
        Attribute of the object that it comes from, a `Solution` or a `Strain`, a column of it behind a dot; empty where
        the main job provides it. That of its standard uncertainty has ``_std`` behind the first word.
    description
        Its description in docs/reference/conventions.md.
    dtype
        Type of the array, in memory and on disk: what is known to no more than some digits has single precision.
    blank
        What a frame holds that could not be measured at all.
    codes
        What each integer means, for a status.
    symbol
        How formulas and pictures write it; empty for what maps do not show.
    base_quantities, order
        Quantities from which it follows: their length where there are two, their derivative by time of an order, a
        strain or a discretisation error.
    group
        Heading under which maps list it.
    kind
        Kind of the values, which sets colours and format.

    Examples
    --------
    >>> from rgbmidic.results import QUANTITIES
    >>> QUANTITIES["u_std"].unit, QUANTITIES["status"].codes
    ('px', ('converged', 'not converged', 'failed'))
    """

    name: str
    axes: tuple[str | int, ...]
    unit: str
    source: str
    description: str
    _: KW_ONLY
    dtype: type[np.generic] = np.float32
    blank: float | int | str = float("nan")
    codes: tuple[str, ...] = ()
    symbol: str = ""
    base_quantities: tuple[str, ...] = ()
    order: int = 0
    group: str = "Quality"
    kind: Kind = "strain"

    @property
    def file_name(self) -> str:
        """Name of its array in records and npz files: the small strain of the nodes has no prefix there."""
        return self.name.removeprefix("nodal_")

    @property
    def uncertainty(self) -> ResultQuantity:
        """Its standard uncertainty."""
        return replace(
            self,
            name=f"{self.name}_std",
            source=re.sub(r"^[a-z]+", r"\g<0>_std", self.source),
            description=f"standard uncertainty of {self.name}",
            dtype=np.float32,
            symbol=self.symbol and f"σ({self.symbol})",
            group="Uncertainty",
            kind="positive",
        )

    def with_units(self, units: Units) -> ResultQuantity:
        """Return it with the reader's units of length and time.

        Parameters
        ----------
        units
            Units of the reader.

        Returns
        -------
        ResultQuantity
        """
        unit = units.length if self.unit == "px" else self.unit
        return replace(self, unit=units.per_time(unit, self.order) if self.order else unit)

    @property
    def label(self) -> str:
        """Symbol and unit, the title of its pictures and axes."""
        return f"{self.symbol} ({self.unit})" if self.unit else self.symbol

    @property
    def is_signed(self) -> bool:
        """True if colours symmetric about 0 make sense."""
        return self.kind in ("displacement", "strain")

    @property
    def is_logarithmic(self) -> bool:
        """True if colours spread by ratio: for uncertainties, and for what is compared with 1."""
        return self.kind == "positive" and self.group in ("Quality", "Uncertainty")

    @property
    def stepped(self) -> bool:
        """True if values between those of two nodes mean nothing."""
        return self.kind in ("angle", "codes")

    @property
    def fixed_range(self) -> tuple[float, float] | None:
        """Values of the first and last colour, where the kind of quantity sets them."""
        fixed = {"codes": (-0.5, len(self.codes) - 0.5), "fraction": (0.0, 1.0), "angle": (-90.0, 90.0)}
        return fixed.get(self.kind)

    def format(self, value: float, std: float = float("nan")) -> str:
        """Return a value with its standard uncertainty and unit as text.

        Parameters
        ----------
        value
            The value in the quantity's unit.
        std
            Its standard uncertainty; NaN where not known.

        Returns
        -------
        str
        """
        if not np.isfinite(value):
            return "not measured"
        if self.codes:
            return self.codes[int(value)]
        if self.group == "Uncertainty":
            return f"{format_value(value, value)} {self.unit}".rstrip()
        return format_with_std(value, std, self.unit)

    def shape(self, sizes: Mapping[str, int]) -> tuple[int | None, ...]:
        """Return the shape in one frame for these sizes of ``"node"`` and ``"light"``; None for an open axis.

        Parameters
        ----------
        sizes
            Numbers of ``"node"`` and ``"light"``.

        Returns
        -------
        tuple of int or None
        """
        return tuple(axis if isinstance(axis, int) else sizes.get(axis) for axis in self.axes)

    @property
    def is_stackable(self) -> bool:
        """True if all frames make one array: no axis is open, and it is no text."""
        return None not in self.shape({"node": 0, "light": 0}) and self.dtype is not np.str_

    @property
    def is_estimated(self) -> bool:
        """True for a quantity of the nodes that only frames have of which it was requested."""
        return self.axes == ESTIMATED

    @property
    def attributes(self) -> dict[str, Any]:
        """Description by the CF conventions: units ("1" where there is none), long_name, and what a status means."""
        attributes: dict[str, Any] = {"units": self.unit or "1", "long_name": self.description}
        if self.codes:
            attributes["flag_values"] = np.arange(len(self.codes), dtype=self.dtype)
            attributes["flag_meanings"] = " ".join(code.replace(" ", "_") for code in self.codes)
        return attributes

    def convert(self, value: Any, sizes: Mapping[str, int]) -> Any:
        """Return `value` in the type of the table.

        Parameters
        ----------
        value
            The quantity in one frame.
        sizes
            Numbers of ``"node"`` and ``"light"``.

        Returns
        -------
        ndarray, or a plain number or text

        Raises
        ------
        InputError
            It has another shape.
        """
        array, shape = np.asarray(value, dtype=self.dtype), self.shape(sizes)
        if array.ndim != len(shape) or any(
            expected not in (None, length) for expected, length in zip(shape, array.shape, strict=True)
        ):
            raise InputError(f"{self.name} of a result has the shape {shape} (None: any), not {array.shape}")
        return array if self.axes else array.item()

    def unmeasured(self, sizes: Mapping[str, int]) -> Any:
        """Return the value of a frame that could not be measured; open axes have the length 0.

        Parameters
        ----------
        sizes
            Numbers of ``"node"`` and ``"light"``.

        Returns
        -------
        ndarray, or a plain number or text
        """
        return np.full([size or 0 for size in self.shape(sizes)], self.blank, dtype=self.dtype)

    def read_from(self, source: object) -> Any:
        """Take the quantity from an object with the attribute that `source` names.

        Parameters
        ----------
        source
            Object with the attribute.

        Returns
        -------
        Any
        """
        attribute, _, column = self.source.partition(".")
        value = getattr(source, attribute)
        return value[:, int(column)] if column else value


def with_uncertainty(*quantities: ResultQuantity) -> tuple[ResultQuantity, ...]:
    """Return quantities, then the standard uncertainty of each."""
    return *quantities, *(quantity.uncertainty for quantity in quantities)
