"""Two cameras from simultaneous views of a flat target: both lenses and the relative pose, by one least-squares fit.

Unknowns are either lens (with the distortion terms that its own views ask for), the relative pose, and the pose of the
target in every view (bundle adjustment; Triggs et al., Vision Algorithms, 2000). The target's poses are eliminated view
by view; the covariance is that of the fit, with the variance of its residuals. What the fit cannot see by itself is
stated beside it: the epipolar residual on views held out, and a distance on the target. A focal length or baseline that
is off by .1 % leaves the epipolar residual at zero and every length off by as much.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from rgbmidic.errors import CalibrationError
from rgbmidic.fields.plane import CameraCalibration
from rgbmidic.tools.stereo import CameraPair, lens_matrix, project_with_slopes, triangulate
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.camera import LIMITS as CAMERA_LIMITS
from rgbmidic_calibration.camera import CameraEstimate, estimate_lens
from rgbmidic_calibration.target import View

Pose = tuple[FloatArray, FloatArray]
"""Rotation vector (3,) and translation (3,)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoConstants:
    """Constants of `estimate_stereo`.

    Attributes
    ----------
    held_out
        One view in so many is left out of a second fit, on which the epipolar residual and the distance are checked
        (chosen).
    min_fitted
        Views that this second fit has at least, below which none is held out (those that a lens needs).
    max_steps
        Gauss-Newton steps; 4 to 8 are needed (measured).
    max_disagreement
        Angle (degrees) between the relative poses of two views from which they cannot be of the same cameras: views of
        one target numbered from opposite ends differ by tens of degrees (chosen).
    min_baseline_angle
        Angle of the cameras seen from the target (degrees) below which a warning says that depth is hardly measured:
        its error is that in the plane over the sine (derived).
    """

    held_out: int = 4
    min_fitted: int = CAMERA_LIMITS.min_views
    max_steps: int = 30
    max_disagreement: float = 3.0
    min_baseline_angle: float = 5.0


LIMITS = StereoConstants()


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewPair:
    """The target seen by both cameras at one time: the same points of it, in the same order.

    Attributes
    ----------
    left, right
        The two views.
    """

    left: View
    right: View

    @classmethod
    def of(cls, left: View, right: View) -> ViewPair:
        """Keep the points that both cameras see; a `CalibrationError` where they are fewer than six."""
        points, first, second = common_points(left.points, right.points)
        if len(points) < 6:
            raise CalibrationError(f"{left.name} and {right.name} show {len(points)} common points, 6 are needed")
        return cls(
            left=replace(left, points=points, pixels=left.pixels[first], factor=None),
            right=replace(right, points=points, pixels=right.pixels[second], factor=None),
        )

    @property
    def name(self) -> str:
        """Names of both photographs."""
        return f"{self.left.name} and {self.right.name}"

    @property
    def renumbered(self) -> ViewPair:
        """The same pair with the right camera's points numbered from the opposite end."""
        return replace(self, right=replace(self.right, pixels=self.right.pixels[::-1]))

    def triangulated(self, pair: CameraPair, std: float) -> tuple[FloatArray, FloatArray]:
        """Return the target's points (m, 3) in space, mm, and their epipolar residuals (m,), px."""
        spread = np.broadcast_to(std**2 * np.eye(4), (len(self.left.points), 4, 4))
        seen = triangulate(pair, self.left.pixels, self.right.pixels, spread)
        return seen.points, seen.residual

    def rms(self, pair: CameraPair) -> float:
        """Epipolar residual of the points, px rms."""
        return float(np.sqrt(np.mean(self.triangulated(pair, 1.0)[1] ** 2)))

    def relative_length(self, pair: CameraPair) -> float:
        """Distance of the two farthest points as triangulated, over that on the target."""
        target = self.left.points
        distance = np.linalg.norm(target[:, None] - target, axis=2)
        ends = list(np.unravel_index(int(distance.argmax()), distance.shape))
        points, _ = self.triangulated(pair, 1.0)
        return float(np.linalg.norm(np.diff(points[ends], axis=0)) / distance.max())


