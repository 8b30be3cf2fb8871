"""Lens and plane of the specimen, from photographs of a flat target (Zhang, IEEE PAMI 22, 2000).

The lens follows from views under different angles: focal length, principal point and as many distortion terms as an F
test asks for. The plane follows from one photograph of the target where the specimen will be: a homography
(`rgbmidic.fields.plane`). The uncertainty of every parameter is that of the least-squares fit to the target's points,
with the variance of their residuals; what the lens leaves uncertain is carried into the plane.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from scipy import optimize, stats

from rgbmidic.errors import CalibrationError
from rgbmidic.fields.plane import CameraCalibration, distorted, undistorted
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.target import View


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraConstants:
    """Constants of `estimate_lens` and `estimate_plane`.

    Attributes
    ----------
    min_views
        Views of the target from which a lens is calibrated: each gives two equations for the focal length and principal
        point (Zhang), which leaves seven for the distortion and the check.
    min_angle
        Largest angle (degrees) between two views below which all count as parallel: the focal length follows from
        1 - cos of it, 1.5 %, with corners good to .1 % of the target (derived).
    max_residual
        Residual of the points (px rms) above which no target is flat and rigid: ten times that of the detection
        (chosen).
    significance
        Level of the F test from which the next distortion term is taken up. At .01 three of 100 lenses took up a term
        by chance, which left a strain of 6e-4 in a corner that no view reached; at .001 none (benchmarks/camera.py).
    outlier_ratio
        Residual of a view, over the median, that gives a warning: in OpenCV's pictures the largest is 1.3 by
        `find_view`, and 6 by the corners of OpenCV's own sample, some of which are wrong (benchmarks/camera.py).
    min_coverage
        Fraction of the frame that the views' points must cover, or a warning says that the lens is extrapolated
        (chosen).
    """

    min_views: int = 5
    min_angle: float = 10.0
    max_residual: float = 0.5
    significance: float = 0.001
    outlier_ratio: float = 3.0
    min_coverage: float = 0.5


LIMITS = CameraConstants()


def coverage_fraction(points: Sequence[FloatArray], shape: tuple[int, int]) -> float:
    """Return the fraction of a frame within the hull of points (m, 2), px."""
    return float(cv2.contourArea(cv2.convexHull(np.concatenate(points).astype(np.float32))) / np.prod(shape))


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraEstimate:
    """Result of `estimate_lens`, `estimate_plane` and `rgbmidic_calibration.jobs.calibrate_camera`.

    Attributes
    ----------
    camera : CameraCalibration
        What is written. Its `details` state ``"lens"`` (views, residual, largest angle between two of them, p values of
        the distortion terms that were tried), ``"plane"`` (residual, scale, tilt) and ``"warnings"``.
    residuals : tuple of (ndarray, ndarray), each of shape (m, 2)
        Points of every photograph and their residuals, px.
    """

    camera: CameraCalibration
    residuals: tuple[tuple[FloatArray, FloatArray], ...] = ()


def estimate_lens(views: Sequence[View], rejected: Sequence[str] = ()) -> CameraEstimate:
    """Calibrate a lens by the target's points in several views.

    The pixels are square. Circles are corrected by `_centre_offset`, as a first fit places them. Distortion terms are
    taken up one after the other (k1, k2, k3; p1 and p2 together), the one that lowers the squares most first, as long
    as it pays at the level of the F test.

    Parameters
    ----------
    views
        Five at least, under different angles.
    rejected
        Reasons why other photographs were not used, for the messages.

    Raises
    ------
    CalibrationError
        Too few views, frames of different sizes, all views parallel, or residuals as no flat target has them.
    """
    rejection_text = "".join(f"; {reason}" for reason in rejected)
    if len(views) < LIMITS.min_views:
        raise CalibrationError(
            f"a lens needs {LIMITS.min_views} photographs of the target at least, under different angles; it was "
            f"found in {len(views)}{rejection_text}"
        )
    shapes = {view.shape for view in views}
    if len(shapes) > 1:
        raise CalibrationError(f"the photographs have different sizes: {sorted(shapes)}")
    if any(view.radius for view in views):
        views = _with_circle_centres(views, _fit(views, 1, 0))
    count = 2 * sum(len(view.points) for view in views)
    terms, fit, tests = (0, 0), _fit(views, 0, 0), dict[str, float]()
    while True:
        radial, tangential = terms
        candidates = {(radial + 1, tangential): f"k{radial + 1}"} if radial < 3 else {}
        candidates |= {} if tangential else {(radial, 1): "p1, p2"}
        gains = []
        for candidate_terms, name in candidates.items():
            candidate = _fit(views, *candidate_terms)
            added, degrees_of_freedom = candidate.unknowns - fit.unknowns, count - candidate.unknowns
            gain = (fit.squares / candidate.squares - 1) * degrees_of_freedom / added
            tests[name] = float(stats.f.sf(max(gain, 0), added, degrees_of_freedom))
            if tests[name] < LIMITS.significance:
                gains.append((gain, candidate_terms, candidate))
        if not gains:
            return _conclude(views, fit, tests, list(rejected))
        _, terms, fit = max(gains, key=lambda entry: entry[0])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Fit:
    """One bundle adjustment: parameters, poses of the views, sum of squared residuals, number of unknowns."""

    lens: FloatArray
    poses: list[tuple[FloatArray, FloatArray]]
    squares: float
    unknowns: int

    def image(self, target_points: FloatArray, turn: FloatArray, shift: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Project points (m, 2) of the target, mm, to the frame, px, in one pose; with OpenCV's derivatives."""
        matrix = np.array([[self.lens[0], 0, self.lens[1]], [0, self.lens[0], self.lens[2]], [0, 0, 1.0]])
        points, slopes = cv2.projectPoints(np.pad(target_points, ((0, 0), (0, 1))), turn, shift, matrix, self.lens[3:])[
            :2
        ]
        return np.asarray(points[:, 0]), np.asarray(slopes)


