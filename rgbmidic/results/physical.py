"""A result as an engineer reads it: millimetres and seconds where they are known, finite strain over a stated gauge.

Scale, frame times and exposure come from the settings of the run and from the camera's files; analog channels recorded
beside the test, such as a force, come from a CSV file. What the files for other programs and the report hold is
declared in the field table and here.
"""

from __future__ import annotations

import csv
import logging
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.fields import (
    EQUIVALENT,
    MEASURES,
    CameraCalibration,
    NodalCovariance,
    Rectification,
    StrainGauges,
    Units,
    reference_fraction,
    strain_of_gradient,
)
from rgbmidic.mesh import Placement, Tri3Mesh
from rgbmidic.results.quantities import QUANTITIES, UNKNOWN_TIME, ResultQuantity
from rgbmidic.results.result import Result
from rgbmidic.settings import ProbeSettings, ScaleSettings, read_section, regular
from rgbmidic.typing import BoolArray, FloatArray

__all__ = [
    "Channels",
    "Physical",
    "exposure",
    "frame_times",
    "placement_of",
    "probes_of",
    "rectification_of",
    "reference_frames",
    "scale_of",
    "shared_part",
    "units_of",
]

logger = logging.getLogger(__name__)

_TIME = re.compile(r"(?:time|t)(?:[\s_(\[]+(s|ms|us|µs)[)\]]?)?", re.IGNORECASE)
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
_NEWTONS = {"N": 1.0, "kN": 1e3}
_UNIT = re.compile(r".*[\s_(\[](kN|N)[)\]]?")
_DIFFERENT = 0.01
"""Relative difference of a stated frame rate from that of the time stamps above which a warning names both: stamps
in whole microseconds give the median interval of 10,000 frames per second to 1 %."""


def scale_of(result: Result) -> ScaleSettings:
    """Return the ``[scale]`` that a result was measured with."""
    return read_section(ScaleSettings, "scale", result.provenance.get("settings", {}).get("scale", {}))


def probes_of(result: Result) -> ProbeSettings:
    """Return the ``[probes]`` that a result was measured with."""
    return read_section(ProbeSettings, "probes", result.provenance.get("settings", {}).get("probes", {}))


def rectification_of(result: Result, scale: ScaleSettings | None = None) -> Rectification:
    """Return the change from px of the image to rectified px, and the scale.

    Parameters
    ----------
    result
        The result; its provenance holds the camera that its ``[scale]`` names.
    scale
        It replaces the ``[scale]`` that was kept with the result; None: that one.

    Raises
    ------
    CalibrationError
        The camera's file is not usable, or was made with frames of another shape.
    InputError
        The camera holds no plane.
    """
    mesh, camera = Tri3Mesh(nodes=result.nodes, elements=result.elements), None
    if scale is not None and scale.camera is not None:
        camera = CameraCalibration.read(scale.camera)
    elif scale is None and (kept := result.provenance.get("camera")) is not None:
        camera = CameraCalibration.from_document(kept, str(scale_of(result).camera))
    if camera is not None:
        camera.check(result.frame_shape or camera.shape)
    stated = scale_of(result) if scale is None else scale
    if camera is None and stated.mm_per_pixel is None and (placed := placement_of(result)) is not None:
        stated = replace(stated, mm_per_pixel=placed.mm_per_pixel, mm_per_pixel_std=placed.mm_per_pixel_std)
    return Rectification.of(mesh, stated, camera)


def placement_of(result: Result) -> Placement | None:
    """Return where the mesh of ``mesh.file`` lies on the image; None where the result has none."""
    kept = result.provenance.get("finite_elements")
    if kept is None:
        return None
    document = result.provenance.get("camera")
    camera = None if document is None else CameraCalibration.from_document(document, str(scale_of(result).camera))
    return Placement.from_document(kept["placement"], camera)


def units_of(result: Result, scale: ScaleSettings | None = None) -> Units:
    """Return the units of a result, with its own ``[scale]`` or another one in its place."""
    return replace(rectification_of(result, scale).units, timed=frame_times(result, scale) is not None)


