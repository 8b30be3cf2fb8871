"""Masks of any kind that a paint program writes are the same region; soft edges and JPEG noise do not let it grow."""

from __future__ import annotations

import logging

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from rgbmidic.errors import FrameError, RegionError
from rgbmidic.frames import read_mask
from rgbmidic.pipeline.plan import read_region
from rgbmidic.settings import RegionSettings

Y, X = np.mgrid[:120, :160]
RING = (np.hypot(X - 80, Y - 60) < 50) & (np.hypot(X - 80, Y - 60) > 15)
WHITE, ONES = RING * np.uint8(255), np.full(RING.shape, 255, np.uint8)


def palette():
    picture = Image.fromarray(RING.astype(np.uint8), "P")
    picture.putpalette([0, 0, 0, 200, 30, 30])
    return picture


def saved(picture):
    return lambda path: picture.save(path)


WRITERS = {
    "grey.png": saved(Image.fromarray(WHITE)),
    "one.png": saved(Image.fromarray(RING.astype(np.uint8))),
    "bits.png": saved(Image.fromarray(WHITE).convert("1")),
    "bits.bmp": saved(Image.fromarray(WHITE).convert("1")),
    "palette.png": saved(palette()),
    "red.png": saved(Image.fromarray(np.dstack([WHITE, 0 * WHITE, 0 * WHITE]))),
    "opaque.png": saved(Image.fromarray(np.dstack([WHITE] * 3 + [ONES]))),
    "cut_out.png": saved(Image.fromarray(np.dstack([ONES] * 3 + [WHITE]))),
    "grey_alpha.png": saved(Image.fromarray(np.dstack([WHITE, ONES]), "LA")),
    "bits16.png": saved(Image.fromarray(RING.astype(np.uint16))),
    "jpeg.jpg": lambda path: Image.fromarray(WHITE).save(path, quality=75),
    "soft.png": saved(Image.fromarray(cv2.GaussianBlur(WHITE, (0, 0), 1.5))),
    "grey.bmp": saved(Image.fromarray(WHITE)),
    "fax.tif": lambda path: Image.fromarray(WHITE).convert("1").save(path, compression="group4"),
    "lzw.tif": lambda path: Image.fromarray(WHITE).save(path, compression="tiff_lzw"),
    "bool.tif": lambda path: tifffile.imwrite(path, RING),
    "float.tif": lambda path: tifffile.imwrite(path, RING.astype(np.float32)),
    "inverted.tif": lambda path: tifffile.imwrite(path, 255 - WHITE, photometric="miniswhite"),
    "bool.npy": lambda path: np.save(path, RING),
    "bytes.npy": lambda path: np.save(path, RING.astype(np.uint8)),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_file_of_a_mask_is_the_region_that_was_painted(tmp_path, name, caplog):
    WRITERS[name](tmp_path / name)
    with caplog.at_level(logging.WARNING):
        region = read_region(RegionSettings(mask=tmp_path / name), RING.shape)
    assert not caplog.records
    if name in ("jpeg.jpg", "soft.png"):  # half a pixel of the rim, no more
        assert (region.mask != RING).sum() < 0.02 * RING.sum()
        assert (read_mask(tmp_path / name) > 0).sum() > 1.05 * RING.sum()
    else:
        np.testing.assert_array_equal(region.mask, RING)


def test_values_count_by_their_fraction_of_the_largest(tmp_path):
    np.save(tmp_path / "mask.npy", np.array([[0, 1, 2], [3, 4, 0]]))
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.npy"), [[0, 0.25, 0.5], [0.75, 1, 0]])


def test_a_picture_of_labels_is_doubtful(tmp_path, caplog):
    Image.fromarray(RING * np.uint8(3) + ((X < 20) & (Y < 20)) * np.uint8(200)).save(tmp_path / "labels.png")
    with caplog.at_level(logging.WARNING):
        read_region(RegionSettings(mask=tmp_path / "labels.png"), RING.shape)
    assert f"{RING.sum()} pixels under half of the largest value are not measured, 400 are" in caplog.text


def test_what_is_no_mask_is_one_line(tmp_path):
    for name, array in (("cube", np.ones((2, 3, 4))), ("text", np.array([["a"]])), ("nan", np.array([[1, np.nan]]))):
        np.save(tmp_path / f"{name}.npy", array)
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (50, 50), np.uint8)).save(tmp_path / "whole.png")
    content = (tmp_path / "whole.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(content[:1000])
    (tmp_path / "wrong.png").write_bytes(content[:500] + bytes([content[500] ^ 1]) + content[501:])
    (tmp_path / "text.png").write_text("no picture", encoding="utf-8")
    (tmp_path / "short.npy").write_bytes((tmp_path / "cube.npy").read_bytes()[:150])
    messages = {
        "cube.npy": r"one image \(H, W\).*shape \(2, 3, 4\)",
        "text.npy": "of numbers",
        "nan.npy": "negative or not finite",
        "cut.png": "cannot be read: .*truncated",
        "wrong.png": "damaged|cannot be read",
        "text.png": "is no mask: allowed are pictures",
        "short.npy": "damaged",
        "missing.png": "not found: .*missing.png",
    }
    for name, message in messages.items():
        with pytest.raises(FrameError, match=message):
            read_mask(tmp_path / name)
    Image.fromarray(0 * WHITE).save(tmp_path / "black.png")
    with pytest.raises(RegionError, match=r"black\.png: the region of interest is empty"):
        read_region(RegionSettings(mask=tmp_path / "black.png"), RING.shape)
