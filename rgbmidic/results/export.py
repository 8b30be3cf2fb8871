"""Results in other programs' formats."""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, BinaryIO

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.results.files import check_file, write_complete
from rgbmidic.results.quantities import QUANTITIES, Quantity
from rgbmidic.results.result import Result
from rgbmidic.settings import ScaleSettings
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    from rgbmidic.results.physical import Physical

__all__ = ["EXPORT_FORMATS", "export_result"]


def export_result(
    result: Result, to: str, out: Path | str, *, scale: ScaleSettings | None = None, overwrite: bool = False
) -> None:
    """Write all frames of a result into one file.

    ``"npz"`` is the store, in px: nodes (N, 2), elements (E, 3), names (T,), lights (k,) and every quantity of
    `rgbmidic.results.QUANTITIES` that has one shape in all frames, the frames as first axis.
    ``"csv"`` and ``"hdf5"`` (`rgbmidic.results.hdf5`) are for engineers: seconds, millimetres where the scale is known,
    Green-Lagrange strain over the shortest virtual strain gauge. csv has a header line, whose names hold the units, and
    a row per node and frame with the quantities that are one number per node.
    x is to the right, y down (ParaView's part of hdf5: up); NaN (an empty field in csv) where not measured.

    Parameters
    ----------
    result
        The result.
    to
        One of `EXPORT_FORMATS`.
    out
        File to write; it appears once it is complete.
    scale
        Stands in place of the ``[scale]`` that was kept with the result; None: that one. npz knows none.
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
    from rgbmidic.results.physical import Physical  # numba comes with it

    told = Physical.of(result, scale)
    write_complete(out, lambda file: _WRITERS[to](told, file))


def _write_npz(told: Physical, file: BinaryIO) -> None:
    result = told.result
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


def _write_csv(told: Physical, file: BinaryIO) -> None:
    from rgbmidic.fields.units import column

    result, text = told.result, io.TextIOWrapper(file, encoding="utf-8", newline="")
    fields = {name: entry.unit for name, entry in told.quantities.items() if entry.axes == ("node",)}
    del fields["node_status"]  # a whole number
    length, writer = told.units.length, csv.writer(text)
    places = [column(name, length) for name in ("x", "y")]
    time = ["time_s"] if told.units.timed else []
    head = ["frame", "number", "name", *time, "status", "node", "node_status"]
    writer.writerow([*head, *places, *(column(name, unit) for name, unit in fields.items())])
    for index, seconds in enumerate(told.times.tolist()):
        values = told.frame(index)
        one = [index, values["number"], result.names[index], *([f"{seconds:.12g}"] if time else []), values["status"]]
        numbers = np.column_stack([told.length * result.nodes, *(values[name] for name in fields)])
        writer.writerows(_csv_rows(one, values["node_status"], numbers))
    text.detach()  # leaves the file open for whoever opened it


def _csv_rows(one: list[Any], status: AnyArray, numbers: FloatArray) -> Iterator[list[Any]]:
    """What belongs to the frame, then node, its status and numbers, which are empty where they are not known."""
    for node, (code, row) in enumerate(zip(status.tolist(), numbers.tolist(), strict=True)):
        yield [*one, node, code, *("" if number != number else f"{number:.9g}" for number in row)]


def _write_hdf5(told: Physical, file: BinaryIO) -> None:
    from rgbmidic.results.hdf5 import write_hdf5

    write_hdf5(told, file)


_WRITERS: dict[str, Callable[[Physical, BinaryIO], None]] = {"npz": _write_npz, "csv": _write_csv, "hdf5": _write_hdf5}
EXPORT_FORMATS = tuple(_WRITERS)
"""Names of the formats that `export_result` writes."""
