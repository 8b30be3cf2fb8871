"""Figures of element sizes on a test's own frames: noise, discretisation error, gauges, and the recommendation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic.pipeline.frame_quality import SPECKLES


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolutionConstants:
    """Constants of the choice of element sizes.

    Attributes
    ----------
    min_size
        Smallest elements, px (`Tri3Mesh.from_region`).
    fewest
        Elements across the region: fewer have no node with neighbours on all sides, and no virtual strain gauge.
    candidates
        Frames among which the key frame is looked for. Chosen: fifths of a test.
    static
        Static frames that the noise floor is taken from at most: 100 nodes in 5 frames give it to 4 %.
    largest
        Quantile over the nodes and components that stands for the largest strain: the very largest is one node's noise.
    equal
        How much shorter than three elements a gauge may be, as `StrainGauges` has it.
    finer
        Ratio of element sizes from which their fields are compared: mesh errors of nearer ones are too much alike.
        Chosen: those of neighbours among `SIZES` are compared.
    passes
        Bisections in a row at most: legs of 25 px become 9 px.
    worth
        Discretisation error of strain over its noise from which bisecting an element makes strain better: the one falls
        as the area of the elements, the other rises as its inverse, e^2/4 + 4 n^2 < e^2 + n^2 (derived). Displacement
        does not decide: with it affine fields and waves had more nodes and no smaller errors (measured).
    exact
        Places of refined nodes are multiples of it, px: where they begin to count can then be shifted without rounding.
    measured
        Area that a size must measure, of the size that measures most: what it loses is where its error would be the
        largest, such as a steep bump beside one node. Chosen: a node of elements of 40 px on 250 px is 8 %.
    tie_factor
        Total errors of the displacement within this factor count as the same, and those of strain decide: an estimate
        of the discretisation error is no better than that.
    significance, independent
        Standard deviations by which the mean square of a difference must exceed that of noise, and independent values
        in a nodal one, whose neighbours are correlated. Chosen.
    """

    min_size: float = 4.0
    fewest: float = 3.0
    candidates: int = 5
    static: int = 5
    largest: float = 0.99
    equal: float = 0.1
    finer: float = 1.4
    passes: int = 3
    worth: float = 2.0
    exact: float = 2.0**-16
    significance: float = 2.0
    independent: float = 0.5
    measured: float = 0.97
    tie_factor: float = 1.05


CONSTANTS = ResolutionConstants()


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
class ErrorFigures:
    """Errors of displacement or strain, rms over the measured nodes and the components; what is not known is NaN.

    Attributes
    ----------
    bias, scatter
        Noise floor: rms over the static frames of the mean over the nodes, and the scatter about it.
    stated
        Standard uncertainty from noise in the key frame.
    discretisation
        What the mesh and the recovery leave out in the key frame.
    """

    bias: float = float("nan")
    scatter: float = float("nan")
    stated: float = float("nan")
    discretisation: float = float("nan")

    @property
    def noise(self) -> float:
        """Noise as stated in the key frame, or the noise floor where that is more."""
        return float(np.fmax(self.stated, self.scatter))

    @property
    def total(self) -> float:
        """Root of the squares of noise and discretisation error."""
        return float(np.hypot(self.noise, self.discretisation))


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeFigures(ErrorFigures):
    """Elements of one size on a test's own frames: errors of u and v, px, and what goes with them.

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
    strain
        Errors of exx, eyy, exy at the nodes.
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
    strain: ErrorFigures = ErrorFigures()
    seconds: float = float("nan")
    gauges: tuple[GaugeFigures, ...] = ()
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """Element size that the frames of a test recommend, and why, in a sentence."""

    element_size: float
    reason: str


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
        max_measured = max((figures.measured for figures in self.sizes), default=0.0)
        too_small = [figures for figures in self.sizes if figures.speckles < SPECKLES]
        usable = [
            figures
            for figures in self.sizes
            if figures not in too_small and figures.measured >= CONSTANTS.measured * max_measured
        ]
        usable = sorted(
            (figures for figures in usable if np.isfinite(figures.total)), key=lambda figures: figures.element_size
        )
        if not usable:
            return None
        min_total = min(figures.total for figures in usable)
        best = min(
            (figures for figures in usable if figures.total <= CONSTANTS.tie_factor * min_total),
            key=lambda figures: np.nan_to_num(figures.strain.total, nan=np.inf),
        )
        smaller, larger = usable[: usable.index(best)][-1:], usable[usable.index(best) + 1 :][:1]
        lead = "the least" if best.total == min_total else "within 5 % of the least"
        sentences = [
            f"elements of {best.element_size:g} px have {lead} total error in {self.name}: {best.total:.2g} px, from "
            f"noise of {best.noise:.2g} px and a discretisation error of {best.discretisation:.2g} px"
        ]
        for figures, error_name in (
            *((figures, "noise") for figures in smaller),
            *((figures, "discretisation error") for figures in larger),
        ):
            value = figures.noise if error_name == "noise" else figures.discretisation
            sentences.append(
                f"with {figures.element_size:g} px it is {figures.total:.2g} px, for a {error_name} of {value:.2g} px"
            )
        if too_small:
            names = ", ".join(f"{figures.element_size:g}" for figures in too_small)
            sentences.append(f"{names} px are less than {SPECKLES:g} speckles of {self.speckle:.1f} px")
        return Choice(element_size=best.element_size, reason="; ".join(sentences))
