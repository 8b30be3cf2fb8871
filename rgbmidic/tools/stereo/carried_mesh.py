"""The mesh of the left test, carried over to the right camera by one match of the reference states.

A node is then the same material point in both tests. The match is the package's own: the search and the solve on the
images of all lights, each camera's aligned by the registration of its own lens. Where the search has no success, since
the right camera sees the specimen farther away than it looks, initial guesses lie on the epipolar lines.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from rgbmidic.correlation import NodeStatus, Status, TrackingState
from rgbmidic.correlation.solution import rank
from rgbmidic.correlation.start import search_reach
from rgbmidic.errors import InputError
from rgbmidic.fields import NodalCovariance
from rgbmidic.illumination import IlluminationImages
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.mesh.recovery import quadratic_fit
from rgbmidic.pipeline import Plan, measure_frame
from rgbmidic.results import FrameRecord
from rgbmidic.results.warnings import collect_messages
from rgbmidic.settings import FrameSettings, MeshSettings, RegionSettings, SolverSettings, TestSettings, WeightSettings
from rgbmidic.tools.stereo.camera_pair import CameraPair, image_plane
from rgbmidic.typing import BoolArray, FloatArray, IntArray

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class CarryConstants:
    """Constants of `carry_mesh`.

    Attributes
    ----------
    margin
        Pixels from the edge of the right frame within which nodes are left out: the taps of the prefilter and of the
        interpolation (chosen).
    sufficient_fraction
        Nodes that the match must hold; below, guesses on the epipolar lines are tried, too (chosen: a region of which
        half is hidden from the right camera is still one).
    max_depths
        Depths that are tried at most (chosen: a depth is a match, which takes as long as a frame).
    min_jump, min_turn
        Change of the second difference of the match from a node to the next where a step lies between them, over its
        standard uncertainty (in noise once in a million) and over the largest second difference around: steps of .3 to
        7 px have 1.2 to 2, sharp bends up to 1, spheres and cylinders of 20 elements less than .5 (measured).
    """

    margin: float = 4.0
    sufficient_fraction: float = 0.5
    max_depths: int = 12
    min_jump: float = 5.0
    min_turn: float = 1.1


LIMITS = CarryConstants()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CarriedMesh:
    """The mesh of the left test in the right frame.

    Attributes
    ----------
    nodes : ndarray, shape (M,), int
        Indices in the left mesh of the nodes that are in the carried one.
    left, right : Tri3Mesh
        These nodes and the elements between them, in px of the left and of the right frame.
    region : Region
        Pixels of the right frame that the elements cover.
    right_std : ndarray, shape (M, 2)
        Standard uncertainty of the nodes in the right frame, px.
    warnings : tuple of str
        Doubts about the match.
    """

    nodes: IntArray
    left: Tri3Mesh
    right: Tri3Mesh
    region: Region
    right_std: FloatArray
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _ReferencePair:
    """A frame source of both cameras' reference states."""

    states: tuple[IlluminationImages, IlluminationImages]

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> IlluminationImages:
        return self.states[index]


