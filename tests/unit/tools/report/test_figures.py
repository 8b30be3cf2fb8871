"""Figures show what the result holds: right place, right values, blank where nothing was measured."""

from __future__ import annotations

import errno
import io
import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.text import Text
from results import LIGHTS, MESH, NODES, make_origin, make_result

from rgbmidic.errors import InputError, ResultError
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.results import QUANTITIES, FrameRecord, Maps, Origin, Result, ResultStore
from rgbmidic.settings import FrameSettings, RegionSettings, ScaleSettings, TestSettings
from rgbmidic.tools.report import curves, figures, remove_pictures, save_figure, style, write_figures, write_maps
from rgbmidic.tools.report.painter import reference_picture
from rgbmidic.typing import AnyArray

IMAGE = np.random.default_rng(0).normal(1000, 100, (80, 120))
X, Y = MESH.nodes.T
SETTINGS = {"frames": {"path": "x.cine", "kind": "monochrome"}, "region": {"rectangle": [0, 0, 9, 9]}}
EVERY_FRAME = {"displacement", "uncertainty", "strain", "misfit", "fractions"}


def _one_frame(
    path: Path, reference: AnyArray | None = None, notes: dict[str, Any] | None = None, **values: Any
) -> Result:
    """A result of one frame with the quantities given."""
    with ResultStore.create(path, make_origin(1, reference=reference, notes=notes or {})) as store:
        store.write_frame(0, FrameRecord.from_values(nodes=NODES, lights=len(LIGHTS), **values))
    return Result.open(path)


def _maps(result: Result, frame: int, kind: str) -> Any:
    """Maps of a kind in a frame."""
    return figures.MapDrawer(Maps.from_result(result)).fields(frame, figures.MAPS[kind])


def _places(picture: Any) -> tuple[AnyArray, AnyArray]:
    """x and y of the columns and rows of a map."""
    rows, columns = picture.get_array().shape[:2]
    left, right, bottom, top = picture.get_extent()
    x = left + (np.arange(columns) + 0.5) * (right - left) / columns
    return x, top + (np.arange(rows) + 0.5) * (bottom - top) / rows


@pytest.mark.parametrize("reference", [None, np.stack([IMAGE] * 3)])
def test_map_has_the_right_value_at_every_place(tmp_path: Path, reference: AnyArray | None) -> None:
    result = _one_frame(tmp_path / "out", reference, u=X / 10, v=1 - Y / 20)
    figure = _maps(result, 0, "displacement")
    for axis, field in zip(figure.axes[:2], (lambda x, y: x / 10, lambda x, y: 1 - y / 20), strict=True):
        picture = axis.images[-1]
        np.testing.assert_allclose(picture.get_array(), field(*np.meshgrid(*_places(picture))), atol=1e-9)
        assert axis.get_ylim()[0] > axis.get_ylim()[1], "y points down"
        assert axis.get_aspect() == 1
        assert "px" in axis.get_title()


def test_a_map_of_a_mesh_with_a_crack_has_the_values_of_both_sides(tmp_path: Path) -> None:
    mesh = Tri3Mesh.from_region(Region.from_rectangle((10, 5, 110, 75), (80, 120)), 20, [[(0, 40), (60, 40)]])
    above = mesh.observation_points[:, 1] < 40
    left = mesh.nodes[:, 0] < 59
    origin = Origin(nodes=mesh.nodes, elements=mesh.elements, names=["one"], lights=["one"])
    with ResultStore.create(tmp_path / "out", origin) as store:
        zero = np.zeros(len(mesh.nodes))
        jump = np.where(left, np.where(above, -1.0, 1.0), 0.0)
        store.write_frame(
            0, FrameRecord.from_values(nodes=len(mesh.nodes), lights=1, u=zero, v=jump, u_std=zero, v_std=zero)
        )
    picture = _maps(Result.open(tmp_path / "out"), 0, "displacement").axes[1].images[-1]
    x, y = _places(picture)
    shown = picture.get_array()
    assert not np.ma.getmaskarray(np.ma.masked_invalid(shown)).any()
    column = np.argmin(np.abs(x - 20))
    # two elements from the step to 0 the field swings by 1 %
    assert shown[y < 40][:, column].max() == pytest.approx(-1, abs=0.02)
    assert shown[y > 40][:, column].min() == pytest.approx(1, abs=0.02)


