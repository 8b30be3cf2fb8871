"""The constants of the solve, each with its source: chosen, measured or derived.

What half and twice a chosen one changes is in ``docs/tables/constants.csv`` (benchmarks/constants.py).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverConstants:
    """Constants of the solve, of the nodes that count as measured and of the stated uncertainty.

    Attributes
    ----------
    first_pass
        Increment (px) at which the first pass hands over to the pass with weights warped anew. At .05 an iteration less
        is needed, but from another initial guess the result differs by up to 2.3e-4 px (measured).
    begun
        Correlation coefficient at the initial guess under which an element waits until its neighbours have brought it
        nearer. Chosen; half or twice of it matters beside a hole and in a deep shadow.
    returns
        Passes after which elements may take part again. Chosen: at a fragment's edge some come and go with every pass,
        which costs iterations; after a single pass what a crack or another body pulls at first is left out for good.
    wandering
        Motion (px) in the last iteration of a pass, and more than half of that in the one before, from which the
        elements around a node are left out after `returns` passes: its own pixels match nothing. Chosen: ten times what
        ends the first pass.
    elsewhere
        Motion (px) of more than `swinging` of the nodes from where weights and grey levels were learnt, after which
        those of several lights are learnt once more: what all lights alike show of the motion hides which of them is
        the precise one. Chosen: a hundredth of a speckle, which a residual still shows.
    swinging
        Fraction of the nodes that may be left out at the end because they still move: a few at the rim of a fragment,
        half of whose pixels match nothing, swing for good; where more do the frame has not converged. Chosen.
    settled
        Fraction of the weight that may still change for the passes to end. Chosen; a hundredth or a hundred times of it
        matter in a deep shadow only.
    looked_at
        That change is the sum over about so many pixels: a change of all weights by that fraction is known to 1 % of it
        (derived).
    passes
        Most passes: each warps the weights with the latest displacement; `returns`, and those that refine after.
    pass_iterations
        Most iterations of a pass: from within half a speckle 4 to 5 do (measured on the truth tests).
    patience
        Iterations of a pass after which a tenth of the nodes may still move: they wander where nothing matches, or
        faster with the weights of the next pass. Chosen; 1 to 3 give the same, with 5 a fragment that has turned takes
        one more.
    swing
        Part of an iteration's motion that the next one takes back, from which steps are shortened: with 1 they diverge,
        and below .5 each halves the error (derived).
    longest_step
        Longest motion of a node in one iteration, px: a speckle (3 to 5 px), beyond which the gradient is another's.
    strained, most_filtered
        Rms change of the inverse stretch ``C^-1 - 1`` (twice the strain) from which the reference is filtered as the
        deformed images are: at a strain of 5 % that takes an error of .0016 px, at half a per cent a tenth. Its
        largest change: a surface compressed to .45, beyond which the filter's first term does not hold. Chosen.
    flattened
        Area of a deformed surface over the square of its stretch (trace of C) from which its deformation gradient
        carries the axes of the reference along, below it the rotation alone: what is 20 times as long as wide, or has
        lost 19 parts in 20 of its area, is no match. Chosen.
    smoothness
        Weight of the smoothness that carries nodes without data along, relative to the texture's median Hessian.
        Chosen; with a tenth or ten times of it three lights under a moving reflection differ by 4e-5 and 4e-4 px at
        most, beside a gap by 7e-4 and 6e-3.
    constant
        Multiple of the identity, relative to the same, that fixes the constant which the smoothness leaves free where
        nothing is seen: 1e5 times less than the smoothness, 1e7 times more than rounding (derived).
    rounding
        Fraction of a node's texture below which that in its worse direction may be rounding: sums of some 1000 products
        in single precision are uncertain by 1000 * 6e-8 at most (derived).
    seen
        A node counts as measured if it has this fraction of the median texture around a node of its area...
    informed
        ...and this fraction of the median information, its texture over the variance of the residual: its noise is then
        10 times the median node's (derived).
    silent
        Fraction of the largest texture below which a node has no part in that median: it is seen by no light, or blank.
    lost
        Uncertainty (px) from which a node is decorrelated: a position uncertain by half a pixel is no match.
    one_sided
        Texture in the worse direction over that in the better one under which the former may be noise... Chosen; half
        or twice of it matters in a deep shadow only.
    noisy
        ...and is, if noise alone would give this fraction of it: displacements along it are 30 % too small (derived).
    matched, matched_precise
        Correlation coefficient under which the images of an element do not match, for poor images and for good ones:
        where the lights count alike, and where they count by their precision, so that a reflection in one of them is no
        mismatch. Chosen.
    worse
        In between: how many times farther from 1 than the median of the elements around. Chosen; with half or twice of
        it lights do not change.
    around
        Elements around: a square of some 5.5 elements a side, of which a crack takes a third.
    torn
        Stretch (norm of C) beyond that of the elements around from which an element is torn, not strained: a strain of
        20 % in both directions more than theirs gives .6.
    shared
        Correlation of a light's gradient with that of the others, in a window, up to which it is matched with the mean
        of all, and from which with that of the others. Lights of smooth paint reach .95 to 1. At .85 the others' mean
        would cost three lights whose paint is their own by 18 % of the variance a tenth (measured).
    follows
        Displacement (px) of what a light alone shows against the solution at which it counts half in its gradient.
        With half or twice of it the error on coarse paint differs by 1 % (measured).
    shown
        Fraction of its Schur complement that the images have of a rigid motion that is measured. The rest is the
        hold's, which holds no data. Lights that see within one element of one another leave .998 or more to the images,
        lights an element further apart .02 or less (measured).
    named
        Least part of a light in a motion that the images do not show, by which the light is named: the parts of the
        lights add up to 1 (derived), so that one of up to ten is named at least.
    lit
        Correlation of both states from which a light has a gain: a lamp that is off shows noise, whose contrast over
        the speckle's is none. Two states of one speckle have .9 and more; of 50 speckles chance makes .3 in 1 of 60
        cases (derived).
    least_gain
        Least local gain over that of the light: where a shadow takes 95 % of it, it is not amplified any further.
    window_of_gain
        Standard deviation of the window of the gain in correlation lengths of the speckle. With 4.5 noise-free coarse
        speckle errs by 1.4 times as much, with 9 a shadow's edge by 1.5 times (benchmarks/grey_levels.py).
    least_window
        ... and at least, px: one and a half blocks of its grid.
    block
        Least side (px) of the blocks whose sums give the covariance of the scores: wider than a speckle and any filter.
    of_element
        Side of a block in sides of an element: what elements cannot follow is alike over about that. With 13 px the
        error of 40 px elements on waves of 3 to 5 elements was 1.5 to 2.3 times the stated one, so 0.8 to 1.2 times
        (DIC Challenge).
    across
        Blocks across a region from which they grow with the element: two of 19 px stated 1.8 times too much.
    projected
        Blocks, every other one in both directions, whose projections the random signs keep apart to half a per cent of
        the fraction; where a region has fewer, those further apart are projected together, every fourth at most.
    anchor
        Multiple of the identity, over the texture of an unknown, that holds nodes without: it takes 1e-6 of the
        projection of the others (derived).
    score_range
        Standard deviation (px) of the window over which block sums are averaged: 67 blocks of 13 px give a variance to
        12 % (derived). With half or twice of it lights differ by 2e-3 px at most, beside a gap by 1e-2, their
        uncertainty by 10 %.
    least_unfitted
        Fraction below which the residual holds no information on the noise: a region of one block (elements of 4 px
        leave 0.1).
    even
        Standard deviation (blocks) of the window in which the information of a block is taken. Chosen; with half or
        twice of it lights differ by 1e-4 px at most, beside a gap by 4e-3, their uncertainty by 4 %.
    prior
        Blocks for which the region's typical score counts in that window: beside a hole there are few.
    bias_range
        Standard deviation (px) of the window in which a light's bias is found: it changes over some 50 px, and the mean
        of the lights that agree is known the better the wider it is. Half of it and 16 px give errors up to 5 % larger
        on raised droplets.
    local_bias_range
        The same (px) where the bias changes by more than chance within that window: a third of it. Of lights displaced
        within discs of 18 to 50 px by .1 to 1 px (144 of them, at random places) errors are 1.2 times what is stated;
        with 12 px 1.9 times, with 5 px .72, and at rest .82 (measured).
    local_bias
        Variances by chance (of both directions together: 2) that such a change must exceed (James and Stein 1961): by
        chance 2 % of the places do. With half of it such errors are 1.03 times what is stated, but means over 50 px are
        stated 15 % larger on scenes without such lights; with twice 1.6 times (measured).
    """

    first_pass: float = 0.01
    begun: float = 0.25
    returns: int = 2
    wandering: float = 0.1
    elsewhere: float = 0.05
    swinging: float = 0.02
    settled: float = 1e-3
    looked_at: int = 10_000
    passes: int = 8
    pass_iterations: int = 12
    patience: int = 3
    swing: float = 0.5
    longest_step: float = 4.0
    strained: float = 0.01
    most_filtered: float = 4.0
    flattened: float = 0.05
    smoothness: float = 1e-4
    constant: float = 1e-9
    rounding: float = 1e-4
    seen: float = 0.05
    informed: float = 0.01
    silent: float = 1e-3
    lost: float = 0.5
    one_sided: float = 0.3
    noisy: float = 0.3
    matched: tuple[float, float] = (0.4, 0.6)
    matched_precise: tuple[float, float] = (0.4, 0.9)
    worse: float = 8.0
    around: int = 61
    torn: float = 0.5
    shared: tuple[float, float] = (0.85, 0.95)
    follows: float = 0.1
    shown: float = 0.5
    named: float = 0.1
    lit: float = 0.3
    least_gain: float = 0.05
    window_of_gain: float = 6.0
    least_window: float = 6.0
    block: int = 13
    of_element: float = 0.75
    across: int = 4
    projected: int = 700
    anchor: float = 1e-6
    score_range: float = 30.0
    least_unfitted: float = 0.05
    even: float = 0.6
    prior: float = 0.1
    bias_range: float = 24.0
    local_bias_range: float = 8.0
    local_bias: float = 8.0


USUAL = SolverConstants()
"""The constants as they are used where nobody states others."""