def carry_mesh(
    images: tuple[IlluminationImages, IlluminationImages],
    mesh: Tri3Mesh,
    *,
    pair: CameraPair | None = None,
    right_region: Region | None = None,
    solver: SolverSettings | None = None,
) -> CarriedMesh:
    """Find the nodes of the left test in the right camera's reference.

    Parameters
    ----------
    images
        Reference states of the left and of the right camera, one image per light in the same order.
    mesh
        Mesh of the left test, px of the left frame.
    pair
        The cameras, for initial guesses on the epipolar lines; None: the search alone.
    right_region
        Pixels of the right frame outside of which nodes are left out; None: the whole frame.
    solver
        Settings of the solve; None: the defaults.

    Returns
    -------
    CarriedMesh

    Raises
    ------
    InputError
        The cameras see different lights, or the images do not match.
    """
    if images[0].names != images[1].names:
        names = " and ".join(", ".join(state.names) for state in images)
        raise InputError(f"both cameras must see the same lights in the same order; theirs are {names}")
    right_shape = images[1].shape
    record = _match(images, mesh, pair, replace(solver or SolverSettings(), brightness="auto"))
    values = record.values
    displacement = np.stack([values["u"], values["v"]], axis=1).astype(np.float64)
    std = np.stack([values["u_std"], values["v_std"]], axis=1).astype(np.float64)
    matched = (values["node_status"] == NodeStatus.MEASURED) & np.isfinite(displacement + std).all(axis=1)
    if not matched.any():
        raise InputError(f"the references of both cameras do not match: {record.reason or 'no node is measured'}")
    positions = np.where(matched[:, None], mesh.nodes + displacement, -1.0)
    last_pixel = np.array(right_shape[::-1]) - 1.0
    inside = ((positions >= LIMITS.margin) & (positions <= last_pixel - LIMITS.margin)).all(axis=1) & matched
    if right_region is not None:
        column, row = np.clip(np.round(positions), 0, last_pixel).astype(int).T
        inside &= right_region.mask[row, column]
    is_carried = _connected(mesh, positions, inside)
    if not is_carried.any():
        raise InputError("no element of the left mesh lies in the right camera's region with all its nodes")
    submesh = mesh.submesh(is_carried)
    right = Tri3Mesh(nodes=positions[is_carried], elements=submesh.elements)
    warnings = []
    at_step = [_at_steps(mesh, matched, *component) for component in zip(displacement.T, std.T, strict=True)]
    if (doubtful := np.any(at_step, axis=0) & is_carried).any():
        (x0, y0), (x1, y1) = (bound(mesh.nodes[doubtful], axis=0) for bound in (np.min, np.max))
        warnings.append(
            f"elements lie across a step in depth, at {int(doubtful.sum())} nodes from ({x0:.0f}, {y0:.0f}) to "
            f"({x1:.0f}, {y1:.0f}) px of the left reference: shape and motion there are off by more than is stated; "
            "let the mesh end on both sides (mesh.cracks of the left test), or leave the edge out of the region"
        )
    if record.status == Status.NOT_CONVERGED:
        warnings.append(f"the match of the references did not converge everywhere and is taken: {record.reason}")
    if missing := int((~is_carried).sum()):
        warnings.append(
            f"{missing} of {len(is_carried)} nodes of the left mesh are not carried to the right camera "
            f"({int((~matched).sum())} without a match, the others outside its frame or region or beside such nodes): "
            "they have no data in three dimensions"
        )
    for text in warnings:
        logger.warning("%s", text)
    return CarriedMesh(
        nodes=np.flatnonzero(is_carried).astype(np.int64),
        left=submesh,
        right=right,
        region=right.region(right_shape),
        right_std=std[is_carried],
        warnings=tuple(warnings),
    )


def _at_steps(mesh: Tri3Mesh, matched: BoolArray, values: FloatArray, std: FloatArray) -> BoolArray:
    """Return the nodes (N,) of edges across a step in nodal values (N,).

    On one side of a step the second difference is the step, on the other its opposite. On a smooth surface it changes
    from node to node by little of its own size, and in errors by little of their uncertainty.
    """
    _, _, _, *second = quadratic_fit(mesh, np.asarray(matched[mesh.elements].all(axis=1)))
    ends, values, std = mesh.neighbours.T, np.where(matched, values, 0.0), np.where(matched, std, 0.0)
    x, y = (mesh.nodes[ends[1]] - mesh.nodes[ends[0]]).T
    squares = [sp.diags(factor) for factor in (x * x, 2 * x * y, y * y)]
    first, last = (sum(a @ b[end] for a, b in zip(squares, second, strict=True)) for end in ends)
    errors = (last - first) @ NodalCovariance.from_mesh(mesh).factor(std)
    change, uncertainty = np.abs((last - first) @ values), np.sqrt(errors.power(2).sum(axis=1).A1)
    largest = np.zeros(len(mesh.nodes))
    np.maximum.at(largest, ends, np.abs([first @ values, last @ values]))
    around = largest.copy()
    np.maximum.at(around, ends, largest[ends[::-1]])
    is_step = (change > LIMITS.min_jump * uncertainty) & (change > LIMITS.min_turn * around[ends].max(axis=0))
    at_step = np.zeros(len(mesh.nodes), dtype=bool)
    at_step[ends[:, is_step]] = True
    return at_step


