"""The methods that the paper compares, as settings of one solver, and what they give on the states of the experiment.

Plain DIC with one light (section 2.2), the same with a local grey-level correction (GLC-DIC, section 2.2 and ref. 14),
all lights together without weights (Fig. 13), and all lights with binary weights (MIDIC, section 3). These four are as
in the paper: grey levels as they are, the nodal values of linear elements, each light's own gradient, equal weight of
the lights. "Ours" has the same images and masks in rgbmidic's solver, whose nodal values are recovered from the linear
fit and whose lights have their gradient in common; "default" the settings that a test has where TEST.toml says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from bench import Bench, Topography
from rgbmidic import Region, Solution, Tri3Mesh
from rgbmidic.correlation import Deformed, Reference, Residual, find_initial_guess, solve
from rgbmidic.errors import InputError
from rgbmidic.fields import at_nodes, at_pixels, high_pass
from rgbmidic.illumination import IlluminationImages
from rgbmidic.lab.measures import Goniometry, area_means, area_stds, residual_percent
from rgbmidic.settings import ELEMENT_SIZE, SolverSettings
from rgbmidic.weights import SetUpThreshold, Statistics, threshold_weights

if TYPE_CHECKING:
    from causes import Cause, NoiseOfLights

BLUR = 10.0
"""Standard deviation (px) of the blur before the threshold: the speckle vanishes, the reflection stays."""
ITERATIONS = 50
"""Most Gauss-Newton iterations of the paper's way; 6 to 9 do on the sphere, more where a reflection stands still."""
CONVERGED = 1e-5
"""Increment (px) that ends them: P is some 1e-3 px."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """What a method uses of the images."""

    title: str
    all_lights: bool = False  # all lights in one solve, or one alone
    weighted: bool = False  # whether reflections are excluded by binary weights
    brightness: Literal["none", "local"] = "none"  # grey-level correction of the solver
    ours: bool = False  # rgbmidic's solver; else linear elements and own gradients, as in the paper
    default: bool = False  # rgbmidic's own settings: grey-level correction, prefilter, weights by statistics
    demosaic: str = "malvar"  # of a Bayer mosaic; Malvar's for the paper's methods, whose figures are about the solve


METHODS: dict[str, Method] = {
    "dic": Method(title="DIC, one light"),
    "glc-dic": Method(title="GLC-DIC, one light", brightness="local"),
    "midic-unweighted": Method(title="MIDIC without weights", all_lights=True),
    "midic": Method(title="MIDIC", all_lights=True, weighted=True),
    "dic-ours": Method(title="DIC, one light, our solver", ours=True),
    "midic-ours": Method(title="MIDIC, our solver", all_lights=True, weighted=True, ours=True),
    "default": Method(title="rgbmidic, default", all_lights=True, ours=True, default=True, demosaic="auto"),
}
"""The methods by the name they have in perturbation.csv."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Competitor:
    """One method, ready to measure any number of states against one reference."""

    method: str  # one of `METHODS`
    lights: tuple[int, ...]  # indices of the lights it uses
    reference: Reference
    threshold: float | None  # of the weights; None: no weights

    @classmethod
    def prepare(
        cls,
        method: str,
        images: IlluminationImages,
        region: Region,
        *,
        light: int = 0,
        threshold: float | None = None,
        element_size: float = ELEMENT_SIZE,
        prefilter: str = "none",
    ) -> Competitor:
        """Prepare the reference of a method.

        `light` is that of the methods with one light, `threshold` (`rgbmidic.weights.threshold_weights`) that of
        ``"midic"``. The paper has no `prefilter`; a Bayer mosaic needs ``"binomial"``. ``"default"`` has its own.
        """
        if method not in METHODS:
            raise InputError(f"unknown method {method!r}; allowed are {', '.join(METHODS)}")
        if not 0 <= light < len(images.values):
            raise InputError(f"light {light} is not one of the {len(images.values)} lights")
        settings = METHODS[method]
        if settings.weighted and threshold is None:
            raise InputError(f"method {method!r} needs a weighting threshold; see `set_up_threshold`")
        lights = tuple(range(len(images.values))) if settings.all_lights else (light,)
        limit = threshold if settings.weighted else None
        values, weights = _seen(method, lights, limit, images)
        reference = Reference.prepare(
            values,
            region,
            weights,
            mesh=Tri3Mesh.from_region(region, element_size),
            prefilter=SolverSettings().prefilter if settings.default else prefilter,
            registration=images.registration,
            brightness="auto" if settings.default else "constant" if settings.brightness == "local" else "none",
        )
        return cls(method=method, lights=lights, reference=reference, threshold=limit)

    def measure(self, images: IlluminationImages, start: np.ndarray | None = None) -> Solution:
        """Displacement of a state against the reference, from illumination images of the same lights; `start` is the
        displacement (N, 2) in px to start from, None looks for it. The stated uncertainty is that of our solver."""
        values, weights = _seen(self.method, self.lights, self.threshold, images)
        deformed = Deformed.prepare(values, weights, prefilter=self.reference.prefilter)
        if start is None:
            start = find_initial_guess(self.reference, deformed).displacement
        method = METHODS[self.method]
        solution = solve(self.reference, deformed, start, SolverSettings(), Statistics() if method.default else None)
        if method.ours or not solution.measured.any():
            return solution
        fitted = linear_fit(self.reference, deformed, solution, corrected=method.brightness == "local")
        return replace(solution, displacement=fitted)


