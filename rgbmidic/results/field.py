"""The nodal fields that maps show, each declared once: name, symbol, unit, heading, kind; measured or derived."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rgbmidic.fields import Units, rounded, uncertain
from rgbmidic.results.physical import STRAIN
from rgbmidic.results.quantities import ResultQuantity

Kind = Literal["displacement", "strain", "positive", "fraction", "angle", "codes"]


@dataclass(frozen=True, slots=True)
class Derived:
    """A field that follows from others: their length where there are two, the derivative by time of an order."""

    symbol: str
    meaning: str
    parts: tuple[str, ...]
    order: int = 0

    @property
    def group(self) -> str:
        """Heading under which it stands."""
        return "Rates" if self.order else "Displacement"


UV = ("u", "v")
OF_LENGTHS = {
    "u": Derived("u", "displacement in x", ("u",)),
    "v": Derived("v", "displacement in y", ("v",)),
    "magnitude": Derived("|u|", "length of the displacement", UV),
    "u_velocity": Derived("du/dt", "velocity in x", ("u",), 1),
    "v_velocity": Derived("dv/dt", "velocity in y", ("v",), 1),
    "velocity": Derived("|du/dt|", "magnitude of the velocity", UV, 1),
    "u_acceleration": Derived("d²u/dt²", "acceleration in x", ("u",), 2),
    "v_acceleration": Derived("d²v/dt²", "acceleration in y", ("v",), 2),
    "acceleration": Derived("|d²u/dt²|", "magnitude of the acceleration", UV, 2),
}
OF_STRAINS = {
    "exx_rate": Derived("dεxx/dt", "rate of the strain in x", ("exx",), 1),
    "eyy_rate": Derived("dεyy/dt", "rate of the strain in y", ("eyy",), 1),
    "exy_rate": Derived("dεxy/dt", "rate of the tensor shear", ("exy",), 1),
    "equivalent_rate": Derived("dεeq/dt", "rate of the von Mises equivalent strain", ("equivalent",), 1),
}
DERIVED = OF_LENGTHS | OF_STRAINS
STRAINS = {entry.name: entry for entry in STRAIN if not entry.name.endswith("_std")}
"""Strains of a frame, by name."""
COMPONENTS = ("u", "v", "exx", "eyy", "exy")
FINER = "finer_mesh"
_ERRORS = {"mesh_error": "discretisation error of {}: what mesh and recovery leave out"}
_ERRORS |= {"total": "noise and discretisation error of {} together"}
WITH_ERROR = {
    f"{name}_{end}": meaning.format(name if name in UV else f"the small strain {name} of the nodes")
    for end, meaning in _ERRORS.items()
    for name in COMPONENTS
}
WITH_ERROR[FINER] = "largest discretisation error over the noise of u, v, exx, eyy, exy: above 1 a finer mesh is needed"
"""Fields of results whose ``mesh.error`` asks for the discretisation error."""
_GROUPS = ("Displacement", "Strain", "Rates", "Quality", "Uncertainty")
_POSITIVE = (FINER, "magnitude", "velocity", "acceleration", "equivalent", "shear", "misfit")
_KINDS: dict[str, Kind] = {"direction": "angle", "node_status": "codes", **dict.fromkeys(_POSITIVE, "positive")}
"""Kinds of fields; other lengths and their rates are displacements, uncertainties positive, all others strains."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapField:
    """A nodal field that can be shown.

    Attributes
    ----------
    name
        As in the field table; a fraction is named by its light, an uncertainty ends in ``_std``.
    symbol
        How formulas and pictures write it.
    unit, meaning
        As in the field table, lengths in the unit of the reader.
    group
        Heading under which it stands in lists.
    kind
        Kind of the values, which sets colours and format.
    codes
        Meaning of each number, for a status.
    """

    name: str
    symbol: str
    unit: str
    meaning: str
    group: str
    kind: Kind
    codes: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Symbol and unit, the title of its pictures and axes."""
        return f"{self.symbol} ({self.unit})" if self.unit else self.symbol

    @property
    def signed(self) -> bool:
        """Whether colours symmetric about 0 make sense."""
        return self.kind in ("displacement", "strain")

    @property
    def logarithmic(self) -> bool:
        """Whether colours spread by ratio: uncertainties, and what is compared with 1."""
        return self.kind == "positive" and self.group in ("Quality", "Uncertainty")

    @property
    def stepped(self) -> bool:
        """Whether values between those of two nodes mean nothing."""
        return self.kind in ("angle", "codes")

    @property
    def ends(self) -> tuple[float, float] | None:
        """Values of the first and last colour, where the kind of field sets them."""
        fixed = {"codes": (-0.5, len(self.codes) - 0.5), "fraction": (0.0, 1.0), "angle": (-90.0, 90.0)}
        return fixed.get(self.kind)

    def text(self, value: float, std: float = float("nan")) -> str:
        """Return a value with its standard uncertainty and unit as text.

        Parameters
        ----------
        value
            The value in the field's unit.
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
            return f"{rounded(value, value)} {self.unit}".rstrip()
        return uncertain(value, std, self.unit)


def map_fields(
    units: Units, quantities: Mapping[str, ResultQuantity], lights: tuple[str, ...], *, with_error: bool
) -> dict[str, MapField]:
    """Return every field by its name, group by group; each that has an uncertainty is followed by it further down.

    Parameters
    ----------
    units
        Units of the reader, that of time included.
    quantities
        What is kept of a frame, in these units.
    lights
        Their names.
    with_error
        Whether the discretisation error is known.

    Returns
    -------
    dict of str to MapField
    """

    def with_std() -> Iterator[MapField]:
        for name, entry in (OF_LENGTHS | OF_STRAINS).items():
            unit = units.length if name in OF_LENGTHS else ""
            unit = units.per_time(unit, entry.order) if entry.order else unit
            yield _field(name, entry.symbol, unit, entry.meaning, entry.group)
        for name, strain in STRAINS.items():
            yield _field(name, strain.symbol, strain.unit, strain.meaning, "Strain")

    known = {each.name: each for each in with_std()}
    spread = [
        replace(
            each, name=f"{each.name}_std", symbol=f"σ({each.symbol})", group="Uncertainty", kind="positive",
            meaning=f"standard uncertainty of {each.name}",
        )
        for each in known.values()
    ]  # fmt: skip
    taken = {*known, *(each.name for each in spread)}
    others = [
        _field(name, name, one.unit, ", ".join(one.codes) or one.meaning, "Quality", one.codes)
        for name, one in quantities.items()
        if one.axes == ("node",) and name not in taken
    ]
    for name, meaning in WITH_ERROR.items() if with_error else ():
        unit = units.length if name[:2] in ("u_", "v_") else ""
        others.append(_field(name, name, unit, meaning, "Quality" if name == FINER else "Uncertainty"))
    meaning = quantities["light_fraction"].meaning
    others += [_field(name := f"fraction of {light}", name, "", meaning, "Quality") for light in lights]
    every = sorted([*known.values(), *others, *spread], key=lambda each: _GROUPS.index(each.group))
    return {each.name: each for each in every}


def _field(name: str, symbol: str, unit: str, meaning: str, group: str, codes: tuple[str, ...] = ()) -> MapField:
    usual: Kind = "displacement" if name in OF_LENGTHS else "strain"
    kind = _KINDS.get(name, "positive" if group == "Uncertainty" else usual)
    kind = "fraction" if name.startswith("fraction") else kind
    return MapField(name=name, symbol=symbol, unit=unit, meaning=meaning, group=group, kind=kind, codes=codes)
