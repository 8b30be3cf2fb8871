"""A test set up, written, run and watched in a real browser."""

from __future__ import annotations

import re
import threading
import tomllib

import numpy as np
import pytest
from small_tests import grey_frame
from viewer import MISSING, Page, chromium, click, serving

from rgbmidic.frames.images import write_tiff
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.pipeline.plan import read_region
from rgbmidic.results import Result
from rgbmidic.settings import read_test
from rgbmidic.tools.view.setup import SetupPage

pytestmark = pytest.mark.skipif(bool(MISSING), reason=MISSING)

SHAPE = (120, 150)
TEXT = """# the plate, second try
[frames]
path = "frame_*.tif"
kind = "monochrome"  # one lamp
white_level = 4095
black_level = 64

[region]
rectangle = [10, 10, 60, 60]
"""


@pytest.fixture
def test_file(tmp_path):
    for index in range(3):
        write_tiff(tmp_path / f"frame_{index}.tif", grey_frame(1, (0.3 * index, 0.0), noise_seed=index, shape=SHAPE))
    (tmp_path / "TEST.toml").write_text(TEXT, encoding="utf-8")
    return tmp_path / "TEST.toml"


def test_a_region_with_a_hole_is_drawn_written_run_and_watched(test_file, tmp_path):
    with chromium() as driver, serving(test_file) as address:
        page = Page(driver, address)
        assert "Frame 0 of 0 to 2: frame_0.tif" in page.run("model('description').text")
        page.do("model('frame').value = 2")
        page.until("model('description').text.includes('frame_2.tif')")
        page.do("model('mode').active = 2")
        corners = [(12, 10), (135, 12), (130, 105), (15, 100)]
        for number, corner in enumerate(corners, start=1):
            page.pointer(("click", *corner))
            page.until(f"model('marks').data.kind.filter((kind) => kind === 'polygon').length === {number}")
        page.do("model('hole').active = 0")
        for number, corner in enumerate([(60, 40), (90, 40), (90, 70)], start=1):
            page.pointer(("click", *corner))
            page.until(f"model('marks').data.kind.filter((kind) => kind === 'hole 1').length === {number}")
        page.pointer(("click", 20, 20))
        page.until("model('marks').data.kind.length === 8")
        page.driver.execute_script(*click("Undo"))
        page.until("model('marks').data.kind.length === 7")
        before = page.until("model('message').text.includes(' nodes, ') && model('message').text")
        page.do("model('size').value = 15")
        told = page.until(f"model('message').text !== {before!r} && model('message').text")
        page.driver.execute_script(*click("Write TEST.toml"))
        page.until("model('message').text.includes('is written')")
        written = test_file.read_text(encoding="utf-8")
        assert "# the plate, second try" in written
        assert "# one lamp" in written
        settings = read_test(test_file)
        np.testing.assert_allclose(settings.region.polygon, corners, atol=0.8)
        np.testing.assert_allclose(settings.region.holes, [[(60, 40), (90, 40), (90, 70)]], atol=0.8)
        assert tomllib.loads(written)["region"].keys() == {"polygon", "holes"}
        mesh = Tri3Mesh.from_region(read_region(settings.region, SHAPE), 15)
        assert told.startswith(f"{len(mesh.nodes)} nodes, {len(mesh.elements)} elements")
        page.do(f"model('out').value = {str(tmp_path / 'measured')!r}")
        page.driver.execute_script(*click("Run"))
        page.until("model('ran').text.includes('href')", patience=120)
        followed = Page(driver, f"{address}result")
        followed.until("model('head').text.includes('3 of 3 frames measured')", patience=120)
        followed.until("model('state').displayed_frame === 2")
        result = Result.open(tmp_path / "measured")
        np.testing.assert_array_equal(result.nodes, mesh.nodes)
        assert np.nanmedian(result.u[2]) == pytest.approx(0.6, abs=0.02)
        again = Page(driver, address)
        again.until("model('ran').text.includes('ended: 3 of 3 frames measured')")
        again.driver.execute_script(*click("Run"))
        again.until("model('ran').text.includes('failed: error: ')", patience=60)


def test_corners_that_are_drawn_while_the_server_makes_a_mesh_are_those_that_are_written(test_file, monkeypatch):
    busy, idle, make = threading.Event(), threading.Event(), SetupPage._make_mesh

    def slow(page):
        busy.set()
        idle.wait(30)
        make(page)

    with chromium() as driver, serving(test_file) as address:
        page = Page(driver, address)
        page.until("model('message').text.includes(' nodes, ')")
        page.do("model('mode').active = 2")
        monkeypatch.setattr(SetupPage, "_make_mesh", slow)
        page.do("model('size').value = 15")
        assert busy.wait(30)
        corners = [(12, 10), (135, 12), (130, 105), (15, 100)]
        for number, corner in enumerate(corners, start=3):
            page.pointer(("click", *corner))
            page.until(f"model('marks').data.kind.length === {number}")
        page.driver.execute_script(*click("Write TEST.toml"))
        idle.set()
        page.until("model('message').text.includes('is written, with a polygon as its region')")
        page.until("model('marks').data.kind.length === 4 && model('rings').data.xs[0].length === 5")
        np.testing.assert_allclose(read_test(test_file).region.polygon, corners, atol=0.8)
        assert read_test(test_file).mesh.element_size == 15


def test_what_the_frame_tells_is_shown_and_bad_input_is_told(test_file):
    with chromium() as driver, serving(test_file) as address:
        page = Page(driver, address)
        page.driver.execute_script(*click("Inspect"))
        page.until("model('picture').value === 'expected uncertainty'", patience=120)
        page.until("model('message').text.includes('uncertainty to expect')")
        assert re.findall("<figcaption>(.*?)</", page.run("model('tiles').text")) == ["raw frame", "light: light"]
        low, high = page.run("[model('colours').low, model('colours').high]")
        assert 0 < low < high < 0.1
        page.do("model('picture').value = 'light: light'")
        page.until("model('plot').title.text === 'light: light'")
        page.do("model('frame').value = 2")
        page.until("model('plot').title.text === 'light: light, of frame 0: frame_0.tif'")
        page.do("model('size').value = 15")
        page.until("model('plot').title.text === 'raw frame' && !model('message').text.includes('median uncertainty')")
        assert page.run("model('picture').options") == ["raw frame"]
        for name, value, words in (
            ("calibration", "none.json", "none.json"),
            ("file", "TEST.txt", "must end in .toml"),
            ("file", "/elsewhere/TEST.toml", "must stay in"),
        ):
            before = page.run(f"model('{name}').value")
            page.do(f"model('{name}').value = {value!r}")
            page.driver.execute_script(*click("Write TEST.toml"))
            page.until(f"model('message').text.includes({words!r})")
            page.do(f"model('{name}').value = {before!r}")
