"""The pictures of a study: the paper's Figs 4 to 11 and 13 to 17 with the virtual bench's data."""

from __future__ import annotations

from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.patheffects import withStroke

from bench import Topography
from measurement import BLUR, METHODS, PaperStudy, SceneStudy
from measures import Goniometry
from rgbmidic.fields import high_pass
from rgbmidic.tools.report import STYLE, finish_plot

AREA_COLOURS = ("#1f8fe0", "#2ca25f", "#d9a400", "#e8590c", "#d6279a")


@mpl.rc_context(STYLE)
def draw_figures(study: PaperStudy) -> dict[str, Figure]:
    """The figures by the name of their file."""
    figures = {
        "fig09_goniometry.png": goniometry_figure(study.goniometry),
        "fig10_11_topography.png": topography_figure(study.topography),
    }
    for scene in study.scenes:
        name = scene.bench.name
        figures |= {
            f"{name}_fig04_images.png": images_figure(scene),
            f"{name}_fig05_dic.png": displacement_maps(scene, "dic"),
            f"{name}_fig06_means.png": mean_figure(scene),
            f"{name}_fig07_08_13_17_perturbation.png": perturbation_figure(scene),
            f"{name}_fig15_midic.png": displacement_maps(scene, "midic"),
            f"{name}_fig16_masks.png": masks_figure(scene),
            f"{name}_ripple.png": ripple_figure(scene),
        }
        if scene.threshold is not None:
            figures[f"{name}_fig14_threshold.png"] = threshold_figure(scene)
    return figures


def images_figure(scene: SceneStudy) -> Figure:
    """Fig. 4: the light that crosses the areas at 0 degrees and at the largest angle, and its grey level along them."""
    last = scene.angles[-1]
    pictures = {0.0: scene.reference, last: scene.snapshots[last].images}
    figure, axes = _axes(2, 2, 5.2, height_ratios=(3, 1))
    for column, (angle, images) in enumerate(pictures.items()):
        image = images[scene.bench.light]
        axes[0][column].imshow(image, cmap="gray", vmin=0, vmax=1)
        axes[0][column].set_title(f"{scene.names[scene.bench.light]} at {angle:g}°")
        _mark_areas(axes[0][column], scene, label=True)
        row = round(scene.bench.areas[0].centre[1])
        axes[0][column].axhline(row, color="w", linewidth=0.5)
        axes[1][column].plot(100 * image[row], color="0.75", linewidth=0.4)
        axes[1][column].plot(100 * _smooth(image)[row], color="k", linewidth=1)
        axes[1][column].set_ylim(0, 100)
        axes[1][column].set_xlim(0, image.shape[1] - 1)
        finish_plot(axes[1][column], "x (px)", "% of the range" if column == 0 else "")
    return figure


def displacement_maps(scene: SceneStudy, method: str) -> Figure:
    """Figs 5 and 15: U_y of a method at the smallest and at the largest angle."""
    figure, axes = _axes(1, len(scene.snapshots), 3.2)
    for axis, (angle, shot) in zip(axes[0], scene.snapshots.items(), strict=True):
        field = shot.displacement[method][1]
        known = field[np.isfinite(field)]
        limits = tuple(np.percentile(known, [0.5, 99.5])) if known.size else (0, 1)
        figure.colorbar(_map(axis, field, "viridis", limits, scene), ax=axis, aspect=25, pad=0.02)
        axis.set_title(f"U_y (px), {METHODS[method].title}, {angle:g}°")
    return figure


def ripple_figure(scene: SceneStudy) -> Figure:
    """U_y without its long waves: every method at the smallest and at the largest angle."""
    count = len(scene.snapshots)
    figure, axes = _axes(count, len(METHODS), 2.2 * count)
    for row, (angle, shot) in enumerate(scene.snapshots.items()):
        fields = {method: shot.displacement[method][1] for method in METHODS}
        ripples = {
            method: high_pass(field) if np.isfinite(field).sum() > 10 else np.full(field.shape, np.nan)
            for method, field in fields.items()
        }
        limit = float(np.nanpercentile(abs(ripples["dic"]), 97)) or 1e-3
        for column, (method, ripple) in enumerate(ripples.items()):
            axis = axes[row][column]
            picture = _map(axis, ripple, "RdBu_r", (-limit, limit), scene)
            axis.set_title(f"{METHODS[method].title}, {angle:g}°", fontsize=7.5)
        figure.colorbar(picture, ax=axes[row], label="px", aspect=18, pad=0.01)
    return figure


