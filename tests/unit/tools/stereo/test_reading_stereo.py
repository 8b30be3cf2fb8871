"""What one camera's result is read with reads a surface in space: true, and as uncertain as stated."""

from __future__ import annotations

import numpy as np
import pytest
from stereo_scene import MOTIONS, Motion

from rgbmidic import Result, read_histories
from rgbmidic.errors import InputError
from rgbmidic.results import Maps, read_profile
from rgbmidic.settings import ProbeSettings, ScaleSettings
from rgbmidic.tools.finite_elements.comparison import Comparison
from rgbmidic.tools.stereo import measure_stereo, open_left

ENDS = (40.0, 60.0, 120.0, 60.0)


def in_space(pair, points):
    """Points (T, P, 3) of the true surface that the left camera sees at pixels."""
    material = Motion().material(pair, 0, np.asarray(points, dtype=float))
    return np.stack([motion.points(material) for motion in MOTIONS])


@pytest.fixture(scope="module")
def surface(measured):
    return Result.open(measured[1].path.parent)


def test_histories_are_those_in_space(surface, pair):
    probes = {"gauges": (ENDS,), "regions": ((50, 40, 110, 80),), "strain_gauges": ((80, 60, 80),)}
    histories = read_histories(surface, ProbeSettings(**probes, lines=(ENDS,), rigid_motion="tell"))
    ends = in_space(pair, np.reshape(ENDS, (2, 2)))
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    x, y = np.meshgrid(np.arange(50.5, 110), np.arange(40.5, 80))
    areas, line = (
        in_space(pair, np.stack([x.ravel(), y.ravel()], axis=1)),
        in_space(pair, np.linspace((40, 60), (120, 60))),
    )
    stretch = np.array(MOTIONS[2].stretch)
    small, large = np.linalg.eigvalsh(stretch.T @ stretch - np.eye(2)) / 2
    true = {
        "gauge_1_extension": lengths - lengths[0],
        "gauge_1_length": lengths,
        "gauge_1_strain": lengths / lengths[0] - 1,
        **{f"region_1_{name}": areas.mean(axis=1)[:, k] - areas[0].mean(axis=0)[k] for k, name in enumerate("uvw")},
        **{f"line_1_{name}": line.mean(axis=1)[:, k] - line[0].mean(axis=0)[k] for k, name in enumerate("uvw")},
        **{f"{probe}_1_{name}": np.array([0, 0, e]) for probe in ("region", "strain_gauge")
           for name, e in {"e1": large, "e2": small}.items()},
    }  # fmt: skip
    ratios = np.array(
        [(histories[name].values - values)[1:] / histories[name].std[1:] for name, values in true.items()]
    )
    assert 0.5 < np.sqrt(np.mean(ratios**2)) < 1.5
    assert np.abs(ratios).max() < 4
    assert histories["gauge_1_length"].std[0] > 100 * histories["gauge_1_extension"].std[0]  # that of the shape
    rotation = np.stack([histories[f"rigid_rotation_{name}"].values for name in "xyz"], axis=1)
    assert np.linalg.norm(rotation[1] - (0.5, 1.0, -0.4)) < 0.02  # degrees
    assert (histories["rigid_rotation_z"].std[1:] < 0.01).all()


