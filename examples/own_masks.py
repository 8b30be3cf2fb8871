"""Masks made by hand
==================

Masks made by hand: where each lamp reflects is known, and that light is excluded there in every frame.

Two lights see a speckle that moves by 1.3 px; each has a bright spot with a texture of its own that stays where it is.
The same masks as images: `method = "images"` and `images = ["mask_1.png", "mask_2.png"]` in [weights] of TEST.toml.
Last line: rms error with the masks, over that without any weights.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import fourier_shift, gaussian_filter

from rgbmidic import measure_sequence
from rgbmidic.weights import MaskWeights

SIDE, MOTION = 160, (1.3, -0.7)
random = np.random.default_rng(0)


def texture() -> np.ndarray:
    """Spots of about 4 px around 0."""
    image = gaussian_filter(random.normal(size=(SIDE, SIDE)), 1.5, mode="wrap")
    return image / image.std()


y, x = np.mgrid[:SIDE, :SIDE]
spots = np.stack([np.hypot(x - 50, y - 80) < 25, np.hypot(x - 110, y - 80) < 25])
speckle, sparkle = texture(), [texture(), texture()]
moved = np.fft.ifft2(fourier_shift(np.fft.fft2(speckle), MOTION[::-1])).real


def photograph(surface: np.ndarray) -> np.ndarray:
    """Images (2, H, W) of the surface, with reflections that stay and with camera noise."""
    lights = [1500 + 300 * surface + spot * (900 + 400 * own) for spot, own in zip(spots, sparkle, strict=True)]
    return np.stack(lights) + random.normal(0, 5, size=(2, SIDE, SIDE))


states = [photograph(speckle), photograph(moved)]
masks = MaskWeights(~spots)  # or MaskWeights(lambda images: images.values < 2000): a function of the frame

rms = {}
for name, weights in (("without weights", None), ("with masks", masks)):
    # statistics=False: the masks alone; with statistics (the default) both count
    _, last = measure_sequence(states, region=(15, 15, 144, 144), statistics=False, weights=weights)
    error = last.displacement - MOTION
    rms[name] = np.sqrt(np.nanmean(error**2))
    print(f"{name}: {last.measured.mean():.0%} of the nodes measured, rms error {rms[name]:.4f} px")
print(f"ratio: {rms['with masks'] / rms['without weights']:.3f}")

# %%
# The two lights in the reference; the dotted lines enclose what their masks exclude.
figure, parts = plt.subplots(1, 2, figsize=(8, 3.8), layout="constrained")
for axes, image, spot in zip(parts, states[0], spots, strict=True):
    axes.imshow(image, cmap="gray")
    axes.contour(spot, [0.5], colors="tab:orange", linestyles="dotted")
    axes.set(xticks=[], yticks=[])
plt.show()
