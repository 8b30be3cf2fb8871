"""A Bayer test from end to end
============================

A test as a laboratory has it, end to end: two raw Bayer frames, a calibration file and TEST.toml on disk.

The frames are virtual (a painted plate under red, green and blue lamps, 12 bit, noise, crosstalk), so the truth is
known. Last line: rms error of the displacement in px.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from rgbmidic import Calibration, measure, read_test
from rgbmidic.fields import at_nodes
from rgbmidic.frames import Mosaic, write_dng
from rgbmidic.tools.lab.virtual import State, plate_scene, record, render, strained_plate, truth

SETTINGS = """
[frames]
path = "frames/*.dng"

[calibration]
file = "calibration.json"

[region]
rectangle = [20, 20, 171, 171]
"""

scene = plate_scene(size=192, seed=2)
states = [State(), strained_plate(shift_px=(1.3, -0.7), strain=0.003)]

with tempfile.TemporaryDirectory() as folder:
    test = Path(folder)
    (test / "frames").mkdir()
    for number, state in enumerate(states):
        frame = record(render(scene, state), scene.camera, scene.lights, seed=number)
        assert isinstance(frame, Mosaic)
        write_dng(test / "frames" / f"frame_{number}.dng", frame)
    # what `rgbmidic-calibrate crosstalk` finds from captures with one lamp on at a time
    crosstalk = scene.camera.true_crosstalk(scene.lights)
    Calibration(crosstalk=crosstalk, noise=scene.camera.noise).write(test / "calibration.json")
    (test / "TEST.toml").write_text(SETTINGS)

    result = measure(read_test(test / "TEST.toml"), test / "result")

    found = np.stack([result.u[1], result.v[1]], axis=-1)
    std = np.stack([result.u_std[1], result.v_std[1]], axis=-1)
    iterations = result.iterations[1]

error = found - at_nodes(truth(scene, states[1]), result.nodes)
print(f"lights {', '.join(result.lights)}; frame 1 in {iterations} iterations")
print(f"predicted uncertainty: {np.sqrt(np.mean(std**2)):.4f} px")
print(f"rms error: {np.sqrt(np.mean(error**2)):.4f} px")

# %%
# A part of the second raw frame, as its camera wrote it, and the displacement measured from it with its uncertainty.
figure, parts = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
parts[0].imshow(frame.values[80:110, 80:110], cmap="gray")
parts[0].set(title="raw samples", xticks=[], yticks=[])
for axes, values, what in ((parts[1], found[:, 0], "u (px)"), (parts[2], std[:, 0], "uncertainty of u (px)")):
    figure.colorbar(axes.tripcolor(*result.nodes.T, result.elements, values, shading="gouraud"), ax=axes, label=what)
    axes.set(aspect="equal", ylim=(172, 20))
plt.show()
