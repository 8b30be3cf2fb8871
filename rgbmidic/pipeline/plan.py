"""What all frames of a test share, made once before the first is measured.

calibration -> series of frames -> reference frames, checked -> one image per light, averaged -> region and mesh ->
weights -> reference of the solve.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from threading import Lock
from typing import Any

import numpy as np

from rgbmidic.correlation import PrecisionMethod, Reference
from rgbmidic.correlation.reference_update import ReferenceUpdate
from rgbmidic.correlation.start import search_reach
from rgbmidic.errors import ConfigurationError, FrameError, RegionError
from rgbmidic.extensions import MESH_SOURCES, PREPARATIONS, load_extension
from rgbmidic.fields import CameraCalibration
from rgbmidic.frames import Window, read_mask
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.contrast import CONTRAST
from rgbmidic.illumination.images import DARK, IlluminationImages, without_dark_pixels
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.illumination.separation import (
    LightSeparation,
    RawState,
    Separation,
    WindowedSeparation,
    light_images,
    reference_images,
)
from rgbmidic.mesh import MeshLabels, Region, Tri3Mesh
from rgbmidic.pipeline import frame_quality
from rgbmidic.pipeline.lamps import LampLight
from rgbmidic.pipeline.user_objects import FrameSequence, Series, check_user_objects, open_frames
from rgbmidic.results.quantities import MESH_DOCUMENT
from rgbmidic.settings import RegionSettings, SolverSettings, TestSettings
from rgbmidic.typing import FloatArray, FloatImage
from rgbmidic.weights import LightWeights, as_weights, precision_method, prepare_weights
from rgbmidic.weights.threshold import ThresholdWeights, blurred

logger = logging.getLogger(__name__)

STRIDE = 16
"""Frames from one key frame to the next: so many workers are kept busy by one chain of key frames."""
_WORTH = 0.5
"""Share of the frame from which all of it is read: what a window saves would be less than half."""


class ProcessState:
    """The threads of one process share this state; a copy that is sent to another process has its own.

    Attributes
    ----------
    reading
        Frames are read by one thread at a time: a movie has one place at which it is read.
    """

    def __init__(self, capacity: int = 2) -> None:
        """`capacity` updated references stay: frames measured side by side follow this one or the last."""
        self.reading, self._updating = Lock(), Lock()
        self._updates: deque[tuple[tuple[int, ...], ReferenceUpdate]] = deque(maxlen=capacity)

    def __reduce__(self) -> tuple[type[ProcessState], tuple[()]]:
        return type(self), ()

    def reference_update(self, frames: tuple[int, ...], make: Callable[[], ReferenceUpdate]) -> ReferenceUpdate:
        """The reference that the `frames` make in turn: a kept one, else what `make` gives, once for all threads."""
        with self._updating:
            for update_frames, reference_update in self._updates:
                if update_frames == frames:
                    return reference_update
            self._updates.append((frames, make()))
            return self._updates[-1][1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """All frames of a test share a plan; it can be pickled, so that any process can measure any frame.

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
    method
        What weighs the lights by their residuals; None: they are weighted by `weights` only.
    images
        Images of the reference state, in grey levels.
    reference
        The reference state as the solve needs it, with the mesh.
    speckle
        Size of the speckle in the reference's region, px; None where it is not known.
    saturated
        Fraction of the reference's samples in the region that are saturated.
    clipped_at
        Level below their white level at which samples of the reference pile up, DN; None: they do not.
    reference_motion
        Largest shift of the reference frames against the first of them, px.
    exposure
        Exposure time of the frames, s; 0 where it is not known.
    element_size
        Side of the elements, px.
    window
        Part of the reference frames that is read; all positions (region, mesh, images) count from where it begins.
    labels
        Of the nodes and elements of the mesh of ``mesh.file``; None: there is no file.
    notes
        For the provenance: figures of the calibration (`Calibration.figures`), why the elements have their size where
        ``mesh.element_size`` is ``"auto"``, in which frame and how far the mesh was refined (``mesh.refine``).
    timings
        Whether to tell the time that each stage of a frame takes.
    process
        What the threads of a process share.
    lamps
        What the light of the lamps is compared with.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> speckle = 1000 + 3000 * gaussian_filter(np.random.default_rng(0).normal(size=(2, 80, 80)), (0, 1.5, 1.5))
    >>> frames, region = {"path": [], "kind": "monochrome"}, {"rectangle": [0, 0, 79, 79]}
    >>> settings = TestSettings.from_mapping({"frames": frames, "region": region})
    >>> plan = Plan.from_settings(settings, source=speckle)
    >>> plan.images.shape, plan.reference.mesh.nodes.shape[1]
    ((80, 80), 2)
    """

    settings: TestSettings
    series: Series
    separation: LightSeparation
    region: Region
    weights: LightWeights
    method: PrecisionMethod | None
    images: IlluminationImages
    reference: Reference
    speckle: float | None
    saturated: float
    clipped_at: float | None
    reference_motion: float
    exposure: float
    window: Window
    element_size: float
    labels: MeshLabels | None = None
    notes: Mapping[str, Any] = field(default_factory=dict)
    timings: bool = False
    process: ProcessState = field(default_factory=ProcessState, repr=False, compare=False)
    lamps: LampLight = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Take what the lamps of the frames are compared with."""
        object.__setattr__(self, "lamps", LampLight.of(self.images.values, self.reference))

    @classmethod
    def from_settings(
        cls,
        settings: TestSettings,
        *,
        source: FrameSequence | None = None,
        separation: LightSeparation | None = None,
        weights: LightWeights | None = None,
        mesh: Tri3Mesh | None = None,
        region: Region | None = None,
    ) -> Plan:
        """Read all that the settings name, except the deformed frames.

        Objects take the place of what the settings name; with a source, weights, or a mesh without its region, frames
        are read whole.

        Parameters
        ----------
        settings
            What TEST.toml says.
        source
            The frames; `frames.path` of the settings is then empty.
        separation
            From a raw frame to one image per light.
        weights
            How much each light counts; ``weights.method`` is then ``"statistics"`` (both count) or ``"none"``.
        mesh
            In px of the frame.
        region
            What is measured, in px of the frame.

        Returns
        -------
        Plan

        Raises
        ------
        RgbmidicError
            The settings, the calibration, the region or the reference frames are not usable, or an object contradicts
            the settings.
        """
        check_user_objects(settings, source, separation, weights, mesh)
        camera = None if settings.calibration.file is None else Calibration.read(settings.calibration.file)
        series = open_frames(settings, source, camera)
        frame = series.shape
        calibration = camera and camera.cropped(settings.frames.crop_origin, frame)
        if settings.scale.camera is not None:
            plane = CameraCalibration.read(settings.scale.camera)
            plane.check(frame)
            plane.check_light(None if calibration is None else calibration.registration)
        separate = separation or Separation(calibration=calibration, demosaic=settings.illumination.demosaic)
        has_objects = source is not None or weights is not None or (mesh is not None and region is None)
        labels = None
        if settings.mesh.file is not None:
            mesh, region, labels = place_mesh(settings, frame)
        if region is not None and region.mask.shape != frame:
            height, width = region.mask.shape
            raise RegionError(
                f"the region is of frames of {width} x {height} px, the test's have {frame[1]} x {frame[0]}"
            )
        region, window = region or read_region(settings.region, frame), Window.of_frame(frame)
        if not has_objects and isinstance(separate, WindowedSeparation):
            window = window_of_reference(region, settings, frame)
            region = region.crop(*window.slices_in(Window.of_frame(frame)))
        state, images, separate, motion = _read_reference(settings, series, separate, window, region, calibration)
        if separation is not None and isinstance(state, IlluminationImages):
            raise ConfigurationError("the source gives images of the lights, which need no separation: give only one")
        if mesh is not None:
            mesh = Tri3Mesh(nodes=mesh.nodes - window.origin, elements=mesh.elements)
            size = mesh.size
        else:
            size = settings.mesh.side
            cracks = [np.subtract(path, window.origin) for path in settings.mesh.cracks]
            mesh = Tri3Mesh.from_region(region, size, cracks)
        if weights is None and (settings.weights.method, settings.weights.threshold) == ("threshold", "auto"):
            weights = load_extension(PREPARATIONS, "weights.threshold", "weights.threshold")(
                settings,
                images,
                region,
                frames=len(series),
                images_of=lambda index: light_images(separate, series.read(index, window), window),
            )
        weights = weights or prepare_weights(settings, lights=images.names, shape=frame, frames=len(series))
        plan = cls(
            settings=settings,
            series=series,
            separation=separate,
            region=region,
            weights=weights,
            method=precision_method(weights, settings.weights.method),
            images=images,
            reference=_reference(images, weights, region, mesh, settings.solver),
            speckle=frame_quality.speckle_size(images, region),
            saturated=frame_quality.saturated_fraction(state, region.mask),
            clipped_at=None if (clipping := frame_quality.clipping(state)) is None else clipping[0],
            reference_motion=motion,
            exposure=1e-9 * (series.recording.exposure_ns or 0),
            window=window,
            element_size=size,
            labels=labels,
            notes={"calibration_figures": camera.figures() if camera else {}},
        )
        _check_reference(plan, state, calibration.noise if calibration else None)
        return plan

    def on_mesh(self, mesh: Tri3Mesh) -> Plan:
        """The same test on another mesh of its region, in px of the window.

        Parameters
        ----------
        mesh
            The other mesh.

        Returns
        -------
        Plan
        """
        reference = _reference(self.images, self.weights, self.region, mesh, self.settings.solver)
        return replace(self, reference=reference)

    def prepared(self, images: IlluminationImages, index: int) -> tuple[FloatImage, FloatImage]:
        """Prepare the images of frame `index` for the solve: grey levels and weights, (k, H, W) each.

        Parameters
        ----------
        images
            One image a light.
        index
            Index of the frame.

        Returns
        -------
        values, weights : ndarray, shape (k, H, W), float32

        Raises
        ------
        InputError
            Weights of the user's have another shape, or are negative or not finite.
        """
        weights = as_weights(self.weights.deformed(images, index), images.values.shape, f"weights of frame {index}")
        assert weights is not None
        return images.values, without_dark_pixels(images, weights)

    def window_of(self, *displacements: FloatArray | None) -> Window:
        """Part of a frame that is read to find its displacement from rest and from nodal `displacements` (N, 2).

        It holds what a search looks at, what the separation of that depends on, and the reference's window.

        Parameters
        ----------
        *displacements : ndarray, shape (N, 2), or None
            Nodal displacements in px that the frame may have.

        Returns
        -------
        Window
        """
        if self.window.is_whole:
            return self.window
        nodes = self.reference.mesh.nodes + self.window.origin
        positions = [nodes, *(nodes + displacement for displacement in displacements if displacement is not None)]
        return window_around(np.concatenate(positions), search_reach(nodes), self.settings, self.window.frame)


