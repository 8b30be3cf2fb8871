"""Every block of every page runs, in the page's order, in a folder that holds the demo's files.

A block is Python, commands (bash) or settings (toml). What cannot run here has the reason above it, in a comment that
no reader sees: ``<!-- not run: it needs a cluster -->``; ``<!-- file: NAME -->`` makes a block that file of the folder.
"""

from __future__ import annotations

import doctest
import os
import re
import shlex
import shutil
import sys
import time
import tomllib
from collections.abc import Callable
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest
import stereo_scene
from matplotlib.figure import Figure
from scipy.ndimage import map_coordinates
from textures import Texture

from rgbmidic import CameraCalibration, TestSettings, measure, read_test
from rgbmidic.cli import app as cli
from rgbmidic.cli import before as cli_before
from rgbmidic.cli.command import execute
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.tools import report
from rgbmidic.tools.lab.demo import run_demo, run_plate, write_plate
from rgbmidic.tools.lab.virtual import rendering
from rgbmidic_calibration import cli as calibrate

pytestmark = pytest.mark.usefixtures("small_pictures")
ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "docs/_ext"))
import reference  # noqa: E402 (it is no package)

OUTSIDE = ["README.md", "calibration/README.md", "CHANGELOG.md"]
PAGES = OUTSIDE + sorted(
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "docs").rglob("*.md")
    if not path.is_relative_to(ROOT / "docs/examples")
)
NOT_RUN = 16
"""Blocks that do not run, at most: installation, servers, clusters, MATLAB, others' packages, minutes of work."""
BLOCK = re.compile(r"(?:^<!-- ([^\n]*?) -->\n)?^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page: str) -> list[tuple[str, str, str]]:
    """Mark, language and text of each block; directives of the site and what the code states are none."""
    text = (ROOT / page).read_text(encoding="utf-8")
    text = re.sub(r"^```\{.*?^```$|^<!-- generated: .*?^<!-- end -->$", "", text, flags=re.MULTILINE | re.DOTALL)
    return [(mark or "", language, code) for mark, language, code in BLOCK.findall(text)]


def once(folder: Path, make: Callable[[Path], None]) -> Path:
    """A folder that the processes of this run have in common, made by the first that comes."""
    try:
        folder.mkdir()
    except FileExistsError:
        for _ in range(600):
            if (folder / "done").exists():
                return folder
            time.sleep(0.5)
        raise TimeoutError(f"{folder} is not made") from None
    make(folder)
    (folder / "done").touch()
    return folder


@pytest.fixture(scope="session")
def demo(tmp_path_factory, request):
    """Folder of the demo's files, smaller and with fewer frames than the command makes, and of the result of a run."""
    base = tmp_path_factory.getbasetemp()
    return once((base.parent if hasattr(request.config, "workerinput") else base) / "demo", make_demo) / "files/test"


RAYS = 4
"""Rays per pixel and direction of the scenes of the pages, instead of 12: their glints are sampled, not averaged."""


@pytest.fixture
def few_rays(monkeypatch):
    """Scenes of the pages are rendered in a ninth of the time."""
    monkeypatch.setattr(rendering, "rays_per_pixel", lambda scene: RAYS)


def make_demo(folder):
    out, lines = folder / "files", []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendering, "rays_per_pixel", lambda scene: RAYS)
        rows = run_demo(out, lines.append, cli_before._calibrate_demo, size=320, angles=(0.33, 1.0, 2.0, 4.0))
    assert [row.angle_deg for row in rows] == [0.33, 1.0, 2.0, 4.0]
    assert all(row.rms_px < min(row.single_px) for row in rows)  # three lights beat each alone
    assert len(lines) == 4
    truth = write_plate(out / "test")
    cli_before._calibrate_demo_camera(out / "test")
    plate = run_plate(out / "test", truth)
    assert all(row.strain[0] < 1.5 * row.stated_strain < 0.1 * row.strain[1] for row in plate)
    assert all(row.displacement_mm[0] < 1.5 * row.stated_mm < 0.1 * row.displacement_mm[1] for row in plate)
    (out / "result").rename(out / "test/my_result")


