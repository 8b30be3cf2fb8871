"""Camera channels to lights: the crosstalk between lights and camera channels undone at every pixel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.unmix import unmix as unmix_kernel
from rgbmidic.errors import InputError
from rgbmidic.illumination.calibration import Crosstalk
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.mosaic import LinearChannels

__all__ = ["NEGLIGIBLE", "unmix"]

NEGLIGIBLE = 1e-3
"""A channel whose coefficient is below this fraction of the light's largest does not make the light invalid: clipped at
full scale it would change the light by less than a thousandth of full scale."""


def unmix(channels: LinearChannels, crosstalk: Crosstalk, *, negligible: float = NEGLIGIBLE) -> IlluminationImages:
    """One image per light from camera channels: ``lights = A^-1 channels`` (pseudo-inverse for k < C).

    Parameters
    ----------
    channels
        Values (C, H, W) above black, with their validity.
    crosstalk
        A, shape (C, k).
    negligible
        Coefficients of A^-1 below this fraction of the largest of their row do not make a light invalid.

    Returns
    -------
    IlluminationImages
        (k, H, W); invalid where any channel with a non-negligible coefficient is. The covariance, where the camera
        noise is known, is ``A^-1 diag(variance of a raw sample at the channel's median) A^-T``.

    Raises
    ------
    InputError
        The channels do not fit the crosstalk matrix.
    """
    colours = crosstalk.matrix.shape[0]
    if channels.values.ndim != 3 or len(channels.values) != colours or channels.valid.shape != channels.values.shape:
        raise InputError(
            f"the crosstalk matrix has {colours} camera channels; the channels given have shape "
            f"{channels.values.shape}, their validity {channels.valid.shape}"
        )
    matrix = crosstalk.unmixing
    needed = np.abs(matrix) > negligible * np.abs(matrix).max(axis=1, keepdims=True)
    lights, shape = len(matrix), channels.values.shape[1:]
    values = np.empty((lights, shape[0] * shape[1]), dtype=np.float32)
    valid = np.empty(values.shape, dtype=bool)
    flat = np.ascontiguousarray(channels.values, dtype=np.float32).reshape(colours, -1)
    flat_valid = np.ascontiguousarray(channels.valid, dtype=bool).reshape(colours, -1)
    unmix_kernel(flat, flat_valid, matrix.astype(np.float32), needed, values, valid)
    return IlluminationImages(
        values=values.reshape(lights, *shape),
        valid=valid.reshape(lights, *shape),
        names=crosstalk.lights,
        full_scale=channels.full_scale,
        covariance=_covariance(channels, matrix),
    )


def _covariance(channels: LinearChannels, matrix: npt.NDArray[np.float64]) -> npt.NDArray[np.float64] | None:
    if channels.noise is None:
        return None
    # A coarse grid is plenty for a median and spares a full sort of every frame.
    sample, valid = channels.values[:, ::7, ::5], channels.valid[:, ::7, ::5]
    levels = [np.median(v[ok]) if ok.any() else channels.full_scale for v, ok in zip(sample, valid, strict=True)]
    return np.asarray((matrix * channels.noise.variance(np.array(levels))) @ matrix.T)
