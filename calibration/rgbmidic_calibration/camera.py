"""Lens and plane of the specimen, from photographs of a flat target (Zhang, IEEE PAMI 22, 2000).

The lens follows from views under different angles: focal length, principal point and as many distortion terms as an F
test asks for. The plane follows from one photograph of the target where the specimen will be: a homography
(`rgbmidic.fields.plane`). The uncertainty of every parameter is that of the least-squares fit to the target's points,
with the variance of their residuals; what the lens leaves uncertain is carried into the plane.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from scipy import optimize, stats

from rgbmidic.errors import CalibrationError
from rgbmidic.fields.plane import CameraCalibration, distorted, undistorted
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.target import View

LEAST_VIEWS = 5
"""Views of the target from which a lens is calibrated: each gives two equations for the focal length and principal
point (Zhang), which leaves seven for the distortion and the check."""
LEAST_ANGLE = 10.0
"""Largest angle (degrees) between two views below which all count as parallel: the focal length follows from 1 - cos of
it, 1.5 %, with corners good to .1 % of the target (derived)."""
LARGEST_RESIDUAL = 0.5
"""Residual of the points (px rms) above which no target is flat and rigid: ten times that of the detection (chosen)."""
PAYS = 0.001
"""Level of the F test from which the next distortion term is taken up. At .01 three of 100 lenses took up a term by
chance, which left a strain of 6e-4 in a corner that no view reached; at .001 none (benchmarks/camera.py)."""
_RIM = 32
"""Corners of the polygon that stands for a circle: its area is 0.6 % too small, and so is the offset (derived)."""
_OUTLYING = 3.0
"""Residual of a view, over the median, that gives a warning: in OpenCV's pictures the largest is 1.3 by `find_view`,
and 6 by the corners of OpenCV's own sample, some of which are wrong (benchmarks/camera.py)."""
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

    The pixels are square. Circles are corrected by `_centre_offset`, as a first fit places them. Distortion terms are
    taken up one after the other (k1, k2, k3; p1 and p2 together), the one that lowers the squares most first, as long
    as it pays at the level `PAYS` of the F test.

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
    if any(view.radius for view in views):
        views = _centred(views, _fit(views, 1, 0))
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


def _centre_offset(points: FloatArray, radius: float, image: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Offset (m, 2), px, of the centroids of circles' images from the images of their centres.

    Where perspective or distortion enlarge one side of a circle, its centroid lies there (Heikkila, IEEE PAMI 22,
    2000): that of the polygon which `image`, from mm to px, makes of the circle.
    """
    if not radius:
        return np.zeros((1, 2))
    angle = np.linspace(0, 2 * np.pi, _RIM, endpoint=False)
    rim = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    centres = image(points)
    corner = image((points[:, None] + rim).reshape(-1, 2)).reshape(-1, _RIM, 2) - centres[:, None]
    following = np.roll(corner, -1, axis=1)
    area = corner[..., 0] * following[..., 1] - corner[..., 1] * following[..., 0]
    return np.asarray(((corner + following) * area[..., None]).sum(axis=1) / (3 * area.sum(axis=1, keepdims=True)))


def _centred(views: Sequence[View], fit: _Fit) -> list[View]:
    """Views with the images of the circles' centres as points."""
    matrix = np.array([[fit.lens[0], 0, fit.lens[1]], [0, fit.lens[0], fit.lens[2]], [0, 0, 1.0]])

    def image(places: FloatArray, turn: FloatArray, shift: FloatArray) -> FloatArray:
        flat = np.c_[places, np.zeros(len(places))]
        return np.asarray(cv2.projectPoints(flat, turn, shift, matrix, fit.lens[3:])[0][:, 0])

    return [
        replace(
            view, pixels=view.pixels - _centre_offset(view.points, view.radius, partial(image, turn=turn, shift=shift))
        )
        for view, (turn, shift) in zip(views, fit.poses, strict=True)
    ]


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
    sizes = np.array([np.sqrt((residual**2).mean()) for residual in residuals])
    warnings += [
        f"{views[index].name}: the points are off by {sizes[index]:.3f} px rms, those of half the views by less than "
        f"{np.median(sizes):.3f}: was the target moved or bent? Leave it out"
        for index in np.flatnonzero(sizes > _OUTLYING * np.median(sizes)).tolist()
    ]
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

    at_first, motion = replace(camera, homography=first / first[2, 2]).in_image_axes()
    points, start = view.points @ motion[:2, :2].T + motion[:2, 2], at_first.homography
    assert start is not None

    def seen(places: FloatArray, entries: FloatArray, values: FloatArray | None) -> FloatArray:
        back = np.c_[places, np.ones(len(places))] @ np.linalg.inv(np.r_[entries, 1.0].reshape(3, 3)).T
        ideal = back[:, :2] / back[:, 2:] + centre
        return ideal if values is None else distorted(values, ideal)

    def off(entries: FloatArray, values: FloatArray | None = lens) -> FloatArray:
        return (seen(points, entries, values) - pixels).ravel()

    entries = start.ravel()[:8]
    pixels = view.pixels - _centre_offset(points, view.radius, lambda places: seen(places, entries, lens))
    # columns scaled alike: by what a px at the edge of the target does
    scale = np.maximum(np.abs(entries), np.r_[[1e-3 * abs(entries[0])] * 6, [1e-6] * 2])

    def scaled(part: FloatArray) -> FloatArray:
        return off(part * scale)

    found = optimize.least_squares(scaled, entries / scale, jac="3-point", method="lm", xtol=1e-14)
    entries, slopes = found.x * scale, np.asarray(found.jac, dtype=np.float64) / scale
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
