"""Of a frame much larger than its region only a part is read and worked on: the result is that of the whole frame."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from small_tests import grey_frame
from textures import Affine, Texture

from rgbmidic import Calibration, Region, Status, Tri3Mesh, measure, read_test
from rgbmidic.errors import AnotherTestError, RegionError
from rgbmidic.frames import Mosaic, Window, write_tiff
from rgbmidic.frames.data import ChannelFrame, sampled_channels
from rgbmidic.illumination.crosstalk import Crosstalk, CrosstalkField
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.pipeline import Plan, plan
from rgbmidic.results import Result
from rgbmidic.settings import TestSettings

SHAPE = (800, 1000)
REGION = (300, 560, 399, 639)
LIGHTS = ("red", "green", "blue")
ROUNDING = 2e-5
"""px: what single precision leaves of positions that are counted from another pixel (1.1e-5 measured)."""

Settings = Callable[..., TestSettings]


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    """Settings of the frames in the folder; keys of `[frames]` and further sections as text."""

    def stated(frames: str = 'kind = "monochrome"', region: str = f"rectangle = {list(REGION)}", more: str = "") -> Any:
        text = f'[frames]\npath = "f*.tif"\nblack_level = 64\nwhite_level = 4095\n{frames}\n[region]\n{region}\n{more}'
        (tmp_path / "TEST.toml").write_text(text)
        return read_test(tmp_path / "TEST.toml")

    return stated


@pytest.fixture
def both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[TestSettings], tuple[Result, Result]]:
    """The results of a test by windows, and from whole frames."""

    def measured(given: TestSettings) -> tuple[Result, Result]:
        assert not Plan.from_settings(given).window.is_whole
        parts = measure(given, tmp_path / "parts")
        with monkeypatch.context() as patch:
            patch.setattr(plan, "_WORTH", 0.0)
            assert Plan.from_settings(given).window.is_whole
            whole = measure(given, tmp_path / "whole")
        np.testing.assert_allclose(parts.nodes, whole.nodes, atol=1e-9)
        assert {*map(frozenset, parts.elements.tolist())} == {*map(frozenset, whole.elements.tolist())}
        np.testing.assert_array_equal(parts.status, whole.status)
        np.testing.assert_array_equal(parts.node_status, whole.node_status)
        return parts, whole

    return measured


def apart(parts: Result, whole: Result) -> npt.NDArray[np.float64]:
    """Largest difference (px) of each frame."""
    differences = np.hypot(parts.u - whole.u, parts.v - whole.v)
    return np.asarray(np.nanmax(differences, axis=1))


def test_far_motion_is_followed_beyond_the_first_window(tmp_path: Path, settings: Settings, both: Any) -> None:
    shifts = [(0.0, 0.0), (0.3, 0.1), (150.2, -120.3), (330.0, -330.0), (333.1, -332.5)]
    for index, shift in enumerate(shifts):
        write_tiff(tmp_path / f"f{index}.tif", grey_frame(3, shift, shape=SHAPE, noise_seed=index))
    parts, whole = both(settings())
    assert (parts.status == Status.CONVERGED).all()
    error = np.stack([parts.u, parts.v], axis=-1) - np.array(shifts)[:, None]
    assert np.sqrt(np.mean(error**2)) < 0.01
    assert apart(parts, whole).max() < ROUNDING
    np.testing.assert_allclose(parts.brightness, whole.brightness, rtol=1e-5, atol=1e-3)
    (left, top), (_, rows, columns) = parts.reference_origin, parts.reference.shape
    end = parts.nodes.max(axis=0) + shifts[-1]
    assert end[0] > left + columns
    assert parts.nodes.min(axis=0)[1] + shifts[-1][1] < top
    assert (parts.frame_shape, whole.frame_shape, whole.reference_origin) == (SHAPE, SHAPE, (0, 0))
    step = -(-max(rows, columns) // 256)
    assert parts.frame(3).weights_thumbnail.shape[1:] == (-(-rows // step), -(-columns // step))


def test_a_mesh_with_its_region_is_measured_in_a_window(tmp_path: Path, settings: Settings) -> None:
    for index, shift in enumerate([(0.0, 0.0), (3.2, -1.7)]):
        write_tiff(tmp_path / f"f{index}.tif", grey_frame(3, shift, shape=SHAPE, noise_seed=index))
    first = measure(settings(), tmp_path / "first")
    mesh, region = Tri3Mesh(nodes=first.nodes, elements=first.elements), Region.from_rectangle(REGION, SHAPE)
    elsewhere = settings(region="rectangle = [0, 0, 50, 50]")
    assert not Plan.from_settings(elsewhere, mesh=mesh, region=region).window.is_whole
    second = measure(elsewhere, tmp_path / "second", mesh=mesh, region=region)
    np.testing.assert_allclose(first.u, second.u, atol=1e-12)
    less = region.without([[(300, 560), (320, 560), (320, 600)]])
    with pytest.raises(AnotherTestError, match="the input region"):
        measure(elsewhere, tmp_path / "second", mesh=mesh, region=less, resume=True)
    with pytest.raises(RegionError, match="the region is of frames of 99 x 99 px"):
        measure(elsewhere, tmp_path / "third", mesh=mesh, region=Region.from_rectangle((0, 0, 50, 50), (99, 99)))


def test_a_search_finds_as_far_as_in_whole_frames(tmp_path: Path, settings: Settings, both: Any) -> None:
    for index, shift in enumerate([(0.0, 0.0), (120.0, -100.0)]):
        write_tiff(tmp_path / f"f{index}.tif", grey_frame(3, shift, shape=SHAPE))
    parts, whole = both(settings())
    assert parts.status[1] == Status.CONVERGED
    assert apart(parts, whole).max() < ROUNDING


def test_renewed_references_have_windows_of_their_own(tmp_path: Path, settings: Settings, both: Any) -> None:
    paints = Texture.random(3), Texture.random(4)
    for index in range(6):
        motion, changed = Affine(shift=(60.3 * index, -65.2 * index)), 0.1 * index
        image = sum(
            part * paint.image(SHAPE, motion) for part, paint in zip((1 - changed, changed), paints, strict=True)
        )
        noisy = np.random.default_rng(index).normal(10 * image + 64, 8.0)
        values = np.rint(noisy).clip(0, 4095).astype(np.uint16)[None]
        write_tiff(
            tmp_path / f"f{index}.tif", ChannelFrame(values=values, black_level=np.array([64.0]), white_level=4095)
        )
    parts, whole = both(settings('kind = "monochrome"\nupdate_reference = true'))
    reference_updates = [list(of) for of in parts.iterate("reference_updates")]
    assert len(reference_updates[-1]) > 1
    assert reference_updates == [list(of) for of in whole.iterate("reference_updates")]
    assert apart(parts, whole).max() < ROUNDING


def test_a_run_that_goes_on_gives_the_same_bits(tmp_path: Path, settings: Settings) -> None:
    for index in range(4):
        write_tiff(tmp_path / f"f{index}.tif", grey_frame(3, (90.3 * index, -70.1 * index), shape=SHAPE))
    given = settings()
    at_once = measure(given, tmp_path / "at_once")

    def stop(done: int, *_: object) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure(given, tmp_path / "resumed", progress=stop)
    resumed = measure(given, tmp_path / "resumed", resume=True)
    np.testing.assert_array_equal(resumed.u, at_once.u)
    np.testing.assert_array_equal(resumed.u_std, at_once.u_std)


OUTLINES = {
    "polygon with a hole and a crack": (
        "polygon = [[300, 560], [399, 565], [395, 650], [310, 640]]\nholes = [[[340, 590], [355, 590], [350, 605]]]",
        "[mesh]\nelement_size = 14\ncracks = [[[290, 620], [345, 625]]]\n",
    ),
    "mask": ('mask = "mask.png"', ""),
    "beyond the frame": ("rectangle = [-30, 700, 60, 900]", ""),
    "threshold": (f"rectangle = {list(REGION)}", '[weights]\nmethod = "threshold"\nthreshold = "auto"\n'),
}


@pytest.mark.parametrize("outline", OUTLINES)
def test_regions_of_all_kinds(tmp_path: Path, settings: Settings, both: Any, outline: str) -> None:
    for index, shift in enumerate([(0.0, 0.0), (1.3, -0.6)]):
        write_tiff(tmp_path / f"f{index}.tif", grey_frame(3, shift, shape=SHAPE, noise_seed=index))
    mask = np.zeros(SHAPE, dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "mask.png"), cv2.circle(mask, (350, 600), 45, 255, -1))
    region, more = OUTLINES[outline]
    parts, whole = both(settings(region=region, more=more))
    assert (parts.status == Status.CONVERGED).all()
    assert apart(parts, whole).max() < ROUNDING
    assert parts.provenance.get("weights_threshold") == whole.provenance.get("weights_threshold")


def test_colour_frames_with_all_that_depends_on_the_place(tmp_path: Path, settings: Settings, both: Any) -> None:
    """What the separation learns it learns from the window: what that changes is far within the uncertainty."""
    matrix = np.array([[1, 0.12, 0.02], [0.1, 1, 0.15], [0.02, 0.1, 1]])
    texture, (y, x) = Texture.random(5), np.mgrid[: SHAPE[0], : SHAPE[1]]
    for index, shift in enumerate([(0.0, 0.0), (2.3, -1.4)]):
        paint = texture.image(SHAPE, Affine(shift=shift))
        shading = [1 + 0.3 * np.sin(x / 300 + light) * np.cos(y / 250 + 2 * light) for light in range(3)]
        lights = 900 * np.maximum(paint / paint.mean(), 0.1) * np.stack(shading)
        values = np.take_along_axis(np.tensordot(matrix, lights, axes=1), sampled_channels("RGGB", SHAPE)[None], 0)[0]
        noisy = np.random.default_rng(index).normal(values + 64, np.sqrt(4 + values / 5))
        write_tiff(
            tmp_path / f"f{index}.tif",
            Mosaic(values=np.rint(noisy).clip(0, 4095).astype(np.uint16), cfa="RGGB", black_level=np.full((2, 2), 64.0),
                   white_level=4095),
        )  # fmt: skip
    slope = 0.01 * np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]])
    parameters = np.array([[0.0] * 5, [0.05, -0.05, 2e-5, 5e-5, 2e-5], [0.0, 0.1, 0.0, -6e-5, 1e-5]])
    Calibration(
        crosstalk=Crosstalk(
            matrix=matrix,
            lights=LIGHTS,
            field=CrosstalkField(order=1, coefficients=np.stack([slope, -slope]), shape=SHAPE),
        ),
        registration=Registration(lights=LIGHTS, parameters=parameters, centre=(499.5, 399.5), radius=640.0),
        noise=NoiseModel(gain=5.0, read_noise=2.0),
        cfa="RGGB",
        shape=SHAPE,
    ).write(tmp_path / "c.json")
    parts, whole = both(settings("", more='[calibration]\nfile = "c.json"\n'))
    difference = np.hypot(parts.u - whole.u, parts.v - whole.v)[1] / whole.u_std[1]
    assert np.sqrt(np.mean(difference**2)) < COLOUR
    np.testing.assert_allclose(parts.u_std[1], whole.u_std[1], rtol=0.1)
    reflections = [result.frame(1).reflection_thumbnail for result in (parts, whole)]
    assert reflections[0].any() == reflections[1].any()


COLOUR = 0.15
"""Rms of the difference over the stated uncertainty."""


def test_where_the_region_is_most_of_the_frame_all_of_it_is_read(tmp_path: Path, settings: Settings) -> None:
    for index in range(2):
        write_tiff(tmp_path / f"f{index}.tif", grey_frame(3, (0.1 * index, 0.0), shape=SHAPE))
    made = Plan.from_settings(settings(region="rectangle = [100, 100, 700, 600]"))
    assert made.window == Window.of_frame(SHAPE)
    assert made.window_of(np.full_like(made.reference.mesh.nodes, 300.0)) == Window.of_frame(SHAPE)


def test_memory_follows_the_region_and_not_the_frame(tmp_path: Path, settings: Settings) -> None:
    def peak(shape: tuple[int, int], region: tuple[int, ...]) -> int:
        for file in tmp_path.glob("f*.tif"):
            file.unlink()
        for index in range(2):
            values = np.tile(grey_frame(3, (0.0, 0.0), shape=(400, 400), noise_seed=index).values, (1, 5, 5))
            frame = ChannelFrame(
                values=values[:, : shape[0], : shape[1]], black_level=np.array([64.0]), white_level=4095
            )
            write_tiff(tmp_path / f"f{index}.tif", frame)
        given = settings(region=f"rectangle = {list(region)}")
        measure(given, tmp_path / "warm", overwrite=True)
        tracemalloc.start()
        measure(given, tmp_path / "out", overwrite=True)
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    large, window = (2000, 2000), Window.around_points(np.array([[900, 900], [999, 999]]), 128 + 96, (2000, 2000))
    corners = [900 - window.origin[0], 900 - window.origin[1], 999 - window.origin[0], 999 - window.origin[1]]
    assert peak(large, (900, 900, 999, 999)) < 1.3 * peak(window.shape, tuple(corners))
