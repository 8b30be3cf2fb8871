"""Histories of probes: displacements of nodes over the frames, rates; and the paper's high-pass filter.

Velocity and acceleration where motion may set in at any frame come from local polynomials within the pieces of a
series. A series is cut into pieces, each a polynomial of the times within its noise, which is known; all ways to cut it
count by their probability (Fearnhead, Stat Comput 16, 2006). Around every frame polynomials are fitted to a window
(Savitzky and Golay, Anal Chem 36, 1964) that does not leave the piece; the mean over pieces and degrees is the rate.
Its uncertainty is that of the mean in noise, and the spread of what it was taken over (Hoeting et al, Stat Sci 14,
1999). Times need not be even; frames that are lost or without data are left out. The noise of the reference, which all
frames have in common, cancels.

`high_pass` is the fine part of a displacement field (paper, section 2.2): the field less its wide Gaussian filter.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.rates import LOWEST, mean_rates
from rgbmidic.arguments import checked
from rgbmidic.errors import InputError
from rgbmidic.field import Displacement, Field
from rgbmidic.typing import BoolArray, FloatArray, IntArray

SIGMA = 40.0
"""Standard deviation (px) of the paper's Gaussian filter."""


def of_probe(probe: str, quantities: Iterable[Field], note: str = "") -> list[Field]:
    """Return what a probe measures over the frames, named by the probe and the quantity, with one note."""
    return [replace(field, name=f"{probe}_{field.name}", dims=("frame",), note=note) for field in quantities]


class Probe(Protocol):
    """The interface of a probe, which measures one or more quantities over the frames.

    Attributes
    ----------
    name
        First part of the names of its histories.
    nodes : ndarray, shape (m,)
        The nodes that it needs.

    Examples
    --------
    >>> class Midpoint:
    ...     name, nodes = "middle", np.array([4])
    ...
    ...     def histories(self, displacement: Displacement) -> list[Field]:
    ...         u = displacement.isel(node=0).components[0]
    ...         return [replace(u, name="middle_u")]
    >>> probe: Probe = Midpoint()
    """

    @property
    def name(self) -> str:
        """First part of the names of its histories."""

    @property
    def nodes(self) -> IntArray:
        """Nodes that it needs."""

    def histories(self, displacement: Displacement) -> list[Field]:
        """Compute its histories from the displacements of its `nodes`.

        Parameters
        ----------
        displacement
            Of its `nodes` in every frame, shape (c, T, m).

        Returns
        -------
        list of Field
            Each of the shape (T,).
        """


_POWERS = {"value": 0, "velocity": 1, "acceleration": 2} | {
    f"{name}_{side}": power for side in ("before", "after") for power, name in ((1, "velocity"), (2, "acceleration"))
}
"""Quantities in the order of the kernel, each with the power of the time in its denominator."""


FEWEST = LOWEST + 2
"""Frames that a parabola with an uncertainty needs."""


def rate_frames(window: int, measured: int) -> int:
    """Return the frames that a parabola takes in for rates: the `window`, or all `measured` if these are fewer.

    Raises
    ------
    InputError
        Either is too few.
    """
    if window < FEWEST:
        raise InputError(f"rates are taken over a window of {FEWEST} frames or more, not {window}")
    if measured < FEWEST:
        raise InputError(f"rates need {FEWEST} measured frames or more; there are {measured}")
    return min(window, measured)


def rate_words(window: int, measured: int) -> str:
    """Return over how many frames the polynomials of rates are fitted."""
    fitted_frames = rate_frames(window, measured)
    fewer = "" if fitted_frames == window else f" (a window of {window} was stated)"
    longest = min(measured, round(5 * fitted_frames / 3))
    return f"parabolas over {fitted_frames} frames{fewer}, polynomials of degree 4 over {longest}"


