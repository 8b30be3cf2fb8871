"""The paper's statements on the flat specimen and on noise, against what the virtual experiment measures."""

from __future__ import annotations

import numpy as np

from rgbmidic.lab.study.claim import Claim, Verdict, verdict
from rgbmidic.lab.study.results import PaperStudy

__all__ = ["judge_noise", "judge_specimen"]


def judge_specimen(study: PaperStudy) -> list[Claim]:
    """Figs 9 to 11: goniometry and topography."""
    turning, relief = study.goniometry, study.topography
    first, last = turning.band
    range_um = float(np.nanpercentile(relief.height, 99.9) - np.nanpercentile(relief.height, 0.1))
    white = (relief.intensity > np.median(relief.intensity)) & np.isfinite(relief.height)
    step = float(relief.height[~white].mean() - relief.height[white].mean())
    steepest = float(np.nanpercentile(relief.slope, 99.9))
    peak = int(np.argmin(abs(turning.angles_deg - turning.lobe.centre_deg)))
    return [
        _plate(
            "Fig. 9",
            "diffuse above 30°, none at 90°, two bundles (white, black); a reflection from 0 to 30°, largest at 15°",
            f"erratic from {first:.0f} to {last:.0f}°; lobe at {turning.lobe.centre_deg:.1f} ± "
            f"{turning.lobe.std[2]:.1f}°, standard deviation {turning.lobe.width_deg:.1f} ± "
            f"{turning.lobe.std[3]:.1f}°, {turning.white.sum()} white and {(~turning.white).sum()} black pixels",
            verdict(-10 <= first <= 10 and 20 <= last <= 40 and abs(turning.lobe.centre_deg - 15) < 2),
        ),
        _plate(
            "Fig. 9",
            "the single pixels are very noisy in the reflection",
            f"pixels of one paint differ by {turning.spread[peak] / turning.lobe.specular:.0%} of the lobe's height",
            "in part",
            "They differ from each other, but each follows a smooth curve: a pixel holds some five wrinkles, each with "
            "a lobe of 4°. Facets that are much sharper would make the single curves noisy.",
        ),
        _plate(
            "Fig. 10",
            "heights follow the droplets and vary by less than 10 um",
            f"range {range_um:.1f} um, black paint {step:.1f} um above white",
            verdict(range_um < 10 and step > 0.5),
        ),
        _plate(
            "Fig. 11",
            "wrinkles about 25 um apart, below the pixel of 55 um",
            f"{relief.spacing[0]:.1f} ± {relief.spacing[1]:.1f} um",
            verdict(abs(relief.spacing[0] - 25) < 3),
        ),
        _plate(
            "Fig. 11",
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


def judge_noise(study: PaperStudy) -> Claim:
    """Section 4: what a second pair of images does to the noise."""
    noise = study.noise
    ratios = noise.single / noise.together
    return Claim(
        figure="Sec. 4",
        scene="sequential",
        statement="k = 2 pairs divide the noise by the square root of 2",
        measured=f"one lamp {' and '.join(f'{s:.4f}' for s in noise.single)} px, both {noise.together:.4f} px: "
        f"{' and '.join(f'{r:.2f}' for r in ratios)} times less, {np.sqrt((ratios**2).mean()):.2f} on average; "
        f"the best combination would give {noise.expected:.4f} px",
        verdict=verdict(bool(abs(np.sqrt((ratios**2).mean()) - np.sqrt(2)) < 0.2)),
    )


def _plate(figure: str, statement: str, measured: str, verdict: Verdict, reason: str = "") -> Claim:
    reason = "" if verdict == "reproduced" else reason
    return Claim(figure=figure, scene="", statement=statement, measured=measured, verdict=verdict, reason=reason)
