"""The fields that a view asks for, read from a result; those read last are kept."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.fields import MEASURES
from rgbmidic.fields.strain import shortest_gauge
from rgbmidic.results import Maps, MapValues, Profile, Result
from rgbmidic.settings import ChannelSettings, ScaleSettings
from rgbmidic.typing import FloatArray
from rgbmidic.view.address import BESIDE, UNCERTAINTY, ViewState
from rgbmidic.view.picture import (
    FieldInFrame,
    Overlay,
    Picture,
    Pictures,
    palette,
    palette_name,
    range_of_test,
    robust_range,
)


class ShownFields:
    """Fields of a result as a view asks for them.

    Parameters
    ----------
    result
        The result; a run may still add to it.
    view
        What is looked at.

    Attributes
    ----------
    maps, pictures
        Fields of the result as the view derives them, and the images under them.
    scale
        What replaces the ``[scale]`` of the result; None: nothing.
    changes, chosen
        What tells that all must be read anew: frames that were added, and another way to derive the fields.
    """

    def __init__(self, result: Result, view: ViewState) -> None:
        self.result, self.view = result, view
        self.scale: ScaleSettings | None = None
        self.maps, self.pictures, self.changes = Maps.of(result), Pictures(result=result), 0
        self.chosen: tuple[Any, ...] = ()
        self._read = lru_cache(4)(lambda name, frame, changes, chosen: self.maps.read(name, frame))
        self._moved = lru_cache(2)(lambda frame, changes, chosen: self.maps.displacement(frame))
        self._test_range = lru_cache(8)(lambda name, changes, chosen: range_of_test(self.maps, name))

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
        self.maps, self.scale = Maps.of(self.result, scale), scale
        return True

    def choose(self) -> None:
        """Derive fields as the view has it."""
        view = self.view
        chosen = (view.gauge, view.measure, view.since, view.rigid, view.rate_window, self.scale)
        if chosen != self.chosen:
            self.maps = self.maps.chosen(
                gauge=view.gauge or None,
                measure=view.measure,
                since=None if view.since < 0 else view.since,
                rigid_removed=view.rigid,
                window=view.rate_window or None,
            )
            self.chosen = chosen

    def grow(self, result: Result) -> None:
        """Go on with more frames of the result."""
        self.result, self.maps, self.changes = result, replace(self.maps, result=result), self.changes + 1

    def values(self, name: str) -> MapValues:
        """Read a field in the frame in view."""
        read: MapValues = self._read(name, self.view.frame, self.changes, self.chosen)
        return read

    @property
    def displacement(self) -> FloatArray:
        """u, v and their uncertainties (4, N) in the frame in view, px."""
        moved: FloatArray = self._moved(self.view.frame, self.changes, self.chosen)
        return moved

    @property
    def names(self) -> list[str]:
        """Names of the field and of those beside it."""
        asked = [getattr(self.view, entry) for entry in BESIDE]
        named = [f"{self.view.field}_std" if name == UNCERTAINTY else name for name in asked]
        return [self.view.field, *(name for name in named if name in self.maps.all)]

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
            low, high = self._test_range(name, self.changes, self.chosen)
        else:
            low, high = robust_range(along or self.values(name)) or (0.0, 1.0)
        even = view.symmetric and field.signed
        return (-max(abs(low), abs(high)), max(abs(low), abs(high))) if even else (low, high)

    def overlay(self, name: str) -> Overlay:
        """Return a field as it is painted; palette, range by hand and number of colours are those of the first."""
        view, field, values, first = self.view, self.maps.all[name], self.values(name), name == self.view.field
        suits = palette_name(field, symmetric=view.symmetric)
        return Overlay(
            nodes=self.nodes,
            elements=self.result.elements,
            values=values.values,
            ends=self.ends(name, by_hand=first),
            colours=palette((first and not field.codes and view.palette) or suits, view.levels),
            opacity=view.opacity,
            stepped=field.stepped,
            beyond=np.abs(values.values) - 2 * values.std if view.hatched else None,
        )

    @property
    def nodes(self) -> FloatArray:
        """Places (N, 2) at which the nodes are drawn."""
        return self.values(self.view.field).moved if self.view.over == "deformed" else self.result.nodes

    @property
    def picture(self) -> tuple[Picture, str]:
        """Image under the fields, and what is to be said of it."""
        return self.pictures.frame(self.view.frame) if self.view.over == "deformed" else (self.pictures.reference, "")

    def text_at(self, x: float, y: float) -> str:
        """Return the values of all fields in view at a place of the image, as HTML."""
        told = dict.fromkeys(self.read(name).pointer_text(self.nodes, x, y) for name in self.names)
        physical, place = self.maps.physical, f"x {x:.1f}, y {y:.1f} px"
        if physical.axes[0] != "px":
            place = f"{place}, {physical.place_text(x, y)}"
        return " &nbsp; ".join([f"{place}:", *told])

    def read(self, name: str) -> FieldInFrame:
        """Read a field in the frame in view, for texts on it."""
        field, values = self.maps.all[name], self.values(name)
        return FieldInFrame(maps=self.maps, field=field, values=values, moved=self.displacement, frame=self.view.frame)
