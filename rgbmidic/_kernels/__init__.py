"""All numba code of the core: loops over arrays, no objects, no checks, no allocation in hot loops."""

from pathlib import Path

__all__ = ["are_compiled"]


def are_compiled() -> bool:
    """Tell whether kernels were compiled on this machine before: one that every solve needs is in the cache.

    Returns
    -------
    bool
    """
    from rgbmidic._kernels.mesh import claim_pixels

    return any(Path(claim_pixels.dispatcher.stats.cache_path or "").glob("mesh.claim_pixels*.nbi"))
