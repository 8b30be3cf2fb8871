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
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy.optimize import minimize_scalar

from rgbmidic.errors import InputError
from rgbmidic.fields import (
    EQUIVALENT,
    MEASURES,
    CameraCalibration,
    NodalCovariance,
    Rectification,
    Strain,
    StrainGauges,
    Units,
    reference_fraction,
    strain_of_gradient,
)
from rgbmidic.mesh import Placement, Tri3Mesh
from rgbmidic.results.quantities import QUANTITIES, UNKNOWN_TIME, ResultQuantity
from rgbmidic.results.result import Result
from rgbmidic.settings import ChannelSettings, ProbeSettings, ScaleSettings, read_section, regular
from rgbmidic.typing import BoolArray, FloatArray

logger = logging.getLogger(__name__)

_TIME = re.compile(r"(?:time|t)(?:[\s_(\[]+(s|ms|us|µs)[)\]]?)?", re.IGNORECASE)
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
_NEWTONS = {"N": 1.0, "kN": 1e3}
_DECIMAL = re.compile(r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:e[+-]?\d+)?|nan", re.IGNORECASE | re.ASCII)
_UNIT = re.compile(r".*[\s_(\[](kN|N)[)\]]?")
_DIFFERENT = 0.01
"""Relative difference of a stated frame rate from that of the time stamps above which a warning names both: stamps
in whole microseconds give the median interval of 10,000 frames per second to 1 %."""


_FEWEST, _ALIKE = 8, 0.7
"""Values that an alignment needs at least, and the correlation coefficient: half of the variance explained (chosen)."""


def scale_of(result: Result) -> ScaleSettings:
    """Return the ``[scale]`` that a result was measured with.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    ScaleSettings
    """
    return read_section(ScaleSettings, "scale", result.provenance.get("settings", {}).get("scale", {}))


def probes_of(result: Result) -> ProbeSettings:
    """Return the ``[probes]`` that a result was measured with.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    ProbeSettings
    """
    return read_section(ProbeSettings, "probes", result.provenance.get("settings", {}).get("probes", {}))


def channels_of(result: Result) -> ChannelSettings:
    """Return the ``[channels]`` that a result was measured with.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    ChannelSettings
    """
    return read_section(ChannelSettings, "channels", result.provenance.get("settings", {}).get("channels", {}))


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
    """Return where the mesh of ``mesh.file`` lies on the image; None where the result has none.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    Placement or None
    """
    kept = result.provenance.get("finite_elements")
    if kept is None:
        return None
    document = result.provenance.get("camera")
    camera = None if document is None else CameraCalibration.from_document(document, str(scale_of(result).camera))
    return Placement.from_document(kept["placement"], camera)


def units_of(result: Result, scale: ScaleSettings | None = None) -> Units:
    """Return the units of a result, with its own ``[scale]`` or another one in its place.

    Parameters
    ----------
    result
        The result.
    scale
        It replaces the ``[scale]`` that was kept with the result; None: that one.

    Returns
    -------
    Units
    """
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
    """Return the exposure time of a frame in seconds; None where the files do not report it.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    float or None
    """
    nanoseconds = result.provenance.get("exposure_ns")
    return None if nanoseconds is None else float(nanoseconds) * 1e-9


def reference_frames(result: Result) -> BoolArray:
    """Return a mask (T,) of the frames that belong to the reference.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    ndarray, shape (T,), bool
    """
    chosen = np.zeros(len(result), dtype=bool)
    chosen[list(result.provenance["references"])] = True
    return chosen


