"""What the sub-commands print: tables for a person at the bench."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from rgbmidic_calibration.crosstalk import CHANNELS, CrosstalkEstimate

__all__ = ["crosstalk"]


def crosstalk(estimate: CrosstalkEstimate, out: Path) -> None:
    """Print the matrix with its uncertainties, what it means for the noise, and the warnings."""
    console = Console(highlight=False)
    _warnings(console, estimate.warnings)
    result = estimate.crosstalk
    table = Table(title="Crosstalk: camera channels = A . lights (± standard uncertainty)", title_justify="left")
    table.add_column("channel")
    for name in result.lights:
        table.add_column(escape(name), justify="right")
    std = result.std
    for row, channel in enumerate(CHANNELS):
        cells = [_entry(value, None if std is None else std[row, i]) for i, value in enumerate(result.matrix[row])]
        table.add_row(channel, *cells)
    table.add_section()
    table.add_row("noise amplification", *(f"{value:.2f}" for value in result.noise_amplification))
    table.add_row("signal, DN", *(f"{fit.signal:.0f}" for fit in estimate.lights))
    table.add_row("captures", *(str(fit.captures) for fit in estimate.lights))
    table.add_row("blocks used, %", *(f"{100 * fit.used:.0f}" for fit in estimate.lights))
    table.add_row("varies over field, rms", *(f"{fit.variation.rms:.5f}" for fit in estimate.lights))
    table.add_row("  by chance, p", *(f"{fit.variation.p_value:.2g}" for fit in estimate.lights))
    table.add_row("strength drift, %", *(f"{100 * fit.intensity_drift:.2f}" for fit in estimate.lights))
    console.print(table)
    field = "the same everywhere" if result.field is None else f"varies over the field (degree {result.field.order})"
    console.print(f"condition number {result.condition_number:.2f}; A {field}")
    console.print(f"written: {escape(str(out))}")


def _entry(value: float, std: float | None) -> str:
    return "1" if value == 1 else f"{value:.5f}" + ("" if std is None else f" ± {std:.5f}")


def _warnings(console: Console, warnings: Sequence[str]) -> None:
    for warning in warnings:
        console.print(f"[yellow]warning:[/] {escape(warning)}")
