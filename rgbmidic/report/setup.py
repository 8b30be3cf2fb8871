"""What was measured with what, row by row, as the iDICs good-practice guide (2018) asks of a test report.

What a report says in numbers: the course of a test, its noise floor, the size of its speckle.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.results import QUANTITIES, Result, speckle_diameter
from rgbmidic.settings import SetupSettings
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from rgbmidic.results.physical import Physical

__all__ = [
    "Course",
    "NoiseFloor",
    "analysis_rows",
    "hardware_rows",
    "noise_floor",
    "noise_words",
    "reference_words",
    "settings_rows",
    "speckle_size",
]

Rows = Iterator[tuple[str, str]]

_NAMES = {"stand_off": "stand-off distance", "pattern": "patterning", "lamps": "lamps"}
_PREFILTERS = {"none": "none", "binomial": "[1 2 1]/4 along x and y", "gaussian": "Gaussian, σ = 1 px"}
_WEIGHTS = {
    "statistics": "by the statistics of each light's residual, robust",
    "threshold": "a light is excluded where it is brighter than a threshold",
    "geometry": "by the geometry of lamps, camera and specimen",
    "images": "by masks made by hand, one per light",
    "none": "none: every light counts everywhere",
}


def hardware_rows(told: Physical, setup: SetupSettings) -> Rows:
    """Camera, optics, light, image, pattern, specimen; what nobody stated names the key that would."""
    for entry in fields(setup):
        if entry.name not in ("pattern", "notes"):
            yield _NAMES.get(entry.name, entry.name), getattr(setup, entry.name) or _missing(f"setup.{entry.name}")
    result, shape = told.result, told.result.frame_shape
    yield "lights", ", ".join(result.lights)
    if shape is not None:
        rows, columns = shape
        scale = told.units.mm_per_pixel
        field = "" if scale is None else f"; field of view {columns * scale:.4g} x {rows * scale:.4g} mm"
        yield "image", f"{columns} x {rows} px{field}"
    yield "image scale", _scale(told)
    yield "frame rate", _rate(told)
    exposure = result.provenance.get("exposure_ns")
    yield "exposure", "not told by the files" if exposure is None else f"{exposure / 1000:g} µs"
    yield "patterning", setup.pattern or _missing("setup.pattern")
    size = speckle_size(result)
    if size is not None:
        yield "speckle size", f"{told.in_units(size)}, full width at half maximum of the reference's autocorrelation"
    if setup.notes:
        yield "notes", setup.notes


def _missing(key: str) -> str:
    return f"not stated (`{key}`)"


def _scale(told: Physical) -> str:
    scale, std = told.units.mm_per_pixel, told.units.mm_per_pixel_std
    if scale is None:
        return f"{_missing('scale.mm_per_pixel')}: lengths are in px"
    return f"{scale:.6g} mm per px" + (f" ± {std:.2g} (one standard uncertainty)" if std else "")


def _rate(told: Physical) -> str:
    stated, camera = (
        told.result.setting("scale", "frame_rate"),
        told.result.provenance.get("frame_rate"),
    )
    if camera or stated:
        return f"{camera or stated:g} frames per second" + (" (by the camera's file)" if camera else " (as stated)")
    return "the frames' own times" if told.units.timed else f"{_missing('scale.frame_rate')}: time is in frames"


def analysis_rows(told: Physical, floor: NoiseFloor | None) -> Rows:
    """How the frames were analysed."""
    result, set_ = told.result, told.result.setting
    yield "software", f"rgbmidic {result.provenance['versions'].get('rgbmidic', '')}, global finite-element DIC"
    yield "reference", reference_words(told)
    demosaic = set_("illumination", "demosaic")
    if len(result.lights) > 1 and demosaic is not None:
        yield "separation of the lights", f"demosaicing `{demosaic}`, crosstalk unmixed by calibration"
    normalise = set_("illumination", "normalise")
    if normalise is not None:
        yield "grey levels", f"divided by their local mean, σ = {normalise:g} px" if normalise else "as they are"
    yield from _known("image filter", _PREFILTERS.get(set_("solver", "prefilter")))
    yield from _known("weights of the lights", _WEIGHTS.get(set_("weights", "method")))
    yield "elements", _elements(told)
    yield "shape functions", "linear over the mesh; values at the nodes by a quadratic through the nodes around"
    yield "matching criterion", "weighted sum of squared differences over all lights at once"
    yield "interpolant", "cubic B-spline"
    yield from _known("grey-level correction", set_("solver", "brightness"))
    yield from _known("rigid motion between lights", set_("solver", "rigid"))
    length = told.in_units(told.gauges.length)
    yield "strain", f"{told.measure_name}: plane fitted to the displacements of the nodes in a virtual strain gauge"
    yield "virtual strain gauge", f"{length}, at every node"
    yield "smoothing afterwards", "none"
    yield "noise floor", noise_words(told, floor)


def _known(name: str, text: str | None) -> Rows:
    if text is not None:
        yield name, text


def reference_words(told: Physical) -> str:
    """Which frames are the reference."""
    frames = told.result.setting("frames", "reference", list(told.result.provenance["references"]))
    if len(frames) == 1:
        return f"frame {frames[0]}"
    even = frames == list(range(frames[0], frames[-1] + 1))
    return f"the mean of {len(frames)} frames, " + (
        f"{frames[0]} to {frames[-1]}" if even else ", ".join(map(str, frames))
    )


def _elements(told: Physical) -> str:
    mesh, size = told.mesh, told.result.setting("mesh", "element_size")
    stated = told.in_units(mesh.size if size is None else size)
    return f"{len(mesh.elements)} triangles of three nodes, {len(mesh.nodes)} nodes; side {stated}"


def noise_words(told: Physical, floor: NoiseFloor | None) -> str:
    """What static frames scatter by, one standard deviation."""
    if floor is None:
        return 'not known: one static frame only; `reference = "0:20"` of frames before the test would tell it'
    u, v, *strain = floor.measured.values()
    parts = ", ".join(f"{name} {value * 1e6:.3g}" for name, value in zip(("exx", "eyy", "exy"), strain, strict=True))
    length = told.units.length
    return f"u {u:.3g} {length}, v {v:.3g} {length}; {parts} µm/m (one standard deviation, {floor.count} static frames)"


def settings_rows(settings: Mapping[str, Mapping[str, Any]]) -> Rows:
    """Every key of the settings that says something, with its value; the words of ``[setup]`` stand elsewhere."""
    for section, keys in settings.items():
        for key, value in keys.items():
            if section != "setup" and value != []:
                yield f"{section}.{key}", _short(value)


def _short(value: Any) -> str:
    if isinstance(value, list) and len(value) > 12 and all(isinstance(entry, int) for entry in value):
        step = np.diff(value)
        if (step == 1).all():
            return f"{value[0]} to {value[-1]}"
    return str(value)


_TOLD = ("u", "v", "u_std", "v_std", "exx", "eyy", "exy", "exx_std", "eyy_std", "exy_std", "misfit")
_QUANTILES = (0.05, 0.5, 0.95)
_STATIC = 50
"""Static frames that a noise floor is taken from at most: it is known to 2 % then."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Course:
    """What the nodes of some frames tell, frame by frame.

    Attributes
    ----------
    frames : tuple of int, length F
        Places in the result.
    times : ndarray, shape (F,)
        In the unit of `Physical.units`.
    quantiles : dict
        Of each quantity the 5 %, 50 % and 95 % quantile over the nodes, shape (F, 3); NaN where nothing is measured.
    shares : ndarray, shape (F, S)
        Share of the nodes with each `node_status`.
    fastest : float
        Largest velocity of a node between two neighbouring ones of these frames, px per unit of time; 0 where unknown.
    """

    frames: tuple[int, ...]
    times: FloatArray
    quantiles: dict[str, FloatArray]
    shares: FloatArray
    fastest: float

    @classmethod
    def of(cls, told: Physical, frames: Sequence[int]) -> Course:
        """Of these frames, one after the other; a `ResultError` where one is damaged."""
        rows: dict[str, list[FloatArray]] = {name: [] for name in _TOLD}
        codes = range(len(QUANTITIES["node_status"].codes))
        shares, fastest, before = [], 0.0, None
        for frame in frames:
            values = told.frame(frame)
            for name, row in rows.items():
                row.append(_quantiles(values[name]))
            shares.append([float((values["node_status"] == code).mean()) for code in codes])
            here = np.stack([values["u"], values["v"]]) / told.length
            if before is not None:
                step = np.hypot(*(here - before[1])) / (told.times[frame] - told.times[before[0]])
                fastest = max(fastest, float(np.nan_to_num(step).max(initial=0)))
            before = frame, here
        return cls(
            frames=tuple(frames),
            times=told.times[list(frames)],
            quantiles={name: np.array(row) for name, row in rows.items()},
            shares=np.array(shares),
            fastest=fastest,
        )

    def median(self, name: str) -> float:
        """Median over the frames of a quantity's median over the nodes; NaN where nothing is measured."""
        known = self.quantiles[name][:, 1]
        known = known[np.isfinite(known)]
        return float(np.median(known)) if known.size else float("nan")

    @property
    def farthest(self) -> int:
        """The frame whose median node has moved farthest."""
        way = np.hypot(self.quantiles["u"][:, 1], self.quantiles["v"][:, 1])
        return self.frames[int(np.nan_to_num(way).argmax())]

    def extreme(self, name: str) -> float:
        """The value farthest from 0 of a quantity's median over the nodes; NaN where nothing is measured."""
        known = self.quantiles[name][:, 1]
        known = known[np.isfinite(known)]
        return float(known[np.abs(known).argmax()]) if known.size else float("nan")


