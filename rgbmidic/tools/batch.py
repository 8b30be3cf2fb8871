"""A series of tests measured one after the other, and one table of what each of them gave.

A test that fails stays in the table with its reason, and the rest goes on. A test that is already measured with the
same settings, calibration and frames is not measured again: its provenance tells.
"""

from __future__ import annotations

import csv
import io
import logging
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.disk import check_file, require_regular_file, write_complete, write_table
from rgbmidic.errors import AnotherTestError, InputError, ResultError, RgbmidicError
from rgbmidic.pipeline.run import measure
from rgbmidic.results import Histories, Maps, Result, common_variance_fraction
from rgbmidic.results.histories import read_histories
from rgbmidic.results.provenance import is_result
from rgbmidic.settings import TestSettings, read_test, read_toml
from rgbmidic.typing import ProgressCallback

logger = logging.getLogger(__name__)

SUMMARIES = ("summary.csv", "summary.html")
"""Table and page of a batch, beside the folders of its tests."""
_HEADER = ("test", "state", "reason", "result")
ELASTIC = (0.0005, 0.0025)
"""Strains between which a modulus is fitted where none are stated: those of ISO 527-1."""


Tests = Mapping[str, Callable[[], TestSettings]]
"""The tests of a batch: by their names, those of their folders, what reads their settings when their turn comes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outcome:
    """The outcome of a test: a measured result or the reason of a failure.

    Attributes
    ----------
    name
        The test.
    folder
        Its result.
    reason
        Why it failed; empty where it did not.
    measured
        Whether it was measured now, and not before.
    values
        Quantities by the name of their column, standard uncertainties as ``_std``.
    """

    name: str
    folder: Path
    reason: str = ""
    measured: bool = False
    values: Mapping[str, float] = field(default_factory=dict)


def read_tests(paths: Sequence[Path]) -> Tests:
    """Name the tests of TEST.toml files, by the file, or by its folder where several are called alike.

    Parameters
    ----------
    paths
        The files.

    Raises
    ------
    InputError
        Two tests would have one name, or a file is missing.
    """
    stems = [path.stem for path in paths]
    names = [path.stem if stems.count(path.stem) == 1 else path.resolve().parent.name for path in paths]
    _check_names(names)
    if missing := [str(path) for path in paths if not path.is_file()]:
        raise InputError(f"there is no settings file {', '.join(missing)}")
    return {name: partial(read_test, path) for path, name in zip(paths, names, strict=True)}


def read_table(template: Path, table: Path) -> Tests:
    """Make tests from a template and a table: a row a test, with values that replace keys of the template.

    Parameters
    ----------
    template
        A TEST.toml; paths in it and in the table are relative to it.
    table
        CSV file. Its first column is ``test``, the name; the others are keys such as ``frames.path`` or
        ``channels.area``, with values as TOML writes them (a text may go without quotes; an empty field leaves the
        template's).

    Raises
    ------
    InputError
        The table is missing, has another first column, a row of another length, or two tests of one name.
    ConfigurationError
        The template is missing or no TOML.
    """
    document = read_toml(template, "settings file")
    try:
        rows = [
            row
            for row in csv.reader(io.StringIO(require_regular_file(table).read_text(encoding="utf-8-sig")))
            if any(row)
        ]
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"the table {table} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    head = [name.strip() for name in rows[0]] if rows else []
    if head[:1] != ["test"] or not all("." in name for name in head[1:]):
        raise InputError(
            f'the table {table} needs a first column "test" and keys such as "frames.path"; its columns are '
            f"{', '.join(head) or 'none'}"
        )
    if twice := [name for name in dict.fromkeys(head) if head.count(name) > 1]:
        raise InputError(f"the table {table} has several columns of one name: {', '.join(twice)}")
    _check_names([row[0].strip() for row in rows[1:]])
    tests = {}
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(head):
            raise InputError(f"row {number} of the table {table} has {len(row)} fields, the header {len(head)}")
        changed = deepcopy(document)
        for name, text in zip(head[1:], map(str.strip, row[1:]), strict=True):
            section, key = name.split(".", 1)
            value: Any = text
            with suppress(tomllib.TOMLDecodeError):  # a text may go without quotes
                value = tomllib.loads(f"value = {text}")["value"]
            if text:
                changed.setdefault(section, {})[key] = value
        tests[row[0].strip()] = partial(TestSettings.from_mapping, changed, template.parent)
    return tests


def _check_names(names: Sequence[str]) -> None:
    folded = [name.casefold() for name in names]  # as file systems without capitals take them
    for name, plain in zip(names, folded, strict=True):
        if not re.fullmatch(r"[\w][\w .+-]{0,79}", name) or plain in SUMMARIES:
            raise InputError(f'"{name}" names no test: letters, digits, . _ + - only, and not {" or ".join(SUMMARIES)}')
        if folded.count(plain) > 1:
            raise InputError(f'"{name}" is the name of two tests')
    if not names:
        raise InputError("a batch needs one test or more")


def run_batch(
    tests: Tests,
    out: Path,
    *,
    workers: int | None = None,
    elastic: tuple[float, float] = ELASTIC,
    overwrite: bool = False,
    conclude: Callable[[Result, TestSettings, bool], None] | None = None,
    progress: ProgressCallback | None = None,
) -> Iterator[Outcome]:
    """Measure tests one after the other, each into a folder of its name; yield what each gave as it ends.

    Parameters
    ----------
    tests
        The tests.
    out
        Folder of the batch.
    workers
        As of `measure`.
    elastic
        Strains between which moduli are fitted.
    overwrite
        Whether a result of other settings, calibration or frames may be replaced; else the test fails.
    conclude
        Called with each result, its settings, and whether it was measured now.
    progress
        Called after every frame of each test, as of `measure`.

    Yields
    ------
    Outcome
        Of each test.
    """
    for name, read in tests.items():
        folder = out / name
        try:
            result, settings, is_new = _measured(read, folder, workers, progress, overwrite=overwrite)
            if conclude is not None:
                conclude(result, settings, is_new)
            yield Outcome(name=name, folder=folder, measured=is_new, values=_values(result, settings, elastic))
        except (RgbmidicError, OSError) as error:
            yield Outcome(name=name, folder=folder, reason=str(error))


def _measured(
    read: Callable[[], TestSettings],
    folder: Path,
    workers: int | None,
    progress: ProgressCallback | None,
    *,
    overwrite: bool,
) -> tuple[Result, TestSettings, bool]:
    """Measure a test unless it is measured already; whether it was measured now comes last."""
    settings, has_run = read(), False

    def count(done: int, total: int, line: str) -> None:
        nonlocal has_run
        has_run = True
        if progress is not None:
            progress(done, total, line)

    try:
        result = measure(settings, folder, resume=is_result(folder), workers=workers, progress=count)
    except AnotherTestError as error:
        reason = str(error).rpartition("; ")[0]
        if not overwrite:
            raise ResultError(f"{reason}; `overwrite=True` measures it again") from None
        logger.warning("%s is measured again: %s", folder.name, reason)
        result = measure(settings, folder, overwrite=True, workers=workers, progress=count)
    return result, settings, has_run


def _values(result: Result, settings: TestSettings, elastic: tuple[float, float]) -> dict[str, float]:
    """Return the values of a result for the table of a batch."""
    statuses = result.status[list(result.deformed)]
    good = float((statuses == 0).mean()) if len(statuses) else 0.0
    if good < 0.5:  # as of `rgbmidic run`
        raise ResultError(f"{int((statuses != 0).sum())} of {len(statuses)} deformed frames failed or did not converge")
    values = {"frames": float(len(statuses)), "converged": good} | dict(_peaks(result, settings))
    probed = dict(_probed(result, settings, elastic))
    if shared_names := sorted(values.keys() & probed.keys()):
        raise InputError(
            f"channels of {settings.channels.file} have the names of measured columns: {', '.join(shared_names)}"
        )
    return values | probed


def _peaks(result: Result, settings: TestSettings) -> Iterator[tuple[str, float]]:
    """Yield the peaks over the frames of fields, each that 99 % of the nodes do not exceed, with its uncertainty."""
    maps = Maps.from_result(result, settings.scale, measure=settings.probes.measure)
    frames = [frame for frame in result.deformed if result.finished[frame]]
    for name in ("magnitude", "e1", "equivalent"):
        peaks = []
        for frame in frames:
            read = maps.read(name, frame)
            finite = np.flatnonzero(np.isfinite(read.values))
            if len(finite):  # single outliers do not count
                at = finite[np.argsort(read.values[finite])[min(len(finite) * 99 // 100, len(finite) - 1)]]
                peaks.append((float(read.values[at]), float(read.uncertainty[at])))
        if peaks:
            unit = maps.field(name).unit
            label = f"peak_{name}_{unit}" if unit else f"peak_{name}"
            yield from zip((label, f"{label}_std"), max(peaks), strict=True)


def _probed(result: Result, settings: TestSettings, elastic: tuple[float, float]) -> Iterator[tuple[str, float]]:
    """Yield the peak of every quantity of the probes and channels, and the modulus where a stress is known."""
    if not settings.probes.kind_coordinates and settings.probes.rigid_motion == "none":
        return
    read = read_histories(result, settings.probes, scale=settings.scale, channels=settings.channels)
    for quantity in read.quantities:
        if quantity.name.endswith(("_before", "_after", "_direction")) or not np.isfinite(quantity.values).any():
            continue
        at = int(np.nanargmax(np.abs(quantity.values)))
        yield f"peak_{quantity.column}", float(quantity.values[at])
        if quantity.std is not None:
            yield f"peak_{quantity.column}_std", float(quantity.std[at])
    if read.stress_strain is not None:
        modulus_and_std = modulus(read, *elastic, common_variance_fraction(result))
        yield from zip(("modulus_MPa", "modulus_MPa_std"), modulus_and_std, strict=True)


def modulus(histories: Histories, low: float, high: float, common_fraction: float) -> tuple[float, float]:
    """Fit the slope of stress over strain while the stress rises, and its standard uncertainty, MPa.

    The strain, whose noise is known, is fitted as a straight line of the stress by weighted least squares; the slope is
    the inverse. The stress is taken as exact: the uncertainty of force and area is not in it.

    Parameters
    ----------
    histories
        With a stress.
    low, high
        Strains between which the frames count.
    common_fraction
        Fraction of the strain's variance that all frames have in common, which shifts the line and not its slope.

    Returns
    -------
    modulus, std : float
        NaN where fewer than three frames lie between the strains.
    """
    assert histories.stress_strain is not None
    strain, stress = (histories[name] for name in histories.stress_strain)
    assert strain.std is not None
    rising = np.arange(len(stress.values)) <= np.nanargmax(np.abs(np.nan_to_num(stress.values)))
    size = np.abs(strain.values)
    in_range = rising & (size >= low) & (size <= high) & np.isfinite(stress.values + strain.values + strain.std)
    if in_range.sum() < 3:
        return math.nan, math.nan
    weight = 1 / ((1 - common_fraction) * strain.std[in_range] ** 2)
    x, y = stress.values[in_range], strain.values[in_range]
    deviation = x - (weight * x).sum() / weight.sum()
    moment = (weight * deviation**2).sum()
    slope = float((weight * deviation * y).sum() / moment) if moment > 0 else math.nan
    return (1 / slope, float(1 / math.sqrt(moment) / slope**2)) if slope else (math.nan, math.nan)


def summary_rows(outcomes: Sequence[Outcome]) -> tuple[list[str], list[list[str]]]:
    """Write what tests gave as a table, with mean and standard deviation over those that did not fail.

    Returns
    -------
    header : list of str
    rows : list of list of str
        One a test: name, state, reason, result folder, values; then the mean, the standard deviation (of two tests or
        more) and the number of tests of each column.
    """
    names = list(dict.fromkeys(name for outcome in outcomes for name in outcome.values))

    def cells(values: Iterable[float]) -> list[str]:
        return ["" if math.isnan(value) else f"{value:.6g}" for value in values]

    rows = []
    for outcome in outcomes:
        state = "failed" if outcome.reason else "measured" if outcome.measured else "measured before"
        value_cells = cells(outcome.values.get(name, math.nan) for name in names)
        rows.append([outcome.name, state, outcome.reason, str(outcome.folder), *value_cells])
    values_by_column = [
        [outcome.values[name] for outcome in outcomes if np.isfinite(outcome.values.get(name, math.nan))]
        for name in names
    ]
    means = (float(np.mean(column_values)) if column_values else math.nan for column_values in values_by_column)
    deviations = (
        float(np.std(column_values, ddof=1)) if len(column_values) > 1 else math.nan
        for column_values in values_by_column
    )
    rows.append(["mean", "", "", "", *cells(means)])
    rows.append(["standard deviation", "", "", "", *cells(deviations)])
    rows.append(["tests", "", "", "", *(str(len(column_values)) for column_values in values_by_column)])
    return [*_HEADER, *names], rows


def check_summary(out: Path, *, overwrite: bool) -> None:
    """Refuse a folder whose table or page has the name of a summary and is not of a batch.

    Raises
    ------
    ResultError
        There is one, and it may not be replaced.
    """
    table = out / SUMMARIES[0]
    if table.is_file() and table.read_bytes().startswith(",".join(_HEADER).encode()):
        return
    for name in SUMMARIES:
        check_file(out / name, overwrite=overwrite)


def write_summary(outcomes: Sequence[Outcome], path: Path) -> None:
    """Write `summary_rows` as a CSV file, in place of an earlier one."""
    write_complete(path, lambda file: write_table(file, *summary_rows(outcomes)))
