"""The laboratory: virtual experiments, the paper's measures, planning, inspection, the demonstration; its documents."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rgbmidic.errors import ResultError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["check_folder", "number_or_none", "write_findings"]


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


def number_or_none(value: float) -> float | None:
    """Return a number for a JSON document, which has neither NaN nor infinity: None for these.

    Parameters
    ----------
    value
        The number.

    Returns
    -------
    float or None
    """
    return float(value) if math.isfinite(value) else None


def write_findings(out: Path, name: str, document: Mapping[str, Any], figure: Figure) -> None:
    """Write a document as NAME.json and a figure as NAME.png into a folder, which is made where it does not exist.

    Parameters
    ----------
    out
        The folder.
    name
        Name of both files, without ending.
    document
        Content of the JSON file.
    figure
        Figure of matplotlib.

    Raises
    ------
    ResultError
        A file cannot be written.
    """
    from rgbmidic.report.style import save_figure

    path = out / f"{name}.json"
    try:
        out.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise ResultError(f"{path} cannot be written: {error.strerror or error}") from None
    save_figure(figure, path.with_suffix(".png"))
