"""The writing side of a result: one folder that grows frame by frame and can be read at any time.

``provenance.json`` (settings, fingerprints, versions, dates), ``frames.json`` (names), ``mesh.npz``, ``reference.npz``
(the reference images as pictures) and the frames under ``solution/``. The provenance appears first and at once, whoever
starts first; all else follows from what it has fingerprints of, so that whoever comes later can complete it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError, ResultError
from rgbmidic.results.files import read_arrays, read_json, write_arrays, write_json, write_new_json, writing
from rgbmidic.results.layout import RecordLayout
from rgbmidic.results.lock import ALL_FRAMES, Claim
from rgbmidic.results.provenance import PROVENANCE, Origin, check_same, digest, now, read_provenance
from rgbmidic.results.quantities import SHARED
from rgbmidic.results.record import FrameRecord
from rgbmidic.results.shards import FrameTable, ShardWriter, shard_files
from rgbmidic.typing import AnyArray, BoolArray, FloatImage

__all__ = [
    "ResultStore",
    "check_complete",
    "finish_result",
    "load_frames",
    "read_mesh",
    "read_names",
    "read_reference",
]

_NAMES, _MESH, _REFERENCE, _FRAMES = "frames.json", "mesh.npz", "reference.npz", "solution"


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultStore:
    """A result folder, some frames of which are written here.

    ``with ResultStore.create(...) as store`` keeps others who would write these frames out until the end, however it
    comes. A copy sent to another process writes there too.

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
    _claim: Claim
    _writer: ShardWriter

    @classmethod
    def create(cls, path: Path | str, origin: Origin, *, overwrite: bool = False) -> Self:
        """Start a result, all frames of which may be written.

        Parameters
        ----------
        path
            Folder; made where it does not exist. Files in it that are not a result's are never touched.
        origin
            What all frames share.
        overwrite
            Whether a result that is already in the folder may be replaced.

        Raises
        ------
        ResultError
            The folder is in use by another run, holds a result (and `overwrite` is False) or foreign files under a
            result's names, or cannot be written.
        """
        store = cls._claimed(Path(path), origin, ALL_FRAMES)
        with _releasing(store):
            _make_room(store.path, overwrite=overwrite)
            _start(store.path, origin)
        return store

    @classmethod
    def resume(cls, path: Path | str, origin: Origin, *, frames: range | None = None) -> Self:
        """Go on with a result: `finished` tells what is there already.

        Parameters
        ----------
        path
            The folder.
        origin
            As it was created.
        frames
            Those to be written here, consecutive; None: all.

        Raises
        ------
        ResultError
            There is no result, it is of another origin (the message names the difference), or some of the frames are
            being written by another run.
        """
        read_provenance(Path(path))
        return cls.join(path, origin, frames=frames)

    @classmethod
    def join(cls, path: Path | str, origin: Origin, *, frames: range | None = None) -> Self:
        """Start a result where there is none, else go on with it: for several runs of parts, in any order or at once.

        Parameters and errors as `resume`; foreign files as `create`.
        """
        store = cls._claimed(Path(path), origin, range(len(origin.names)) if frames is None else frames)
        with _releasing(store):
            _start(store.path, origin)
        return store

    @classmethod
    def _claimed(cls, path: Path, origin: Origin, frames: range) -> Self:
        """The store with its claim, before anything is in the folder."""
        count, sizes = len(origin.names), {"node": len(origin.mesh["nodes"]), "light": len(origin.lights)}
        with writing(path):
            path.mkdir(parents=True, exist_ok=True)
        return cls(
            path=path,
            frame_count=count,
            sizes=sizes,
            _claim=Claim.take(path, frames),
            _writer=ShardWriter(path / _FRAMES, RecordLayout.of(sizes)),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Close what was written and let other runs write these frames."""
        try:
            self._writer.close()
        finally:
            self._claim.release()

    def write_frame(self, index: int, record: FrameRecord) -> None:
        """Keep the result of frame `index`; in any order, and again, where the last one counts.

        Frames that others claim may be written too, where this run needs them: all runs give them the same values.

        Raises
        ------
        InputError
            There is no such frame, or the record has another number of nodes or lights.
        ResultError
            The disk is full or refuses; the frames before are kept.
        """
        if not 0 <= index < self.frame_count:
            raise InputError(f"there is no frame {index} in a result of {self.frame_count} frames")
        if record.sizes != self.sizes:
            raise InputError(f"frame {index} has the sizes {record.sizes}, the result {self.sizes}")
        self._writer.append(index, record)

    def finished(self) -> BoolArray:
        """Which frames of the test are in the folder, whoever wrote them, shape (T,)."""
        return self.table().finished

    def table(self) -> FrameTable:
        """What is in the folder now, whoever wrote it; reads it."""
        return load_frames(self.path, self.sizes, self.frame_count)

    def finish(self) -> None:
        """`release` and `finish_result`: when every frame is written."""
        self.release()
        finish_result(self.path)


@contextmanager
def _releasing(store: ResultStore) -> Iterator[None]:
    """Release a store if the block fails."""
    try:
        yield
    except BaseException:
        store.release()
        raise


def finish_result(path: Path | str) -> None:
    """Put the date of its end into the provenance of a result.

    Raises
    ------
    ResultError
        The folder is no result, a frame is missing, or it cannot be written.
    """
    path = Path(path)
    provenance = read_provenance(path)
    names = read_names(path, provenance)
    sizes = {"node": len(read_mesh(path, provenance)["nodes"]), "light": len(provenance["lights"])}
    check_complete(path, names, load_frames(path, sizes, len(names)).finished)
    write_json(path / PROVENANCE, {**provenance, "finished": now()})


def check_complete(path: Path, names: tuple[str, ...], finished: BoolArray) -> None:
    """Raise a `ResultError` that says how many frames are missing, and the first of them."""
    if not finished.all():
        first, missing = int(finished.argmin()), int((~finished).sum())
        more = f" and {missing - 1} more" if missing > 1 else ""
        raise ResultError(
            f"{path} is incomplete: frame {first} ({names[first]}) of {len(names)} is missing{more}; was the run "
            "interrupted, or does it go on?"
        )


def load_frames(path: Path, sizes: Mapping[str, int], count: int) -> FrameTable:
    """What is in the folder of a result of `count` frames now."""
    return FrameTable.load(path / _FRAMES, RecordLayout.of(sizes), count)


def read_names(path: Path, provenance: Mapping[str, Any]) -> tuple[str, ...]:
    """The frames' names; a `ResultError` where they are not those of the provenance."""
    try:
        names = read_json(path / _NAMES)
    except FileNotFoundError:
        raise ResultError(f"{path / _NAMES} is missing: the result is incomplete") from None
    texts = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not texts or {"count": len(names), "sha256": digest(names)} != provenance["frames"]:
        raise ResultError(f"{path / _NAMES} is damaged: it does not hold the names of the frames")
    return tuple(names)


def read_mesh(path: Path, provenance: Mapping[str, Any]) -> dict[str, AnyArray]:
    """``nodes`` (N, 2) and ``elements`` (E, 3); a `ResultError` where they are not those of the provenance."""
    mesh = _read(path / _MESH, ["nodes", "elements"], {})
    if digest(mesh) != provenance["mesh"]:
        raise ResultError(f"{path / _MESH} is damaged or of another result")
    return mesh


def read_reference(path: Path, sizes: Mapping[str, int]) -> npt.NDArray[np.uint8] | None:
    """Reference image of each light as a picture, shape (k, H, W); None where none was kept."""
    if not (path / _REFERENCE).is_file():
        return None
    pictures: npt.NDArray[np.uint8] = _read(path / _REFERENCE, ["reference"], sizes)["reference"]
    return pictures


def _read(path: Path, names: Iterable[str], sizes: Mapping[str, int]) -> dict[str, AnyArray]:
    arrays = read_arrays(path, names)
    try:
        return {name: SHARED[name].convert(array, sizes) for name, array in arrays.items()}
    except (TypeError, ValueError) as error:
        raise ResultError(f"{path} is damaged: {error}") from None


def _pictures(images: FloatImage) -> npt.NDArray[np.uint8]:
    """Images in 8 bit, each stretched between its own extreme percent; 0 where unknown."""
    known = np.isfinite(images).any(axis=(1, 2), keepdims=True)
    low, high = np.nanpercentile(np.where(known, images, 0), [1, 99], axis=(1, 2), keepdims=True)
    scaled = 255 * (images - low) / np.maximum(high - low, 1e-6)
    pictures: npt.NDArray[np.uint8] = np.clip(np.nan_to_num(scaled), 0, 255).astype(np.uint8)
    return pictures


def _make_room(path: Path, *, overwrite: bool) -> None:
    """Empty the folder of an old result, its provenance last; nothing else in it is touched."""
    if not (path / PROVENANCE).exists():
        return
    read_provenance(path)  # refuses foreign files of this name
    if not overwrite:
        raise ResultError(
            f"{path} already holds a result; choose another folder, overwrite it (overwrite=True, --overwrite), or go "
            "on with it (--resume)"
        )
    with writing(path):
        for file in (*shard_files(path / _FRAMES), *(path / name for name in (_REFERENCE, _MESH, _NAMES, PROVENANCE))):
            file.unlink(missing_ok=True)


def _start(path: Path, origin: Origin) -> None:
    """Let the folder hold what all frames share; refuse one of another origin."""
    foreign = [file for name in (_MESH, _REFERENCE, _NAMES) if (file := path / name).exists()]
    foreign += shard_files(path / _FRAMES)
    provenance = origin.provenance()
    if not (path / PROVENANCE).exists():  # looked at after the others: it is the first to appear
        if foreign:
            raise ResultError(f"{path} holds a {foreign[0].name} that is not of a result; give another folder")
        write_new_json(path / PROVENANCE, provenance)
    check_same(path, read_provenance(path), provenance)
    with writing(path):
        (path / _FRAMES).mkdir(exist_ok=True)
    if not (path / _NAMES).exists():
        write_json(path / _NAMES, list(origin.names))
    if not (path / _MESH).exists():
        write_arrays(path / _MESH, origin.mesh)
    if origin.reference is not None and not (path / _REFERENCE).exists():
        write_arrays(path / _REFERENCE, {"reference": _pictures(np.asarray(origin.reference, dtype=np.float32))})
