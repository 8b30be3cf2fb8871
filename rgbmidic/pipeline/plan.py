"""What all frames of a test share, made once before the first is measured.

calibration -> series of frames -> reference frames -> one image per light, averaged -> region and mesh -> weights ->
reference of the solve.

Why a state cannot be measured: no texture, no light, too much, wrong levels, speckle too coarse for the elements.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, combinations
from threading import Lock
from typing import Any

import numpy as np

from rgbmidic.correlation import PrecisionMethod, Reference
from rgbmidic.correlation.reference_update import ReferenceUpdate
from rgbmidic.correlation.start import search_reach
from rgbmidic.errors import ConfigurationError, FrameError
from rgbmidic.fields import CameraCalibration
from rgbmidic.frames import Window, open_series
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.frame_check import check_state
from rgbmidic.illumination.images import DARK, IlluminationImages, correlated, local_mean
from rgbmidic.illumination.linear import QUANTISATION
from rgbmidic.illumination.separation import (
    LightSeparation,
    RawState,
    Separation,
    WindowedSeparation,
    light_images,
    reference_images,
)
from rgbmidic.illumination.texture import speckle_diameter
from rgbmidic.mesh import FiniteElementMesh, Placement, Region, Tri3Mesh
from rgbmidic.pipeline.region import finite_elements_of, read_region, region_and_window, window_around
from rgbmidic.pipeline.source import FrameSequence, Series, open_sequence
from rgbmidic.settings import SolverSettings, TestSettings, grey_levels
from rgbmidic.typing import AnyArray, BoolArray, FloatArray, FloatImage
from rgbmidic.weights import LightWeights, as_weights, precision_method, prepare_weights
from rgbmidic.weights.threshold import ThresholdWeights, blurred

logger = logging.getLogger(__name__)

_LOOKED_AT = 256
"""Largest side (px) of the part of the region in which the speckle is measured: a thousand speckles of 8 px."""
_KEPT_UPDATES = 2
"""Updated references that a process keeps: frames measured side by side follow this one or the last."""


class Turns:
    """A lock that lets one thread in at a time; a copy sent to another process has one of its own."""

    def __init__(self) -> None:
        self._lock = Lock()

    def __reduce__(self) -> tuple[type[Turns], tuple[()]]:
        return type(self), ()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class UpdatedReferences(Turns):
    """The references that frames of one test have become lately, made once for all threads of a process.

    A copy sent to another process begins empty.
    """

    def __init__(self) -> None:
        super().__init__()
        self._kept: deque[tuple[tuple[int, ...], ReferenceUpdate]] = deque(maxlen=_KEPT_UPDATES)

    def get(self, frames: tuple[int, ...], make: Callable[[], ReferenceUpdate]) -> ReferenceUpdate:
        """The reference that the `frames` make in turn: a kept one, else what `make` gives."""
        with self:
            for known, reference_update in self._kept:
                if known == frames:
                    return reference_update
            self._kept.append((frames, make()))
            return self._kept[-1][1]


SPECKLES = 3.0
"""Least number of speckles on the side of an element (iDICs Good Practices Guide, for subsets)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """Element size that the frames of a test recommend (`rgbmidic.pipeline.resolution`), and why, in a sentence."""

    element_size: float
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What all frames of a test share; it can be pickled, so that any process can measure any frame.

    Attributes
    ----------
    settings
        What TEST.toml says.
    normalise, solver
        Width of the local mean (px) and settings of the solve that hold for the mesh (`grey_levels`).
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
    saturated
        Fraction of the reference's samples in the region that are saturated.
    element_size
        Side of the elements, px.
    window
        Part of the reference frames that is read; all positions (region, mesh, images) count from where it begins.
    finite_elements, placement
        The mesh of ``mesh.file``, the part that is measured, and where it lies in the frame; None: there is no file.
    choice
        Why the elements have their size, where ``mesh.element_size`` is ``"auto"``; else None.
    refinement
        In which frame and how far the mesh was refined (``mesh.refine``), in a sentence; else None.
    calibration
        Figures of the calibration, for the provenance (`Calibration.figures`).
    timings
        Whether to tell the time that each stage of a frame takes.
    updates
        References that later frames have become.
    reading
        Frames are read by one thread at a time: a movie has one place at which it is read.
    """

    settings: TestSettings
    normalise: float
    solver: SolverSettings
    series: Series
    separation: LightSeparation
    region: Region
    weights: LightWeights
    images: IlluminationImages
    reference: Reference
    speckle: float | None
    saturated: float
    window: Window
    element_size: float
    finite_elements: FiniteElementMesh | None = None
    placement: Placement | None = None
    choice: Choice | None = None
    refinement: str | None = None
    calibration: dict[str, Any] = field(default_factory=dict)
    timings: bool = False
    updates: UpdatedReferences = field(default_factory=UpdatedReferences, repr=False, compare=False)
    reading: Turns = field(default_factory=Turns, repr=False, compare=False)

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

        Objects take the place of what the settings name; with any of them frames are read whole.

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
        _check_given(settings, source, separation, weights, mesh)
        whole_calibration = None if settings.calibration_file is None else Calibration.read(settings.calibration_file)
        series, calibration = _series_and_calibration(settings, source, whole_calibration)
        separate = separation or Separation(calibration=calibration, demosaic=settings.illumination.demosaic)
        whole = any(one is not None for one in (source, weights, mesh, region))
        finite_elements, placement = None, None
        if settings.mesh_file is not None:
            finite_elements, placement, mesh, region = finite_elements_of(settings, series.shape)
        if whole or not isinstance(separate, WindowedSeparation):
            region, window = region or read_region(settings.region, series.shape), Window.whole(series.shape)
        else:
            region, window = region_and_window(settings, region, series.shape)
            if mesh is not None:
                mesh = Tri3Mesh(nodes=mesh.nodes - window.origin, elements=mesh.elements)
        rest = _Rest.read(settings, series, separate, window, region, calibration)
        if separation is not None and isinstance(rest.states[0], IlluminationImages):
            raise ConfigurationError("the source gives images of the lights, which need no separation: give only one")
        size = settings.side if mesh is None else mesh.size
        if mesh is None:
            mesh = Tri3Mesh.from_region(region, size, [np.subtract(path, window.origin) for path in settings.cracks])
        cracked = len(mesh.crack_edges) > 0
        sigma, solver = grey_levels(settings.illumination.normalise, settings.solver, cracked=cracked)
        weights = weights or prepare_weights(
            settings,
            rest.images,
            region,
            shape=window.frame,
            frames=len(series),
            images_of=lambda index: light_images(rest.separation, series.read(index, window), window),
        )
        reference = _reference(rest.images, weights, region, mesh, sigma, solver, window)
        if isinstance(weights, ThresholdWeights):
            _tell_no_effect(weights, rest.images, region)
        speckle = _speckle(rest.images, region)
        if finite_elements is not None:
            _tell_small(mesh, speckle, finite_elements)
        elif small := too_small(size, speckle, HARDLY_ENOUGH):
            logger.warning("%s", small)
        rest.check_seen(reference, region)
        return cls(
            settings=settings,
            normalise=sigma,
            solver=solver,
            series=series,
            separation=rest.separation,
            region=region,
            weights=weights,
            images=rest.images,
            reference=reference,
            speckle=speckle,
            saturated=saturated_fraction(rest.states[0], region.mask),
            window=window,
            element_size=size,
            finite_elements=finite_elements,
            placement=placement,
            calibration=whole_calibration.figures() if whole_calibration else {},
        )

    @property
    def method(self) -> PrecisionMethod | None:
        """How the lights are weighted by their residuals; None: by `weights` only."""
        return precision_method(self.weights, self.settings.weights.method)

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
        reference = _reference(self.images, self.weights, self.region, mesh, self.normalise, self.solver, self.window)
        return replace(self, reference=reference)

    def lights(self, state: RawState, window: Window) -> IlluminationImages:
        """One image per light of a state, or of a `window` of it.

        Parameters
        ----------
        state
            Raw frames of the state.
        window
            The part of it that is wanted.

        Returns
        -------
        IlluminationImages
        """
        return light_images(self.separation, state, window)

    def prepared(self, images: IlluminationImages, index: int) -> tuple[FloatImage, FloatImage]:
        """What the solve takes of the images of frame `index`: grey levels and weights, (k, H, W) each.

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
        return correlated(images, self.normalise), weights

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
        places = [nodes, *(nodes + moved for moved in displacements if moved is not None)]
        return window_around(np.concatenate(places), search_reach(nodes), self.settings, self.window.frame)


