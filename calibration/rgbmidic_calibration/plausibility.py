"""Plausibility of the captures before anything is fitted, and the fixed pattern and defects of the sensor.

A check that fails is an error, unless it is waived by name; what is merely worth knowing is a warning. The fixed
pattern (DSNU, PRNU) and hot and dead pixels follow EMVA standard 1288, sections 4 and 8.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from rgbmidic.errors import CalibrationError
from rgbmidic.illumination.linear import Quantity
from rgbmidic.typing import BoolArray, FloatArray
from rgbmidic_calibration.captures import TemporalStack
from rgbmidic_calibration.ratio import BlockMeans

CHECKS = {
    "name": "a light named red, green or blue is seen best by the channel of that colour",
    "same-channel": "no two lights are seen best by the same channel",
    "ambient": "the dark frames are dark",
    "greens": "the two green planes of the mosaic agree",
    "weak": "every light gives enough signal",
    "captures": "the captures of one light agree in colour",
    "dark-frames": "the dark frames agree with each other",
    "white-level": "no samples pile up below the white level",
}

DARK_FRACTION_LIMIT = 0.10
"""Dark frames brighter than this fraction of the weakest light's own signal are not dark."""
DARK_SCALE_LIMIT = 0.05
"""Dark frames brighter than this fraction of the full scale are not dark."""
DARK_WARNING = 0.005
"""Fraction of the full scale by which dark frames may differ from each other, or from black: chosen; as leakage, it is
of the order of what `check` allows (`rgbmidic_calibration.verify.Limits.leakage`)."""
DARK_LEVEL_WARNING = 2.0
"""Departure (DN) of the dark frames from the stated black level that the user should know of."""
GREENS_LIMIT, GREENS_WARNING = 0.08, 0.03
"""Difference of the two green planes over the strongest channel. Chosen: with the right pattern the greens differ by
their filters only, with a wrong one they are two colours."""
WEAK_LIMIT, WEAK_WARNING = 0.01, 0.10
"""Signal over full scale: chosen; 30 to 70 % is advised (calibration/README.md)."""
COLOUR_LIMIT = 0.02
"""A capture whose entry departs by more than this from the median of its light is another picture."""
DETAIL_LIMIT = 0.6
"""Detail of a capture over the median of its light: chosen; it decides on a warning only."""


def check_captures(
    lights: Mapping[str, Sequence[BlockMeans]],
    dark: Sequence[BlockMeans],
    *,
    allow: Sequence[str],
    labels: Mapping[str, Sequence[str]],
) -> list[str]:
    """Check the captures before anything is fitted.

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    CalibrationError
        A check that is not waived by `allow` fails.
    """
    if not lights:
        raise CalibrationError("no light is given: state each with --light NAME=FILES")
    if len(lights) > 3:
        raise CalibrationError(f"a camera with three channels separates at most three lights, not {len(lights)}")
    for name, captures in lights.items():
        if not captures:
            raise CalibrationError(f"light {name} has no captures")
    checks = _Checks(allow, labels)
    checks.sizes({**lights, "dark": dark})
    checks.dark(lights, dark)
    level = np.mean([frame.channels for frame in dark], axis=0) if dark else np.float64(0)
    for name, captures in lights.items():
        signals = [frame.channels - level for frame in captures]
        checks.signal(name, captures, signals)
        if len(captures[0].names) > 3:
            checks.greens(name, captures, signals)
        if len(captures) > 1:
            checks.agreement(name, captures, signals)
    return checks.warnings


