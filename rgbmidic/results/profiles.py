"""Profiles: a field along a line over the frames, and the front of a wave on it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.disk import check_file, write_complete, write_table
from rgbmidic.errors import InputError
from rgbmidic.field import Field, column
from rgbmidic.fields import ProfileLine
from rgbmidic.fields.history import rate_correlation
from rgbmidic.fields.profiles import Arrivals, Front, arrival_times, fit_front
from rgbmidic.renamed import state_new_names
from rgbmidic.results.maps import Maps
from rgbmidic.text import format_times
from rgbmidic.typing import AnyArray, FloatArray


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Wave:
    """A front or peak along a profile, in the profile's units.

    Attributes
    ----------
    feature, level
        As of `rgbmidic.fields.profiles.arrival_times`.
    arrivals, front
        When it is at each position, and the straight line through that. The uncertainty of the speed includes the
        scale's.
    """

    feature: str
    level: float | str
    arrivals: Arrivals
    front: Front


@state_new_names
class Profile:
    """A field along a line in some frames; its values are NaN until `fill` reads them.

    Parameters
    ----------
    maps
        The result and how its fields are derived.
    field
        Name of the field.
    place
        Ends x0, y0, x1, y1 of the line in px of the image.
    frames
        Indices of the frames.

    Attributes
    ----------
    field, how
        What it is, and how it is derived (`Maps.processing_note`).
    line
        The points; its positions are in rectified px.
    frames, numbers : ndarray, shape (T,), int
        Place in the result and number of each frame.
    times : ndarray, shape (T,), or None
        In seconds.
    units
        Of lengths and time.
    data
        The field at each point in each frame, shape (T, P), with its standard uncertainty; NaN where not measured. Its
        arrays are `values` and `std`.
    bias_fractions, calibration_fractions : ndarray, shape (T,)
        Part of the noise's variance along the line that the lights' bias leaves, and part of all variance that the
        calibration of two cameras leaves, the same along the line.
    common_fraction
        Fraction of the variance that all frames have in common.
    rate_window
        Time that a rate is taken over; 0 for what is no rate.

    Raises
    ------
    InputError
        The field has no uncertainty, no frame is measured yet, or half of the line is outside the mesh.

    Examples
    --------
    >>> from rgbmidic.results import Result
    >>> maps = Maps.from_result(Result.open("my_result"))
    >>> profile = Profile(maps, "u", (100, 150, 200, 150), frames=[1])
    >>> profile.fill(maps, [0])
    >>> profile.values.shape == (1, len(profile.positions))
    True
    """

    def __init__(self, maps: Maps, field: str, endpoints: Sequence[float], frames: Sequence[int] | AnyArray) -> None:
        self.field, self.processing_note = maps.field(field), maps.processing_note(field)
        result, physical = maps.result, maps.physical
        if f"{field}_std" not in maps.quantities:
            raise InputError(
                f'a profile is of a field with an uncertainty, not of "{field}"; these are '
                + ", ".join(name for name in maps.quantities if f"{name}_std" in maps.quantities)
            )
        self.frames = np.asarray(frames, dtype=np.int64)
        if not len(self.frames):
            raise InputError(f"no frame of {result.path} is measured yet")
        self.line = ProfileLine(
            physical.covariance, physical.gauges, *physical.rectified.probe_coordinates(endpoints, 2)
        )
        times, self.numbers = physical.seconds, physical.number[self.frames]
        self.times = None if times is None else times[self.frames]
        self.units = replace(physical.units, timed=times is not None)
        self.data = Field(
            name=field,
            unit=self.field.unit,
            dims=("frame", "position"),
            values=np.full((len(self.frames), len(self.line.points)), np.nan),
            std=np.full((len(self.frames), len(self.line.points)), np.nan),
        )
        self.bias_fractions, self.calibration_fractions = np.zeros((2, len(self.frames)))
        self.common_fraction, self.rate_window = physical.common_fraction, 0.0
        if self.field.group == "Rates" and len(self.frames) > 1:
            self.rate_window = (maps.window - 1) * float(np.median(np.diff(self.clock)))

    def fill(self, maps: Maps, rows: Iterable[int]) -> None:
        """Read some rows of the values and of their uncertainties, in place.

        Parameters
        ----------
        maps
            The result and how its fields are derived.
        rows
            Indices of the rows, one a frame.
        """
        for row in rows:
            nodal = maps.read(self.field.name, int(self.frames[row]))
            variances = np.square([nodal.bias_std, nodal.noise.uncertainty, nodal.uncertainty])[:, self.line.nodes]
            bias, noise, total = np.nansum(variances, axis=1)
            self.bias_fractions[row] = bias / noise if noise else 0.0
            self.calibration_fractions[row] = 1 - noise / total if total else 0.0
            along = self.line.read(nodal, self.covariance_key)
            self.values[row], self.std[row] = along.values, along.uncertainty

    @property
    def values(self) -> FloatArray:
        """Values (T, P) of `data`."""
        return self.data.values

    @property
    def std(self) -> FloatArray:
        """Standard uncertainties (T, P) of `data`."""
        return self.data.uncertainty

    @property
    def positions(self) -> FloatArray:
        """Distance (P,) of the points from the first end, in the unit of lengths."""
        return self._in_units(self.line.positions)

    @property
    def places(self) -> FloatArray:
        """Places (P, 2) of the points on the reference, or (P, 3) in space, in the unit of lengths."""
        return self._in_units(self.line.coordinates)

    def _in_units(self, lengths: FloatArray) -> FloatArray:
        return self.units.convert(Field(name="", unit=self.line.unit, values=lengths)).values

    @property
    def clock(self) -> FloatArray:
        """Times (T,) in s, or numbers of the frames where no time is known."""
        return np.asarray(self.numbers if self.times is None else self.times, dtype=np.float64)

    @property
    def covariance_key(self) -> str:
        """Key of `ProfileLine.covariances`: how the errors of the field hang together."""
        if self.field.name[:3] in ("exx", "eyy"):
            return self.field.name[:3]
        return "strain" if self.field.unit in ("", "deg") or "_rate" in self.field.name else ""

    def wave(self, feature: str = "front", level: float | str = "50%") -> Wave:
        """Fit the speed of a front or peak.

        Parameters
        ----------
        feature, level
            As of `rgbmidic.fields.profiles.arrival_times`.

        Returns
        -------
        Wave

        Raises
        ------
        InputError
            Nothing travels along the line, or `feature` or `level` is none of those allowed.
        """
        clock = self.clock
        frame_correlation = rate_correlation(clock, self.rate_window) if self.rate_window else None
        options: dict[str, Any] = {
            "common_fraction": 0.0 if self.rate_window else self.common_fraction,
            "between_frames": frame_correlation,
        }
        arrivals = arrival_times(clock, self.data, feature=feature, level=level, **options)
        fractions = float(self.bias_fractions.mean()), float(self.calibration_fractions.mean())
        correlation = self.line.correlation(self.covariance_key, *fractions)
        front = fit_front(self.positions, arrivals, self.data, correlation, usable=self.line.is_two_sided, **options)
        scale = self.units.mm_per_pixel_std / (self.units.mm_per_pixel or 1.0)
        front = replace(front, speed_std=float(np.hypot(front.speed_std, scale * front.speed)))
        return Wave(feature=feature, level=level, arrivals=arrivals, front=front)


def read_profile(maps: Maps, field: str, endpoints: Sequence[float], frames: Sequence[int] | None = None) -> Profile:
    """Read a field along a line in every frame.

    Parameters
    ----------
    maps
        The result and how its fields are derived.
    field
        Name of the field.
    endpoints
        Ends x0, y0, x1, y1 of the line in px of the image.
    frames
        Indices of the frames; None: all that are measured.

    Returns
    -------
    Profile

    Raises
    ------
    InputError
        There is no such field or frame, it has no uncertainty, or half of the line is outside the mesh.

    Examples
    --------
    >>> from rgbmidic.results import Result
    >>> maps = Maps.from_result(Result.open("my_result"))
    >>> (x0, y0), (x1, y1) = maps.result.nodes.min(axis=0), maps.result.nodes.max(axis=0)
    >>> profile = read_profile(maps, "u", (x0, (y0 + y1) / 2, x1, (y0 + y1) / 2))
    >>> profile.values.shape == (len(profile.frames), len(profile.positions))
    True
    """
    profile = Profile(maps, field, endpoints, np.flatnonzero(maps.result.finished) if frames is None else frames)
    profile.fill(maps, range(len(profile.frames)))
    if not np.isfinite(profile.values).any():
        raise InputError(f"{field} is measured in no frame along the line; place it elsewhere")
    return profile


def write_profile(profile: Profile, out: Path | str, wave: Wave | None = None, *, overwrite: bool = False) -> None:
    """Write a profile as CSV, one row for each frame and point; with a wave its arrival times beside it.

    Parameters
    ----------
    profile
        What is written: frame, number, time, position along the line, place, value and uncertainty.
    out
        File to write.
    wave
        Its arrival times and residuals go into a file whose name ends in ``_arrivals.csv``, one row a position.
    overwrite
        Replace files that are already there.

    Raises
    ------
    ResultError
        A file exists, its folder does not, or it cannot be written.

    Examples
    --------
    >>> from rgbmidic.results import Result
    >>> profile = read_profile(Maps.from_result(Result.open("my_result")), "u", (100, 150, 200, 150))
    >>> write_profile(profile, "profile.csv", overwrite=True)
    >>> Path("profile.csv").read_text().split(",")[:3]
    ['frame', 'number', 'position_mm']
    >>> Path("profile.csv").unlink()
    """
    out = Path(out)
    arrivals_path = arrivals_file(out)
    for file in (out, *([arrivals_path] if wave else [])):
        check_file(file, overwrite=overwrite)
    unit, value = profile.units.length, column(profile.field.name, profile.field.unit)
    head = [column(name, unit) for name in ("position", *"xyz"[: profile.places.shape[1]])]
    positions = np.column_stack([profile.positions, profile.places])
    time_columns = [] if profile.times is None else ["time_s"]

    def rows() -> Iterator[list[object]]:
        clock = format_times(profile.clock.tolist())
        for row, (frame, number, time) in enumerate(zip(profile.frames, profile.numbers, clock, strict=True)):
            cells = [frame, number, *([time] if time_columns else [])]
            for numbers in np.column_stack([positions, profile.values[row], profile.std[row]]).tolist():
                yield [*cells, *numbers]

    names = ["frame", "number", *time_columns, *head, value, f"{value}_std"]
    write_complete(out, lambda file: write_table(file, names, rows()))
    if wave is None:
        return
    clock = "s" if time_columns else "frame"
    columns = {
        **dict(zip(head, positions.T, strict=True)),
        f"arrival_{clock}": wave.arrivals.times.values,
        f"arrival_{clock}_std": wave.arrivals.times.uncertainty,
        f"residual_{clock}": wave.front.residuals,
        "used": wave.front.is_fitted.astype(float),
    }
    write_complete(
        arrivals_path, lambda file: write_table(file, columns, np.column_stack([*columns.values()]).tolist())
    )


def arrivals_file(out: Path) -> Path:
    """Return the file of arrival times beside that of a profile."""
    return out.with_name(f"{out.stem}_arrivals.csv")
