"""The virtual bench: reflections where they were asked for, areas as in the paper, exposures that do not saturate."""

import numpy as np
import pytest

from bench import BENCHES, SMALLEST, Bench, lamp_for_reflection
from rgbmidic.errors import InputError
from rgbmidic.tools.lab.virtual import Sphere, State, reference_camera


def mirror_direction(body, camera, pixel, state=None):
    """Direction of a mirrored ray, found by marching along the camera's ray: nothing shared with what is tested."""
    ray = np.array(
        [(pixel[0] - camera.centre[0]) / camera.focal_px, (pixel[1] - camera.centre[1]) / camera.focal_px, 1]
    )
    ray /= np.linalg.norm(ray)
    _, origin = (state or State()).pose(body)
    low, high = 0.0, float(np.linalg.norm(body.centre))
    for _ in range(80):
        middle = (low + high) / 2
        outside = np.linalg.norm(middle * ray - origin) > body.radius
        low, high = (middle, high) if outside else (low, middle)
    point = low * ray
    normal = (point - origin) / np.linalg.norm(point - origin)
    return point, ray - 2 * (ray @ normal) * normal


@pytest.mark.parametrize("pixel", [(511.5, 511.5), (700.0, 330.0), (200.0, 800.0)])
def test_the_lamp_is_mirrored_at_its_pixel(pixel):
    body, camera = Sphere(), reference_camera((1024, 1024))
    lamp = np.array(lamp_for_reflection(body, camera, pixel, distance=500.0))
    point, mirrored = mirror_direction(body, camera, pixel)
    assert (lamp - point) / 500.0 == pytest.approx(mirrored, abs=1e-6)


def test_no_lamp_for_a_pixel_beside_the_sphere():
    with pytest.raises(InputError, match="not seen"):
        lamp_for_reflection(Sphere(), reference_camera((1024, 1024)), (3000.0, 0.0))


@pytest.mark.parametrize("name", BENCHES)
@pytest.mark.parametrize("size", [SMALLEST, 512, 1024])
def test_areas_lie_in_the_measured_square_and_the_reflection_moves_from_a4_to_a2(name, size):
    bench = Bench.build(name, size)
    mask = bench.region.mask
    pitch = bench.areas[1].centre[0] - bench.areas[0].centre[0]
    for area in bench.areas:
        x0, y0, x1, y1 = area.rectangle
        inside = mask[int(y0) - 59 : int(y1) + 60, int(x0) - 59 : int(x1) + 60]
        assert inside.all()
    way = bench.reflection_shift(14.0)
    assert way == pytest.approx(-181, abs=1)
    crossed = bench.areas[4].centre[0] + way
    nearest = min(bench.areas, key=lambda area: abs(area.centre[0] - crossed))
    assert nearest.name == ("A2" if size >= 512 else "A1")
    assert pitch == pytest.approx(100) or size < 1024


def test_the_mirror_image_of_the_lamp_moves_as_stated():
    bench = Bench.build("sequential", 1024)
    x, y = bench.areas[4].centre
    moved = (x + bench.reflection_shift(8.0), y)
    lamp = np.array(bench.scene.lights[bench.light].position)
    point, mirrored = mirror_direction(bench.scene.body, bench.scene.camera, moved, bench.state(8.0))
    towards = (lamp - point) / np.linalg.norm(lamp - point)
    # half the angle between them is how far the true highlight is off, over 750 px of radius
    assert np.degrees(np.arccos(towards @ mirrored)) / 2 < 1.0


@pytest.mark.parametrize("name", BENCHES)
def test_shots_fill_the_range_without_saturation_and_differ_in_noise_only(name):
    bench = Bench.build(name, SMALLEST)
    k, (height, width) = len(bench.scene.lights), bench.scene.camera.shape
    clean = np.zeros((k, height, width), np.float32)
    clean[:, 100:200, 100:200] = 700.0
    exposed = clean * np.float32(bench.exposure_gain(bench.brightest(clean)))
    first, again, other = (bench.photograph(exposed, shot) for shot in (0, 0, 1))
    assert first.values.shape == clean.shape
    inside = first.valid[:, 2:-2, 2:-2]  # the lens shows the frame's edge in blue from beyond it
    assert inside.mean() > 0.999  # the noise of a few pixels reaches saturation
    assert first.names == tuple(light.name for light in bench.scene.lights)
    np.testing.assert_array_equal(first.values, again.values)  # NaN where the noise saturates
    difference = (first.values - other.values)[:, 110:190, 110:190]
    assert np.nanstd(difference) > 0
    mean = np.nanmean(first.values[:, 110:190, 110:190], axis=(1, 2))
    assert mean == pytest.approx(exposed.max(axis=(1, 2)), rel=0.01)


def test_what_the_bench_does_not_have_is_refused():
    with pytest.raises(InputError, match="allowed are sequential, bayer"):
        Bench.build("stereo")
    with pytest.raises(InputError, match="at least 448"):
        Bench.build("bayer", 300)


def test_the_paper_s_methods_get_the_lights_of_a_mosaic_on_one_grid() -> None:
    bench = Bench.build("bayer", 448)
    images = np.full((len(bench.scene.lights), 448, 448), 1000.0, dtype=np.float32)
    assert bench.photograph(images, 0).registration is None
    assert bench.photograph(images, 0, "auto").registration is not None
