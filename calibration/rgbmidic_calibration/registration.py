"""Lateral colour registration of the lights: DIC between single-light captures of a speckled target at rest.

With one light on, every colour plane of the camera shows the same picture, each with its own strength. Each plane
divided by its local mean gives that picture at every pixel, with no demosaicing and no crosstalk matrix. The
displacement between the pictures of two lights (`rgbmidic.correlate`) is then fitted by shift, rotation,
scale and a radial term (`rgbmidic.illumination.images`). Its initial guess is the peak of their cross-correlation: on a
periodic target fewer marks overlap a period beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.signal import correlate as cross_correlate

from rgbmidic.correlation.solution import NodeStatus, Solution
from rgbmidic.errors import CalibrationError, RgbmidicError
from rgbmidic.illumination.checks import Check, warning
from rgbmidic.illumination.images import PARAMETERS, Registration, frame_geometry, registration_basis
from rgbmidic.pipeline import correlate
from rgbmidic.settings import ELEMENT_SIZE
from rgbmidic.typing import BoolArray, FloatArray, FloatImage
from rgbmidic_calibration.captures import TemporalStack, require_same_camera
from rgbmidic_calibration.plausibility import collect_warnings


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationConstants:
    """Constants of `estimate_registration`.

    Attributes
    ----------
    mean_width
        Standard deviation (px) of the neighbourhood whose mean a plane is divided by: several speckles.
    min_snr
        Signal over noise of the mean frame below which a plane is not used for the light. Measured on the virtual
        sphere's target (256 px, three lights, no lateral colour): errors of .004 and .005 px from 10 to 20, of .010 and
        .016 px at 30, where the weaker planes drop out, .002 px at 5, where the stated uncertainty is the same.
    border
        Pixels at the frame's edge that are left out: the neighbourhood of `mean_width` is cut off there.
    outlier_sigma
        Standard deviations beyond which a node is left out of the fit, as a block of the crosstalk.
    min_measured
        Fraction of the nodes that must be measured: .99 to 1 on the virtual sphere's target, nearly none without a
        match.
    max_residual
        Residual of the fit (px rms) above which the target moved: ten times the motion that gives a warning; at rest
        .02 to .03 px.
    min_samples
        Samples at least for the fit of the motion, with four unknowns: a plane of 32 x 32 has as many.
    element_sizes
        Sides of the elements (px) that are tried in turn, the paper's first (section 2.2). On printed dots of 30 px,
        68 px apart, a third to half of the nodes are measured with 25 px, nine tenths with 40 px; the shifts of 40, 60
        and 80 px agree within .1 px.
    """

    mean_width: float = 8.0
    min_snr: float = 15.0
    border: int = 8
    outlier_sigma: float = 5.0
    min_measured: float = 0.5
    max_residual: float = 0.3
    min_samples: int = 1000
    element_sizes: tuple[float, ...] = (ELEMENT_SIZE, 40.0, 60.0, 80.0, 120.0)


LIMITS = RegistrationConstants()


@dataclass(frozen=True, slots=True, kw_only=True)
class LightMatch:
    """Result of the DIC between the first light and another.

    Attributes
    ----------
    name : str
    nodes : ndarray, shape (N, 2)
        Where the first light's picture was compared with the other light's, px.
    residual : ndarray, shape (N, 2)
        Displacement between them minus the fitted registration, px.
    is_used : ndarray, shape (N,), bool
        Nodes that were measured and are no outliers.
    """

    name: str
    nodes: FloatArray
    residual: FloatArray
    is_used: BoolArray

    @property
    def rms(self) -> float:
        """Root mean square of the residual's components over the nodes used, px."""
        return float(np.sqrt((self.residual[self.is_used] ** 2).mean()))


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationEstimate:
    """Result of `estimate_registration`: one match per light after the first, by elements of one size (px)."""

    registration: Registration
    matches: tuple[LightMatch, ...]
    element_size: float
    warnings: tuple[str, ...] = ()


