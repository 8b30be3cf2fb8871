"""The MIDIC solve: one displacement field from k weighted image pairs (paper, section 3.2)."""

from rgbmidic.correlation.constants import SolverConstants
from rgbmidic.correlation.discretisation import discretisation_error
from rgbmidic.correlation.one_sided_fit import unresolved_strain, with_one_sided_error
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.reference_update import ReferenceUpdate
from rgbmidic.correlation.residual import PrecisionMethod, Residual
from rgbmidic.correlation.solution import NodeStatus, Solution, Status, fill
from rgbmidic.correlation.solve import solve
from rgbmidic.correlation.start import TrackingState, find_initial_guess, track
from rgbmidic.renamed import refuse_old_names
from rgbmidic.weights.precision import Precision

__all__ = [
    "Deformed",
    "NodeStatus",
    "Precision",
    "PrecisionMethod",
    "Reference",
    "ReferenceUpdate",
    "Residual",
    "Solution",
    "SolverConstants",
    "Status",
    "TrackingState",
    "discretisation_error",
    "fill",
    "find_initial_guess",
    "solve",
    "track",
    "unresolved_strain",
    "with_one_sided_error",
]

__getattr__ = refuse_old_names(__name__)