@checked
def rates(
    times: npt.ArrayLike,
    field: Field,
    *,
    window: float,
    common_fraction: float,
    references: Sequence[bool] | BoolArray,
) -> dict[str, Field]:
    """Estimate value, velocity and acceleration of a quantity that is measured in every frame.

    Next to a change of the motion, and at both ends of the test, a window keeps its length and the polynomial is taken
    off its middle, with an uncertainty that is accordingly larger. No statement that holds for every motion is narrower
    than the worst motion demands (Low, Ann Stat 25, 1997; Cai and Low, Ann Stat 32, 2004): a change of two or three
    standard uncertainties within a frame may be overlooked. How far the stated holds is in ``docs/how-to/results.md``.

    Parameters
    ----------
    times : (T,)
        Of the frames, rising.
    field
        What was measured, and its standard uncertainty, shape (T, ...); NaN where it was not.
    window
        Length of time that the fit of a parabola takes in, from the first to the last frame; those of degrees 3 and 4
        take in 4/3 and 5/3 of it.
    common_fraction
        Fraction of the variance that all frames have in common, that of the reference: `reference_fraction`.
    references : (T,), bool
        Which of the frames belong to the reference.

    Returns
    -------
    dict of str to Field
        ``"value"``, ``"velocity"`` and ``"acceleration"``, in the unit of the field over that of the times or its
        square. Their standard uncertainties are those of noise, and of where the motion changes: at a kink velocity and
        acceleration lie between those of both sides, and the uncertainty reaches to either. ``"velocity_before"``,
        ``"velocity_after"``, ``"acceleration_before"`` and ``"acceleration_after"`` are from the frames up to this one,
        and from this one on; NaN but in frames where they differ by more than four standard uncertainties, at kinks.
        NaN in a frame whose windows have fewer known values than a parabola has coefficients, in a frame that lies
        beyond the known ones of its window, and where fewer than 4 frames are known at all.

    Raises
    ------
    InputError
        The times do not rise, shapes differ, or no window has enough frames.

    Examples
    --------
    >>> times = np.arange(20) * 1e-3
    >>> position = Field(name="u", values=50 * times, std=np.full(20, 0.01))
    >>> result = rates(times, position, window=10, common_fraction=0.0, references=[False] * 20)
    >>> result["velocity"].values[10].round(6), result["acceleration"].values[10].round(6) + 0
    (np.float64(50.0), np.float64(0.0))
    """
    frame_times, quantity, error = (
        np.asarray(array, dtype=np.float64) for array in (times, field.values, field.noise.uncertainty)
    )
    references = np.asarray(references, dtype=bool)
    if not (frame_times.ndim == references.ndim == 1 and quantity.ndim and frame_times.size):
        raise InputError(f"rates need times (T,) and references (T,), not {frame_times.shape} and {references.shape}")
    if quantity.shape != error.shape or len(frame_times) != len(quantity) or len(references) != len(frame_times):
        raise InputError(
            f"rates need a time for each frame, not {frame_times.shape} for values {quantity.shape}, {error.shape}"
        )
    if not (np.diff(frame_times) > 0).all():
        raise InputError("rates need the times of the frames to rise from each to the next")
    reach = 1.01 * window  # cameras round time stamps, to 1 us at 10,000 frames a second
    max_frames = int(
        (np.searchsorted(frame_times, frame_times + reach, side="right") - np.arange(len(frame_times))).max()
    )
    if max_frames < FEWEST:
        raise InputError(
            f"a window of {window:g} holds no more than {max_frames} frames; a polynomial of degree {LOWEST} needs "
            f"{FEWEST} or more"
        )
    flat, spread = (np.ascontiguousarray(array.reshape(len(frame_times), -1).T) for array in (quantity, error))
    scaled = (frame_times - frame_times[0]) / reach
    noise, common = _noise(scaled, flat, spread, common_fraction, references)
    out = np.full((len(flat), 2, len(_POWERS), len(frame_times)), np.nan)
    weight = references / max(references.sum(), 1)
    mean_rates(scaled, np.nan_to_num(flat), noise, common, weight, max_frames, out)
    out[:, 1] = np.sqrt(np.maximum(out[:, 1], 0))
    out /= reach ** np.array(list(_POWERS.values()), dtype=np.float64)[:, None]
    before_kink, after_kink = out[:, :, 3:5], out[:, :, 5:]
    with np.errstate(invalid="ignore"):  # a kink is 4 standard uncertainties: in noise once in 16,000 frames
        kink = (np.abs(after_kink[:, 0] - before_kink[:, 0]) > 4 * np.hypot(after_kink[:, 1], before_kink[:, 1])).any(
            axis=1
        )
    out[:, :, 3:] = np.where(kink[:, None, None], out[:, :, 3:], np.nan)
    by_quantity = out.transpose(1, 2, 3, 0).reshape(2, len(_POWERS), *quantity.shape)
    fields = {
        name: replace(field.noise, name=name, values=by_quantity[0, i], std=by_quantity[1, i], bias=None)
        for i, name in enumerate(_POWERS)
    }
    if field.common is None:
        return fields
    return {
        name: one.with_common(_derivative(frame_times, field.common, _POWERS[name])) for name, one in fields.items()
    }


def _derivative(times: FloatArray, errors: FloatArray, power: int) -> FloatArray:
    """Differentiate errors (M, T) that all frames have in common: in proportion to the motion, they have no noise."""
    has_data = np.isfinite(errors).all(axis=0)
    measured_times, derivative = times[has_data], errors[:, has_data]
    for _ in range(power if len(measured_times) > 1 else 0):
        derivative = np.gradient(derivative, measured_times, axis=1)
    return np.array([np.interp(times, measured_times, row) for row in derivative]).reshape(errors.shape)


