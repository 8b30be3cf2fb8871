"""Tables that the sub-commands print, for a person at the bench."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from rgbmidic.fields.plane import LENS_PARAMETERS, CameraCalibration
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.checks import Check, reported
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import CameraNoise
from rgbmidic.text import uncertain
from rgbmidic_calibration.crosstalk import CHANNELS, CrosstalkEstimate
from rgbmidic_calibration.design import Design
from rgbmidic_calibration.noise import NoiseEstimate
from rgbmidic_calibration.registration import RegistrationEstimate


def crosstalk(estimate: CrosstalkEstimate, out: Path) -> None:
    """Print the matrix with its uncertainties, what it means for the noise, and the warnings."""
    table, words = _matrix(estimate.crosstalk)
    fits, variations = estimate.lights, estimate.variations
    table.add_row("signal, DN", *(f"{fit.level:.0f}" for fit in fits))
    table.add_row("captures", *(str(len(fit.weights)) for fit in fits))
    table.add_row("blocks used, %", *(f"{100 * fit.weights.mean():.0f}" for fit in fits))
    table.add_row("varies over field, rms", *(f"{found.rms:.5f}" for found in variations))
    table.add_row("  by chance, p", *(f"{found.p_value:.2g}" for found in variations))
    table.add_row("strength drift, %", *(f"{100 * fit.intensity_drift:.2f}" for fit in fits))
    _print([*_marked(estimate.warnings), table, words, _written(out)])


def noise(estimate: NoiseEstimate, out: Path) -> None:
    """Print the noise figures per plane and the warnings."""
    _print([*_marked(estimate.warnings), *_noise(estimate.camera_noise), _written(out)])


def registration(estimate: RegistrationEstimate, out: Path) -> None:
    """Print the parameters of every light, how well they fit, and the warnings."""
    fits = (
        f"{escape(match.name)}: residual {match.rms:.3f} px rms per node, "
        f"{100 * float(match.used.mean()):.0f} % of the nodes used"
        for match in estimate.matches
    )
    _print([*_marked(estimate.warnings), _registration(estimate.registration), *fits, _written(out)])


def camera(found: CameraCalibration, file: Path, *, written: bool = True) -> None:
    """Print the parameters of lens and plane with their standard uncertainty, how they were found, and the warnings."""
    details = dict(found.details)
    parts: list[str | Table] = list(_marked(details.get("warnings", ())))
    if found.lens is not None:
        table = _table("Lens", ("parameter", "value", "standard uncertainty"))
        for name, value, variance in zip(LENS_PARAMETERS, found.lens, np.diag(found.covariance), strict=False):
            unit = " px" if name in ("f", "cx", "cy") else ""
            table.add_row(name, f"{value:.6g}{unit}", f"{np.sqrt(variance):.2g}{unit}" if variance else "not taken up")
        parts.append(table)
    if lens := details.get("lens"):
        tests = ", ".join(f"{name}: p = {value:.2g}" for name, value in lens["p_values"].items())
        parts.append(
            f"{len(lens['views'])} views, up to {lens['largest_angle_deg']:.0f} degrees apart, over "
            f"{lens['covered']:.0%} of the frame; residual {lens['rms_px']:.3f} px rms; {tests}"
        )
    if found.homography is not None:
        residual = f"; residual {details['plane']['rms_px']:.3f} px rms" if "plane" in details else ""
        parts.append(f"plane: {found.summary()}{residual}")
    parts.append(f"frames of {found.shape[1]} x {found.shape[0]} px")
    _print([*parts, _written(file) if written else escape(str(file))])


def verdict(checks: Sequence[Check]) -> None:
    """Print every figure with its limit, and the verdict."""
    table = _table("Check of the calibration", ("figure", "value", "limit", ""))
    figures = [check for check in checks if check.name]
    for item in figures:
        word = "[green]passed[/]" if item.passed else "[bold red]failed[/]"
        figure = uncertain(item.value, item.std, item.unit)
        table.add_row(escape(item.name), figure, f"{item.limit:g} {item.unit}", word)
    doubts = [check.text for check in reported(checks) if not check.name]
    sums = (escape(item.text) for item in figures if item.text)
    skipped = (f"[dim]{escape(check.text)}[/]" for check in checks if not check.name and check.text not in doubts)
    failed = sum(not item.passed for item in figures)
    words = f"[bold red]FAILED[/]: {failed} of {len(figures)} figures break their limit"
    _print([*_marked(doubts), table, *sums, *skipped, words if failed else "[bold green]PASSED[/]"])


def designs(found: Sequence[Design]) -> None:
    """Print the predicted matrix of the best set of lamps, and how the other sets compare."""
    best = found[0]
    table, words = _matrix(best.crosstalk)
    table.title = "Predicted crosstalk of the best set" if len(found) > 1 else "Predicted crosstalk"
    table.add_row("relative lamp power", *(f"{value:.2f}" for value in best.power))
    _print([table, words, f"with all lights on, each may reach {100 * best.headroom:.0f} % of full scale"])
    if len(found) == 1:
        return
    heads = ("lamps", "condition number", "noise amplification")
    ranking = _table("Sets of lamps, least noise first", heads, justify="left")
    for candidate in found:
        matrix = candidate.crosstalk
        amplification = " ".join(f"{value:.2f}" for value in matrix.noise_amplification)
        ranking.add_row(escape(", ".join(matrix.lights)), f"{matrix.condition_number:.2f}", amplification)
    _print([ranking])


def merged(result: Calibration, out: Path) -> None:
    """Print which sections a merged file has."""
    _print([f"sections: {', '.join(_sections(result))}", _written(out)])


def calibration(result: Calibration, path: Path) -> None:
    """Print the content of a calibration file."""
    names = {"kind": "kind", "cfa": "pattern", "black_level": "black level", "white_level": "white level"}
    stated = [f"{word} {value}" for name, word in names.items() if (value := getattr(result, name)) is not None]
    stated += [f"{result.shape[1]} x {result.shape[0]} px"] if result.shape else []
    parts: list[str | Table] = [f"[bold]{escape(str(path))}[/]: {', '.join(_sections(result)) or 'empty'}"]
    parts.append(f"camera: {', '.join(stated) or 'nothing stated'}")
    if result.crosstalk is not None:
        parts += _matrix(result.crosstalk)
    if result.camera_noise is not None:
        parts += _noise(result.camera_noise)
    elif result.noise is not None:
        parts.append(f"noise: gain {result.noise.gain:.4g} e-/DN, read noise {result.noise.read_noise:.4g} DN")
    if result.registration is not None:
        parts.append(_registration(result.registration))
    for section, origin in result.provenance.items():
        if isinstance(origin, dict):
            files = len(origin.get("inputs", ()))
            parts.append(f"{section}: {files} files, {origin.get('date', '?')}, version {origin.get('version', '?')}")
            parts += _marked(origin.get("warnings", ()))
    _print(parts)


def _print(parts: Iterable[str | Table]) -> None:
    Console(highlight=False).print(*parts, sep="\n")


def _table(title: str, heads: Sequence[str], justify: Literal["left", "right"] = "right") -> Table:
    """A table whose first column is text, never wrapped."""
    table = Table(title=title, title_justify="left")
    for index, head in enumerate(heads):
        table.add_column(escape(head), justify=justify if index else "left", no_wrap=index == 0)
    return table


def _marked(warnings: Sequence[str]) -> list[str]:
    return [f"[yellow]warning:[/] {escape(warning)}" for warning in warnings]


def _written(out: Path) -> str:
    return f"written: {escape(str(out))}"


def _sections(result: Calibration) -> list[str]:
    return [name for name in ("crosstalk", "noise", "registration") if getattr(result, name) is not None]


def _registration(result: Registration) -> Table:
    """The parameters of every light with their uncertainties."""
    heads = ("light", "x (px)", "y (px)", "rotation (mrad)", "scale (1e-3)", "radial (1e-3)")
    table = _table(f"Registration against {escape(result.lights[0])}", heads)
    factors = np.array([1, 1, 1e3, 1e3, 1e3])
    for index, name in enumerate(result.lights[1:], start=1):
        values = result.parameters[index] * factors
        std = None if result.covariance is None else np.sqrt(np.diag(result.covariance[index])) * factors
        table.add_row(escape(name), *map(uncertain, values, np.zeros_like(values) if std is None else std))
    return table


def _matrix(result: Crosstalk) -> tuple[Table, str]:
    """The matrix with its uncertainties, and what it means for the noise."""
    heads = ("channel", *result.lights)
    table, std = _table("Crosstalk: camera channels = A . lights (± standard uncertainty)", heads), result.std
    for row, values in enumerate(result.matrix):
        cells = map(uncertain, values, np.where(values == 1, 0, 0 if std is None else std[row]))
        table.add_row(CHANNELS[row] if len(result.matrix) == 3 else str(row + 1), *cells)
    table.add_section()
    table.add_row("noise amplification", *(f"{value:.2f}" for value in result.noise_amplification))
    field = "is the same everywhere" if result.field is None else f"varies over the field (degree {result.field.order})"
    words = f"condition number {result.condition_number:.2f}; A {field}"
    if (leakage := result.leakage_std) is not None:
        words += f"; its uncertainty leaves at most {100 * leakage.max():.3f} % of one light in another (1 sigma)"
    return table, words


def _noise(result: CameraNoise) -> tuple[Table, str]:
    """The figures of every plane, and the number of defects."""
    table = _table("Camera noise (EMVA 1288; ± standard uncertainty)", ("", *result.planes))
    rows = (
        ("gain 1/K, e-/DN", result.gain),
        ("dark noise, DN", result.read_noise),
        ("dark noise, e-", result.dark_noise),
        ("black level, DN", result.black_level),
        ("saturation, DN", result.saturation),
        ("full well, e-", result.full_well),
        ("linearity LE, %", result.linearity_error),
        ("DSNU, DN", result.dsnu),
        ("PRNU, %", result.prnu),
    )
    for name, quantity in rows:
        table.add_row(name, *map(uncertain, quantity.value, quantity.std))
    table.add_row("dynamic range, dB", *(f"{value:.1f}" for value in result.dynamic_range))
    counts = [f"{sum(kind == name for *_, kind in result.defects)} {name}" for name in ("hot", "dead")]
    return table, f"pixels to distrust: {', '.join(counts)}"
