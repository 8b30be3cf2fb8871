"""The settings of a test: frozen, checked and normalised once, here, whether read from TOML or built in Python.

Paths in the file are relative to the file. Only ``frames.path``, a region and, for colour frames,
``calibration.file`` are needed; an unknown key is an error that names it. A value of numpy, a `Path` in place of a text
and a single entry in place of a list of one are what they stand for, in a file as in Python.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rgbmidic.errors import ConfigurationError
from rgbmidic.settings.conversion import (
    CheckedSettings,
    bounded,
    check_names,
    convert_value,
    read_section,
    read_table,
    read_toml,
    to_plain,
    type_hints,
)
from rgbmidic.settings.sections import (
    CalibrationSettings,
    FrameSettings,
    IlluminationSettings,
    MeshSettings,
    RegionSettings,
    SolverSettings,
    WeightSettings,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleSettings(CheckedSettings):
    """Physical units (``[scale]``): they decide in which units results are reported, not what is measured.

    Attributes
    ----------
    mm_per_pixel
        Millimetres on the specimen for a pixel; None: lengths are reported in px.
    mm_per_pixel_std
        Its standard uncertainty.
    camera
        Instead of `mm_per_pixel`: file with lens and plane, which ``rgbmidic-calibrate camera`` writes.
    frame_rate
        Frames per second, for files that do not state when their frames were taken.
    unit
        Unit of lengths: ``"mm"`` where the scale is known, or ``"px"`` of the image though it is.

    Examples
    --------
    >>> scale = ScaleSettings(mm_per_pixel=0.05, frame_rate=100_000)
    >>> scale.mm_per_pixel, scale.frame_rate
    (0.05, 100000.0)
    """

    section = "scale"

    mm_per_pixel: float | None = bounded(None, above=0, at_most=1e6)
    mm_per_pixel_std: float = bounded(0.0, at_least=0, at_most=1e6)
    camera: Path | None = None
    frame_rate: float | None = bounded(None, above=0, at_most=1e15)
    unit: Literal["mm", "px"] = "mm"

    def _problems(self) -> Iterator[str]:
        if self.camera is not None and self.mm_per_pixel is not None:
            yield f"scale.camera ({self.camera}) and scale.mm_per_pixel both state the scale: leave one of them out"
        if self.mm_per_pixel_std and self.mm_per_pixel is None:
            yield "scale.mm_per_pixel_std is the uncertainty of scale.mm_per_pixel, which is missing"


_Coordinates2 = tuple[tuple[float, float], ...]
_Coordinates3 = tuple[tuple[float, float, float], ...]
_Coordinates4 = tuple[tuple[float, float, float, float], ...]


STRAIN_MEASURES: dict[str, float | None] = {"green-lagrange": 1.0, "hencky": 0.0, "biot": 0.5, "engineering": None}
"""Every strain measure with the power m of ``C = F^T F`` in ``(C^m - I) / (2 m)``, in the limit of 0 ``ln(C) / 2``
(Hill, J Mech Phys Solids 16, 1968); None: small strain. The first is the default."""
if TYPE_CHECKING:
    StrainMeasure = str
else:
    StrainMeasure = Literal[tuple(STRAIN_MEASURES)]

PROBE_NAME = re.compile(r"[^\W_](?:[^\W_]|[ .-]){0,59}")
"""Name of a probe: without ``_``, which parts it from that of the quantity in a column, nor what parts an address."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeSettings(CheckedSettings):
    """Probes that `rgbmidic history` evaluates on a result (``[probes]``); the measurement does not depend on them.

    All places and lengths are in px on the reference.

    Attributes
    ----------
    points
        (x, y).
    lines, regions
        (x0, y0, x1, y1): both ends of a line, two corners of a rectangle, for the mean displacement.
    circles
        (x, y, radius), for the mean displacement.
    gauges
        (x0, y0, x1, y1): extensometers between two points, along the line between them in the deformed state.
    straight_gauges
        The same, along the line in the reference.
    strain_gauges
        (x, y, length): virtual strain gauges.
    cracks
        (x0, y0, x1, y1): two points on a crack of the mesh, between which the displacement jump is read.
    tips
        (x, y, r0, r1): tip of a crack of the mesh, and the radii of the annulus in which Williams' series is fitted.
    youngs_modulus, poissons_ratio, plane
        Of the material, for `tips`: MPa; a number; ``"stress"`` for a thin body, ``"strain"`` for a thick one.
    terms
        Highest term of the series; 0: chosen by a test.
    fit_tip
        Whether the place of a tip along its crack is fitted in every frame.
    measure
        Strain measure of the strain gauges.
    window
        Frames that a parabola takes in for velocities, accelerations and strain rates; 0: none are taken.
    rigid_motion
        ``"tell"``: shift and rotation of the measured field as a whole are reported beside the probes; ``"remove"``:
        they are also subtracted from the displacements.
    names
        Pairs of a probe, kind and number, such as ``"gauge_1"``, and the name that it has in tables and curves.

    Examples
    --------
    >>> probes = ProbeSettings(points=[[120, 80]], gauges=[[40, 80, 200, 80]])
    >>> probes.gauges
    ((40.0, 80.0, 200.0, 80.0),)
    """

    section = "probes"

    points: _Coordinates2 = ()
    lines: _Coordinates4 = ()
    circles: _Coordinates3 = ()
    regions: _Coordinates4 = ()
    gauges: _Coordinates4 = ()
    straight_gauges: _Coordinates4 = ()
    strain_gauges: _Coordinates3 = ()
    cracks: _Coordinates4 = ()
    tips: _Coordinates4 = ()
    youngs_modulus: float | None = bounded(None, above=0, at_most=1e12)
    poissons_ratio: float | None = bounded(None, above=-1, at_most=0.5)
    plane: Literal["stress", "strain"] | None = None
    terms: int = bounded(0, at_least=0, at_most=20)
    fit_tip: bool = False
    measure: StrainMeasure = "green-lagrange"
    window: int = bounded(0, at_least=0)
    rigid_motion: Literal["none", "tell", "remove"] = "none"
    names: tuple[tuple[str, str], ...] = ()

    def _problems(self) -> Iterator[str]:
        if 0 < self.window < 4:
            yield f"probes.window must be 0 or at least 4 frames, not {self.window}"
        for key in ("circles", "strain_gauges"):
            sizes = [size for *_, size in getattr(self, key)]
            if not all(size > 0 for size in sizes):
                yield f"probes.{key} are [x, y, size] with a size above 0, not {sizes}"
        for x0, y0, x1, y1 in self.regions:
            if x0 == x1 or y0 == y1:
                yield f"probes.regions are [x0, y0, x1, y1] of a rectangle with an area, not {[x0, y0, x1, y1]}"
        for *_, inner, outer in self.tips:
            if not 0 < inner < outer:
                yield f"probes.tips are [x, y, r0, r1] with radii 0 < r0 < r1 in px, not {inner:g} and {outer:g}"
        missing = [key for key in ("youngs_modulus", "poissons_ratio", "plane") if getattr(self, key) is None]
        if self.tips and missing:
            yield (
                'probes.tips need probes.youngs_modulus (MPa), probes.poissons_ratio and probes.plane ("stress" or '
                f'"strain"); missing: {", ".join(missing)}'
            )
        if self.terms == 1:
            yield "probes.terms must be 0 (chosen by a test) or at least 2, not 1"
        check_names((probe for probe, _ in self.names), self.labels, "probe", "probes.names")
        names = [name for _, name in self.names]
        for name in names:
            if not PROBE_NAME.fullmatch(name) or names.count(name) > 1:
                allowed = 'different, of letters, digits, spaces, "." and "-" (60 at most)'
                yield f'probes.names must be {allowed}, not "{name}"'

    @property
    def labels(self) -> list[str]:
        """Kind and number of every probe, such as ``"straight_gauge_1"``."""
        kinds = [kind for kind, _ in self.kind_coordinates]
        return [f"{kind}_{kinds[: i + 1].count(kind)}" for i, kind in enumerate(kinds)]

    @property
    def kind_coordinates(self) -> list[tuple[str, tuple[float, ...]]]:
        """Kind, such as ``"straight_gauge"``, and place of every probe."""
        return [
            (entry.name[:-1], coordinates)
            for entry in fields(self)
            if isinstance(getattr(self, entry.name), tuple) and entry.name != "names"
            for coordinates in getattr(self, entry.name)
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelSettings(CheckedSettings):
    """Analog channels recorded beside a test (``[channels]``), such as a force; nothing measured depends on them.

    At most one of `offset`, `trigger` and `align` relates the clock of the recorder to that of the frames.

    Attributes
    ----------
    file
        CSV file (`rgbmidic.results.Channels`); None: there are no channels.
    offset
        Seconds that are added to the recorded times to make them those of the frames.
    trigger
        Name of the channel with the trigger signal: its first crossing of the middle of its range is the time 0.
    align
        Name of a channel and of a column of the histories: the offset is that of their largest correlation.
    area
        Cross-section of the specimen in square mm, for a stress.
    force
        Name of the channel with the force; None: the only one whose name ends in N or kN.

    Examples
    --------
    >>> channels = ChannelSettings(file="force.csv", trigger="trigger_V", area=40.0)
    >>> channels.trigger, channels.offset
    ('trigger_V', 0.0)
    """

    section = "channels"

    file: Path | None = None
    offset: float = bounded(0.0, at_least=-1e15, at_most=1e15)
    trigger: str | None = None
    align: tuple[str, str] | None = None
    area: float | None = bounded(None, above=0, at_most=1e15)
    force: str | None = None

    def _problems(self) -> Iterator[str]:
        clock_keys = [name for name in ("offset", "trigger", "align") if getattr(self, name)]
        if len(clock_keys) > 1:
            yield f"channels.{' and channels.'.join(clock_keys)} both relate the clocks: state one of them"
        other_keys = [entry.name for entry in fields(self) if getattr(self, entry.name) and entry.name != "file"]
        if self.file is None and other_keys:
            yield f"channels.{other_keys[0]} is of channels, whose file (channels.file) is not stated"


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupSettings(CheckedSettings):
    """Description of the experiment for `rgbmidic report` (``[setup]``), which no file holds; None: not stated.

    The good-practice guide of the International Digital Image Correlation Society asks for these (section 5 and
    appendix; doi:10.32720/idics/gpg.ed1).

    Attributes
    ----------
    camera
        Maker and model of camera and sensor.
    lens, aperture
        Maker, model and focal length; f-number.
    stand_off
        Distance from the lens to the specimen.
    lamps
        Kind, colours and places of the lamps, filters and polarisers.
    pattern
        How the speckle was made.
    specimen, loading
        What was tested, and how.
    operator
        Who tested.
    notes
        Anything else.

    Examples
    --------
    >>> SetupSettings(lens="100 mm macro", aperture="f/8").aperture
    'f/8'
    """

    section = "setup"

    camera: str | None = None
    lens: str | None = None
    aperture: str | None = None
    stand_off: str | None = None
    lamps: str | None = None
    pattern: str | None = None
    specimen: str | None = None
    loading: str | None = None
    operator: str | None = None
    notes: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TestSettings(CheckedSettings):
    """All settings of a test, as `rgbmidic.pipeline.measure` takes them.

    Attributes
    ----------
    frames, region, calibration, mesh, illumination, weights, solver, scale, setup, probes, channels
        The sections of the same name.
    base
        Folder that relative paths start from.

    Examples
    --------
    >>> from rgbmidic import TestSettings
    >>> frames = {"path": "frames/*.tif", "kind": "monochrome"}
    >>> settings = TestSettings.from_mapping({"frames": frames, "region": {"rectangle": [10, 10, 90, 70]}})
    >>> settings.mesh.element_size, settings.frames.reference
    (25.0, (0,))
    """

    __test__ = False

    frames: FrameSettings
    region: RegionSettings = field(default_factory=RegionSettings)
    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    mesh: MeshSettings = field(default_factory=MeshSettings)
    illumination: IlluminationSettings = field(default_factory=IlluminationSettings)
    weights: WeightSettings = field(default_factory=WeightSettings)
    solver: SolverSettings = field(default_factory=SolverSettings)
    scale: ScaleSettings = field(default_factory=ScaleSettings)
    setup: SetupSettings = field(default_factory=SetupSettings)
    probes: ProbeSettings = field(default_factory=ProbeSettings)
    channels: ChannelSettings = field(default_factory=ChannelSettings)
    base: Path = field(default_factory=Path)

    def _problems(self) -> Iterator[str]:
        if self.mesh.error and self.frames.update_reference:
            yield "mesh.error is for one reference, and frames.update_reference makes others: leave one of them out"
        if self.mesh.file is None and not self.region.is_stated:
            yield "[region] is missing or empty: it needs exactly one of rectangle, polygon, mask; given are 0"
        if self.mesh.file is not None and (scale := self.scale.mm_per_pixel) is not None:
            yield f"scale.mm_per_pixel ({scale}) states a scale, mesh.points hold another: leave it out"

    @classmethod
    def from_mapping(cls, document: Mapping[str, Any], base: Path | str = ".") -> TestSettings:
        """Build the settings from sections of plain values, as TOML gives them.

        Parameters
        ----------
        document
            Section name to its keys and values.
        base
            Folder that relative paths start from.

        Returns
        -------
        TestSettings

        Raises
        ------
        ConfigurationError
            A section or key is unknown, missing, of the wrong type, out of range, or contradicts another.
        """
        if not isinstance(document, Mapping):
            raise ConfigurationError(f"the document of a test maps sections to their keys; given is {document!r:.80}")
        folder: Path = convert_value(base, Path, "base").resolve()
        kinds = section_types()
        check_names(document, kinds, "section", "the file")
        if "frames" not in document:
            raise ConfigurationError("the section [frames] is missing")
        document = without_former_keys(document)
        sections = {name: read_section(kinds[name], name, read_table(document, name), folder) for name in document}
        return cls(base=folder, **sections)

    def to_mapping(self) -> dict[str, dict[str, Any]]:
        """Return the settings as sections of plain values, defaults included, without `base` and what is not known.

        ``TestSettings.from_mapping(settings.to_mapping(), settings.base)`` gives the settings back.

        Returns
        -------
        dict of str to dict
        """
        return {
            name: {key: value for key, value in to_plain(getattr(self, name)).items() if value is not None}
            for name in section_types()
        }


def section_types() -> dict[str, Any]:
    """Return the names of the sections of a TEST.toml, and the classes that hold their keys."""
    return {name: kind for name, kind in type_hints(TestSettings).items() if is_dataclass(kind)}


def read_test(path: Path | str) -> TestSettings:
    """Read the settings of a test from a TOML file; paths in it are relative to it.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    TestSettings

    Raises
    ------
    ConfigurationError
        The file is missing, not TOML, or has an entry that `TestSettings.from_mapping` refuses; the file is named.

    Examples
    --------
    >>> settings = read_test("test.toml")
    >>> settings.frames.path, settings.calibration.file.name
    (('frames/*.dng',), 'calibration.json')
    """
    file: Path = convert_value(path, Path, "read_test: path")
    document = read_toml(file, "settings file")
    try:
        return TestSettings.from_mapping(document, file.parent)
    except ConfigurationError as error:
        raise ConfigurationError(f"{file}: {error}") from None


_FORMER_BRIGHTNESS = {"global": "constant", "local": "auto", "mean": "auto"}


def without_former_keys(document: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the sections with the grey-level keys of former versions replaced by ``solver.brightness``.

    ``illumination.normalise`` divided each image by its local mean in its own frame; ``solver.brightness`` was
    ``"global"``, ``"local"`` or ``"mean"``. What they mean now is logged.

    Raises
    ------
    ConfigurationError
        ``illumination.normalise`` is neither a width nor ``"auto"``, or stands beside a new value of the other key.
    """
    illumination, solver = document.get("illumination", {}), document.get("solver", {})
    if not isinstance(illumination, Mapping) or not isinstance(solver, Mapping):
        return document
    stated = solver.get("brightness", "auto")
    is_former = isinstance(stated, str) and stated in _FORMER_BRIGHTNESS
    if "normalise" not in illumination and not is_former:
        return document
    brightness = _FORMER_BRIGHTNESS[stated] if is_former else stated
    if "normalise" in illumination:
        width = illumination["normalise"]
        is_width = isinstance(width, int | float) and not isinstance(width, bool) and 0 <= width <= 10_000
        if not (is_width or width == "auto"):
            raise ConfigurationError(
                f'illumination.normalise, now solver.brightness, must be a width in px or "auto", not {width!r}'
            )
        if not is_former and stated not in ("auto", "none"):
            raise ConfigurationError(
                f"illumination.normalise = {width!r} and solver.brightness = {stated!r} contradict each other: the "
                "former is now the latter, state only solver.brightness"
            )
        if width == 0:
            brightness = brightness if is_former else "none"
        elif stated != "global" and width != "auto":
            brightness = max(width, 2.0)
        elif not is_former:
            brightness = "auto"
        logger.warning(
            "illumination.normalise = %r is no key any more: solver.brightness = %r is used", width, brightness
        )
        illumination = {key: value for key, value in illumination.items() if key != "normalise"}
    else:
        logger.warning('solver.brightness = "%s" is now "%s", which is used', stated, brightness)
    return {**document, "illumination": illumination, "solver": {**solver, "brightness": brightness}}