def _reference(
    images: IlluminationImages,
    weights: LightWeights,
    region: Region,
    mesh: Tri3Mesh,
    sigma: float,
    solver: SolverSettings,
    window: Window,
) -> Reference:
    """The reference state as the solve needs it."""
    return Reference.prepare(
        correlated(images, sigma),
        region,
        as_weights(weights.reference(images), images.values.shape, "weights of the reference"),
        mesh=mesh,
        prefilter=solver.prefilter,
        origin=window.origin,
        registration=images.registration,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rest:
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
    ) -> _Rest:
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
        if shifted := _shifted(samples := frame.values[..., region.mask], frame.white_level):
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
    if share > SATURATED:
        logger.warning("%.0f %% of the samples in the region of the reference (%s) are saturated", 100 * share, names)
    if calibration is None or not raw:
        return
    if not window.is_whole:
        calibration = calibration.cropped(window.origin, window.shape)
    repeat = raw[1] if len(raw) > 1 else None
    for found in check_state(raw[0], calibration, region.mask, names, accept=settings.accept, repeat=repeat):
        if not found.certain:
            logger.warning("%s may not be what %s calibrates: %s", names, settings.calibration_file, found.text)


def light_levels(images: IlluminationImages, region: Region) -> dict[str, float]:
    """Median grey level of each light in the region, as a fraction of the full scale; 0 where nothing is usable."""
    known = (light[np.isfinite(light)] for light in images.values[:, region.mask])
    medians = (float(np.median(light)) / images.full_scale if light.size else 0.0 for light in known)
    return dict(zip(images.names, medians, strict=True))


