"""Sections of a TEST.toml that state how is measured: frames, lights, region, weights, solver."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypedDict

from rgbmidic.arguments import bounded
from rgbmidic.settings.conversion import CheckedSettings

FrameKind = Literal["bayer", "rgb", "monochrome"]


BAYER_PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
"""The four phases of the Bayer colour filter array, named by the top-left 2x2 cell read row by row."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSettings(CheckedSettings):
    """Frame files, and what they do not state themselves (``[frames]``).

    Attributes
    ----------
    path
        File patterns or folders, one per light fired in succession (monochrome); a single one otherwise. Empty where a
        script gives the frames (`source` of `rgbmidic.measure`).
    kind
        None: as the file states, else ``"bayer"``.
    cfa, black_level, white_level
        None: as the file states. A statement that contradicts the file is an error.
    reference
        Indices of the frames whose average is the reference, or a range of them: ``"0:20"`` are the first twenty.
    first, last, step
        The frames that are measured: every `step`-th from the first to the last (None: of all). Frames are counted from
        0 over all files; the reference need not be among them.
    lights
        Number of lights that fire in turn while a monochrome camera records one series: frame i shows light
        i mod `lights`. `lights` frames make one state, and the other keys count states.
    update_reference
        Whether a later frame becomes the reference where the correlation with the present one is low, for paint that
        changes (incremental correlation). Uncertainties add up (`rgbmidic.correlation.reference_update`), and a node
        that is without data in such a frame stays so.
    shape, dtype
        Rows and columns, and sample type, of headerless files.
    crop_origin
        Column and row in the calibrated frame of the first pixel of cropped frames; None: they are as large as the
        calibrated ones, or nothing in the calibration depends on the position.

    Examples
    --------
    >>> frames = FrameSettings(path="frames/*.tif", kind="monochrome", reference="0:3")
    >>> frames.path, frames.reference
    (('frames/*.tif',), (0, 1, 2))
    """

    section = "frames"

    path: tuple[str, ...]
    kind: FrameKind | None = None
    cfa: str | None = None
    black_level: float | None = bounded(None, at_least=0)
    white_level: float | None = bounded(None, above=0)
    reference: tuple[int, ...] = bounded((0,), at_least=0)
    first: int = bounded(0, at_least=0)
    last: int | None = bounded(None, at_least=0)
    step: int = bounded(1, at_least=1)
    lights: int = bounded(1, at_least=1)
    update_reference: bool = False
    shape: tuple[int, int] | None = bounded(None, at_least=1)
    dtype: Literal["uint8", "uint16", ">u2"] | None = None
    crop_origin: tuple[int, int] | None = bounded(None, at_least=0)

    def _problems(self) -> Iterator[str]:
        if not all(self.path):
            yield "frames.path must name the frame files"
        if len(self.path) > 1 and self.kind != "monochrome":
            yield (
                f"frames.path with {len(self.path)} entries means as many lights fired in succession before a "
                'monochrome camera: state kind = "monochrome", or give a single path'
            )
        if self.lights > 1 and (len(self.path) != 1 or self.kind != "monochrome"):
            yield (
                f"frames.lights = {self.lights} means lights that fire in turn before a monochrome camera that records "
                f'them in one series: state kind = "monochrome" and a single path, not {len(self.path)}'
            )
        if self.last is not None and self.last < self.first:
            yield f"frames.last must be at least frames.first ({self.first}), not {self.last}"
        if not self.reference or len(set(self.reference)) < len(self.reference):
            yield f"frames.reference must name different frames, not {list(self.reference)}"
        if self.cfa is not None:
            object.__setattr__(self, "cfa", self.cfa.upper())
            if self.cfa not in BAYER_PATTERNS:
                yield f'frames.cfa must be one of {", ".join(BAYER_PATTERNS)}, not "{self.cfa}"'
        if self.black_level is not None and self.white_level is not None and self.white_level <= self.black_level:
            yield f"frames.white_level must be above black_level {self.black_level}, not {self.white_level}"


