"""Profiles: a field along a line in every frame, and the speed of a front or peak that travels along it.

At each position the series over time is smoothed by local parabolas (tricube weights: Cleveland, J Am Stat Assoc 74,
1979), which frames that are missing do not shift. The peak arrives at the maximum of the smooth curve, the front where
the curve last rises through a fraction of that maximum before it. To first order an arrival time is a linear functional
of the series, so that the covariance of two arrival times follows from the noise of the frames and its correlation
between the positions; the speed is that of the straight line through the arrival times by generalised least squares
(Aitken, Proc R Soc Edinb 55, 1936).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.special import chdtrc

from rgbmidic.errors import InputError
from rgbmidic.field import Field
from rgbmidic.fields.interpolation import MeshPoints
from rgbmidic.fields.nodal import NodalCovariance
from rgbmidic.fields.strain import StrainGauges
from rgbmidic.renamed import state_new_names
from rgbmidic.text import format_with_std
from rgbmidic.typing import BoolArray, FloatArray

ARRIVALS = ("front", "peak")
"""What arrives: the rise through a fraction of the peak or through a value, or the peak."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProfileConstants:
    """Numbers of a profile along a line and of the fit of a front.

    Attributes
    ----------
    min_inside_fraction
        Least part of a line that must be inside the region: the larger part represents the whole, as of a
        probe's.
    step
        Distance of the points along a line in elements, the golden section: the positions of a fit then lie
        anywhere between the nodes, and what interpolation leaves out shows in its chi-square. With half an
        element it was 3.4 times that.
    lopsided
        Elements by which the middle of a gauge's nodes may lie off its own along a line: a tenth of what an
        edge does.
    clear
        Standard uncertainties that a peak must reach: noise alone does in one of 3,500 series of 500 frames.
    smoothest
        Least half-width of the smoothing in frames: a parabola through six or more of them.
    determined
        Least determinant of a parabola's normal equations over that of its weights; with all frames it is .01.
    fine
        Places of the smooth curve to an interval of the frames. With 16 the arrival times change by less than
        1e-3 of it.
    rows
        Places whose weights are computed at once: 80 MB for a test of 10,000 frames.
    rise
        Fractions of the peak between which a front rises, by which the smoothing is chosen: nearly straight for
        a half sine and for an error function.
    abrupt
        Rises of a step, smoothed, within which the frames do not resolve when the front arrives between two of
        them.
    independent
        Correlation of the noise between neighbouring positions of a fit, at most: beyond it positions add
        little, and the inverse of their covariance amplifies what is not known of it.
    travels
        Standard uncertainties by which the slope of the arrival times must differ from 0: as for a kink in
        `rates`.
    doubtful
        Probability of the chi-square below which the arrival times do not lie on a line.
    fewest
        Positions that a fit needs: two parameters, and two more to see whether they describe anything.
    """

    min_inside_fraction: float = 0.5
    step: float = 0.382
    lopsided: float = 0.1
    clear: float = 5.0
    smoothest: float = 3.5
    determined: float = 1e-4
    fine: int = 8
    rows: int = 1000
    rise: tuple[float, float] = (0.2, 0.8)
    abrupt: float = 1.2
    independent: float = 0.5
    travels: float = 4.0
    doubtful: float = 1e-3
    fewest: int = 4


_CONSTANTS = ProfileConstants()

_WIDTHS = {"front": 1.5, "peak": 3.0}
"""Rises that the smoothing is wide on either side: with half of it, noise of 5 % of the peak moves it to another
maximum."""


