"""Pages as HTML in one file, by the templates beside this module."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from rgbmidic.errors import printable
from rgbmidic.text import format_value, format_with_std
from rgbmidic.tools.report import style

_TEMPLATES = Path(__file__).with_name("templates")


def render(template: str, folder: Path = _TEMPLATES, **values: Any) -> str:
    """Fill a template in.

    It has three filters beside those of jinja2: ``code`` writes words between backquotes as code, ``gaps`` writes a
    paragraph on one line and marks words between brackets, ``data_url`` makes the address of a picture of a figure; and
    `rgbmidic.text.format_value` and `format_with_std`.

    Parameters
    ----------
    template
        Name of its file; what is filled into a file that ends in ``.html`` is escaped.
    folder
        Its folder; it may use the templates of this package.
    **values
        What it names.

    Returns
    -------
    str
        The page.

    Examples
    --------
    >>> render("batch.html", header=["test", "status"], rows=[], links=[], version="1").startswith("<!")
    True
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
    from markupsafe import Markup, escape

    environment = Environment(
        loader=FileSystemLoader([folder, _TEMPLATES]),
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "code": lambda text: Markup(re.sub("`([^`]*)`", r"<code>\1</code>", str(escape(text)))),
        "gaps": lambda text: Markup(re.sub(r"(\[[^\]]*\])", r"<mark>\1</mark>", " ".join(escape(text).split()))),
        "data_url": style.data_url,
    }
    environment.globals |= {"format_value": format_value, "format_with_std": format_with_std}
    return printable(environment.get_template(template).render(values))
