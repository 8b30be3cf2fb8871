"""The fine part of a displacement field: what a wide Gaussian filter takes out is taken off (paper, section 2.2)."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["SIGMA", "high_pass"]

SIGMA = 40.0
"""Standard deviation (px) of the paper's Gaussian filter."""
_KNOWN = 1e-3
"""Share of the filter's weight that must lie on measured pixels."""


def high_pass(field: npt.ArrayLike, sigma: float = SIGMA) -> FloatArray:
    """A field (H, W) minus its copy filtered by a Gaussian: the paper's U tilde.

    NaN pixels take no part: the filter is the normalised convolution, the sum of the measured pixels' values over the
    sum of their weights. At the edge of the measured region such a filter is lopsided and would leak the field's slope
    into the result. The best quadratic polynomial is therefore taken off first and its own, exactly known, share
    (a constant) put back: within the region the result is the plain filter's, and near the edge only what is
    neither rotation, stretch nor bending of the whole field can leak.

    Parameters
    ----------
    field
        One component of the displacement (px).
    sigma
        Standard deviation of the Gaussian, px.

    Raises
    ------
    InputError
        `field` is not one image, or nothing in it is measured.
    """
    values = np.asarray(field, dtype=np.float64)
    if values.ndim != 2 or not sigma > 0:
        raise InputError(f"one image (H, W) and a positive sigma are needed, not shape {values.shape}, sigma {sigma!r}")
    known = np.isfinite(values)
    if known.sum() < 10:
        raise InputError("the field is measured at fewer than 10 pixels")
    trend, laplacian = _quadratic_trend(values, known)
    rest = np.where(known, values - trend, 0.0)
    weight = _blur(known.astype(np.float64), sigma)
    smooth = _blur(rest, sigma) / np.maximum(weight, _KNOWN)
    usable = known & (weight > _KNOWN)
    return np.where(usable, rest - smooth - sigma**2 / 2 * laplacian, np.nan)


def _blur(image: FloatArray, sigma: float) -> FloatArray:
    """Gaussian filter with zeros beyond the image, which the normalisation takes out."""
    # what is filtered is small beside the displacement itself: single precision holds it to 1e-7 px
    filtered = cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(filtered, dtype=np.float64)


def _quadratic_trend(values: FloatArray, known: BoolArray) -> tuple[FloatArray, float]:
    """Least-squares polynomial of degree 2 in x and y (H, W), and its Laplacian."""
    scale = float(max(values.shape))
    y, x = (axis / scale for axis in np.mgrid[: values.shape[0], : values.shape[1]])
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    step = max(1, int(np.sqrt(known.sum() / 20_000)))
    some = np.zeros_like(known)
    some[::step, ::step] = known[::step, ::step]
    if some.sum() < 10:
        some = known
    coefficients = np.linalg.lstsq(basis[some], values[some], rcond=None)[0]
    return basis @ coefficients, float(2 * (coefficients[3] + coefficients[5]) / scale**2)
