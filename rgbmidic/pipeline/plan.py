"""What all frames of a test share, made once before the first is measured.

calibration -> series of frames -> reference frames -> one image per light, averaged -> region and mesh -> weights ->
reference of the solve.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from rgbmidic.correlation import Reference
from rgbmidic.errors import FrameError, RegionError
from rgbmidic.frames import FrameSeries, open_series, read_frame
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.frame_check import check_state
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.raw_samples import check_texture, exposure_fault
from rgbmidic.pipeline.separation import RawState, Separation, correlated
from rgbmidic.settings import RegionSettings, TestSettings
from rgbmidic.weights import LightWeights, prepare_weights

__all__ = ["Plan", "read_region"]

logger = logging.getLogger(__name__)


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
    timings
        Whether to tell the time that each stage of a frame takes.
    """

    settings: TestSettings
    series: FrameSeries
    separation: Separation
    region: Region
    weights: LightWeights
    images: IlluminationImages
    reference: Reference
    timings: bool = False

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
        names = ", ".join(map(series.name, settings.frames.reference))
        if calibration is not None:
            again = series.read(others[0]) if others else None
            for found in check_state(first, calibration, region.mask, names, accept=settings.accept, repeat=again):
                if not found.certain:
                    logger.warning("%s may not be what %s calibrates: %s", names, settings.calibration_file, found.text)
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
        _check_seen(reference, first, region, names)
        return cls(
            settings=settings,
            series=series,
            separation=separation,
            region=region,
            weights=weights,
            images=images,
            reference=reference,
        )


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
