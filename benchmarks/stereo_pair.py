"""A real pair of cameras: six frames of a D-shaped specimen that hardly moves, and pyvale's stereo on the same files.

The frames and the cameras' calibration are those of a regression test of DICe (github.com/dicengine/dice,
tests/regression/stereo_d_spec, BSD-3-Clause), 28 MB, of which nothing is in this repository: RGBMIDIC_DICE names a
checkout. The motion is unknown, but it is all but rigid: what it has beyond a plane is the error.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from rgbmidic import CameraCalibration
from rgbmidic.tools.stereo import CameraPair, StereoSettings, measure_stereo
from rgbmidic.typing import FloatArray

from .contenders import environment, peers_python
from .tables import MissingDataError, Row, table
from .uncertainty import rms

LEFT = (
    955.0537385,
    645.2301624,
    6636.033383,
    6636.440175,
    -5.693077075e-4,
    -1.957515272e-4,
    0.8739544595,
    -26.91426143,
)
RIGHT = (971.3275619, 615.7965508, 6609.847619, 6609.166930, 0.7051020868, -5.22596687e-3, 1.077694686, -30.05404073)
"""cx, cy, fx, fy, skew (px), k1, k2, k3, as the test's cal.xml states them."""
POSES = ((179.933221, 9.415993919, -0.05775865407, -58.20738494, 0.1641145944, 20.16820788),
         (-179.9418875, -9.41605085, 0.04747312256, 59.84373321, 0.2184759676, 21.0471920))  # fmt: skip
"""From the world to either camera: angles about x, y, z (degrees, in this order) and translation (mm)."""
REGION = (300, 480, 1600, 690)
ELEMENT, SUBSET, STEP = 30, 31, 15


