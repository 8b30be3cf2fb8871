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

from rgbmidic.errors import import_optional
from rgbmidic.report import style
from rgbmidic.report.figures import spread
from rgbmidic.report.page import render
from rgbmidic.results.comparison import QUANTITIES, WAYS, Comparison, FrameComparison
from rgbmidic.results.files import write_complete, write_table, writing
from rgbmidic.text import format_with_std
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAGE, TABLE, SCALE, INDEX = "comparison.html", "comparison.csv", "scale.csv", "comparison.pvd"


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparisonConstants:
    """What a comparison shows, and where it begins to doubt the simulation.

    Attributes
    ----------
    shown
        Frames of which maps are shown at most.
    reach
        Ratios to the standard uncertainty at the ends of the colours: beyond lies one in 16,000 of a right simulation.
    unlikely
        Probability of chi-square under which a warning names the frame. Chosen.
    rigid
        Standard uncertainties of a rigid motion above which a warning names the frame. Chosen.
    shape
        Chi-square of what the best scale leaves above which the shape differs: 1.2 times the stated uncertainty, more
        than that is wrong by in any scene of docs/explanation/uncertainty.md.
    """

    shown: int = 2
    reach: float = 4.0
    unlikely: float = 0.01
    rigid: float = 4.0
    shape: float = 1.5


_LIMITS = ComparisonConstants()
_GROUPS = {"displacement": QUANTITIES[:2], "strain": QUANTITIES[2:]}
_TITLES = {"nodes": "at the nodes", "levelled": "levelled"}


def comparison_files(comparison: Comparison) -> list[str]:
    """Names of the files that `write_comparison` writes."""
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
    shown = spread(comparison.frames, _LIMITS.shown)
    done: list[FrameComparison] = []
    tables: dict[str, list[dict[str, Any]]] = {TABLE: [], SCALE: []}
    import_optional("meshio", "fe")
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    for made in comparison.each():
        _write_state(comparison, made, out / _state(made.frame))
        done.append(made if made.frame in shown else replace(made, measured={}, std={}, simulated={}))
        number, clock = int(comparison.result.number[made.frame]), "time_s" if comparison.timed else "time_frame"
        head = {"frame": made.frame, "number": number, clock: made.time}
        for (way, name), one in made.agreement.items():
            what = {"way": way, "quantity": name, "unit": "1" if name[0] == "e" else "mm"}
            tables[TABLE].append(head | what | asdict(one))
        fit, names = made.fit, ("rigid_u_mm", "rigid_v_mm", "rigid_rotation_deg")
        rigid = zip(names, fit.rigid.tolist(), fit.rigid_std.tolist(), strict=True)
        row = head | {"scale": fit.scale, "scale_std": fit.scale_std}
        row |= {key: number for name, value, std in rigid for key, number in ((name, value), (f"{name}_std", std))}
        tables[SCALE].append(row | {"chi_square_of_the_rest": fit.chi_square})
        if progress is not None:
            progress(len(done), len(comparison.frames), "frames")
    sets = "".join(f'<DataSet timestep="{one.time:.12g}" file={quoteattr(_state(one.frame))}/>' for one in done)
    index = f'<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1"><Collection>{sets}</Collection></VTKFile>'
    for name, rows in tables.items():
        write_complete(out / name, partial(write_table, head=rows[0], rows=[row.values() for row in rows]))
    for name, text in {INDEX: index, PAGE: _page(comparison, done)}.items():
        write_complete(out / name, methodcaller("write", text.encode()))
    return done


