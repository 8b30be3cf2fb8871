"""Settings of a test: what is read, what is refused and with which words."""

from __future__ import annotations

import json
import sys
import tomllib
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

import rgbmidic
import rgbmidic.settings
from rgbmidic.disk import require_regular_file
from rgbmidic.errors import ConfigurationError
from rgbmidic.settings import (
    BAYER_PATTERNS,
    CalibrationSettings,
    ChannelSettings,
    FrameSettings,
    IlluminationSettings,
    MeshSettings,
    ProbeSettings,
    RegionSettings,
    ScaleSettings,
    SetupSettings,
    SolverSettings,
    TestSettings,
    WeightSettings,
    read_test,
    unique_keys,
)

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.append(str(DOCS / "_ext"))
from schema import json_schema  # noqa: E402 (it is no package)

LEAST = """
[frames]
path = "frames/*.dng"
[region]
rectangle = [10, 20, 110, 220]
"""

FULL = """
[frames]
path = "frames/*.tif"
kind = "bayer"
cfa = "GRBG"
black_level = 64
white_level = 4095
reference = [0, 1, 2]
[calibration]
file = "calibration.json"
[region]
polygon = [[0, 0], [100, 0], [50, 80.5]]
[mesh]
element_size = 20
[weights]
threshold = 0.5
blur = 3
[solver]
prefilter = "gaussian"
rigid = "translation"
tolerance = 1e-4
max_iterations = 30
[scale]
mm_per_pixel = 0.055
frame_rate = 12000
"""


PLACED = LEAST + '[mesh]\nfile = "a.inp"\npoints = [[0, 0, 1, 1], [1, 0, 2, 1]]\n'


def _read(tmp_path: Path, text: str) -> TestSettings:
    path = tmp_path / "test.toml"
    path.write_text(text, encoding="utf-8")
    return read_test(path)


def test_least_test_takes_the_defaults(tmp_path: Path) -> None:
    settings = _read(tmp_path, LEAST)
    expected = TestSettings(
        frames=FrameSettings(path=("frames/*.dng",)),
        region=RegionSettings(rectangle=(10.0, 20.0, 110.0, 220.0)),
        base=tmp_path.resolve(),
    )
    assert settings == expected


def test_every_key(tmp_path: Path) -> None:
    settings = _read(tmp_path, FULL)
    assert settings.frames == FrameSettings(
        path=("frames/*.tif",), kind="bayer", cfa="GRBG", black_level=64.0, white_level=4095.0, reference=(0, 1, 2)
    )
    assert settings.calibration.file == tmp_path.resolve() / "calibration.json"
    assert settings.region.polygon == ((0.0, 0.0), (100.0, 0.0), (50.0, 80.5))
    assert settings.mesh.element_size == 20.0
    assert (settings.weights.threshold, settings.weights.blur) == (0.5, 3.0)
    assert settings.solver.tolerance == 1e-4
    assert settings.scale == ScaleSettings(mm_per_pixel=0.055, frame_rate=12000.0)


def test_numbers_become_what_the_field_states(tmp_path: Path) -> None:
    settings = _read(tmp_path, FULL)
    for section in (settings.frames, settings.weights, settings.solver, settings.scale):
        for entry in fields(section):
            value = getattr(section, entry.name)
            if "float" in str(entry.type) and value is not None and not isinstance(value, str):
                assert type(value) is float, entry.name


def test_several_lights_one_after_the_other(tmp_path: Path) -> None:
    text = LEAST.replace('"frames/*.dng"', '["left/*.tif", "right/*.tif"]\nkind = "monochrome"\nreference = 1')
    frames = _read(tmp_path, text).frames
    assert (frames.path, frames.reference) == (("left/*.tif", "right/*.tif"), (1,))


def test_the_threshold_is_a_number_or_automatic(tmp_path: Path) -> None:
    assert _read(tmp_path, LEAST + '[weights]\nthreshold = "auto"').weights.threshold == "auto"
    assert _read(tmp_path, LEAST + "[weights]\nthreshold = 1").weights.threshold == 1.0


