"""Lens and plane: coverage of the stated uncertainty over draws, the strain that is left, and OpenCV's own pictures.

    python -m benchmarks.camera FOLDER

Every draw is another virtual camera: distortion of -2 to 2 % in the frame's corners, a plane tilted by 0 to 5 degrees
about any axis, 20 views of a chessboard under up to 25 degrees, corners with noise of .01 px. A true 95 % interval has
90.6 to 99.4 % of 100 draws (2 sigma of the binomial law), and all lines together, were they independent, 94 to 96 %. A
distortion term that the F test did not take up states no uncertainty and does not count.

FOLDER holds left01.jpg to left14.jpg of OpenCV (samples/data: 13 views of a chessboard of 9 x 6 corners, 25 mm).
Printed are residual and parameters by the corners of OpenCV's own sample (`findChessboardCorners`, `cornerSubPix` with
11 px), by what `find_view` finds, and as published in samples/data/left_intrinsics.yml; the same of right*.jpg.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import cache
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from target_scene import LENS, SHAPE, imaged, on_plane, pose, random_views, view_of

from rgbmidic.frames.data import ChannelFrame
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic_calibration.camera import estimate_lens, estimate_plane
from rgbmidic_calibration.target import Target, View, find_view

from .tables import table

NOISE, VIEWS = 0.01, 20
PUBLISHED = {"left": (535.916, 342.283, 235.571, -0.26637, -0.03859, 0.00178, -0.00028, 0.23839)}
"""samples/data/left_intrinsics.yml of OpenCV; its residual, .3926 px a point, is .278 px a coordinate."""
MESH = Tri3Mesh.from_region(Region.from_rectangle((40, 40, 600, 440), SHAPE), 25)
_C, _S = np.cos(np.radians(2)), np.sin(np.radians(2))
MOTIONS = {
    "moves by 10 px": (np.eye(2), np.array([0.8, -0.5]), (0.0, 0.0)),
    "turns by 2 deg": (np.array([[_C, -_S], [_S, _C]]), np.zeros(2), (0.0, 0.0)),
    "stretches by 1 %": (np.diag([1.01, 1.0]), np.zeros(2), (0.01 + 0.01**2 / 2, 0.0)),
}
"""Gradient and shift (mm) of a motion of the plane, and its principal Green-Lagrange strains."""


def principal(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Principal Green-Lagrange strains (E, 2) of the elements, the larger first."""
    edges = [np.diff(places[MESH.elements], axis=1).transpose(0, 2, 1) for places in (before, after)]
    gradient = edges[1] @ np.linalg.inv(edges[0])
    return np.linalg.eigvalsh(gradient.transpose(0, 2, 1) @ gradient / 2 - np.eye(2) / 2)[:, ::-1]


