"""Results damaged at random: what is read of them is right or missing with a word, never wrong.

``python tests/damage.py 500 [SEED]`` damages as many and prints what became of them.
"""

from __future__ import annotations

import logging
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from results import make_origin, random_record

from rgbmidic.errors import ResultError
from rgbmidic.results import FrameRecord, Result, ResultStore
from rgbmidic.settings import FrameSettings, ProbeSettings, RegionSettings, ScaleSettings, SolverSettings, TestSettings

FRAMES = 6
_RETRIED = 3
"""The frame that was measured twice."""
_KINDS = ("bit", "bits", "digit", "cut", "lost piece", "doubled piece", "zeros", "swapped", "deleted", "renamed")


def write_result(path: Path, *, tolerance: float = 1e-3, seed: int = 0) -> Path:
    """A finished result, one frame of which was taken back and measured again."""
    settings = TestSettings(
        frames=FrameSettings(path=("*.dng",)),
        region=RegionSettings(rectangle=(0, 0, 9, 9)),
        solver=SolverSettings(tolerance=tolerance),
        scale=ScaleSettings(mm_per_pixel=0.0125),
        probes=ProbeSettings(points=((31.5, 22.25),)),
        base=path,
    )
    images = np.random.default_rng(seed).normal(1000, 100, (3, 20, 30))
    origin = make_origin(FRAMES, settings=settings, reference=images)
    with ResultStore.create(path, origin) as store:
        for index in range(_RETRIED + 1):
            store.write_frame(index, _record(index, seed - (index == _RETRIED)))
    with ResultStore.resume(path, origin) as store:
        store.discard([_RETRIED])
        for index in range(_RETRIED, FRAMES):
            store.write_frame(index, _record(index, seed))
        store.finish()
    return path


def _record(index: int, seed: int) -> FrameRecord:
    return random_record(1000 * seed + index + 1000)


def damage_results(folder: Path, count: int, seed: int) -> Counter[tuple[str, str]]:
    """Damage a result `count` times, each time from the whole one; how often each kind of damage ended how.

    Raises
    ------
    AssertionError
        Something wrong was read without a word.
    """
    random = np.random.default_rng(seed)
    whole, other = write_result(folder / "whole", seed=1), write_result(folder / "other", tolerance=2e-3, seed=3)
    truth = Result.open(whole)
    ends: Counter[tuple[str, str]] = Counter()
    for number in range(count):
        copy = Path(shutil.copytree(whole, folder / "copy"))
        kind = _KINDS[number % len(_KINDS)]
        told = _damage(copy, other, kind, random)
        try:
            end = _check(copy, truth)
        except AssertionError as error:
            raise AssertionError(f"damage {number} of seed {seed}, {told}: {error}") from error
        ends[kind, end] += 1
        shutil.rmtree(copy)
    return ends


def _damage(copy: Path, other: Path, kind: str, random: np.random.Generator) -> str:
    """Damage one file, chosen at random; says what was done."""
    files = sorted(file for file in copy.rglob("*") if file.is_file())
    file = files[int(random.integers(len(files)))]
    content = bytearray(file.read_bytes())
    first, second = sorted(int(place) for place in random.integers(0, len(content), 2))
    if kind in ("bit", "bits"):
        for place in random.integers(0, len(content), 1 if kind == "bit" else 8):
            content[place] ^= 1 << int(random.integers(8))
    elif kind == "digit":  # by hand, in the provenance
        file = copy / "provenance.json"
        content = bytearray(file.read_bytes())
        digits = [place for place, byte in enumerate(content) if chr(byte).isdigit()]
        place = digits[int(random.integers(len(digits)))]
        content[place] = ord(str((int(chr(content[place])) + int(random.integers(1, 10))) % 10))
    elif kind == "cut":
        del content[second:]
    elif kind == "lost piece":
        del content[first:second]
    elif kind == "doubled piece":
        content[second:second] = content[first:second]
    elif kind == "zeros":
        content[first:second] = bytes(second - first)
    elif kind == "swapped":
        content[:] = (other / file.relative_to(copy)).read_bytes()
    elif kind == "renamed":
        one, two = (copy / "solution" / f"00000{number}.npz" for number in (0, 1))
        spare = one.rename(one.with_suffix(".spare"))
        two.rename(one)
        spare.rename(two)
        return kind
    file.write_bytes(content)
    if kind == "deleted":
        file.unlink()
    return f"{kind} {file.relative_to(copy)} {first} {second}"


def _check(copy: Path, truth: Result) -> str:
    """What a damaged result ends as; an AssertionError where something wrong is read."""
    complete = "right"
    try:
        opened = Result.open(copy)
        for frame in range(FRAMES):
            assert _same(opened.frame(frame), truth.frame(frame)), f"frame {frame} read as whole"
        _check_shared(opened, truth)
    except ResultError as error:
        complete = "refused" if str(copy) in str(error) else "refused without its name"
    try:
        partial = Result.open(copy, partial=True)
        _check_shared(partial, truth)
    except ResultError:
        partial = None
    lost = [] if partial is None else list(_lost(partial, truth))
    assert complete == ("refused" if lost else complete)
    assert complete != "refused without its name"
    healed = _resumed(copy, truth)
    if complete == "right":
        return "right"
    return f"told, {'nothing' if partial is None else 'the rest'} read, {'healed' if healed else 'refused'} by --resume"


def _lost(partial: Result, truth: Result) -> Iterator[int]:
    for frame in range(FRAMES):
        record = partial.frame(frame)
        if record.reason == "damaged":
            assert np.isnan(record.u).all()
            assert not partial.finished[frame]
            yield frame
        else:
            assert _same(record, truth.frame(frame)), f"frame {frame} of the rest"


def _resumed(copy: Path, truth: Result) -> bool:
    """What `rgbmidic run --resume` does to the store; False where it is refused."""
    kept = truth.provenance["settings"]
    settings = TestSettings.from_mapping(kept, truth.provenance["base"])
    images = np.random.default_rng(1).normal(1000, 100, (3, 20, 30))
    try:
        with ResultStore.resume(copy, make_origin(FRAMES, settings=settings, reference=images)) as store:
            store.discard(np.flatnonzero(store.table().without_damaged(ended=True).damaged).tolist())
            store.reopen()
            for frame in np.flatnonzero(~store.finished()).tolist():
                store.write_frame(frame, truth.frame(frame))
            store.finish()
        healed = Result.open(copy)
    except ResultError:
        return False
    _check_shared(healed, truth)
    assert all(_same(healed.frame(frame), truth.frame(frame)) for frame in range(FRAMES)), "after --resume"
    return True


def _check_shared(result: Result, truth: Result) -> None:
    assert (result.names, result.lights) == (truth.names, truth.lights)
    assert [result.section(kind) for kind in (ScaleSettings, ProbeSettings)] == [
        truth.section(kind) for kind in (ScaleSettings, ProbeSettings)
    ]
    np.testing.assert_array_equal(result.nodes, truth.nodes)
    np.testing.assert_array_equal(result.elements, truth.elements)
    if result.reference is not None:  # pictures; a result may be without
        np.testing.assert_array_equal(result.reference, truth.reference)


def _same(record: FrameRecord, other: FrameRecord) -> bool:
    try:
        np.testing.assert_equal(dict(record.values), dict(other.values))
    except AssertionError:
        return False
    return True


if __name__ == "__main__":
    logging.disable(logging.WARNING)
    with tempfile.TemporaryDirectory() as made:
        count, seed = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
        for (kind, end), times in sorted(damage_results(Path(made), count, seed).items()):
            print(f"{times:5} {kind}: {end}")  # noqa: T201
