"""What is kept of one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.results.quantities import QUANTITIES
from rgbmidic.typing import AnyArray

if TYPE_CHECKING:
    from rgbmidic.correlation.solution import Solution

__all__ = ["FrameRecord"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameRecord:
    """The result of one frame; every quantity of `rgbmidic.results.QUANTITIES` is an attribute, such as ``record.u``.

    Attributes
    ----------
    values
        Every quantity by its name, in the shape and type of the table: an array, or a plain number or text.
    sizes
        Number of nodes (``"node"``) and of lights (``"light"``).

    Raises
    ------
    InputError
        A quantity is missing, unknown or has another shape.
    """

    values: Mapping[str, Any]
    sizes: Mapping[str, int]

    def __post_init__(self) -> None:
        if odd := self.values.keys() ^ QUANTITIES.keys():
            raise InputError(f"a frame record holds {', '.join(QUANTITIES)}; missing or unknown: {', '.join(odd)}")
        values = {name: entry.convert(self.values[name], self.sizes) for name, entry in QUANTITIES.items()}
        object.__setattr__(self, "values", values)

    @classmethod
    def of(cls, *, nodes: int, lights: int, **values: Any) -> FrameRecord:
        """The record of the quantities given (None: not known); the others hold what an unmeasured frame does."""
        sizes = {"node": nodes, "light": lights}
        blank = {name: entry.unmeasured(sizes) for name, entry in QUANTITIES.items()}
        given = {name: value for name, value in values.items() if value is not None}
        return cls(values=blank | given, sizes=sizes)

    @classmethod
    def from_solution(cls, solution: Solution, *, inputs: Mapping[str, str] | None = None, **given: Any) -> FrameRecord:
        """The record of a solved frame.

        Parameters
        ----------
        solution
            Gives the quantities that have a `Quantity.source`.
        inputs
            Path and SHA-256 of the files that the frame was read from.
        given
            The others, such as `number`, `time_ns`, `brightness` and `weights_thumbnail`; None where not known.
        """
        nodes, lights = np.shape(solution.light_share)
        solved = {name: entry.of(solution) for name, entry in QUANTITIES.items() if entry.source}
        return cls.of(nodes=nodes, lights=lights, inputs=_pairs(inputs), **solved, **given)

    @classmethod
    def failed(
        cls, reason: str, *, nodes: int, lights: int, inputs: Mapping[str, str] | None = None, **given: Any
    ) -> FrameRecord:
        """The record of a frame that could not be measured at all: NaN everywhere, and the reason."""
        return cls.of(nodes=nodes, lights=lights, reason=reason, inputs=_pairs(inputs), **given)

    def __getattr__(self, name: str) -> Any:
        if name in QUANTITIES:
            return self.values[name]
        raise AttributeError(f"a frame record has no quantity {name!r}")


def _pairs(inputs: Mapping[str, str] | None) -> AnyArray:
    return np.array(list((inputs or {}).items()), dtype=np.str_).reshape(-1, 2)
