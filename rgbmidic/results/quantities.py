"""The table of numbers of a result: every quantity that is kept, and those that follow from them.

Each is declared once, here; records, store, exports, maps and documents read that.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from rgbmidic.fields.quantity import ESTIMATED, ResultQuantity, Units, with_uncertainty
from rgbmidic.fields.strain import PRINCIPAL, STRAIN, TENSOR
from rgbmidic.timing import STAGES

NO_CHECKSUM = -1
"""`checksum` of a frame that could not be measured at all."""
UNKNOWN_TIME = np.iinfo(np.int64).min
"""`time_ns` of a frame whose time is not known."""

_NODE, _LIGHT, _PICTURE = ("node",), ("light",), ("light", "row", "column")
_TEXT: dict[str, Any] = {"dtype": np.str_, "blank": ""}
_BYTE: dict[str, Any] = {"dtype": np.uint8, "blank": 0}
_DOUBLE: dict[str, Any] = {"dtype": np.float64}
_AT_NODE = "relative to the reference, at the node"
_NOT_FIT = "(not the best linear fit's nodal value)"
_NODAL_SLOPE = "slope of the quadratic through the neighbouring nodes; NaN also next to a node that is not measured"
_BIAS = "part of {}_std left by the bias of the lights, alike over some 24 px; 0 where there is none"
_EDGE = "part of {}_std that the recovery misses near edges of the region; 0 elsewhere and with `mesh.error`"
_DISCRETISATION = (
    "discretisation error of {}, caused by mesh and recovery, one sigma; empty unless `mesh.error` requests it"
)
_FRAME_OUTCOMES = ("converged", "not converged", "failed")
_NODE_OUTCOMES = ("measured", "not seen", "decorrelated", "filled")

_TABLE = (
    ResultQuantity("number", (), "", "", "number of the frame; missing frames leave gaps", dtype=np.int64, blank=-1),
    ResultQuantity("time_ns", (), "ns", "",
        "time of the frame after the trigger; the smallest 64-bit integer if it is not known",
        dtype=np.int64, blank=UNKNOWN_TIME),
    ResultQuantity("status", (), "", "status",
        "status of the frame, see below", dtype=np.int64, blank=2, codes=_FRAME_OUTCOMES),
    ResultQuantity("reason", (), "", "reason", "why it failed or did not converge, else empty", **_TEXT),
    ResultQuantity("warnings", ("warning",), "", "", "what is doubtful about it, a text each", **_TEXT),
    ResultQuantity("unread", (), "", "",
        "1 if the frame failed because it could not be read (`rgbmidic run --resume` tries again), else 0",
        dtype=np.int64, blank=0),
    ResultQuantity("tries", (), "", "",
        "2 for a key frame that was also measured from the frame just before it, else 1", dtype=np.int64, blank=1),
    ResultQuantity("iterations", (), "", "iterations", "Gauss-Newton iterations", dtype=np.int64, blank=0),
    ResultQuantity("history", ("iteration",), "px", "history", "largest motion of a measured node in each iteration"),
    ResultQuantity("inputs", ("file", 2), "", "",
        "path and SHA-256 of each file that the frame was read from", **_TEXT),
    ResultQuantity("machine", (), "", "",
        "processor and BLAS library that it was measured with, on which the last bits depend; empty if it failed",
        **_TEXT),
    ResultQuantity("checksum", (), "", "",
        "CRC-32 of the frame's samples where the reference was read; -1 if it failed. Noise makes all differ",
        dtype=np.int64, blank=NO_CHECKSUM),
    ResultQuantity("node_status", _NODE, "", "node_status",
        "see below", dtype=np.uint8, blank=1, codes=_NODE_OUTCOMES, kind="codes"),
    *with_uncertainty(
        ResultQuantity("u", _NODE, "px", "displacement.0", f"displacement in x {_AT_NODE} {_NOT_FIT}", **_DOUBLE),
        ResultQuantity("v", _NODE, "px", "displacement.1", f"displacement in y {_AT_NODE}", **_DOUBLE),
    ),
    ResultQuantity("u_bias_std", _NODE, "px", "bias_std.0", _BIAS.format("u"), kind="positive"),
    ResultQuantity("v_bias_std", _NODE, "px", "bias_std.1", _BIAS.format("v"), kind="positive"),
    ResultQuantity("u_edge_std", _NODE, "px", "edge_std.0", _EDGE.format("u"), kind="positive"),
    ResultQuantity("v_edge_std", _NODE, "px", "edge_std.1", _EDGE.format("v"), kind="positive"),
    *with_uncertainty(
        ResultQuantity("nodal_exx", _NODE, "", "strain.0", f"small strain in x: {_NODAL_SLOPE}"),
        ResultQuantity("nodal_eyy", _NODE, "", "strain.1", f"small strain in y: {_NODAL_SLOPE}"),
        ResultQuantity("nodal_exy", _NODE, "", "strain.2", f"small strain, tensor shear: {_NODAL_SLOPE}"),
    ),
    ResultQuantity("u_mesh_error", ESTIMATED, "px", "displacement_error.0", _DISCRETISATION.format("u")),
    ResultQuantity("v_mesh_error", ESTIMATED, "px", "displacement_error.1", _DISCRETISATION.format("v")),
    ResultQuantity("nodal_exx_mesh_error", ESTIMATED, "", "strain_error.0", _DISCRETISATION.format("nodal_exx")),
    ResultQuantity("nodal_eyy_mesh_error", ESTIMATED, "", "strain_error.1", _DISCRETISATION.format("nodal_eyy")),
    ResultQuantity("nodal_exy_mesh_error", ESTIMATED, "", "strain_error.2", _DISCRETISATION.format("nodal_exy")),
    ResultQuantity("match", (), "", "",
        "median correlation coefficient of the elements with their reference, for the light that matches best; NaN "
        "without `frames.update_reference`"),
    ResultQuantity("best_match", (), "", "",
        "largest match of the frames compared with the same reference, up to this one", blank=0),
    ResultQuantity("reference_updates", ("reference_update",), "", "",
        "indices in the result of the frames that became the reference, up to this one: this frame was compared with "
        "the last one before it, or with the test's reference", dtype=np.int64, blank=0),
    ResultQuantity("misfit", _NODE, "", "misfit",
        "weighted rms residual around a node over its median: 1 is typical, 3 is suspicious", kind="positive"),
    ResultQuantity("light_fraction", ("node", "light"), "", "light_fraction",
        "fraction of each light in the information that determines a node", blank=0),
    ResultQuantity("residual", _LIGHT, "", "residual",
        "weighted rms of `f - g(x + u)`, corrected for brightness, over the local mean of f"),
    ResultQuantity("weight_fraction", _LIGHT, "", "weight_fraction",
        "mean fraction of each light in the weights; their sum is the part of the region that any light sees"),
    ResultQuantity("brightness", ("light", 2), "", "",
        "gain and offset (DN) of each light relative to the reference, from contrast and mean of the speckle; "
        "reported, not used"),
    ResultQuantity("rigid", ("light", "function"), "", "rigid",
        "coefficients of each light's rigid functions: shift in x and y (px), rotation (rad); 0 for the first, NaN for "
        "a light that sees nothing"),
    ResultQuantity("seconds", (len(STAGES),), "s", "",
        f"time of each of the stages {', '.join(STAGES)}; NaN without `rgbmidic run --timings`"),
    ResultQuantity("weights_thumbnail", _PICTURE, "", "", "reduced picture of each light's weight, 255 for 1", **_BYTE),
    ResultQuantity("reflection_thumbnail", _PICTURE, "", "",
        "reduced picture of each light's reflection index, 255 for 1; empty if the separation does not give it",
        **_BYTE),
)  # fmt: skip

QUANTITIES: dict[str, ResultQuantity] = {quantity.name: quantity for quantity in _TABLE}
"""Every quantity by its name, in the order of the documents."""
NUMBERS = tuple(name for name, quantity in QUANTITIES.items() if not quantity.axes and quantity.is_stackable)
"""Those that are one number a frame: they are read together."""
FAILED = QUANTITIES["status"].codes.index("failed")
"""`status` of a frame that could not be measured."""

_CORNERS = "node indices; `(p1 - p0) x (p2 - p0) > 0` in (x, y)"
_REFERENCE = "reference image of each light, stretched to 8 bit, for pictures"
_LABEL = "number of the node in the file of `mesh.file`"
_CELL = "number of the element in the file of `mesh.file` that the triangle is from"
_FILE_AXES = "node positions (x, y) in the axes of the file of `mesh.file`"
SHARED: dict[str, ResultQuantity] = {
    "nodes": ResultQuantity("nodes", ("node", 2), "px", "", "node positions (x, y) on the reference image", **_DOUBLE),
    "elements": ResultQuantity("elements", ("element", 3), "", "", _CORNERS, dtype=np.int32, blank=0),
    "node_number": ResultQuantity("node_number", ("node",), "", "", _LABEL, dtype=np.int64, blank=-1),
    "element_number": ResultQuantity("element_number", ("element",), "", "", _CELL, dtype=np.int64, blank=-1),
    "node_mm": ResultQuantity("node_mm", ("node", 2), "mm", "", _FILE_AXES, **_DOUBLE),
    "reference": ResultQuantity("reference", ("light", "image row", "image column"), "", "", _REFERENCE, **_BYTE),
}
"""Quantities that all frames have in common."""

MESH_LABELS = ("node_number", "element_number", "node_mm")
"""Those of them that only a mesh of ``mesh.file`` has."""
MESH_DOCUMENT = "finite_elements"
"""Name of its entry in the provenance, and of the source that wrote it."""

UV = ("u", "v")


def derived_quantities(components: tuple[str, ...]) -> dict[str, ResultQuantity]:
    """Return what follows from a displacement with these components, and rates of strain, by name."""
    axis = dict(zip(components, "xyz", strict=False))
    table = [
        *((name, "px", name, f"displacement in {axis[name]}", (name,), 0) for name in components),
        ("magnitude", "px", "|u|", "length of the displacement", components, 0),
        *((f"{name}_velocity", "px", f"d{name}/dt", f"velocity in {axis[name]}", (name,), 1) for name in components),
        ("velocity", "px", "|du/dt|", "magnitude of the velocity", components, 1),
        *(
            (f"{name}_acceleration", "px", f"d²{name}/dt²", f"acceleration in {axis[name]}", (name,), 2)
            for name in components
        ),
        ("acceleration", "px", "|d²u/dt²|", "magnitude of the acceleration", components, 2),
        *((f"e{axes}_rate", "", f"dε{axes}/dt", f"rate of the strain in {axes[0]}", (f"e{axes}",), 1)
          for axes in ("xx", "yy")),
        ("exy_rate", "", "dεxy/dt", "rate of the tensor shear", ("exy",), 1),
        ("equivalent_rate", "", "dεeq/dt", "rate of the von Mises equivalent strain", ("equivalent",), 1),
    ]  # fmt: skip
    return {
        name: ResultQuantity(
            name, _NODE, unit, "", description, symbol=symbol, base_quantities=base, order=order,
            group="Rates" if order else "Displacement",
            kind="strain" if not unit else "positive" if len(base) > 1 else "displacement",
        )
        for name, unit, symbol, description, base, order in table
    }  # fmt: skip


DERIVED = derived_quantities(UV) | STRAIN
"""Displacement, rates of displacement and strain, and strain itself, by name."""
STRAIN_COLUMNS = tuple(
    column
    for names in (TENSOR, PRINCIPAL, *((name,) for name in STRAIN if name not in TENSOR + PRINCIPAL))
    for column in with_uncertainty(*(STRAIN[name] for name in names))
)
"""Strain of a frame over a gauge, in the order of exports."""
ELEMENT_STRAIN = tuple(
    replace(
        entry,
        name=f"{entry.name}_element",
        axes=("element",),
        description=f"{entry.description}, constant in an element",
    )
    for entry in map(STRAIN.__getitem__, TENSOR)
)
COMPONENTS = ("u", "v", "nodal_exx", "nodal_eyy", "nodal_exy")
ERROR_QUANTITIES = {
    f"{name}_{suffix}": ResultQuantity(
        f"{name}_{suffix}", _NODE, "px" if name in UV else "", "",
        description.format(name if name in UV else f"the small strain {name}"),
        symbol=f"{name}_{suffix}", base_quantities=(name,), group="Uncertainty", kind="positive",
    )
    for suffix, description in (
        ("mesh_error", "discretisation error of {}: what mesh and recovery leave out"),
        ("total", "noise and discretisation error of {} together"),
    )
    for name in COMPONENTS
}  # fmt: skip
_FINER_MESH = "largest discretisation error over the noise of u, v and the small strain: above 1 a finer mesh is needed"
ERROR_QUANTITIES["finer_mesh"] = ResultQuantity(
    "finer_mesh", _NODE, "", "", _FINER_MESH, symbol="finer_mesh", base_quantities=COMPONENTS, kind="positive"
)
"""Quantities of results whose ``mesh.error`` asks for the discretisation error."""
_GROUPS = ("Displacement", "Strain", "Rates", "Quality", "Uncertainty")


def stored_map_quantities(lights: tuple[str, ...], *, with_error: bool) -> list[ResultQuantity]:
    """Return what maps show besides displacement, strain and rates.

    Parameters
    ----------
    lights
        Their names.
    with_error
        Whether the discretisation error is known.

    Returns
    -------
    list of ResultQuantity
    """
    derived_names = {name for entry in DERIVED.values() for name in (entry.name, entry.uncertainty.name)}
    stored = [
        replace(entry, symbol=name, description=", ".join(entry.codes) or entry.description)
        for name, entry in QUANTITIES.items()
        if entry.axes == _NODE and entry.file_name not in derived_names
    ]
    description, names = QUANTITIES["light_fraction"].description, [f"fraction of {light}" for light in lights]
    fractions = [ResultQuantity(name, _NODE, "", "", description, symbol=name, kind="fraction") for name in names]
    return [*stored, *(ERROR_QUANTITIES.values() if with_error else ()), *fractions]


def map_quantities(
    components: tuple[str, ...], quantities: Iterable[ResultQuantity], units: Units
) -> dict[str, ResultQuantity]:
    """Return what maps show by its name, group by group; each that has an uncertainty is followed by it further down.

    Parameters
    ----------
    components
        Names of the components of the displacement.
    quantities
        Those of a `FieldSource`.
    units
        Units of the reader, that of time included.

    Returns
    -------
    dict of str to ResultQuantity
    """
    derived = derived_quantities(components) | {entry.name: entry for entry in quantities if entry.group == "Strain"}
    others = [entry for entry in quantities if entry.name not in derived]
    entries = [*derived.values(), *others, *(entry.uncertainty for entry in derived.values())]
    return {entry.name: entry.with_units(units) for entry in sorted(entries, key=lambda one: _GROUPS.index(one.group))}
