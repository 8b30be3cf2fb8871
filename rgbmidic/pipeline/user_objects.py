"""Objects that a script gives in place of what TEST.toml names: what they must be, and what a result keeps of them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from types import UnionType
from typing import Any

from rgbmidic.errors import ConfigurationError, InputError
from rgbmidic.illumination.separation import LightSeparation
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.settings import TestSettings
from rgbmidic.weights import LightWeights


def check_user_objects(
    settings: TestSettings,
    source: object | None,
    separation: LightSeparation | None,
    weights: LightWeights | None,
    mesh: Tri3Mesh | None,
) -> None:
    """Refuse an object that is none of its kind or that contradicts the settings, and settings that need another one.

    Raises
    ------
    InputError
        It lacks a method, or is of another kind.
    ConfigurationError
        The settings name something else, or something that nobody gives.
    """
    check_object("separation", separation, "__call__")
    check_object("weights", weights, "reference", "deformed")
    check_type("mesh", mesh, Tri3Mesh | None, "a Tri3Mesh")
    frames, mesh_settings, method = settings.frames, settings.mesh, settings.weights.method

    def contradictions() -> Iterator[str]:
        if source is not None and (path := ", ".join(frames.path)):
            yield f"frames.path names {path}, and a frame source is given: leave the path empty (path = [])"
        if source is not None and frames.lights > 1:
            yield "frames.lights is for files; a frame source gives all lights of a state by one index"
        if weights is not None and method not in ("statistics", "none"):
            advice = 'and weights are given: state "statistics", with which both count, or "none"'
            yield f'weights.method = "{method}", {advice}'
        if mesh is not None and mesh_settings.file is not None:
            yield f"mesh.file names {mesh_settings.file}, and a mesh is given: leave one of them out"
        if mesh is not None and mesh_settings.cracks:
            yield "mesh.cracks splits a mesh that is made here; the mesh that is given has its own"
        measured = "on the frames of a test by rgbmidic.measure, for a mesh"
        if mesh_settings.element_size == "auto":
            yield f'mesh.element_size = "auto" is found {measured} that is made there: state a number'
        if mesh_settings.refine is not False:
            yield f"mesh.refine is done {measured} made there: leave it out"

    for message in contradictions():
        raise ConfigurationError(message)


def check_object(name: str, candidate: object, *methods: str) -> None:
    """Refuse an object that a script gave, unless it is None or has all of these methods.

    Raises
    ------
    InputError
        It lacks one of them.
    """
    if candidate is not None and not all(callable(getattr(candidate, method, None)) for method in methods):
        needed = "can be called" if methods == ("__call__",) else f"has {' and '.join(f'{name}()' for name in methods)}"
        raise InputError(f"{name} must be an object that {needed}, not {class_name(candidate)}")


def check_type(name: str, value: object, kind: type | UnionType, allowed: str) -> None:
    """Refuse what is not of a kind.

    Raises
    ------
    InputError
        It is of another one.
    """
    if not isinstance(value, kind):
        raise InputError(f"{name} must be {allowed}, not {class_name(value)}")


def describe(value: Any, longest: int = 120) -> str:
    """Describe an object that a script gave, for the result: its ``describe()`` where it has one, else what it shows.

    Functions and objects without a representation of their own give their name only: two of one name cannot be told
    apart. More than the `longest` number of characters are cut and get their checksum: people read the text, the
    comparison reads the checksum.
    """
    if callable(describe_method := getattr(value, "describe", None)):
        text = f"{class_name(value)}: {describe_method()}"
    elif callable(value) and hasattr(value, "__qualname__"):
        text = f"{value.__module__}.{value.__qualname__}"
    elif repr(value) == object.__repr__(value):
        text = class_name(value)
    else:
        text = f"{class_name(value)}: " + re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))
    if len(text) > longest:
        return f"{text[:longest]} ... {hashlib.sha256(text.encode()).hexdigest()[:16]}"
    return text


def class_name(value: object) -> str:
    """Return module and name of the class of an object."""
    return f"{type(value).__module__}.{type(value).__qualname__}"
