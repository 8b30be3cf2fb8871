"""The nodal fields of a result that can be looked at: what the field table holds, and what follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Self

import numpy as np

from rgbmidic.report.style import colour_range
from rgbmidic.results import QUANTITIES, Result, scale_of
from rgbmidic.results.physical import Physical
from rgbmidic.typing import FloatArray

__all__ = ["Field", "Fields", "Values", "robust_range"]

Kind = Literal["displacement", "strain", "positive", "share", "angle", "codes"]

_DOUBTFUL = 3.0
"""Nodes whose uncertainty is over this many times the median do not rule the colours, as in the report."""
_MOVED = ("u", "v", "u_std", "v_std")
_SPREAD = 24
"""Frames, evenly spread, whose values rule the colours of a whole test."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """A nodal field that can be shown.

    Attributes
    ----------
    name
        As in the field table; a share is named by its light.
    unit, meaning
        As in the field table, lengths in the unit of the reader.
    kind
        What colours suit it, and how its values are written.
    codes
        What each number means, for a status.
    """

    name: str
    unit: str
    meaning: str
    kind: Kind
    codes: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Name and unit."""
        return f"{self.name} ({self.unit})" if self.unit else self.name

    @property
    def signed(self) -> bool:
        """Whether colours symmetric about 0 make sense."""
        return self.kind in ("displacement", "strain")

    @property
    def stepped(self) -> bool:
        """Whether values between those of two nodes mean nothing."""
        return self.kind in ("angle", "codes")

    @property
    def ends(self) -> tuple[float, float] | None:
        """Values of the first and last colour, where the kind of field says them."""
        fixed = {"codes": (-0.5, len(self.codes) - 0.5), "share": (0.0, 1.0), "angle": (-90.0, 90.0)}
        return fixed.get(self.kind)

    def text(self, value: float, std: float = float("nan")) -> str:
        """A value with its standard uncertainty in words."""
        if not np.isfinite(value):
            return "not measured"
        if self.codes:
            return self.codes[int(value)]
        unit = f" {self.unit}" if self.unit else ""
        return f"{value:.5g}{unit}" if not np.isfinite(std) else f"{value:.5g} ± {std:.2g}{unit}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Values:
    """A field in one frame.

    Attributes
    ----------
    values, std : ndarray, shape (N,)
        In the unit of the field; NaN where not known.
    moved : ndarray, shape (N, 2)
        Where the nodes are in this frame, px; NaN where not measured.
    """

    values: FloatArray
    std: FloatArray
    moved: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Fields:
    """The fields of a result.

    Attributes
    ----------
    result
        The result.
    physical
        It in the units of its ``[scale]``.
    """

    result: Result
    physical: Physical

    @classmethod
    def of(cls, result: Result) -> Self:
        """The fields of a result."""
        return cls(result=result, physical=Physical.untimed(result, scale_of(result)))

    @cached_property
    def all(self) -> dict[str, Field]:
        """Every field by its name, displacements first."""
        told = self.physical.quantities
        length = self.physical.units.length
        fields = [Field(name="magnitude", unit=length, meaning="length of the displacement", kind="positive")]
        for name, entry in told.items():
            if entry.axes == ("node",):
                meaning = ", ".join(entry.codes) or entry.meaning
                kind = self._kind(name)
                fields.append(Field(name=name, unit=entry.unit, meaning=meaning, kind=kind, codes=entry.codes))
        fields += [
            Field(name=f"share of {light}", unit="", meaning=told["light_share"].meaning, kind="share")
            for light in self.result.lights
        ]
        order = ("u", "v", "magnitude", "exx", "eyy", "exy", "e1", "e2", "direction", "equivalent")
        fields.sort(key=lambda field: order.index(field.name) if field.name in order else len(order))
        return {field.name: field for field in fields}

    def _kind(self, name: str) -> Kind:
        if name in ("u", "v"):
            return "displacement"
        if name == "node_status":
            return "codes"
        if name == "direction":
            return "angle"
        return "positive" if name.endswith("_std") or name in ("misfit", "equivalent") else "strain"

    def read(self, name: str, frame: int) -> Values:
        """A field in one frame; errors as `Result.frame`."""
        more = {"share": ("light_share", "node_status")}.get(self.all[name].kind, ())
        own = (name,) if name in QUANTITIES and name not in _MOVED and not self.physical.is_strain(name) else ()
        read = next(self.result.table.each([*_MOVED, *own, *more], [frame]))
        u, v, u_std, v_std = (np.asarray(read[part], dtype=np.float64) for part in _MOVED)
        moved = self.result.nodes + np.stack([u, v], axis=1)
        nothing = np.full(len(u), np.nan)
        if name == "magnitude":
            length, std = _length(u, v, u_std, v_std)
            values, std = self.physical.units.lengths(length, std)
        elif name in _MOVED:
            values, std = self.physical.units.lengths(*((u, u_std) if name.startswith("u") else (v, v_std)))
            values, std = (std, nothing) if name.endswith("_std") else (values, std)
        elif self.physical.is_strain(name):
            strain = self.physical.strain(u, v, u_std, v_std)
            values, std = strain[name], strain.get(f"{name}_std", nothing)
        elif more:
            light = self.result.lights.index(name.removeprefix("share of "))
            values, std = np.where(read["node_status"] == 0, read["light_share"][:, light], np.nan), nothing
        else:
            values, std = np.asarray(read[name], dtype=np.float64), nothing
        return Values(values=np.ascontiguousarray(values, dtype=np.float64), std=std, moved=moved)

    def range_of_test(self, name: str) -> tuple[float, float]:
        """Robust ends of the colours over the whole test, from frames evenly spread over what is measured."""
        there = np.flatnonzero(self.result.finished)
        chosen = there[np.unique(np.linspace(0, len(there) - 1, min(_SPREAD, len(there))).round().astype(int))]
        ends = [robust_range(self.read(name, int(frame))) for frame in chosen]
        known = [pair for pair in ends if pair is not None]
        return (min(a for a, _ in known), max(b for _, b in known)) if known else (0.0, 1.0)


def robust_range(read: Values) -> tuple[float, float] | None:
    """Ends of the colours of one frame, doubtful nodes and outliers left out; None where nothing is measured."""
    known = np.isfinite(read.values)
    if not known.any():
        return None
    spread = np.isfinite(read.std)
    doubtful = read.std > _DOUBTFUL * np.median(read.std[spread]) if spread.any() else ~known
    kept = known & ~doubtful
    return colour_range(read.values[kept if kept.any() else known])


def _length(u: FloatArray, v: FloatArray, u_std: FloatArray, v_std: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Length of a displacement and its uncertainty; at 0, where the first order says nothing, that of its parts."""
    length = np.hypot(u, v)
    with np.errstate(divide="ignore", invalid="ignore"):
        std = np.where(length > 0, np.hypot(u * u_std, v * v_std) / length, np.hypot(u_std, v_std))
    return length, std
