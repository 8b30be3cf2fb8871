"""The report of a test: what it says is what the result holds, and it needs no other file."""

from __future__ import annotations

import os
import re
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from results import LIGHTS, MESH, NODES, make_origin, make_result, random_record

from rgbmidic.errors import InputError, ResultError
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.results import UNKNOWN_TIME, FrameRecord, Maps, Result, ResultStore, read_profile
from rgbmidic.results.result_in_units import ResultInUnits
from rgbmidic.settings import (
    ChannelSettings,
    FrameSettings,
    ProbeSettings,
    RegionSettings,
    ScaleSettings,
    SetupSettings,
    TestSettings,
)
from rgbmidic.tools.report import curves, document, remove_pictures, style, write_batch_page, write_report
from rgbmidic.tools.report.noise_floor import noise_floor

X, Y = MESH.nodes.T
ROOM = (NODES, len(LIGHTS))


class Reader(HTMLParser):
    """Texts of a page's tables and paragraphs, addresses of its pictures, and whether every element is closed."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.rows: dict[str, str] = {}
        self.pictures: list[str] = []
        self.texts: list[str] = []
        self._cells: list[str] = []
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: Any) -> None:
        assert tag not in ("script", "link", "iframe"), "nothing that loads or runs"
        if tag == "img":
            self.pictures.append(dict(attributes)["src"])
        elif tag not in ("meta", "!doctype"):
            self.open.append(tag)
        if tag == "tr":
            self._cells = []
        if tag in ("td", "th"):
            self._cells.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag
        if tag == "tr":
            self.rows[self._cells[0]] = " | ".join(self._cells[1:])

    def handle_data(self, text: str) -> None:
        if self.open and self.open[-1] in ("td", "th", "code", "a") and self._cells:
            self._cells[-1] += text
        self.texts.append(text)

    @property
    def words(self) -> str:
        return "".join(self.texts)


def settings(**sections: Any) -> TestSettings:
    return TestSettings(frames=FrameSettings(path=("a",)), region=RegionSettings(rectangle=(0, 0, 9, 9)), **sections)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """No pictures: drawing them takes nearly all of the time."""
    monkeypatch.setattr(style, "data_url", lambda _: "data:image/png;base64,")
    for method in ("fields", "strip"):
        monkeypatch.setattr(document.figures.MapDrawer, method, lambda *_, **__: None)
    for module in (curves, document.figures, style):
        for name in [name for name in vars(module) if name.endswith("_figure")]:
            monkeypatch.setattr(module, name, lambda *_, **__: None)


def make(path: Path, records: list[FrameRecord], **options: Any) -> Result:
    with ResultStore.create(path, make_origin(len(records), **options)) as store:
        for index, record in enumerate(records):
            store.write_frame(index, record)
    return Result.open(path)


def still(index: int, noise: float, **values: Any) -> FrameRecord:
    """A frame of a body at rest, with the noise and uncertainty of u and v given in px."""
    u, v = np.random.default_rng(index).normal(0, noise, (2, NODES))
    std = np.full(NODES, noise)
    given = {"number": index, "status": 0, "u": u, "v": v, "u_std": std, "v_std": std} | values
    return FrameRecord.from_values(
        nodes=NODES, lights=len(LIGHTS), node_status=np.zeros(NODES, dtype=np.uint8), **given
    )


def test_the_page_is_whole_and_needs_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(style, "data_url", partial(style.data_url, dpi=40))  # coarse: for the time
    for name in ("brightness", "convergence", "residual"):  # have tests of their own
        monkeypatch.setattr(document.figures, f"{name}_figure", lambda *_: Figure(facecolor="red"))
    image = np.random.default_rng(0).normal(1000, 100, (3, 80, 120))
    probes = ProbeSettings(points=((60.0, 40.0),))
    records = [still(index, 0.01, u=np.full(NODES, float(index))) for index in range(4)]
    result = make(tmp_path / "result", records, reference=image, settings=settings(probes=probes))
    write_report(result, tmp_path / "a.html", frames=[2])
    page = Reader(tmp_path / "a.html")
    assert page.open == []
    assert len(page.pictures) >= 11
    assert "larger principal strain (Green-Lagrange) in key frames" in page.words
    assert all(re.fullmatch("data:image/png;base64,[A-Za-z0-9+/=]{1000,}", source) for source in page.pictures)
    assert "http" not in (tmp_path / "a.html").read_text(encoding="utf-8")
    for heading in (
        "Warnings",
        "What was measured with what",
        "Uncertainty",
        "Lights",
        "Quality",
        "Provenance",
        "Probes",
    ):
        assert heading in page.words


@pytest.mark.usefixtures("undrawn")
def test_a_result_in_a_folder_whose_name_is_no_text_has_a_report(tmp_path: Path) -> None:
    try:
        result = make(tmp_path / os.fsdecode(b"k\xf6rper"), [still(0, 0.01)])
    except ResultError:
        pytest.skip("a file system of names in UTF-8")
    write_report(result, tmp_path / "a.html")
    assert "k\\xf6rper" in Reader(tmp_path / "a.html").words


@pytest.mark.usefixtures("undrawn")
def test_it_says_what_is_stated_and_what_is_not(tmp_path: Path) -> None:
    setup = SetupSettings(lens='50 mm, "f/2" <script>', loading="three-point bending")
    scale = ScaleSettings(mm_per_pixel=0.05, mm_per_pixel_std=0.001)
    notes = {"frame_rate": 5e4, "exposure_ns": 1500, "lost_frames": 2}
    records = [still(index, 0.01, time_ns=20_000 * index) for index in range(3)]
    image = np.random.default_rng(0).normal(1000, 100, (3, 80, 120))
    stated = settings(setup=setup, scale=scale)
    write_report(make(tmp_path / "r", records, reference=image, notes=notes, settings=stated), tmp_path / "a.html")
    page = Reader(tmp_path / "a.html")
    assert page.rows["lens"] == '50 mm, "f/2" <script>'
    assert page.rows["loading"] == "three-point bending"
    assert page.rows["camera"] == "not stated (setup.camera)"
    assert page.rows["image"] == "120 x 80 px; field of view 6 x 4 mm"
    assert page.rows["image scale"].startswith("0.0500 ± 0.0010 mm per px")
    assert page.rows["frame rate"].startswith("50000 frames per second")
    assert page.rows["exposure"] == "1.5 µs"
    assert page.rows["virtual strain gauge"] == f"{3 * MESH.size:.4g} px ({0.15 * MESH.size:.3g} mm), at every node"
    assert page.rows["data point spacing"].endswith("at the nodes")
    assert page.rows["spatial resolution"].startswith(f"displacement {2.2 * stated.mesh.element_size:.2g} px (")
    assert page.rows["elements"].endswith(
        f"side {stated.mesh.element_size:.4g} px ({0.05 * stated.mesh.element_size:.3g} mm)"
    )
    assert page.rows["image filter"].startswith("[1 2 1]")
    assert page.rows["σ(u)"].startswith("mm | ")
    assert "by number or time: 2" in page.words
    assert "no image scale" not in page.words
    methods = page.words[page.words.index("The surface was patterned") :]
    assert "<mark>[camera]</mark> with 50 mm" in (tmp_path / "a.html").read_text(encoding="utf-8")
    assert '[camera] with 50 mm, "f/2" <script> recorded 120 x 80 px at 50000 frames per second' in methods
    assert "exposure 1.5 µs" in methods
    assert f"triangles of {stated.mesh.element_size:.4g} px ({0.05 * stated.mesh.element_size:.3g} mm)" in methods
    assert "noise floor is [noise floor of static frames]" in methods


@pytest.mark.usefixtures("undrawn")
def test_the_frame_rate_is_the_one_that_the_times_follow(tmp_path: Path) -> None:
    """As `frame_times`: time stamps first, then what is stated, then what the camera's file holds."""
    kept = {"notes": {"frame_rate": 1000.0}, "settings": settings(scale=ScaleSettings(frame_rate=500.0))}
    for name, clock, wanted in (
        ("stamped", 1_000_000, "1000 frames per second (by the cam"),
        ("a", 0, "500 frames per s"),
    ):
        times = [clock * index if clock else UNKNOWN_TIME for index in range(3)]
        result = make(tmp_path / name, [still(index, 0.01, time_ns=time) for index, time in enumerate(times)], **kept)
        write_report(result, tmp_path / f"{name}.html")
        assert Reader(tmp_path / f"{name}.html").rows["frame rate"].startswith(wanted)
    write_report(result, tmp_path / "b.html", settings=settings(scale=ScaleSettings(frame_rate=250.0)))
    assert Reader(tmp_path / "b.html").rows["frame rate"] == "250 frames per second (as stated)"


