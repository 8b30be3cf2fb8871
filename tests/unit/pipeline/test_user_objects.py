"""Objects that a script gives in place of what TEST.toml names: frame source, separation, weights, mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from rgbmidic.errors import ConfigurationError, FrameError, InputError, ResultError
from rgbmidic.frames import open_series, write_tiff
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline import Plan, measure
from rgbmidic.settings import TestSettings

SIDE = 96
MOTION = [(0.0, 0.0), (0.4, -0.3), (0.9, -0.6)]


def speckle(seed: int = 0) -> np.ndarray:
    pattern = gaussian_filter(np.random.default_rng(seed).normal(size=(SIDE, SIDE)), 1.5)
    return 1800 + 1600 * pattern / pattern.std() / 4


FRAMES = np.stack([np.round(shift(speckle(), (v, u), mode="nearest")) for u, v in MOTION]).astype(np.uint16)
"""(T, H, W), 12 bit."""


def settings(path: object = (), **sections: dict[str, object]) -> TestSettings:
    frames = {"path": path, "kind": "monochrome", "white_level": 4095.0} | sections.pop("frames", {})
    document = {"frames": frames, "region": {"rectangle": [10, 10, 85, 85]}, "mesh": {"element_size": 15}}
    return TestSettings.from_mapping(document | sections)


def error(result) -> float:
    found = np.stack([result.u[1:], result.v[1:]], axis=-1)
    return float(np.sqrt(np.mean((found - np.array(MOTION[1:])[:, None]) ** 2)))


def test_a_numpy_stack_gives_the_bits_of_its_files(tmp_path):
    for number, frame in enumerate(FRAMES):
        write_tiff(tmp_path / f"{number}.tif", ChannelFrame(values=frame[None], black_level=0, white_level=4095))
    files = settings(str(tmp_path / "*.tif"))
    from_files = measure(files, tmp_path / "files")
    from_stack = measure(settings(), tmp_path / "stack", source=FRAMES)
    series = measure(settings(), tmp_path / "series", source=open_series(files.frames))
    own = Series(open_series(files.frames))
    for other in (from_stack, series, measure(settings(), tmp_path / "own", source=own)):
        np.testing.assert_array_equal(other.u, from_files.u)
        np.testing.assert_array_equal(other.u_std, from_files.u_std)
    assert error(from_stack) < 0.05
    assert own.windows
    assert all(window is not None for window in own.windows)


class Series:
    """A series of one's own, which can all that the package's can: it is asked for the part of a frame it needs."""

    def __init__(self, series):
        self.series, self.windows = series, []

    def __len__(self):
        return len(self.series)

    def __getitem__(self, index):
        return self.read(index)

    def __getattr__(self, name):
        return getattr(self.series, name)

    def read(self, index, window=None):
        self.windows.append(window)
        return self.series.read(index, window)


@dataclass
class Library:
    """As a camera maker's: every frame says what it is, and when it was taken."""

    form: str
    times_ns = (0, 1000, 2500)
    names = ("first", "second", "third")

    def __len__(self):
        return len(FRAMES)

    def __getitem__(self, index):
        one = FRAMES[index]
        if self.form == "channel":
            return ChannelFrame(values=one[None], black_level=0, white_level=4095)
        if self.form == "images":
            values = one[None].astype(np.float32)
            return IlluminationImages(values=values, valid=values > 0, names=("lamp",), full_scale=4095)
        return one.astype(np.float32)


@pytest.mark.parametrize("form", ["channel", "images", "floats"])
def test_frames_that_say_what_they_are_give_the_same(form, tmp_path):
    known = measure(settings(), tmp_path / "stack", source=FRAMES)
    result = measure(settings(), tmp_path / "out", source=Library(form))
    np.testing.assert_allclose(result.u, known.u, atol=1e-6)
    assert list(result.names) == ["first", "second", "third"]
    assert result.time_ns.tolist() == [0, 1000, 2500]


def test_first_last_step_and_reference_choose_from_a_source(tmp_path):
    chosen = settings(frames={"reference": [0, 1], "first": 0, "last": 2, "step": 2})
    result = measure(chosen, tmp_path / "out", source=FRAMES)
    assert list(result.names) == ["frame 0", "frame 2"]
    with pytest.raises(FrameError, match=r"frames.last names frame 5, but there are 3"):
        measure(settings(frames={"last": 5}), tmp_path / "no", source=FRAMES)


def plain(frames):
    """Every second light from its colour alone."""
    (mosaic,) = frames
    values = np.repeat(mosaic.values[None].astype(np.float32), 2, axis=0)
    return IlluminationImages(values=values, valid=values < mosaic.white_level, names=("a", "b"), full_scale=4095)


def test_a_separation_of_ones_own_needs_no_calibration(tmp_path):
    bayer = settings(frames={"kind": "bayer", "cfa": "RGGB"})
    result = measure(bayer, tmp_path / "out", source=FRAMES, separation=plain)
    assert result.lights == ("a", "b")
    assert error(result) < 0.05
    with pytest.raises(ConfigurationError, match=r"calibration\.file is missing: colour frames need"):
        measure(bayer, tmp_path / "no", source=FRAMES)


