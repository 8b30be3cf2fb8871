"""Analog channels recorded beside a test, such as a force: a CSV file, brought to the times of the frames."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.settings import regular
from rgbmidic.typing import FloatArray

__all__ = ["Channels"]

_TIME = re.compile(r"(?:time|t)(?:[\s_(\[]+(s|ms|us|µs)[)\]]?)?", re.IGNORECASE)
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
_NEWTONS = {"N": 1.0, "kN": 1e3}
_UNIT = re.compile(r".*[\s_(\[](kN|N)[)\]]?")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Channels:
    """What was recorded, each value at its time.

    Attributes
    ----------
    path
        The file.
    times : ndarray, shape (n,)
        In seconds, rising.
    values
        Name of each channel to its values (n,).
    """

    path: Path
    times: FloatArray
    values: Mapping[str, FloatArray]

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a CSV file: a header line, then rows; the first column is ``time_s``, ``time_ms`` or ``time_us``.

        Columns are parted by commas, semicolons (then a comma may be the decimal point) or tabs.

        Raises
        ------
        InputError
            The file is missing, has no such header, a field is no number, or the times do not rise.
        """
        path = Path(path)
        try:
            lines = regular(path).read_text(encoding="utf-8-sig").splitlines()
        except OSError as error:
            raise InputError(f"the channels {path} cannot be read: {error.strerror or error}") from None
        except ValueError:
            raise InputError(f"the channels {path} are not a text file") from None
        lines = [line for line in lines if line.strip()]
        parted = max(",;\t", key=(lines or [""])[0].count)
        names = [name.strip() for name in next(csv.reader(lines[:1], delimiter=parted), [])]
        unit = _TIME.fullmatch(names[0]) if len(names) > 1 else None
        if unit is None:
            raise InputError(
                f'the channels {path} need a header line: "time_s" (or time_ms, time_us) and the name of each channel'
            )
        table = _numbers(path, lines[1:], parted, len(names))
        times = table[:, 0] * _SECONDS[(unit[1] or "s").lower()]
        if len(times) < 2 or not (np.diff(times) > 0).all():
            raise InputError(f"the times of the channels {path} must rise from row to row, over two rows or more")
        return cls(path=path, times=times, values=dict(zip(names[1:], table[:, 1:].T, strict=True)))

    def at(self, times: FloatArray, offset: float = 0.0) -> dict[str, FloatArray]:
        """Each channel at the times (T,) of the frames, linear between its values, NaN beyond them.

        Parameters
        ----------
        times
            In seconds.
        offset
            Seconds that are added to the times of the channels to make them those of the frames.

        Raises
        ------
        InputError
            No frame lies within the times of the channels.
        """
        own = self.times + offset
        if not ((times >= own[0]) & (times <= own[-1])).any():
            raise InputError(
                f"the channels {self.path} span {own[0]:.9g} to {own[-1]:.9g} s (offset {offset:g} s included), the "
                f"frames {np.nanmin(times):.9g} to {np.nanmax(times):.9g} s: state the --offset between both clocks"
            )
        return {name: np.interp(times, own, values, np.nan, np.nan) for name, values in self.values.items()}

    def force(self, name: str | None = None) -> tuple[str, float]:
        """Name of the channel with a force, and newtons for one of its unit.

        Parameters
        ----------
        name
            Of the channel; None: the only one whose name ends in N or kN.

        Raises
        ------
        InputError
            There is none, more than one, or its name does not end in its unit.
        """
        found = {own: _NEWTONS[unit[1]] for own in self.values if (unit := _UNIT.fullmatch(own))}
        if name is None and len(found) == 1:
            return next(iter(found.items()))
        if name is None or name not in found:
            what = "none is stated" if name is None else f'"{name}" is not one'
            raise InputError(
                f"a stress needs one channel of {self.path} with a force, whose name ends in _N or _kN; {what}, the "
                f"channels are {', '.join(self.values)}"
            )
        return name, found[name]


def _numbers(path: Path, lines: list[str], parted: str, count: int) -> FloatArray:
    """Rows of numbers (n, count); an empty field is NaN."""
    rows = []
    for number, row in enumerate(csv.reader(lines, delimiter=parted), 2):
        fields = [part.strip().replace(",", ".") if parted == ";" else part.strip() for part in row]
        try:
            rows.append([float(part) if part else math.nan for part in fields])
        except ValueError:
            raise InputError(f"row {number} of the channels {path} is not numbers: {row}") from None
        if len(row) != count:
            raise InputError(f"row {number} of the channels {path} has {len(row)} fields, the header {count}")
    return np.array(rows, dtype=np.float64).reshape(-1, count)
