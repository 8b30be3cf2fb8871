"""Other DIC programs behind one call: points and displacement of a grey pair over a region.

Each takes the default of its authors but for the region, the side of elements or subsets and their spacing, which are
alike, and starts from nothing. They live in a Python of their own (`pip install ".[bench]"`), which PEERS_PYTHON names.
"""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import rgbmidic
from rgbmidic.typing import AnyArray, FloatArray

from . import ROOT

MARGIN, STEP = 30, 25
Points = tuple[FloatArray, FloatArray]
"""Positions and displacements (n, 2) in px."""


@dataclass(frozen=True)
class Placing:
    """Corners x0, y0, x1, y1 of the region, side of elements or subsets, and spacing of subsets (0: the side); px."""

    region: tuple[int, int, int, int]
    size: int = STEP
    step: int = 0

    @classmethod
    def inside(cls, shape: tuple[int, ...]) -> Placing:
        """All of an image but for its border."""
        return cls((MARGIN, MARGIN, shape[1] - 1 - MARGIN, shape[0] - 1 - MARGIN))


def with_rgbmidic(f: AnyArray, g: AnyArray, threads: int, placing: Placing | None = None) -> Points:
    from rgbmidic import correlate

    placing = placing or Placing.inside(f.shape)
    found = correlate(f, g, region=placing.region, element_size=placing.size)
    return found.nodes, found.displacement


