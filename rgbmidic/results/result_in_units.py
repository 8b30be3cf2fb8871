"""A result as an engineer reads it: millimetres and seconds where they are known, finite strain over a stated gauge.

Scale, frame times and exposure come from the settings of the run and from the camera's files; analog channels recorded
beside the test, such as a force, come from a CSV file. What the files for other programs and the report hold is
declared in the field table and here.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from typing import Any, BinaryIO, ClassVar, Literal, Self

import numpy as np

from rgbmidic._version import __version__
from rgbmidic.errors import InputError
from rgbmidic.extensions import MESH_SOURCES, load_extension
from rgbmidic.field import Displacement, Field
from rgbmidic.fields.nodal import NodalCovariance, reference_fraction
from rgbmidic.fields.plane import CameraCalibration, Rectification
from rgbmidic.fields.quantity import ResultQuantity, Units
from rgbmidic.fields.strain import MEASURES, STRAIN, TENSOR, StrainGauges, unchecked_strain
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.results.quantities import (
    DERIVED,
    ELEMENT_STRAIN,
    ERROR_QUANTITIES,
    FAILED,
    MESH_DOCUMENT,
    QUANTITIES,
    STRAIN_COLUMNS,
    UNKNOWN_TIME,
    UV,
    stored_map_quantities,
)
from rgbmidic.results.result import Portable, Result
from rgbmidic.settings import MeshSettings, ScaleSettings
from rgbmidic.typing import AnyArray, BoolArray, FloatArray

logger = logging.getLogger(__name__)

DISPLACEMENT_QUANTITIES = ("u", "v", "u_std", "v_std", "u_bias_std", "v_bias_std")
"""Displacement, its standard uncertainty and the part that the lights' bias leaves, in the order of records."""


def rectification_of(
    result: Result, scale: ScaleSettings | None = None, unit: Literal["mm", "px"] | None = None
) -> Rectification:
    """Return the change from px of the image to rectified px, and the scale.

    Parameters
    ----------
    result
        The result; its provenance holds the camera that its ``[scale]`` names.
    scale
        It replaces the ``[scale]`` that was kept with the result; None: that one.
    unit
        Unit of lengths; None: the scale's.

    Raises
    ------
    CalibrationError
        The camera's file is not usable, or was made with frames of another shape.
    InputError
        The camera holds no plane, or a scale is stated beside that of a mesh of ``mesh.file``.
    """
    stated, camera = result.scale if scale is None else scale, None
    units = Units(mm_per_pixel=stated.mm_per_pixel, mm_per_pixel_std=stated.mm_per_pixel_std)
    if (unit or stated.unit) == "px":
        units = Units()
    elif scale is None:
        camera = stored_camera(result)
    elif scale.camera is not None:
        camera = CameraCalibration.read(scale.camera)
    document = result.provenance.get(MESH_DOCUMENT)
    if camera is not None:
        camera.check(result.frame_shape or camera.shape)
    elif document is not None and units.mm_per_pixel is not None:
        raise InputError(
            f"scale.mm_per_pixel ({units.mm_per_pixel:g}) states a scale, the mesh of {result.path} has another, that "
            "of mesh.file: leave it out"
        )
    elif document is not None and (unit or stated.unit) == "mm" and "camera" not in result.provenance:
        mm_per_pixel, std = load_extension(MESH_SOURCES, MESH_DOCUMENT, "the mesh of the result").scale(document)
        units = Units(mm_per_pixel=mm_per_pixel, mm_per_pixel_std=std)
    return Rectification.of(Tri3Mesh(nodes=result.nodes, elements=result.elements), units, camera)


def stored_camera(result: Result) -> CameraCalibration | None:
    """Return the camera that the ``[scale]`` of a result names, as its provenance holds it; None: none."""
    document = result.provenance.get("camera")
    return None if document is None else CameraCalibration.from_document(document, str(result.scale.camera))


