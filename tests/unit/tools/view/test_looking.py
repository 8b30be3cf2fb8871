"""What the viewer is made of: addresses, fields, colours, windows, marks and the time line."""

from __future__ import annotations

import base64
import itertools
import random
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import parse_qs

import cv2
import numpy as np
import pytest
from bokeh.document import Document
from bokeh.events import MouseMove
from bokeh.plotting import figure
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from results import LIGHTS, MESH, NODES, corrupt, make_origin, make_result, random_record, smooth_record

from rgbmidic import CameraCalibration
from rgbmidic.errors import FrameError
from rgbmidic.fields import MEASURES, Field
from rgbmidic.results import QUANTITIES, FrameRecord, Maps, Result, ResultStore
from rgbmidic.results.histories import read_histories, write_histories
from rgbmidic.settings import PROBE_NAME, ChannelSettings, ProbeSettings, TestSettings
from rgbmidic.text import format_value, format_with_std
from rgbmidic.tools.report.painter import ImageWindow, Overlay, paint, palette
from rgbmidic.tools.report.style import time_axis
from rgbmidic.tools.view import curves
from rgbmidic.tools.view.controls import CLOCKS, PALETTES, ResultControls
from rgbmidic.tools.view.curves import CurvePanel
from rgbmidic.tools.view.fields import FieldsInView, element_at, palette_name, range_over_test, robust_range
from rgbmidic.tools.view.layers import LabelLayer, arrow_lines, contour_lines, place_texts
from rgbmidic.tools.view.marks import MARKS, Mark, UndoHistory, marks_of_probes, probe_marks, settings_of_marks
from rgbmidic.tools.view.page import ResultPage
from rgbmidic.tools.view.time_line import FrameProgress, TimeLine
from rgbmidic.tools.view.url_state import UNCERTAINTY, ViewState
from rgbmidic.tools.view.widgets import is_watched

NAMES = ("u", "v", "e1")


def replace_name(mark, name):
    return replace(mark, name=name if len(name) % 2 else "")


def read(result, *marks):
    return read_histories(result, settings_of_marks(marks, 60.0, ProbeSettings()))


numbers = st.floats(-1e6, 1e6).map(lambda x: float(f"{x:.6g}"))
marks = st.lists(st.builds(Mark, st.sampled_from(MARKS), numbers, numbers), max_size=4).map(tuple)
names = st.sets(st.from_regex(PROBE_NAME, fullmatch=True), min_size=4, max_size=4)
named = st.builds(lambda marks, names: tuple(map(replace_name, marks, names)), marks, names)
looks = st.builds(
    ViewState,
    frame=st.integers(0, 9),
    field=st.sampled_from(NAMES),
    over=st.sampled_from(["reference", "deformed"]),
    symmetric=st.booleans(),
    directions=st.booleans(),
    second=st.sampled_from(["", UNCERTAINTY, *NAMES]),
    palette=st.sampled_from(["", *PALETTES]),
    levels=st.integers(2, 256),
    hatched=st.booleans(),
    longer=numbers.map(abs),
    gauge=numbers.map(abs),
    measure=st.sampled_from(MEASURES),
    since=st.integers(-1, 9),
    rate_window=st.integers(0, 99),
    curve=st.text("abc ()/²", max_size=9),
    theme=st.sampled_from(["", "light", "dark"]),
    channels=st.text("abc /.ä", max_size=9),
    clock=st.sampled_from(list(CLOCKS)),
    offset=st.floats(-1e9, 1e9),
    marks=named,
)


def opened(query: str) -> ViewState:
    arguments = {key: [value.encode() for value in values] for key, values in parse_qs(query).items()}
    return ViewState.from_query(arguments, frames=10, names=NAMES, frame=9)


@given(looks)
def test_an_address_opens_what_it_was_made_of(view):
    assert opened(f"frame={view.frame}&{view.query()}") == view


@given(
    st.dictionaries(
        st.sampled_from([*ViewState.__dataclass_fields__, "x"]), st.lists(st.binary(max_size=30), max_size=2)
    )
)
@settings(max_examples=200)
def test_an_address_of_nonsense_opens_something_that_can_be_shown(query):
    view = ViewState.from_query(query, frames=10, names=NAMES, frame=9)
    assert 0 <= view.frame < 10
    assert view.field in NAMES
    assert view.low < view.high
    assert 0 <= view.opacity <= 1
    assert -1 <= view.since < 10
    assert view.levels >= 2
    assert view.rate_window >= 0
    assert all(np.isfinite([mark.x, mark.y]).all() and mark.kind in MARKS for mark in view.marks)


@given(st.lists(marks, max_size=6))
@settings(max_examples=30)
def test_every_step_is_undone_and_done_again(states):
    steps = UndoHistory(())
    for state in states:
        steps.record(state)
    back = [steps.marks]
    while (state := steps.step(back=True)) != back[-1] or len(back) <= len(states):
        back.append(state)
        if len(back) > len(states) + 1:
            break
    assert steps.marks == ()
    for _ in back:
        steps.step(back=False)
    assert steps.marks == (states[-1] if states else ())


