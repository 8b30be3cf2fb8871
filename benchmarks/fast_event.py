"""A virtual fast test as one colour movie, measured end to end: error, stated uncertainty, memory, kill and resume.

    python benchmarks/fast_event.py make FOLDER [--frames 500] [--size 1024]
    python benchmarks/fast_event.py score FOLDER RESULT
    python benchmarks/fast_event.py kill FOLDER [--times 20] [--workers 2]
    python benchmarks/fast_event.py glare [--draws 6]

`make` writes a raw Bayer ``event.cine`` with its calibration, test.toml and the parameters of the motion, which has a
closed form. A speckled plate is struck: it swings by up to 30 px from frame to frame while a wave runs through it; a
round fragment in it turns on its own; three reflections, each erratic in its own way, sweep over it; some frames are
lost, as the time stamps tell. `score` prints the error of every tenth frame beside its stated uncertainty. `kill`
measures it once, and once more killed at random moments and resumed: both must have the same bits. `glare` measures
another event in memory, a plate with a hole under glare of all lights that stands still in the laboratory, and counts
the nodes that are wild: off by more than .2 px and 4 times their stated uncertainty.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from rgbmidic._kernels.interpolation import PAD, bspline_coefficients, sample_with_gradient
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.start import Start, track
from rgbmidic.frames import Mosaic, Window, cfa_channels
from rgbmidic.illumination.calibration import Calibration, Crosstalk
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.source import Separation, correlated, reference_images
from rgbmidic.results import Result
from rgbmidic.settings import ELEMENT_SIZE, IlluminationSettings, SolverSettings
from rgbmidic.typing import FloatArray, FloatImage
from rgbmidic.weights import Statistics

CROSSTALK = np.array([[1, 0.10, 0.02], [0.14, 1, 0.16], [0.03, 0.12, 1]])
CFA, BLACK, WHITE, GAIN, READ_NOISE = "GBRG", 64, 4095, 4.0, 3.0
RATE = 100_000
"""Frames per second."""
_FINE = 2
"""Pixels of the texture to one of a frame: what interpolating it adds is below the camera's noise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Displacement of the plate and its fragment in px, at every point of the reference and every frame."""

    size: int
    struck: int = 20
    swing: float = 120.0
    period: float = 25.2
    decay: float = 180.0
    wave: float = 1.5
    wave_length: float = 160.0
    wave_speed: float = 9.0
    turn_deg: float = 0.1

    @property
    def centre(self) -> FloatArray:
        """Of the fragment, px."""
        return np.array([0.62, 0.42]) * self.size

    @property
    def radius(self) -> float:
        """Of the fragment, px."""
        return 0.11 * self.size

    def angle(self, frame: int) -> float:
        """How far the fragment has turned, rad."""
        return float(np.radians(self.turn_deg * max(frame - self.struck, 0)))

    def plate(self, points: FloatArray, frame: int) -> FloatArray:
        """Displacement (..., 2) of points (..., 2) of the plate."""
        after = max(frame - self.struck, 0)
        swing = self.swing * np.exp(-after / self.decay) * np.sin(2 * np.pi * after / self.period)
        behind = (self.wave_speed * after - points[..., 0]) / self.wave_length
        wave = np.where((behind > 0) & (behind < 1), self.wave * np.sin(np.pi * behind) ** 2, 0.0)
        return np.stack([swing + wave, np.full(wave.shape, 0.3 * swing)], axis=-1)

    def fragment(self, points: FloatArray, frame: int) -> FloatArray:
        """Displacement (..., 2) of points (..., 2) of the fragment: the plate's at its centre, and its turn."""
        c, s = np.cos(self.angle(frame)), np.sin(self.angle(frame))
        turned = (points - self.centre) @ np.array([[c, s], [-s, c]])
        return turned + self.centre - points + self.plate(self.centre, frame)

    def displacement(self, points: FloatArray, frame: int) -> FloatArray:
        """Displacement (..., 2) of material points (..., 2)."""
        return np.where(self.inside(points)[..., None], self.fragment(points, frame), self.plate(points, frame))

    def inside(self, points: FloatArray) -> FloatArray:
        """Whether points lie in the fragment."""
        return np.asarray(np.hypot(*np.moveaxis(points - self.centre, -1, 0)) < self.radius)

    def origin(self, points: FloatArray, frame: int) -> FloatArray:
        """Material points (H, W, 2) that are seen at the pixels (H, W, 2) of a frame."""
        c, s = np.cos(self.angle(frame)), np.sin(self.angle(frame))
        seen = points - self.centre - self.plate(self.centre, frame)
        turned_back = seen @ np.array([[c, -s], [s, c]]) + self.centre
        seen_line = line = points[:1]  # the plate moves alike in all rows
        for _ in range(20):  # the wave's slope is .03: each step gains a factor of 30
            line = seen_line - self.plate(line, frame)
        plate = points + (line - seen_line)
        return np.where(self.inside(turned_back)[..., None], turned_back, plate)


