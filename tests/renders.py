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

_VARIABLE = "RGBMIDIC_RENDERS"
_WORTH = 0.1
"""Seconds of the processor from which a render is kept: to read it takes a hundredth."""
_trace = rendering._trace


def renders() -> Path:
    """Folder of what the processes of this run have in common."""
    return Path(os.environ[_VARIABLE])


@contextmanager
def kept_renders() -> Iterator[None]:
    """Keep renders within the block, in the folder of the process that started this one or else in one that ends."""
    with tempfile.TemporaryDirectory(prefix="rgbmidic-renders-") as folder:
        first = os.environ.setdefault(_VARIABLE, folder) == folder
        before, rendering._trace = rendering._trace, _found
        try:
            yield
        finally:
            rendering._trace = before
            if first:
                del os.environ[_VARIABLE]


@contextmanager
def new_renders() -> Iterator[None]:
    """Render anew within the block, which is about the renderer."""
    before, rendering._trace = rendering._trace, _trace
    try:
        yield
    finally:
        rendering._trace = before


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


def _found(*scene_and_state: Any) -> Any:
    try:
        described = pickle.dumps(scene_and_state)
    except (pickle.PicklingError, AttributeError, TypeError):  # displaced by a function that has no name
        return _trace(*scene_and_state)
    path = renders() / f"{hashlib.sha1(described).hexdigest()}.npy"
    if path.exists():
        return np.load(path)
    start = time.process_time()
    images = _trace(*scene_and_state)
    if time.process_time() - start > _WORTH:
        temporary = path.with_suffix(f".{os.getpid()}.npy")
        np.save(temporary, images)
        temporary.replace(path)
    return images
