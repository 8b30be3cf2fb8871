"""What probes read off a result: right columns, units and times; what is wrong or unknown is one clear line."""

from __future__ import annotations

import csv
import io
import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from results import MESH, NODES, make_origin, make_result, smooth_record

from rgbmidic.cli import app as cli
from rgbmidic.cli.command import execute
from rgbmidic.errors import ConfigurationError, InputError
from rgbmidic.fields import Field, Units
from rgbmidic.fields.history import rate_words
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.results import (
    UNKNOWN_TIME,
    Channels,
    FrameRecord,
    Histories,
    Maps,
    Origin,
    Result,
    ResultStore,
    frame_times,
    history_rows,
    write_histories,
)
from rgbmidic.results.histories import history_csv, read_histories, with_channels
from rgbmidic.results.result_in_units import ResultInUnits
from rgbmidic.settings import (
    ChannelSettings,
    FrameSettings,
    ProbeSettings,
    RegionSettings,
    ScaleSettings,
    TestSettings,
)
from rgbmidic.tools.report import history_figure

NUMBERS = (0, 1, 2, 4, 5, 6, 7, 8)
"""Of the frames: number 3 is lost."""
RATE = 1000.0
SCALE = ScaleSettings(mm_per_pixel=0.05, mm_per_pixel_std=1e-4)
PLACE = (53.3, 47.1)
LOST_NODE = int(np.argmin(np.hypot(*(MESH.nodes - [50, 45]).T)))


def stretch(number: int) -> np.ndarray:
    """u and v (2, N): 1 % along x in 10 frames, growing with the square of the time, and a shift of 2 px a frame."""
    share = (number / 10) ** 2
    return np.stack([0.01 * share * (MESH.nodes[:, 0] - 10) + 2 * number, np.zeros(NODES)])


def struck(number: int) -> np.ndarray:
    """u and v (2, N): at rest up to the frame number 5, then 3 px a frame along x."""
    return np.stack([np.full(NODES, 3.0 * max(number - 5, 0)), np.zeros(NODES)])


def make(
    path: Path,
    *,
    timed: bool = True,
    scale: ScaleSettings | None = None,
    motion: Callable[[int], np.ndarray] = stretch,
    **notes: Any,
) -> Result:
    settings = TestSettings(
        frames=FrameSettings(path=("f*.tif",), kind="monochrome"),
        region=RegionSettings(rectangle=(10, 5, 110, 75)),
        scale=scale or ScaleSettings(),
        probes=ProbeSettings(points=(PLACE,)),
    )
    origin = replace(make_origin(len(NUMBERS), settings=settings, notes=notes), lights=("light",))
    with ResultStore.create(path, origin) as store:
        for index, number in enumerate(NUMBERS):
            u, v = motion(number)
            std = np.full(NODES, 0.01 if index else 0.0)
            if index == 5:
                u[LOST_NODE] = v[LOST_NODE] = std[LOST_NODE] = np.nan
            record = FrameRecord.from_values(
                nodes=NODES,
                lights=1,
                status=0,
                number=number,
                time_ns=round(number * 1e9 / RATE) + 2_000 if timed else UNKNOWN_TIME,
                **{"u": u, "v": v, "u_std": std, "v_std": std},
                light_fraction=np.ones((NODES, 1)),
            )
            store.write_frame(index, record)
        store.finish()
    return Result.open(path)


@pytest.fixture
def result(tmp_path: Path) -> Result:
    return make(tmp_path / "out", scale=SCALE, exposure_ns=200_000)


def read(result: Result, **options: Any) -> Histories:
    chosen = {
        key: options.pop(key)
        for key in list(options)
        if key in ("points", "gauges", "strain_gauges", "regions", "window")
    }
    return read_histories(result, ProbeSettings(**chosen), **options)


def test_a_point_is_told_in_mm_and_seconds_with_the_uncertainty_of_the_scale(result: Result) -> None:
    found = read(result, points=(PLACE,))
    np.testing.assert_allclose(found.times, np.array(NUMBERS) / RATE + 2e-6)
    u = found["point_1_u_mm"]
    pixels = np.array([0.01 * (n / 10) ** 2 * (PLACE[0] - 10) + 2 * n for n in NUMBERS])
    known = np.arange(len(NUMBERS)) != 5
    np.testing.assert_allclose(u.values[known], 0.05 * pixels[known])
    assert u.std is not None
    assert np.isnan(u.values[5])
    assert u.std[7] == pytest.approx(np.hypot(0.05 * 0.01, 1e-4 * pixels[7]), rel=0.2)
    assert "point_1 is not measured in 1 of 8 frames" in found.remarks


