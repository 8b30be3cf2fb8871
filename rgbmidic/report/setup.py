"""Numbers and rows of a test report as the iDICs Good Practices Guide (2018) asks for them.

Hardware and analysis parameters as rows of tables, quantiles of the fields over time, noise floor, speckle size.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.report.style import time_axis
from rgbmidic.results import QUANTITIES, Result, speckle_diameter
from rgbmidic.settings import SetupSettings
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from rgbmidic.results.physical import Physical

Rows = Iterator[tuple[str, str]]
Cells = Iterator[tuple[str, ...]]

_PREFILTERS = {"none": "none", "binomial": "[1 2 1]/4 along x and y", "gaussian": "Gaussian, σ = 1 px"}
_WEIGHTS = {
    "statistics": "by the statistics of each light's residual, robust",
    "threshold": "a light is excluded where it is brighter than a threshold",
    "geometry": "by the geometry of lamps, camera and specimen",
    "images": "by masks made by hand, one per light",
    "none": "none: every light counts everywhere",
}


def hardware_rows(physical: Physical, setup: SetupSettings) -> Rows:
    """Yield camera, optics, light, image, pattern, specimen; what is not stated names the key that would state it."""
    for entry in fields(setup):
        if entry.name not in ("pattern", "notes"):
            name = "stand-off distance" if entry.name == "stand_off" else entry.name
            yield name, getattr(setup, entry.name) or _missing(f"setup.{entry.name}")
    result, shape = physical.result, physical.result.frame_shape
    scale, std = physical.units.mm_per_pixel, physical.units.mm_per_pixel_std
    yield "lights", ", ".join(result.lights)
    if shape is not None:
        rows, columns = shape
        field = "" if scale is None else f"; field of view {columns * scale:.4g} x {rows * scale:.4g} mm"
        yield "image", f"{columns} x {rows} px{field}"
    if scale is None:
        yield "image scale", f"{_missing('scale.mm_per_pixel')}: lengths are in px"
    else:
        yield "image scale", f"{scale:.6g} mm per px" + (f" ± {std:.2g} (one standard uncertainty)" if std else "")
    if (plane := physical.rectified.camera) is not None:
        yield "lens and plane", f"{plane.name}: {plane.summary()}"
    camera = result.provenance.get("frame_rate")
    if rate := camera or result.setting("scale", "frame_rate"):
        origin = "by the camera's file" if camera else "as stated"
        yield "frame rate", f"{rate:g} frames per second ({origin})"
    else:
        missing = f"{_missing('scale.frame_rate')}: time is in frames"
        yield "frame rate", "the frames' own times" if physical.units.timed else missing
    exposure = result.provenance.get("exposure_ns")
    yield "exposure", "not stated by the files" if exposure is None else f"{exposure / 1000:g} µs"
    yield "patterning", setup.pattern or _missing("setup.pattern")
    width = "full width at half maximum of the reference's autocorrelation"
    if (size := speckle_size(result)) is not None:
        yield "speckle size", f"{physical.in_units(size)}, {width}"
    if setup.notes:
        yield "notes", setup.notes


def _missing(key: str) -> str:
    return f"not stated (`{key}`)"


_FINEST = (2.2, 2.6)
"""Spatial resolution of the displacement at the nodes, in elements, and of a virtual strain gauge's strain, in its
lengths (`rgbmidic.lab.resolution.cut_offs`)."""


def analysis_rows(physical: Physical, floor: NoiseFloor | None) -> Rows:
    """Yield the parameters of the analysis, in the order of the guide; settings that were not kept are left out."""
    result, set_, mesh = physical.result, physical.result.setting, physical.mesh
    demosaic, ran = set_("illumination", "demosaic"), result.provenance.get("grey_levels", {})
    chosen = result.provenance.get("element_size")  # of element_size = "auto"
    stated = set_("mesh", "element_size") if chosen is None else chosen["element_size"]
    size = float(mesh.size if stated is None else stated)
    separation = f"demosaicing `{demosaic}`, crosstalk unmixed by calibration"
    separated = len(result.lights) > 1 and demosaic is not None
    strain = "plane fitted to the displacements of the nodes in a virtual strain gauge"
    normalise = ran.get("normalise")
    levels = f"divided by their local mean, σ = {normalise:g} px" if normalise else "as they are"
    refinement, gauge = result.provenance.get("refinement"), physical.gauges.length  # of mesh.refine
    legs = np.sqrt(2 * mesh.areas)
    ends = (float(f"{end:.3g}") for end in (legs.min(), legs.max())) if refinement else (size,)
    side = " to ".join(map(physical.in_units, ends))
    finest = (("displacement", _FINEST[0] * size), ("strain", _FINEST[1] * gauge))
    rows = (
        ("software", f"rgbmidic {result.provenance['versions'].get('rgbmidic', '')}, global finite-element DIC"),
        ("reference", reference_text(physical)),
        ("separation of the lights", separation if separated else None),
        ("grey levels", None if normalise is None else levels),
        ("image filter", _PREFILTERS.get(set_("solver", "prefilter"))),
        ("weights of the lights", _WEIGHTS.get(set_("weights", "method"))),
        ("elements", f"{len(mesh.elements)} triangles of three nodes, {len(mesh.nodes)} nodes; side {side}"),
        ("data point spacing", f"{side}, at the nodes"),
        ("choice of the elements", None if chosen is None else f"by the run: {chosen['reason']}"),
        ("refinement of the elements", refinement),
        ("shape functions", "linear over the mesh; values at the nodes by a quadratic through the nodes around"),
        ("matching criterion", "weighted sum of squared differences over all lights at once"),
        ("interpolant", "cubic B-spline"),
        ("grey-level correction", ran.get("brightness")),
        ("rigid motion between lights", set_("solver", "rigid")),
        ("strain", f"{physical.measure_name}: {strain}"),
        ("virtual strain gauge", f"{physical.in_units(gauge)}, at every node"),
        ("smoothing afterwards", "none"),
        (
            "spatial resolution",
            ", ".join(f"{name} {physical.in_units(float(f'{period:.2g}'))}" for name, period in finest)
            + ": the period of a wave of which a tenth of the amplitude is lost",
        ),
        ("noise floor", noise_text(physical, floor)),
    )
    yield from ((name, text) for name, text in rows if text is not None)


def methods_text(physical: Physical, setup: SetupSettings, floor: NoiseFloor | None) -> str:
    """Write the paragraph of a paper's methods section; what is not known is left open as [its name]."""
    result, set_, units = physical.result, physical.result.setting, physical.units
    rate = result.provenance.get("frame_rate") or set_("scale", "frame_rate")
    exposure, speckle = result.provenance.get("exposure_ns"), speckle_size(result)
    rows, columns = result.frame_shape or ("[rows]", "[columns]")
    lights, size = result.lights, set_("mesh", "element_size")
    named = f"{len(lights)} lights ({', '.join(lights)}; {setup.lamps or '[lamps and their directions]'})"
    several = (
        f"{named} lit it; the images of each light were evaluated together by multiple-illumination digital image "
        "correlation (Poncelet and Leclerc, 2015)"
    )
    single = f"{setup.lamps or '[lamp]'} lit it; the images were evaluated by global digital image correlation"
    noise = "[noise floor of static frames]"
    if floor is not None:
        u, v, exx, *_ = floor.measured.values()
        noise = (
            f"{u:.2g} {units.length} in x and {v:.2g} {units.length} in y, and {exx * 1e6:.3g} µm/m in the strain exx "
            f"({floor.count} static frames, one standard deviation)"
        )
    return (
        f"The surface was patterned with {setup.pattern or '[patterning]'} (speckle size "
        f"{'[speckle size]' if speckle is None else physical.in_units(speckle)}). {setup.camera or '[camera]'} with "
        f"{setup.lens or '[lens]'} recorded {columns} x {rows} px at {f'{rate:g}' if rate else '[frame rate]'} frames "
        f"per second, exposure {'[exposure]' if exposure is None else f'{exposure / 1000:g} µs'}, while "
        f"{several if len(lights) > 1 else single} with rgbmidic {result.provenance['versions'].get('rgbmidic', '')} "
        f"on linear triangles of {physical.in_units(physical.mesh.size if size is None else size)}"
        f"{', bisected by their discretisation error' if result.provenance.get('refinement') else ''}, against "
        f"{reference_text(physical)}, with cubic B-spline interpolation. Strain is {physical.measure_name} over "
        f"virtual strain gauges of {physical.in_units(physical.gauges.length)}. The noise floor is {noise}. "
        "Uncertainties are standard uncertainties (k = 1)."
    )


