"""Time, memory and accuracy beside other DIC programs, in one run, alternating.

Every contender is a process of its own that lives as long as a case; in each round they take their turns, so that what
else the machine does meets all of them, and the best time counts: processor time, on one thread. All get the same
images, place their nodes or subset centres 25 px apart over the same region (pyALDIC 32: a power of two), and start
from zero. ``al-dic local`` is pyALDIC without its global step. The peers are installed in a Python of their own (they
bring opencv-python and PySide6): PEERS_PYTHON names it, `pip install ".[bench]"` fills it.

Grey pairs, for all contenders:

``star``: v = 0.5 cos(2 pi y / period) px with a period that grows from 100 to 300 px along x, noise of 1 DN.
``affine, 1 % noise``: 1 % strain and a turn of 2 degrees, noise of 2.55 DN (1 %): far motion.

Our own, beside three pairs of pyvale: ``raw``, the second frame of a raw Bayer series under three lights, from file to
record, with noise and crosstalk calibrated; ``calibrated``, with the registration of the lights besides, which the
frames then need; ``small``, 256 x 128 px of ``raw``. ``compiling``: what a first
`rgbmidic run` takes more than a second one.

Accuracy is over the points away from the edge.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.typing import AnyArray, FloatArray

from .contenders import CONTENDERS, MARGIN, Points, environment, peers_python
from .tables import table

SIZE, ROUNDS = 1024, 6
"""Side of the images (px), and timed rounds."""
TIMED = ("rgbmidic", "pyvale", "pyxel-dic", "al-dic", "al-dic local")
"""Contenders whose time is compared."""
PAIRS = {"star": "grey pair – waves of half a pixel", "affine, 1 % noise": "grey pair – 1 % and 2 deg – 1 % noise"}
FRAMES = {
    "raw": "raw frame – noise and crosstalk",
    "calibrated": "raw frame – registration as well",
    "small": "raw frame of 256 x 128 px",
}
_STRAIN, _TURN = 0.01, np.radians(2.0)


def star(x: FloatArray, y: FloatArray, size: int) -> FloatArray:
    """Displacement v of the star field at points of the reference image."""
    return np.asarray(0.5 * np.cos(2 * np.pi * (y - size / 2) / (100 + 200 * x / size)))


def turned(size: int) -> FloatArray:
    """Matrix of the affine motion about the middle of the image."""
    rotation = np.array([[np.cos(_TURN), -np.sin(_TURN)], [np.sin(_TURN), np.cos(_TURN)]])
    return rotation @ np.diag([1 + _STRAIN, 1 + _STRAIN])


def truth(case: str, points: FloatArray, size: int) -> FloatArray:
    """Displacement (n, 2) at points (n, 2)."""
    if case == "star":
        return np.stack([np.zeros(len(points)), star(*points.T, size)], axis=1)
    return (points - size / 2) @ (turned(size) - np.eye(2)).T


def speckle(x: FloatArray, y: FloatArray, seed: int = 0, waves: int = 150) -> FloatArray:
    """Grey levels 0 to 255 of a texture with spots of 4 px."""
    random = np.random.default_rng(seed)
    image = np.full(x.shape, 128.0)
    for a, b in random.normal(scale=0.42, size=(waves, 2)):
        image += 40 * np.sqrt(2 / waves) * np.cos(a * x + b * y + random.uniform(0, 2 * np.pi))
    return image


def pair(case: str, size: int, shift: FloatArray | float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Reference and deformed image without noise, of a light that sees each point `shift` (2, H, W) px farther."""
    x, y = np.mgrid[:size, :size][::-1].astype(float) - shift
    if case == "star":
        material = y.copy()
        for _ in range(30):
            material = y - star(x, material, size)
        return speckle(x, y), speckle(x, material)
    back = np.linalg.inv(turned(size))
    there = np.tensordot(back, np.stack([x, y]) - size / 2, axes=1) + size / 2
    return speckle(x, y), speckle(*there)


def noisy(image: FloatArray, deviation: float, seed: int) -> FloatArray:
    """The image with noise, in 8 bit where it has some."""
    if not deviation:
        return image
    noise = np.random.default_rng(seed).normal(scale=deviation, size=image.shape)
    return np.asarray(np.round(image + noise).clip(0, 255))


def write_cases(folder: Path, size: int) -> None:
    """The pairs of all cases and the raw series."""
    star_pair, affine = pair("star", size), pair("affine", size)
    np.savez(folder / "star.npz", *(noisy(image, 1.0, n) for n, image in enumerate(star_pair)))
    np.savez(folder / "affine.npz", *(noisy(image, 2.55, n) for n, image in enumerate(affine)))
    plain = np.stack([np.stack([image] * 3) for image in star_pair])
    write_raw_test(folder / "raw", 2, plain)
    write_raw_test(folder / "small", 2, plain[..., :128, :256])
    write_raw_test(folder / "calibrated", 2, *registered_states(size, plain))


