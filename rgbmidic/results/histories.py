"""Histories and profiles: what probes measure over the frames, and a field along a line, as tables and CSV files.

A probe is read frame by frame; its rates, and the channels recorded beside the test, go with it. A profile is read off
the maps of a result, with the speed of a front that travels along it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from rgbmidic.arguments import checked
from rgbmidic.disk import check_file, write_complete, write_table
from rgbmidic.errors import InputError
from rgbmidic.field import Displacement, Field, FieldSource
from rgbmidic.fields.history import Probe, rate_frames, rate_words, rates
from rgbmidic.fields.nodal import RigidMotion
from rgbmidic.fields.probes import make_probe
from rgbmidic.fields.quantity import Units
from rgbmidic.fields.strain import EQUIVALENT
from rgbmidic.results.channels import Channels
from rgbmidic.results.result import Result
from rgbmidic.settings import ChannelSettings, ProbeSettings, ScaleSettings
from rgbmidic.text import format_times, format_value
from rgbmidic.typing import AnyArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Histories:
    """Histories of probes over the measured frames.

    Attributes
    ----------
    frames, numbers, status : ndarray, shape (T,), int
        Place in the result, number (with gaps where frames are lost) and status of each frame.
    times : ndarray, shape (T,), or None
        In seconds.
    units
        Of lengths and time.
    quantities
        One after the other.
    stress_strain
        Names of the strain and the stress that go together, where a stress is known.
    remarks
        What a reader should know, a line each.
    channels
        Recorded beside the test, by the clock of the frames; None: there are none.

    Examples
    --------
    >>> result = Result.open("my_result")
    >>> histories = read_histories(result, ProbeSettings(points=(tuple(result.nodes.mean(axis=0)),)))
    >>> u = histories.quantities[0]
    >>> u.unit, u.values.shape == histories.status.shape == (len(histories.frames),)
    ('mm', True)
    """

    frames: IntArray
    numbers: IntArray
    status: IntArray
    times: FloatArray | None
    units: Units
    quantities: tuple[Field, ...] = ()
    stress_strain: tuple[str, str] | None = None
    remarks: tuple[str, ...] = ()
    channels: Channels | None = None

    def __getitem__(self, name: str) -> Field:
        """Return the quantity of a name, or of a column name with unit."""
        for quantity in self.quantities:
            if name in (quantity.name, quantity.column):
                return quantity
        raise KeyError(name)


def history_rows(histories: Histories) -> tuple[list[str], list[list[str]]]:
    """Summarise histories for a table.

    Parameters
    ----------
    histories
        What is summarised.

    Returns
    -------
    headings : list of str
    rows : list of list of str
        Of every quantity: name, unit, extremes, last value, median standard uncertainty, number of frames.

    Examples
    --------
    >>> result = Result.open("my_result")
    >>> headings, rows = history_rows(read_histories(result, ProbeSettings(points=(tuple(result.nodes.mean(axis=0)),))))
    >>> headings[:2], [row[0] for row in rows]
    (['quantity', 'unit'], ['point_1_u', 'point_1_v'])
    """
    rows = []
    for quantity in histories.quantities:
        finite_rows = np.flatnonzero(np.isfinite(quantity.values))
        finite_values = quantity.values[finite_rows]
        std = quantity.uncertainty[finite_rows]
        extreme_indices = (
            (finite_values.argmin(), finite_values.argmax(), len(finite_values) - 1) if finite_values.size else ()
        )
        median_std = float(np.median(std[np.isfinite(std)])) if np.isfinite(std).any() else math.nan
        rounding_std = np.fmax(
            std, median_std
        )  # a reference frame is known to rounding only: that is not the test's uncertainty
        texts = [format_value(finite_values[index], rounding_std[index]) for index in extreme_indices] or ["-"] * 3
        rows.append(
            [quantity.name, quantity.unit, *texts, format_value(median_std, median_std), f"{finite_values.size}"]
        )
    return ["quantity", "unit", "smallest", "largest", "last", "uncertainty", "frames"], rows


def write_histories(histories: Histories, out: Path | str, *, overwrite: bool = False) -> None:
    """Write `history_csv` into a file.

    Parameters
    ----------
    histories
        What is written.
    out
        File to write.
    overwrite
        Whether it may be replaced.

    Raises
    ------
    ResultError
        The file exists, its folder does not, or it cannot be written.

    Examples
    --------
    >>> result = Result.open("my_result")
    >>> histories = read_histories(result, ProbeSettings(points=(tuple(result.nodes.mean(axis=0)),)))
    >>> write_histories(histories, "history.csv", overwrite=True)
    >>> Path("history.csv").read_text().split(",")[:3]
    ['frame', 'number', 'status']
    >>> Path("history.csv").unlink()
    """
    out = Path(out)
    check_file(out, overwrite=overwrite)
    write_complete(out, lambda file: history_csv(histories, file))


def history_csv(histories: Histories, file: BinaryIO) -> None:
    """Write histories as CSV: a header line whose names carry the units, then one row a frame; empty: no value."""
    columns: dict[str, AnyArray] = {"frame": histories.frames, "number": histories.numbers, "status": histories.status}
    if histories.times is not None:
        columns["time_s"] = np.array(format_times(histories.times.tolist()))
    for quantity in histories.quantities:
        columns[quantity.column] = quantity.values
        if quantity.std is not None:
            columns[f"{quantity.column}_std"] = quantity.std
    write_table(file, columns, zip(*(values.tolist() for values in columns.values()), strict=True))


@checked
def read_histories(
    result: Result | FieldSource,
    probes: ProbeSettings,
    *,
    scale: ScaleSettings | None = None,
    channels: ChannelSettings | None = None,
) -> Histories:
    """Read probes off a result.

    The frames are read once, one after the other; only the nodes that the probes need are kept.

    Parameters
    ----------
    result
        The result, or another source of fields.
    probes
        Where, and what.
    scale
        It replaces the ``[scale]`` that was kept with the result; None: that one.
    channels
        Recorded beside the test: file, clock, and what a stress needs; None: none.

    Returns
    -------
    Histories
        Rigid motion, probes in their order with their rates, channels, stress.

    Raises
    ------
    InputError
        A probe is outside the region, or measured in no frame; too few frames for rates; the times of the
        frames are not known, or have none in common with those of the channels; the channels are not usable.

    Examples
    --------
    >>> result = Result.open("my_result")
    >>> histories = read_histories(result, ProbeSettings(points=(tuple(result.nodes.mean(axis=0)),)))
    >>> [history.name for history in histories.quantities]
    ['point_1_u', 'point_1_v']
    """
    if not probes.kind_coordinates and probes.rigid_motion == "none":
        raise InputError("no probe is stated, such as a point (`points`, or [probes] of TEST.toml)")
    source: FieldSource = result.in_units(scale) if isinstance(result, Result) else result
    base, rectified = empty_histories(source), source.rectified
    frames, units = base.frames, base.units
    if rectified is not None:
        rectified = replace(rectified, units=units)
    if not len(frames):
        raise InputError(f"no frame of {source.path} is measured yet")
    window = probes.window and rate_frames(probes.window, len(frames))
    counts, probe_list = Counter[str](), list[Probe]()
    for kind, position in probes.kind_coordinates:
        counts[kind] += 1
        probe_list.append(make_probe(source.covariance, kind, counts[kind], position, probes, rectified))
    clock = base.numbers.astype(np.float64) if base.times is None else base.times
    series, rigid, steps = _read_probes(source, frames, probe_list, probes.rigid_motion)
    by_probe = {probe.name: probe.histories(nodal) for probe, nodal in zip(probe_list, series, strict=True)}
    for name, histories in by_probe.items():
        if not any(np.isfinite(history.values).any() for history in histories):
            raise InputError(
                f"{name} is measured in no frame of {source.path}: the nodes around it are not measured (node_status "
                "says why); place it elsewhere"
            )
    span = (window - 1) * float(np.median(np.diff(clock))) if len(clock) > 1 else 0.0
    options: dict[str, Any] = {"common_fraction": source.common_fraction, "references": source.references[frames]}
    compute_rates = partial(rates, clock, window=span, **options) if window else None
    all_histories = [*rigid, *(history for histories in by_probe.values() for history in histories)]
    quantities = tuple(
        quantity for history in all_histories for quantity in convert_history(history, units, compute_rates)
    )
    remarks = [*source.remarks, *_remarks(source, base, steps, by_probe)]
    if any(quantity.name.endswith("_exx") for quantity in quantities):
        remarks.append(f"exx, eyy, exy, e1, e2: {probes.measure.title()} strain")
    if window:
        remarks.append(f"rates: {rate_words(probes.window, len(frames))}")
    probe_histories = replace(base, quantities=quantities, remarks=tuple(remarks))
    return with_channels(probe_histories, channels or ChannelSettings())


def empty_histories(source: FieldSource) -> Histories:
    """Return histories of no probe: the measured frames and their times, for channels."""
    frames, seconds = np.flatnonzero(source.finished), source.seconds
    return Histories(
        frames=frames,
        numbers=source.number[frames],
        status=source.status[frames],
        times=None if seconds is None else seconds[frames],
        units=replace(source.units, timed=seconds is not None),
    )


def _read_probes(
    source: FieldSource, frames: IntArray, probes: list[Probe], rigid_motion: str
) -> tuple[list[Displacement], list[Field], FloatArray]:
    """Read what displacements each probe needs, the rigid motion, and the steps (T,) of fast nodes between frames."""
    of_probes: list[list[Displacement]] = [[] for _ in probes]
    motions = dict[int, RigidMotion]()
    steps, previous = np.full(len(frames), np.nan), np.full(1, np.nan)
    for row, frame in enumerate(frames.tolist()):
        displacement = source.displacement(frame)
        step = np.linalg.norm(displacement.values - previous, axis=0)
        if row and np.isfinite(step).any():
            steps[row] = np.nanpercentile(step, 95)  # of the fast nodes: single outliers do not count
        previous = displacement.values
        if rigid_motion != "none" and displacement.is_measured.sum() > 1:
            motions[row] = motion = RigidMotion.of(source.covariance, displacement)
            displacement = motion.removed(source.points, displacement) if rigid_motion == "remove" else displacement
        for fields, probe in zip(of_probes, probes, strict=True):
            fields.append(displacement.isel(node=probe.nodes))
    histories = []
    for component in zip(*(motion.components for motion in motions.values()), strict=True):
        values, std = np.full((2, len(frames)), np.nan)
        values[[*motions]], std[[*motions]] = zip(*((one.values, one.uncertainty) for one in component), strict=True)
        history, common = replace(component[0], dims=("frame",), values=values, std=std), component[0].common
        if common is not None:
            common = np.full((len(common), len(frames)), np.nan)
            common[:, [*motions]] = np.stack([one.common for one in component], axis=1)
        histories.append(replace(history, common=common))
    return [Displacement.concatenate(fields) for fields in of_probes], histories, steps


def convert_history(
    history: Field, units: Units, compute_rates: Callable[[Field], dict[str, Field]] | None
) -> Iterator[Field]:
    """Convert a history to the reader's units; add its rates, if asked for, at kinks those of both sides."""
    converted, is_length = units.convert(history), history.unit in ("px", "mm")
    yield converted
    is_direction = history.unit == "deg" and not history.name.startswith("rigid_rotation")
    # the rates of a length are those of its extension
    if history.std is None or compute_rates is None or is_direction or history.name.endswith("_length"):
        return
    rate_fields = compute_rates(history)
    for power, name in enumerate(("velocity", "acceleration") if is_length else ("velocity",), start=1):
        for suffix in ("", "_before", "_after"):
            rate = units.convert(rate_fields[f"{name}{suffix}"])
            if not suffix or np.isfinite(rate.values).any():  # else no kink
                title = f"{history.name}_{name if is_length else 'rate'}{suffix}"
                yield replace(rate, name=title, unit=units.per_time(converted.unit, power), note="")


