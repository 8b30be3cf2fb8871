"""A plan on paper: tables, JSON, picture, and the command that writes them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rgbmidic.cli import app as cli
from rgbmidic.cli.command import execute
from rgbmidic.errors import InputError, ResultError
from rgbmidic.tools.lab.planning import make_plan, propose_lamps
from rgbmidic.tools.lab.planning_report import (
    lamp_rows,
    out_of_plane_error,
    plan_document,
    plan_figure,
    uncertainty_rows,
    write_plan,
    zone_rows,
)
from rgbmidic.tools.scene.scene import State, read_scene
from rgbmidic.tools.scene.zones import truth

SCENE = """
[body]
kind = "sphere"
[surface]
droplet = 0.9
[camera]
shape = [120, 160]
mm_per_pixel = 0.22
[[states]]
angle_deg = 1.0
[[states]]
angle_deg = 4.0
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory):
    path = tmp_path_factory.mktemp("plan") / "scene.toml"
    path.write_text(SCENE)
    plan = make_plan(read_scene(path))
    return path, plan, {"lamps moved": propose_lamps(plan)}


def test_the_rows_hold_what_the_plan_holds(made):
    _, plan, _ = made
    headings, rows = zone_rows(plan)
    assert [len(row) for row in rows] == [len(headings)] * 2
    assert rows[1][0] == "2: 4 deg"
    assert rows[1][2:5] == [f"{plan.fraction(mask):.1%}" for mask in plan.outlooks[1].reflects]
    headings, rows = uncertainty_rows(plan)
    assert float(rows[0][1]) == pytest.approx(np.median(plan.outlooks[0].std[plan.inside]), abs=1e-4)
    headings, rows = lamp_rows(plan)
    assert rows[0][:4] == ["red", "[-190, -12, 90]", "184", "20"]


def test_the_document_is_plain_json_and_says_the_same(made):
    _, plan, proposals = made
    document = json.loads(json.dumps(plan_document(plan, proposals), allow_nan=False))
    assert document["field_px"] == list(plan.field)
    assert [light["name"] for light in document["lights"]] == ["red", "green", "blue"]
    state = document["states"][1]
    assert state["angle_deg"] == 4
    assert 0 < state["std_px"]["median"] <= state["std_px"]["q95"] <= state["std_px"]["largest"]
    assert state["reflecting"]["green"] == plan.fraction(plan.outlooks[1].reflects[1])
    moved = document["proposals"]["lamps moved"]
    assert moved["lights"][0]["position_mm"] == list(proposals["lamps moved"].scene.lights[0].position)


def test_the_picture_shows_zones_and_uncertainty_where_they_are(made):
    _, plan, proposals = made
    figure = plan_figure(plan, proposals)
    panels = 2 + (proposals["lamps moved"].gain > 1)
    zones, maps = figure.axes[:panels], figure.axes[panels : 2 * panels]
    for axis in (*zones, *maps):
        assert axis.get_xlim() == (-0.5, 159.5)
        assert axis.get_ylim() == (119.5, -0.5)
    # where red reflects, the picture of the first state is red
    picture, share = zones[0].images[0].get_array(), plan.reference.fraction
    red = (share[0] > 0.5) & (share[1:].max(axis=0) < 0.05)
    assert red.any()
    assert (picture[red][:, 0] > 1.3 * picture[red][:, 2]).all()
    np.testing.assert_allclose(maps[1].images[0].get_array(), plan.outlooks[1].std)


def test_nothing_is_overwritten_unless_asked(made, tmp_path):
    _, plan, _ = made
    write_plan(plan, {}, tmp_path / "plan")
    before = (tmp_path / "plan" / "plan.json").read_bytes()
    with pytest.raises(ResultError, match=r"plan\.json is already there"):
        write_plan(plan, {}, tmp_path / "plan")
    assert (tmp_path / "plan" / "plan.json").read_bytes() == before
    assert (tmp_path / "plan" / "plan.png").stat().st_size > 10_000
    write_plan(plan, {}, tmp_path / "plan", overwrite=True)
    (tmp_path / "file").write_text("x")
    with pytest.raises(ResultError, match="is a file"):
        write_plan(plan, {}, tmp_path / "file")


@pytest.mark.usefixtures("small_pictures")
def test_the_command_prints_the_tables_and_writes_the_files(made, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scene, plan, _ = made
    assert execute(cli.app, ["plan", str(scene), "--out", str(tmp_path / "out")], debug=False) == 0
    printed = capsys.readouterr().out
    assert max(len(line) for line in printed.splitlines() if "plan.json" not in line) <= 100
    assert "lamps as they are: reflections overlap on up to" in printed
    assert f"u_std {plan.std:.4f} px" in printed
    assert all(f"  {word}: " in printed for word in ("random", "feigned", "clipped"))
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["plan.json", "plan.png"]
    assert execute(cli.app, ["plan", str(scene), "--out", str(tmp_path / "out")], debug=False) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_a_motion_towards_the_camera_is_what_the_renderer_shows(made):
    _, plan, _ = made
    told = out_of_plane_error(plan)
    x0, y0, x1, y1 = plan.field
    corners = np.array([[x0, x1, x0, x1], [y0, y0, y1, y1]])
    motion = truth(plan.scene, State(translation=(0.0, 0.0, -0.01)), None, tuple(corners))
    there = np.linalg.norm(corners - np.reshape(plan.scene.camera.centre, (2, 1)), axis=0)
    strain = np.linalg.norm(motion, axis=0) / there  # of the lines from the optical axis
    depth = plan.scene.body.front[2]
    assert strain == pytest.approx(0.01 * told["strain_per_mm"], rel=0.03)  # the plate or sphere is not at one distance
    assert told["edge_px_per_mm"] * 0.01 == pytest.approx(np.linalg.norm(motion, axis=0).max(), rel=0.03)
    assert told["unseen_mm"] * told["edge_px_per_mm"] == pytest.approx(plan.std)
    assert out_of_plane_error(plan, 2 * depth)["strain_per_mm"] == pytest.approx(told["strain_per_mm"] / 2)
    assert plan_document(plan, {}, 500.0)["out_of_plane"]["stand_off_mm"] == 500
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="`distance`"):
            out_of_plane_error(plan, wrong)
