"""The documents say what the code does: every key of TEST.toml with its default, status codes, examples that run."""

from __future__ import annotations

import re
import sys
from dataclasses import MISSING, fields
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import typer

from rgbmidic import NodeStatus, Status
from rgbmidic.cli import app as cli
from rgbmidic.cli.command import execute
from rgbmidic.results import QUANTITIES
from rgbmidic.results.quantities import SHARED
from rgbmidic.settings.schema import section_types
from rgbmidic_calibration import cli as calibrate

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
sys.path.append(str(DOCS / "_ext"))
import reference  # noqa: E402 (it is no package)


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
    return {name: {entry.name: entry.default for entry in fields(kind)} for name, kind in section_types().items()}


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
    for section, kind in section_types().items():
        rows = text.split(f"\n## [{section}]")[1].split("\n## ")[0].splitlines()
        for key, hint in get_type_hints(kind).items():
            row = next(line for line in rows if line.startswith(f"| `{key}` |"))
            for choice in (c for part in (hint, *get_args(hint)) for c in get_args(part) if isinstance(c, str)):
                assert choice in row, f"{section}.{key}: {choice}"


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
    keys = {entry.name for kind in section_types().values() for entry in fields(kind)} | {*QUANTITIES, *SHARED}
    source = "\n".join(file.read_text(encoding="utf-8") for file in (ROOT / "rgbmidic").rglob("*.py"))
    source += "\n".join(file.read_text(encoding="utf-8") for file in (ROOT / "calibration").rglob("*.py"))
    for _, names, *_ in glossary():
        for name in re.findall(r"`([\w.]+)`", names):
            part = name.split(".")[-1]
            assert part in keys or re.search(rf"(class|def) {part}\b|^ *{part}( =|:)", source, re.MULTILINE), name


GENERATED = {DOCS / "examples", DOCS / "reference/api"}
PROSE = [*ROOT.glob("[A-Z]*.md"), ROOT / "calibration/README.md"]
PROSE += [page for page in DOCS.rglob("*.md") if not GENERATED & set(page.parents)]


def test_links_between_the_documents_lead_somewhere():
    for page in PROSE:
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page.name}: {target}"


FORMER_KEYS = {"illumination.normalise"}
ENDINGS = {"npz", "json", "toml", "py", "csv"}


@pytest.mark.parametrize("page", PROSE, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_keys_options_and_files_that_a_page_mentions_exist(page):
    """Names of the code are looked up by tests/examples/test_pages.py."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    keys = {f"{name}.{entry.name}" for name, kind in section_types().items() for entry in fields(kind)} | FORMER_KEYS
    sources = [*ROOT.glob("rgbmidic/cli/*.py"), *ROOT.glob("*/__main__.py"), ROOT / "examples/paper/run.py"]
    sources += [ROOT / "tests/conftest.py", *DOCS.glob("reference/*commands.md")]
    options = set(re.findall(r"--[a-z][a-z-]*", "\n".join(file.read_text(encoding="utf-8") for file in sources)))
    for quoted in re.findall(r"`([^`\n]+)`", text):
        if (key := re.match(rf"({'|'.join(section_types())})\.(\w+)", quoted)) and key[2] not in ENDINGS:
            assert key[0] in keys, quoted
        if quoted.startswith(("rgbmidic", "--", "python -m benchmarks", "pytest")):
            assert set(re.findall(r"(?<!\S)--[a-z][a-z-]*", quoted)) <= options, quoted
        if re.fullmatch(r"(rgbmidic|calibration|tests|benchmarks|examples|docs)/[\w/.-]+", quoted):
            assert (ROOT / quoted).exists(), quoted


RULED_OUT = [
    r"\b(bring\w*|brought) .{0,20}\bback\b",  # warp
    r"\bshares? of (a|the|its|each|every)\b",  # fraction, relative weight
    r"\b(spoil|disturb)\w*",  # corrupted, affected by specular reflection
    r"\brenew(al|ed)\w*",  # reference update
    r"\bunmeasured\b|\blost nodes\b|\bnodes (are )?lost\b|\blos(es?|ing) nodes\b",  # nodes without data
    r"\b(told|tells|says)\b",  # reports, states
]
"""What the pages do not write, and what they write in its place."""


@pytest.mark.parametrize("page", PROSE, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_the_pages_have_the_words_of_the_field(page):
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert not [hit[0] for words in RULED_OUT for hit in re.finditer(words, text, re.IGNORECASE)]


# ---- what the site generates: the modules of docs/_ext need no Sphinx to make it


def test_the_page_of_the_test_file_has_the_code_s_types_and_defaults():
    page = reference.with_types((DOCS / "reference/test-file.md").read_text(encoding="utf-8"))
    for section, keys in reference.test_keys().items():
        part = page.split(f"## [{section}]\n")[1]
        for key, (kind, default) in keys.items():
            assert f"\n| `{key}` | {kind} | {default} | " in part, f"{section}.{key}"


@pytest.mark.parametrize("program", [cli.app, calibrate.app])
def test_every_option_of_every_command_is_on_its_page(program, capsys):
    name = "calibrate-commands" if program is calibrate.app else "commands"
    page = (DOCS / f"reference/{name}.md").read_text(encoding="utf-8")
    for name in typer.main.get_command(program).commands:
        execute(program, [name, "--help"])
        part = page.split(f"\n## {program.info.name} {name}\n")[1].split("\n## ")[0]
        options = set(re.findall(r"^ +(--[a-z][a-z-]*)", capsys.readouterr().out, re.MULTILINE)) - {"--help"}
        assert options == set(re.findall(r"^\| `(--[a-z][a-z-]*)", part, re.MULTILINE))


@pytest.mark.parametrize("name", ["scene", "calibration", "camera", "quantities"])
def test_a_generated_table_leaves_no_meaning_open(name):
    rows = [line.split(" | ") for line in reference.GENERATORS[name]().splitlines() if line.startswith("| `")]
    assert len(rows) > 4
    assert not [row[0] for row in rows if not row[-1].strip(" |")]


@pytest.mark.parametrize("page", ["scene-file", "calibration-file", "conventions"])
def test_pages_hold_what_the_code_states(page):
    """`python -m benchmarks --pages` writes it. That of the commands depends on typer: options are compared above."""
    text = (DOCS / f"reference/{page}.md").read_text(encoding="utf-8")
    assert "<!-- generated: " in text
    assert reference.filled(text) == text


def test_every_public_name_has_one_page():
    names = [f"{module}.{name}" for module, name, _ in reference.public()]
    assert len(names) == len(set(names)) > 300
    assert {"rgbmidic.Result", "rgbmidic.fields.strain_of", "rgbmidic_calibration.verify.check"} & set(names)
