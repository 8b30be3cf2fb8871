"""The comparison with a simulation: its statistics, its levelling, its times, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import meshio
import numpy as np
import pytest
from nodal_tests import MESH, nodal_noise
from results import make_result

from rgbmidic import FiniteElementMesh, Placement, Region, Tri3Mesh, read_mesh
from rgbmidic.cli import app as cli
from rgbmidic.cli.command import execute
from rgbmidic.errors import InputError
from rgbmidic.mesh.recovery import Recovery
from rgbmidic.results import FrameRecord, Result
from rgbmidic.tools.finite_elements import measured_mesh
from rgbmidic.tools.finite_elements.comparison import Comparison
from rgbmidic.tools.finite_elements.comparison_page import scale_text
from rgbmidic.tools.finite_elements.mesh_source import labels_of
from rgbmidic.tools.finite_elements.simulation import Levelling, Simulation, find_placement

NODES, STD, MM = len(MESH.nodes), 0.01, 0.05
PLACEMENT = Placement.fit([[0, 0, 10, 170], [10, 0, 210, 170], [0, 8, 10, 10]])
OTHER = Tri3Mesh.from_region(Region.from_rectangle((25, 22, 190, 160), (200, 240)), 13)


def finite_elements(mesh: Tri3Mesh = MESH, name: str = "plate.vtu") -> FiniteElementMesh:
    return FiniteElementMesh(
        name=name,
        points=PLACEMENT.to_mm(mesh.nodes),
        node_numbers=100 + 3 * np.arange(len(mesh.nodes)),
        elements=mesh.elements,
        element_numbers=1 + np.arange(len(mesh.elements)),
    )


def stretch(mesh: Tri3Mesh = MESH, strain: float = 0.01, bend: float = 0.05) -> np.ndarray:
    """Displacement (N, 2) in mm of a plate that is pulled along y and fixed at its lower edge."""
    x, y = PLACEMENT.to_mm(mesh.nodes).T
    return np.stack([-0.3 * strain * x, strain * (y + bend * y**2)], axis=1)


def measured(
    path: Path, displacement: np.ndarray, std: float = STD, timed: bool = True, bias: float = 0.0, **options: object
) -> Result:
    """A result of displacements (T, N, 2) in mm along the mesh's axes, each frame against the one reference."""

    def record(index: int) -> FrameRecord:
        u, v = PLACEMENT.vectors_to_px(PLACEMENT.to_mm(MESH.nodes), displacement[index]).T
        stated = {"u_std": np.full(NODES, std), "v_std": np.full(NODES, std)}
        stated |= {"u_bias_std": np.full(NODES, bias), "v_bias_std": np.full(NODES, bias)}
        stated |= {"time_ns": 1_000_000 * index} if timed else {}
        return FrameRecord.from_values(nodes=NODES, lights=3, number=index, status=0, u=u, v=v, **stated)

    mesh = {"nodes": MESH.nodes, "elements": MESH.elements, "references": []}
    return make_result(path, frames=len(displacement), record=record, **{**mesh, **options})


def noise(frames: int, seed: int = 0) -> np.ndarray:
    """Noise (T, N, 2) in mm, of frames that have no reference in common."""
    return nodal_noise(np.random.default_rng(seed), frames) * STD * MM


def compared(result: Result, displacement: np.ndarray, mesh: Tri3Mesh = MESH, **options: object) -> Comparison:
    simulation = Simulation(mesh=finite_elements(mesh), displacement=displacement[None])
    return Comparison(result, simulation, PLACEMENT, **{"frames": range(len(result)), **options})


@pytest.mark.parametrize("mesh", [MESH, OTHER], ids=["own nodes", "other nodes"])
def test_chi_square_is_1_and_scatters_as_its_degrees_of_freedom_state(tmp_path, mesh):
    comparison = compared(measured(tmp_path / "r", noise(60)), np.zeros((len(mesh.nodes), 2)), mesh)
    frames = list(comparison.iterate())
    for name in ("displacement", "u", "exx", "eyy", "exy"):
        agreements = [made.agreement["levelled", name] for made in frames]
        squares = np.array([one.chi_square for one in agreements])
        assert abs(squares.mean() - 1) < 0.1, name
        assert 0.6 < squares.var() * agreements[0].degrees_of_freedom / 2 < 1.6, name
        assert np.mean([one.beyond_2 for one in agreements]) == pytest.approx(0.0455, abs=0.015)
    assert np.isnan(frames[0].fit.scale)  # nothing has moved