def reference_text(physical: Physical) -> str:
    """State which frames are the reference."""
    frames = physical.result.setting("frames", "reference", list(physical.result.provenance["references"]))
    if len(frames) == 1:
        return f"frame {frames[0]}"
    listed = f"{frames[0]} to {frames[-1]}" if _successive(frames) else ", ".join(map(str, frames))
    return f"the mean of {len(frames)} frames, {listed}"


def _successive(numbers: Sequence[int]) -> bool:
    return list(numbers) == list(range(numbers[0], numbers[-1] + 1))


def noise_text(physical: Physical, floor: NoiseFloor | None) -> str:
    """State the noise floor, one standard deviation of each component."""
    if floor is None:
        return 'not known: one static frame only; `reference = "0:20"` of frames before the test would show it'
    u, v, *strain = floor.measured.values()
    parts = ", ".join(f"{name} {value * 1e6:.3g}" for name, value in zip(("exx", "eyy", "exy"), strain, strict=True))
    length = physical.units.length
    return f"u {u:.3g} {length}, v {v:.3g} {length}; {parts} µm/m (one standard deviation, {floor.count} static frames)"


def noise_rows(physical: Physical, floor: NoiseFloor, history: TimeHistory) -> Cells:
    """Yield quantity, unit, noise floor, the part of it that all nodes have in common, and the stated uncertainty."""
    for name, value in floor.measured.items():
        unit = physical.units.length if name in "uv" else "1"
        yield name, unit, *(f"{number:.3g}" for number in (value, floor.common[name], history.median(f"{name}_std")))


