"""Brightness that changes between the states, borders of the frame and turns: plain textures, exactly rendered.

Each case is measured by the default of `correlate` and by that of `measure` (`measure_sequence` gives the same bits).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from textures import Affine, Texture

from rgbmidic import Solution, correlate, measure_sequence
from rgbmidic.typing import FloatArray

from .tables import Row, table
from .uncertainty import rms

SHAPE, REGION, NOISE = (300, 300), (20, 20, 280, 280), 2.0
MEAN, CONTRAST = 120.0, 40.0
SHIFT = (0.2, 0.3)
DRAWS = 2
DEFAULTS = ("correlate", "measure")


def measured_by(default: str, f: FloatArray, g: FloatArray, **options: Any) -> Solution:
    """One pair by the default of `correlate` or of `measure`."""
    if default == "correlate":
        return correlate(f, g, **options)
    return next(measure_sequence([g], reference=f, **options))


def noisy(image: FloatArray, deviation: float, seed: int) -> FloatArray:
    """The image with white noise."""
    return image + np.random.default_rng(seed).normal(0, deviation, image.shape)


def speckle(seed: int = 0, width: float = 4.0) -> Texture:
    """Mean 120, contrast 40 grey levels."""
    made = Texture.random(seed, width, contrast=CONTRAST)
    return Texture(waves=made.waves, phases=made.phases, mean=MEAN, contrast=CONTRAST)


@dataclass(frozen=True)
class Change:
    """A change of brightness, g = gain f + offset at each pixel of the deformed frame; of each light (k,) or pixel."""

    gain: FloatArray | float = 1.0
    offset: FloatArray | float = 0.0

    @property
    def noise(self) -> float:
        """Noise of the displacement over that without a change, if both images have the same noise."""
        return float(np.sqrt(np.mean((1 + 1 / np.asarray(self.gain) ** 2) / 2)))


def changes() -> dict[str, Change]:
    """The cases by name."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    found = {"none": Change()}
    found |= {f"gain {gain:g}": Change(gain=gain) for gain in (0.25, 0.5, 0.98, 1.5, 2.0, 4.0)}
    found |= {f"offset {offset:+g}": Change(offset=offset) for offset in (-25.0, 5.0, 25.0)}
    found["gain 0.7 offset +20"] = Change(0.7, 20.0)
    found["gain 0.7 to 1.3 across"] = Change(0.7 + 0.6 * x / SHAPE[1])
    found["offset 0 to 25 across"] = Change(1.0, 25 * x / SHAPE[1])
    found["edge of a shadow"] = Change(0.8 - 0.2 * np.tanh((x - 0.6 * y - 60) / 4))
    found["highlight of 40 px"] = Change(1.0, 60 * np.exp(-((x - 140) ** 2 + (y - 160) ** 2) / (2 * 40**2)))
    found["lamp's spot moved"] = Change(1.2 - 0.6 * ((x - 90) ** 2 + (y - 100) ** 2) / 290**2)
    found["flicker of three lamps"] = Change(np.array([0.7, 1.0, 1.3])[:, None, None])
    return found


def judged(found: list[Solution], truth: FloatArray | tuple[float, float]) -> Row:
    """Figures of one default over draws."""
    error = np.stack([one.displacement - truth for one in found])
    ratio = error / np.stack([one.displacement_std for one in found])
    return {
        "rms error [px]": rms(error) if np.isfinite(error).any() else float("nan"),
        "error/stated": rms(ratio) if np.isfinite(ratio).any() else float("nan"),
        "lost [%]": 100 * float(np.isnan(error[..., 0]).mean()),
        "iterations": float(np.mean([one.iterations for one in found])),
    }


def beside(found: dict[str, Row]) -> Row:
    """Columns of all defaults."""
    return {f"{name}: {column}": value for name, row in found.items() for column, value in row.items()}