def simulate(folder):
    """A simulation of a plate of 10 x 8 mm, two states of it, and the demo's frames measured on its mesh."""
    meshio = pytest.importorskip("meshio")
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 10, 11), np.linspace(0, 8, 9)))
    corner = (np.arange(8)[:, None] * 11 + np.arange(10)).ravel()
    cells = [("quad", np.stack([corner, corner + 1, corner + 12, corner + 11], axis=1))]
    points, names = np.stack([x, y, 0 * x], axis=1), []
    rows = ["node,u_mm,v_mm"]
    for number, strain in enumerate((0.0, 1e-3)):
        moved = np.stack([-0.3 * strain * x, strain * y, 0 * x], axis=1)
        meshio.Mesh(points, cells, point_data={"U": moved}).write(folder / f"step_{number}.vtu")
        names.append(f'<DataSet timestep="{number}" file="step_{number}.vtu"/>')
    rows += [f"{node},{u:.6g},{v:.6g}" for node, (u, v, _) in enumerate(moved)]
    shutil.copy(folder / "step_1.vtu", folder / "plate.vtu")
    kind = '<VTKFile type="Collection"><Collection>'
    (folder / "simulation.pvd").write_text(f"{kind}{''.join(names)}</Collection></VTKFile>", encoding="utf-8")
    (folder / "simulation.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    shutil.rmtree(folder / "my_result")
    placed = "points = [[0, 0, 40, 240], [10, 0, 240, 240], [0, 8, 40, 80]]"
    test = '[frames]\npath = "frames/*.dng"\nlast = 1\n[calibration]\nfile = "calibration.json"\n[mesh]\n'
    (folder / "on_mesh.toml").write_text(f'{test}file = "plate.vtu"\n{placed}\n', encoding="utf-8")
    measure(read_test(folder / "on_mesh.toml"), folder / "my_result")


def interrupt(folder):
    """A run of which two frames were measured."""
    shutil.rmtree(folder / "my_result")
    measure(read_test(folder / "test.toml"), folder / "my_result", frames=range(2))


def send_wave(folder):
    """A result of frames through which a front of strain travels at 30 px a frame."""
    speckle = Texture.random(0).image((200, 320))
    y, x = np.mgrid[:200, :320].astype(float)
    (folder / "wave").mkdir()
    for frame in range(13):
        shown = x - 0.5 * np.tanh((30 * frame - 40 - x) / 30)  # the motion is small against its width
        image = 100 * map_coordinates(speckle, [y, shown], order=5, mode="nearest")
        cv2.imwrite(str(folder / f"wave/{frame:02}.png"), image.astype(np.uint16))
    test = '[frames]\npath = "wave/*.png"\nkind = "monochrome"\n[region]\nrectangle = [20, 60, 300, 180]\n'
    three = (folder / "test.toml").read_text(encoding="utf-8").replace("[frames]\n", "[frames]\nlast = 2\n")
    (folder / "test.toml").write_text(three, encoding="utf-8")  # `batch` reports on them four times
    (folder / "wave.toml").write_text(f"{test}[scale]\nframe_rate = 1000.0\n", encoding="utf-8")
    shutil.rmtree(folder / "my_result")
    measure(read_test(folder / "wave.toml"), folder / "my_result")


def strike(folder):
    """Nothing but the scene of the impact."""
    shutil.copy(folder / "examples/scenes/impact.toml", folder.parent)
    shutil.rmtree(folder)
    folder.mkdir()
    shutil.move(folder.parent / "impact.toml", folder)
    os.chdir(folder)  # the old one is gone


def strike_panel(folder):
    """Nothing but the scene of the panel, with every other state."""
    scene = (folder / "examples/scenes/panel.toml").read_text(encoding="utf-8")
    head, *states = scene.split("[[states]]\n")
    strike(folder)
    (folder / "impact.toml").unlink()
    (folder / "panel.toml").write_text("[[states]]\n".join([head, *states[::2]]), encoding="utf-8")


def see_twice(folder):
    """Frames of a plate and photographs of a target by two cameras; the file of the cameras is made on the page."""
    shutil.rmtree(folder / "my_result")
    pair = stereo_scene.pair_of()
    stereo_scene.write_photographs(folder / "board", pair, 13)
    stereo_scene.write_tests(folder, pair)
    (folder / "stereo.json").unlink()


PREPARED = {
    "README.md": lambda folder: shutil.rmtree(folder / "my_result"),
    "docs/tutorials/first-steps.md": lambda folder: shutil.rmtree(folder / "my_result"),
    "docs/how-to/compare.md": simulate,
    "docs/how-to/fast-tests.md": interrupt,
    "docs/how-to/movies.md": send_wave,
    "docs/how-to/stereo.md": see_twice,
    "docs/tutorials/impact.md": strike,
    "docs/tutorials/panel.md": strike_panel,
}
"""What the folder of a page lacks or has besides."""


def accept(text):
    """Settings of a test, of whose needed sections those that the block leaves out stand in."""
    document = tomllib.loads(text)
    if "mesh" not in document:
        document.setdefault("region", {"rectangle": [0, 0, 9, 9]})
    TestSettings.from_mapping({"frames": {"path": "frames/*.dng"}, **document})


def commands(text):
    """Program and arguments of each command of a block."""
    for line in text.replace("\\\n", " ").replace("&&", "\n").splitlines():
        if words := shlex.split(line, comments=True):
            yield words


DRAWN = {
    tuple(words[:2]): page
    for page in PAGES
    for mark, language, text in blocks(page)
    if language == "bash" and not mark.startswith("not run")
    for words in commands(text)
}
"""The last page on which a command runs: there its pictures are drawn, else blank ones are written."""


@contextmanager
def blank_pictures():
    """Maps are not made, other figures are made but not drawn, movies have two frames: pictures take the most time."""
    savefig, movie = Figure.savefig, report.FieldMovie
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda figure, *to, **how: savefig(Figure((1, 1)), *to, **how))
        patch.setattr(report, "write_figures", lambda *_, **__: [])
        patch.setattr(
            report, "FieldMovie", lambda **shown: movie(**shown | {"frames": (shown["frames"] or [0, 1])[:2]})
        )
        for maps in ("fields", "strip"):
            patch.setattr(report.MapDrawer, maps, lambda *_, **__: Figure((1, 1)))
        yield


