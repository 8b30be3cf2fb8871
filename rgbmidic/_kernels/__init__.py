"""All numba code of the project: loops over arrays, no objects, no checks, no allocation in hot loops."""