@table("grey_levels", page="explanation/uncertainty", cost=40)
def grey_levels(quick: bool) -> Iterator[Row]:
    """Brightness that changes between the states (contrast 40, noise 2; shift of .2 and .3 px, elements of 25 px):
    error of the defaults of `correlate` and `measure`, as a multiple of that without a change times the noise that
    the gain adds; error over stated uncertainty; nodes without data; iterations. And coarse speckle under strain
    without one.
    """
    texture, without = speckle(), dict[str, float]()
    f, g = texture.image(SHAPE), texture.image(SHAPE, Affine(shift=SHIFT))
    for name, change in changes().items():
        if quick and name not in ("none", "gain 0.98"):
            continue
        gain = np.asarray(change.gain)
        lights = (len(gain), 1, 1) if gain.ndim == 3 else (1, 1)
        first, second = np.broadcast_to(f, (*lights[:-2], *SHAPE)), gain * g + change.offset
        found = {}
        for default in DEFAULTS:
            options = {"region": REGION, "element_size": 25}
            solutions = [
                measured_by(default, noisy(first, NOISE, draw), noisy(second, NOISE, 50 + draw), **options)
                for draw in range(DRAWS)
            ]
            row = judged(solutions, SHIFT)
            without.setdefault(default, row["rms error [px]"])
            few = 1 / np.sqrt(len(gain)) if gain.ndim == 3 else 1.0
            found[default] = {"over expected": row["rms error [px]"] / (without[default] * change.noise * few)} | row
        yield {"case": name} | beside(found)
    for width, noise in () if quick else ((5.0, 0.0), (5.0, 1.0), (10.0, 0.0), (10.0, 1.0), (20.0, 0.0), (20.0, 1.0)):
        texture, motion = Texture.random(3, width, contrast=1.0), Affine(gradient=((1.02, 0), (0, 0.99)))
        shape, found = (400, 400), {}
        f, g = (120 + 90 * np.tanh(2 * (texture.image(shape, one) - 200)) for one in (None, motion))
        for default in DEFAULTS:
            solution = measured_by(
                default, np.round(noisy(f, noise, 1)), np.round(noisy(g, noise, 2)), region=(40, 40, 350, 350),
                element_size=25,
            )  # fmt: skip
            row = judged([solution], motion.displacement(solution.nodes, shape))
            found[default] = {"over expected": float("nan")} | row
        yield {"case": f"blobs of {width:g} px under 2 % strain and noise {noise:g}"} | beside(found)


BANDS = {"beyond": (-99, 0), "on it (< 1 px)": (0, 1), "1 to 25 px": (1, 25), "deeper": (25, 999)}


@table("frame_border", page="explanation/uncertainty", cost=30, keys=2)
def frame_border(quick: bool) -> Iterator[Row]:
    """Nodes near the border of the frame in either state: the whole frame (320 x 240 px) as region, elements of 20 px,
    noise of 2.5 % of the contrast, shifts along x; and stretch by 1.3 along y that takes nodes out of the frame."""
    shape = (240, 320)
    motions = {f"shift {u:g} px": Affine(shift=(u, 0)) for u in (0, 0.5, 6, 20)}
    motions["stretch 1.3"] = Affine(gradient=((1.3**-0.5, 0), (0, 1.3)))
    motions["shift 20 px and vignetting"] = Affine(shift=(20, 0))
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    dim = 1.1 - 0.6 * (((x - 160) / 200) ** 2 + ((y - 120) / 200) ** 2)
    for name, motion in motions.items():
        if quick and name != "shift 6 px":
            continue
        parts: dict[tuple[str, str], list[tuple[FloatArray, FloatArray]]] = {}
        for seed in range(3):
            texture, light = speckle(100 + seed), dim if "vignetting" in name else 1.0
            f, g = (noisy(light * texture.image(shape, one), 1, n + 10 * seed) for n, one in enumerate((None, motion)))
            region = (20, 20, 300, 220) if name == "stretch 1.3" else (0, 0, shape[1] - 1, shape[0] - 1)
            for default in DEFAULTS:
                solution = measured_by(default, f, g, region=region, element_size=20)
                u = motion.displacement(solution.nodes, shape)
                error, both = solution.displacement - u, np.stack([solution.nodes, solution.nodes + u])
                depth = np.minimum(both, np.array(shape)[::-1] - 1 - both).min(axis=(0, 2))
                for band, (low, high) in BANDS.items():
                    here = (depth >= low) & (depth < high)
                    parts.setdefault((band, default), []).append((error[here], solution.displacement_std[here]))
        for band in BANDS:
            row: Row = {"motion": name, "distance": band}
            for default in DEFAULTS:
                error, std = (np.concatenate(part) for part in zip(*parts[band, default], strict=True))
                if not len(error):
                    break
                some = np.isfinite(error).any()
                row |= {
                    "nodes": len(error),
                    f"{default}: measured [%]": 100 * float(np.isfinite(error[:, 0]).mean()),
                    f"{default}: rms error [px]": rms(error) if some else float("nan"),
                    f"{default}: largest [px]": float(np.nanmax(np.abs(error))) if some else float("nan"),
                    f"{default}: error/stated": rms(error / std) if some else float("nan"),
                }
            else:
                yield row


