"""What of a frame is measured, and what of it is read: the region of interest, finite elements, windows."""

from __future__ import annotations

import logging

import numpy as np

from rgbmidic.correlation.start import search_reach
from rgbmidic.errors import RegionError
from rgbmidic.fields import CameraCalibration
from rgbmidic.frames import Window, read_frame
from rgbmidic.mesh import FiniteElementMesh, Placement, Region, Tri3Mesh, read_mesh
from rgbmidic.mesh.placement import on_image
from rgbmidic.settings import RegionSettings, TestSettings, grey_levels
from rgbmidic.typing import FloatArray

logger = logging.getLogger(__name__)


_WORTH = 0.5
"""Share of the frame from which all of it is read: what a window saves would be less than half."""


def finite_elements_of(
    settings: TestSettings, frame: tuple[int, int]
) -> tuple[FiniteElementMesh, Placement, Tri3Mesh, Region]:
    """The part of ``mesh.file`` that is measured, where it lies on frames of this shape, and its pixels."""
    assert settings.mesh.file is not None
    camera = None if settings.scale.camera is None else CameraCalibration.read(settings.scale.camera)
    placement = Placement.fit(settings.mesh.points or (), camera)
    logger.info("mesh.points: %s", placement.summary())
    limits = settings.region
    allowed = read_region(limits, frame) if limits.is_stated else Region.from_mask(np.ones(frame, dtype=bool))
    every = read_mesh(settings.mesh.file, unit=settings.mesh.unit or "mm", part=settings.mesh.part)
    part, mesh, region = on_image(every, placement, frame, allowed.without(limits.holes))
    return part, placement, mesh, region


def region_and_window(settings: TestSettings, region: Region | None, frame: tuple[int, int]) -> tuple[Region, Window]:
    """The region, counted from where the window begins, and the part of the reference frames that is read."""
    region = region or read_region(settings.region, frame)
    spans = [np.flatnonzero(region.mask.any(axis=axis)) for axis in (0, 1)]
    corners = np.array([[span[0], span[-1]] for span in spans], dtype=np.float64).T
    window = window_around(corners, search_reach(corners), settings, frame)
    if np.prod(window.shape) > _WORTH * np.prod(frame):
        return region, Window.whole(frame)
    return region.part(*window.part_of(Window.whole(frame))), window


def window_around(
    points: FloatArray, reach: float, settings: TestSettings, frame: tuple[int, int], around: float = 96.0
) -> Window:
    """What lies within `reach` of points (N, 2), and what its images depend on.

    The separation's local statistics use `around` px: three standard deviations of their windows with all that is
    between (`rgbmidic.lab.inspection.channels.InspectionConstants`).
    """
    may_crack = bool(settings.mesh.cracks) or settings.mesh.file is not None
    sigma, _ = grey_levels(settings.illumination.normalise, settings.solver, cracked=may_crack)
    return Window.around(points, reach + max(around, 3 * max(sigma, settings.weights.blur)), frame)


def read_region(settings: RegionSettings, shape: tuple[int, int]) -> Region:
    """The region of interest of the settings on images of `shape` (H, W).

    Parameters
    ----------
    settings
        The section ``[region]``.
    shape
        Rows and columns of the images.

    Returns
    -------
    Region

    Raises
    ------
    RegionError
        The region is empty, outside the image, or the mask image has another size.
    """
    if settings.rectangle is not None:
        outlined = Region.from_rectangle(settings.rectangle, shape)
    elif settings.polygon is not None:
        outlined = Region.from_polygon(settings.polygon, shape)
    else:
        assert settings.mask is not None
        try:
            outlined = Region.from_mask(read_frame(settings.mask, kind="monochrome").values[0], shape)
        except RegionError as error:
            raise RegionError(f"region.mask {settings.mask}: {error}") from None
    return outlined.without(settings.holes)
