"""Which demosaicing?
==================

Which demosaicing? One virtual pair with a reflection over the green light, measured by several methods.

The plate lies wholly in the reflection of the green lamp, whose paint sparkles differently in the two states. Each
method separates the lights of the same two raw frames; the solve is the same. Last line: scatter of the displacement
error with the default method, relative to that with Malvar's.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from rgbmidic import correlate
from rgbmidic.fields import at_nodes
from rgbmidic.illumination import linearise, separate
from rgbmidic.illumination.linear import LinearMosaic
from rgbmidic.illumination.separation import DEMOSAICERS
from rgbmidic.tools.lab.virtual import plate_scene, record, render, strained_plate, truth

scene = plate_scene(size=288, seed=5, gloss=1.5, glare="green", tilt_deg=(-8.6, 0.0))
# wrinkles twice as wide, sampled by few rays: a rough reflection
white, black = (replace(finish, spacing=0.05) for finish in (scene.surface.white, scene.surface.black))
scene = replace(
    scene, surface=replace(scene.surface, white=white, black=black), camera=replace(scene.camera, samples=3)
)
moved = strained_plate()
crosstalk = scene.camera.true_crosstalk(scene.lights)
pair = []
for number, state in enumerate((None, moved)):
    mosaic = linearise(record(render(scene, state), scene.camera, scene.lights, seed=number), scene.camera.noise)
    assert isinstance(mosaic, LinearMosaic)
    pair.append(mosaic)

lights = separate(pair[0], crosstalk)
index = np.median(lights.reflection_index(), axis=(1, 2))
print(f"speckle {lights.texture.diameter:.1f} px; reflection index of", end=" ")
print(", ".join(f"{name} {value:.2f}" for name, value in zip(crosstalk.lights, index, strict=True)))

exact, scatter, pictures = truth(scene, moved), {}, {}
for method in DEMOSAICERS:
    reference, deformed = (separate(mosaic, crosstalk, method, texture=lights.texture) for mosaic in pair)
    pictures[method] = reference.values[1, 100:160, 100:160]
    solution = correlate(reference.values, deformed.values, region=(19, 19, 269, 269))
    error = solution.displacement - at_nodes(exact, solution.nodes)
    scatter[method] = float(np.nanstd(error - np.nanmean(error, axis=0)))
    bias = np.nanmean(error, axis=0)
    print(f"{method:>16}: bias {bias[0]:+.4f} {bias[1]:+.4f} px, scatter {scatter[method]:.4f} px")

print(f"ratio: {scatter['reflection-aware'] / scatter['malvar']:.3f}")

# %%
# The green light as each method separates it, in a part of the reference.
figure, parts = plt.subplots(1, len(pictures), figsize=(11, 3.6), layout="constrained")
for axes, (method, image) in zip(parts, pictures.items(), strict=True):
    axes.imshow(image, cmap="gray", vmin=0, vmax=np.nanpercentile(pictures["malvar"], 99))
    axes.set(title=f"{method}: {scatter[method]:.4f} px", xticks=[], yticks=[])
plt.show()