def test_the_lights_bias_is_alike_over_its_range_and_leaves_fewer_degrees_of_freedom(tmp_path):
    mesh = OTHER
    away = ((MESH.nodes[:, None] - MESH.nodes) ** 2).sum(axis=-1)
    root = np.linalg.cholesky(np.exp(-away / (4 * 34**2)) + 1e-9 * np.eye(NODES))
    bias = 2 * STD * MM * (root @ np.random.default_rng(9).normal(size=(60, NODES, 2)))
    field = 0.05 * stretch(mesh)
    moved = noise(60) + bias + 0.05 * stretch()
    comparison = compared(measured(tmp_path / "r", moved, std=5**0.5 * STD, bias=2 * STD), field, mesh)
    plain = compared(measured(tmp_path / "p", moved[:1], std=5**0.5 * STD), field, mesh).frame(0)
    frames = list(comparison.iterate())
    for name, tolerance in {"u": 0.15, "exx": 0.1, "exy": 0.1}.items():
        agreements = [made.agreement["levelled", name] for made in frames]
        squares = np.array([one.chi_square for one in agreements])
        assert abs(squares.mean() - 1) < tolerance, name
        assert 0.5 < squares.var() * agreements[0].degrees_of_freedom / 2 < 1.8, name
    assert frames[0].agreement["levelled", "u"].degrees_of_freedom < 0.6 * (
        plain.agreement["levelled", "u"].degrees_of_freedom
    )
    pulls = [(one.fit.scale - 1) / one.fit.scale_std for one in frames]
    assert 0.75 < np.sqrt(np.mean(np.square(pulls))) < 1.25
    shifts = [(one.fit.rigid / one.fit.rigid_std) for one in frames]
    assert (np.abs(np.sqrt(np.mean(np.square(shifts), axis=0)) - 1) < 0.25).all()


def test_the_scale_of_several_frames_holds_its_uncertainty(tmp_path):
    """The noise of the reference is in all frames: that the stated mean is not too certain is what is tested."""
    field, pulls, alone = stretch(strain=0.002, bend=0), [], []
    for seed in range(12):
        own = noise(5, seed)
        made = (own[1:] - own[:1]) / np.sqrt(2) + np.linspace(0.25, 1, 4)[:, None, None] * 1.05 * field
        result = measured(tmp_path / f"{seed}", np.concatenate([0 * own[:1], made]), references=[0])
        simulation = Simulation(
            mesh=finite_elements(), displacement=np.stack([0 * field, field]), times=np.array([0, 4e-3])
        )
        comparison = Comparison(result, simulation, PLACEMENT)
        fits = [one.fit for one in comparison.iterate()]
        scale, std = comparison.best_scale(fits)
        pulls.append((scale - 1.05) / std)
        alone += [(fit.scale - 1.05) / fit.scale_std for fit in fits]
    assert comparison.frames == (1, 2, 3, 4)
    assert 0.75 < np.sqrt(np.mean(np.square(pulls))) < 1.3
    assert 0.85 < np.sqrt(np.mean(np.square(alone))) < 1.2


def test_the_uncertain_scale_of_the_image_counts_as_one_factor(tmp_path):
    field, random = stretch(), np.random.default_rng(3)
    placement = Placement.fit(PLACEMENT.pairs + random.normal(0, 1.5, PLACEMENT.pairs.shape) * [0, 0, 1, 1])
    simulation = Simulation(mesh=finite_elements(), displacement=field[None])
    relative = Comparison(measured(tmp_path / "a", field[None]), simulation, placement).relative_std
    assert relative == placement.mm_per_pixel_std / placement.mm_per_pixel > 1e-3
    factors = 1 + relative * random.normal(size=60)
    comparison = compared(measured(tmp_path / "b", factors[:, None, None] * field, std=1e-4), field)
    comparison.relative_std = relative
    frames = list(comparison.iterate())
    agreements = [made.agreement["nodes", "displacement"] for made in frames]
    assert np.mean([one.chi_square for one in agreements]) == pytest.approx(1, abs=0.5)
    assert agreements[0].degrees_of_freedom < 1.5  # all differences are the same factor
    assert [made.fit.scale_std for made in frames] == pytest.approx([relative] * 60, rel=0.05)


