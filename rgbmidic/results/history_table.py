"""Histories as a table: a summary for people, all of it as a CSV file."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import BinaryIO

import numpy as np

from rgbmidic.results.files import check_file, write_complete
from rgbmidic.results.histories import Histories
from rgbmidic.typing import FloatArray

__all__ = ["history_csv", "history_rows", "write_histories"]


def history_rows(histories: Histories) -> tuple[list[str], list[list[str]]]:
    """Headings, and of every quantity its extremes, last value and median standard uncertainty, as texts."""
    rows = []
    for told in histories.quantities:
        known = told.values[np.isfinite(told.values)]
        std = np.array([]) if told.std is None else told.std[np.isfinite(told.std)]
        ends = [f"{value:.5g}" for value in (known.min(), known.max(), known[-1])] if known.size else ["-"] * 3
        spread = f"{np.median(std):.2g}" if std.size else "-"
        rows.append([told.name, told.unit, *ends, spread, f"{known.size}"])
    return ["quantity", "unit", "smallest", "largest", "last", "uncertainty", "frames"], rows


def write_histories(histories: Histories, out: Path | str, *, overwrite: bool = False) -> None:
    """Write `history_csv` into a file.

    Raises
    ------
    ResultError
        The file exists, its folder does not, or it cannot be written.
    """
    out = Path(out)
    check_file(out, overwrite=overwrite)
    write_complete(out, lambda file: history_csv(histories, file))


def history_csv(histories: Histories, file: BinaryIO) -> None:
    """Write histories as CSV: a header line whose names carry the units, then one row a frame; empty: no value."""
    columns: dict[str, FloatArray] = {}
    if histories.times is not None:
        columns["time_s"] = histories.times
    for told in histories.quantities:
        columns[told.column] = told.values
        if told.std is not None:
            columns[f"{told.column}_std"] = told.std
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text)
    writer.writerow(["frame", "number", "status", *columns])
    heads = np.stack([histories.frames, histories.numbers, histories.status], axis=1).tolist()
    for head, row in zip(heads, np.column_stack([*columns.values()]).tolist(), strict=True):
        writer.writerow([*head, *("" if value != value else f"{value:.9g}" for value in row)])
    text.detach()  # leaves the file open for whoever opened it
