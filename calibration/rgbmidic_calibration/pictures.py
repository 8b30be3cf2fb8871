"""Pictures of calibrations: matrix, noise, lateral colour, camera, spectra of lamps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.errors import CalibrationError
from rgbmidic.fields.plane import CameraCalibration, distorted
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import CameraNoise
from rgbmidic.tools.report.style import literal, save_figure
from rgbmidic.tools.scene.spectra import Sensitivities
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.crosstalk import CHANNELS
from rgbmidic_calibration.design import Design, Lamp

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


PALETTE = ("#c0392b", "#27823b", "#2457a6", "#7d3c98")


def draw_calibration(calibration: Calibration, path: Path) -> None:
    """Draw every section of a calibration into one picture file.

    Raises
    ------
    CalibrationError
        The calibration is empty.
    InputError, ResultError
        The file cannot be written, or not in the format of its ending.
    """
    panels: list[Callable[[Axes], None]] = []
    if (crosstalk := calibration.crosstalk) is not None:
        panels.append(lambda axes: _draw_matrix(axes, crosstalk))
        if crosstalk.field is not None:
            panels.append(lambda axes: _draw_field(axes, crosstalk))
    if (noise := calibration.camera_noise) is not None:
        panels.append(lambda axes: _draw_noise(axes, noise))
    if (registration := calibration.registration) is not None:
        panels.append(lambda axes: _draw_registration(axes, registration))
    if not panels:
        raise CalibrationError("the calibration has nothing to draw")
    _save(panels, path)


def _save(panels: list[Callable[[Axes], None]], path: Path) -> None:
    """Draw panels side by side into a file."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"axes.titlesize": "medium"}):
        figure: Figure = Figure(figsize=(5 * len(panels), 4.4), layout="constrained")
        for draw, axes in zip(panels, np.atleast_1d(figure.subplots(1, len(panels))), strict=True):
            draw(axes)
        save_figure(figure, path, dpi=130)


def _draw_matrix(axes: Axes, crosstalk: Crosstalk) -> None:
    """Draw the crosstalk matrix as a coloured table."""
    matrix = crosstalk.matrix
    axes.imshow(matrix, cmap="Greys", vmin=0, vmax=1.4)
    for (row, column), value in np.ndenumerate(matrix):
        axes.text(column, row, f"{value:.3f}", ha="center", va="center", color="w" if value > 0.8 else "k")
    axes.set_xticks(range(len(crosstalk.lights)), list(map(literal, crosstalk.lights)))
    axes.set_yticks(range(len(matrix)), CHANNELS[: len(matrix)])
    title = f"crosstalk A, condition number {crosstalk.condition_number:.2f}"
    axes.set(xlabel="light", ylabel="camera channel", title=title)


def _draw_field(axes: Axes, crosstalk: Crosstalk) -> None:
    """Draw the entry of A that varies most, over the field."""
    assert crosstalk.field is not None
    height, width = crosstalk.field.shape
    points = np.stack(np.meshgrid(np.linspace(0, width - 1, 60), np.linspace(0, height - 1, 60)), axis=-1)
    values = crosstalk.at(points)
    row, column = np.unravel_index(np.ptp(values, axis=(0, 1)).argmax(), crosstalk.matrix.shape)
    image = axes.imshow(values[..., row, column], extent=(0, width, height, 0), cmap="viridis")
    axes.figure.colorbar(image, ax=axes, shrink=0.8)
    title = f"{CHANNELS[row]} seen of {literal(crosstalk.lights[column])}"
    axes.set(xlabel="x (px)", ylabel="y (px)", title=title)


def _draw_noise(axes: Axes, noise: CameraNoise) -> None:
    """Draw the standard deviation of a sample over its grey level, per plane."""
    for index, plane in enumerate(noise.planes):
        level = np.geomspace(1, noise.saturation.value[index], 200)
        std = np.sqrt(noise.read_noise.value[index] ** 2 + level / noise.gain.value[index])
        colour = PALETTE["RGB".find(plane[0])] if plane[0] in "RGB" else "k"
        axes.loglog(level, std, color=colour, ls="--" if plane == "G2" else "-", label=plane)
    axes.set(xlabel="grey level above black (DN)", ylabel="noise of one sample (DN)", title="camera noise")
    axes.legend()
    axes.grid(alpha=0.3)


