"""The page of the study, as Markdown and by the template ``page_of_study.html`` as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rgbmidic.tools.report import render


class Page:
    """Headings, texts, tables and pictures, collected in order."""

    def __init__(self, title: str) -> None:
        self.title = title
        self._blocks: list[tuple[str, Any]] = []
        self._markdown = [f"# {title}"]

    def heading(self, text: str) -> None:
        self._add("heading", text, f"## {text}")

    def text(self, text: str) -> None:
        """Words between backquotes are code."""
        self._add("text", text, text)

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        lines = [header, ["---"] * len(header), *rows]
        cells = (" | ".join(cell.replace("|", "\\|") for cell in line) for line in lines)
        self._add("table", (header, rows), "\n".join(f"| {line} |" for line in cells))

    def picture(self, file: str, caption: str) -> None:
        self._add("picture", (file, caption), f"![{caption}]({file})\n\n*{caption}*")

    def _add(self, kind: str, content: Any, markdown: str) -> None:
        self._blocks.append((kind, content))
        self._markdown.append(markdown)

    def write(self, folder: Path) -> None:
        """Write ``report.md`` and ``report.html``."""
        page = render("page_of_study.html", Path(__file__).parent, title=self.title, blocks=self._blocks)
        (folder / "report.md").write_text("\n\n".join(self._markdown) + "\n", encoding="utf-8")
        (folder / "report.html").write_text(page, encoding="utf-8")
