"""The linear algebra of one pass: Hessian, smoothness for what nobody sees, rigid motions of the lights (`rigid`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.rigid import RigidMotions
from rgbmidic.mesh.sparse import with_data
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["SEEN", "Equations"]

_SMOOTHNESS = 1e-4
"""Weight of the smoothness that carries unseen nodes along, relative to the texture's median Hessian."""
_ROUNDING = 1e-4
"""Share of a node's texture under which what it sees in its worse direction may be rounding."""
SEEN = 0.05
"""A node is measured if it has this share of the median texture around a node of its area..."""
_INFORMED = 0.01
"""...and this share of the median information, its texture over the variance of the residual: 10 times the noise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Equations:
    """Factorised normal equations for given weights, in axes that turn with the surface.

    The reference's gradient stands for that of the deformed image, which the surface has turned with it: the motion is
    solved for in the axes of the reference and turned to where they are now.

    Attributes
    ----------
    weights : ndarray, shape (k, P), float32
    rotation : ndarray, shape (N, 2, 2)
        Of the surface around each node.
    functions : ndarray, shape (2 N, m)
        The rigid functions in the axes of the reference.
    blocks : ndarray, shape (E, 3, 3, 3)
        Element blocks of the Hessian.
    smoothness : float
        Factor on the smoothness of the `Assembly`.
    node_blocks : ndarray, shape (3, N)
        Entries xx, xy and yy of the nodes' own blocks of the Hessian.
    solve
        Solves the normal equations with it.
    rigid
        The rigid motions of the lights after the first; None where there are none.
    textured : ndarray, shape (N,), bool
        Nodes that see enough texture.
    light_share : ndarray, shape (N, k), float64
        Share of each light in what determines a node; 0 where nothing does.
    """

    weights: FloatImage
    rotation: FloatArray
    functions: FloatArray
    blocks: FloatArray
    node_blocks: FloatArray
    smoothness: float
    solve: Callable[[FloatArray], FloatArray]
    rigid: RigidMotions | None
    textured: BoolArray
    light_share: FloatArray

    @classmethod
    def build(
        cls,
        reference: Reference,
        weights: FloatImage,
        functions: FloatArray,
        displacement: FloatArray,
        given: FloatImage | None = None,
    ) -> Equations:
        """Assemble and factorise for pixel weights (k, P), rigid functions (2 N, m), around a displacement (N, 2).

        `given` are the weights without the precision of the lights, where it is part of `weights`.
        """
        assembly = reference.assembly
        rotation = _rotation(reference.mesh.nodal_gradient(displacement))
        functions = _turned_back(rotation, functions)
        per_light = [reference.hessian_blocks(light, weight) for light, weight in enumerate(weights)]
        blocks = np.sum(per_light, axis=0)
        own = assembly.node_blocks(blocks)
        textured, scale = _observability(own, assembly.nodal_area, SEEN if given is None else _INFORMED)
        if given is not None:
            texture = sum(reference.hessian_blocks(light, weight) for light, weight in enumerate(given))
            textured &= _observability(assembly.node_blocks(np.asarray(texture)), assembly.nodal_area, SEEN)[0]
        # the tiny multiple of the identity fixes the constant that smoothness leaves free where nothing is seen
        held = scale * (_SMOOTHNESS * assembly.smoothness.data + 1e-9 * assembly.diagonal)
        solve = assembly.factorise(assembly.matrix(blocks, held))
        rigid = None
        if functions.shape[1] and len(per_light) > 1:
            shown = np.asarray(textured[reference.mesh.elements].all(axis=1))
            hold = with_data(assembly.smoothness, held)
            rigid = RigidMotions.eliminate(assembly, per_light, functions, hold, solve, shown)
        return cls(
            weights=weights,
            rotation=rotation,
            functions=functions,
            blocks=blocks,
            node_blocks=own,
            smoothness=_SMOOTHNESS * scale,
            solve=solve,
            rigid=rigid,
            textured=textured,
            light_share=_light_share(reference, per_light),
        )

    def information(self, reference: Reference) -> FloatArray:
        """Texture times weight around each node, over its area, (N,): what the inverse variance of a node goes with."""
        return np.asarray((self.node_blocks[0] + self.node_blocks[2]) / reference.assembly.nodal_area)

    def increment(
        self, right_side: FloatArray, held_side: FloatArray, rigid_side: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Solve for the motion of the nodes (N, 2) and of the rigid functions ((k - 1) m,); `held_side` (2 N,) is the
        smoothness' part of the `right_side`."""
        motion, rigid = self.solve(right_side), np.zeros(0)
        if self.rigid is not None:
            rigid = self.rigid.increment(motion, held_side, rigid_side)
            motion = motion - self.rigid.follows @ rigid
        return np.einsum("nij,nj->ni", self.rotation, motion.reshape(-1, 2)), rigid

    def turned_back(self, columns: FloatArray) -> FloatArray:
        """Nodal vectors (2 N, m) in the axes of the reference."""
        return _turned_back(self.rotation, columns)


def _turned_back(rotation: FloatArray, columns: FloatArray) -> FloatArray:
    turned = np.einsum("nji,njm->nim", rotation, columns.reshape(len(rotation), 2, -1))
    return np.asarray(turned.reshape(columns.shape))


def _rotation(gradient: FloatArray) -> FloatArray:
    """Rotation (N, 2, 2): the polar factor of ``I + grad u`` in the plane, for a gradient (N, 2, 2)."""
    angle = np.arctan2(gradient[:, 1, 0] - gradient[:, 0, 1], 2 + gradient[:, 0, 0] + gradient[:, 1, 1])
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)


def _light_share(reference: Reference, per_light: list[FloatArray]) -> FloatArray:
    own = [reference.assembly.node_blocks(blocks) for blocks in per_light]
    light = np.stack([xx + yy for xx, _, yy in own], axis=1)
    total = light.sum(axis=1, keepdims=True)
    return np.asarray(light / np.where(total > 0, total, 1.0))


def _observability(own: FloatArray, area: FloatArray, least: float) -> tuple[BoolArray, float]:
    """Which nodes see at least that share of the median texture, and the typical diagonal entry of the Hessian.

    The texture a node sees in its worse direction is the smaller eigenvalue of its own 2 x 2 block.
    """
    xx, xy, yy = own
    half = (xx + yy) / 2
    smallest = half - np.hypot((xx - yy) / 2, xy)
    smallest[smallest < _ROUNDING * half] = 0  # texture in one direction only
    density = smallest / area
    typical = np.median(density[density > 1e-3 * density.max()]) if density.max() > 0 else 0.0
    seen = density > least * typical if typical > 0 else np.zeros(len(density), dtype=bool)
    return seen, float(np.median(half[seen]) if seen.any() else half.max(initial=0.0)) or 1.0
