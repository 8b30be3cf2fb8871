"""Two cameras: shape, motion and strain of a surface in three dimensions.

Each camera's test is an ordinary run. The left mesh is carried over to the right camera once, so that a node is one
material point in both; both displacements are triangulated frame by frame with their covariances.
"""

from rgbmidic.tools.stereo.axes import Axes
from rgbmidic.tools.stereo.calibration_part import CalibrationPart
from rgbmidic.tools.stereo.camera_pair import PAIR_PARAMETERS, CameraPair, lens_matrix, project_with_slopes
from rgbmidic.tools.stereo.carried_mesh import CarriedMesh, carry_mesh
from rgbmidic.tools.stereo.left_result import LeftResult, open_left
from rgbmidic.tools.stereo.result import StereoResult
from rgbmidic.tools.stereo.run import StereoSettings, measure_stereo, measure_stereo_part
from rgbmidic.tools.stereo.shape import Shape
from rgbmidic.tools.stereo.stereo_file import QUANTITIES
from rgbmidic.tools.stereo.surface import attitude, displacement_in_space
from rgbmidic.tools.stereo.triangulation import Triangulation, triangulate

__all__ = [
    "PAIR_PARAMETERS",
    "QUANTITIES",
    "Axes",
    "CalibrationPart",
    "CameraPair",
    "CarriedMesh",
    "LeftResult",
    "Shape",
    "StereoResult",
    "StereoSettings",
    "Triangulation",
    "attitude",
    "carry_mesh",
    "displacement_in_space",
    "lens_matrix",
    "measure_stereo",
    "measure_stereo_part",
    "open_left",
    "project_with_slopes",
    "triangulate",
]
