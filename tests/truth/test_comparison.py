"""A comparison with a simulation that is the truth finds nothing, and one with a wrong modulus finds the modulus."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plate_fe import PLACEMENT, Plate
from results import make_result
from textures import Texture

from rgbmidic import correlate
from rgbmidic.results import FrameRecord
from rgbmidic.results.comparison import Comparison, FrameComparison, Simulation

DRAWS, NOISE, STIFF = 8, 4.0, 1.03
RATIO = (0.9, 1.1)  # rms over the draws of difference over stated: .94 of displacement, .92 to 1.01 of strain
COARSE, FINE = 30, 10  # sides of the measurement's and of the simulation's elements, px


@pytest.fixture(scope="module")
def comparisons(tmp_path_factory: pytest.TempPathFactory) -> dict[float, list[FrameComparison]]:
    """Pairs of noisy photographs of a simulated plate, compared with its simulation and with one that is too stiff."""
    plate, texture, random = Plate.of(FINE), Texture.random(3, waves=150), np.random.default_rng(1)
    pair = [plate.image(texture, amount) for amount in (0.0, 1.0)]
    solutions = [
        correlate(
            *(image + random.normal(0, NOISE, image.shape) for image in pair),
            region=plate.region(),
            element_size=COARSE,
        )
        for _ in range(DRAWS)
    ]
    nodes = solutions[0].nodes

    def record(index: int) -> FrameRecord:
        (u, v), (u_std, v_std) = solutions[index].displacement.T, solutions[index].displacement_std.T
        return FrameRecord.of(nodes=len(nodes), lights=3, number=index, status=0, u=u, v=v, u_std=u_std, v_std=v_std)

    path: Path = tmp_path_factory.mktemp("comparison") / "result"
    mesh = {"nodes": nodes, "elements": solutions[0].elements, "references": []}
    result = make_result(path, frames=DRAWS, record=record, **mesh)
    simulation = Simulation(mesh=plate.mesh, displacement=plate.displacement[None])
    made = {}
    for modulus in (1.0, STIFF):
        wrong = replace(simulation, displacement=simulation.displacement / modulus)
        made[modulus] = list(Comparison(result, wrong, PLACEMENT, frames=range(DRAWS)).each())
    return made


def chi_square(frames: list[FrameComparison], way: str, name: str) -> float:
    return float(np.mean([made.agreement[way, name].chi_square for made in frames]))


@pytest.mark.parametrize("name", ["displacement", "exx", "eyy", "exy"])
def test_error_against_a_simulated_truth_is_as_stated(comparisons, name):
    assert RATIO[0] ** 2 < chi_square(comparisons[1.0], "levelled", name) < RATIO[1] ** 2


def test_chi_square_scatters_as_its_degrees_of_freedom_say(comparisons):
    probabilities = [made.agreement["levelled", "displacement"].probability for made in comparisons[1.0]]
    assert min(probabilities) > 0.01
    assert max(probabilities) > 0.3


def test_resolution_is_difference_at_the_nodes_and_none_when_levelled(comparisons):
    """Elements as wide as the hole's radius miss the concentration of strain beside it."""
    assert chi_square(comparisons[1.0], "nodes", "displacement") > 2
    assert chi_square(comparisons[1.0], "nodes", "eyy") > 8


def test_a_wrong_modulus_is_found_at_the_level_of_the_uncertainty(comparisons):
    fits = [made.fit for made in comparisons[STIFF]]
    pulls = np.array([(fit.scale - STIFF) / fit.scale_std for fit in fits])
    assert 0.5 < np.sqrt(np.mean(pulls**2)) < 1.6
    assert all(fit.scale_std < (STIFF - 1) / 3 for fit in fits)
    assert np.mean([(fit.scale - 1) / fit.scale_std for fit in fits]) > 3
    assert chi_square(comparisons[STIFF], "levelled", "displacement") > 1.4
    left = np.mean([fit.chi_square for fit in fits])
    assert RATIO[0] ** 2 < left < RATIO[1] ** 2
