"""Tools that stand on the public names of the core: each could be taken away."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rgbmidic import extensions

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rgbmidic.fields import Probe
    from rgbmidic.mesh import MeshSource
    from rgbmidic.results import Result
    from rgbmidic.weights.light_weights import PrepareWeights


def add_to_core() -> None:
    """Add to the core what a test or a result may be of a tool, which is imported when it is needed."""
    extensions.LIGHT_WEIGHTS["geometry"] = _geometry_weights
    extensions.MESH_SOURCES["finite_elements"] = _finite_elements
    extensions.PROBES["tip"] = _crack_tip
    extensions.RESULTS["stereo.vtkhdf"] = _stereo


def _geometry_weights() -> PrepareWeights:
    from rgbmidic.tools.scene.geometry_weights import GeometryWeights

    return GeometryWeights.prepare


def _finite_elements() -> MeshSource:
    from rgbmidic.tools.finite_elements.mesh_source import MeshFile

    return MeshFile()


def _crack_tip() -> Callable[..., Probe]:
    from rgbmidic.tools.finite_elements.crack_tip import tip_probe

    return tip_probe


def _stereo() -> Callable[[Path], Result]:
    from rgbmidic.tools.stereo import open_left

    return open_left
