"""Time per pixel of the kernels that a frame spends its time in, beside what the memory allows; prints a table.

    python benchmarks/roofline.py [--size 1024] [--threads 1 2] [--json FILE]

The bound is the time in which the memory moves a kernel's arrays once, at the bandwidth that numpy's copy of arrays of
64 MB reaches with as many threads ("copy" is a triad without its product). Best of several runs; one light, 25 px
elements, 1 % strain and a turn of 2 degrees; pixels are those of the region or of the image.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np

from rgbmidic._kernels.illumination import unmix
from rgbmidic._kernels.interpolation import PAD, bspline_coefficients
from rgbmidic._kernels.threads import set_threads
from rgbmidic.correlation import Deformed, Reference
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.typing import FloatArray

_RUNS = 7
_COPIED = 1 << 24
"""Numbers of 4 bytes that are copied to tell the bandwidth."""


def best(work: Callable[[], object]) -> float:
    """Shortest time in s of several runs after one that compiles."""
    work()
    times = []
    for _ in range(_RUNS):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def bandwidth(threads: int) -> float:
    """Bytes per second that are read or written when arrays are copied."""
    source, target = np.ones(_COPIED, np.float32), np.zeros(_COPIED, np.float32)
    edges = np.linspace(0, _COPIED, threads + 1).astype(int)
    with ThreadPoolExecutor(threads) as pool:

        def copy() -> None:
            parts = [slice(*edge) for edge in pairwise(edges)]
            for _ in pool.map(lambda part: np.copyto(target[part], source[part]), parts):
                pass

        return 8 * _COPIED / best(copy)


def cases(size: int) -> list[tuple[str, int, int, Callable[[], object]]]:
    """Name, pixels, bytes of a pixel that are read or written, and the call of each kernel."""
    random = np.random.default_rng(0)
    image = random.uniform(0, 200, (1, size, size)).astype(np.float32)
    region = Region.from_rectangle((30, 30, size - 31, size - 31), (size, size))
    mesh = Tri3Mesh.from_region(region, 25)
    reference, deformed = Reference.prepare(image, region, mesh=mesh), Deformed.prepare(image)
    motion = (mesh.nodes - size / 2) @ np.array([[0.01, 0.035], [-0.035, 0.01]])
    owned, count, elements = reference.pixels.local_x.size, size * size, len(mesh.elements)
    difference, weight = np.empty((2, owned), np.float32)
    values, weights = reference.values[0], reference.pixel_weights[0]
    coefficients = np.empty((size + 2 * PAD,) * 2, np.float32)
    moments: FloatArray = np.empty((elements, 6))
    compared = values, motion, difference, weight, moments
    channels, known = random.uniform(0, 200, (3, size, size)).astype(np.float32), np.ones((3, size, size), dtype=bool)
    lights, lit = np.empty_like(channels), np.empty_like(known)
    grid, needed = np.tile(np.eye(3, dtype=np.float32) + np.float32(0.1), (2, 2, 1, 1)), np.eye(3, dtype=bool)
    return [
        ("right-hand side", owned, 20, lambda: reference.right_side(deformed, 0, values, weights, motion)),
        ("comparison", owned, 20, lambda: reference.warp(deformed, 0, *compared[:2], compared[2:])),
        ("Hessian", owned, 20, lambda: reference.blocks(weights, reference.gradient[:, 0])),
        ("spline coefficients", count, 16, lambda: bspline_coefficients(image[0], coefficients)),
        ("unmixing, 3 lights", count, 30, lambda: unmix(channels, known, grid, size, needed, lights, lit)),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", type=int, default=1024, help="rows and columns of the image")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--json", type=Path, help="file for the table")
    arguments = parser.parse_args()
    rows = []
    for threads in arguments.threads:
        set_threads(threads)
        speed = bandwidth(threads)
        print(f"{threads} threads, {speed / 1e9:.1f} GB/s, load {os.getloadavg()[0]:.1f}")
        print(f"{'kernel':<22} {'ns per px':>9} {'bound':>6} {'/ bound':>8}")
        for name, count, size, work in cases(arguments.size):
            taken, bound = 1e9 * best(work) / count, 1e9 * size / speed
            print(f"{name:<22} {taken:>9.2f} {bound:>6.2f} {taken / bound:>8.1f}")
            rows.append({"kernel": name, "threads": threads, "ns": taken, "bound": bound})
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
