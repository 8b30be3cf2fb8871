"""Mesh files that contradict themselves, leave something out, or would cost without end: refused or said, at once."""

from __future__ import annotations

import base64
import os
import signal
import struct
import tracemalloc
import zlib
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbmidic import FiniteElementMesh, Placement, Tri3Mesh, read_mesh
from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.tools.finite_elements import mesh_file

meshio = pytest.importorskip("meshio")

POINTS = np.array([[x, y, 0.0] for y in (0, 10) for x in (0, 10, 20)])
QUADS = [[0, 1, 4, 3], [1, 2, 5, 4]]
NODES = "".join(f"{n}, {x}, {y}\n" for n, (x, y, _) in enumerate(POINTS, start=1))
CARD = "*Element, type=CPS4, elset=all\n"
INP = f"*Node\n{NODES}{CARD}1, 1, 2, 5, 4\n2, 2, 3, 6, 5\n"
ROWS = "".join(f"{n} {x} {y} 0\n" for n, (x, y, _) in enumerate(POINTS, start=1))
MSH = f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n6\n{ROWS}$EndNodes\n"
MSH += "$Elements\n2\n1 3 2 1 1 1 2 5 4\n2 3 2 1 1 2 3 6 5\n$EndElements\n"
AVS = f"6 2 0 0 0\n{ROWS}1 1 quad 1 2 5 4\n2 1 quad 2 3 6 5\n"
GRIDS = "".join(f"GRID,{n},,{x},{y}\n" for n, (x, y, _) in enumerate(POINTS, start=1))
BDF = f"BEGIN BULK\n{GRIDS}CQUAD4,1,3,1,2,5,4\nCQUAD4,2,3,2,3,6,5\nENDDATA\n"


def read(folder: Path, name: str, text: str, **how: Any) -> FiniteElementMesh:
    (folder / name).write_text(text)
    return read_mesh(folder / name, **how)


