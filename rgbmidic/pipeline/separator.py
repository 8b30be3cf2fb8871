"""From what the camera recorded of one state to one image per light, as the settings and the calibration say."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbmidic.errors import ConfigurationError, FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.align import align
from rgbmidic.illumination.calibration import Calibration, Crosstalk
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.linearise import LinearChannels, LinearMosaic, linearise
from rgbmidic.illumination.separate import frame_texture, separate
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.illumination.unmix import unmix
from rgbmidic.settings import TestSettings

__all__ = ["Separator", "average"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Separator:
    """From what the camera recorded of one state to one image per light.

    Attributes
    ----------
    crosstalk
        None for monochrome frames.
    calibration
        Camera noise and settings, where there is a calibration.
    settings
        The test's settings.
    texture
        The speckle's autocorrelation, learnt once from the reference so that all frames are separated alike; None: each
        frame tells its own.
    """

    settings: TestSettings
    calibration: Calibration | None = None
    texture: TextureModel | None = None

    @classmethod
    def from_settings(cls, settings: TestSettings) -> Separator:
        """Read the calibration file that the settings name, if any."""
        file = settings.calibration_file
        return cls(settings=settings, calibration=None if file is None else Calibration.read(file))

    def with_texture_of(self, frames: tuple[Mosaic | ChannelFrame, ...]) -> Separator:
        """The same, knowing the speckle that one state shows."""
        linear = linearise(frames[0], self.calibration.noise if self.calibration else None)
        if not isinstance(linear, LinearMosaic):
            return self
        return replace(self, texture=frame_texture(linear, self.settings.illumination.demosaic))

    def __call__(self, frames: tuple[Mosaic | ChannelFrame, ...]) -> IlluminationImages:
        """Illumination images of one state from its frame, or its frames if lights fired in succession.

        Raises
        ------
        ConfigurationError
            Colour frames without a calibrated crosstalk, or settings that contradict the calibration.
        """
        noise = self.calibration.noise if self.calibration else None
        linear = [linearise(frame, noise) for frame in frames]
        if all(isinstance(one, LinearChannels) and len(one.values) == 1 for one in linear):
            return IlluminationImages.in_succession([one for one in linear if isinstance(one, LinearChannels)])
        if len(linear) > 1:
            raise ConfigurationError("frames.path names several series, which is for monochrome frames only")
        crosstalk = self._crosstalk()
        (only,) = linear
        if isinstance(only, LinearMosaic):
            images = separate(only, crosstalk, self.settings.illumination.demosaic, texture=self.texture)
        else:
            images = unmix(only, crosstalk)
        registration = self.calibration.registration if self.calibration else None
        return images if registration is None else align(images, registration)

    def _crosstalk(self) -> Crosstalk:
        if self.calibration is None or self.calibration.crosstalk is None:
            what = "calibration.file is missing" if self.calibration is None else "calibration.file has no crosstalk"
            raise ConfigurationError(f"{what}: colour frames need the crosstalk matrix of rgbmidic-calibrate crosstalk")
        return self.calibration.crosstalk


def average(images: list[IlluminationImages]) -> IlluminationImages:
    """Mean of several images of one state; a pixel is valid where it is valid in all of them.

    Raises
    ------
    FrameError
        The images have different shapes.
    """
    first = images[0]
    if len(images) == 1:
        return first
    shapes = {one.values.shape for one in images}
    if len(shapes) > 1:
        raise FrameError(f"the reference frames have different shapes: {sorted(shapes)}")
    values = np.asarray(np.mean([one.values for one in images], axis=0, dtype=np.float64))
    return replace(
        first,
        values=np.asarray(values, dtype=np.float32),
        valid=np.logical_and.reduce([one.valid for one in images]),
    )
