"""Checks that a raw frame is of the camera and the lights that were calibrated, from that frame alone.

Every check is one-sided: what a frame does not show, as noise under texture, passes. The constants are measured:
docs/how-to/inspect.md shows which manipulations are found and that good frames pass.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any, get_args

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import erf

from rgbmidic.errors import ConfigurationError, FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic, planes_of
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.illumination.unevenness import SIGNIFICANCE, unevenness
from rgbmidic.settings import FrameCheck
from rgbmidic.typing import BoolArray, FloatArray

Frame = Mosaic | ChannelFrame

LARGEST = 288
"""Side, in samples of a plane, of the middle of the region whose noise is looked at: 4 planes of it in 30 ms."""
FLATTEST, LEVELS = (0.01, 0.05, 0.2), 6
"""Fractions of the places of a grey level whose noise is looked at, those that the other planes show flattest; number
of grey levels. They decide how much is found, not what is right (`_noise`)."""
SHARED = 1.5
"""Variance of the number of small differences over that of independent ones: neighbours share two samples of four."""
PHOTONS = 4.0
"""Variance over that of read noise from which a level is looked at: noise that a row or a column has in common is not
in the differences, so that with as much of it as read noise the count is 1.15 times the predicted one, a warning."""
NEAR = 0.5
"""Differences under this fraction of their predicted standard deviation are counted."""
QUIET, QUIETER = 1.12, 1.25
"""Count of such differences over the predicted one from which the noise is doubtful, and certainly less than
calibrated: a variance .80 and .64 times the calibrated one. Gains are calibrated within 2 % (calibration/README.md)."""
UNEVEN = 0.03
"""Relative variance of the histogram about its smooth course that is too much: good scenes reach .006, real raw frames
without a table of their own .022 above 8 bit; a gain of 1.05 on stored samples gives .05."""
FINE = 1000
"""Grey levels of the full scale, that is 10 bit, from which photon noise exceeds `SMOOTHED` where a sensor is lit: with
a full well of 4,000 electrons it is 8 levels at a third of the scale. 8-bit frames of real cameras reach .23."""
GREENS, GREENS_RATIO = 0.03, 1.5
"""Rms of log(G1/G2) over blocks from which the greens differ, and over that of the two other planes: the greens of good
scenes reach .03 by the texture that each plane samples, the other two planes as much or more."""
BLOCK = 16
"""Side of blocks in px, twice that for the greens."""
NEGATIVE, REACH = 0.005, 0.01
"""A light is negative below minus this fraction of the full scale, on more than this fraction of the blocks."""
MIRRORED = 0.1
"""A light's contrast is mirrored below minus this fraction of the best one's: -.13 in one block of good scenes."""
COMMON = 1.6
"""Variance of the channels' sum over the sum of their variances from which they show one texture (correlation .3)."""
INTERPOLATED = 1.5
"""How many times second differences may depend on the axis, other than in the other planes, or on the place in a 2 x 2
cell: 1.03 in good scenes, 1.8 and more after bilinear interpolation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mismatch:
    """A contradiction between a frame and its calibration.

    Attributes
    ----------
    check : str
        Name of the check, by which `accept` waives it.
    certain : bool
        Whether it cannot be otherwise; else it is doubtful.
    text : str
        What was found and what the calibration states.
    """

    check: FrameCheck
    certain: bool
    text: str


@dataclass(frozen=True, slots=True)
class _Plane:
    name: str
    values: npt.NDArray[np.float32]  # DN above black
    usable: BoolArray
    stored: npt.NDArray[np.uint16]
    black: float
    noise: NoiseModel | None


def check_state(
    state: Sequence[Frame],
    calibration: Calibration,
    inside: BoolArray,
    name: str,
    *,
    accept: Collection[str] = (),
    repeat: Sequence[Frame] | None = None,
) -> tuple[Mismatch, ...]:
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
    tuple of Mismatch
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
    found = [mismatch for frame, again in pairs for mismatch in mismatches(frame, calibration, inside, again)]
    refused = [mismatch for mismatch in found if mismatch.certain and mismatch.check not in accept]
    if refused:
        waived = ", ".join(dict.fromkeys(f'"{mismatch.check}"' for mismatch in refused))
        raise FrameError(
            f"{name} is not what was calibrated: {'; '.join(mismatch.text for mismatch in refused)}. Take the "
            "calibration of this camera and these lights; if all this is meant to be, accept it: calibration.accept = "
            f"[{waived}] (rgbmidic inspect: --accept)"
        )
    return tuple(found)


def mismatches(
    frame: Frame, calibration: Calibration, inside: BoolArray, repeat: Frame | None = None
) -> list[Mismatch]:
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
    list of Mismatch
    """
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    top, left = int(rows[0]) // 2 * 2, int(columns[0]) // 2 * 2  # the pattern stays what it is
    window = slice(top, int(rows[-1]) + 1), slice(left, int(columns[-1]) + 1)
    planes = _planes(frame, calibration, inside, window)
    if min(planes[0].values.shape) < 2 * BLOCK:
        return []
    again = None if repeat is None else _planes(repeat, calibration, inside, window)
    full_scale = frame.white_level - float(frame.black_level.mean())
    bits = int(np.bitwise_or.reduce([np.bitwise_or.reduce(plane.stored, axis=None) for plane in planes]))
    step = bits & -bits or 1  # all samples are multiples of it
    found: list[Mismatch] = []
    if full_scale >= FINE * step or planes[0].noise is not None:  # else noise may be too little to smooth the histogram
        each = [unevenness(plane.stored[plane.usable], plane.noise, plane.black, step) for plane in planes]
        uneven = float(np.nanmax([0.0, *each]))
        calibrated = calibration.unevenness
        # some cameras have tables of their own, which their captures show too
        if calibrated is not None and calibrated <= UNEVEN < uneven:
            text = (
                f"grey levels of {planes[int(np.nanargmax(each))].name} are missing or doubled (relative variance of "
                f"their histogram {uneven:.2g}, in the captures of the calibration {calibrated:.2g}): a gain, white "
                "balance, gamma or 8-bit table was applied to stored samples"
            )
            found.append(Mismatch(check="levels", certain=True, text=text))
        if uneven <= UNEVEN:  # the count of small differences wants samples that take any whole value
            found += _noise(planes, again, step)
    if len(planes) == 4:
        found += _greens(planes)
    if len(planes) > 1:
        found += _interpolated(planes)
    if len(planes) > 1 and calibration.crosstalk is not None:
        found += _lights(planes, calibration.crosstalk, full_scale, (left, top))
    return found


