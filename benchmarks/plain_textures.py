"""Tables of plain textures: elements and regions of any size, probes, lights that overlap, a crack, interpolation.

Nothing but speckle and white noise: what is left is the solve's own.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from textures import Affine, Texture

from rgbmidic import Region, Tri3Mesh, correlate
from rgbmidic.correlation import Reference
from rgbmidic.fields import Displacement, NodalCovariance, difference_std, make_probe, reference_fraction
from rgbmidic.typing import FloatArray

from .tables import Row, table
from .uncertainty import covered, rms


@table("elements", page="explanation/uncertainty", cost=40, keys=3)
def elements(quick: bool) -> Iterator[Row]:
    """Error over stated uncertainty with elements and regions of any size, and the fraction of the noise's score that
    remains in the residual after the fit: plain texture at rest, noise of 8 % of its contrast, 12 draws.
    """
    image = 100 + 50 * _speckle(160, 3.5)
    cases = [(size, 160, lights) for size in (40, 25, 16, 12, 8, 6, 4) for lights in (1, 3)]
    cases += [(25, side, 3) for side in (16, 25, 40, 60)]
    for size, side, lights in [(25, 160, 1), (25, 25, 3)] if quick else cases:
        draws, corner = [], (160 - side) // 2
        for draw in range(12):
            random = np.random.default_rng(draw)
            first, second = (image + 4 * random.normal(size=(lights, 160, 160)) for _ in (0, 1))
            region = (corner, corner, corner + side - 1, corner + side - 1)
            draws.append(correlate(first, second, region=region, element_size=size, initial=(0.0, 0.0)))
        error, std = (np.array([getattr(one, name) for one in draws]) for name in ("displacement", "displacement_std"))
        ratio = error / std
        yield {
            "elements [px]": size,
            "region [px]": side,
            "lights": lights,
            "rms error [px]": rms(error),
            "error/stated": rms(ratio),
            "covered [%]": 100 * covered(ratio),
            "measured [%]": 100 * float(np.isfinite(ratio).mean()),
            "left by the fit": _unfitted(image, region, size),
        }


PLACES = {
    "point": ("point", (53.3, 47.1)),
    "line": ("line", (20, 20, 100, 100)),
    "circle": ("circle", (60, 60, 25)),
    "region": ("region", (30, 30, 100, 100)),
    "gauge": ("gauge", (33, 40, 100, 90)),
    "strain gauge of 3.2 elements": ("strain_gauge", (65, 60, 51)),
    "strain gauge of 5.4 elements": ("strain_gauge", (65, 60, 87)),
}
"""Probes on a region of 100 px: kind and place in px; elements have 16 px."""


@table("probes", page="explanation/uncertainty", cost=15, keys=2, own_quick=True)
def probes(quick: bool) -> Iterator[Row]:
    """Error over stated uncertainty of probes, and of their change from one frame to the next with the same reference:
    plain texture at rest, noise of 8 % of its contrast, 100 draws.
    """
    image, draws = 100 + 50 * _speckle(130, 3.5), []
    for draw in range(20 if quick else 100):
        random = np.random.default_rng(draw)
        first, *later = (image + 4 * random.normal(size=image.shape) for _ in range(3))
        states = [correlate(first, one, region=(15, 15, 114, 114), element_size=16, initial=(0, 0)) for one in later]
        draws.append(np.stack([np.concatenate([one.displacement.T, one.displacement_std.T]) for one in states], axis=1))
    covariance = NodalCovariance.from_mesh(Tri3Mesh(nodes=states[0].nodes, elements=states[0].elements))
    fields = np.stack(draws)
    for number, (title, (kind, place)) in enumerate(PLACES.items()):
        probe = make_probe(covariance, kind, number, place)
        read = [probe.histories(Displacement.in_plane(*draw[..., probe.nodes])) for draw in fields]
        for histories in zip(*read, strict=True):
            name = histories[0].name.removeprefix(f"{kind}_{number}_")
            # directions and invariants mean nothing without strain, a gauge's strain is its extension over its length
            if histories[0].unit == "deg" or name in ("e1", "e2", "shear", "equivalent", "strain"):
                continue
            error, std = (np.stack([getattr(one, part) for one in histories]) for part in ("values", "std"))
            change = (error[:, 1] - error[:, 0]) / difference_std(std[:, 0], std[:, 1], reference_fraction(1))
            yield {
                "probe": title,
                "quantity": name,
                "error/stated": rms(error / std),
                "covered [%]": 100 * covered(error / std),
                "change: error/stated": rms(change),
            }


ROTATING = "translation+rotation"
OVERLAPS = {"whole region": 999, "60 px": 30, "8 px": 4, "none": 0}
"""Half of what two neighbouring lights both see (px); none: they meet."""


@table("overlaps", page="explanation/uncertainty", cost=30, keys=3, seed=7)
def overlaps(quick: bool) -> Iterator[Row]:
    """Error over stated uncertainty if each light has its own rigid motion (`solver.rigid`) and neighbouring lights
    overlap by the stated width: plain texture, noise of 8 % of its contrast, 20 draws.
    """
    cases = [(name, lights, rigid) for name in OVERLAPS for lights, rigid in ((2, "translation"), (3, ROTATING))]
    for name, lights, rigid in cases[-2:-1] if quick else cases:
        shape, region, texture, random = (130, 220), (12, 12, 207, 117), Texture.random(3), np.random.default_rng(7)
        column, limits = np.arange(shape[1]), np.linspace(12, 208, lights + 1)
        low, high = [0, *(limits[1:-1] - OVERLAPS[name])], [*(limits[1:-1] + OVERLAPS[name]), 999]
        seen = [(column >= left) & (column < right) for left, right in zip(low, high, strict=True)]
        weights = np.array(seen, dtype=float)[:, None] * np.ones((shape[0], 1))
        motion = Affine.strain_and_rotation(0.003, 0.2, (0.3, -0.2))
        turns = random.uniform(-0.005, 0.005, lights) * (rigid == ROTATING)
        own = [
            Affine(
                shift=tuple(motion.shift + shift),
                gradient=tuple(map(tuple, motion.gradient + np.array([[0, -turn], [turn, 0]]))),
            )
            for shift, turn in zip(random.uniform(-0.6, 0.6, (lights, 2)), turns, strict=True)
        ]
        pair = [
            np.stack([texture.image(shape, one) for one in motions])
            for motions in ([Affine()] * lights, [motion, *own[1:]])
        ]
        ratios = []
        for _ in range(20):
            noisy = [images + random.normal(0, 4, images.shape) for images in pair]
            found = correlate(
                *noisy, region=region, element_size=20, weights=weights, rigid=rigid, initial=motion.shift
            )
            ratios.append((found.displacement - motion.displacement(found.nodes, shape)) / found.displacement_std)
        ratio = np.concatenate(ratios)
        yield {
            "overlap": name,
            "lights": lights,
            "motion of each": rigid,
            "error/stated": rms(ratio),
            "covered [%]": 100 * covered(ratio),
        }


BANDS = ((1, 30), (30, 60), (60, 100), (100, 150))
"""Distances from a crack (px); a node nearer than 1 px belongs to either side."""


@table("crack", page="explanation/uncertainty", cost=10, keys=2, seed=1)
def crack(quick: bool) -> Iterator[Row]:
    """Halves of a plate that move apart by 6 px each, without a stated crack, elements of 25 px: nodes measured at a
    distance from the crack, their rms error and rms stated uncertainty, and the error without a crack.
    """
    shape, middle, jump = (400, 400), 200, 6.0
    texture = Texture.random(8)
    first = texture.image(shape)
    halves = [texture.image(shape, Affine(shift=(0.3, v))) for v in (jump, -jump)]
    cracked = np.where(np.arange(shape[1]) < middle, *halves)
    for noise in (0.013,) if quick else (0.013, 0.07):
        random = np.random.default_rng(1)
        noisy = [image + random.normal(0, noise * texture.contrast, shape) for image in (first, cracked, halves[0])]
        found, whole = (correlate(noisy[0], noisy[n]) for n in (1, 2))
        apart = np.abs(found.nodes[:, 0] - middle)
        sign = np.where(found.nodes[:, 0] < middle, jump, -jump)
        error = found.displacement - np.stack([np.full(len(sign), 0.3), sign], axis=1)
        for low, high in BANDS:
            here, there = (apart >= low) & (apart < high), np.abs(whole.nodes[:, 0] - middle)
            usual = (whole.displacement - (0.3, jump))[(there >= low) & (there < high)]
            yield {
                "noise/contrast [%]": 100 * noise,
                "distance [px]": f"{low} to {high}",
                "measured [%]": 100 * float(found.measured[here].mean()),
                "rms error [px]": rms(error[here]),
                "stated [px]": rms(found.displacement_std[here]),
                "error without a crack [px]": rms(usual),
            }


NAMES = {"none": "no prefilter", "binomial": "binomial", "gaussian": "gaussian"}


@table("interpolation", page="explanation/uncertainty", cost=20, keys=1)
def interpolation(quick: bool) -> Iterator[Row]:
    """Bias of the displacement by interpolation: largest mean error over rigid shifts by tenths of a pixel, no noise,
    by width of the speckle and prefilter (the default is binomial).
    """
    shape, region = (200, 200), (20, 20, 180, 180)
    for speckle in (4.0,) if quick else (2.0, 2.5, 3.0, 4.0, 6.0):
        texture = Texture.random(0, speckle)
        reference, largest = texture.image(shape), dict[str, float]()
        for prefilter in NAMES:
            for tenths in range(11):
                motion = Affine(shift=(tenths / 10, 1 - tenths / 10))
                found = correlate(reference, texture.image(shape, motion), region=region, prefilter=prefilter)
                bias = np.abs((found.displacement - motion.shift).mean(axis=0)).max()
                largest[prefilter] = max(largest.get(prefilter, 0.0), float(bias))
        yield {"speckle [px]": speckle, **{f"{NAMES[name]} [px]": value for name, value in largest.items()}}


def _unfitted(image: FloatArray, region: tuple[int, int, int, int], size: float) -> float:
    """Fraction of the noise's score that the fit leaves in the residual."""
    place = Region.from_rectangle(region, image.shape)
    mesh = Tri3Mesh.from_region(place, size)
    return float(
        Reference.prepare(image[None].astype(np.float32), place, mesh=mesh, prefilter="binomial").residual_leverage
    )


def _speckle(size: int, width: float) -> FloatArray:
    """Gaussian speckle of unit contrast; `width` (px) of the autocorrelation at half maximum."""
    blurred = cv2.GaussianBlur(np.random.default_rng(5).normal(size=(size + 40, size + 40)), (0, 0), width / 3.33)
    return np.asarray(blurred[20:-20, 20:-20] / blurred.std())
