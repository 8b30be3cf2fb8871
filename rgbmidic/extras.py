"""Modules that need the packages of an extra."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from rgbmidic.errors import InputError


def optional(module: str, extra: str) -> Any:
    """A module that needs packages of an extra.

    Raises
    ------
    InputError
        They are not installed.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("rgbmidic"):
            raise
        raise InputError(f'this needs the package {error.name}: pip install "rgbmidic[{extra}]"') from None
