"""Sphinx extension: tables and figures of docs/tables in the pages, so that no figure is typed by hand.

    ```{measured} sphere
    :columns: light images, angle [deg], rms error [px]
    :rows: 3-CCD; Bayer, 8
    ```

shows a table (or some of its columns, or the rows whose first cells are the ones named) with its caption (or another,
`:caption:`), date and commit; {measured}`sphere | Bayer, 8 | rms error [px]` is one figure. An unknown table, row or
column is an error.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.util.docutils import SphinxDirective, SphinxRole

sys.path.append(str(Path(__file__).resolve().parents[2]))

from benchmarks.tables import FOLDER, Table


def _number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _shown(cell: str) -> str:
    return "–" if cell == "nan" else cell.replace("-", "−") if _number(cell) else cell


class MeasuredTable(SphinxDirective):
    """The directive `measured`: a table of docs/tables."""

    required_arguments = 1
    option_spec = dict.fromkeys(("columns", "rows", "caption"), directives.unchanged_required)

    def run(self) -> list[nodes.Node]:
        """Docutils table with a caption."""
        path = FOLDER / f"{self.arguments[0]}.csv"
        self.env.note_dependency(str(path))
        try:
            table = Table.read(path)
            names = self.options.get("columns", "")
            columns = [table.column(n.strip()) for n in names.split(",")] if names else range(len(table.columns))
            chosen = self.options.get("rows", "")
            rows = [r for part in chosen.split(";") for r in table.matching(part.split(","))] if chosen else table.rows
        except ValueError as error:
            raise self.error(str(error)) from error
        made: Any = nodes.table(classes=["measured"])
        made += self._title(table)
        group = nodes.tgroup(cols=len(columns))
        made += group
        group += [nodes.colspec(colwidth=1) for _ in columns]
        right = [all(_number(row[i]) for row in rows) for i in columns]
        head, body = nodes.thead(), nodes.tbody()
        group += [head, body]
        for part, lines in ((head, [table.columns]), (body, rows)):
            for line in lines:
                row = nodes.row()
                part += row
                for i, to_right in zip(columns, right, strict=True):
                    entry = nodes.entry(classes=["text-right", "text-end"] if to_right else [])
                    entry += nodes.paragraph(text=_shown(line[i]))
                    row += entry
        return [made]

    def _title(self, table: Table) -> nodes.title:
        """Caption, and small where it comes from."""
        parsed, messages = self.parse_inline(self.options.get("caption", table.header.get("caption", "")) + " ")
        title = nodes.title("", "", *parsed, *messages)
        origin = f"(measured {table.header.get('date', '')} at commit {table.header.get('commit', '')} by "
        small = nodes.inline(classes=["small", "measured-origin"])
        small += [nodes.Text(origin), nodes.literal(text=table.header.get("command", "")), nodes.Text(")")]
        title += small
        return title


class MeasuredFigure(SphinxRole):
    """The role `measured`: one figure of a table of docs/tables."""

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        """The figure as text."""
        try:
            name, keys, column = (part.strip() for part in self.text.split("|"))
            path = FOLDER / f"{name}.csv"
            self.env.note_dependency(str(path))
            return [nodes.Text(_shown(Table.read(path).figure(keys.split(","), column)))], []
        except ValueError as error:
            message = self.inliner.reporter.error(f"measured figure {self.text!r}: {error}", line=self.lineno)
            return [self.inliner.problematic(self.rawtext, self.rawtext, message)], [message]


def setup(app: Any) -> dict[str, bool]:
    """Add the directive and the role to Sphinx."""
    app.add_directive("measured", MeasuredTable)
    app.add_role("measured", MeasuredFigure())
    return {"parallel_read_safe": True, "parallel_write_safe": True}
