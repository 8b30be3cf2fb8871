"""A short run of the paper's experiment: the reflection disturbs plain DIC, and MIDIC with weights puts it right."""

import ast
import csv
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import run
from claims import judge
from measurement import METHODS, PaperStudy

sys.path.append(str(Path(__file__).resolve().parents[3]))

from benchmarks.study import FEW as ANGLES
from benchmarks.study import bench_study, small_cause


@pytest.fixture(scope="module")
def study() -> PaperStudy:
    """That of the quick tables: frames of 448 px, one scene."""
    return bench_study(True)


def test_reflection_disturbs_one_light_and_midic_follows_the_quiet_area(study):
    scene = study.scenes[0]
    p = {method: scene.perturbation(method) for method in METHODS}
    quiet = p["dic"][:, 0]
    assert (quiet > 0.0005).all()
    assert (quiet < 0.025).all()  # .0175 at 8 degrees
    # paper: 4 to 5 times; the worst of A2 to A4 tells. At 1 degree the draw of the noise scatters it from 2.7 to 6
    assert (p["dic"][:, 2:].max(axis=1) > np.array([1.5, 3]) * quiet).all()
    assert p["glc-dic"][1, 2:].max() < 0.8 * p["dic"][1, 2:].max()
    assert np.median(p["midic-unweighted"] / p["dic"]) > 0.5
    # the P of one area rests on some ten nodes and scatters by a quarter: at 1 degree the quiet one's is all noise
    assert rms(p["midic"][0, 3:]) < 0.7 * rms(p["dic"][0, 3:])
    assert (p["midic"][1, 3:] < 1.3 * quiet[1]).all()
    assert p["midic"][1, 2:].max() < 0.4 * p["dic"][1, 2:].max()


def rms(values):
    return np.sqrt(np.mean(values**2))


def test_p_is_error_and_not_the_motion_of_the_sphere(study):
    """The long waves that the filter takes off are all of the true field: what is left is error."""
    for one in study.scenes[0].measurements.values():
        assert one.perturbation == pytest.approx(
            one.error, rel=0.05, abs=2e-4, nan_ok=True
        )  # noise has long waves, too


def test_rms_is_of_both_components_with_all_their_waves(study):
    scene = study.scenes[0]
    for angle, shot in scene.snapshots.items():
        for method, field in shot.displacement.items():
            error = (field - scene.bench.truth(angle)) ** 2
            expected = [np.sqrt(np.nanmean(area.cut(error))) for area in scene.bench.areas]
            found = scene.measurements[method, angle]
            known = np.isfinite(found.rms)
            assert known.any()
            assert found.rms[known] == pytest.approx(np.array(expected)[known], rel=1e-6)
            assert (found.ratio[known] > 0.2).all()


def test_threshold_is_found_where_the_disturbance_ends(study):
    found = study.scenes[0].threshold
    assert 100 < found.zone.radius < 300
    assert 0.15 < found.value < 0.5


def test_two_lamps_halve_the_variance(study):
    noise = study.noise
    assert noise.together < noise.single.min()
    assert np.sqrt(np.mean((noise.single / noise.together) ** 2)) == pytest.approx(np.sqrt(2), rel=0.12)


def test_every_statement_has_a_verdict_and_a_reason_where_it_fails(study):
    claims = judge(study)
    assert {claim.figure.split(",")[0] for claim in claims} >= {"Fig. 4", "Fig. 7", "Fig. 8", "Fig. 9", "Fig. 17"}
    for claim in claims:
        assert claim.measured
        if claim.possible == ("not reproduced",):
            assert claim.reason or claim.figure == "Fig. 6", claim


def test_verdicts_follow_the_figures(study):
    """A study in which MIDIC is as disturbed as plain DIC must not pass: at 8 degrees, for at 1 all is noise."""
    scene = replace(study.scenes[0], angles=(8.0,))
    study = replace(study, scenes=(scene,))
    spoilt = {
        (method, angle): scene.measurements["dic" if method == "midic" else method, angle]
        for method, angle in scene.measurements
    }
    worse = replace(study, scenes=(replace(scene, measurements=spoilt),))
    for figures, passes in ((judge(study), True), (judge(worse), False)):
        trend = next(claim for claim in figures if claim.figure == "Fig. 17" and "trend" in claim.statement)
        assert (trend.verdict != "not reproduced") == passes


@pytest.mark.usefixtures("small_pictures")
def test_command_writes_tables_pictures_and_report(study, tmp_path, monkeypatch, capsys):
    asked = {}

    def canned(angles, **settings):
        asked.update(angles=angles, **settings)
        return study

    monkeypatch.setattr(run, "run_paper_study", canned)
    out = tmp_path / "study"
    run.main(["--out", str(out), "--angles", "1,8", "--size", "512"])
    assert "report: " in capsys.readouterr().out
    assert asked["angles"] == [1.0, 8.0]
    assert (asked["size"], asked["causes"]) == (512, False)
    with (out / "perturbation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["scene", "method", "angle_deg", "area", "P_px"]
    assert len(rows) == len(METHODS) * len(ANGLES) * 5
    row = next(r for r in rows if (r["method"], r["angle_deg"], r["area"]) == ("midic", "8", "A4"))
    assert float(row["P_px"]) == pytest.approx(study.scenes[0].perturbation("midic")[1, 4], rel=1e-5)
    report = (out / "report.md").read_text(encoding="utf-8")
    pictures = {path.name for path in out.glob("*.png")}
    assert len(pictures) == 10
    assert all(f"]({name})" in report for name in pictures)
    assert "reproduced" in report
    assert all(name in (out / "report.html").read_text(encoding="utf-8") for name in pictures)
    with pytest.raises(SystemExit, match="2"):
        run.main(["--out", str(out)])
    assert "not empty" in capsys.readouterr().err


@pytest.mark.parametrize("angles", ["0", "-1,3", "50", "3,x"])
def test_angles_that_make_no_sense_are_refused_before_any_work(angles, tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        run.main(["--out", str(tmp_path / "out"), f"--angles={angles}"])
    assert "angles" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("script", sorted(Path(run.__file__).parent.glob("*.py")), ids=lambda path: path.name)
def test_the_study_uses_public_names_only(script):
    """Names of a package's `__all__`, or a top module: what a laboratory's own script may rely on."""
    public = {"rgbmidic.errors", "rgbmidic.settings", "rgbmidic.typing"}
    for node in ast.walk(ast.parse(script.read_text(encoding="utf-8"))):
        assert not (isinstance(node, ast.Import) and any(part.name.startswith("rgbmidic") for part in node.names))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rgbmidic"):
            home = import_module(node.module)
            assert hasattr(home, "__path__") or node.module in public, node.module
            assert {part.name for part in node.names} <= set(getattr(home, "__all__", vars(home))), node.module


def test_brightness_disturbs_plain_dic_and_roughness_defeats_the_grey_level_correction():
    """Paint without relief and wrinkles that reflects as much on average: the same P by DIC, hardly any by GLC-DIC."""
    rough, smooth = small_cause(0), small_cause(5)
    assert "no wrinkles" in smooth.title
    plain, corrected = rough.inside[:, 0], smooth.inside[:, 0]
    assert corrected[0] == pytest.approx(plain[0], rel=0.35)
    assert corrected[1] < 0.35 * plain[1]
    assert (rough.inside[:, 0] > 3 * rough.outside[:, 0]).all()
