"""Probes: displacement at points and over areas, extensometers between two points, virtual strain gauges, cracks.

A probe knows the nodes that it needs; it takes the displacements of these in some frames and returns named histories
with their standard uncertainty, from the covariance between the nodes. All probes sit on the material: their places are
those on the reference.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic import extensions
from rgbmidic.errors import InputError
from rgbmidic.field import Displacement, Field
from rgbmidic.fields.cracks import JumpAlong
from rgbmidic.fields.history import Probe, of_probe
from rgbmidic.fields.interpolation import MeshPoints, PointSum
from rgbmidic.fields.nodal import NodalCovariance
from rgbmidic.fields.plane import Rectification
from rgbmidic.fields.quantity import Units
from rgbmidic.fields.strain import MEASURES, Strain, StrainGauges, strain_of_gradient
from rgbmidic.fields.tangent_plane import gradient_errors, in_tangent_plane
from rgbmidic.renamed import state_new_names
from rgbmidic.settings import ProbeSettings
from rgbmidic.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeConstants:
    """Numbers by which places are laid and judged.

    Attributes
    ----------
    min_fraction
        Least part of an area that must be measured for its mean to be stated: the larger part represents the whole.
    complete_fraction
        Part of a place from which nothing is said of the rest, which is rounding of its points. Chosen.
    rounding
        Of a sum of weights.
    edge
        Part of a strain gauge by which one whose middle lies on a straight edge may hold less than half: its points on
        the edge, a twentieth of a gauge of 25 px.
    step
        Distance in px of the points that stand for a line or an area: an element of 10 px holds some 40.
    """

    min_fraction: float = 0.5
    complete_fraction: float = 0.995
    rounding: float = 1e-9
    edge: float = 0.05
    step: float = 1.0


_CONSTANTS = ProbeConstants()


@state_new_names
@dataclass(kw_only=True, eq=False)
class Mean:
    """Displacement at a point, or its mean along a line or over an area: u and v.

    Attributes
    ----------
    name
        See `Probe`.
    sum
        Over points that stand for the place.
    covariance
        Of the nodes' errors.
    min_fraction
        Part of the points in the region that must be measured; the mean is that of the measured part.

    Examples
    --------
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 80, 60), shape=(80, 100)), element_size=20)
    >>> probe = make_probe(NodalCovariance.from_mesh(mesh), "point", 1, (40, 30))
    >>> type(probe) is Mean, probe.name
    (True, 'point_1')
    """

    name: str
    sum: PointSum
    covariance: NodalCovariance
    min_fraction: float = 1.0

    @classmethod
    def over(
        cls,
        covariance: NodalCovariance,
        name: str,
        points: npt.ArrayLike,
        min_fraction: float = 1.0,
        factors: npt.ArrayLike | None = None,
    ) -> Mean:
        """Average over points (P, 2) that stand for a place, px.

        Parameters
        ----------
        covariance
            Of the mesh.
        name
            Name of the probe.
        points : array_like, shape (P, 2)
            Points (x, y) on the reference, px.
        min_fraction
            Fraction of the points that must have data in a frame.
        factors : array_like, shape (P,), optional
            Of the points; None: equal ones, whose sum is 1.

        Returns
        -------
        Mean

        Raises
        ------
        InputError
            A point is outside the region.
        """
        mesh_points = MeshPoints.of(covariance.mesh, points)
        mesh_points.check(name)
        equal = np.full(len(mesh_points.points), 1 / len(mesh_points.points))
        points_sum = PointSum.over(mesh_points, equal if factors is None else np.asarray(factors, dtype=np.float64))
        return cls(name=name, sum=points_sum, covariance=covariance.subset(points_sum.nodes), min_fraction=min_fraction)

    @property
    def nodes(self) -> IntArray:
        """See `Probe`."""
        return self.sum.nodes

    def histories(self, displacement: Displacement) -> list[Field]:
        """Compute each component of the displacement.

        Parameters
        ----------
        displacement
            Of its `nodes` in every frame, shape (c, T, m).

        Returns
        -------
        list of Field
        """
        weights, measured = self.weights(displacement.is_measured)
        return self._displacement_histories(displacement, weights[:, 0], measured)

    def _displacement_histories(
        self, displacement: Displacement, weights: FloatArray, measured: FloatArray
    ) -> list[Field]:
        note = _coverage_note(self.name, "mean", self.sum.inside * measured)
        means = [self.average(weights, one) for one in displacement.components]
        if (calibration := self.covariance.calibration) is not None:
            errors = calibration.of_sums(weights[:, None], displacement.values)[1][..., 0]
            means = [mean.with_common(errors[..., row]) for row, mean in enumerate(means)]
        return of_probe(self.name, means, note)

    def weights(self, has_data: BoolArray, *, linear: bool = False) -> tuple[FloatArray, FloatArray]:
        """Compute the weights of the nodes in the mean, and for an area in those of the slopes, in every frame.

        Parameters
        ----------
        has_data : ndarray, shape (T, m), bool
            Nodes that have data.
        linear
            As of `PointSum.weights`.

        Returns
        -------
        weights : ndarray, shape (T, S, m)
            Of the S sums of `PointSum`; NaN where too few points are measured.
        measured : ndarray, shape (T,)
            Fraction of the points in the region that are measured; 1 where they are too few.
        """
        patterns, frame = np.unique(has_data, axis=0, return_inverse=True)
        shape = len(patterns), len(self.sum.moments), has_data.shape[1]
        weights, measured = np.full(shape, np.nan), np.ones(len(patterns))
        for row, pattern in enumerate(patterns):
            sums, fraction = self.sum.weights(pattern, linear=linear)
            if fraction >= self.min_fraction - _CONSTANTS.rounding:
                weights[row], measured[row] = sums / fraction, fraction
        return weights[frame.ravel()], measured[frame.ravel()]

    def average(self, weights: FloatArray, field: Field) -> Field:
        """Average a component of the displacement over the nodes.

        Parameters
        ----------
        weights : ndarray, shape (T, m)
            Of the nodes, see `weights`.
        field
            Of the nodes, shape (T, m).

        Returns
        -------
        Field
            Of the shape (T,).
        """
        variance = self.covariance.variance(weights, field)
        mean = _products(weights, field.values).sum(axis=1)
        return replace(field, dims=("frame",), values=mean, std=np.sqrt(variance), bias=None)

    def average_bound(self, weights: FloatArray, field: Field) -> Field:
        """Average another quantity, whose errors are taken as the same at all nodes: the most that they can add up to.

        Parameters
        ----------
        weights, field
            As of `average`.

        Returns
        -------
        Field
        """
        mean = replace(field, bias=None).with_arrays(lambda array: _products(weights, array).sum(axis=1))
        return replace(mean, dims=("frame",))


def _products(weights: FloatArray, values: FloatArray) -> FloatArray:
    """Multiply values (T, m) by weights; those of the weight 0, which may be NaN, give 0."""
    return np.multiply(weights, values, out=np.zeros(weights.shape), where=weights != 0)


def _coverage_note(name: str, quantity: str, coverage: FloatArray) -> str:
    """Return a note on a probe whose `coverage` (T,) by measured points is not complete in all frames."""
    min_coverage = float(coverage.min(initial=1.0))
    if min_coverage > _CONSTANTS.complete_fraction:
        return ""
    return (
        f"{name} is the {quantity} of {min_coverage:.0%} of its place at least: the rest lies outside the region "
        "or has no data"
    )


def _line(x0: float, y0: float, x1: float, y1: float) -> FloatArray:
    return np.linspace((x0, y0), (x1, y1), int(np.hypot(x1 - x0, y1 - y0) / _CONSTANTS.step) + 2)


def _rectangle(x0: float, y0: float, x1: float, y1: float) -> FloatArray:
    """Make the points (P, 2) that stand for the cells of a rectangle."""
    axes = []
    for low, high in ((min(x0, x1), max(x0, x1)), (min(y0, y1), max(y0, y1))):
        count = max(int(np.ceil((high - low) / _CONSTANTS.step)), 1)
        axes.append(low + (np.arange(count) + 0.5) * (high - low) / count)
    x, y = np.meshgrid(*axes)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _circle(x: float, y: float, radius: float) -> FloatArray:
    grid = _rectangle(x - radius, y - radius, x + radius, y + radius)
    return grid[np.hypot(grid[:, 0] - x, grid[:, 1] - y) <= radius]


class Gauge:
    """An extensometer between two points: extension and strain, extension over length; in space also the length.

    Parameters
    ----------
    covariance
        Of the mesh.
    name
        Name of the gauge.
    *place
        Ends x0, y0, x1, y1 in px on the reference.
    moving
        Whether the length is that between the points as they move; else the extension along the line as it was.

    Raises
    ------
    InputError
        A point is outside the region, or both are the same.
    """

    def __init__(self, covariance: NodalCovariance, name: str, *place: float, moving: bool = True) -> None:
        ends = np.array(place, dtype=np.float64).reshape(2, 2)
        self.name, self.moving, self.arm = name, moving, ends[1] - ends[0]
        if not np.hypot(*self.arm) > 0:
            raise InputError(f"{name} needs two different points, not ({place[0]:g}, {place[1]:g}) twice")
        self._relative = Mean.over(covariance, name, ends, factors=(-1, 1))
        self.nodes = self._relative.nodes
        if covariance.surface is not None:
            weights = self._relative.weights(np.ones((1, len(self.nodes)), dtype=bool))[0]
            self.arm = weights[0, 0] @ covariance.surface[self.nodes]

    def histories(self, displacement: Displacement) -> list[Field]:
        """Compute the extension and the strain from the displacements of its `nodes` in every frame."""
        weights, nodal = self._relative.weights(displacement.is_measured)[0], self._relative.covariance
        relative = np.stack([_products(weights[:, 0], values).sum(axis=1) for values in displacement.values], axis=1)
        covariance, length = nodal.of_sums(weights, displacement), float(np.linalg.norm(self.arm))
        values, towards = self._lengths(self.arm, relative)
        std = np.sqrt(np.einsum("ta,tab,tb->t", towards, covariance, towards))
        stds, names = [std, std / length], ("extension", "strain", "length")
        if nodal.surface is not None and nodal.surface_covariance is not None and self.moving:
            surface = Displacement(values=nodal.surface.T, covariance=nodal.surface_covariance)
            shape = np.einsum("ta,tab,tb->t", towards, nodal.of_sums(weights, surface), towards)
            stds.append(np.sqrt(std**2 + shape))
        units = displacement.unit, "", displacement.unit
        fields = [
            Field(name=n, unit=u, values=v, std=s) for n, u, v, s in zip(names, units, values, stds, strict=False)
        ]
        if nodal.calibration is not None:
            of_arm, of_relative = (one[..., 0] for one in nodal.calibration.of_sums(weights, displacement.values))
            changed = self._lengths(self.arm + of_arm, relative + of_relative)[0] - values[:, None]
            fields = [field.with_common(errors) for field, errors in zip(fields, changed, strict=False)]
        return of_probe(self.name, fields)

    def _lengths(self, arm: FloatArray, relative: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return extension, strain and length (3, ...) of arms (..., c) and the direction of the deformed ones."""
        deformed = arm + relative if self.moving else np.broadcast_to(arm, relative.shape)
        length, deformed_length = (np.linalg.norm(one, axis=-1) for one in (arm, deformed))
        towards = deformed / deformed_length[..., None]
        extension = deformed_length - length if self.moving else (towards * relative).sum(axis=-1)
        return np.stack([extension, extension / length, deformed_length]), towards


