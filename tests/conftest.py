"""What all tests share: the folders of real files, and an end to what hangs."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest
import real_files

if "PYTEST_XDIST_WORKER" in os.environ:  # the processes share the cores already
    os.environ.setdefault("RGBMIDIC_THREADS", "1")


@pytest.fixture(scope="session")
def real_data() -> real_files.RealData:
    """Gives the folder of real files of a name: the full ones where this machine has them, else their crops."""
    return real_files.real_folder


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
    """Say which figures of README and docs this run has not checked, because it had no full files."""
    skipped = terminalreporter.stats.get("skipped", [])
    unchecked = sorted({report.nodeid.split("[")[0] for report in skipped if "no shared data" in str(report.longrepr)})
    if unchecked:
        terminalreporter.section("figures on real data that were not checked (no shared data)")
        for name in unchecked:
            terminalreporter.write_line(name)
