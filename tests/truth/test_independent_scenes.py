"""Scenes of a renderer that shares no code with the project: no figure is worse than the best that any release reached.

The best are in independent_scenes.csv, each with its commit; `python tests/independent_scenes.py` takes over what is
better.
"""

from __future__ import annotations

import pytest
from independent_scenes import CROPS, FULL, QUANTITIES, figures, off, read_best

WORSE = 1.05
"""Ratio of a figure to the best so far from which it is a loss: frames and truth are files, so it changes by rounding
alone, and by the code."""
CONSISTENT = 1.25
"""Error over stated uncertainty, or its inverse, that counts as right: of 80 means that overlap it scatters by .1."""


@pytest.mark.parametrize("scene", [*FULL, *CROPS])
def test_no_figure_is_worse_than_the_best_of_any_release(scene, tmp_path):
    found, best = figures(scene, tmp_path), {key: row for key, row in read_best().items() if key[0] == scene}
    assert set(found) == set(best)
    assert {quantity for *_, quantity in found} == set(QUANTITIES)
    worse = []
    for key, (rms, ratio) in found.items():
        row, name = best[key], "{}, frame {}, {}".format(*key)
        if not rms <= WORSE * float(row["rms [px]"]):
            worse.append(f"{name}: rms {rms:.5f} px, the best {row['rms [px]']} ({row['rms of commit']})")
        if key[2] != "pixels" and not off(ratio) <= WORSE * max(off(float(row["error/stated"])), CONSISTENT):
            worse.append(f"{name}: error/stated {ratio:.3f}, the best {row['error/stated']} ({row['ratio of commit']})")
    assert not worse, "\n".join(worse)
