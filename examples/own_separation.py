"""A separation of your own
========================

A separation of one's own in place of the package's: raw Bayer frames in, images of the lights out, by a plain one.

Every colour is interpolated by a local mean of its own samples, and the crosstalk is inverted. Everything else, from
tracking to the result folder, stays. Last line: rms error of the displacement in px.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import convolve

from rgbmidic import TestSettings, measure
from rgbmidic.fields import at_nodes
from rgbmidic.frames import Mosaic, cfa_channels
from rgbmidic.illumination import IlluminationImages, linearise
from rgbmidic.tools.lab.virtual import State, plate_scene, record, render, strained_plate, truth

scene = plate_scene(size=192, seed=2)
states = [State(), strained_plate(shift_px=(1.3, -0.7), strain=0.003)]
frames = [record(render(scene, state), scene.camera, scene.lights, seed=n) for n, state in enumerate(states)]
unmixing = np.linalg.inv(scene.camera.true_crosstalk(scene.lights).matrix)
AROUND = np.outer([1, 2, 1], [1, 2, 1])


def separation(state: tuple[Mosaic, ...]) -> IlluminationImages:
    """Bilinear demosaicing, and the inverse of the crosstalk."""
    mosaic = linearise(state[0])
    height, width = mosaic.values.shape
    sampled = np.tile(cfa_channels(mosaic.cfa), (height // 2, width // 2))
    colours = [
        convolve(mosaic.values * (sampled == colour), AROUND) / convolve((sampled == colour) * 1.0, AROUND)
        for colour in range(3)
    ]
    values = np.tensordot(unmixing, np.stack(colours), axes=1)
    clipped = convolve(mosaic.saturated * 1, AROUND) > 0
    valid = np.broadcast_to(~clipped, values.shape)
    return IlluminationImages(values=values, valid=valid, names=("red", "green", "blue"), full_scale=mosaic.full_scale)


settings = TestSettings.from_mapping(
    {"frames": {"path": [], "kind": "bayer"}, "region": {"rectangle": [20, 20, 171, 171]}}
)
with tempfile.TemporaryDirectory() as folder:
    # a list of frames is a source as good as files; a function is a separation as good as the package's
    result = measure(settings, Path(folder) / "result", source=frames, separation=separation)
    print(f"lights {', '.join(result.lights)}; separated by {result.provenance['inputs']['separation']}")
    nodes = result.nodes
    found = np.stack([result.u[1], result.v[1]], axis=-1)

error = found - at_nodes(truth(scene, states[1]), nodes)
print(f"rms error: {np.sqrt(np.nanmean(error**2)):.4f} px")

# %%
# The reference's lights, as this separation gives them.
images = separation((frames[0],))
figure, parts = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
for axes, image, name in zip(parts, images.values, images.names, strict=True):
    axes.imshow(image, cmap="gray")
    axes.set(title=name, xticks=[], yticks=[])
plt.show()
