"""The samples of a raw frame in the rectangle of the region, colour plane by colour plane."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rgbmidic.frames.data import ChannelFrame, Mosaic, colour_planes
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.typing import BoolArray, FloatArray

Frame = Mosaic | ChannelFrame


@dataclass(frozen=True, slots=True)
class PlaneSamples:
    """The P colour planes of a frame in the rectangle of the region."""

    names: tuple[str, ...]
    stored: npt.NDArray[np.uint16]  # (P, h, w)
    black: FloatArray  # (P,)
    values: npt.NDArray[np.float32]  # DN above black
    usable: BoolArray  # in the region, neither saturated nor cut off at 0
    noise: tuple[NoiseModel | None, ...]
    red_row: int  # of a cell of the pattern

    @classmethod
    def of(cls, frame: Frame, calibration: Calibration, inside: BoolArray, window: tuple[slice, slice]) -> PlaneSamples:
        """Cut the colour planes in a window out of the frame."""
        step = 2 if isinstance(frame, Mosaic) else 1
        names, planes, black = colour_planes(replace(frame, values=frame.values[..., *window]))
        stored = np.stack(planes)
        height, width = stored.shape[1:]
        inner = inside[window][: step * height : step, : step * width : step]
        noise = dict.fromkeys("RGBM", calibration.noise)
        if (figures := calibration.camera_noise) is not None:  # of a colour, since cropping exchanges the greens
            for colour in {name[0] for name in figures.planes}:
                same = [index for index, name in enumerate(figures.planes) if name[0] == colour]
                gain, read_noise = figures.gain.value[same].mean(), figures.read_noise.value[same].mean()
                noise[colour] = NoiseModel(gain=float(gain), read_noise=float(read_noise))
        return cls(
            names=names,
            stored=stored,
            black=black,
            values=stored.astype(np.float32) - black.astype(np.float32)[:, None, None],
            usable=inner & (stored < frame.white_level) & (stored > 0),
            noise=tuple(noise[name[0]] for name in names),
            red_row=int("R" in frame.cfa[2:]) if isinstance(frame, Mosaic) else 0,
        )

    @property
    def middle(self) -> tuple[slice, ...]:
        """At most 288 x 288 samples in the middle, from even ones on: 4 planes of them are looked at in 30 ms."""
        max_side = 288
        return tuple(slice(max(side - max_side, 0) // 4 * 2, (side + max_side) // 2) for side in self.stored.shape[1:])
