"""Camera noise by the photon transfer method: gain, read noise, black level, saturation, linearity, fixed pattern.

With shot noise of the electrons and read noise, the temporal variance of a sample is ``v = r^2 + K mu`` with K = 1/gain
and mu the mean above dark (EMVA standard 1288, release 4.0, section 2.2 and 6). Mean and variance are taken in blocks,
so neither shading nor texture of the target matters, as long as it stands still. The fixed pattern (DSNU, PRNU) and hot
and dead pixels follow its sections 4 and 8.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from rgbmidic.errors import CalibrationError
from rgbmidic.illumination.checks import Check, warning
from rgbmidic.illumination.linear import CameraNoise, Quantity
from rgbmidic.typing import AnyArray, BoolArray, FloatArray
from rgbmidic_calibration.captures import TILE, TemporalStack, require_same_camera, tile_means
from rgbmidic_calibration.plausibility import collect_warnings


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseConstants:
    """Constants of `photon_transfer`.

    Attributes
    ----------
    max_level
        Blocks brighter than this fraction of the range are not used: the variance falls as samples reach white. From .7
        to .95 the gain of the virtual camera changes by .7 of its standard uncertainty at most.
    knee
        Variance over its prediction below which the sensor itself saturates before the white level does: from .6 to .9
        no figure of the virtual camera changes, since tiles must fall below it by three standard deviations as well.
    drift
        Largest drift of the lamp's strength within an exposure (`TemporalStack.drift`). Chosen: frames are scaled to
        one strength, so that drift does no harm; a fifth is another exposure rather than a lamp that warms up.
    window
        Side (samples of a plane) of the neighbourhood whose mean is taken out: shading and dirt are wider than this.
    hot_sigma
        Robust standard deviations above the neighbourhood's median that make a pixel hot in the dark: of normal noise
        one sample in 1e15 lies there; from 6 to 10 the virtual camera has no false one.
    hot_fraction
        Fraction of the full scale by which a hot pixel exceeds its neighbourhood at least: 20 DN of 12 bit, seven times
        the dark noise of the virtual camera, which has no false one from .002 to .01.
    dead_fraction
        Response relative to the neighbourhood's median below which a pixel is dead: half, as far from a live pixel as
        from a black one; from .3 to .7 the virtual camera has no false one.
    lit_fraction
        Signal over the full scale below which neither is determined (chosen).
    max_response_variation
        Local variation of the response above which the target, not the sensor, is uneven: from .03 to .08 the virtual
        camera's white card is judged alike.
    """

    max_level: float = 0.9
    knee: float = 0.8
    drift: float = 0.2
    window: int = 7
    hot_sigma: float = 8.0
    hot_fraction: float = 0.005
    dead_fraction: float = 0.5
    lit_fraction: float = 0.02
    max_response_variation: float = 0.05


LIMITS = NoiseConstants()


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseEstimate:
    """Result of `photon_transfer`: the figures, and what the user should know."""

    camera_noise: CameraNoise
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Line:
    """Photon transfer line of one plane: variance over mean.

    `max_mean` is the mean of the brightest exposure above dark (DN), `scatter` that of the tiles' variances about the
    line over what noise alone explains, `max_departure` the largest relative departure of an exposure's mean beyond
    its noise.
    """

    read_variance: float
    slope: float
    covariance: FloatArray  # (2, 2)
    max_mean: float
    scatter: float
    max_departure: float


def photon_transfer(dark: TemporalStack, flats: Sequence[TemporalStack]) -> NoiseEstimate:
    """Return the noise figures of every colour plane from dark frames and flat frames at several exposures.

    Parameters
    ----------
    dark
        At least two frames without light, at the exposure time of the test.
    flats
        One stack per exposure, each of at least two frames. Any target that stands still; a plain one where the
        response's fixed pattern (PRNU) and dead pixels are wanted.

    Raises
    ------
    CalibrationError
        Too few frames, frames of different cameras, a lamp that flickers, everything saturated, dark frames as bright
        as the flats.
    """
    stacks, names = [dark, *flats], dark.camera.names
    require_same_camera(stacks)
    _require_usable(dark, flats)
    full_range = dark.camera.white - np.array(dark.camera.black)
    freedom = TILE**2 * (np.array([stack.count for stack in stacks]) - 1)
    # tiles of every exposure and plane, those of the dark frames first
    level = np.stack([tile_means(stack.mean) for stack in stacks])
    variance = np.stack([tile_means(stack.variance) for stack in stacks])
    free = np.stack([tile_means(stack.clipped) == 0 for stack in stacks])
    is_used = free & (level < LIMITS.max_level * full_range[:, None])
    is_used[0] = True
    mean = level - level[0]
    lines = [_fit_line(name, mean[:, p], variance[:, p], is_used[:, p], freedom) for p, name in enumerate(names)]
    drift = dark.strength.var(axis=0, ddof=1)
    mean_variance = np.array([plane.mean(dtype=np.float64) / plane.size for plane in dark.variance])
    black_std = np.sqrt(np.maximum(drift, mean_variance) / dark.count)
    black = Quantity(np.array(dark.camera.black) + dark.strength.mean(axis=0), black_std)
    knees = []  # lowest level at which the variance of a plane breaks down
    for plane, line in enumerate(lines):
        ratio = variance[1:, plane] / (line.read_variance + line.slope * np.maximum(mean[1:, plane], 0))
        broken = free[1:, plane] & (ratio < LIMITS.knee - 3 * np.sqrt(2 / freedom[1:, None]))
        broken &= mean[1:, plane] > 0.3 * full_range[plane]
        is_broken = broken.mean(axis=1) > 0.02
        levels = [
            np.median(level[mask]) for level, mask in zip(mean[1:, plane][is_broken], broken[is_broken], strict=True)
        ]
        knees.append(min(levels, default=np.nan))
    white, std = dark.camera.white - black.value, np.hypot(black.std, 0.5)
    saturates_early = (
        np.nan_to_num(knees, nan=np.inf) < 0.95 * white
    )  # the sensor saturates before the white level does
    saturation = Quantity(
        np.where(saturates_early, knees, white), np.where(saturates_early, 0.05 * np.array(knees), std)
    )
    read, gain = np.sqrt([line.read_variance for line in lines]), np.array([1 / line.slope for line in lines])
    read_std, slope_std = np.sqrt([np.diag(line.covariance) for line in lines]).T
    dsnu, prnu, defects, texture_warnings = fixed_pattern(dark, flats, saturation)
    noise = CameraNoise(
        planes=names,
        gain=Quantity(gain, gain**2 * slope_std),
        read_noise=Quantity(read, read_std / (2 * read)),
        black_level=black,
        saturation=saturation,
        linearity_error=_linearity(dark, flats, saturation.value),
        dsnu=dsnu,
        prnu=prnu,
        defects=defects,
    )
    warnings = collect_warnings(_checks(dark, flats, noise, lines, saturates_early))
    return NoiseEstimate(camera_noise=noise, warnings=(*warnings, *texture_warnings))


def _require_usable(dark: TemporalStack, flats: Sequence[TemporalStack]) -> None:
    if not flats:
        raise CalibrationError("no flat exposure is given: the gain needs lit frames at one exposure at least")
    for index, stack in enumerate([dark, *flats]):
        name = f"flat exposure {index}" if index else "the dark frames"
        if stack.count < 2:
            raise CalibrationError(f"{name}: temporal noise needs at least two frames of the same scene, given is one")
        if index and stack.drift > LIMITS.drift:
            raise CalibrationError(
                f"{name}: the frames' strengths differ by {100 * stack.drift:.0f} %: each group must be frames of one "
                "exposure with a steady lamp"
            )
        if index and stack.pile_level is not None:
            raise CalibrationError(
                f"{name}: samples pile up at {stack.pile_level:.0f} DN, below the stated white level "
                f"{stack.camera.white:g}: the camera saturates there; state `white_level` {stack.pile_level:.0f}"
            )
    brightest = max(float(flat.strength.mean(axis=0).max()) for flat in flats)
    if float(dark.strength.mean(axis=0).max()) > 0.5 * brightest:
        raise CalibrationError("the dark frames are not darker than half of the brightest flat frames: was a lamp on?")


def _fit_line(
    name: str, mean: FloatArray, variance: FloatArray, is_used: BoolArray, freedom: npt.NDArray[np.intp]
) -> _Line:
    """Line of variance over mean through the tiles of all exposures (E, T), weighted by the variance of a variance."""
    if not is_used[1:].any():
        raise CalibrationError(
            f"plane {name}: every block of every flat exposure is saturated or nearly so; shorten the exposure"
        )
    exposure, freedom = (
        np.broadcast_to(values[:, None], mean.shape)[is_used] for values in (np.arange(len(mean)), freedom)
    )
    mean, variance = mean[is_used], variance[is_used]
    if mean.max() <= 0:
        raise CalibrationError(f"plane {name}: the flat frames are not brighter than the dark ones")
    design = np.stack([np.ones_like(mean), mean], axis=1)
    fitted = np.maximum(variance.mean(), 1e-6) * np.ones_like(mean)
    for _ in range(8):
        weight = freedom / fitted**2
        inverse = np.linalg.inv(design.T @ (weight[:, None] * design))
        solution = inverse @ (design.T @ (weight * variance))
        fitted = np.maximum(design @ solution, 1e-3 * variance.mean())
    residual = variance - design @ solution
    # Sandwich covariance with each residual as if its block had not been fitted (HC3): the dark blocks pull strongly.
    leverage = weight * np.einsum("bi,ij,bj->b", design, inverse, design)
    score = (weight * residual / (1 - leverage))[:, None] * design
    groups = np.unique(exposure)
    means = np.array([[values[exposure == g].mean() for g in groups] for values in (mean, variance, fitted)])
    scatter = float(np.sqrt(np.mean((residual / fitted) ** 2 * freedom / 2)))
    if solution[1] <= 0:
        raise CalibrationError(
            "the variance does not grow with the signal: these are not raw samples with shot noise (compressed, "
            "averaged or noise-reduced frames cannot be calibrated)"
        )
    noise = scatter * np.sqrt([2 / freedom[exposure == g].sum() for g in groups])
    return _Line(
        read_variance=max(float(solution[0]), 1e-12),
        slope=float(solution[1]),
        covariance=inverse @ (score.T @ score) @ inverse,
        max_mean=float(means[0].max()),
        scatter=scatter,
        max_departure=float(np.maximum(np.abs(means[1] / means[2] - 1) - 4 * noise, 0).max()),
    )


def _linearity(dark: TemporalStack, flats: Sequence[TemporalStack], saturation: FloatArray) -> Quantity:
    """Return LE of EMVA 1288, mean relative deviation in % from the line of mean against exposure time, 5 to 95 %."""
    timed_flats = [flat for flat in flats if flat.exposure is not None]
    time = np.array([flat.exposure for flat in timed_flats], dtype=np.float64)
    error, std = np.full((2, len(dark.camera.names)), np.nan)
    for plane, full in enumerate(saturation):
        mean = np.array([flat.strength[:, plane].mean() for flat in timed_flats]) - dark.strength[:, plane].mean()
        steady = np.array([flat.strength[:, plane].std(ddof=1) / np.sqrt(flat.count) for flat in timed_flats])
        free = np.array([not flat.clipped[plane].any() for flat in timed_flats], dtype=bool)
        good = free & (mean > 0.05 * full) & (mean < 0.95 * full)
        if len(np.unique(time[good])) < 3:
            continue
        line = np.polyfit(time[good], mean[good], 1, w=1 / mean[good])
        error[plane] = 100 * np.abs(mean[good] / np.polyval(line, time[good]) - 1).mean()
        std[plane] = 100 * np.sqrt(((steady[good] / mean[good]) ** 2).sum()) / good.sum()
    return Quantity(error, std)


def fixed_pattern(
    dark: TemporalStack, flats: Sequence[TemporalStack], saturation: Quantity
) -> tuple[Quantity, Quantity, tuple[tuple[int, int, str], ...], list[str]]:
    """Return the fixed pattern from the mean dark frame and the mean flat frame nearest to half of saturation.

    The variance of the temporal noise that remains in a mean over n frames, its n-th part, is taken out.

    Returns
    -------
    dsnu, prnu : Quantity
        In DN and in %.
    defects : tuple of (int, int, str)
        Row, column and kind of hot and dead pixels.
    warnings : list of str
    """
    dsnu, prnu, defects, textured = [], [], [], []
    for plane, name in enumerate(dark.camera.names):
        excess = dark.mean[plane] - ndimage.median_filter(dark.mean[plane], 5)
        floor = LIMITS.hot_fraction * (dark.camera.white - dark.camera.black[plane])
        hot = excess > max(LIMITS.hot_sigma * float(np.median(np.abs(excess))) / 0.6745, floor)
        dsnu.append(_spread(dark.mean[plane], dark.variance[plane] / dark.count, ~hot))
        flat = min(flats, key=lambda f: abs(float(f.strength[:, plane].mean()) - saturation.value[plane] / 2))
        response, dead = _response(dark, flat, plane, hot)
        if response[0] > LIMITS.max_response_variation:
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
    figures = Quantity(*np.array(dsnu).T), Quantity(*np.array(prnu).T)
    return *figures, tuple(sorted(defects)), [warning] if textured else []


def _response(
    dark: TemporalStack, flat: TemporalStack, plane: int, hot: BoolArray
) -> tuple[tuple[float, float], BoolArray]:
    """Return relative spread of the response with its uncertainty, NaN where it cannot be determined; dead pixels."""
    min_signal = LIMITS.lit_fraction * (flat.camera.white - flat.camera.black[plane])
    signal = flat.mean[plane] - dark.mean[plane]
    local_median = ndimage.median_filter(signal, 5)
    usable = ~hot & ~flat.clipped[plane]
    dead = usable & (signal < LIMITS.dead_fraction * local_median) & (local_median > min_signal)
    level = float(signal[usable].mean()) if usable.any() else 0.0
    if level < min_signal:
        return (np.nan, np.nan), np.zeros_like(dead)
    temporal = flat.variance[plane] / flat.count + dark.variance[plane] / dark.count
    local = np.maximum(ndimage.uniform_filter(signal, 4 * LIMITS.window), 1e-3 * level)
    return _spread(signal / local, temporal / local**2, usable & ~dead), dead


def _spread(mean: AnyArray, temporal: AnyArray, usable: BoolArray) -> tuple[float, float]:
    """Spatial standard deviation about the neighbourhood's mean, temporal noise taken out, and its uncertainty."""
    window = LIMITS.window
    filled = np.where(usable, mean, np.median(mean[usable]))
    smooth = ndimage.uniform_filter(filled, window, mode="nearest")
    inner = (slice(window, -window), slice(window, -window))
    square = ((filled - smooth) ** 2 / (1 - 1 / window**2) - temporal)[inner][usable[inner]]
    variance = float(square.mean(dtype=np.float64))
    # Neighbouring residuals share their mean; the plain standard error is good within a few per cent.
    error = float(square.std(dtype=np.float64)) / np.sqrt(max(square.size, 1))
    value = np.sqrt(max(variance, 0.0))
    return float(value), float(error / (2 * value)) if variance > error else float(np.sqrt(error))