def _check_given(
    settings: TestSettings,
    source: FrameSequence | None,
    separation: LightSeparation | None,
    weights: LightWeights | None,
    mesh: Tri3Mesh | None,
) -> None:
    """Refuse an object that contradicts what the settings name."""
    if source is not None and settings.frames.path:
        raise ConfigurationError(
            f"frames.path names {', '.join(settings.frames.path)}, and a frame source is given: leave the path empty "
            "(path = [])"
        )
    if source is not None and settings.frames.lights > 1:
        raise ConfigurationError("frames.lights is for files; a frame source gives all lights of a state by one index")
    if weights is not None and settings.weights.method not in ("statistics", "none"):
        raise ConfigurationError(
            f'weights.method = "{settings.weights.method}", and weights are given: state "statistics", with which both '
            'count, or "none"'
        )
    if mesh is not None and settings.mesh_file is not None:
        raise ConfigurationError(f"mesh.file names {settings.mesh_file}, and a mesh is given: leave one of them out")
    if mesh is not None and settings.cracks:
        raise ConfigurationError("mesh.cracks splits a mesh that is made here; the mesh that is given has its own")
    if settings.element_size == "auto":
        raise ConfigurationError(
            'mesh.element_size = "auto" is found on the frames of a test by rgbmidic.measure, for a mesh that is made '
            "there: state a number"
        )
    if settings.mesh_refine is not False:
        raise ConfigurationError(
            "mesh.refine is done on the frames of a test by rgbmidic.measure, for a mesh made there: leave it out"
        )
    kind = settings.frames.kind
    if kind in ("bayer", "rgb") and separation is None and settings.calibration_file is None:
        raise ConfigurationError(
            f'frames.kind = "{kind}" needs the lights\' crosstalk: state calibration.file, a file that '
            "rgbmidic-calibrate writes"
        )


def _series_and_calibration(
    settings: TestSettings, source: FrameSequence | None, calibration: Calibration | None
) -> tuple[Series, Calibration | None]:
    """The frames, of the settings or a `source`, and the calibration cropped to them."""
    series: Series
    if source is None:
        series = open_series(settings.frames, settings.base, calibration)
    else:
        series = open_sequence(source, settings.frames, calibration)
    if settings.scale.camera is not None:
        CameraCalibration.read(settings.scale.camera).check(series.shape)
    return series, calibration and calibration.cropped(settings.frames.crop_origin, series.shape)


def _tell_small(mesh: Tri3Mesh, speckle: float | None, finite_elements: FiniteElementMesh) -> None:
    """Warn of finite elements that are small for the speckle, with the uncertainty to expect.

    It goes with the inverse of the element's side (`rgbmidic.scene.forecast.node_constant`).
    """
    sides = np.sqrt(2 * mesh.areas)
    small = np.zeros(sides.size, dtype=bool) if speckle is None else sides < SPECKLES * speckle
    if speckle is None or not small.any():
        return
    least = int(np.argmin(sides))
    typical = float(np.median(sides[small]))
    logger.warning(
        "%s: %d of %d triangles have sides under %g speckles of %.1f px, %.1f px in the median (element %d: %.1f px): "
        "expect %.1f times (%.1f times) the uncertainty of elements of %g speckles; with fewer than %g nodes are lost",
        finite_elements.name,
        int(small.sum()),
        sides.size,
        SPECKLES,
        speckle,
        typical,
        finite_elements.element_numbers[least],
        sides[least],
        SPECKLES * speckle / typical,
        SPECKLES * speckle / sides[least],
        SPECKLES,
        _ENOUGH,
    )