def frame_times(result: Result, scale: ScaleSettings | None = None) -> FloatArray | None:
    """Find the time of each frame.

    Time stamps count where the files have one of every frame, from the trigger where the camera reports it; else the
    time is the number of the frame over `frame_rate`, that of ``[scale]`` before the camera's.

    Parameters
    ----------
    result
        The result; it is read for the numbers and time stamps.
    scale
        It replaces the ``[scale]`` that was kept with the result; None: that one.

    Returns
    -------
    ndarray, shape (T,), or None
        In seconds, NaN for frames that are not measured yet; None where no time is known.
    """
    scale = scale_of(result) if scale is None else scale
    there = result.finished
    stamps, numbers = result.time_ns[there], result.number[there]
    if (stamps == UNKNOWN_TIME).any():
        camera_rate = result.provenance.get("frame_rate")
        rate = scale.frame_rate or camera_rate
        seconds = numbers / rate if rate else None
        if camera_rate:
            _compare(camera_rate, scale.frame_rate, "the camera was set to %.6g: the former is taken")
    else:
        seconds = stamps * 1e-9
        if len(seconds) > 1:
            stamped_rate = float(np.median(np.maximum(np.diff(numbers), 1) / np.diff(seconds)))
            _compare(stamped_rate, scale.frame_rate, "the frames' own times %.6g: these are taken")
    if seconds is None:
        return None
    times = np.full(len(result), np.nan)
    times[there] = seconds
    return times


def _compare(recorded: float, stated: float | None, contradiction: str) -> None:
    """Warn where a stated frame rate is not the recorded one."""
    if stated and abs(recorded / stated - 1) > _DIFFERENT:
        logger.warning(f"scale.frame_rate states %g frames per second, {contradiction}", stated, recorded)


def exposure(result: Result) -> float | None:
    """Return the exposure time of a frame in seconds; None where the files do not report it."""
    nanoseconds = result.provenance.get("exposure_ns")
    return None if nanoseconds is None else float(nanoseconds) * 1e-9


def reference_frames(result: Result) -> BoolArray:
    """Return a mask (T,) of the frames that belong to the reference."""
    chosen = np.zeros(len(result), dtype=bool)
    chosen[list(result.provenance["references"])] = True
    return chosen


def shared_part(result: Result) -> float:
    """Return the fraction of a frame's variance that all frames have in common (see `reference_fraction`)."""
    return reference_fraction(len(result.setting("frames", "reference", [0])))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Channels:
    """Analog channels recorded beside a test: values at their times.

    Attributes
    ----------
    path
        The file.
    times : ndarray, shape (n,)
        In seconds, rising, by the clock of the frames.
    values
        Name of each channel to its values (n,).
    offset
        Seconds that were added to the recorded times to make them those of the frames.
    """

    path: Path
    times: FloatArray
    values: Mapping[str, FloatArray]
    offset: float = 0.0

    @classmethod
    def read(cls, path: Path | str, offset: float = 0.0) -> Self:
        """Read a CSV file: a header line, then rows; the first column is ``time_s``, ``time_ms`` or ``time_us``.

        Columns are separated by commas, semicolons (then a comma may be the decimal point) or tabs.

        Parameters
        ----------
        path
            The file.
        offset
            Seconds that are added to its times to make them those of the frames.

        Raises
        ------
        InputError
            The file is missing, has no such header, a field is no number, or the times do not rise.
        """
        path = Path(path)
        try:
            lines = regular(path).read_text(encoding="utf-8-sig").splitlines()
        except OSError as error:
            raise InputError(f"the channels {path} cannot be read: {error.strerror or error}") from None
        except ValueError:
            raise InputError(f"the channels {path} are not a text file") from None
        lines = [line for line in lines if line.strip()]
        separator = max(",;\t", key=(lines or [""])[0].count)
        names = [name.strip() for name in next(csv.reader(lines[:1], delimiter=separator), [])]
        unit = _TIME.fullmatch(names[0]) if len(names) > 1 else None
        if unit is None:
            raise InputError(
                f'the channels {path} need a header line: "time_s" (or time_ms, time_us) and the name of each channel'
            )
        table = _numbers(path, lines[1:], separator, len(names))
        times = table[:, 0] * _SECONDS[(unit[1] or "s").lower()]
        if len(times) < 2 or not (np.diff(times) > 0).all():
            raise InputError(f"the times of the channels {path} must rise from row to row, over two rows or more")
        values = dict(zip(names[1:], table[:, 1:].T, strict=True))
        return cls(path=path, times=times + offset, values=values, offset=offset)

    def at(self, times: FloatArray) -> dict[str, FloatArray]:
        """Interpolate each channel linearly at the times (T,) of the frames; NaN beyond its values.

        Parameters
        ----------
        times
            In seconds.

        Raises
        ------
        InputError
            No frame lies within the times of the channels.
        """
        first, last = self.times[[0, -1]]
        if not ((times >= first) & (times <= last)).any():
            raise InputError(
                f"the channels {self.path} span {first:.9g} to {last:.9g} s (offset {self.offset:g} s included), the "
                f"frames {np.nanmin(times):.9g} to {np.nanmax(times):.9g} s: state the --offset between both clocks"
            )
        return {name: np.interp(times, self.times, values, np.nan, np.nan) for name, values in self.values.items()}

    def force(self, name: str | None = None) -> tuple[str, float]:
        """Return the name of the channel with a force, and its unit in newtons.

        Parameters
        ----------
        name
            Of the channel; None: the only one whose name ends in N or kN.

        Raises
        ------
        InputError
            There is none, more than one, or its name does not end in its unit.
        """
        found = {channel: _NEWTONS[unit[1]] for channel in self.values if (unit := _UNIT.fullmatch(channel))}
        if name is None and len(found) == 1:
            return next(iter(found.items()))
        if name is None or name not in found:
            what = "none is stated" if name is None else f'"{name}" is not one'
            raise InputError(
                f"a stress needs one channel of {self.path} with a force, whose name ends in _N or _kN; {what}, the "
                f"channels are {', '.join(self.values)}"
            )
        return name, found[name]


