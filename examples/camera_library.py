"""Frames of a camera maker's library
==================================

Frames from a camera maker's library: whatever has a length and a frame by index is a source, without any file.

The library here is virtual: a monochrome camera of 12 bit before a strip that is pulled to the right. What the source
knows of names and times goes into the result. Last line: error of the measured speed in px per second.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import fourier_shift, gaussian_filter

from rgbmidic import TestSettings, measure

SIDE, COUNT, RATE, SPEED = 128, 6, 1000.0, 350.0


class Recording:
    """A recording as a maker's library opens it; it can be sent to other processes, which open it again."""

    names = tuple(f"shot_7 frame {number}" for number in range(COUNT))
    times_ns = tuple(int(number * 1e9 / RATE) for number in range(COUNT))

    def __len__(self) -> int:
        """Number of frames."""
        return COUNT

    def __getitem__(self, index: int) -> np.ndarray:
        """Frame (H, W), uint16, 12 bit."""
        random = np.random.default_rng(0)
        speckle = gaussian_filter(random.normal(size=(SIDE, SIDE)), 1.5, mode="wrap")
        moved = np.fft.ifft2(fourier_shift(np.fft.fft2(speckle), (0, SPEED * index / RATE))).real
        noise = np.random.default_rng(index + 1).normal(0, 5, size=moved.shape)
        return np.clip(np.round(1800 + 2500 * moved + noise), 0, 4095).astype(np.uint16)

    def describe(self) -> str:
        """What `resume` compares: another recording is another test."""
        return "shot 7"


settings = TestSettings.from_mapping(
    {
        "frames": {"path": [], "kind": "monochrome", "white_level": 4095.0},
        "region": {"rectangle": [10, 10, 117, 117]},
    }
)
with tempfile.TemporaryDirectory() as folder:
    result = measure(settings, Path(folder) / "result", source=Recording())
    seconds, position = result.time_ns / 1e9, np.nanmean(result.u, axis=1)
    print(f"{len(result)} frames, {result.names[0]} to {result.names[-1]}, of {result.provenance['inputs']['source']}")

speed = np.polyfit(seconds, position, 1)[0]
print(f"speed {speed:.2f} px/s, true {SPEED:.2f} px/s")
print(f"error: {abs(speed - SPEED):.3f} px/s")

# %%
# Mean position over the camera's own times.
figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
axes.plot(1e3 * seconds, position, "o", label="measured")
axes.plot(1e3 * seconds, SPEED * seconds, "-", label="true")
axes.set(xlabel="time (ms)", ylabel="mean u (px)")
axes.legend()
plt.show()