def light_picture(stack: TemporalStack, dark: TemporalStack | None = None) -> FloatImage:
    """Return the picture of the one light that is on, relative to its local mean, at every pixel.

    Parameters
    ----------
    stack
        Captures with one light on.
    dark
        Captures with all lights off; None: the stated black level.

    Returns
    -------
    ndarray, shape (H, W), float32
        About 1 on average; NaN where a sample is saturated. Planes too faint for the light are interpolated from the
        others.

    Raises
    ------
    CalibrationError
        No plane has enough signal.
    """
    signals = [mean - (0 if dark is None else dark.mean[plane]) for plane, mean in enumerate(stack.mean)]
    levels = [float(signal.mean(dtype=np.float64)) for signal in signals]
    if max(levels) < 0.005 * (stack.camera.white - min(stack.camera.black)):
        raise CalibrationError(f"the light gives {max(levels):.1f} DN above dark only: was the lamp on?")
    if stack.camera.step == 1:
        brightest = int(np.argmax(levels))
        return _relative(signals[brightest], stack.clipped[brightest], LIMITS.mean_width)

    picture = np.full(stack.camera.shape, np.nan, dtype=np.float32)
    is_filled, noise_stacks = np.zeros_like(picture), [stack, *([dark] if dark is not None and dark.count > 1 else [])]
    for plane, (signal, (row, column)) in enumerate(zip(signals, stack.camera.origins, strict=True)):
        noise = sum(
            float(source_stack.variance[plane].mean(dtype=np.float64)) / source_stack.count
            for source_stack in noise_stacks
        )
        # a plane that does not exceed its noise is not used; of a single frame, a tenth of the brightest plane
        is_faint = stack.count < 2 and levels[plane] < 0.1 * max(levels)
        if not is_faint and levels[plane] > LIMITS.min_snr * float(np.sqrt(noise)):
            plane_pixels = (slice(row, 2 * signal.shape[0], 2), slice(column, 2 * signal.shape[1], 2))
            picture[plane_pixels] = _relative(signal, stack.clipped[plane], LIMITS.mean_width / 2)
            is_filled[plane_pixels] = 1
    if not is_filled.any():
        raise CalibrationError("no colour plane stands out of its noise: do all captures show the same scene at rest?")
    if is_filled.all():
        return picture
    # Pixels of planes not used: the mean of their neighbours, symmetric so that nothing shifts. A neighbourhood that
    # lost a saturated sample is not symmetric any more.
    is_valid = is_filled * np.isfinite(picture)
    kernel = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], dtype=np.float32)
    total, count, expected = (
        ndimage.convolve(values, kernel) for values in (np.nan_to_num(picture) * is_valid, is_valid, is_filled)
    )
    mean = np.where(count == expected, total / np.maximum(count, 1), np.nan)
    return np.where(is_filled > 0, picture, mean).astype(np.float32)


def _relative(signal: npt.NDArray[np.floating], clipped: BoolArray, sigma: float) -> FloatImage:
    """Return the signal over its local mean; NaN where clipped."""
    weight = (~clipped).astype(np.float32)
    total = ndimage.gaussian_filter(signal * weight, sigma)
    mean = total / np.maximum(ndimage.gaussian_filter(weight, sigma), 1e-3)
    floor = 1e-3 * max(float(signal.mean()), 1.0)
    return np.where(clipped, np.nan, signal / np.maximum(mean, floor)).astype(np.float32)


def estimate_registration(
    lights: Mapping[str, TemporalStack],
    dark: TemporalStack | None = None,
    *,
    region: Sequence[float] | None = None,
    element_size: float | None = None,
) -> RegistrationEstimate:
    """Return the registration of every light against the first.

    Parameters
    ----------
    lights
        Captures of a speckled target at rest with one light on at a time, by the light's name.
    dark
        Captures with all lights off.
    region
        Rectangle (x0, y0, x1, y1) in px where the target is; None: the whole frame.
    element_size
        Side of the elements of the DIC, px; None: the smallest that match (`RegistrationConstants.element_sizes`).

    Raises
    ------
    CalibrationError
        Fewer than two lights, frames of different cameras, a target without texture, or pictures that do not match.
    """
    if len(lights) < 2:
        raise CalibrationError("a registration needs the captures of at least two lights")
    require_same_camera([*lights.values(), *([dark] if dark else [])])
    shape = next(iter(lights.values())).camera.shape
    centre, radius = frame_geometry(shape)
    pictures = {}
    for name, stack in lights.items():
        try:
            pictures[name] = light_picture(stack, dark)
            if (saturated := float(np.isnan(pictures[name]).mean())) > 1 - LIMITS.min_measured:
                raise CalibrationError(f"{100 * saturated:.0f} % of the picture is saturated; shorten the exposure")
        except CalibrationError as error:
            raise CalibrationError(f"light {name}: {error}") from None
    names = tuple(lights)
    motion = {name: np.nan_to_num(jitter(stack, pictures[name]) ** 2 / stack.count) for name, stack in lights.items()}
    parameters = np.zeros((len(names), len(PARAMETERS)))
    covariance = np.zeros((len(names), len(PARAMETERS), len(PARAMETERS)))
    matches = []
    solutions, element_size = _match_all(pictures, region, element_size)
    for index, (name, solution) in enumerate(solutions.items(), start=1):
        parameters[index], covariance[index], match = _fit(name, solution, (centre, radius), element_size)
        covariance[index, :2, :2] += np.diag(motion[names[0]] + motion[name])
        matches.append(match)
    registration = Registration(
        lights=names, parameters=parameters, centre=centre, radius=radius, covariance=covariance
    )
    warnings = tuple(collect_warnings(_checks(lights, dark, motion, matches)))
    return RegistrationEstimate(
        registration=registration, matches=tuple(matches), element_size=element_size, warnings=warnings
    )


