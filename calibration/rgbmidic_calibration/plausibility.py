"""Plausibility of the captures of a crosstalk, before anything is fitted.

A check that fails is an error, unless it is waived by name; what is merely worth knowing is a warning. Limits without a
source are chosen.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

import numpy as np

from rgbmidic.errors import CalibrationError
from rgbmidic.illumination.checks import Check, refused, reported, warning
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.captures import BlockMeans

CHECKS = ("name", "same-channel", "ambient", "greens", "weak", "captures", "dark-frames", "white-level")
"""Checks that can be waived: a light named red, green or blue is seen best by the channel of that colour; no two lights
are seen best by the same channel; the dark frames are dark; the two green planes of the mosaic agree; every light gives
enough signal; the captures of one light agree in colour; the dark frames agree with each other; no samples pile up
below the white level."""


def collect_warnings(checks: Iterable[Check], allow: Collection[str] = ()) -> list[str]:
    """Return the warnings that checks give rise to, those among them that fail and are waived.

    Raises
    ------
    CalibrationError
        One fails that `allow` does not name.
    """
    reported_checks = reported(checks)
    if refused_checks := refused(reported_checks, allow):
        raise CalibrationError(f"{refused_checks[0].text} (`allow` {refused_checks[0].name} goes on all the same)")
    return [check.text for check in reported_checks]


def capture_checks(lights: Mapping[str, Sequence[BlockMeans]], dark: Sequence[BlockMeans]) -> Iterator[Check]:
    """Check the captures of the lights and the dark frames.

    Raises
    ------
    CalibrationError
        There are none, they are of different cameras, or all saturated.
    """
    if not lights:
        raise CalibrationError("no light is given: state each in `lights`")
    if len(lights) > 3:
        raise CalibrationError(f"a camera with three channels separates at most three lights, not {len(lights)}")
    for name in [name for name, captures in lights.items() if not captures]:
        raise CalibrationError(f"light {name} has no captures")

    labels: dict[str, list[str]] = {}
    first = next(iter(lights.values()))[0].camera
    for name, captures in {**lights, "dark": dark}.items():
        group_name = "the dark frames" if name == "dark" else f"light {name}"
        files = [f" ({frame.name})" if frame.name else "" for frame in captures]
        labels[name] = [f"capture {index} of {group_name}{file}" for index, file in enumerate(files, start=1)]
        for frame, label in zip(captures, labels[name], strict=True):
            if frame.camera != first:
                raise CalibrationError(
                    f"{label} is {frame.camera}, the first capture is {first}: all captures must come from the same "
                    "camera with the same settings"
                )
    yield from _dark_checks(lights, dark, labels["dark"])
    level = np.mean([frame.channels for frame in dark], axis=0) if dark else np.float64(0)
    for name, captures in lights.items():
        signals = [frame.channels - level for frame in captures]
        yield from _signal_checks(name, captures, signals)
        if len(captures) > 1:
            yield from _agreement_checks(captures, signals, labels[name])


def _dark_checks(
    lights: Mapping[str, Sequence[BlockMeans]], dark: Sequence[BlockMeans], labels: Sequence[str]
) -> Iterator[Check]:
    if not dark:
        text = "no dark frames: the stated black level is taken for the dark level, and any ambient light goes unseen"
        yield warning(text)
        return
    scale = dark[0].camera.full_scale
    leakage = 0.005 * scale  # of the order of what `check` allows (`verify.Limits.leakage`)
    means = np.array([frame.channels.mean(axis=(1, 2)) for frame in dark])
    median = np.median(means, axis=0)
    level = float(median.max())
    for label, mean in zip(labels, means, strict=True):
        text = (
            f"{label} is {mean.max():.1f} DN above the black level, the median of the dark frames {level:.1f} DN: was "
            "a lamp on, or did daylight change?"
        )
        yield Check("dark-frames", text, np.abs(mean - median).max(), leakage)
    sums = [np.mean([f.channels.mean(axis=(1, 2)) for f in captures], axis=0).max() for captures in lights.values()]
    weakest = max(0.0, float(min(sums)))
    text = (
        f"the dark frames are not dark: {level:.1f} DN above the black level, where the weakest light with its "
        f"surroundings gives {weakest:.1f} DN: was a lamp on, or does daylight reach the target?"
    )
    ambient = Check("ambient", text, max(level, 0.0), min(0.05 * scale, max(leakage, 0.1 * weakest)))
    yield ambient
    if ambient.passed:
        text = (
            f"the dark frames are {median[np.abs(median).argmax()]:+.1f} DN from the stated black level: right only if "
            "the same ambient light holds in all captures and in the test; without ambient light state this black level"
        )
        yield warning(text, np.abs(median).max(), above=min(leakage, 2.0))


def _signal_checks(name: str, captures: Sequence[BlockMeans], signals: Sequence[FloatArray]) -> Iterator[Check]:
    clear = [~frame.saturated for frame in captures]
    clipped = 1 - float(np.mean(clear))
    if np.sum(clear) < 9 * len(captures):  # as many blocks as the smallest frame has, 3 x 3 (`block_means`)
        raise CalibrationError(
            f"light {name}: {100 * clipped:.0f} % of the blocks hold saturated samples; shorten the exposure until "
            "none does"
        )
    for pile_level in [frame.pile_level for frame in captures if frame.pile_level is not None][:1]:
        text = (
            f"light {name}: samples pile up at {pile_level:.0f} DN, below the stated white level: the camera saturates "
            f"there; state `white_level` {pile_level:.0f}"
        )
        yield Check("white-level", text)
    scale = captures[0].camera.full_scale
    strength = float(np.mean([signal.mean(axis=(1, 2)) for signal in signals], axis=0).max())
    text = (
        f"light {name} gives {strength:.1f} DN above dark, {100 * strength / scale:.1f} % of the full scale: was "
        "the lamp on? 30 to 70 % is best"
    )
    yield Check("weak", text, scale / max(strength, 1e-9), limit=100, doubtful=10)
    text = f"light {name}: {100 * clipped:.0f} % of the blocks hold saturated samples and are left out"
    yield warning(text, clipped, above=0.2)
    if len(captures[0].planes) < 4:
        return
    # with the right pattern the greens differ by their filters only, with a wrong one they are two colours
    brightest = np.mean([signal[:, c].mean(axis=1).max() for signal, c in zip(signals, clear, strict=True)])
    gap = np.mean([(f.planes[1] - f.planes[2])[c].mean() for f, c in zip(captures, clear, strict=True)])
    difference = float(np.nan_to_num(gap / max(brightest, 1e-9)))
    text = (
        f"light {name}: the two green planes differ by {100 * abs(difference):.1f} % of the strongest channel: is the "
        "colour filter array (`cfa`) right?"
    )
    yield Check("greens", text, difference, limit=0.08, doubtful=0.03)


def _agreement_checks(
    captures: Sequence[BlockMeans], signals: Sequence[FloatArray], labels: Sequence[str]
) -> Iterator[Check]:
    clear = np.all([~frame.saturated for frame in captures], axis=0)
    clear = clear if clear.any() else np.ones_like(clear)
    sums = np.array([signal[:, clear].sum(axis=1) for signal in signals])
    colour = sums / np.maximum(sums.max(axis=1), 1e-9)[:, None]
    departure = np.abs(colour - np.median(colour, axis=0)).max(axis=1)
    for label, value in zip(labels, departure, strict=True):
        text = (
            f"{label} has another colour than the others (a channel departs by {100 * value:.1f} % of the strongest): "
            "another lamp, daylight, or a file of another light"
        )
        yield Check("captures", text, value, limit=0.02)
    detail = np.array([frame.detail for frame in captures])
    typical = float(np.median(detail))
    for label, lost in zip(labels, 1 - detail / typical if typical > 0 else 0 * detail, strict=True):
        text = (
            f"{label} is less sharp than the others: out of focus, or moved? The matrix does not suffer, a "
            "registration would"
        )
        yield warning(text, max(lost, 0.0), above=0.4)
