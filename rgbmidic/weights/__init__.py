"""How much each light counts at each pixel."""

from rgbmidic.weights.light_weights import LightWeights, MaskWeights, prepare_weights
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
    "SetUpThreshold",
    "blurred",
    "disturbed_zone",
    "prepare_weights",
    "set_up_threshold",
    "threshold_weights",
]
