"""A resolution study on paper: rows of its tables, resolution.csv, resolution.json and resolution.png.

Noise floor, discretisation error, strain resolution and spatial resolution of several element sizes and virtual strain
gauges, as the iDICs Good Practices Guide asks for. The spatial resolution is the period of a wave of which a tenth of
the amplitude is lost (DIC Challenge 2.0: Reu et al., Exp Mech 62, 2022): what the best linear fit, the recovery and the
gauge make of a wave along the mesh, which depends on nothing but the elements.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from rgbmidic.fields import NodalCovariance, StrainGauges
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.mesh.recovery import Recovery
from rgbmidic.pipeline.frame_quality import SPECKLES
from rgbmidic.tools.lab import format_number, schema_document, write_findings
from rgbmidic.tools.preparation.size_figures import GaugeFigures, ResolutionStudy
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILES = ("resolution.csv", "resolution.json", "resolution.png")
"""Files that `write_study` writes."""


@lru_cache(maxsize=1)  # three tables of a study have the same
def cut_offs(gauges: tuple[float, ...]) -> tuple[float, float, FloatArray]:
    """Evaluate the spatial resolution of displacement and strain at the nodes, and of virtual strain gauges.

    Parameters
    ----------
    gauges : tuple, length G
        Lengths in elements, three at least.

    Returns
    -------
    displacement, strain : float
        Period of a wave along the mesh at which a tenth of its amplitude is lost, in elements.
    gauges : ndarray, shape (G,)
        The same of the strain of each gauge.
    """
    periods = np.geomspace(2, 40, 48)  # from the shortest that a mesh can hold to that of the longest gauge below
    # the cut-off of a longer gauge, a disc on a fine grid, is in proportion to its length
    lengths = np.minimum(np.asarray(gauges, dtype=np.float64), 12.0)
    count = int(np.ceil(max(lengths, default=0.0))) + 14  # half a gauge and the reach of the recovery on either side
    mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 8 * count, 8 * count), (8 * count + 1,) * 2), 8.0)
    fitted = splu(mesh.mass_matrix).solve(_integrals(mesh, 2 * np.pi / (8.0 * periods)))
    recovery = Recovery.over(mesh, np.ones(len(mesh.elements), bool))
    field = recovery.value @ fitted
    cut_offs_px = [
        _cut_off(mesh, periods, field, 3.0),
        _cut_off(mesh, periods, recovery.slope_x @ fitted, 3.0, slope=True),
    ]
    covariance = NodalCovariance.from_mesh(mesh)
    for length in lengths:
        gauge = StrainGauges.at_nodes(covariance, 8 * length)
        slope = sp.csr_matrix((gauge.full_weights[0], (gauge.rows, gauge.nodes)), shape=(len(mesh.nodes),) * 2)
        cut_offs_px.append(_cut_off(mesh, periods, slope @ field, length / 2 + 2, slope=True))
    scale = np.asarray(gauges, dtype=np.float64) / lengths
    return cut_offs_px[0], cut_offs_px[1], scale * np.asarray(cut_offs_px[2:])


def _integrals(mesh: Tri3Mesh, number: FloatArray, n_parts: int = 6) -> FloatArray:
    """Return the integrals (N, 2 P) of each shape function times cosine and sine of wave numbers (P,) along x.

    They are summed over so many `n_parts` of an element's side: 1e-3 of the amplitude at a period of two elements.
    """
    i, j = np.indices((n_parts, n_parts)).reshape(2, -1)
    low, high = (
        i + j < n_parts,
        i + j < n_parts - 1,
    )  # the parts as the element lies, and those upside down between them
    b, c = (np.concatenate([index_part[low] + 1 / 3, index_part[high] + 2 / 3]) / n_parts for index_part in (i, j))
    shape = np.stack([1 - b - c, b, c], axis=1)
    x = mesh.nodes[mesh.elements, 0] @ shape.T
    phase = x[..., None] * number
    wave = np.concatenate([np.cos(phase), np.sin(phase)], axis=-1)
    sums = np.einsum("qa,eqp->eap", shape, wave) * (mesh.areas / len(b))[:, None, None]
    rows = sp.csr_matrix((np.ones(mesh.elements.size), (mesh.elements.ravel(), np.arange(mesh.elements.size))))
    return np.asarray(rows @ sums.reshape(mesh.elements.size, -1))


def _cut_off(
    mesh: Tri3Mesh,
    periods: FloatArray,
    reproduced: FloatArray,
    rim: float,
    *,
    slope: bool = False,
    min_gain: float = 0.9,
) -> float:
    """Period, in elements, below which less than `min_gain` is found of cosine and sine (N, 2 P) inside the `rim`."""
    number = 2 * np.pi / (8.0 * periods)
    low, high = mesh.nodes.min(axis=0) + 8 * rim, mesh.nodes.max(axis=0) - 8 * rim
    inner = ((mesh.nodes >= low - 1e-9) & (mesh.nodes <= high + 1e-9)).all(axis=1)
    phase = mesh.nodes[inner, :1] * number
    cosine, sine = np.split(reproduced[inner], 2, axis=1)
    if slope:
        cosine, sine = sine / number, -cosine / number
    gain = (cosine * np.cos(phase) + sine * np.sin(phase)).mean(axis=0)
    under_gain = np.flatnonzero(gain < min_gain)
    if not under_gain.size:
        return float(periods[0])
    last = under_gain[-1]
    if last + 1 == len(gain):
        return float("nan")
    return float(np.interp(min_gain, gain[last : last + 2], periods[last : last + 2]))


SIZE_WORDS = {
    "bias, scatter": "noise floor of the displacement in static frames, px; - where the test has a single one",
    "noise": "standard uncertainty of u and v in the key frame, px; the noise floor where that is more",
    "mesh": "discretisation error in the key frame, what the elements cannot follow, px",
    "total": "both, px",
    "strain": "the same three of exx, eyy and exy at the nodes, 1e-6",
    "cut-off": "period of a wave of which a tenth is lost, displacement / strain at the nodes, px",
    "CPU s": "of the solve of a frame",
}
"""Meaning of the headings of `size_rows`."""
GAUGE_WORDS = {
    "resolution": "noise of the strain, 1e-6",
    "largest": "99 % of the strains in the key frame are smaller, 1e-6: longer gauges level peaks",
    "cut-off": "period of a wave of which a tenth of the strain is lost, px",
}
"""Meaning of the headings of `gauge_rows`."""


def size_rows(study: ResolutionStudy) -> tuple[list[str], list[list[str]]]:
    """Return the headings and one row per element size."""
    rows = []
    for size_figures in _documents(study):
        micro = [1e6 * size_figures[f"strain_{key}"] for key in ("noise", "discretisation", "total")]
        cells = [format_number(size_figures["speckles"]), f"{size_figures['nodes']}", f"{size_figures['measured']:.0%}"]
        cells += [", ".join(format_number(size_figures[key]) for key in ("bias_px", "scatter_px"))]
        cells += [format_number(size_figures[key]) for key in ("noise_px", "discretisation_px", "total_px")]
        cells += [
            ", ".join(map(format_number, micro)),
            f"{size_figures['cut_off_px']:.0f}, {size_figures['strain_cut_off_px']:.0f}",
        ]
        rows.append([f"{size_figures['element_size_px']:g} px", *cells, format_number(size_figures["solve_cpu_s"])])
    headings = ["elements", "speckles", "nodes", "measured", "bias, scatter", "noise", "mesh", "total"]
    return [*headings, "strain: noise, mesh, total", "cut-off", "CPU s"], rows


def gauge_rows(study: ResolutionStudy) -> tuple[list[str], list[list[str]]]:
    """Return the headings and one row per element size and virtual strain gauge."""
    rows = []
    for size_figures in _documents(study):
        for gauge in size_figures["gauges"]:
            length, noise, largest, cut_off = gauge.values()
            cells = [f"{length:g} px", format_number(1e6 * noise), format_number(1e6 * largest), f"{cut_off:.0f}"]
            rows.append([f"{size_figures['element_size_px']:g} px", *cells])
    return ["elements", "gauge", "resolution", "largest", "cut-off"], rows


def write_study(study: ResolutionStudy, out: Path, *, overwrite: bool = False) -> None:
    """Write resolution.csv, resolution.json and resolution.png into a folder, which is made where it does not exist.

    Raises
    ------
    ResultError
        A study is already there, or the folder cannot be written.
    """
    sizes = _documents(study)
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    headings = [key for key, value in sizes[0].items() if not isinstance(value, str | list)]
    lines.writerow([*headings, *(f"gauge_{key}" for key in _NO_GAUGE)])
    for size_figures in sizes:
        for gauge in size_figures["gauges"] or [_NO_GAUGE]:
            lines.writerow([f"{value:.6g}" for value in (*(size_figures[key] for key in headings), *gauge.values())])
    figures = {
        "key_frame": {"index": study.frame, "name": study.name},
        "static_frames": study.static,
        "speckle_px": study.speckle,
        "preparation_cpu_s": study.preparation,
        "recommendation": study.choice,
        "sizes": sizes,
    }
    contents = text.getvalue(), schema_document("resolution", figures), _figure(study)
    write_findings(out, FILES, *contents, overwrite=overwrite)


_ERRORS = ("bias", "scatter", "stated", "noise", "discretisation", "total")
"""Figures of a size that displacement and strain both have."""
_NO_GAUGE = dict.fromkeys(("length_px", "noise", "largest", "cut_off_px"), float("nan"))


def _documents(study: ResolutionStudy) -> list[dict[str, Any]]:
    """Return the figures of every size with their units in their names, cut-offs and gauges included."""
    lengths_in_elements = sorted({gauge.length / size.element_size for size in study.sizes for gauge in size.gauges})
    displacement_cut_off, strain_cut_off, gauge_cut_offs = cut_offs(tuple(lengths_in_elements))
    cut_off_of = dict(zip(lengths_in_elements, gauge_cut_offs.tolist(), strict=True))

    def gauge_figures(gauge: GaugeFigures, side: float) -> dict[str, float]:
        figures = gauge.length, gauge.noise, gauge.largest, side * cut_off_of[gauge.length / side]
        return dict(zip(_NO_GAUGE, figures, strict=True))

    return [
        {
            "element_size_px": size.element_size,
            "speckles": size.speckles,
            "nodes": size.nodes,
            "measured": size.measured,
            **{f"{name}_px": getattr(size, name) for name in _ERRORS},
            **{f"strain_{name}": getattr(size.strain, name) for name in _ERRORS},
            "cut_off_px": size.element_size * displacement_cut_off,
            "strain_cut_off_px": size.element_size * strain_cut_off,
            "solve_cpu_s": size.seconds,
            "reason": size.reason,
            "gauges": [gauge_figures(gauge, size.element_size) for gauge in size.gauges],
        }
        for size in study.sizes
    ]


def _figure(study: ResolutionStudy) -> Figure:
    """Draw errors over the element size and, over the gauges' length, strain resolution and largest strain."""
    from rgbmidic.tools.report.style import NUMBERS, draw_figure

    panels = (("noise", 1e6, "strain resolution (1e-6)"), ("largest", 1e3, "strain, 99 % quantile (1e-3)"))

    def draw(axes: list[Axes]) -> None:
        _draw_errors(axes[0], study)
        for axis, (key, unit, label) in zip(axes[1:], panels, strict=False):
            for size in (size for size in study.sizes if size.gauges):
                values = [unit * getattr(gauge, key) for gauge in size.gauges]
                axis.plot([gauge.length for gauge in size.gauges], values, "o-", label=f"{size.element_size:g} px")
            axis.set_yscale("log" if key == "noise" else "linear")
            lengths = [gauge.length for size in study.sizes for gauge in size.gauges]
            _finish(axis, lengths, "virtual strain gauge (px)", label)
        if len(axes) > 1:
            axes[-1].legend(title="elements", loc="best")

    count = 3 if any(size.gauges for size in study.sizes) else 1
    return draw_figure(draw, count=count, aspect=1.4, right_room=NUMBERS)


