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
from rgbmidic.disk import check_file, write_text
from rgbmidic.errors import InputError
from rgbmidic.results import QUANTITIES, Maps, Result, speckle_diameter
from rgbmidic.results.histories import read_histories
from rgbmidic.results.result_in_units import ResultInUnits, frame_rate
from rgbmidic.settings import ChannelSettings, ProbeSettings, SetupSettings, TestSettings
from rgbmidic.tools.report import curves, figures, style
from rgbmidic.tools.report.gallery import REPORT
from rgbmidic.tools.report.noise_floor import noise_floor
from rgbmidic.tools.report.page import render


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportConstants:
    """Sizes of a report, and the limits of its warnings.

    Attributes
    ----------
    history_frames
        Frames that the time histories are drawn from at most: a panel is some 450 pixels wide, two for each.
    map_frames
        Frames of which maps are shown where none are named: first third, second third and end of a test.
    key_frames
        Key frames in a strip: as many as a page is wide with panels of 4 cm.
    max_listed
        Failed frames that are listed with their reason: half a page.
    panels_per_picture
        Panels of the histories of the probes in a picture: as many fill a page of A4.
    min_profile_frames
        Frames from which position against time is a picture: fewer are single stripes.
    finest_nodes, finest_gauge
        Spatial resolution of the displacement at the nodes, in elements, and of a virtual strain gauge's strain, in its
        lengths (`rgbmidic.tools.lab.resolution.cut_offs`).
    max_no_data, max_misfit, max_noise_ratio
        Largest fraction of nodes without data, median misfit (1 is ordinary), and noise of static frames over the
        stated uncertainty, that are not warned of. Chosen.
    max_blur
        The same of the px that a node moves during the exposure: the speckle's gradient is resolved to 1 px.
    """

    history_frames: int = 200
    map_frames: int = 3
    key_frames: int = 5
    max_listed: int = 20
    panels_per_picture: int = 4
    min_profile_frames: int = 10
    finest_nodes: float = 2.2
    finest_gauge: float = 2.6
    max_no_data: float = 0.1
    max_misfit: float = 2.0
    max_noise_ratio: float = 1.5
    max_blur: float = 1.0


def speckle_size(result: Result) -> float | None:
    """Return the full width at half maximum (px) of the reference's autocorrelation; None where none was kept.

    It is the median over the lights, around the mesh, of the separated images, which are interpolated at all pixels;
    `rgbmidic inspect` evaluates the samples themselves.
    """
    if result.reference is None:
        return None
    nodes = result.nodes - result.reference_origin
    (x_min, y_min), (x_max, y_max) = nodes.min(axis=0).astype(int), nodes.max(axis=0).astype(int) + 1
    images = result.reference[:, max(y_min, 0) : y_max, max(x_min, 0) : x_max].astype(np.float32)
    sizes = [size for image in images if (size := speckle_diameter(image)) is not None]
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

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_report(Result.open("my_result"), f"{folder}/report.html", frames=[1])
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
    physical = ResultInUnits.from_result(result, None if settings is None else settings.scale)
    for frame in frames or ():
        result.frame(frame)  # an error of one is raised before the long work
    constants, provenance = ReportConstants(), result.provenance
    history = curves.TimeHistory(
        physical, figures.select_evenly(figures.frames_to_draw(result), constants.history_frames)
    )
    if frames is None:
        sampled_frames = figures.select_evenly(figures.measured_frames(result), constants.map_frames)
        frames = sorted({*sampled_frames, history.farthest})
    maps = figures.MapDrawer(Maps(physical=physical), style.PAGE_DPI)
    exposure, speckle = provenance.get("exposure_ns"), speckle_size(result)
    statuses = result.status[list(result.deformed)]
    unconverged = [index for index in result.deformed if result.status[index] != 0 and result.finished[index]]
    text = render(
        "report.html",
        constants=constants,
        curves=curves,
        figures=figures,
        isfinite=np.isfinite,
        result=result,
        physical=physical,
        setup=asdict(setup),
        probes=probes,
        map_frames=frames,
        maps=maps,
        history=history,
        measured_fraction=history.fractions[:, 0],
        floor=noise_floor(physical),
        histories=read_histories(physical, probes, channels=channels) if probes.kind_coordinates else None,
        lines=_lines(maps.maps, probes, constants),
        frame_label=partial(_frame_label, physical),
        rate=frame_rate(result, physical.scale),
        exposure=None if exposure is None else f"{exposure / 1000:g} µs",
        blur=1e-9 * (exposure or 0) * history.fastest if physical.units.timed else 0,
        speckle=None if speckle is None else physical.in_units(speckle),
        missing=int((~result.finished).sum()),
        endings={word: int((statuses == code).sum()) for code, word in enumerate(QUANTITIES["status"].codes)},
        unconverged=list(
            zip((result.names[index] for index in unconverged), result.iterate("reason", unconverged), strict=True)
        ),
    )
    write_text(out, text)


