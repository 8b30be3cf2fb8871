"""Report of a test: one HTML page of text, tables and pictures that needs no other file and no network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from rgbmidic._version import __version__
from rgbmidic.errors import InputError
from rgbmidic.report import curves, figures
from rgbmidic.report import setup as tables
from rgbmidic.report.gallery import REPORT
from rgbmidic.report.page import render
from rgbmidic.report.style import PAGE_DPI, time_text
from rgbmidic.results import QUANTITIES, Maps, Result, channels_of, probes_of, rounded, uncertain
from rgbmidic.results.files import check_file, write_complete
from rgbmidic.results.physical import Physical
from rgbmidic.settings import ChannelSettings, ProbeSettings, SetupSettings, TestSettings, read_section

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rgbmidic.results.histories import Histories


_MOST = 200
"""Frames that the time histories are drawn from at most: a panel is some 450 pixels wide, two for each."""
_SHOWN = 3
"""Frames of which maps are shown where none are named: first third, second third and end of a test."""
_KEYS = 5
"""Key frames in a strip: as many as a page is wide with panels of 4 cm."""
_LISTED = 20
"""Failed frames that are listed with their reason: half a page."""
_FEWEST = 10
"""Frames from which position against time is a picture: fewer are single stripes."""
_NO_DATA, _MISFIT, _RATIO, _BLUR = 0.1, 2.0, 1.5, 1.0
"""Where warnings begin. Chosen: fraction of nodes without data; median misfit (1 is ordinary); noise of static frames
over the stated uncertainty; px that a node moves during the exposure (the speckle's gradient is resolved to 1 px)."""


def write_report(
    result: Result,
    out: Path | str,
    *,
    settings: TestSettings | None = None,
    frames: Sequence[int] | None = None,
    overwrite: bool = False,
) -> None:
    """Write the report of a result as one HTML file.

    Parameters
    ----------
    result
        The result.
    out
        HTML file to write; it appears once it is complete.
    settings
        Settings whose ``[setup]``, ``[scale]``, ``[probes]`` and ``[channels]`` replace those kept in the result; None:
        those kept.
    frames
        Indices of the frames of which maps are shown; None: three deformed ones that did not fail, evenly spaced,
        the last of them included, and the one that has moved farthest.
    overwrite
        Whether an existing file may be replaced.

    Raises
    ------
    InputError
        There is no such frame, or the file is named as something else than HTML.
    ResultError
        The file exists, its folder does not, or a frame of the result is damaged.
    """
    out = Path(out)
    if out.suffix.lower() not in (".html", ".htm"):
        raise InputError(
            f"a report is a page, .html or .htm, not {out.name}; for a PDF open the page in a browser and print it"
        )
    check_file(out, overwrite=overwrite)
    kept = result.provenance.get("settings", {}).get("setup", {})
    setup = read_section(SetupSettings, "setup", kept) if settings is None else settings.setup
    probes = probes_of(result) if settings is None else settings.probes
    channels = channels_of(result) if settings is None else settings.channels
    physical = Physical.of(result, None if settings is None else settings.scale)
    report = _Report(physical, probes, channels, frames)
    text = render(
        "report.html",
        **vars(report),
        report=report,
        result=result,
        setup=setup,
        curves=curves,
        figures=figures,
        tables=tables,
        isfinite=np.isfinite,
        uncertain=uncertain,
        measured=report.history.fractions[:, 0],
        listed=_LISTED,
    )
    write_complete(out, lambda file: file.write(text.encode()))


class _Report:
    """Data that the sections of a report are made from, which its template names."""

    def __init__(
        self,
        physical: Physical,
        probes: ProbeSettings,
        channels: ChannelSettings,
        frames: Sequence[int] | None,
    ) -> None:
        result = physical.result
        for frame in frames or ():
            result.frame(frame)  # an error of one is raised before the long work
        self.physical, self.probes, self.channels = physical, probes, channels
        self.history = tables.TimeHistory(physical, figures.spread(figures.shown_frames(result), _MOST))
        measured = figures.spread(figures.measured_frames(result), _SHOWN)
        self.shown = tuple(sorted({*measured, self.history.farthest})) if frames is None else tuple(frames)
        self.floor = tables.noise_floor(physical)
        self.maps = figures.MapDrawer(Maps(result=result, physical=physical), PAGE_DPI)

    def warnings(self) -> Iterator[str]:
        """Yield what a reader of the numbers must know, the gravest first."""
        units, history, result = self.physical.units, self.history, self.physical.result
        if missing := int((~result.finished).sum()):
            yield f"the run is not finished: {missing} of {len(result)} frames are missing"
        ends = result.status[list(result.deformed)]
        for code, ended in ((2, "failed"), (1, "did not converge")):
            if count := int((ends == code).sum()):
                yield f"{count} of {len(ends)} frames {ended}"
        without = 1 - float(history.fractions[:, 0].mean())
        if without > _NO_DATA:
            yield f"{without:.0%} of the nodes are not measured"
        if gaps := result.provenance.get("lost_frames"):
            yield f"frames missing between those that are there, by number or time: {gaps}"
        exposure = result.provenance.get("exposure_ns") or 0
        blur = history.fastest * exposure * 1e-9 if units.timed else 0.0
        if blur > _BLUR:
            yield (
                f"motion blur: the fastest node moves by {blur:.2g} px while the frame is exposed "
                f"({exposure / 1000:g} µs)"
            )
        if self.floor is not None:
            stated = np.hypot(history.median("u_std"), history.median("v_std"))
            ratio = np.hypot(self.floor.measured["u"], self.floor.measured["v"]) / stated
            if ratio > _RATIO:
                yield f"static frames scatter {ratio:.2g} times as much as the stated uncertainty: vibration, flicker?"
        if history.median("misfit") > _MISFIT:
            yield "half of the nodes fit badly (`misfit`)"
        if units.mm_per_pixel is None:
            yield "no image scale is stated (`scale.mm_per_pixel`): lengths are in px"
        if not units.timed:
            yield "no frame rate is known (`scale.frame_rate`): time is in frames"

    def strips(self) -> Iterator[tuple[Figure, str]]:
        """Yield pictures of displacement and strain in key frames, with what they show."""
        keys, physical = self.history.key_frames(_KEYS), self.physical
        if len(keys) < 3:
            return
        frames = {self.when(frame, short=True): physical.frame(frame) for frame in keys}
        moved = [(title, np.hypot(values["u"], values["v"])) for title, values in frames.items()]
        strain = [(title, values["e1"]) for title, values in frames.items()]
        for label, strip in (
            (f"displacement ({physical.units.length})", moved),
            (f"larger principal strain ({physical.measure_name})", strain),
        ):
            yield self.maps.strip(strip, label), label

    def histories(self) -> Histories:
        """Read the time histories of the probes."""
        from rgbmidic.results.histories import read_histories

        return read_histories(self.physical.result, self.probes, scale=self.physical.scale, channels=self.channels)

    def lines(self) -> Iterator[dict[str, Any]]:
        """Yield position against time along the lines of the probes, else through the middle of the region."""
        physical, measured = self.physical, figures.measured_frames(self.physical.result)
        if not physical.units.timed or len(measured) < _FEWEST:
            return
        from rgbmidic.results.profiles import read_profile

        nodes = physical.result.nodes
        middle, (wide, tall) = (nodes.min(axis=0) + nodes.max(axis=0)) / 2, np.ptp(nodes, axis=0) / 2
        reach = np.array([wide, 0.0] if wide >= tall else [0.0, tall])
        lines = {"the longer side of the region, through its middle": (*(middle - reach), *(middle + reach))}
        if stated := [place for kind, place in self.probes.places if kind == "line"]:
            lines = {f"line_{number}": place for number, place in enumerate(stated, 1)}
        maps, frames = self.maps.maps, figures.spread(measured, _MOST)
        for name, place in lines.items():
            x0, y0, x1, y1 = place
            field = "exx" if abs(x1 - x0) >= abs(y1 - y0) else "eyy"
            where = f"{name}, from ({x0:.0f}, {y0:.0f}) to ({x1:.0f}, {y1:.0f}) px"
            line = {"field": field, "where": where, "drawn": len(frames), "measured": len(measured), "error": None}
            try:
                yield line | {"figure": curves.profile_figure(read_profile(maps, field, place, frames))}
            except InputError as error:
                yield line | {"error": error}

    def uncertainty_rows(self) -> Iterator[tuple[str, ...]]:
        """Yield quantity, unit, and quantiles over the nodes of its standard uncertainty, medians of the frames."""
        for name in ("u_std", "v_std", "exx_std", "eyy_std", "exy_std"):
            known = self.history.quantiles[name]
            known = known[np.isfinite(known).all(axis=1)]
            numbers = [rounded(value, value) for value in np.median(known, axis=0)] if len(known) else "---"
            yield name, self.physical.units.length if name[0] in "uv" else "1", *numbers

    def endings(self) -> list[tuple[str, int]]:
        """Return how many deformed frames ended in each status."""
        ends = self.physical.result.status[list(self.physical.result.deformed)]
        return [(word, int((ends == code).sum())) for code, word in enumerate(QUANTITIES["status"].codes)]

    def troubled(self) -> list[tuple[str, str]]:
        """Return names and reasons of the deformed frames that failed or did not converge."""
        result = self.physical.result
        odd = [index for index in result.deformed if result.status[index] != 0 and result.finished[index]]
        return list(zip([result.names[index] for index in odd], result.each("reason", odd), strict=True))

    def when(self, frame: int, *, short: bool = False) -> str:
        """Name a frame, with its time where it is known."""
        times = self.physical.times
        when = f" at {time_text(times[frame], times)}" if self.physical.units.timed else ""
        if short:
            return f"frame {frame}{when.replace(' at', ',')}"
        return f"frame {frame} ({self.physical.result.names[frame]}){when}"


def write_batch_page(header: Sequence[str], rows: Sequence[Sequence[str]], path: Path) -> None:
    """Write the table of a batch (`rgbmidic.pipeline.batch.summary_rows`) as a page with links to the tests' reports.

    Parameters
    ----------
    header, rows
        Of the table; the fourth column is a test's folder.
    path
        HTML file to write.
    """
    links = []
    for _, _, _, folder, *_ in rows:
        report = Path(folder) / REPORT
        links.append(quote(report.relative_to(path.parent).as_posix()) if folder and report.is_file() else "")
    text = render("batch.html", header=header, rows=rows, links=links, version=__version__)
    write_complete(path, lambda file: file.write(text.encode()))