def test_geometry_is_relative_to_the_file_and_survives_the_mapping(tmp_path: Path) -> None:
    text = LEAST + '[weights]\nmethod = "geometry"\ngeometry = "scene.toml"\nheight_map = "h.npy"\nlimit_deg = 15'
    settings = _read(tmp_path, text)
    assert settings.weights.geometry == tmp_path.resolve() / "scene.toml"
    assert settings.weights.height_map == tmp_path.resolve() / "h.npy"
    assert TestSettings.from_mapping(settings.to_mapping(), settings.base) == settings


@pytest.mark.parametrize("stated", ["[[0, 5], [9, 5.5]]", "[[[0, 5], [9, 5.5]]]"])
def test_a_single_crack_needs_no_outer_brackets_and_survives_the_mapping(tmp_path: Path, stated: str) -> None:
    settings = _read(tmp_path, f"{LEAST}[mesh]\ncracks = {stated}")
    assert settings.mesh.cracks == (((0.0, 5.0), (9.0, 5.5)),)
    assert TestSettings.from_mapping(settings.to_mapping(), settings.base) == settings


def test_mask_is_relative_to_the_file(tmp_path: Path) -> None:
    settings = _read(tmp_path, LEAST.replace("rectangle = [10, 20, 110, 220]", 'mask = "masks/region.png"'))
    assert settings.region.mask == tmp_path.resolve() / "masks" / "region.png"


def test_absolute_path_stays(tmp_path: Path) -> None:
    settings = _read(tmp_path, LEAST + '[calibration]\nfile = "/data/c.json"')
    assert settings.calibration.file == Path("/data/c.json")


