"""What a probe takes, the displacements of some nodes over the frames, and what it gives: named histories."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from rgbmidic.typing import FloatArray

__all__ = ["History", "Nodal", "Probe"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Nodal:
    """Displacement of some nodes and its standard uncertainty, each (T, m), px; NaN where not measured."""

    u: FloatArray
    v: FloatArray
    u_std: FloatArray
    v_std: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class History:
    """One quantity of a probe over the frames.

    Attributes
    ----------
    name
        Such as ``"point_1_u"``.
    unit
        ``"px"`` for a length, ``"deg"`` for an angle, empty for a strain.
    values, std : ndarray, shape (T,)
        NaN where not measured.
    """

    name: str
    unit: str
    values: FloatArray
    std: FloatArray


class Probe(Protocol):
    """What all probes can do.

    Attributes
    ----------
    name
        First part of the names of its histories.
    nodes : ndarray, shape (m,)
        The nodes that it needs.
    """

    @property
    def name(self) -> str: ...

    @property
    def nodes(self) -> npt.NDArray[np.int64]: ...

    def histories(self, nodal: Nodal) -> list[History]:
        """What it reads, from the displacements of its `nodes`."""
