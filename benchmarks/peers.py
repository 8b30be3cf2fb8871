"""Time, memory and accuracy beside other DIC programs, in one run, alternating; prints a table.

    pip install "rgbmidic[bench]"
    python benchmarks/peers.py [--size 1024] [--threads 2] [--repeats 3] [--base DIRECTORY] [--json FILE]

Every contender is a process of its own that lives through the run; in each round they take their turns, so that what
else the machine does meets all of them, and the best time counts. Absolute times depend on the machine: compare the
ratios. `--base` adds another checkout of rgbmidic as a contender. All get the same images, place their nodes or subset
centres 25 px apart over the same region, and start from zero.

``star``: v = 0.5 cos(2 pi y / period) px with a period that grows from 100 to 300 px along x, noise of 1 DN.
``affine``: 1 % strain and a turn of 2 degrees, without noise and with noise of 2.55 DN (1 %); ``affine, 3 lights``:
three noisy views of it together. ``raw``: the second frame of a raw Bayer series under three lights, from file to
record, beside three pairs of each peer. ``sequence``: the same in a series of which every frame moves by as much as
``star``, in as many processes as threads, its start left out; the seconds are those from one frame to the next.
Accuracy is over the points away from the edge; pyxel-dic has one thread only.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import io
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.typing import AnyArray, FloatArray

MARGIN, STEP = 30, 25
CONTENDERS = ("rgbmidic", "pyvale", "pyxel-dic")
CASES = ("star", "affine", "affine, 1 % noise")
TIMED = ("star", "raw")
FRAMES, STARTED = 24, 6
"""Cases run several times, the others once; frames of the sequence, and those after which its time counts."""
_STRAIN, _TURN = 0.01, np.radians(2.0)

Points = tuple[FloatArray, FloatArray]
"""Positions and displacements (n, 2) in px."""


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


def pair(case: str, size: int) -> tuple[FloatArray, FloatArray]:
    """Reference and deformed image without noise."""
    y, x = np.mgrid[:size, :size].astype(float)
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
    np.savez(folder / "affine.npz", *affine)
    for light in range(3):
        states = [noisy(image, 2.55, 2 * light + n) for n, image in enumerate(affine)]
        np.savez(folder / f"affine_{light}.npz", *states)
    write_raw_test(folder, *star_pair)


def write_raw_test(folder: Path, f: FloatArray, g: FloatArray) -> None:
    """Two raw Bayer frames of the pair under three lights, with calibration and TEST.toml."""
    from rgbmidic import Calibration
    from rgbmidic.frames.data import Mosaic
    from rgbmidic.frames.images import write_dng
    from rgbmidic.lab.virtual import plate_scene, record

    scene = plate_scene(size=len(f))
    for number in range(FRAMES + 1):
        image = (f, g)[number % 2]
        lights = np.stack([level * image for level in (7.0, 6.0, 6.5)])
        frame = record(lights, scene.camera, scene.lights, seed=number)
        assert isinstance(frame, Mosaic)
        write_dng(folder / f"frame_{number:02d}.dng", frame)
    crosstalk = scene.camera.true_crosstalk(scene.lights)
    Calibration(crosstalk=crosstalk, noise=scene.camera.noise).write(folder / "calibration.json")
    edge = len(f) - 1 - MARGIN
    (folder / "TEST.toml").write_text(
        f'[frames]\npath = "*.dng"\n[calibration]\nfile = "calibration.json"\n'
        f"[region]\nrectangle = [{MARGIN}, {MARGIN}, {edge}, {edge}]\n"
    )


def with_rgbmidic(f: AnyArray, g: AnyArray, threads: int) -> Points:
    from rgbmidic import correlate

    edge = f.shape[-1] - 1 - MARGIN
    found = correlate(f, g, region=(MARGIN, MARGIN, edge, edge), element_size=STEP)
    return found.nodes, found.displacement


def with_pyvale(f: AnyArray, g: AnyArray, threads: int) -> Points:
    from pyvale import dic  # type: ignore[import-untyped]

    size = len(f)
    mask = np.zeros(f.shape, dtype=bool)
    mask[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    with tempfile.TemporaryDirectory() as folder:
        dic.calculate_2d(
            *(image.round().astype(np.uint8) for image in (f, g)), mask, [size // 2, size // 2], subset_size=25,
            subset_step=STEP, max_displacement=32, num_threads=threads, output_basepath=folder, print_level=0,
        )  # fmt: skip
        found = dic.import_2d(str(next(Path(folder).glob("*.csv"))), layout="column", binary=False, delimiter=",")
    x, y, u, v = (np.asarray(p, dtype=float).ravel() for p in (found.ss_x, found.ss_y, found.u_px, found.v_px))
    return np.stack([x, y], axis=1), np.stack([u, v], axis=1)


def with_pyxel(f: AnyArray, g: AnyArray, threads: int) -> Points:
    import pyxel  # type: ignore[import-untyped]

    def image(pixels: AnyArray) -> Any:
        made = pyxel.Image("array")
        made.pix = pixels.copy()
        return made

    edge = len(f) - 1 - MARGIN
    with contextlib.redirect_stdout(io.StringIO()):
        mesh, camera = pyxel.MeshFromROI(np.array([[MARGIN, MARGIN], [edge, edge]]), [STEP, STEP], typel=2)
        mesh.Connectivity()
        found = np.asarray(pyxel.Correlate(image(f), image(g), mesh, camera, disp=False)[0])
    u, v = (found[mesh.conn[:, axis]] for axis in (0, 1))
    return np.stack([mesh.n[:, 0], -mesh.n[:, 1]], axis=1), np.stack([u, -v], axis=1)


def raw_frame(folder: Path) -> Callable[[], Any]:
    """Measures the second frame of the raw series, whose reference is prepared, as a run does."""
    from rgbmidic import read_test
    from rgbmidic.correlation import Start
    from rgbmidic.pipeline import Plan, measure_frame

    plan = Plan.from_settings(read_test(folder / "TEST.toml"))
    start = Start(displacement=np.zeros_like(plan.reference.mesh.nodes))
    return lambda: measure_frame(plan, 1, start)


def sequence(folder: Path, processes: int) -> float:
    """Seconds a frame of the raw series, measured as `rgbmidic run` does, without pictures."""
    from rgbmidic import measure, read_test

    times: list[float] = []
    with tempfile.TemporaryDirectory() as out:
        settings = read_test(folder / "TEST.toml")
        measure(
            settings, Path(out) / "result", workers=processes, progress=lambda *_: times.append(time.perf_counter())
        )
    return (times[-1] - times[STARTED]) / (len(times) - 1 - STARTED)


def error(case: str, found: Points, size: int) -> float:
    """rms over the components of the error in px, away from the image's edge."""
    points, displacement = found
    inner = ((points > 2 * MARGIN) & (points < size - 2 * MARGIN)).all(axis=1) & np.isfinite(displacement).all(axis=1)
    return float(np.sqrt(np.mean((displacement - truth(case, points, size))[inner] ** 2)))


