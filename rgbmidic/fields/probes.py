"""Probes: displacement at points and over areas, extensometers between two points, virtual strain gauges, cracks.

A probe knows the nodes that it needs; it takes the displacements of these in some frames and returns named histories
with their standard uncertainty, from the covariance between the nodes. All probes sit on the material: their places are
those on the reference.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.fields.crack_tip import CrackTip, Williams
from rgbmidic.fields.cracks import JumpAlong
from rgbmidic.fields.history import History, Nodal, Probe, histories_of
from rgbmidic.fields.interpolation import MeshPoints, PointSum
from rgbmidic.fields.nodal import NodalCovariance
from rgbmidic.fields.plane import Rectification
from rgbmidic.fields.strain import MEASURES, Strain, StrainGauges, strain_of_gradient
from rgbmidic.fields.units import Units
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

    def histories(self, nodal: Nodal) -> list[History]:
        """Compute u and v in px.

        Parameters
        ----------
        nodal
            Displacements of its `nodes` in every frame.

        Returns
        -------
        list of History
        """
        weights, measured = self.weights(_has_data(nodal))
        return self._displacement_histories(nodal, weights[:, 0], measured)

    def _displacement_histories(self, nodal: Nodal, weights: FloatArray, measured: FloatArray) -> list[History]:
        u, v = (self.average(weights, *component) for component in nodal.components)
        note = _coverage_note(self.name, "mean", self.sum.inside * measured)
        return histories_of(self.name, [("u", "px", *u), ("v", "px", *v)], note)

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

    def average(
        self, weights: FloatArray, values: FloatArray, std: FloatArray, bias: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Average a quantity (T, m) of the nodes, with its standard uncertainty, each (T,).

        The errors are correlated between nodes as those of a displacement; of another quantity, without a `bias`, they
        are taken as the same at all nodes, which is the most that they can add up to.

        Parameters
        ----------
        weights : ndarray, shape (T, m)
            Of the nodes, see `weights`.
        values, std : ndarray, shape (T, m)
            The quantity and its standard uncertainty.
        bias : ndarray, shape (T, m)
            The part of a displacement's uncertainty that the lights' bias leaves.

        Returns
        -------
        values, std : ndarray, shape (T,)
        """
        mean = _products(weights, values).sum(axis=1)
        if bias is None:
            return mean, _products(weights, std).sum(axis=1)
        return mean, np.sqrt(self.covariance.variance(weights, std, bias))


def _products(weights: FloatArray, values: FloatArray) -> FloatArray:
    """Multiply values (T, m) by weights; those of the weight 0, which may be NaN, give 0."""
    return np.multiply(weights, values, out=np.zeros(weights.shape), where=weights != 0)


