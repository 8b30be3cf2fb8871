"""The inspection of one frame: what a user must know before a test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rgbmidic.correlation import Solution, correlate
from rgbmidic.errors import ConfigurationError, FrameError, InputError
from rgbmidic.frames import open_source
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.calibration import Calibration, Crosstalk
from rgbmidic.illumination.demosaic import ReflectionAwareDemosaicer
from rgbmidic.illumination.demosaic.reflection_aware import SMALLEST_FRAME
from rgbmidic.illumination.images import REFLECTING, IlluminationImages
from rgbmidic.illumination.linearise import LinearChannels, LinearMosaic, NoiseModel, linearise
from rgbmidic.illumination.normalise import local_mean
from rgbmidic.illumination.separate import separate_reflections
from rgbmidic.illumination.unmix import unmix
from rgbmidic.lab.inspection.repeat import BayerRepeat, noise_difference
from rgbmidic.lab.inspection.results import BLIND, ChannelFacts, Inspection, LightFacts, Spread
from rgbmidic.lab.inspection.samples import Channel, channels_of, noise_estimate, speckle_size
from rgbmidic.mesh import Region
from rgbmidic.pipeline import Separation, read_region
from rgbmidic.settings import (
    ELEMENT_SIZE,
    FrameSettings,
    RegionSettings,
    TestSettings,
)
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["inspect_files", "inspect_frame", "state_frames"]

Frames = tuple[Mosaic | ChannelFrame, ...]
Prefilter = Literal["none", "binomial", "gaussian"]

CONTRAST_WIDTH = (10.0, 40.0)
"""Least and largest standard deviation (px) of the window in which local contrast is taken: 2.5 speckles between."""


def inspect_files(
    files: Sequence[Path | str],
    *,
    test: TestSettings | None = None,
    calibration: Path | str | None = None,
    frame: FrameSettings | None = None,
    region: Sequence[float] | None = None,
    element_size: float | None = None,
) -> Inspection:
    """Inspect one frame on disk, or the frames of one state of lights fired in succession.

    Parameters
    ----------
    files
        One file, or one per light.
    test
        Settings of a test; its sections say how the frame is read, separated and measured.
    calibration
        Calibration file; instead of the test's.
    frame
        What the file does not tell (its `path` is not used); instead of the test's.
    region, element_size
        (x0, y0, x1, y1) and side of the elements in px; instead of the test's, else the whole frame and 25.

    Raises
    ------
    RgbmidicError
        A file is missing, damaged or contradicts what is stated; the frame cannot be inspected.
    """
    stated = _settings(frame or (test.frames if test else None), test)
    file = calibration or (test.calibration_file if test else None)
    known = None if file is None else Calibration.read(file)
    paths = [Path(one) for one in files]
    frames = tuple(open_source(path, stated.frames, known).read(0) for path in paths)
    shape = frames[0].values.shape[-2], frames[0].values.shape[-1]
    place = Region.from_rectangle(region, shape) if region is not None else None
    if place is None and test is not None:
        place = read_region(test.region, shape)
    try:
        return inspect_frame(
            frames,
            calibration=known,
            region=place,
            element_size=element_size or (test.element_size if test else ELEMENT_SIZE),
            demosaic=stated.illumination.demosaic,
            normalise=stated.illumination.normalise,
            prefilter=stated.solver.prefilter,
            name=" + ".join(path.name for path in paths),
        )
    except InputError as error:
        raise FrameError(f"{' + '.join(map(str, paths))}: {error}") from None


def inspect_frame(
    frame: Mosaic | ChannelFrame | Sequence[Mosaic | ChannelFrame],
    *,
    calibration: Calibration | None = None,
    region: Region | Sequence[float] | None = None,
    element_size: float = ELEMENT_SIZE,
    demosaic: str = "auto",
    normalise: float = 10.0,
    prefilter: Prefilter = "binomial",
    name: str = "frame",
    seed: int = 0,
) -> Inspection:
    """What one frame tells before a test: exposure, lights, reflections, speckle, noise, uncertainty to expect.

    The uncertainty is predicted by letting the solver measure a simulated repeat of the frame: the frame's lights, and
    the same with what a second, moved exposure would get wrong (`rgbmidic.lab.inspection.repeat`).

    Parameters
    ----------
    frame
        A raw frame, or one monochrome frame per light of lights fired in succession.
    calibration
        Crosstalk, noise and registration as far as they are known. Without crosstalk the channels stand for the lights,
        without noise it is estimated from the frame.
    region
        What will be measured; None: the whole frame.
    element_size
        Side of the elements in px.
    demosaic, normalise, prefilter
        As in TEST.toml.
    name
        Of the frame, for reports.
    seed
        Of the simulated repeat.

    Raises
    ------
    InputError
        The frame is too small, saturated everywhere in the region, or of another kind than the calibration.
    RegionError
        The region is empty, outside the frame or too small for one element.
    """
    frames = (frame,) if isinstance(frame, Mosaic | ChannelFrame) else tuple(frame)
    seen = _Seen.prepare(frames, calibration, region, demosaic)
    images, index, texture = seen.lights(), None, None
    channels = seen.channel_facts()
    if isinstance(first := seen.linear[0], LinearMosaic):
        found = separate_reflections(first, seen.crosstalk)
        index, texture = found.reflection_index, found.texture
    contrast = _local_contrast(images, _contrast_window(channels))
    if index is None and len(contrast) > 1:
        index = np.asarray(1 - contrast / np.maximum(contrast.max(axis=0), 1e-6), dtype=np.float32)
    whole, noise = seen.differences(np.random.default_rng(seed))

    smoothing: dict[str, Any] = {"prefilter": prefilter, "normalise": normalise or None, "curvature": True}

    def predicted(change: FloatImage, light: slice = slice(None)) -> Solution:
        pair = images.values[light], (images.values + change)[light]
        return correlate(*pair, region=seen.region, element_size=element_size, initial=(0.0, 0.0), **smoothing)

    together = predicted(whole)
    std = together.displacement_std
    many = len(images.names) > 1
    alone = [predicted(whole, slice(j, j + 1)).displacement_std if many else std for j in range(len(images.names))]
    sampled = isinstance(first, LinearMosaic)
    return Inspection(
        name=name,
        kind="bayer" if sampled else ("rgb" if len(seen.linear[0].values) == 3 else "monochrome"),
        channels=channels,
        lights=_light_facts(images, contrast, index, alone, seen.region.mask),
        images=images,
        reflection_index=index,
        saturated=np.logical_or.reduce([channel.saturated for channel in seen.channels]),
        region=seen.region.mask,
        hidden=_hidden(contrast, seen.region.mask),
        texture=texture,
        noise=seen.noise,
        noise_known=seen.noise_known,
        crosstalk_known=seen.crosstalk_known,
        element_size=element_size,
        nodes=together.nodes,
        elements=together.elements,
        std=std,
        noise_std=predicted(noise).displacement_std if sampled else std,
        sampling_std=predicted(whole - noise).displacement_std if sampled else 0 * std,
        greens=_greens(first) if isinstance(first, LinearMosaic) else 0.0,
    )


def state_frames(test: TestSettings | None, *, count: int = 1, **stated: Any) -> FrameSettings:
    """The test's frame settings, or none, with what is stated in their place (`FrameSettings`; None: not stated).

    Raises
    ------
    ConfigurationError
        Something stated is not allowed, or several frames that are not monochrome.
    """
    given = {key: value for key, value in stated.items() if value is not None}
    allowed = ("bayer", "rgb", "monochrome")
    if given.get("kind", "bayer") not in allowed:
        raise ConfigurationError(f"kind must be one of {', '.join(allowed)}, not {given['kind']!r}")
    if given.get("dtype", "uint8") not in ("uint8", "uint16", ">u2"):
        raise ConfigurationError(f"dtype must be one of uint8, uint16, >u2, not {given['dtype']!r}")
    if len(given.get("shape", (1, 1))) != 2:
        raise ConfigurationError("shape is two numbers, rows and columns")
    if test is not None:
        return replace(test.frames, **given)
    return FrameSettings(path=("frame",) * (count if given.get("kind") == "monochrome" else 1), **given)


def _settings(frames: FrameSettings | None, test: TestSettings | None) -> TestSettings:
    """The test's settings with other frames, or default ones; their region is not used."""
    if test is not None:
        return replace(test, frames=frames or test.frames)
    return TestSettings(
        frames=frames or FrameSettings(path=("frame",)),
        region=RegionSettings(rectangle=(0.0, 0.0, 1.0, 1.0)),
        calibration_file=Path("calibration.json"),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Seen:
    """A frame made ready: linearised, with the crosstalk and noise it is looked at with."""

    frames: Frames
    linear: list[LinearMosaic | LinearChannels]
    channels: list[Channel]
    region: Region
    separation: Separation
    crosstalk: Crosstalk
    crosstalk_known: bool
    noise: NoiseModel
    noise_known: bool
    estimates: tuple[float, ...]

    @classmethod
    def prepare(
        cls,
        frames: Frames,
        calibration: Calibration | None,
        region: Region | Sequence[float] | None,
        demosaic: str,
    ) -> _Seen:
        known = calibration or Calibration()
        linear = [linearise(one, known.noise) for one in frames]
        shape = linear[0].values.shape[-2:]
        _check_frames(linear)
        place = region if isinstance(region, Region) else Region.from_rectangle(_rectangle(region, shape), shape)
        channels = channels_of(linear)
        _check_light(channels, place.mask)
        single = not isinstance(linear[0], LinearMosaic) and len(linear[0].values) == 1
        crosstalk = known.crosstalk or Crosstalk.identity(("red", "green", "blue"))
        estimates = [] if known.noise else noise_estimate(channels, place.mask)
        typical = (
            float(np.sqrt(np.nanmean(np.square(estimates)))) if estimates and not np.isnan(estimates).all() else 0.0
        )
        return cls(
            frames=frames,
            linear=linear,
            channels=channels,
            region=place,
            separation=Separation(calibration=replace(known, crosstalk=crosstalk), demosaic=demosaic),
            crosstalk=crosstalk,
            crosstalk_known=single or known.crosstalk is not None,
            noise=known.noise or NoiseModel(gain=float("inf"), read_noise=typical),
            noise_known=known.noise is not None,
            estimates=tuple(estimates),
        )

    def lights(self) -> IlluminationImages:
        """One image per light, as the test would have them."""
        return self.separation(self.frames)

    def differences(self, random: np.random.Generator) -> tuple[FloatImage, FloatImage]:
        """What two states differ by (k, H, W), DN, though nothing has moved; and the part from camera noise."""
        first = self.linear[0]
        if isinstance(first, LinearMosaic):
            model = ReflectionAwareDemosaicer(crosstalk=self.crosstalk).reconstruct(first)
            method = self.separation.demosaic
            repeat = BayerRepeat(mosaic=first, model=model, crosstalk=self.crosstalk, method=method, noise=self.noise)
            return repeat.draw(random)
        full = [one for one in self.linear if isinstance(one, LinearChannels)]
        noise = noise_difference(full, self.noise, self._unmixed, random)
        return noise, noise

    def _unmixed(self, frames: Sequence[LinearChannels]) -> IlluminationImages:
        if len(frames[0].values) == 3:
            return unmix(frames[0], self.crosstalk)
        return IlluminationImages(
            values=np.concatenate([one.values for one in frames]),
            valid=np.concatenate([one.valid for one in frames]),
            names=tuple(map(str, range(len(frames)))),
            full_scale=frames[0].full_scale,
        )

    def channel_facts(self) -> tuple[ChannelFacts, ...]:
        """Figures of the samples of each channel."""
        full_scale, facts = self.linear[0].full_scale, []
        for number, channel in enumerate(self.channels):
            samples = channel.values[self.region.mask & np.isfinite(channel.values)] / full_scale
            low, high = np.quantile(samples, [0.05, 0.95])
            level = float(samples.mean())
            calibrated = float(np.sqrt(self.noise.variance(np.array(level * full_scale))))
            facts.append(
                ChannelFacts(
                    name=channel.name,
                    mean=level,
                    low=float(low),
                    high=float(high),
                    saturated=float(channel.saturated[self.region.mask].sum() / samples.size),
                    speckle_px=speckle_size(channel, self.region.mask, self.noise if self.noise_known else None),
                    noise_dn=calibrated if self.noise_known else self.estimates[number],
                )
            )
        return tuple(facts)


def _check_frames(linear: list[LinearMosaic | LinearChannels]) -> None:
    shapes = {one.values.shape for one in linear}
    if len(shapes) > 1:
        raise InputError(f"frames of lights in succession must have one shape; given are {sorted(shapes)}")
    if len(linear) > 1 and (isinstance(linear[0], LinearMosaic) or len(linear[0].values) > 1):
        raise InputError(f"{len(linear)} frames are for lights in succession before a monochrome camera")
    rows, columns = linear[0].values.shape[-2:]
    if min(rows, columns) < SMALLEST_FRAME:
        raise InputError(
            f"an inspection needs at least {SMALLEST_FRAME} x {SMALLEST_FRAME} px; the frame has {columns} x {rows}"
        )


def _check_light(channels: list[Channel], inside: BoolArray) -> None:
    samples = [channel.values[inside & np.isfinite(channel.values)] for channel in channels]
    if not all(one.size for one in samples):
        raise InputError("the region holds no sample of some channel: it must be larger than a cell of the pattern")
    if all(channel.saturated[inside].sum() == one.size for channel, one in zip(channels, samples, strict=True)):
        raise InputError("every sample of the region is saturated: there is nothing to inspect")
    if all(float(np.ptp(one)) == 0 for one in samples):
        raise InputError("every channel of the region is constant: there is nothing to inspect")


def _rectangle(region: Sequence[float] | None, shape: tuple[int, ...]) -> Sequence[float]:
    return (0, 0, shape[1] - 1, shape[0] - 1) if region is None else region


def _contrast_window(channels: tuple[ChannelFacts, ...]) -> float:
    """Standard deviation (px) of a window that holds many speckles."""
    sizes = [one.speckle_px for one in channels if np.isfinite(one.speckle_px)]
    return float(np.clip(2.5 * np.median(sizes) if sizes else 0.0, *CONTRAST_WIDTH))


def _local_contrast(images: IlluminationImages, window: float) -> FloatImage:
    """Local standard deviation over the local mean (k, H, W); 0 where a light is dark or unknown."""
    out = np.zeros_like(images.values)
    for image, target in zip(images.values, out, strict=True):
        mean, square = local_mean(image, window), local_mean(image**2, window)
        lit = np.isfinite(image) & (mean > 0.01 * images.full_scale)
        target[lit] = np.sqrt(np.maximum(square[lit] - mean[lit] ** 2, 0)) / mean[lit]
    return out


def _hidden(contrast: FloatImage, inside: BoolArray) -> BoolArray:
    best = contrast.max(axis=0)
    return np.asarray(best < BLIND * np.quantile(best[inside], 0.9))


def _light_facts(
    images: IlluminationImages,
    contrast: FloatImage,
    index: FloatImage | None,
    alone: list[FloatArray],
    inside: BoolArray,
) -> tuple[LightFacts, ...]:
    facts = []
    for j, light in enumerate(images.names):
        values, valid = images.values[j][inside], images.valid[j][inside]
        mean = local_mean(images.values[j], CONTRAST_WIDTH[0])[inside]
        facts.append(
            LightFacts(
                name=light,
                mean=float(values[valid].mean() / images.full_scale) if valid.any() else float("nan"),
                contrast=float(np.median(contrast[j][inside])),
                reflecting=None if index is None else float((index[j][inside] > REFLECTING).mean()),
                valid=float(valid.mean()),
                negative=float((mean < -0.002 * images.full_scale).mean()),
                alone=Spread.of(alone[j]),
            )
        )
    return tuple(facts)


def _greens(mosaic: LinearMosaic) -> float:
    """Difference of the two greens' means over their mean."""
    red = int(np.flatnonzero(np.array(list(mosaic.cfa)) == "R")[0])
    diagonal = red in (0, 3)
    places = ((0, 1), (1, 0)) if diagonal else ((0, 0), (1, 1))
    first, second = (float(mosaic.values[p::2, q::2].mean()) for p, q in places)
    return abs(first - second) / max((first + second) / 2, 1e-6)
