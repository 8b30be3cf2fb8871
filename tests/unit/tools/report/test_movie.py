"""Movies: formats, colours, processes, interruption, wrong input."""

from __future__ import annotations

import multiprocessing
import os
import signal
from dataclasses import replace
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import BinaryIO

import imageio_ffmpeg
import numpy as np
import pytest
from results import NODES, make_result, smooth_record

from rgbmidic.cli import app as cli
from rgbmidic.cli.command import execute
from rgbmidic.errors import FrameError, InputError, ResultError
from rgbmidic.results import FrameRecord, Maps
from rgbmidic.tools.report import movie
from rgbmidic.tools.report.curves import Curve
from rgbmidic.tools.report.movie import FieldMovie, _Canvas, write_movie
from rgbmidic.tools.view.picture import RawPictures


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Maps:
    folder = tmp_path_factory.mktemp("movie") / "result"
    more = {"notes": {"frame_rate": 1e5}, "reference": np.full((3, 80, 120), 90.0)}
    return Maps.from_result(make_result(folder, frames=6, record=smooth_record, **more))


def decoded(path: Path) -> np.ndarray:
    """Frames (T, H, W, 3) of a movie as ffmpeg reads it."""
    reader = imageio_ffmpeg.read_frames(str(path))
    width, height = next(reader)["size"]
    return np.array([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader])


@pytest.mark.parametrize("ending", [".mp4", ".webm", ".gif"])
def test_a_movie_shows_the_field_in_each_frame(maps: Maps, tmp_path: Path, ending: str) -> None:
    shown = FieldMovie(maps=maps, fields=("u", "exx"), frames=[1, 3, 5], width=640)
    out = write_movie(shown, tmp_path / f"m{ending}")
    frames = decoded(out).astype(int)
    assert frames.shape[0] == 3
    page = _Canvas(shown).page(3)[..., :3].astype(int)
    part = frames[1][: page.shape[0], : page.shape[1]]
    assert np.abs(part - page).mean() < 4  # what the encoders leave: 1 to 3 of 255
    assert np.abs(frames[0] - frames[2]).mean() > 2


def test_the_colour_of_a_node_is_that_of_its_value(maps: Maps) -> None:
    from matplotlib import colormaps

    canvas = _Canvas(FieldMovie(maps=maps, fields=("u",), frames=[5], limits=(-0.5, 0.5)))
    panel = canvas.page(5)[canvas.boxes[0]]
    points = np.array([(30, 40), (60, 30), (95, 60)])
    for x, column, row in zip(points[:, 0], *canvas.window.to_picture(points), strict=True):
        value, at = 0.01 * (x - 60), panel[round(row), round(column), :3] / 255
        np.testing.assert_allclose(at, colormaps["viridis"](value + 0.5)[:3], atol=0.03)


def test_a_page_states_how_its_fields_are_derived(maps: Maps) -> None:
    since = replace(maps, since=2)
    canvas = _Canvas(FieldMovie(maps=since, fields=("u", "exx_std"), frames=[4]))
    canvas.page(4)
    first, how = canvas._title.get_text().splitlines()
    assert first.endswith("frame 4")
    assert how == since.processing_note("exx")
    assert how.endswith(", since frame 2")
    page, box = canvas.figure.bbox, canvas._title.get_window_extent()
    assert page.y0 <= box.y0 < box.y1 <= page.y1


@pytest.mark.parametrize("width", [601, 640, 727])
def test_panels_have_one_size_however_their_edges_are_rounded(maps: Maps, width: int) -> None:
    boxes = _Canvas(FieldMovie(maps=maps, fields=("u", "v", "exx"), frames=[5], width=width)).boxes
    assert len({(rows.stop - rows.start, columns.stop - columns.start) for rows, columns in boxes}) == 1