def _draw_registration(axes: Axes, registration: Registration) -> None:
    """Draw the displacement of the lights' images at the points of a grid, magnified."""
    (x, y), radius = registration.centre, registration.radius
    points = np.stack(np.meshgrid(np.linspace(0, 2 * x, 9), np.linspace(0, 2 * y, 9)), axis=-1).reshape(-1, 2)
    displacement = registration.displacement(points)
    largest = max(float(np.abs(displacement).max()), 1e-6)
    for index, name in enumerate(registration.lights[1:], start=1):
        look: dict[str, Any] = {"color": PALETTE[index % len(PALETTE)], "label": literal(name)}
        axes.quiver(
            *points.T, *displacement[index].T, angles="xy", scale_units="xy", scale=10 * largest / radius, **look
        )
    title = f"seen elsewhere than by {literal(registration.lights[0])}, up to {largest:.2f} px"
    axes.set(xlabel="x (px)", ylabel="y (px)", title=title)
    axes.set(xlim=(-0.1 * x, 2.1 * x), ylim=(2.1 * y, -0.1 * y), aspect="equal")
    axes.legend(fontsize="small")


def draw_design(result: Design, camera: Sensitivities, lamps: Mapping[str, Lamp], path: Path) -> None:
    """Draw the spectra over the camera's sensitivities, and of the predicted matrix."""

    def spectra(axes: Axes) -> None:
        for name, values, colour in zip("RGB", camera.values, PALETTE, strict=False):
            axes.plot(camera.wavelengths, values / camera.values.max(), color=colour, label=f"camera {name}")
        for name, column in zip(result.crosstalk.lights, result.crosstalk.matrix.T, strict=True):
            power = lamps[name].power(camera.wavelengths)
            colour = PALETTE[column.argmax()]
            axes.fill_between(camera.wavelengths, power / power.max(), alpha=0.25, label=literal(name), color=colour)
        axes.set(xlabel="wavelength (nm)", ylabel="relative")
        axes.legend(fontsize="small")

    _save([spectra, lambda axes: _draw_matrix(axes, result.crosstalk)], path)


def draw_camera(camera: CameraCalibration, path: Path, residuals: Sequence[tuple[FloatArray, FloatArray]] = ()) -> None:
    """Draw the residuals of all points, the distortion over the frame, and the local scale on the plane.

    Parameters
    ----------
    camera
        Lens and plane, or either.
    path
        Picture file.
    residuals
        Points of every photograph and their residuals, px; a file has none.

    Raises
    ------
    InputError, ResultError
        The file cannot be written, or not in the format of its ending.
    """
    rows, columns = camera.shape
    y, x = np.mgrid[0 : rows - 1 : 24j, 0 : columns - 1 : 24j]
    grid = np.stack([x.ravel(), y.ravel()], axis=1)  # what is drawn there is rounded: noise of 1e-14 would be contoured
    axes_options: dict[str, Any] = {"xlim": (-0.5, columns - 0.5), "ylim": (rows - 0.5, -0.5), "aspect": "equal"}
    axes_options |= {"xlabel": "x (px)", "ylabel": "y (px)"}

    def points_off(axes: Axes) -> None:
        unit = float(f"{max(1e-6, *(np.abs(residual).max() for _, residual in residuals)):.0e}")
        for points, residual in residuals:
            axes.quiver(*points.T, *residual.T, angles="xy", scale_units="width", scale=10 * unit, width=0.003)
        axes.set(title=f"residuals of the points (a tenth of the width: {unit:g} px)", **axes_options)

    def distortion(axes: Axes) -> None:
        if camera.lens is not None:
            shift = np.linalg.norm(distorted(camera.lens, grid) - grid, axis=1).reshape(x.shape)
            axes.figure.colorbar(axes.contourf(x, y, shift.round(6), 12, cmap="viridis"), ax=axes, shrink=0.8)
        axes.set(title="distortion (px)" if camera.lens is not None else "no lens calibrated", **axes_options)

    def scale(axes: Axes) -> None:
        has_plane = camera.homography is not None
        if has_plane:
            local = np.sqrt(np.linalg.det(camera.jacobian(grid))).reshape(x.shape)
            filled = axes.contourf(x, y, (100 * (local / local.mean() - 1)).round(6), 12, cmap="viridis")
            axes.figure.colorbar(filled, ax=axes, shrink=0.8)
        axes.set(title="scale on the plane (% of its mean)" if has_plane else "no plane calibrated", **axes_options)

    _save([*([points_off] if residuals else []), distortion, scale], path)
