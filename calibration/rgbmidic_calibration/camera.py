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
from typing import Any, Self

import cv2
import numpy as np
from scipy import optimize, special, stats

from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.fields.plane import CameraCalibration, distorted, undistorted
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.settings import FrameSettings
from rgbmidic.typing import BoolArray, FloatArray, FloatImage
from rgbmidic_calibration.captures import CaptureFiles, provenance

__all__ = [
    "LensEstimate",
    "PlaneEstimate",
    "Target",
    "View",
    "estimate_lens",
    "estimate_plane",
    "find_view",
    "photograph",
]

_KINDS = ("chessboard", "charuco", "circles", "acircles")
_FORM = re.compile(rf"({'|'.join(_KINDS)}):(\d+)x(\d+):([\d.]+)mm(?::([\d.]+)mm)?(?::(DICT_\w+))?")
LEAST_VIEWS = 5
"""Views of the target from which a lens is calibrated: each gives two equations for the focal length and principal
point (Zhang), which leaves seven for the distortion and the check."""
LEAST_ANGLE = 10.0
"""Largest angle (degrees) between two views below which all count as parallel: the focal length follows from 1 - cos of
it, 1.5 %, with corners good to .1 % of the target (derived)."""
CLIPPED = 0.005
"""Fraction of saturated samples within the target above which a photograph is refused: chosen; glare on one square of
a board of 54 is 1.9 %."""
BLURRED = 0.25
"""Blur of the target's edges (10 to 90 %), over the square's side, above which a photograph is refused: beyond it the
blur of one edge reaches the next corner's window (chosen)."""
LARGEST_RESIDUAL = 0.5
"""Residual of the points (px rms) above which no target is flat and rigid: ten times that of the detection (chosen)."""
PAYS = 0.01
"""Level of the F test from which the next distortion term is taken up."""
COVERED = 0.5
"""Fraction of the frame that the views' points must cover, or a warning says that the lens is extrapolated (chosen)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A flat target with points at known places.

    Attributes
    ----------
    kind
        ``"chessboard"`` (inner corners), ``"charuco"`` (squares), ``"circles"`` or ``"acircles"`` (asymmetric).
    columns, rows
        Numbers of them along both sides.
    spacing
        mm between neighbours; of asymmetric circles half the distance in a row, as OpenCV counts it.
    marker
        Side of a ChArUco board's markers, mm.
    dictionary
        OpenCV's name of their dictionary.
    """

    kind: str
    columns: int
    rows: int
    spacing: float
    marker: float = 0.0
    dictionary: str = "DICT_5X5_100"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``KIND:COLUMNSxROWS:SPACINGmm``, for ``charuco`` with ``:MARKERmm`` and ``:DICTIONARY``.

        Raises
        ------
        ConfigurationError
            The text has another form, or names what cannot be a target.
        """
        found = _FORM.fullmatch(text.strip())
        form = (
            f"--target is KIND:COLUMNSxROWS:SPACINGmm with a kind of {', '.join(_KINDS)}, such as chessboard:9x6:2.5mm "
            "(inner corners), charuco:8x6:10mm:7.5mm:DICT_5X5_100 (squares, markers)"
        )
        if found is None:
            raise ConfigurationError(f"{form}; not {text!r}")
        kind, columns, rows, spacing, marker, dictionary = found.groups()
        try:
            target = cls(kind=kind, columns=int(columns), rows=int(rows), spacing=float(spacing))
            if kind == "charuco":
                target = replace(target, marker=float(marker or 0), dictionary=dictionary or target.dictionary)
        except ValueError:
            raise ConfigurationError(f"{form}; not {text!r}") from None
        wrong = min(target.columns, target.rows) < 3 or target.spacing <= 0
        if wrong or (kind == "charuco") != bool(marker) or not target.marker < target.spacing:
            raise ConfigurationError(
                f"{form}; at least 3 points along a side, markers smaller than squares; not {text!r}"
            )
        if not hasattr(cv2.aruco, target.dictionary):
            raise ConfigurationError(f"--target: OpenCV has no dictionary {target.dictionary}")
        return target

    @property
    def points(self) -> FloatArray:
        """Places (n, 2) of the points on the target, mm."""
        if self.kind == "charuco":
            return np.asarray(self._board().getChessboardCorners(), dtype=np.float64)[:, :2]
        row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
        if self.kind == "acircles":
            column = 2 * column + row % 2
        return np.stack([column, row], axis=1) * self.spacing

    def _board(self) -> Any:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.spacing, self.marker, dictionary)

    def find(self, image: Any) -> tuple[FloatArray, FloatArray] | None:
        """Find the target in an image (H, W) of 8 bit.

        Returns
        -------
        tuple of ndarray, shape (m, 2), or None
            Its points in mm and in px; None where it is not found whole (a ChArUco board: six points of it).
        """
        size = (self.columns, self.rows)
        if self.kind == "charuco":
            corners, numbers, *_ = cv2.aruco.CharucoDetector(self._board()).detectBoard(image)
            if numbers is None or len(numbers) < 6:
                return None
            return self.points[np.ravel(numbers)], np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        if self.kind == "chessboard":
            # normalised images (CALIB_CB_NORMALIZE_IMAGE) cost .2 px
            there, points = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_ACCURACY)
            if not there:
                there, points = cv2.findChessboardCornersSB(
                    image, size, flags=cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
                )
        else:
            grid = cv2.CALIB_CB_ASYMMETRIC_GRID if self.kind == "acircles" else cv2.CALIB_CB_SYMMETRIC_GRID
            there, points = cv2.findCirclesGrid(image, size, flags=grid)
        return (self.points, np.asarray(points, dtype=np.float64).reshape(-1, 2)) if there else None


def refined_corners(image: FloatImage, points: FloatArray, pixels: FloatArray, reach: float) -> FloatArray:
    """Fit the model of a blurred corner to the image around each corner of a chessboard.

    The grey levels are ``a + b erf(d1 / s) erf(d2 / s)`` with the distances d1 and d2 from the two edges: seven
    unknowns a corner, by Gauss-Newton. What OpenCV finds is off by .015 px, this by .003 px (noise of .5 %, tests).

    Parameters
    ----------
    image : ndarray, shape (H, W), float32
        Grey levels.
    points, pixels : ndarray, shape (m, 2)
        The corners on the target, mm, and where they were found, px.
    reach : float
        mm around a corner in which the target shows nothing but its edges.

    Returns
    -------
    ndarray, shape (m, 2)
        px; where the fit leaves the corner's window, what was found before.
    """
    homography = np.asarray(cv2.findHomography(points, pixels)[0], dtype=np.float64)

    def seen(places: FloatArray) -> FloatArray:
        values = np.c_[places, np.ones(len(places))] @ homography.T
        return np.asarray(values[:, :2] / values[:, 2:])

    edges = [seen(points + step) - seen(points - step) for step in reach * np.eye(2)]
    half = int(min(_WINDOW, np.min([np.linalg.norm(edge, axis=1).min() for edge in edges]) / (2 * np.sqrt(2))))
    if half < _LEAST_WINDOW:
        return pixels
    y, x = (part.ravel() for part in np.mgrid[-half : half + 1, -half : half + 1])
    corner = np.round(pixels).astype(int)
    inside = ((corner >= half) & (corner < np.array(image.shape[::-1]) - half)).all(axis=1)
    values = image[
        np.clip(corner[:, 1:] + y, 0, image.shape[0] - 1), np.clip(corner[:, :1] + x, 0, image.shape[1] - 1)
    ].astype(np.float64)
    angles = [np.arctan2(edge[:, 1], edge[:, 0]) for edge in edges]
    low, high = np.percentile(values, (5, 95), axis=1)

    def model(state: FloatArray) -> FloatArray:
        dx, dy = x - state[:, :1], y - state[:, 1:2]
        distance = [dy * np.cos(angle) - dx * np.sin(angle) for angle in (state[:, 2:3], state[:, 3:4])]
        width = np.exp(state[:, 4:5])
        return np.asarray(
            state[:, 5:6] + state[:, 6:7] * special.erf(distance[0] / width) * special.erf(distance[1] / width)
        )

    state = np.column_stack([pixels - corner, *angles, np.zeros(len(pixels)), (low + high) / 2, (high - low) / 2])
    signs = np.einsum("mp,mp->m", model(state) - state[:, 5:6], values - values.mean(axis=1, keepdims=True))
    state[:, 6] *= np.where(signs < 0, -1, 1)
    steps = np.array([1e-4, 1e-4, 1e-5, 1e-5, 1e-4, 1.0, 1.0])
    for _ in range(_TURNS):
        slopes = np.stack(
            [(model(state + step) - model(state - step)) / (2 * step.sum()) for step in np.diag(steps)], axis=2
        )
        normal = slopes.transpose(0, 2, 1) @ slopes
        scale = 1 / np.sqrt(np.maximum(np.einsum("maa->ma", normal), 1e-12))
        normal = normal * scale[:, :, None] * scale[:, None] + 1e-9 * np.eye(7)
        right = np.einsum("mpa,mp->ma", slopes, values - model(state)) * scale
        change = np.linalg.solve(normal, right[..., None])[..., 0] * scale
        state += np.clip(change, -_LARGEST_CHANGE, _LARGEST_CHANGE)
    found = corner + state[:, :2]
    sure = inside & (np.abs(found - pixels) < 1).all(axis=1) & np.isfinite(state).all(axis=1)
    return np.where(sure[:, None], found, pixels)


_WINDOW, _LEAST_WINDOW = 15.0, 4
"""Largest and smallest half width (px) of the window around a corner: beyond 15 px nothing is gained, below 4 px there
are hardly more samples than unknowns."""
_TURNS = 12
"""Gauss-Newton iterations of a corner: after 8 no corner moves by 1e-4 px (measured)."""
_LARGEST_CHANGE = np.array([1.0, 1.0, 0.2, 0.2, 0.5, np.inf, np.inf])
"""Largest step of position (px), angles, and logarithm of the width; the grey levels are linear."""


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """Points of the target in one photograph.

    Attributes
    ----------
    name : str
        Of the photograph.
    points : ndarray, shape (m, 2)
        Their places on the target, mm.
    pixels : ndarray, shape (m, 2)
        Where they are in the frame, px.
    shape : tuple of int
        Rows and columns of the frame.
    """

    name: str
    points: FloatArray
    pixels: FloatArray
    shape: tuple[int, int]


def photograph(frame: Mosaic | ChannelFrame) -> tuple[FloatImage, BoolArray]:
    """Return the mean image (H, W) of a frame's samples, in grey levels above black, and where it is saturated.

    Of a mosaic every pixel is the mean over red, green, green and blue around it in equal parts, with the weights 1 2 1
    along both axes: no lattice of the colours is left, and nothing is shifted.
    """
    values = np.asarray(frame.values, dtype=np.float32) - np.float32(frame.black_level.mean())
    clipped = np.asarray(frame.values) >= frame.white_level
    if isinstance(frame, Mosaic):
        smooth = np.array([0.25, 0.5, 0.25])
        return np.asarray(cv2.sepFilter2D(values, -1, smooth, smooth, borderType=cv2.BORDER_REFLECT_101)), clipped
    return np.asarray(values.mean(axis=0)), np.asarray(clipped.any(axis=0))


def find_view(frame: Mosaic | ChannelFrame, target: Target, name: str) -> View:
    """Find the target in a frame.

    Raises
    ------
    CalibrationError
        It is not found, saturated or blurred; the message names the photograph.
    """
    image, clipped = photograph(frame)
    low, high = np.percentile(image, (0.5, 99.5))
    grey = np.round(np.clip((image - low) * (255 / max(high - low, 1e-6)), 0, 255)).astype(np.uint8)
    found = target.find(grey)
    if found is None:
        raise CalibrationError(f"{name}: the {target.kind} of {target.columns} x {target.rows} is not found")
    points, pixels = found
    inside = np.zeros(image.shape, dtype=np.uint8)
    cv2.fillConvexPoly(inside, cv2.convexHull(np.round(pixels).astype(np.int32)), 1)
    if (fraction := float(clipped[inside > 0].mean())) > CLIPPED:
        raise CalibrationError(
            f"{name}: {fraction:.1%} of the samples within the target are saturated, at most {CLIPPED:.1%} may be: "
            "take away light or glare"
        )
    if target.kind == "chessboard":
        sharpness = cv2.estimateChessboardSharpness(grey, (target.columns, target.rows), pixels.astype(np.float32))[0]
        edge = float(np.ravel(np.asarray(sharpness))[0])
        side = float(np.linalg.norm(np.diff(pixels[: target.columns], axis=0), axis=1).mean())
        if not edge <= BLURRED * side:
            raise CalibrationError(
                f"{name}: the edges of the squares are {edge:.1f} px wide, at most {BLURRED:g} of their side of "
                f"{side:.0f} px may be: focus, or hold the target still"
            )
    if target.kind in ("chessboard", "charuco"):
        reach = target.spacing if target.kind == "chessboard" else (target.spacing - target.marker) / 2
        pixels = refined_corners(image, points, pixels, 0.8 * reach)
    return View(name=name, points=points, pixels=pixels, shape=(image.shape[0], image.shape[1]))


def find_views(files: CaptureFiles, target: Target) -> tuple[list[View], tuple[str, ...]]:
    """Find the target in every photograph; those without it come as reasons."""
    views, reasons = list[View](), list[str]()
    for frame, name in zip(files.frames(), files.labels, strict=True):
        try:
            views.append(find_view(frame, target, name))
        except CalibrationError as error:
            reasons.append(str(error))
    return views, tuple(reasons)


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

    def off(entries: FloatArray, points: FloatArray, values: FloatArray | None) -> FloatArray:
        back = np.c_[points, np.ones(len(points))] @ np.linalg.inv(np.r_[entries, 1.0].reshape(3, 3)).T
        ideal = back[:, :2] / back[:, 2:] + centre
        return np.asarray((ideal if values is None else distorted(values, ideal)) - view.pixels)

    # the axes of the image: the top left pixel is (0, 0), and x runs along the rows in the middle
    slope = first[:2, :2] / first[2, 2] - np.outer(first[:2, 2], first[2, :2]) / first[2, 2] ** 2
    x, y = slope[:, 0] / np.linalg.norm(slope[:, 0])
    turn = np.array([[x, y], [-y, x]])
    turn[1] *= np.sign(np.linalg.det(slope))
    motion = np.eye(3)
    motion[:2, :2] = turn
    begin = replace(camera, homography=motion @ first / first[2, 2])
    origin = begin.to_mm(np.zeros((1, 2)))[0]
    motion[:2, 2] = -origin
    points = view.points @ turn.T - origin
    start = motion @ first
    entries = (start / start[2, 2]).ravel()[:8]
    # columns scaled alike: by what a px at the edge of the target does
    scale = np.maximum(np.abs(entries), np.r_[[1e-3 * abs(entries[0])] * 6, [1e-6] * 2])

    def scaled(part: FloatArray) -> FloatArray:
        return off(part * scale, points, lens).ravel()

    found = optimize.least_squares(scaled, entries / scale, jac="3-point", method="lm", xtol=1e-14)
    entries = found.x * scale
    residual = off(entries, points, lens)
    rms = float(np.sqrt((residual**2).mean()))
    if rms > LARGEST_RESIDUAL and std is None:
        raise CalibrationError(
            f"{view.name}: the points are off the plane by {rms:.2f} px rms, at most {LARGEST_RESIDUAL:g} is what a "
            "flat target leaves" + (": calibrate the lens too, with --views" if lens is None else "")
        )
    variance = std**2 if std is not None else float((residual**2).sum()) / (residual.size - 8)
    own = found.jac / scale
    covariance = np.zeros((16, 16))
    fitted = np.linalg.inv(own.T @ own)
    covariance[8:, 8:] = fitted * variance
    if lens is not None:
        steps = np.sqrt(np.diag(camera.covariance)[:8])
        by_lens = np.zeros((residual.size, 8))
        for number in np.flatnonzero(steps):
            step = np.zeros(8)
            step[number] = steps[number]
            change = off(entries, points, lens + step) - off(entries, points, lens - step)
            by_lens[:, number] = change.ravel() / (2 * steps[number])
        follows = -fitted @ own.T @ by_lens
        known = camera.covariance[:8, :8]
        covariance[:8, :8] = known
        covariance[8:, :8] = follows @ known
        covariance[:8, 8:] = covariance[8:, :8].T
        covariance[8:, 8:] += follows @ known @ follows.T
    plane = replace(camera, homography=np.r_[entries, 1.0].reshape(3, 3), covariance=covariance)
    return PlaneEstimate(camera=plane, residual=residual, rms=rms)


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
        shots, reasons = find_views(groups[-1], target)
        if reasons:
            raise CalibrationError("; ".join(reasons))
        if any(len(shot.points) != len(shots[0].points) for shot in shots):
            raise CalibrationError("--plane: the photographs show different points of the target: state one of them")
        view = replace(shots[0], pixels=np.mean([shot.pixels for shot in shots], axis=0))
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
        tilt, tilt_std = camera.tilt_deg
        scale, scale_std = camera.scale(camera.centre)
        details["plane"] = {"photograph": view.name, "rms_px": fitted.rms, "mm_per_pixel": scale} | {
            key: value
            for key, value in (("mm_per_pixel_std", scale_std), ("tilt_deg", tilt), ("tilt_std_deg", tilt_std))
            if np.isfinite(value)
        }
        hull = cv2.contourArea(cv2.convexHull(view.pixels.astype(np.float32))) / np.prod(view.shape)
        if hull < COVERED / 2:
            warnings = (
                *warnings,
                f"the target covers {hull:.0%} of the frame on the plane: beyond it the plane is extrapolated",
            )
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
