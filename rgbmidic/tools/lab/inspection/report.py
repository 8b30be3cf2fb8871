"""An inspection on paper: the rows of its tables, inspection.json, and inspection.png."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.illumination.images import REFLECTING
from rgbmidic.tools.lab import format_number, schema_document, write_findings
from rgbmidic.tools.lab.inspection import Inspection, Spread
from rgbmidic.tools.report.style import STYLE, colour_range, finish_picture, literal, shade, show_image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILES = ("inspection.json", "inspection.png")
"""Files that `write_inspection` writes."""
_UNKNOWN_COLOUR = "#e8590c"
"""Colour of what is not known of a light's image."""


def write_inspection(inspection: Inspection, out: Path, *, overwrite: bool = False) -> None:
    """Write inspection.json and inspection.png into a folder, which is made where it does not exist.

    Raises
    ------
    ResultError
        An inspection is already there, or the folder cannot be written.
    """
    figures, picture = inspection_document(inspection), _inspection_figure(inspection)
    write_findings(out, FILES, figures, picture, overwrite=overwrite)


def channel_rows(inspection: Inspection) -> tuple[list[str], list[list[str]]]:
    """Return the headings and one row per camera channel."""
    rows = []
    for channel in inspection.channels:
        noise = f"{channel.noise_dn:.1f}" if inspection.noise_known else f"~ {channel.noise_dn:.0f}"
        fractions = [f"{value:.1%}" for value in (channel.mean, channel.low, channel.high, channel.saturated)]
        rows.append([channel.name, *fractions, format_number(channel.speckle_px, ".1f"), noise])
    return ["channel", "mean", "5 %", "95 %", "saturated", "speckle (px)", "noise (DN)"], rows


def light_rows(inspection: Inspection) -> tuple[list[str], list[list[str]]]:
    """Return the headings and one row per light."""
    rows = []
    for light in inspection.lights:
        reflecting = "-" if light.reflecting is None else f"{light.reflecting:.1%}"
        rows.append([light.name, f"{light.mean:.1%}", f"{light.contrast:.2f}", reflecting, f"{light.valid:.1%}"])
    return ["light", "mean", "contrast", "reflects on", "known on"], rows


def uncertainty_rows(inspection: Inspection) -> tuple[list[str], list[list[str]]]:
    """Return the headings and rows: all lights together, its parts, each light alone."""
    expected = inspection.prediction
    spreads = {"all lights": Spread.of(expected.std)}
    if inspection.kind == "bayer":
        spreads |= {"  from noise": Spread.of(expected.noise), "  from the mosaic": Spread.of(expected.mosaic)}
    if len(inspection.lights) > 1:
        spreads |= {f"{light.name} alone": light.std_alone for light in inspection.lights}
    rows = [
        [name, format_number(spread.median, ".4f"), format_number(spread.q95, ".4f")]
        for name, spread in spreads.items()
    ]
    return ["", "median", "95 %"], rows


def inspection_document(inspection: Inspection) -> dict[str, Any]:
    """Return the figures as plain values, for inspection.json; a number that is not known is null."""
    texture, expected = inspection.texture, inspection.prediction
    figures = {
        "frame": inspection.name,
        "kind": inspection.kind,
        "region_px": int(inspection.region.sum()),
        "element_size_px": inspection.element_size,
        "crosstalk_known": inspection.crosstalk_known,
        "noise_known": inspection.noise_known,
        "speckle_px": inspection.speckle_px,
        "texture": texture
        and {
            "diameter_px": texture.diameter,
            "agreement_of_colours": texture.correlation,
            "channel_specific_fraction": texture.specific,
        },
        "reflects_from_index": REFLECTING,
        "channels": inspection.channels,
        "lights": [
            {("alone_std_px" if name == "std_alone" else name): value for name, value in asdict(light).items()}
            for light in inspection.lights
        ],
        "std_px": Spread.of(expected.std),
        "std_from_noise_px": Spread.of(expected.noise),
        "std_from_mosaic_px": Spread.of(expected.mosaic),
        "nodes_not_measured": inspection.unmeasured_fraction,
        "warnings": [{"code": finding.name, "text": finding.text} for finding in inspection.findings],
    }
    return schema_document("inspection", figures)