def shared_part(result: Result) -> float:
    """Return the fraction of a frame's variance that all frames have in common (see `reference_fraction`).

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    float
    """
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
    def read(cls, path: Path | str, offset: float = 0.0, trigger: str | None = None) -> Self:
        """Read a CSV file: a header line, then rows; the first column is ``time_s``, ``time_ms`` or ``time_us``.

        Columns are separated by commas, semicolons (then a comma may be the decimal point) or tabs.

        Parameters
        ----------
        path
            The file.
        offset
            Seconds that are added to its times to make them those of the frames.
        trigger
            In place of `offset`: the channel whose first crossing of the middle of its range is the time 0.

        Returns
        -------
        Channels

        Raises
        ------
        InputError
            The file is missing, has no such header, a field is no number, two columns have one name, the times do not
            rise, or the trigger is not one of the channels or constant.
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
        try:
            head, *rows = list(csv.reader(lines, delimiter=separator)) or [[]]
        except csv.Error as error:
            raise InputError(f"the channels {path} are not a table: {error}") from None
        names = [name.strip() for name in head]
        unit = _TIME.fullmatch(names[0]) if len(names) > 1 else None
        if unit is None:
            raise InputError(
                f'the channels {path} need a header line: "time_s" (or time_ms, time_us) and the name of each channel'
            )
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InputError(f"the channels {path} have several columns of one name: {', '.join(twice)}")
        if "" in names:
            raise InputError(f"column {names.index('') + 1} of the channels {path} has no name in the header line")
        table = _numbers(path, rows, separator, len(names))
        times = table[:, 0] * _SECONDS[(unit[1] or "s").lower()]
        if len(times) < 2 or not (np.diff(times) > 0).all():
            raise InputError(f"the times of the channels {path} must rise from row to row, over two rows or more")
        values = dict(zip(names[1:], table[:, 1:].T, strict=True))
        channels = cls(path=path, times=times, values=values)
        if trigger is not None:
            known = np.isfinite(channels.named(trigger))
            signal, times = channels.named(trigger)[known], times[known]
            middle = (signal.min() + signal.max()) / 2 if len(signal) else math.nan
            crossed = np.flatnonzero(np.diff(signal > middle))
            if not len(crossed):
                raise InputError(f"the trigger {trigger} of the channels {path} is constant: it marks no time")
            if len(crossed) > 1:
                logger.warning(
                    "the trigger %s of %s crosses the middle of its range %d times: the first counts",
                    trigger,
                    path,
                    len(crossed),
                )
            i = int(crossed[0])
            offset = -float(times[i] + (middle - signal[i]) / (signal[i + 1] - signal[i]) * (times[i + 1] - times[i]))
        return channels.shifted(offset)

    def shifted(self, offset: float) -> Self:
        """Return the channels with an offset (s) added to the times.

        Parameters
        ----------
        offset
            In seconds.

        Returns
        -------
        Channels
        """
        return replace(self, times=self.times + offset, offset=self.offset + offset)

    def named(self, name: str) -> FloatArray:
        """Return the values (n,) of a channel.

        Parameters
        ----------
        name
            Name of the channel.

        Returns
        -------
        ndarray, shape (n,)

        Raises
        ------
        InputError
            There is none of this name.
        """
        if name not in self.values:
            raise InputError(f'"{name}" is not one of the channels of {self.path}: {", ".join(self.values)}')
        return self.values[name]

    def aligned(self, name: str, times: FloatArray, values: FloatArray) -> tuple[Self, float, float]:
        """Find the offset at which a channel correlates best with a history.

        Of every offset that leaves half of the frames within the channel's times, the largest absolute correlation
        coefficient of the channel, interpolated at the frames, with the history counts.

        Parameters
        ----------
        name
            The channel.
        times, values : ndarray, shape (T,)
            Seconds and values of the history; NaN where it has none.

        Returns
        -------
        channels : Channels
            With that offset.
        std : float
            Its standard uncertainty in seconds, from what the fit of the channel to the history leaves as noise, taken
            as independent from frame to frame.
        coefficient : float
            The correlation coefficient.

        Raises
        ------
        InputError
            There is no such channel, too little of the history is known, or the two do not correlate.
        """
        signal, there = self.named(name), np.isfinite(values) & np.isfinite(times)
        at, wanted = times[there], values[there]
        if len(at) < _FEWEST or not np.ptp(wanted) > 0:
            raise InputError(f"{len(at)} values of the history are too few, or constant, to align {name} with")
        least = len(at) // 2

        def fit(offset: float) -> tuple[float, float]:
            """Correlation coefficient and standard uncertainty of the offset."""
            moved = np.interp(at, self.times + offset, signal, np.nan, np.nan)
            used = np.isfinite(moved)
            if used.sum() < max(least, _FEWEST) or not np.ptp(moved[used]) > 0:
                return 0.0, math.nan
            coefficient = float(np.corrcoef(moved[used], wanted[used])[0, 1])
            slope = coefficient * np.std(wanted[used]) / np.std(moved[used])
            noise = np.var(wanted[used]) * (1 - coefficient**2)
            steep = np.gradient(moved[used], at[used]) * slope
            return coefficient, float(np.sqrt(noise / max((steep**2).sum(), np.finfo(float).tiny)))

        step = float(np.median(np.diff(at))) / 2
        grid = np.arange(at[least] - self.times[-1], at[-least - 1] - self.times[0] + step, step)
        scores = [abs(fit(offset)[0]) for offset in grid]
        best = float(grid[int(np.argmax(scores))]) if scores else 0.0
        offset = float(
            minimize_scalar(lambda x: -abs(fit(x)[0]), bounds=(best - step, best + step), method="bounded").x
        )
        coefficient, std = fit(offset)
        if not abs(coefficient) > _ALIKE:
            raise InputError(
                f"the channel {name} of {self.path} correlates with the history by {coefficient:.2f} at best, {_ALIKE} "
                "is needed to align them: state channels.offset"
            )
        return self.shifted(offset), std, coefficient

    def at(self, times: FloatArray) -> dict[str, FloatArray]:
        """Interpolate each channel linearly at the times (T,) of the frames; NaN beyond its values.

        Parameters
        ----------
        times
            In seconds.

        Returns
        -------
        dict of str to ndarray, shape (T,)

        Raises
        ------
        InputError
            No frame lies within the times of the channels.
        """
        first, last = self.times[[0, -1]]
        if not ((times >= first) & (times <= last)).any():
            raise InputError(
                f"the channels {self.path} span {first:.9g} to {last:.9g} s (offset {self.offset:g} s included), the "
                f"frames {np.nanmin(times):.9g} to {np.nanmax(times):.9g} s: state channels.offset (--offset) between "
                "both clocks"
            )
        return {name: np.interp(times, self.times, values, np.nan, np.nan) for name, values in self.values.items()}

    def force(self, name: str | None = None) -> tuple[str, float]:
        """Return the name of the channel with a force, and its unit in newtons.

        Parameters
        ----------
        name
            Of the channel; None: the only one whose name ends in N or kN.

        Returns
        -------
        name : str
        factor : float

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


