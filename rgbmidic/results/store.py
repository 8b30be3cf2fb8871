"""The result of a test on disk: one folder that grows frame by frame and can be read at any time.

``provenance.json`` (settings, inputs with their hashes, versions, dates), ``mesh.npz``, ``reference.npz`` (the
reference images as pictures) and one npz per frame under ``solution/``. Every file appears under its name only when it
is complete, so several processes may write frames and an interrupted run loses none that was finished. No other module
knows these files.
"""

from __future__ import annotations

import importlib.metadata
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from rgbmidic._version import __version__
from rgbmidic.errors import InputError, ResultError
from rgbmidic.frames import file_hash
from rgbmidic.results.files import read_arrays, read_json, write_arrays, write_json, writing
from rgbmidic.results.lock import release_lock, take_lock
from rgbmidic.results.quantities import QUANTITIES, SHARED
from rgbmidic.results.record import FrameRecord
from rgbmidic.settings import TestSettings
from rgbmidic.typing import AnyArray, FloatImage

__all__ = ["SCHEMA_VERSION", "ResultStore"]

SCHEMA_NAME = "rgbmidic-result"
SCHEMA_VERSION = 3
"""Goes up with every change of the quantities: a result of another version is refused, not guessed at."""

_PROVENANCE, _MESH, _REFERENCE, _FRAMES = "provenance.json", "mesh.npz", "reference.npz", "solution"
_LOCK = "in_use.json"
_FRAME_FILE = re.compile(r"frame_[0-9]{6,}\.npz(\.[0-9]+\.part)?")
_PACKAGES = ("numpy", "scipy", "numba", "opencv-python-headless", "rawpy", "tifffile")


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultStore:
    """A result folder; small, so that it can be sent to other processes.

    ``with ResultStore.create(...) as store`` keeps other runs out of the folder until the end, however it comes.

    Attributes
    ----------
    path
        The folder.
    frame_count
        Number of frames of the test.
    sizes
        Number of nodes (``"node"``) and of lights (``"light"``) of every frame.
    """

    path: Path
    frame_count: int
    sizes: Mapping[str, int]

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
            The folder is in use by another run, holds a result (and `overwrite` is False) or foreign files under a
            result's names, or cannot be written.
        """
        path = Path(path)
        mesh = {"nodes": SHARED["nodes"].convert(nodes, {}), "elements": SHARED["elements"].convert(elements, {})}
        provenance = _provenance(settings, names, lights, notes or {})
        sizes = {"node": len(mesh["nodes"]), "light": len(lights)}
        with writing(path):
            path.mkdir(parents=True, exist_ok=True)
        take_lock(path / _LOCK)
        store = cls(path=path, frame_count=len(names), sizes=sizes)
        try:
            _make_room(path, overwrite=overwrite)
            write_json(path / _PROVENANCE, provenance)
            write_arrays(path / _MESH, mesh)
            if reference is not None:
                write_arrays(path / _REFERENCE, {"reference": _pictures(np.asarray(reference, dtype=np.float32))})
        except BaseException:
            store.release()
            raise
        return store

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Let other runs write into the folder."""
        release_lock(self.path / _LOCK)

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
        if record.sizes != self.sizes:
            raise InputError(f"frame {index} has the sizes {record.sizes}, the result {self.sizes}")
        write_arrays(self._frame_file(index), record.values)

    def finish(self) -> None:
        """Put the date into the provenance and release the folder; call once, when every frame is written."""
        write_json(self.path / _PROVENANCE, {**read_provenance(self.path), "finished": _now()})
        self.release()

    def written(self) -> int:
        """Number of frames before the first missing one."""
        present = {file.name for file in (self.path / _FRAMES).glob("*")}
        missing = (i for i in range(self.frame_count) if self._frame_file(i).name not in present)
        return next(missing, self.frame_count)

    def read(self, index: int, names: Iterable[str]) -> dict[str, Any]:
        """The named quantities of frame `index`; the others are not read.

        Raises
        ------
        ResultError
            The frame is missing or damaged, or belongs to another mesh or other lights.
        """
        return _read(self._frame_file(index), names, self.sizes)

    def read_frame(self, index: int) -> FrameRecord:
        """All that is kept of frame `index`; errors as `read`."""
        return FrameRecord(values=self.read(index, QUANTITIES), sizes=self.sizes)

    def read_reference(self) -> npt.NDArray[np.uint8] | None:
        """Reference image of each light as a picture, shape (k, H, W); None where none was kept."""
        if not (self.path / _REFERENCE).is_file():
            return None
        pictures: npt.NDArray[np.uint8] = _read(self.path / _REFERENCE, ["reference"], self.sizes)["reference"]
        return pictures

    def _frame_file(self, index: int) -> Path:
        return self.path / _FRAMES / f"frame_{index:06d}.npz"


def read_mesh(path: Path) -> dict[str, AnyArray]:
    """``nodes`` (N, 2) and ``elements`` (E, 3) of the result in a folder."""
    return _read(path / _MESH, ["nodes", "elements"], {})


def _read(path: Path, names: Iterable[str], sizes: Mapping[str, int]) -> dict[str, Any]:
    arrays = read_arrays(path, names)
    try:
        return {name: (QUANTITIES | SHARED)[name].convert(array, sizes) for name, array in arrays.items()}
    except (TypeError, ValueError) as error:
        raise ResultError(f"{path} is damaged or does not belong to this mesh and these lights: {error}") from None


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
        read_provenance(path)  # refuses foreign files of this name
        if not overwrite:
            raise ResultError(
                f"{path} already holds a result; choose another folder, or overwrite it (overwrite=True, --overwrite)"
            )
    elif foreign := [name for name in (_MESH, _REFERENCE, _FRAMES) if (path / name).exists()]:
        raise ResultError(f"{path} holds a {foreign[0]} that is not of a result; give another folder")
    with writing(path):
        frames.mkdir(parents=True, exist_ok=True)
        (path / _REFERENCE).unlink(missing_ok=True)
        for file in frames.glob("*"):
            if _FRAME_FILE.fullmatch(file.name):
                file.unlink()


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
    return {one.name: one.version for one in importlib.metadata.distributions() if one.name in _PACKAGES}


def read_provenance(path: Path) -> dict[str, Any]:
    """The provenance of the result in a folder: names of frames and lights, settings, versions, dates.

    Raises
    ------
    ResultError
        The folder is no result, of another schema version, or damaged.
    """
    file = path / _PROVENANCE
    try:
        document = read_json(file)
    except FileNotFoundError:
        raise ResultError(f"{path} is not a result folder: it has no {_PROVENANCE}") from None
    if not isinstance(document, dict) or document.get("schema") != SCHEMA_NAME:
        raise ResultError(f'{file} does not belong to a result: its "schema" is not "{SCHEMA_NAME}"')
    if (version := document.get("schema_version")) != SCHEMA_VERSION:
        raise ResultError(f"{path} has schema version {version!r}; this version of rgbmidic reads {SCHEMA_VERSION}")
    names = [document.get("frames"), document.get("lights")]
    sections = document.get("settings", {})
    named = all(isinstance(entry, list) and all(isinstance(name, str) for name in entry) for entry in names)
    if not (named and isinstance(sections, dict) and all(isinstance(keys, dict) for keys in sections.values())):
        raise ResultError(f"{file} is damaged: the names of frames and lights, or the settings, are not as written")
    return document


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
