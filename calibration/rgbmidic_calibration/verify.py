"""Measures of a calibration on captures that were not used to make it: leakage, additivity, noise, registration.

The sub-command `check`: the verdict on a calibration file, from captures that were not used to make it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.checks import Check
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import QUANTISATION, NoiseModel
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.captures import (
    TILE,
    BlockMeans,
    Captures,
    TemporalStack,
    block_centres,
    block_means,
    same_camera,
    tile_means,
)
from rgbmidic_calibration.registration import estimate_registration


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Largest errors with which a calibration passes; chosen, and replaced by ``--limit`` of the command.

    Attributes
    ----------
    leakage
        Light left where it should not be, % of the light that is alone.
    additivity
        Departure of all lights together from the sum of the single ones, % of the signal, once offset and strengths
        are taken out.
    strength
        Change of a light's strength between the single and the common capture, %.
    registration
        Misregistration left anywhere in the frame, px.
    noise
        Observed noise against the predicted one, %.
    """

    leakage: float = 0.3
    additivity: float = 0.5
    strength: float = 5.0
    registration: float = 0.03
    noise: float = 10.0


def _line(name: str, value: float, std: float, limit: float, unit: str = "%") -> Check:
    """A line of the verdict."""
    return Check(name, "", value=value, limit=limit, std=std, unit=unit)


@dataclass(frozen=True, slots=True, kw_only=True)
class Leakage:
    """Fraction of light j (column) that unmixing leaves in the image of light i (row).

    Attributes
    ----------
    lights : tuple of str, length k
        Lights of the calibration.
    alone : tuple of str, length m
        Lights that were captured alone.
    mean, std : ndarray, shape (k, m)
        Ratio of the sums over the field, and its standard uncertainty; the light itself gives 1.
    """

    lights: tuple[str, ...]
    alone: tuple[str, ...]
    mean: FloatArray
    std: FloatArray

    def items(self, limit: float) -> list[Check]:
        """One line per pair of lights."""
        return [
            _line(f"{alone} left in {light}", 100 * self.mean[row, column], 100 * self.std[row, column], limit)
            for column, alone in enumerate(self.alone)
            for row, light in enumerate(self.lights)
            if light != alone
        ]


def leakage(
    crosstalk: Crosstalk, lights: Mapping[str, Sequence[BlockMeans]], dark: Sequence[BlockMeans] = ()
) -> Leakage:
    """Fraction of a light that unmixing leaves in the images of the other lights, from captures with one light on.

    Parameters
    ----------
    crosstalk
        The calibration under test.
    lights
        Block averages of the captures, by light.
    dark
        Block averages of the dark frames; none: the stated black level.

    Raises
    ------
    CalibrationError
        A light that the calibration does not know, or captures that are saturated everywhere.
    """
    if unknown := [name for name in lights if name not in crosstalk.lights]:
        raise CalibrationError(
            f"the calibration knows the lights {', '.join(crosstalk.lights)}, not {', '.join(unknown)}"
        )
    level = np.mean([frame.channels for frame in dark], axis=0) if dark else np.float64(0)
    first = next(iter(lights.values()))[0]
    unmixing = crosstalk.unmixing_at(block_centres(first.camera.shape, first.block))
    mean, std = np.empty((2, len(crosstalk.lights), len(lights)))
    for column, (name, captures) in enumerate(lights.items()):
        clear = ~np.any([frame.saturated for frame in captures], axis=0)
        if clear.sum() < 4:
            raise CalibrationError(f"light {name}: nearly every block holds saturated samples; shorten the exposure")
        channels = np.mean([frame.channels for frame in captures], axis=0) - level
        values = np.einsum("rskc,crs->krs", unmixing, channels)[:, clear]
        lit, brightest = crosstalk.lights.index(name), int(values.sum(axis=1).argmax())
        total = float(values[lit].sum())
        if total <= 0 or brightest != lit:
            raise CalibrationError(
                f"the captures of light {name} show most light in {crosstalk.lights[brightest]} after unmixing: are "
                "the captures swapped, was the lamp off, or is the calibration of another camera?"
            )
        mean[:, column] = values.sum(axis=1) / total
        scatter = values - mean[:, column, None] * values[lit]
        std[:, column] = np.sqrt((scatter**2).sum(axis=1)) / total
    return Leakage(lights=crosstalk.lights, alone=tuple(lights), mean=mean, std=std)


