"""The main job: raw frames in, displacement fields out.

raw frame -> linearise -> demosaic and unmix -> one image per light -> weights -> one MIDIC solve -> displacement with
its uncertainty, frame after frame, each kept as it finishes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rgbmidic.correlation import Deformed, Reference, Start, Status, track
from rgbmidic.correlation.light_levels import brightness_change
from rgbmidic.errors import FrameError, RegionError, RgbmidicError
from rgbmidic.fields import fill
from rgbmidic.frames import FrameSeries, open_series, read_frame
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.normalise import normalise
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.separator import Separator, average
from rgbmidic.results import FrameRecord, Result, ResultStore
from rgbmidic.settings import RegionSettings, TestSettings, WeightSettings
from rgbmidic.typing import FloatArray, FloatImage
from rgbmidic.weights.threshold import light_weights

if TYPE_CHECKING:
    from rgbmidic.weights.geometry import GeometryWeights

__all__ = ["Weigher", "measure", "read_region", "texture"]

logger = logging.getLogger(__name__)

Progress = Callable[[int, int, str], None]

_THUMBNAIL = 256
"""Longest side in px of the picture of the weights that is kept of every frame."""


def measure(
    settings: TestSettings, out: Path | str, *, overwrite: bool = False, progress: Progress | None = None
) -> Result:
    """Measure a test: displacement of every frame against the reference.

    Parameters
    ----------
    settings
        What `rgbmidic.settings.read_test` reads from TEST.toml.
    out
        Result folder; nothing is written to it before settings, calibration, region and reference are found good.
    overwrite
        Replace a result that is already there.
    progress
        Called after every frame with the number of frames done, their total and a line about the last one.

    Returns
    -------
    Result
        A frame that cannot be read or measured is kept as failed with its reason; the others go on.

    Raises
    ------
    RgbmidicError
        The settings, the calibration, the region or the reference frames are not usable.
    """
    test = _Prepared.from_settings(settings)
    frames, mesh = test.frames, test.reference.mesh
    store = ResultStore.create(
        out,
        nodes=mesh.nodes,
        elements=mesh.elements,
        names=[frames.name(index) for index in range(len(frames))],
        lights=test.images.names,
        settings=settings,
        reference=test.images.values,
        notes=test.weigher.notes,
        overwrite=overwrite,
    )
    last = Start(displacement=None)
    for index in range(len(frames)):
        record, last = test.measure(index, last)
        store.write_frame(index, record)
        if progress is not None:
            progress(index + 1, len(frames), _line(frames.name(index), record))
    store.finish()
    return Result.open(out)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Prepared:
    """A test with everything that its frames share.

    Attributes
    ----------
    images
        Illumination images of the reference state, in grey levels.
    reference
        What the solve correlates with.
    """

    settings: TestSettings
    frames: FrameSeries
    separator: Separator
    weigher: Weigher
    images: IlluminationImages
    reference: Reference

    @classmethod
    def from_settings(cls, settings: TestSettings) -> _Prepared:
        """Read calibration, reference frames and region."""
        separator = Separator.from_settings(settings)
        frames = open_series(settings.frames, settings.base, separator.calibration)
        states = [frames.read(index) for index in settings.frames.reference]
        separator = separator.with_texture_of(states[0])
        images = average([separator(state) for state in states])
        region = read_region(settings.region, images.shape)
        mesh = Tri3Mesh.from_region(region, settings.element_size)
        weigher = Weigher.prepare(settings, images, region, frames, separator)
        reference = Reference.prepare(
            texture(images, settings),
            region,
            weigher.reference(images),
            mesh=mesh,
            prefilter=settings.solver.prefilter,
        )
        if not reference.pixel_weights.any():
            names = ", ".join(frames.name(index) for index in settings.frames.reference)
            raise FrameError(
                f"no light sees the region in the reference ({names}): it is saturated, dark or excluded by the weights"
            )
        return cls(
            settings=settings, frames=frames, separator=separator, weigher=weigher, images=images, reference=reference
        )

    def measure(self, index: int, last: Start) -> tuple[FrameRecord, Start]:
        """Record of one frame, and from where the next one starts."""
        settings, frames, reference = self.settings, self.frames, self.reference
        nodes, lights = len(reference.mesh.nodes), len(reference.images)
        try:
            images = self.separator(frames.read(index))
            if images.values.shape != reference.images.shape:
                raise FrameError(
                    f"{frames.name(index)} has the shape {images.values.shape}, the reference {reference.images.shape}"
                )
            weights = self.weigher.deformed(images, index)
            deformed = Deformed.prepare(texture(images, settings), weights, prefilter=reference.prefilter)
            start = Start(displacement=np.zeros((nodes, 2))) if settings.frames.reference == (index,) else last
            statistics = settings.weights.method == "statistics"
            solution = track(reference, deformed, start, settings.solver, statistics=statistics)
            kept = fill(reference.mesh, solution, settings.solver.fill) if settings.solver.fill else solution
            inputs = frames.inputs(index)
        except RgbmidicError as error:
            logger.warning("frame %d (%s) failed: %s", index, frames.name(index), error)
            return FrameRecord.failed(str(error), nodes=nodes, lights=lights), last
        if solution.status is Status.FAILED:
            logger.warning("frame %d (%s) cannot be measured: %s", index, frames.name(index), solution.reason)
        brightness = brightness_change(self.images.values, images.values, reference, solution.displacement)
        _tell_dark(frames.name(index), images.names, brightness)
        record = FrameRecord.from_solution(
            kept,
            brightness=brightness,
            weights_thumbnail=_thumbnail(weights),
            reflection_thumbnail=None if images.reflection_index is None else _thumbnail(images.reflection_index),
            inputs=inputs,
        )
        return record, last.after(solution)


_DARK = 0.3
"""Share of its light in the reference under which a light is told to be failing."""


def _tell_dark(name: str, lights: tuple[str, ...], brightness: FloatArray) -> None:
    for light, gain in zip(lights, brightness[:, 0], strict=True):
        if gain < _DARK:
            logger.warning("%s: %s gives %.0f %% of its light in the reference", name, light, 100 * gain)


@dataclass(frozen=True, slots=True, kw_only=True)
class Weigher:
    """The lights' weights in every state, by the method of the settings.

    Attributes
    ----------
    settings
        With a threshold that is a number.
    reference_frames
        Indices of the reference frames.
    predicted
        Weights from geometry, or None.
    notes
        What was found out about the weights, for the provenance.
    """

    settings: WeightSettings
    reference_frames: tuple[int, ...]
    predicted: GeometryWeights | None = None
    notes: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def prepare(
        cls,
        settings: TestSettings,
        images: IlluminationImages,
        region: Region,
        frames: FrameSeries,
        separator: Separator,
    ) -> Weigher:
        """Read the scene that the settings name, or find the automatic threshold, if either is asked for."""
        weights, notes, predicted = settings.weights, {}, None
        if weights.method == "geometry":
            from rgbmidic.weights.geometry import GeometryWeights

            predicted = GeometryWeights.prepare(settings, lights=images.names, shape=images.shape, frames=len(frames))
        elif weights.method == "threshold" and weights.threshold == "auto":
            notes["weights_threshold"] = _find_threshold(settings, images, region, frames, separator)
            weights = replace(weights, threshold=notes["weights_threshold"])
        return cls(settings=weights, reference_frames=settings.frames.reference, predicted=predicted, notes=notes)

    def reference(self, images: IlluminationImages) -> FloatImage:
        """Weights (k, H, W) of the reference images."""
        weights = light_weights(images, self.settings)
        return weights if self.predicted is None else weights * self.predicted.reference(self.reference_frames)

    def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
        """Weights (k, H, W) of the images of frame `index`."""
        weights = light_weights(images, self.settings)
        return weights if self.predicted is None else weights * self.predicted.frame(index, self.reference_frames[0])


def _find_threshold(
    settings: TestSettings,
    images: IlluminationImages,
    region: Region,
    frames: FrameSeries,
    separator: Separator,
) -> float:
    """The automatic threshold from the first deformed frame, else the paper's; says which."""
    from rgbmidic.weights.automatic import FALLBACK, automatic_threshold

    index = next((i for i in range(len(frames)) if i not in settings.frames.reference), None)
    if index is None:
        logger.warning('weights.threshold = "auto": there is no deformed frame; %.3g is taken', FALLBACK)
        return FALLBACK
    try:
        found = automatic_threshold(
            images,
            separator(frames.read(index)),
            region,
            blur=settings.weights.blur,
            element_size=settings.element_size,
            prefilter=settings.solver.prefilter,
        )
    except RgbmidicError as error:
        logger.warning('weights.threshold = "auto": %s cannot be used: %s', frames.name(index), error)
        found = None
    if found is None:
        logger.warning(
            'weights.threshold = "auto": no disturbed zone in %s; the threshold is %.3g of the dynamic range',
            frames.name(index),
            FALLBACK,
        )
        return FALLBACK
    logger.info(
        "threshold %.3f: disturbed zone of radius %.0f px around %s in %s",
        found.value,
        found.zone.radius,
        found.zone.centre,
        frames.name(index),
    )
    return found.value


def texture(images: IlluminationImages, settings: TestSettings) -> FloatImage:
    """What the solve correlates (k, H, W): the illumination images, locally normalised unless the settings say no."""
    sigma = settings.illumination.normalise
    return normalise(images.values, sigma, images.full_scale) if sigma else images.values


def read_region(settings: RegionSettings, shape: tuple[int, int]) -> Region:
    """The region of interest of the settings on images of `shape` (H, W).

    Raises
    ------
    RegionError
        The region is empty, outside the image, or the mask image has another size.
    """
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


def _thumbnail(weights: FloatImage) -> npt.NDArray[np.uint8]:
    step = -(-max(weights.shape[1:]) // _THUMBNAIL)
    return np.round(weights[:, ::step, ::step] * 255).astype(np.uint8)


def _line(name: str, record: FrameRecord) -> str:
    status = Status(record.status)
    if status is Status.CONVERGED:
        measured = float((record.node_status == 0).mean())
        return f"{name}: converged in {record.iterations} iterations, {measured:.0%} of the nodes measured"
    return f"{name}: {status.name.lower().replace('_', ' ')}: {record.reason}"
