"""Displacement between one pair of states: arrays in, a solution out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Literal, Unpack

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.threads import aside
from rgbmidic.correlation import (
    Deformed,
    PrecisionMethod,
    Reference,
    Solution,
    Start,
    discretisation_error,
    fill,
    solve,
    track,
)
from rgbmidic.correlation.images import as_light_stack
from rgbmidic.errors import ConfigurationError, InputError
from rgbmidic.illumination.images import normalise as divide_by_local_mean
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.given import check_object
from rgbmidic.settings import ELEMENT_SIZE, SolverOptions, SolverSettings, check_names, grey_levels
from rgbmidic.typing import FloatArray
from rgbmidic.weights import Statistics, as_weights


def correlate(
    reference: npt.ArrayLike,
    deformed: npt.ArrayLike,
    *,
    region: Sequence[float] | Region | None = None,
    element_size: float = ELEMENT_SIZE,
    cracks: Sequence[npt.ArrayLike] = (),
    weights: npt.ArrayLike | None = None,
    initial: npt.ArrayLike | None = None,
    deformed_weights: npt.ArrayLike | None = None,
    normalise: float | Literal["auto"] | None = None,
    statistics: bool | PrecisionMethod = True,
    mesh_error: bool = False,
    **options: Unpack[SolverOptions],
) -> Solution:
    """Measure the displacement between two states seen under k lights (k = 1: plain DIC).

    Parameters
    ----------
    reference, deformed : array_like, shape (H, W) or (k, H, W)
        Grey levels; NaN marks an invalid pixel.
    region
        Rectangle (x0, y0, x1, y1) in px, or a `rgbmidic.mesh.Region`; None: the whole image.
    element_size
        Side of the triangles in px.
    cracks
        Paths, each of corners (x, y) in px, along which the mesh is split, see `Tri3Mesh.from_region`.
    weights : array_like, shape (H, W) or (k, H, W), optional
        Weight of each light at each pixel of the reference, finite and not negative; 0 excludes the pixel.
    initial : array_like, shape (2,) or (N, 2), optional
        Initial guess of the displacement (u, v) in px; None: it is found by a search.
    deformed_weights
        Like `weights`, on the deformed images.
    normalise
        Standard deviation in px of the Gaussian of the local mean by which every image is first divided; ``"auto"``: 10
        px, 30 px if there are cracks. None: grey levels are not changed.
    statistics
        True: weight the lights by the statistics of the residual around each pixel (`rgbmidic.weights.Statistics`).
        False: only by `weights`. Or an object with a method of your own.
    mesh_error
        Estimate the discretisation error, too (`rgbmidic.discretisation_error`).
    **options
        Fields of `rgbmidic.settings.SolverSettings` and their defaults: prefilter, rigid, brightness, fill,
        tolerance, max_iterations.

    Returns
    -------
    Solution
        With `nodes` (N, 2), `elements` (E, 3), `displacement` (N, 2) in px, `displacement_std` (N, 2) in px,
        `status`, and more.

    Raises
    ------
    InputError
        The images have different shapes, a weight or initial guess does not fit them, or a setting is unknown.
    RegionError
        The region is empty, too small or outside the image.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> speckle = 1000 + 3000 * gaussian_filter(np.random.default_rng(0).normal(size=(120, 160)), 1.5)
    >>> solution = correlate(speckle, np.roll(speckle, 2, axis=1), region=(20, 20, 140, 100))
    >>> solution.status.name
    'CONVERGED'
    >>> np.allclose(solution.displacement, (2, 0), atol=0.01)
    True
    """
    f, g = as_light_stack(reference, "reference"), as_light_stack(deformed, "deformed")
    if f.shape != g.shape:
        raise InputError(f"reference and deformed images must have one shape; given are {f.shape} and {g.shape}")
    height, width = f.shape[1:]
    if not isinstance(region, Region):
        region = Region.from_rectangle(region if region is not None else (0, 0, width - 1, height - 1), (height, width))
    mesh = Tri3Mesh.from_region(region, element_size, cracks)
    cracked = len(mesh.crack_edges) > 0
    if not (normalise in (None, "auto") or isinstance(normalise, int | float)):
        raise InputError(f'normalise must be a width in px or "auto", not {normalise!r}')
    sigma, solver = grey_levels(0.0 if normalise is None else normalise, solver_settings(options), cracked=cracked)
    if sigma:
        f, g = (divide_by_local_mean(stack, sigma, float(np.nanmax(stack, initial=0.0))) for stack in (f, g))
    given = as_weights(weights, f.shape, "weights"), as_weights(deformed_weights, f.shape, "deformed_weights")
    second = aside(Deformed.prepare, g, given[1], prefilter=solver.prefilter)
    first = Reference.prepare(f, region, given[0], mesh=mesh, prefilter=solver.prefilter)
    method = (Statistics() if statistics else None) if isinstance(statistics, bool) else statistics
    check_object("statistics", method, "precision")
    start = initial_displacement(initial, len(mesh.nodes))
    if start is None:
        solution = track(first, second.result(), Start(displacement=None), solver, method)
    else:
        solution = solve(first, second.result(), start, solver, method)
    if mesh_error:
        solution = discretisation_error(first, second.result(), solution, solver, method)
    return fill(mesh, solution, solver.fill) if solver.fill else solution


def solver_settings(options: SolverOptions) -> SolverSettings:
    """The settings of the solve that options of a function state.

    Raises
    ------
    InputError
        An option is unknown or out of range.
    """
    try:
        check_names(options, (entry.name for entry in fields(SolverSettings)), "option", "correlate")
        return SolverSettings(**options)
    except ConfigurationError as error:
        raise InputError(str(error)) from None


def initial_displacement(initial: npt.ArrayLike | None, nodes: int) -> FloatArray | None:
    """Return an initial guess as an array, or None where none is given.

    Parameters
    ----------
    initial : array_like, shape (2,) or (N, 2), optional
        Displacement (u, v) in px.
    nodes
        Number N of nodes of the mesh.

    Returns
    -------
    ndarray, shape (N, 2), or None

    Raises
    ------
    InputError
        Not (2,) or (N, 2), or not finite.
    """
    if initial is None:
        return None
    try:
        values = np.asarray(initial, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"initial must be numbers (u, v) in px; given is {initial!r}") from None
    if values.shape not in ((2,), (nodes, 2)) or not np.isfinite(values).all():
        raise InputError(f"initial must be finite with shape (2,) or ({nodes}, 2); given is shape {values.shape}")
    return np.broadcast_to(values, (nodes, 2)).copy()