@pytest.mark.usefixtures("undrawn")
def test_calibration_exposure_and_stress_are_in_the_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    crosstalk = Crosstalk(lights=LIGHTS, matrix=[[1, 0.1, 0], [0.2, 1, 0.3], [0, 0.1, 1]], std=np.full((3, 3), 2e-4))
    origin = {"crosstalk": {"date": "today", "inputs": [{}, {}], "warnings": ["drift"]}}
    figures = Calibration(crosstalk=crosstalk, noise=NoiseModel(gain=0.5, read_noise=3.0), provenance=origin).figures()
    exposure = [{"light": light, "median": 0.301, "excluded": 0.02} for light in LIGHTS]
    (tmp_path / "c.csv").write_text("time_s,load_N\n0,0\n1,10\n")
    channels = ChannelSettings(file=tmp_path / "c.csv", area=2.0)
    stated = settings(
        channels=channels, probes=ProbeSettings(gauges=((20.0, 20.0, 90.0, 60.0),)), scale=ScaleSettings(frame_rate=10)
    )
    notes = {"calibration_figures": figures, "reference_exposure": exposure}
    result = make(tmp_path / "r", [still(index, 0.01) for index in range(3)], notes=notes, settings=stated)
    seen: list[Any] = []
    monkeypatch.setattr(curves, "history_figure", lambda *given: seen.append(given))
    write_report(result, tmp_path / "a.html")
    page = Reader(tmp_path / "a.html")
    assert page.rows["channel 2"] == "0.20000 ± 0.00020 | 1 | 0.30000 ± 0.00020"
    assert page.rows[LIGHTS[0]] == "30.1% | 2.00%"
    assert page.rows["noise model"] == "gain 0.5, read_noise 3"
    assert page.rows["crosstalk measured"] == "today, from 2 files"
    assert page.rows["crosstalk: warning"] == "drift"
    histories, _ = seen[0]
    assert all(0 < len(panels) <= 4 for _, panels in seen), "a picture fits a page"
    np.testing.assert_allclose(histories["stress"].values, [0, 0.5, 1.0])


