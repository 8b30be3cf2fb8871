"""Plain DIC on two arrays
=======================

Plain DIC on two arrays: a speckle image, the same stretched by 1 % and turned by 2 degrees, and what comes back.

The speckle is a sum of cosines, so the deformed image is exact. Last line: rms error of the displacement in px.
"""

import matplotlib.pyplot as plt
import numpy as np

from rgbmidic import correlate

SHAPE, STRETCH, ANGLE = (220, 240), 1.01, np.radians(2.0)


def speckle(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Grey levels at any point; spots of about 4 px."""
    random = np.random.default_rng(1)
    image = np.full(x.shape, 128.0)
    for a, b in random.normal(scale=0.42, size=(200, 2)):
        image += 4 * np.cos(a * x + b * y + random.uniform(0, 2 * np.pi))
    return image


# motion of the material points: x -> centre + gradient (x - centre)
centre = np.array([SHAPE[1] - 1, SHAPE[0] - 1]) / 2
turn = np.array([[np.cos(ANGLE), -np.sin(ANGLE)], [np.sin(ANGLE), np.cos(ANGLE)]])
gradient = STRETCH * turn

# a pixel of the deformed image shows the point that was at the inverse of the motion
y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
pixels = np.stack([x, y], axis=-1)
before = (pixels - centre) @ np.linalg.inv(gradient).T + centre
reference, deformed = speckle(x, y), speckle(before[..., 0], before[..., 1])

solution = correlate(reference, deformed, region=(20, 20, 219, 199), element_size=25)

truth = (solution.nodes - centre) @ (gradient - np.eye(2)).T
error = solution.displacement - truth
print(f"{solution.status.name.lower()} in {solution.iterations} iterations, {solution.measured.sum()} nodes")
print(f"displacements up to {np.hypot(*truth.T).max():.2f} px")
print(f"rms error: {np.sqrt(np.mean(error**2)):.5f} px")

# %%
# Length of the measured displacement, and of its error, over the mesh.
figure, parts = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
for axes, field, what in zip(parts, (solution.displacement, error), ("displacement", "error"), strict=True):
    axes.imshow(reference, cmap="gray")
    values = np.hypot(*field.T)
    drawn = axes.tripcolor(*solution.nodes.T, solution.elements, values, shading="gouraud", alpha=0.8)
    figure.colorbar(drawn, ax=axes, label=f"{what} (px)")
plt.show()
