"""The command of `rgbmidic` that measures with two cameras."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from typer import Argument, Option

from rgbmidic.cli import command
from rgbmidic.cli.command import Draw, Out, Overwrite, Workers, note, progress_bar
from rgbmidic.errors import InputError

if TYPE_CHECKING:
    from rgbmidic.tools.stereo import StereoResult

app = typer.Typer()


def _read_axes(text: str) -> Any:
    """Return the axes that ``--axes`` states: a word, or three points."""
    if text in ("plane", "camera"):
        return text
    try:
        first, second, third = (command.read_coordinates(point, "--axes", "X,Y") for point in text.split(":"))
    except ValueError:
        form = "plane, camera or three points X,Y:X,Y:X,Y in px of the left reference"
        raise InputError(f"--axes is {form}, not {text!r}") from None
    return first, second, third


@app.command()
def stereo(
    left: Annotated[Path, Argument(metavar="LEFT", help="TEST.toml of the left camera, or its result folder.")],
    right: Annotated[Path, Argument(metavar="RIGHT", help="The same of the right camera.")],
    camera: Annotated[Path, Option(help="Both cameras: the file of rgbmidic-calibrate stereo.")],
    out: Out,
    axes: Annotated[
        str, Option(help="plane (best fit), camera (the left one), or X,Y:X,Y:X,Y px: origin, x axis, side of y.")
    ] = "plane",
    gauge: Annotated[float | None, Option("--gauge-length", "--gauge", help="Virtual strain gauge, px.")] = None,
    measure: command.Measure = None,
    pairing: Annotated[str, Option(help="Pair frames by their times (auto) or by number.")] = "auto",
    overwrite: Overwrite = False,
    resume: Annotated[bool, Option("--resume", help="Continue the interrupted run in DIR.")] = False,
    frames: Annotated[str, Option(help="Only these, such as 1000:2000; when all are measured: --resume.")] = "",
    workers: Workers = 0,
    draw: Draw = False,
) -> None:
    """Measure shape, motion and surface strain in three dimensions with two cameras."""
    from rgbmidic.results import Maps
    from rgbmidic.settings import read_range
    from rgbmidic.tools.stereo import LeftResult, StereoSettings, measure_stereo, measure_stereo_part

    if overwrite and (resume or frames):
        raise InputError("--overwrite begins anew, --resume and --frames go on: state one of them")
    settings = StereoSettings(
        axes=_read_axes(axes),
        gauge=gauge,
        measure=measure or "green-lagrange",
        pairing=cast("Any", pairing),  # checked there
    )
    try:
        with progress_bar("measuring") as progress:
            if frames:
                part = read_range(frames, "--frames")
                measure_stereo_part(
                    left, right, camera, out, part, settings, workers=workers or None, progress=progress
                )
                print(f"frames {frames} are measured; when all are, --resume in place of --frames triangulates them")
                return
            result = measure_stereo(
                left,
                right,
                camera,
                out,
                settings,
                overwrite=overwrite,
                resume=resume,
                workers=workers or None,
                progress=progress,
            )
    except KeyboardInterrupt:
        note("what was finished is kept: run the same command again with --resume")
        raise
    if draw:
        from rgbmidic.tools.report import write_maps

        names = ["z", "u", "v", "w", "e1", "e2", "epipolar_common", "epipolar_change"]
        write_maps(Maps.from_result(LeftResult.of(result)), names, out / "figures", [len(result) - 1])
    _print_summary(result)


def _print_summary(result: StereoResult) -> None:
    """Print how many nodes are measured in the last frame, what is stated of them, and the epipolar residual."""
    import numpy as np

    measured = np.isfinite(result["w"])
    stds = [float(np.nanmedian(result[f"{name}_std"][-1])) if measured[-1].any() else np.nan for name in "uvw"]
    change, scale_std = result["epipolar_change"][-1], float(result.attributes["relative_length_std"])
    rows = {
        "frames": f"{len(result)}",
        "nodes": f"{measured.shape[1]}, {measured.mean():.1%} measured",
        "axes": str(result.attributes["axes"]),
        "shape": f"z from {result['z'].min():.4g} to {result['z'].max():.4g} mm, known to "
        f"{np.median(result['z_std']):.2g} mm",
        "motion": "u, v, w of the last frame are known to " + ", ".join(f"{std:.2g}" for std in stds) + " mm (median)",
        "epipolar": f"residual {np.sqrt(np.mean(result['epipolar_common'] ** 2)):.3g} px rms common to all frames, "
        f"{np.sqrt(np.nanmean(change**2)) if measured[-1].any() else np.nan:.3g} px more in the last one",
        "lengths": f"known to {100 * scale_std:.2g} % by the calibration" if scale_std else "exact by the calibration",
        "result": str(result.path),
    }
    width = max(map(len, rows)) + 2
    for name, text in rows.items():
        print(f"{name:<{width}}{text}")
