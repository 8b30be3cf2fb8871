"""The commands of `rgbmidic` that read fields of a result: histories, profiles, movies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option

from rgbmidic.cli import command
from rgbmidic.cli.result_source import ResultSource, derived_options, result_options
from rgbmidic.errors import InputError, import_optional

app = typer.Typer()

_POSITION_OPTIONS = {
    "points": ("--point", "X,Y", "Displacement of a point."),
    "lines": ("--line", "X0,Y0:X1,Y1", "Mean displacement along a line."),
    "circles": ("--circle", "X,Y:R", "Mean displacement and strain over a circle."),
    "regions": ("--region", "X0,Y0:X1,Y1", "Mean displacement and strain over a rectangle."),
    "gauges": ("--gauge", "X0,Y0:X1,Y1", "Extensometer between two points, deformed state."),
    "straight_gauges": ("--straight-gauge", "X0,Y0:X1,Y1", "Extensometer along the reference line."),
    "strain_gauges": ("--strain-gauge", "X,Y:LENGTH", "Virtual strain gauge."),
    "cracks": ("--crack", "X0,Y0:X1,Y1", "Opening and sliding of a crack of the mesh."),
    "tips": ("--tip", "X,Y:R0,R1", "Stress intensity factors of a crack tip."),
}
"""Keys of ``[probes]`` with the option, the form of a position and the help."""
_TIP_OPTIONS: dict[str, Any] = {
    "youngs_modulus": Annotated[float | None, Option(metavar="MPA", help="For --tip.")],
    "poissons_ratio": Annotated[float | None, Option(help="For --tip.")],
    "plane": Annotated[str | None, Option(help="For --tip: stress or strain.")],
    "terms": Annotated[int | None, Option(help="Highest term of Williams' series; 0: automatic.")],
    "fit_tip": Annotated[bool | None, Option("--fit-tip/--mesh-tip", help="Fit the tip's position along the crack.")],
}
"""Keys of ``[probes]`` that are of a crack's tip."""
_PROBE_OPTIONS: dict[str, Any] = {
    **{
        key: Annotated[list[str] | None, Option(option, metavar=template, help=text)]
        for key, (option, template, text) in _POSITION_OPTIONS.items()
    },
    **_TIP_OPTIONS,
    "measure": command.Measure,
    "window": Annotated[int | None, Option(help="Frames that a rate is taken over, 4 or more; 0: no rates.")],
    "rigid_motion": Annotated[str | None, Option("--rigid", help="Rigid motion: none, tell (report) or remove.")],
}
_CHANNEL_OPTIONS: dict[str, Any] = {
    "file": Annotated[Path | None, Option("--channels", help="CSV file: time_s, then one column per channel.")],
    "offset": Annotated[float | None, Option(metavar="S", help="Time added to the channels, s.")],
    "trigger": Annotated[str | None, Option(help="Channel whose first step is at time 0.")],
    "align": Annotated[str | None, Option(metavar="CHANNEL=COLUMN", help="Offset by correlation with a history.")],
    "area": Annotated[float | None, Option(metavar="MM2", help="Cross-section, to compute a stress.")],
    "force": Annotated[str | None, Option(help="Channel with the force (_N or _kN).")],
}
"""Keys of ``[channels]``."""
_Frames = Annotated[str, Option(help="Only these, such as 0,5,10:200; by default all.")]


