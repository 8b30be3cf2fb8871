"""The laboratory: virtual experiments, the paper's measures, planning, inspection, the demonstration; its documents."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rgbmidic.errors import ResultError

__all__ = ["check_folder", "number_or_none", "write_document"]


def check_folder(out: Path, files: Sequence[str], *, overwrite: bool) -> None:
    """Refuse a folder in which one of the files would be overwritten.

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
    """Return a number for a JSON document, which has neither NaN nor infinity: None for these."""
    return float(value) if math.isfinite(value) else None


def write_document(document: Mapping[str, Any], path: Path) -> None:
    """Write a document as JSON; its folder is made where it does not exist.

    Raises
    ------
    ResultError
        The file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise ResultError(f"{path} cannot be written: {error.strerror or error}") from None
