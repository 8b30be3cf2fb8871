"""Names, steps, channels, scale and masks in a real browser: what is shown and written is what the library reads."""

from __future__ import annotations

from dataclasses import replace
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest
from results import MESH, NODES, make_origin, smooth_record
from small_tests import grey_frame
from viewer import MISSING, Page, chromium, click, serving

from rgbmidic.fields import Units
from rgbmidic.frames.images import write_tiff
from rgbmidic.mesh import Region
from rgbmidic.results import Result, ResultStore
from rgbmidic.results.histories import read_histories
from rgbmidic.settings import ChannelSettings, ProbeSettings, ScaleSettings, read_test
from rgbmidic.weights import MaskWeights

pytestmark = pytest.mark.skipif(bool(MISSING), reason=MISSING)

TEXT = """# the bar
[frames]
path = "x.cine"  # high speed
kind = "monochrome"

[region]
rectangle = [10, 5, 110, 75]
"""
LATE = 1.2345e-3
"""Seconds by which the recorder's clock is ahead of that of the frames."""


def course(seconds):
    return 1 / (1 + np.exp(-(seconds - 1e-3) / 2e-4))


@pytest.fixture
def result(tmp_path):
    """A bar that is stretched within a ms, its TEST.toml, and the force as a recorder has it."""
    (tmp_path / "TEST.toml").write_text(TEXT, encoding="utf-8")
    store = ResultStore.create(tmp_path / "result", make_origin(41, settings=read_test(tmp_path / "TEST.toml")))
    x, y = MESH.nodes.T
    for index in range(41):
        stretch = 0.02 * course(index * 5e-5)
        parts = {"u": stretch * (x - 60), "v": -0.3 * stretch * (y - 40), "nodal_exx": np.full(NODES, stretch)}
        record = smooth_record(index)
        values = {name: part.astype(record.values[name].dtype) for name, part in parts.items()}
        store.write_frame(index, replace(record, values={**record.values, **values, "time_ns": index * 50_000}))
    store.finish()
    seconds = np.arange(-1e-3, 6e-3, 1e-5)
    columns = np.column_stack([seconds, 12 * course(seconds - LATE), 5.0 * (seconds > LATE)])
    np.savetxt(tmp_path / "daq.csv", columns, "%.9g", ",", header="time_s,load_kN,ttl_V", comments="")
    return Result.open(store.path)


@pytest.fixture(scope="module")
def driver():
    with chromium() as one:
        yield one


def ends(page, kind):
    rows = page.run("(d => Array.from(d.kind).map((k, i) => [k, d.x[i], d.y[i], d.name[i]]))(model('marks').data)")
    return [(x, y) for mark, x, y, _ in rows if mark == kind]


def line(page, axis="ys"):
    return np.array(page.run(f"Array.from(model('lines').data.{axis}[0])"), dtype=float)


def test_a_name_is_undone_kept_in_address_and_csv_and_written_with_the_probe(driver, result):
    file = result.path.parent / "TEST.toml"
    with serving(result.path) as told:
        page = Page(driver, told)
        page.do("model('mode').active = 2")
        page.pointer(("click", 30, 40))
        page.pointer(("click", 90, 40))
        page.until("model('probe').value === 'gauge_1'")
        page.do("model('name').value = 'left grip'")
        page.until("model('probe').value === 'left grip' && model('lines').data.name[0] === 'left grip extension'")
        page.do("model('name').value = 'left_grip'")
        page.until("model('message').text.includes('left_grip') && model('name').value === 'left grip'")
        page.do("document.activeElement.blur()")
        modified(driver, "z")
        page.until("model('probe').value === 'gauge_1'")
        driver.execute_script(*click("Undo"))
        page.until("model('marks').data.x.length === 1")
        driver.execute_script(*click("Redo"))
        page.until("model('probe').value === 'gauge_1'")
        modified(driver, "y")
        page.until("model('lines').data.name[0] === 'left grip extension'")
        page.until("location.search.includes('left+grip')")
        assert parse_qs(urlsplit(driver.current_url).query)["marks"][0].split(";")[0].endswith(",left grip")
        page = Page(driver, driver.current_url)
        page.until("model('lines').data.name[0] === 'left grip extension'")
        script = "URL.createObjectURL = (blob) => { blob.text().then((t) => window.saved = t); return '#'; }"
        page.do(f"window.saved = ''; {script}")
        driver.execute_script(*click("Save CSV"))
        assert ",left grip_extension_px," in page.until("window.saved").splitlines()[0]
        driver.execute_script(*click("Write"))
        page.until("model('save_status').text.includes('TEST.toml exists: press again')")
        assert file.read_text(encoding="utf-8") == TEXT
        driver.execute_script(*click("Write"))
        page.until("model('save_status').text.includes('written')")
        stated = read_test(file).probes
        place = tuple(value for end in ends(page, "gauge") for value in end)
        np.testing.assert_allclose(stated.gauges, [place], atol=6e-4)
        assert stated.names == (("gauge_1", "left grip"),)
        text = file.read_text(encoding="utf-8")
        assert text.startswith("# the bar")
        assert "# high speed" in text
        driver.execute_script(*click("Clear"))
        page.until("model('marks').data.x.length === 0")
        driver.execute_script(*click("Take its probes"))
        page.until("model('lines').data.name[0] === 'left grip extension'")
        np.testing.assert_allclose(line(page), read_histories(result, stated)["left grip_extension"].values, atol=1e-9)
        for name, words in (("elsewhere.txt", "must end in .toml"), ("/other/TEST.toml", "and be in")):
            page.do(f"model('file').value = {name!r}")
            driver.execute_script(*click("Write"))
            page.until(f"model('save_status').text.includes({words!r})")
        page.do("model('file').value = 'new.toml'")
        driver.execute_script(*click("Write"))
        page.until("model('save_status').text.includes('new.toml is written')")
        assert read_test(file.with_name("new.toml")).probes == stated


