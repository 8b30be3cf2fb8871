"""Page, pictures, tables and files of a comparison with a simulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

import numpy as np

from rgbmidic.disk import write_complete, write_errors, write_table
from rgbmidic.errors import import_optional
from rgbmidic.text import format_with_std
from rgbmidic.tools.finite_elements.comparison import VARIANTS, Comparison, FrameComparison
from rgbmidic.tools.finite_elements.simulation_nodes import COMPARED_QUANTITIES
from rgbmidic.tools.report import style
from rgbmidic.tools.report.figures import select_evenly
from rgbmidic.tools.report.page import render
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAGE, TABLE, SCALE, INDEX = "comparison.html", "comparison.csv", "scale.csv", "comparison.pvd"


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparisonConstants:
    """Limits of a comparison: frames shown, and ratios above which it warns.

    Attributes
    ----------
    map_count
        Frames of which maps are shown at most.
    colour_reach
        Ratios to the standard uncertainty at the ends of the colours: beyond lies one in 16,000 of a right simulation.
    min_probability
        Probability of chi-square under which a warning names the frame. Chosen.
    max_rigid_ratio
        Standard uncertainties of a rigid motion above which a warning names the frame. Chosen.
    max_chi_square
        Chi-square of what the best scale leaves above which the shape differs: errors of 1.2 times the stated
        uncertainty, which hardly any whole field of docs/explanation/uncertainty.md exceeds.
    """

    map_count: int = 2
    colour_reach: float = 4.0
    min_probability: float = 0.01
    max_rigid_ratio: float = 4.0
    max_chi_square: float = 1.5


_LIMITS = ComparisonConstants()
_GROUPS = {"displacement": COMPARED_QUANTITIES[:2], "strain": COMPARED_QUANTITIES[2:]}
_TITLES = {"nodes": "at the nodes", "levelled": "levelled"}


def comparison_files(comparison: Comparison) -> list[str]:
    """Return the names of the files that `write_comparison` writes."""
    return [PAGE, TABLE, SCALE, INDEX, *(_state(frame) for frame in comparison.frames)]


def _state(frame: int) -> str:
    return f"comparison_{frame:06d}.vtu"


def write_comparison(
    comparison: Comparison, out: Path, progress: Callable[[int, int, str], None] | None = None
) -> list[FrameComparison]:
    """Compare all frames, and write page, tables and the fields at the simulation's nodes into a folder.

    ``comparison.csv`` has a row per frame, way and quantity, ``scale.csv`` one per frame; the ``.vtu`` files, which
    ``comparison.pvd`` names with their times, have the measurement at the simulation's nodes with their numbers, in mm
    along the simulation's axes.

    Parameters
    ----------
    comparison
        Of a result and a simulation.
    out
        Folder, made where it does not exist; files of these names are replaced.
    progress
        Called with the number of frames done, that of all, and a text.

    Returns
    -------
    list of FrameComparison
        Without their fields, but those of the frames of which maps are shown.

    Raises
    ------
    InputError
        meshio is not installed (extra ``fe``).
    ResultError
        A file cannot be written, or a frame of the result is damaged.
    """
    map_frames = select_evenly(comparison.frames, _LIMITS.map_count)
    frame_comparisons: list[FrameComparison] = []
    tables: dict[str, list[dict[str, Any]]] = {TABLE: [], SCALE: []}
    import_optional("meshio", "fe")
    with write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    for frame_comparison in comparison.iterate():
        _write_state(comparison, frame_comparison, out / _state(frame_comparison.frame))
        frame_comparisons.append(
            frame_comparison
            if frame_comparison.frame in map_frames
            else replace(frame_comparison, measured={}, simulated={})
        )
        number, clock = (
            int(comparison.result.number[frame_comparison.frame]),
            "time_s" if comparison.has_times else "time_frame",
        )
        head = {"frame": frame_comparison.frame, "number": number, clock: frame_comparison.time}
        for (variant, name), entry in frame_comparison.agreement.items():
            labels = {"way": variant, "quantity": name, "unit": "1" if name[0] == "e" else "mm"}
            tables[TABLE].append(head | labels | asdict(entry))
        fit, names = frame_comparison.fit, ("rigid_u_mm", "rigid_v_mm", "rigid_rotation_deg")
        rigid = zip(names, fit.rigid.tolist(), fit.rigid_std.tolist(), strict=True)
        row = head | {"scale": fit.scale, "scale_std": fit.scale_std}
        row |= {key: number for name, value, std in rigid for key, number in ((name, value), (f"{name}_std", std))}
        tables[SCALE].append(row | {"chi_square_of_the_rest": fit.chi_square})
        if progress is not None:
            progress(len(frame_comparisons), len(comparison.frames), "frames")
    datasets = "".join(
        f'<DataSet timestep="{entry.time:.12g}" file={quoteattr(_state(entry.frame))}/>' for entry in frame_comparisons
    )
    index = (
        f'<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1"><Collection>{datasets}</Collection></VTKFile>'
    )
    for name, rows in tables.items():
        write_complete(out / name, partial(write_table, head=rows[0], rows=[row.values() for row in rows]))
    for name, text in {INDEX: index, PAGE: _page(comparison, frame_comparisons)}.items():
        write_complete(out / name, methodcaller("write", text.encode()))
    return frame_comparisons


def _write_state(comparison: Comparison, frame_comparison: FrameComparison, path: Path) -> None:
    """Write one frame as VTU: the measurement at the simulation's nodes, the simulation, and their difference."""
    import meshio

    mesh = comparison.simulation.mesh
    flat = np.zeros(len(mesh.points))

    def vectors(group: str, value_of: Callable[[str], FloatArray]) -> FloatArray:
        components = [value_of(name) for name in _GROUPS[group]]
        return np.column_stack([*components, *[flat] * (3 - len(components))])

    fields: dict[str, Any] = {"node_number": mesh.node_numbers}
    for group in _GROUPS:
        fields[group] = vectors(group, lambda name: frame_comparison.measured[name].values)
        fields[f"{group}_std"] = vectors(group, lambda name: frame_comparison.measured[name].uncertainty)
        for variant in VARIANTS:
            fields[f"{group}_simulated_{variant}"] = vectors(group, frame_comparison.simulated[variant].__getitem__)
            fields[f"{group}_ratio_{variant}"] = vectors(group, partial(frame_comparison.ratio, variant))
    points, cells = np.column_stack([mesh.points, flat]), {"element_number": [mesh.element_numbers]}
    output_mesh = meshio.Mesh(points, [("triangle", mesh.elements)], point_data=fields, cell_data=cells)
    write_complete(path, lambda file: meshio.vtu.write(file.name, output_mesh))


