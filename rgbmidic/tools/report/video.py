"""Pages of a movie written to a file: by ffmpeg, or as a GIF."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import ResultError

Page = npt.NDArray[np.uint8]
"""Red, green, blue and opacity of a page, (H, W, 4)."""


PALETTE = 256
"""Colours of a GIF, and of a field."""


def encode_video(file: BinaryIO, pages: Iterator[Page], fps: float, encoder: list[str]) -> None:
    """Encode pages by ffmpeg, which gets the whole path of the open file: `-b.mp4` is an option, `file:b.mp4` a URL."""
    first_page, path = next(pages), Path(file.name).absolute()
    rows, columns = first_page.shape[:2]
    exe, *options = encoder
    source = ["-f", "rawvideo", "-pix_fmt", "rgba", "-s", f"{columns}x{rows}", "-r", f"{fps:g}", "-i", "-"]
    padding = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white"]
    command = [exe, "-y", "-loglevel", "error", *source, *padding, *options, str(path)]
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=errors, start_new_session=True)
        pipe = process.stdin
        assert pipe is not None
        try:
            with suppress(BrokenPipeError):  # it says why on stderr
                for page in chain([first_page], pages):
                    pipe.write(page.tobytes())
                pipe.close()
            status = process.wait()
        finally:
            process.kill()
            process.wait()
        errors.seek(0)
        error_lines = errors.read().decode(errors="replace").strip().splitlines()
    if status != 0 or not path.stat().st_size:
        reason = error_lines[-1] if error_lines else f"it ended with status {status} and {path.stat().st_size} bytes"
        raise ResultError(f"ffmpeg could not write the movie: {reason}")


def write_gif(file: BinaryIO, pages: Iterator[Page], fps: float, samples: list[Page]) -> None:
    """Write pages as a GIF, one after the other, with one palette found from some of them."""
    from PIL import GifImagePlugin, Image

    colours = Image.fromarray(np.concatenate(samples)[..., :3]).quantize(PALETTE - 2, dither=Image.Dither.NONE)
    palette = Image.new("P", (1, 1))
    palette.putpalette([0, 0, 0, 255, 255, 255, *(colours.getpalette() or [])])  # the page itself is exact
    previous_time = 0.0
    for number, page in enumerate(pages, 1):
        image = Image.fromarray(page[..., :3]).quantize(palette=palette, dither=Image.Dither.NONE)
        if number == 1:
            for block in GifImagePlugin.getheader(image, info={"loop": 0, "optimize": False})[0]:
                file.write(block)
        end_time = 10 * round(100 * number / fps)  # whole hundredths of a second, which add up to the rate
        for block in GifImagePlugin.getdata(image, duration=end_time - previous_time):
            file.write(block)
        previous_time = end_time
    file.write(b";")
