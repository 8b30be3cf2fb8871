"""The tables of the pages: they exist, the pages' figures are theirs, and measuring a few rows again gives the same."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from table_laws import LAWS

sys.path.append(str(Path(__file__).resolve().parents[2]))

from benchmarks import ROOT
from benchmarks import __main__ as driver
from benchmarks.tables import (
    FOLDER,
    PAGES,
    QUICK_FOLDER,
    SCATTER_FOLDER,
    TABLES,
    Entry,
    MissingDataError,
    Table,
    disagreements,
    filled,
    load,
    scatter_of,
    table,
    written,
)

BROKEN = load()


def test_every_module_of_tables_can_be_imported():
    assert not BROKEN


@pytest.mark.parametrize("name", TABLES)
def test_each_table_is_committed_and_shown_by_its_page(name):
    Table.read(FOLDER / f"{name}.csv")
    text = (ROOT / "docs" / f"{TABLES[name].page}.md").read_text(encoding="utf-8")
    assert re.search(rf"<!-- measured: {name}\s|tables/{name}\.csv \"", text)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: f"{page.parent.name}_{page.stem}")
def test_pages_show_tables_and_figures_as_the_files_have_them(page):
    """`python -m benchmarks --pages` writes them."""
    text = page.read_text(encoding="utf-8")
    assert filled(text) == text
    assert len(re.findall(r"<!-- (?:measured|generated): ", text)) == len(re.findall(r"<!-- end -->", text))
    assert "{measured}" not in text


def test_a_table_and_a_figure_are_replaced_and_nothing_else(tmp_path):
    header = {"date": "2026-01-02", "commit": "abc", "command": "python -m benchmarks sphere"}
    Table.of(ENTRY, ROWS, header).write(tmp_path / "sphere.csv")
    text = """before
<!-- measured: sphere -->
old
<!-- end -->
   <!-- measured: sphere
   columns: camera, bias [px]
   rows: 3-CCD, 8
   caption: -
   -->
   <!-- end -->
[0](../tables/sphere.csv "Bayer; bias [px]") and [a link](../tables/sphere.csv)
"""
    expected = """before
<!-- measured: sphere -->

 (measured 2026-01-02 at commit abc by `python -m benchmarks sphere`)

| camera | angle [deg] | rms error [px] | bias [px] | lost |
| --- | ---: | ---: | ---: | ---: |
| Bayer | 8 | 0.0122 | 0.000400 | 3 |
| 3-CCD | 8 | 0.0100 | – | 0 |

<!-- end -->
   <!-- measured: sphere
   columns: camera, bias [px]
   rows: 3-CCD, 8
   caption: -
   -->

   | camera | bias [px] |
   | --- | ---: |
   | 3-CCD | – |

   <!-- end -->
