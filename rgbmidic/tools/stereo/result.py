"""The result in three dimensions, read quantity by quantity from its file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from rgbmidic.errors import InputError, ResultError, import_optional
from rgbmidic.field import column
from rgbmidic.results.files import check_file, write_complete, write_errors, write_table
from rgbmidic.tools.stereo.stereo_file import QUANTITIES, SCHEMA, SHARED, STEREO_FILE, VERSION, dimensions
from rgbmidic.typing import AnyArray, FloatArray

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure


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
        s, or the number of the frame where times are not known.
    """

    path: Path
    attributes: Mapping[str, Any]
    names: tuple[str, ...]
    elements: AnyArray
    time: FloatArray

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
        import h5py

        if name not in QUANTITIES:
            raise InputError(f"a stereo result has no {name!r}; it has {', '.join(QUANTITIES)}")
        try:
            with h5py.File(self.path, "r") as content:
                return np.asarray(content[name][...])
        except (OSError, KeyError) as error:
            raise ResultError(f"{self.path} is damaged: {error}") from None

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

    def write_csv(self, folder: Path | str, *, overwrite: bool = False) -> None:
        """Write a CSV file for each frame: a row per node, names of the columns with their units.

        Parameters
        ----------
        folder
            Folder of the files ``000000.csv`` and so on; it is made.
        overwrite
            Whether existing files may be replaced.

        Raises
        ------
        ResultError
            A file exists or cannot be written.
        """
        folder = Path(folder)
        entries = [entry for entry in QUANTITIES.values() if entry.axes == ("node",)]
        with write_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        head = ["node", *(column(entry.name, entry.unit) for entry in entries)]
        arrays = {entry.name: self[entry.name] for entry in entries}
        for frame in range(len(self)):
            columns = [arrays[entry.name] if entry in SHARED else arrays[entry.name][frame] for entry in entries]
            rows = ([node, *values] for node, values in enumerate(zip(*(c.tolist() for c in columns), strict=True)))
            file = folder / f"{frame:06d}.csv"
            check_file(file, overwrite=overwrite)
            write_complete(file, lambda stream, rows=rows: write_table(stream, head, rows))  # type: ignore[misc]

    def figure(self, name: str, frame: int = -1) -> Figure:
        """Draw a quantity over the left reference.

        Parameters
        ----------
        name
            Quantity with one number a node.
        frame
            Index of the frame; from the end where negative.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        InputError
            There is no such quantity with one number a node, or no such frame.
        """
        from matplotlib.figure import Figure
        from matplotlib.tri import Triangulation

        if name not in QUANTITIES or QUANTITIES[name].axes != ("node",):
            allowed = [entry.name for entry in QUANTITIES.values() if entry.axes == ("node",)]
            raise InputError(f"no map of {name!r}; there are {', '.join(allowed)}")
        if not -len(self) <= frame < len(self):
            raise InputError(f"there is no frame {frame} in a result of {len(self)} frames")
        entry = QUANTITIES[name]
        values = np.asarray(self[name] if entry in SHARED else self[name][frame], dtype=np.float64)
        figure = Figure(layout="constrained")
        axes = figure.subplots()
        x, y, triangles = self["x_left"], self["y_left"], self.elements
        is_shown = np.isfinite(values)[triangles].all(axis=1)
        if is_shown.any():
            grid = Triangulation(x, y, triangles[is_shown])
            picture = axes.tripcolor(grid, np.nan_to_num(values), shading="gouraud")
            figure.colorbar(picture, label=entry.label)
        axes.set(aspect="equal", xlabel="x, left reference (px)", ylabel="y, left reference (px)")
        axes.set_title(entry.description if entry in SHARED else f"{entry.description}: {self.names[frame]}")
        axes.invert_yaxis()
        return figure