def refused(folder: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(folder, name, text)
    assert str(folder / name) in str(caught.value)


@pytest.mark.parametrize(("name", "text"), [("a.inp", INP), ("a.msh", MSH), ("a.avs", AVS), ("a.bdf", BDF)])
def test_the_texts_of_these_tests_are_sound(tmp_path: Path, name: str, text: str) -> None:
    mesh = read(tmp_path, name, text)
    assert mesh.areas.sum() == 200
    assert (mesh.node_numbers.tolist(), mesh.element_numbers.tolist()) == ([1, 2, 3, 4, 5, 6], [1, 1, 2, 2])
    assert mesh.numbering == "labels of the file"


@pytest.mark.parametrize("name", ["a.vtu", "a.vtk", "old.vtk", "a.xdmf", "a.mesh"])
@pytest.mark.parametrize("node", [-1, 6])
def test_a_node_that_is_not_there_is_none_of_those_that_are(tmp_path: Path, name: str, node: int) -> None:
    how = {"file_format": "vtk42"} if name == "old.vtk" else {}
    meshio.write(tmp_path / name, meshio.Mesh(POINTS, [("quad", [QUADS[0], [1, 2, node, 4]])]), **how)
    with pytest.raises(InputError, match=r"element [12] has a node that the file does not state"):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize("place", [np.nan, np.inf, 1e200])
@pytest.mark.parametrize("name", ["a.vtu", "a.vtk", "a.xdmf", "a.mesh", "a.avs"])
def test_nodes_lie_somewhere(tmp_path: Path, name: str, place: float) -> None:
    points = POINTS.copy()
    points[2, 1] = place
    meshio.write(tmp_path / name, meshio.Mesh(points, [("quad", QUADS)]))
    with pytest.raises(InputError, match="coordinates are finite numbers"):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.inp", INP.replace(CARD, "*Node\n6, 99., 99.\n" + CARD), "node 6 is stated 2 times"),
        ("a.msh", MSH.replace("$Nodes\n6", "$Nodes\n7\n6 9 9 9"), "node 6 is stated 2 times"),
        ("a.avs", AVS.replace("6 20.0", "5 20.0").replace("6 5", "5 5"), "node 5 is stated 2 times"),
        ("a.bdf", BDF.replace("ENDDATA", "GRID,6,,99.,99.\nENDDATA"), "node 6 is stated 2 times"),
        ("a.inp", INP.replace("2, 2, 3", "1, 2, 3"), "element 1 is stated 2 times"),
        ("a.msh", MSH.replace("2 3 2 1 1", "1 3 2 1 1"), "element 1 is stated 2 times"),
        ("a.avs", AVS.replace("2 1 quad", "1 1 quad"), "element 1 is stated 2 times"),
        ("a.bdf", BDF.replace("CQUAD4,2,", "CQUAD4,1,"), "element 1 is stated 2 times"),
        (
            "a.inp",
            INP.replace("3, 6, 5", "3, 6, 6000000000000000000000"),
            "has node 60*, which the file does not state",
        ),
        ("a.inp", INP.replace(CARD, f"{10**21}, 20., 5.\n" + CARD), "too large"),
        ("a.msh", MSH.replace("$Elements\n2", "$Elements\n1"), "after its stated number of rows .Elements goes on"),
        ("a.msh", MSH.replace("$Nodes\n6", "noted\n$Nodes\n6"), '"noted" stands in no section'),
        ("a.msh", MSH.replace("2.2 0", "4 0"), "version 4; of gmsh's 2 and 4.1 are read"),
        ("a.inp", INP[1:], "which is no keyword"),
        ("a.msh", MSH.replace("1 3 2 1 1", "1 67 2 1 1"), "elements of type 67 are not read; those of types"),
        ("a.inp", INP + "*Elset, elset=some\nother\n", "a set that is not stated before"),
        ("a.inp", INP.replace("*Node\n", "*Node,\n"), 'ends with a comma and goes on with "1"'),
        (
            "a.inp",
            f"*Part, name=A\n{INP}*End part\n*Instance, name=A-1, part=a\n*Instance, name=A-2, part=A\n",
            r"has the part A 2 times \(A-1, A-2\)",
        ),
        ("a.bdf", BDF.replace("GRID,6,,", "GRID,6,4,"), "has the coordinate system 4"),
        ("a.bdf", BDF.replace("ENDDATA\n", ""), "ends without ENDDATA"),
        ("a.bdf", BDF.replace("GRID,6", "INCLUDE 'missing.bdf'\nGRID,6"), "No such file.*missing.bdf"),
        ("a.inp", INP.replace("2, 2, 3, 6, 5", "2, 1, 2, 5, 4"), "elements 1 and 2 of .* overlap"),
        ("a.inp", INP.replace("2, 2, 3, 6, 5", "2, 1, 3, 6, 4"), "elements [12] and [12] of .* overlap"),
        ("a.inp", INP.replace("2, 2, 3, 6, 5", "2, 2, 3, 5, 6"), "elements 2 and 2 of .* overlap"),
        ("a.inp", INP.replace("2, 2, 3, 6, 5", "2, 2, 2, 2, 6"), "element 2 of .* has no area"),
    ],
)
def test_what_a_file_says_twice_or_leaves_open_is_refused(tmp_path: Path, name: str, text: str, message: str) -> None:
    refused(tmp_path, name, text, message)


