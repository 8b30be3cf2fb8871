"""The writing side of a result: one folder that grows frame by frame and can be read at any time.

``provenance.json`` (settings, fingerprints, versions, dates), ``frames.json`` (names), ``mesh.npz``, ``reference.npz``
(the reference images as pictures) and a file for each frame under ``solution/``. The provenance appears first and at
once, whoever starts first; all else follows from what it has fingerprints of, so that whoever comes later can complete
it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from rgbmidic.disk import remove_partial_files, write_arrays, write_errors, write_json
from rgbmidic.errors import InputError, ResultError
from rgbmidic.results.lock import ALL_FRAMES, FrameLock
from rgbmidic.results.provenance import (
    PROVENANCE,
    Origin,
    check_same,
    fingerprint,
    is_result,
    read_provenance,
    with_checksum,
)
from rgbmidic.results.records import FRAMES, FrameRecord, FrameTable, record_file, record_files, write_record
from rgbmidic.results.result import MESH, NAMES, REFERENCE, finish_result, read_reference, read_shared
from rgbmidic.typing import BoolArray

logger = logging.getLogger(__name__)


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

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> origin = Origin(nodes=[[0, 0], [9, 0], [0, 9]], elements=[[0, 1, 2]], names=["a.png"], lights=["red"])
    >>> with ResultStore.create(f"{mkdtemp()}/result", origin) as store:
    ...     store.write_frame(0, FrameRecord.failed("too dark", nodes=3, lights=1))
    >>> store.finished().tolist()
    [True]
    """

    path: Path
    frame_count: int
    sizes: Mapping[str, int]
    _lock: FrameLock
    _run: bytes

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

        Returns
        -------
        ResultStore

        Raises
        ------
        ResultError
            The folder is in use by another run, holds a result (and `overwrite` is False) or foreign files under a
            result's names, or cannot be written.
        """
        return cls._open_locked(Path(path), origin, ALL_FRAMES, overwrite=overwrite)

    @classmethod
    def resume(cls, path: Path | str, origin: Origin, *, frames: range | None = None) -> Self:
        """Go on with a result: `finished` reports which frames are there already.

        How it is read (``[scale]``, ``[setup]``, ``[probes]``) is from now on as `origin` states.

        Parameters
        ----------
        path
            The folder.
        origin
            As it was created.
        frames
            Those to be written here, consecutive; None: all.

        Returns
        -------
        ResultStore

        Raises
        ------
        ResultError
            There is no result, it is of another origin (the message names the difference), or some of the frames are
            being written by another run.
        """
        read_provenance(Path(path))
        return cls._open_locked(Path(path), origin, frames, restate=True)

    @classmethod
    def join(cls, path: Path | str, origin: Origin, *, frames: range | None = None) -> Self:
        """Start a result where there is none, else go on with it: for runs of parts of a test, in any order or at once.

        Parameters and errors are those of `resume`; foreign files are refused as in `create`.

        Parameters
        ----------
        path
            The folder; made where it does not exist.
        origin
            What all frames share.
        frames
            Frames that this run claims; None: all.

        Returns
        -------
        ResultStore
        """
        return cls._open_locked(Path(path), origin, frames)

    @classmethod
    def _open_locked(
        cls, path: Path, origin: Origin, frames: range | None, *, overwrite: bool | None = None, restate: bool = False
    ) -> Self:
        """Claim the frames and start the folder; `overwrite` None: whatever is there stays."""
        count, sizes = len(origin.names), {"node": len(origin.mesh["nodes"]), "light": len(origin.lights)}
        with write_errors(path):
            path.mkdir(parents=True, exist_ok=True)
        lock = FrameLock.acquire(path, range(count) if frames is None else frames)
        try:
            if overwrite is not None:
                _empty_folder(path, overwrite=overwrite)
            run = _write_shared_files(path, origin, restate=restate)
        except BaseException:
            lock.release()
            raise
        return cls(path=path, frame_count=count, sizes=sizes, _lock=lock, _run=run)

    def __enter__(self) -> Self:
        """Return the store."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the store."""
        self.release()

    def release(self) -> None:
        """Remove the claim, so that other runs can write these frames."""
        self._lock.release()

    def write_frame(self, index: int, record: FrameRecord) -> None:
        """Keep the result of frame `index`; in any order, and again, where the last one counts.

        Frames that others claim may be written too, where this run needs them: all runs give them the same values.

        Parameters
        ----------
        index
            Index of the frame.
        record
            All that is kept of it.

        Raises
        ------
        InputError
            There is no such frame, or the record has another number of nodes or lights.
        ResultError
            The disk is full or refuses, or another folder took the place of this one; the frames before are kept.
        """
        if not 0 <= index < self.frame_count:
            raise InputError(f"there is no frame {index} in a result of {self.frame_count} frames")
        if record.sizes != self.sizes:
            raise InputError(f"frame {index} has the sizes {record.sizes}, the result {self.sizes}")
        write_record(self.path / FRAMES, index, record, self._run, self._lock.check)

    def discard(self, frames: Collection[int]) -> None:
        """Discard frames that are to be measured again.

        Parameters
        ----------
        frames
            Indices of the frames.

        Raises
        ------
        ResultError
            The disk refuses.
        """
        if frames:
            self.reopen()  # which checks the claim
        for frame in frames:
            with write_errors(file := record_file(self.path / FRAMES, frame)):
                file.unlink(missing_ok=True)

    def finished(self) -> BoolArray:
        """Read which frames of the test are in the folder, whoever wrote them, shape (T,).

        Returns
        -------
        ndarray, shape (T,), bool
        """
        return self.table().finished

    def table(self) -> FrameTable:
        """Read the table of the frames that are in the folder now, whoever wrote them.

        Returns
        -------
        FrameTable
        """
        return FrameTable.load(self.path, self.sizes, self.frame_count, self._run)

    def reopen(self) -> None:
        """Take the date of its end out of the provenance, before frames are written."""
        self._lock.check()
        provenance = read_provenance(self.path)
        if provenance.pop("finished", None) is not None:
            provenance.pop("final_warnings", None)
            write_json(self.path / PROVENANCE, with_checksum(provenance))

    def finish(self, warnings: Sequence[str] = ()) -> None:
        """Release the store and call `finish_result`, when every frame is written.

        Parameters
        ----------
        warnings
            What only all frames together show, to be kept.
        """
        self._lock.check()
        self.release()
        finish_result(self.path, warnings)


