"""In which order frames can be measured: each starts from an earlier one, whatever the number of workers.

The frames are the leaves of a tree of base `STRIDE`: a frame starts from the one before it, every 16th from the 16th
before, every 256th from the 256th before, and so on, so that chunks of consecutive frames can be measured side by side
once their key frame is, and any range of frames needs only some key frames of those before it. A key frame that is not
measured well from there is measured once more from the frame just before it, and the better of both is kept
(`rgbmidic.pipeline.engine`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

STRIDE = 16
"""Frames from one key frame to the next: so many workers are kept busy by one chain of key frames."""


def parent(position: int) -> int | None:
    """The frame that a frame starts from; None for the first."""
    return position - _step(position) if position else None


def is_key(position: int) -> bool:
    """Whether a frame starts from one that is not just before it."""
    return position > 0 and _step(position) > 1


def children(position: int, count: int) -> Iterator[int]:
    """The frames among `count` that start from a frame."""
    step = 1
    while position + step < count:
        if parent(position + step) == position:
            yield position + step
        step *= STRIDE


def lineage(position: int) -> Iterator[int]:
    """A frame, its parent, the parent of that, and so on to the first."""
    yield position
    while position:
        position -= _step(position)
        yield position


def dependants(places: Iterable[int], tries: Sequence[int]) -> set[int]:
    """The frames that depend on some, directly or through others, of a test with as many frames as `tries`.

    A frame depends on the one that it starts from; a key frame of 2 `tries` also on the one just before it.
    """
    found: set[int] = set()
    ahead = list(places)
    while ahead:
        place = ahead.pop()
        after = set(children(place, len(tries)))
        if place + 1 < len(tries) and tries[place + 1] > 1:
            after.add(place + 1)
        ahead += after - found
        found |= after
    return found


def _step(position: int) -> int:
    """The largest power of `STRIDE` that divides the position of a frame after the first."""
    step = 1
    while position % (step * STRIDE) == 0:
        step *= STRIDE
    return step
