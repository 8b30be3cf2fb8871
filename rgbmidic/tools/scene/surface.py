"""The painted surface: black mat droplets sprayed on white paint, wrinkled below the pixel (paper, section 2.4).

In-plane displacement fields of a plate: uniform gradient, nodal values on a mesh, or any function of the user's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.special import pdtr

from rgbmidic._kernels.mesh import interpolate_at_points
from rgbmidic.arguments import bounded, check_fields, checked
from rgbmidic.errors import InputError
from rgbmidic.tools.scene import SceneSection
from rgbmidic.tools.scene.kernels import PLATE, sample_paint
from rgbmidic.typing import FloatArray

WRINKLE_FREQUENCY = 0.525
"""Wrinkles per lattice cell: where the height spectrum of the gradient noise peaks (measured; see the tests)."""
WRINKLE_SLOPE = 0.704
"""Rms tangential slope of the gradient noise in lattice units (measured; see the tests)."""
BOUND = math.sqrt(6.0)
"""Largest deviation of the logarithm of a droplet's diameter, in its standard deviations: a triangular law's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finish(SceneSection):
    """Reflectance of one paint.

    Attributes
    ----------
    albedo
        Fraction of light scattered diffusely (Lambert).
    gloss
        Peak of the specular reflection of one facet, in units of the radiance of an ideal white.
    lobe_deg
        Standard deviation of the facet's lobe, as the angle between its normal and the half-way vector.
    slope_deg
        Root mean square slope of the wrinkles.
    spacing
        Distance between wrinkles (mm).
    """

    albedo: float = bounded(at_least=0, at_most=1)
    gloss: float = bounded(1.5, at_least=0)
    lobe_deg: float = bounded(4.0, above=0, at_most=30)
    slope_deg: float = bounded(6.0, at_least=0, at_most=30)
    spacing: float = bounded(0.025, above=0)

    def _problems(self) -> Iterator[str]:
        if self.reflectance > 1:
            yield (
                f"the paint would reflect {self.reflectance:.2f} times the light it receives: lower albedo, gloss or "
                f"lobe_deg of {self}"
            )

    @property
    def reflectance(self) -> float:
        """Fraction of the light reflected, diffuse + specular: albedo + 8 gloss lobe**2 (lobe in rad)."""
        return self.albedo + 8 * self.gloss * math.radians(self.lobe_deg) ** 2

    def _parameters(self) -> list[float]:
        slope = math.tan(math.radians(self.slope_deg)) / WRINKLE_SLOPE
        lattice = self.spacing * WRINKLE_FREQUENCY
        return [self.albedo, slope, lattice, self.gloss, math.radians(self.lobe_deg) ** 2]


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface(SceneSection):
    """White paint under a spray of black droplets, thrown at random (Boolean model).

    Attributes
    ----------
    white, black
        The two paints.
    droplet
        Median diameter of the droplets (mm).
    spread
        Standard deviation of the logarithm of the diameter (bounded at 2.45 of it).
    coverage
        Fraction of the surface that is black, 0 to 0.95; 0 leaves white paint alone.
    softness
        Width over which black fades to white at a droplet's edge (mm).
    dome
        Height of a droplet above the white paint (mm); 0: flat.
    seed
        Seed of the speckle: another one gives another pattern of the same kind.
    """

    white: Finish = field(default_factory=lambda: Finish(albedo=0.80))
    black: Finish = field(default_factory=lambda: Finish(albedo=0.10))
    droplet: float = bounded(0.23, above=0, at_most=1000)
    spread: float = bounded(0.2, at_least=0, at_most=0.6)
    coverage: float = bounded(0.45, at_least=0, at_most=0.95)
    softness: float = bounded(0.02, at_least=0)
    dome: float = bounded(0.0, at_least=0)
    seed: int = bounded(0, at_least=0)

    def _problems(self) -> Iterator[str]:
        for name, length in {"softness": self.softness, "dome": self.dome}.items():
            if length > self.droplet:
                yield f"{name} must be at most the droplet's diameter of {self.droplet:g} mm, not {length:g}"

    @property
    def droplets_per_area(self) -> float:
        """Droplets per mm2, from the coverage 1 - exp(-number x mean area) of the Boolean model."""
        a = 2 * self.spread * BOUND
        mean_square = (2 * math.sinh(a / 2) / a) ** 2 if a else 1.0
        return -math.log(1 - self.coverage) / (math.pi / 4 * self.droplet**2 * mean_square)

    def parameters(self) -> tuple[FloatArray, FloatArray, np.uint32]:
        """Return the paint, counts and seed, as the kernels of `rgbmidic.tools.scene.kernels` take them.

        Returns
        -------
        paint, counts : ndarray
        seed : uint32
        """
        radius = self.droplet / 2
        shell = 0.3 * radius
        far = radius * math.exp(BOUND * self.spread) + self.softness / 2
        reach = math.hypot(far, shell)
        cell = 1.5 * (reach + 0.5 * radius)
        mean = self.droplets_per_area * cell**3 / (2 * shell)
        # a uniform number passes as many entries as there are droplets in a cell
        counts = np.asarray(pdtr(np.arange(int(mean + 8 * math.sqrt(mean) + 12)), mean), dtype=np.float64)
        head = [cell, shell, reach, radius, self.spread, self.softness, self.dome]
        paint = np.array([*head, *self.white._parameters(), *self.black._parameters()])
        return paint, counts, np.uint32(np.random.SeedSequence(self.seed).generate_state(1)[0])

    def sample(self, points: FloatArray, body: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the cover by black paint (0 to 1), height (mm) and slope vector at material points.

        Parameters
        ----------
        points : (N, 3)
            Points (mm) on the body's surface, in its axes.
        body : (4,)
            The body's parameters (`Plate.parameters` and so on).

        Returns
        -------
        cover : (N,)
        height : (N,)
        slope : (N, 3)
            Gradient of the height in the tangent plane.
        """
        out = np.empty((len(points), 5))
        sample_paint(out, np.ascontiguousarray(points, dtype=float), body, *self.parameters())
        return out[:, 0], out[:, 1], out[:, 2:]

    def on_plate(self, columns: npt.ArrayLike, rows: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Cover by black paint (0 to 1) and height (mm), both (h, w), on a plate at x of columns and y of rows (mm).

        Parameters
        ----------
        columns : array_like, shape (w,)
            x of the columns in mm.
        rows : array_like, shape (h,)
            y of the rows in mm.

        Returns
        -------
        cover, height : ndarray, shape (h, w)
        """
        x, y = np.meshgrid(columns, rows)
        points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        cover, height, _ = self.sample(points, np.array([PLATE, 0.0, np.inf, np.inf]))
        return cover.reshape(x.shape), height.reshape(x.shape)


@checked
def height_map(
    surface: Surface, *, size: float, pitch: float, corner: tuple[float, float] = (0.0, 0.0)
) -> tuple[FloatArray, FloatArray]:
    """Return the topography of a painted plate, as a profilometer would scan it (paper, Fig. 10).

    Parameters
    ----------
    surface
        The paint.
    size, pitch
        Side of the square and distance between points (mm).
    corner
        Material coordinates (x, y) of the first point (mm).

    Returns
    -------
    height : (N, N)
        Height in mm, rows along y.
    black : (N, N)
        Cover by black paint, 0 to 1.

    Raises
    ------
    InputError
        There are fewer than 3 points a side.
    """
    if not (pitch > 0 and 2 <= size / pitch < 50_000):
        raise InputError(f"a height map has 3 to 50,000 points a side; given are size {size} mm, pitch {pitch} mm")
    steps = np.arange(round(size / pitch) + 1) * pitch
    cover, height = surface.on_plate(corner[0] + steps, corner[1] + steps)
    return height, cover


InPlaneField = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""Displacement (ux, uy) in mm of a plate's material points (x, y) in mm, in the plate's own axes; vectorised."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AffineField:
    """A uniform displacement gradient on a plate: u = gradient . x + offset.

    Attributes
    ----------
    gradient
        ((du/dx, du/dy), (dv/dx, dv/dy)).
    offset
        Displacement (mm) of the plate's middle.
    """

    gradient: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    offset: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        (xx, xy), (yx, yy) = self.gradient
        if not (1 + xx) * (1 + yy) - xy * yx > 0:
            raise InputError(f"a displacement gradient must not turn the plate inside out: {self.gradient}")

    def __call__(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the displacement (mm) of the material points."""
        (xx, xy), (yx, yy) = self.gradient
        return xx * x + xy * y + self.offset[0], yx * x + yy * y + self.offset[1]

    def inverse(self) -> FloatArray:
        """Return [m00, m01, m10, m11, t0, t1]: spatial to material point.

        Returns
        -------
        ndarray, shape (6,)
        """
        matrix = np.linalg.inv(np.eye(2) + np.array(self.gradient))
        return np.concatenate([matrix.ravel(), -matrix @ np.array(self.offset)])

    def material(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the material points of spatial ones.

        Parameters
        ----------
        x, y : ndarray
            Spatial points in mm.

        Returns
        -------
        x, y : ndarray
            In mm.
        """
        m = self.inverse()
        return m[0] * x + m[1] * y + m[4], m[2] * x + m[3] * y + m[5]


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshField:
    """Nodal displacements on triangles, linear in between, as a finite-element program gives them.

    The plate ends where the mesh ends.

    Attributes
    ----------
    nodes : ndarray, shape (N, 2)
        Material positions (mm) in the plate's axes.
    elements : ndarray, shape (E, 3)
        Node indices.
    displacement : ndarray, shape (N, 2)
        mm.
    """

    nodes: FloatArray
    elements: npt.NDArray[np.int64]
    displacement: FloatArray

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        nodes, values = np.array(self.nodes, dtype=float), np.array(self.displacement, dtype=float)
        elements = np.array(self.elements, dtype=np.int64)
        if nodes.ndim != 2 or nodes.shape[1] != 2 or values.shape != nodes.shape or elements.shape[1:] != (3,):
            raise InputError(
                f"a mesh field has nodes (N, 2), elements (E, 3) and displacement (N, 2), not {nodes.shape}, "
                f"{elements.shape} and {values.shape}"
            )
        if not len(elements) or elements.min() < 0 or elements.max() >= len(nodes):
            raise InputError("the elements of a mesh field must name existing nodes, and there must be one")
        if not (np.isfinite(nodes).all() and np.isfinite(values).all()):
            raise InputError("nodes and displacement of a mesh field must be finite")
        reference_areas, deformed_areas = _areas(nodes, elements), _areas(nodes + values, elements)
        if not (reference_areas * deformed_areas > 0).all():
            raise InputError(
                f"element {int(np.argmin(reference_areas * deformed_areas))} of the mesh field has no area or is "
                "turned over"
            )
        object.__setattr__(self, "nodes", nodes)
        object.__setattr__(self, "displacement", values)
        object.__setattr__(self, "elements", elements)

    def __call__(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the displacement (mm) of the material points; NaN off the mesh."""
        return _interpolate(x, y, self.nodes, self.elements, self.displacement)

    def material(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the material points of spatial ones: linear in the deformed triangles, hence exact; NaN off the mesh.

        Parameters
        ----------
        x, y : ndarray
            Spatial points in mm.

        Returns
        -------
        x, y : ndarray
            In mm.
        """
        return _interpolate(x, y, self.nodes + self.displacement, self.elements, self.nodes)


def material_from_spatial(
    field: InPlaneField | None, x: FloatArray, y: FloatArray, accuracy: float = 1e-8
) -> tuple[FloatArray, FloatArray]:
    """Return the material points X of spatial points x = X + u(X).

    A general function is inverted to an `accuracy` (mm) by the iteration X <- x - u(X), which converges where its
    gradient is below 1.

    Raises
    ------
    InputError
        The iteration does not converge.
    """
    if field is None:
        return x, y
    if isinstance(field, AffineField | MeshField):
        return field.material(x, y)
    mx, my = x, y
    for _ in range(100):
        ux, uy = field(mx, my)
        nx, ny = x - ux, y - uy
        change = np.maximum(abs(nx - mx), abs(ny - my))
        mx, my = nx, ny
        if not (change > accuracy).any():
            return mx, my
    raise InputError("the plate's displacement field cannot be inverted: its gradient must stay below 1 everywhere")


def _areas(nodes: FloatArray, elements: npt.NDArray[np.int64]) -> FloatArray:
    a, b, c = (nodes[elements[:, corner]] for corner in range(3))
    return np.asarray((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))


def _interpolate(
    x: FloatArray, y: FloatArray, nodes: FloatArray, elements: npt.NDArray[np.int64], values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    out = np.empty((x.size, 2))
    flat_x, flat_y = np.ascontiguousarray(x, dtype=float).ravel(), np.ascontiguousarray(y, dtype=float).ravel()
    interpolate_at_points(out, flat_x, flat_y, nodes, elements, values, *_bins(nodes, elements))
    return out[:, 0].reshape(x.shape), out[:, 1].reshape(x.shape)


def _bins(
    nodes: FloatArray, elements: npt.NDArray[np.int64]
) -> tuple[FloatArray, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return square bins over the mesh, two elements each, and for each the elements whose bounding box meets it."""
    corners = nodes[elements]
    low, high = corners.min(axis=1), corners.max(axis=1)
    origin, span = low.min(axis=0), high.max(axis=0) - low.min(axis=0)
    side = float(np.sqrt(span[0] * span[1] * 2 / len(elements)))
    columns, rows = (int(length / side) + 1 for length in span)
    start = ((low - origin) / side).astype(np.int64)
    count = ((high - origin) / side).astype(np.int64) - start + 1
    pairs = np.repeat(np.arange(len(elements)), count.prod(axis=1))
    index_in_element = np.arange(pairs.size) - np.repeat(
        np.cumsum(count.prod(axis=1)) - count.prod(axis=1), count.prod(axis=1)
    )
    i = np.minimum(start[pairs, 0] + index_in_element % count[pairs, 0], columns - 1)
    j = np.minimum(start[pairs, 1] + index_in_element // count[pairs, 0], rows - 1)
    bins = j * columns + i
    first = np.searchsorted(np.sort(bins), np.arange(columns * rows + 1))
    return np.array([*origin, side, columns, rows]), first, pairs[np.argsort(bins, kind="stable")]