def difference_figure(
    comparison: Comparison,
    frame_comparison: FrameComparison,
    names: Sequence[str],
    variant: str,
    *,
    ratio: bool = False,
) -> Figure:
    """Draw measured minus simulated at the simulation's nodes, y up; blank where there are no data.

    Parameters
    ----------
    comparison
        The comparison.
    frame_comparison
        One of its frames.
    names
        Of the `COMPARED_QUANTITIES`, a panel each.
    variant
        One of the `VARIANTS`.
    ratio
        Whether in units of the standard uncertainty, from -4 to 4; else in mm or strain.
    """
    from matplotlib.colors import Normalize
    from matplotlib.tri import Triangulation

    mesh = comparison.simulation.mesh
    low, high = style.view_limits(mesh.points)

    def draw(axes: list[Axes]) -> None:
        for axis, name in zip(axes, names, strict=True):
            values, unit, reach = frame_comparison.ratio(variant, name), " in uncertainties", _LIMITS.colour_reach
            if not ratio:
                values, unit = frame_comparison.difference(variant, name), "" if name[0] == "e" else " (mm)"
                colour_values = style.ordinary_values(values, frame_comparison.measured[name].uncertainty)
                reach = max(np.abs(style.colour_range(colour_values))) if colour_values.size else 1.0
            norm, finite = Normalize(-reach, reach), np.isfinite(values)
            has_data = finite[mesh.elements].all(axis=1)
            if has_data.any():
                triangulation = Triangulation(mesh.points[:, 0], mesh.points[:, 1], mesh.elements, ~has_data)
                axis.tripcolor(triangulation, np.where(finite, values, 0), cmap="RdBu_r", norm=norm, shading="gouraud")
            style.add_colour_bar(axis, norm, "RdBu_r", values=values[finite])
            style.finish_picture(axis, (low[0], high[0]), (high[1], low[1]), has_y_label=axis is axes[0], unit="mm")
            axis.set_title(f"{name}{unit}, {_TITLES[variant]}")

    aspect = float(np.ptp([low[1], high[1]]) / np.ptp([low[0], high[0]]))
    return style.draw_figure(draw, count=len(names), aspect=aspect, right_room=style.BAR)


def histogram_figure(frame_comparison: FrameComparison) -> Figure:
    """Draw how often each ratio of difference to standard uncertainty occurs, both ways, and what a Gaussian has."""

    def draw(axes: list[Axes]) -> None:
        bins = np.linspace(-6, 6, 49)  # what lies beyond is counted in the outermost ones
        middles, width = (bins[1:] + bins[:-1]) / 2, bins[1] - bins[0]
        for axis, (title, names) in zip(axes, _GROUPS.items(), strict=True):
            for variant, colour in zip(VARIANTS, ("vermillion", "blue"), strict=True):
                ratios = np.concatenate([frame_comparison.ratio(variant, name) for name in names])
                ratios = ratios[np.isfinite(ratios)]
                counts = np.histogram(np.clip(ratios, bins[0], bins[-1]), bins)[0] / max(len(ratios), 1) / width
                axis.stairs(counts, bins, color=style.OKABE_ITO[colour], label=_TITLES[variant], linewidth=1.2)
            axis.plot(middles, np.exp(-(middles**2) / 2) / np.sqrt(2 * np.pi), "k--", linewidth=1, label="expected")
            axis.set_title(title)
            style.finish_plot(axis, "difference over its standard uncertainty", "density")
        axes[-1].legend(loc="upper right")

    return style.draw_figure(draw, count=2, aspect=0.7, right_room=style.NUMBERS)


