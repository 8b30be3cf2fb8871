"""Post-processing with xarray
===========================

A result as people post-process it in a notebook: named dimensions, units, lazily frame by frame (xarray).

A strip is stretched by 0.1 % a frame. Needs the package xarray (pip install rgbmidic[xarray]). Last line: largest error
of the mean strain in the middle, in 1e-6.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from rgbmidic import TestSettings, measure

try:
    import xarray  # noqa: F401
except ImportError:
    raise SystemExit("this example needs xarray: pip install rgbmidic[xarray]") from None

SIDE, COUNT, STEP = 160, 5, 1e-3


def speckle(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Grey levels at any point; spots of about 4 px."""
    random = np.random.default_rng(1)
    image = np.full(x.shape, 2000.0)
    for a, b in random.normal(scale=0.42, size=(150, 2)):
        image += 60 * np.cos(a * x + b * y + random.uniform(0, 2 * np.pi))
    return image


y, x = np.mgrid[:SIDE, :SIDE].astype(float)
# a pixel of a stretched frame shows the point that was nearer to the left edge
frames = np.stack([speckle(x / (1 + STEP * number), y) for number in range(COUNT)]).astype(np.float32)
settings = TestSettings.from_mapping({"frames": {"path": []}, "region": {"rectangle": [15, 15, 144, 144]}})

with tempfile.TemporaryDirectory() as folder:
    data = measure(settings, Path(folder) / "result", source=frames).to_xarray()
    middle = data.isel(node=np.flatnonzero(np.hypot(data.x - 80, data.y - 80) < 40))
    strain = middle.where(middle.node_status == 0).strain.sel(component="exx").mean("node")
    print(f"{data.sizes['frame']} frames of {data.sizes['node']} nodes; u in {data.u.attrs['units']}")
    for number, value in zip(data.frame.values, strain.values, strict=True):
        print(f"frame {number}: mean strain {1e6 * value:.0f}e-6")
    stretch = STEP * np.arange(COUNT)
    error = np.abs(strain.values - (stretch + stretch**2 / 2)).max()  # Green-Lagrange

print(f"largest error: {1e6 * error:.1f} (1e-6)")

# %%
# Mean strain, frame after frame.
figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
axes.plot(strain.frame, 100 * strain, "o", label="measured")
axes.plot(strain.frame, 100 * STEP * strain.frame, "-", label="true")
axes.set(xlabel="frame", ylabel="strain (%)")
axes.legend()
plt.show()
