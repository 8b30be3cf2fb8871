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

from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.fields import MEASURES, Area, Mean, Nodal, make_probe
from rgbmidic.fields.strain import shortest_gauge
from rgbmidic.report.figures import field_colours, spread
from rgbmidic.report.style import time_text
from rgbmidic.results import QUANTITIES, UNKNOWN_TIME, Maps, MapValues, Profile, Quantity, Result
from rgbmidic.results.histories import in_units
from rgbmidic.results.quantities import FAILED
from rgbmidic.settings import ChannelSettings, ProbeSettings, ScaleSettings
from rgbmidic.typing import FloatArray
from rgbmidic.view.address import BESIDE, UNCERTAINTY, ViewState
from rgbmidic.view.constants import VIEWER
from rgbmidic.view.models import warning
from rgbmidic.view.picture import Overlay, Picture, RawPictures, element_at, palette, reference_picture, robust_range

_REASONS = ("measured", "no light sees enough texture here", "the images around it do not match", "carried over")
"""What a node's status means, under the pointer."""
_UNREADABLE = (RgbmidicError, OSError, IndexError, KeyError)
"""What a field or a raw frame that cannot be read raises."""


def palette_name(field: Quantity, *, symmetric: bool) -> str:
    """Return the name of the colours that suit a field, symmetric about 0 where asked; safe for the colour-blind."""
    return "RdBu_r" if symmetric and field.signed else "codes" if field.codes else field_colours(field)


def range_of_test(maps: Maps, name: str) -> tuple[float, float]:
    """Return the colour range of a field over the whole test, from frames evenly spread over those measured."""
    there = np.flatnonzero(maps.result.finished).tolist()
    ends = [robust_range(maps.read(name, frame)) for frame in (spread(there, VIEWER.range_frames) if there else ())]
    measured = [pair for pair in ends if pair is not None]
    return (min(low for low, _ in measured), max(high for _, high in measured)) if measured else (0.0, 1.0)