def _write_state(comparison: Comparison, made: FrameComparison, path: Path) -> None:
    """Write one frame as VTU: the measurement at the simulation's nodes, the simulation, and their difference."""
    import meshio

    mesh = comparison.simulation.mesh
    flat = np.zeros(len(mesh.points))

    def vectors(group: str, value_of: Callable[[str], FloatArray]) -> FloatArray:
        parts = [value_of(name) for name in _GROUPS[group]]
        return np.column_stack([*parts, *[flat] * (3 - len(parts))])

    fields: dict[str, Any] = {"node_number": mesh.node_numbers}
    for group in _GROUPS:
        fields[group] = vectors(group, made.measured.__getitem__)
        fields[f"{group}_std"] = vectors(group, made.std.__getitem__)
        for way in WAYS:
            fields[f"{group}_simulated_{way}"] = vectors(group, made.simulated[way].__getitem__)
            fields[f"{group}_ratio_{way}"] = vectors(group, partial(made.ratio, way))
    points, cells = np.column_stack([mesh.points, flat]), {"element_number": [mesh.element_numbers]}
    written = meshio.Mesh(points, [("triangle", mesh.elements)], point_data=fields, cell_data=cells)
    write_complete(path, lambda file: meshio.vtu.write(file.name, written))


def difference_figure(
    comparison: Comparison, made: FrameComparison, names: Sequence[str], way: str, *, ratio: bool = False
) -> Figure:
    """Draw measured minus simulated at the simulation's nodes, y up; blank where there are no data.

    Parameters
    ----------
    comparison
        The comparison.
    made
        One of its frames.
    names
        Of the `QUANTITIES`, a panel each.
    way
        One of the `WAYS`.
    ratio
        Whether in units of the standard uncertainty, from -4 to 4; else in mm or strain.
    """
    from matplotlib.colors import Normalize
    from matplotlib.tri import Triangulation

    mesh = comparison.simulation.mesh
    low, high = style.view_limits(mesh.points)

    def draw(axes: list[Axes]) -> None:
        for axis, name in zip(axes, names, strict=True):
            values, unit, reach = made.ratio(way, name), " in uncertainties", _LIMITS.reach
            if not ratio:
                values, unit = made.difference(way, name), "" if name[0] == "e" else " (mm)"
                ordinary = style.ordinary_values(values, made.std[name])
                reach = max(np.abs(style.colour_range(ordinary))) if ordinary.size else 1.0
            norm, known = Normalize(-reach, reach), np.isfinite(values)
            whole = known[mesh.elements].all(axis=1)
            if whole.any():
                drawn = Triangulation(mesh.points[:, 0], mesh.points[:, 1], mesh.elements, ~whole)
                axis.tripcolor(drawn, np.where(known, values, 0), cmap="RdBu_r", norm=norm, shading="gouraud")
            style.add_colour_bar(axis, norm, "RdBu_r", shown=values[known])
            style.finish_picture(axis, (low[0], high[0]), (high[1], low[1]), first=axis is axes[0], unit="mm")
            axis.set_title(f"{name}{unit}, {_TITLES[way]}")

    aspect = float(np.ptp([low[1], high[1]]) / np.ptp([low[0], high[0]]))
    return style.draw_figure(draw, count=len(names), aspect=aspect, beside=style.BAR)


def histogram_figure(made: FrameComparison) -> Figure:
    """Draw how often each ratio of difference to standard uncertainty occurs, both ways, and what a Gaussian has."""

    def draw(axes: list[Axes]) -> None:
        bins = np.linspace(-6, 6, 49)  # what lies beyond is counted in the outermost ones
        middles, width = (bins[1:] + bins[:-1]) / 2, bins[1] - bins[0]
        for axis, (title, names) in zip(axes, _GROUPS.items(), strict=True):
            for way, colour in zip(WAYS, ("vermillion", "blue"), strict=True):
                ratios = np.concatenate([made.ratio(way, name) for name in names])
                ratios = ratios[np.isfinite(ratios)]
                counts = np.histogram(np.clip(ratios, bins[0], bins[-1]), bins)[0] / max(len(ratios), 1) / width
                axis.stairs(counts, bins, color=style.OKABE_ITO[colour], label=_TITLES[way], linewidth=1.2)
            axis.plot(middles, np.exp(-(middles**2) / 2) / np.sqrt(2 * np.pi), "k--", linewidth=1, label="expected")
            axis.set_title(title)
            style.finish_plot(axis, "difference over its standard uncertainty", "density")
        axes[-1].legend(loc="upper right")

    return style.draw_figure(draw, count=2, aspect=0.7, beside=style.NUMBERS)