def common_points(first: FloatArray, second: FloatArray) -> tuple[FloatArray, list[int], list[int]]:
    """Return the points (m, 2) that two lists have in common, and their indices in both."""
    indices = {tuple(point): index for index, point in enumerate(np.round(second, 6).tolist())}
    rows = [
        (row, indices[key]) for row, point in enumerate(np.round(first, 6).tolist()) if (key := tuple(point)) in indices
    ]
    ours, theirs = [row for row, _ in rows], [row for _, row in rows]
    return first[ours], ours, theirs


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoEstimate:
    """Result of `estimate_stereo`.

    Attributes
    ----------
    pair : CameraPair
        What is written. Its `details` state the views, the residuals of either camera, the epipolar residual and the
        relative length on views held out, and warnings.
    residuals : tuple of ndarray, shape (m, 4)
        Residuals of the points of every view, x and y left, x and y right, px.
    """

    pair: CameraPair
    residuals: tuple[FloatArray, ...]


def estimate_stereo(pairs: Sequence[ViewPair], rejected: Sequence[str] = ()) -> StereoEstimate:
    """Calibrate two cameras by the target's points in simultaneous views.

    Parameters
    ----------
    pairs
        Five at least, under different angles.
    rejected
        Reasons why other photographs were not used, for the messages.

    Returns
    -------
    StereoEstimate

    Raises
    ------
    CalibrationError
        As `rgbmidic_calibration.camera.estimate_lens` of either camera; or the views do not agree in one relative pose.
    """
    if len(pairs) < CAMERA_LIMITS.min_views:
        reasons = "".join(f"; {reason}" for reason in rejected)
        raise CalibrationError(
            f"two cameras need {CAMERA_LIMITS.min_views} simultaneous views of the target at least, under different "
            f"angles; both cameras see it in {len(pairs)}{reasons}"
        )
    estimates = [estimate_lens([getattr(pair, side) for pair in pairs]) for side in ("left", "right")]
    pairs = _with_circle_centres(pairs, estimates)
    pairs, start, poses = _agreeing(pairs, estimates)
    fit = _Fit.solved(start, pairs, poses, estimates)
    details: dict[str, Any] = {
        "views": [pair.name for pair in pairs],
        "rms_px": {side: fit.rms[number] for number, side in enumerate(("left", "right"))},
        "baseline_mm": fit.pair.baseline,
        "angle_deg": fit.pair.angle_deg,
    }
    sides = zip(("left", "right"), estimates, strict=True)
    warnings = [f"{side} camera: {text}" for side, one in sides for text in one.camera.details["warnings"]]
    warnings += rejected
    if max(fit.rms) > CAMERA_LIMITS.max_residual:
        raise CalibrationError(
            f"the points are off by {max(fit.rms):.2f} px rms once both cameras are fitted together, at most "
            f"{CAMERA_LIMITS.max_residual:g} is what cameras at rest leave: were all views taken at one time by both?"
        )
    if not fit.pair.baseline > 5 * np.sqrt(np.trace(fit.pair.covariance[19:, 19:])):
        raise CalibrationError(
            f"both cameras stand at one place: their distance, {fit.pair.baseline:.2g} mm, is nothing within its "
            "uncertainty: are the photographs of one camera stated twice?"
        )
    held_out = list(pairs[LIMITS.held_out - 1 :: LIMITS.held_out])
    if held_out and len(pairs) - len(held_out) >= LIMITS.min_fitted:
        fitted = [number for number in range(len(pairs)) if (number + 1) % LIMITS.held_out]
        subset_fit = _Fit.solved(fit.pair, [pairs[n] for n in fitted], [fit.poses[n] for n in fitted], estimates)
        details["held_out"] = {"views": [pair.name for pair in held_out], **verdicts(subset_fit.pair, held_out)}
    else:
        warnings.append(
            f"{len(pairs)} views are too few to hold some out: the epipolar residual and a distance on other views are "
            "not known (rgbmidic-calibrate check)"
        )
    if (angle := _angle_from_target(fit.pair, fit.poses)) < LIMITS.min_baseline_angle:
        warnings.append(
            f"seen from the target the cameras are {angle:.1f} degrees apart: depth is "
            f"{1 / np.sin(np.radians(angle)):.0f} times as uncertain as what lies in the plane"
        )
    details["warnings"] = warnings
    return StereoEstimate(pair=replace(fit.pair, details=details), residuals=fit.residuals)


def verdicts(pair: CameraPair, views: Sequence[ViewPair]) -> dict[str, float]:
    """State the epipolar residual (px rms) and the relative error of a length on views that were not fitted."""
    residuals = np.concatenate([view.triangulated(pair, 1.0)[1] for view in views])
    lengths = np.array([view.relative_length(pair) - 1 for view in views])
    scatter = float(lengths.std(ddof=1) / np.sqrt(len(lengths))) if len(lengths) > 1 else float("nan")
    figures = {
        "epipolar_px": float(np.sqrt(np.mean(residuals**2))),
        "relative_length_error": float(lengths.mean()),
        "relative_length_std": scatter,
    }
    return {name: value for name, value in figures.items() if np.isfinite(value)}


