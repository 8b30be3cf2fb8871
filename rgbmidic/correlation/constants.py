"""The constants of the solve, each with its source: chosen, measured or derived.

What half and twice a chosen one changes in the scene that changes most is in ``docs/tables/constants.csv``
(benchmarks/constants.py); changes below are of those scenes, one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverConstants:
    """Constants of the solve, of the nodes that count as measured and of the stated uncertainty.

    Attributes
    ----------
    min_initial_zncc
        Correlation coefficient at the initial guess under which an element waits until its neighbours have brought it
        nearer. Chosen; half or twice of it matters where images do not match alone: beside a hole, between two bodies
        and in a deep shadow, by .07 to .15 of the stated uncertainty.
    reweight_motion
        Rms motion (px) from where the weights of the lights were learnt, after which these are learnt anew: what all
        lights alike show of the motion hides which of them is the precise one. With .03 errors on raised droplets are
        as large, on coarse wrinkles by .4 % larger, with .1 px of any node in fifty by 4 % (measured).
    max_oscillating_fraction
        Fraction of the nodes that are not measured if they still move at the end: a few at the rim of a fragment, half
        of whose pixels match nothing, swing for good; where more do the frame has not converged. Chosen; half or twice
        of it matters in a deep shadow and with rigid motions of the lights, by .15 of the stated uncertainty.
    smoothness
        Weight of the smoothness that carries nodes without data along, relative to the texture's median Hessian.
        Chosen; with a tenth or ten times of it lights under a reflection differ by 2e-6 px at most, beside a gap by
        3e-4, nodes between two bodies by .3 of their stated uncertainty.
    min_texture
        A node counts as measured if it has this fraction of the median texture around a node of its area...
    min_information
        ...and this fraction of the median information, its texture over the variance of the residual: its noise is then
        10 times the median node's (derived).
    max_std
        Uncertainty (px) from which a node is decorrelated: a position uncertain by half a pixel is no match.
    zncc_bounds, zncc_bounds_precise
        Correlation coefficient under which the images of an element do not match, for poor images and for good ones:
        where the lights count alike, and where they count by their precision, so that a reflection in one of them is no
        mismatch. With the latter where they count alike two bodies that part are pulled together. Chosen.
    outlier_factor
        In between: how many times farther from 1 than the median of the elements around. Chosen; half or twice of it
        matters beside a hole, between two bodies and in a deep shadow only, by .08 to .2 of the stated uncertainty.
    neighbour_count
        Elements around: a square of some 5.5 elements a side, of which a crack takes a third.
    max_relative_stretch
        Stretch (norm of C - 1, C the right Cauchy-Green tensor) beyond that of the elements around from which an
        element is torn, not strained: a strain of
        20 % in both directions more than theirs gives .6.
    gradient_correlation_bounds
        Correlation of a light's gradient with that of the others, in a window, up to which it is matched with the mean
        of all, and from which with that of the others. Lights of smooth paint reach .95 to 1. At .85 the others' mean
        would cost three lights whose paint is their own by 18 % of the variance a tenth (measured).
    half_weight_displacement
        Displacement (px) of what a light alone shows against the solution at which it counts half in its gradient.
        With half or twice of it the error on coarse paint differs by 1 % (measured).
    min_gain_correlation
        Correlation of both states from which a light has a gain: a lamp that is off shows noise, whose contrast over
        the speckle's is none. Two states of one speckle have .9 and more; of 50 speckles chance makes .3 in 1 of 60
        cases (derived).
    least_gain
        Least local gain over that of the light: where a shadow takes 95 % of it, it is not amplified any further.
    gain_window_factor
        Standard deviation of the window of the gain in correlation lengths of the speckle. With 4.5 noise-free coarse
        speckle errs by 1.4 times as much, with 9 a shadow's edge by 1.5 times (benchmarks/grey_levels.py). Half or
        twice of it changes displacements by .2 to .5 of their stated uncertainty, in a deep shadow by all of it.
    max_smooth_fraction
        Fraction of the squared residual in its means over blocks of that window, from which the light changes within
        it: edges of shadows 1 to 15 px wide have .29 to .8, highlights that are added .25 to .5, vignetting of coarse
        speckle .5 to .7, reflections on several lights .1 to .21, plain speckle .01 to .1 (measured).
    gain_window_ratio
        The window over the narrower one that follows such a light: plain speckle then errs by 3 % more, a shadow's edge
        by half (benchmarks/grey_levels.py).
    score_block_side
        Side (px) of the blocks of the table: wider than a speckle and any filter. With 10, 19 and 26 px white noise is
        stated as large (.95 to 1.0 of what it is), by estimates that scatter by .13 to .16 instead of .09 (elements of
        25 px, measured).
    score_block_side_per_element
        Side of the squares of blocks in sides of an element: what elements cannot follow is alike over about that. Of
        waves of 3 to 6 elements errors are .6 to 1.0 times what is stated with elements of 25 px (13 px; .4 to .9 with
        19 px), .5 to .9 with 40 px (26 px; .4 to .9 with 30 px), .8 to 1.3 with 13 px, and on the DIC Challenge star of
        2 to 3 elements 1.5 (measured).
    score_range
        Standard deviation (px) of the window over which block sums are averaged: 67 blocks of 13 px give a variance to
        12 % (derived). With half or twice of it lights differ by 1e-3 px at most, beside a gap by 2e-3, their
        uncertainty by 5 %.
    information_smoothing
        Standard deviation (blocks) of the window in which the information of a block is taken. Chosen; with half or
        twice of it lights differ by 1e-4 px at most, beside a gap by 2e-4, their uncertainty by 3 %.
    prior_blocks
        Blocks for which the region's typical score counts in that window: beside a hole there are few.
    bias_range
        Standard deviation (px) of the window in which a light's bias is found, and how far what it alone shows follows
        the solution: it changes over some 50 px, and the mean
        of the lights that agree is known the better the wider it is. Half of it and 16 px give errors up to 5 % larger
        on raised droplets.
    bias_across
        Fraction of the variance across a direction that is stated in it where no lights agree: an estimate from two or
        three lights has few degrees of freedom. Without, places that were stated largest on raised droplets erred by .3
        of that, others by 1.25 times (measured); with twice of it it fits as well.
    local_bias_range
        The same (px) where the bias changes by more than chance within that window: a third of it. Of lights displaced
        within discs of 18 to 50 px by .1 to 1 px (144 of them, at random places) errors are 1.2 times what is stated;
        with 12 px 1.9 times, with 5 px .72, and at rest .82 (measured).
    local_bias_threshold
        Variances by chance (of both directions together: 2) that such a change must exceed (James and Stein 1961): by
        chance 2 % of the places do. With half of it such errors are 1.03 times what is stated, but means over 50 px are
        stated 15 % larger on scenes without such lights; with twice 1.6 times (measured).

    Examples
    --------
    >>> SolverConstants(smoothness=1e-3).smoothness
    0.001
    """

    min_initial_zncc: float = 0.25
    reweight_motion: float = 0.02
    max_oscillating_fraction: float = 0.02
    smoothness: float = 1e-4
    min_texture: float = 0.05
    min_information: float = 0.01
    max_std: float = 0.5
    zncc_bounds: tuple[float, float] = (0.4, 0.6)
    zncc_bounds_precise: tuple[float, float] = (0.4, 0.9)
    outlier_factor: float = 8.0
    neighbour_count: int = 61
    max_relative_stretch: float = 0.5
    gradient_correlation_bounds: tuple[float, float] = (0.85, 0.95)
    half_weight_displacement: float = 0.1
    min_gain_correlation: float = 0.3
    least_gain: float = 0.05
    gain_window_factor: float = 6.0
    max_smooth_fraction: float = 0.25
    gain_window_ratio: float = 3.0
    score_block_side: int = 13
    score_block_side_per_element: float = 0.5
    score_range: float = 30.0
    information_smoothing: float = 0.6
    prior_blocks: float = 0.1
    bias_range: float = 24.0
    bias_across: float = 0.25
    local_bias_range: float = 8.0
    local_bias_threshold: float = 8.0

    def merged_block_side(self, element: float, extent: Sequence[int] | None = None) -> int:
        """Side (px) of the squares of blocks for elements of side `element` (px); a small region has a few across.

        Parameters
        ----------
        element
            Side of the elements, px.
        extent
            Height and width of the region, px; None: large.

        Returns
        -------
        int
        """
        # of two of 19 px across the uncertainty was 1.8 times what it is
        longest = min(self.score_block_side_per_element * element, np.inf if extent is None else min(extent) // 4)
        return self.score_block_side * max(1, round(longest / self.score_block_side))


USUAL = SolverConstants()
"""The constants that are used by default."""
