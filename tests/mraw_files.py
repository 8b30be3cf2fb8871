"""Writes Photron movies, .mraw with .cih or .cihx, as FASTCAM Viewer 3 and 4 lay them out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.typing import AnyArray

HEADER: dict[str, Any] = {
    "Record Rate(fps)": 30000,
    "Start Frame": 0,
    "Save Step": 1,
    "Correct Trigger Frame": 0,
    "Color Type": "Raw",
    "EffectiveBit Depth": 12,
    "EffectiveBit Side": "Lower",
    "Shutter Type2(nsec)": 20000,
}
"""Entries under their names in .cih; size, number of frames and bits of storage come from the frames."""

_PLACES = {
    "Image Width": "imageDataInfo/resolution/width",
    "Image Height": "imageDataInfo/resolution/height",
    "Color Type": "imageDataInfo/colorInfo/type",
    "Color Bit": "imageDataInfo/colorInfo/bit",
    "EffectiveBit Depth": "imageDataInfo/effectiveBit/depth",
    "EffectiveBit Side": "imageDataInfo/effectiveBit/side",
    "Total Frame": "frameInfo/totalFrame",
    "Start Frame": "frameInfo/startFrame",
    "Save Step": "frameInfo/skipFrame",
    "Correct Trigger Frame": "frameInfo/adjustTriggerPoint",
    "Record Rate(fps)": "recordInfo/recordRate",
    "Shutter Type2(nsec)": "recordInfo/shutterSpeedNsec",
}


def pack_bits(values: AnyArray, bits: int) -> bytes:
    """Samples one behind the other without a gap, the highest bit of each first; 8 and 16 bit as numbers."""
    if bits in (8, 16):
        return values.astype(f"<u{bits // 8}").tobytes()
    each = values.ravel()[:, None] >> np.arange(bits - 1, -1, -1) & 1
    return np.packbits(each.astype(np.uint8)).tobytes()


def write_mraw(folder: Path, frames: AnyArray, *, bits: int, ending: str = ".cihx", **entries: Any) -> Path:
    """A movie of frames (T, H, W) as stored; `entries` change or, with None, drop some; gives the path of .mraw."""
    count, rows, columns = frames.shape
    size = {"Image Width": columns, "Image Height": rows, "Total Frame": count, "Color Bit": bits}
    known = {name: value for name, value in {**HEADER, **size, **entries}.items() if value is not None}
    header = _cihx(known) if ending == ".cihx" else _cih(known)
    (folder / f"movie{ending}").write_bytes(header)
    (folder / "movie.mraw").write_bytes(b"".join(pack_bits(frame, bits) for frame in frames))
    return folder / "movie.mraw"


def _cih(entries: dict[str, Any]) -> bytes:
    lines = ["#Camera Information Header", "Time : 12:48", *(f"{name} : {value}" for name, value in entries.items())]
    older = ["END", "", "#Photron Fastcam Viewer Version Information:", "Image Width : 7", "Saved Time : 12:50", "END"]
    return "\r\n".join([*lines, *older]).encode()


def _cihx(entries: dict[str, Any]) -> bytes:
    groups: dict[str, list[str]] = {}
    for name, value in entries.items():
        if name in _PLACES:
            *outer, tag = _PLACES[name].split("/")
            inner = f"<{tag}>{value}</{tag}>"
            for group in outer[:0:-1]:
                inner = f"<{group}>{inner}</{group}>"
            groups.setdefault(outer[0], []).append(inner)
    body = "".join(f"<{group}>{''.join(_merged(inner))}</{group}>" for group, inner in groups.items())
    before = b"!!! This file can not be edited. !!!" + bytes(280)
    return before + f'<?xml version="1.0" encoding="utf-8"?>\r\n<cih>{body}</cih>\r\n'.encode() + b"\2\0x<3\x1a" * 40


def _merged(elements: list[str]) -> list[str]:
    """Elements of one group, the doubled ones of a subgroup joined."""
    joined: dict[str, str] = {}
    for element in elements:
        tag = element[1 : element.index(">")]
        close = f"</{tag}>"
        if tag in joined:
            joined[tag] = joined[tag].removesuffix(close) + element.removeprefix(f"<{tag}>")
        else:
            joined[tag] = element
    return list(joined.values())