@dataclass(frozen=True, slots=True, kw_only=True)
class Additivity:
    """All lights together against the sum of the single ones, ``together - sum = offset + sum of change_j light_j``.

    Attributes
    ----------
    lights : tuple of str, length k
    mean, spread : float
        Mean and standard deviation of the difference over all samples, DN.
    noise : float
        Standard deviation of the difference that the camera's noise explains, DN; rounding alone where the noise is
        not known.
    offset : float
        DN; what a wrong black level leaves.
    change, change_std : ndarray, shape (k,)
        Relative change of every light's strength between its own and the common capture.
    left : float
        Rms over tiles of what remains, as a fraction of the mean signal, noise taken out.
    """

    lights: tuple[str, ...]
    mean: float
    spread: float
    noise: float
    offset: float
    change: FloatArray
    change_std: FloatArray
    left: float

    def items(self, limits: Limits) -> list[Check]:
        """Lines of the verdict."""
        together = "+".join(self.lights)
        return [
            _line(f"{together} not the sum", 100 * self.left, 0.0, limits.additivity),
            *(
                _line(f"strength of {name} in {together}", 100 * change, 100 * std, limits.strength)
                for name, change, std in zip(self.lights, self.change, self.change_std, strict=True)
            ),
        ]


def additivity(
    together: TemporalStack,
    singles: Mapping[str, TemporalStack],
    dark: TemporalStack | None = None,
    *,
    noise: NoiseModel | None = None,
) -> Additivity:
    """Compare captures of several lights together with the sum of their single captures, sample by sample.

    The same scene must be at rest in all of them: a camera that is linear and lamps that do not influence each other
    give the sum exactly, whatever the crosstalk.

    Parameters
    ----------
    together
        Captures with these lights on.
    singles
        Captures of each of them alone.
    dark
        Captures with all lights off; none: the stated black level.
    noise
        Camera noise; None: from the captures where each group has two or more, else rounding to grey levels alone.
    """
    same_camera([together, *singles.values(), *([dark] if dark else [])])
    level = dark.mean if dark else np.float32(0)
    lights = [stack.mean - level for stack in singles.values()]
    stacks = [together, *singles.values()]
    variance = np.sum([_variance(stack, noise) for stack in stacks], axis=0)
    if dark:
        variance = variance + (len(lights) - 1) ** 2 * _variance(dark, noise)
    # difference, its noise variance, and every light's image, NaN where saturated
    rows = np.stack([together.mean - level - np.sum(lights, axis=0), variance, *lights]).astype(np.float64)
    rows[:, np.any([stack.clipped for stack in stacks], axis=0)] = np.nan
    samples = rows[:, np.isfinite(rows[0])]
    if samples.shape[1] < TILE**2:
        raise CalibrationError("nearly every sample is saturated in one of the captures; shorten the exposure")
    tiles = tile_means(rows).reshape(len(rows), -1)
    tiles = tiles[:, np.isfinite(tiles[0])]  # without saturated samples
    difference, variance, of_lights = tiles[0], tiles[1] / min(TILE, *rows.shape[2:]) ** 2, tiles[2:]
    design = np.concatenate([np.ones((1, len(difference))), of_lights]).T
    inverse = np.linalg.pinv(design.T @ design)
    solution = inverse @ (design.T @ difference)
    residual = difference - design @ solution
    score = design * residual[:, None]
    std = np.sqrt(np.diag(inverse @ (score.T @ score) @ inverse))
    signal = float(of_lights.sum(axis=0).mean())
    left = max(float((residual**2).mean() - variance.mean()), 0.0)
    return Additivity(
        lights=tuple(singles),
        mean=float(samples[0].mean()),
        spread=float(samples[0].std()),
        noise=float(np.sqrt(samples[1].mean())),
        offset=float(solution[0]),
        change=solution[1:],
        change_std=std[1:],
        left=float(np.sqrt(left)) / max(signal, 1e-9),
    )


def _variance(stack: TemporalStack, noise: NoiseModel | None) -> npt.NDArray[np.floating]:
    """Noise variance of the mean over the frames: from the noise model, from the frames themselves, or of rounding."""
    if noise is not None:
        return np.asarray(noise.variance(stack.mean) / stack.count)
    return stack.variance / stack.count if stack.count > 1 else np.full(stack.mean.shape, QUANTISATION)