def _has_data(nodal: Nodal) -> BoolArray:
    return np.isfinite(nodal.u + nodal.v + nodal.u_std + nodal.v_std)


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
    """An extensometer between two points: extension in px and strain, extension over length.

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

    def histories(self, nodal: Nodal) -> list[History]:
        """Compute the extension in px and the strain from the displacements of its `nodes` in every frame."""
        length, weights = float(np.hypot(*self.arm)), self._relative.weights(_has_data(nodal))[0][:, 0]
        relative_displacement, spread = np.stack(
            [self._relative.average(weights, *component) for component in nodal.components], axis=2
        )
        deformed_arm = (
            self.arm + relative_displacement if self.moving else np.broadcast_to(self.arm, relative_displacement.shape)
        )
        towards = deformed_arm / np.hypot(*deformed_arm.T)[:, None]
        extension = np.hypot(*deformed_arm.T) - length if self.moving else (towards * relative_displacement).sum(axis=1)
        std = np.hypot(*(towards * spread).T)
        quantities = [("extension", "px", extension, std), ("strain", "", extension / length, std / length)]
        return histories_of(self.name, quantities)


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

    def histories(self, nodal: Nodal) -> list[History]:
        """Compute strain, principal strains and equivalent from the displacements of its `nodes` in every frame.

        They are NaN where less than half of the nodes, as they count, is measured.
        """
        patterns, frame = np.unique(has_data := _has_data(nodal), axis=0, return_inverse=True)
        slopes = np.stack([self.gauges.weights(pattern) for pattern in patterns])[frame.ravel()]
        measured_fraction = has_data[:, self.gauges.nodes] @ (self.gauges.fractions / self.gauges.fractions.sum())
        slopes[measured_fraction < _CONSTANTS.min_fraction - _CONSTANTS.rounding] = np.nan
        strain = _strain(slopes, nodal, self.covariance, self.measure)
        coverage = np.where(np.isfinite(strain.components[:, 0]), measured_fraction, 1.0)
        return _strain_histories(self.name, strain, _coverage_note(self.name, "strain", self.inside * coverage))


def _strain(slopes: FloatArray, nodal: Nodal, covariance: NodalCovariance, measure: str) -> Strain:
    """Compute the strain (T,) of the displacement gradient that weights (T, 2, m) of the nodes give."""
    gradient, spread = np.zeros((len(slopes), 2, 2)), np.zeros((len(slopes), 4, 4))
    for row, (value, std, bias) in enumerate(nodal.components[:, :, :, None]):
        gradient[:, row] = _products(slopes, value).sum(axis=2)
        errors, block = covariance.errors(slopes, std, bias), slice(2 * row, 2 * row + 2)
        spread[:, block, block] = errors @ errors.swapaxes(1, 2)
    return strain_of_gradient(gradient, spread, measure)


def _strain_histories(name: str, strain: Strain, note: str) -> list[History]:
    """Return every quantity of a strain (T,) as a history."""
    values = [*strain.components.T, *strain.principal.T, strain.direction_deg, strain.equivalent]
    stds = [*strain.components_std.T, *strain.principal_std.T, strain.direction_std_deg, strain.equivalent_std]
    names = "exx", "eyy", "exy", "e1", "e2", "direction", "equivalent"
    units = ("deg" if quantity == "direction" else "" for quantity in names)
    return histories_of(name, zip(names, units, values, stds, strict=True), note)


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

    def histories(self, nodal: Nodal) -> list[History]:
        """Compute u and v in px, then strain, principal strains and equivalent strain.

        Parameters
        ----------
        nodal
            Displacements of its `nodes` in every frame.

        Returns
        -------
        list of History
        """
        weights, measured = self.weights(_has_data(nodal))
        displacements = self._displacement_histories(nodal, weights[:, 0], measured)
        strain = _strain(weights[:, 1:], nodal, self.covariance, self.measure)
        return [*displacements, *_strain_histories(self.name, strain, displacements[0].note)]


PROBES: dict[str, tuple[int, int, Callable[..., Probe]]] = {
    "point": (1, 0, lambda c, name, *place: Mean.over(c, name, [place])),
    "line": (2, 0, lambda c, name, *place: Mean.over(c, name, _line(*place), _CONSTANTS.min_fraction)),
    "circle": (1, 1, lambda c, name, *place, **more: Area(c, name, _circle(*place), **more)),
    "region": (2, 0, lambda c, name, *place, **more: Area(c, name, _rectangle(*place), **more)),
    "gauge": (2, 0, Gauge),
    "straight_gauge": (2, 0, partial(Gauge, moving=False)),
    "strain_gauge": (1, 1, StrainGauge),
    "crack": (2, 0, JumpAlong),
    "tip": (1, 2, CrackTip),
}
"""Every kind of probe with how many points and lengths (px) place it, and what makes it."""
_STRAINED = ("circle", "region", "strain_gauge")
"""Those that measure a strain of a stated measure."""
_OF_TIPS = ("youngs_modulus", "poissons_ratio", "plane", "terms", "fit_tip")
"""Settings of a crack's tip, which [probes] with tips checks, as `Williams` takes them."""


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
    >>> still = Nodal(u=zero, v=zero, u_std=zero + 0.01, v_std=zero + 0.01)
    >>> [(history.name, history.values.tolist()) for history in gauge.histories(still)][:1]
    [('gauge_1_extension', [0.0, 0.0])]
    """
    (points, lengths, make), settings = PROBES[kind], settings or ProbeSettings()
    name = dict(settings.names).get(f"{kind}_{number}", f"{kind}_{number}")
    if len(coordinates) != 2 * points + lengths:
        raise InputError(f"{name} is placed by {2 * points + lengths} numbers, not by {list(coordinates)}")
    more: dict[str, Any] = {"measure": settings.measure} if kind in _STRAINED else {}
    if kind == "tip":
        tip_settings: dict[str, Any] = {name: getattr(settings, name) for name in _OF_TIPS}
        more["williams"] = Williams(units=Units() if rectified is None else rectified.units, **tip_settings)
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
