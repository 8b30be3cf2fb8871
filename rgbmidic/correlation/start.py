"""A start for the Gauss-Newton iteration: masked block matching, coarse windows first.

The lights' images are locally normalised (so that reflections and shading weigh little) and summed into one feature
image per state. Large windows at half resolution find motions up to the search radius; small windows around every
node refine them; windows that disagree with their neighbours are replaced (normalised median test, Westerweel and
Scarano, Exp. Fluids 39, 2005).
"""

from __future__ import annotations

import logging

import cv2
import numpy as np
from scipy.spatial import cKDTree

from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["coarse_start", "refine_start"]

logger = logging.getLogger(__name__)


_NORMALISE = 10.0
"""Standard deviation (px) of the local mean and contrast."""
_WINDOW = 64
"""Side of the coarse windows, px."""
_FINE_WINDOW = 32
_FINE_RADIUS = 6
_SCORE = 0.3
"""Correlation coefficient under which a window counts as not found."""


def coarse_start(
    reference: Reference, deformed: Deformed, search_radius: float, around: FloatArray | None = None
) -> FloatArray:
    """Displacement (N, 2) of the nodes in px, found within `search_radius` px of `around` (N, 2), or of rest."""
    f, g = (feature_image(state.images, state.weights) for state in (reference, deformed))
    half_f, half_g = (np.asarray(cv2.pyrDown(image), dtype=np.float32) for image in (f, g))
    centres = _window_centres(reference)
    side = min(_WINDOW, *(int(size) // 2 * 2 for size in f.shape))
    guess = None if around is None else around[cKDTree(reference.mesh.nodes).query(centres)[1]] / 2
    motion, score = _match(half_f, half_g, centres / 2, side // 2, int(np.ceil(search_radius / 2)), guess)
    motion = _smooth_outliers(centres, 2 * motion, score, tolerance=3.0)
    start = _interpolate(centres, motion, reference.mesh.nodes)
    return _refine(reference, f, g, start)


def refine_start(reference: Reference, deformed: Deformed, start: FloatArray) -> FloatArray:
    """Improve a start (N, 2) that is right within a few px."""
    f, g = (feature_image(state.images, state.weights) for state in (reference, deformed))
    return _refine(reference, f, g, start)


def feature_image(images: FloatImage, weights: FloatImage) -> FloatImage:
    """Sum over the lights of the locally normalised images (k, H, W), 0 where excluded; shape (H, W)."""
    total = np.zeros(images.shape[1:], dtype=np.float32)
    for image, weight in zip(images, weights, strict=True):
        norm = _blur(weight) + np.float32(1e-6)
        centred = image - _blur(image * weight) / norm
        contrast = np.sqrt(_blur(centred * centred * weight) / norm)
        floor = np.float32(0.1) * contrast.max() + np.float32(1e-20)
        total += weight * centred / (contrast + floor)
    return total


def _blur(image: FloatImage) -> FloatImage:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _NORMALISE, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)


def _window_centres(reference: Reference) -> FloatArray:
    """Centres (M, 2) of the coarse windows: a grid over the mesh, kept where the region is."""
    low, high = reference.mesh.nodes.min(axis=0), reference.mesh.nodes.max(axis=0)
    count = np.maximum(np.round((high - low) / _WINDOW), 1).astype(int)
    axes = [a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low, high, count, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    covered = reference.pixels.scatter(np.ones(reference.pixels.rows.size, dtype=np.float32))
    share = cv2.blur(covered, (_WINDOW, _WINDOW))[np.round(grid[:, 1]).astype(int), np.round(grid[:, 0]).astype(int)]
    return np.asarray(grid[share >= min(0.25, float(share.max()))])


def _match(
    f: FloatImage, g: FloatImage, centres: FloatArray, side: int, radius: int, guess: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Motion (M, 2) in px and score (M,) of the windows of f around `centres`, looked for in g around the guess."""
    motion = np.zeros((len(centres), 2)) if guess is None else guess.copy()
    score = np.full(len(centres), -1.0)
    height, width = f.shape
    for i, (x, y) in enumerate(centres):
        left = min(max(round(x - side / 2), 0), max(width - side, 0))
        top = min(max(round(y - side / 2), 0), max(height - side, 0))
        template = f[top : top + side, left : left + side]
        dx, dy = np.round(motion[i]).astype(int)
        x0, y0 = max(left + dx - radius, 0), max(top + dy - radius, 0)
        area = g[y0 : max(top + dy + radius + side, 0), x0 : max(left + dx + radius + side, 0)]
        if area.shape[0] < template.shape[0] or area.shape[1] < template.shape[1] or not template.any():
            continue
        surface = np.asarray(cv2.matchTemplate(area, template, cv2.TM_CCORR_NORMED), dtype=np.float32)
        _, best, _, (column, row) = cv2.minMaxLoc(surface)
        if not np.isfinite(best):
            continue
        score[i] = best
        motion[i] = (
            x0 + column - left + _vertex(surface[row], column),
            y0 + row - top + _vertex(surface[:, column], row),
        )
    return motion, score


def _vertex(line: FloatImage, peak: int) -> float:
    """Position of the vertex of the parabola through a peak and its two neighbours, relative to the peak."""
    if peak == 0 or peak == len(line) - 1:
        return 0.0
    before, at, after = (float(value) for value in line[peak - 1 : peak + 2])
    bend = before - 2 * at + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


def _smooth_outliers(points: FloatArray, motion: FloatArray, score: FloatArray, *, tolerance: float) -> FloatArray:
    """Replace motions with a low score or far from their neighbours' median by the median of good neighbours."""
    if len(points) < 4:
        good = score > _SCORE
        return np.where(good[:, None], motion, np.median(motion[good], axis=0) if good.any() else 0.0)
    neighbours = np.asarray(cKDTree(points).query(points, k=min(9, len(points)))[1])[:, 1:]
    found = np.where((score > _SCORE)[:, None], motion, np.nan)
    with np.errstate(all="ignore"):
        for _ in range(2):
            around = found[neighbours]
            median = _nanmedian(around)
            spread = _nanmedian(np.abs(around - median[:, None]))
            off = np.abs(found - median) > tolerance + 3 * spread
            found[off.any(axis=1)] = np.nan
    return _fill_from_nearest(points, found)


def _nanmedian(values: FloatArray) -> FloatArray:
    """Median over axis 1 without NaN; NaN where nothing is left, without a warning."""
    empty = np.asarray(np.isnan(values).all(axis=1, keepdims=True))
    result = np.nanmedian(np.where(empty, 0.0, values), axis=1)
    return np.where(empty[:, 0], np.nan, result)


def _fill_from_nearest(points: FloatArray, motion: FloatArray) -> FloatArray:
    good = np.isfinite(motion).all(axis=1)
    if not good.any():
        return np.zeros_like(motion)
    count = min(4, int(good.sum()))
    distance, index = cKDTree(points[good]).query(points[~good], k=[*range(1, count + 1)])
    weight = 1 / np.maximum(distance, 1e-6)
    filled = motion.copy()
    filled[~good] = (motion[good][index] * weight[..., None]).sum(axis=1) / weight.sum(axis=1)[:, None]
    return filled


def _interpolate(points: FloatArray, motion: FloatArray, nodes: FloatArray) -> FloatArray:
    """Motion at the nodes: linear between the windows, by the best affine field beyond them."""
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import QhullError

    basis = np.c_[np.ones(len(points)), points - points.mean(axis=0)]
    if len(points) < 6:
        return np.broadcast_to(np.median(motion, axis=0), nodes.shape).copy()
    affine = np.linalg.lstsq(basis, motion, rcond=1e-6)[0]
    outside = np.c_[np.ones(len(nodes)), nodes - points.mean(axis=0)] @ affine
    try:
        # the affine part is interpolated exactly; the rest is what the windows add to it, fading outwards
        rest = LinearNDInterpolator(points, motion - basis @ affine)(nodes)
    except (QhullError, ValueError):
        return np.asarray(outside)
    nearest = _fill_from_nearest(nodes, rest)
    return np.asarray(outside + nearest)


def _refine(reference: Reference, f: FloatImage, g: FloatImage, start: FloatArray) -> FloatArray:
    nodes = reference.mesh.places
    motion, score = _match(f, g, nodes, min(_FINE_WINDOW, *f.shape), _FINE_RADIUS, start)
    # a window at the image's edge is centred inside; its motion is still the best there is
    return _smooth_outliers(nodes, motion, score, tolerance=1.0)
