"""The result of a test on disk: one folder that grows frame by frame and can be read at any time.

``provenance.json`` (settings, inputs with their hashes, versions, dates), ``mesh.npz``, ``reference.npz`` (the
reference images as pictures) and one npz per frame under ``solution/``. Every file appears under its name only when it
is complete, so several processes may write frames and an interrupted run loses none that was finished.
"""

from __future__ import annotations

import importlib.metadata
import json
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic import __version__
from rgbmidic.errors import InputError, ResultError
from rgbmidic.frames.series import file_hash
from rgbmidic.results.record import FrameRecord, read_arrays, read_record, write_complete, write_record
from rgbmidic.settings import TestSettings
from rgbmidic.typing import AnyArray, FloatArray, FloatImage

__all__ = ["FrameRecord", "Result", "ResultStore"]

SCHEMA_NAME = "rgbmidic-result"
SCHEMA_VERSION = 2

_PROVENANCE, _MESH, _REFERENCE, _FRAMES = "provenance.json", "mesh.npz", "reference.npz", "solution"
_FRAME_FILE = re.compile(r"frame_[0-9]{6,}\.npz(\.[0-9]+\.part)?")
_PACKAGES = ("numpy", "scipy", "numba", "opencv-python-headless", "rawpy", "tifffile")


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultStore:
    """The writing side of a result folder; small, so that it can be sent to other processes.

    Attributes
    ----------
    path
        The folder.
    frame_count, node_count, light_count
        Sizes that every frame must have.
    """

    path: Path
    frame_count: int
    node_count: int
    light_count: int

    @classmethod
    def create(
        cls,
        path: Path | str,
        *,
        nodes: npt.ArrayLike,
        elements: npt.ArrayLike,
        names: Sequence[str],
        lights: Sequence[str],
        settings: TestSettings | None = None,
        reference: npt.ArrayLike | None = None,
        notes: Mapping[str, Any] | None = None,
        overwrite: bool = False,
    ) -> ResultStore:
        """Start a result.

        Parameters
        ----------
        path
            Folder; made where it does not exist. Files in it that are not a result's are never touched.
        nodes, elements
            The mesh: (N, 2) positions in px and (E, 3) node indices.
        names, lights
            Name of each frame and of each light.
        settings
            Kept in the provenance, with the hash of the calibration file that they name.
        reference : array, shape (k, H, W), optional
            Reference image of each light, NaN where unknown; kept in 8 bit, for figures.
        notes
            Further plain values to keep in the provenance.
        overwrite
            Whether a result that is already in the folder may be replaced.

        Raises
        ------
        ResultError
            The folder holds a result (and `overwrite` is False) or foreign files under a result's names, or cannot be
            written.
        """
        path = Path(path)
        mesh: dict[str, Any] = {
            "nodes": np.asarray(nodes, dtype=np.float64),
            "elements": np.asarray(elements, dtype=np.int32),
        }
        provenance = _provenance(settings, names, lights, notes or {})
        _make_room(path, overwrite=overwrite)
        _write_json(path / _PROVENANCE, provenance)
        _frame_path(path, 0).parent.mkdir(exist_ok=True)
        write_complete(path / _MESH, lambda file: np.savez(file, **mesh))
        if reference is not None:
            pictures = _pictures(np.asarray(reference, dtype=np.float32))
            write_complete(path / _REFERENCE, lambda file: np.savez_compressed(file, pictures=pictures))
        return cls(path=path, frame_count=len(names), node_count=len(mesh["nodes"]), light_count=len(lights))

    def write_frame(self, index: int, record: FrameRecord) -> None:
        """Keep the result of frame `index`; may be called in any order, from any process.

        Raises
        ------
        InputError
            There is no such frame, or the record has another number of nodes or lights.
        ResultError
            The file cannot be written.
        """
        if not 0 <= index < self.frame_count:
            raise InputError(f"there is no frame {index} in a result of {self.frame_count} frames")
        given = len(record.node_status), len(record.residual)
        if given != (self.node_count, self.light_count):
            raise InputError(
                f"frame {index} has {given[0]} nodes and {given[1]} lights; the result has {self.node_count} and "
                f"{self.light_count}"
            )
        write_record(_frame_path(self.path, index), record)

    def finish(self) -> None:
        """Complete the provenance with all frames' inputs and the date; call once, when every frame is written."""
        provenance = _read_provenance(self.path)
        provenance["inputs"] = Result.open(self.path).inputs
        provenance["finished"] = _now()
        _write_json(self.path / _PROVENANCE, provenance)


