"""From a solution to what an engineer reads: the field at pixels and nodes."""

from rgbmidic.fields.evaluate import at_nodes, at_pixels, field_rms
from rgbmidic.fields.fill import fill
from rgbmidic.fields.high_pass import SIGMA, high_pass

__all__ = ["SIGMA", "at_nodes", "at_pixels", "field_rms", "fill", "high_pass"]
