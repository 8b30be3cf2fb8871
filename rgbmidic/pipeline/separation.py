"""From what the camera recorded of one state to one image per light, as the settings and the calibration say."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from rgbmidic.errors import ConfigurationError, FrameError, InputError
from rgbmidic.frames.data import ChannelFrame, Mosaic, Window
from rgbmidic.illumination.calibration import Calibration, Crosstalk
from rgbmidic.illumination.images import IlluminationImages, normalise
from rgbmidic.illumination.linear import LinearChannels, linearise
from rgbmidic.illumination.separation import separate
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.settings import WIDER_AT_CRACKS, IlluminationSettings, SolverSettings
from rgbmidic.typing import FloatImage

__all__ = [
    "LightSeparation",
    "RawState",
    "Separation",
    "WindowedSeparation",
    "beside_cracks",
    "correlated",
    "light_images",
    "reference_images",
]

RawState = tuple[Mosaic | ChannelFrame, ...] | IlluminationImages
"""What a series gives of one state: a raw frame, or one per light fired in succession; or the lights' images already,
which are not separated any more."""


class LightSeparation(Protocol):
    """From what the camera recorded of one state to one image per light: `Separation`, or a function of one's own.

    It may also have

    - ``learnt(images)``: the separation of all other frames, which knows the images of the reference's first frame;
    - ``describe()``: a text that says what it does; another text is another test, which `resume` refuses.
    """

    def __call__(self, frames: tuple[Mosaic | ChannelFrame, ...], /) -> IlluminationImages:
        """Separate the lights of one state.

        Parameters
        ----------
        frames
            The raw frame, or one per light fired in succession.

        Returns
        -------
        IlluminationImages
            Images (k, H, W) of the size of the frame, of the same lights in every state.
        """
        ...


@runtime_checkable
class WindowedSeparation(LightSeparation, Protocol):
    """A separation of parts of frames, too; with another one frames are read whole."""

    def within(self, window: Window) -> LightSeparation:
        """The separation of a part of the frames."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Separation:
    """From what the camera recorded of one state to one image per light: linearise, demosaic, unmix.

    The images stay where they are: the solve reads each where its registration says that it lies.

    Attributes
    ----------
    calibration
        Crosstalk, noise and registration of the lights; None where monochrome frames need none.
    demosaic
        Method for Bayer frames, as in `IlluminationSettings`.
    texture
        The speckle's autocorrelation, shared by all frames of a test; None: each frame tells its own.
    """

    calibration: Calibration | None = None
    demosaic: str = "auto"
    texture: TextureModel | None = None

    def __call__(self, frames: tuple[Mosaic | ChannelFrame, ...]) -> IlluminationImages:
        """Illumination images of one state from its frame, or its frames if lights fired in succession.

        Raises
        ------
        ConfigurationError
            Colour frames without a calibrated crosstalk, or settings that contradict the calibration.
        """
        known = self.calibration or Calibration()
        linear = [linearise(frame, known.noise) for frame in frames]
        if all(isinstance(one, LinearChannels) and len(one.values) == 1 for one in linear):
            names = known.registration.lights if known.registration else ()
            images = IlluminationImages.in_succession([one for one in linear if isinstance(one, LinearChannels)], names)
        elif len(linear) > 1:
            raise ConfigurationError("frames.path names several series, which is for monochrome frames only")
        else:
            images = separate(linear[0], self._crosstalk(), self.demosaic, texture=self.texture)
        return replace(images, registration=known.registration)

    def within(self, window: Window) -> Separation:
        """The separation of a part of the frames."""
        return replace(self, calibration=self.calibration and self.calibration.cropped(window.origin, window.shape))

    def learnt(self, images: IlluminationImages) -> Separation:
        """The separation that takes the speckle's texture from the images of one state for all others."""
        return replace(self, texture=images.texture)

    def _crosstalk(self) -> Crosstalk:
        if self.calibration is None or self.calibration.crosstalk is None:
            what = "calibration.file is missing" if self.calibration is None else "calibration.file has no crosstalk"
            raise ConfigurationError(f"{what}: colour frames need the crosstalk matrix of rgbmidic-calibrate crosstalk")
        return self.calibration.crosstalk


def light_images(separation: LightSeparation, state: RawState, window: Window) -> IlluminationImages:
    """One image per light of a state, or of a `window` of it; a state that has them already gives them as they are.

    Raises
    ------
    InputError
        A separation of the user's gives something else than images of the size of the frame.
    RgbmidicError
        What the separation raises.
    """
    if isinstance(state, IlluminationImages):
        return state
    if not window.is_whole:
        assert isinstance(separation, WindowedSeparation), "frames of another separation are read whole"
        separation = separation.within(window)
    images = separation(state)
    if not isinstance(images, IlluminationImages) or images.shape != state[0].values.shape[-2:]:
        told = f"of shape {images.values.shape}" if isinstance(images, IlluminationImages) else ""
        raise InputError(
            f"the separation must give IlluminationImages of the size of the frame {state[0].values.shape[-2:]}; it "
            f"gives {type(images).__name__} {told}".rstrip()
        )
    return images if window.is_whole else images.placed(window.origin)


def reference_images(
    separation: LightSeparation, states: Iterable[RawState], window: Window
) -> tuple[IlluminationImages, LightSeparation]:
    """Mean image of each light over the states of the reference, and the separation that has learnt from the first.

    A pixel is valid where it is valid in all of them. They are taken one by one.

    Raises
    ------
    FrameError
        The frames have different shapes.
    RgbmidicError
        As `light_images`.
    """
    others = iter(states)
    mean = light_images(separation, next(others), window)
    if (learn := getattr(separation, "learnt", None)) is not None:
        separation = learn(mean)
    total, valid, count = mean.values.astype(np.float64), mean.valid, 1
    for images in (light_images(separation, state, window) for state in others):
        if images.values.shape != total.shape:
            raise FrameError(f"the reference frames have different shapes: {total.shape}, {images.values.shape}")
        total, valid, count = total + images.values, valid & images.valid, count + 1
    return replace(mean, values=(total / count).astype(np.float32), valid=valid), separation


def beside_cracks(mesh: Tri3Mesh, sigma: float, solver: SolverSettings) -> tuple[float, SolverSettings]:
    """Width (px) of the local mean and settings of the solve that hold for a mesh: others where it has cracks.

    A local mean takes in the gap of an open crack, and the other side, which may be lit otherwise. So it is made wider,
    and means over the elements around each node, on one side and without the gap, do the rest.
    """
    if not sigma or not len(mesh.crack_edges):
        return sigma, solver
    return WIDER_AT_CRACKS * sigma, solver if solver.brightness == "local" else replace(solver, brightness="mean")


def correlated(images: IlluminationImages, settings: IlluminationSettings) -> FloatImage:
    """What the solve correlates (k, H, W): the lights' images, locally normalised unless the settings say no."""
    sigma = settings.normalise
    return normalise(images.values, sigma, images.full_scale) if sigma else images.values
