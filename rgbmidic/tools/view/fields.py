"""The fields that a view asks for, read from a result, the image under them, and what is said of them."""

from __future__ import annotations

import html
import math
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.fields import MEASURES, Area, Displacement, Field, Mean, make_probe
from rgbmidic.fields.strain import shortest_gauge
from rgbmidic.results import QUANTITIES, UNKNOWN_TIME, Maps, Profile, Result, ResultQuantity
from rgbmidic.results.histories import convert_history
from rgbmidic.results.quantities import FAILED
from rgbmidic.settings import ChannelSettings, ProbeSettings, ScaleSettings
from rgbmidic.tools.report.figures import field_colours, select_evenly
from rgbmidic.tools.report.painter import Overlay, Picture, palette, reference_picture
from rgbmidic.tools.report.style import colour_range, ordinary_values, time_text
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.picture import RawPictures
from rgbmidic.tools.view.url_state import EXTRA_FIELDS, UNCERTAINTY, ViewState
from rgbmidic.tools.view.widgets import warning
from rgbmidic.typing import AnyArray, FloatArray

_REASONS = ("measured", "no light sees enough texture here", "the images around it do not match", "carried over")
"""What a node's status means, under the pointer."""
_UNREADABLE = (RgbmidicError, OSError, IndexError, KeyError)
"""What a field or a raw frame that cannot be read raises."""


def palette_name(field: ResultQuantity, *, symmetric: bool) -> str:
    """Return the name of the colours that suit a field, symmetric about 0 where asked; safe for the colour-blind."""
    return "RdBu_r" if symmetric and field.is_signed else "codes" if field.codes else field_colours(field)


def range_over_test(maps: Maps, name: str) -> tuple[float, float]:
    """Return the colour range of a field over the whole test, from frames evenly spread over those measured."""
    measured_frames = np.flatnonzero(maps.result.finished).tolist()
    ranges = [
        robust_range(maps.read(name, frame))
        for frame in (select_evenly(measured_frames, VIEWER.range_frames) if measured_frames else ())
    ]
    finite_ranges = [limits for limits in ranges if limits is not None]
    return (
        (min(low for low, _ in finite_ranges), max(high for _, high in finite_ranges)) if finite_ranges else (0.0, 1.0)
    )


