"""Perturbation P of a displacement field, the zone a reflection disturbs, and the weighting threshold of a set-up.

Paper, sections 2.2 and 3.2: the displacement minus its Gaussian-filtered copy, and its standard deviation over areas.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError

__all__ = [
    "AREA_SIZE",
    "SIGMA",
    "Area",
    "area_means",
    "area_stds",
    "areas_along_x",
    "high_pass",
    "perturbation",
    "residual_percent",
]

Image = npt.NDArray[np.float64]

SIGMA = 40.0
"""Standard deviation (px) of the paper's Gaussian filter."""
AREA_SIZE = (50.0, 100.0)
"""Width and height (px) of the paper's areas."""
_MEASURED = 0.5
"""Share of an area that must be measured for a figure on it."""
_KNOWN = 1e-3
"""Share of the filter's weight that must lie on measured pixels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Area:
    """A rectangle of the reference image over which the perturbation is assessed.

    Attributes
    ----------
    name
        For instance ``"A0"``.
    centre
        (x, y) in px.
    size
        (width, height) in px.
    """

    name: str
    centre: tuple[float, float]
    size: tuple[float, float] = AREA_SIZE

    @property
    def rectangle(self) -> tuple[float, float, float, float]:
        """(x0, y0, x1, y1) in px."""
        (x, y), (width, height) = self.centre, self.size
        return x - width / 2, y - height / 2, x + width / 2, y + height / 2

    def cut(self, image: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        """The pixels of an image (..., H, W) whose centres lie in the area.

        Raises
        ------
        InputError
            The area is not wholly inside the image.
        """
        height, width = image.shape[-2:]
        x0, y0, x1, y1 = self.rectangle
        if not (0 <= x0 < x1 <= width - 1 and 0 <= y0 < y1 <= height - 1):
            raise InputError(f"area {self.name} {self.rectangle} does not lie in the image of {width} x {height} px")
        return image[..., int(np.ceil(y0)) : int(y1) + 1, int(np.ceil(x0)) : int(x1) + 1]


def areas_along_x(
    first: tuple[float, float], *, pitch: float = 100.0, count: int = 5, size: tuple[float, float] = AREA_SIZE
) -> tuple[Area, ...]:
    """Areas A0, A1, ... along x, from the centre (x, y) of the first one; a negative pitch runs to the left."""
    return tuple(Area(name=f"A{i}", centre=(first[0] + i * pitch, first[1]), size=size) for i in range(count))


def high_pass(field: npt.ArrayLike, sigma: float = SIGMA) -> Image:
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


def area_stds(high_passed: Image, areas: Sequence[Area]) -> npt.NDArray[np.float64]:
    """Standard deviation of an image in each area; NaN where less than half of the area is measured."""
    return np.array([_over_measured(area.cut(high_passed), np.nanstd) for area in areas])


def area_means(field: Image, areas: Sequence[Area]) -> npt.NDArray[np.float64]:
    """Mean of an image in each area; NaN where less than half of the area is measured."""
    return np.array([_over_measured(area.cut(field), np.nanmean) for area in areas])


def perturbation(field: npt.ArrayLike, areas: Sequence[Area], *, sigma: float = SIGMA) -> npt.NDArray[np.float64]:
    """Perturbation P of a displacement component (H, W) in each area: the standard deviation of `high_pass`, in px."""
    return area_stds(high_pass(field, sigma), areas)


def residual_percent(reference: npt.ArrayLike, deformed: npt.ArrayLike, displacement: Image) -> float:
    """Residual of a measurement in % of the effective dynamic range (paper, section 2.2).

    Standard deviation of the difference between the reference image and the deformed image brought back by the
    displacement (cubic spline interpolation), over the largest minus the smallest grey level of the two images.

    Parameters
    ----------
    reference, deformed
        Images (H, W) of one light; NaN where invalid.
    displacement
        (u, v) at the pixels of the reference image, shape (2, H, W); NaN where not measured.
    """
    from scipy.ndimage import map_coordinates

    f, g = np.asarray(reference, dtype=np.float64), np.asarray(deformed, dtype=np.float64)
    rows, columns = np.nonzero(np.isfinite(displacement[0]) & np.isfinite(f))
    if f.shape != g.shape or displacement.shape != (2, *f.shape) or not rows.size:
        raise InputError(f"images and displacement do not fit: {f.shape}, {g.shape}, {displacement.shape}")
    there = displacement[:, rows, columns]
    unknown = ~np.isfinite(g)
    place = np.stack([rows + there[1], columns + there[0]])
    back = map_coordinates(np.where(unknown, np.nanmean(g), g), place, order=3, mode="constant", cval=np.nan)
    if unknown.any():
        back[map_coordinates(unknown.astype(np.float32), place, order=1) > 0] = np.nan
    used = f[rows, columns]
    span = max(used.max(), np.nanmax(back)) - min(used.min(), np.nanmin(back))
    return float(100 * np.nanstd(back - used) / span)


def _over_measured(values: npt.NDArray[np.floating], statistic: object) -> float:
    enough = np.isfinite(values).mean() >= _MEASURED
    return float(statistic(values)) if enough else float("nan")  # type: ignore[operator]


def _blur(image: Image, sigma: float) -> Image:
    """Gaussian filter with zeros beyond the image, which the normalisation takes out."""
    # what is filtered is small beside the displacement itself: single precision holds it to 1e-7 px
    filtered = cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(filtered, dtype=np.float64)


def _quadratic_trend(values: Image, known: npt.NDArray[np.bool_]) -> tuple[Image, float]:
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