def _fit(views: Sequence[View], radial: int, tangential: int) -> _Fit:
    flags = cv2.CALIB_FIX_ASPECT_RATIO | (0 if tangential else cv2.CALIB_ZERO_TANGENT_DIST)
    for flag in (cv2.CALIB_FIX_K1, cv2.CALIB_FIX_K2, cv2.CALIB_FIX_K3)[radial:]:
        flags |= flag
    rms, matrix, distortion, turns, shifts = cv2.calibrateCamera(
        [np.pad(view.points, ((0, 0), (0, 1))).astype(np.float32) for view in views],
        [view.pixels.astype(np.float32)[:, None] for view in views],
        views[0].shape[::-1],
        np.eye(3),
        np.zeros(5),
        flags=flags,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12),
    )
    return _Fit(
        lens=np.r_[matrix[0, 0], matrix[:2, 2], np.ravel(distortion)[:5]],
        poses=[(np.asarray(turn), np.asarray(shift)) for turn, shift in zip(turns, shifts, strict=True)],
        squares=float(rms) ** 2 * sum(len(view.points) for view in views),
        unknowns=3 + radial + 2 * tangential + 6 * len(views),
    )


def _centre_offset(points: FloatArray, radius: float, image: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return the offset (m, 2), px, of the centroids of circles' images from the images of their centres.

    Where perspective or distortion enlarge one side of a circle, its centroid lies there (Heikkila, IEEE PAMI 22,
    2000): that of the polygon which `image`, from mm to px, makes of the circle.
    """
    if not radius:
        return np.zeros((1, 2))
    corners = 32  # the polygon's area is 0.6 % too small, and so is the offset (derived)
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    rim = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corner = image((points[:, None] + rim).reshape(-1, 2)).reshape(-1, corners, 2) - image(points)[:, None]
    following = np.roll(corner, -1, axis=1)
    area = corner[..., 0] * following[..., 1] - corner[..., 1] * following[..., 0]
    return np.asarray(((corner + following) * area[..., None]).sum(axis=1) / (3 * area.sum(axis=1, keepdims=True)))


def _with_circle_centres(views: Sequence[View], fit: _Fit) -> list[View]:
    """Return the views with the images of the circles' centres as points."""

    def centres(view: View, pose: tuple[FloatArray, FloatArray]) -> FloatArray:
        return view.pixels - _centre_offset(
            view.points, view.radius, lambda target_points: fit.image(target_points, *pose)[0]
        )

    return [replace(view, pixels=centres(view, pose)) for view, pose in zip(views, fit.poses, strict=True)]


def _conclude(views: Sequence[View], fit: _Fit, tests: dict[str, float], warnings: list[str]) -> CameraEstimate:
    """Return the covariance, residuals and checks of the chosen fit; the poses are eliminated view by view."""
    active = np.ix_(*[np.flatnonzero(np.r_[True, True, True, fit.lens[3:] != 0])] * 2)
    normal, residuals = np.zeros((8, 8)), []
    for view, pose in zip(views, fit.poses, strict=True):
        projected, slopes = fit.image(view.points, *pose)
        residuals.append((view.pixels, view.pixels - projected))
        by_pose, by_lens = slopes[:, :6], np.c_[slopes[:, 6] + slopes[:, 7], slopes[:, 8:15]]
        lens_slopes = by_lens - by_pose @ np.linalg.lstsq(by_pose, by_lens, rcond=None)[0]
        normal += lens_slopes.T @ lens_slopes
    squares = sum(float((residual**2).sum()) for _, residual in residuals)
    count = 2 * sum(len(view.points) for view in views)
    covariance = np.zeros((16, 16))
    covariance[active] = np.linalg.inv(normal[active]) * squares / (count - fit.unknowns)
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn, _ in fit.poses])
    angle = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))
    if angle < LIMITS.min_angle:
        raise CalibrationError(
            f"all views are parallel within {angle:.1f} degrees: the focal length needs views that differ by "
            f"{LIMITS.min_angle:g} degrees at least; tilt the target by 20 to 40 degrees about both axes"
        )
    rms, sizes = float(np.sqrt(squares / count)), np.array([np.sqrt((residual**2).mean()) for _, residual in residuals])
    if rms > LIMITS.max_residual:
        raise CalibrationError(
            f"the points are off by {rms:.2f} px rms, at most {LIMITS.max_residual:g} is what a flat, rigid "
            f"target leaves; most in {views[int(sizes.argmax())].name}: is the target flat, and its size stated right?"
        )
    coverage = coverage_fraction([view.pixels for view in views], views[0].shape)
    if coverage < LIMITS.min_coverage:
        warnings.append(
            f"the views cover {coverage:.0%} of the frame: beyond them the distortion is extrapolated; show the target "
            "in every corner"
        )
    warnings += [
        f"{view.name}: the points are off by {size:.3f} px rms, those of half the views by less than "
        f"{np.median(sizes):.3f}: was the target moved or bent? Leave it out"
        for view, size in zip(views, sizes, strict=True)
        if size > LIMITS.outlier_ratio * np.median(sizes)
    ]
    details = {
        "views": [view.name for view in views],
        "rms_px": rms,
        "largest_angle_deg": angle,
        "covered": coverage,
        "p_values": tests,
    }
    camera = CameraCalibration(
        shape=views[0].shape, lens=fit.lens, covariance=covariance, details={"lens": details, "warnings": warnings}
    )
    return CameraEstimate(camera=camera, residuals=tuple(residuals))


