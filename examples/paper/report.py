"""The report of a study: tables, pictures and a page that sets the paper's statements beside the figures measured."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from causes import RADIUS, Cause
from claims import Claim, judge
from figures import draw_figures
from measurement import METHODS, PaperStudy, SceneStudy
from page import Page
from rgbmidic import __version__
from rgbmidic.errors import ResultError
from rgbmidic.tools.report import save_figure

_SCENES = {
    "sequential": "two white lamps in succession, monochrome camera",
    "bayer": "three colours at once, one Bayer shot",
}


def check_folder(out: Path | str, *, overwrite: bool = False) -> Path:
    """The folder for a study, made where it does not exist, refused where it holds something that must be kept."""
    out = Path(out)
    try:
        if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not overwrite)):
            raise ResultError(
                f"{out} is there and not empty; choose another folder, or overwrite it (overwrite=True, --overwrite)"
            )
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultError(f"{out} cannot be made: {error.strerror or error}") from None
    return out


def write_study(study: PaperStudy, out: Path | str, *, overwrite: bool = False) -> tuple[Claim, ...]:
    """Write tables (CSV), pictures, ``report.md`` and ``report.html``; gives the statements with their verdicts."""
    folder = check_folder(out, overwrite=overwrite)
    claims = judge(study)
    _write_tables(study, claims, folder)
    for name, figure in draw_figures(study).items():
        save_figure(figure, folder / name)
    _page(study, claims).write(folder)
    return claims


def _write_tables(study: PaperStudy, claims: Iterable[Claim], folder: Path) -> None:
    perturbation, areas, solves = [], [], []
    for scene in study.scenes:
        for method in METHODS:
            for angle in scene.angles:
                one, state = scene.measurements[method, angle], (scene.bench.name, method, angle)
                for number, area in enumerate(scene.bench.areas):
                    perturbation.append([*state, area.name, one.perturbation[number]])
                    areas.append([*state, area.name, *one.mean[:, number], one.error[number]])
        for (method, angle), one in scene.measurements.items():
            solves.append([scene.bench.name, method, angle, one.status, one.measured, one.residual, one.frontier])
    state = ("scene", "method", "angle_deg")
    _write_csv(folder / "perturbation.csv", (*state, "area", "P_px"), perturbation)
    _write_csv(folder / "areas.csv", (*state, "area", "mean_u_px", "mean_v_px", "error_v_px"), areas)
    header = (*state, "status", "measured_fraction", "residual_percent", "frontier_ratio")
    _write_csv(folder / "solves.csv", header, solves)
    turning = study.goniometry
    pixels = [f"pixel_{i}" for i in range(turning.levels.shape[1])]
    _write_csv(folder / "goniometry.csv", ("angle_deg", *pixels), np.column_stack([turning.angles_deg, turning.levels]))
    columns = ("figure", "scene", "statement", "measured", "verdict", "reason")
    _write_csv(folder / "claims.csv", columns, ([getattr(claim, c) for c in columns] for claim in claims))


def _write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A table; numbers with six digits, an empty field where there is none."""

    def cell(value: Any) -> Any:
        if not isinstance(value, float | np.floating):
            return value
        return f"{float(value):.6g}" if np.isfinite(value) else ""

    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([header, *([cell(value) for value in row] for row in rows)])