def test_rates_know_the_times_of_the_frames_that_are_there(result: Result) -> None:
    found = read(result, gauges=((20, 15, 90, 60),), window=5)
    gauge = np.hypot(70, 45)
    along = found["gauge_1_extension_acceleration_mm_per_s2"]
    exact = 0.05 * 2 * 0.01 * 70 * (70 / gauge) * (RATE / 10) ** 2
    np.testing.assert_allclose(along.values[2:-2], exact, rtol=0.01)
    rate = found["gauge_1_strain_rate_per_s"]
    np.testing.assert_allclose(
        rate.values[2:-2], 0.02 * (70 / gauge) ** 2 * np.array(NUMBERS)[2:-2] / 10 * RATE / 10, rtol=0.01
    )


def test_a_kink_is_told_with_the_rates_of_both_sides_and_only_there(tmp_path: Path) -> None:
    found = read(make(tmp_path / "a", scale=SCALE, motion=struck), points=((30.0, 30.0),), window=5)
    before, after = found["point_1_u_velocity_before_mm_per_s"], found["point_1_u_velocity_after_mm_per_s"]
    place = NUMBERS.index(5)
    assert [np.flatnonzero(np.isfinite(side.values)).tolist() for side in (before, after)] == [[place]] * 2
    assert abs(before.values[place]) < 2 * before.std[place] < 3 * 0.05 * RATE / 2
    assert abs(after.values[place] - 3 * 0.05 * RATE) < 2 * after.std[place] < 3 * 0.05 * RATE / 2
    velocity = found["point_1_u_velocity"]
    assert np.abs(velocity.values[:place]).max() < 10
    assert velocity.std[place] > 0.4 * 3 * 0.05 * RATE  # it reaches to both sides
    figure = history_figure(found)
    assert "velocity (mm/s)" in [axis.get_ylabel() for axis in figure.axes]
    with pytest.raises(KeyError):
        read(make(tmp_path / "b"), points=((30.0, 30.0),), window=5)["point_1_u_velocity_after"]


def test_the_equivalent_strain_is_said_to_be_hencky_s(result: Result) -> None:
    said = "equivalent: von Mises equivalent of the Hencky strain, for a material of constant volume"
    assert said in read(result, strain_gauges=((60, 40, 60),)).remarks
    assert said not in read(result, points=(PLACE,)).remarks


def test_a_strain_gauge_that_holds_less_than_half_of_its_place_is_refused(result: Result) -> None:
    """One on the edge holds half."""
    x, y = result.nodes[:, 0].min(), result.nodes[:, 1].mean()
    at_edge = read(result, strain_gauges=((x, y, 60),))
    assert np.isfinite(at_edge["strain_gauge_1_exx"].values[:5]).all()
    assert any("of its place at least" in remark for remark in at_edge.remarks)
    with pytest.raises(InputError, match="half or more of strain_gauge_1 is outside"):
        read(result, strain_gauges=((*result.nodes.min(axis=0), 60),))


@pytest.mark.parametrize(("count", "title"), [(4, ""), (7, ""), (20, "14 of 40 lines are named")])
def test_the_names_of_lines_fit_beside_their_panel(result: Result, count: int, title: str) -> None:
    found = read(result, points=tuple((30.0 + number, 40.0) for number in range(count)))
    figure = history_figure(found)
    figure.canvas.draw()
    (axis,) = figure.axes
    legend, whole = axis.get_legend(), figure.bbox
    box = legend.get_window_extent()
    assert whole.y0 <= box.y0 < box.y1 <= whole.y1
    assert box.x1 <= whole.x1
    assert legend.get_title().get_text() == title


def test_the_table_has_one_header_line_and_one_row_a_frame(result: Result, tmp_path: Path) -> None:
    found = read(result, points=(PLACE,), strain_gauges=((60, 40, 60),))
    write_histories(found, tmp_path / "a.csv")
    header, *rows = list(csv.reader((tmp_path / "a.csv").open()))
    assert header[:8] == [
        "frame",
        "number",
        "status",
        "time_s",
        *(f"point_1_{c}_mm{e}" for c in "uv" for e in ("", "_std")),
    ]
    assert header[8:10] == ["strain_gauge_1_exx", "strain_gauge_1_exx_std"]
    assert [int(row[1]) for row in rows] == list(NUMBERS)
    assert rows[5][4] == ""
    np.testing.assert_allclose(float(rows[7][4]), found["point_1_u"].values[7], rtol=1e-8)


def test_without_scale_and_time_it_counts_in_px_and_frames_and_says_so(tmp_path: Path) -> None:
    result = make(tmp_path / "out", timed=False)
    found = read(result, points=(PLACE,), window=5)
    assert found.times is None
    told = [told.column for told in found.quantities]
    assert told[:3] == ["point_1_u_px", "point_1_u_velocity_px_per_frame", "point_1_u_acceleration_px_per_frame2"]
    assert [remark.split(":")[0] for remark in found.remarks[:2]] == ["no scale is known", "no time is known"]
    stated = read(result, points=(PLACE,), scale=ScaleSettings(frame_rate=500.0))
    np.testing.assert_allclose(stated.times, np.array(NUMBERS) / 500)


