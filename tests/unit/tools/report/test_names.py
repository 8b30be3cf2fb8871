"""Pictures, page, tables and dataset of one result have the names and units that its quantities declare."""

from __future__ import annotations

import ast
import html
import re
from pathlib import Path

import numpy as np
import pytest
from results import NODES, make_result, smooth_record
from textures import rigid_pair

import rgbmidic
import rgbmidic_calibration
from rgbmidic import correlate
from rgbmidic.field import column
from rgbmidic.results import (
    FrameRecord,
    Maps,
    Result,
    export_result,
    history_rows,
    read_profile,
    write_histories,
    write_profile,
)
from rgbmidic.results.histories import read_histories
from rgbmidic.settings import ProbeSettings, ScaleSettings
from rgbmidic.text import format_value
from rgbmidic.tools.report import history_figure, profile_figure, write_report
from rgbmidic.tools.report.curves import history_panels
from rgbmidic.tools.report.figures import MapDrawer
from rgbmidic.tools.report.style import literal

FIELDS = ("u", "exx", "e1", "direction", "equivalent", "u_velocity")
STATED = re.compile(r"(\S+) ± (\d\S*?)(?=[\s<,;)]|$)")
SCALES = (None, ScaleSettings(mm_per_pixel=0.05), ScaleSettings(mm_per_pixel=0.05, unit="px"))


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    def record(index: int) -> FrameRecord:
        smooth = smooth_record(index)
        std = dict.fromkeys(("nodal_exx_std", "nodal_eyy_std", "nodal_exy_std"), np.full(NODES, 1e-3))
        return FrameRecord(values={**smooth.values, "time_ns": index * 1_000_000, **std}, sizes=smooth.sizes)

    return make_result(tmp_path_factory.mktemp("names") / "out", frames=6, record=record)


@pytest.mark.parametrize("scale", SCALES, ids=["px", "mm", "mm known, px asked"])
def test_a_field_has_one_name_and_one_unit(result: Result, scale: ScaleSettings | None, tmp_path: Path) -> None:
    maps = Maps.from_result(result, scale)
    length = "mm" if scale is not None and scale.unit == "mm" else "px"
    data = result.to_xarray(scale)
    export_result(result, "csv", tmp_path / "all.csv", scale=scale)
    exported = (tmp_path / "all.csv").read_text().splitlines()[0].split(",")
    for name in FIELDS:
        field = maps.field(name)
        assert field.unit == {"u": length, "direction": "deg", "u_velocity": f"{length}/s"}.get(name, "")
        label = f"{field.symbol} ({field.unit})" if field.unit else field.symbol
        assert field.label == label
        picture = MapDrawer(maps).fields(3, [name]).axes[0]
        assert (picture.get_title(), picture.get_xlabel()) == (literal(label), f"x ({length})")
        profile = read_profile(maps, name, (20, 40, 100, 40))
        write_profile(profile, file := tmp_path / f"{name}.csv")
        header = file.read_text().splitlines()[0].split(",")
        assert header[3:] == [
            *(f"{place}_{length}" for place in ("position", "x", "y")),
            column(name, field.unit),
            f"{column(name, field.unit)}_std",
        ]
        curves = profile_figure(profile).axes
        assert (curves[0].get_title(), curves[1].get_ylabel()) == (literal(label), literal(label))
        if "velocity" not in name:
            assert column(name, field.unit) in exported
        if name in ("u", "v"):
            assert (data[name].attrs["units"], data.x.attrs["units"]) == (field.unit, length)


@pytest.mark.usefixtures("blank_pictures")
def test_histories_have_one_name_and_one_unit_in_picture_table_and_page(result: Result, tmp_path: Path) -> None:
    scale = ScaleSettings(mm_per_pixel=0.05)
    probes = ProbeSettings(points=((50.0, 40.0),), strain_gauges=((50.0, 40.0, 60.0),))
    histories = read_histories(result, probes, scale=scale)
    write_histories(histories, tmp_path / "h.csv")
    header = (tmp_path / "h.csv").read_text().splitlines()[0].split(",")
    assert {"point_1_u_mm", "point_1_u_mm_std", "strain_gauge_1_exx"} <= set(header)
    for (label, quantities), axis in zip(history_panels(histories), history_figure(histories).axes, strict=False):
        assert axis.get_ylabel() == literal(label)
        drawn = {line.get_label() for line in axis.lines}
        for quantity in quantities:
            assert column(quantity.name, quantity.unit) in header
            assert label.endswith(f"({quantity.unit})" if quantity.unit else label)
            assert literal(quantity.name) in drawn
    write_report(result, tmp_path / "page.html")
    page = html.unescape(
        re.sub(r"data:image[^\"]*|<svg.*?</svg>", "", (tmp_path / "page.html").read_text(), flags=re.DOTALL)
    )
    for name in ("u", "v", "exx", "eyy", "exy"):
        field = Maps.from_result(result).field(f"{name}_std")
        assert f"<tr><td>{field.symbol}</td><td>{field.unit or 1}</td>" in page
    printed = " ".join(cell for row in history_rows(histories)[1] for cell in row)
    stated = (
        STATED.findall(page)
        + STATED.findall(printed)
        + STATED.findall(repr(correlate(*rigid_pair((80, 80), (0.3, 0.2)))))
    )
    assert len(stated) >= 4
    for value, std in stated:
        assert std == format_value(float(std), float(std))
        assert value == format_value(float(value), float(std))


def test_no_number_with_an_uncertainty_is_written_but_by_one_function() -> None:
    package = Path(rgbmidic.__file__).parent
    for file in [*package.rglob("*.py"), *Path(rgbmidic_calibration.__file__).parent.rglob("*.py")]:
        text = file.read_text()
        nodes = ast.walk(ast.parse(text)) if re.search("±|00b1|xb1|PLUS-MINUS", text, re.IGNORECASE) else ()
        found = [one.lineno for one in nodes if isinstance(one, ast.JoinedStr) and "±" in ast.unparse(one)]
        assert len(found) == (file.name == "text.py"), file
    assert not [file for file in package.rglob("*.html") if "±" in file.read_text()]