def _page(study: PaperStudy, claims: Sequence[Claim]) -> Page:
    page = Page("The paper's results on the virtual bench")
    angles = ", ".join(f"{angle:g}" for angle in study.angles)
    page.text(
        f"rgbmidic {__version__}; frames of {study.size} px, angles {angles}°, seed {study.seed}. P is the standard "
        "deviation over 50 x 100 px of the vertical displacement minus its Gaussian-filtered copy (40 px); the mesh is "
        "TRI3 with 25 px. The paper's methods are as in the paper: linear elements, each light's own gradient, grey "
        "levels as recorded, weights binary; 'our solver' has the same images and masks. Nothing here was adjusted to "
        "the paper's P: the paint is that of `rgbmidic.tools.lab.virtual.paper_scene`."
    )
    page.heading("Statements of the paper and what was measured")
    verdicts = [claim.verdict for claim in claims]
    counts = {v: verdicts.count(v) for v in ("reproduced", "in part", "not reproduced", "not measured")}
    page.text(f"{len(claims)} tests: " + ", ".join(f"{n} {verdict}" for verdict, n in counts.items() if n) + ".")
    header = ("paper", "statement", "measured here", "verdict", "why it differs")
    for scene in ("", *(one.bench.name for one in study.scenes)):
        rows = [(c.figure, c.statement, c.measured, c.verdict, c.reason) for c in claims if c.scene == scene]
        page.text(f"Scene `{scene}`: {_SCENES[scene]}." if scene else "The flat specimen.")
        page.table(header, rows)
    for scene_study in study.scenes:
        _scene_section(page, scene_study)
    page.heading("The flat specimen")
    page.picture("fig09_goniometry.png", "Fig. 9: grey level of 40 pixels against the angle of the light")
    page.picture("fig10_11_topography.png", "Figs 10 and 11: intensity, height, and slope with the pixels of 55 um")
    _causes_section(page, study.causes)
    return page


def _scene_section(page: Page, scene: SceneStudy) -> None:
    name = scene.bench.name
    page.heading(f"Scene {name}: {_SCENES[name]}")
    page.picture(f"{name}_fig04_images.png", "Fig. 4: the reflection at the first and the last angle, and the areas")
    page.picture(f"{name}_fig07_08_13_17_perturbation.png", "Figs 7, 8, 13 and 17: perturbation P of the areas")
    page.table(
        ("method", "angle (°)", *(area.name for area in scene.bench.areas), "A3/A0", "A4/A0"), list(_table(scene))
    )
    page.text("P in 1e-3 px; a dash where less than half of the area was measured.")
    page.picture(f"{name}_ripple.png", "What P is taken from: the vertical displacement without its long waves")
    page.picture(f"{name}_fig05_dic.png", "Fig. 5: vertical displacement by plain DIC")
    page.picture(f"{name}_fig06_means.png", "Fig. 6: mean displacement of the areas, plain DIC")
    if scene.threshold is not None:
        page.picture(f"{name}_fig14_threshold.png", "Fig. 14: how the weighting threshold is found")
    page.picture(f"{name}_fig15_midic.png", "Fig. 15: vertical displacement by MIDIC")
    page.picture(f"{name}_fig16_masks.png", "Fig. 16: excluded zones (orange), reference and deformed state together")


def _table(scene: SceneStudy) -> Iterator[tuple[str, ...]]:
    for method, settings in METHODS.items():
        for angle, row in zip(scene.angles, scene.perturbation(method), strict=True):
            ratios = ["-" if np.isnan(ratio) else f"{ratio:.2f}" for ratio in row[3:] / row[0]]
            yield settings.title, f"{angle:g}", *("-" if np.isnan(p) else f"{1000 * p:.1f}" for p in row), *ratios


def _causes_section(page: Page, causes: Sequence[Cause]) -> None:
    if not causes:
        return
    page.heading("Causes: one thing changed at a time")
    page.text(
        f"P in 1e-3 px within {RADIUS:g} px of the middle of the reflection / far from it. Plain DIC suffers from the "
        "reflection's brightness as such: paint without any roughness that reflects as much on average gives the same "
        "P, and P follows the gloss. Grey-level correction removes that part; what it leaves is the erratic part: on "
        "flat, smooth paint it leaves hardly more than noise. Away from the reflection P of plain DIC rises with the "
        "angle because the diffuse light changes with its incidence, with wrinkles and without them."
    )
    angles = causes[0].angles
    rows = [
        (
            cause.title,
            *(
                f"{1000 * inside:.1f} / {1000 * outside:.1f}"
                for inside, outside in zip(cause.inside.flat, cause.outside.flat, strict=True)
            ),
        )
        for cause in causes
    ]
    header = ("change", *(f"{method} {angle:g}°" for method in ("DIC", "GLC-DIC") for angle in angles))
    page.table(header, rows)
