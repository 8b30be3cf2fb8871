"""The pictures that `rgbmidic run` leaves beside a result."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rgbmidic.errors import ResultError
from rgbmidic.report.figures import (
    brightness_figure,
    convergence_figure,
    displacement_figure,
    mask_figure,
    reflection_figure,
    residual_figure,
    save_figure,
    share_figure,
    uncertainty_figure,
)
from rgbmidic.results import Result

__all__ = ["remove_figures", "write_figures"]

_FRAMES = 5
_NAMES = re.compile(
    r"(convergence|residual|brightness|masks|reflections|(displacement|uncertainty|shares)_[0-9]{6,})\.png"
)


def write_figures(result: Result, folder: Path | str, *, frames: int = _FRAMES) -> tuple[Path, ...]:
    """Write convergence, residual and brightness of a test, masks or reflections, and maps of a few frames.

    Parameters
    ----------
    result
        The result.
    folder
        Where the pictures go; made where it does not exist. Pictures of the same names are replaced.
    frames
        Number of frames that get maps of displacement and uncertainty: evenly spaced, the last one included.

    Returns
    -------
    tuple of Path
        The files written.

    Raises
    ------
    ResultError
        The result is damaged or the folder cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultError(f"{folder} cannot be made: {error.strerror or error}") from None
    image = None if result.reference is None else result.reference[0]
    figures = {
        "convergence": convergence_figure(result),
        "residual": residual_figure(result),
        "brightness": brightness_figure(result),
    }
    first = _reference_index(result)
    weights = result.frame(first).weights_thumbnail
    if result.reference is not None and weights.size:
        figures["masks"] = mask_figure(result.reference, weights / 255, result.lights)
    if result.reference is not None and (reflections := reflection_figure(result, first, result.reference)) is not None:
        figures["reflections"] = reflections
    if len(result.lights) > 1:
        figures[f"shares_{len(result) - 1:06d}"] = share_figure(result, len(result) - 1, image)
    for index in _spread(len(result), frames):
        figures[f"displacement_{index:06d}"] = displacement_figure(result, index, image)
        figures[f"uncertainty_{index:06d}"] = uncertainty_figure(result, index, image)
    for name, figure in figures.items():
        save_figure(figure, folder / f"{name}.png")
    return tuple(folder / f"{name}.png" for name in figures)


def remove_figures(folder: Path | str) -> None:
    """Remove the pictures that an earlier run left, which would show another result; nothing else is touched.

    Raises
    ------
    ResultError
        A picture cannot be removed.
    """
    for file in Path(folder).glob("*.png"):
        if _NAMES.fullmatch(file.name):
            try:
                file.unlink()
            except OSError as error:
                raise ResultError(f"{file} cannot be removed: {error.strerror or error}") from None


def _reference_index(result: Result) -> int:
    reference: list[int] = result.provenance.get("settings", {}).get("frames", {}).get("reference", [0])
    return reference[0] if reference[0] < len(result) else 0


def _spread(total: int, count: int) -> list[int]:
    """Indices of `count` frames out of `total`, evenly spaced up to the last one, without the first."""
    first = min(1, total - 1)
    return sorted({int(index) for index in np.linspace(total - 1, first, max(min(count, total), 1)).round()})
