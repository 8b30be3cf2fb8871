"""The documents say what the code does: every key of TEST.toml with its default, status codes, examples that run."""

from __future__ import annotations

import re
import tomllib
from dataclasses import MISSING, fields
from pathlib import Path

import pytest
from small_tests import colour_test

from rgbmidic import NodeStatus, Status, TestSettings
from rgbmidic.results import QUANTITIES
from rgbmidic.results.quantities import SHARED
from rgbmidic.settings import _place, _sections

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def documented() -> dict[str, dict[str, str]]:
    """Section, key and default as docs/test-file.md states them."""
    sections: dict[str, dict[str, str]] = {}
    for line in (DOCS / "test-file.md").read_text(encoding="utf-8").splitlines():
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
    text = (DOCS / "test-file.md").read_text(encoding="utf-8")
    from typing import get_args

    for section, keys in _sections(TestSettings).items():
        for key, hint in keys.items():
            row = next(line for line in text.splitlines() if line.startswith(f"| `{key}` |"))
            for choice in (c for part in (hint, *get_args(hint)) for c in get_args(part) if isinstance(c, str)):
                assert choice in row, f"{section}.{key}: {choice}"


@pytest.mark.parametrize("page", [DOCS / "test-file.md", ROOT / "README.md"])
def test_example_settings_are_accepted(page):
    examples = blocks(page, "toml")
    assert examples
    for text in examples:
        TestSettings.from_mapping(tomllib.loads(text))


@pytest.mark.parametrize("codes", [Status, NodeStatus])
def test_status_codes_are_documented(codes):
    text = (DOCS / "conventions.md").read_text(encoding="utf-8")
    for code in codes:
        assert f"| {int(code)} | `{code.name}` |" in text


SIZES = {"node": "N", "light": "k", "element": "E", "function": "m", "row": "h", "column": "w", "iteration": "i"}
SIZES |= {"image row": "H", "image column": "W", "file": "files"}


@pytest.mark.parametrize(("quantities", "frames"), [(SHARED, ()), (QUANTITIES, ("T",))])
def test_every_quantity_of_a_result_is_documented(quantities, frames):
    text = (DOCS / "conventions.md").read_text(encoding="utf-8")
    for name, quantity in quantities.items():
        sizes = (*frames, *(str(SIZES.get(axis, axis)) for axis in quantity.axes))
        shape = f"({', '.join(sizes)}{',' * (len(sizes) == 1)})"
        assert f"| `{name}` | {shape} | {quantity.unit} | {quantity.meaning} |".replace("  ", " ") in text, name


def test_the_python_of_the_readme_runs(tmp_path, monkeypatch):
    test = colour_test(tmp_path / "test", [(0.0, 0.0), (0.3, 0.1)])
    monkeypatch.chdir(test.folder)
    for text in blocks(ROOT / "README.md", "python"):
        exec(compile(text, "README.md", "exec"), {})
    assert (test.folder / "result" / "provenance.json").is_file()


def test_links_between_the_documents_lead_somewhere():
    for page in [ROOT / "README.md", *DOCS.glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page.name}: {target}"


def test_commands_of_the_readme_exist():
    from typer.main import get_command

    from rgbmidic.cli import app
    from rgbmidic_calibration.cli import app as calibrate

    known = {"rgbmidic": set(get_command(app).commands), "rgbmidic-calibrate": set(get_command(calibrate).commands)}
    used = re.findall(
        r"(?:^|&& )(rgbmidic|rgbmidic-calibrate) (\w+)", "\n".join(blocks(ROOT / "README.md", "bash")), re.MULTILINE
    )
    assert len(used) >= 4
    for program, command in used:
        assert command in known[program]