def registration_left(
    registration: Registration,
    lights: Mapping[str, TemporalStack],
    dark: TemporalStack | None = None,
    *,
    region: Sequence[float] | None = None,
) -> list[tuple[str, float, float]]:
    """Displacement between the lights that the registration leaves in captures of a speckled target.

    Parameters
    ----------
    registration
        The registration under test.
    lights
        Captures with one light on, by light.
    dark
        Captures with all lights off; none: the stated black level.
    region
        Rectangle (x0, y0, x1, y1) of the target in px; None: the whole frame.

    Returns
    -------
    list of (str, float, float)
        Light, largest displacement left on a grid over the frame (px), and its standard uncertainty there.
    """
    ordered = {name: lights[name] for name in registration.lights if name in lights}
    found = estimate_registration(ordered, dark, region=region).registration
    height, width = next(iter(ordered.values())).camera.shape
    x0, y0, x1, y1 = region if region is not None else (0, 0, width - 1, height - 1)
    grid = np.stack(np.meshgrid(np.linspace(x0, x1, 9), np.linspace(y0, y1, 9)), axis=-1).reshape(-1, 2)
    known = registration.displacement(grid)[[registration.lights.index(name) for name in ordered]]
    # The first of the captured lights need not be the calibration's first.
    left = np.linalg.norm(found.displacement(grid) - (known - known[0]), axis=2)
    std = found.displacement_std(grid)
    errors = np.zeros_like(left) if std is None else np.linalg.norm(std, axis=2)
    worst = [(float(row.max()), float(error[row.argmax()])) for row, error in zip(left, errors, strict=True)]
    return [(name, *figures) for name, figures in list(zip(ordered, worst, strict=True))[1:]]


def noise_ratio(stack: TemporalStack, noise: NoiseModel, same_exposure: float = 0.05) -> tuple[float, float]:
    """Observed over predicted noise of captures at rest (standard deviations), and its uncertainty.

    Captures count as one exposure up to the drift `same_exposure` (`TemporalStack.drift`); more is a lamp that drifts
    or an exposure series, as of the warning in `rgbmidic_calibration.crosstalk.matrix_checks`.

    Raises
    ------
    CalibrationError
        Fewer than two captures, or captures of different exposures.
    """
    if stack.count < 2:
        raise CalibrationError("noise needs at least two captures of the same scene")
    if stack.drift > same_exposure:
        raise CalibrationError("the captures of a light have different exposures")
    clear = ~stack.clipped
    observed, predicted = (
        sum(float(plane[use].sum(dtype=np.float64)) for plane, use in zip(values, clear, strict=True))
        for values in (stack.variance, noise.variance(stack.mean))
    )
    samples = int(clear.sum())
    ratio = float(np.sqrt(observed / max(predicted, 1e-12)))
    return ratio, ratio / np.sqrt(2 * max(samples, 1) * (stack.count - 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Result of `check_calibration`: lines with limits, sums of lights, what was not checked, warnings."""

    items: tuple[Check, ...]
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
    known = {
        entry.get("sha256")
        for origin in calibration.provenance.values()
        if isinstance(origin, Mapping)
        for entry in origin.get("inputs", ())
    }
    lit = (*captures.lights.values(), *captures.together.values())
    reused = [path for group in lit for path, fingerprint in group.fingerprints.items() if fingerprint in known]
    made = f"{len(reused)} of these captures made the calibration ({[*reused, ''][0]} ...): they always agree"
    warnings = [f"{made}; a check needs others"] if reused else []
    stacks, dark = captures.stacks()
    means = {name: [block_means(frame) for frame in files.frames()] for name, files in captures.lights.items()}
    dark_means = [block_means(frame) for frame in captures.dark.frames()] if captures.dark else []
    items, skipped = leakage(calibration.crosstalk, means, dark_means).items(limits.leakage), []
    sums = []
    for names, files in captures.together.items():
        singles = {name: stacks[name] for name in names.split("+")}
        sums.append(additivity(files.stack(), singles, dark, noise=calibration.noise))
    items += [item for total in sums for item in total.items(limits)]

    def noise() -> Iterator[Check]:
        if calibration.noise is None:
            raise CalibrationError("the calibration has no noise section")
        for name, stack in stacks.items():
            ratio, std = noise_ratio(stack, calibration.noise)
            yield _line(f"noise of {name} against prediction", 100 * (ratio - 1), 100 * std, limits.noise)

    def registration() -> Iterator[Check]:
        if calibration.registration is None:
            raise CalibrationError("the calibration has no registration section")
        for name, value, std in registration_left(calibration.registration, stacks, dark, region=region):
            yield _line(f"registration of {name}", value, std, limits.registration, "px")

    for check in (noise, registration):
        try:
            items += list(check())
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
