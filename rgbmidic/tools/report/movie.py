"""Movies of a result: fields over the reference image or the raw frames, with one colour range for all frames.

The page, with axes, colour bars and texts, is drawn by matplotlib once; a frame changes the pixels of the maps, the
time above them and the cursor of the curve. MP4 and WebM are encoded by ffmpeg, GIF by Pillow.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.disk import check_file, write_complete
from rgbmidic.errors import InputError, ResultError, RgbmidicError, import_optional
from rgbmidic.renamed import state_new_names
from rgbmidic.results import QUANTITIES, Maps, ResultQuantity
from rgbmidic.tools.report import style
from rgbmidic.tools.report.curves import Curve
from rgbmidic.tools.report.figures import field_colours, picture_limits, select_evenly
from rgbmidic.tools.report.painter import OUTSIDE_GREY, ImageWindow, Overlay, pack, paint, palette, reference_picture
from rgbmidic.tools.report.video import Page, encode_video, write_gif
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ENCODERS = {
    ".mp4": "-c:v libx264 -preset fast -crf 18 -pix_fmt yuv420p -movflags +faststart -f mp4",
    ".webm": "-c:v libvpx-vp9 -crf 28 -b:v 0 -deadline realtime -cpu-used 5 -row-mt 1 -pix_fmt yuv420p -f webm",
}
"""Quality at which text of 9 points keeps its edges; both need an even number of rows and columns."""
MOVIES = (*_ENCODERS, ".gif")
"""Endings of the files that `write_movie` writes."""
_Span = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class MovieConstants:
    """Constants of a movie's making, whatever it shows.

    Attributes
    ----------
    sample_size
        Nodal values of each field that its colour range is found from: 500 frames of 8,000 nodes; of more, evenly
        spaced frames count.
    min_frames_per_process
        Frames below which another process does not pay. Measured: it starts in 2 s, a page of 1 Mpx takes 20 ms.
    """

    sample_size: int = 4_000_000
    min_frames_per_process: int = 100


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Panel:
    """A field, the values of its first and last colour, their name, and the smallest and largest value."""

    field: ResultQuantity
    colour_range: _Span
    colours: str
    extremes: FloatArray


@state_new_names
@dataclass(frozen=True, kw_only=True, eq=False)
class FieldMovie:
    """A movie of nodal fields, side by side; blank where not measured.

    Attributes
    ----------
    maps
        The result and how its fields are derived.
    fields
        Names of the fields.
    frames
        Indices of the frames; None: all that are measured.
    limits
        Ends of the colour bar of all fields, or by the name of each; of others, or None: those of all its frames but
        the extreme .5 % at each end.
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
    constants
        How it is made.

    Raises
    ------
    InputError
        A field, a frame, the limits or a number is none of those allowed.

    Examples
    --------
    >>> from rgbmidic.results import Result
    >>> maps = Maps.from_result(Result.open("my_result"))
    >>> movie = FieldMovie(maps=maps, fields=("u", "exx"), limits={"u": (-1.0, 1.0)})
    >>> movie.stated_limits
    {'u': (-1.0, 1.0)}
    """

    maps: Maps
    fields: Sequence[str]
    frames: Sequence[int] | None = None
    limits: _Span | Mapping[str, _Span] | None = None
    images: Callable[[int], AnyArray] | None = None
    curve: Curve | None = None
    colours: str | None = None
    opacity: float = 1.0
    width: int = 1280
    constants: MovieConstants = MovieConstants()

    def __post_init__(self) -> None:
        from matplotlib import colormaps

        if not (320 <= self.width <= 7680 and 0 <= self.opacity <= 1):
            values = f"{self.width} px and {self.opacity:g}"
            raise InputError(f"a movie has 320 to 7680 px and an opacity of 0 to 1, not {values}")
        result = self.maps.result
        if not self.frame_indices:
            raise InputError(f"none of the frames of {result.path} is measured")
        if absent_frames := [frame for frame in self.frame_indices if not 0 <= frame < len(result)]:
            raise InputError(f"there is no frame {absent_frames} in {result.path}, which has {len(result)} frames")
        for low, high in self.stated_limits.values():
            if not low < high:
                raise InputError(f"the colours range from a smaller to a larger value, not {low:g} to {high:g}")
        if not self.fields or any(self.maps.field(name).codes for name in self.fields):
            raise InputError(f"a movie shows fields of numbers, not {', '.join(self.fields) or 'none'}")
        if self.colours is not None and self.colours not in colormaps:
            names = ", ".join(list(colormaps)[:12])
            raise InputError(f'there are no colours "{self.colours}"; there are {names}, ...')
        if self.curve is not None and self.curve.has_times and self.times is None:
            raise InputError("a curve over time needs the frames' times: state frame_rate in [scale]")

    @property
    def frame_indices(self) -> list[int]:
        """Indices of the frames that are shown."""
        finished = self.maps.result.finished
        return np.flatnonzero(finished).tolist() if self.frames is None else list(self.frames)

    @property
    def stated_limits(self) -> Mapping[str, _Span]:
        """Ends of the colour bars that are stated, by field."""
        if self.limits is None or isinstance(self.limits, Mapping):
            return self.limits or {}
        return dict.fromkeys(self.fields, self.limits)

    @cached_property
    def times(self) -> FloatArray | None:
        """Times (T,) of all frames of the result in s; None where not known."""
        return self.maps.physical.seconds

    @cached_property
    def _layout(self) -> tuple[tuple[_Panel, ...], tuple[_Span, _Span]]:
        """Panels and their limits (px) along x and y, from all frames or evenly spaced ones."""
        maps, result, panels, corners = self.maps, self.maps.result, [], [self.maps.result.nodes]
        frames = select_evenly(self.frame_indices, max(2, self.constants.sample_size // len(result.nodes)))
        for frame in frames if self.images is not None else ():
            deformed = maps.deformed_nodes(frame)
            deformed = deformed[np.isfinite(deformed).all(axis=1)]
            if len(deformed):
                corners += [deformed.min(axis=0, keepdims=True), deformed.max(axis=0, keepdims=True)]
        for name in self.fields:
            colour_values, field = [], maps.field(name)
            for frame in frames:
                nodal = maps.read(name, frame)
                colour_values.append(style.ordinary_values(nodal.values, nodal.uncertainty))
            finite_values = np.concatenate(colour_values)
            if not finite_values.size:
                raise InputError(f"{name} is measured in none of the frames of {result.path}")
            limits = self.stated_limits.get(name) or field.fixed_range or style.colour_range(finite_values)
            extremes = np.array([finite_values.min(), finite_values.max()])
            colours = self.colours or field_colours(field)
            panels.append(_Panel(field=field, colour_range=limits, colours=colours, extremes=extremes))
        return tuple(panels), picture_limits(result, np.concatenate(corners))


def write_movie(
    movie: FieldMovie,
    out: Path | str,
    *,
    fps: float = 15.0,
    processes: int = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> Path:
    """Write a movie of nodal fields.

    The pages are the same for any number of processes. Nothing is left under the name of the file unless all of it was
    written.

    Parameters
    ----------
    movie
        What it shows.
    out
        File to write; the ending states the format, one of `MOVIES`.
    fps
        Frames per second of the movie.
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
        The ending or the number of frames per second is none of those allowed, or nothing is measured.
    ResultError
        The result is damaged, or the file cannot be written.

    Examples
    --------
    >>> from rgbmidic.results import Result
    >>> maps = Maps.from_result(Result.open("my_result"))
    >>> movie = FieldMovie(maps=maps, fields=("u",), frames=[1], width=320)
    >>> path = write_movie(movie, "u.gif", overwrite=True)
    >>> path.name, path.unlink()
    ('u.gif', None)
    """
    out = Path(out)
    ending = out.suffix.lower()
    if ending not in MOVIES:
        raise InputError(f"a movie's name ends in {', '.join(MOVIES)}, not {out.name!r}")
    if not 0.1 <= fps <= 240:
        raise InputError(f"a movie has .1 to 240 frames per second, not {fps:g}")
    check_file(out, overwrite=overwrite)
    frame_indices, canvas = movie.frame_indices, _Canvas(movie)
    exe = "" if ending == ".gif" else str(import_optional("imageio_ffmpeg", "movie").get_ffmpeg_exe())
    process_count = max(1, min(processes, len(frame_indices) // movie.constants.min_frames_per_process))

    def pages() -> Iterator[Page]:
        for done, page in enumerate(_pages(canvas, frame_indices, process_count), 1):
            yield page
            if progress is not None:
                progress(done, len(frame_indices), "")

    if exe:
        encoder = [exe, *_ENCODERS[ending].split()]
        write_complete(out, lambda file: encode_video(file, pages(), fps, encoder))
    else:
        samples = [*canvas.mixtures(), *(canvas.page(frame) for frame in select_evenly(frame_indices, 3))]
        write_complete(out, lambda file: write_gif(file, pages(), fps, samples))
    return out


class _Canvas:
    """A page that is drawn once, and the parts of it that change from frame to frame."""

    def __init__(self, movie: FieldMovie) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.colors import Normalize

        self.movie, self._times, (unit, factor) = movie, movie.times, movie.maps.physical.axes
        self._panels, (x, y) = panels, _ = movie._layout

        def draw(axes: list[Axes]) -> None:
            for axis, panel in zip(axes, panels, strict=False):
                style.finish_picture(axis, x, y, has_y_label=axis is axes[0], unit=unit, factor=factor)
                axis.set_title(style.literal(panel.field.label))
                style.add_colour_bar(axis, Normalize(*panel.colour_range), panel.colours, values=panel.extremes)
            if (curve := movie.curve) is not None:
                times, label = style.time_axis(curve.times if curve.has_times else None, curve.times)
                axes[-1].plot(times, curve.values, linewidth=1, color=style.OKABE_ITO["blue"])
                axes[-1].set_title(style.literal(curve.name), pad=15)  # above the power of ten of the numbers
                style.finish_plot(axes[-1], label, "", integer_ticks=not curve.has_times)
                self._factor = style.time_unit(curve.times)[0] if curve.has_times else 1.0
                (self._cursor,) = axes[-1].plot([], [], color="k", linewidth=1.0, animated=True)

        count, aspect = len(panels) + (movie.curve is not None), np.ptp(y) / np.ptp(x)
        self.figure = style.draw_figure(draw, count=count, aspect=aspect, right_room=style.BAR, title=" ")
        self.figure.set_dpi(movie.width / self.figure.get_figwidth())
        texts = {movie.maps.processing_note(panel.field.name) for panel in panels}
        self._note = "; ".join(sorted(text for text in texts if sum(text in longer for longer in texts) == 1))
        canvas: Any = FigureCanvasAgg(self.figure)
        self._canvas, self._title = canvas, self.figure.texts[0]
        self._title.set_fontsize(8)  # two lines have room
        canvas.draw()
        self._background = canvas.copy_from_bbox(self.figure.bbox)
        boxes = [axis.get_window_extent() for axis in self.figure.axes[: len(panels)]]
        height = self.figure.bbox.height  # boxes are from the bottom of the page
        starts = np.ceil([(height - box.y1, box.x0) for box in boxes]).astype(int) + 1
        stops = np.array([(height - box.y0, box.x1) for box in boxes]).astype(int) - 1
        rows, columns = (stops - starts).min(axis=0).tolist()  # panels of one size, however their edges are rounded
        self.boxes = [(slice(row, row + rows), slice(column, column + columns)) for row, column in starts.tolist()]
        # the part of the image that the pixels of the first panel show
        step, (row, column), box = (x[1] - x[0]) / boxes[0].width, starts[0].tolist(), boxes[0]
        x_min, y_min = x[0] + step * (column - box.x0), y[0] + step * (row - height + box.y1)
        edges = {"x_min": x_min, "y_min": y_min, "x_max": x_min + step * columns, "y_max": y_min + step * rows}
        self.window = ImageWindow(**edges, width=columns, height=rows)
        if self._times is not None:  # as many decimals in all frames: a text that changes its length jumps
            factor, unit = style.time_unit(self._times)
            interval = factor * np.nanmedian(np.diff(self._times)) if len(self._times) > 1 else 1.0
            self._clock = factor, unit, max(0, int(np.ceil(-np.log10(interval) - 1e-9)))
        self._reference = reference_picture(movie.maps.result, OUTSIDE_GREY[False])

    def mixtures(self) -> Iterator[Page]:
        """Yield for each panel its colours over all grey levels, as many pixels as a page has."""
        height, width = (int(length) for length in self.figure.bbox.size[::-1])
        grey_part = round(256 * (1 - self.movie.opacity))
        grey = np.linspace(0, 255, height).astype(np.uint32)[:, None] * np.uint32(grey_part) >> np.uint32(8)
        for panel in self._panels:
            colours = pack(palette(panel.colours), grey_part)
            mixed = colours[np.linspace(0, len(colours) - 1, width).astype(int)] + grey * np.uint32(0x010101)
            yield mixed.view(np.uint8).reshape(height, width, 4)

    def page(self, frame: int) -> Page:
        """Draw the page of a frame."""
        movie, canvas, times = self.movie, self._canvas, self._times
        canvas.restore_region(self._background)
        result = movie.maps.result
        status, time = QUANTITIES["status"].codes[result.table.read(frame, ["status"])["status"]], ""
        if times is not None:
            factor, unit, decimals = self._clock
            time = f"{factor * times[frame]:.{decimals}f} {unit}   "
        remark = "" if status == "converged" else f" ({status})"
        self._title.set_text("\n".join(filter(None, (f"{time}frame {frame}{remark}", self._note))))
        self.figure.draw_artist(self._title)
        if movie.curve is not None:
            cursor_time = frame if not movie.curve.has_times or times is None else self._factor * times[frame]
            axis = self.figure.axes[-1]
            self._cursor.set_data([cursor_time, cursor_time], axis.get_ylim())
            axis.draw_artist(self._cursor)
        page = np.array(canvas.buffer_rgba()).view(np.uint32)[..., 0]
        picture = self._reference if movie.images is None else movie.images(frame)
        nodes = result.nodes if movie.images is None else movie.maps.deformed_nodes(frame)
        for box, panel in zip(self.boxes, self._panels, strict=True):
            values = movie.maps.read(panel.field.name, frame).values
            look = {"colour_range": panel.colour_range, "colours": palette(panel.colours), "opacity": movie.opacity}
            overlay = Overlay.of_field(movie.maps, panel.field, nodes, values, **look)
            page[box] = paint(self.window, picture, overlay, OUTSIDE_GREY[False])
        return page.view(np.uint8).reshape(*page.shape, 4)


def _pages(canvas: _Canvas, frames: list[int], processes: int) -> Iterator[Page]:
    """Yield the pages of frames in their order; each process draws every so many of them and waits until they go."""
    if processes == 1:
        yield from map(canvas.page, frames)
        return
    context, receivers = multiprocessing.get_context("spawn"), []
    with ExitStack() as clean_up:
        previous_handler = signal.signal(
            signal.SIGINT, signal.SIG_IGN
        )  # which they inherit: Ctrl-C reaches all processes
        try:
            for process_index in range(processes):
                receive, send = context.Pipe(duplex=False)
                process = context.Process(
                    target=_draw, args=(canvas.movie, frames[process_index::processes], send), daemon=True
                )
                process.start()
                clean_up.callback(process.join)
                clean_up.callback(process.terminate)
                send.close()
                receivers.append(receive)
        finally:
            signal.signal(signal.SIGINT, previous_handler)
        for number in range(len(frames)):
            try:
                page = receivers[number % processes].recv()
            except EOFError:
                raise ResultError("a process that drew pages of the movie was ended; write it again") from None
            if isinstance(page, RgbmidicError):
                raise page
            yield page


def _draw(movie: FieldMovie, frames: list[int], send: Any) -> None:
    """Draw pages in a process of its own; what goes wrong is sent in place of a page."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes: the one that encodes ends them
    try:
        canvas = _Canvas(movie)
        for frame in frames:
            send.send(canvas.page(frame))
    except BrokenPipeError:  # who asked for the pages was killed
        return
    except RgbmidicError as error:
        send.send(error)
