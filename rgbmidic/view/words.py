"""What a page says in words: of the frame in view, of the place under the pointer, of what went wrong."""

from __future__ import annotations

import html
import logging
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from bokeh.document import Document

from rgbmidic.errors import RgbmidicError
from rgbmidic.report.style import time_unit
from rgbmidic.results import QUANTITIES, UNKNOWN_TIME, Result
from rgbmidic.typing import FloatArray
from rgbmidic.view.fields import Field, Values
from rgbmidic.view.picture import element_at

__all__ = ["frame_words", "guarded", "pointed_words", "warning", "watched"]

logger = logging.getLogger(__name__)

_FAILED = 2


def warning(text: str) -> str:
    """A remark that is to be seen, as HTML."""
    return f'<b style="color:var(--warn)">{html.escape(text)}</b>'


def guarded(act: Callable[[], None], complain: Callable[[str], None]) -> None:
    """Do something; what goes wrong is told in one line, and the page goes on."""
    try:
        act()
    except (RgbmidicError, OSError) as error:
        complain(str(error))
    except Exception as error:  # the last resort of a page
        logger.exception("the page failed")
        complain(f"{type(error).__name__}: {error}")


def watched(document: Document) -> bool:
    """Whether a browser shows the page: one that was left lives on for a while, and does nothing more."""
    session = document.session_context.session if document.session_context else None
    return session is None or session.connection_count > 0


def frame_words(result: Result, place: int, field: Field, values: Values, remark: str) -> str:
    """What is in view, as HTML: the frame, how it ended, the field and what there is to remark."""
    read = next(result.table.each(["status", "reason", "iterations", "node_status", "time_ns"], [place]))
    missing = float(np.mean(read["node_status"] != 0))
    measured = bool(result.finished[place])
    end = QUANTITIES["status"].codes[read["status"]] if measured else "not measured yet"
    seconds = read["time_ns"] * 1e-9
    factor, unit = time_unit(np.array([seconds]))
    time = "" if read["time_ns"] == UNKNOWN_TIME else f", {factor * seconds:.6g} {unit}"
    lost = f", {missing:.1%} of the nodes not measured" if missing and read["status"] != _FAILED else ""
    lines = [f"Frame {place} of {len(result) - 1}: {html.escape(result.names[place])}{time}", f"{end}{lost}"]
    if read["reason"] and measured:
        lines[1] = warning(f"{end}: {read['reason']}")
    if not np.isfinite(values.values).any():
        lines.append("Nothing is measured here: choose another frame below.")
    lines.append(f"<b>{html.escape(field.label)}</b>: {html.escape(field.meaning.partition(':')[0])}")
    return "<br>".join([*lines, *([html.escape(remark)] if remark else [])])


def pointed_words(
    field: Field, values: Values, nodes: FloatArray, elements: npt.NDArray[np.int32], x: float, y: float
) -> str:
    """The value at a place of the image, as HTML."""
    found = element_at(nodes, elements, x, y)
    if found is None:
        return f"x {x:.1f}, y {y:.1f} px: outside the mesh"
    corners, weights = found
    weights = np.eye(3)[weights.argmax()] if field.stepped else weights
    value, std = (float(weights @ part[corners]) for part in (values.values, values.std))
    return f"x {x:.1f}, y {y:.1f} px: <b>{html.escape(f'{field.name} = {field.text(value, std)}')}</b>"
