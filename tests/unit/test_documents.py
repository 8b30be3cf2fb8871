"""The documents say what the code does: every key of TEST.toml with its default, status codes, examples that run."""

from __future__ import annotations

import re
import shlex
import tomllib
from dataclasses import MISSING, fields
from pathlib import Path

import pytest

from rgbmidic import CameraCalibration, NodeStatus, Status, TestSettings, cli
from rgbmidic.command import execute
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.lab.demo import run_demo, run_plate, write_plate
from rgbmidic.results import QUANTITIES
from rgbmidic.results.quantities import SHARED
from rgbmidic.settings import _place, _sections
from rgbmidic_calibration import cli as calibrate

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def documented() -> dict[str, dict[str, str]]:
    """Section, key and default as docs/reference/test-file.md states them."""
    sections: dict[str, dict[str, str]] = {}
    for line in (DOCS / "reference/test-file.md").read_text(encoding="utf-8").splitlines():
        if heading := re.fullmatch(r"## \[(\w+)\]", line):
            keys = sections.setdefault(heading[1], {})
        elif row := re.match(r"\| `(\w+)` \| ([^|]+) \|", line):
            keys[row[1]] = row[2].strip()
    return sections


def defaults() -> dict[str, dict[str, object]]:
    """Section, key and default of the code; MISSING where the key is needed."""
    found: dict[str, dict[str, object]] = {section: {} for section in _sections(TestSettings)}
    for entry in fields(TestSettings):
        section, key = _place(entry)
        if key:
            found[section][key] = entry.default
        elif section:
            types = {"frames": "FrameSettings", "region": "RegionSettings"}
            home = entry.default_factory if entry.default_factory is not MISSING else types[section]
            if isinstance(home, str):
                import rgbmidic.settings

                home = getattr(rgbmidic.settings, home)
            found[section] |= {part.name: part.default for part in fields(home)}
    return found


def as_written(default: object) -> str:
    if default is MISSING:
        return "needed"
    if default is None:
        return "-"
    if isinstance(default, bool):
        return f"`{str(default).lower()}`"
    if isinstance(default, str):
        return f'`"{default}"`'
    if isinstance(default, tuple):
        return f"`{list(default)}`"
    return f"`{round(default, 4) if isinstance(default, float) else default}`"


def test_every_key_of_the_test_file_is_documented_with_its_default():
    expected = {f"{name}.{key}": as_written(d) for name, keys in defaults().items() for key, d in keys.items()}
    assert {f"{name}.{key}": text for name, keys in documented().items() for key, text in keys.items()} == expected


def test_every_choice_of_a_key_is_named():
    text = (DOCS / "reference/test-file.md").read_text(encoding="utf-8")
    from typing import get_args

    for section, keys in _sections(TestSettings).items():
        for key, hint in keys.items():
            row = next(line for line in text.splitlines() if line.startswith(f"| `{key}` |"))
            for choice in (c for part in (hint, *get_args(hint)) for c in get_args(part) if isinstance(c, str)):
                assert choice in row, f"{section}.{key}: {choice}"


@pytest.mark.parametrize("page", [DOCS / "reference/test-file.md", ROOT / "README.md", DOCS / "how-to/resolution.md"])
def test_example_settings_are_accepted(page):
    examples = blocks(page, "toml")
    assert examples
    for text in examples:
        TestSettings.from_mapping(tomllib.loads(text))


@pytest.mark.parametrize("codes", [Status, NodeStatus])
def test_status_codes_are_documented(codes):
    text = (DOCS / "reference/conventions.md").read_text(encoding="utf-8")
    for code in codes:
        assert f"| {int(code)} | `{code.name}` |" in text


GUIDE = [
    "noise floor",
    "matching criterion",
    "virtual strain gauge (VSG) length",
    "field of view",
    "stand-off distance",
]
GUIDE += ["spatial resolution", "interpolant", "data point spacing", "initial guess", "reference update", "residual"]


def glossary():
    """Rows of the glossary of docs/reference/conventions.md: term, name here, symbol, definition."""
    text = (DOCS / "reference/conventions.md").read_text(encoding="utf-8").split("## Words and symbols")[1]
    return [line.strip("|").split("|") for line in text.splitlines() if line.startswith("|")][2:]


@pytest.mark.parametrize("term", GUIDE)
def test_the_glossary_has_the_terms_of_the_good_practices_guide(term):
    assert any(term in row[0] for row in glossary())


def test_every_term_of_the_glossary_is_defined_in_a_sentence():
    for term, _, _, definition in glossary():
        assert definition.strip().endswith("."), term


