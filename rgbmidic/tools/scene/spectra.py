"""Spectra of lights and cameras, from which the crosstalk follows: ``A[c, l] = sum over wavelengths of S_c E_l``."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.arguments import check_fields
from rgbmidic.disk import require_regular_file
from rgbmidic.errors import InputError
from rgbmidic.settings import unique_keys
from rgbmidic.typing import FloatArray

HALF_MAXIMUM = 0.921823
"""Full width at half maximum of Ohno's model over its width parameter: twice the x where (g + 2 g^5)/3 is 1/2 for
g = exp(-x^2)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Led:
    """A light-emitting diode, by the model of Ohno (Optical Engineering 44, 111302, 2005).

    Attributes
    ----------
    centre
        Wavelength of the peak (nm).
    width
        Full width at half maximum (nm), as data sheets state it.
    """

    centre: float
    width: float = 25.0

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        if not (200 < self.centre < 1200 and 0 < self.width < 300):
            raise InputError(f"an LED has its centre in 200 to 1200 nm and its width in 0 to 300 nm, not {self}")

    def power(self, wavelengths: FloatArray) -> FloatArray:
        """Return the spectral power at the wavelengths (nm), of unit sum: equal spacing is assumed.

        Parameters
        ----------
        wavelengths : ndarray, shape (n,)
            In nm, equally spaced.

        Returns
        -------
        ndarray, shape (n,)

        Raises
        ------
        InputError
            It emits nothing there.
        """
        g = np.exp(-(((wavelengths - self.centre) * HALF_MAXIMUM / self.width) ** 2))
        shape = (g + 2 * g**5) / 3
        if not shape.sum() > 0:
            raise InputError(f"{self} emits nothing within {wavelengths[0]} to {wavelengths[-1]} nm")
        return np.asarray(shape / shape.sum())


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensitivities:
    """Spectral sensitivities of a colour camera.

    Attributes
    ----------
    wavelengths : ndarray, shape (n,)
        Equally spaced (nm).
    values : ndarray, shape (3, n)
        Rows R, G, B; any common unit.
    """

    wavelengths: FloatArray
    values: FloatArray

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        check_fields(self)
        wavelengths, values = np.asarray(self.wavelengths, dtype=float), np.asarray(self.values, dtype=float)
        if wavelengths.ndim != 1 or values.shape != (3, wavelengths.size) or wavelengths.size < 2:
            raise InputError(
                f"sensitivities are 3 rows over n wavelengths, not {values.shape} over {wavelengths.shape}"
            )
        if not (np.isfinite(values).all() and values.min() >= 0 and np.allclose(np.diff(wavelengths, 2), 0)):
            raise InputError("sensitivities must be finite, not negative, and given at equally spaced wavelengths")
        object.__setattr__(self, "wavelengths", wavelengths)
        object.__setattr__(self, "values", values)

    @classmethod
    def from_colour(cls, name: str) -> Sensitivities:
        """Return a camera of colour-science (``colour.MSDS_CAMERA_SENSITIVITIES``), such as "Nikon 5100 (NPL)".

        Parameters
        ----------
        name
            Name of the camera there.

        Returns
        -------
        Sensitivities

        Raises
        ------
        InputError
            There is none of this name.
        """
        with np.printoptions():  # colour-science sets those of the whole process
            import colour

        cameras = colour.MSDS_CAMERA_SENSITIVITIES
        if name not in cameras:
            raise InputError(f"unknown camera {name!r}; colour-science has {', '.join(sorted(cameras))}")
        camera = cameras[name]
        return cls(wavelengths=camera.wavelengths, values=np.maximum(camera.values.T, 0))

    @classmethod
    def read(cls, path: Path | str) -> Sensitivities:
        """Read a camera file: the JSON of rawtoaces, or a CSV with wavelength, R, G, B in its first four columns.

        Parameters
        ----------
        path
            The file.

        Returns
        -------
        Sensitivities

        Raises
        ------
        InputError
            The file is missing or not of this kind.
        """
        path = Path(path)
        try:
            if path.suffix.lower() == ".json":
                document: Any = json.loads(
                    require_regular_file(path).read_text(encoding="utf-8"), object_pairs_hook=unique_keys
                )
                spectra = document["spectral_data"]["data"]["main"]
                rows = [[float(key), *values] for key, values in spectra.items()]
                table = np.array(sorted(rows), dtype=float)
            else:
                table = read_columns(path, 4)[1].T
            return cls(wavelengths=table[:, 0], values=table[:, 1:4].T)
        except FileNotFoundError:
            raise InputError(f"sensitivities file not found: {path}") from None
        except (OSError, KeyError, IndexError, TypeError, ValueError) as error:
            raise InputError(f"{path} is not a file of camera sensitivities: {error}") from None


def read_columns(path: Path, count: int | None = None) -> tuple[list[str], FloatArray]:
    """Return the heading, empty where there is none, and the first `count` columns of a CSV file of numbers.

    Parameters
    ----------
    path
        The file.
    count
        Columns that are read; None: all.

    Returns
    -------
    heading : list of str
    table : ndarray, shape (columns, n)
    """
    with require_regular_file(path).open(newline="", encoding="utf-8") as stream:
        rows = [row[:count] for row in csv.reader(stream) if row]
    try:
        float(rows[0][0])
        heading = []
    except ValueError:
        heading = [cell.strip() for cell in rows.pop(0)]
    return heading, np.array(rows, dtype=np.float64).T


def spectral_response(sensitivities: Sensitivities, lights: tuple[Led, ...]) -> FloatArray:
    """Return the response of each camera channel to each light of equal power.

    Parameters
    ----------
    sensitivities
        S_c of the camera.
    lights
        E_l, each of unit power.

    Returns
    -------
    ndarray, shape (3, k)
        Sum of S_c E_l over wavelengths.
    """
    power = np.stack([light.power(sensitivities.wavelengths) for light in lights], axis=1)
    return sensitivities.values @ power
