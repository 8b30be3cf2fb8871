"""Meshes of files, written by meshio or by hand, read back with their labels; and where a mesh lies on the image."""

from __future__ import annotations

import logging
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbmidic import CameraCalibration, FiniteElementMesh, Placement, Tri3Mesh, read_mesh
from rgbmidic.errors import InputError, RegionError
from rgbmidic.mesh import Region
from rgbmidic.tools.finite_elements.placement import place_on_image

meshio = pytest.importorskip("meshio")

POINTS = np.array([[0, 0, 0], [10, 0, 0], [20, 0, 0], [0, 10, 0], [10, 10, 0], [20, 10, 0], [5, 20, 0]], dtype=float)
CELLS = [("quad", [[0, 1, 4, 3], [1, 2, 5, 4]]), ("triangle", [[3, 4, 6]])]
AREA = 250.0
"""Of these cells, square mm."""


def written(path: Path, cells: Any = CELLS, points: Any = POINTS, **how: Any) -> Path:
    meshio.write(path, meshio.Mesh(np.asarray(points), cells, **how.pop("mesh", {})), **how)
    return path


@pytest.mark.parametrize(
    ("name", "first", "how"),
    [
        ("a.inp", 1, {}),
        ("a.msh", 1, {"file_format": "gmsh22"}),
        ("text.msh", 1, {"file_format": "gmsh22", "binary": False}),
        ("a.vtu", 0, {}),
        ("a.vtk", 0, {}),
        ("a.bdf", 1, {}),
        ("a.xdmf", 0, {}),
        ("a.mesh", 1, {}),
        ("a.avs", 1, {}),
        ("a.vol", 1, {}),
    ],
)
def test_every_format_comes_back(tmp_path: Path, name: str, first: int, how: dict[str, Any]) -> None:
    mesh = read_mesh(written(tmp_path / name, **how))
    assert mesh.points == pytest.approx(POINTS[:, :2])
    assert mesh.areas.sum() == pytest.approx(AREA)
    assert (mesh.areas > 0).all()
    assert mesh.node_numbers.tolist() == list(range(first, first + 7))
    assert mesh.element_numbers.tolist() == [first, first, first + 1, first + 1, first + 2]


def test_nodal_data_come_along_in_the_order_of_the_nodes(tmp_path: Path) -> None:
    points = np.vstack([[[99, 99, 0]], POINTS])  # the first belongs to no element
    cells = [(kind, np.array(nodes) + 1) for kind, nodes in CELLS]
    mesh = read_mesh(written(tmp_path / "a.vtu", cells, points, mesh={"point_data": {"U": points * 1e-3}}))
    assert mesh.fields["U"] == pytest.approx(POINTS * 1e-3)
    assert mesh.node_numbers.tolist() == list(range(1, 8))


def test_the_unit_of_the_file_is_converted_and_kept(tmp_path: Path) -> None:
    mesh = read_mesh(written(tmp_path / "a.vtu", points=POINTS / 1000), unit="m")
    assert mesh.points == pytest.approx(POINTS[:, :2])
    assert mesh.unit_mm == 1000
    with pytest.raises(InputError, match="one of mm, m, um, inch"):
        read_mesh(tmp_path / "a.vtu", unit="ft")


def test_vtk_files_may_state_labels(tmp_path: Path) -> None:
    data = {"point_data": {"GlobalNodeId": np.arange(11, 18)}}
    data["cell_data"] = {"GlobalElementId": [np.array([5, 6]), np.array([9])]}
    mesh = read_mesh(written(tmp_path / "a.vtu", mesh=data))
    assert mesh.node_numbers.tolist() == list(range(11, 18))
    assert mesh.element_numbers.tolist() == [5, 5, 6, 6, 9]


INP = """*Heading
** of Abaqus/CAE, with labels that have gaps, in two blocks
*Part, name=Plate
*Node
10, 0., 0.
20, 10., 0.
*Node, nset=more
7, 10., 10., 0.
8, 0., 10., 0.
30, 5., 0., 0.
31, 10., 5., 0.
32, 5., 10., 0.
33, 0., 5., 0.
40, 20., 5., 0.
*Element, type=CPS8R, elset=LEFT
501, 10, 20, 7, 8, 30,
31, 32, 33
*Element, type=s3
77, 20, 40, 7
*Elset, elset=both, generate
77, 501, 424
*End Part
*Assembly, name=A
*Node
1, 99., 99., 99.
*End Assembly
"""


