"""What a new frame costs the viewer's server: reading a field and painting it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import tifffile
from results import make_result

from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.results import FrameRecord, Maps
from rgbmidic.settings import TestSettings
from rgbmidic.tools.report.painter import ImageWindow, Overlay, paint, palette
from rgbmidic.tools.view.fields import FieldsInView
from rgbmidic.tools.view.url_state import ViewState

from .tables import table

FRAMES, SIDE = 12, 1200
"""Frames of the result, and side of the region, px."""


@table("viewer", page="how-to/view", cost=3, timing=True)
def viewer(quick: bool) -> Iterator[dict[str, object]]:
    """Processor time of the viewer's server for a frame that was not shown before: reading a field with its
    uncertainty, and painting it on 1100 x 700 pixels of the screen; median of ten frames."""
    picture = np.random.default_rng(0).integers(0, 255, (SIDE, SIDE), dtype=np.uint8)
    window = ImageWindow(x_min=0, y_min=0, x_max=SIDE, y_max=SIDE, width=1100, height=700).fit_aspect()
    for size in (120,) if quick else (40, 12):
        mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, SIDE - 1, SIDE - 1), (SIDE, SIDE)), size)
        fields = np.random.default_rng(1).normal(size=(2, len(mesh.nodes)))

        def record(index: int, fields: np.ndarray = fields) -> FrameRecord:
            named = dict(zip(("u", "v"), fields, strict=True)) | {f"{name}_std": abs(fields[0]) + 0.1 for name in "uv"}
            return FrameRecord.from_values(nodes=fields.shape[1], lights=3, number=index, status=0, **named)

        with tempfile.TemporaryDirectory() as folder:
            parts = {"nodes": mesh.nodes, "elements": mesh.elements, "references": []}
            made = make_result(Path(folder) / "result", frames=FRAMES, record=record, **parts)
            maps, colours = Maps.from_result(made), palette("viridis")
            for name in ("u", "exx"):
                times = []
                for index in range(FRAMES):
                    start = time.process_time()
                    values = maps.read(name, index)
                    read = time.process_time()
                    over = {
                        "nodes": mesh.nodes,
                        "elements": mesh.elements,
                        "values": values.values,
                        "colour_range": (-1.0, 1.0),
                    }
                    paint(window, picture, Overlay(colours=colours, **over))
                    times.append((read - start, time.process_time() - read))
                reading, painting = 1e3 * np.median(times[2:], axis=0)
                row: dict[str, object] = {"nodes": str(len(mesh.nodes)), "field": name}
                yield row | {"reading [ms]": float(reading), "painting [ms]": float(painting)}


ROWS, COLUMNS = 2048, 2560
"""Of a raw frame of 5 million pixels, as fast cameras have them."""


@table("viewer_latency", page="how-to/view", cost=3, timing=True)
def viewer_latency(quick: bool) -> Iterator[dict[str, object]]:
    """Processor time of the viewer's server for a step to the next frame over raw frames of 5 Mpx (12 bit, TIFF;
    strain on a mesh of 2,000 nodes): read when it is asked for, and where it was read ahead; median and largest of the
    steps."""
    mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, COLUMNS - 1, ROWS - 1), (ROWS, COLUMNS)), 50)
    levels, count = np.random.default_rng(0).integers(0, 4096, (ROWS, COLUMNS), dtype=np.uint16), 4 if quick else FRAMES
    fields = np.random.default_rng(1).normal(size=(2, len(mesh.nodes)))

    def record(index: int) -> FrameRecord:
        named = dict(zip(("u", "v"), fields, strict=True)) | {f"{name}_std": abs(fields[0]) + 0.1 for name in "uv"}
        return FrameRecord.from_values(nodes=len(mesh.nodes), lights=1, number=index, status=0, **named)

    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        for index in range(count):
            tifffile.imwrite(base / f"f{index:02d}.tif", np.roll(levels, index))
        stated = {"path": "f*.tif", "kind": "monochrome"}
        region = {"rectangle": [0, 0, COLUMNS - 1, ROWS - 1]}
        settings = TestSettings.from_mapping({"frames": stated, "region": region}, base)
        parts = {"nodes": mesh.nodes, "elements": mesh.elements, "lights": ["light"], "settings": settings}
        made = make_result(base / "result", frames=count, record=record, **parts)
        window = ImageWindow(x_min=0, y_min=0, x_max=COLUMNS, y_max=ROWS, width=1100, height=700).fit_aspect()
        for ahead in (False, True):
            shown, times = FieldsInView(made, ViewState(field="exx", over="deformed", frame=0)), list[float]()
            for frame in range(count):
                shown.view = replace(shown.view, frame=frame)
                start = time.process_time()
                paint(window, shown.picture[0], shown.overlay("exx"))
                times.append(1e3 * (time.process_time() - start))
                if ahead:
                    shown.read_ahead()
            row: dict[str, object] = {"read ahead": "yes" if ahead else "no"}
            yield row | {"median [ms]": float(np.median(times[1:])), "largest [ms]": float(max(times[1:]))}
