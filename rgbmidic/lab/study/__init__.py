"""The paper's own studies, on virtual and real data: perturbation P, goniometry, topography, methods compared."""

from rgbmidic.lab.study.bench import BENCHES, Bench, lamp_for_reflection
from rgbmidic.lab.study.competitors import METHODS, Competitor, Method
from rgbmidic.lab.study.goniometry import Goniometry, Lobe, fit_lobe, goniometry, pixel_levels
from rgbmidic.lab.study.paper import ANGLES, run_paper_study
from rgbmidic.lab.study.perturbation import (
    Area,
    area_means,
    area_stds,
    areas_along_x,
    perturbation,
    residual_percent,
)
from rgbmidic.lab.study.results import Measurement, PaperStudy, SceneStudy
from rgbmidic.lab.study.topography import (
    detrend,
    local_slope,
    paint_classes,
    rms_slope,
    slope_uncertainty,
    wrinkle_spacing,
)
from rgbmidic.weights.disturbed_zone import DisturbedZone, SetUpThreshold, disturbed_zone, set_up_threshold

__all__ = [
    "ANGLES",
    "BENCHES",
    "METHODS",
    "Area",
    "Bench",
    "Competitor",
    "DisturbedZone",
    "Goniometry",
    "Lobe",
    "Measurement",
    "Method",
    "PaperStudy",
    "SceneStudy",
    "SetUpThreshold",
    "area_means",
    "area_stds",
    "areas_along_x",
    "detrend",
    "disturbed_zone",
    "fit_lobe",
    "goniometry",
    "lamp_for_reflection",
    "local_slope",
    "paint_classes",
    "perturbation",
    "pixel_levels",
    "residual_percent",
    "rms_slope",
    "run_paper_study",
    "set_up_threshold",
    "slope_uncertainty",
    "wrinkle_spacing",
]
