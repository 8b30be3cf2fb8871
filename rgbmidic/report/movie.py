"""Movies of a result: fields over the reference image or the raw frames, with one colour range for all frames.

The page, with axes, colour bars and texts, is drawn by matplotlib once; a frame changes the pixels of the maps, the
time above them and the cursor of the curve. MP4 and WebM are encoded by ffmpeg, GIF by Pillow.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.picture import paint_field
from rgbmidic.errors import InputError, ResultError, RgbmidicError
from rgbmidic.extras import optional
from rgbmidic.report import style
from rgbmidic.report.figures import field_colours, picture_limits, spread
from rgbmidic.report.movie_curve import Curve
from rgbmidic.report.video import PALETTE, Page, gif, video
from rgbmidic.results import QUANTITIES, Maps, Quantity, frame_times
from rgbmidic.results.files import check_file, write_complete
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_SAMPLE = 4_000_000
"""Nodal values of each field that its colour range is found from: 500 frames of 8,000 nodes; of more, evenly spaced
frames count."""
_FEW = 100
"""Frames below which another process does not pay. Measured: it starts in 2 s, a page of 1 Mpx takes 20 ms."""
_AROUND = 235
"""Grey level outside the image, as in the viewer's light page."""
_ENCODERS = {
    ".mp4": "-c:v libx264 -preset fast -crf 18 -pix_fmt yuv420p -movflags +faststart -f mp4",
    ".webm": "-c:v libvpx-vp9 -crf 28 -b:v 0 -deadline realtime -cpu-used 5 -row-mt 1 -pix_fmt yuv420p -f webm",
}
"""Quality at which text of 9 points keeps its edges; both need an even number of rows and columns."""
MOVIES = (*_ENCODERS, ".gif")
"""Endings of the files that `write_movie` writes."""


