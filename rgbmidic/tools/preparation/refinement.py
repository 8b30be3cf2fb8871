"""Refinement of the mesh of a test where the discretisation error of strain exceeds the noise."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rgbmidic.correlation import discretisation_error
from rgbmidic.errors import FrameError, InputError
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.outline_mesh import EDGES, edge_keys
from rgbmidic.pipeline.frame_quality import SPECKLES
from rgbmidic.pipeline.plan import Plan
from rgbmidic.tools.preparation.element_size import KeyFrame, solved
from rgbmidic.tools.preparation.size_figures import CONSTANTS
from rgbmidic.typing import BoolArray

logger = logging.getLogger(__name__)


def refine(plan: Plan, frame: int | bool = True) -> Plan:
    """Bisect the elements whose discretisation error of strain in a deformed frame is more than twice its noise.

    It is done three times at most, in one frame, for the mesh of the whole test. No leg gets shorter than three
    speckles; both sides of a crack are bisected alike.

    Parameters
    ----------
    plan
        The test with elements of one size.
    frame
        Index of the frame; True: of five of the test, evenly spread, the one that departs most from an affine motion.

    Returns
    -------
    Plan
        With the finer mesh, and a note that tells of it.

    Raises
    ------
    RgbmidicError
        There is no such deformed frame, or none can be measured.
    """
    try:
        key = KeyFrame.find(plan, () if frame is True else (int(frame),))
    except (FrameError, InputError) as error:
        raise type(error)(f"mesh.refine: {error}") from error
    min_leg, counts = max(SPECKLES * (plan.speckle or 0.0), CONSTANTS.min_size), [len(plan.reference.mesh.nodes)]
    while len(counts) <= CONSTANTS.passes:
        mesh = plan.reference.mesh
        solution = solved(plan, key.deformed, key.start(mesh))
        estimated = discretisation_error(plan.reference, key.deformed, solution, plan.settings.solver, plan.method)
        missed, noise = (  # the squares at the corners of each element; NaN takes no part
            np.nan_to_num(values[mesh.elements] ** 2).sum(axis=(1, 2))
            for values in (estimated.strain_error, estimated.strain_std)
        )
        unresolved = missed > CONSTANTS.worth**2 * noise
        finer = refine_elements(mesh, unresolved, min_leg)
        if finer is mesh:
            if unresolved.any():
                worst = int(np.argmax(np.where(unresolved, missed, 0)))
                logger.warning(
                    "mesh.refine: strain is not resolved in %.2g %% of the region, least around (%.0f, %.0f): its "
                    "discretisation error is %.2g there, its noise %.2g, and its parts would have legs under %.3g px",
                    *(
                        100 * mesh.areas[unresolved].sum() / mesh.areas.sum(),
                        *mesh.nodes[mesh.elements[worst]].mean(axis=0),
                    ),
                    *(np.sqrt(values[worst] / 9) for values in (missed, noise)),  # three strains at three corners
                    min_leg,
                )
            break
        nodes = np.round(finer.nodes / CONSTANTS.exact) * CONSTANTS.exact
        plan = plan.on_mesh(Tri3Mesh(nodes=nodes, elements=finer.elements))
        counts.append(len(nodes))
    name = plan.series.name(key.index)
    worth = f"the discretisation error of strain in {name} is more than {CONSTANTS.worth:g} times its noise"
    text = f"no element: there is none where {worth} and parts would have legs of {min_leg:.3g} px or more"
    if counts[1:]:
        text = f"from {counts[0]} to {counts[-1]} nodes in {len(counts) - 1} steps, where {worth}; no leg is shorter "
        text += f"than {min_leg:.3g} px"
    logger.info("refined: %s", text)
    return replace(plan, notes={**plan.notes, "refinement": text})


def refine_elements(mesh: Tri3Mesh, marked: BoolArray, min_leg: float) -> Tri3Mesh:
    """Bisect elements at their longest edges, and those beside as far as no node then hangs on an edge.

    No angle gets smaller than half the smallest of the mesh (Rosenberg and Stenger, SIAM J. Numer. Anal. 12, 1975;
    Rivara, Int. J. Numer. Meth. Eng. 20, 1984). Both sides of a crack are bisected alike and stay apart.

    Parameters
    ----------
    mesh
        What is refined; its nodes stay, with their numbers.
    marked
        Elements (E,) that are to be bisected.
    min_leg
        Smallest leg in px that a part may have, as that of a right isosceles triangle of its area: what would give
        smaller ones stays whole.

    Returns
    -------
    Tri3Mesh
        The finer mesh; `mesh` itself where nothing can be bisected.
    """
    corners, count = mesh.elements.astype(np.int64), len(mesh.nodes)
    # edges by place: what is cut on one side of a crack is cut on the other
    keys, edge = np.unique(edge_keys(mesh.merged_index[corners][:, EDGES].reshape(-1, 2), count), return_inverse=True)
    edge = edge.reshape(-1, 3)
    start, end = mesh.nodes[np.stack(np.divmod(keys, count))]
    rank = np.empty(len(keys), dtype=np.int64)
    # equal edges in no order along the rows of a regular mesh: cuts of elements beside would go on to its end
    shuffled = np.random.default_rng(0).permutation(len(keys))
    rank[np.lexsort((shuffled, np.round(np.hypot(*(end - start).T), 6)))] = np.arange(len(keys))
    turn = (np.argmax(rank[edge], axis=1)[:, None] + np.arange(3)) % 3  # the longest edge first
    corners, edge = (np.take_along_axis(values, turn, axis=1) for values in (corners, edge))
    is_final = mesh.areas < min_leg**2
    while True:
        free, cut = np.ones(len(keys), dtype=bool), np.zeros(len(keys), dtype=bool)
        while (is_blocked := (is_final | ~free[edge[:, 0]]) & free[edge].any(axis=1)).any():
            free[edge[is_blocked]] = False
        cut[edge[marked & free[edge[:, 0]], 0]] = True
        while (is_forced := cut[edge].any(axis=1) & ~cut[edge[:, 0]]).any():
            cut[edge[is_forced, 0]] = True
        n_cuts = cut[edge].sum(axis=1)
        # a part between two edges that are cut is a quarter
        small = (n_cuts > 1) & (mesh.areas / 2 < min_leg**2)
        if not small.any():
            break
        is_final |= small
    return _bisect(mesh, corners, cut[edge]) if cut.any() else mesh


def _bisect(mesh: Tri3Mesh, corners: npt.NDArray[np.int64], cut: BoolArray) -> Tri3Mesh:
    """Cut edges (E, 3) of elements, the first edge of each before the others; edge i joins corners i and i + 1."""
    count = len(mesh.nodes)
    keys, middle = np.unique(edge_keys(corners[:, EDGES][cut], count), return_inverse=True)
    midpoint = np.full(cut.shape, -1)
    midpoint[cut] = count + middle
    a, b, c = corners.T
    first_cut, ab, bc, ca = cut[:, 0], *midpoint.T
    halves = [corners[~first_cut]]
    for side, corner_sets in ((1, ((ab, b, c), (ab, b, bc), (ab, bc, c))), (2, ((ab, c, a), (ab, c, ca), (ab, ca, a)))):
        second_cut = first_cut & cut[:, side]
        halves += [
            np.stack(corner_sets[0], 1)[first_cut & ~second_cut],
            *(np.stack(corner_set, 1)[second_cut] for corner_set in corner_sets[1:]),
        ]
    nodes = np.concatenate([mesh.nodes, mesh.nodes[np.stack(np.divmod(keys, count))].mean(axis=0)])
    return Tri3Mesh(nodes=nodes, elements=np.concatenate(halves))
