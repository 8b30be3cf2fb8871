"""Every name that the package exports has an example in its docstring, and it runs as written."""

from __future__ import annotations

import doctest
import sys
from pathlib import Path

import pytest

import rgbmidic

PENDING = {
    "Calibration",
    "CameraCalibration",
    "NodeStatus",
    "Result",
    "RgbmidicError",
    "Solution",
    "Status",
    "correlate",
    "discretisation_error",
    "export_result",
    "measure",
    "measure_sequence",
    "read_histories",
    "separate",
}
"""Names that have no example of their own yet; the list only gets shorter."""


def examples(name: str) -> list[doctest.DocTest]:
    exported = getattr(rgbmidic, name)
    module = sys.modules[exported.__module__]
    cases = doctest.DocTestFinder().find(exported, name, module=module, globs=dict(vars(module)))
    return [case for case in cases if case.examples]


@pytest.mark.parametrize("name", sorted(set(rgbmidic.__all__) - PENDING - {"__version__"}))
def test_the_examples_of_an_exported_name_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # some write a small file and read it
    cases = examples(name)
    assert cases, f"{name} has no example"
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    reports: list[str] = []
    for case in cases:
        runner.run(case, out=reports.append)
    assert not runner.failures, "".join(reports)


def test_a_name_that_waits_is_exported() -> None:
    assert set(rgbmidic.__all__) >= PENDING
