"""The limits of the check for texture: what neighbouring samples correlate by, and what can then be measured."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rgbmidic import correlate
from rgbmidic.frames.data import ChannelFrame
from rgbmidic.pipeline.frame_quality import SUITABILITY, neighbour_correlation

SIDE = 256
SHIFT = (0.4, -0.3)
INSIDE = np.ones((SIDE, SIDE), dtype=bool)


def pair(diameter: float, contrast: float) -> list[np.ndarray]:
    """Two states of a random texture of the given full width at half maximum (px), its contrast in units of the noise's
    200 DN."""
    random = np.random.default_rng(round(10 * diameter))
    fine = cv2.GaussianBlur(random.standard_normal((SIDE + 40, SIDE + 40)), (0, 0), diameter / 2.355 / np.sqrt(2))
    shift = np.fft.fftfreq(SIDE + 40) * 2j * np.pi
    phase = np.exp(-shift[:, None] * SHIFT[1] - shift * SHIFT[0])
    states = [fine, np.fft.ifft2(np.fft.fft2(fine) * phase).real]
    cut = [state[20:-20, 20:-20] / fine.std() for state in states]
    return [20000 + 200 * (contrast * state + random.standard_normal((SIDE, SIDE))) for state in cut]


def correlation(state: np.ndarray) -> float:
    frame = ChannelFrame(values=np.rint(state).astype(np.uint16)[None], black_level=0, white_level=65535)
    return neighbour_correlation(frame, INSIDE)


@pytest.mark.parametrize("diameter", [2.0, 3.0, 4.7])
def test_what_is_refused_cannot_be_measured_and_what_is_warned_of_is_poor(diameter):
    found = {}
    for contrast in (0.3, 0.5, 1.5):
        first, second = pair(diameter, contrast)
        solution = correlate(first, second, prefilter="binomial", initial=(0.3, -0.2))
        error = np.sqrt(np.nanmean((solution.displacement - SHIFT) ** 2)) if solution.measured.any() else np.nan
        found[contrast] = correlation(first), error
    assert found[0.3][0] < SUITABILITY.no_texture
    assert np.isnan(found[0.3][1])
    assert SUITABILITY.no_texture < found[0.5][0] < SUITABILITY.faint_texture
    assert found[0.5][1] > 0.2
    assert found[1.5][0] > SUITABILITY.faint_texture
    assert found[1.5][1] < 0.2
