"""Scenes of a renderer that shares no code with the project, measured as a user would, and the best that was reached.

`python tests/independent_scenes.py [SCENE ...]` measures them and takes over, with the commit, what is better than the
best so far (tests/truth/independent_scenes.csv). What is worse stays: a loss is accepted by hand or not at all.
"""

from __future__ import annotations

import csv
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import real_files
import scipy.sparse as sp

from rgbmidic import Tri3Mesh, measure
from rgbmidic.fields import Displacement, MeshPoints, NodalCovariance, at_nodes, at_pixels
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.results.result_in_units import DISPLACEMENT_QUANTITIES
from rgbmidic.settings import CalibrationSettings, FrameSettings, RegionSettings, TestSettings
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.captures import Captures
from rgbmidic_calibration.jobs import calibrate_crosstalk, calibrate_registration, merge_files

BEST = Path(__file__).parent / "truth" / "independent_scenes.csv"
FULL = (
    "sphere",
    "plate_in_green_glare",
    "raised_droplets",
    "coarse_wrinkles",
    "lateral_colour",
    "lateral_colour_strong",
    "lateral_colour_blue4",
    "lateral_colour_glare",
)
CROPS = ("sphere_crop", "plate_in_green_glare_crop")
COLUMNS = ("scene", "quantity", "frame", "rms [px]", "rms of commit", "error/stated", "ratio of commit")
QUANTITIES = ("pixels", "nodes", "centres", "means", "gauges")
LIGHTS = ("red", "green", "blue")
MARGIN, SPACING, LENGTH, STEP = 25.0, 25.0, 100.0, 10.0
"""px: border that is left out; from one gauge or square to the next; their length; between points of a square."""
STATED = {"kind": "bayer", "cfa": "RGGB", "black_level": 64.0, "white_level": 4095.0}

Figures = dict[tuple[str, int, str], tuple[float, float]]
"""Rms error (px) and error over stated uncertainty, by scene, frame and quantity."""


def folder_of(scene: str) -> Path:
    """Folder of a scene: of a crop in tests/data; a test of a full one is skipped where it is not on this machine."""
    if scene in CROPS:
        return real_files.CROPS / "independent_scenes" / scene.removesuffix("_crop")
    folder = real_files.full_folder("independent_scenes") / scene
    if not folder.is_dir():
        real_files.pytest.skip(f"no shared data at {folder}; its size keeps it out of tests/data")
    return folder


def calibrated(folder: Path, out: Path) -> Path:
    """Calibration file from the scene's captures; a crop, which has none, comes with its crosstalk."""
    if not (folder / "dark").is_dir():
        matrix = np.load(folder / "lights.npz")["crosstalk"].astype(float)
        calibration = Calibration(crosstalk=Crosstalk(matrix=matrix, lights=LIGHTS))
        calibration.write(out / "calibration.json")
        return out / "calibration.json"
    stated = FrameSettings(path=("captures",), **STATED)

    def captures(kind: str) -> Captures:
        lights = {name: str(folder / f"{kind}_{name}" / "*.tif") for name in LIGHTS}
        return Captures.find(lights, str(folder / "dark" / "*.tif"), stated)

    calibrate_crosstalk(captures("light"))[0].write(out / "crosstalk.json")
    if not (folder / "speckle_red").is_dir():
        return out / "crosstalk.json"
    calibrate_registration(captures("speckle"))[0].write(out / "registration.json")
    merge_files([out / "crosstalk.json", out / "registration.json"]).write(out / "calibration.json")
    return out / "calibration.json"


def figures(scene: str, out: Path) -> Figures:
    """Measure a scene into the folder `out` and compare it with its truth."""
    folder = folder_of(scene)
    number = [int(path.stem.rpartition("_")[2]) for path in sorted((folder / "frames").glob("*.tif"))]
    stored = np.load(folder / "truth.npz")
    truth = stored["u"] if "u" in stored else stored["steps"].cumsum(2).cumsum(3) / 2**12
    truth = np.asarray(truth[number], dtype=np.float64)
    rows, columns = truth.shape[2:]
    settings = TestSettings(
        frames=FrameSettings(path=(str(folder / "frames" / "*.tif"),), **STATED),
        region=RegionSettings(rectangle=(20, 20, columns - 21, rows - 21)),
        calibration=CalibrationSettings(file=calibrated(folder, out)),
        base=out,
    )
    result = measure(settings, out / "result", workers=1)
    mesh = Tri3Mesh(nodes=result.nodes, elements=result.elements)
    displacement = Displacement.in_plane(*(getattr(result, name) for name in DISPLACEMENT_QUANTITIES))
    found: Figures = {}
    for quantity, errors, stds in compared(mesh, displacement, truth):
        for frame, error, std in list(zip(number, errors, stds, strict=True))[1:]:
            ratio = float(np.sqrt(np.mean((error / std) ** 2)))
            found[scene, frame, quantity] = float(np.sqrt(np.mean(error**2))), ratio
    return found


