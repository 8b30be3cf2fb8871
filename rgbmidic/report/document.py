"""The report of a test: one HTML page that needs no other file and no network.

A page of text, tables and pictures, written as Markdown and as HTML at once.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rgbmidic.errors import legible
from rgbmidic.report import figures
from rgbmidic.report.curves import course_figure, history_figure, status_figure, uncertainty_figure
from rgbmidic.report.setup import (
    Course,
    NoiseFloor,
    analysis_rows,
    hardware_rows,
    noise_floor,
    noise_words,
    reference_words,
    settings_rows,
)
from rgbmidic.report.style import embedded, time_unit
from rgbmidic.results import QUANTITIES, Result, probes_of
from rgbmidic.results.files import check_file, write_complete
from rgbmidic.settings import ProbeSettings, SetupSettings, TestSettings, read_section

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rgbmidic.results.physical import Physical

__all__ = ["Page", "write_report"]

_MOST = 200
"""Frames that the course of a test is drawn from at most: more lie closer than the dots of a page."""
_KEY = 3
_LISTED = 20
"""Frames that are listed with what befell them."""
_LOST, _MISFIT, _RATIO, _BLUR = 0.1, 2.0, 1.5, 1.0
"""From where a warning is worth its line: share of the nodes that are not measured; noise of static frames over the
stated uncertainty, or the other way round; px that a node moves during the exposure."""


def write_report(
    result: Result,
    out: Path | str,
    *,
    settings: TestSettings | None = None,
    frames: Sequence[int] | None = None,
    overwrite: bool = False,
) -> None:
    """Write the report of a result.

    Parameters
    ----------
    result
        The result.
    out
        HTML file to write; it appears once it is complete.
    settings
        Of which ``[setup]``, ``[scale]`` and ``[probes]`` stand in place of those that were kept; None: those kept.
    frames
        Indices of the frames of which maps are shown; None: three deformed ones that did not fail, evenly spaced,
        the last of them included, and the one that has moved farthest.
    overwrite
        Whether an existing file may be replaced.

    Raises
    ------
    InputError
        There is no such frame.
    ResultError
        The file exists, its folder does not, or a frame of the result is damaged.
    """
    from rgbmidic.results.physical import Physical  # numba comes with it

    out = Path(out)
    check_file(out, overwrite=overwrite)
    kept = result.provenance.get("settings", {}).get("setup", {})
    setup = read_section(SetupSettings, "setup", kept) if settings is None else settings.setup
    probes = probes_of(result) if settings is None else settings.probes
    told = Physical.of(result, None if settings is None else settings.scale)
    text = _Report.of(told, setup, probes, frames).page().html
    write_complete(out, lambda file: file.write(text.encode()))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Report:
    """What all sections of a report are made from."""

    told: Physical
    setup: SetupSettings
    probes: ProbeSettings
    course: Course
    floor: NoiseFloor | None
    shown: tuple[int, ...]

    @classmethod
    def of(cls, told: Physical, setup: SetupSettings, probes: ProbeSettings, frames: Sequence[int] | None) -> _Report:
        deformed = figures.shown_frames(told.result)
        for frame in frames or ():
            told.result.frame(frame)  # what is wrong with one is told before the long work
        course = Course.of(told, figures.spread(deformed, _MOST))
        measured = figures.spread(figures.measured_frames(told.result), _KEY)
        shown = tuple(sorted({*measured, course.farthest})) if frames is None else tuple(frames)
        return cls(told=told, setup=setup, probes=probes, course=course, floor=noise_floor(told), shown=shown)

    def page(self) -> Page:
        """The page, section by section."""
        result = self.told.result
        page = Page(f"Test report: {result.path.resolve().name}")
        page.text(self._summary())
        page.heading("Warnings")
        page.bullets(list(self._warnings()) or ["none"])
        page.heading("What was measured with what")
        page.table(("set-up", ""), list(hardware_rows(self.told, self.setup)))
        page.table(("analysis", ""), list(analysis_rows(self.told, self.floor)))
        self._fields(page)
        self._probes(page)
        self._uncertainty(page)
        self._lights(page)
        self._quality(page)
        self._provenance(page)
        return page

    def _summary(self) -> str:
        """The test in a few lines."""
        told, course = self.told, self.course
        result, length = told.result, told.units.length
        measured = course.shares[:, 0].mean()
        lines = [
            f"{len(result.deformed)} deformed frames against {reference_words(told)}; {len(result.nodes)} nodes, "
            f"{measured:.1%} of them measured."
        ]
        if np.isfinite(course.extreme("u") + course.extreme("v")):
            lines.append(
                f"The median node moves by up to {course.extreme('u'):.4g} {length} in x and {course.extreme('v'):.4g} "
                f"{length} in y, known to {course.median('u_std'):.2g} and {course.median('v_std'):.2g} {length} "
                "(standard uncertainty, median)."
            )
        lines.append("x is to the right and y down, on the reference image; blank means not measured.")
        return " ".join(lines)

    def _warnings(self) -> Iterator[str]:
        """What a reader of the numbers must know, the gravest first."""
        told, course = self.told, self.course
        result = told.result
        if missing := int((~result.finished).sum()):
            yield f"the run is not finished: {missing} of {len(result)} frames are missing"
        ends = result.status[list(result.deformed)]
        for code, word in ((2, "failed"), (1, "did not converge")):
            if count := int((ends == code).sum()):
                yield f"{count} of {len(ends)} frames {word}"
        lost = 1 - float(course.shares[:, 0].mean())
        if lost > _LOST:
            yield f"{lost:.0%} of the nodes are not measured"
        if gaps := result.provenance.get("lost_frames"):
            yield f"frames missing between those that are there, by number or time: {gaps}"
        yield from self._doubts()
        if told.units.mm_per_pixel is None:
            yield "no image scale is stated (`scale.mm_per_pixel`): lengths are in px"
        if not told.units.timed:
            yield "no frame rate is known (`scale.frame_rate`): time is in frames"

    def _doubts(self) -> Iterator[str]:
        """Warnings that follow from the numbers."""
        told, course, floor = self.told, self.course, self.floor
        exposure = told.result.provenance.get("exposure_ns")
        if exposure and told.units.timed and course.fastest * exposure * 1e-9 > _BLUR:
            yield (
                f"motion blur: the fastest node moves by {course.fastest * exposure * 1e-9:.2g} px while the frame is "
                f"exposed ({exposure / 1000:g} µs)"
            )
        if floor is not None:
            ratio = np.hypot(floor.measured["u"], floor.measured["v"]) / np.hypot(
                course.median("u_std"), course.median("v_std")
            )
            if ratio > _RATIO:
                yield f"static frames scatter {ratio:.2g} times as much as the stated uncertainty: vibration, flicker?"
        if course.median("misfit") > _MISFIT:
            yield "half of the nodes fit badly (`misfit`)"

    def _fields(self, page: Page) -> None:
        """Key frames as maps, and the course of the test."""
        told, length = self.told, self.told.units.length
        page.heading("Displacement and strain")
        page.text(
            f"Displacement in {length} and strain ({told.measure_name}, virtual strain gauge of "
            f"{told.in_units(told.gauges.length)}), at their places on the reference image."
        )
        for frame in self.shown:
            values = told.frame(frame)
            maps = {f"{name} ({length})": (values[name], values[f"{name}_std"]) for name in ("u", "v")}
            self._show(page, figures.field_figure(told.result, frame, maps), f"displacement, {self._when(frame)}")
            maps = {name: (values[name], values[f"{name}_std"]) for name in ("exx", "eyy", "exy")}
            self._show(page, figures.field_figure(told.result, frame, maps), f"strain, {self._when(frame)}")
        caption = "over the test: median of the nodes (line) and 5 to 95 % of them (band)"
        self._show(page, course_figure(told, self.course), f"displacement and strain {caption}")

    def _probes(self, page: Page) -> None:
        """What the probes of the settings read."""
        if not self.probes.places:
            return
        from rgbmidic.results.histories import read_histories

        page.heading("Probes")
        page.table(("probe", "place in px"), [(kind, _numbers(place)) for kind, place in self.probes.places])
        histories = read_histories(self.told.result, self.probes, scale=self.told.scale)
        self._show(
            page, history_figure(histories), "what the probes read; the bands are two standard uncertainties wide"
        )
        if histories.remarks:
            page.bullets(histories.remarks)

    def _uncertainty(self, page: Page) -> None:
        told, length = self.told, self.told.units.length
        page.heading("Uncertainty")
        page.text(f"Noise floor: {noise_words(told, self.floor)}.")
        if told.units.mm_per_pixel_std:
            page.text(
                "The uncertainty of the image scale is part of that of every length in mm, the same in all of them."
            )
        names = [*(f"{name}_std" for name in ("u", "v", "exx", "eyy", "exy"))]
        rows = [(name, length if name[0] in "uv" else "1", *self._spread_words(name)) for name in names]
        page.table(("standard uncertainty", "unit", "5 % of the nodes below", "median", "95 % below"), rows)
        caption = "stated standard uncertainty over the test, median of the nodes"
        caption += "" if self.floor is None else "; thin lines: noise floor of the static frames"
        self._show(page, uncertainty_figure(told, self.course, self.floor), caption)
        frame, values = self.shown[-1], told.frame(self.shown[-1])
        maps = {f"{name} ({length})": (values[name], values[name] * 0) for name in ("u_std", "v_std")}
        figure = figures.field_figure(told.result, frame, maps, positive=True)
        self._show(page, figure, f"standard uncertainty, {self._when(frame)}")

    def _spread_words(self, name: str) -> Iterator[str]:
        """Medians over the frames of the quantiles over the nodes."""
        known = self.course.quantiles[name]
        known = known[np.isfinite(known).all(axis=1)]
        return (f"{value:.3g}" for value in np.median(known, axis=0)) if len(known) else iter("---")

    def _lights(self, page: Page) -> None:
        result, frame = self.told.result, self.shown[-1]
        page.heading("Lights and reflections")
        self._show(page, figures.brightness_figure(result), "gain and offset of each light against the reference")
        self._show(page, figures.residual_figure(result), "residual of each light, and its share in what is measured")
        if len(result.lights) > 1:
            caption = f"share of each light in what determines the nodes, {self._when(frame)}"
            self._show(page, figures.fraction_figure(result, frame), caption)
        reflections = {"reflection index of each light": figures.reflection_figure(result, frame)}
        reflections["what the weights exclude of each light"] = figures.mask_figure(result, frame)
        for words, figure in reflections.items():
            if figure is not None:
                self._show(page, figure, f"{words}, {self._when(frame)}")

    def _quality(self, page: Page) -> None:
        result, frame = self.told.result, self.shown[-1]
        page.heading("Quality")
        ends = result.status[list(result.deformed)]
        rows = [(word, str(int((ends == code).sum()))) for code, word in enumerate(QUANTITIES["status"].codes)]
        page.table(("deformed frames", "number"), rows)
        odd = [index for index in result.deformed if result.status[index] != 0 and result.finished[index]]
        if odd:
            reasons = [
                (result.names[index], reason) for index, reason in zip(odd, result.each("reason", odd), strict=True)
            ]
            page.table(("frame", "what befell it"), reasons[:_LISTED])
            if len(odd) > _LISTED:
                page.text(f"And {len(odd) - _LISTED} more.")
        if self.course.shares[:, 0].min() < 1:
            self._show(page, status_figure(self.told, self.course), "how the nodes ended")
        else:
            page.text("Every node is measured in every frame.")
        self._show(page, figures.convergence_figure(result), "convergence: largest motion of a node in each iteration")
        self._show(page, figures.map_figure(result, frame, "misfit"), f"misfit: 1 is ordinary, {self._when(frame)}")

    def _provenance(self, page: Page) -> None:
        kept = self.told.result.provenance
        page.heading("Provenance")
        rows = [("measured", f"{kept['created']} to {kept.get('finished', 'not finished')}")]
        rows += [("result", str(self.told.result.path.resolve())), ("platform", kept.get("platform", ""))]
        rows += [(f"version of {name}", text) for name, text in kept["versions"].items()]
        if (calibration := kept.get("calibration")) is not None:
            rows.append(("calibration", f"{calibration['file']}, SHA-256 {calibration['sha256']}"))
        rows += [(f"input {name}", text) for name, text in kept["inputs"].items()]
        page.table(("what", ""), rows)
        page.table(("setting", "value"), list(settings_rows(kept.get("settings", {}))))

    def _when(self, frame: int) -> str:
        result, time = self.told.result, self.told.times[frame]
        factor, unit = time_unit(self.told.times)
        when = f" at {factor * time:.6g} {unit}" if self.told.units.timed else ""
        return f"frame {frame} ({result.names[frame]}){when}"

    @staticmethod
    def _show(page: Page, figure: Figure, caption: str) -> None:
        page.picture(embedded(figure), caption)


def _numbers(place: Sequence[float]) -> str:
    return ", ".join(f"{number:g}" for number in place)


_STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:64rem;margin:2rem auto;padding:0 1rem;color:#222}
h1{line-height:1.2}h2{margin-top:2.2rem;border-bottom:1px solid #ccc}
.table{overflow-x:auto}table{border-collapse:collapse;font-size:13px;margin:1rem 0}
td,th{border:1px solid #ccc;padding:.25rem .5rem;text-align:left;vertical-align:top;overflow-wrap:anywhere}
td:first-child,th{overflow-wrap:normal}th{background:#f3f3f3}
img{max-width:100%;max-height:54rem}figcaption{color:#555;font-size:13px}figure{margin:1rem 0}
@media print{@page{size:A4;margin:14mm}body{font-size:10pt;max-width:none;margin:0;padding:0}table{font-size:8.5pt}
figure,tr,li{break-inside:avoid}h1,h2{break-after:avoid}thead{display:table-header-group}
img{max-height:112mm}.table{overflow:visible}}"""