class _Checks:
    """The checks and the warnings found so far; `signals` are block averages (3, R, S) above dark of each capture."""

    def __init__(self, allow: Sequence[str], labels: Mapping[str, Sequence[str]]) -> None:
        self.allow, self.labels, self.warnings = allow, labels, list[str]()

    def fail(self, check: str, message: str) -> None:
        if check not in self.allow:
            raise CalibrationError(f"{message} (--allow {check} goes on all the same)")
        self.warnings.append(message)

    def label(self, name: str, index: int) -> str:
        named = self.labels.get(name, ())
        file = f" ({named[index]})" if index < len(named) else ""
        return f"capture {index + 1} of {'the dark frames' if name == 'dark' else 'light ' + name}{file}"

    def sizes(self, groups: Mapping[str, Sequence[BlockMeans]]) -> None:
        first = next(iter(groups.values()))[0]
        for name, captures in groups.items():
            for index, frame in enumerate(captures):
                if frame.shape != first.shape or frame.names != first.names:
                    sizes = [f"{f.shape[1]} x {f.shape[0]} px with planes {' '.join(f.names)}" for f in (frame, first)]
                    raise CalibrationError(
                        f"{self.label(name, index)} is {sizes[0]}, the first capture is {sizes[1]}: "
                        "all captures must come from the same camera with the same settings"
                    )
                if frame.full_scale != first.full_scale:
                    raise CalibrationError(
                        f"{self.label(name, index)} has a range of {frame.full_scale:g} DN from black to white level, "
                        f"the first capture {first.full_scale:g} DN"
                    )

    def dark(self, lights: Mapping[str, Sequence[BlockMeans]], dark: Sequence[BlockMeans]) -> None:
        if not dark:
            self.warnings.append(
                "no dark frames: the stated black level is taken for the dark level, and any ambient light goes unseen"
            )
            return
        scale = dark[0].full_scale
        means = np.array([frame.channels.mean(axis=(1, 2)) for frame in dark])
        median = np.median(means, axis=0)
        for index, mean in enumerate(means):
            if np.abs(mean - median).max() > DARK_WARNING * scale:
                self.fail(
                    "dark-frames",
                    f"{self.label('dark', index)} is {mean.max():.1f} DN above the black level, the median of the dark "
                    f"frames {median.max():.1f} DN: was a lamp on, or did daylight change?",
                )
        weakest = min(
            max(0.0, float(np.mean([f.channels.mean(axis=(1, 2)) for f in captures], axis=0).max()))
            for captures in lights.values()
        )
        level = float(median.max())
        if level > DARK_SCALE_LIMIT * scale or level > max(DARK_WARNING * scale, DARK_FRACTION_LIMIT * weakest):
            self.fail(
                "ambient",
                f"the dark frames are not dark: {level:.1f} DN above the black level, where the weakest light with its "
                f"surroundings gives {weakest:.1f} DN: was a lamp on, or does daylight reach the target?",
            )
        elif np.abs(median).max() > min(DARK_WARNING * scale, DARK_LEVEL_WARNING):
            self.warnings.append(
                f"the dark frames are {median[np.abs(median).argmax()]:+.1f} DN from the stated black level: right "
                "only if the same ambient light holds in all captures and in the test; without ambient light state "
                "this black level"
            )

    def signal(self, name: str, captures: Sequence[BlockMeans], signals: Sequence[FloatArray]) -> None:
        clipped = float(np.mean([frame.saturated.mean() for frame in captures]))
        if clipped == 1:
            raise CalibrationError(
                f"light {name}: every block of every capture holds saturated samples; "
                "shorten the exposure until none does"
            )
        if (piled := next((frame.piled_at for frame in captures if frame.piled_at is not None), None)) is not None:
            self.fail(
                "white-level",
                f"light {name}: samples pile up at {piled:.0f} DN, below the stated white level: the camera saturates "
                f"there; state --white-level {piled:.0f}",
            )
        scale = captures[0].full_scale
        strength = float(np.mean([signal.mean(axis=(1, 2)) for signal in signals], axis=0).max())
        message = (
            f"light {name} gives {strength:.1f} DN above dark, {100 * strength / scale:.1f} % of the full scale: was "
            "the lamp on? 30 to 70 % is best"
        )
        if strength < WEAK_LIMIT * scale:
            self.fail("weak", message)
        elif strength < WEAK_WARNING * scale:
            self.warnings.append(message)
        if clipped > 0.2:
            self.warnings.append(
                f"light {name}: {100 * clipped:.0f} % of the blocks hold saturated samples and are left out"
            )

    def greens(self, name: str, captures: Sequence[BlockMeans], signals: Sequence[FloatArray]) -> None:
        clear = [~frame.saturated for frame in captures]
        brightest = np.mean([signal[:, c].mean(axis=1).max() for signal, c in zip(signals, clear, strict=True)])
        gap = np.mean([(f.planes[1] - f.planes[2])[c].mean() for f, c in zip(captures, clear, strict=True)])
        difference = abs(float(gap / max(brightest, 1e-9)))
        message = (
            f"light {name}: the two green planes differ by {100 * difference:.1f} % of the strongest channel: "
            "is the colour filter array (--cfa) right?"
        )
        if difference > GREENS_LIMIT:
            self.fail("greens", message)
        elif difference > GREENS_WARNING:
            self.warnings.append(message)

    def agreement(self, name: str, captures: Sequence[BlockMeans], signals: Sequence[FloatArray]) -> None:
        clear = np.all([~frame.saturated for frame in captures], axis=0)
        clear = clear if clear.any() else np.ones_like(clear)
        sums = np.array([signal[:, clear].sum(axis=1) for signal in signals])
        colour = sums / np.maximum(sums.max(axis=1), 1e-9)[:, None]
        departure = np.abs(colour - np.median(colour, axis=0)).max(axis=1)
        for index in np.flatnonzero(departure > COLOUR_LIMIT).tolist():
            self.fail(
                "captures",
                f"{self.label(name, index)} has another colour than the others (a channel departs by "
                f"{100 * departure[index]:.1f} % of the strongest): another lamp, daylight, or a file of another light",
            )
        detail = np.array([frame.detail for frame in captures])
        self.warnings += [
            f"{self.label(name, index)} is less sharp than the others: out of focus, or moved? The "
            "matrix does not suffer, a registration would"
            for index in np.flatnonzero(detail < DETAIL_LIMIT * np.median(detail)).tolist()
        ]


WINDOW = 7
"""Side (samples of a plane) of the neighbourhood whose mean is taken out: shading and dirt are wider than this."""

