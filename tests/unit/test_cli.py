"""The command `rgbmidic`: one clear line for a wrong input, the right exit status, nothing lost."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import h5py
import numpy as np
import pytest
import tifffile
import typer
from cine_files import write_cine
from results import corrupt, make_origin, make_result, random_record, smooth_record
from small_tests import colour_test

from rgbmidic import __version__
from rgbmidic.cli import app as cli
from rgbmidic.cli.command import (
    FRAME_OPTIONS,
    collect_options,
    execute,
    print_table,
    read_coordinates,
    read_frames,
    read_shape,
)
from rgbmidic.errors import FrameError, InputError
from rgbmidic.results import FrameRecord, Origin, Result, ResultStore
from rgbmidic.tools import report

TEST = '[frames]\npath = "f*.tif"\nkind = "monochrome"\n[region]\nrectangle = [40, 40, 160, 120]\n'

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run the command in this process, as where kernels are compiled: exit status, standard output, standard error."""
    monkeypatch.setattr("rgbmidic._kernels.are_compiled", lambda: True)

    def run(*arguments: object, debug: bool = False) -> tuple[int, str, str]:
        status = execute(cli.app, [str(argument) for argument in arguments], debug=debug)
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def test_file(tmp_path: Path) -> Path:
    path = tmp_path / "test.toml"
    path.write_text(TEST)
    return path


def _replace_pipeline(monkeypatch: pytest.MonkeyPatch, measure: Callable[..., Result]) -> None:
    module = ModuleType("rgbmidic.pipeline")
    module.measure = measure  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "rgbmidic.pipeline", module)


