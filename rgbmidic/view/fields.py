"""Nodal fields of a result with units and colour ranges, the images under them, texts on a frame and a place."""

from __future__ import annotations

import html
import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from bokeh.document import Document

from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.fields import Mean, make_probe
from rgbmidic.report.figures import spread
from rgbmidic.report.style import colour_range, ordinary_values, time_text
from rgbmidic.results import QUANTITIES, UNKNOWN_TIME, MapField, Maps, MapValues, Result
from rgbmidic.typing import FloatArray
from rgbmidic.view.picture import Picture, RawPictures, element_at

__all__ = [
    "Background",
    "Pictures",
    "every",
    "extremes",
    "frame_text",
    "guarded",
    "pointer_text",
    "probe_text",
    "range_of_test",
    "robust_range",
    "warning",
    "watched",
]

T = TypeVar("T")

logger = logging.getLogger(__name__)

_SPREAD = 24
"""Frames, evenly spread, whose values set the colour range of a whole test: they are read within a second."""
_KEPT = 8
"""Raw frames that are kept as pictures: those around the one in view."""
_REASON = 90
"""Letters of a frame's reason that are shown at once: two lines of the column."""
_REASONS = ("measured", "no light sees enough texture here", "the images around it do not match", "carried over")
"""What a node's status means, under the pointer."""
_FAILED = QUANTITIES["status"].codes.index("failed")


def range_of_test(maps: Maps, name: str) -> tuple[float, float]:
    """Return the colour range of a field over the whole test, from frames evenly spread over those measured."""
    there = np.flatnonzero(maps.result.finished).tolist()
    ends = [robust_range(maps.read(name, frame)) for frame in (spread(there, _SPREAD) if there else ())]
    measured = [pair for pair in ends if pair is not None]
    return (min(low for low, _ in measured), max(high for _, high in measured)) if measured else (0.0, 1.0)


def robust_range(read: MapValues) -> tuple[float, float] | None:
    """Return the colour range of one frame without doubtful nodes and outliers; None where nothing is measured."""
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
        return lru_cache(_KEPT)(RawPictures(result=self.result))


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


def frame_text(maps: Maps, place: int, field: MapField, values: MapValues, remark: str) -> str:
    """Describe what is in view, as HTML: the frame, how it ended, the field with its extremes, and a remark."""
    result = maps.result
    read = next(result.table.each(["status", "reason", "iterations", "node_status", "time_ns"], [place]))
    missing = float(np.mean(read["node_status"] != 0))
    measured = bool(result.finished[place])
    end = QUANTITIES["status"].codes[read["status"]] if measured else "not measured yet"
    seconds = read["time_ns"] * 1e-9
    time = "" if read["time_ns"] == UNKNOWN_TIME else f", {time_text(seconds, np.array([seconds]))}"
    without = f", {missing:.1%} of the nodes not measured" if missing and read["status"] != _FAILED else ""
    lines = [f"Frame {place} of {len(result) - 1}: {html.escape(result.names[place])}{time}", f"{end}{without}"]
    if read["reason"] and measured:
        first, rest = read["reason"][:_REASON], read["reason"][_REASON:]
        lines[1] = warning(f"{end}: {first}")
        if rest:
            lines[1] = f"<details><summary>{lines[1]} … more</summary>… {html.escape(rest)}</details>"
    lines.append(f"<b>{html.escape(field.label)}</b>: {html.escape(field.meaning.partition(':')[0])}")
    found = extremes(field, values)
    if found:
        ends = [
            f"{name} {field.text(values.values[node])} at ({result.nodes[node, 0]:.0f}, {result.nodes[node, 1]:.0f}) px"
            for name, node in zip(("smallest", "largest"), found, strict=True)
        ]
        lines.append(html.escape(", ".join(ends)))
    elif not np.isfinite(values.values).any():
        lines.append("Nothing is measured here: choose another frame below.")
    base = maps.all.get(field.name.removesuffix("_std"), field)
    lines += [html.escape(text) for text in [maps.how.get(base.group, "")] if text]
    return "<br>".join([*lines, *([html.escape(remark)] if remark else [])])


def extremes(field: MapField, values: MapValues) -> tuple[int, ...]:
    """Return the nodes with the smallest and the largest value; none where nothing is measured, or of a status."""
    if field.codes or not np.isfinite(values.values).any():
        return ()
    return int(np.nanargmin(values.values)), int(np.nanargmax(values.values))


def pointer_text(
    field: MapField, values: MapValues, nodes: FloatArray, elements: npt.NDArray[np.int32], x: float, y: float
) -> str:
    """Return the value at a place of the image, as HTML; where there is none, why."""
    found = element_at(nodes, elements, x, y)
    if found is None:
        return f"x {x:.1f}, y {y:.1f} px: outside the mesh"
    corners, weights = found
    weights = np.eye(3)[weights.argmax()] if field.stepped else weights
    value, std = (float(weights @ part[corners]) for part in (values.values, values.std))
    text = f"{field.name} = {field.text(value, std)}"
    blank = values.status[corners].max()
    if not np.isfinite(value):
        text += f" ({_REASONS[blank] if blank else 'a node beside it has no data'})"
    return f"x {x:.1f}, y {y:.1f} px: <b>{html.escape(text)}</b>"


def probe_text(maps: Maps, field: MapField, values: MapValues, kind: str, place: tuple[float, ...]) -> str:
    """Return the value of a field at a point, or its mean along a line or over an area, with its uncertainty.

    That of a mean of u or v, or of their rates, is exact; of others it is the most that it can be.
    """
    if kind == "gauge" or (field.stepped and kind != "point"):
        return ""
    try:
        kind, place = ("point", place[:2]) if kind == "strain_gauge" else (kind, place)
        probe = make_probe(maps.physical.covariance, kind, 1, place, rectified=maps.physical.rectified)
    except InputError:
        return ""
    assert isinstance(probe, Mean)
    if field.stepped:
        return f": {field.text(float(values.values[probe.nodes[probe.weights.argmax()]]))}"
    read = np.stack([values.values, values.std])[:, None, probe.nodes]
    stated = bool(np.isfinite(read[1]).any())
    alike = field.name.partition("_")[0] not in ("u", "v") and len(probe.nodes) > 3
    known = np.isfinite(read[0] + (read[1] if stated else 0))
    (value,), (std,) = probe.average(read[0], read[1], known, alike=alike)
    most = " at most" if stated and alike and np.isfinite(value) else ""
    mean = " mean" if kind != "point" else ""
    return f"{mean}: {field.text(float(value), float(std) if stated else float('nan'))}{most}"
