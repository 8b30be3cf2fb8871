"""What other modules derive from an object that does not change: kept with it, and freed with it."""

from collections.abc import Callable, Hashable
from functools import cached_property, lru_cache
from typing import Any, TypeVar
from weakref import ref

T = TypeVar("T")


class Derivable:
    """An object that keeps what is derived from it."""

    def derive(self, function: Callable[..., T], *arguments: Hashable) -> T:
        """Return ``function(object, *arguments)``; the last twelve results are kept as long as the object lives.

        Of a mesh they are those over all elements and those over the elements with data in a frame.

        Parameters
        ----------
        function
            Takes the object first; it does not change it.
        *arguments
            The others.

        Returns
        -------
        object
            What the function returns; not to be changed.
        """
        result: T = self._derived(function, *arguments)
        return result

    @cached_property
    def _derived(self) -> Callable[..., Any]:
        owner = ref(self)  # no cycle: the results are freed with the object
        return lru_cache(maxsize=12)(lambda function, *arguments: function(owner(), *arguments))
