"""Made-up results for tests of what reads them."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.results import QUANTITIES, FrameRecord, Origin, Result, ResultStore
from rgbmidic.results.result_in_units import ResultInUnits
from rgbmidic.timing import STAGES
from rgbmidic.tools.report import render
from rgbmidic.tools.report.document import ReportConstants

LIGHTS = ("red", "green", "blue")
MESH = Tri3Mesh.from_region(Region.from_rectangle((10, 5, 110, 75), (80, 120)), 20)
NODES = len(MESH.nodes)


def smooth_record(index: int) -> FrameRecord:
    """A field that every probe can read, of a stretch that grows with the frames."""
    x, y = MESH.nodes.T
    u, v = 0.002 * index * (x - 60), 0.001 * index * (y - 40)
    both = {"u": u, "v": v, "u_std": np.full(NODES, 0.01), "v_std": np.full(NODES, 0.02)}
    more = {
        "nodal_exx": np.full(NODES, 0.002 * index),
        "misfit": np.ones(NODES),
        "light_fraction": np.full((NODES, 3), 1 / 3),
    }
    return FrameRecord.from_values(
        nodes=NODES, lights=3, number=index, status=0, node_status=np.zeros(NODES), **both, **more
    )


def random_record(seed: int) -> FrameRecord:
    """A record in which some nodes are not measured; its shapes and types are the table's."""
    random = np.random.default_rng(seed)
    blank = random.random(NODES) < 0.2
    values = {
        name: np.where(blank, np.nan, random.normal(0, 1e-3 if name.startswith("nodal_e") else 3, NODES))
        for name, quantity in QUANTITIES.items()
        if quantity.axes == ("node",)
    }
    for name in (name for name in values if name.endswith("_std")):
        values[name] = np.where(blank, np.nan, random.uniform(0.01, 0.02, NODES))
    estimated = [name for name, quantity in QUANTITIES.items() if quantity.is_estimated]
    values |= {name: random.uniform(0.01, 0.02, NODES * (seed % 2)) for name in estimated}
    pictures = random.integers(0, 256, (2, 3, 8, 12)).astype(np.uint8) if seed % 2 == 0 else (None, None)
    history = 0.5 * 0.1 ** np.arange(1 + seed % 5)
    values |= {
        "number": seed,
        "time_ns": seed * 1_000_003,
        "status": seed % 2,
        "reason": "did not converge: é" if seed % 2 else "",
        "warnings": ["dark: é", "late"][: seed % 3],
        "unread": seed % 2,
        "tries": 1 + seed % 2,
        "iterations": len(history),
        "history": history,
        "inputs": [[f"/data/{seed}.dng", f"{seed:02x}"]],
        "machine": "a processor, a BLAS",
        "checksum": 7 * seed,
        "node_status": blank,
        "match": random.uniform(0.9, 1),
        "best_match": random.uniform(0.9, 1),
        "reference_updates": np.arange(seed % 3),
        "misfit": np.ones(NODES),
        "light_fraction": np.full((NODES, len(LIGHTS)), 1 / len(LIGHTS)),
        "residual": random.uniform(10, 20, 3),
        "weight_fraction": random.uniform(0.5, 1, 3),
        "brightness": random.uniform(0.9, 1.1, (3, 2)),
        "seconds": random.uniform(0, 1, len(STAGES)),
        "rigid": random.normal(0, 1, (3, seed % 3)),
        "weights_thumbnail": pictures[0],
        "reflection_thumbnail": pictures[1],
    }
    assert values.keys() == QUANTITIES.keys()
    return FrameRecord.from_values(nodes=NODES, lights=len(LIGHTS), **values)


def corrupt(result: Result, frame: int) -> Path:
    """Turn a bit in the file of a frame, in the displacement."""
    file = result.path / "solution" / f"{frame:06d}.npz"
    content = bytearray(file.read_bytes())
    content[content.find(b"u.npy") + 200] ^= 4
    file.write_bytes(content)
    return file


def make_result(
    path: Path,
    *,
    frames: int = 2,
    overwrite: bool = False,
    record: Callable[[int], FrameRecord] | None = None,
    **options: Any,
) -> Result:
    """A finished result, of random records unless stated."""
    store = ResultStore.create(path, make_origin(frames, **options), overwrite=overwrite)
    for index in range(frames):
        store.write_frame(index, (record or random_record)(index))
    store.finish()
    return Result.open(path)


def make_origin(frames: int, **options: Any) -> Origin:
    """What the frames of a made-up result share."""
    names = [f"frame {index}" for index in range(frames)]
    return Origin(**{"nodes": MESH.nodes, "elements": MESH.elements, "names": names, "lights": LIGHTS, **options})


def analysis_rows(result: Result) -> dict[str, str]:
    """The rows of a report's table of the analysis."""
    given = {
        "physical": ResultInUnits.from_result(result),
        "constants": ReportConstants(),
        "reference": "",
        "noise": "",
    }
    rows = re.findall("<tr><td>(.*?)</td><td>(.*?)</td></tr>", render("analysis.html", **given))
    return {name: html.unescape(text) for name, text in rows}
