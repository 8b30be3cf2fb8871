"""An inspection on paper: the rows of its tables, inspection.json, and inspection.png."""

from __future__ import annotations

import json
import math
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic import __version__
from rgbmidic.errors import ResultError
from rgbmidic.illumination.images import REFLECTING
from rgbmidic.lab.inspection import Inspection, Spread
from rgbmidic.report.style import STYLE, colour_range, finish_picture, save_figure
from rgbmidic.typing import AnyArray, BoolArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "channel_rows",
    "check_folder",
    "inspection_document",
    "inspection_figure",
    "light_rows",
    "uncertainty_rows",
    "write_inspection",
]

FILES = ("inspection.json", "inspection.png")
_BOX: dict[str, Any] = {"frameon": True, "framealpha": 0.85, "edgecolor": "none", "borderpad": 0.3}
_PICTURE = 700
"""Longest side (px) of an image in the figure."""


def check_folder(out: Path, *, overwrite: bool) -> None:
    """Raise `ResultError` where an inspection would be overwritten."""
    if out.exists() and not out.is_dir():
        raise ResultError(f"{out} is a file; state a folder")
    taken = [name for name in FILES if (out / name).exists()]
    if taken and not overwrite:
        raise ResultError(f"{out / taken[0]} is already there; state --overwrite or choose another folder")


def write_inspection(seen: Inspection, out: Path, *, overwrite: bool = False) -> None:
    """Write inspection.json and inspection.png into a folder, which is made where it does not exist.

    Raises
    ------
    ResultError
        An inspection is already there, or the folder cannot be written.
    """
    check_folder(out, overwrite=overwrite)
    try:
        out.mkdir(parents=True, exist_ok=True)
        text = json.dumps(inspection_document(seen), indent=2, allow_nan=False)
        (out / "inspection.json").write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise ResultError(f"{out} cannot be written: {error.strerror or error}") from None
    save_figure(inspection_figure(seen), out / "inspection.png")


def channel_rows(seen: Inspection) -> tuple[list[str], list[list[str]]]:
    """Headings and one row per camera channel."""
    rows = []
    for one in seen.channels:
        noise = f"{one.noise_dn:.1f}" if seen.noise_known else f"~ {one.noise_dn:.0f}"
        shares = [f"{share:.1%}" for share in (one.mean, one.low, one.high, one.saturated)]
        rows.append([one.name, *shares, _text(one.speckle_px, 1), noise])
    return ["channel", "mean", "5 %", "95 %", "saturated", "speckle, px", "noise, DN"], rows


def light_rows(seen: Inspection) -> tuple[list[str], list[list[str]]]:
    """Headings and one row per light."""
    rows = []
    for one in seen.lights:
        reflecting = "-" if one.reflecting is None else f"{one.reflecting:.1%}"
        rows.append([one.name, f"{one.mean:.1%}", f"{one.contrast:.2f}", reflecting, f"{one.valid:.1%}"])
    return ["light", "mean", "contrast", "reflects on", "known on"], rows


def uncertainty_rows(seen: Inspection) -> tuple[list[str], list[list[str]]]:
    """Headings and rows: all lights together, what that is made of, each light alone."""
    parts = {"all lights": Spread.of(seen.std)}
    if seen.kind == "bayer":
        parts |= {"  from noise": Spread.of(seen.noise_std), "  from the mosaic": Spread.of(seen.sampling_std)}
    if len(seen.lights) > 1:
        parts |= {f"{light.name} alone": light.alone for light in seen.lights}
    rows = [[name, _text(spread.median, 4), _text(spread.q95, 4)] for name, spread in parts.items()]
    return ["", "median", "95 %"], rows


