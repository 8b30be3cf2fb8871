"""Calibrations for a person at the bench: the tables that the sub-commands print, and pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from rgbmidic.cli.command import name_options
from rgbmidic.errors import CalibrationError
from rgbmidic.fields.plane import LENS_PARAMETERS, CameraCalibration, distorted
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.checks import Check, reported
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import CameraNoise
from rgbmidic.text import format_with_std
from rgbmidic.tools.report.style import literal, save_figure
from rgbmidic.tools.scene.spectra import Sensitivities
from rgbmidic.tools.stereo import PAIR_PARAMETERS, CameraPair
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.crosstalk import CHANNELS, CrosstalkEstimate
from rgbmidic_calibration.design import Design, Lamp
from rgbmidic_calibration.noise import NoiseEstimate
from rgbmidic_calibration.registration import RegistrationEstimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
