"""What a TEST.toml may name and the core does not have: a tool adds it to one of these tables.

`rgbmidic.tools.add_to_core` does so when `rgbmidic` is imported, by functions that import the tool: it is loaded by a
test that needs it, however that is run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from rgbmidic.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path

    from rgbmidic.fields import Probe
    from rgbmidic.frames import FrameFormat
    from rgbmidic.mesh import MeshSource
    from rgbmidic.pipeline.engine import OpenWorkers
    from rgbmidic.results import Result
    from rgbmidic.weights.light_weights import PrepareWeights

T = TypeVar("T")

LIGHT_WEIGHTS: dict[str, Callable[[], PrepareWeights]] = {}
"""Methods of weighting by the name of ``weights.method``."""
MESH_SOURCES: dict[str, Callable[[], MeshSource]] = {}
"""Meshes of other origin, by the name under which a result keeps their document; ``mesh.file`` is "finite_elements"."""
PREPARATIONS: dict[str, Callable[[], Callable[..., Any]]] = {}
"""What looks at the frames of a test before it is measured, by the key of TEST.toml that it is for."""
FRAME_FORMATS: dict[str, Callable[[], tuple[FrameFormat, ...]]] = {}
"""Formats of frame files beside those of `rgbmidic.frames`, by the kind of their files."""
WORKERS: dict[str, Callable[[], OpenWorkers]] = {}
"""Workers beside the threads of the process, by the kind of their scheduler."""

RESULTS: dict[str, Callable[[], Callable[[Path], Result]]] = {}
"""Functions that open results of tools, by the file that marks their folder."""
PROBES: dict[str, Callable[[], Callable[..., Probe]]] = {}
"""Probes by their kind; called as those of `rgbmidic.fields` are, with the `settings` and `units` beside."""


def load_extension(table: Mapping[str, Callable[[], T]], name: str, key: str) -> T:
    """Return what a tool adds to one of the tables under a name, for what `key` of TEST.toml states.

    Raises
    ------
    ConfigurationError
        No tool adds it.
    """
    if name not in table:
        raise ConfigurationError(f'{key} needs the tool that adds "{name}"; there are {", ".join(table) or "none"}')
    return table[name]()
