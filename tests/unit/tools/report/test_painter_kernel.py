"""The kernel that paints a field paints what its naive twin does, on any number of threads."""

from __future__ import annotations

import naive_picture
import numpy as np
import pytest
from bits import assert_same_on_threads

from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.tools.report.kernels import paint_field

MESH = Tri3Mesh.from_region(Region.from_rectangle((3, 2, 40, 30), (34, 46)), 9)


def arguments(seed, *, nearest):
    """A field with nodes that are not measured, over random grey, on nodes that have moved a little, some beyond."""
    random = np.random.default_rng(seed)
    x, y = (MESH.nodes + random.uniform(-2, 2, MESH.nodes.shape)).T.copy()
    x[random.integers(len(x))] += 40
    values = random.normal(0, 1, len(x))
    values[random.integers(len(x), size=2)] = np.nan
    y[random.integers(len(x))] = np.nan
    grey = random.integers(0, 256, (34, 46)).astype(np.uint8)
    colours = random.integers(0, 2**23, 16).astype(np.uint32) & 0x7F7F7F | 0xFF000000
    return grey, x, y, MESH.elements, values, -1.0, 1.2, colours.astype(np.uint32), 100, nearest


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_it_paints_as_its_naive_twin(seed, nearest):
    given = arguments(seed, nearest=nearest)
    painted, expected = np.zeros((2, 34, 46), dtype=np.uint32)
    paint_field(painted, *given)
    naive_picture.paint_field(expected, *given)
    grey_only = given[0] * np.uint32(0x010101) | np.uint32(0xFF000000)
    assert (painted != grey_only).mean() > 0.3
    # a pixel on an edge, or at the border between two colours, may fall to either side
    assert (painted == expected).mean() > 0.995


def test_any_number_of_threads_paints_the_same():
    given = arguments(5, nearest=False)

    def painted():
        image = np.zeros((34, 46), dtype=np.uint32)
        paint_field(image, *given)
        return [image]

    assert_same_on_threads(painted)
