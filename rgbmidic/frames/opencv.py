"""Pictures decoded by OpenCV."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rgbmidic.frames.complaints import complaints
from rgbmidic.frames.stored import damaged
from rgbmidic.typing import AnyArray

__all__ = ["decode"]

_PLACE = re.compile(r"^\[ERROR\S*\] global \S+ \S+ ")
"""Where in OpenCV a line of its log comes from."""


def decode(content: bytes, path: Path) -> AnyArray:
    """Samples as stored, (H, W) or (H, W, C), three channels in the order R, G, B; `path` is for messages.

    Raises
    ------
    FrameError
        OpenCV cannot decode them.
    """
    import cv2

    previous = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        with complaints(b"libpng error", b"libpng warning", b"[ERROR", b"> ") as told:
            # OpenCV opens no non-ASCII names on Windows, hence decoding from memory
            image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    finally:
        cv2.utils.logging.setLogLevel(previous)
    errors = [line for line in told if not line.startswith("libpng warning")]  # of parts that are not used
    if image is None or errors:  # libtiff's errors do not always keep OpenCV from giving a picture
        raise damaged(path, _PLACE.sub("", errors[0]) if errors else "its image data cannot be decoded")
    return image[..., ::-1] if image.ndim == 3 and image.shape[2] == 3 else image
