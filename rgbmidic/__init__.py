"""rgbmidic: Digital Image Correlation that survives light reflections.

Several coloured lights shine at once, one colour camera records one raw frame per state, and one weighted
minimisation over the separated illumination images gives the displacement (Multiple Illumination DIC).

The names below are imported on first use, so that ``import rgbmidic`` stays cheap.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rgbmidic.correlation import NodeStatus, Solution, Status, discretisation_error
    from rgbmidic.errors import RgbmidicError
    from rgbmidic.fields import CameraCalibration
    from rgbmidic.frames import read_frame
    from rgbmidic.illumination import separate
    from rgbmidic.illumination.calibration import Calibration
    from rgbmidic.lab.inspection import Inspection, inspect_frame
    from rgbmidic.mesh import Region, Tri3Mesh
    from rgbmidic.pipeline import correlate, measure, measure_sequence
    from rgbmidic.results import Result, export_result
    from rgbmidic.results.histories import read_histories
    from rgbmidic.settings import SolverSettings, TestSettings, read_test
    from rgbmidic.tools.finite_elements import FiniteElementMesh, Placement, read_mesh

from rgbmidic._version import __version__
from rgbmidic.tools import add_to_core as _add_tools_to_core

_add_tools_to_core()

__all__ = [
    "Calibration",
    "CameraCalibration",
    "FiniteElementMesh",
    "Inspection",
    "NodeStatus",
    "Placement",
    "Region",
    "Result",
    "RgbmidicError",
    "Solution",
    "SolverSettings",
    "Status",
    "TestSettings",
    "Tri3Mesh",
    "__version__",
    "correlate",
    "discretisation_error",
    "export_result",
    "inspect_frame",
    "measure",
    "measure_sequence",
    "read_frame",
    "read_histories",
    "read_mesh",
    "read_test",
    "separate",
]

_HOMES = {
    "correlation": ("NodeStatus", "Solution", "Status", "discretisation_error"),
    "errors": ("RgbmidicError",),
    "fields": ("CameraCalibration",),
    "frames": ("read_frame",),
    "illumination": ("separate",),
    "illumination.calibration": ("Calibration",),
    "lab.inspection": ("Inspection", "inspect_frame"),
    "mesh": ("Region", "Tri3Mesh"),
    "pipeline": ("correlate", "measure", "measure_sequence"),
    "results": ("Result", "export_result"),
    "results.histories": ("read_histories",),
    "settings": ("SolverSettings", "TestSettings", "read_test"),
    "tools.finite_elements": ("FiniteElementMesh", "Placement", "read_mesh"),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
