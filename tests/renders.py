"""What the tests of a run, or its tables, have in common: renders, kept in a folder by the description of the scene,
and results of functions, by their arguments."""

from __future__ import annotations

import hashlib
import os
import pickle
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import draws
import numpy as np

from rgbmidic.tools.lab.virtual import rendering
from rgbmidic.tools.scene import speckle, surface

_VARIABLE = "RGBMIDIC_RENDERS"
_WORTH = 0.1
"""Seconds of the processor from which a render is kept: to read it takes a hundredth."""
_RENDERER = [(rendering, "_trace"), (surface.Surface, "on_plate"), (speckle, "cover_covariance")]
"""What renders a scene, and what a forecast asks of its paint."""
_NEW = [getattr(*place) for place in _RENDERER]


def renders() -> Path:
    """Folder of what the processes of this run have in common."""
    return Path(os.environ[_VARIABLE])


def kept(make: Callable[..., Any]) -> Callable[..., Any]:
    """Keep what a function gives beside the renders, for the same arguments and draws of the noise."""

    @wraps(make)
    def found(*arguments: Any, **options: Any) -> Any:
        described = pickle.dumps((make.__module__, make.__name__, draws.current, arguments, sorted(options.items())))
        path = renders() / f"{hashlib.sha1(described).hexdigest()}.pickle"
        if not path.exists():
            temporary = path.with_suffix(f".{os.getpid()}.pickle")
            temporary.write_bytes(pickle.dumps(make(*arguments, **options)))
            temporary.replace(path)
        return pickle.loads(path.read_bytes())

    return found


@contextmanager
def kept_renders() -> Iterator[None]:
    """Keep renders within the block, in the folder of the process that started this one or else in one that ends."""
    with tempfile.TemporaryDirectory(prefix="rgbmidic-renders-") as folder:
        first = os.environ.setdefault(_VARIABLE, folder) == folder
        try:
            with _exchanged([_found, *map(kept, _NEW[1:])]):
                yield
        finally:
            if first:
                del os.environ[_VARIABLE]


@contextmanager
def new_renders() -> Iterator[None]:
    """Render anew within the block, which is about the renderer."""
    with _exchanged(_NEW):
        yield


@contextmanager
def _exchanged(functions: list[Callable[..., Any]]) -> Iterator[None]:
    before = [getattr(*place) for place in _RENDERER]
    for place, function in zip(_RENDERER, functions, strict=True):
        setattr(*place, function)
    try:
        yield
    finally:
        for place, function in zip(_RENDERER, before, strict=True):
            setattr(*place, function)


def _found(*scene_and_state: Any) -> Any:
    try:
        described = pickle.dumps(scene_and_state)
    except (pickle.PicklingError, AttributeError, TypeError):  # displaced by a function that has no name
        return _NEW[0](*scene_and_state)
    path = renders() / f"{hashlib.sha1(described).hexdigest()}.npy"
    if path.exists():
        return np.load(path)
    start = time.process_time()
    images = _NEW[0](*scene_and_state)
    if time.process_time() - start > _WORTH:
        temporary = path.with_suffix(f".{os.getpid()}.npy")
        np.save(temporary, images)
        temporary.replace(path)
    return images
