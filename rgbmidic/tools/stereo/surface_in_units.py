"""The surface in space as what reads fields of a result takes it (`rgbmidic.field.FieldSource`): mm and s.

Probes and lines are placed in px of the left reference; lengths along them, displacements and strains are those in
space.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.fields import Rectification, Units
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.results.result_in_units import ResultInUnits
from rgbmidic.settings import ScaleSettings
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from rgbmidic.tools.stereo.left_result import LeftResult


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceInUnits(ResultInUnits):
    """A stereo result as histories, profiles, maps, figures, movies and reports read one.

    Attributes
    ----------
    result
        The left camera's result on the nodes that were carried over.
    """

    result: LeftResult
    components: ClassVar[tuple[str, ...]] = ("u", "v", "w")

    @classmethod
    def of(cls, result: LeftResult, scale: ScaleSettings | None = None) -> Self:
        """Take the times of the left result, or of another ``[scale]``.

        Parameters
        ----------
        result
            The left result.
        scale
            It replaces the ``[scale]`` of the left test; None: that one.

        Returns
        -------
        SurfaceInUnits

        Raises
        ------
        InputError
            Lengths in px are asked for.
        """
        if scale is not None and scale.unit == "px":
            raise InputError(
                f"lengths of {result.path} are those in space, mm; for px read the result of a camera, "
                f"{result.left.path}"
            )
        mesh = Tri3Mesh(nodes=result.nodes, elements=result.elements)
        units = Units(mm_per_pixel=1.0, mm_per_pixel_std=float(result.stereo.attributes["relative_length_std"]))
        flat = Rectification(camera=None, image=mesh, mesh=mesh, units=units)
        times = np.arange(len(result), dtype=np.float64)
        return cls(result=result, scale=scale, units=units, times=times, rectified=flat)

    @cached_property
    def points(self) -> FloatArray:
        """Nodes (N, 3) on the undeformed surface, mm."""
        return np.stack([self.result.stereo[name] for name in "xyz"], axis=1)