def settings_rows(settings: Mapping[str, Mapping[str, Any]]) -> Rows:
    """Yield every key of the settings with its value, but for empty lists and for ``[setup]``, which stands elsewhere.

    More than twelve integers in succession are written as their first and last.
    """
    for section, keys in settings.items():
        for key, value in keys.items():
            if section != "setup" and value != []:
                long = isinstance(value, list) and len(value) > 12 and all(isinstance(entry, int) for entry in value)
                yield f"{section}.{key}", f"{value[0]} to {value[-1]}" if long and _successive(value) else str(value)


_READ = ("u", "v", "u_std", "v_std", "exx", "eyy", "exy", "exx_std", "eyy_std", "exy_std", "misfit")
_QUANTILES = (0.05, 0.5, 0.95)
"""Median, and the band that holds 90 % of the nodes."""
_STATIC = 50
"""Static frames that a noise floor is taken from at most. A standard deviation over n frames and N nodes has the
relative uncertainty 1 / sqrt(2 n N) for independent nodes: below 1 % from 100 nodes on."""


class TimeHistory:
    """Quantiles over the nodes of the fields of some frames, read one frame after the other.

    Parameters
    ----------
    physical
        The result in the units of its scale.
    frames
        Indices of the frames in the result.

    Attributes
    ----------
    frames : tuple of int, length F
        Indices of the frames in the result.
    axis : tuple of ndarray, shape (F,), and str
        Times, or numbers of the frames where no time is known, and the label of the axis.
    timed : bool
        Whether the times are known.
    quantiles : dict
        Of each quantity the 5 %, 50 % and 95 % quantile over the nodes, shape (F, 3); NaN where nothing is measured.
    fractions : ndarray, shape (F, S)
        Fraction of the nodes with each `node_status`.
    fastest : float
        Largest velocity of a node between two neighbouring ones of these frames, px per unit of time; 0 where unknown.

    Raises
    ------
    ResultError
        A frame is damaged.
    """

    def __init__(self, physical: Physical, frames: Sequence[int]) -> None:
        self.frames, self.timed, times = tuple(frames), physical.units.timed, physical.times[list(frames)]
        self.axis = time_axis(times if self.timed else None, physical.result.number[list(frames)])
        self.quantiles = {name: np.full((len(times), len(_QUANTILES)), np.nan) for name in _READ}
        self.fractions = np.empty((len(times), len(QUANTITIES["node_status"].codes)))
        self.fastest, before = 0.0, np.array(np.nan)
        for place, frame in enumerate(frames):
            values = physical.frame(frame)
            for name, quantiles in self.quantiles.items():
                if (known := values[name][np.isfinite(values[name])]).size:
                    quantiles[place] = np.quantile(known, _QUANTILES)
            codes = range(self.fractions.shape[1])
            self.fractions[place] = [(values["node_status"] == code).mean() for code in codes]
            here = np.stack([values["u"], values["v"]]) / physical.length
            if place:
                step = np.hypot(*(here - before)) / (times[place] - times[place - 1])
                self.fastest = max(self.fastest, float(np.nan_to_num(step).max(initial=0)))
            before = here

    def medians(self, name: str) -> FloatArray:
        """Return the medians over the nodes of a quantity, of the frames in which it is finite; else one NaN."""
        known = self.quantiles[name][:, 1]
        return known[np.isfinite(known)] if np.isfinite(known).any() else np.array([np.nan])

    def median(self, name: str) -> float:
        """Return the median over the frames of a quantity's median over the nodes; NaN where nothing is measured."""
        return float(np.median(self.medians(name)))

    def extreme(self, name: str) -> float:
        """Return the value farthest from 0 of a quantity's median over the nodes; NaN where nothing is measured."""
        return float(max(self.medians(name), key=abs))

    def key_frames(self, count: int) -> tuple[int, ...]:
        """Select frames between which the field changes by about as much: its quantiles' path in equal parts."""
        fields = np.stack([self.quantiles[name] for name in ("u", "v")])
        seen = np.flatnonzero(np.isfinite(fields).all(axis=(0, 2)))
        if not len(seen):
            return ()
        path = np.cumsum(np.abs(np.diff(fields[:, seen], axis=1, prepend=0)).sum(axis=(0, 2)))  # from rest
        places = np.searchsorted(path, path[-1] * np.arange(1, count + 1) / count * (1 - 1e-9))
        return tuple(self.frames[seen[place]] for place in sorted({*places.tolist()}))

    @property
    def farthest(self) -> int:
        """The frame whose median displacement is the largest."""
        length = np.hypot(self.quantiles["u"][:, 1], self.quantiles["v"][:, 1])
        return self.frames[int(np.nan_to_num(length).argmax())]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseFloor:
    """Noise floor: standard deviation of the fields of static frames, as of a single frame against the reference.

    Attributes
    ----------
    count
        Number of static frames.
    measured
        Of u, v (in the unit of `Physical.units`), exx, eyy and exy: the rms over the nodes.
    common
        Of the same: the standard deviation of the mean over the nodes, which is what all nodes have in common, such as
        vibration.
    """

    count: int
    measured: dict[str, float]
    common: dict[str, float]


