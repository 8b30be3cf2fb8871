"""How much each light counts at each pixel."""

from rgbmidic.weights.light_weights import (
    LightWeights,
    MaskWeights,
    Statistics,
    as_weights,
    precision_method,
    prepare_weights,
)
from rgbmidic.weights.precision import Precision
from rgbmidic.weights.threshold import (
    DisturbedZone,
    SetUpThreshold,
    blurred,
    disturbed_zone,
    set_up_threshold,
    threshold_weights,
)

__all__ = [
    "DisturbedZone",
    "LightWeights",
    "MaskWeights",
    "Precision",
    "SetUpThreshold",
    "Statistics",
    "as_weights",
    "blurred",
    "disturbed_zone",
    "precision_method",
    "prepare_weights",
    "set_up_threshold",
    "threshold_weights",
]