def test_a_linear_field_is_levelled_to_itself_and_one_of_the_mesh_to_its_recovery():
    random = np.random.default_rng(0)
    linear = OTHER.nodes @ random.normal(size=(2, 2)) + random.normal(size=2)
    reached = np.isfinite(found := Levelling(MESH, OTHER)(linear)).all(axis=0)
    expected = np.linalg.lstsq(np.c_[OTHER.nodes, np.ones(len(OTHER.nodes))], linear, rcond=None)[0]
    assert 0.3 < reached.mean() < 1
    assert found.T[reached] == pytest.approx((np.c_[MESH.nodes, np.ones(NODES)] @ expected)[reached], abs=1e-6)
    field = random.normal(size=(NODES, 2))
    everywhere = np.ones(len(MESH.elements), dtype=bool)
    recovery = Recovery.over(MESH, everywhere)
    assert pytest.approx(recovery.value @ field, abs=1e-9) == Levelling(MESH, MESH)(field).T


def test_a_finer_simulation_is_levelled_to_what_least_squares_makes_of_it():
    """Naive twin: a dense fit to many points within the mesh, then the recovery."""
    fine = Tri3Mesh.from_region(Region.from_rectangle((5, 5, 215, 175), (200, 240)), 6)
    wave = np.stack([np.sin(fine.nodes[:, 0] / 12), np.cos(fine.nodes[:, 1] / 15)], axis=1)
    y, x = np.mgrid[10.5:170, 10.5:210]
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    drawn, coarse = (Triangulation(*mesh.nodes.T, mesh.elements) for mesh in (fine, MESH))
    seen = np.stack([LinearTriInterpolator(drawn, part)(*points.T).filled(0) for part in wave.T], axis=1)
    hats = np.stack([LinearTriInterpolator(coarse, one)(*points.T).filled(0) for one in np.eye(NODES)], axis=1)
    fitted = np.linalg.solve(hats.T @ hats, hats.T @ seen)
    everywhere = np.ones(len(MESH.elements), dtype=bool)
    recovery = Recovery.over(MESH, everywhere)
    off = Levelling(MESH, fine)(wave).T - recovery.value @ fitted
    assert np.sqrt(np.mean(off**2)) < 0.004  # of an amplitude of 1: the quadrature's error


def test_a_rigid_motion_is_stated_and_taken_off(tmp_path):
    field, angle = stretch(bend=0), 1e-3  # levelling changes nothing of a linear field
    points = PLACEMENT.to_mm(MESH.nodes)
    x, y = (points - points.mean(axis=0)).T
    moved = field + 0.03 + angle * np.stack([-y, x], axis=1)
    result = measured(tmp_path / "r", moved + noise(30))
    kept, taken = (list(compared(result, field, remove_rigid=one).iterate()) for one in (False, True))
    pulls = [(made.fit.rigid - [0.03, 0.03, np.degrees(angle)]) / made.fit.rigid_std for made in kept]
    assert 0.85 < np.sqrt(np.mean(np.square(pulls))) < 1.2
    assert kept[0].agreement["nodes", "displacement"].chi_square > 100
    squares = [made.agreement["levelled", "displacement"].chi_square for made in taken]
    assert np.mean(squares) == pytest.approx(1, abs=0.025)


def test_a_simulation_of_another_shape_has_no_scale_without_a_word(tmp_path):
    result = measured(tmp_path / "r", stretch()[None] + noise(1))
    right, wrong = (compared(result, 0.9 * stretch(bend=bend)) for bend in (0.05, 0.5))
    assert "the shape differs" not in scale_text(right, [right.frame(0)])
    assert "; the shape differs (chi-square of what is left: " in scale_text(wrong, [wrong.frame(0)])


def test_nodes_without_data_are_left_out_and_so_is_their_strain(tmp_path):
    field = stretch()
    field[7] = np.nan
    frames = np.stack([field, np.full(field.shape, np.nan)]) + noise(2)
    made, blank = compared(measured(tmp_path / "r", frames), stretch()).iterate()
    assert np.isnan(blank.fit.scale)
    assert blank.agreement["levelled", "displacement"].values == 0
    assert np.flatnonzero(np.isnan(made.ratio("levelled", "u"))).tolist() == [7]
    around = MESH.adjacent_nodes(np.arange(NODES) == 7)
    assert np.isnan(made.ratio("nodes", "eyy")).tolist() == around.tolist()
    assert made.agreement["nodes", "displacement"].values == 2 * (NODES - 1)


