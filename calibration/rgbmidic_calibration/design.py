"""Predicted crosstalk from camera sensitivities and lamp spectra, the best set of lamps, and pictures.

Before buying lamps: ``response[c, l] = sum over wavelengths of S_c E_l``; every column divided by its largest entry is
the predicted A. Paint and specimen are taken as grey. A picture shows a prediction, or every section of a calibration
file side by side.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from rgbmidic.errors import CalibrationError, ConfigurationError, InputError
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk, Led, Sensitivities
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import CameraNoise
from rgbmidic.report.style import literal
from rgbmidic.settings import regular
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.crosstalk import CHANNELS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#c0392b", "#27823b", "#2457a6", "#7d3c98")


UNSEEN = 1e-3
"""Response to a lamp, relative to that to the best wavelength, below which the camera does not see it: chosen; such
a lamp would need a thousand times the power of another."""


class Lamp(Protocol):
    """Anything with a spectrum."""

    def power(self, wavelengths: FloatArray) -> FloatArray:
        """Spectral power at equally spaced wavelengths (nm), of unit sum."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredLamp:
    """A lamp with a measured spectrum.

    Attributes
    ----------
    wavelengths : ndarray, shape (n,)
        Rising, nm.
    values : ndarray, shape (n,)
        Power per nm, any unit.
    """

    wavelengths: FloatArray
    values: FloatArray

    def __post_init__(self) -> None:
        wavelengths = np.asarray(self.wavelengths, dtype=np.float64)
        values = np.maximum(np.asarray(self.values, dtype=np.float64), 0)
        rising = wavelengths.ndim == 1 and wavelengths.size > 1 and (np.diff(wavelengths) > 0).all()
        if not (rising and values.shape == wavelengths.shape and np.isfinite(values).all() and values.max() > 0):
            raise InputError("a spectrum needs rising wavelengths and as many finite values, not all zero")
        object.__setattr__(self, "wavelengths", wavelengths)
        object.__setattr__(self, "values", values)

    def power(self, wavelengths: FloatArray) -> FloatArray:
        """Spectral power at equally spaced wavelengths (nm), of unit sum; zero outside the measured range."""
        values = np.interp(wavelengths, self.wavelengths, self.values, left=0.0, right=0.0)
        if not values.sum() > 0:
            raise InputError(f"the lamp emits nothing within {wavelengths[0]:g} to {wavelengths[-1]:g} nm")
        return np.asarray(values / values.sum())


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """Predicted response of a camera to a set of lamps.

    Attributes
    ----------
    crosstalk : Crosstalk
        Predicted A.
    response : ndarray, shape (3, k)
        Response of every channel to every lamp of unit radiant power.
    power : ndarray, shape (k,)
        Radiant power that every lamp needs for equal grey levels, relative to the largest.
    headroom : float
        Grey level that each light may reach when all shine, as a fraction of full scale: the fullest channel just
        saturates.
    """

    crosstalk: Crosstalk
    response: FloatArray
    power: FloatArray
    headroom: float

    @property
    def noise(self) -> float:
        """Root mean square of the lights' noise amplification: what the sets are ranked by."""
        return float(np.sqrt((self.crosstalk.noise_amplification**2).mean()))


def design(camera: Sensitivities, lamps: Mapping[str, Lamp]) -> Design:
    """Predict the crosstalk of a camera under a set of lamps.

    Raises
    ------
    CalibrationError
        The camera cannot separate the lamps, or does not see one of them.
    """
    spectra = np.stack([lamp.power(camera.wavelengths) for lamp in lamps.values()], axis=1)
    response = camera.values @ spectra
    seen = response.max(axis=0)
    if unseen := [name for name, value in zip(lamps, seen, strict=True) if value < UNSEEN * camera.values.max()]:
        raise CalibrationError(f"the camera does not see {', '.join(unseen)}")
    crosstalk = Crosstalk(matrix=response / seen, lights=tuple(lamps))
    return Design(
        crosstalk=crosstalk,
        response=response,
        power=(1 / seen) / (1 / seen).max(),
        headroom=float(1 / crosstalk.matrix.sum(axis=1).max()),
    )