class StrainGauge:
    """A virtual strain gauge: strain, principal strains with their direction, equivalent of the Hencky strain.

    Parameters
    ----------
    covariance
        Of the mesh.
    name
        Name of the gauge.
    x, y
        Its middle in px on the reference.
    length
        Its length in px.
    measure
        Strain measure, as of `strain_of`.

    Raises
    ------
    InputError
        It is too short, or half of it or more is outside the region.
    """

    def __init__(
        self, covariance: NodalCovariance, name: str, x: float, y: float, length: float, *, measure: str = MEASURES[0]
    ) -> None:
        gauges = StrainGauges.at_points(covariance, np.array([[x, y]]), length)
        self.name, self.measure, self.nodes = name, measure, np.unique(gauges.nodes)
        self.gauges, self.covariance = gauges.of_nodes(self.nodes), covariance.subset(self.nodes)
        mesh_points = MeshPoints.of(covariance.mesh, _circle(x, y, gauges.length / 2))
        self.inside = float(mesh_points.inside.mean())
        if self.inside < _CONSTANTS.min_fraction - _CONSTANTS.edge:
            raise InputError(f"half or more of {name} is outside {mesh_points.bounds_text}")

    def histories(self, displacement: Displacement) -> list[Field]:
        """Compute every quantity of the strain from the displacements of its `nodes` in every frame.

        They are NaN where less than half of the nodes, as they count, is measured.
        """
        patterns, frame = np.unique(has_data := displacement.is_measured, axis=0, return_inverse=True)
        slopes = np.stack([self.gauges.weights(pattern) for pattern in patterns])[frame.ravel()]
        measured_fraction = has_data[:, self.gauges.nodes] @ (self.gauges.fractions / self.gauges.fractions.sum())
        slopes[measured_fraction < _CONSTANTS.min_fraction - _CONSTANTS.rounding] = np.nan
        strain = _strain(slopes, displacement, self.covariance, self.measure)
        coverage = np.where(np.isfinite(strain["exx"].values), measured_fraction, 1.0)
        return of_probe(self.name, strain.values(), _coverage_note(self.name, "strain", self.inside * coverage))