def test_file_with_a_byte_order_mark(tmp_path: Path) -> None:
    assert _read(tmp_path, "\ufeff" + LEAST.strip()).frames.path == ("frames/*.dng",)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (LEAST + "[solver]\ntolerence = 1", r'unknown key "tolerence" in \[solver\] \(did you mean "tolerance"\?\)'),
        (LEAST + "[solver]\nfoo = 1", r'unknown key "foo" in \[solver\]; allowed are prefilter, rigid'),
        (LEAST + "[mesh]\nsize = 1", r'unknown key "size" in \[mesh\].*allowed are element_size'),
        (LEAST + "[weigths]\nblur = 1", r'unknown section "weigths".*did you mean "weights"'),
        ("top = 1\n" + LEAST, r'unknown section "top"'),
        ("frames = 1", r"\[frames\] must be a section"),
        ("[frames]\npath = 'a'", r"\[region\] is missing"),
        ("[region]\nrectangle = [0, 0, 1, 1]", r"\[frames\] is missing"),
        (LEAST.replace('path = "frames/*.dng"', ""), r"frames\.path is missing"),
        (LEAST.replace('"frames/*.dng"', "3"), r"frames\.path must be a text in quotes, not 3"),
        (LEAST.replace('"frames/*.dng"', '""'), r"frames\.path must name"),
        (LEAST.replace('"frames/*.dng"', '["a", ""]'), r"frames\.path must name"),
        (LEAST.replace('"frames/*.dng"', '["a", "b"]'), r"2 entries.*monochrome"),
        (
            LEAST.replace('dng"', 'dng"\nkind = "color"'),
            r'kind must be one of "bayer", "rgb", "monochrome", not "color"',
        ),
        (LEAST.replace('dng"', 'dng"\ncfa = "RGBG"'), r'frames\.cfa must be one of RGGB.*not "RGBG"'),
        (LEAST.replace('dng"', 'dng"\nblack_level = -1'), r"frames\.black_level must be at least 0, not -1"),
        (LEAST.replace('dng"', 'dng"\nblack_level = 9\nwhite_level = 9'), r"white_level must be above black_level 9"),
        (LEAST.replace('dng"', 'dng"\nreference = [-1]'), r"frames\.reference must be at least 0"),
        (LEAST.replace('dng"', 'dng"\nreference = [0, 0]'), r"reference must name different frames"),
        (LEAST.replace('dng"', 'dng"\nreference = []'), r"reference must name"),
        (LEAST.replace('dng"', 'dng"\nshape = [10]'), r"frames\.shape must be 2 values"),
        (LEAST.replace('dng"', 'dng"\nshape = [10, 0]'), r"frames\.shape must be at least 1"),
        (LEAST.replace('dng"', 'dng"\ndtype = "float32"'), r'dtype must be one of "uint8", "uint16", ">u2"'),
        (LEAST + '[weights]\nthreshold = "otto"', r'weights\.threshold must be a number or "auto", not "otto"'),
        (LEAST + "[weights]\nthreshold = 1.5", r"weights\.threshold must be at most 1"),
        (LEAST + '[weights]\nmethod = "geometry"', r'weights\.geometry = "SCENE\.toml" go together'),
        (LEAST + '[weights]\ngeometry = "s.toml"', r"weights\.method.* go together"),
        (LEAST + "[weights]\nlimit_deg = 15", r"weights\.limit_deg is for weights\.method"),
        (
            LEAST + '[weights]\nmethod = "geometry"\ngeometry = "s.toml"\nlimit_deg = 180',
            r"weights\.limit_deg must be below 180",
        ),
        (LEAST + "[mesh]\npoints = [[0, 0, 1, 1], [1, 0, 2, 1]]", r"mesh\.points is for mesh\.file"),
        (LEAST + '[mesh]\nfile = "a.inp"', r"mesh\.file needs mesh\.points, two or more"),
        (LEAST + '[mesh]\nfile = "a.inp"\npoints = [[0, 0, 1, 1]]', r"two or more .*, not 1"),
        (PLACED + "element_size = 20", r"mesh\.element_size is for a mesh made here"),
        (PLACED + "cracks = [[0, 5], [9, 5]]", r"mesh\.cracks is for a mesh made here"),
        (PLACED + "[scale]\nmm_per_pixel = 0.1", r"scale\.mm_per_pixel \(0\.1\) states a scale, mesh\.points"),
        (PLACED + 'unit = "ft"', r'mesh\.unit must be one of "mm"'),
        (LEAST + 'mask = "m.png"', r"exactly one of rectangle, polygon, mask; given are 2"),
        (LEAST.replace("rectangle = [10, 20, 110, 220]", ""), r"exactly one of .*; given are 0"),
        (LEAST.replace("10, 20, 110", "110, 20, 10"), r"rectangle is \[x0, y0, x1, y1\] with x0 < x1"),
        (LEAST.replace("rectangle = [10, 20, 110, 220]", "polygon = [[0, 0], [1, 1]]"), r"at least three corners"),
        (LEAST.replace("10, 20, 110", "10, nan, 110"), r"region\.rectangle must be finite"),
        (LEAST + "[mesh]\nelement_size = 0", r"mesh\.element_size must be above 0, not 0"),
        (LEAST + "[mesh]\ncracks = [[[0, 5]]]", r"mesh\.cracks\[0\] needs at least two corners \[x, y\]"),
        (LEAST + "[probes]\ntips = [[1, 2, 60, 30]]", r"probes\.tips .* radii 0 < r0 < r1 in px, not 60 and 30"),
        (
            LEAST + "[probes]\ntips = [[1, 2, 30, 60]]\nplane = 'stress'",
            r"probes\.tips need probes\.youngs_modulus .*; missing: youngs_modulus, poissons_ratio",
        ),
        (LEAST + "[probes]\nterms = 1", r"probes\.terms must be 0 .* or at least 2, not 1"),
        (LEAST + "[probes]\npoissons_ratio = 0.6", r"probes\.poissons_ratio must be .* 0\.5, not 0\.6"),
        (LEAST + "[mesh]\ncracks = [[[0, 5], [nan, 5]]]", r"mesh\.cracks must be finite, not nan"),
        (LEAST + "[mesh]\nelement_size = true", r"mesh\.element_size must be a number, not True"),
        (LEAST + "[mesh]\nelement_size = '25'", r'mesh\.element_size must be a number or "auto", not "25"'),
        (LEAST + "[weights]\nthreshold = 1.5", r"weights\.threshold must be at most 1, not 1.5"),
        (LEAST + "[weights]\nmethod = 'magic'", r'weights\.method must be one of .*not "magic"'),
        (LEAST + "[solver]\nmax_iterations = 5.5", r"solver\.max_iterations must be a whole number, not 5.5"),
        (LEAST + "[solver]\ncurvature = true", r'unknown key "curvature" in \[solver\]'),
        (LEAST + "[solver]\ntolerance = inf", r"solver\.tolerance must be finite"),
        (LEAST + "[scale]\nmm_per_pixel = 0", r"scale\.mm_per_pixel must be above 0"),
        (LEAST + "[scale]\nmm_per_pixel = 1e308", r"scale\.mm_per_pixel must be at most 1e\+06, not 1e\+308"),
        (LEAST + "[scale]\nframe_rate = 1e300", r"scale\.frame_rate must be at most 1e\+15"),
        (LEAST + '[scale]\nmm_per_pixel = 1\ncamera = "c.json"', r"scale\.camera \(.*c\.json\).*scale\.mm_per_pixel"),
        (LEAST + "[calibration]\nfile = 1", r"calibration\.file must be a file name in quotes, not 1"),
        ("[frames\n", r"not a readable settings file \(TOML\)"),
    ],
)
def test_what_is_wrong_is_told_with_file_and_key(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words) as caught:
        _read(tmp_path, text)
    assert str(tmp_path / "test.toml") in str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"not found: .*none\.toml"):
        read_test(tmp_path / "none.toml")
    with pytest.raises(ConfigurationError, match="not a readable"):
        read_test(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'[frames]\npath = "\xe9"')
    with pytest.raises(ConfigurationError, match="not a readable"):
        read_test(tmp_path / "latin.toml")