@table("background_at_rest", page="explanation/uncertainty", cost=15, keys=1)
def background_at_rest(quick: bool) -> Iterator[Row]:
    """A specimen that moves by 3 px along y beside a background at rest, both in the frame, elements of 20 px: error of
    nodes on its edge and of those deeper than 25 px."""
    shape = (240, 320)
    material, ground = speckle(5), speckle(6)
    x = np.arange(shape[1])
    inside = (x >= 60) & (x <= 259)
    rest = ground.image(shape)
    grounds = {"textured": rest, "dark": np.full(shape, 10.0), "bright": np.full(shape, 240.0)}
    for name in ("textured",) if quick else grounds:
        f, g = (
            noisy(np.where(inside, material.image(shape, one), grounds[name]), 1, n)
            for n, one in enumerate((None, Affine(shift=(0, 3))))
        )
        row: Row = {"background": name}
        for default in DEFAULTS:
            solution = measured_by(default, f, g, region=(60, 20, 259, 219), element_size=20)
            error, depth = solution.displacement - (0, 3), np.minimum(*np.abs(solution.nodes[:, :1] - (60, 259)).T)
            for place, here in {"edge": depth < 1, "inside": depth > 25}.items():
                row |= {
                    f"{default}: {place} [px]": rms(error[here]),
                    f"{default}: {place} error/stated": rms(error[here] / solution.displacement_std[here]),
                }
        yield row


@table("turned", page="explanation/uncertainty", cost=20, keys=3)
def turned(quick: bool) -> Iterator[Row]:
    """Turns: a directional speckle (4 times as long along x as along y) with noise, by the angle; and an exact copy of
    a plain one turned by 180 degrees, by the size of the elements.
    """
    shape = (300, 300)
    plain = speckle()
    waves = Texture.random(0, 2.0).waves * (0.25, 1.0)
    streaky = Texture(waves=waves, phases=plain.phases, mean=MEAN, contrast=CONTRAST)
    cases = [("directional", degrees, 20, streaky, (80, 80, 219, 219), 2.0) for degrees in (0, 20, 45, 90, 180)]
    cases += [("exact copy", 180, size, plain, (20, 20, 279, 279), 0.0) for size in (12, 25, 50)]
    for name, degrees, size, texture, region, noise in cases[3:4] if quick else cases:
        motion, row = Affine.strain_and_rotation(0, degrees), {"speckle": name, "turn [deg]": degrees, "elements": size}
        f, g = (noisy(texture.image(shape, one), noise, n) for n, one in enumerate((None, motion)))
        for default in DEFAULTS:
            found = measured_by(default, f, g, region=region, element_size=size)
            error = found.displacement - motion.displacement(found.nodes, shape)
            row |= {
                f"{default}: rms error [px]": rms(error),
                f"{default}: largest [px]": float(np.nanmax(np.abs(error), initial=0)),
            }
            for axis, component in enumerate("uv"):
                ratio = rms(error[:, axis] / found.displacement_std[:, axis]) if noise else float("nan")
                row[f"{default}: {component} error/stated"] = ratio
        yield row
