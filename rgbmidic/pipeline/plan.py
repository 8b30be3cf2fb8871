"""What all frames of a test share, made once before the first is measured.

calibration -> series of frames -> reference frames -> one image per light, averaged -> region and mesh -> weights ->
reference of the solve.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Lock

import numpy as np

from rgbmidic.correlation import Reference
from rgbmidic.correlation.renewal import Renewal
from rgbmidic.errors import FrameError, RegionError
from rgbmidic.frames import FrameSeries, open_series, read_frame
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.texture import speckle_diameter
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.raw_samples import HARDLY_ENOUGH, check_texture, exposure_fault, too_small
from rgbmidic.pipeline.separation import RawState, Separation, correlated
from rgbmidic.settings import RegionSettings, TestSettings
from rgbmidic.weights import LightWeights, prepare_weights

__all__ = ["Plan", "ReferenceUpdates", "read_region"]

logger = logging.getLogger(__name__)

_LOOKED_AT = 512
"""Largest side (px) of the part of the region in which the speckle is measured: thousands of speckles, .1 s."""
_KEPT_UPDATES = 2
"""Updated references that a process keeps: frames measured side by side follow this one or the last."""


class ReferenceUpdates:
    """The references that frames of one test have become lately, made once for all threads of a process.

    A copy sent to another process begins empty.
    """

    def __init__(self) -> None:
        self._kept: deque[tuple[tuple[int, ...], Renewal]] = deque(maxlen=_KEPT_UPDATES)
        self._lock = Lock()

    def __reduce__(self) -> tuple[type[ReferenceUpdates], tuple[()]]:
        return ReferenceUpdates, ()

    def get(self, frames: tuple[int, ...], make: Callable[[], Renewal]) -> Renewal:
        """The reference that the `frames` make in turn: a kept one, else what `make` gives."""
        with self._lock:
            for known, renewal in self._kept:
                if known == frames:
                    return renewal
            self._kept.append((frames, make()))
            return self._kept[-1][1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What all frames of a test share; it can be pickled, so that any process can measure any frame.

    Attributes
    ----------
    settings
        What TEST.toml says.
    series
        The frames.
    separation
        From a raw frame to one image per light.
    region
        What is measured.
    weights
        How much each light counts.
    images
        Images of the reference state, in grey levels.
    reference
        The reference state as the solve needs it, with the mesh.
    speckle
        Size of the speckle in the reference's region, px; None where it is not known.
    timings
        Whether to tell the time that each stage of a frame takes.
    updates
        References that later frames have become.
    """

    settings: TestSettings
    series: FrameSeries
    separation: Separation
    region: Region
    weights: LightWeights
    images: IlluminationImages
    reference: Reference
    speckle: float | None
    timings: bool = False
    updates: ReferenceUpdates = field(default_factory=ReferenceUpdates, repr=False, compare=False)

    @classmethod
    def from_settings(cls, settings: TestSettings) -> Plan:
        """Read all that the settings name, except the deformed frames.

        Raises
        ------
        RgbmidicError
            The settings, the calibration, the region or the reference frames are not usable.
        """
        calibration = None if settings.calibration_file is None else Calibration.read(settings.calibration_file)
        start, *others = settings.frames.reference
        series = open_series(settings.frames, settings.base, calibration)
        first = series.read(start)
        if calibration is not None:
            height, width = first[0].values.shape[-2:]
            calibration = calibration.cropped(settings.frames.crop_origin, (height, width))
        separation = Separation(calibration=calibration, demosaic=settings.illumination.demosaic)
        images, separation = separation.reference(first, map(series.read, others))
        region = read_region(settings.region, images.shape)
        mesh = Tri3Mesh.from_region(region, settings.element_size, settings.cracks)
        weights = prepare_weights(
            settings, images, region, frames=len(series), images_of=lambda index: separation(series.read(index))
        )
        reference = Reference.prepare(
            correlated(images, settings.illumination),
            region,
            weights.reference(images),
            mesh=mesh,
            prefilter=settings.solver.prefilter,
        )
        speckle = _speckle(images, region)
        if small := too_small(settings.element_size, speckle, HARDLY_ENOUGH):
            logger.warning("%s", small)
        _check_seen(reference, first, region, ", ".join(map(series.name, settings.frames.reference)))
        return cls(
            settings=settings,
            series=series,
            separation=separation,
            region=region,
            weights=weights,
            images=images,
            reference=reference,
            speckle=speckle,
        )


def _speckle(images: IlluminationImages, region: Region) -> float | None:
    """Size of the speckle (px), the median over the lights, in the middle of the region; None where none shows any."""
    part = [
        slice(max(int(np.median(inside)) - _LOOKED_AT // 2, int(inside[0])), int(inside[-1]) + 1)
        for inside in (np.flatnonzero(region.mask.any(axis=axis)) for axis in (1, 0))
    ]
    pictures = [values[part[0], part[1]][:_LOOKED_AT, :_LOOKED_AT] for values in images.values]
    known = [np.where(np.isfinite(one), one, np.nanmean(one)) for one in pictures if np.isfinite(one).any()]
    sizes = [size for one in known if (size := speckle_diameter(one.astype(np.float64))) is not None]
    return float(np.median(sizes)) if sizes else None


def _check_seen(reference: Reference, state: RawState, region: Region, names: str) -> None:
    """Refuse a reference that no light sees or that shows no texture; `state` is its first."""
    if not reference.pixel_weights.any():
        fault = exposure_fault(state, region.mask) or "it is saturated, dark or excluded by the weights"
        raise FrameError(f"no light sees the region in the reference ({names}): {fault}")
    check_texture(state, region.mask, names)


def read_region(settings: RegionSettings, shape: tuple[int, int]) -> Region:
    """The region of interest of the settings on images of `shape` (H, W).

    Raises
    ------
    RegionError
        The region is empty, outside the image, or the mask image has another size.
    """
    return _outlined(settings, shape).without(settings.holes)


def _outlined(settings: RegionSettings, shape: tuple[int, int]) -> Region:
    """The region, its holes included."""
    if settings.rectangle is not None:
        return Region.from_rectangle(settings.rectangle, shape)
    if settings.polygon is not None:
        return Region.from_polygon(settings.polygon, shape)
    assert settings.mask is not None
    mask = read_frame(settings.mask, kind="monochrome").values[0]
    try:
        return Region.from_mask(mask, shape)
    except RegionError as error:
        raise RegionError(f"region.mask {settings.mask}: {error}") from None
