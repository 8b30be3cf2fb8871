"""Names say what they hold: riddles stay the exception, and no summary of a docstring is a fragment.

A function word or a riddle (`known`, `part`, `place`, `found`) says nothing of the quantity behind it: a reader has to
leave the line to learn that `known` is a mask in one function and a calibration in the next. They were 9.3 % of the
names that this project bound; the code of scikit-fem, zarr and lmfit has 0.6 to 1.5 % of them.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import rgbmidic
import rgbmidic_calibration

POINTERS = """there here again now why what where who how this that it such each every both one ones other others own
    some many few most least even alone apart together alike away beyond around under elsewhere after
    worse whole rest"""
"""They point at something that stands elsewhere."""
PARTICIPLES = """found known kept told asked shown seen stated used made left wanted given taken chosen tried believed
    returned learnt settled lit named drawn followed follows carried moved straightened written swinging wandering
    hidden begun meant said says tells about ready agree"""
"""They say what was done with a quantity, not which quantity it is."""
EMPTY_NOUNS = "place places part parts thing things way ways sure"
RIDDLES = frozenset(f"{POINTERS} {PARTICIPLES} {EMPTY_NOUNS}".split())
FRAGMENTS = ("What ", "How ", "Where ", "When ", "Of ", "From ", "Whether ")
PENDING = frozenset[str]()
"""Rooms whose names are still the old ones; the list only gets shorter."""

MAX_FRACTION, MAX_FRACTION_OF_ROOM = 0.01, 0.02


def bound_names(tree: ast.AST) -> Iterator[str]:
    """Yield the names of functions, parameters, classes, variables and fields that a module binds."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name
            arguments = node.args
            for argument in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs):
                if argument.arg not in ("self", "cls"):
                    yield argument.arg
        elif isinstance(node, ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id


def is_riddle(name: str) -> bool:
    return name.strip("_").lower() in RIDDLES


def summaries(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield (ast.get_docstring(node) or "").partition("\n")[0]


@cache
def modules() -> dict[str, list[Path]]:
    """Files of every room."""
    modules_by_room: dict[str, list[Path]] = {}
    for package in (rgbmidic, rgbmidic_calibration):
        root = Path(package.__file__).parent
        for path in sorted(root.rglob("*.py")):
            modules_by_room.setdefault("/".join([root.name, *path.relative_to(root).parts[:-1][:1]]), []).append(path)
    return modules_by_room


@cache
def trees(room: str) -> list[tuple[Path, ast.Module]]:
    """Modules of a room, read once."""
    return [(path, ast.parse(path.read_text(encoding="utf-8"))) for path in modules()[room]]


def renamed_rooms() -> list[str]:
    return sorted(modules().keys() - PENDING)


def test_rooms_that_wait_exist() -> None:
    assert modules().keys() >= PENDING
    assert len(renamed_rooms()) >= 6


@pytest.mark.parametrize("room", renamed_rooms())
def test_few_names_of_a_room_are_riddles(room: str) -> None:
    names = [(name, path.name) for path, tree in trees(room) for name in bound_names(tree)]
    riddles = [f"{file}: {name}" for name, file in names if is_riddle(name)]
    assert len(names) > 100
    assert len(riddles) <= MAX_FRACTION_OF_ROOM * len(names), riddles


def test_hardly_any_name_is_a_riddle() -> None:
    names = [name for room in renamed_rooms() for _, tree in trees(room) for name in bound_names(tree)]
    riddles = [name for name in names if is_riddle(name)]
    assert len(riddles) <= MAX_FRACTION * len(names), sorted(riddles)


@pytest.mark.parametrize("room", renamed_rooms())
def test_no_summary_is_a_fragment(room: str) -> None:
    fragments = [
        f"{path.name}: {summary}"
        for path, tree in trees(room)
        for summary in summaries(tree)
        if summary.startswith(FRAGMENTS)
    ]
    assert not fragments


QUOTED = re.compile(r"(?<!`)`([A-Za-z_][\w.]*)(?:\([^`]*\))?`(?!`)")
ELSEWHERE = ("numpy.", "eHBayerPatternOrigin", "x_image", "y_image")
"""Names of another package, of a camera's header, and those that a result's axes are put together to."""


def quoted_names(tree: ast.AST) -> Iterator[str]:
    """Yield the names in quotes of the docstrings of a module, attributes included."""
    for node in ast.walk(tree):
        for statement in getattr(node, "body", None) if isinstance(getattr(node, "body", None), list) else ():
            match statement:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    yield from QUOTED.findall(text)


@cache
def identifiers() -> frozenset[str]:
    """Names that the code has: bound, looked up, imported, keys in quotes, and modules."""
    found = set[str]()
    for path, tree in (module for room in modules() for module in trees(room)):
        found |= {path.stem, path.parent.name}
        for node in ast.walk(tree):
            found.update(re.findall(r"\w+", str(getattr(node, "asname", None) or getattr(node, "name", ""))))
            found |= {str(getattr(node, field)) for field in ("id", "attr", "arg") if hasattr(node, field)}
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.isidentifier():
                found.add(node.value)
    return frozenset(found)


def is_defined(name: str) -> bool:
    """Return True if a name exists; of `rgbmidic.package.module.name` the last one in that very module."""
    if not name.startswith("rgbmidic"):
        return set(name.split(".")) <= identifiers()
    root = Path(rgbmidic.__file__ if name.startswith("rgbmidic.") else rgbmidic_calibration.__file__).parent
    path, parts = root, name.split(".")[1:]
    while parts and ((path / parts[0]).is_dir() or (path / f"{parts[0]}.py").is_file()):
        path /= parts.pop(0)
    source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return not parts or (
        re.search(rf"\b{parts[0]}\b", source.read_text(encoding="utf-8")) is not None and set(parts) <= identifiers()
    )


@pytest.mark.parametrize("room", renamed_rooms())
def test_names_that_docstrings_quote_exist(room: str) -> None:
    quoted = [(name, path.name) for path, tree in trees(room) for name in quoted_names(tree)]
    missing = [f"{file}: {name}" for name, file in quoted if not name.startswith(ELSEWHERE) and not is_defined(name)]
    assert not missing


def test_a_quoted_name_that_is_not_there_is_found_out() -> None:
    assert list(quoted_names(ast.parse('"""Not `that_is_gone`, ``code`` or `Residual.at(x)`."""'))) == [
        "that_is_gone",
        "Residual.at",
    ]
    assert is_defined("Residual.at")
    assert is_defined("rgbmidic.correlation.solve")
    assert not is_defined("that_is_" + "gone")
    assert not is_defined("rgbmidic.illumination.crosstalk.needed")


def test_riddles_and_fragments_are_recognised() -> None:
    tree = ast.parse('def told(known, *, std):\n    """What a worker found."""\n    part, _place = known\n')
    assert [name for name in bound_names(tree) if is_riddle(name)] == ["told", "known", "part", "_place"]
    assert [summary for summary in summaries(tree) if summary.startswith(FRAGMENTS)] == ["What a worker found."]
