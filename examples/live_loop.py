"""A live loop
===========

A live loop: each frame is measured as it is taken, and the stage is corrected before the next one.

A stage drifts by some tenths of a pixel a frame, in a direction that wanders; the measured displacement moves it back.
`measure_sequence` takes the camera's generator and gives each solution before it asks for the next frame. Last line:
rms position of the stage over that without correction.
"""

from collections.abc import Iterator

import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import fourier_shift, gaussian_filter

from rgbmidic import Status, measure_sequence

SIDE, COUNT = 128, 16
random = np.random.default_rng(0)
spectrum = np.fft.fft2(gaussian_filter(random.normal(size=(SIDE, SIDE)), 1.5, mode="wrap"))
drift = np.vstack([np.zeros((1, 2)), np.cumsum(random.normal(0.05, 0.1, size=(COUNT - 1, 2)), axis=0)])
drift = np.cumsum(drift, axis=0)
correction = np.zeros(2)
positions = []


def camera() -> Iterator[np.ndarray]:
    """Frames as they are taken: the stage is where drift and correction have brought it by then."""
    for moved in drift:
        positions.append(moved + correction)
        yield (
            1800
            + 2500 * np.fft.ifft2(fourier_shift(spectrum, positions[-1][::-1])).real
            + random.normal(0, 5, size=(SIDE, SIDE))
        )


speed = np.zeros(2)
for solution in measure_sequence(camera(), region=(12, 12, 115, 115), element_size=25):
    if solution.status is not Status.CONVERGED:
        continue
    off = np.nanmean(solution.displacement, axis=0)
    speed += 0.5 * off  # an integrating controller: what is left is drift that was not foreseen
    correction -= off + speed

left, free = (np.sqrt(np.mean(np.square(one))) for one in (positions, drift))
print(f"{COUNT} frames; without correction the stage would be {free:.2f} px off (rms), with it {left:.2f} px")
print(f"ratio: {left / free:.3f}")

# %%
# Where the stage is in each frame, along x.
figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
axes.plot(drift[:, 0], label="without correction")
axes.plot(np.array(positions)[:, 0], label="with it")
axes.set(xlabel="frame", ylabel="x (px)")
axes.legend()
plt.show()
