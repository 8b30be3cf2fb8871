"""Several calibration files into one: noise, crosstalk and registration are often measured on different days."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.illumination.calibration import Calibration

__all__ = ["merge_files"]

SECTIONS = ("crosstalk", "camera_noise", "noise", "registration")
CAMERA = ("kind", "cfa", "black_level", "white_level", "shape")


def merge_files(paths: Sequence[Path]) -> Calibration:
    """One calibration with every section that any of the files has.

    Raises
    ------
    ConfigurationError
        Fewer than two files are given.
    CalibrationError
        A file cannot be read, two files have the same section with different contents, or the files are of different
        cameras or lights.
    """
    if len(paths) < 2:
        raise ConfigurationError(f"merge needs at least two calibration files, given is {len(paths)}")
    read = {str(path): Calibration.read(path) for path in paths}
    chosen: dict[str, Any] = {name: _agreed(name, read) for name in (*SECTIONS, *CAMERA)}
    provenance: dict[str, Any] = {}
    extra: dict[str, Any] = {}
    for path, calibration in read.items():
        _add(provenance, calibration.provenance, f"provenance of {path}")
        _add(extra, calibration.extra, path)
    uneven = [calibration.unevenness for calibration in read.values() if calibration.unevenness is not None]
    return Calibration(**chosen, unevenness=max(uneven, default=None), provenance=provenance, extra=extra)


def _agreed(name: str, read: Mapping[str, Calibration]) -> Any:
    """The value of a section or camera setting; files that have it must agree."""
    found: tuple[str, Calibration] | None = None
    for path, calibration in read.items():
        if getattr(calibration, name) is None:
            continue
        if found and _document(calibration, name) != _document(found[1], name):
            raise CalibrationError(
                f"{found[0]} and {path} differ in {name.replace('_', ' ')}: merge takes it from one file only, and the "
                "camera settings must be the same in all"
            )
        found = found or (path, calibration)
    return getattr(found[1], name) if found else None


def _document(calibration: Calibration, name: str) -> Any:
    document = calibration.to_document()
    return document["camera"][name] if name in CAMERA else document["noise" if "noise" in name else name]


def _add(into: dict[str, Any], new: Mapping[str, Any], where: str) -> None:
    for key, value in new.items():
        if into.setdefault(key, value) != value:
            raise CalibrationError(f"{where}: section {key} differs from that of an earlier file")
