"""The surface in space as what reads fields of a result takes it (`rgbmidic.field.FieldSource`): mm and s.

Probes and lines are placed in px of the left reference; lengths along them, displacements and strains are those in
space.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, BinaryIO, ClassVar, Literal, Self

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.field import Displacement, Field
from rgbmidic.fields import CalibrationErrors, NodalCovariance, Rectification, StrainGauges, Units
from rgbmidic.fields.strain import STRAIN
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.results import ResultQuantity
from rgbmidic.results.quantities import derived_quantities, stored_map_quantities
from rgbmidic.results.result_in_units import ResultInUnits
from rgbmidic.settings import ScaleSettings
from rgbmidic.tools.stereo.stereo_file import QUANTITIES
from rgbmidic.tools.stereo.surface import displacement_in_space
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    from rgbmidic.tools.stereo.left_result import LeftResult


_SPACE: dict[str, Literal["displacement", "strain"]] = {
    "x": "displacement",
    "y": "displacement",
    "z": "displacement",
    "tilt": "strain",
    "epipolar_common": "displacement",
    "epipolar_change": "displacement",
}
"""Quantities of the file, with their standard uncertainty, that maps show as they are, with their kinds."""
_BIASES = ("u_bias_std", "v_bias_std", "w_bias_std")
_ROUNDING = 1e-6
"""Part of a variance that is added where the calibration's is taken off it: single precision (derived)."""


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
        if scale is not None and (scale.mm_per_pixel is not None or scale.camera is not None):
            raise InputError(
                f"lengths of {result.path} are those in space: mm_per_pixel and camera of [scale] are of one camera, "
                "leave them out"
            )
        mesh, points = Tri3Mesh(nodes=result.nodes, elements=result.elements), _points(result)
        corners = points[mesh.elements]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        mean_scale = float(np.sqrt(areas.sum() / mesh.areas.sum()))
        relative = float(result.stereo.attributes["relative_length_std"])
        units = Units(mm_per_pixel=mean_scale, mm_per_pixel_std=mean_scale * relative)
        return cls(result=result, scale=scale, rectified=Rectification(camera=None, image=mesh, mesh=mesh, units=units))

    @cached_property
    def points(self) -> FloatArray:
        """Nodes (N, 3) on the undeformed surface, mm."""
        return _points(self.result)

    @cached_property
    def covariance(self) -> NodalCovariance:
        """Covariance of the nodes' errors, with the surface in space and what its match leaves of it."""
        stereo = self.result.stereo
        shape, gain = (np.moveaxis(stereo[name], (0, -1), (-1, 0)) for name in ("shape_errors", "displacement_gain"))
        causes = shape.any(axis=(1, 2))
        errors = CalibrationErrors(surface=shape[causes].astype(np.float64), gain=gain[causes].astype(np.float64))
        matched = np.moveaxis(stereo["shape_covariance"], 0, 2) - np.einsum(
            "min,mjn->ijn", errors.surface, errors.surface
        )
        nodal = NodalCovariance.from_mesh(self.mesh)
        return replace(nodal, surface=self.points, surface_covariance=matched, calibration=errors)

    @cached_property
    def gauges(self) -> StrainGauges:
        """Virtual strain gauges around the nodes; where no length is stated, with that of the file."""
        return StrainGauges.at_nodes(self.covariance, self.gauge or float(self.result.stereo.attributes["gauge_px"]))

    @property
    def axes(self) -> tuple[str, float]:
        """Pictures are those of the left camera: in px."""
        return "px", 1.0

    @property
    def remarks(self) -> Iterator[str]:
        """Remarks on axes and lengths, a line each."""
        attributes = self.result.stereo.attributes
        yield f"u, v, w are along the axes {attributes['axes']}; lengths are those in space"
        yield "places are in px of the left camera's reference; a scale in mm per px is the mean over the surface"
        yield f"the calibration leaves {100 * float(attributes['relative_length_std']):.2g} % of every length"

    @cached_property
    def quantities(self) -> dict[str, ResultQuantity]:
        """Every nodal field by its name: of the surface, and what the left camera's result has of its match."""
        derived = derived_quantities(self.components)
        # px are of the frames here: no length on the surface, which readers turn them into
        space = [replace(QUANTITIES[name], symbol=name, kind=kind) for name, kind in _SPACE.items()]
        errors = [QUANTITIES[f"{name}_std"] for name in _SPACE]
        space = [replace(entry, unit=entry.unit.replace("px", "pixel")) for entry in (*space, *errors)]
        left = stored_map_quantities(self.result.lights, with_error=False)
        left = [entry for entry in left if not entry.name.startswith(("u_", "v_", "nodal_"))]
        entries = [*(derived[name].with_units(self.units) for name in self.components), *STRAIN.values()]
        return {entry.name: entry for entry in (*entries, *left, *space)}

    def displacement(self, frame: int) -> Displacement:
        """Read the displacement of all nodes in a frame, mm, without the part of the calibration in its uncertainty."""
        arrays = self.result.stereo.frame([*self.components, "displacement_covariance", *_BIASES], frame)
        values, bias = (np.stack([arrays[name] for name in names]) for names in (self.components, _BIASES))
        total, errors = np.moveaxis(arrays["displacement_covariance"], 0, 2), self._errors.at_nodes(values)
        covariance = total * (1 + _ROUNDING * np.eye(3)[..., None]) - np.einsum("min,mjn->ijn", errors, errors)
        return displacement_in_space(values, covariance, bias)

    def field(self, name: str, frame: int) -> Field:
        """Read one of the `quantities` with its standard uncertainty in a frame."""
        base = name.removesuffix("_std")
        if base in _SPACE:
            entry, stereo = self.quantities[name], self.result.stereo
            arrays = [np.asarray(stereo.at(one, frame), dtype=np.float64) for one in (name, f"{base}_std")]
            std = arrays[1] if name == base else None
            return Field(name=name, unit=entry.unit, dims=("node",), values=arrays[0], std=std)
        if name in self.components:
            displacement, row = self.displacement(frame), self.components.index(name)
            return displacement.components[row].with_common(self._errors.at_nodes(displacement.values)[:, row])
        return super().field(name, frame)

    def frame(self, index: int) -> dict[str, AnyArray]:
        """Return displacement, strain, and what the left camera's record has of the match, each in its type."""
        record, displacement = self.result.frame(index).values, self.displacement(index)
        columns = {name: np.asarray(record[name]) for name in ("number", "status", "node_status", "misfit")}
        fields = [self.field(name, index) for name in self.components]
        for field in (*fields, *self.gauges.strain(displacement, self.measure).values()):
            columns |= {field.name: field.values, f"{field.name}_std": field.uncertainty}
        return columns

    @property
    def exporter(self) -> Callable[[str, BinaryIO], None]:
        """The file of the result has all that is exported."""
        return self.result.stereo.export

    @property
    def _errors(self) -> CalibrationErrors:
        errors = self.covariance.calibration
        assert errors is not None
        return errors


def _points(result: LeftResult) -> FloatArray:
    return np.stack([result.stereo[name] for name in "xyz"], axis=1)
