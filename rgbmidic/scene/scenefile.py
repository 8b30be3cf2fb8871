"""SCENE.toml: what a virtual experiment shows, read strictly; an unknown key is an error that names it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, get_type_hints

import numpy as np

from rgbmidic.errors import ConfigurationError, InputError
from rgbmidic.illumination.spectra import Led, Sensitivities
from rgbmidic.scene.camera import PIXEL, Camera, reference_camera
from rgbmidic.scene.in_plane import AffineField, InPlaneField, MeshField
from rgbmidic.scene.light import Light, three_lights
from rgbmidic.scene.scene import Body, Cylinder, Plate, Scene, Sphere, State
from rgbmidic.scene.surface import Finish, Surface
from rgbmidic.settings import (  # the one strict reader of TOML values
    ELEMENT_SIZE,
    check_names,
    convert_value,
    read_toml,
    regular,
)

__all__ = ["DatasetSettings", "Experiment", "Target", "read_scene"]

BODIES: dict[str, type[Sphere] | type[Cylinder] | type[Plate]] = {
    "sphere": Sphere,
    "cylinder": Cylinder,
    "plate": Plate,
}
Target = Literal["white", "speckled"]
"""What calibration captures show."""
_SIZE = (640, 640)
_FIELD_KEYS = ("displacement_gradient", "displacement_offset", "displacement_file")


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetSettings:
    """What is written (``[output]``).

    Attributes
    ----------
    format
        Of Bayer frames; other cameras give TIFF.
    seed
        Of the camera's noise.
    calibration_frames
        Frames per light, and dark frames.
    target
        What the calibration frames show.
    region
        (x0, y0, x1, y1) px for test.toml; None: all that stays in view, less a margin.
    element_size
        px, for test.toml.
    noise_free
        Write what each light alone gives, too.
    """

    format: Literal["dng", "tiff"] = "dng"
    seed: int = 0
    calibration_frames: int = 3
    target: Target = "white"
    region: tuple[float, float, float, float] | None = None
    element_size: float = ELEMENT_SIZE
    noise_free: bool = False

    def __post_init__(self) -> None:
        if self.calibration_frames < 1 or self.element_size <= 0 or self.seed < 0:
            raise InputError("calibration_frames and element_size must be positive, seed not negative")


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """A scene, its states in order (the first frame of a data set is the body at rest), and what to write."""

    scene: Scene
    states: tuple[State, ...]
    output: DatasetSettings


def read_scene(path: Path | str) -> Experiment:
    """Read a SCENE.toml.

    Sections: ``[body]``, ``[surface]`` with ``[surface.white]`` and ``[surface.black]``, ``[[lights]]``, ``[camera]``,
    ``[[states]]`` and ``[output]``. Every one may be left out: the reference sphere, paint, lights and camera stand in.

    Raises
    ------
    ConfigurationError
        The file is missing, not TOML, or has an entry that is unknown, of the wrong type or impossible; named.
    """
    path = Path(path)
    document = read_toml(path, "scene file")
    try:
        return _experiment(document, path.parent)
    except (ConfigurationError, InputError) as error:
        raise ConfigurationError(f"{path}: {error}") from None


def _experiment(document: Mapping[str, Any], base: Path) -> Experiment:
    sections = ("body", "surface", "lights", "camera", "states", "output")
    check_names(document, sections, "section", "the file")
    body = _body(_table(document, "body"), base)
    lights = _tables(document, "lights")
    scene = Scene(
        body=body,
        surface=_surface(_table(document, "surface"), base),
        lights=tuple(_light(table, body, base) for table in lights) if lights else three_lights(body.front),
        camera=_camera(_table(document, "camera"), body, base),
    )
    return Experiment(
        scene=scene,
        states=tuple(_state(table, body, base) for table in _tables(document, "states")),
        output=_build(DatasetSettings, _table(document, "output"), "output", base),
    )


def _table(document: Mapping[str, Any], name: str) -> dict[str, Any]:
    table = document.get(name, {})
    if not isinstance(table, Mapping):
        raise ConfigurationError(f"[{name}] must be a section with keys, not {table!r}")
    return dict(table)


def _tables(document: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    tables = document.get(name, [])
    if not isinstance(tables, list) or not all(isinstance(table, Mapping) for table in tables):
        raise ConfigurationError(f"{name} must be written as [[{name}]], once for each")
    return [dict(table) for table in tables]


def _build(kind: Any, table: Mapping[str, Any], where: str, base: Path, **ready: Any) -> Any:
    """An object of a settings class from a table of plain values; `ready` holds fields that are objects already."""
    hints = {name: hint for name, hint in get_type_hints(kind).items() if name not in ready}
    check_names(table, hints, "key", f"[{where}]")
    given = {key: convert_value(value, hints[key], f"{where}.{key}", base) for key, value in table.items()}
    for entry in fields(kind):
        required = entry.default is MISSING and entry.default_factory is MISSING
        if required and entry.name not in given and entry.name not in ready:
            raise ConfigurationError(f"{where}.{entry.name} is missing")
    return kind(**given, **ready)


def _body(table: dict[str, Any], base: Path) -> Body:
    kind = convert_value(table.pop("kind", "sphere"), Literal["sphere", "cylinder", "plate"], "body.kind", base)
    body: Body = _build(BODIES[kind], table, "body", base)
    return body


def _surface(table: dict[str, Any], base: Path) -> Surface:
    paints = {}
    for name, albedo in (("white", 0.80), ("black", 0.10)):
        paint = {"albedo": albedo, **_table(table, name)}
        table.pop(name, None)
        paints[name] = _build(Finish, paint, f"surface.{name}", base)
    surface: Surface = _build(Surface, table, "surface", base, **paints)
    return surface


def _light(table: dict[str, Any], body: Body, base: Path) -> Light:
    name = table.get("name", "?")
    led = {key: table.pop(f"led_{key}") for key in ("centre", "width") if f"led_{key}" in table}
    spectrum = _build(Led, led, f"lights.{name}.led", base) if led else None
    light: Light = _build(Light, table, f"lights.{name}", base, spectrum=spectrum)
    return light if "power" in table else light.aimed(body.front)


def _camera(table: dict[str, Any], body: Body, base: Path) -> Camera:
    ready: dict[str, Any] = {"crosstalk": None, "sensitivities": None}
    if "crosstalk" in table:
        rows = convert_value(table.pop("crosstalk"), tuple[tuple[float, ...], ...], "camera.crosstalk", base)
        if len({len(row) for row in rows}) != 1:
            raise ConfigurationError("camera.crosstalk must be rows of the same length")
        ready["crosstalk"] = np.array(rows)
    if "sensitivities" in table:
        ready["sensitivities"] = Sensitivities.read(
            convert_value(table.pop("sensitivities"), Path, "camera.sensitivities", base)
        )
    if "model" in table:
        ready["sensitivities"] = Sensitivities.from_colour(convert_value(table.pop("model"), str, "camera.model", base))
    pixel = convert_value(table.pop("mm_per_pixel", PIXEL), float, "camera.mm_per_pixel", base)
    if not pixel > 0:
        raise ConfigurationError(f"camera.mm_per_pixel must be positive, not {pixel}")
    table.setdefault("shape", list(_SIZE))
    table.setdefault("focal_px", body.front[2] / pixel)
    camera: Camera = _build(Camera, table, "camera", base, **ready)
    if ready["crosstalk"] is None and ready["sensitivities"] is None and camera.kind != "monochrome":
        return replace(camera, crosstalk=reference_camera(camera.shape).crosstalk)
    return camera


def _state(table: dict[str, Any], body: Body, base: Path) -> State:
    given = {key: table.pop(key) for key in _FIELD_KEYS if key in table}
    state: State = _build(State, table, "states", base, displacement=_field(given, body, base))
    return state


def _field(given: Mapping[str, Any], body: Body, base: Path) -> InPlaneField | None:
    if not given:
        return None
    if not isinstance(body, Plate):
        raise ConfigurationError(f"states.{next(iter(given))} is for a plate only")
    if "displacement_file" not in given:
        types = {"gradient": tuple[tuple[float, float], tuple[float, float]], "offset": tuple[float, float]}
        values = {key.removeprefix("displacement_"): value for key, value in given.items()}
        return AffineField(
            **{k: convert_value(v, types[k], f"states.displacement_{k}", base) for k, v in values.items()}
        )
    if len(given) > 1:
        raise ConfigurationError("states.displacement_file excludes displacement_gradient and displacement_offset")
    return _mesh_field(convert_value(given["displacement_file"], Path, "states.displacement_file", base))


def _mesh_field(path: Path) -> MeshField:
    try:
        with np.load(regular(path)) as file:
            arrays = {name: file[name] for name in ("nodes", "elements", "displacement")}
    except (OSError, KeyError, ValueError) as error:
        raise ConfigurationError(f"{path} is not an npz with nodes, elements and displacement: {error}") from None
    return MeshField(**arrays)
