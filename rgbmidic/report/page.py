"""Pages of a report as HTML: headings, tables, pictures in one file."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from pathlib import Path

from rgbmidic.errors import legible

_STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:64rem;margin:2rem auto;padding:0 1rem;color:#222}
h1{line-height:1.2}h2{margin-top:2.2rem;border-bottom:1px solid #ccc}
.table{overflow-x:auto}table{border-collapse:collapse;font-size:13px;margin:1rem 0}
td,th{border:1px solid #ccc;padding:.25rem .5rem;text-align:left;vertical-align:top;overflow-wrap:anywhere}
td:first-child,th{overflow-wrap:normal}th{background:#f3f3f3}
img{max-width:100%;max-height:54rem}figcaption{color:#555;font-size:13px}figure{margin:1rem 0}
@media print{@page{size:A4;margin:14mm}body{font-size:10pt;max-width:none;margin:0;padding:0}table{font-size:8.5pt}
figure,tr,li{break-inside:avoid}h1,h2{break-after:avoid}thead{display:table-header-group}
img{max-height:112mm}.table{overflow:visible}}"""


class Page:
    """A page of text, tables and pictures, collected in order as Markdown and as HTML.

    Parameters
    ----------
    title
        Its title.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self._markdown = [f"# {title}"]
        self._html = [f"<h1>{html.escape(title)}</h1>"]

    def heading(self, text: str) -> None:
        """Add the heading of a section.

        Parameters
        ----------
        text
            The heading.
        """
        self._markdown.append(f"## {text}")
        self._html.append(f"<h2>{html.escape(text)}</h2>")

    def text(self, text: str) -> None:
        """Add a paragraph; words between backquotes are code.

        Parameters
        ----------
        text
            The paragraph.
        """
        self._markdown.append(text)
        self._html.append(f"<p>{_inline(text)}</p>")

    def bullets(self, texts: Sequence[str]) -> None:
        """Add a list of texts; words between backquotes are code.

        Parameters
        ----------
        texts
            One text a bullet.
        """
        self._markdown.append("\n".join(f"- {text}" for text in texts))
        self._html.append("<ul>" + "".join(f"<li>{_inline(text)}</li>" for text in texts) + "</ul>")

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table of texts.

        Parameters
        ----------
        header
            Names of the columns.
        rows
            Cells of each row.
        """
        lines = [header, ["---"] * len(header), *rows]
        cells = (" | ".join(cell.replace("|", "\\|") for cell in line) for line in lines)
        self._markdown.append("\n".join(f"| {line} |" for line in cells))
        head = "".join(f"<th>{_inline(cell)}</th>" for cell in header)
        body = "".join("<tr>" + "".join(f"<td>{_inline(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        self._html.append(f'<div class="table">{table}</div>')

    def picture(self, source: str, caption: str) -> None:
        """Add a picture with a caption.

        Parameters
        ----------
        source
            A file in the page's folder, or a data URL (`rgbmidic.report.style.embedded`).
        caption
            Its caption.
        """
        self._markdown.append(f"![{caption}]({source})\n\n*{caption}*")
        source, caption = html.escape(source), html.escape(caption)
        self._html.append(f'<figure><img src="{source}" alt="{caption}"><figcaption>{caption}</figcaption></figure>')

    @property
    def html(self) -> str:
        """The page as HTML."""
        title, body = html.escape(self.title), "\n".join(self._html)
        return legible(
            f'<!doctype html><html lang="en"><meta charset="utf-8">'
            f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>'
            f"<style>{_STYLE}</style>{body}</html>\n"
        )

    def write(self, folder: Path) -> tuple[Path, Path]:
        """Write the page into a folder.

        Parameters
        ----------
        folder
            An existing folder.

        Returns
        -------
        tuple of Path
            ``report.md`` and ``report.html``.
        """
        markdown, page = folder / "report.md", folder / "report.html"
        markdown.write_text(legible("\n\n".join(self._markdown) + "\n"), encoding="utf-8")
        page.write_text(self.html, encoding="utf-8")
        return markdown, page


def _inline(text: str) -> str:
    """Return text as HTML, with words between backquotes as code and ``[name](page.html)`` as a link."""
    text = re.sub("`([^`]*)`", r"<code>\1</code>", html.escape(text))
    return re.sub(r"\[([^\[\]]*)\]\(([\w%./+-]+\.html)\)", r'<a href="\2">\1</a>', text)
