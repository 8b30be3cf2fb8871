"""Results in other programs' formats."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from rgbmidic.errors import InputError, ResultError
from rgbmidic.results.record import write_complete
from rgbmidic.results.store import Result

__all__ = ["EXPORT_FORMATS", "export_result"]

_ARRAYS = ("nodes", "elements", "u", "v", "u_std", "v_std", "node_status", "light_share", "misfit")
_STRAIN = ("exx", "eyy", "exy")
_CSV_COLUMNS = (
    *("frame", "name", "status", "node", "node_status", "x", "y", "u", "v", "u_std", "v_std"),
    *_STRAIN,
    *(f"{name}_std" for name in _STRAIN),
)


def export_result(result: Result, to: str, out: Path | str, *, overwrite: bool = False) -> None:
    """Write all frames of a result into one file.

    ``"npz"``: nodes (N, 2) and elements (E, 3); u, v, exx, eyy, exy, each also with _std, node_status and misfit (T,
    N); light_share (T, N, k); status and iterations (T,); residual and weight_share (T, k); brightness (T, k, 2),
    gain and offset; names and lights.
    ``"csv"``: a header line, then one row per node and frame.
    Positions and displacements are in px, x right, y down; NaN (an empty field in csv) where not measured.

    Parameters
    ----------
    result
        The result.
    to
        One of `EXPORT_FORMATS`.
    out
        File to write; it appears once it is complete.
    overwrite
        Whether an existing file may be replaced.

    Raises
    ------
    InputError
        The format is unknown.
    ResultError
        The file exists, its folder does not, or a frame of the result is damaged.
    """
    out = Path(out)
    if to not in _WRITERS:
        raise InputError(f'unknown export format "{to}"; allowed are {", ".join(EXPORT_FORMATS)}')
    if out.exists() and not (overwrite and out.is_file()):
        raise ResultError(f"{out} already exists; choose another name, or overwrite it (overwrite=True, --overwrite)")
    if not out.parent.is_dir():
        raise ResultError(f"{out} cannot be written: there is no folder {out.parent}")
    write_complete(out, lambda file: _WRITERS[to](result, file))


def _write_npz(result: Result, file: BinaryIO) -> None:
    arrays: dict[str, Any] = {name: getattr(result, name) for name in (*_ARRAYS, "status", "iterations")}
    for axis, name in enumerate(_STRAIN):
        arrays[name], arrays[f"{name}_std"] = result.strain[..., axis], result.strain_std[..., axis]
    arrays |= {
        name: np.asarray(getattr(result, name))
        for name in ("residual", "weight_share", "brightness", "names", "lights")
    }
    np.savez_compressed(file, **arrays)


def _write_csv(result: Result, file: BinaryIO) -> None:
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text)
    writer.writerow(_CSV_COLUMNS)
    for index in range(len(result)):
        writer.writerows(_csv_rows(result, index))
    text.detach()  # leaves the file open for whoever opened it


def _csv_rows(result: Result, index: int) -> Iterator[list[Any]]:
    record = result.frame(index)
    head = [index, result.names[index], record.status]
    numbers = np.hstack([result.nodes, record.displacement, record.displacement_std, record.strain, record.strain_std])
    for node, (status, row) in enumerate(zip(record.node_status, numbers.tolist(), strict=True)):
        yield [*head, node, int(status), *("" if number != number else f"{number:.9g}" for number in row)]


_WRITERS: dict[str, Callable[[Result, BinaryIO], None]] = {"npz": _write_npz, "csv": _write_csv}
EXPORT_FORMATS = tuple(_WRITERS)
"""Names of the formats that `export_result` writes."""