def write_state(path: Path, displacement: np.ndarray, mesh: FiniteElementMesh | None = None) -> None:
    mesh = mesh or finite_elements()
    points, values = (np.c_[part, np.zeros(len(part))] for part in (mesh.points, displacement))
    fields = {"node_number": mesh.node_numbers, "U": values}
    meshio.Mesh(points, [("triangle", mesh.elements)], point_data=fields).write(path)


@pytest.fixture
def states(tmp_path: Path) -> Path:
    """A folder of two states as files, as .pvd, and as a table."""
    folder = tmp_path / "simulated"
    folder.mkdir()
    field, mesh = stretch(), finite_elements()
    sets = ""
    for number in (0, 4):
        write_state(folder / f"step_{number}.vtu", number * field)
        sets += f'<DataSet timestep="{number * 1e-3}" file="step_{number}.vtu"/>'
    (folder.parent / "all.pvd").write_text(
        f"<VTKFile><Collection>{sets}</Collection></VTKFile>".replace('file="', 'file="simulated/')
    )
    rows = [
        f"{number},{t},{u},{v}"
        for t in (0, 4)
        for number, (u, v) in zip(mesh.node_numbers.tolist(), (1e3 * t * field).tolist(), strict=True)
    ]
    (folder.parent / "table.csv").write_text("\n".join(["node,time_ms,u_um,v_um", *rows]))
    return folder


@pytest.mark.parametrize("name", ["simulated", "all.pvd", "table.csv"])
def test_a_simulation_is_read_with_its_times_and_interpolated(states, name):
    interval = 1e-3 if name == "simulated" else None
    read = Simulation.read(states.parent / name, mesh=finite_elements(), interval=interval, offset=0.5)
    assert read.times == pytest.approx([0.5, 0.504])
    assert read.interpolate(0.501) == pytest.approx(stretch(), abs=1e-9)
    assert read.mesh.node_numbers.tolist() == finite_elements().node_numbers.tolist()


@pytest.mark.parametrize("numbers", [(0.25, 0.5, 0.75), (-0.5, 0, 0.25, 1), (9, 10, 11)])
def test_signs_and_fractions_in_the_names_of_states_count(tmp_path, numbers):
    for number in numbers:
        write_state(tmp_path / f"plate_{number}.vtu", number * stretch())
    read = Simulation.read(tmp_path, interval=2.0)
    assert read.times.tolist() == [2.0 * number for number in numbers]
    assert read.interpolate(2.0 * numbers[1]) == pytest.approx(numbers[1] * stretch(), abs=1e-9)


def test_what_may_be_meant_otherwise_is_stated(tmp_path, states, caplog):
    table = states.parent / "table.csv"
    mesh = finite_elements()
    meshio.Mesh(np.c_[mesh.points, 0 * mesh.points[:, :1]], [("triangle", mesh.elements)]).write(tmp_path / "plain.vtu")
    counted = tmp_path / "counted.csv"
    counted.write_text("node,u,v\n0,1,1\n1,2,2\n")
    Simulation.read(counted, mesh=read_mesh(tmp_path / "plain.vtu"))
    assert "are counted from 0 in the order of the file" in caplog.text
    table.write_text(table.read_text().replace("node,time_ms,", "node,step,"))
    with pytest.raises(InputError, match=r"two rows or more for node 100 at one time: several states need a time_s"):
        Simulation.read(table, mesh=mesh)
    result = measured(tmp_path / "r", np.arange(3)[:, None, None] * stretch(), timed=False)
    Comparison(result, Simulation.read(states.parent / "all.pvd"), PLACEMENT)
    assert "have no times: their numbers count as the simulation's times" in caplog.text


def test_frames_beyond_the_times_of_the_simulation_are_left_out_and_those_asked_for_refused(tmp_path, states):
    result = measured(tmp_path / "r", np.arange(7)[:, None, None] * stretch() + noise(7))
    simulation = Simulation.read(states.parent / "all.pvd", offset=1e-3)
    comparison = Comparison(result, simulation, PLACEMENT)
    assert (comparison.frames, comparison.frames_outside) == ((1, 2, 3, 4, 5), (0, 6))
    last = comparison.frame(3)
    assert np.median(last.measured["v"].values / last.simulated["nodes"]["v"]) == pytest.approx(1.5, rel=0.01)
    with pytest.raises(InputError, match=r"frame 6 is at 0\.006 s.* spans 0\.001 to 0\.005: state the `offset`"):
        Comparison(result, simulation, PLACEMENT, frames=[2, 6])
    with pytest.raises(InputError, match=r"the frames of .* are at 0 to 0\.006 s"):
        Comparison(result, Simulation.read(states.parent / "all.pvd", offset=1.0), PLACEMENT)


