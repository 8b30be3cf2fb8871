"""What all tests share: the folder of real data, where this machine has it, and an end to what hangs."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:  # the processes share the cores already
    os.environ.setdefault("RGBMIDIC_THREADS", "1")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the shared real data: RGBMIDIC_SHARED_DATA, else ../shared/data beside the checkout, else skip."""
    stated = os.environ.get("RGBMIDIC_SHARED_DATA")
    folder = Path(stated) if stated else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no shared data at {folder}; set RGBMIDIC_SHARED_DATA to its folder")
    return folder


@pytest.fixture
def alarm() -> Iterator[None]:
    """What waits for ever fails after 20 s."""

    def stop(*_: object) -> None:
        raise TimeoutError("it hangs")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say which figures of README and docs this run has not checked, because it had no real data."""
    skipped = terminalreporter.stats.get("skipped", [])
    unchecked = sorted({report.nodeid.split("[")[0] for report in skipped if "no shared data" in str(report.longrepr)})
    if unchecked:
        terminalreporter.section("figures on real data that were not checked (no shared data)")
        for name in unchecked:
            terminalreporter.write_line(name)
