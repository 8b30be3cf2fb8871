"""From both cameras' displacements of one frame to the motion of the surface in space."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.fields import NodalCovariance, StrainGauges
from rgbmidic.results import Result
from rgbmidic.tools.stereo.axes import Axes, AxesChoice
from rgbmidic.tools.stereo.calibration_part import CalibrationPart
from rgbmidic.tools.stereo.camera_pair import CameraPair
from rgbmidic.tools.stereo.carried_mesh import CarriedMesh
from rgbmidic.tools.stereo.surface import attitude, displacement_in_space
from rgbmidic.tools.stereo.triangulation import Triangulation, triangulate
from rgbmidic.typing import AnyArray, FloatArray

_EXACT = 1e-4
"""Standard uncertainty (px) of what is exact by definition: a node in the left reference, a frame that is the only
reference. Weights stay finite; it is a tenth of the smallest that is stated of a match."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoLimits:
    """Limits of the epipolar residual from which a stereo result warns.

    Attributes
    ----------
    residual
        rms (px) up to which nothing is reported: a sound calibration of a real rig left .05 px (prototype, Stereo-DIC
        Challenge 1.0, sample 3), which moves the shape by as many px.
    factor
        The same over the stated uncertainty.
    outlier
        Deviation of a node's residual from the median, over the scatter of all or the stated one, from which its match
        is in doubt: six standard deviations are no chance.
    """

    residual: float = 0.06
    factor: float = 3.0
    outlier: float = 6.0


