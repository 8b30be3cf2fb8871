"""The threads that share a kernel: every item once, in ranges of whole grains, from anywhere, after a fork too."""

import multiprocessing
import os
import pickle
import runpy
import subprocess
import sys
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack

import numpy as np
import pytest
from shared_kernel import summed
from textures import Texture
from threadpoolctl import threadpool_info, threadpool_limits

from rgbmidic import correlate
from rgbmidic._kernels.cache import _warn_once
from rgbmidic._kernels.owned_pixels import block_sums
from rgbmidic._kernels.threads import aside, compiled, one_blas_thread, set_threads, threads
from rgbmidic.errors import InputError


@pytest.fixture(autouse=True)
def as_before():
    before = threads()
    yield
    set_threads(before)


class Counted:
    """A stand-in for numba's function that writes down its ranges."""

    def __init__(self):
        self.ranges = []

    def __call__(self, start, stop, other, items):
        self.ranges.append((start, stop))
        items[:, start:stop] += 1


def shared(dispatcher, **options):
    """A kernel over the `items` that runs the stand-in."""

    @compiled("items", **options)
    def kernel(start, stop, other, items): ...

    kernel.dispatcher = dispatcher
    return kernel


@pytest.mark.parametrize("count", [0, 1, 7, 64, 65, 1000])
@pytest.mark.parametrize("grain", [1, 64])
@pytest.mark.parametrize("number", [1, 2, 5])
def test_every_item_is_done_once_in_whole_grains(count, grain, number):
    set_threads(number)
    kernel, items = Counted(), np.zeros((2, count))
    shared(kernel, axis=1, grain=grain, min_size=0)(None, items)
    assert (items == 1).all()
    assert len(kernel.ranges) == max(1, min(number, -(-count // grain)))
    assert all(start % grain == 0 for start, _ in kernel.ranges)


@pytest.mark.parametrize(("other", "parts"), [(np.zeros(99), 1), (np.zeros(100), 2), (None, 1)])
def test_one_thread_does_alone_what_is_small(other, parts):
    set_threads(2)
    kernel = Counted()
    shared(kernel, axis=1, min_size=100)(other, np.zeros((2, 8)))
    assert len(kernel.ranges) == parts


def test_a_failure_in_any_thread_is_told():
    class Failing(Counted):
        def __call__(self, start, stop, other, items):
            if start > 0:
                raise ValueError("the last one")

    set_threads(3)
    with pytest.raises(ValueError, match="the last one"):
        shared(Failing(), min_size=0)(None, np.zeros(9))


def test_many_threads_may_call_at_once():
    with ThreadPoolExecutor(8) as callers:
        assert all(callers.map(summed, range(40)))


@pytest.mark.parametrize("number", [1, 2])
def test_work_done_aside_may_share_kernels_and_fail(number):
    set_threads(number)
    assert (aside(threading.get_ident).result() == threading.get_ident()) == (number == 1)
    assert all(one.result() for one in [aside(summed, seed) for seed in range(4)])
    set_threads(2)
    with pytest.raises(ZeroDivisionError):
        aside(divmod, 1, 0).result()


def blas_threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_the_last_solve_that_ends_gives_the_threads_of_linear_algebra_back():
    with threadpool_limits(2, "blas"):
        before, first, second = blas_threads(), one_blas_thread(), one_blas_thread()
        with ExitStack() as still:
            with first:
                still.enter_context(second)
            assert blas_threads() == {1}
        assert blas_threads() == before


def test_solves_in_several_threads_give_the_bits_of_one():
    def found(seed):
        image = Texture.random(seed).image((90, 100))
        return correlate(image, np.roll(image, 1, axis=1), initial=(1, 0)).displacement.tobytes()

    alone = [found(seed) for seed in range(6)]
    with ThreadPoolExecutor(6) as callers:
        assert list(callers.map(found, range(6))) == alone


@pytest.mark.parametrize("way", sorted({"fork", "spawn"} & set(multiprocessing.get_all_start_methods())))
def test_other_processes_make_their_own_pool(way):
    assert summed(0)
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context(way)) as pool:
        assert all(pool.map(summed, range(4), timeout=300))


def test_a_shared_kernel_can_be_sent_to_another_process():
    assert pickle.loads(pickle.dumps(block_sums)) is block_sums


def said(value):
    code = (
        "from rgbmidic._kernels.threads import threads\ntry: print(threads())\nexcept Exception as error: print(error)"
    )
    environment = {**os.environ, "RGBMIDIC_THREADS": value}
    return subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, env=environment
    ).stdout.strip()


def test_the_environment_sets_the_number():
    assert said("3") == "3"
    for wrong in ("0", "-2", "many", ""):
        assert said(wrong) == f"RGBMIDIC_THREADS must be a whole number from 1; given is {wrong!r}"


def test_fewer_than_one_thread_is_refused():
    with pytest.raises(InputError, match="at least 1; given is 0"):
        set_threads(0)


_KERNEL = """
from rgbmidic._kernels.threads import compiled

@compiled()
def doubled(values):
    values *= 2
"""


def _doubled(folder):
    """Whether the kernel of a module works, as a new process has it; and the files of its cache."""
    module = runpy.run_path(str(folder / "doubling.py"))
    values = np.ones(3)
    module["doubled"](values)
    assert (values == 2).all()
    hits = sum(module["doubled"].dispatcher.stats.cache_hits.values())
    return hits, [next((folder / "__pycache__").glob(f"*.{ending}")) for ending in ("nbi", "nbc")]


def test_a_damaged_cache_is_stated_and_compiled_anew(tmp_path, caplog):
    (tmp_path / "doubling.py").write_text(_KERNEL)
    hits, (index, data) = _doubled(tmp_path)
    assert not hits
    for file, content in ((index, b""), (index, index.read_bytes()[:-9]), (data, data.read_bytes()[:-99])):
        file.write_bytes(content)
        caplog.clear()
        _warn_once.cache_clear()
        hits, _ = _doubled(tmp_path)
        assert not hits
        (warning,) = caplog.messages
        assert warning.startswith(f"compiled kernels in {tmp_path}/__pycache__ are damaged and are compiled anew (")
        assert _doubled(tmp_path)[0] == 1
        assert caplog.messages == [warning]
    index.unlink()
    index.mkdir()
    (index / "in the way").touch()
    assert not _doubled(tmp_path)[0]
    assert caplog.messages[-1].startswith(f"compiled kernels cannot be kept in {tmp_path}/__pycache__: ")
