"""The result of a test, read frame by frame or quantity by quantity, each when it is asked for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError, ResultError
from rgbmidic.results.quantities import QUANTITIES
from rgbmidic.results.record import FrameRecord
from rgbmidic.results.store import ResultStore, read_mesh, read_provenance
from rgbmidic.typing import AnyArray, FloatArray

__all__ = ["Result"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Result:
    """The reading side of a result folder.

    Every quantity of `rgbmidic.results.QUANTITIES` whose shape is the same in all frames is an attribute with the
    frames as first axis, such as ``result.u`` of shape (T, N): read when it is first asked for, then kept. `each` gives
    any quantity one frame after the other and keeps nothing, `frame` everything of one frame.

    Attributes
    ----------
    store
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
        Settings, versions and dates, as in ``provenance.json``.
    """

    store: ResultStore
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
        provenance, mesh = read_provenance(path), read_mesh(path)
        names, lights = tuple(provenance["frames"]), tuple(provenance["lights"])
        sizes = {"node": len(mesh["nodes"]), "light": len(lights)}
        store = ResultStore(path=path, frame_count=len(names), sizes=sizes)
        written = store.written()
        if written < len(names) and not (partial and written):
            raise ResultError(
                f"{path} is incomplete: frame {written} ({names[written]}) of {len(names)} is missing; was the run "
                "interrupted?"
            )
        return cls(store=store, **mesh, names=names[:written], lights=lights, provenance=provenance)

    def __len__(self) -> int:
        """Number of frames T."""
        return len(self.names)

    @property
    def path(self) -> Path:
        """The folder."""
        return self.store.path

    @property
    def deformed(self) -> tuple[int, ...]:
        """Indices of the frames that are no reference."""
        references = self.setting("frames", "reference", [0])
        return tuple(index for index in range(len(self)) if index not in references)

    def setting(self, section: str, key: str, default: Any = None) -> Any:
        """A setting of the run, as TEST.toml names it; `default` where it was not kept."""
        return self.provenance.get("settings", {}).get(section, {}).get(key, default)

    def frame(self, index: int) -> FrameRecord:
        """Everything that is kept of one frame.

        Raises
        ------
        ResultError
            The frame is missing or damaged, or does not fit the mesh.
        """
        if not 0 <= index < len(self):
            raise InputError(f"there is no frame {index} in a result of {len(self)} frames (0 to {len(self) - 1})")
        return self.store.read_frame(index)

    def each(self, name: str, frames: Iterable[int] | None = None) -> Iterator[Any]:
        """One quantity, frame after frame (None: all): an array, or a plain number or text."""
        chosen = range(len(self)) if frames is None else frames
        return (self.store.read(index, [name])[name] for index in chosen)

    def stack(self, name: str) -> AnyArray:
        """One quantity of all frames, the frames as first axis."""
        one = QUANTITIES[name].unmeasured(self.store.sizes)
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
    def mean_share(self) -> FloatArray:
        """Mean of `light_share` over the measured nodes, shape (T, k); NaN where none is measured."""
        shares = np.full((len(self), len(self.lights)), np.nan)
        for row, share, status in zip(shares, self.each("light_share"), self.each("node_status"), strict=True):
            if (measured := status == 0).any():
                row[:] = share[measured].mean(axis=0)
        return shares

    @cached_property
    def reference(self) -> npt.NDArray[np.uint8] | None:
        """Reference image of each light as a picture, shape (k, H, W); None where none was kept."""
        return self.store.read_reference()
