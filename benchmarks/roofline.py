"""Time per pixel of the kernels that a frame spends its time in, beside what the memory allows.

The bound is the time in which the memory moves a kernel's arrays once, at the bandwidth that numpy's copy of arrays of
64 MB reaches ("copy" is a triad without its product). Best of several runs on one thread, processor time; one light, 25
px elements, 1 % strain and a turn of 2 degrees; pixels are those of the region or of the image.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from rgbmidic._kernels.correlation import compare_states
from rgbmidic._kernels.illumination import unmix
from rgbmidic._kernels.splines import PAD, bspline_coefficients
from rgbmidic.correlation import Deformed, Reference
from rgbmidic.correlation.reference import warp_arguments
from rgbmidic.mesh import Region, Tri3Mesh

from .tables import table

_RUNS = 7
_COPIED = 1 << 24
"""Numbers of 4 bytes that are copied to tell the bandwidth."""


def best(work: Callable[[], object]) -> float:
    """Shortest time in s of several runs after one that compiles."""
    work()
    times = []
    for _ in range(_RUNS):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return min(times)


def bandwidth() -> float:
    """Bytes per second that are read or written when arrays are copied."""
    source, target = np.ones(_COPIED, np.float32), np.zeros(_COPIED, np.float32)
    return 8 * _COPIED / best(lambda: np.copyto(target, source))


def cases(size: int) -> list[tuple[str, int, int, Callable[[], object]]]:
    """Name, pixels, bytes of a pixel that are read or written, and the call of each kernel."""
    random = np.random.default_rng(0)
    image = random.uniform(0, 200, (1, size, size)).astype(np.float32)
    region = Region.from_rectangle((30, 30, size - 31, size - 31), (size, size))
    mesh = Tri3Mesh.from_region(region, 25)
    reference, deformed = Reference.prepare(image, region, mesh=mesh), Deformed.prepare(image)
    motion = (mesh.nodes - size / 2) @ np.array([[0.01, 0.035], [-0.035, 0.01]])
    owned, count, elements = reference.pixels.local_x.size, size * size, len(mesh.elements)
    difference, weight = np.empty((2, 1, owned), np.float32)
    values, weights, moments = reference.values, reference.pixel_weights, np.empty((1, elements, 6))
    coefficients = np.empty((size + 2 * PAD,) * 2, np.float32)
    there = warp_arguments(mesh, reference.pixels, motion)
    is_changed = np.zeros((1, elements), dtype=bool)
    states = deformed.coefficients, deformed.weights, values, weights, is_changed
    outputs = reference.pixels.offsets, difference, weight, moments
    channels, known = random.uniform(0, 200, (3, size, size)).astype(np.float32), np.ones((3, size, size), dtype=bool)
    lights, lit = np.empty_like(channels), np.empty_like(known)
    grid, needed = np.tile(np.eye(3, dtype=np.float32) + np.float32(0.1), (2, 2, 1, 1)), np.eye(3, dtype=bool)
    return [
        ("comparison of states", owned, 20, lambda: compare_states(*states, *there, *outputs)),
        ("right-hand side", owned, 24, lambda: reference.projected(weights, difference, reference.gradient)),
        ("Hessian", owned, 20, lambda: reference.hessians(weights)),
        ("spline coefficients", count, 16, lambda: bspline_coefficients(image[0], coefficients)),
        ("unmixing, 3 lights", count, 30, lambda: unmix(channels, known, grid, size, needed, lights, lit)),
    ]


@table("speed_kernels", page="explanation/speed", cost=2, timing=True)
def speed_kernels(quick: bool) -> Iterator[dict[str, object]]:
    """Time per pixel of the kernels on one thread, and relative to the time to move their arrays through the memory
    once."""
    speed = bandwidth()
    for name, count, size, work in cases(256 if quick else 1024):
        taken, bound = 1e9 * best(work) / count, 1e9 * size / speed
        yield {"kernel": name.replace(", ", " of "), "time [ns/px]": taken, "over the memory's": taken / bound}
