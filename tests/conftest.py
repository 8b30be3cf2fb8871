"""What all tests share: threads, kernels, renders, the draws of the noise, real files, and an end to what hangs."""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
from collections.abc import Generator, Iterator
from contextlib import ExitStack, nullcontext
from functools import cache

import pytest
import real_files
import typer.main
from draws import JITTER, SAMPLERS, other_draws
from hypothesis import HealthCheck, settings
from kernels_of_tests import compiled_in_background
from matplotlib.figure import Figure
from renders import kept_renders, new_renders

from rgbmidic.tools import report

settings.register_profile(
    "on any machine", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)  # a verdict is of the code, not of the draw
settings.load_profile("on any machine")
_compilation = ExitStack()
THREADS = ("RGBMIDIC_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options under which nothing may fail: no verdict depends on a draw of the noise."""
    group = parser.getgroup("other draws of the noise (see CONTRIBUTING.md)")
    group.addoption("--draw", type=int, default=0, metavar="N", help="another noise of every virtual camera: 1, 2, ...")
    group.addoption("--sampler", choices=SAMPLERS, default="poisson", help="of the photons: rounded normal numbers")
    group.addoption("--jitter", action="store_const", const=JITTER, default=0.0, help="of renders: 1e-6 of each pixel")


def pytest_configure(config: pytest.Config) -> None:
    """Let the processes of the run share cores, kernels and renders; exchange the noise where an option asks for it."""
    logging.getLogger().setLevel(logging.INFO)  # once: `log_level` sets it for every phase of every test
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # sources are compiled once, as kernels are, not by every process
    sys.dont_write_bytecode = False
    typer.main.get_command = cache(typer.main.get_command)  # 15 ms, of every command that a test executes
    if getattr(config.option, "numprocesses", None):
        os.environ |= {name: os.environ.get(name, "1") for name in THREADS}
        if not config.option.collectonly:
            _compilation.enter_context(compiled_in_background())
            config.add_cleanup(_compilation.close)
    else:
        gc.disable()  # a third of the time of collecting tests is that of looking through what they are made of
    stack = ExitStack()
    stack.enter_context(kept_renders())
    stack.enter_context(other_draws(config.option.draw, config.option.sampler, config.option.jitter))
    config.add_cleanup(stack.close)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished() -> None:
    """Wait for the kernels, which are compiled while the tests are collected: no two processes compile the same."""
    _compilation.close()


def pytest_collection_finish() -> None:
    """Let no collection of garbage look through what the tests are made of."""
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)  # a twentieth of the time of the tests
    gc.enable()


RENDERER = ("lab/virtual", "kernels")
"""Rooms whose tests are about the renderer."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Render anew where the renderer is tested."""
    with new_renders() if item.path.parent.as_posix().endswith(RENDERER) else nullcontext():
        return (yield)


@pytest.fixture(scope="session")
def real_data() -> real_files.RealData:
    """Gives the folder of real files of a name: the full ones where this machine has them, else their crops."""
    return real_files.real_folder


DEADLINE = 600
"""Seconds after which a test hangs: the longest takes 15 on an idle machine."""


@pytest.fixture(autouse=True)
def alarm() -> Iterator[None]:
    """What waits for ever fails."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def stop(*_: object) -> None:
        raise TimeoutError(f"it hangs: {DEADLINE} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(DEADLINE)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures and movies that nobody looks at are drawn with a third of the resolution, texts wherever they fall."""
    savefig, movie = Figure.savefig, report.FieldMovie

    def coarse(figure: Figure, *to: object, **how: object) -> None:
        figure.set_layout_engine("none")  # an engine draws every text several times
        savefig(figure, *to, **how | {"dpi": 50})

    monkeypatch.setattr(Figure, "savefig", coarse)
    monkeypatch.setattr(report, "FieldMovie", lambda **shown: movie(**shown | {"width": 480}))


@pytest.fixture
def blank_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made and not drawn, in tests about what is written beside them."""
    savefig = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda _, *to, **how: savefig(Figure((1, 1)), *to, **how))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say which figures of README and docs this run has not checked, because it had no full files."""
    skipped = terminalreporter.stats.get("skipped", [])
    unchecked = sorted({report.nodeid.split("[")[0] for report in skipped if "no shared data" in str(report.longrepr)})
    if unchecked:
        terminalreporter.section("figures on real data that were not checked (no shared data)")
        for name in unchecked:
            terminalreporter.write_line(name)
