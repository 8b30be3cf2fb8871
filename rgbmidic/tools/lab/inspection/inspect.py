"""Inspection of one frame before a test: figures of its samples and lights in a region, uncertainty to expect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rgbmidic.arguments import checked
from rgbmidic.errors import ConfigurationError, FrameError, InputError, printable
from rgbmidic.frames import open_series, open_source
from rgbmidic.frames.data import ChannelFrame, Mosaic, Window, sampled_channels
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.contrast import CONTRAST, LocalContrast
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.demosaicing import SMALLEST_FRAME
from rgbmidic.illumination.images import REFLECTING, IlluminationImages, local_mean
from rgbmidic.illumination.linear import LinearMosaic, NoiseModel, linearise
from rgbmidic.illumination.plane_samples import Frame
from rgbmidic.illumination.texture import COLOURED, TextureModel
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.frame_quality import clipping, repetition, separation_doubts
from rgbmidic.pipeline.plan import place_mesh, read_region
from rgbmidic.settings import ELEMENT_SIZE, FrameSettings, TestSettings
from rgbmidic.tools.lab.inspection.channels import (
    Channel,
    estimate_noise,
    frame_channels,
    roi_window,
    speckle_texture,
)
from rgbmidic.tools.lab.inspection.lamps import LampBalance
from rgbmidic.tools.lab.inspection.prediction import Prediction, predict, separate_with_errors
from rgbmidic.tools.lab.inspection.results import ChannelSummary, Inspection, LightSummary, Spread
from rgbmidic.tools.preparation.frame_check import check_state
from rgbmidic.typing import BoolArray, FloatArray, FloatImage, ProgressCallback


def inspect_files(
    files: Sequence[Path | str] = (),
    *,
    test: TestSettings | None = None,
    calibration: Path | str | None = None,
    frame: FrameSettings | None = None,
    region: Sequence[float] | None = None,
    **options: Any,
) -> Inspection:
    """Inspect one frame on disk, or the frames of one state of lights fired in succession.

    Parameters
    ----------
    files
        One file, or one per light; none: the first frame of the test's reference.
    test
        Settings of a test; its sections state how the frame is read, separated and measured.
    calibration
        Calibration file; instead of the test's.
    frame
        What the file does not state (its `path` is not used); instead of the test's.
    region
        (x0, y0, x1, y1) in px; instead of the test's, else the whole frame.
    **options
        As in `inspect_frame`; those that are stated and not None replace the test's.

    Returns
    -------
    Inspection

    Raises
    ------
    RgbmidicError
        A file is missing, damaged or contradicts what is stated; the frame cannot be inspected.
    """
    user_metadata = frame or (test.frames if test else FrameSettings(path=("frame",)))
    calibrated = calibration or (test.calibration.file if test else None)
    read_calibration = None if calibrated is None else Calibration.read(calibrated)
    if files:
        paths = [Path(file) for file in files]
        frames = tuple(open_source(path, user_metadata, read_calibration).read(0) for path in paths)
        name, file_names = " + ".join(printable(path.name) for path in paths), " + ".join(map(str, paths))
    elif test is not None:
        series, index = open_series(user_metadata, test.base, read_calibration), user_metadata.reference[0]
        frames = series.read(index)
        name = file_names = series.name(index)
    else:
        raise InputError("there is nothing to inspect: neither a frame nor a test is given")
    shape = frames[0].values.shape[-2], frames[0].values.shape[-1]
    read_calibration = read_calibration and read_calibration.cropped(user_metadata.crop_origin, shape)
    roi = Region.from_rectangle(region, shape) if region is not None else None
    inspection_options: dict[str, Any] = {"name": name}
    if test is not None:
        inspection_options |= {"element_size": test.mesh.side, "accept": test.calibration.accept}
        inspection_options |= {"demosaic": test.illumination.demosaic, "prefilter": test.solver.prefilter}
        if roi is None and test.mesh.file is None:
            roi = read_region(test.region, shape)
        elif roi is None:
            mesh, roi, _ = place_mesh(test, shape)
            inspection_options["element_size"] = mesh.size
    inspection_options |= {key: value for key, value in options.items() if value is not None}
    try:
        return inspect_frame(frames, calibration=read_calibration, region=roi, **inspection_options)
    except InputError as error:
        raise FrameError(f"{file_names}: {error}") from None


@checked
def inspect_frame(
    frame: Frame | Sequence[Frame],
    *,
    calibration: Calibration | None = None,
    region: Region | Sequence[float] | None = None,
    element_size: float = ELEMENT_SIZE,
    demosaic: str = "auto",
    prefilter: Literal["none", "binomial", "gaussian"] = "binomial",
    name: str = "frame",
    seed: int = 0,
    accept: Sequence[str] = (),
    progress: ProgressCallback | None = None,
) -> Inspection:
    """Inspect one frame before a test: exposure, lights, reflections, speckle, noise, expected uncertainty.

    The uncertainty is predicted in closed form (`rgbmidic.tools.lab.inspection.prediction`) from the speckle, the
    contrast of the lights and the separation errors of such a frame.

    Parameters
    ----------
    frame
        A raw frame, or for lights fired in succession one monochrome frame per light.
    calibration
        Crosstalk, noise and registration as far as they are known. Without crosstalk the channels are used as lights;
        unknown noise is estimated from the frame.
    region
        The region to be measured; None: the whole frame. Only the region and its surroundings are inspected.
    element_size
        Side of the elements in px.
    demosaic, prefilter
        As in TEST.toml.
    name
        Name of the frame in reports.
    seed
        Seed of the random numbers of the prediction.
    accept
        Checks against the calibration whose failure is accepted, by name (`FrameCheck`).
    progress
        Called with the number of steps done, their total and the next step.

    Returns
    -------
    Inspection

    Raises
    ------
    InputError
        The frame is too small, saturated everywhere in the region, or of another kind than the calibration.
    FrameError
        The frame contradicts the calibration.
    CalibrationError
        The calibration varies over frames of another size.
    RegionError
        The region is empty, outside the frame or too small for one element.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> from rgbmidic import inspect_frame
    >>> from rgbmidic.frames import ChannelFrame
    >>> speckle = gaussian_filter(np.random.default_rng(0).normal(size=(1, 64, 64)), (0, 2, 2))
    >>> levels = np.round(2000 + 2000 * speckle)
    >>> frame = ChannelFrame(values=levels, black_level=np.zeros(1), white_level=4095.0)
    >>> inspection = inspect_frame(frame)
    >>> inspection.kind, inspection.channels[0].mean > 0.3, inspection.unmeasured_fraction
    ('monochrome', True, 0.0)
    """
    frames = tuple(frame) if isinstance(frame, Sequence) else (frame,)
    shape = _require_shape(frames)
    cropped_calibration = (calibration or Calibration()).cropped(None, shape)
    if not isinstance(region, Region):
        region = Region.from_rectangle((0, 0, shape[1] - 1, shape[0] - 1) if region is None else region, shape)
    report = progress or (lambda done, total, line: None)
    contradictions = check_state(frames, cropped_calibration, region.mask, name, accept=accept)
    mesh, window = Tri3Mesh.from_region(region, element_size), roi_window(region)
    roi_slices = window.slices_in(Window.of_frame(shape))
    region, cropped_calibration = region.crop(*roi_slices), cropped_calibration.cropped(window.origin, window.shape)
    cropped_frames = [replace(shot, values=np.ascontiguousarray(shot.values[..., *roi_slices])) for shot in frames]
    if clipped := clipping(frames):
        cropped_frames = [replace(shot, white_level=clipped[0]) for shot in cropped_frames]
    linear = [linearise(shot, cropped_calibration.noise) for shot in cropped_frames]
    report(0, 3, "exposure, speckle and noise")
    channels = frame_channels(linear)
    summaries, noise, speckle = _summarise(channels, region.mask, cropped_calibration.noise, linear[0].full_scale)
    report(1, 3, "lights, and the errors of their separation")
    state, draw = separate_with_errors(linear, cropped_calibration, demosaic, noise)
    state = replace(state, registration=cropped_calibration.registration)
    images = state.on_first_light()
    report(2, 3, "uncertainty to expect")
    contrasts = LocalContrast.of(images, [channel.speckle_px for channel in summaries], region.mask, noise)
    index = state.reflection_index()
    if index is None and len(images.names) > 1:  # the contrast that a light lacks to the best one
        best = np.maximum(contrasts.contrast.max(axis=0), 1e-6)
        index = np.asarray(1 - contrasts.contrast / best, dtype=np.float32)
    texture, local = state.texture or speckle, replace(mesh, nodes=mesh.nodes - window.origin)

    def expected(strength: FloatArray) -> Prediction:
        """Predict the uncertainty with the lights so many times as strong."""
        lights = replace(contrasts, level=contrasts.level * strength[:, None, None].astype(np.float32))
        errors = draw(np.random.default_rng(seed), strength)
        return predict(local, region, lights, errors, texture=texture, prefilter=prefilter)

    prediction = expected(np.ones(len(images.names)))
    doubts = separation_doubts(state, region)
    coloured = texture is not None and texture.specific >= COLOURED  # of one light more than of another
    if (
        cropped_calibration.crosstalk is not None
        and len(cropped_calibration.crosstalk.matrix) == len(channels)
        and not coloured
    ):
        balance = LampBalance.of(contrasts, channels, cropped_calibration.crosstalk.matrix, region.mask)
        doubts += balance.advice(
            images.names, prediction, expected, noise_calibrated=cropped_calibration.noise is not None
        )
    report(3, 3, "done")
    first, greens = linear[0], 0.0
    single = not isinstance(first, LinearMosaic) and len(first.values) == 1
    if isinstance(first, LinearMosaic):
        greens = _unexpected_green_difference(first, state, cropped_calibration.crosstalk)
    return Inspection(
        name=name,
        kind="bayer" if isinstance(first, LinearMosaic) else "monochrome" if single else "rgb",
        channels=summaries,
        lights=_light_summaries(images, contrasts.contrast, index, prediction, region.mask),
        frame_shape=shape,
        origin=window.origin,
        images=images,
        reflection_index=index,
        saturated=np.logical_or.reduce([channel.saturated for channel in channels]),
        region=region.mask,
        lacks_contrast=contrasts.low_contrast(region.mask),
        background=contrasts.background(region.mask),
        texture=state.texture,
        noise=noise,
        noise_known=cropped_calibration.noise is not None,
        contradictions=contradictions,
        crosstalk_known=single or cropped_calibration.crosstalk is not None,
        element_size=element_size,
        mesh=mesh,
        prediction=prediction,
        greens=greens,
        clipping="" if clipped is None else clipped[1],
        doubts=tuple(doubts),
        repetition=repetition(images, region, None if speckle is None else speckle.diameter) or "",
    )


def _unexpected_green_difference(
    mosaic: LinearMosaic, lights: IlluminationImages, crosstalk: Crosstalk | None
) -> float:
    """Return the difference of the means of the greens beyond the calibrated one, over their mean."""
    channel = sampled_channels(mosaic.cfa, mosaic.values.shape)
    with_red = int((channel[1] == 0).any())  # row
    red, blue = (float(mosaic.values[row::2][channel[row::2] == 1].mean()) for row in (with_red, 1 - with_red))
    expected = 0.0
    if crosstalk is not None and crosstalk.green_difference is not None:
        expected = float(crosstalk.green_difference @ np.nanmean(lights.values, axis=(1, 2)))
    return abs(red - blue - expected) / max((red + blue) / 2, 1e-6)


def state_frames(test: TestSettings | None, *, count: int = 1, **stated: Any) -> FrameSettings:
    """Return the test's frame settings, or none, with what else is stated (`FrameSettings`; None: not stated).

    Parameters
    ----------
    test
        Settings of a test; None: nothing but what is stated.
    count
        Number of files that are inspected.
    **stated
        Properties of the frames, by the names of the fields of `FrameSettings`.

    Returns
    -------
    FrameSettings

    Raises
    ------
    ConfigurationError
        Something stated is not allowed or not what the test states, or several frames that are not monochrome.
    """
    properties = {key: value for key, value in stated.items() if value is not None}
    if test is not None:
        combined = replace(test.frames, **properties)
        for key in properties:
            if (test_value := getattr(test.frames, key)) not in (None, new_value := getattr(combined, key)):
                raise ConfigurationError(
                    f"frames.{key} is {test_value} in TEST.toml, but the option states {new_value}"
                )
        return combined
    return FrameSettings(path=("frame",) * (count if properties.get("kind") == "monochrome" else 1), **properties)


def _require_shape(frames: Sequence[Frame]) -> tuple[int, int]:
    """Return the rows and columns of frames that can be inspected."""
    if not (frames and all(isinstance(frame, Mosaic | ChannelFrame) for frame in frames)):
        raise InputError(f"an inspection needs a frame, or one of each light in succession, not {frames!r:.80}")
    first, shapes = frames[0], {frame.values.shape for frame in frames}
    if len(shapes) > 1:
        raise InputError(f"frames of lights in succession must have one shape; given are {sorted(shapes)}")
    if len(frames) > 1 and (isinstance(first, Mosaic) or len(first.values) > 1):
        raise InputError(f"{len(frames)} frames are for lights in succession before a monochrome camera")
    rows, columns = first.values.shape[-2:]
    if min(rows, columns) < SMALLEST_FRAME:
        raise InputError(
            f"an inspection needs at least {SMALLEST_FRAME} x {SMALLEST_FRAME} px; the frame has {columns} x {rows}"
        )
    return rows, columns


def _summarise(
    channels: list[Channel], inside: BoolArray, calibrated: NoiseModel | None, full_scale: float
) -> tuple[tuple[ChannelSummary, ...], NoiseModel, TextureModel | None]:
    """Figures of the channels' samples inside the region, the camera noise, and the autocorrelation of the speckle.

    Raises
    ------
    InputError
        A channel without a sample in the region; all samples saturated, or every channel constant.
    """
    samples = [channel.values[inside & np.isfinite(channel.values)] for channel in channels]
    saturated = [int(channel.saturated[inside].sum()) for channel in channels]
    if not all(values.size for values in samples):
        raise InputError("the region holds no sample of some channel: it must be larger than a cell of the pattern")
    if saturated == [values.size for values in samples]:
        raise InputError("every sample of the region is saturated: there is nothing to inspect")
    if all(float(np.ptp(values)) == 0 for values in samples):
        raise InputError("every channel of the region is constant: there is nothing to inspect")
    textures = [speckle_texture(channel, inside, calibrated) for channel in channels]
    estimates = estimate_noise(channels, inside) if calibrated is None else []
    finite = [estimate for estimate in estimates if np.isfinite(estimate)]
    typical = float(np.sqrt(np.mean(np.square(finite)))) if finite else 0.0
    noise = calibrated or NoiseModel(gain=float("inf"), read_noise=typical)
    summaries = []
    for number, (channel, texture) in enumerate(zip(channels, textures, strict=True)):
        values = samples[number] / full_scale
        level = float(values.mean())
        low, high = np.quantile(values, [0.05, 0.95]).tolist()
        std = estimates[number] if estimates else float(noise.variance(np.array(level * full_scale))) ** 0.5
        clipped, size = saturated[number] / values.size, float("nan") if texture is None else texture.diameter
        summaries.append(ChannelSummary(channel.name, level, low, high, clipped, size, std))
    sharpest = sorted((texture for texture in textures if texture), key=lambda texture: texture.diameter)
    return tuple(summaries), noise, sharpest[len(sharpest) // 2] if sharpest else None


def _light_summaries(
    images: IlluminationImages,
    contrast: FloatImage,
    index: FloatImage | None,
    prediction: Prediction,
    inside: BoolArray,
) -> tuple[LightSummary, ...]:
    """Return figures of each light in the region, from its contrast, its reflection index and its uncertainty alone."""
    summaries = []
    for j, light in enumerate(images.names):
        values, valid = images.values[j][inside], images.valid[j][inside]
        mean = local_mean(images.values[j], CONTRAST.contrast_widths[0])[inside]
        summaries.append(
            LightSummary(
                name=light,
                mean=float(values[valid].mean() / images.full_scale) if valid.any() else float("nan"),
                contrast=float(np.median(contrast[j][inside])),
                reflecting=None if index is None else float((index[j][inside] > REFLECTING).mean()),
                valid=float(valid.mean()),
                negative=float((mean < -0.002 * images.full_scale).mean()),
                std_alone=Spread.of(prediction.single_light[j]),
            )
        )
    return tuple(summaries)