class Page:
    """Collects blocks in order; `write` puts them into a folder as ``report.md`` and ``report.html``."""

    def __init__(self, title: str) -> None:
        self.title = title
        self._markdown = [f"# {title}"]
        self._html = [f"<h1>{html.escape(title)}</h1>"]

    def heading(self, text: str) -> None:
        """A section's heading."""
        self._markdown.append(f"## {text}")
        self._html.append(f"<h2>{html.escape(text)}</h2>")

    def text(self, text: str) -> None:
        """A paragraph; words between backquotes are code."""
        self._markdown.append(text)
        self._html.append(f"<p>{_inline(text)}</p>")

    def bullets(self, texts: Sequence[str]) -> None:
        """A list of texts; words between backquotes are code."""
        self._markdown.append("\n".join(f"- {text}" for text in texts))
        self._html.append("<ul>" + "".join(f"<li>{_inline(text)}</li>" for text in texts) + "</ul>")

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """A table of texts."""
        lines = [header, ["---"] * len(header), *rows]
        self._markdown.append(
            "\n".join("| " + " | ".join(c.replace("|", "\\|") for c in line) + " |" for line in lines)
        )
        head = "".join(f"<th>{_inline(cell)}</th>" for cell in header)
        body = "".join("<tr>" + "".join(f"<td>{_inline(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        self._html.append(
            f'<div class="table"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        )

    def picture(self, source: str, caption: str) -> None:
        """A picture that lies in the page's folder, or is embedded (`rgbmidic.report.style.embedded`)."""
        self._markdown.append(f"![{caption}]({source})\n\n*{caption}*")
        cell = html.escape(caption)
        self._html.append(
            f'<figure><img src="{html.escape(source)}" alt="{cell}"><figcaption>{cell}</figcaption></figure>'
        )

    @property
    def html(self) -> str:
        """The page as HTML."""
        title, body = html.escape(self.title), "\n".join(self._html)
        return legible(
            f'<!doctype html><html lang="en"><meta charset="utf-8">'
            f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>'
            f"<style>{_STYLE}</style>{body}</html>\n"
        )

    def write(self, folder: Path) -> tuple[Path, Path]:
        """Write both pages; gives their paths."""
        markdown, page = folder / "report.md", folder / "report.html"
        markdown.write_text(legible("\n\n".join(self._markdown) + "\n"), encoding="utf-8")
        page.write_text(self.html, encoding="utf-8")
        return markdown, page


def _inline(text: str) -> str:
    return re.sub("`([^`]*)`", r"<code>\1</code>", html.escape(text))