def _match_all(
    pictures: Mapping[str, FloatImage], region: Sequence[float] | None, element_size: float | None
) -> tuple[dict[str, Solution], float]:
    """DIC between the first light's picture and each other's, by the smallest elements that match, and their size."""
    (first, reference), *other_pictures = pictures.items()
    sizes = LIMITS.element_sizes if element_size is None else (element_size,)
    for size in sizes:
        try:
            return {
                name: _match({first: reference, name: other_picture}, region, size)
                for name, other_picture in other_pictures
            }, size
        except CalibrationError as error:
            failure = error
    sizes_text = f" (elements of {', '.join(f'{size:g}' for size in sizes)} px were tried)" if len(sizes) > 1 else ""
    raise CalibrationError(f"{failure}{sizes_text}")


def _match(pictures: Mapping[str, FloatImage], region: Sequence[float] | None, element_size: float) -> Solution:
    """Run DIC between the pictures of two lights."""
    reference, deformed = pictures.values()
    (height, width), edge = reference.shape, LIMITS.border
    roi = region if region is not None else (edge, edge, width - 1 - edge, height - 1 - edge)
    pair = f"the pictures of lights {' and '.join(pictures)}"
    try:
        solution = correlate(
            reference,
            deformed,
            region=roi,
            element_size=element_size,
            brightness="none",  # the pictures are over their local means
            initial=_cross_correlation_peak(reference, deformed),
        )
    except RgbmidicError as error:
        raise CalibrationError(f"{pair} cannot be compared: {error}") from None
    measured = float((solution.node_status == NodeStatus.MEASURED).mean())
    if measured < LIMITS.min_measured:
        raise CalibrationError(
            f"{pair} match in {100 * measured:.0f} % of the field only: is the target speckled and at rest, sharp "
            "under both lights, and not saturated?"
        )
    return solution


