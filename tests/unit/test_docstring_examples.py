"""Every name that a package for users exports has an example, which `tests/examples/test_pages.py` runs."""

from __future__ import annotations

import inspect
from importlib import import_module
from typing import Any

PACKAGES = [
    "rgbmidic",
    *(
        f"rgbmidic.{room}"
        for room in (
            "settings",
            "frames",
            "illumination",
            "weights",
            "mesh",
            "correlation",
            "fields",
            "results",
            "pipeline",
            "tools.report",
            "tools.view",
            "tools.finite_elements",
        )
    ),
]
PENDING = {"Wave", "wave_text"}
"""Names that have no example of their own yet; the list only gets shorter."""


def exported() -> dict[str, Any]:
    """Return the exported classes and functions by their names; what others have typed is none."""
    names = {f"{package}.{name}" for package in PACKAGES for name in import_module(package).__all__}
    objects = {name: getattr(import_module(name.rpartition(".")[0]), name.rpartition(".")[2]) for name in sorted(names)}
    return {name: item for name, item in objects.items() if inspect.isclass(item) or inspect.isroutine(item)}


def test_every_exported_name_has_an_example() -> None:
    missing = {item.__name__ for item in exported().values() if ">>> " not in (inspect.getdoc(item) or "")}
    assert missing == PENDING
