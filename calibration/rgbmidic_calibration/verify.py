"""Measures of a calibration on captures that were not used to make it: leakage, additivity, noise, registration.

The sub-command `check`: the verdict on a calibration file, from captures that were not used to make it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.fields.plane import CameraCalibration
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.checks import Check, warning
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import QUANTISATION, NoiseModel
from rgbmidic.tools.stereo import CameraPair
from rgbmidic_calibration.captures import TILE, BlockMeans, Captures, TemporalStack, require_same_camera, tile_means
from rgbmidic_calibration.registration import estimate_registration
from rgbmidic_calibration.stereo import ViewPair, verdicts


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Largest errors with which a calibration passes; chosen, and replaced by the option ``--limit``.

    Attributes
    ----------
    leakage
        Light left where it should not be, % of the light that is alone.
    checkerboard
        Amplitude of the checkerboard that the two greens leave in any light's image, % of the light that is alone.
    additivity
        Departure of all lights together from the sum of the single ones, % of the signal, once offset and strengths
        are taken out.
    strength
        Change of a light's strength between the single and the common capture, %.
    registration
        Misregistration left anywhere in the frame, px.
    noise
        Observed noise against the predicted one, %.
    distance
        Known distance on the specimen's plane against the measured one, %.
    length
        Known distance on a target before two cameras against the triangulated one, %: lengths of the package's own
        calibration are right to .003 % (tests); a focal length off by .1 % is seen by nothing else.
    epipolar
        Epipolar residual of a target's points before two cameras, px rms.
    """

    leakage: float = 0.3
    checkerboard: float = 0.3
    additivity: float = 0.5
    strength: float = 5.0
    registration: float = 0.03
    noise: float = 10.0
    distance: float = 0.5
    length: float = 0.05
    epipolar: float = 0.1


LIMITS = Limits()


def leakage(
    crosstalk: Crosstalk,
    lights: Mapping[str, Sequence[BlockMeans]],
    dark: Sequence[BlockMeans] = (),
    limits: Limits = LIMITS,
) -> list[Check]:
    """Fraction of a light that unmixing leaves in the images of the other lights, from captures with one light on.

    Of a Bayer mosaic also the checkerboard that it leaves where the greens differ by something else than calibrated.

    Parameters
    ----------
    crosstalk
        The calibration under test.
    lights
        Block averages of the captures, by light.
    dark
        Block averages of the dark frames; none: the stated black level.
    limits
        What may be left.

    Returns
    -------
    list of Check
        For every light that is on and every other one: ratio of the sums over the field and its standard uncertainty.
        For every light that is on: the checkerboard in the image that shows it most.

    Raises
    ------
    CalibrationError
        A light that the calibration does not know, or captures that are saturated everywhere.
    """
    if unknown := [name for name in lights if name not in crosstalk.lights]:
        raise CalibrationError(
            f"the calibration knows the lights {', '.join(crosstalk.lights)}, not {', '.join(unknown)}"
        )
    level = np.mean([frame.signals for frame in dark], axis=0) if dark else np.float64(0)
    greens = crosstalk.green_difference
    unmixing = crosstalk.unmixing_at(next(iter(lights.values()))[0].centres)
    checks = []
    for name, captures in lights.items():
        clear = ~np.any([frame.saturated for frame in captures], axis=0)
        if clear.sum() < 4:
            raise CalibrationError(f"light {name}: nearly every block holds saturated samples; shorten the exposure")
        signals = np.mean([frame.signals for frame in captures], axis=0) - level
        values = np.einsum("rskc,crs->krs", unmixing, signals[:3])[:, clear]
        light_index, brightest = crosstalk.lights.index(name), int(values.sum(axis=1).argmax())
        total = float(values[light_index].sum())
        if total <= 0 or brightest != light_index:
            raise CalibrationError(
                f"the captures of light {name} show most light in {crosstalk.lights[brightest]} after unmixing: are "
                "the captures swapped, was the lamp off, or is the calibration of another camera?"
            )
        mean = values.sum(axis=1) / total
        std = np.sqrt(((values - mean[:, None] * values[light_index]) ** 2).sum(axis=1)) / total
        checks += [
            Check(f"{name} left in {light}", "", 100 * mean[row], limits.leakage, std=100 * std[row], unit="%")
            for row, light in enumerate(crosstalk.lights)
            if light != name
        ]
        if len(signals) > 3:  # what the greens differ by beyond the calibration
            difference = signals[3][clear] - values[light_index] * (0 if greens is None else greens[light_index])
            relative = float(difference.sum()) / total
            scatter = np.sqrt(((difference - relative * values[light_index]) ** 2).sum()) / total
            amplitude, std = 100 * np.abs(crosstalk.checkerboard(np.array([relative, scatter]))).max(axis=0)
            checks.append(Check(f"checkerboard of {name}", "", amplitude, limits.checkerboard, std=std, unit="%"))
    return checks


