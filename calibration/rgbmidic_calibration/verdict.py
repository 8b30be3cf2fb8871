"""The sub-command `check`: the verdict on a calibration file, from captures that were not used to make it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.illumination.calibration import Calibration
from rgbmidic_calibration.captures import Captures, stack_frames
from rgbmidic_calibration.ratio import block_means
from rgbmidic_calibration.verify import (
    Additivity,
    CheckItem,
    Limits,
    additivity,
    leakage,
    noise_ratio,
    registration_left,
)

__all__ = ["Verdict", "check_calibration", "read_limits"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Result of `check_calibration`: lines with limits, sums of lights, what was not checked, warnings."""

    items: tuple[CheckItem, ...]
    sums: tuple[Additivity, ...]
    skipped: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Every line keeps its limit."""
        return all(item.passed for item in self.items)


def check_calibration(
    calibration: Calibration,
    captures: Captures,
    *,
    limits: Limits | None = None,
    region: Sequence[float] | None = None,
) -> Verdict:
    """Check a calibration on captures that were not used to make it.

    Parameters
    ----------
    calibration
        The calibration under test.
    captures
        Found with the calibration, which fills in what neither the files nor the user states (`Captures.find`).
    limits
        What may be left.
    region
        Rectangle of the speckled target for the registration, px.

    Raises
    ------
    CalibrationError
        The calibration has no crosstalk, or captures cannot be compared with it.
    """
    limits = limits or Limits()
    if not captures.lights:
        raise ConfigurationError("check needs captures with one light on: --light NAME=FILES")
    calibration = calibration.cropped(None, next(iter(captures.lights.values())).series.shape)
    if calibration.crosstalk is None:
        raise CalibrationError("the calibration has no crosstalk to check; make it with rgbmidic-calibrate crosstalk")
    warnings, skipped = _reused(calibration, captures), []
    stacks, dark = captures.stacks()
    means = {name: [block_means(frame) for frame in files.frames()] for name, files in captures.lights.items()}
    dark_means = [block_means(frame) for frame in captures.dark.frames()] if captures.dark else []
    items = leakage(calibration.crosstalk, means, dark_means).items(limits.leakage)
    sums = []
    for names, files in captures.together.items():
        together = stack_frames(files.frames(), name=files.role)
        singles = {name: stacks[name] for name in names.split("+")}
        sums.append(additivity(together, singles, dark, noise=calibration.noise))
    items += [item for total in sums for item in total.items(limits)]

    def noise() -> list[CheckItem]:
        if calibration.noise is None:
            raise CalibrationError("the calibration has no noise section")
        ratios = {name: noise_ratio(stack, calibration.noise) for name, stack in stacks.items()}
        return [
            CheckItem(f"noise of {name} against prediction", 100 * (ratio - 1), 100 * std, limits.noise, "%")
            for name, (ratio, std) in ratios.items()
        ]

    def registration() -> list[CheckItem]:
        if calibration.registration is None:
            raise CalibrationError("the calibration has no registration section")
        left = registration_left(calibration.registration, stacks, dark, region=region)
        limit = limits.registration
        return [CheckItem(f"registration of {name}", value, std, limit, "px") for name, value, std in left]

    for check in (noise, registration):
        try:
            items += check()
        except CalibrationError as error:
            skipped.append(f"{check.__name__} was not checked: {error}")
    if dark is None:
        warnings.append("no dark frames: the stated black level is taken for the dark level")
    if not captures.together:
        skipped.append("additivity was not checked: no captures with lights together (--together)")
    return Verdict(items=tuple(items), sums=tuple(sums), skipped=tuple(skipped), warnings=tuple(warnings))


def read_limits(options: Sequence[str]) -> Limits:
    """Limits from options of the form NAME=VALUE.

    Raises
    ------
    ConfigurationError
        An unknown name, or a value that is not a positive number.
    """
    limits, names = Limits(), [entry.name for entry in fields(Limits)]
    for text in options:
        name, _, value = text.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = -1.0
        if name not in names or not number > 0:
            raise ConfigurationError(
                f"--limit takes NAME=VALUE with a positive value and one of the names {', '.join(names)}, not {text!r}"
            )
        limits = replace(limits, **{name: number})
    return limits


def _reused(calibration: Calibration, captures: Captures) -> list[str]:
    known = {
        entry.get("sha256")
        for origin in calibration.provenance.values()
        if isinstance(origin, Mapping)
        for entry in origin.get("inputs", ())
    }
    groups = (*captures.lights.values(), *captures.together.values())
    reused = [path for group in groups for path, fingerprint in group.fingerprints.items() if fingerprint in known]
    if not reused:
        return []
    made = f"{len(reused)} of these captures made the calibration ({reused[0]} ...)"
    return [f"{made}: they always agree; a check needs others"]
