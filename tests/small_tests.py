"""Tiny virtual tests on disk: raw frames of a painted plate under coloured lights, calibration file and TEST.toml."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from textures import Affine, Texture

from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.images import write_dng, write_tiff
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.settings import TestSettings, read_test
from rgbmidic.tools.lab.virtual import Scene, plate_scene, record, render, strained_plate, truth

SHAPE = (144, 144)
REGION = [16, 16, 128, 128]
Motion = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class SmallTest:
    """A test on disk.

    Attributes
    ----------
    folder
        Holds ``TEST.toml``, ``calibration.json`` and ``frames/``.
    frames
        The frame files.
    truth
        (u, v) of each frame at the pixels of the reference, shape (T, 2, H, W), px.
    """

    folder: Path
    frames: tuple[Path, ...]
    truth: npt.NDArray[np.float64]

    def settings(self, **sections: Mapping[str, Any]) -> TestSettings:
        """The settings of TEST.toml with keys of its sections changed; None drops a key."""
        document = read_test(self.folder / "TEST.toml").to_mapping()
        for section, changes in sections.items():
            keys = {**document.get(section, {}), **changes}
            document[section] = {key: value for key, value in keys.items() if value is not None}
        return TestSettings.from_mapping({name: keys for name, keys in document.items() if keys}, self.folder)

    def error(self, nodes: npt.NDArray[np.float64], u: Any, v: Any) -> npt.NDArray[np.float64]:
        """Measured minus true displacement at the nodes, shape (T, N, 2), px; the truth is bilinear between pixels."""
        from scipy.ndimage import map_coordinates

        points = nodes.T[::-1]
        true = [[map_coordinates(part, points, order=1) for part in frame] for frame in self.truth]
        return np.asarray(np.stack([u, v], axis=-1) - np.moveaxis(np.array(true), 1, -1))


@cache
def _scene(kind: str) -> Scene:
    return plate_scene(size=SHAPE[0], seed=3, samples=4, kind=kind)


@cache
def _rendered(shift: Motion) -> npt.NDArray[np.float32]:
    """What the lights alone give: the same for every kind of camera."""
    return render(_scene("bayer"), strained_plate(shift_px=shift, strain=0.002 if any(shift) else 0.0))


@cache
def _truth(shift: Motion) -> npt.NDArray[np.float64]:
    return truth(_scene("bayer"), strained_plate(shift_px=shift, strain=0.002 if any(shift) else 0.0))


def colour_test(
    folder: Path,
    shifts: Sequence[Motion] = ((0.0, 0.0), (0.3, 0.1), (1.2, -0.8)),
    *,
    kind: str = "bayer",
    suffix: str = ".dng",
) -> SmallTest:
    """Write a test with one frame per shift (px) of a plate under three lights; DNG or TIFF, Bayer or 3-CCD."""
    (folder / "frames").mkdir(parents=True)
    scene = _scene(kind)
    paths = []
    for index, shift in enumerate(shifts):
        frame = record(_rendered(shift), scene.camera, scene.lights, seed=index)
        paths.append(folder / "frames" / f"frame_{index}{suffix}")
        if suffix == ".dng":
            assert isinstance(frame, Mosaic)
            write_dng(paths[-1], frame)
        else:
            write_tiff(paths[-1], frame)
    camera = scene.camera
    Calibration(
        crosstalk=camera.true_crosstalk(scene.lights),
        noise=camera.noise,
        cfa=camera.cfa if kind == "bayer" else None,
        black_level=camera.black_level,
        white_level=camera.white_level,
        shape=SHAPE,
    ).write(folder / "calibration.json")
    stated = f'kind = "{kind}"\n' if kind != "bayer" else ""
    (folder / "TEST.toml").write_text(toml(f'path = "frames/*{suffix}"\n{stated}', 'file = "calibration.json"'))
    return SmallTest(folder=folder, frames=tuple(paths), truth=np.stack([_truth(shift) for shift in shifts]))


def toml(frames: str, calibration: str = "") -> str:
    """A TEST.toml with the keys of ``[frames]`` and, where there are any, of ``[calibration]``."""
    text = f"[frames]\n{frames}\n[region]\nrectangle = {REGION}\n"
    return text + (f"[calibration]\n{calibration}\n" if calibration else "")


def grey_frame(
    seed: int, shift: Motion, *, sigma: float = 8.0, noise_seed: int = 0, shape: tuple[int, int] = SHAPE
) -> ChannelFrame:
    """A 12-bit monochrome frame of a cosine texture (mean 2000, contrast 500 DN) with white noise, black level 64."""
    image = 10 * Texture.random(seed).image(shape, Affine(shift=shift)) + 64
    noisy = image + np.random.default_rng([noise_seed, seed]).normal(scale=sigma, size=shape)
    return ChannelFrame(
        values=np.rint(noisy).clip(0, 4095).astype(np.uint16)[None], black_level=np.array([64.0]), white_level=4095
    )
