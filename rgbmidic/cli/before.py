"""The commands of `rgbmidic` before a test: what to expect of it, and what its frames are worth."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from rgbmidic._version import __version__
from rgbmidic.cli import command
from rgbmidic.cli.command import Out, Overwrite, Test, note, print_table, progress_bar
from rgbmidic.errors import InputError

app = typer.Typer()


@app.command()
def demo(out: Annotated[Path, Option(help="Output folder; must be empty or new.")] = Path("rgbmidic-demo")) -> None:
    """Make a small virtual test, calibrate and measure it, and compare the result with the exact truth."""
    note(f"rgbmidic {__version__}: a virtual test is made, calibrated, measured and compared in {out}")
    from rgbmidic._kernels.threads import threads
    from rgbmidic.results import Maps, Result
    from rgbmidic.tools.lab.demo import run_demo, run_plate, write_plate
    from rgbmidic.tools.report import write_figures

    start_time = time.perf_counter()
    with progress_bar("demo") as progress:
        rows = run_demo(out, note, _calibrate_demo, progress)
    note("5 of 7: a flat plate, tilted, behind a lens that distorts, and photographs of a chessboard")
    truth = write_plate(out / "test")
    _calibrate_demo_camera(out / "test")
    note(f"6 of 7: measurement on it: rgbmidic run {out / 'test' / 'plate.toml'}, with [scale] camera = camera.json")
    plate = run_plate(out / "test", truth)
    note(f"7 of 7: pictures of the result in {out / 'figures'}")
    write_figures(Maps.from_result(Result.open(out / "result")), out / "figures", (len(rows),), processes=threads())
    columns = ["angle", "three lights", "red alone", "green alone", "blue alone", "at nodes", "stated u_std"]
    lines = []
    for row in rows:
        errors = (row.rms_px, *row.single_px, row.nodal_px, row.predicted_px)
        lines.append([f"{row.angle_deg:g} deg", *(f"{error:.4f}" for error in errors)])
    title = "Displacement error against the exact truth, px (a sphere turning under moving reflections)"
    print_table(title, columns, lines)
    columns = ["plate", "lens and plane", "one scale", "stated", "strain, lens and plane", "one scale", "stated"]
    lines = []
    for case in plate:
        micrometres = [f"{1e3 * value:.2f}" for value in (*case.displacement_mm, case.stated_mm)]
        lines.append(
            [case.motion, *micrometres, *(f"{1e6 * value:.0f}" for value in (*case.strain, case.stated_strain))]
        )
    title = "Displacement error, um, and strain error, 1e-6, against the exact truth (a flat plate tilted by 5 degrees)"
    print_table(title, columns, lines)
    print(f"pictures: {out / 'figures'}   result: {out / 'result'}   {time.perf_counter() - start_time:.0f} s")


def _calibrate_demo(test: Path) -> None:
    """Calibrate a virtual test from its captures: `rgbmidic-calibrate crosstalk`, `registration` and `merge`."""
    from rgbmidic.settings import FrameSettings
    from rgbmidic_calibration.captures import Captures
    from rgbmidic_calibration.jobs import calibrate_crosstalk, calibrate_registration, merge_files

    lights = {name: str(test / f"light_{name}") for name in ("red", "green", "blue")}
    captures = Captures.find(lights, str(test / "dark"), FrameSettings(path=("captures",)))
    sections = {"crosstalk": calibrate_crosstalk(captures), "registration": calibrate_registration(captures)}
    folder = test / "calibration"
    folder.mkdir()
    for name, (calibration, _) in sections.items():
        calibration.write(folder / f"{name}.json")
    merge_files([folder / f"{name}.json" for name in sections]).write(test / "calibration.json")


def _calibrate_demo_camera(test: Path) -> None:
    """Calibrate lens and plane from the demo's photographs, as `rgbmidic-calibrate camera` computes them."""
    from rgbmidic.settings import FrameSettings
    from rgbmidic_calibration.jobs import calibrate_camera
    from rgbmidic_calibration.target import Target

    frame_settings = FrameSettings(path=("photographs",), kind="monochrome", white_level=65535)
    estimate = calibrate_camera(
        frame_settings,
        Target.parse("chessboard:9x7:5mm"),
        lens=str(test / "target/*.png"),
        plane=str(test / "plane/*.png"),
    )
    estimate.camera.write(test / "camera.json")


