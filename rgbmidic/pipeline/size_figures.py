"""Figures of element sizes on a test's own frames: noise, discretisation error, gauges, and the recommendation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic.pipeline.plan import Choice
from rgbmidic.pipeline.suitability import SPECKLES

_MEASURED = 0.97
"""Area that a size must measure, of the size that measures most: what it loses is where its error would be the largest,
such as a steep bump beside one node. Chosen: a node of elements of 40 px on 250 px is 8 %."""
_ALIKE = 1.05
"""Total errors of the displacement within this factor count as the same, and those of strain decide: an estimate of the
discretisation error is no better than that."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GaugeFigures:
    """Virtual strain gauges of one length on elements of one size.

    Attributes
    ----------
    length
        px.
    noise
        Noise of exx, eyy and exy, rms over the nodes: the strain resolution; from static frames, else as stated.
    largest
        Largest value of a component of the strain in the key frame, the 99 % quantile over the nodes.
    """

    length: float
    noise: float
    largest: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeFigures:
    """Elements of one size on a test's own frames; what is not known is NaN.

    All errors are rms over the measured nodes and over the components: u, v in px; exx, eyy, exy at the nodes.

    Attributes
    ----------
    element_size
        px.
    speckles
        On the side of an element.
    nodes
        Number of nodes.
    measured
        Fraction of the area whose nodes the key frame measures.
    bias, scatter, strain_bias, strain_scatter
        Noise floor: rms over the static frames of the mean over the nodes, and the scatter about it.
    stated, strain_stated
        Standard uncertainty from noise in the key frame.
    discretisation, strain_discretisation
        What the mesh and the recovery leave out in the key frame.
    seconds
        CPU seconds of the solve of the key frame.
    gauges
        Virtual strain gauges.
    reason
        Why nothing is known; else empty.
    """

    element_size: float
    speckles: float = float("nan")
    nodes: int = 0
    measured: float = 0.0
    bias: float = float("nan")
    scatter: float = float("nan")
    strain_bias: float = float("nan")
    strain_scatter: float = float("nan")
    stated: float = float("nan")
    strain_stated: float = float("nan")
    discretisation: float = float("nan")
    strain_discretisation: float = float("nan")
    seconds: float = float("nan")
    gauges: tuple[GaugeFigures, ...] = ()
    reason: str = ""

    @property
    def noise(self) -> float:
        """Noise of the displacement, px: as stated in the key frame, or the noise floor where that is more."""
        return float(np.fmax(self.stated, self.scatter))

    @property
    def strain_noise(self) -> float:
        """Noise of the strain at the nodes, as `noise`."""
        return float(np.fmax(self.strain_stated, self.strain_scatter))

    @property
    def total(self) -> float:
        """Error of the displacement, px: root of the squares of noise and discretisation error."""
        return float(np.hypot(self.noise, self.discretisation))

    @property
    def strain_total(self) -> float:
        """Error of the strain at the nodes, as `total`."""
        return float(np.hypot(self.strain_noise, self.strain_discretisation))


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolutionStudy:
    """Figures of several element sizes on a test's own frames.

    Attributes
    ----------
    frame, name
        The key frame: index and name.
    static
        Number of static frames that the noise floor is from; 0: the test has none, and noise is as stated.
    speckle
        Size of the speckle, px; NaN where it is not known.
    preparation
        CPU seconds of reading and separating the key frame, the same for all sizes; NaN where it was not measured.
    sizes
        Figures of each size.
    """

    frame: int
    name: str
    static: int
    speckle: float
    preparation: float
    sizes: tuple[SizeFigures, ...]

    @property
    def choice(self) -> Choice | None:
        """The size of the least total error among those that hold and measure enough; None where none is known."""
        most = max((one.measured for one in self.sizes), default=0.0)
        few = [one for one in self.sizes if one.speckles < SPECKLES]
        usable = [one for one in self.sizes if one not in few and one.measured >= _MEASURED * most]
        usable = sorted((one for one in usable if np.isfinite(one.total)), key=lambda one: one.element_size)
        if not usable:
            return None
        least = min(one.total for one in usable)
        best = min(
            (one for one in usable if one.total <= _ALIKE * least),
            key=lambda one: np.nan_to_num(one.strain_total, nan=np.inf),
        )
        smaller, larger = usable[: usable.index(best)][-1:], usable[usable.index(best) + 1 :][:1]
        lead = "the least" if best.total == least else "within 5 % of the least"
        parts = [
            f"elements of {best.element_size:g} px have {lead} total error in {self.name}: {best.total:.2g} px, from "
            f"noise of {best.noise:.2g} px and a discretisation error of {best.discretisation:.2g} px"
        ]
        for one, what in (*((one, "noise") for one in smaller), *((one, "discretisation error") for one in larger)):
            value = one.noise if what == "noise" else one.discretisation
            parts.append(f"with {one.element_size:g} px it is {one.total:.2g} px, for a {what} of {value:.2g} px")
        if few:
            names = ", ".join(f"{one.element_size:g}" for one in few)
            parts.append(f"{names} px are less than {SPECKLES:g} speckles of {self.speckle:.1f} px")
        return Choice(element_size=best.element_size, reason="; ".join(parts))
