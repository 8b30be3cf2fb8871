"""Messages: one line that a terminal can show, whatever a file holds."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from rgbmidic.command import OnceFilter
from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.settings import TestSettings


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
