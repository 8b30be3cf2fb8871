"""Real captures of a print under three narrow bands, one at a time, and single shots made of them.

Every photosite answers to every band, so a sum of the three captures is a raw frame of all of them together whose
parts are known. The print is at rest: a crop that begins at (x, y) shows the whole scene moved by (-x, -y) exactly,
and an odd offset changes the Bayer phase under the texture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rgbmidic import Solution, correlate, read_frame
from rgbmidic.frames.data import Mosaic, shift_cfa
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.illumination.separation import Separation
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.settings import FrameSettings

FILES = {"red": "disks_650nm_250ms.tif", "green": "disks_550nm_25ms.tif", "blue": "disks_450nm_50ms.tif"}
DARK = {"red": "dark_250ms_*.tif", "green": "dark_25ms_*.tif", "blue": "dark_50ms_*.tif"}
CFA = "GBRG"
STATED = FrameSettings(path=(), kind="bayer", cfa=CFA, black_level=0, white_level=255)
"""What the files do not state."""
BLACK, WHITE = 64, 4095
"""DN of the 12-bit camera that takes the single shots."""
NOISE = NoiseModel(gain=4.0, read_noise=3.0)
"""Of this camera: that of the virtual scenes, in electrons per DN and DN."""
BRIGHTEST = 0.8
"""Largest sample of a single shot, of the full scale."""
ELEMENT = 80
"""px: disks of 30 px lie 68 px apart."""
MARGIN = 20
OFFSETS = ((1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 2), (3, 1))
"""Offsets (x, y) of the crops, px: those of two even numbers keep the Bayer phase."""
LARGEST = 4
"""px, of an offset: the crops have one size."""
Offset = tuple[int, int]
Ratio = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Bands:
    """Samples of each band alone above dark, shape (3, H, W), relative to the level of its own channel."""

    samples: npt.NDArray[np.float64]

    @classmethod
    def read(cls, folder: Path) -> Bands:
        """Read the captures; each is scaled to a median of 1 in the channel that sees the band best."""
        bands = []
        for name, file in FILES.items():
            dark = np.mean([_samples(path) for path in sorted(folder.glob(DARK[name]))], axis=0)
            lit = _samples(folder / file) - dark
            planes = [lit[row::2, column::2] for row in (0, 1) for column in (0, 1)]
            bands.append(lit / max(float(np.median(plane)) for plane in planes))
        return cls(samples=np.array(bands))

    def scale(self, ratio: Ratio) -> float:
        """DN per unit of the samples that bring the brightest one to `BRIGHTEST`."""
        return BRIGHTEST * (WHITE - BLACK) / float(np.tensordot(np.array(ratio), self.samples, axes=1).max())

    def shot(self, ratio: Ratio, offset: Offset = (0, 0), seed: int | None = 0) -> Mosaic:
        """A single shot of all bands, their strengths in a ratio, taken by a 12-bit camera; seed None: no noise."""
        signal = np.tensordot(np.array(ratio), self.samples, axes=1) * self.scale(ratio)
        if seed is not None:
            random = np.random.default_rng(seed)
            noise = random.normal(size=signal.shape)
            signal = signal + noise * np.sqrt(np.maximum(signal, 0) / NOISE.gain + NOISE.read_noise**2)
        (x, y), (rows, columns) = offset, np.array(signal.shape) - LARGEST
        values = np.clip(np.rint(signal + BLACK), 0, WHITE).astype(np.uint16)[y : y + rows, x : x + columns]
        cfa = shift_cfa(CFA, y, x)
        return Mosaic(values=values, cfa=cfa, black_level=np.array(float(BLACK)), white_level=WHITE)


def _samples(path: Path) -> npt.NDArray[np.float64]:
    frame = read_frame(path, kind="bayer", cfa=CFA, black_level=0, white_level=255)
    return np.asarray(frame.values, dtype=np.float64)


def calibrate(folder: Path, element_size: float = ELEMENT) -> Calibration:
    """Calibrate crosstalk and registration from the captures, as `rgbmidic-calibrate` does."""
    from rgbmidic_calibration.captures import Captures
    from rgbmidic_calibration.jobs import calibrate_crosstalk, calibrate_registration

    lights = {name: str(folder / file) for name, file in FILES.items()}
    captures = Captures.find(lights, str(folder / DARK["blue"]), STATED)
    crosstalk, _ = calibrate_crosstalk(captures)
    registration, _ = calibrate_registration(captures, element_size=element_size)
    return replace(crosstalk, registration=registration.registration, noise=NOISE, black_level=None, white_level=None)


def lights(
    shot: Mosaic, calibration: Calibration, offset: Offset, method: str, texture: TextureModel | None = None
) -> IlluminationImages:
    """One image per band of a crop, where it lies; the crop's place in the calibrated frame is known."""
    cropped = calibration.cropped(offset, shot.values.shape)
    return Separation(calibration=cropped, demosaic=method, texture=texture)((shot,))


