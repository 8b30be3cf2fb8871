"""A run that a page has started: the command line's own, in a process beside the server."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Self

from rgbmidic.errors import ResultError
from rgbmidic.results import Result

__all__ = ["Run"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """``rgbmidic run TEST.toml --out DIR``, going on or at its end.

    Attributes
    ----------
    out
        The result's folder.
    process
        The command.
    said
        What it writes for people.
    """

    out: Path
    process: subprocess.Popen[bytes]
    said: IO[bytes]

    @classmethod
    def start(cls, test: Path, out: Path) -> Self:
        """Start it; whatever is wrong with its input it says itself."""
        said = tempfile.TemporaryFile()  # noqa: SIM115 it lives as long as the run
        command = [sys.executable, "-m", "rgbmidic.cli", "run", str(test), "--out", str(out), "--no-figures"]
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said)
        return cls(out=out, process=process, said=said)

    @property
    def going(self) -> bool:
        """Whether it goes on."""
        return self.process.poll() is None

    def words(self) -> str:
        """How far it has come, or how it ended."""
        try:
            result = Result.open(self.out, partial=True, check=False)
            far = f"{int(result.finished.sum())} of {len(result)} frames measured"
        except ResultError:
            far = "preparing the reference"
        if self.going:
            return f"running: {far}"
        return f"ended: {far}" if not self.process.returncode else f"failed: {self._last_line()}"

    @property
    def begun(self) -> bool:
        """Whether there is a result to look at."""
        try:
            Result.open(self.out, partial=True, check=False)
        except ResultError:
            return False
        return True

    def _last_line(self) -> str:
        self.said.seek(0)
        lines = [line for line in self.said.read().decode("utf-8", "replace").splitlines() if line.strip()]
        return next((line for line in lines if line.startswith("error: ")), lines[-1] if lines else "no word of it")
