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
from rgbmidic.results.physical import MOVED, Physical, frame_times
from rgbmidic.results.quantities import QUANTITIES, SHARED
from rgbmidic.results.result import Result
from rgbmidic.settings import ScaleSettings
from rgbmidic.timing import STAGES

_COMPONENTS = ("exx", "eyy", "exy")
"""Quantities of the field table that are the components of one variable, `strain`; likewise of their uncertainties."""
_PARTS = {"brightness": ("brightness_part", ("gain", "offset")), "seconds": ("stage", tuple(STAGES))}
"""Dimension and coordinate of the axes that have a number in the field table in place of a name."""


class _Frames(BackendArray):
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
        self.blank = QUANTITIES[names[0]].unmeasured(result.table.sizes)
        self.dtype = self.blank.dtype
        self.shape = (len(result), *self.blank.shape, *([len(names)] if len(names) > 1 else []))

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read)

    def _read(self, key: tuple[Any, ...]) -> Any:
        """Read the part at an outer key: a whole number, a slice or an array for each axis."""
        frames = np.arange(len(self.result))[key[0]]
        inner = list(enumerate(key[1:]))[::-1]  # from the last axis: a whole number drops its axis

        def part(values: Mapping[str, Any]) -> Any:
            array = np.stack([values[name] for name in self.names], axis=-1).reshape(self.shape[1:])
            for axis, index in inner:
                array = array[(slice(None),) * axis + (index,)]
            return array

        read = np.empty((frames.size, *part(dict.fromkeys(self.names, self.blank)).shape), dtype=self.dtype)
        for row, values in enumerate(self._each(frames.reshape(-1).tolist())):
            read[row] = part(values)
        return read.reshape((*frames.shape, *read.shape[1:]))

    def _each(self, frames: list[int]) -> Iterable[Mapping[str, Any]]:
        if self.maps is None:
            return self.result.table.each(self.names, frames)
        read, nothing, there = self.maps.read, dict.fromkeys(self.names, self.blank), self.result.finished
        return ({name: read(name, at).values for name in self.names} if there[at] else nothing for at in frames)


def to_dataset(result: Result, scale: ScaleSettings | None = None) -> xr.Dataset:
    """Make the Dataset that `Result.to_xarray` documents."""
    maps, variables = Maps.of(result, scale), dict[str, xr.Variable]()
    physical = maps.physical
    plane = "" if physical.rectified.camera is None else "on the plane of the specimen"
    for name, entry in QUANTITIES.items():
        dimension = _PARTS[name][0] if name in _PARTS else ""
        if not entry.stackable or name.removesuffix("_std") in _COMPONENTS or name in ("number", "time_ns"):
            continue
        axes = ("frame", *(axis if isinstance(axis, str) else dimension for axis in entry.axes))
        moved = name in MOVED
        about = entry.attributes | ({"units": maps.field(name).unit} if moved else {})
        if moved and plane:
            about["description"] = plane
        read = indexing.LazilyIndexedArray(_Frames(result, (name,), maps if moved else None))
        variables[name] = xr.Variable(axes, read, about)
    for end, meaning in {"": "strain", "_std": "standard uncertainty of strain"}.items():
        names, how = tuple(f"{name}{end}" for name in _COMPONENTS), maps.how("exx")
        about = {"units": "1", "long_name": meaning, "description": ": ".join(filter(None, [plane, how]))}
        read = indexing.LazilyIndexedArray(_Frames(result, names, maps))
        variables[f"strain{end}"] = xr.Variable(("frame", "node", "component"), read, about)
    variables["elements"] = xr.Variable(("element", "corner"), result.elements, SHARED["elements"].attributes)
    return xr.Dataset(variables, _coordinates(physical), _provenance(physical))


def _coordinates(physical: Physical) -> dict[str, xr.Variable]:
    """Collect the places of the nodes, as in exports; numbers, names and times of the frames."""
    result = physical.result
    coordinates = {
        "frame": xr.Variable("frame", np.arange(len(result)), {"long_name": "place of the frame in the result"}),
        "number": xr.Variable("frame", result.number, QUANTITIES["number"].attributes),
        "name": xr.Variable("frame", list(result.names), {"long_name": "name of the frame"}),
        "light": xr.Variable("light", list(result.lights), {"long_name": "name of the light"}),
        "component": xr.Variable("component", list(_COMPONENTS), {"long_name": "component of the strain tensor"}),
    }
    coordinates |= {dimension: xr.Variable(dimension, list(parts)) for dimension, parts in _PARTS.values()}
    numbers = [(SHARED[name], getattr(result, name)) for name in ("node_number", "element_number")]
    for entry, values in [*physical.places, *numbers]:
        if values is not None:
            coordinates[entry.name] = xr.Variable(entry.axes, values, entry.attributes)
    if (times := frame_times(result, physical.scale)) is not None:
        about = {"units": "s", "long_name": "time of the frame from the trigger"}
        coordinates["time"] = xr.Variable("frame", times, about)
    return coordinates


def _provenance(physical: Physical) -> dict[str, Any]:
    """Collect the attributes of the Dataset as plain numbers and texts, which a file can hold."""
    kept = physical.result.provenance
    plain = {name: kept[name] for name in ("created", "finished", "frame_rate", "exposure_ns") if kept.get(name)}
    texts = {name: json.dumps(kept[name]) for name in ("settings", "calibration", "versions") if name in kept}
    return {**physical.facts, **plain, "references": list(kept["references"]), **texts}
