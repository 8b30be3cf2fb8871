"""The pictures that `rgbmidic run` leaves beside a result, `rgbmidic figures` draws later, and a new run removes."""

from __future__ import annotations

import multiprocessing
import re
import signal
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rgbmidic.errors import ResultError
from rgbmidic.report.figures import (
    MAPS,
    brightness_figure,
    convergence_figure,
    fraction_figure,
    map_figure,
    mask_figure,
    measured_frames,
    reflection_figure,
    residual_figure,
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
_OF_TEST: Mapping[str, Callable[[Result], Figure]] = {
    "convergence": convergence_figure,
    "residual": residual_figure,
    "brightness": brightness_figure,
}
_OF_FRAME: Mapping[str, Callable[[Result, int], Figure | None]] = {
    **{kind: partial(map_figure, kind=kind) for kind in MAPS},
    "shares": lambda result, frame: fraction_figure(result, frame) if len(result.lights) > 1 else None,
    "masks": mask_figure,
    "reflections": reflection_figure,
}
_NAMES = re.compile(rf"({'|'.join(_OF_TEST)}|({'|'.join(_OF_FRAME)})_[0-9]{{6,}})\.png")
_FEW = 5
"""Pictures for which another process does not pay: it starts in one to two seconds, a picture takes half of one."""

_Picture = tuple[str, int | None]
"""Kind, and frame if it is of one."""


def write_figures(
    result: Result, folder: Path | str, frames: Sequence[int] | None = None, *, processes: int = 1
) -> tuple[Path, ...]:
    """Write convergence, residual and brightness of a test, and of some frames maps, masks and reflections.

    Parameters
    ----------
    result
        The result.
    folder
        Where the pictures go; made where it does not exist. Pictures of the same names are replaced.
    frames
        Indices of the frames that get pictures; None: three deformed ones that did not fail, evenly spaced, the
        last of them included.
    processes
        How many draw, this one among them. With more than one, a script that calls this must be importable
        (``if __name__ == "__main__":``), as always with processes.

    Returns
    -------
    tuple of Path
        The files written.

    Raises
    ------
    InputError
        There is no such frame.
    ResultError
        The result is damaged, the folder cannot be written, or a process that draws is ended.
    """
    folder = Path(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    frames = spread(measured_frames(result), _FRAMES) if frames is None else frames
    for frame in frames:
        result.frame(frame)  # what is wrong with one is told before the first picture
    pictures: list[_Picture] = [(kind, None) for kind in _OF_TEST]
    pictures += [(kind, frame) for frame in frames for kind in _OF_FRAME]
    parts = max(1, min(processes, len(pictures) // _FEW))
    with ProcessPoolExecutor(parts, multiprocessing.get_context("spawn"), initializer=_end_when_interrupted) as pool:
        bare = replace(result)  # without the quantities that were read, which each process reads for itself
        others = [pool.submit(_draw, bare, folder, pictures[part::parts]) for part in range(1, parts)]
        drawn = {*_draw(result, folder, pictures[::parts])}
        try:
            drawn.update(*(other.result() for other in others))
        except BrokenExecutor:
            raise ResultError(
                f"a process that drew pictures into {folder} was ended; draw them anew: rgbmidic figures {result.path}"
            ) from None
    return tuple(file for picture in pictures if (file := _file(folder, *picture)) in drawn)


def _end_when_interrupted() -> None:
    """Ctrl-C reaches all processes: this one ends without a word, the first one tells."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _draw(result: Result, folder: Path, pictures: Sequence[_Picture]) -> list[Path]:
    """Write pictures, one after the other, so that only one is in memory; the files of those that there are."""
    files = []
    for kind, frame in pictures:
        figure = _OF_TEST[kind](result) if frame is None else _OF_FRAME[kind](result, frame)
        if figure is not None:
            files.append(_file(folder, kind, frame))
            save_figure(figure, files[-1])
    return files


def _file(folder: Path, kind: str, frame: int | None) -> Path:
    return folder / (f"{kind}.png" if frame is None else f"{kind}_{frame:06d}.png")


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
