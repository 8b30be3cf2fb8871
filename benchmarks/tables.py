"""The tables of the pages: a registry of what measures them, and CSV files that say where their figures come from.

    @table("sphere", page="explanation/uncertainty", cost=180)
    def sphere(quick: bool) -> Iterator[Row]:
        '''What the table shows (becomes its caption).'''
        yield {"light images": "3-CCD", "angle [deg]": 0.33, "rms error [px]": 0.00241}

A row maps column headings (unit in brackets) to a text, a whole number or a float. The first columns name the row (its
keys), the others are figures. This module imports nothing that measures, so a page that shows a table does not either.
"""

from __future__ import annotations

import csv
import importlib
import os
import pkgutil
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from . import ROOT

Row = dict[str, object]


class MissingDataError(Exception):
    """The files that a table is measured on are not here."""


FOLDER = ROOT / "docs" / "tables"
PAGES = (ROOT / "README.md", ROOT / "calibration" / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
"""They show tables and figures as Markdown, so that they can be read in the repository, too: see `filled`."""
QUICK_FOLDER = FOLDER / "quick"
"""Committed files of the tables whose quick rows are a smaller case instead of some rows of the full table."""
SCATTER_FOLDER = FOLDER / "scatter"
"""How far the draws of the camera's noise scatter the figures of quick rows (see `scatter_of`); without: not at all."""
DRAWS = 12
"""Draws that it is measured from."""
DIGITS = 3
"""Significant digits of a figure: the limits of the tests are 1.5 times the figures, draws scatter by more than 1 %."""


@dataclass(frozen=True)
class Entry:
    """A table of the pages, and what measures it."""

    name: str
    page: str
    cost: float
    measure: Callable[[bool], Iterator[Row]]
    keys: int | None = None
    seed: int = 0
    own_quick: bool = False
    timing: bool = False
    scatter: dict[str, str] = field(default_factory=dict)
    within: dict[str, float] = field(default_factory=dict)

    @property
    def caption(self) -> str:
        """First paragraph of the docstring of what measures the table."""
        return " ".join((self.measure.__doc__ or "").strip().split("\n\n")[0].split())

    def committed(self) -> Path:
        """File that the rows of a quick measurement are compared with."""
        return (QUICK_FOLDER if self.own_quick else FOLDER) / f"{self.name}.csv"


TABLES: dict[str, Entry] = {}
"""Filled by `table` as the modules of this package are imported: see `load`."""


def table(
    name: str,
    *,
    page: str,
    cost: float,
    keys: int | None = None,
    seed: int = 0,
    own_quick: bool = False,
    timing: bool = False,
    scatter: dict[str, str] | None = None,
    within: dict[str, float] | None = None,
) -> Callable[[Callable[[bool], Iterator[Row]]], Callable[[bool], Iterator[Row]]]:
    """Register a generator of rows as a table of the pages.

    Parameters
    ----------
    name
        Name of the table and of its file.
    page
        Page that shows it, below docs and without its suffix.
    cost
        CPU seconds of the full table; the longest is started first.
    keys
        Number of leading columns that name a row; default: the leading columns of text, at least one.
    seed
        Seed of the first draw, as stated in the file.
    own_quick
        The quick rows are a smaller case with a file of their own, docs/tables/quick/NAME.csv, not rows of the full
        table.
    timing
        The figures depend on the machine: a test only sees that the table is made.
    scatter
        For figures that are noise around zero, such as a bias: the column that says how far they scatter.
    within
        For figures that are fractions of a count n, 2/n; for others that may be 0, what is as good as 0.
    """

    def register(measure: Callable[[bool], Iterator[Row]]) -> Callable[[bool], Iterator[Row]]:
        if name in TABLES:
            raise ValueError(f"there are two tables named {name!r}: {TABLES[name].measure} and {measure}")
        TABLES[name] = Entry(name, page, cost, measure, keys, seed, own_quick, timing, scatter or {}, within or {})
        return measure

    return register


def load() -> dict[str, str]:
    """Import all modules of this package; return why those that cannot be imported cannot."""
    broken = {}
    for module in pkgutil.iter_modules([str(Path(__file__).parent)], "benchmarks."):
        if module.name not in ("benchmarks.__main__", __name__):
            try:
                importlib.import_module(module.name)
            except Exception as error:  # one module that fails does not keep the others from being measured
                broken[module.name] = f"{type(error).__name__}: {error}"
    return broken


def written(value: object, *, key: bool = False) -> str:
    """A cell as the file has it: texts as they are, figures with three significant digits."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool | int | str):
        text = str(value)
    elif not isinstance(value, float):
        raise ValueError(f"a cell is a text, a whole number or a float, not {value!r} of type {type(value).__name__}")
    elif key or not np.isfinite(value) or value == 0:
        text = f"{value:g}"
    else:
        rounded, exponent = f"{value:.{DIGITS - 1}e}".split("e")
        text = f"{float(rounded + 'e' + exponent):.{max(DIGITS - 1 - int(exponent), 0)}f}"
    if re.search(r"[,;|\n]", text):
        raise ValueError(f"a cell has no comma, semicolon, bar or line break: {text!r}")
    return text


_ORIGIN = ("date", "commit", "command")


def shown(cell: str) -> str:
    """A cell as pages show it."""
    return "–" if cell == "nan" else cell.replace("-", "−") if _is_number(cell) else cell


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class Table:
    """A table as its file has it."""

    name: str
    header: dict[str, str]
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @property
    def keys(self) -> int:
        """Number of leading columns that name a row."""
        return int(self.header["keys"])

    @classmethod
    def of(cls, entry: Entry, rows: Iterable[Row], header: dict[str, str] | None = None) -> Table:
        """Table of measured rows.

        Raises
        ------
        ValueError
            For no rows, rows of different columns, cells that cannot be written, or two rows of the same keys.
        """
        rows = list(rows)
        if not rows:
            raise ValueError(f"table {entry.name} has no rows")
        columns = tuple(written(heading) for heading in rows[0])
        for row in rows:
            if tuple(row) != columns:
                raise ValueError(f"table {entry.name} has the columns {columns}, but a row has {tuple(row)}")
        text = next((i for i, heading in enumerate(columns) if not isinstance(rows[0][heading], str)), len(columns))
        keys = entry.keys if entry.keys is not None else max(text, 1)
        cells = tuple(tuple(written(v, key=i < keys) for i, v in enumerate(row.values())) for row in rows)
        if len({row[:keys] for row in cells}) < len(cells):
            raise ValueError(f"table {entry.name} has two rows of the same keys {columns[:keys]}")
        header = (header or {}) | {"keys": str(keys), "caption": entry.caption}
        return cls(entry.name, header, columns, cells)

    @classmethod
    def read(cls, path: Path) -> Table:
        """Table of a file.

        Raises
        ------
        ValueError
            Where there is no such file; the tables that exist are named.
        """
        if not path.is_file():
            found = ", ".join(sorted(p.stem for p in path.parent.glob("*.csv"))) or "none"
            raise ValueError(f"there is no table {path.stem!r} in {path.parent}; tables are: {found}")
        lines = path.read_text(encoding="utf-8").splitlines()
        comments = [line[1:].partition(":") for line in lines if line.startswith("#")]
        columns, *rows = csv.reader(line for line in lines if not line.startswith("#"))
        header = {key.strip(): value.strip() for key, _, value in comments}
        return cls(path.stem, header, tuple(columns), tuple(map(tuple, rows)))

    def write(self, path: Path) -> None:
        """Write the file at once: there is the old one, or the new one, never half of it."""
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
        lines = [f"# {key}: {value}" for key, value in self.header.items()]
        lines += [",".join(row) for row in (self.columns, *self.rows)]
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
        temporary.replace(path)

    def markdown(self, *, columns: str = "", rows: str = "", caption: str = "") -> str:
        """Return the table as a page shows it: caption with its origin, then the rows.

        Parameters
        ----------
        columns
            Headings with commas between them; empty: all.
        rows
            First cells of the rows with commas between them, semicolons between the rows; empty: all.
        caption
            Instead of that of the file; ``-``: none.
        """
        places = [self.column(name.strip()) for name in columns.split(",")] if columns else range(len(self.columns))
        chosen = [row for part in rows.split(";") for row in self.matching(part.split(","))] if rows else self.rows
        ends = ["---:" if all(_is_number(row[place]) for row in chosen) else "---" for place in places]
        cells = [[self.columns[place] for place in places], ends]
        cells += [[shown(row[place]) for place in places] for row in chosen]
        lines = [f"| {' | '.join(line)} |" for line in cells]
        if caption != "-":
            origin = "measured {date} at commit {commit} by `{command}`".format_map(
                {**dict.fromkeys(_ORIGIN, ""), **self.header}
            )
            lines = [f"{caption or self.header.get('caption', '')} ({origin})", "", *lines]
        return "\n".join(lines)

    def column(self, name: str) -> int:
        """Number of a column.

        Raises
        ------
        ValueError
            If there is no such column; the columns that exist are named.
        """
        if name not in self.columns:
            raise ValueError(f"table {self.name} has no column {name!r}; columns are: {', '.join(self.columns)}")
        return self.columns.index(name)

    def matching(self, values: Iterable[str]) -> list[tuple[str, ...]]:
        """Rows whose first cells are the values; numbers are compared as numbers.

        Raises
        ------
        ValueError
            If there is no such row; the rows that exist are named.
        """
        wanted = [value.strip() for value in values]
        found = [r for r in self.rows if len(wanted) <= len(r) and all(map(_same, wanted, r))]
        if not found:
            rows = "; ".join(", ".join(row[: self.keys]) for row in self.rows)
            raise ValueError(f"table {self.name} has no row {', '.join(wanted)!r}; rows are: {rows}")
        return found

    def figure(self, values: Iterable[str], column: str) -> str:
        """One cell, of the one row whose first cells are the values.

        Raises
        ------
        ValueError
            If there is no such row or column, or if there are several rows.
        """
        values = list(values)
        found = self.matching(values)
        if len(found) > 1:
            raise ValueError(f"table {self.name} has {len(found)} rows {', '.join(values)!r}: name more of its keys")
        return found[0][self.column(column)]


_BLOCK = re.compile(r"^( *)(<!-- measured: (\w+)\s(.*?)-->\n).*?(<!-- end -->)", re.DOTALL | re.MULTILINE)
_FIGURE = re.compile(r'\[[^\[\]]*\](\(\S*tables/(\w+)\.csv "([^";]*); ([^"]*)"\))')


def filled(text: str, folder: Path = FOLDER) -> str:
    """Return a page's text with its tables and figures as the files in a folder have them.

    A table lies between `<!-- measured: NAME -->` and `<!-- end -->`; lines `columns:`, `rows:` and `caption:` in the
    first comment choose (`Table.markdown`). A figure is a link to its table with the title `KEYS; COLUMN`:
    `[0.0122](../tables/sphere.csv "Bayer, 8; rms error [px]")`.

    Raises
    ------
    ValueError
        A table, row or column does not exist; the message names those that do.
    """

    def table_of(found: re.Match[str]) -> str:
        options = dict(re.findall(r"^ *(\w+): (.*?) *$", found[4], re.MULTILINE))
        if odd := options.keys() - {"columns", "rows", "caption"}:
            raise ValueError(f"a table of a page states columns, rows and caption, not {', '.join(odd)}: {found[2]!r}")
        lines = ["", *Table.read(folder / f"{found[3]}.csv").markdown(**options).splitlines(), "", found[5]]
        return found[1] + found[2] + "\n".join(found[1] + line if line else "" for line in lines)

    def figure_of(found: re.Match[str]) -> str:
        return f"[{shown(Table.read(folder / f'{found[2]}.csv').figure(found[3].split(','), found[4]))}]{found[1]}"

    return _FIGURE.sub(figure_of, _BLOCK.sub(table_of, text))


def fill_pages(fill: Callable[[str], str] = filled) -> None:
    """Write tables and figures into the pages that show them, or what else `fill` gives."""
    for page in PAGES:
        if (text := page.read_text(encoding="utf-8")) != (new := fill(text)):
            page.write_text(new, encoding="utf-8")


def _same(wanted: str, cell: str) -> bool:
    try:
        return float(wanted) == float(cell)
    except ValueError:
        return wanted == cell


TIMES = 6.0
"""Standard deviations of draws by which two draws may differ: 4.2 of their difference."""


def disagreements(
    entry: Entry, quick: Table, committed: Table, scatter: Table | None = None, factor: float = 1.5
) -> list[str]:
    """Figures of a quick measurement that are not those of the committed table.

    A figure agrees within the factor, or within `TIMES` its `scatter` by the draws (`scatter_of`), or the `within` of
    the entry; one that is noise around zero (`scatter` of the entry) within the factor times its scatter. A text agrees
    where it has one of its alternatives, "a or b", in common with the committed one or the draws.
    """
    if quick.columns != committed.columns:
        return [f"columns {quick.columns}, committed {committed.columns}"]
    found = []
    for row in quick.rows:
        page = committed.matching(row[: quick.keys])[0]
        draws = scatter.matching(row[: quick.keys])[0] if scatter else ("",) * len(row)
        for heading, *cells in list(zip(quick.columns, row, page, draws, strict=True))[quick.keys :]:
            new, old, drawn = cells
            try:
                a, b, spread = float(new), float(old), float(drawn or 0)
            except ValueError:
                close = bool(set(new.split(" or ")) & set(f"{old} or {drawn}".split(" or ")))
            else:
                allowed = max(TIMES * spread, entry.within.get(heading, 0))
                if heading in entry.scatter:
                    allowed = max(allowed, factor * float(page[committed.column(entry.scatter[heading])]))
                elif a * b > 0 and 1 / factor <= a / b <= factor:
                    allowed = np.inf
                unknown = np.isnan(a) or np.isnan(b)
                close = (np.isnan(a) and np.isnan(b)) or np.isnan(spread) if unknown else abs(a - b) <= allowed
            if not close:
                found.append(f"{', '.join(row[: quick.keys])}: {heading} is {new}, committed {old}")
    return found


def scatter_of(entry: Entry, draws: list[Table]) -> Table | None:
    """Standard deviation of every figure over draws of the camera's noise, the first as stated; None without any.

    A figure that is known in some of the draws only scatters by NaN. Of a text, the alternatives in other draws that
    share none with it.
    """
    first, rows = draws[0], []
    for cells in zip(*(table.rows for table in draws), strict=True):
        row: list[str] = list(cells[0][: first.keys])
        for values in list(zip(*cells, strict=True))[first.keys :]:
            try:
                numbers = [float(value) for value in values]
            except ValueError:
                usual = set(values[0].split(" or "))
                others = {
                    one for value in values if not usual & set(value.split(" or ")) for one in value.split(" or ")
                }
                row.append(" or ".join(sorted(others)))
            else:
                row.append(written(0.0 if np.isnan(numbers).all() else float(np.std(numbers, ddof=1))))
        rows.append(tuple(row))
    if all(cell in ("", "0") for row in rows for cell in row[first.keys :]):
        return None
    return Table(entry.name, first.header, first.columns, tuple(rows))


def measured(
    module: str, name: str, quick: bool, header: dict[str, str], scatter: bool = False
) -> tuple[Table | None, float]:
    """One table, or how its figures scatter by `DRAWS` draws of the noise, and the CPU seconds, those of its own child
    processes included; for a process of its own."""
    import cv2
    from draws import other_draws
    from renders import kept_renders

    cv2.setNumThreads(1)
    importlib.import_module(module)
    entry = TABLES[name]
    start = sum(os.times()[:4])
    made = []
    for draw in range(DRAWS if scatter else 1):
        with kept_renders(), other_draws(draw):
            made.append(Table.of(entry, entry.measure(quick), header | {"seed": str(entry.seed)}))
    return scatter_of(entry, made) if scatter else made[0], sum(os.times()[:4]) - start
