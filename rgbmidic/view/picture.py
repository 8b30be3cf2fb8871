"""Picture of a field on the screen: window of the image, resampling, colours, elements.

Nodal fields of a result with units and colour ranges, the images under them, texts on a frame and a place.
"""

from __future__ import annotations

import html
import logging
import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from typing import Any, TypeVar, cast

import cv2
import numpy as np
import numpy.typing as npt
from bokeh.document import Document

from rgbmidic._kernels.picture import paint_field
from rgbmidic.errors import FrameError, InputError, RgbmidicError
from rgbmidic.fields import Area, Mean, Nodal, make_probe
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.series import FrameSeries, open_series
from rgbmidic.report.figures import field_colours, spread
from rgbmidic.report.style import STATUS_COLOURS, colour_range, ordinary_values, resampled, time_text
from rgbmidic.results import QUANTITIES, UNKNOWN_TIME, Maps, MapValues, Profile, Quantity, Result
from rgbmidic.results.histories import in_units
from rgbmidic.results.quantities import FAILED
from rgbmidic.settings import ProbeSettings, TestSettings
from rgbmidic.typing import AnyArray, FloatArray
from rgbmidic.view.constants import VIEWER

logger = logging.getLogger(__name__)

Picture = npt.NDArray[np.uint8]
"""A grey picture (H, W)."""

AROUND = {False: 235, True: 30}
"""Grey level outside the image, by whether the page is dark."""
_SIDES, _APART = ("#010203", "#ffffff"), 8
"""Colours of what lies below and above 0, of which the first is no grey, and pixels from one hatch to the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """The part of the image that the screen shows.

    Attributes
    ----------
    left, top, right, bottom
        Edges in px of the image, where the centre of the first pixel is (0, 0).
    width, height
        Pixels of the screen.
    """

    left: float
    top: float
    right: float
    bottom: float
    width: int
    height: int

    @property
    def edges(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom."""
        return self.left, self.top, self.right, self.bottom

    def fitted(self) -> Window:
        """Widen the window to as many screen pixels per px in both directions, about the same centre."""
        step = max((self.right - self.left) / self.width, (self.bottom - self.top) / self.height)
        x, y = (self.left + self.right) / 2, (self.top + self.bottom) / 2
        half_x, half_y = step * self.width / 2, step * self.height / 2
        return replace(self, left=x - half_x, top=y - half_y, right=x + half_x, bottom=y + half_y)

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the picture."""
        shrink = max(1.0, (self.width * self.height / VIEWER.picture_pixels) ** 0.5)
        return max(int(self.height / shrink), 2), max(int(self.width / shrink), 2)

    @property
    def steps(self) -> tuple[float, float]:
        """Px of the image to a pixel of the picture, along x and y."""
        rows, columns = self.size
        return (self.right - self.left) / columns, (self.bottom - self.top) / rows

    def place(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return column and row of points (N, 2) in the picture."""
        across, down = self.steps
        return (points[:, 0] - self.left) / across - 0.5, (points[:, 1] - self.top) / down - 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlay:
    """A nodal field as it is painted over an image.

    Attributes
    ----------
    nodes : ndarray, shape (N, 2)
        Places of the nodes in px.
    elements : ndarray, shape (E, 3)
        Nodes of the triangles.
    values : ndarray, shape (N,)
        Values at the nodes; triangles with a NaN are not painted.
    ends
        Values of the first and the last colour.
    colours
        As ``"#rrggbb"``.
    opacity
        Opacity of the field, from 0 to 1.
    stepped
        Whether values between those of two nodes mean nothing.
    beyond : ndarray, shape (N,), or None
        What is hatched where it is below 0; None: nothing.
    """

    nodes: FloatArray
    elements: npt.NDArray[np.int32]
    values: FloatArray
    ends: tuple[float, float]
    colours: tuple[str, ...]
    opacity: float = 1.0
    stepped: bool = False
    beyond: FloatArray | None = None