def element_at(
    nodes: FloatArray, elements: npt.NDArray[np.int32], x: float, y: float
) -> tuple[npt.NDArray[np.int32], FloatArray] | None:
    """Return the nodes (3,) of the element that holds a point, and their shape functions (3,); None outside."""
    xs, ys = (nodes[elements] - (x, y)).transpose(2, 0, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        areas = np.roll(xs, -1, axis=1) * np.roll(ys, 1, axis=1) - np.roll(xs, 1, axis=1) * np.roll(ys, -1, axis=1)
        shape = areas / areas.sum(axis=1, keepdims=True)  # of the triangles between the place and the opposite sides
        containing = np.flatnonzero(shape.min(axis=1) >= -1e-9)
    return (elements[containing[0]], shape[containing[0]]) if len(containing) else None


def robust_range(field_values: Field) -> tuple[float, float] | None:
    """Return the colour range of what was read without doubtful nodes and outliers; None where nothing is measured."""
    colour_values = ordinary_values(field_values.values, field_values.uncertainty)
    return colour_range(colour_values) if colour_values.size else None


class FieldsInView:
    """Fields of a result as a view asks for them; those read last are kept.

    Parameters
    ----------
    result
        The result; a run may still add to it.
    view
        What is looked at.

    Attributes
    ----------
    maps
        Fields of the result as the view derives them.
    scale
        What replaces the ``[scale]`` of the result; None: nothing.
    derivation
        How the fields are derived: what was read otherwise must be read anew.
    """

    def __init__(self, result: Result, view: ViewState) -> None:
        self.view = view
        self.scale: ScaleSettings | None = None
        self.derivation: tuple[Any, ...] = ()
        self._raw = lru_cache(VIEWER.raw_frames)(RawPictures(result=result))
        self._use_maps(Maps.from_result(result))

    def _use_maps(self, maps: Maps) -> None:
        self.maps = maps
        self._read_field, self._read_displacement = (
            lru_cache(3 * (1 + len(EXTRA_FIELDS)))(maps.read),
            lru_cache(2)(maps.displacement),
        )
        self._ahead: tuple[tuple[Any, ...], ...] = ()
        self._test_range = lru_cache(8)(partial(range_over_test, maps))

    @property
    def result(self) -> Result:
        """The result, with the frames that a run has added up to now."""
        return self.maps.result

    @property
    def base(self) -> Path:
        """Folder that the paths of the view are relative to."""
        return Path(self.result.provenance.get("base", self.result.path.parent))

    @property
    def channels(self) -> ChannelSettings:
        """``[channels]`` as it is in view."""
        return self.view.channel_settings(self.base)

    @property
    def measure(self) -> str | None:
        """Strain measure of the probes; None: the one that they state."""
        return self.view.measure if self.view.measure != MEASURES[0] else None

    def rescale(self) -> bool:
        """Take the scale of the view; returns whether it is another one."""
        scale = self.view.scale_settings(self.base, self.result.scale)
        if scale == self.scale:
            return False
        self._use_maps(Maps.from_result(self.result, scale))
        self.scale = scale
        return True

    def derive_fields(self) -> None:
        """Derive fields as the view has it."""
        view = self.view
        options: dict[str, Any] = {"gauge": view.gauge or None, "measure": view.measure, "rigid_removed": view.rigid}
        options |= {"since": None if view.since < 0 else view.since, "window": view.rate_window or None}
        if (options, self.scale) != self.derivation:
            self._use_maps(self.maps.with_options(**options))
            self.derivation = options, self.scale

    def grow(self, result: Result) -> None:
        """Go on with more frames of the result."""
        self._use_maps(self.maps.refreshed(result))

    def values(self, name: str) -> Field:
        """Read a field in the frame in view."""
        return self._read_field(name, self.view.frame)

    @property
    def displacement(self) -> Displacement:
        """Displacement (2, N) in the frame in view, px."""
        return self._read_displacement(self.view.frame)

    @property
    def deformed_nodes(self) -> FloatArray:
        """Deformed places (N, 2) of the nodes in the frame in view, px of the image."""
        return self.maps.deformed_nodes(self.view.frame)

    @property
    def node_status(self) -> AnyArray:
        """Status (N,) of the nodes in the frame in view."""
        return np.asarray(self.result.table.read(self.view.frame, ["node_status"])["node_status"])

    @property
    def names(self) -> list[str]:
        """Names of the field and of those beside it."""
        entries = [getattr(self.view, entry) for entry in EXTRA_FIELDS]
        names = [f"{self.view.field}_std" if name == UNCERTAINTY else name for name in entries]
        return [self.view.field, *(name for name in names if name in self.maps.quantities)]

    def read_ahead(self) -> None:
        """Read the next frame or the one before, whichever is not read yet, so that a step there does not wait."""
        view, result = self.view, self.result
        for frame in (view.frame + 1, view.frame - 1):
            request = (frame, view.over, *self.names)
            if not 0 <= frame < len(result) or not result.finished[frame] or request in self._ahead:
                continue
            self._ahead = (request, *self._ahead[:1])  # also where it cannot be read, which a step there reports
            with suppress(*_UNREADABLE):
                for name in self.names:
                    self._read_field(name, frame)
                if view.over == "deformed":
                    self._raw(frame)
            return

    @property
    def gauge(self) -> float:
        """Length of the virtual strain gauges, px."""
        return self.view.gauge or shortest_gauge(self.maps.physical.mesh)

    def colour_range(self, name: str, *, by_hand: bool = True, profile: Profile | None = None) -> tuple[float, float]:
        """Return the values of the first and the last colour of a field, in one frame or, `profile` a line, in all."""
        view, field = self.view, self.maps.quantities[name]
        if view.range == "hand" and by_hand:
            return view.low, view.high
        if field.fixed_range is not None:
            return field.fixed_range
        if view.range == "test":
            low, high = self._test_range(name)
        else:
            low, high = robust_range(profile.data if profile else self.values(name)) or (0.0, 1.0)
        is_symmetric = view.symmetric and field.is_signed
        return (-max(abs(low), abs(high)), max(abs(low), abs(high))) if is_symmetric else (low, high)

    def overlay(self, name: str) -> Overlay:
        """Return a field as it is painted; palette, range by hand and number of colours are those of the first."""
        view, field, values = self.view, self.maps.quantities[name], self.values(name)
        is_first = name == view.field
        field_palette = palette_name(field, symmetric=view.symmetric)
        hatch_margin = (np.abs(values.values) - 2 * values.uncertainty)[:, None]
        return Overlay.of_field(
            self.maps,
            field,
            self.nodes,
            values.values,
            colour_range=self.colour_range(name, by_hand=is_first),
            colours=palette((is_first and not field.codes and view.palette) or field_palette, view.levels),
            opacity=view.opacity,
            hatch_margin=self.maps.triangulate(field, hatch_margin)[0][:, 0] if view.hatched else None,
        )

    @property
    def nodes(self) -> FloatArray:
        """Places (N, 2) at which the nodes are drawn."""
        return self.deformed_nodes if self.view.over == "deformed" else self.result.nodes

    @cached_property
    def _reference(self) -> Picture:
        return reference_picture(self.result)

    @property
    def picture(self) -> tuple[Picture, str]:
        """Image under the fields; where a raw frame cannot be read it is the reference, and the reason is stated."""
        if self.view.over != "deformed":
            return self._reference, ""
        try:
            return self._raw(self.view.frame), ""
        except _UNREADABLE as error:
            return self._reference, f"the raw frame cannot be shown ({error}): this is the reference image"

    @property
    def extremes(self) -> tuple[int, ...]:
        """Nodes with the smallest and the largest value; none where nothing is measured, or of a status."""
        values = self.values(self.view.field).values
        if self.maps.quantities[self.view.field].codes or not np.isfinite(values).any():
            return ()
        return int(np.nanargmin(values)), int(np.nanargmax(values))

    def title(self, seconds: float) -> str:
        """Return place, name and time of the frame in view; NaN: it is not known."""
        result, frame = self.result, self.view.frame
        time = f", {time_text(seconds, np.array([seconds]))}" if math.isfinite(seconds) else ""
        return f"Frame {frame} of 0 to {len(result) - 1}: {result.names[frame]}{time}"

    def description(self, remark: str = "") -> str:
        """Describe what is in view, as HTML: the frame, how it ended, the field with its extremes, and a remark."""
        result, maps, frame, field = self.result, self.maps, self.view.frame, self.maps.quantities[self.view.field]
        record = result.table.read(frame, ["status", "reason", "node_status", "time_ns"])
        missing = float(np.mean(record["node_status"] != 0))
        is_measured = bool(result.finished[frame])
        outcome = QUANTITIES["status"].codes[record["status"]] if is_measured else "not measured yet"
        without = f", {missing:.1%} of the nodes not measured" if missing and record["status"] != FAILED else ""
        seconds = math.nan if record["time_ns"] == UNKNOWN_TIME else record["time_ns"] * 1e-9
        lines = [html.escape(self.title(seconds)), f"{outcome}{without}"]
        if record["reason"] and is_measured:
            beginning, remainder = record["reason"][: VIEWER.reason_letters], record["reason"][VIEWER.reason_letters :]
            lines[1] = warning(f"{outcome}: {beginning}")
            if remainder:
                lines[1] = f"<details><summary>{lines[1]} … more</summary>… {html.escape(remainder)}</details>"
        lines.append(f"<b>{html.escape(field.label)}</b>: {html.escape(field.description.partition(':')[0])}")
        values = self.values(field.name)
        if extreme_nodes := self.extremes:
            std = values.uncertainty
            texts = [
                f"{name} {field.format(values.values[node], std[node])} at {maps.physical.position_text(x, y)}"
                for name, node, (x, y) in zip(
                    ("smallest", "largest"), extreme_nodes, result.nodes[[*extreme_nodes]], strict=True
                )
            ]
            lines.append(html.escape(", ".join(texts)))
        elif not np.isfinite(values.values).any():
            lines.append("Nothing is measured here: choose another frame below.")
        return "<br>".join(
            [*lines, *(html.escape(text) for text in (maps.processing_note(field.name), remark) if text)]
        )

    def pointer_text(self, x: float, y: float) -> str:
        """Return the values of all fields in view at a place of the image, as HTML; where there is none, why."""
        physical, position_text = self.maps.physical, f"x {x:.1f}, y {y:.1f} px"
        if physical.axes[0] != "px":
            position_text = f"{position_text}, {physical.position_text(x, y)}"
        element = element_at(self.nodes, self.result.elements, x, y)
        if element is None:
            return f"{position_text}: &nbsp; outside the mesh"
        nodes, texts = element[0], []
        mean = Mean.over(physical.covariance, "the pointer", [element[1] @ physical.mesh.nodes[nodes]])
        for name in self.names:
            field, blank = self.maps.quantities[name], self.node_status[nodes].max()
            value, std = self._mean(field, mean)
            reason = (
                f" ({_REASONS[blank] if blank else 'a node beside it has no data'})" if not np.isfinite(value) else ""
            )
            texts.append(f"<b>{html.escape(f'{field.symbol} = {field.format(value, std)}{reason}')}</b>")
        return " &nbsp; ".join([f"{position_text}:", *dict.fromkeys(texts)])

    def probe_text(self, kind: str, position: tuple[float, ...]) -> str:
        """Return what a probe of a kind measures of the field, with its uncertainty, as its history has it.

        A probe whose history does not have the field shows its value at the centre, or its mean; see `_mean`. A
        gauge shows its extension, or over a strain its own.
        """
        maps, field = self.maps, self.maps.quantities[self.view.field]
        name = _base_name(field)
        group = maps.quantities.get(name, field).group
        if field.stepped and kind in ("line", "region", "circle"):
            return ""

        def describe(value: float, std: float, unit: str) -> str:
            quantity = replace(field, unit=unit)
            return quantity.format(value, std) if name == field.name else quantity.format(std)

        try:
            if kind == "strain_gauge" and group == "Strain":
                strain = maps.strain_at(self.view.frame, *position)[name]
                return f": {describe(float(strain.values[0]), float(strain.uncertainty[0]), field.unit)}"
            kind, position = ("point", position[:2]) if kind == "strain_gauge" else (kind, position)
            settings = ProbeSettings(measure=cast(Any, maps.physical.measure))
            probe = make_probe(maps.physical.covariance, kind, 1, position, settings, maps.physical.rectified)
        except InputError:
            return ""
        of_gauge = {"Displacement": "extension", "Strain": "strain"}.get(group) if kind == "gauge" else None
        quantity_name = of_gauge or (name if isinstance(probe, Area) and group == "Strain" else None)
        if quantity_name and maps.since is None and not maps.rigid_removed:
            displacement = Displacement.concatenate([self.displacement.isel(node=probe.nodes)])
            probe_histories = (
                entry for entry in probe.histories(displacement) if entry.name == f"{probe.name}_{quantity_name}"
            )
            for entry in (
                converted
                for history in probe_histories
                for converted in convert_history(history, maps.physical.units, None)
            ):
                if entry.std is not None:
                    return f" {of_gauge or 'mean'}: {describe(float(entry.values[0]), float(entry.std[0]), entry.unit)}"
        if not isinstance(probe, Mean):
            return ""
        value, std = self._mean(field, probe)
        limit_note = " at most" if kind != "point" and name not in maps.physical.components and np.isfinite(std) else ""
        return f"{' mean' if kind != 'point' else ''}: {field.format(value, std)}{limit_note}"

    def _mean(self, field: ResultQuantity, mean: Mean) -> tuple[float, float]:
        """Average a field over a place, as a history does, with its standard uncertainty; NaN where it has none.

        That of u and v is exact, from their displacement; the errors of other fields are taken as the same at all
        nodes, which is the most that they can add up to: gauges overlap.
        """
        name, values = _base_name(field), self.values(field.name)
        if field.stepped:
            nearest = mean.sum.weights(np.ones(len(mean.nodes), dtype=bool), linear=True)[0][0].argmax()
            return float(values.values[mean.nodes[nearest]]), math.nan
        components = {component.name: component for component in self.displacement.components}
        is_displacement = name in components
        nodal = Field.concatenate([components.get(name, values).isel(node=mean.nodes)])
        has_std = bool(np.isfinite(nodal.uncertainty).any())
        has_data = np.isfinite(nodal.values + (nodal.uncertainty if has_std else 0))
        weights = mean.weights(has_data, linear=not (is_displacement or field.is_signed))[0][:, 0]
        average = (mean.average if is_displacement else mean.average_bound)(weights, nodal)
        average = self.maps.physical.units.convert(average) if is_displacement else average
        (value,), (std,) = average.values, average.uncertainty
        if is_displacement and name != field.name:
            return float(std), math.nan
        return float(value), float(std) if has_std else math.nan


def _base_name(field: ResultQuantity) -> str:
    """Return the name of a field, or of that whose uncertainty it is."""
    return field.name.removesuffix("_std")
