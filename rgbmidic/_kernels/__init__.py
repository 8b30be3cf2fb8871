"""All numba code of the project: loops over arrays, no objects, no checks, no allocation in hot loops."""

import os

# numba's OpenMP threads otherwise spin while they wait, and slow down whatever runs beside them (OpenCV, scipy, other
# processes); must be set before the first parallel kernel runs
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
