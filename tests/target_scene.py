"""A virtual camera with a lens, and a target or a specimen on a tilted plane before it."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from scipy.special import erf

from rgbmidic.fields.plane import distorted, undistorted
from rgbmidic_calibration.target import Target, View

SHAPE = (480, 640)
TARGET = Target.parse("chessboard:9x7:5mm")
LENS = np.array([2400.0, 327.0, 232.0, -0.5, 0, 0, 0, 0])
DISTANCE = 2400 * 60 / 640
"""mm at which 60 mm fill the frame's width."""
NOISE = 0.03


def pose(tilt_x: float, tilt_y: float = 0.0, turn: float = 0.0, shift: tuple[float, float] = (0, 0), far: float = 1.0):
    """Rotation (3, 3) and translation (3,) of the target's middle."""
    return cv2.Rodrigues(np.radians([tilt_x, tilt_y, turn]))[0], np.array([*shift, DISTANCE * far])


def imaged(points, where, lens=LENS):
    """Points (n, 2) of the target, from its middle, in px."""
    rotation, shift = where
    there = np.c_[points, np.zeros(len(points))] @ rotation.T + shift
    return distorted(lens, lens[0] * there[:, :2] / there[:, 2:] + lens[1:3])


def on_plane(pixels, where, lens=LENS):
    """The inverse of `imaged`."""
    return _traced(undistorted(lens, pixels), where, lens)


def frame_on_plane(where, lens=LENS):
    """`on_plane` at all pixels of the frame, row by row."""
    return _traced(_undistorted_frame(tuple(lens)), where, lens)


@cache
def _undistorted_frame(lens):
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return undistorted(np.array(lens), np.stack([x.ravel(), y.ravel()], axis=1).astype(float))


def _traced(pixels, where, lens):
    rotation, shift = where
    rays = np.c_[(pixels - lens[1:3]) / lens[0], np.ones(len(pixels))]
    normal = rotation[:, 2]
    return ((rays * ((normal @ shift) / (rays @ normal))[:, None] - shift) @ rotation)[:, :2]


def view_of(where, random, target=TARGET, lens=LENS, noise=NOISE, name="view"):
    points = target.points - target.points.mean(axis=0)
    pixels = imaged(points, where, lens)
    return View(name=name, points=target.points, pixels=pixels + random.normal(0, noise, pixels.shape), shape=SHAPE)


def random_views(random, count=10, lens=LENS, tilt=25.0, noise=NOISE):
    views = []
    while len(views) < count:
        where = pose(
            *random.uniform(-tilt, tilt, 2), random.uniform(-20, 20), random.uniform(-8, 8, 2), 1.2 * lens[0] / LENS[0]
        )
        view = view_of(where, random, lens=lens, noise=noise, name=f"view {len(views)}")
        if (view.pixels > 2).all() and (view.pixels < np.array(SHAPE[::-1]) - 3).all():
            views.append(view)
    return views


def photo(where, random=None, blur=0.9, level=180.0, lens=LENS, target=TARGET):
    """Photograph of a chessboard, its edges blurred by `blur` px, with noise of one grey level."""
    places = frame_on_plane(where, lens) + target.points.mean(axis=0)
    width = blur * DISTANCE / lens[0] * np.sqrt(2)

    def wave(place):
        number = np.floor(place / target.spacing + 0.5)
        return np.where(number % 2 == 0, 1, -1) * erf((place - number * target.spacing) / width)

    size = np.array([target.columns, target.rows]) * target.spacing
    inside = ((places > -target.spacing) & (places < size)).all(axis=1)
    values = np.where(inside, -wave(places[:, 0]) * wave(places[:, 1]), 1.0).reshape(SHAPE)
    image = 20 + level * (0.55 + 0.45 * values)
    return image + (0 if random is None else random.normal(0, 1, SHAPE))