def test_what_the_calibration_leaves_is_in_every_reading_as_in_the_file(calibrated):
    surface, node = open_left(calibrated.path), 30
    maps, place = Maps.from_result(surface), tuple(surface.nodes[node])
    gauge = calibrated.attributes["gauge_px"]
    probes = ProbeSettings(points=(place,), gauges=(ENDS,), strain_gauges=((*place, gauge),), rigid_motion="tell")
    histories = read_histories(surface, probes)
    as_stated = {"rel": 2e-3}  # single precision
    for name in "uvw":
        stated = calibrated[f"{name}_std"][2, node]
        assert histories[f"point_1_{name}"].std[2] == pytest.approx(stated, **as_stated)
        assert maps.read(name, 2).std[node] == pytest.approx(stated, **as_stated)
    for name in ("exx", "eyy", "exy", "e1", "e2"):
        stated = calibrated[f"{name}_std"][2]
        assert maps.read(name, 2).std == pytest.approx(stated, nan_ok=True, **as_stated)
    motion = np.array([calibrated[name][2, node] for name in "uvw"])
    along = motion / np.linalg.norm(motion)
    stated = np.sqrt(along @ calibrated["displacement_covariance"][2, node] @ along)
    assert maps.read("magnitude", 2).std[node] == pytest.approx(stated, **as_stated)
    relative = calibrated.attributes["relative_length_std"]
    length, extension = histories["gauge_1_length"], histories["gauge_1_extension"]
    assert length.std == pytest.approx(relative * length.values, rel=0.1)
    assert extension.std[2] < 0.3 * relative * length.values[2]  # both ends have it in common
    # the false strain and rotation of a rigid motion by cameras that are not known exactly
    assert np.linalg.norm(histories["strain_gauge_1_e1"].common[:, 1]) > 1e-5
    assert (np.linalg.norm(histories["rigid_rotation_z"].common[:, 1:], axis=0) > 0).all()
    # since another frame only what has changed since is uncertain
    since = [Maps.from_result(surface, since=frame).read("exx", 2).std[node] for frame in (1, 2)]
    assert since[1] == pytest.approx(0, abs=1e-9)
    assert since[0] > 0


def test_maps_since_a_frame_and_without_the_rigid_motion(surface):
    absolute, since = Maps.from_result(surface), Maps.from_result(surface, since=1)
    w = [absolute.read("w", frame).values for frame in (1, 2)]
    assert since.read("w", 2).values == pytest.approx(w[1] - w[0], abs=1e-12)
    strains = [maps.read("e1", 2) for maps in (absolute, since)]
    inner = np.isfinite(strains[0].values)
    # frame 1 only turned: what it strained is noise
    assert np.abs((strains[1].values - strains[0].values) / strains[1].std)[inner].max() < 5
    rest = Maps.from_result(surface, rigid_removed=True)
    left = np.stack([rest.read(name, 1).values for name in "uvw"], axis=1)
    assert np.sqrt(np.mean(left**2)) < 0.006  # mm: noise
    tilt = absolute.read("tilt", 1).values
    normals = [Motion(degrees=degrees).attitude[:, 2] for degrees in ((0, 0, 0), MOTIONS[1].degrees)]
    assert np.median(tilt) == pytest.approx(np.degrees(np.arccos(normals[0] @ normals[1])), abs=0.02)
    assert surface.to_xarray().w.attrs["units"] == "mm"


def test_a_profile_runs_along_the_surface(surface, pair):
    profile = read_profile(Maps.from_result(surface), "w", ENDS)
    places = in_space(pair, profile.line.points)
    assert profile.positions[-1] == pytest.approx(np.linalg.norm(places[0, -1] - places[0, 0]), rel=2e-3)
    assert profile.places == pytest.approx(places[0], abs=0.03)
    ratio = ((profile.values - (places - places[0])[..., 2]) / profile.std)[1:]
    assert 0.4 < np.sqrt(np.mean(ratio**2)) < 1.8


def test_what_a_surface_has_not_is_said_in_one_line(surface, measured, pair, tmp_path):
    with pytest.raises(InputError, match="crack_1: cracks are measured in a plane"):
        read_histories(surface, ProbeSettings(cracks=(ENDS,)))
    with pytest.raises(InputError, match="for px read the result of a camera"):
        Maps.from_result(surface, ScaleSettings(unit="px"))
    with pytest.raises(InputError, match="are those in space: mm_per_pixel and camera of"):
        Maps.from_result(surface, ScaleSettings(mm_per_pixel=0.2))
    with pytest.raises(InputError, match="has the displacements u, v, w"):
        Comparison(surface, None, None)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="is a result of two cameras; the result of one is"):
        measure_stereo(surface.path, measured[0] / "right/TEST.toml", pair, tmp_path / "again")
    with pytest.raises(InputError, match="there is no field"):
        Maps.from_result(surface).read("u_bias_std", 1)