def _draw_errors(axis: Axes, study: ResolutionStudy) -> None:
    sizes = [size.element_size for size in study.sizes]
    for key, label in (("noise", "noise"), ("discretisation", "discretisation error"), ("total", "both")):
        axis.plot(sizes, [getattr(size, key) for size in study.sizes], "o-", label=label)
    axis.set_yscale("log")
    if study.choice is not None:
        axis.axvline(study.choice.element_size, color="0.5", linestyle="--", zorder=0)
    if np.isfinite(study.speckle):
        axis.axvspan(0.7 * min(sizes), SPECKLES * study.speckle, color="0.93", zorder=0)
    axis.set_xlim(0.85 * min(sizes), 1.18 * max(sizes))
    totals = [size.total for size in study.sizes if np.isfinite(size.total)]
    axis.set_ylim(top=3 * max(totals, default=1 / 3))  # room for the legend
    axis.legend(loc="upper center")
    _finish(axis, sizes, "element size (px)", "displacement, rms over the nodes (px)")


def _finish(axis: Axes, lengths: Sequence[float], x: str, y: str) -> None:
    """Label the axes: lengths along x, on a logarithmic scale, and plain numbers along y."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    from rgbmidic.tools.report.style import finish_plot

    finish_plot(axis, x, y)
    ticks = sorted(set(lengths))
    axis.set_xscale("log")
    if axis.get_yscale() == "log":
        axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.yaxis.set_minor_formatter(NullFormatter())
    axis.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_xticks(ticks, [f"{length:g}" for length in ticks])
    axis.set_xticks([], minor=True)