LIMITS = StereoLimits()
MATCHED = ("u", "v", "u_std", "v_std", "u_bias_std", "v_bias_std", "node_status")
"""Quantities of a camera's result that are triangulated."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shape:
    """The undeformed surface, and what every frame needs of it.

    Attributes
    ----------
    pair, carried_mesh
        Cameras, and the mesh in both frames.
    triangulation
        Of the reference states, left camera's axes.
    axes
        In which results are.
    points, covariance : ndarray, shapes (N, 3) and (N, 3, 3)
        The surface in these axes, mm, and its covariance by the match of the references and the calibration.
    gauges, measure
        Of the surface strain.
    calibration
        The part of the calibration.
    """

    pair: CameraPair
    carried_mesh: CarriedMesh
    triangulation: Triangulation
    axes: Axes
    points: FloatArray
    covariance: FloatArray
    gauges: StrainGauges
    measure: str
    calibration: CalibrationPart

    @classmethod
    def of(
        cls,
        pair: CameraPair,
        carried_mesh: CarriedMesh,
        *,
        axes: AxesChoice = "plane",
        gauge: float | None = None,
        measure: str = "green-lagrange",
    ) -> Shape:
        """Triangulate the reference states.

        Parameters
        ----------
        pair, carried_mesh
            Cameras, and the mesh in both frames.
        axes
            As of `Axes.of`.
        gauge
            Length of the virtual strain gauges in px of the left frame; None: the shortest.
        measure
            Strain measure.

        Returns
        -------
        Shape

        Raises
        ------
        InputError
            A node lies where a lens has no inverse or behind a camera, or axes and gauge are not possible.
        """
        spread = _diagonal(np.zeros_like(carried_mesh.right_std), carried_mesh.right_std)
        pixels = carried_mesh.left.nodes, carried_mesh.right.nodes
        shape, exchanged = (
            triangulate(cameras, *pixels, spread, _weights(spread)) for cameras in (pair, pair.exchanged)
        )
        if not _is_plausible(shape) and _is_plausible(exchanged):
            raise InputError(f"LEFT and RIGHT are exchanged: their references fit the cameras of {pair.name} so only")
        if not _is_in_front(shape):
            raise InputError(f"{pair.name}: the references of both cameras do not meet in front of the cameras")
        axes_in_space = Axes.of(axes, carried_mesh.left, shape.points)
        points = axes_in_space.points(shape.points)
        calibration = CalibrationPart.of(pair, carried_mesh.left, shape, axes)
        nodal = NodalCovariance.from_mesh(carried_mesh.left)
        nodal = replace(nodal, surface=points, calibration=calibration.errors)
        return cls(
            pair=pair,
            carried_mesh=carried_mesh,
            triangulation=shape,
            axes=axes_in_space,
            points=points,
            covariance=axes_in_space.covariance(shape.covariance) + _covariance_of(calibration.errors.surface),
            gauges=StrainGauges.at_nodes(nodal, gauge),
            measure=measure,
            calibration=calibration,
        )

    def frame(self, left: Mapping[str, Any], right: Mapping[str, Any]) -> dict[str, AnyArray]:
        """Compute what a frame shows of the surface.

        Parameters
        ----------
        left, right
            `MATCHED` quantities of the N nodes of the carried mesh in either test.

        Returns
        -------
        dict
            Quantities of `rgbmidic.tools.stereo.stereo_file.QUANTITIES` that a frame has, by name.
        """
        displacements, stds, biases = (
            [np.stack([side[f"u{end}"], side[f"v{end}"]], axis=1, dtype=np.float64) for side in (left, right)]
            for end in ("", "_std", "_bias_std")
        )
        spread = _diagonal(*stds)
        weights = _weights(spread)
        nodes = self.carried_mesh.left.nodes, self.carried_mesh.right.nodes
        deformed = triangulate(self.pair, nodes[0] + displacements[0], nodes[1] + displacements[1], spread, weights)
        # with the same weights: the error of the shape is in both, and cancels in their difference
        reference = triangulate(self.pair, *nodes, spread, weights)
        displacement = (deformed.points - reference.points) @ self.axes.rotation.T
        covariance = self.axes.covariance(deformed.covariance)
        gain = self.axes.rotation @ deformed.gain
        bias = np.sqrt(np.einsum("nij,nj->ni", gain**2, np.nan_to_num(np.concatenate(biases, axis=1)) ** 2))
        field = displacement_in_space(displacement.T, np.moveaxis(covariance, 0, 2))
        strain, (normal, tilt) = self.gauges.strain(field, self.measure), attitude(self.gauges, field)
        covariance = covariance + _covariance_of(self.calibration.errors.at_nodes(displacement.T))
        std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        values: dict[str, AnyArray] = {
            "displacement_covariance": covariance,
            "epipolar_change": deformed.residual - reference.residual,
            "epipolar_change_std": deformed.residual_std,
            "normal": normal,
            "tilt": tilt.values,
            "tilt_std": tilt.uncertainty,
            "left_status": np.asarray(left["node_status"]),
            "right_status": np.asarray(right["node_status"]),
        }
        values |= dict(zip(("u_bias_std", "v_bias_std", "w_bias_std"), bias.T, strict=True))
        for column, name in enumerate("uvw"):
            values |= {name: displacement[:, column], f"{name}_std": std[:, column]}
        for name in ("exx", "eyy", "exy", "e1", "e2", "direction"):
            values |= {name: strain[name].values, f"{name}_std": strain[name].uncertainty}
        return values

    def doubts(self, changes: FloatArray, expected: FloatArray) -> Iterator[str]:
        """Yield warnings about the epipolar residual.

        Parameters
        ----------
        changes, expected : ndarray, shape (T,)
            rms over the nodes of its change since the reference in each frame, and of what is stated of it, px.

        Yields
        ------
        str
        """
        shape = self.triangulation
        common = float(np.sqrt(np.mean(shape.residual**2)))
        common_std = float(np.sqrt(np.mean(shape.residual_std**2) + self.calibration.epipolar_std**2))
        if common > max(LIMITS.residual, LIMITS.factor * common_std):
            yield (
                f"the epipolar residual common to all frames is {common:.3f} px rms, stated are {common_std:.3f} px: "
                f"the cameras do not stand as {self.pair.name} states, and the shape is in doubt by as many px: "
                "calibrate again (rgbmidic-calibrate stereo)"
            )
        deviation = np.abs(shape.residual - np.median(shape.residual))
        scatter = np.maximum(1.4826 * np.median(deviation), shape.residual_std)
        if wrong := int((deviation > np.maximum(LIMITS.outlier * scatter, LIMITS.residual)).sum()):
            yield (
                f"at {wrong} of {len(deviation)} nodes the references are in doubt: their epipolar residual is off by "
                f"up to {deviation.max():.3f} px from that of the others (epipolar_common); their shape is, too"
            )
        off = np.flatnonzero(changes > np.maximum(LIMITS.residual, LIMITS.factor * expected))
        if len(off):
            worst = off[np.argmax(changes[off])]
            yield (
                f"the epipolar residual changes in {len(off)} frames, by {changes[worst]:.3f} px rms in frame {worst} "
                f"where {expected[worst]:.3f} px are stated: a camera moved or the frames of both cameras were not "
                "taken at one time"
            )


def _is_in_front(surface: Triangulation) -> bool:
    return bool(np.isfinite(surface.points).all() and (surface.points[:, 2] > 0).all())


def _is_plausible(surface: Triangulation) -> bool:
    """Report whether the rays of a surface meet in front of the cameras but for what is not worth a warning."""
    rms, std = (np.sqrt(np.mean(array**2)) for array in (surface.residual, surface.residual_std))
    return _is_in_front(surface) and bool(rms <= max(LIMITS.residual, LIMITS.factor * std))


def nodal_values(result: Result, frame: int, nodes: AnyArray | slice = slice(None)) -> dict[str, AnyArray]:
    """Read what `Shape.frame` needs of some nodes of a frame."""
    values = result.table.read(frame, [*MATCHED, "number", "status"])
    return {name: values[name][nodes] if name in MATCHED else values[name] for name in values}


def _covariance_of(errors: FloatArray) -> FloatArray:
    """Return the covariance (N, 3, 3) of independent errors (M, 3, N) of unit variance."""
    return np.asarray(np.einsum("min,mjn->nij", errors, errors))


def _weights(covariance: FloatArray) -> FloatArray:
    """Return the inverse of covariances (N, 4, 4), finite where a coordinate is exact or has no data."""
    finite = np.where(np.isfinite(covariance), covariance, 1.0)
    return np.asarray(np.linalg.inv(finite + _EXACT**2 * np.eye(4)), dtype=np.float64)


def _diagonal(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return covariances (N, 4, 4) of independent coordinates with standard uncertainties (N, 2) in either frame."""
    return np.asarray(np.concatenate([left, right], axis=1)[:, :, None] ** 2 * np.eye(4))
