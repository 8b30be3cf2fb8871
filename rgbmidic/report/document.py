"""Report of a test: one HTML page of text, tables and pictures that needs no other file and no network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from rgbmidic._version import __version__
from rgbmidic.errors import InputError
from rgbmidic.report import figures
from rgbmidic.report import setup as tables
from rgbmidic.report.curves import field_history_figure, history_figure, status_figure, uncertainty_figure
from rgbmidic.report.gallery import REPORT
from rgbmidic.report.page import Page
from rgbmidic.report.style import PAGE_DPI, embedded, time_text
from rgbmidic.results import QUANTITIES, Maps, Result, channels_of, probes_of, rounded, uncertain
from rgbmidic.results.files import check_file, write_complete
from rgbmidic.results.physical import Physical
from rgbmidic.settings import ChannelSettings, ProbeSettings, SetupSettings, TestSettings, read_section
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
        There is no such frame.
    ResultError
        The file exists, its folder does not, or a frame of the result is damaged.
    """
    out = Path(out)
    check_file(out, overwrite=overwrite)
    kept = result.provenance.get("settings", {}).get("setup", {})
    setup = read_section(SetupSettings, "setup", kept) if settings is None else settings.setup
    probes = probes_of(result) if settings is None else settings.probes
    channels = channels_of(result) if settings is None else settings.channels
    physical = Physical.of(result, None if settings is None else settings.scale)
    text = _Report(physical, setup, probes, channels, frames).page().html
    write_complete(out, lambda file: file.write(text.encode()))


