"""How the paper judges a set-up and a specimen, for any data: perturbation P, goniometry, topography."""

from rgbmidic.lab.measures.perturbation import (
    Area,
    area_means,
    area_stds,
    areas_along_x,
    perturbation,
    residual_percent,
)
from rgbmidic.lab.measures.surface import (
    Goniometry,
    Lobe,
    detrend,
    fit_lobe,
    goniometry,
    local_slope,
    paint_classes,
    pixel_levels,
    rms_slope,
    slope_uncertainty,
    wrinkle_spacing,
)

__all__ = [
    "Area",
    "Goniometry",
    "Lobe",
    "area_means",
    "area_stds",
    "areas_along_x",
    "detrend",
    "fit_lobe",
    "goniometry",
    "local_slope",
    "paint_classes",
    "perturbation",
    "pixel_levels",
    "residual_percent",
    "rms_slope",
    "slope_uncertainty",
    "wrinkle_spacing",
]
