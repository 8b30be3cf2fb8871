"""Pictures in the folder of a result: `rgbmidic run` and `rgbmidic figures` write them, a new run removes them."""

from __future__ import annotations

import multiprocessing
import re
import signal
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rgbmidic.disk import remove_partial_files, write_errors
from rgbmidic.errors import ResultError
from rgbmidic.results import Maps, Result
from rgbmidic.tools.report import style
from rgbmidic.tools.report.figures import (
    MAPS,
    MapDrawer,
    brightness_figure,
    convergence_figure,
    measured_frames,
    residual_figure,
    select_evenly,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REPORT = "report.html"
"""Name of the report that lies in a result's folder."""
_TEST_FIGURES: Mapping[str, Callable[[Result], Figure]] = {
    "convergence": convergence_figure,
    "residual": residual_figure,
    "brightness": brightness_figure,
}
_FRAME_FIGURES: Mapping[str, Callable[[MapDrawer, int], Figure | None]] = {
    **{kind: partial(MapDrawer.kind, kind=kind) for kind in MAPS},
    "fractions": lambda maps, frame: maps.fractions(frame) if len(maps.result.lights) > 1 else None,
    "masks": MapDrawer.masks,
    "discretisation": MapDrawer.discretisation,
    "reflections": MapDrawer.reflections,
}
_NAMES = re.compile(rf"({'|'.join(_TEST_FIGURES)}|({'|'.join(_FRAME_FIGURES)}|map_.+)_[0-9]{{6,}})\.png")
_Picture = tuple[str, int | None]
"""Kind of a picture, and its frame if it is of one."""


def write_figures(
    maps: Maps, folder: Path | str, frames: Sequence[int] | None = None, *, processes: int = 1, min_pictures: int = 20
) -> tuple[Path, ...]:
    """Write figures of convergence, residual and brightness, and of some frames maps, masks and reflections.

    Parameters
    ----------
    maps
        The fields of a result.
    folder
        Where the pictures go; made where it does not exist. Pictures of the same names are replaced.
    frames
        Indices of the frames that get pictures; None: three deformed ones that did not fail, evenly spaced, the
        last of them included.
    processes
        Number of processes that draw, this one included. With more than one, a script that calls this function must
        be importable (``if __name__ == "__main__":``).
    min_pictures
        Pictures below which another process does not pay. Measured: it starts in 1 to 2 s, a picture takes 0.15 s.

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

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from rgbmidic.results import Result
    >>> maps = Maps.from_result(Result.open("my_result"))
    >>> with TemporaryDirectory() as folder:
    ...     pictures = write_figures(maps, folder, frames=[])
    >>> pictures[0].name
    'convergence.png'
    """
    folder, result = Path(folder), maps.result
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        remove_partial_files(folder, "*")
    frames = _default_frames(result) if frames is None else frames
    for frame in frames:
        result.frame(frame)  # an error of one is raised before the first picture
    pictures: list[_Picture] = [(kind, None) for kind in _TEST_FIGURES]
    pictures += [(kind, frame) for frame in frames for kind in _FRAME_FIGURES]
    process_count = max(1, min(processes, len(pictures) // min_pictures))
    # Ctrl-C reaches all processes: the others end silently, this one reports it
    restore_interrupt = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with ProcessPoolExecutor(
        process_count, multiprocessing.get_context("spawn"), initializer=restore_interrupt
    ) as pool:
        futures = [
            pool.submit(_draw, maps, folder, pictures[process_index::process_count])
            for process_index in range(1, process_count)
        ]
        files = {*_draw(maps, folder, pictures[::process_count])}
        try:
            files.update(*(future.result() for future in futures))
        except BrokenExecutor:
            raise ResultError(
                f"a process that drew pictures into {folder} was ended; draw them anew: rgbmidic figures {result.path}"
            ) from None
    return tuple(file for picture in pictures if (file := _file(folder, *picture)) in files)


def write_maps(
    maps: Maps, names: Sequence[str], folder: Path | str, frames: Sequence[int] | None = None, *, hatched: bool = False
) -> tuple[Path, ...]:
    """Write a picture of each field in each frame, its standard uncertainty beside it: ``map_exx_000005.png``.

    Parameters
    ----------
    maps
        The fields of a result.
    names
        Names of fields.
    folder, frames
        As `write_figures`.
    hatched
        Whether values within two standard uncertainties of 0 are hatched.

    Returns
    -------
    tuple of Path
        The files written.

    Raises
    ------
    InputError
        There is no such field or frame, or rates need more frames.
    ResultError
        The result is damaged, or the folder cannot be written.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from rgbmidic.results import Result
    >>> maps = Maps.from_result(Result.open("my_result"))
    >>> with TemporaryDirectory() as folder:
    ...     [picture.name for picture in write_maps(maps, ["u"], folder, frames=[1])]
    ['map_u_000001.png']
    """
    folder, drawer = Path(folder), MapDrawer(maps, style.DPI)
    frame_indices = _default_frames(maps.result) if frames is None else frames
    pictures = [(name, frame) for name in names for frame in frame_indices]
    for name, frame in pictures:
        maps.read(name, frame)  # an error of one is raised before the first picture
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        remove_partial_files(folder, "*")
    files = [_file(folder, f"map_{name.replace(' ', '_')}", frame) for name, frame in pictures]
    for file, (name, frame) in zip(files, pictures, strict=True):
        style.save_figure(drawer.fields(frame, [name], std=True, hatched=hatched), file)
    return tuple(files)


def _default_frames(result: Result) -> tuple[int, ...]:
    """Select the three frames that get pictures where none are named, as in the report."""
    return select_evenly(measured_frames(result), 3)


def _draw(field_maps: Maps, folder: Path, pictures: Sequence[_Picture]) -> list[Path]:
    """Write pictures one after the other, so that only one is in memory; return the files of those that exist."""
    files, drawer = [], MapDrawer(field_maps, style.DPI)
    for kind, frame in pictures:
        figure = _TEST_FIGURES[kind](field_maps.result) if frame is None else _FRAME_FIGURES[kind](drawer, frame)
        if figure is not None:
            files.append(_file(folder, kind, frame))
            style.save_figure(figure, files[-1])
    return files


def _file(folder: Path, kind: str, frame: int | None) -> Path:
    return folder / (f"{kind}.png" if frame is None else f"{kind}_{frame:06d}.png")


def remove_pictures(folder: Path | str) -> None:
    """Remove the figures and the report of an earlier run, since they would show another result; nothing else.

    Parameters
    ----------
    folder
        Folder of the result.

    Raises
    ------
    ResultError
        One of them cannot be removed.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     report = Path(folder) / "report.html"
    ...     report.touch()
    ...     remove_pictures(folder)
    ...     report.exists()
    False
    """
    figure_files = [file for file in (Path(folder) / "figures").glob("*.png") if _NAMES.fullmatch(file.name)]
    for file in (*figure_files, Path(folder) / REPORT):
        with write_errors(file):
            file.unlink(missing_ok=True)