def test_key_frames_share_the_change_of_the_field(tmp_path: Path) -> None:
    """At rest, then a fast event, then slow motion: frames where the path of the field has equal parts."""
    moved = np.r_[np.zeros(10), np.linspace(0, 9, 10), np.linspace(9, 10, 11)[1:]]
    result = make(tmp_path / "r", [still(i, 1e-9, u=np.full(NODES, u)) for i, u in enumerate(moved)])
    history = curves.TimeHistory(ResultInUnits.from_result(result), range(len(moved)))
    assert history.key_frames(5) == (12, 14, 16, 18, 29)


@pytest.mark.usefixtures("undrawn")
def test_other_settings_stand_in_place_of_those_kept(tmp_path: Path) -> None:
    result = make_result(tmp_path / "r", settings=settings(setup=SetupSettings(lens="old")))
    write_report(result, tmp_path / "a.html")
    assert Reader(tmp_path / "a.html").rows["lens"] == "old"
    assert "lengths are in px" in Reader(tmp_path / "a.html").words
    now = settings(setup=SetupSettings(lens="new"), scale=ScaleSettings(mm_per_pixel=2.0))
    write_report(result, tmp_path / "a.html", settings=now, overwrite=True)
    assert Reader(tmp_path / "a.html").rows["lens"] == "new"
    assert Reader(tmp_path / "a.html").rows["image scale"] == "2 mm per px"


@pytest.mark.usefixtures("undrawn")
def test_warnings_tell_what_is_wrong(tmp_path: Path) -> None:
    fast = [still(index, 0.01, u=np.full(NODES, 30.0 * index), time_ns=10_000 * index) for index in range(3)]
    failed = FrameRecord.failed("too <dark>", nodes=NODES, lights=len(LIGHTS), number=3, time_ns=30_000)
    result = make(tmp_path / "r", [*fast, failed], notes={"exposure_ns": 1000})
    write_report(result, tmp_path / "a.html")
    page = Reader(tmp_path / "a.html")
    assert "1 of 3 frames failed" in page.words
    assert page.rows["frame 3"] == "too <dark>"
    assert "33% of the nodes are not measured" in page.words
    assert "motion blur: the fastest node moves by 3 px" in page.words


