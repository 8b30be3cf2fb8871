"""Initial guesses of the displacement, however large the motion, and the tracking of one frame after another.

A frame starts from the last one's displacement, and from a search where that fails or loses nodes. The search compares
pictures of both states, reduced 8 times, then 4, 2 and, of small regions, 1 times. The lights' images are locally
normalised (so that reflections and shading weigh little) and averaged into one picture per state. Its keypoints (SIFT:
Lowe, Int. J. Comput. Vision 60, 2004) are paired by their descriptors, which change little under shift, rotation and
moderate strain. Angle and size of a pair give the turn and stretch of its surroundings; it counts if the pairs around
it have moved accordingly. The nodes follow the pairs around them by a robust local affine fit. The confidence of such
an initial guess is the fraction of the nodes around which the images then agree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import cv2
import numpy as np
from scipy.spatial import cKDTree

from rgbmidic.correlation.constants import USUAL, SolverConstants
from rgbmidic.correlation.nodes import correlation_around
from rgbmidic.correlation.reference import Deformed, Reference, torn_elements
from rgbmidic.correlation.residual import PrecisionMethod, Residual, interpolate_motion
from rgbmidic.correlation.solution import NO_MATCH, Solution, Status, rank
from rgbmidic.correlation.solve import solve
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.settings import SolverSettings
from rgbmidic.timing import timed_items
from rgbmidic.typing import BoolArray, FloatArray, FloatImage, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialGuess:
    """An initial guess of the displacement, and its confidence.

    Attributes
    ----------
    displacement : ndarray, shape (N, 2)
        px.
    confidence : float
        See `Search.confidence`.
    residual : Residual or None
        There, where it was looked at.
    """

    displacement: FloatArray
    confidence: float
    residual: Residual | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Keypoints:
    """Keypoints, the strongest first.

    Attributes
    ----------
    points : ndarray, shape (M, 2)
        px of the image.
    size, angle : ndarray, shape (M,)
        In px and rad.
    descriptors : ndarray, shape (M, 128), float32
        Whole numbers, the norm about 512.
    """

    points: FloatArray
    size: FloatArray
    angle: FloatArray
    descriptors: FloatImage


MIN_CONFIDENCE = 0.15
"""Confidence from which an initial guess is worth a solve: another specimen gives at most .1 (benchmarks/starts.py)."""

_VOTES = 4
"""Pairs around a pair that must agree with it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """The search for initial guesses, with its constants.

    Attributes
    ----------
    normalise
        Standard deviation of the local mean and contrast, px of the reduced picture. Chosen; with half or twice of it
        results differ by 5e-4 px at most, by more between two bodies and in a deep shadow (benchmarks/constants.py).
    flat
        Contrast that is not amplified further, over that of the most contrasted tenth of the picture. Chosen; with half
        or twice of it results differ by 2e-4 px at most, elsewhere as above (benchmarks/constants.py).
    contrast
        SIFT's threshold: lower ones add keypoints that noise makes, at .12 a jittered lattice loses most (measured).
    voters
        Pairs around a pair that vote on it, of which four must agree: with wrong pairs in a picture of 1 Mpx it happens
        to one in 1000 by chance.
    sufficient_confidence
        Confidence from which finer pictures are not looked at: at .9, speckles of 3 px may be off by 1.2 px (measured).
    min_correlation
        Correlation coefficient from which the images around a node agree: noise is half of their variance then
        (derived).
    keypoints
        Most keypoints of the reference: 1500 cost half again as much and were no surer on 1024 px (measured).
    context
        Surroundings (px) of the region in which keypoints are looked for too. Chosen; with half or twice of it results
        differ by 1.3e-3 px at most, elsewhere as above (benchmarks/constants.py).
    """

    normalise: float = 6.0
    flat: float = 0.1
    contrast: float = 0.06
    voters: int = 30
    sufficient_confidence: float = 0.95
    min_correlation: float = 0.5
    keypoints: int = 1000
    context: float = 24.0

    def candidates(
        self, reference: Reference, deformed: Deformed, last: FloatArray | None = None
    ) -> Iterator[InitialGuess]:
        """Search for initial guesses in ever finer pictures, each surer than the one before, until one is sure.

        They are looked for within `search_reach` of rest and of the last displacement.

        Parameters
        ----------
        reference, deformed
            The two states.
        last : ndarray, shape (N, 2), optional
            Displacement of the frame before, px; what is found of the motion since is added to it.

        Yields
        ------
        InitialGuess
            Rest alone, if that is sure.
        """
        nodes, offset = reference.mesh.nodes, reference.offset(deformed)
        predicted = np.zeros_like(nodes) if last is None else last

        def compared(displacement: FloatArray) -> Residual:
            return Residual.at(reference, deformed, [displacement] * len(reference.images))

        if last is None:
            residual = compared(predicted)
            # which is not asked of a search: at .5, speckles of 7 px were off by 2.6 px
            rest_confidence = self.confidence(residual, min_correlation=0.8)
            if rest_confidence >= self.sufficient_confidence:
                yield InitialGuess(displacement=predicted, confidence=rest_confidence, residual=residual)
                return
        # larger regions have keypoints enough at half the size
        reductions = (8, 4, 2, 1) if float(np.ptp(nodes, axis=0).max()) <= 300 else (8, 4, 2)
        slopes = reference.mesh.nodal_gradient(predicted)
        reference_window = _window_around(nodes, self.context, reference.images.shape[1:])
        positions = np.concatenate([nodes, nodes + predicted]) - offset
        deformed_window = _window_around(positions, search_reach(nodes), deformed.weights.shape[1:])
        as_dense = (
            self.keypoints * deformed.weights[0][deformed_window].size / reference.weights[0][reference_window].size
        )
        best, (images, weights) = 0.0, deformed.images_on_first_light(reference.registration)
        for reduction in reductions:
            f = self._keypoints(reference.images, reference.weights, reference_window, reduction, self.keypoints)
            g = self._keypoints(images, weights, deformed_window, reduction, int(min(as_dense, 5000)))
            if f is None or g is None:
                continue
            points, motion = self._pairs(f, replace(g, points=g.points + offset), 2.0 * reduction)
            if not len(points):
                continue
            # what moves beyond the last displacement is smooth where parts of the specimen turn on their own
            nearest = np.asarray(cKDTree(nodes).query(points)[1])
            before = predicted[nearest] + np.einsum("pij,pj->pi", slopes[nearest], points - nodes[nearest])
            displacement = predicted + interpolate_motion(points, motion - before, reference.mesh, float(reduction))
            residual = compared(displacement)
            confidence = self.confidence(residual)
            if confidence > best:
                best = confidence
                yield InitialGuess(displacement=displacement, confidence=confidence, residual=residual)
            if best >= self.sufficient_confidence:
                return

    def confidence(self, residual: Residual, min_correlation: float | None = None) -> float:
        """Fraction of the nodes around which the images correlate by `min_correlation`, from their residual.

        Nodes count that see something in both states, and at least a tenth of those that do in the reference, so that
        a few speckles alone make no start.
        """
        reference, coefficients = residual.reference, correlation_around(residual)
        weight = reference.sums(reference.pixel_weights, reference.pixel_weights[0])[..., 0].sum(axis=0)
        has_texture = reference.mesh.to_nodes(weight) > 0
        is_matched = coefficients >= (self.min_correlation if min_correlation is None else min_correlation)
        return float(is_matched.sum() / max(int(np.isfinite(coefficients).sum()), 0.1 * has_texture.sum(), 1))

    def _keypoints(
        self, images: FloatImage, weights: FloatImage, window: tuple[slice, slice], reduction: int, max_count: int
    ) -> Keypoints | None:
        """Find the `max_count` strongest keypoints in a window of a state's picture, where a weight is not 0."""
        if min(side.stop - side.start for side in window) // reduction < 2 * self.normalise:
            return None
        picture, weight_sum = self._picture(images, weights, window, reduction)
        # three standard deviations of the picture fit into 8 bits
        grey = np.clip(128 + 40 * picture, 0, 255).astype(np.uint8)
        # the precise upscale keeps positions free of a bias of a quarter of a pixel
        sift = cv2.SIFT.create(contrastThreshold=self.contrast, enable_precise_upscale=True)
        detected = sift.detect(grey, None)
        columns, rows = np.round(cv2.KeyPoint.convert(detected)).astype(int).reshape(-1, 2).T
        strength = np.where(weight_sum[rows, columns] > 0, [key.response for key in detected], 0.0)
        strongest = np.argsort(-strength, kind="stable")[: min(max_count, np.count_nonzero(strength))]
        if not len(strongest):
            return None
        selected, descriptors = sift.compute(grey, [detected[number] for number in strongest])
        points = np.asarray(cv2.KeyPoint.convert(selected), dtype=np.float64) * reduction + (reduction - 1) / 2
        return Keypoints(
            points=np.add(points, (window[1].start, window[0].start)),
            size=np.array([key.size for key in selected]),
            angle=np.radians([key.angle for key in selected]),
            descriptors=np.asarray(descriptors, dtype=np.float32),
        )

    def _pairs(self, first: Keypoints, second: Keypoints, tolerance: float) -> tuple[FloatArray, FloatArray]:
        """Points (P, 2) of the first state that are paired with some of the second, and their motion, px.

        Pairs are mutually nearest descriptors whose angle and size predict, within `tolerance` px and a fraction of the
        distance, where some of the pairs around them have gone.
        """
        # sums of products of whole numbers under 2^24: exact in float32, hence the same in any order, on any threads
        likeness = first.descriptors @ second.descriptors.T
        nearest, back = likeness.argmax(axis=1), np.asarray(likeness.argmax(axis=0))
        first_index = np.flatnonzero(back[nearest] == np.arange(len(nearest)))
        second_index = nearest[first_index]
        points, motion = first.points[first_index], second.points[second_index] - first.points[first_index]
        if len(first_index) <= _VOTES:
            return points[:0], motion[:0]
        neighbours = np.asarray(cKDTree(points).query(points, k=min(self.voters + 1, len(points)))[1])[:, 1:]
        step = points[neighbours] - points[:, None]
        scale, turn = (
            second.size[second_index] / first.size[first_index],
            second.angle[second_index] - first.angle[first_index],
        )
        cos, sin = (scale * np.cos(turn))[:, None], (scale * np.sin(turn))[:, None]
        turned = np.stack([cos * step[..., 0] - sin * step[..., 1], sin * step[..., 0] + cos * step[..., 1]], axis=-1)
        off = np.linalg.norm(motion[neighbours] - motion[:, None] - (turned - step), axis=-1)
        # what angle and size of a keypoint are good for, strains of 20 % included
        votes = (off <= tolerance + 0.3 * np.linalg.norm(step, axis=-1)).sum(axis=1)
        return points[votes >= _VOTES], motion[votes >= _VOTES]

    def _picture(
        self, images: FloatImage, weights: FloatImage, window: tuple[slice, slice], reduction: int
    ) -> tuple[FloatImage, FloatImage]:
        """Mean over the lights of the locally normalised images of a part, reduced, and the sum of the weights."""
        height, width = (size // reduction for size in images[0][window].shape)
        total, weight_sum = np.zeros((2, height, width), dtype=np.float32)

        def reduced(image: FloatImage) -> FloatImage:
            cropped = image[: height * reduction, : width * reduction]
            return np.asarray(cv2.resize(cropped, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32)

        for image, weight in zip(images, weights, strict=True):
            reduced_weight = reduced(weight[window])
            values = reduced(image[window] * weight[window])
            total += reduced_weight * self._normalised(
                np.asarray(values / np.maximum(reduced_weight, np.float32(1e-6))), reduced_weight
            )
            weight_sum += reduced_weight
        return np.asarray(total / np.maximum(weight_sum, np.float32(1e-6))), weight_sum

    def _normalised(self, image: FloatImage, weight: FloatImage) -> FloatImage:
        """Return an image (H, W) less its local mean, over its local standard deviation."""

        def blur(image: FloatImage) -> FloatImage:
            smooth = cv2.GaussianBlur(image, (0, 0), self.normalise, borderType=cv2.BORDER_REFLECT_101)
            return np.asarray(smooth, dtype=np.float32)

        norm = blur(weight) + np.float32(1e-6)
        centred = image - blur(image * weight) / norm
        contrast = np.sqrt(blur(centred * centred * weight) / norm)
        floor = np.float32(self.flat * np.quantile(contrast, 0.9) + 1e-20)
        return np.asarray(centred / (contrast + floor), dtype=np.float32)


def _window_around(points: FloatArray, margin: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of an image of `shape` (H, W) within `margin` px of points (N, 2) in x and y."""
    low = np.clip(np.floor(points.min(axis=0) - margin).astype(int)[::-1], 0, shape)
    high = np.clip(np.ceil(points.max(axis=0) + margin).astype(int)[::-1] + 1, 0, shape)
    return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))


def search_reach(nodes: FloatArray, min_reach: float = 128.0) -> float:
    """Distance (px) up to which nodes (N, 2) are looked for: the longer side of the region, 30 speckles at least."""
    return max(float(np.ptp(nodes, axis=0).max()), min_reach)


def find_initial_guess(reference: Reference, deformed: Deformed) -> InitialGuess:
    """Search for an initial guess.

    Parameters
    ----------
    reference, deformed
        The two states.

    Returns
    -------
    InitialGuess
        The surest of `Search.candidates`; rest, with the confidence 0, where there is none.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> random = np.random.default_rng(0)
    >>> speckle = 2 + gaussian_filter(random.normal(size=(1, 80, 80)), (0, 1.5, 1.5)).astype(np.float32)
    >>> region = Region.from_rectangle((10, 10, 69, 69), shape=(80, 80))
    >>> reference = Reference.prepare(speckle, region, mesh=Tri3Mesh.from_region(region, element_size=30))
    >>> guess = find_initial_guess(reference, Deformed.prepare(np.roll(speckle, 3, axis=2)))
    >>> guess.displacement.mean(axis=0).round()
    array([3., 0.])
    """
    no_guess = InitialGuess(displacement=np.zeros_like(reference.mesh.nodes), confidence=0.0)
    return max(Search().candidates(reference, deformed), key=lambda guess: guess.confidence, default=no_guess)


def nodal_slopes(
    mesh: Tri3Mesh, displacement: FloatArray, measured: BoolArray, constants: SolverConstants = USUAL
) -> tuple[FloatArray, IntArray]:
    """Average the displacement gradient of the intact elements around each node, or around the nearest that has some.

    Parameters
    ----------
    mesh
        N nodes, E elements.
    displacement : ndarray, shape (N, 2)
        px; of nodes that are not measured it may be NaN.
    measured : ndarray, shape (N,), bool
        Which of them are measured.
    constants
        Of the solve.

    Returns
    -------
    tuple of ndarray
        The gradient (N, 2, 2), and the node (N,) that it is from.
    """
    values = np.where(measured[:, None], displacement, 0.0)
    gradient = mesh.element_gradient(values)
    intact = measured[mesh.elements].all(axis=1) & ~torn_elements(mesh, values, constants)
    weight = np.where(intact, mesh.areas, 0.0)
    nodal_area = mesh.to_nodes(weight)
    nearest = mesh.nearest_nodes(measured & (nodal_area > 0) if intact.any() else measured)[1]
    components = [mesh.to_nodes(weight * component) for component in gradient.reshape(-1, 4).T]
    slope = np.stack(components, axis=1) / np.maximum(nodal_area, 1e-300)[:, None]
    return slope.reshape(-1, 2, 2)[nearest], nearest


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingState:
    """Initial guess of a frame, and the references so far.

    Attributes
    ----------
    displacement : ndarray, shape (N, 2), or None
        The last frame's displacement in px, gaps filled; None where there is none yet.
    unmeasured : float
        Fraction of the nodes that the last frame could not measure.
    reference_updates : tuple of int
        The frames that have become the reference in turn.
    best_match : float
        How well a frame has matched the last of them, see `ReferenceUpdate.match`; 0 where none has.

    Examples
    --------
    >>> TrackingState(displacement=None).reference_updates
    ()
    """

    displacement: FloatArray | None
    unmeasured: float = 0.0
    reference_updates: tuple[int, ...] = ()
    best_match: float = 0.0

    def extrapolate(
        self, mesh: Tri3Mesh, displacement: FloatArray, measured: BoolArray, constants: SolverConstants = USUAL
    ) -> TrackingState:
        """Return the start of the frame after one that started here.

        Nodes without data go on with the displacement, turn and strain of the nearest measured one. Where a frame has
        none that is measured, the next starts here too.

        Parameters
        ----------
        mesh
            On the reference.
        displacement : ndarray, shape (N, 2)
            Of that frame, px.
        measured : ndarray, shape (N,)
            Which of them are measured.
        constants
            Of the solve.

        Returns
        -------
        TrackingState
        """
        if not measured.any():
            return self
        slope, nearest = nodal_slopes(mesh, displacement, measured, constants)
        extrapolated = displacement[nearest] + np.einsum("nij,nj->ni", slope, mesh.nodes - mesh.nodes[nearest])
        filled = np.where(measured[:, None], displacement, extrapolated)
        return replace(self, displacement=filled, unmeasured=float((~measured).mean()))


def track(
    reference: Reference,
    deformed: Deformed,
    state: TrackingState,
    options: SolverSettings,
    method: PrecisionMethod | None,
    search: Search = Search(),
) -> Solution:
    """Solve one frame from the last frame's displacement, and from a search where that fails or loses nodes.

    Parameters
    ----------
    reference, deformed
        The two states.
    state
        The last frame's end; without a displacement the initial guess is searched for.
    options, method
        How to solve, see `solve`.
    search
        How initial guesses are searched for.

    Returns
    -------
    Solution
        The best of those from each initial guess.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> from rgbmidic.settings import SolverSettings
    >>> random = np.random.default_rng(0)
    >>> speckle = 2 + gaussian_filter(random.normal(size=(1, 80, 80)), (0, 1.5, 1.5)).astype(np.float32)
    >>> region = Region.from_rectangle((10, 10, 69, 69), shape=(80, 80))
    >>> reference = Reference.prepare(speckle, region, mesh=Tri3Mesh.from_region(region, element_size=30))
    >>> deformed, state = Deformed.prepare(np.roll(speckle, 3, axis=2)), TrackingState(displacement=None)
    >>> solution = track(reference, deformed, state, SolverSettings(), None)
    >>> (solution.displacement.mean(axis=0).round(2) + 0.0).tolist()
    [3.0, 0.0]
    """
    best: Solution | None = None
    surest = 0.0
    last = [] if state.displacement is None else [InitialGuess(displacement=state.displacement, confidence=np.nan)]
    candidates = timed_items("search", search.candidates(reference, deformed, state.displacement))
    for number, guess in enumerate(chain(last, candidates)):
        surest = float(np.fmax(surest, guess.confidence))
        if guess.confidence < MIN_CONFIDENCE:
            continue
        trial = solve(reference, deformed, guess.displacement, options, method, guess.residual)
        if best is None or rank(trial.status, trial.node_status) < rank(best.status, best.node_status):
            best = trial
        acceptable = state.unmeasured + (number + 0.5) * 0.04  # 1 to 2 % do go at the edge of a turning fragment
        if best.status is Status.CONVERGED and best.unmeasured_fraction <= acceptable:
            break
    if best is None:  # from rest, for the reason why there is no start
        best = solve(reference, deformed, np.zeros_like(reference.mesh.nodes), options, method)
    if best.reason != NO_MATCH:
        return best
    explanation = (
        f"no start found: at the best one the images agree around {surest:.0%} of the nodes, of "
        f"{MIN_CONFIDENCE:.0%} needed. Looked for were motions up to the region's longer side, at least 128 px, "
        "and turns up to about 30 degrees: take frames in between"
    )
    if surest >= MIN_CONFIDENCE:
        explanation = (
            f"at the start found they agree around {surest:.0%} of the nodes, but the solve did not hold one of them"
        )
    return replace(best, reason=f"{NO_MATCH}; {explanation}")