def run_commands(text, page, capsys):
    programs = {"rgbmidic": cli.app, "rgbmidic-calibrate": calibrate.app}
    for program, *arguments in commands(text):
        is_drawn = DRAWN[program, arguments[0]] == page and arguments[0] not in ("batch", "run")  # as report, figures
        arguments = [part.replace("60,60,390,390", "60,60,260,260") for part in arguments]  # smaller files here
        arguments += ["--no-reports"] * ("--table" in arguments)  # `batch`, which writes them before, of other tests
        with nullcontext() if is_drawn else blank_pictures():
            assert execute(programs[program], arguments) == 0, (arguments, capsys.readouterr().err)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)])
@pytest.mark.usefixtures("few_rays")
def test_the_blocks_of_a_page_run_as_written(page, demo, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "test"
    shutil.copytree(demo, folder)
    shutil.copytree(ROOT / "examples/scenes", folder / "examples/scenes")
    monkeypatch.chdir(folder)
    PREPARED.get(page, lambda folder: None)(folder)
    names: dict[str, object] = {}
    for mark, language, text in blocks(page):
        what, _, detail = mark.partition(": ")
        if what == "not run":
            assert len(detail.split()) > 1, f"{page}: {mark!r} states no reason"
        elif what == "file":
            Path(detail).write_text(text, encoding="utf-8")
        elif language == "python":
            exec(compile(text, page, "exec"), names)
        elif language == "bash":
            run_commands(text, page, capsys)
        elif language == "toml":
            accept(text)
        else:
            pytest.fail(f"{page}: a block of language {language!r} neither runs nor says why: {text[:60]!r}")
    if page == "README.md":
        assert Path("python_result/provenance.json").is_file()
    if page == "docs/tutorials/panel.md":
        assert np.sqrt(np.nanmean(names["ratio"] ** 2)) == pytest.approx(1, abs=0.4)
        assert names["true"].min() < -0.5
    if page == "calibration/README.md":
        noise = Calibration.read("noise.json").camera_noise
        assert (noise.linearity_error.value < 0.05).all()  # of a camera that is linear
        made = [CameraCalibration.read(name) for name in ("lens_and_plane.json", "new_plane.json", "by_corners.json")]
        scales = [camera.scale(camera.centre)[0] for camera in made]
        assert scales[:2] == pytest.approx([0.0939855] * 2, rel=3e-5)
        assert scales[2] == pytest.approx(0.0939855, rel=0.01)


def reachable(home, parts):
    """Whether a name of the code has these parts, fields of a dataclass included."""
    for part in parts:
        if is_dataclass(home) and part in {entry.name for entry in fields(home)}:
            return True
        if not hasattr(home, part):
            return False
        home = getattr(home, part)
    return True


@cache
def public_names():
    """Names of the public modules, and what they are."""
    return [(name, found) for _, name, found in reference.public()]


def exists(words):
    """Whether `package.module.name` or `Class.name` is there."""
    first, *parts = words.split(".")
    if first.startswith("rgbmidic"):
        for count in range(len(parts), -1, -1):
            with suppress(ImportError):
                return reachable(import_module(".".join([first, *parts[:count]])), parts[count:])
    return any(reachable(found, parts) for name, found in public_names() if name == first)


NO_NAMES = ("rgbmidic.frame_formats", "Competitor.prepare")
"""A group of entry points, and a class of examples/paper."""


@pytest.mark.parametrize("page", PAGES)
def test_the_names_that_a_page_mentions_exist(page):
    text = re.sub(r"```.*?```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    found = re.findall(r"`((?:rgbmidic(?:_calibration)?|[A-Z][a-z]\w+)(?:\.[A-Za-z_]\w*)+)(?:\(.*?\))?`", text)
    assert not [words for words in found if words not in NO_NAMES and not exists(words)]


@pytest.mark.parametrize("name", ["rgbmidic.nothing", "rgbmidic.results.Nothing", "Result.nothing", "Nothing.at_all"])
def test_a_name_that_is_not_there_is_found_out(name):
    assert not exists(name)


def test_every_name_that_pages_and_examples_import_is_on_the_page_of_public_names():
    texts = [code for page in PAGES for _, language, code in blocks(page) if language == "python"]
    texts += [path.read_text(encoding="utf-8") for path in (ROOT / "examples").glob("*.py")]
    imported = {line for text in texts for line in re.findall(r"^from (rgbmidic\S*) import", text, re.MULTILINE)}
    assert imported - set(reference.MODULES) == set()


PACKAGES = [*(ROOT / "rgbmidic").rglob("*.py"), *(ROOT / "calibration").rglob("*.py")]
DOCTESTS = [path for path in PACKAGES if ">>> " in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", DOCTESTS, ids=[path.stem for path in DOCTESTS])
def test_the_examples_of_the_docstrings_run(path, demo, monkeypatch):
    monkeypatch.chdir(demo)
    name = path.relative_to(ROOT).with_suffix("").as_posix().removeprefix("calibration/").replace("/", ".")
    blank = blank_pictures() if path.stem in ("document", "gallery") else nullcontext()
    with np.printoptions(legacy=False), blank:  # whatever other tests have imported
        found = doctest.testmod(import_module(name))
    assert found.attempted
    assert not found.failed


def test_few_blocks_do_not_run():
    marks = [mark for page in PAGES for mark, *_ in blocks(page) if mark.startswith("not run")]
    assert len(marks) <= NOT_RUN, marks
