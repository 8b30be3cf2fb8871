"""The result of a test, read frame by frame or quantity by quantity, each when it is asked for."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar, cast

import numpy as np
import numpy.typing as npt

from rgbmidic.arguments import checked
from rgbmidic.disk import read_arrays, read_json, write_json
from rgbmidic.errors import InputError, ResultError, import_optional
from rgbmidic.extensions import RESULTS
from rgbmidic.renamed import state_new_names
from rgbmidic.results.provenance import (
    PROVENANCE,
    RESTORE_REMEDY,
    current_time,
    digest,
    find_marker,
    fingerprint,
    read_provenance,
    with_checksum,
)
from rgbmidic.results.quantities import MESH_DOCUMENT, MESH_LABELS, NUMBERS, QUANTITIES, SHARED
from rgbmidic.results.records import FrameRecord, FrameTable, QuantityAttributes
from rgbmidic.results.warnings import join_frame_warnings
from rgbmidic.settings import ScaleSettings, read_section
from rgbmidic.settings.schema import section_types
from rgbmidic.text import HtmlRepr
from rgbmidic.typing import AnyArray, BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr

    from rgbmidic.results.result_in_units import ResultInUnits

S = TypeVar("S")

logger = logging.getLogger(__name__)

NAMES, MESH, REFERENCE = "frames.json", "mesh.npz", "reference.npz"
"""Files with what all frames share."""


class Portable:
    """A dataclass that goes to another process without what it has read or made, which that reads for itself."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields alone."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


