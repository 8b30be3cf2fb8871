"""Processor time that each stage of a frame takes, and the part of it that threads share.

The cases are those of `benchmarks.peers`, on one thread, the fastest of several runs; the stages those of
`rgbmidic run --timings`. The "rest" of a pair is the preparation of both states, which a sequence has done. What is
shared is the time in kernels; "bound" is how many times as fast two threads are if they halve it (Amdahl's law).
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rgbmidic import timing
from rgbmidic._kernels import threads

from . import peers
from .contenders import with_rgbmidic
from .tables import table


def stages(work: Callable[[], object], repeats: int) -> tuple[dict[str, float], dict[str, float]]:
    """Milliseconds of each stage, and those of its kernels, in the fastest of several runs after one that compiles."""
    shared, call = dict.fromkeys(timing.STAGES, 0.0), threads.Kernel.__call__

    def counted(kernel: threads.Kernel, *arguments: Any) -> Any:
        begin, found = time.process_time(), call(kernel, *arguments)
        if (on := timing._current.get()) is not None and kernel.over is not None:
            shared[on[0]] += time.process_time() - begin
        return found

    timing.time = SimpleNamespace(perf_counter=time.process_time)  # processor time, whatever else the machine does
    threads.Kernel.__call__, best = counted, (float("inf"), {}, {})
    work()
    for _ in range(repeats):
        shared.update(dict.fromkeys(shared, 0.0))
        with timing.record_stages() as seconds:
            work()
        best = min(best, (sum(seconds.values()), dict(seconds), dict(shared)), key=lambda one: one[0])
    threads.Kernel.__call__ = call
    taken, inside = ({name: 1e3 * value for name, value in part.items()} for part in best[1:])
    return taken, inside


@table("speed_stages", page="explanation/speed", cost=30, timing=True)
def speed_stages(quick: bool) -> Iterator[dict[str, object]]:
    """Processor time (ms) of the stages of a frame of 1024 x 1024 px on one thread, the fastest of three runs; the part
    that runs in parallel, and the largest possible speed-up by two threads."""
    cases = {"star": "grey pair"} | peers.FRAMES
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        peers.write_cases(folder, 160 if quick else peers.SIZE)
        for case in ("star",) if quick else cases:
            pair = peers.images(folder, "star")
            work: Callable[[], object] = (
                partial(with_rgbmidic, *pair, 1) if case == "star" else peers.raw_frame(folder / case)
            )
            taken, inside = stages(work, 1 if quick else 3)
            total, shared = sum(taken.values()), sum(inside.values())
            row: dict[str, object] = {"case": cases[case]} | {stage: taken[stage] for stage in timing.STAGES}
            yield row | {"sum": total, "shared [%]": 100 * shared / total, "bound": total / (total - shared / 2)}
