"""How the kernels are compiled: once for the processor, kept in a cache, free of the interpreter's lock."""

from functools import partial

from numba import njit

__all__ = ["compiled", "helper"]

# a division by zero gives what the processor gives, and C callers are not catered for: less code, sooner compiled
compiled = partial(njit, cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True)
helper = partial(compiled, no_cpython_wrapper=True)
"""For a function that only kernels call."""
