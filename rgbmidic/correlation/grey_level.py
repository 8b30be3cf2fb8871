"""Grey-level correction: the reference brought to the brightness and contrast of the deformed images."""

from __future__ import annotations

from typing import Literal

import numpy as np

from rgbmidic._kernels.correlation import element_vector, interpolate_nodal
from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.mesh.sparse import with_data
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["corrected_values"]

_LEAST_GAIN = 0.05
"""Least gain of the local correction: a light that has lost 95 % of its contrast is not amplified any further."""
_SMOOTHNESS = 1e-3
"""Weight of the smoothness of gain and offset over the mean entry of their matrix: carries them over what is unseen."""


def corrected_values(residual: Residual, kind: Literal["none", "global", "local"]) -> FloatImage:
    """Reference grey levels (k, P) brought to the brightness and contrast of the deformed images.

    ``"global"``: one gain and offset per light. ``"local"``: gain and offset as linear shape functions on the mesh
    (grey-level correction, paper, section 2.2). In both, f is taken as ``a g + b``; what is returned is ``(f - b) / a``
    of the uncorrected reference. ``"none"``: that itself.
    """
    reference = residual.reference
    if kind == "none":
        return reference.values
    lights = zip(reference.values, residual.warped, residual.weights, strict=True)
    if kind == "global":
        return np.stack([_one_gain(f, g, weight.astype(np.float64)) for f, g, weight in lights])
    return np.stack([_gain_field(reference, f, g, weight) for f, g, weight in lights])


def _one_gain(f: FloatImage, g: FloatImage, weight: FloatArray) -> FloatImage:
    total = weight.sum()
    if not total:
        return f
    mean_f, mean_g = (weight * f).sum() / total, (weight * g).sum() / total
    # both images carry the same noise: the ratio of the deviations is not attenuated by it
    spread_f, spread_g = (float((weight * (i - m) ** 2).sum()) for i, m in ((f, mean_f), (g, mean_g)))
    gain = np.sqrt(spread_f / spread_g) if spread_f > 0 and spread_g > 0 else 1.0
    return np.asarray((f - mean_f) / gain + mean_g, dtype=np.float32)


def _gain_field(reference: Reference, f: FloatImage, g: FloatImage, weight: FloatImage) -> FloatImage:
    if not weight.any():
        return f
    pixels, assembly = reference.pixels, reference.assembly
    scale = float(np.sqrt((weight * g * g).sum() / weight.sum())) or 1.0
    g = g / np.float32(scale)
    system = assembly.matrix(reference.blocks(weight, g, np.ones_like(g)))
    smooth = _SMOOTHNESS * system.diagonal().mean() * assembly.smoothness.data
    parts = np.zeros((len(reference.mesh.elements), 3, 2))
    geometry = pixels.local_x, pixels.local_y, pixels.offsets, pixels.barycentric
    element_vector(weight, f, g, np.ones_like(g), *geometry, parts)
    nodal = assembly.factorise(with_data(system, system.data + smooth))(assembly.vector(parts)).reshape(-1, 2)
    fields = np.empty((2, f.size), dtype=np.float32)
    interpolate_nodal(nodal, reference.mesh.elements, *geometry, fields)
    gain = np.maximum(fields[0] / np.float32(scale), np.float32(_LEAST_GAIN))
    return np.asarray((f - fields[1]) / gain, dtype=np.float32)
