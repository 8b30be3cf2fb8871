"""From a solution to what an engineer reads: the field at pixels and nodes, strain, rates, units, probes."""

from rgbmidic.fields.covariance import NodalCovariance
from rgbmidic.fields.differences import difference_std, frame_covariance, reference_share
from rgbmidic.fields.evaluate import at_nodes, at_pixels, field_rms
from rgbmidic.fields.gauges import Gauge, StrainGauge
from rgbmidic.fields.high_pass import SIGMA, high_pass
from rgbmidic.fields.history import History, Nodal, Probe
from rgbmidic.fields.locate import Places
from rgbmidic.fields.means import Mean
from rgbmidic.fields.measures import EQUIVALENT, MEASURES, Strain, strain_of_gradient
from rgbmidic.fields.probes import PROBES, make_probe
from rgbmidic.fields.rates import Rates, rates
from rgbmidic.fields.rigid import RigidMotion
from rgbmidic.fields.strain import StrainGauges, shortest_gauge, strain_of
from rgbmidic.fields.units import Units, column

__all__ = [
    "EQUIVALENT",
    "MEASURES",
    "PROBES",
    "SIGMA",
    "Gauge",
    "History",
    "Mean",
    "Nodal",
    "NodalCovariance",
    "Places",
    "Probe",
    "Rates",
    "RigidMotion",
    "Strain",
    "StrainGauge",
    "StrainGauges",
    "Units",
    "at_nodes",
    "at_pixels",
    "column",
    "difference_std",
    "field_rms",
    "frame_covariance",
    "high_pass",
    "make_probe",
    "rates",
    "reference_share",
    "shortest_gauge",
    "strain_of",
    "strain_of_gradient",
]
