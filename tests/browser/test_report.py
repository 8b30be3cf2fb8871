"""The report printed by a browser: a PDF of A4 pages that holds every picture."""

from __future__ import annotations

import base64
import re

import pytest
from results import make_result
from viewer import MISSING, chromium

from rgbmidic.tools.report import write_report

pytestmark = pytest.mark.skipif(bool(MISSING), reason=MISSING)
A4 = (595, 842)
"""In points of 1/72 inch."""


def test_the_report_prints_as_a_pdf_with_every_picture(tmp_path):
    result = make_result(tmp_path / "result")
    write_report(result, tmp_path / "r.html")
    pictures = (tmp_path / "r.html").read_text(encoding="utf-8").count("<img ")
    with chromium() as driver:
        driver.get((tmp_path / "r.html").as_uri())
        printed = driver.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
    pdf = base64.b64decode(printed["data"])
    boxes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    assert pdf.startswith(b"%PDF")
    assert 4 <= len(boxes) <= 2 + pictures
    assert all(abs(float(side) - wanted) < 2 for box in boxes for side, wanted in zip(box, A4, strict=True))
    assert pdf.count(b"/Subtype /Image") >= pictures > 5
