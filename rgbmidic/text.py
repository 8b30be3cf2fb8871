"""Numbers and objects as text: value and standard uncertainty to the same place, times, and tables for notebooks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from itertools import pairwise

_FIXED_POINT_DECIMALS = range(-3, 9)
"""Decimals of a number that is written without a power of ten: from whole thousands to the eighth decimal."""


def format_value(value: float, std: float) -> str:
    """Write a number to the place of the second digit of its standard uncertainty (GUM, 7.2.6); it may be its own.

    Parameters
    ----------
    value
        The number.
    std
        Its standard uncertainty; not finite or 0 where there is none: four digits of the value are written.

    Returns
    -------
    str
        A dash for a value that is not finite.

    Examples
    --------
    >>> format_value(0.14327, 0.0022)
    '0.1433'
    """
    if not math.isfinite(value):
        return "-"
    if not (math.isfinite(std) and std > 0):
        return f"{value:.4g}"
    decimals = 1 - int(f"{std:.1e}".partition("e")[2])  # of the uncertainty as it is rounded: 0.0996 is 0.10
    if decimals in _FIXED_POINT_DECIMALS:
        value = round(value, decimals) + 0.0  # no "-0.00"
        return f"{value:.{max(decimals, 0)}f}"
    digits = int(f"{value:.1e}".partition("e")[2]) + decimals if value else 0
    return f"{value:.{max(digits, 0)}e}"


def format_with_std(value: float, std: float, unit: str = "") -> str:
    """Write a number with its standard uncertainty and unit, such as ``"0.1433 ± 0.0022 mm"``.

    Parameters
    ----------
    value, std
        As in `format_value`; a value without uncertainty is written alone.
    unit
        Empty for none.

    Returns
    -------
    str

    Examples
    --------
    >>> format_with_std(0.14327, 0.0022, "mm")
    '0.1433 ± 0.0022 mm'
    """
    if not math.isfinite(value):
        return "-"
    has_std = math.isfinite(std) and std > 0
    return " ".join(filter(None, [format_value(value, std), f"± {format_value(std, std)}" if has_std else "", unit]))


def format_times(times: Sequence[float], digits: int = 12) -> list[str]:
    """Write times with so many digits, or as many as it takes to tell each from the next to a thousandth.

    Parameters
    ----------
    times
        In any unit.
    digits
        The fewest.

    Returns
    -------
    list of str

    Examples
    --------
    >>> format_times([0.001, 0.002]), format_times([1.7e9, 1.7e9 + 0.001])
    (['0.001', '0.002'], ['1700000000', '1700000000.001'])
    """
    finite = sorted(time for time in times if math.isfinite(time))
    interval = min((after - before for before, after in pairwise(finite) if after > before), default=0.0)
    if interval:
        digits = max(digits, min(math.ceil(math.log10(max(map(abs, finite)) / interval)) + 3, 17))
    return [f"{time:.{digits}g}" for time in times]


class HtmlRepr:
    """An object whose ``repr`` is a title and lines ``name: value``; notebooks show it as a table."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        title, *lines = repr(self).splitlines()
        cells = (line.partition(":") for line in lines)
        cell = '<td style="text-align: left">'
        rows = "".join(f"<tr>{cell}{escape(name)}</td>{cell}{escape(value)}</td></tr>" for name, _, value in cells)
        return f"<div><code>{escape(title)}</code><table>{rows}</table></div>"