@state_new_names
class ProfileLine:
    """Points .38 elements apart along a line in a mesh, at which nodal fields are read.

    A value is that of the field between the nodes (`MeshPoints`); its uncertainty follows from the correlation of their
    errors.

    Parameters
    ----------
    covariance
        Of the mesh.
    gauges
        Strain gauges at its nodes.
    x0, y0, x1, y1
        Ends in px on the reference.

    Attributes
    ----------
    points : ndarray, shape (P, 2)
        In px on the reference, from the first end to the last.
    coordinates : ndarray, shape (P, 2) or (P, 3)
        The points, or on a surface in space where they are, NaN outside of it, in `unit`.
    positions : ndarray, shape (P,)
        Distance from the first end, in space along the surface, in `unit`.
    unit
        ``"px"``; in space that of the surface, ``"mm"``.
    nodes : ndarray, shape (n,), int
        Nodes around the line.
    mesh_points
        The points in the part of the mesh that has these nodes.
    is_two_sided : ndarray, shape (P,), bool
        Where the strain gauges around extend to both sides along the line: at an edge their strain is that of a place
        further inside.
    covariances
        Of the errors at these nodes of a displacement (``""``), of the strains ``"exx"`` and ``"eyy"``, which are
        slopes along x and y, and of all other strains (``"strain"``), taken as sums of both.

    Raises
    ------
    InputError
        Both ends are the same, or half of the line or more is outside the mesh.

    Examples
    --------
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 80, 60), shape=(80, 100)), element_size=20)
    >>> covariance = NodalCovariance.from_mesh(mesh)
    >>> line = ProfileLine(covariance, StrainGauges.at_nodes(covariance), 0, 30, 80, 30)
    >>> line.positions[[0, -1]].round(6).tolist()
    [0.0, 80.0]
    """

    def __init__(
        self, covariance: NodalCovariance, gauges: StrainGauges, x0: float, y0: float, x1: float, y1: float
    ) -> None:
        mesh, length = covariance.mesh, math.hypot(x1 - x0, y1 - y0)
        if not length > 0:
            raise InputError(f"a line needs two different points, not ({x0:g}, {y0:g}) twice")
        # the longest line of which so much can be inside
        longest = float(np.hypot(*np.ptp(mesh.nodes, axis=0))) / _CONSTANTS.min_inside_fraction
        steps = max(math.ceil(min(length, longest) / (_CONSTANTS.step * mesh.size)), 1)
        points = np.linspace((x0, y0), (x1, y1), steps + 1)
        if (
            not length <= longest
            or (mesh_points := MeshPoints.of(mesh, points)).inside.mean() < _CONSTANTS.min_inside_fraction
        ):
            raise InputError(
                f"half or more of the line from ({x0:g}, {y0:g}) to ({x1:g}, {y1:g}) px is outside "
                f"{MeshPoints.of(mesh, mesh.nodes[:1]).bounds_text}"
            )
        self.points, self.positions, self.unit = points, np.linspace(0, length, len(points)), "px"
        self.nodes, self.mesh_points = mesh_points.nearby()
        self.coordinates = points if covariance.surface is None else mesh_points.read(covariance.surface)
        if covariance.surface is not None:
            self.unit = "mm"
            steps_in_space = np.linalg.norm(np.diff(self.coordinates, axis=0), axis=1)
            outside = np.nanmedian(steps_in_space)  # the surface is not known there
            self.positions = np.append(0.0, np.cumsum(np.where(np.isfinite(steps_in_space), steps_in_space, outside)))
        self._weights = lru_cache(maxsize=4)(partial(_weights, self.mesh_points))
        nodes = self.nodes
        exx, eyy = (covariance.relative([slope[nodes]]) for slope in gauges.slopes)
        strain_covariance = covariance.relative([slope[nodes] for slope in gauges.slopes])
        self.covariances = {"": covariance.subset(nodes), "exx": exx, "eyy": eyy, "strain": strain_covariance}
        count = np.bincount(gauges.rows, weights=gauges.fractions, minlength=len(mesh.nodes))
        arm = (mesh.nodes[gauges.nodes] - mesh.nodes[gauges.rows]) @ (points[-1] - points[0]) / length
        lopsided = np.abs(np.bincount(gauges.rows, weights=gauges.fractions * arm, minlength=len(mesh.nodes)) / count)
        at_corners = lopsided[mesh.elements[mesh_points.element]]
        self.is_two_sided = np.asarray((at_corners < _CONSTANTS.lopsided * mesh.size).all(axis=1))

    def read(self, field: Field, kind: str = "") -> Field:
        """Interpolate a nodal field and its standard uncertainty at the points.

        Parameters
        ----------
        field
            At all nodes of the mesh, shape (N,); NaN where not measured.
        kind
            Key of `covariances`.

        Returns
        -------
        Field
            Of the shape (P,); NaN where a node around is not measured.
        """
        near = field.noise.isel(node=self.nodes)
        weights = self._weights(np.isfinite(near.values).tobytes())
        values = weights @ np.nan_to_num(near.values)
        variance = self.covariances[kind].variance(np.nan_to_num(weights), near)
        std = np.where(np.isfinite(values), np.sqrt(variance), np.nan)
        along = replace(near, dims=("position",), values=values, std=std, bias=None)
        if field.common is None:
            return along
        return along.with_common(np.nan_to_num(field.common[:, self.nodes]) @ weights.T)

    def correlation(self, kind: str = "", bias_fraction: float = 0.0, common_fraction: float = 0.0) -> FloatArray:
        """Compute the correlation (P, P) of the noise of a field between the points; 0 outside the mesh.

        Parameters
        ----------
        kind
            Key of `covariances`.
        bias_fraction
            Part of the noise's variance that the lights' bias leaves.
        common_fraction
            Part of the variance that all points have in common, which a calibration leaves.

        Returns
        -------
        ndarray, shape (P, P)
        """
        weights = np.nan_to_num(self._weights(np.ones(len(self.nodes), dtype=bool).tobytes()))
        errors = self.covariances[kind].errors(weights, np.ones(len(self.nodes)), bias_fraction**0.5)
        return (1 - common_fraction) * _unit(errors @ errors.T) + common_fraction