def additivity(
    combined: TemporalStack,
    singles: Mapping[str, TemporalStack],
    dark: TemporalStack | None = None,
    *,
    noise: NoiseModel | None = None,
    limits: Limits = LIMITS,
) -> list[Check]:
    """Compare captures of several lights together with the sum of their single captures, sample by sample.

    The same scene must be at rest in all of them: a camera that is linear and lamps that do not influence each other
    give the sum exactly, whatever the crosstalk. Fitted is ``together - sum = offset + sum of change_j light_j``: a
    wrong black level leaves the offset, a lamp that is weaker when others are on its change.

    Parameters
    ----------
    combined
        Captures with these lights on.
    singles
        Captures of each of them alone.
    dark
        Captures with all lights off; none: the stated black level.
    noise
        Camera noise; None: from the captures where each group has two or more, else rounding to grey levels alone.
    limits
        What may be left.

    Returns
    -------
    list of Check
        Rms over tiles of what remains, noise taken out, as a fraction of the mean signal, with a sentence about the
        difference; then the relative change of every light's strength between its own and the common capture.
    """
    require_same_camera([combined, *singles.values(), *([dark] if dark else [])])
    level = dark.mean if dark else np.float32(0)
    lights = [stack.mean - level for stack in singles.values()]
    stacks = [combined, *singles.values()]
    variance = np.sum([_variance(stack, noise) for stack in stacks], axis=0)
    if dark:
        variance = variance + (len(lights) - 1) ** 2 * _variance(dark, noise)
    # difference, its noise variance, and every light's image, NaN where saturated
    rows = np.stack([combined.mean - level - np.sum(lights, axis=0), variance, *lights]).astype(np.float64)
    rows[:, np.any([stack.clipped for stack in stacks], axis=0)] = np.nan
    samples = rows[:, np.isfinite(rows[0])]
    if samples.shape[1] < TILE**2:
        raise CalibrationError("nearly every sample is saturated in one of the captures; shorten the exposure")
    tiles = tile_means(rows).reshape(len(rows), -1)
    tiles = tiles[:, np.isfinite(tiles[0])]  # without saturated samples
    difference, variance, light_tiles = tiles[0], tiles[1] / min(TILE, *rows.shape[2:]) ** 2, tiles[2:]
    design = np.concatenate([np.ones((1, len(difference))), light_tiles]).T
    inverse = np.linalg.pinv(design.T @ design)
    solution = inverse @ (design.T @ difference)
    residual = difference - design @ solution
    score = design * residual[:, None]
    std = np.sqrt(np.diag(inverse @ (score.T @ score) @ inverse))
    signal = float(light_tiles.sum(axis=0).mean())
    remaining = np.sqrt(max(float((residual**2).mean() - variance.mean()), 0.0)) / max(signal, 1e-9)
    names = "+".join(singles)
    text = (
        f"{names} minus the sum of the single captures: {samples[0].mean():+.2f} DN on average, scatter "
        f"{samples[0].std():.2f} DN where noise explains {np.sqrt(samples[1].mean()):.2f} DN; offset "
        f"{solution[0]:+.2f} DN"
    )
    return [
        Check(f"{names} not the sum", text, 100 * remaining, limits.additivity, unit="%"),
        *(
            Check(f"strength of {name} in {names}", "", 100 * change, limits.strength, std=100 * error, unit="%")
            for name, change, error in zip(singles, solution[1:], std[1:], strict=True)
        ),
    ]


def _variance(stack: TemporalStack, noise: NoiseModel | None) -> npt.NDArray[np.floating]:
    """Noise variance of the mean over the frames: from the noise model, from the frames themselves, or of rounding."""
    if noise is not None:
        return np.asarray(noise.variance(stack.mean) / stack.count)
    return stack.variance / stack.count if stack.count > 1 else np.full(stack.mean.shape, QUANTISATION)