@dataclass(frozen=True, kw_only=True)
class Result:
    """The reading side of a result folder; arrays are read when they are first asked for.

    Attributes
    ----------
    path
        The folder.
    nodes : ndarray, shape (N, 2), float64
        Positions (x, y) in px on the reference image.
    elements : ndarray, shape (E, 3), int32
        Node indices.
    names : tuple of str, length T
        The frames' names.
    lights : tuple of str, length k
        The lights' names.
    provenance
        Settings, inputs, versions and dates, as in ``provenance.json``.
    """

    path: Path
    nodes: FloatArray
    elements: npt.NDArray[np.int32]
    names: tuple[str, ...]
    lights: tuple[str, ...]
    provenance: Mapping[str, Any]

    @classmethod
    def open(cls, path: Path | str, *, partial: bool = False) -> Result:
        """Open a result folder.

        Parameters
        ----------
        path
            The folder.
        partial
            Take the frames before the first missing one of an interrupted run as the whole result.

        Raises
        ------
        ResultError
            The folder is not a result, is damaged, is incomplete (unless `partial`), or has no frame at all.
        """
        path = Path(path)
        provenance = _read_provenance(path)
        mesh = read_arrays(path / _MESH)
        try:
            names, lights = tuple(provenance["frames"]), tuple(provenance["lights"])
            nodes, elements = mesh["nodes"], mesh["elements"]
        except (KeyError, TypeError) as error:
            raise ResultError(f"{path} is damaged: {error} is missing") from None
        written = next((i for i in range(len(names)) if not _frame_path(path, i).is_file()), len(names))
        if written < len(names) and not (partial and written):
            raise ResultError(
                f"{path} is incomplete: frame {written} ({names[written]}) of {len(names)} is missing; was the run "
                "interrupted?"
            )
        return cls(
            path=path, nodes=nodes, elements=elements, names=names[:written], lights=lights, provenance=provenance
        )

    def __len__(self) -> int:
        """Number of frames T."""
        return len(self.names)

    def frame(self, index: int) -> FrameRecord:
        """Everything that is kept of one frame.

        Raises
        ------
        ResultError
            The frame's file is missing or damaged, or does not fit the mesh.
        """
        if not 0 <= index < len(self):
            raise InputError(f"there is no frame {index} in a result of {len(self)} frames (0 to {len(self) - 1})")
        record = read_record(_frame_path(self.path, index))
        if (len(record.node_status), len(record.residual)) != (len(self.nodes), len(self.lights)):
            raise ResultError(f"{_frame_path(self.path, index)} is damaged: it does not belong to this mesh and lights")
        return record

    @cached_property
    def _records(self) -> tuple[FrameRecord, ...]:
        return tuple(self.frame(index) for index in range(len(self)))

    def _stack(self, name: str) -> AnyArray:
        return np.stack([getattr(record, name) for record in self._records])

    @cached_property
    def reference(self) -> npt.NDArray[np.uint8] | None:
        """Reference image of each light as a picture, shape (k, H, W); None where none was kept."""
        if not (self.path / _REFERENCE).is_file():
            return None
        return read_arrays(self.path / _REFERENCE)["pictures"]

    @cached_property
    def u(self) -> FloatArray:
        """Displacement in x, px, shape (T, N); NaN where not measured."""
        return self._stack("displacement")[..., 0]

    @cached_property
    def v(self) -> FloatArray:
        """Displacement in y, px, shape (T, N); NaN where not measured."""
        return self._stack("displacement")[..., 1]

    @cached_property
    def u_std(self) -> FloatArray:
        """Standard uncertainty of `u`, px, shape (T, N)."""
        return self._stack("displacement_std")[..., 0]

    @cached_property
    def v_std(self) -> FloatArray:
        """Standard uncertainty of `v`, px, shape (T, N)."""
        return self._stack("displacement_std")[..., 1]

    @cached_property
    def strain(self) -> FloatArray:
        """Small strain (exx, eyy, exy), tensor shear, shape (T, N, 3); NaN where not measured."""
        return self._stack("strain")

    @cached_property
    def strain_std(self) -> FloatArray:
        """Standard uncertainty of `strain`, shape (T, N, 3)."""
        return self._stack("strain_std")

    @cached_property
    def light_share(self) -> FloatArray:
        """Share of each light in what determines a node, shape (T, N, k)."""
        return self._stack("light_share")

    @cached_property
    def mean_share(self) -> FloatArray:
        """Mean of `light_share` over the measured nodes, shape (T, k); NaN where none is measured."""
        measured = (self.node_status == 0)[..., None]
        count = measured.sum(axis=1)
        total = np.where(measured, self.light_share, 0).sum(axis=1)
        return np.asarray(np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0))

    @cached_property
    def misfit(self) -> FloatArray:
        """Residual around each node over its median, shape (T, N); well above 1 is suspicious."""
        return self._stack("misfit")

    @cached_property
    def status(self) -> npt.NDArray[np.int64]:
        """`Status` of each frame, shape (T,)."""
        return np.array([record.status for record in self._records], dtype=np.int64)

    @cached_property
    def node_status(self) -> npt.NDArray[np.uint8]:
        """`NodeStatus` of each node and frame, shape (T, N)."""
        return self._stack("node_status")

    @cached_property
    def iterations(self) -> npt.NDArray[np.int64]:
        """Gauss-Newton iterations of each frame, shape (T,)."""
        return np.array([record.iterations for record in self._records], dtype=np.int64)

    @cached_property
    def residual(self) -> FloatArray:
        """Weighted rms residual of each frame and light, grey levels, shape (T, k)."""
        return self._stack("residual")

    @cached_property
    def weight_share(self) -> FloatArray:
        """Mean weight of each light over the region, shape (T, k)."""
        return self._stack("weight_share")

    @cached_property
    def brightness(self) -> FloatArray:
        """Gain and offset (grey levels) of each light against the reference, shape (T, k, 2)."""
        return self._stack("brightness")

    @cached_property
    def reasons(self) -> tuple[str, ...]:
        """Why each frame failed or did not converge, length T; empty texts otherwise."""
        return tuple(record.reason for record in self._records)

    @property
    def inputs(self) -> dict[str, str]:
        """Path and SHA-256 of every file that the frames were read from."""
        return {name: digest for record in self._records for name, digest in record.inputs.items()}