def _weights(mesh_points: MeshPoints, measured: bytes) -> FloatArray:
    """Return the weight (P, n) of every node at each point; NaN outside the mesh and beside missing nodes."""
    has_data = np.frombuffer(measured, dtype=bool)
    weights = mesh_points.weights(has_data).toarray()
    weights[~mesh_points.measured(has_data)] = np.nan
    return np.asarray(weights)


def _unit(covariance: FloatArray) -> FloatArray:
    """Return the correlation of a covariance matrix; 0 where a variance is."""
    scale = np.sqrt(np.diag(covariance))
    scale = np.divide(1, scale, out=np.zeros_like(scale), where=scale > 0)
    return np.asarray(covariance * scale * scale[:, None])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Arrivals:
    """Times at which a front or peak arrives at each position.

    Attributes
    ----------
    times
        In the unit of the frames' times, with their standard uncertainty, shape (P,); NaN where nothing arrives.
    weights : ndarray, shape (P, T)
        Change of each arrival time by the value in each frame.
    abrupt
        Whether the rise is shorter than the frames resolve; a uniform distribution between two frames is then part of
        the uncertainty.
    cut : ndarray, shape (P,), bool
        Where the series still rises in the last frames: no peak, and no front that is a fraction of it, arrives.
    """

    times: Field
    weights: FloatArray
    abrupt: bool
    cut: BoolArray


