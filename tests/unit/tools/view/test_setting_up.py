"""Setting a test up: drawn regions, and TEST.toml with its comments."""

from __future__ import annotations

import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rgbmidic.errors import ConfigurationError
from rgbmidic.mesh import Region
from rgbmidic.settings import ProbeSettings, ScaleSettings, read_section, read_test
from rgbmidic.tools.view.drawing import keep_one_outline, marks_of_region, masks_of, region_of
from rgbmidic.tools.view.marks import Mark
from rgbmidic.tools.view.panels import probe_section, scale_section
from rgbmidic.tools.view.setup import SetupPage
from rgbmidic.tools.view.setup_panel import SetupControls
from rgbmidic.tools.view.test_file_editor import Confirmation, Draft

TEXT = """# a test of the plate
[frames]  # as recorded
path = "frames/*.tif"   # all of them
kind = "monochrome"

[region]
rectangle = [10, 10,
             90, 90]  # without the clamps

[mesh]
element_size = 20  # px
"""


def test_a_file_keeps_its_comments_and_what_was_not_changed(tmp_path):
    file = tmp_path / "TEST.toml"
    file.write_text(TEXT, encoding="utf-8")
    polygon = [[1.0, 2.0], [50.0, 2.0], [50.0, 60.0]]
    changes = {
        "region": {"rectangle": None, "polygon": polygon},
        "mesh": {"element_size": 30.0},
        "frames": {"first": 2},
    }
    Draft.from_path(file).with_values(changes).write()
    written = file.read_text(encoding="utf-8")
    for comment in ("# a test of the plate", "# as recorded", "# all of them", "# px"):
        assert comment in written
    assert tomllib.loads(written) == {
        "frames": {"path": "frames/*.tif", "kind": "monochrome", "first": 2},
        "region": {"polygon": polygon},
        "mesh": {"element_size": 30.0},
    }
    assert read_test(file).mesh.element_size == 30


def test_a_size_that_the_run_finds_is_kept_unless_it_is_changed(tmp_path):
    file = tmp_path / "TEST.toml"
    file.write_text(TEXT.replace("= 20", '= "auto"'), encoding="utf-8")
    controls = SetupControls(Draft.from_path(file), 4, tmp_path / "out", dark=False)
    page = SimpleNamespace(controls=controls, draft=Draft.from_path(file), drawing=SimpleNamespace(marks=[]))
    page.source = SimpleNamespace(series=range(5))
    assert controls["size"].value == 25
    assert SetupPage._edited_draft(page).section("mesh")["element_size"] == "auto"
    controls["size"].value = 30
    assert SetupPage._edited_draft(page).section("mesh")["element_size"] == 30


def test_a_reference_of_several_frames_is_stated_and_kept_unless_it_is_changed(tmp_path):
    file = tmp_path / "TEST.toml"
    file.write_text(TEXT.replace('"monochrome"', '"monochrome"\nreference = "1:4"'), encoding="utf-8")
    controls = SetupControls(Draft.from_path(file), 4, tmp_path / "out", dark=False)
    page = SimpleNamespace(controls=controls, draft=Draft.from_path(file), drawing=SimpleNamespace(marks=[]))
    page.source = SimpleNamespace(series=range(5))
    assert (controls["reference"].title, controls["reference"].value) == ("Reference, 3 from", 1)
    assert SetupPage._edited_draft(page).frames.reference == (1, 2, 3)
    controls["reference"].value = 2
    assert controls["reference"].title == "Reference"
    assert SetupPage._edited_draft(page).frames.reference == (2,)


def test_nothing_is_changed_by_no_change(tmp_path):
    file = tmp_path / "TEST.toml"
    file.write_text(TEXT, encoding="utf-8")
    assert Draft.from_path(file).with_values({"mesh": {"element_size": 20}}).text == TEXT


