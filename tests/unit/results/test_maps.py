"""Maps of derived fields: values of motions known in closed form, and errors as large as they are stated."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from nodal_tests import MESH, NodalTest
from results import NODES as SMALL
from results import make_result, smooth_record

from rgbmidic.errors import InputError
from rgbmidic.fields import strain_of_gradient
from rgbmidic.results import FrameRecord, Maps, Result
from rgbmidic.results.maps import _relative_gradient
from rgbmidic.settings import ScaleSettings
from rgbmidic.typing import FloatArray

FRAMES, SINCE = 26, 7
NODES = len(MESH.nodes)
FIRST, SECOND = np.array([[0.06, -0.5], [0.62, -0.02]]), np.array([[-0.02, 0.03], [0.05, 0.1]])
"""Displacement gradient per second and per second squared: a turn by 30 degrees, and a stretch."""
PUSH = np.array([[3.0, 0.0], [0.0, 2.0]])
CENTRE = 110.0
SCALE = ScaleSettings(mm_per_pixel=0.5)


def gradient(time: float) -> FloatArray:
    return FIRST * time + SECOND * time**2


TEST = NodalTest(
    times=np.arange(FRAMES) / FRAMES,
    motion=lambda points, time: (points - CENTRE) @ gradient(time).T + PUSH[0] * time + PUSH[1] * time**2,
)


def result_of(path: Path, field: FloatArray) -> Result:
    def record(index: int) -> FrameRecord:
        u, v = field[index].T
        head = {"number": index, "status": 0, "time_ns": round(TEST.times[index] * 1e9)}
        std = {"u_std": TEST.std[index], "v_std": TEST.std[index]}
        return FrameRecord.from_values(nodes=NODES, lights=3, node_status=np.zeros(NODES), u=u, v=v, **std, **head)

    mesh = {"nodes": MESH.nodes, "elements": MESH.elements}
    return make_result(path, frames=FRAMES, record=record, references=[0], **mesh)


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Result:
    return result_of(tmp_path_factory.mktemp("exact") / "result", TEST.truth)


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> list[Result]:
    return [result_of(tmp_path_factory.mktemp("noisy") / "result", TEST.measured(seed)) for seed in range(6)]


@pytest.mark.parametrize("frame", [12, 20])
def test_rates_are_the_derivatives_in_the_units_of_the_reader(exact: Result, frame: int) -> None:
    """Frames of two of the blocks that are computed at once."""
    maps, time = Maps.from_result(exact, SCALE), TEST.times[frame]
    slope = FIRST + 2 * SECOND * time
    velocity = 0.5 * ((MESH.nodes - CENTRE) @ slope.T + PUSH[0] + 2 * PUSH[1] * time)
    acceleration = 0.5 * (2 * (MESH.nodes - CENTRE) @ SECOND.T + 2 * PUSH[1])
    f = np.eye(2) + gradient(time)
    green = (slope.T @ f + f.T @ slope) / 2
    expected = {
        "u_velocity": velocity[:, 0], "v_velocity": velocity[:, 1], "velocity": np.hypot(*velocity.T),
        "v_acceleration": acceleration[:, 1], "acceleration": np.hypot(*acceleration.T),
        "exx_rate": green[0, 0], "eyy_rate": green[1, 1], "exy_rate": green[0, 1],
    }  # fmt: skip
    for name, truth in expected.items():
        np.testing.assert_allclose(maps.read(name, frame).values, np.broadcast_to(truth, NODES), rtol=2e-3, atol=1e-6)
    assert maps.quantities["velocity"].label == "|du/dt| (mm/s)"
    assert (maps.quantities["acceleration"].unit, maps.quantities["exx_rate"].unit) == ("mm/s²", "1/s")


def test_what_lies_between_two_frames_is_the_motion_of_the_material_from_one_to_the_other(exact: Result) -> None:
    maps, times = Maps.from_result(exact, since=SINCE), TEST.times
    np.testing.assert_allclose(maps.read("u", 20).values, (TEST.truth[20] - TEST.truth[SINCE])[:, 0], atol=1e-9)
    f = (np.eye(2) + gradient(times[20])) @ np.linalg.inv(np.eye(2) + gradient(times[SINCE]))
    truth = strain_of_gradient((f - np.eye(2))[None], np.zeros((1, 4, 4)))
    for name, values in {
        "exx": truth.components[0, 0],
        "e2": truth["e2"].values[0],
        "shear": truth["shear"].values[0],
    }.items():
        np.testing.assert_allclose(maps.read(name, 20).values, np.full(NODES, values), atol=1e-9)
    here = maps.read("u", SINCE)
    assert not here.values.any()
    assert not here.std.any()
    assert maps.read("exx", SINCE).std.max() < 1e-9
    assert "since frame 7" in maps.processing_note("exx")
    assert "since frame 7" in maps.processing_note("u")


def test_the_covariance_between_two_states_is_that_of_their_gradients() -> None:
    """By differences, of large gradients whose errors are correlated."""
    random = np.random.default_rng(3)
    states, root = random.normal(scale=0.4, size=(2, 2, 2)), random.normal(size=(8, 8))
    joint = root @ root.T
    parts = [(states[0][None], joint[None, :4, :4]), (states[1][None], joint[None, 4:, 4:])]
    found, covariance = _relative_gradient(*parts, joint[None, :4, 4:])

    def between(both: FloatArray) -> FloatArray:
        now, first = np.eye(2) + both.reshape(2, 2, 2)
        return (now @ np.linalg.inv(first) - np.eye(2)).ravel()

    at, step = states.ravel(), 1e-6
    slope = np.stack([(between(at + d) - between(at - d)) / (2 * step) for d in step * np.eye(8)], axis=1)
    np.testing.assert_allclose(found[0].ravel(), between(at))
    np.testing.assert_allclose(covariance[0], slope @ joint @ slope.T, rtol=1e-6)


def test_a_rigid_motion_that_is_removed_leaves_the_deformation(tmp_path: Path) -> None:
    c, s = np.cos(0.6), np.sin(0.6)
    stretch, turn = np.array([[1.02, 0.0], [0.0, 0.99]]), np.array([[c, -s], [s, c]])
    moved = (MESH.nodes - MESH.nodes.mean(axis=0)) @ (turn @ stretch).T + [5.0, -3.0] + MESH.nodes.mean(axis=0)
    field = np.stack([np.zeros((NODES, 2)), *[moved - MESH.nodes] * (FRAMES - 1)])
    maps = Maps.from_result(result_of(tmp_path / "result", field), rigid_removed=True, measure="engineering")
    left = (MESH.nodes - MESH.nodes.mean(axis=0)) @ (stretch - np.eye(2)).T
    np.testing.assert_allclose(maps.read("u", 3).values, left[:, 0], atol=1e-3)
    np.testing.assert_allclose(maps.read("magnitude", 3).values, np.hypot(*left.T), atol=1e-3)
    np.testing.assert_allclose(maps.read("exx", 3).values, np.full(NODES, 0.02), atol=1e-5)
    assert np.abs(Maps.from_result(maps.result, measure="engineering").read("exx", 3).values).min() > 0.1


CHOICES = {
    "plain": {},
    "since": {"since": SINCE},
    "since, rigid motion removed": {"since": SINCE, "rigid_removed": True, "measure": "engineering"},
    "longer gauge": {"gauge": 100.0, "measure": "hencky"},
}


@pytest.mark.parametrize("choice", CHOICES)
def test_errors_are_as_large_as_stated(exact: Result, noisy: list[Result], choice: str) -> None:
    right = Maps.from_result(exact, **CHOICES[choice])
    found: dict[str, list[FloatArray]] = {}
    for result in noisy:
        maps = Maps.from_result(result, **CHOICES[choice])
        for name, field in right.quantities.items():
            if field.group not in ("Displacement", "Strain"):
                continue
            for frame in (3, 12, 20):
                read = maps.read(name, frame)
                error = read.values - right.read(name, frame).values
                error = (error + 90) % 180 - 90 if field.kind == "angle" else error
                found.setdefault(name, []).append(error / read.std)
                np.testing.assert_array_equal(maps.read(f"{name}_std", frame).values, read.std)
    ratios = {name: np.sqrt(np.mean(np.square(parts))) for name, parts in found.items()}
    assert len(ratios) == 11
    assert all(0.9 < ratio < 1.1 for ratio in ratios.values()), ratios


def test_errors_of_rates_are_as_large_as_stated(exact: Result, noisy: list[Result]) -> None:
    """The mean over pieces of a series states its spread too (`rates`): .89 to .94 were found of six draws."""
    ratios = {}
    right, maps = Maps.from_result(exact), [Maps.from_result(result) for result in noisy[:2]]
    for name in ("velocity", "acceleration", "exx_rate"):
        parts = [each.read(name, frame) for each in maps for frame in (3, 12, 20)]
        truth = [right.read(name, frame).values for _ in maps for frame in (3, 12, 20)]
        ratios[name] = np.sqrt(np.mean([((a.values - b) / a.std) ** 2 for a, b in zip(parts, truth, strict=True)]))
    assert all(0.85 < ratio < 1.1 for ratio in ratios.values()), ratios


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (lambda result: Maps.from_result(result).read("speed", 0), 'no field "speed"; the fields are u, v, magnitude'),
        (lambda result: Maps.from_result(result, since=99), r"no frame 99 in a result of 26 frames \(0 to 25\)"),
        (lambda result: Maps.from_result(result, gauge=10.0), "must be at least 60 px long"),
        (lambda result: Maps.from_result(result, measure="small"), 'unknown strain measure "small"'),
        (lambda result: Maps.from_result(result, window=3), "4 frames or more, not 3"),
        (lambda result: Maps.from_result(result).read("u", 26), "no frame 26"),
    ],
)
def test_bad_choices_are_refused(exact: Result, act: Callable[[Result], object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        act(exact)


def test_nothing_is_known_since_a_frame_that_failed(tmp_path: Path) -> None:
    def record(index: int) -> FrameRecord:
        bad = {"number": 1, "status": 2, "reason": "no texture", "node_status": np.ones(SMALL)}
        return FrameRecord.from_values(nodes=SMALL, lights=3, **bad) if index == 1 else smooth_record(index)

    result = make_result(tmp_path / "r", frames=3, record=record)
    with pytest.raises(InputError, match="nothing is known since frame 1, in which nothing is measured: no texture"):
        Maps.from_result(result, since=1)


def test_what_was_read_does_not_go_to_another_process(tmp_path):
    maps = Maps.from_result(make_result(tmp_path / "result", frames=5, record=smooth_record), gauge=60.0)
    values = maps.read("exx_std", 4).values, maps.read("velocity", 4).values, maps.result.u
    sent = pickle.loads(pickle.dumps(maps))
    assert "u" in maps.result.__dict__
    for one in (sent, sent.physical, sent.result):
        assert one.__dict__.keys() == one.__dataclass_fields__.keys()
    there = sent.read("exx_std", 4).values, sent.read("velocity", 4).values, sent.result.u
    for one, same in zip(values, there, strict=True):
        np.testing.assert_array_equal(one, same)
