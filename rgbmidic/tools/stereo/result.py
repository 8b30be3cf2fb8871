"""The result in three dimensions, read quantity by quantity from its file."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, Self

import numpy as np

from rgbmidic.disk import write_table
from rgbmidic.errors import InputError, ResultError, import_optional
from rgbmidic.field import column
from rgbmidic.results import Result, ResultQuantity
from rgbmidic.text import format_times
from rgbmidic.tools.stereo.stereo_file import QUANTITIES, SCHEMA, SHARED, STEREO_FILE, VERSION, dimensions
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoResult:
    """A result in three dimensions, read quantity by quantity, each when it is asked for.

    Attributes
    ----------
    path
        The HDF5 file.
    attributes
        Attributes of the file: axes, gauge, measure, uncertainty of the calibration.
    names
        Name of each frame.
    elements : ndarray, shape (E, 3)
        Nodes of the triangles.
    time : ndarray, shape (T,)
        s, or the index of the frame where times are not known.
    has_times
        Whether they are.
    """

    path: Path
    attributes: Mapping[str, Any]
    names: tuple[str, ...]
    elements: AnyArray
    time: FloatArray
    has_times: bool

    @classmethod
    def open(cls, path: Path | str) -> Self:
        """Open the result that ``rgbmidic stereo`` wrote.

        Parameters
        ----------
        path
            Its folder, or the HDF5 file.

        Returns
        -------
        StereoResult

        Raises
        ------
        ResultError
            There is none, or it is damaged or of another version.
        """
        import h5py

        file = Path(path)
        file = file / STEREO_FILE if file.is_dir() else file
        if not file.is_file():
            raise ResultError(f"{path} is no stereo result: it has no {STEREO_FILE} (rgbmidic stereo writes it)")
        try:
            with h5py.File(file, "r") as content:
                attributes = dict(content.attrs)
                if (attributes.get("schema"), int(attributes.get("schema_version", 0))) != (SCHEMA, VERSION):
                    raise ResultError(f"{file} is no stereo result of this version of rgbmidic")
                names = tuple(content["name"].asstr()[...].tolist())
                return cls(
                    path=file,
                    attributes=attributes,
                    names=names,
                    elements=content["elements"][...],
                    time=content["time"][...],
                    has_times=content["time"].attrs["units"] == "s",
                )
        except (OSError, KeyError, ValueError, TypeError) as error:
            if isinstance(error, ResultError):
                raise
            raise ResultError(f"{file} is damaged: {error}") from None

    def __len__(self) -> int:
        """Return the number of frames T."""
        return len(self.names)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about calibration, match and frames."""
        return tuple(json.loads(self.attributes["warnings"]))

    def __getitem__(self, name: str) -> AnyArray:
        """Read a quantity of `QUANTITIES`: (N, ...) of the shape, (T, N, ...) of frames; NaN where there is no data."""
        if name not in QUANTITIES:
            raise InputError(f"a stereo result has no {name!r}; it has {', '.join(QUANTITIES)}")
        return self._read([name], ...)[name]

    def frame(self, names: Iterable[str], index: int) -> dict[str, AnyArray]:
        """Read quantities of one frame.

        Parameters
        ----------
        names
            Their names, those of `QUANTITIES` that frames have.
        index
            Index of the frame.

        Returns
        -------
        dict of str to ndarray

        Raises
        ------
        InputError
            There is no such frame.
        ResultError
            The file is damaged.
        """
        if not 0 <= index < len(self):
            raise InputError(f"there is no frame {index} in a result of {len(self)} frames (0 to {len(self) - 1})")
        return self._read(names, index)

    def _read(self, names: Iterable[str], index: Any) -> dict[str, AnyArray]:
        import h5py

        try:
            with h5py.File(self.path, "r") as content:
                return {name: np.asarray(content[name][index]) for name in names}
        except (OSError, KeyError) as error:
            raise ResultError(f"{self.path} is damaged: {error}") from None

    def at(self, name: str, index: int) -> AnyArray:
        """Read a quantity of one frame, or that of the undeformed surface.

        Parameters
        ----------
        name
            Name of the quantity.
        index
            Index of the frame.

        Returns
        -------
        ndarray
        """
        return self[name] if QUANTITIES[name] in SHARED else self.frame([name], index)[name]

    def camera(self, side: Literal["left", "right"]) -> Result:
        """Open the ordinary result of a camera.

        Parameters
        ----------
        side
            Which.

        Returns
        -------
        Result

        Raises
        ------
        ResultError
            It is not where it was, or is damaged.
        """
        folder = self.path.parent / str(self.attributes[side])
        if not folder.is_dir():
            raise ResultError(f"the result of the {side} camera, {folder}, is not there any more; {self.path} needs it")
        return Result.open(folder)

    def to_xarray(self) -> xr.Dataset:
        """Return all quantities with named dimensions, coordinates and units.

        Returns
        -------
        xarray.Dataset
            Dimensions `time`, `node`, `row`, `column`; coordinates x, y, z of the nodes and the frames' times.

        Raises
        ------
        InputError
            The package xarray is not installed (extra ``xarray``).
        """
        xarray = import_optional("xarray", "xarray")
        variables = {}
        for name, entry in QUANTITIES.items():
            variables[name] = (dimensions(entry), self[name], entry.attributes)
        coordinates = {"time": self.time, "name": ("time", list(self.names))}
        dataset: xr.Dataset = xarray.Dataset(variables, coordinates, dict(self.attributes))
        return dataset.set_coords(["x", "y", "z"])

    def export(self, to: str, file: BinaryIO) -> None:
        """Write all frames for another program.

        Parameters
        ----------
        to
            ``"hdf5"``: the file as it is, for ParaView, MATLAB and xarray. ``"csv"``: a row per frame and node, with
            the quantities that are one number per node, their units in the names of the columns. ``"npz"``: every
            quantity of `QUANTITIES`, ``elements``, ``names`` and ``time``, frames first.
        file
            Open file.
        """
        if to == "hdf5":
            with self.path.open("rb") as source:
                shutil.copyfileobj(source, file)
        elif to == "npz":
            arrays: dict[str, Any] = {"elements": self.elements, "names": np.array(self.names), "time": self.time}
            np.savez(file, **arrays | {name: self[name] for name in QUANTITIES})
        else:
            entries = [entry for entry in QUANTITIES.values() if entry.axes == ("node",)]
            time = ["time_s"] if self.has_times else []
            head = ["frame", "number", "name", *time, "status", "node"]
            write_table(file, [*head, *(column(entry.name, entry.unit) for entry in entries)], self._rows(entries))

    def _rows(self, entries: Sequence[ResultQuantity]) -> Iterator[list[object]]:
        names, shared = [entry.name for entry in entries], {entry.name for entry in SHARED}
        same = {name: self[name] for name in names if name in shared}
        for frame, (name, seconds) in enumerate(zip(self.names, format_times(self.time.tolist()), strict=True)):
            values = self.frame(["number", "status", *(one for one in names if one not in shared)], frame) | same
            cells = [frame, int(values["number"]), name, *([seconds] if self.has_times else [])]
            columns = zip(*(values[one].tolist() for one in names), strict=True)
            yield from ([*cells, int(values["status"]), node, *numbers] for node, numbers in enumerate(columns))
