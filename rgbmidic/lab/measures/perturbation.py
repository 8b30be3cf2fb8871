"""Perturbation P of a displacement field over areas, and the residual in percent of the dynamic range.

Paper, section 2.2: the displacement minus its Gaussian-filtered copy, and its standard deviation over areas.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.fields import SIGMA, high_pass
from rgbmidic.typing import FloatArray

AREA_SIZE = (50.0, 100.0)
"""Width and height (px) of the paper's areas."""
_MEASURED = 0.5
"""Fraction of an area that must be measured for a figure on it; chosen."""


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
        """Return the pixels of an image whose centres lie in the area.

        Parameters
        ----------
        image
            Shape (..., H, W).

        Returns
        -------
        ndarray, shape (..., h, w)

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
    """Areas A0, A1, ... in a row along x, as on the paper's Fig. 4.

    Parameters
    ----------
    first
        Centre (x, y) of A0 in px.
    pitch
        Distance between the centres in px; a negative one runs to the left.
    count
        How many.
    size
        (width, height) of each in px.

    Returns
    -------
    tuple of Area
    """
    return tuple(Area(name=f"A{i}", centre=(first[0] + i * pitch, first[1]), size=size) for i in range(count))


def perturbation(field: npt.ArrayLike, areas: Sequence[Area], *, sigma: float = SIGMA) -> FloatArray:
    """Perturbation P (paper, section 2.2): standard deviation in each area of a displacement without its long waves.

    Parameters
    ----------
    field : array_like, shape (H, W)
        A component of the displacement in px, NaN where not measured (`rgbmidic.fields.at_pixels`).
    areas
        Where P is assessed.
    sigma
        Standard deviation in px of the Gaussian of `rgbmidic.fields.high_pass`.

    Returns
    -------
    ndarray, shape (n,)
        P in px; NaN where less than half of the area is measured.

    Raises
    ------
    InputError
        An area does not lie in the image, or there is nothing to filter.
    """
    return area_stds(high_pass(field, sigma), areas)


def residual_percent(reference: npt.ArrayLike, deformed: npt.ArrayLike, displacement: FloatArray) -> float:
    """Residual of a measurement in % of the effective dynamic range (paper, section 2.2).

    Standard deviation of the difference between the reference image and the deformed image warped by the
    displacement (cubic spline interpolation), over the largest minus the smallest grey level of the two images.

    Parameters
    ----------
    reference, deformed
        Images (H, W) of one light; NaN where invalid.
    displacement
        (u, v) in px at the pixels of the reference image, shape (2, H, W); NaN where not measured.

    Returns
    -------
    float
        %.

    Raises
    ------
    InputError
        The shapes do not fit, or nothing is measured.
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


def area_stds(high_passed: FloatArray, areas: Sequence[Area]) -> FloatArray:
    """Return the standard deviation of an image in each area.

    Parameters
    ----------
    high_passed : ndarray, shape (H, W)
        For P: `rgbmidic.fields.high_pass` of a displacement in px; NaN where not measured.
    areas
        n areas.

    Returns
    -------
    ndarray, shape (n,)
        In the unit of the image; NaN where less than half of the area is measured.
    """
    return np.array([_over_measured(area.cut(high_passed), np.nanstd) for area in areas])


def area_means(field: FloatArray, areas: Sequence[Area]) -> FloatArray:
    """Mean of an image in each area.

    Parameters
    ----------
    field : ndarray, shape (H, W)
        NaN where not measured.
    areas
        n areas.

    Returns
    -------
    ndarray, shape (n,)
        In the unit of the image; NaN where less than half of the area is measured.
    """
    return np.array([_over_measured(area.cut(field), np.nanmean) for area in areas])
