"""Position of a finite-element mesh on the image, fitted to pairs of points.

A placement is a similarity of the mesh's plane to the image, or a rigid motion of it to the plane of a calibrated
camera (Umeyama, IEEE Transactions on Pattern Analysis and Machine Intelligence 13, 1991).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from rgbmidic.arguments import checked
from rgbmidic.errors import InputError, RegionError
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.mesh.source import Plane
from rgbmidic.text import format_with_std
from rgbmidic.tools.finite_elements.mesh import FiniteElementMesh
from rgbmidic.typing import FloatArray, as_numbers, as_values

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Placement(Plane):
    """Position of a mesh in mm on the image.

    Attributes
    ----------
    matrix : ndarray, shape (2, 2)
        Maps the mesh's mm to px, or to mm on the camera's plane if there is a `camera`.
    shift : ndarray, shape (2,)
        Position of the mesh's origin, in the same unit.
    camera
        Lens and plane; None: the image is similar to the mesh (rotated, shifted and scaled).
    pairs : ndarray, shape (n, 4)
        The pairs (x_mm, y_mm, x_px, y_px) that it was fitted to.

    Examples
    --------
    >>> from rgbmidic import Placement
    >>> placement = Placement.fit([(0, 0, 100, 300), (10, 0, 200, 300), (0, 20, 100, 100)])
    >>> placement.to_px(np.array([[5.0, 5.0]])).round(6).tolist()
    [[150.0, 250.0]]
    >>> round(placement.mm_per_pixel, 6)
    0.1
    """

    matrix: FloatArray
    shift: FloatArray
    camera: Plane | None = None
    pairs: FloatArray = field(default_factory=lambda: np.empty((0, 4)))

    def __post_init__(self) -> None:
        """Check the arrays."""
        for name, shape in (("matrix", (2, 2)), ("shift", (2,)), ("pairs", (None, 4))):
            as_values(getattr(self, name), f"{name} of a placement", shape)

    @classmethod
    def fit(cls, pairs: npt.ArrayLike, camera: Plane | None = None, *, label: str = "mesh.points") -> Self:
        """Fit a placement to pairs of points by least squares.

        Without a camera it is a similarity: shift, rotation and scale. With one it is a rigid motion, for both have mm.
        Whether the image shows the mesh or its mirror image is what fits three or more pairs better; where they do not
        decide, the mesh's y axis points up (and the image's down). The log states a doubt, and residuals beyond those
        of points set by hand.

        Parameters
        ----------
        pairs : array_like, shape (n, 4)
            (x_mm, y_mm, x_px, y_px), two or more.
        camera
            Lens and plane.
        label
            Name of the pairs in messages.

        Returns
        -------
        Placement

        Raises
        ------
        InputError
            Fewer than two pairs, or two at one place.
        """
        requirement = f"{label} is two or more pairs [x_mm, y_mm, x_px, y_px] of finite numbers"
        pair_array = as_numbers(pairs, requirement, (None, 4))
        if len(pair_array) < 2:
            raise InputError(f"{requirement}; given is {pairs!r}")
        for positions, surface in ((pair_array[:, :2], "on the mesh"), (pair_array[:, 2:], "on the image")):
            same = np.argwhere(np.triu((positions[:, None] == positions).all(axis=2), 1))
            if len(same):
                raise InputError(f"{label}: pairs {same[0].tolist()} are one point {surface}")
        if camera is not None:
            on_plane, on_mesh = (
                positions - positions.mean(axis=0) for positions in (camera.to_mm(pair_array[:, 2:]), pair_array[:, :2])
            )
            stretch = np.linalg.norm(on_plane) / np.linalg.norm(on_mesh)
            # a wrong unit is 25 or more, a scale that is known to 5 % is no calibration (chosen)
            if not 1 / 1.05 < stretch < 1.05:
                raise InputError(
                    f"the pairs of {label} lie {stretch:.4g} times as far apart on the camera's plane as on the mesh, "
                    "where both are in mm: look at mesh.unit, the points and the calibration"
                )
        best, alternative = (cls._fitted(pair_array, camera, reflected) for reflected in (True, False))
        # a point set by hand is a click on a whole pixel; three times as much is beyond any scatter (both chosen)
        pointing_px, decisive_ratio = 0.5, 3.0
        if len(pair_array) > 2:
            small, large = sorted((best.rms, alternative.rms))
            if large < decisive_ratio * max(small, pointing_px):
                text = "%s does not decide whether the image shows the mesh or its mirror image: up is taken"
                logger.warning(text, label)
            elif alternative.rms < best.rms:
                best = alternative
        if best.rms > decisive_ratio * pointing_px:
            distance = np.hypot(*best.residuals.T)
            text = "%s leaves residuals of %.1f px rms, the largest, %.1f px, at %s[%d]: check the pairs"
            logger.warning(text, label, best.rms, distance.max(), label, distance.argmax())
        return best

    @classmethod
    def _fitted(cls, pairs: FloatArray, camera: Plane | None, reflected: bool) -> Self:
        """Fit one of both senses of rotation, in complex numbers: ``w = a z + b`` of z or its conjugate."""
        image = pairs[:, 2:] if camera is None else camera.to_mm(pairs[:, 2:])
        sign = -1.0 if reflected else 1.0
        z, w = pairs[:, 0] + sign * 1j * pairs[:, 1], image[:, 0] + 1j * image[:, 1]
        a = np.vdot(z - z.mean(), w - w.mean()) / np.vdot(z - z.mean(), z - z.mean())
        a /= 1 if camera is None else abs(a)
        b = w.mean() - a * z.mean()
        matrix = np.array([[a.real, -sign * a.imag], [a.imag, sign * a.real]])
        return cls(matrix=matrix, shift=np.array([b.real, b.imag]), camera=camera, pairs=pairs)

    @property
    def reflected(self) -> bool:
        """True if a counter-clockwise turn of the mesh (x right, y up) is one on the screen, where y points down."""
        return bool(np.linalg.det(self.matrix) < 0)

    @property
    def residuals(self) -> FloatArray:
        """Distance (n, 2) in px from the image's point of every pair to where the mesh's is placed."""
        return self.to_px(self.pairs[:, :2]) - self.pairs[:, 2:]

    @property
    def rms(self) -> float:
        """Root mean square length of the residuals, px."""
        return float(np.sqrt((self.residuals**2).sum(axis=1).mean()))

    @property
    def mm_per_pixel(self) -> float | None:
        """Millimetres of the mesh in a px; None with a camera, which has a scale of its own at every pixel."""
        return None if self.camera is not None else float(1 / np.sqrt(abs(np.linalg.det(self.matrix))))

    @property
    def mm_per_pixel_std(self) -> float:
        """Standard uncertainty of `mm_per_pixel` from the residuals; 0 where two pairs leave none, or with a camera."""
        free = 2 * len(self.pairs) - 4
        if free < 1 or self.mm_per_pixel is None:
            return 0.0
        spread = ((self.pairs[:, 2:] - self.pairs[:, 2:].mean(axis=0)) ** 2).sum()
        return float(self.mm_per_pixel * np.sqrt((self.residuals**2).sum() / free / spread))

    def to_px(self, points: FloatArray) -> FloatArray:  # noqa: D102
        positions = as_values(points, "points", (None, 2)) @ self.matrix.T + self.shift
        return positions if self.camera is None else self.camera.to_px(positions)

    def to_mm(self, points: FloatArray) -> FloatArray:  # noqa: D102
        points = as_values(points, "points", (None, 2))
        positions = points if self.camera is None else self.camera.to_mm(points)
        return np.asarray((positions - self.shift) @ np.linalg.inv(self.matrix).T)

    def jacobian(self, points: FloatArray) -> FloatArray:  # noqa: D102
        points, inverse = as_values(points, "points", (None, 2)), np.linalg.inv(self.matrix)
        if self.camera is None:
            return np.broadcast_to(inverse, (len(points), 2, 2)).copy()
        return np.asarray(inverse @ self.camera.jacobian(points))

    def vectors_to_mm(self, points: FloatArray, vectors: FloatArray) -> FloatArray:
        """Return displacements (N, 2) in mm in the mesh's axes, of `vectors` (N, 2) in px from `points` (N, 2) in px.

        Parameters
        ----------
        points, vectors : ndarray, shape (N, 2)
            Points of the image and displacements of them, px.

        Returns
        -------
        ndarray, shape (N, 2)
            In mm.
        """
        start = as_values(points, "points", (None, 2))
        return self.to_mm(start + as_values(vectors, "vectors", start.shape)) - self.to_mm(start)

    def vectors_to_px(self, points: FloatArray, vectors: FloatArray) -> FloatArray:
        """Return displacements (N, 2) in px, of `vectors` (N, 2) in mm from `points` (N, 2) in mm, in the mesh's axes.

        Parameters
        ----------
        points, vectors : ndarray, shape (N, 2)
            Points of the mesh and displacements of them, mm.

        Returns
        -------
        ndarray, shape (N, 2)
            In px.
        """
        start = as_values(points, "points", (None, 2))
        return self.to_px(start + as_values(vectors, "vectors", start.shape)) - self.to_px(start)

    def to_document(self) -> dict[str, Any]:
        """Return all but the camera in plain values, as the provenance of a result holds it.

        Returns
        -------
        dict
        """
        return {name: getattr(self, name).tolist() for name in ("matrix", "shift", "pairs")}

    @classmethod
    @checked
    def from_document(cls, document: Mapping[str, Any], camera: Plane | None = None) -> Self:
        """Return the placement of such values, and the `camera` that it was fitted with.

        Parameters
        ----------
        document
            Values as `to_document` gives them.
        camera
            Lens and plane; None where it was fitted without.

        Returns
        -------
        Placement
        """
        values = {name: np.array(document[name], dtype=np.float64) for name in ("matrix", "shift", "pairs")}
        return cls(**values, camera=camera)

    def summary(self) -> str:
        """Return what it is, in words.

        Returns
        -------
        str
        """
        angle_deg = np.degrees(np.arctan2(self.matrix[1, 0], self.matrix[0, 0]))
        scale = (
            f"{format_with_std(self.mm_per_pixel, self.mm_per_pixel_std, 'mm per px')}, " if self.mm_per_pixel else ""
        )
        fit = f"{len(self.pairs)} pairs, residuals {self.rms:.2g} px rms"
        return f"{scale}x axis at {angle_deg:.2f} degrees, y axis {'up' if self.reflected else 'down'}; {fit}"


def place_on_image(
    finite_elements: FiniteElementMesh, placement: Placement, shape: tuple[int, int], region: Region | None = None
) -> tuple[FiniteElementMesh, Tri3Mesh, Region]:
    """Place a mesh on images of `shape` (H, W); the log states how much of it is left out.

    Parameters
    ----------
    finite_elements, placement
        The mesh, and where it lies.
    shape
        Rows and columns of the images.
    region
        Only triangles whose centre lies in it.

    Returns
    -------
    tuple
        The part of the mesh that is measured, wholly within the image; the same in px; and the pixels that it covers.

    Raises
    ------
    RegionError
        No element is left.
    """
    corners = placement.to_px(finite_elements.points)[finite_elements.elements]
    last_pixel = np.array([shape[1] - 1, shape[0] - 1])
    within = np.asarray(((corners >= 0) & (corners <= last_pixel)).all(axis=(1, 2)), dtype=bool).reshape(-1)
    selected = within.copy()
    if region is not None:
        column, row = np.clip(np.round(corners[within].mean(axis=1)).astype(int), 0, last_pixel).T
        selected[within] = region.mask[row, column]
    if not selected.any():
        low, high = np.nanmin(corners, axis=(0, 1)), np.nanmax(corners, axis=(0, 1))
        raise RegionError(
            f"no element of {finite_elements.name} lies in the {'region' if within.any() else 'image'}: mesh.points "
            f"place it at x {low[0]:.0f} to {high[0]:.0f}, y {low[1]:.0f} to {high[1]:.0f} px of an image of "
            f"{shape[1]} x {shape[0]} px"
        )
    n_triangles = len(selected)
    for count, boundary in (
        (n_triangles - int(within.sum()), "the image"),
        (int((within & ~selected).sum()), "the region"),
    ):
        if count:
            logger.warning(
                "%s: %d of %d triangles lie outside %s: left out", finite_elements.name, count, n_triangles, boundary
            )
    subset = finite_elements.subset(selected)
    mesh = Tri3Mesh(nodes=placement.to_px(subset.points), elements=subset.elements)
    return subset, mesh, mesh.region(shape)
