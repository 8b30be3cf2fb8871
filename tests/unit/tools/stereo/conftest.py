"""The one virtual pair that the tests of two cameras share."""

from __future__ import annotations

import numpy as np
import pytest
from stereo_scene import pair_of, write_tests

from rgbmidic.tools.stereo import StereoSettings, measure_stereo


@pytest.fixture(scope="session")
def pair():
    return pair_of(20.0, (2000.0, 80.0, 60.0, -0.4, 0, 0, 0, 0))


@pytest.fixture(scope="session")
def measured(tmp_path_factory, pair):
    """Folder of the tests, and the result in three dimensions."""
    folder = tmp_path_factory.mktemp("stereo")
    left, right, camera = write_tests(folder, pair)
    settings = StereoSettings(axes="camera")
    return folder, measure_stereo(left, right, camera, folder / "result", settings, workers=1)


@pytest.fixture(scope="session")
def calibrated(measured, pair, tmp_path_factory):
    """The same by cameras that are not known exactly."""
    std = np.zeros(22)
    std[[0, 8]], std[16:] = 1.5, (4e-4, 4e-4, 1e-4, 0.1, 0.01, 0.3)
    known = pair_of(20.0, (2000.0, 80.0, 60.0, -0.4, 0, 0, 0, 0), covariance=np.diag(std**2))
    there = [measured[0] / "result" / side for side in ("left", "right")]
    return measure_stereo(*there, known, tmp_path_factory.mktemp("calibrated"), StereoSettings(axes="camera"))
