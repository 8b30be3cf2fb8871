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
    from rgbmidic.mesh import FiniteElementMesh, Placement, Region, Tri3Mesh, read_mesh
    from rgbmidic.pipeline import correlate, measure, measure_sequence
    from rgbmidic.results import Result, export_result
    from rgbmidic.results.histories import read_histories
    from rgbmidic.settings import SolverSettings, TestSettings, read_test

from rgbmidic._version import __version__

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
    "Calibration": "rgbmidic.illumination.calibration",
    "CameraCalibration": "rgbmidic.fields",
    "FiniteElementMesh": "rgbmidic.mesh",
    "Inspection": "rgbmidic.lab.inspection",
    "NodeStatus": "rgbmidic.correlation",
    "Placement": "rgbmidic.mesh",
    "Region": "rgbmidic.mesh",
    "Result": "rgbmidic.results",
    "RgbmidicError": "rgbmidic.errors",
    "Solution": "rgbmidic.correlation",
    "SolverSettings": "rgbmidic.settings",
    "Status": "rgbmidic.correlation",
    "TestSettings": "rgbmidic.settings",
    "Tri3Mesh": "rgbmidic.mesh",
    "correlate": "rgbmidic.pipeline",
    "discretisation_error": "rgbmidic.correlation",
    "export_result": "rgbmidic.results",
    "inspect_frame": "rgbmidic.lab.inspection",
    "measure": "rgbmidic.pipeline",
    "measure_sequence": "rgbmidic.pipeline",
    "read_frame": "rgbmidic.frames",
    "read_histories": "rgbmidic.results.histories",
    "read_mesh": "rgbmidic.mesh",
    "read_test": "rgbmidic.settings",
    "separate": "rgbmidic.illumination",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