def remaining_registration(
    registration: Registration,
    lights: Mapping[str, TemporalStack],
    dark: TemporalStack | None = None,
    *,
    region: Sequence[float] | None = None,
    limits: Limits = LIMITS,
) -> list[Check]:
    """Return the displacement between the lights that the registration leaves in captures of a speckled target.

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
    limits
        What may be left.

    Returns
    -------
    list of Check
        For every light after the first the largest displacement left on a grid over the frame, and its standard
        uncertainty there.
    """
    ordered = {name: lights[name] for name in registration.lights if name in lights}
    estimated = estimate_registration(ordered, dark, region=region).registration
    height, width = next(iter(ordered.values())).camera.shape
    x0, y0, x1, y1 = region if region is not None else (0, 0, width - 1, height - 1)
    grid = np.stack(np.meshgrid(np.linspace(x0, x1, 9), np.linspace(y0, y1, 9)), axis=-1).reshape(-1, 2)
    calibrated = registration.displacement(grid)[[registration.lights.index(name) for name in ordered]]
    # The first of the captured lights need not be the calibration's first.
    remaining = np.linalg.norm(estimated.displacement(grid) - (calibrated - calibrated[0]), axis=2)
    std = estimated.displacement_std(grid)
    errors = np.zeros_like(remaining) if std is None else np.linalg.norm(std, axis=2)
    return [
        Check(f"registration of {name}", "", row.max(), limits.registration, std=error[row.argmax()], unit="px")
        for name, row, error in list(zip(ordered, remaining, errors, strict=True))[1:]
    ]