def write_movie(
    maps: Maps,
    out: Path | str,
    fields: Sequence[str],
    *,
    frames: Sequence[int] | None = None,
    limits: tuple[float, float] | Mapping[str, tuple[float, float]] | None = None,
    fps: float = 15.0,
    images: Callable[[int], AnyArray] | None = None,
    curve: Curve | None = None,
    colours: str | None = None,
    opacity: float = 1.0,
    width: int = 1280,
    processes: int = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> Path:
    """Write a movie of nodal fields, side by side; blank where not measured.

    The pages are the same for any number of processes. Nothing is left under the name of the file unless all of it was
    written.

    Parameters
    ----------
    maps
        The result and how its fields are derived.
    out
        File to write; the ending states the format, one of `MOVIES`.
    fields
        Names of the fields.
    frames
        Indices of the frames; None: all that are measured.
    limits
        Ends of the colour bar of all fields, or by the name of each; of others, or None: those of all its frames but
        the extreme .5 % at each end.
    fps
        Frames per second of the movie.
    images
        Picture (H, W) in grey, 0 to 255, of a frame; the fields then lie over the deformed specimen. None: over the
        reference image.
    curve
        Shown beside the maps, with a cursor.
    colours
        Name of matplotlib's colours; None: as in the viewer.
    opacity
        Of the fields over the image, 0 to 1.
    width
        Of the movie in px.
    processes
        Number of processes that draw. With more than one, a script that calls this function must be importable
        (``if __name__ == "__main__":``).
    overwrite
        Replace a file that is already there.
    progress
        Called after every frame with the number of frames done, their total and an empty line.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        The ending, a field, a frame, the limits or a number is none of those allowed, or nothing is measured.
    ResultError
        The result is damaged, or the file cannot be written.
    """
    out = Path(out)
    if out.suffix.lower() not in MOVIES:
        raise InputError(f"a movie's name ends in {', '.join(MOVIES)}, not {out.name!r}")
    if not (0.1 <= fps <= 240 and 320 <= width <= 7680 and 0 <= opacity <= 1):
        raise InputError(
            f"a movie has .1 to 240 frames per second, 320 to 7680 px and an opacity of 0 to 1, not {fps:g} frames "
            f"per second, {width} px and {opacity:g}"
        )
    check_file(out, overwrite=overwrite)
    chosen = np.flatnonzero(maps.result.finished).tolist() if frames is None else list(frames)
    if beyond := [frame for frame in chosen if not 0 <= frame < len(maps.result)] or not chosen:
        raise InputError(f"there is no frame {beyond} in {maps.result.path}, which has {len(maps.result)} frames")
    drawer = _Drawer.of(maps, tuple(fields), chosen, limits, images=images, curve=curve, colours=colours)
    drawer = replace(drawer, opacity=opacity, width=width)
    exe = "" if out.suffix.lower() == ".gif" else str(optional("imageio_ffmpeg", "movie").get_ffmpeg_exe())
    parts = max(1, min(processes, len(chosen) // _FEW))

    def pages() -> Iterator[Page]:
        for done, page in enumerate(_pages(drawer, chosen, parts), 1):
            yield page
            if progress is not None:
                progress(done, len(chosen), "")

    if exe:
        write_complete(out, lambda file: video(file, pages(), fps, [exe, *_ENCODERS[out.suffix.lower()].split()]))
    else:
        canvas = drawer.opened()
        samples = [*canvas.mixtures(), *(canvas.page(frame) for frame in spread(chosen, 3))]
        write_complete(out, lambda file: gif(file, pages(), fps, samples))
    return out


@dataclass(frozen=True, kw_only=True, eq=False)
class _Drawer:
    """What all pages of a movie share.

    Attributes
    ----------
    maps, images, curve, opacity, width
        As of `write_movie`.
    fields, ends, colours, beyond
        For each panel the field, the values of the first and last colour, the name of the colours, and whether there
        are values below or above.
    times : ndarray, shape (T,), or None
        Of the frames, s.
    limits
        Of the picture along x and y, px.
    """

    maps: Maps
    fields: tuple[Quantity, ...]
    ends: tuple[tuple[float, float], ...]
    colours: tuple[str, ...]
    beyond: tuple[tuple[bool, bool], ...]
    times: FloatArray | None
    limits: tuple[tuple[float, float], tuple[float, float]]
    images: Callable[[int], AnyArray] | None = None
    curve: Curve | None = None
    opacity: float = 1.0
    width: int = 1280

    @classmethod
    def of(
        cls,
        maps: Maps,
        names: tuple[str, ...],
        frames: list[int],
        limits: tuple[float, float] | Mapping[str, tuple[float, float]] | None,
        **more: Any,
    ) -> _Drawer:
        """Find the colours of fields from all frames, or from evenly spaced ones."""
        from matplotlib import colormaps

        fields = tuple(maps.field(name) for name in names)
        given_ends = limits if isinstance(limits, Mapping) else dict.fromkeys(names, limits) if limits else {}
        for low, high in given_ends.values():
            if not low < high:
                raise InputError(f"the colours range from a smaller to a larger value, not {low:g} to {high:g}")
        if not fields or any(field.codes for field in fields):
            raise InputError(f"a movie shows fields of numbers, not {', '.join(names) or 'none'}")
        given = more.pop("colours")
        if given is not None and given not in colormaps:
            raise InputError(f'there are no colours "{given}"; there are {", ".join(list(colormaps)[:12])}, ...')
        result = maps.result
        times = frame_times(result, maps.physical.scale)
        curve = more["curve"]
        if curve is not None and curve.timed and times is None:
            raise InputError("a curve over time needs the frames' times: state frame_rate in [scale]")
        ends, beyond, corners = [], [], [result.nodes]
        for part in fields:
            ordinary: list[FloatArray] = []
            for frame in spread(frames, max(2, _SAMPLE // len(result.nodes))):
                read = maps.read(part.name, frame)
                ordinary.append(style.ordinary_values(read.values, read.std))
                known = np.isfinite(read.moved).all(axis=1)
                if more["images"] is not None and known.any():
                    corners.append(np.stack([read.moved[known].min(axis=0), read.moved[known].max(axis=0)]))
            known_values = np.concatenate(ordinary)
            if not known_values.size:
                raise InputError(f"{part.name} is measured in none of the frames of {result.path}")
            low, high = given_ends.get(part.name) or part.ends or style.colour_range(known_values)
            ends.append((low, high))
            beyond.append((bool(known_values.min() < low), bool(known_values.max() > high)))
        return cls(
            maps=maps,
            fields=fields,
            ends=tuple(ends),
            colours=tuple(given or field_colours(part) for part in fields),
            beyond=tuple(beyond),
            times=times,
            limits=picture_limits(result, np.concatenate(corners)),
            **more,
        )

    def opened(self) -> _Canvas:
        """Draw what all pages share."""
        return _Canvas(self)


class _Canvas:
    """A page that is drawn once, and the parts of it that change from frame to frame."""

    def __init__(self, drawer: _Drawer) -> None:
        from matplotlib import colormaps
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.colors import Normalize

        self._drawer, self._curve = drawer, drawer.curve
        ((left, right), (top, bottom)), (unit, factor) = drawer.limits, drawer.maps.physical.axes

        def draw(axes: list[Axes]) -> None:
            panels = zip(axes, drawer.fields, drawer.ends, drawer.colours, drawer.beyond, strict=False)
            for axis, part, ends, colours, beyond in panels:
                style.finish_picture(
                    axis, (left, right), (top, bottom), first=axis is axes[0], unit=unit, factor=factor
                )
                axis.set_title(style.literal(part.label))
                style.add_colour_bar(axis, Normalize(*ends), colours, beyond=beyond)
            if drawer.curve is not None:
                self._draw_curve(axes[-1], drawer.curve)

        count = len(drawer.fields) + (drawer.curve is not None)
        aspect = (bottom - top) / (right - left)
        self.figure = style.draw_figure(draw, count=count, aspect=aspect, beside=style.BAR, title=" ")
        self.figure.set_dpi(drawer.width / self.figure.get_figwidth())
        texts = {drawer.maps.how(part.name) for part in drawer.fields}
        self._how = "; ".join(sorted(text for text in texts if sum(text in other for other in texts) == 1))
        canvas: Any = FigureCanvasAgg(self.figure)
        self._canvas = canvas
        self._title = self.figure.texts[0]
        self._title.set(visible=False, fontsize=8)  # two lines have room
        canvas.draw()
        self._title.set_visible(True)
        self._bare = canvas.copy_from_bbox(self.figure.bbox)
        self._boxes = []
        for axis in self.figure.axes[: len(drawer.fields)]:
            box = axis.get_window_extent()  # from the bottom of the page
            rows = slice(int(np.ceil(self.figure.bbox.height - box.y1)) + 1, int(self.figure.bbox.height - box.y0) - 1)
            self._boxes.append((rows, slice(int(np.ceil(box.x0)) + 1, int(box.x1) - 1), box))
        solid = np.uint32(round(256 * drawer.opacity))
        self._grey_part = 256 - int(solid)
        self._packed = []
        for name in drawer.colours:
            red, green, blue = (colormaps[name](np.arange(PALETTE) / (PALETTE - 1))[:, :3].T * 255).astype(np.uint32)
            parts = [part * solid >> np.uint32(8) for part in (red, green, blue)]
            self._packed.append(parts[0] | parts[1] << 8 | parts[2] << 16 | np.uint32(0xFF000000))
        if drawer.times is not None:  # as many decimals in all frames: a text that changes its length jumps
            factor, unit = style.time_unit(drawer.times)
            interval = factor * np.nanmedian(np.diff(drawer.times)) if len(drawer.times) > 1 else 1.0
            self._clock = factor, unit, max(0, int(np.ceil(-np.log10(interval) - 1e-9)))
        result = drawer.maps.result
        reference = None if result.reference is None else result.reference.mean(axis=0).astype(np.uint8)
        self._reference = None if reference is None else self._resampled(reference, result.reference_origin)

    def _draw_curve(self, axis: Axes, curve: Curve) -> None:
        times, label = style.time_axis(curve.times if curve.timed else None, curve.times)
        axis.plot(times, curve.values, linewidth=1, color=style.OKABE_ITO["blue"])
        axis.set_title(style.literal(curve.name), pad=15)  # above the power of ten of the numbers
        style.finish_plot(axis, label, "", whole=not curve.timed)
        self._factor = style.time_unit(curve.times)[0] if curve.timed else 1.0
        (self._cursor,) = axis.plot([], [], color="k", linewidth=1.0, animated=True)

    def _resampled(self, image: AnyArray, origin: tuple[int, int] = (0, 0)) -> npt.NDArray[np.uint8]:
        """Resample an image, which begins at `origin`, in the first panel; all have its size."""
        import cv2

        rows, columns, _ = self._boxes[0]
        (step, left), (_, top) = self._steps()
        factor = max(1, int(step))
        small: AnyArray = np.asarray(image, dtype=np.uint8)
        if factor > 1:  # reduced by a whole factor first, against moiré
            height, width = (size // factor * factor for size in small.shape)
            size = (width // factor, height // factor)
            small = cv2.resize(small[:height, :width], size, interpolation=cv2.INTER_AREA)
        shift = (factor - 1) / 2
        to_image = np.array([[step, 0, left - origin[0] - shift], [0, step, top - origin[1] - shift]]) / factor
        shape = (columns.stop - columns.start, rows.stop - rows.start)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(small, to_image, shape, flags=flags, borderValue=float(_AROUND)), np.uint8)

    def _steps(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return px of the image to a pixel of the panel, and the place of the first pixel, along x and y."""
        rows, columns, box = self._boxes[0]
        (left, right), (top, _) = self._drawer.limits
        step = (right - left) / box.width
        above = self.figure.bbox.height - box.y1
        return (step, left + step * (columns.start + 0.5 - box.x0)), (step, top + step * (rows.start + 0.5 - above))

    def mixtures(self) -> Iterator[Page]:
        """Yield for each panel its colours over all grey levels, as many pixels as a page has."""
        height, width = (int(side) for side in self.figure.bbox.size[::-1])
        grey = np.linspace(0, 255, height).astype(np.uint32)[:, None] * np.uint32(self._grey_part) >> np.uint32(8)
        for packed in self._packed:
            mixed = packed[np.linspace(0, PALETTE - 1, width).astype(int)][None] + grey * np.uint32(0x010101)
            yield mixed.astype(np.uint32).view(np.uint8).reshape(height, width, 4)

    def page(self, frame: int) -> Page:
        """Draw the page of a frame."""
        drawer, canvas = self._drawer, self._canvas
        canvas.restore_region(self._bare)
        result = drawer.maps.result
        status = QUANTITIES["status"].codes[next(result.each("status", [frame]))]
        time = (
            ""
            if drawer.times is None
            else f"{self._clock[0] * drawer.times[frame]:.{self._clock[2]}f} {self._clock[1]}   "
        )
        remark = "" if status == "converged" else f" ({status})"
        self._title.set_text("\n".join(filter(None, (f"{time}frame {frame}{remark}", self._how))))
        self.figure.draw_artist(self._title)
        if self._curve is not None:
            now = frame if not self._curve.timed or drawer.times is None else self._factor * drawer.times[frame]
            axis = self.figure.axes[-1]
            self._cursor.set_data([now, now], axis.get_ylim())
            axis.draw_artist(self._cursor)
        page: npt.NDArray[np.uint32] = np.array(canvas.buffer_rgba()).view(np.uint32)[..., 0]
        grey = self._reference if drawer.images is None else self._resampled(drawer.images(frame))
        (step, left), (_, top) = self._steps()
        boxes = zip(self._boxes, drawer.fields, drawer.ends, self._packed, strict=True)
        for (rows, columns, _), part, ends, packed in boxes:
            read = drawer.maps.read(part.name, frame)
            panel = np.empty((rows.stop - rows.start, columns.stop - columns.start), dtype=np.uint32)
            under = np.full(panel.shape, _AROUND, dtype=np.uint8) if grey is None else grey
            x, y = ((read.moved if drawer.images is not None else result.nodes) - (left, top)).T / step
            place = [np.ascontiguousarray(axis, dtype=np.float64) for axis in (x, y)]
            paint_field(
                panel, under, *place, result.elements, read.values, *map(float, ends), packed, self._grey_part,
                part.stepped,
            )  # fmt: skip
            page[rows, columns] = panel
        return page.view(np.uint8).reshape(*page.shape, 4)


def _pages(drawer: _Drawer, frames: list[int], processes: int) -> Iterator[Page]:
    """Yield the pages of frames in their order; each process draws every so many of them and waits until they go."""
    if processes == 1:
        canvas = drawer.opened()
        yield from map(canvas.page, frames)
        return
    maps = replace(
        drawer.maps, result=replace(drawer.maps.result)
    )  # without what was read, which each reads for itself
    drawer = replace(drawer, maps=maps)
    context, started, ends = multiprocessing.get_context("spawn"), [], []
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # which they inherit: Ctrl-C reaches all processes
    try:
        try:
            for part in range(processes):
                receive, send = context.Pipe(duplex=False)
                process = context.Process(target=_draw, args=(drawer, frames[part::processes], send), daemon=True)
                process.start()
                send.close()
                started.append(process)
                ends.append(receive)
        finally:
            signal.signal(signal.SIGINT, before)
        for number in range(len(frames)):
            try:
                page = ends[number % processes].recv()
            except EOFError:
                raise ResultError("a process that drew pages of the movie was ended; write it again") from None
            if isinstance(page, RgbmidicError):
                raise page
            yield page
    finally:
        for process in started:
            process.terminate()
            process.join()


def _draw(drawer: _Drawer, frames: list[int], send: Any) -> None:
    """Draw pages in a process of its own; what goes wrong is sent in place of a page."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes: the one that encodes ends them
    try:
        canvas = drawer.opened()
        for frame in frames:
            send.send(canvas.page(frame))
    except BrokenPipeError:  # who asked for the pages was killed
        return
    except RgbmidicError as error:
        send.send(error)
