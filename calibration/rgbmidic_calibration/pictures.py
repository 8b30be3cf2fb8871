"""One picture of a calibration file: matrix, noise curve and registration side by side."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rgbmidic.errors import CalibrationError
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.camera_noise import CameraNoise
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.registration import Registration
from rgbmidic.report.style import literal
from rgbmidic_calibration.crosstalk import CHANNELS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["COLOURS", "draw_calibration", "draw_matrix", "save"]

COLOURS = ("#c0392b", "#27823b", "#2457a6", "#7d3c98")


def draw_calibration(calibration: Calibration, path: Path) -> None:
    """Draw every section of a calibration into one picture file.

    Raises
    ------
    CalibrationError
        The calibration is empty, or the file cannot be written in the format of its ending.
    """
    panels: list[Callable[[Axes], None]] = []
    if (crosstalk := calibration.crosstalk) is not None:
        panels.append(lambda axes: draw_matrix(axes, crosstalk))
        if crosstalk.field is not None:
            panels.append(lambda axes: _draw_field(axes, crosstalk))
    if (noise := calibration.camera_noise) is not None:
        panels.append(lambda axes: _draw_noise(axes, noise))
    if (registration := calibration.registration) is not None:
        panels.append(lambda axes: _draw_registration(axes, registration))
    if not panels:
        raise CalibrationError("the calibration has nothing to draw")
    save(panels, path)


def save(panels: list[Callable[[Axes], None]], path: Path) -> None:
    """Draw panels side by side into a file.

    Raises
    ------
    CalibrationError
        The file cannot be written in the format of its ending.
    """
    from matplotlib.figure import Figure

    figure: Figure = Figure(figsize=(5 * len(panels), 4.4), layout="constrained")
    for draw, axes in zip(panels, np.atleast_1d(figure.subplots(1, len(panels))), strict=True):
        draw(axes)
    try:
        figure.savefig(path, dpi=130)
    except (OSError, ValueError) as error:
        raise CalibrationError(f"the picture {path} cannot be written: {error}") from None


def draw_matrix(axes: Axes, crosstalk: Crosstalk) -> None:
    """The crosstalk matrix as a coloured table."""
    matrix = crosstalk.matrix
    axes.imshow(matrix, cmap="Greys", vmin=0, vmax=1.4)
    for (row, column), value in np.ndenumerate(matrix):
        axes.text(column, row, f"{value:.3f}", ha="center", va="center", color="w" if value > 0.8 else "k")
    axes.set_xticks(range(len(crosstalk.lights)), list(map(literal, crosstalk.lights)))
    axes.set_yticks(range(len(matrix)), CHANNELS[: len(matrix)])
    axes.set(xlabel="light", ylabel="camera channel")
    axes.set_title(f"crosstalk A, condition number {crosstalk.condition_number:.2f}", fontsize="medium")


def _draw_field(axes: Axes, crosstalk: Crosstalk) -> None:
    """The entry of A that varies most, over the field."""
    assert crosstalk.field is not None
    height, width = crosstalk.field.shape
    points = np.stack(np.meshgrid(np.linspace(0, width - 1, 60), np.linspace(0, height - 1, 60)), axis=-1)
    values = crosstalk.at(points)
    row, column = np.unravel_index(np.ptp(values, axis=(0, 1)).argmax(), crosstalk.matrix.shape)
    image = axes.imshow(values[..., row, column], extent=(0, width, height, 0), cmap="viridis")
    axes.figure.colorbar(image, ax=axes, shrink=0.8)
    axes.set(xlabel="x, px", ylabel="y, px")
    axes.set_title(f"{CHANNELS[row]} seen of {literal(crosstalk.lights[column])}", fontsize="medium")


def _draw_noise(axes: Axes, noise: CameraNoise) -> None:
    """Standard deviation of a sample over its grey level, per plane."""
    for index, plane in enumerate(noise.planes):
        level = np.geomspace(1, noise.saturation.value[index], 200)
        std = np.sqrt(noise.read_noise.value[index] ** 2 + level / noise.gain.value[index])
        colour = COLOURS["RGB".find(plane[0])] if plane[0] in "RGB" else "k"
        axes.loglog(level, std, color=colour, ls="--" if plane == "G2" else "-", label=plane)
    axes.set(xlabel="grey level above black, DN", ylabel="noise of one sample, DN")
    axes.set_title("camera noise", fontsize="medium")
    axes.legend()
    axes.grid(alpha=0.3)


def _draw_registration(axes: Axes, registration: Registration) -> None:
    """Where the lights see the points of a grid, magnified."""
    (x, y), radius = registration.centre, registration.radius
    points = np.stack(np.meshgrid(np.linspace(0, 2 * x, 9), np.linspace(0, 2 * y, 9)), axis=-1).reshape(-1, 2)
    moved = registration.displacement(points)
    largest = max(float(np.abs(moved).max()), 1e-6)
    for index, name in enumerate(registration.lights[1:], start=1):
        u, v = moved[index].T * 0.1 * radius / largest
        colour = COLOURS[index % len(COLOURS)]
        axes.quiver(
            points[:, 0], points[:, 1], u, v, color=colour, angles="xy", scale_units="xy", scale=1, label=literal(name)
        )
    axes.set(xlabel="x, px", ylabel="y, px", xlim=(-0.1 * x, 2.1 * x), ylim=(2.1 * y, -0.1 * y), aspect="equal")
    axes.set_title(
        f"seen elsewhere than by {literal(registration.lights[0])}, up to {largest:.2f} px", fontsize="medium"
    )
    axes.legend(fontsize="small")