def estimate_plane(view: View, camera: CameraCalibration, std: float | None = None) -> CameraEstimate:
    """Fit the plane to the target's points in one photograph.

    Parameters
    ----------
    view
        The target on the specimen's plane; or four points of the specimen itself.
    camera
        Its lens; without one the image counts as free from distortion.
    std
        Standard uncertainty of the points, px; None: that of their residuals.

    Raises
    ------
    CalibrationError
        Another frame size than the lens', too few points, points on a line, or residuals as no flat target has them.
    """
    if view.shape != camera.shape:
        raise CalibrationError(
            f"{view.name} has {view.shape[1]} x {view.shape[0]} px, the lens was calibrated with "
            f"{camera.shape[1]} x {camera.shape[0]}"
        )
    if len(view.points) < 4 or (std is None and len(view.points) < 6):
        raise CalibrationError(f"{view.name}: a plane needs four points, without their uncertainty six")
    centre, lens = camera.centre, camera.lens
    straight = view.pixels if lens is None else undistorted(lens, view.pixels)
    first, _ = cv2.findHomography(straight - centre, view.points)
    if first is None or not np.isfinite(first).all() or abs(np.linalg.det(first[:2, :2])) < 1e-12:
        raise CalibrationError(f"{view.name}: the points of the target lie on a line")

    at_first, motion = replace(camera, homography=first / first[2, 2]).in_image_axes()
    points, start = view.points @ motion[:2, :2].T + motion[:2, 2], at_first.homography
    assert start is not None

    def project(target_points: FloatArray, entries: FloatArray, values: FloatArray | None = lens) -> FloatArray:
        plane_points = (
            np.c_[target_points, np.ones(len(target_points))] @ np.linalg.inv(np.r_[entries, 1.0].reshape(3, 3)).T
        )
        ideal = plane_points[:, :2] / plane_points[:, 2:] + centre
        return ideal if values is None else distorted(values, ideal)

    entries = start.ravel()[:8]
    pixels = view.pixels - _centre_offset(points, view.radius, lambda target_points: project(target_points, entries))

    def residual_vector(entries: FloatArray, values: FloatArray | None = lens) -> FloatArray:
        return (project(points, entries, values) - pixels).ravel()

    # columns scaled alike: by what a px at the edge of the target does
    scale = np.maximum(np.abs(entries), np.r_[[1e-3 * abs(entries[0])] * 6, [1e-6] * 2])

    def scaled(scaled_entries: FloatArray) -> FloatArray:
        return residual_vector(scaled_entries * scale)

    solution = optimize.least_squares(scaled, entries / scale, jac="3-point", method="lm", xtol=1e-14)
    entries, slopes = solution.x * scale, np.asarray(solution.jac, dtype=np.float64) / scale
    residual = residual_vector(entries)
    rms = float(np.sqrt((residual**2).mean()))
    if rms > LIMITS.max_residual and std is None:
        raise CalibrationError(
            f"{view.name}: the points are off the plane by {rms:.2f} px rms, at most {LIMITS.max_residual:g} "
            "is what a flat target leaves"
            + (": calibrate the lens too, from views at several angles" if lens is None else "")
        )
    variance = std**2 if std is not None else float((residual**2).sum()) / (residual.size - 8)
    covariance = np.zeros((16, 16))
    covariance[8:, 8:] = variance * np.linalg.inv(slopes.T @ slopes)
    if lens is not None:  # a change of the lens' parameters moves the plane that fits best
        lens_covariance = camera.covariance[:8, :8]
        steps = np.diag(np.sqrt(np.diag(lens_covariance)))
        changes = np.stack(
            [(residual_vector(entries, lens + step) - residual_vector(entries, lens - step)) / 2 for step in steps],
            axis=1,
        )
        by_lens = np.divide(changes, np.diag(steps), out=np.zeros_like(changes), where=np.diag(steps) > 0)
        sensitivity = -np.linalg.lstsq(slopes, by_lens, rcond=None)[0]
        covariance[:8, :8] = lens_covariance
        covariance[8:, :8] = sensitivity @ lens_covariance
        covariance[:8, 8:] = covariance[8:, :8].T
        covariance[8:, 8:] += sensitivity @ lens_covariance @ sensitivity.T
    if view.factor is not None:
        sensitivity = np.linalg.lstsq(slopes, view.factor.reshape(len(slopes), -1), rcond=None)[0]
        covariance[8:, 8:] += sensitivity @ sensitivity.T
    plane = replace(camera, homography=np.r_[entries, 1.0].reshape(3, 3), covariance=covariance)
    details = {**camera.details, **_plane_details(plane, view, rms)}
    return CameraEstimate(camera=replace(plane, details=details), residuals=((view.pixels, residual.reshape(-1, 2)),))


def _plane_details(camera: CameraCalibration, view: View, rms: float) -> dict[str, Any]:
    names = ("mm_per_pixel", "mm_per_pixel_std", "tilt_deg", "tilt_std_deg")
    figures = zip(names, (*camera.scale(camera.centre), *camera.tilt_deg), strict=True)
    finite_figures = {name: value for name, value in figures if np.isfinite(value)}
    warnings = list(camera.details.get("warnings", ()))
    if (hull := coverage_fraction([view.pixels], view.shape)) < LIMITS.min_coverage / 2:
        warnings.append(f"the target covers {hull:.0%} of the frame on the plane: beyond it the plane is extrapolated")
    return {"plane": {"photograph": view.name, "rms_px": rms, **finite_figures}, "warnings": warnings}
