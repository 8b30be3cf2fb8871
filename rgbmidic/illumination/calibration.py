"""The calibration of camera and lights, and its JSON file.

`rgbmidic-calibrate` writes the file, the main job reads it. Camera channels = A . lights (rows of A: camera channels,
columns: lights), every column divided by its largest entry, so that a light's image is in grey levels of the channel
that sees it best.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import CalibrationError
from rgbmidic.illumination.mosaic import BAYER_PATTERNS, NoiseModel

__all__ = ["SCHEMA_VERSION", "Calibration", "Crosstalk"]

SCHEMA_NAME = "rgbmidic-calibration"
SCHEMA_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Crosstalk:
    """How strongly each camera channel sees each light.

    Attributes
    ----------
    matrix : ndarray, shape (C, k)
        A in ``channels = A @ lights``; the largest entry of every column is 1.
    lights : tuple of str, length k
    covariance : ndarray, shape (C k, C k), or None
        Covariance of the entries, taken row by row (``matrix.ravel()``).
    std : ndarray, shape (C, k), or None
        Standard uncertainty of every entry; from the covariance where that is given.
    """

    matrix: npt.NDArray[np.float64]
    lights: tuple[str, ...]
    std: npt.NDArray[np.float64] | None = None
    covariance: npt.NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        matrix = np.asarray(self.matrix, dtype=np.float64)
        if matrix.ndim != 2 or matrix.shape[1] != len(self.lights) or matrix.shape[1] > matrix.shape[0]:
            raise CalibrationError(
                f"a crosstalk matrix has one row per camera channel and one column per light, at most as many lights "
                f"as channels; given is shape {matrix.shape} for the lights {', '.join(self.lights)}"
            )
        if not np.isfinite(matrix).all():
            raise CalibrationError("the crosstalk matrix has entries that are not finite numbers")
        condition = np.linalg.cond(matrix)
        if not condition < 1e3:
            raise CalibrationError(
                f"the crosstalk matrix cannot be inverted (condition number {condition:.3g}, allowed is below 1000): "
                "two lights look the same to the camera"
            )
        object.__setattr__(self, "matrix", matrix)
        std = self.std
        if self.covariance is not None:
            covariance = _square(self.covariance, matrix.size, "the covariance of the crosstalk matrix")
            object.__setattr__(self, "covariance", covariance)
            std = np.sqrt(np.diag(covariance))
        if std is not None:
            object.__setattr__(self, "std", np.asarray(std, dtype=np.float64).reshape(matrix.shape))

    @classmethod
    def identity(cls, lights: tuple[str, ...]) -> Crosstalk:
        """No crosstalk: every light is seen by its own channel alone."""
        return cls(matrix=np.eye(len(lights)), lights=lights)

    @property
    def unmixing(self) -> npt.NDArray[np.float64]:
        """The matrix (k, C) that turns channels into lights: the (pseudo-)inverse of A."""
        return np.asarray(np.linalg.pinv(self.matrix), dtype=np.float64)

    @property
    def condition_number(self) -> float:
        """Ratio of the largest to the smallest singular value of A."""
        return float(np.linalg.cond(self.matrix))

    @property
    def noise_amplification(self) -> npt.NDArray[np.float64]:
        """Noise of each light's image over the noise of one camera channel, shape (k,)."""
        return np.asarray(np.sqrt((self.unmixing**2).sum(axis=1)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """All that is known of camera and lights; a section that was not measured is None.

    Attributes
    ----------
    crosstalk, noise
        See `Crosstalk` and `NoiseModel`.
    cfa, black_level, white_level
        The camera settings of the captures, where they were stated or told by the files.
    provenance
        Inputs with their hashes, date, software version; kept as written.
    extra
        Sections of the file that this class does not interpret, kept when the file is written again.
    """

    crosstalk: Crosstalk | None = None
    noise: NoiseModel | None = None
    cfa: str | None = None
    black_level: float | None = None
    white_level: float | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path | str) -> Calibration:
        """Read a calibration file.

        Raises
        ------
        CalibrationError
            The file is missing, not JSON, of another schema or version, or has damaged sections.
        """
        path = Path(path)
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise CalibrationError(f"calibration file not found: {path}") from None
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise CalibrationError(f"{path} is not a readable calibration file: {error}") from None
        if not isinstance(document, dict) or document.get("schema") != SCHEMA_NAME:
            raise CalibrationError(f'{path} is not a calibration file: its "schema" is not "{SCHEMA_NAME}"')
        if document.get("schema_version") != SCHEMA_VERSION:
            raise CalibrationError(
                f"{path} has schema version {document.get('schema_version')!r}; this version of rgbmidic reads "
                f"{SCHEMA_VERSION}. Make the file again with rgbmidic-calibrate"
            )
        try:
            return cls._from_document(document)
        except (KeyError, TypeError, ValueError) as error:
            reason = f"missing key {error}" if isinstance(error, KeyError) else error
            raise CalibrationError(f"{path} is damaged: {reason}") from None

    @classmethod
    def _from_document(cls, document: dict[str, Any]) -> Calibration:
        known = {"schema", "schema_version", "crosstalk", "noise", "camera", "provenance"}
        camera = document.get("camera", {})
        if (cfa := camera.get("cfa")) is not None and cfa not in BAYER_PATTERNS:
            raise ValueError(f"camera.cfa is {cfa!r}; allowed are {', '.join(BAYER_PATTERNS)}")
        crosstalk = document.get("crosstalk")
        noise = document.get("noise")
        return cls(
            crosstalk=crosstalk
            and Crosstalk(
                matrix=crosstalk["matrix"],
                lights=tuple(crosstalk["lights"]),
                std=crosstalk.get("std"),
                covariance=crosstalk.get("covariance"),
            ),
            noise=noise and NoiseModel(gain=_positive(noise, "gain"), read_noise=_positive(noise, "read_noise")),
            cfa=cfa,
            black_level=camera.get("black_level"),
            white_level=camera.get("white_level"),
            provenance=document.get("provenance", {}),
            extra={key: value for key, value in document.items() if key not in known},
        )

    def to_document(self) -> dict[str, Any]:
        """The JSON document, as plain dictionaries, lists and numbers."""
        document: dict[str, Any] = {"schema": SCHEMA_NAME, "schema_version": SCHEMA_VERSION}
        camera = {"cfa": self.cfa, "black_level": self.black_level, "white_level": self.white_level}
        document["camera"] = {key: value for key, value in camera.items() if value is not None}
        if (crosstalk := self.crosstalk) is not None:
            document["crosstalk"] = {
                "lights": list(crosstalk.lights),
                "matrix": crosstalk.matrix.tolist(),
                "std": None if crosstalk.std is None else crosstalk.std.tolist(),
                "covariance": None if crosstalk.covariance is None else crosstalk.covariance.tolist(),
                "condition_number": crosstalk.condition_number,
                "noise_amplification": crosstalk.noise_amplification.tolist(),
            }
        if self.noise is not None:
            document["noise"] = {"gain": self.noise.gain, "read_noise": self.noise.read_noise}
        return {**document, **self.extra, "provenance": dict(self.provenance)}

    def write(self, path: Path | str) -> None:
        """Write the calibration file; an existing file is replaced only once the new one is complete."""
        path = Path(path)
        temporary = path.with_name(path.name + ".part")
        temporary.write_text(json.dumps(self.to_document(), indent=2) + "\n", encoding="utf-8")
        temporary.replace(path)


def _square(values: npt.ArrayLike, size: int, name: str) -> npt.NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (size, size) or not np.isfinite(array).all() or (np.diag(array) < 0).any():
        raise CalibrationError(f"{name} must be {size} x {size} finite numbers with no negative variance")
    return array


def _positive(section: dict[str, Any], key: str) -> float:
    value = section[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value <= 0:
        raise ValueError(f"{key} must be a positive number, not {value!r}")
    return float(value)
