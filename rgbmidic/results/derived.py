"""Quantities that follow from what is kept of a frame: lengths, strain over gauges, rates; and all that maps show."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from rgbmidic.fields import Units
from rgbmidic.fields.strain import EQUIVALENT
from rgbmidic.results.quantities import QUANTITIES, Quantity, with_uncertainty

_NODE = ("node",)
UV = ("u", "v")
DERIVED = {
    name: Quantity(
        name, _NODE, unit, "", meaning, symbol=symbol, parts=parts, order=order,
        group="Rates" if order else "Displacement",
        kind="strain" if not unit else "positive" if parts == UV else "displacement",
    )
    for name, unit, symbol, meaning, parts, order in (
        ("u", "px", "u", "displacement in x", ("u",), 0),
        ("v", "px", "v", "displacement in y", ("v",), 0),
        ("magnitude", "px", "|u|", "length of the displacement", UV, 0),
        ("u_velocity", "px", "du/dt", "velocity in x", ("u",), 1),
        ("v_velocity", "px", "dv/dt", "velocity in y", ("v",), 1),
        ("velocity", "px", "|du/dt|", "magnitude of the velocity", UV, 1),
        ("u_acceleration", "px", "d²u/dt²", "acceleration in x", ("u",), 2),
        ("v_acceleration", "px", "d²v/dt²", "acceleration in y", ("v",), 2),
        ("acceleration", "px", "|d²u/dt²|", "magnitude of the acceleration", UV, 2),
        ("exx_rate", "", "dεxx/dt", "rate of the strain in x", ("exx",), 1),
        ("eyy_rate", "", "dεyy/dt", "rate of the strain in y", ("eyy",), 1),
        ("exy_rate", "", "dεxy/dt", "rate of the tensor shear", ("exy",), 1),
        ("equivalent_rate", "", "dεeq/dt", "rate of the von Mises equivalent strain", ("equivalent",), 1),
    )
}  # fmt: skip
"""Displacement, and rates of displacement and strain, by name."""
_POSITIVE: dict[str, Any] = {"group": "Strain", "kind": "positive"}
_ANGLE: dict[str, Any] = {"group": "Strain", "kind": "angle"}
_TOWARDS, _LARGEST = "direction of e1, from x towards y", "largest engineering shear in the plane, e1 - e2"
STRAIN = (
    *with_uncertainty(
        Quantity("exx", _NODE, "", "components.0", "strain in x", symbol="εxx", group="Strain"),
        Quantity("eyy", _NODE, "", "components.1", "strain in y", symbol="εyy", group="Strain"),
        Quantity("exy", _NODE, "", "components.2", "strain, tensor shear", symbol="εxy", group="Strain"),
    ),
    *with_uncertainty(
        Quantity("e1", _NODE, "", "principal.0", "larger principal strain in the plane", symbol="ε₁", group="Strain"),
        Quantity("e2", _NODE, "", "principal.1", "smaller principal strain in the plane", symbol="ε₂", group="Strain"),
    ),
    *with_uncertainty(Quantity("direction", _NODE, "deg", "direction_deg", _TOWARDS, symbol="θ₁", **_ANGLE)),
    *with_uncertainty(Quantity("shear", _NODE, "", "shear", _LARGEST, symbol="γmax", **_POSITIVE)),
    *with_uncertainty(Quantity("equivalent", _NODE, "", "equivalent", EQUIVALENT, symbol="εeq (Hencky)", **_POSITIVE)),
)
"""Strain of a frame over a gauge, in the order of exports."""
STRAINS = {entry.name: entry for entry in STRAIN if entry.group == "Strain"}
"""The same by name, without the uncertainties."""
ELEMENT_STRAIN = tuple(
    replace(entry, name=f"{name}_element", axes=("element",), meaning=f"{entry.meaning}, constant in an element")
    for name, entry in list(STRAINS.items())[:3]
)
COMPONENTS = ("u", "v", "exx", "eyy", "exy")
FINER = "finer_mesh"
WITH_ERROR = {
    f"{name}_{end}": Quantity(
        f"{name}_{end}", _NODE, "px" if name in UV else "", "",
        meaning.format(name if name in UV else f"the small strain {name} of the nodes"),
        symbol=f"{name}_{end}", group="Uncertainty", kind="positive",
    )
    for end, meaning in (
        ("mesh_error", "discretisation error of {}: what mesh and recovery leave out"),
        ("total", "noise and discretisation error of {} together"),
    )
    for name in COMPONENTS
}  # fmt: skip
_FINER_MESH = "largest discretisation error over the noise of u, v, exx, eyy, exy: above 1 a finer mesh is needed"
WITH_ERROR[FINER] = Quantity(FINER, _NODE, "", "", _FINER_MESH, symbol=FINER, kind="positive")
"""Quantities of results whose ``mesh.error`` asks for the discretisation error."""
_GROUPS = ("Displacement", "Strain", "Rates", "Quality", "Uncertainty")


def map_quantities(units: Units, lights: tuple[str, ...], *, with_error: bool) -> dict[str, Quantity]:
    """Return what maps show by its name, group by group; each that has an uncertainty is followed by it further down.

    Parameters
    ----------
    units
        Units of the reader, that of time included.
    lights
        Their names.
    with_error
        Whether the discretisation error is known.

    Returns
    -------
    dict of str to Quantity
    """
    derived = [*DERIVED.values(), *STRAINS.values()]
    spread = [entry.uncertainty for entry in derived]
    taken = {entry.name for entry in (*derived, *spread)}
    kept = [
        replace(entry, symbol=name, meaning=", ".join(entry.codes) or entry.meaning)
        for name, entry in QUANTITIES.items()
        if entry.axes == _NODE and name not in taken
    ]
    meaning, names = QUANTITIES["light_fraction"].meaning, [f"fraction of {light}" for light in lights]
    fractions = [Quantity(name, _NODE, "", "", meaning, symbol=name, kind="fraction") for name in names]
    every = [*derived, *kept, *(WITH_ERROR.values() if with_error else ()), *fractions, *spread]
    return {entry.name: entry.in_units(units) for entry in sorted(every, key=lambda one: _GROUPS.index(one.group))}
