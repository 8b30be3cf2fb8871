"""All numba code of the project: loops over arrays, no objects, no checks, no allocation in hot loops."""

import os
from pathlib import Path

__all__ = ["are_compiled"]

# numba's OpenMP threads otherwise spin while they wait, and slow down whatever runs beside them (OpenCV, scipy, other
# processes); must be set before the first parallel kernel runs
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def are_compiled() -> bool:
    """Whether kernels were compiled on this machine before: what the solve takes longest to compile is in the cache."""
    from rgbmidic._kernels.correlation import element_hessian

    return any(Path(element_hessian.stats.cache_path or "").glob("correlation.element_hessian*.nbi"))
