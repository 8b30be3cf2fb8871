"""Time, memory and accuracy beside other DIC programs, in one run, alternating; prints a table.

    pip install "rgbmidic[bench]"
    python benchmarks/peers.py [--size 1024] [--threads 2] [--repeats 3] [--base DIRECTORY] [--json FILE]
    python benchmarks/peers.py --quick
    python benchmarks/peers.py --cases raw calibrated --base DIRECTORY

Every contender is a process of its own that lives as long as a case; in each round they take their turns, so that what
else the machine does meets all of them, and the best time counts. Absolute times depend on the machine: compare the
ratios. `--base` adds another checkout of rgbmidic as a contender. All get the same images, place their nodes or subset
centres 25 px apart over the same region (pyALDIC 32: a power of two), and start from zero. ``al-dic local`` is pyALDIC
without its global step.

Grey pairs, for all contenders:

``star``: v = 0.5 cos(2 pi y / period) px with a period that grows from 100 to 300 px along x, noise of 1 DN.
``affine``: 1 % strain and a turn of 2 degrees, without noise and with noise of 2.55 DN (1 %): far motion.

Our own, beside three pairs of each peer:

``3 lights``: three noisy views of the affine pair together. ``raw``: the second frame of a raw Bayer series under three
lights, from file to record, with noise and crosstalk calibrated; ``calibrated``: with the registration of the lights
besides, which the frames then need; ``small``: 256 x 128 px of ``raw``. ``sequence`` and ``sequence, calibrated``: the
same in a series of which every frame moves by as much as ``star``, in as many processes as threads, its start left out;
the seconds are those from one frame to the next. ``demo`` and ``event``: iterations of the frames of `rgbmidic demo`
and of the first 60 of ``benchmarks/fast_event.py``. ``compiling``: processor seconds that a first `rgbmidic run` takes
more than a second one. These three once, at the first size.

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
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.typing import AnyArray, FloatArray

MARGIN, STEP = 30, 25
CONTENDERS = {"rgbmidic": "rgbmidic", "pyvale": "pyvale", "pyxel-dic": "pyxel-dic", "al-dic": "al-dic"}
CONTENDERS["al-dic local"] = "al-dic"
"""Contenders, and the packages that they need."""
PAIRS = ("star", "affine", "affine, 1 % noise")
OWN = ("3 lights", "raw", "calibrated", "small", "sequence", "sequence, calibrated", "demo", "event", "compiling")
TIMED = ("star", "affine, 1 % noise", "raw", "calibrated", "small")
"""Cases run several times, the others once."""
ONCE = ("demo", "event", "compiling")
"""Cases that do not depend on size and threads."""
FRAMES, STARTED, EVENT = 24, 6, 60
"""Frames of the sequence, and those after which its time counts; frames of the event."""
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


def write_cases(folder: Path, size: int, cases: list[str]) -> None:
    """The pairs of all cases and the raw series."""
    star_pair, affine = pair("star", size), pair("affine", size)
    np.savez(folder / "star.npz", *(noisy(image, 1.0, n) for n, image in enumerate(star_pair)))
    np.savez(folder / "affine.npz", *affine)
    for light in range(3):
        states = [noisy(image, 2.55, 2 * light + n) for n, image in enumerate(affine)]
        np.savez(folder / f"affine_{light}.npz", *states)
    plain = np.stack([np.stack([image] * 3) for image in star_pair])
    frames = {
        name: FRAMES if f"sequence{end}" in cases else 2 for name, end in (("raw", ""), ("calibrated", ", calibrated"))
    }
    write_raw_test(folder / "raw", frames["raw"], plain)
    write_raw_test(folder / "small", 2, plain[..., :128, :256])
    if {"calibrated", "sequence, calibrated", "compiling"} & set(cases):
        write_raw_test(folder / "calibrated", frames["calibrated"], *registered_states(size, plain))


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
    from rgbmidic.lab.virtual import plate_scene, record

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


def write_tests(folder: Path, cases: list[str]) -> None:
    """The demo and the event, if they are asked for."""
    if "demo" in cases:
        command = [sys.executable, "-c", "from rgbmidic.cli import main; main()", "demo", "--out", str(folder / "demo")]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    if "event" in cases:
        script = str(Path(__file__).with_name("fast_event.py"))
        command = [sys.executable, script, "make", str(folder / "event"), "--frames", str(EVENT), "--lost", "0"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


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


def with_aldic(f: AnyArray, g: AnyArray, threads: int, *, whole: bool = True) -> Points:
    import al_dic  # type: ignore[import-untyped]
    from al_dic.core.data_structures import GridxyROIRange

    # as pyvale's: subsets of 25 px; its step is a power of two
    region = (MARGIN, len(f) - 1 - MARGIN)
    settings = al_dic.dicpara_default(
        winsize=24, winstepsize=32, img_size=f.shape, gridxy_roi_range=GridxyROIRange(region, region),
        reference_mode="accumulative", use_global_step=whole, size_of_fft_search_region=32, show_plots=False,
    )  # fmt: skip
    found = al_dic.run_aldic(settings, [f / 255, g / 255], [np.ones(f.shape)] * 2, compute_strain=False)
    return found.dic_mesh.coordinates_fem, found.result_disp[0].U.reshape(-1, 2)


def raw_frame(folder: Path) -> Callable[[], Points]:
    """Measures the second frame of a raw series, whose reference is prepared, as a run does."""
    from rgbmidic import read_test
    from rgbmidic.correlation import Start
    from rgbmidic.pipeline import Plan, measure_frame

    plan = Plan.from_settings(read_test(folder / "TEST.toml"))
    nodes = plan.reference.mesh.nodes

    def measure() -> Points:
        found = measure_frame(plan, 1, Start(displacement=np.zeros_like(nodes)))
        return nodes + plan.window.origin, np.stack([found.u, found.v], axis=1)

    return measure


def sequence(test: Path, processes: int) -> dict[str, Any]:
    """Seconds a frame of a series, measured as `rgbmidic run` does, without pictures; iterations of its frames."""
    from rgbmidic import measure, read_test

    times: list[float] = []
    with tempfile.TemporaryDirectory() as out:
        found = measure(
            read_test(test),
            Path(out) / "result",
            workers=processes,
            progress=lambda *_: times.append(time.perf_counter()),
        )
        started = min(STARTED, len(times) // 2)
        iterations = found.iterations[list(found.deformed)].tolist()
    return {"seconds": (times[-1] - times[started]) / (len(times) - 1 - started), "iterations": iterations}


def compiling(test: Path) -> float:
    """Processor seconds that a first `rgbmidic run`, whose cache of kernels is empty, takes more than a second one."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": f"{folder}/kernels"}
        taken = [0.0]
        for out in ("first", "second"):
            command = [sys.executable, "-c", "from rgbmidic.cli import main; main()", "run", str(test), "--no-figures"]
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
    """Largest memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024**2 if sys.platform == "darwin" else 1024)


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
    run = {
        "rgbmidic": with_rgbmidic,
        "pyvale": with_pyvale,
        "pyxel-dic": with_pyxel,
        "al-dic": with_aldic,
        "al-dic local": partial(with_aldic, whole=False),
    }[name]
    frame = cache(lambda case: raw_frame(folder / case))

    def measure(case: str) -> dict[str, Any]:
        if case.startswith("sequence"):
            return sequence(folder / ("calibrated" if "," in case else "raw") / "TEST.toml", threads)
        if case in ("demo", "event"):
            return sequence(folder.parent / {"demo": "demo/test/test.toml", "event": "event/test.toml"}[case], 1)
        if case == "compiling":
            return {"seconds": compiling(folder / "calibrated" / "TEST.toml")}
        if case in ("raw", "calibrated", "small"):
            work = frame(case)
        else:
            f, g = _images(folder, case)
            work = partial(run, f, g, threads)
        seconds, found = _time(work)
        with np.load(folder / "star.npz") as kept:
            size = len(kept["arr_0"])
        rms = error("star" if case in ("star", "raw", "calibrated", "small") else "affine", found, size)
        return {"seconds": seconds, "nodes": len(found[0]), "error": rms if case != "small" else None}

    return measure


def _time(work: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of some work, and what it gives."""
    begin = time.perf_counter()
    found = work()
    return time.perf_counter() - begin, found


