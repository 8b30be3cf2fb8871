"""Stress intensity at the tip of a crack: Williams' series fitted to the displacements around it.

Near the tip of a straight crack in a plane linear elastic body the displacement is Williams' series (J Appl Mech 24,
1957), here in the complex form of Roux, Réthoré and Hild (J Phys D 42, 214004, 2009), with r and the angle t from the
direction of the crack, the shear modulus G and Kolosov's constant k::

    2 G (u + i v) = sum_n r^(n/2) [ a_n (k e^(i n t/2) - n/2 e^(i (2 - n/2) t) + (n/2 + (-1)^n) e^(-i n t/2))
                                - i b_n (k e^(i n t/2) + n/2 e^(i (2 - n/2) t) - (n/2 - (-1)^n) e^(-i n t/2)) ]

``K_I = sqrt(2 pi) a_1``, ``K_II = sqrt(2 pi) b_1``, the T-stress is ``4 a_2``; n = 0 and b_2 are the rigid motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.linalg import cholesky, solve_triangular

from rgbmidic.arguments import check_fields
from rgbmidic.errors import InputError
from rgbmidic.field import Displacement, Field
from rgbmidic.fields.cracks import comma_separated, crack_faces, nearest_node
from rgbmidic.fields.history import of_probe
from rgbmidic.fields.interpolation import MeshPoints
from rgbmidic.fields.nodal import NodalCovariance
from rgbmidic.fields.quantity import Units
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.settings import ProbeSettings
from rgbmidic.typing import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CrackTipConstants:
    """Numbers of the fit at a crack's tip.

    Attributes
    ----------
    inner
        Least inner radius of an annulus, in elements: from there on K of an image without noise is right to .3 %
        (measured).
    straight
        Distance (px) of a straight crack's nodes from its line: as near as a row of nodes follows a stated path.
    most_terms
        Highest term of the series that a test may ask for.
    per_coefficient
        Least number of measured components of displacement for a coefficient of the series.
    chance
        Probability with which noise alone asks for more terms of the series, over all frames together.
    gap_deg
        Largest angle without a measured node: half of the shortest period, 90 degrees, of the terms up to the 7th that
        are left when the smooth ones are taken (chosen).
    outside
        Part of an annulus that may be outside the mesh: slivers at the edge are left out of it.
    steps, exact
        Most Gauss-Newton steps of a tip's place, and the step (px) that ends them.
    poor
        Chi-square over its degrees of freedom from which a remark says that the field is not the series'.
    least_std
        Least uncertainty of a node over the median one: a node that is stated without noise does not outweigh all
        others.
    """

    inner: float = 2.0
    straight: float = 1.0
    most_terms: int = 7
    per_coefficient: int = 4
    chance: float = 1e-3
    gap_deg: float = 45.0
    outside: float = 0.02
    steps: int = 20
    exact: float = 1e-3
    poor: float = 1.5
    least_std: float = 1e-3


_CONSTANTS = CrackTipConstants()


@dataclass(frozen=True, slots=True, kw_only=True)
class Williams:
    """Material, scale and terms that the fit of Williams' series needs beside the displacements.

    Attributes
    ----------
    youngs_modulus, poissons_ratio
        Of the material; the modulus in MPa.
    plane
        ``"stress"`` (a thin body) or ``"strain"`` (a thick one).
    units
        With the millimetres for a pixel.
    terms
        Highest term N of the series; 0: the least one that a chi-square test accepts in all frames.
    fit_tip
        Whether the tip's place along the crack is fitted in every frame; else it is that of the mesh.

    Examples
    --------
    >>> steel = Williams(youngs_modulus=210e3, poissons_ratio=0.3, plane="stress", units=Units(mm_per_pixel=0.05))
    >>> round(steel.kolosov, 3)
    2.077
    """

    youngs_modulus: float
    poissons_ratio: float
    plane: Literal["stress", "strain"]
    units: Units
    terms: int = 0
    fit_tip: bool = False

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        e, nu = self.youngs_modulus, self.poissons_ratio
        if not (
            e > 0 and -1 < nu <= 0.5 and self.plane in ("stress", "strain") and (self.terms == 0 or self.terms >= 2)
        ):
            raise InputError(
                "Williams' series needs a Young's modulus above 0 MPa, a Poisson's ratio above -1 and at most .5, the "
                f'plane "stress" or "strain", and terms 0, 2 or more; given are {e:g}, {nu:g}, "{self.plane}", '
                f"{self.terms}"
            )
        if self.units.mm_per_pixel is None:
            raise InputError(
                "stress intensity factors, in MPa √m, need the scale of the image: state mm_per_pixel or camera in "
                "[scale] (`rgbmidic scale` finds the former), and no lengths in px (scale.unit)"
            )

    @property
    def shear(self) -> float:
        """Twice the shear modulus, MPa."""
        return self.youngs_modulus / (1 + self.poissons_ratio)

    @property
    def kolosov(self) -> float:
        """Kolosov's constant."""
        nu = self.poissons_ratio
        return 3 - 4 * nu if self.plane == "strain" else (3 - nu) / (1 + nu)


