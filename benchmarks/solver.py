"""Time, memory and accuracy of the solve, beside other DIC programs where they are installed; prints two tables.

    python benchmarks/solver.py [--size 1024] [--repeats 3]

Every contender runs in a process of its own, twice or more after a first run that compiles and fills caches; the best
time counts. Absolute times depend on the machine: compare the ratios. The pair is a star field, v = 0.5 cos(2 pi y /
period) px with a period that grows from 100 to 300 px along x, exactly rendered, with noise of 1 DN. All start from
zero.
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

from rgbmidic.typing import FloatArray

MARGIN, STEP = 30, 25
CONTENDERS = ("rgbmidic", "pyvale", "pyxel-dic")


def star(x: FloatArray, y: FloatArray, size: int) -> FloatArray:
    """v in px at points of the reference image."""
    return np.asarray(0.5 * np.cos(2 * np.pi * (y - size / 2) / (100 + 200 * x / size)))


def speckle(x: FloatArray, y: FloatArray, waves: int = 150) -> FloatArray:
    """Grey levels 0 to 255 of a texture with spots of 4 px."""
    random = np.random.default_rng(0)
    image = np.full(x.shape, 128.0)
    for a, b in random.normal(scale=0.42, size=(waves, 2)):
        image += 40 * np.sqrt(2 / waves) * np.cos(a * x + b * y + random.uniform(0, 2 * np.pi))
    return image


def star_pair(size: int) -> tuple[FloatArray, FloatArray]:
    """Reference and deformed image without noise."""
    y, x = np.mgrid[:size, :size].astype(float)
    material = y.copy()
    for _ in range(30):
        material = y - star(x, material, size)
    return speckle(x, y), speckle(x, material)


def best_time(work: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Shortest wall time in s after a first run, and the last result."""
    work()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        result = work()
        times.append(time.perf_counter() - begin)
    return min(times), result


def rms_error(points: FloatArray, v: FloatArray, size: int) -> float:
    """rms error of v in px over the points away from the image's edge."""
    inner = ((points > 2 * MARGIN) & (points < size - 2 * MARGIN)).all(axis=1) & np.isfinite(v)
    error = v - star(points[:, 0], points[:, 1], size)
    return float(np.sqrt(np.mean(error[inner] ** 2)))


def run_rgbmidic(f: FloatArray, g: FloatArray, threads: int, repeats: int) -> tuple[float, int, float]:
    from rgbmidic import correlate

    size = len(f)
    region = (MARGIN, MARGIN, size - 1 - MARGIN, size - 1 - MARGIN)
    seconds, found = best_time(lambda: correlate(f, g, region=region, initial=(0, 0), element_size=STEP), repeats)
    return seconds, len(found.nodes), rms_error(found.nodes, found.displacement[:, 1], size)


