"""The cache of compiled kernels: what is damaged in it is compiled anew. Numba is imported with this module."""

from __future__ import annotations

import functools
import logging
from contextlib import suppress
from typing import Any

from numba.core.caching import FunctionCache

from rgbmidic.errors import disk_reason

logger = logging.getLogger(__name__)


class KernelCache(FunctionCache):
    """Cache of a kernel's compiled forms; a power cut may have left its files empty or cut off."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled form for a signature; None where there is none, or a damaged one, which is discarded."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # pickle and LLVM raise a dozen kinds on damaged files
            reason = f"{type(error).__name__}: {error}"
        _warn_once(f"compiled kernels in {self.cache_path} are damaged and are compiled anew ({reason})")
        with suppress(OSError):  # a folder that is only read
            self.flush()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the compiled form for a signature where the disk allows it."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _warn_once(f"compiled kernels cannot be kept in {self.cache_path}: {disk_reason(error)}")


@functools.cache
def _warn_once(text: str) -> None:
    """Log a warning; the texts of a process are few, one per folder and reason."""
    logger.warning("%s", text)
