"""The site's pages are the repository's: links as they stand there, files outside docs/, formulas as MathML."""

from __future__ import annotations

import os
import re
from pathlib import Path

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

logger = logging.getLogger(__name__)

DOCS = Path(__file__).resolve().parents[1]
ROOT = DOCS.parent
OUTSIDE = {
    "README.md": "index",
    "calibration/README.md": "how-to/calibration",
    "CHANGELOG.md": "changelog",
    "CONTRIBUTING.md": "contributing",
    "CODE_OF_CONDUCT.md": "conduct",
    "SECURITY.md": "security",
}
"""Pages that include a file from outside docs/, and the one in place of the README."""


def rewritten(text: str, folder: Path, page: Path) -> str:
    """A page's text with links to repository files that Sphinx resolves: pages by name, other files as downloads.

    Parameters
    ----------
    text
        As it stands in a file of `folder`, where its links start.
    folder
        Folder of the file.
    page
        Folder of the page that the text becomes part of.
    """

    def link(found: re.Match[str]) -> str:
        label, target, anchor = found[1], found[2], found[3] or ""
        path = (folder / target).resolve()
        if target.startswith(("http", "/")) or not path.is_relative_to(ROOT):
            return found[0]
        name = path.relative_to(ROOT).as_posix()
        if name in OUTSIDE:
            return f"{label}(/{OUTSIDE[name]}.md{anchor})"
        if name.startswith("examples/") and name.count("/") == 1 and path.suffix == ".py":
            return f"{label}(/{name.removesuffix('.py')}.rst)"
        if name == "examples":
            return f"{label}(/examples/index.rst)"
        if path.is_dir():
            return f"{label[label.index('[') + 1 : -1]}" if label.startswith("[") else label
        if path.is_relative_to(DOCS):
            return f"{label}(/{path.relative_to(DOCS).as_posix()}{anchor})"
        return f"{label}({os.path.relpath(path, page)}{anchor})"

    text = re.sub(r'\[([^\[\]]*)\]\(\S*tables/\w+\.csv "[^"]*"\)', r"\1", text)  # a figure is no link on the site
    parts = re.split(r"(^```.*?^```)", text, flags=re.DOTALL | re.MULTILINE)
    whole = re.compile(r"(!?\[[^\[\]]*\])\(([^)#\s]+)(#[^)\s]*)?\)")
    return "".join(part if n % 2 else whole.sub(link, part) for n, part in enumerate(parts))


def _read(app: Sphinx, docname: str, source: list[str]) -> None:
    page = Path(app.env.doc2path(docname))
    if page.suffix == ".md":
        source[0] = rewritten(source[0], page.parent, page.parent)


def _included(app: Sphinx, path: Path, docname: str, source: list[str]) -> None:
    folder = (Path(app.srcdir) / path).resolve().parent
    source[0] = rewritten(source[0], folder, Path(app.env.doc2path(docname)).parent)


def _formula(translator: nodes.NodeVisitor, node: nodes.math | nodes.math_block) -> None:
    block = isinstance(node, nodes.math_block)
    try:
        formula = tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        logger.warning("formula %r: %s", node.astext(), error, location=node)
        formula = translator.encode(node.astext())
    translator.body.append(f'<div class="math">{formula}</div>\n' if block else formula)
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("source-read", _read)
    app.connect("include-read", _included)
    app.add_html_math_renderer("mathml", (_formula, None), (_formula, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