def _numbers(path: Path, rows: list[list[str]], separator: str, count: int) -> FloatArray:
    """Read rows of finite decimal numbers (n, count); an empty field, or nan, is NaN."""
    table, marks = [], set[str]()
    for number, row in enumerate(rows, 2):
        fields = [part.strip() for part in row]
        marks.update(mark for part in fields for mark in ".," if mark in part)
        values = [
            float(part.replace(",", ".") if separator == ";" else part) if part else math.nan
            for part in fields
            if not part or (_DECIMAL.fullmatch(part) and (separator == ";" or "," not in part))
        ]
        if len(values) != len(row) or np.isinf(values).any():
            raise InputError(f"row {number} of the channels {path} is not numbers: {reprlib.repr(row)}")
        if len(row) != count:
            raise InputError(f"row {number} of the channels {path} has {len(row)} fields, the header {count}")
        if len(marks) > 1:
            raise InputError(
                f"row {number} of the channels {path}: the file has numbers with a comma and numbers with a point; "
                f"one of them is the decimal mark, and thousands are not separated: {reprlib.repr(row)}"
            )
        table.append(values)
    return np.array(table, dtype=np.float64).reshape(-1, count)


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
    ResultQuantity("e1_std", _NODE, "", "principal_std.0", "standard uncertainty of e1"),
    ResultQuantity("e2_std", _NODE, "", "principal_std.1", "standard uncertainty of e2"),
    ResultQuantity("direction", _NODE, "deg", "direction_deg", "direction of e1, from x towards y"),
    ResultQuantity("direction_std", _NODE, "deg", "direction_std_deg", "standard uncertainty of direction"),
    ResultQuantity("shear", _NODE, "", "shear", "largest shear in the plane, e1 - e2 (engineering shear)"),
    ResultQuantity("shear_std", _NODE, "", "shear_std", "standard uncertainty of shear"),
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
    gauge
        Length of the virtual strain gauges in (rectified) px; None: the shortest there are.
    measure
        Name of the strain measure, one of `MEASURES`.
    """

    result: Result
    scale: ScaleSettings | None
    units: Units
    times: FloatArray
    rectified: Rectification
    gauge: float | None = None
    measure: str = MEASURES[0]

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
    def covariance(self) -> NodalCovariance:
        """Correlation of the nodes' errors."""
        return NodalCovariance.from_mesh(self.mesh)

    @cached_property
    def gauges(self) -> StrainGauges:
        """Virtual strain gauges around the nodes."""
        return StrainGauges.at_nodes(self.covariance, self.gauge)

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
        elements = strain_of_gradient(gradient, np.zeros((len(gradient), 4, 4)), self.measure)
        return values | {entry.name: entry.of(elements) for entry in _ELEMENT_STRAIN}

    def strain(self, u: FloatArray, v: FloatArray, u_std: FloatArray, v_std: FloatArray) -> dict[str, FloatArray]:
        """Return the strain at the nodes by name, from the displacements (N,) of one frame in rectified px."""
        return self.named(self.gauges.strain(u, v, u_std, v_std, measure=self.measure))

    @staticmethod
    def named(strain: Strain) -> dict[str, FloatArray]:
        """Return the quantities of a strain by name."""
        return {entry.name: entry.of(strain) for entry in _STRAIN}
