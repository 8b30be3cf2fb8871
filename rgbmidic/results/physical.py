"""A result as an engineer reads it: millimetres and seconds where they are known, finite strain over a stated gauge.

What the files for other programs and the report hold is declared in the field table and here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from rgbmidic.fields import EQUIVALENT, MEASURES, NodalCovariance, Strain, StrainGauges, Units, strain_of_gradient
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.results.measures import frame_times, scale_of, units_of
from rgbmidic.results.quantities import QUANTITIES, Quantity
from rgbmidic.results.record import FrameRecord
from rgbmidic.results.result import Result
from rgbmidic.settings import ScaleSettings
from rgbmidic.typing import FloatArray

__all__ = ["Physical"]

_NODE, _ELEMENT = ("node",), ("element",)
_STRAIN = (
    Quantity("exx", _NODE, "", "components.0", "strain in x"),
    Quantity("eyy", _NODE, "", "components.1", "strain in y"),
    Quantity("exy", _NODE, "", "components.2", "strain, tensor shear"),
    Quantity("exx_std", _NODE, "", "components_std.0", "standard uncertainty of exx"),
    Quantity("eyy_std", _NODE, "", "components_std.1", "standard uncertainty of eyy"),
    Quantity("exy_std", _NODE, "", "components_std.2", "standard uncertainty of exy"),
    Quantity("e1", _NODE, "", "principal.0", "larger principal strain in the plane"),
    Quantity("e2", _NODE, "", "principal.1", "smaller principal strain in the plane"),
    Quantity("direction", _NODE, "deg", "direction_deg", "direction of e1, from x towards y"),
    Quantity("equivalent", _NODE, "", "equivalent", EQUIVALENT),
    Quantity("equivalent_std", _NODE, "", "equivalent_std", "standard uncertainty of equivalent"),
)
_ELEMENT_STRAIN = tuple(
    replace(entry, name=f"{entry.name}_element", axes=_ELEMENT, meaning=f"{entry.meaning}, constant in an element")
    for entry in _STRAIN[:3]
)
_REPLACED = ("time_ns", *(entry.name for entry in _STRAIN))
"""Quantities of the table in whose place others stand here: times in s, finite strain over a gauge."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Physical:
    """A result with its units.

    Attributes
    ----------
    result
        The result.
    scale
        Its ``[scale]``, or what stands in place of it.
    units
        Of lengths and times.
    times : ndarray, shape (T,)
        Of the frames: seconds where all are known and each is later than the one before, else places in the result.
    mesh
        In px.
    """

    result: Result
    scale: ScaleSettings
    units: Units
    times: FloatArray
    mesh: Tri3Mesh

    @classmethod
    def of(cls, result: Result, scale: ScaleSettings | None = None) -> Self:
        """With the scale and the times that the result knows, or with another ``[scale]`` in place of its own."""
        scale = scale_of(result) if scale is None else scale
        times, units = frame_times(result, scale), units_of(result, scale)
        mesh = Tri3Mesh(nodes=result.nodes, elements=result.elements)
        if times is None or not (np.diff(times) > 0).all():
            times, units = np.arange(len(result), dtype=np.float64), replace(units, timed=False)
        return cls(result=result, scale=scale, units=units, times=times, mesh=mesh)

    @classmethod
    def untimed(cls, result: Result, scale: ScaleSettings) -> Self:
        """Without the times, which take a look at every frame: for who reads single frames, or a result that grows."""
        mesh = Tri3Mesh(nodes=result.nodes, elements=result.elements)
        times = np.arange(len(result), dtype=np.float64)
        return cls(result=result, scale=scale, units=Units.of(scale, timed=False), times=times, mesh=mesh)

    @cached_property
    def gauges(self) -> StrainGauges:
        """Virtual strain gauges around the nodes, the shortest there are."""
        return StrainGauges.at_nodes(NodalCovariance.from_mesh(self.mesh))

    @property
    def measure(self) -> str:
        """Name of the strain measure."""
        return MEASURES[0]

    @property
    def measure_name(self) -> str:
        """It with capitals, as people write it."""
        return self.measure.title()

    def in_units(self, length: float) -> str:
        """A length, given in px, in words: in px, and in mm where the scale is known."""
        scale = self.units.mm_per_pixel
        return f"{length:.4g} px" + ("" if scale is None else f" ({length * scale:.3g} mm)")

    @cached_property
    def quantities(self) -> dict[str, Quantity]:
        """What `frame` gives, by name: the stackable quantities of the table, and strain; lengths in `units`."""
        kept = [entry for entry in QUANTITIES.values() if entry.stackable and entry.name not in _REPLACED]
        told = [replace(entry, unit=self.units.length) if entry.unit == "px" else entry for entry in kept]
        return {entry.name: entry for entry in (*told, *_STRAIN, *_ELEMENT_STRAIN)}

    def is_strain(self, name: str) -> bool:
        """Whether a quantity depends on measure and gauge."""
        return any(entry.name == name for entry in (*_STRAIN, *_ELEMENT_STRAIN))

    @property
    def length(self) -> float:
        """What a length in px is multiplied by."""
        return self.units.mm_per_pixel or 1.0

    def frame(self, index: int) -> dict[str, Any]:
        """The `quantities` of one frame, each in its type; errors as `Result.frame`."""
        record = self.result.frame(index)
        values = {name: record.values[name] for name in self.quantities if name in record.values}
        for component in ("u", "v"):
            pair = self.units.lengths(record.values[component], record.values[f"{component}_std"])
            values |= zip((component, f"{component}_std"), pair, strict=True)
        values |= self.strain(record.u, record.v, record.u_std, record.v_std)
        elements = self._element_strain(record)
        values |= {entry.name: _part(elements, entry) for entry in _ELEMENT_STRAIN}
        return values

    def strain(self, u: FloatArray, v: FloatArray, u_std: FloatArray, v_std: FloatArray) -> dict[str, FloatArray]:
        """The strain at the nodes by name, from the displacements (N,) of one frame in px."""
        strain = self.gauges.strain(u, v, u_std, v_std)
        return {entry.name: _part(strain, entry) for entry in _STRAIN}

    def _element_strain(self, record: FrameRecord) -> Strain:
        """Strain of the linear field in each element, without its uncertainty."""
        gradient = self.mesh.element_gradient(np.stack([record.u, record.v], axis=1))
        return strain_of_gradient(gradient, np.zeros((len(gradient), 4, 4)))


def _part(strain: Strain, entry: Quantity) -> FloatArray:
    attribute, _, column = entry.source.partition(".")
    values: FloatArray = getattr(strain, attribute)
    return values[:, int(column)] if column else values