def test_a_new_file_for_frames_is_whole_once_the_region_is_drawn(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    draft = Draft.from_path(tmp_path / "movie.cine")
    with pytest.raises(ConfigurationError, match="region"):
        draft.write()
    assert not draft.file.exists()
    draft.with_values({"frames": {"kind": "monochrome"}, "region": {"rectangle": [0.0, 0.0, 9.0, 9.0]}}).write()
    assert read_test(tmp_path / "TEST.toml").frames.path == (str(tmp_path / "movie.cine"),)


@pytest.mark.parametrize(
    ("text", "told"),
    [("", "frames.path"), ("frames = 3", "frames.path"), ("[frames]\npath = 3", "frames.path"), ("[", "TOML")],
)
def test_a_file_that_says_nothing_of_the_frames_is_refused(tmp_path, text, told):
    file = tmp_path / "TEST.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError, match=told) as error:
        Draft.from_path(file)
    assert str(file) in str(error.value)


def test_drawn_shapes_are_the_region_that_is_read_again():
    marks = [Mark("polygon", 5, 5), Mark("polygon", 60.04, 5), Mark("polygon", 60, 50)]
    marks += [Mark("hole 1", 40, 10), Mark("hole 1", 50, 10), Mark("hole 1", 50, 20), Mark("hole 2", 1, 1)]
    content = region_of(marks)
    assert content == {
        "polygon": [[5, 5], [60, 5], [60, 50]],
        "holes": [[[40, 10], [50, 10], [50, 20]]],
    }
    draft = Draft(file=Path("TEST.toml"), text="").with_values({"region": content})
    assert region_of(marks_of_region(draft.section("region"), draft.file.parent)) == content


def test_a_round_hole_has_the_area_of_its_circle():
    marks = [Mark("rectangle", 90, 80), Mark("rectangle", 10, 10)]
    marks += [Mark("round hole 1", 50, 45), Mark("round hole 1", 70, 45)]
    content = region_of(marks)
    assert content["rectangle"] == [10, 10, 90, 80]
    region = Region.from_rectangle(content["rectangle"], (100, 100)).without(content["holes"])
    assert (81 * 71 - region.mask.sum()) == pytest.approx(np.pi * 20**2, rel=0.06)


def test_there_is_one_outline_of_the_kind_drawn_last():
    first = (Mark("polygon", 1, 1), Mark("polygon", 2, 2), Mark("hole 1", 3, 3))
    rectangle = keep_one_outline((*first, Mark("rectangle", 5, 5)), "rectangle")
    assert [mark.kind for mark in rectangle] == ["hole 1", "rectangle"]
    corners = (*rectangle, Mark("rectangle", 9, 9))
    assert keep_one_outline(corners, "rectangle") == corners
    assert keep_one_outline((*corners, Mark("rectangle", 20, 20)), "rectangle") == (first[2], Mark("rectangle", 20, 20))
    assert region_of(first) is None


def test_probes_written_leave_those_that_the_page_cannot_set(tmp_path):
    file = tmp_path / "TEST.toml"
    probes = (
        '[probes]\nwindow = 9 # short\ncracks = [1, 2, 3, 4]\nnames = [["crack_1", "notch"]]\nlines = [1, 2, 3, 4]\n'
    )
    file.write_text(TEXT + probes, encoding="utf-8")
    draft = Draft.from_path(file)
    made = ProbeSettings(points=((1.23456, 2),), names=(("point_1", "tip"),))
    draft.with_values({"probes": probe_section(draft, made)}).write()
    stated = read_test(file).probes
    assert stated.points == ((1.235, 2),)
    assert stated.lines == ()
    assert stated.cracks == ((1, 2, 3, 4),)
    assert stated.names == (("crack_1", "notch"), ("point_1", "tip"))
    assert "window = 9 # short" in file.read_text(encoding="utf-8")


def test_a_scale_or_camera_replaces_the_other_and_keeps_the_frame_rate(tmp_path):
    file = tmp_path / "TEST.toml"
    file.write_text(TEXT + '[scale]\ncamera = "camera.json"\nframe_rate = 1e4\n', encoding="utf-8")
    draft = Draft.from_path(file)
    scale = scale_section(draft, ScaleSettings(mm_per_pixel=0.12345678, mm_per_pixel_std=0.00123))
    assert read_section(ScaleSettings, "scale", draft.with_values({"scale": scale}).section("scale")) == ScaleSettings(
        mm_per_pixel=0.123457, mm_per_pixel_std=0.0012, frame_rate=1e4
    )
    other = scale_section(draft, ScaleSettings(camera=tmp_path / "b.json"))
    assert draft.with_values({"scale": other}).section("scale") == {"camera": "b.json", "frame_rate": 1e4}
    with pytest.raises(ConfigurationError, match="set two points"):
        scale_section(draft, None)


def test_what_exists_is_asked_for_again_when_it_changes(tmp_path):
    file, confirmation = tmp_path / "a", Confirmation()
    assert confirmation.question([file], "it") == ""
    file.touch()
    assert "press again to replace it" in confirmation.question([file], "it")
    assert "press again to replace more" in confirmation.question([file], "more")
    assert confirmation.question([file], "more") == ""
    assert "press again" in confirmation.question([file], "more")


def test_masks_of_a_light_that_there_is_not_are_refused():
    marks = [Mark("mask 1 red", 2, 2), Mark("mask 1 red", 8, 2), Mark("mask 1 red", 8, 8), Mark("mask 2 blue", 1, 1)]
    assert masks_of(marks) == {"red": [[[2, 2], [8, 2], [8, 8]]]}
    assert region_of([Mark("rectangle", 0, 0), Mark("rectangle", 9, 9), *marks]) == {"rectangle": [0, 0, 9, 9]}
    with pytest.raises(ConfigurationError, match="mask of red, but the lights are green, blue"):
        Draft(file=Path("TEST.toml"), text="").with_masks(marks, ("green", "blue"), (10, 10))