PARAMETRIC = "".join(f"{n} {x} {y} 0 {n % 4} 1 {' .5' * (n % 4 % 3)}\n" for n, (x, y, _) in enumerate(POINTS, start=1))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.bdf", BDF.replace("BEGIN BULK\n", "$ Created by Gmsh\n")),
        ("a.bdf", "CEND\n" + BDF.replace("ENDDATA", "END BULK")),
        ("a.inp", INP.replace("*Node\n", "*Node,\n nset = all\n").replace("type=CPS4,", "type=CPS4,\n")),
        ("a.inp", INP.replace("10.0", "1.0D+01").replace("20.0", "2.0d1")),
        ("a.msh", MSH.replace(ROWS, PARAMETRIC).replace("Nodes", "ParametricNodes")),
    ],
)
def test_dialects_of_other_programs_are_read(
    tmp_path: Path, name: str, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    mesh = read(tmp_path, name, text)
    assert mesh.areas.sum() == 200
    assert mesh.node_numbers.tolist() == [1, 2, 3, 4, 5, 6]
    assert not caplog.text


def test_sets_of_one_name_in_part_and_assembly_are_told_apart(tmp_path: Path) -> None:
    text = f"*Part, name=A\n{INP}*Elset, elset=ROI\n1\n*End part\n*Assembly\n*Instance, name=A-1, part=A\n"
    text += "*End instance\n*Instance, name=B-1, part=B\n*End instance\n*Elset, elset=Roi, instance=A-1\n1, 2\n"
    text += "*Elset, elset=all, instance=B-1\n2\n"
    text += "*Elset, elset=right, instance=a-1\n2\n"
    with pytest.raises(InputError, match=r'no set "roi" of elements; it has A.ROI, ASSEMBLY.ROI, all, right'):
        read(tmp_path, "a.inp", text, part="roi")
    areas = [read(tmp_path, "a.inp", text, part=name).areas.sum() for name in ("a.roi", "assembly.roi", "RIGHT")]
    assert areas == [100, 200, 100]


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("version", ["2.2", "4.1"])
def test_gmsh_s_binary_files_keep_tags_groups_and_nodal_data(
    tmp_path: Path, version: str, order: str, alarm: None
) -> None:
    def packed(layout: str, *numbers: float) -> bytes:
        return struct.pack(order + layout, *numbers)

    nodes = [packed("iddd", 10 + n, *place) for n, place in enumerate(POINTS)]
    if version == "2.2":
        body = b"$Nodes\n6\n" + b"".join(nodes) + b"\n$EndNodes\n$Elements\n2\n"
        body += b"".join(
            packed("iii7i", 3, 1, 2, 5 + n, 7 + n, 1, *(10 + np.array(quad))) for n, quad in enumerate(QUADS)
        )
    else:
        body = b"$Entities\n" + packed("4q", 0, 0, 2, 0)
        body += b"".join(packed("i6dqiq", 1 + n, *[0] * 6, 1, 7 + n, 0) for n in range(2)) + b"\n$EndEntities\n"
        body += b"$Nodes\n" + packed("4qiiiq6q", 1, 6, 10, 15, 2, 1, 1, 6, *range(10, 16))
        body += b"".join(packed("5d", *place, 0, 0) for place in POINTS) + b"\n$EndNodes\n"
        body += b"$Elements\n" + packed("4q", 2, 2, 5, 6)
        body += b"".join(packed("iiiq5q", 2, 1 + n, 3, 1, 5 + n, *(10 + np.array(q))) for n, q in enumerate(QUADS))
    data = b'$NodeData\n1\n"U"\n1\n0.0\n3\n0\n3\n6\n' + b"".join(nodes)
    content = f"$MeshFormat\n{version} 1 8\n".encode() + packed("i", 1) + b"\n$EndMeshFormat\n"
    content += b'$PhysicalNames\n1\n2 8 "the right one"\n$EndPhysicalNames\n' + body + b"\n$EndElements\n"
    path = tmp_path / "a.msh"
    path.write_bytes(content + data + b"\n$EndNodeData\n")
    mesh = read_mesh(path)
    assert mesh.node_numbers.tolist() == [10, 11, 12, 13, 14, 15]
    assert mesh.element_numbers.tolist() == [5, 5, 6, 6]
    assert mesh.fields["U"].tolist() == POINTS.tolist()
    assert read_mesh(path, part="the right one").element_numbers.tolist() == [6, 6]
    for huge in (b"7" * 12, b"7" * 30):  # rows of nodal data, real and whole numbers
        for row in (b"\n3\n6\n", b"\n1\n0.0\n", b"\n3\n0\n"):
            path.write_bytes(content + data.replace(row, b"\n%s\n" % huge + row[3:], 1))
            signal.alarm(5)
            with pytest.raises(InputError, match=r"is not a readable mesh|components"):
                read_mesh(path)
    signal.alarm(0)


def test_bodies_that_overlap_are_measured_one_at_a_time(tmp_path: Path) -> None:
    text = INP + "*Element, type=M3D4, elset=skin\n3, 1, 2, 5, 4\n"
    refused(tmp_path, "a.inp", text, "measure one set of them")
    assert read(tmp_path, "a.inp", text, part="ALL").areas.sum() == 200


def test_a_solid_stated_twice_does_not_vanish(tmp_path: Path) -> None:
    points = np.array([[x, y, z] for z in (0, 2) for y in (0, 10) for x in (0, 10, 20)], dtype=float)
    bricks = [[0, 1, 4, 3, 6, 7, 10, 9], [1, 2, 5, 4, 7, 8, 11, 10]]
    meshio.write(tmp_path / "a.vtu", meshio.Mesh(points, [("hexahedron", [*bricks, bricks[1]])]))
    with pytest.raises(InputError, match="overlap, element 0 among them"):
        read_mesh(tmp_path / "a.vtu")


@pytest.mark.parametrize(
    ("name", "text", "types"),
    [
        ("a.inp", INP + "*Element, type=COH2D4\n9, 1, 2, 5, 4\n", "type COH2D4"),
        ("a.bdf", BDF.replace("ENDDATA", "CTRIAX6,9,3,1,2,3,4,5,6\nENDDATA"), "CTRIAX6"),
        ("a.inp", INP + "*Element, type=C3D4\n9, 1, 2, 5, 4\n", "tetra"),
    ],
)
def test_elements_that_are_left_out_are_named(
    tmp_path: Path, name: str, text: str, types: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert read(tmp_path, name, text).areas.sum() == 200
    assert f"elements are left out: {types}" in caplog.text


def test_polygons_are_left_out_with_a_word(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cells = [("quad", QUADS), ("polygon", [[0, 1, 2, 5, 3]]), ("line", [[0, 1]])]
    meshio.write(tmp_path / "a.vtu", meshio.Mesh(POINTS, cells))
    assert read_mesh(tmp_path / "a.vtu").areas.sum() == 200
    assert "elements are left out: type 7" in caplog.text


def test_files_that_are_included_belong_to_the_mesh(tmp_path: Path, alarm: None) -> None:
    (tmp_path / "grids.bdf").write_text(GRIDS)
    mesh = read(tmp_path, "a.bdf", BDF.replace(GRIDS, "include 'grids.bdf'  $ all\n"))
    assert mesh.areas.sum() == 200
    (tmp_path / "nodes.txt").write_text(NODES)
    text = INP.replace("*Node\n" + NODES, "*Node, input=nodes.txt\n")
    assert read(tmp_path, "a.inp", text).areas.sum() == 200
    (tmp_path / "b.inp").write_text("*Include, input=a.inp\n" * 2)
    refused(tmp_path, "a.inp", "*Include, input=b.inp\n" * 2 + INP, "a.inp is included twice, or includes itself")


def test_nastran_s_fields_are_wide_or_narrow_and_go_on(tmp_path: Path) -> None:
    numbers = [f"GRID*   {n:>16}{'':16}{x:>16}{y:>16}\n*       {'0.':>16}\n" for n, (x, y, _) in enumerate(POINTS, 1)]
    text = "SOL 101\nBEGIN BULK\n$ all kinds\n" + "".join(numbers).replace("            20.0", "           2.0+1")
    text += f"CQUAD4* {1:>16}{7:>16}{1:>16}{2:>16}\n*       {5:>16}{4:>16}\n"
    text += f"ctria3  {2:8}{8:8}{2:8}{3:8}{6:8}\nCTRIA6,3,8,2,6,5,0,0\n+,0\nENDDATA\n"
    mesh = read(tmp_path, "a.nas", text)
    assert mesh.areas.tolist() == [50, 50, 50, 50]
    assert sorted(mesh.element_numbers.tolist()) == [1, 1, 2, 3]
    assert read_mesh(tmp_path / "a.nas", part="8").areas.sum() == 100


def test_cells_with_fewer_nodes_than_corners_are_refused(tmp_path: Path) -> None:
    meshio.write(tmp_path / "a.xdmf", meshio.Mesh(POINTS, [("triangle", [[0, 1, 4]])]), data_format="XML")
    text = (tmp_path / "a.xdmf").read_text()
    refused(tmp_path, "a.xdmf", text.replace('"Triangle"', '"Quadrilateral"'), "a quad has fewer nodes than corners")


def array(values: Any, kind: str, header: str, packing: str, order: str, form: str, at: list[bytes]) -> str:
    """A DataArray of a .vtu as VTK writes it; what is appended is added to `at`."""
    values, size = np.asarray(values), np.dtype(order + header)
    content, number = values.astype(order + kind).tobytes(), lambda *n: np.array(n, dtype=size).tobytes()
    if packing:
        pieces = [zlib.compress(content[i : i + 64]) for i in range(0, len(content), 64)]
        parts = [number(len(pieces), 64, len(content) % 64, *map(len, pieces)), b"".join(pieces)]
    else:
        parts = [number(len(content)), content]
    if form == "together":
        parts = [b"".join(parts)]
    stream = b"".join(parts if form == "raw" else map(base64.b64encode, parts))
    names = {"f8": "Float64", "i8": "Int64", "u1": "UInt8"}
    inner = f'type="{names[kind]}" NumberOfComponents="{values.shape[1] if values.ndim > 1 else 1}"'
    if form == "inline":
        return f'{inner} format="binary">\n{stream.decode()}\n'
    offset = sum(map(len, at))
    at.append(stream)
    return f'{inner} format="appended" offset="{offset}">'


def vtu(path: Path, *, header: str, packing: str, order: str, form: str, **change: Any) -> Path:
    at: list[bytes] = []
    given = {"Points": POINTS, "U": POINTS / 1000, "connectivity": np.ravel(QUADS), "offsets": [4, 8], "types": [9, 9]}
    given |= change
    kinds = {"Points": "f8", "U": "f8", "connectivity": "i8", "offsets": "i8", "types": "u1"}
    text = {
        name: f'<DataArray Name="{name}" {array(x, kinds[name], header, packing, order, form, at)}</DataArray>'
        for name, x in given.items()
    }
    endian, headers = ("Little" if order == "<" else "Big"), {"u4": "UInt32", "u8": "UInt64"}[header]
    packed = f' compressor="{packing}"' if packing else ""
    head = f'<VTKFile type="UnstructuredGrid" byte_order="{endian}Endian" header_type="{headers}"{packed}>'
    head += '<UnstructuredGrid><Piece NumberOfPoints="6" NumberOfCells="2">'
    head += f"<Points>{text['Points']}</Points><PointData>{text['U']}</PointData>"
    head += f"<Cells>{text['connectivity']}{text['offsets']}{text['types']}</Cells></Piece></UnstructuredGrid>"
    encoding = "raw" if form == "raw" else "base64"
    tail = f'<AppendedData encoding="{encoding}">\n _'.encode() + b"".join(at) + b"\n</AppendedData>" if at else b""
    path.write_bytes(head.encode() + tail + b"</VTKFile>")
    return path


@pytest.mark.parametrize("header", ["u4", "u8"])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("form", "packing"),
    [*product(("inline", "base64", "raw"), ("", "vtkZLibDataCompressor")), ("together", "")],
)
def test_a_vtu_is_read_in_each_of_its_encodings(
    tmp_path: Path, header: str, order: str, form: str, packing: str
) -> None:
    mesh = read_mesh(vtu(tmp_path / "a.vtu", header=header, packing=packing, order=order, form=form))
    assert mesh.areas.tolist() == [50, 50, 50, 50]
    np.testing.assert_array_equal(mesh.fields["U"], POINTS / 1000)


def test_a_vtu_whose_cells_do_not_fit_is_refused(tmp_path: Path) -> None:
    how: dict[str, Any] = {"header": "u4", "packing": "", "order": "<", "form": "inline"}
    for change, message in (
        ({"offsets": [4, 7]}, "the offsets of its cells"),
        ({"offsets": [3, 8]}, "a quad has fewer nodes than corners"),
        ({"Points": POINTS[:, :2]}, "not those that it announces"),
        ({"types": [9]}, "not those that it announces"),
        ({"U": POINTS[1:]}, "U of nodes are not as many"),
    ):
        with pytest.raises(InputError, match=message):
            read_mesh(vtu(tmp_path / "a.vtu", **how, **change))
    text = vtu(tmp_path / "a.vtu", **how).read_text()
    begin, end = text.index("<Piece"), text.index("</UnstructuredGrid>")
    refused(tmp_path, "a.vtu", text[:end] + text[begin:end] + text[end:], "2 pieces")


def test_what_is_packed_is_not_larger_than_it_states(tmp_path: Path) -> None:
    path = vtu(tmp_path / "a.vtu", header="u4", packing="vtkZLibDataCompressor", order="<", form="raw")
    data = path.read_bytes()
    place = data.index(b" _") + 2
    block = zlib.compress(bytes(2**26))
    for blocks, largest, message in ((1, 64, "larger than it states"), (2**16, 2**20, "bytes; up to")):
        header = np.array([blocks, largest, 0, len(block), *[0] * (blocks - 1)], dtype="<u4").tobytes()
        path.write_bytes(data[:place] + header + block + data[place:])
        tracemalloc.start()
        with pytest.raises(InputError, match=message):
            read_mesh(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 2**23


def test_what_is_larger_than_is_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_file, "MAX_BYTES", 100)
    for name, text in (("a.inp", INP), ("a.msh", MSH), ("a.avs", AVS), ("a.bdf", BDF), ("a.vtu", "<VTKFile/>" * 11)):
        refused(tmp_path, name, text, "bytes; meshes of up to 100 are read")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_is_not_waited_for(tmp_path: Path, alarm: None) -> None:
    for form, name in (("HDF", "data.h5:/data0"), ("Binary", f"{tmp_path / 'data.h5'}")):
        meshio.write(tmp_path / "a.xdmf", meshio.Mesh(POINTS, [("quad", QUADS)]), data_format="XML")
        text = (tmp_path / "a.xdmf").read_text()
        begin = text.index('Format="XML"')
        end = text.index("</DataItem>")
        (tmp_path / "data.h5").unlink(missing_ok=True)
        os.mkfifo(tmp_path / "data.h5")
        refused(
            tmp_path, "a.xdmf", f'{text[:begin]}Format="{form}">{name}{text[end:]}', "not a regular file but a pipe"
        )
    os.mkfifo(tmp_path / "a.inp")
    with pytest.raises(InputError, match="not a regular file but a pipe"):
        read_mesh(tmp_path / "a.inp")


def test_blank_lines_cost_no_more_than_others(tmp_path: Path, alarm: None) -> None:
    for name, text in (("a.inp", INP), ("a.msh", MSH), ("a.bdf", BDF)):
        begin = text.index("\n") + 1
        assert read(tmp_path, name, text[:begin] + "\n" * 10**6 + text[begin:]).areas.sum() == 200


@pytest.mark.parametrize(("name", "section"), [("a.vol", "face_colours"), ("a.mesh", "Ridges")])
def test_rows_that_are_announced_are_not_waited_for(tmp_path: Path, name: str, section: str, alarm: None) -> None:
    meshio.write(tmp_path / name, meshio.Mesh(POINTS, [("quad", QUADS)]))
    text = (tmp_path / name).read_text().replace("endmesh", "").replace("End\n", "")
    refused(tmp_path, name, f"{text}\n{section}\n{10**15}\n", "more than it has bytes")


def test_a_range_of_labels_is_not_written_out(tmp_path: Path, alarm: None) -> None:
    tracemalloc.start()
    mesh = read(tmp_path, "a.inp", INP + "*Elset, elset=wide, generate\n2, 4000000, 2\n", part="wide")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert mesh.element_numbers.tolist() == [2, 2]
    assert peak < 2**23


def overlaps(one: np.ndarray, other: np.ndarray, reach: float) -> bool:
    """Whether no side of either triangle parts them, side by side and corner by corner."""
    for a, b in ((one, other), (other, one)):
        for k in range(3):
            side = a[(k + 1) % 3] - a[k]
            inward = np.array([-side[1], side[0]]) / np.hypot(*side)
            if max(float(inward @ (corner - a[k])) for corner in b) <= reach:
                return False
    return True


def test_overlaps_are_those_of_all_pairs() -> None:
    random, found = np.random.default_rng(4), []
    for _ in range(150):
        number = int(random.integers(2, 14))
        corners = random.uniform(0, 1, (number, 1, 2)) + random.uniform(0.02, 0.4) * random.normal(size=(number, 3, 2))
        flat = corners.reshape(-1, 2)
        mesh = FiniteElementMesh(
            name="random",
            points=flat,
            node_numbers=np.arange(len(flat)),
            elements=np.arange(len(flat)).reshape(-1, 3),
            element_numbers=np.arange(number),
        )
        placed, reach = mesh.points[mesh.elements], 1e-4 * np.ptp(flat, axis=0).max()
        pairs = {
            (i, j) for i in range(number) for j in range(number) if i != j and overlaps(placed[i], placed[j], reach)
        }
        both = mesh.overlap()
        assert (both in pairs) if pairs else (both is None)
        found.append(bool(pairs))
    assert 0.2 < np.mean(found) < 0.98


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "a.inp",
            INP.replace("6, 20.0", "6x, 20.0"),
            'not a readable mesh: "6x" stands where a whole number is expected',
        ),
        ("a.inp", INP.replace("20.0, 10.0", "2_0, 10.0"), 'mesh: "2_0" stands where a number is expected'),
        ("a.inp", INP.replace("type=CPS4", "tpe=CPS4"), r"mesh: \*ELEMENT has no TYPE"),
        ("a.bdf", BDF.replace("GRID,6", "GRID,six"), 'mesh: "six" stands where a whole number'),
        ("a.msh", MSH.replace("20.0", "20.0.0"), 'mesh: "20.0.0" stands where a number'),
        ("a.vtu", "<VTKFile>", "mesh: it is no XML: no element found"),
        ("a.avs", AVS.replace("quad", "quat"), "mesh: meshio ends with KeyError"),
    ],
)
def test_a_word_in_place_of_a_number_is_named(tmp_path: Path, name: str, text: str, message: str) -> None:
    refused(tmp_path, name, text, message)


