"""Mean strain over an area: that of the mean displacement gradient, with the uncertainty that its scatter has."""

from __future__ import annotations

import numpy as np
import pytest
from nodal_tests import COVARIANCE, MESH, STD, nodal_noise

from rgbmidic.fields import Displacement, make_probe
from rgbmidic.settings import ProbeSettings
from rgbmidic.typing import FloatArray

GRADIENT = np.array([[0.02, -0.013], [0.004, -0.007]])
AREAS = {"region": (43, 41, 151, 127), "circle": (100, 90, 45)}


def read(kind: str, moved: FloatArray, measure: str = "green-lagrange") -> dict[str, tuple[FloatArray, FloatArray]]:
    probe = make_probe(COVARIANCE, kind, 1, AREAS[kind], ProbeSettings(measure=measure))
    part, std = moved[:, probe.nodes], np.full((len(moved), len(probe.nodes)), STD)
    std = np.where(np.isfinite(part[..., 0]), std, np.nan)
    found = probe.histories(Displacement.in_plane(*np.moveaxis(part, 2, 0), std, std))
    return {history.name.removeprefix(f"{kind}_1_"): (history.values, history.std) for history in found}  # type: ignore[misc]


@pytest.mark.parametrize("kind", AREAS)
def test_an_affine_motion_has_its_strain_also_where_nodes_are_missing(kind: str) -> None:
    moved = np.stack([MESH.nodes @ GRADIENT.T] * 2)
    moved[1, np.hypot(*(MESH.nodes - [90, 90]).T) < 15] = np.nan
    found, turned = read(kind, moved), np.eye(2) + GRADIENT
    green = (turned.T @ turned - np.eye(2)) / 2
    for name, value in {"exx": green[0, 0], "eyy": green[1, 1], "exy": green[0, 1]}.items():
        np.testing.assert_allclose(found[name][0], value, atol=1e-12)
    np.testing.assert_allclose(read(kind, moved, "engineering")["exx"][0], 0.02, atol=1e-12)
    assert found["exx"][1][1] > found["exx"][1][0]


@pytest.mark.parametrize("kind", AREAS)
def test_a_curved_motion_has_the_mean_of_its_strain(kind: str) -> None:
    x, y = MESH.nodes.T
    moved = np.stack([1e-4 * (x - 110) ** 2, 0 * y], axis=1)[None]
    middle = {"region": 97.0, "circle": 100.0}[kind]
    assert read(kind, moved, "engineering")["exx"][0][0] == pytest.approx(2e-4 * (middle - 110), abs=1e-4)


@pytest.mark.parametrize("kind", AREAS)
def test_the_scatter_in_noise_is_the_stated_uncertainty(kind: str) -> None:
    found = read(kind, STD * nodal_noise(np.random.default_rng(0), 3000), "engineering")
    for name in ("exx", "eyy", "exy"):
        values, std = found[name]
        assert np.std(values) == pytest.approx(np.median(std), rel=0.1)


def test_too_little_of_an_area_has_no_strain() -> None:
    moved = np.stack([MESH.nodes @ GRADIENT.T])
    moved[0, MESH.nodes[:, 0] > 80] = np.nan
    assert np.isnan(read("region", moved)["exx"][0]).all()
