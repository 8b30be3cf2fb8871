"""Lens and plane of the specimen, from photographs of a flat target (Zhang, IEEE PAMI 22, 2000).

The lens follows from views under different angles: focal length, principal point and as many distortion terms as an F
test asks for. The plane follows from one photograph of the target where the specimen will be: a homography
(`rgbmidic.fields.plane`). The uncertainty of every parameter is that of the least-squares fit to the target's points,
with the variance of their residuals; what the lens leaves uncertain is carried into the plane.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy import optimize, stats

from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.fields.plane import CameraCalibration, distorted, undistorted
from rgbmidic.settings import FrameSettings
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.captures import CaptureFiles, provenance
from rgbmidic_calibration.target import Target, View, find_views

__all__ = [
    "LensEstimate",
    "PlaneEstimate",
    "estimate_lens",
    "estimate_plane",
]

LEAST_VIEWS = 5
"""Views of the target from which a lens is calibrated: each gives two equations for the focal length and principal
point (Zhang), which leaves seven for the distortion and the check."""
LEAST_ANGLE = 10.0
"""Largest angle (degrees) between two views below which all count as parallel: the focal length follows from 1 - cos of
it, 1.5 %, with corners good to .1 % of the target (derived)."""
LARGEST_RESIDUAL = 0.5
"""Residual of the points (px rms) above which no target is flat and rigid: ten times that of the detection (chosen)."""
PAYS = 0.01
"""Level of the F test from which the next distortion term is taken up."""
COVERED = 0.5
"""Fraction of the frame that the views' points must cover, or a warning says that the lens is extrapolated (chosen)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LensEstimate:
    """Result of `estimate_lens`.

    Attributes
    ----------
    lens : ndarray, shape (8,)
        `rgbmidic.fields.plane.LENS_PARAMETERS`; those not taken up are 0.
    covariance : ndarray, shape (8, 8)
        Of them.
    residuals : tuple of ndarray, shape (m, 2)
        Of the points of each view, px.
    rms : float
        Root mean square of their components, px.
    angle : float
        Largest angle between two views, degrees.
    covered : float
        Fraction of the frame within the hull of all points.
    tests : mapping
        p value of every distortion term that was tried.
    warnings : tuple of str
    """

    lens: FloatArray
    covariance: FloatArray
    residuals: tuple[FloatArray, ...]
    rms: float
    angle: float
    covered: float
    tests: dict[str, float]
    warnings: tuple[str, ...] = ()


def estimate_lens(views: Sequence[View], rejected: Sequence[str] = ()) -> LensEstimate:
    """Calibrate a lens by the target's points in several views.

    The pixels are square. Distortion terms are taken up one after the other (k1, k2, k3; p1 and p2 together), the one
    that lowers the squares most first, as long as it pays at the level `PAYS` of the F test.

    Parameters
    ----------
    views
        `LEAST_VIEWS` at least, under different angles.
    rejected
        Reasons why other photographs were not used, for the messages.

    Raises
    ------
    CalibrationError
        Too few views, frames of different sizes, all views parallel, or residuals as no flat target has them.
    """
    why = "".join(f"; {reason}" for reason in rejected)
    if len(views) < LEAST_VIEWS:
        raise CalibrationError(
            f"a lens needs {LEAST_VIEWS} photographs of the target at least, under different angles; it was found in "
            f"{len(views)}{why}"
        )
    shapes = {view.shape for view in views}
    if len(shapes) > 1:
        raise CalibrationError(f"the photographs have different sizes: {sorted(shapes)}")
    count = 2 * sum(len(view.points) for view in views)
    fits = {(0, 0): _fit(views, 0, 0)}
    chosen, tests = (0, 0), dict[str, float]()
    while True:
        radial, tangential = chosen
        tried = {(radial + 1, tangential): f"k{radial + 1}"} if radial < 3 else {}
        tried |= {} if tangential else {(radial, 1): "p1, p2"}
        best: tuple[float, tuple[int, int]] | None = None
        for terms, name in tried.items():
            fits[terms] = fits.get(terms) or _fit(views, *terms)
            added, free = fits[terms].terms - fits[chosen].terms, count - fits[terms].unknowns
            gain = (fits[chosen].squares / fits[terms].squares - 1) * free / added
            tests[name] = float(stats.f.sf(max(gain, 0), added, free))
            if tests[name] < PAYS and (best is None or gain > best[0]):
                best = gain, terms
        if best is None:
            break
        chosen = best[1]
    return _concluded(views, fits[chosen], tests, tuple(rejected))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Fit:
    """One bundle adjustment: parameters, poses of the views, sum of squared residuals, numbers of unknowns."""

    lens: FloatArray
    poses: list[tuple[FloatArray, FloatArray]]
    squares: float
    terms: int
    unknowns: int


