"""The sub-command `check`: the verdict on a calibration file, from captures that were not used to make it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.settings import FrameSettings
from rgbmidic_calibration.captures import CaptureFiles, TemporalStack, stack_frames
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


@dataclass(frozen=True, slots=True)
class _Captures:
    lights: dict[str, CaptureFiles]
    together: dict[str, CaptureFiles]
    dark: CaptureFiles | None

    def groups(self) -> Iterator[CaptureFiles]:
        yield from self.lights.values()
        yield from self.together.values()
        if self.dark is not None:
            yield self.dark


def check_calibration(
    path: Path,
    lights: Mapping[str, str],
    dark: str | None,
    together: Mapping[str, str],
    stated: FrameSettings,
    *,
    limits: Limits | None = None,
    region: Sequence[float] | None = None,
) -> Verdict:
    """Check a calibration file on captures that were not used to make it.

    Parameters
    ----------
    path
        Calibration file.
    lights
        Patterns of the captures with one light on, by light.
    dark
        Pattern of the dark frames.
    together
        Patterns of captures with several lights on, by the lights' names joined by ``+``.
    stated
        What is stated of the files; it, the files and the calibration must agree, and the calibration fills in what
        neither states.
    limits
        What may be left.
    region
        Rectangle of the speckled target for the registration, px.
    """
    limits = limits or Limits()
    calibration = Calibration.read(path)
    files = _find(lights, dark, together, stated, calibration)
    calibration = calibration.cropped(None, next(iter(files.lights.values())).series.shape)
    warnings, skipped = _reused(calibration, files), []
    dark_stack = stack_frames(files.dark.frames(), drifts=False, name="the dark frames") if files.dark else None
    stacks = {name: stack_frames(group.frames(), name=group.role) for name, group in files.lights.items()}
    if calibration.crosstalk is None:
        raise CalibrationError("the calibration has no crosstalk to check; make it with rgbmidic-calibrate crosstalk")
    means = {name: [block_means(frame) for frame in group.frames()] for name, group in files.lights.items()}
    dark_means = [block_means(frame) for frame in files.dark.frames()] if files.dark else []
    items = leakage(calibration.crosstalk, means, dark_means).items(limits.leakage)
    sums = []
    for names, group in files.together.items():
        singles = {name: stacks[name] for name in names.split("+")}
        together_stack = stack_frames(group.frames(), name=group.role)
        sums.append(additivity(together_stack, singles, dark_stack, noise=calibration.noise))
    items += [item for total in sums for item in total.items(limits)]
    for name, check in (("noise", _noise_items), ("registration", _registration_items)):
        try:
            items += check(calibration, stacks, dark_stack, limits, region)
        except CalibrationError as error:
            skipped.append(f"{name} was not checked: {error}")
    if dark_stack is None:
        warnings.append("no dark frames: the stated black level is taken for the dark level")
    if not together:
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


def _find(
    lights: Mapping[str, str],
    dark: str | None,
    together: Mapping[str, str],
    stated: FrameSettings,
    calibration: Calibration,
) -> _Captures:
    def find(role: str, pattern: str) -> CaptureFiles:
        return CaptureFiles.find(role, pattern, stated, calibration)

    if not lights:
        raise ConfigurationError("check needs captures with one light on: --light NAME=FILES")
    found = {name: find(f"light {name}", pattern) for name, pattern in lights.items()}
    for names in together:
        if missing := [name for name in names.split("+") if name not in found]:
            raise ConfigurationError(
                f"--together {names} needs the single captures of {', '.join(missing)} too (--light)"
            )
        if "+" not in names:
            raise ConfigurationError(f"--together takes NAME+NAME=FILES, at least two lights, not {names}")
    return _Captures(
        found,
        {names: find(f"lights {names}", pattern) for names, pattern in together.items()},
        find("dark", dark) if dark else None,
    )


def _reused(calibration: Calibration, files: _Captures) -> list[str]:
    known = {
        entry.get("sha256")
        for origin in calibration.provenance.values()
        if isinstance(origin, Mapping)
        for entry in origin.get("inputs", ())
    }
    groups = (*files.lights.values(), *files.together.values())
    reused = [path for group in groups for path, fingerprint in group.fingerprints.items() if fingerprint in known]
    if not reused:
        return []
    made = f"{len(reused)} of these captures made the calibration ({reused[0]} ...)"
    return [f"{made}: they always agree; a check needs others"]


def _noise_items(
    calibration: Calibration,
    stacks: Mapping[str, TemporalStack],
    dark: TemporalStack | None,
    limits: Limits,
    region: Sequence[float] | None,
) -> list[CheckItem]:
    if calibration.noise is None:
        raise CalibrationError("the calibration has no noise section")
    items = []
    for name, stack in stacks.items():
        ratio, std = noise_ratio(stack, calibration.noise)
        value, error = 100 * (ratio - 1), 100 * std
        items.append(
            CheckItem(name=f"noise of {name} against prediction", value=value, std=error, limit=limits.noise, unit="%")
        )
    return items


def _registration_items(
    calibration: Calibration,
    stacks: Mapping[str, TemporalStack],
    dark: TemporalStack | None,
    limits: Limits,
    region: Sequence[float] | None,
) -> list[CheckItem]:
    if calibration.registration is None:
        raise CalibrationError("the calibration has no registration section")
    left = registration_left(calibration.registration, stacks, dark, region=region)
    return [
        CheckItem(name=f"registration of {name}", value=value, std=std, limit=limits.registration, unit="px")
        for name, value, std in left
    ]