def _frame_path(path: Path, index: int) -> Path:
    return path / _FRAMES / f"frame_{index:06d}.npz"


def _pictures(images: FloatImage) -> npt.NDArray[np.uint8]:
    """Images in 8 bit, each stretched between its own extreme percent; 0 where unknown."""
    known = np.isfinite(images).any(axis=(1, 2), keepdims=True)
    low, high = np.nanpercentile(np.where(known, images, 0), [1, 99], axis=(1, 2), keepdims=True)
    scaled = 255 * (images - low) / np.maximum(high - low, 1e-6)
    pictures: npt.NDArray[np.uint8] = np.clip(np.nan_to_num(scaled), 0, 255).astype(np.uint8)
    return pictures


def _make_room(path: Path, *, overwrite: bool) -> None:
    """Make the folder, or empty it of an old result; nothing else in it is touched."""
    frames = path / _FRAMES
    if (path / _PROVENANCE).exists():
        _read_provenance(path)  # refuses foreign files of this name
        if not overwrite:
            raise ResultError(
                f"{path} already holds a result; choose another folder, or overwrite it (overwrite=True, --overwrite)"
            )
    elif foreign := [name for name in (_MESH, _REFERENCE, _FRAMES) if (path / name).exists()]:
        raise ResultError(f"{path} holds a {foreign[0]} that is not of a result; give another folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
        (path / _REFERENCE).unlink(missing_ok=True)
        for file in frames.glob("*"):
            if _FRAME_FILE.fullmatch(file.name):
                file.unlink()
    except OSError as error:
        raise ResultError(f"{path} cannot be written: {error.strerror or error}") from None


def _provenance(
    settings: TestSettings | None, names: Sequence[str], lights: Sequence[str], notes: Mapping[str, Any]
) -> dict[str, Any]:
    document: dict[str, Any] = {"schema": SCHEMA_NAME, "schema_version": SCHEMA_VERSION, "created": _now()}
    document["versions"] = {"rgbmidic": __version__, "python": platform.python_version(), **_package_versions()}
    document["platform"] = platform.platform()
    if settings is not None:
        document |= {"settings": settings.to_mapping(), "base": str(settings.base)}
        if (file := settings.calibration_file) is not None:
            document["calibration"] = {"file": str(file), "sha256": file_hash(file)}
    return {**document, **notes, "lights": list(lights), "frames": list(names)}


def _package_versions() -> dict[str, str]:
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def _read_provenance(path: Path) -> dict[str, Any]:
    file = path / _PROVENANCE
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ResultError(f"{path} is not a result folder: it has no {_PROVENANCE}") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ResultError(f"{file} is damaged: {error}") from None
    if not isinstance(document, dict) or document.get("schema") != SCHEMA_NAME:
        raise ResultError(f'{file} does not belong to a result: its "schema" is not "{SCHEMA_NAME}"')
    if document.get("schema_version") != SCHEMA_VERSION:
        raise ResultError(
            f"{path} has schema version {document.get('schema_version')!r}; this version of rgbmidic reads "
            f"{SCHEMA_VERSION}"
        )
    return document


def _write_json(path: Path, document: Mapping[str, Any]) -> None:
    text = json.dumps(document, indent=2, ensure_ascii=False) + "\n"
    write_complete(path, lambda file: file.write(text.encode()))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
