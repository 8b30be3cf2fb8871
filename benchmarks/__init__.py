"""Every table of the pages by name: `python -m benchmarks` measures them and writes docs/tables (see `tables`)."""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
"""The checkout: it holds the pages, the tests' scenes and the paper's bench, which tables use."""

sys.path += [str(ROOT / "tests"), str(ROOT / "examples" / "paper")]
