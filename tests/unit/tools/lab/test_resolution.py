"""The command `rgbmidic resolution`: what it prints, writes and refuses; the spatial resolution it states."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).resolve().parents[4]))

from benchmarks.resolution import Scene
from rgbmidic.cli import app as cli
from rgbmidic.cli.command import execute
from rgbmidic.frames import write_tiff
from rgbmidic.frames.data import ChannelFrame
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.mesh.pixel_map import PixelMap
from rgbmidic.tools.lab.resolution import FILES, cut_offs
from rgbmidic.tools.report.document import ReportConstants

STATES = Scene("bump", width=14, height=1.2, noise=0.05, side=144).images()[0]
TEST = '[frames]\npath = "f*.tif"\nkind = "monochrome"\nwhite_level = 4095\n[region]\nrectangle = [8, 8, 135, 135]\n'


@pytest.fixture
def test_file(tmp_path):
    for number, state in enumerate(STATES):
        values = np.round(state).astype(np.uint16)
        write_tiff(tmp_path / f"f{number}.tif", ChannelFrame(values=values, black_level=0, white_level=4095))
    path = tmp_path / "TEST.toml"
    path.write_text(TEST)
    return path


@pytest.fixture
def command(capsys, monkeypatch):
    monkeypatch.setattr("rgbmidic._kernels.are_compiled", lambda: True)

    def run(*arguments):
        status = execute(cli.app, [str(argument) for argument in arguments], debug=False)
        return status, *capsys.readouterr()

    return run


def test_tables_files_and_one_sentence(command, test_file, tmp_path):
    out = tmp_path / "out"
    status, printed, _ = command("resolution", test_file, "--sizes", "8,16,25", "--out", out)
    assert status == 0
    assert "key frame 1: f1.tif; speckle 3.5 px; no static frames" in printed
    document = json.loads((out / "resolution.json").read_text())
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)
    choice = document["recommendation"]
    assert printed.rstrip().splitlines()[-1] == f"recommended: {choice['reason']}"
    assert choice["element_size"] in (16, 25)
    assert "8 px are less than 3 speckles" in choice["reason"]
    sizes = document["sizes"]
    assert [one["element_size_px"] for one in sizes] == [8, 16, 25]
    assert sizes[0]["scatter_px"] is None  # one reference frame: not known
    rows = list(csv.DictReader((out / "resolution.csv").read_text().splitlines()))
    assert [(row["element_size_px"], row["gauge_length_px"]) for row in rows] == [
        ("8", "24"), ("8", "48"), ("8", "75"), ("16", "48"), ("16", "75"), ("25", "75"),
    ]  # fmt: skip
    assert {row["scatter_px"] for row in rows} == {"nan"}
    assert float(rows[0]["gauge_noise"]) == pytest.approx(sizes[0]["gauges"][0]["noise"], rel=1e-4)
    assert command("resolution", test_file, "--sizes", "16", "--out", out)[0] == 2  # nothing is overwritten
    assert json.loads((out / "resolution.json").read_text()) == document


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--sizes", "10,x"], "--sizes are different lengths in px"),
        (["--sizes", "10,10"], "--sizes are different lengths in px"),
        (["--sizes", "-10"], "--sizes are different lengths in px"),
        (["--sizes", "nan"], "--sizes are different lengths in px"),
        (["--sizes", "3"], "3 px are too small: 4 px are the least"),
        (["--sizes", "16,90"], "elements of 90 px are too large for the region: 42 px"),
        (["--sizes", "16", "--gauges", "30"], "strain gauges of 30 px at most are too short"),
        (["--sizes", "16", "--gauges", "a"], "--gauges are different lengths"),
        (["--sizes", "16", "--frames", "0"], "frame 0 is of the reference"),
        (["--sizes", "16", "--frames", "7"], "frame 7 is not among 0 to 1"),
        (["--sizes", "16", "--frames", "1.5"], "--frames are indices and ranges"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(command, test_file, tmp_path, options, text):
    status, _, errors = command("resolution", test_file, *options, "--out", tmp_path / "out")
    assert status == 2
    assert text in errors
    assert len([line for line in errors.splitlines() if line.startswith("error:")]) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (("f*.tif", "f0.tif"), "the test has no deformed frame"),
        (("f*.tif", "g*.tif"), "g*.tif"),
        (("[region]", '[mesh]\nfile = "m.inp"\npoints = [[0,0,0,0],[1,1,1,1]]\n[region]'), "mesh.file names"),
    ],
)
def test_a_test_that_shows_nothing_is_refused(command, test_file, change, text):
    test_file.write_text(TEST.replace(*change))
    status, _, errors = command("resolution", test_file, "--sizes", "16")
    assert (status, text in errors) == (2, True), errors


def test_the_spatial_resolution_is_that_of_a_wave_measured_on_the_mesh():
    displacement, strain, gauges = cut_offs((3, 5, 8, 12, 30))
    assert 2 < displacement < 3 < strain < gauges[0]
    np.testing.assert_allclose(displacement, ReportConstants().finest_nodes, rtol=0.03)  # what a report states
    np.testing.assert_allclose(gauges / [3, 5, 8, 12, 30], ReportConstants().finest_gauge, rtol=0.06)
    # the gain of a linear fit that sees a wave of the stated period at every pixel, without its theory
    side, period = 20, 20 * displacement
    region = Region.from_rectangle((0, 0, 16 * side, 16 * side), (16 * side + 1,) * 2)
    mesh = Tri3Mesh.from_region(region, side)
    pixels = PixelMap.from_mesh(mesh, region)
    x = np.tile(np.arange(16 * side + 1, dtype=np.float32), (16 * side + 1, 1))
    wave = pixels.gather(np.cos(2 * np.pi * x / period)[None].astype(np.float32))[0]
    shape, nodes = shape_functions(mesh, pixels)
    normal = np.zeros((len(mesh.nodes),) * 2)
    right = np.zeros(len(mesh.nodes))
    for a in range(3):
        np.add.at(right, nodes[:, a], shape[:, a] * wave)
        for b in range(3):
            np.add.at(normal, (nodes[:, a], nodes[:, b]), shape[:, a] * shape[:, b])
    from rgbmidic.mesh.recovery import Recovery

    recovered = Recovery.over(mesh, np.ones(len(mesh.elements), bool)).value @ np.linalg.solve(normal, right)
    inner = ((mesh.nodes > 3.5 * side) & (mesh.nodes < 12.5 * side)).all(axis=1)
    true = np.cos(2 * np.pi * mesh.nodes[inner, 0] / period)
    assert (recovered[inner] @ true) / (true @ true) == pytest.approx(0.9, abs=0.03)


def shape_functions(mesh, pixels):
    """Shape functions (P, 3) and nodes (P, 3) of the element of each pixel."""
    element = np.repeat(np.arange(len(mesh.elements)), np.diff(pixels.offsets))
    place = np.stack([pixels.columns, pixels.rows], axis=1) - mesh.nodes[mesh.elements[element]].mean(axis=1)
    slopes = mesh.shape_gradients()[element]
    return 1 / 3 + np.einsum("pad,pd->pa", slopes, place), mesh.elements[element]
