"""Probes: what is read off a displacement field at points, over areas, between two points, and over strain gauges.

A probe knows the nodes that it needs; it takes the displacements of these in some frames and gives named histories with
their standard uncertainty. All probes sit on the material: their places are those on the reference.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rgbmidic.errors import InputError
from rgbmidic.fields.covariance import NodalCovariance
from rgbmidic.fields.gauges import Gauge, StrainGauge
from rgbmidic.fields.history import Probe
from rgbmidic.fields.means import Mean

__all__ = ["PROBES", "make_probe"]

_Make = Callable[..., Probe]
PROBES: dict[str, tuple[int, _Make]] = {
    "point": (2, Mean.at_point),
    "line": (4, Mean.along_line),
    "circle": (3, Mean.over_circle),
    "region": (4, Mean.over_region),
    "gauge": (4, Gauge.between),
    "straight_gauge": (4, lambda *a, **k: Gauge.between(*a, **k, moving=False)),
    "strain_gauge": (3, StrainGauge.around),
}
"""Every kind of probe with how many numbers (px) place it, and what makes it."""


def make_probe(covariance: NodalCovariance, kind: str, number: int, place: Sequence[float], measure: str) -> Probe:
    """The probe of a kind of `PROBES`, at a place in px, named by its kind and number.

    Raises
    ------
    InputError
        The place is outside the region, or no place for it.
    """
    count, make = PROBES[kind]
    name = f"{kind}_{number}"
    if len(place) != count:
        raise InputError(f"{name} is placed by {count} numbers, not by {list(place)}")
    more = {"measure": measure} if kind == "strain_gauge" else {}
    return make(covariance, name, *map(float, place), **more)
