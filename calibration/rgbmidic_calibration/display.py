"""Tables that the sub-commands print, for a person at the bench."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from rgbmidic.fields.plane import LENS_PARAMETERS
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.linear import CameraNoise, Quantity
from rgbmidic.illumination.registration import Registration
from rgbmidic_calibration.camera import CameraEstimate
from rgbmidic_calibration.crosstalk import CHANNELS, CrosstalkEstimate
from rgbmidic_calibration.design import Design
from rgbmidic_calibration.noise import NoiseEstimate
from rgbmidic_calibration.registration import RegistrationEstimate
from rgbmidic_calibration.verdict import Verdict

__all__ = [
    "calibration",
    "camera",
    "crosstalk",
    "designs",
    "merged",
    "noise",
    "registration",
    "registration_table",
    "verdict",
]


def crosstalk(estimate: CrosstalkEstimate, out: Path) -> None:
    """Print the matrix with its uncertainties, what it means for the noise, and the warnings."""
    console = Console(highlight=False)
    _warnings(console, estimate.warnings)
    table = _matrix_table(estimate.crosstalk)
    table.add_row("signal, DN", *(f"{fit.signal:.0f}" for fit in estimate.lights))
    table.add_row("captures", *(str(fit.captures) for fit in estimate.lights))
    table.add_row("blocks used, %", *(f"{100 * fit.used:.0f}" for fit in estimate.lights))
    table.add_row("varies over field, rms", *(f"{fit.variation.rms:.5f}" for fit in estimate.lights))
    table.add_row("  by chance, p", *(f"{fit.variation.p_value:.2g}" for fit in estimate.lights))
    table.add_row("strength drift, %", *(f"{100 * fit.intensity_drift:.2f}" for fit in estimate.lights))
    console.print(table)
    console.print(_matrix_words(estimate.crosstalk))
    _written(console, out)


def noise(estimate: NoiseEstimate, out: Path) -> None:
    """Print the noise figures per plane and the warnings."""
    console = Console(highlight=False)
    _warnings(console, estimate.warnings)
    console.print(_noise_table(estimate.camera_noise))
    console.print(_defect_words(estimate.camera_noise))
    _written(console, out)


def registration(estimate: RegistrationEstimate, out: Path) -> None:
    """Print the parameters of every light, how well they fit, and the warnings."""
    console = Console(highlight=False)
    _warnings(console, estimate.warnings)
    console.print(registration_table(estimate.registration))
    for match in estimate.matches:
        used = 100 * float(match.used.mean())
        console.print(f"{escape(match.name)}: residual {match.rms:.3f} px rms per node, {used:.0f} % of the nodes used")
    _written(console, out)


def camera(estimate: CameraEstimate, out: Path) -> None:
    """Print the parameters of lens and plane with their standard uncertainty, and the warnings."""
    console = Console(highlight=False)
    _warnings(console, estimate.warnings)
    found, lens, plane = estimate.camera, estimate.lens, estimate.plane
    if found.lens is not None:
        table = Table(title="Lens", title_justify="left")
        for head in ("parameter", "value", "standard uncertainty"):
            table.add_column(head, justify="right")
        for name, value, variance in zip(LENS_PARAMETERS, found.lens, np.diag(found.covariance), strict=False):
            unit = " px" if name in ("f", "cx", "cy") else ""
            table.add_row(name, f"{value:.6g}{unit}", f"{np.sqrt(variance):.2g}{unit}" if variance else "not taken up")
        console.print(table)
    if lens is not None:
        console.print(
            f"{len(estimate.views)} views, up to {lens.angle:.0f} degrees apart, over {lens.covered:.0%} of the frame; "
            f"residual {lens.rms:.3f} px rms; "
            + ", ".join(f"{name}: p = {value:.2g}" for name, value in lens.tests.items())
        )
    if plane is not None:
        (scale, scale_std), (tilt, tilt_std) = found.scale(found.centre), found.tilt_deg
        known = f"tilt {tilt:.2f} ± {tilt_std:.2f} degrees" if np.isfinite(tilt) else "tilt not known without a lens"
        console.print(
            f"plane: {scale:.6g} ± {scale_std:.2g} mm per px in the middle of the frame, {known}; residual "
            f"{plane.rms:.3f} px rms"
        )
    _written(console, out)


def verdict(result: Verdict) -> None:
    """Print every figure with its limit, and the verdict."""
    console = Console(highlight=False)
    _warnings(console, result.warnings)
    table = Table(title="Check of the calibration", title_justify="left")
    table.add_column("figure")
    for head in ("value", "limit", ""):
        table.add_column(head, justify="right")
    for item in result.items:
        figure = f"{item.value:+.3f}" + (f" ± {item.std:.3f}" if item.std else "") + f" {item.unit}"
        word = "[green]passed[/]" if item.passed else "[bold red]failed[/]"
        table.add_row(escape(item.name), figure, f"{item.limit:g} {item.unit}", word)
    console.print(table)
    for total in result.sums:
        console.print(
            f"{'+'.join(total.lights)} minus the sum of the single captures: {total.mean:+.2f} DN on average, scatter "
            f"{total.spread:.2f} DN where noise explains {total.noise:.2f} DN; offset {total.offset:+.2f} DN"
        )
    for text in result.skipped:
        console.print(f"[dim]{escape(text)}[/]")
    failed = sum(not item.passed for item in result.items)
    words = f"[bold red]FAILED[/]: {failed} of {len(result.items)} figures break their limit"
    console.print("[bold green]PASSED[/]" if result.passed else words)


def designs(found: Sequence[Design]) -> None:
    """Print the predicted matrix of the best set of lamps, and how the other sets compare."""
    console = Console(highlight=False)
    best = found[0]
    table = _matrix_table(best.crosstalk)
    table.title = "Predicted crosstalk of the best set" if len(found) > 1 else "Predicted crosstalk"
    table.add_row("relative lamp power", *(f"{value:.2f}" for value in best.power))
    console.print(table)
    console.print(_matrix_words(best.crosstalk))
    console.print(f"with all lights on, each may reach {100 * best.headroom:.0f} % of full scale")
    if len(found) == 1:
        return
    ranking = Table(title="Sets of lamps, least noise first", title_justify="left")
    for head in ("lamps", "condition number", "noise amplification"):
        ranking.add_column(head)
    for candidate in found:
        crosstalk = candidate.crosstalk
        amplification = " ".join(f"{value:.2f}" for value in crosstalk.noise_amplification)
        ranking.add_row(escape(", ".join(crosstalk.lights)), f"{crosstalk.condition_number:.2f}", amplification)
    console.print(ranking)


def merged(result: Calibration, out: Path) -> None:
    """Print which sections a merged file has."""
    console = Console(highlight=False)
    console.print(f"sections: {', '.join(_sections(result))}")
    _written(console, out)


def calibration(result: Calibration, path: Path) -> None:
    """Print the content of a calibration file."""
    console = Console(highlight=False)
    console.print(f"[bold]{escape(str(path))}[/]: {', '.join(_sections(result)) or 'empty'}")
    names = {"kind": "kind", "cfa": "pattern", "black_level": "black level", "white_level": "white level"}
    stated = [f"{word} {value}" for name, word in names.items() if (value := getattr(result, name)) is not None]
    stated += [f"{result.shape[1]} x {result.shape[0]} px"] if result.shape else []
    console.print(f"camera: {', '.join(stated) or 'nothing stated'}")
    if result.crosstalk is not None:
        console.print(_matrix_table(result.crosstalk))
        console.print(_matrix_words(result.crosstalk))
    if result.camera_noise is not None:
        console.print(_noise_table(result.camera_noise))
        console.print(_defect_words(result.camera_noise))
    elif result.noise is not None:
        console.print(f"noise: gain {result.noise.gain:.4g} e-/DN, read noise {result.noise.read_noise:.4g} DN")
    if result.registration is not None:
        console.print(registration_table(result.registration))
    for section, origin in result.provenance.items():
        if isinstance(origin, dict):
            files = len(origin.get("inputs", ()))
            console.print(f"{section}: {files} files, {origin.get('date', '?')}, version {origin.get('version', '?')}")
            _warnings(console, origin.get("warnings", ()))


def registration_table(result: Registration) -> Table:
    """Table of the parameters of every light with their uncertainties."""
    table = Table(title=f"Registration against {escape(result.lights[0])}", title_justify="left")
    for head in ("light", "x, px", "y, px", "rotation, mrad", "scale, 1e-3", "radial, 1e-3"):
        table.add_column(head, justify="left" if head == "light" else "right")
    factors = np.array([1, 1, 1e3, 1e3, 1e3])
    for index, name in enumerate(result.lights[1:], start=1):
        values = result.parameters[index] * factors
        std = None if result.covariance is None else np.sqrt(np.diag(result.covariance[index])) * factors
        cells = [f"{value:.4f}" + ("" if std is None else f" ± {std[term]:.4f}") for term, value in enumerate(values)]
        table.add_row(escape(name), *cells)
    return table


def _sections(result: Calibration) -> list[str]:
    return [name for name in ("crosstalk", "noise", "registration") if getattr(result, name) is not None]


def _matrix_table(result: Crosstalk) -> Table:
    table = Table(title="Crosstalk: camera channels = A . lights (± standard uncertainty)", title_justify="left")
    table.add_column("channel", no_wrap=True)
    for name in result.lights:
        table.add_column(escape(name), justify="right")
    std = result.std
    for row, values in enumerate(result.matrix):
        cells = [_entry(value, None if std is None else std[row, column]) for column, value in enumerate(values)]
        table.add_row(CHANNELS[row] if len(result.matrix) == 3 else str(row + 1), *cells)
    table.add_section()
    table.add_row("noise amplification", *(f"{value:.2f}" for value in result.noise_amplification))
    return table


def _matrix_words(result: Crosstalk) -> str:
    field = "the same everywhere" if result.field is None else f"varies over the field (degree {result.field.order})"
    words = f"condition number {result.condition_number:.2f}; A is {field}"
    if (leakage := result.leakage_std) is not None:
        words += f"; its uncertainty leaves at most {100 * leakage.max():.3f} % of one light in another (1 sigma)"
    return words


def _noise_table(result: CameraNoise) -> Table:
    table = Table(title="Camera noise (EMVA 1288; ± standard uncertainty)", title_justify="left")
    table.add_column("", no_wrap=True)
    for name in result.planes:
        table.add_column(name, justify="right")
    rows: list[tuple[str, Quantity, int]] = [
        ("gain 1/K, e-/DN", result.gain, 3),
        ("dark noise, DN", result.read_noise, 3),
        ("dark noise, e-", result.dark_noise, 2),
        ("black level, DN", result.black_level, 2),
        ("saturation, DN", result.saturation, 0),
        ("full well, e-", result.full_well, 0),
        ("linearity LE, %", result.linearity_error, 3),
        ("DSNU, DN", result.dsnu, 3),
        ("PRNU, %", result.prnu, 3),
    ]
    for name, quantity, digits in rows:
        pairs = zip(quantity.value, quantity.std, strict=True)
        table.add_row(name, *(f"{v:.{digits}f} ± {s:.{digits}f}" if np.isfinite(v) else "-" for v, s in pairs))
    table.add_row("dynamic range, dB", *(f"{value:.1f}" for value in result.dynamic_range))
    return table


def _defect_words(result: CameraNoise) -> str:
    counts = [f"{sum(kind == name for *_, kind in result.defects)} {name}" for name in ("hot", "dead")]
    return f"pixels to distrust: {', '.join(counts)}"


def _entry(value: float, std: float | None) -> str:
    return "1" if value == 1 else f"{value:.5f}" + ("" if std is None else f" ± {std:.5f}")


def _warnings(console: Console, warnings: Sequence[str]) -> None:
    for warning in warnings:
        console.print(f"[yellow]warning:[/] {escape(warning)}")


def _written(console: Console, out: Path) -> None:
    console.print(f"written: {escape(str(out))}")
