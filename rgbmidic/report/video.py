"""Pages of a movie written to a file: by ffmpeg, or as a GIF."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from itertools import chain
from pathlib import Path
from threading import Event, Timer
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import ResultError

Page = npt.NDArray[np.uint8]
"""Red, green, blue and opacity of a page, (H, W, 4)."""


PALETTE = 256
"""Colours of a GIF, and of a field."""


def video(file: BinaryIO, pages: Iterator[Page], fps: float, encoder: list[str], patience: float) -> None:
    """Encode pages by ffmpeg; one that neither takes a page nor ends for so many seconds is ended.

    It gets the whole path of the open file: `-b.mp4` is an option, `file:b.mp4` a URL.
    """
    first, path = next(pages), Path(file.name).absolute()
    rows, columns = first.shape[:2]
    exe, *options = encoder
    source = ["-f", "rawvideo", "-pix_fmt", "rgba", "-s", f"{columns}x{rows}", "-r", f"{fps:g}", "-i", "-"]
    even = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white"]
    command = [exe, "-y", "-loglevel", "error", *source, *even, *options, str(path)]
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=errors, start_new_session=True)
        pipe, late = process.stdin, Event()
        assert pipe is not None

        def end() -> None:
            late.set()
            process.kill()

        try:
            with suppress(BrokenPipeError):  # it says why on stderr
                for page in chain([first], pages):
                    _within(patience, partial(pipe.write, page.tobytes()), end)
                _within(patience, pipe.close, end)
            status = _within(patience, process.wait, end)
        finally:
            process.kill()
            process.wait()
        errors.seek(0)
        said = errors.read().decode(errors="replace").strip().splitlines()
    if late.is_set():
        raise ResultError(f"ffmpeg could not write the movie: {exe} did nothing for {patience:g} s and was ended")
    if status != 0 or not path.stat().st_size:
        reason = said[-1] if said else f"it ended with status {status} and {path.stat().st_size} bytes"
        raise ResultError(f"ffmpeg could not write the movie: {reason}")


def _within(seconds: float, act: Callable[[], Any], late: Callable[[], object]) -> Any:
    """Call `act`; `late` is called where that takes longer, and lets it end."""
    timer = Timer(seconds, late)
    timer.daemon = True  # an interrupted program does not wait for it
    try:
        timer.start()
        return act()
    finally:
        timer.cancel()


def gif(file: BinaryIO, pages: Iterator[Page], fps: float, samples: list[Page]) -> None:
    """Write pages as a GIF, one after the other, with one palette found from some of them."""
    from PIL import GifImagePlugin, Image

    colours = Image.fromarray(np.concatenate(samples)[..., :3]).quantize(PALETTE - 2, dither=Image.Dither.NONE)
    palette = Image.new("P", (1, 1))
    palette.putpalette([0, 0, 0, 255, 255, 255, *(colours.getpalette() or [])])  # the page itself is exact
    shown = 0.0
    for number, page in enumerate(pages, 1):
        image = Image.fromarray(page[..., :3]).quantize(palette=palette, dither=Image.Dither.NONE)
        if number == 1:
            for block in GifImagePlugin.getheader(image, info={"loop": 0, "optimize": False})[0]:
                file.write(block)
        until = 10 * round(100 * number / fps)  # whole hundredths of a second, which add up to the rate
        for block in GifImagePlugin.getdata(image, duration=until - shown):
            file.write(block)
        shown = until
    file.write(b";")
