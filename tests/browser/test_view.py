"""The viewer in a real browser: what the page shows is what the result holds, and nobody else is served."""

from __future__ import annotations

import re
import time
from importlib.util import find_spec
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from results import NODES, corrupt, make_origin, make_result, smooth_record
from viewer import MISSING, Page, chromium, click, serving

from rgbmidic.results import FrameRecord, Maps, Result, ResultStore
from rgbmidic.results.histories import read_histories
from rgbmidic.results.profiles import read_profile
from rgbmidic.settings import FrameSettings, ProbeSettings, RegionSettings, ScaleSettings, TestSettings
from rgbmidic.tools.report import FieldMovie, write_movie
from rgbmidic.tools.view import panels
from rgbmidic.tools.view.fields import element_at, robust_range

pytestmark = pytest.mark.skipif(bool(MISSING), reason=MISSING)
RIGHT, LEFT, HOME = "\ue014", "\ue012", "\ue011"


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Seven frames, of which the fourth failed."""
    store = ResultStore.create(tmp_path_factory.mktemp("view") / "result", make_origin(7))
    for index in range(7):
        failed = FrameRecord.failed("no start <was> found", nodes=NODES, lights=3, number=index)
        store.write_frame(index, failed if index == 3 else smooth_record(index))
    store.finish()
    return Result.open(store.path)


@pytest.fixture(scope="module")
def address(result):
    with serving(result.path) as told:
        yield told


@pytest.fixture(scope="module")
def driver():
    with chromium() as one:
        yield one


def shown(page, frame):
    """The words on the page once it shows a frame."""
    page.until(f"model('state').displayed_frame === {frame} && model('description').text.startsWith('Frame {frame} ')")
    return page.run("model('description').text")


def test_frames_are_scrubbed_and_the_address_holds_what_is_shown(driver, address, result):
    page = Page(driver, address)
    assert "converged" in shown(page, 6)
    page.keys(LEFT, LEFT)
    shown(page, 4)
    page.keys(LEFT)
    assert "failed: no start &lt;was&gt; found" in shown(page, 3)
    page.do("model('quantity').value = 'v'")
    page.do("model('frame').value = 2")
    shown(page, 2)
    low, high = robust_range(Maps.from_result(result).read("v", 2))
    mapper = "model('colours')"
    page.until(f"{mapper}.low === {low!r} && {mapper}.high === {high!r}")
    held = parse_qs(urlsplit(driver.current_url).query)
    assert held == {"frame": ["2"], "field": ["v"]}
    again = Page(driver, driver.current_url)
    shown(again, 2)
    assert again.run("model('quantity').value") == "v"


def test_the_value_under_the_pointer_is_that_of_the_array(driver, address, result):
    page = Page(driver, f"{address}?frame=5&field=u")
    shown(page, 5)
    node = int(np.argmin(np.hypot(*(result.nodes - [70, 45]).T)))
    page.pointer(("move", *result.nodes[node]))
    text = page.until("model('under').text")
    x, y, u, std = (float(n) for n in re.findall(r"-?[\d.]+(?:e-?\d+)?", text))
    assert np.hypot(x - result.nodes[node, 0], y - result.nodes[node, 1]) < 0.5
    assert u == pytest.approx(0.002 * 5 * (x - 60), abs=1e-3)
    read = read_histories(result, ProbeSettings(points=((x, y),)))
    assert std == pytest.approx(read["point_1_u"].std[read.frames == 5][0], rel=0.03)  # two digits, of a place to .1 px


def test_the_value_stays_that_of_what_is_shown(driver, address, result):
    """A point is clicked; then keys, another field, the frame beneath, playing: the number is always that in view."""
    page = Page(driver, f"{address}?frame=5&field=u")
    shown(page, 5)
    page.pointer(("move", 90, 50))
    page.until("model('under').text.includes('u = ')")
    page.do("model('mode').active = 1")
    page.pointer(("click", 90, 50))
    fields = Maps.from_result(result)

    def check(frame, name):
        field = fields.quantities[name]
        page.until(f"model('state').displayed_frame === {frame} && model('plot').title.text === {field.label!r}")
        text = page.until(f"model('under').text.includes('{field.symbol} = ') && model('under').text")
        x, y, value = (float(n) for n in re.findall(r"-?[\d.]+(?:e-?\d+)?", text)[:3])
        values = fields.read(name, frame)
        corners, weights = element_at(result.nodes, result.elements, x, y)
        assert value == pytest.approx(weights @ values.values[corners], rel=0.02, abs=1e-5)

    check(5, "u")
    page.keys(HOME)
    check(0, "u")
    page.keys(RIGHT, RIGHT)
    check(2, "u")
    page.do("model('quantity').value = 'v'")
    check(2, "v")
    page.do("model('quantity').value = 'magnitude'")
    check(2, "magnitude")
    page.do("model('frame').value = 4")
    check(4, "magnitude")
    page.do("model('step').value = 2; model('play').active = true")
    page.until("model('state').displayed_frame === 6")
    page.do("model('play').active = false; model('step').value = 1")
    page.until(
        "model('state').displayed_frame === model('frame').value && "
        "model('state').displayed_frame === model('state').requested_frame"
    )
    check(page.run("model('state').displayed_frame"), "magnitude")
    page.keys(HOME, RIGHT, RIGHT, RIGHT)
    shown(page, 3)
    assert "not measured" in page.run("model('under').text")


CUT = """(() => {
  const cut = [], side = document.querySelector(".side"), edge = side.getBoundingClientRect().left + side.clientWidth;
  const walk = (root) => root.querySelectorAll("*").forEach((one) => {
    const box = one.getBoundingClientRect(), control = ["BUTTON", "INPUT", "SELECT"].includes(one.tagName);
    if (control && (box.right > edge + 1 || one.scrollWidth > one.clientWidth + 1)) cut.push(one.textContent);
    if (one.shadowRoot) walk(one.shadowRoot);
  });
  walk(side);
  return [cut, document.documentElement.scrollWidth - innerWidth, side.scrollHeight - side.clientHeight];
})()"""


UNLABELLED = """(() => {
  const found = [];
  const walk = (root) => root.querySelectorAll("*").forEach((one) => {
    const input = ["INPUT", "SELECT"].includes(one.tagName) || one.getAttribute("role") === "slider";
    if (input && !one.ariaLabel && !one.labels?.[0]?.textContent.trim()) found.push(one.outerHTML);
    if (one.shadowRoot) walk(one.shadowRoot);
  });
  walk(document);
  return found;
})()"""


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1280, 720), (1920, 1080)])
def test_no_control_is_cut_off(driver, address, size, theme):
    driver.set_window_size(*size)
    driver.set_window_size(size[0], 2 * size[1] - driver.execute_script("return innerHeight"))
    more = "range=hand&low=-1&high=1&second=uncertainty&frame=3&clock=correlation"
    page = Page(driver, f"{address}?theme={theme}&{more}")
    page.until("model('low').visible && model('plot_2') !== null")
    for name in ("step", "over", "section", "scale", "sections_to_write"):
        assert page.run(f"Bokeh.index.get_one(model('{name}')).el.getAttribute('aria-label')")
    assert driver.execute_script("return [innerWidth, innerHeight]") == list(size)
    for section in range(7):
        page.keys(str(section + 1))
        page.until(f"model('section').active === {section}")
        time.sleep(0.3)
        cut, beyond, below = page.run(CUT)
        assert cut == []
        assert beyond <= 0
        assert below <= 0, section
    assert page.run(UNLABELLED) == []
    driver.set_window_size(1280, 940)


def numbers(text):
    return [float(number) for number in re.findall(r"-?\d+\.?\d*(?:e[+-]?\d+)?", text)]


def test_a_derived_field_and_its_uncertainty_are_those_of_the_library(driver, address, result):
    page = Page(driver, f"{address}?frame=5&field=exx")
    shown(page, 5)
    for name, value in {"gauge": 80, "measure": "'hencky'", "since": 2, "second": "'uncertainty'"}.items():
        page.do(f"model('{name}').value = {value}")
    page.do("model('rigid').active = true; model('third').value = 'velocity'")
    page.until("model('plot_3') && model('plot_3').title.text === '|du/dt| (px/frame)'")
    page.until("model('description').text.includes('since frame 2')")
    assert "Hencky, virtual strain gauge of 80 px" in page.run("model('description').text")
    maps = Maps.from_result(result, gauge=80.0, measure="hencky", since=2, rigid_removed=True)
    read, speed = maps.read("exx", 5), maps.read("velocity", 5)
    node = int(np.argmin(np.hypot(*(result.nodes - [70, 45]).T)))
    for _ in range(30):  # while the plots take their new sizes the pointer is elsewhere
        page.pointer(("move", *result.nodes[node]))
        told = page.until("model('under').text.includes('εxx = ') && model('under').text")
        if np.abs(numbers(told)[:2] - result.nodes[node]).max() < 1:
            break
        time.sleep(0.1)
    exx, std = numbers(told.partition("εxx = ")[2])[:2]
    assert (exx, std) == pytest.approx((read.values[node], read.std[node]), rel=0.02)
    assert numbers(told.partition("|du/dt| = ")[2])[0] == pytest.approx(speed.values[node], rel=0.05)
    for plot, values in (("plot", read), ("plot_2", maps.read("exx_std", 5)), ("plot_3", speed)):
        ends = page.run(f"[model('{plot}').right[0].color_mapper.low, model('{plot}').right[0].color_mapper.high]")
        assert ends == pytest.approx(robust_range(values), rel=1e-6)
    assert page.run("model('plot').x_range === model('plot_3').x_range")
    held = parse_qs(urlsplit(driver.current_url).query)
    assert (held["gauge"], held["since"], held["measure"], held["rigid"]) == (["80"], ["2"], ["hencky"], ["1"])


def test_a_second_field_is_moved_with_the_first_and_painted_anew(driver, address):
    from selenium.webdriver.common.action_chains import ActionBuilder

    page = Page(driver, f"{address}?frame=5&field=u&second=v")
    shown(page, 5)
    page.until("model('plot_2') !== null && model('plot_2').inner_width > 100")
    time.sleep(1)  # the plots take their new sizes
    before = page.run("model('plot').x_range.start")
    box = page.run(
        "(() => { const b = Bokeh.index.get_one(model('plot_2')).el.getBoundingClientRect(); "
        "return [b.x + b.width / 2, b.y + b.height / 2]; })()"
    )
    actions = ActionBuilder(driver, duration=50)
    actions.pointer_action.move_to_location(*map(round, box))
    actions.pointer_action.pointer_down()
    actions.pointer_action.move_to_location(round(box[0]) + 60, round(box[1]))
    actions.pointer_action.pointer_up()
    actions.perform()
    page.until(f"model('plot').x_range.start < {before} - 5")
    for plot in ("plot", "plot_2"):
        page.until(f"Math.abs(model('{plot}').renderers[0].data_source.data.x[0] - model('plot').x_range.start) < 0.5")


def test_extremes_arrows_contours_and_colours(driver, address, result):
    page = Page(driver, f"{address}?frame=5&field=u")
    shown(page, 5)
    values = Maps.from_result(result).read("u", 5).values
    page.do("['extremes', 'contours', 'vectors'].forEach((name) => { model(name).active = true; })")
    page.do("model('levels').value = 8; model('palette').value = 'PuOr_r'")
    page.until("model('colours').palette.length === 8 && model('extreme nodes').data.x.length === 2")
    x, y, texts = (page.run(f"Array.from(model('extreme nodes').data.{name})") for name in ("x", "y", "text"))
    nodes = [int(np.argmin(values)), int(np.argmax(values))]
    np.testing.assert_allclose(np.transpose([x, y]), result.nodes[nodes])
    assert [numbers(text)[0] for text in texts] == pytest.approx(values[nodes], rel=1e-4)
    assert f"largest {values.max():.3f} ± 0.010 px" in page.run("model('description').text")
    low, high = robust_range(Maps.from_result(result).read("u", 5))
    at = np.array(page.run("Array.from(model('contour lines').data.x0)"))
    levels = np.unique(np.round(0.01 * (at - 60), 9))
    np.testing.assert_allclose(levels, np.linspace(low, high, 9)[1:-1], atol=1e-6)
    page.do("model('longer').value = 3")
    page.until("model('longer').title.endsWith(': 3')")
    x0, x1 = (np.array(page.run(f"Array.from(model('arrows').data.{name})")) for name in ("x0", "x1"))
    shafts = len(x0) // 3
    np.testing.assert_allclose((x1 - x0)[:shafts], 3 * 0.01 * (x0[:shafts] - 60), atol=1e-6)


def test_a_range_is_locked_where_it_is(driver, address, result):
    page = Page(driver, f"{address}?frame=5&field=u")
    shown(page, 5)
    page.do("model('section').active = 1")
    page.until("document.querySelector('.side')")
    ends = robust_range(Maps.from_result(result).read("u", 5))
    page.driver.execute_script(*click("Lock the range"))
    page.until("model('range').value === 'hand' && model('low').visible")
    page.do("model('frame').value = 2")
    shown(page, 2)
    assert page.run("[model('colours').low, model('colours').high]") == pytest.approx(ends)
    assert page.run("[model('low').value, model('high').value]") == pytest.approx(ends)


def test_means_over_a_box_and_a_circle_stay_on_the_map(driver, address, result):
    page = Page(driver, f"{address}?frame=5&field=u")
    shown(page, 5)
    for mode, ends in ((5, ((30, 20), (60, 60))), (6, ((80, 40), (90, 40))), (1, ((40, 30),))):
        page.do(f"model('mode').active = {mode}")
        page.pointer(*(("click", *end) for end in ends))
    page.until("model('probes').data.text.length === 3")
    for frame in (5, 2):
        page.do(f"model('frame').value = {frame}")
        shown(page, frame)
        told = {
            text.partition(":")[0]: numbers(text.partition(":")[2])
            for text in page.run("Array.from(model('probes').data.text)")
        }
        for name, x in (("region 1 mean", 45), ("circle 1 mean", 80), ("point 1", 40)):
            assert told[name][0] == pytest.approx(0.002 * frame * (x - 60), abs=0.006)
            assert 0 < told[name][1] <= 0.0101
    expected = read_histories(result, ProbeSettings(regions=((30, 20, 60, 60),)))["region_1_u"]
    assert told["region 1 mean"][1] == pytest.approx(expected.std[2], rel=0.05)


def test_nodes_without_data_have_their_reason(driver, address):
    page = Page(driver, f"{address}?frame=3&blank=1")
    shown(page, 3)
    page.until(f"model('blank nodes').data.x.length === {NODES}")
    page.pointer(("move", 60, 40))
    page.until("model('under').text.includes('no light sees enough texture here')")


def test_curves_of_a_gauge_that_is_set_and_dragged_are_those_of_history(driver, address, result):
    page = Page(driver, f"{address}?frame=6")
    page.do("model('mode').active = 2")
    page.pointer(("click", 25, 40))
    page.pointer(("click", 95, 40))
    check_gauge(page, result)
    page.pointer(("press", *ends(page)[1]), ("move", 90, 50), ("release", 80, 60))
    page.until("model('marks').data.y[1] > 55")
    check_gauge(page, result)
    page.do("model('section').active = 4")
    page.do(
        "window.saved = ''; URL.createObjectURL = (blob) => { blob.text().then((t) => window.saved = t); return '#'; }"
    )
    page.driver.execute_script(*click("Save CSV"))
    assert page.until("window.saved").splitlines()[0].startswith("frame,number,status,gauge_1_extension_px")
    page.do("window.saved = ''")
    page.driver.execute_script(*click("Save PNG"))
    assert "PNG" in page.until("window.saved")[:8]
    page.do("model('mode').active = 1")
    page.pointer(("click", 60, 30))
    page.until("model('curve').value === 'u (px)' && model('lines').data.name[0] === 'point 1 u'")


def ends(page):
    data = page.run("[Array.from(model('marks').data.x), Array.from(model('marks').data.y)]")
    return list(zip(*data, strict=True))


def check_gauge(page, result):
    """The curve on the page and its band are what `rgbmidic history` reads at the marks of the page."""
    place = tuple(value for end in ends(page) for value in end)
    expected = read_histories(result, ProbeSettings(gauges=(place,)))["gauge_1_extension"]
    last = f"{expected.values[-1]:.9g}"
    page.until(f"model('lines').data.ys.length === 1 && Math.abs(model('lines').data.ys[0][6] - {last}) < 1e-6")
    curve = page.run("Array.from(model('lines').data.ys[0]).map((v) => Number.isFinite(v) ? v : null)")
    np.testing.assert_allclose([np.nan if v is None else v for v in curve], expected.values, atol=1e-9)
    first = page.run("Array.from(model('bands').data.ys[1])")  # behind the failed frame
    np.testing.assert_allclose(first[:3], (expected.values - 2 * expected.std)[4:], atol=1e-9)


def test_a_result_that_grows_is_followed(driver, tmp_path):
    store = ResultStore.create(tmp_path / "result", make_origin(4))
    with serving(store.path) as told:
        page = Page(driver, told)
        assert "not measured yet" in shown(page, 0)
        for index in (0, 1):
            store.write_frame(index, smooth_record(index))
        assert "converged" in shown(page, 1)
        page.until("model('head').text.includes('2 of 4 frames measured')")
        for index in (2, 3):
            store.write_frame(index, smooth_record(index))
        store.finish()
        shown(page, 3)
        page.until("model('head').text.includes('4 of 4 frames measured')")


def test_nothing_is_asked_of_the_network(driver, address):
    page = Page(driver, address)
    asked = page.run("performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert len(asked) >= 2
    assert all(name.startswith((address, "data:", "blob:")) for name in asked)


def test_a_damaged_frame_is_told_and_the_page_goes_on(driver, tmp_path):
    made = make_result(tmp_path / "result", frames=3)
    corrupt(made, 1)
    with serving(made.path) as told:
        page = Page(driver, told)
        page.do("model('frame').value = 1")
        page.until("model('description').text.includes('damaged in frame 1')")
        page.do("model('frame').value = 0")
        shown(page, 0)


def test_a_folder_s_page_opens_its_results_and_a_reload_stays(driver, result):
    with serving(result.path.parent) as told:
        driver.get(told)
        page = Page(driver, f"{told}open?path={result.path.name}")
        shown(page, 6)
        assert driver.execute_script("return document.querySelector('.head a').href") == told
        page.keys(LEFT)
        shown(page, 5)
        page.until("new URL(location.href).searchParams.get('frame') === '5'")
        driver.refresh()
        assert "converged" in shown(page, 5)
        driver.get(f"{told}open?path=..%2Fother")
        wait = "return Bokeh.documents[0] && Bokeh.documents[0].roots()[0].text"
        text = ""
        while "has no result and no test" not in (text or ""):
            text = driver.execute_script(wait)
        driver.get(told)
        listed = ""
        while "2 of 7" not in (listed or "") and "7 of 7" not in (listed or ""):
            listed = driver.execute_script(wait)
        assert "result: 7 of 7 frames" in listed


ALONG = (25, 40, 95, 45)


@pytest.fixture(scope="module")
def wave(tmp_path_factory):
    """Twelve frames, 1 ms apart, of which the fourth failed."""
    sections = {"frames": FrameSettings(path=("a",)), "region": RegionSettings(rectangle=(0, 0, 9, 9))}
    settings = TestSettings(**sections, scale=ScaleSettings(mm_per_pixel=0.5, frame_rate=1000.0))
    store = ResultStore.create(tmp_path_factory.mktemp("wave") / "result", make_origin(12, settings=settings))
    for index in range(12):
        failed = FrameRecord.failed("no start", nodes=NODES, lights=3, number=index)
        store.write_frame(index, failed if index == 3 else smooth_record(index))
    store.finish()
    return Result.open(store.path)


def array(page, script):
    """Numbers of the page; what is not finite is NaN."""
    read = page.run(f"Array.from({script}).map((v) => Number.isFinite(v) ? v : null)")
    return np.array([np.nan if value is None else value for value in read], dtype=float)


def test_a_line_shows_its_profile_and_position_against_time(driver, wave):
    from selenium.webdriver.common.action_chains import ActionBuilder

    with serving(wave.path) as told:
        page = Page(driver, f"{told}?frame=5&field=exx")
        shown(page, 5)
        assert not page.run("model('beside_map').visible")
        page.do("model('mode').active = 3")
        page.pointer(("click", *ALONG[:2]), ("click", *ALONG[2:]))
        page.until("model('beside_map').visible")
        assert page.run("model('beside_map').labels") == ["over time", "along line 1"]
        page.driver.execute_script(*click("along line 1"))
        page.until("model('wave').data.image.length && !model('line_status').visible")
        data = page.run("[Array.from(model('marks').data.x), Array.from(model('marks').data.y)]")
        place = tuple(np.transpose(data).ravel())
        expected = read_profile(Maps.from_result(wave), "exx", place)
        image = array(page, "model('wave').data.image[0]").reshape(page.run("model('wave').data.image[0].shape"))
        np.testing.assert_allclose(image, expected.values.T, rtol=1e-5)
        assert np.isnan(image[:, 3]).all()
        x, y, wide, tall = (page.run(f"model('wave').data.{name}[0]") for name in ("x", "y", "dw", "dh"))
        apart = expected.positions[1]
        assert (x, y, wide) == pytest.approx((-0.5, -apart / 2, 12))
        assert tall == pytest.approx(expected.positions[-1] + apart)
        page.until("model('wave_frame_mark').location === 5")
        for frame in (5, 8):
            page.do(f"model('frame').value = {frame}")
            shown(page, frame)
            page.until(f"model('wave_frame_mark').location === {frame}")
            curve = array(page, "model('profile').data.y")
            np.testing.assert_allclose(curve, expected.values[frame], atol=1e-12)
            np.testing.assert_allclose(array(page, "model('profile').data.x"), expected.positions)
            rim = array(page, "model('profile bands').data.ys[0]")
            known = np.isfinite(curve)
            np.testing.assert_allclose(rim[: known.sum()], (curve - 2 * expected.std[frame])[known])
            for name, read in (("colours", Maps.from_result(wave).read("exx", frame)), ("wave_colours", expected.data)):
                ends = page.run(f"[model('{name}').low, model('{name}').high]")
                assert ends == pytest.approx(robust_range(read)), "the map has those of the frame, the line of the test"
        held = parse_qs(urlsplit(driver.current_url).query)
        assert held["line"] == ["line_1"]
        box = page.run(
            "(() => { const v = Bokeh.index.get_one(model('wave_plot')), b = v.el.getBoundingClientRect(); "
            "return [b.x + v.frame.x_scale.compute(2), b.y + b.height / 2]; })()"
        )
        actions = ActionBuilder(driver, duration=50)
        actions.pointer_action.move_to_location(*map(round, box))
        actions.pointer_action.click()
        actions.perform()
        shown(page, 2)
        page.do("model('since').value = 1")
        longer = read_profile(Maps.from_result(wave, since=1), "exx", place).values.T.ravel()
        place_of = int(np.nanargmax(np.abs(longer - expected.values.T.ravel())))
        page.until(f"Math.abs(model('wave').data.image[0]?.[{place_of}] - {float(longer[place_of])!r}) < 1e-6")
        np.testing.assert_allclose(array(page, "model('wave').data.image[0]"), longer, rtol=1e-5, atol=1e-9)
        page.do("model('since').value = -1; model('quantity').value = 'u'")
        other = read_profile(Maps.from_result(wave), "u", place)
        page.until("model('wave_plot').title.text.startsWith('u ') && model('wave').data.image.length")
        page.until("!model('line_status').visible")
        np.testing.assert_allclose(array(page, "model('wave').data.image[0]"), other.values.T.ravel(), rtol=1e-5)
        page.do("model('quantity').value = 'node_status'")
        page.until(
            "model('line_status').text.includes('a field with an uncertainty') && !model('wave').data.image.length"
        )
        page.driver.execute_script(*click("over time"))
        page.until("!model('wave_plot').visible && model('lines').data.ys.length")


def test_the_line_s_panel_is_whole_on_a_small_dark_screen(driver, wave):
    driver.set_window_size(1280, 720)
    driver.set_window_size(1280, 2 * 720 - driver.execute_script("return innerHeight"))
    with serving(wave.path) as told:
        marks = "line:25,40;line:95,45;line:30,20;line:90,70"
        page = Page(driver, f"{told}?frame=5&field=u&marks={marks}&line=line_2&theme=dark")
        page.until("model('wave').data.image.length && model('profile_plot').inner_height > 80")
        for name in ("beside_map", "wave_plot", "profile_plot", "movie"):
            box = page.run(
                f"(() => {{ const b = Bokeh.index.get_one(model('{name}')).el.getBoundingClientRect(); "
                "return [b.left, b.top, innerWidth - b.right, innerHeight - b.bottom, b.height]; })()"
            )
            assert min(box[:4]) >= 0, name
            assert box[4] > (20 if name in ("beside_map", "movie") else 150), name
        assert page.run("Bokeh.index.get_one(model('beside_map')).el.getAttribute('aria-label')")
    driver.set_window_size(1280, 940)


def test_several_fields_without_curves_leave_room_for_the_pointer_s_text_and_stay_where_they_are(
    driver, address, result
):
    page = Page(driver, f"{address}?frame=5&field=u&second=v&third=exx")
    shown(page, 5)
    page.until("model('plot_3') && model('plot_3').inner_width > 100")
    box = "JSON.stringify(Bokeh.index.get_one(model('plot')).el.getBoundingClientRect())"
    time.sleep(0.5)
    before, told = page.run(box), "Bokeh.index.get_one(model('under')).el"
    page.pointer(("move", 70, 45))
    text = page.until("model('under').text.includes('εxx = ') && model('under').text")
    assert text.count("px:") == 1, "the place is said once"
    assert page.run(f"{told}.getBoundingClientRect().width") > 800
    assert page.run(f"{told}.getBoundingClientRect().height") < 45
    assert page.run(box) == before


def test_the_picture_that_is_saved_is_of_the_plot_that_is_there(driver, wave):
    with serving(wave.path) as told:
        page = Page(driver, f"{told}?frame=5&field=exx")
        shown(page, 5)
        page.do("model('mode').active = 3")
        page.pointer(("click", *ALONG[:2]), ("click", *ALONG[2:]))
        page.until("model('beside_map').visible")
        page.driver.execute_script(*click("along line 1"))
        page.until("model('wave').data.image.length && !model('line_status').visible")
        driver.execute_script("window.kept = []; rgbmidic.keep = (blob, name) => window.kept.push([name, blob.size])")
        page.driver.execute_script(*click("Save PNG"))
        page.until("window.kept.length === 1")
        page.driver.execute_script(*click("Save PNG for print"))
        page.until("window.kept.length === 2")
        page.driver.execute_script(*click("over time"))
        page.until("model('curves_plot').visible && model('curve').value")
        page.driver.execute_script(*click("Save PNG"))
        page.until("window.kept.length === 3")
        kept = dict(page.run("window.kept"))
        assert list(kept) == ["profile.png", "exx_000005.png", "history.png"]
        assert min(kept.values()) > 20_000


def test_a_movie_of_what_is_in_view_is_written_beside_the_others(driver, wave, tmp_path, monkeypatch):
    """Without the extra it is a .gif, whose bytes are those of the library."""
    names = [f"movie_exx_u{number}{ending}" for number, ending in (("", ".gif"), ("_2", ".gif"), ("", ".mp4"))]
    first, second, other = (wave.path / name for name in names)
    there = find_spec("imageio_ffmpeg") is not None
    with serving(wave.path) as told:
        view = "frame=5&field=exx&second=u&range=hand&low=-0.01&high=0.02&opacity=0.5&gauge=60&since=1&measure=hencky"
        page = Page(driver, f"{told}?{view}")
        shown(page, 5)
        monkeypatch.setattr(panels, "find_spec", lambda name: None)
        page.driver.execute_script(*click("Movie"))
        page.until("model('movie_status').text.startsWith('movie_exx_u') && model('movie').label === '■ Movie'")
        page.until(
            f"model('movie_status').text.startsWith('written: {first} (a .gif; for .mp4: pip install')", patience=180
        )
        assert not page.run("model('movie').active")
        maps = Maps.from_result(wave, gauge=60.0, since=1, measure="hencky")
        movie = FieldMovie(maps=maps, fields=["exx", "u"], limits={"exx": (-0.01, 0.02)}, opacity=0.5)
        write_movie(movie, tmp_path / "a.gif")
        before = first.read_bytes()
        assert before == (tmp_path / "a.gif").read_bytes()
        page.keys("m")
        page.until(f"model('movie_status').text.startsWith('written: {second}')", patience=180)
        assert first.read_bytes() == before
        monkeypatch.undo()
        if there:
            page.keys("m")
            page.until(f"model('movie_status').text === 'written: {other}'", patience=180)
        page.do("model('quantity').value = 'node_status'")
        page.keys("m")
        page.until(
            "model('movie_status').text.includes('a movie shows fields of numbers, not node_status')", patience=180
        )
        page.until("!model('movie').active")  # which is told after the text
        page.do("model('quantity').value = 'v'")
        page.keys("m")
        page.until("model('movie').active && model('movie_status').text.startsWith('movie_v')")
        page.keys("m")
        page.until("model('movie_status').text.includes('was stopped; no file is left')")
        assert sorted(file.name for file in wave.path.glob("*movie*")) == sorted(names[: 2 + there])


def test_a_line_of_a_result_that_grows_takes_the_new_frames_in(driver, tmp_path):
    store = ResultStore.create(tmp_path / "result", make_origin(6))
    for index in range(3):
        store.write_frame(index, smooth_record(index))
    with serving(store.path) as told:
        page = Page(driver, f"{told}?frame=1&field=u&line=line_1&marks=line:25,40;line:95,45")
        page.until("model('wave').data.image.length && model('wave').data.image[0].shape[1] === 3")
        for index in range(3, 6):
            store.write_frame(index, smooth_record(index))
        store.finish()
        page.until("model('wave').data.image[0].shape[1] === 6 && !model('line_status').visible")
        expected = read_profile(Maps.from_result(Result.open(store.path)), "u", (25, 40, 95, 45))
        np.testing.assert_allclose(
            array(page, "model('wave').data.image[0]"), expected.values.T.ravel(), rtol=1e-5, atol=1e-7
        )
