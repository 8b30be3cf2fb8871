"""Quantities that follow from what is kept of a frame: lengths, strain over gauges, rates; and all that maps show."""

from __future__ import annotations

from dataclasses import replace

from rgbmidic.fields import Units
from rgbmidic.fields.measures import EQUIVALENT
from rgbmidic.results.quantities import QUANTITIES, Quantity

_NODE = ("node",)
UV = ("u", "v")
OF_LENGTHS = {
    name: Quantity(
        name, _NODE, "px", "", meaning, symbol=symbol, parts=parts, order=order,
        group="Rates" if order else "Displacement", kind="positive" if parts == UV else "displacement",
    )
    for name, symbol, meaning, parts, order in (
        ("u", "u", "displacement in x", ("u",), 0),
        ("v", "v", "displacement in y", ("v",), 0),
        ("magnitude", "|u|", "length of the displacement", UV, 0),
        ("u_velocity", "du/dt", "velocity in x", ("u",), 1),
        ("v_velocity", "dv/dt", "velocity in y", ("v",), 1),
        ("velocity", "|du/dt|", "magnitude of the velocity", UV, 1),
        ("u_acceleration", "d²u/dt²", "acceleration in x", ("u",), 2),
        ("v_acceleration", "d²v/dt²", "acceleration in y", ("v",), 2),
        ("acceleration", "|d²u/dt²|", "magnitude of the acceleration", UV, 2),
    )
}  # fmt: skip
"""Displacement and its rates, by name."""
OF_STRAINS = {
    f"{part}_rate": Quantity(
        f"{part}_rate", _NODE, "", "", f"rate of the {meaning}", symbol=symbol, parts=(part,), order=1, group="Rates"
    )
    for part, symbol, meaning in (
        ("exx", "dεxx/dt", "strain in x"),
        ("eyy", "dεyy/dt", "strain in y"),
        ("exy", "dεxy/dt", "tensor shear"),
        ("equivalent", "dεeq/dt", "von Mises equivalent strain"),
    )
}
"""Rates of the strain, by name."""
STRAINS = {
    name: Quantity(name, _NODE, unit, source, meaning, symbol=symbol, std_source=std_source, group="Strain", kind=kind)
    for name, symbol, unit, kind, source, std_source, meaning in (
        ("exx", "εxx", "", "strain", "components.0", "components_std.0", "strain in x"),
        ("eyy", "εyy", "", "strain", "components.1", "components_std.1", "strain in y"),
        ("exy", "εxy", "", "strain", "components.2", "components_std.2", "strain, tensor shear"),
        ("e1", "ε₁", "", "strain", "principal.0", "principal_std.0", "larger principal strain in the plane"),
        ("e2", "ε₂", "", "strain", "principal.1", "principal_std.1", "smaller principal strain in the plane"),
        ("direction", "θ₁", "deg", "angle", "direction_deg", "direction_std_deg", "direction of e1, from x towards y"),
        ("shear", "γmax", "", "positive", "shear", "shear_std", "largest engineering shear in the plane, e1 - e2"),
        ("equivalent", "εeq (Hencky)", "", "positive", "equivalent", "equivalent_std", EQUIVALENT),
    )
}
"""Strain of a frame over a gauge, by name."""
_TOGETHER = (("exx", "eyy", "exy"), ("e1", "e2"), ("direction",), ("shear",), ("equivalent",))
STRAIN = tuple(
    entry
    for names in _TOGETHER
    for entry in (*(STRAINS[name] for name in names), *(STRAINS[name].uncertainty for name in names))
)
"""The same with their standard uncertainties, in the order of exports."""
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
    derived = [*OF_LENGTHS.values(), *OF_STRAINS.values(), *STRAINS.values()]
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