@dataclass(frozen=True, slots=True, kw_only=True)
class IlluminationSettings(CheckedSettings):
    """Separation of the frame into one image per light (``[illumination]``).

    Attributes
    ----------
    demosaic
        Method of `rgbmidic.illumination.separation` for Bayer frames; ``"auto"``: the reflection-aware one, and
        Malvar's for frames too small for it.

    Examples
    --------
    >>> IlluminationSettings(demosaic="malvar").demosaic
    'malvar'
    """

    section = "illumination"

    demosaic: Literal["auto", "reflection-aware", "malvar", "normalised"] = "auto"


FrameCheck = Literal["noise", "levels", "greens", "lights", "demosaiced"]
"""Checks of a frame against its calibration (`rgbmidic.tools.preparation.frame_check`)."""

ELEMENT_SIZE = 25.0
"""Side of the elements in px where nobody states another: the paper's (section 2.2)."""

SMALLEST_HALVED = 8.0
"""Side (px) of the smallest elements of which the discretisation error is known: their halves, of 4 px, have some eight
samples for six unknowns."""

LENGTH_UNITS = {"mm": 1.0, "m": 1000.0, "um": 1e-3, "inch": 25.4}
"""Millimetres in a length of 1 of a mesh's file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationSettings(CheckedSettings):
    """Calibration of the camera and the lights (``[calibration]``).

    Attributes
    ----------
    file
        What ``rgbmidic-calibrate`` wrote; needed for colour frames, unless a script gives its own separation.
    accept
        Checks of the reference frame against the calibration whose contradictions are accepted
        (`rgbmidic.tools.preparation.frame_check`).

    Examples
    --------
    >>> CalibrationSettings(file="calibration.json").file.name
    'calibration.json'
    """

    section = "calibration"

    file: Path | None = None
    accept: tuple[FrameCheck, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshSettings(CheckedSettings):
    """The mesh that is measured on (``[mesh]``): made here, or of finite elements from a file.

    Attributes
    ----------
    element_size
        Side of the elements in px, 25 where none is stated; ``"auto"``: what a study of the test's own frames
        recommends (`rgbmidic.tools.preparation.element_size`); None with `file`, which has its own.
    cracks
        Paths, each of corners (x, y) in px on the reference, along which the mesh is split.
    file
        Finite-element mesh to measure on (`rgbmidic.read_mesh`).
    points
        Pairs (x_mm, y_mm, x_px, y_px), two or more, that place it on the image (`rgbmidic.Placement.fit`).
    unit
        Unit of length of the file; the points are in mm.
    part
        Set of its elements that is measured; None: all.
    error
        Whether the discretisation error is estimated (`rgbmidic.discretisation_error`), in every frame, or in key
        frames (``"key"``): every 16th and the last.
    refine
        Whether elements are bisected where the discretisation error of strain is more than twice its noise
        (`rgbmidic.tools.preparation.refinement.refine`), in the frame of this index, or in a key frame (True).

    Examples
    --------
    >>> mesh = MeshSettings(element_size=20, cracks=[[[60, 100], [120, 100]]], error=True)
    >>> mesh.cracks
    (((60.0, 100.0), (120.0, 100.0)),)
    """

    section = "mesh"

    element_size: float | Literal["auto"] | None = bounded(None, above=0)
    cracks: tuple[tuple[tuple[float, float], ...], ...] = ()
    file: Path | None = None
    points: tuple[tuple[float, float, float, float], ...] | None = None
    unit: Literal["mm", "m", "um", "inch"] | None = None
    part: str | None = None
    error: bool | Literal["key"] = False
    refine: int | Literal[True, False] = False

    def _problems(self) -> Iterator[str]:
        is_refined = self.refine is not False
        for key, is_requested in (("error", self.error), ("refine", is_refined)):
            if is_requested and self.file is None and self.side < SMALLEST_HALVED:
                yield (
                    f"mesh.{key} halves the elements: mesh.element_size must be {SMALLEST_HALVED:g} px or more for it, "
                    f"not {self.side:g}"
                )
        if is_refined and self.element_size == "auto":
            yield 'mesh.refine and mesh.element_size = "auto" both choose the elements: state a number or leave one out'
        for number, crack in enumerate(self.cracks):
            yield from _few_corners(f"mesh.cracks[{number}]", crack, 2, "two")
        if self.file is None:
            for key in ("points", "unit", "part"):
                if getattr(self, key) is not None:
                    yield f"mesh.{key} is for mesh.file, which is missing"
            if self.element_size is None:
                object.__setattr__(self, "element_size", ELEMENT_SIZE)
            return
        for key, value in {"element_size": self.element_size, "cracks": self.cracks, "refine": is_refined}.items():
            if value:
                yield f"mesh.{key} is for a mesh made here, and mesh.file names one: leave one out"
        if (count := len(self.points or ())) < 2:
            yield f"mesh.file needs mesh.points, two or more [x_mm, y_mm, x_px, y_px], not {count}"

    @property
    def side(self) -> float:
        """Side of the elements in px, where it is stated; the default where it is not, or is found by the run."""
        return self.element_size if isinstance(self.element_size, float) else ELEMENT_SIZE


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionSettings(CheckedSettings):
    """The region of interest (``[region]``): exactly one of rectangle, polygon and mask, without the holes.

    With ``mesh.file`` the region is the mesh's area, and these, if stated, restrict it.

    Attributes
    ----------
    rectangle
        (x0, y0, x1, y1) in px.
    polygon
        Corners (x, y) in px.
    mask
        Image file; pixels of at least half of its largest value belong to the region.
    holes
        Polygons, each of corners (x, y) in px, whose pixels do not belong to it.

    Examples
    --------
    >>> region = RegionSettings(rectangle=(10, 10, 90, 70), holes=[[[40, 40], [60, 40], [50, 60]]])
    >>> region.rectangle, len(region.holes)
    ((10.0, 10.0, 90.0, 70.0), 1)
    """

    section = "region"

    rectangle: tuple[float, float, float, float] | None = None
    polygon: tuple[tuple[float, float], ...] | None = None
    mask: Path | None = None
    holes: tuple[tuple[tuple[float, float], ...], ...] = ()

    def _problems(self) -> Iterator[str]:
        count = sum(getattr(self, kind) is not None for kind in ("rectangle", "polygon", "mask"))
        if count > 1:
            yield f"[region] needs exactly one of rectangle, polygon, mask; given are {count}"
        if self.rectangle is not None:
            x0, y0, x1, y1 = self.rectangle
            if x0 >= x1 or y0 >= y1:
                yield f"region.rectangle is [x0, y0, x1, y1] with x0 < x1 and y0 < y1, not {list(self.rectangle)}"
        if self.polygon is not None:
            yield from _few_corners("region.polygon", self.polygon, 3, "three")
        for number, hole in enumerate(self.holes):
            yield from _few_corners(f"region.holes[{number}]", hole, 3, "three")

    @property
    def is_stated(self) -> bool:
        """True if there is a rectangle, polygon or mask."""
        return any(getattr(self, kind) is not None for kind in ("rectangle", "polygon", "mask"))


@dataclass(frozen=True, slots=True, kw_only=True)
class WeightSettings(CheckedSettings):
    """Weighting of the lights (``[weights]``).

    Attributes
    ----------
    method
        ``"statistics"``: by the inverse covariance of the lights' residuals around each pixel, robust;
        ``"threshold"``: the paper's second method, 0 where the blurred image exceeds `threshold`, 1 elsewhere;
        ``"geometry"``: the paper's first method, from lamps, camera and specimen; ``"images"``: masks made by hand;
        ``"none"``: 1 everywhere.
    threshold
        Fraction of the camera's dynamic range (the paper: 2/3); ``"auto"``: found as in the paper, section 3.2, on the
        first deformed frame.
    blur
        Standard deviation of the Gaussian blur in px; several speckles wide.
    geometry
        SCENE.toml with lamps, camera, paint and body, for ``"geometry"``.
    height_map
        npy file with the height (mm, towards the camera) of the specimen at every pixel of the reference over the plane
        of the scene's front point; instead of the scene's body.
    images
        Masks for ``"images"``, of the size of the frames, one per light in the lights' order; see
        `rgbmidic.weights.MaskWeights.read`.
    limit_deg
        Light is excluded within this angle of the mirror direction (the paper: 15); None: soft weights, the inverse of
        the variance expected from geometry, paint and camera noise.

    Examples
    --------
    >>> WeightSettings().method, WeightSettings(method="threshold", threshold=0.5).threshold
    ('statistics', 0.5)
    """

    section = "weights"

    method: Literal["statistics", "threshold", "geometry", "images", "none"] = "statistics"
    threshold: float | Literal["auto"] = bounded(2 / 3, above=0, at_most=1)
    blur: float = bounded(10.0, above=0)
    geometry: Path | None = None
    height_map: Path | None = None
    images: tuple[Path, ...] = ()
    limit_deg: float | None = bounded(None, above=0, below=180)

    def _problems(self) -> Iterator[str]:
        geometric = self.method == "geometry"
        if geometric != (self.geometry is not None):
            yield 'weights.method = "geometry" and weights.geometry = "SCENE.toml" go together'
        if (self.method == "images") != bool(self.images):
            yield 'weights.method = "images" and weights.images = ["MASK.png", ...] go together'
        for key in ("height_map", "limit_deg"):
            if not geometric and getattr(self, key) is not None:
                yield f'weights.{key} is for weights.method = "geometry"'


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverSettings(CheckedSettings):
    """The MIDIC minimisation (``[solver]``), and the options of `rgbmidic.correlate`.

    Attributes
    ----------
    prefilter
        Filter on reference and deformed images: ``"none"``, ``"binomial"`` ([1 2 1] in x and y, zero at the Bayer
        carriers) or ``"gaussian"`` (standard deviation 1 px).
    rigid
        Rigid functions per light after the first: ``"none"``, ``"translation"`` or ``"translation+rotation"``.
    brightness
        Grey-level correction, ``g(x + u) = a(x) f(x) + b`` for every light: the standard deviation (px) of the window
        over which the gain a is smooth; ``"auto"``, by the size of the speckle; ``"constant"``, one gain a light;
        ``"none"``, grey levels are compared as they are.
    fill
        Longest distance in px over which nodes that are not measured get a value carried over from measured ones,
        flagged and with an uncertainty that grows with the distance; 0 leaves them NaN.
    tolerance
        The iteration stops when a tenth of this (px) is left of the motion of any node, as the last two steps have it.
    max_iterations
        Iterations before the frame counts as not converged.

    Examples
    --------
    >>> from rgbmidic import SolverSettings
    >>> SolverSettings(fill=3).fill
    3.0
    >>> SolverSettings(tolerance=0)
    Traceback (most recent call last):
        ...
    rgbmidic.errors.ConfigurationError: solver.tolerance must be above 0, not 0
    """

    section = "solver"

    prefilter: Literal["none", "binomial", "gaussian"] = "binomial"
    rigid: Literal["none", "translation", "translation+rotation"] = "none"
    brightness: float | Literal["auto", "constant", "none"] = bounded("auto", at_least=2, at_most=10_000)
    fill: float = bounded(0.0, at_least=0)
    tolerance: float = bounded(1e-3, above=0)
    max_iterations: int = bounded(50, at_least=1)


class SolverOptions(TypedDict, total=False):
    """The fields of `SolverSettings` as options of a function.

    Examples
    --------
    >>> options: SolverOptions = {"fill": 3, "prefilter": "none"}
    >>> SolverSettings(**options).prefilter
    'none'
    """

    prefilter: Literal["none", "binomial", "gaussian"]
    rigid: Literal["none", "translation", "translation+rotation"]
    brightness: float | Literal["auto", "constant", "none"]
    fill: float
    tolerance: float
    max_iterations: int


def _few_corners(key: str, corners: tuple[Any, ...], min_count: int, count_name: str) -> Iterator[str]:
    """Report a path or polygon of too few corners."""
    if len(corners) < min_count:
        yield f"{key} needs at least {count_name} corners [x, y], not {len(corners)}"
