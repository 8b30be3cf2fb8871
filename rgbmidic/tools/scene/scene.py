"""A scene: a body before the camera, its states, paint, lights and camera; and SCENE.toml, which describes it.

The file is read strictly: an unknown key is an error that names it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rgbmidic.arguments import bounded, check_fields
from rgbmidic.disk import require_regular_file
from rgbmidic.errors import ConfigurationError, InputError
from rgbmidic.settings import ELEMENT_SIZE, check_names, convert_value, read_section, read_table, read_toml
from rgbmidic.tools.scene import SceneSection, kernels
from rgbmidic.tools.scene.camera import (
    PIXEL,
    REFERENCE_CROSSTALK,
    Camera,
    Light,
    Polarisers,
    SecondCamera,
    Vector,
    rotation,
    three_lights,
)
from rgbmidic.tools.scene.spectra import Led, Sensitivities
from rgbmidic.tools.scene.surface import AffineField, InPlaneField, MeshField, Surface
from rgbmidic.typing import FloatArray


class _Body(SceneSection):
    """Common properties of bodies."""

    __slots__ = ()
    centre: Vector

    @property
    def front(self) -> Vector:
        """The point nearest to the camera's plane, on a line along z through the centre."""
        x, y, z = self.centre
        return x, y, z - float(self.parameters()[1])

    def parameters(self) -> FloatArray:
        """Return [kind, radius, half width, half height] for the kernels.

        Returns
        -------
        ndarray, shape (4,)
        """
        raise NotImplementedError

    def _problems(self) -> Iterator[str]:
        if not self.front[2] > 0:
            yield f"a body lies in front of the camera, not at z = {self.front[2]:g} mm"


@dataclass(frozen=True, slots=True, kw_only=True)
class Sphere(_Body):
    """A sphere.

    Attributes
    ----------
    radius
        mm.
    centre
        (x, y, z) in mm, camera axes.
    """

    radius: float = bounded(41.25, above=0)
    centre: Vector = (0.0, 0.0, 641.25)

    @property
    def attitude(self) -> FloatArray:
        """Rotation from the body's axes to the camera's in the reference state."""
        return np.eye(3)

    def parameters(self) -> FloatArray:
        """Return [kind, radius, half width, half height] for the kernels.

        Returns
        -------
        ndarray, shape (4,)
        """
        return np.array([kernels.SPHERE, self.radius, np.inf, np.inf])


@dataclass(frozen=True, slots=True, kw_only=True)
class Cylinder(_Body):
    """The mantle of a cylinder; its axis is parallel to y until it is tilted.

    Attributes
    ----------
    radius, length
        mm.
    centre
        Middle of the axis: (x, y, z) in mm, camera axes.
    tilt_deg
        Degrees about z.
    """

    radius: float = bounded(15.0, above=0)
    length: float = bounded(1000.0, above=0)
    centre: Vector = (0.0, 0.0, 615.0)
    tilt_deg: float = 0.0

    @property
    def attitude(self) -> FloatArray:
        """Rotation from the body's axes to the camera's in the reference state."""
        return rotation(self.tilt_deg, (0.0, 0.0, 1.0))

    def parameters(self) -> FloatArray:
        """Return [kind, radius, half width, half height] for the kernels.

        Returns
        -------
        ndarray, shape (4,)
        """
        return np.array([kernels.CYLINDER, self.radius, np.inf, self.length / 2])


@dataclass(frozen=True, slots=True, kw_only=True)
class Plate(_Body):
    """A flat plate facing the camera until it is tilted.

    Attributes
    ----------
    width, height
        mm.
    centre
        (x, y, z) in mm, camera axes.
    tilt_deg
        Degrees about y, then about x.
    """

    width: float = bounded(75.0, above=0)
    height: float = bounded(50.0, above=0)
    centre: Vector = (0.0, 0.0, 600.0)
    tilt_deg: tuple[float, float] = (0.0, 0.0)

    @property
    def attitude(self) -> FloatArray:
        """Rotation from the body's axes to the camera's in the reference state."""
        return rotation(self.tilt_deg[1], (1.0, 0.0, 0.0)) @ rotation(self.tilt_deg[0], (0.0, 1.0, 0.0))

    def parameters(self) -> FloatArray:
        """Return [kind, radius, half width, half height] for the kernels.

        Returns
        -------
        ndarray, shape (4,)
        """
        return np.array([kernels.PLATE, 0.0, self.width / 2, self.height / 2])


