"""Keypoints of a state's picture, and the pairs of them that two states share, whatever their turn and size.

The lights' images are locally normalised (so that reflections and shading weigh little) and averaged into one picture
per state. Its keypoints (SIFT: Lowe, Int. J. Comput. Vision 60, 2004) are paired by their descriptors, which change
little under shift, rotation and moderate strain. A pair tells how its surroundings turn and stretch; it counts if the
pairs around it have moved accordingly.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["Box", "Keypoints", "pairs"]

_NORMALISE = 6.0
"""Standard deviation of the local mean and contrast, px of the reduced picture."""
_FLAT = 0.1
"""Contrast that is not amplified further, over that of the most contrasted tenth of the picture."""
_GREY = 40
"""Grey levels of the picture's local standard deviation: three of them fit into 8 bits."""
_CONTRAST = 0.06
"""SIFT's threshold: lower ones add keypoints that noise makes, at .12 a jittered lattice loses most (measured)."""
_VOTERS = 30
"""Pairs around a pair that are asked..."""
_VOTES = 4
"""...and how many must agree: with wrong pairs in a picture of 1 Mpx it happens to one in 1000 by chance."""
_TOLERANCE = 0.3
"""Disagreement over distance that angle and size of a keypoint are good for, strains of 20 % included."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """A rectangular part of an image: first row and column, and those after the last."""

    top: int
    left: int
    bottom: int
    right: int

    @classmethod
    def around(cls, points: FloatArray, margin: float, shape: tuple[int, ...]) -> Box:
        """The part of an image of `shape` (H, W) within `margin` px of points (N, 2) in x and y."""
        left, top = np.floor(points.min(axis=0) - margin).astype(int)
        right, bottom = np.ceil(points.max(axis=0) + margin).astype(int) + 1
        height, width = shape
        return cls(
            top=min(max(top, 0), height),
            left=min(max(left, 0), width),
            bottom=max(min(bottom, height), 0),
            right=max(min(right, width), 0),
        )

    @property
    def area(self) -> int:
        """Pixels; 0 for a box beside the image."""
        return max(self.bottom - self.top, 0) * max(self.right - self.left, 0)

    def cut(self, image: FloatImage, step: int) -> FloatImage:
        """The box's part of an image (H, W), its sides whole multiples of `step`."""
        height, width = (size // step * step for size in (self.bottom - self.top, self.right - self.left))
        return image[self.top : self.top + height, self.left : self.left + width]


@dataclass(frozen=True, slots=True, kw_only=True)
class Keypoints:
    """Keypoints, the strongest first.

    Attributes
    ----------
    points : ndarray, shape (M, 2)
        px of the image.
    size, angle : ndarray, shape (M,)
        In px and rad.
    descriptors : ndarray, shape (M, 128), float32
        Whole numbers, the norm about 512.
    """

    points: FloatArray
    size: FloatArray
    angle: FloatArray
    descriptors: FloatImage

    @classmethod
    def find(cls, images: FloatImage, weights: FloatImage, box: Box, reduction: int, most: int) -> Keypoints:
        """The `most` strongest in a part of images (k, H, W), reduced `reduction` times, where weights (k, H, W)
        are not 0."""
        picture, seen = _picture(images, weights, box, reduction)
        if min(picture.shape) < 2 * _NORMALISE:
            return cls._empty()
        grey = np.clip(128 + _GREY * picture, 0, 255).astype(np.uint8)
        # the precise upscale keeps positions free of a bias of a quarter of a pixel
        sift = cv2.SIFT.create(contrastThreshold=_CONTRAST, enable_precise_upscale=True)
        found = sift.detect(grey, None)
        columns, rows = np.round(cv2.KeyPoint.convert(found)).astype(int).reshape(-1, 2).T
        strength = np.where(seen[rows, columns] > 0, [key.response for key in found], 0.0)
        strongest = np.argsort(-strength, kind="stable")[: min(most, np.count_nonzero(strength))]
        if not len(strongest):
            return cls._empty()
        chosen, descriptors = sift.compute(grey, [found[number] for number in strongest])
        return cls(
            points=np.asarray(cv2.KeyPoint.convert(chosen), dtype=np.float64) * reduction
            + (reduction - 1) / 2
            + (box.left, box.top),
            size=np.array([key.size for key in chosen]),
            angle=np.radians([key.angle for key in chosen]),
            descriptors=np.asarray(descriptors, dtype=np.float32),
        )

    @classmethod
    def _empty(cls) -> Keypoints:
        none = np.zeros(0)
        return cls(points=np.zeros((0, 2)), size=none, angle=none, descriptors=np.zeros((0, 128), dtype=np.float32))


def pairs(first: Keypoints, second: Keypoints, tolerance: float) -> tuple[FloatArray, FloatArray]:
    """Points (P, 2) of `first` and their motion (P, 2) in px to `second`: mutually nearest descriptors whose angle and
    size tell, within `tolerance` px and a share of the distance, where some of the pairs around them have gone."""
    here, there = _nearest(first, second)
    if len(here) <= _VOTES:
        return np.zeros((0, 2)), np.zeros((0, 2))
    points, motion = first.points[here], second.points[there] - first.points[here]
    around = np.asarray(cKDTree(points).query(points, k=min(_VOTERS + 1, len(points)))[1])[:, 1:]
    step = points[around] - points[:, None]
    scale, turn = second.size[there] / first.size[here], second.angle[there] - first.angle[here]
    cos, sin = (scale * np.cos(turn))[:, None], (scale * np.sin(turn))[:, None]
    turned = np.stack([cos * step[..., 0] - sin * step[..., 1], sin * step[..., 0] + cos * step[..., 1]], axis=-1)
    off = np.linalg.norm(motion[around] - motion[:, None] - (turned - step), axis=-1)
    votes = (off <= tolerance + _TOLERANCE * np.linalg.norm(step, axis=-1)).sum(axis=1)
    return points[votes >= _VOTES], motion[votes >= _VOTES]


def _nearest(first: Keypoints, second: Keypoints) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Numbers of the mutually nearest descriptors."""
    if not len(first.points) or not len(second.points):
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    # sums of products of whole numbers under 2^24: exact in float32, hence the same in any order and on any threads
    likeness = first.descriptors @ second.descriptors.T
    there = likeness.argmax(axis=1)
    back = np.asarray(likeness.argmax(axis=0))
    here = np.flatnonzero(back[there] == np.arange(len(there)))
    return here, there[here]


def _picture(images: FloatImage, weights: FloatImage, box: Box, reduction: int) -> tuple[FloatImage, FloatImage]:
    """Mean over the lights of the locally normalised images of a box, reduced in size, and the sum of the weights."""
    height, width = box.cut(images[0], reduction).shape
    size = (width // reduction, height // reduction)
    total, seen = np.zeros((2, *size[::-1]), dtype=np.float32)
    if not total.size:
        return total, seen
    for image, weight in zip(images, weights, strict=True):
        used = box.cut(weight, reduction)
        share = cv2.resize(used, size, interpolation=cv2.INTER_AREA)
        values = cv2.resize(box.cut(image, reduction) * used, size, interpolation=cv2.INTER_AREA)
        total += share * _normalised(np.asarray(values / np.maximum(share, np.float32(1e-6))), np.asarray(share))
        seen += share
    return np.asarray(total / np.maximum(seen, np.float32(1e-6))), seen


def _normalised(image: FloatImage, weight: FloatImage) -> FloatImage:
    """An image (H, W) less its local mean, over its local standard deviation."""
    norm = _blur(weight) + np.float32(1e-6)
    centred = image - _blur(image * weight) / norm
    contrast = np.sqrt(_blur(centred * centred * weight) / norm)
    return np.asarray(centred / (contrast + np.float32(_FLAT * np.quantile(contrast, 0.9) + 1e-20)), dtype=np.float32)


def _blur(image: FloatImage) -> FloatImage:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _NORMALISE, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)
