"""Errors of the calibration come into shape, displacement and strain as stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stereo_scene import Motion, pair_of

from rgbmidic import Region, Tri3Mesh
from rgbmidic.tools.stereo import CalibrationPart, CarriedMesh, Shape, triangulate

MESH = Tri3Mesh.from_region(Region.from_rectangle((10, 10, 150, 110), shape=(120, 160)), 30)
MOVED = Motion(degrees=(6.0, -9.0, 4.0), translation=(1.2, -0.9, 1.5))


def frame_of(shape, rest, deformed):
    """Quantities of a frame in which exact pixels are measured."""
    sides = [
        {
            **{name: (after - before)[:, column] for column, name in enumerate("uv")},
            **{f"{name}_std": np.full(len(before), 1e-9) for name in "uv"},
            **{f"{name}_bias_std": np.zeros(len(before)) for name in "uv"},
            "node_status": np.zeros(len(before), dtype=np.uint8),
        }
        for before, after in zip(rest, deformed, strict=True)
    ]
    return shape.frame(*sides)


@pytest.mark.parametrize("axes", ["plane", "camera"])
def test_draws_of_the_calibration_scatter_as_stated(axes):
    std = np.zeros(22)
    std[[0, 1, 2, 8, 9, 10]] = 1.5, 0.6, 0.6, 1.5, 0.6, 0.6
    std[[3, 11]] = 0.3  # the edge of the frame moves by .2 px
    std[16:] = 4e-4, 4e-4, 1e-4, 0.1, 0.01, 0.3
    random = np.random.default_rng(0)
    root = np.diag(std) @ np.linalg.qr(random.normal(size=(22, 22)))[0]  # correlated
    pair = replace(pair_of(), covariance=root @ root.T)
    points = Motion().points(Motion().material(pair, 0, MESH.nodes))
    rest = pair.project(points)
    deformed = pair.project(MOVED.points(Motion().material(pair, 0, MESH.nodes)))
    meshes = [Tri3Mesh(nodes=nodes, elements=MESH.elements) for nodes in rest]
    carried = CarriedMesh(
        nodes=np.arange(len(points)),
        left=meshes[0],
        right=meshes[1],
        region=meshes[1].region((120, 160)),
        right_std=np.full_like(MESH.nodes, 1e-9),
    )

    def measured(cameras):
        shape = Shape.of(cameras, carried, axes=axes)
        values = frame_of(shape, rest, deformed)
        motion, strain = (
            np.stack([values[name] for name in names], axis=1) for names in ("uvw", ("exx", "eyy", "exy"))
        )
        stds = [np.stack([values[f"{n}_std"] for n in names], axis=1) for names in ("uvw", ("exx", "eyy", "exy"))]
        return shape, [shape.points, motion, strain], stds

    shape, true, stds = measured(pair)
    stated = [np.sqrt(np.diagonal(shape.covariance, axis1=1, axis2=2)), *stds]
    drawn = [
        measured(
            replace(
                pair.with_parameters(pair.parameters + root @ random.normal(size=22)), covariance=np.zeros((22, 22))
            )
        )[1]
        for _ in range(40)
    ]
    for number, (exact, expected) in enumerate(zip(true, stated, strict=True)):
        observed = np.sqrt(np.mean([(draw[number] - exact) ** 2 for draw in drawn], axis=0))
        large = expected > 0.1 * expected.max(axis=0)
        assert (observed / expected)[large].mean() == pytest.approx(1, abs=0.25)
    assert np.abs(true[2]).max() < 1e-9  # nothing strains: all that draws show is the calibration
    assert stated[2].max() > 1e-5
    assert shape.calibration.length_std > 1e-4


def test_nothing_moves_nothing_is_uncertain():
    """The calibration's part is of what moves: of a surface at rest no error of the cameras makes motion or strain."""
    pair = replace(pair_of(), covariance=np.diag(np.r_[np.full(16, 1e-4), np.full(6, 1e-6)]))
    points = Motion().points(Motion().material(pair, 0, MESH.nodes))
    seen = triangulate(pair, *pair.project(points), np.eye(4)[None].repeat(len(points), axis=0))
    part = CalibrationPart.of(pair, MESH, seen, "plane")
    assert part.errors.surface.any()
    assert not part.errors.at_nodes(np.zeros((3, len(points)))).any()


def test_exact_cameras_leave_nothing():
    pair = pair_of()
    points = Motion().points(Motion().material(pair, 0, MESH.nodes))
    seen = triangulate(pair, *pair.project(points), np.eye(4)[None].repeat(len(points), axis=0))
    part = CalibrationPart.of(pair, MESH, seen, "plane")
    assert not part.errors.surface.any()
    assert part.length_std == 0
