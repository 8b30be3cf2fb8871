"""What probes read off a result over the frames, in physical units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from rgbmidic.fields.units import Units

__all__ = ["Histories", "Told"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Told:
    """One quantity over the frames, in the unit that it is told in.

    Attributes
    ----------
    name
        Without its unit.
    unit
        Such as ``"mm"``, ``"px/frame"``, ``"1/s"``; empty for a strain.
    values, std : ndarray, shape (T,)
        NaN where not known; `std` is None for what was not measured by the images.
    """

    name: str
    unit: str
    values: FloatArray
    std: FloatArray | None

    @property
    def column(self) -> str:
        """Name of its column, with the unit."""
        from rgbmidic.fields.units import column

        return column(self.name, self.unit)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Histories:
    """What probes tell of the frames that are measured.

    Attributes
    ----------
    frames, numbers, status : ndarray, shape (T,), int
        Place in the result, number (with gaps where frames are lost) and end of each frame.
    times : ndarray, shape (T,), or None
        In seconds.
    quantities
        One after the other.
    stress_strain
        Names of the strain and the stress that go together, where a stress is known.
    units
        Of lengths and time.
    remarks
        What a reader should know, a line each.
    """

    frames: npt.NDArray[np.int64]
    numbers: npt.NDArray[np.int64]
    status: npt.NDArray[np.int64]
    times: FloatArray | None
    quantities: tuple[Told, ...]
    stress_strain: tuple[str, str] | None
    units: Units
    remarks: tuple[str, ...]

    def __getitem__(self, name: str) -> Told:
        """The quantity of a name, or of its column's."""
        for told in self.quantities:
            if name in (told.name, told.column):
                return told
        raise KeyError(name)
