"""The result that several commands read, and the options by which they state it and the fields derived from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from rgbmidic.cli.command import REQUIRED, Measure, Pixels, collect_options, read_frames
from rgbmidic.errors import InputError

if TYPE_CHECKING:
    from rgbmidic.results import Maps, Result
    from rgbmidic.settings import ScaleSettings, TestSettings


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResultSource:
    """A result that a command reads, and the settings that replace those stored in it, if any are stated."""

    result: Result
    settings: TestSettings | None

    def scale(self, *, px: bool = False) -> ScaleSettings | None:
        """Return the scale of these settings, with lengths in px if `px`; None: that of the result."""
        scale = None if self.settings is None else self.settings.scale
        return replace(scale or self.result.scale, unit="px") if px else scale

    def maps(self, derived: Mapping[str, Any]) -> Maps:
        """Return the fields of the result, derived as the options of `derived_options` state."""
        from rgbmidic.results import Maps

        choices = dict(derived)
        return Maps.from_result(self.result, self.scale(px=choices.pop("px")), **choices)

    def frames(self, text: str) -> list[int] | None:
        """Return the measured frames among those that ``--frames`` states; None if it is empty."""
        if (indices := read_frames(text)) is None:
            return None
        result, available = self.result, f"{self.result.path} has frames 0 to {len(self.result) - 1}"
        if max(indices) >= len(result):
            raise InputError(f"--frames {text}: {available}")
        if not (measured_indices := [frame for frame in indices if result.finished[frame]]):
            raise InputError(f"--frames {text}: none of them is measured; {available}")
        return measured_indices


def _open_result(options: Mapping[str, Any]) -> ResultSource:
    from rgbmidic.results import Result
    from rgbmidic.settings import read_test

    result, test = Result.open(options["result"], partial=options["partial"]), options["test"]
    return ResultSource(result=result, settings=None if test is None else read_test(test))


_RESULT_OPTIONS: dict[str, Any] = {
    "result": Annotated[Path, Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    "test": Annotated[
        Path | None,
        Option(help="TEST.toml whose [scale], [setup], [probes] and [channels] replace those of the result."),
    ],
    "partial": Annotated[bool, Option("--partial", help="Use the finished frames of an interrupted run.")],
}
result_options = collect_options("source", _RESULT_OPTIONS, _open_result, result=REQUIRED, partial=False)
"""Decorator of a command whose parameter `source` is the result that it reads."""

_DERIVED: dict[str, Any] = {
    "gauge": Annotated[float | None, Option("--gauge-length", "--gauge", help="Virtual strain gauge, px.")],
    "measure": Measure,
    "since": Annotated[int | None, Option(metavar="N", help="Show the fields relative to frame N.")],
    "rigid_removed": Annotated[bool, Option("--remove-rigid", help="Remove the rigid motion.")],
    "window": Annotated[int | None, Option(help="Frames that a rate is taken over, 4 or more.")],
    "px": Pixels,
}
derived_options = collect_options("derived", _DERIVED, dict, rigid_removed=False, px=False)
"""Decorator of a command whose parameter `derived` states how fields are derived, see `rgbmidic.results.Maps`."""