def _stamped_times(result: Result) -> FloatArray:
    """Return the time of each measured frame (n,) in s by its time stamp; NaN where it has none.

    That of a frame that could not be measured, such as one that could not be read, follows from its number.
    """
    stamps, number = result.time_ns[result.finished], result.number[result.finished].astype(np.float64)
    stamped = stamps != UNKNOWN_TIME
    seconds = np.where(stamped, stamps * 1e-9, np.nan)
    if stamped.sum() > 1:
        first, *_, last = number[stamped]
        lost = ~stamped & (result.status[result.finished] == FAILED)
        interval = np.median(np.diff(seconds[stamped]) / np.maximum(np.diff(number[stamped]), 1))
        seconds[lost] = np.interp(number[lost], number[stamped], seconds[stamped])
        seconds[lost] += interval * (number[lost] - np.clip(number[lost], first, last))
    return seconds


def _rises(seconds: FloatArray) -> bool:
    """Report whether all times are known, and each is later than the one before."""
    return bool(np.isfinite(seconds).all() and (np.diff(seconds) > 0).all())


def frame_rate(result: Result, scale: ScaleSettings | None = None) -> tuple[float | None, str]:
    """Return the frame rate of a test and where it is from: that of ``[scale]`` before the camera's.

    Frames that have time stamps do not follow the ``[scale]``.
    """
    stated, recorded = (scale or result.scale).frame_rate, result.provenance.get("frame_rate")
    if stated is not None and not _rises(_stamped_times(result)):
        return stated, "as stated"
    return recorded, "by the camera's file" if recorded else ""


def frame_times(result: Result, scale: ScaleSettings | None = None) -> FloatArray | None:
    """Find the time of each frame.

    Time stamps count where the files have one of every frame that could be measured, and each is later than the one
    before, from the trigger where the camera reports it; else the time is the number of the frame over `frame_rate`,
    that of ``[scale]`` before the camera's.

    Parameters
    ----------
    result
        The result; it is read for the numbers and time stamps.
    scale
        It replaces the ``[scale]`` that was kept with the result; None: that one.

    Returns
    -------
    ndarray, shape (T,), or None
        In seconds, NaN for frames that are not measured yet; None where no time is known.

    Examples
    --------
    >>> frame_times(Result.open("my_result"), ScaleSettings(frame_rate=100.0))[:2].tolist()
    [0.0, 0.01]
    """
    finished, stated = result.finished, (scale or result.scale).frame_rate
    stamps, number, names = _stamped_times(result), result.number[finished], np.array(result.names)[finished]
    if _rises(stamps):
        seconds: FloatArray | None = stamps
        choice = "the frames' own times %.6g: these are taken"
        recorded = np.median(np.maximum(np.diff(number), 1) / np.diff(stamps)) if len(stamps) > 1 else None
    else:
        rate, _ = frame_rate(result, scale)
        recorded, choice = result.provenance.get("frame_rate"), "the camera was set to %.6g: the former is taken"
        seconds = number / rate if rate else None
        if not np.isnan(stamps).all():
            row = int(np.argmax(np.isnan(stamps) | (np.diff(stamps, prepend=-np.inf) <= 0)))
            problem = "has none" if np.isnan(stamps[row]) else "is not later than the one before"
            text = "the time stamps of the frames are not used: %s %s (frame_rate in [scale] states the times)"
            logger.warning(text, names[row], problem)
        if seconds is not None and not _rises(seconds):
            logger.warning("no time is known: the numbers of the frames do not rise")
            seconds = None
    # stamps in whole microseconds give the median interval of 10,000 frames per second to 1 %
    if recorded and stated and abs(recorded / stated - 1) > 0.01:
        logger.warning(f"scale.frame_rate states %g frames per second, {choice}", stated, recorded)
    if seconds is None:
        return None
    times = np.full(len(result), np.nan)
    times[finished] = seconds
    return times


def common_variance_fraction(result: Result) -> float:
    """Return the fraction of a frame's variance that all frames have in common (see `reference_fraction`).

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    float

    Examples
    --------
    >>> common_variance_fraction(Result.open("my_result"))  # one frame is the reference
    0.5
    """
    return reference_fraction(len(result.setting("frames", "reference", [0])))


