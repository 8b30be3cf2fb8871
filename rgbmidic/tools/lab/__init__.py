"""The laboratory: virtual experiments, planning, inspection, the demonstration; its documents."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rgbmidic._version import __version__
from rgbmidic.arguments import to_plain
from rgbmidic.disk import write_errors, write_json, write_text
from rgbmidic.errors import ResultError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["check_folder", "write_findings"]


def check_folder(out: Path, files: Sequence[str], *, overwrite: bool) -> None:
    """Refuse a folder in which one of the files would be overwritten.

    Parameters
    ----------
    out
        The folder; it need not exist.
    files
        Names of the files that will be written.
    overwrite
        Whether they may be replaced.

    Raises
    ------
    ResultError
        `out` is a file, or holds one of the files and `overwrite` is False.
    """
    if out.exists() and not out.is_dir():
        raise ResultError(f"{out} is a file; state a folder")
    existing = [name for name in files if (out / name).exists()]
    if existing and not overwrite:
        raise ResultError(
            f"{out / existing[0]} is already there; choose another folder, or overwrite it (`overwrite=True`)"
        )


def format_number(value: float, form: str = ".3g") -> str:
    """Write a number in a format of Python's; a dash where it is not finite."""
    return format(value, form) if math.isfinite(value) else "-"


def schema_document(kind: str, figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return figures as plain values under the name of their schema, for JSON; a number that is not known is null."""
    content: dict[str, Any] = to_plain({"schema": f"rgbmidic-{kind}", "rgbmidic": __version__, **figures})
    return content


def write_findings(out: Path, files: Sequence[str], *contents: dict[str, Any] | str | Figure, overwrite: bool) -> None:
    """Write documents (JSON), texts and figures into a folder, which is made where it does not exist.

    Parameters
    ----------
    out
        The folder.
    files
        Names of the files.
    *contents
        What they hold, in their order.
    overwrite
        Whether files of these names may be replaced.

    Raises
    ------
    ResultError
        A file is already there, or cannot be written.
    """
    from rgbmidic.tools.report.style import save_figure

    check_folder(out, files, overwrite=overwrite)
    for path, content in zip((out / name for name in files), contents, strict=True):
        with write_errors(path):
            out.mkdir(parents=True, exist_ok=True)
            if isinstance(content, dict):
                write_json(path, content)
            elif isinstance(content, str):
                write_text(path, content)
            else:
                save_figure(content, path)