def test_the_moves_of_a_drag_are_one_step_and_those_of_another_mark_another():
    one, two = Mark("point", 1, 1), Mark("point", 9, 9)
    steps = UndoHistory((one, two))
    for x in (2, 3, 4):
        steps.record((replace(one, x=x), two))
    steps.record((replace(one, x=4), replace(two, y=5)))
    assert steps.step(back=True) == (replace(one, x=4), two)
    assert steps.step(back=True) == (one, two)
    steps.record((one,))
    assert steps.step(back=False) == (one,)


@given(named, st.floats(1, 99))
@settings(max_examples=20)
def test_marks_of_the_probes_that_marks_make_make_the_same(set_, gauge):
    boxes = [mark for mark in set_ if mark.kind == "region"]
    assume(all(one.x != other.x and one.y != other.y for one, other in itertools.pairwise(boxes)))  # else it is refused
    made = settings_of_marks([mark for mark in set_ if mark.kind != "circle"], gauge, ProbeSettings())
    assert settings_of_marks(marks_of_probes(made), gauge, ProbeSettings()) == made


@pytest.mark.parametrize(
    "stated",
    [
        {"offset": -1.23456789012e-3, "area": 20.0},
        {"trigger": "ttl_V", "force": "a_N"},
        {"align": ("a", "gauge_1_strain")},
        {},
    ],
)
def test_channels_that_are_stated_are_those_of_the_address(stated):
    channels = ChannelSettings(file=Path("/x/daq.csv"), **stated)
    view = ViewState().with_channels(channels)
    assert opened(view.query()).channel_settings(Path("/y")) == channels
    assert ViewState(channels="b.csv").with_channels(channels).channels == "b.csv"
    assert ViewState(channels="b.csv", area=-1.0).channel_settings(Path("/y")).area is None


def test_a_thinned_curve_keeps_its_peaks():
    x, y = np.arange(100_000.0), np.zeros(100_000)
    y[[777, 50_001]] = 5, -3
    thin = curves._decimate(x, y)
    assert len(thin[0]) <= 3000
    assert (x[y.argmax()], x[y.argmin()]) == (thin[0][thin[1].argmax()], thin[0][thin[1].argmin()])


def test_channels_off_the_frames_are_shown_where_they_are_and_told(tmp_path):
    result = make_result(tmp_path / "result", frames=4, record=lambda index: timed(index, 20_000))
    (tmp_path / "daq.csv").write_text("time_s,a_N\n" + "".join(f"{5 + n},{n}\n" for n in range(9)), encoding="utf-8")
    page = ResultPage(Document(), result, ViewState(channels="daq.csv", beside="a_N"), FrameProgress(4))
    page.update_view()
    assert "span 5 to 13 s" in page.controls["channel_status"].text
    assert list(page.curves._recorded.data["ys"][0]) == list(range(9))
    page.controls["offset"].value = -5.0
    assert "has no value in" not in page.controls["channel_status"].text
    page.controls["area"].value = 2.0
    np.testing.assert_allclose(page.curves.histories["stress"].values, 0.5 * 2e-5 * np.arange(4), atol=1e-15)
    page._save()
    assert page.state.csv.splitlines()[0] == "frame,number,status,time_s,a_N,stress_MPa"


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    return make_result(tmp_path_factory.mktemp("view") / "result", frames=6, settings=in_mm())


def in_mm():
    scale = {"mm_per_pixel": 0.5, "mm_per_pixel_std": 0.01}
    return TestSettings.from_mapping(
        {"frames": {"path": "x.cine", "kind": "monochrome"}, "region": {"rectangle": [0, 0, 9, 9]}, "scale": scale}
    )


def test_fields_are_those_of_the_table_in_the_units_of_the_reader(result):
    fields = Maps.from_result(result)
    assert list(fields.quantities)[:3] == ["u", "v", "magnitude"]
    assert {"e1", "equivalent", "node_status", "u_std", *(f"fraction of {light}" for light in LIGHTS)} <= set(
        fields.quantities
    )
    assert fields.quantities["u"].label == "u (mm)"
    read, record = fields.read("u", 3), result.frame(3)
    np.testing.assert_allclose(read.values, 0.5 * record.u)
    np.testing.assert_allclose(read.std, np.hypot(0.5 * record.u_std, 0.01 * record.u))
    np.testing.assert_allclose(fields.deformed_nodes(3), result.nodes + np.stack([record.u, record.v], axis=1))
    np.testing.assert_allclose(fields.read("magnitude", 3).values, 0.5 * np.hypot(record.u, record.v))
    bias = np.where(np.isfinite(record.u_std), 0.5 * np.nan_to_num(record.u_bias_std), np.nan)
    for found in (fields.read("u_bias_std", 3).values, fields.physical.frame(3)["u_bias_std"]):
        np.testing.assert_allclose(found, bias)
    for found in (fields.read("u_edge_std", 3).values, fields.physical.frame(3)["u_edge_std"]):
        np.testing.assert_allclose(found, 0.5 * record.u_edge_std)
    np.testing.assert_array_equal(fields.read("node_status", 3).values, record.node_status)
    np.testing.assert_allclose(fields.read("e1", 3).values, fields.physical.frame(3)["e1"])
    fraction = fields.read("fraction of green", 3).values
    assert np.isnan(fraction[record.node_status != 0]).all()
    for name in (name for name in fields.quantities if not any(word in name for word in TIMED)):
        assert fields.read(name, 3).values.shape == (NODES,)


