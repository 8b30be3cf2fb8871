"""The calibration of camera and lights, and its JSON file.

`rgbmidic-calibrate` writes the file, the main job reads it. Camera channels = A . lights (rows of A: camera channels,
columns: lights), every column divided by its largest entry, so that a light's image is in grey levels of the channel
that sees it best.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy.typing as npt

from rgbmidic.arguments import check_fields, checked
from rgbmidic.disk import require_regular_file, write_complete
from rgbmidic.errors import CalibrationError
from rgbmidic.frames.data import shift_cfa
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import CameraNoise, NoiseModel
from rgbmidic.settings import BAYER_PATTERNS, FrameKind, read_section, read_table, to_plain, unique_keys
from rgbmidic.typing import FloatArray

_Section = TypeVar("_Section")

SCHEMA_NAME = "rgbmidic-calibration"
SCHEMA_VERSION = 1

_KINDS: dict[FrameKind, tuple[int, int]] = {"bayer": (4, 3), "rgb": (3, 3), "monochrome": (1, 1)}
"""Numbers of colour planes and channels by the kind of frames."""
_CAMERA = ("kind", "cfa", "black_level", "white_level", "unevenness", "shape")
"""Fields of a `Calibration` that are keys of the section ``camera``."""
_PARAMETERS = ["shift_x_px", "shift_y_px", "rotation_rad", "scale", "radial_at_radius"]
"""Names of the registration's parameters with their units, for readers of the file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Calibration of camera and lights; a section that was not measured is None.

    Attributes
    ----------
    crosstalk, noise
        See `Crosstalk` and `NoiseModel`.
    camera_noise
        All figures of the photon transfer measurement, per colour plane; `noise` is its summary.
    registration
        Lateral registration of the lights, which are those of the crosstalk in the same order.
    kind, cfa, white_level
        The camera settings of the captures, as far as they are known.
    black_level
        Mean black level over the positions of the Bayer cell, as far as it is known.
    shape
        Rows and columns of the captures.
    name
        Name in messages: the file name.
    unevenness
        Unevenness of the histogram of the captures' grey levels (`rgbmidic.illumination.plane_samples.unevenness`).
    provenance
        Inputs with their hashes, date, software version, by section; not changed by reading.
    extra
        Sections of the file that this class does not interpret, kept when the file is written again.

    Examples
    --------
    >>> calibration = Calibration.read("calibration.json")
    >>> calibration.crosstalk.lights, calibration.kind
    (('red', 'green', 'blue'), 'bayer')
    >>> calibration.crosstalk.matrix.shape
    (3, 3)
    """

    crosstalk: Crosstalk | None = None
    noise: NoiseModel | None = None
    camera_noise: CameraNoise | None = None
    registration: Registration | None = None
    kind: FrameKind | None = None
    cfa: str | None = None
    black_level: float | None = None
    white_level: float | None = None
    shape: tuple[int, int] | None = None
    unevenness: float | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)
    name: str = field(default="the calibration", compare=False)

    def __post_init__(self) -> None:
        """Check that the sections agree, and fill in the summary of the noise."""
        check_fields(self, CalibrationError)
        if self.crosstalk and self.registration and self.crosstalk.lights != self.registration.lights:
            raise CalibrationError(
                f"crosstalk and registration are of different lights: {', '.join(self.crosstalk.lights)} and "
                f"{', '.join(self.registration.lights)}"
            )
        if self.noise is None and self.camera_noise is not None:
            object.__setattr__(self, "noise", self.camera_noise.model)
        if not self.kinds:
            planes = f"noise of the planes {' '.join(self.camera_noise.planes)}" if self.camera_noise else "no noise"
            crosstalk = f"a crosstalk of {len(self.crosstalk.matrix)} channels" if self.crosstalk else "no crosstalk"
            raise CalibrationError(
                f"it is of frames of two kinds: kind {self.kind}, pattern {self.cfa}, {planes}, {crosstalk}"
            )

    @property
    def kinds(self) -> tuple[FrameKind, ...]:
        """The kinds of frames that it may be of, by all that it holds: one, or more where that leaves it open."""
        n_planes = len(self.camera_noise.planes) if self.camera_noise else 0
        n_channels = len(self.crosstalk.matrix) if self.crosstalk else 0
        stated_kinds = {self.kind, "bayer" if self.cfa else None} - {None}
        return tuple(
            kind
            for kind, (planes, channels) in _KINDS.items()
            if stated_kinds <= {kind} and n_planes in (0, planes) and n_channels in (0, channels)
        )

    def cropped(self, origin: tuple[int, int] | None, shape: tuple[int, int]) -> Calibration:
        """Return the calibration for frames that were cropped out of those it was made with.

        Parameters
        ----------
        origin
            Column and row of the calibrated frame at which they begin; None: not stated.
        shape
            Their rows and columns.

        Returns
        -------
        Calibration

        Raises
        ------
        CalibrationError
            They reach beyond the calibrated frame; or no origin is stated, they have another size, and the calibration
            depends on the place.
        """
        crosstalk, registration, full_shape = self.crosstalk, self.registration, self.shape
        field = crosstalk.field if crosstalk else None
        if full_shape is None and field is not None:  # older files hold the shape of the captures only in what varies
            full_shape = field.shape
        elif full_shape is None and registration is not None:
            full_shape = round(2 * registration.centre[1] + 1), round(2 * registration.centre[0] + 1)
        if origin is None:
            if (
                full_shape is None
                or full_shape == shape
                or not (field or (registration and registration.depends_on_place))
            ):
                return self
            raise CalibrationError(
                f"the calibration was made with frames of {_size(full_shape)} px and holds what varies over them; "
                f"those of the test have {_size(shape)} px. If the camera cropped them, state "
                "frames.crop_origin = [x, y], the column and row of the calibrated frame at which they begin; else "
                "calibrate with frames of their size"
            )
        column, row = origin
        if full_shape is not None and (row + shape[0] > full_shape[0] or column + shape[1] > full_shape[1]):
            raise CalibrationError(
                f"frames of {_size(shape)} px that begin at frames.crop_origin = {list(origin)} reach beyond the "
                f"calibrated frame of {_size(full_shape)} px"
            )
        return replace(
            self,
            crosstalk=crosstalk and crosstalk.cropped(origin, shape),
            registration=registration and registration.cropped(origin),
            cfa=self.cfa and shift_cfa(self.cfa, row, column),
            shape=shape,
        )

    @classmethod
    @checked
    def read(cls, path: Path | str) -> Calibration:
        """Read a calibration file.

        Parameters
        ----------
        path
            The file that `rgbmidic-calibrate` wrote.

        Returns
        -------
        Calibration

        Raises
        ------
        CalibrationError
            The file is missing, not JSON, of another schema or version, or has damaged sections.
        """
        document = read_document(path, "calibration file", SCHEMA_NAME, SCHEMA_VERSION)
        try:
            return cls.from_document(document, str(path))
        except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
            reason = f"missing key {error}" if isinstance(error, KeyError) else error
            raise CalibrationError(f"{path} is damaged: {reason}") from None

    @classmethod
    @checked
    def from_document(cls, document: dict[str, Any], name: str = "the calibration") -> Calibration:
        """Return the calibration of a JSON document.

        Parameters
        ----------
        document
            What `to_document` gives.
        name
            Name in messages.

        Returns
        -------
        Calibration

        Raises
        ------
        ValueError
            A section is damaged.
        """
        known_keys = {"schema", "schema_version", "crosstalk", "noise", "registration", "camera", "provenance"}
        camera, noise = read_table(document, "camera"), read_table(document, "noise")
        if (cfa := camera.get("cfa")) not in (None, *BAYER_PATTERNS):
            raise ValueError(f"camera.cfa is {cfa!r}; allowed are {', '.join(BAYER_PATTERNS)}")
        return read_section(
            cls,
            "camera",
            {key: camera[key] for key in _CAMERA if key in camera},
            name=name,
            crosstalk=_read(Crosstalk, document, "crosstalk"),
            noise=_read(NoiseModel, document, "noise"),
            camera_noise=_read(CameraNoise, noise, "planes"),
            registration=_read(Registration, document, "registration"),
            provenance=read_table(document, "provenance"),
            extra={key: value for key, value in document.items() if key not in known_keys},
        )

    def to_document(self) -> dict[str, Any]:
        """Return the JSON document, as plain dictionaries, lists and numbers.

        Returns
        -------
        dict
        """
        document: dict[str, Any] = {"schema": SCHEMA_NAME, "schema_version": SCHEMA_VERSION}
        camera = {name: to_plain(getattr(self, name)) for name in _CAMERA}
        document["camera"] = {key: value for key, value in camera.items() if value is not None}
        for name in ("crosstalk", "noise", "registration"):
            if (section := getattr(self, name)) is not None:
                document[name] = to_plain(section)
        if self.crosstalk is not None:
            document["crosstalk"]["condition_number"] = self.crosstalk.condition_number
            document["crosstalk"]["noise_amplification"] = to_plain(self.crosstalk.noise_amplification)
        if self.camera_noise is not None:
            document["noise"]["planes"] = to_plain(self.camera_noise)
        if self.registration is not None:
            document["registration"]["parameter_names"] = _PARAMETERS
        return {**document, **self.extra, "provenance": dict(self.provenance)}

    def figures(self) -> dict[str, Any]:
        """Return what a report states of the calibration: the document without what varies over the field.

        Returns
        -------
        dict
        """
        document = self.to_document()
        figure_names = {
            "lights",
            "matrix",
            "std",
            "green_difference",
            "noise_amplification",
            "gain",
            "read_noise",
            "parameters",
        }
        figures: dict[str, Any] = {
            section: {key: value for key, value in document[section].items() if key in figure_names}
            for section in ("crosstalk", "noise", "registration")
            if section in document
        }
        origins = {}
        for name, record in self.provenance.items():
            if isinstance(record, Mapping):
                date, files = record.get("date", "at an unknown time"), len(record.get("inputs", ()))
                origins[name] = {"date": date, "files": files, "warnings": list(record.get("warnings", ()))}
        return {**figures, "provenance": origins}

    def write(self, path: Path | str) -> None:
        """Write the calibration file; an existing file is replaced only once the new one is complete.

        Parameters
        ----------
        path
            File to write.

        Raises
        ------
        CalibrationError
            The file cannot be written.
        """
        write_document(path, self.to_document())


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetLights:
    """Lights under which a target of known size was photographed, and the calibration that has their registration.

    Results are in px of the first light's image. A lens magnifies each colour a little differently, so that a scale
    from an image under another light is one for other pixels.

    Attributes
    ----------
    names : tuple of str
        One light, or several that were on together.
    calibration : Calibration
        With a registration.
    crop_origin : tuple of int, or None
        Column and row of the calibrated frame at which the photographs begin; None: not cropped.
    """

    names: tuple[str, ...]
    calibration: Calibration
    crop_origin: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        """Check that the calibration has the lights registered."""
        if self.calibration.registration is None:
            raise CalibrationError(
                f"{self.calibration.name} has no registration, which carries the scale from light "
                f"{' + '.join(self.names)} to the first light: rgbmidic-calibrate registration, or merge"
            )
        self.calibration.registration.on_first_light([[0.0, 0.0]], self.names)

    @property
    def first(self) -> str:
        """The light in whose pixels results are."""
        assert self.calibration.registration is not None
        return self.calibration.registration.lights[0]

    def on_first_light(
        self, points: npt.ArrayLike, shape: tuple[int, int] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return points (M, 2) of the photograph in px of the first light's image, and the factor of their covariance.

        Parameters
        ----------
        points : array_like, shape (M, 2)
            Points (x, y) in px of the photograph.
        shape
            Rows and columns of the photograph, which must fit the calibration; None: not known.

        Returns
        -------
        points, factor : ndarray, shapes (M, 2) and (M, 2, 5)
            See `Registration.on_first_light`.

        Raises
        ------
        CalibrationError
            The photograph does not fit the calibration.
        """
        registration, full_shape = self.calibration.registration, self.calibration.shape
        if shape is not None:
            if self.crop_origin is None and full_shape is not None and shape != full_shape:
                raise CalibrationError(
                    f"{self.calibration.name} was made with frames of {_size(full_shape)} px, the photograph has "
                    f"{_size(shape)} px: state `crop_origin`, where it begins in the calibrated frame"
                )
            registration = self.calibration.cropped(self.crop_origin, shape).registration
        elif self.crop_origin is not None and registration is not None:
            registration = registration.cropped(self.crop_origin)
        assert registration is not None
        return registration.on_first_light(points, self.names)


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[1]} x {shape[0]}"