def run_pyvale(f: FloatArray, g: FloatArray, threads: int, repeats: int) -> tuple[float, int, float]:
    from pyvale import dic  # type: ignore[import-untyped]

    size = len(f)
    images = f.astype(np.uint8), g.astype(np.uint8)
    mask = np.zeros(f.shape, dtype=bool)
    mask[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    with tempfile.TemporaryDirectory() as folder:

        def work() -> None:
            dic.calculate_2d(
                *images, mask, [size // 2, size // 2], subset_size=25, subset_step=STEP, max_displacement=8,
                num_threads=threads, output_basepath=folder, print_level=0,
            )  # fmt: skip

        seconds, _ = best_time(work, repeats)
        found = dic.import_2d(str(next(Path(folder).glob("*.csv"))), layout="column", binary=False, delimiter=",")
    x, y, v = (np.asarray(part, dtype=float).ravel() for part in (found.ss_x, found.ss_y, found.v_px))
    return seconds, len(x), rms_error(np.stack([x, y], axis=1), v, size)


def run_pyxel(f: FloatArray, g: FloatArray, threads: int, repeats: int) -> tuple[float, int, float]:
    import pyxel  # type: ignore[import-untyped]

    size = len(f)

    def image(pixels: FloatArray) -> Any:
        made = pyxel.Image("array")
        made.pix = pixels.copy()
        return made

    def work() -> tuple[Any, Any]:
        corners = np.array([[MARGIN, MARGIN], [size - 1 - MARGIN, size - 1 - MARGIN]])
        mesh, camera = pyxel.MeshFromROI(corners, [STEP, STEP], typel=2)
        mesh.Connectivity()
        return mesh, pyxel.Correlate(image(f), image(g), mesh, camera, disp=False)[0]

    with contextlib.redirect_stdout(io.StringIO()):
        seconds, (mesh, found) = best_time(work, repeats)
    points = np.stack([mesh.n[:, 0], -mesh.n[:, 1]], axis=1)
    return seconds, len(points), rms_error(points, -np.asarray(found)[mesh.conn[:, 1]], size)


def write_raw_test(folder: Path, f: FloatArray, g: FloatArray) -> None:
    """Two raw Bayer frames of the pair under three lights, with calibration and TEST.toml."""
    from rgbmidic import Calibration
    from rgbmidic.frames.data import Mosaic
    from rgbmidic.frames.writers import write_dng
    from rgbmidic.lab.virtual import plate_scene, record

    scene = plate_scene(size=len(f))
    for number, image in enumerate((f, g)):
        lights = np.stack([level * image for level in (7.0, 6.0, 6.5)])
        frame = record(lights, scene.camera, scene.lights, seed=number)
        assert isinstance(frame, Mosaic)
        write_dng(folder / f"frame_{number}.dng", frame)
    crosstalk = scene.camera.true_crosstalk(scene.lights)
    Calibration(crosstalk=crosstalk, noise=scene.camera.noise).write(folder / "calibration.json")
    edge = len(f) - 1 - MARGIN
    (folder / "TEST.toml").write_text(
        f'[frames]\npath = "*.dng"\n[calibration]\nfile = "calibration.json"\n'
        f"[region]\nrectangle = [{MARGIN}, {MARGIN}, {edge}, {edge}]\n"
    )


def run_file(folder: Path, repeats: int) -> dict[str, Any]:
    """From a raw frame's file to its displacement, step by step; the reference is prepared once before."""
    from rgbmidic import read_test
    from rgbmidic.correlation import Deformed, Start, track
    from rgbmidic.pipeline import Plan, correlated

    imports = peak_memory()
    settings = read_test(folder / "TEST.toml")
    plan = Plan.from_settings(settings)
    start = Start(displacement=np.zeros_like(plan.reference.mesh.nodes))
    steps = dict[str, list[float]]()

    def frame() -> Any:
        clock = [time.perf_counter()]

        def lap(name: str) -> None:
            clock.append(time.perf_counter())
            steps.setdefault(name, []).append(clock[-1] - clock[-2])

        raw = plan.series.read(1)
        lap("read")
        images = plan.separation(raw)
        lap("linearise, demosaic, unmix")
        ready, weights = correlated(images, settings.illumination), plan.weights.deformed(images, 1)
        lap("normalise, weights")
        deformed = Deformed.prepare(ready, weights, prefilter="binomial")
        lap("prefilter, spline")
        solution = track(plan.reference, deformed, start, settings.solver)
        lap("solve, uncertainty")
        return solution

    seconds, found = best_time(frame, repeats)
    return {
        "seconds": seconds,
        "nodes": len(found.nodes),
        "iterations": found.iterations,
        "error": rms_error(found.nodes, found.displacement[:, 1], len(plan.reference.images[0])),
        "steps": {name: min(times[1:]) for name, times in steps.items()},
        "imports": imports,
    }


def peak_memory() -> float:
    """Largest memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024**2 if sys.platform == "darwin" else 1024)


def installed(name: str) -> str | None:
    """Version of a package; None where it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "this" if name == "rgbmidic" else None


def in_own_process(what: str, folder: Path, threads: int, repeats: int) -> dict[str, Any]:
    """Run one contender in a fresh process; a failure is a result too."""
    path = os.pathsep.join(str(Path(entry).resolve()) for entry in sys.path)
    threading = {"RGBMIDIC_THREADS": str(threads), "OMP_NUM_THREADS": str(threads)}
    environment = {**os.environ, **threading, "PYTHONPATH": path}
    command = [sys.executable, str(Path(__file__).resolve()), "--child", what, str(folder), str(threads), str(repeats)]
    # in the temporary folder: some contenders leave files where they run
    done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"failed": (done.stderr.strip().splitlines() or ["no message"])[-1]}
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def child(what: str, folder: Path, threads: int, repeats: int) -> None:
    if what == "file":
        result = run_file(folder, repeats)
    else:
        pair = np.load(folder / "pair.npz")
        run = {"rgbmidic": run_rgbmidic, "pyvale": run_pyvale, "pyxel-dic": run_pyxel}[what]
        seconds, points, error = run(pair["f"], pair["g"], threads, repeats)
        result = {"seconds": seconds, "nodes": points, "error": error}
    print(json.dumps({**result, "memory": peak_memory()}))


def compare(folder: Path, repeats: int) -> None:
    print(
        f"{'one grey pair':<24} {'threads':>7} {'s':>7} {'ratio':>6} {'points':>7} {'rms error px':>13} {'peak MB':>8}"
    )
    own: dict[int, float] = {}
    for name in CONTENDERS:
        if (version := installed(name)) is None:
            print(f"{name:<24} not installed")
            continue
        for threads in (1,) if name == "pyxel-dic" else (1, 2):
            row = in_own_process(name, folder, threads, repeats)
            if "failed" in row:
                print(f"{name + ' ' + version:<24} {threads:>7} failed: {row['failed']}")
                continue
            own.setdefault(threads, row["seconds"])
            print(
                f"{name + ' ' + version:<24} {threads:>7} {row['seconds']:>7.3f} {row['seconds'] / own[threads]:>6.1f} "
                f"{row['nodes']:>7} {row['error']:>13.4f} {row['memory']:>8.0f}"
            )


def one_frame(folder: Path, repeats: int) -> None:
    print("one raw frame, three lights, from file to displacement")
    for threads in (1, 2):
        row = in_own_process("file", folder, threads, repeats)
        if "failed" in row:
            print(f"  {threads} threads failed: {row['failed']}")
            continue
        print(
            f"  {threads} threads: {row['seconds']:.3f} s, {row['nodes']} nodes, {row['iterations']} iterations, "
            f"rms error {row['error']:.4f} px, peak {row['memory']:.0f} MB ({row['imports']:.0f} MB after the imports)"
        )
        print("    " + "; ".join(f"{name} {1e3 * seconds:.0f} ms" for name, seconds in row["steps"].items()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", type=int, default=1024, help="rows and columns of the images")
    parser.add_argument("--repeats", type=int, default=3, help="timed runs of each contender")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        f, g = star_pair(arguments.size)
        noise = np.random.default_rng(0).normal(size=(2, *f.shape))
        np.savez(folder / "pair.npz", f=np.round(f + noise[0]).clip(0, 255), g=np.round(g + noise[1]).clip(0, 255))
        write_raw_test(folder, f, g)
        compare(folder, arguments.repeats)
        print()
        one_frame(folder, arguments.repeats)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5]))
    else:
        main()