def _tell_no_effect(weights: ThresholdWeights, images: IlluminationImages, region: Region) -> None:
    """Warn of a threshold that excludes nothing in the region of the reference."""
    inside = region.mask
    if (weights.reference(images) > 0)[:, inside].sum() == images.valid[:, inside].sum():
        logger.warning(
            "weights.threshold = %.3g excludes nothing in the reference: no light, blurred over %g px, exceeds %.2g of "
            'the dynamic range in the region. State a lower one, or weights.method = "statistics"',
            weights.threshold,
            weights.blur,
            blurred(images, weights.blur)[:, inside].max() / images.full_scale,
        )


def _speckle(images: IlluminationImages, region: Region) -> float | None:
    """Size of the speckle (px), the median over the lights that are on, in the middle of the region; None: unknown."""
    part = [
        slice(max(int(np.median(inside)) - _LOOKED_AT // 2, int(inside[0])), int(inside[-1]) + 1)
        for inside in (np.flatnonzero(region.mask.any(axis=axis)) for axis in (1, 0))
    ]
    levels = light_levels(images, region).values()
    lit = [level >= DARK for level in levels] if max(levels) >= DARK else [True] * len(images.names)
    pictures = [values[part[0], part[1]][:_LOOKED_AT, :_LOOKED_AT] for values in images.values[lit]]
    known = [np.where(np.isfinite(one), one, np.nanmean(one)) for one in pictures if np.isfinite(one).any()]
    sizes = [size for one in known if (size := speckle_diameter(one.astype(np.float64))) is not None]
    return float(np.median(sizes)) if sizes else None


NO_TEXTURE = 0.05
"""Correlation of neighbouring samples under which nothing can be measured: with speckle of 2 to 5 px no element matched
at a contrast of .3 times the noise, where it is .02 to .05 (tests/truth/test_texture_check.py)."""
FAINT_TEXTURE = 0.2
"""Correlation under which the result is poor: in the same simulation displacements were wrong by .2 to .7 px (rms) at a
contrast of .5 to .7 times the noise, where it is .08 to .23. Speckle in focus has .5 to .95."""
HARDLY_ENOUGH, _ENOUGH = 1.3, 2.0
"""Speckles on the side of an element. Of 150 pairs of simulated images (speckle of 2.6 to 8.4 px and +-600 DN, noise of
8, 40 and 80 DN, .4 % strain) 13 of the 46 with fewer than 1.3 did not converge, some with most of their nodes lost, 1
of the 36 with 1.3 to 1.85, and none of the 68 with more, which lost 2 % of the nodes at most."""
_MEAN_WIDTH = 5.0
"""Standard deviation, in samples, of the local mean that is taken off: shading is no texture."""


def check_texture(state: RawState, inside: BoolArray, name: str) -> None:
    """Refuse a reference without texture, and warn of one with little.

    Parameters
    ----------
    state
        Raw frames of the reference.
    inside : ndarray, shape (H, W)
        The region.
    name
        Name of the reference in messages.

    Raises
    ------
    FrameError
        No frame shows anything in the region that noise would not.
    """
    shown = [
        neighbour_correlation(frame, inside) for frame in ([state] if isinstance(state, IlluminationImages) else state)
    ]
    told = f"neighbouring samples of the reference ({name}) correlate by {min(shown):.2f} in the region"
    if max(shown) < NO_TEXTURE:
        raise FrameError(
            f"{told}, where noise gives 0 and speckle .4 or more: there is no texture above the noise to measure with"
        )
    if min(shown) < FAINT_TEXTURE:
        logger.warning("%s, where speckle gives .4 or more: its contrast is hardly above the noise", told)


def neighbour_correlation(frame: Mosaic | ChannelFrame | IlluminationImages, inside: BoolArray) -> float:
    """Correlation of neighbouring raw samples less their local mean: 0 for camera noise, towards 1 for texture.

    The noise of a raw sample is its own, so what neighbours have in common is texture. Neighbours are samples of one
    channel or of two, whichever agree better: lights may show different textures, and a mosaic samples a channel only
    at every other pixel. Variance below that of rounding to grey levels counts as noise. Noise of separated lights may
    have been smoothed: what is certain of raw frames is less so there.
    """
    planes = _planes(frame, inside)
    rounding = float(np.finfo(np.float32).tiny) if isinstance(frame, IlluminationImages) else QUANTISATION
    energy = [max(float((plane**2).sum()), rounding * plane.size) for plane in planes]
    own = sum(float((p[:, 1:] * p[:, :-1]).sum() + (p[1:] * p[:-1]).sum()) / 2 for p in planes) / sum(energy)
    pairs = list(combinations(range(len(planes)), 2))
    total = sum(float(np.sqrt(energy[a] * energy[b])) for a, b in pairs)
    return max(own, sum(float((planes[a] * planes[b]).sum()) for a, b in pairs) / total if pairs else 0.0)


def _planes(frame: Mosaic | ChannelFrame | IlluminationImages, inside: BoolArray) -> list[FloatArray]:
    """Samples of each channel on their own lattice, less their local mean; 0 outside and where saturated."""
    step = 2 if isinstance(frame, Mosaic) else 1
    seen = frame.valid if isinstance(frame, IlluminationImages) else frame.values < frame.white_level
    usable = inside & seen
    known = np.where(usable, frame.values, np.nan).astype(np.float32).reshape(-1, *inside.shape)
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    # a cell of a mosaic is any 2 x 2 samples, wherever the region begins
    height, width = (int(index[-1] + 1 - index[0]) // step * step for index in (rows, columns))
    window = known[:, rows[0] : rows[0] + height, columns[0] : columns[0] + width]
    planes = [channel[p::step, q::step] for channel in window for p in range(step) for q in range(step)]
    return [np.nan_to_num(plane - local_mean(plane, _MEAN_WIDTH)).astype(np.float64) for plane in planes]


def exposure_fault(state: RawState, inside: BoolArray) -> str | None:
    """What is wrong with the exposure or the stated levels of raw frames in a region (H, W); None: nothing evident."""
    if isinstance(state, IlluminationImages):  # no samples of a camera
        return None
    faults = [_fault(frame, inside) for frame in state]
    told = [f"light {i + 1}: {fault}" if len(state) > 1 else fault for i, fault in enumerate(faults) if fault]
    return "; ".join(told) or None


SATURATED = 0.1
"""Fraction of the samples in the region that are saturated, beyond that of the reference, from which a frame is
over-exposed. Chosen: reflections saturate a few per cent; three times the exposure saturates a fifth and more."""
_ABOVE = 2.0
"""Samples this many times the white level have a bit more than it: it is not the camera's, or deliberately low."""


_BLIND = 0.98
"""Fraction from which the lights are not separated: with .985 they still were, with .99 no texture was left to learn
from in two of three frames (measured)."""


def saturated_fraction(state: RawState, inside: BoolArray) -> float:
    """Fraction of the raw samples in a region (H, W) that are saturated; 0 for images of the lights."""
    if isinstance(state, IlluminationImages):
        return 0.0
    return float(np.mean([(frame.values[..., inside] >= frame.white_level).mean() for frame in state]))


def _shifted(samples: AnyArray, white: float) -> str | None:
    """What is wrong with samples of which the lowest bits are all 0, and the `white` level not that of the others."""
    bits, largest = int(np.bitwise_or.reduce(samples, axis=None)), int(samples.max())
    step = bits & -bits  # all samples are multiples of it
    if not (step > 2 and largest > white and white * step <= 65536):
        return None
    return (
        f"the samples reach {largest} and are all multiples of {step}, as of a camera whose levels lie in the high "
        f"bits; white_level is {white:g}: should it be {65536 - step}?"
    )


def _fault(frame: Mosaic | ChannelFrame, inside: BoolArray) -> str | None:
    samples, white, black = frame.values[..., inside], frame.white_level, float(frame.black_level.mean())
    if shifted := _shifted(samples, white):
        return shifted
    largest = int(samples.max())
    over, dark = (samples >= white).mean(), (samples < black + DARK * (white - black)).mean()
    if over > 0.5:
        above = f"; the largest is {largest}" if largest > white else ""
        return f"{over:.0%} of the samples in the region are saturated (white_level {white:g}{above})"
    if dark > 0.5:
        return (
            f"{dark:.0%} of the samples in the region are dark: within {DARK:.0%} of the dynamic range from the black "
            f"level {black:g}; the largest is {largest}, white_level is {white:g}"
        )
    return None


def too_small(element_size: float, speckle: float | None, least: float = _ENOUGH) -> str:
    """What is wrong with elements (px) that have fewer than `least` speckles (px) on a side, in words; else nothing."""
    if speckle is None or element_size >= least * speckle:
        return ""
    return (
        f"elements of {element_size:g} px are too small for speckles of {speckle:.1f} px: with fewer than {least:g} "
        "speckles on a side nodes are lost and frames may not converge; set mesh.element_size to "
        f"{np.ceil(_ENOUGH * speckle):.0f} or more"
    )
