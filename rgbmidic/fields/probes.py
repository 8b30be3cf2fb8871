"""Probes: displacement at points and over areas, extensometers between two points, virtual strain gauges, cracks.

A probe knows the nodes that it needs; it takes the displacements of these in some frames and returns named histories
with their standard uncertainty, from the covariance between the nodes. All probes sit on the material: their places are
those on the reference.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.fields.crack_tip import CrackTip, Williams
from rgbmidic.fields.cracks import JumpAlong
from rgbmidic.fields.history import History, Nodal, Probe
from rgbmidic.fields.measures import MEASURES, Strain, strain_of_gradient
from rgbmidic.fields.nodal import NodalCovariance, Places
from rgbmidic.fields.plane import Rectification
from rgbmidic.fields.strain import StrainGauges
from rgbmidic.fields.units import Units
from rgbmidic.settings import ProbeSettings
from rgbmidic.typing import BoolArray, FloatArray

_LEAST = 0.5
"""Least part of an area that must be measured for its mean to be stated: the larger part represents the whole."""
_WHOLE = 0.995
"""Part of a place from which nothing is said of the rest, which is rounding of its points. Chosen."""
_ROUNDING = 1e-9
"""Of a sum of weights."""
_STEP = 1.0
"""Distance in px of the points that stand for a line or an area: an element of 10 px holds some 40."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mean:
    """Displacement at a point, or its mean along a line or over an area: u and v.

    Attributes
    ----------
    name, nodes
        See `Probe`.
    weights : ndarray, shape (m,)
        Of the nodes; their sum is 1.
    correlation : ndarray, shape (m, m)
        Of the nodes' errors.
    least
        Part of the weights that must be measured; the mean is that of the measured part.
    inside
        Part of the place that lies in the region.
    """

    name: str
    nodes: npt.NDArray[np.int64]
    weights: FloatArray
    correlation: FloatArray
    least: float = 1.0
    inside: float = 1.0

    @classmethod
    def over(cls, covariance: NodalCovariance, name: str, points: npt.ArrayLike, least: float = 1.0) -> Mean:
        """Average over points (P, 2) that stand for a place, px.

        Parameters
        ----------
        covariance
            Of the mesh.
        name
            Name of the probe.
        points : array_like, shape (P, 2)
            Points (x, y) on the reference, px.
        least
            Fraction of the weight that nodes with data must have in a frame.

        Returns
        -------
        Mean

        Raises
        ------
        InputError
            A point is outside the region.
        """
        places = Places.of(covariance.mesh, points)
        places.check(name)
        weights = places.mean()
        nodes = np.flatnonzero(weights).astype(np.int64)
        return cls(
            name=name,
            nodes=nodes,
            weights=weights[nodes],
            correlation=covariance.part(nodes),
            least=least - _ROUNDING,
        )

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
        uv = [*zip("uv", self.read(nodal), strict=True)]
        used = np.where(np.isfinite(uv[0][1][0]), _known(nodal) @ self.weights, 1.0)
        note = _cut(self.name, "mean", self.inside * used)
        return [
            History(name=f"{self.name}_{name}", unit="px", values=values, std=std, note=note)
            for name, (values, std) in uv
        ]

    def read(self, nodal: Nodal) -> list[tuple[FloatArray, FloatArray]]:
        """Average u and v, each (T,), with their standard uncertainty.

        Parameters
        ----------
        nodal
            Displacements of its `nodes` in every frame.

        Returns
        -------
        list of (ndarray, ndarray), shape (T,) each
            Mean of u, then of v, with its standard uncertainty, px.
        """
        known = _known(nodal)
        return [self.average(*pair, known) for pair in ((nodal.u, nodal.u_std), (nodal.v, nodal.v_std))]

    def average(
        self, values: FloatArray, std: FloatArray, known: BoolArray, *, alike: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Average a quantity (T, m) of the nodes where it is known, with its standard uncertainty, each (T,).

        The errors are correlated between nodes as those of a displacement, or where they are `alike` the same at all
        nodes, which is the most that they can add up to.

        Parameters
        ----------
        values, std : ndarray, shape (T, m)
            The quantity and its standard uncertainty.
        known : ndarray, shape (T, m), bool
            Where it is known.
        alike
            Whether the errors are the same at all nodes.

        Returns
        -------
        values, std : ndarray, shape (T,)
        """
        measured = known @ self.weights
        enough = measured >= self.least
        weights = np.where(known, self.weights, 0) / np.where(enough, measured, 1)[:, None]
        mean = (weights * np.where(known, values, 0)).sum(axis=1)
        parts = weights * np.where(known, std, 0)
        square = parts.sum(axis=1) ** 2 if alike else np.einsum("tm,tm->t", parts @ self.correlation, parts)
        spread = np.sqrt(np.maximum(square, 0))
        return np.where(enough, mean, np.nan), np.where(enough, spread, np.nan)


def _known(nodal: Nodal) -> BoolArray:
    return np.isfinite(nodal.u + nodal.v + nodal.u_std + nodal.v_std)


def _cut(name: str, what: str, used: FloatArray) -> str:
    """What is said of a probe of which only a part (T,) is `used`, where it reaches beyond what is measured."""
    least = float(used.min(initial=1.0))
    if least > _WHOLE:
        return ""
    return f"{name} is the {what} of {least:.0%} of its place at least: the rest lies outside the region or has no data"


def _line(x0: float, y0: float, x1: float, y1: float) -> FloatArray:
    return np.linspace((x0, y0), (x1, y1), int(np.hypot(x1 - x0, y1 - y0) / _STEP) + 2)


def _rectangle(x0: float, y0: float, x1: float, y1: float) -> FloatArray:
    """Make the points (P, 2) that stand for the cells of a rectangle."""
    axes = []
    for low, high in ((min(x0, x1), max(x0, x1)), (min(y0, y1), max(y0, y1))):
        count = max(int(np.ceil((high - low) / _STEP)), 1)
        axes.append(low + (np.arange(count) + 0.5) * (high - low) / count)
    x, y = np.meshgrid(*axes)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _circle(x: float, y: float, radius: float) -> FloatArray:
    grid = _rectangle(x - radius, y - radius, x + radius, y + radius)
    return grid[np.hypot(grid[:, 0] - x, grid[:, 1] - y) <= radius]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gauge:
    """An extensometer between two points: extension in px and strain, extension over length.

    Attributes
    ----------
    name
        See `Probe`.
    ends : ndarray, shape (2, 2)
        Both points, px.
    difference
        Of the displacements at both ends, as a mean whose weights add up to 0.
    moving
        Whether the length is that between the points as they move; else the extension along the line as it was.
    """

    name: str
    ends: FloatArray
    difference: Mean
    moving: bool

    @classmethod
    def between(cls, covariance: NodalCovariance, name: str, *place: float, moving: bool = True) -> Gauge:
        """Lay a gauge between two points, x0, y0, x1, y1 in px.

        Parameters
        ----------
        covariance
            Of the mesh.
        name
            Name of the gauge.
        *place
            Ends x0, y0, x1, y1 in px on the reference.
        moving
            Whether the gauge goes with the specimen.

        Returns
        -------
        Gauge

        Raises
        ------
        InputError
            A point is outside the region, or both are the same.
        """
        ends = np.array(place, dtype=np.float64).reshape(2, 2)
        if not np.hypot(*(ends[1] - ends[0])) > 0:
            raise InputError(f"{name} needs two different points, not ({place[0]:g}, {place[1]:g}) twice")
        Places.of(covariance.mesh, ends).check(name)
        first, second = (Places.of(covariance.mesh, end).mean() for end in ends)
        nodes = np.flatnonzero(second - first).astype(np.int64)
        correlation = covariance.part(nodes)
        difference = Mean(name=name, nodes=nodes, weights=(second - first)[nodes], correlation=correlation)
        return cls(name=name, ends=ends, difference=difference, moving=moving)

    @property
    def nodes(self) -> npt.NDArray[np.int64]:
        """The nodes around both points."""
        return self.difference.nodes

    @property
    def length(self) -> float:
        """Distance of both points on the reference, px."""
        return float(np.hypot(*(self.ends[1] - self.ends[0])))

    def histories(self, nodal: Nodal) -> list[History]:
        """Compute the extension in px and the strain.

        Parameters
        ----------
        nodal
            Displacements of its `nodes` in every frame.

        Returns
        -------
        list of History
        """
        d = self.difference
        apart = np.stack([nodal.u @ d.weights, nodal.v @ d.weights], axis=1)
        arm = self.ends[1] - self.ends[0]
        now = arm + apart if self.moving else np.broadcast_to(arm, apart.shape)
        towards = now / np.hypot(*now.T)[:, None]
        extension = np.hypot(*now.T) - self.length if self.moving else (towards * apart).sum(axis=1)
        parts = [d.weights * std for std in (nodal.u_std, nodal.v_std)]
        spread = np.stack([np.einsum("tm,tm->t", part @ d.correlation, part) for part in parts], axis=1)
        std = np.sqrt(np.maximum((towards**2 * spread).sum(axis=1), 0))
        return [
            History(name=f"{self.name}_extension", unit="px", values=extension, std=std),
            History(name=f"{self.name}_strain", unit="", values=extension / self.length, std=std / self.length),
        ]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StrainGauge:
    """A virtual strain gauge: strain, principal strains with their direction, equivalent of the Hencky strain.

    Attributes
    ----------
    name, nodes
        See `Probe`.
    gauges
        One gauge, whose nodes count as in `nodes`.
    measure
        One of `rgbmidic.fields.MEASURES`.
    inside
        Part of the gauge that lies in the region.
    """

    name: str
    nodes: npt.NDArray[np.int64]
    gauges: StrainGauges
    measure: str
    inside: float

    @classmethod
    def around(
        cls, covariance: NodalCovariance, name: str, x: float, y: float, length: float, *, measure: str = MEASURES[0]
    ) -> StrainGauge:
        """Lay a gauge of a length around a point, px; an `InputError` where it is outside the region or too short.

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

        Returns
        -------
        StrainGauge
        """
        gauges = StrainGauges.at_points(covariance, np.array([[x, y]]), length)
        nodes = np.unique(gauges.nodes)
        reduced = replace(
            gauges,
            points=gauges.points[nodes],
            nodes=np.searchsorted(nodes, gauges.nodes),
            needed=gauges.needed[:, nodes],
        )
        inside = float(Places.of(covariance.mesh, _circle(x, y, reduced.length / 2)).inside.mean())
        return cls(name=name, nodes=nodes, gauges=reduced, measure=measure, inside=inside)

    def histories(self, nodal: Nodal) -> list[History]:
        """Compute exx, eyy, exy, e1, e2, the direction of e1 and the von Mises equivalent.

        Parameters
        ----------
        nodal
            Displacements of its `nodes` in every frame.

        Returns
        -------
        list of History
        """
        rows = zip(nodal.u, nodal.v, nodal.u_std, nodal.v_std, strict=True)
        gradients, covariances = zip(*(self.gauges.gradient(*row) for row in rows), strict=True)
        strain = strain_of_gradient(np.concatenate(gradients), np.concatenate(covariances), self.measure)
        weights = self.gauges.fractions / self.gauges.fractions.sum()
        measured = np.isfinite(strain.components[:, 0])
        used = np.where(measured, _known(nodal)[:, self.gauges.nodes] @ weights, 1.0)
        return _strain_histories(self.name, strain, _cut(self.name, "strain", self.inside * used))


def _strain_histories(name: str, strain: Strain, note: str) -> list[History]:
    """Return every quantity of a strain (T,) as a history."""
    values = [*strain.components.T, *strain.principal.T, strain.direction_deg, strain.equivalent]
    stds = [*strain.components_std.T, *strain.principal_std.T, strain.direction_std_deg, strain.equivalent_std]
    units = {"exx": "", "eyy": "", "exy": "", "e1": "", "e2": "", "direction": "deg", "equivalent": ""}
    return [
        History(name=f"{name}_{quantity}", unit=unit, values=value, std=std, note=note)
        for (quantity, unit), value, std in zip(units.items(), values, stds, strict=True)
    ]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Area(Mean):
    """Mean displacement over an area, and the strain of the mean displacement gradient over it.

    The gradient of a linear displacement is constant in an element, so that its mean over the area is one of the
    elements, each by the part of the area that it holds. It is that of the nodes around the area alone (Gauss).

    Attributes
    ----------
    elements : ndarray, shape (E, 3), int
        Indices in `nodes` of the corners of the elements that the area touches.
    parts : ndarray, shape (E,)
        Fraction of the area within each; their sum is 1.
    slopes : ndarray, shape (E, 3, 2)
        Gradient of the shape functions, per px.
    measure
        One of `rgbmidic.fields.MEASURES`.
    """

    elements: npt.NDArray[np.int64]
    parts: FloatArray
    slopes: FloatArray
    measure: str

    @classmethod
    def of(cls, covariance: NodalCovariance, name: str, points: FloatArray, measure: str = MEASURES[0]) -> Area:
        """Average over the area that points (P, 2) stand for, px.

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

        Returns
        -------
        Area

        Raises
        ------
        InputError
            Half of the area or more is outside the region.
        """
        mesh, places = covariance.mesh, Places.of(covariance.mesh, points)
        if (inside := float(places.inside.mean())) < _LEAST:
            raise InputError(f"half or more of {name} is outside {places.where}")
        elements, count = np.unique(places.element[places.inside], return_counts=True)
        nodes = np.unique(mesh.elements[elements]).astype(np.int64)
        return cls(
            name=name,
            nodes=nodes,
            weights=places.mean()[nodes],
            correlation=covariance.part(nodes),
            least=_LEAST - _ROUNDING,
            inside=inside,
            elements=np.searchsorted(nodes, mesh.elements[elements]),
            parts=count / count.sum(),
            slopes=mesh.shape_gradients()[elements],
            measure=measure,
        )

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
        moved, known = Mean.histories(self, nodal), _known(nodal)
        gradient, covariance = np.full((len(known), 2, 2), np.nan), np.full((len(known), 4, 4), np.nan)
        patterns, of_frame = np.unique(known[:, self.elements].all(axis=2), axis=0, return_inverse=True)
        for place, there in enumerate(patterns):
            if (measured := self.parts[there].sum()) < self.least:
                continue
            weights, frames = np.zeros((len(self.nodes), 2)), np.flatnonzero(of_frame.ravel() == place)
            np.add.at(weights, self.elements[there], (self.parts[there] / measured)[:, None, None] * self.slopes[there])
            covariance[frames] = 0
            for row, (value, std) in enumerate(((nodal.u, nodal.u_std), (nodal.v, nodal.v_std))):
                gradient[frames, row] = np.where(known, value, 0)[frames] @ weights
                errors = np.where(known, std, 0)[frames, None] * weights.T
                own = slice(2 * row, 2 * row + 2)
                covariance[frames, own, own] = errors @ self.correlation @ errors.swapaxes(1, 2)
        strain = strain_of_gradient(gradient, covariance, self.measure)
        return [*moved, *_strain_histories(self.name, strain, moved[0].note)]


_Make = Callable[..., Probe]
PROBES: dict[str, tuple[int, int, _Make]] = {
    "point": (1, 0, lambda c, name, *place: Mean.over(c, name, [place])),
    "line": (2, 0, lambda c, name, *place: Mean.over(c, name, _line(*place), _LEAST)),
    "circle": (1, 1, lambda c, name, *place, **more: Area.of(c, name, _circle(*place), **more)),
    "region": (2, 0, lambda c, name, *place, **more: Area.of(c, name, _rectangle(*place), **more)),
    "gauge": (2, 0, Gauge.between),
    "straight_gauge": (2, 0, lambda *a, **k: Gauge.between(*a, **k, moving=False)),
    "strain_gauge": (1, 1, StrainGauge.around),
    "crack": (2, 0, JumpAlong.between),
    "tip": (1, 2, CrackTip.at),
}
"""Every kind of probe with how many points and lengths (px) place it, and what makes it."""
_STRAINED = ("circle", "region", "strain_gauge")
"""Those that measure a strain of a stated measure."""


def make_probe(
    covariance: NodalCovariance,
    kind: str,
    number: int,
    place: Sequence[float],
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
    place
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
    """
    (points, lengths, make), settings = PROBES[kind], settings or ProbeSettings()
    name = dict(settings.names).get(f"{kind}_{number}", f"{kind}_{number}")
    if len(place) != 2 * points + lengths:
        raise InputError(f"{name} is placed by {2 * points + lengths} numbers, not by {list(place)}")
    more: dict[str, Any] = {"measure": settings.measure} if kind in _STRAINED else {}
    if kind == "tip":
        assert settings.youngs_modulus is not None  # as [probes] with tips checks
        assert settings.poissons_ratio is not None
        assert settings.plane is not None
        more["williams"] = Williams(
            youngs_modulus=settings.youngs_modulus,
            poissons_ratio=settings.poissons_ratio,
            plane=settings.plane,
            units=Units() if rectified is None else rectified.units,
            terms=settings.terms,
            fit_tip=settings.fit_tip,
        )
    return make(covariance, name, *(place if rectified is None else rectified.place(place, points)), **more)
