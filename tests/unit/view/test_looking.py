"""What the viewer is made of: addresses, fields, colours, windows, marks and the time line."""

from __future__ import annotations

from urllib.parse import parse_qs

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from results import LIGHTS, NODES, make_origin, make_result, random_record, smooth_record

from rgbmidic.results import FrameRecord, Result, ResultStore
from rgbmidic.results.history_table import write_histories
from rgbmidic.settings import ProbeSettings, TestSettings
from rgbmidic.view import curves
from rgbmidic.view.address import KINDS, Look, Mark
from rgbmidic.view.fields import Fields, Values, robust_range
from rgbmidic.view.picture import Window, element_at, paint, palette, palette_name
from rgbmidic.view.timeline import Course

NAMES = ("u", "v", "e1")
numbers = st.floats(-1e6, 1e6).map(lambda x: float(f"{x:.6g}"))
marks = st.lists(st.builds(Mark, st.sampled_from(list(KINDS)), numbers, numbers), max_size=4).map(tuple)
looks = st.builds(
    Look,
    frame=st.integers(0, 9),
    field=st.sampled_from(NAMES),
    over=st.sampled_from(["reference", "deformed"]),
    symmetric=st.booleans(),
    directions=st.booleans(),
    curve=st.text("abc ()/²", max_size=9),
    theme=st.sampled_from(["", "light", "dark"]),
    marks=marks,
)


def opened(query: str) -> Look:
    arguments = {key: [value.encode() for value in values] for key, values in parse_qs(query).items()}
    return Look.from_query(arguments, frames=10, names=NAMES, frame=9)


@given(looks)
def test_an_address_opens_what_it_was_made_of(look):
    assert opened(f"frame={look.frame}&{look.query()}") == look


@given(
    st.dictionaries(st.sampled_from([*Look.__dataclass_fields__, "x"]), st.lists(st.binary(max_size=30), max_size=2))
)
@settings(max_examples=200)
def test_an_address_of_nonsense_opens_something_that_can_be_shown(query):
    look = Look.from_query(query, frames=10, names=NAMES, frame=9)
    assert 0 <= look.frame < 10
    assert look.field in NAMES
    assert look.low < look.high
    assert 0 <= look.opacity <= 1
    assert all(np.isfinite([mark.x, mark.y]).all() and mark.kind in KINDS for mark in look.marks)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    scale = {"mm_per_pixel": 0.5, "mm_per_pixel_std": 0.01}
    settings = TestSettings.from_mapping(
        {"frames": {"path": "x.cine", "kind": "monochrome"}, "region": {"rectangle": [0, 0, 9, 9]}, "scale": scale}
    )
    return make_result(tmp_path_factory.mktemp("view") / "result", frames=6, settings=settings)


def test_fields_are_those_of_the_table_in_the_units_of_the_reader(result):
    fields = Fields.of(result)
    assert list(fields.all)[:3] == ["u", "v", "magnitude"]
    assert {"e1", "equivalent", "node_status", "u_std", *(f"share of {light}" for light in LIGHTS)} <= set(fields.all)
    assert fields.all["u"].label == "u (mm)"
    read, record = fields.read("u", 3), result.frame(3)
    np.testing.assert_allclose(read.values, 0.5 * record.u)
    np.testing.assert_allclose(read.std, np.hypot(0.5 * record.u_std, 0.01 * record.u))
    np.testing.assert_allclose(read.moved, result.nodes + np.stack([record.u, record.v], axis=1))
    np.testing.assert_allclose(fields.read("magnitude", 3).values, 0.5 * np.hypot(record.u, record.v))
    np.testing.assert_array_equal(fields.read("node_status", 3).values, record.node_status)
    np.testing.assert_allclose(fields.read("e1", 3).values, fields.physical.frame(3)["e1"])
    share = fields.read("share of green", 3).values
    assert np.isnan(share[record.node_status != 0]).all()
    for name in fields.all:
        assert fields.read(name, 3).values.shape == (NODES,)


def test_the_magnitude_is_as_uncertain_as_along_itself(tmp_path):
    store = ResultStore.create(tmp_path / "result", make_origin(1))
    both = {"u": np.full(NODES, 3.0), "v": np.full(NODES, 4.0), "u_std": np.full(NODES, 0.1), "v_std": np.zeros(NODES)}
    store.write_frame(0, FrameRecord.of(nodes=NODES, lights=3, status=0, node_status=np.zeros(NODES), **both))
    store.finish()
    read = Fields.of(Result.open(tmp_path / "result")).read("magnitude", 0)
    np.testing.assert_allclose([read.values[0], read.std[0]], [5.0, 0.06])


def test_doubtful_nodes_and_outliers_do_not_rule_the_colours():
    values, std = np.linspace(0, 1, 1000), np.full(1000, 0.1)
    values[3], std[3] = 50.0, 9.0
    low, high = robust_range(Values(values=values, std=std, moved=np.zeros((1000, 2))))
    assert low == pytest.approx(0, abs=0.01)
    assert high == pytest.approx(1, abs=0.01)
    assert robust_range(Values(values=np.full(3, np.nan), std=np.ones(3), moved=np.zeros((3, 2)))) is None