class _Report:
    """Data that all sections of a report are made from."""

    def __init__(
        self,
        physical: Physical,
        setup: SetupSettings,
        probes: ProbeSettings,
        channels: ChannelSettings,
        frames: Sequence[int] | None,
    ) -> None:
        result = physical.result
        for frame in frames or ():
            result.frame(frame)  # an error of one is raised before the long work
        self.physical, self.setup, self.probes, self.channels = physical, setup, probes, channels
        self.history = tables.TimeHistory(physical, figures.spread(figures.shown_frames(result), _MOST))
        measured = figures.spread(figures.measured_frames(result), _SHOWN)
        self.shown = tuple(sorted({*measured, self.history.farthest})) if frames is None else tuple(frames)
        self.floor = tables.noise_floor(physical)
        self.maps = figures.MapDrawer(Maps(result=result, physical=physical), PAGE_DPI)

    def page(self) -> Page:
        """Build the page, section by section."""
        result = self.physical.result
        page = Page(f"Test report: {result.path.resolve().name}")
        page.text(self._summary())
        page.heading("Warnings")
        page.bullets(list(self._warnings()) or ["none"])
        page.heading("What was measured with what")
        page.table(("set-up", ""), list(tables.hardware_rows(self.physical, self.setup)))
        page.table(("analysis", ""), list(tables.analysis_rows(self.physical, self.floor)))
        page.heading("Methods, for a paper")
        page.text(tables.methods_text(self.physical, self.setup, self.floor))
        page.text(
            "Please cite the method (M. Poncelet and H. Leclerc, A Digital Image Correlation algorithm with light "
            "reflection compensation, Experimental Mechanics, 2015) and the program (rgbmidic, with its version)."
        )
        self._fields(page)
        self._probes(page)
        self._along(page)
        self._uncertainty(page)
        self._lights(page)
        self._quality(page)
        self._provenance(page)
        return page

    def _summary(self) -> str:
        """Summarise the test in a few sentences."""
        history, result, length = self.history, self.physical.result, self.physical.units.length
        x, y, x_std, y_std = *map(history.extreme, ("u", "v")), *map(history.median, ("u_std", "v_std"))
        text = f"{len(result.deformed)} deformed frames against {tables.reference_text(self.physical)}; "
        text += f"{len(result.nodes)} nodes, {history.fractions[:, 0].mean():.1%} of them measured. "
        if np.isfinite(x + y):
            moved = uncertain(abs(x), x_std, length), uncertain(abs(y), y_std, length)
            text += f"The median node moves by up to {moved[0]} in x and {moved[1]} in y. "
        return text + "x is to the right and y down, on the reference image; blank means not measured."

    def _warnings(self) -> Iterator[str]:
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

    def _fields(self, page: Page) -> None:
        """Add maps of some frames, and the fields over the time."""
        physical, length = self.physical, self.physical.units.length
        page.heading("Displacement and strain")
        page.text(
            f"Displacement in {length} and strain ({physical.measure_name}, virtual strain gauge of "
            f"{physical.in_units(physical.gauges.length)}), at their places on the reference image."
        )
        if len(keys := self.history.key_frames(_KEYS)) > 2:
            strips: dict[str, list[tuple[str, FloatArray]]] = {}
            for frame in keys:
                values, title = physical.frame(frame), self._when(frame, short=True)
                strips.setdefault(f"displacement ({length})", []).append((title, np.hypot(values["u"], values["v"])))
                strips.setdefault(f"larger principal strain ({physical.measure_name})", []).append(
                    (title, values["e1"])
                )
            for label, strip in strips.items():
                _show(
                    page,
                    self.maps.strip(strip, label),
                    f"{label} in key frames, between which the field changes by equal amounts",
                )
        for frame in self.shown:
            _show(page, self.maps.fields(frame, ("u", "v")), f"displacement, {self._when(frame)}")
            _show(page, self.maps.fields(frame, ("exx", "eyy", "exy")), f"strain, {self._when(frame)}")
        caption = "over the test: median of the nodes (line) and 5 to 95 % of them (band)"
        _show(page, field_history_figure(physical, self.history), f"displacement and strain {caption}")

    def _probes(self, page: Page) -> None:
        """Add place and time history of the probes."""
        if not self.probes.places:
            return
        from rgbmidic.results.histories import read_histories

        page.heading("Probes")
        places = [(kind, ", ".join(f"{number:g}" for number in place)) for kind, place in self.probes.places]
        page.table(("probe", "place in px"), places)
        histories = read_histories(self.physical.result, self.probes, scale=self.physical.scale, channels=self.channels)
        caption = "time history of the probes; the bands extend two standard uncertainties to both sides"
        _show(page, history_figure(histories), caption)
        if histories.remarks:
            page.bullets(histories.remarks)

    def _along(self, page: Page) -> None:
        """Add position against time along the lines of the probes, else through the middle of the region."""
        physical, measured = self.physical, figures.measured_frames(self.physical.result)
        if not physical.units.timed or len(measured) < _FEWEST:
            return
        from rgbmidic.report.curves import profile_figure
        from rgbmidic.results.profiles import read_profile

        nodes = physical.result.nodes
        middle, (wide, tall) = (nodes.min(axis=0) + nodes.max(axis=0)) / 2, np.ptp(nodes, axis=0) / 2
        reach = np.array([wide, 0.0] if wide >= tall else [0.0, tall])
        along = "the longer side of the region, through its middle"
        lines = {"line": (*(middle - reach), *(middle + reach))}
        if stated := [place for kind, place in self.probes.places if kind == "line"]:
            lines, along = {f"line_{number}": place for number, place in enumerate(stated, 1)}, ""
        page.heading("Along a line")
        maps, frames = self.maps.maps, figures.spread(measured, _MOST)
        for name, place in lines.items():
            x0, y0, x1, y1 = place
            field = "exx" if abs(x1 - x0) >= abs(y1 - y0) else "eyy"
            ends = f"({x0:.0f}, {y0:.0f}) to ({x1:.0f}, {y1:.0f}) px"
            where = f"{along or f'`{name}`'}, from {ends}"
            try:
                figure = profile_figure(read_profile(maps, field, place, frames))
            except InputError as error:
                page.text(f"Nothing is shown along {where}: {error}.")
                continue
            caption = f"strain {field} along {where.replace('`', '')}: position, from the first end, against time in "
            caption += (
                f"{len(frames)} of {len(measured)} measured frames, and the strain along the line in some frames "
            )
            _show(page, figure, caption + "with bands of two standard uncertainties")

    def _uncertainty(self, page: Page) -> None:
        physical, length = self.physical, self.physical.units.length
        page.heading("Uncertainty")
        page.text(f"Noise floor: {tables.noise_text(physical, self.floor)}.")
        if physical.units.mm_per_pixel_std:
            page.text(
                "The uncertainty of the image scale is part of that of every length in mm, the same in all of them."
            )
        if self.floor is not None:
            heads = ("noise floor", "unit", "standard deviation", "of the mean over the nodes", "stated, median")
            page.table(heads, list(tables.noise_rows(physical, self.floor, self.history)))
        rows = []
        for name in ("u_std", "v_std", "exx_std", "eyy_std", "exy_std"):
            known = self.history.quantiles[name]
            known = known[np.isfinite(known).all(axis=1)]
            numbers = [rounded(value, value) for value in np.median(known, axis=0)] if len(known) else "---"
            rows.append((name, length if name[0] in "uv" else "1", *numbers))
        page.table(("standard uncertainty", "unit", "5 % of the nodes below", "median", "95 % below"), rows)
        caption = "stated standard uncertainty over the test, median of the nodes"
        caption += "" if self.floor is None else "; thin lines: noise floor of the static frames"
        _show(page, uncertainty_figure(physical, self.history, self.floor), caption)
        frame = self.shown[-1]
        _show(page, self.maps.fields(frame, ("u_std", "v_std")), f"standard uncertainty, {self._when(frame)}")
        both = self.maps.discretisation(frame)
        if both is not None:
            caption = "noise and discretisation error together; above 1 on the right a finer mesh is needed"
            _show(page, both, f"{caption}, {self._when(frame)}")

    def _lights(self, page: Page) -> None:
        result, frame = self.physical.result, self.shown[-1]
        page.heading("Lights and reflections")
        for heads, rows in tables.calibration_tables(result):
            page.table(heads, rows)
        _show(page, figures.brightness_figure(result), "gain and offset of each light against the reference")
        _show(page, figures.residual_figure(result), "residual of each light, and its fraction in the nodes")
        if len(result.lights) > 1:
            caption = f"fraction of each light in what determines the nodes, {self._when(frame)}"
            _show(page, self.maps.fractions(frame), caption)
        for caption, figure in (
            ("reflection index of each light", figures.reflection_figure(result, frame)),
            ("part of each light that the weights exclude", figures.mask_figure(result, frame)),
        ):
            if figure is not None:
                _show(page, figure, f"{caption}, {self._when(frame)}")

    def _quality(self, page: Page) -> None:
        result, frame = self.physical.result, self.shown[-1]
        page.heading("Quality")
        ends = result.status[list(result.deformed)]
        rows = [(word, str(int((ends == code).sum()))) for code, word in enumerate(QUANTITIES["status"].codes)]
        page.table(("deformed frames", "number"), rows)
        odd = [index for index in result.deformed if result.status[index] != 0 and result.finished[index]]
        if odd:
            names = [result.names[index] for index in odd[:_LISTED]]
            page.table(("frame", "reason"), list(zip(names, result.each("reason", odd[:_LISTED]), strict=True)))
            if len(odd) > _LISTED:
                page.text(f"And {len(odd) - _LISTED} more.")
        if self.history.fractions[:, 0].min() < 1:
            _show(page, status_figure(self.history), "status of the nodes")
        else:
            page.text("Every node is measured in every frame.")
        _show(page, figures.convergence_figure(result), "convergence: largest motion of a node in each iteration")
        _show(page, self.maps.fields(frame, ("misfit",)), f"misfit: 1 is ordinary, {self._when(frame)}")

    def _provenance(self, page: Page) -> None:
        kept = self.physical.result.provenance
        page.heading("Provenance")
        rows = [("measured", f"{kept['created']} to {kept.get('finished', 'not finished')}")]
        rows += [("result", str(self.physical.result.path.resolve())), ("platform", kept.get("platform", ""))]
        rows.append(("processor and BLAS", kept["machine"]))
        rows += [(f"version of {name}", text) for name, text in kept["versions"].items()]
        if (calibration := kept.get("calibration")) is not None:
            rows.append(("calibration", f"{calibration['file']}, SHA-256 {calibration['sha256']}"))
        rows += [(f"input {name}", text) for name, text in kept["inputs"].items()]
        page.table(("what", ""), rows)
        page.table(("setting", "value"), list(tables.settings_rows(kept.get("settings", {}))))

    def _when(self, frame: int, *, short: bool = False) -> str:
        times = self.physical.times
        when = f" at {time_text(times[frame], times)}" if self.physical.units.timed else ""
        if short:
            return f"frame {frame}{when.replace(' at', ',')}"
        return f"frame {frame} ({self.physical.result.names[frame]}){when}"


def _show(page: Page, figure: Figure, caption: str) -> None:
    page.picture(embedded(figure), caption)


def write_batch_page(header: Sequence[str], rows: Sequence[Sequence[str]], path: Path) -> None:
    """Write the table of a batch (`rgbmidic.pipeline.batch.summary_rows`) as a page with links to the tests' reports.

    Parameters
    ----------
    header, rows
        Of the table; the fourth column is a test's folder.
    path
        HTML file to write.
    """
    page = Page("Tests of a batch")
    failed = [(row[0], row[2]) for row in rows if row[1] == "failed"]
    page.text(f"{len([row for row in rows if row[1]])} tests, {len(failed)} failed; written by rgbmidic {__version__}.")
    names = []
    for name, _, _, folder, *_ in rows:
        report = Path(folder) / REPORT
        link = report.relative_to(path.parent).as_posix() if folder and report.is_file() else ""
        names.append(f"[{name}]({quote(link)})" if link else name)
    page.table(["", *names], [[header[place], *(row[place] for row in rows)] for place in (1, *range(4, len(header)))])
    if failed:
        page.heading("Failed")
        page.bullets([f"{name}: {reason}" for name, reason in failed])
    write_complete(path, lambda file: file.write(page.html.encode()))
