"""How kernels are compiled, and the threads that share their items: ranges of elements, rows or pixels.

A kernel is compiled once for the processor and kept in a cache. It holds no lock of the interpreter (``nogil=True``)
and writes only what belongs to its items, so that the result is the same bits on any number of threads. Numba itself
is imported with the first call: whoever reads a result waits for no compiler.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache, cached_property, partial, update_wrapper
from itertools import pairwise
from typing import Any, ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

from rgbmidic.errors import InputError

P = ParamSpec("P")
T = TypeVar("T")

FAST = {"reassoc", "contract", "arcp", "nsz"}
"""Freedom of a kernel's floating-point arithmetic: it keeps the meaning of NaN and inf."""
_VARIABLE = "RGBMIDIC_THREADS"
_requested_threads: list[int] = []
_limits: list[Any] = []
_lock = threading.Lock()


@cache
def machine() -> str:
    """Processor and BLAS libraries of this process, on which the last bits of a result depend."""
    import scipy.linalg  # noqa: F401 which has a library of its own
    from llvmlite.binding import get_host_cpu_name

    blas = [library for library in ThreadpoolController().info() if library["user_api"] == "blas"]
    libraries = {
        f"{library['internal_api']} {library['version']} {library.get('architecture', '')}".strip() for library in blas
    }
    return ", ".join([str(get_host_cpu_name()), *sorted(libraries)])


def threads() -> int:
    """Return the number of threads that share a kernel.

    It is what `set_threads` was given, else the environment's RGBMIDIC_THREADS, else the number of processors that this
    process may use.

    Raises
    ------
    InputError
        RGBMIDIC_THREADS is not a whole number from 1.
    """
    return _requested_threads[-1] if _requested_threads else _default()


def set_threads(number: int) -> None:
    """Let `number` threads share the kernels of this process.

    Raises
    ------
    InputError
        `number` is under 1.
    """
    if number < 1:
        raise InputError(f"the number of threads must be at least 1; given is {number}")
    _requested_threads[:] = [number]


@cache
def keep_memory() -> None:
    """Have glibc keep what a frame gives back for the next one, in one heap for all threads.

    Pages that the system fills with zeros first took 3 to 8 % of the CPU time of a raw frame of 1 Mpx, and 26 % of one
    of 4 Mpx, whose arrays exceed the 32 MB up to which glibc learns to keep them. A thread's own heap ends at 64 MB and
    gives all back: two frames side by side took .24 s each, and .20 s with one heap (measured).
    """
    with suppress(OSError, AttributeError, TypeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, value in ((-1, 2**30), (-3, 2**30), (-8, 1)):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX
            mallopt(parameter, value)


_MIN_SHARED_SIZE = 1 << 16
"""Entries of a kernel's largest array under which one thread does it all: at some 3 ns each it takes .2 ms, and another
thread .05 to .1 ms to begin and to report (measured)."""


def aside(function: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> Future[T]:
    """Call a function in a thread of its own where there are several, at once where there is but one.

    The thread is none of those that share a kernel, which the function may call.
    """
    if threads() > 1:
        import numba  # noqa: F401  of two threads that import it at once, one may find half of it

        return _pool(os.getpid(), "aside").submit(function, *arguments, **named)
    done: Future[T] = Future()
    done.set_result(function(*arguments, **named))
    return done


@cache
def _pool(process: int, name: str = "kernels") -> ThreadPoolExecutor:
    """Return the pool of a process: a forked one inherits no threads and makes its own, as many as are needed."""
    return ThreadPoolExecutor(max(_default(), *_requested_threads, 1), thread_name_prefix=f"rgbmidic-{name}")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep the linear algebra of scipy and numpy on one thread.

    The triangular solves of a frame, some 50 right-hand sides at a time, take two to three times as long on two threads
    (measured), and their sums may differ. The limit is the process's: the first thread that comes
    sets it, and the last that goes lifts it.
    """
    with _lock:
        _limits.append(_limits[-1] if _limits else _blas().limit(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            limit = _limits.pop()
            if not _limits:
                limit.restore_original_limits()


@cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


@cache
def _default() -> int:
    setting = os.environ.get(_VARIABLE)
    if setting is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not setting.isdecimal() or int(setting) < 1:
        raise InputError(f"{_VARIABLE} must be a whole number from 1; given is {setting!r}")
    return int(setting)


class Kernel:
    """A function that numba compiles when it is first called, or when a kernel that calls it is.

    Where it is ``kernel(start, stop, *arguments)``, threads share its items, and it is called without the first two.
    """

    __wrapped__: Callable[..., Any]

    def __init__(
        self,
        function: Callable[..., Any],
        over: str | None = None,
        *,
        axis: int = 0,
        grain: int = 1,
        min_size: int | None = None,
        **options: Any,
    ) -> None:
        update_wrapper(self, function)
        self._names = function.__code__.co_varnames[2 : function.__code__.co_argcount]
        self.over, self._axis, self._grain, self._min_size, self._options = over, axis, grain, min_size, options

    @cached_property
    def dispatcher(self) -> Any:
        """Numba's, which knows the kernel's signatures and its place in the cache."""
        from numba import njit

        from rgbmidic._kernels.cache import KernelCache

        kernel = njit(**self._options)(self.__wrapped__)
        kernel._cache = KernelCache(self.__wrapped__)
        return kernel

    @property
    def _numba_type_(self) -> Any:  # what numba asks of a global of a function that it compiles
        return self.dispatcher._numba_type_

    def __reduce__(self) -> str:  # what pickle takes to another process is the name
        return self.__wrapped__.__qualname__

    def __call__(self, *arguments: Any) -> Any:
        """Run the kernel, shared by ranges of about equal length: the first in this thread, the others in the pool."""
        if self.over is None:
            return self.dispatcher(*arguments)
        keep_memory()
        items, n_threads = arguments[self._names.index(self.over)].shape[self._axis], threads()
        kernel = self.dispatcher  # the first call imports numba, before threads begin
        grains = -(-items // self._grain)
        largest = max(getattr(argument, "size", 0) for argument in arguments)
        n_ranges = (
            min(n_threads, grains) if largest >= (_MIN_SHARED_SIZE if self._min_size is None else self._min_size) else 1
        )
        if n_ranges <= 1:
            return kernel(0, items, *arguments)
        edges = [min(grains * index // n_ranges * self._grain, items) for index in range(n_ranges + 1)]
        pool = _pool(os.getpid())
        futures = [pool.submit(kernel, *edge, *arguments) for edge in pairwise(edges[1:])]
        kernel(0, edges[1], *arguments)
        for future in futures:
            future.result()
        return None


def compiled(over: str | None = None, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a kernel.

    Parameters
    ----------
    over
        Name of the argument that has one entry per item that threads share; None: it is no such kernel.
    axis, grain, min_size
        Axis of the items; ranges start at multiples of the grain, so that what is vectorised or gathered in blocks of
        so many items stays the same on any number of threads; entries of its largest array from which threads share
        it, some 65,000 if not stated.
    **options
        Those of ``numba.njit``.
    """
    # a division by zero gives what the processor gives, and C callers are not catered for: less code, sooner compiled
    always: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    return partial(Kernel, over=over, **always | options)


helper = partial(compiled, no_cpython_wrapper=True, forceinline=True)
"""For a function that only kernels call. It becomes a part of each: of one that stays a function, a kernel just
compiled calls another copy than one from the cache, and the last bits differ (measured)."""
