"""Marks that browser and server set at the same time, and what the page that sets a test up writes of them."""

from __future__ import annotations

import os
import random
from dataclasses import replace

import cv2
import numpy as np
import pytest
from bokeh.document import Document
from small_tests import grey_frame

from rgbmidic.frames.images import write_tiff
from rgbmidic.settings import read_test
from rgbmidic.tools.view.canvas import Canvas
from rgbmidic.tools.view.drawing import RegionDrawing, region_of
from rgbmidic.tools.view.marks import Mark
from rgbmidic.tools.view.setup import SetupPage
from rgbmidic.tools.view.setup_panel import DraftFrames
from rgbmidic.tools.view.test_file_editor import Confirmation, Draft

RECTANGLE = (Mark("rectangle", 10, 10), Mark("rectangle", 60, 60))
CORNERS = [[12.0, 10.0], [135.0, 12.0], [130.0, 105.0], [15.0, 100.0]]


class Browser:
    """Other end of a canvas: a message of either takes effect at the other when it is delivered."""

    def __init__(self, canvas):
        self.canvas, self.sent, self.coming = canvas, [], []
        self.data = self.copy(canvas.marks.data)
        self.taking = False
        canvas.marks.on_change("data", lambda attr, old, new: self.taking or self.coming.append(self.copy(new)))

    @staticmethod
    def copy(data):
        return {key: list(values) for key, values in data.items()}

    def draw(self, kind, x, y, name=""):
        mark = {"x": x, "y": y, "kind": kind, "name": name}
        for key, values in self.data.items():
            values.append(mark.get(key, 0))
        self.send()

    def send(self):
        self.sent.append(self.copy(self.data))

    def deliver_to_server(self):
        """As Bokeh does it: what the server sets meanwhile goes to the browser."""
        message, place = self.sent.pop(0), self.canvas.place_marks

        def placing(marks):
            self.taking = False
            place(marks)
            self.taking = True

        self.canvas.place_marks, self.taking = placing, True
        self.canvas.marks.data = message
        self.canvas.place_marks, self.taking = place, False

    def deliver_to_browser(self):
        self.data = self.copy(self.coming.pop(0))

    def settle(self):
        while self.sent or self.coming:
            (self.deliver_to_server if self.sent else self.deliver_to_browser)()

    @property
    def rows(self):
        return sorted(zip(*(self.data[key] for key in ("kind", "x", "y", "name")), strict=True))


def drawing_on(marks):
    document = Document()
    canvas = Canvas(document, ("rectangle", "polygon", "hole"), (0, 0, 150, 120), lambda: None)
    drawing = RegionDrawing(document, canvas, marks, lambda: None)
    return drawing, Browser(canvas)


def test_a_canvas_shows_what_was_asked_for_in_the_size_that_the_browser_reports():
    canvas = Canvas(Document(), ("point",), (0, 0, 150, 120), lambda: None)
    for name in ("inner_width", "inner_height"):
        canvas.plot.set_from_json(name, 300)
    assert (canvas.window.width, canvas.window.height) == (300, 300)
    assert canvas.window.edges == (0, -15, 150, 135)
    assert (canvas.plot.y_range.start, canvas.plot.y_range.end) == (135, -15)


@pytest.mark.parametrize("answered", [0, 1, 2, 3])
def test_corners_that_are_drawn_while_the_server_is_busy_stay(answered):
    """Four corners at once over a rectangle; so many are sent after an answer to the first has come."""
    drawing, browser = drawing_on(RECTANGLE)
    for number, corner in enumerate(CORNERS):
        if number == len(CORNERS) - answered:
            browser.deliver_to_server()
            browser.deliver_to_browser()
        browser.draw("polygon", *corner)
    browser.settle()
    assert region_of(drawing.marks) == {"polygon": CORNERS}
    assert browser.rows == sorted(("polygon", x, y, "") for x, y in CORNERS)


def test_a_step_that_is_undone_while_a_mark_is_drawn_takes_nothing_else_away():
    drawing, browser = drawing_on(RECTANGLE)
    browser.draw("hole", 20, 20)
    browser.settle()
    browser.draw("hole", 30, 20)
    drawing.step(back=True)
    browser.settle()
    assert [(mark.kind, mark.x) for mark in drawing.marks] == [("rectangle", 10), ("rectangle", 60), ("hole 1", 30)]
    assert [row[:2] for row in browser.rows] == [("hole 1", 30), ("rectangle", 10), ("rectangle", 60)]


def test_corners_of_a_hole_that_are_sent_again_stay_those_of_that_hole():
    drawing, browser = drawing_on(RECTANGLE)
    for x in (20, 30, 40):
        browser.draw("hole", x, 2 * x)
    for _ in range(3):
        browser.deliver_to_server()
    drawing.next_hole()
    browser.draw("hole", 50, 20)
    browser.settle()
    assert [mark.kind for mark in drawing.marks[2:]] == ["hole 1"] * 3 + ["hole 2"]