def linear_fit(reference: Reference, deformed: Deformed, solution: Solution, *, corrected: bool) -> np.ndarray:
    """Nodal values (N, 2) of the paper's minimisation (eq. 3): linear elements, each light's own gradient.

    Gauss-Newton from a `solution`, over the elements whose nodes it measured, to which each light adds its residual
    times its own gradient. `corrected`: a gain and an offset, linear on the same mesh, are fitted to each light in
    every iteration (section 2.2).
    """
    assembly, mesh, lights = reference.assembly, reference.mesh, range(len(reference.values))
    own = reference.texture.images
    whole = np.repeat(solution.measured[mesh.elements].all(axis=1), np.diff(reference.pixels.offsets))
    moved = np.where(solution.measured[:, None], solution.displacement, np.nanmean(solution.displacement, axis=0))

    def solved(system: sp.csr_matrix, vector: np.ndarray) -> np.ndarray:
        held = 1e-9 * system.diagonal().mean()  # of nodes that no pixel belongs to
        return np.asarray(spsolve((system + held * sp.eye(len(vector))).tocsc(), vector)).reshape(-1, 2)

    for _ in range(ITERATIONS):
        residual = Residual.at(reference, deformed, [moved] * len(lights))
        system, vector = sp.csr_matrix((2 * len(moved),) * 2), np.zeros(2 * len(moved))
        for light in lights:
            weight, difference = residual.weights[light] * whole, residual.difference[light]
            if corrected:
                f = reference.values[light] * reference.inverse_level[light]
                g = f - difference
                basis = np.stack([g / np.float32(g.mean()), np.ones_like(g)])
                sums = assembly.vector(reference.projected(weight, f, basis))
                nodal = solved(assembly.matrix(reference.blocks(weight, basis)), sums)
                field = at_pixels(mesh, nodal, reference.images.shape[1:]).astype(np.float32)
                difference = f - (reference.pixels.gather(np.nan_to_num(field)) * basis).sum(axis=0)
            system = system + assembly.matrix(reference.blocks(weight, own[:, light]))
            vector += assembly.vector(reference.projected(weight, difference, own[:, light]))
        step = solved(system, vector)
        moved = moved + step
        if np.abs(step[solution.measured]).max() < CONVERGED:
            break
    return np.where(solution.measured[:, None], moved, np.nan)


def _seen(
    method: str, lights: tuple[int, ...], threshold: float | None, images: IlluminationImages
) -> tuple[np.ndarray, np.ndarray]:
    """What the solve correlates of a state, and its weights, both (k, H, W) of the lights that a method uses."""
    chosen = IlluminationImages(
        values=images.values[list(lights)],
        valid=images.valid[list(lights)],
        names=tuple(images.names[light] for light in lights),
        full_scale=images.full_scale,
    )
    if threshold is None:
        return chosen.values, chosen.valid.astype(np.float32)
    return chosen.values, threshold_weights(chosen, threshold=threshold, blur=BLUR)


def displacement_at_pixels(solution: Solution, shape: tuple[int, int]) -> np.ndarray:
    """Displacement (2, H, W) in px; NaN where not measured."""
    return at_pixels(Tri3Mesh(nodes=solution.nodes, elements=solution.elements), solution.displacement, shape)


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """One method at one angle."""

    perturbation: np.ndarray  # P of U_y in A0 to A4, px
    error: np.ndarray  # standard deviation of the measured minus the true U_y in the areas, high-passed alike, px
    rms: np.ndarray  # root mean square error of U_x and U_y together in the areas, nothing taken off, px
    ratio: np.ndarray  # root mean square of error over stated uncertainty at the nodes in the areas
    mean: np.ndarray  # mean of (U_x, U_y) in the areas, (2, 5), px
    residual: float  # % of the effective dynamic range, mean of the lights
    measured: float  # fraction of the nodes that were measured
    frontier: float  # P along the frontiers of the masks over P beside them; NaN without masks
    status: str  # how the solve ended