def registered_states(size: int, plain: FloatArray) -> tuple[FloatArray, Any]:
    """The star pair (2, 3, H, W) as three lights through a lens see it, and their registration, as a lens has it."""
    from rgbmidic.illumination.images import Registration, frame_geometry

    centre, radius = frame_geometry((size, size))
    parameters = [[0.0] * 5, [0.6, -0.3, 3e-4, 8e-4, 3e-4], [-0.4, 0.5, -2e-4, -6e-4, -4e-4]]
    registration = Registration(
        lights=("red", "green", "blue"), parameters=np.array(parameters), centre=centre, radius=radius
    )
    points = np.mgrid[:size, :size][::-1].reshape(2, -1).T.astype(float)
    lights = [plain[:, 0]]
    for light in (1, 2):
        seen = points - registration.displacement(points)[light]  # rho is so smooth that once more is exact
        shift = registration.displacement(seen)[light].T.reshape(2, size, size)
        lights.append(np.stack(pair("star", size, shift)))
    return np.stack(lights, axis=1), registration


def write_raw_test(folder: Path, frames: int, states: FloatArray, registration: Any = None) -> None:
    """Raw Bayer frames that alternate between two states (2, 3, H, W), with calibration and TEST.toml."""
    from rgbmidic import Calibration
    from rgbmidic.frames.data import Mosaic
    from rgbmidic.frames.images import write_dng
    from rgbmidic.tools.lab.virtual import plate_scene, record

    folder.mkdir()
    scene = plate_scene()
    for number in range(frames + 1):
        lights = np.array([7.0, 6.0, 6.5])[:, None, None] * states[number % 2]
        frame = record(lights, scene.camera, scene.lights, seed=number)
        assert isinstance(frame, Mosaic)
        write_dng(folder / f"frame_{number:02d}.dng", frame)
    crosstalk = scene.camera.true_crosstalk(scene.lights)
    calibration = Calibration(crosstalk=crosstalk, noise=scene.camera.noise, registration=registration)
    calibration.write(folder / "calibration.json")
    right, bottom = states.shape[3] - 1 - MARGIN, states.shape[2] - 1 - MARGIN
    (folder / "TEST.toml").write_text(
        f'[frames]\npath = "*.dng"\n[calibration]\nfile = "calibration.json"\n'
        f"[region]\nrectangle = [{MARGIN}, {MARGIN}, {right}, {bottom}]\n"
    )


def raw_frame(folder: Path) -> Callable[[], Points]:
    """Measures the second frame of a raw series, whose reference is prepared, as a run does."""
    from rgbmidic import read_test
    from rgbmidic.correlation import TrackingState
    from rgbmidic.pipeline import Plan, measure_frame

    plan = Plan.from_settings(read_test(folder / "TEST.toml"))
    nodes = plan.reference.mesh.nodes

    def measure() -> Points:
        found = measure_frame(plan, 1, TrackingState(displacement=np.zeros_like(nodes)))
        return nodes + plan.window.origin, np.stack([found.u, found.v], axis=1)

    return measure


def compiling(test: Path) -> float:
    """Additional processor seconds of a first `rgbmidic run`, with an empty cache of kernels, compared with a second
    one."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": f"{folder}/kernels"}
        taken = [0.0]
        for out in ("first", "second"):
            command = [
                sys.executable,
                "-c",
                "from rgbmidic.cli.app import main; main()",
                "run",
                str(test),
                "--no-figures",
            ]
            subprocess.run([*command, "--out", f"{folder}/{out}"], check=True, env=environment, stdout=sys.stderr)
            used = resource.getrusage(resource.RUSAGE_CHILDREN)
            taken.append(used.ru_utime + used.ru_stime)
    return taken[1] - (taken[2] - taken[1])


def error(case: str, found: Points, size: int) -> float:
    """rms over the components of the error in px, away from the image's edge."""
    points, displacement = found
    inner = ((points > 2 * MARGIN) & (points < size - 2 * MARGIN)).all(axis=1) & np.isfinite(displacement).all(axis=1)
    return float(np.sqrt(np.mean((displacement - truth(case, points, size))[inner] ** 2)))


