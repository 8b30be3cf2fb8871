"""Targets of a camera calibration: chessboard, ChArUco board, grids of circles, and their points in a photograph."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, Self

import cv2
import numpy as np
from scipy import special
from scipy.spatial import cKDTree

from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.typing import BoolArray, FloatArray, FloatImage
from rgbmidic_calibration.captures import CaptureFiles

_KINDS = ("chessboard", "charuco", "circles", "acircles")
_MM = r"(\d+\.?\d*|\.\d+)mm"
_FORM = re.compile(rf"({'|'.join(_KINDS)}):(\d+)x(\d+):{_MM}(?::{_MM})?(?::(DICT_\w+))?")


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
        match = _FORM.fullmatch(text.strip())
        form = (
            f"a target is KIND:COLUMNSxROWS:SPACINGmm with a kind of {', '.join(_KINDS)}, such as chessboard:9x6:2.5mm "
            "(inner corners), charuco:8x6:10mm:7.5mm:DICT_5X5_100 (squares, markers)"
        )
        if match is None:
            raise ConfigurationError(f"{form}; not {text!r}")
        kind, columns, rows, spacing, marker, dictionary = match.groups()
        target = cls(kind=kind, columns=int(columns), rows=int(rows), spacing=float(spacing))
        if kind == "charuco":
            target = replace(target, marker=float(marker or 0), dictionary=dictionary or target.dictionary)
        is_invalid = min(target.columns, target.rows) < 3 or target.spacing <= 0
        if is_invalid or (kind == "charuco") != bool(marker) or not target.marker < target.spacing:
            raise ConfigurationError(
                f"{form}; at least 3 points along a side, markers smaller than squares; not {text!r}"
            )
        if not hasattr(cv2.aruco, target.dictionary):
            raise ConfigurationError(f"target {text!r}: OpenCV has no dictionary {target.dictionary}")
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
            for flags in (cv2.CALIB_CB_ACCURACY, cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE):
                is_found, points = cv2.findChessboardCornersSB(image, size, flags=flags)
                if is_found:
                    break
        else:
            grid = cv2.CALIB_CB_ASYMMETRIC_GRID if self.kind == "acircles" else cv2.CALIB_CB_SYMMETRIC_GRID
            is_found, points = cv2.findCirclesGrid(image, size, flags=grid)
        return (self.points, np.asarray(points, dtype=np.float64).reshape(-1, 2)) if is_found else None


def refine_corners(image: FloatImage, points: FloatArray, pixels: FloatArray, reach: float) -> FloatArray:
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
        px; where the fit moves a corner by more than a quarter of its window, what was found before.
    """
    homography = np.asarray(cv2.findHomography(points, pixels)[0], dtype=np.float64)

    def project(target_points: FloatArray) -> FloatArray:
        values = np.c_[target_points, np.ones(len(target_points))] @ homography.T
        return np.asarray(values[:, :2] / values[:, 2:])

    edges = [project(points + step) - project(points - step) for step in reach * np.eye(2)]
    # half width (px) of the window: beyond 15 nothing is gained, below 4 there are hardly more samples than unknowns
    half = int(min(15, np.min([np.linalg.norm(edge, axis=1).min() for edge in edges]) / (2 * np.sqrt(2))))
    if half < 4:
        return pixels
    y, x = (axis_indices.ravel() for axis_indices in np.mgrid[-half : half + 1, -half : half + 1])
    corner = np.round(pixels).astype(int)
    in_image = ((corner >= half) & (corner < np.array(image.shape[::-1]) - half)).all(axis=1)
    values = image[
        np.clip(corner[:, 1:] + y, 0, image.shape[0] - 1), np.clip(corner[:, :1] + x, 0, image.shape[1] - 1)
    ].astype(np.float64)
    angles = [np.arctan2(edge[:, 1], edge[:, 0]) for edge in edges]
    low, high = np.percentile(values, (5, 95), axis=1)

    def model(state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the grey levels (m, p) and their derivatives (m, p, 7)."""
        dx, dy = (x - state[:, :1])[:, None], (y - state[:, 1:2])[:, None]
        width, step = np.exp(state[:, 4:5, None]), state[:, 6:7]
        # of both edges: coordinates along and across, the profile of a blurred edge and its derivative by the distance
        sines, cosines = np.sin(state[:, 2:4, None]), np.cos(state[:, 2:4, None])
        along, across = dx * cosines + dy * sines, dy * cosines - dx * sines
        profile = special.erf(across / width)
        e, f = profile[:, 0], profile[:, 1]
        de, df = np.moveaxis(2 / np.sqrt(np.pi) * np.exp(-((across / width) ** 2)) / width, 1, 0)
        first_slope, second_slope = step * de * f, step * e * df
        slopes = (
            first_slope * sines[:, 0] + second_slope * sines[:, 1],
            -first_slope * cosines[:, 0] - second_slope * cosines[:, 1],
            -first_slope * along[:, 0],
            -second_slope * along[:, 1],
            -first_slope * across[:, 0] - second_slope * across[:, 1],
            np.ones_like(e),
            e * f,
        )
        return state[:, 5:6] + step * e * f, np.stack(slopes, axis=2)

    state = np.column_stack([pixels - corner, *angles, np.zeros(len(pixels)), (low + high) / 2, (high - low) / 2])
    signs = np.einsum("mp,mp->m", model(state)[0] - state[:, 5:6], values - values.mean(axis=1, keepdims=True))
    state[:, 6] *= np.where(signs < 0, -1, 1)
    largest_change = np.array([1.0, 1.0, 0.2, 0.2, 0.5, np.inf, np.inf])  # px, angles, log of the width; grey levels
    for _ in range(12):  # 8 are needed (measured)
        levels, slopes = model(state)
        normal = slopes.transpose(0, 2, 1) @ slopes
        scale = 1 / np.sqrt(np.maximum(np.einsum("maa->ma", normal), 1e-12))
        normal = normal * scale[:, :, None] * scale[:, None] + 1e-9 * np.eye(7)
        right_side = np.einsum("mpa,mp->ma", slopes, values - levels) * scale
        change = np.linalg.solve(normal, right_side[..., None])[..., 0] * scale
        state += np.clip(change, -largest_change, largest_change)
        if not (np.abs(change[:, :2]) > 1e-4).any():
            break
    refined = corner + state[:, :2]
    is_accepted = in_image & (np.abs(refined - pixels) < half / 2).all(axis=1) & np.isfinite(state).all(axis=1)
    return np.where(is_accepted[:, None], refined, pixels)


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
    radius : float
        Of the circles that the points are the centres of, mm; `pixels` are then the centroids of their images. 0:
        corners.
    factor : ndarray, shape (m, 2, P), or None
        Errors of `pixels` per unit of P independent errors that they have in common, px.
    """

    name: str
    points: FloatArray
    pixels: FloatArray
    shape: tuple[int, int]
    radius: float = 0.0
    factor: FloatArray | None = None


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
    detected = target.find(grey)
    if detected is None:
        raise CalibrationError(f"{name}: the {target.kind} of {target.columns} x {target.rows} is not found")
    points, pixels = detected
    inside = np.zeros(image.shape, dtype=np.uint8)
    cv2.fillConvexPoly(inside, cv2.convexHull(np.round(pixels).astype(np.int32)), 1)
    # in OpenCV's own pictures up to 2.9 % lie in white squares and leave the residual of the corners as it is
    # (benchmarks/camera.py); of a board that is overexposed it is half
    if (fraction := float(clipped[inside > 0].mean())) > (limit := 0.05):
        raise CalibrationError(
            f"{name}: {fraction:.1%} of the samples within the target are saturated, at most {limit:.1%} may be: "
            "take away light or glare"
        )
    if target.kind == "chessboard":
        sharpness = cv2.estimateChessboardSharpness(grey, (target.columns, target.rows), pixels.astype(np.float32))[0]
        edge = float(np.ravel(np.asarray(sharpness))[0])
        side = float(np.linalg.norm(np.diff(pixels[: target.columns], axis=0), axis=1).mean())
        if not edge <= (limit := 0.25) * side:  # else the blur of one edge reaches the next corner's window (chosen)
            raise CalibrationError(
                f"{name}: the edges of the squares are {edge:.1f} px wide, at most {limit:g} of their side of "
                f"{side:.0f} px may be: focus, or hold the target still"
            )
    radius = 0.0
    if target.kind in ("chessboard", "charuco"):
        reach = target.spacing if target.kind == "chessboard" else (target.spacing - target.marker) / 2
        pixels = refine_corners(image, points, pixels, 0.8 * reach)
    else:
        radius = _radius(grey, points, pixels)
    return View(name=name, points=points, pixels=pixels, shape=(image.shape[0], image.shape[1]), radius=radius)


def _radius(image: Any, points: FloatArray, pixels: FloatArray) -> float:
    """Radius of a grid's circles, mm: the median of the blobs that OpenCV finds at the points (m, 2), mm and px."""
    blobs = cv2.SimpleBlobDetector.create().detect(image)
    blob_centres, sizes = np.array([blob.pt for blob in blobs]), np.array([blob.size for blob in blobs])
    distance, nearest = cKDTree(blob_centres).query(pixels)
    homography = np.asarray(cv2.findHomography(points, pixels)[0], dtype=np.float64)
    w = homography[2, :2] @ points.T + 1
    scale = np.sqrt(np.abs(np.linalg.det(homography)) / np.abs(w) ** 3)  # px per mm, by the determinant of the map
    return float(np.median((sizes[nearest] / 2 / scale)[distance < 1]))


def find_views(files: CaptureFiles, target: Target) -> tuple[list[View], tuple[str, ...]]:
    """Find the target in every photograph; those without it come as reasons."""
    views, reasons = list[View](), list[str]()
    for name, frame in files.frames():
        try:
            views.append(find_view(frame, target, name))
        except CalibrationError as error:
            reasons.append(str(error))
    return views, tuple(reasons)