def has_schema(path: Path, schema: str) -> bool:
    """Return whether a JSON file states a schema, whatever else is in it."""
    try:
        return bool(json.loads(path.read_text(encoding="utf-8"))["schema"] == schema)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def read_document(path: Path | str, description: str, schema: str, version: int) -> dict[str, Any]:
    """Read the document of a JSON file that ``rgbmidic-calibrate`` wrote.

    Raises
    ------
    CalibrationError
        The file is missing, not JSON, or of another schema or version; the message names the `description` of the file.
    """
    try:
        text = require_regular_file(Path(path)).read_text(encoding="utf-8")
        document = json.loads(
            text,
            object_pairs_hook=unique_keys,
            parse_constant=_number,
            parse_float=_number,
            parse_int=lambda text: int(text) if _number(text) else 0,
        )
    except FileNotFoundError:
        raise CalibrationError(f"{description} not found: {path}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise CalibrationError(f"{path} is not a readable {description}: {error}") from None
    if not isinstance(document, dict) or document.get("schema") != schema:
        raise CalibrationError(f'{path} is not a {description}: its "schema" is not "{schema}"')
    if document.get("schema_version") != version:
        raise CalibrationError(
            f"{path} has schema version {document.get('schema_version')!r}; this version of rgbmidic reads {version}. "
            "Make the file again with rgbmidic-calibrate"
        )
    return document


def write_document(path: Path | str, document: Mapping[str, Any]) -> None:
    """Write a JSON file; an existing one is replaced only once the new one is complete.

    Raises
    ------
    CalibrationError
        The file cannot be written.
    """
    text = json.dumps(document, indent=2, allow_nan=False) + "\n"
    write_complete(Path(path), lambda file: file.write(text.encode()), error=CalibrationError)


def _read(kind: type[_Section], document: dict[str, Any], name: str) -> _Section | None:
    """Object of a section of the file, None where it is not there; what is derived from other keys is not read."""
    if document.get(name) is None:
        return None
    table, keys = read_table(document, name), {entry.name for entry in fields(cast(Any, kind))}
    return read_section(kind, name, {key: table[key] for key in table if key in keys})


def _number(text: str) -> float:
    """Return a number of the file: JSON has no NaN nor infinity, and no figure whose products would be infinite."""
    value = float(text)
    if not abs(value) <= 1e30:
        raise ValueError(f"{text[:40]} is not a number of a calibration")
    return value
