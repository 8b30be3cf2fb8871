"""The command `rgbmidic-calibrate`: thin, the science is in the library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from rgbmidic.cli import command
from rgbmidic.errors import ConfigurationError
from rgbmidic_calibration.options import (
    CAPTURE_OPTIONS,
    PAIR_LIGHTS,
    PAIR_OPTIONS,
    Out,
    Overwrite,
    Region,
    capture_finder,
    check_output,
    read_distance,
    read_frame_settings,
    read_limits,
    read_name_patterns,
    read_pair_lights,
    read_region,
    takes_captures,
    writes_file,
)

if TYPE_CHECKING:
    from rgbmidic_calibration.verify import Limits

app = command.application("rgbmidic-calibrate")


def main() -> None:
    """Run the command."""
    command.main(app)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context, debug: Annotated[bool, Option("--debug", help="Show where an error occurs.")] = False
) -> None:
    """Calibrate a colour camera and its lamps for rgbmidic. The laboratory procedure: calibration/README.md."""
    command.print_help_without_command(context)


@app.command()
@writes_file("out", Out, "calibration.json")
@takes_captures
def crosstalk(
    captures: Any,
    out: Path,
    block: Annotated[int, Option(help="Side of the averaged blocks, px.")] = 16,
    field: Annotated[
        str, Option(help="Degree of the variation of A over the field: 0 to 4, or auto (chosen by a test).")
    ] = "auto",
    allow: Annotated[list[str] | None, Option(help="Waive a plausibility check by its name. May be repeated.")] = None,
) -> None:
    """Measure how strongly each camera channel sees each light: the matrix A in channels = A . lights."""
    from rgbmidic_calibration import display, jobs

    if field != "auto" and not field.isdecimal():
        raise ConfigurationError(f"--field is auto or a degree from 0, not {field!r}")
    order = None if field == "auto" else int(field)
    calibration, estimate = jobs.calibrate_crosstalk(captures(), block=block, order=order, allow=tuple(allow or ()))
    calibration.write(out)
    display.crosstalk(estimate, out)


@app.command()
@writes_file("out", Out, "noise.json")
@command.collect_options("user_metadata", command.FRAME_OPTIONS, read_frame_settings)
def noise(
    dark: Annotated[str, Option(help="Dark frames, at least two: lens capped, exposure time of the test.")],
    flat: Annotated[
        list[str],
        Option(
            help="Lit frames at rest, at least two per exposure: FILES in one folder per exposure, or TIME=FILES for "
            "one exposure with its time. May be repeated."
        ),
    ],
    user_metadata: Any,
    out: Path,
) -> None:
    """Measure gain, read noise, black level, saturation, linearity, fixed pattern and defects of the camera."""
    from rgbmidic_calibration import display, jobs

    calibration, estimate = jobs.calibrate_noise(dark, flat, user_metadata)
    calibration.write(out)
    display.noise(estimate, out)


@app.command()
@writes_file("out", Out, "registration.json")
@takes_captures
def registration(
    captures: Any,
    out: Path,
    region: Region = None,
    element_size: Annotated[
        float | None,
        Option(help="Side of the elements, px: several speckles. Else the smallest of 25 to 120 that match."),
    ] = None,
) -> None:
    """Measure lateral colour: the shift of each light's image relative to that of the first light."""
    from rgbmidic_calibration import display, jobs

    calibration, estimate = jobs.calibrate_registration(
        captures(), region=read_region(region), element_size=element_size
    )
    calibration.write(out)
    display.registration(estimate, out)


