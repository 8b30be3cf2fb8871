"""Two cameras before a flat speckled plate that turns, moves and stretches: images in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.special import erf

from rgbmidic import CameraCalibration
from rgbmidic.fields.plane import undistorted
from rgbmidic.frames.data import ChannelFrame
from rgbmidic.frames.images import write_tiff
from rgbmidic.tools.stereo import CameraPair

SHAPE = (120, 160)
DISTANCE = 400.0
FOCAL = 2000.0
PITCH = DISTANCE / FOCAL
"""mm per px."""
EDGE = 1.0
"""Where the plate's step lies in its own x (mm), between the nodes of elements of 20 px."""


def turn(*degrees: float):
    return np.asarray(cv2.Rodrigues(np.radians(degrees))[0])


def pair_of(angle: float = 20.0, lens=(FOCAL, 79.5, 59.5, 0, 0, 0, 0, 0), **changes) -> CameraPair:
    """Cameras on a circle around (0, 0, DISTANCE), `angle` degrees apart."""
    camera = CameraCalibration(shape=SHAPE, lens=np.array(lens))
    rotation, pivot = turn(0, -angle, 0), np.array([0, 0, DISTANCE])
    rest = {"rotation": np.radians([0, -angle, 0]), "translation": pivot - rotation @ pivot}
    return CameraPair(**{"left": camera, "right": camera, **rest, **changes})


@dataclass(frozen=True)
class Motion:
    """The plate at a place: `stretch` (2, 2) of its material, then rotation and translation (mm).

    Beyond `EDGE` it lies `step` mm deeper.
    """

    stretch: tuple = ((1.0, 0.0), (0.0, 1.0))
    degrees: tuple = (0.0, 0.0, 0.0)
    translation: tuple = (0.0, 0.0, 0.0)
    step: float = 0.0

    @property
    def attitude(self):
        return turn(*self.degrees) @ turn(4.0, 11.0, 0.0)

    def points(self, material):
        """Points (N, 3) of material ones (N, 2), left camera's axes."""
        flat = np.c_[material @ np.array(self.stretch).T, np.where(material[:, 0] > EDGE, self.step, 0.0)]
        return flat @ self.attitude.T + self.translation + np.array([0, 0, DISTANCE])

    def material(self, pair: CameraPair, side: int, pixels):
        """Material points (N, 2) that a camera sees at pixels."""
        lens, (rotation, shift) = pair.cameras[side].lens, pair.poses[side]
        rays = np.c_[(undistorted(lens, pixels) - lens[1:3]) / lens[0], np.ones(len(pixels))] @ rotation
        centre = (-rotation.T @ shift - self.translation - np.array([0, 0, DISTANCE])) @ self.attitude
        rays = rays @ self.attitude
        front, rear = (
            (centre + rays * ((depth - centre[2]) / rays[:, 2])[:, None])[:, :2] @ np.linalg.inv(self.stretch).T
            for depth in (0.0, self.step)
        )
        rear[:, 0] = np.maximum(rear[:, 0], EDGE)  # the wall of the step
        return np.where(front[:, :1] <= EDGE, front, rear)


def image(pair: CameraPair, side: int, motion: Motion = Motion(), seed: int = 0, shape=SHAPE):
    """Grey levels (H, W), mean 2000, of a sum of waves 5 px long and longer."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    material = motion.material(pair, side, np.stack([x.ravel(), y.ravel()], axis=1).astype(float)) / PITCH
    random = np.random.default_rng(seed)
    length, angle, phase = random.uniform(6, 14, 60), random.uniform(0, np.pi, 60), random.uniform(0, 2 * np.pi, 60)
    wave = 2 * np.pi / length * np.stack([np.cos(angle), np.sin(angle)])
    return (2000 + 90 * np.cos(material @ wave + phase).sum(axis=1)).reshape(shape)


MOTIONS = (
    Motion(),
    Motion(degrees=(0.5, 1.0, -0.4), translation=(0.1, -0.05, 0.3)),
    Motion(stretch=((1.01, 0.004), (0.0, 0.995)), degrees=(1.0, -2.0, 0.5), translation=(0.2, 0.1, -0.4)),
)


def write_tests(folder: Path, pair: CameraPair, motions=MOTIONS, sigma: float = 8.0) -> tuple[Path, Path, Path]:
    """Write a monochrome test of each camera and the cameras' file; return their paths."""
    random, tests = np.random.default_rng(7), []
    for side, name in enumerate(("left", "right")):
        (folder / name).mkdir(parents=True)
        for number, motion in enumerate(motions):
            values = np.rint(image(pair, side, motion) + random.normal(scale=sigma, size=SHAPE)).clip(0, 4095)
            frame = ChannelFrame(values=values.astype(np.uint16)[None], black_level=np.array(0.0), white_level=4095)
            write_tiff(folder / name / f"frame_{number}.tif", frame)
        region = "[12, 12, 147, 107]" if side == 0 else f"[0, 0, {SHAPE[1] - 1}, {SHAPE[0] - 1}]"
        tests.append(folder / name / "TEST.toml")
        text = '[frames]\npath = "frame_*.tif"\nkind = "monochrome"\nblack_level = 0\nwhite_level = 4095\n'
        tests[-1].write_text(f"{text}[region]\nrectangle = {region}\n[mesh]\nelement_size = 16\n", encoding="utf-8")
    pair.write(folder / "stereo.json")
    return tests[0], tests[1], folder / "stereo.json"


def photograph(pair: CameraPair, side: int, rotation, translation):
    """Photograph (H, W) of a chessboard of 6 x 5 inner corners, 3 mm apart, with edges blurred by .9 px."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    lens, (turned, shift) = pair.cameras[side].lens, pair.poses[side]
    pixels = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
    rays = np.c_[(undistorted(lens, pixels) - lens[1:3]) / lens[0], np.ones(len(pixels))] @ turned
    centre = -turned.T @ shift - translation
    normal = rotation[:, 2]
    places = ((centre - rays * ((normal @ centre) / (rays @ normal))[:, None]) @ rotation)[:, :2] + [7.5, 6.0]
    number = np.floor(places / 3.0 + 0.5)
    waves = np.where(number % 2 == 0, 1, -1) * erf((places - 3.0 * number) / (0.9 * PITCH * np.sqrt(2)))
    inside = ((places > -3.0) & (places < [18.0, 15.0])).all(axis=1)
    return (400 + 2400 * (0.55 + 0.45 * np.where(inside, -waves.prod(axis=1), 1.0))).reshape(SHAPE)


def write_photographs(folder: Path, pair: CameraPair, count: int = 10) -> None:
    """Write simultaneous photographs of the board by both cameras, at different angles."""
    random = np.random.default_rng(3)
    folder.mkdir()
    for number in range(count):
        rotation = turn(0, 10, 0) @ turn(*random.uniform(-35, 35, 2), random.uniform(-10, 10))
        translation = np.array([*random.uniform(-1.5, 1.5, 2), DISTANCE])
        for side, name in enumerate(("left", "right")):
            values = photograph(pair, side, rotation, translation) + random.normal(scale=8, size=SHAPE)
            frame = ChannelFrame(
                values=np.rint(values).clip(0, 4095).astype(np.uint16)[None],
                black_level=np.array(0.0),
                white_level=4095,
            )
            write_tiff(folder / f"{name}_{number:02}.tif", frame)
