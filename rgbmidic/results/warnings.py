"""Warnings of a test: those of frames in one line for each text, and those that a thread logs, collected."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager


def join_frame_warnings(texts: Iterable[tuple[int, Sequence[str]]], names: Sequence[str]) -> list[str]:
    """Join the warnings of frames that have the same text.

    Parameters
    ----------
    texts
        Index of each frame in its order, and its warnings.
    names
        Name of every frame.

    Returns
    -------
    list of str
        A line for each text, in the order of the first frame that has it: numbers of the frames, text.

    Examples
    --------
    >>> join_frame_warnings([(0, []), (1, ["dark"]), (2, ["dark", "late"]), (4, ["dark"])], ["a.png"] * 5)
    ['frames 1 to 2, 4 (a.png, ...): dark', 'frame 2 (a.png): late']
    """
    frames: dict[str, list[int]] = {}
    for frame, warnings in texts:
        for text in warnings:
            frames.setdefault(text, []).append(frame)
    lines = []
    for text, numbers in frames.items():
        frames_text = f"frame{'s' if len(numbers) > 1 else ''} {_ranges(numbers)}"
        name = f" ({names[numbers[0]]}{', ...' if len(numbers) > 1 else ''})"
        lines.append(f"{frames_text}{name if names[numbers[0]] != frames_text else ''}: {text}")
    return lines


def _ranges(numbers: Sequence[int], max_count: int = 12) -> str:
    """Write rising numbers as ranges, `max_count` of them."""
    ranges: list[list[int]] = []
    for number in numbers:
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    remainder = f" and {len(ranges) - max_count} more ranges" if len(ranges) > max_count else ""
    return (
        ", ".join(f"{first} to {last}" if last > first else f"{first}" for first, last in ranges[:max_count])
        + remainder
    )


class _Collector(logging.Handler):
    """Keeps what one thread logs."""

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[tuple[int, str]] = []
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:
            self.messages.append((record.levelno, self.format(record)))


@contextmanager
def collect_messages() -> Iterator[list[tuple[int, str]]]:
    """Collect level and text of what this thread logs through rgbmidic's loggers."""
    logger, handler = logging.getLogger("rgbmidic"), _Collector()
    logger.addHandler(handler)
    try:
        yield handler.messages
    finally:
        logger.removeHandler(handler)