def test_a_reference_that_shows_a_part_of_the_frame_lies_where_it_belongs(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(8, 120), np.arange(4, 80))
    cover = np.zeros((3, 38, 56))
    cover[:, 10:12, 20:22] = 255
    result = _one_frame(
        tmp_path / "out",
        np.stack([x + 1000.0 * y] * 3),
        {"reference_origin": [8, 4], "frame_shape": [80, 120]},
        u=X / 10,
        v=Y / 20,
        reflection_thumbnail=cover,
    )
    whole = reference_picture(result)
    assert whole.shape == (80, 120)
    np.testing.assert_array_equal(whole[4:, 8:], result.reference[0])
    assert (whole[:4] == whole[0, 0]).all()
    image, shade = figures.MapDrawer(Maps.from_result(result)).reflections(0).axes[0].images
    assert image.get_extent() == [7.5, 119.5, 79.5, 3.5]
    places, rows = _places(shade)
    seen = shade.get_array()[..., 3] > 0
    assert places[seen.any(axis=0)].tolist() == [48.5, 50.5]
    assert rows[seen.any(axis=1)].tolist() == [24.5, 26.5]


def test_axes_that_are_drawn_once_look_as_if_drawn_for_each_map(tmp_path: Path) -> None:
    result = make_result(tmp_path / "out", frames=3, reference=np.stack([IMAGE] * 3))
    maps = figures.MapDrawer(Maps.from_result(result), 60)
    before = _pixels(maps.fields(1, figures.MAPS["displacement"]))
    frozen = _pixels(maps.fields(2, figures.MAPS["displacement"]))
    anew = _pixels(_maps(result, 2, "displacement"))
    changed = (np.abs(before - anew) > 30).mean()
    assert (np.abs(frozen - anew) > 30).mean() < 0.01 < 0.1 < changed
    assert maps.fields(2, figures.MAPS["uncertainty"]) is maps.fields(1, figures.MAPS["displacement"])


def _pixels(figure: Any) -> AnyArray:
    file = io.BytesIO()
    figure.savefig(file, dpi=60)
    return cv2.imdecode(np.frombuffer(file.getvalue(), np.uint8), cv2.IMREAD_COLOR).astype(float)


