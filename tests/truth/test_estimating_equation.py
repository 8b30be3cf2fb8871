"""What the solve solves (docs/explanation/how-it-works.md): the root of an estimating equation, not always a minimum.

Images are speckle that is known at every point; limits are what was measured (in brackets) and a margin below 1.5.
"""

import numpy as np
import pytest
from textures import Texture

from rgbmidic import Tri3Mesh, correlate, discretisation_error
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.solve import solve
from rgbmidic.mesh import Region
from rgbmidic.settings import SolverSettings
from rgbmidic.weights import Statistics

SHAPE, REGION = (240, 240), (20, 20, 219, 219)
ROWS, COLUMNS = np.indices(SHAPE).astype(float)
MOTION = (0.3, -0.2)
CURVED = (0.0005, 0.0016)
"""px, rms error of the nodes (.0011) at a second derivative of 2e-4 / px; those of the linear fit are off by .0104."""
SAME = 0.0008
"""px, from the root to the minimum of the criterion along a shift (.0005), one light, noise of 8 % of the contrast."""
EQUAL = 3e-5
"""The same (2e-5) with three lights that show one texture, noise of 4 %."""
PULLED = 0.025
"""The same (.033, towards zero) where every light has a pattern of its own that stands still."""
HALVED = 0.03
"""px, stated discretisation error where the patterns have 25 % of the contrast (.025); .037 with the mean gradient."""
ROOT = 0.003
"""px, mean error of the root there (.002)."""


@pytest.mark.parametrize("second", [1e-4, 2e-4])
def test_quadratic_fields_are_exact_under_a_uniform_texture_only(second):
    errors = []
    for seed in (1, 2):
        texture, x = Texture.random(seed), COLUMNS
        for _ in range(30):
            x = COLUMNS - second / 2 * (x - 119.5) ** 2
        images = texture.at(COLUMNS, ROWS), texture.at(x, ROWS)
        found = correlate(*images, region=REGION, element_size=25, prefilter="binomial")
        errors.append(found.displacement[:, 0] - second / 2 * (found.nodes[:, 0] - 119.5) ** 2)
    low, high = (limit * second / 2e-4 for limit in CURVED)
    assert low < np.sqrt(np.mean(np.square(errors))) < high


def lights(own, noise):
    """Both states (3, H, W) of one moving texture, each light with a pattern of contrast `own` that stands still."""
    texture, random = Texture.random(3), np.random.default_rng(0)
    still = [Texture.random(10 + light, 2.5, contrast=own).at(COLUMNS, ROWS) - 200 for light in range(3)]
    for u, v in ((0, 0), MOTION):
        moved = texture.at(COLUMNS - u, ROWS - v)
        yield np.stack([moved + pattern + random.normal(0, noise, SHAPE) for pattern in still])


def minimum_from_root(first, second):
    """Mean error of the root in u, and from there to the minimum of the criterion along x; all weights 1."""
    found = correlate(first, second, region=REGION, element_size=25, prefilter="binomial", statistics=False)
    region = Region.from_rectangle(REGION, SHAPE)
    mesh = Tri3Mesh.from_region(region, 25)
    reference = Reference.prepare(first.astype(np.float32), region, mesh=mesh, prefilter="binomial")
    deformed = Deformed.prepare(second.astype(np.float32), prefilter="binomial")

    def criterion(shift):
        moved = found.displacement + np.array([shift, 0])
        residual = Residual.at(reference, deformed, [moved] * len(first))
        return float((residual.weights * residual.difference.astype(float) ** 2).sum())

    place = 0.0
    for _ in range(3):
        below, here, above = (criterion(place + step) for step in (-0.05, 0, 0.05))
        place += 0.05 * (below - above) / (2 * (below + above - 2 * here))
    return (found.displacement[:, 0] - MOTION[0]).mean(), place


def test_with_one_light_or_one_texture_the_root_is_the_minimum():
    one = [state[:1] for state in lights(0, 4.0)]
    assert abs(minimum_from_root(*one)[1]) < SAME
    assert abs(minimum_from_root(*lights(0, 2.0))[1]) < EQUAL


def test_where_lights_differ_the_minimum_is_pulled_and_the_root_is_not():
    error, place = minimum_from_root(*lights(15.0, 2.0))
    assert abs(error) < ROOT
    assert place < -PULLED


def test_where_lights_differ_the_halved_mesh_is_not_pulled_either():
    """A shift has no discretisation error: what is stated is what the halved mesh is pulled by, and noise."""
    first, second = lights(25.0, 2.0)
    region = Region.from_rectangle(REGION, SHAPE)
    mesh = Tri3Mesh.from_region(region, 25)
    reference = Reference.prepare(first.astype(np.float32), region, mesh=mesh, prefilter="binomial")
    states = reference, Deformed.prepare(second.astype(np.float32), prefilter="binomial")
    options = SolverSettings(), Statistics()
    found = solve(*states, np.tile(MOTION, (len(mesh.nodes), 1)), *options)
    error = discretisation_error(*states, found, *options).displacement_error
    assert np.sqrt(np.nanmean(error**2)) < HALVED


def test_noise_of_the_reference_is_a_bias_of_all_frames():
    """The mean of frames at rest scatters over the nodes as one frame does in time; with n averaged by 1/sqrt(n)."""
    clean, random = Texture.random(5).at(COLUMNS, ROWS), np.random.default_rng(1)
    for averaged, low, high in ((1, 0.9, 1.1), (4, 0.4, 0.6)):  # 1.00 and .46 of 36 frames, by theory 1 and .5
        bias, scatter = [], []
        for _ in range(3):
            reference = clean + random.normal(0, 4 / np.sqrt(averaged), SHAPE)
            frames = (clean + random.normal(0, 4, SHAPE) for _ in range(5))
            found = [
                correlate(reference, frame, region=REGION, element_size=25, prefilter="binomial", initial=(0, 0))
                for frame in frames
            ]
            displacement = np.array([each.displacement for each in found])
            scatter.append(displacement.var(axis=0, ddof=1))
            bias.append(displacement.mean(axis=0) ** 2 - scatter[-1] / len(found))
        assert low < np.sqrt(np.mean(bias) / np.mean(scatter)) < high