Body = Sphere | Cylinder | Plate


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """Pose of the body: in-plane displacement of a plate, then rotation about a pivot, then translation.

    Attributes
    ----------
    angle_deg
        Rotation about an axis through the pivot.
    axis
        Its direction (x, y, z) in the camera's axes.
    pivot
        Point on the axis (mm); None: the body's front point.
    translation
        (x, y, z) in mm.
    displacement
        In-plane displacement of a plate; None: none.
    velocity
        mm/s during the camera's exposure time.
    spin_deg
        Degrees per second during it, about the same axis and pivot.
    """

    angle_deg: float = 0.0
    axis: Vector = (0.0, 1.0, 0.0)
    pivot: Vector | None = None
    translation: Vector = (0.0, 0.0, 0.0)
    displacement: InPlaneField | None = None
    velocity: Vector = (0.0, 0.0, 0.0)
    spin_deg: float = 0.0

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        check_fields(self)

    def at_time(self, seconds: float) -> State:
        """Return the state some time later, at rest.

        Parameters
        ----------
        seconds
            Time in s.

        Returns
        -------
        State
        """
        x, y, z = (p + v * seconds for p, v in zip(self.translation, self.velocity, strict=True))
        angle = self.angle_deg + self.spin_deg * seconds
        return replace(self, angle_deg=angle, translation=(x, y, z), velocity=(0.0, 0.0, 0.0), spin_deg=0.0)

    def pose(self, body: Body) -> tuple[FloatArray, FloatArray]:
        """Return the rotation R (3, 3) and origin t (3,): camera point = R . body point + t.

        Parameters
        ----------
        body
            The body, whose front point is turned about.

        Returns
        -------
        rotation : ndarray, shape (3, 3)
        origin : ndarray, shape (3,)
            In mm.
        """
        pivot = np.array(body.front if self.pivot is None else self.pivot)
        turn = rotation(self.angle_deg, self.axis)
        origin = turn @ (np.array(body.centre) - pivot) + pivot + np.array(self.translation)
        return turn @ body.attitude, origin


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A body with its paint, the lights and the camera."""

    body: Body
    lights: tuple[Light, ...]
    camera: Camera
    surface: Surface = field(default_factory=Surface)

    @property
    def pixel(self) -> float:
        """Pixel size on the object, mm per px of the first light's image, at the body's front point."""
        return self.body.front[2] / float(self.camera.lenses(self.lights)[0, 0])

    def __post_init__(self) -> None:
        """Check the values."""
        names = [light.name for light in self.lights]
        if not names or len(set(names)) < len(names):
            raise InputError(f"a scene has at least one light, and every light its own name; given are {names}")
        if self.camera.kind == "monochrome":
            self.camera.response(self.lights)
        else:
            self.camera.true_crosstalk(self.lights)

    def light(self, name: str) -> Light:
        """Return the light of that name.

        Parameters
        ----------
        name
            Name of the light.

        Returns
        -------
        Light

        Raises
        ------
        InputError
            There is none of this name.
        """
        for light in self.lights:
            if light.name == name:
                return light
        raise InputError(f"no light {name!r}; the scene has {', '.join(light.name for light in self.lights)}")

    def with_light(self, light: Light) -> Scene:
        """Return the same scene with the light of that name exchanged.

        Parameters
        ----------
        light
            It takes the place of the one with its name.

        Returns
        -------
        Scene
        """
        self.light(light.name)
        return replace(self, lights=tuple(light if old.name == light.name else old for old in self.lights))

    def polarised(self, polarisers: Polarisers) -> Scene:
        """Return the scene behind crossed polarisers: less light, and less gloss than there is diffuse light.

        Parameters
        ----------
        polarisers
            How much light they pass.

        Returns
        -------
        Scene
        """
        white, black = (
            replace(paint, gloss=paint.gloss * polarisers.glare) for paint in (self.surface.white, self.surface.black)
        )
        lights = tuple(replace(light, power=light.power * polarisers.transmission) for light in self.lights)
        return replace(self, lights=lights, surface=replace(self.surface, white=white, black=black))

    def mirror_position(self, distance: float) -> Vector:
        """Return the position of a lamp whose reflection covers the body's front point, seen from the camera.

        On a flat plate it covers the whole field. `distance` from the front point in mm.

        Parameters
        ----------
        distance
            Distance of the lamp from the front point in mm.

        Returns
        -------
        Point (x, y, z) in mm, in the camera's axes
        """
        point, normal = np.array(self.body.front), self.body.attitude @ np.array([0.0, 0.0, -1.0])
        view = -point / np.linalg.norm(point)
        x, y, z = (point + distance * (2 * (normal @ view) * normal - view)).tolist()
        return x, y, z


BODIES: dict[str, type[Body]] = {"sphere": Sphere, "cylinder": Cylinder, "plate": Plate}
Target = Literal["white", "speckled"]
"""Targets of the calibration captures."""
_FIELD_KEYS = ("displacement_gradient", "displacement_offset", "displacement_file")


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetSettings(SceneSection):
    """Settings of the output (``[output]``).

    Attributes
    ----------
    format
        Format of Bayer frames; other cameras give TIFF.
    seed
        Seed of the camera's noise.
    calibration_frames
        Frames per light, and dark frames.
    target
        Target in the calibration frames; a registration needs a speckled one.
    region
        (x0, y0, x1, y1) px for test.toml; None: everything that stays in view, minus a margin.
    element_size
        px, for test.toml.
    noise_free
        Write the images of each light alone, too.
    """

    format: Literal["dng", "tiff"] = "dng"
    seed: int = bounded(0, at_least=0)
    calibration_frames: int = bounded(3, at_least=1)
    target: Target = "speckled"
    region: tuple[float, float, float, float] | None = None
    element_size: float = bounded(ELEMENT_SIZE, above=0)
    noise_free: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """A scene, its states in order (the first frame of a data set is the body at rest), and settings of the output.

    `second` is the second camera of a stereo test, None without.
    """

    scene: Scene
    states: tuple[State, ...]
    output: DatasetSettings
    second: SecondCamera | None = None


def read_scene(path: Path | str) -> Experiment:
    """Read a SCENE.toml.

    Sections: ``[body]``, ``[surface]`` with ``[surface.white]`` and ``[surface.black]``, ``[[lights]]``, ``[camera]``
    with ``[camera.second]``, ``[polarisers]``, ``[[states]]`` and ``[output]``. Every one may be left out: the
    reference sphere, paint, lights and camera stand in; polarisers and a second camera are there where their section
    is, even an empty one.

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
    sections = ("body", "surface", "lights", "camera", "polarisers", "states", "output")
    check_names(document, sections, "section", "the file")
    table = read_table(document, "body")
    kind = convert_value(table.pop("kind", "sphere"), Literal["sphere", "cylinder", "plate"], "body.kind", base)
    body: Body = read_section(BODIES[kind], "body", table, base)
    table, albedos = read_table(document, "surface"), {"white": 0.80, "black": 0.10}
    paints = {name: {"albedo": albedo, **read_table(table, name)} for name, albedo in albedos.items()}
    lights, camera = _tables(document, "lights"), read_table(document, "camera")
    second = camera.pop("second", None)
    scene = Scene(
        body=body,
        surface=read_section(Surface, "surface", {**table, **paints}, base),
        lights=tuple(_light(table, body, base) for table in lights) if lights else three_lights(body.front),
        camera=_camera(camera, body, base),
    )
    if "polarisers" in document:
        scene = scene.polarised(read_section(Polarisers, "polarisers", read_table(document, "polarisers"), base))
    return Experiment(
        scene=scene,
        states=tuple(_state(table, body, base) for table in _tables(document, "states")),
        output=read_section(DatasetSettings, "output", read_table(document, "output"), base),
        second=None if second is None else read_section(SecondCamera, "camera.second", second, base),
    )


