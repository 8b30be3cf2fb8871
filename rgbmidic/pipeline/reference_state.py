"""The reference frames of a test: read, checked, separated, averaged."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

from rgbmidic.correlation import Reference
from rgbmidic.errors import FrameError
from rgbmidic.frames import Window
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.frame_check import check_state
from rgbmidic.illumination.images import DARK, IlluminationImages
from rgbmidic.illumination.separation import LightSeparation, RawState, reference_images
from rgbmidic.mesh import Region
from rgbmidic.pipeline.source import Series
from rgbmidic.pipeline.suitability import (
    SUITABILITY,
    check_texture,
    exposure_fault,
    light_levels,
    saturated_fraction,
    shifted_levels,
)
from rgbmidic.settings import TestSettings

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceState:
    """The reference frames: the first two as they were recorded, the mean images of all, the separation that learnt."""

    names: str
    states: Sequence[RawState]
    images: IlluminationImages
    separation: LightSeparation

    @classmethod
    def read(
        cls,
        settings: TestSettings,
        series: Series,
        separation: LightSeparation,
        window: Window,
        region: Region,
        calibration: Calibration | None,
    ) -> ReferenceState:
        """Read, check and separate them one by one."""
        indices = settings.frames.reference
        names = ", ".join(map(series.name, indices))
        states = [series.read(index, window) for index in indices[:2]]
        _check_raw(states, names, settings, window, region, calibration)
        others = (series.read(index, window) for index in indices[2:])
        images, learnt = reference_images(separation, chain(states, others), window)
        return cls(names=names, states=states, images=images, separation=learnt)

    def check_seen(self, reference: Reference, region: Region) -> None:
        """Refuse a reference that no light sees or that shows no texture; warn of a light that is off."""
        if not reference.pixel_weights.any():
            fault = exposure_fault(self.states[0], region.mask)
            raise FrameError(
                f"no light sees the region in the reference ({self.names}): "
                f"{fault or 'it is saturated, dark or excluded by the weights'}"
            )
        check_texture(self.states[0], region.mask, self.names)
        levels = light_levels(self.images, region)
        off = [f"{light} ({level:.1%})" for light, level in levels.items() if level < DARK]
        if off and not isinstance(self.states[0], IlluminationImages):
            logger.warning(
                "the reference (%s) shows no light of %s: the median in the region is under %.0f %% of the full scale; "
                "are the lamps on?",
                self.names,
                ", ".join(off),
                100 * DARK,
            )


def _check_raw(
    states: Sequence[RawState],
    names: str,
    settings: TestSettings,
    window: Window,
    region: Region,
    calibration: Calibration | None,
) -> None:
    """Refuse raw frames that contradict the stated levels or their `calibration`, and warn of doubtful ones."""
    raw = [state for state in states if not isinstance(state, IlluminationImages)]
    for frame in raw[0] if raw else ():
        if shifted := shifted_levels(samples := frame.values[..., region.mask], frame.white_level):
            raise FrameError(f"the reference ({names}): {shifted}")
        if (largest := samples.max()) > _ABOVE * frame.white_level:
            logger.warning(
                "the samples of the reference (%s) reach %d, far above white_level %g: is it that of the camera, and "
                "is the order of the bytes (frames.dtype) right?",
                names,
                largest,
                frame.white_level,
            )
    share = saturated_fraction(raw[0], region.mask) if raw else 0.0
    if share > _BLIND:
        raise FrameError(f"no light sees the region in the reference ({names}): {exposure_fault(raw[0], region.mask)}")
    if share > SUITABILITY.saturated:
        logger.warning("%.0f %% of the samples in the region of the reference (%s) are saturated", 100 * share, names)
    if calibration is None or not raw:
        return
    if not window.is_whole:
        calibration = calibration.cropped(window.origin, window.shape)
    repeat = raw[1] if len(raw) > 1 else None
    for found in check_state(raw[0], calibration, region.mask, names, accept=settings.accept, repeat=repeat):
        if found.passed:
            logger.warning("%s may not be what %s calibrates: %s", names, settings.calibration_file, found.text)


_ABOVE = 2.0
"""Samples this many times the white level have a bit more than it: it is not the camera's, or deliberately low."""
_BLIND = 0.98
"""Fraction from which the lights are not separated: with .985 they still were, with .99 no texture was left to learn
from in two of three frames (measured)."""
