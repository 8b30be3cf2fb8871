"""The main job: a test's raw frames in, displacement fields with their uncertainty out, each kept as it finishes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rgbmidic.correlation import NodeStatus, Start, Status
from rgbmidic.pipeline.frame import measure_frame
from rgbmidic.pipeline.plan import Plan
from rgbmidic.results import FrameRecord, Origin, Result, ResultStore
from rgbmidic.settings import TestSettings

__all__ = ["measure"]

Progress = Callable[[int, int, str], None]


def measure(
    settings: TestSettings, out: Path | str, *, overwrite: bool = False, progress: Progress | None = None
) -> Result:
    """Measure a test: displacement of every frame against the reference.

    Parameters
    ----------
    settings
        What `rgbmidic.settings.read_test` reads from TEST.toml.
    out
        Result folder; nothing is written to it before settings, calibration, region and reference are found good.
    overwrite
        Replace a result that is already there.
    progress
        Called after every frame with the number of frames done, their total and a line about the last one.

    Returns
    -------
    Result
        A frame that cannot be read or measured is kept as failed with its reason; the others go on.

    Raises
    ------
    RgbmidicError
        The settings, the calibration, the region or the reference frames are not usable.
    """
    plan = Plan.from_settings(settings)
    names = [plan.series.name(index) for index in range(len(plan.series))]
    origin = Origin(
        nodes=plan.reference.mesh.nodes,
        elements=plan.reference.mesh.elements,
        names=names,
        lights=plan.images.names,
        settings=settings,
        references=settings.frames.reference,
        reference=plan.images.values,
        notes=plan.weights.notes,
    )
    with ResultStore.create(out, origin, overwrite=overwrite) as store:
        start = Start(displacement=None)
        for index, name in enumerate(names):
            record, start = measure_frame(plan, index, start)
            store.write_frame(index, record)
            if progress is not None:
                progress(index + 1, len(names), _line(name, record))
        store.finish()
    return Result.open(out)


def _line(name: str, record: FrameRecord) -> str:
    status = Status(record.status)
    if status is Status.CONVERGED:
        measured = float((record.node_status == NodeStatus.MEASURED).mean())
        return f"{name}: converged in {record.iterations} iterations, {measured:.0%} of the nodes measured"
    return f"{name}: {status.name.lower().replace('_', ' ')}: {record.reason}"
