"""The reference pages, generated from the code: commands, keys of the files, fields of a result, public names.

A page holds one between `<!-- generated: NAME -->`, a name of `GENERATORS`, and `<!-- end -->`: `python -m benchmarks
--pages` writes it there. In the tables of TEST.toml the columns *type* and *default* are the code's. The pages of the
public names are written into docs/reference/api.
"""

from __future__ import annotations

import ast
import inspect
import re
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin, get_type_hints

if TYPE_CHECKING:
    from types import ModuleType

    from sphinx.application import Sphinx

MODULES = [
    "rgbmidic",
    "rgbmidic.settings",
    "rgbmidic.pipeline",
    "rgbmidic.results",
    "rgbmidic.fields",
    "rgbmidic.tools.report",
    "rgbmidic.tools.view",
    "rgbmidic.frames",
    "rgbmidic.illumination",
    "rgbmidic.illumination.calibration",
    "rgbmidic.illumination.separation",
    "rgbmidic.illumination.linear",
    "rgbmidic.illumination.texture",
    "rgbmidic.weights",
    "rgbmidic.mesh",
    "rgbmidic.correlation",
    "rgbmidic.tools.finite_elements",
    "rgbmidic.tools.finite_elements.comparison",
    "rgbmidic.tools.finite_elements.simulation",
    "rgbmidic.tools.scene.scene",
    "rgbmidic.tools.scene.camera",
    "rgbmidic.tools.scene.surface",
    "rgbmidic.tools.scene.geometry_weights",
    "rgbmidic.tools.scene.speckle",
    "rgbmidic.tools.scene.zones",
    "rgbmidic.tools.scene.forecast",
    "rgbmidic.tools.lab",
    "rgbmidic.tools.lab.demo",
    "rgbmidic.tools.lab.inspection",
    "rgbmidic.tools.lab.planning",
    "rgbmidic.tools.lab.virtual",
    "rgbmidic.tools.stereo",
    "rgbmidic.errors",
    "rgbmidic.typing",
    "rgbmidic_calibration.captures",
    "rgbmidic_calibration.crosstalk",
    "rgbmidic_calibration.noise",
    "rgbmidic_calibration.registration",
    "rgbmidic_calibration.camera",
    "rgbmidic_calibration.stereo",
    "rgbmidic_calibration.target",
    "rgbmidic_calibration.verify",
    "rgbmidic_calibration.design",
    "rgbmidic_calibration.plausibility",
    "rgbmidic_calibration.jobs",
    "rgbmidic_calibration.display",
]
"""Modules whose names are public, in the order of the pages; a name that several have is described with the first."""


# ---- tables