def mean_figure(scene: SceneStudy) -> Figure:
    """Fig. 6: mean displacement of the areas against the angle, plain DIC."""
    figure, axes = _axes(1, 2, 2.6)
    for axis, component, name in zip(axes[0], (1, 0), ("U_y", "U_x"), strict=True):
        for area, colour, series in zip(
            scene.bench.areas, AREA_COLOURS, scene.series("dic", "mean")[:, component].T, strict=True
        ):
            axis.plot(scene.angles, series, marker="o", markersize=3, linewidth=1, color=colour, label=area.name)
        finish_plot(axis, "angle (°)", f"mean {name} (px)")
    axes[0][0].legend(fontsize=7)
    return figure


def perturbation_figure(scene: SceneStudy) -> Figure:
    """Figs 7, 8, 13 and 17: P of the areas against the angle, one panel per method, one scale."""
    figure, axes = _axes(2, 2, 5.4, sharex=True, sharey=True)
    papers = {"dic": "Fig. 7", "glc-dic": "Fig. 8", "midic-unweighted": "Fig. 13", "midic": "Fig. 17"}
    for axis, (method, paper) in zip(axes.flat, papers.items(), strict=True):
        for area, colour, series in zip(scene.bench.areas, AREA_COLOURS, scene.perturbation(method).T, strict=True):
            axis.semilogy(scene.angles, series, marker="o", markersize=3, linewidth=1, color=colour, label=area.name)
        axis.set_title(f"{METHODS[method].title} ({paper})")
        bottom = axis in axes[1]
        finish_plot(axis, "angle (°)" if bottom else "", "P (px)" if axis in axes[:, 0] else "")
    axes.flat[0].legend(fontsize=7)
    return figure


def goniometry_figure(turning: Goniometry) -> Figure:
    """Fig. 9: grey level of the pixels against the angle of the light."""
    figure, axes = _axes(1, 1, 3.6, width=5.5)
    axis = axes[0][0]
    top = turning.levels.max()
    for series, white in zip(turning.levels.T, turning.is_white, strict=True):
        axis.plot(turning.angles_deg, 100 * series / top, linewidth=0.5, color="#e0a030" if white else "#406090")
    axis.plot(
        turning.angles_deg,
        100 * turning.lobe(turning.angles_deg) / top,
        color="k",
        linewidth=1.5,
        label="fit to the mean",
    )
    axis.plot(
        turning.angles_deg, 100 * turning.spread / top, color="#c8102e", linewidth=1.2, label="spread within a paint"
    )
    axis.axvspan(*turning.band, color="0.9", zorder=0, label="erratic band")
    axis.invert_xaxis()
    axis.legend(fontsize=7)
    finish_plot(axis, "angle of the light (°)", "grey level (% of the largest)")
    return figure