def williams_series(r: FloatArray, angle: FloatArray, orders: range, kolosov: float) -> FloatArray:
    """Evaluate the terms of Williams' series times 2 G, in axes along the crack and to its left.

    Parameters
    ----------
    r, angle : ndarray, shape (m,)
        Distance from the tip, and angle from the direction of the crack to its left, rad.
    orders
        The numbers n of the terms.
    kolosov
        Kolosov's constant.

    Returns
    -------
    ndarray, shape (m, 2, p)
        u and v of a_n and b_n, one n after the other.
    """
    terms = []
    for n in orders:
        sign, power = (-1) ** n, r ** (n / 2)
        turn, over, back = (np.exp(1j * k * angle) for k in (n / 2, 2 - n / 2, -n / 2))
        terms.append(power * (kolosov * turn - n / 2 * over + (n / 2 + sign) * back))
        terms.append(-1j * power * (kolosov * turn + n / 2 * over - (n / 2 - sign) * back))
    series = np.stack(terms, axis=-1)
    return np.stack([series.real, series.imag], axis=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StressIntensity:
    """Stress intensity at a tip; NaN in frames in which the annulus is not measured.

    Attributes
    ----------
    factors
        K_I and K_II, MPa √m, shape (T, 2). K_II is positive where the left side moves ahead.
    t_stress
        MPa, shape (T,).
    extension
        Distance (px) by which the fitted tip is ahead of the mesh's, shape (T,); None where it is not fitted.
    chi_square : ndarray, shape (T,)
        Of the fit over its degrees of freedom: 1 where the series describes the field within its stated uncertainty.
    terms
        Highest term of the series.

    Examples
    --------
    >>> dims, std = ("frame", "mode"), np.full((1, 2), 0.5)
    >>> factors = Field(name="K", unit="MPa √m", dims=dims, values=np.full((1, 2), 25.0), std=std)
    >>> t_stress = Field(name="T", unit="MPa", values=np.zeros(1), std=np.array([3.0]))
    >>> intensity = StressIntensity(
    ...     factors=factors, t_stress=t_stress, extension=None, chi_square=np.ones(1), terms=4
    ... )
    >>> intensity.factors.values[0].tolist()  # MPa √m
    [25.0, 25.0]
    """

    factors: Field
    t_stress: Field
    extension: Field | None
    chi_square: FloatArray
    terms: int


class CrackTip:
    """A probe of the stress intensity factors at the tip of a straight crack.

    Parameters
    ----------
    covariance
        Of the mesh.
    name
        Name of the probe.
    *place
        Point x, y at the tip, then inner and outer radius of the annulus whose nodes are taken, px.
    williams
        Material, scale and what is fitted.

    Attributes
    ----------
    tip : ndarray, shape (2,)
        Place of the mesh's tip, px.
    axes : ndarray, shape (2, 2)
        Rows: direction of the crack, and to its left as seen.
    points : ndarray, shape (m, 2)
        The nodes of the annulus in these axes from the tip, px.
    face : ndarray, shape (m,)
        1 for a node on the left side of the crack, -1 on its right side, else 0.
    correlations : ndarray, shape (2, m, m)
        Of the nodes' errors: those of the fit, and those that the lights' bias leaves.
    min_nodes
        Least number of nodes for the terms that are asked for.
    most_terms
        Highest term that is taken, stated or allowed to the test.

    Raises
    ------
    InputError
        The place is no tip of the mesh, the crack is not straight up to the outer radius, or the annulus leaves the
        region, has too few nodes, or reaches into the elements at the tip.
    """

    def __init__(self, covariance: NodalCovariance, name: str, *place: float, williams: Williams) -> None:
        mesh, (inner, outer) = covariance.mesh, place[2:]
        self.name, self.williams, self.radii = name, williams, (float(inner), float(outer))
        faces, merged_index = crack_faces(mesh), mesh.merged_index
        tip_nodes = np.setdiff1d(faces, mesh.copies)
        node = nearest_node(mesh, name, tip_nodes, np.array(place[:2]), "the tip of a crack")
        self.tip = tip = mesh.nodes[node]
        nearest = _CONSTANTS.inner * mesh.size
        if not nearest <= inner < outer:
            raise InputError(
                f"{name} needs an inner radius of 2 elements, {nearest:.3g} px, or more, as nearer nodes do not "
                f"resolve the field at a tip, and a larger outer one; given are {inner:g} and {outer:g} px"
            )
        near = np.setdiff1d(merged_index[faces], node)
        behind = tip - mesh.nodes[near]
        behind = behind[np.hypot(*behind.T) < outer]
        ahead = behind.sum(axis=0) / np.hypot(*behind.sum(axis=0))
        self.axes = np.array([ahead, [ahead[1], -ahead[0]]])
        along, beside = self.axes @ behind.T
        if np.abs(beside).max() > _CONSTANTS.straight or along.min() < 0 or along.max() < outer - 2 * mesh.size:
            raise InputError(
                f"{name} needs one crack that is straight from the tip at ({comma_separated(tip.round(1))}) px to the "
                f"outer radius, {outer:g} px; it is {along.max():.4g} px long there and leaves its line by "
                f"{np.abs(beside).max():.3g} px"
            )
        side = np.zeros(len(mesh.nodes))
        forward = (mesh.nodes[faces[:, 1]] - mesh.nodes[faces[:, 0]]) @ ahead > 0
        side[faces[forward]], side[faces[~forward]] = -1, 1
        distance = np.hypot(*(mesh.nodes - tip).T)
        self.nodes = np.flatnonzero((distance >= inner) & (distance <= outer))
        self.points, self.face = (mesh.nodes[self.nodes] - tip) @ self.axes.T, side[self.nodes]
        node_covariance, per = covariance.subset(self.nodes), _CONSTANTS.per_coefficient
        self.correlations = np.stack(
            [(root @ root.T).toarray() for root in (node_covariance.fit, node_covariance.bias)]
        )
        self.min_nodes = per * ((williams.terms or 2) + 1)
        self.most_terms = williams.terms or min(_CONSTANTS.most_terms, len(self.nodes) // per - 1)
        self._check_annulus(mesh)

    def _check_annulus(self, mesh: Tri3Mesh) -> None:
        inner, outer = self.radii
        angles, radii = np.linspace(0, 2 * np.pi, 90, endpoint=False), np.linspace(inner, outer, 40)
        ring = self.tip + radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        outside = 1 - MeshPoints.of(mesh, ring.reshape(-1, 2)).inside.reshape(ring.shape[:2]).mean(axis=1)
        annulus_text = (
            f"{self.name}: the annulus from {inner:g} to {outer:g} px around ({comma_separated(self.tip.round(1))}) px"
        )
        if len(cut := np.flatnonzero(outside > _CONSTANTS.outside)):
            reach_text = f"it may reach to {radii[cut[0] - 1]:.4g} px" if cut[0] else "no part of it is within"
            raise InputError(
                f"{annulus_text} leaves the region (edge or hole) at {100 * outside.max():.0f} % of its angles; "
                f"{reach_text}"
            )
        if not self._is_sufficient(np.ones(len(self.nodes), dtype=bool)):
            raise InputError(
                f"{annulus_text} has {len(self.nodes)} nodes, none over up to {self._gap(self.points):.0f} degrees; "
                f"{self.min_nodes} are needed, and one every {_CONSTANTS.gap_deg:g} degrees: widen it, or take smaller "
                "elements"
            )

    def series(self, points: FloatArray, face: FloatArray, orders: range) -> FloatArray:
        """Evaluate terms at points (m, 2), those of a `face` on its side, in (r / outer radius)^(n/2); (m, 2, p)."""
        angle = np.arctan2(points[:, 1], points[:, 0])
        angle += 2 * np.pi * face * (angle * face < 0)
        return williams_series(np.hypot(*points.T) / self.radii[1], angle, orders, self.williams.kolosov)

    def _gap(self, points: FloatArray) -> float:
        """Largest angle in degrees without a point, the crack's two sides being ends."""
        return float(np.degrees(np.diff(np.sort([-np.pi, *np.arctan2(points[:, 1], points[:, 0]), np.pi])).max()))

    def _is_sufficient(self, is_measured: BoolArray) -> bool:
        return bool(is_measured.sum() >= self.min_nodes and self._gap(self.points[is_measured]) <= _CONSTANTS.gap_deg)

    def read(self, displacement: Displacement) -> StressIntensity:
        """Fit the series to the displacements of the `nodes` in every frame.

        The weights are the inverse covariance of the nodes, neighbours correlated. Where the chi-square is above its
        degrees of freedom the uncertainty grows by the root of their ratio (Birge, Phys Rev 40, 1932). The terms go up
        to the least N from which all those beyond it lower no frame's chi-square by more than noise would, once in a
        thousand tests; where the tip is fitted the terms n = -1, which shift it, take part in that.
        """
        arrays = displacement.values, displacement.uncertainty, displacement.bias_std
        fields = np.concatenate(arrays).swapaxes(0, 1)
        is_measured: BoolArray = np.asarray(np.isfinite(fields).all(axis=1))
        frames = np.flatnonzero([self._is_sufficient(row) for row in is_measured])
        data = {frame: _Weighted(self, fields[frame], is_measured[frame]) for frame in frames.tolist()}
        fit_tip = self.williams.fit_tip
        terms = self.williams.terms or self._terms(
            [frame_data for frame_data in data.values() if not frame_data.certain]
        )
        coefficients, chi_square = np.full((len(fields), 4, 2), np.nan), np.full(len(fields), np.nan)
        for frame, weighted in data.items():
            if (fit := weighted.fit(terms)) is not None:
                values, covariance, chi_square[frame] = fit
                std = np.sqrt(np.diag(covariance) * max(1.0, chi_square[frame]))
                if weighted.certain:
                    std, chi_square[frame] = 0 * std, np.nan
                coefficients[frame] = np.stack([values, std], axis=1)[[2, 3, 4, -1]]
        outer, units, scale = self.radii[1], self.williams.units, self.williams.shear
        assert units.mm_per_pixel is not None
        # coefficients are those of (r / outer)^(n/2); a pixel is mm_per_pixel / 1000 m
        factors = scale * np.sqrt(2 * np.pi * units.mm_per_pixel * 1e-3 / outer) * coefficients[:, :2]
        factors[..., 1] = np.hypot(factors[..., 1], factors[..., 0] * units.mm_per_pixel_std / units.mm_per_pixel / 2)
        (t_stress, t_std), (ahead, ahead_std) = (4 * scale / outer * coefficients[:, 2]).T, coefficients[:, 3].T
        return StressIntensity(
            factors=Field(name="K", unit="MPa √m", dims=("frame", "mode"), values=factors[..., 0], std=factors[..., 1]),
            t_stress=Field(name="T", unit="MPa", values=t_stress, std=t_std),
            extension=Field(name="extension", unit="px", values=ahead, std=ahead_std) if fit_tip else None,
            chi_square=chi_square,
            terms=terms,
        )

    def _terms(self, frames: list[_Weighted]) -> int:
        """Choose the highest term of the series."""
        from scipy.stats import chi2

        most_terms = self.most_terms
        orders = range(-1 if self.williams.fit_tip else 0, most_terms + 1)
        misfits = np.array([frame.misfits(orders) for frame in frames]).reshape(-1, len(orders))
        freedom = np.array([2 * len(frame.points) - 2 * len(orders) for frame in frames])
        level = np.maximum(1, misfits[:, -1] / freedom)
        for terms in range(2, most_terms):
            limit = chi2.isf(_CONSTANTS.chance / max(len(frames), 1), 2 * (most_terms - terms))
            if (misfits[:, terms - most_terms - 1] - misfits[:, -1] < limit * level).all():
                return terms
        return most_terms

    def histories(self, displacement: Displacement) -> list[Field]:
        """Compute the stress intensity factors, the T-stress, the fitted tip's way and the chi-square of the fit."""
        s, w = self.read(displacement), self.williams
        tip, radii = comma_separated(self.tip.round(1)), comma_separated(self.radii)
        tip_text = "its place along the crack is fitted" if w.fit_tip else "its place is that of the mesh"
        note = (
            f"{self.name}: tip at ({tip}) px, {tip_text}; Williams' series up to n = "
            f"{s.terms} ({'stated' if w.terms else 'by a test'}), {len(self.nodes)} nodes at {radii} px, "
            f"plane {w.plane}, E = {w.youngs_modulus:g} MPa, nu = {w.poissons_ratio:g}"
        )
        if np.isfinite(s.chi_square).any() and (worst := np.nanmax(s.chi_square)) > _CONSTANTS.poor:
            note += (
                f"; its chi-square over the degrees of freedom is up to {worst:.3g}, where 1 is expected: the "
                "field is not the series' within the noise, and what this makes of the factors is not known"
            )
        modes = [replace(s.factors.isel(mode=mode), name=f"K{mode + 1}") for mode in range(2)]
        quantities = [*modes, s.t_stress, *([] if s.extension is None else [s.extension])]
        return of_probe(self.name, [*quantities, Field(name="chi_square", values=s.chi_square)], note)


class _Weighted:
    """The displacements and uncertainties (6, m) of a frame in an annulus, without rotation, their errors independent.

    Attributes
    ----------
    points, face
        Those of `CrackTip` that are measured.
    data : ndarray, shape (2 m,)
        Displacements over their errors.
    turned : ndarray, shape (2, 2)
        The crack's axes as the body has turned: rows.
    certain
        Whether the displacements are stated without uncertainty, as those of the reference: all errors are then 1 px.
    """

    def __init__(self, probe: CrackTip, field: FloatArray, is_measured: BoolArray) -> None:
        std, bias = field[2:4, is_measured], field[4:, is_measured]
        level = float(np.median(std))
        self.probe, self.certain, self._factors = probe, not level > 0, list[FloatArray]()
        std = np.ones_like(std) if self.certain else np.maximum(std, _CONSTANTS.least_std * level)
        correlations, shared = probe.correlations[:, is_measured][..., is_measured], np.minimum(bias, std)
        for component_std in np.stack([np.sqrt(std**2 - shared**2), shared], axis=1)[..., None]:
            covariance = (component_std * correlations * component_std.swapaxes(1, 2)).sum(axis=0)
            self._factors.append(cholesky(covariance, lower=True))
        self.points, self.face = probe.points[is_measured], probe.face[is_measured]
        arm = self.points @ probe.axes
        arm -= arm.mean(axis=0)
        deformed = arm + field[:2, is_measured].T
        deformed -= deformed.mean(axis=0)
        # the series is that of small rotations: the body's, from the best one (Kabsch), is then that of its own term
        angle = np.arctan2((arm[:, 0] * deformed[:, 1] - arm[:, 1] * deformed[:, 0]).sum(), (arm * deformed).sum())
        for last in (False, True):
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            self.turned, data = probe.axes @ turn, deformed - arm @ turn
            if not last:
                series = probe.series(self.points, self.face, range(probe.most_terms + 1)).reshape(2 * len(arm), -1)
                rotation = np.linalg.lstsq(series, (data @ self.turned.T).ravel(), rcond=None)[0][5]
                angle += (probe.williams.kolosov + 1) * rotation / probe.radii[1]
        self.data = self.whiten(data.T[:, :, None])[:, 0]

    def whiten(self, fields: FloatArray) -> FloatArray:
        """Divide fields (2, m, p) by their errors, (2 m, p)."""
        factors = zip(self._factors, fields, strict=True)
        return np.concatenate([solve_triangular(factor, component, lower=True) for factor, component in factors])

    def series(self, orders: range, tip: float = 0.0) -> FloatArray:
        """Evaluate the terms, in (r / outer radius)^(n/2), for a tip so many px ahead; (2, m, p)."""
        series = self.probe.series(self.points - (tip, 0.0), self.face, orders)
        return np.asarray(np.einsum("mcp,ci->imp", series, self.turned))

    def misfits(self, orders: range) -> FloatArray:
        """Chi-square of the best fit of the terms up to each."""
        projections = np.linalg.qr(self.whiten(self.series(orders)))[0].T @ self.data
        return np.asarray((self.data**2).sum() - np.cumsum((projections**2).reshape(-1, 2).sum(axis=1)))

    def fit(self, terms: int) -> tuple[FloatArray, FloatArray, float] | None:
        """Fit the terms: coefficients, their covariance, and chi-square over its degrees of freedom.

        Where the tip is fitted the last value is the way (px) by which it is ahead, less than half the inner radius,
        beyond which the annulus is another one; None where it is not found.
        """
        orders, tip, step, fit_tip = range(terms + 1), 0.0, 1e-3 * self.probe.radii[1], self.probe.williams.fit_tip
        solved = self._solved(self.series(orders))
        for _ in range(_CONSTANTS.steps if fit_tip else 0):
            values = solved[0][: 2 * len(orders)]
            slope = (self.series(orders, tip + step) - self.series(orders, tip - step)) @ values / (2 * step)
            solved = self._solved(np.concatenate([self.series(orders, tip), slope[..., None]], axis=2))
            change = float(solved[0][-1])
            tip += change
            if not abs(tip) < self.probe.radii[0] / 2:
                return None
            if abs(change) < _CONSTANTS.exact:
                return np.r_[solved[0][:-1], tip], *solved[1:]
        return None if fit_tip else solved

    def _solved(self, series: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        design = self.whiten(series)
        q, triangle = np.linalg.qr(design)
        inverse = solve_triangular(triangle, np.eye(len(triangle)))
        values = inverse @ (q.T @ self.data)
        chi_square = ((self.data - design @ values) ** 2).sum() / (len(self.data) - len(values))
        return values, inverse @ inverse.T, float(chi_square)


def tip_probe(covariance: NodalCovariance, name: str, *place: float, settings: ProbeSettings, units: Units) -> CrackTip:
    """Make the probe of one of the ``tips`` of ``[probes]``, which checks that the material is stated."""
    keys = ("youngs_modulus", "poissons_ratio", "plane", "terms", "fit_tip")
    williams: dict[str, Any] = {key: getattr(settings, key) for key in keys}
    return CrackTip(covariance, name, *place, williams=Williams(units=units, **williams))


def stress_intensity(
    nodes: FloatArray,
    elements: npt.NDArray[np.int32],
    displacement: Displacement,
    tip: tuple[float, float],
    radii: tuple[float, float],
    williams: Williams,
) -> StressIntensity:
    """Fit Williams' series around the tip of a straight crack of a mesh.

    Parameters
    ----------
    nodes : ndarray, shape (N, 2)
        In px on the reference.
    elements : ndarray, shape (E, 3)
        Node indices.
    displacement
        Of all nodes, shape (2, T, N), px.
    tip
        Point (x, y) at the tip, px.
    radii
        Inner and outer radius of the annulus whose nodes are taken, px.
    williams
        Material, scale, and what is fitted.

    Returns
    -------
    StressIntensity

    Raises
    ------
    InputError
        The place is no tip of the mesh, the crack is not straight up to the outer radius, or the annulus leaves the
        region, has too few nodes, or reaches into the elements at the tip.

    Examples
    --------
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> region = Region.from_rectangle((0, 0, 140, 140), shape=(160, 160))
    >>> mesh = Tri3Mesh.from_region(region, element_size=16, cracks=[[(0, 70), (70, 70)]])
    >>> zero = np.zeros((1, len(mesh.nodes)))
    >>> still = Displacement.in_plane(zero, zero, zero + 0.01, zero + 0.01)
    >>> steel = Williams(youngs_modulus=210e3, poissons_ratio=0.3, plane="stress", units=Units(mm_per_pixel=0.05))
    >>> result = stress_intensity(mesh.nodes, mesh.elements, still, (70, 70), (32, 68), steel)
    >>> np.abs(result.factors.values).max() < 1e-9
    np.True_
    """
    covariance = NodalCovariance.from_mesh(Tri3Mesh(nodes=nodes, elements=elements))
    probe = CrackTip(covariance, "the tip", *tip, *radii, williams=williams)
    return probe.read(displacement.isel(node=probe.nodes))
