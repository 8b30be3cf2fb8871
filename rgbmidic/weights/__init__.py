"""How much each light counts at each pixel."""

from rgbmidic.weights.light_weights import LightWeights, prepare_weights

__all__ = ["LightWeights", "prepare_weights"]
