"""The curve below the maps of a movie: what a probe read, up to the frame that is shown."""

from __future__ import annotations

import csv
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.results import Channels
from rgbmidic.typing import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve:
    """A quantity over time that is shown beside the maps.

    Attributes
    ----------
    name
        Label of its axis.
    times : ndarray, shape (n,)
        In seconds; indices of frames where `timed` is false.
    values : ndarray, shape (n,)
    timed
        Whether `times` are seconds.
    """

    name: str
    times: FloatArray
    values: FloatArray
    timed: bool

    @classmethod
    def read(cls, path: Path | str, column: str | None = None, offset: float = 0.0) -> Curve:
        """Read a column of a file that ``rgbmidic history`` wrote, or a channel of a file of channels.

        Parameters
        ----------
        path
            CSV file.
        column
            Its name; None: the first that holds a quantity.
        offset
            Seconds that are added to the times of channels.

        Returns
        -------
        Curve

        Raises
        ------
        InputError
            The file is no such table or has no such column, or an offset is stated for a history.
        """
        path = Path(path)
        with suppress(OSError, UnicodeDecodeError), path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.reader(file)
            head = next(rows, [])
            if head[:3] == ["frame", "number", "status"]:
                timed = "time_s" in head
                names = [name for name in head[3:] if name != "time_s" and not name.endswith("_std")]
                name = _chosen(path, column, names)
                wanted = [head.index("time_s" if timed else "frame"), head.index(name)]
                try:
                    table = np.array([[float(row[at] or "nan") for at in wanted] for row in rows]).reshape(-1, 2)
                except (ValueError, IndexError):
                    raise InputError(f"the table {path} is damaged: a row is not numbers") from None
                if offset:
                    raise InputError(f"an offset is of channels; {path} is a history, by the frames' own clock")
                return cls(name=name, times=table[:, 0], values=table[:, 1], timed=timed)
        channels = Channels.read(path, offset)
        name = _chosen(path, column, list(channels.values))
        return cls(name=name, times=channels.times, values=channels.values[name], timed=True)


def _chosen(path: Path, column: str | None, names: list[str]) -> str:
    if column not in (None, *names) or not names:
        raise InputError(f'{path} has no column "{column}"; it has {", ".join(names) or "none"}')
    return column or names[0]
