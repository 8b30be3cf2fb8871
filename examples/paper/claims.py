"""The paper's statements, one by one, against what the virtual experiment measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from measurement import METHODS, PaperStudy, SceneStudy

Verdict = Literal["reproduced", "in part", "not reproduced", "not measured"]

SMALL, LARGE = 2.0, 6.0
"""Degrees: what the paper calls small (up to) and large (from)."""
TREND = 1.3
"""An area follows the trend of A0 where its P is at most this multiple of that of A0."""
CERTAIN = 1.5
"""A verdict is certain where its limits could be so many times as strict or as lenient: P of an area, of some ten
nodes, scatters by a quarter with the draw of the noise."""


@dataclass(frozen=True, slots=True)
class Claim:
    """A statement and what became of it."""

    figure: str  # where the paper makes it
    scene: str  # on which virtual scene it was tested; empty: on the flat specimen
    statement: str  # the paper's words, shortened
    measured: str  # the figures of the virtual experiment
    verdict: Verdict
    reason: str = ""  # why it differs, where it does and where a reason was found
    possible: tuple[Verdict, ...] = ()  # verdicts by limits `CERTAIN` times as strict or as lenient; one if certain

    def __post_init__(self) -> None:
        object.__setattr__(self, "possible", self.possible or (self.verdict,))
        if self.verdict == "reproduced":
            object.__setattr__(self, "reason", "")


def judge(study: PaperStudy) -> tuple[Claim, ...]:
    """Test every statement for which the study has the angles."""
    claims = [*_specimen(study), _noise(study)]
    for scene in study.scenes:
        data = _Data(scene)
        tests = _ON_EVERY_SCENE + (_ON_THE_PAPERS_SCENE if data.name == "sequential" else ())
        claims += [Claim(scene=data.name, **test(data)) for test in tests]
    return tuple(sorted(claims, key=lambda claim: (claim.scene == "bayer", _number(claim.figure))))


def _number(figure: str) -> float:
    digits = "".join(c for c in figure.split(",")[0] if c.isdigit() or c == ".").strip(".")
    return float(digits) + (0.0 if figure.startswith("Fig") else 100.0)


class _Data:
    """P of the methods at the angles above 0, and P over that of A0, both (n, 5)."""

    def __init__(self, scene: SceneStudy) -> None:
        self.scene = scene
        self.name = scene.bench.name
        angles = np.array(scene.angles)
        self.moved = angles > 0
        self.angles = angles[self.moved]
        self.small = self.angles <= SMALL
        self.large = self.angles >= LARGE
        self.p = {method: scene.perturbation(method)[self.moved] for method in METHODS}
        self.ratio = {method: p / p[:, :1] for method, p in self.p.items()}


def _under(value: float, limit: float) -> float:
    """How many times a positive value lies under its limit."""
    return limit / max(value, 1e-9 * limit)


def _over(value: float, limit: float) -> float:
    return value / limit


def _at_least(part: np.ndarray, limit: float) -> float:
    """How far the fraction of a count lies above its limit, as a factor: `CERTAIN` for 2 of the count."""
    return CERTAIN ** ((part.sum() - limit * part.size + 0.5) / 2)


def _graded(full: Sequence[float], part: Sequence[float] = (0.0,)) -> dict[str, Any]:
    """The verdict, and those by other limits, from what must lie beyond its limit: factors of 1 and more do."""

    def verdict(factor: float) -> Verdict:
        return "reproduced" if np.min(full) >= factor else "in part" if np.min(part) >= factor else "not reproduced"

    possible = [verdict(factor) for factor in (CERTAIN, 1, 1 / CERTAIN)]
    return {"verdict": possible[1], "possible": tuple(dict.fromkeys(possible))}


def _displacement_of_reflection(data: _Data) -> dict[str, Any]:
    bench, angle = data.scene.bench, data.scene.angles[-1]
    way, expected = data.scene.peaks[-1][0] - bench.areas[-1].centre[0], bench.reflection_shift(angle)
    return {
        "figure": "Fig. 4",
        "statement": "the reflection moves from A4 at 0° to A2 at 14°, about 200 px",
        "measured": f"the brightest point of the blurred image moves by {way:.0f} px at {angle:g}° "
        f"({expected:.0f} px by geometry)",
        **_graded([_under(abs(way - expected), 20)]),
        "reason": "The brightest point is that of reflection and diffuse light together, and of the speckle that is "
        "left.",
    }


def _residual(data: _Data) -> dict[str, Any]:
    residual = data.scene.series("dic", "residual")[data.moved]
    return {
        "figure": "Sec. 2.2",
        "statement": "the residual of plain DIC is about 2 % of the effective dynamic range at every angle",
        "measured": f"{residual.min():.1f} to {residual.max():.1f} %",
        **_graded([_under(residual.max(), 3)], [_under(residual.min(), 3), _over(residual.max(), 3)]),
        "reason": "The residual grows with the angle because it holds the reflection itself, which stays with the "
        "lamps while the paint moves on. A reflection as bright as here cannot leave 2 % at 14°.",
    }


def _linear_mean(data: _Data) -> dict[str, Any]:
    claim = {"figure": "Fig. 6", "statement": "the mean U_y of every area is linear in the angle"}
    if len(data.angles) < 3:
        return claim | {"measured": "needs 3 angles", "verdict": "not measured"}
    mean = data.scene.series("dic", "mean")[data.moved, 1]
    known = np.isfinite(mean)
    filled = np.where(known, mean, 0.0)
    slope = (data.angles @ filled) / ((data.angles[:, None] * known) ** 2).sum(axis=0)
    worst = float(np.abs(np.where(known, filled - np.outer(data.angles, slope), 0)).max() / np.abs(filled).max())
    return claim | {
        "measured": f"largest deviation from a straight line {worst:.1%} of the largest displacement of any area",
        **_graded([_under(worst, 0.1)]),
        "reason": "The reflection's error adds to a small displacement.",
    }


def _unaffected(data: _Data) -> dict[str, Any]:
    a0 = data.p["dic"][:, 0]
    growth = a0[-1] / a0[0]
    return {
        "figure": "Fig. 7, A0",
        "statement": "P of A0 is 0.004 px at small angles and rises slowly, tenfold at 14°",
        "measured": f"{a0[0]:.4f} px at {data.angles[0]:g}°, {a0[-1]:.4f} px at {data.angles[-1]:g}°: "
        f"{growth:.1f} times",
        **_graded([_over(a0[0], 0.001), _under(a0[0], 0.008), _over(growth, 2)]),
    }


def _at_once(data: _Data) -> dict[str, Any]:
    first = data.ratio["dic"][0, 3:]
    return {
        "figure": "Fig. 7, A4",
        "statement": "P of A4 is up to 4 times that of A0 from the smallest angle (0.33°) on",
        "measured": f"at {data.angles[0]:g}° {first[1]:.1f} times in A4 and {first[0]:.1f} times in A3",
        **_graded([_over(first.max(), 3)], [_over(first.max(), 1.5)]),
        "reason": "At this angle the camera's noise makes most of P; without it P is several times larger in the "
        "reflection than beside it (causes: camera without noise). Sharper facets or more gloss bring the paper's "
        "factor at once.",
    }


def _factor(data: _Data) -> dict[str, Any]:
    ratio = data.ratio["dic"]
    worst = np.nanmax(ratio, axis=1)
    text = "largest P of any area over A0: " + _per_angle(data.angles, worst)
    if lost := [f"A{area} at {data.angles[row]:g}°" for row, area in np.argwhere(np.isnan(ratio))]:
        text += f"; not measurable: {', '.join(lost)}"
    return {
        "figure": "Fig. 7",
        "statement": "a reflection multiplies P by 4 to 5",
        "measured": text,
        **_graded([_over(np.nanmax(worst), 4), _under(worst.max(), 6)], [_over(np.nanmax(worst), 4)]),
        "reason": "Demosaicing and unmixing raise P of A0 itself, to which the reflection is compared."
        if data.name == "bayer"
        else "The factor is that of the gloss: the reflection's brightness against the contrast of the speckle "
        "(causes: P doubles with the gloss and halves with it). The paper does not give its paint's gloss.",
    }


def _only_then(data: _Data) -> dict[str, Any]:
    first = data.ratio["dic"][0, 1:3]
    later = np.nanmax(data.ratio["dic"][data.large, 1:3], axis=0) if data.large.any() else np.full(2, np.nan)
    graded = _graded([_under(first.max(), 1.6), _over(np.nanmax(later), 2)])
    return {
        "figure": "Fig. 7, A1 to A3",
        "statement": "areas that the reflection has not reached have the P of A0; once it crosses them P rises up to 5 "
        "times",
        "measured": f"A1, A2 at {data.angles[0]:g}°: {first[0]:.1f}, {first[1]:.1f} times A0; at {LARGE:g}° and more "
        f"up to {later[0]:.1f}, {later[1]:.1f} times",
        **(graded if data.large.any() else {"verdict": "not measured"}),
        "reason": "In small frames the areas stand closer together than in the paper, and A2 lies in the disturbed "
        "zone.",
    }


def _glc_small(data: _Data) -> dict[str, Any]:
    claim = {
        "figure": "Fig. 8, A3 and A4",
        "statement": "the grey-level correction leaves the increase at up to 2° nearly unchanged",
    }
    if not data.small.any():
        return claim | {"measured": "needs an angle up to 2°", "verdict": "not measured"}
    ratio = (data.p["glc-dic"] / data.p["dic"])[data.small, 3:]
    mean = float(np.nanmean(ratio))
    return claim | {
        "measured": f"P of GLC-DIC over plain DIC at up to {SMALL:g}°: {mean:.2f} on average, {np.nanmin(ratio):.2f} "
        f"to {np.nanmax(ratio):.2f}",
        **_graded([_over(mean, 0.8)], [_over(mean, 0.5)]),
        "reason": "What the correction cannot undo is the erratic part of the reflection (relief of droplets and "
        "wrinkles; causes: on flat, smooth paint GLC-DIC compensates all). It is smaller here than in the paper, where "
        "single pixels change erratically with the angle (Fig. 9).",
    }


def _glc_large(data: _Data) -> dict[str, Any]:
    claim = {
        "figure": "Fig. 8, A1 to A4",
        "statement": "at large angles it reduces P of the crossed areas clearly, but not to that of A0",
    }
    if not data.large.any():
        return claim | {"measured": f"needs an angle from {LARGE:g}°", "verdict": "not measured"}
    median = np.nanmedian((data.p["glc-dic"] / data.p["dic"])[data.large, 1:])
    left = np.nanmax(data.ratio["glc-dic"][data.large, 1:])
    return claim | {
        "measured": f"P of GLC-DIC over plain DIC {median:.2f} (median); still up to {left:.1f} times A0",
        **_graded([_under(median, 0.75), _over(left, 1.5)]),
    }


def _glc_a0(data: _Data) -> dict[str, Any]:
    ratio = (data.p["glc-dic"] / data.p["dic"])[:, 0]
    return {
        "figure": "Fig. 8, A0",
        "statement": "in A0 the grey-level correction lowers P slightly",
        "measured": f"P of GLC-DIC over plain DIC: {_per_angle(data.angles, ratio)}",
        **_graded([_under(np.median(ratio), 1)]),
    }


def _unweighted(data: _Data) -> dict[str, Any]:
    median = float(np.nanmedian(data.p["midic-unweighted"] / data.p["dic"]))
    noise = 1 / np.sqrt(len(data.scene.names))
    left = np.nanmax(data.ratio["midic-unweighted"])
    return {
        "figure": "Fig. 13",
        "statement": "all lights without weights are only slightly better than one",
        "measured": f"P over plain DIC {median:.2f} (median of areas and angles; noise alone: {noise:.2f}); still up "
        f"to {left:.1f} times that of A0",
        **_graded([_over(median, 0.9 * noise), _under(median, 1.05), _over(left, 2)]),
    }


def _threshold(data: _Data) -> dict[str, Any]:
    claim = {
        "figure": "Fig. 14",
        "statement": "at 0.33° the corrupted zone has a radius of 165 px, the grey level on its contour is 69 %",
    }
    used = data.scene.threshold
    if used is None:
        return claim | {"measured": "no corrupted zone at any angle", "verdict": "not reproduced"}
    each = "; ".join(
        f"{angle:g}°: {found.zone.radius:.0f} px, {found.contour:.0%} (P {found.zone.contrast:.1f} times)"
        for angle, found in data.scene.thresholds.items()
    )
    return claim | {
        "measured": f"{each}; used: {used.value:.0%}, of {data.scene.chosen:g}°",
        **_graded([0], [_over(used.zone.radius, 110), _under(used.zone.radius, 250)]),
        "reason": "The level is a matter of exposure and coding: here the brightest pixel of a linear image fills the "
        "range, and white paint without reflection comes to less than half of it; 69 % of a gamma-coded picture would "
        "be 43 to 48 % of a linear one. The angle is the smallest at which the reflection stands out clearly; earlier "
        "contours are those of noise.",
    }


def _overlap(data: _Data) -> dict[str, Any]:
    inside = data.scene.bench.region.mask
    weights = {angle: shot.weights[:, inside] for angle, shot in data.scene.snapshots.items()}
    worst = max(float((weight.max(axis=0) == 0).mean()) for weight in weights.values())
    excluded = [" ".join(f"{1 - light.mean():.0%}" for light in weight) for weight in weights.values()]
    angles = ", ".join(f"{angle:g}°" for angle in weights)
    return {
        "figure": "Fig. 16",
        "statement": "the excluded zones of the lights do not overlap",
        "measured": f"pixels without any light: {worst:.2%}; excluded per light at {angles}: {'; '.join(excluded)}",
        **_graded([_under(worst, 0.002)], [_under(worst, 0.05)]),
        "reason": "The threshold that this paint needs lies so near to the diffuse level that the masks reach far "
        "beyond the reflections.",
    }


def _trend(data: _Data) -> dict[str, Any]:
    ratio, plain = data.ratio["midic"][:, 1:], data.ratio["dic"][:, 1:]
    follows = ratio <= TREND
    text = (
        f"{follows.mean():.0%} of areas and angles at most {TREND} times A0, median {np.nanmedian(ratio):.2f}, largest "
    )
    text += f"{np.nanmax(ratio):.2f} (plain DIC: {np.nanmedian(plain):.2f}, {np.nanmax(plain):.1f})"
    above = [f"A{a + 1} at {data.angles[row]:g}° {ratio[row, a]:.2f}" for row, a in np.argwhere(ratio > TREND)]
    text += f"; above: {', '.join(above)}" if above else ""
    return {
        "figure": "Fig. 17",
        "statement": f"with weights every area follows the trend of A0 (at most {TREND} times, wherever a light sees "
        "the surface)",
        "measured": text,
        **_graded([_at_least(follows, 1)], [_at_least(follows, 0.75)]),
        "reason": "Where a light is excluded fewer are left than in A0, which costs noise: the square root of 2 where "
        "one of two equal lights is left, more where it is the darker one. P over the eight elements of an area "
        "scatters by a quarter. And a binary mask lets pass the skirt of the reflection just below the threshold.",
    }


def _as_one_light(data: _Data) -> dict[str, Any]:
    ratio = data.p["midic"][:, 1:] / data.p["dic"][:, :1]
    fraction = float((ratio <= TREND).mean())
    return {
        "figure": "Fig. 17",
        "statement": "where masks are used P is similar to that of one light in an area without reflection (A0 on "
        "Fig. 7)",
        "measured": f"{fraction:.0%} of areas and angles at most {TREND} times, median {np.nanmedian(ratio):.2f}, "
        f"largest {np.nanmax(ratio):.2f}",
        **_graded([_at_least(ratio <= TREND, 0.95)], [_at_least(ratio <= TREND, 0.75)]),
        "reason": "As for the trend.",
    }


def _frontier(data: _Data) -> dict[str, Any]:
    claim = {
        "figure": "Sec. 3.2",
        "statement": "no band of high uncertainty along the frontiers of the masks (here all lights share one point of "
        "view)",
    }
    ratio = data.scene.series("midic", "frontier")[data.moved]
    known = ratio[np.isfinite(ratio)]
    if not known.size:
        return claim | {"measured": "no frontier in the measured square", "verdict": "not measured"}
    median = np.median(known)
    return claim | {
        "measured": f"P along the frontier over P beside it: median {median:.2f}, {known.min():.2f} to "
        f"{known.max():.2f}",
        **_graded([_under(median, 1.2)], [_under(median, 1.5)]),
        "reason": "Just outside a mask lies the brightest part of the reflection that the threshold lets pass; at 0°, "
        "where only noise is left, the frontier does not show.",
    }


def _per_angle(angles: np.ndarray, values: np.ndarray) -> str:
    return ", ".join(f"{value:.2f} at {angle:g}°" for angle, value in zip(angles, values, strict=True))


_ON_EVERY_SCENE = (_factor, _glc_small, _glc_large, _unweighted, _threshold, _overlap, _trend, _as_one_light, _frontier)
_ON_THE_PAPERS_SCENE = (
    _displacement_of_reflection,
    _residual,
    _linear_mean,
    _unaffected,
    _at_once,
    _only_then,
    _glc_a0,
)


def _specimen(study: PaperStudy) -> list[Claim]:
    """Figs 9 to 11: goniometry and topography."""
    turning, relief = study.goniometry, study.topography
    first, last = turning.band
    range_um = float(np.nanpercentile(relief.height, 99.9) - np.nanpercentile(relief.height, 0.1))
    white = (relief.intensity > np.median(relief.intensity)) & np.isfinite(relief.height)
    step = float(relief.height[~white].mean() - relief.height[white].mean())
    steepest = float(np.nanpercentile(relief.slope, 99.9))
    peak = int(np.argmin(abs(turning.angles_deg - turning.lobe.centre_deg)))
    return [
        Claim(
            "Fig. 9",
            "",
            "diffuse above 30°, none at 90°, two bundles (white, black); a reflection from 0 to 30°, largest at 15°",
            f"erratic from {first:.0f} to {last:.0f}°; lobe at {turning.lobe.centre_deg:.1f} ± "
            f"{turning.lobe.std[2]:.1f}°, standard deviation {turning.lobe.width_deg:.1f} ± "
            f"{turning.lobe.std[3]:.1f}°, {turning.is_white.sum()} white and {(~turning.is_white).sum()} black pixels",
            **_graded(
                [_under(abs(first), 10), _under(abs(last - 30), 10), _under(abs(turning.lobe.centre_deg - 15), 2)]
            ),
        ),
        Claim(
            "Fig. 9",
            "",
            "the single pixels are very noisy in the reflection",
            f"pixels of one paint differ by {turning.spread[peak] / turning.lobe.specular:.0%} of the lobe's height",
            "in part",
            "They differ from each other, but each follows a smooth curve: a pixel holds some five wrinkles, each with "
            "a lobe of 4°. Facets that are much sharper would make the single curves noisy.",
        ),
        Claim(
            "Fig. 10",
            "",
            "heights follow the droplets and vary by less than 10 um",
            f"range {range_um:.1f} um, black paint {step:.1f} um above white",
            **_graded([_under(range_um, 10), _over(step, 0.5)]),
        ),
        Claim(
            "Fig. 11",
            "",
            "wrinkles about 25 um apart, below the pixel of 55 um",
            f"{relief.spacing[0]:.1f} ± {relief.spacing[1]:.1f} um",
            **_graded([_under(abs(relief.spacing[0] - 25), 3)]),
        ),
        Claim(
            "Fig. 11",
            "",
            "slopes up to 15°, with an uncertainty of 0.23° for heights good to 0.1 um",
            f"99.9th percentile {steepest:.1f}° (rms {relief.white_deg:.1f}° on white, "
            f"{relief.black_deg:.1f}° on black); uncertainty {relief.slope_std:.2f}°",
            "in part",
            f"The paint has 6° rms and 15° at its steepest; central differences at a pitch of {relief.pitch:g} um show "
            "three quarters of the slope of waves 25 um long, so that slopes read from such a map, the paper's "
            "included, are too small. The uncertainty of a central difference is 0.1 um / (sqrt(2) 5 um) = 0.81°; "
            "0.23° is that of 0.1 um over 25 um.",
        ),
    ]


def _noise(study: PaperStudy) -> Claim:
    """Section 4: what a second pair of images does to the noise."""
    noise = study.noise
    ratios = noise.single / noise.together
    mean = np.sqrt((ratios**2).mean())
    return Claim(
        figure="Sec. 4",
        scene="sequential",
        statement="k = 2 pairs divide the noise by the square root of 2",
        measured=f"one lamp {' and '.join(f'{s:.4f}' for s in noise.single)} px, both {noise.together:.4f} px: "
        f"{' and '.join(f'{r:.2f}' for r in ratios)} times less, {mean:.2f} on average; "
        f"the best combination would give {noise.expected:.4f} px",
        **_graded([_under(abs(mean - np.sqrt(2)), 0.2)]),
    )