def noise_floor(physical: Physical) -> NoiseFloor | None:
    """Estimate the noise floor from the frames of the reference.

    The reference is the mean of n frames; the differences of these frames among each other do not depend on it. Another
    frame scatters against the mean by sqrt(1 + 1/n) more than they do around their own mean.

    Parameters
    ----------
    physical
        The result in the units of its scale.

    Returns
    -------
    NoiseFloor or None
        None where fewer than two frames of the reference are measured.
    """
    result, names = physical.result, ("u", "v", "exx", "eyy", "exy")
    static = [place for place in result.provenance["references"] if result.status[place] != 2][:_STATIC]
    if len(static) < 2:
        return None
    sums, squares, means = *np.zeros((2, len(names), len(result.nodes))), []
    for frame in static:
        values = physical.frame(frame)
        one = np.stack([values[name] for name in names]).astype(np.float64)
        sums, squares = sums + one, squares + one**2
        known = [row[np.isfinite(row)] for row in one]
        means.append([row.mean() if row.size else np.nan for row in known])
    count, single = len(static), 1 + 1 / len(result.setting("frames", "reference", static))
    known = [row[np.isfinite(row)] for row in np.maximum(squares - sums**2 / count, 0) / (count - 1)]
    rms = [float(np.sqrt(single * row.mean())) if row.size else float("nan") for row in known]
    common = np.sqrt(single) * np.std(means, axis=0, ddof=1)
    return NoiseFloor(
        count=count, measured=dict(zip(names, rms, strict=True)), common=dict(zip(names, common.tolist(), strict=True))
    )


