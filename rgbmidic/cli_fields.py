"""The commands of `rgbmidic` that read fields of a result: histories, profiles, movies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rgbmidic import command
from rgbmidic.cli_parts import (
    Measure,
    Overwrite,
    Partial,
    Reading,
    chosen_frames,
    derived_options,
    note,
    print_table,
    progress_of,
    read_settings,
)
from rgbmidic.errors import InputError

if TYPE_CHECKING:
    pass

app = typer.Typer()


_PLACES = {
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
"""Keys of ``[probes]`` with the option, the form of a place and the help."""


_PROBE_OPTIONS: dict[str, Any] = {
    key: Annotated[list[str] | None, typer.Option(option, metavar=form, help=text)]
    for key, (option, form, text) in _PLACES.items()
} | {
    "youngs_modulus": Annotated[float | None, typer.Option("--youngs-modulus", metavar="MPA", help="For --tip.")],
    "poissons_ratio": Annotated[float | None, typer.Option("--poissons-ratio", help="For --tip.")],
    "plane": Annotated[str | None, typer.Option("--plane", help="For --tip: stress or strain.")],
    "terms": Annotated[int | None, typer.Option("--terms", help="Highest term of Williams' series; 0: automatic.")],
    "fit_tip": Annotated[
        bool | None, typer.Option("--fit-tip/--mesh-tip", help="Fit the position of the tip along the crack.")
    ],
    "measure": Measure,
    "window": Annotated[
        int | None, typer.Option("--window", help="Frames that a rate is taken over, 4 or more; 0: no rates.")
    ],
    "rigid_motion": Annotated[str | None, typer.Option("--rigid", help="Rigid motion: none, tell (report) or remove.")],
}


_CHANNEL_OPTIONS: dict[str, Any] = {
    "file": Annotated[Path | None, typer.Option("--channels", help="CSV file: time_s, then one column per channel.")],
    "offset": Annotated[float | None, typer.Option("--offset", metavar="S", help="Time added to the channels, s.")],
    "trigger": Annotated[str | None, typer.Option("--trigger", help="Channel whose first step is at time 0.")],
    "align": Annotated[
        str | None, typer.Option("--align", metavar="CHANNEL=COLUMN", help="Offset by correlation with a history.")
    ],
    "area": Annotated[float | None, typer.Option("--area", metavar="MM2", help="Cross-section, to compute a stress.")],
    "force": Annotated[str | None, typer.Option("--force", help="Channel with the force (_N or _kN).")],
}
"""Keys of ``[channels]``."""


def _read_channels(options: dict[str, Any]) -> dict[str, Any]:
    """The keys of ``[channels]`` that the options state; of the three clocks only one is kept."""
    stated = {key: value for key, value in options.items() if value is not None}
    if (pair := stated.get("align")) is not None:
        stated["align"] = tuple(part.strip() for part in pair.split("="))
        if len(stated["align"]) != 2 or not all(stated["align"]):
            raise InputError(f"--align is CHANNEL=COLUMN, such as force_kN=gauge_1_strain, not {pair!r}")
    clocks = ("offset", "trigger", "align")
    return ({"offset": 0.0, "trigger": None, "align": None} if any(key in stated for key in clocks) else {}) | stated


def _read_probes(options: dict[str, Any]) -> dict[str, Any]:
    """The keys of ``[probes]`` that the options state, the places as numbers."""
    places = {
        key: tuple(command.read_place(text, option, form) for text in options[key] or ())
        for key, (option, form, _) in _PLACES.items()
    }
    return {key: value for key, value in {**options, **places}.items() if value is not None}


@app.command()
@command.gather("probes", _PROBE_OPTIONS, _read_probes)
@command.gather("channels", _CHANNEL_OPTIONS, _read_channels)
def history(
    folder: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    probes: dict[str, Any],
    channels: dict[str, Any],
    out: Annotated[
        Path | None, typer.Option("--out", help="CSV file to write; a picture gets the same name. Else printed only.")
    ] = None,
    test: Reading = None,
    overwrite: Overwrite = False,
    partial: Partial = False,
) -> None:
    """Displacement, strain and rates over time at points, over areas and along gauges: table, picture and CSV file.

    Positions are in px on the reference; an option of a position may be given several times.
    """
    from rgbmidic.report import history_figure, save_figure
    from rgbmidic.results import Result, channels_of, history_rows, probes_of, write_histories
    from rgbmidic.results.files import check_file
    from rgbmidic.results.histories import read_histories

    for file in (out, command.picture_beside(out)) if out else ():
        check_file(file, overwrite=overwrite)
    result = Result.open(folder, partial=partial)
    settings = read_settings(test)
    kept = probes_of(result) if settings is None else settings.probes
    asked = sorted(key for key in ("youngs_modulus", "poissons_ratio", "plane", "terms", "fit_tip") if key in probes)
    if asked and not (probes.get("tips") or kept.tips):
        raise InputError(f"--{asked[0].replace('_', '-')} is of a crack's tip, and none is stated: --tip X,Y:R0,R1")
    stated: dict[str, Any] = {
        key: (*getattr(kept, key), *value) if key in _PLACES else value for key, value in probes.items()
    }
    histories = read_histories(
        result,
        replace(kept, **stated),
        scale=None if settings is None else settings.scale,
        channels=replace(channels_of(result) if settings is None else settings.channels, **channels),
    )
    if out is not None:
        write_histories(histories, out, overwrite=overwrite)
        save_figure(history_figure(histories), command.picture_beside(out))
    for remark in histories.remarks:
        note(f"note: {remark}")
    print_table(f"{len(histories.frames)} frames", *history_rows(histories))
    if out is not None:
        print(f"table: {out}   picture: {command.picture_beside(out)}")


@app.command()
@derived_options
def profile(
    folder: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    line: Annotated[str, typer.Option("--line", metavar="X0,Y0:X1,Y1", help="Ends of the line on the reference, px.")],
    out: Annotated[Path, typer.Option("--out", help="CSV file to write; a picture gets the same name.")],
    derived: dict[str, Any],
    field: Annotated[str, typer.Option("--field", help="One field, such as exx, u or u_velocity.")] = "u",
    frames: Annotated[str, typer.Option("--frames", help="Only these, such as 0,5,10:200; by default all.")] = "",
    curves: Annotated[str, typer.Option("--curves", help="Frames drawn as curves, such as 10,20,30.")] = "",
    speed: Annotated[str, typer.Option("--speed", metavar="WHAT", help="Fit the speed of a wave: front or peak.")] = "",
    level: Annotated[
        float | None, typer.Option("--level", help="Fraction of the peak that defines the front; else 0.5.")
    ] = None,
    test: Reading = None,
    overwrite: Overwrite = False,
    partial: Partial = False,
) -> None:
    """A field along a line in every frame: table, position-time picture, curves, and the speed of a front or peak."""
    from rgbmidic.report import profile_figure, save_figure, wave_text
    from rgbmidic.results import Maps, Result, read_profile, write_profile
    from rgbmidic.results.files import check_file
    from rgbmidic.results.profiles import arrivals_file

    picture, place = command.picture_beside(out), command.read_place(line, "--line", "X0,Y0:X1,Y1")
    for file in (out, picture, *([arrivals_file(out)] if speed else [])):
        check_file(file, overwrite=overwrite)
    if level is not None and speed != "front":
        raise InputError("--level is of --speed front, which is not stated")
    result, settings = Result.open(folder, partial=partial), read_settings(test)
    maps = Maps.of(result, None if settings is None else settings.scale, **derived)
    read = read_profile(maps, field, place, chosen_frames(result, frames))
    shown, there = command.read_frames(curves, "--curves") or [], list(read.frames)
    if beyond := [frame for frame in shown if frame not in there]:
        raise InputError(f"--curves {curves}: frames {beyond} are not among those read, {there[0]} to {there[-1]}")
    rows = [there.index(frame) for frame in dict.fromkeys(shown)]
    wave = read.wave(speed, 0.5 if level is None else level) if speed else None
    write_profile(read, out, wave, overwrite=overwrite)
    save_figure(profile_figure(read, wave, rows), picture)
    if wave is not None:
        print(f"{wave_text(read, wave)}; arrival times: {arrivals_file(out)}")
        if not wave.front.straight:
            note(
                "note: the arrival times do not lie on a line within their uncertainty: the wave changes its speed or "
                "form, or the mesh does not follow it; the uncertainty of the speed includes that scatter"
            )
    print(f"table: {out}   picture: {picture}")


@app.command()
@derived_options
def movie(
    folder: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    out: Annotated[Path, typer.Option("--out", help="File to write: .mp4, .webm or .gif.")],
    derived: dict[str, Any],
    field: Annotated[str, typer.Option("--field", help="Fields side by side, such as u,exx,velocity.")] = "u",
    range_: Annotated[
        str, typer.Option("--range", metavar="LOW:HIGH", help="Range of the colour bars; else that of all frames.")
    ] = "",
    frames: Annotated[str, typer.Option("--frames", help="Only these, such as 0,5,10:200; by default all.")] = "",
    fps: Annotated[float, typer.Option("--fps", help="Frames per second of the movie.")] = 15.0,
    over: Annotated[str, typer.Option("--over", help="reference, or frame (the raw frames, deformed).")] = "reference",
    curve: Annotated[
        Path | None, typer.Option("--curve", help="CSV of `rgbmidic history` or of channels: a curve with a cursor.")
    ] = None,
    column: Annotated[str | None, typer.Option("--column", help="Column of --curve; by default the first.")] = None,
    offset: Annotated[float, typer.Option("--offset", metavar="S", help="Time added to the channels, s.")] = 0.0,
    colours: Annotated[str | None, typer.Option("--colours", help="Name of a matplotlib colour map.")] = None,
    opacity: Annotated[float, typer.Option("--opacity", help="Opacity of the fields over the image, 0 to 1.")] = 1.0,
    width: Annotated[int, typer.Option("--width", help="Width of the movie, px.")] = 1280,
    workers: Annotated[int, typer.Option("--workers", min=0, help="Processes; 0: as many as cores.")] = 0,
    test: Reading = None,
    overwrite: Overwrite = False,
    partial: Partial = False,
) -> None:
    """Write a movie of one field or several side by side, over the reference image or the raw frames."""
    from rgbmidic._kernels.threads import threads
    from rgbmidic.report import Curve, write_movie
    from rgbmidic.results import Maps, Result
    from rgbmidic.view.picture import RawPictures

    result, settings = Result.open(folder, partial=partial), read_settings(test)
    if over not in ("reference", "frame"):
        raise InputError(f"--over is reference or frame, not {over!r}")
    if curve is None and (column is not None or offset):
        raise InputError("--column and --offset are of a --curve FILE, which is not stated")
    with progress_of("movie") as progress:
        write_movie(
            Maps.of(result, None if settings is None else settings.scale, **derived),
            out,
            [name.strip() for name in field.split(",")],
            frames=chosen_frames(result, frames),
            limits=None if not range_ else command.read_pair(range_, "--range"),
            fps=fps,
            images=RawPictures(result=result) if over == "frame" else None,
            curve=None if curve is None else Curve.read(curve, column, offset),
            colours=colours,
            opacity=opacity,
            width=width,
            processes=workers or threads(),
            overwrite=overwrite,
            progress=progress,
        )
    print(out)
