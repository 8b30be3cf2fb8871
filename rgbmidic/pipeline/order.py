"""The frame that each frame of a test starts from, and the frames that depend on it.

The frames are the leaves of a tree of base `STRIDE`, whatever the number of workers: a frame starts from the one before
it, every 16th from the 16th before, every 256th from the 256th before, and so on, so that chunks of consecutive frames
can be measured side by side once their key frame is, and any range of frames needs only some key frames of those before
it. A key frame that is not measured well from there is measured once more from the frame just before it, and the better
of both is kept (`rgbmidic.pipeline.engine`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

STRIDE = 16
"""Frames from one key frame to the next: so many workers are kept busy by one chain of key frames."""


def parent(position: int) -> int | None:
    """The frame that a frame starts from; None for the first."""
    if position == 0:
        return None
    step = 1
    while position % (step * STRIDE) == 0:
        step *= STRIDE
    return position - step


def is_key(position: int) -> bool:
    """Return whether a frame starts from one that is not just before it."""
    return position > 0 and position % STRIDE == 0


def dependants(positions: Iterable[int], tries: Sequence[int]) -> set[int]:
    """Some frames, and all that depend on them, directly or through others, of a test with as many as `tries`.

    A frame depends on the one that it starts from; a key frame of 2 `tries` also on the one just before it.
    """
    affected = set(positions)
    for position, try_count in enumerate(tries):
        if parent(position) in affected or (try_count > 1 and position - 1 in affected):
            affected.add(position)
    return affected