def test_the_identifiers_of_the_glossary_exist():
    """Names in code quotes are keys of TEST.toml, quantities of a result, or names in the package."""
    keys = {key for section in _sections(TestSettings).values() for key in section} | {*QUANTITIES, *SHARED}
    source = "\n".join(file.read_text(encoding="utf-8") for file in (ROOT / "rgbmidic").rglob("*.py"))
    source += "\n".join(file.read_text(encoding="utf-8") for file in (ROOT / "calibration").rglob("*.py"))
    for _, names, *_ in glossary():
        for name in re.findall(r"`([\w.]+)`", names):
            part = name.split(".")[-1]
            assert part in keys or re.search(rf"(class|def) {part}\b|^ *{part}( =|:)", source, re.MULTILINE), name


SIZES = {"node": "N", "light": "k", "element": "E", "function": "m", "row": "h", "column": "w", "iteration": "i"}
SIZES |= {"image row": "H", "image column": "W", "file": "files", "reference_update": "r", "estimated node": "N"}


@pytest.mark.parametrize(("quantities", "frames"), [(SHARED, ()), (QUANTITIES, ("T",))])
def test_every_quantity_of_a_result_is_documented(quantities, frames):
    text = (DOCS / "reference/conventions.md").read_text(encoding="utf-8")
    for name, quantity in quantities.items():
        sizes = (*frames, *(str(SIZES.get(axis, axis)) for axis in quantity.axes))
        shape = f"({', '.join(sizes)}{',' * (len(sizes) == 1)})"
        assert f"| `{name}` | {shape} | {quantity.unit} | {quantity.meaning} |".replace("  ", " ") in text, name


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Folder of the demo's files, smaller and with fewer frames than the command makes."""
    out = tmp_path_factory.mktemp("demo") / "rgbmidic-demo"
    lines = []
    rows = run_demo(out, lines.append, cli._calibrate_demo, size=320, angles=(0.33, 1.0, 2.0, 4.0))
    assert [row.angle_deg for row in rows] == [0.33, 1.0, 2.0, 4.0]
    assert all(row.rms_px < min(row.single_px) for row in rows)
    assert len(lines) == 4
    truth = write_plate(out / "test")
    cli._calibrate_demo_camera(out / "test")
    plate = run_plate(out / "test", truth)
    assert all(row.strain[0] < 1.5 * row.stated_strain < 0.1 * row.strain[1] for row in plate)
    assert all(row.displacement_mm[0] < 1.5 * row.stated_mm < 0.1 * row.displacement_mm[1] for row in plate)
    return out / "test"


def commands(page):
    """The commands of a page's examples, one list of words each, continued lines joined."""
    text = re.sub(r"```(?:bash)?\n(rgbmidic.*?)```", r"\0\1\0", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    examples = "\n".join(text.split("\0")[1::2]).replace("\\\n", " ")
    return [shlex.split(line) for line in examples.splitlines() if line.startswith("rgbmidic")]


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", ROOT / "calibration" / "README.md", DOCS / "how-to/resolution.md"], ids=str
)
def test_the_commands_of_a_page_run_on_the_demo_s_files_as_written(page, demo, monkeypatch, capsys):
    monkeypatch.chdir(demo)
    programs = {"rgbmidic": cli.app, "rgbmidic-calibrate": calibrate.app}
    found = commands(page)
    assert len(found) >= (1 if DOCS in page.parents else 5)
    for program, *arguments in found:
        arguments = [part.replace("60,60,390,390", "60,60,260,260") for part in arguments]  # smaller files here
        assert execute(programs[program], arguments) == 0, (arguments, capsys.readouterr().err)
    if page.parent.name == "calibration":
        noise = Calibration.read("noise.json").camera_noise
        assert (noise.linearity_error.value < 0.05).all()  # of a camera that is linear
        made = [CameraCalibration.read(name) for name in ("lens_and_plane.json", "new_plane.json", "by_corners.json")]
        scales = [camera.scale(camera.centre)[0] for camera in made]
        assert scales[:2] == pytest.approx([0.0939855] * 2, rel=3e-5)
        assert scales[2] == pytest.approx(0.0939855, rel=0.01)


def test_the_python_of_the_readme_runs_on_the_demo_s_files_as_written(demo, monkeypatch):
    monkeypatch.chdir(demo)
    for text in blocks(ROOT / "README.md", "python"):
        exec(compile(text, "README.md", "exec"), {})
    assert (demo / "python_result" / "provenance.json").is_file()


def test_links_between_the_documents_lead_somewhere():
    for page in [ROOT / "README.md", *DOCS.rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page.name}: {target}"