def _connected(mesh: Tri3Mesh, positions: FloatArray, inside: BoolArray) -> BoolArray:
    """Return the nodes (N,) of elements whose nodes are all inside and that are not turned over by the match."""
    corners = positions[mesh.elements]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    # a wrong node turns an element over or makes it a sliver; what perspective does is far from it
    is_turned = inside[mesh.elements].all(axis=1) & (area < 0.05 * mesh.areas)
    usable = inside.copy()
    usable[mesh.elements[is_turned]] = False
    intact = usable[mesh.elements].all(axis=1)
    connected = np.zeros(len(mesh.nodes), dtype=bool)
    connected[mesh.elements[intact]] = True
    return connected


def _match(
    images: tuple[IlluminationImages, IlluminationImages],
    mesh: Tri3Mesh,
    pair: CameraPair | None,
    solver: SolverSettings,
) -> FrameRecord:
    """Match the right reference with the left one: by the search, else from guesses on the epipolar lines."""
    shape = np.maximum(images[0].shape, images[1].shape)
    first, second = (_padded(state.on_first_light(), shape) for state in images)
    settings = TestSettings(
        frames=FrameSettings(path=()),
        region=RegionSettings(rectangle=(0.0, 0.0, shape[1] - 1.0, shape[0] - 1.0)),
        mesh=MeshSettings(element_size=mesh.size),
        weights=WeightSettings(method="statistics"),
        solver=solver,
    )
    with collect_messages():  # doubts about the left reference: its own run reports them
        source = _ReferencePair((first, second))
        region = mesh.region((int(shape[0]), int(shape[1])))
        plan = Plan.from_settings(settings, source=source, mesh=mesh, region=region)
    best = measure_frame(plan, 1, TrackingState(displacement=None))
    guesses = iter(()) if pair is None else _on_epipolar_lines(pair, mesh.nodes)
    while (best.node_status == NodeStatus.MEASURED).mean() < LIMITS.sufficient_fraction:
        if (guess := next(guesses, None)) is None:
            break
        trial = measure_frame(plan, 1, TrackingState(displacement=guess))
        best = min(best, trial, key=lambda record: rank(int(record.status), record.node_status))
    return best


def _padded(images: IlluminationImages, shape: FloatArray) -> IlluminationImages:
    """Return the images with invalid pixels to the right and below, up to a shape."""
    missing = [(0, 0), *((0, int(side - length)) for side, length in zip(shape, images.shape, strict=True))]
    if not np.any(missing):
        return images
    values = np.pad(images.values, missing, constant_values=np.nan)
    valid = np.pad(images.valid, missing)
    return replace(images, values=values, valid=valid, reflection=None, displacement=None, texture=None)


def _on_epipolar_lines(pair: CameraPair, nodes: FloatArray) -> Iterator[FloatArray]:
    """Yield displacements (N, 2) from the left to the right frame of surfaces at several depths.

    A surface is a plane that faces both cameras alike. Its depths begin where the optical axes come nearest, and go on
    from there, nearer and farther, by steps that move the nodes in the right frame by as much as the search looks.
    """
    turn, shift = pair.poses[1]
    axis, right_centre = turn[2], -turn.T @ shift  # the right camera's axis and centre in the left one's axes
    # on the left axis, the point nearest to the right one: (0, 0, depth)
    across = np.eye(3) - np.outer(axis, axis)
    depth = float(across[2] @ right_centre / across[2, 2]) if across[2, 2] > 1e-6 else 10 * pair.baseline
    depth = depth if depth > 0 else 10 * pair.baseline
    normal = (np.array([0.0, 0.0, 1.0]) + axis) / np.linalg.norm(np.array([0.0, 0.0, 1.0]) + axis)
    rays = np.c_[image_plane(pair.left, nodes)[0], np.ones(len(nodes))]

    def displacement(distance: float) -> FloatArray:
        points = rays * (normal[2] * distance / (rays @ normal))[:, None]
        return pair.project(points)[1] - nodes

    middle = displacement(depth)
    motion = float(np.linalg.norm(np.nanmean(displacement(1.01 * depth) - middle, axis=0)))
    step = min(0.01 * search_reach(nodes) / max(motion, 1e-9), 0.5)  # relative depth that moves by one reach
    for number in range(LIMITS.max_depths):
        sign = 1 if number % 2 else -1
        guess = displacement(depth * (1 + step) ** (sign * ((number + 1) // 2)))
        if np.isfinite(guess).all():
            yield guess