def _planes(frame: Frame, calibration: Calibration, inside: BoolArray, window: tuple[slice, slice]) -> list[_Plane]:
    """Cut the colour planes in a window out of the frame."""
    step = 2 if isinstance(frame, Mosaic) else 1
    names, stored, black = planes_of(replace(frame, values=frame.values[..., *window]))
    height, width = stored[0].shape
    inner = inside[window][: step * height : step, : step * width : step]
    noise = dict.fromkeys("RGBM", calibration.noise)
    if (figures := calibration.camera_noise) is not None:  # of a colour, since cropping exchanges the greens
        for colour in {name[0] for name in figures.planes}:
            same = [index for index, name in enumerate(figures.planes) if name[0] == colour]
            gain, read_noise = figures.gain.value[same].mean(), figures.read_noise.value[same].mean()
            noise[colour] = NoiseModel(gain=float(gain), read_noise=float(read_noise))
    return [
        _Plane(
            name=name,
            values=plane.astype(np.float32) - np.float32(level),
            usable=inner & (plane < frame.white_level) & (plane > 0),
            stored=plane,
            black=float(level),
            noise=noise[name[0]],
        )
        for name, plane, level in zip(names, stored, black, strict=True)
    ]


def _noise(planes: Sequence[_Plane], repeat: Sequence[_Plane] | None, step: int) -> Iterator[Mismatch]:
    """Report noise that is not on the photon transfer line of the calibration, at some grey level of some plane.

    Differences ``a - b - c + d`` of four neighbours in a plane hold four times the variance of a sample, and texture.
    What is added to noise only makes small differences rarer (Anderson's inequality: the noise is symmetric, with one
    peak), wherever they are counted, so more small ones than the calibrated noise gives prove that there is less of it.
    They are counted where the other planes are flattest, whose noise is independent. More noise than calibrated looks
    like texture in a single frame; in the difference to a `repeat` of the same state it is doubtful.
    """
    if any(plane.noise is None for plane in planes):
        return
    if repeat and all(np.array_equal(a.stored, b.stored) for a, b in zip(planes, repeat, strict=True)):
        return  # one frame, stored twice
    difference, mean, variance, usable = _differences(planes)
    square = difference**2 / variance
    if len(planes) > 1:
        flatness = square.sum(axis=0) - square
    else:  # around each place of the only plane, of differences that share no sample with its own
        flatness = np.full_like(square, np.inf)
        flatness[:, 2:-2, 2:-2] = (
            square[:, :-4, 2:-2] + square[:, 4:, 2:-2] + square[:, 2:-2, :-4] + square[:, 2:-2, 4:]
        )
    if repeat:
        again, _, more, clear = _differences(repeat)
        difference, variance, usable = difference - again, variance + more, usable & clear
    usable &= np.isfinite(flatness).all(axis=0)
    if usable.sum() < 1000:
        return
    counts = np.stack(
        [
            _small_differences(a[usable], b[usable], c[usable], d[usable], step)
            for a, b, c, d in zip(difference, mean, variance, flatness, strict=True)
        ]
    )
    # of every colour and of all, at every grey level and at all
    counts = np.concatenate([counts, counts.sum(axis=0, keepdims=True)])
    counts = np.concatenate([counts, counts.sum(axis=1, keepdims=True)], axis=1)
    count, expected, chance, level, deviation, places = np.moveaxis(counts, -1, 0)
    beyond = (count - expected) / (SIGNIFICANCE * np.sqrt(SHARED * np.maximum(chance, 1e-9)))
    ratio = np.divide(count, expected, out=np.ones_like(count), where=(beyond > 1) | ((beyond < -1) & bool(repeat)))
    for where, doubtful in ((int(ratio.argmax()), QUIET), (int(ratio.argmin()), 1 / QUIET)):
        at = np.unravel_index(where, ratio.shape)
        if ratio[at] > doubtful > 1 or ratio[at] < doubtful < 1:
            name = [*(plane.name for plane in planes), "all colours"][at[0]]
            calibrated = deviation[at] / places[at] / np.sqrt(2 if repeat else 1)
            other = "" if ratio[at] > 1 else ", motion between the two frames"
            yield Mismatch(
                check="noise",
                certain=bool(ratio[at] > QUIETER),
                text=f"the noise of {name} at {level[at] / places[at]:.0f} DN above black is "
                f"{calibrated / ratio[at]:.2g} DN{'' if repeat else ' or less'}, the calibration states "
                f"{calibrated:.2g} DN (another camera or gain, gamma, noise reduction, interpolated samples, black "
                f"level{other}?)",
            )