def _fit(views: Sequence[View], radial: int, tangential: int) -> _Fit:
    flags = cv2.CALIB_FIX_ASPECT_RATIO | (0 if tangential else cv2.CALIB_ZERO_TANGENT_DIST)
    for number, flag in enumerate((cv2.CALIB_FIX_K1, cv2.CALIB_FIX_K2, cv2.CALIB_FIX_K3), 1):
        flags |= 0 if number <= radial else flag
    steps = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    rms, matrix, distortion, turns, shifts = cv2.calibrateCamera(
        [np.c_[view.points, np.zeros(len(view.points))].astype(np.float32) for view in views],
        [view.pixels.astype(np.float32)[:, None] for view in views],
        views[0].shape[::-1],
        np.eye(3),
        np.zeros(5),
        flags=flags,
        criteria=steps,
    )
    terms = radial + 2 * tangential
    return _Fit(
        lens=np.r_[matrix[0, 0], matrix[:2, 2], np.ravel(distortion)[:5]],
        poses=[
            (np.asarray(turn, dtype=float), np.asarray(shift, dtype=float))
            for turn, shift in zip(turns, shifts, strict=True)
        ],
        squares=float(rms) ** 2 * sum(len(view.points) for view in views),
        terms=terms,
        unknowns=3 + terms + 6 * len(views),
    )


