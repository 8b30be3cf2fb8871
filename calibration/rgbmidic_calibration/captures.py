"""Capture files in, provenance out: which files went into a calibration, with their hashes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import rgbmidic
from rgbmidic.errors import CalibrationError, ConfigurationError, FrameError
from rgbmidic.frames import ChannelFrame, FrameSeries, FrameSource, Mosaic, open_series
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.settings import FrameSettings

__all__ = ["CaptureFiles", "check_output", "named_patterns", "provenance"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureFiles:
    """The captures of one group: one light, or the dark frames.

    Attributes
    ----------
    role
        ``"dark"``, ``"light red"`` ...: for messages and the provenance.
    series
        Their frames.
    stated
        What the user stated about them.
    """

    role: str
    series: FrameSeries
    stated: FrameSettings

    @classmethod
    def find(
        cls, role: str, pattern: str, stated: FrameSettings, calibration: Calibration | None = None
    ) -> CaptureFiles:
        """Files that a pattern or folder names; `stated` is what the user says of them (its path is not used).

        What neither the files nor the user tell comes from the `calibration`, which must agree with both.

        Raises
        ------
        CalibrationError
            No file matches, or the files have different sizes.
        """
        settings = replace(stated, path=(pattern,))
        try:
            return cls(role=role, series=open_series(settings, camera=calibration, in_order=False), stated=settings)
        except FrameError as error:
            raise CalibrationError(f"{role}: {error}") from None

    def by_folder(self) -> list[CaptureFiles]:
        """The same flat frames in one group per folder."""
        groups: dict[Path, list[FrameSource]] = {}
        for source in self.series.lights[0]:
            groups.setdefault(source.path.parent, []).append(source)
        return [
            replace(self, role=f"flat {folder}", series=FrameSeries(lights=(tuple(sources),)))
            for folder, sources in groups.items()
        ]

    def __len__(self) -> int:
        return len(self.series)

    def frames(self) -> Iterator[Mosaic | ChannelFrame]:
        """The frames one after the other."""
        for index in range(len(self)):
            yield self.series.read(index)[0]

    @property
    def labels(self) -> tuple[str, ...]:
        """Name of every frame, for messages."""
        return tuple(self.series.name(index) for index in range(len(self)))

    @property
    def fingerprints(self) -> dict[str, str]:
        """The files with their SHA-256."""
        return {str(source.path): source.fingerprint for source in self.series.lights[0]}


def named_patterns(options: Sequence[str], option: str) -> dict[str, str]:
    """Split options of the form NAME=FILES.

    Raises
    ------
    ConfigurationError
        An option has another form, or a name occurs twice.
    """
    named: dict[str, str] = {}
    for text in options:
        name, separator, pattern = text.partition("=")
        name, pattern = name.strip(), pattern.strip()
        if not (separator and name and pattern):
            raise ConfigurationError(f"{option} takes NAME=FILES, as in {option} red='light_red/*.tif', not {text!r}")
        if name in named:
            raise ConfigurationError(f"{option} {name} is given twice; one pattern may match many files")
        named[name] = pattern
    return named


def check_output(path: Path, *, overwrite: bool, option: str = "--out") -> None:
    """Refuse to write where that would lose something.

    Raises
    ------
    ConfigurationError
        The file exists and may not be overwritten, or its folder does not exist.
    """
    if path.is_dir():
        raise ConfigurationError(f"{option} {path} is a folder; state a file name")
    if path.exists() and not overwrite:
        raise ConfigurationError(f"{path} exists already; choose another {option} or add --overwrite")
    if not path.parent.is_dir():
        raise ConfigurationError(f"the folder of {option} {path} does not exist")


def provenance(command: str, groups: Sequence[CaptureFiles], details: Mapping[str, Any]) -> dict[str, Any]:
    """Where a section of the calibration file comes from: date, version, inputs with hashes, and `details`."""
    inputs = [
        {"role": group.role, "file": path, "sha256": fingerprint}
        for group in groups
        for path, fingerprint in group.fingerprints.items()
    ]
    names = ("kind", "cfa", "black_level", "white_level", "shape", "dtype")
    stated = {name: getattr(groups[0].stated, name) for name in names} if groups else {}
    return {
        "command": f"rgbmidic-calibrate {command}",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "version": rgbmidic.__version__,
        "stated": {name: value for name, value in stated.items() if value is not None},
        "inputs": inputs,
        **details,
    }