def _text(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def inspection_document(seen: Inspection) -> dict[str, Any]:
    """The figures as plain values, for inspection.json; a number that is not known is null."""
    texture = seen.texture
    return {
        "schema": "rgbmidic-inspection",
        "rgbmidic": __version__,
        "frame": seen.name,
        "kind": seen.kind,
        "region_px": int(seen.region.sum()),
        "element_size_px": seen.element_size,
        "crosstalk_known": seen.crosstalk_known,
        "noise_known": seen.noise_known,
        "speckle_px": _number(seen.speckle_px),
        "texture": None
        if texture is None
        else {
            "diameter_px": _number(texture.diameter),
            "agreement_of_colours": texture.correlation,
            "private_share": texture.private,
        },
        "reflects_from_index": REFLECTING,
        "channels": [_plain(one) for one in seen.channels],
        "lights": [_plain(one) | {"alone_std_px": _spread(one.alone)} for one in seen.lights],
        "std_px": _spread(Spread.of(seen.std)),
        "std_from_noise_px": _spread(Spread.of(seen.noise_std)),
        "std_from_mosaic_px": _spread(Spread.of(seen.sampling_std)),
        "nodes_not_measured": seen.unmeasured,
        "warnings": [{"code": one.code, "text": one.text} for one in seen.findings],
    }


def _plain(facts: Any) -> dict[str, Any]:
    values = {name: getattr(facts, name) for name in facts.__dataclass_fields__ if name != "alone"}
    return {name: _number(value) if isinstance(value, float) else value for name, value in values.items()}


def _spread(spread: Spread) -> dict[str, float | None]:
    return {"median": _number(spread.median), "q95": _number(spread.q95)}


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def inspection_figure(seen: Inspection) -> Figure:
    """One page: lights, reflection index with its colour bar, then troubles, summary and predicted uncertainty."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    lights = len(seen.lights)
    columns, rows = (2, 2) if seen.reflection_index is None else (max(lights, 3), 3)
    height, width = seen.region.shape
    panel = 7.4 / columns
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.6, min(rows * (panel * height / width + 0.45) + 0.6, 11.5)))
        figure.set_layout_engine("constrained", w_pad=0.02, h_pad=0.06)
        grid = figure.add_gridspec(rows, columns + 1, width_ratios=[*[1.0] * columns, 0.05])
        for light in range(lights):
            _draw_light(figure.add_subplot(grid[0, light]), seen, light)
        if seen.reflection_index is not None:
            for light in range(lights):
                shown = _draw_index(figure.add_subplot(grid[1, light]), seen, light)
            figure.colorbar(shown, cax=figure.add_subplot(grid[1, -1]), label="reflection index")
        _draw_trouble(figure.add_subplot(grid[-1, 0]), seen)
        _draw_std(figure, figure.add_subplot(grid[-1, columns - 1]), figure.add_subplot(grid[-1, -1]), seen)
        _write_summary(figure.add_subplot(grid[0, 1] if columns == 2 else grid[-1, 1]), seen)
        figure.suptitle(f"{seen.name}, {width} x {height} px", fontsize=10)
    return figure


def _draw_light(axis: Axes, seen: Inspection, light: int) -> None:
    image, facts = _reduced(seen.images.values[light]), seen.lights[light]
    known = image[np.isfinite(image)]
    low, high = np.percentile(known, [1, 99]) if known.size else (0, 1)
    axis.set_facecolor("#e8590c")  # what is unknown
    axis.imshow(image, extent=_extent(seen), cmap="gray", vmin=low, vmax=max(high, low + 1e-6), interpolation="auto")
    axis.set_title(f"light {facts.name}" if len(seen.lights) > 1 else "image")
    _frame_axis(axis, seen, first=light == 0)


def _draw_index(axis: Axes, seen: Inspection, light: int) -> Any:
    assert seen.reflection_index is not None
    facts = seen.lights[light]
    index = _reduced(seen.reflection_index[light])
    picture = axis.imshow(index, extent=_extent(seen), cmap="inferno", vmin=0, vmax=1, interpolation="auto")
    axis.set_title(f"{facts.name} reflects on {facts.reflecting:.0%}")
    _frame_axis(axis, seen, first=light == 0)
    return picture


def _draw_trouble(axis: Axes, seen: Inspection) -> None:
    """Saturated samples, and where no light shows the texture, over the mean of the lights."""
    from matplotlib.lines import Line2D

    mean = np.nan_to_num(seen.images.values).mean(axis=0)
    low, high = np.percentile(mean, [1, 99])
    grey = np.clip((_reduced(mean) - low) / max(high - low, 1e-6), 0, 1)
    picture = np.repeat(0.35 + 0.6 * grey[..., None], 3, axis=2)
    marks = {"saturated": (_spread_out(seen.saturated), "#c8102e"), "no light shows it": (seen.hidden, "#1f5fbf")}
    handles = []
    for label, (mask, colour) in marks.items():
        where = _reduced(mask & seen.region)
        picture[where] = 0.25 * picture[where] + 0.75 * np.array(_rgb(colour))
        share = (seen.saturated if label == "saturated" else mask)[seen.region].mean()
        style: dict[str, Any] = {"marker": "s", "linestyle": "", "markersize": 5}
        handles.append(Line2D([], [], color=colour, label=f"{label}: {share:.1%}", **style))
    axis.imshow(picture, extent=_extent(seen), interpolation="nearest")
    axis.set_title("samples in the region")
    axis.legend(handles=handles, loc="upper left", fontsize=8, handletextpad=0.2, **_BOX)
    _frame_axis(axis, seen, first=True)


def _draw_std(figure: Figure, axis: Axes, bar: Axes, seen: Inspection) -> None:
    """Predicted uncertainty of u and v, root mean square, linear inside each element."""
    from matplotlib.tri import Triangulation

    std = np.sqrt((seen.std**2).mean(axis=1))
    known = np.isfinite(std)
    axis.set_title("predicted uncertainty")
    axis.set_facecolor("0.85")
    _frame_axis(axis, seen, first=False)
    if not known.any():
        axis.text(0.5, 0.5, "nothing can be measured", transform=axis.transAxes, ha="center", va="center")
        bar.axis("off")
        return
    blank = ~known[seen.elements].all(axis=1)
    grid = Triangulation(seen.nodes[:, 0], seen.nodes[:, 1], triangles=seen.elements, mask=blank)
    low, high = colour_range(std[known])
    picture = axis.tripcolor(grid, np.nan_to_num(std), shading="gouraud", cmap="viridis", vmin=low, vmax=high)
    extend = "max" if std[known].max() > high else "neither"
    figure.colorbar(picture, cax=bar, label="px (one sigma)", extend=extend)


def _write_summary(axis: Axes, seen: Inspection) -> None:
    axis.axis("off")
    spread = Spread.of(seen.std)
    lines = [
        "uncertainty of u and v:",
        f"  median {_text(spread.median, 4)} px",
        f"  95 %    {_text(spread.q95, 4)} px",
        f"elements {seen.element_size:g} px, speckle {_text(seen.speckle_px, 1)} px",
        *(
            f"{light.name} alone {_text(light.alone.median, 4)} px"
            for light in seen.lights[: 9 if len(seen.lights) > 1 else 0]
        ),
    ]
    if not seen.noise_known:
        lines.append("noise not calibrated, estimated")
    if not seen.crosstalk_known:
        lines.append("crosstalk unknown: channels for lights")
    codes = list(dict.fromkeys(one.code for one in seen.findings))
    lines += ["", "warnings: " + (", ".join(codes) if codes else "none")]
    text = "\n".join(fill(line, 36, subsequent_indent="  ") if line.strip() == line else line for line in lines)
    axis.text(0.02, 0.98, text, transform=axis.transAxes, va="top", fontsize=8, linespacing=1.5)


def _spread_out(mask: BoolArray) -> BoolArray:
    """A mask grown by a pixel and more, so that single samples stay visible in a reduced picture."""
    from scipy.ndimage import maximum_filter

    return np.asarray(maximum_filter(mask, size=2 * _step(mask.shape) + 1))


def _rgb(colour: str) -> tuple[float, float, float]:
    from matplotlib.colors import to_rgb

    return to_rgb(colour)


def _step(shape: tuple[int, ...]) -> int:
    return max(1, max(shape) // _PICTURE)


def _reduced(image: AnyArray) -> AnyArray:
    step = _step(image.shape)
    return image[::step, ::step]


def _extent(seen: Inspection) -> tuple[float, float, float, float]:
    height, width = seen.region.shape
    return (-0.5, width - 0.5, height - 0.5, -0.5)


def _frame_axis(axis: Axes, seen: Inspection, *, first: bool) -> None:
    """Pixel axes, and the outline of the region where it is not the whole frame."""
    height, width = seen.region.shape
    if not seen.region.all():
        axis.contour(seen.region, [0.5], colors=["#f2c037"], linewidths=0.8)
    finish_picture(axis, (-0.5, width - 0.5), (-0.5, height - 0.5), first=first)
