"""The order of frames: a tree in which every frame has one place, near to which little has to be measured before it."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rgbmidic.pipeline.engine import dependants, is_key, parent
from rgbmidic.pipeline.plan import STRIDE


def test_a_frame_starts_from_the_one_before_it_and_a_key_frame_from_the_key_frame_before() -> None:
    assert [parent(position) for position in (0, 1, 15, 16, 17, 32, 256, 272, 4096)] == [
        None, 0, 14, 0, 16, 16, 0, 256, 0,
    ]  # fmt: skip
    assert [position for position in range(40) if is_key(position)] == [16, 32]


@given(st.integers(1, 10**6))
def test_the_line_of_a_frame_goes_back_to_the_first_and_is_short(position: int) -> None:
    line = [position]
    while (before := parent(line[-1])) is not None:
        assert 0 <= before < line[-1]
        line.append(before)
    assert line[-1] == 0
    assert len(line) <= 1 + (STRIDE - 1) * 5


@given(st.data())
def test_what_depends_on_a_frame_starts_from_it_by_some_way(data: st.DataObject) -> None:
    tries = data.draw(st.lists(st.sampled_from([1, 1, 1, 2]), min_size=1, max_size=600))
    places = data.draw(st.sets(st.integers(0, len(tries) - 1), max_size=4))
    reached = set[int]()
    for place in range(1, len(tries)):  # what a frame starts from lies before it
        starts = {parent(place), place - 1} if tries[place] > 1 else {parent(place)}
        if starts & (reached | places):
            reached.add(place)
    assert dependants(places, tries) == reached | places
