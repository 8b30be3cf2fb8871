"""The command `rgbmidic`: thin; each sub-command calls one function of the library, imported when it is called."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from rgbmidic import command
from rgbmidic._version import __version__
from rgbmidic.errors import InputError

if TYPE_CHECKING:
    from rgbmidic.results import Result
    from rgbmidic.settings import TestSettings

__all__ = ["app", "main"]

_WIDE = 400
"""Columns that a table may take: where the terminal has fewer it breaks the lines, and nothing is cut off."""
_CONVERGED, _UNCONVERGED, _FAILED = 0, 1, 2
_TOO_MANY = 0.5
"""Fraction of the deformed frames beyond which those that failed or did not converge make a run a failure: a specimen
that breaks or leaves the picture halfway through is an ordinary test, a run that measures few of its frames is not."""

app = typer.Typer(name="rgbmidic", add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
_messages = Console(stderr=True)


def _note(text: str) -> None:
    """Print a line on stderr as it is, however long."""
    _messages.print(text, soft_wrap=True, markup=False, highlight=False)


def _settings(test: Path | None) -> TestSettings | None:
    from rgbmidic.settings import read_test

    return None if test is None else read_test(test)


Out = Annotated[Path, typer.Option("--out", help="Folder for what is written; made where it does not exist.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is already there.")]
Reading = Annotated[
    Path | None,
    typer.Option(
        "--test", help="TEST.toml whose [scale], [setup], [probes] and [channels] count instead of those kept."
    ),
]
Partial = Annotated[bool, typer.Option("--partial", help="Take what an interrupted run has finished.")]

_PLACES = {
    "points": ("--point", "X,Y", "Displacement there."),
    "lines": ("--line", "X0,Y0:X1,Y1", "Mean displacement along it."),
    "circles": ("--circle", "X,Y:R", "Mean displacement over it."),
    "regions": ("--region", "X0,Y0:X1,Y1", "Mean displacement over it."),
    "gauges": ("--gauge", "X0,Y0:X1,Y1", "Between two points that move."),
    "straight_gauges": ("--straight-gauge", "X0,Y0:X1,Y1", "Along the line as it was."),
    "strain_gauges": ("--strain-gauge", "X,Y:LENGTH", "Virtual strain gauge."),
    "cracks": ("--crack", "X0,Y0:X1,Y1", "Jump along a crack of the mesh."),
    "tips": ("--tip", "X,Y:R0,R1", "Stress intensity at a crack's tip."),
}
"""Keys of ``[probes]`` with the option, the form of a place and the help."""
_PROBE_OPTIONS: dict[str, Any] = {
    key: Annotated[list[str] | None, typer.Option(option, metavar=form, help=text)]
    for key, (option, form, text) in _PLACES.items()
} | {
    "youngs_modulus": Annotated[float | None, typer.Option("--youngs-modulus", metavar="MPA", help="For --tip.")],
    "poissons_ratio": Annotated[float | None, typer.Option("--poissons-ratio", help="For --tip.")],
    "plane": Annotated[str | None, typer.Option("--plane", help="For --tip: stress or strain.")],
    "terms": Annotated[int | None, typer.Option("--terms", help="Highest term of Williams' series; 0: by a test.")],
    "fit_tip": Annotated[
        bool | None, typer.Option("--fit-tip/--mesh-tip", help="Fit the tip's place along the crack.")
    ],
    "measure": Annotated[str | None, typer.Option("--measure", help="green-lagrange, hencky, biot or engineering.")],
    "window": Annotated[
        int | None, typer.Option("--window", help="Frames of a parabola, for rates, 4 or more; 0: no rates.")
    ],
    "rigid_motion": Annotated[str | None, typer.Option("--rigid", help="Motion as a whole: none, tell or remove.")],
}


_CHANNEL_OPTIONS: dict[str, Any] = {
    "file": Annotated[Path | None, typer.Option("--channels", help="CSV file: time_s, then a column each.")],
    "offset": Annotated[float | None, typer.Option("--offset", metavar="S", help="Added to the channels' times, s.")],
    "trigger": Annotated[str | None, typer.Option("--trigger", help="Channel whose first step is the time 0.")],
    "align": Annotated[
        str | None, typer.Option("--align", metavar="CHANNEL=COLUMN", help="Offset by correlation with a history.")
    ],
    "area": Annotated[float | None, typer.Option("--area", metavar="MM2", help="Cross-section, for a stress.")],
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


def main() -> None:
    """Run the command."""
    command.main(app)


@app.callback(invoke_without_command=True)
def _rgbmidic(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show where an error comes from.")] = False,
) -> None:
    """Digital Image Correlation that survives light reflections."""
    if version:
        print(f"rgbmidic {__version__}")
    else:
        command.help_where_alone(context)


@app.command()
def run(
    test: Annotated[Path, typer.Argument(metavar="TEST.toml", help="Settings of the test.")],
    out: Out,
    overwrite: Overwrite = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the interrupted run in DIR.")] = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="With --resume: measure all frames again that failed.")
    ] = False,
    frames: Annotated[
        str, typer.Option("--frames", help="Only these, such as 1000:2000; then `rgbmidic finish`.")
    ] = "",
    workers: Annotated[int, typer.Option("--workers", min=0, help="Processes; 0: as many as cores.")] = 0,
    scheduler: Annotated[str | None, typer.Option("--scheduler", help="Address of a Dask scheduler.")] = None,
    timings: Annotated[bool, typer.Option("--timings", help="Keep and print the time of each stage.")] = False,
    draw: Annotated[bool, typer.Option("--figures/--no-figures", help="Write pictures into DIR/figures.")] = True,
) -> None:
    """Measure a test: from raw frames to one displacement field per frame."""
    from rgbmidic.pipeline import measure
    from rgbmidic.settings import read_range, read_test

    started = time.perf_counter()
    settings = read_test(test)
    chosen = read_range(frames, "--frames") if frames else None
    if overwrite and (resume or frames):
        raise InputError("--overwrite begins anew, --resume and --frames go on: state one of them")
    _explain_first_run()
    with _progress("measuring") as progress, _continuation_hint(test, out, frames, resume=resume):
        result = measure(
            settings,
            out,
            overwrite=overwrite,
            resume=resume,
            retry_failed=retry_failed,
            frames=chosen,
            workers=workers or None,
            scheduler=scheduler,
            timings=timings,
            progress=progress,
        )
    if chosen is None:
        _conclude(result, started, draw=draw, processes=workers)
    else:
        print(f"frames {frames} are measured; when all frames are: rgbmidic finish {out}")


@app.command()
def batch(
    tests: Annotated[
        list[Path], typer.Argument(metavar="TEST.toml...", help="Settings of the tests; one with --table.")
    ],
    out: Out,
    table: Annotated[
        Path | None, typer.Option("--table", help="CSV: a column test, and keys of TEST.toml that its values replace.")
    ] = None,
    elastic: Annotated[
        str, typer.Option("--elastic", metavar="LOW:HIGH", help="Strains between which a modulus is fitted.")
    ] = "0.0005:0.0025",
    workers: Annotated[int, typer.Option("--workers", min=0, help="Processes; 0: as many as cores.")] = 0,
    reports: Annotated[bool, typer.Option("--reports/--no-reports", help="Write a report of each test.")] = True,
) -> None:
    """Measure a series of tests, each into DIR/NAME, with one summary table and page.

    A test that fails does not stop the rest; one that is measured already with the same settings is not measured again.
    """
    from rgbmidic.pipeline import batch as series
    from rgbmidic.report import REPORT, write_batch_page, write_report
    from rgbmidic.results.files import writing

    if table is not None and len(tests) != 1:
        raise InputError(f"--table goes with one TEST.toml, the template, not with {len(tests)}")
    chosen = series.read_tests(tests) if table is None else series.read_table(tests[0], table)
    limits = command.read_pair(elastic, "--elastic")
    if not 0 <= limits[0] < limits[1]:
        raise InputError(f"--elastic is a smaller and a larger strain, not {elastic}")
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)

    def conclude(result: Result, settings: TestSettings, measured: bool) -> None:
        if reports and (measured or not (result.path / REPORT).is_file()):
            write_report(result, result.path / REPORT, settings=settings, overwrite=True)

    _explain_first_run()
    outcomes = []
    with _progress("batch") as progress:
        for outcome in series.run_batch(
            chosen, out, workers=workers or None, elastic=limits, conclude=conclude, progress=lambda name: progress
        ):
            outcomes.append(outcome)
            series.write_summary(outcomes, out / "summary.csv")
            write_batch_page(*series.summary_rows(outcomes), out / "summary.html")
            _note(f"{outcome.name}: {outcome.reason or ('measured' if outcome.measured else 'measured before')}")
    print(f"table: {out / 'summary.csv'}   page: {out / 'summary.html'}")
    if failed := [outcome.name for outcome in outcomes if outcome.reason]:
        raise typer.Exit(
            command.fail(f"{len(failed)} of {len(outcomes)} tests failed: {', '.join(failed)}", command.FAILURE)
        )


@app.command()
def finish(
    result: Annotated[Path, typer.Argument(metavar="DIR", help="Result folder that runs with --frames have filled.")],
    draw: Annotated[bool, typer.Option("--figures/--no-figures", help="Write pictures into DIR/figures.")] = True,
) -> None:
    """End a result that was measured in parts: check that no frame is missing, and draw it."""
    from rgbmidic.results import Result, finish_result

    started = time.perf_counter()
    finish_result(result)
    _conclude(Result.open(result), started, draw=draw)


def _conclude(result: Result, started: float, *, draw: bool, processes: int = 0) -> None:
    """Draw a finished result and print how its frames ended.

    The drawing takes as many processes as cores if none are asked for; the command fails where more than `_TOO_MANY`
    of the frames failed or did not converge.
    """
    from rgbmidic._kernels.threads import threads
    from rgbmidic.report import remove_figures, remove_report, write_figures

    remove_figures(result.path / "figures")
    remove_report(result.path)
    if draw:
        write_figures(result, result.path / "figures", processes=processes or threads())
    _print_summary(result, time.perf_counter() - started)
    failed = [index for index in result.deformed if result.status[index] != _CONVERGED]
    if unread := int(result.unread.sum()):
        _note(f"note: frames that could not be read: {unread}; --resume tries them again")
    if len(failed) > _TOO_MANY * len(result.deformed) or not result.deformed:
        first = f"the first, {result.names[failed[0]]}: {result.frame(failed[0]).reason}" if failed else "there is none"
        count = f"{len(failed)} of {len(result.deformed)} deformed frames failed or did not converge"
        raise typer.Exit(command.fail(f"{count}; {first}", command.FAILURE))


@contextmanager
def _continuation_hint(test: Path, out: Path, frames: str, *, resume: bool) -> Iterator[None]:
    """Print how to go on when the run is interrupted, by Ctrl-C or by SIGTERM, if anything was begun."""
    from rgbmidic.results.provenance import PROVENANCE

    def begun() -> bytes:
        return file.read_bytes() if (file := out / PROVENANCE).is_file() else b""

    before_it = begun()
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C, which a background job ignores
    try:
        yield
    except KeyboardInterrupt:
        if frames or resume or begun() != before_it:
            part = f"--frames {frames}" if frames else "--resume"
            _note(f"go on with: rgbmidic run {test} --out {out} {part}")
        else:
            _note("nothing was begun: run the same command again")
        raise
    finally:
        signal.signal(signal.SIGTERM, before)


@app.command()
def figures(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the pictures; by default RESULT/figures.")
    ] = None,
    frames: Annotated[str, typer.Option("--frames", help="Indices such as 0,5,10; by default three frames.")] = "",
    fields: Annotated[
        str, typer.Option("--field", help="Fields to map, with their uncertainty, such as exx,velocity,magnitude.")
    ] = "",
    gauge: Annotated[
        float | None,
        typer.Option("--gauge", help="Length of the virtual strain gauge in px; by default the shortest."),
    ] = None,
    measure: Annotated[str | None, typer.Option("--measure", help="Strain measure, such as hencky.")] = None,
    since: Annotated[int | None, typer.Option("--since", help="Frame that displacement and strain count from.")] = None,
    rigid: Annotated[bool, typer.Option("--remove-rigid", help="Remove shift and rotation of the whole.")] = False,
    window: Annotated[int | None, typer.Option("--window", help="Frames that rates are taken over.")] = None,
    hatch: Annotated[bool, typer.Option("--hatch", help="Hatch what is within 2 standard uncertainties of 0.")] = False,
    test: Reading = None,
    partial: Partial = False,
) -> None:
    """Draw a result: maps, masks and reflections of some frames, and what happened over all of them; or any fields."""
    from rgbmidic._kernels.threads import threads
    from rgbmidic.report import write_figures, write_maps
    from rgbmidic.results import Maps, Result

    chosen, folder, settings = _frames(frames), out or result / "figures", _settings(test)
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
    out: Annotated[Path, typer.Option("--out", help="File to write; of crackpy a folder.")],
    to: Annotated[str, typer.Option("--to", help="Format: npz, csv, hdf5 or crackpy.")] = "npz",
    test: Reading = None,
    overwrite: Overwrite = False,
    partial: Partial = False,
) -> None:
    """Write a result for another program: ParaView, MATLAB, xarray, a spreadsheet, CrackPy."""
    from rgbmidic.results import Result, export_result

    settings = _settings(test)
    scale = None if settings is None else settings.scale
    export_result(Result.open(result, partial=partial), to, out, scale=scale, overwrite=overwrite)


@app.command()
def report(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    out: Annotated[Path | None, typer.Option("--out", help="HTML file; by default RESULT/report.html.")] = None,
    test: Reading = None,
    frames: Annotated[str, typer.Option("--frames", help="Indices such as 0,5,10, of which maps are shown.")] = "",
    overwrite: Overwrite = False,
    partial: Partial = False,
) -> None:
    """Write the report of a test: one HTML page, to be read in any browser and printed."""
    from rgbmidic.report import REPORT, write_report
    from rgbmidic.results import Result

    file, chosen, settings = out or result / REPORT, _frames(frames), _settings(test)
    opened = Result.open(result, partial=partial)
    write_report(opened, file, settings=settings, frames=chosen, overwrite=overwrite)
    print(file)


@app.command()
def view(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="PATH", help="Result, also one that still grows; TEST.toml; raw frames; folder of tests."
        ),
    ],
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0: any that is free.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the browser.")] = True,
) -> None:
    """Look at a result, or set a test up, in the browser: the address is printed, only this machine is served.

    Ctrl-C ends it.
    """
    serve = command.optional("rgbmidic.view", "view").serve
    serve(path, port=port, browser=browser, tell=lambda address: print(address, flush=True))


@app.command()
@command.gather("probes", _PROBE_OPTIONS, _read_probes)
@command.gather("channels", _CHANNEL_OPTIONS, _read_channels)
def history(
    folder: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    out: Annotated[Path, typer.Option("--out", help="CSV file to write; a picture of the same name lies beside it.")],
    probes: dict[str, Any],
    channels: dict[str, Any],
    test: Reading = None,
    overwrite: Overwrite = False,
    partial: Partial = False,
) -> None:
    """Displacement, strain and rates over time at points, over areas and along gauges: table, picture and CSV file.

    Places are in px on the reference; the option of a place may be given several times.
    """
    from rgbmidic.report import history_figure, save_figure
    from rgbmidic.results import Result, channels_of, history_rows, probes_of, write_histories
    from rgbmidic.results.files import check_file
    from rgbmidic.results.histories import read_histories

    picture = out.with_suffix(".png")
    for file in (out, picture):
        check_file(file, overwrite=overwrite)
    result = Result.open(folder, partial=partial)
    settings = _settings(test)
    kept = probes_of(result) if settings is None else settings.probes
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
        _note(f"note: {remark}")
    _print_table(f"{len(histories.frames)} frames", *history_rows(histories))
    print(f"table: {out}   picture: {picture}")


_DERIVED: dict[str, Any] = {
    "gauge": Annotated[float | None, typer.Option("--gauge", metavar="PX", help="Virtual strain gauge length, px.")],
    "measure": _PROBE_OPTIONS["measure"],
    "since": Annotated[int | None, typer.Option("--since", metavar="N", help="Displacement and strain since frame N.")],
    "rigid_removed": Annotated[bool, typer.Option("--rigid-removed", help="Remove the motion as a whole.")],
    "window": Annotated[int | None, typer.Option("--window", help="Frames of a parabola, for rates, 4 or more.")],
}
"""Options that state how fields are derived, by the keys of `rgbmidic.results.Maps.of`."""
_derived_options = command.gather("derived", _DERIVED, lambda options: options, rigid_removed=False)


def _chosen_frames(result: Result, text: str) -> list[int] | None:
    """The measured frames of a range that ``--frames`` states; None where it states none."""
    from rgbmidic.settings import read_range

    if not text:
        return None
    chosen = [frame for frame in read_range(text, "--frames") if frame < len(result) and result.finished[frame]]
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
        str, typer.Option("--range", metavar="LOW:HIGH", help="Ends of the colour bars; else those of all frames.")
    ] = "",
    frames: Annotated[str, typer.Option("--frames", help="Only these, such as 10:200; by default all.")] = "",
    fps: Annotated[float, typer.Option("--fps", help="Frames per second of the movie.")] = 15.0,
    over: Annotated[str, typer.Option("--over", help="reference, or frame: the raw frames, deformed.")] = "reference",
    curve: Annotated[
        Path | None, typer.Option("--curve", help="CSV of `rgbmidic history` or of channels: a curve with a cursor.")
    ] = None,
    column: Annotated[str | None, typer.Option("--column", help="Column of --curve; by default the first.")] = None,
    offset: Annotated[float, typer.Option("--offset", metavar="S", help="Added to the channels' times, s.")] = 0.0,
    colours: Annotated[str | None, typer.Option("--colours", help="matplotlib's name of the colours.")] = None,
    opacity: Annotated[float, typer.Option("--opacity", help="Of the fields over the image, 0 to 1.")] = 1.0,
    width: Annotated[int, typer.Option("--width", help="Of the movie, px.")] = 1280,
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

    result, settings = Result.open(folder, partial=partial), _settings(test)
    if over not in ("reference", "frame"):
        raise InputError(f"--over is reference or frame, not {over!r}")
    with _progress("movie") as progress:
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
    out: Annotated[Path, typer.Option("--out", help="CSV file to write; a picture of the same name lies beside it.")],
    derived: dict[str, Any],
    field: Annotated[str, typer.Option("--field", help="One field, such as exx, u or u_velocity.")] = "u",
    frames: Annotated[str, typer.Option("--frames", help="Only these, such as 10:200; by default all.")] = "",
    curves: Annotated[str, typer.Option("--curves", help="Frames drawn as curves, such as 10,20,30.")] = "",
    speed: Annotated[
        str, typer.Option("--speed", metavar="WHAT", help="Fit the speed of the front, or of the peak.")
    ] = "",
    level: Annotated[float, typer.Option("--level", help="Fraction of the peak at which the front is taken.")] = 0.5,
    test: Reading = None,
    overwrite: Overwrite = False,
    partial: Partial = False,
) -> None:
    """A field along a line in every frame: table, position-time picture, curves, and the speed of a front or peak."""
    from rgbmidic.report import profile_figure, save_figure, wave_text
    from rgbmidic.results import Maps, Result, read_profile, write_profile
    from rgbmidic.results.files import check_file
    from rgbmidic.results.histories import arrivals_file

    picture, place = out.with_suffix(".png"), command.read_place(line, "--line", "X0,Y0:X1,Y1")
    for file in (out, picture, *([arrivals_file(out)] if speed else [])):
        check_file(file, overwrite=overwrite)
    result, settings = Result.open(folder, partial=partial), _settings(test)
    maps = Maps.of(result, None if settings is None else settings.scale, **derived)
    read = read_profile(maps, field, place, _chosen_frames(result, frames))
    rows = [list(read.frames).index(frame) for frame in _frames(curves) or [] if frame in read.frames]
    wave = read.wave(speed, level) if speed else None
    write_profile(read, out, wave, overwrite=overwrite)
    save_figure(profile_figure(read, wave, rows), picture)
    if wave is not None:
        print(f"{wave_text(read, wave)}; arrival times: {arrivals_file(out)}")
        if not wave.front.straight:
            _note(
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
    mesh: Annotated[Path | None, typer.Option("--mesh", help="Mesh file of the nodes of a .csv.")] = None,
    points: Annotated[
        list[str] | None,
        typer.Option("--points", metavar="X_MM,Y_MM:X_PX,Y_PX", help="Where a point of the mesh lies; twice or more."),
    ] = None,
    unit: Annotated[str, typer.Option("--unit", help="Of length in these files: mm, m, um or inch.")] = "mm",
    field: Annotated[str | None, typer.Option("--field", help="Name of the displacement in the files.")] = None,
    interval: Annotated[
        float | None, typer.Option("--interval", metavar="S", help="Time between the numbers of a folder's files.")
    ] = None,
    offset: Annotated[float, typer.Option("--offset", metavar="S", help="Added to the simulation's times.")] = 0.0,
    frames: Annotated[str, typer.Option("--frames", help="Indices such as 0,5,10; by default all.")] = "",
    rigid: Annotated[str, typer.Option("--rigid", help="Motion as a whole: tell or remove.")] = "tell",
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
    from rgbmidic.results.comparison import Comparison, Simulation, measured_mesh, place

    if rigid not in ("tell", "remove"):
        raise InputError(f'--rigid is tell or remove, not "{rigid}"')
    form = "X_MM,Y_MM:X_PX,Y_PX"
    pairs = [command.read_place(text, "--points", form) for text in points or ()]
    chosen, settings, result = _frames(frames), _settings(test), Result.open(folder, partial=partial)
    scale = None if settings is None else settings.scale
    placement = place(result, scale=scale, pairs=pairs)
    numbered = measured_mesh(result) if mesh is None else read_mesh(mesh, unit=unit)
    simulation = Simulation.read(fe, mesh=numbered, unit=unit, field=field, interval=interval, offset=offset)
    comparison = Comparison(result, simulation, placement, scale=scale, frames=chosen, remove_rigid=rigid == "remove")
    check_folder(out, comparison_files(comparison), overwrite=overwrite)
    with _progress("comparing") as progress:
        done = write_comparison(comparison, out, progress)
    _note(f"placed: {placement.summary()}")
    headings = ["frame", "scale", "uncertainty", "chi-square at nodes", "levelled", "after the scale"]
    rows = []
    for made in done:
        squares = [made.agreement[way, "displacement"].chi_square for way in ("nodes", "levelled")]
        numbers = (made.fit.scale, made.fit.scale_std, *squares, made.fit.chi_square)
        rows.append([f"{made.frame}", *(f"{number:.4g}" for number in numbers)])
    _print_table(f"{len(done)} frames against {fe}", headings, rows)
    print(scale_text(comparison, done))
    print(f"page: {out / PAGE}")


@app.command()
def scale(
    points: Annotated[str, typer.Argument(metavar="X0,Y0:X1,Y1", help="Two points of a known distance, px.")],
    length: Annotated[float, typer.Option("--length", metavar="MM", help="Their distance in mm.")],
    length_std: Annotated[float, typer.Option("--length-std", metavar="MM", help="Its standard uncertainty.")] = 0.0,
    point_std: Annotated[float, typer.Option("--point-std", metavar="PX", help="Of each point, px.")] = 0.5,
) -> None:
    """Millimetres per pixel, with its uncertainty, from two points on an image and their distance."""
    from rgbmidic.fields import Units

    x0, y0, x1, y1 = command.read_place(points, "the points", "X0,Y0:X1,Y1")
    units = Units.from_points([[x0, y0], [x1, y1]], length, length_std=length_std, point_std=point_std)
    print(f"[scale]\nmm_per_pixel = {units.mm_per_pixel:.6g}\nmm_per_pixel_std = {units.mm_per_pixel_std:.2g}")


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for what is written; must be empty or new.")] = Path(
        "rgbmidic-demo"
    ),
) -> None:
    """Make a small virtual test, calibrate, measure it, and compare with the known truth."""
    _note(f"rgbmidic {__version__}: a virtual test is made, calibrated, measured and compared in {out}")
    _explain_first_run()
    from rgbmidic._kernels.threads import threads
    from rgbmidic.lab.demo import run_demo, run_plate, write_plate
    from rgbmidic.report import write_figures
    from rgbmidic.results import Result

    started = time.perf_counter()
    with _progress("demo") as progress:
        rows = run_demo(out, _note, _calibrate_demo, progress)
    _note("5 of 7: a flat plate, tilted, behind a lens that distorts, and photographs of a chessboard")
    truth = write_plate(out / "test")
    _calibrate_demo_camera(out / "test")
    _note(f"6 of 7: measurement on it: rgbmidic run {out / 'test' / 'plate.toml'}, with [scale] camera = camera.json")
    plate = run_plate(out / "test", truth)
    _note(f"7 of 7: pictures of the result in {out / 'figures'}")
    write_figures(Result.open(out / "result"), out / "figures", (len(rows),), processes=threads())
    columns = ["angle", "three lights", "red alone", "green alone", "blue alone", "at nodes", "stated u_std"]
    errors = [(row.rms_px, *row.single_px, row.nodal_px, row.predicted_px) for row in rows]
    lines = [[f"{row.angle_deg:g} deg", *(f"{e:.4f}" for e in each)] for row, each in zip(rows, errors, strict=True)]
    title = "Displacement error against the exact truth, px (a sphere turning under moving reflections)"
    _print_table(title, columns, lines)
    columns = ["plate", "lens and plane", "one scale", "stated", "strain, lens and plane", "one scale", "stated"]
    lines = [
        [
            row.motion,
            *(f"{1e3 * value:.2f}" for value in (*row.displacement_mm, row.stated_mm)),
            *(f"{1e6 * value:.0f}" for value in (*row.strain, row.stated_strain)),
        ]
        for row in plate
    ]
    title = (
        "Displacement error, um, and strain error, 1e-6, against the exact truth (a flat plate, tilted by 5 degrees)"
    )
    _print_table(title, columns, lines)
    print(f"pictures: {out / 'figures'}   result: {out / 'result'}   {time.perf_counter() - started:.0f} s")


def _calibrate_demo(test: Path) -> None:
    """The crosstalk of a virtual test from its captures, as `rgbmidic-calibrate crosstalk` finds it."""
    from rgbmidic.settings import FrameSettings
    from rgbmidic_calibration.captures import Captures
    from rgbmidic_calibration.jobs import calibrate_crosstalk

    lights = {name: str(test / f"light_{name}") for name in ("red", "green", "blue")}
    captures = Captures.find(lights, str(test / "dark"), FrameSettings(path=("captures",)))
    calibration, _ = calibrate_crosstalk(captures)
    calibration.write(test / "calibration.json")


def _calibrate_demo_camera(test: Path) -> None:
    """Lens and plane from the demo's photographs, as `rgbmidic-calibrate camera` finds them."""
    from rgbmidic.settings import FrameSettings
    from rgbmidic_calibration.jobs import calibrate_camera
    from rgbmidic_calibration.target import Target

    stated = FrameSettings(path=("photographs",), kind="monochrome", white_level=65535)
    found = calibrate_camera(
        stated, Target.parse("chessboard:9x7:5mm"), views=str(test / "target/*.png"), plane=str(test / "plane/*.png")
    )
    found.camera.write(test / "camera.json")


