"""Checks that a raw frame is of the camera and the lights that were calibrated, from that frame alone.

Every check is one-sided: what a frame does not show, as noise under texture, passes. The constants are measured:
docs/how-to/inspect.md shows which manipulations are found and that good frames pass.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import zip_longest
from typing import Any, get_args

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import erf

from rgbmidic.errors import ConfigurationError, FrameError
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.checks import Check, refused, reported, warning
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.plane_samples import SIGNIFICANCE, Frame, PlaneSamples, unevenness
from rgbmidic.settings import FrameCheck
from rgbmidic.typing import BoolArray, FloatArray

BLOCK = 16
"""Side of blocks in px, twice that for the greens."""


def check_state(
    state: Sequence[Frame],
    calibration: Calibration,
    inside: BoolArray,
    name: str,
    *,
    accept: Collection[str] = (),
    repeat: Sequence[Frame] | None = None,
) -> tuple[Check, ...]:
    """Refuse a state whose frames contradict their calibration.

    Parameters
    ----------
    state
        A raw frame, or one per light fired in succession.
    calibration
        Cropped to the frame.
    inside : ndarray, shape (H, W), bool
        The region.
    name
        What messages call the state.
    accept
        Names of checks whose contradictions are accepted.
    repeat
        The same state once more, where there are two frames of it.

    Returns
    -------
    tuple of Check
        What is doubtful, and contradictions that are accepted.

    Raises
    ------
    FrameError
        A contradiction that is certain and not accepted.
    ConfigurationError
        `accept` names no check.
    """
    if unknown := set(accept) - set(get_args(FrameCheck)):
        raise ConfigurationError(f"accept takes {', '.join(get_args(FrameCheck))}, not {', '.join(sorted(unknown))}")
    pairs = zip_longest(state, repeat or ())
    checks = tuple(
        check for frame, repeat_frame in pairs for check in contradictions(frame, calibration, inside, repeat_frame)
    )
    if wrong := refused(checks, accept):
        names = ", ".join(dict.fromkeys(f'"{check.name}"' for check in wrong))
        raise FrameError(
            f"{name} is not what was calibrated: {'; '.join(check.text for check in wrong)}. Take the calibration of "
            "this camera and these lights; if all this is meant to be, accept it: calibration.accept = "
            f"[{names}] (`rgbmidic inspect --accept`)"
        )
    return checks


def contradictions(
    frame: Frame, calibration: Calibration, inside: BoolArray, repeat: Frame | None = None
) -> list[Check]:
    """Find all that contradicts the calibration in the region `inside` of a raw frame.

    Parameters
    ----------
    frame
        A raw frame.
    calibration
        Cropped to the frame.
    inside : ndarray, shape (H, W), bool
        The region.
    repeat
        The same state once more, at rest, which shows the noise without the texture; if it moved, its texture differs
        and only too little noise is found.

    Returns
    -------
    list of Check
        Those that fail: it cannot be otherwise; and those that are doubtful.
    """
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    top, left = int(rows[0]) // 2 * 2, int(columns[0]) // 2 * 2  # the pattern stays what it is
    window = slice(top, int(rows[-1]) + 1), slice(left, int(columns[-1]) + 1)
    samples = PlaneSamples.of(frame, calibration, inside, window)
    if min(samples.stored.shape[1:]) < 2 * BLOCK:
        return []
    repeat_samples = None if repeat is None else PlaneSamples.of(repeat, calibration, inside, window)
    full_scale = frame.white_level - float(frame.black_level.mean())
    checks = list(_levels(samples, repeat_samples, calibration.unevenness, full_scale))
    if len(samples.names) == 4:
        checks += _greens(samples)
    if len(samples.names) > 1:
        checks += _interpolated(samples)
        if calibration.crosstalk is not None:
            checks += _lights(samples, calibration.crosstalk, full_scale, (left, top))
            checks += _red_and_blue(samples, calibration.crosstalk)
    return reported(checks)


def _levels(
    samples: PlaneSamples, repeat_samples: PlaneSamples | None, calibrated: float | None, full_scale: float
) -> Iterator[Check]:
    """Check the histogram of the grey levels for levels that are missing or doubled, and where none are, the noise.

    From 1000 levels of the full scale on, that is 10 bit, photon noise exceeds `SMOOTHED` where a sensor is
    lit: with a full well of 4,000 electrons it is 8 levels at a third of the scale. 8-bit frames of real cameras reach
    an unevenness of .23, others without a table of their own .022, good scenes .006; a gain of 1.05 gives .05.
    """
    limit = 0.03
    bits = int(np.bitwise_or.reduce(samples.stored, axis=None))
    step = bits & -bits or 1  # all samples are multiples of it
    if full_scale < 1000 * step and samples.noise[0] is None:  # noise may be too little to smooth the histogram
        return
    planes = zip(samples.stored, samples.usable, samples.noise, samples.black.tolist(), strict=True)
    by_plane = [unevenness(stored[usable], noise, black, step) for stored, usable, noise, black in planes]
    uneven = float(np.nanmax([0.0, *by_plane]))
    # some cameras have tables of their own, which their captures show too
    if uneven > limit and calibrated is not None and calibrated <= limit:
        text = (
            f"grey levels of {samples.names[int(np.nanargmax(by_plane))]} are missing or doubled (relative variance of "
            f"their histogram {uneven:.2g}, in the captures of the calibration {calibrated:.2g}): a gain, white "
            "balance, gamma or 8-bit table was applied to stored samples"
        )
        yield Check("levels", text, uneven, limit)
    if uneven <= limit:  # the count of small differences wants samples that take any whole value
        yield from _noise(samples, repeat_samples, step)


def _noise(samples: PlaneSamples, repeat: PlaneSamples | None, step: int) -> Iterator[Check]:
    """Check that the noise is on the photon transfer line of the calibration, at each grey level of each plane.

    Differences ``a - b - c + d`` of four neighbours in a plane hold four times the variance of a sample, and texture.
    What is added to noise only makes small differences rarer (Anderson's inequality: the noise is symmetric, with one
    peak), wherever they are counted, so more small ones than the calibrated noise gives prove that there is less of it.
    They are counted where the other planes are flattest, whose noise is independent. More noise than calibrated looks
    like texture in a single frame; in the difference to a `repeat` of the same state it is doubtful.

    The count over the predicted one is doubtful from 1.12 on and certainly too large from 1.25, a variance .80 and .64
    times the calibrated one; gains are calibrated within 2 % (calibration/README.md).
    """
    if None in samples.noise or (repeat and np.array_equal(samples.stored, repeat.stored)):
        return  # not known, or one frame, stored twice
    difference, mean, variance, usable = _differences(samples)
    square = difference**2 / variance
    if len(samples.names) > 1:
        flatness = square.sum(axis=0) - square
    else:  # around each place of the only plane, of differences that share no sample with its own
        flatness = np.full_like(square, np.inf)
        flatness[:, 2:-2, 2:-2] = (
            square[:, :-4, 2:-2] + square[:, 4:, 2:-2] + square[:, 2:-2, :-4] + square[:, 2:-2, 4:]
        )
    if repeat:
        repeat_difference, _, repeat_variance, repeat_usable = _differences(repeat)
        difference, variance = difference - repeat_difference, variance + repeat_variance
        usable = usable & repeat_usable
    usable &= np.isfinite(flatness).all(axis=0)
    if usable.sum() < 1000:
        return
    planes = np.stack([difference, mean, variance, flatness], axis=1)[..., usable]
    counts = np.stack([_small_differences(plane, step) for plane in planes])
    # of every colour and of all, at every grey level and at all
    counts = np.concatenate([counts, counts.sum(axis=0, keepdims=True)])
    counts = np.concatenate([counts, counts.sum(axis=1, keepdims=True)], axis=1)
    count, expected, chance, level, deviation, n_differences = np.moveaxis(counts, -1, 0)
    shared = 1.5  # variance of the count over that of independent differences: neighbours share two samples of four
    score = (count - expected) / (SIGNIFICANCE * np.sqrt(shared * np.maximum(chance, 1e-9)))
    ratio = np.divide(count, expected, out=np.ones_like(count), where=(score > 1) | ((score < -1) & bool(repeat)))
    for excess, limit, motion in ((ratio, 1.25, ""), (1 / ratio, np.inf, ", motion between the two frames")):
        at = np.unravel_index(excess.argmax(), excess.shape)
        if excess[at] <= 1:
            continue
        name = [*samples.names, "all colours"][at[0]]
        calibrated = deviation[at] / n_differences[at] / np.sqrt(2 if repeat else 1)
        text = (
            f"the noise of {name} at {level[at] / n_differences[at]:.0f} DN above black is "
            f"{calibrated / ratio[at]:.2g} DN{'' if repeat else ' or less'}, the calibration states {calibrated:.2g} "
            f"DN (another camera or gain, gamma, noise reduction, interpolated samples, black level{motion}?)"
        )
        yield Check("noise", text, float(excess[at]), limit, doubtful=1.12)


_FLATTEST = 0.01, 0.05, 0.2
"""Fractions of the places of a grey level whose noise is looked at, those that the other planes show flattest. They
decide how much is found, not what is right (`_noise`)."""


def _small_differences(plane: npt.NDArray[Any], step: int) -> FloatArray:
    """Count small differences in a plane, by grey level and by how flat the others are, (levels, len(_FLATTEST), 6).

    Of each place the `plane` holds the difference, the mean, the predicted variance, and how flat the others are. Small
    are differences under half their predicted standard deviation. The six are their number, the number that the
    calibrated noise gives, the variance of that number, the sums of means and of predicted standard deviations of a
    sample, and the number of places.
    """
    difference, mean, variance, flatness = plane
    levels = 6
    out = np.zeros((levels, len(_FLATTEST), 6))
    bins = np.searchsorted(np.quantile(mean, np.linspace(0, 1, levels + 1)[1:-1]), mean)
    for level in range(levels):
        inside = np.flatnonzero(bins == level)
        inside = inside[np.argsort(flatness[inside])][: int(np.ceil(max(_FLATTEST) * inside.size))]
        deviation = np.sqrt(variance[inside])
        limit = step * (np.floor(0.5 * deviation / step) + 0.5)  # differences are multiples of the step
        expected = erf(limit / deviation / np.sqrt(2))
        near = np.abs(difference[inside]) < limit
        columns = (near, expected, expected * (1 - expected), mean[inside], deviation / 2, np.ones(inside.size))
        for index, fraction in enumerate(_FLATTEST):
            n_flattest = int(inside.size * fraction / max(_FLATTEST))
            out[level, index] = [column[:n_flattest].sum() for column in columns]
    return out


def _differences(samples: PlaneSamples) -> tuple[npt.NDArray[Any], ...]:
    """Return differences of 2 x 2 samples, means, the predicted variance (P, h, w), and where to use them.

    Noise that a row or a column has in common is not in the differences. With as much of it as read noise the count of
    small ones is 1.15 times the predicted one, a warning; hence levels of at least 4 times that variance.
    """
    x, usable = samples.values[:, *samples.middle], np.logical_and.reduce(samples.usable[:, *samples.middle])
    a, b, c, d = x[:, :-1, :-1], x[:, :-1, 1:], x[:, 1:, :-1], x[:, 1:, 1:]
    mean = (a + b + c + d) / 4
    complete = usable[:-1, :-1] & usable[:-1, 1:] & usable[1:, :-1] & usable[1:, 1:]
    variance = np.empty_like(mean)
    for plane, model in enumerate(filter(None, samples.noise)):
        exact = 4 * model.variance(mean[plane])
        complete &= exact > 4 * 4 * model.read_noise**2
        variance[plane] = exact
    return a - b - c + d, mean, variance, complete


def _block_means(values: npt.NDArray[np.float32], side: int) -> FloatArray:
    """Average (P, h, w) over blocks of `side` samples; a border that does not fill a block is left out."""
    rows, columns = (length // side for length in values.shape[1:])
    cut = values[:, : rows * side, : columns * side]
    means = [cv2.resize(plane, (columns, rows), interpolation=cv2.INTER_AREA) for plane in cut]
    return np.asarray(means, dtype=np.float64)


def _whole_blocks(samples: PlaneSamples, side: int) -> BoolArray:
    """Return the blocks of `side` samples that are usable in all planes."""
    return np.asarray(_block_means(np.logical_and.reduce(samples.usable)[None].astype(np.float32), side)[0] == 1)


def _greens(samples: PlaneSamples) -> Iterator[Check]:
    """Check that the greens agree from place to place as the other planes do: else the pattern has another phase.

    The greens of good scenes reach a rms of log(G1/G2) of .03 by the texture that each plane samples, the other two
    planes as much or more.
    """
    means = _block_means(samples.values, BLOCK)
    clear = _whole_blocks(samples, BLOCK) & (means.min(axis=0) > 0)
    if clear.sum() < 36:  # a rms of 36 is known to 12 %
        return
    red, first, second, blue = (np.log(mean[clear]) for mean in means)
    greens, red_blue = (float(np.sqrt((pair**2).mean())) for pair in (first - second, red - blue))
    text = (
        f"the two greens of the pattern differ by {greens:.1%} (rms of blocks of {2 * BLOCK} px), red and blue by "
        f"{red_blue:.1%}: the pattern or its phase is not that of the calibration"
    )
    yield Check("greens", text, greens, max(0.03, 1.5 * red_blue))


def _lights(samples: PlaneSamples, crosstalk: Crosstalk, full_scale: float, origin: tuple[int, int]) -> Iterator[Check]:
    """Check that no light is negative after unmixing, or shows a mirrored texture, on more than 1 % of the blocks.

    A contrast counts as mirrored below -.1 of the best light's: in one block of good scenes it is -.13. It needs one
    texture in all channels: a variance of their sum over the sum of their variances of 1.6 (correlation .3).
    """
    negligible = 0.005 * full_scale
    side = BLOCK // 2 if len(samples.names) == 4 else BLOCK
    red, *greens, blue = samples.values
    channels = np.stack([red, (greens[0] + greens[-1]) / 2, blue])
    usable = _whole_blocks(samples, side)
    if usable.sum() < 36 or crosstalk.matrix.shape[0] != 3:
        return
    mean = _block_means(channels, side)
    texture = channels[0] + channels[1] + channels[2]
    spread = _block_means(channels * texture, side) - mean * _block_means(texture[None], side)
    channel_variance = _block_means(channels**2, side) - mean**2
    common = float(np.median((spread.sum(axis=0) / np.maximum(channel_variance.sum(axis=0), 1e-9))[usable]))  # 1 to 3
    y, x = (BLOCK * (np.arange(count) + 0.5) for count in usable.shape)
    unmixing = crosstalk.unmixing_at(np.stack(np.meshgrid(x, y), axis=-1) + origin)
    level, slope = (np.einsum("yxkc,cyx->kyx", unmixing, channel_blocks) for channel_blocks in (mean, spread))
    contrast = slope / np.maximum(level, negligible)
    best = contrast.max(axis=0)
    for name, light, relative in zip(crosstalk.lights, level, contrast, strict=True):
        limit = 0.01
        negative = float((light < -negligible)[usable].mean())
        mirrored = float((relative < -0.1 * best)[usable].mean()) if common > 1.6 else 0.0
        defect = f"negative on {negative:.0%}" if negative > limit else f"mirrored (dark for bright) on {mirrored:.0%}"
        text = (
            f"light {name} is {defect} of the region after unmixing: crosstalk, pattern or black level of the "
            "calibration are not those of this frame"
        )
        yield Check("lights", text, max(negative, mirrored), limit)


_LIGHT_LEVELS, _GREENS = np.log(1.3), 0.002
"""Scatter of the ratio of two lamps between calibration and test, and of the greens' difference over their mean with
the lens: 1.3 is what lamps that were not touched may drift and a target may be coloured; .002 is a seventh of what the
greens of an ICX655 differ by in red light."""


def _red_and_blue(samples: PlaneSamples, crosstalk: Crosstalk) -> Iterator[Check]:
    """Check that red and blue are not exchanged, as by a window of the sensor that is moved by one row and one column.

    The greens in rows with red and those in rows with blue are exchanged, too: their difference, where it is
    calibrated, and the levels of the lights relative to those in the captures are compared with what is expected then.
    Squares of the departures over their scatter show which fits: 9 less is doubtful, of the greens 36 certain.
    """
    mosaic, lights = len(samples.names) == 4, crosstalk.lights
    if crosstalk.matrix.shape[0] != 3 or len(samples.names) not in (3, 4):
        return
    means = _block_means(samples.values, BLOCK)
    clear = _whole_blocks(samples, BLOCK) & (means.min(axis=0) > 0)
    if clear.sum() < 36:
        return
    red, *greens, blue = means[:, clear]
    first, last = greens[0], greens[-1]
    channels = np.array([red.mean(), (first.mean() + last.mean()) / 2, blue.mean()])
    direct_levels, exchanged_levels = (crosstalk.unmixing @ levels for levels in (channels, channels[::-1]))
    text = (
        "{} than if red and blue were exchanged, as where the window of the sensor (offset, crop, region of interest) "
        "begins one row and one column beside that of the calibration: compare their offsets, or state the pattern "
        "(frames.cfa)"
    )
    better = 0.0

    def fits_better(direct: float, swapped: float, scatter: float) -> float:
        """Return by how much the squared departure `swapped` is less than `direct`; 0 where neither fits."""
        return (
            float((direct**2 - swapped**2) / scatter**2)
            if abs(swapped) < 3 * scatter or abs(direct) < abs(swapped)
            else 0.0
        )

    if mosaic and crosstalk.green_difference is not None:
        sign = 1.0 if samples.red_row == 0 else -1.0
        relative = sign * (first - last) / channels[1]
        std = 0.0 if crosstalk.green_difference_std is None else crosstalk.green_difference_std @ np.abs(direct_levels)
        scatter = np.sqrt(relative.var() / relative.size + (std / channels[1]) ** 2 + _GREENS**2)
        direct, swapped = (
            crosstalk.green_difference @ levels / channels[1] for levels in (direct_levels, exchanged_levels)
        )
        better = fits_better(relative.mean() - direct, relative.mean() + swapped, scatter)
        observation = (
            f"the greens in rows with red exceed those in rows with blue by {relative.mean():.2%}, calibrated "
        )
        yield Check(
            "greens", text.format(f"{observation}are {direct:.2%}: less probable"), max(better, 0.0), 36.0, doubtful=9.0
        )
    if crosstalk.light_levels is None or better < -9 or min(*direct_levels, *exchanged_levels) <= 0 or len(lights) != 3:
        return
    order = np.argmax(crosstalk.matrix, axis=0)
    ends = int(np.argmin(order)), int(np.argmax(order))
    if (order[ends[0]], order[ends[1]]) != (0, 2):
        return
    calibrated, direct, swapped = (
        np.log(levels[ends[0]] / levels[ends[1]])
        for levels in (crosstalk.light_levels, direct_levels, exchanged_levels)
    )
    better = fits_better(direct - calibrated, swapped - calibrated, _LIGHT_LEVELS)
    observation = (
        f"light {lights[ends[0]]} is {np.exp(direct):.2g} times as strong as light {lights[ends[1]]}, in the captures "
        f"of the calibration {np.exp(calibrated):.2g} times: less probable"
    )
    yield warning(text.format(observation), max(better, 0.0), above=9.0)


def _interpolated(samples: PlaneSamples) -> Iterator[Check]:
    """Check for samples interpolated from a mosaic: smoother along one axis, or at some places of a 2 x 2 cell.

    In a plane of a mosaic interpolated by another phase of the pattern samples are means of neighbours along one axis,
    which leaves nothing of the highest frequency there: of white noise, mean square sixth over mean square fourth
    differences are then 1.4 times as large along the other axis (derived). Over those of the planes beside it they
    depend on the axis 1.06 times in good scenes, 1.17 times at most under streaks of a reflection and in files of two
    cameras that compress, 1.41 times and more after interpolation (measured). In channels that are there at every
    pixel, second differences depend on the place in the cell: 1.03 times in good scenes, 1.8 times and more after
    bilinear interpolation.

    References
    ----------
    A. C. Gallagher, T. Chen, Image authentication by detecting traces of demosaicing, CVPR workshops (2008).
    """
    mosaic = len(samples.names) == 4
    ratios: list[float] = []
    for x, usable in zip(samples.values[:, *samples.middle], samples.usable[:, *samples.middle], strict=True):
        of_axis = _high_frequencies if mosaic else _curvature
        across, along = (of_axis(axis(x), axis(usable)) for axis in (np.asarray, np.transpose))
        if across is None or along is None:
            return
        energy = (across + along.T).ravel()
        ratios.append(float(across / along) if mosaic else energy.max() / energy.min())
    relative = np.array(ratios) / (min(ratios) if mosaic else 1.0)
    worst = int(np.argmax(relative))
    text = (
        f"samples of {samples.names[worst]} are interpolated from those of a colour mosaic: their differences depend "
        f"{relative[worst]:.2g} times on the axis or the place in a 2 x 2 cell"
    )
    yield Check("demosaiced", text, float(np.nan_to_num(relative[worst])), 1.28 if mosaic else 1.5)


def _high_frequencies(x: npt.NDArray[np.float32], usable: BoolArray) -> FloatArray | None:
    """Return the mean square sixth over the mean square fourth difference along rows.

    None where too few samples are usable, or do not vary.
    """
    energy = []
    for order in (4, 6):
        clear = np.lib.stride_tricks.sliding_window_view(usable, order + 1, axis=1).all(axis=-1)
        if clear.sum() < 4000:
            return None
        energy.append((np.diff(x.astype(np.float64), order)[clear] ** 2).mean())
    return np.asarray(energy[1] / energy[0]) if energy[0] > 0 else None


def _curvature(x: npt.NDArray[np.float32], usable: BoolArray) -> FloatArray | None:
    """Return the mean square second difference along rows at each place of a 2 x 2 cell.

    None where too few samples are usable, or do not vary.
    """
    clear = usable[:, :-2] & usable[:, 1:-1] & usable[:, 2:]
    if clear.sum() < 4000:
        return None
    second = np.where(clear, x[:, :-2] - 2 * x[:, 1:-1] + x[:, 2:], 0)
    mean_squares = [[(second[p::2, q::2] ** 2).sum() / clear[p::2, q::2].sum() for q in (1, 0)] for p in (0, 1)]
    return np.array(mean_squares) if min(mean_squares[0] + mean_squares[1]) > 0 else None
