"""The command `rgbmidic-calibrate`: thin, the science is in the library."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from rgbmidic.cli import command
from rgbmidic.errors import ConfigurationError, InputError

if TYPE_CHECKING:
    from rgbmidic.settings import FrameSettings
    from rgbmidic_calibration.captures import Captures
    from rgbmidic_calibration.verify import Limits

app = command.application("rgbmidic-calibrate")

Out = Annotated[Path, Option(help="Calibration file to write (JSON).")]
Region = Annotated[str | None, Option(help="x0,y0,x1,y1 in px: region of the speckled target.")]
Overwrite = Annotated[bool, Option("--overwrite", help="Replace an existing file.")]
CAPTURE_OPTIONS: dict[str, Any] = {
    "light": Annotated[
        list[str], Option("--light", help="NAME=FILES: captures with only this light on. Once per light.")
    ],
    "dark": Annotated[str | None, Option("--dark", help="Captures with all lamps off (and the same ambient light).")],
    **command.FRAME_OPTIONS,
}

Command = Callable[..., None]


def main() -> None:
    """Run the command."""
    command.main(app)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context, debug: Annotated[bool, Option("--debug", help="Show where an error occurs.")] = False
) -> None:
    """Calibrate a colour camera and its lamps for rgbmidic. The laboratory procedure: calibration/README.md."""
    command.print_help_without_command(context)


def _frame_settings(options: Mapping[str, Any]) -> FrameSettings:
    """Return the settings of captures as options state them; an option with a value that is not allowed is named."""
    from rgbmidic.settings import FrameSettings

    try:
        return FrameSettings(path=("captures",), **command.read_statement(options))
    except ConfigurationError as error:
        as_options = re.sub(r"frames\.(\w+)", lambda key: "--" + key[1].replace("_", "-"), str(error))
        raise ConfigurationError(as_options) from None


def _capture_finder(options: dict[str, Any]) -> partial[Captures]:
    """Return a call that finds the captures which options name."""
    from rgbmidic_calibration.captures import Captures

    lights, dark = read_name_patterns(options.pop("light") or (), "--light"), options.pop("dark")
    return partial(Captures.find, lights, dark, _frame_settings(options))


def read_name_patterns(options: Sequence[str], option: str) -> dict[str, str]:
    """Split options of the form NAME=FILES.

    Raises
    ------
    ConfigurationError
        An option has another form, or a name occurs twice.
    """
    pattern_by_name: dict[str, str] = {}
    for text in options:
        name, separator, pattern = text.partition("=")
        name, pattern = name.strip(), pattern.strip()
        if not (separator and name and pattern):
            raise ConfigurationError(f"{option} takes NAME=FILES, as in {option} red='light_red/*.tif', not {text!r}")
        if name in pattern_by_name:
            raise ConfigurationError(f"{option} {name} is given twice; one pattern may match many files")
        pattern_by_name[name] = pattern
    return pattern_by_name


def check_output(path: Path, *, overwrite: bool, option: str = "--out") -> None:
    """Refuse to write where that would lose something.

    Raises
    ------
    ConfigurationError
        The file exists and may not be overwritten, or its folder does not exist.
    """
    if path.is_dir():
        raise ConfigurationError(f"{option} {path} is a folder; state a file name")
    if path.exists() and not overwrite:
        raise ConfigurationError(f"{path} exists already; choose another {option} or add --overwrite")
    if not path.parent.is_dir():
        raise ConfigurationError(f"the folder of {option} {path} does not exist")


def read_limits(options: Sequence[str]) -> Limits:
    """Return the limits from options of the form NAME=VALUE.

    Raises
    ------
    ConfigurationError
        An unknown name, or a value that is not a positive number.
    """
    from rgbmidic_calibration.verify import LIMITS

    limits, names = LIMITS, [entry.name for entry in fields(LIMITS)]
    for text in options:
        name, _, value = text.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = -1.0
        if name not in names or not number > 0:
            raise ConfigurationError(
                f"--limit takes NAME=VALUE with a positive value and one of the names {', '.join(names)}, not {text!r}"
            )
        limits = replace(limits, **{name: number})
    return limits


def _distance(text: str) -> tuple[tuple[float, ...], float]:
    """Ends (x0, y0, x1, y1) in px and length in mm of ``X0,Y0:X1,Y1=MM``; a `ConfigurationError` for anything else."""
    ends, _, length = text.partition("=")
    try:
        return command.read_coordinates(ends, "--distance", "X0,Y0:X1,Y1"), float(length.removesuffix("mm"))
    except (InputError, ValueError):
        form = "X0,Y0:X1,Y1=MM, such as 120,85:840,85=25"
        raise ConfigurationError(f"--distance is {form}, not {text!r}") from None


def _region(text: str | None) -> tuple[float, ...] | None:
    return command.read_coordinates(text, "--region", "X0,Y0,X1,Y1") if text else None


_takes_captures = command.collect_options("captures", CAPTURE_OPTIONS, _capture_finder, light=command.REQUIRED)


def _writes_file(name: str, hint: Any, default: str | None = None) -> Callable[[Command], Command]:
    """Return the decorator of a command with a file to write, which may replace another only where that is stated."""

    def read(options: Mapping[str, Any]) -> Path | None:
        path: Path | None = options[name]
        if path is not None:
            check_output(path, overwrite=options["overwrite"], option=f"--{name}")
        return path

    defaults = {name: default and Path(default), "overwrite": False}
    return command.collect_options(name, {name: hint, "overwrite": Overwrite}, read, **defaults)


@app.command()
@_writes_file("out", Out, "calibration.json")
@_takes_captures
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
@_writes_file("out", Out, "noise.json")
@command.collect_options("user_metadata", command.FRAME_OPTIONS, _frame_settings)
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
@_writes_file("out", Out, "registration.json")
@_takes_captures
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

    calibration, estimate = jobs.calibrate_registration(captures(), region=_region(region), element_size=element_size)
    calibration.write(out)
    display.registration(estimate, out)


@app.command()
@command.collect_options("user_metadata", command.FRAME_OPTIONS, _frame_settings)
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
    from rgbmidic_calibration import display, jobs
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
        display.draw_camera(estimate.camera, picture, estimate.residuals)


_PAIR_OPTIONS: dict[str, Any] = {
    "left": Annotated[str, Option(help="Photographs of the target by the left camera.")],
    "right": Annotated[str, Option(help="Photographs at the same moments by the right camera, in the same order.")],
    "target": Annotated[str, Option(help="KIND:COLUMNSxROWS:SPACINGmm, as of `camera`.")],
}
_PAIR_LIGHTS: dict[str, Any] = {
    "light": Annotated[list[str] | None, Option(help="NAME of the light of the photographs; once per light.")],
    "left_calibration": Annotated[
        Path | None, Option(help="Calibration of the left camera, whose registration counts.")
    ],
    "right_calibration": Annotated[Path | None, Option(help="The same of the right camera.")],
}


def _read_pair_lights(options: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the lights of the photographs for either camera, see `command.read_target_lights`."""
    files = options["left_calibration"], options["right_calibration"]
    if (files[0] is None) != (files[1] is None):
        raise ConfigurationError("--left-calibration and --right-calibration belong together: state both")
    left, right = (
        command.read_target_lights({"light": options["light"], "calibration": file, "crop_origin": None})
        for file in files
    )
    return left, right


