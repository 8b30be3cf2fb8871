"""Figures show what the result holds: right place, right values, blank where nothing was measured."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from results import LIGHTS, MESH, NODES, make_result

from rgbmidic.errors import InputError, ResultError
from rgbmidic.report import figures
from rgbmidic.report.gallery import remove_figures, write_figures
from rgbmidic.results import FrameRecord, Result, ResultStore

IMAGE = np.random.default_rng(0).normal(1000, 100, (80, 120))


def _linear_result(path: Path, *, blank: bool = False) -> Result:
    """One frame with u = x / 10 and v = 1 - y / 20; some nodes blank where asked for."""
    x, y = MESH.nodes.T
    hidden = (x > 60) & blank
    store = ResultStore.create(path, nodes=MESH.nodes, elements=MESH.elements, names=["only"], lights=LIGHTS)
    record = FrameRecord.of(
        nodes=NODES,
        lights=len(LIGHTS),
        u=np.where(hidden, np.nan, x / 10),
        v=np.where(hidden, np.nan, 1 - y / 20),
        status=0,
        node_status=hidden,
        residual=np.ones(3),
        history=np.array([1.0, 0.01, 0.0001]),
    )
    store.write_frame(0, record)
    return Result.open(path)


@pytest.mark.parametrize("image", [None, IMAGE])
def test_map_has_the_right_value_at_every_place(tmp_path: Path, image: np.ndarray | None) -> None:
    result = _linear_result(tmp_path / "out")
    figure = figures.displacement_figure(result, 0, image)
    for axis, field in zip(figure.axes[:2], (lambda x, y: x / 10, lambda x, y: 1 - y / 20), strict=True):
        picture = axis.images[-1]
        values = picture.get_array()
        left, right, bottom, top = picture.get_extent()
        x = left + (np.arange(values.shape[1]) + 0.5) * (right - left) / values.shape[1]
        y = top + (np.arange(values.shape[0]) + 0.5) * (bottom - top) / values.shape[0]
        np.testing.assert_allclose(values, field(*np.meshgrid(x, y)), atol=1e-9)
        assert axis.get_ylim()[0] > axis.get_ylim()[1], "y points down"
        assert axis.get_aspect() == 1
        assert "px" in axis.get_title()


def test_blank_where_not_measured(tmp_path: Path) -> None:
    figure = figures.displacement_figure(_linear_result(tmp_path / "out", blank=True), 0)
    picture = figure.axes[0].images[-1]
    hidden = np.ma.getmaskarray(picture.get_array())
    left, right = picture.get_extent()[:2]
    x = left + (np.arange(hidden.shape[1]) + 0.5) * (right - left) / hidden.shape[1]
    # an element is blank as soon as one of its nodes is: from the last measured column of nodes on
    assert hidden[:, x > 60.01].all()
    assert not hidden[:, x < 60 - 20].any()


def test_one_wild_node_does_not_flatten_the_colours() -> None:
    values = np.linspace(0, 1, 500)
    assert figures._limits(values) == (0, 1)
    low, high = figures._limits(np.append(values, 1000))
    assert (low, high) == pytest.approx((0, 1.1), abs=0.01)


def test_all_figures_can_be_written(tmp_path: Path) -> None:
    result = make_result(tmp_path / "out", frames=12, reference=np.stack([IMAGE] * 3))
    files = write_figures(result, tmp_path / "figures", frames=2)
    names = {file.name for file in files}
    told_once = {"convergence.png", "residual.png", "brightness.png", "masks.png", "reflections.png"}
    assert told_once | {"displacement_000011.png", "shares_000011.png"} <= names
    assert len(names) == len(told_once) + 1 + 2 * 2
    assert all(file.stat().st_size > 5000 for file in files)


def test_pictures_of_an_earlier_run_are_removed_and_no_others(tmp_path: Path) -> None:
    result = make_result(tmp_path / "out", frames=3, reference=np.stack([IMAGE] * 3))
    files = write_figures(result, tmp_path / "figures")
    mine = tmp_path / "figures" / "my_displacement.png"
    mine.write_bytes(b"kept")
    remove_figures(tmp_path / "figures")
    assert not any(file.exists() for file in files)
    assert mine.read_bytes() == b"kept"
    remove_figures(tmp_path / "nowhere")


def test_frame_where_nothing_is_measured_still_has_a_figure(tmp_path: Path) -> None:
    store = ResultStore.create(tmp_path / "out", nodes=MESH.nodes, elements=MESH.elements, names=["bad"], lights=LIGHTS)
    store.write_frame(0, FrameRecord.failed("damaged", nodes=NODES, lights=3))
    for file in write_figures(Result.open(tmp_path / "out"), tmp_path / "figures"):
        assert file.stat().st_size > 2000


def test_mask_shades_what_is_excluded() -> None:
    weights = np.ones((2, 40, 60))
    weights[0, :20] = 0
    figure = figures.mask_figure(np.stack([IMAGE, IMAGE]), weights, ("red", "blue"))
    shade = figure.axes[0].images[-1]
    alpha = shade.get_array()[..., 3]
    assert alpha[:20].min() > 0.5
    assert alpha[20:].max() == 0
    assert shade.get_extent() == [-0.5, 119.5, 79.5, -0.5]
    assert "50.0% excluded" in figure.axes[0].get_title()
    with pytest.raises(InputError, match="masks need"):
        figures.mask_figure(np.stack([IMAGE, IMAGE]), weights[:1], ("red", "blue"))


def test_impossible_frame_and_file(tmp_path: Path) -> None:
    result = _linear_result(tmp_path / "out")
    with pytest.raises(InputError, match="no frame 1"):
        figures.displacement_figure(result, 1)
    with pytest.raises(ResultError, match="cannot be written"):
        figures.save_figure(figures.residual_figure(result), tmp_path / "none" / "a.png")


def test_matplotlib_is_imported_only_for_a_figure() -> None:
    code = "import sys, rgbmidic.report.gallery, rgbmidic.results.export; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