def pose(angles: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Rotation and translation."""
    x, y, z = (cv2.Rodrigues(np.radians(axis * a))[0] for axis, a in zip(np.eye(3), angles[:3], strict=True))
    return z @ y @ x, np.array(angles[3:])


def cameras() -> CameraPair:
    """Both cameras; their pixels count as square and not skewed, which moves a point by up to .06 px."""
    left, right = (
        CameraCalibration(shape=(1200, 1920), lens=np.array([(fx + fy) / 2, cx, cy, k1, k2, 0, 0, k3]))
        for cx, cy, fx, fy, _, k1, k2, k3 in (LEFT, RIGHT)
    )
    return CameraPair.of_poses((left, right), *map(pose, POSES))


def beyond_a_plane(values: FloatArray, x: FloatArray, y: FloatArray) -> float:
    """Rms of what values have beyond the plane that fits them best."""
    basis = np.stack([np.ones_like(x), x, y], axis=1)
    return rms(values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0])


def by_pyvale(python: str, images: Path, pair: CameraPair, folder: Path) -> dict[str, list[list[float]]]:
    """Coordinates and displacements (frame, point) that pyvale measures, the reference first."""
    turn = pair.poses[1][0]
    angles = np.degrees(
        [np.arctan2(turn[2, 1], turn[2, 2]), -np.arcsin(turn[2, 0]), np.arctan2(turn[1, 0], turn[0, 0])]
    )
    lines = []
    for number, (cx, cy, fx, fy, skew, k1, k2, k3) in enumerate((LEFT, RIGHT)):
        values = {"fx_px": fx, "fy_px": fy, "fs_px": skew, "cx_px": cx, "cy_px": cy}
        values |= {"k1": k1, "k2": k2, "p1": 0.0, "p2": 0.0, "k3": k3}
        lines += [f"cam{number}_{name},{value}" for name, value in values.items()]
    lines += [f"{name}_mm,{value}" for name, value in zip(("tx", "ty", "tz"), pair.translation, strict=True)]
    lines += [f"{name}_deg,{value}" for name, value in zip(("theta", "phi", "psi"), angles, strict=True)]
    (folder / "cal.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    command = [python, "-m", "benchmarks.stereo_pair", str(images), str(folder)]
    subprocess.run(command, env=environment(), cwd=folder, check=True, stdout=subprocess.DEVNULL)
    return dict(json.loads((folder / "found.json").read_text(encoding="utf-8")))


def pyvale(images: Path, folder: Path) -> None:
    """Measure by pyvale, in the Python that has it."""
    from pyvale import calib, dic

    left, right = ([images / f"GT4-{number:04}_{side}.tif" for number in range(6)] for side in (0, 1))
    roi = dic.RegionOfInterest(left[0])
    roi.mask[...] = False
    roi.mask[REGION[1] : REGION[3] + 1, REGION[0] : REGION[2] + 1] = True
    dic.calculate_3d(
        reference=[left[0], right[0]],
        deformed=[left[1:], right[1:]],
        calibration=calib.loadtxt(folder / "cal.txt"),
        roi_mask=roi.mask,
        seed=[900, 600],
        subset_size=SUBSET,
        subset_step=STEP,
        max_displacement=100,
        output_basepath=folder,
        print_level=0,
    )
    found = dic.import_3d(data=folder / "dic_results_*.csv", delimiter=",", binary=False).stereo
    names = ("x_mm", "y_mm", "u_mm", "v_mm", "w_mm")
    arrays = {name: np.asarray(getattr(found, name)).reshape(6, -1).tolist() for name in names}
    (folder / "found.json").write_text(json.dumps(arrays), encoding="utf-8")


@table("stereo_pair", page="how-to/stereo", cost=60, keys=2)
def stereo_pair(quick: bool) -> Iterator[Row]:
    """Two real cameras 19° apart before a D-shaped specimen that hardly moves (six frames of 1920 x 1200 px): rms of
    what the displacement has beyond a plane, in the axes of the left camera, and what is stated of it; elements of
    30 px, pyvale with subsets of 31 px at every 15th."""
    images = Path(os.environ.get("RGBMIDIC_DICE", "")) / "tests/regression/stereo_d_spec/images"
    if not (images / "GT4-0005_1.tif").is_file():
        raise MissingDataError("RGBMIDIC_DICE names no checkout of github.com/dicengine/dice")
    with tempfile.TemporaryDirectory() as text:
        folder, pair, tests = Path(text), cameras(), list[Path]()
        for side, rectangle in ((0, REGION), (1, (20, 300, 1900, 900))):
            tests.append(folder / f"{side}.toml")
            frames = f'[frames]\npath = "{images}/GT4-*_{side}.tif"\nkind = "monochrome"\n'
            frames += "black_level = 0\nwhite_level = 255\n"
            mesh = f"[region]\nrectangle = {list(rectangle)}\n[mesh]\nelement_size = {ELEMENT}\n"
            tests[-1].write_text(frames + mesh, encoding="utf-8")
        result = measure_stereo(*tests, pair, folder / "result", StereoSettings(axes="camera"), workers=1)
        peer = None if quick else by_pyvale(peers_python(("rgbmidic", "pyvale"))[0], images, pair, folder)
        for frame in range(1, 6):
            row: Row = {"program": "rgbmidic", "frame": str(frame)}
            row |= {f"{n} [um]": 1e3 * beyond_a_plane(result[n][frame], result["x"], result["y"]) for n in "uvw"}
            yield row | {f"{n} stated [um]": 1e3 * rms(result[f"{n}_std"][frame]) for n in "uvw"}
            if peer is not None:
                x, y = (np.array(peer[f"{name}_mm"][0]) for name in "xy")
                row = {"program": "pyvale", "frame": str(frame)}
                for name in "uvw":
                    values = np.array(peer[f"{name}_mm"][frame])
                    usable = np.isfinite(values + x + y)
                    row[f"{name} [um]"] = 1e3 * beyond_a_plane(values[usable], x[usable], y[usable])
                yield row | {f"{name} stated [um]": float("nan") for name in "uvw"}


if __name__ == "__main__":
    pyvale(Path(sys.argv[1]), Path(sys.argv[2]))