@pytest.mark.usefixtures("undrawn")
def test_a_quiet_test_has_no_warning(tmp_path: Path) -> None:
    records = [still(index, 0.01, time_ns=10_000 * index) for index in range(3)]
    result = make(tmp_path / "r", records, settings=settings(scale=ScaleSettings(mm_per_pixel=1.0)))
    write_report(result, tmp_path / "a.html")
    assert re.search(r"Warnings\s*none", Reader(tmp_path / "a.html").words)


@pytest.mark.usefixtures("undrawn")
def test_what_the_run_warned_of_stands_in_the_report(tmp_path: Path) -> None:
    """Of the test, of frames in one line a text, and what only all frames together show."""
    records = [still(index, 0.01, warnings=["a lamp is <out>"] if index in (1, 2, 4) else []) for index in range(5)]
    with ResultStore.create(tmp_path / "r", make_origin(5, notes={"warnings": ["clipped"]})) as store:
        for index, record in enumerate(records):
            store.write_frame(index, record)
        store.finish(["all repeat"])
    result = Result.open(tmp_path / "r")
    lines = f"frames 1 to 2, 4 ({result.names[1]}, ...): a lamp is <out>"
    assert result.warnings == ("clipped", "all repeat", lines)
    write_report(result, tmp_path / "a.html")
    assert re.search(rf"Warnings\s*clipped\s*all repeat\s*{re.escape(lines)}", Reader(tmp_path / "a.html").words)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("records", [[], [0], [1, 3]])
def test_a_run_that_is_not_finished_is_told(tmp_path: Path, records: list[int]) -> None:
    with ResultStore.create(tmp_path / "r", make_origin(4)) as store:
        for index in records:
            store.write_frame(index, random_record(index))
    write_report(Result.open(tmp_path / "r", partial=True), tmp_path / "a.html")
    assert f"{4 - len(records)} of 4 frames are missing" in Reader(tmp_path / "a.html").words


def test_nothing_is_overwritten_or_left_behind(tmp_path: Path) -> None:
    result, page = make_result(tmp_path / "r"), tmp_path / "a.html"
    page.write_text("mine")
    with pytest.raises(ResultError, match="already exists"):
        write_report(result, page)
    with pytest.raises(ResultError, match="no folder"):
        write_report(result, tmp_path / "none" / "a.html")
    with pytest.raises(InputError, match="no frame 9"):
        write_report(result, tmp_path / "b.html", frames=[9])
    with pytest.raises(InputError, match=r"\.html or \.htm, not r\.pdf.*print it"):
        write_report(result, tmp_path / "r.pdf")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.html", "r"]
    assert page.read_text() == "mine"


def test_the_page_of_a_batch_links_its_reports_and_escapes_what_it_is_given(tmp_path: Path) -> None:
    (tmp_path / "a & b").mkdir()
    (tmp_path / "a & b" / "report.html").touch()
    rows = [
        ["a & b", "measured", "", str(tmp_path / "a & b"), "3 < 4"],
        ["c", "failed", "no <b> of `d`", "", ""],
        ["later", "", "", "", ""],
    ]
    write_batch_page(["test", "ended", "reason", "folder", "modulus"], rows, tmp_path / "summary.html")
    page = Reader(tmp_path / "summary.html")
    assert page.rows == {"": "a & b | c | later", "ended": "measured | failed | ", "modulus": "3 < 4 |  | "}
    assert "2 tests, 1 failed" in page.words
    assert "c: no <b> of d" in page.words
    assert '<a href="a%20%26%20b/report.html">a &amp; b</a>' in (tmp_path / "summary.html").read_text(encoding="utf-8")


