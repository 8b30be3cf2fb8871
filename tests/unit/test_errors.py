"""Messages: one line that a terminal can show, whatever a file holds."""

from __future__ import annotations

import ast
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from typer import Typer
from typer.main import get_command

import rgbmidic
import rgbmidic_calibration
from rgbmidic.cli import app as cli
from rgbmidic.cli import command
from rgbmidic.cli.command import OnceFilter
from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.settings import TestSettings
from rgbmidic_calibration import cli as calibration


def test_control_characters_are_spelt_out() -> None:
    assert str(InputError("a\nb\x1b[31m")) == r"a\nb\x1b[31m"


@pytest.mark.parametrize("text", ["9" * 100_000, "word " * 20_000])
def test_what_is_quoted_is_cut(text: str) -> None:
    said = str(RgbmidicError(f"the key a of f.toml must be a number, not {text}; 5 is one"))
    assert len(said) < 4200
    assert said.startswith("the key a of f.toml must be a number, not ")
    assert "characters)" in said


@pytest.mark.parametrize(
    "sections",
    [
        {"frames": {"kind": "x" * 100_000}},
        {"frames": {"path": "f.npy"}, "y" * 100_000: {}},
        {"frames": {"path": "f.npy"}, "probes": {"points": "1," * 50_000}},
    ],
)
def test_settings_with_huge_texts_are_refused_in_a_line(sections: dict[str, object], tmp_path: Path) -> None:
    with pytest.raises(RgbmidicError) as caught:
        TestSettings.from_mapping(sections, tmp_path)
    assert len(str(caught.value)) < 4200


def test_a_text_is_shown_once() -> None:
    once = OnceFilter()
    records = [
        logging.makeLogRecord({"msg": text, "args": args}) for text, args in (("a %d", (1,)), ("b", ()), ("a 1", ()))
    ]
    assert [once.filter(record) for record in records] == [True, True, False]


def messages(package: Path) -> Iterator[str]:
    """Yield the texts of a library, without its docstrings and its commands; ``{}`` for what is filled in."""
    for path in (path for path in package.rglob("*.py") if not {"cli", "options"} & {path.parent.name, path.stem}):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        nodes = list(ast.walk(tree))
        within = {part for node in nodes if isinstance(node, ast.JoinedStr) for part in ast.walk(node)} | {
            node.value for node in nodes if isinstance(node, ast.Expr)
        }
        for node in nodes:
            if isinstance(node, ast.JoinedStr):
                yield "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in within:
                yield node.value


@pytest.mark.parametrize(("library", "app"), [(rgbmidic, cli.app), (rgbmidic_calibration, calibration.app)])
def test_a_library_names_arguments_and_a_command_the_options_that_state_them(library: ModuleType, app: Typer) -> None:
    commands = get_command(app).commands.values()  # type: ignore[attr-defined]
    options = {option for entry in commands for parameter in entry.params for option in parameter.opts}
    whole_command = re.compile(r"rgbmidic(-calibrate)?( [^`);]*)?")
    for message in messages(Path(str(library.__file__)).parent):
        if re.fullmatch("--[a-z-]+", message):  # an argument of a command that is started
            continue
        assert not re.search(r"(?<!var\()--[a-z]", whole_command.sub("", message)), message
        for argument in re.findall(r"`[a-z_]+(?:=True)?`", message):
            assert command.name_options(argument) in options, message


def test_a_command_reports_its_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.fail("`retry_failed` goes with `resume=True`: see `rgbmidic run`") == 1
    assert capsys.readouterr().err == "error: --retry-failed goes with --resume: see `rgbmidic run`\n"
