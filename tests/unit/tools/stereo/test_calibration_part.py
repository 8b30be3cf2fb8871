"""Errors of the calibration come into shape and displacement as stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stereo_scene import Motion, pair_of

from rgbmidic import Region, Tri3Mesh
from rgbmidic.tools.stereo import Axes, CalibrationPart, CarriedMesh, Shape, triangulate

MESH = Tri3Mesh.from_region(Region.from_rectangle((10, 10, 150, 110), shape=(120, 160)), 30)
MOVED = np.array([0.2, -0.3, 0.8])


@pytest.mark.parametrize("axes", ["plane", "camera"])
def test_draws_of_the_calibration_scatter_as_stated(axes):
    std = np.zeros(22)
    std[[0, 1, 2, 8, 9, 10]] = 1.5, 0.6, 0.6, 1.5, 0.6, 0.6
    std[16:] = 4e-4, 4e-4, 1e-4, 0.1, 0.01, 0.3
    random = np.random.default_rng(0)
    root = np.diag(std) @ np.linalg.qr(random.normal(size=(22, 22)))[0]  # correlated
    pair = replace(pair_of(), covariance=root @ root.T)
    points = Motion().points(Motion().material(pair, 0, MESH.nodes))
    rest, deformed = pair.project(points), pair.project(points + MOVED)
    meshes = [Tri3Mesh(nodes=nodes, elements=MESH.elements) for nodes in rest]
    region, tiny = meshes[1].region((120, 160)), np.full_like(MESH.nodes, 1e-9)
    carried = CarriedMesh(nodes=np.arange(len(points)), left=meshes[0], right=meshes[1], region=region, right_std=tiny)
    shape = Shape.of(pair, carried, axes=axes)
    displacement = MOVED @ shape.axes.rotation.T
    stated = shape.calibration.displacement_covariance(displacement[None])[0]
    spread, off = np.eye(4)[None].repeat(len(points), axis=0), []
    for _ in range(60):
        drawn = pair.with_parameters(pair.parameters + root @ random.normal(size=22))
        first, second = (triangulate(drawn, *pixels, spread).points for pixels in (rest, deformed))
        turned = Axes.of(axes, MESH, first)
        off.append([turned.points(first) - shape.points, (second - first) @ turned.rotation.T - displacement])
    errors = np.array(off)
    observed = np.sqrt((errors[:, 0] ** 2).mean(axis=0))
    expected = np.sqrt(np.diagonal(shape.covariance, axis1=1, axis2=2))
    large = expected > 0.1 * expected.max(axis=0)
    assert (observed / expected)[large].mean() == pytest.approx(1, abs=0.2)
    ratio = np.sqrt((errors[:, 1].mean(axis=1) ** 2).mean(axis=0) / np.diag(stated))
    assert ratio == pytest.approx(1, abs=0.3)
    assert shape.calibration.length_std > 1e-4


def test_exact_cameras_leave_nothing():
    pair = pair_of()
    points = Motion().points(Motion().material(pair, 0, MESH.nodes))
    seen = triangulate(pair, *pair.project(points), np.eye(4)[None].repeat(len(points), axis=0))
    part = CalibrationPart.of(pair, MESH, seen, np.eye(4)[None].repeat(len(points), axis=0), "plane")
    assert not part.shape.any()
    assert part.length_std == 0