def test_a_contour_lies_where_the_field_has_its_level_and_nowhere_beside_nodes_without_data():
    nodes, elements = MESH.nodes, MESH.elements
    values = nodes[:, 0] + 2 * nodes[:, 1]
    values[7] = np.nan
    lines = contour_lines(nodes, elements, values, [100.0, 130.0])
    ends = lines.reshape(-1, 2)
    np.testing.assert_allclose(np.unique(np.round(ends @ [1, 2], 9)), [100, 130])
    beside = elements[(elements == 7).any(axis=1)].ravel()
    low, high = nodes[beside].min(axis=0), nodes[beside].max(axis=0)
    assert not ((ends > low + 1) & (ends < high - 1)).all(axis=1).any()
    assert not len(contour_lines(nodes, elements, values, []))


def test_arrows_point_along_the_displacement_and_the_longest_reaches_to_the_next():
    window = ImageWindow(x_min=0, y_min=0, x_max=240, y_max=120, width=800, height=400)
    moved = np.tile([0.3, -0.4], (NODES, 1))
    lines, longer = arrow_lines(window, MESH.nodes, moved, 0.0)
    shaft = (lines[:, 2:] - lines[:, :2])[: len(lines) // 3]
    np.testing.assert_allclose(shaft, np.tile([0.6, -0.8], (len(shaft), 1)) * 0.9 * 10)
    assert longer == pytest.approx(18)
    assert arrow_lines(window, MESH.nodes, moved, 5.0)[1] == 5
    point = lines[len(lines) // 3 :]
    assert (np.einsum("md,d->m", point[:, 2:] - point[:, :2], [0.6, -0.8]) < 0).all(), "back from the end"


def test_what_is_hatched_lies_below_zero():
    window = ImageWindow(x_min=10, y_min=5, x_max=110, y_max=75, width=400, height=280)
    over = {"nodes": MESH.nodes, "elements": MESH.elements, "values": np.ones(NODES), "colour_range": (0.0, 2.0)}
    over |= {"colours": palette("viridis")}
    grey = np.full((80, 120), 90, dtype=np.uint8)
    plain, hatched = (
        paint(window, grey, Overlay(**over, hatch_margin=beyond)) for beyond in (None, MESH.nodes[:, 0] - 60)
    )
    changed = plain != hatched
    assert not changed[:, 202:].any()
    assert changed[:, 2:198].mean() == pytest.approx(0.25, abs=0.02)
    assert (hatched[changed] == 0xFF000000).all()


def label(shown, name, kind, *place):
    shown.view = replace(shown.view, field=name)
    return shown.probe_text(kind, place)


def shown_fields(result, **view):
    """The fields of a view, as a page that was opened just now has them."""
    shown = FieldsInView(result, ViewState(**view))
    shown.derive_fields()
    return shown


def test_the_frames_beside_the_one_in_view_are_read_ahead_and_each_once(tmp_path, monkeypatch):
    result, seen = make_result(tmp_path / "result", frames=6, record=smooth_record), []
    shown = shown_fields(result, frame=3, field="exx", over="deformed")

    def read(kind, frame):
        if kind == "raw" and frame == 2:
            raise FrameError("it is gone")
        seen.append((kind, frame))

    monkeypatch.setattr(shown, "_read_field", lambda name, frame: read(name, frame))
    monkeypatch.setattr(shown, "_raw", lambda frame: read("raw", frame))
    for _ in range(4):
        shown.read_ahead()
    assert seen == [("exx", 4), ("raw", 4), ("exx", 2)]
    seen.clear()
    shown.view = replace(shown.view, frame=4)
    for _ in range(4):
        shown.read_ahead()
    assert seen == [("exx", 5), ("raw", 5), ("exx", 3), ("raw", 3)]
    seen.clear()
    shown.view = replace(shown.view, frame=5, over="reference")
    for _ in range(4):
        shown.read_ahead()
    assert seen == [("exx", 4)]


def spread_of(text):
    return float(text.split("±")[1].split()[0])


PLACES = {"point": (52.0, 41.0), "region": (30.0, 20.0, 60.0, 60.0), "line": (20.0, 20.0, 90.0, 55.0)}
PLACES |= {"circle": (60.0, 40.0, 17.0), "strain_gauge": (52.0, 41.0, 60.0), "gauge": (25.0, 30.0, 85.0, 50.0)}


@pytest.mark.parametrize("measure", MEASURES[:2])
def test_the_label_of_a_probe_is_its_history_in_that_frame_and_the_pointer_states_the_same(tmp_path, measure):
    result = make_result(tmp_path / "result", frames=6, record=smooth_record, settings=in_mm())
    shown = shown_fields(result, frame=5, gauge=60.0, measure=measure)
    maps = shown.maps
    histories = read_histories(
        result, ProbeSettings(**{f"{kind}s": (place,) for kind, place in PLACES.items()}, measure=measure)
    )

    def history(kind, name):
        read = histories[f"{kind}_1_{name}"]
        return float(read.values[5]), float(read.std[5])

    for kind in ("point", "line", "region", "circle"):
        mean = "" if kind == "point" else " mean"
        for name in "uv":
            value, std = history(kind, name)
            assert label(shown, name, kind, *PLACES[kind]) == f"{mean}: {maps.quantities[name].format(value, std)}"
            assert (
                label(shown, f"{name}_std", kind, *PLACES[kind])
                == f"{mean}: {maps.quantities[f'{name}_std'].format(std)}"
            )
    for name, of_gauge, unit in (("u", "extension", " mm"), ("exx", "strain", "")):
        value, std = history("gauge", of_gauge)
        assert label(shown, name, "gauge", *PLACES["gauge"]) == f" {of_gauge}: {format_with_std(value, std)}{unit}"
        assert label(shown, f"{name}_std", "gauge", *PLACES["gauge"]) == f" {of_gauge}: {format_value(std, std)}{unit}"
    assert label(shown, "misfit", "gauge", *PLACES["gauge"]) == ""
    for name in ("exx", "eyy", "exy", "e1", "e2", "equivalent"):
        for kind in ("region", "circle"):
            assert (
                label(shown, name, kind, *PLACES[kind])
                == f" mean: {maps.quantities[name].format(*history(kind, name))}"
            )
    for name in ("exx", "eyy", "exy", "e1", "e2", "direction", "equivalent"):
        value, std = history("strain_gauge", name)
        assert (
            label(shown, name, "strain_gauge", *PLACES["strain_gauge"])
            == f": {maps.quantities[name].format(value, std)}"
        )
        assert (
            label(shown, f"{name}_std", "strain_gauge", *PLACES["strain_gauge"])
            == f": {maps.quantities[f'{name}_std'].format(std)}"
        )
    for name in ("u", "v", "u_std"):
        field = maps.quantities[name]
        shown.view = replace(shown.view, field=name)
        told = shown.pointer_text(*PLACES["point"])
        assert told.endswith(f"<b>{field.symbol} = {label(shown, name, 'point', *PLACES['point'])[2:]}</b>")
    assert label(shown, "u", "strain_gauge", *PLACES["strain_gauge"]) == label(shown, "u", "point", *PLACES["point"])


def test_what_a_history_does_not_have_is_not_stated_too_exactly(tmp_path):
    """Gauges overlap: their mean over three nodes is as uncertain as one, and so is that over an area at most."""
    shown = shown_fields(make_result(tmp_path / "result", frames=6, record=smooth_record), frame=5)
    maps = shown.maps
    std, (around, _) = maps.read("exx", 5).std, element_at(MESH.nodes, MESH.elements, *PLACES["point"])
    assert (
        0.97 * std[around].min() < spread_of(label(shown, "exx", "point", *PLACES["point"])) < 1.03 * std[around].max()
    )
    std, told = maps.read("magnitude", 5).std, label(shown, "magnitude", "region", *PLACES["region"])
    assert told.endswith(" at most")
    assert 0.97 * std.min() < spread_of(told) < 1.03 * std.max()
    assert label(shown, "misfit", "point", 50.0, 40.0) == ": 1"
    assert label(shown, "node_status", "point", 50.0, 40.0) == ": measured"
    assert label(shown, "u", "region", 200.0, 200.0, 300.0, 300.0) == ""
    assert label(shown, "exx", "strain_gauge", 200.0, 200.0, 40.0) == ""


def test_a_strain_gauge_at_a_node_is_the_map_at_that_node_since_any_frame(tmp_path):
    result = make_result(tmp_path / "result", frames=6, record=smooth_record)
    shown = shown_fields(result, frame=5, gauge=60.0, since=2, rigid=True)
    maps = shown.maps
    node = int(np.argmin(np.hypot(*(result.nodes - [60, 40]).T)))
    for name in ("exx", "equivalent"):
        read = maps.read(name, 5)
        stated = maps.quantities[name].format(read.values[node], read.std[node])
        assert label(shown, name, "strain_gauge", *result.nodes[node], 60.0) == f": {stated}"


def map_values(values, std):
    return Field(name="u", dims=("node",), values=values, std=std)


def test_the_magnitude_is_as_uncertain_as_along_itself(tmp_path):
    store = ResultStore.create(tmp_path / "result", make_origin(1))
    both = {"u": np.full(NODES, 3.0), "v": np.full(NODES, 4.0), "u_std": np.full(NODES, 0.1), "v_std": np.zeros(NODES)}
    store.write_frame(0, FrameRecord.from_values(nodes=NODES, lights=3, status=0, node_status=np.zeros(NODES), **both))
    store.finish()
    read = Maps.from_result(Result.open(tmp_path / "result")).read("magnitude", 0)
    np.testing.assert_allclose([read.values[0], read.std[0]], [5.0, 0.06], rtol=1e-3)  # a noise of .1 adds 2e-5


def test_doubtful_nodes_and_outliers_do_not_rule_the_colours():
    values, std = np.linspace(0, 1, 1000), np.full(1000, 0.1)
    values[3], std[3] = 50.0, 9.0
    low, high = robust_range(map_values(values, std))
    assert low == pytest.approx(0, abs=0.01)
    assert high == pytest.approx(1, abs=0.01)
    assert robust_range(map_values(np.full(3, np.nan), np.ones(3))) is None


def test_the_range_of_the_test_holds_that_of_every_frame(result):
    fields = Maps.from_result(result)
    low, high = range_over_test(fields, "v")
    ends = [robust_range(fields.read("v", frame)) for frame in range(6)]
    assert (low, high) == (min(a for a, _ in ends), max(b for _, b in ends))


def test_a_window_keeps_its_centre_and_shows_all_with_one_scale():
    window = ImageWindow(x_min=0, y_min=10, x_max=100, y_max=30, width=200, height=200).fit_aspect()
    assert window.edges == (0, -30, 100, 70)
    assert window.steps == pytest.approx((0.5, 0.5))


@pytest.mark.parametrize("zoom", [1, 4, 0.5])
def test_a_node_is_painted_where_its_pixel_of_the_image_is(zoom):
    """One bright pixel of the image, and a triangle around it whose corner values differ: both in the same place."""
    image = np.zeros((64, 64), dtype=np.uint8)
    image[20:24, 40:44] = 255  # centre (41.5, 21.5)
    window = ImageWindow(x_min=-0.5, y_min=-0.5, x_max=63.5, y_max=63.5, width=int(64 * zoom), height=int(64 * zoom))
    shown = paint(window, image) & 0xFF
    rows, columns = np.nonzero(shown > 120)
    x, y = window.to_picture(np.array([[41.5, 21.5]]))
    assert (columns.mean(), rows.mean()) == pytest.approx((x[0], y[0]), abs=0.51)
    nodes = np.array([[38.0, 18.0], [45.0, 18.0], [41.5, 28.5]])
    elements, colours = np.array([[0, 1, 2]], dtype=np.int32), ("#000000", "#ff0000")
    over = Overlay(nodes=nodes, elements=elements, values=np.ones(3), colour_range=(0, 1), colours=colours)
    painted = paint(window, np.zeros_like(image), over) & 0xFF
    rows, columns = np.nonzero(painted)
    x, y = window.to_picture(nodes.mean(axis=0)[None])
    assert (columns.mean(), rows.mean()) == pytest.approx((x[0], y[0]), abs=0.6)


def test_a_place_is_found_in_its_element(result):
    nodes, weights = element_at(result.nodes, result.elements, 33.3, 44.4)
    np.testing.assert_allclose(weights @ result.nodes[nodes], [33.3, 44.4])
    assert element_at(result.nodes, result.elements, 5.0, 44.4) is None


def test_every_field_has_colours(result):
    for field in Maps.from_result(result).quantities.values():
        for symmetric in {False, field.is_signed}:
            assert all(len(colour) == 7 for colour in palette(palette_name(field, symmetric=symmetric)))


def test_marks_make_probes_in_the_order_set_and_a_lone_end_waits():
    set_ = [
        Mark("gauge", 1, 2),
        Mark("point", 5, 6),
        Mark("gauge", 3, 4),
        Mark("gauge", 7, 8),
        Mark("strain_gauge", 9, 9),
    ]
    made = settings_of_marks(set_, 60.0, ProbeSettings(measure="hencky"))
    assert made.gauges == ((1, 2, 3, 4),)
    assert made.points == ((5, 6),)
    assert made.strain_gauges == ((9, 9, 60.0),)
    assert made.measure == "hencky"


def test_curves_are_grouped_by_what_they_tell_and_saved_as_the_command_does(tmp_path):
    result = make_result(tmp_path / "result", frames=4, record=smooth_record)
    set_ = [Mark("point", 50, 40), Mark("gauge", 30, 30), Mark("gauge", 90, 30), Mark("point", 60, 40)]
    histories = read(result, *set_)
    groups = {
        name: [told.name for told in own] for name, own in curves.group_quantities(histories, probe_marks(set_)).items()
    }
    assert groups["u (px)"] == ["point_1_u", "point_2_u"]
    assert groups["extension (px)"] == ["gauge_1_extension"]
    page = ResultPage(Document(), result, ViewState(), FrameProgress(4))
    page.curves.histories = histories
    page._save()
    write_histories(histories, tmp_path / "own.csv")
    assert page.state.csv == (tmp_path / "own.csv").read_bytes().decode()


def test_the_band_is_open_where_a_frame_is_missing():
    told = Field(name="a", unit="", values=np.array([1.0, 2, np.nan, 4, 5, 6]), std=np.full(6, 0.5))
    xs, ys = curves.uncertainty_band(np.arange(6.0), told)
    assert [list(x) for x in xs] == [[0, 1, 1, 0], [3, 4, 5, 5, 4, 3]]
    assert list(ys[0]) == [0, 1, 3, 2]


def test_the_time_line_tells_failed_frames_and_lost_nodes(tmp_path):
    store = ResultStore.create(tmp_path / "result", make_origin(4))
    records = [random_record(0), FrameRecord.failed("no start", nodes=NODES, lights=3), random_record(3)]
    for index, record in enumerate(records):
        store.write_frame(index, record)
    result, progress = Result.open(tmp_path / "result", partial=True), FrameProgress(4)
    for _ in range(2):
        progress.advance(result)
        assert progress.n_frames_read == 3
    assert progress.status.tolist() == [0, 2, 1, -1]
    np.testing.assert_allclose(progress.fraction[:3], [(r.node_status == 0).mean() for r in records])
    assert progress.summary(3) == "3 of 4 frames measured, 1 not converged, 1 failed"
    store.release()


def test_a_frame_that_is_measured_again_or_taken_back_is_looked_at_again(tmp_path):
    store = ResultStore.create(tmp_path / "result", make_origin(3))
    for index in range(3):
        store.write_frame(index, FrameRecord.failed("no start", nodes=NODES, lights=3))
    progress, line = FrameProgress(3), TimeLine(3, 0)
    progress.advance(Result.open(store.path, partial=True))
    line.draw(progress)
    store.write_frame(1, smooth_record(1))
    progress.advance(Result.open(store.path, partial=True))
    line.draw(progress)
    assert progress.summary(3) == "3 of 3 frames measured, 2 failed"
    assert line.plot.select_one({"name": "faults"}).data["x"] == [0, 2]
    store.release()


def test_a_frame_that_the_curves_do_not_hold_is_not_pointed_at(tmp_path):
    store = ResultStore.create(tmp_path / "result", make_origin(5))
    for index in (0, 1, 4):
        store.write_frame(index, smooth_record(index))
    result = Result.open(store.path, partial=True)
    panel = CurvePanel(Document(), FieldsInView(result, ViewState()), ResultControls(4, 0, dark=False))
    panel.histories = read(result, Mark("point", 50, 40))
    shown = []
    for frame in range(5):
        panel.mark_frame(frame)
        shown.append(panel.frame_mark.location)
    assert shown == [0, 1, None, None, 4]
    store.release()


def test_curves_go_over_the_time_in_the_unit_that_suits_it(tmp_path):
    result = make_result(tmp_path / "result", frames=4, record=lambda index: timed(index, 20_000))
    histories = read(result, Mark("point", 50, 40))
    x, name = time_axis(histories.times, histories.frames)
    assert name == "time (µs)"
    np.testing.assert_allclose(x, [0, 20, 40, 60])
    assert "frame 3, 60 µs" in FieldsInView(result, ViewState(frame=3)).description()


def timed(index, step):
    """A record with its time in ns."""
    record = smooth_record(index)
    return replace(record, values={**record.values, "time_ns": index * step})


TIMED = ("rate", "velocity", "acceleration")
"""Parts of the names of rates, which need frames whose numbers rise."""


class Walk:
    """A page without a browser, whose visitor does this and that while the result grows."""

    def __init__(self, folder):
        self.store = ResultStore.create(folder / "result", make_origin(8))
        self.store.write_frame(0, smooth_record(1))
        self.page = ResultPage(Document(), self.opened, ViewState(), FrameProgress(8))
        self.page.update_view()

    @property
    def opened(self):
        return Result.open(self.store.path, partial=True)

    def do(self, what, choose):
        page, parts = self.page, self.page.controls
        if what == "point":
            x, y = choose.uniform(0, 120), choose.uniform(0, 80)
            page.maps.canvas.plot._trigger_event(MouseMove(page.maps.canvas.plot, sx=1, sy=1, x=x, y=y))
        elif what == "frame":
            page.state.requested_frame = choose.randrange(8)
        elif what == "field":
            still = [name for name in page.fields.maps.quantities if not any(word in name for word in TIMED)]
            parts["field"].value = choose.choice(still)
        elif what == "over":
            parts["over"].active = choose.randrange(2)
        elif what == "range":
            parts["range"].value = choose.choice(["frame", "test"])
        else:
            self.store.write_frame(choose.randrange(8), smooth_record(choose.randrange(1, 9)))
            page._grow()
            page.state.requested_frame = (
                parts.frame.value if parts.frame.value != page.view.frame else page.state.requested_frame
            )

    def check(self):
        """All that is shown is of the frame and the field in view, as the result holds them now."""
        page, view, result = self.page, self.page.view, self.opened
        fields = Maps.from_result(result)
        field, values = fields.quantities[view.field], fields.read(view.field, view.frame)
        shown = FieldsInView(result, view)
        assert page.controls.pointer_label.text == (shown.pointer_text(*page._pointer) if page._pointer else "")
        assert page.controls.description.text == shown.description(shown.picture[1])
        assert page.maps.canvas.plot.title.text == field.label
        if field.fixed_range is None:
            whole = range_over_test(fields, view.field)
            ends = whole if view.range == "test" else robust_range(values) or (0.0, 1.0)
            assert (page.maps.canvas.colours.low, page.maps.canvas.colours.high) == ends


@pytest.mark.parametrize("seed", range(2))
def test_what_is_told_is_always_that_of_what_is_shown(tmp_path, seed):
    choose, walk = random.Random(seed), Walk(tmp_path)
    walk.check()
    for step in range(30):
        walk.do(
            "point" if step == 0 else choose.choice(["point", "frame", "frame", "field", "over", "range", "grow"]),
            choose,
        )
        walk.check()
    walk.store.release()


def test_nothing_is_shown_of_a_frame_that_cannot_be_read(tmp_path):
    made = make_result(tmp_path / "result", frames=3, record=smooth_record)
    page = ResultPage(Document(), made, ViewState(frame=0), FrameProgress(3))
    page.update_view()
    page.maps.canvas.plot._trigger_event(MouseMove(page.maps.canvas.plot, sx=1, sy=1, x=50, y=40))
    corrupt(made, 1)
    page.state.requested_frame = 1
    assert "damaged in frame 1" in page.controls.description.text
    assert page.controls.pointer_label.text == ""
    assert not len(page.maps.canvas._image.data["image"])
    assert not page.maps.canvas.bar.visible
    page.state.requested_frame = 2
    assert page.controls.description.text.startswith("Frame 2 of 0 to 2")
    assert "u = " in page.controls.pointer_label.text
    assert page.maps.canvas.bar.visible


def test_curves_that_are_being_read_are_not_saved(tmp_path):
    page = ResultPage(Document(), make_result(tmp_path / "result", record=smooth_record), ViewState(), FrameProgress(2))
    page.curves.histories = read(page.result, Mark("point", 50, 40))
    page.curves.reading = True
    page._save()
    assert page.state.csv == ""
    assert "still being read" in page.controls.message.text
    page.curves.reading = False
    page._save()
    assert page.state.csv.startswith("frame,")


def test_a_range_by_hand_that_makes_no_sense_is_told(tmp_path):
    page = ResultPage(Document(), make_result(tmp_path / "result", record=smooth_record), ViewState(), FrameProgress(2))
    page.update_view()
    present = page.maps.canvas.colours.low, page.maps.canvas.colours.high
    page.controls["range"].value = "hand"
    assert (page.view.low, page.view.high) == present
    page.controls["low"].value = 5.0
    assert f"The colours go from {present[0]:g} to {present[1]:g}" in page.controls.description.text
    page.controls["high"].value = 9.0
    assert "The colours go" not in page.controls.description.text
    assert (page.maps.canvas.colours.low, page.maps.canvas.colours.high) == (5, 9)


def test_a_choice_that_cannot_be_is_told_and_the_next_one_counts(tmp_path):
    page = ResultPage(Document(), make_result(tmp_path / "result", record=smooth_record), ViewState(), FrameProgress(2))
    page.controls["gauge"].value = 5.0
    assert "at least 56.12 px long" in page.controls.description.text
    assert not page._has_view
    page.controls["gauge"].value = 70.0
    page.controls["field"].value = "exx"
    assert "virtual strain gauge of 70 px" in page.controls.description.text
    page.controls["field"].value = "velocity"
    assert "rates need 4 measured frames or more; there are 2" in page.controls.description.text


def test_a_long_reason_is_short_until_more_is_asked_for(tmp_path):
    reason = "the solve stopped because " + "of this and that " * 20
    store = ResultStore.create(tmp_path / "result", make_origin(1))
    store.write_frame(0, FrameRecord.failed(reason, nodes=NODES, lights=3))
    store.finish()
    text = FieldsInView(Result.open(tmp_path / "result"), ViewState()).description()
    summary, _, rest = text.partition("</summary>")
    assert "failed: the solve stopped because" in summary
    assert summary.endswith("… more")
    assert summary.rpartition("<b")[2].count("this and that") < 5
    assert rest.count("this and that") > 15


def test_a_camera_s_plane_is_that_of_the_page_and_a_wrong_file_changes_nothing(tmp_path):
    made = make_result(tmp_path / "result", record=smooth_record)
    CameraCalibration(shape=(80, 120), homography=np.diag([0.5, 0.5, 1])).write(tmp_path / "camera.json")
    page = ResultPage(Document(), made, ViewState(frame=1), FrameProgress(2))
    page.update_view()
    before = page.fields.values("u").values
    page.controls["camera"].value = "camera.json"
    assert page.maps.canvas.plot.title.text == "u (mm)"
    assert ("u", "u (mm)") in [tuple(pair) for group in page.controls["field"].options.values() for pair in group]
    np.testing.assert_allclose(page.fields.values("u").values, 0.5 * before, atol=1e-9)
    page.controls["camera"].value = "none.json"
    assert "none.json" in page.controls["scale_label"].text
    assert page.maps.canvas.plot.title.text == "u (mm)"
    page.controls["camera"].value = ""
    assert page.maps.canvas.plot.title.text == "u (px)"


PROBES = ProbeSettings(points=((50, 40),), lines=((25, 40, 95, 45),), strain_gauges=((60, 40, 60),))


@pytest.fixture(scope="module")
def probed(tmp_path_factory):
    stated = replace(in_mm(), probes=PROBES)
    folder = tmp_path_factory.mktemp("probed")
    return make_result(folder / "result", frames=4, record=lambda index: timed(index, 20_000), settings=stated)


def test_probes_that_the_test_states_are_shown_at_opening(probed):
    page = ResultPage(Document(), probed, ViewState(), FrameProgress(4))
    assert settings_of_marks(page.view.marks, page.view.gauge, ProbeSettings()) == PROBES
    own = (Mark("point", 30, 30),)
    assert ResultPage(Document(), probed, ViewState(marks=own), FrameProgress(4)).view.marks == own
    other = replace(PROBES, strain_gauges=((60, 40, 60), (60, 40, 80)))  # the page has one length for all
    assert {mark.kind for mark in ViewState().with_probes(other, 50.0).marks} == {"point", "line"}
    assert ViewState().with_probes(PROBES, 61.0).gauge == 0
    assert ViewState().with_probes(PROBES, 60.0).gauge == 60


def test_a_picture_for_print_is_light_wide_and_says_what_it_shows(probed):
    view = ViewState(frame=3, field="exx", second="u", theme="dark", vectors=True, contours=True)
    page = ResultPage(Document(), probed, view, FrameProgress(4))
    page.update_view()
    figure = page.maps.figure()
    title = figure.texts[0].get_text()
    assert "Frame 3 of 0 to 3" in title
    assert "60 µs" in title
    assert "Green-Lagrange, virtual strain gauge of 60 px" in title
    assert [axis.get_title() for axis in figure.axes] == ["εxx", "u (mm)"]
    assert sum("point 1" in text.get_text() for text in figure.axes[0].texts) == 1
    assert figure.get_facecolor()[:3] == (1, 1, 1)
    page._print_maps()
    source, _, name = page.state.png.partition(" ")
    assert name == "exx_000003.png"
    png = base64.b64decode(source.removeprefix("data:image/png;base64,"))
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] == pytest.approx(2000, abs=5)
    assert (picture[:5] == 255).mean() > 0.9


def test_there_is_no_colour_bar_before_there_are_colours(probed):
    page = ResultPage(Document(), probed, ViewState(), FrameProgress(4))
    assert not page.maps.canvas.bar.visible
    page.update_view()
    assert page.maps.canvas.bar.visible


def test_a_bar_of_codes_has_their_names_only(probed):
    page = ResultPage(Document(), probed, ViewState(field="node_status"), FrameProgress(4))
    bar = page.maps.canvas.bar
    ticker = bar.ticker  # the page keeps the one that it was opened with
    page.update_view()
    assert bar.ticker is ticker
    assert ticker.min_interval == 1
    assert bar.major_label_overrides == dict(enumerate(QUANTITIES["node_status"].codes))


def test_a_page_whose_browser_has_gone_is_not_watched():
    def document(connections):
        session = None if connections is None else SimpleNamespace(connection_count=connections)
        return SimpleNamespace(session_context=SimpleNamespace(session=session))

    assert [is_watched(document(connections)) for connections in (None, 0, 1)] == [True, False, True]


def test_texts_end_in_the_window_and_do_not_lie_on_each_other():
    window = ImageWindow(x_min=0, y_min=0, x_max=500, y_max=400, width=500, height=400)
    texts = [(10, 50, "left"), (480, 50, "at the right edge"), (12, 55, "beside the first"), (14, 52, "and a third")]
    placed = place_texts(texts, window)
    assert [side for side, *_ in placed] == ["left", "right", "left", "left"]
    lows = [y + down for (_, y, _), (_, _, down) in zip(texts, placed, strict=True)]
    near = sorted(lows[at] for at in (0, 2, 3))
    assert min(np.diff(near)) >= 20
    assert lows[1] == 50
    layer = LabelLayer(SimpleNamespace(window=window, plot=figure()), "extremes")
    layer.show([(11, 51, "smallest", "black")], other_texts=texts)
    assert 51 + layer._points.data["down"][0] >= max(near) + 20
