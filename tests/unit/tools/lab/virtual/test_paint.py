"""The paint: coverage, sizes and slopes as asked, the same everywhere on every body."""

import numpy as np
import pytest

from rgbmidic.errors import InputError
from rgbmidic.tools.lab.virtual import Cylinder, Finish, Plate, Sphere, Surface, height_map


def sphere_points(rng, number, radius=41.25, widest=1.0):
    cosine = rng.uniform(np.cos(widest), 1, number)
    angle = rng.uniform(0, 2 * np.pi, number)
    sine = np.sqrt(1 - cosine**2)
    return radius * np.stack([sine * np.cos(angle), sine * np.sin(angle), -cosine], axis=1)


def scattered(body, rng, number=40_000):
    if isinstance(body, Plate):
        return np.column_stack([rng.uniform(-30, 30, (number, 2)), np.zeros(number)])
    if isinstance(body, Sphere):
        return sphere_points(rng, number)
    angle = rng.uniform(-1.5, 1.5, number)
    return np.column_stack([15 * np.sin(angle), rng.uniform(-30, 30, number), -15 * np.cos(angle)])


@pytest.mark.parametrize("body", [Plate(), Sphere(), Cylinder()])
@pytest.mark.parametrize("coverage", [0.0, 0.45, 0.7])
def test_coverage_is_as_asked(body, coverage):
    points = scattered(body, np.random.default_rng(1))
    cover, _, _ = Surface(coverage=coverage, seed=5).sample(points, body.parameters())
    assert cover.mean() == pytest.approx(coverage, abs=0.012)


def test_droplets_have_the_stated_diameter():
    """A Boolean model of discs of one diameter D: its covariogram meets the square of its mean exactly at D."""
    diameter = 0.23
    surface = Surface(coverage=0.3, spread=0.0, droplet=diameter, softness=0.0)
    points = scattered(Plate(), np.random.default_rng(2), 150_000)
    body = Plate().parameters()
    here = surface.sample(points, body)[0]
    for factor, correlated in ((0.5, True), (0.8, True), (1.05, False), (1.5, False)):
        there = surface.sample(points + np.array([factor * diameter, 0, 0]), body)[0]
        correlation = np.corrcoef(here, there)[0, 1]
        assert (correlation > 0.03) == correlated, (factor, correlation)


@pytest.mark.parametrize("body", [Plate(), Sphere(), Cylinder()])
def test_slopes_have_the_stated_rms_on_white_and_on_black(body):
    white, black = Finish(albedo=0.8, slope_deg=6.0), Finish(albedo=0.1, slope_deg=9.0)
    points = scattered(body, np.random.default_rng(3))
    cover, _, slope = Surface(white=white, black=black).sample(points, body.parameters())
    steepness = np.hypot(np.hypot(slope[:, 0], slope[:, 1]), slope[:, 2])
    for paint, where in ((white, cover == 0), (black, cover == 1)):
        rms = np.degrees(np.arctan(np.sqrt((steepness[where] ** 2).mean())))
        assert rms == pytest.approx(paint.slope_deg, rel=0.03)
    # the paper sees slopes up to about 15 degrees
    assert 12 < np.degrees(np.arctan(np.quantile(steepness[cover == 0], 0.999))) < 18


def test_slope_is_the_gradient_of_the_height():
    surface = Surface(coverage=0.3, softness=0.001, dome=0.004)
    points = scattered(Plate(), np.random.default_rng(4), 2000)
    body, step = Plate().parameters(), 1e-5
    cover, _, slope = surface.sample(points, body)
    for axis in (0, 1):
        shift = np.eye(3)[axis] * step
        forward, back = surface.sample(points + shift, body), surface.sample(points - shift, body)
        gradient = (forward[1] - back[1]) / (2 * step)
        clean = (cover == forward[0]) & (cover == back[0])
        error = np.abs(gradient - slope[:, axis])[clean]
        assert clean.mean() > 0.9
        assert np.quantile(error, 0.97) < 2e-3  # the remaining points lie on the ridge between two domes


def test_wrinkles_are_25_um_apart():
    pitch, size = 0.004, 1.6
    height, _ = height_map(Surface(coverage=0.0), size=size, pitch=pitch)
    n = len(height)
    window = np.hanning(n)[:, None] * np.hanning(n)
    power = np.abs(np.fft.fft2((height - height.mean()) * window)) ** 2
    frequency = np.fft.fftfreq(n, pitch)
    radius = np.hypot(*np.meshgrid(frequency, frequency))
    edges = np.arange(4, 100, 4.0)
    ring = np.array([power[(radius >= low) & (radius < low + 4)].sum() for low in edges])
    smooth = np.convolve(ring, np.ones(5) / 5, mode="same")
    assert 1 / (edges[smooth.argmax()] + 2) == pytest.approx(0.025, rel=0.15)


def test_another_seed_gives_another_spray_and_the_same_seed_the_same():
    points = scattered(Sphere(), np.random.default_rng(6), 5000)
    body = Sphere().parameters()
    a, b, c = (Surface(seed=seed).sample(points, body) for seed in (1, 1, 2))
    assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    assert abs(np.corrcoef(a[0], c[0])[0, 1]) < 0.05


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: Finish(albedo=0.99, gloss=1.5),
        lambda: Finish(albedo=-0.1),
        lambda: Surface(coverage=1.0),
        lambda: Surface(droplet=0.0),
        lambda: Surface(softness=1.0),
        lambda: height_map(Surface(), size=0.01, pitch=0.01),
    ],
)
def test_impossible_paint_is_refused(wrong):
    with pytest.raises(InputError):
        wrong()
