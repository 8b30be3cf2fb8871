"""In-plane displacement fields: inverse after forward gives the point back; a mesh field is linear in triangles."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay

from rgbmidic.errors import InputError
from rgbmidic.tools.lab.virtual import AffineField, MeshField, Plate, State, plate_scene, render, truth
from rgbmidic.tools.scene.surface import material_from_spatial


def irregular_mesh(rng, number=60, strain=0.02):
    nodes = rng.uniform(-5, 5, (number, 2))
    displacement = strain * np.column_stack([np.sin(nodes[:, 1]) + nodes[:, 0], nodes[:, 0] * nodes[:, 1] / 5])
    return MeshField(nodes=nodes, elements=Delaunay(nodes).simplices, displacement=displacement)


def test_mesh_field_equals_scipy_and_is_nan_outside():
    rng = np.random.default_rng(0)
    field = irregular_mesh(rng)
    x, y = rng.uniform(-6, 6, (2, 40, 50))
    oracle = LinearNDInterpolator(Delaunay(field.nodes), field.displacement)
    expected = oracle(x, y)
    ours = np.stack(field(x, y), axis=-1)
    assert np.isnan(ours).any()
    assert np.array_equal(np.isnan(ours), np.isnan(expected))
    assert np.allclose(ours, expected, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize("kind", ["affine", "mesh", "function"])
def test_inverse_undoes_the_motion(kind):
    rng = np.random.default_rng(1)
    fields = {
        "affine": AffineField(gradient=((0.05, 0.02), (-0.03, -0.01)), offset=(0.3, -0.2)),
        "mesh": irregular_mesh(rng),
        "function": lambda x, y: (0.05 * np.sin(x + y), 0.03 * np.cos(2 * x)),
    }
    x, y = rng.uniform(-3, 3, (2, 500))
    ux, uy = fields[kind](x, y)
    mx, my = material_from_spatial(fields[kind], x + ux, y + uy)
    assert np.nanmax(np.hypot(mx - x, my - y)) < 1e-7
    assert np.isfinite(mx).mean() > 0.95


def test_plate_of_a_mesh_field_ends_with_the_mesh_and_moves_with_its_nodes():
    nodes = np.array([[-0.8, -0.8], [0.8, -0.8], [0.8, 0.8], [-0.8, 0.8]])
    field = MeshField(nodes=nodes, elements=np.array([[0, 1, 2], [0, 2, 3]]), displacement=0.01 * nodes + 0.05)
    scene = replace(plate_scene(size=40, tilt_deg=(0.0, 0.0), samples=3), body=Plate(width=50.0))
    affine = State(displacement=AffineField(gradient=((0.01, 0), (0, 0.01)), offset=(0.05, 0.05)))
    meshed = State(displacement=field)
    inside = np.isfinite(truth(scene, meshed)[0])
    assert inside.sum() == 30 * 30  # 1.6 mm of 0.055 mm
    assert np.allclose(truth(scene, meshed)[:, inside], truth(scene, affine)[:, inside])
    a, b = render(scene, meshed)[0], render(scene, affine)[0]
    assert np.allclose(a[10:30, 10:30], b[10:30, 10:30], atol=0.5)
    assert not a[0].any()


@pytest.mark.parametrize(
    "wrong",
    [
        {"nodes": np.zeros((3, 3))},
        {"elements": np.array([[0, 1, 3]])},
        {"elements": np.zeros((0, 3), dtype=int)},
        {"displacement": np.full((3, 2), np.nan)},
        {"displacement": np.array([[0, 0], [-2.0, 0], [0, 0]])},
    ],
)
def test_impossible_mesh_fields_are_refused(wrong):
    right = {
        "nodes": np.array([[0, 0], [1.0, 0], [0, 1.0]]),
        "elements": np.array([[0, 1, 2]]),
        "displacement": np.zeros((3, 2)),
    }
    MeshField(**right)
    with pytest.raises(InputError):
        MeshField(**{**right, **wrong})
    with pytest.raises(InputError, match="inside out"):
        AffineField(gradient=((-1.5, 0.0), (0.0, 0.0)))