def _reference(
    images: IlluminationImages, weights: LightWeights, region: Region, mesh: Tri3Mesh, solver: SolverSettings
) -> Reference:
    """The reference state as the solve needs it."""
    counted = as_weights(weights.reference(images), images.values.shape, "weights of the reference")
    assert counted is not None
    return Reference.prepare(
        images.values,
        region,
        without_dark_pixels(images, counted),
        mesh=mesh,
        prefilter=solver.prefilter,
        brightness=solver.brightness,
        origin=images.origin,
        registration=images.registration,
    )


def _read_reference(
    settings: TestSettings,
    series: Series,
    separation: LightSeparation,
    window: Window,
    region: Region,
    calibration: Calibration | None,
) -> tuple[RawState, IlluminationImages, LightSeparation, float]:
    """First state of the reference, mean images of its frames, the separation learnt from them, their motion (px).

    Raw frames that contradict the stated levels or their calibration are refused; doubts are warned of.
    """
    indices, name = settings.frames.reference, ", ".join(map(series.name, settings.frames.reference))
    motion = frame_quality.ReferenceMotion(region.mask)
    states = list(motion.watch(series.read(index, window) for index in indices[:2]))
    raw = [state for state in states if not isinstance(state, IlluminationImages)]
    for frame in raw[0] if raw else ():
        if shifted := frame_quality.shifted_levels(samples := frame.values[..., region.mask], frame.white_level):
            raise FrameError(f"the reference ({name}): {shifted}")
        # twice as much has a bit more than the level: it is not the camera's, or deliberately low
        if (largest := samples.max()) > 2 * frame.white_level:
            logger.warning(
                f"the samples of the reference ({name}) reach {largest}, far above white_level {frame.white_level:g}: "
                "is it that of the camera, and is the order of the bytes (frames.dtype) right?"
            )
    saturated = frame_quality.saturated_fraction(states[0], region.mask)
    # with .985 lights were still separated, with .99 no texture was left in two of three frames (measured)
    if saturated > 0.98:
        fault = frame_quality.exposure_fault(states[0], region.mask)
        raise FrameError(f"no light sees the region in the reference ({name}): {fault}")
    if saturated > frame_quality.SUITABILITY.clipped:
        text = f"{100 * saturated:.2g} % of the samples in the region of the reference ({name}) are saturated"
        logger.warning("%s and will not be measured", text)
    if calibration is not None and raw:
        window_calibration = calibration if window.is_whole else calibration.cropped(window.origin, window.shape)
        # a camera that shakes adds to the difference of two frames: it is not the noise that is calibrated
        repeat = raw[1] if len(raw) > 1 and motion.largest < frame_quality.SUITABILITY.shake else None
        check_state = load_extension(PREPARATIONS, "calibration.accept", "calibration.file")
        for check in check_state(
            raw[0], window_calibration, region.mask, name, accept=settings.calibration.accept, repeat=repeat
        ):
            if check.passed:
                logger.warning("%s may not be what %s calibrates: %s", name, settings.calibration.file, check.text)
    remaining_states = motion.watch(series.read(index, window) for index in indices[2:])
    images, adapted_separation = reference_images(separation, chain(states, remaining_states), window)
    return states[0], images, adapted_separation, motion.largest