POINTS = [part for pair in PLACEMENT.pairs.tolist() for part in ("--points", "{},{}:{},{}".format(*pair))]


def test_the_command_writes_what_it_found_with_the_simulation_s_numbers(tmp_path, states, capsys):
    result = measured(tmp_path / "r", np.arange(5)[:, None, None] * 1.03 * stretch() + noise(5))
    out = tmp_path / "out"
    command = ["compare", str(result.path), "--fe", str(states.parent / "all.pvd"), "--out", str(out), *POINTS]
    command += ["--frames", "3"]
    assert execute(cli.app, command) == 0
    assert "1.03" in capsys.readouterr().out
    assert {file.suffix for file in out.iterdir()} == {".html", ".csv", ".pvd", ".vtu"}
    assert "<h2>Warnings</h2>" in (out / "comparison.html").read_text()
    written = read_mesh(out / "comparison_000003.vtu")
    made = Comparison(
        result, Simulation.read(states.parent / "all.pvd"), find_placement(result, point_pairs=PLACEMENT.pairs.tolist())
    ).frame(3)
    assert written.node_numbers.tolist() == finite_elements().node_numbers.tolist()
    assert written.fields["displacement"][:, 0] == pytest.approx(made.measured["u"].values)
    assert written.fields["displacement_ratio_levelled"][:, 1] == pytest.approx(made.ratio("levelled", "v"))
    again = Simulation.read(out / "comparison.pvd")  # the measurement, as a simulation's boundary conditions
    assert again.displacement[0][:, 1] == pytest.approx(made.measured["v"].values)
    head, row, *_ = (out / "comparison.csv").read_text().splitlines()
    assert head.startswith("frame,number,time_s,way,quantity,unit,values,mean,rms,std,beyond_2,chi_square,")
    one = made.agreement["nodes", "displacement"]
    assert row.startswith(f"3,3,0.003,nodes,displacement,mm,{one.values},{one.mean:.9g}")
    assert (out / "scale.csv").read_text().splitlines()[1].startswith(f"3,3,0.003,{made.fit.scale:.9g},")
    assert execute(cli.app, command) == 2
    assert "is already there" in capsys.readouterr().err


def test_a_result_of_mesh_file_is_compared_by_number_where_the_simulation_has_another_order(tmp_path):
    mesh = finite_elements(name=str(tmp_path / "plate.vtu"))
    write_state(tmp_path / "plate.vtu", stretch(), mesh)
    options = {"labels": labels_of(mesh, PLACEMENT), "references": [0]}
    result = measured(tmp_path / "r", np.stack([0 * stretch(), stretch()]), **options)
    order = np.random.default_rng(0).permutation(NODES)
    rows = [f"{mesh.node_numbers[i]},{stretch()[i, 0]},{stretch()[i, 1]}" for i in order]
    (tmp_path / "t.csv").write_text("\n".join(["node,u_mm,v_mm", *rows]))
    simulation = Simulation.read(tmp_path / "t.csv", mesh=measured_mesh(result))
    made = Comparison(result, simulation, find_placement(result)).frame(1)
    assert np.abs(made.difference("nodes", "u")).max() < 1e-9
    assert np.abs(made.ratio("nodes", "v")).max() < 1e-6
    (tmp_path / "t.csv").write_text("\n".join(["node,u_mm,v_mm", *rows, rows[3]]))
    with pytest.raises(InputError, match=f"two rows or more for node {mesh.node_numbers[order[3]]} at one time"):
        Simulation.read(tmp_path / "t.csv", mesh=measured_mesh(result))


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("node,u_mm,v_mm", "100,1,2"),
        ("v_mm,node,u_mm", "2,100,1"),
        ("node,UY_um,time_ms,ux", "100,2000,7,1"),
        ("u2,w_mm,u_1,node", "2,3,1,100"),
    ],
)
def test_the_columns_of_a_table_are_taken_by_their_names(tmp_path, header, row):
    (tmp_path / "t.csv").write_text(f"{header}\n{row}")
    read = Simulation.read(tmp_path / "t.csv", mesh=finite_elements())
    assert read.displacement[0, 0].tolist() == [1, 2]
    assert read.times is None or read.times.tolist() == [0.007]


