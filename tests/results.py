"""Made-up results for tests of what reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.results.store import FrameRecord, Result, ResultStore

__all__ = ["LIGHTS", "MESH", "NODES", "make_result", "random_record"]

LIGHTS = ("red", "green", "blue")
MESH = Tri3Mesh.from_region(Region.from_rectangle((10, 5, 110, 75), (80, 120)), 20)
NODES = len(MESH.nodes)


def random_record(seed: int) -> FrameRecord:
    """A record in which some nodes are not measured."""
    random = np.random.default_rng(seed)
    blank = random.random(NODES) < 0.2
    displacement = np.where(blank[:, None], np.nan, random.normal(0, 3, (NODES, 2)))
    return FrameRecord(
        displacement=displacement,
        displacement_std=np.where(blank[:, None], np.nan, random.uniform(0.01, 0.02, (NODES, 2))),
        strain=np.where(blank[:, None], np.nan, random.normal(0, 1e-3, (NODES, 3))),
        light_share=np.full((NODES, len(LIGHTS)), 1 / len(LIGHTS)),
        misfit=np.ones(NODES),
        strain_std=np.where(blank[:, None], np.nan, random.uniform(1e-4, 2e-4, (NODES, 3))),
        status=seed % 2,
        node_status=blank.astype(np.uint8),
        residual=random.uniform(10, 20, 3),
        weight_share=random.uniform(0.5, 1, 3),
        rigid=random.normal(0, 1, (3, seed % 3)),
        history=0.5 * 0.1 ** np.arange(1 + seed % 5),
        reason="did not converge: é" if seed % 2 else "",
        weights_thumbnail=random.integers(0, 256, (3, 8, 12)).astype(np.uint8) if seed % 2 == 0 else None,
        brightness=random.uniform(0.9, 1.1, (3, 2)),
        reflection_thumbnail=random.integers(0, 256, (3, 8, 12)).astype(np.uint8) if seed % 2 == 0 else None,
        inputs={f"/data/{seed}.dng": f"{seed:02x}"},
    )


def make_result(path: Path, *, frames: int = 2, **options: Any) -> Result:
    """A finished result of random records."""
    names = [f"frame {index}" for index in range(frames)]
    store = ResultStore.create(path, nodes=MESH.nodes, elements=MESH.elements, names=names, lights=LIGHTS, **options)
    for index in range(frames):
        store.write_frame(index, random_record(index))
    store.finish()
    return Result.open(path)
