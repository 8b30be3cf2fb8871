"""Starts for the Gauss-Newton iteration, however large the motion, and how sure they are; coarse pictures first.

Keypoints that both states share (`keypoints`) are found in pictures reduced 8 times, then 4, 2 and 1 times. The nodes
follow the pairs around them by a robust local affine fit. How sure such a start is says the correlation of the images
around the nodes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from rgbmidic.correlation.keypoints import Box, Keypoints, pairs
from rgbmidic.correlation.matching import correlation_around
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import FloatArray

__all__ = ["FoundStart", "confidence", "find_start", "find_starts", "search_reach"]

_SURE = 0.95
"""Confidence from which finer pictures are not looked at: at .9, speckles of 3 px may be off by 1.2 px (measured)."""
_AGREES = 0.5
"""Correlation coefficient from which the images around a node agree."""
_STILL = 0.8
"""The same at rest, which is not asked of a search: at 0.5, speckles of 7 px were off by 2.6 px."""
_REDUCTIONS = (8, 4, 2, 1)
_SMALL = 300.0
"""Side (px) of regions up to which pictures of full size are looked at: larger ones have keypoints enough at half."""
_KEYPOINTS = 1000
"""Most keypoints of the reference: 1500 cost half again as much and were no surer on 1024 px (measured)."""
_MOST = 5000
"""Most keypoints of the deformed image, where there are as many per area."""
_CONTEXT = 24.0
"""Surroundings (px) of the region in which keypoints are looked for too."""
_REACH = 128.0
"""Motion (px) that is looked for at least; the longer side of the region where that is more."""
_FITTED = 12
"""Pairs to which the motion around a node is fitted."""
_TURNS = 5
"""Robust fits until the weights have settled."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundStart:
    """A displacement to start from, and how sure it is.

    Attributes
    ----------
    displacement : ndarray, shape (N, 2)
        px.
    confidence : float
        See `confidence`.
    """

    displacement: FloatArray
    confidence: float


def confidence(reference: Reference, deformed: Deformed, displacement: FloatArray, least: float = _AGREES) -> float:
    """Share of the nodes around which the images correlate by `least` or more at a displacement (N, 2).

    Nodes count that see something in both states, and at least a tenth of those that do in the reference, so that
    a few speckles alone make no start.
    """
    residual = Residual.at(reference, deformed, reference.values, [displacement] * len(reference.images))
    around = correlation_around(residual)
    weight = reference.sums(reference.pixel_weights, reference.pixel_weights[0])[..., 0].sum(axis=0)
    seen = reference.mesh.to_nodes(weight) > 0
    with np.errstate(invalid="ignore"):
        agrees = around >= least
    return float(agrees.sum() / max(int(np.isfinite(around).sum()), 0.1 * seen.sum(), 1))


def search_reach(nodes: FloatArray) -> float:
    """Distance (px) from where nodes (N, 2) may be up to which a search looks for them: the longer side of the region,
    at least `_REACH`."""
    return max(float(np.ptp(nodes, axis=0).max()), _REACH)


def find_start(reference: Reference, deformed: Deformed) -> FoundStart:
    """The surest start of `find_starts`; rest where there is none."""
    rest = FoundStart(displacement=np.zeros_like(reference.mesh.nodes), confidence=0.0)
    return max(find_starts(reference, deformed), key=lambda found: found.confidence, default=rest)


def find_starts(reference: Reference, deformed: Deformed, last: FloatArray | None = None) -> Iterator[FoundStart]:
    """Starts from ever finer pictures, each surer than the one before, until one is sure; rest alone, if that is.

    They are looked for within the region's longer side, but at least 128 px, of rest and of `last` (N, 2).
    """
    nodes, offset = reference.mesh.nodes, reference.offset(deformed)
    rest = np.zeros_like(nodes)
    if last is None and (sure := confidence(reference, deformed, rest, _STILL)) >= _SURE:
        yield FoundStart(displacement=rest, confidence=sure)
        return
    side = float(np.ptp(nodes, axis=0).max())
    here = Box.around(nodes, _CONTEXT, reference.images.shape[1:])
    known = nodes if last is None else np.concatenate([nodes, nodes + last])
    there = Box.around(known - offset, search_reach(nodes), deformed.weights.shape[1:])
    most = int(min(_KEYPOINTS * there.area / here.area, _MOST))
    best, images = 0.0, deformed.images
    for reduction in _REDUCTIONS if side <= _SMALL else _REDUCTIONS[:-1]:
        f = Keypoints.find(reference.images, reference.weights, here, reduction, _KEYPOINTS)
        g = Keypoints.find(images, deformed.weights, there, reduction, most)
        points, motion = pairs(f, replace(g, points=g.points + offset), 2.0 * reduction)
        if not len(points):
            continue
        displacement = _followed(points, motion, reference.mesh, float(reduction))
        found = FoundStart(displacement=displacement, confidence=confidence(reference, deformed, displacement))
        if found.confidence > best:
            best = found.confidence
            yield found
        if best >= _SURE:
            return


def _followed(points: FloatArray, motion: FloatArray, mesh: Tri3Mesh, scale: float) -> FloatArray:
    """Motion (N, 2) of the nodes: one affine field, and what the pairs around each add to it by a local one; around
    the nodes at a crack those on their own side."""
    nodes = mesh.nodes
    middle, size = points.mean(axis=0), np.ptp(points, axis=0).max() + 1.0
    basis, at_nodes = (np.c_[np.ones(len(where)), (where - middle) / size] for where in (points, nodes))
    affine = _robust_fit(basis[None], motion[None], 1e-6, 4 * scale)[0]
    rest = motion - basis @ affine
    distance, near = map(np.asarray, cKDTree(points).query(mesh.places, k=[*range(1, min(_FITTED, len(points)) + 1)]))
    step = (points[near] - nodes[:, None]) / np.maximum(distance[:, -1:, None], 1.0)
    local = np.concatenate([np.ones((*step.shape[:2], 1)), step], axis=2)
    return np.asarray(at_nodes @ affine + _robust_fit(local, rest[near], 0.3, scale)[:, 0])


def _robust_fit(basis: FloatArray, motion: FloatArray, ridge: float, scale: float) -> FloatArray:
    """Coefficients (T, 3, 2) of T fits of `motion` (T, K, 2) by `basis` (T, K, 3), whose first function is 1, with
    Cauchy weights of `scale` px; `ridge` holds the slopes back where the points do not tell them."""
    weight = np.ones(basis.shape[:2])
    held = np.diag([1e-6, ridge, ridge])
    for _ in range(_TURNS):
        # no BLAS, whose sums may depend on the number of threads
        weighted = (basis * weight[..., None])[..., None]
        normal, right = ((weighted * side[:, :, None]).sum(axis=1) for side in (basis, motion))
        found = np.linalg.solve(normal + held, right)
        off = np.linalg.norm(motion - np.einsum("tka,tab->tkb", basis, found), axis=2)
        weight = 1 / (1 + (off / scale) ** 2)
    return np.asarray(found)
