"""Measure the tables of the pages: `python -m benchmarks [NAME ...]`, with `--quick`, `--pages`, `--list` and others.

Each table is measured in a process of its own with one thread and written as a whole to docs/tables/NAME.csv, with
the commit, date, seed, machine and versions it was measured with, and into the pages that show it; `--pages` writes the
pages alone, from the files. `--quick`
measures a few rows and writes nothing unless `--out` names a folder. A table that fails does not stop the others; the
exit status is 1 then. `--scatter` measures how far draws of the cameras' noise scatter the quick rows and writes
docs/tables/scatter/NAME.csv, by which the tests compare them.
"""

from __future__ import annotations

import argparse
import datetime
import importlib
import importlib.metadata
import os
import platform
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from renders import kept_renders

from . import ROOT
from .tables import FOLDER, TABLES, Table, fill_pages, load, measured

ONE_THREAD = ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
PACKAGES = ("numpy", "scipy", "numba", "opencv-python-headless", "rgbmidic")


def provenance() -> dict[str, str]:
    """Where figures come from: commit, date, machine and versions."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
        return done.stdout.strip() if done.returncode == 0 else ""

    dirty = git("status", "--porcelain", "--", ".", ":!docs/tables")
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "from the checkout" if package == "rgbmidic" else "missing"
    return {
        "commit": (git("rev-parse", "--short", "HEAD") or "unknown") + ("-dirty" if dirty else ""),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": f"{os.cpu_count()} cores, {_processor()}",
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def isolated(name: str, quick: bool, header: dict[str, str], scatter: bool) -> tuple[Table | None, float]:
    """A table measured in a process that may die without taking another along."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        return process.submit(measured, TABLES[name].measure.__module__, name, quick, header, scatter).result()


def main() -> int:
    """Read the command line, measure the tables asked for and return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="tables to measure; all if none is named")
    parser.add_argument("--quick", action="store_true", help="a few rows of each; written only where --out is given")
    parser.add_argument("--scatter", action="store_true", help="how draws of the noise scatter the figures of --quick")
    parser.add_argument(
        "--pages", action="store_true", help="measure nothing: write tables and descriptions into the pages"
    )
    parser.add_argument("--list", action="store_true", help="names, pages and CPU seconds of the tables")
    parser.add_argument("--processes", type=int, default=1, metavar="N", help="tables measured at once (default 1)")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help=f"default: {FOLDER.relative_to(ROOT)}")
    options = parser.parse_args()
    if options.pages:
        sys.path.append(str(ROOT / "docs" / "_ext"))
        fill_pages()
        fill_pages(importlib.import_module("reference").filled)
        return 0
    broken = load()
    if unknown := [name for name in options.names if name not in TABLES]:
        print(f"tables are: {', '.join(sorted(TABLES))}; given was {', '.join(unknown)}", file=sys.stderr)
        return 2
    if options.processes < 1:
        print(f"--processes is a whole number from 1, not {options.processes}", file=sys.stderr)
        return 2
    if options.out is not None and options.out.exists() and not options.out.is_dir():
        print(f"--out is a folder; {options.out} is a file", file=sys.stderr)
        return 2
    names = sorted(set(options.names) or TABLES, key=lambda name: -TABLES[name].cost)
    if options.list:
        for name in sorted(names):
            print(f"{name:24} {TABLES[name].cost:6g} s  {TABLES[name].page:30} {TABLES[name].caption}")
        return 0
    os.environ |= dict.fromkeys(ONE_THREAD, "1")
    failed = {f"module {name}": reason for name, reason in broken.items()}
    start = time.perf_counter()
    with kept_renders():
        # times come last, one at a time
        for timing, processes in ((False, options.processes), (True, 1)):
            some = [name for name in names if TABLES[name].timing == timing and not (timing and options.scatter)]
            failed |= measure(some, options.quick, options.out, processes, options.scatter)
    print(f"{len(names)} tables in {time.perf_counter() - start:.0f} s")
    for name, reason in failed.items():
        print(f"failed: {name}, {reason}", file=sys.stderr)
    return 1 if failed else 0


def measure(names: list[str], quick: bool, out: Path | None, processes: int, scatter: bool) -> dict[str, str]:
    """Measure tables, several at once, write them where they belong and return why those that failed did.

    Where the quick rows are a smaller case, they are measured with the full ones and written to `quick` beside them.
    """
    header, work, failed = provenance(), {}, {}
    place = out or (None if quick else FOLDER)
    with ThreadPoolExecutor(processes) as pool:
        for name in names:
            if scatter:
                full = header | {"command": f"python -m benchmarks {name} --scatter"}
                work[pool.submit(isolated, name, True, full, True)] = name, (out or FOLDER) / "scatter"
                continue
            full = header | {"command": f"python -m benchmarks {name}{' --quick' if quick else ''}"}
            work[pool.submit(isolated, name, quick, full, False)] = name, place
            if TABLES[name].own_quick and not quick:
                small = header | {"command": f"python -m benchmarks {name} --quick"}
                work[pool.submit(isolated, name, True, small, False)] = name, (out or FOLDER) / "quick"
        for done in as_completed(work):
            name, folder = work[done]
            try:
                made, seconds = done.result()
                if made is None:
                    (folder / f"{name}.csv").unlink(missing_ok=True)
                    print(f"{name}: no figure scatters, {seconds:.1f} CPU s", flush=True)
                    continue
                if folder is not None:
                    made.write(folder / f"{name}.csv")
                if folder == FOLDER:
                    fill_pages()
            except Exception as error:
                failed[name] = f"{type(error).__name__}: {error}"
                print(f"{name}: failed, {failed[name]}", file=sys.stderr, flush=True)
            else:
                print(f"{made.header['command']}: {len(made.rows)} rows, {seconds:.1f} CPU s", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