def with_channels(histories: Histories, settings: ChannelSettings) -> Histories:
    """Add channels at the times of the frames to what probes measure, and the stress where a cross-section is known.

    Parameters
    ----------
    histories
        Of probes, or of none: its frames count.
    settings
        File, clock, and what a stress needs.

    Raises
    ------
    InputError
        As `read_histories`, for the channels.
    """
    if settings.file is None:
        return histories
    times = histories.times
    if times is None:
        raise InputError(
            f"the channels {settings.file} cannot be brought to the frames, whose times are not known: state "
            "frame_rate in [scale]"
        )
    channels, remarks, shift_text = Channels.read(settings.file, settings.offset, settings.trigger), list[str](), ""
    if settings.align is not None:
        name, history_name = settings.align
        column = next(
            (quantity for quantity in histories.quantities if history_name in (quantity.name, quantity.column)), None
        )
        if column is None:
            names = ", ".join(quantity.name for quantity in histories.quantities)
            raise InputError(
                f'channels.align names the history "{history_name}", which is not one of {names or "none"}'
            )
        channels, std, coefficient = channels.align(name, times, column.values)
        shift_text = (
            f" ({std:.2g} s standard uncertainty), where {name} and {column.name} correlate by {coefficient:.3f}"
        )
    elif settings.trigger is not None:
        shift_text = f": {settings.trigger} rises at 0"
    if shift_text:
        remarks.append(f"the times of the channels were shifted by {channels.offset:.6g} s{shift_text}")
    elif not settings.offset:
        clock_remark = "the clocks of channels and frames are taken as equal"
        remarks.append(f"{clock_remark}: channels.offset, .trigger or .align relates them")
    start, end = channels.times[[0, -1]]
    covered_fraction = float(np.nanmax(times) - np.nanmin(times)) / (end - start)
    if covered_fraction < 0.01:  # a factor of 1,000 is far below
        coverage_remark = f"the frames cover {covered_fraction:.2%} of the time of the channels"
        remarks.append(f"{coverage_remark}: is the unit of {settings.file} right?")
    channel_values = channels.interpolate(times)
    reserved_names = {"frame", "number", "status", "time_s"} | (
        {"stress", "stress_MPa"} if settings.area is not None else set()
    )
    reserved_names.update(
        *({quantity.name, quantity.column, f"{quantity.column}_std"} for quantity in histories.quantities)
    )
    if clashing_names := sorted(reserved_names & channel_values.keys()):
        raise InputError(
            f"channels of {settings.file} have the names of columns of the history, rename: {', '.join(clashing_names)}"
        )
    channel_histories = [Field(name=name, values=values) for name, values in channel_values.items()]
    for name, values in channel_values.items():
        if missing := int(np.isnan(values).sum()):
            remarks.append(f"the channel {name} has no value in {missing} of {len(histories.frames)} frames")
    strain_and_stress = None
    if settings.area is not None:
        name, newtons = channels.force(settings.force)
        channel_histories.append(
            Field(name="stress", unit="MPa", values=channel_values[name] * newtons / settings.area)
        )
        strain = next(
            (quantity.name for quantity in histories.quantities if quantity.name.endswith(("_strain", "_e1"))), None
        )
        strain_and_stress = (strain, "stress") if strain else None
    return replace(
        histories,
        quantities=(*histories.quantities, *channel_histories),
        stress_strain=strain_and_stress,
        remarks=(*histories.remarks, *remarks),
        channels=channels,
    )


def _remarks(
    source: FieldSource, base: Histories, steps: FloatArray, by_probe: Mapping[str, list[Field]]
) -> Iterator[str]:
    units, frames, exposure = base.units, base.frames, source.exposure
    if not units.timed:
        yield "no time is known: the frame is the unit of time (frame_rate in [scale])"
    speed = np.full(len(frames), np.nan) if base.times is None else steps / np.diff(base.times, prepend=np.nan)
    blurred = np.nan_to_num(speed) * exposure > 1  # px: the speckle is smeared over a pixel
    if blurred.any():
        yield (
            f"motion blur: within the exposure of {exposure:g} s the surface moves by up to "
            f"{np.nanmax(speed) * exposure:.3g} px, by more than 1 px in {int(blurred.sum())} frames from "
            f"frame {frames[blurred][0]} on"
        )
    if any(history.name.endswith("_equivalent") for series in by_probe.values() for history in series):
        yield f"equivalent: {EQUIVALENT}"
    yield from dict.fromkeys(history.note for series in by_probe.values() for history in series if history.note)
    for name, series in by_probe.items():
        if missing := int(np.isnan(series[0].values).sum()):
            yield f"{name} is not measured in {missing} of {len(frames)} frames"