def _check_reference(plan: Plan, state: RawState, noise: NoiseModel | None) -> None:
    """Refuse a reference that no light sees or that shows no texture; warn of what will be measured badly."""
    weights, images, region = plan.weights, plan.images, plan.region
    inside, name = region.mask, ", ".join(map(plan.series.name, plan.settings.frames.reference))
    if isinstance(weights, ThresholdWeights) and (
        (weights.reference(images) > 0)[:, inside].sum() == images.valid[:, inside].sum()
    ):
        max_level = blurred(images, weights.blur)[:, inside].max() / images.full_scale
        logger.warning(
            f"weights.threshold = {weights.threshold:.3g} excludes nothing in the reference: no light, blurred over "
            f"{weights.blur:g} px, exceeds {max_level:.2g} of the dynamic range in the region. State a lower one, or "
            'weights.method = "statistics"'
        )
    if plan.labels is not None:
        frame_quality.warn_small_elements(plan.reference.mesh, plan.speckle, plan.labels)
    elif small := frame_quality.too_small(plan.element_size, plan.speckle, frame_quality.SUITABILITY.hardly_enough):
        logger.warning("%s", small)
    if not plan.reference.pixel_weights.any():
        fault = frame_quality.exposure_fault(state, inside) or "it is saturated, dark or excluded by the weights"
        raise FrameError(f"no light sees the region in the reference ({name}): {fault}")
    frame_quality.check_texture(state, inside, name)
    if plan.reference_motion > frame_quality.SUITABILITY.motion:
        logger.warning("%s", frame_quality.unsteady(plan.reference_motion))
    if clipping := frame_quality.clipping(state):
        logger.warning("the reference (%s): %s", name, clipping[1])
    if repeated := frame_quality.repetition(images, region, plan.speckle):
        logger.warning("the reference (%s): %s", name, repeated)
    for doubt in frame_quality.separation_doubts(images, region):
        logger.warning("the reference (%s): %s", name, doubt.text)
    dark = frame_quality.background_fraction(images, region, plan.speckle, noise)
    if dark > CONTRAST.max_hidden_fraction:
        logger.warning(f"the region holds dark background ({dark:.1%}) in the reference: draw it inside the specimen")
    levels = frame_quality.light_levels(images, region).items()
    off = [f"{light} ({level:.1%})" for light, level in levels if level < DARK]
    if off and not isinstance(state, IlluminationImages):
        logger.warning(
            f"the reference ({name}) shows no light of {', '.join(off)}: the median in the region is under "
            f"{100 * DARK:.0f} % of the full scale; are the lamps on?"
        )