def _images(folder: Path, case: str) -> tuple[AnyArray, AnyArray]:
    if case == "3 lights":
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
        threading = dict.fromkeys(
            ("RGBMIDIC_THREADS", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads)
        )
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


def compare(folder: Path, size: int, threads: int, options: argparse.Namespace) -> list[dict[str, Any]]:
    """The best of several alternating runs of every contender, after one that warms up, in the `TIMED` cases."""
    there = [
        (name, f"{name} {version}".strip(), None)
        for name, package in CONTENDERS.items()
        if (version := installed(package)) is not None
    ]
    base = options.base
    there += [("rgbmidic", f"rgbmidic in {base}", str(Path(base).resolve()))] if base else []
    rows = []
    for case in options.cases:
        if case in ONCE and (size, threads) != (options.size[0], options.threads[-1]):
            continue
        able = there if case in PAIRS else [one for one in there if one[0] == "rgbmidic"]
        contenders = [Contender(name, label, folder, threads, path) for name, label, path in able]
        found: dict[str, dict[str, Any]] = {}
        try:
            for turn in range(1 + options.repeats if case in TIMED else 1):
                for one in contenders:
                    row = one.measure(case)
                    if turn < 2 or row.get("seconds", np.inf) < found[one.label].get("seconds", np.inf):
                        found[one.label] = row
        finally:
            for one in contenders:
                one.close()
        for (name, label, path), row in zip(able, found.values(), strict=True):
            named = {"case": case, "contender": label, "name": "base" if path else name}
            rows.append({"size": size, "threads": threads, **named, **row})
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Print all rows."""
    own = {row["case"]: row.get("seconds", np.nan) for row in rows[::-1] if row["name"] == "rgbmidic"}
    print(f"{'case':<21} {'contender':<32} {'s':>8} {'/ ours':>7} {'points':>7} {'rms error px':>13} {'peak MB':>8}")
    for row in rows:
        head = f"{row['case']:<21} {row['contender']:<32} "
        if "failed" in row:
            print(head + f"failed: {row['failed'][:90]}")
            continue
        rms = row.get("error")
        print(
            head + f"{row['seconds']:>8.3f} {row['seconds'] / own[row['case']]:>7.2f} {row.get('nodes', ''):>7} "
            f"{np.nan if rms is None else rms:>13.5f} {row['memory']:>8.0f}"
        )


def table(rows: list[dict[str, Any]]) -> None:
    """Print what the rows come to beside what issue 24 asks for, another checkout's in a column of its own."""
    names = [name for name in ("base", "rgbmidic") if any(row["name"] == name for row in rows)]
    print("\n| | " + " | ".join(("now" if name == "rgbmidic" else name) for name in names) + " | asked |")
    print("|---" * (len(names) + 2) + "|")
    for size, threads in sorted({(row["size"], row["threads"]) for row in rows}):
        part = {(row["case"], row["name"]): row for row in rows if (row["size"], row["threads"]) == (size, threads)}
        for lines in zip(*(list(asked(part, size, threads, name)) for name in names), strict=True):
            values = [value for _, value, _ in lines]
            if np.isfinite(values).any():
                print(f"| {lines[0][0]} | " + " | ".join(f"{value:.3g}" for value in values) + f" | {lines[0][2]} |")


