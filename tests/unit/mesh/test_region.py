"""Regions of interest: which pixels belong to a rectangle, a polygon, a mask, and what is refused."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from rgbmidic.errors import RegionError
from rgbmidic.mesh import Region

SHAPE = (41, 60)


@pytest.mark.parametrize(
    ("rectangle", "rows", "columns"),
    [
        ((10, 5, 30, 20), (5, 20), (10, 30)),
        ((9.2, 4.9, 30.8, 20.1), (5, 20), (10, 30)),
        ((0, 0, 59, 40), (0, 40), (0, 59)),
        ((0.0, 0.0, 59.4, 40.4), (0, 40), (0, 59)),
    ],
)
def test_a_rectangle_holds_the_pixels_whose_centres_lie_on_it(rectangle, rows, columns):
    expected = np.zeros(SHAPE, dtype=bool)
    expected[rows[0] : rows[1] + 1, columns[0] : columns[1] + 1] = True
    np.testing.assert_array_equal(Region.from_rectangle(rectangle, SHAPE).mask, expected)


def test_a_rectangle_beyond_the_image_is_clipped_with_a_warning(caplog):
    with caplog.at_level(logging.WARNING):
        region = Region.from_rectangle((-5, 10, 30, 100), SHAPE)
    assert region.rectangle == (0, 10, 30, 40)
    assert "the rectangle [[-5.0, 10.0], [30.0, 100.0]] reaches outside the image of 60 x 41 px" in caplog.text


def test_a_polygon_beyond_the_image_is_told(caplog):
    with caplog.at_level(logging.WARNING):
        Region.from_polygon([(0, 0), (59.4, 0), (59, 40.5)], SHAPE)
        assert not caplog.records
        Region.from_polygon([(10, 10), (90, 10), (30, 30)], SHAPE)
    assert "polygon" in caplog.text
    assert "reaches outside the image of 60 x 41 px" in caplog.text


@pytest.mark.parametrize(("rectangle", "width"), [((10, 5, 30, 20), 16), ((3, 3, 11, 38), 9), ((0, 0, 59, 40), 41)])
def test_the_width_of_a_region_is_that_of_the_largest_disc_in_it(rectangle, width):
    assert Region.from_rectangle(rectangle, SHAPE).width == pytest.approx(width, abs=1)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    assert Region.from_mask(np.hypot(x - 20, y - 20) < 12).width == pytest.approx(23, abs=1)
    strip = Region.from_mask(abs(x - y) < 5)
    assert strip.width == pytest.approx(9 / np.sqrt(2), abs=1.5)


@pytest.mark.parametrize(
    ("rectangle", "message"),
    [
        ((30, 5, 10, 20), "x0 < x1"),
        ((10, 20, 30, 20), "x0 < x1"),
        ((10, 5, 30), "four finite numbers"),
        ((10, 5, float("nan"), 20), "four finite numbers"),
        ((100, 5, 130, 20), "does not overlap the image of 60 x 41 px"),
        ((10, -30, 30, -1), "does not overlap"),
    ],
)
def test_impossible_rectangles_are_refused(rectangle, message):
    with pytest.raises(RegionError, match=message):
        Region.from_rectangle(rectangle, SHAPE)


def test_a_polygon_holds_what_lies_inside_its_corners():
    corners = np.array([(10.0, 5.0), (50.0, 8.0), (30.0, 35.0)])
    mask = Region.from_polygon(corners, SHAPE).mask
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = np.full(SHAPE, np.inf)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        side = ((x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)) / np.hypot(x1 - x0, y1 - y0)
        depth = np.minimum(depth, side)
    assert mask[depth > 0.75].all()
    assert not mask[depth < -0.75].any()


def test_a_polygon_as_a_rectangle_holds_the_same_pixels():
    polygon = Region.from_polygon([(10, 5), (30, 5), (30, 20), (10, 20)], SHAPE)
    np.testing.assert_array_equal(polygon.mask, Region.from_rectangle((10, 5, 30, 20), SHAPE).mask)


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ([(0, 0), (10, 10)], "at least three"),
        ([(0, 0), (10, 10), (float("inf"), 3)], "at least three finite"),
        ([(0, 0, 1), (10, 10, 1), (3, 4, 1)], "at least three"),
        ([(200, 200), (210, 200), (205, 210)], "does not overlap"),
    ],
)
def test_impossible_polygons_are_refused(corners, message):
    with pytest.raises(RegionError, match=message):
        Region.from_polygon(corners, SHAPE)


def test_a_mask_is_its_non_zero_pixels_and_must_have_the_images_size():
    picture = np.zeros(SHAPE, dtype=np.uint8)
    picture[5:20, 10:30] = 255
    np.testing.assert_array_equal(Region.from_mask(picture, SHAPE).mask, picture > 0)
    with pytest.raises(RegionError, match=r"60, 41.*41, 60|\(60, 41\)"):
        Region.from_mask(picture, (60, 41))
    with pytest.raises(RegionError, match="empty"):
        Region.from_mask(np.zeros(SHAPE), SHAPE)
    with pytest.raises(RegionError, match=r"one \(H, W\) image"):
        Region.from_mask(np.ones((3, *SHAPE)))


def test_holes_are_left_out_and_the_rest_stays():
    region = Region.from_rectangle((2, 2, 30, 20), (40, 40))
    holes = [[(5, 5), (9, 5), (9, 9), (5, 9)], [(20, 10), (24, 10), (24, 14)]]
    left = region.without(holes)
    assert not left.mask[5:10, 5:10].any()
    inside = np.logical_or(*(Region.from_polygon(hole, (40, 40)).mask for hole in holes))
    assert (left.mask == (region.mask & ~inside)).all()
    assert left.rectangle is None
    assert region.without([]) is region
    with pytest.raises(RegionError, match="empty"):
        region.without([[(0, 0), (39, 0), (39, 39), (0, 39)]])
