"""Block averages of each colour plane: what the calibration compares instead of single samples.

The samples of different channels of a Bayer mosaic lie at different points of the target, so on a speckled target
their ratio pixel by pixel says nothing. Averages over a block do, provided that every plane's average is taken about
the same point: the window is a box convolved with [1 2 1] in rows and columns. Its transfer function has a triple zero
at the carriers of the 2x2 cell, hence the four planes see the mean, the slope and the curvature of the picture alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import CalibrationError
from rgbmidic.frames.data import ChannelFrame, Mosaic, cfa_channels, planes_of
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["BlockMeans", "block_centres", "block_means", "plane_origins", "saturation_pile"]


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockMeans:
    """Block averages of one frame above the stated black level.

    Attributes
    ----------
    planes : ndarray, shape (P, R, S), float64
        Mean grey level (DN above black) of each colour plane in each of R x S blocks.
    names : tuple of str, length P
        R, G1, G2, B for a mosaic (G1 is the first green met row by row); R, G, B for a 3-CCD frame.
    saturated : ndarray, shape (R, S), bool
        True where any sample of any plane is saturated.
    full_scale : float
        Grey level of a just saturated sample (DN above black).
    shape : tuple of int
        Rows and columns of the frame in px.
    block : int
        Side of a block in px.
    detail : float
        Mean square second difference over the square of the mean, in the brightest plane: how sharp the picture is.
    piled_at : float or None
        Grey level (DN) below the white level at which samples pile up as they do at saturation; None: nowhere.
    """

    planes: FloatArray
    names: tuple[str, ...]
    saturated: BoolArray
    full_scale: float
    shape: tuple[int, int]
    block: int
    detail: float
    piled_at: float | None = None

    @property
    def channels(self) -> FloatArray:
        """Block averages of the channels R, G, B, shape (3, R, S): the two greens of a mosaic averaged."""
        if len(self.names) == 3:
            return self.planes
        return np.stack([self.planes[0], 0.5 * (self.planes[1] + self.planes[2]), self.planes[3]])


def plane_origins(frame: Mosaic | ChannelFrame) -> tuple[tuple[int, int], ...]:
    """Row and column of the first sample of every plane of `rgbmidic.frames.data.planes_of`."""
    if isinstance(frame, ChannelFrame):
        return ((0, 0),) * len(frame.values)
    order = np.argsort(cfa_channels(frame.cfa).ravel(), kind="stable")
    return tuple((int(position) // 2, int(position) % 2) for position in order)


def block_means(frame: Mosaic | ChannelFrame, *, block: int = 16) -> BlockMeans:
    """Average every colour plane of a frame in blocks.

    Parameters
    ----------
    frame
        Raw frame, Bayer or 3-CCD.
    block
        Side of a block in px; even.

    Raises
    ------
    CalibrationError
        The frame is monochrome, or too small for 3 x 3 blocks.
    """
    names, planes, black = planes_of(frame)
    shape = frame.values.shape[-2], frame.values.shape[-1]
    if names == ("M",):
        raise CalibrationError("a monochrome frame has no colour channels: there is no crosstalk to calibrate")
    if block < 2 or block % 2:
        raise CalibrationError(f"a block has an even number of pixels, at least 2, not {block}")
    if min(shape) < 3 * block + 4:
        raise CalibrationError(
            f"frames of {shape[1]} x {shape[0]} px are too small for calibration in blocks of {block} px "
            f"(at least {3 * block + 4} px on each side)"
        )
    offsets = plane_origins(frame)
    step = 2 if isinstance(frame, Mosaic) else 1
    means = [
        _window(shape[0], len(plane), block, step, row) @ plane @ _window(shape[1], plane.shape[1], block, step, col).T
        - level
        for plane, level, (row, col) in zip(planes, black, offsets, strict=True)
    ]
    stack = np.stack(means)
    brightest = int(stack.mean(axis=(1, 2)).argmax())
    return BlockMeans(
        planes=stack,
        names=names,
        saturated=_saturated(frame, block),
        full_scale=frame.white_level - float(np.mean(black)),
        shape=shape,
        block=block,
        detail=_detail(planes[brightest], float(black[brightest])),
        piled_at=saturation_pile(planes[brightest], frame.white_level),
    )


def block_centres(shape: tuple[int, int], block: int) -> FloatArray:
    """Centres (x, y) in px of the blocks of a frame, shape (R, S, 2)."""
    rows, columns = (_starts(side, block) + (block - 1) / 2 for side in shape)
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def _starts(side: int, block: int) -> npt.NDArray[np.intp]:
    # Two pixels at each border stay unused: the window reaches one pixel beyond its block.
    return np.arange(2, side - side % 2 - block - 1, block)


def _window(side: int, length: int, block: int, step: int, offset: int) -> FloatArray:
    """Weights (blocks, samples) that average the samples at offset + step * n with the window of the module."""
    position = offset + step * np.arange(length)
    distance = position[None, :] - _starts(side, block)[:, None]
    edges = np.array([-2, -1, 0, 1, block - 2, block - 1, block, block + 1])
    weights = np.interp(distance, edges, [0, 1, 3, 4, 4, 3, 1, 0], left=0.0, right=0.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), dtype=np.float64)


def _saturated(frame: Mosaic | ChannelFrame, block: int) -> BoolArray:
    clipped = np.atleast_3d(frame.white_level <= frame.values.T).any(axis=2).T
    rows, columns = (_starts(side, block) for side in clipped.shape)
    # Summed-area table over each block with its rim of one pixel.
    table = np.zeros((clipped.shape[0] + 1, clipped.shape[1] + 1), dtype=np.int64)
    table[1:, 1:] = clipped.cumsum(axis=0, dtype=np.int64).cumsum(axis=1)
    top, bottom, left, right = rows - 1, rows + block + 1, columns - 1, columns + block + 1
    count = table[np.ix_(bottom, right)] - table[np.ix_(top, right)] - table[np.ix_(bottom, left)]
    return np.asarray(count + table[np.ix_(top, left)] > 0)


def saturation_pile(plane: npt.NDArray[np.uint16], white: float) -> float | None:
    """Largest value of a plane where it occurs far more often than the values just below it."""
    top = int(plane.max())
    if top >= white or top < 8:
        return None
    count, below = int((plane == top).sum()), int(((plane < top) & (plane >= top - 4)).sum())
    return float(top) if count > 20 and count > 2 * below else None


def _detail(plane: npt.NDArray[np.uint16], black: float) -> float:
    values = plane.astype(np.float32)
    second = values[:, 2:] - 2 * values[:, 1:-1] + values[:, :-2]
    level = max(float(values.mean()) - black, 1.0)
    return float((second**2).mean()) / level**2
