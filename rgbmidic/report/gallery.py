"""The pictures that `rgbmidic run` leaves beside a result, `rgbmidic figures` draws later, and a new run removes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rgbmidic.report.figures import (
    MAPS,
    brightness_figure,
    convergence_figure,
    map_figure,
    mask_figure,
    reflection_figure,
    residual_figure,
    share_figure,
    shown_frames,
    spread,
)
from rgbmidic.report.style import save_figure
from rgbmidic.results import Result
from rgbmidic.results.files import writing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["REPORT", "remove_figures", "remove_report", "write_figures"]

REPORT = "report.html"
"""Name of the report that lies in a result's folder."""

_FRAMES = 3
_OF_FRAMES = (*MAPS, "shares", "masks", "reflections")
_NAMES = re.compile(rf"(convergence|residual|brightness|({'|'.join(_OF_FRAMES)})_[0-9]{{6,}})\.png")


def write_figures(result: Result, folder: Path | str, frames: Sequence[int] | None = None) -> tuple[Path, ...]:
    """Write convergence, residual and brightness of a test, and of some frames maps, masks and reflections.

    Parameters
    ----------
    result
        The result.
    folder
        Where the pictures go; made where it does not exist. Pictures of the same names are replaced.
    frames
        Indices of the frames that get pictures; None: three deformed ones, evenly spaced, the last one included.

    Returns
    -------
    tuple of Path
        The files written.

    Raises
    ------
    InputError
        There is no such frame.
    ResultError
        The result is damaged or the folder cannot be written.
    """
    folder = Path(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    frames = spread(shown_frames(result), _FRAMES) if frames is None else frames
    for frame in frames:
        result.frame(frame)  # what is wrong with one is told before the first picture
    files = []
    for name, figure in _figures(result, frames):
        files.append(folder / f"{name}.png")
        save_figure(figure, files[-1])
    return tuple(files)


def remove_figures(folder: Path | str) -> None:
    """Remove the pictures that an earlier run left, which would show another result; nothing else is touched.

    Raises
    ------
    ResultError
        A picture cannot be removed.
    """
    for file in Path(folder).glob("*.png"):
        if _NAMES.fullmatch(file.name):
            with writing(file):
                file.unlink()


def remove_report(folder: Path | str) -> None:
    """Remove the report in the folder of a result that was measured anew: it would show another one.

    Raises
    ------
    ResultError
        It cannot be removed.
    """
    with writing(Path(folder) / REPORT):
        (Path(folder) / REPORT).unlink(missing_ok=True)


def _figures(result: Result, frames: Sequence[int]) -> Iterator[tuple[str, Figure]]:
    """Name and content of each picture, one after the other: only one is in memory."""
    yield "convergence", convergence_figure(result)
    yield "residual", residual_figure(result)
    yield "brightness", brightness_figure(result)
    for frame in frames:
        made: dict[str, Figure | None] = {kind: map_figure(result, frame, kind) for kind in MAPS}
        made["shares"] = share_figure(result, frame) if len(result.lights) > 1 else None
        made |= {"masks": mask_figure(result, frame), "reflections": reflection_figure(result, frame)}
        yield from ((f"{kind}_{frame:06d}", figure) for kind, figure in made.items() if figure is not None)