@pytest.mark.parametrize(
    "header", ["node,u_mm,u_mm", "node,v_mm,uy", "node,u_mm,v_mm,ux", "node,u,v,node", "node,u,v,time_s,time_ms", "u,v"]
)
def test_each_column_of_a_table_must_be_there_once(tmp_path, header):
    (tmp_path / "t.csv").write_text(f"{header}\n1,1,1,1,1")
    with pytest.raises(InputError, match='one column each "node", "u_mm" and "v_mm"'):
        Simulation.read(tmp_path / "t.csv", mesh=finite_elements())


def test_nodes_on_two_sides_of_a_crack_are_told_apart_by_their_numbers(tmp_path):
    cracked = Tri3Mesh.from_region(Region.from_rectangle((10, 10, 210, 170), (200, 240)), 20, [[(0, 95), (110, 95)]])
    assert len(cracked.copies) > 2
    mesh = finite_elements(cracked, str(tmp_path / "plate.vtu"))
    jump = 0.02 * np.isin(
        np.arange(len(cracked.nodes)), cracked.elements[cracked.nodes[cracked.elements].mean(axis=1)[:, 1] < 95]
    )
    field = np.stack([0 * jump, jump], axis=1)
    order = np.random.default_rng(0).permutation(len(jump))
    place_of = np.argsort(order)
    shuffled = FiniteElementMesh(
        name=mesh.name,
        points=mesh.points[order],
        node_numbers=mesh.node_numbers[order],
        elements=place_of[mesh.elements],
        element_numbers=mesh.element_numbers,
    )
    write_state(tmp_path / "plate.vtu", field[order], shuffled)
    count, known = len(jump), {"labels": labels_of(mesh, PLACEMENT), "references": []}

    def record(index: int) -> FrameRecord:
        u, v = PLACEMENT.vectors_to_px(mesh.points, field).T
        stated = {"u_std": np.full(count, STD), "v_std": np.full(count, STD)}
        return FrameRecord.from_values(nodes=count, lights=3, number=index, status=0, u=u, v=v, **stated)

    options = {"nodes": cracked.nodes, "elements": cracked.elements, **known}
    result = make_result(tmp_path / "r", frames=1, record=record, **options)
    made = Comparison(result, Simulation.read(tmp_path / "plate.vtu"), find_placement(result)).frame(0)
    assert np.abs(made.difference("nodes", "v")).max() < 1e-8


def no_points(arguments: list[str]) -> None:
    del arguments[5:]


def option(*words: str) -> Callable[[list[str]], None]:
    return lambda arguments: arguments.extend(words)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (no_points, "is not known: state two points or more, each in mm and in px (--points)"),
        (option("--points", "1,2"), "--points is X_MM,Y_MM:X_PX,Y_PX, such as"),
        (option("--frames", "99"), "there is no frame 99"),
        (option("--frames", "1,0"), "is of the reference, against which nothing has moved"),
        (option("--frames", "a"), "--frames are indices and ranges"),
        (option("--rigid", "keep"), '--rigid is tell or remove, not "keep"'),
        (option("--fe", "missing.vtu"), "missing.vtu"),
        (option("--fe", "{}"), "the times of the files"),
        (option("--fe", "{}", "--interval", "-1"), "the times of the files"),
        (option("--fe", "{}/step_4.vtu", "--field", "V"), 'no nodal vector "V" (--field); its nodal data: U (3,)'),
        (option("--fe", "{}/../table.csv"), "state the --mesh that they belong to"),
        (option("--offset", "7"), "state the --offset between both clocks"),
        (option("--unit", "yard"), "yard"),
        (option("--interval", "1"), "--interval is the time between the files of a folder"),
        (option("--fe", "{}/step_4.vtu", "--offset", "7"), "--offset shifts the times of several states"),
        (option("--mesh", "{}/step_4.vtu"), "--mesh is for a .csv with numbers of nodes"),
        (option("--fe", "{}/../table.csv", "--field", "U"), "--field names a field of a mesh file"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_a_line_and_nothing_is_written(tmp_path, states, capsys, change, message):
    result = measured(tmp_path / "r", np.arange(3)[:, None, None] * stretch(), references=[0])
    out = tmp_path / "out"
    arguments = ["compare", str(result.path), f"--out={out}", "--fe", str(states.parent / "all.pvd"), *POINTS]
    change(arguments)
    assert execute(cli.app, [part.replace("{}", str(states)) for part in arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not out.exists()