def test_the_range_of_the_test_holds_that_of_every_frame(result):
    fields = Fields.of(result)
    low, high = fields.range_of_test("v")
    ends = [robust_range(fields.read("v", frame)) for frame in range(6)]
    assert (low, high) == (min(a for a, _ in ends), max(b for _, b in ends))


def test_a_window_keeps_its_centre_and_shows_all_with_one_scale():
    window = Window(left=0, top=10, right=100, bottom=30, width=200, height=200).fitted()
    assert window.edges == (0, -30, 100, 70)
    assert window.steps == pytest.approx((0.5, 0.5))


@pytest.mark.parametrize("zoom", [1, 4, 0.5])
def test_a_node_is_painted_where_its_pixel_of_the_image_is(zoom):
    """One bright pixel of the image, and a triangle around it whose corner values differ: both in the same place."""
    image = np.zeros((64, 64), dtype=np.uint8)
    image[20:24, 40:44] = 255  # centre (41.5, 21.5)
    window = Window(left=-0.5, top=-0.5, right=63.5, bottom=63.5, width=int(64 * zoom), height=int(64 * zoom))
    shown = paint(window, image, None, (0, 1), palette("viridis"), opacity=1) & 0xFF
    rows, columns = np.nonzero(shown > 120)
    x, y = window.place(np.array([[41.5, 21.5]]))
    assert (columns.mean(), rows.mean()) == pytest.approx((x[0], y[0]), abs=0.51)
    nodes = np.array([[38.0, 18.0], [45.0, 18.0], [41.5, 28.5]])
    field = (nodes, np.array([[0, 1, 2]], dtype=np.int32), np.ones(3))
    painted = paint(window, np.zeros_like(image), field, (0, 1), ("#000000", "#ff0000"), opacity=1) & 0xFF
    rows, columns = np.nonzero(painted)
    x, y = window.place(nodes.mean(axis=0)[None])
    assert (columns.mean(), rows.mean()) == pytest.approx((x[0], y[0]), abs=0.6)


def test_a_place_is_found_in_its_element(result):
    nodes, weights = element_at(result.nodes, result.elements, 33.3, 44.4)
    np.testing.assert_allclose(weights @ result.nodes[nodes], [33.3, 44.4])
    assert element_at(result.nodes, result.elements, 5.0, 44.4) is None


def test_every_field_has_colours(result):
    for field in Fields.of(result).all.values():
        for symmetric in {False, field.signed}:
            assert all(len(colour) == 7 for colour in palette(palette_name(field.kind, symmetric=symmetric)))


def test_marks_make_probes_in_the_order_set_and_a_lone_end_waits():
    set_ = [
        Mark("gauge", 1, 2),
        Mark("point", 5, 6),
        Mark("gauge", 3, 4),
        Mark("gauge", 7, 8),
        Mark("strain_gauge", 9, 9),
    ]
    made = curves.probes(set_, 60.0, ProbeSettings(measure="hencky"))
    assert made.gauges == ((1, 2, 3, 4),)
    assert made.points == ((5, 6),)
    assert made.strain_gauges == ((9, 9, 60.0),)
    assert made.measure == "hencky"


def test_curves_are_grouped_by_what_they_tell_and_saved_as_the_command_does(tmp_path):
    result = make_result(tmp_path / "result", frames=4, record=smooth_record)
    set_ = [Mark("point", 50, 40), Mark("gauge", 30, 30), Mark("gauge", 90, 30), Mark("point", 60, 40)]
    histories = curves.read(result, set_, 60.0)
    groups = {name: [told.name for told in own] for name, own in curves.groups(histories).items()}
    assert groups["u (px)"] == ["point_1_u", "point_2_u"]
    assert groups["extension (px)"] == ["gauge_1_extension"]
    write_histories(histories, tmp_path / "own.csv")
    assert curves.as_csv(histories) == (tmp_path / "own.csv").read_bytes().decode()
    assert curves.read(result, [], 60.0) is None


def test_the_band_is_open_where_a_frame_is_missing():
    from rgbmidic.results import Told

    told = Told(name="a", unit="", values=np.array([1.0, 2, np.nan, 4, 5, 6]), std=np.full(6, 0.5))
    xs, ys = curves.band(np.arange(6.0), told)
    assert [list(x) for x in xs] == [[0, 1, 1, 0], [3, 4, 5, 5, 4, 3]]
    assert list(ys[0]) == [0, 1, 3, 2]


def test_the_time_line_tells_failed_frames_and_lost_nodes(tmp_path):
    store = ResultStore.create(tmp_path / "result", make_origin(4))
    records = [random_record(0), FrameRecord.failed("no start", nodes=NODES, lights=3), random_record(3)]
    for index, record in enumerate(records):
        store.write_frame(index, record)
    result, course = Result.open(tmp_path / "result", partial=True), Course(4)
    for _ in range(2):
        course.advance(result)
        assert course.known == 3
    assert course.status.tolist() == [0, 2, 1, -1]
    np.testing.assert_allclose(course.share[:3], [(r.node_status == 0).mean() for r in records])
    assert course.words(3) == "3 of 4 frames measured, 1 not converged, 1 failed"
    store.release()