def test_methods_of_meshes_refuse_arrays_of_another_type_or_size() -> None:
    mesh = FiniteElementMesh(
        name="plate",
        points=POINTS[:, :2],
        node_numbers=np.arange(6),
        elements=np.array([[0, 1, 4], [1, 2, 5]]),
        element_numbers=np.array([1, 2]),
    )
    placement = Placement.fit([(0, 0, 100, 300), (10, 0, 200, 300)])
    tri3 = Tri3Mesh(nodes=10 * mesh.points, elements=mesh.elements)
    flags: Any = [True] * 5
    for call, message in (
        (lambda: mesh.subset(flags), r"selected must be an array \(2\) of True or False"),
        (lambda: replace(mesh, fields={"U": np.ones(3)}), r"plate: U must be an array \(6\) of numbers"),
        (lambda: placement.to_px("here"), r"points must be an array \(any, 2\) of numbers; given is 'here'"),
        (lambda: placement.vectors_to_mm([[1, 2]], [[3]]), r"vectors must be an array \(1, 2\) of numbers"),
        (lambda: Placement(matrix="x", shift=[1, 2]), r"matrix of a placement must be an array \(2, 2\)"),
        (lambda: tri3.region("x"), "numbers of rows and columns"),
        (lambda: tri3.submesh(flags), r"nodes must be an array \(6\) of True or False"),
        (lambda: tri3.nearest_nodes(np.ones(5, dtype=bool)), r"targets must be an array \(6\)"),
        (lambda: tri3.nearest_nodes(np.zeros(6, dtype=bool)), "one node at least"),
        (lambda: tri3.to_nodes(np.ones(6)), r"per_element must be an array \(2\) of numbers"),
        (lambda: tri3.nodal_gradient(np.ones(6)), r"values must be an array \(6, any\) of numbers"),
        (lambda: Tri3Mesh.from_region("x", 20), "made of a Region"),
    ):
        with pytest.raises(RgbmidicError, match=message):
            call()
