"""The commands of `rgbmidic` that draw, export and compare a result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from rgbmidic import command
from rgbmidic.cli_parts import (
    Out,
    Overwrite,
    Partial,
    Reading,
    derived_options,
    note,
    print_table,
    progress_of,
    read_settings,
)
from rgbmidic.errors import InputError
from rgbmidic.extras import optional

app = typer.Typer()


@app.command()
@derived_options
def figures(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    derived: dict[str, Any],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the pictures; by default RESULT/figures.")
    ] = None,
    frames: Annotated[str, typer.Option("--frames", help="Such as 0,5,10:20; by default three frames.")] = "",
    fields: Annotated[
        str, typer.Option("--field", help="Fields to map, with their uncertainty, such as exx,velocity,magnitude.")
    ] = "",
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
        if derived["measure"] is None and settings is not None:
            derived["measure"] = settings.probes.measure
        maps = Maps.of(Result.open(result, partial=partial), None if settings is None else settings.scale, **derived)
        for file in write_maps(maps, [name.strip() for name in fields.split(",")], folder, chosen, hatched=hatch):
            print(file)
        return
    if hatch or test or any(option not in (None, False) for option in derived.values()):
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