def _strain(slopes: FloatArray, displacement: Displacement, covariance: NodalCovariance, measure: str) -> Strain:
    """Compute the strain (T,) of the displacement gradient that weights (T, 2, m) of the nodes give."""
    gradient = np.stack([_products(slopes, values[:, None]).sum(axis=2) for values in displacement.values], axis=1)
    spread = covariance.of_sums(slopes, displacement)
    if covariance.surface is None:
        return strain_of_gradient(gradient, spread, measure)
    tangents = np.stack([_products(slopes, nodes).sum(axis=2) for nodes in covariance.surface.T], axis=1)
    in_plane, spread = in_tangent_plane(tangents, gradient, spread)
    strain = strain_of_gradient(in_plane, spread, measure)
    if covariance.calibration is not None:
        of_sums = covariance.calibration.of_sums(slopes, displacement.values)
        errors = gradient_errors(tangents, gradient, *of_sums).reshape(-1, *in_plane.shape)
        changed = strain_of_gradient(in_plane + errors, np.zeros((*errors.shape[:2], 4, 4)), measure)
        for name, field in strain.items():
            change = changed[name].values - field.values
            strain[name] = field.with_common((change + 90) % 180 - 90 if name == "direction" else change)
    return strain


class Area(Mean):
    """Mean displacement over an area, and the strain of the mean displacement gradient over it.

    The mean gradient is that of the displacement around the area alone (Gauss).

    Parameters
    ----------
    covariance
        Of the mesh.
    name
        Name of the probe.
    points : ndarray, shape (P, 2)
        Middles of equal parts of the area on the reference, px.
    measure
        Strain measure, as of `strain_of`.

    Raises
    ------
    InputError
        Half of the area or more is outside the region.

    Examples
    --------
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 80, 60), shape=(80, 100)), element_size=20)
    >>> area = make_probe(NodalCovariance.from_mesh(mesh), "region", 1, (20, 20, 60, 40))
    >>> type(area) is Area, area.name
    (True, 'region_1')
    """

    def __init__(self, covariance: NodalCovariance, name: str, points: FloatArray, measure: str = MEASURES[0]) -> None:
        mesh_points = MeshPoints.of(covariance.mesh, points)
        if mesh_points.inside.mean() < _CONSTANTS.min_fraction:
            raise InputError(f"half or more of {name} is outside {mesh_points.bounds_text}")
        area = PointSum.over(mesh_points, mesh_points.inside / mesh_points.inside.sum(), slopes=True)
        super().__init__(
            name=name, sum=area, covariance=covariance.subset(area.nodes), min_fraction=_CONSTANTS.min_fraction
        )
        self.measure = measure

    def histories(self, displacement: Displacement) -> list[Field]:
        """Compute each component of the displacement, then every quantity of the strain.

        Parameters
        ----------
        displacement
            Of its `nodes` in every frame, shape (c, T, m).

        Returns
        -------
        list of Field
        """
        weights, measured = self.weights(displacement.is_measured)
        means = self._displacement_histories(displacement, weights[:, 0], measured)
        strain = _strain(weights[:, 1:], displacement, self.covariance, self.measure)
        return [*means, *of_probe(self.name, strain.values(), means[0].note)]