def topography_figure(relief: Topography) -> Figure:
    """Figs 10 and 11: intensity, height and local slope of one square millimetre."""
    figure, axes = _axes(1, 3, 2.6)
    points = min(int(1000 / relief.pitch), *relief.height.shape)
    rows, columns = ((n - points) // 2 for n in relief.height.shape)
    side = points * relief.pitch / 1000
    parts = {
        "intensity": (relief.intensity, "gray", ""),
        "height (um)": (relief.height, "viridis", "um"),
        "local slope (°)": (relief.slope, "magma", "°"),
    }
    for axis, (title, (values, colours, unit)) in zip(axes[0], parts.items(), strict=True):
        cut = values[rows : rows + points, columns : columns + points]
        low, high = np.nanpercentile(cut, [0.5, 99.5])
        picture = axis.imshow(cut, cmap=colours, vmin=low, vmax=high, extent=(0, side, side, 0))
        axis.set_title(title)
        axis.set_xlabel("mm")
        if unit:
            figure.colorbar(picture, ax=axis, aspect=20, pad=0.02)
    for line in np.arange(0, side, 0.055):
        axes[0][2].axhline(line, color="w", linewidth=0.2)
        axes[0][2].axvline(line, color="w", linewidth=0.2)
    return figure


def threshold_figure(scene: SceneStudy) -> Figure:
    """Fig. 14: from P around the reflection to the threshold and the mask."""
    found = scene.threshold
    assert found is not None
    figure, axes = _axes(1, 4, 2.3)
    image = scene.reference[scene.bench.light]
    blurred = _smooth(image)
    zone = found.zone
    mask = (blurred <= found.value).astype(float)
    for axis, picture, title in zip(
        axes[0],
        (image, blurred, mask),
        ("image", f"blurred, contour at {found.contour:.0%}", f"p_j at {found.value:.0%}"),
        strict=False,
    ):
        axis.imshow(picture, cmap="gray", vmin=0, vmax=1)
        axis.set_title(title, fontsize=8)
        axis.set_xticks([])
        axis.set_yticks([])
    axes[0][1].add_patch(Circle(zone.centre, zone.radius, fill=False, edgecolor="#c8102e", linewidth=1))
    axis = axes[0][3]
    axis.plot(zone.radii, 1000 * zone.profile, marker="o", markersize=2.5, linewidth=1, color="#1b6ca8")
    axis.axhline(1500 * zone.unaffected, color="0.5", linewidth=0.8, linestyle="--")
    axis.axvline(zone.radius, color="#c8102e", linewidth=1)
    axis.set_title(f"P (1e-3 px), {scene.chosen:g}°: {zone.radius:.0f} px", fontsize=8)
    finish_plot(axis, "distance (px)", "")
    return figure


def masks_figure(scene: SceneStudy) -> Figure:
    """Fig. 16: what every light leaves out at the smallest and at the largest angle, with the areas."""
    count, orange = len(scene.snapshots), ListedColormap(["#e8590c"])
    figure, axes = _axes(count, len(scene.names), 2.6 * count)
    for row, (angle, shot) in enumerate(scene.snapshots.items()):
        for column, name in enumerate(scene.names):
            axis = axes[row][column]
            image = scene.reference[column]
            axis.imshow(image, cmap="gray", vmin=0, vmax=max(0.3, float(np.nanmax(_smooth(image)))))
            excluded = 1 - shot.weights[column]
            axis.imshow(np.ones_like(excluded), cmap=orange, alpha=0.65 * excluded, interpolation="nearest")
            _mark_areas(axis, scene)
            axis.set_title(f"{name}, {angle:g}°", fontsize=8)
            axis.set_axis_off()
    return figure


def _axes(rows: int, columns: int, height: float, *, width: float = 7.5, **settings: Any) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **settings)


def _map(axis: Axes, field: np.ndarray, colours: str, limits: tuple[float, float], scene: SceneStudy) -> Any:
    """A field over the measured square, with the areas; gives the picture, for a colour bar."""
    picture = axis.imshow(field, cmap=colours, vmin=limits[0], vmax=limits[1], interpolation="nearest")
    half, (x, y) = scene.bench.half, scene.bench.scene.camera.centre
    axis.set_xlim(x - half, x + half)
    axis.set_ylim(y + half, y - half)
    _mark_areas(axis, scene)
    axis.set_axis_off()
    return picture


def _mark_areas(axis: Axes, scene: SceneStudy, *, label: bool = False) -> None:
    for area, colour in zip(scene.bench.areas, AREA_COLOURS, strict=True):
        x0, y0, x1, y1 = area.rectangle
        axis.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=colour, linewidth=0.9))
        if label:
            text = axis.text((x0 + x1) / 2, y0 - 12, area.name, color=colour, ha="center", fontsize=7, weight="bold")
            text.set_path_effects([withStroke(linewidth=2, foreground="white")])


def _smooth(image: np.ndarray) -> np.ndarray:
    filled = np.where(np.isfinite(image), image, np.float32(1))
    return np.asarray(cv2.GaussianBlur(filled, (0, 0), BLUR, borderType=cv2.BORDER_REFLECT_101))
