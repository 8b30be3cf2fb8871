"""Velocity and acceleration of signals with a known truth: error over stated uncertainty, false motion, noise, time.

    python benchmarks/rates.py [--draws 200] [--noise 0.005 0.015] [--seed 1] [--time]

For every signal and noise (px) a line, each number of velocity / acceleration, in px and frames; windows of 7 frames:

- worst: largest rms(error / stated) of a frame, over the draws; the frame of a kink itself is left out, its rates of
  both sides have a column of their own (fraction of draws in which they are stated, rms(error / stated));
- over 1.3: part of the frames where that is above 1.3;
- all: the same over all frames, which for smooth motion should be near 1;
- near, far: largest estimate over stated where the body is at rest, within a window of the onset and elsewhere;
- noise: rms error at rest over that of one parabola over the same window; last, what that parabola makes of `near`.

`--time` measures 10,000 nodes of 500 frames. The constants of `rgbmidic/_kernels/rates.py` were chosen on other
signals, but for the highest degree and the least probability that counts.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rgbmidic.fields import Rates, rates
from rgbmidic.typing import BoolArray, FloatArray

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


def judge(signal: Signal, noise: float, draws: int, seed: int) -> list[str]:
    """The columns of a signal."""
    random = np.random.default_rng([seed, round(noise * 1e6)])
    known = np.isin(np.arange(len(signal.times)), signal.lost, invert=True)
    values = signal.value[:, None] + noise * random.normal(size=(len(signal.times), draws))
    own = np.where(known[:, None], values, np.nan)
    still: BoolArray = np.zeros(len(signal.times), dtype=bool)
    found = rates(
        signal.times, own, np.full(own.shape, noise), window=WINDOW - 1.0, common_fraction=0.0, references=still
    )
    plain = fixed(signal.times, values, known)
    at_rest = signal.times <= (np.inf if signal.onset is None else signal.onset)
    if not (signal.velocity[at_rest] == 0).all():
        at_rest[:] = False
    away = at_rest & (signal.times < (signal.times[-1] if signal.onset is None else signal.onset - WINDOW))
    inner = np.zeros(len(signal.times), dtype=bool)
    inner[EDGE:-EDGE] = True
    kink = signal.kink
    if kink is not None:
        inner[kink] = False
    columns: list[list[str]] = []
    for order, name in enumerate(("velocity", "acceleration")):
        truth = getattr(signal, name)[:, None]
        value, std = getattr(found, name), getattr(found, f"{name}_std")
        ratio = np.sqrt(np.mean(((value - truth) / std) ** 2, axis=1))[inner]
        column = [f"{ratio.max():.2f}", f"{np.mean(ratio > 1.3):.2f}", f"{np.sqrt(np.mean(ratio**2)):.2f}"]
        false = np.abs(value / std).max(axis=1)
        near, far = (false[part & inner] for part in (at_rest & ~away, away))
        column += [f"{part.max():.1f}" if part.size else "" for part in (near, far)]
        quiet = away & inner
        error = np.sqrt(np.mean(value[quiet] ** 2) / np.mean(plain[order, 0][quiet] ** 2)) if quiet.any() else np.nan
        column += [f"{error:.2f}" if quiet.any() else ""]
        rested = at_rest & ~away & inner
        column += [f"{np.abs(plain[order, 0] / plain[order, 1] / noise)[rested].max():.0f}" if rested.any() else ""]
        column += [_both_sides(signal, found, name, kink)]
        columns.append(column)
    return [f"{a} / {b}" if a or b else "" for a, b in zip(*columns, strict=True)]


def _both_sides(signal: Signal, found: Rates, name: str, kink: int | None) -> str:
    """In how many draws the rates of both sides are stated at a kink, and their rms(error / stated)."""
    stated = np.zeros(1, dtype=bool) if kink is None else np.isfinite(getattr(found, f"{name}_after")[kink])
    if kink is None or not stated.any():
        return ""
    truth = getattr(signal, name)
    ratios = [
        (getattr(found, f"{name}_{side}")[kink] - true) / getattr(found, f"{name}_{side}_std")[kink]
        for side, true in (("before", 0.0), ("after", 2 * truth[kink + 1] - truth[kink + 2]))
    ]
    return f"{stated.mean():.2f}, {np.sqrt(np.nanmean(np.square(ratios))):.2f}"


def measure_time(nodes: int = 10_000, frames: int = 500) -> None:
    """Print the processor's seconds for a large result at rest, in a swing and under blows."""
    t = np.arange(frames, dtype=np.float64)
    still: BoolArray = t < 0
    noise = 0.01 * np.random.default_rng(0).normal(size=(frames, nodes))
    rates(
        t, noise[:, :2], np.full((frames, 2), 0.01), window=WINDOW - 1.0, common_fraction=0.0, references=still
    )  # compiles
    for name, motion in {"rest": 0 * t, "swing": 5 * np.sin(t / 6), "blows": 0.5 * np.abs(t % 80 - 40)}.items():
        values = noise + motion[:, None]
        start, wall = time.process_time(), time.perf_counter()
        rates(t, values, np.full(values.shape, 0.01), window=WINDOW - 1.0, common_fraction=0.0, references=still)
        seconds = time.process_time() - start
        print(f"{name}: {nodes} nodes, {frames} frames: {seconds:.3g} s CPU, {time.perf_counter() - wall:.3g} s")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="rates of signals with a known truth")
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.005, 0.015])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--time", action="store_true")
    given = parser.parse_args()
    if given.time:
        measure_time()
        return
    print("signal | noise | worst | over 1.3 | all | near | far | noise | parabola's near | both sides")
    for name, signal in signals():
        for noise in given.noise:
            print(" | ".join([name, f"{noise:g}", *judge(signal, noise, given.draws, given.seed)]), flush=True)


if __name__ == "__main__":
    main()