def _quantiles(values: FloatArray) -> FloatArray:
    known = values[np.isfinite(values)]
    return np.quantile(known, _QUANTILES) if known.size else np.full(len(_QUANTILES), np.nan)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseFloor:
    """Scatter of what static frames show, one standard deviation, as that of a single frame against the reference.

    Attributes
    ----------
    count
        Number of static frames.
    measured
        Of u, v (in the unit of `Physical.units`), exx, eyy and exy: the rms over the nodes.
    """

    count: int
    measured: dict[str, float]


def noise_floor(told: Physical) -> NoiseFloor | None:
    """Noise floor from the frames of the reference, where several of them are measured; else None.

    The reference is their mean, which does not move what they scatter around. A frame of its own scatters against the
    mean of n by the factor sqrt(1 + 1/n) more than they do around theirs.
    """
    result, names = told.result, ("u", "v", "exx", "eyy", "exy")
    static = [place for place in result.provenance["references"] if result.status[place] != 2][:_STATIC]
    if len(static) < 2:
        return None
    sums, squares = np.zeros((2, len(names), len(result.nodes)))
    for frame in static:
        values = told.frame(frame)
        one = np.stack([values[name] for name in names]).astype(np.float64)
        sums, squares = sums + one, squares + one**2
    count = len(static)
    variance = np.maximum(squares - sums**2 / count, 0) / (count - 1)
    variance *= 1 + 1 / len(result.setting("frames", "reference", static))
    known = [row[np.isfinite(row)] for row in variance]
    rms = [float(np.sqrt(row.mean())) if row.size else float("nan") for row in known]
    return NoiseFloor(count=count, measured=dict(zip(names, rms, strict=True)))


def speckle_size(result: Result) -> float | None:
    """Full width at half maximum (px) of the reference's autocorrelation, around the mesh; None where none is kept.

    The median over the lights. The pictures are those of the separated lights, filled in at all pixels; `rgbmidic
    inspect` looks at the samples themselves.
    """
    if result.reference is None:
        return None
    nodes = result.nodes - result.reference_origin
    (left, top), (right, bottom) = nodes.min(axis=0).astype(int), nodes.max(axis=0).astype(int) + 1
    parts = result.reference[:, max(top, 0) : bottom, max(left, 0) : right].astype(np.float32)
    sizes = [size for part in parts if (size := speckle_diameter(part)) is not None]
    return float(np.median(sizes)) if sizes else None
