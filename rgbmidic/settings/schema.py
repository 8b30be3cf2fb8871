"""The settings of a test: frozen, checked and normalised once, here, whether read from TOML or built in Python.

Paths in the file are relative to the file. Only ``frames.path``, a region and, for colour frames,
``calibration.file`` are needed; an unknown key is an error that names it. A value of numpy, a `Path` in place of a text
and a single entry in place of a list of one are what they stand for, in a file as in Python.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args

from rgbmidic.errors import ConfigurationError
from rgbmidic.settings.conversion import check_names, convert_value, plain, read_table, read_toml
from rgbmidic.settings.sections import (
    Checked,
    FrameSettings,
    IlluminationSettings,
    RegionSettings,
    SolverSettings,
    WeightSettings,
    bounded,
    converted,
    hints_of,
    require,
    require_corners,
)

_Section = TypeVar("_Section")


FrameCheck = Literal["noise", "levels", "greens", "lights", "demosaiced"]
"""Checks of a frame against its calibration (`rgbmidic.illumination.frame_check`)."""

ELEMENT_SIZE = 25.0
"""Side of the elements in px where nobody states another: the paper's (section 2.2)."""

SMALLEST_HALVED = 8.0
"""Side (px) of the smallest elements of which the discretisation error is known: their halves, of 4 px, have some eight
samples for six unknowns."""

LENGTH_UNITS = {"mm": 1.0, "m": 1000.0, "um": 1e-3, "inch": 25.4}
"""Millimetres in a length of 1 of a mesh's file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleSettings(Checked):
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
    """

    section = "scale"

    mm_per_pixel: float | None = bounded(None, above=0)
    mm_per_pixel_std: float = bounded(0.0, at_least=0)
    camera: Path | None = None
    frame_rate: float | None = bounded(None, above=0)

    def _check(self) -> None:
        require(
            self.camera is None or self.mm_per_pixel is None,
            f"scale.camera ({self.camera}) holds the scale, scale.mm_per_pixel states another: leave one of them out",
        )
        require(
            not self.mm_per_pixel_std or self.mm_per_pixel is not None,
            "scale.mm_per_pixel_std is the uncertainty of scale.mm_per_pixel, which is missing",
        )


_Place2 = tuple[tuple[float, float], ...]
_Place3 = tuple[tuple[float, float, float], ...]
_Place4 = tuple[tuple[float, float, float, float], ...]