def measure_state(
    competitor: Competitor,
    reference: IlluminationImages,
    images: IlluminationImages,
    bench: Bench,
    truth: np.ndarray,
) -> tuple[Measurement, np.ndarray]:
    """Measure one state with one method prepared with `reference`; `truth` is the exact displacement (2, H, W).

    Gives the measurement, and the displacement (2, H, W) at the pixels.
    """
    solution = competitor.measure(images)
    field = displacement_at_pixels(solution, images.shape)
    nothing = np.full(len(bench.areas), np.nan)
    measurement = Measurement(
        perturbation=nothing,
        error=nothing,
        rms=np.sqrt(area_means((np.asarray(field - truth) ** 2).mean(axis=0), bench.areas)),
        ratio=_over_stated(solution, truth, bench),
        mean=np.stack([area_means(part, bench.areas) for part in field]),
        residual=float("nan"),
        measured=float(solution.measured.mean()),
        frontier=float("nan"),
        status=solution.status.name.lower(),
    )
    if np.isfinite(field[1]).sum() <= 10:
        return measurement, field
    ripple = high_pass(field[1])
    residuals = [
        residual_percent(reference.values[light], images.values[light], np.asarray(field, dtype=np.float64))
        for light in competitor.lights
    ]
    measurement = replace(
        measurement,
        perturbation=area_stds(ripple, bench.areas),
        error=area_stds(high_pass(field[1] - truth[1]), bench.areas),
        residual=float(np.mean(residuals)),
        frontier=_frontier(ripple, competitor, images),
    )
    return measurement, field


def _over_stated(solution: Solution, truth: np.ndarray, bench: Bench) -> np.ndarray:
    """Root mean square of error over stated uncertainty at the nodes in each area; NaN where none is measured."""
    ratio = (solution.displacement - at_nodes(truth, solution.nodes)) / solution.displacement_std
    found = []
    for area in bench.areas:
        x0, y0, x1, y1 = area.rectangle
        inside = ((solution.nodes >= (x0, y0)) & (solution.nodes <= (x1, y1))).all(axis=1)
        known = ratio[inside & solution.measured]
        found.append(float(np.sqrt(np.mean(known**2))) if known.size else float("nan"))
    return np.array(found)


def _frontier(ripple: np.ndarray, competitor: Competitor, images: IlluminationImages) -> float:
    """P within an element of the masks' frontiers, over P beside it: on the side where it is larger.

    On either side of a frontier other lights are seen, and fewer lights give more noise; a band that the frontier
    itself disturbs is worse than both. The mask of the deformed state is taken where it is, within a few px of where
    the displacement warps it.
    """
    if competitor.threshold is None:
        return float("nan")
    after = threshold_weights(images, threshold=competitor.threshold, blur=BLUR)
    masks = ((competitor.reference.weights > 0) & (after > 0)).astype(np.uint8)
    edge = np.max([cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) for mask in masks], axis=0)
    distance = cv2.distanceTransform(1 - edge, cv2.DIST_L2, 5) if edge.any() else np.full(images.shape, np.inf)
    known, enough = np.isfinite(ripple), 20 * ELEMENT_SIZE**2
    band = known & (distance <= ELEMENT_SIZE)
    beside = known & (distance > ELEMENT_SIZE) & (distance <= 3 * ELEMENT_SIZE)
    sides = [beside & (masks.sum(axis=0) == count) for count in range(len(masks) + 1)]
    level = max((float((ripple[side] ** 2).mean()) for side in sides if side.sum() >= enough), default=0.0)
    if level == 0 or band.sum() < enough:
        return float("nan")
    return float(np.sqrt((ripple[band] ** 2).mean() / level))


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """What is kept of one state for the figures."""

    images: np.ndarray  # illumination images over full scale, (k, H, W)
    displacement: dict[str, np.ndarray]  # of every method, (2, H, W)
    weights: np.ndarray  # masks of the reference and of this state together, not warped by the displacement, (k, H, W)


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneStudy:
    """The methods on one scene."""

    bench: Bench
    angles: tuple[float, ...]  # degrees, in order
    reference: np.ndarray  # reference images over full scale, (k, H, W)
    names: tuple[str, ...]  # of the lights
    thresholds: dict[float, SetUpThreshold]  # found at each of the set-up angles that was tried
    chosen: float | None  # the angle whose threshold is used; None where the reflection nowhere disturbs plain DIC
    measurements: dict[tuple[str, float], Measurement]  # by method and angle
    snapshots: dict[float, Snapshot]  # of the smallest and the largest angle above 0
    peaks: np.ndarray  # brightest point (x, y) of the blurred light that crosses the areas, at every angle, (n, 2)

    @property
    def threshold(self) -> SetUpThreshold | None:
        """The weighting threshold that is used."""
        return None if self.chosen is None else self.thresholds[self.chosen]

    def series(self, method: str, quantity: str) -> np.ndarray:
        """A quantity of `Measurement` at every angle, shape (n angles, ...)."""
        return np.array([getattr(self.measurements[method, angle], quantity) for angle in self.angles])

    def perturbation(self, method: str) -> np.ndarray:
        """P (n angles, 5 areas) of a method, px."""
        return self.series(method, "perturbation")


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperStudy:
    """All that the paper's figures show, as the virtual bench gives it."""

    angles: tuple[float, ...]
    size: int
    seed: int
    scenes: tuple[SceneStudy, ...]  # the sphere, one entry per way to light and record
    goniometry: Goniometry  # of the flat specimen
    topography: Topography
    noise: NoiseOfLights
    causes: tuple[Cause, ...]  # empty where they were not asked for