def best_sets(camera: Sensitivities, lamps: Mapping[str, Lamp], count: int = 3) -> list[Design]:
    """All sets of `count` lamps that the camera can separate, those with the least noise first.

    Raises
    ------
    CalibrationError
        Fewer lamps than wanted, or no set that works.
    """
    if not 1 <= count <= 3 or len(lamps) < count:
        raise CalibrationError(f"cannot choose {count} of {len(lamps)} lamps: a colour camera separates one to three")
    found = []
    for names in combinations(lamps, count):
        try:
            found.append(design(camera, {name: lamps[name] for name in names}))
        except CalibrationError:  # a set that cannot be separated is no candidate
            continue
    if not found:
        raise CalibrationError("the camera can separate no set of these lamps")
    return sorted(found, key=lambda candidate: candidate.noise)


def read_lamp(text: str) -> Lamp:
    """A lamp from CENTRE or CENTRE:WIDTH in nm, FILE.csv, FILE.csv#COLUMN, or a name that colour-science knows.

    WIDTH is the full width at half maximum; an LED without one gets 25 nm.

    Raises
    ------
    ConfigurationError
        The text is none of these.
    """
    centre, _, width = text.partition(":")
    try:
        return Led(centre=float(centre), width=float(width) if width else 25.0)
    except InputError:
        raise
    except ValueError:
        pass
    if ".csv" in text.lower():
        wavelengths, columns = _read_table(text)
        return MeasuredLamp(wavelengths=wavelengths, values=columns[0])
    import colour

    known = {**colour.SDS_LIGHT_SOURCES, **colour.SDS_ILLUMINANTS}
    if text not in known:
        leds = ", ".join(sorted(key for key in known if "LED" in key))
        raise ConfigurationError(
            f"a lamp is CENTRE:WIDTH in nm, a CSV file, or a light source of colour-science ({leds} ...), not {text!r}"
        )
    return MeasuredLamp(wavelengths=known[text].wavelengths, values=known[text].values)


def read_camera(text: str) -> Sensitivities:
    """Camera sensitivities from FILE.json (rawtoaces), FILE.csv, FILE.csv#NAME, or a name that colour-science knows.

    ``FILE.csv#NAME`` takes the columns ``NAME R``, ``NAME G`` and ``NAME B``.
    """
    if "#" in text:
        wavelengths, columns = _read_table(text, (" R", " G", " B"))
        return Sensitivities(wavelengths=wavelengths, values=np.maximum(columns, 0))
    if Path(text).suffix.lower() in (".json", ".csv"):
        return Sensitivities.read(text)
    return Sensitivities.from_colour(text)


def _read_table(text: str, endings: Sequence[str] = ("",)) -> tuple[FloatArray, FloatArray]:
    """Wavelengths and the columns that a text FILE.csv#NAME means, shape (columns, n)."""
    file, _, column = text.partition("#")
    try:
        with regular(Path(file)).open(newline="", encoding="utf-8") as stream:
            rows = [row for row in csv.reader(stream) if row]
        try:
            float(rows[0][0])
            head = []
        except ValueError:
            head = [cell.strip() for cell in rows.pop(0)]
        table = np.array(rows, dtype=np.float64).T
    except FileNotFoundError:
        raise ConfigurationError(f"file of spectra not found: {file}") from None
    except (OSError, ValueError, IndexError) as error:
        raise ConfigurationError(f"{file} is not a table of numbers with the wavelength first: {error}") from None
    names = [column + ending for ending in endings]
    if column and not set(names) <= set(head):
        raise ConfigurationError(
            f"{file} has no column {', '.join(names)}; it has {', '.join(head[1:]) or 'no heading'}"
        )
    if table.ndim != 2 or len(table) < 2:
        raise ConfigurationError(f"{file} needs a column of wavelengths and at least one more")
    return table[0], table[[head.index(name) for name in names] if column else [1]]


def draw_calibration(calibration: Calibration, path: Path) -> None:
    """Draw every section of a calibration into one picture file.

    Raises
    ------
    CalibrationError
        The calibration is empty, or the file cannot be written in the format of its ending.
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
    """Draw panels side by side into a file.

    Raises
    ------
    CalibrationError
        The file cannot be written in the format of its ending.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    try:
        with mpl.rc_context({"axes.titlesize": "medium"}):
            figure: Figure = Figure(figsize=(5 * len(panels), 4.4), layout="constrained")
            for draw, axes in zip(panels, np.atleast_1d(figure.subplots(1, len(panels))), strict=True):
                draw(axes)
            figure.savefig(path, dpi=130)
    except (OSError, ValueError) as error:
        raise CalibrationError(f"the picture {path} cannot be written: {error}") from None