def test_pages_are_the_same_for_any_number_of_processes(maps: Maps, monkeypatch: pytest.MonkeyPatch) -> None:
    start, handlers = SpawnProcess.start, []

    def starting(process: SpawnProcess) -> None:
        handlers.append(signal.getsignal(signal.SIGINT))
        start(process)

    monkeypatch.setattr(SpawnProcess, "start", starting)
    before = signal.getsignal(signal.SIGINT)
    curve = Curve(name="force_N", times=np.linspace(0, 5e-5, 9), values=np.arange(9.0), has_times=True)
    canvas = _Canvas(FieldMovie(maps=maps, fields=("exx", "velocity"), frames=[0, 2, 4], curve=curve))
    alone, shared = (list(movie._pages(canvas, [0, 2, 4], count)) for count in (1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(alone, shared, strict=True))
    assert not np.array_equal(alone[0], alone[1])
    assert handlers == [signal.SIG_IGN] * 2  # inherited: a Ctrl-C while they import is no traceback of theirs
    assert signal.getsignal(signal.SIGINT) is before


def test_a_process_whose_pages_nobody_takes_ends_in_silence(maps: Maps) -> None:
    shown = FieldMovie(maps=maps, fields=("u",), frames=[0, 1])
    receive, send = multiprocessing.Pipe(duplex=False)
    receive.close()
    before = signal.getsignal(signal.SIGINT)
    try:
        movie._draw(shown, [0, 1], send)
    finally:
        signal.signal(signal.SIGINT, before)


def test_over_raw_frames_the_field_lies_where_the_specimen_is(tmp_path: Path) -> None:
    def shifted(index: int) -> FrameRecord:
        both = {
            "u": np.full(NODES, 30.0 * index),
            "v": np.zeros(NODES),
            "u_std": np.ones(NODES),
            "v_std": np.ones(NODES),
        }
        rest = {"nodal_exx": np.zeros(NODES), "misfit": np.ones(NODES), "light_fraction": np.full((NODES, 3), 1 / 3)}
        return FrameRecord.from_values(
            nodes=NODES, lights=3, number=index, status=0, node_status=np.zeros(NODES), **both, **rest
        )

    maps = Maps.from_result(make_result(tmp_path / "r", frames=2, record=shifted, notes={"frame_shape": [80, 200]}))
    grey = lambda index: np.full((80, 200), 100, dtype=np.uint8)  # noqa: E731
    canvas = _Canvas(FieldMovie(maps=maps, fields=("u",), frames=[0, 1], images=grey))
    panel = canvas.page(1)[canvas.boxes[0]]
    (begin, beyond), (row, _) = canvas.window.to_picture(np.array([(25, 40), (135, 40)]))
    assert np.ptp(panel[round(row), round(begin), :3]) == 0  # where the mesh begins on the reference
    assert np.ptp(panel[round(row), round(beyond), :3]) > 0  # beyond its end there


def test_nothing_is_left_of_a_movie_that_is_interrupted(maps: Maps, tmp_path: Path) -> None:
    def stop(done: int, total: int, line: str) -> None:
        raise KeyboardInterrupt

    for ending in (".mp4", ".gif"):
        with pytest.raises(KeyboardInterrupt):
            write_movie(FieldMovie(maps=maps, fields=["u"], width=320), tmp_path / f"m{ending}", progress=stop)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("does", "told"),
    [
        ("cat > /dev/null", "it ended with status 0 and 0 bytes"),
        ("cat > /dev/null; echo no codec >&2; exit 3", "no codec"),
        ("exit 3", "it ended with status 3"),
    ],
)
def test_an_ffmpeg_that_does_not_do_its_work_is_an_error_and_nothing_is_left(
    maps: Maps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, does: str, told: str
) -> None:
    exe, out = tmp_path / "ffmpeg", tmp_path / "out"
    exe.write_text(f"#!/bin/sh\n{does}\n")
    exe.chmod(0o700)
    out.mkdir()
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(exe))
    with pytest.raises(ResultError, match=told):
        write_movie(FieldMovie(maps=maps, fields=["u"], width=320), out / "m.mp4")
    assert not list(out.iterdir())