def _concluded(views: Sequence[View], fit: _Fit, tests: dict[str, float], rejected: tuple[str, ...]) -> LensEstimate:
    """Covariance, residuals and checks of the chosen fit; the poses are eliminated view by view."""
    active = np.r_[True, True, True, fit.lens[3:] != 0]
    normal, residuals = np.zeros((8, 8)), []
    matrix = np.array([[fit.lens[0], 0, fit.lens[1]], [0, fit.lens[0], fit.lens[2]], [0, 0, 1.0]])
    for view, (turn, shift) in zip(views, fit.poses, strict=True):
        flat = np.c_[view.points, np.zeros(len(view.points))]
        there, slopes = cv2.projectPoints(flat, turn, shift, matrix, fit.lens[3:])
        residuals.append(view.pixels - there[:, 0])
        pose, lens = slopes[:, :6], np.c_[slopes[:, 6] + slopes[:, 7], slopes[:, 8:15]]
        own = lens - pose @ np.linalg.lstsq(pose, lens, rcond=None)[0]
        normal += own.T @ own
    squares = sum(float((residual**2).sum()) for residual in residuals)
    count = 2 * sum(len(view.points) for view in views)
    covariance = np.zeros((8, 8))
    covariance[np.ix_(active, active)] = (
        np.linalg.inv(normal[np.ix_(active, active)]) * squares / (count - fit.unknowns)
    )
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn, _ in fit.poses])
    angle = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))
    if angle < LEAST_ANGLE:
        raise CalibrationError(
            f"all views are parallel within {angle:.1f} degrees: the focal length needs views that differ by "
            f"{LEAST_ANGLE:g} degrees at least; tilt the target by 20 to 40 degrees about both axes"
        )
    rms = float(np.sqrt(squares / count))
    if rms > LARGEST_RESIDUAL:
        worst = max(zip(residuals, views, strict=True), key=lambda entry: float((entry[0] ** 2).mean()))[1].name
        raise CalibrationError(
            f"the points are off by {rms:.2f} px rms, at most {LARGEST_RESIDUAL:g} is what a flat, rigid target "
            f"leaves; most in {worst}: is the target flat, and its size stated right?"
        )
    hull = cv2.contourArea(cv2.convexHull(np.concatenate([view.pixels for view in views]).astype(np.float32)))
    covered = float(hull / np.prod(views[0].shape))
    warnings = list(rejected)
    if covered < COVERED:
        warnings.append(
            f"the views cover {covered:.0%} of the frame: beyond them the distortion is extrapolated; show the target "
            "in every corner"
        )
    return LensEstimate(
        lens=fit.lens,
        covariance=covariance,
        residuals=tuple(residuals),
        rms=rms,
        angle=angle,
        covered=covered,
        tests=tests,
        warnings=tuple(warnings),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaneEstimate:
    """Result of `estimate_plane`: the camera with its plane, the residual (m, 2) of the points in px, its rms."""

    camera: CameraCalibration
    residual: FloatArray
    rms: float


def estimate_plane(view: View, camera: CameraCalibration, std: float | None = None) -> PlaneEstimate:
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

    points, start = _in_image_axes(view.points, np.asarray(first, dtype=np.float64), camera)

    def off(entries: FloatArray, values: FloatArray | None = lens) -> FloatArray:
        back = np.c_[points, np.ones(len(points))] @ np.linalg.inv(np.r_[entries, 1.0].reshape(3, 3)).T
        ideal = back[:, :2] / back[:, 2:] + centre
        return np.asarray((ideal if values is None else distorted(values, ideal)) - view.pixels).ravel()

    entries = (start / start[2, 2]).ravel()[:8]
    # columns scaled alike: by what a px at the edge of the target does
    scale = np.maximum(np.abs(entries), np.r_[[1e-3 * abs(entries[0])] * 6, [1e-6] * 2])

    def scaled(part: FloatArray) -> FloatArray:
        return off(part * scale)

    found = optimize.least_squares(scaled, entries / scale, jac="3-point", method="lm", xtol=1e-14)
    entries, slopes = found.x * scale, found.jac / scale
    residual = off(entries)
    rms = float(np.sqrt((residual**2).mean()))
    if rms > LARGEST_RESIDUAL and std is None:
        raise CalibrationError(
            f"{view.name}: the points are off the plane by {rms:.2f} px rms, at most {LARGEST_RESIDUAL:g} is what a "
            "flat target leaves" + (": calibrate the lens too, with --views" if lens is None else "")
        )
    variance = std**2 if std is not None else float((residual**2).sum()) / (residual.size - 8)
    covariance = np.zeros((16, 16))
    covariance[8:, 8:] = variance * np.linalg.inv(slopes.T @ slopes)
    if lens is not None:  # a change of the lens' parameters moves the plane that fits best
        known = camera.covariance[:8, :8]
        steps = np.diag(np.sqrt(np.diag(known)))
        changes = np.stack([(off(entries, lens + step) - off(entries, lens - step)) / 2 for step in steps], axis=1)
        by_lens = np.divide(changes, np.diag(steps), out=np.zeros_like(changes), where=np.diag(steps) > 0)
        follows = -np.linalg.lstsq(slopes, by_lens, rcond=None)[0]
        covariance[:8, :8] = known
        covariance[8:, :8] = follows @ known
        covariance[:8, 8:] = covariance[8:, :8].T
        covariance[8:, 8:] += follows @ known @ follows.T
    plane = replace(camera, homography=np.r_[entries, 1.0].reshape(3, 3), covariance=covariance)
    return PlaneEstimate(camera=plane, residual=residual.reshape(-1, 2), rms=rms)


def _in_image_axes(
    points: FloatArray, homography: FloatArray, camera: CameraCalibration
) -> tuple[FloatArray, FloatArray]:
    """Points (m, 2) of the target, and the homography to them, in the axes of the image.

    The top left pixel is (0, 0) mm, and in the middle of the frame x runs along the rows.
    """
    homography = homography / homography[2, 2]
    slope = homography[:2, :2] - np.outer(homography[:2, 2], homography[2, :2])
    x, y = slope[:, 0] / np.linalg.norm(slope[:, 0])
    motion = np.eye(3)
    motion[:2, :2] = [[x, y], [-y, x]]
    motion[1] *= np.sign(np.linalg.det(slope))
    turned = motion @ homography
    motion[:2, 2] = -replace(camera, homography=turned).to_mm(np.zeros((1, 2)))[0]
    return points @ motion[:2, :2].T + motion[:2, 2], motion @ homography


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraEstimate:
    """Result of `calibrate_camera`: what is written, how it was found, and warnings."""

    camera: CameraCalibration
    views: tuple[View, ...] = ()
    lens: LensEstimate | None = None
    plane_view: View | None = None
    plane: PlaneEstimate | None = None
    warnings: tuple[str, ...] = ()


def read_corners(corners: str, size: str, std: float, shape: tuple[int, int]) -> View:
    """Read the corners of a rectangle on the specimen, in px, and its two sides in mm.

    Parameters
    ----------
    corners
        ``X0,Y0:X1,Y1:X2,Y2:X3,Y3`` in the order around the rectangle, beginning at its top left.
    size
        ``WIDTHxHEIGHTmm``.
    std
        Standard uncertainty of a corner, px.
    shape
        Rows and columns of the frames.

    Raises
    ------
    ConfigurationError
        An option has another form, the corners lie outside the frame or do not go around a convex quadrilateral.
    """
    sides = re.fullmatch(r"([\d.]+)x([\d.]+)mm", size)
    groups = [part.split(",") for part in corners.split(":")]
    try:
        pixels = np.array([[float(number) for number in group] for group in groups])
        width, height = (float(side) for side in sides.groups()) if sides else (0.0, 0.0)
    except ValueError:
        pixels, width, height = np.zeros(0), 0.0, 0.0
    if pixels.shape != (4, 2) or not np.isfinite(pixels).all() or not (width > 0 and height > 0 and std > 0):
        raise ConfigurationError(
            "--corners is X0,Y0:X1,Y1:X2,Y2:X3,Y3 in px around a rectangle and --size its WIDTHxHEIGHTmm, "
            f"--corner-std positive; not {corners!r}, {size!r}, {std:g}"
        )
    if (pixels < -0.5).any() or (pixels > np.array(shape[::-1]) - 0.5).any():
        raise ConfigurationError(f"--corners lie outside the frame of {shape[1]} x {shape[0]} px: {corners}")
    steps = np.roll(pixels, -1, axis=0) - pixels
    turns = steps[:, 0] * np.roll(steps[:, 1], -1) - steps[:, 1] * np.roll(steps[:, 0], -1)
    if not (turns > 0).all():
        raise ConfigurationError(
            f"--corners must go around the rectangle clockwise from its top left; given: {corners}"
        )
    points = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    return View(name="--corners", points=points, pixels=pixels, shape=shape)


def calibrate_camera(
    stated: FrameSettings,
    target: Target | None,
    *,
    views: str | None = None,
    plane: str | None = None,
    lens: CameraCalibration | None = None,
    corners: tuple[str, str, float] | None = None,
) -> CameraEstimate:
    """Calibrate lens and plane, or either, from capture files.

    Parameters
    ----------
    stated
        What is stated of the files.
    target
        The target; None where only `corners` are given.
    views
        Pattern of the photographs of the lens.
    plane
        Pattern of the photograph of the target on the specimen's plane; of several the points are averaged.
    lens
        An earlier calibration, for its lens.
    corners
        In place of `plane`: arguments of `read_corners`.

    Raises
    ------
    CalibrationError
        The photographs do not allow it.
    ConfigurationError
        Neither views nor a plane are given, or both of what excludes one another.
    """
    if (views or plane) and target is None:
        raise ConfigurationError("--views and --plane need --target, what the photographs show")
    if not (views or plane or corners):
        raise ConfigurationError("nothing to calibrate: state --views, --plane or --corners")
    if views and lens is not None:
        raise ConfigurationError("--views calibrate a lens, --lens takes one from a file: state one of them")
    if plane and corners:
        raise ConfigurationError("--plane and --corners both state the plane: state one of them")
    details: dict[str, Any] = {} if lens is None else {"lens": dict(lens.details).get("lens")}
    groups, found, estimate = list[CaptureFiles](), list[View](), None
    warnings: tuple[str, ...] = ()
    camera = None if lens is None else replace(lens, homography=None, covariance=_lens_only(lens.covariance))
    if views and target:
        groups.append(CaptureFiles.find("views", views, stated))
        found, reasons = find_views(groups[-1], target)
        estimate = estimate_lens(found, reasons)
        warnings = estimate.warnings
        camera = CameraCalibration(
            shape=found[0].shape, lens=estimate.lens, covariance=np.pad(estimate.covariance, (0, 8))
        )
        details["lens"] = {
            "views": [view.name for view in found],
            "rms_px": estimate.rms,
            "largest_angle_deg": estimate.angle,
            "covered": estimate.covered,
            "p_values": estimate.tests,
        }
    view, fitted = None, None
    if plane and target:
        groups.append(CaptureFiles.find("plane", plane, stated))
        view = _mean_view(groups[-1], target)
    elif corners:
        if camera is None and stated.shape is None:
            raise ConfigurationError("--corners need the frames' size: --shape ROWSxCOLUMNS, or --lens")
        shape = camera.shape if camera is not None else stated.shape
        assert shape is not None
        view = read_corners(*corners, shape)
    if view is not None:
        camera = camera or CameraCalibration(shape=view.shape)
        fitted = estimate_plane(view, camera, corners[2] if corners else None)
        camera = fitted.camera
        details["plane"] = {"photograph": view.name, "rms_px": fitted.rms, **_plane_details(camera)}
        hull = cv2.contourArea(cv2.convexHull(view.pixels.astype(np.float32))) / np.prod(view.shape)
        if hull < COVERED / 2:
            beyond = f"the target covers {hull:.0%} of the frame on the plane: beyond it the plane is extrapolated"
            warnings = (*warnings, beyond)
    assert camera is not None
    details |= {"warnings": list(warnings), "provenance": provenance("camera", groups, {})}
    return CameraEstimate(
        camera=replace(camera, details=details),
        views=tuple(found),
        lens=estimate,
        plane_view=view,
        plane=fitted,
        warnings=warnings,
    )


def _mean_view(files: CaptureFiles, target: Target) -> View:
    """Return the points of the target, averaged over the photographs of one plane."""
    shots, reasons = find_views(files, target)
    if reasons:
        raise CalibrationError("; ".join(reasons))
    if any(len(shot.points) != len(shots[0].points) for shot in shots):
        raise CalibrationError("--plane: the photographs show different points of the target: state one of them")
    return replace(shots[0], pixels=np.mean([shot.pixels for shot in shots], axis=0))


def _plane_details(camera: CameraCalibration) -> dict[str, float]:
    """Return scale and tilt of the plane with their standard uncertainties, as far as they are known."""
    (scale, scale_std), (tilt, tilt_std) = camera.scale(camera.centre), camera.tilt_deg
    names = ("mm_per_pixel", "mm_per_pixel_std", "tilt_deg", "tilt_std_deg")
    return {
        name: value for name, value in zip(names, (scale, scale_std, tilt, tilt_std), strict=True) if np.isfinite(value)
    }


def _lens_only(covariance: FloatArray) -> FloatArray:
    """Covariance of the lens, that of an earlier plane left out."""
    out = np.zeros_like(covariance)
    out[:8, :8] = covariance[:8, :8]
    return out


def draw_camera(estimate: CameraEstimate, path: Path) -> None:
    """Draw the residuals of all points, the distortion over the frame, and the local scale on the plane."""
    from matplotlib.figure import Figure

    camera = estimate.camera
    rows, columns = camera.shape
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    axes = figure.subplots(1, 3)
    y, x = np.mgrid[0 : rows - 1 : 24j, 0 : columns - 1 : 24j]
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    shown = list(zip(estimate.views, estimate.lens.residuals, strict=True)) if estimate.lens else []
    if estimate.plane_view and estimate.plane:
        shown.append((estimate.plane_view, estimate.plane.residual))
    for view, residual in shown:
        axes[0].quiver(*view.pixels.T, *residual.T, angles="xy", scale=0.004 * 300 / columns, width=0.003)
    axes[0].set_title("residuals of the points (a tenth of the width: 0.12 px)" if shown else "no residuals")
    if camera.lens is not None:
        shift = np.linalg.norm(distorted(camera.lens, grid) - grid, axis=1).reshape(x.shape)
        axes[1].clabel(axes[1].contour(x, y, shift, cmap="viridis"), fmt="%.2f")
    axes[1].set_title("distortion, px" if camera.lens is not None else "no lens calibrated")
    if camera.homography is not None:
        scale = np.sqrt(np.linalg.det(camera.jacobian(grid))).reshape(x.shape)
        axes[2].clabel(axes[2].contour(x, y, 100 * (scale / scale.mean() - 1), cmap="viridis"), fmt="%.3f")
    axes[2].set_title("scale on the plane, % of its mean" if camera.homography is not None else "no plane calibrated")
    for axis in axes:
        axis.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), aspect="equal", xlabel="x, px", ylabel="y, px")
    figure.savefig(path, dpi=120)