_numbers = st.floats(0.5, 1e4)
_settings = st.builds(
    TestSettings,
    frames=st.builds(
        FrameSettings,
        path=st.lists(st.text(min_size=1), min_size=1, max_size=3).map(tuple),
        kind=st.just("monochrome"),
        cfa=st.none() | st.sampled_from(BAYER_PATTERNS),
        black_level=st.none() | st.floats(0, 100),
        white_level=st.none() | st.floats(101, 65535),
        reference=st.lists(st.integers(0, 99), min_size=1, max_size=4, unique=True).map(tuple),
        shape=st.none() | st.tuples(st.integers(1, 99), st.integers(1, 99)),
        dtype=st.none() | st.sampled_from(["uint8", "uint16", ">u2"]),
    ),
    region=st.one_of(
        st.builds(RegionSettings, rectangle=st.tuples(*[st.floats(0, 0.4)] * 2, *[_numbers] * 2)),
        st.builds(RegionSettings, polygon=st.lists(st.tuples(_numbers, _numbers), min_size=3, max_size=6).map(tuple)),
        st.builds(RegionSettings, mask=st.just(Path("/data/mask.png"))),
    ),
    calibration=st.builds(CalibrationSettings, file=st.none() | st.just(Path("/data/calibration.json"))),
    mesh=st.builds(MeshSettings, element_size=_numbers),
    illumination=st.builds(IlluminationSettings),
    weights=st.builds(WeightSettings, threshold=st.floats(0.01, 1), blur=_numbers),
    solver=st.builds(
        SolverSettings, prefilter=st.sampled_from(["none", "binomial"]), max_iterations=st.integers(1, 100)
    ),
    scale=st.builds(ScaleSettings, mm_per_pixel=st.none() | _numbers, frame_rate=st.none() | _numbers),
    base=st.just(Path("/data")),
)