[0.000400](../tables/sphere.csv "Bayer; bias [px]") and [a link](../tables/sphere.csv)
"""
    assert filled(text, tmp_path) == expected
    assert filled(expected, tmp_path) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<!-- measured: cube -->\n<!-- end -->", "no table 'cube' in .*; tables are: sphere"),
        ("<!-- measured: sphere\nrow: Bayer\n-->\n<!-- end -->", "states columns, rows and caption, not row"),
        ("<!-- measured: sphere\nrows: Foveon\n-->\n<!-- end -->", "no row 'Foveon'"),
        ('[1](tables/sphere.csv "Bayer; rms")', "no column 'rms'"),
    ],
)
def test_what_a_page_asks_for_wrongly_is_said(tmp_path, text, message):
    Table.of(ENTRY, ROWS).write(tmp_path / "sphere.csv")
    with pytest.raises(ValueError, match=message):
        filled(text, tmp_path)


def test_each_file_is_of_a_table():
    assert {path.stem for path in FOLDER.glob("*.csv")} <= set(TABLES)
    assert {path.stem for path in FOLDER.glob("quick/*.csv")} == {n for n, e in TABLES.items() if e.own_quick}
    assert {path.stem for path in SCATTER_FOLDER.glob("*.csv")} <= {n for n, e in TABLES.items() if not e.timing}


def test_each_table_of_smaller_cases_has_a_law():
    assert set(LAWS) == {name for name, entry in TABLES.items() if entry.own_quick}


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("folder", [FOLDER, QUICK_FOLDER], ids=["full", "quick"])
def test_committed_figures_obey_what_does_not_come_from_them(name, folder):
    LAWS[name](Table.read(folder / f"{name}.csv"))


@pytest.mark.parametrize("name", TABLES)
def test_quick_rows_are_those_of_the_page(name):
    entry = TABLES[name]
    try:
        made = Table.of(entry, entry.measure(True))
    except MissingDataError as error:
        pytest.skip(str(error))
    if not entry.timing:
        scatter = SCATTER_FOLDER / f"{name}.csv"
        known = Table.read(scatter) if scatter.exists() else None
        assert not disagreements(entry, made, Table.read(entry.committed()), known)
    if name in LAWS:
        LAWS[name](made)


ROWS = [
    {"camera": "Bayer", "angle [deg]": 8.0, "rms error [px]": 0.0122, "bias [px]": 0.0004, "lost": 3},
    {"camera": "3-CCD", "angle [deg]": 8.0, "rms error [px]": 0.01, "bias [px]": float("nan"), "lost": 0},
]
ENTRY = Entry("sphere", "page", 1, lambda quick: iter(ROWS), keys=2, scatter={"bias [px]": "rms error [px]"})


def changed(**figures: object) -> list[str]:
    rows = [ROWS[0] | {ROWS_NAMES[name]: value for name, value in figures.items()}]
    return disagreements(ENTRY, Table.of(ENTRY, rows), Table.of(ENTRY, ROWS))


ROWS_NAMES = {"rms": "rms error [px]", "bias": "bias [px]", "lost": "lost", "angle": "angle [deg]"}


def test_a_figure_counts_as_the_same_within_a_factor_and_noise_within_its_scatter():
    assert not changed(rms=0.0122 * 1.49, bias=-0.0170, lost=4)
    assert len(changed(rms=0.0122 * 1.51)) == len(changed(rms=0.0081)) == len(changed(rms=-0.0122)) == 1
    assert len(changed(bias=0.02)) == len(changed(lost=0)) == len(changed(rms=float("nan"))) == 1
    with pytest.raises(ValueError, match="no row 'Bayer, 4'; rows are: Bayer, 8; 3-CCD, 8"):
        changed(angle=4.0)


def test_a_figure_agrees_within_the_scatter_of_draws_a_count_within_two_and_a_text_with_an_alternative():
    entry = replace(ENTRY, within={"lost": 2.0})
    rows = [row | {"by": "noise or levels"} for row in ROWS]
    draws = [Table.of(entry, [rows[0] | {"rms error [px]": rms, "by": by}]) for rms, by in ((0.011, "–"), (0.013, "x"))]
    scatter = scatter_of(entry, [Table.of(entry, rows[:1]), *draws])
    assert scatter.rows == (("Bayer", "8", "0.00101", "0", "0", "x or –"),)
    assert scatter_of(entry, [Table.of(entry, rows)] * 3) is None

    def compared(**figures):
        made = Table.of(entry, [rows[0] | {ROWS_NAMES.get(name, name): value for name, value in figures.items()}])
        return len(disagreements(entry, made, Table.of(entry, rows), scatter))

    assert not compared(rms=0.0061 + 1e-4, lost=1, by="levels or black level")
    assert not compared(by="–")
    assert [compared(rms=0.0060), compared(lost=0), compared(by="black level")] == [1, 1, 1]


def test_what_is_written_is_read(tmp_path):
    made = Table.of(ENTRY, ROWS, {"commit": "abc"})
    made.write(tmp_path / "sphere.csv")
    found = Table.read(tmp_path / "sphere.csv")
    assert (found.columns, found.rows, found.keys, found.header["commit"]) == (made.columns, made.rows, 2, "abc")
    assert found.figure(["Bayer", "8"], "rms error [px]") == "0.0122"
    assert found.figure(["3-CCD"], "bias [px]") == "nan"
    assert [path.name for path in tmp_path.iterdir()] == ["sphere.csv"]


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda t, f: Table.read(f / "cube.csv"), "no table 'cube' in .*; tables are: sphere"),
        (lambda t, f: t.column("rms"), "no column 'rms'; columns are: camera, angle"),
        (lambda t, f: t.matching(["Foveon"]), "no row 'Foveon'; rows are: Bayer, 8; 3-CCD, 8"),
        (lambda t, f: Table.of(ENTRY, ROWS * 2), "two rows of the same keys"),
        (lambda t, f: Table.of(ENTRY, [ROWS[0], {"camera": "x"}]), "a row has"),
        (lambda t, f: Table.of(ENTRY, []), "no rows"),
        (lambda t, f: Table.of(ENTRY, [{"camera": "a, b"}]), "no comma"),
        (lambda t, f: Table.of(ENTRY, [{"camera": None}]), "not None of type NoneType"),
        (lambda t, f: table(next(iter(TABLES)), page="x", cost=1)(ENTRY.measure), "two tables named"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, ask, message):
    made = Table.of(ENTRY, ROWS)
    made.write(tmp_path / "sphere.csv")
    with pytest.raises(ValueError, match=message):
        ask(made, tmp_path)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.012249, "0.0122"),
        (-0.0219961, "-0.0220"),
        (9.999, "10.0"),
        (1.0, "1.00"),
        (123456.0, "123000"),
        (float("nan"), "nan"),
        (0.0, "0"),
        (3, "3"),
    ],
)
def test_three_digits(value, text):
    assert written(value) == text


def run(monkeypatch, *arguments: str) -> int:
    """Status of the driver, whose two tables are a good one and one that fails."""

    def made(name: str, quick: bool, header: dict[str, str], scatter: bool) -> tuple[Table, float]:
        if name == "broken":
            raise RuntimeError("no camera")
        return Table.of(ENTRY, ROWS, header), 0.1

    monkeypatch.setattr(sys, "argv", ["benchmarks", *arguments])
    monkeypatch.setattr(
        driver, "TABLES", {"sphere": replace(ENTRY, own_quick=True), "broken": replace(ENTRY, name="broken")}
    )
    monkeypatch.setattr(driver, "isolated", made)
    monkeypatch.setattr(driver, "load", dict)
    return driver.main()


def test_a_table_that_fails_does_not_stop_the_others(monkeypatch, tmp_path, capsys):
    assert run(monkeypatch, "--out", str(tmp_path)) == 1
    assert "broken: failed, RuntimeError: no camera" in capsys.readouterr().err
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.csv")) == [
        "quick/sphere.csv",
        "sphere.csv",
    ]
    header = Table.read(tmp_path / "sphere.csv").header
    assert {"commit", "date", "machine", "versions", "command"} <= set(header)
    assert header["command"] == "python -m benchmarks sphere"
    assert Table.read(tmp_path / "quick" / "sphere.csv").header["command"] == "python -m benchmarks sphere --quick"
    assert run(monkeypatch, "sphere", "--quick") == 0
    assert run(monkeypatch, "sphere", "--scatter", "--out", str(tmp_path / "new")) == 0
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("new/*/*")] == ["new/scatter/sphere.csv"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("cube",), "tables are: broken, sphere; given was cube"),
        (("--processes", "0"), "--processes is a whole number from 1, not 0"),
        (("--out", __file__), "--out is a folder"),
    ],
)
def test_what_the_driver_cannot_do_is_said_in_one_line(monkeypatch, capsys, arguments, message):
    assert run(monkeypatch, *arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