@pytest.mark.parametrize("seed", range(20))
def test_both_ends_have_every_mark_that_was_set_where_it_was_moved_to(seed):
    """Any order of setting, moving and removing at both ends, and of what each hears of the other."""
    choose, document = random.Random(seed), Document()
    canvas = Canvas(document, ("point",), (0, 0, 100, 100), lambda: None)
    browser, expected = Browser(canvas), {}
    for step in range(60):
        names = [at for at, name in enumerate(browser.data["name"]) if name in expected]  # not one shown once more
        act = choose.choice(["set", "move", "remove", "place", "hear", "hear", "answer"])
        if act == "set":
            expected[f"m{step}"] = (float(step), 0.0)
            browser.draw("point", float(step), 0.0, f"m{step}")
        elif act == "place":
            expected[f"m{step}"] = (float(step), 1.0)
            canvas.place_marks([*canvas.current_marks, Mark("point", float(step), 1.0, f"m{step}")])
        elif act == "move" and names:
            at = choose.choice(names)
            browser.data["y"][at] = float(step)
            browser.send()
            expected[browser.data["name"][at]] = (browser.data["x"][at], float(step))
        elif act == "remove" and names:
            at = choose.choice(names)
            expected.pop(browser.data["name"][at])
            for values in browser.data.values():
                values.pop(at)
            browser.send()
        elif act == "hear" and browser.sent:
            browser.deliver_to_server()
            canvas.place_marks(canvas.current_marks)
        elif act == "answer" and browser.coming:
            browser.deliver_to_browser()
    while browser.sent or browser.coming:
        if browser.sent:
            browser.deliver_to_server()
            canvas.place_marks(canvas.current_marks)
        else:
            browser.deliver_to_browser()
    assert {mark.name: (mark.x, mark.y) for mark in canvas.current_marks} == expected
    assert browser.rows == sorted(("point", x, y, name) for name, (x, y) in expected.items())


TEXT = """[frames]
path = "frame_*.tif"
kind = "monochrome"  # one lamp
lights = 2

[region]
rectangle = [10, 10, 60, 60]
"""


@pytest.fixture
def page(tmp_path):
    for index in range(2):
        write_tiff(tmp_path / f"frame_{index}.tif", grey_frame(1, (0.0, 0.0), noise_seed=index, shape=(120, 150)))
    (tmp_path / "TEST.toml").write_text(TEXT, encoding="utf-8")
    made = SetupPage(Document(), Draft.from_path(tmp_path / "TEST.toml"), [], dark=False)
    made.press = lambda: (made._run_guarded(made._write), made.controls.message.text)[1]
    return made


def test_write_states_what_was_written_and_refuses_what_would_be_left_out(page, tmp_path):
    browser, file = Browser(page.canvas), tmp_path / "TEST.toml"
    for corner in CORNERS[:2]:
        browser.draw("polygon", *corner)
    browser.settle()
    assert "the polygon needs 3 marks or more and has 2: finish or remove it" in page.press()
    assert file.read_text(encoding="utf-8") == TEXT
    page.drawing.take_marks(())
    assert "[region] is missing or empty" in page.press()
    assert file.read_text(encoding="utf-8") == TEXT
    for corner in CORNERS:
        browser.draw("polygon", *corner)
    browser.settle()
    assert page.press().endswith("is written, with a polygon as its region.")
    assert read_test(file).region.polygon == tuple(map(tuple, CORNERS))


def test_a_file_that_was_edited_meanwhile_is_replaced_only_when_asked_twice(page, tmp_path):
    file, edited = tmp_path / "TEST.toml", TEXT + "\n[solver]\nmax_iterations = 77\n"
    assert "is written" in page.press()
    file.write_text(edited, encoding="utf-8")
    assert "press again to replace it, which has another content than this page read" in page.press()
    assert file.read_text(encoding="utf-8") == edited
    file.write_bytes(edited.encode() + b"# \xe4\n")  # once more, in another encoding
    page.confirmation._pending = None
    assert "press again" in page.press()
    assert file.read_bytes() == edited.encode() + b"# \xe4\n"
    assert "is written" in page.press()
    assert "is written" in page.press()


def test_an_inspection_that_measures_no_node_is_reported_and_drawn(page):
    _, region, size = page._build_mesh()
    found = page.source.inspect(0, region, size)
    nothing = replace(found.prediction, std=np.full_like(found.prediction.std, np.nan))
    page._receive(lambda: replace(found, prediction=nothing), 0)
    assert "no node is measured" in page.controls.message.text
    assert page.canvas.bar.visible


def test_a_question_is_of_the_content_that_it_was_asked_about(tmp_path):
    file, confirmation = tmp_path / "a", Confirmation()
    file.touch()
    assert confirmation.question([file], "it")
    os.utime(file, ns=(0, 1))
    assert confirmation.question([file], "it")
    assert confirmation.question([file], "it") == ""


def test_masks_of_lights_of_any_names_have_files_of_their_own(page, monkeypatch, tmp_path):
    lights = ("rot-1", "rot 1", "красный", "红")
    monkeypatch.setattr(DraftFrames, "lights", lights)
    marks = [Mark(f"mask {n} {light}", 20 * n + x, y) for n, light in enumerate(lights, 1) for x, y in CORNER]
    page.drawing.take_marks((*RECTANGLE, *marks))
    assert "are written" in page.press()
    files = read_test(tmp_path / "TEST.toml").weights.images
    assert len(set(files)) == 4
    for n, file in enumerate(files, 1):
        columns = (cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) == 0).any(axis=0).nonzero()[0]
        assert 20 * n <= columns.min() < columns.max() <= 20 * n + 10


CORNER = ((0, 20), (10, 20), (10, 30), (0, 30))
