"""The command `rgbmidic-calibrate`: thin, the science is in the library."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from rgbmidic import command

__all__ = ["app", "main"]

app = typer.Typer(
    name="rgbmidic-calibrate",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Out = Annotated[Path, typer.Option(help="Calibration file to write (JSON).")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing --out.")]
Light = Annotated[list[str], typer.Option(help="NAME=FILES: captures with this light alone on. Once per light.")]
Dark = Annotated[str | None, typer.Option(help="Captures with every lamp off (and the same ambient light).")]
Allow = Annotated[list[str] | None, typer.Option(help="Waive a plausibility check by its name. May be repeated.")]


def main() -> None:
    """Run the command."""
    command.main(app)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    debug: Annotated[bool, typer.Option("--debug", help="Show where an error comes from.")] = False,
) -> None:
    """Calibrate a colour camera and its lamps for rgbmidic. The laboratory procedure: calibration/README.md."""
    command.help_where_alone(context)


@app.command()
@command.gather("statement", command.FRAME_OPTIONS, command.read_statement)
def crosstalk(
    light: Light,
    statement: dict[str, Any],
    out: Out = Path("calibration.json"),
    dark: Dark = None,
    block: Annotated[int, typer.Option(help="Side of the blocks that are averaged, px.")] = 16,
    field: Annotated[
        str, typer.Option(help="Degree by which A varies over the field: 0 to 4, or auto: what the data ask for.")
    ] = "auto",
    allow: Allow = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure how strongly each camera channel sees each light: the matrix A in channels = A . lights."""
    from rgbmidic_calibration import display, jobs
    from rgbmidic_calibration.captures import check_output, named_patterns

    check_output(out, overwrite=overwrite)
    calibration, estimate = jobs.calibrate_crosstalk(
        named_patterns(light, "--light"),
        dark,
        jobs.captures_as_stated(statement),
        block=block,
        order=jobs.field_order(field),
        allow=tuple(allow or ()),
    )
    calibration.write(out)
    display.crosstalk(estimate, out)


@app.command()
@command.gather("statement", command.FRAME_OPTIONS, command.read_statement)
def noise(
    dark: Annotated[str, typer.Option(help="Dark frames, two at least: lens capped, exposure time of the test.")],
    flat: Annotated[
        list[str],
        typer.Option(
            help="Lit frames at rest, two at least per exposure: FILES in one folder per exposure, or TIME=FILES for "
            "one exposure with its time. May be repeated."
        ),
    ],
    statement: dict[str, Any],
    out: Out = Path("noise.json"),
    overwrite: Overwrite = False,
) -> None:
    """Measure gain, read noise, black level, saturation, linearity, fixed pattern and defects of the camera."""
    from rgbmidic_calibration import display, jobs
    from rgbmidic_calibration.captures import check_output

    check_output(out, overwrite=overwrite)
    calibration, estimate = jobs.calibrate_noise(dark, flat, jobs.captures_as_stated(statement))
    calibration.write(out)
    display.noise(estimate, out)


@app.command()
@command.gather("statement", command.FRAME_OPTIONS, command.read_statement)
def registration(
    light: Light,
    statement: dict[str, Any],
    out: Out = Path("registration.json"),
    dark: Dark = None,
    region: Annotated[str | None, typer.Option(help="x0,y0,x1,y1 in px: where the speckled target is.")] = None,
    element_size: Annotated[float, typer.Option(help="Side of the elements, px; several speckles.")] = 25.0,
    overwrite: Overwrite = False,
) -> None:
    """Measure lateral colour: where each light shows a point other than where the first light shows it."""
    from rgbmidic_calibration import display, jobs
    from rgbmidic_calibration.captures import check_output, named_patterns

    check_output(out, overwrite=overwrite)
    calibration, estimate = jobs.calibrate_registration(
        named_patterns(light, "--light"),
        dark,
        jobs.captures_as_stated(statement),
        region=command.read_place(region, "--region", "X0,Y0,X1,Y1") if region else None,
        element_size=element_size,
    )
    calibration.write(out)
    display.registration(estimate, out)


