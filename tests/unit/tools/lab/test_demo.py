"""The small measurements that compile the kernels while the demonstration's frames are rendered."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rgbmidic.tools.lab import demo

_REST = """
import importlib, pkgutil, sys
from pathlib import Path
import rgbmidic._kernels
from rgbmidic._kernels.threads import Kernel
from rgbmidic.tools.lab import demo

def kernels():
    names = [one.name for one in pkgutil.iter_modules(rgbmidic._kernels.__path__)]
    modules = [importlib.import_module(f"rgbmidic._kernels.{name}") for name in names]
    found = [value for module in modules for value in vars(module).values() if type(value) is Kernel]
    return {(one.__name__, form) for one in found if one.over for form in one.dispatcher.signatures}

for part in demo._SMALL_MEASUREMENTS.values():
    part()
before = kernels()
from small_tests import colour_test
from rgbmidic.pipeline import measure
test = colour_test(Path(sys.argv[1]) / "test")
measure(test.settings(), Path(sys.argv[1]) / "result")
print(len(before), *sorted({name for name, _ in kernels() - before}))
"""


def test_a_measurement_compiles_nothing_that_the_small_measurements_have_not(tmp_path):
    """Of the core; those of the renderer, which makes this test's frames, are its own."""
    tests = str(Path(__file__).parents[3])
    script = f"import sys; sys.path.insert(0, {tests!r})\n{_REST}"
    # -P: not the package of a clone in whose folder this runs, whose kernels lie elsewhere
    done = subprocess.run([sys.executable, "-P", "-c", script, tmp_path], capture_output=True, text=True, check=True)
    number, *more = done.stdout.split()
    assert int(number) > 15
    assert not more


def test_what_goes_wrong_meanwhile_ends_the_compilation(monkeypatch):
    monkeypatch.setattr(demo, "are_compiled", lambda: False)
    started = []
    monkeypatch.setattr(demo.subprocess, "Popen", _noting(started))
    with pytest.raises(KeyboardInterrupt), demo.compile_kernels_in_background():
        raise KeyboardInterrupt
    assert len(started) == 2
    assert [one.returncode for one in started] == [-signal.SIGKILL] * 2


def test_nothing_is_started_where_the_kernels_are_compiled(monkeypatch):
    monkeypatch.setattr(demo, "are_compiled", lambda: True)
    monkeypatch.setattr(demo.subprocess, "Popen", lambda *_, **__: pytest.fail("started"))
    with demo.compile_kernels_in_background():
        pass


def _noting(started):
    class Noted(subprocess.Popen):
        def __init__(self, command, **options):
            super().__init__([sys.executable, "-c", "import time; time.sleep(1000)"], **options)
            started.append(self)

    return Noted
