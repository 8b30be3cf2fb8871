"""Real captures under three narrow bands, one at a time, and single shots of all three made of them.

The captures are those of tests/data/real_disks_three_bands; how shots, offsets and noise are made is in
tests/real_disks.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import real_disks as disks

from . import ROOT
from .tables import table

FOLDER = ROOT / "tests" / "data" / "real_disks_three_bands"
RATIOS = ((1.0, 1.0, 1.0), (1.0, 1.0, 4.0), (1.0, 1.0, 10.0), (4.0, 1.0, 1.0), (10.0, 1.0, 1.0), (1.0, 10.0, 1.0))
"""Strengths of red, green and blue on white, each in the channel that sees it best."""
METHODS = {"default": "auto", "Malvar": "malvar", "normalised mosaic": "normalised"}
SEEDS = (0, 1, 2)
PHASES = {"changes": True, "stays": False}
"""Whether a step of the offset is odd."""


@table("real_captures", page="explanation/real-captures", cost=60, keys=3, own_quick=True)
def real_captures(quick: bool) -> Iterator[dict[str, object]]:
    """Error at the nodes of a print at rest that crops show moved by whole pixels (elements of 80 px), and rms error of
    the images of red and blue where they are not sampled, by the strengths of 650 : 550 : 450 nm."""
    bands, calibration = disks.Bands.read(FOLDER), disks.calibrate(FOLDER)
    without_noise = replace(calibration, noise=None)
    cases = [(ratio, "calibrated", calibration) for ratio in RATIOS]
    cases += [(ratio, "not calibrated", without_noise) for ratio in RATIOS[1:3]]
    offsets = ((1, 0), (2, 0)) if quick else disks.OFFSETS
    for ratio, noise, known in cases[:1] if quick else cases:
        found = {
            method: [
                disks.errors(bands, known, ratio, key, offsets=offsets, seed=seed)
                for seed in (SEEDS[:1] if quick else SEEDS)
            ]
            for method, key in METHODS.items()
        }
        images = {
            f"images by {method} [%]": 100 * disks.image_error(bands, known, ratio, key)
            for method, key in METHODS.items()
        }
        for phase, odd in PHASES.items():
            row: dict[str, object] = {
                "strengths": " : ".join(f"{part:g}" for part in ratio),
                "noise": noise,
                "Bayer phase": phase,
            }
            each = {
                method: disks.Error.together(
                    [error for run in runs for offset, error in run.items() if any(step % 2 for step in offset) == odd]
                )
                for method, runs in found.items()
            }
            row |= {f"{method} [px]": error.rms for method, error in each.items()}
            row |= {f"{method}: error/stated": each[method].ratio for method in ("default", "Malvar")}
            yield row | images


@table("real_bands", page="explanation/real-captures", cost=2)
def real_bands(quick: bool) -> Iterator[dict[str, object]]:
    """The same captures as `rgbmidic-calibrate crosstalk` and `registration` see them: crosstalk, difference of the two
    greens over their mean, and shift of the band's image in the middle of the crop against that of 650 nm."""
    calibration = disks.calibrate(FOLDER)
    crosstalk, registration = calibration.crosstalk, calibration.registration
    assert crosstalk is not None
    assert registration is not None
    assert crosstalk.green_difference is not None
    for band, (light, nm) in enumerate(zip(crosstalk.lights, (650, 550, 450), strict=True)):
        red, green, blue = crosstalk.matrix[:, band]
        x, y = registration.displacement(np.array([registration.centre]))[band, 0]
        yield {
            "band": f"{nm} nm ({light})",
            "R": float(red),
            "G": float(green),
            "B": float(blue),
            "greens apart [%]": 100 * float(crosstalk.green_difference[band] / green),
            "shift along x [px]": float(x),
            "shift along y [px]": float(y),
            "scale [1e-3]": 1e3 * float(registration.parameters[band, 3]),
        }
