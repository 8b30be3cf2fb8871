"""What a page that sets a test up shows of its frames: raw, and as `rgbmidic inspect` separates and judges them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.series import FrameSeries, open_series
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.lab.inspection import Inspection, inspect_frame
from rgbmidic.mesh import Region
from rgbmidic.typing import FloatImage
from rgbmidic.view.draft import Draft
from rgbmidic.view.picture import grey_picture

__all__ = ["RAW", "Footage", "inspected", "pictures", "side_by_side"]

RAW = "raw frame"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Footage:
    """The frames of a test that is being set up.

    Attributes
    ----------
    series
        All frames of the source, whatever part of them is chosen.
    calibration
        As far as it is known.
    shape
        Rows and columns.
    """

    series: FrameSeries
    calibration: Calibration | None
    shape: tuple[int, int]

    @classmethod
    def of(cls, draft: Draft) -> Footage:
        """The frames that a draft names.

        Raises
        ------
        RgbmidicError
            They, or the calibration, cannot be read as the draft says.
        """
        file = draft.section("calibration").get("file")
        calibration = Calibration.read(draft.file.parent / file) if isinstance(file, str) else None
        series = open_series(draft.frames, draft.file.parent, calibration)
        first = series.read(0)[0]
        shape = first.values.shape[-2], first.values.shape[-1]
        if calibration is not None:
            calibration = calibration.cropped(draft.frames.crop_origin, shape)
        return cls(series=series, calibration=calibration, shape=shape)

    def raw(self, index: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
        """A raw frame as a picture (H, W), and where it is saturated; errors as `FrameSeries.read`."""
        frame = self.series.read(index)[0]
        return grey_picture(frame), saturated(frame)


def saturated(frame: Mosaic | ChannelFrame) -> npt.NDArray[np.bool_]:
    """Where a raw frame is saturated in some channel, (H, W)."""
    full = frame.values >= frame.white_level
    return np.asarray(full if full.ndim == 2 else full.any(axis=0))


def inspected(footage: Footage, index: int, region: Region, element_size: float) -> Inspection:
    """What a frame tells before the test; errors as `inspect_frame`."""
    calibration = footage.calibration
    name, frame = footage.series.name(index), footage.series.read(index)
    return inspect_frame(frame, calibration=calibration, region=region, element_size=element_size, name=name)


def pictures(inspection: Inspection, shape: tuple[int, int]) -> dict[str, npt.NDArray[np.uint8]]:
    """The separated lights and their reflection index by their names, each a picture of the whole frame."""
    images = inspection.images
    found = {f"light: {name}": _stretched(values) for name, values in zip(images.names, images.values, strict=True)}
    if inspection.reflection_index is not None:
        for name, index in zip(images.names, inspection.reflection_index, strict=True):
            found[f"reflection index: {name}"] = np.asarray(255 * np.clip(np.nan_to_num(index), 0, 1), dtype=np.uint8)
    return {name: _placed(picture, inspection.origin, shape) for name, picture in found.items()}


def side_by_side(
    inspection: Inspection, named: dict[str, npt.NDArray[np.uint8]], raw: npt.NDArray[np.uint8]
) -> list[dict[str, npt.NDArray[np.uint8]]]:
    """Rows of pictures: the raw frame and the separated lights, their reflection index."""
    lights = len(inspection.images.names)
    pairs = [(RAW, raw), *((name.replace("reflection index", "index"), picture) for name, picture in named.items())]
    return [dict(row) for row in (pairs[: lights + 1], pairs[lights + 1 :]) if row]


def _stretched(values: FloatImage) -> npt.NDArray[np.uint8]:
    low, high = np.nanpercentile(values, [1, 99]) if np.isfinite(values).any() else (0.0, 1.0)
    return np.asarray(np.clip(255 * (np.nan_to_num(values) - low) / max(high - low, 1e-6), 0, 255), dtype=np.uint8)


def _placed(picture: npt.NDArray[np.uint8], origin: tuple[int, int], shape: tuple[int, int]) -> npt.NDArray[np.uint8]:
    whole = np.zeros(shape, dtype=np.uint8)
    x, y = (int(value) for value in origin)
    whole[y : y + picture.shape[0], x : x + picture.shape[1]] = picture
    return whole
