"""The commands of `rgbmidic` that measure a test."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from rgbmidic.cli import command
from rgbmidic.cli.command import Draw, Out, Overwrite, Test, Workers, note, progress_bar
from rgbmidic.errors import InputError

if TYPE_CHECKING:
    from rgbmidic.results import Result
    from rgbmidic.settings import TestSettings

app = typer.Typer()


@app.command()
def run(
    test: Test,
    out: Out,
    overwrite: Overwrite = False,
    resume: Annotated[bool, Option("--resume", help="Continue the interrupted run in DIR.")] = False,
    retry_failed: Annotated[bool, Option("--retry-failed", help="With --resume: repeat all failed frames.")] = False,
    frames: Annotated[str, Option(help="Only these, such as 1000:2000; end with `rgbmidic finish`.")] = "",
    workers: Workers = 0,
    scheduler: Annotated[str | None, Option(help="Address of a Dask scheduler.")] = None,
    timings: Annotated[bool, Option("--timings", help="Store and print the time of each stage.")] = False,
    draw: Draw = True,
) -> None:
    """Measure a test: from raw frames to one displacement field per frame."""
    from rgbmidic.pipeline import measure
    from rgbmidic.settings import read_range, read_test

    start_time = time.perf_counter()
    settings = read_test(test)
    frame_range = read_range(frames, "--frames") if frames else None
    if overwrite and (resume or frames):
        raise InputError("--overwrite begins anew, --resume and --frames go on: state one of them")
    with progress_bar("measuring") as progress, _continuation_hint(test, out, frames, resume=resume):
        result = measure(
            settings,
            out,
            overwrite=overwrite,
            resume=resume,
            retry_failed=retry_failed,
            frames=frame_range,
            workers=workers or None,
            scheduler=scheduler,
            timings=timings,
            progress=progress,
        )
    if frame_range is None:
        _conclude(result, start_time, draw=draw, processes=workers)
    else:
        print(f"frames {frames} are measured; when all frames are: rgbmidic finish {out}")


@app.command()
def batch(
    tests: Annotated[list[Path], Argument(metavar="TEST.toml...", help="Settings of the tests; one with --table.")],
    out: Out,
    table: Annotated[
        Path | None, Option(help="CSV: a column test, and keys of TEST.toml that its values replace.")
    ] = None,
    elastic: Annotated[
        str, Option(metavar="LOW:HIGH", help="Strains between which a modulus is fitted.")
    ] = "0.0005:0.0025",
    workers: Workers = 0,
    reports: Annotated[bool, Option("--reports/--no-reports", help="Write a report of each test.")] = True,
    overwrite: Overwrite = False,
) -> None:
    """Measure a series of tests, each into DIR/NAME, with one summary table and page.

    A test that fails does not stop the others; a finished test is not measured again. --overwrite replaces a
    result that was measured with other settings.
    """
    from rgbmidic.disk import write_errors
    from rgbmidic.tools import batch as series
    from rgbmidic.tools.report import REPORT, write_batch_page, write_report

    if table is not None and len(tests) != 1:
        raise InputError(f"--table goes with one TEST.toml, the template, not with {len(tests)}")
    test_readers = series.read_tests(tests) if table is None else series.read_table(tests[0], table)
    low, high = command.read_pair(elastic, "--elastic")
    if not 0 <= low < high:
        raise InputError(f"--elastic is a smaller and a larger strain, not {elastic}")
    with write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        series.check_summary(out, overwrite=overwrite)

    def conclude(result: Result, settings: TestSettings, is_new: bool) -> None:
        if reports and (is_new or not (result.path / REPORT).is_file()):
            write_report(result, result.path / REPORT, settings=settings, overwrite=True)

    outcomes = []
    with progress_bar("batch") as progress:
        for outcome in series.run_batch(
            test_readers,
            out,
            workers=workers or None,
            elastic=(low, high),
            overwrite=overwrite,
            conclude=conclude,
            progress=progress,
        ):
            outcomes.append(outcome)
            series.write_summary(outcomes, out / "summary.csv")
            write_batch_page(*series.summary_rows(outcomes), out / "summary.html")
            success = "measured" if outcome.measured else "measured before"
            note(f"{outcome.name}: {command.name_options(outcome.reason) or success}")
    print(f"table: {out / 'summary.csv'}   page: {out / 'summary.html'}")
    if failed := [outcome.name for outcome in outcomes if outcome.reason]:
        raise typer.Exit(command.fail(f"{len(failed)} of {len(outcomes)} tests failed: {', '.join(failed)}"))


@app.command()
def finish(
    result: Annotated[Path, Argument(metavar="DIR", help="Result folder of runs with --frames.")], draw: Draw = True
) -> None:
    """Finish a result that was measured in parts: check that no frame is missing, and draw it."""
    from rgbmidic.results import Result, finish_result

    start_time = time.perf_counter()
    finish_result(result)
    _conclude(Result.open(result), start_time, draw=draw)


def _conclude(result: Result, start_time: float, *, draw: bool, processes: int = 0) -> None:
    """Draw a finished result and print the status of its frames.

    The drawing uses as many processes as cores if no number is stated. The command fails if more than half of the
    frames failed or did not converge: a specimen that breaks or leaves the picture halfway through is an ordinary test,
    a run that measures few of its frames is not.
    """
    from rgbmidic._kernels.threads import threads
    from rgbmidic.results import Maps
    from rgbmidic.tools.report import remove_pictures, write_figures

    remove_pictures(result.path)
    if draw:
        write_figures(Maps.from_result(result), result.path / "figures", processes=processes or threads())
    _print_summary(result, time.perf_counter() - start_time)
    failed = [index for index in result.deformed if result.status[index] != 0]
    if unread := int(result.unread.sum()):
        note(f"note: frames that could not be read: {unread}; --resume tries them again")
    if not result.deformed:
        raise typer.Exit(command.fail("every frame is one of the reference: there is no deformed one"))
    if len(failed) > len(result.deformed) / 2:
        first_failure = f"the first, {result.names[failed[0]]}: {result.frame(failed[0]).reason}"
        count = f"{len(failed)} of {len(result.deformed)} deformed frames failed or did not converge"
        raise typer.Exit(command.fail(f"{count}; {first_failure}"))


@contextmanager
def _continuation_hint(test: Path, out: Path, frames: str, *, resume: bool) -> Iterator[None]:
    """Print how to continue when the run is interrupted, by Ctrl-C or by SIGTERM, if it wrote anything."""
    from rgbmidic.results.provenance import PROVENANCE

    def provenance_bytes() -> bytes:
        return file.read_bytes() if (file := out / PROVENANCE).is_file() else b""

    initial_bytes = provenance_bytes()
    try:
        yield
    except KeyboardInterrupt:
        if frames or resume or provenance_bytes() != initial_bytes:
            option = f"--frames {frames}" if frames else "--resume"
            note(f"go on with: rgbmidic run {test} --out {out} {option}")
        else:
            note("nothing was begun: run the same command again")
        raise


def _print_summary(result: Result, seconds: float) -> None:
    """Print the status of the deformed frames; the reference, matched with itself, is left out."""
    from rgbmidic.results import QUANTITIES
    from rgbmidic.timing import STAGES

    deformed = list(result.deformed)
    status_counts = {
        word: int((result.status[deformed] == code).sum()) for code, word in enumerate(QUANTITIES["status"].codes)
    }
    words = [f"{count} {word}" for word, count in status_counts.items() if count or word != "not converged"]
    measured_fractions = [float((status == 0).mean()) for status in result.iterate("node_status", deformed)]
    rows = {"frames": f"{len(deformed)} deformed: {', '.join(words)}", "nodes": f"{len(result.nodes)}"}
    if measured_fractions:
        rows["nodes"] += f", {sum(measured_fractions) / len(measured_fractions):.1%} measured"
    if element_size := result.provenance.get("element_size"):
        rows["mesh"] = f"{element_size['element_size']:g} px: {element_size['reason']}"
    if refinement := result.provenance.get("refinement"):
        rows["refined"] = refinement
    if (count := len(result.setting("frames", "reference", [0]))) > 1:
        gain = ((1 + 1 / count) / 2) ** 0.5
        rows["mean"] = f"of {count} frames is the reference: camera noise counts {gain:.2f} of what it does with one"
    for light, fraction in zip(result.lights, result.mean_light_fraction[deformed].T, strict=True):
        finite = fraction[fraction == fraction]
        rows[light if light.startswith("light ") else f"light {light}"] = (
            f"{finite.mean():.0%} of what determines the nodes" if finite.size else "-"
        )
    stage_seconds = (
        [seconds for seconds in result.iterate("seconds", deformed) if seconds[0] == seconds[0]]
        if measured_fractions
        else []
    )
    if stage_seconds:  # the mean time of a frame and what each stage takes of it
        mean = sum(stage_seconds) / len(stage_seconds)
        stage_texts = ", ".join(
            f"{name} {stage_fraction:.0%}" for name, stage_fraction in zip(STAGES, mean / mean.sum(), strict=True)
        )
        rows["frame"] = f"{mean.sum():.2f} s: {stage_texts}"
    rows |= {"time": f"{seconds:.1f} s", "result": str(result.path)}
    width = max(map(len, rows)) + 2
    for name, text in rows.items():
        print(f"{name:<{width}}{text}")
