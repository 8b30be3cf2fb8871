"""A result as an xarray Dataset, whose variables read the frames that are asked for, and no others.

Attributes follow the CF conventions: ``units`` ("1" where there is none), ``long_name``, and for a status
``flag_values`` and ``flag_meanings``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from rgbmidic.results.maps import Maps
from rgbmidic.results.quantities import QUANTITIES, SHARED, STRAIN_COLUMNS
from rgbmidic.results.result import Result
from rgbmidic.results.result_in_units import DISPLACEMENT_QUANTITIES, ResultInUnits, frame_times
from rgbmidic.settings import ScaleSettings
from rgbmidic.timing import STAGES

_COMPONENTS = ("exx", "eyy", "exy")
"""Quantities of the field table that are the components of one variable, `strain`; likewise of their uncertainties."""
_NUMBERED_AXES = {"brightness": ("brightness_part", ("gain", "offset")), "seconds": ("stage", tuple(STAGES))}
"""Dimension and coordinate of the axes that have a number in the field table in place of a name."""


class _LazyQuantity(BackendArray):
    """Quantities of the field table over all frames, stacked along a last axis where there are several.

    Parameters
    ----------
    result
        It is read when the array is indexed.
    names
        Of one shape and type.
    maps
        Where they are fields in the reader's units, not as the table has them.
    """

    def __init__(self, result: Result, names: tuple[str, ...], maps: Maps | None = None) -> None:
        self.result, self.names, self.maps = result, names, maps
        entries = {**QUANTITIES, **{entry.name: entry for entry in STRAIN_COLUMNS}}
        self.blank = entries[names[0]].unmeasured(result.table.sizes)
        self.dtype = self.blank.dtype
        self.shape = (len(result), *self.blank.shape, *([len(names)] if len(names) > 1 else []))

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read_selection)

    def _read_selection(self, key: tuple[Any, ...]) -> Any:
        """Read the part at an outer key: a whole number, a slice or an array for each axis."""
        frames = np.arange(len(self.result))[key[0]]
        axis_keys = list(enumerate(key[1:]))[::-1]  # from the last axis: a whole number drops its axis

        def select(values: Mapping[str, Any]) -> Any:
            array = np.stack([values[name] for name in self.names], axis=-1).reshape(self.shape[1:])
            for axis, index in axis_keys:
                array = array[(slice(None),) * axis + (index,)]
            return array

        selected = np.empty((frames.size, *select(dict.fromkeys(self.names, self.blank)).shape), dtype=self.dtype)
        for row, values in enumerate(self._frame_values(frames.reshape(-1).tolist())):
            selected[row] = select(values)
        return selected.reshape((*frames.shape, *selected.shape[1:]))

    def _frame_values(self, frames: list[int]) -> Iterable[Mapping[str, Any]]:
        if self.maps is None:
            return self.result.table.iterate(self.names, frames)
        read_field, blank_values, finished = self.maps.read, dict.fromkeys(self.names, self.blank), self.result.finished
        return (
            {name: read_field(name, frame).values for name in self.names} if finished[frame] else blank_values
            for frame in frames
        )


def to_dataset(result: Result, scale: ScaleSettings | None = None) -> xr.Dataset:
    """Make the Dataset that `Result.to_xarray` documents."""
    maps, variables = Maps.from_result(result, scale), dict[str, xr.Variable]()
    physical = maps.physical
    plane = "" if physical.rectified.camera is None else "on the plane of the specimen"
    for name, entry in QUANTITIES.items():
        dimension = _NUMBERED_AXES[name][0] if name in _NUMBERED_AXES else ""
        if (
            not entry.is_stackable
            or entry.file_name.removesuffix("_std") in _COMPONENTS
            or name in ("number", "time_ns")
        ):
            continue
        axes = ("frame", *(axis if isinstance(axis, str) else dimension for axis in entry.axes))
        is_displacement = name in DISPLACEMENT_QUANTITIES
        attributes = entry.attributes | ({"units": maps.field(name).unit} if is_displacement else {})
        if is_displacement and plane:
            attributes["description"] = plane
        lazy_array = indexing.LazilyIndexedArray(_LazyQuantity(result, (name,), maps if is_displacement else None))
        variables[name] = xr.Variable(axes, lazy_array, attributes)
    for suffix, long_name in {"": "strain", "_std": "standard uncertainty of strain"}.items():
        names, note = tuple(f"{name}{suffix}" for name in _COMPONENTS), maps.processing_note("exx")
        attributes = {"units": "1", "long_name": long_name, "description": ": ".join(filter(None, [plane, note]))}
        lazy_array = indexing.LazilyIndexedArray(_LazyQuantity(result, names, maps))
        variables[f"strain{suffix}"] = xr.Variable(("frame", "node", "component"), lazy_array, attributes)
    variables["elements"] = xr.Variable(("element", "corner"), result.elements, SHARED["elements"].attributes)
    return xr.Dataset(variables, _coordinates(physical), _provenance(physical))


def _coordinates(physical: ResultInUnits) -> dict[str, xr.Variable]:
    """Collect the places of the nodes, as in exports; numbers, names and times of the frames."""
    result = physical.result
    coordinates = {
        "frame": xr.Variable("frame", np.arange(len(result)), {"long_name": "place of the frame in the result"}),
        "number": xr.Variable("frame", result.number, QUANTITIES["number"].attributes),
        "name": xr.Variable("frame", list(result.names), {"long_name": "name of the frame"}),
        "light": xr.Variable("light", list(result.lights), {"long_name": "name of the light"}),
        "component": xr.Variable("component", list(_COMPONENTS), {"long_name": "component of the strain tensor"}),
    }
    coordinates |= {dimension: xr.Variable(dimension, list(labels)) for dimension, labels in _NUMBERED_AXES.values()}
    numbers = [(SHARED[name], getattr(result, name)) for name in ("node_number", "element_number")]
    for entry, values in [*physical.coordinates, *numbers]:
        if values is not None:
            coordinates[entry.name] = xr.Variable(entry.axes, values, entry.attributes)
    if (times := frame_times(result, physical.scale)) is not None:
        attributes = {"units": "s", "long_name": "time of the frame from the trigger"}
        coordinates["time"] = xr.Variable("frame", times, attributes)
    return coordinates


def _provenance(physical: ResultInUnits) -> dict[str, Any]:
    """Collect the attributes of the Dataset as plain numbers and texts, which a file can hold."""
    document = physical.result.provenance
    values = {
        name: document[name] for name in ("created", "finished", "frame_rate", "exposure_ns") if document.get(name)
    }
    texts = {name: json.dumps(document[name]) for name in ("settings", "calibration", "versions") if name in document}
    return {**physical.file_attributes, **values, "references": list(document["references"]), **texts}