def _draw_matrix(axes: Axes, crosstalk: Crosstalk) -> None:
    """The crosstalk matrix as a coloured table."""
    matrix = crosstalk.matrix
    axes.imshow(matrix, cmap="Greys", vmin=0, vmax=1.4)
    for (row, column), value in np.ndenumerate(matrix):
        axes.text(column, row, f"{value:.3f}", ha="center", va="center", color="w" if value > 0.8 else "k")
    axes.set_xticks(range(len(crosstalk.lights)), list(map(literal, crosstalk.lights)))
    axes.set_yticks(range(len(matrix)), CHANNELS[: len(matrix)])
    title = f"crosstalk A, condition number {crosstalk.condition_number:.2f}"
    axes.set(xlabel="light", ylabel="camera channel", title=title)


def _draw_field(axes: Axes, crosstalk: Crosstalk) -> None:
    """The entry of A that varies most, over the field."""
    assert crosstalk.field is not None
    height, width = crosstalk.field.shape
    points = np.stack(np.meshgrid(np.linspace(0, width - 1, 60), np.linspace(0, height - 1, 60)), axis=-1)
    values = crosstalk.at(points)
    row, column = np.unravel_index(np.ptp(values, axis=(0, 1)).argmax(), crosstalk.matrix.shape)
    image = axes.imshow(values[..., row, column], extent=(0, width, height, 0), cmap="viridis")
    axes.figure.colorbar(image, ax=axes, shrink=0.8)
    title = f"{CHANNELS[row]} seen of {literal(crosstalk.lights[column])}"
    axes.set(xlabel="x, px", ylabel="y, px", title=title)


def _draw_noise(axes: Axes, noise: CameraNoise) -> None:
    """Standard deviation of a sample over its grey level, per plane."""
    for index, plane in enumerate(noise.planes):
        level = np.geomspace(1, noise.saturation.value[index], 200)
        std = np.sqrt(noise.read_noise.value[index] ** 2 + level / noise.gain.value[index])
        colour = COLOURS["RGB".find(plane[0])] if plane[0] in "RGB" else "k"
        axes.loglog(level, std, color=colour, ls="--" if plane == "G2" else "-", label=plane)
    axes.set(xlabel="grey level above black, DN", ylabel="noise of one sample, DN", title="camera noise")
    axes.legend()
    axes.grid(alpha=0.3)


def _draw_registration(axes: Axes, registration: Registration) -> None:
    """Where the lights see the points of a grid, magnified."""
    (x, y), radius = registration.centre, registration.radius
    points = np.stack(np.meshgrid(np.linspace(0, 2 * x, 9), np.linspace(0, 2 * y, 9)), axis=-1).reshape(-1, 2)
    moved = registration.displacement(points)
    largest = max(float(np.abs(moved).max()), 1e-6)
    for index, name in enumerate(registration.lights[1:], start=1):
        look: dict[str, Any] = {
            "color": COLOURS[index % len(COLOURS)],
            "label": literal(name),
            "scale": 10 * largest / radius,
        }
        axes.quiver(*points.T, *moved[index].T, angles="xy", scale_units="xy", **look)
    title = f"seen elsewhere than by {literal(registration.lights[0])}, up to {largest:.2f} px"
    axes.set(xlabel="x, px", ylabel="y, px", title=title)
    axes.set(xlim=(-0.1 * x, 2.1 * x), ylim=(2.1 * y, -0.1 * y), aspect="equal")
    axes.legend(fontsize="small")


def draw_design(result: Design, camera: Sensitivities, lamps: Mapping[str, Lamp], path: Path) -> None:
    """Picture of the spectra over the camera's sensitivities, and of the predicted matrix."""

    def spectra(axes: Axes) -> None:
        for name, values, colour in zip("RGB", camera.values, COLOURS, strict=False):
            axes.plot(camera.wavelengths, values / camera.values.max(), color=colour, label=f"camera {name}")
        for name, column in zip(result.crosstalk.lights, result.crosstalk.matrix.T, strict=True):
            power = lamps[name].power(camera.wavelengths)
            colour = COLOURS[column.argmax()]
            axes.fill_between(camera.wavelengths, power / power.max(), alpha=0.25, label=literal(name), color=colour)
        axes.set(xlabel="wavelength, nm", ylabel="relative")
        axes.legend(fontsize="small")

    _save([spectra, lambda axes: _draw_matrix(axes, result.crosstalk)], path)
