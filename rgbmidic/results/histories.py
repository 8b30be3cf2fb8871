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
from typing import BinaryIO

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.fields.history import History, Nodal, Probe, Rates, rate_frames, rate_words, rates
from rgbmidic.fields.nodal import RigidMotion
from rgbmidic.fields.probes import make_probe
from rgbmidic.fields.strain import EQUIVALENT
from rgbmidic.fields.units import Units
from rgbmidic.results.channels import Channels
from rgbmidic.results.files import check_file, write_complete, write_table
from rgbmidic.results.physical import Physical, displacements, frame_times, reference_frames, shared_part
from rgbmidic.results.result import Result
from rgbmidic.settings import ChannelSettings, ProbeSettings, ScaleSettings
from rgbmidic.text import format_value
from rgbmidic.typing import AnyArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Histories:
    """What probes measure in the frames that there are.

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
    """

    frames: IntArray
    numbers: IntArray
    status: IntArray
    times: FloatArray | None
    units: Units
    quantities: tuple[History, ...] = ()
    stress_strain: tuple[str, str] | None = None
    remarks: tuple[str, ...] = ()
    channels: Channels | None = None

    def __getitem__(self, name: str) -> History:
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
    """
    rows = []
    for quantity in histories.quantities:
        places = np.flatnonzero(np.isfinite(quantity.values))
        known = quantity.values[places]
        std = np.full(len(known), np.nan) if quantity.std is None else quantity.std[places]
        ends = (known.argmin(), known.argmax(), len(known) - 1) if known.size else ()
        typical = float(np.median(std[np.isfinite(std)])) if np.isfinite(std).any() else math.nan
        place = np.fmax(std, typical)  # a reference frame is known to rounding only: that is not the test's uncertainty
        texts = [format_value(known[end], place[end]) for end in ends] or ["-"] * 3
        rows.append([quantity.name, quantity.unit, *texts, format_value(typical, typical), f"{known.size}"])
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
    """
    out = Path(out)
    check_file(out, overwrite=overwrite)
    write_complete(out, lambda file: history_csv(histories, file))


def history_csv(histories: Histories, file: BinaryIO) -> None:
    """Write histories as CSV: a header line whose names carry the units, then one row a frame; empty: no value."""
    columns: dict[str, AnyArray] = {"frame": histories.frames, "number": histories.numbers, "status": histories.status}
    if histories.times is not None:
        columns["time_s"] = histories.times
    for quantity in histories.quantities:
        columns[quantity.column] = quantity.values
        if quantity.std is not None:
            columns[f"{quantity.column}_std"] = quantity.std
    write_table(file, columns, zip(*(values.tolist() for values in columns.values()), strict=True))


