"""Calibrations for a person at the bench: the tables that the sub-commands print."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from rgbmidic.cli.command import name_options
from rgbmidic.fields.plane import LENS_PARAMETERS, CameraCalibration
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.checks import Check, reported
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import CameraNoise
from rgbmidic.text import format_with_std
from rgbmidic.tools.stereo import PAIR_PARAMETERS, CameraPair
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
    table.add_row("varies over field, rms", *(f"{variation.rms:.5f}" for variation in variations))
    table.add_row("  by chance, p", *(f"{variation.p_value:.2g}" for variation in variations))
    table.add_row("strength drift, %", *(f"{100 * fit.intensity_drift:.2f}" for fit in fits))
    _print([*_warning_lines(estimate.warnings), table, words, _written_line(out)])


def noise(estimate: NoiseEstimate, out: Path) -> None:
    """Print the noise figures per plane and the warnings."""
    _print([*_warning_lines(estimate.warnings), *_noise(estimate.camera_noise), _written_line(out)])


def registration(estimate: RegistrationEstimate, out: Path) -> None:
    """Print the parameters of every light, how well they fit, and the warnings."""
    fits = (
        f"{escape(match.name)}: residual {match.rms:.3f} px rms per node, "
        f"{100 * float(match.is_used.mean()):.0f} % of the nodes used"
        for match in estimate.matches
    )
    size = f"elements of {estimate.element_size:g} px"
    _print([*_warning_lines(estimate.warnings), _registration(estimate.registration), *fits, size, _written_line(out)])


def camera(result: CameraCalibration, file: Path, *, is_written: bool = True) -> None:
    """Print the parameters of lens and plane with their standard uncertainty, how they were found, and the warnings."""
    details = dict(result.details)
    lines: list[str | Table] = list(_warning_lines(details.get("warnings", ())))
    if result.lens is not None:
        table = _table("Lens", ("parameter", "value", "standard uncertainty"))
        for name, value, variance in zip(LENS_PARAMETERS, result.lens, np.diag(result.covariance), strict=False):
            unit = " px" if name in ("f", "cx", "cy") else ""
            table.add_row(name, f"{value:.6g}{unit}", f"{np.sqrt(variance):.2g}{unit}" if variance else "not taken up")
        lines.append(table)
    if lens := details.get("lens"):
        tests = ", ".join(f"{name}: p = {value:.2g}" for name, value in lens["p_values"].items())
        lines.append(
            f"{len(lens['views'])} views, up to {lens['largest_angle_deg']:.0f} degrees apart, over "
            f"{lens['covered']:.0%} of the frame; residual {lens['rms_px']:.3f} px rms; {tests}"
        )
    if result.homography is not None:
        residual = f"; residual {details['plane']['rms_px']:.3f} px rms" if "plane" in details else ""
        lines.append(f"plane: {result.summary()}{residual}")
    lines.append(f"frames of {result.shape[1]} x {result.shape[0]} px")
    _print([*lines, _written_line(file) if is_written else escape(str(file))])


def stereo(pair: CameraPair, file: Path, *, is_written: bool = True) -> None:
    """Print both lenses and the relative pose with their standard uncertainty, both verdicts, and the warnings."""
    details = dict(pair.details)
    lines: list[str | Table] = list(_warning_lines(details.get("warnings", ())))
    table = _table("Two cameras", ("parameter", "value", "standard uncertainty"))
    for name, value, variance in zip(PAIR_PARAMETERS, pair.parameters, np.diag(pair.covariance), strict=True):
        unit = {"f": " px", "cx": " px", "cy": " px", "rotation": " rad", "translation": " mm"}
        unit_text = unit.get(name.split("_")[1] if name[0] in "lr" and name[:3] != "rot" else name.split("_")[0], "")
        if value or variance:
            table.add_row(name.replace("_", " "), f"{value:.7g}{unit_text}", f"{np.sqrt(variance):.2g}{unit_text}")
    lines.append(table)
    if rms := details.get("rms_px"):
        lines.append(
            f"{len(details['views'])} views; residual {rms['left']:.3f} px rms left, {rms['right']:.3f} px right"
        )
    if held_out := details.get("held_out"):
        std = held_out.get("relative_length_std", float("nan"))
        lines.append(
            f"on {len(held_out['views'])} views held out: epipolar residual {held_out['epipolar_px']:.3f} px rms, "
            f"a length on the target {format_with_std(100 * held_out['relative_length_error'], 100 * std, '%')} off"
        )
    lines.append(pair.summary())
    _print([*lines, _written_line(file) if is_written else escape(str(file))])


def verdict(checks: Sequence[Check]) -> None:
    """Print every figure with its limit, and the verdict."""
    table = _table("Check of the calibration", ("figure", "value", "limit", ""))
    figures = [check for check in checks if check.name]
    for item in figures:
        word = "[green]passed[/]" if item.passed else "[bold red]failed[/]"
        figure = format_with_std(item.value, item.std, item.unit)
        table.add_row(escape(item.name), figure, f"{item.limit:g} {item.unit}", word)
    doubts = [check.text for check in reported(checks) if not check.name]
    sums = (escape(item.text) for item in figures if item.text)
    skipped = (
        f"[dim]{escape(name_options(check.text))}[/]" for check in checks if not check.name and check.text not in doubts
    )
    failed = sum(not item.passed for item in figures)
    words = f"[bold red]FAILED[/]: {failed} of {len(figures)} figures break their limit"
    _print([*_warning_lines(doubts), table, *sums, *skipped, words if failed else "[bold green]PASSED[/]"])


def designs(ranked_sets: Sequence[Design]) -> None:
    """Print the predicted matrix of the best set of lamps, and how the other sets compare."""
    best = ranked_sets[0]
    table, words = _matrix(best.crosstalk)
    table.title = "Predicted crosstalk of the best set" if len(ranked_sets) > 1 else "Predicted crosstalk"
    table.add_row("relative lamp power", *(f"{value:.2f}" for value in best.power))
    _print([table, words, f"with all lights on, each may reach {100 * best.headroom:.0f} % of full scale"])
    if len(ranked_sets) == 1:
        return
    heads = ("lamps", "condition number", "noise amplification")
    ranking = _table("Sets of lamps, least noise first", heads, justify="left")
    for candidate in ranked_sets:
        matrix = candidate.crosstalk
        amplification = " ".join(f"{value:.2f}" for value in matrix.noise_amplification)
        ranking.add_row(escape(", ".join(matrix.lights)), f"{matrix.condition_number:.2f}", amplification)
    _print([ranking])


def merged(result: Calibration, out: Path) -> None:
    """Print which sections a merged file has."""
    _print([f"sections: {', '.join(_sections(result))}", _written_line(out)])


def calibration(result: Calibration, path: Path) -> None:
    """Print the content of a calibration file."""
    names = {"kind": "kind", "cfa": "pattern", "black_level": "black level", "white_level": "white level"}
    settings_text = [f"{word} {value}" for name, word in names.items() if (value := getattr(result, name)) is not None]
    settings_text += [f"{result.shape[1]} x {result.shape[0]} px"] if result.shape else []
    lines: list[str | Table] = [f"[bold]{escape(str(path))}[/]: {', '.join(_sections(result)) or 'empty'}"]
    lines.append(f"camera: {', '.join(settings_text) or 'nothing stated'}")
    if result.crosstalk is not None:
        lines += _matrix(result.crosstalk)
        if result.crosstalk.green_difference is None and "bayer" in result.kinds:
            lines.append("the two greens are taken as equal: measure the crosstalk again to know their difference")
    if result.camera_noise is not None:
        lines += _noise(result.camera_noise)
    elif result.noise is not None:
        lines.append(f"noise: gain {result.noise.gain:.4g} e-/DN, read noise {result.noise.read_noise:.4g} DN")
    if result.registration is not None:
        lines.append(_registration(result.registration))
    for section, origin in result.provenance.items():
        if isinstance(origin, dict):
            files = len(origin.get("inputs", ()))
            lines.append(f"{section}: {files} files, {origin.get('date', '?')}, version {origin.get('version', '?')}")
            lines += _warning_lines(origin.get("warnings", ()))
    _print(lines)


def _print(lines: Iterable[str | Table]) -> None:
    Console(highlight=False).print(*lines, sep="\n")


def _table(title: str, heads: Sequence[str], justify: Literal["left", "right"] = "right") -> Table:
    """Return a table whose first column is text, never wrapped."""
    table = Table(title=title, title_justify="left")
    for index, head in enumerate(heads):
        table.add_column(escape(head), justify=justify if index else "left", no_wrap=index == 0)
    return table


def _warning_lines(warnings: Sequence[str]) -> list[str]:
    return [f"[yellow]warning:[/] {escape(name_options(warning))}" for warning in warnings]


def _written_line(out: Path) -> str:
    return f"written: {escape(str(out))}"


def _sections(result: Calibration) -> list[str]:
    return [name for name in ("crosstalk", "noise", "registration") if getattr(result, name) is not None]


def _registration(result: Registration) -> Table:
    """Return the parameters of every light with their uncertainties."""
    heads = ("light", "x (px)", "y (px)", "rotation (mrad)", "scale (1e-3)", "radial (1e-3)")
    table = _table(f"Registration against {escape(result.lights[0])}", heads)
    factors = np.array([1, 1, 1e3, 1e3, 1e3])
    for index, name in enumerate(result.lights[1:], start=1):
        values = result.parameters[index] * factors
        std = None if result.covariance is None else np.sqrt(np.diag(result.covariance[index])) * factors
        table.add_row(escape(name), *map(format_with_std, values, np.zeros_like(values) if std is None else std))
    return table


def _matrix(result: Crosstalk) -> tuple[Table, str]:
    """Return the matrix with its uncertainties, and what it means for the noise."""
    heads = ("channel", *result.lights)
    table, std = _table("Crosstalk: camera channels = A . lights (± standard uncertainty)", heads), result.std
    for row, values in enumerate(result.matrix):
        cells = map(format_with_std, values, np.where(values == 1, 0, 0 if std is None else std[row]))
        table.add_row(CHANNELS[row] if len(result.matrix) == 3 else str(row + 1), *cells)
    table.add_section()
    if (difference := result.green_difference) is not None:
        std = np.zeros_like(difference) if result.green_difference_std is None else result.green_difference_std
        table.add_row("G red rows - blue rows", *map(format_with_std, difference, std))
        for name, figures in (("checkerboard if equal", difference), ("  with both rows of G", std)):
            amplitudes = 100 * np.abs(result.checkerboard(figures)).max(axis=0)
            table.add_row(f"{name}, %", *(f"{value:.2g}" for value in amplitudes))
        table.add_section()
    table.add_row("noise amplification", *(f"{value:.2f}" for value in result.noise_amplification))
    field = "is the same everywhere" if result.field is None else f"varies over the field (degree {result.field.order})"
    words = f"condition number {result.condition_number:.2f}; A {field}"
    if (leakage := result.leakage_std) is not None:
        words += f"; its uncertainty leaves at most {100 * leakage.max():.3f} % of one light in another (1 sigma)"
    return table, words


def _noise(result: CameraNoise) -> tuple[Table, str]:
    """Return the figures of every plane, and the number of defects."""
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
        table.add_row(name, *map(format_with_std, quantity.value, quantity.std))
    table.add_row("dynamic range, dB", *(f"{value:.1f}" for value in result.dynamic_range))
    counts = [f"{sum(kind == name for *_, kind in result.defects)} {name}" for name in ("hot", "dead")]
    return table, f"pixels to distrust: {', '.join(counts)}"