def test_abaqus_labels_blocks_and_continued_lines(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "a.inp"
    path.write_text(INP)
    mesh = read_mesh(path)
    assert sorted(mesh.node_numbers.tolist()) == [7, 8, 10, 20, 40]  # mid-side nodes are left out
    places = dict(zip(mesh.node_numbers.tolist(), mesh.points.tolist(), strict=True))
    assert (places[7], places[40]) == ([10, 10], [20, 5])
    assert sorted(mesh.element_numbers.tolist()) == [77, 501, 501]
    assert read_mesh(path, part="left").element_numbers.tolist() == [501, 501]
    assert len(read_mesh(path, part="BOTH").elements) == 3
    with pytest.raises(InputError, match='no set "right" of elements; it has LEFT, both'):
        read_mesh(path, part="right")
    assert not caplog.text
    moved = (
        "*Instance, name=Plate-1, part=Plate\n5., 0., 0.\n*End Instance\n*Elset, elset=right, instance=Plate-1\n77\n"
    )
    path.write_text(INP.replace("*End Assembly", moved + "*End Assembly"))
    assert read_mesh(path, part="right").element_numbers.tolist() == [77]
    assert "translation of an *INSTANCE is not applied" in caplog.text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("*Node\n1, 0., 0.\n*Ngen\n1, 5\n", r"\*NGEN is not read"),
        ("*Node\n1, 0., 0.\n*Element, type=CPS3\n1, 1, 2, 3\n", "element 1 has node 2"),
        ("*Node\n1, 0., 0.\n*Element, type=B21\n1, 1, 1\n", "no elements that are read"),
        ("*Node\n1, x, 0.\n", "is not a readable mesh"),
        (INP.split("*Assembly")[0].replace("Plate", "Other") + INP, "parts that number their nodes alike"),
        (
            "*Node\n1, 0., 0.\n2, 1., 0.\n3, 2., 0.\n4, 2., 1.\n*Element, type=CPS3\n1, 1, 2, 4\n5, 1, 2, 3\n",
            "element 5",
        ),
    ],
)
def test_an_abaqus_file_that_cannot_be_taken_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.inp"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_mesh(path)
    assert str(path) in str(caught.value)


