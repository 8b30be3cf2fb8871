"""Velocity and acceleration of signals with a known truth: error over stated uncertainty, false motion, noise, time.

The constants of `rgbmidic/_kernels/rates.py` were chosen on other signals, but for the highest degree and the least
probability that counts.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rgbmidic.fields import Field, rates
from rgbmidic.typing import BoolArray, FloatArray

from .tables import table

FRAMES, WINDOW, EDGE = 61, 7, 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Signal:
    """Displacement (T,) in px over the times in frames, its rates, and when the motion sets in (None: it is smooth)."""

    times: FloatArray
    value: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    onset: float | None = None
    lost: tuple[int, ...] = ()

    @property
    def kink(self) -> int | None:
        """The frame at which the motion sets in, where there is one."""
        hit = [] if self.onset is None else np.flatnonzero(self.times == self.onset)
        return int(hit[0]) if len(hit) else None


def moving(t: FloatArray, onset: float, speed: float, **options: tuple[int, ...]) -> Signal:
    """Rest, then a uniform velocity."""
    on = t > onset
    return Signal(
        times=t, value=speed * on * (t - onset), velocity=speed * on, acceleration=0 * t, onset=onset, **options
    )


def pushed(t: FloatArray, onset: float, push: float) -> Signal:
    """Rest, then a uniform acceleration."""
    past = np.maximum(t - onset, 0)
    return Signal(times=t, value=push * past**2 / 2, velocity=push * past, acceleration=push * (t > onset), onset=onset)


def struck(t: FloatArray, onset: float, push: float, length: float) -> Signal:
    """Rest, then a half-sine pulse of acceleration, then a uniform velocity."""
    x, w = np.clip(t - onset, 0, length), np.pi / length
    value = push / w * (x - np.sin(w * x) / w + 2 * np.maximum(t - onset - length, 0))
    velocity, acceleration = push / w * (1 - np.cos(w * x)), push * np.sin(w * x) * (x < length)
    return Signal(times=t, value=value, velocity=velocity, acceleration=acceleration, onset=onset)


def swing(t: FloatArray, reach: float, period: float) -> Signal:
    """A smooth swing."""
    w = 2 * np.pi / period
    s, c = reach * np.sin(w * t + 0.3), reach * np.cos(w * t + 0.3)
    return Signal(times=t, value=s, velocity=w * c, acceleration=-w * w * s)


def wave(t: FloatArray, height: float, length: float) -> Signal:
    """A step that passes smoothly."""
    x = np.tanh((t - 30.2) / length)
    slope = height / (2 * length) * (1 - x * x)
    return Signal(times=t, value=height * x / 2, velocity=slope, acceleration=-2 * slope * x / length)


def signals() -> Iterator[tuple[str, Signal]]:
    """The signals by name."""
    t = np.arange(FRAMES, dtype=np.float64)
    uneven = np.cumsum(np.random.default_rng(3).uniform(0.5, 1.5, FRAMES))
    gaps = (8, 19, 27, 28, 33, 34, 45)
    for speed in (0.02, 0.1, 1.0, 5.0):
        for onset in (30.0, 30.4):
            yield f"kink {speed:g} at {onset:g}", moving(t, onset, speed)
    for speed in (0.05, 0.2, 2.0):
        yield f"kink {speed:g}, uneven", moving(uneven, float(uneven[30]), speed)
        yield f"kink {speed:g}, lost", moving(t, 31.0, speed, lost=gaps)
    yield "pulse .3, 12", struck(t, 30.0, 0.3, 12)
    yield "pulse .15, 9", struck(t, 29.3, 0.15, 9)
    yield "pulse .8, 16", struck(t, 27.0, 0.8, 16)
    for push in (0.01, 0.05, 0.1, 0.4):
        yield f"step {push:g}", pushed(t, 30.0, push)
    yield "step .07 at 30.6", pushed(t, 30.6, 0.07)
    yield "swing 10, 40", swing(t, 10.0, 40.0)
    yield "swing 4, 30", swing(t, 4.0, 30.0)
    yield "swing, uneven", swing(uneven, 6.0, 50.0)
    yield "wave 1, 3", wave(t, 1.0, 3.0)
    yield "wave 3, 4.5", wave(t, 3.0, 4.5)
    yield "fall .05", Signal(times=t, value=0.025 * t * t, velocity=0.05 * t, acceleration=0.05 + 0 * t)
    yield "rest", Signal(times=t, value=0 * t, velocity=0 * t, acceleration=0 * t)


def fixed(times: FloatArray, values: FloatArray, known: BoolArray) -> FloatArray:
    """Velocity and acceleration of one parabola over each window, and their noise for 1 px (2, 2, T, draws)."""
    out = np.full((2, 2, *values.shape), np.nan)
    reach = 1.01 * (WINDOW - 1)
    for i, now in enumerate(times):
        first = np.clip(now - reach / 2, times[0], times[-1] - reach)
        part = known & (times >= first) & (times <= first + reach)
        rows = np.linalg.pinv((times[part] - now)[:, None] ** np.arange(3.0))[1:] * [[1], [2]]
        out[:, 0, i], out[:, 1, i] = rows @ values[part], np.linalg.norm(rows, axis=1)[:, None]
    return out


@dataclass(frozen=True)
class Verdict:
    """What the draws of a signal give for one rate.

    Attributes
    ----------
    ratio
        Of every frame but the ends' and that of a kink itself: rms(error / stated).
    near, far
        Largest estimate over stated where the body is at rest, within a window of the onset and elsewhere; NaN: never.
    near_parabola
        What one parabola over each window makes of `near`.
    noise
        rms error at rest over that of the parabola.
    """

    ratio: FloatArray
    near: float
    far: float
    near_parabola: float
    noise: float


def judge(signal: Signal, noise: float, draws: int, seed: int, stated: float | None = None) -> list[Verdict]:
    """Verdicts on velocity and acceleration, windows of 7 frames; `stated` is not the noise where that is unknown."""
    random = np.random.default_rng([seed, round(noise * 1e6)])
    known = np.isin(np.arange(len(signal.times)), signal.lost, invert=True)
    values = signal.value[:, None] + noise * random.normal(size=(len(signal.times), draws))
    own = np.where(known[:, None], values, np.nan)
    still: BoolArray = np.zeros(len(signal.times), dtype=bool)
    std = np.full(own.shape, stated or noise)
    found = rates(
        signal.times, Field(name="u", values=own, std=std), window=WINDOW - 1.0, common_fraction=0.0, references=still
    )
    plain = fixed(signal.times, values, known)
    at_rest = signal.times <= (np.inf if signal.onset is None else signal.onset)
    if not (signal.velocity[at_rest] == 0).all():
        at_rest[:] = False
    away = at_rest & (signal.times < (signal.times[-1] if signal.onset is None else signal.onset - WINDOW))
    inner = np.zeros(len(signal.times), dtype=bool)
    inner[EDGE:-EDGE] = True
    if signal.kink is not None:
        inner[signal.kink] = False
    quiet, beside, verdicts = away & inner, at_rest & ~away & inner, []
    for order, name in enumerate(("velocity", "acceleration")):
        error = found[name].values - getattr(signal, name)[:, None]
        false = np.abs(found[name].values / found[name].uncertainty).max(axis=1)
        parabola = np.abs(plain[order, 0] / plain[order, 1] / noise).max(axis=1)
        power = (np.mean(way[quiet] ** 2) if quiet.any() else np.nan for way in (found[name].values, plain[order, 0]))
        verdicts.append(
            Verdict(
                ratio=np.sqrt(np.mean((error / found[name].uncertainty) ** 2, axis=1))[inner],
                near=float(false[beside].max()) if beside.any() else np.nan,
                far=float(false[quiet].max()) if quiet.any() else np.nan,
                near_parabola=float(parabola[beside].max()) if beside.any() else np.nan,
                noise=float(np.sqrt(np.divide(*power))),
            )
        )
    return verdicts


GROUPS = {
    "kinks of .02 to 5 px a frame": ("kink",),
    "steps of acceleration and pulses to .3 px a square frame": ("step", "pulse .3", "pulse .15"),
    "pulse of .8 px a square frame in 16 frames": ("pulse .8",),
    "smooth motion": ("swing", "wave", "fall"),
    "rest": ("rest",),
}
"""Signals by the first words of their names."""


@table("rates", page="how-to/results", cost=5, seed=20261)
def rates_of_known_motion(quick: bool) -> Iterator[dict[str, object]]:
    """Velocity and acceleration over 7 frames of motions with noise of .005 and .015 px, 61 frames, 200 draws:
    rms(error / stated) of the worst frame and of all, frames where it is over 1.3; largest estimate over stated of a
    body at rest within 7 frames of an onset, the same by one parabola, and further away."""
    for group, names in GROUPS.items():
        if quick and not group.startswith("pulse"):
            continue
        judged = [
            judge(signal, noise, 200, 20261)
            for name, signal in signals()
            if name.startswith(names)
            for noise in (0.005, 0.015)
        ]
        for rate, found in zip(("velocity", "acceleration"), zip(*judged, strict=True), strict=True):
            ratios = np.concatenate([one.ratio for one in found])
            yield {
                "motion": group,
                "rate": rate,
                "worst frame": float(ratios.max()),
                "all frames": float(np.sqrt(np.mean(ratios**2))),
                "over 1.3 [%]": round(100 * float((ratios > 1.3).mean())),
                "at rest near an onset": float(np.max([one.near for one in found])),
                "the same by a parabola": float(np.max([one.near_parabola for one in found])),
                "at rest further away": float(np.max([one.far for one in found])),
            }


@table("rates_noise", page="how-to/results", cost=1, seed=20261)
def rates_of_noise(quick: bool) -> Iterator[dict[str, object]]:
    """A body at rest whose noise is a multiple of the stated uncertainty of its displacement: rms(error / stated) of
    its rates, and their noise over that of one parabola over 7 frames."""
    rest = dict(signals())["rest"]
    for factor in (1.0, 1.2, 1.5, 2.0):
        velocity, acceleration = judge(rest, 0.01 * factor, 200, 20261, stated=0.01)
        yield {
            "noise over stated": f"{factor:g}",
            "velocity: error/stated": float(np.sqrt(np.mean(velocity.ratio**2))),
            "acceleration: error/stated": float(np.sqrt(np.mean(acceleration.ratio**2))),
            "velocity over the parabola's": velocity.noise,
            "acceleration over the parabola's": acceleration.noise,
        }


@table("rates_speed", page="how-to/results", cost=10, timing=True)
def rates_speed(quick: bool) -> Iterator[dict[str, object]]:
    """Processor time of the rates of 500 frames on one thread, by motion."""
    t, nodes = np.arange(500.0), 20 if quick else 300
    still: BoolArray = t < 0
    noise = 0.01 * np.random.default_rng(0).normal(size=(len(t), nodes))
    std = np.full(noise.shape, 0.01)
    options = {"window": WINDOW - 1.0, "common_fraction": 0.0, "references": still}
    rates(t, Field(name="u", values=noise[:, :2], std=std[:, :2]), **options)  # compiles
    for name, motion in {"at rest": 0 * t, "swinging": 5 * np.sin(t / 6), "blows": 0.5 * abs(t % 80 - 40)}.items():
        start = time.process_time()
        rates(t, Field(name="u", values=noise + motion[:, None], std=std), **options)
        yield {"motion": name, "time [ms a node]": 1e3 * (time.process_time() - start) / nodes}