@app.command()
@command.collect_options("user_metadata", command.FRAME_OPTIONS, read_frame_settings)
@command.collect_options("target_lights", command.TARGET_LIGHT_OPTIONS, command.read_target_lights)
def camera(
    user_metadata: Any,
    target_lights: Any,
    target: Annotated[
        str | None,
        Option(
            help="KIND:COLUMNSxROWS:SPACINGmm, such as chessboard:9x6:2.5mm (inner corners), circles:9x6:2.5mm, "
            "acircles:4x11:2mm, charuco:8x6:10mm:7.5mm:DICT_5X5_100."
        ),
    ] = None,
    views: Annotated[
        str | None, Option(help="Photographs of the target at different angles, to calibrate the lens.")
    ] = None,
    plane: Annotated[
        str | None, Option(help="Photograph of the target at the position of the specimen's surface.")
    ] = None,
    lens: Annotated[Path | None, Option(help="Earlier camera.json whose lens is used.")] = None,
    corners: Annotated[
        str | None,
        Option(help="Instead of --plane: corners X0,Y0:X1,Y1:X2,Y2:X3,Y3 in px of a rectangle on the specimen."),
    ] = None,
    size: Annotated[str | None, Option(help="WIDTHxHEIGHTmm of that rectangle.")] = None,
    corner_std: Annotated[float, Option(help="Standard uncertainty of such a corner, px.")] = 0.5,
    out: Annotated[Path, Option(help="Camera file to write (JSON).")] = Path("camera.json"),
    picture: Annotated[Path | None, Option(help="Picture of residuals, distortion and scale.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Calibrate lens distortion and the plane of the specimen, from photographs of a target: px to mm."""
    from rgbmidic.fields.plane import CameraCalibration
    from rgbmidic_calibration import display, jobs, pictures
    from rgbmidic_calibration.target import Target

    check_output(out, overwrite=overwrite)
    if picture is not None:
        check_output(picture, overwrite=overwrite, option="--picture")
    if (corners is None) != (size is None):
        raise ConfigurationError("--corners and --size belong together: state both")
    if views is not None and lens is not None:
        raise ConfigurationError("--views calibrate a lens, --lens takes one from a file: state one of them")
    if plane is not None and corners is not None:
        raise ConfigurationError("--plane and --corners both state the plane: state one of them")
    estimate = jobs.calibrate_camera(
        user_metadata,
        None if target is None else Target.parse(target),
        lens=views if lens is None else CameraCalibration.read(lens),
        plane=plane if corners is None or size is None else (corners, size, corner_std),
        lights=target_lights,
    )
    estimate.camera.write(out)
    display.camera(estimate.camera, out)
    if picture is not None:
        pictures.draw_camera(estimate.camera, picture, estimate.residuals)


@app.command()
@writes_file("out", Annotated[Path, Option(help="File of both cameras to write (JSON).")], "stereo.json")
@command.collect_options("lights", PAIR_LIGHTS, read_pair_lights)
@command.collect_options("user_metadata", command.FRAME_OPTIONS, read_frame_settings)
@command.collect_options(
    "views", PAIR_OPTIONS, dict, left=command.REQUIRED, right=command.REQUIRED, target=command.REQUIRED
)
def stereo(views: Any, user_metadata: Any, lights: Any, out: Path) -> None:
    """Calibrate two cameras, lenses and relative pose, from simultaneous photographs of a target."""
    from rgbmidic_calibration import display, jobs
    from rgbmidic_calibration.target import Target

    patterns = views["left"], views["right"]
    estimate = jobs.calibrate_stereo(user_metadata, Target.parse(views["target"]), patterns, lights)
    estimate.pair.write(out)
    display.stereo(estimate.pair, out)


@app.command()
@command.collect_options("captures", CAPTURE_OPTIONS, capture_finder)
@command.collect_options("views", PAIR_OPTIONS, dict)
def check(
    file: Annotated[
        Path, Argument(help="Calibration file; camera file with --distance; file of two cameras with --left, --right.")
    ],
    captures: Any,
    views: Any,
    together: Annotated[
        list[str] | None, Option(help="NAME+NAME=FILES: the same scene with these lights on together.")
    ] = None,
    limit: Annotated[
        list[str] | None,
        Option(help="NAME=VALUE: leakage, checkerboard, additivity, strength, noise, distance (%), registration (px)."),
    ] = None,
    region: Region = None,
    distance: Annotated[
        list[str] | None,
        Option(
            help="X0,Y0:X1,Y1=MM: a known distance on the plane of a camera file, between two places in px. MM: of two "
            "cameras, between the target's farthest points."
        ),
    ] = None,
    corner_std: Annotated[float, Option(help="Standard uncertainty of such a place, px.")] = 0.5,
) -> None:
    """Check a calibration on captures that were not used to make it; exit status 1 if a limit is exceeded."""
    from rgbmidic.fields.plane import CameraCalibration
    from rgbmidic.illumination.calibration import Calibration
    from rgbmidic.tools.stereo import CameraPair
    from rgbmidic_calibration import display
    from rgbmidic_calibration.verify import check_calibration, check_distances

    limits = read_limits(limit or ())
    if CameraPair.is_in(file):
        checks = _check_pair(file, captures, views, distance or (), limits)
    elif any(views.values()):
        raise ConfigurationError(f"--left, --right and --target are for a file of two cameras, and {file} is none")
    elif CameraCalibration.is_in(file):
        true_distances = [read_distance(text) for text in distance or ()]
        if not true_distances:
            raise ConfigurationError(f"{file} is a camera file: state a known distance, --distance X0,Y0:X1,Y1=MM")
        checks = check_distances(CameraCalibration.read(file), true_distances, corner_std=corner_std, limits=limits)
    elif distance:
        raise ConfigurationError(f"--distance is for a camera file (rgbmidic-calibrate camera), and {file} is none")
    else:
        calibration = Calibration.read(file)
        check_captures = captures(
            calibration=calibration, simultaneous=read_name_patterns(together or (), "--together")
        )
        checks = check_calibration(calibration, check_captures, limits=limits, region=read_region(region))
    display.verdict(checks)
    if not all(figure.passed for figure in checks):
        raise typer.Exit(1)


def _check_pair(file: Path, captures: Any, views: Mapping[str, Any], distances: Sequence[str], limits: Limits) -> Any:
    """Return the checks of a file of two cameras on photographs of a target."""
    from rgbmidic.tools.stereo import CameraPair
    from rgbmidic_calibration import jobs
    from rgbmidic_calibration.captures import CaptureFiles
    from rgbmidic_calibration.target import Target
    from rgbmidic_calibration.verify import check_stereo

    if not all(views.values()):
        raise ConfigurationError(
            f"{file} is of two cameras: state photographs of a target, --left, --right and --target"
        )
    if len(distances) > 1 or any("=" in text for text in distances):
        raise ConfigurationError(f"--distance of two cameras is one number in mm, such as 64.03, not {distances[0]!r}")
    try:
        distance = float(distances[0].removesuffix("mm")) if distances else None
    except ValueError:
        raise ConfigurationError(f"--distance of two cameras is a number in mm, not {distances[0]!r}") from None
    patterns = zip(("left", "right"), (views["left"], views["right"]), strict=True)
    settings = captures.args[2]
    left, right = (CaptureFiles.find(role, pattern, settings) for role, pattern in patterns)
    pairs, _ = jobs.find_view_pairs((left, right), Target.parse(views["target"]))
    return check_stereo(CameraPair.read(file), pairs, distance=distance, limits=limits)


@app.command()
@writes_file("picture", Annotated[Path | None, Option(help="Picture of spectra and matrix of the best set.")])
def design(
    camera: Annotated[
        str, Option(help="FILE.json (rawtoaces), FILE.csv, FILE.csv#NAME, or a camera of colour-science.")
    ],
    light: Annotated[
        list[str],
        Option(
            help="NAME=CENTRE:WIDTH (full width at half maximum) in nm, NAME=FILE.csv[#COLUMN], or NAME=source of "
            "colour-science."
        ),
    ],
    choose: Annotated[int, Option(help="Lamps in a set; from more candidates the best sets are selected.")] = 3,
    show_sets: Annotated[int, Option("--sets", help="How many of the best sets to list.")] = 5,
    picture: Path | None = None,
) -> None:
    """Predict crosstalk, condition number and noise from spectra, and find the best set of lamps to buy."""
    from rgbmidic_calibration import design as designs
    from rgbmidic_calibration import display, pictures

    lamps = {name: designs.read_lamp(text) for name, text in read_name_patterns(light, "--light").items()}
    sensitivities = designs.read_camera(camera)
    ranked_sets = designs.best_sets(sensitivities, lamps, min(choose, len(lamps)))
    display.designs(ranked_sets[:show_sets])
    if picture is not None:
        pictures.draw_design(ranked_sets[0], sensitivities, lamps, picture)


@app.command()
@writes_file("out", Out, "calibration.json")
def merge(
    files: Annotated[list[Path], Argument(help="Calibration files; common sections must be equal.")], out: Path
) -> None:
    """Merge noise, crosstalk and registration from several files into one."""
    from rgbmidic_calibration import display
    from rgbmidic_calibration.jobs import merge_files

    calibration = merge_files(files)
    calibration.write(out)
    display.merged(calibration, out)


@app.command()
@writes_file("picture", Annotated[Path | None, Option(help="Write a picture too (PNG, PDF or SVG).")])
def show(file: Annotated[Path, Argument(help="Calibration file.")], picture: Path | None = None) -> None:
    """Show a calibration or camera file as tables, and in one picture."""
    from rgbmidic.fields.plane import CameraCalibration
    from rgbmidic.illumination.calibration import Calibration
    from rgbmidic.tools.stereo import CameraPair
    from rgbmidic_calibration import display, pictures

    if CameraPair.is_in(file):
        display.stereo(CameraPair.read(file), file, is_written=False)
        if picture is not None:
            raise ConfigurationError(f"--picture is for a calibration or camera file; {file} is of two cameras")
        return
    if CameraCalibration.is_in(file):
        camera = CameraCalibration.read(file)
        display.camera(camera, file, is_written=False)
        if picture is not None:
            pictures.draw_camera(camera, picture)
        return
    calibration = Calibration.read(file)
    display.calibration(calibration, file)
    if picture is not None:
        pictures.draw_calibration(calibration, picture)