def calibration_tables(result: Result) -> Iterator[tuple[tuple[str, ...], list[tuple[str, ...]]]]:
    """Yield headings and rows of what the run kept of the calibration, and of the reference's exposure."""
    exposed = result.provenance.get("reference_exposure", [])
    rows: list[tuple[str, ...]] = [(one["light"], f"{one['median']:.1%}", f"{one['excluded']:.2%}") for one in exposed]
    if rows:
        yield ("light, in the region of the reference", "median grey level, of full scale", "pixels not usable"), rows
    kept = result.provenance.get("calibration_figures", {})
    if crosstalk := kept.get("crosstalk"):
        std = crosstalk.get("std")
        cells = [
            [f"{value:.5f}" + (f" ± {std[i][j]:.1g}" if std and value != 1 else "") for j, value in enumerate(row)]
            for i, row in enumerate(crosstalk["matrix"])
        ]
        rows = [(f"channel {i + 1}", *row) for i, row in enumerate(cells)]
        rows.append(("amplification of noise", *(f"{value:.2f}" for value in crosstalk["noise_amplification"])))
        yield ("crosstalk", *crosstalk["lights"]), rows
    if registration := kept.get("registration"):
        heads = ("registration", "shift in x, px", "in y, px", "rotation, rad", "scale", "radial")
        parameters = zip(registration["lights"], registration["parameters"], strict=True)
        yield heads, [(light, *(f"{value:.4g}" for value in row)) for light, row in parameters]
    rows = [("noise model", ", ".join(f"{name} {value:.4g}" for name, value in kept.get("noise", {}).items()))]
    for section, origin in kept.get("provenance", {}).items():
        rows.append((f"{section} measured", f"{origin['date']}, from {origin['files']} files"))
        rows += [(f"{section}: warning", warning) for warning in origin["warnings"]]
    if rows := [row for row in rows if row[1]]:
        yield ("calibration", ""), rows


def speckle_size(result: Result) -> float | None:
    """Return the full width at half maximum (px) of the reference's autocorrelation; None where none was kept.

    It is the median over the lights, around the mesh, of the separated images, which are interpolated at all pixels;
    `rgbmidic inspect` evaluates the samples themselves.
    """
    if result.reference is None:
        return None
    nodes = result.nodes - result.reference_origin
    (left, top), (right, bottom) = nodes.min(axis=0).astype(int), nodes.max(axis=0).astype(int) + 1
    parts = result.reference[:, max(top, 0) : bottom, max(left, 0) : right].astype(np.float32)
    sizes = [size for part in parts if (size := speckle_diameter(part)) is not None]
    return float(np.median(sizes)) if sizes else None
