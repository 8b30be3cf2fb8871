"""The MIDIC solve: one displacement field from k weighted image pairs (paper, section 3.2)."""

from rgbmidic.correlation.correlate import correlate
from rgbmidic.correlation.fill import fill
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.renewal import Renewal
from rgbmidic.correlation.solution import NodeStatus, Solution, Status
from rgbmidic.correlation.solve import solve
from rgbmidic.correlation.start import find_start
from rgbmidic.correlation.track import Start, track

__all__ = [
    "Deformed",
    "NodeStatus",
    "Reference",
    "Renewal",
    "Solution",
    "Start",
    "Status",
    "correlate",
    "fill",
    "find_start",
    "solve",
    "track",
]
