"""Captures of a calibration: their files with hashes, their mean and temporal variance, their averages in blocks.

Mean and variance are those of every sample over the frames of one exposure, plane by plane.

*Block averages.* The samples of different channels of a Bayer mosaic lie at different points of the target, so on a
speckled target their ratio pixel by pixel is meaningless. Averages over a block are comparable, provided that every
plane's average is taken about the same point: the window is a box convolved with [1 2 1] in rows and columns. Its
transfer function has a triple zero at the carriers of the 2x2 cell, hence the four planes see the mean, the slope and
the curvature of the picture alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

import rgbmidic
from rgbmidic.errors import CalibrationError, ConfigurationError, FrameError
from rgbmidic.frames import ChannelFrame, FrameSeries, FrameSource, Mosaic, open_series
from rgbmidic.frames.data import cfa_channels, colour_planes
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.plane_samples import saturation_pile, unevenness
from rgbmidic.settings import FrameSettings
from rgbmidic.typing import BoolArray, FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureFiles:
    """The captures of one group: one light, or the dark frames.

    Attributes
    ----------
    role
        ``"dark"``, ``"light red"`` ...: for messages and the provenance.
    series
        Their frames.
    user_metadata
        What the user stated about them.
    exposure
        Exposure time of all of them, any unit; None: not stated.
    """

    role: str
    series: FrameSeries
    user_metadata: FrameSettings
    exposure: float | None = None

    @classmethod
    def find(
        cls, role: str, pattern: str, user_metadata: FrameSettings, calibration: Calibration | None = None
    ) -> Self:
        """Files that a pattern or folder names; `user_metadata` is what the user states of them (its path is not used).

        What neither the files nor the user state comes from the `calibration`, which must agree with both.

        Raises
        ------
        CalibrationError
            No file matches, or the files have different sizes.
        """
        settings = replace(user_metadata, path=(pattern,))
        try:
            return cls(
                role=role, series=open_series(settings, camera=calibration, in_order=False), user_metadata=settings
            )
        except FrameError as error:
            raise CalibrationError(f"{role}: {error}") from None

    def by_folder(self) -> list[CaptureFiles]:
        """Return the same flat frames in one group per folder."""
        groups: dict[Path, list[FrameSource]] = {}
        for source in self.series.lights[0]:
            groups.setdefault(source.path.parent, []).append(source)
        return [
            replace(self, role=f"flat {folder}", series=FrameSeries(lights=(tuple(sources),)))
            for folder, sources in groups.items()
        ]

    def frames(self) -> Iterator[tuple[str, Mosaic | ChannelFrame]]:
        """Return the name and frame, one after the other."""
        return ((self.series.name(index), self.series.read(index)[0]) for index in range(len(self.series)))

    def stack(self) -> TemporalStack:
        """Return the mean and variance of the frames of one exposure; dark frames do not drift."""
        dark, frames = self.role == "dark", (frame for _, frame in self.frames())
        name = "the dark frames" if dark else self.role
        return stack_frames(frames, exposure=self.exposure, drifts=not dark, name=name)

    def means(self, block: int = 16) -> list[BlockMeans]:
        """Return the block averages of every frame."""
        return [block_means(frame, block=block, name=name) for name, frame in self.frames()]

    @property
    def fingerprints(self) -> dict[str, str]:
        """The files with their SHA-256."""
        return {str(source.path): source.fingerprint for source in self.series.lights[0]}


def provenance(command: str, groups: Sequence[CaptureFiles], details: Mapping[str, Any]) -> dict[str, Any]:
    """Return the origin of a calibration: command, date, version, stated metadata, input files, and `details`."""
    names = ("kind", "cfa", "black_level", "white_level", "shape", "dtype")
    metadata_values = {name: getattr(group.user_metadata, name) for group in groups[:1] for name in names}
    return {
        "command": f"rgbmidic-calibrate {command}",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "version": rgbmidic.__version__,
        "stated": {name: value for name, value in metadata_values.items() if value is not None},
        "inputs": [
            {"role": group.role, "file": path, "sha256": fingerprint}
            for group in groups
            for path, fingerprint in group.fingerprints.items()
        ],
        **details,
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Captures:
    """All captures of a calibration, or of a check.

    Attributes
    ----------
    lights
        With one light on, by its name.
    dark
        With every lamp off; None: there are none.
    simultaneous
        With several lights on, by their names joined by ``+``.
    """

    lights: Mapping[str, CaptureFiles]
    dark: CaptureFiles | None
    simultaneous: Mapping[str, CaptureFiles]

    @classmethod
    def find(
        cls,
        lights: Mapping[str, str],
        dark: str | None,
        user_metadata: FrameSettings,
        *,
        calibration: Calibration | None = None,
        simultaneous: Mapping[str, str] | None = None,
    ) -> Captures:
        """Find the files of patterns, given by the names of the lights.

        Raises
        ------
        ConfigurationError
            Captures of lights together without the single ones of each.
        CalibrationError
            As in `CaptureFiles.find`.
        """
        for names in simultaneous or ():
            if missing := [name for name in names.split("+") if name not in lights]:
                raise ConfigurationError(
                    f"`simultaneous` {names} needs the single captures of {', '.join(missing)} too (`lights`)"
                )
            if "+" not in names:
                raise ConfigurationError(f"`simultaneous` takes NAME+NAME=FILES, at least two lights, not {names}")

        def find_files(role: str, pattern: str) -> CaptureFiles:
            return CaptureFiles.find(role, pattern, user_metadata, calibration)

        return cls(
            lights={name: find_files(f"light {name}", pattern) for name, pattern in lights.items()},
            dark=find_files("dark", dark) if dark else None,
            simultaneous={
                names: find_files(f"lights {names}", pattern) for names, pattern in (simultaneous or {}).items()
            },
        )

    @property
    def groups(self) -> tuple[CaptureFiles, ...]:
        """The captures of each light, of lights together, and the dark frames."""
        return *self.lights.values(), *self.simultaneous.values(), *([self.dark] if self.dark else [])

    def stacks(self) -> tuple[dict[str, TemporalStack], TemporalStack | None]:
        """Return the mean and variance of the captures of every light by its name, and of the dark frames."""
        return {name: files.stack() for name, files in self.lights.items()}, self.dark.stack() if self.dark else None


@dataclass(frozen=True, slots=True)
class Sampling:
    """Sampling of a camera's frames.

    Attributes
    ----------
    names : tuple of str, length P
        Colour planes: R, G1, G2, B of a mosaic (G1 is the first green met row by row); R, G, B; or M.
    shape : tuple of int
        Rows and columns of the frames.
    black : tuple of float, length P
        Stated black levels (DN); each frame may state its own.
    white : float
        White level (DN).
    full_scale : float
        Grey level of a just saturated sample (DN above black).
    origins : tuple of (int, int), length P
        Row and column of each plane's first sample.
    step : int
        Distance of a plane's samples in the frame, px: 2 for a mosaic.
    """

    names: tuple[str, ...]
    shape: tuple[int, int]
    black: tuple[float, ...] = field(compare=False)
    white: float = field(compare=False)
    full_scale: float
    origins: tuple[tuple[int, int], ...]
    step: int

    @classmethod
    def of(cls, frame: Mosaic | ChannelFrame) -> Sampling:
        """Return the sampling of a frame's camera."""
        names, _, black = colour_planes(frame)
        origins, step = ((0, 0),) * len(names), 1
        if isinstance(frame, Mosaic):
            order = np.argsort(cfa_channels(frame.cfa).ravel(), kind="stable")
            origins, step = tuple((int(position) // 2, int(position) % 2) for position in order), 2
        shape = frame.values.shape[-2], frame.values.shape[-1]
        levels, white = tuple(black.tolist()), frame.white_level
        return cls(names, shape, levels, white, white - float(np.mean(levels)), origins, step)

    @property
    def greens(self) -> tuple[int, int] | None:
        """Planes of the greens in rows with red and in rows with blue; None where there is one green."""
        if self.step == 1:
            return None
        return (1, 2) if self.origins[1][0] == self.origins[0][0] else (2, 1)

    def __str__(self) -> str:
        planes = f"{self.shape[1]} x {self.shape[0]} px with planes {' '.join(self.names)}"
        return f"{planes} and a range of {self.full_scale:g} DN from black to white level {self.white:g}"


@dataclass(frozen=True, slots=True, kw_only=True)
class TemporalStack:
    """Frames of a scene at rest, all at one exposure.

    Attributes
    ----------
    camera
        How they were sampled; P colour planes.
    mean, variance : ndarray, shape (P, h, w), float32
        Mean above the stated black level (DN) and sample variance (DN squared) over the frames. Every frame is first
        scaled to the mean strength of all, so that a drifting lamp does not count as noise.
    clipped : ndarray, shape (P, h, w), bool
        True where any frame is saturated.
    strength : ndarray, shape (M, P)
        Mean of every frame and plane above the stated black level (DN).
    zeros : float
        Largest fraction of a plane's samples that are 0 (cut off at the bottom).
    pile_level : float or None
        Level below white where samples pile up as at saturation.
    unevenness : float
        Unevenness of the histogram of the first frame (`unevenness_of`).
    exposure : float or None
        Exposure time, any unit.
    """

    camera: Sampling
    mean: FloatImage
    variance: FloatImage
    clipped: BoolArray
    strength: FloatArray
    zeros: float
    pile_level: float | None
    unevenness: float
    exposure: float | None = None

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.strength)

    @property
    def drift(self) -> float:
        """Range of a plane's strength over the frames, relative to its mean (or to 1 DN), of the worst plane."""
        return float((np.ptp(self.strength, axis=0) / np.maximum(self.strength.mean(axis=0), 1)).max())


def stack_frames(
    frames: Iterable[Mosaic | ChannelFrame], *, exposure: float | None = None, drifts: bool = True, name: str = "frames"
) -> TemporalStack:
    """Return mean and variance over the frames of one exposure, frame by frame (Welford), so that memory does not grow.

    Parameters
    ----------
    frames
        Frames of one size and kind, with the same levels.
    exposure
        Exposure time of these frames, any unit.
    drifts
        Scale every frame to the strength of the first before its variance counts; not for dark frames.
    name
        What the frames are, for messages.

    Raises
    ------
    CalibrationError
        No frame, or frames that do not belong together.
    """
    camera: Sampling | None = None
    strength: list[FloatArray] = []
    zeros, pile_level = 0.0, None
    for frame in frames:
        _, samples, black = colour_planes(frame)
        planes, sampling = np.stack(samples), Sampling.of(frame)
        if camera is None:
            camera, clipped, unevenness_first = sampling, np.zeros(planes.shape, dtype=bool), unevenness_of(frame)
            mean, squares = np.zeros((2, *planes.shape), dtype=np.float32)
        if sampling != camera:
            raise CalibrationError(
                f"{name}: a frame is {sampling}, the first {camera}: all must come from the same camera and settings"
            )
        strength.append(np.array([plane.mean(dtype=np.float64) for plane in planes]) - black)
        zeros = max(zeros, *(float((plane == 0).mean()) for plane in planes))
        pile_level = pile_level or next(
            filter(None, (saturation_pile(plane, sampling.white) for plane in planes)), None
        )
        scale = _ratio(strength[0], strength[-1]) if drifts else np.ones(len(planes))
        values = (planes.astype(np.float32) - _column(black)) * _column(scale)
        step = values - mean
        mean += step / len(strength)
        squares += step * (values - mean)
        clipped |= planes >= sampling.white
    if camera is None:
        raise CalibrationError(f"{name}: no frames")
    levels = np.array(strength)
    # The frames were scaled to the first one's strength: bring them to the mean strength.
    factor = _ratio(levels.mean(axis=0), levels[0]) if drifts else np.ones(len(camera.names))
    return TemporalStack(
        camera=camera,
        mean=mean * _column(factor),
        variance=squares * _column(factor**2 / max(len(levels) - 1, 1)),
        clipped=clipped,
        strength=levels,
        zeros=zeros,
        pile_level=pile_level,
        unevenness=unevenness_first,
        exposure=exposure,
    )


def _column(figures: FloatArray) -> FloatImage:
    """Return the figures of the planes (P,), for images (P, h, w)."""
    return figures.astype(np.float32)[:, None, None]


TILE = 16
"""Side of the tiles, in samples of a plane: of 256 samples the variance is known to 9 %."""


def tile_means(values: npt.NDArray[np.generic]) -> FloatArray:
    """Return the means over tiles of up to TILE x TILE samples; a border that does not fill a tile is left out.

    Parameters
    ----------
    values
        Shape (..., h, w).

    Returns
    -------
    ndarray, shape (..., tiles)
    """
    *lead, height, width = values.shape
    size = min(TILE, height, width)
    rows, columns = height // size, width // size
    cut = values[..., : rows * size, : columns * size].reshape(*lead, rows, size, columns, size)
    return np.asarray(cut.mean(axis=(-3, -1), dtype=np.float64).reshape(*lead, rows * columns))


def _ratio(levels: FloatArray, by: FloatArray) -> FloatArray:
    """Return the ratio of strengths; 1 for strengths up to 1 DN, where there is hardly any light to drift."""
    return np.where((levels > 1) & (by > 1), levels / np.where(by > 1, by, 1.0), 1.0)


def require_same_camera(stacks: Sequence[TemporalStack]) -> None:
    """Refuse stacks of different cameras or settings.

    Raises
    ------
    CalibrationError
        Size, planes, pattern or levels differ.
    """
    first = stacks[0].camera
    for stack in stacks[1:]:
        if stack.camera != first:
            raise CalibrationError(f"the exposures are of different cameras or settings: {stack.camera} and {first}")


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockMeans:
    """Block averages of one frame above the stated black level.

    Attributes
    ----------
    planes : ndarray, shape (P, R, S), float64
        Mean grey level (DN above black) of each colour plane in each of R x S blocks.
    saturated : ndarray, shape (R, S), bool
        True where any sample of any plane is saturated.
    camera : Sampling
        How the frame was sampled.
    block : int
        Side of a block in px.
    detail : float
        Mean square second difference over the square of the mean, in the brightest plane: how sharp the picture is.
    pile_level : float or None
        Grey level (DN) below the white level at which samples pile up as they do at saturation; None: nowhere.
    unevenness : float
        Unevenness of its histogram (`unevenness_of`).
    name : str
        Of its file, for messages.
    """

    planes: FloatArray
    saturated: BoolArray
    camera: Sampling
    block: int
    detail: float
    pile_level: float | None
    unevenness: float
    name: str

    @property
    def channels(self) -> FloatArray:
        """Block averages of the channels R, G, B, shape (3, R, S): the two greens of a mosaic averaged."""
        if len(self.planes) == 3:
            return self.planes
        return np.stack([self.planes[0], 0.5 * (self.planes[1] + self.planes[2]), self.planes[3]])

    @property
    def signals(self) -> FloatArray:
        """Block averages of the channels R, G, B and, of a mosaic, of G in red rows minus G in blue rows."""
        greens = self.camera.greens
        return np.stack([*self.channels, *([self.planes[greens[0]] - self.planes[greens[1]]] if greens else [])])

    @property
    def centres(self) -> FloatArray:
        """Centres (x, y) of the blocks in px, shape (R, S, 2)."""
        rows, columns = (_block_starts(side, self.block) + (self.block - 1) / 2 for side in self.camera.shape)
        return np.stack(np.meshgrid(columns, rows), axis=-1)


def block_means(frame: Mosaic | ChannelFrame, *, block: int = 16, name: str = "") -> BlockMeans:
    """Average every colour plane of a frame in blocks.

    Parameters
    ----------
    frame
        Raw frame, Bayer or 3-CCD.
    block
        Side of a block in px; even.
    name
        Name of the frame's file, for messages.

    Raises
    ------
    CalibrationError
        The frame is monochrome, or too small for 3 x 3 blocks.
    """
    _, planes, black = colour_planes(frame)
    camera = Sampling.of(frame)
    shape, step = camera.shape, camera.step
    if camera.names == ("M",):
        raise CalibrationError("a monochrome frame has no colour channels: there is no crosstalk to calibrate")
    if block < 2 or block % 2:
        raise CalibrationError(f"a block has an even number of pixels, at least 2, not {block}")
    if min(shape) < 3 * block + 4:
        raise CalibrationError(
            f"frames of {shape[1]} x {shape[0]} px are too small for calibration in blocks of {block} px "
            f"(at least {3 * block + 4} px on each side)"
        )
    averages = []
    for plane, dark, origin in zip(planes, black, camera.origins, strict=True):
        row_weights, column_weights = (
            _window(shape[axis], plane.shape[axis], block, step, origin[axis]) for axis in (0, 1)
        )
        averages.append(row_weights @ plane @ column_weights.T - dark)
    means = np.stack(averages)
    brightest = int(means.mean(axis=(1, 2)).argmax())
    picture = planes[brightest].astype(np.float32)
    level = max(float(picture.mean()) - float(black[brightest]), 1.0)
    clipped = np.atleast_3d(frame.white_level <= frame.values.T).any(axis=2).T.astype(np.float32)
    # the window is positive on the block and its rim of one pixel, 0 elsewhere
    row_cover, column_cover = (_window(side, side, block, 1, 0) for side in shape)
    saturated = row_cover @ clipped @ column_cover.T > 0
    return BlockMeans(
        planes=means,
        saturated=saturated,
        camera=camera,
        block=block,
        detail=float(((picture[:, 2:] - 2 * picture[:, 1:-1] + picture[:, :-2]) ** 2).mean()) / level**2,
        pile_level=saturation_pile(planes[brightest], frame.white_level),
        unevenness=unevenness_of(frame),
        name=name,
    )


def _block_starts(side: int, block: int) -> npt.NDArray[np.intp]:
    # Two pixels at each border stay unused: the window reaches one pixel beyond its block.
    return np.arange(2, side - side % 2 - block - 1, block)


def _window(side: int, length: int, block: int, step: int, offset: int) -> FloatArray:
    """Return weights (blocks, samples) that average the samples at offset + step * n with the window of the module."""
    position = offset + step * np.arange(length)
    distance = position[None, :] - _block_starts(side, block)[:, None]
    edges = np.array([-2, -1, 0, 1, block - 2, block - 1, block, block + 1])
    weights = np.interp(distance, edges, [0, 1, 3, 4, 4, 3, 1, 0], left=0.0, right=0.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), dtype=np.float64)


def unevenness_of(frame: Mosaic | ChannelFrame, min_level: float = 0.1) -> float:
    """Return the largest unevenness of the histogram of a lit plane; NaN where it cannot be determined in any.

    Lit are planes whose mean above black exceeds the fraction `min_level` of the full scale: in the dark, noise is too
    little to smooth it. Some cameras apply gains of their own to red and blue, so all planes are looked at.
    """
    white, values = frame.white_level, [np.nan]
    for plane, black in zip(*colour_planes(frame)[1:], strict=True):
        if plane.mean() > black + min_level * (white - black):
            values.append(unevenness(plane[plane < white]))
    return float(np.fmax.reduce(values))
