"""The laboratory: virtual experiments, the paper's measures, planning, inspection, the demonstration; its documents."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    taken = [name for name in files if (out / name).exists()]
    if taken and not overwrite:
        raise ResultError(
            f"{out / taken[0]} is already there; choose another folder, or overwrite it (overwrite=True, --overwrite)"
        )


def write_findings(out: Path, contents: Mapping[str, Mapping[str, Any] | str | Figure], *, overwrite: bool) -> None:
    """Write documents (JSON), texts and figures into a folder, which is made where it does not exist.

    Parameters
    ----------
    out
        The folder.
    contents
        By the names of the files.
    overwrite
        Whether files of these names may be replaced.

    Raises
    ------
    ResultError
        A file is already there, or cannot be written.
    """
    from rgbmidic.report.style import save_figure

    check_folder(out, list(contents), overwrite=overwrite)
    for path, content in ((out / name, content) for name, content in contents.items()):
        if not isinstance(content, str | Mapping):
            save_figure(content, path)
            continue
        text = content if isinstance(content, str) else json.dumps(content, indent=2, allow_nan=False) + "\n"
        try:
            out.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ResultError(f"{path} cannot be written: {error.strerror or error}") from None
