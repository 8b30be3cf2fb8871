"""The result in three dimensions as histories, profiles, maps, figures, movies and reports read results.

They read the left camera's picture, records and settings from its result, on the nodes that were carried over; the
displacement, its uncertainty and the strain are those of the surface in space.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from rgbmidic.results import QUANTITIES, Result
from rgbmidic.results.records import FrameTable
from rgbmidic.settings import ScaleSettings
from rgbmidic.tools.stereo.result import StereoResult
from rgbmidic.tools.stereo.surface_in_units import SurfaceInUnits
from rgbmidic.typing import IntArray

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CarriedTable(FrameTable):
    """The left camera's records on the nodes that were carried over.

    Attributes
    ----------
    nodes : ndarray, shape (N,), int
        Indices of these in the left result.
    stereo
        The result in three dimensions. A node, and a frame, is as the worse one of both cameras.
    """

    nodes: IntArray
    stereo: StereoResult

    def read(self, frame: int, names: Iterable[str] = QUANTITIES) -> dict[str, Any]:
        """Read some quantities of a frame, as `FrameTable.read`."""
        values = FrameTable.read(self, frame, names)
        if self.finished[frame]:
            of_nodes = [name for name in values if "node" in str(QUANTITIES[name].axes[:1])]
            values |= {name: values[name][self.nodes] for name in of_nodes if len(values[name])}
        if {"status", "node_status"} & values.keys():
            space = self.stereo.frame(["status", "left_status", "right_status"], frame)
            node_status = np.maximum(space["left_status"], space["right_status"])
            statuses = {"status": int(space["status"]), "node_status": node_status}
            values |= {name: statuses[name] for name in statuses.keys() & values.keys()}
        return values


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class LeftResult(Result):
    """The left camera's result of a stereo test; `in_units` is in three dimensions.

    Attributes
    ----------
    stereo
        The result in three dimensions.
    left
        The left camera's whole result.
    """

    stereo: StereoResult
    left: Result

    @classmethod
    def of(cls, stereo: StereoResult) -> Self:
        """Open the left result of a stereo test.

        Parameters
        ----------
        stereo
            The result in three dimensions.

        Returns
        -------
        LeftResult

        Raises
        ------
        ResultError
            It is not where it was, or is damaged.
        """
        left, nodes = stereo.camera("left"), stereo["left_node"]
        shared = {entry.name: getattr(left, entry.name) for entry in fields(left)}
        shared |= dict.fromkeys(("node_number", "element_number", "node_mm"))
        table = {entry.name: getattr(left.table, entry.name) for entry in fields(left.table)}
        table["sizes"] = {**left.table.sizes, "node": len(nodes)}
        shared |= {"path": stereo.path.parent, "nodes": left.nodes[nodes], "elements": stereo.elements}
        return cls(**shared | {"table": CarriedTable(**table, nodes=nodes, stereo=stereo)}, stereo=stereo, left=left)

    def in_units(self, scale: ScaleSettings | None = None) -> SurfaceInUnits:
        """Return the surface in space.

        Parameters
        ----------
        scale
            It states the times in place of the ``[scale]`` of the left test; lengths are those of the cameras.

        Returns
        -------
        SurfaceInUnits
        """
        return SurfaceInUnits.of(self, scale)

    def to_xarray(self, scale: ScaleSettings | None = None) -> xr.Dataset:
        """Return the result in three dimensions, see `StereoResult.to_xarray`.

        Parameters
        ----------
        scale
            Not used: lengths are those of the cameras.

        Returns
        -------
        xarray.Dataset
        """
        return self.stereo.to_xarray()

    def refresh(self) -> Self:
        """Return the result: it is complete.

        Returns
        -------
        LeftResult
        """
        return self

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about cameras and match, then those of the left test."""
        return (*self.stereo.warnings, *self.left.warnings)

    @property
    def reference(self) -> npt.NDArray[np.uint8] | None:  # cached there
        """Reference image of each light in the left camera, shape (k, H, W); None where none was kept."""
        return self.left.reference


def open_left(path: Path | str) -> LeftResult:
    """Open a stereo result as histories, maps and reports read it.

    Parameters
    ----------
    path
        Its folder, or the HDF5 file.

    Returns
    -------
    LeftResult

    Raises
    ------
    ResultError
        As of `StereoResult.open` and `LeftResult.of`.
    """
    return LeftResult.of(StereoResult.open(path))
