"""Camera channels to one image per light, on one pixel grid: crosstalk and lateral registration undone.

Where the camera sees ``channels = A lights``, the lights are ``A^-1 channels`` at every pixel (`unmix`). Light j sees
at x + rho_j(x) what the first light sees at x (`Registration`), in the reference and in the deformed state alike; the
solve reads it there. Sampled there (`align`), its image shows every point where the first light's image shows it.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from rgbmidic._kernels.interpolation import PAD, bspline_coefficients, sample_with_gradient
from rgbmidic._kernels.lights import unmix as unmix_kernel
from rgbmidic.errors import InputError
from rgbmidic.illumination.calibration import Crosstalk
from rgbmidic.illumination.images import IlluminationImages, fill_holes
from rgbmidic.illumination.linear import LinearChannels
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["NEGLIGIBLE", "align", "needed", "unmix"]

NEGLIGIBLE = 0.25
"""A clipped channel makes a light invalid only if its coefficient is above this fraction of the light's largest: the
light's own channel does, a neighbour's crosstalk of some 10 % does not. Two lights of three see on where the third
saturates; what leaks from beyond full scale is smooth or judged by the residual like the rest of a reflection."""

_ALIGNED = 0.002
"""A light that is nowhere farther than this (px) from the first is left as it is.

Chosen: a fifth of the noise floor of DIC in good images, .01 px.
"""

GRID = 32
"""Largest distance (px) of the points between which a matrix that varies over the field is interpolated."""
_ROWS = 64
"""Rows that are warped at a time: their positions take less memory than an image."""


def unmix(channels: LinearChannels, crosstalk: Crosstalk, *, negligible: float = NEGLIGIBLE) -> IlluminationImages:
    """Return one image per light from camera channels: ``lights = A^-1 channels`` (pseudo-inverse for k < C).

    Parameters
    ----------
    channels
        Values (C, H, W) above black, with their validity.
    crosstalk
        A, shape (C, k), everywhere the same or varying over the field.
    negligible
        Coefficients of A^-1 below this fraction of the largest of their row do not make a light invalid; a clipped
        channel then counts with the value it has.

    Returns
    -------
    IlluminationImages
        (k, H, W); invalid where any channel with a non-negligible coefficient is.

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
    shape = channels.values.shape[1:]
    if crosstalk.field is not None and crosstalk.field.shape != shape:
        calibrated = crosstalk.field.shape
        raise InputError(
            f"the crosstalk varies over a field of {calibrated[1]} x {calibrated[0]} px; the frame has {shape[1]} x "
            f"{shape[0]} px: calibrate with frames of the size of the test"
        )
    # A^-1 at every `step`-th pixel and beyond the last ones, (GY, GX, k, C); one cell of the grid where it is constant
    step = max(shape) if crosstalk.field is None else max(min(GRID, min(shape) // 16), 2)
    y, x = (step * np.arange((side - 1) // step + 2) for side in shape)
    grid = crosstalk.unmixing_at(np.stack(np.meshgrid(x, y), axis=-1)).astype(np.float32)
    values = np.empty((len(crosstalk.lights), *shape), dtype=np.float32)
    valid = np.empty(values.shape, dtype=bool)
    unmix_kernel(
        np.ascontiguousarray(channels.values, dtype=np.float32),
        np.ascontiguousarray(channels.valid, dtype=bool),
        grid,
        step,
        needed(crosstalk.unmixing, negligible),
        values,
        valid,
    )
    return IlluminationImages(values=values, valid=valid, names=crosstalk.lights, full_scale=channels.full_scale)


def needed(matrix: FloatArray, negligible: float = NEGLIGIBLE) -> BoolArray:
    """Find the channels that must be valid for each light that ``matrix @ channels`` gives.

    Parameters
    ----------
    matrix : ndarray, shape (k, C)
        A^-1, or what else makes lights of channels.
    negligible
        Fraction of the largest entry of a row under which a channel need not be valid.

    Returns
    -------
    ndarray, shape (k, C), bool
    """
    return np.asarray(np.abs(matrix) > negligible * np.abs(matrix).max(axis=1, keepdims=True))


def align(images: IlluminationImages) -> IlluminationImages:
    """Warp every light to the first one's pixels by cubic B-spline interpolation.

    Pixels whose neighbourhood of interpolation is invalid or outside the image become invalid.

    Parameters
    ----------
    images
        (k, H, W), each where its `registration` says.

    Returns
    -------
    IlluminationImages
        On the pixel grid of the first light, without a registration.
    """
    if (registration := images.registration) is None:
        return images
    height, width = images.shape
    values, spline = images.values.copy(), np.empty((height + 2 * PAD, width + 2 * PAD), dtype=np.float32)
    for light, image in enumerate(images.values):
        bspline_coefficients(fill_holes(image), spline)
        near_hole = cv2.dilate(np.isnan(image).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        for top in range(0, height, _ROWS):
            part = values[light, top : top + _ROWS]
            y, x = np.mgrid[top : top + len(part), :width].reshape(2, -1).astype(np.float64)
            shift = registration.displacement(np.stack([x, y], axis=1) + images.origin)[light].T
            if np.abs(shift).max() > _ALIGNED:
                x, y = x + shift[0], y + shift[1]
                sampled = np.empty((3, x.size), dtype=np.float32)
                sample_with_gradient(spline, x, y, *sampled)
                inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
                row, column = (np.round(np.where(inside, at, 0)).astype(np.intp) for at in (y, x))
                usable = inside & ~near_hole[row, column]
                part[:] = np.where(usable, sampled[0], np.float32(np.nan)).reshape(part.shape)
    return replace(images, values=values, valid=np.isfinite(values), registration=None)
