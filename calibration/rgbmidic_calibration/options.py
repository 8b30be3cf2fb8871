"""Options of the command `rgbmidic-calibrate`: their types, and what their values make."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from rgbmidic.cli import command
from rgbmidic.errors import ConfigurationError, InputError

if TYPE_CHECKING:
    from rgbmidic.settings import FrameSettings
    from rgbmidic_calibration.captures import Captures
    from rgbmidic_calibration.verify import Limits

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


def read_frame_settings(options: Mapping[str, Any]) -> FrameSettings:
    """Return the settings of captures as options state them; an option with a value that is not allowed is named."""
    from rgbmidic.settings import FrameSettings

    try:
        return FrameSettings(path=("captures",), **command.read_statement(options))
    except ConfigurationError as error:
        as_options = re.sub(r"frames\.(\w+)", lambda key: "--" + key[1].replace("_", "-"), str(error))
        raise ConfigurationError(as_options) from None


def capture_finder(options: dict[str, Any]) -> partial[Captures]:
    """Return a call that finds the captures which options name."""
    from rgbmidic_calibration.captures import Captures

    lights, dark = read_name_patterns(options.pop("light") or (), "--light"), options.pop("dark")
    return partial(Captures.find, lights, dark, read_frame_settings(options))


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


def read_distance(text: str) -> tuple[tuple[float, ...], float]:
    """Ends (x0, y0, x1, y1) in px and length in mm of ``X0,Y0:X1,Y1=MM``; a `ConfigurationError` for anything else."""
    ends, _, length = text.partition("=")
    try:
        return command.read_coordinates(ends, "--distance", "X0,Y0:X1,Y1"), float(length.removesuffix("mm"))
    except (InputError, ValueError):
        form = "X0,Y0:X1,Y1=MM, such as 120,85:840,85=25"
        raise ConfigurationError(f"--distance is {form}, not {text!r}") from None


def read_region(text: str | None) -> tuple[float, ...] | None:
    """Return the region of the speckled target, px."""
    return command.read_coordinates(text, "--region", "X0,Y0,X1,Y1") if text else None


takes_captures = command.collect_options("captures", CAPTURE_OPTIONS, capture_finder, light=command.REQUIRED)


def writes_file(name: str, hint: Any, default: str | None = None) -> Callable[[Command], Command]:
    """Return the decorator of a command with a file to write, which may replace another only where that is stated."""

    def read(options: Mapping[str, Any]) -> Path | None:
        path: Path | None = options[name]
        if path is not None:
            check_output(path, overwrite=options["overwrite"], option=f"--{name}")
        return path

    defaults = {name: default and Path(default), "overwrite": False}
    return command.collect_options(name, {name: hint, "overwrite": Overwrite}, read, **defaults)


PAIR_OPTIONS: dict[str, Any] = {
    "left": Annotated[str, Option(help="Photographs of the target by the left camera.")],
    "right": Annotated[str, Option(help="Photographs at the same moments by the right camera, in the same order.")],
    "target": Annotated[str, Option(help="KIND:COLUMNSxROWS:SPACINGmm, as of `camera`.")],
}
PAIR_LIGHTS: dict[str, Any] = {
    "light": Annotated[list[str] | None, Option(help="NAME of the light of the photographs; once per light.")],
    "left_calibration": Annotated[
        Path | None, Option(help="Calibration of the left camera, whose registration counts.")
    ],
    "right_calibration": Annotated[Path | None, Option(help="The same of the right camera.")],
}


def read_pair_lights(options: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the lights of the photographs for either camera, see `command.read_target_lights`."""
    files = options["left_calibration"], options["right_calibration"]
    if (files[0] is None) != (files[1] is None):
        raise ConfigurationError("--left-calibration and --right-calibration belong together: state both")
    left, right = (
        command.read_target_lights({"light": options["light"], "calibration": file, "crop_origin": None})
        for file in files
    )
    return left, right
