"""Errors of a calibration in what probes measure on a surface in space: those of a surface and a motion off by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbmidic import Region, Tri3Mesh
from rgbmidic.field import Displacement, Field
from rgbmidic.fields import CalibrationErrors, NodalCovariance, RigidMotion, StrainGauges
from rgbmidic.fields.history import rates
from rgbmidic.fields.probes import make_probe
from rgbmidic.fields.profiles import ProfileLine

MESH = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 120, 90), shape=(100, 130)), 15)
X, Y = MESH.nodes.T
SURFACE = np.stack([0.2 * X, 0.2 * Y, 1e-3 * X**2], axis=1)
CAUSES, STEP = 3, 1e-4
RANDOM = np.random.default_rng(0)
TREND = np.stack([np.ones_like(X), X / 60 - 1, Y / 45 - 1])
ERRORS = CalibrationErrors(
    surface=STEP * RANDOM.normal(size=(CAUSES, 3, 3)) @ TREND, gain=STEP * RANDOM.normal(size=(CAUSES, 3, 3, 3)) @ TREND
)
SLOPE = 2e-4  # errors are to first order in the slopes
MOTION = np.stack(
    [[0.1 + SLOPE * X, 0.3 - SLOPE * X, 0.4 + SLOPE * Y], [0.5 - SLOPE * X, 2 * SLOPE * Y, 0.1 - SLOPE * X]], axis=1
)


def motion(values=MOTION):
    """Displacement (3, T, N) of the nodes, hardly uncertain."""
    std = np.full_like(values, 1e-9)
    covariance = np.einsum("ij,...->ij...", np.eye(3) * 1e-18, np.ones(values.shape[1:]))
    return Displacement(unit="mm", values=values, std=std, covariance=covariance)


def nodal(surface=SURFACE, calibration=None):
    return replace(NodalCovariance.from_mesh(MESH), surface=surface, calibration=calibration)


def off_by(cause):
    """The same nodes and motion, off by the errors of a cause."""
    moved = np.stack([MOTION[:, frame] + ERRORS.at_nodes(MOTION[:, frame])[cause] for frame in range(2)], axis=1)
    return nodal(SURFACE + ERRORS.surface[cause].T), motion(moved)


PROBES = {"point": (50, 40), "line": (20, 30, 90, 60), "region": (20, 20, 100, 70), "gauge": (20, 30, 100, 60),
          "straight_gauge": (20, 30, 100, 60), "strain_gauge": (60, 45, 60)}  # fmt: skip


@pytest.mark.parametrize("kind", PROBES)
def test_common_errors_of_a_probe_are_those_of_what_is_off(kind):
    def histories(covariance, displacement):
        probe = make_probe(covariance, kind, 1, PROBES[kind])
        return probe.histories(displacement.isel(node=probe.nodes))

    stated = histories(nodal(calibration=ERRORS), motion())
    for cause in range(CAUSES):
        exact, off = histories(nodal(), motion()), histories(*off_by(cause))
        for field, rest, changed in zip(stated, exact, off, strict=True):
            expected = changed.values - rest.values
            if field.name.endswith("direction"):
                expected = (expected + 90) % 180 - 90
            assert field.common[cause] == pytest.approx(expected, abs=0.01 * np.abs(expected).max() + 1e-7), field.name
    for field, rest in zip(stated, histories(nodal(), motion()), strict=True):
        assert field.std**2 == pytest.approx(rest.std**2 + (field.common**2).sum(axis=0))


def test_strain_of_gauges_and_the_rigid_motion_have_the_errors_too():
    frame = motion().isel(frame=1)
    gauges = StrainGauges.at_nodes(nodal(calibration=ERRORS), 60.0)
    strain, noise = gauges.strain(frame), StrainGauges.at_nodes(nodal(), 60.0).strain(frame)
    rigid = RigidMotion.of(nodal(calibration=ERRORS), frame)
    expected = noise.components_std**2
    for cause in range(CAUSES):
        surface, moved = off_by(cause)
        moved = moved.isel(frame=1)
        expected += (StrainGauges.at_nodes(surface, 60.0).strain(moved).components - strain.components) ** 2
        turned = RigidMotion.of(surface, moved)
        for one, exact in ((turned.shift, rigid.shift), (turned.rotation, rigid.rotation)):
            off = one.values - exact.values
            assert exact.common[cause] == pytest.approx(off, abs=5e-3 * np.abs(off).max())
    assert strain.components_std == pytest.approx(np.sqrt(expected), rel=5e-3)
    # a frame has all with itself in common: since itself nothing is uncertain
    assert gauges.shared_covariance(frame, frame, 1.0) == pytest.approx(gauges.gradient(frame)[1])


def test_a_profile_has_the_errors_at_all_places_together():
    covariance, values = nodal(), MOTION[0, 1]
    line = ProfileLine(covariance, StrainGauges.at_nodes(covariance), 10, 45, 110, 45)
    noise = Field(name="u", dims=("node",), values=values, std=np.full_like(values, 1e-3))
    along = line.read(noise.with_common(ERRORS.at_nodes(MOTION[:, 1])[:, 0]))
    x = np.linspace(10, 110, len(line.points))
    expected = np.stack([np.interp(x, *_row(errors)) for errors in ERRORS.at_nodes(MOTION[:, 1])[:, 0]])
    assert along.common == pytest.approx(expected, abs=0.02 * np.abs(expected).max())
    assert along.noise.std == pytest.approx(line.read(noise).std)
    correlation = line.correlation(common_fraction=0.4)
    far = line.correlation()
    assert correlation == pytest.approx(0.6 * far + 0.4)


def _row(errors):
    row = np.flatnonzero(Y == 45)
    return X[row], errors[row]


def test_common_errors_are_neither_noise_nor_smoothed_in_a_rate():
    times = np.arange(12.0)
    has_data = times != 4
    series = Field(name="u", values=times**2, std=np.where(has_data, 0.01, np.nan))
    common = np.where(has_data, 1e-2 * np.stack([times**2, -3 * times]), np.nan)
    plain, stated = (
        rates(times, field, window=5, common_fraction=0.0, references=[False] * 12)
        for field in (series, series.with_common(common))
    )
    for name, expected in {
        "velocity": [0.02 * times, -0.03 + 0 * times],
        "value": [0.01 * times**2, -0.03 * times],
    }.items():
        assert stated[name].common[:, 1:4] == pytest.approx(np.stack(expected)[:, 1:4], rel=1e-6)
        assert stated[name].noise.std == pytest.approx(plain[name].std, rel=1e-6, nan_ok=True)