def _checks(
    dark: TemporalStack,
    flats: Sequence[TemporalStack],
    noise: CameraNoise,
    lines: Sequence[_Line],
    saturates_early: BoolArray,
) -> Iterator[Check]:
    """Warn the user of doubts; the limits are chosen where no source is given, and decide on nothing else."""
    planes, black = noise.planes, noise.black_level.value
    for plane in np.flatnonzero(saturates_early).tolist():
        knee = noise.saturation.value[plane]
        yield warning(
            f"plane {planes[plane]}: the variance breaks down at {knee:.0f} DN above black, below the white level: the "
            f"sensor saturates there (white_level {knee + black[plane]:.0f} in the test)"
        )
    if not any(flat.clipped.any() for flat in flats) and not saturates_early.any():
        yield warning("no exposure reached saturation: the full well is that of the stated white level")
    text = (
        f"{100 * dark.zeros:.1f} % of the dark samples are 0: the black level is cut off and the read noise comes out "
        "too small; raise the camera's black level (offset)"
    )
    yield warning(text, dark.zeros, above=0.005)  # of normal noise they lie 2.6 standard deviations above the cut
    drift = max(flat.drift for flat in flats)
    text = f"the lamp's strength differs by {100 * drift:.1f} % within an exposure; it was taken out"
    yield warning(text, drift, above=0.02)
    reach, full_range = max(line.max_mean for line in lines), dark.camera.white - min(dark.camera.black)
    text = f"the brightest exposure reaches {reach:.0f} DN only: expose up to 70 % of the range for a good gain"
    yield warning(text, reach < 0.2 * full_range)  # the relative error of the gain grows as its inverse
    for name, line in zip(planes, lines, strict=True):
        text = (
            f"plane {name}: the variance does not follow a line (departs by {100 * line.max_departure:.1f} %, scatters "
            f"{line.scatter:.1f} times as much as noise): did the target move, or the lamp flicker, between frames?"
        )
        yield warning(text, max(line.scatter / 1.5, line.max_departure / 0.03), above=1)
    # lights that shine together are then the sum of the single ones as `check` allows (`verify.Limits.additivity`);
    # EMVA 1288 defines the figure and sets no limit
    error, limit = np.nan_to_num(noise.linearity_error.value), 0.5
    worst = int(error.argmax())
    text = (
        f"plane {planes[worst]}: the linearity error is {error[worst]:.2f} %, the limit is {limit:g} %: are the "
        "exposure times those of the frames, was the lamp steady? Unmixing needs a linear camera"
    )
    yield warning(text, error[worst], above=limit)
    text = "no linearity error for some plane: it takes three exposure times that reach 5 to 95 % of the range there"
    timed = any(flat.exposure is not None for flat in flats)
    yield warning(text, timed and float(np.isnan(noise.linearity_error.value).any()))
    text = "the gains of the planes differ: the camera applies digital gain per colour; the mean is used"
    yield warning(text, np.ptp(noise.gain.value) / noise.gain.value.mean(), above=0.05)
