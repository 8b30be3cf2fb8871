"""Results in other programs' formats."""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.results.files import check_file, write_complete
from rgbmidic.results.quantities import QUANTITIES, Quantity
from rgbmidic.results.result import Result

__all__ = ["EXPORT_FORMATS", "export_result"]

_CSV_HEAD = ("frame", "number", "name", "status", "node", "node_status", "x", "y")


def export_result(result: Result, to: str, out: Path | str, *, overwrite: bool = False) -> None:
    """Write all frames of a result into one file.

    ``"npz"``: nodes (N, 2), elements (E, 3), names (T,), lights (k,) and every quantity of
    `rgbmidic.results.QUANTITIES` that has one shape in all frames, the frames as first axis.
    ``"csv"``: a header line, then one row per node and frame with the quantities that are one number per node.
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
    check_file(out, overwrite=overwrite)
    write_complete(out, lambda file: _WRITERS[to](result, file))


def _write_npz(result: Result, file: BinaryIO) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("nodes", "elements", "names", "lights"):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(getattr(result, name)), allow_pickle=False)
        for quantity in QUANTITIES.values():
            if quantity.stackable:
                with archive.open(f"{quantity.name}.npy", "w", force_zip64=True) as member:
                    _write_frames(result, quantity, member)


def _write_frames(result: Result, quantity: Quantity, file: IO[bytes]) -> None:
    """One array of all frames, of which one frame at a time is in memory."""
    one = quantity.unmeasured(result.table.layout.sizes)
    head = {"descr": one.dtype.str, "fortran_order": False, "shape": (len(result), *one.shape)}
    np.lib.format.write_array_header_1_0(file, head)
    for value in result.each(quantity.name):
        file.write(np.asarray(value, dtype=one.dtype).tobytes())


def _write_csv(result: Result, file: BinaryIO) -> None:
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text)
    fields = [name for name, quantity in QUANTITIES.items() if quantity.axes == ("node",) and name not in _CSV_HEAD]
    writer.writerow((*_CSV_HEAD, *fields))
    for index in range(len(result)):
        writer.writerows(_csv_rows(result, index, fields))
    text.detach()  # leaves the file open for whoever opened it


def _csv_rows(result: Result, index: int, fields: Iterable[str]) -> Iterator[list[Any]]:
    record = result.frame(index)
    head = [index, record.number, result.names[index], record.status]
    numbers = np.column_stack([result.nodes, *(record.values[name] for name in fields)])
    for node, (status, row) in enumerate(zip(record.node_status, numbers.tolist(), strict=True)):
        yield [*head, node, int(status), *("" if number != number else f"{number:.9g}" for number in row)]


_WRITERS: dict[str, Callable[[Result, BinaryIO], None]] = {"npz": _write_npz, "csv": _write_csv}
EXPORT_FORMATS = tuple(_WRITERS)
"""Names of the formats that `export_result` writes."""