def arrival_times(
    times: npt.ArrayLike,
    field: Field,
    *,
    feature: str = ARRIVALS[0],
    level: float | str = "50%",
    common_fraction: float = 0.5,
    between_frames: FloatArray | None = None,
) -> Arrivals:
    """Find when a front or peak arrives at each of P positions, with its standard uncertainty.

    The sign of the wave is that of the `level`; of a fraction, that of the largest value over its uncertainty. The
    smoothing has a half-width of 1.5 times the median rise from 20 to 80 % of the peak, for a peak of 3 times, and 3.5
    frames at least; it shifts all arrivals alike where the wave keeps its form.

    Parameters
    ----------
    times : (T,)
        Of the frames, rising.
    field
        At each position, with its standard uncertainty, shape (T, P); NaN where not measured.
    feature
        One of `ARRIVALS`.
    level
        Value at which the front is taken, or with a percent sign the fraction of the peak.
    common_fraction
        Fraction of the variance that all frames have in common, that of the reference.
    between_frames : (T, T), optional
        Correlation of the noise between frames besides that; None: independent.

    Returns
    -------
    Arrivals
        NaN where the peak is below 5 standard uncertainties or lies at either end, the series does not rise to it
        through the level, or the level is a fraction of a peak to which it still rises in the last frames.

    Raises
    ------
    InputError
        `feature` or `level` is none of those allowed, or there are fewer than 6 frames.
    """
    value, fraction = read_level(level)
    if feature not in ARRIVALS:
        raise InputError(f"what arrives is {' or '.join(ARRIVALS)}, not {feature!r}")
    frame_times, y, spread = (np.asarray(array, dtype=np.float64) for array in (times, field.values, field.uncertainty))
    if len(frame_times) < 6 or not (np.diff(frame_times) > 0).all():
        raise InputError(f"arrival times need 6 frames or more whose times rise; there are {len(frame_times)}")
    interval = float(np.median(np.diff(frame_times)))
    is_measured = np.isfinite(y) & np.isfinite(spread)
    size = np.where(is_measured, y / np.where(spread > 0, spread, np.inf), 0.0)
    signs = np.where(np.abs(size).max(axis=0) > 0, np.sign(size[np.abs(size).argmax(axis=0), np.arange(y.shape[1])]), 0)
    sign = math.copysign(1.0, value or signs.sum() or 1.0)
    series = sign * y
    first = _Smooth(frame_times, _CONSTANTS.smoothest * interval)
    clear = np.flatnonzero((np.abs(size) > _CONSTANTS.clear).any(axis=0))
    height = 2 * abs(value) or math.inf  # around a value, as around half of a peak
    rises = np.array([first.rise(series[:, p], is_measured[:, p], height) for p in clear])
    rise = float(np.median(rises[np.isfinite(rises)])) if np.isfinite(rises).any() else 0.0
    smooth = _Smooth(frame_times, max(_CONSTANTS.smoothest * interval, _WIDTHS[feature] * rise))
    arrivals, errors, weights = np.full(y.shape[1], np.nan), np.full(y.shape[1], np.nan), np.zeros(y.T.shape)
    noise_correlation = np.eye(len(frame_times)) if between_frames is None else between_frames
    step = first.rise((frame_times > frame_times[len(frame_times) // 2]) * 1.0, np.ones(len(frame_times), dtype=bool))
    abrupt, cut = 0 < rise < _CONSTANTS.abrupt * step, np.zeros(y.shape[1], dtype=bool)
    for p in range(y.shape[1]):
        at, is_rising = smooth.arrival(
            series[:, p], np.where(is_measured[:, p], spread[:, p], np.nan), feature, (sign * value, fraction)
        )
        cut[p] = is_rising and at is None
        if at is not None:
            arrivals[p], weights[p] = at
            weighted_std = weights[p] * np.nan_to_num(spread[:, p])
            noise = (1 - common_fraction) * weighted_std @ noise_correlation @ weighted_std
            noise += common_fraction * weighted_std.sum() ** 2
            errors[p] = math.sqrt(noise + abrupt * interval**2 / 12)
    at_positions = Field(name="arrival", dims=("position",), values=arrivals, std=errors)
    return Arrivals(times=at_positions, weights=sign * weights, abrupt=abrupt, cut=cut)


def read_level(level: float | str) -> tuple[float, float]:
    """Return the value at which a front is taken, and the fraction of the peak; one of them is 0.

    Parameters
    ----------
    level
        The value, or with a percent sign the fraction.

    Returns
    -------
    value, fraction : float

    Raises
    ------
    InputError
        It is neither, the value 0, or a fraction that is not between 0 and 100 %.
    """
    text = str(level).strip()
    try:
        number = float(text.removesuffix("%"))
    except ValueError:
        number = math.nan
    if text.endswith("%") and 0 < number < 100:
        return 0.0, number / 100
    if text.endswith("%") or not math.isfinite(number) or not number:
        raise InputError(
            f"the level of a front is a value of the field other than 0, such as -0.005, or between 0% and 100% of the "
            f"peak, not {level!r}"
        )
    return number, 0.0


class _Smooth:
    """Smooth curve through a series by local parabolas, and the places where it peaks and rises.

    Parameters
    ----------
    times : ndarray, shape (T,)
        Of the frames.
    half
        Half-width of the weights.
    """

    def __init__(self, times: FloatArray, half: float) -> None:
        self.times, self.half = times, half
        steps = [np.linspace(a, b, _CONSTANTS.fine, endpoint=False) for a, b in pairwise(times)]
        self.grid = np.append(np.concatenate(steps), times[-1])
        self._operators: dict[bytes, sp.csr_matrix] = {}

    def operator(self, is_measured: BoolArray) -> sp.csr_matrix:
        """Return the weight (G, T) of every frame in the curve at each place; NaN where too few frames are known."""
        if (key := is_measured.tobytes()) not in self._operators:
            batches = np.array_split(self.grid, math.ceil(len(self.grid) / _CONSTANTS.rows))
            self._operators[key] = sp.csr_matrix(
                sp.vstack([sp.csr_matrix(self._rows(batch, is_measured)) for batch in batches])
            )
        return self._operators[key]

    def _rows(self, points: FloatArray, is_measured: BoolArray) -> FloatArray:
        offset = (self.times[None] - points[:, None]) / self.half
        w = np.clip(1 - np.abs(offset) ** 3, 0, None) ** 3 * is_measured
        powers = np.stack([np.ones_like(offset), offset, offset**2], axis=1)
        normal = np.einsum("gt,git,gjt->gij", w, powers, powers, optimize=True)
        enough = np.linalg.det(normal) > _CONSTANTS.determined * normal[:, 0, 0] ** 3
        normal[~enough] = np.nan
        first = np.full((len(points), 3), np.nan)
        first[enough] = np.linalg.inv(normal[enough])[:, 0]
        return np.asarray(w * np.einsum("gi,git->gt", first, powers))

    def rise(self, series: FloatArray, is_measured: BoolArray, height: float = math.inf) -> float:
        """Return how long a series rises between the `_CONSTANTS.rise` fractions of its peak, or of a lower `height`.

        NaN where it does not.
        """
        curve = self.operator(is_measured) @ np.where(is_measured, series, 0.0)
        if not np.isfinite(curve).any():
            return math.nan
        top = int(np.nanargmax(curve))
        low, high = (self._crossing(curve, top, fraction * min(curve[top], height)) for fraction in _CONSTANTS.rise)
        return high - low

    def _crossing(self, curve: FloatArray, top: int, level: float) -> float:
        """Return when a curve last rises through a level before its place `top`; NaN where it does not."""
        below = np.flatnonzero(~(curve[:top] >= level))
        if not len(below) or not np.isfinite(curve[below[-1]]):
            return math.nan
        i = below[-1]
        fraction = (level - curve[i]) / (curve[i + 1] - curve[i])
        return float(self.grid[i] + fraction * (self.grid[i + 1] - self.grid[i]))

    def arrival(
        self, series: FloatArray, std: FloatArray, feature: str, level: tuple[float, float]
    ) -> tuple[tuple[float, FloatArray] | None, bool]:
        """Find the arrival in a series (T,).

        Returns
        -------
        arrival
            Its time, and the change (T,) of that by every value; None where nothing arrives.
        is_rising
            Whether the series still rises above all before in the last frames, by more than its noise.
        """
        is_measured, (value, fraction) = np.isfinite(std), level
        operator = self.operator(is_measured)
        values = np.where(is_measured, series, 0.0)
        curve = operator @ values
        if not np.isfinite(curve).any():
            return None, False
        top = int(np.nanargmax(curve))
        highest = operator[top].toarray().ravel()
        clear = _CONSTANTS.clear * float(np.linalg.norm(highest * np.nan_to_num(std)))
        before = np.where(self.grid <= self.times[-1] - self.half, np.nan_to_num(curve), 0.0).max()
        is_rising = curve[top] - before > clear
        if not curve[top] > clear or top == 0 or (feature == "peak" and top == len(curve) - 1):
            return None, False
        step = (self.grid[-1] - self.grid[0]) / (len(self.grid) - 1)
        if feature == "peak":
            at = float(self.grid[top])
            for _ in range(3):  # Newton's steps from the best of the places
                rows = self._rows(np.array([at - step, at, at + step]), is_measured)
                slope, curvature = (rows[2] - rows[0]) / (2 * step), (rows[2] - 2 * rows[1] + rows[0]) / step**2
                if not curvature @ values < 0:
                    return None, is_rising
                at = min(max(at - float(slope @ values) / float(curvature @ values), self.times[0]), self.times[-1])
            return (at, -slope / float(curvature @ values)), is_rising
        at = self._crossing(curve, top, value + fraction * curve[top])
        if (is_rising and fraction) or curve[top] < value or not math.isfinite(at):
            return None, is_rising
        rows = self._rows(np.array([at - step, at, at + step]), is_measured)
        slope = float((rows[2] - rows[0]) @ values) / (2 * step)
        return ((at, (fraction * highest - rows[1]) / slope) if slope > 0 else None), is_rising


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Front:
    """A straight line through arrival times: ``t = start + position / speed``.

    Attributes
    ----------
    speed, speed_std
        In the unit of the positions over that of the times, negative where it travels towards the first end. It is
        that over the material, on the reference.
    start, start_std
        When it is at position 0.
    is_fitted : ndarray, shape (P,), bool
        Positions that the fit takes in, so far apart that their noise is little correlated.
    residuals : ndarray, shape (P,)
        Arrival times less the line; NaN where nothing arrives.
    chi_square, freedom
        Weighted sum of the squared residuals of `is_fitted`, and how many degrees of freedom it has.
    probability
        That noise alone gives as large a chi-square. Where this exceeds the degrees of freedom the uncertainties are
        those of the noise times ``sqrt(chi_square / freedom)`` (Birge, Phys Rev 40, 1932).
    """

    speed: float
    speed_std: float
    start: float
    start_std: float
    is_fitted: BoolArray
    residuals: FloatArray
    chi_square: float
    freedom: int
    probability: float

    @property
    def is_straight(self) -> bool:
        """Return whether the arrival times lie on a line within their uncertainty."""
        return self.probability >= _CONSTANTS.doubtful


def fit_front(
    positions: FloatArray,
    arrivals: Arrivals,
    field: Field,
    correlation: FloatArray,
    *,
    usable: BoolArray | None = None,
    common_fraction: float = 0.5,
    between_frames: FloatArray | None = None,
) -> Front:
    """Fit the speed of a front by generalised least squares.

    Parameters
    ----------
    positions : ndarray, shape (P,)
        Along the line, rising.
    arrivals
        At these.
    field
        As of `arrival_times`, shape (T, P).
    correlation : ndarray, shape (P, P)
        Of the noise between positions.
    usable : ndarray, shape (P,), bool, optional
        Positions that may count, `ProfileLine.is_two_sided`; None: all.
    common_fraction, between_frames
        As `arrival_times`.

    Raises
    ------
    InputError
        Something arrives at fewer than four positions that are far enough apart, or at all of them at once: no front
        travels along the line.
    """
    arrival_indices = np.flatnonzero(np.isfinite(arrivals.times.values) & (True if usable is None else usable))
    fitted = list[int]()
    for p in arrival_indices:
        if not fitted or abs(correlation[p, fitted[-1]]) <= _CONSTANTS.independent:
            fitted.append(int(p))
    if len(fitted) < _CONSTANTS.fewest:
        cut = int(arrivals.cut.sum())
        rising = f"; at {cut} positions the field still rises in the last of them: take a value, not a part of the peak"
        raise InputError(
            f"no front: something arrives at {len(arrival_indices)} of {len(positions)} positions, {len(fitted)} of "
            f"them far enough apart to be independent; a speed needs {_CONSTANTS.fewest}. A peak counts that exceeds "
            f"{_CONSTANTS.clear:g} standard uncertainties and lies within the frames{rising if cut else ''}"
        )
    weighted_std = arrivals.weights[fitted] * np.nan_to_num(field.uncertainty.T[fitted])
    noise_covariance = (
        weighted_std @ weighted_std.T if between_frames is None else weighted_std @ between_frames @ weighted_std.T
    )
    sums = weighted_std.sum(axis=1)
    cover = correlation[np.ix_(fitted, fitted)] * (
        (1 - common_fraction) * noise_covariance + common_fraction * np.outer(sums, sums)
    )
    cover += np.diag(
        np.maximum(arrivals.times.uncertainty[fitted] ** 2 - np.diag(cover), 0)
    )  # what is not noise, between two frames
    design = np.stack([np.ones(len(fitted)), positions[fitted]], axis=1)
    weighted = np.linalg.solve(cover, design)
    spread = np.linalg.inv(design.T @ weighted)
    start, slope = spread @ (weighted.T @ arrivals.times.values[fitted])
    residuals = arrivals.times.values - start - slope * positions
    chi_square, freedom = float(residuals[fitted] @ np.linalg.solve(cover, residuals[fitted])), len(fitted) - 2
    probability = float(chdtrc(freedom, chi_square))
    spread = spread * max(chi_square / freedom, 1)
    start_std, slope_std = np.sqrt(np.diag(spread))
    if not abs(slope) > _CONSTANTS.travels * slope_std:
        differ = format_with_std(*(value * np.ptp(positions[fitted]) for value in (slope, slope_std)))
        raise InputError(
            f"no front travels along the line: the arrival times differ by {differ} between its ends "
            f"(chi-square {chi_square:.3g} of {freedom}); "
            f"a speed needs {_CONSTANTS.travels:g} standard uncertainties"
        )
    return Front(
        speed=float(1 / slope),
        speed_std=float(slope_std / slope**2),
        start=float(start),
        start_std=float(start_std),
        is_fitted=np.isin(np.arange(len(positions)), fitted),
        residuals=residuals,
        chi_square=chi_square,
        freedom=freedom,
        probability=probability,
    )