def _tables(document: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    tables = document.get(name, [])
    if not isinstance(tables, list) or not all(isinstance(table, Mapping) for table in tables):
        raise ConfigurationError(f"{name} must be written as [[{name}]], once for each")
    return [dict(table) for table in tables]


def _light(table: dict[str, Any], body: Body, base: Path) -> Light:
    name = table.get("name", "?")
    led = {key: table.pop(f"led_{key}") for key in ("centre", "width") if f"led_{key}" in table}
    spectrum = read_section(Led, f"lights.{name}.led", led, base) if led else None
    light = read_section(Light, f"lights.{name}", table, base, spectrum=spectrum)
    return light if "power" in table else light.aimed(body.front)


def _camera(table: dict[str, Any], body: Body, base: Path) -> Camera:
    derived: dict[str, Any] = {}

    def read_key(key: str, kind: Any, default: Any = None) -> Any:
        return convert_value(table.pop(key, default), kind, f"camera.{key}", base)

    if "crosstalk" in table:
        rows = read_key("crosstalk", tuple[tuple[float, ...], ...])
        if len({len(row) for row in rows}) != 1:
            raise ConfigurationError("camera.crosstalk must be rows of the same length")
        derived["crosstalk"] = np.array(rows)
    if "sensitivities" in table:
        derived["sensitivities"] = Sensitivities.read(read_key("sensitivities", Path))
    if "model" in table:
        derived["sensitivities"] = Sensitivities.from_colour(read_key("model", str))
    if not derived and table.get("kind") != "monochrome":
        derived["crosstalk"] = np.array(REFERENCE_CROSSTALK)
    pixel = read_key("mm_per_pixel", float, PIXEL)
    if not pixel > 0:
        raise ConfigurationError(f"camera.mm_per_pixel must be positive, not {pixel}")
    table.setdefault("shape", [640, 640])
    table.setdefault("focal_px", body.front[2] / pixel)
    return read_section(Camera, "camera", table, base, **derived)


def _state(table: dict[str, Any], body: Body, base: Path) -> State:
    field_keys = {key: table.pop(key) for key in _FIELD_KEYS if key in table}
    return read_section(State, "states", table, base, displacement=_field(field_keys, body, base))


def _field(field_keys: Mapping[str, Any], body: Body, base: Path) -> InPlaneField | None:
    if not field_keys:
        return None
    if not isinstance(body, Plate):
        raise ConfigurationError(f"states.{next(iter(field_keys))} is for a plate only")
    if "displacement_file" not in field_keys:
        types = {"gradient": tuple[tuple[float, float], tuple[float, float]], "offset": tuple[float, float]}
        values = {key.removeprefix("displacement_"): value for key, value in field_keys.items()}
        return AffineField(
            **{k: convert_value(v, types[k], f"states.displacement_{k}", base) for k, v in values.items()}
        )
    if len(field_keys) > 1:
        raise ConfigurationError("states.displacement_file excludes displacement_gradient and displacement_offset")
    path = convert_value(field_keys["displacement_file"], Path, "states.displacement_file", base)
    try:
        with np.load(require_regular_file(path)) as file:
            arrays = {name: file[name] for name in ("nodes", "elements", "displacement")}
    except (OSError, KeyError, ValueError) as error:
        raise ConfigurationError(f"{path} is not an npz with nodes, elements and displacement: {error}") from None
    return MeshField(**arrays)
