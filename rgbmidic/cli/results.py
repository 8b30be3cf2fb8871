"""The commands of `rgbmidic` that draw, export and compare a result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from rgbmidic.cli import command
from rgbmidic.cli.result_source import ResultSource, derived_options, result_options
from rgbmidic.errors import InputError, import_optional

app = typer.Typer()


@app.command()
@result_options
@derived_options
def figures(
    source: ResultSource,
    derived: dict[str, Any],
    out: Annotated[Path | None, Option(help="Folder for the pictures; by default RESULT/figures.")] = None,
    frames: Annotated[str, Option(help="Such as 0,5,10:20; by default three frames.")] = "",
    field: Annotated[str, Option(help="Fields to map, with their uncertainty, such as exx,velocity,magnitude.")] = "",
    hatch: Annotated[bool, Option("--hatch", help="Hatch values within 2 standard uncertainties of 0.")] = False,
) -> None:
    """Draw a result: maps, masks and reflections of some frames, curves over all frames, or any fields."""
    from rgbmidic._kernels.threads import threads
    from rgbmidic.tools.report import write_figures, write_maps

    frame_indices = command.read_frames(frames)
    folder = out or source.result.path / "figures"
    settings = source.settings
    if derived["measure"] is None and settings is not None:
        derived["measure"] = settings.probes.measure
    maps = source.maps(derived)
    if field:
        files = write_maps(maps, [name.strip() for name in field.split(",")], folder, frame_indices, hatched=hatch)
    elif hatch:
        raise InputError("--hatch needs a --field")
    else:
        files = write_figures(maps, folder, frame_indices, processes=threads())
    for file in files:
        print(file)


@app.command()
@result_options
def export(
    source: ResultSource,
    out: Annotated[Path, Option(help="File to write.")],
    to: Annotated[str, Option(help="Format: npz, csv or hdf5.")] = "npz",
    overwrite: command.Overwrite = False,
) -> None:
    """Write a result for another program: ParaView, MATLAB, xarray, a spreadsheet."""
    from rgbmidic.results import export_result

    export_result(source.result, to, out, scale=source.scale(), overwrite=overwrite)


@app.command()
@result_options
def report(
    source: ResultSource,
    out: Annotated[Path | None, Option(help="HTML file; by default RESULT/report.html.")] = None,
    frames: Annotated[str, Option(help="Frames to show as maps, such as 0,5,10:20.")] = "",
    overwrite: command.Overwrite = False,
) -> None:
    """Write the report of a test: one HTML page that can be printed."""
    from rgbmidic.tools.report import REPORT, write_report

    file, frame_indices = out or source.result.path / REPORT, command.read_frames(frames)
    if not file.suffix:
        file = file.with_name(f"{file.name}.html")
    write_report(source.result, file, settings=source.settings, frames=frame_indices, overwrite=overwrite)
    print(file)


@app.command()
@command.frame_options
def view(
    path: Annotated[
        Path, Argument(metavar="PATH", help="Result, also of a running test; TEST.toml; raw frames; folder of tests.")
    ],
    statement: dict[str, Any],
    port: Annotated[int, Option(min=0, max=65535, help="Port; 0: any free port.")] = 0,
    browser: Annotated[bool, Option("--browser/--no-browser", help="Open the browser.")] = True,
) -> None:
    """Look at a result, or set up a test, in the browser. The address is printed; it is valid on this machine only.

    Ctrl-C ends the server. Options that state properties of frames are for raw frames only.
    """
    serve = import_optional("rgbmidic.tools.view", "view").serve
    serve(
        path, port=port, browser=browser, report_address=lambda address: print(address, flush=True), statement=statement
    )


@app.command()
@result_options
def compare(
    source: ResultSource,
    fe: Annotated[Path, Option(help="Simulation: .vtu, .pvd or a folder of such files, or .csv by node numbers.")],
    out: command.Out,
    mesh: Annotated[Path | None, Option(help="Mesh file with the nodes of a .csv.")] = None,
    points: Annotated[
        list[str] | None, Option(metavar="X_MM,Y_MM:X_PX,Y_PX", help="Mesh point and its pixel; twice or more.")
    ] = None,
    unit: Annotated[str, Option(help="Unit of length of the files: mm, m, um or inch.")] = "mm",
    field: Annotated[str | None, Option(help="Name of the displacement in the files.")] = None,
    interval: Annotated[float | None, Option(metavar="S", help="Time between files with successive numbers.")] = None,
    offset: Annotated[float, Option(metavar="S", help="Time added to the simulation, s.")] = 0.0,
    frames: Annotated[str, Option(help="Such as 0,5,10:20; by default all.")] = "",
    rigid: Annotated[str, Option(help="Rigid motion: tell (report it) or remove.")] = "tell",
    overwrite: command.Overwrite = False,
) -> None:
    """Compare measured and simulated displacement and strain, in mm and in units of the stated uncertainty.

    Page, tables and the fields at the simulation's nodes are written into a folder.
    """
    from rgbmidic.tools.finite_elements import measured_mesh, read_mesh
    from rgbmidic.tools.finite_elements.comparison import Comparison
    from rgbmidic.tools.finite_elements.comparison_page import PAGE, comparison_files, scale_text, write_comparison
    from rgbmidic.tools.finite_elements.simulation import Simulation, find_placement
    from rgbmidic.tools.lab import check_folder

    if rigid not in ("tell", "remove"):
        raise InputError(f'--rigid is tell or remove, not "{rigid}"')
    if mesh is not None and fe.suffix.lower() != ".csv":
        raise InputError(f"--mesh is for a .csv with numbers of nodes; {fe} has a mesh of its own")
    point_pairs = [command.read_coordinates(text, "--points", "X_MM,Y_MM:X_PX,Y_PX") for text in points or ()]
    frame_indices, result, scale = command.read_frames(frames), source.result, source.scale()
    placement = find_placement(result, scale=scale, point_pairs=point_pairs)
    fe_mesh = measured_mesh(result) if mesh is None else read_mesh(mesh, unit=unit)
    simulation = Simulation.read(fe, mesh=fe_mesh, unit=unit, field=field, interval=interval, offset=offset)
    comparison = Comparison(
        result, simulation, placement, scale=scale, frames=frame_indices, remove_rigid=rigid == "remove"
    )
    check_folder(out, comparison_files(comparison), overwrite=overwrite)
    with command.progress_bar("comparing") as progress:
        frame_comparisons = write_comparison(comparison, out, progress)
    command.note(f"placed: {placement.summary()}")
    headings = ["frame", "scale", "uncertainty", "chi-square at nodes", "levelled", "after the scale"]
    rows = []
    for frame_comparison in frame_comparisons:
        squares = [frame_comparison.agreement[variant, "displacement"].chi_square for variant in ("nodes", "levelled")]
        numbers = (
            frame_comparison.fit.scale,
            frame_comparison.fit.scale_std,
            *squares,
            frame_comparison.fit.chi_square,
        )
        rows.append([f"{frame_comparison.frame}", *(f"{number:.4g}" for number in numbers)])
    command.print_table(f"{len(frame_comparisons)} frames against {fe}", headings, rows)
    print(scale_text(comparison, frame_comparisons))
    print(f"page: {out / PAGE}")


@app.command()
@command.collect_options("photographed", command.TARGET_LIGHT_OPTIONS, command.read_target_lights)
def scale(
    points: Annotated[str, Argument(metavar="X0,Y0:X1,Y1", help="Two points with a known distance, px.")],
    length: Annotated[float, Option(metavar="MM", help="Their distance in mm.")],
    length_std: Annotated[float, Option(metavar="MM", help="Its standard uncertainty.")] = 0.0,
    point_std: Annotated[float, Option(metavar="PX", help="Uncertainty of each point, px.")] = 0.5,
    photographed: Any = None,
) -> None:
    """Compute mm per pixel of the first light's image, with its uncertainty, from two points and their distance."""
    from rgbmidic.fields import Units

    x0, y0, x1, y1 = command.read_coordinates(points, "the points", "X0,Y0:X1,Y1")
    endpoints: Any = [[x0, y0], [x1, y1]]
    factor, remark = None, "the image that the points are of; results are in px of the first light's (--light)"
    if photographed is not None:
        endpoints, factor = photographed.on_first_light(endpoints)
        remark = f"the image of light {photographed.first}, from points in that of {' + '.join(photographed.names)}"
    units = Units.from_points(endpoints, length, length_std=length_std, point_std=point_std, factor=factor)
    print(f"# mm per px of {remark}")
    print(f"[scale]\nmm_per_pixel = {units.mm_per_pixel:.6g}\nmm_per_pixel_std = {units.mm_per_pixel_std:.2g}")
