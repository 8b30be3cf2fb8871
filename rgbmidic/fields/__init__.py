"""From a solution to what an engineer reads: the field at pixels, strain, rates."""

from rgbmidic.fields.evaluate import at_nodes, at_pixels, field_rms
from rgbmidic.fields.strain import nodal_strain

__all__ = ["at_nodes", "at_pixels", "field_rms", "nodal_strain"]