@pytest.mark.parametrize("name", ["file:b.mp4", "-b.mp4", "a%03d.mp4", "http://b.mp4"])
def test_a_movie_is_in_the_file_of_its_name_whatever_that_means_to_ffmpeg(
    maps: Maps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(name).parent.mkdir(exist_ok=True)
    write_movie(FieldMovie(maps=maps, fields=["u"], width=320, frames=[1, 3]), name)
    assert decoded(tmp_path / name).shape[0] == 2
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [tmp_path / name]


def test_nothing_is_left_of_a_movie_whose_command_is_terminated(
    maps: Maps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def terminated(file: BinaryIO, *_: object) -> None:
        file.write(b"begun")
        os.kill(os.getpid(), signal.SIGTERM)
        raise AssertionError("still writing")

    monkeypatch.setattr(movie, "write_gif", terminated)
    before = signal.getsignal(signal.SIGTERM)
    out = tmp_path / "m.gif"
    assert execute(cli.app, ["movie", str(maps.result.path), "--out", str(out), "--width", "320"]) == 130
    assert signal.getsignal(signal.SIGTERM) is before
    assert not list(tmp_path.iterdir())


def test_wrong_input_is_refused_and_nothing_is_overwritten(maps: Maps, tmp_path: Path) -> None:
    for message, name, fields, more in (
        ("name ends in .mp4, .webm, .gif", "m.avi", ["u"], {}),
        ("there is no field", "m.gif", ["w"], {}),
        ("fields of numbers", "m.gif", ["node_status"], {}),
        ("no frame", "m.gif", ["u"], {"frames": [6]}),
        ("from a smaller to a larger", "m.gif", ["u"], {"limits": (1.0, 1.0)}),
        (".1 to 240 frames", "m.gif", ["u"], {"fps": 0.0}),
        ("no colours", "m.gif", ["u"], {"colours": "none"}),
        ("room for 7 panels of this shape, not for 30: show fewer", "m.gif", ["u"] * 30, {}),
    ):
        options = {"fps": more.pop("fps")} if "fps" in more else {}
        with pytest.raises(InputError, match=message):
            write_movie(FieldMovie(maps=maps, fields=fields, **more), tmp_path / name, **options)
    with pytest.raises(FrameError, match=r"result does not state where its raw frames are"):
        write_movie(FieldMovie(maps=maps, fields=["u"], images=RawPictures(result=maps.result)), tmp_path / "m.gif")
    assert not list(tmp_path.iterdir())
    (tmp_path / "there.gif").write_text("kept")
    with pytest.raises(ResultError, match="already exists"):
        write_movie(FieldMovie(maps=maps, fields=["u"]), tmp_path / "there.gif")
    assert (tmp_path / "there.gif").read_text() == "kept"


def test_a_curve_is_a_column_of_a_history_or_a_channel(tmp_path: Path) -> None:
    history, channels = tmp_path / "h.csv", tmp_path / "c.csv"
    history.write_text("frame,number,status,time_s,a_px,a_px_std,b\n0,0,0,0.5,1,.1,\n1,1,0,1.5,2,.1,7\n")
    channels.write_text("time_ms,load_N\n0,1\n10,3\n")
    assert Curve.read(history).name == "a_px"
    curve = Curve.read(history, "b")
    np.testing.assert_array_equal(curve.times, [0.5, 1.5])
    np.testing.assert_array_equal(curve.values, [np.nan, 7])
    assert Curve.read(channels, offset=1.0).times[0] == 1.0
    with pytest.raises(InputError, match="it has a_px, b"):
        Curve.read(history, "c")
    with pytest.raises(InputError, match="an offset is of channels"):
        Curve.read(history, "b", offset=1.0)
