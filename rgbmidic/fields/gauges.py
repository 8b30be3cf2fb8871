"""Extensometers between two points, and virtual strain gauges, over the frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.fields.covariance import NodalCovariance
from rgbmidic.fields.history import History, Nodal
from rgbmidic.fields.locate import Places
from rgbmidic.fields.means import Mean
from rgbmidic.fields.measures import MEASURES, strain_of_gradient
from rgbmidic.fields.strain import StrainGauges
from rgbmidic.typing import FloatArray

__all__ = ["Gauge", "StrainGauge"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gauge:
    """An extensometer between two points: extension in px and strain, extension over length.

    Attributes
    ----------
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
    def between(
        cls,
        covariance: NodalCovariance,
        name: str,
        x0: float,
        y0: float,
        x1: float,
        y1: float,
        *,
        moving: bool = True,
    ) -> Gauge:
        """Between two points, px; an `InputError` where one is outside the region or both are the same."""
        ends = np.array([[x0, y0], [x1, y1]], dtype=np.float64)
        if not np.hypot(*(ends[1] - ends[0])) > 0:
            raise InputError(f"{name} needs two different points, not ({x0:g}, {y0:g}) twice")
        places = Places.of(covariance.mesh, ends)
        places.check(name)
        first, second = (Places.of(covariance.mesh, end).mean() for end in ends)
        nodes = np.flatnonzero(second - first).astype(np.int64)
        weights = (second - first)[nodes]
        difference = Mean(name=name, nodes=nodes, weights=weights, correlation=covariance.part(nodes))
        return cls(name=name, ends=ends, difference=difference, moving=moving)

    @property
    def nodes(self) -> npt.NDArray[np.int64]:
        """The nodes around both points."""
        return self.difference.nodes

    @property
    def length(self) -> float:
        """On the reference, px."""
        return float(np.hypot(*(self.ends[1] - self.ends[0])))

    def histories(self, nodal: Nodal) -> list[History]:
        """Extension in px and strain."""
        d = self.difference
        parts = [nodal.u, nodal.v]
        apart = np.stack([part @ d.weights for part in parts], axis=1)
        arm = self.ends[1] - self.ends[0]
        now = arm + apart if self.moving else np.broadcast_to(arm, apart.shape)
        towards = now / np.hypot(*now.T)[:, None]
        extension = np.hypot(*now.T) - self.length if self.moving else (towards * apart).sum(axis=1)
        spread = [
            np.einsum("tm,tm->t", (d.weights * std) @ d.correlation, d.weights * std)
            for std in (nodal.u_std, nodal.v_std)
        ]
        std = np.sqrt(np.maximum((towards**2 * np.stack(spread, axis=1)).sum(axis=1), 0))
        return [
            History(name=f"{self.name}_extension", unit="px", values=extension, std=std),
            History(name=f"{self.name}_strain", unit="", values=extension / self.length, std=std / self.length),
        ]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StrainGauge:
    """A virtual strain gauge: strain, principal strains with their direction, equivalent of the Hencky strain.

    Attributes
    ----------
    gauges
        One gauge, whose nodes count as in `nodes`.
    measure
        One of `rgbmidic.fields.MEASURES`.
    """

    name: str
    nodes: npt.NDArray[np.int64]
    gauges: StrainGauges
    measure: str

    @classmethod
    def around(
        cls, covariance: NodalCovariance, name: str, x: float, y: float, length: float, *, measure: str = MEASURES[0]
    ) -> StrainGauge:
        """Of a length, around a point, px; an `InputError` where it is outside the region or the gauge too short."""
        gauges = StrainGauges.at_points(covariance, np.array([[x, y]]), length)
        nodes = np.unique(gauges.nodes)
        own = replace(
            gauges,
            points=gauges.points[nodes],
            nodes=np.searchsorted(nodes, gauges.nodes),
            needed=gauges.needed[:, nodes],
        )
        return cls(name=name, nodes=nodes, gauges=own, measure=measure)

    def histories(self, nodal: Nodal) -> list[History]:
        """exx, eyy, exy, e1, e2, the direction of e1 and the von Mises equivalent."""
        rows = zip(nodal.u, nodal.v, nodal.u_std, nodal.v_std, strict=True)
        gradients, covariances = zip(*(self.gauges.gradient(*row) for row in rows), strict=True)
        s = strain_of_gradient(np.concatenate(gradients), np.concatenate(covariances), self.measure)
        values = [*s.components.T, *s.principal.T, s.direction_deg, s.equivalent]
        stds = [*s.components_std.T, *s.principal_std.T, s.direction_std_deg, s.equivalent_std]
        units = {"exx": "", "eyy": "", "exy": "", "e1": "", "e2": "", "direction": "deg", "equivalent": ""}
        return [
            History(name=f"{self.name}_{name}", unit=unit, values=value, std=std)
            for (name, unit), value, std in zip(units.items(), values, stds, strict=True)
        ]