def modified(driver, key):
    from selenium.webdriver.common.action_chains import ActionChains

    ActionChains(driver).key_down("\ue009").send_keys(key).key_up("\ue009").perform()


def test_channels_are_dragged_triggered_correlated_and_make_stress_over_strain(driver, result):
    folder = result.path.parent
    with serving(result.path) as told:
        page = Page(driver, f"{told}?frame=20&marks=gauge:30,40;gauge:90,40")
        page.until("model('lines').data.name[0] === 'gauge 1 extension'")
        page.do("model('channels').value = 'none.csv'")
        page.until("model('channel_status').text.includes('none.csv')")
        page.do("model('channels').value = 'daq.csv'; model('beside').value = 'load_kN'")
        page.until("model('recorded').data.xs.length === 1")
        page.until("model('curves_plot').below[0].axis_label === 'time (ms)'")
        page.do("model('drag').active = true")
        page.until("model('curves_plot').inner_width > 50")
        page.pointer(("press", 1.8, 0.6), ("move", 1.2, 0.6), ("release", 0.6, 0.6), plot="curves_plot")
        page.until("model('offset').value < -0.001")
        offset = page.run("model('offset').value")
        assert offset == pytest.approx(-1.2e-3, abs=2e-5)  # a pixel of the screen is 8 us
        xs, ys = (np.array(page.run(f"Array.from(model('recorded').data.{key}[0])")) for key in ("xs", "ys"))
        np.testing.assert_allclose(ys, 12 * course(1e-3 * xs - offset - LATE), atol=1e-6)
        settings = ProbeSettings(gauges=((30, 40, 90, 40),))
        page.do("model('drag').active = false; model('curve').value = 'load_kN'")

        def expected(**clock):
            channels = ChannelSettings(file=folder / "daq.csv", **clock)
            return read_histories(result, settings, channels=channels)

        def check(read):
            page.until(f"Math.abs(model('lines').data.ys[0][20] - {float(read['load_kN'].values[20])!r}) < 1e-6")
            np.testing.assert_allclose(line(page), read["load_kN"].values, atol=1e-9)

        check(expected(offset=offset))
        page.do("model('clock').value = 'trigger'; model('trigger').value = 'ttl_V'")
        check(expected(trigger="ttl_V"))
        page.do("model('clock').value = 'correlation'; model('align').value = 'load_kN'")
        page.do("model('align_to').value = 'gauge_1_strain'")
        found = expected(align=("load_kN", "gauge_1_strain"))
        check(found)
        assert found.channels.offset == pytest.approx(-LATE, abs=2e-6)
        page.do("model('area').value = 20")
        page.until("model('curve').options.includes('stress (MPa)')")
        page.do("model('along').value = 'gauge_1_strain'; model('curve').value = 'stress (MPa)'")
        page.until("model('lines').data.name[0] === 'stress' && model('lines').data.xs[0][40] < 0.03")
        found = expected(align=("load_kN", "gauge_1_strain"), area=20)
        np.testing.assert_allclose(line(page, "xs"), found["gauge_1_strain"].values, atol=1e-9)
        np.testing.assert_allclose(line(page), found["stress"].values, atol=1e-6)
        page.until("location.search.includes('along=')")
        page = Page(driver, driver.current_url)
        page.until("model('lines').data.name[0] === 'stress'")
        np.testing.assert_allclose(line(page), found["stress"].values, atol=1e-6)
        page.do("model('sections_to_write').active = [1]")
        driver.execute_script(*click("Write"))
        page.until("model('save_status').text.includes('press again')")
        driver.execute_script(*click("Write"))
        page.until("model('save_status').text.includes('is written')")
        stated = read_test(folder / "TEST.toml").channels
        assert stated == ChannelSettings(file=folder / "daq.csv", align=("load_kN", "gauge_1_strain"), area=20)
        assert 'file = "daq.csv"' in (folder / "TEST.toml").read_text(encoding="utf-8")