def read_histories(
    result: Result,
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
        The result.
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
    """
    if not probes.places and probes.rigid_motion == "none":
        raise InputError("no probe is stated: give one on the command line, such as --point X,Y, or in [probes]")
    physical = Physical.untimed(result, scale)
    alone = frames_alone(result, physical)
    rectified, there, units = replace(physical.rectified, units=alone.units), alone.frames, alone.units
    if not len(there):
        raise InputError(f"no frame of {result.path} is measured yet")
    window = probes.window and rate_frames(probes.window, len(there))
    counts, made = Counter[str](), list[Probe]()
    for kind, place in probes.places:
        counts[kind] += 1
        made.append(make_probe(physical.covariance, kind, counts[kind], place, probes, rectified))
    clock = alone.numbers.astype(np.float64) if alone.times is None else alone.times
    nodal, rigid, speed = _read(physical, there, made, probes.rigid_motion, clock)
    by_probe = {probe.name: probe.histories(part) for probe, part in zip(made, nodal, strict=True)}
    for name, histories in by_probe.items():
        if not any(np.isfinite(history.values).any() for history in histories):
            raise InputError(
                f"{name} is measured in no frame of {result.path}: the nodes around it are not measured (node_status "
                "says why); place it elsewhere"
            )
    span = (window - 1) * float(np.median(np.diff(clock))) if len(clock) > 1 else 0.0
    common, references = shared_part(result), reference_frames(result)[there]
    rate = partial(rates, clock, window=span, common_fraction=common, references=references) if window else None
    read = [*rigid, *(history for part in by_probe.values() for history in part)]
    quantities = tuple(quantity for history in read for quantity in in_units(history, units, rate))
    remarks = [*_remarks(physical, alone, speed, by_probe)]
    if any(one.name.endswith("_exx") for one in quantities):
        remarks.append(f"exx, eyy, exy, e1, e2: {probes.measure.title()} strain")
    if window:
        remarks.append(f"rates: {rate_words(probes.window, len(there))}")
    read_off = replace(alone, quantities=quantities, remarks=tuple(remarks))
    return with_channels(read_off, channels or ChannelSettings())


def frames_alone(result: Result, physical: Physical | None = None) -> Histories:
    """Return histories of no probe: the measured frames and their times, for channels."""
    physical = physical or Physical.untimed(result)
    there, times = np.flatnonzero(result.finished), frame_times(result, physical.scale)
    return Histories(
        frames=there,
        numbers=result.number[there],
        status=result.status[there],
        times=None if times is None else times[there],
        units=replace(physical.units, timed=times is not None),
    )


def _read(
    physical: Physical, frames: IntArray, probes: list[Probe], rigid: str, clock: FloatArray
) -> tuple[list[Nodal], list[History], FloatArray]:
    """Read the displacements that each probe needs, the rigid motion and the speed (T,) of the fast nodes."""
    kept: list[list[FloatArray]] = [[] for _ in probes]
    motions = np.full((len(clock), 3, 2), np.nan)
    speed, before = np.full(len(clock), np.nan), np.full((2, len(physical.mesh.nodes)), np.nan)
    for row, field in enumerate(displacements(physical.result, physical.rectified, frames.tolist())):
        moved = np.hypot(*(field[:2] - before))
        if row and np.isfinite(moved).any():
            # of the fast nodes: single outliers do not count
            speed[row] = np.nanpercentile(moved, 95) / (clock[row] - clock[row - 1])
        before = field[:2]
        if rigid != "none" and np.isfinite(field).all(axis=0).sum() > 1:
            motion = RigidMotion.of(physical.covariance, *field)
            motions[row] = [*zip(motion.shift, motion.shift_std, strict=True), (motion.rotation, motion.rotation_std)]
            field = motion.removed(physical.mesh.nodes, field) if rigid == "remove" else field
        for fields, probe in zip(kept, probes, strict=True):
            fields.append(field[:, probe.nodes])
    nodal = [Nodal.of(np.stack(fields, axis=1)) for fields in kept]
    motions[:, 2] = np.degrees(motions[:, 2])
    names = {"rigid_u": "px", "rigid_v": "px", "rigid_rotation": "deg"} if rigid != "none" else {}
    histories = [
        History(name=name, unit=unit, values=motions[:, place, 0], std=motions[:, place, 1])
        for place, (name, unit) in enumerate(names.items())
    ]
    return nodal, histories, speed


def in_units(history: History, units: Units, rate: Callable[..., Rates] | None) -> Iterator[History]:
    """Convert a history to the reader's units; add its rates, if asked for, at kinks those of both sides."""
    length = history.unit == "px"
    unit = units.length if length else history.unit

    def entry(name: str, unit: str, values: FloatArray, std: FloatArray) -> History:
        values, std = units.lengths(values, std) if length else (values, std)
        return History(name=name, unit=unit, values=values, std=std)

    if history.std is None:
        yield history
        return
    yield entry(history.name, unit, history.values, history.std)
    if rate is None or (history.unit == "deg" and history.name != "rigid_rotation"):
        return
    found = rate(history.values, history.std)
    for power, name in enumerate(("velocity", "acceleration") if length else ("velocity",), start=1):
        for side in ("", "_before", "_after"):
            values, std = getattr(found, f"{name}{side}"), getattr(found, f"{name}{side}_std")
            if not side or np.isfinite(values).any():  # else no kink
                title = f"{history.name}_{name if length else 'rate'}{side}"
                yield entry(title, units.per_time(unit, power), values, std)


def with_channels(histories: Histories, stated: ChannelSettings) -> Histories:
    """Add channels at the times of the frames to what probes measure, and the stress where a cross-section is known.

    Parameters
    ----------
    histories
        Of probes, or of none: its frames count.
    stated
        File, clock, and what a stress needs.

    Raises
    ------
    InputError
        As `read_histories`, for the channels.
    """
    if stated.file is None:
        return histories
    times = histories.times
    if times is None:
        raise InputError(
            f"the channels {stated.file} cannot be brought to the frames, whose times are not known: state "
            "frame_rate in [scale]"
        )
    channels, remarks, shifted = Channels.read(stated.file, stated.offset, stated.trigger), list[str](), ""
    if stated.align is not None:
        name, wanted = stated.align
        column = next((one for one in histories.quantities if wanted in (one.name, one.column)), None)
        if column is None:
            known = ", ".join(one.name for one in histories.quantities)
            raise InputError(f'channels.align names the history "{wanted}", which is not one of {known or "none"}')
        channels, std, coefficient = channels.aligned(name, times, column.values)
        shifted = f" ({std:.2g} s standard uncertainty), where {name} and {column.name} correlate by {coefficient:.3f}"
    elif stated.trigger is not None:
        shifted = f": {stated.trigger} rises at 0"
    if shifted:
        remarks.append(f"the times of the channels were shifted by {channels.offset:.6g} s{shifted}")
    elif not stated.offset:
        equal = "the clocks of channels and frames are taken as equal"
        remarks.append(f"{equal}: channels.offset, .trigger or .align relates them")
    first, last = channels.times[[0, -1]]
    covered = float(np.nanmax(times) - np.nanmin(times)) / (last - first)
    if covered < 0.01:  # a factor of 1,000 is far below
        part = f"the frames cover {covered:.2%} of the time of the channels"
        remarks.append(f"{part}: is the unit of {stated.file} right?")
    read = channels.at(times)
    taken = {"frame", "number", "status", "time_s"} | ({"stress", "stress_MPa"} if stated.area is not None else set())
    taken.update(*({one.name, one.column, f"{one.column}_std"} for one in histories.quantities))
    if both := sorted(taken & read.keys()):
        raise InputError(
            f"channels of {stated.file} have the names of columns of the history, rename: {', '.join(both)}"
        )
    beside = [History(name=name, unit="", values=values, std=None) for name, values in read.items()]
    for name, values in read.items():
        if missing := int(np.isnan(values).sum()):
            remarks.append(f"the channel {name} has no value in {missing} of {len(histories.frames)} frames")
    pair = None
    if stated.area is not None:
        name, newtons = channels.force(stated.force)
        beside.append(History(name="stress", unit="MPa", values=read[name] * newtons / stated.area, std=None))
        strain = next((one.name for one in histories.quantities if one.name.endswith(("_strain", "_e1"))), None)
        pair = (strain, "stress") if strain else None
    return replace(
        histories,
        quantities=(*histories.quantities, *beside),
        stress_strain=pair,
        remarks=(*histories.remarks, *remarks),
        channels=channels,
    )


def _remarks(
    physical: Physical, alone: Histories, speed: FloatArray, read: Mapping[str, list[History]]
) -> Iterator[str]:
    units, frames, exposed = alone.units, alone.frames, (physical.result.provenance.get("exposure_ns") or 0) * 1e-9
    if (camera := physical.rectified.camera) is not None:
        yield f"lengths and strains are those on the plane of {camera.name}: {camera.summary()}"
    if units.mm_per_pixel is None:
        yield "no scale is known: lengths are in px (mm_per_pixel in [scale]; `rgbmidic scale` finds it)"
    if not units.timed:
        yield "no time is known: the frame is the unit of time (frame_rate in [scale])"
    blurred = np.nan_to_num(speed) * exposed > 1  # px: the speckle is smeared over a pixel
    if units.timed and blurred.any():
        yield (
            f"motion blur: within the exposure of {exposed:g} s the surface moves by up to "
            f"{np.nanmax(speed) * exposed:.3g} px, by more than 1 px in {int(blurred.sum())} frames from "
            f"frame {frames[blurred][0]} on"
        )
    if any(history.name.endswith("_equivalent") for part in read.values() for history in part):
        yield f"equivalent: {EQUIVALENT}"
    yield from dict.fromkeys(history.note for part in read.values() for history in part if history.note)
    for name, part in read.items():
        if missing := int(np.isnan(part[0].values).sum()):
            yield f"{name} is not measured in {missing} of {len(frames)} frames"
