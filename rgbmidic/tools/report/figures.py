"""Figures of a result: maps of its fields, and quantities over frames and iterations; `save_figure` writes them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.results import QUANTITIES, REFLECTING, FrameRecord, Maps, Result, ResultQuantity
from rgbmidic.results.quantities import FAILED
from rgbmidic.tools.report import style
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

MAPS = {
    "displacement": ("u", "v"),
    "uncertainty": ("u_std", "v_std"),
    "strain": ("exx", "eyy", "exy"),
    "misfit": ("misfit",),
}
"""Fields of each kind of map."""
_COLOURS = {"positive": "plasma", "fraction": "cividis", "angle": "twilight"}
"""Colours of the kinds of fields; all others have viridis."""


def frames_to_draw(result: Result) -> tuple[int, ...]:
    """Select the deformed frames that are measured; else all that are measured; else all of the test."""
    finished = result.finished
    deformed = tuple(index for index in result.deformed if finished[index])
    return deformed or tuple(np.flatnonzero(finished).tolist()) or tuple(range(len(result)))


def measured_frames(result: Result) -> tuple[int, ...]:
    """Select those of `frames_to_draw` that did not fail; all of them where all failed."""
    candidates = frames_to_draw(result)
    statuses = zip(candidates, result.iterate("status", candidates), strict=True)
    return tuple(frame for frame, status in statuses if status != FAILED) or candidates


def select_evenly(frames: Sequence[int], max_count: int) -> tuple[int, ...]:
    """Select at most `max_count` of the frames, evenly spaced up to the last one."""
    return tuple(sorted({frames[int(i)] for i in np.linspace(len(frames) - 1, 0, min(max_count, len(frames))).round()}))


def brightness_figure(result: Result) -> Figure:
    """Draw gain and offset of every light against the reference over the deformed frames.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    Figure
        The figure, one line per light.

    Examples
    --------
    >>> len(brightness_figure(Result.open("my_result")).axes)
    2
    """
    gain, offset = np.moveaxis(result.brightness, -1, 0)
    return _over_frames(result, {"gain": gain, "offset (grey levels)": offset})


def residual_figure(result: Result) -> Figure:
    """Draw the weighted rms residual of every light, and its mean fraction in the nodes, over the deformed frames.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    Figure
        The figure, one line per light.

    Examples
    --------
    >>> len(residual_figure(Result.open("my_result")).axes)
    2
    """
    return _over_frames(result, {"residual": result.residual, "mean fraction in the nodes": result.mean_light_fraction})


def convergence_figure(result: Result) -> Figure:
    """Draw the largest motion of a measured node in each iteration, and the tolerance where it is known.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    Figure
        The figure, one line per deformed frame.

    Examples
    --------
    >>> len(convergence_figure(Result.open("my_result")).axes)
    1
    """
    from matplotlib import colormaps
    from matplotlib.colors import Normalize

    drawable_frames = frames_to_draw(result)
    frames = drawable_frames[:: math.ceil(len(drawable_frames) / 100)]  # more lines cover each other
    has_legend = len(frames) <= 8  # in a legend, which then fills half the height; else a colour bar

    def draw(axes: list[Axes]) -> None:
        (axis,), norm = axes, Normalize(frames[0], frames[-1])
        colours = style.CURVES if has_legend else [colormaps["viridis"](norm(frame)) for frame in frames]
        looks = zip(cycle(colours), cycle(style.MARKERS), cycle(style.LINES), strict=False)
        for frame, history, (colour, marker, line) in zip(
            frames, result.iterate("history", frames), looks, strict=False
        ):
            look: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 3, "linestyle": line}
            name = style.literal(result.names[frame])
            axis.plot(np.arange(1, len(history) + 1), history, linewidth=1, label=name, **look)
        if (tolerance := result.setting("solver", "tolerance")) is not None:
            axis.axhline(tolerance, color="0.4", linewidth=0.8, linestyle="--", label="tolerance")
        axis.set_yscale("log")
        style.finish_plot(axis, "iteration", "largest motion of a measured node (px)")
        if has_legend:
            axis.legend(loc="upper right")
        else:
            style.add_colour_bar(axis, norm, "viridis", label="frame")

    return style.draw_figure(draw, count=1, aspect=0.6, right_room=style.GAP if has_legend else style.BAR)


def _over_frames(result: Result, panels: Mapping[str, FloatArray]) -> Figure:
    """Draw a panel per quantity (T, k), with one line per light over the deformed frames."""
    frames = list(frames_to_draw(result))

    def draw(axes: list[Axes]) -> None:
        for axis, (label, values) in zip(axes, panels.items(), strict=True):
            for light, line, series in zip(result.lights, cycle(style.LINES), values[frames].T, strict=False):
                look: dict[str, Any] = {"linestyle": line, "color": style.LIGHT_COLOURS.get(light)}
                look |= {"marker": "o", "markersize": 2.5, "linewidth": 1, "label": style.literal(light)}
                axis.plot(result.number[frames], series, **look)
            if np.nanmin(values, initial=0) >= 0:
                axis.set_ylim(bottom=0)
            style.finish_plot(axis, "frame", label)
        axes[-1].legend(loc="best")

    return style.draw_figure(draw, count=len(panels), aspect=0.75, right_room=style.NUMBERS)


class MapDrawer:
    """Maps of a result's nodes over its reference image; the axes and the places of the mesh are made once.

    A figure lasts until the next one of as many panels is drawn, in its place.

    Parameters
    ----------
    maps
        The fields of the result.
    dpi
        Pixels per inch that all figures are written with; the axes are then drawn once. None: not known.

    Examples
    --------
    >>> drawer = MapDrawer(Maps.from_result(Result.open("my_result")))
    >>> len(drawer.fields(1, ("u", "v")).axes)
    2
    """

    def __init__(self, maps: Maps, dpi: int | None = None) -> None:
        from matplotlib.tri import Triangulation

        self.maps, self.result, self._dpi = maps, (result := maps.result), dpi
        self._unit, self._factor = maps.physical.axes
        self._figures: dict[int, Figure] = {}
        low, high = result.nodes.min(axis=0), result.nodes.max(axis=0)
        step = float((high - low).max()) / 450  # as many pixels as the panels of two maps have at 150 dpi
        x, y = (np.arange(start + step / 2, stop, step) for start, stop in zip(low, high, strict=True))
        self._grid = np.meshgrid(x, y)
        self._extent = (low[0], low[0] + step * len(x), low[1] + step * len(y), low[1])
        # matplotlib finds elements on meshes without two nodes at one place: those of a crack's sides count as one
        nodes, node_index = np.unique(result.nodes, axis=0, return_inverse=True)
        triangulation = Triangulation(nodes[:, 0], nodes[:, 1], node_index.reshape(-1)[result.elements])
        self._points = np.stack(self._grid, axis=-1)
        element = np.asarray(triangulation.get_trifinder()(*self._grid), dtype=np.int64).ravel()  # -1: of none
        self._points_in_elements = maps.points_in_elements(self._points.reshape(-1, 2), element)

    def discretisation(self, frame: int) -> Figure | None:
        """Draw noise and discretisation error together, and where a finer mesh is needed.

        Parameters
        ----------
        frame
            Index of the frame.

        Returns
        -------
        Figure or None
            The figure; None for a frame without discretisation error.

        Raises
        ------
        InputError, ResultError
            As `fields`.
        """
        if "finer_mesh" not in self.maps.quantities or not np.isfinite(self.maps.read("u_total", frame).values).any():
            return None
        return self.fields(frame, ("u_total", "v_total", "finer_mesh"))

    def kind(self, frame: int, kind: str) -> Figure:
        """Draw the maps of a kind of one frame, of all components of the displacement; errors as `fields`.

        Parameters
        ----------
        frame
            Index of the frame.
        kind
            Key of `MAPS`.

        Returns
        -------
        Figure
        """
        names, others = MAPS[kind], self.maps.physical.components[2:]
        more = [name.replace("v", other, 1) for other in others for name in names if name in ("v", "v_std")]
        return self.fields(frame, [*names, *more])

    def fields(self, frame: int, names: Sequence[str], *, std: bool = False, hatched: bool = False) -> Figure:
        """Draw maps of fields of one frame, blank where not measured.

        Parameters
        ----------
        frame
            Index of the frame.
        names
            Names of the fields; nodes of large uncertainty do not set the colours.
        std
            Whether the standard uncertainty of each field that has one is shown beside it.
        hatched
            Whether values within two standard uncertainties of 0 are hatched.

        Returns
        -------
        Figure
            The figure, one panel per field.

        Raises
        ------
        InputError, ResultError
            As `Maps.read`.
        """
        import matplotlib as mpl
        from matplotlib.colors import Normalize

        panels = []
        for name in names:
            panels.append(field := self.maps.read(name, frame))
            if std and np.isfinite(field.uncertainty).any():
                panels.append(replace(field, name=f"{name}_std", values=field.uncertainty, std=None))
        if len(panels) not in self._figures:
            self._figures[len(panels)] = self._panels(len(panels))
        figure, reference_count = (
            self._figures[len(panels)],
            int(self._dpi is None and self.result.reference is not None),
        )
        title = _frame_title(self.result, frame, self.result.frame(frame))
        note = "; ".join(filter(None, dict.fromkeys(self.maps.processing_note(name) for name in names)))
        figure.texts[0].update({"text": f"{title}\n{note}" if note else title, "fontsize": 8 if note else 10})
        with mpl.rc_context(style.STYLE):
            for axis, field in zip(figure.axes, panels, strict=True):
                quantity, uncertainty = self.maps.field(field.name), field.uncertainty
                artists = (*axis.lines, *axis.patches, *axis.texts, *axis.artists, *axis.collections)
                for artist in (*axis.images[reference_count:], *artists):
                    artist.remove()
                colour_values = style.ordinary_values(field.values, uncertainty)
                positive = quantity.is_logarithmic
                norm = style.colour_scale(colour_values, positive=positive) if colour_values.size else None
                norm = Normalize(*quantity.fixed_range) if quantity.fixed_range else norm
                self._show_field(axis, field.values, norm, quantity)
                axis.set_title(style.literal(quantity.label))
                if hatched and np.isfinite(uncertainty).any():
                    margin = self._points_in_elements.linear(np.abs(field.values) - 2 * uncertainty)
                    with np.errstate(invalid="ignore"):
                        axis.contourf(
                            *self._grid,
                            margin.reshape(self._grid[0].shape),
                            levels=[-np.inf, 0],
                            hatches=["////"],
                            colors="none",
                        )
        return figure

    def fractions(self, frame: int) -> Figure:
        """Draw maps of the fraction of each light in what determines the nodes of a frame.

        Parameters
        ----------
        frame
            Index of the frame.

        Returns
        -------
        Figure
            The figure, one panel per light.

        Raises
        ------
        InputError, ResultError
            As `fields`.
        """
        return self.fields(frame, [f"fraction of {light}" for light in self.result.lights])

    def masks(self, frame: int) -> Figure | None:
        """Draw what the weights of a frame exclude of each light before the solve.

        Parameters
        ----------
        frame
            Index of the frame.

        Returns
        -------
        Figure or None
            The figure, one panel per light; None where they exclude nothing, or no reference image was kept.

        Raises
        ------
        InputError, ResultError
            As `fields`.
        """
        excluded = 1 - self.result.frame(frame).weights_thumbnail / 255
        return self._shaded_figure(frame, excluded, excluded, "{:.1%} excluded") if excluded.any() else None

    def reflections(self, frame: int) -> Figure | None:
        """Draw the reflection index of each light in a frame.

        Parameters
        ----------
        frame
            Index of the frame.

        Returns
        -------
        Figure or None
            The figure, one panel per light; None where the separation did not estimate it, or no reference image
            was kept.

        Raises
        ------
        InputError, ResultError
            As `fields`.
        """
        index = self.result.frame(frame).reflection_thumbnail / 255
        return self._shaded_figure(frame, index, index > REFLECTING, "reflects on {:.1%}") if index.size else None

    def strip(self, name: str, frames: Sequence[int], label: str) -> Figure:
        """Draw small maps of one field in several frames, side by side, in the same colours.

        Parameters
        ----------
        name
            Name of the field.
        frames
            Indices of the frames.
        label
            Title of the figure: the field and its unit.

        Returns
        -------
        Figure
        """
        field, (x, y) = self.maps.field(name), picture_limits(self.result, self.result.nodes)
        maps, physical = {frame: self.maps.read(name, frame).values for frame in frames}, self.maps.physical
        all_values = np.concatenate([*maps.values()])
        finite_values = all_values[np.isfinite(all_values)]
        norm = style.colour_scale(finite_values) if finite_values.size else None

        def draw(axes: list[Axes]) -> None:
            for axis, (frame, values) in zip(axes, maps.items(), strict=False):
                self._show_field(axis, values, norm, field, bar=axis is axes[-2])
                time_note = (
                    f", {style.time_text(physical.times[frame], physical.times)}" if physical.units.timed else ""
                )
                axis.set_title(f"frame {frame}{time_note}")
                style.finish_picture(axis, x, y, has_y_label=axis is axes[0], unit=self._unit, factor=self._factor)
            axes[-1].set_axis_off()  # room for the colour bar

        aspect = np.ptp(y) / np.ptp(x)
        return style.draw_figure(draw, count=len(maps) + 1, aspect=max(aspect, 0.5), right_room=style.GAP, title=label)

    def _shaded_figure(self, frame: int, cover: FloatArray, flags: AnyArray, caption: str) -> Figure | None:
        """Show the reference of each light around the mesh, shaded by a reduced picture (k, h, w) of one frame.

        The `caption` state the mean of what is `flags` (k, h, w) over the part that is shown. None where no reference
        was kept.
        """
        result = self.result
        if (reference := result.reference) is None:
            return None
        record = result.frame(frame)
        step, origin = -(-reference.shape[1] // cover.shape[1]), result.reference_origin
        deformed = result.nodes + np.stack([record.u, record.v], axis=1)
        x, y = picture_limits(result, np.concatenate([result.nodes, deformed[np.isfinite(deformed).all(axis=1)]]))
        columns, rows = (
            slice(int((low - offset + 0.5) // step), math.ceil((high - offset + 0.5) / step))
            for (low, high), offset in zip((x, y), origin, strict=True)
        )

        def draw(axes: list[Axes]) -> None:
            for axis, image, light, mask, light_flags in zip(axes, reference, result.lights, cover, flags, strict=True):
                style.show_image(axis, image, origin)
                style.shade(axis, mask, step, origin, style.LIGHT_COLOURS.get(light))
                axis.set_title(style.literal(f"{light}: {caption.format(light_flags[rows, columns].mean())}"))
                style.finish_picture(axis, x, y, has_y_label=axis is axes[0], unit=self._unit, factor=self._factor)

        title = f"{_frame_title(result, frame, record)}, over the reference image"
        return style.draw_figure(
            draw, count=len(cover), aspect=np.ptp(y) / np.ptp(x), right_room=style.GAP, title=title
        )

    def _panels(self, count: int) -> Figure:
        """Draw what is the same in all figures of `count` maps: axes and reference image."""
        result, (x, y) = self.result, picture_limits(self.result, self.result.nodes)

        def draw(axes: list[Axes]) -> None:
            reference = None if result.reference is None else result.reference.mean(axis=0, dtype=np.float32)
            for axis in axes:
                if reference is not None:
                    style.show_image(axis, reference, result.reference_origin)
                style.finish_picture(axis, x, y, has_y_label=axis is axes[0], unit=self._unit, factor=self._factor)

        figure = style.draw_figure(draw, count=count, aspect=np.ptp(y) / np.ptp(x), right_room=style.BAR, title=" ")
        if self._dpi is not None:
            style.freeze_axes(figure, self._dpi)
        return figure

    def _rasterise(self, values: FloatArray, field: ResultQuantity) -> FloatArray:
        """Evaluate a nodal field between the nodes; NaN where one of those around has no data.

        Where values between nodes mean nothing it is that of the nearest one.
        """
        from scipy.spatial import cKDTree

        interpolate = self._points_in_elements.read if field.is_signed else self._points_in_elements.linear
        picture = interpolate(values).reshape(self._grid[0].shape)
        if field.stepped:
            picture = np.where(np.isfinite(picture), values[cKDTree(self.result.nodes).query(self._points)[1]], np.nan)
        return np.asarray(picture)

    def _show_field(
        self, axis: Axes, values: FloatArray, norm: Normalize | None, field: ResultQuantity, *, bar: bool = True
    ) -> None:
        """Show nodal values and their colour bar; a code has one colour in every picture."""
        from matplotlib.colors import ListedColormap

        finite = values[np.isfinite(values)]
        if norm is None or not finite.size:
            box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85}
            axis.text(0.5, 0.5, "nothing measured", transform=axis.transAxes, ha="center", va="center", bbox=box)
            return
        codes = len(field.codes)
        colours = ListedColormap(style.STATUS_COLOURS[:codes]) if codes else field_colours(field)
        picture = self._rasterise(values, field)
        axis.imshow(picture, extent=self._extent, cmap=colours, norm=norm, interpolation="nearest")
        if bar:
            style.add_colour_bar(axis, norm, colours, values=finite, names=field.codes)


def field_colours(field: ResultQuantity) -> str:
    """Return the name of matplotlib's colours of a field."""
    return _COLOURS.get(field.kind, "viridis")


def picture_limits(result: Result, points: FloatArray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the limits in x and in y of a picture around points (N, 2), inside the image."""
    low, high = style.view_limits(points)
    if result.reference is not None:
        origin, size = np.array(result.reference_origin), np.array(result.reference.shape[:0:-1])
        low, high = (np.clip(limit, origin - 0.5, origin + size - 0.5) for limit in (low, high))
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def _frame_title(result: Result, frame: int, record: FrameRecord) -> str:
    """Return the title of a frame: number, file, status, iterations, fraction of nodes without data."""
    missing_fraction = np.isnan(record.u).mean()
    missing = f", {missing_fraction:.1%} of the nodes not measured" if missing_fraction else ""
    outcome = QUANTITIES["status"].codes[record.status]
    return f"frame {frame}: {style.literal(result.names[frame])} ({outcome}, {record.iterations} iterations{missing})"