def paint(window: Window, picture: AnyArray, over: Overlay | None = None, around: int = 40) -> npt.NDArray[np.uint32]:
    """Paint a grey picture, and a field over it, as the window shows them.

    Parameters
    ----------
    window
        Part of the image and size of the screen.
    picture : ndarray, shape (H, W), uint8
        The image.
    over
        The field; None: the picture alone.
    around
        Grey level outside the image.

    Returns
    -------
    ndarray, shape (rows, columns), uint32
        Red, green, blue, 255, the lowest byte first; the first row is the top.
    """
    first = (window.left + window.steps[0] / 2, window.top + window.steps[1] / 2)
    grey = resampled(picture, window.steps, first, window.size, around, nearest=min(window.steps) <= 0.5)
    if over is None:
        return grey * np.uint32(0x010101) | np.uint32(0xFF000000)
    out = np.empty(grey.shape, dtype=np.uint32)
    (x, y), grey_part = window.place(over.nodes), round(256 * (1 - over.opacity))
    packed = _packed(over.colours, grey_part)
    paint_field(out, grey, x, y, over.elements, over.values, *map(float, over.ends), packed, grey_part, over.stepped)
    if over.beyond is not None:
        below, lines = np.empty_like(out), sum(np.indices(out.shape)) % _APART < 2
        reach = float(np.nanmax(np.abs(over.beyond), initial=0)) or 1.0
        paint_field(below, grey, x, y, over.elements, over.beyond, -reach, reach, _packed(_SIDES, 0), 0, False)
        out[lines & (below == _packed(_SIDES, 0)[0])] = 0xFF000000
    return out


@cache
def _packed(colours: tuple[str, ...], grey_part: int) -> npt.NDArray[np.uint32]:
    rgb = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in colours], dtype=np.uint32)
    red, green, blue = (rgb * (256 - grey_part) >> 8).T
    return np.asarray(red | green << 8 | blue << 16 | 0xFF000000, dtype=np.uint32)


def palette_name(field: Quantity, *, symmetric: bool) -> str:
    """Return the name of the colours that suit a field, symmetric about 0 where asked; safe for the colour-blind."""
    return "RdBu_r" if symmetric and field.signed else "codes" if field.codes else field_colours(field)


@cache
def palette(name: str, levels: int = 256) -> tuple[str, ...]:
    """Return so many colours of a palette, up to 256 as a screen has levels, as ``"#rrggbb"``."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    places = np.linspace(0, 1, min(max(levels, 2), 256))
    return STATUS_COLOURS if name == "codes" else tuple(map(to_hex, colormaps[name](places)))


def grey_picture(frame: Mosaic | ChannelFrame) -> Picture:
    """Return a raw frame as one stretched picture: the mean of its channels, or of the cell around each sample."""
    if isinstance(frame, Mosaic):
        return stretched(cv2.blur(frame.values.astype(np.float32), (2, 2)))
    return stretched(frame.values.mean(axis=0, dtype=np.float32))


@dataclass(frozen=True, kw_only=True, eq=False)
class RawPictures:
    """Pictures of the raw frames of a result, read where they still exist; picklable until the first is read.

    Attributes
    ----------
    result
        The result.
    """

    result: Result

    @cached_property
    def _series(self) -> FrameSeries:
        provenance = self.result.provenance
        if "settings" not in provenance:
            raise FrameError(
                f"{self.result.path} does not state where its raw frames are: it was not measured from files"
            )
        settings = TestSettings.from_mapping(provenance["settings"], provenance["base"])
        return open_series(settings.frames, settings.base)

    def __call__(self, index: int) -> Picture:
        """Read the frame of an index in the result; errors as those of the frames' reader."""
        return grey_picture(self._series.read(self._series.chosen[index])[0])


def stretched(image: AnyArray) -> Picture:
    """Stretch an image (H, W) between its 1 % and 99 % quantiles, of every fourth pixel, to 0 to 255; NaN is 0."""
    finite = image[::4, ::4][np.isfinite(image[::4, ::4])]
    low, high = np.percentile(finite, [1, 99]) if finite.size else (0.0, 1.0)
    return np.asarray(np.clip(255 * (np.nan_to_num(image) - low) / max(high - low, 1e-6), 0, 255), dtype=np.uint8)


