"""What is kept of one frame, and its file: an npz that appears under its name only when it is complete."""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError, ResultError
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    from rgbmidic.correlation.solution import Solution

__all__ = ["FrameRecord", "read_arrays", "read_record", "write_complete", "write_record"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameRecord:
    """The result of one frame of N nodes and k lights.

    Attributes
    ----------
    strain, strain_std : ndarray, shape (N, 3), float64
        (exx, eyy, exy) and standard uncertainty; NaN where not measured.
    displacement, displacement_std : ndarray, shape (N, 2), float64
        (u, v) and standard uncertainty in px; NaN where not measured.
    status : int
        A `Status`.
    node_status : ndarray, shape (N,), uint8
        A `NodeStatus` per node.
    light_share : ndarray, shape (N, k), float64
        Share of each light in what determines a node.
    misfit : ndarray, shape (N,), float64
        Residual around a node over its median.
    residual, weight_share : ndarray, shape (k,), float64
        Weighted rms residual in grey levels and mean weight over the region, per light.
    rigid : ndarray, shape (k, m), float64
        Coefficients beta of the rigid functions, per light.
    history : ndarray, shape (iterations,), float64
        Largest motion of a node in each iteration, px.
    brightness : ndarray, shape (k, 2), float64
        Gain and offset (grey levels) of each light against the reference; NaN where not known.
    reason : str
        Why the frame failed or did not converge; empty otherwise.
    weights_thumbnail : ndarray, shape (k, h, w), uint8, or None
        Reduced picture of each light's weight, 255 for 1.
    reflection_thumbnail : ndarray, shape (k, h, w), uint8, or None
        Reduced picture of each light's reflection index, 255 for 1; None where the separation does not tell it.
    inputs : mapping of str to str
        Path and SHA-256 of the files that the frame was read from.
    """

    displacement: FloatArray
    displacement_std: FloatArray
    strain: FloatArray
    strain_std: FloatArray
    status: int
    node_status: npt.NDArray[np.uint8]
    light_share: FloatArray
    misfit: FloatArray
    residual: FloatArray
    weight_share: FloatArray
    rigid: FloatArray
    history: FloatArray
    brightness: FloatArray | None = None
    reason: str = ""
    weights_thumbnail: npt.NDArray[np.uint8] | None = None
    reflection_thumbnail: npt.NDArray[np.uint8] | None = None
    inputs: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.brightness is None:
            object.__setattr__(self, "brightness", np.full((len(np.atleast_1d(self.residual)), 2), np.nan))
        for name, (shape, dtype) in _arrays(len(np.atleast_1d(self.node_status)), len(np.atleast_1d(self.residual))):
            array = np.asarray(getattr(self, name), dtype=dtype)
            fits = array.ndim == len(shape) and all(size < 0 or size == array.shape[i] for i, size in enumerate(shape))
            if not fits:
                raise InputError(f"a frame record's {name} has shape {shape} (-1: any), not {array.shape}")
            object.__setattr__(self, name, array)
        object.__setattr__(self, "status", int(self.status))

    @classmethod
    def from_solution(
        cls,
        solution: Solution,
        *,
        brightness: FloatArray | None = None,
        weights_thumbnail: npt.NDArray[np.uint8] | None = None,
        reflection_thumbnail: npt.NDArray[np.uint8] | None = None,
        inputs: Mapping[str, str] | None = None,
    ) -> FrameRecord:
        """The record of a solved frame."""
        names = [name for name, _ in _arrays(0, 0) if name != "brightness"]
        return cls(
            **{name: getattr(solution, name) for name in names},
            status=solution.status,
            reason=solution.reason,
            brightness=brightness,
            weights_thumbnail=weights_thumbnail,
            reflection_thumbnail=reflection_thumbnail,
            inputs=inputs or {},
        )

    @classmethod
    def failed(cls, reason: str, *, nodes: int, lights: int, inputs: Mapping[str, str] | None = None) -> FrameRecord:
        """The record of a frame that could not be measured at all: NaN everywhere, and the reason."""
        from rgbmidic.correlation.solution import NodeStatus, Status  # readers of results need no solver

        return cls(
            displacement=np.full((nodes, 2), np.nan),
            displacement_std=np.full((nodes, 2), np.nan),
            strain=np.full((nodes, 3), np.nan),
            strain_std=np.full((nodes, 3), np.nan),
            status=Status.FAILED,
            node_status=np.full(nodes, NodeStatus.NOT_SEEN, dtype=np.uint8),
            light_share=np.zeros((nodes, lights)),
            misfit=np.full(nodes, np.nan),
            residual=np.full(lights, np.nan),
            weight_share=np.full(lights, np.nan),
            rigid=np.zeros((lights, 0)),
            history=np.zeros(0),
            reason=reason,
            inputs=inputs or {},
        )

    @property
    def iterations(self) -> int:
        """Number of Gauss-Newton iterations."""
        return len(self.history)


def _arrays(nodes: int, lights: int) -> list[tuple[str, tuple[tuple[int, ...], Any]]]:
    """Shape (-1: any) and type of every array of a record."""
    return [
        ("displacement", ((nodes, 2), np.float64)),
        ("displacement_std", ((nodes, 2), np.float64)),
        ("strain", ((nodes, 3), np.float64)),
        ("strain_std", ((nodes, 3), np.float64)),
        ("node_status", ((nodes,), np.uint8)),
        ("light_share", ((nodes, lights), np.float64)),
        ("misfit", ((nodes,), np.float64)),
        ("residual", ((lights,), np.float64)),
        ("weight_share", ((lights,), np.float64)),
        ("rigid", ((lights, -1), np.float64)),
        ("history", ((-1,), np.float64)),
        ("brightness", ((lights, 2), np.float64)),
    ]


def write_record(path: Path, record: FrameRecord) -> None:
    """Write a record; a file of the same name is replaced once the new one is complete."""
    content = {entry.name: getattr(record, entry.name) for entry in fields(record)}
    content["inputs"] = json.dumps(dict(record.inputs))
    arrays: dict[str, Any] = {name: np.asarray(value) for name, value in content.items() if value is not None}
    write_complete(path, lambda file: np.savez(file, **arrays))


def read_record(path: Path) -> FrameRecord:
    """Read a record.

    Raises
    ------
    ResultError
        The file is missing or damaged.
    """
    arrays: dict[str, Any] = read_arrays(path)
    try:
        plain: dict[str, Any] = {
            "status": int(arrays.pop("status")),
            "reason": str(arrays.pop("reason")),
            "inputs": json.loads(str(arrays.pop("inputs"))),
        }
        return FrameRecord(**arrays, **plain)
    except (KeyError, TypeError, ValueError) as error:
        raise ResultError(f"{path} is damaged: {error}") from None


def read_arrays(path: Path) -> dict[str, AnyArray]:
    """All arrays of an npz file, checksums verified.

    Raises
    ------
    ResultError
        The file is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        raise ResultError(f"{path} is missing: the result is incomplete") from None
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        raise ResultError(f"{path} is damaged: {error}") from None


def write_complete(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file under another name and rename it when all of it is on the disk."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise ResultError(f"{path} cannot be written: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)