@dataclass(frozen=True, kw_only=True, eq=False)
class ResultInUnits(Portable):
    """A result with its units: the `FieldSource` of displacements in a plane.

    Attributes
    ----------
    result
        The result.
    scale
        What replaces its ``[scale]``; None: nothing.
    rectified
        Change to rectified px, where a camera is stated.
    timed
        Whether the times of the frames are read, and known.
    gauge
        Length of the virtual strain gauges in (rectified) px; None: the shortest there are.
    measure
        Name of the strain measure, one of `MEASURES`.
    """

    result: Result
    scale: ScaleSettings | None
    rectified: Rectification
    timed: bool = False
    gauge: float | None = None
    measure: str = MEASURES[0]

    @staticmethod
    def from_result(result: Result, scale: ScaleSettings | None = None) -> ResultInUnits:
        """Take the scale and the times of the result, or another ``[scale]`` in place of its own."""
        return result.in_units(scale).with_times()

    @classmethod
    def without_times(cls, result: Result, scale: ScaleSettings | None = None) -> Self:
        """Leave out the times, for which every frame is read: for single frames, or a result that still grows."""
        return cls(result=result, scale=scale, rectified=rectification_of(result, scale))

    def with_times(self) -> Self:
        """Read the times of all frames."""
        return self._changed("units", "columns", timed=self.seconds is not None)

    def with_strain(self, gauge: float | None, measure: str) -> Self:
        """Take the strain over another gauge, or of another measure."""
        return self._changed("gauges", gauge=gauge, measure=measure)

    def refreshed(self, result: Result) -> Self:
        """Take the result with the frames that a run has added since."""
        return self._changed("seconds", result=result)

    def _changed(self, *outdated: str, **changes: Any) -> Self:
        """Change fields, and keep what was derived, such as the covariance of the nodes, unless it is outdated."""
        kept = self.__dict__.keys() - {*self.__dataclass_fields__, *outdated}
        changed = replace(self, **changes)
        changed.__dict__.update({name: self.__dict__[name] for name in kept})
        return changed

    @cached_property
    def units(self) -> Units:
        """Units of lengths and times."""
        return replace(self.rectified.units, timed=self.timed)

    @property
    def times(self) -> FloatArray:
        """Times (T,) of the frames: seconds where they are `timed`, NaN if not measured; else places in the result."""
        seconds = self.seconds if self.timed else None
        return np.arange(len(self.result), dtype=np.float64) if seconds is None else seconds

    components: ClassVar[tuple[str, ...]] = ("u", "v")

    path, names, number, status, finished = (
        property(attrgetter(f"result.{name}")) for name in ("path", "names", "number", "status", "finished")
    )

    @property
    def references(self) -> BoolArray:
        """Mask of the frames that belong to the reference, shape (T,)."""
        return np.isin(np.arange(len(self.result)), self.result.provenance["references"])

    @property
    def common_fraction(self) -> float:
        """Fraction of a frame's variance that all frames have in common."""
        return common_variance_fraction(self.result)

    @property
    def exposure(self) -> float:
        """Exposure of a frame in s; 0 where it is not known."""
        return 1e-9 * (self.result.provenance.get("exposure_ns") or 0)

    @property
    def remarks(self) -> Iterator[str]:
        """Remarks on the lengths, a line each."""
        if (camera := self.rectified.camera) is not None:
            yield f"lengths and strains are those on the plane of {camera.name}: {camera.summary()}"
        if self.units.mm_per_pixel is None:
            yield "no scale is known: lengths are in px (mm_per_pixel in [scale]; `rgbmidic scale` finds it)"

    @cached_property
    def seconds(self) -> FloatArray | None:
        """Time of each frame in s, shape (T,); None where no time is known."""
        return frame_times(self.result, self.scale)

    @property
    def points(self) -> FloatArray:
        """Places of the nodes on the reference in rectified px, shape (N, 2)."""
        return self.mesh.nodes

    @property
    def mesh(self) -> Tri3Mesh:
        """The mesh in rectified px; in px where no camera is stated."""
        return self.rectified.mesh

    @property
    def coordinates(self) -> list[tuple[ResultQuantity, FloatArray]]:
        """Coordinates of the nodes, each with its values (N,): with a camera those on the image too."""
        image, camera = "the reference image", self.rectified.camera
        plane, directions = "the plane of the specimen at the reference", ("to the right", "down")
        systems = [
            ("", self.units.length, self.length * self.mesh.nodes, image if camera is None else plane, directions)
        ]
        if camera is not None:
            systems.append(("_image", "px", self.result.nodes, image, directions))
        if self.result.node_mm is not None:
            directions = ("along its axis x", "along its axis y")
            systems.append(("_mesh", "mm", self.result.node_mm, "the mesh of mesh.file", directions))
        return [
            (
                ResultQuantity(
                    f"{axis}{suffix}", ("node",), unit, "", f"position of the node on {surface}, {direction}"
                ),
                values,
            )
            for suffix, unit, nodes, surface, axis_directions in systems
            for axis, direction, values in zip("xy", axis_directions, nodes.T, strict=True)
        ]

    @property
    def file_attributes(self) -> dict[str, Any]:
        """Attributes of the result as a whole in the files of other programs."""
        attributes: dict[str, Any] = {"title": f"result {self.result.path.name}", "source": f"rgbmidic {__version__}"}
        if (scale := self.units).mm_per_pixel is not None:
            attributes |= {"mm_per_pixel": scale.mm_per_pixel, "mm_per_pixel_std": scale.mm_per_pixel_std}
        if (camera := self.rectified.camera) is not None:
            attributes["camera"] = f"{camera.name}: {camera.summary()}"
        return attributes

    @cached_property
    def covariance(self) -> NodalCovariance:
        """Covariance of the nodes' errors."""
        return NodalCovariance.from_mesh(self.mesh, self.result.nodes)

    @cached_property
    def gauges(self) -> StrainGauges:
        """Virtual strain gauges around the nodes."""
        return StrainGauges.at_nodes(self.covariance, self.gauge)

    @property
    def measure_name(self) -> str:
        """Name of the strain measure with capitals."""
        return self.measure.title()

    def strain_description(self, name: str = "") -> str:
        """Name measure and gauge of a strain; the equivalent strain is that of the Hencky strain whatever is chosen."""
        measure = "Hencky" if name.startswith("equivalent") else self.measure_name
        return f"{measure}, virtual strain gauge of {self.in_units(self.gauges.length)}"

    @property
    def axes(self) -> tuple[str, float]:
        """Unit of the axes of pictures of the image, and that unit over px: mm where each px is as long."""
        return ("px", 1.0) if self.rectified.camera is not None else (self.units.length, self.length)

    def position_text(self, x: float, y: float) -> str:
        """Write a place of the image (px) as text, in the unit of the axes."""
        unit, factor = self.axes
        return f"({x:.0f}, {y:.0f}) px" if unit == "px" else f"({x * factor:.4g}, {y * factor:.4g}) {unit}"

    def in_units(self, length: float) -> str:
        """Write a length (px) as text: in px, and in mm where the scale is known."""
        scale = self.units.mm_per_pixel
        return f"{length:.4g} px" + ("" if scale is None else f" ({length * scale:.3g} mm)")

    @cached_property
    def quantities(self) -> dict[str, ResultQuantity]:
        """Every nodal field by its name, see `FieldSource`."""
        error = self.result.section(MeshSettings).error
        entries = [DERIVED["u"], DERIVED["v"], *STRAIN.values()]
        entries += stored_map_quantities(self.result.lights, with_error=bool(error))
        return {entry.name: entry.with_units(self.units) for entry in entries}

    @cached_property
    def columns(self) -> dict[str, ResultQuantity]:
        """Entries of what `frame` returns: the stackable quantities of the table, and strain; lengths in `units`."""
        stored = {entry.file_name: entry for entry in QUANTITIES.values() if entry.is_stackable}
        finite = {"time_ns", *(entry.name for entry in STRAIN_COLUMNS)}  # small strain gives way to finite strain
        stored = {name: entry for name, entry in stored.items() if name not in finite}
        return {
            entry.name: entry.with_units(self.units) for entry in (*stored.values(), *STRAIN_COLUMNS, *ELEMENT_STRAIN)
        }

    def is_strain(self, name: str) -> bool:
        """Report whether a quantity depends on strain measure and gauge."""
        return name.removesuffix("_element").removesuffix("_std") in STRAIN

    @property
    def length(self) -> float:
        """Factor from px to the unit of lengths."""
        return self.units.mm_per_pixel or 1.0

    def displacement(self, frame: int) -> Displacement:
        """Read the displacement of all nodes in a frame, in rectified px."""
        record = self.result.table.read(frame, DISPLACEMENT_QUANTITIES)
        return self._rectified(record, ("_std", "_bias_std"))[0]

    def _rectified(self, record: Mapping[str, AnyArray], *suffixes: Sequence[str]) -> list[Displacement]:
        """Return the displacement of a record in rectified px, with each group of uncertainties by their suffixes."""
        groups = [[record[f"{name}{suffix}"] for suffix in group for name in UV] for group in suffixes]
        in_px = [Displacement.in_plane(record["u"], record["v"], *std) for std in groups]
        return [self.rectified.displacement(displacement) for displacement in in_px]

    def field(self, name: str, frame: int) -> Field:
        """Read one of the `quantities` with its standard uncertainty in a frame, in the reader's unit."""
        entry = self.quantities[name]
        if name in STRAIN:
            return self.gauges.strain(self.displacement(frame), self.measure)[name]
        if name in self.components:
            return self.units.convert(self.displacement(frame).components[self.components.index(name)])
        record = self.result.frame(frame).values
        if name in ERROR_QUANTITIES:
            values = self._discretisation_error(entry, record)
        elif entry.kind == "fraction":
            light = self.result.lights.index(name.removeprefix("fraction of "))
            values = np.where(record["node_status"] == 0, record["light_fraction"][:, light], np.nan)
        else:
            values = self._stored(record, name)
        return Field(name=name, unit=entry.unit, dims=("node",), values=np.asarray(values, dtype=np.float64))

    def _stored(self, record: Mapping[str, AnyArray], name: str) -> AnyArray:
        """Return a quantity of a record; an uncertainty of u or v is turned into the reader's axes and unit."""
        component, _, suffix = name.partition("_")
        if component not in self.components:
            return np.asarray(record[name])
        rectified = self._rectified(record, [f"_{suffix}"])[0].uncertainty
        return np.asarray(self.length * rectified[self.components.index(component)])

    def _discretisation_error(self, entry: ResultQuantity, record: Mapping[str, AnyArray]) -> FloatArray:
        """Compute one of `ERROR_QUANTITIES` (N,); NaN in frames without."""
        if not record["u_mesh_error"].size:
            return np.full(len(self.result.nodes), np.nan)
        std, error = (
            np.array([self._stored(record, f"{base}{end}") for base in entry.base_quantities], dtype=np.float64)
            for end in ("_std", "_mesh_error")
        )
        if len(error) > 1:
            return np.asarray(np.fmax.reduce(error / std))
        return np.asarray(error[0] if entry.name.endswith("_error") else np.hypot(error, std)[0])

    @property
    def exporter(self) -> Callable[[str, BinaryIO], None] | None:
        """Function that writes the result for other programs into a file; None: those of `rgbmidic.results.export`."""
        return None

    def frame(self, index: int) -> dict[str, AnyArray]:
        """Return the `columns` of one frame, each in its type; errors as `Result.frame`."""
        record, length = self.result.table.read(index), self.length
        displacement, edge = self._rectified(record, ("_std", "_bias_std"), ["_edge_std"])
        gradient = self.rectified.mesh.element_gradient(displacement.values.T)
        in_elements = unchecked_strain(gradient, np.zeros((len(gradient), 4, 4)), self.measure)
        strain = self.gauges.strain(displacement, self.measure)
        columns: dict[str, Any] = {name: np.asarray(record[name]) for name in self.columns if name in record}
        for field in (*map(self.units.convert, displacement.components), *strain.values()):
            columns |= {field.name: field.values, f"{field.name}_std": field.std}
            if field.bias is not None:
                columns[f"{field.name}_bias_std"] = field.bias
        columns |= zip(("u_edge_std", "v_edge_std"), length * np.asarray(edge.std), strict=True)
        return columns | {f"{name}_element": in_elements[name].values for name in TENSOR}
