"""Curves over time: the marks that were set on the field, read off as `rgbmidic history` reads probes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from rgbmidic.report.style import time_unit
from rgbmidic.results import Histories, Result, Told, probes_of
from rgbmidic.results.history_table import history_csv
from rgbmidic.results.probing import read_histories
from rgbmidic.settings import ProbeSettings
from rgbmidic.typing import FloatArray
from rgbmidic.view.address import KINDS, Mark

__all__ = ["as_csv", "band", "groups", "over", "probes", "read"]


def probes(marks: Sequence[Mark], gauge: float, stated: ProbeSettings) -> ProbeSettings:
    """The probes that marks make: each kind in the order set; strain gauges of length `gauge`, px; a last one without
    its pair waits for it. Strain measure and window are those `stated`."""
    places: dict[str, list[tuple[float, ...]]] = {}
    for kind, count in KINDS.items():
        own = [(mark.x, mark.y) for mark in marks if mark.kind == kind]
        whole = [tuple(np.ravel(own[i : i + count]).tolist()) for i in range(0, len(own) - count + 1, count)]
        places[f"{kind}s"] = [(*place, gauge) for place in whole] if kind == "strain_gauge" else whole
    made: dict[str, Any] = {key: tuple(value) for key, value in places.items()}
    return ProbeSettings(measure=stated.measure, window=stated.window, **made)


def read(result: Result, marks: Sequence[Mark], gauge: float) -> Histories | None:
    """What the marks read off a result over its frames; None where they make no probe. Errors as `read_histories`."""
    made = probes(marks, gauge, probes_of(result))
    return read_histories(result, made) if made.places else None


def groups(histories: Histories) -> dict[str, list[Told]]:
    """What can be shown together: the same quantity of all probes, by its name and unit."""
    found: dict[str, list[Told]] = {}
    for told in histories.quantities:
        if told.name.endswith(("_before", "_after")):  # single frames, no curve
            continue
        kind = next(kind for kind in sorted(KINDS, key=len, reverse=True) if told.name.startswith(f"{kind}_"))
        name = told.name.removeprefix(f"{kind}_").partition("_")[2]
        found.setdefault(f"{name} ({told.unit})" if told.unit else name, []).append(told)
    return found


def over(histories: Histories) -> tuple[FloatArray, str]:
    """What the curves go over, and its name: the time, or frames where none is known."""
    if histories.times is None:
        return histories.frames.astype(np.float64), "frame"
    factor, unit = time_unit(histories.times)
    return factor * histories.times, f"time ({unit})"


def band(x: FloatArray, told: Told) -> tuple[list[FloatArray], list[FloatArray]]:
    """Outlines of two standard uncertainties on both sides, one for each stretch of frames without a gap."""
    if told.std is None:
        return [], []
    known = np.isfinite(told.values) & np.isfinite(told.std)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    xs, ys = [], []
    for start, stop in edges.reshape(-1, 2):
        middle, reach = told.values[start:stop], 2 * told.std[start:stop]
        xs.append(np.concatenate([x[start:stop], x[start:stop][::-1]]))
        ys.append(np.concatenate([middle - reach, (middle + reach)[::-1]]))
    return xs, ys


def as_csv(histories: Histories) -> str:
    """The file that `rgbmidic history` writes."""
    file = io.BytesIO()
    history_csv(histories, file)
    return file.getvalue().decode("utf-8")