class ShownFields:
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
    chosen
        How the fields are derived: what was read otherwise must be read anew.
    """

    def __init__(self, result: Result, view: ViewState) -> None:
        self.result, self.view = result, view
        self.scale: ScaleSettings | None = None
        self.chosen: tuple[Any, ...] = ()
        self._raw = lru_cache(VIEWER.raw_frames)(RawPictures(result=result))
        self._take(Maps.of(result))

    def _take(self, maps: Maps) -> None:
        self.maps = maps
        self._read, self._moved = lru_cache(3 * (1 + len(BESIDE)))(maps.read), lru_cache(2)(maps.displacement)
        self._ahead: tuple[tuple[Any, ...], ...] = ()
        self._test_range = lru_cache(8)(partial(range_of_test, maps))

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
        scale = self.view.scale_settings(self.base, self.result.section(ScaleSettings))
        if scale == self.scale:
            return False
        self._take(Maps.of(self.result, scale))
        self.scale = scale
        return True

    def choose(self) -> None:
        """Derive fields as the view has it."""
        view = self.view
        options: dict[str, Any] = {"gauge": view.gauge or None, "measure": view.measure, "rigid_removed": view.rigid}
        options |= {"since": None if view.since < 0 else view.since, "window": view.rate_window or None}
        if (options, self.scale) != self.chosen:
            self._take(self.maps.chosen(**options))
            self.chosen = options, self.scale

    def grow(self, result: Result) -> None:
        """Go on with more frames of the result."""
        self.result = result
        self._take(replace(self.maps, result=result))

    def values(self, name: str) -> MapValues:
        """Read a field in the frame in view."""
        return self._read(name, self.view.frame)

    @property
    def displacement(self) -> FloatArray:
        """u, v and their uncertainties (4, N) in the frame in view, px."""
        return self._moved(self.view.frame)

    @property
    def names(self) -> list[str]:
        """Names of the field and of those beside it."""
        asked = [getattr(self.view, entry) for entry in BESIDE]
        named = [f"{self.view.field}_std" if name == UNCERTAINTY else name for name in asked]
        return [self.view.field, *(name for name in named if name in self.maps.all)]

    def read_ahead(self) -> None:
        """Read the next frame or the one before, whichever is not read yet, so that a step there does not wait."""
        view, result = self.view, self.result
        for frame in (view.frame + 1, view.frame - 1):
            wanted = (frame, view.over, *self.names)
            if not 0 <= frame < len(result) or not result.finished[frame] or wanted in self._ahead:
                continue
            self._ahead = (wanted, *self._ahead[:1])  # also where it cannot be read, which a step there reports
            with suppress(*_UNREADABLE):
                for name in self.names:
                    self._read(name, frame)
                if view.over == "deformed":
                    self._raw(frame)
            return

    @property
    def gauge(self) -> float:
        """Length of the virtual strain gauges, px."""
        return self.view.gauge or shortest_gauge(self.maps.physical.mesh)

    def ends(self, name: str, *, by_hand: bool = True, along: Profile | None = None) -> tuple[float, float]:
        """Return the values of the first and the last colour of a field, in one frame or, `along` a line, in all."""
        view, field = self.view, self.maps.all[name]
        if view.range == "hand" and by_hand:
            return view.low, view.high
        if field.ends is not None:
            return field.ends
        if view.range == "test":
            low, high = self._test_range(name)
        else:
            low, high = robust_range(along or self.values(name)) or (0.0, 1.0)
        even = view.symmetric and field.signed
        return (-max(abs(low), abs(high)), max(abs(low), abs(high))) if even else (low, high)

    def overlay(self, name: str) -> Overlay:
        """Return a field as it is painted; palette, range by hand and number of colours are those of the first."""
        view, field, values, first = self.view, self.maps.all[name], self.values(name), name == self.view.field
        suits = palette_name(field, symmetric=view.symmetric)
        painted, elements = self.maps.drawn(field, np.column_stack([self.nodes, values.values]))
        beyond = (np.abs(values.values) - 2 * values.std)[:, None]
        return Overlay(
            nodes=painted[:, :2],
            elements=elements,
            values=np.ascontiguousarray(painted[:, 2]),
            ends=self.ends(name, by_hand=first),
            colours=palette((first and not field.codes and view.palette) or suits, view.levels),
            opacity=view.opacity,
            stepped=field.stepped,
            beyond=self.maps.drawn(field, beyond)[0][:, 0] if view.hatched else None,
        )

    @property
    def nodes(self) -> FloatArray:
        """Places (N, 2) at which the nodes are drawn."""
        return self.values(self.view.field).moved if self.view.over == "deformed" else self.result.nodes

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
        if self.maps.all[self.view.field].codes or not np.isfinite(values).any():
            return ()
        return int(np.nanargmin(values)), int(np.nanargmax(values))

    def title(self, seconds: float) -> str:
        """Return place, name and time of the frame in view; NaN: it is not known."""
        result, place = self.result, self.view.frame
        time = f", {time_text(seconds, np.array([seconds]))}" if math.isfinite(seconds) else ""
        return f"Frame {place} of 0 to {len(result) - 1}: {result.names[place]}{time}"

    def text(self, remark: str = "") -> str:
        """Describe what is in view, as HTML: the frame, how it ended, the field with its extremes, and a remark."""
        result, maps, frame, field = self.result, self.maps, self.view.frame, self.maps.all[self.view.field]
        read = next(result.table.each(["status", "reason", "node_status", "time_ns"], [frame]))
        missing = float(np.mean(read["node_status"] != 0))
        measured = bool(result.finished[frame])
        end = QUANTITIES["status"].codes[read["status"]] if measured else "not measured yet"
        without = f", {missing:.1%} of the nodes not measured" if missing and read["status"] != FAILED else ""
        seconds = math.nan if read["time_ns"] == UNKNOWN_TIME else read["time_ns"] * 1e-9
        lines = [html.escape(self.title(seconds)), f"{end}{without}"]
        if read["reason"] and measured:
            first, rest = read["reason"][: VIEWER.reason_letters], read["reason"][VIEWER.reason_letters :]
            lines[1] = warning(f"{end}: {first}")
            if rest:
                lines[1] = f"<details><summary>{lines[1]} … more</summary>… {html.escape(rest)}</details>"
        lines.append(f"<b>{html.escape(field.label)}</b>: {html.escape(field.meaning.partition(':')[0])}")
        values = self.values(field.name)
        if found := self.extremes:
            ends = [
                f"{name} {field.text(values.values[node], values.std[node])} at {maps.physical.place_text(x, y)}"
                for name, node, (x, y) in zip(("smallest", "largest"), found, result.nodes[[*found]], strict=True)
            ]
            lines.append(html.escape(", ".join(ends)))
        elif not np.isfinite(values.values).any():
            lines.append("Nothing is measured here: choose another frame below.")
        return "<br>".join([*lines, *(html.escape(text) for text in (maps.how(field.name), remark) if text)])

    def text_at(self, x: float, y: float) -> str:
        """Return the values of all fields in view at a place of the image, as HTML; where there is none, why."""
        physical, place = self.maps.physical, f"x {x:.1f}, y {y:.1f} px"
        if physical.axes[0] != "px":
            place = f"{place}, {physical.place_text(x, y)}"
        found = element_at(self.nodes, self.result.elements, x, y)
        if found is None:
            return f"{place}: &nbsp; outside the mesh"
        nodes, told = found[0], []
        mean = Mean.over(physical.covariance, "the pointer", [found[1] @ physical.mesh.nodes[nodes]])
        for name in self.names:
            field, blank = self.maps.all[name], self.values(name).status[nodes].max()
            value, std = self._mean(field, mean)
            why = f" ({_REASONS[blank] if blank else 'a node beside it has no data'})" if not np.isfinite(value) else ""
            told.append(f"<b>{html.escape(f'{field.symbol} = {field.text(value, std)}{why}')}</b>")
        return " &nbsp; ".join([f"{place}:", *dict.fromkeys(told)])

    def probe_text(self, kind: str, place: tuple[float, ...]) -> str:
        """Return what a probe of a kind measures of the field, with its uncertainty, as its history has it.

        A probe whose history does not have the field shows its value at the centre, or its mean; see `_mean`. A
        gauge shows its extension, or over a strain its own.
        """
        maps, field = self.maps, self.maps.all[self.view.field]
        name = _measured(field)
        group = maps.all.get(name, field).group
        if field.stepped and kind in ("line", "region", "circle"):
            return ""

        def stated(value: float, std: float, unit: str) -> str:
            shown = replace(field, unit=unit)
            return shown.text(value, std) if name == field.name else shown.text(std)

        try:
            if kind == "strain_gauge" and group == "Strain":
                read = maps.strain_at(self.view.frame, *place)
                return f": {stated(float(read[name][0]), float(read[f'{name}_std'][0]), field.unit)}"
            kind, place = ("point", place[:2]) if kind == "strain_gauge" else (kind, place)
            settings = ProbeSettings(measure=cast(Any, maps.physical.measure))
            probe = make_probe(maps.physical.covariance, kind, 1, place, settings, maps.physical.rectified)
        except InputError:
            return ""
        of_gauge = {"Displacement": "extension", "Strain": "strain"}.get(group) if kind == "gauge" else None
        wanted = of_gauge or (name if isinstance(probe, Area) and group == "Strain" else None)
        if wanted and maps.since is None and not maps.rigid_removed:
            moved = self.displacement[:, None, probe.nodes]
            part = Nodal.of(moved)
            whole = (one for one in probe.histories(part) if one.name == f"{probe.name}_{wanted}")
            for one in (read for history in whole for read in in_units(history, maps.physical.units, None)):
                if one.std is not None:
                    return f" {of_gauge or 'mean'}: {stated(float(one.values[0]), float(one.std[0]), one.unit)}"
        if not isinstance(probe, Mean):
            return ""
        value, std = self._mean(field, probe)
        most = " at most" if kind != "point" and name not in ("u", "v") and np.isfinite(std) else ""
        return f"{' mean' if kind != 'point' else ''}: {field.text(value, std)}{most}"

    def _mean(self, field: Quantity, mean: Mean) -> tuple[float, float]:
        """Average a field over a place, as a history does, with its standard uncertainty; NaN where it has none.

        That of u and v is exact, from their displacement; the errors of other fields are taken as the same at all
        nodes, which is the most that they can add up to: gauges overlap.
        """
        name, values = _measured(field), self.values(field.name)
        if field.stepped:
            nearest = mean.sum.weights(np.ones(len(mean.nodes), dtype=bool), linear=True)[0][0].argmax()
            return float(values.values[mean.nodes[nearest]]), math.nan
        exact = name in ("u", "v")
        read = self.displacement["uv".index(name) :: 2] if exact else np.stack([values.values, values.std])
        of_nodes, stds, *bias = read[:, None, mean.nodes]
        stated = bool(np.isfinite(stds).any())
        has_data = np.isfinite(of_nodes + (stds if stated else 0))
        weights, _ = mean.weights(has_data, linear=not (exact or field.signed))
        pair = mean.average(weights[:, 0], of_nodes, stds, *bias)
        (value,), (std,) = self.maps.physical.units.lengths(*pair) if exact else pair
        if exact and name != field.name:
            return float(std), math.nan
        return float(value), float(std) if stated else math.nan


def _measured(field: Quantity) -> str:
    """Return the name of a field, or of that whose uncertainty it is."""
    return field.name.removesuffix("_std")
