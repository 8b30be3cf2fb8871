"""The JSON schema of a TEST.toml, by which editors complete and check it (docs/reference/test.schema.json)."""

from __future__ import annotations

import json
import types
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from rgbmidic.arguments import to_plain, type_hints
from rgbmidic.settings.schema import section_types

_TYPES = {bool: "boolean", float: "number", int: "integer", str: "string", Path: "string"}
_BOUNDS = {
    "above": "exclusiveMinimum",
    "at_least": "minimum",
    "at_most": "maximum",
    "below": "exclusiveMaximum",
}


def json_schema() -> dict[str, Any]:
    """Describe TEST.toml as a JSON schema (draft 2020-12), generated from `rgbmidic.settings.TestSettings`.

    Bounds and types of single keys are in it; what keys demand of each other is checked when a file is read.

    Returns
    -------
    dict
    """
    sections = {
        name: {
            "type": "object",
            "additionalProperties": False,
            "properties": {entry.name: _described(type_hints(kind)[entry.name], entry) for entry in fields(kind)},
            "required": [entry.name for entry in fields(kind) if entry.default is entry.default_factory is MISSING],
        }
        for name, kind in section_types().items()
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "TEST.toml of rgbmidic",
        "type": "object",
        "additionalProperties": False,
        "properties": sections,
        "required": ["frames", "region"],
    }


def _value(hint: Any) -> dict[str, Any]:
    kind, parts = get_origin(hint), [part for part in get_args(hint) if part is not type(None)]
    if kind is Literal:
        return {"enum": parts}
    if kind in (Union, types.UnionType):
        return {"anyOf": [_value(part) for part in parts]} if len(parts) > 1 else _value(parts[0])
    if kind is not tuple:
        return {"type": _TYPES[hint]} if hint in _TYPES else {}
    if len(parts) != 2 or parts[1] is not Ellipsis:
        return {"type": "array", "prefixItems": [*map(_value, parts)], "minItems": len(parts), "maxItems": len(parts)}
    one = _value(parts[0])  # a single one needs no brackets
    ranges = [{"type": "string", "pattern": r"^\s*\d+\s*:\s*\d+\s*$"}] if parts[0] is int else []
    return {"anyOf": [{"type": "array", "items": one}, one, *ranges]}


def _described(hint: Any, entry: Field[Any]) -> dict[str, Any]:
    """Describe a key; bounds are those of a single number, and in lists are checked when the file is read."""
    known = _value(hint)
    if hint in (int, float):
        known |= {_BOUNDS[name]: value for name, value in entry.metadata.get("bounds", {}).items()}
    return known if entry.default in (MISSING, None) else known | {"default": to_plain(entry.default)}


if __name__ == "__main__":
    print(json.dumps(json_schema(), indent=1))