PROBES: dict[str, tuple[int, int, Callable[..., Probe] | None]] = {
    "point": (1, 0, lambda c, name, *place: Mean.over(c, name, [place])),
    "line": (2, 0, lambda c, name, *place: Mean.over(c, name, _line(*place), _CONSTANTS.min_fraction)),
    "circle": (1, 1, lambda c, name, *place, **more: Area(c, name, _circle(*place), **more)),
    "region": (2, 0, lambda c, name, *place, **more: Area(c, name, _rectangle(*place), **more)),
    "gauge": (2, 0, Gauge),
    "straight_gauge": (2, 0, partial(Gauge, moving=False)),
    "strain_gauge": (1, 1, StrainGauge),
    "crack": (2, 0, JumpAlong),
    "tip": (1, 2, None),
}
"""Kinds of probes with how many points and lengths (px) place them, and what makes them; None: a tool."""
_STRAINED = ("circle", "region", "strain_gauge")
"""Those that measure a strain of a stated measure."""


def make_probe(
    covariance: NodalCovariance,
    kind: str,
    number: int,
    coordinates: Sequence[float],
    settings: ProbeSettings | None = None,
    rectified: Rectification | None = None,
) -> Probe:
    """Make a probe, named by its kind and number, or as the settings do.

    Parameters
    ----------
    covariance
        Of the mesh, in rectified px where `rectified` is given.
    kind
        One of `PROBES`.
    number
        Counted from 1 within the kind.
    coordinates
        The numbers of `PROBES`, px of the image.
    settings
        Strain measure of a strain gauge; material and fit of a crack's tip; names. None: the defaults.
    rectified
        Change from px of the image, and the scale, which a crack's tip needs; None: places are in px of the mesh.

    Returns
    -------
    Probe

    Raises
    ------
    InputError
        The place is outside the region, or no place for it.

    Examples
    --------
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 80, 60), shape=(80, 100)), element_size=20)
    >>> gauge = make_probe(NodalCovariance.from_mesh(mesh), "gauge", 1, (20, 30, 60, 30))
    >>> zero = np.zeros((2, len(gauge.nodes)))
    >>> still = Displacement.in_plane(zero, zero, zero + 0.01, zero + 0.01)
    >>> [(history.name, history.values.tolist()) for history in gauge.histories(still)][:1]
    [('gauge_1_extension', [0.0, 0.0])]
    """
    (points, lengths, make), settings = PROBES[kind], settings or ProbeSettings()
    name = dict(settings.names).get(f"{kind}_{number}", f"{kind}_{number}")
    if covariance.surface is not None and kind in ("crack", "tip"):
        raise InputError(f"{name}: cracks are measured in a plane, not on a surface in space: take one camera's result")
    if len(coordinates) != 2 * points + lengths:
        raise InputError(f"{name} is placed by {2 * points + lengths} numbers, not by {list(coordinates)}")
    more: dict[str, Any] = {"measure": settings.measure} if kind in _STRAINED else {}
    if make is None:
        make = extensions.load_extension(extensions.PROBES, kind, f"probes.{kind}s")
        more = {"settings": settings, "units": Units() if rectified is None else rectified.units}
    rectified_coordinates = np.asarray(
        coordinates if rectified is None else rectified.probe_coordinates(coordinates, points), dtype=np.float64
    )
    nodes = covariance.mesh.nodes
    if not (
        np.abs(rectified_coordinates) <= np.abs(nodes).max() + 2 * np.ptp(nodes, axis=0).max()
    ).all():  # too far to be sampled
        bounds_text = MeshPoints.of(covariance.mesh, nodes[:1]).bounds_text
        raise InputError(f"half or more of {name} is outside {bounds_text}; given is {list(coordinates)}")
    return make(covariance, name, *rectified_coordinates.tolist(), **more)
