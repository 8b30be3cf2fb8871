"""Setting a test up: drawn regions, and TEST.toml with its comments."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from rgbmidic.errors import ConfigurationError
from rgbmidic.mesh import Region
from rgbmidic.settings import RegionSettings, read_section, read_test
from rgbmidic.view.address import Mark
from rgbmidic.view.draft import Draft, arranged, marks_of, region_of

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
    Draft.of(file).changed(changes).write()
    written = file.read_text(encoding="utf-8")
    for comment in ("# a test of the plate", "# as recorded", "# all of them", "# px"):
        assert comment in written
    assert tomllib.loads(written) == {
        "frames": {"path": "frames/*.tif", "kind": "monochrome", "first": 2},
        "region": {"polygon": polygon},
        "mesh": {"element_size": 30.0},
    }
    assert read_test(file).element_size == 30


def test_nothing_is_changed_by_no_change(tmp_path):
    file = tmp_path / "TEST.toml"
    file.write_text(TEXT, encoding="utf-8")
    assert Draft.of(file).changed({"mesh": {"element_size": 20}}).text == TEXT


def test_a_new_file_for_frames_is_whole_once_the_region_is_drawn(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    draft = Draft.of(tmp_path / "movie.cine")
    with pytest.raises(ConfigurationError, match="region"):
        draft.write()
    assert not draft.file.exists()
    draft.changed({"frames": {"kind": "monochrome"}, "region": {"rectangle": [0.0, 0.0, 9.0, 9.0]}}).write()
    assert read_test(tmp_path / "TEST.toml").frames.path == (str(tmp_path / "movie.cine"),)


@pytest.mark.parametrize(
    ("text", "told"),
    [("", "frames.path"), ("frames = 3", "frames.path"), ("[frames]\npath = 3", "frames.path"), ("[", "TOML")],
)
def test_a_file_that_says_nothing_of_the_frames_is_refused(tmp_path, text, told):
    file = tmp_path / "TEST.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError, match=told) as error:
        Draft.of(file)
    assert str(file) in str(error.value)


def test_drawn_shapes_are_the_region_that_is_read_again():
    marks = [Mark("polygon", 5, 5), Mark("polygon", 60.04, 5), Mark("polygon", 60, 50)]
    marks += [Mark("hole 1", 40, 10), Mark("hole 1", 50, 10), Mark("hole 1", 50, 20), Mark("hole 2", 1, 1)]
    content = region_of(marks)
    assert content == {
        "polygon": [[5, 5], [60, 5], [60, 50]],
        "holes": [[[40, 10], [50, 10], [50, 20]]],
    }
    region = read_section(RegionSettings, "region", content)
    assert region_of(marks_of(region)) == content


def test_a_round_hole_has_the_area_of_its_circle():
    marks = [Mark("rectangle", 90, 80), Mark("rectangle", 10, 10)]
    marks += [Mark("round hole 1", 50, 45), Mark("round hole 1", 70, 45)]
    content = region_of(marks)
    assert content["rectangle"] == [10, 10, 90, 80]
    region = Region.from_rectangle(content["rectangle"], (100, 100)).without(content["holes"])
    assert (81 * 71 - region.mask.sum()) == pytest.approx(np.pi * 20**2, rel=0.06)


def test_there_is_one_outline_of_the_kind_drawn_last():
    first = (Mark("polygon", 1, 1), Mark("polygon", 2, 2), Mark("hole 1", 3, 3))
    rectangle = arranged((*first, Mark("rectangle", 5, 5)), "rectangle")
    assert [mark.kind for mark in rectangle] == ["hole 1", "rectangle"]
    corners = (*rectangle, Mark("rectangle", 9, 9))
    assert arranged(corners, "rectangle") == corners
    assert arranged((*corners, Mark("rectangle", 20, 20)), "rectangle") == (first[2], Mark("rectangle", 20, 20))
    assert region_of(first) is None