def _lines(maps: Maps, probes: ProbeSettings, constants: ReportConstants) -> Iterator[dict[str, Any]]:
    """Yield position against time along the lines of the probes, else through the middle of the region."""
    from rgbmidic.results.profiles import read_profile

    measured_frames, nodes = figures.measured_frames(maps.result), maps.result.nodes
    if not maps.physical.units.timed or len(measured_frames) < constants.min_profile_frames:
        return
    middle, (wide, tall) = (nodes.min(axis=0) + nodes.max(axis=0)) / 2, np.ptp(nodes, axis=0) / 2
    reach = np.array([wide, 0.0] if wide >= tall else [0.0, tall])
    lines = {"the longer side of the region, through its middle": (*(middle - reach), *(middle + reach))}
    if line_positions := [position for kind, position in probes.kind_coordinates if kind == "line"]:
        lines = {f"line_{number}": position for number, position in enumerate(line_positions, 1)}
    frames = figures.select_evenly(measured_frames, constants.history_frames)
    for name, position in lines.items():
        x0, y0, x1, y1 = position
        field = "exx" if abs(x1 - x0) >= abs(y1 - y0) else "eyy"
        description = f"{name}, from ({x0:.0f}, {y0:.0f}) to ({x1:.0f}, {y1:.0f}) px"
        line = {
            "field": field,
            "where": description,
            "drawn": len(frames),
            "measured": len(measured_frames),
            "error": None,
        }
        try:
            yield line | {"figure": curves.profile_figure(read_profile(maps, field, position, frames))}
        except InputError as error:
            yield line | {"error": error}


def _frame_label(physical: ResultInUnits, frame: int) -> str:
    """Name a frame, with its time where it is known."""
    time_note = f" at {style.time_text(physical.times[frame], physical.times)}" if physical.units.timed else ""
    return f"frame {frame} ({physical.result.names[frame]}){time_note}"


def write_batch_page(header: Sequence[str], rows: Sequence[Sequence[str]], path: Path) -> None:
    """Write the table of a batch (`rgbmidic.tools.batch.summary_rows`) as a page with links to the tests' reports.

    Parameters
    ----------
    header, rows
        Of the table; the fourth column is a test's folder.
    path
        HTML file to write.

    Examples
    --------
    >>> write_batch_page(["test", "status", "reason", "folder"], [["a", "measured", "", "a"]], Path("batch.html"))
    >>> Path("batch.html").read_text(encoding="utf-8")[:15], Path("batch.html").unlink()
    ('<!doctype html>', None)
    """
    links = []
    for _, _, _, folder, *_ in rows:
        report = Path(folder) / REPORT
        links.append(quote(report.relative_to(path.parent).as_posix()) if folder and report.is_file() else "")
    text = render("batch.html", header=header, rows=rows, links=links, version=__version__)
    write_text(path, text)