PROBE_NAME = re.compile(r"[^\W_](?:[^\W_]|[ .-]){0,59}")
"""Name of a probe: without ``_``, which parts it from that of the quantity in a column, nor what parts an address."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeSettings(Checked):
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
    """

    section = "probes"

    points: _Place2 = ()
    lines: _Place4 = ()
    circles: _Place3 = ()
    regions: _Place4 = ()
    gauges: _Place4 = ()
    straight_gauges: _Place4 = ()
    strain_gauges: _Place3 = ()
    cracks: _Place4 = ()
    tips: _Place4 = ()
    youngs_modulus: float | None = bounded(None, above=0)
    poissons_ratio: float | None = bounded(None, above=-1, at_most=0.5)
    plane: Literal["stress", "strain"] | None = None
    terms: int = bounded(0, at_least=0, at_most=20)
    fit_tip: bool = False
    measure: Literal["green-lagrange", "hencky", "biot", "engineering"] = "green-lagrange"
    window: int = bounded(0, at_least=0)
    rigid_motion: Literal["none", "tell", "remove"] = "none"
    names: tuple[tuple[str, str], ...] = ()

    def _check(self) -> None:
        require(
            self.window == 0 or self.window >= 4, f"probes.window must be 0 or at least 4 frames, not {self.window}"
        )
        for key in ("circles", "strain_gauges"):
            sizes = [size for *_, size in getattr(self, key)]
            require(all(size > 0 for size in sizes), f"probes.{key} are [x, y, size] with a size above 0, not {sizes}")
        for x0, y0, x1, y1 in self.regions:
            require(
                x0 != x1 and y0 != y1,
                f"probes.regions are [x0, y0, x1, y1] of a rectangle with an area, not {[x0, y0, x1, y1]}",
            )
        for *_, inner, outer in self.tips:
            require(
                0 < inner < outer,
                f"probes.tips are [x, y, r0, r1] with radii 0 < r0 < r1 in px, not {inner:g} and {outer:g}",
            )
        missing = [key for key in ("youngs_modulus", "poissons_ratio", "plane") if getattr(self, key) is None]
        require(
            not (self.tips and missing),
            'probes.tips need probes.youngs_modulus (MPa), probes.poissons_ratio and probes.plane ("stress" or '
            f'"strain"), as options --youngs-modulus, --poissons-ratio, --plane; missing: {", ".join(missing)}',
        )
        require(self.terms != 1, "probes.terms must be 0 (chosen by a test) or at least 2, not 1")
        check_names((probe for probe, _ in self.names), self.numbered, "probe", "probes.names")
        given = [name for _, name in self.names]
        for name in given:
            require(
                PROBE_NAME.fullmatch(name) and given.count(name) == 1,
                'probes.names must be different, of letters, digits, spaces, "." and "-" (60 at most), not "'
                + name
                + '"',
            )

    @property
    def numbered(self) -> list[str]:
        """Kind and number of every probe, such as ``"straight_gauge_1"``."""
        kinds = [kind for kind, _ in self.places]
        return [f"{kind}_{kinds[: at + 1].count(kind)}" for at, kind in enumerate(kinds)]

    @property
    def places(self) -> list[tuple[str, tuple[float, ...]]]:
        """Kind, such as ``"straight_gauge"``, and place of every probe."""
        return [
            (entry.name[:-1], place)
            for entry in fields(self)
            if isinstance(getattr(self, entry.name), tuple) and entry.name != "names"
            for place in getattr(self, entry.name)
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelSettings(Checked):
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
    """

    section = "channels"

    file: Path | None = None
    offset: float = 0.0
    trigger: str | None = None
    align: tuple[str, str] | None = None
    area: float | None = bounded(None, above=0)
    force: str | None = None

    def _check(self) -> None:
        stated = [name for name in ("offset", "trigger", "align") if getattr(self, name)]
        require(len(stated) < 2, f"channels.{' and channels.'.join(stated)} both relate the clocks: state one of them")
        others = [entry.name for entry in fields(self) if getattr(self, entry.name) and entry.name != "file"]
        require(
            self.file is not None or not others,
            f"channels.{(others or ['file'])[0]} is of channels, whose file (channels.file) is not stated",
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupSettings(Checked):
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
class TestSettings(Checked):
    """All settings of a test, as `rgbmidic.pipeline.measure` takes them.

    Attributes
    ----------
    frames, region, illumination, weights, solver, scale, setup, probes, channels
        The sections of the same name.
    calibration_file
        ``file`` in ``[calibration]``; needed for colour frames, unless a script gives its own separation.
    accept
        ``accept`` in ``[calibration]``: checks of the reference frame against the calibration whose contradictions are
        accepted (`rgbmidic.illumination.frame_check`).
    element_size
        ``element_size`` in ``[mesh]``: side of the elements in px; ``"auto"``: what a study of the test's own frames
        recommends (`rgbmidic.pipeline.resolution`); None with `mesh_file`, which has its own.
    cracks
        ``cracks`` in ``[mesh]``: paths, each of corners (x, y) in px on the reference, along which the mesh is split.
    mesh_file
        ``file`` in ``[mesh]``: finite-element mesh to measure on (`rgbmidic.read_mesh`).
    mesh_points
        ``points`` in ``[mesh]``: pairs (x_mm, y_mm, x_px, y_px), two or more, that place it on the image
        (`rgbmidic.Placement.fit`).
    mesh_unit
        ``unit`` in ``[mesh]``: unit of length of the file; the points are in mm.
    mesh_part
        ``part`` in ``[mesh]``: set of its elements that is measured; None: all.
    mesh_error
        ``error`` in ``[mesh]``: whether the discretisation error is estimated (`rgbmidic.discretisation_error`), in
        every frame, or in key frames (``"key"``): every 16th and the last.
    mesh_refine
        ``refine`` in ``[mesh]``: whether elements are bisected where the discretisation error of strain is more than
        twice its noise (`rgbmidic.pipeline.resolution.refine`), in the frame of this index, or in a key frame (True).
    base
        Folder that relative paths start from.
    """

    __test__ = False

    frames: FrameSettings
    region: RegionSettings = field(default_factory=RegionSettings)
    calibration_file: Path | None = field(default=None, metadata={"key": "calibration.file"})
    accept: tuple[FrameCheck, ...] = field(default=(), metadata={"key": "calibration.accept"})
    element_size: float | Literal["auto"] | None = field(
        default=None, metadata={"key": "mesh.element_size", "bounds": {"above": 0}}
    )
    cracks: tuple[tuple[tuple[float, float], ...], ...] = field(default=(), metadata={"key": "mesh.cracks"})
    mesh_file: Path | None = field(default=None, metadata={"key": "mesh.file"})
    mesh_points: tuple[tuple[float, float, float, float], ...] | None = field(
        default=None, metadata={"key": "mesh.points"}
    )
    mesh_unit: Literal["mm", "m", "um", "inch"] | None = field(default=None, metadata={"key": "mesh.unit"})
    mesh_part: str | None = field(default=None, metadata={"key": "mesh.part"})
    mesh_error: bool | Literal["key"] = field(default=False, metadata={"key": "mesh.error"})
    mesh_refine: int | Literal[True, False] = field(default=False, metadata={"key": "mesh.refine"})
    illumination: IlluminationSettings = field(default_factory=IlluminationSettings)
    weights: WeightSettings = field(default_factory=WeightSettings)
    solver: SolverSettings = field(default_factory=SolverSettings)
    scale: ScaleSettings = field(default_factory=ScaleSettings)
    setup: SetupSettings = field(default_factory=SetupSettings)
    probes: ProbeSettings = field(default_factory=ProbeSettings)
    channels: ChannelSettings = field(default_factory=ChannelSettings)
    base: Path = field(default_factory=Path, metadata={"key": ""})

    def _check(self) -> None:
        require(
            not (self.mesh_error and self.frames.update_reference),
            "mesh.error is for one reference, and frames.update_reference makes others: leave one of them out",
        )
        for key, asked in (("error", self.mesh_error), ("refine", self.mesh_refine is not False)):
            require(
                not asked or self.mesh_file is not None or self.side >= SMALLEST_HALVED,
                f"mesh.{key} halves the elements: mesh.element_size must be {SMALLEST_HALVED:g} px or more for it, not "
                f"{self.side:g}",
            )
        require(
            self.mesh_refine is False or self.element_size != "auto",
            'mesh.refine and mesh.element_size = "auto" both choose the elements: state a number, or leave refine out',
        )
        for number, crack in enumerate(self.cracks):
            require_corners(f"mesh.cracks[{number}]", crack, 2, "two")
        if self.mesh_file is None:
            for key in ("points", "unit", "part"):
                require(getattr(self, f"mesh_{key}") is None, f"mesh.{key} is for mesh.file, which is missing")
            require(
                self.region.is_stated,
                "[region] is missing or empty: it needs exactly one of rectangle, polygon, mask; given are 0",
            )
            if self.element_size is None:
                object.__setattr__(self, "element_size", ELEMENT_SIZE)
            return
        stated = {"element_size": self.element_size, "cracks": self.cracks, "refine": self.mesh_refine is not False}
        for key, value in stated.items():
            require(not value, f"mesh.{key} is for a mesh made here, and mesh.file names one: leave one out")
        pairs = self.mesh_points or ()
        require(len(pairs) >= 2, f"mesh.file needs mesh.points, two or more [x_mm, y_mm, x_px, y_px], not {len(pairs)}")
        require(
            self.scale.mm_per_pixel is None,
            f"scale.mm_per_pixel ({self.scale.mm_per_pixel}) states a scale, mesh.points hold another: leave it out",
        )

    @property
    def side(self) -> float:
        """Side of the elements in px, where it is stated; the default where it is not, or is found by the run."""
        return self.element_size if isinstance(self.element_size, float) else ELEMENT_SIZE

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
        base = Path(base).resolve()
        hints, sections = hints_of(cast(Any, cls)), section_keys(cls)
        places = {_place(entry): entry.name for entry in fields(cls)}
        check_names(document, sections, "section", "the file")
        values: dict[str, Any] = {"base": base}
        for name in document:
            content = read_table(document, name)
            if name in hints:
                values[name] = read_section(hints[name], name, content, base)
                continue
            check_names(content, sections[name], "key", f"[{name}]")
            for key, value in content.items():
                values[places[name, key]] = convert_value(value, sections[name][key][0], f"{name}.{key}", base)
        for entry in fields(cls):
            if _is_required(entry) and entry.name not in values:
                raise ConfigurationError(f"the section [{entry.name}] is missing")
        return cls(**values)

    def to_mapping(self) -> dict[str, dict[str, Any]]:
        """The settings as sections of plain values, defaults included, without `base` and what is not known.

        ``TestSettings.from_mapping(settings.to_mapping(), settings.base)`` gives the settings back.

        Returns
        -------
        dict of str to dict
        """
        document: dict[str, dict[str, Any]] = {}
        for entry in fields(self):
            section, key = _place(entry)
            value = plain(getattr(self, entry.name))
            if not key and section:
                document[section] = {name: content for name, content in value.items() if content is not None}
            elif section and value is not None:
                document.setdefault(section, {})[key] = value
        return document


def read_section(
    kind: type[_Section], name: str, content: Mapping[str, Any], base: Path | str = ".", /, **ready: Any
) -> _Section:
    """Object of a dataclass from the keys and plain values of a section: of TEST.toml, SCENE.toml or a calibration.

    Parameters
    ----------
    kind
        Class of the section, such as `FrameSettings`.
    name
        Name of the section, for messages.
    content
        Its keys and values.
    base
        Folder that relative paths start from.
    **ready
        Fields that are no keys of the section.

    Returns
    -------
    object of `kind`

    Raises
    ------
    ConfigurationError
        A key is unknown, missing, of the wrong type, out of range, or contradicts another.
    """
    hints = {key: hint for key, hint in hints_of(cast(Any, kind)).items() if key not in ready}
    check_names(content, hints, "key", f"[{name}]")
    for entry in fields(cast(Any, kind)):
        if entry.name in content:
            value, hint, where = content[entry.name], hints[entry.name], f"{name}.{entry.name}"
            inner = next((part for part in (hint, *get_args(hint)) if is_dataclass(part)), None)
            if inner is not None and isinstance(value, Mapping):
                value = read_section(cast(Any, inner), where, value, base)
            ready[entry.name] = converted(entry, value, hint, where, base)
        elif _is_required(entry) and entry.name not in ready:
            raise ConfigurationError(f"{name}.{entry.name} is missing")
    return kind(**ready)


def unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of a JSON file (`object_pairs_hook`), as TOML reads it: a key stated twice is an error.

    Parameters
    ----------
    pairs
        Keys and values of the object, in its order.

    Returns
    -------
    dict

    Raises
    ------
    ValueError
        A key is stated twice.
    """
    keys = [key for key, _ in pairs]
    if len(found := dict(pairs)) < len(keys):
        raise ValueError(f'the key "{next(key for key in found if keys.count(key) > 1)[:40]}" is stated twice')
    return found


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
    """
    path = Path(path)
    document = read_toml(path, "settings file")
    try:
        return TestSettings.from_mapping(document, path.parent)
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}") from None


def _place(entry: Field[Any]) -> tuple[str, str]:
    """Section and key that a field of `TestSettings` comes from; a whole section has no key, `base` has neither."""
    section, _, key = entry.metadata.get("key", entry.name).partition(".")
    return section, key


def _is_required(entry: Field[Any]) -> bool:
    return entry.default is MISSING and entry.default_factory is MISSING


def section_keys(settings: type[TestSettings]) -> dict[str, dict[str, tuple[Any, Field[Any]]]]:
    """For every section its keys, each with the type of its value and the field that holds it."""
    hints = hints_of(cast(Any, settings))
    sections: dict[str, dict[str, tuple[Any, Field[Any]]]] = {}
    for entry in fields(settings):
        section, key = _place(entry)
        if key:
            sections.setdefault(section, {})[key] = hints[entry.name], entry
        elif section:
            parts = hints_of(hints[entry.name])
            sections[section] = {part.name: (parts[part.name], part) for part in fields(hints[entry.name])}
    return sections
