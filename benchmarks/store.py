"""Time, size and memory of a result's store: many tiny frames, and fewer of a large mesh; prints two tables.

    python benchmarks/store.py [--frames 100000] [--large 500] [--folder DIR]

Frames hold noise, so nothing but plain pictures can be packed. Times are the processor's, so that a busy machine counts
little; the files were just written and are still in memory, where they fit: the disk's own speed comes on top.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.results import QUANTITIES, FrameRecord, Origin, Result, ResultStore

SMALL, LARGE = 16, 10_000
"""Nodes of a region of 32 x 32 px, and of a large one."""


def record_of(nodes: int, lights: int, side: int) -> FrameRecord:
    """A record of noise, with pictures of a weight that is 1 nearly everywhere."""
    random = np.random.default_rng(0)
    fields = {name: random.normal(size=nodes) for name, entry in QUANTITIES.items() if entry.axes == ("node",)}
    fields |= {"node_status": np.zeros(nodes), "light_fraction": random.random((nodes, lights))}
    picture = np.full((lights, side, side), 255, np.uint8)
    picture[:, : side // 4, : side // 4] = random.integers(0, 256, (lights, side // 4, side // 4))
    pictures = {"weights_thumbnail": picture, "reflection_thumbnail": picture}
    told = {"status": 0, "history": np.ones(5), "inputs": [["/data/test/shot_0001.cine", "ab" * 32]]}
    return FrameRecord.of(nodes=nodes, lights=lights, **fields, **pictures, **told)


def write(folder: Path, record: FrameRecord, frames: int) -> list[float]:
    """Write a result of copies of one record; gives the seconds of each."""
    nodes, lights = record.sizes["node"], record.sizes["light"]
    names = [f"shot_0001.cine frame {index}" for index in range(frames)]
    mesh = {"nodes": np.zeros((nodes, 2)), "elements": np.zeros((1, 3), dtype=np.int32)}
    origin = Origin(**mesh, names=names, lights=[f"light {index}" for index in range(lights)])
    times = []
    with ResultStore.create(folder, origin, overwrite=True) as store:
        for index in range(frames):
            started = time.process_time()
            store.write_frame(index, record)
            times.append(time.process_time() - started)
        row("finish", timed(store.finish)[0], "s")
    return times


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of the processor that it takes, and what it gives."""
    started = time.process_time()
    made = work()
    return time.process_time() - started, made


def row(what: str, value: float, unit: str) -> None:
    """A line of a table."""
    print(f"  {what:<44}{value:>10.3f} {unit}")


def stored(folder: Path) -> int:
    """Bytes of the frames."""
    return sum(file.stat().st_size for file in (folder / "solution").iterdir())


def memory() -> float:
    """Largest memory of the process so far in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def many(folder: Path, frames: int) -> None:
    """Frames of a few nodes, as many as a test can have."""
    print(f"{frames} frames of {SMALL} nodes, 1 light")
    row("memory before", memory(), "MB")
    times = write(folder, record_of(SMALL, 1, 8), frames)
    row("write, first thousand", 1e6 * float(np.mean(times[:1000])), "us a frame")
    row("write, last thousand", 1e6 * float(np.mean(times[-1000:])), "us a frame")
    row("size", stored(folder) / frames, "B a frame")
    seconds, result = timed(lambda: Result.open(folder))
    row("open", seconds, "s")
    row("refresh", timed(result.refresh)[0], "s")
    row("status over time", timed(lambda: result.stack("status"))[0], "s")
    row("u over time", timed(lambda: result.stack("u"))[0], "s")
    row("reason over time", timed(lambda: sum(map(len, result.each("reason"))))[0], "s")
    row("one frame in the middle", 1e6 * timed(lambda: result.frame(frames // 2))[0], "us")
    row("memory after", memory(), "MB")


def large(folder: Path, frames: int) -> None:
    """Frames of many nodes and three lights."""
    print(f"{frames} frames of {LARGE} nodes, 3 lights, two pictures of 256 x 256 px each")
    times = write(folder, record_of(LARGE, 3, 256), frames)
    size = stored(folder) / 1e6
    row("size", size / frames, "MB a frame")
    row("write", size / sum(times), "MB/s")
    row("write", 1e3 * float(np.median(times)), "ms a frame, median")
    row("memory", memory(), "MB")
    result = Result.open(folder)
    seconds = timed(lambda: [result.frame(index).status for index in range(frames)])[0]
    row("read all of every frame", size / seconds, "MB/s")
    seconds = timed(lambda: [None for _ in result.each("u")])[0]
    row("read u of every frame", 8e-6 * LARGE * frames / seconds, "MB/s")
    row("memory, nothing kept", memory(), "MB")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--large", type=int, default=500)
    parser.add_argument("--folder", type=Path, default=None, help="where the disk is that is meant")
    wanted = parser.parse_args()
    folder = Path(tempfile.mkdtemp(dir=wanted.folder))
    try:
        many(folder / "many", wanted.frames)
        large(folder / "large", wanted.large)
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
