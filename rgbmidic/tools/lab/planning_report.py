"""A plan on paper: the rows of its tables, plan.json, and plan.png with zones and uncertainty."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.arguments import to_plain
from rgbmidic.errors import InputError
from rgbmidic.tools.lab import format_number, schema_document, write_findings
from rgbmidic.tools.lab.planning import LampPlan, Outlook
from rgbmidic.tools.lab.stereo_planning import StereoOutlook, stereo_figures
from rgbmidic.tools.preparation.element_size import rms
from rgbmidic.tools.report.style import LIGHT_COLOURS, STYLE, finish_picture, literal
from rgbmidic.tools.scene.scene import Scene
from rgbmidic.tools.scene.zones import REFLECTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILES = ("plan.json", "plan.png")
"""Files that `write_plan` writes."""


def write_plan(
    plan: LampPlan,
    proposals: dict[str, LampPlan],
    out: Path,
    *,
    distance: float | None = None,
    stereo: Sequence[StereoOutlook] = (),
    overwrite: bool = False,
) -> None:
    """Write plan.json and plan.png.

    Parameters
    ----------
    plan
        The scene as it is.
    proposals
        Name to better lamps.
    out
        Folder; made where it does not exist.
    distance
        Stand-off distance, mm; None: that of the scene.
    stereo
        What two cameras leave to expect, at several angles; empty: there is one.
    overwrite
        Whether a plan in the folder is replaced.

    Raises
    ------
    ResultError
        A plan is already there, or the folder cannot be written.
    """
    figures, picture = plan_document(plan, proposals, distance, stereo), plan_figure(plan, proposals)
    write_findings(out, FILES, figures, picture, overwrite=overwrite)


def zone_rows(plan: LampPlan) -> tuple[list[str], list[list[str]]]:
    """Headings and one row per state: field fractions where each light reflects, all do, one or none is clean."""
    rows = []
    for label, state in _labelled_states(plan):
        fractions = [*state["reflecting"].values()]
        fractions += [state[key] for key in ("all_reflect", "one_light", "no_light", "saturated")]
        rows.append([label, f"{state['largest_motion_px']:.1f}", *(f"{fraction:.1%}" for fraction in fractions)])
    names = [light.name for light in plan.scene.lights]
    return ["state", "motion (px)", *names, "all", "one", "none", "clipped"], rows


def uncertainty_rows(plan: LampPlan) -> tuple[list[str], list[list[str]]]:
    """Return the headings and one row per state: standard uncertainty over the field in px, and its parts."""
    rows = []
    for label, state in _labelled_states(plan):
        std = state["std_px"]
        values = [std["median"], std["q95"], state["random_px"], state["feigned_by_domes_px"]]
        rows.append([label, *(format_number(value, ".4f") for value in values)])
    return ["state", "median", "95 %", "random", "feigned"], rows


ZONE_WORDS = {
    "all": "every light reflects",
    "one, none": "a single light is clean, no light is",
    "clipped": "white paint saturates a channel",
}
"""Meaning of the headings of `zone_rows`."""
UNCERTAINTY_WORDS = {
    "random": "camera noise, what demosaicing leaves of the mosaic, reflections that change",
    "feigned": "droplets whose lit sides change look as if they moved",
}
"""Meaning of the headings of `uncertainty_rows`."""


def _labelled_states(plan: LampPlan) -> Iterator[tuple[str, dict[str, Any]]]:
    for state_number, outlook in enumerate(plan.outlooks, start=1):
        state = _state(plan, outlook)
        yield f"{state_number}: {state['angle_deg']:g} deg" if state["angle_deg"] else str(state_number), state


def lamp_rows(plan: LampPlan) -> tuple[list[str], list[list[str]]]:
    """Headings and one row per lamp: position (mm) as SCENE.toml states it, direction, largest zone of any state."""
    rows = []
    for index, lamp in enumerate(_lamps(plan)):
        worst = max(plan.fraction(outlook.reflects[index]) for outlook in plan.outlooks)
        position = ", ".join(f"{round(value)}" for value in lamp["position_mm"])
        angles = [f"{lamp[key]:.0f}" for key in ("azimuth_deg", "inclination_deg")]
        rows.append([lamp["name"], f"[{position}]", *angles, f"{worst:.1%}"])
    return ["light", "position = (mm)", "azimuth", "inclination", "reflects on"], rows


def summary(plan: LampPlan) -> str:
    """Return one line: the largest overlap of reflections, and the uncertainty over field and states."""
    overlap = max(plan.fraction(np.asarray(outlook.reflects.sum(axis=0) > 1)) for outlook in plan.outlooks)
    std = f"{plan.std:.4f} px" if math.isfinite(plan.std) else "unbounded: somewhere no light sees"
    return f"reflections overlap on up to {overlap:.1%} of the field; u_std {std}"


def out_of_plane_error(plan: LampPlan, distance: float | None = None) -> dict[str, Any]:
    """Return the strain that a motion towards the camera feigns, dz / D of all lengths: no single camera resolves it.

    Parameters
    ----------
    plan
        The scene as it is.
    distance
        Stand-off distance D from the camera's entrance pupil to the specimen, mm; None: that of the scene.

    Returns
    -------
    dict
        ``stand_off_mm``; ``strain_per_mm``, 1 / D; ``edge_px_per_mm``, the displacement of the point of the field
        farthest from the optical axis; ``unseen_mm``, the motion that moves this point by the uncertainty to expect.

    Raises
    ------
    InputError
        The distance is not positive.
    """
    distance = plan.scene.body.front[2] if distance is None else distance
    if not (distance > 0 and math.isfinite(distance)):
        raise InputError(f"`distance`, from camera to specimen, must be positive and finite, not {distance:g} mm")
    x0, y0, x1, y1 = plan.field
    x, y = plan.scene.camera.centre
    edge = math.hypot(max(x - x0, x1 - x), max(y - y0, y1 - y)) / distance
    figures = {"stand_off_mm": distance, "strain_per_mm": 1 / distance, "edge_px_per_mm": edge}
    return to_plain(figures | {"unseen_mm": plan.std / edge})  # type: ignore[no-any-return]


def plan_document(
    plan: LampPlan,
    proposals: dict[str, LampPlan],
    distance: float | None = None,
    stereo: Sequence[StereoOutlook] = (),
) -> dict[str, Any]:
    """Return the plan as plain values, for plan.json; fractions are of the field, an unknown number is null."""
    figures = {
        "field_px": plan.field,
        "element_size_px": plan.instrument.element_size,
        "reflects_from_specular_fraction": REFLECTS,
        "out_of_plane": out_of_plane_error(plan, distance),
        **_arrangement(plan),
        "proposals": {name: {"gain": better.gain, **_arrangement(better)} for name, better in proposals.items()},
    }
    if stereo:
        figures["stereo"] = to_plain(stereo_figures(stereo))
    return schema_document("plan", figures)


def _arrangement(plan: LampPlan) -> dict[str, Any]:
    states = [_state(plan, outlook) for outlook in plan.outlooks]
    return {"lights": _lamps(plan), "std_px": plan.std, "states": states}


def _lamps(plan: LampPlan) -> list[dict[str, Any]]:
    """Return lamps; azimuth about the optical axis (0 to the right, 90 down) and inclination from it, from the body."""
    lamps = []
    for light in plan.scene.lights:
        x, y, z = (a - b for a, b in zip(light.position, plan.scene.body.front, strict=True))
        lamps.append(
            {
                "name": light.name,
                "position_mm": light.position,
                "azimuth_deg": math.degrees(math.atan2(y, x)) % 360,
                "inclination_deg": math.degrees(math.atan2(math.hypot(x, y), -z)),
                "power": light.power,
            }
        )
    return lamps


def _state(plan: LampPlan, outlook: Outlook) -> dict[str, Any]:
    inside, names = plan.inside, [light.name for light in plan.scene.lights]
    std = outlook.std[inside & np.isfinite(outlook.std)]
    quantiles = np.quantile(std, [0.5, 0.95, 1.0]).tolist() if std.size else [math.nan] * 3
    return {
        "angle_deg": outlook.state.angle_deg,
        "translation_mm": outlook.state.translation,
        "largest_motion_px": float(np.hypot(*outlook.displacement[:, inside]).max()),
        "reflecting": {name: plan.fraction(mask) for name, mask in zip(names, outlook.reflects, strict=True)},
        "all_reflect": plan.fraction(np.asarray(outlook.reflects.all(axis=0))),
        "one_light": plan.fraction(outlook.clean == 1),
        "no_light": plan.fraction(outlook.clean == 0),
        "saturated": plan.fraction(np.asarray(outlook.saturated.any(axis=0))),
        "std_px": dict(zip(("median", "q95", "largest"), quantiles, strict=True)),
        "random_px": rms(outlook.forecast.std[inside]),
        "feigned_by_domes_px": rms(outlook.forecast.bias[inside]),
    }


def plan_figure(plan: LampPlan, proposals: dict[str, LampPlan]) -> Figure:
    """Zones of the lights (above) and uncertainty (below) in the first and last state, and in the last as proposed."""
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    panels = {"first state": (plan, plan.outlooks[0]), "last state": (plan, plan.outlooks[-1])}
    panels |= {
        f"last state, {name}": (shown_plan, shown_plan.outlooks[-1])
        for name, shown_plan in proposals.items()
        if shown_plan.gain > 1
    }
    levels = np.concatenate([outlook.std[shown_plan.inside] for shown_plan, outlook in panels.values()])
    levels = levels[np.isfinite(levels)]
    top = float(np.quantile(levels, 0.98)) if levels.size else 1.0
    height, width = plan.scene.camera.shape
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(2.9 * len(panels) + 0.6, 2 * 2.7 * height / width + 0.9), layout="compressed")
        axes = figure.subplots(2, len(panels), squeeze=False, sharex=True, sharey=True)
        for column, (title, (shown_plan, outlook)) in enumerate(panels.items()):
            _draw_zones(axes[0, column], shown_plan, outlook)
            angle_text = f": {outlook.state.angle_deg:g}°" if outlook.state.angle_deg else ""
            axes[0, column].set_title(literal(f"{title}{angle_text}"))
            axes[1, column].set_facecolor("0.85")
            image_options = {"cmap": "magma", "vmin": 0, "vmax": top, "interpolation": "nearest"}
            image = axes[1, column].imshow(
                np.ma.masked_invalid(outlook.std), extent=_extent(shown_plan), **image_options
            )
            _draw_field(axes[1, column], shown_plan)
        figure.colorbar(image, ax=list(axes[1]), label="u_std (px)", extend="max", aspect=20, pad=0.02)
        lines = [Line2D([], [], color=colour) for colour in _colours(plan.scene)]
        lines += [Line2D([], [], color="0.3", linestyle="--"), Line2D([], [], color="k", linewidth=0.9)]
        labels = [*(literal(light.name) for light in plan.scene.lights), "at rest", "field"]
        figure.legend(lines, labels, loc="outside upper center", ncols=len(labels))
    return figure


def _colours(scene: Scene) -> list[str]:
    return [LIGHT_COLOURS.get(light.name, f"C{index}") for index, light in enumerate(scene.lights)]


def _extent(plan: LampPlan) -> tuple[float, float, float, float]:
    half = (plan.x[0, 1] - plan.x[0, 0]) / 2
    return plan.x[0, 0] - half, plan.x[0, -1] + half, plan.y[-1, 0] + half, plan.y[0, 0] - half


def _draw_zones(axis: Axes, plan: LampPlan, outlook: Outlook) -> None:
    """Draw the specular fractions as colours, zones as lines: broken in the reference state, whole in this one."""
    from matplotlib.colors import to_rgb

    body = np.isfinite(outlook.displacement[0])
    picture = np.where(body[..., None], 0.93, 1.0) * np.ones(3)
    largest = np.fmax(plan.reference.fraction, outlook.zones.fraction)
    for colour, fraction in zip(_colours(plan.scene), largest, strict=True):
        cover = 0.85 * np.clip(np.nan_to_num(fraction), 0, 1)[..., None]
        picture = picture * (1 - cover) + np.array(to_rgb(colour)) * cover
    axis.imshow(picture, extent=_extent(plan), interpolation="bilinear")
    for index, colour in enumerate(_colours(plan.scene)):
        for zones, style in ((plan.reference, "--"), (outlook.zones, "-")):
            fraction = zones.fraction[index]
            if np.nanmin(fraction, initial=1.0) < REFLECTS < np.nanmax(fraction, initial=0.0):
                axis.contour(plan.x, plan.y, fraction, [REFLECTS], colors=[colour], linestyles=style, linewidths=1)
    _draw_field(axis, plan)


def _draw_field(axis: Axes, plan: LampPlan) -> None:
    from matplotlib.patches import Rectangle

    x0, y0, x1, y1 = plan.field
    axis.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor="k", linewidth=0.9))
    height, width = plan.scene.camera.shape
    subplot = axis.get_subplotspec()
    finish_picture(axis, (-0.5, width - 0.5), (-0.5, height - 0.5), has_y_label=subplot.is_first_col())  # type: ignore[union-attr]
    axis.label_outer()