def test_the_report_of_an_earlier_run_is_removed_and_nothing_else(tmp_path: Path) -> None:
    for name in ("report.html", "mine.html"):
        (tmp_path / name).touch()
    remove_pictures(tmp_path)
    remove_pictures(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["mine.html"]


@pytest.mark.parametrize("count", [5, 30])
def test_the_noise_floor_is_what_a_frame_scatters_by_against_the_reference(tmp_path: Path, count: int) -> None:
    """Static frames of known noise, each told against the mean of all: s sqrt(1 + 1/n) to within what n nodes know."""
    noise = np.random.default_rng(1).normal(0, 0.02, (2, count, NODES))
    u, v = noise - noise.mean(axis=1, keepdims=True)
    records = [still(index, 0.02, u=u[index], v=v[index]) for index in range(count)]
    frames = FrameSettings(path=("a",), reference=tuple(range(count)))
    stated = TestSettings(frames=frames, region=RegionSettings(rectangle=(0, 0, 9, 9)))
    origin = {"references": range(count), "settings": stated}
    floor = noise_floor(
        ResultInUnits.from_result(make(tmp_path / "r", records, **origin), ScaleSettings(mm_per_pixel=0.1))
    )
    assert floor is not None
    assert floor.count == count
    accuracy = 4 / np.sqrt(2 * (count - 1) * NODES)
    for name, field in (("u", u), ("v", v)):
        assert floor.single_frame[name] == pytest.approx(0.1 * 0.02 * np.sqrt(1 + 1 / count), rel=accuracy)
        common = np.std(field.mean(axis=1), ddof=1) * np.sqrt(1 + 1 / count)
        assert floor.common_mode[name] == pytest.approx(0.1 * common, rel=1e-4)


def test_one_static_frame_tells_no_noise(tmp_path: Path) -> None:
    assert noise_floor(ResultInUnits.from_result(make(tmp_path / "r", [still(0, 0.0), still(1, 0.1)]))) is None


@pytest.mark.parametrize("noise", [0.0, 0.5])
@pytest.mark.parametrize("sigma", [1.0, 1.5, 3.0])
def test_speckle_size_is_the_width_of_the_autocorrelation(tmp_path: Path, sigma: float, noise: float) -> None:
    """White noise filtered by a Gaussian has one sqrt 2 times as wide as it; camera noise has no width."""
    white, more = np.random.default_rng(0).normal(size=(2, 3, 80, 120)).astype(np.float32)
    texture = np.stack([cv2.GaussianBlur(image, (0, 0), sigma) for image in white])
    reference = texture / texture.std() + noise * more
    size = document.speckle_size(make(tmp_path / "r", [still(0, 0.01)], reference=reference))
    assert size == pytest.approx(2 * np.sqrt(2 * np.log(2)) * np.sqrt(2) * sigma, rel=0.08)


MIDDLE = "the longer side of the region, through its middle"


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("count", "lines", "missing", "expected"),
    [
        (11, (), False, f"strain exx along {MIDDLE}, from (10, 40) to (110, 40) px"),
        (11, ((30, 20, 35, 60),), False, "strain eyy along line_1, from (30, 20) to (35, 60) px"),
        (11, (), True, ""),
        (10, (), False, ""),
    ],
)  # fmt: skip
def test_position_against_time_is_along_the_stated_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int, lines: Any, missing: bool, expected: str
) -> None:
    """The first frame is the reference, and no part of it."""
    seen: list[Any] = []
    monkeypatch.setattr(curves, "profile_figure", lambda profile: seen.append(profile) or Figure())
    part = np.where((np.abs(Y - 40) < 15) & missing, np.nan, 0.1)
    records = [still(index, 0.01, u=part, u_std=part, time_ns=20_000 * index) for index in range(count)]
    result = make(tmp_path / "r", records, settings=settings(probes=ProbeSettings(lines=lines)))
    write_report(result, tmp_path / "a.html")
    words = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert [*re.findall(r'alt="(strain e.. along [^:]*):', words)] == [expected] * bool(expected)
    assert ("Nothing is shown along the longer side" in words) == missing
    assert len(seen) == bool(expected)
    for profile in seen:
        ends = lines[0] if lines else (X.min(), np.mean([Y.min(), Y.max()]), X.max(), np.mean([Y.min(), Y.max()]))
        read = read_profile(Maps.from_result(result), profile.field.name, ends, range(1, count))
        np.testing.assert_array_equal(profile.values, read.values)
        np.testing.assert_allclose(profile.times, 2e-5 * np.arange(1, count))
        assert f"against time in {count - 1} of {count - 1} measured frames" in words