def peak_memory() -> float:
    """Largest memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024**2 if sys.platform == "darwin" else 1024)


def serve(name: str, folder: Path, threads: int) -> None:
    """Answer each line, the name of a case or ``raw``, with the seconds and the error in JSON."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what programs print is no answer
    run = {"rgbmidic": with_rgbmidic, "pyvale": with_pyvale, "pyxel-dic": with_pyxel}[name]
    frame: Callable[[], Any] | None = None
    for line in sys.stdin:
        case = line.strip()
        row: dict[str, Any] = {}
        try:
            if case == "raw":
                frame = frame or raw_frame(folder)
                row["seconds"] = _time(frame)[0]
            elif case == "sequence":
                row["seconds"] = sequence(folder, threads)
            else:
                f, g = _images(folder, case)
                row["seconds"], found = _time(lambda f=f, g=g: run(f, g, threads))
                row |= {"nodes": len(found[0]), "error": error(case, found, f.shape[-1])}
        except Exception as failure:  # what a peer cannot do is a result, too
            row["failed"] = f"{type(failure).__name__}: {failure}"
        print(json.dumps({**row, "memory": peak_memory()}), file=answers, flush=True)


def _time(work: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of some work, and what it gives."""
    begin = time.perf_counter()
    found = work()
    return time.perf_counter() - begin, found


def _images(folder: Path, case: str) -> tuple[AnyArray, AnyArray]:
    if case == "affine, 3 lights":
        f, g = (np.stack(part) for part in zip(*(_stored(folder / f"affine_{n}.npz") for n in range(3)), strict=True))
        return f, g
    return _stored(folder / {"star": "star.npz", "affine": "affine.npz"}.get(case, "affine_0.npz"))


def _stored(file: Path) -> tuple[AnyArray, AnyArray]:
    with np.load(file) as kept:
        return kept["arr_0"], kept["arr_1"]


class Contender:
    """A process that measures what it is told."""

    def __init__(self, name: str, label: str, folder: Path, threads: int, path: str | None = None) -> None:
        self.name, self.label = name, label
        whole = os.pathsep.join([*([path] if path else []), *(str(Path(entry).resolve()) for entry in sys.path)])
        threading = dict.fromkeys(("RGBMIDIC_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads))
        command = [sys.executable, str(Path(__file__).resolve()), "--serve", name, str(folder), str(threads)]
        # in the temporary folder: some contenders leave files where they run
        self._process = subprocess.Popen(
            command, env={**os.environ, **threading, "PYTHONPATH": whole}, cwd=folder, text=True,
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


def installed(name: str) -> str | None:
    """Version of a package; None where it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "" if name == "rgbmidic" else None


def compare(folder: Path, size: int, threads: int, repeats: int, base: str | None) -> list[dict[str, Any]]:
    """The best of `repeats` alternating runs of every contender, after one that warms up, in the `TIMED` cases."""
    there = [
        (name, f"{name} {version}".strip(), None) for name in CONTENDERS if (version := installed(name)) is not None
    ]
    there += [("rgbmidic", f"rgbmidic in {base}", str(Path(base).resolve()))] if base else []
    contenders = [Contender(name, label, folder, threads, path) for name, label, path in there]
    rows = []
    try:
        for case in (*CASES, "affine, 3 lights", "raw", "sequence"):
            able = contenders if case in CASES else [one for one in contenders if one.name == "rgbmidic"]
            found: dict[str, dict[str, Any]] = {}
            for turn in range(1 + repeats if case in TIMED else 1):
                for one in able:
                    row = one.measure(case)
                    if turn < 2 or row.get("seconds", np.inf) < found[one.label].get("seconds", np.inf):
                        found[one.label] = row
            rows += [
                {"size": size, "threads": threads, "case": case, "contender": k, **row} for k, row in found.items()
            ]
    finally:
        for one in contenders:
            one.close()
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    own = {row["case"]: row.get("seconds", np.nan) for row in rows[::-1] if row["contender"].startswith("rgbmidic")}
    print(f"{'case':<18} {'contender':<32} {'s':>8} {'/ ours':>7} {'points':>7} {'rms error px':>13} {'peak MB':>8}")
    for row in rows:
        head = f"{row['case']:<18} {row['contender']:<32} "
        if "failed" in row:
            print(head + f"failed: {row['failed'][:90]}")
            continue
        print(
            head + f"{row['seconds']:>8.3f} {row['seconds'] / own[row['case']]:>7.2f} {row.get('nodes', ''):>7} "
            f"{row.get('error', np.nan):>13.5f} {row['memory']:>8.0f}"
        )
    for row in rows:
        if row["case"] == "star" and "seconds" in row and not row["contender"].startswith("rgbmidic"):
            alone, within = (3 * row["seconds"] / own[case] for case in ("raw", "sequence"))
            print(
                f"three pairs with {row['contender']} / ours: a raw frame {alone:.2f}, one of a sequence {within:.2f}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", type=int, nargs="+", default=[512, 1024, 2048], help="rows and columns of the images")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=3, help="timed rounds")
    parser.add_argument("--base", help="another checkout of rgbmidic that takes part")
    parser.add_argument("--json", type=Path, help="file for the table")
    arguments = parser.parse_args()
    rows = []
    for size in arguments.size:
        with tempfile.TemporaryDirectory() as name:
            write_cases(Path(name), size)
            for threads in arguments.threads:
                print(f"{size} x {size} px, {threads} threads, load {os.getloadavg()[0]:.1f}", flush=True)
                part = compare(Path(name), size, threads, arguments.repeats, arguments.base)
                show(part)
                rows += part
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]))
    else:
        main()