def asked(
    found: dict[tuple[str, str], dict[str, Any]], size: int, threads: int, ours: str
) -> Iterator[tuple[str, float, float | str]]:
    """Each line of the issue's table: its text, the value of a contender of ours (NaN: not known), what is asked."""
    at, far = f"{size} px, {threads} threads", PAIRS[2]

    def of(case: str, name: str = ours, what: str = "seconds") -> Any:
        return found.get((case, name), {}).get(what, np.nan)

    for peer, least in (("pyvale", 4), ("pyxel-dic", 25), ("al-dic", ""), ("al-dic local", "")):
        yield f"{peer} / ours, grey pair, small motion, {at}", of("star", peer) / of("star"), least
    yield f"pyvale / ours, far motion with noise, {at}", of(far, "pyvale") / of(far), 2.5
    for text, case, end in (("full calibration", "calibrated", ", calibrated"), ("crosstalk only", "raw", "")):
        full, large = case == "calibrated", size == 2048
        ratio = 3 * of("star", "pyvale") / of(case)
        yield f"three pyvale pairs / our raw frame, {text}, {at}", ratio, 6 if full else ""
        rate = 1 / of(f"sequence{end}")
        yield f"frames a second, files included, {text}, {at}", rate, 6 if full and threads > 1 else ""
        yield f"raw frame, {text}, s, {at}", of(case), 0.7 if large else ""
        yield f"its peak memory, GB, {at}", of(case, what="memory") / 1000, 1.0 if large else ""
    yield f"raw frame, full calibration / crosstalk only, {at}", of("calibrated") / of("raw"), 1.1
    yield f"256 x 128 px frame, ms, {threads} threads", 1000 * of("small"), 10
    demo, event = (np.atleast_1d(of(case, what="iterations")) for case in ("demo", "event"))
    yield "iterations, demo's last frame", demo[-1], 8
    yield "iterations, event's median", float(np.median(event)), 6
    yield "iterations, event's most", event.max(), 12
    yield "compiling for `run`, CPU s", of("compiling"), 20


def main() -> None:
    """Run the command line above."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", type=int, nargs="+", default=[1024, 2048], help="rows and columns of the images")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=3, help="timed rounds")
    parser.add_argument("--cases", nargs="+", choices=[*PAIRS, *OWN], default=[*PAIRS, *OWN], metavar="CASE")
    parser.add_argument("--quick", action="store_true", help="small images, one round: whether all of it runs")
    parser.add_argument("--base", help="another checkout of rgbmidic that takes part")
    parser.add_argument("--json", type=Path, help="file for the rows")
    options = parser.parse_args()
    if options.quick:
        options.size, options.threads, options.repeats = [256], [2], 1
        options.cases = [case for case in options.cases if case not in ONCE]
    rows = []
    with tempfile.TemporaryDirectory() as name:
        write_tests(Path(name), options.cases)
        for size in options.size:
            folder = Path(name) / str(size)
            folder.mkdir()
            write_cases(folder, size, options.cases)
            for threads in options.threads:
                print(f"{size} x {size} px, {threads} threads, load {os.getloadavg()[0]:.1f}", flush=True)
                part = compare(folder, size, threads, options)
                show(part)
                rows += part
    table(rows)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]))
    else:
        main()
