"""Sparse normal equations of a mesh: assembly, rigid motions of the lights, and what a fit leaves over.

Sums per element are assembled into matrices and vectors with two unknowns a node.

With the nodal displacement u, the rigid coefficients beta and the Hessian M_j of light j, the equations are bordered:
``[[M + H, B], [B^T, C]]`` with ``M = sum M_j``, ``B = [M_2 R, M_3 R, ...]``, ``C = diag(R^T M_j R)`` and the hold H,
the weak smoothness that carries unseen nodes along. To a unit of beta the displacement answers by ``-X``,
``X = (M + H)^-1 B``, so that light j moves by ``D_j = E_j - X``, with E_j the light's own functions R. The Schur
complement ``C - B^T X = sum D_j^T M_j D_j + X^T H X`` is the information on beta of the images and of the hold.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.linalg import eigh

from rgbmidic._kernels.correlation import element_block_products, element_hessian
from rgbmidic._kernels.owned_pixels import interpolate_nodal
from rgbmidic.correlation.constants import SolverConstants
from rgbmidic.correlation.elimination import Elimination
from rgbmidic.correlation.images import apply_prefilter
from rgbmidic.mesh import PixelMap, Tri3Mesh
from rgbmidic.mesh.pixel_map import window_means
from rgbmidic.mesh.tri3 import with_data
from rgbmidic.typing import BoolArray, FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class Assembly:
    """Sparse structure shared by all frames: the unknowns are (u, v) of node 0, (u, v) of node 1, and so on.

    Attributes
    ----------
    entries : csc_matrix, shape (nonzeros, 27 E)
        Sums element blocks into the data of the assembled matrix.
    unknowns, node_entries : ndarray, shape (6 E,), (9 E,)
        Number of each entry of element vectors, and of three values at the corners, in those of the nodes.
    smoothness : csc_matrix, shape (2 N, 2 N)
        Graph Laplacian of the mesh for u and v, rows summing to zero, unit mean diagonal; in the structure of the
        assembled matrices.
    diagonal : ndarray
        The unit matrix's data in it.
    nodal_area : ndarray, shape (N,), float64
        A third of the area of the elements around each node, square px.
    elimination : Elimination
        Of the assembled matrices.
    """

    entries: sp.csc_matrix
    unknowns: npt.NDArray[np.int64]
    node_entries: npt.NDArray[np.int64]
    smoothness: sp.csc_matrix
    diagonal: FloatArray
    nodal_area: FloatArray
    elimination: Elimination

    @classmethod
    def from_mesh(cls, mesh: Tri3Mesh) -> Assembly:
        """Structure of the equations of a mesh."""
        count, corners = len(mesh.nodes), mesh.elements.astype(np.int64)
        keys, pair = np.unique(corners[:, None, :] * count + corners[:, :, None], return_inverse=True)
        row, column = keys % count, keys // count
        degree = np.bincount(column)
        ahead = np.cumsum(degree) - degree
        component = np.arange(2)
        indptr = np.append(4 * ahead[:, None] + 2 * degree[:, None] * component, 4 * len(keys)).astype(np.int32)
        # the entry of each pair of nodes, its component in the row, its component in the column
        slots = 2 * (np.arange(len(keys)) + ahead[column])[:, None, None] + component[:, None]
        slots = slots + 2 * degree[column, None, None] * component
        indices, smooth, diagonal = np.empty(slots.size, dtype=np.int32), np.zeros(slots.size), np.zeros(slots.size)
        indices[slots] = (2 * row[:, None] + component)[:, :, None]
        smooth[slots[:, component, component]] = (np.where(row == column, degree[row] - 1, -1) / (degree - 1).mean())[
            :, None
        ]
        diagonal[slots[row == column][:, component, component]] = 1
        # each entry of the element blocks counts in one, two (xy and yx) and one entry of the matrix
        rows, starts = slots[pair].ravel(), np.append(0, np.cumsum(np.tile([1, 2, 1], 9 * len(corners))))
        return cls(
            entries=sp.csc_matrix((np.ones(rows.size), rows, starts), shape=(slots.size, starts.size - 1)),
            unknowns=(2 * corners[..., None] + component).ravel(),
            node_entries=(3 * corners[..., None] + np.arange(3)).ravel(),
            smoothness=sp.csc_matrix((smooth, indices, indptr), shape=(2 * count, 2 * count)),
            diagonal=diagonal,
            nodal_area=mesh.to_nodes(mesh.areas / 3),
            elimination=Elimination.of_pairs(row, column, slots),
        )

    @property
    def size(self) -> int:
        """Number of unknowns, twice the number of nodes."""
        return self.smoothness.shape[0]

    def matrix(self, blocks: FloatArray, more: FloatArray | float = 0.0) -> sp.csc_matrix:
        """Assemble element blocks (E, 3, 3, 3), last axis (xx, xy, yy), into a symmetric matrix (2 N, 2 N).

        `more` is added to its data.
        """
        return with_data(self.smoothness, self.entries @ blocks.ravel() + more)

    def factorise(self, matrix: sp.csc_matrix) -> Callable[[FloatArray], FloatArray]:
        """Factorise such a matrix, positive definite; see `Elimination.factorise`."""
        return self.elimination.factorise(matrix.data)

    def node_blocks(self, blocks: FloatArray) -> FloatArray:
        """Entries xx, xy, yy (3, N) of the nodes' own blocks in that matrix."""
        return np.ascontiguousarray(self.at_nodes(np.einsum("eaad->ead", blocks)).T)

    def at_nodes(self, corner_values: FloatArray) -> FloatArray:
        """Sum three values at the corners of the elements (E, 3, 3) at the nodes, (N, 3)."""
        sums = np.bincount(self.node_entries, weights=corner_values.ravel(), minlength=self.size // 2 * 3)
        return np.asarray(sums, dtype=np.float64).reshape(-1, 3)

    def vector(self, corner_values: FloatArray) -> FloatArray:
        """Assemble element vectors (E, 3, 2) into a vector (2 N,)."""
        return np.asarray(
            np.bincount(self.unknowns, weights=corner_values.ravel(), minlength=self.size), dtype=np.float64
        )


_RIGID_FUNCTIONS = {"none": 0, "translation": 2, "translation+rotation": 3}
"""Number of rigid functions of a light."""


def rigid_functions(nodes: FloatArray, rigid: str) -> FloatArray:
    """Nodal values (2 N, m) of the rigid motions: shifts in x and y (px), rotation (rad) about the mesh's middle."""
    arm = nodes - nodes.mean(axis=0)
    columns = np.zeros((len(nodes), 2, 3))
    columns[:, 0, 0] = columns[:, 1, 1] = 1
    columns[:, 0, 2], columns[:, 1, 2] = -arm[:, 1], arm[:, 0]
    return columns.reshape(-1, 3)[:, : _RIGID_FUNCTIONS[rigid]]


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidMotions:
    """The rigid unknowns of one pass: K = (k - 1) m coefficients, light after light, m functions each.

    Attributes
    ----------
    response : ndarray, shape (2 N, K)
        X: the displacement follows a unit of each coefficient by its negative.
    relative_modes : ndarray, shape (k, 2 N, K)
        D: what each light moves by then.
    coupling : ndarray, shape (2 N, K)
        ``B + H X``: what a displacement takes from the right-hand sides of the coefficients.
    inverse : ndarray, shape (K, K)
        Of the Schur complement without smoothness, in the directions that the images show, else 0.
    unobservable : ndarray, shape (k,), bool
        Lights with a weight whose rigid motion the images do not show: they share no texture with the first light,
        directly or through others.
    """

    response: FloatArray
    relative_modes: FloatArray
    coupling: FloatArray
    inverse: FloatArray
    unobservable: BoolArray

    @classmethod
    def eliminate(
        cls,
        assembly: Assembly,
        per_light: Sequence[FloatArray],
        functions: FloatArray,
        hold: sp.csc_matrix,
        solve: Callable[[FloatArray], FloatArray],
        textured: BoolArray,
    ) -> RigidMotions:
        """Find the equations of the rigid unknowns that are left when the displacement is eliminated.

        Parameters
        ----------
        assembly
            Of the mesh.
        per_light
            Element blocks (E, 3, 3, 3) of the Hessian of each of the k lights.
        functions : ndarray, shape (2 N, m)
            Rigid functions.
        hold : csc_matrix, shape (2 N, 2 N)
            H.
        solve
            Solves with ``M + H`` for (2 N, K).
        textured : ndarray, shape (E,), bool
            Elements with texture enough: what noise alone shows elsewhere counts for nothing.
        """
        lights, count = len(per_light), functions.shape[1]
        unit_modes = np.zeros((lights, lights - 1, len(functions), count))
        unit_modes[np.arange(1, lights), np.arange(lights - 1)] = functions
        modes = unit_modes.transpose(0, 2, 1, 3).reshape(lights, len(functions), -1)
        border = np.sum(
            [assembly.matrix(blocks) @ mode for blocks, mode in zip(per_light, modes, strict=True)],
            axis=0,
        )
        response = solve(border)
        relative_modes, held = modes - response, hold @ response

        def energy(elements: BoolArray) -> FloatArray:
            """``sum D_j^T M_j D_j`` over the chosen elements (E,)."""
            hessians = (assembly.matrix(blocks * elements[:, None, None, None]) for blocks in per_light)
            return np.asarray(
                sum(motion.T @ (hessian @ motion) for hessian, motion in zip(hessians, relative_modes, strict=True))
            )

        everywhere = energy(np.ones_like(textured))
        border_diagonal = np.einsum("jnc,nc->c", modes, border)  # diagonal of C
        unit = np.sqrt(np.where(border_diagonal > 0, border_diagonal, 1.0))
        scale = unit[:, None] * unit
        total_energy = (everywhere + response.T @ held) / scale
        # a complement under it is rounding (1e-13), or the hold of a constant between two bodies (1e-9)
        rounding = 1e-9
        observability, directions = eigh(energy(textured) / scale, total_energy + rounding * np.eye(len(unit)))
        # the images have .998 or more of it where lights see within one element of one another, .02 or less an element
        # further apart (measured): the rest is the hold's, which holds no data
        is_observable = observability > 0.5
        observable = directions[:, is_observable] / unit[:, None]
        unknown = directions[:, ~is_observable] * (border_diagonal > 0)[:, None]
        unknown = unknown / np.maximum(np.linalg.norm(unknown, axis=0), 1e-300)
        participation = (unknown**2).sum(axis=1).reshape(lights - 1, count).sum(axis=1)
        return cls(
            response=response,
            relative_modes=relative_modes,
            coupling=border + held,
            inverse=observable @ np.linalg.inv(observable.T @ everywhere @ observable) @ observable.T,
            # the lights' fractions of a motion add up to 1: of up to ten lights one is named at least
            unobservable=np.append(False, participation > 0.1),
        )

    def increment(self, free: FloatArray, held_side: FloatArray, rigid_side: FloatArray) -> FloatArray:
        """Increment (K,) of the coefficients, which the smoothness of nodes without data has no part in.

        The smoothness would pull the lights together where none sees both sides: what it does to the displacement,
        `held_side` (2 N,) and H times the increment, is taken out of the coefficients' own equations.

        Parameters
        ----------
        free : ndarray, shape (2 N,)
            Increment of the displacement with the coefficients as they are.
        held_side : ndarray, shape (2 N,)
            The smoothness' part of its right-hand side.
        rigid_side : ndarray, shape (K,)
            Right-hand side of the coefficients.
        """
        return np.asarray(self.inverse @ (rigid_side - self.coupling.T @ free + self.response.T @ held_side))


_MIN_RESIDUAL_LEVERAGE = 0.05
"""Fraction below which the residual holds no information on the noise: a region of one block (elements of 4 px leave
.1)."""


def mean_residual_leverage(
    mesh: Tri3Mesh,
    pixels: PixelMap,
    assembly: Assembly,
    images: tuple[FloatImage, FloatImage],
    prefilter: str,
    constants: SolverConstants,
) -> float | FloatArray:
    """Return the fraction of the variance of a block's score that a fit of the displacement to noise leaves.

    The residual is the noise less its projection P on the columns ``J = grad f phi`` of the least-squares problem. The
    score of block b is the product with ``c = grad f 1_b``, so ``1 - |P c|^2 / |c|^2`` of its variance is left, with
    ``|P c|^2 = (J^T c)^T (J^T J)^-1 (J^T c)``; the mean over the blocks is returned. Blocks apart are projected
    together, with random signs. It falls from 0.85 for elements of 40 px to 0.1 for 4 px, and is not known (NaN) where
    nothing is left, in a region of about one block.

    That holds for white noise. A prefilter takes more of ``(1 - P) c``, which are the edges of the blocks, than of
    ``J (J^T J)^-1 z``, by which noise moves the nodes: the fraction is multiplied by the ratio of what it passes.

    On a graded mesh it is taken around each element, (E,): each node has its part of both products, and they are summed
    over the window in which the scores are averaged.

    Parameters
    ----------
    mesh, pixels, assembly
        The mesh, its pixels and equations.
    images : ndarray, shape (2, k, P), (k, P), float32
        Gradients and weights of the reference.
    prefilter
        Of the images.
    constants
        Of the solve.
    """
    side = constants.merged_block_side(mesh.size, pixels.bounds[2:])
    rows, columns = pixels.grid(side)
    # of 700 blocks the random signs keep the projections apart to half a per cent of the fraction (derived)
    stride = int(np.clip(np.ceil(2 * np.sqrt(700 / (rows * columns))), 2, 4))
    sign = np.random.default_rng(0).choice(np.array([-1, 1], dtype=np.float32), (rows, columns))
    first_row, first_column, _, _ = pixels.bounds
    pixel_geometry = pixels.runs, pixels.run_offsets, pixels.origin - (first_column, first_row), pixels.barycentric
    hessian, products = np.zeros((len(pixels.origin), 3, 3, 3)), np.zeros((stride**2, len(pixels.origin), 3, 3))
    light_hessian = np.empty_like(hessian)
    for gx, gy, weight in zip(*images[0], images[1], strict=True):
        element_hessian(gx, gy, weight, *pixels.positions, light_hessian)
        hessian += light_hessian
        element_block_products(gx, gy, weight, *pixel_geometry, sign, side, stride, products)
    total = float(hessian[..., (0, 2)].sum())
    if not total:
        return 1.0
    projected = []
    for xx_to_yy in map(assembly.at_nodes, products):
        projected += [xx_to_yy[:, :2].ravel(), xx_to_yy[:, 1:].ravel()]
    sides, anchor = np.stack(projected, axis=1), 1e-6 * total / assembly.size  # holds unknowns without texture
    solve = assembly.factorise(assembly.matrix(hessian, anchor * assembly.diagonal))
    solutions, ratio = solve(sides), 1.0
    if prefilter != "none":
        inner = ~mesh.on_boundary | mesh.on_boundary.all()
        unit = np.zeros((len(mesh.nodes), 2, 2))
        unit[:, [0, 1], [0, 1]] = inner[:, None] * np.random.default_rng(0).choice([-1.0, 1.0], mesh.nodes.shape)
        nodal_noise = solve(unit.reshape(-1, 2)).T
        fitted = solutions.reshape(-1, stride**2, 2).sum(axis=1).T
        sign = pixels.from_blocks(sign[None], side, cv2.INTER_NEAREST)[0]
        shared_arguments = mesh, pixels, images, prefilter
        passed = [
            (
                _passed(*shared_arguments, fitted[a], (sign * (1 - a), sign * a)),
                _passed(*shared_arguments, nodal_noise[a]),
            )
            for a in (0, 1)
        ]
        ratio = float(np.sqrt(np.prod([residual / motion for residual, motion in passed])))
    if not mesh.is_graded:
        fraction = 1 - float((sides * solutions).sum()) / total
        return ratio * fraction if fraction > _MIN_RESIDUAL_LEVERAGE else float("nan")
    fitted = (sides * solutions).reshape(len(mesh.nodes), -1).sum(axis=1)
    element_texture = np.ascontiguousarray(hessian[..., (0, 2)].sum(axis=(2, 3)).ravel())
    nodal_texture = np.bincount(mesh.elements.ravel(), weights=element_texture, minlength=len(mesh.nodes))
    limits = np.array([side * rows, side * columns]) - 1
    row, column = (np.clip(mesh.nodes[:, ::-1] - (first_row, first_column), 0, limits) // side).astype(int).T
    block_sums = [np.bincount(row * columns + column, values, rows * columns) for values in (fitted, nodal_texture)]
    smoothed_grids = window_means(np.reshape(block_sums, (2, rows, columns)), constants.score_range / side)
    centre = mesh.centres[:, ::-1] - (first_row, first_column)
    row, column = (np.clip(centre, 0, limits) // side).astype(int).T
    local_texture = np.maximum(smoothed_grids[1][row, column], np.finfo(float).tiny)
    local = 1 - smoothed_grids[0][row, column] / local_texture
    return np.where(local > _MIN_RESIDUAL_LEVERAGE, ratio * local, np.nan)


def _passed(
    mesh: Tri3Mesh,
    pixels: PixelMap,
    images: tuple[FloatImage, FloatImage],
    prefilter: str,
    nodal: FloatArray,
    blocks: tuple[FloatImage | float, FloatImage | float] = (0.0, 0.0),
) -> float:
    """Return the fraction of the energy of ``sqrt(w) grad f . d`` that a prefilter passes.

    The motion d is that of nodes (2 N,) less that of the `blocks` along x and y, (P,).
    """
    energy, passed, motion = 0.0, 0.0, np.empty((2, pixels.local_x.size), dtype=np.float32)
    interpolate_nodal(nodal.reshape(-1, 2), mesh.elements, *pixels.positions, motion)
    motion[0] -= blocks[0]
    motion[1] -= blocks[1]
    for gx, gy, weight in zip(*images[0], images[1], strict=True):
        image = gx * motion[0]
        image += gy * motion[1]
        image *= np.sqrt(weight)
        energy += cv2.norm(image, cv2.NORM_L2SQR)
        passed += cv2.norm(apply_prefilter(pixels.scatter(image), prefilter), cv2.NORM_L2SQR)
    return passed / energy if energy else 1.0
