"""From a solution to what an engineer reads: the field at pixels and nodes, strain, rates, units, probes."""

from rgbmidic.field import Displacement, Field
from rgbmidic.fields.cracks import Jump, crack_jump
from rgbmidic.fields.history import SIGMA, Probe, high_pass, rates
from rgbmidic.fields.interpolation import MeshPoints, at_nodes, at_pixels, field_rms
from rgbmidic.fields.nodal import (
    CalibrationErrors,
    NodalCovariance,
    RigidMotion,
    difference_std,
    frame_covariance,
    reference_fraction,
)
from rgbmidic.fields.plane import CameraCalibration, Rectification
from rgbmidic.fields.probes import Area, Mean, make_probe
from rgbmidic.fields.profiles import ProfileLine
from rgbmidic.fields.quantity import Units
from rgbmidic.fields.strain import MEASURES, Strain, StrainGauges, shortest_gauge, strain_of, strain_of_gradient
from rgbmidic.renamed import refuse_old_names
from rgbmidic.text import format_value, format_with_std

__all__ = [
    "MEASURES",
    "SIGMA",
    "Area",
    "CalibrationErrors",
    "CameraCalibration",
    "Displacement",
    "Field",
    "Jump",
    "Mean",
    "MeshPoints",
    "NodalCovariance",
    "Probe",
    "ProfileLine",
    "Rectification",
    "RigidMotion",
    "Strain",
    "StrainGauges",
    "Units",
    "at_nodes",
    "at_pixels",
    "crack_jump",
    "difference_std",
    "field_rms",
    "format_value",
    "format_with_std",
    "frame_covariance",
    "high_pass",
    "make_probe",
    "rates",
    "reference_fraction",
    "shortest_gauge",
    "strain_of",
    "strain_of_gradient",
]

__getattr__ = refuse_old_names(__name__)
