"""Refinement of the mesh of a test where the discretisation error of strain exceeds the noise."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from rgbmidic.correlation import discretisation_error
from rgbmidic.errors import FrameError, InputError
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.tri3 import refine_elements
from rgbmidic.pipeline.frame_quality import SPECKLES
from rgbmidic.pipeline.plan import Plan
from rgbmidic.tools.preparation.element_size import KeyFrame, solved
from rgbmidic.tools.preparation.size_figures import CONSTANTS

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
