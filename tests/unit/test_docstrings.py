"""What a package exports states its parameters, what it returns and what it raises (numpy style)."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import rgbmidic
import rgbmidic_calibration


def packages() -> Iterator[ModuleType]:
    for root in (rgbmidic, rgbmidic_calibration):
        yield root
        for module in pkgutil.walk_packages(root.__path__, f"{root.__name__}."):
            if module.ispkg:
                yield importlib.import_module(module.name)


def exported() -> dict[str, Callable[..., Any]]:
    """Every exported function, and every public method that an exported class defines, by where it is defined."""
    found: dict[str, Callable[..., Any]] = {}
    for package in packages():
        for name in getattr(package, "__all__", ()):
            item = getattr(package, name)
            public = (
                [member for key, member in vars(item).items() if key[0] != "_"] if inspect.isclass(item) else [item]
            )
            for member in public:
                function = inspect.unwrap(getattr(member, "__func__", member)) if callable(member) else None
                function = getattr(member, "__func__", function)  # of a class or static method
                if inspect.isfunction(function) and function.__module__.startswith("rgbmidic"):
                    found[f"{function.__module__}.{function.__qualname__}"] = function
    return found


def sections(function: Callable[..., Any]) -> dict[str, str]:
    """Content of the sections of a docstring by their titles."""
    parts = re.split(r"^(\w[\w ]*)\n-+$", inspect.getdoc(function) or "", flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def raises(function: Callable[..., Any]) -> bool:
    """Whether the body states an error itself, those of functions in it left out."""
    open_nodes = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0].body  # type: ignore[attr-defined]
    while open_nodes:
        node = open_nodes.pop()
        if isinstance(node, ast.Raise) and node.exc is not None:
            return True
        if not isinstance(node, ast.FunctionDef):
            open_nodes.extend(ast.iter_child_nodes(node))
    return False


EXPORTED = exported()


def test_all_packages_are_walked() -> None:
    assert {"rgbmidic.frames.formats.read_frame", "rgbmidic.mesh.tri3.Tri3Mesh.from_region"} <= EXPORTED.keys()
    assert {"rgbmidic.frames.source.file_hash", "rgbmidic.mesh.region.Region.from_mask"} <= EXPORTED.keys()
    assert len(EXPORTED) > 300


@pytest.mark.parametrize("name", sorted(EXPORTED))
def test_an_exported_function_states_what_it_takes_returns_and_raises(name: str) -> None:
    function = EXPORTED[name]
    stated, signature = sections(function), inspect.signature(function)
    variadic = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}
    taken = [variadic.get(p.kind, "") + p.name for p in signature.parameters.values() if p.name not in ("self", "cls")]
    lines = re.findall(r"^(\S.*?)(?: :.*)?$", stated.get("Parameters", ""), re.MULTILINE)
    assert sorted(", ".join(lines).split(", ") if lines else []) == sorted(taken)
    gives = signature.return_annotation not in (None, "None", "NoReturn", inspect.Signature.empty)
    assert gives <= bool({"Returns", "Yields"} & stated.keys())
    assert raises(function) <= ("Raises" in stated)


def listed(text: str) -> set[str]:
    """Names that a section of a docstring lists."""
    lines = re.findall(r"^(\S.*?)(?: :.*)?$", text, re.MULTILINE)
    return {name.lstrip("*") for line in lines for name in line.split(", ")}


def test_a_class_of_the_tools_lists_parameters_and_attributes_that_it_has() -> None:
    roots = (Path(str(rgbmidic.__file__)).parent / "tools", Path(str(rgbmidic_calibration.__file__)).parent)
    for path in (path for root in roots for path in root.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ClassDef):
                continue
            parts = re.split(r"^(\w[\w ]*)\n-+$", ast.get_docstring(node) or "", flags=re.MULTILINE)
            stated = {title: listed(text) for title, text in zip(parts[1::2], parts[2::2], strict=True)}
            fields = {item.target.id for item in node.body if isinstance(item, ast.AnnAssign)}  # type: ignore[union-attr]
            methods = {item.name: item for item in node.body if isinstance(item, ast.FunctionDef)}
            owned = {item.attr for item in ast.walk(node) if isinstance(item, ast.Attribute)} | fields | methods.keys()
            assert stated.get("Attributes", set()) <= owned, f"{path}: {node.name}"
            if "__init__" in methods and "Parameters" in stated:
                arguments = [item for item in ast.walk(methods["__init__"].args) if isinstance(item, ast.arg)]
                assert stated["Parameters"] == {item.arg for item in arguments} - {"self"}, f"{path}: {node.name}"
