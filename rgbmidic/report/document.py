"""Report of a test: one HTML page of text, tables and pictures that needs no other file and no network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from rgbmidic._version import __version__
from rgbmidic.errors import InputError
from rgbmidic.report import curves, figures, style
from rgbmidic.report.gallery import REPORT
from rgbmidic.report.noise_floor import noise_floor
from rgbmidic.report.page import render
from rgbmidic.results import QUANTITIES, UNKNOWN_TIME, Maps, Result, speckle_diameter
from rgbmidic.results.files import check_file, write_text
from rgbmidic.results.histories import read_histories
from rgbmidic.results.physical import Physical
from rgbmidic.settings import ChannelSettings, ProbeSettings, ScaleSettings, SetupSettings, TestSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportConstants:
    """How much a report shows, and where its warnings begin.

    Attributes
    ----------
    histories
        Frames that the time histories are drawn from at most: a panel is some 450 pixels wide, two for each.
    shown
        Frames of which maps are shown where none are named: first third, second third and end of a test.
    keys
        Key frames in a strip: as many as a page is wide with panels of 4 cm.
    listed
        Failed frames that are listed with their reason: half a page.
    panels
        Panels of the histories of the probes in a picture: as many fill a page of A4.
    fewest
        Frames from which position against time is a picture: fewer are single stripes.
    finest_nodes, finest_gauge
        Spatial resolution of the displacement at the nodes, in elements, and of a virtual strain gauge's strain, in its
        lengths (`rgbmidic.lab.resolution.cut_offs`).
    no_data, misfit, excess
        Largest fraction of nodes without data, median misfit (1 is ordinary), and noise of static frames over the
        stated uncertainty, that are not warned of. Chosen.
    blur
        The same of the px that a node moves during the exposure: the speckle's gradient is resolved to 1 px.
    """

    histories: int = 200
    shown: int = 3
    keys: int = 5
    listed: int = 20
    panels: int = 4
    fewest: int = 10
    finest_nodes: float = 2.2
    finest_gauge: float = 2.6
    no_data: float = 0.1
    misfit: float = 2.0
    excess: float = 1.5
    blur: float = 1.0


def speckle_size(result: Result) -> float | None:
    """Return the full width at half maximum (px) of the reference's autocorrelation; None where none was kept.

    It is the median over the lights, around the mesh, of the separated images, which are interpolated at all pixels;
    `rgbmidic inspect` evaluates the samples themselves.
    """
    if result.reference is None:
        return None
    nodes = result.nodes - result.reference_origin
    (left, top), (right, bottom) = nodes.min(axis=0).astype(int), nodes.max(axis=0).astype(int) + 1
    parts = result.reference[:, max(top, 0) : bottom, max(left, 0) : right].astype(np.float32)
    sizes = [size for part in parts if (size := speckle_diameter(part)) is not None]
    return float(np.median(sizes)) if sizes else None


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
    setup = result.section(SetupSettings) if settings is None else settings.setup
    probes = result.section(ProbeSettings) if settings is None else settings.probes
    channels = result.section(ChannelSettings) if settings is None else settings.channels
    physical = Physical.of(result, None if settings is None else settings.scale)
    for frame in frames or ():
        result.frame(frame)  # an error of one is raised before the long work
    constants, kept = ReportConstants(), result.provenance
    history = curves.TimeHistory(physical, figures.spread(figures.shown_frames(result), constants.histories))
    if frames is None:
        measured = figures.spread(figures.measured_frames(result), constants.shown)
        frames = sorted({*measured, history.farthest})
    maps = figures.MapDrawer(Maps(result=result, physical=physical), style.PAGE_DPI)
    exposure, speckle = kept.get("exposure_ns"), speckle_size(result)
    ends = result.status[list(result.deformed)]
    odd = [index for index in result.deformed if result.status[index] != 0 and result.finished[index]]
    text = render(
        "report.html",
        constants=constants,
        curves=curves,
        figures=figures,
        isfinite=np.isfinite,
        result=result,
        physical=physical,
        stated=asdict(setup),
        probes=probes,
        shown=frames,
        maps=maps,
        history=history,
        measured=history.fractions[:, 0],
        floor=noise_floor(physical),
        histories=read_histories(result, probes, scale=physical.scale, channels=channels)
        if probes.kind_coordinates
        else None,
        lines=_lines(maps.maps, probes, constants),
        when=partial(_when, physical),
        rate=_frame_rate(physical),
        exposure=None if exposure is None else f"{exposure / 1000:g} µs",
        blur=1e-9 * (exposure or 0) * history.fastest if physical.units.timed else 0,
        speckle=None if speckle is None else physical.in_units(speckle),
        missing=int((~result.finished).sum()),
        endings={word: int((ends == code).sum()) for code, word in enumerate(QUANTITIES["status"].codes)},
        troubled=list(zip((result.names[index] for index in odd), result.each("reason", odd), strict=True)),
    )
    write_text(out, text)


def _frame_rate(physical: Physical) -> tuple[float | None, str]:
    """Frame rate that `frame_times` follows, and where it is from; None where the frames have times of their own."""
    result = physical.result
    recorded = result.provenance.get("frame_rate"), "by the camera's file"
    stated = (physical.scale or result.section(ScaleSettings)).frame_rate, "as stated"
    stamped = (result.time_ns[result.finished] != UNKNOWN_TIME).all()
    return next((rate for rate in ([recorded] if stamped else [stated, recorded]) if rate[0]), (None, ""))


def _lines(maps: Maps, probes: ProbeSettings, constants: ReportConstants) -> Iterator[dict[str, Any]]:
    """Yield position against time along the lines of the probes, else through the middle of the region."""
    from rgbmidic.results.profiles import read_profile

    measured, nodes = figures.measured_frames(maps.result), maps.result.nodes
    if not maps.physical.units.timed or len(measured) < constants.fewest:
        return
    middle, (wide, tall) = (nodes.min(axis=0) + nodes.max(axis=0)) / 2, np.ptp(nodes, axis=0) / 2
    reach = np.array([wide, 0.0] if wide >= tall else [0.0, tall])
    lines = {"the longer side of the region, through its middle": (*(middle - reach), *(middle + reach))}
    if stated := [place for kind, place in probes.kind_coordinates if kind == "line"]:
        lines = {f"line_{number}": place for number, place in enumerate(stated, 1)}
    frames = figures.spread(measured, constants.histories)
    for name, place in lines.items():
        x0, y0, x1, y1 = place
        field = "exx" if abs(x1 - x0) >= abs(y1 - y0) else "eyy"
        where = f"{name}, from ({x0:.0f}, {y0:.0f}) to ({x1:.0f}, {y1:.0f}) px"
        line = {"field": field, "where": where, "drawn": len(frames), "measured": len(measured), "error": None}
        try:
            yield line | {"figure": curves.profile_figure(read_profile(maps, field, place, frames))}
        except InputError as error:
            yield line | {"error": error}


def _when(physical: Physical, frame: int) -> str:
    """Name a frame, with its time where it is known."""
    at = f" at {style.time_text(physical.times[frame], physical.times)}" if physical.units.timed else ""
    return f"frame {frame} ({physical.result.names[frame]}){at}"


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
    write_text(path, text)