def with_pyvale(
    f: AnyArray, g: AnyArray, threads: int, placing: Placing | None = None, *, shape_function: str = "AFFINE"
) -> Points:
    from pyvale import dic  # type: ignore[import-untyped]

    placing = placing or Placing.inside(f.shape)
    left, top, right, bottom = placing.region
    mask = np.zeros(f.shape, dtype=bool)
    mask[top : bottom + 1, left : right + 1] = True
    with tempfile.TemporaryDirectory() as folder:
        dic.calculate_2d(
            *(image.round().astype(np.uint8) for image in (f, g)), mask, [(left + right) // 2, (top + bottom) // 2],
            subset_size=placing.size | 1, subset_step=placing.step or placing.size, max_displacement=32,
            num_threads=threads, shape_function=shape_function, output_basepath=folder, print_level=0,
        )  # fmt: skip
        found = dic.import_2d(str(next(Path(folder).glob("*.csv"))), layout="column", binary=False, delimiter=",")
    x, y, u, v = (np.asarray(p, dtype=float).ravel() for p in (found.ss_x, found.ss_y, found.u_px, found.v_px))
    return np.stack([x, y], axis=1), np.stack([u, v], axis=1)


def with_pyxel(f: AnyArray, g: AnyArray, threads: int, placing: Placing | None = None) -> Points:
    import pyxel  # type: ignore[import-untyped]

    def image(pixels: AnyArray) -> Any:
        made = pyxel.Image("array")
        made.pix = pixels.copy()
        return made

    placing = placing or Placing.inside(f.shape)
    left, top, right, bottom = placing.region
    with contextlib.redirect_stdout(io.StringIO()):
        corners = np.array([[left, top], [right, bottom]])
        mesh, camera = pyxel.MeshFromROI(corners, [placing.size, placing.size], typel=2)
        mesh.Connectivity()
        found = np.asarray(pyxel.Correlate(image(f), image(g), mesh, camera, disp=False)[0])
    u, v = (found[mesh.conn[:, axis]] for axis in (0, 1))
    return np.stack([mesh.n[:, 0], -mesh.n[:, 1]], axis=1), np.stack([u, -v], axis=1)


def with_aldic(f: AnyArray, g: AnyArray, threads: int, placing: Placing | None = None, *, whole: bool = True) -> Points:
    import al_dic  # type: ignore[import-untyped]
    from al_dic.core.data_structures import GridxyROIRange

    placing = placing or Placing.inside(f.shape)
    left, top, right, bottom = placing.region
    settings = al_dic.dicpara_default(
        winsize=placing.size // 2 * 2, winstepsize=32,  # as pyvale's subsets; its step is a power of two
        img_size=f.shape, gridxy_roi_range=GridxyROIRange((left, right), (top, bottom)),
        reference_mode="accumulative", use_global_step=whole, size_of_fft_search_region=32, show_plots=False,
    )  # fmt: skip
    found = al_dic.run_aldic(settings, [f / 255, g / 255], [np.ones(f.shape)] * 2, compute_strain=False)
    return found.dic_mesh.coordinates_fem, found.result_disp[0].U.reshape(-1, 2)


def with_mudic(f: AnyArray, g: AnyArray, threads: int, placing: Placing | None = None) -> Points:
    import muDIC  # type: ignore[import-untyped]
    from muDIC.IO.image_stack import image_stack_from_list  # type: ignore[import-untyped]

    placing = placing or Placing.inside(f.shape)
    left, top, right, bottom = placing.region
    corners = {"Xc1": float(left), "Xc2": float(right), "Yc1": float(top), "Yc2": float(bottom)}
    with contextlib.redirect_stdout(io.StringIO()):
        stack = image_stack_from_list([np.asarray(image, dtype=float) for image in (f, g)])
        mesh = muDIC.Mesher(deg_e=1, deg_n=1, type="q4").mesh(
            stack, **corners, n_elx=round((right - left) / placing.size),
            n_ely=round((bottom - top) / placing.size), GUI=False,
        )  # fmt: skip
        found = muDIC.DICAnalysis(muDIC.DICInput(mesh, stack, maxit=40, ref_update_frames=[])).run()
    x, y = (np.asarray(nodes, dtype=float) for nodes in (found.xnodesT, found.ynodesT))
    return np.stack([x[:, 0], y[:, 0]], axis=1), np.stack([x[:, 1] - x[:, 0], y[:, 1] - y[:, 0]], axis=1)


CONTENDERS: dict[str, Callable[..., Points]] = {
    "rgbmidic": with_rgbmidic,
    "pyvale": with_pyvale,
    "pyxel-dic": with_pyxel,
    "al-dic": with_aldic,
    "al-dic local": partial(with_aldic, whole=False),
    "muDIC": with_mudic,
    "pyvale quadratic": partial(with_pyvale, shape_function="QUAD"),
}
MODULES = {"al-dic": "al_dic", "al-dic local": "al_dic", "pyxel-dic": "pyxel", "pyvale quadratic": "pyvale"}
"""Modules that they need, where it is not their name."""


def peers_python(names: Sequence[str]) -> tuple[str, list[str]]:
    """The Python that PEERS_PYTHON names, and the contenders.

    Raises
    ------
    RuntimeError
        It has not all of them.
    """
    python = os.environ.get("PEERS_PYTHON", sys.executable)
    code = "import importlib.util as u, sys; print(*(n for n in sys.argv[1:] if u.find_spec(n)))"
    modules = {name: MODULES.get(name, name) for name in names if name != "rgbmidic"}
    done = subprocess.run([python, "-c", code, *modules.values()], capture_output=True, text=True, check=True)
    if missing := [name for name, module in modules.items() if module not in done.stdout.split()]:
        raise RuntimeError(f"PEERS_PYTHON names a Python with {', '.join(names)}; {python} has no {', '.join(missing)}")
    return python, list(names)


def environment(python: str) -> dict[str, str]:
    """One thread, and this checkout first; but this Python's own package, whose kernels are compiled."""
    variables = ("RGBMIDIC_THREADS", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    package = Path(rgbmidic.__file__).parents[1] if python == sys.executable else ROOT
    path = os.pathsep.join(map(str, (package, ROOT, ROOT / "calibration")))
    return {**os.environ, **dict.fromkeys(variables, "1"), "PYTHONPATH": path}


def displacements(
    python: str, name: str, pairs: dict[str, tuple[AnyArray, AnyArray, Placing]]
) -> dict[str, Points | None]:
    """What a contender measures of pairs, in a process of the Python that has it; None where it fails."""
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        for number, (f, g, placing) in enumerate(pairs.values()):
            np.savez(folder / f"{number}.npz", f=f, g=g, placing=(*placing.region, placing.size, placing.step))
        subprocess.run(
            [python, "-m", "benchmarks.contenders", name, str(folder)],
            env=environment(python), cwd=folder, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        found: dict[str, Points | None] = {}
        for number, pair in enumerate(pairs):
            path = folder / f"found_{number}.npz"
            found[pair] = None
            if path.exists():
                with np.load(path) as content:
                    found[pair] = content["points"], content["displacement"]
        return found


def main(name: str, folder: Path) -> None:
    """Measure the pairs of a folder, each by itself; one that fails leaves no file."""
    for path in sorted(folder.glob("[0-9]*.npz")):
        with np.load(path) as content:
            f, g, (left, top, right, bottom, size, step) = content["f"], content["g"], content["placing"].tolist()
        with contextlib.suppress(Exception):  # what a peer cannot do is a result, too
            points, displacement = CONTENDERS[name](f, g, 1, Placing((left, top, right, bottom), size, step))
            np.savez(folder / f"found_{path.stem}.npz", points=points, displacement=displacement)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