def displacement(first: IlluminationImages, second: IlluminationImages) -> Solution:
    """Displacement between two crops; all bands move alike, so each is read where it lies, without registration."""
    rows, columns = first.shape
    region = (MARGIN, MARGIN, columns - 1 - MARGIN, rows - 1 - MARGIN)
    return correlate(first.values, second.values, region=region, element_size=ELEMENT)


@dataclass(frozen=True, slots=True, kw_only=True)
class Error:
    """Error of the nodes: root mean square over both components, px, and of the error over what is stated.

    A node without data does not count; their number is `lost`.
    """

    rms: float
    ratio: float
    lost: int = 0

    @classmethod
    def of(cls, found: Solution, offset: Offset) -> Error:
        """Of a solution for a crop at an offset; NaN where it has no node."""
        error = (found.displacement + np.array(offset))[found.measured]
        relative = error / found.displacement_std[found.measured]
        rms, ratio = (
            float(np.sqrt((part**2).sum() / part.size)) if part.size else np.nan for part in (error, relative)
        )
        return cls(rms=rms, ratio=ratio, lost=int((~found.measured).sum()))

    @classmethod
    def together(cls, errors: Sequence[Error]) -> Error:
        """Of several solutions of as many nodes."""
        rms, ratio = np.sqrt(np.mean([(error.rms**2, error.ratio**2) for error in errors], axis=0))
        return cls(rms=float(rms), ratio=float(ratio), lost=sum(error.lost for error in errors))


def errors(
    bands: Bands,
    calibration: Calibration,
    ratio: Ratio,
    method: str,
    *,
    offsets: Sequence[Offset] = OFFSETS,
    seed: int = 0,
) -> dict[Offset, Error]:
    """Errors of the displacement by a method at some offsets; each frame has noise of its own."""
    first = lights(bands.shot(ratio, (0, 0), seed), calibration, (0, 0), method)
    found = {}
    for number, offset in enumerate(offsets, start=1):
        shot = bands.shot(ratio, offset, seed + 1000 * number)
        second = lights(shot, calibration, offset, method, first.texture)
        found[offset] = Error.of(displacement(first, second), offset)
    return found


def image_error(bands: Bands, calibration: Calibration, ratio: Ratio, method: str, seed: int = 0) -> float:
    """Rms error of red and blue at the greens' sites, over their level on white.

    There each band alone was recorded, at a tenth and a fifth of its level, and is not sampled in a single shot: its
    image is an estimate. Rounding of the captures to 8 bits is part of the error (1 to 2 %).
    """
    images = lights(bands.shot(ratio, seed=seed), calibration, (0, 0), method)
    rows, columns = images.shape
    squares = []
    for band in (0, 2):
        level = ratio[band] * bands.scale(ratio)
        for row, column in ((0, 0), (1, 1)):  # of the greens of GBRG
            response = bands.samples[band, row::2, column::2]
            known = response[: rows // 2, : columns // 2] / np.median(response)
            image = images.values[band, row::2, column::2] / level
            squares.append(((image / np.median(image) - known)[8:-8, 8:-8] ** 2).mean())
    return float(np.sqrt(np.mean(squares)))
