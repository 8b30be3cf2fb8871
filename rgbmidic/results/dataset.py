"""A result as an xarray Dataset, whose variables read the frames that are asked for, and no others.

Attributes follow the CF conventions: ``units`` ("1" where there is none), ``long_name``, and for a status
``flag_values`` and ``flag_meanings``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from rgbmidic.fields.strain import TENSOR
from rgbmidic.results.maps import Maps
from rgbmidic.results.quantities import QUANTITIES, SHARED
from rgbmidic.results.result import Result
from rgbmidic.results.result_in_units import DISPLACEMENT_QUANTITIES, ResultInUnits
from rgbmidic.settings import ScaleSettings
from rgbmidic.timing import STAGES
from rgbmidic.typing import AnyArray

_NUMBERED_AXES = {"brightness": ("brightness_part", ("gain", "offset")), "seconds": ("stage", tuple(STAGES))}
"""Dimension and coordinate of the axes that have a number in the field table in place of a name."""


class _LazyArray(BackendArray):
    """An array over all frames, which are read when it is indexed.

    Parameters
    ----------
    read
        Reads a frame.
    frame_count
        Number of frames T.
    blank
        What a frame is that is not measured.
    """

    def __init__(self, read: Callable[[int], AnyArray], frame_count: int, blank: AnyArray) -> None:
        self.read, self.dtype, self.shape = read, blank.dtype, (frame_count, *blank.shape)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read_selection)

    def _read_selection(self, key: tuple[Any, ...]) -> Any:
        """Read the part at an outer key: a whole number, a slice or an array for each axis."""
        frames = np.arange(self.shape[0])[key[0]]
        selected = np.empty((frames.size, *self.shape[1:]), dtype=self.dtype)
        for row, frame in enumerate(frames.reshape(-1).tolist()):
            selected[row] = self.read(frame)
        for axis, index in list(enumerate(key[1:], start=1))[::-1]:  # from the last axis: a whole number drops its axis
            selected = selected[(slice(None),) * axis + (index,)]
        return selected.reshape((*frames.shape, *selected.shape[1:]))


def _read_stored(result: Result, name: str, frame: int) -> Any:
    return result.table.read(frame, [name])[name]


def _read_fields(maps: Maps, names: Sequence[str], frame: int) -> AnyArray:
    """Read fields in the reader's units, along a last axis where there are several."""
    values = [maps.read(name, frame).values for name in names]
    return values[0] if len(values) == 1 else np.stack(values, axis=-1)


def to_dataset(result: Result, scale: ScaleSettings | None = None) -> xr.Dataset:
    """Make the Dataset that `Result.to_xarray` documents."""
    maps, variables = Maps.from_result(result, scale), dict[str, xr.Variable]()
    physical = maps.physical
    plane = "" if physical.rectified.camera is None else "on the plane of the specimen"
    for name, entry in QUANTITIES.items():
        dimension = _NUMBERED_AXES[name][0] if name in _NUMBERED_AXES else ""
        if not entry.is_stackable or entry.file_name.removesuffix("_std") in TENSOR or name in ("number", "time_ns"):
            continue
        axes = ("frame", *(axis if isinstance(axis, str) else dimension for axis in entry.axes))
        is_displacement = name in DISPLACEMENT_QUANTITIES
        attributes = entry.attributes | ({"units": maps.field(name).unit} if is_displacement else {})
        if is_displacement and plane:
            attributes["description"] = plane
        read = partial(_read_fields, maps, [name]) if is_displacement else partial(_read_stored, result, name)
        lazy_array = _LazyArray(read, len(result), entry.unmeasured(result.table.sizes))
        variables[name] = xr.Variable(axes, indexing.LazilyIndexedArray(lazy_array), attributes)
    for suffix, long_name in {"": "strain", "_std": "standard uncertainty of strain"}.items():
        names, note = tuple(f"{name}{suffix}" for name in TENSOR), maps.processing_note("exx")
        attributes = {"units": "1", "long_name": long_name, "description": ": ".join(filter(None, [plane, note]))}
        blank = np.full((len(result.nodes), len(names)), np.nan, dtype=np.float32)
        lazy_array = _LazyArray(partial(_read_fields, maps, names), len(result), blank)
        axes = ("frame", "node", "component")
        variables[f"strain{suffix}"] = xr.Variable(axes, indexing.LazilyIndexedArray(lazy_array), attributes)
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
        "component": xr.Variable("component", list(TENSOR), {"long_name": "component of the strain tensor"}),
    }
    coordinates |= {dimension: xr.Variable(dimension, list(labels)) for dimension, labels in _NUMBERED_AXES.values()}
    numbers = [(SHARED[name], getattr(result, name)) for name in ("node_number", "element_number")]
    for entry, values in [*physical.coordinates, *numbers]:
        if values is not None:
            coordinates[entry.name] = xr.Variable(entry.axes, values, entry.attributes)
    if (times := physical.seconds) is not None:
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