def scale_figure(comparison: Comparison, frame_comparisons: Sequence[FrameComparison]) -> Figure:
    """Draw the best-fitting scale of the simulation and chi-square over the frames."""
    frames = np.array([frame_comparison.frame for frame_comparison in frame_comparisons])
    times, label = style.time_axis(
        np.array([frame_comparison.time for frame_comparison in frame_comparisons]) if comparison.has_times else None,
        frames,
    )

    def draw(axes: list[Axes]) -> None:
        scale, std = np.array(
            [(frame_comparison.fit.scale, frame_comparison.fit.scale_std) for frame_comparison in frame_comparisons]
        ).T
        axes[0].errorbar(times, scale, 2 * std, fmt="o-", markersize=2.5, linewidth=1, color=style.OKABE_ITO["blue"])
        axes[0].axhline(1, color="0.4", linewidth=0.8, linestyle="--")
        style.finish_plot(axes[0], label, "scale of the simulation", integer_ticks=not comparison.has_times)
        for variant, colour in zip(VARIANTS, ("vermillion", "blue"), strict=True):
            for name, line in (("displacement", "-"), ("eyy", ":")):
                values = [
                    frame_comparison.agreement[variant, name].chi_square for frame_comparison in frame_comparisons
                ]
                look: dict[str, Any] = {"linestyle": line, "color": style.OKABE_ITO[colour], "linewidth": 1}
                axes[1].plot(times, values, marker="o", markersize=2.5, label=f"{name}, {_TITLES[variant]}", **look)
        axes[1].axhline(1, color="0.4", linewidth=0.8, linestyle="--")
        axes[1].set_ylim(bottom=0)
        style.finish_plot(axes[1], label, "chi-square per degree of freedom", integer_ticks=not comparison.has_times)
        axes[1].legend(loc="best", fontsize=7)

    return style.draw_figure(draw, count=2, aspect=0.75, right_room=style.NUMBERS)


def scale_text(comparison: Comparison, frame_comparisons: Sequence[FrameComparison]) -> str:
    """Return the best-fitting scale of all frames as text, and its meaning for a modulus."""
    scale, std = comparison.best_scale([frame_comparison.fit for frame_comparison in frame_comparisons])
    if not np.isfinite(scale):
        return "no scale is found: the simulation is a rigid motion in all frames, or too few of its nodes have data"
    text = (
        f"{format_with_std(scale, std)} times the simulation fits the measurement best, with any shift and rotation: "
    )
    deviation, residual_chi_square = (
        abs(scale - 1) / std if std else np.inf,
        float(np.median([frame_comparison.fit.chi_square for frame_comparison in frame_comparisons])),
    )
    if deviation <= 2:
        text += "1 is within two standard uncertainties"
    else:
        text += f"{deviation:.1f} standard uncertainties from 1; where the loads are right, divide the moduli by it"
    if residual_chi_square > _LIMITS.max_chi_square:
        text += (
            f"; the shape differs (chi-square of what is left: {residual_chi_square:.3g}), which this uncertainty does "
            "not hold"
        )
    return text


def _page(comparison: Comparison, frame_comparisons: Sequence[FrameComparison]) -> str:
    unlikely = {
        name: [
            frame_comparison.frame
            for frame_comparison in frame_comparisons
            if frame_comparison.agreement["levelled", name].probability < _LIMITS.min_probability
        ]
        for name in ("displacement", *COMPARED_QUANTITIES[2:])
    }
    rigid = [
        (
            frame_comparison.frame,
            (np.abs(frame_comparison.fit.rigid) > _LIMITS.max_rigid_ratio * frame_comparison.fit.rigid_std).any(),
        )
        for frame_comparison in frame_comparisons
    ]
    return render(
        "comparison.html",
        Path(__file__).parent,
        comparison=comparison,
        frame_comparisons=frame_comparisons,
        simulation=Path(comparison.simulation.name).name,
        scale=scale_text(comparison, frame_comparisons),
        limits=_LIMITS,
        unlikely=unlikely,
        moved_frames=[frame for frame, is_moved in rigid if is_moved],
        heads=[entry.name.replace("_", " ") for entry in fields(next(iter(frame_comparisons[0].agreement.values())))],
        values=lambda agreement: asdict(agreement).values(),
        groups=_GROUPS.values(),
        titles=_TITLES,
        scale_figure=scale_figure,
        histogram_figure=histogram_figure,
        difference_figure=difference_figure,
    )