def _noise(
    times: FloatArray, values: FloatArray, std: FloatArray, fraction: float, references: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Split the uncertainty (N, T) into each value's own noise (0: not known) and the variance common to all frames.

    As in `frame_covariance`, two frames have the reference's part of the smaller variance in common, here that of the
    least in half a window to both sides. A frame of the reference has the noise of the others alone.
    """
    is_measured = np.isfinite(values) & np.isfinite(std)
    variance = np.where(is_measured, std, 0.0) ** 2
    other_variance = np.where(is_measured & ~references, variance, np.inf)
    first, last = np.searchsorted(times, times - 0.5), np.searchsorted(times, times + 0.5, side="right")
    min_variance = np.stack([other_variance[:, a:b].min(axis=1) for a, b in zip(first, last, strict=True)], axis=1)
    min_variance = np.where(np.isfinite(min_variance), min_variance, other_variance.min(axis=1, keepdims=True))
    min_variance = np.where(np.isfinite(min_variance), min_variance, variance / (1 - fraction))
    noise = np.sqrt(
        np.where(references, (1 - fraction) * min_variance, np.maximum(variance - fraction * min_variance, 0))
    )
    middle, size = np.median(noise, axis=1), np.abs(np.nan_to_num(values)).max(axis=1)
    # a value that is stated without noise does not outweigh all others
    floor = np.where(middle > 0, 1e-3 * middle, 1e-9 * size + np.finfo(float).tiny)
    return np.where(is_measured, np.maximum(noise, floor[:, None]), 0.0), fraction * min_variance


def rate_correlation(times: FloatArray, window: float) -> FloatArray:
    """Compute the correlation (T, T) between frames of a rate from a parabola over a `window` of time.

    That of two slopes of parabolas around their frames in independent noise, ``sum(h h') / sum(h^2)`` with h the
    distance in time from the middle. That of `rates`, which has further degrees, is taken as the same.
    """
    lag = times[None] - times[:, None]
    inside = np.abs(lag) <= 0.5 * window * (1 + 1e-6)
    lag = np.where(inside, lag - (lag * inside).sum(axis=1, keepdims=True) / inside.sum(axis=1)[:, None], 0.0)
    scale = 1 / np.sqrt(np.maximum((lag**2).sum(axis=1), np.finfo(float).tiny))
    return np.asarray((lag @ lag.T) * scale * scale[:, None])


@checked
def high_pass(field: npt.ArrayLike, sigma: float = SIGMA) -> FloatArray:
    """Subtract from a field (H, W) its copy filtered by a Gaussian: the paper's U tilde.

    NaN pixels take no part: the filter is the normalised convolution, the sum of the measured pixels' values over the
    sum of their weights. At the edge of the measured region such a filter is lopsided and would leak the field's slope
    into the result. The best quadratic polynomial is therefore subtracted first and its own high-pass
    part, which is a constant and exactly known, added again: within the region the result is the plain filter's, and
    near the edge only what is neither rotation, stretch nor bending of the whole field can leak.

    Parameters
    ----------
    field
        One component of the displacement (px).
    sigma
        Standard deviation of the Gaussian, px.

    Returns
    -------
    ndarray, shape (H, W)
        In px; NaN where the field is not measured.

    Raises
    ------
    InputError
        `field` is not one image, or nothing in it is measured.

    Examples
    --------
    >>> high_pass(np.tile(np.arange(60.0), (50, 1)), sigma=5.0).round(6).max() + 0  # a slope is smooth
    np.float64(0.0)
    """
    values = np.asarray(field, dtype=np.float64)
    if values.ndim != 2 or not 0 < sigma < 1e6:
        raise InputError(f"one image (H, W) and a positive sigma are needed, not shape {values.shape}, sigma {sigma!r}")
    is_measured = np.isfinite(values)
    if is_measured.sum() < 10:
        raise InputError("the field is measured at fewer than 10 pixels")
    trend, laplacian = _quadratic_trend(values, is_measured)
    residual = np.where(is_measured, values - trend, 0.0)
    # zeros beyond the image, which the normalisation corrects; what is filtered is small beside the displacement
    # itself: single precision holds it to 1e-7 px
    total, weight = (
        cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT).astype(np.float64)
        for image in (residual, is_measured)
    )
    min_weight = 1e-3  # of the weight on measured pixels: single precision then holds the mean to 1e-4
    smooth = total / np.maximum(weight, min_weight)
    usable = is_measured & (weight > min_weight)
    return np.where(usable, residual - smooth - sigma**2 / 2 * laplacian, np.nan)


def _quadratic_trend(values: FloatArray, is_measured: BoolArray) -> tuple[FloatArray, float]:
    """Fit a polynomial of degree 2 in x and y (H, W) by least squares; return it and its Laplacian."""
    scale = float(max(values.shape))
    y, x = (axis / scale for axis in np.mgrid[: values.shape[0], : values.shape[1]])
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    step = max(1, int(np.sqrt(is_measured.sum() / 20_000)))
    sample = np.zeros_like(is_measured)
    sample[::step, ::step] = is_measured[::step, ::step]
    if sample.sum() < 10:
        sample = is_measured
    coefficients = np.linalg.lstsq(basis[sample], values[sample], rcond=None)[0]
    return basis @ coefficients, float(2 * (coefficients[3] + coefficients[5]) / scale**2)
