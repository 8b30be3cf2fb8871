"""Print tables: python evidence.py [TABLE ...] (public_pairs grey_levels frame_border background_at_rest turned)."""

import os
import sys
import time
import warnings
from pathlib import Path

sys.path += [str(Path(__file__).parent / "tests"), str(Path(__file__).parent / "calibration")]
warnings.simplefilter("ignore")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")
import importlib  # noqa: E402

from benchmarks.tables import TABLES, Table  # noqa: E402

for module in ("grey_levels", "public_pairs", "challenge"):
    importlib.import_module(f"benchmarks.{module}")
for name in sys.argv[1:] or ["public_pairs", "grey_levels", "frame_border", "background_at_rest", "turned"]:
    begin = time.perf_counter()
    made = Table.of(TABLES[name], TABLES[name].measure(False))
    rows = [made.columns, *made.rows]
    wide = [max(len(row[k]) for row in made.rows) for k in range(len(made.columns))]
    print(f"=== {name}: {' | '.join(made.columns)}")
    for row in made.rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, wide, strict=True)))
    print(f"    {time.perf_counter() - begin:.0f} s", flush=True)
