"""From what the camera recorded of a state to one image per light: linearise, demosaic, unmix.

`separate` is the single call for one frame; `Separation` holds what all frames of a test share, and `LightSeparation`
is the protocol that it and a function of the user's follow.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import cv2
import numpy as np

from rgbmidic.arguments import checked
from rgbmidic.errors import ConfigurationError, FrameError, InputError
from rgbmidic.frames.data import ChannelFrame, Mosaic, Window
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk, unmix
from rgbmidic.illumination.demosaicing import (
    SMALLEST_FRAME,
    FilterTables,
    Reconstruction,
    malvar_demosaic,
    normalised_demosaic,
    reconstruct,
)
from rgbmidic.illumination.images import IlluminationImages, Registration
from rgbmidic.illumination.linear import LinearChannels, LinearMosaic, linearise
from rgbmidic.illumination.texture import TextureModel

DEFAULT_METHOD = "reflection-aware"
_BY_CHANNEL = {"malvar": malvar_demosaic, "normalised": normalised_demosaic}
"""Methods that know nothing of lights: demosaic, then unmix."""
DEMOSAICERS = (DEFAULT_METHOD, *_BY_CHANNEL)
"""The methods by the name they have in the configuration, where ``"auto"`` means the one that suits the frame."""


@checked
def separate(
    frame: Mosaic | ChannelFrame | LinearMosaic | LinearChannels,
    calibration: Calibration | Crosstalk,
    method: str = "auto",
    *,
    texture: TextureModel | None = None,
) -> IlluminationImages:
    """Return one image per light from one raw colour frame, as a measurement uses them.

    The frame is linearised, demosaiced and unmixed. No image is resampled: a calibrated registration comes with the
    images, and `correlate` reads each light where it says. `IlluminationImages.on_first_light` resamples them.

    Parameters
    ----------
    frame
        As it was recorded, or linearised (`linearise`) already.
    calibration
        Of camera and lights; or their crosstalk alone, shape (3, k).
    method
        How a mosaic is demosaiced: one of `DEMOSAICERS`, or ``"auto"``: reflection-aware where the frame is large
        enough, else Malvar.
    texture
        The speckle's autocorrelation for the methods that use it; None: they learn it from the frame.

    Returns
    -------
    IlluminationImages
        Shape (k, H, W), DN above black.

    Raises
    ------
    InputError
        Unknown method, a frame too small for it, no crosstalk, or one that is not for the frame's channels.

    Examples
    --------
    >>> crosstalk = Crosstalk(matrix=[[1, 0.1, 0], [0.1, 1, 0.1], [0, 0.1, 1]], lights=("red", "green", "blue"))
    >>> raw_values = np.full((16, 20), 564, dtype=np.uint16)
    >>> frame = Mosaic(values=raw_values, cfa="RGGB", black_level=64, white_level=4095)
    >>> images = separate(frame, crosstalk)
    >>> images.names, images.shape
    (('red', 'green', 'blue'), (16, 20))
    >>> images.values[:, 8, 8].round()
    array([459., 408., 459.], dtype=float32)
    """
    if isinstance(calibration, Crosstalk):
        calibration = Calibration(crosstalk=calibration)
    linear = linearise(frame, calibration.noise) if isinstance(frame, Mosaic | ChannelFrame) else frame
    return _separated(linear, calibration, method, texture)


def _separated(
    linear: LinearMosaic | LinearChannels,
    calibration: Calibration,
    method: str,
    texture: TextureModel | None,
    tables: FilterTables | None = None,
) -> IlluminationImages:
    """One image per light, each where the lens put it."""
    crosstalk, registration = calibration.crosstalk, calibration.registration
    if crosstalk is None:
        raise InputError("the calibration has no crosstalk, which colour frames need (rgbmidic-calibrate crosstalk)")
    if isinstance(linear, LinearChannels):
        return replace(unmix(linear, crosstalk), registration=registration)
    method = _resolve_method(method, linear)
    if crosstalk.matrix.shape[0] != 3:
        rows = crosstalk.matrix.shape[0]
        raise InputError(f"a Bayer mosaic has 3 camera channels; the crosstalk matrix has {rows} rows")
    if method != DEFAULT_METHOD:
        return replace(unmix(_BY_CHANNEL[method](linear), crosstalk), registration=registration)
    model = reconstruct(linear, crosstalk, registration=registration, texture=texture)
    return reconstructed_lights(model, crosstalk, registration=registration, tables=tables)


@checked
def demosaic(
    mosaic: Mosaic | LinearMosaic,
    method: str = DEFAULT_METHOD,
    *,
    crosstalk: Crosstalk | None = None,
    texture: TextureModel | None = None,
) -> LinearChannels:
    """All three camera channels at every pixel of a mosaic.

    Parameters
    ----------
    mosaic
        As it was recorded, or linearised.
    method
        As in `separate`.
    crosstalk, texture
        For the reflection-aware method: see `rgbmidic.illumination.demosaicing.reconstruct`.

    Returns
    -------
    LinearChannels
        Shape (3, H, W) in the order R, G, B, DN above black.

    Raises
    ------
    InputError
        Unknown method, or a frame too small for it.

    Examples
    --------
    >>> mosaic = Mosaic(values=np.full((16, 20), 564, dtype=np.uint16), cfa="RGGB", black_level=64, white_level=4095)
    >>> demosaic(mosaic, "malvar").values[:, 8, 8]
    array([500., 500., 500.], dtype=float32)
    """
    linear = linearise(mosaic) if isinstance(mosaic, Mosaic) else mosaic
    if not isinstance(linear, LinearMosaic):
        raise InputError(f"demosaicing takes a LinearMosaic, not {type(linear).__name__}")
    if (method_name := _resolve_method(method, linear)) != DEFAULT_METHOD:
        return _BY_CHANNEL[method_name](linear)
    return reconstruct(linear, crosstalk, texture=texture).predicted()


def reconstructed_lights(
    model: Reconstruction,
    crosstalk: Crosstalk,
    *,
    registration: Registration | None = None,
    tables: FilterTables | None = None,
) -> IlluminationImages:
    """The lights of a frame, and their reflection index, from what the reflection-aware method found out of it.

    Crosstalk that is the same everywhere is taken off as the lights are predicted, else from the channels predicted.
    The index, on the blocks' grid, is how much less contrast a light has than the best one.
    """
    height, width = model.factors.slope.shape[1:]
    unmixing = crosstalk.unmixing
    level = np.stack(
        [cv2.resize(mean, (width, height), interpolation=cv2.INTER_AREA) for mean in model.moments.channel_mean]
    )
    slope, light = (np.tensordot(unmixing, of_channels, axes=1) for of_channels in (model.factors.slope, level))
    contrast = np.divide(slope, light, out=np.zeros_like(slope), where=light > 1e-3 * light.max())
    best = contrast.max(axis=0)
    relative = np.divide(contrast, best, out=np.ones_like(contrast), where=best > 0)
    diagnostics = {
        "reflection": 1 - np.clip(relative, 0, 1),
        "displacement": model.displacement,
        "texture": model.texture,
        "registration": registration,
    }
    if crosstalk.field is not None:
        return replace(unmix(model.predicted(tables=tables), crosstalk), **diagnostics)
    lights = model.predicted(unmixing, tables)
    return IlluminationImages(
        values=lights.values, valid=lights.valid, names=crosstalk.lights, full_scale=lights.full_scale, **diagnostics
    )


def _resolve_method(method: str, mosaic: LinearMosaic) -> str:
    """The method meant, "auto" resolved."""
    if method == "auto":
        return DEFAULT_METHOD if min(mosaic.values.shape) >= SMALLEST_FRAME else "malvar"
    if method not in DEMOSAICERS:
        raise InputError(f"unknown demosaicing method {method!r}; allowed are auto, {', '.join(DEMOSAICERS)}")
    return method


RawState = tuple[Mosaic | ChannelFrame, ...] | IlluminationImages
"""What a series gives of one state: a raw frame, or one per light fired in succession; or the lights' images already,
which are not separated any more."""


class LightSeparation(Protocol):
    """A function that turns what the camera recorded of one state into one image per light, such as `Separation`.

    It may also have

    - ``learnt(images)``: the separation of all other frames, which has the images of the reference's first frame;
    - ``describe()``: a text that says what it does; another text is another test, which `resume` refuses.

    Examples
    --------
    >>> def first_channel(frames: tuple[Mosaic | ChannelFrame, ...]) -> IlluminationImages:
    ...     values = frames[0].values[:1].astype(float)
    ...     return IlluminationImages(values=values, valid=values >= 0, names=("red",), full_scale=4095.0)
    >>> separation: LightSeparation = first_channel
    >>> frame = ChannelFrame(values=np.full((3, 4, 5), 9, dtype=np.uint16), black_level=np.zeros(3), white_level=4095.0)
    >>> separation((frame,)).values.shape
    (1, 4, 5)
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
    """A separation that linearises, demosaics and unmixes what the camera recorded into one image per light.

    The images stay where they are: the solve reads each where its registration says that it lies.

    Attributes
    ----------
    calibration
        Crosstalk, noise and registration of the lights; None where monochrome frames need none.
    demosaic
        Method for Bayer frames, as in `IlluminationSettings`.
    texture
        The speckle's autocorrelation, shared by all frames of a test; None: each frame tells its own.
    tables
        The filters that its frames have needed so far.

    Examples
    --------
    >>> frame = ChannelFrame(values=np.full((1, 4, 5), 9, dtype=np.uint16), black_level=np.ones(1), white_level=4095.0)
    >>> Separation()((frame,)).values[0, 0, 0]
    np.float32(8.0)
    """

    calibration: Calibration | None = None
    demosaic: str = "auto"
    texture: TextureModel | None = None
    tables: FilterTables = field(default_factory=FilterTables, repr=False, compare=False)

    def __call__(self, frames: tuple[Mosaic | ChannelFrame, ...]) -> IlluminationImages:
        """Illumination images of one state from its frame, or its frames if lights fired in succession.

        Raises
        ------
        ConfigurationError
            Colour frames without a calibrated crosstalk, or settings that contradict the calibration.
        """
        calibration = self.calibration or Calibration()
        linear = [linearise(frame, calibration.noise) for frame in frames]
        if all(isinstance(channels, LinearChannels) and len(channels.values) == 1 for channels in linear):
            names = calibration.registration.lights if calibration.registration else ()
            images = IlluminationImages.in_succession(
                [channels for channels in linear if isinstance(channels, LinearChannels)], names
            )
            return replace(images, registration=calibration.registration)
        if len(linear) > 1:
            raise ConfigurationError("frames.path names several series, which is for monochrome frames only")
        if calibration.crosstalk is None:
            problem = "calibration.file is missing" if self.calibration is None else "calibration.file has no crosstalk"
            raise ConfigurationError(
                f"{problem}: colour frames need the crosstalk matrix of rgbmidic-calibrate crosstalk; of one white "
                'light, state frames.kind = "monochrome"'
            )
        return _separated(linear[0], calibration, self.demosaic, self.texture, self.tables)

    def within(self, window: Window) -> Separation:
        """The separation of a part of the frames.

        Parameters
        ----------
        window
            The part of the frame.

        Returns
        -------
        Separation
        """
        return replace(self, calibration=self.calibration and self.calibration.cropped(window.origin, window.shape))

    def learnt(self, images: IlluminationImages) -> Separation:
        """The separation that takes the speckle's texture from the images of one state for all others.

        Parameters
        ----------
        images
            One image a light, of the state that the texture is taken from.

        Returns
        -------
        Separation
        """
        return replace(self, texture=images.texture)


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
        description = f"of shape {images.values.shape}" if isinstance(images, IlluminationImages) else ""
        raise InputError(
            f"the separation must give IlluminationImages of the size of the frame {state[0].values.shape[-2:]}; it "
            f"gives {type(images).__name__} {description}".rstrip()
        )
    return images if window.is_whole else images.with_origin(window.origin)


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
    remaining = iter(states)
    mean = light_images(separation, next(remaining), window)
    if (learn := getattr(separation, "learnt", None)) is not None:
        separation = learn(mean)
    total, valid, count = mean.values.astype(np.float64), mean.valid, 1
    for images in (light_images(separation, state, window) for state in remaining):
        if images.values.shape != total.shape:
            raise FrameError(f"the reference frames have different shapes: {total.shape}, {images.values.shape}")
        total, valid, count = total + images.values, valid & images.valid, count + 1
    return replace(mean, values=(total / count).astype(np.float32), valid=valid), separation