def table(heading: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    lines = [list(heading)]
    lines += [["---"] * len(lines[0])]
    lines += [[" ".join(cell.split()) for cell in row] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def described(kind: type) -> dict[str, str]:
    """Attributes of a class with the words of its docstring."""
    _, _, text = (inspect.getdoc(kind) or "").partition("Attributes\n----------\n")
    section = re.split(r"\n\n\w+\n---", text)[0]
    entries = re.findall(r"^(\S.*)\n((?:    .*\n?|\n)*)", section, re.MULTILINE)
    meanings = {}
    for names, words in entries:
        for name in names.partition(" : ")[0].split(", "):
            meanings[name] = re.sub(r"``(.*?)``", r"`\1`", " ".join(words.split()))
    return meanings


def default(entry: Field[Any]) -> str:
    """The default of a field as TOML writes it; *needed*, or a dash where it is not stated."""
    value = entry.default
    if value is MISSING:
        value = MISSING if entry.default_factory is MISSING else entry.default_factory()
    if value is MISSING:
        return "needed"
    if not isinstance(value, (bool, int, float, str, tuple)):
        return "-"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, tuple):
        return f"`{_listed(value)}`"
    return f"`{round(value, 4) if isinstance(value, float) else value}`"


def _listed(value: Any) -> Any:
    return [_listed(entry) for entry in value] if isinstance(value, tuple) else value


_WORDS = {bool: "`true`, `false`", int: "whole number", float: "number", str: "text", Path: "file"}
_SIGNS = {"above": ">", "at_least": "≥", "at_most": "≤", "below": "<"}


def type_words(hint: Any, bounds: Mapping[str, float] | None = None) -> str:
    """What may be written where the code has a type, with the bounds of its numbers."""
    limits = "".join(f" {_SIGNS[name]} {limit:g}" for name, limit in (bounds or {}).items())
    kinds = [kind for kind in get_args(hint) if kind is not types.NoneType]
    if get_origin(hint) in (Union, types.UnionType):
        return " or ".join(type_words(kind) for kind in kinds) + limits
    if get_origin(hint) is Literal:
        return ", ".join(f'`"{kind}"`' for kind in kinds)
    if get_origin(hint) is tuple and kinds[-1] is Ellipsis:
        return f"list of {_several(kinds[0])}{limits}"
    if get_origin(hint) is tuple:
        return f"[{', '.join(type_words(kind) for kind in kinds)}]{limits}"
    if is_dataclass(hint):
        return "section"
    return (_WORDS.get(hint) or "array of numbers") + limits


def _several(hint: Any) -> str:
    if get_origin(hint) is tuple:
        return type_words(hint).replace("list of", "lists of", 1)
    return {float: "numbers", int: "whole numbers", str: "texts", Path: "files"}.get(hint, type_words(hint))


# ---- keys of the files


def test_keys() -> dict[str, dict[str, tuple[str, str]]]:
    """Type and default of every key of TEST.toml, by section and key."""
    from rgbmidic.settings.schema import section_types

    return {
        name: {
            entry.name: (
                type_words(get_type_hints(kind)[entry.name], entry.metadata.get("bounds")),
                default(entry),
            )
            for entry in fields(kind)
        }
        for name, kind in section_types().items()
    }


def with_types(text: str) -> str:
    """The page of TEST.toml with the code's types and defaults in its tables of keys."""
    section, keys, lines = "", test_keys(), []
    for line in text.splitlines():
        if heading := re.fullmatch(r"## \[(\w+)\]", line):
            section = heading[1]
        if line == "| key | default | meaning |":
            line = "| key | type | default | meaning |\n|---|---|---|---|"
        elif line == "|---|---|---|" and lines[-1].endswith("|---|---|---|---|"):
            continue
        elif row := re.match(r"\| `(\w+)` \| [^|]+ \| (.*)", line):
            line = f"| `{row[1]}` | {' | '.join(keys[section][row[1]])} | {row[2]}"
        lines.append(line)
    return "\n".join(lines) + "\n"


def _keys(kind: type, extra: Mapping[str, tuple[str, str, str]], left_out: Iterable[str] = ()) -> str:
    """Table of the keys of a section that a dataclass stands for."""
    meanings, hints = described(kind), get_type_hints(kind)
    rows = [(f"`{name}`", *cells) for name, cells in extra.items()]
    for entry in fields(kind):
        if entry.name not in extra and entry.name not in left_out:
            typed = type_words(hints[entry.name], entry.metadata.get("bounds"))
            rows.append((f"`{entry.name}`", typed, default(entry), meanings[entry.name]))
    return table(("key", "type", "default", "meaning"), rows)


_BODY = {"kind": ('`"sphere"`, `"cylinder"`, `"plate"`', '`"sphere"`', "The body's shape.")}
_LIGHT = {
    "led_centre": ("number", "-", "Peak of the lamp's spectrum in nm, if the crosstalk is computed from spectra."),
    "led_width": ("number", "-", "Its full width at half of the peak, nm."),
    "power": ("number", "-", "With 1, an ideal white that faces the lamp at its nominal distance reaches the camera's "
              "`exposure`. Not stated: the power that gives this at the body's front point."),
}  # fmt: skip
_CAMERA = {
    "shape": ("[whole number, whole number]", "`[640, 640]`", "Rows and columns of the frame."),
    "mm_per_pixel": ("number > 0", "`0.055`", "Scale at the body's front point; gives `focal_px` if not stated."),
    "focal_px": ("number", "-", "Focal length in px: distance / (mm per px at that distance)."),
    "crosstalk": ("list of lists of numbers", "-", "A in channels = A · lights: a row for each channel. Not stated: "
                  "from the spectra if there are any, else that of the reference camera."),
    "sensitivities": ("file", "-", "CSV with the spectral sensitivities of the camera."),
    "model": ("text", "-", "A camera with spectral sensitivities in colour-science."),
}  # fmt: skip
_STATE = {
    "displacement_gradient": ("[[number, number], [number, number]]", "-", "Displacement gradient of a plate."),
    "displacement_offset": ("[number, number]", "-", "Displacement of the middle of a plate, mm."),
    "displacement_file": ("file", "-", "npz with `nodes` (mm), `elements` and `displacement` (mm) of a plate."),
}


def scene() -> str:
    """Sections and keys of SCENE.toml."""
    from rgbmidic.tools.scene.camera import Camera, Light, SecondCamera
    from rgbmidic.tools.scene.scene import BODIES, DatasetSettings, State
    from rgbmidic.tools.scene.surface import Finish, Surface

    text = "## [body]\n\n" + table(("key", "type", "default", "meaning"), [("`kind`", *_BODY["kind"])])
    for name, kind in BODIES.items():
        text += f'\n### kind = "{name}"\n\n' + _keys(kind, {})
    parts: list[tuple[str, type, Mapping[str, tuple[str, str, str]], tuple[str, ...]]] = [
        ("[surface]", Surface, {}, ("white", "black")),
        (
            "[surface.white], [surface.black]",
            Finish,
            {"albedo": ("number", "`0.8`, `0.1`", described(Finish)["albedo"])},
            (),
        ),
        ("[[lights]]", Light, _LIGHT, ("spectrum",)),
        ("[camera]", Camera, _CAMERA, ()),
        ("[camera.second]", SecondCamera, {}, ()),
        ("[[states]]", State, _STATE, ("displacement",)),
        ("[output]", DatasetSettings, {}, ()),
    ]
    for heading, kind, extra, left_out in parts:
        text += f"\n## {heading}\n\n" + _keys(kind, extra, left_out)
    return text


def calibration() -> str:
    """Sections and keys of a calibration file."""
    from rgbmidic.illumination.calibration import _CAMERA, Calibration
    from rgbmidic.illumination.crosstalk import Crosstalk
    from rgbmidic.illumination.images import Registration
    from rgbmidic.illumination.linear import CameraNoise, NoiseModel

    others = [entry.name for entry in fields(Calibration) if entry.name not in _CAMERA]
    text = "### camera\n\n" + _keys(Calibration, {}, others)
    for name, kind in (
        ("crosstalk", Crosstalk),
        ("noise", NoiseModel),
        ("noise.planes", CameraNoise),
        ("registration", Registration),
    ):
        text += f"\n### {name}\n\n" + _keys(kind, {})
    return text


def camera() -> str:
    """Keys of a file with lens and plane."""
    from rgbmidic.fields.plane import LENS_PARAMETERS, CameraCalibration

    lens = f"numbers {', '.join(f'`{name}`' for name in LENS_PARAMETERS)}"
    focal = "Focal length and principal point in px, then the distortion in OpenCV's order; null: it does not distort."
    return _keys(CameraCalibration, {"lens": (lens, "-", focal)}, ["name"])


# ---- results and formats

_SIZES = {"node": "N", "light": "k", "element": "E", "function": "m", "row": "h", "column": "w", "iteration": "i"}
_SIZES |= {"image row": "H", "image column": "W", "reference_update": "r", "estimated node": "N"}


def quantities() -> str:
    """Every field of a result: what all frames share, then what each frame has."""
    from rgbmidic.results.quantities import QUANTITIES, SHARED

    rows = []
    for first, entries in (((), SHARED), (("T",), QUANTITIES)):
        for name, entry in entries.items():
            sizes = (*first, *(str(_SIZES.get(str(axis), axis)) for axis in entry.axes))
            shape = f"({', '.join(sizes)}{',' * (len(sizes) == 1)})"
            rows.append((f"`{name}`", shape, entry.dtype.__name__.rstrip("_"), entry.unit, entry.description))
    rows.append(("`names`, `lights`", "(T,), (k,)", "str", "", "names of the frames and of the lights"))
    return table(("name", "shape", "type", "unit", "meaning"), rows)


def formats() -> str:
    """Formats of frame files, as ``rgbmidic frames --formats`` lists them."""
    from rgbmidic.frames import frame_formats

    rows = []
    for entry in frame_formats():
        endings = [" ".join(f"`{ending}`" for ending in group) for group in (entry.endings, entry.movies)]
        rows.append((entry.name, *(endings if any(endings) else ("by content", ""))))
    return table(("format", "one frame a file", "several frames a file"), rows)


# ---- commands


def commands(program: str) -> str:
    """Every command of a program with its options, as its own help states them."""
    import typer

    from rgbmidic.cli import app as cli
    from rgbmidic_calibration import cli as calibrate

    group = typer.main.get_command({"rgbmidic": cli.app, "rgbmidic-calibrate": calibrate.app}[program])
    parent = group.make_context(program, [], resilient_parsing=True)
    text = ""
    for name, command in group.commands.items():
        context = command.make_context(name, [], resilient_parsing=True, parent=parent)
        usage = command.get_usage(context).removeprefix("Usage: ")
        text += f"\n## {program} {name}\n\n```text\n{usage}\n```\n\n{_prose(command.help)}\n\n"
        rows = []
        for parameter in command.params:
            if record := parameter.get_help_record(context):
                words, _, details = record[1].partition("  [")
                rows.append((f"`{record[0]}`", _prose(words), details.rstrip("]").replace("|", "\\|")))
        text += table(("option", "meaning", "default, limits"), rows)
    return text


def _prose(text: str) -> str:
    """Text of a command's help: placeholders are no HTML, a bar is no end of a cell."""
    return re.sub(r"([<>|*\[\]])", r"\\\1", text)


GENERATORS: dict[str, Callable[[], str]] = {
    "commands rgbmidic": lambda: commands("rgbmidic"),
    "commands rgbmidic-calibrate": lambda: commands("rgbmidic-calibrate"),
    "scene": scene,
    "calibration": calibration,
    "camera": camera,
    "quantities": quantities,
    "formats": formats,
}


_BLOCK = re.compile(r"(<!-- generated: ([^\n]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def filled(text: str) -> str:
    """A page's text with what the code gives between `<!-- generated: NAME -->` and `<!-- end -->`."""
    return _BLOCK.sub(lambda found: f"{found[1]}\n{GENERATORS[found[2]]().strip()}\n\n{found[3]}", text)


# ---- public names


def exported(module: ModuleType) -> list[str]:
    """Names a package exports by its list; of a module, what it defines under a name without underscore."""
    if hasattr(module, "__all__"):
        return list(module.__all__)
    names = []
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.append(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names += [target.id for target in targets if isinstance(target, ast.Name)]
    return [name for name in names if not name.startswith("_") and name != "logger"]


def public() -> Iterator[tuple[str, str, Any]]:
    """Module, name and object of every public name, once, aliases of classes left out."""
    seen: set[int] = set()
    for module in map(import_module, MODULES):
        for name in exported(module):
            found = getattr(module, name)
            alone = inspect.isclass(found) or inspect.isroutine(found)
            alias = inspect.isclass(found) and found.__name__ != name
            if name != "__version__" and not alias and not (alone and id(found) in seen):
                seen.add(id(found))
                yield module.__name__, name, found


def _constant(module: str, name: str) -> list[str]:
    """Description of a constant: the text below it where it is assigned, and its value where that is short."""
    from sphinx.pycode import ModuleAnalyzer

    home = module
    while ("", name) not in (docs := ModuleAnalyzer.for_module(home).find_attr_docs()):
        tree = ast.parse(inspect.getsource(import_module(home)))
        sources = [
            node.module
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and name in (alias.name for alias in node.names)
        ]
        if not sources or sources[0] is None:
            docs = {("", name): []}
            break
        home = sources[0]
    lines = [f".. py:data:: {name}", f"   :module: {module}"]
    value = getattr(import_module(module), name)
    if isinstance(value, int | float | str | tuple) and len(repr(value)) < 80:
        lines.append(f"   :value: {value!r}")
    return [*lines, "", *(f"   {line}" for line in docs["", name]), ""]


def write_api(folder: Path) -> None:
    """Write a page of every public module, and their list, into a folder."""
    pages: dict[str, list[tuple[str, Any]]] = {name: [] for name in MODULES}
    for module, name, found in public():
        pages[module].append((name, found))
    folder.mkdir(exist_ok=True)
    for module, names in pages.items():
        lines = [module, "=" * len(module), "", f".. automodule:: {module}", "   :no-members:", ""]
        classes = [name for name, found in names if inspect.isclass(found)]
        functions = [name for name, found in names if inspect.isroutine(found)]
        constants = [name for name, _ in names if name not in (*classes, *functions)]
        elsewhere = [
            name for name in exported(import_module(module)) if name not in dict(names) and name != "__version__"
        ]
        if classes or functions:
            lines += [".. autosummary::", "   :nosignatures:", ""]
            lines += [f"   {name}" for name in (*classes, *functions)] + [""]
        if elsewhere:
            lines += [".. rubric:: Described with another module", ""]
            homes = {id(found): f"{home}.{name}" for home, entries in pages.items() for name, found in entries}
            lines += [
                ", ".join(f":py:obj:`~{homes[id(getattr(import_module(module), name))]}`" for name in elsewhere),
                "",
            ]
        for title, kind, members in (("Classes", "class", classes), ("Functions", "function", functions)):
            if members:
                lines += [title, "-" * len(title), ""]
            for name in members:
                found = dict(names)[name]
                error = inspect.isclass(found) and issubclass(found, Exception)
                lines += [f".. auto{'exception' if error else kind}:: {module}.{name}"]
                if kind == "class" and not error:
                    lines += ["   :members:", "   :undoc-members:"]
                lines += [""]
        if constants:
            lines += ["Constants and types", "-------------------", ""]
            for name in constants:
                lines += _constant(module, name)
        _update(folder / f"{module}.rst", "\n".join(lines))
    index = ["Public names", "============", "", "Every public name of the packages with its docstring.", ""]
    index += [".. toctree::", "   :maxdepth: 1", "", *(f"   {module}" for module in MODULES), ""]
    _update(folder / "index.rst", "\n".join(index))


def _update(path: Path, text: str) -> None:
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def _read(app: Sphinx, docname: str, source: list[str]) -> None:
    if docname == "reference/test-file":
        source[0] = with_types(source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("builder-inited", lambda app: write_api(Path(app.srcdir) / "reference" / "api"), priority=400)
    app.connect("source-read", _read, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