def _cross_correlation_peak(reference: FloatImage, deformed: FloatImage) -> FloatArray:
    """Return the shift (x, y) of the other picture, whole px."""
    first, second = (np.nan_to_num(picture - 1) for picture in (reference, deformed))
    product = np.asarray(cross_correlate(second, first, mode="same", method="fft"))
    row, column = np.unravel_index(product.argmax(), product.shape)
    return np.array([column - product.shape[1] // 2, row - product.shape[0] // 2], dtype=np.float64)


def _fit(
    name: str, solution: Solution, frame: tuple[tuple[float, float], float], element_size: float
) -> tuple[FloatArray, FloatArray, LightMatch]:
    """Parameters (5,), covariance (5, 5) and residuals: weighted least squares without outliers, cluster sandwich."""
    value = solution.displacement
    basis = registration_basis(solution.nodes, *frame)
    weight = np.nan_to_num(1 / solution.displacement_std**2, posinf=0.0)
    is_used = is_finite = np.asarray((np.isfinite(value) & (weight > 0)).all(axis=1))
    for _ in range(10):
        scaled = basis * (weight * is_used[:, None])[..., None]  # values of weight 0 may be NaN
        inverse = np.linalg.inv(np.einsum("ndp,ndq->pq", scaled, basis))
        parameters = inverse @ np.einsum("ndp,nd->p", scaled, np.nan_to_num(value))
        residual = value - basis @ parameters
        size = np.linalg.norm(residual, axis=1)
        limit = LIMITS.outlier_sigma * np.median(size[is_finite]) / 1.1774
        update = is_finite & (np.nan_to_num(size, nan=np.inf) <= limit)
        if (update == is_used).all():
            break
        is_used = update
    score = np.einsum("ndp,nd->np", basis * (weight * is_used[:, None])[..., None], np.nan_to_num(residual))
    sums = _cell_sums(score, solution.nodes, 2 * element_size)
    covariance = inverse @ (sums.T @ sums) @ inverse * len(sums) / max(len(sums) - 1, 1)
    match = LightMatch(name=name, nodes=solution.nodes, residual=residual, is_used=is_used)
    if match.rms > LIMITS.max_residual:
        raise CalibrationError(
            f"the picture of light {name} departs from a shift, rotation and magnification of the first light's by "
            f"{match.rms:.2f} px rms: did the target deform or move, or is it another target?"
        )
    return parameters, covariance, match


def _cell_sums(values: FloatArray, nodes: FloatArray, side: float) -> FloatArray:
    """Return the sums (cells, Q) of values (N, Q) over square cells: neighbouring nodes share pixels and errors."""
    _, cell = np.unique(np.floor(nodes / side).astype(int), axis=0, return_inverse=True)
    return np.stack([np.bincount(cell.ravel(), weights=column) for column in values.T], axis=1)


def _checks(
    lights: Mapping[str, TemporalStack],
    dark: TemporalStack | None,
    motion: Mapping[str, FloatArray],
    matches: Sequence[LightMatch],
) -> Iterator[Check]:
    """Warn the user of doubts, from about what `check` allows (`rgbmidic_calibration.verify.Limits`)."""
    if dark is None:
        yield warning("no dark frames: the sensor's own pattern stays in the pictures")
    for name, stack in lights.items():
        motion_px = float(np.sqrt(motion[name].max() * stack.count))
        text = (
            f"light {name}: the picture moves by {motion_px:.2f} px (standard deviation) from capture to capture: "
            "something vibrates or drifts; the stated uncertainty of the shift covers it"
        )
        yield warning(text, motion_px, above=0.03)
    for match in matches:  # what the model leaves, over cells of 4 x 4 nodes: noise is small there, a misfit is not
        side = 4 * max(float(np.median(np.diff(np.unique(match.nodes[:, 0].round(2))))), 1.0)
        residual = match.residual[match.is_used]
        sums = _cell_sums(np.column_stack([residual, np.ones(len(residual))]), match.nodes[match.is_used], side)
        means = (sums[:, :2] / sums[:, 2:])[sums[:, 2] >= 8]
        smooth = float(np.sqrt((means**2).mean())) if means.size else 0.0
        text = (
            f"light {match.name}: a smooth misfit of {smooth:.2f} px rms is left: the target was not at rest, or the "
            "lens needs more than shift, rotation, scale and radial term"
        )
        yield warning(text, smooth, above=0.05)


def jitter(stack: TemporalStack, picture: FloatImage) -> FloatArray:
    """Return motion of the picture from frame to frame: standard deviation (2,) in x and y, px; NaN for a single frame.

    The temporal variance of a sample that moves by d is ``r^2 + K mu + (d . gradient)^2``; the coefficients of the
    squared gradients are fitted over the brightest plane.

    Parameters
    ----------
    stack
        Captures with one light on.
    picture
        Their picture (`light_picture`), whose gradients are finer than those of a plane.
    """
    if stack.count < 2:
        return np.full(2, np.nan)
    plane = int(stack.strength.mean(axis=0).argmax())
    mean = stack.mean[plane].astype(np.float64)
    (row, column), step = stack.camera.origins[plane], stack.camera.step
    local = ndimage.gaussian_filter(mean, LIMITS.mean_width / step)
    plane_pixels = (slice(row, row + step * mean.shape[0], step), slice(column, None, step))
    stencil = np.array([1, -8, 0, 8, -1]) / 12
    slopes = [
        ndimage.correlate1d(picture, stencil, axis=axis)[plane_pixels][:, : mean.shape[1]] * local for axis in (1, 0)
    ]
    columns = np.stack([np.ones_like(mean), mean, slopes[0] ** 2, slopes[1] ** 2], axis=-1)
    is_used = np.isfinite(columns).all(axis=-1) & ~stack.clipped[plane]
    if is_used.sum() < LIMITS.min_samples:
        return np.full(2, np.nan)
    weight = 1 / np.maximum(mean[is_used], 0.02 * float(mean[is_used].mean()))
    moments = (columns[is_used] * weight[:, None]).T
    solution = np.linalg.pinv(moments @ columns[is_used]) @ (moments @ stack.variance[plane][is_used])
    return np.asarray(np.sqrt(np.maximum(solution[2:], 0)))