def peak_memory() -> float:
    """Largest memory of this process so far, MB; NaN: not known. (Of `resource` it is the parent's.)"""
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        return next(float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        return float("nan")


def serve(name: str, folder: Path, threads: int) -> None:
    """Answer each line, the name of a case, with the seconds, the error and so on in JSON."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what programs print is no answer
    measure = _measures(name, folder, threads)
    for line in sys.stdin:
        try:
            row = measure(line.strip())
        except Exception as failure:  # what a peer cannot do is a result, too
            row = {"failed": f"{type(failure).__name__}: {failure}"}
        print(json.dumps({**row, "memory": peak_memory()}), file=answers, flush=True)


def _measures(name: str, folder: Path, threads: int) -> Callable[[str], dict[str, Any]]:
    """What a contender measures of a case."""
    run = CONTENDERS[name]
    frame = cache(lambda case: raw_frame(folder / case))

    def measure(case: str) -> dict[str, Any]:
        work = frame(case) if case in FRAMES else partial(run, *images(folder, case), threads)
        begin = time.process_time()
        found = work()
        seconds = time.process_time() - begin
        size = len(images(folder, "star")[0])
        rms = error("affine" if case.startswith("affine") else "star", found, size)
        return {"seconds": seconds, "nodes": len(found[0]), "error": rms if case != "small" else float("nan")}

    return measure


def images(folder: Path, case: str) -> tuple[AnyArray, AnyArray]:
    """The pair of a case."""
    with np.load(folder / ("star.npz" if case == "star" else "affine.npz")) as kept:
        return kept["arr_0"], kept["arr_1"]


class Contender:
    """A process that measures what it is told."""

    def __init__(self, python: str, name: str, folder: Path) -> None:
        # in the temporary folder: some contenders leave files where they run
        self._process = subprocess.Popen(
            [python, "-m", "benchmarks.peers", name, str(folder)],
            env=environment(python), cwd=folder, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def measure(self, case: str) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            print(case, file=self._process.stdin, flush=True)
            return dict(json.loads(self._process.stdout.readline()))
        except (OSError, ValueError):
            return {"failed": "it died"}

    def close(self) -> None:
        self._process.kill()
        self._process.wait()


def compare(python: str, folder: Path, case: str, names: list[str], rounds: int) -> dict[str, dict[str, Any]]:
    """The best of several alternating runs of contenders, after one that warms up.

    Raises
    ------
    RuntimeError
        A contender cannot measure the case.
    """
    found: dict[str, dict[str, Any]] = {}
    contenders = {name: Contender(python, name, folder) for name in names}
    try:
        for turn in range(1 + rounds):
            for name, one in contenders.items():
                row = one.measure(case)
                if turn < 2 or row.get("seconds", np.inf) < found[name].get("seconds", np.inf):
                    found[name] = row
    finally:
        for one in contenders.values():
            one.close()
    if failed := {name: row["failed"] for name, row in found.items() if "failed" in row and name == "rgbmidic"}:
        raise RuntimeError(f"{case}: {failed}")
    return found


@table("speed_peers", page="explanation/speed", cost=130, timing=True)
def speed_peers(quick: bool) -> Iterator[dict[str, object]]:
    """Comparison with other programs in one run: processor seconds on one thread, best of three alternating runs, 1024
    x 1024 px."""
    python, names = (sys.executable, ["rgbmidic"]) if quick else peers_python(TIMED)
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        write_cases(folder, 160 if quick else SIZE)
        ours, rows = 0.0, []
        for case in ("star",) if quick else (*PAIRS, *FRAMES):
            able = names if case in PAIRS and not quick else ["rgbmidic"]
            for name, row in compare(python, folder, case, able, 1 if quick else ROUNDS).items():
                ours = row["seconds"] if name == "rgbmidic" else ours
                seconds = row.get("seconds", float("nan"))
                rows.append((PAIRS.get(case) or FRAMES[case], name, seconds, seconds / ours, row))
        for case, name, seconds, over, row in rows:
            yield {
                "case": case,
                "program": name,
                "time [s]": seconds,
                "over ours": over,
                "rms error [px]": row.get("error", float("nan")),
                "memory [MB]": row.get("memory", float("nan")),
            }
        if not quick:
            pyvale = next(seconds for case, name, seconds, *_ in rows if (case, name) == (PAIRS["star"], "pyvale"))
            for case in ("raw", "calibrated"):
                frame = next(seconds for text, _, seconds, *_ in rows if text == FRAMES[case])
                yield {
                    "case": FRAMES[case],
                    "program": "three pairs by pyvale",
                    "time [s]": 3 * pyvale,
                    "over ours": 3 * pyvale / frame,
                    "rms error [px]": float("nan"),
                    "memory [MB]": float("nan"),
                }


@table("speed_compiling", page="explanation/speed", cost=30, timing=True)
def speed_compiling(quick: bool) -> Iterator[dict[str, object]]:
    """Additional processor seconds of a first `rgbmidic run`, with an empty cache of kernels, compared with a second
    one."""
    if quick:  # what it takes does not depend on the size
        yield {"command": "rgbmidic run", "time [s]": float("nan")}
        return
    with tempfile.TemporaryDirectory() as folder:
        states = np.stack([np.stack([image] * 3) for image in pair("star", 256)])
        write_raw_test(Path(folder) / "test", 2, *registered_states(256, states))
        yield {"command": "rgbmidic run", "time [s]": compiling(Path(folder) / "test" / "TEST.toml")}


if __name__ == "__main__":
    serve(sys.argv[1], Path(sys.argv[2]), 1)