def test_a_stated_rate_that_is_not_that_of_the_stamps_is_told(result: Result, caplog: pytest.LogCaptureFixture) -> None:
    found = read(result, points=(PLACE,), scale=replace(SCALE, frame_rate=25.0))
    assert "states 25 frames per second, the frames' own times 1000" in caplog.text
    np.testing.assert_allclose(found.times[-1], 8 / RATE + 2e-6)


def test_a_stated_rate_that_is_not_that_of_the_camera_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    result = make(tmp_path / "out", timed=False, frame_rate=1000.0)
    found = read(result, points=(PLACE,), scale=ScaleSettings(frame_rate=1001.0))
    assert not caplog.text
    found = read(result, points=(PLACE,), scale=ScaleSettings(frame_rate=500.0))
    assert "states 500 frames per second, the camera was set to 1000: the former is taken" in caplog.text
    np.testing.assert_allclose(found.times, np.array(NUMBERS) / 500)


def timed_record(number: int, time_ns: int, *, failed: bool = False) -> FrameRecord:
    """Of a frame that was measured, or could not be read."""
    if failed:
        return FrameRecord.failed("gone", nodes=NODES, lights=3, number=number, time_ns=time_ns)
    return replace(record := smooth_record(number), values={**record.values, "time_ns": time_ns})


@pytest.mark.parametrize(
    ("stamps", "problem"),
    [
        ((0, 10, 10, 30), "frame 2 is not later"),
        ((0, 20, 10, 30), "frame 2 is not later"),
        ((0, None, 20, 30), "frame 1 has none"),
    ],
)
def test_time_stamps_that_do_not_rise_or_are_missing_are_not_used(
    stamps: tuple[int | None, ...], problem: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def record(number: int) -> FrameRecord:
        stamp = stamps[number]
        return timed_record(number, UNKNOWN_TIME if stamp is None else stamp * 1_000_000)

    result = make_result(tmp_path / "out", frames=4, record=record)
    assert frame_times(result) is None
    assert f"the time stamps of the frames are not used: {problem}" in caplog.text
    np.testing.assert_allclose(frame_times(result, ScaleSettings(frame_rate=50.0)), np.arange(4) / 50)
    assert not ResultInUnits.from_result(result).units.timed


def test_a_frame_that_cannot_be_read_takes_no_time_from_the_others(tmp_path: Path) -> None:
    """Its own follows from its number, between the others and beyond them."""

    def record(number: int) -> FrameRecord:
        lost = number in (2, 5)
        return timed_record(number, UNKNOWN_TIME if lost else 7 * number, failed=lost)

    times = frame_times(make_result(tmp_path / "out", frames=6, record=record))
    assert times is not None
    np.testing.assert_allclose(times, 7e-9 * np.arange(6))


def test_late_times_are_written_with_the_digits_that_tell_them_apart(tmp_path: Path) -> None:
    hours = 200_000 * 10**9
    result = make_result(tmp_path / "out", frames=3, record=lambda i: timed_record(i, hours + 20_000 * i))
    file = io.BytesIO()
    history_csv(read(result, points=(PLACE,)), file)
    rows = csv.DictReader(io.StringIO(file.getvalue().decode()))
    assert [row["time_s"] for row in rows] == ["200000", "200000.00002", "200000.00004"]


def test_motion_within_the_exposure_is_told_where_it_blurs(tmp_path: Path) -> None:
    assert not [r for r in read(make(tmp_path / "a", exposure_ns=200_000), points=(PLACE,)).remarks if "blur" in r]
    (blur,) = (r for r in read(make(tmp_path / "b", exposure_ns=600_000), points=(PLACE,)).remarks if "blur" in r)
    assert "within the exposure of 0.0006 s the surface moves by up to 1.29 px" in blur


def test_the_rigid_part_is_told_and_taken_off(result: Result) -> None:
    probes = ProbeSettings(gauges=((20, 15, 90, 60),), points=(PLACE,), rigid_motion="remove")
    found, plain = (read_histories(result, replace(probes, rigid_motion=rigid)) for rigid in ("remove", "none"))
    middle = MESH.nodes[:, 0].mean() - 10
    expected = [0.05 * (2 * n + 0.01 * (n / 10) ** 2 * middle) for n in NUMBERS]
    np.testing.assert_allclose(np.delete(found["rigid_u"].values, 5), np.delete(expected, 5))
    np.testing.assert_allclose(found["rigid_rotation"].values, 0, atol=1e-3)
    left = 0.05 * 0.01 * 0.64 * (PLACE[0] - 10 - middle)
    np.testing.assert_allclose(found["point_1_u"].values[-1], left, rtol=1e-6)
    name = "gauge_1_extension"
    np.testing.assert_allclose(found[name].values, plain[name].values, atol=1e-12)


CHANNELS = "time_ms;force_kN;room\n-1;-0,5;20\n3,002;1,5;\n20;10;22\n"


def test_channels_are_brought_to_the_frames_and_make_a_stress(result: Result, tmp_path: Path) -> None:
    (tmp_path / "c.csv").write_text(CHANNELS, encoding="utf-8-sig")
    channels = ChannelSettings(file=tmp_path / "c.csv", offset=1e-3, area=20.0)
    found = read(result, gauges=((20, 15, 90, 60),), channels=channels)
    np.testing.assert_allclose(found["force_kN"].values[3], 1.5)
    np.testing.assert_allclose(found["stress_MPa"].values[3], 75)
    assert found.stress_strain == ("gauge_1_strain", "stress")
    assert np.isnan(found["room"].values).all()
    assert "the channel room has no value in 8 of 8 frames" in found.remarks
    figure = history_figure(found)
    labels = [axis.get_ylabel() for axis in figure.axes]
    assert labels == ["extension (mm)", "strain", "force_kN", "room", "stress (MPa)", "stress (MPa)"]
    assert figure.axes[-1].get_xlabel() == "gauge_1_strain"
    assert figure.axes[0].get_xlabel() == "time (ms)"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0,1\n1,2\n", r"need a header line: \"time_s\""),
        ("time_s,a\n0,1\n", "must rise from row to row, over two rows or more"),
        ("time_s,a\n0,1\n0,2\n", "must rise"),
        ("time_s,a,b,a\n0,1,2,3\n1,1,2,3\n", "several columns of one name: a"),
        ("time_s,a\n0,x\n1,2\n", r"row 2 of the channels .* is not numbers"),
        ("time_s,a\n0,1\n1,2,3\n", r"row 3 of the channels .* has 3 fields, the header 2"),
        ("", "need a header line"),
        ("time_s;force_N\n0;1,234\n1;2.5\n", "numbers with a comma and numbers with a point"),
        ("time_s,a\n0,1e999\n1,2\n", r"row 2 of the channels .* is not numbers"),
        ("time_s,a\n0,inf\n1,2\n", r"row 2 of the channels .* is not numbers"),
        ("time_s,a\n0,5_0\n1,2\n", r"row 2 of the channels .* is not numbers"),
        ("time_s,a,\n0,1,\n1,2,\n", "column 3 of the channels .* has no name"),
        ("time_s,a\n0," + "9" * 200_000 + "\n1,2\n", "c.csv (are not a table|is not numbers)"),
    ],
    ids=range(13),
)
def test_a_channel_file_that_is_none_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        Channels.read(tmp_path / "c.csv")