def make(folder: Path, frames: int, size: int, lost: int) -> None:
    """Write movie, calibration, settings and truth."""
    from cine_files import write_cine

    folder.mkdir(parents=True)
    motion = Motion(size=size)
    numbers = np.setdiff1d(np.arange(frames + lost), _lost_numbers(frames + lost, lost))
    (folder / "motion.json").write_text(json.dumps({**asdict(motion), "numbers": numbers.tolist()}))
    Calibration(crosstalk=Crosstalk(matrix=CROSSTALK, lights=("red", "green", "blue"))).write(
        folder / "calibration.json"
    )
    margin = round(0.17 * size)
    (folder / "test.toml").write_text(
        f'[frames]\npath = "event.cine"\nreference = "0:10"\n\n[region]\n'
        f"rectangle = [{margin}, {margin // 2}, {size - 1 - margin}, {size - 1 - margin // 2}]\n\n"
        f'[calibration]\nfile = "calibration.json"\n'
    )
    with ProcessPoolExecutor(initializer=_prepare, initargs=(motion,)) as pool:
        write_cine(
            folder / "event.cine",
            pool.map(_frame, map(int, numbers)),
            count=len(numbers),
            bits=12,
            cfa=CFA,
            levels=(BLACK, WHITE),
            first=-10,
            rate=RATE,
            exposure_ns=2000,
            times_ns=((numbers - 10) * (10**9 // RATE)).tolist(),
        )


def _prepare(motion: Motion) -> None:
    global renderer
    renderer = _Renderer(motion)


def _frame(number: int) -> FloatImage:
    return renderer.frame(number)


def _lost_numbers(count: int, lost: int) -> FloatArray:
    """Frames that are lost, in runs of one to three, none of them among the first 30."""
    begins = np.random.default_rng(5).choice(np.arange(30, count - 4, 5), size=lost, replace=False)
    return np.sort(begins)


class _Renderer:
    """Frames of the test, from a texture and three sparkles that lie on the specimen."""

    def __init__(self, motion: Motion | HoledPlate, seed: int = 11) -> None:
        self.motion = motion
        rng = np.random.default_rng(seed)
        self.fine = _FINE * (motion.size + 400)
        spots = gaussian_filter(rng.normal(size=(self.fine, self.fine)).astype(np.float32), 1.25 * _FINE, mode="wrap")
        paint = 0.45 + 0.3 * np.tanh(2 * spots / spots.std())
        self.paint = np.empty([size + 2 * PAD for size in paint.shape], dtype=np.float32)
        bspline_coefficients(paint, self.paint)
        self.sparkle = [
            gaussian_filter(rng.normal(size=paint.shape).astype(np.float32), 0.5 * _FINE, mode="wrap") for _ in range(3)
        ]
        self.sparkle = [1 + 0.35 * one / one.std() for one in self.sparkle]
        rows, columns = np.mgrid[: motion.size, : motion.size].astype(np.float64)
        self.points = np.stack([columns, rows], axis=-1)
        self.site = np.tile(cfa_channels(CFA), (motion.size // 2, motion.size // 2))

    def frame(self, number: int) -> FloatImage:
        """The raw mosaic of one frame, uint16, 12 bit."""
        places = (self.motion.origin(self.points, number) + 200) * _FINE
        lights = np.stack([0.6 * self._paint(places) * self._reflected(light, number, places) for light in range(3)])
        return self._recorded(lights, seed=1000 + number)

    def _paint(self, places: FloatArray) -> FloatImage:
        # OpenCV rounds places to 1/32 px: enough for sparkle, not for the truth
        paint, *slopes = np.empty((3, places[..., 0].size), dtype=np.float32)
        sample_with_gradient(
            self.paint, *np.ascontiguousarray(np.moveaxis(places, -1, 0)).reshape(2, -1), paint, *slopes
        )
        return paint.reshape(self.site.shape)

    def _recorded(self, lights: FloatImage, seed: int) -> FloatImage:
        channels = np.tensordot(CROSSTALK, lights, axes=1)
        signal = np.take_along_axis(channels, self.site[None], axis=0)[0] * (WHITE - BLACK) * 0.75
        rng = np.random.default_rng(seed)
        noisy = signal + rng.normal(size=signal.shape) * np.sqrt(np.maximum(signal, 0) / GAIN + READ_NOISE**2)
        values: FloatImage = np.clip(np.round(noisy + BLACK), 0, WHITE).astype(np.uint16)
        return values

    def _reflected(self, light: int, number: int, places: FloatImage) -> FloatImage:
        """How much brighter a light's reflection, which sweeps over the picture, makes what it meets."""
        size = self.motion.size
        angle = 2 * np.pi * (number / 170 + light / 3)
        x, y = (0.5 + 0.3 * np.cos(angle)) * size, (0.5 + 0.3 * np.sin(angle)) * size
        spot = np.exp(-((self.points[..., 0] - x) ** 2 + (self.points[..., 1] - y) ** 2) / (2 * (0.09 * size) ** 2))
        return 1 + 1.2 * spot * np.maximum(self._seen(self.sparkle[light], places), 0)

    def _seen(self, texture: FloatImage, places: FloatImage) -> FloatImage:
        x, y = ((places[..., axis] % self.fine).astype(np.float32) for axis in (0, 1))
        return np.asarray(cv2.remap(texture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP))


@dataclass(frozen=True, slots=True, kw_only=True)
class HoledPlate:
    """A plate with a hole, at rest, then moving by up to 17 px, 2 degrees and 2 % of strain; what differs from draw to
    draw: hole, glare beside it, sparkle."""

    draw: int
    hole: FloatArray
    """Its centre, px."""
    radius: float
    spots: FloatArray
    """Centres (3, 2) of the lights' glare, px."""
    spread: float
    """Standard deviation of a light's glare, px."""
    glare: float
    """Over the diffuse level."""
    erratic: float
    sparkle: float
    """Standard deviation of the erratic part's grains, px."""
    shift: FloatArray
    size: int = 512
    rest: int = 4
    moving: int = 12

    @classmethod
    def drawn(cls, draw: int) -> HoledPlate:
        """One of them."""
        rng = np.random.default_rng(draw)
        angle, direction = rng.uniform(0, 2 * np.pi, 2)
        hole, radius = rng.uniform(200, 312, 2), rng.uniform(35, 80)
        spread, level, erratic, sparkle = rng.uniform((45, 1.5, 0.3, 1), (60, 2.5, 0.6, 2))
        beside = hole + (radius + 15) * np.array([np.cos(angle), np.sin(angle)])
        return cls(
            draw=draw,
            hole=hole,
            radius=radius,
            spots=beside + rng.normal(0, 25, (3, 2)),
            spread=spread,
            glare=level,
            erratic=erratic,
            sparkle=sparkle,
            shift=17 * np.array([np.cos(direction), np.sin(direction)]),
        )

    def _affine(self, frame: int) -> tuple[FloatArray, FloatArray]:
        part = (max(frame - self.rest + 1, 0) / self.moving) ** 2
        c, s = np.cos(np.radians(2 * part)), np.sin(np.radians(2 * part))
        return np.array([[c, -s], [s, c]]) @ np.diag([1 + 0.02 * part, 1 - 0.006 * part]), self.shift * part

    def displacement(self, points: FloatArray, frame: int) -> FloatArray:
        """Displacement (..., 2) of material points (..., 2)."""
        gradient, shift = self._affine(frame)
        return (points - self.size / 2) @ (gradient - np.eye(2)).T + shift

    def origin(self, points: FloatArray, frame: int) -> FloatArray:
        """Material points (H, W, 2) that are seen at the pixels (H, W, 2) of a frame."""
        gradient, shift = self._affine(frame)
        return (points - self.size / 2 - shift) @ np.linalg.inv(gradient).T + self.size / 2

    def region(self) -> Region:
        """The frame but for its border and the hole."""
        angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
        edge = self.hole + self.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return Region.from_rectangle((30, 30, self.size - 31, self.size - 31), (self.size,) * 2).without([edge])


class _GlaringRenderer(_Renderer):
    """Frames of such a plate: the paint, and glare of each light that stands still in the laboratory."""

    def __init__(self, plate: HoledPlate) -> None:
        super().__init__(plate, seed=100 + plate.draw)
        self.plate, rng = plate, np.random.default_rng(200 + plate.draw)
        self.glare = []
        for spot in plate.spots:
            grains = sum(gaussian_filter(rng.normal(size=self.site.shape), plate.sparkle) ** 2 for _ in range(2))
            erratic = 1 - plate.erratic + plate.erratic * grains / grains.mean()
            distance = ((self.points - spot) ** 2).sum(axis=-1)
            self.glare.append(0.45 * plate.glare * erratic * np.exp(-distance / (2 * plate.spread**2)))

    def mosaic(self, number: int) -> Mosaic:
        """One raw frame."""
        seen = self.plate.origin(self.points, number)
        solid = np.clip(np.hypot(*np.moveaxis(seen - self.plate.hole, -1, 0)) - self.plate.radius + 0.5, 0, 1)
        paint = self._paint((seen + 200) * _FINE)
        lights = 0.4 * (solid * (paint + np.stack(self.glare)) + 0.03 * (1 - solid))
        values = self._recorded(lights, seed=10_000 * (self.plate.draw + 1) + number)
        return Mosaic(values=values, cfa=CFA, black_level=BLACK, white_level=WHITE)


def glare(draws: int) -> None:
    """Measure such plates, one line for each."""
    crosstalk = Crosstalk(matrix=CROSSTALK, lights=("red", "green", "blue"))
    calibration = Calibration(crosstalk=crosstalk, noise=NoiseModel(gain=GAIN, read_noise=READ_NOISE))
    settings, solver = IlluminationSettings(), SolverSettings()
    print("draw  wild nodes  not measured  rms error  largest  rms error/stated  covered")
    for draw in range(draws):
        plate = HoledPlate.drawn(draw)
        renderer, region = _GlaringRenderer(plate), plate.region()
        frames = [(renderer.mosaic(number),) for number in range(plate.rest + plate.moving)]
        images, separation = reference_images(
            Separation(calibration=calibration), frames[: plate.rest], Window.whole(frames[0][0].values.shape[-2:])
        )
        mesh = Tri3Mesh.from_region(region, ELEMENT_SIZE)
        reference = Reference.prepare(correlated(images, settings), region, mesh=mesh, prefilter=solver.prefilter)
        start, errors, stated = Start(displacement=np.zeros_like(mesh.nodes)), [], []
        for number in range(plate.rest, len(frames)):
            ready = correlated(separation(frames[number]), settings)
            found = track(reference, Deformed.prepare(ready, prefilter=solver.prefilter), start, solver, Statistics())
            start = start.after(mesh, found.displacement, found.measured)
            errors.append(found.displacement - plate.displacement(mesh.nodes, number))
            stated.append(found.displacement_std)
        error, std = np.abs(np.concatenate(errors)), np.concatenate(stated)
        known, ratio = np.isfinite(error[:, 0]), error / std
        wild = ((error > 0.2) & (ratio > 4)).any(axis=1).sum()
        _, rms, relative = _figures(error, std)
        covered = (ratio[known] < 1.96).mean()
        print(
            f"{draw:4d}  {wild:4d} of {len(error)}  {1 - known.mean():6.2%}  {rms:.4f}  {error[known].max():.2f}  "
            f"{relative:.2f}  {covered:.1%}",
            flush=True,
        )


def score(folder: Path, path: Path) -> None:
    """Error of the frames beside what they state, apart for the plate and the fragment."""
    told = json.loads((folder / "motion.json").read_text())
    numbers = told.pop("numbers")
    motion, result = Motion(**told), Result.open(path, partial=True)
    nodes = result.nodes
    away = np.abs(np.hypot(*(nodes - motion.centre).T) - motion.radius) > 30
    print("frame  motion  iterations  plate: measured rms error/stated   fragment: measured rms error/stated")
    totals = []
    for index in range(len(result)):
        record, number = result.frame(index), numbers[index]
        assert record.number == number - numbers[0] or record.iterations == 0
        truth = motion.displacement(nodes, number) - motion.displacement(nodes, numbers[0])
        error = np.stack([record.u, record.v], axis=1) - truth
        stated = np.stack([record.u_std, record.v_std], axis=1)
        parts = [
            _figures(error[part], stated[part]) for part in (away & ~motion.inside(nodes), motion.inside(nodes) & away)
        ]
        totals.append([*parts[0], *parts[1]])
        if index % 10 == 0:
            jump = np.linalg.norm(truth - motion.displacement(nodes, number - 1), axis=1).max()
            told_parts = "   ".join(f"{share:7.1%} {rms:.4f} {ratio:.2f}" for share, rms, ratio in parts)
            print(f"{number:5d}  {jump:6.1f}  {record.iterations:4d}  {told_parts}")
    print("median over the frames:", np.round(np.nanmedian(totals, axis=0), 4).tolist())
    print("worst:", np.round(np.nanmin(totals, axis=0), 4).tolist(), np.round(np.nanmax(totals, axis=0), 4).tolist())


def _figures(error: FloatArray, stated: FloatArray) -> tuple[float, float, float]:
    """Share that is measured, rms error, rms of error over stated."""
    known = np.isfinite(error[:, 0])
    if not known.any():
        return 0.0, np.nan, np.nan
    return float(known.mean()), *(float(np.sqrt((part[known] ** 2).mean())) for part in (error, error / stated))


def kill(folder: Path, times: int, workers: int) -> None:
    """Measure the test at one go, and killed at random moments and resumed; compare all quantities of all frames."""
    command = [sys.executable, "-m", "rgbmidic.cli", "run", str(folder / "test.toml"), "--no-figures"]
    command += ["--workers", str(workers), "--out"]
    if not (folder / "whole").exists():
        subprocess.run([*command, str(folder / "whole")], check=True)
    moments, running = random.Random(3), 0
    for number in range(times):
        until = _stored(folder / "killed") + moments.uniform(0, 1.4) * _stored(folder / "whole") / times
        run = subprocess.Popen([*command, str(folder / "killed"), *(["--resume"] if number else [])])
        time.sleep(moments.uniform(0, 4))  # some are killed while they start
        while run.poll() is None and _stored(folder / "killed") < until:
            time.sleep(0.01)
        running += run.poll() is None
        run.send_signal(signal.SIGKILL)
        run.wait()
        done = 0
        if (folder / "killed" / "provenance.json").exists():
            done = int((Result.open(folder / "killed", partial=True).number >= 0).sum())
        print(f"killed {number + 1} times: {done} frames are kept", flush=True)
    subprocess.run([*command, str(folder / "killed"), "--resume"], check=True)
    one, other = (Result.open(folder / name) for name in ("whole", "killed"))
    for index in range(len(one)):
        for name, value in one.frame(index).values.items():
            np.testing.assert_array_equal(value, other.frame(index).values[name], err_msg=f"{name} of frame {index}")
    print(f"the same bits in all {len(one)} frames; {running} of {times} runs were killed before they ended")


def _stored(result: Path) -> int:
    """Bytes of the frames of a result."""
    return sum(file.stat().st_size for file in result.glob("solution/*.frames"))


def main() -> None:
    """Run the command line above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["make", "score", "kill", "glare"])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("result", type=Path, nargs="?")
    for name, default in (("frames", 500), ("size", 1024), ("lost", 30), ("times", 20), ("workers", 2), ("draws", 6)):
        parser.add_argument(f"--{name}", type=int, default=default)
    given = parser.parse_args()
    if given.folder is None and given.what != "glare":
        parser.error(f"{given.what} needs a FOLDER")
    if given.what == "glare":
        glare(given.draws)
    elif given.what == "make":
        make(given.folder, given.frames, given.size, given.lost)
    elif given.what == "score":
        score(given.folder, given.result or given.folder / "whole")
    else:
        kill(given.folder, given.times, given.workers)


if __name__ == "__main__":
    main()
