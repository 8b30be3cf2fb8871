"""The result of a test, read frame by frame or quantity by quantity, each when it is asked for."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError, ResultError
from rgbmidic.results.provenance import fingerprint, read_provenance
from rgbmidic.results.quantities import QUANTITIES, FrameRecord
from rgbmidic.results.shards import FrameTable
from rgbmidic.results.store import check_complete, listed, load_frames, read_mesh, read_names, read_reference
from rgbmidic.typing import AnyArray, BoolArray, FloatArray

__all__ = ["Result"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class Result:
    """The reading side of a result folder, as far as it has come when it is opened.

    Every quantity of `rgbmidic.results.QUANTITIES` whose shape is the same in all frames is an attribute with the
    frames as first axis, such as ``result.u`` of shape (T, N): read when it is first asked for, then kept, so that it
    takes its T x N numbers of memory. `each` gives any quantity one frame after the other and keeps nothing, `frame`
    everything of one frame. A frame that is not measured yet is blank, with that as its reason.

    Attributes
    ----------
    path
        The folder.
    table
        Where each frame lies.
    nodes : ndarray, shape (N, 2), float64
        Positions (x, y) in px on the reference image.
    elements : ndarray, shape (E, 3), int32
        Node indices.
    names : tuple of str, length T
        The frames' names.
    lights : tuple of str, length k
        The lights' names.
    provenance
        Settings, versions and dates, as in ``provenance.json``.
    """

    path: Path
    table: FrameTable
    nodes: FloatArray
    elements: npt.NDArray[np.int32]
    names: tuple[str, ...]
    lights: tuple[str, ...]
    provenance: Mapping[str, Any]

    @classmethod
    def open(cls, path: Path | str, *, partial: bool = False, check: bool = True) -> Self:
        """Open a result folder.

        Parameters
        ----------
        path
            The folder.
        partial
            Whether frames may be missing, because a run goes on, was interrupted, or its records are damaged.
        check
            Whether a `partial` result is read once at opening, so that damaged frames are blank with that reason, and
            named in a warning; else a damaged frame is an error when it is read.

        Raises
        ------
        ResultError
            The folder is not a result, is damaged, or is incomplete (unless `partial`).
        """
        path = Path(path)
        provenance = read_provenance(path)
        names, lights = read_names(path, provenance), tuple(provenance["lights"])
        mesh = read_mesh(path, provenance)
        sizes, ended = {"node": len(mesh["nodes"]), "light": len(lights)}, "finished" in provenance
        table = load_frames(path, sizes, len(names), fingerprint(provenance))
        if not partial:
            check_complete(path, names, table, ended=ended)
        elif check:
            table = table.without_damaged(ended=ended)
            if (lost := np.flatnonzero(table.damaged).tolist()) or table.gaps:
                files = "".join(f"; {file} is damaged between its records" for file in table.gaps)
                logger.warning("%s is damaged: frames lost: %s%s", path, listed(lost, names) or "unknown", files)
        return cls(path=path, table=table, **mesh, names=names, lights=lights, provenance=provenance)

    def refresh(self) -> Self:
        """The result as it is now, with the frames that were added since.

        Raises
        ------
        ResultError
            It is damaged, or another result took its place.
        """
        provenance = read_provenance(self.path)
        if {**provenance, "finished": ""} != {**self.provenance, "finished": ""}:
            raise ResultError(f"{self.path} now holds another result; open it again")
        table = load_frames(self.path, self.table.layout.sizes, len(self), fingerprint(provenance))
        if self.table.damaged.any():
            table = table.without_damaged(ended="finished" in provenance)
        return replace(self, table=table, provenance=provenance)

    def __len__(self) -> int:
        """Number of frames T."""
        return len(self.names)

    @property
    def finished(self) -> BoolArray:
        """Which frames are measured, failed ones included, shape (T,)."""
        return self.table.finished

    @cached_property
    def deformed(self) -> tuple[int, ...]:
        """Indices of the frames that are no reference."""
        references = set(self.provenance["references"])
        return tuple(index for index in range(len(self)) if index not in references)

    def setting(self, section: str, key: str, default: Any = None) -> Any:
        """A setting of the run, as TEST.toml names it; `default` where it was not kept."""
        return self.provenance.get("settings", {}).get(section, {}).get(key, default)

    def frame(self, index: int) -> FrameRecord:
        """Everything that is kept of one frame.

        Raises
        ------
        ResultError
            The frame is damaged, or does not fit the mesh.
        """
        if not 0 <= index < len(self):
            raise InputError(f"there is no frame {index} in a result of {len(self)} frames (0 to {len(self) - 1})")
        return self.table.read(index)

    def each(self, name: str, frames: Iterable[int] | None = None) -> Iterator[Any]:
        """One quantity, frame after frame (None: all): an array, or a plain number or text."""
        chosen = range(len(self)) if frames is None else frames
        return (values[name] for values in self.table.each([name], chosen))

    def stack(self, name: str) -> AnyArray:
        """One quantity of all frames, the frames as first axis; takes the memory of all of them."""
        one = QUANTITIES[name].unmeasured(self.table.layout.sizes)
        stacked = np.empty((len(self), *one.shape), dtype=one.dtype)
        for index, value in enumerate(self.each(name)):
            stacked[index] = value
        return stacked

    def __getattr__(self, name: str) -> AnyArray:
        if name not in QUANTITIES or not QUANTITIES[name].stackable:
            raise AttributeError(f"a result has no attribute {name!r}")
        stacked = self.__dict__[name] = self.stack(name)
        return stacked

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *(name for name, quantity in QUANTITIES.items() if quantity.stackable)]

    @property
    def strain(self) -> FloatArray:
        """Small strain (exx, eyy, exy), shape (T, N, 3)."""
        return np.stack([self.exx, self.eyy, self.exy], axis=-1)

    @property
    def strain_std(self) -> FloatArray:
        """Standard uncertainty of `strain`, shape (T, N, 3)."""
        return np.stack([self.exx_std, self.eyy_std, self.exy_std], axis=-1)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why each frame failed or did not converge, length T; empty texts otherwise."""
        return tuple(self.each("reason"))

    @property
    def inputs(self) -> dict[str, str]:
        """Path and SHA-256 of every file that the frames were read from."""
        return {path: digest for pairs in self.each("inputs") for path, digest in pairs.tolist()}

    @cached_property
    def mean_light_fraction(self) -> FloatArray:
        """Mean of `light_fraction` over the measured nodes, shape (T, k); NaN where none is measured."""
        shares = np.full((len(self), len(self.lights)), np.nan)
        for row, values in zip(
            shares, self.table.each(["light_fraction", "node_status"], range(len(self))), strict=True
        ):
            if (measured := values["node_status"] == 0).any():
                row[:] = values["light_fraction"][measured].mean(axis=0, dtype=np.float64)
        return shares

    @cached_property
    def reference(self) -> npt.NDArray[np.uint8] | None:
        """Reference image of each light as a picture, shape (k, H, W); None where none was kept.

        Of a frame of which only a part is read it shows that part, which begins at `reference_origin`.
        """
        return read_reference(self.path, self.table.layout.sizes, fingerprint(self.provenance))

    @property
    def reference_origin(self) -> tuple[int, int]:
        """Column and row of the frame at which `reference` begins."""
        x, y = self.provenance.get("reference_origin") or (0, 0)
        return x, y

    @property
    def frame_shape(self) -> tuple[int, int] | None:
        """Rows and columns of the frames; None where neither the provenance nor a reference image tells them."""
        noted = self.provenance.get("frame_shape")
        if noted is None and self.reference is not None:
            noted = self.reference.shape[1:]
        return noted and (noted[0], noted[1])