@state_new_names
@dataclass(frozen=True, kw_only=True, eq=False)
class Result(Portable, QuantityAttributes, HtmlRepr):
    """The result of a test, for post-processing.

    `Result.open` opens a result folder, also during a run, and reads only the mesh and which frames there are. The
    quantities are those of `rgbmidic.results.QUANTITIES` (table in docs: conventions). There are four ways to read
    them:

    - ``result.u``, ``result.misfit`` and so on: one quantity of all T frames as an array with the frames as first
      axis, such as (T, N) for N nodes. It is read at its first use and then kept in memory. Only quantities whose
      shape is the same in all frames are attributes.
    - `iterate`: any quantity frame by frame, for results larger than the memory.
    - `frame`: all quantities of one frame, a `FrameRecord`.
    - `to_xarray`: all quantities with named dimensions, coordinates and units, read frame by frame when used.

    Displacements are in px on the reference image (x to the right, y down), at the nodes; NaN where a node has no data.
    Use `rgbmidic.results.histories.read_histories` for probes and `rgbmidic.fields` for arrays to obtain millimetres,
    seconds, finite strain and rates. A frame that is not measured yet is blank, with that reason.

    Attributes
    ----------
    path
        The folder.
    table
        Which frames there are.
    nodes : ndarray, shape (N, 2), float64
        Positions (x, y) in px on the reference image.
    elements : ndarray, shape (E, 3), int32
        Node indices.
    names : tuple of str, length T
        The frames' names.
    lights : tuple of str, length k
        The lights' names.
    node_number, element_number, node_mm : ndarray, shape (N,), (E,), (N, 2), or None
        For a mesh of ``mesh.file``: numbers of nodes and elements in the file, and positions (x, y) in mm in its axes.
    provenance
        Settings, versions and dates, as in ``provenance.json``.

    Examples
    --------
    >>> result = Result.open("my_result")
    >>> converged = result.status == 0
    >>> result.u[converged].shape == (converged.sum(), len(result.nodes))
    True
    """

    path: Path
    table: FrameTable
    nodes: FloatArray
    elements: npt.NDArray[np.int32]
    names: tuple[str, ...]
    lights: tuple[str, ...]
    provenance: Mapping[str, Any]
    node_number: IntArray | None = None
    element_number: IntArray | None = None
    node_mm: FloatArray | None = None

    @classmethod
    @checked
    def open(cls, path: Path | str, *, partial: bool = False, check: bool = True) -> Self:
        """Open a result folder, also one of a tool (`rgbmidic.extensions.RESULTS`), such as that of two cameras.

        Parameters
        ----------
        path
            The folder.
        partial
            Whether frames may be missing, because a run goes on, was interrupted, or its records are damaged.
        check
            Whether a `partial` result is read once at opening, so that damaged frames are blank with that reason, and
            named in a warning; else a damaged frame is an error when it is read.

        Returns
        -------
        Result

        Raises
        ------
        ResultError
            The folder is not a result, is damaged, or is incomplete (unless `partial`).
        """
        path = Path(path)
        if (marker := find_marker(path)) and (load := RESULTS.get(marker.name)):
            return cast("Self", load()(path))
        provenance = read_provenance(path)
        shared, lights = read_shared(path, provenance), tuple(provenance["lights"])
        sizes = {"node": len(shared["nodes"]), "light": len(lights)}
        table = FrameTable.load(path, sizes, len(shared["names"]), fingerprint(provenance))
        result = cls(path=path, table=table, lights=lights, provenance=provenance, **shared)
        if not partial:
            result._check_complete()
        elif check:
            result = result.without_damaged()
            if damaged_frames := np.flatnonzero(result.table.damaged).tolist():
                logger.warning("%s is damaged: frames lost: %s", path, list_frames(damaged_frames, result.names))
        return result

    def refresh(self) -> Self:
        """Open the result again, with the frames that were added since.

        Returns
        -------
        Result

        Raises
        ------
        ResultError
            It is damaged, or another result took its place.
        """
        provenance = read_provenance(self.path)
        ended = {"finished": "", "final_warnings": []}
        if {**provenance, **ended} != {**self.provenance, **ended}:
            raise ResultError(f"{self.path} now holds another result; open it again")
        table = FrameTable.load(self.path, self.table.sizes, len(self), fingerprint(provenance))
        refreshed = replace(self, table=table, provenance=provenance)
        return refreshed.without_damaged() if self.table.damaged.any() else refreshed

    def without_damaged(self) -> Self:
        """Read every record once and return the result without the damaged ones; once ended it misses none.

        Returns
        -------
        Result
        """
        return replace(self, table=self.table.without_damaged(ended="finished" in self.provenance))

    def _check_complete(self) -> None:
        """Raise a `ResultError` that names the frames that are missing, or lost to damage where all were there once."""
        missing, path, count = np.flatnonzero(~self.finished).tolist(), self.path, len(self)
        if not missing:
            return
        frames = list_frames(missing, self.names)
        if "finished" in self.provenance or self.table.damaged.any():
            raise ResultError(
                f"{path} is damaged: of {count} frames are lost {frames}; `rgbmidic run TEST.toml --out {path} "
                "--resume` measures them again, `partial=True` reads the rest"
            )
        raise ResultError(
            f"{path} is incomplete: of {count} frames are missing {frames}; was the run interrupted, or does it go on?"
        )

    def __repr__(self) -> str:
        """Summarise the result in a few lines; values are not read."""
        done, lights = int(self.finished.sum()), ", ".join(self.lights)
        lines = [
            f"<rgbmidic.Result {self.path}>",
            f"frames: {len(self)}, {done} measured" if done < len(self) else f"frames: {len(self)}",
            f"mesh:   {len(self.nodes)} nodes, {len(self.elements)} elements",
            f"lights: {lights}",
            "read:   result.u (T, N), .u_std, .nodal_strain, .misfit, ...; .frame(i), .iterate(name), .to_xarray()",
        ]
        return "\n".join(lines)

    def __len__(self) -> int:
        """Return the number of frames T."""
        return len(self.names)

    @property
    def finished(self) -> BoolArray:
        """Mask of the frames that are measured, failed ones included, shape (T,)."""
        return self.table.finished

    @cached_property
    def deformed(self) -> tuple[int, ...]:
        """Indices of the frames that are no reference."""
        return tuple(sorted({*range(len(self))} - {*self.provenance["references"]}))

    def section(self, section_type: type[S]) -> S:
        """Return a section of the settings that the result was measured with; its defaults where none were kept.

        Parameters
        ----------
        section_type
            Class of the section, such as `rgbmidic.settings.ScaleSettings`.

        Returns
        -------
        object of `section_type`

        Raises
        ------
        InputError
            There is no section of this class.
        ConfigurationError
            None was kept, and one of its keys has no default.
        """
        names = {section_class: name for name, section_class in section_types().items()}
        if section_type not in names:
            raise InputError(
                f"{section_type!r} is no section of a TEST.toml; these are {', '.join(cls.__name__ for cls in names)}"
            )
        name = names[section_type]
        return read_section(section_type, name, self.provenance.get("settings", {}).get(name, {}))

    @cached_property
    def scale(self) -> ScaleSettings:
        """``[scale]`` of the settings that it was measured with."""
        return self.section(ScaleSettings)

    def setting(self, section: str, key: str, default: Any = None) -> Any:
        """Return a setting of the run, as TEST.toml names it; `default` where it was not kept.

        Parameters
        ----------
        section, key
            Names of section and key.
        default
            What is returned where it was not kept.

        Returns
        -------
        Any
        """
        return self.provenance.get("settings", {}).get(section, {}).get(key, default)

    def frame(self, index: int) -> FrameRecord:
        """Read everything that is kept of one frame.

        Parameters
        ----------
        index
            Index of the frame; from the end where negative.

        Returns
        -------
        FrameRecord

        Raises
        ------
        InputError
            There is no such frame.
        ResultError
            The frame is damaged, or does not fit the mesh.
        """
        if not isinstance(index, int | np.integer) or not -len(self) <= index < len(self):
            raise InputError(f"there is no frame {index!r} in a result of {len(self)} frames (0 to {len(self) - 1})")
        values = self.table.read(int(index) % len(self))
        return FrameRecord(values=values, sizes=self.table.sizes)

    @checked
    def iterate(self, name: str, frames: Iterable[int] | None = None) -> Iterator[Any]:
        """Read one quantity, frame after frame (None: all); yields arrays, or plain numbers or texts.

        Parameters
        ----------
        name
            Name of the quantity.
        frames
            Indices of the frames; None: all.

        Yields
        ------
        Any
        """
        indices = range(len(self)) if frames is None else frames
        return (self.table.read(frame, [name])[name] for frame in indices)

    @checked
    def stack(self, name: str) -> AnyArray:
        """Read one quantity of all frames into one array, the frames as first axis.

        Parameters
        ----------
        name
            Name of the quantity.

        Returns
        -------
        ndarray, shape (T, ...)
        """
        return self._stacked([name])[name]

    def _stacked(self, names: Sequence[str]) -> dict[str, AnyArray]:
        """Read some quantities of all frames, each frame once."""
        stacked, count = dict[str, AnyArray](), len(self)
        for name in names:
            entry = QUANTITIES[name]
            shape = (len(self.nodes),) if entry.is_estimated else entry.unmeasured(self.table.sizes).shape
            stacked[name] = np.full((count, *shape), entry.blank, dtype=entry.dtype)
        for frame in range(count):
            values = self.table.read(frame, names)
            for name, array in stacked.items():
                if np.size(values[name]) or not QUANTITIES[name].is_estimated:
                    array[frame] = values[name]
        return stacked

    def in_units(self, scale: ScaleSettings | None = None) -> ResultInUnits:
        """Return the result as histories, profiles and maps read it: the units of its ``[scale]``, times and strain.

        Parameters
        ----------
        scale
            It replaces the ``[scale]`` that was kept with the result; None: that one.

        Returns
        -------
        ResultInUnits
        """
        from rgbmidic.results.result_in_units import ResultInUnits

        return ResultInUnits.without_times(self, scale)

    def to_xarray(self, scale: ScaleSettings | None = None) -> xr.Dataset:
        """Return the result with named dimensions, coordinates and units; values are read frame by frame when used.

        Parameters
        ----------
        scale
            It replaces the ``[scale]`` that was kept with the result; None: that one.

        Returns
        -------
        xarray.Dataset
            Dimensions: `frame` (T), `node` (N), `light` (k), `element` (E), `corner` (3), `component` (exx, eyy, exy)
            and, of single variables, `brightness_part` and `stage`.
            Coordinates: `x`, `y` of the nodes, in mm where the scale is known (with a camera also `x_image`, `y_image`
            in px); `number`, `name` and, where it is known, `time` (s) of the frames; names of lights and components.
            Variables: every quantity of `QUANTITIES` that has one shape in all frames, such as `u` (frame, node),
            `light_fraction` (frame, node, light) and `status` (frame); displacements are in the unit of `x`. Strain
            and its uncertainty are `strain` and `strain_std` (frame, node, component): Green-Lagrange strain over
            the shortest virtual strain gauge, as in figures, viewer and exports; the description says so.
            `elements` (element, corner). Where ``[scale]`` has a camera, all are those on its plane. Each has the
            attributes ``units`` and ``long_name``, a status ``flag_values`` and ``flag_meanings``.
            Attributes: ``settings``, ``calibration`` and ``versions`` as JSON texts, ``references``, dates, and
            ``mm_per_pixel`` with its uncertainty where the scale is known, and ``camera``.

        Raises
        ------
        InputError
            The package xarray is not installed (extra ``xarray``).
        ResultError
            A frame is damaged; raised when a value of it is read.
        """
        dataset: xr.Dataset = import_optional("rgbmidic.results.dataset", "xarray").to_dataset(self, scale)
        return dataset

    def _quantity(self, name: str, /) -> AnyArray:
        self.__dict__.update(self._stacked([name] if QUANTITIES[name].axes else NUMBERS))
        quantity: AnyArray = self.__dict__[name]
        return quantity

    @property
    def nodal_strain(self) -> FloatArray:
        """Small strain (exx, eyy, exy) of the nodes, shape (T, N, 3): no gauge, and no finite strain."""
        return np.stack([self.nodal_exx, self.nodal_eyy, self.nodal_exy], axis=-1)

    @property
    def nodal_strain_std(self) -> FloatArray:
        """Standard uncertainty of `nodal_strain`, shape (T, N, 3)."""
        return np.stack([self.nodal_exx_std, self.nodal_eyy_std, self.nodal_exy_std], axis=-1)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why each frame failed or did not converge, length T; empty texts otherwise."""
        return tuple(self.iterate("reason"))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the run: of the test as a whole, then of frames, with their numbers."""
        of_test = [*self.provenance.get("warnings", ()), *self.provenance.get("final_warnings", ())]
        texts = zip(range(len(self)), self.iterate("warnings"), strict=True)
        return (*of_test, *join_frame_warnings(((frame, messages.tolist()) for frame, messages in texts), self.names))

    @property
    def inputs(self) -> dict[str, str]:
        """Path and SHA-256 of every file that the frames were read from."""
        return {path: digest for file_rows in self.iterate("inputs") for path, digest in file_rows.tolist()}

    @cached_property
    def mean_light_fraction(self) -> FloatArray:
        """Mean of `light_fraction` over the measured nodes, shape (T, k); NaN where none is measured."""
        fractions = np.full((len(self), len(self.lights)), np.nan)
        for row in range(len(self)):
            values = self.table.read(row, ["light_fraction", "node_status"])
            if (is_measured := values["node_status"] == 0).any():
                fractions[row] = values["light_fraction"][is_measured].mean(axis=0, dtype=np.float64)
        return fractions

    @cached_property
    def reference(self) -> npt.NDArray[np.uint8] | None:
        """Reference image of each light as a picture, shape (k, H, W); None where none was kept.

        Of a frame of which only a part is read it shows that part, which begins at `reference_origin`.
        """
        return read_reference(self.path, self.table.sizes, self.table.run)

    @property
    def reference_origin(self) -> tuple[int, int]:
        """Column and row of the frame at which `reference` begins."""
        x, y = self.provenance.get("reference_origin") or (0, 0)
        return x, y

    @property
    def frame_shape(self) -> tuple[int, int] | None:
        """Rows and columns of the frames; None where neither the provenance nor a reference image has them."""
        shape = self.provenance.get("frame_shape")
        if shape is None and self.reference is not None:
            shape = self.reference.shape[1:]
        return shape and (shape[0], shape[1])


