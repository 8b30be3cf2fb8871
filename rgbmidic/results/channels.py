"""Channels that were recorded beside a test: force, trigger, temperature; read from a file, brought to the frames."""

from __future__ import annotations

import csv
import logging
import math
import re
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from rgbmidic.disk import require_regular_file
from rgbmidic.errors import InputError
from rgbmidic.renamed import state_new_names
from rgbmidic.results.alignment import MIN_CORRELATION, MIN_FRAMES, Alignment
from rgbmidic.typing import FloatArray

logger = logging.getLogger(__name__)

_TIME = re.compile(r"(?:time|t)(?:[\s_(\[]+(s|ms|us|µs)[)\]]?)?", re.IGNORECASE)
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
_NEWTONS = {"N": 1.0, "kN": 1e3}
_DECIMAL = re.compile(r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:e[+-]?\d+)?|nan", re.IGNORECASE | re.ASCII)
_UNIT = re.compile(r".*[\s_(\[](kN|N)[)\]]?")


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Channels:
    """Analog channels recorded beside a test: values at their times.

    Attributes
    ----------
    path
        The file.
    times : ndarray, shape (n,)
        In seconds, rising, by the clock of the frames.
    values
        Name of each channel to its values (n,).
    offset
        Seconds that were added to the recorded times to make them those of the frames.

    Examples
    --------
    >>> np.savetxt("force.csv", [[0, 0], [0.1, 20]], delimiter=",", header="time_s,force_N", comments="")
    >>> channels = Channels.read("force.csv", offset=0.1)
    >>> channels.interpolate(np.array([0.15]))
    {'force_N': array([10.])}
    >>> Path("force.csv").unlink()
    """

    path: Path
    times: FloatArray
    values: Mapping[str, FloatArray]
    offset: float = 0.0

    @classmethod
    def read(cls, path: Path | str, offset: float = 0.0, trigger: str | None = None) -> Self:
        """Read a CSV file: a header line, then rows; the first column is ``time_s``, ``time_ms`` or ``time_us``.

        Columns are separated by commas, semicolons (then a comma may be the decimal point) or tabs.

        Parameters
        ----------
        path
            The file.
        offset
            Seconds that are added to its times to make them those of the frames.
        trigger
            In place of `offset`: the channel whose first crossing of the middle of its range is the time 0.

        Returns
        -------
        Channels

        Raises
        ------
        InputError
            The file is missing, has no such header, a field is no number, two columns have one name, the times do not
            rise, or the trigger is not one of the channels or constant.
        """
        path = Path(path)
        try:
            lines = require_regular_file(path).read_text(encoding="utf-8-sig").splitlines()
        except OSError as error:
            raise InputError(f"the channels {path} cannot be read: {error.strerror or error}") from None
        except ValueError:
            raise InputError(f"the channels {path} are not a text file") from None
        lines = [line for line in lines if line.strip()]
        separator = max(",;\t", key=(lines or [""])[0].count)
        try:
            head, *rows = list(csv.reader(lines, delimiter=separator)) or [[]]
        except csv.Error as error:
            raise InputError(f"the channels {path} are not a table: {error}") from None
        names = [name.strip() for name in head]
        unit = _TIME.fullmatch(names[0]) if len(names) > 1 else None
        if unit is None:
            raise InputError(
                f'the channels {path} need a header line: "time_s" (or time_ms, time_us) and the name of each channel'
            )
        if duplicates := sorted({name for name in names if names.count(name) > 1}):
            raise InputError(f"the channels {path} have several columns of one name: {', '.join(duplicates)}")
        if "" in names:
            raise InputError(f"column {names.index('') + 1} of the channels {path} has no name in the header line")
        table = _numbers(path, rows, separator, len(names))
        times = table[:, 0] * _SECONDS[(unit[1] or "s").lower()]
        if len(times) < 2 or not (np.diff(times) > 0).all():
            raise InputError(f"the times of the channels {path} must rise from row to row, over two rows or more")
        values = dict(zip(names[1:], table[:, 1:].T, strict=True))
        channels = cls(path=path, times=times, values=values)
        if trigger is not None:
            finite = np.isfinite(channels.values_of(trigger))
            signal, times = channels.values_of(trigger)[finite], times[finite]
            middle = (signal.min() + signal.max()) / 2 if len(signal) else math.nan
            crossings = np.flatnonzero(np.diff(signal > middle))
            if not len(crossings):
                raise InputError(f"the trigger {trigger} of the channels {path} is constant: it marks no time")
            if len(crossings) > 1:
                text = "the trigger %s of %s crosses the middle of its range %d times: the first counts"
                logger.warning(text, trigger, path, len(crossings))
            i = int(crossings[0])
            offset = -float(times[i] + (middle - signal[i]) / (signal[i + 1] - signal[i]) * (times[i + 1] - times[i]))
        return channels.with_offset(offset)

    def with_offset(self, offset: float) -> Self:
        """Return the channels with an offset (s) added to the times.

        Parameters
        ----------
        offset
            In seconds.

        Returns
        -------
        Channels
        """
        return replace(self, times=self.times + offset, offset=self.offset + offset)

    def values_of(self, name: str) -> FloatArray:
        """Return the values (n,) of a channel.

        Parameters
        ----------
        name
            Name of the channel.

        Returns
        -------
        ndarray, shape (n,)

        Raises
        ------
        InputError
            There is none of this name.
        """
        if name not in self.values:
            raise InputError(f'"{name}" is not one of the channels of {self.path}: {", ".join(self.values)}')
        return self.values[name]

    def align(self, name: str, times: FloatArray, values: FloatArray) -> tuple[Self, float, float]:
        """Find the offset at which a channel correlates best with a history.

        Of every offset that leaves half of the frames within the channel's times, the largest absolute correlation
        coefficient of the channel, interpolated at the frames, with the history counts. Another that correlates as well
        is named in a warning.

        Parameters
        ----------
        name
            The channel.
        times, values : ndarray, shape (T,)
            Seconds and values of the history; NaN where it has none.

        Returns
        -------
        channels : Channels
            With that offset.
        std : float
            Its standard uncertainty in seconds, from what the fit of the channel to the history leaves as noise
            (`Alignment.std`), and from the interval of the channel: how far the offsets differ that every other of its
            values gives, taken as the width of a uniform distribution.
        coefficient : float
            The correlation coefficient.

        Raises
        ------
        InputError
            There is no such channel, too little of the history is known, or the two do not correlate.
        """
        signal, finite = self.values_of(name), np.isfinite(values) & np.isfinite(times)
        history_times, history_values = times[finite], values[finite]
        if len(history_times) < MIN_FRAMES or not np.ptp(history_values) > 0 or not np.nanstd(signal) > 0:
            raise InputError(
                f"{len(history_times)} values of the history are too few, or constant, to align {name} with"
            )
        alignment, *half_alignments = (
            Alignment.from_series(self.times[samples], signal[samples], history_times, history_values)
            for samples in (slice(None), slice(None, None, 2), slice(1, None, 2))
        )
        offsets, coefficients = alignment.coefficients()
        offset = alignment.refine_offset(offsets[np.argmax(np.abs(coefficients))], max(alignment.intervals))
        coefficient = alignment.correlation(offset)
        if not abs(coefficient) > MIN_CORRELATION:
            raise InputError(
                f"the channel {name} of {self.path} correlates with the history by {coefficient:.2f} at best, "
                f"{MIN_CORRELATION} is needed to align them: state channels.offset"
            )
        if len(rival_offsets := alignment.rival_offsets(offsets, coefficients)):
            text = "the channel %s of %s correlates as well with other offsets of its clock, such as %.6g s"
            logger.warning(f"{text}: state channels.offset", name, self.path, rival_offsets[0])
        even_offset, odd_offset = (
            half_alignment.refine_offset(offset, max(half_alignment.intervals)) for half_alignment in half_alignments
        )
        return (
            self.with_offset(offset),
            math.hypot(alignment.std(offset), (even_offset - odd_offset) / math.sqrt(12)),
            coefficient,
        )

    def interpolate(self, times: FloatArray) -> dict[str, FloatArray]:
        """Interpolate each channel linearly at the times (T,) of the frames; NaN beyond its values.

        Parameters
        ----------
        times
            In seconds.

        Returns
        -------
        dict of str to ndarray, shape (T,)

        Raises
        ------
        InputError
            No frame lies within the times of the channels.
        """
        start, end = self.times[[0, -1]]
        if not ((times >= start) & (times <= end)).any():
            raise InputError(
                f"the channels {self.path} span {start:.9g} to {end:.9g} s (offset {self.offset:g} s included), the "
                f"frames {np.nanmin(times):.9g} to {np.nanmax(times):.9g} s: state channels.offset (`offset`) between "
                "both clocks"
            )
        return {name: np.interp(times, self.times, values, np.nan, np.nan) for name, values in self.values.items()}

    def force(self, name: str | None = None) -> tuple[str, float]:
        """Return the name of the channel with a force, and its unit in newtons.

        Parameters
        ----------
        name
            Of the channel; None: the only one whose name ends in N or kN.

        Returns
        -------
        name : str
        factor : float

        Raises
        ------
        InputError
            There is none, more than one, or its name does not end in its unit.
        """
        factors = {channel: _NEWTONS[unit[1]] for channel in self.values if (unit := _UNIT.fullmatch(channel))}
        if name is None and len(factors) == 1:
            return next(iter(factors.items()))
        if name is None or name not in factors:
            problem = "none is stated" if name is None else f'"{name}" is not one'
            raise InputError(
                f"a stress needs one channel of {self.path} with a force, whose name ends in _N or _kN; {problem}, the "
                f"channels are {', '.join(self.values)}"
            )
        return name, factors[name]


def _numbers(path: Path, rows: list[list[str]], separator: str, count: int) -> FloatArray:
    """Read rows of finite decimal numbers (n, count); an empty field, or nan, is NaN."""
    table, marks = [], set[str]()
    for number, row in enumerate(rows, 2):
        fields = [cell.strip() for cell in row]
        marks.update(mark for cell in fields for mark in ".," if mark in cell)
        values = [
            float(cell.replace(",", ".") if separator == ";" else cell) if cell else math.nan
            for cell in fields
            if not cell or (_DECIMAL.fullmatch(cell) and (separator == ";" or "," not in cell))
        ]
        if len(values) != len(row) or np.isinf(values).any():
            raise InputError(f"row {number} of the channels {path} is not numbers: {reprlib.repr(row)}")
        if len(row) != count:
            raise InputError(f"row {number} of the channels {path} has {len(row)} fields, the header {count}")
        if len(marks) > 1:
            raise InputError(
                f"row {number} of the channels {path}: the file has numbers with a comma and numbers with a point; "
                f"one of them is the decimal mark, and thousands are not separated: {reprlib.repr(row)}"
            )
        table.append(values)
    return np.array(table, dtype=np.float64).reshape(-1, count)