def test_version_and_help(command: Run) -> None:
    assert command("--version") == (0, f"rgbmidic {__version__}\n", "")
    for arguments in ((), ("--help",), ("-h",)):
        status, out, _ = command(*arguments)
        assert status == 0
        headings = [line for line in out.splitlines() if line.endswith(":") and line[0] != " "]
        assert headings == [
            "Options:",
            "Before a test:",
            "A test:",
            "Two cameras:",
            "Its result:",
            "Fields of the result:",
        ]
        assert all(word in out for word in ("run", "export", "report", "figures", "frames", "demo", "virtual", "plan"))
    for name in ("run", "export", "report", "figures", "frames", "demo", "virtual", "plan", "stereo"):
        assert command(name, "-h") == command(name, "--help")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["bogus"], "bogus"),
        (["run"], "TEST.toml"),
        (["run", "none.toml"], "--out"),
        (["run", "none.toml", "--out", "out"], "none.toml"),
        (["run", "none.toml", "--out", "out", "--bogus"], "--bogus"),
        (["export", "none", "--to", "npz", "--out", "a"], "none is not a result folder"),
        (["virtual", "none.toml", "--out", "out"], "none.toml"),
        (["plan", "none.toml", "--out", "out"], "none.toml"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(
    command: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arguments: list[str], word: str
) -> None:
    monkeypatch.chdir(tmp_path)
    status, out, error = command(*arguments)
    assert (status, out) == (2, "")
    assert error.startswith("error: ")
    assert word in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_table_prints_names_with_brackets_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    print_table("frames", ["frame", "file"], [["0", "[/red]a[b].dng"]])
    assert "[/red]a[b].dng" in capsys.readouterr().out


def test_a_huge_argument_is_refused_in_a_line_that_can_be_read(command: Run) -> None:
    for arguments in (["x" * 100_000], ["run", "--" + "y" * 100_000]):
        status, _, error = command(*arguments)
        assert status == 2
        assert len(error) < 1000


def test_failure_is_one_line_and_status_1(command: Run, monkeypatch: pytest.MonkeyPatch, test_file: Path) -> None:
    def measure(*_: Any, **__: Any) -> Result:
        raise ZeroDivisionError("a fault\nof ours")

    _replace_pipeline(monkeypatch, measure)
    status, _, error = command("run", test_file, "--out", test_file.parent / "out")
    assert (status, error.count("\n")) == (1, 1)
    assert error.startswith("error: ZeroDivisionError: a fault of ours")
    status, _, error = command("run", test_file, "--out", test_file.parent / "out", debug=True)
    assert status == 1
    assert "Traceback" in error


def test_bad_frames_are_status_2_and_an_interruption_130(
    command: Run, monkeypatch: pytest.MonkeyPatch, test_file: Path
) -> None:
    for raised, expected in ((FrameError("f1.dng is damaged"), 2), (KeyboardInterrupt(), 130)):

        def measure(*_: Any, raised: BaseException = raised, **__: Any) -> Result:
            raise raised

        _replace_pipeline(monkeypatch, measure)
        status, _, error = command("run", test_file, "--out", test_file.parent / "out")
        assert status == expected
        assert error.splitlines()[-1].startswith("error: ")


def test_a_file_that_ends_early_is_no_interruption(
    command: Run, monkeypatch: pytest.MonkeyPatch, test_file: Path
) -> None:
    def measure(*_: Any, **__: Any) -> Result:
        raise EOFError("Ran out of input")

    _replace_pipeline(monkeypatch, measure)
    status, _, error = command("run", test_file, "--out", test_file.parent / "out")
    assert status == 1
    assert error.strip() == "error: EOFError: Ran out of input (run again with --debug for the details)"


def test_too_many_open_files_are_told_with_their_limit(
    command: Run, monkeypatch: pytest.MonkeyPatch, test_file: Path
) -> None:
    def measure(*_: Any, **__: Any) -> Result:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    _replace_pipeline(monkeypatch, measure)
    status, _, error = command("run", test_file, "--out", test_file.parent / "out")
    assert status == 1
    assert error.splitlines()[-1].startswith("error: Too many open files: ")
    assert "ulimit -n" in error


@pytest.mark.parametrize(
    "arguments",
    [["run", "pipe.toml", "--out", "out"], ["run", "calibrated.toml", "--out", "out"], ["frames", "pipe.toml"],
     ["run", "masked.toml", "--out", "out"], ["plan", "pipe.toml", "--out", "out"], ["export", ".", "--out", "a.npz"],
     ["inspect", "f0.tif", "--cfa", "RGGB", "--calibration", "pipe.toml", "--out", "out"]],
)  # fmt: skip
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in folders")
def test_a_pipe_is_refused_at_once_wherever_a_file_is_read(
    command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("pipe.toml", "provenance.json"):
        os.mkfifo(name)
    tifffile.imwrite("f0.tif", np.random.default_rng(0).integers(0, 4096, (200, 200), dtype=np.uint16))
    Path("calibrated.toml").write_text(TEST + '[calibration]\nfile = "pipe.toml"\n')
    Path("masked.toml").write_text(TEST.replace("rectangle = [40, 40, 160, 120]", 'mask = "pipe.toml"'))
    status, _, error = command(*arguments)
    assert status == 2
    assert "is not a regular file" in error


def test_a_termination_ends_a_run_in_the_background_of_a_script_too(
    command: Run, monkeypatch: pytest.MonkeyPatch, test_file: Path
) -> None:
    """It says how to go on; before there is a result, or while there is but an old one, that there is nothing yet."""
    out, begins = test_file.parent / "out", False

    def measure(*_: Any, **__: Any) -> Result:
        if begins:
            make_result(out, overwrite=True, record=smooth_record)
        os.kill(os.getpid(), signal.SIGTERM)
        raise AssertionError("still running")

    _replace_pipeline(monkeypatch, measure)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell does for a job behind &
    try:
        for begun, resume, told in (
            (False, False, "nothing was begun: run the same command again"),
            (True, False, f"rgbmidic run {test_file} --out {out} --resume"),
            (False, False, "nothing was begun"),
            (False, True, f"rgbmidic run {test_file} --out {out} --resume"),
        ):
            begins = begun
            status, _, error = command("run", test_file, "--out", out, "--resume" if resume else "--overwrite")
            assert (status, told in error) == (130, True)
    finally:
        signal.signal(signal.SIGINT, before)


def test_run_passes_everything_on_and_tells_what_came_out(
    command: Run, monkeypatch: pytest.MonkeyPatch, test_file: Path
) -> None:
    monkeypatch.setattr("rgbmidic.tools.report.style.save_figure", lambda _, path: path.touch())
    calls: list[dict[str, Any]] = []

    def measure(
        settings: Any, out: Path, *, overwrite: bool, progress: Callable[[int, int, str], None], **_: Any
    ) -> Result:
        calls.append({"path": settings.frames.path, "overwrite": overwrite})
        progress(1, 2, "f1.tif: [converged]")
        return make_result(out, frames=2, overwrite=overwrite)

    _replace_pipeline(monkeypatch, measure)
    out = test_file.parent / "out"
    status, printed, _ = command("run", test_file, "--out", out, "--no-figures")
    assert status == 1  # none converged
    assert "1 deformed: 0 converged, 1 not converged, 0 failed" in printed
    assert str(out) in printed
    assert not (out / "figures").exists()
    assert command("run", test_file, "--out", out, "--overwrite")[0] == 1
    assert (out / "figures" / "convergence.png").is_file()
    assert [call["overwrite"] for call in calls] == [False, True]
    assert {call["path"] for call in calls} == {("f*.tif",)}


def test_the_summary_keeps_names_of_lights_apart(
    command: Run, monkeypatch: pytest.MonkeyPatch, test_file: Path
) -> None:
    """From the fractions behind them, and from its own rows."""
    for light in ("the lamp no. 1", "time"):
        _replace_pipeline(monkeypatch, _measure_of("", light=light))
        out = command("run", test_file, "--out", test_file.parent / "out", "--overwrite", "--no-figures")[1]
        (line,) = (line for line in out.splitlines() if "of what determines the nodes" in line)
        assert line.startswith(f"light {light}  ")
        assert line.endswith("  100% of what determines the nodes")


def _measure_of(*ends: str, light: str = "light") -> Callable[..., Result]:
    """Instead of the pipeline: f0 is the reference and measured, the others failed for these reasons, "" if not."""

    def measure(_: Any, out: Path, **__: Any) -> Result:
        names = [f"f{index}" for index in range(1 + len(ends))]
        origin = Origin(nodes=np.zeros((4, 2)), elements=[[0, 1, 2]], names=names, lights=[light])
        store = ResultStore.create(out, origin, overwrite=True)
        good = FrameRecord.from_values(
            nodes=4, lights=1, status=0, node_status=[0, 0, 0, 1], light_fraction=np.ones((4, 1))
        )
        for index, reason in enumerate(("", *ends)):
            failed = FrameRecord.failed(reason, nodes=4, lights=1, unread=reason == "torn")
            store.write_frame(index, failed if reason else good)
        store.finish()
        return Result.open(out)

    return measure


def test_run_in_which_no_deformed_frame_is_measured_is_a_failure(
    command: Run, monkeypatch: pytest.MonkeyPatch, test_file: Path
) -> None:
    """The reference matched with itself always converges: it counts for nothing."""
    for ends, told in ((("dark", "torn"), "f1: dark"), (("torn",), "f1: torn"), ((), "there is no deformed one")):
        _replace_pipeline(monkeypatch, _measure_of(*ends))
        status, printed, error = command("run", test_file, "--out", test_file.parent / "out", "--no-figures")
        assert status == 1
        assert (f"error: {len(ends)} of {len(ends)} deformed frames failed or did not converge" in error) == bool(ends)
        assert told in error
        assert f"{len(ends)} deformed: 0 converged, {len(ends)} failed" in printed
        assert "75.0%" not in printed


def test_run_tells_how_many_deformed_frames_failed(
    command: Run, monkeypatch: pytest.MonkeyPatch, test_file: Path
) -> None:
    _replace_pipeline(monkeypatch, _measure_of("", "torn", ""))
    status, printed, _ = command("run", test_file, "--out", test_file.parent / "out", "--no-figures")
    assert status == 0
    assert "3 deformed: 2 converged, 1 failed" in printed
    assert "50.0% measured" in printed  # 3 of 4 nodes in two frames, none in one; the reference does not count
    for ends, expected in (("", "torn"), 0), (("", "torn", "torn"), 1):  # half of them, and more
        _replace_pipeline(monkeypatch, _measure_of(*ends))
        status, _, error = command("run", test_file, "--out", test_file.parent / "out", "--no-figures")
        told = "2 of 3 deformed frames failed or did not converge; the first, f2: torn" in error
        assert (status, told) == (expected, bool(expected))
        assert f"frames that could not be read: {1 + expected}; --resume tries them again" in error
        assert Result.open(test_file.parent / "out").finished.all()


def test_figures_of_any_field(command: Run, tmp_path: Path) -> None:
    result = make_result(tmp_path / "result", frames=2, record=smooth_record)
    status, printed, _ = command(
        "figures", result.path, "--field", "exx,magnitude", "--frames", "1", "--out", tmp_path / "maps", "--gauge", "70"
    )
    assert status == 0
    assert [Path(line).name for line in printed.split()] == ["map_exx_000001.png", "map_magnitude_000001.png"]
    for options, says in (
        (("--field", "speed"), 'no field "speed"'),
        (("--field", "exx", "--gauge", "9"), "at least 56.12 px"),
        (("--field", "exx", "--measure", "small"), "allowed are green-lagrange"),
        (("--field", "exx", "--since", "5"), "no frame 5"),
        (("--field", "velocity"), "rates need 4 measured frames or more; there are 2"),
        (("--hatch",), "--hatch needs a --field"),
    ):
        status, _, error = command("figures", result.path, "--out", tmp_path / "none", *options)
        assert status == 2
        assert says in error
    assert not (tmp_path / "none").exists()


def test_figures_later(command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rgbmidic.tools.report.style.save_figure", lambda _, path: path.touch())
    result = make_result(tmp_path / "result", frames=4)
    status, printed, _ = command("figures", result.path, "--frames", "0,2")
    assert status == 0
    drawn = {file.name for file in (result.path / "figures").iterdir()}
    assert {"convergence.png", "strain_000000.png", "misfit_000002.png"} <= drawn
    assert not {"strain_000001.png", "strain_000003.png"} & drawn
    assert set(printed.split()) == {str(result.path / "figures" / name) for name in drawn}
    for file in (result.path / "solution").iterdir():
        file.unlink()
    with ResultStore.resume(result.path, make_origin(4)) as store:
        for index in (0, 1, 3):
            store.write_frame(index, random_record(index))
    assert command("figures", result.path, "--out", tmp_path / "few")[0] == 2
    assert command("figures", result.path, "--out", tmp_path / "few", "--partial")[0] == 0
    assert {file.name for file in (tmp_path / "few").glob("strain*")} == {"strain_000001.png", "strain_000003.png"}
    for frames, word in (("0,x", "indices and ranges"), ("9", "no frame 9")):
        status, _, error = command("figures", result.path, "--out", tmp_path / "none", "--frames", frames, "--partial")
        assert status == 2
        assert word in error


def test_export(command: Run, tmp_path: Path) -> None:
    result = make_result(tmp_path / "result")
    assert command("export", result.path, "--to", "npz", "--out", tmp_path / "a.npz") == (0, "", "")
    with np.load(tmp_path / "a.npz") as archive:
        np.testing.assert_array_equal(archive["u"], result.u)
    content = (tmp_path / "a.npz").read_bytes()
    status, _, error = command("export", result.path, "--out", tmp_path / "a.npz")
    assert (status, (tmp_path / "a.npz").read_bytes()) == (2, content)
    assert "already exists" in error
    (tmp_path / "a.csv").write_text("another")
    assert command("export", result.path, "--to", "csv", "--out", tmp_path / "a.csv", "--overwrite")[0] == 0
    assert (tmp_path / "a.csv").read_text().startswith("frame,")


def test_export_takes_the_scale_of_another_test_file(command: Run, tmp_path: Path) -> None:
    result = make_result(tmp_path / "result")
    test = tmp_path / "now.toml"
    test.write_text('[frames]\npath = "a"\n[region]\nrectangle = [0, 0, 9, 9]\n[scale]\nmm_per_pixel = 0.5\n')
    out = tmp_path / "a.vtkhdf"
    assert command("export", result.path, "--to", "hdf5", "--out", out, "--test", test) == (0, "", "")
    with h5py.File(out) as file:
        np.testing.assert_array_equal(file["u"], 0.5 * result.u)


def test_report(command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = []
    monkeypatch.setattr(report, "write_report", lambda *given, **options: written.append((given[1], options)))
    result = make_result(tmp_path / "result")
    assert command("report", result.path) == (0, f"{result.path / 'report.html'}\n", "")
    assert command("report", result.path, "--out", tmp_path / "a.html", "--frames", "0,1", "--overwrite")[0] == 0
    assert [file for file, _ in written] == [result.path / "report.html", tmp_path / "a.html"]
    assert written[1][1] == {"settings": None, "frames": [0, 1], "overwrite": True}
    assert command("report", result.path, "--out", tmp_path / "rep")[1] == f"{tmp_path / 'rep.html'}\n"
    assert written[2][0] == tmp_path / "rep.html"
    status, _, error = command("report", tmp_path)
    assert status == 2
    assert "is not a result folder" in error


def test_export_of_an_interrupted_run(command: Run, tmp_path: Path) -> None:
    with ResultStore.create(tmp_path / "out", make_origin(3)) as store:
        store.write_frame(1, random_record(1))
    assert command("export", tmp_path / "out", "--out", tmp_path / "a.npz")[0] == 2
    assert command("export", tmp_path / "out", "--out", tmp_path / "a.npz", "--partial")[0] == 0
    with np.load(tmp_path / "a.npz") as archive:
        assert archive["names"].tolist() == ["frame 0", "frame 1", "frame 2"]
        assert np.isnan(archive["u"]).all(axis=1).tolist() == [True, False, True]


def test_export_of_a_damaged_result(command: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    result = make_result(tmp_path / "out", frames=3)
    last = result.frame(2).u
    corrupt(result, 1)
    status, _, error = command("export", result.path, "--out", tmp_path / "a.npz")
    assert status == 2
    assert "000001.npz is damaged in frame 1: " in error
    assert "--partial" in error
    assert command("export", result.path, "--out", tmp_path / "a.npz", "--partial")[0] == 0
    assert f"{result.path} is damaged: frames lost: 1 (frame 1)" in caplog.text
    with np.load(tmp_path / "a.npz") as archive:
        assert np.isnan(archive["u"]).all(axis=1).tolist() == [False, True, False]
        np.testing.assert_array_equal(archive["u"][2], last)
    assert command("finish", result.path, "--no-figures")[0] == 2


def test_frames_says_what_a_reader_sees(command: Run, tmp_path: Path) -> None:
    path, out = tmp_path / "f.cine", tmp_path / "f.tif"
    values = np.random.default_rng(0).integers(0, 4096, (3, 12, 16))
    write_cine(path, values, count=3, cfa="GBRG")
    status, printed, error = command("frames", path, "--json", "--save", 1, out)
    assert (status, error) == (0, "")
    seen = json.loads(printed)
    assert (seen["count"], seen["shape"], seen["cfa"], seen["lost_frames"]) == (3, [12, 16], "GBRG", 0)
    np.testing.assert_array_equal(tifffile.imread(out), values[1])
    status, printed, error = command("frames", path, "--save", 1, out)
    assert (status, printed) == (2, "")
    assert error.endswith("f.tif exists already; --overwrite replaces it\n")
    path.write_bytes(path.read_bytes()[:-10])
    status, printed, error = command("frames", path)
    assert (status, printed.split()[:2]) == (0, ["reader", "Phantom"])
    assert error.startswith("warning: ")
    assert error.endswith("ends after frame 1 of 3 (0 to 2): truncated or still being written\n")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["none.cine"], "no file matches: none.cine"),
        (["f.txt"], "f.txt is not a frame that rgbmidic reads"),
        (["f.cine"], "f.cine is no Phantom movie"),
        (["f.cine", "--kind", "blue"], 'kind must be one of "bayer", "rgb", "monochrome", not "blue"'),
        (["f.cine", "--cfa", "RGB"], "cfa must be one of RGGB"),
        (["f.cine", "--save", "one", "a.tif"], "--save"),
    ],
)
def test_frames_that_cannot_be_read_are_one_line(
    command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], reason: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("f.cine", "f.txt"):
        (tmp_path / name).write_bytes(bytes(200))
    status, printed, error = command("frames", *options)
    assert (status, printed, error.count("\n")) == (2, "", 1)
    assert reason in error


def test_from_frames_to_export(command: Run, test_file: Path) -> None:
    """The whole way with the real pipeline: three frames of one pattern, each one pixel further to the right."""
    random = np.random.default_rng(0)
    texture = random.integers(0, 4, (40, 54)).repeat(4, 0).repeat(4, 1) * 800 + 300
    for index in range(3):
        frame = np.roll(texture, index, 1)[:160, 8:208] + random.normal(0, 12, (160, 200))
        tifffile.imwrite(test_file.with_name(f"f{index}.tif"), frame.round().astype(np.uint16))
    out = test_file.parent / "out"
    status, printed, error = command("run", test_file, "--out", out, "--no-figures")
    assert status == 0, error
    assert "2 deformed: 2 converged, 0 failed" in printed
    assert command("export", out, "--to", "npz", "--out", out / "fields.npz")[0] == 0
    with np.load(out / "fields.npz") as archive:
        np.testing.assert_allclose(archive["u"].mean(axis=1), [0, 1, 2], atol=0.02)
        np.testing.assert_allclose(archive["v"].mean(axis=1), [0, 0, 0], atol=0.02)
    status, _, error = command("run", test_file, "--out", out)
    assert status == 2
    assert "already holds a result" in error


def test_installed_command_ends_with_the_status_and_without_traceback(tmp_path: Path) -> None:
    code = "from rgbmidic.cli.app import main; main()"
    for extra, traces in (([], False), (["--debug"], True)):
        done = subprocess.run(
            [sys.executable, "-P", "-c", code, "run", "none.toml", "--out", str(tmp_path / "out"), *extra],
            capture_output=True,
            text=True,
        )
        assert done.returncode == 2
        assert done.stderr.splitlines()[-1] == "error: settings file not found: none.toml"
        assert ("Traceback" in done.stderr) is traces


@pytest.mark.parametrize(("text", "shape"), [("512x768", (512, 768)), ("512,768", (512, 768)), ("", None)])
def test_a_shape_is_written_one_way_and_read_in_two(text: str, shape: tuple[int, int] | None) -> None:
    assert read_shape(text) == shape


def test_a_wrong_shape_is_answered_with_an_example(command: Run, tmp_path: Path) -> None:
    status, _, error = command("inspect", tmp_path / "a.raw", "--shape", "512 768")
    assert (status, error) == (2, "error: --shape is ROWSxCOLUMNS, such as 512x768, not '512 768'\n")


@pytest.mark.usefixtures("blank_pictures")
def test_a_test_is_inspected_by_its_reference(command: Run, tmp_path: Path) -> None:
    test = colour_test(tmp_path / "test", [(0.0, 0.0), (0.3, 0.1)])
    file = test.folder / "TEST.toml"
    file.write_text(file.read_text().replace("[region]", "reference = 1\n[region]"))
    status, out, error = command("inspect", file, "--out", tmp_path / "out")
    assert (status, error) == (0, "")
    assert out == command("inspect", test.frames[1], "--test", file, "--out", tmp_path / "out", "--overwrite")[1]
    for arguments in ((file, file), (file, "--test", file)):
        assert command("inspect", *arguments)[2].startswith("error: a TEST.toml stands for the frames of its reference")


def test_the_first_run_says_that_kernels_are_compiled(
    command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "file").touch()
    for compiled in (False, True):
        monkeypatch.setattr("rgbmidic._kernels.are_compiled", lambda compiled=compiled: compiled)
        status, _, said = command("demo", "--out", taken)
        assert status == 2
        assert ("first run on this machine" in said) == (not compiled)


def test_kernels_are_not_compiled_where_the_cache_is_empty(tmp_path: Path) -> None:
    code = "from rgbmidic._kernels import are_compiled; print(are_compiled())"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, env=environment, check=True
    )
    assert done.stdout.strip() == "False"


def test_the_frame_options_are_the_same_in_all_commands():
    from rgbmidic_calibration import cli as calibrate

    first = None
    calibrations = ("crosstalk", "noise", "registration", "check")
    for program, names in ((cli.app, ("frames", "inspect", "view")), (calibrate.app, calibrations)):
        for name in names:
            options = {part.name: part for part in typer.main.get_command(program).commands[name].params}
            found = [(key, options[key].opts, options[key].help, options[key].required) for key in FRAME_OPTIONS]
            first = first or found
            assert found == first, name


def test_a_parameter_is_gathered_from_its_options():
    gathered, app = [], typer.Typer()
    options = {"a": Annotated[int | None, typer.Option("--a")], "b": Annotated[str | None, typer.Option("--b")]}

    @app.command()
    @collect_options("sizes", options, dict)
    def command(
        path: Annotated[str, typer.Argument()],
        sizes: dict[str, Any],
        flag: Annotated[bool, typer.Option("--flag")] = False,
    ) -> None:
        gathered.append((path, sizes, flag))

    for arguments in (["x"], ["x", "--b", "c", "--flag", "--a", "3"]):
        assert execute(app, arguments) == 0
    assert gathered == [("x", {"a": None, "b": None}, False), ("x", {"a": 3, "b": "c"}, True)]


def test_movie_and_profile_write_what_is_asked_for_or_nothing(command: Run, tmp_path: Path) -> None:
    result, movie, table = tmp_path / "result", tmp_path / "m.gif", tmp_path / "p.csv"
    make_result(result, frames=6, record=smooth_record)
    line = ("--line", "20,40:100,45")
    for arguments, message in (
        (("movie", result, "--out", movie, "--range", "1"), "--range is LOW:HIGH"),
        (("movie", result, "--out", movie, "--range", "0:inf"), "--range is LOW:HIGH"),
        (("movie", result, "--out", movie, "--over", "mask"), "--over is reference or frame"),
        (("movie", result, "--out", movie, "--column", "a"), "--column and --offset are of a --curve FILE"),
        (("movie", result, "--out", movie, "--offset", "1"), "--column and --offset are of a --curve FILE"),
        (("movie", result, "--out", movie, "--frames", "7:9"), "has frames 0 to 5"),
        (("movie", result, "--out", movie, "--field", "w"), 'there is no field "w"'),
        (("profile", result, "--out", table, "--line", "1,2"), "--line is X0,Y0:X1,Y1"),
        (("profile", result, "--out", table, *line, "--field", "misfit"), "a field with an uncertainty"),
        (("profile", result, "--out", table, *line, "--speed", "wave"), "front or peak"),
        (("profile", result, "--out", table, *line, "--field", "exx", "--speed", "front"), "no front"),
        (("profile", result, "--out", table, "--line", "20,40:900,40"), "half or more of the line"),
        (("profile", result, "--out", table, *line, "--level", ".3"), "--level is of --speed front"),
        (("profile", result, "--out", table, *line, "--curves", "2,9"), "--curves 2,9: frames [9] are not among"),
        (("profile", result, "--out", table, *line, "--curves", "a"), "--curves are indices and ranges"),
        (("profile", result, "--out", tmp_path / "p.png", *line), "--out is the table, such as p.csv, not 'p.png'"),
        (("report", result, "--out", tmp_path / "r.PDF"), "for a PDF open the page in a browser and print it"),
        (("history", result, "--out", tmp_path / "h.PNG", "--point", "30,40"), "--out is the table, such as h.csv"),
    ):
        status, out, err = command(*arguments)
        assert (status, out) == (2, "")
        assert message in err
        assert not list(tmp_path.glob("*.*"))
    assert command("movie", result, "--out", movie, "--field", "u,exx", "--range", "-.01:.01", "--width", 400)[0] == 0
    assert command("profile", result, "--out", table, *line, "--field", "u", "--curves", "2,5")[0] == 0
    assert movie.read_bytes()[:3] == b"GIF"
    assert table.with_suffix(".png").is_file()
    rows = [line.split(",") for line in table.read_text().splitlines()]
    assert rows[0] == ["frame", "number", "position_px", "x_px", "y_px", "u_px", "u_px_std"]
    numbers = np.array(rows[1:], dtype=float)
    np.testing.assert_allclose(numbers[:, 5], 0.002 * numbers[:, 0] * (numbers[:, 3] - 60), atol=1e-6)
    for name in ("movie", "profile"):
        status, _, err = command(
            name, result, "--out", {"movie": movie, "profile": table}[name], *line[: 2 * (name != "movie")]
        )
        assert status == 2
        assert "already exists" in err


def test_batch_goes_on_after_a_failure_and_ends_with_status_1(command: Run, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.toml").write_text(TEST)
    status, _, err = command("batch", tmp_path / "a.toml", tmp_path / "b.toml", "--out", tmp_path / "out")
    assert status == 1
    assert "2 of 2 tests failed: a, b" in err
    assert (tmp_path / "out" / "summary.csv").read_text().count("no frame") == 2
    assert "Failed" in (tmp_path / "out" / "summary.html").read_text()
    status, _, err = command("batch", tmp_path / "a.toml", "--out", tmp_path / "out2", "--elastic", "2:1")
    assert status == 2
    assert not (tmp_path / "out2").exists()


@pytest.mark.parametrize("form", ["X0,Y0:X1,Y1", "X0,Y0,X1,Y1"])
@pytest.mark.parametrize("text", ["40,60:200,160.5", "40,60,200,160.5"])
def test_two_corners_have_one_grammar_in_all_commands(form: str, text: str) -> None:
    assert read_coordinates(text, "--region", form) == (40, 60, 200, 160.5)
    for wrong in ("40,60:200", "40:60,200,160", "40,60,200,x", ""):
        with pytest.raises(InputError, match=f"--region is {form} in px, such as"):
            read_coordinates(wrong, "--region", form)


def test_frames_have_one_grammar_in_all_commands() -> None:
    assert read_frames("") is None
    assert read_frames("5") == [5]
    assert read_frames("0, 5,10:13") == [0, 5, 10, 11, 12]
    for wrong in ("a", "5:", ":5", "5,,6", "7:7", "-1", "1.5", "9" * 30, "0,7:7", "3:1,5", "0:20000000"):
        with pytest.raises(InputError, match="--frames are indices and ranges such as"):
            read_frames(wrong)