def _with_circle_centres(pairs: Sequence[ViewPair], estimates: Sequence[CameraEstimate]) -> list[ViewPair]:
    """Return the pairs with the images of circles' centres as points, as the lens' own fits corrected them."""
    corrected = zip(pairs, estimates[0].residuals, estimates[1].residuals, strict=True)
    return [
        ViewPair(left=replace(pair.left, pixels=left[0]), right=replace(pair.right, pixels=right[0]))
        for pair, left, right in corrected
    ]


def _pose(view: View, camera: CameraCalibration) -> Pose:
    """Return the pose of the target in one view."""
    lens = camera.lens
    assert lens is not None
    _, turn, shift = cv2.solvePnP(_in_space(view.points), view.pixels, lens_matrix(lens), lens[3:])
    return np.ravel(turn), np.ravel(shift)


def _in_space(points: FloatArray) -> FloatArray:
    return np.pad(points, ((0, 0), (0, 1)))


def _relative(left: Pose, right: Pose) -> Pose:
    """Return the pose of the left camera in the right one's axes, from the target's pose in both."""
    turn = cv2.Rodrigues(right[0])[0] @ cv2.Rodrigues(left[0])[0].T
    return np.ravel(cv2.Rodrigues(turn)[0]), np.asarray(right[1] - turn @ left[1])


def _agreeing(
    pairs: Sequence[ViewPair], estimates: Sequence[CameraEstimate]
) -> tuple[list[ViewPair], CameraPair, list[Pose]]:
    """Number the points of all views alike, and return them with the cameras' pose and the target's in the left camera.

    A symmetric board may be numbered from opposite ends by the two cameras. Of both numberings of every view those
    are taken that agree in one relative pose.
    """
    cameras = [estimate.camera for estimate in estimates]
    poses = [_pose(pair.left, cameras[0]) for pair in pairs]
    is_symmetric = [np.allclose(p := pair.left.points, p[0] + p[-1] - p[::-1]) for pair in pairs]
    numberings = [[pair, pair.renumbered] if both else [pair] for pair, both in zip(pairs, is_symmetric, strict=True)]
    candidates = [
        [(option, _relative(pose, _pose(option.right, cameras[1]))) for option in options]
        for options, pose in zip(numberings, poses, strict=True)
    ]

    def angle(first: Pose, second: Pose) -> float:
        turn = cv2.Rodrigues(first[0])[0] @ cv2.Rodrigues(second[0])[0].T
        return float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))

    def best_angles(pose: Pose) -> FloatArray:
        return np.array([min(angle(pose, other) for _, other in options) for options in candidates])

    best = min(
        (pose for options in candidates for _, pose in options), key=lambda pose: float(np.median(best_angles(pose)))
    )
    angles = best_angles(best)
    if angles.max() > LIMITS.max_disagreement:
        raise CalibrationError(
            f"{pairs[int(angles.argmax())].name} show the cameras {angles.max():.1f} degrees off where the other views "
            "have them: were they taken at one time, and do the lists of files pair the right ones? Leave them out"
        )
    selected = [min(options, key=lambda entry: angle(best, entry[1])) for options in candidates]
    lenses = [replace(camera, covariance=np.zeros((16, 16)), details={}) for camera in cameras]
    translation = np.median([pose[1] for _, pose in selected], axis=0)
    pair = CameraPair(left=lenses[0], right=lenses[1], rotation=best[0], translation=translation)
    return [option for option, _ in selected], pair, poses


def _angle_from_target(pair: CameraPair, poses: Sequence[Pose]) -> float:
    """Return the mean angle in degrees between the directions from the target's origin to both cameras."""
    turn, shift = pair.poses[1]
    to_left = -np.array([pose[1] for pose in poses])
    to_right = to_left - turn.T @ shift
    cosines = (to_left * to_right).sum(axis=1) / np.linalg.norm(to_left, axis=1) / np.linalg.norm(to_right, axis=1)
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean())