def _numbers(path: Path, lines: list[str], separator: str, count: int) -> FloatArray:
    """Read rows of numbers (n, count); an empty field is NaN."""
    rows = []
    for number, row in enumerate(csv.reader(lines, delimiter=separator), 2):
        fields = [part.strip().replace(",", ".") if separator == ";" else part.strip() for part in row]
        try:
            rows.append([float(part) if part else math.nan for part in fields])
        except ValueError:
            raise InputError(f"row {number} of the channels {path} is not numbers: {row}") from None
        if len(row) != count:
            raise InputError(f"row {number} of the channels {path} has {len(row)} fields, the header {count}")
    return np.array(rows, dtype=np.float64).reshape(-1, count)


_NODE, _ELEMENT = ("node",), ("element",)
_STRAIN = (
    ResultQuantity("exx", _NODE, "", "components.0", "strain in x"),
    ResultQuantity("eyy", _NODE, "", "components.1", "strain in y"),
    ResultQuantity("exy", _NODE, "", "components.2", "strain, tensor shear"),
    ResultQuantity("exx_std", _NODE, "", "components_std.0", "standard uncertainty of exx"),
    ResultQuantity("eyy_std", _NODE, "", "components_std.1", "standard uncertainty of eyy"),
    ResultQuantity("exy_std", _NODE, "", "components_std.2", "standard uncertainty of exy"),
    ResultQuantity("e1", _NODE, "", "principal.0", "larger principal strain in the plane"),
    ResultQuantity("e2", _NODE, "", "principal.1", "smaller principal strain in the plane"),
    ResultQuantity("direction", _NODE, "deg", "direction_deg", "direction of e1, from x towards y"),
    ResultQuantity("equivalent", _NODE, "", "equivalent", EQUIVALENT),
    ResultQuantity("equivalent_std", _NODE, "", "equivalent_std", "standard uncertainty of equivalent"),
)
_ELEMENT_STRAIN = tuple(
    replace(entry, name=f"{entry.name}_element", axes=_ELEMENT, meaning=f"{entry.meaning}, constant in an element")
    for entry in _STRAIN[:3]
)
_REPLACED = ("time_ns", *(entry.name for entry in _STRAIN))
"""Quantities of the table that others replace here: times in s, finite strain over a gauge."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Physical:
    """A result with its units.

    Attributes
    ----------
    result
        The result.
    scale
        What replaces its ``[scale]``; None: nothing.
    units
        Of lengths and times.
    times : ndarray, shape (T,)
        Of the frames: seconds where all are known and each is later than the one before, else places in the result.
    rectified
        Change to rectified px, where a camera is stated.
    """

    result: Result
    scale: ScaleSettings | None
    units: Units
    times: FloatArray
    rectified: Rectification

    @classmethod
    def of(cls, result: Result, scale: ScaleSettings | None = None) -> Self:
        """Take the scale and the times of the result, or another ``[scale]`` in place of its own."""
        untimed, times = cls.untimed(result, scale), frame_times(result, scale)
        if times is None or not (np.diff(times) > 0).all():
            return untimed
        return replace(untimed, times=times, units=replace(untimed.units, timed=True))

    @classmethod
    def untimed(cls, result: Result, scale: ScaleSettings | None = None) -> Self:
        """Leave out the times, for which every frame is read: for single frames, or a result that still grows."""
        rectified, times = rectification_of(result, scale), np.arange(len(result), dtype=np.float64)
        return cls(result=result, scale=scale, units=rectified.units, times=times, rectified=rectified)

    @property
    def mesh(self) -> Tri3Mesh:
        """The mesh in rectified px; in px where no camera is stated."""
        return self.rectified.mesh

    def where(self, name: str) -> str:
        """Say what one of the `places` lies on."""
        if name.endswith("_mesh"):
            return "the mesh of mesh.file, in its own axes"
        plane = self.rectified.camera is not None and not name.endswith("_image")
        return "the plane of the specimen at the reference" if plane else "the reference image"

    @property
    def places(self) -> dict[str, tuple[str, FloatArray]]:
        """Coordinates of the nodes by name, with unit and values (N,): with a camera those on the image too."""
        found = {name: (self.units.length, self.length * x) for name, x in zip("xy", self.mesh.nodes.T, strict=True)}
        if self.rectified.camera is not None:
            found |= {f"{name}_image": ("px", x) for name, x in zip("xy", self.result.nodes.T, strict=True)}
        if self.result.node_mm is not None:
            found |= {f"{name}_mesh": ("mm", x) for name, x in zip("xy", self.result.node_mm.T, strict=True)}
        return found

    @cached_property
    def gauges(self) -> StrainGauges:
        """Virtual strain gauges around the nodes, the shortest there are."""
        return StrainGauges.at_nodes(NodalCovariance.from_mesh(self.mesh))

    @property
    def measure(self) -> str:
        """Name of the strain measure."""
        return MEASURES[0]

    @property
    def measure_name(self) -> str:
        """Name of the strain measure with capitals."""
        return self.measure.title()

    def in_units(self, length: float) -> str:
        """Write a length (px) as text: in px, and in mm where the scale is known."""
        scale = self.units.mm_per_pixel
        return f"{length:.4g} px" + ("" if scale is None else f" ({length * scale:.3g} mm)")

    @cached_property
    def quantities(self) -> dict[str, ResultQuantity]:
        """Entries of what `frame` returns: the stackable quantities of the table, and strain; lengths in `units`."""
        kept = [entry for entry in QUANTITIES.values() if entry.stackable and entry.name not in _REPLACED]
        converted = [replace(entry, unit=self.units.length) if entry.unit == "px" else entry for entry in kept]
        return {entry.name: entry for entry in (*converted, *_STRAIN, *_ELEMENT_STRAIN)}

    def is_strain(self, name: str) -> bool:
        """Report whether a quantity depends on strain measure and gauge."""
        return any(entry.name == name for entry in (*_STRAIN, *_ELEMENT_STRAIN))

    @property
    def length(self) -> float:
        """Factor from px to the unit of lengths."""
        return self.units.mm_per_pixel or 1.0

    def frame(self, index: int) -> dict[str, Any]:
        """Return the `quantities` of one frame, each in its type; errors as `Result.frame`."""
        record = self.result.frame(index)
        values = {name: record.values[name] for name in self.quantities if name in record.values}
        u, v, u_std, v_std = self.rectified.displacement(record.u, record.v, record.u_std, record.v_std)
        for component, pair in {"u": (u, u_std), "v": (v, v_std)}.items():
            values |= zip((component, f"{component}_std"), self.units.lengths(*pair), strict=True)
        values |= self.strain(u, v, u_std, v_std)
        gradient = self.mesh.element_gradient(np.stack([u, v], axis=1))
        elements = strain_of_gradient(gradient, np.zeros((len(gradient), 4, 4)))
        return values | {entry.name: entry.of(elements) for entry in _ELEMENT_STRAIN}

    def strain(self, u: FloatArray, v: FloatArray, u_std: FloatArray, v_std: FloatArray) -> dict[str, FloatArray]:
        """Return the strain at the nodes by name, from the displacements (N,) of one frame in rectified px."""
        strain = self.gauges.strain(u, v, u_std, v_std)
        return {entry.name: entry.of(strain) for entry in _STRAIN}