def finish_result(path: Path | str, warnings: Sequence[str] = ()) -> None:
    """Put the date of its end into the provenance of a result, once every record is read and found whole.

    Parameters
    ----------
    path
        The folder.
    warnings
        What only all frames together show, to be kept.

    Raises
    ------
    ResultError
        The folder is no result, a frame is missing or damaged, or it cannot be written.

    Examples
    --------
    >>> finish_result("my_result")
    >>> "finished" in Result.open("my_result").provenance
    True
    """
    result = Result.open(path, partial=True, check=False)
    result.without_damaged()._check_complete()
    if "finished" not in result.provenance:
        ended = {"final_warnings": list(warnings), "finished": current_time()}
        write_json(result.path / PROVENANCE, with_checksum({**result.provenance, **ended}))


def list_frames(frames: Sequence[int], names: Sequence[str], max_count: int = 5) -> str:
    """List the first of some frames with their names, at most `max_count`, and how many more there are."""
    remainder = f" and {len(frames) - max_count} more" if len(frames) > max_count else ""
    return ", ".join(f"{frame} ({names[frame]})" for frame in frames[:max_count]) + remainder


def read_shared(path: Path, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Read ``names`` of the frames, ``nodes`` (N, 2), ``elements`` (E, 3) and, of a mesh file, `MESH_LABELS`.

    Raises
    ------
    ResultError
        They are not those of the provenance.
    """
    try:
        names = read_json(path / NAMES)
    except FileNotFoundError:
        raise ResultError(f"{path / NAMES} is missing: the result is incomplete") from None
    texts = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not texts or {"count": len(names), "sha256": digest(names)} != provenance["frames"]:
        raise ResultError(f"{path / NAMES} is damaged: it does not hold the names of the frames")
    mesh_file_names = MESH_LABELS if MESH_DOCUMENT in provenance else ()
    mesh = _read_converted(path / MESH, ["nodes", "elements", *mesh_file_names], {})
    if digest(mesh) != provenance["mesh"]:
        raise ResultError(f"{path / MESH} is damaged or of another result")
    return {"names": tuple(names), **mesh}


def read_reference(path: Path, sizes: Mapping[str, int], run: bytes) -> npt.NDArray[np.uint8] | None:
    """Read the reference image of each light as a picture, shape (k, H, W); None where none was kept.

    Raises
    ------
    ResultError
        The file is damaged, or of another run than the one with this digest.
    """
    file = path / REFERENCE
    if not file.is_file():
        return None
    if read_arrays(file, ["run"])["run"].tobytes() != run:
        raise ResultError(f"{file} is of another run than {path / PROVENANCE}: {RESTORE_REMEDY}")
    pictures: npt.NDArray[np.uint8] = _read_converted(file, ["reference"], sizes)["reference"]
    return pictures


def _read_converted(path: Path, names: Iterable[str], sizes: Mapping[str, int]) -> dict[str, AnyArray]:
    arrays = read_arrays(path, names)
    try:
        return {name: SHARED[name].convert(array, sizes) for name, array in arrays.items()}
    except (TypeError, ValueError) as error:
        raise ResultError(f"{path} is damaged: {error}") from None