@pytest.mark.parametrize("kind", figures.MAPS)
def test_every_map_shows_its_quantities_around_the_mesh(tmp_path: Path, kind: str) -> None:
    ramp = np.linspace(1, 2, NODES)
    given = {"u": 0.01 * X**2 / 60, "v": 0.02 * Y, "u_std": ramp, "v_std": 2 * ramp, "misfit": ramp}
    result = _one_frame(tmp_path / "out", np.ones((3, 500, 700)), **given)
    figure, maps = _maps(result, 0, kind), Maps.from_result(result)
    for axis, name in zip(figure.axes, figures.MAPS[kind], strict=False):
        assert axis.get_title() == maps.field(name).label
        picture, values = axis.images[-1].get_array(), maps.read(name, 0).values
        beyond = 0.1 * np.ptp(values[np.isfinite(values)]) + 1e-9  # the field may be curved between the nodes
        assert np.nanmin(values) - beyond <= np.nanmin(picture) <= np.nanmax(picture) <= np.nanmax(values) + beyond
        (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
        assert left < 10 < 110 < right < 150
        assert top < 5 < 75 < bottom < 100


def test_a_derived_field_has_its_uncertainty_beside_it_and_hatches_where_it_may_be_zero(
    tmp_path: Path,
) -> None:
    still = {"u": 0.01 * (X - 60), "v": 0 * X, "u_std": np.full(NODES, 0.01), "v_std": np.full(NODES, 0.01)}
    result = _one_frame(tmp_path / "out", np.stack([IMAGE] * 3), **still)
    maps = Maps.from_result(result, gauge=70.0, measure="engineering")
    drawer = figures.MapDrawer(maps)
    figure, read = drawer.fields(0, ["exx"], std=True, hatched=True), maps.read("exx", 0)
    assert [axis.get_title() for axis in figure.axes] == ["εxx", "σ(εxx)"]
    assert "Engineering, virtual strain gauge of 70 px" in figure.texts[0].get_text()
    for axis, values in zip(figure.axes, (read.values, read.std), strict=True):
        picture = axis.images[-1].get_array()
        assert np.nanmin(picture) >= values.min() - 1e-9
        assert np.nanmax(picture) == pytest.approx(values.max(), rel=0.02)
    assert not figure.axes[0].collections[0].get_paths()[0].vertices.size, "a stretch of 10 standard uncertainties"
    figure = drawer.fields(0, ["eyy"], std=True, hatched=True)
    assert figure.axes[0].collections[0].get_paths()[0].vertices.size
    files = write_maps(maps, ["eyy", "node_status"], tmp_path / "figures", [0])
    assert [file.name for file in files] == ["map_eyy_000000.png", "map_node_status_000000.png"]
    remove_pictures(tmp_path)
    assert not [*(tmp_path / "figures").iterdir()]


def test_blank_where_not_measured(tmp_path: Path) -> None:
    result = _one_frame(tmp_path / "out", u=np.where(X > 60, np.nan, X), v=X)
    picture = _maps(result, 0, "displacement").axes[0].images[-1]
    hidden, (x, _) = np.ma.getmaskarray(picture.get_array()), _places(picture)
    # an element is blank as soon as one of its nodes is: from the last measured column of nodes on
    assert hidden[:, x > 60.01].all()
    assert not hidden[:, x < 60 - 20].any()


def test_one_wild_node_does_not_flatten_the_colours() -> None:
    values = np.linspace(0, 1, 500)
    assert style.colour_range(values) == (0, 1)
    assert style.colour_range(np.append(values, 1000)) == pytest.approx((0, 1.1), abs=0.01)


def test_outliers_at_the_edge_do_not_turn_the_bulk_of_an_uncertainty_black(tmp_path: Path) -> None:
    """A third of the nodes 30 times as uncertain: the others still spread over a good part of the colours."""
    edge = np.isin(X, [X.min(), X.max()])
    std = np.where(edge, 0.1, 0.003) * np.exp(np.random.default_rng(0).normal(0, 0.2, NODES))
    figure = _maps(_one_frame(tmp_path / "out", u_std=std, v_std=std), 0, "uncertainty")
    colours = np.asarray(figure.axes[0].images[-1].norm(std))
    assert np.ptp(np.percentile(colours[~edge], [5, 95])) > 0.15
    assert (colours[edge] >= 1).all()


def test_doubtful_nodes_do_not_rule_the_colours(tmp_path: Path) -> None:
    """A step of .002 px in the middle shows beside border nodes that scatter by .05 px, and say so."""
    edge = X < 30
    u = np.where(edge, 0.05 * np.random.default_rng(0).normal(size=NODES), 0.002 * (X > 60))
    result = _one_frame(tmp_path / "out", u=u, v=u, u_std=np.where(edge, 0.05, 1e-4), v_std=np.full(NODES, 1.0))
    norm = _maps(result, 0, "displacement").axes[0].images[-1].norm
    assert (norm.vmin, norm.vmax) == (0, 0.002)


@pytest.fixture
def unsaved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures without content: writing them takes most of the time."""
    monkeypatch.setattr(style, "save_figure", lambda _, path: path.touch())


def test_all_figures_can_be_written_by_two_processes(tmp_path: Path) -> None:
    result = make_result(tmp_path / "out", frames=12, reference=np.stack([IMAGE] * 3))
    told_once = {"convergence", "residual", "brightness"}
    with_pictures = {*EVERY_FRAME, "masks", "reflections"}
    files = write_figures(Maps.from_result(result), tmp_path / "figures", [4], processes=2, min_pictures=5)
    assert {file.stem for file in files} == told_once | {f"{name}_000004" for name in with_pictures}
    assert all(file.stat().st_size > 5000 for file in files)


@pytest.mark.usefixtures("unsaved")
def test_each_frame_has_the_pictures_it_can_have(tmp_path: Path) -> None:
    result = make_result(tmp_path / "out", frames=12, reference=np.stack([IMAGE] * 3))
    files = write_figures(Maps.from_result(result), tmp_path / "figures", [3, 4])
    assert {file.stem.split("_")[0] for file in files if "000004" in file.stem} == {
        *EVERY_FRAME,
        "masks",
        "reflections",
    }
    assert {file.stem.split("_")[0] for file in files if "000003" in file.stem} == EVERY_FRAME


def test_a_profile_shows_the_first_the_last_and_busy_frames_between() -> None:
    values = np.full((20, 5), np.nan)
    assert curves._select_rows(values) == [0, 19]
    assert curves._select_rows(values[:6]) == [0, 1, 2, 3, 4, 5]
    values[8:12] = 1.0
    assert curves._select_rows(values) == [0, 8, 9, 10, 11, 19]
    values[:] = 1.0
    assert curves._select_rows(values)[::5] == [0, 19]
    assert curves._select_rows(values[:1]) == [0]


def test_three_deformed_frames_get_pictures_and_the_reference_none() -> None:
    assert figures.select_evenly(tuple(range(1, 12)), 3) == (1, 6, 11)
    assert figures.select_evenly((5,), 3) == (5,)


def test_the_reference_is_left_out_of_what_happens_over_the_frames(tmp_path: Path) -> None:
    settings = TestSettings(
        frames=FrameSettings(path=("*",), reference=(1, 3)), region=RegionSettings(rectangle=(0, 0, 9, 9))
    )
    result = make_result(tmp_path / "out", frames=6, settings=settings, references=(1, 3))
    for figure in (figures.residual_figure(result), figures.brightness_figure(result)):
        for line in (line for axis in figure.axes for line in axis.lines):
            assert line.get_xdata().tolist() == [0, 2, 4, 5]
    lines = figures.convergence_figure(result).axes[0].lines
    assert [line.get_label() for line in lines] == [*(f"frame {i}" for i in (0, 2, 4, 5)), "tolerance"]


@pytest.mark.usefixtures("unsaved")
def test_pictures_are_of_frames_that_were_measured(tmp_path: Path) -> None:
    """The last frames failed: the last picture is of the last one before them."""
    records = [FrameRecord.from_values(nodes=NODES, lights=len(LIGHTS), status=0, u=X, v=Y) for _ in range(8)]
    records += [FrameRecord.failed("the fragment has left", nodes=NODES, lights=len(LIGHTS)) for _ in range(2)]
    result = make_result(tmp_path / "out", frames=10, record=records.__getitem__)
    drawn = {
        int(file.stem[-6:])
        for file in write_figures(Maps.from_result(result), tmp_path / "figures")
        if file.stem[-1].isdigit()
    }
    assert drawn == {1, 4, 7}
    none = make_result(tmp_path / "none", frames=4, record=lambda index: records[-1])
    assert figures.measured_frames(none) == figures.frames_to_draw(none)


def test_displacements_are_in_mm_where_the_scale_is_known(tmp_path: Path) -> None:
    scale = {"mm_per_pixel": 0.05, "mm_per_pixel_std": 0.001}
    settings = TestSettings.from_mapping({**SETTINGS, "scale": scale})
    record = FrameRecord.from_values(
        nodes=NODES, lights=len(LIGHTS), u=X, v=Y, u_std=X / 100, v_std=Y / 100, nodal_exx=X
    )
    result = make_result(tmp_path / "out", frames=1, record=lambda index: record, settings=settings)
    u, v, *_ = _maps(result, 0, "displacement").axes
    assert (u.get_title(), v.get_title()) == ("u (mm)", "v (mm)")
    assert np.ptp(u.images[-1].get_array()) == pytest.approx(0.05 * np.ptp(X), rel=0.01)
    std = _maps(result, 0, "uncertainty").axes[0].images[-1].get_array()
    assert std.max() == pytest.approx(np.hypot(0.05 * 0.01, 0.001) * X.max(), rel=0.01)
    assert _maps(result, 0, "strain").axes[0].get_title() == "εxx"
    assert (u.get_xlabel(), u.get_ylabel()) == ("x (mm)", "y (mm)")
    numbers = [float(label.get_text()) for label in u.get_xticklabels()]
    assert all(0 < number < 0.05 * 120 for number in numbers[1:-1])


def test_a_status_has_its_names_and_one_colour_a_code(tmp_path: Path) -> None:
    status = np.where(X > 60, 1, 0)
    result = _one_frame(tmp_path / "out", u=X, v=Y, node_status=status)
    axis = figures.MapDrawer(Maps.from_result(result)).fields(0, ["node_status"]).axes[0]
    picture = axis.images[-1]
    colours = {tuple(row) for row in picture.cmap(picture.norm(np.arange(4)))}
    assert colours == {to_rgba(colour) for colour in style.STATUS_COLOURS}
    assert [text.get_text() for text in axis.texts] == [*QUANTITIES["node_status"].codes]


def test_run_xarray_and_maps_have_one_strain_and_say_which(tmp_path: Path) -> None:
    """The picture of `run`, the Dataset and the maps: the same numbers, and the title has measure and gauge."""
    stretch = {"u": 0.1 * (X - 60), "v": 0 * Y, "u_std": np.full(NODES, 0.01), "v_std": np.full(NODES, 0.01)}
    result = _one_frame(tmp_path / "out", **stretch)
    figure, maps = _maps(result, 0, "strain"), Maps.from_result(result)
    expected = 0.1 + 0.1**2 / 2
    assert np.nanmean(figure.axes[0].images[-1].get_array()) == pytest.approx(expected, rel=1e-3)
    assert maps.processing_note("exx") in figure.texts[0].get_text()
    assert "Green-Lagrange" in maps.processing_note("exx")
    assert "Hencky" in maps.processing_note("equivalent")
    data = result.to_xarray()
    np.testing.assert_array_equal(data.strain[0].sel(component="exx"), maps.read("exx", 0).values.astype(np.float32))
    assert maps.processing_note("exx") in data.strain.attrs["description"]


NASTY = ("a$x^2$_1", "_hidden", "r$ed", "x\\alpha_{2}", "кадр", "写真", "no\udcffutf8", "two\nlines", "n" * 200)


@pytest.mark.filterwarnings("error")  # of letters without a picture
def test_names_are_drawn_as_they_are(tmp_path: Path) -> None:
    origin = Origin(nodes=MESH.nodes, elements=MESH.elements, names=NASTY[:8], lights=NASTY[:3])
    still = {"u": 0 * X, "v": 0 * X, "light_fraction": np.full((NODES, 3), 0.3), "history": [1.0, 0.1]}
    store = ResultStore.create(tmp_path / "out", origin)
    for index in range(8):
        store.write_frame(index, FrameRecord.from_values(nodes=NODES, lights=3, status=0, residual=np.ones(3), **still))
    store.finish()
    result = Result.open(tmp_path / "out")
    for figure, names in (
        (figures.convergence_figure(result), NASTY[1:5]),
        (figures.residual_figure(result), NASTY[:3]),
        (figures.MapDrawer(Maps.from_result(result)).fractions(0), NASTY[:3]),
    ):
        figure.savefig(io.BytesIO(), format="png", dpi=30)
        texts = [text for text in figure.findobj(match=Text) if "mathdefault" not in text.get_text()]
        drawn = [text._preprocess_math(text.get_text()) for text in texts]
        assert not any(formula for _, formula in drawn)
        assert all(any(name in text for text, _ in drawn) for name in names)


def test_letters_without_a_picture_and_long_names_are_told_otherwise() -> None:
    assert style.literal("写真") == "\\u5199\\u771f"
    assert style.literal("no\udcffutf8") == "no\\udcffutf8"
    assert style.literal("two\nlines") == "two\\nlines"
    assert len(style.literal("n" * 200)) == 60


@pytest.mark.parametrize(
    ("reach", "unit"), [(3e-7, "ns"), (4e-5, "µs"), (0.02, "ms"), (1.0, "s"), (700.0, "s"), (0, "s")]
)
def test_times_are_told_in_the_unit_that_suits_them(reach: float, unit: str) -> None:
    times = np.array([-reach / 2, np.nan, reach])
    factor, name = style.time_unit(times)
    assert name == unit
    assert np.nanmax(factor * times) == pytest.approx(reach * {"s": 1, "ms": 1e3, "µs": 1e6, "ns": 1e9}[unit])


@pytest.mark.parametrize("numbers", [range(4), range(10**8, 10**8 + 300), range(0, 10**7, 10**5)], ids=str)
def test_numbers_along_an_axis_do_not_touch(tmp_path: Path, numbers: range) -> None:
    def record(index: int) -> FrameRecord:
        known = {"node_status": np.zeros(NODES), "light_fraction": np.full((NODES, 3), 1 / 3)}
        return FrameRecord.from_values(nodes=NODES, lights=3, residual=np.ones(3), number=numbers[index], **known)

    result = make_result(tmp_path / "out", frames=len(numbers), record=record)
    assert all(number.is_integer() for number in _numbers(figures.residual_figure(result)))


def test_numbers_under_a_narrow_map_do_not_touch(tmp_path: Path) -> None:
    tall = Tri3Mesh.from_region(Region.from_rectangle((4010, 5, 4110, 1175), (1200, 4200)), 20)
    origin = make_origin(1, nodes=tall.nodes, elements=tall.elements)
    with ResultStore.create(tmp_path / "out", origin) as store:
        store.write_frame(
            0, FrameRecord.from_values(nodes=len(tall.nodes), lights=len(LIGHTS), nodal_exx=tall.nodes[:, 0])
        )
    _numbers(_maps(Result.open(tmp_path / "out"), 0, "strain"))


def _numbers(figure: Any) -> list[float]:
    """The numbers along x of all panels, which must be two or more with room between them."""
    figure.canvas.draw()
    found = []
    for axis in (axis for axis in figure.axes if axis.get_xlabel()):
        (left, right), labels = axis.get_xlim(), axis.get_xticklabels()
        shown = [label for label in labels if left <= label.get_position()[0] <= right and label.get_text()]
        boxes = [label.get_window_extent() for label in shown]
        assert len(boxes) >= 2
        assert all(box.x1 + 3 < other.x0 for box, other in pairwise(boxes))
        found += [float(label.get_text()) for label in shown]
    return found


@pytest.mark.usefixtures("unsaved")
def test_pictures_of_an_earlier_run_are_removed_and_no_others(tmp_path: Path) -> None:
    result = make_result(tmp_path / "out", frames=3, reference=np.stack([IMAGE] * 3))
    files = write_figures(Maps.from_result(result), tmp_path / "figures", [2])
    mine = tmp_path / "figures" / "my_displacement.png"
    mine.write_bytes(b"kept")
    remove_pictures(tmp_path)
    assert not any(file.exists() for file in files)
    assert mine.read_bytes() == b"kept"
    remove_pictures(tmp_path / "nowhere")


def test_frame_where_nothing_is_measured_still_has_figures(tmp_path: Path) -> None:
    for file in write_figures(Maps.from_result(_one_frame(tmp_path / "out", reason="damaged")), tmp_path / "figures"):
        assert file.stat().st_size > 2000


def test_mask_shades_what_is_excluded(tmp_path: Path) -> None:
    weights = np.full((3, 40, 60), 255)
    weights[0, :20] = 0
    still = {"u": 0 * X, "v": 0 * X, "reflection_thumbnail": 255 - weights}
    result = _one_frame(tmp_path / "out", np.stack([IMAGE] * 3), weights_thumbnail=weights, **still)
    for figure in (
        figures.MapDrawer(Maps.from_result(result)).masks(0),
        figures.MapDrawer(Maps.from_result(result)).reflections(0),
    ):
        assert figure is not None
        shade = figure.axes[0].images[-1]
        alpha = shade.get_array()[..., 3]
        assert alpha[:20].min() > 0.5
        assert alpha[20:].max() == 0
        assert shade.get_extent() == [-0.5, 119.5, 79.5, -0.5]
    figure = figures.MapDrawer(Maps.from_result(result)).masks(0)
    assert figure is not None
    top, bottom = sorted(figure.axes[0].get_ylim())
    share = (40 - top) / (bottom - top)
    told = float(figure.axes[0].get_title().removeprefix("red: ").removesuffix("% excluded"))
    assert told == pytest.approx(100 * share, abs=2)
    assert figure.axes[1].get_title() == "green: 0.0% excluded"


def test_pictures_of_a_frame_have_one_unit_and_the_options_of_the_maps(tmp_path: Path) -> None:
    notes = {"settings": {"scale": {"mm_per_pixel": 0.5}}}
    dark = {"weights_thumbnail": np.zeros((3, 40, 60)), "reflection_thumbnail": np.full((3, 40, 60), 255)}
    result = _one_frame(tmp_path / "out", np.stack([IMAGE] * 3), notes, u=X / 100, v=Y / 200, **dark)
    for unit, maps in (
        ("mm", Maps.from_result(result)),
        ("px", Maps.from_result(result, ScaleSettings(unit="px"), gauge=70)),
    ):
        drawer = figures.MapDrawer(maps)
        drawn = drawer.fields(0, ["u"]), drawer.masks(0), drawer.reflections(0)
        assert {figure.axes[0].get_xlabel() for figure in drawn} == {f"x ({unit})"}
    assert "gauge of 70 px" in drawer.fields(0, figures.MAPS["strain"]).texts[0].get_text()
    assert any(file.name == "masks_000000.png" for file in write_figures(maps, tmp_path / "figures"))


def test_weights_that_exclude_nothing_have_no_picture(tmp_path: Path) -> None:
    weights = np.full((3, 40, 60), 255)
    result = _one_frame(tmp_path / "out", np.stack([IMAGE] * 3), weights_thumbnail=weights)
    assert figures.MapDrawer(Maps.from_result(result)).masks(0) is None
    assert figures.MapDrawer(Maps.from_result(result)).reflections(0) is None


def test_impossible_frame_and_file(tmp_path: Path) -> None:
    result = make_result(tmp_path / "out")
    with pytest.raises(InputError, match="no frame 2"):
        _maps(result, 2, "displacement")
    with pytest.raises(InputError, match="no frame 7"):
        write_figures(Maps.from_result(result), tmp_path / "figures", [0, 7])
    assert not list((tmp_path / "figures").iterdir())
    with pytest.raises(ResultError, match="cannot be written"):
        save_figure(figures.residual_figure(result), tmp_path / "none" / "a.png")


def test_a_picture_appears_when_all_of_it_is_written_and_only_in_a_format_that_there_is(tmp_path: Path) -> None:
    path, figure = tmp_path / "a.png", Figure()
    save_figure(figure, path)
    before = path.read_bytes()
    assert before[:4] == b"\x89PNG"

    def draw(renderer: object) -> None:
        assert [file.name for file in tmp_path.glob("a.png.*.part")]
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    figure.draw = draw  # type: ignore[method-assign]
    with pytest.raises(ResultError, match=r"a\.png cannot be written: No space"):
        save_figure(figure, path)
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [before]
    with pytest.raises(InputError, match=r"a\.xyz cannot be written: a figure is one of .*\.png, "):
        save_figure(figure, tmp_path / "a.xyz")
