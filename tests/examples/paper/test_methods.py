"""The methods differ in what they use of the images, and only in that."""

import numpy as np
import pytest

from measurement import METHODS, Competitor
from rgbmidic import Region
from rgbmidic.correlation import Deformed, Residual
from rgbmidic.errors import InputError
from rgbmidic.illumination import IlluminationImages

SHAPE = (160, 170)
REGION = Region.from_rectangle((10, 10, 159, 149), SHAPE)


def speckle(dx, dy, seed=0):
    """A band-limited texture moved by (dx, dy)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    waves = rng.uniform(0.3, 0.9, 60)[:, None] * np.array(
        [(np.cos(a), np.sin(a)) for a in rng.uniform(0, 2 * np.pi, 60)]
    )
    phases = rng.uniform(0, 2 * np.pi, 60)
    total = sum(np.cos(k * (x - dx) + q * (y - dy) + p) for (k, q), p in zip(waves, phases, strict=True))
    return 1000 + 80 * total


def state(dx, dy, spots, noise_seed):
    """Two lights; each has a reflection, which does not move with the texture."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    rng = np.random.default_rng(noise_seed)
    values = []
    for cx, cy in spots:
        spot = 2500 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 18**2))
        values.append(
            0.5 * speckle(dx, dy) + spot * (1 + 0.1 * rng.normal(size=SHAPE)) + rng.normal(scale=2, size=SHAPE)
        )
    stack = np.array(values, np.float32)
    return IlluminationImages(values=stack, valid=np.isfinite(stack), names=("b1", "b2"), full_scale=4000.0)


REFERENCE = state(0, 0, ((45, 80), (130, 80)), 1)
MOVED = state(0.4, -0.3, ((42, 80), (127, 80)), 2)


def error(method, images=MOVED, **settings):
    competitor = Competitor.prepare(method, REFERENCE, REGION, threshold=0.18, **settings)
    solution = competitor.measure(images, np.zeros_like(competitor.reference.mesh.nodes))
    inner = ((solution.nodes > 30) & (solution.nodes < 135)).all(axis=1)
    return np.sqrt(np.nanmean((solution.displacement - [0.4, -0.3])[inner] ** 2)), competitor


def test_weights_remove_what_the_reflections_disturb():
    errors = {method: error(method)[0] for method in METHODS}
    assert errors["midic"] < 0.02
    assert errors["midic"] < 0.2 * errors["glc-dic"]
    assert errors["midic"] < 0.1 * errors["midic-unweighted"]
    assert errors["glc-dic"] < errors["dic"]
    assert errors["default"] < errors["midic"]


def test_one_light_or_all_with_or_without_weights():
    for method, settings in METHODS.items():
        competitor = error(method, light=1)[1]
        assert competitor.lights == ((0, 1) if settings.all_lights else (1,))
        assert (competitor.threshold is not None) == settings.weighted
        assert len(competitor.reference.images) == len(competitor.lights)
        excluded = (competitor.reference.weights[:, 40:120, 40:140] == 0).mean()
        assert (excluded > 0.1) == settings.weighted


def pull(solution, method):
    """Length of the sum over the lights of residual times own gradient at the nodes: the paper's eq. 3 has it 0."""
    competitor = Competitor.prepare(method, REFERENCE, REGION, threshold=0.18)
    reference, deformed = competitor.reference, Deformed.prepare(MOVED.values[list(competitor.lights)])
    lights = range(len(competitor.lights))
    own = reference.texture.images
    residual = Residual.at(reference, deformed, [solution.displacement for _ in lights])
    parts = (reference.projected(residual.weights[i], residual.difference[i], own[:, i]) for i in lights)
    return float(np.linalg.norm(sum(reference.assembly.vector(part) for part in parts)))


@pytest.mark.parametrize(("method", "ours"), [("dic", "dic-ours"), ("midic-unweighted", "default")])
def test_the_papers_methods_solve_the_papers_equations_and_ours_do_not(method, ours):
    found = {}
    for name in (method, ours):
        competitor = Competitor.prepare(name, REFERENCE, REGION)
        found[name] = competitor.measure(MOVED, np.zeros_like(competitor.reference.mesh.nodes))
    assert pull(found[method], method) < 1e-3 * pull(found[ours], method)


def test_the_other_light_does_not_matter_to_one():
    blind = IlluminationImages(
        values=MOVED.values * np.array([1, np.nan], np.float32)[:, None, None],
        valid=MOVED.valid,
        names=MOVED.names,
        full_scale=MOVED.full_scale,
    )
    assert error("dic", blind)[0] == error("dic")[0]


def test_what_a_method_needs_is_asked_for():
    with pytest.raises(InputError, match="allowed are dic, glc-dic, midic-unweighted, midic"):
        Competitor.prepare("ncc", REFERENCE, REGION)
    with pytest.raises(InputError, match="needs a weighting threshold"):
        Competitor.prepare("midic", REFERENCE, REGION)
    with pytest.raises(InputError, match="light 2"):
        Competitor.prepare("dic", REFERENCE, REGION, light=2)
