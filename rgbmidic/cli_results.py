"""The sub-commands of `rgbmidic` that read a result, and what all sub-commands share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from rgbmidic import command
from rgbmidic.errors import InputError
from rgbmidic.extras import optional

if TYPE_CHECKING:
    from rgbmidic.results import Result
    from rgbmidic.settings import TestSettings

app = typer.Typer()

_WIDE = 400
"""Columns that a table may take: where the terminal has fewer it breaks the lines, and nothing is cut off."""


messages = Console(stderr=True)


def note(text: str) -> None:
    """Print a line on stderr as it is, however long."""
    messages.print(text, soft_wrap=True, markup=False, highlight=False)


def read_settings(test: Path | None) -> TestSettings | None:
    """Settings of a TEST.toml, None where none is stated."""
    from rgbmidic.settings import read_test

    return None if test is None else read_test(test)


Out = Annotated[Path, typer.Option("--out", help="Output folder; created if it does not exist.")]


Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")]


Reading = Annotated[
    Path | None,
    typer.Option(
        "--test", help="TEST.toml whose [scale], [setup], [probes] and [channels] replace those of the result."
    ),
]


Partial = Annotated[bool, typer.Option("--partial", help="Use the finished frames of an interrupted run.")]


_PLACES = {
    "points": ("--point", "X,Y", "Displacement of a point."),
    "lines": ("--line", "X0,Y0:X1,Y1", "Mean displacement along a line."),
    "circles": ("--circle", "X,Y:R", "Mean displacement over a circle."),
    "regions": ("--region", "X0,Y0:X1,Y1", "Mean displacement over a rectangle."),
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
    "measure": Annotated[str | None, typer.Option("--measure", help="green-lagrange, hencky, biot or engineering.")],
    "window": Annotated[
        int | None, typer.Option("--window", help="Frames per parabola for rates, 4 or more; 0: no rates.")
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
def figures(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the pictures; by default RESULT/figures.")
    ] = None,
    frames: Annotated[str, typer.Option("--frames", help="Such as 0,5,10:20; by default three frames.")] = "",
    fields: Annotated[
        str, typer.Option("--field", help="Fields to map, with their uncertainty, such as exx,velocity,magnitude.")
    ] = "",
    gauge: Annotated[
        float | None,
        typer.Option("--gauge-length", "--gauge", help="Of the virtual strain gauge, px; by default the shortest."),
    ] = None,
    measure: Annotated[str | None, typer.Option("--measure", help="Strain measure, such as hencky.")] = None,
    since: Annotated[int | None, typer.Option("--since", help="Frame that the fields are relative to.")] = None,
    rigid: Annotated[bool, typer.Option("--remove-rigid", help="Remove rigid shift and rotation.")] = False,
    window: Annotated[int | None, typer.Option("--window", help="Number of frames for rates.")] = None,
    hatch: Annotated[bool, typer.Option("--hatch", help="Hatch values within 2 standard uncertainties of 0.")] = False,
    test: Reading = None,
    partial: Partial = False,
) -> None:
    """Draw a result: maps, masks and reflections of some frames, curves over all frames, or any fields."""
    from rgbmidic._kernels.threads import threads
    from rgbmidic.report import write_figures, write_maps
    from rgbmidic.results import Maps, Result

    chosen, folder, settings = command.read_frames(frames), out or result / "figures", read_settings(test)
    if fields:
        maps = Maps.of(
            Result.open(result, partial=partial), None if settings is None else settings.scale, gauge=gauge,
            measure=measure or (None if settings is None else settings.probes.measure),
            since=since, rigid_removed=rigid, window=window,
        )  # fmt: skip
        for file in write_maps(maps, [name.strip() for name in fields.split(",")], folder, chosen, hatched=hatch):
            print(file)
        return
    if hatch or rigid or test or any(option is not None for option in (gauge, measure, since, window)):
        raise InputError("--gauge, --measure, --since, --remove-rigid, --window, --hatch and --test need a --field")
    for file in write_figures(Result.open(result, partial=partial), folder, chosen, processes=threads()):
        print(file)


@app.command()
def export(
    result: Annotated[Path, typer.Argument(metavar="DIR", help="Result folder that `rgbmidic run` wrote.")],
    out: Annotated[Path, typer.Option("--out", help="File to write; for crackpy a folder.")],
    to: Annotated[str, typer.Option("--to", help="Format: npz, csv, hdf5 or crackpy.")] = "npz",
    test: Reading = None,
    overwrite: Overwrite = False,
    partial: Partial = False,
) -> None:
    """Write a result for another program: ParaView, MATLAB, xarray, a spreadsheet, CrackPy."""
    from rgbmidic.results import Result, export_result

    settings = read_settings(test)
    scale = None if settings is None else settings.scale
    export_result(Result.open(result, partial=partial), to, out, scale=scale, overwrite=overwrite)


@app.command()
def report(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    out: Annotated[Path | None, typer.Option("--out", help="HTML file; by default RESULT/report.html.")] = None,
    test: Reading = None,
    frames: Annotated[str, typer.Option("--frames", help="Frames to show as maps, such as 0,5,10:20.")] = "",
    overwrite: Overwrite = False,
    partial: Partial = False,
) -> None:
    """Write the report of a test: one HTML page that can be printed."""
    from rgbmidic.report import REPORT, write_report
    from rgbmidic.results import Result

    file, chosen, settings = out or result / REPORT, command.read_frames(frames), read_settings(test)
    if not file.suffix:
        file = file.with_name(f"{file.name}.html")
    opened = Result.open(result, partial=partial)
    write_report(opened, file, settings=settings, frames=chosen, overwrite=overwrite)
    print(file)


@app.command()
@command.frame_options
def view(
    path: Annotated[
        Path,
        typer.Argument(metavar="PATH", help="Result, also of a running test; TEST.toml; raw frames; folder of tests."),
    ],
    statement: dict[str, Any],
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port; 0: any free port.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the browser.")] = True,
) -> None:
    """Look at a result, or set up a test, in the browser. The address is printed; it is valid on this machine only.

    Ctrl-C ends the server. Options that state properties of frames are for raw frames only.
    """
    serve = optional("rgbmidic.view", "view").serve
    serve(path, port=port, browser=browser, tell=lambda address: print(address, flush=True), statement=statement)


@app.command()
@command.gather("probes", _PROBE_OPTIONS, _read_probes)
@command.gather("channels", _CHANNEL_OPTIONS, _read_channels)
def history(
    folder: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    out: Annotated[Path, typer.Option("--out", help="CSV file to write; a picture gets the same name.")],
    probes: dict[str, Any],
    channels: dict[str, Any],
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

    picture = command.picture_beside(out)
    for file in (out, picture):
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
    write_histories(histories, out, overwrite=overwrite)
    save_figure(history_figure(histories), picture)
    for remark in histories.remarks:
        note(f"note: {remark}")
    print_table(f"{len(histories.frames)} frames", *history_rows(histories))
    print(f"table: {out}   picture: {picture}")


_DERIVED: dict[str, Any] = {
    "gauge": Annotated[float | None, typer.Option("--gauge-length", "--gauge", help="Virtual strain gauge, px.")],
    "measure": _PROBE_OPTIONS["measure"],
    "since": Annotated[int | None, typer.Option("--since", metavar="N", help="Show the fields relative to frame N.")],
    "rigid_removed": Annotated[bool, typer.Option("--remove-rigid", help="Remove the rigid motion.")],
    "window": Annotated[int | None, typer.Option("--window", help="Frames per parabola for rates, 4 or more.")],
}
"""Options that state how fields are derived, by the keys of `rgbmidic.results.Maps.of`."""


_derived_options = command.gather("derived", _DERIVED, lambda options: options, rigid_removed=False)


def _chosen_frames(result: Result, text: str) -> list[int] | None:
    """The measured ones of the frames that ``--frames`` states; None where it states none."""
    if (asked := command.read_frames(text)) is None:
        return None
    if max(asked) >= len(result):
        raise InputError(f"--frames {text}: {result.path} has frames 0 to {len(result) - 1}")
    chosen = [frame for frame in asked if result.finished[frame]]
    if not chosen:
        raise InputError(f"--frames {text}: none of them is measured; {result.path} has frames 0 to {len(result) - 1}")
    return chosen


@app.command()
@_derived_options
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
            frames=_chosen_frames(result, frames),
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


@app.command()
@_derived_options
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
    read = read_profile(maps, field, place, _chosen_frames(result, frames))
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
def compare(
    folder: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    fe: Annotated[
        Path, typer.Option("--fe", help="Simulation: .vtu, .pvd or a folder of such files, or .csv by node numbers.")
    ],
    out: Out,
    mesh: Annotated[Path | None, typer.Option("--mesh", help="Mesh file with the nodes of a .csv.")] = None,
    points: Annotated[
        list[str] | None,
        typer.Option("--points", metavar="X_MM,Y_MM:X_PX,Y_PX", help="Mesh point and its pixel; twice or more."),
    ] = None,
    unit: Annotated[str, typer.Option("--unit", help="Unit of length of the files: mm, m, um or inch.")] = "mm",
    field: Annotated[str | None, typer.Option("--field", help="Name of the displacement in the files.")] = None,
    interval: Annotated[
        float | None, typer.Option("--interval", metavar="S", help="Time between files with successive numbers.")
    ] = None,
    offset: Annotated[float, typer.Option("--offset", metavar="S", help="Time added to the simulation, s.")] = 0.0,
    frames: Annotated[str, typer.Option("--frames", help="Such as 0,5,10:20; by default all.")] = "",
    rigid: Annotated[str, typer.Option("--rigid", help="Rigid motion: tell (report it) or remove.")] = "tell",
    test: Reading = None,
    overwrite: Overwrite = False,
    partial: Partial = False,
) -> None:
    """Measured minus simulated displacement and strain, in mm and in units of the stated uncertainty.

    Page, tables and the fields at the simulation's nodes are written into a folder.
    """
    from rgbmidic.lab import check_folder
    from rgbmidic.mesh import read_mesh
    from rgbmidic.report.comparison import PAGE, comparison_files, scale_text, write_comparison
    from rgbmidic.results import Result
    from rgbmidic.results.comparison import Comparison, measured_mesh
    from rgbmidic.results.simulation import Simulation, place

    if rigid not in ("tell", "remove"):
        raise InputError(f'--rigid is tell or remove, not "{rigid}"')
    if mesh is not None and fe.suffix.lower() != ".csv":
        raise InputError(f"--mesh is for a .csv with numbers of nodes; {fe} has a mesh of its own")
    form = "X_MM,Y_MM:X_PX,Y_PX"
    pairs = [command.read_place(text, "--points", form) for text in points or ()]
    chosen, settings, result = command.read_frames(frames), read_settings(test), Result.open(folder, partial=partial)
    scale = None if settings is None else settings.scale
    placement = place(result, scale=scale, pairs=pairs)
    numbered = measured_mesh(result) if mesh is None else read_mesh(mesh, unit=unit)
    simulation = Simulation.read(fe, mesh=numbered, unit=unit, field=field, interval=interval, offset=offset)
    comparison = Comparison(result, simulation, placement, scale=scale, frames=chosen, remove_rigid=rigid == "remove")
    check_folder(out, comparison_files(comparison), overwrite=overwrite)
    with progress_of("comparing") as progress:
        done = write_comparison(comparison, out, progress)
    note(f"placed: {placement.summary()}")
    headings = ["frame", "scale", "uncertainty", "chi-square at nodes", "levelled", "after the scale"]
    rows = []
    for made in done:
        squares = [made.agreement[way, "displacement"].chi_square for way in ("nodes", "levelled")]
        numbers = (made.fit.scale, made.fit.scale_std, *squares, made.fit.chi_square)
        rows.append([f"{made.frame}", *(f"{number:.4g}" for number in numbers)])
    print_table(f"{len(done)} frames against {fe}", headings, rows)
    print(scale_text(comparison, done))
    print(f"page: {out / PAGE}")


@app.command()
def scale(
    points: Annotated[str, typer.Argument(metavar="X0,Y0:X1,Y1", help="Two points with a known distance, px.")],
    length: Annotated[float, typer.Option("--length", metavar="MM", help="Their distance in mm.")],
    length_std: Annotated[float, typer.Option("--length-std", metavar="MM", help="Its standard uncertainty.")] = 0.0,
    point_std: Annotated[float, typer.Option("--point-std", metavar="PX", help="Uncertainty of each point, px.")] = 0.5,
) -> None:
    """Millimetres per pixel, with its uncertainty, from two points on an image and their distance."""
    from rgbmidic.fields import Units

    x0, y0, x1, y1 = command.read_place(points, "the points", "X0,Y0:X1,Y1")
    units = Units.from_points([[x0, y0], [x1, y1]], length, length_std=length_std, point_std=point_std)
    print(f"[scale]\nmm_per_pixel = {units.mm_per_pixel:.6g}\nmm_per_pixel_std = {units.mm_per_pixel_std:.2g}")


def print_table(title: str, headings: list[str], rows: list[list[str]], words: Mapping[str, str] | None = None) -> None:
    """Print a table on stdout, and below it what words of its heading mean."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="right" if number else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    print(title)
    Console(soft_wrap=True, width=_WIDE).print(table)
    for heading, meaning in (words or {}).items():
        print(f"  {heading}: {meaning}")
    print()


def progress_of(what: str) -> AbstractContextManager[Callable[[int, int, str], None]]:
    """A bar on stderr for people who watch, see `rgbmidic.timing`."""
    from rgbmidic.progress import progress_bar

    return progress_bar(what, messages)