def noise_ratio(stack: TemporalStack, noise: NoiseModel, same_exposure: float = 0.05) -> tuple[float, float]:
    """Return the observed over predicted noise of captures at rest (standard deviations), and its uncertainty.

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


def check_stereo(
    pair: CameraPair, views: Sequence[ViewPair], *, distance: float | None = None, limits: Limits = LIMITS
) -> list[Check]:
    """Check two cameras on views of a target that were not used to calibrate them.

    Parameters
    ----------
    pair
        The cameras under test.
    views
        The target seen by both at one time.
    distance
        True distance of the target's two farthest points, mm, as a caliper measures it; None: as the target states it.
    limits
        What may be left.

    Returns
    -------
    list of Check
        The epipolar residual, and the relative error of the length with the scatter of the views.

    Raises
    ------
    CalibrationError
        The photographs have another size than the cameras', there are none, or the distance is not positive.
    """
    if not views:
        raise CalibrationError("both cameras see the target together in no photograph")
    pair.check((views[0].left.shape, views[0].right.shape))
    points = views[0].left.points
    target_length = float(np.linalg.norm(points[:, None] - points, axis=2).max())
    if distance is not None and not 0.9 * target_length < distance < 1.1 * target_length:
        raise CalibrationError(
            f"the target's farthest points are {target_length:g} mm apart as stated; a measured distance is within a "
            f"tenth of that, not {distance:g} mm"
        )
    numbered = [min((view, view.renumbered), key=lambda item: item.rms(pair)) for view in views]
    figures = verdicts(pair, numbered)
    known_length = distance or target_length
    error = (1 + figures["relative_length_error"]) * target_length / known_length - 1
    text = f"the target's farthest points are {known_length:g} mm apart: measured {(1 + error) * known_length:.6g} mm"
    std = 100 * figures.get("relative_length_std", float("nan"))
    return [
        Check("epipolar residual", "", figures["epipolar_px"], limits.epipolar, unit="px"),
        Check("known length", text, 100 * error, limits.length, std=std, unit="%"),
    ]


def check_distances(
    camera: CameraCalibration,
    distances: Sequence[tuple[Sequence[float], float]],
    *,
    corner_std: float = 0.5,
    limits: Limits = LIMITS,
) -> list[Check]:
    """Check plane and scale of a camera on distances that were not used to make it, such as a ruler on the plane.

    Parameters
    ----------
    camera
        The camera under test, with a plane.
    distances
        Ends (x0, y0, x1, y1) in px, as they are read in an image, and the true distance in mm.
    corner_std
        Standard uncertainty of the ends, px.
    limits
        What may be left.

    Returns
    -------
    list of Check
        Relative error of each, and its standard uncertainty from the ends, the lens and the plane.

    Raises
    ------
    CalibrationError
        An end lies outside the frame, or a distance is not positive.
    """
    checks = []
    for number, (ends, true) in enumerate(distances, start=1):
        points = np.reshape(np.asarray(ends, dtype=np.float64), (2, 2))
        if not true > 0 or (points < 0).any() or (points > np.array(camera.shape[::-1]) - 1).any():
            height, width = camera.shape
            raise CalibrationError(
                f"a distance has its ends in the frame of {width} x {height} px and a length above 0 mm; given are "
                f"{points.tolist()} and {true:g} mm"
            )
        step = np.diff(camera.to_mm(points), axis=0)[0]
        length = float(np.hypot(*step))
        along = step / max(length, 1e-300)
        by_ends = along @ camera.jacobian(points)
        slopes = along @ np.diff(camera.sensitivity(points), axis=0)[0]
        variance = corner_std**2 * float((by_ends**2).sum()) + float(slopes @ camera.correlation @ slopes)
        text = f"distance {number} is {true:g} mm: measured {length:.6g} mm"
        error, std = 100 * (length / true - 1), 100 * float(np.sqrt(variance)) / true
        checks.append(Check(f"distance {number}", text, error, limits.distance, std=std, unit="%"))
    return checks


def check_calibration(
    calibration: Calibration, captures: Captures, *, limits: Limits = LIMITS, region: Sequence[float] | None = None
) -> list[Check]:
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

    Returns
    -------
    list of Check
        Those with a name are the verdict: each has a figure, its uncertainty and its limit. Those without are doubts
        (`rgbmidic.illumination.checks.reported`), and sentences about what was not checked.

    Raises
    ------
    CalibrationError
        The calibration has no crosstalk, or captures cannot be compared with it.
    """
    if not captures.lights:
        raise ConfigurationError("a check needs captures with one light on: state them in `lights`")
    calibration = calibration.cropped(None, next(iter(captures.lights.values())).series.shape)
    if calibration.crosstalk is None:
        raise CalibrationError("the calibration has no crosstalk to check; make it with rgbmidic-calibrate crosstalk")
    input_hashes = {
        entry.get("sha256")
        for origin in calibration.provenance.values()
        if isinstance(origin, Mapping)
        for entry in origin.get("inputs", ())
    }
    light_groups = (*captures.lights.values(), *captures.simultaneous.values())
    reused = [
        path
        for group in light_groups
        for path, fingerprint in group.fingerprints.items()
        if fingerprint in input_hashes
    ]
    checks = []
    if reused:
        reuse_text = f"{len(reused)} of these captures made the calibration ({reused[0]} ...): they always agree"
        checks.append(warning(f"{reuse_text}; a check needs others"))
    stacks, dark = captures.stacks()
    if dark is None:
        checks.append(warning("no dark frames: the stated black level is taken for the dark level"))
    means = {name: files.means() for name, files in captures.lights.items()}
    dark_means = captures.dark.means() if captures.dark else []
    checks += leakage(calibration.crosstalk, means, dark_means, limits)
    for names, files in captures.simultaneous.items():
        singles = {name: stacks[name] for name in names.split("+")}
        checks += additivity(files.stack(), singles, dark, noise=calibration.noise, limits=limits)

    def noise() -> Iterator[Check]:
        if calibration.noise is None:
            raise CalibrationError("the calibration has no noise section")
        for name, stack in stacks.items():
            ratio, std = noise_ratio(stack, calibration.noise)
            text = f"noise of {name} against prediction"
            yield Check(text, "", 100 * (ratio - 1), limits.noise, std=100 * std, unit="%")

    def registration() -> list[Check]:
        if calibration.registration is None:
            raise CalibrationError("the calibration has no registration section")
        return remaining_registration(calibration.registration, stacks, dark, region=region, limits=limits)

    for measure in (noise, registration):
        try:
            checks += list(measure())
        except CalibrationError as error:
            checks.append(Check("", f"{measure.__name__} was not checked: {error}", value=0))
    if not captures.simultaneous:
        checks.append(
            Check("", "additivity was not checked: no captures with lights together (`simultaneous`)", value=0)
        )
    return checks