@examples(max_examples=40)
@given(settings=_settings)
def test_settings_come_back_from_their_plain_form(settings: TestSettings) -> None:
    document: dict[str, dict[str, Any]] = settings.to_mapping()
    assert TestSettings.from_mapping(document, settings.base) == settings


PLACE, SQUARE = (20.0, 15.0, 90.5, 60.0), ((0.0, 0.0), (9.0, 0.0), (9.0, 9.5))
BUILT: dict[str, Any] = {
    "frames": FrameSettings(
        path=("frames/*.tif",),
        kind="monochrome",
        cfa="GRBG",
        black_level=64,
        white_level=4095,
        reference=(0, 2),
        first=1,
        last=9,
        step=2,
        lights=2,
        update_reference=True,
        shape=(40, 60),
        dtype="uint16",
        crop_origin=(3, 0),
    ),
    "calibration": CalibrationSettings(file=Path("calibration.json"), accept=("noise", "greens")),
    "mesh": MeshSettings(element_size=20, cracks=(SQUARE,)),
    "mesh of finite elements": MeshSettings(
        file=Path("specimen.inp"),
        points=((0.0, 0.0, 10.0, 90.0), (5.0, 0.0, 60.0, 90.0)),
        unit="m",
        part="PLATE",
    ),
    "illumination": IlluminationSettings(demosaic="malvar"),
    "region": RegionSettings(rectangle=PLACE, holes=(SQUARE, SQUARE)),
    "region of corners": RegionSettings(polygon=SQUARE),
    "region of a mask": RegionSettings(mask=Path("mask.png")),
    "weights": WeightSettings(
        method="geometry",
        threshold=0.5,
        blur=3.5,
        geometry=Path("scene.toml"),
        height_map=Path("height.npy"),
        limit_deg=15,
    ),
    "weights by masks": WeightSettings(method="images", images=(Path("red.png"), Path("green.png"))),
    "solver": SolverSettings(
        prefilter="gaussian", rigid="translation", brightness=8.5, fill=50, tolerance=0.5, max_iterations=7
    ),
    "scale": ScaleSettings(mm_per_pixel=0.5, mm_per_pixel_std=0.25, frame_rate=1000),
    "scale by a camera": ScaleSettings(camera=Path("camera.json")),
    "probes": ProbeSettings(
        points=((1.0, 2.0),),
        lines=(PLACE,),
        circles=((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
        regions=(PLACE,),
        gauges=(PLACE, PLACE),
        straight_gauges=(PLACE,),
        strain_gauges=((1.0, 2.0, 30.0),),
        cracks=(PLACE,),
        tips=((1.0, 2.0, 30.0, 60.0),),
        youngs_modulus=70_000,
        poissons_ratio=0.3,
        plane="strain",
        terms=5,
        fit_tip=True,
        measure="biot",
        window=7,
        rigid_motion="remove",
        names=(("gauge_1", "left grip"),),
    ),
    "channels": ChannelSettings(file=Path("daq.csv"), offset=0.5, area=20, force="load_N"),
    "channels of a trigger": ChannelSettings(file=Path("daq.csv"), trigger="ttl"),
    "channels of a history": ChannelSettings(file=Path("daq.csv"), align=("load_N", "gauge_1_strain")),
    "setup": SetupSettings(**{entry.name: f"some {entry.name}" for entry in fields(SetupSettings)}),
}
BUILT["test"] = TestSettings(
    **{name: built for name, built in BUILT.items() if " " not in name},
    base=Path("/data"),
)
BUILT["test on finite elements"] = TestSettings(frames=BUILT["frames"], mesh=BUILT["mesh of finite elements"])
"""Settings of every kind with a value in every field."""
STATED = [
    pytest.param(built, entry.name, id=f"{name}.{entry.name}")
    for name, built in BUILT.items()
    for entry in fields(built)
    if getattr(built, entry.name) not in (None, ())
]


def test_every_field_of_every_kind_of_settings_is_tried() -> None:
    kinds = [kind for kind in vars(rgbmidic.settings).values() if isinstance(kind, type) and is_dataclass(kind)]
    tried = {(type(param.values[0]), param.values[1]) for param in STATED}
    assert tried == {(kind, entry.name) for kind in kinds for entry in fields(kind)}


def _as_numpy(value: Any) -> Any:
    """The same in the types that a script has it in: of numpy, texts for paths and paths for texts with a slash."""
    if isinstance(value, str):
        return Path(value) if "/" in value else np.str_(value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, tuple):
        numbers = all(isinstance(entry, float | int) for entry in value)
        return np.array(value) if numbers else [_as_numpy(entry) for entry in value]
    return value if is_dataclass(value) else np.asarray(value)[()]


def _types(value: Any) -> Any:
    return tuple(map(_types, value)) if isinstance(value, tuple) else type(value)


@pytest.mark.parametrize(("built", "name"), STATED)
def test_settings_built_in_python_take_what_is_losslessly_of_the_type(built: Any, name: str) -> None:
    value = getattr(built, name)
    found = getattr(replace(built, **{name: _as_numpy(value)}), name)
    assert found == value
    assert _types(found) == _types(value)
    if isinstance(value, tuple) and len(value) == 1:
        assert getattr(replace(built, **{name: value[0]}), name) == value  # a single one needs no brackets


@pytest.mark.parametrize(("built", "name"), STATED)
def test_settings_built_in_python_are_checked_as_those_read(built: Any, name: str) -> None:
    value = getattr(built, name)
    inner = np.asarray(value, dtype=object).ravel()[0] if isinstance(value, tuple) else value
    wrong: list[Any] = [3j, {}, object(), [[[[1]]]]]
    wrong += ["true", *([1] if name != "refine" else [1.0])] if isinstance(inner, bool) else [True]  # or a frame
    wrong += ["1e-3", float("nan")] if isinstance(inner, int | float) else [3]
    wrong += [1.5] if type(inner) is int else []
    section = next(section.split()[0] for section, settings in BUILT.items() if settings is built)
    prefix = "" if section == "test" else rf"{section}\."
    for instead in wrong:
        with pytest.raises(ConfigurationError, match=rf"^{prefix}{name} must be") as caught:
            replace(built, **{name: instead})
        assert "\n" not in str(caught.value)


def test_a_number_is_no_word() -> None:
    """1 == True, but states a frame; 1.0 states none."""
    assert [MeshSettings(refine=one).refine is one for one in (1, True, False)] == [True] * 3
    with pytest.raises(ConfigurationError, match=r"^mesh\.refine must be a whole number, not 1\.0"):
        MeshSettings(refine=1.0)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("normalise", "brightness", "now"),
    [
        (None, "global", "constant"),
        (None, "local", "auto"),
        ("auto", None, "auto"),
        (20, None, 20.0),
        (20, "mean", 20.0),
        (0, "auto", "none"),
        (0, "mean", "auto"),
        (0, "global", "constant"),
        (20, "none", 20.0),
    ],
)
def test_former_keys_of_the_grey_levels_are_read(
    normalise: Any, brightness: Any, now: Any, caplog: pytest.LogCaptureFixture
) -> None:
    document: dict[str, Any] = {"frames": {"path": "*.tif"}, "region": {"rectangle": [0, 0, 9, 9]}}
    document |= {"illumination": {"normalise": normalise}} if normalise is not None else {}
    document |= {"solver": {"brightness": brightness}} if brightness is not None else {}
    assert TestSettings.from_mapping(document).solver.brightness == now
    (warning,) = caplog.messages
    assert f"{now!r}".strip("'").removesuffix(".0") in warning


@pytest.mark.parametrize(
    ("normalise", "brightness", "message"),
    [
        ("x", "auto", "illumination.normalise, now solver.brightness, must be a width"),
        (-1, "auto", "must be a width"),
        (5, 20, "contradict each other"),
        (5, "constant", "contradict each other"),
    ],
)
def test_former_keys_that_are_wrong_or_contradict_are_refused(normalise: Any, brightness: Any, message: str) -> None:
    document = {"frames": {"path": "*.tif"}, "region": {"rectangle": [0, 0, 9, 9]}}
    more = {"illumination": {"normalise": normalise}, "solver": {"brightness": brightness}}
    with pytest.raises(ConfigurationError, match=message):
        TestSettings.from_mapping({**document, **more})


def test_a_wrong_number_is_told_at_construction_by_its_field() -> None:
    with pytest.raises(ConfigurationError, match=r'solver\.tolerance must be a number, not "1e-3"'):
        SolverSettings(tolerance="1e-3")  # type: ignore[arg-type]


def test_a_mapping_may_hold_numbers_of_numpy_and_paths(tmp_path: Path) -> None:
    built = TestSettings.from_mapping(
        {
            "frames": {"path": tmp_path / "*.dng", "reference": np.arange(3), "first": np.int64(1)},
            "region": {"rectangle": np.array([1.0, 2.0, 30.0, 40.0])},
            "calibration": {"file": Path("calibration.json")},
            "solver": {"tolerance": np.float64(1e-4)},
        },
        tmp_path,
    )
    assert built.frames == FrameSettings(path=(str(tmp_path / "*.dng"),), reference=(0, 1, 2), first=1)
    assert built.region.rectangle == (1.0, 2.0, 30.0, 40.0)
    assert built.calibration.file == tmp_path / "calibration.json"
    assert built.solver.tolerance == 1e-4


def test_a_key_stated_twice_in_json_and_a_nul_in_a_name_are_errors() -> None:
    assert json.loads('{"a": 1, "b": {"a": 2}}', object_pairs_hook=unique_keys) == {"a": 1, "b": {"a": 2}}
    with pytest.raises(ValueError, match='the key "a" is stated twice'):
        json.loads('{"b": {"a": 1, "a": 2}}', object_pairs_hook=unique_keys)
    with pytest.raises(OSError, match="holds a NUL"):
        require_regular_file(Path("a\0b"))


def test_names_of_the_package_are_there() -> None:
    assert all(hasattr(rgbmidic, name) for name in rgbmidic.__all__)


SCHEMA = DOCS / "reference/test.schema.json"


def test_the_schema_of_the_page_is_that_of_the_code() -> None:
    """Write it anew with ``python docs/_ext/schema.py > docs/reference/test.schema.json``."""
    assert json.loads(SCHEMA.read_text(encoding="utf-8")) == json_schema()


@pytest.mark.parametrize("place", sorted(SCHEMA.parents[2].glob("**/*.toml")), ids=lambda place: place.name)
def test_the_schema_accepts_every_settings_file_of_the_project(place: Path) -> None:
    document = tomllib.loads(place.read_text(encoding="utf-8"))
    if {"frames", "region"} <= document.keys():
        jsonschema.validate(document, json_schema())


def test_the_schema_refuses_what_the_settings_refuse() -> None:
    good = {"frames": {"path": "*.tif"}, "region": {"rectangle": [0, 0, 50, 50]}}
    jsonschema.validate(good, json_schema())
    for section, key, value in (
        ("frames", "pth", "x"),
        ("solver", "tolerance", "small"),
        ("solver", "fill", -1),
        ("weights", "method", "magic"),
        ("region", "rectangle", [1, 2]),
        ("mesh", "element_size", [1]),
    ):
        wrong = {**good, section: {**good.get(section, {}), key: value}}
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, json_schema())
        with pytest.raises(ConfigurationError):
            TestSettings.from_mapping(wrong)