def _empty_folder(path: Path, *, overwrite: bool) -> None:
    """Empty the folder of an old result, its provenance last; nothing else in it is touched."""
    if not is_result(path):
        return
    if not overwrite:
        raise ResultError(
            f"{path} already holds a result; choose another folder, overwrite it (`overwrite=True`), or go on with "
            "it (`resume=True`)"
        )
    with write_errors(path):
        old_files = (path / FRAMES).glob("[0-9]*.frames")  # of schema versions to 10
        frames = (Path(entry) for entry in record_files(path / FRAMES).values())
        for file in (*old_files, *frames, *(path / name for name in (REFERENCE, MESH, NAMES, PROVENANCE))):
            file.unlink(missing_ok=True)


def _write_shared_files(path: Path, origin: Origin, *, restate: bool) -> bytes:
    """Write what all frames share where it is missing or damaged; refuse a folder of another origin.

    With `restate` the provenance takes over the settings and the camera of `origin`, which state how a result is read.
    Returns the digest of the run from the provenance that is there, which may write the same number in another way.
    """
    foreign = [file for name in (MESH, REFERENCE, NAMES) if (file := path / name).exists()]
    foreign += map(Path, record_files(path / FRAMES).values())
    provenance = origin.provenance()
    if not (path / PROVENANCE).exists():  # looked at after the others: it is the first to appear
        if foreign:
            raise ResultError(f"{path} holds a {foreign[0].name} that is not of a result; give another folder")
        write_json(path / PROVENANCE, with_checksum(provenance), exclusive=True)
    stored = read_provenance(path)
    check_same(path, stored, provenance)
    reading_settings = {name: provenance.get(name) for name in ("settings", "camera")}
    if restate and reading_settings != {name: stored.get(name) for name in reading_settings}:
        write_json(path / PROVENANCE, with_checksum({**stored, **reading_settings}))
    if stored["machine"] != provenance["machine"]:
        text = "%s was begun with %s, and goes on with %s: the last bits of its frames may differ"
        logger.warning(text, path, stored["machine"], provenance["machine"])
    with write_errors(path):
        (path / FRAMES).mkdir(exist_ok=True)
        remove_partial_files(path, "*")
        remove_partial_files(path / FRAMES, "*")
    run, sizes = fingerprint(stored), {"light": len(origin.lights)}
    if not _is_readable(lambda: read_shared(path, stored)):
        write_json(path / NAMES, list(origin.names))
        write_arrays(path / MESH, origin.mesh)
    if origin.reference is not None and not _is_readable(lambda: read_reference(path, sizes, run)):
        images = np.asarray(origin.reference, dtype=np.float32)  # stretched to 8 bit between percentiles 1 and 99
        has_pixels = np.isfinite(images).any(axis=(1, 2), keepdims=True)
        low, high = np.nanpercentile(np.where(has_pixels, images, 0), [1, 99], axis=(1, 2), keepdims=True)
        stretched = 255 * (images - low) / np.maximum(high - low, 1e-6)
        pictures = np.clip(np.nan_to_num(stretched), 0, 255).astype(np.uint8)
        write_arrays(path / REFERENCE, {"reference": pictures, "run": np.frombuffer(run, dtype=np.uint8)})
    return run


def _is_readable(read_file: Callable[[], object]) -> bool:
    try:
        return read_file() is not None
    except ResultError:
        return False
