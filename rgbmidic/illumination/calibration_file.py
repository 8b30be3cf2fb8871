"""The sections of a calibration file: plain JSON on one side, what they describe on the other.

What reads raises KeyError, TypeError or ValueError where the file is damaged.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from rgbmidic.illumination.crosstalk import Crosstalk, CrosstalkField
from rgbmidic.illumination.registration import Registration
from rgbmidic.settings import regular
from rgbmidic.typing import FloatArray

__all__ = [
    "crosstalk_document",
    "read_crosstalk",
    "read_json",
    "read_level",
    "read_positive",
    "read_registration",
    "read_section",
    "registration_document",
]

_LARGEST = 1e30
"""Beyond it squares and products of figures would be infinite."""


def read_json(path: Path) -> Any:
    """The document of a JSON file; OSError, ValueError or RecursionError where there is none."""
    text = regular(path).read_text(encoding="utf-8")
    return json.loads(text, parse_constant=_number, parse_float=_number, parse_int=_whole_number)


def read_crosstalk(section: dict[str, Any] | None) -> Crosstalk | None:
    """The crosstalk of its section."""
    if section is None:
        return None
    variation = read_section(section, "field")
    return Crosstalk(
        matrix=section["matrix"],
        lights=_names(section["lights"]),
        std=section.get("std"),
        covariance=section.get("covariance"),
        field=None
        if variation is None
        else CrosstalkField(
            order=int(variation["order"]),
            coefficients=variation["coefficients"],
            shape=tuple(variation["shape"]),
            std=variation.get("std"),
        ),
    )


def crosstalk_document(crosstalk: Crosstalk) -> dict[str, Any]:
    """The section of a crosstalk."""
    document: dict[str, Any] = {
        "lights": list(crosstalk.lights),
        "matrix": crosstalk.matrix.tolist(),
        "std": _listed(crosstalk.std),
        "covariance": _listed(crosstalk.covariance),
        "condition_number": crosstalk.condition_number,
        "noise_amplification": crosstalk.noise_amplification.tolist(),
    }
    if (variation := crosstalk.field) is not None:
        document["field"] = {
            "order": variation.order,
            "shape": list(variation.shape),
            "coefficients": variation.coefficients.tolist(),
            "std": _listed(variation.std),
        }
    return document


def read_registration(section: dict[str, Any] | None) -> Registration | None:
    """The registration of its section."""
    if section is None:
        return None
    return Registration(
        lights=_names(section["lights"]),
        parameters=section["parameters"],
        centre=tuple(section["centre"]),
        radius=read_positive(section, "radius"),
        covariance=section.get("covariance"),
    )


def registration_document(registration: Registration) -> dict[str, Any]:
    """The section of a registration."""
    return {
        "lights": list(registration.lights),
        "parameter_names": ["shift_x_px", "shift_y_px", "rotation_rad", "scale", "radial_at_radius"],
        "parameters": registration.parameters.tolist(),
        "centre": list(registration.centre),
        "radius": registration.radius,
        "covariance": _listed(registration.covariance),
    }


def _listed(values: FloatArray | None) -> Any:
    return None if values is None else values.tolist()


def read_section(document: dict[str, Any], name: str) -> dict[str, Any] | None:
    """A section of the file, None where it is not there."""
    section = document.get(name)
    if section is not None and not isinstance(section, dict):
        raise ValueError(f"{name} must be a section of keys, not {section!r}")
    return section


def _names(lights: Any) -> tuple[str, ...]:
    if not isinstance(lights, list) or not all(isinstance(name, str) for name in lights):
        raise ValueError(f"lights must be a list of names, not {lights!r}")
    return tuple(lights)


def _number(text: str) -> float:
    """A number of the file; JSON knows neither NaN nor infinity, and no figure of a camera is beyond `_LARGEST`."""
    value = float(text)
    if not abs(value) <= _LARGEST:
        raise ValueError(f"{text[:40]} is not a number of a calibration")
    return value


def _whole_number(text: str) -> int:
    _number(text)
    return int(text)


def read_positive(section: dict[str, Any], key: str) -> float:
    """A positive number of a section."""
    value = section[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value <= 0:
        raise ValueError(f"{key} must be a positive number, not {value!r}")
    return float(value)


def read_level(camera: dict[str, Any], key: str) -> float | None:
    """A grey level of the section of the camera; None where it is not stated."""
    value = camera.get(key)
    if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
        raise ValueError(f"camera.{key} must be a number, not {value!r}")
    return None if value is None else float(value)
