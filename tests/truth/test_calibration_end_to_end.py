"""The virtual sphere measured with a calibration from captures alone, against the run that is given the truth."""

from __future__ import annotations

import numpy as np

from rgbmidic.frames.images import write_dng
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.pipeline import measure
from rgbmidic.settings import CalibrationSettings, FrameSettings, RegionSettings, TestSettings
from rgbmidic.tools.lab.virtual import record, render, sphere_scene, truth, turned
from rgbmidic.tools.lab.virtual.dataset import dark_frames, target_scene, true_calibration
from rgbmidic_calibration.captures import block_means, stack_frames
from rgbmidic_calibration.crosstalk import estimate_crosstalk
from rgbmidic_calibration.noise import photon_transfer
from rgbmidic_calibration.registration import estimate_registration

SIZE = 224
LATERAL_COLOUR = 0.5
"""px at the corner, from light to light."""
GREENS = (-0.015, -0.001, 0.010)
"""A real sensor's, of the rows with red less those with blue."""
LOSS = 0.05
BORDER = 30


def from_captures(scene):
    target, camera, lights = render(target_scene(scene, "speckled")), scene.camera, scene.lights
    singles = {
        light.name: [record(target, camera, lights, seed=100 * i + k, shining=(light.name,)) for k in range(4)]
        for i, light in enumerate(lights)
    }
    dark = dark_frames(scene, count=4, seed=9)
    crosstalk = estimate_crosstalk(
        {name: [block_means(frame) for frame in frames] for name, frames in singles.items()},
        [block_means(frame) for frame in dark],
    ).crosstalk
    dark_stack = stack_frames(dark, drifts=False)
    stacks = {name: stack_frames(frames) for name, frames in singles.items()}
    dimmed = [target * np.float32(share) for share in (0.3, 0.6)]
    flats = [
        [record(image, camera, lights, seed=500 + 10 * i + k, shining=("green",)) for k in range(2)]
        for i, image in enumerate(dimmed)
    ]
    noise = photon_transfer(dark_stack, [*(stack_frames(frames) for frames in flats), stacks["green"]]).camera_noise
    return Calibration(
        crosstalk=crosstalk, camera_noise=noise, registration=estimate_registration(stacks, dark_stack).registration
    )


def test_calibration_from_captures_loses_less_than_five_per_cent(tmp_path):
    scene = sphere_scene(size=SIZE, seed=5, lateral_colour=LATERAL_COLOUR, green_difference=GREENS)
    state, found = turned(2.0), from_captures(scene)
    assert np.abs(found.crosstalk.green_difference - GREENS).max() < 0.002
    corners = np.array([[0.0, 0.0], [SIZE - 1, 0], [SIZE - 1, SIZE - 1]])
    lens = scene.camera.true_registration(scene.lights)
    assert np.abs(found.registration.displacement(corners) - lens.displacement(corners)).max() < 0.05
    (tmp_path / "frames").mkdir()
    for index, image in enumerate((render(scene), render(scene, state))):
        write_dng(tmp_path / "frames" / f"{index}.dng", record(image, scene.camera, scene.lights, seed=index))
    exact = truth(scene, state)
    errors = {}
    for name, calibration in (("truth", true_calibration(scene)), ("captures", found)):
        calibration.write(tmp_path / f"{name}.json")
        settings = TestSettings(
            frames=FrameSettings(path=("frames/*.dng",)),
            region=RegionSettings(rectangle=(BORDER, BORDER, SIZE - 1 - BORDER, SIZE - 1 - BORDER)),
            calibration=CalibrationSettings(file=tmp_path / f"{name}.json"),
            base=tmp_path,
        )
        result = measure(settings, tmp_path / name)
        column, row = np.rint(result.nodes).astype(int).T
        found = np.stack([result.u[1], result.v[1]])
        errors[name] = float(np.sqrt(np.nanmean((found - exact[:, row, column]) ** 2)))
    assert errors["truth"] < 0.0095
    assert errors["captures"] < (1 + LOSS) * errors["truth"]