def scale_figure(comparison: Comparison, done: Sequence[FrameComparison]) -> Figure:
    """Draw the best-fitting scale of the simulation and chi-square over the frames."""
    frames = np.array([made.frame for made in done])
    times, label = style.time_axis(np.array([made.time for made in done]) if comparison.timed else None, frames)

    def draw(axes: list[Axes]) -> None:
        scale, std = np.array([(made.fit.scale, made.fit.scale_std) for made in done]).T
        axes[0].errorbar(times, scale, 2 * std, fmt="o-", markersize=2.5, linewidth=1, color=style.OKABE_ITO["blue"])
        axes[0].axhline(1, color="0.4", linewidth=0.8, linestyle="--")
        style.finish_plot(axes[0], label, "scale of the simulation", whole=not comparison.timed)
        for way, colour in zip(WAYS, ("vermillion", "blue"), strict=True):
            for name, line in (("displacement", "-"), ("eyy", ":")):
                values = [made.agreement[way, name].chi_square for made in done]
                look: dict[str, Any] = {"linestyle": line, "color": style.OKABE_ITO[colour], "linewidth": 1}
                axes[1].plot(times, values, marker="o", markersize=2.5, label=f"{name}, {_TITLES[way]}", **look)
        axes[1].axhline(1, color="0.4", linewidth=0.8, linestyle="--")
        axes[1].set_ylim(bottom=0)
        style.finish_plot(axes[1], label, "chi-square per degree of freedom", whole=not comparison.timed)
        axes[1].legend(loc="best", fontsize=7)

    return style.draw_figure(draw, count=2, aspect=0.75, beside=style.NUMBERS)


def scale_text(comparison: Comparison, done: Sequence[FrameComparison]) -> str:
    """Say what the best-fitting scale of all frames is, and what it means for a modulus."""
    scale, std = comparison.best_scale([made.fit for made in done])
    if not np.isfinite(scale):
        return "no scale is found: the simulation is a rigid motion in all frames, or too few of its nodes have data"
    text = (
        f"{format_with_std(scale, std)} times the simulation fits the measurement best, with any shift and rotation: "
    )
    away, rest = abs(scale - 1) / std if std else np.inf, float(np.median([made.fit.chi_square for made in done]))
    if away <= 2:
        text += "1 is within two standard uncertainties"
    else:
        text += f"{away:.1f} standard uncertainties from 1; where the loads are right, divide the moduli by it"
    if rest > _LIMITS.shape:
        text += f"; the shape differs (chi-square of what is left: {rest:.3g}), which this uncertainty does not hold"
    return text


def _page(comparison: Comparison, done: Sequence[FrameComparison]) -> str:
    unlikely = {
        name: [made.frame for made in done if made.agreement["levelled", name].probability < _LIMITS.unlikely]
        for name in ("displacement", *QUANTITIES[2:])
    }
    rigid = [(made.frame, (np.abs(made.fit.rigid) > _LIMITS.rigid * made.fit.rigid_std).any()) for made in done]
    return render(
        "comparison.html",
        comparison=comparison,
        done=done,
        simulation=Path(comparison.simulation.name).name,
        scale=scale_text(comparison, done),
        limits=_LIMITS,
        unlikely=unlikely,
        moved=[frame for frame, moves in rigid if moves],
        heads=[entry.name.replace("_", " ") for entry in fields(next(iter(done[0].agreement.values())))],
        values=lambda one: asdict(one).values(),
        groups=_GROUPS.values(),
        titles=_TITLES,
        scale_figure=scale_figure,
        histogram_figure=histogram_figure,
        difference_figure=difference_figure,
    )
