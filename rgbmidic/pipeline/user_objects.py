"""Objects that a script gives in place of what TEST.toml names: what they must be, and what a result keeps of them.

Frames come from any object that has a length and a frame by index, read as a series of files is. `FrameSequence` is the
protocol; a numpy stack, an HDF5 dataset, a camera maker's library and the series of files that
`rgbmidic.frames.open_series` makes are implementations of it. `SourceSeries` is what the pipeline reads it through,
unless it can itself what a series of files can.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import UnionType
from typing import Any, ClassVar, Protocol, cast

import numpy as np

from rgbmidic.errors import ConfigurationError, FrameError, InputError, RgbmidicError
from rgbmidic.frames.data import ChannelFrame, Mosaic, Recording, Window
from rgbmidic.frames.metadata import CameraMetadata, StoredFrame, raw_frame
from rgbmidic.frames.series import FrameSeries, open_series, selected_frames
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.separation import LightSeparation, RawState
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.settings import FrameSettings, TestSettings
from rgbmidic.typing import unmasked
from rgbmidic.weights import LightWeights

logger = logging.getLogger(__name__)


class FrameSequence(Protocol):
    """Frames by index, from 0: a numpy stack (T, H, W), an HDF5 dataset, a camera maker's library.

    It may also have

    - ``names``: what messages and results call each frame, one text a frame;
    - ``times_ns``: when each frame was taken, whole ns, one a frame;
    - ``lights``: names of the lights, where its frames are arrays of light images;
    - ``describe()``: a text that says what is measured; another text is another test, which `resume` refuses. Without
      it the class, the number of frames and the content of the first and the last frame say it.

    It is read by one thread at a time. A Dask cluster sends it to other processes: it must then be picklable, and one
    that holds an open file opens it where it is used.

    Examples
    --------
    >>> stack: FrameSequence = np.zeros((3, 40, 60))
    >>> len(stack), stack[0].shape
    (3, (40, 60))
    """

    def __len__(self) -> int:
        """Number of frames."""

    def __getitem__(self, index: int, /) -> Any:
        """One state.

        Returns
        -------
        ndarray of whole numbers, shape (H, W) or (C, H, W)
            A raw frame, of which ``[frames]`` says kind, pattern and levels as for files.
        Mosaic or ChannelFrame, or a tuple of one per light fired in succession
            A raw frame that says so itself.
        IlluminationImages, or ndarray of floats, shape (H, W) or (k, H, W)
            One image per light, which needs no separation; NaN where not valid.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceSeries:
    """A `FrameSequence` as the pipeline reads it; frames are read whole.

    Attributes
    ----------
    source
        The frames.
    user_metadata
        What ``[frames]`` says of them.
    camera
        What a calibration knows of them.
    selected
        The frames that are to be measured.
    n_lost
        A source has all the frames that it counts.
    shape
        Rows and columns, of the reference's first frame.
    full_scale
        Grey level of a just saturated sample where the frames are arrays of light images: the stated levels', else the
        largest grey level of the first frame of the reference.
    """

    source: FrameSequence
    user_metadata: FrameSettings
    camera: CameraMetadata | None = field(default=None, compare=False, repr=False)
    selected: range = range(0)
    n_lost: ClassVar[int] = 0
    shape: tuple[int, int] = (0, 0)
    full_scale: float = 1.0

    def __len__(self) -> int:
        """Number of states."""
        return len(self.source)

    @property
    def numbers(self) -> Sequence[int]:
        """The frames are numbered through."""
        return range(len(self))

    @property
    def recording(self) -> Recording:
        """Return when the frames were taken, where the source knows it."""
        times = getattr(self.source, "times_ns", None)
        return Recording(count=len(self), times_ns=None if times is None else np.asarray(times, dtype=np.int64))

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return what a user should know of the times."""
        return tuple(f"{class_name(self.source)}: {remark}" for remark in self.recording.remarks)

    def read(self, index: int, window: Window | None = None) -> RawState:
        """State `index`: raw frames, or one image per light.

        Raises
        ------
        FrameError
            The source raises an error, gives something that is no frame, or contradicts ``[frames]``.
        """
        try:
            state = self.source[index]
        except RgbmidicError:
            raise
        except Exception as error:  # of whatever library it is
            message = f"{type(error).__name__}: {error}"
            raise FrameError(f"{self.name(index)} cannot be read from {class_name(self.source)}: {message}") from error
        return self._state(state, self.name(index))

    def missing_lights(self) -> str:
        """A source that is there stays there."""
        return ""

    def name(self, index: int) -> str:
        """Return what the source calls the frame, else its number."""
        names = getattr(self.source, "names", None)
        return f"frame {index}" if names is None else str(names[index])

    def time_ns(self, index: int) -> int | None:
        """Return when the frame was taken, where the source knows it."""
        times = self.recording.times_ns
        return None if times is None else int(times[index])

    def inputs(self, index: int, window: Window | None = None) -> dict[str, str]:
        """No file is known."""
        return {}

    def fingerprint(self, unread: Collection[str] = ()) -> tuple[str, tuple[str, ...]]:
        """Return what `describe` gives for the source.

        Without a description of its own, the content of the first frame of the reference and of the last frame chosen
        belongs to it.
        """
        if hasattr(self.source, "describe"):
            return describe(self.source), ()
        description, without = f"{class_name(self.source)} of {len(self)} frames", []
        for index in (self.user_metadata.reference[0], self.selected[-1]):
            name, content = self.name(index), "unread"
            if name not in unread:
                with suppress(FrameError):
                    state = self.read(index)
                    frames = [state] if isinstance(state, IlluminationImages) else state
                    content = hashlib.sha256(b"".join(frame.values.tobytes() for frame in frames)).hexdigest()[:16]
            if content == "unread":
                without.append(name)
            description += f", {content}"
        return description, tuple(without)

    def _state(self, state: Any, name: str) -> RawState:
        """Convert a state of the source to raw frames or images of the lights; refuse anything else."""
        if isinstance(state, IlluminationImages):
            return state
        states = tuple(state) if isinstance(state, tuple | list) else (state,)
        if states and all(isinstance(frame, Mosaic | ChannelFrame) for frame in states):
            return states
        values, label = unmasked(state), f"{name} of {class_name(self.source)}"
        kind = values.dtype.kind
        if kind == "f" and np.asarray(state).dtype.kind in "ui":
            raise FrameError(
                f"{label} has masked samples, which a raw frame cannot have: give it saturated there, or images of the "
                "lights as floats"
            )
        if kind not in "uif" or values.ndim not in (2, 3) or not values.size:
            raise FrameError(
                f"{label} is {values.dtype} of shape {values.shape}; allowed are whole numbers (H, W) or (C, H, W), "
                "floats (H, W) or (k, H, W), Mosaic, ChannelFrame and IlluminationImages"
            )
        values = values.reshape(-1, *values.shape[-2:])
        if kind != "f":
            if values.dtype not in (np.uint8, np.uint16) and (values.min() < 0 or values.max() > 65535):
                raise FrameError(f"{label} has grey levels outside 0 to 65535")
            samples = values if values.dtype == np.uint8 else values.astype(np.uint16, copy=False)
            channels_last = np.ascontiguousarray(np.moveaxis(samples, 0, -1))
            return (
                raw_frame(
                    StoredFrame.from_samples(channels_last, Path(name)), self.user_metadata, Path(name), self.camera
                ),
            )
        raw_settings = {
            "frames.kind": self.user_metadata.kind,
            "frames.cfa": self.user_metadata.cfa,
            "calibration.file": self.camera,
        }
        of_raw = [key for key, value in raw_settings.items() if value not in (None, "monochrome")]
        if of_raw:
            raise ConfigurationError(
                f"{label} is {values.dtype}: arrays of floats are images of the lights, and {' and '.join(of_raw)} "
                f"{'is' if len(of_raw) == 1 else 'are'} stated, of raw frames: give whole numbers, which are raw "
                "frames, or leave that out"
            )
        lights = getattr(self.source, "lights", None) or [f"light {light + 1}" for light in range(len(values))]
        valid = np.isfinite(values)
        return IlluminationImages(values=values, valid=valid, names=tuple(lights), full_scale=self.full_scale)


Series = FrameSeries | SourceSeries
"""What the pipeline reads frames from: a series of files, a source as `SourceSeries`, or a source that can all this
itself, such as read parts of frames."""


def open_frames(settings: TestSettings, source: FrameSequence | Series | None, camera: CameraMetadata | None) -> Series:
    """The series that the pipeline reads: of files, or of a source, checked on the first frame of the reference.

    Raises
    ------
    InputError
        The source has no length or no frame by index, or its names or times are not one a frame.
    FrameError
        A reference frame, or the first or last frame, does not exist or cannot be read.
    """
    series = _opened(settings, source, camera)
    for remark in series.remarks:
        logger.warning("%s", remark)
    return series


def _opened(settings: TestSettings, source: FrameSequence | Series | None, camera: CameraMetadata | None) -> Series:
    frame_settings = settings.frames
    if source is None:
        return open_series(frame_settings, settings.base, camera)
    members = {name for name in set(dir(FrameSeries)) & set(dir(SourceSeries)) if not name.startswith("_")}
    if all(hasattr(source, name) for name in members):  # also by `__getattr__` of a wrapper
        return cast(Series, source)
    if not (hasattr(source, "__len__") and hasattr(source, "__getitem__")):
        raise InputError(
            f"a frame source has a length and a frame by index (__len__ and __getitem__); {class_name(source)} has "
            "not. Frames that come one after the other are for rgbmidic.measure_sequence"
        )
    for name in ("names", "times_ns"):
        entries = getattr(source, name, None)
        if entries is not None and len(entries) != len(source):
            raise InputError(f"{name} of {class_name(source)} has {len(entries)} entries for {len(source)} frames")
    selected, start = selected_frames(frame_settings, len(source)), frame_settings.reference[0]
    series = SourceSeries(
        source=cast(FrameSequence, source), user_metadata=frame_settings, camera=camera, selected=selected
    )
    state = series.read(start)
    if not isinstance(state, IlluminationImages):
        return replace(series, shape=state[0].values.shape[-2:])
    white = (
        float(np.nanmax(state.values, initial=0.0))
        if frame_settings.white_level is None
        else frame_settings.white_level
    )
    return replace(series, shape=state.shape, full_scale=white - (frame_settings.black_level or 0.0))


def check_user_objects(
    settings: TestSettings,
    source: object | None,
    separation: LightSeparation | None,
    weights: LightWeights | None,
    mesh: Tri3Mesh | None,
) -> None:
    """Refuse an object that is none of its kind or that contradicts the settings, and settings that need another one.

    Raises
    ------
    InputError
        It lacks a method, or is of another kind.
    ConfigurationError
        The settings name something else, or something that nobody gives.
    """
    check_object("separation", separation, "__call__")
    check_object("weights", weights, "reference", "deformed")
    check_type("mesh", mesh, Tri3Mesh | None, "a Tri3Mesh")
    frames, mesh_settings, method = settings.frames, settings.mesh, settings.weights.method

    def contradictions() -> Iterator[str]:
        if source is not None and (path := ", ".join(frames.path)):
            yield f"frames.path names {path}, and a frame source is given: leave the path empty (path = [])"
        if source is not None and frames.lights > 1:
            yield "frames.lights is for files; a frame source gives all lights of a state by one index"
        if weights is not None and method not in ("statistics", "none"):
            advice = 'and weights are given: state "statistics", with which both count, or "none"'
            yield f'weights.method = "{method}", {advice}'
        if mesh is not None and mesh_settings.file is not None:
            yield f"mesh.file names {mesh_settings.file}, and a mesh is given: leave one of them out"
        if mesh is not None and mesh_settings.cracks:
            yield "mesh.cracks splits a mesh that is made here; the mesh that is given has its own"
        measured = "on the frames of a test by rgbmidic.measure, for a mesh"
        if mesh_settings.element_size == "auto":
            yield f'mesh.element_size = "auto" is found {measured} that is made there: state a number'
        if mesh_settings.refine is not False:
            yield f"mesh.refine is done {measured} made there: leave it out"

    for message in contradictions():
        raise ConfigurationError(message)


def check_object(name: str, candidate: object, *methods: str) -> None:
    """Refuse an object that a script gave, unless it is None or has all of these methods.

    Raises
    ------
    InputError
        It lacks one of them.
    """
    if candidate is not None and not all(callable(getattr(candidate, method, None)) for method in methods):
        needed = "can be called" if methods == ("__call__",) else f"has {' and '.join(f'{name}()' for name in methods)}"
        raise InputError(f"{name} must be an object that {needed}, not {class_name(candidate)}")


def check_type(name: str, value: object, kind: type | UnionType, allowed: str) -> None:
    """Refuse what is not of a kind.

    Raises
    ------
    InputError
        It is of another one.
    """
    if not isinstance(value, kind):
        raise InputError(f"{name} must be {allowed}, not {class_name(value)}")


def describe(value: Any, longest: int = 120) -> str:
    """Describe an object that a script gave, for the result: its ``describe()`` where it has one, else what it shows.

    Functions and objects without a representation of their own give their name only: two of one name cannot be told
    apart. More than the `longest` number of characters are cut and get their checksum: people read the text, the
    comparison reads the checksum.
    """
    if callable(describe_method := getattr(value, "describe", None)):
        text = f"{class_name(value)}: {describe_method()}"
    elif callable(value) and hasattr(value, "__qualname__"):
        text = f"{value.__module__}.{value.__qualname__}"
    elif repr(value) == object.__repr__(value):
        text = class_name(value)
    else:
        text = f"{class_name(value)}: " + re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))
    if len(text) > longest:
        return f"{text[:longest]} ... {hashlib.sha256(text.encode()).hexdigest()[:16]}"
    return text


def class_name(value: object) -> str:
    """Return module and name of the class of an object."""
    return f"{type(value).__module__}.{type(value).__qualname__}"
