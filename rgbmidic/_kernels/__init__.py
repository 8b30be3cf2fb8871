"""All numba code of the project: loops over arrays, no objects, no checks, no allocation in hot loops."""

from pathlib import Path

__all__ = ["are_compiled"]


def are_compiled() -> bool:
    """Whether kernels were compiled on this machine before: one that every solve needs is in the cache."""
    from rgbmidic._kernels.correlation import element_hessian

    return any(Path(element_hessian.__wrapped__.stats.cache_path or "").glob("correlation.element_hessian*.nbi"))