def histories_of(times: np.ndarray, *quantities: Field) -> Histories:
    """Histories of frames that are all there."""
    numbers = np.arange(len(times))
    return Histories(
        frames=numbers,
        numbers=numbers,
        status=0 * numbers,
        times=times,
        quantities=quantities,
        stress_strain=None,
        units=Units(),
        remarks=(),
    )


def test_a_channel_does_not_take_the_place_of_a_measured_column(tmp_path: Path) -> None:
    times = np.arange(4.0)
    gauge = Field(name="gauge_1_strain", unit="", values=np.full(4, 1e-3), std=np.full(4, 1e-5))
    for name in ("gauge_1_strain", "frame", "status"):
        (tmp_path / "c.csv").write_text(f"time_s,{name}\n" + "".join(f"{t},{t}\n" for t in times))
        with pytest.raises(InputError, match=f"have the names of columns of the history, rename: {name}"):
            with_channels(histories_of(times, gauge), ChannelSettings(file=tmp_path / "c.csv"))


def test_doubts_about_the_clock_of_a_channel_file_are_stated(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    times = np.arange(4.0)
    gauge = Field(name="gauge_1_strain", unit="", values=np.zeros(4), std=np.zeros(4))
    (tmp_path / "c.csv").write_text("time_s,a\n" + "".join(f"{1000 * t},{t}\n" for t in times))
    found = with_channels(histories_of(times, gauge), ChannelSettings(file=tmp_path / "c.csv"))
    assert any("the clocks of channels and frames are taken as equal" in remark for remark in found.remarks)
    assert any("the frames cover 0.10% of the time of the channels" in remark for remark in found.remarks)
    (tmp_path / "t.csv").write_text("time_s,ttl\n0,0\n1,1\n2,0\n3,1\n")
    Channels.read(tmp_path / "t.csv", trigger="ttl")
    assert "crosses the middle of its range 3 times: the first counts" in caplog.text


def test_a_trigger_channel_and_a_correlation_find_the_recorder_s_clock(tmp_path: Path) -> None:
    recorded = np.arange(0, 20e-3, 20e-6)  # 50 kHz, its clock 7.3 ms behind that of the frames
    pulse = np.exp(-(((recorded - 12e-3) / 1e-3) ** 2))
    rows = zip(recorded, pulse, recorded >= 7.3e-3, strict=True)
    (tmp_path / "c.csv").write_text("time_s,force_N,ttl\n" + "".join(f"{t:.7f},{f:.6g},{s:d}\n" for t, f, s in rows))
    triggered = Channels.read(tmp_path / "c.csv", trigger="ttl")
    assert triggered.offset == pytest.approx(-7.29e-3, abs=1e-9)  # in the middle of the rise
    errors = []
    times = np.arange(-2e-3, 10e-3, 100e-6)
    for seed in range(40):
        noise = np.random.default_rng(seed).normal(0, 0.02, len(times))
        history = -3e-4 * (np.exp(-(((times - 4.7e-3) / 1e-3) ** 2)) + noise)
        found, std, coefficient = Channels.read(tmp_path / "c.csv").align("force_N", times, history)
        errors.append((found.offset + 7.3e-3) / std)
        assert coefficient < -0.99
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.25
    with pytest.raises(InputError, match=r"correlates with the history by -?0\.\d+ at best, 0\.7 is needed"):
        Channels.read(tmp_path / "c.csv").align("force_N", times, np.random.default_rng(1).normal(0, 1, len(times)))
    (tmp_path / "d.csv").write_text("time_s,ttl\n0,1\n1,1\n")
    with pytest.raises(InputError, match="is constant: it marks no time"):
        Channels.read(tmp_path / "d.csv", trigger="ttl")


def command(*arguments: object) -> int:
    return execute(cli.app, ["history", *map(str, arguments)])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["--gauge", "20,15:190,60"],
            "gauge_1 at (190, 60) px is outside the region that was measured, which lies within",
        ),
        (["--point", "20"], "--point is X,Y in px, such as 120,85.5, not '20'"),
        (["--strain-gauge", "60,40:9"], "a strain gauge must be at least 56.12 px long, 3 elements; given are 9 px"),
        (
            ["--circle", "500,40:9"],
            "half or more of circle_1 is outside the region that was measured, which lies within x 10 to 110",
        ),
        (["--region", "40,20:40,60"], "probes.regions are [x0, y0, x1, y1] of a rectangle with an area"),
        (["--window", "3"], "probes.window must be 0 or at least 4 frames, not 3"),
        (["--window", "2"], "probes.window must be 0 or at least 4 frames, not 2"),
        (["--measure", "euler"], "probes.measure must be one of"),
        (["--youngs-modulus", "2"], "--youngs-modulus is of a crack's tip, and none is stated"),
        (["--area", "20"], "channels.area is of channels, whose file (channels.file) is not stated"),
        (["--channels", "late.csv", "--trigger", "b"], '"b" is not one of the channels of late.csv: bridge'),
        (
            ["--channels", "late.csv", "--trigger", "b", "--offset", "3"],
            "channels.offset and channels.trigger both relate",
        ),
        (["--channels", "late.csv", "--align", "bridge"], "--align is CHANNEL=COLUMN, such as"),
        (
            ["--channels", "late.csv", "--align", "bridge=force"],
            'names the history "force", which is not one of point_1_u',
        ),
        (["--channels", "late.csv", "--align", "bridge=point_1_u"], "values of the history are too few"),
        (["--channels", "none.csv"], "none.csv cannot be read"),
        (
            ["--channels", "late.csv"],
            "late.csv span 100 to 101 s (offset 0 s included), the frames 2e-06 to 0.008002 s",
        ),
        (["--channels", "late.csv", "--area", "3", "--offset", "-100"], "one channel of late.csv with a force"),
    ],
)
def test_what_a_new_user_gets_wrong_is_one_clear_line(
    result: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options, words
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("late.csv").write_text("time_s,bridge\n100,1\n101,2\n")
    assert command(result.path, "--out", "h.csv", *options) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error
    assert not list(tmp_path.glob("h.*"))


def test_a_probe_that_no_frame_measures_and_a_result_without_probes_are_refused(tmp_path: Path) -> None:
    lost = make(tmp_path / "out", timed=False)
    node = MESH.nodes[LOST_NODE]
    with pytest.raises(InputError, match="no probe is stated"):
        read(lost)
    (tmp_path / "c.csv").write_text(CHANNELS)
    channels = ChannelSettings(file=tmp_path / "c.csv")
    with pytest.raises(InputError, match=r"channels .* cannot be brought to the frames, whose times are not known"):
        read(lost, points=(PLACE,), channels=channels)
    origin = make_origin(1)
    with ResultStore.create(tmp_path / "blank", origin) as store:
        store.write_frame(0, FrameRecord.failed("dark", nodes=NODES, lights=3, number=0, time_ns=0))
        store.finish()
    with pytest.raises(InputError, match=r"point_1 is measured in no frame of .*blank: .* place it elsewhere"):
        read(Result.open(tmp_path / "blank"), points=(tuple(node),))


def test_the_command_takes_the_test_s_probes_and_its_own_and_writes_table_and_picture(
    result: Result, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert result.section(ProbeSettings) == ProbeSettings(points=(PLACE,))
    with pytest.raises(InputError, match=r"is no section of a TEST.toml; these are FrameSettings, "):
        result.section(TestSettings)
    out = tmp_path / "h.csv"
    assert command(result.path, "--point", "60,40", "--gauge", "20,15:90,60", "--window", 5, "--out", out) == 0
    printed = capsys.readouterr()
    assert all(name in printed.out for name in ("point_1_u", "point_2_v", "gauge_1_strain_rate", "1/s", "picture: "))
    assert "note: point_1 is not measured in 1 of 8 frames" in printed.err
    assert (tmp_path / "h.png").stat().st_size > 10_000
    assert command(result.path, "--out", out) == 2
    assert "already exists" in capsys.readouterr().err
    (tmp_path / "test.toml").write_text(
        '[frames]\npath = "f*.tif"\nkind = "monochrome"\n[region]\nrectangle = [10, 5, 110, 75]\n'
        "[scale]\nmm_per_pixel = 2\n[probes]\ngauges = [20, 15, 90, 60]\n"
    )
    assert command(result.path, "--test", tmp_path / "test.toml", "--out", out, "--overwrite") == 0
    header = out.read_text().splitlines()[0].split(",")
    assert header[4:] == ["gauge_1_extension_mm", "gauge_1_extension_mm_std", "gauge_1_strain", "gauge_1_strain_std"]
    table = np.genfromtxt(out, delimiter=",", names=True)
    assert command(result.path, "--test", tmp_path / "test.toml", "--px", "--out", out, "--overwrite") == 0
    in_px = np.genfromtxt(out, delimiter=",", names=True)
    np.testing.assert_allclose(2 * in_px["gauge_1_extension_px"], table["gauge_1_extension_mm"])


def test_the_command_scale_gives_lines_for_the_settings(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["scale", "10,10:410,310", "--length", "25", "--length-std", "0.05"]
    assert execute(cli.app, arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("# mm per px of the image that the points are of")
    assert lines[1:] == ["[scale]", "mm_per_pixel = 0.05", "mm_per_pixel_std = 0.00012"]
    assert execute(cli.app, ["scale", "10,10:10,10", "--length", "25"]) == 2
    assert "two different points" in capsys.readouterr().err
    assert execute(cli.app, ["scale", "10,10:10,20", "--length", "0"]) == 2
    assert "must be above 0 mm, not 0" in capsys.readouterr().err


def test_a_scale_from_another_light_s_image_is_carried_to_the_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lights = ("red", "green", "blue")
    covariance = np.zeros((3, 5, 5))
    covariance[1, 3, 3] = 1e-4**2
    parameters = np.array([[0] * 5, [0.5, -1, 0, -0.006, 0], [1, 0, 0, 0.003, 0]])
    registration = Registration(
        lights=lights, parameters=parameters, centre=(210, 160), radius=250, covariance=covariance
    )
    calibration = Calibration(registration=registration, crosstalk=Crosstalk.identity(lights))
    calibration.write(file := tmp_path / "calibration.json")
    replace(calibration, registration=None).write(without := tmp_path / "crosstalk.json")
    points = ["scale", "10,10:410,310", "--length", "25", "--point-std", "0"]

    def scale(*options: object) -> tuple[float, float]:
        assert execute(cli.app, [*points, *map(str, options)]) == 0
        read = tomllib.loads(capsys.readouterr().out)["scale"]
        return read["mm_per_pixel"], read["mm_per_pixel_std"]

    # green's image is .6 % smaller: the same length spans more of red's pixels
    assert scale("--light", "green", "--calibration", file) == pytest.approx((0.05 * 0.994, 0.05 * 1e-4), rel=0.01)
    assert scale("--light", "green", "--calibration", file)[0] == pytest.approx(0.05 * 0.994, rel=1e-5)
    assert scale("--light", "red", "--calibration", file) == pytest.approx((0.05, 0), abs=1e-9)
    both, std = scale("--light", "green", "--light", "blue", "--calibration", file)
    assert both == pytest.approx(0.05 * 0.9985, rel=1e-5)
    assert std == pytest.approx(0.05 * 0.009 / np.sqrt(12), rel=0.02)  # any between them
    for wrong, reason in (
        (["--light", "green"], "--light needs --calibration"),
        (["--calibration", file], "only with --light"),
        (["--light", "violet", "--calibration", file], "lights red, green, blue, not violet"),
        (["--light", "green", "--calibration", without], "no registration"),
        (["--light", "green", "--calibration", file, "--crop-origin", "1.5,2"], "whole numbers"),
    ):
        assert execute(cli.app, [*points, *map(str, wrong)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert reason in line


CRACKED = Tri3Mesh.from_region(Region.from_rectangle((5, 5, 194, 194), (200, 200)), 10, [[(0, 100), (100, 100)]])
MATERIAL = {"youngs_modulus": 70_000, "poissons_ratio": 0.3, "plane": "stress"}


def cracked(path: Path, scale: ScaleSettings | None = SCALE) -> Result:
    """Frames 0 to 4 px of opening, of a crack whose sides move apart as they are."""
    settings = TestSettings(
        frames=FrameSettings(path=("f*.tif",), kind="monochrome"),
        region=RegionSettings(rectangle=(5, 5, 194, 194)),
        scale=scale or ScaleSettings(),
    )
    names = [f"frame {index}" for index in range(5)]
    origin = Origin(nodes=CRACKED.nodes, elements=CRACKED.elements, names=names, lights=("light",), settings=settings)
    above, behind = CRACKED.observation_points[:, 1] < 100, CRACKED.nodes[:, 0] < 99
    count = len(CRACKED.nodes)
    with ResultStore.create(path, origin) as store:
        for index in range(5):
            v = np.where(behind, np.where(above, -0.5, 0.5) * index, 0.0)
            std = np.full(count, 0.01 if index else 0.0)
            record = {"u": np.zeros(count), "v": v, "u_std": std, "v_std": std}
            store.write_frame(index, FrameRecord.from_values(nodes=count, lights=1, status=0, number=index, **record))
        store.finish()
    return Result.open(path)


def test_cracks_are_read_as_histories_in_mm_with_their_notes(tmp_path: Path) -> None:
    probes = ProbeSettings(cracks=((10, 100, 95, 101),), tips=((100, 100, 30, 90),), terms=3, window=4, **MATERIAL)
    found = read_histories(cracked(tmp_path / "a"), probes)
    opening = found["crack_1_2_opening_mm"]
    np.testing.assert_allclose(opening.values, 0.05 * np.arange(5), atol=1e-9)
    assert opening.std is not None
    np.testing.assert_allclose(opening.std[4], np.hypot(0.05 * 0.01 * np.sqrt(2), 1e-4 * 4), rtol=0.02)
    np.testing.assert_allclose(found["crack_1_2_opening_velocity_mm_per_frame"].values, 0.05, rtol=1e-3)
    assert found["crack_1_2_sliding_mm"].values == pytest.approx(0, abs=1e-9)
    factor = found["tip_1_K1_MPa_sqrt_m"]
    assert factor.values[4] > 1
    assert factor.std is not None
    twice = read_histories(cracked(tmp_path / "b", replace(SCALE, mm_per_pixel_std=0.01)), replace(probes, window=0))[
        "tip_1_K1"
    ]
    assert twice.std is not None
    np.testing.assert_allclose(twice.std[4], np.hypot(factor.std[4], 0.1 * factor.values[4]), rtol=1e-3)
    assert found["tip_1_chi_square"].std is None
    assert "tip_1_chi_square" in history_csv_text(found)
    remarks = "\n".join(found.remarks)
    assert "crack_1: jump of the left side" in remarks
    assert "Williams' series up to n = 3 (stated)" in remarks
    assert "its chi-square over the degrees of freedom is up to" in remarks
    assert "K (MPa √m)" in [axis.get_ylabel() for axis in history_figure(found).axes]


def history_csv_text(histories: Histories) -> str:
    file = io.BytesIO()
    history_csv(histories, file)
    return file.getvalue().decode()


def test_factors_without_millimetres_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"need the scale of the image: state mm_per_pixel or camera in \[scale\]"):
        read_histories(cracked(tmp_path / "a", None), ProbeSettings(tips=((100, 100, 30, 90),), **MATERIAL))


def test_names_of_probes_are_those_of_columns_and_figures(result: Result, tmp_path: Path) -> None:
    places: dict[str, Any] = {"points": (PLACE, (60, 40)), "gauges": ((30, 30, 90, 30),)}
    named = ProbeSettings(**places, names=(("point_2", "left grip"), ("gauge_1", "span-2")))
    plain, read = read_histories(result, ProbeSettings(**places)), read_histories(result, named)
    names = [one.name.replace("left grip_", "point_2_").replace("span-2_", "gauge_1_") for one in read.quantities]
    assert names == [one.name for one in plain.quantities]
    np.testing.assert_array_equal(read["left grip_u"].values, plain["point_2_u"].values)
    assert read["span-2_extension"].column == "span-2_extension_mm"


@pytest.mark.parametrize(
    ("names", "told"),
    [
        ([["point_3", "a"]], 'unknown probe "point_3" in probes.names'),
        ([["point_1", "a_b"]], 'not "a_b"'),
        ([["point_1", "a"], ["point_2", "a"]], "must be different"),
        ([["point_1", ""]], "must be different"),
    ],
)
def test_names_that_make_no_column_are_refused(names: list[list[str]], told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        ProbeSettings(points=((1, 2), (3, 4)), names=names)


def test_a_window_longer_than_the_test_is_one_rule_for_maps_and_histories(result: Result) -> None:
    """Rates are those of all frames that are measured, and say so, in both alike."""
    maps = Maps.from_result(result, window=30)
    said = "parabolas over 8 frames (a window of 30 was stated), polynomials of degree 4 over 8"
    assert maps.processing_note("velocity") == said
    found = read_histories(result, ProbeSettings(points=(PLACE,), window=30))
    assert f"rates: {said}" in found.remarks
    alike = read_histories(result, ProbeSettings(points=(PLACE,), window=8))
    for one, other in zip(found.quantities, alike.quantities, strict=True):
        np.testing.assert_array_equal(one.values, other.values)
    with pytest.raises(InputError, match="rates need 4 measured frames or more; there are 3"):
        rate_words(9, 3)


def test_what_is_cut_off_a_probe_is_stated(result: Result) -> None:
    """The region reaches to 110 px; a node lacks data in one frame."""
    regions = ((80.0, 20.0, 130.0, 60.0), (15.0, 12.0, 30.0, 30.0))
    read_off = read(result, regions=regions, strain_gauges=((100, 40, 60),))
    (area, gauge) = (remark for remark in read_off.remarks if "of its place at least" in remark)
    assert area.startswith("region_1 is the mean of 60% of its place at least")
    part = float(re.search(r"strain of (\d+)%", gauge)[1])
    assert gauge.startswith("strain_gauge_1")
    assert 60 < part < 80


def test_of_many_channels_the_first_are_drawn(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    columns = [Field(name=f"c{i}", unit=f"u{i}", values=np.arange(4.0), std=None) for i in range(40)]
    assert len(history_figure(histories_of(np.arange(4.0), *columns)).axes) == 24
    assert "the picture shows 24 of 40 kinds" in caplog.text


def test_a_legend_states_how_many_it_does_not_name() -> None:
    curves = [Field(name=f"point_{i}_u", unit="px", values=np.arange(4.0) + i, std=np.ones(4)) for i in range(48)]
    legend = history_figure(histories_of(np.arange(4.0), *curves)).axes[0].get_legend()
    names = [text.get_text() for text in legend.get_texts()]
    assert len(names) == 13
    assert names[-1] == "and 36 more"


def test_without_a_file_the_table_is_printed_and_nothing_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = make_result(tmp_path / "out", frames=3)
    before = sorted(tmp_path.rglob("*"))
    assert execute(cli.app, ["history", str(result.path), "--point", "60,40"]) == 0
    out = capsys.readouterr().out
    assert "point_1_u" in out
    assert "table:" not in out
    assert sorted(tmp_path.rglob("*")) == before


def test_extremes_are_not_stated_finer_than_the_test_is_known():
    """A reference frame compared with itself is known to rounding; beside frames known to 1e-4 that means nothing."""
    std = np.array([1.6e-9, 1.1e-4, 1.2e-4])
    quantity = Field(name="point_1_u", unit="mm", values=np.array([2.35e-9, 3e-4, 0.01944]), std=std)
    assert history_rows(histories_of(np.arange(float(len(quantity.values))), quantity))[1] == [
        ["point_1_u", "mm", "0.00000", "0.01944", "0.01944", "0.00011", "3"]
    ]
    wide = replace(quantity, values=quantity.values[::-1], std=np.array([1.1e-4, 1.2e-4, 0.02]))
    assert history_rows(histories_of(np.arange(3.0), wide))[1][0][2:5] == ["0.000", "0.01944", "0.000"]


def test_a_direction_that_is_not_drawn_sets_no_limits():
    values, std = np.array([-80.0, 67.0, 68.0, 72.0]), np.array([30.0, 0.4, 0.3, 0.1])
    quantity = Field(name="region_1_direction", unit="deg", values=values, std=std)
    low, high = history_figure(histories_of(np.arange(float(len(quantity.values))), quantity)).axes[0].get_ylim()
    assert 60 < low < 67
    assert 72 < high < 80
