"""A series of tests: failures, resuming, templates, summary, moduli."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from small_tests import SmallTest, colour_test

from rgbmidic.errors import InputError, ResultError
from rgbmidic.fields import Field, Units
from rgbmidic.results import Histories
from rgbmidic.tools.batch import (
    Outcome,
    check_summary,
    modulus,
    read_table,
    read_tests,
    run_batch,
    summary_rows,
    write_summary,
)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> SmallTest:
    return colour_test(tmp_path_factory.mktemp("batch"), [(0.0, 0.0), (0.5, 0.2)])


def test_a_failed_test_does_not_stop_the_rest_and_a_measured_one_is_kept(small: SmallTest, tmp_path: Path) -> None:
    template, table, out = small.folder / "TEST.toml", tmp_path / "t.csv", tmp_path / "out"
    table.write_text("test,mesh.element_size,frames.path\nfirst,30,\nlost,,nowhere/*.dng\nlast,36,\n")
    outcomes = list(run_batch(read_table(template, table), out))
    assert [outcome.name for outcome in outcomes if outcome.reason] == ["lost"]
    assert [outcome.measured for outcome in outcomes] == [True, False, True]
    assert outcomes[0].values["peak_magnitude_px"] == pytest.approx(0.6, abs=0.3)
    kept = (out / "first" / "provenance.json").read_bytes()
    table.write_text("test,mesh.element_size\nfirst,30\nlast,40\n")
    other = list(run_batch(read_table(template, table), out))
    assert [outcome.reason.split(";")[-1] for outcome in other] == ["", " `overwrite=True` measures it again"]
    again = list(run_batch(read_table(template, table), out, overwrite=True))
    assert [outcome.measured for outcome in again] == [False, True]
    assert again[0].values == outcomes[0].values
    assert (out / "first" / "provenance.json").read_bytes() == kept


def test_the_summary_has_mean_and_deviation_of_the_tests_that_did_not_fail(tmp_path: Path) -> None:
    outcomes = [Outcome(name=f"t{i}", folder=tmp_path / f"t{i}", values={"peak": 1.0 + i}) for i in range(3)]
    outcomes.append(Outcome(name="bad", folder=tmp_path / "bad", reason="no, not at all"))
    header, rows = summary_rows(outcomes)
    cells = {row[0]: row[header.index("peak")] for row in rows}
    assert (cells["mean"], cells["standard deviation"], cells["tests"], cells["bad"]) == ("2", "1", "3", "")
    write_summary(outcomes, tmp_path / "s.csv")
    assert [row[2] for row in csv.reader((tmp_path / "s.csv").open(newline=""))][4] == "no, not at all"


def test_a_summary_that_is_of_no_batch_is_not_replaced(tmp_path: Path) -> None:
    write_summary([Outcome(name="a", folder=tmp_path)], tmp_path / "summary.csv")
    check_summary(tmp_path, overwrite=False)
    (tmp_path / "summary.csv").write_text("my,own,table\n")
    with pytest.raises(ResultError, match="already exists"):
        check_summary(tmp_path, overwrite=False)
    check_summary(tmp_path, overwrite=True)


def test_a_modulus_is_the_slope_while_the_stress_rises() -> None:
    random, true, errors, stds = np.random.default_rng(0), 70_000.0, [], []
    strain = np.concatenate([np.linspace(0, 0.003, 40), np.linspace(0.003, 0, 40)])
    stress = np.where(np.arange(80) < 40, true * strain, 0.5 * true * strain)
    for _ in range(100):
        shared, own = random.normal(0, 2e-5), random.normal(0, 2e-5, 80)
        columns = (
            Field(name="gauge_1_strain", unit="", values=strain + own + shared, std=np.full(80, 2e-5 * 2**0.5)),
            Field(name="stress", unit="MPa", values=stress, std=None),
        )
        index = np.arange(80)
        histories = Histories(frames=index, numbers=index, status=0 * index, times=None, quantities=columns,
                              stress_strain=("gauge_1_strain", "stress"), units=Units(), remarks=())  # fmt: skip
        value, std = modulus(histories, 0.0005, 0.0025, 0.5)
        errors.append(value - true)
        stds.append(std)
    assert 0.8 < np.std(errors) / np.mean(stds) < 1.2
    assert abs(np.mean(errors)) < 0.01 * true


def test_tests_of_one_name_and_tables_without_keys_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is the name of two tests"):
        read_tests([tmp_path / "a.toml", tmp_path / "a.toml"])
    (tmp_path / "a.toml").write_text("")
    with pytest.raises(InputError, match=r"no settings file .*b\.toml$"):
        read_tests([tmp_path / "a.toml", tmp_path / "b.toml"])
    for text, message in (
        ("name,x\n", 'a first column "test"'),
        ("test,speed\n", 'a first column "test"'),
        ("test,channels.area\na\n", "row 2 .* has 1 fields"),
        ("test,channels.area\n../a,1\n", "names no test"),
        ("test,channels.area\nSummary.csv,1\n", "names no test"),
        ("test,channels.area\nA,1\na,1\n", "is the name of two tests"),
        ("test,channels.area,channels.area\na,1,2\n", "several columns of one name: channels.area"),
        ("test,channels.area\n", "one test or more"),
    ):
        (tmp_path / "t.csv").write_text(text)
        with pytest.raises(InputError, match=message):
            read_table(tmp_path / "a.toml", tmp_path / "t.csv")