def test_two_points_of_a_distance_are_the_scale_of_the_page_and_of_the_file(driver, result):
    with serving(result.path) as told:
        page = Page(driver, f"{told}?frame=40&marks=gauge:30,40;gauge:90,40")
        page.until("model('lines').data.name[0] === 'gauge 1 extension'")
        page.do("model('scale').active = 1")
        page.pointer(("click", 20, 20))
        page.pointer(("click", 100, 20))
        page.until("model('marks').data.x.length === 4")
        page.do("model('distance').value = 40; model('distance_std').value = 0.1")
        page.until("model('plot').title.text === 'u (mm)' && model('curve').value === 'extension (mm)'")
        units = Units.from_points(ends(page, "scale"), 40, length_std=0.1)
        scale = ScaleSettings(mm_per_pixel=units.mm_per_pixel, mm_per_pixel_std=units.mm_per_pixel_std)
        page.until("model('plot').below[0].axis_label === 'x (mm)'")
        axis = "Bokeh.index.get_one(model('plot').below[0])"
        places = page.run(f"Array.from({axis}.tick_coords.major[0])")
        texts = page.run(f"{axis}.compute_labels({axis}.tick_coords.major[0]).items.map((one) => +one.text)")
        assert texts == pytest.approx(scale.mm_per_pixel * np.array(places), rel=1e-5, abs=1e-9)
        assert f"{texts[1] - texts[0]:e}"[0] in "125", "each a round number of mm farther"
        read = read_histories(result, ProbeSettings(gauges=((30, 40, 90, 40),)), scale=scale)
        last = float(read["gauge_1_extension"].values[40])
        page.until(f"Math.abs(model('lines').data.ys[0][40] - {last!r}) < 1e-6")
        page.do("model('sections_to_write').active = [2]")
        driver.execute_script(*click("Write"))
        page.until("model('save_status').text.includes('press again')")
        driver.execute_script(*click("Write"))
        page.until("model('save_status').text.includes('is written')")
        stated = read_test(result.path.parent / "TEST.toml").scale
        assert stated.mm_per_pixel == float(f"{units.mm_per_pixel:.6g}")
        assert stated.mm_per_pixel_std == float(f"{units.mm_per_pixel_std:.2g}")
        page.do("model('camera').value = 'none.json'")
        page.until("model('scale_label').text.includes('none.json')")


def test_masks_are_painted_undone_and_written_as_images_that_are_replaced_when_confirmed(driver, tmp_path):
    shape = (120, 150)
    for index in range(2):
        write_tiff(tmp_path / f"frame_{index}.tif", grey_frame(1, (0.3 * index, 0.0), noise_seed=index, shape=shape))
    text = TEXT.replace("x.cine", "frame_*.tif").replace("[region]", "lights = 2\n\n[region]")
    (tmp_path / "TEST.toml").write_text(text, encoding="utf-8")
    corners = [(20, 20), (60, 25), (50, 60)]
    with serving(tmp_path / "TEST.toml") as told:
        page = Page(driver, told)
        page.do("model('light').value = 'light 2'; model('hole').active = 2")
        for number, corner in enumerate(corners, start=1):
            page.pointer(("click", *corner))
            page.until(f"model('marks').data.kind.filter((kind) => kind === 'mask 1 light 2').length === {number}")
        page.until("model('rings').data.xs.length === 2")
        driver.execute_script(*click("Undo"))
        page.until("model('rings').data.xs.length === 1")
        driver.execute_script(*click("Redo"))
        page.until("model('rings').data.xs.length === 2")
        placed = ends(page, "mask 1 light 2")
        driver.execute_script(*click("Write TEST.toml"))
        page.until("model('message').text.includes('are written')")
        weights = read_test(tmp_path / "TEST.toml").weights
        assert [path.name for path in weights.images] == ["TEST_mask_1_light_1.png", "TEST_mask_2_light_2.png"]
        masks = np.asarray(MaskWeights.read(weights.images).masks)
        ring = [[round(x, 1), round(y, 1)] for x, y in placed]
        whole = Region.from_rectangle((0, 0, 149, 119), shape)
        np.testing.assert_array_equal(masks, [np.ones(shape), whole.without([ring]).mask])
        assert 600 < (masks[1] == 0).sum() < 900
        before = cv2.imread(str(weights.images[1]))
        page.pointer(("press", *placed[2]), ("move", 50, 70), ("release", 50, 80))
        page.until("Array.from(model('rings').data.ys[1]).some((y) => Math.abs(y - 80) < 2)")
        driver.execute_script(*click("Write TEST.toml"))
        page.until("model('message').text.includes('press again to replace')")
        np.testing.assert_array_equal(cv2.imread(str(weights.images[1])), before)
        driver.execute_script(*click("Write TEST.toml"))
        page.until("model('message').text.includes('are written')")
        assert (cv2.imread(str(weights.images[1])) == 0).sum() > (before == 0).sum()