@app.command()
def virtual(
    scene: Annotated[Path, Argument(metavar="SCENE.toml", help="Scene to render.")],
    out: Out,
    stereo: Annotated[float | None, Option(metavar="DEG", help="Two cameras, so many degrees apart.")] = None,
) -> None:
    """Render a virtual test: raw frames, calibration captures and the exact truth."""
    from rgbmidic.tools.lab.virtual.dataset import write_dataset, write_stereo_dataset
    from rgbmidic.tools.scene.scene import read_scene

    with progress_bar("rendering") as progress:
        if stereo is None and read_scene(scene).second is None:
            write_dataset(scene, out, progress)
        else:
            write_stereo_dataset(scene, out, stereo, progress)


@app.command()
def plan(
    scene: Annotated[Path, Argument(metavar="SCENE.toml", help="Lamps, camera, paint, specimen and its states.")],
    out: Out,
    distance: Annotated[float | None, Option(metavar="MM", help="Camera to specimen; else the scene's.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Predict where each lamp is reflected, the expected uncertainty, and better positions of the lamps."""
    from rgbmidic.tools.lab import check_folder
    from rgbmidic.tools.lab import planning_report as planning
    from rgbmidic.tools.lab.planning import make_plan, propose_colours, propose_lamps
    from rgbmidic.tools.lab.stereo_planning import STEREO_WORDS, stereo_outlooks, stereo_rows
    from rgbmidic.tools.scene.scene import read_scene

    check_folder(out, planning.FILES, overwrite=overwrite)
    experiment = read_scene(scene)
    lamp_plan = make_plan(experiment)
    stereo = stereo_outlooks(lamp_plan, experiment.second) if experiment.second else []
    motion = planning.out_of_plane_error(lamp_plan, distance)
    proposals = {"colours exchanged": propose_colours(lamp_plan), "lamps moved": propose_lamps(lamp_plan)}
    planning.write_plan(lamp_plan, proposals, out, distance=distance, stereo=stereo, overwrite=overwrite)
    title = "fraction of the field where lights reflect, all of them do, and only one or none is clean"
    print_table(title, *planning.zone_rows(lamp_plan), planning.ZONE_WORDS)
    uncertainty = "standard uncertainty to expect over the field, px"
    print_table(uncertainty, *planning.uncertainty_rows(lamp_plan), planning.UNCERTAINTY_WORDS)
    better = {name: proposal for name, proposal in proposals.items() if proposal.gain > 1}
    for name, lamps in {"lamps as they are": lamp_plan, **better}.items():
        print_table(f"{name}: {planning.summary(lamps)}", *planning.lamp_rows(lamps))
    if not better:
        print("no better place was found for the lamps")
    if stereo:
        title = "two cameras: standard uncertainty to expect in the axes of the mean plane, um, over field and states"
        print_table(title, *stereo_rows(stereo), STEREO_WORDS)
    noise_limit = "" if motion["unseen_mm"] is None else f"; below {motion['unseen_mm']:.2g} mm the noise hides it"
    print(
        f"out-of-plane motion at {motion['stand_off_mm']:g} mm reads as strain, {motion['strain_per_mm']:.2e} per mm:"
    )
    print(f"  {motion['edge_px_per_mm']:.2g} px per mm at the field's edge{noise_limit}")
    print(f"plan: {out / 'plan.json'}   picture: {out / 'plan.png'}")


@app.command()
@command.frame_options
def frames(
    statement: dict[str, Any],
    path: Annotated[str, Argument(metavar="PATH", help="A movie, a frame, a folder or a pattern.")] = "",
    formats: Annotated[bool, Option("--formats", help="List the formats that are read.")] = False,
    json: Annotated[bool, Option("--json", help="Print the list as JSON.")] = False,
    save: Annotated[tuple[int, Path] | None, Option(metavar="N OUT.tif", help="Write frame N as 16-bit TIFF.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """List the properties of raw frames as read: number, size, levels, times, missing frames."""
    from json import dumps

    from rgbmidic.frames import frame_formats
    from rgbmidic.settings import FrameSettings
    from rgbmidic.tools.lab.inspection.frame_files import describe, description_text, save_frame

    if formats:
        for format_ in frame_formats():
            print(f"{format_.name}: {' '.join((*format_.endings, *format_.movies)) or 'by content'}")
        return
    if not path:
        raise InputError("PATH must name a movie, a frame, a folder or a pattern; --formats lists what is read")
    settings = FrameSettings(path=(path,), **statement)
    description = describe(settings)
    if save is not None:
        save_frame(settings, *save, overwrite=overwrite)
    for warning in description["warnings"]:
        note(f"warning: {warning}")
    print(dumps(description, indent=2) if json else description_text(description))


@app.command()
@command.frame_options
def inspect(
    frames: Annotated[
        list[Path],
        Argument(metavar="FRAME...", help="A raw frame; in succession one per light; or TEST.toml: its reference."),
    ],
    statement: dict[str, Any],
    test: Annotated[Path | None, Option(help="TEST.toml of the test.")] = None,
    calibration: Annotated[Path | None, Option(help="Calibration file.")] = None,
    region: Annotated[str, Option(help="x0,y0,x1,y1 in px; else the test's or all.")] = "",
    element_size: Annotated[float | None, Option(help="px; else the test's, or 25.")] = None,
    accept: Annotated[list[str] | None, Option(help="Failing calibration check to accept; else the test's.")] = None,
    out: Annotated[Path | None, Option(help="Folder for inspection.png and inspection.json.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Inspect one frame before a test: lights, reflections, speckle, noise, expected uncertainty."""
    from rgbmidic.settings import read_test
    from rgbmidic.tools.lab import check_folder
    from rgbmidic.tools.lab.inspection import inspect_files, report, state_frames

    if out is not None:
        check_folder(out, report.FILES, overwrite=overwrite)
    if any(path.suffix.lower() == ".toml" for path in frames):
        if test is not None or len(frames) > 1:
            raise InputError("a TEST.toml stands for the frames of its reference: give it alone, or frames and --test")
        test, frames = frames[0], []
    settings = None if test is None else read_test(test)
    with progress_bar("inspecting") as progress:
        inspection = inspect_files(
            frames,
            test=settings,
            calibration=calibration,
            frame=state_frames(settings, count=max(len(frames), 1), **statement),
            region=command.read_coordinates(region, "--region", "X0,Y0,X1,Y1") if region else None,
            element_size=element_size,
            accept=tuple(accept) if accept else None,
            progress=progress,
        )
    if out is not None:
        report.write_inspection(inspection, out, overwrite=overwrite)
    rows, columns = inspection.frame_shape
    print(f"{inspection.name}: {inspection.kind}, {columns} x {rows} px\n")
    print_table("samples in the region, fractions of the full scale", *report.channel_rows(inspection))
    print_table("lights", *report.light_rows(inspection))
    noise_note = "" if inspection.noise_known else " (noise estimated, not calibrated)"
    size = f"elements of {inspection.element_size:g} px"
    print_table(
        f"standard uncertainty of u and v to expect{noise_note}, px, {size}", *report.uncertainty_rows(inspection)
    )
    for finding in inspection.findings:
        print(f"warning: {finding.text}")
    if out is not None:
        print(f"picture: {out / 'inspection.png'}   figures: {out / 'inspection.json'}")


@app.command()
def resolution(
    test: Test,
    sizes: Annotated[str, Option(help="Element sizes in px, such as 10,16,25; else those that suit the speckle.")] = "",
    gauges: Annotated[str, Option(help="Lengths of virtual strain gauges, px; else three elements of each size.")] = "",
    frames: Annotated[str, Option(help="Frames, such as 5,10:20, among which the key frame is; else five.")] = "",
    out: Annotated[Path | None, Option(help="Folder for resolution.csv, .json and .png.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Find the element size of a test: noise, discretisation error and strain resolution of several, on its frames."""
    from rgbmidic.settings import read_test
    from rgbmidic.tools.lab import check_folder
    from rgbmidic.tools.lab import resolution as report
    from rgbmidic.tools.preparation.element_size import study_sizes

    if out is not None:
        check_folder(out, report.FILES, overwrite=overwrite)
    settings = read_test(test)
    frame_indices = command.read_frames(frames) or []
    lengths = command.read_lengths(gauges, "--gauges")
    element_sizes = command.read_lengths(sizes, "--sizes")
    with progress_bar("resolution") as progress:
        study = study_sizes(settings, element_sizes, gauges=lengths or None, frames=frame_indices, progress=progress)
    static = f"{study.static} static frames" if study.static else "no static frames: noise is as stated, not measured"
    print(f"key frame {study.frame}: {study.name}; speckle {study.speckle:.1f} px; {static}\n")
    print_table("elements, rms over the nodes of the key frame", *report.size_rows(study), report.SIZE_WORDS)
    print_table("virtual strain gauges", *report.gauge_rows(study), report.GAUGE_WORDS)
    for size in study.sizes:
        if size.reason:
            note(f"warning: elements of {size.element_size:g} px: {size.reason}")
    if out is not None:
        report.write_study(study, out, overwrite=overwrite)
        print(
            f"table: {out / 'resolution.csv'}   figures: {out / 'resolution.json'}   picture: {out / 'resolution.png'}"
        )
    choice = study.choice
    print("no recommendation: nothing is known of the errors" if choice is None else f"recommended: {choice.reason}")