def _small_differences(
    difference: npt.NDArray[Any],
    mean: npt.NDArray[Any],
    variance: npt.NDArray[Any],
    flatness: npt.NDArray[Any],
    step: int,
) -> FloatArray:
    """Count small differences in a plane, by grey level and by how flat the others are, (LEVELS, len(FLATTEST), 6).

    The six are their number, the number that the calibrated noise gives, the variance of that number, the sums of means
    and of predicted standard deviations of a sample, and the number of places.
    """
    out = np.zeros((LEVELS, len(FLATTEST), 6))
    bins = np.searchsorted(np.quantile(mean, np.linspace(0, 1, LEVELS + 1)[1:-1]), mean)
    for level in range(LEVELS):
        inside = np.flatnonzero(bins == level)
        inside = inside[np.argsort(flatness[inside])][: int(np.ceil(max(FLATTEST) * inside.size))]
        deviation = np.sqrt(variance[inside])
        limit = step * (np.floor(NEAR * deviation / step) + 0.5)  # differences are multiples of the step
        expected = erf(limit / deviation / np.sqrt(2))
        near = np.abs(difference[inside]) < limit
        columns = (near, expected, expected * (1 - expected), mean[inside], deviation / 2, np.ones(inside.size))
        for index, fraction in enumerate(FLATTEST):
            few = int(inside.size * fraction / max(FLATTEST))
            out[level, index] = [column[:few].sum() for column in columns]
    return out


