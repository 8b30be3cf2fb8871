"""Processor time that each stage of a frame takes, and the part of it that threads share; prints a table.

    python benchmarks/stages.py [--size 1024 2048] [--cases star raw calibrated small] [--repeats 5] [--json FILE]

The cases are those of ``benchmarks/peers.py``, on one thread, the fastest of several runs; the stages those of
`rgbmidic run --timings`. The "rest" of a pair is the preparation of both states, which a sequence has done. What is
shared is the time in kernels; "bound" is how many times as fast two threads are if they halve it (Amdahl's law).
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2

from rgbmidic import timing
from rgbmidic._kernels import threads

from . import peers

PAIRS = ("star", "affine, 1 % noise")


def stages(work: Callable[[], object], repeats: int) -> tuple[dict[str, float], dict[str, float]]:
    """Milliseconds of each stage, and those of its kernels, in the fastest of several runs after one that compiles."""
    shared, share = dict.fromkeys(timing.STAGES, 0.0), threads._share

    def counted(*arguments: Any) -> None:
        begin = time.process_time()
        share(*arguments)
        clock = timing._clock.get()
        if clock is not None:
            shared[clock._on] += time.process_time() - begin

    timing.time = SimpleNamespace(perf_counter=time.process_time)  # processor time, whatever else the machine does
    threads._share, best = counted, (float("inf"), {}, {})
    work()
    for _ in range(repeats):
        shared.update(dict.fromkeys(shared, 0.0))
        with timing.timed() as seconds:
            work()
        best = min(best, (sum(seconds.values()), dict(seconds), dict(shared)), key=lambda one: one[0])
    threads._share = share
    taken, inside = ({name: 1e3 * value for name, value in part.items()} for part in best[1:])
    return taken, inside


def measured(folder: Path, case: str) -> Callable[[], object]:
    """The work of a case of ``benchmarks/peers.py``."""
    if case in PAIRS:
        return partial(peers.with_rgbmidic, *peers._images(folder, case), 1)
    return peers.raw_frame(folder / case)


def main() -> None:
    """Run the command line above."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", type=int, nargs="+", default=[1024], help="rows and columns of the images")
    parser.add_argument("--cases", nargs="+", default=["star", "raw", "calibrated", "small"], metavar="CASE")
    parser.add_argument("--repeats", type=int, default=5, help="timed runs")
    parser.add_argument("--json", type=Path, help="file for the rows")
    arguments = parser.parse_args()
    threads.set_threads(1)
    cv2.setNumThreads(1)
    rows: dict[str, Any] = {}
    print("| ms of processor time | " + " | ".join(timing.STAGES) + " | sum | shared | bound |")
    print("|---" * (len(timing.STAGES) + 4) + "|")
    with tempfile.TemporaryDirectory() as name:
        for size in arguments.size:
            folder = Path(name) / str(size)
            folder.mkdir()
            peers.write_cases(folder, size, arguments.cases)
            for case in arguments.cases:
                taken, inside = stages(measured(folder, case), arguments.repeats)
                total, shared = sum(taken.values()), sum(inside.values())
                each = " | ".join(f"{taken[stage]:.3g} ({inside[stage]:.2g})" for stage in timing.STAGES)
                bound = total / (total - shared / 2)
                print(f"| {case}, {size} px | {each} | {total:.4g} | {shared / total:.0%} | {bound:.2f} |", flush=True)
                rows[f"{case}, {size}"] = {"ms": taken, "shared": inside, "load": os.getloadavg()[0]}
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
