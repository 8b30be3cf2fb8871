"""Pictures decoded by OpenCV."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rgbmidic.typing import AnyArray

__all__ = ["decode"]


def decode(path: Path) -> AnyArray | None:
    """Samples as stored, (H, W) or (H, W, 3) in the order R, G, B; None where OpenCV cannot decode them."""
    import cv2

    previous = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # faults come back as one FrameError
    try:
        # OpenCV opens no non-ASCII names on Windows, hence decoding from memory
        image = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    finally:
        cv2.utils.logging.setLogLevel(previous)
    if image is None or image.ndim == 2:
        return image
    return image[..., ::-1] if image.shape[2] == 3 else image