def _middle(planes: Sequence[_Plane]) -> tuple[slice, ...]:
    """Return at most LARGEST x LARGEST samples in the middle; they begin at even ones."""
    return tuple(slice(max(side - LARGEST, 0) // 4 * 2, (side + LARGEST) // 2) for side in planes[0].values.shape)


def _differences(planes: Sequence[_Plane]) -> tuple[npt.NDArray[Any], ...]:
    """Return differences of 2 x 2 samples, means, the predicted variance (P, h, w), and where to use them."""
    middle = _middle(planes)
    x = np.stack([plane.values[middle] for plane in planes])
    usable = np.logical_and.reduce([plane.usable[middle] for plane in planes])
    a, b, c, d = x[:, :-1, :-1], x[:, :-1, 1:], x[:, 1:, :-1], x[:, 1:, 1:]
    mean = (a + b + c + d) / 4
    models = [plane.noise for plane in planes if plane.noise is not None]
    variance = np.stack([4 * model.variance(level) for model, level in zip(models, mean, strict=True)])
    whole = usable[:-1, :-1] & usable[:-1, 1:] & usable[1:, :-1] & usable[1:, 1:]
    for model, part in zip(models, variance, strict=True):
        whole &= part > 4 * PHOTONS * model.read_noise**2
    return a - b - c + d, mean, variance.astype(np.float32), whole


def _block_means(values: npt.NDArray[np.float32], side: int) -> FloatArray:
    """Average (h, w) over blocks of `side` samples; a border that does not fill a block is left out."""
    rows, columns = (length // side for length in values.shape)
    cut = values[: rows * side, : columns * side]
    return np.asarray(cv2.resize(cut, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.float64)


def _whole_blocks(planes: Sequence[_Plane], side: int) -> BoolArray:
    """Return the blocks of `side` samples that are usable in all planes."""
    usable = np.logical_and.reduce([plane.usable for plane in planes])
    return np.asarray(_block_means(usable.astype(np.float32), side) == 1)


def _greens(planes: Sequence[_Plane]) -> Iterator[Mismatch]:
    """Report greens that differ from place to place while the other planes agree: another phase of the pattern."""
    means = [_block_means(plane.values, BLOCK) for plane in planes]
    clear = _whole_blocks(planes, BLOCK)
    clear &= np.min(means, axis=0) > 0
    if clear.sum() < 36:  # a rms of 36 is known to 12 %
        return
    red, first, second, blue = (np.log(mean[clear]) for mean in means)
    greens, others = (float(np.sqrt((pair**2).mean())) for pair in (first - second, red - blue))
    if greens > GREENS and greens > GREENS_RATIO * others:
        yield Mismatch(
            check="greens",
            certain=True,
            text=f"the two greens of the pattern differ by {greens:.1%} (rms of blocks of {2 * BLOCK} px), red and "
            f"blue by {others:.1%}: the pattern or its phase is not that of the calibration",
        )


def _lights(
    planes: Sequence[_Plane], crosstalk: Crosstalk, full_scale: float, origin: tuple[int, int]
) -> Iterator[Mismatch]:
    """Report lights that the calibrated crosstalk makes negative, or shows with a mirrored texture."""
    mosaic = len(planes) == 4
    side = BLOCK // 2 if mosaic else BLOCK
    red, *greens, blue = (plane.values for plane in planes)
    channels: list[npt.NDArray[Any]] = [red, (greens[0] + greens[-1]) / 2, blue]
    usable = _whole_blocks(planes, side)
    mean = np.stack([_block_means(channel, side) for channel in channels])
    if usable.sum() < 36 or crosstalk.matrix.shape[0] != 3:
        return
    texture = channels[0] + channels[1] + channels[2]
    spread = np.stack([_block_means(channel * texture, side) for channel in channels])
    spread -= mean * _block_means(texture, side)
    own = np.stack([_block_means(channel**2, side) for channel in channels]) - mean**2
    common = float(np.median((spread.sum(axis=0) / np.maximum(own.sum(axis=0), 1e-9))[usable]))  # 1 to 3
    y, x = (BLOCK * (np.arange(count) + 0.5) for count in usable.shape)
    unmixing = crosstalk.unmixing_at(np.stack(np.meshgrid(x, y), axis=-1) + origin)
    level, slope = (np.einsum("yxkc,cyx->kyx", unmixing, part) for part in (mean, spread))
    contrast = slope / np.maximum(level, NEGATIVE * full_scale)
    best = contrast.max(axis=0)
    for name, light, relative in zip(crosstalk.lights, level, contrast, strict=True):
        negative = float((light < -NEGATIVE * full_scale)[usable].mean())
        mirrored = float((relative < -MIRRORED * best)[usable].mean()) if common > COMMON else 0.0
        if max(negative, mirrored) > REACH:
            what = f"mirrored (dark for bright) on {mirrored:.0%}"
            what = f"negative on {negative:.0%}" if negative > REACH else what
            yield Mismatch(
                check="lights",
                certain=True,
                text=f"light {name} is {what} of the region after unmixing: crosstalk, pattern or black level of the "
                "calibration are not those of this frame",
            )


def _interpolated(planes: Sequence[_Plane]) -> Iterator[Mismatch]:
    """Report samples that were interpolated from a mosaic: smoother along one axis, or at some places of a 2 x 2 cell.

    In a plane of a mosaic, interpolated by another phase of the pattern, mean square second over mean square first
    differences depend on the axis other than in the planes beside it, which show the same texture; in channels that are
    there at every pixel, second differences depend on the place in the cell.

    References
    ----------
    A. C. Gallagher, T. Chen, Image authentication by detecting traces of demosaicing, CVPR workshops (2008).
    """
    ratios: list[float] = []
    middle = _middle(planes)
    for plane in planes:
        x, usable = plane.values[middle], plane.usable[middle]
        across, along = (_curvature(axis(x), axis(usable)) for axis in (np.asarray, np.transpose))
        if across is None or along is None:
            return
        energy = (across[0] + along[0].T).ravel()
        ratios.append(across[1] / along[1] if len(planes) == 4 else energy.max() / energy.min())
    relative = np.array(ratios) / (min(ratios) if len(planes) == 4 else 1.0)
    worst = int(np.argmax(relative))
    if relative[worst] > INTERPOLATED:
        yield Mismatch(
            check="demosaiced",
            certain=True,
            text=f"samples of {planes[worst].name} are interpolated from those of a colour mosaic: their second "
            f"differences depend {relative[worst]:.2g} times on the axis or the place in a 2 x 2 cell",
        )


def _curvature(x: npt.NDArray[np.float32], usable: BoolArray) -> tuple[FloatArray, float] | None:
    """Return the mean square second difference along rows at each place of a 2 x 2 cell, and its ratio to the first.

    None where too few samples are usable, or do not vary.
    """
    clear = usable[:, :-2] & usable[:, 1:-1] & usable[:, 2:]
    if clear.sum() < 4000:
        return None
    second = np.where(clear, x[:, :-2] - 2 * x[:, 1:-1] + x[:, 2:], 0)
    first = np.where(clear, x[:, 2:] - x[:, :-2], 0)
    places = [[(second[p::2, q::2] ** 2).sum() / clear[p::2, q::2].sum() for q in (1, 0)] for p in (0, 1)]
    energy = float((second**2).sum()), float((first**2).sum())
    return (np.array(places), energy[0] / energy[1]) if min(places[0] + places[1]) > 0 and energy[1] > 0 else None