def element_at(
    nodes: FloatArray, elements: npt.NDArray[np.int32], x: float, y: float
) -> tuple[npt.NDArray[np.int32], FloatArray] | None:
    """Return the nodes (3,) of the element that holds a point, and their shape functions (3,); None outside."""
    a, b, c = (nodes[elements[:, corner]] for corner in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        area = _cross(b - a, c - a)
        second, third = _cross(np.array([x, y]) - a, c - a) / area, _cross(b - a, np.array([x, y]) - a) / area
        inside = np.flatnonzero(np.minimum(np.minimum(second, third), 1 - second - third) >= -1e-9)
    if not len(inside):
        return None
    e = inside[0]
    return elements[e], np.array([1 - second[e] - third[e], second[e], third[e]])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


T = TypeVar("T")
_REASONS = ("measured", "no light sees enough texture here", "the images around it do not match", "carried over")
"""What a node's status means, under the pointer."""


def range_of_test(maps: Maps, name: str) -> tuple[float, float]:
    """Return the colour range of a field over the whole test, from frames evenly spread over those measured."""
    there = np.flatnonzero(maps.result.finished).tolist()
    ends = [robust_range(maps.read(name, frame)) for frame in (spread(there, VIEWER.range_frames) if there else ())]
    measured = [pair for pair in ends if pair is not None]
    return (min(low for low, _ in measured), max(high for _, high in measured)) if measured else (0.0, 1.0)


def robust_range(read: MapValues | Profile) -> tuple[float, float] | None:
    """Return the colour range of what was read without doubtful nodes and outliers; None where nothing is measured."""
    ordinary = ordinary_values(read.values, read.std)
    return colour_range(ordinary) if ordinary.size else None


@dataclass(frozen=True, kw_only=True, eq=False)
class Pictures:
    """Images under the fields: the reference that the result keeps, and the raw frames, where they still exist.

    Attributes
    ----------
    result
        The result.
    """

    result: Result

    @cached_property
    def reference(self) -> Picture:
        """Mean of the lights' reference images, grey where none was kept."""
        images, (left, top) = self.result.reference, self.result.reference_origin
        columns, rows = np.ceil(self.result.nodes.max(axis=0) + 1).astype(int)
        picture = np.full(self.result.frame_shape or (rows, columns), 60, dtype=np.uint8)
        if images is not None:
            picture[top : top + images.shape[1], left : left + images.shape[2]] = images.mean(axis=0)
        return picture

    def frame(self, place: int) -> tuple[Picture, str]:
        """Return the raw frame of an index in the result; where it cannot be read, the reference and the reason."""
        try:
            return self._read(place), ""
        except (RgbmidicError, OSError, IndexError, KeyError) as error:
            return self.reference, f"the raw frame cannot be shown ({error}): this is the reference image"

    @cached_property
    def _read(self) -> Callable[[int], Picture]:
        return lru_cache(VIEWER.raw_frames)(RawPictures(result=self.result))


def warning(text: str) -> str:
    """Return a remark as HTML that stands out."""
    return f'<b style="color:var(--warn)">{html.escape(text)}</b>'


def guarded(act: Callable[[], object], complain: Callable[[str], None]) -> None:
    """Call `act`; an error is reported in one line by `complain`, and the page goes on."""
    try:
        act()
    except (RgbmidicError, OSError) as error:
        complain(str(error))
    except Exception as error:  # the last resort of a page
        logger.exception("the page failed")
        complain(f"{type(error).__name__}: {error}")


def watched(document: Document) -> bool:
    """Return whether a browser shows the page: one that was left exists for a while, and shall do nothing more."""
    session = document.session_context.session if document.session_context else None
    return session is None or session.connection_count > 0


def every(milliseconds: int, document: Document, act: Callable[[], None], complain: Callable[[str], None]) -> None:
    """Call `act`, as `guarded`, again and again while a browser shows the page."""
    document.add_periodic_callback(lambda: guarded(act, complain) if watched(document) else None, milliseconds)


class Background:
    """Work for a page in another thread, one task after the other, of which only the last that was asked for counts.

    Parameters
    ----------
    document
        Document of the page.
    """

    def __init__(self, document: Document) -> None:
        self._document, self._thread, self._task = document, ThreadPoolExecutor(1), Future[Any]()
        document.on_session_destroyed(lambda context: self._thread.shutdown(wait=False, cancel_futures=True))

    def drop(self) -> None:
        """Forget the task that was asked for."""
        self._task.cancel()
        self._task = Future()

    def ask(self, work: Callable[[], T], take: Callable[[Callable[[], T]], None]) -> None:
        """Start a task; `take` gets the function that returns its result or raises its error, in the page's thread."""
        self.drop()
        task = self._task = self._thread.submit(work)
        taken = lambda: take(task.result) if task is self._task else None  # noqa: E731
        task.add_done_callback(lambda _: self._document.add_next_tick_callback(taken))


def frame_title(result: Result, place: int, seconds: float) -> str:
    """Return a frame's place, name and time; NaN: it is not known."""
    time = f", {time_text(seconds, np.array([seconds]))}" if math.isfinite(seconds) else ""
    return f"Frame {place} of 0 to {len(result) - 1}: {result.names[place]}{time}"


def frame_text(maps: Maps, place: int, field: Quantity, values: MapValues, remark: str) -> str:
    """Describe what is in view, as HTML: the frame, how it ended, the field with its extremes, and a remark."""
    result = maps.result
    read = next(result.table.each(["status", "reason", "node_status", "time_ns"], [place]))
    missing = float(np.mean(read["node_status"] != 0))
    measured = bool(result.finished[place])
    end = QUANTITIES["status"].codes[read["status"]] if measured else "not measured yet"
    without = f", {missing:.1%} of the nodes not measured" if missing and read["status"] != FAILED else ""
    seconds = math.nan if read["time_ns"] == UNKNOWN_TIME else read["time_ns"] * 1e-9
    lines = [html.escape(frame_title(result, place, seconds)), f"{end}{without}"]
    if read["reason"] and measured:
        first, rest = read["reason"][: VIEWER.reason_letters], read["reason"][VIEWER.reason_letters :]
        lines[1] = warning(f"{end}: {first}")
        if rest:
            lines[1] = f"<details><summary>{lines[1]} … more</summary>… {html.escape(rest)}</details>"
    lines.append(f"<b>{html.escape(field.label)}</b>: {html.escape(field.meaning.partition(':')[0])}")
    found = extremes(field, values)
    if found:
        ends = [
            f"{name} {field.text(values.values[node], values.std[node])} at {maps.physical.place_text(x, y)}"
            for name, node, (x, y) in zip(("smallest", "largest"), found, result.nodes[[*found]], strict=True)
        ]
        lines.append(html.escape(", ".join(ends)))
    elif not np.isfinite(values.values).any():
        lines.append("Nothing is measured here: choose another frame below.")
    lines += [html.escape(text) for text in [maps.how(field.name)] if text]
    return "<br>".join([*lines, *([html.escape(remark)] if remark else [])])


def extremes(field: Quantity, values: MapValues) -> tuple[int, ...]:
    """Return the nodes with the smallest and the largest value; none where nothing is measured, or of a status."""
    if field.codes or not np.isfinite(values.values).any():
        return ()
    return int(np.nanargmin(values.values)), int(np.nanargmax(values.values))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FieldInFrame:
    """A field in one frame, as it is stated under the pointer and at probes.

    Attributes
    ----------
    maps, field, values, frame
        The fields of the result, which one it is, what was read of it, and the index of the frame.
    moved : ndarray, shape (4, N)
        As `Maps.displacement` returns it.
    """

    maps: Maps
    field: Quantity
    values: MapValues
    moved: FloatArray
    frame: int

    @property
    def measured(self) -> str:
        """Name of the field, or of that whose uncertainty it is."""
        return self.field.name.removesuffix("_std")

    def pointer_text(self, nodes: FloatArray, x: float, y: float) -> str:
        """Return the value at a place over nodes (N, 2), as HTML; where there is none, why."""
        found = element_at(nodes, self.maps.result.elements, x, y)
        if found is None:
            return "outside the mesh"
        corners, weights = found[0].astype(np.int64), found[1]
        correlation, least = self.maps.physical.covariance.part(corners), VIEWER.least_weight
        mean = Mean(name="", nodes=corners, weights=weights, correlation=correlation, least=least)
        value, std = self.mean_of(mean)
        text = f"{self.field.symbol} = {self.field.text(value, std)}"
        blank = self.values.status[corners].max()
        if not np.isfinite(value):
            text += f" ({_REASONS[blank] if blank else 'a node beside it has no data'})"
        return f"<b>{html.escape(text)}</b>"

    def probe_text(self, kind: str, place: tuple[float, ...]) -> str:
        """Return what a probe of a kind measures of the field, with its uncertainty, as its history has it.

        A probe whose history does not have the field shows its value at the centre, or its mean; see `mean_of`. A
        gauge shows its extension, or over a strain its own.
        """
        maps, name = self.maps, self.measured
        group = maps.all.get(name, self.field).group
        strain = group == "Strain"
        if self.field.stepped and kind in ("line", "region", "circle"):
            return ""
        try:
            if kind == "strain_gauge" and strain:
                read = maps.strain_at(self.frame, *place)
                return f": {self._told(float(read[name][0]), float(read[f'{name}_std'][0]), self.field.unit)}"
            kind, place = ("point", place[:2]) if kind == "strain_gauge" else (kind, place)
            stated = ProbeSettings(measure=cast(Any, maps.physical.measure))
            probe = make_probe(maps.physical.covariance, kind, 1, place, stated, maps.physical.rectified)
        except InputError:
            return ""
        of_gauge = {"Displacement": "extension", "Strain": "strain"}.get(group) if kind == "gauge" else None
        wanted = of_gauge or (name if isinstance(probe, Area) and strain else None)
        if wanted and maps.since is None and not maps.rigid_removed:
            part = Nodal(**dict(zip(("u", "v", "u_std", "v_std"), self.moved[:, None, probe.nodes], strict=True)))
            whole = (one for one in probe.histories(part) if one.name == f"{probe.name}_{wanted}")
            for one in (read for history in whole for read in in_units(history, maps.physical.units, None)):
                if one.std is not None:
                    return f" {of_gauge or 'mean'}: {self._told(float(one.values[0]), float(one.std[0]), one.unit)}"
        if not isinstance(probe, Mean):
            return ""
        value, std = self.mean_of(probe)
        most = " at most" if kind != "point" and name not in ("u", "v") and np.isfinite(std) else ""
        return f"{' mean' if kind != 'point' else ''}: {self.field.text(value, std)}{most}"

    def _told(self, value: float, std: float, unit: str) -> str:
        """State a value, or where the field is an uncertainty that of the value."""
        stated = replace(self.field, unit=unit)
        return stated.text(value, std) if self.measured == self.field.name else stated.text(std)

    def mean_of(self, mean: Mean) -> tuple[float, float]:
        """Average the field over a place, as a history does, with its standard uncertainty; NaN where it has none.

        That of u and v is exact, from their displacement; the errors of other fields are taken as the same at all
        nodes, which is the most that they can add up to: gauges overlap.
        """
        name, values = self.measured, self.values
        if self.field.stepped:
            return float(values.values[mean.nodes[mean.weights.argmax()]]), math.nan
        exact = name in ("u", "v")
        read = self.moved["uv".index(name) :: 2] if exact else np.stack([values.values, values.std])
        of_nodes, stds = read[:, None, mean.nodes]
        stated = bool(np.isfinite(stds).any())
        pair = mean.average(of_nodes, stds, np.isfinite(of_nodes + (stds if stated else 0)), alike=not exact)
        (value,), (std,) = self.maps.physical.units.lengths(*pair) if exact else pair
        if exact and name != self.field.name:
            return float(std), math.nan
        return float(value), float(std) if stated else math.nan