def test_a_separation_that_gives_something_else_is_named(tmp_path):
    bayer = settings(frames={"kind": "bayer", "cfa": "RGGB"})
    with pytest.raises(InputError, match=r"must give IlluminationImages.*ndarray"):
        measure(bayer, tmp_path / "no", source=FRAMES, separation=lambda frames: frames[0].values)
    with pytest.raises(ConfigurationError, match="need no separation"):
        measure(settings(), tmp_path / "no", source=Library("images"), separation=plain)
    assert not (tmp_path / "no").exists()


@dataclass(frozen=True)
class LeftHalf:
    """Only the left half counts."""

    width: int = SIDE // 2
    scale: float = 1.0

    def reference(self, images):
        weights = images.valid.astype(np.float32)
        weights[:, :, self.width :] = 0
        return self.scale * weights

    def deformed(self, images, index):
        return self.reference(images)


def test_weights_of_ones_own_decide_where_there_is_data(tmp_path):
    result = measure(settings(), tmp_path / "out", source=FRAMES, weights=LeftHalf())
    right, left = result.nodes[:, 0] > SIDE // 2 + 20, result.nodes[:, 0] < SIDE // 2 - 5
    assert right.any()
    assert np.isnan(result.u[1, right]).all()
    assert np.isfinite(result.u[1, left]).all()


def test_weights_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(InputError, match="not negative"):
        measure(settings(), tmp_path / "no", source=FRAMES, weights=LeftHalf(scale=-1))
    threshold = settings(weights={"method": "threshold"})
    with pytest.raises(ConfigurationError, match=r'weights.method = "threshold", and weights are given'):
        measure(threshold, tmp_path / "no", source=FRAMES, weights=LeftHalf())


def test_a_mesh_of_ones_own_is_measured_at_its_nodes(tmp_path):
    mesh = Tri3Mesh.from_region(Region.from_rectangle((20, 20, 70, 70), (SIDE, SIDE)), 12)
    result = measure(settings(), tmp_path / "out", source=FRAMES, mesh=mesh)
    np.testing.assert_array_equal(result.nodes, mesh.nodes)
    assert error(result) < 0.05


def test_a_source_and_a_path_contradict_each_other(tmp_path):
    with pytest.raises(ConfigurationError, match=r"frames.path names x.tif, and a frame source is given"):
        Plan.from_settings(settings("x.tif"), source=FRAMES)
    with pytest.raises(ConfigurationError, match=r"frames.path must name the frame files"):
        Plan.from_settings(settings())
    with pytest.raises(InputError, match=r"__len__ and __getitem__.*measure_sequence"):
        Plan.from_settings(settings(), source=iter(FRAMES))


def test_another_object_does_not_go_on_with_a_result(tmp_path):
    measure(settings(), tmp_path / "out", source=FRAMES, weights=LeftHalf())
    measure(settings(), tmp_path / "out", source=FRAMES, weights=LeftHalf(), resume=True)
    with pytest.raises(ResultError, match="the input weights was"):
        measure(settings(), tmp_path / "out", source=FRAMES, weights=LeftHalf(width=60), resume=True)
    with pytest.raises(ResultError, match="the input source was"):
        measure(settings(), tmp_path / "out", source=FRAMES + 1, weights=LeftHalf(), resume=True)


class Failing(Library):
    def __getitem__(self, index):
        if index == 1:
            raise RuntimeError("the camera does not answer")
        return super().__getitem__(index)


def test_a_frame_that_a_source_cannot_give_fails_alone(tmp_path):
    result = measure(settings(), tmp_path / "out", source=Failing("floats"))
    assert result.status.tolist() == [0, 2, 0]
    assert "second cannot be read" in result.frame(1).reason


class Open(Library):
    """Holds what cannot be sent to another process, as an open file cannot."""

    def __init__(self):
        super().__init__("floats")
        self.handle = (number for number in range(3))


def test_a_source_with_an_open_file_is_measured_by_several_threads(tmp_path):
    alone = measure(settings(), tmp_path / "one", source=Open(), workers=1)
    both = measure(settings(), tmp_path / "two", source=Open(), workers=2)
    np.testing.assert_array_equal(both.u, alone.u)


def test_several_threads_measure_a_source_alike(tmp_path):
    alone = measure(settings(), tmp_path / "one", source=FRAMES)
    both = measure(settings(), tmp_path / "two", source=FRAMES, workers=2)
    np.testing.assert_array_equal(both.u, alone.u)


def test_arrays_that_are_no_frames_are_named(tmp_path):
    with pytest.raises(FrameError, match="allowed are whole numbers"):
        measure(settings(), tmp_path / "out", source=FRAMES > 0)
    with pytest.raises(FrameError, match="outside 0 to 65535"):
        measure(settings(), tmp_path / "out", source=-FRAMES.astype(np.int32))


def test_mosaics_of_a_source_pass_as_they_are(tmp_path):
    mosaics = [Mosaic(values=one, cfa="RGGB", black_level=0, white_level=4095) for one in FRAMES]
    result = measure(settings(frames={"kind": "bayer"}), tmp_path / "out", source=mosaics, separation=plain)
    assert error(result) < 0.05
