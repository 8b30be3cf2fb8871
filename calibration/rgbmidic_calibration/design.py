"""Predicted crosstalk from camera sensitivities and lamp spectra, and the best set of lamps.

Before buying lamps: ``response[c, l] = sum over wavelengths of S_c E_l``; every column divided by its largest entry is
the predicted A. Paint and specimen are taken as grey.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from rgbmidic.errors import CalibrationError, ConfigurationError, InputError
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.tools.scene.spectra import Led, Sensitivities, read_columns
from rgbmidic.typing import FloatArray


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
        wavelengths, values = self.wavelengths, self.values
        rising = wavelengths.ndim == 1 and wavelengths.size > 1 and (np.diff(wavelengths) > 0).all()
        if not (rising and values.shape == wavelengths.shape and np.isfinite(values).all() and values.max() > 0):
            raise InputError("a spectrum needs rising wavelengths and as many finite values, not all zero")

    def power(self, wavelengths: FloatArray) -> FloatArray:
        """Return spectral power at equally spaced wavelengths (nm), of unit sum; zero outside the measured range."""
        values = np.interp(wavelengths, self.wavelengths, np.maximum(self.values, 0), left=0.0, right=0.0)
        if not values.sum() > 0:
            raise InputError(f"the lamp emits nothing within {wavelengths[0]:g} to {wavelengths[-1]:g} nm")
        return np.asarray(values / values.sum())


Lamp = Led | MeasuredLamp


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """Predicted response of a camera to a set of lamps.

    Attributes
    ----------
    crosstalk : Crosstalk
        Predicted A.
    power : ndarray, shape (k,)
        Radiant power that every lamp needs for equal grey levels, relative to the largest.
    headroom : float
        Grey level that each light may reach when all shine, as a fraction of full scale: the fullest channel just
        saturates.
    """

    crosstalk: Crosstalk
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
    largest_response = response.max(axis=0)
    # chosen: to a lamp under .001 of the best wavelength's response it would need a thousand times another's power
    if invisible := [
        name for name, value in zip(lamps, largest_response, strict=True) if value < 1e-3 * camera.values.max()
    ]:
        raise CalibrationError(f"the camera does not see {', '.join(invisible)}")
    crosstalk = Crosstalk(matrix=response / largest_response, lights=tuple(lamps))
    return Design(
        crosstalk=crosstalk,
        power=(1 / largest_response) / (1 / largest_response).max(),
        headroom=float(1 / crosstalk.matrix.sum(axis=1).max()),
    )


def best_sets(camera: Sensitivities, lamps: Mapping[str, Lamp], count: int = 3) -> list[Design]:
    """Return all sets of `count` lamps that the camera can separate, those with the least noise first.

    Raises
    ------
    CalibrationError
        Fewer lamps than wanted, or no set that works.
    """
    if not 1 <= count <= 3 or len(lamps) < count:
        raise CalibrationError(f"cannot choose {count} of {len(lamps)} lamps: a colour camera separates one to three")
    designs = []
    for names in combinations(lamps, count):
        try:
            designs.append(design(camera, {name: lamps[name] for name in names}))
        except CalibrationError:  # a set that cannot be separated is no candidate
            continue
    if not designs:
        raise CalibrationError("the camera can separate no set of these lamps")
    return sorted(designs, key=lambda candidate: candidate.noise)


def read_lamp(text: str) -> Lamp:
    """Return a lamp from CENTRE or CENTRE:WIDTH in nm, FILE.csv, FILE.csv#COLUMN, or a name that colour-science knows.

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
    with np.printoptions():  # colour-science sets those of the whole process
        import colour

    spectra = {**colour.SDS_LIGHT_SOURCES, **colour.SDS_ILLUMINANTS}
    if text not in spectra:
        leds = ", ".join(sorted(key for key in spectra if "LED" in key))
        raise ConfigurationError(
            f"a lamp is CENTRE:WIDTH in nm, a CSV file, or a light source of colour-science ({leds} ...), not {text!r}"
        )
    return MeasuredLamp(wavelengths=spectra[text].wavelengths, values=spectra[text].values)


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
    """Return the wavelengths and the columns that a text FILE.csv#NAME means, shape (columns, n)."""
    file, _, column = text.partition("#")
    try:
        head, table = read_columns(Path(file))
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