@app.command()
def virtual(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="What to render.")],
    out: Out,
) -> None:
    """Render a virtual test: raw frames, calibration captures and the exact truth."""
    from rgbmidic.lab.virtual.dataset import write_dataset

    _explain_first_run()
    with _progress("rendering") as progress:
        write_dataset(scene, out, progress)


@app.command()
def plan(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Lamps, camera, paint, body and its states.")],
    out: Out,
    distance: Annotated[
        float | None, typer.Option("--distance", metavar="MM", help="From camera to specimen; else the scene's.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Predict where each lamp reflects, the uncertainty to expect, and better places for the lamps."""
    from rgbmidic.lab import check_folder
    from rgbmidic.lab import planning_report as planning
    from rgbmidic.lab.planning import make_plan, propose_colours, propose_lamps
    from rgbmidic.scene.scene import read_scene

    check_folder(out, planning.FILES, overwrite=overwrite)
    made = make_plan(read_scene(scene))
    motion = planning.out_of_plane(made, distance)
    proposals = {"colours exchanged": propose_colours(made), "lamps moved": propose_lamps(made)}
    planning.write_plan(made, proposals, out, distance=distance, overwrite=overwrite)
    title = "fraction of the field where lights reflect, all of them do, and only one or none is clean"
    _print_table(title, *planning.zone_rows(made), planning.ZONE_WORDS)
    uncertainty = "standard uncertainty to expect over the field, px"
    _print_table(uncertainty, *planning.uncertainty_rows(made), planning.UNCERTAINTY_WORDS)
    better = {name: proposal.plan for name, proposal in proposals.items() if proposal.gain > 1}
    for name, lamps in {"lamps as they are": made, **better}.items():
        _print_table(f"{name}: {planning.summary(lamps)}", *planning.lamp_rows(lamps))
    if not better:
        print("no better place was found for the lamps")
    unseen = "" if motion["unseen_mm"] is None else f"; below {motion['unseen_mm']:.2g} mm the noise hides it"
    print(
        f"out-of-plane motion at {motion['stand_off_mm']:g} mm reads as strain, {motion['strain_per_mm']:.2e} per mm:"
    )
    print(f"  {motion['edge_px_per_mm']:.2g} px per mm at the field's edge{unseen}")
    print(f"plan: {out / 'plan.json'}   picture: {out / 'plan.png'}")


@app.command()
@command.frame_options
def frames(
    statement: dict[str, Any],
    path: Annotated[str, typer.Argument(metavar="PATH", help="A movie, a frame, a folder or a pattern.")] = "",
    formats: Annotated[bool, typer.Option("--formats", help="List the formats that are read.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
    save: Annotated[
        tuple[int, Path] | None, typer.Option("--save", metavar="N OUT.tif", help="Write frame N as a 16-bit TIFF.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """List what a reader finds in raw frames: number, size, levels, times, missing frames."""
    from rgbmidic.frames import known_formats
    from rgbmidic.frames.describe import describe, save_frame
    from rgbmidic.settings import FrameSettings

    if formats:
        for format_ in known_formats():
            print(f"{format_.name}: {' '.join((*format_.endings, *format_.movies)) or 'by content'}")
        return
    if not path:
        raise InputError("PATH must name a movie, a frame, a folder or a pattern; --formats lists what is read")
    settings = FrameSettings(path=(path,), **statement)
    description = describe(settings)
    if save is not None:
        save_frame(settings, *save, overwrite=overwrite)
    for warning in description.warnings:
        _note(f"warning: {warning}")
    print(description.as_json() if json else description.as_text())


@app.command()
@command.frame_options
def inspect(
    frames: Annotated[list[Path], typer.Argument(metavar="FRAME...", help="A raw frame; one per light in succession.")],
    statement: dict[str, Any],
    test: Annotated[Path | None, typer.Option("--test", help="TEST.toml the frame is meant for.")] = None,
    calibration: Annotated[Path | None, typer.Option("--calibration", help="Calibration file.")] = None,
    region: Annotated[str, typer.Option("--region", help="x0,y0,x1,y1 in px; else the test's or the frame.")] = "",
    element_size: Annotated[float | None, typer.Option("--element-size", help="px; else the test's or 25.")] = None,
    accept: Annotated[
        list[str] | None, typer.Option("--accept", help="Contradiction to the calibration to accept; else the test's.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for inspection.png and inspection.json.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Inspect one frame before a test: lights, reflections, speckle, noise, uncertainty to expect."""
    from rgbmidic.lab import check_folder
    from rgbmidic.lab.inspection import inspect_files, report, state_frames

    if out is not None:
        check_folder(out, report.FILES, overwrite=overwrite)
    settings = _settings(test)
    _explain_first_run()
    with _progress("inspecting") as progress:
        inspection = inspect_files(
            frames,
            test=settings,
            calibration=calibration,
            frame=state_frames(settings, count=len(frames), **statement),
            region=command.read_place(region, "--region", "X0,Y0,X1,Y1") if region else None,
            element_size=element_size,
            accept=tuple(accept) if accept else None,
            progress=progress,
        )
    if out is not None:
        report.write_inspection(inspection, out, overwrite=overwrite)
    rows, columns = inspection.frame_shape
    print(f"{inspection.name}: {inspection.kind}, {columns} x {rows} px\n")
    _print_table("samples in the region, fractions of the full scale", *report.channel_rows(inspection))
    _print_table("lights", *report.light_rows(inspection))
    known = "" if inspection.noise_known else " (noise estimated, not calibrated)"
    size = f"elements of {inspection.element_size:g} px"
    _print_table(f"standard uncertainty of u and v to expect{known}, px, {size}", *report.uncertainty_rows(inspection))
    for finding in inspection.findings:
        print(f"warning: {finding.text}")
    if out is not None:
        print(f"picture: {out / 'inspection.png'}   figures: {out / 'inspection.json'}")


def _print_table(
    title: str, headings: list[str], rows: list[list[str]], words: Mapping[str, str] | None = None
) -> None:
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


def _frames(text: str) -> list[int] | None:
    """Indices that ``--frames`` states, None where it states none."""
    try:
        return [int(part) for part in text.split(",")] if text else None
    except ValueError:
        raise InputError(f"--frames are whole numbers with commas between them, such as 0,5,10; not {text!r}") from None


def _explain_first_run() -> None:
    """Print why the first use takes longer."""
    from rgbmidic._kernels import are_compiled

    if not are_compiled():
        _note(
            "first run on this machine: kernels are compiled for its processor as they are needed, in all some 40 s; "
            "later runs take them from a cache"
        )


def _progress(what: str) -> AbstractContextManager[Callable[[int, int, str], None]]:
    """A bar on stderr for people who watch, see `rgbmidic.timing`."""
    from rgbmidic.timing import progress_bar

    return progress_bar(what, _messages)


def _print_summary(result: Result, seconds: float) -> None:
    """Print how the deformed frames ended; the reference, matched with itself, is left out."""
    from rgbmidic.timing import STAGES

    deformed = list(result.deformed)
    ends = [int((result.status[deformed] == code).sum()) for code in (_CONVERGED, _UNCONVERGED, _FAILED)]
    words = [f"{ends[0]} converged", *([f"{ends[1]} not converged"] if ends[1] else []), f"{ends[2]} failed"]
    measured = [float((status == 0).mean()) for status in result.each("node_status", deformed)]
    rows = {"frames": f"{len(deformed)} deformed: {', '.join(words)}", "nodes": f"{len(result.nodes)}"}
    if measured:
        rows["nodes"] += f", {sum(measured) / len(measured):.1%} measured"
    if (count := len(result.setting("frames", "reference", [0]))) > 1:
        gain = ((1 + 1 / count) / 2) ** 0.5
        rows["mean"] = f"of {count} frames is the reference: camera noise counts {gain:.2f} of what it does with one"
    for light, fraction in zip(result.lights, result.mean_light_fraction[deformed].T, strict=True):
        known = fraction[fraction == fraction]
        rows[light] = f"{known.mean():.0%} of what determines the nodes" if known.size else "-"
    timed = [seconds for seconds in result.each("seconds", deformed) if seconds[0] == seconds[0]] if measured else []
    if timed:  # the mean time of a frame and what each stage takes of it
        mean = sum(timed) / len(timed)
        parts = ", ".join(f"{name} {part:.0%}" for name, part in zip(STAGES, mean / mean.sum(), strict=True))
        rows["frame"] = f"{mean.sum():.2f} s: {parts}"
    for name, text in {**rows, "time": f"{seconds:.1f} s", "result": result.path}.items():
        print(f"{name:<8}{text}")


if __name__ == "__main__":
    main()
