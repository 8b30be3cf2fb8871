"""Files by their names: those that a pattern stands for, and their order by the numbers in their names."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Self

from rgbmidic.arguments import checked
from rgbmidic.errors import FrameError, convert_disk_errors, printable
from rgbmidic.frames.formats import advice, frame_formats
from rgbmidic.frames.source import split_dataset

_INTEGER, _DECIMAL = "[0-9]+", r"[0-9]+(?:[.,][0-9]+)?"
_RESET = 9999
"""Last number of a camera's counter, after which it begins with 1 (DCF: four digits, 0001 to 9999)."""


@checked
def list_frames(pattern: str | Path, base: Path | str = ".") -> tuple[Path, ...]:
    """List frame files in the order of the numbers in their names (`NamedFiles`: frame9 before frame10).

    Parameters
    ----------
    pattern
        A file, a folder (its files with the ending of a frame), or a pattern with ``*``, ``?``, ``[...]`` or ``**``;
        behind an HDF5 file or a pattern of them the dataset may be named, as in ``run.h5:/entry/data``.
    base
        Folder that a relative pattern starts from.

    Returns
    -------
    tuple of Path

    Raises
    ------
    FrameError
        Nothing matches.

    Examples
    --------
    >>> [path.suffix for path in list_frames("frames")][:2]
    ['.dng', '.dng']
    """
    text, dataset = split_dataset(pattern)
    full_path = Path(base) / text
    with convert_disk_errors(FrameError, f"the frames {pattern} cannot be looked for"):
        if full_path.is_dir():
            candidates = sorted(file for file in full_path.iterdir() if file.name[0] != ".")
            endings = {ending for frame_format in frame_formats() for ending in frame_format.endings}
            files = [file for file in candidates if file.suffix.lower() in endings]
        else:
            candidates = files = _find_matches(Path(text), Path(base))
        files = [file for file in files if not file.is_dir()]  # what else is no file is reported when it is read
    if not files:
        problem = "a folder without frames" if full_path.is_dir() else "no file matches"
        hint = next((f"; {file.name} is {text}" for file in candidates if (text := advice(file))), "")
        raise FrameError(f"no frames: {problem}: {pattern} (looked for in {Path(base).resolve()}){hint}")

    paths = NamedFiles.from_files(files).paths
    return tuple(Path(f"{path}:{dataset}") if dataset else path for path in paths)


def _find_matches(pattern: Path, base: Path) -> list[Path]:
    """Find files that match; what exists of the pattern's beginning is taken literally, brackets included."""
    components = list(pattern.parts)
    while components and (base / components[0]).exists():
        base /= components.pop(0)
    if not components:
        return [base]
    return [base / match for match in glob.glob(str(Path(*components)), root_dir=base, recursive=True)]  # noqa: PTH207


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedFiles:
    """Files in the order of their names.

    Digits count as numbers. A sign before them or a decimal fraction counts where the names of the series then have
    one form: in ``shot-1``, ``shot0``, ``shot1`` the minus is a sign, in ``shot-1``, ``shot-2`` it is a separator.
    Fractions of different lengths are decimal unless one ends with a zero, as a counter does. A name without a counter
    comes before those with one.

    Attributes
    ----------
    paths
        The files in their order.
    numbers
        The numbers in the name of each.
    forms
        The names' other characters, one text a form.
    doubt
        Why the order may be another; empty where it is certain.
    """

    paths: tuple[Path, ...]
    numbers: tuple[tuple[Fraction, ...], ...]
    forms: frozenset[str]
    doubt: str = ""

    @classmethod
    def from_files(cls, files: Collection[Path]) -> Self:
        """Return files in the order of their names."""
        one_folder = len({file.parent for file in files}) == 1
        common = "" if one_folder or not files else os.path.commonpath([file.parent for file in files])
        names = [file.stem if one_folder else str(file.relative_to(common).with_suffix("")) for file in files]
        splits, doubt = _split([name.casefold() for name in names])
        keys = {
            file: [(_number(text), "") if index % 2 else (Fraction(), text) for index, text in enumerate(split)]
            for file, split in zip(files, splits, strict=True)
        }
        paths = sorted(keys, key=lambda file: (keys[file], file.suffix.casefold(), str(file)))
        numbers = [tuple(number for number, _ in keys[path][1::2]) for path in paths]
        forms = frozenset("#".join(split[::2]) for split in splits)
        if len(forms) > 1:
            doubt = "their names have several forms"
        elif begin := _after_reset(splits, numbers):
            paths, numbers = paths[begin:] + paths[:begin], numbers[begin:] + numbers[:begin]
            doubt = f"their counter seems to begin again after {_RESET}"
        return cls(paths=tuple(paths), numbers=tuple(numbers), forms=forms, doubt=doubt)

    @property
    def counts(self) -> tuple[Fraction, ...]:
        """Counters in the names, rising; empty unless a counter is the only thing in which the names differ."""
        counts = _counter(self.numbers) if len(self.forms) == 1 else ()
        counts = tuple(count + _RESET * (count < counts[0]) for count in counts)
        return counts if len(set(counts)) == len(counts) else ()

    @property
    def first_and_last(self) -> str:
        """The first and the last names."""
        names = [printable(path.name) for path in self.paths]
        return ", ".join(names if len(names) <= 5 else (*names[:3], "...", names[-1]))


def _number(text: str) -> Fraction:
    return Fraction(int(text) if text.isdecimal() else text.replace(",", "."))


def _split(names: Sequence[str]) -> tuple[list[list[str]], str]:
    """Split names into texts and, between them, numbers as the series writes them; also what is uncertain of it."""
    fractions = {decimals for name in names for decimals in re.findall(r"[0-9]+[.,]([0-9]+)", name)}
    is_uneven = len({len(digits) for digits in fractions}) > 1
    allowed = [_INTEGER, _DECIMAL]
    if is_uneven:
        is_counter = any(len(digits) > 1 and digits.endswith("0") for digits in fractions)
        allowed = [_INTEGER] if is_counter else [_DECIMAL, _INTEGER]
    splits = [[re.split(f"({sign}{number})", name) for name in names] for number in allowed for sign in ("", "[+-]?")]
    counts = [len({tuple(split[::2]) for split in texts}) for texts in splits]
    best = counts.index(min(counts))  # the first where several are as good
    is_uncertain = is_uneven and len(allowed) > 1 and best < 2 and min(counts) == min(counts[2:])
    return splits[best], "the fractions in their names may be counters" if is_uncertain else ""


def _counter(numbers: Sequence[tuple[Fraction, ...]]) -> tuple[Fraction, ...]:
    """Return the one number in which names of one form differ; empty where none or several do."""
    differing = [column for column in zip(*numbers, strict=True) if len(set(column)) > 1]
    return differing[0] if len(differing) == 1 else ()


def _after_reset(splits: Sequence[Sequence[str]], numbers: Sequence[tuple[Fraction, ...]]) -> int:
    """Return the index of the first file, sorted, before which a camera's counter began again; 0 where it did not."""
    counts = _counter(numbers)
    columns = (set(column) for column in zip(*(split[1::2] for split in splits), strict=True))
    digits = {len(text) for column in columns if len(column) > 1 for text in column}
    if len(counts) < 3 or counts[0] < 1 or digits != {4}:
        return 0
    steps = [later - earlier for earlier, later in pairwise(counts)]
    begin = steps.index(max(steps)) + 1
    largest_other = max(steps[: begin - 1] + steps[begin:])
    return begin if steps[begin - 1] > _RESET / 2 and counts[0] + _RESET - counts[-1] <= largest_other else 0