@app.command()
@_writes_file("out", Annotated[Path, Option(help="File of both cameras to write (JSON).")], "stereo.json")
@command.collect_options("lights", _PAIR_LIGHTS, _read_pair_lights)
@command.collect_options("user_metadata", command.FRAME_OPTIONS, _frame_settings)
@command.collect_options(
    "views", _PAIR_OPTIONS, dict, left=command.REQUIRED, right=command.REQUIRED, target=command.REQUIRED
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
@command.collect_options("captures", CAPTURE_OPTIONS, _capture_finder)
@command.collect_options("views", _PAIR_OPTIONS, dict)
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
        true_distances = [_distance(text) for text in distance or ()]
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
        checks = check_calibration(calibration, check_captures, limits=limits, region=_region(region))
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
@_writes_file("picture", Annotated[Path | None, Option(help="Picture of spectra and matrix of the best set.")])
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
    from rgbmidic_calibration import display

    lamps = {name: designs.read_lamp(text) for name, text in read_name_patterns(light, "--light").items()}
    sensitivities = designs.read_camera(camera)
    ranked_sets = designs.best_sets(sensitivities, lamps, min(choose, len(lamps)))
    display.designs(ranked_sets[:show_sets])
    if picture is not None:
        display.draw_design(ranked_sets[0], sensitivities, lamps, picture)


@app.command()
@_writes_file("out", Out, "calibration.json")
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
@_writes_file("picture", Annotated[Path | None, Option(help="Write a picture too (PNG, PDF or SVG).")])
def show(file: Annotated[Path, Argument(help="Calibration file.")], picture: Path | None = None) -> None:
    """Show a calibration or camera file as tables, and in one picture."""
    from rgbmidic.fields.plane import CameraCalibration
    from rgbmidic.illumination.calibration import Calibration
    from rgbmidic.tools.stereo import CameraPair
    from rgbmidic_calibration import display

    if CameraPair.is_in(file):
        display.stereo(CameraPair.read(file), file, is_written=False)
        if picture is not None:
            raise ConfigurationError(f"--picture is for a calibration or camera file; {file} is of two cameras")
        return
    if CameraCalibration.is_in(file):
        camera = CameraCalibration.read(file)
        display.camera(camera, file, is_written=False)
        if picture is not None:
            display.draw_camera(camera, picture)
        return
    calibration = Calibration.read(file)
    display.calibration(calibration, file)
    if picture is not None:
        display.draw_calibration(calibration, picture)
