"""What a script gives: of another kind it is refused in one line that says what is allowed; results show themselves."""

from __future__ import annotations

import html
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from textures import rigid_pair

from rgbmidic import Result, TestSettings, correlate, measure, measure_sequence
from rgbmidic.errors import InputError, RgbmidicError

IMAGE = np.zeros((80, 80))
SETTINGS = TestSettings.from_mapping({"frames": {"path": []}, "region": {"rectangle": [10, 10, 69, 69]}})
NOTHING: Any = object()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: correlate(IMAGE, IMAGE, element_size=NOTHING), "element_size must be a number of at least 4 px"),
        (lambda: correlate(IMAGE, IMAGE, element_size="auto"), '"auto" is for rgbmidic.measure'),  # type: ignore[arg-type]
        (lambda: correlate(np.zeros((80, 80, 3)), np.zeros((80, 80, 3))), "the lights come first: np.moveaxis"),
        (lambda: correlate(IMAGE, IMAGE, region="all"), "a rectangle is four finite numbers"),
        (lambda: correlate(IMAGE, IMAGE, initial="none"), "initial must be numbers"),
        (lambda: correlate(IMAGE, IMAGE, brightness="x"), "brightness must be a number or"),  # type: ignore[arg-type]
        (lambda: correlate(IMAGE, IMAGE, statistics=NOTHING), r"statistics must be an object that has precision\(\)"),
        (lambda: measure(NOTHING, "out"), "settings must be a TestSettings or the path of a TEST.toml"),
        (lambda: measure("none.toml", "out"), "none.toml"),
        (lambda: measure(SETTINGS, "out", separation=NOTHING), "separation must be an object that can be called"),
        (
            lambda: measure(SETTINGS, "out", weights=NOTHING),
            r"weights must be an object that has reference\(\) and def",
        ),
        (lambda: measure(SETTINGS, "out", mesh=NOTHING), "mesh must be a Tri3Mesh, not builtins.object"),
        (lambda: measure(SETTINGS, "out", region=NOTHING), "region must be a Region, not builtins.object"),
        (lambda: measure(SETTINGS, "out", frames=NOTHING), "frames must be a range"),
        (lambda: measure(SETTINGS, "out", workers=NOTHING), "workers must be a whole number"),
        (lambda: measure(SETTINGS, "out", progress=NOTHING), "progress must be an object that can be called"),
        (lambda: measure_sequence([IMAGE], NOTHING), "settings must be a TestSettings"),
        (lambda: measure_sequence([IMAGE], separation=NOTHING), "separation must be an object that can be called"),
    ],
)
def test_what_is_of_another_kind_is_refused_in_one_line(
    call: Callable[[], object], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RgbmidicError, match=words) as told:
        call()
    assert "\n" not in str(told.value)
    assert not [*tmp_path.iterdir()]


def test_results_show_what_they_are_and_frames_count_from_the_end(tmp_path: Path) -> None:
    images = np.stack([rigid_pair((80, 80), (0.0, 0.0))[0]] * 3).astype(np.float32)
    result = measure(SETTINGS, tmp_path / "out", source=images, workers=1)
    shown = repr(result).splitlines()
    assert shown[:2] == [f"<rgbmidic.Result {tmp_path / 'out'}>", "frames: 3"]
    assert len(shown) < 8
    assert repr(result.frame(-1)).startswith("<rgbmidic frame 2, converged; ")
    assert result.frame(-3).number == result.frame(0).number == 0
    for index in (3, -4, "x", None):
        with pytest.raises(InputError, match=r"there is no frame .* in a result of 3 frames \(0 to 2\)"):
            result.frame(index)  # type: ignore[arg-type]
    solution = correlate(images[0], images[1])
    assert repr(solution).startswith("<rgbmidic.Solution converged, ")
    assert len(repr(solution).splitlines()) < 8
    for one in (result, result.frame(0), solution):
        title, *lines = repr(one).splitlines()
        table = one._repr_html_()
        assert html.escape(title) in table
        assert table.count("<tr>") == len(lines)
        assert all(html.escape(line.partition(":")[2]) in table for line in lines)
    assert isinstance(Result.open(tmp_path / "out"), Result)