GMSH4 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
1
2 5 "specimen"
$EndPhysicalNames
$Entities
0 0 2 0
1 0 0 0 1 1 0 1 5 0
2 1 0 0 2 1 0 0 0
$EndEntities
$Nodes
2 5 3 90
2 1 0 4
3
4
9
90
0 0 0
1 0 0
1 1 0
0 1 0
2 2 0 1
50
2 0 0
$EndNodes
$Elements
2 3 8 30
2 1 2 2
8 3 4 9
12 3 9 90
2 2 2 1
30 4 50 9
$EndElements
"""


def test_gmsh_text_of_version_4_keeps_tags_and_groups(tmp_path: Path) -> None:
    path = tmp_path / "a.msh"
    path.write_text(GMSH4)
    mesh = read_mesh(path)
    assert mesh.node_numbers.tolist() == [3, 4, 9, 90, 50]
    assert mesh.element_numbers.tolist() == [8, 12, 30]
    assert read_mesh(path, part="specimen").element_numbers.tolist() == [8, 12]
    path.write_text(GMSH4.partition("12 3 9 90")[0])
    with pytest.raises(InputError, match="is not a readable mesh: it ends early"):
        read_mesh(path)


def test_nastran_labels(tmp_path: Path) -> None:
    path = tmp_path / "a.bdf"
    rows = [f"GRID,{n},,{x},{y},0." for n, x, y in ((11, "0.", "0."), (5, "9.", "0."), (8, "0.", "9."))]
    path.write_text("BEGIN BULK\n" + "\n".join([*rows, "CTRIA3,42,1,11,5,8"]) + "\nENDDATA\n")
    mesh = read_mesh(path)
    assert (mesh.node_numbers.tolist(), mesh.element_numbers.tolist()) == ([11, 5, 8], [42])


def block(depth: float) -> tuple[np.ndarray, list[list[int]]]:
    """Two bricks side by side, 20 x 10 mm, as thick as `depth`."""
    flat = [[x, y] for y in (0, 10) for x in (0, 10, 20)]
    points = np.array([[*place, z] for z in (0, depth) for place in flat], dtype=float)
    return points, [[0, 1, 4, 3, 6, 7, 10, 9], [1, 2, 5, 4, 7, 8, 11, 10]]


def test_a_solid_gives_its_largest_face_the_one_that_lies_ahead(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    points, bricks = block(2.0)
    with caplog.at_level(logging.WARNING):
        mesh = read_mesh(written(tmp_path / "a.vtu", [("hexahedron", bricks)], points))
    assert mesh.areas.sum() == pytest.approx(200)
    assert mesh.node_numbers.tolist() == [6, 7, 8, 9, 10, 11]  # those at z = 2
    assert "its plane z = 2 with 2 of 10 faces" in caplog.text
    assert "as large" in caplog.text


def test_a_plane_across_another_axis_is_seen_along_it(tmp_path: Path) -> None:
    mesh = read_mesh(written(tmp_path / "a.vtu", points=POINTS[:, [2, 0, 1]]))
    assert (mesh.axes, mesh.areas.sum()) == ((1, 2), pytest.approx(AREA))


@pytest.mark.parametrize(("bend", "message"), [(0.0, "20 degrees from the nearest"), (0.02, r"off its mean plane")])
def test_a_surface_that_is_tilted_or_curved_is_refused_with_the_figure(
    tmp_path: Path, bend: float, message: str
) -> None:
    x, y, _ = POINTS.T
    points = np.stack([x * np.cos(np.radians(20)), y, x * np.sin(np.radians(20)) + bend * x**2], axis=1)
    with pytest.raises(InputError, match=message):
        read_mesh(written(tmp_path / "a.vtu", points=points))


def test_concave_and_collapsed_quadrilaterals_are_split_within_them(tmp_path: Path) -> None:
    points = np.array([[0, 0, 0], [10, 0, 0], [3, 3, 0], [0, 10, 0], [-5, 0, 0]], dtype=float)
    mesh = read_mesh(written(tmp_path / "a.vtu", [("quad", [[0, 1, 2, 3], [3, 4, 0, 0]])], points))
    assert mesh.areas == pytest.approx([15, 15, 25])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.step", "", "meshes are read from .inp"),
        ("a.vtu", "<no/>", "is not a readable mesh"),
        ("a.msh", "nothing", "not a gmsh file"),
        ("a.bdf", "nothing", "is not a readable mesh"),
        ("a.inp", "", "no elements that are read"),
    ],
)
def test_files_that_are_no_mesh_are_refused(tmp_path: Path, name: str, content: str, message: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message):
        read_mesh(tmp_path / name)
    with pytest.raises(InputError, match="mesh file not found"):
        read_mesh(tmp_path / "missing.inp")


def test_a_missing_meshio_is_told_with_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path / "a.vtk")
    for module in ("meshio", "meshio.vtk"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r'needs the package meshio.*: pip install "rgbmidic\[fe\]"'):
        read_mesh(path)


MM = np.array([[0.0, 0.0], [50.0, 0.0], [50.0, 30.0], [0.0, 30.0], [20.0, 10.0]])


def imaged(points: np.ndarray, *, mirrored: bool = False) -> np.ndarray:
    """10 px per mm, turned by 15 degrees; y up, unless the mesh is seen from behind."""
    c, s = 10 * np.cos(np.radians(15)), 10 * np.sin(np.radians(15))
    x, y = points.T
    y = y if mirrored else -y
    return np.stack([c * x - s * y + 100, s * x + c * y + 400], axis=1)


def pairs(number: int, **how: bool) -> np.ndarray:
    return np.hstack([MM[:number], imaged(MM[:number], **how)])


@pytest.mark.parametrize("number", [2, 3, 5])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_placement_finds_shift_turn_scale_and_the_side_it_is_seen_from(number: int, mirrored: bool) -> None:
    placement = Placement.fit(pairs(number, mirrored=mirrored))
    assert placement.residuals == pytest.approx(0, abs=1e-9)
    assert placement.mm_per_pixel == pytest.approx(0.1)
    if number > 2 or not mirrored:  # two points cannot tell: y is up then
        assert placement.reflected != mirrored
        assert placement.to_px(MM) == pytest.approx(imaged(MM, mirrored=mirrored))
    else:
        assert placement.reflected
    assert placement.to_mm(placement.to_px(MM)) == pytest.approx(MM)
    moved = placement.vectors_to_px(MM, np.full_like(MM, 0.3))
    assert placement.vectors_to_mm(placement.to_px(MM), moved) == pytest.approx(0.3)
    assert placement.jacobian(MM) @ placement.matrix == pytest.approx(np.broadcast_to(np.eye(2), (5, 2, 2)))
    reread = Placement.from_document(placement.to_document())
    assert reread.to_px(MM) == pytest.approx(placement.to_px(MM))


def test_points_on_a_line_leave_a_doubt_that_is_told(caplog: pytest.LogCaptureFixture) -> None:
    line = np.array([[0.0, 0.0], [10.0, 0.0], [30.0, 0.0]])
    placement = Placement.fit(np.hstack([line, imaged(line)]))
    assert "does not decide" in caplog.text
    assert placement.reflected


def test_a_pair_beyond_what_the_others_explain_is_named(caplog: pytest.LogCaptureFixture) -> None:
    point_pairs = pairs(5)
    point_pairs[:, 2:] += np.random.default_rng(1).normal(scale=0.4, size=(5, 2))
    Placement.fit(point_pairs)
    assert not caplog.text
    point_pairs[3, 2] += 25
    Placement.fit(point_pairs)
    assert "leaves residuals of" in caplog.text
    assert "mesh.points[3]" in caplog.text


def test_the_scale_s_uncertainty_is_that_of_the_residuals() -> None:
    random, scales, stated = np.random.default_rng(0), [], []
    for _ in range(200):
        point_pairs = pairs(5)
        point_pairs[:, 2:] += random.normal(size=(5, 2))
        placement = Placement.fit(point_pairs)
        scales.append(placement.mm_per_pixel)
        stated.append(placement.mm_per_pixel_std)
    assert np.std(scales) / np.sqrt(np.mean(np.square(stated))) == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([[0, 0, 1, 1]], "two or more pairs"),
        ([[0, 0, 1], [1, 1, 2]], "two or more pairs"),
        ([[0, 0, 1, 1], [0, 0, 5, 5]], r"pairs \[0, 1\] are one point on the mesh"),
        ([[0, 0, 1, 1], [5, 0, 1, 1]], r"pairs \[0, 1\] are one point on the image"),
    ],
)
def test_pairs_that_place_nothing_are_refused(given: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Placement.fit(given)


def test_a_camera_gives_lens_and_tilt_and_the_pairs_a_rigid_motion() -> None:
    homography = np.array([[0.1, 0.002, 30], [-0.001, 0.101, 20], [1e-5, 2e-5, 1]])
    camera = CameraCalibration(shape=(480, 640), lens=[3000, 320, 240, 0.05, 0, 0, 0, 0], homography=homography)
    turn = np.radians(30)
    plane = MM @ np.array([[np.cos(turn), np.sin(turn)], [np.sin(turn), -np.cos(turn)]]).T * 0.3 + [22, 18]
    placement = Placement.fit(np.hstack([MM * 0.3, camera.to_px(plane)]), camera)
    assert camera.to_mm(camera.to_px(plane)) == pytest.approx(plane, abs=1e-9)
    assert placement.residuals == pytest.approx(0, abs=1e-6)
    assert placement.reflected
    assert placement.mm_per_pixel is None
    with pytest.raises(InputError, match=r"0\.001 times as far apart"):  # the mesh's points in um
        Placement.fit(np.hstack([MM * 300, camera.to_px(plane)]), camera)
    inside = placement.to_px(MM * 0.3)
    steps = [(placement.to_mm(inside + step) - placement.to_mm(inside - step)) / 2e-3 for step in 1e-3 * np.eye(2)]
    assert placement.jacobian(inside) == pytest.approx(np.stack(steps, axis=2), rel=1e-5, abs=1e-9)


def test_pairs_near_each_other_are_not_refused_for_the_one_that_is_far() -> None:
    homography = np.array([[0.1, 0, 30], [0, 0.1, 20], [0, 0, 1]])
    camera = CameraCalibration(shape=(480, 640), lens=[3000, 320, 240, 0, 0, 0, 0, 0], homography=homography)
    points = np.array([[0.0, 0.0], [1.0, 0.0], [30.0, 20.0]])
    image = camera.to_px(points * [1, -1] + [40, 60]) + np.array([[0, 0], [1, 0], [0, 0]])
    assert Placement.fit(np.hstack([points, image]), camera).rms < 1


def plate() -> FiniteElementMesh:
    flat = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 60, 40), (41, 61)), 10)
    return FiniteElementMesh(
        name="plate",
        points=flat.nodes,
        node_numbers=np.arange(len(flat.nodes)) + 100,
        elements=flat.elements,
        element_numbers=np.arange(len(flat.elements)) + 7,
    )


def test_what_lies_outside_the_image_or_the_region_is_left_out_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    mesh, placement = pickle.loads(pickle.dumps((plate(), Placement.fit([[0, 0, 10, 50], [10, 0, 20, 50]]))))
    inner_mesh, placed, region = place_on_image(mesh, placement, (80, 80))
    assert len(inner_mesh.elements) == len(mesh.elements)
    assert np.abs(region.mask.sum() - placed.areas.sum()) < 0.05 * placed.areas.sum()
    inner_mesh, placed, region = place_on_image(mesh, placement, (80, 45))
    assert f"{24} of {48} triangles lie outside the image" in caplog.text
    assert (inner_mesh.points[:, 0] <= 30).all()
    assert set(inner_mesh.node_numbers) <= set(mesh.node_numbers)
    assert placed.nodes == pytest.approx(inner_mesh.points * [1, -1] + [10, 50])
    half = np.zeros((80, 80), dtype=bool)
    half[:, :40] = True
    inner_mesh, _, _ = place_on_image(mesh, placement, (80, 80), Region.from_mask(half))
    assert "lie outside the region" in caplog.text
    assert set(inner_mesh.element_numbers) < set(mesh.element_numbers)
    with pytest.raises(RegionError, match="place it at x 10 to 70, y 10 to 50 px of an image of 8 x 8"):
        place_on_image(mesh, placement, (8, 8))