@app.command()
@command.gather("statement", command.FRAME_OPTIONS, command.read_statement)
def check(
    file: Annotated[Path, typer.Argument(help="Calibration file.")],
    light: Light,
    statement: dict[str, Any],
    dark: Dark = None,
    together: Annotated[
        list[str] | None, typer.Option(help="NAME+NAME=FILES: the same scene with these lights on together.")
    ] = None,
    limit: Annotated[
        list[str] | None,
        typer.Option(help="NAME=VALUE: leakage, additivity, strength, noise (in %), registration (in px)."),
    ] = None,
    region: Annotated[str | None, typer.Option(help="x0,y0,x1,y1 in px: where the speckled target is.")] = None,
) -> None:
    """Check a calibration on captures that were not used to make it; exit status 1 where it does not hold."""
    from rgbmidic_calibration import display, jobs
    from rgbmidic_calibration.captures import named_patterns
    from rgbmidic_calibration.verdict import check_calibration, read_limits

    verdict = check_calibration(
        file,
        named_patterns(light, "--light"),
        dark,
        named_patterns(together or (), "--together"),
        jobs.captures_as_stated(statement),
        limits=read_limits(limit or ()),
        region=command.read_place(region, "--region", "X0,Y0,X1,Y1") if region else None,
    )
    display.verdict(verdict)
    if not verdict.passed:
        raise typer.Exit(1)


@app.command()
def design(
    camera: Annotated[
        str,
        typer.Option(help="FILE.json (rawtoaces), FILE.csv, FILE.csv#NAME, or a camera of colour-science."),
    ],
    light: Annotated[
        list[str],
        typer.Option(
            help="NAME=CENTRE:WIDTH (full width at half maximum) in nm, NAME=FILE.csv[#COLUMN], or NAME=source of "
            "colour-science."
        ),
    ],
    choose: Annotated[int, typer.Option(help="Lamps in a set; of more candidates the best sets are found.")] = 3,
    show_sets: Annotated[int, typer.Option("--sets", help="How many of the best sets to list.")] = 5,
    picture: Annotated[Path | None, typer.Option(help="Picture of spectra and matrix of the best set.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Predict crosstalk, condition number and noise from spectra, and find the best set of lamps to buy."""
    from rgbmidic_calibration import design as designs
    from rgbmidic_calibration import display
    from rgbmidic_calibration.captures import check_output, named_patterns

    if picture is not None:
        check_output(picture, overwrite=overwrite, option="--picture")
    lamps = {name: designs.read_lamp(text) for name, text in named_patterns(light, "--light").items()}
    sensitivities = designs.read_camera(camera)
    found = designs.best_sets(sensitivities, lamps, min(choose, len(lamps)))
    display.designs(found[:show_sets])
    if picture is not None:
        designs.draw_design(found[0], sensitivities, lamps, picture)


@app.command()
def merge(
    files: Annotated[list[Path], typer.Argument(help="Calibration files; every section from one of them.")],
    out: Out = Path("calibration.json"),
    overwrite: Overwrite = False,
) -> None:
    """Merge noise, crosstalk and registration from several files into one."""
    from rgbmidic_calibration import display
    from rgbmidic_calibration.captures import check_output
    from rgbmidic_calibration.jobs import merge_files

    check_output(out, overwrite=overwrite)
    calibration = merge_files(files)
    calibration.write(out)
    display.merged(calibration, out)


@app.command()
def show(
    file: Annotated[Path, typer.Argument(help="Calibration file.")],
    picture: Annotated[Path | None, typer.Option(help="Write a picture too (PNG, PDF or SVG).")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Show a calibration file as tables, and in one picture."""
    from rgbmidic.illumination.calibration import Calibration
    from rgbmidic_calibration import display
    from rgbmidic_calibration.captures import check_output

    calibration = Calibration.read(file)
    if picture is not None:
        check_output(picture, overwrite=overwrite, option="--picture")
    display.calibration(calibration, file)
    if picture is not None:
        from rgbmidic_calibration.design import draw_calibration

        draw_calibration(calibration, picture)
