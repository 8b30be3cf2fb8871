"""Masks as paint programs write them: grey, colour, palette or transparent pictures of 1 to 16 bit; .npy arrays."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from rgbmidic.arguments import checked
from rgbmidic.disk import require_regular_file
from rgbmidic.errors import FrameError, disk_reason
from rgbmidic.typing import AnyArray, FloatImage

SOFTWARE = 305
"""Tag of a TIFF file: the program that wrote it."""


@checked
def read_mask(path: Path) -> FloatImage:
    """Read a mask; of a colour counts its strongest channel, and of what is transparent the visible part.

    Parameters
    ----------
    path
        A picture that Pillow reads (PNG, TIFF, BMP, JPEG, GIF, ...), or a .npy file of an array (H, W).

    Returns
    -------
    ndarray, shape (H, W), float32
        Fractions of the largest value in the file, 0 to 1.

    Raises
    ------
    FrameError
        The file is missing, damaged or no picture, or has values that are negative or not finite.

    Examples
    --------
    >>> np.save("mask.npy", np.array([[0, 255], [255, 51]], dtype=np.uint8))
    >>> read_mask(Path("mask.npy")).tolist()
    [[0.0, 1.0], [1.0, 0.20000000298023224]]
    >>> Path("mask.npy").unlink()
    """
    from PIL import Image, UnidentifiedImageError

    try:
        load = np.load if require_regular_file(path).suffix.lower() == ".npy" else _strongest_channel
        values = load(path)
    except UnidentifiedImageError:
        raise FrameError(f"{path} is no mask: allowed are pictures (PNG, TIFF, BMP, JPEG) and .npy arrays") from None
    except FileNotFoundError:
        raise FrameError(f"the mask is not found: {path}") from None
    except OSError as error:
        raise FrameError(f"the mask {path} cannot be read: {disk_reason(error) if error.errno else error}") from None
    except (SyntaxError, ValueError, EOFError, Image.DecompressionBombError) as error:  # Pillow's for damaged files
        raise FrameError(f"the mask {path} is damaged: {error}") from None
    if values.ndim != 2 or values.dtype.kind not in "buif":
        raise FrameError(f"a mask is one image (H, W) of numbers; {path} is {values.dtype} of shape {values.shape}")
    if not np.isfinite(values).all() or values.min(initial=0) < 0:
        raise FrameError(f"a mask has no values that are negative or not finite; {path} has")
    largest = max(float(values.max(initial=0)), float(np.finfo(np.float32).tiny))
    return np.asarray(values / largest, dtype=np.float32)


def _strongest_channel(path: Path) -> AnyArray:
    """Return the strongest channel of each pixel of a picture, times its opacity."""
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # frames of 100 Mpx are none
        with Image.open(path) as picture:
            if picture.mode == "1" and getattr(picture, "tag_v2", {}).get(SOFTWARE) == "tifffile.py":
                return ~np.asarray(picture)  # tifffile and scikit-image store True as 1 and state that 0 is white
            if picture.mode in ("1", "L", "I", "F") or picture.mode.startswith("I;16"):
                return np.asarray(picture)
            pixels = np.asarray(picture.convert("RGBA"), dtype=np.float32)
    return np.asarray(pixels[..., :3].max(axis=-1) * pixels[..., 3])
