"""The example that writes nodemaps: every number as CrackPy reads it, frames that failed left out."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from results import NODES, make_result, random_record

from rgbmidic.results import FrameRecord, Result, export_result
from rgbmidic.results.quantities import FAILED
from rgbmidic.results.result_in_units import ResultInUnits
from rgbmidic.settings import ScaleSettings

SCALE = ScaleSettings(mm_per_pixel=0.05, frame_rate=1000)
write_nodemaps = runpy.run_path(str(Path(__file__).resolve().parents[2] / "examples/nodemaps.py"))["write_nodemaps"]


@pytest.fixture
def result(tmp_path: Path) -> Result:
    """Two frames and one that failed."""
    failed = FrameRecord.from_values(nodes=NODES, lights=3, number=2, status=FAILED, time_ns=2_000_006)
    return make_result(
        tmp_path / "result", frames=3, record=lambda index: random_record(index) if index < 2 else failed
    )


def test_nodemaps_are_those_that_crackpy_reads(result: Result, tmp_path: Path) -> None:
    export_result(result, "csv", tmp_path / "plate.csv", scale=SCALE)
    files = write_nodemaps(tmp_path / "plate.csv", tmp_path / "a" / "nodemaps")
    assert [file.name for file in files] == ["plate_0.txt", "plate_1.txt"]
    physical = ResultInUnits.from_result(result, SCALE)
    values, (x, y), zero = physical.frame(1), 0.05 * result.nodes.T, np.zeros(NODES)
    expected = [np.arange(NODES) + 1, x, -y, zero, values["u"], -values["v"], zero]
    expected += [100 * values["exx"], 100 * values["eyy"], -values["exy"]]
    np.testing.assert_allclose(np.genfromtxt(files[1], delimiter=";").T, expected, rtol=1e-6, atol=1e-9)
    lines = files[1].read_text(encoding="ascii").splitlines()
    assert f"# time : {physical.times[1]:.12g}" in lines
    assert not any(line.startswith(("# x", "# force", "# displacement")) for line in lines)  # words CrackPy looks for


def test_crackpy_reads_them(result: Result, tmp_path: Path) -> None:
    reader = pytest.importorskip("crackpy.fracture_analysis.data_processing", reason="pip install crackpy")
    from crackpy.structure_elements.data_files import Nodemap

    export_result(result, "csv", tmp_path / "plate.csv", scale=SCALE)
    write_nodemaps(tmp_path / "plate.csv", tmp_path)
    read = reader.InputData(Nodemap(name="plate_1.txt", folder=str(tmp_path)))
    values = ResultInUnits.from_result(result, SCALE).frame(1)
    known = np.isfinite(values["exx"] + values["u"])  # CrackPy leaves rows with a NaN out
    names = {"disp_x": values["u"], "disp_y": -values["v"], "eps_x": values["exx"], "eps_xy": -values["exy"]}
    for name, expected in names.items():
        np.testing.assert_allclose(getattr(read, name), expected[known], rtol=1e-6, atol=1e-9, err_msg=name)


def test_an_export_in_px_is_refused(result: Result, tmp_path: Path) -> None:
    export_result(result, "csv", tmp_path / "plate.csv")
    with pytest.raises(SystemExit, match=r"plate\.csv is not a csv export in mm: state mm_per_pixel or camera"):
        write_nodemaps(tmp_path / "plate.csv", tmp_path / "nodemaps")