def _read_channels(options: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of ``[channels]`` that the options state; of the three clocks only one is kept."""
    keys = {key: value for key, value in options.items() if value is not None}
    if (alignment := keys.get("align")) is not None:
        keys["align"] = tuple(name.strip() for name in alignment.split("="))
        if len(keys["align"]) != 2 or not all(keys["align"]):
            raise InputError(f"--align is CHANNEL=COLUMN, such as force_kN=gauge_1_strain, not {alignment!r}")
    clocks = {"offset": 0.0, "trigger": None, "align": None}
    return (clocks if clocks.keys() & keys else {}) | keys


def _read_probes(options: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of ``[probes]`` that the options state, positions as numbers."""
    positions = {
        key: tuple(command.read_coordinates(text, option, template) for text in options[key] or ())
        for key, (option, template, _) in _POSITION_OPTIONS.items()
    }
    return {key: value for key, value in {**options, **positions}.items() if value is not None}


@app.command()
@result_options
@command.collect_options("probes", _PROBE_OPTIONS, _read_probes)
@command.collect_options("channels", _CHANNEL_OPTIONS, _read_channels)
def history(
    source: ResultSource,
    probes: dict[str, Any],
    channels: dict[str, Any],
    out: Annotated[Path | None, Option(help="CSV file to write; a picture gets its name. Else printed only.")] = None,
    px: command.Pixels = False,
    overwrite: command.Overwrite = False,
) -> None:
    """Write displacement, strain and rates over time at points, over areas, along gauges: table, picture, CSV file.

    Positions are in px on the reference; an option of a position may be given several times.
    """
    from rgbmidic.disk import check_file
    from rgbmidic.results import history_rows, write_histories
    from rgbmidic.results.histories import read_histories
    from rgbmidic.settings import ChannelSettings, ProbeSettings
    from rgbmidic.tools.report import history_figure, save_figure

    for file in (out, command.picture_path(out)) if out else ():
        check_file(file, overwrite=overwrite)
    result, settings = source.result, source.settings
    probe_settings = result.section(ProbeSettings) if settings is None else settings.probes
    if (tip_keys := sorted(_TIP_OPTIONS.keys() & probes.keys())) and not (probes.get("tips") or probe_settings.tips):
        raise InputError(f"--{tip_keys[0].replace('_', '-')} is of a crack's tip, and none is stated: --tip X,Y:R0,R1")
    positions = {key: (*getattr(probe_settings, key), *probes[key]) for key in _POSITION_OPTIONS}
    histories = read_histories(
        result,
        replace(probe_settings, **(probes | positions)),
        scale=source.scale(px=px),
        channels=replace(result.section(ChannelSettings) if settings is None else settings.channels, **channels),
    )
    if out is not None:
        write_histories(histories, out, overwrite=overwrite)
        save_figure(history_figure(histories), command.picture_path(out))
    for remark in histories.remarks:
        command.note(f"note: {remark}")
    command.print_table(f"{len(histories.frames)} frames", *history_rows(histories))
    if out is not None:
        print(f"table: {out}   picture: {command.picture_path(out)}")


@app.command()
@result_options
@derived_options
def profile(
    source: ResultSource,
    line: Annotated[str, Option(metavar="X0,Y0:X1,Y1", help="Ends of the line on the reference, px.")],
    out: Annotated[Path, Option(help="CSV file to write; a picture gets the same name.")],
    derived: dict[str, Any],
    field: Annotated[str, Option(help="One field, such as exx, u or u_velocity.")] = "u",
    frames: _Frames = "",
    curves: Annotated[str, Option(help="Frames drawn as curves, such as 10,20,30.")] = "",
    speed: Annotated[str, Option(metavar="WHAT", help="Fit the speed of a wave: front or peak.")] = "",
    level: Annotated[str, Option(help="Value at which the front is, such as -0.005, or part of the peak; 50%.")] = "",
    overwrite: command.Overwrite = False,
) -> None:
    """Read a field along a line in every frame: table, position-time picture, curves, speed of a front or peak."""
    from rgbmidic.disk import check_file
    from rgbmidic.results import read_profile, write_profile
    from rgbmidic.results.profiles import arrivals_file
    from rgbmidic.tools.report import profile_figure, save_figure, wave_text

    picture, endpoints = command.picture_path(out), command.read_coordinates(line, "--line", "X0,Y0:X1,Y1")
    for file in (out, picture, *([arrivals_file(out)] if speed else [])):
        check_file(file, overwrite=overwrite)
    if level and speed != "front":
        raise InputError("--level is of --speed front, which is not stated")
    field_profile = read_profile(source.maps(derived), field, endpoints, source.frames(frames))
    curve_frames, profile_frames = command.read_frames(curves, "--curves") or [], list(field_profile.frames)
    if absent_frames := [frame for frame in curve_frames if frame not in profile_frames]:
        raise InputError(
            f"--curves {curves}: frames {absent_frames} are not among those read, "
            f"{profile_frames[0]} to {profile_frames[-1]}"
        )
    rows = [profile_frames.index(frame) for frame in dict.fromkeys(curve_frames)]
    wave = field_profile.wave(speed, level or "50%") if speed else None
    write_profile(field_profile, out, wave, overwrite=overwrite)
    save_figure(profile_figure(field_profile, wave, rows), picture)
    if wave is not None:
        print(f"{wave_text(field_profile, wave)}; arrival times: {arrivals_file(out)}")
        if wave.arrivals.cut.any():
            command.note(
                f"note: at {wave.arrivals.cut.sum()} of {len(wave.arrivals.cut)} positions the field still rises in "
                "the last frames: its peak is not known, they are left out; --level takes a value, too, such as -0.005"
            )
        if not wave.front.is_straight:
            command.note(
                "note: the arrival times do not lie on a line within their uncertainty: the wave changes its speed or "
                "form, or the mesh does not follow it; the uncertainty of the speed includes that scatter"
            )
    print(f"table: {out}   picture: {picture}")


@app.command()
@result_options
@derived_options
def movie(
    source: ResultSource,
    out: Annotated[Path, Option(help="File to write: .mp4, .webm or .gif.")],
    derived: dict[str, Any],
    field: Annotated[str, Option(help="Fields side by side, such as u,exx,velocity.")] = "u",
    range_: Annotated[
        str, Option("--range", metavar="LOW:HIGH", help="Range of the colour bars; else that of all frames.")
    ] = "",
    frames: _Frames = "",
    fps: Annotated[float, Option(help="Frames per second of the movie.")] = 15.0,
    over: Annotated[str, Option(help="reference, or frame (the raw frames, deformed).")] = "reference",
    curve: Annotated[Path | None, Option(help="CSV of `rgbmidic history` or channels: a curve with a cursor.")] = None,
    column: Annotated[str | None, Option(help="Column of --curve; by default the first.")] = None,
    offset: Annotated[float, Option(metavar="S", help="Time added to the channels, s.")] = 0.0,
    colours: Annotated[str | None, Option(help="Name of a matplotlib colour map.")] = None,
    opacity: Annotated[float, Option(help="Opacity of the fields over the image, 0 to 1.")] = 1.0,
    width: Annotated[int, Option(help="Width of the movie, px.")] = 1280,
    workers: command.Workers = 0,
    overwrite: command.Overwrite = False,
) -> None:
    """Write a movie of one field or several side by side, over the reference image or the raw frames."""
    from rgbmidic._kernels.threads import threads
    from rgbmidic.tools.report import Curve, FieldMovie, write_movie

    if over not in ("reference", "frame"):
        raise InputError(f"--over is reference or frame, not {over!r}")
    if curve is None and (column is not None or offset):
        raise InputError("--column and --offset are of a --curve FILE, which is not stated")
    field_movie = FieldMovie(
        maps=source.maps(derived),
        fields=tuple(name.strip() for name in field.split(",")),
        frames=source.frames(frames),
        limits=command.read_pair(range_, "--range") if range_ else None,
        images=import_optional("rgbmidic.tools.view.picture", "view").RawPictures(result=source.result)
        if over == "frame"
        else None,
        curve=None if curve is None else Curve.read(curve, column, offset),
        colours=colours,
        opacity=opacity,
        width=width,
    )
    with command.progress_bar("movie") as progress:
        write_movie(field_movie, out, fps=fps, processes=workers or threads(), overwrite=overwrite, progress=progress)
    print(out)