def compared(
    mesh: Tri3Mesh, displacement: Displacement, truth: FloatArray
) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Errors and stated uncertainties, by frame, of each quantity: at pixels (where none is stated), nodes and centres
    of elements, of means over squares and of extensometers.
    """
    low, high = mesh.nodes.min(axis=0) + MARGIN, mesh.nodes.max(axis=0) - MARGIN
    (left, top), (right, bottom) = np.ceil(low).astype(int), high.astype(int) + 1
    moved = displacement.values.swapaxes(0, 1)
    field = at_pixels(mesh, moved.reshape(-1, len(mesh.nodes)).T, truth.shape[2:]).reshape(truth.shape)
    yield "pixels", (field - truth)[..., top:bottom, left:right], np.full(len(field), np.nan)
    covariance, has_data = NodalCovariance.from_mesh(mesh), np.ones(len(mesh.nodes), dtype=bool)

    def errors(points: FloatArray, factors: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Errors, uncertainties and true values (T, 2, S) of sums, with factors (P,), over points (S, P, 2)."""
        at = MeshPoints.of(mesh, points).weights(has_data)
        weights = (sp.kron(sp.eye(len(points)), factors, format="csr") @ at).toarray()
        exact = np.stack([at_nodes(frame, points.reshape(-1, 2)) for frame in truth])
        exact = np.einsum("tspc,p->tcs", exact.reshape(len(truth), *points.shape), factors)
        variance = [
            [covariance.variance(weights, one.isel(frame=index)) for index in range(len(truth))]
            for one in displacement.components
        ]
        return moved @ weights.T - exact, np.sqrt(variance).swapaxes(0, 1), exact

    for quantity, points in (("nodes", mesh.nodes), ("centres", mesh.centres)):
        inner = points[((points >= low) & (points <= high)).all(axis=1)]
        yield quantity, *errors(inner[:, None], np.ones(1))[:2]
    along = [np.arange(first, last - LENGTH, SPACING) for first, last in zip(low, high, strict=True)]
    corners, cells = (_grid(*axes) for axes in (along, [np.arange(STEP / 2, LENGTH, STEP)] * 2))
    yield "means", *errors(corners[:, None] + cells, np.full(len(cells), 1 / len(cells)))[:2]
    arms = LENGTH * np.tile(np.eye(2), (len(corners), 1))
    ends = np.repeat(corners, 2, axis=0)[:, None] + np.stack([0 * arms, arms], axis=1)
    error, std, apart = errors(ends, np.array([-1.0, 1.0]))
    towards = (apart + arms.T) / np.hypot(*np.moveaxis(apart + arms.T, 1, 0))[:, None]
    yield "gauges", (towards * error).sum(axis=1), np.sqrt(((towards * std) ** 2).sum(axis=1))


def _grid(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)


Row = dict[str, str]


def read_best() -> dict[tuple[str, int, str], Row]:
    """Rows of the file of the best, by scene, frame and quantity."""
    if not BEST.exists():
        return {}
    with BEST.open(encoding="utf-8", newline="") as file:
        return {(row["scene"], int(row["frame"]), row["quantity"]): row for row in csv.DictReader(file)}


def off(ratio: float) -> float:
    """Error over stated uncertainty or its inverse, whichever is larger."""
    return max(ratio, 1 / ratio)


def keep_better(found: Figures, commit: str) -> None:
    """Take over into the file what is better than the best so far."""
    best = read_best()
    for (scene, frame, quantity), (rms, ratio) in found.items():
        row = best.setdefault((scene, frame, quantity), {})
        row |= {"scene": scene, "quantity": quantity, "frame": str(frame)}
        rms, ratio = round(rms, 5), round(ratio, 3)
        if not row.get("rms [px]") or rms < float(row["rms [px]"]):
            row |= {"rms [px]": f"{rms:.5f}", "rms of commit": commit}
        if np.isfinite(ratio) and (not row.get("error/stated") or off(ratio) < off(float(row["error/stated"]))):
            row |= {"error/stated": f"{ratio:.3f}", "ratio of commit": commit}
    order = {name: number for number, name in enumerate((*FULL, *CROPS, *QUANTITIES))}
    with BEST.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(best[key] for key in sorted(best, key=lambda key: (order[key[0]], order[key[2]], key[1])))


def main() -> None:
    """Measure the scenes named, or all, and keep what is better."""
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
    for scene in sys.argv[1:] or (*FULL, *CROPS):
        with tempfile.TemporaryDirectory() as folder:
            keep_better(figures(scene, Path(folder)), done.stdout.strip())


if __name__ == "__main__":
    main()