def draw(random: np.random.Generator) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Error over stated uncertainty of every parameter, and the strain error of every motion before and after."""
    lens, (tilt, about) = LENS.copy(), random.uniform([0, 0], [5, 2 * np.pi])
    lens[3] = random.uniform(-0.02, 0.02) / (np.hypot(*SHAPE) / 2 / lens[0]) ** 2
    where = pose(tilt * np.cos(about), tilt * np.sin(about), random.uniform(-5, 5))
    found = estimate_lens(random_views(random, VIEWS, lens=lens, noise=NOISE)).camera
    std = np.sqrt(np.diag(found.covariance))[:8]
    names = ("f", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    off = {name: (a - b) / s for name, a, b, s in zip(names, found.lens, lens, std, strict=True) if s > 0}
    camera = estimate_plane(view_of(where, random, lens=lens, noise=NOISE), found).camera
    seen, seen_std = camera.tilt_deg
    off["tilt"] = (seen - np.degrees(np.arccos(where[0][2, 2]))) / seen_std
    ends = np.array([[40.0, 40], [600, 60], [580, 440], [60, 420]])
    places, true, slopes = camera.to_mm(ends), on_plane(ends, where, lens), camera.sensitivity(ends)
    for name, a, b in (("length along x", 0, 1), ("length along y", 1, 2), ("diagonal", 0, 2)):
        length = np.linalg.norm(places[b] - places[a])
        slope = (places[b] - places[a]) / length @ (slopes[b] - slopes[a])
        off[name] = (length - np.linalg.norm(true[b] - true[a])) / np.sqrt(slope @ camera.correlation @ slope)
    strains = {}
    nodes = on_plane(MESH.nodes, where, lens)
    for name, (gradient, shift, exact) in MOTIONS.items():
        moved = imaged(nodes @ gradient.T + shift, where, lens)
        ways = principal(MESH.nodes, moved), principal(camera.to_mm(MESH.nodes), camera.to_mm(moved))
        strains[name] = tuple(float(np.abs(way - exact).max()) for way in ways)
    return off, strains


def pictures(folder: Path) -> None:
    """Lens of OpenCV's own pictures, by its corners and by those of `find_view`."""
    target, size = Target.parse("chessboard:9x6:25mm"), (9, 6)
    for side in ("left", "right"):
        ours, theirs = list[View](), list[View]()
        for path in sorted(folder.glob(f"{side}[0-9]*.jpg")):
            image = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
            frame = ChannelFrame(values=image[None].astype(np.uint16), black_level=0.0, white_level=255.0)
            ours.append(find_view(frame, target, path.name))
            corners = cv2.findChessboardCorners(image, size)[1]
            corners = (
                cv2.cornerSubPix(image, corners, (11, 11), (-1, -1), (3, 30, 0.1)).reshape(-1, 2).astype(np.float64)
            )
            theirs.append(View(name=path.name, points=target.points, pixels=corners, shape=image.shape))
        print(f"{side}: {len(ours)} pictures; rms of a coordinate (px), then f, cx, cy, k1, k2, p1, p2, k3")
        if not ours:
            continue
        rms, matrix, distortion, *_ = cv2.calibrateCamera(
            [np.c_[view.points, np.zeros(len(view.points))].astype(np.float32) for view in theirs],
            [view.pixels.astype(np.float32)[:, None] for view in theirs],
            theirs[0].shape[::-1], np.eye(3), None, flags=cv2.CALIB_FIX_ASPECT_RATIO,
        )  # fmt: skip
        rows = {"OpenCV, its corners": (rms / np.sqrt(2), np.r_[matrix[0, 0], matrix[:2, 2], distortion.ravel()[:5]])}
        fit = estimate_lens(ours)
        halves = {"one half": estimate_lens(ours[::2]), "other half": estimate_lens(ours[1::2])}
        for name, found in {"find_view": fit, **halves}.items():
            rows[name] = (found.camera.details["lens"]["rms_px"], found.camera.lens)
        rows["find_view, stated"] = (np.nan, np.sqrt(np.diag(fit.camera.covariance))[:8])
        if side in PUBLISHED:
            rows["published"] = (0.3926 / np.sqrt(2), np.array(PUBLISHED[side]))
        for name, (rms, values) in rows.items():
            print(f"{name:20s} {rms:7.3f}  {values[0]:8.2f} {values[1]:8.2f} {values[2]:8.2f}",
                  *(f"{value:9.5f}" for value in values[3:]))  # fmt: skip
        print("rms of every picture:", *(f"{np.sqrt((part**2).mean()):.3f}" for _, part in fit.residuals))


@cache
def draws(count: int) -> tuple[dict[str, list[float]], list[dict[str, tuple[float, float]]]]:
    """Errors over stated uncertainty by parameter, and strains of each draw."""
    found = [draw(random) for random in np.random.default_rng(0).spawn(count)]
    off: dict[str, list[float]] = {}
    for one, _ in found:
        for name, value in one.items():
            off.setdefault(name, []).append(float(value))
    return off, [strains for _, strains in found]


QUICK, FULL = 6, 100
"""Draws of the tables."""


@table("camera_coverage", page="../calibration/README", cost=13, own_quick=True)
def coverage(quick: bool) -> Iterator[dict[str, object]]:
    """100 virtual cameras: draws whose error is within 1.96 stated standard uncertainties, and rms(error / stated)."""
    off = draws(QUICK if quick else FULL)[0]
    some = ("f", "cx", "cy", "k1", "tilt", "length along x", "length along y", "diagonal")
    for name, values in {**{name: off[name] for name in some}, "all": [*chain(*off.values())]}.items():
        within = 100 * float((np.abs(values) < 1.96).mean())
        yield {"parameter": name, "within 95 % [%]": within, "error/stated": float(np.sqrt(np.mean(np.square(values))))}


@table("camera_strain", page="../calibration/README", cost=13, own_quick=True)
def strain_left(quick: bool) -> Iterator[dict[str, object]]:
    """Largest strain error (1e-6) over the field of a specimen that only moves, turns or stretches, images without
    noise: median and largest of the draws, in pixels with one scale and by lens and plane."""
    for name in MOTIONS:
        values = 1e6 * np.array([strains[name] for strains in draws(QUICK if quick else FULL)[1]])
        middle, largest = np.median(values, axis=0), values.max(axis=0)
        yield {
            "specimen": name,
            "one scale [1e-6]": float(middle[0]),
            "its largest [1e-6]": float(largest[0]),
            "lens and plane [1e-6]": float(middle[1]),
            "largest by lens and plane [1e-6]": float(largest[1]),
        }


if __name__ == "__main__":
    pictures(Path(sys.argv[1]))