def _inspection_figure(inspection: Inspection) -> Figure:
    """One page: lights, reflection index with its colour bar, then troubles, summary and predicted uncertainty."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    lights = len(inspection.lights)
    columns, rows = (2, 2) if inspection.reflection_index is None else (max(lights, 3), 3)
    height, width = inspection.region.shape
    panel = 7.4 / columns
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.6, min(rows * (panel * height / width + 0.45) + 0.6, 11.5)))
        figure.set_layout_engine("constrained", w_pad=0.02, h_pad=0.06)
        grid = figure.add_gridspec(rows, columns + 1, width_ratios=[*[1.0] * columns, 0.05])
        for column, (light, image) in enumerate(zip(inspection.lights, inspection.images.values, strict=True)):
            axis = figure.add_subplot(grid[0, column], facecolor=_UNKNOWN_COLOUR)
            show_image(axis, image, inspection.origin)
            _finish(axis, inspection, f"light {literal(light.name)}" if lights > 1 else "image")
        if inspection.reflection_index is not None:
            for column, (light, index) in enumerate(zip(inspection.lights, inspection.reflection_index, strict=True)):
                axis = figure.add_subplot(grid[1, column], facecolor=_UNKNOWN_COLOUR)
                extent = _extent(inspection)
                image_artist = axis.imshow(index, cmap="inferno", vmin=0, vmax=1, interpolation="auto", extent=extent)
                _finish(axis, inspection, f"{literal(light.name)} reflects on {light.reflecting:.0%}")
            figure.colorbar(image_artist, cax=figure.add_subplot(grid[1, -1]), label="reflection index")
        _draw_trouble(figure.add_subplot(grid[-1, 0]), inspection)
        _draw_std(figure, figure.add_subplot(grid[-1, columns - 1]), figure.add_subplot(grid[-1, -1]), inspection)
        _write_summary(figure.add_subplot(grid[0, 1] if columns == 2 else grid[-1, 1]), inspection)
        rows_px, columns_px = inspection.frame_shape
        figure.suptitle(f"{literal(inspection.name)}, {columns_px} x {rows_px} px", fontsize=10)
    return figure


def _draw_trouble(axis: Axes, inspection: Inspection) -> None:
    """Draw the saturated samples, and where no light shows the texture, over the mean of the lights."""
    from scipy.ndimage import maximum_filter

    show_image(axis, np.nan_to_num(inspection.images.values).mean(axis=0), inspection.origin)
    inside, step = inspection.region, max(1, max(inspection.region.shape) // 700)
    # grown by a pixel and more, so that single samples stay visible in a reduced picture
    grown = maximum_filter(inspection.saturated, size=2 * step + 1)
    for label, mask, shown_mask, colour in (
        ("saturated", inspection.saturated, grown, "#c8102e"),
        ("no light shows it", inspection.lacks_contrast, inspection.lacks_contrast, "#1f5fbf"),
    ):
        cover = (shown_mask & inside)[::step, ::step].astype(np.float32)
        shade(axis, cover, step, inspection.origin, colour)
        axis.plot([], [], "s", color=colour, markersize=5, label=f"{label}: {mask[inside].mean():.1%}")
    box: dict[str, Any] = {"frameon": True, "framealpha": 0.85, "edgecolor": "none", "borderpad": 0.3}
    axis.legend(loc="upper left", fontsize=8, handletextpad=0.2, **box)
    _finish(axis, inspection, "samples in the region")


def _draw_std(figure: Figure, axis: Axes, bar: Axes, inspection: Inspection) -> None:
    """Draw the predicted uncertainty of u and v, linear inside each element."""
    from matplotlib.tri import Triangulation

    std, mesh = inspection.prediction.std, inspection.mesh
    has_std = np.isfinite(std)
    axis.set_facecolor("0.85")
    _finish(axis, inspection, "predicted uncertainty")
    if not has_std.any():
        axis.text(0.5, 0.5, "nothing can be measured", transform=axis.transAxes, ha="center", va="center")
        bar.axis("off")
        return
    is_masked = ~has_std[mesh.elements].all(axis=1)
    grid = Triangulation(mesh.nodes[:, 0], mesh.nodes[:, 1], triangles=mesh.elements, mask=is_masked)
    low, high = colour_range(std[has_std])
    picture = axis.tripcolor(grid, np.nan_to_num(std), shading="gouraud", cmap="viridis", vmin=low, vmax=high)
    extend = "max" if std[has_std].max() > high else "neither"
    figure.colorbar(picture, cax=bar, label="px (one sigma)", extend=extend)


def _write_summary(axis: Axes, inspection: Inspection) -> None:
    axis.axis("off")
    spread = Spread.of(inspection.prediction.std)
    lines = [
        "uncertainty of u and v:",
        f"  median {format_number(spread.median, '.4f')} px",
        f"  95 %    {format_number(spread.q95, '.4f')} px",
        f"elements {inspection.element_size:g} px, speckle {format_number(inspection.speckle_px, '.1f')} px",
        *(
            f"{light.name} alone {format_number(light.std_alone.median, '.4f')} px"
            for light in inspection.lights[: 9 if len(inspection.lights) > 1 else 0]
        ),
    ]
    if not inspection.noise_known:
        lines.append("noise not calibrated, estimated")
    if not inspection.crosstalk_known:
        lines.append("crosstalk unknown: channels for lights")
    codes = list(dict.fromkeys(finding.name for finding in inspection.findings))
    lines += ["", "warnings: " + (", ".join(codes) if codes else "none")]
    text = "\n".join(fill(line, 36, subsequent_indent="  ") if line.strip() == line else line for line in lines)
    axis.text(0.02, 0.98, text, transform=axis.transAxes, va="top", fontsize=8, linespacing=1.5, parse_math=False)


def _extent(inspection: Inspection) -> tuple[float, float, float, float]:
    (height, width), (x, y) = inspection.region.shape, inspection.origin
    return (x - 0.5, x + width - 0.5, y + height - 0.5, y - 0.5)


def _finish(axis: Axes, inspection: Inspection, title: str) -> None:
    """Draw title, pixel axes, and the outline of the region where it is not the whole frame."""
    axis.set_title(title)
    x_low, x_high, y_high, y_low = _extent(inspection)
    if not inspection.region.all():
        axes_coordinates = np.arange(x_low + 0.5, x_high), np.arange(y_low + 0.5, y_high)
        axis.contour(*axes_coordinates, inspection.region, [0.5], colors=["#f2c037"], linewidths=0.8)
    finish_picture(axis, (x_low, x_high), (y_low, y_high), has_y_label=axis.get_subplotspec().is_first_col())  # type: ignore[union-attr]