@dataclass(frozen=True, slots=True, kw_only=True)
class _Fit:
    """A joint fit: the cameras with their covariance, the target's poses, residuals (m, 4) and rms of either camera."""

    pair: CameraPair
    poses: list[Pose]
    residuals: tuple[FloatArray, ...]
    rms: tuple[float, float]

    @classmethod
    def solved(
        cls, pair: CameraPair, views: Sequence[ViewPair], poses: Sequence[Pose], estimates: Sequence[CameraEstimate]
    ) -> _Fit:
        """Minimise the squared residuals, each over those of its camera's own fit, by Gauss-Newton."""
        is_free = pair.parameters != 0  # distortion terms that a camera's own views do not ask for are held at 0
        is_free[[0, 1, 2, 8, 9, 10, *range(16, 22)]] = True
        active = np.flatnonzero(is_free)
        noise = np.repeat([max(estimate.camera.details["lens"]["rms_px"], 1e-6) for estimate in estimates], 2)
        poses, squares, steps = list(poses), np.inf, 0
        while True:
            normal, right_side, total, blocks = np.zeros((len(active), len(active))), np.zeros(len(active)), 0.0, []
            for residual, by_cameras, by_pose in _linearised(pair, views, poses):
                r = (residual / noise).ravel()
                cameras, target_slopes = (
                    (slopes / noise[:, None]).reshape(len(r), -1) for slopes in (by_cameras[..., active], by_pose)
                )
                projection = np.linalg.pinv(target_slopes)
                across = cameras - target_slopes @ (projection @ cameras)
                normal += across.T @ across
                right_side += across.T @ r
                total += float(r @ r)
                blocks.append((residual, r, cameras, projection))
            is_settled = abs(squares - total) <= 1e-10 * total
            squares, steps = total, steps + 1
            if is_settled or steps > LIMITS.max_steps:
                break
            change = np.linalg.solve(normal, right_side)
            values = pair.parameters
            values[active] += change
            pair = pair.with_parameters(values)
            for number, (_, r, cameras, projection) in enumerate(blocks):
                step = projection @ (r - cameras @ change)
                poses[number] = poses[number][0] + step[:3], poses[number][1] + step[3:]
        if not is_settled:
            raise CalibrationError("the fit of both cameras does not settle: are the views tilted in different ways?")
        residuals = tuple(block[0] for block in blocks)
        count = 4 * sum(map(len, residuals))
        covariance = np.zeros((22, 22))
        variance = squares / (count - len(active) - 6 * len(views))
        scale = 1 / np.sqrt(np.diag(normal))  # px, rad and mm: the inverse is symmetric to rounding then only
        inverse = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
        covariance[np.ix_(active, active)] = (inverse + inverse.T) / 2 * variance
        everything = np.concatenate(residuals)
        rms = tuple(float(np.sqrt((everything[:, columns] ** 2).mean())) for columns in (slice(2), slice(2, 4)))
        lenses = [np.pad(covariance[block, block], (0, 8)) for block in (slice(8), slice(8, 16))]
        left, right = (replace(c, covariance=lens) for c, lens in zip(pair.cameras, lenses, strict=True))
        solved = replace(pair, left=left, right=right, covariance=covariance)
        return cls(pair=solved, poses=poses, residuals=residuals, rms=(rms[0], rms[1]))


def _linearised(
    pair: CameraPair, views: Sequence[ViewPair], poses: Sequence[Pose]
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Yield residuals (m, 4) of each view, and the slopes of its points by cameras (m, 4, 22) and pose (m, 4, 6)."""
    for view, (turn, shift) in zip(views, poses, strict=True):
        count = len(view.left.points)
        residual, by_cameras, by_pose = np.empty((count, 4)), np.zeros((count, 4, 22)), np.empty((count, 4, 6))
        composed = cv2.composeRT(turn, shift, pair.rotation, pair.translation)
        chain = np.block([[composed[2], composed[3]], [composed[6], composed[7]]])  # by the target's pose
        chain_pair = np.block([[composed[4], composed[5]], [composed[8], composed[9]]])  # by the relative pose
        for side, (seen, camera, pose) in enumerate(
            (
                (view.left, pair.left, (turn, shift)),
                (view.right, pair.right, (np.ravel(composed[0]), np.ravel(composed[1]))),
            )
        ):
            assert camera.lens is not None
            rows, lens = slice(2 * side, 2 * side + 2), slice(8 * side, 8 * side + 8)
            pixels, by_cameras[:, rows, lens], slopes = project_with_slopes(camera.lens, _in_space(seen.points), pose)
            residual[:, rows] = seen.pixels - pixels
            by_pose[:, rows] = slopes @ chain if side else slopes
            if side:
                by_cameras[:, rows, 16:] = slopes @ chain_pair
        yield residual, by_cameras, by_pose