HOT = 8.0
"""Robust standard deviations above the neighbourhood's median that make a pixel hot in the dark: of normal
noise one sample in 1e15 lies there; from 6 to 10 the virtual camera has no false one."""
HOT_FRACTION = 0.005
"""Fraction of the full scale by which a hot pixel exceeds its neighbourhood at least: 20 DN of 12 bit, seven times the
dark noise of the virtual camera, which has no false one from .002 to .01."""
DEAD_FRACTION = 0.5
"""Response relative to the neighbourhood's median below which a pixel is dead: half, as far
from a live pixel as from a black one; from .3 to .7 the virtual camera has no false one."""

TEXTURED = 0.05
"""Local variation of the response above which the target, not the sensor, is uneven: from .03 to .08 the
virtual camera's white card is judged alike."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedPattern:
    """DSNU in DN, PRNU in %, defects (row, column, kind) and warnings."""

    dsnu: Quantity
    prnu: Quantity
    defects: tuple[tuple[int, int, str], ...]
    warnings: tuple[str, ...] = ()


def fixed_pattern(dark: TemporalStack, flats: Sequence[TemporalStack], saturation: Quantity) -> FixedPattern:
    """Fixed pattern from the mean dark frame and the mean flat frame nearest to half of saturation.

    The variance of the temporal noise that remains in a mean over n frames, its n-th part, is taken out.
    """
    dsnu, prnu, defects, textured = [], [], [], []
    for plane, name in enumerate(dark.camera.names):
        excess = dark.mean[plane] - ndimage.median_filter(dark.mean[plane], 5)
        floor = HOT_FRACTION * (dark.camera.white - dark.camera.black[plane])
        hot = excess > max(HOT * float(np.median(np.abs(excess))) / 0.6745, floor)
        dsnu.append(_spread(dark.mean[plane], dark.variance[plane] / dark.count, ~hot))
        flat = min(flats, key=lambda f: abs(float(f.strength[:, plane].mean()) - saturation.value[plane] / 2))
        response, dead = _response(dark, flat, plane, hot)
        if response[0] > TEXTURED:
            textured.append(f"{name} {100 * response[0]:.0f} %")
            response, dead = (np.nan, np.nan), np.zeros_like(hot)
        prnu.append((100 * response[0], 100 * response[1]))
        row, column = dark.camera.origins[plane]
        defects += [
            (int(r) * dark.camera.step + row, int(c) * dark.camera.step + column, kind)
            for kind, marked in (("hot", hot), ("dead", dead & ~hot))
            for r, c in np.argwhere(marked)
        ]
    warning = (
        f"the target is textured or the lamp uneven (local variation {', '.join(textured)}): PRNU and dead pixels need "
        "a plain white target out of focus"
    )
    return FixedPattern(
        dsnu=Quantity(*np.array(dsnu).T),
        prnu=Quantity(*np.array(prnu).T),
        defects=tuple(sorted(defects)),
        warnings=(warning,) if textured else (),
    )


def _response(
    dark: TemporalStack, flat: TemporalStack, plane: int, hot: BoolArray
) -> tuple[tuple[float, float], BoolArray]:
    """Relative spread of the response with its uncertainty, NaN where it cannot be determined; dead pixels."""
    signal = flat.mean[plane] - dark.mean[plane]
    around = ndimage.median_filter(signal, 5)
    usable = ~hot & ~flat.clipped[plane]
    dead = usable & (signal < DEAD_FRACTION * around) & (around > 0.02 * (flat.camera.white - flat.camera.black[plane]))
    level = float(signal[usable].mean()) if usable.any() else 0.0
    if level < 0.02 * (flat.camera.white - flat.camera.black[plane]):
        return (np.nan, np.nan), np.zeros_like(dead)
    temporal = flat.variance[plane] / flat.count + dark.variance[plane] / dark.count
    local = np.maximum(ndimage.uniform_filter(signal, 4 * WINDOW), 1e-3 * level)
    return _spread(signal / local, temporal / local**2, usable & ~dead), dead


def _spread(
    mean: npt.NDArray[np.floating], temporal: npt.NDArray[np.floating], usable: BoolArray
) -> tuple[float, float]:
    """Spatial standard deviation about the neighbourhood's mean, temporal noise taken out, and its uncertainty."""
    filled = np.where(usable, mean, np.median(mean[usable]))
    smooth = ndimage.uniform_filter(filled, WINDOW, mode="nearest")
    inner = (slice(WINDOW, -WINDOW), slice(WINDOW, -WINDOW))
    shrink = 1 - 1 / WINDOW**2
    square = (((filled - smooth) ** 2) / shrink - temporal)[inner]
    keep = usable[inner]
    variance = float(square[keep].mean(dtype=np.float64))
    # Neighbouring residuals share their mean; the plain standard error is good within a few per cent.
    error = float(square[keep].std(dtype=np.float64)) / np.sqrt(max(int(keep.sum()), 1))
    value = np.sqrt(max(variance, 0.0))
    return float(value), float(error / (2 * value)) if variance > error else float(np.sqrt(error))
