"""Two lamps in succession
=======================

Two lamps fired in succession before a monochrome camera: each is excluded where it reflects (the paper's bench).

A painted sphere turns by half a degree; the reflection of each lamp stays where it is while the speckle moves. The
masks are the paper's: blur, threshold at a fraction of the dynamic range. Last line: error of the two lights together
with masks, over that of the first light alone, in the part of the field where the first light reflects.
"""

from dataclasses import replace
from functools import partial

import matplotlib.pyplot as plt
import numpy as np

from rgbmidic import correlate
from rgbmidic.fields import at_nodes
from rgbmidic.illumination import IlluminationImages
from rgbmidic.tools.lab.virtual import State, render, sphere_scene, truth, turned
from rgbmidic.weights import threshold_weights

scene = sphere_scene(size=288, seed=4, kind="monochrome", crosstalk=None, samples=8)
scene = replace(scene, lights=scene.lights[1:])
states = [State(), turned(0.5)]


def photographs(state: State, seed: int) -> IlluminationImages:
    """One image per lamp, each with its own camera noise."""
    camera, values = scene.camera, render(scene, state)
    values += np.sqrt(camera.noise.variance(values)) * np.random.default_rng(seed).normal(size=values.shape)
    return IlluminationImages(
        values=values,
        valid=values < camera.full_scale,
        names=tuple(light.name for light in scene.lights),
        full_scale=camera.full_scale,
    )


reference, deformed = photographs(states[0], seed=0), photographs(states[1], seed=1)
masks = [threshold_weights(images, threshold=0.5, blur=8) for images in (reference, deformed)]
solve = partial(correlate, region=(24, 24, 263, 263), statistics=False)

alone = solve(reference.values[:1], deformed.values[:1])
together = solve(reference.values, deformed.values, weights=masks[0], deformed_weights=masks[1])

true = at_nodes(truth(scene, states[1]), alone.nodes)
reflecting = at_nodes(masks[0][:1].astype(float), alone.nodes)[:, 0] < 0.5
rms = [np.sqrt(np.nanmean((one.displacement - true)[reflecting] ** 2)) for one in (alone, together)]
print(f"{scene.lights[0].name} excluded on {1 - masks[0][0].mean():.0%} of the image, {reflecting.sum()} nodes there")
print(f"rms error there: {rms[0]:.4f} px with {scene.lights[0].name} alone, {rms[1]:.4f} px with both and masks")
print(f"ratio: {rms[1] / rms[0]:.3f}")

# %%
# What either lamp shows; the dotted lines enclose what its mask excludes.
figure, parts = plt.subplots(1, 2, figsize=(9, 4.2), layout="constrained")
for axes, image, mask, light in zip(parts, reference.values, masks[0], scene.lights, strict=True):
    axes.imshow(image, cmap="gray")
    axes.contour(mask, [0.5], colors="tab:orange", linestyles="dotted")
    axes.set(title=light.name, xticks=[], yticks=[])
plt.show()
