"""Surface strain: none of a rigid motion, exact of a stretch, as uncertain as stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stereo_scene import DISTANCE, Motion

from rgbmidic import Region, Tri3Mesh
from rgbmidic.errors import InputError
from rgbmidic.fields import NodalCovariance, StrainGauges
from rgbmidic.tools.stereo import Axes, attitude, displacement_in_space

MESH = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 120, 90), shape=(100, 130)), 15)
MATERIAL = (MESH.nodes - MESH.nodes.mean(axis=0)) * 0.2
REST = Motion().points(MATERIAL)
EXACT = np.zeros((len(REST), 3, 3))


def gauges_on(points=REST, length=None):
    return StrainGauges.at_nodes(replace(NodalCovariance.from_mesh(MESH), surface=points), length)


def moved(displacement, covariance=EXACT):
    return displacement_in_space(displacement.T, np.moveaxis(covariance, 0, 2))


def tilt_of(motion):
    """Angle in degrees by which a motion turns the plate's normal."""
    return np.degrees(np.arccos(motion.attitude[:, 2] @ Motion().attitude[:, 2]))


def test_a_rigid_motion_strains_nothing():
    motion = Motion(degrees=(20.0, -35.0, 50.0), translation=(3.0, 2.0, -9.0))
    displacement = moved(motion.points(MATERIAL) - REST)
    assert np.abs(gauges_on().strain(displacement).components).max() < 1e-12
    assert attitude(gauges_on(), displacement)[1].values == pytest.approx(tilt_of(motion), abs=1e-6)


@pytest.mark.parametrize("measure", ["green-lagrange", "biot"])
def test_a_stretch_of_a_plate_that_turns_is_exact(measure):
    """In the axes of the plate itself, whichever way it faces."""
    stretch = np.array([[1.02, 0.0], [0.01, 0.99]])
    axes = Axes.of("plane", MESH, REST)
    motion = Motion(stretch=tuple(map(tuple, stretch)), degrees=(5.0, 9.0, -20.0))
    gauges, displacement = gauges_on(axes.points(REST)), moved((motion.points(MATERIAL) - REST) @ axes.rotation.T)
    strain, (normal, _) = gauges.strain(displacement, measure), attitude(gauges, displacement)
    along = axes.rotation @ Motion().attitude[:, :2]  # the material's axes in those of the result
    c = along[:2] @ (stretch.T @ stretch) @ along[:2].T
    values, vectors = np.linalg.eigh(c)
    true = (c - np.eye(2)) / 2 if measure == "green-lagrange" else (vectors * np.sqrt(values)) @ vectors.T - np.eye(2)
    assert strain.components == pytest.approx(np.array([[true[0, 0], true[1, 1], true[0, 1]]] * len(REST)), abs=1e-10)
    assert normal == pytest.approx(np.tile(axes.rotation @ motion.attitude[:, 2], (len(REST), 1)), abs=1e-9)


def test_noise_of_nodes_that_are_correlated_as_those_of_a_fit_is_stated():
    random, ratios, tilts = np.random.default_rng(0), [], []
    motion = Motion(degrees=(1, 2, 3))
    gauges = gauges_on(length=70.0)
    fit = NodalCovariance.from_mesh(MESH).fit
    root = np.diag([1e-3, 2e-3, 5e-3])
    covariance = np.tile(root @ root.T, (len(REST), 1, 1))
    for _ in range(60):
        noise = fit @ random.normal(size=(fit.shape[1], 3)) @ root.T
        displacement = moved(motion.points(MATERIAL) - REST + noise, covariance)
        strain, (_, tilt) = gauges.strain(displacement), attitude(gauges, displacement)
        ratios.append(strain.components / strain.components_std)
        tilts.append((tilt.values - tilt_of(motion)) / tilt.std)
    assert np.sqrt(np.mean(np.square(tilts))) == pytest.approx(1, abs=0.1)
    assert np.sqrt(np.mean(np.square(ratios), axis=(0, 1))) == pytest.approx(1, abs=0.1)


def test_a_node_without_data_leaves_its_gauge_without():
    gauges = gauges_on()
    displacement = np.zeros_like(REST)
    displacement[10] = np.nan
    strain, (normal, tilt) = gauges.strain(moved(displacement)), attitude(gauges, moved(displacement))
    assert np.isnan(strain.components[10]).all()
    assert np.isnan(normal[10]).all()
    assert np.isnan(tilt.values[10])
    assert np.isfinite(strain.components).any()


def test_axes():
    plane = Axes.of("plane", MESH, REST)
    assert plane.points(REST)[:, 2] == pytest.approx(0, abs=1e-9)
    assert plane.rotation[2, 2] > 0
    assert np.linalg.det(plane.rotation) == pytest.approx(1)
    through = Axes.of([(0, 0), (120, 0), (0, 90)], MESH, REST)
    assert through.points(REST[:1]) == pytest.approx(np.zeros((1, 3)), abs=1e-9)
    assert through.points(REST)[:, 0].max() == pytest.approx(120 * 0.2)
    assert (Axes.of("camera", MESH, REST).points(REST) == REST).all()
    assert REST[:, 2].mean() == pytest.approx(DISTANCE, abs=5)
    for wrong in ("world", [(0, 0), (50, 0), (100, 0)], [(0, 0), (50, 0), (500, 40)], [(0, 0)]):
        with pytest.raises(InputError):
            Axes.of(wrong, MESH, REST)
