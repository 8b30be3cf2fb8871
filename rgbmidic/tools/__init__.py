"""Tools that stand on the public names of the core: each could be taken away."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rgbmidic import extensions

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rgbmidic.fields import Probe
    from rgbmidic.frames import FrameFormat
    from rgbmidic.mesh import MeshSource
    from rgbmidic.pipeline.engine import OpenWorkers
    from rgbmidic.results import Result
    from rgbmidic.weights.light_weights import PrepareWeights


def add_to_core() -> None:
    """Add to the core what a test or a result may be of a tool, which is imported when it is needed."""
    extensions.LIGHT_WEIGHTS["geometry"] = _geometry_weights
    extensions.MESH_SOURCES["finite_elements"] = _finite_elements
    extensions.PREPARATIONS["calibration.accept"] = _frame_check
    extensions.PREPARATIONS["mesh.element_size"] = _element_size
    extensions.PREPARATIONS["mesh.refine"] = _refinement
    extensions.PREPARATIONS["weights.threshold"] = _automatic_threshold
    extensions.FRAME_FORMATS["movies and bitmaps"] = _frame_formats
    extensions.WORKERS["dask"] = _dask
    extensions.PROBES["tip"] = _crack_tip
    extensions.RESULTS["stereo.vtkhdf"] = _stereo


def _geometry_weights() -> PrepareWeights:
    from rgbmidic.tools.scene.geometry_weights import GeometryWeights

    return GeometryWeights.prepare


def _finite_elements() -> MeshSource:
    from rgbmidic.tools.finite_elements.mesh_source import MeshFile

    return MeshFile()


def _frame_check() -> Callable[..., Any]:
    from rgbmidic.tools.preparation.frame_check import check_state

    return check_state


def _element_size() -> Callable[..., Any]:
    from rgbmidic.tools.preparation.element_size import choose

    return choose


def _refinement() -> Callable[..., Any]:
    from rgbmidic.tools.preparation.refinement import refine

    return refine


def _automatic_threshold() -> Callable[..., Any]:
    from rgbmidic.tools.preparation.automatic_threshold import automatic_weights

    return automatic_weights


def _frame_formats() -> tuple[FrameFormat, ...]:
    from rgbmidic.tools.formats import FORMATS

    return FORMATS


def _dask() -> OpenWorkers:
    from rgbmidic.tools.cluster import Cluster

    return Cluster


def _crack_tip() -> Callable[..., Probe]:
    from rgbmidic.tools.finite_elements.crack_tip import tip_probe

    return tip_probe


def _stereo() -> Callable[[Path], Result]:
    from rgbmidic.tools.stereo import open_left

    return open_left
