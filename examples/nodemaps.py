"""Nodemaps for CrackPy
====================

A result as CrackPy (Strohmann et al, DLR) reads it: a text file for each frame, from the CSV export.

A strip is stretched by 0.1 % a frame. ``write_nodemaps`` is for your own results too. Last line: largest error of the
mean strain in the middle, in 1e-6, read back from the nodemaps.
"""

import csv
import tempfile
from itertools import groupby
from operator import itemgetter
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from rgbmidic import TestSettings, export_result, measure

HEADER = "id; x [mm]; y [mm]; z [mm]; u [mm]; v [mm]; w [mm]; eps_x [%]; eps_y [%]; eps_xy [1]"
SIDE, COUNT, STEP, SCALE = 160, 4, 1e-3, 0.05


def write_nodemaps(table: Path, folder: Path) -> list[Path]:
    """Write FOLDER/TABLE_NUMBER.txt for each measured frame of a CSV export in mm; y is up, normal strain in %."""
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    with table.open(encoding="utf-8", newline="") as stream:
        rows = csv.DictReader(stream)
        if "u_mm" not in (rows.fieldnames or ()):
            raise SystemExit(
                f"{table} is not a csv export in mm: state mm_per_pixel or camera in [scale], and export again"
            )
        for number, nodes in groupby(rows, key=itemgetter("number")):
            frame = list(nodes)
            x, y, u, v, exx, eyy, exy = (
                np.array([float(node[name] or "nan") for node in frame])
                for name in ("x_mm", "y_mm", "u_mm", "v_mm", "exx", "eyy", "exy")
            )
            if np.isnan(u).all():  # the frame failed
                continue
            flat = np.zeros(len(x))
            values = [np.arange(len(x)) + 1, x, -y, flat, u, -v, flat, 100 * exx, 100 * eyy, -exy]
            # CrackPy looks for "# time" at the beginning of a line, and for the number behind its colon
            lines = [f"{table.stem}, {frame[0]['name']}", HEADER]
            if "time_s" in frame[0]:
                lines.insert(1, f"time : {frame[0]['time_s']}")
            header = "\n".join(lines).encode("ascii", "backslashreplace").decode()
            files.append(folder / f"{table.stem}_{number}.txt")
            np.savetxt(files[-1], np.column_stack(values), fmt="%.9g", delimiter=";", header=header)
    return files


def speckle(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Grey levels at any point; spots of about 4 px."""
    random = np.random.default_rng(1)
    image = np.full(x.shape, 2000.0)
    for a, b in random.normal(scale=0.42, size=(150, 2)):
        image += 60 * np.cos(a * x + b * y + random.uniform(0, 2 * np.pi))
    return image


if __name__ == "__main__":
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    # a pixel of a stretched frame shows the point that was nearer to the left edge
    frames = np.stack([speckle(x / (1 + STEP * number), y) for number in range(COUNT)]).astype(np.float32)
    sections = {"region": {"rectangle": [15, 15, 144, 144]}, "scale": {"mm_per_pixel": SCALE, "frame_rate": 100}}
    settings = TestSettings.from_mapping({"frames": {"path": []}, **sections})

    with tempfile.TemporaryDirectory() as folder:
        result = measure(settings, Path(folder) / "result", source=frames)
        export_result(result, "csv", Path(folder) / "strip.csv")
        nodemaps = [
            np.loadtxt(file, delimiter=";", unpack=True)
            for file in write_nodemaps(Path(folder) / "strip.csv", Path(folder) / "nodemaps")
        ]

    is_middle = np.hypot(nodemaps[0][1] - 80 * SCALE, nodemaps[0][2] + 80 * SCALE) < 40 * SCALE
    strains = np.array([values[7][is_middle].mean() / 100 for values in nodemaps])
    stretch = STEP * np.arange(COUNT)
    error = np.abs(strains - (stretch + stretch**2 / 2)).max()  # Green-Lagrange
    print(f"largest error: {1e6 * error:.1f} (1e-6)")

    # Strain of the last frame over the strip, y up.
    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    drawn = axes.scatter(nodemaps[-1][1], nodemaps[-1][2], c=nodemaps[-1][7])
    axes.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
    figure.colorbar(drawn, label="strain in x (%)")
    plt.show()