def place_mesh(settings: TestSettings, frame: tuple[int, int]) -> tuple[Tri3Mesh, Region, MeshLabels]:
    """Return the mesh of ``mesh.file`` in px of frames of this shape, the pixels that it covers, and its labels."""
    camera = None if settings.scale.camera is None else CameraCalibration.read(settings.scale.camera)
    source = load_extension(MESH_SOURCES, MESH_DOCUMENT, "mesh.file")
    return source.place(settings.mesh, read_region(settings.region, frame), camera)


def window_of_reference(region: Region, settings: TestSettings, frame: tuple[int, int]) -> Window:
    """The part of the reference frames that is read for a region of them."""
    spans = [np.flatnonzero(region.mask.any(axis=axis)) for axis in (0, 1)]
    corners = np.array([[span[0], span[-1]] for span in spans], dtype=np.float64).T
    window = window_around(corners, search_reach(corners), settings, frame)
    return Window.of_frame(frame) if np.prod(window.shape) > _WORTH * np.prod(frame) else window


def window_around(points: FloatArray, reach: float, settings: TestSettings, frame: tuple[int, int]) -> Window:
    """Return the window within `reach` of points (N, 2), and what its images depend on.

    The separation's local statistics use 96 px around: three standard deviations of their windows with all that is
    between (`rgbmidic.tools.lab.inspection.channels.InspectionConstants`).
    """
    return Window.around_points(points, reach + max(96.0, 3 * settings.weights.blur), frame)


def read_region(settings: RegionSettings, shape: tuple[int, int]) -> Region:
    """The region of interest of the settings on images of `shape` (H, W); all of them where none is stated.

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
    FrameError
        The mask image cannot be read.
    """
    if settings.rectangle is not None:
        outlined = Region.from_rectangle(settings.rectangle, shape)
    elif settings.polygon is not None:
        outlined = Region.from_polygon(settings.polygon, shape)
    elif settings.mask is None:
        outlined = Region.from_mask(np.ones(shape, dtype=bool))
    else:
        mask = read_mask(settings.mask)
        inside = mask >= 0.5
        if (excluded := np.count_nonzero(~inside & (mask > 0))) > 0.25 * np.count_nonzero(inside):
            # soft edges and JPEG files have 7 to 15 %
            logger.warning(
                f"region.mask {settings.mask}: {excluded} pixels under half of the largest value are not measured, "
                f"{np.count_nonzero(inside)} are: draw in one colour what is to be measured"
            )
        try:
            outlined = Region.from_mask(inside, shape)
        except RegionError as error:
            raise RegionError(f"region.mask {settings.mask}: {error}") from None
    return outlined.without(settings.holes)
