"""Rigid motions of the lights after the first: their functions, their equations, and whether the images show them.

With the nodal displacement u, the rigid coefficients beta and the Hessian M_j of light j, the equations are bordered:
``[[M + H, B], [B^T, C]]`` with ``M = sum M_j``, ``B = [M_2 R, M_3 R, ...]``, ``C = diag(R^T M_j R)`` and the hold H,
the weak smoothness that carries unseen nodes along. To a unit of beta the displacement answers by ``-X``,
``X = (M + H)^-1 B``, so that light j moves by ``D_j = E_j - X``, with E_j the light's own functions R. The Schur
complement ``C - B^T X = sum D_j^T M_j D_j + X^T H X`` is what the images say of beta and what the hold says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.linalg import eigh

from rgbmidic.correlation.assembly import Assembly
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["RigidMotions", "rigid_functions"]

_RIGID_FUNCTIONS = {"none": 0, "translation": 2, "translation+rotation": 3}
"""Number of rigid functions of a light."""
_SHOWN = 0.5
"""Fraction of its Schur complement that the images have of a rigid motion that is measured. The rest is the hold's,
which knows nothing of it. Lights that see within one element of one another leave .998 or more to the images, lights
an element further apart .02 or less (measured)."""
_ROUNDING = 1e-9
"""Fraction of ``R^T M_j R`` under which a Schur complement is rounding (1e-13), or the hold of a constant where there
is nothing else between two bodies (1e-9)."""
_NAMED = 0.1
"""Least part of a light in a motion that the images do not show, by which the light is named."""


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
    follows : ndarray, shape (2 N, K)
        X: the displacement follows a unit of each coefficient by its negative.
    moves : ndarray, shape (k, 2 N, K)
        D: what each light moves by then.
    pull : ndarray, shape (2 N, K)
        ``B + H X``: what a displacement takes from the right-hand sides of the coefficients.
    inverse : ndarray, shape (K, K)
        Of the Schur complement without smoothness, in the directions that the images show, else 0.
    hidden : ndarray, shape (k,), bool
        Lights with a weight whose rigid motion the images do not show: they share no texture with the first light,
        directly or through others.
    """

    follows: FloatArray
    moves: FloatArray
    pull: FloatArray
    inverse: FloatArray
    hidden: BoolArray

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
        """The rigid unknowns left when the displacement is eliminated.

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
        each = np.zeros((lights, lights - 1, len(functions), count))
        each[np.arange(1, lights), np.arange(lights - 1)] = functions
        own = each.transpose(0, 2, 1, 3).reshape(lights, len(functions), -1)
        border = np.sum([assembly.matrix(blocks) @ part for blocks, part in zip(per_light, own, strict=True)], axis=0)
        follows = solve(border)
        moves, held = own - follows, hold @ follows

        def energy(chosen: BoolArray) -> FloatArray:
            """``sum D_j^T M_j D_j`` over the chosen elements (E,)."""
            hessians = (assembly.matrix(blocks * chosen[:, None, None, None]) for blocks in per_light)
            return np.asarray(sum(part.T @ (hessian @ part) for hessian, part in zip(hessians, moves, strict=True)))

        everywhere = energy(np.ones_like(textured))
        alone = np.einsum("jnc,nc->c", own, border)  # diagonal of C
        unit = np.sqrt(np.where(alone > 0, alone, 1.0))
        scale = unit[:, None] * unit
        whole = (everywhere + follows.T @ held) / scale
        shown, directions = eigh(energy(textured) / scale, whole + _ROUNDING * np.eye(len(unit)))
        known = directions[:, shown > _SHOWN] / unit[:, None]
        unknown = directions[:, shown <= _SHOWN] * (alone > 0)[:, None]
        unknown = unknown / np.maximum(np.linalg.norm(unknown, axis=0), 1e-300)
        part = (unknown**2).sum(axis=1).reshape(lights - 1, count).sum(axis=1)
        return cls(
            follows=follows,
            moves=moves,
            pull=border + held,
            inverse=known @ np.linalg.inv(known.T @ everywhere @ known) @ known.T,
            hidden=np.append(False, part > _NAMED),
        )

    def increment(self, free: FloatArray, held_side: FloatArray, rigid_side: FloatArray) -> FloatArray:
        """Increment (K,) of the coefficients, which the smoothness of unseen nodes has no part in.

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
        return np.asarray(self.inverse @ (rigid_side - self.pull.T @ free + self.follows.T @ held_side))
