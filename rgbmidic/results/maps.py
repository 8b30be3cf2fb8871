"""Maps: nodal fields of a result in a frame, measured or derived, each with its unit and standard uncertainty.

Displacement and strain are those against the test's reference, or since a later frame (see `Maps.since`). Velocities,
accelerations and strain rates are those of `rgbmidic.fields.rates` at every node, always against the test's reference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.field import Displacement, Field
from rgbmidic.fields.history import FEWEST, rate_frames, rate_words, rates
from rgbmidic.fields.interpolation import MeshPoints
from rgbmidic.fields.nodal import NodalCovariance, RigidMotion, frame_covariance
from rgbmidic.fields.quantity import ResultQuantity, Units
from rgbmidic.fields.strain import MEASURES, Strain, StrainGauges, length_of, strain_of_gradient
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.renamed import state_new_names
from rgbmidic.results.quantities import UNKNOWN_TIME, UV, map_quantities
from rgbmidic.results.result import Portable, Result
from rgbmidic.results.result_in_units import ResultInUnits
from rgbmidic.settings import ProbeSettings, ScaleSettings
from rgbmidic.typing import FloatArray, IntArray

DEFAULT_RATE_WINDOW = 9
"""Frames that a parabola takes in for rates where none are stated. Chosen: the noise of a velocity is then .13 of that
of a displacement per frame, and a change within 4 frames is still seen."""
_WINDOWS_PER_BLOCK = 2
"""Windows of frames that are read at once, and on either side of these: the widest fit takes in 5/3 of a window."""
_PICTURE_TRIANGLES = 80_000
"""Parts of the elements in a picture, each side in 4 at most: what a picture leaves out that is linear in the elements
is then a sixteenth."""
_NODES_PER_BATCH = 4096
"""Nodes whose rates are computed at once: 25 MB of results at the default window."""


@state_new_names
@dataclass(frozen=True, kw_only=True, eq=False)
class Maps(Portable):
    """The nodal fields of a result.

    Attributes
    ----------
    physical
        The result in the units of its ``[scale]``, with gauge length and measure of the strain.
    since
        Frame that displacement and strain are taken from, in place of the test's reference; None: that one. The
        displacement since frame n of a material point is ``u_t - u_n``, its deformation gradient ``F_t F_n⁻¹``, in the
        axes and lengths of frame n; fields stay on the nodes of the test's reference. The noise of the test's reference
        is in both frames and cancels, as in `frame_covariance`; that of frame n counts, so that the uncertainty is
        that of two frames.
    rigid_removed
        Whether shift and rotation of the field as a whole are removed from the displacement, and from the gradient of
        the engineering strain; other strains do not depend on it.
    window
        Frames that a rate is taken over, as ``probes.window``.

    Examples
    --------
    >>> maps = Maps.from_result(Result.open("my_result"))
    >>> exx = maps.read("exx", 1)
    >>> exx.values.shape == exx.std.shape == (len(maps.result.nodes),)
    True
    """

    physical: ResultInUnits
    since: int | None = None
    rigid_removed: bool = False
    window: int = DEFAULT_RATE_WINDOW

    @classmethod
    def from_result(cls, result: Result, scale: ScaleSettings | None = None, **choices: Any) -> Self:
        """Choose how fields are derived.

        Parameters
        ----------
        result
            The result; a run may still add to it.
        scale
            It replaces the ``[scale]`` that was kept with the result; None: that one.
        **choices
            `gauge`, `measure`, `since`, `rigid_removed` and `window`, as of `with_options`.

        Returns
        -------
        Maps

        Raises
        ------
        InputError
            As of `with_options`.
        """
        return cls(physical=result.in_units(scale)).with_options(**choices)

    @property
    def result(self) -> Result:
        """The result."""
        return self.physical.result

    def refreshed(self, result: Result) -> Self:
        """Return the fields of the result with the frames that a run has added since.

        Parameters
        ----------
        result
            The result as it is now, `Result.refresh`.

        Returns
        -------
        Maps
        """
        return replace(self, physical=self.physical.refreshed(result))

    def with_options(
        self,
        *,
        gauge: float | None = None,
        measure: str | None = None,
        since: int | None = None,
        rigid_removed: bool = False,
        window: int | None = None,
    ) -> Self:
        """Choose anew how fields are derived.

        Parameters
        ----------
        gauge
            Length of the virtual strain gauge in px; None: the shortest, three elements.
        measure
            One of `rgbmidic.fields.MEASURES`; None: the first.
        since, rigid_removed, window
            See the class; the window is that of ``[probes]``, or 9 frames, where None is stated.

        Returns
        -------
        Maps

        Raises
        ------
        InputError
            There is no frame `since`, nothing is measured in it, there is no such measure, the gauge is too short, or
            the window holds fewer than 4 frames.
        """
        frames = len(self.result)
        if since is not None and not 0 <= since < frames:
            raise InputError(f"there is no frame {since} in a result of {frames} frames (0 to {frames - 1})")
        if since is not None and self.result.finished[since] and np.isnan((base := self.result.frame(since)).u).all():
            reason = base.reason or "no node"
            raise InputError(f"nothing is known since frame {since}, in which nothing is measured: {reason}")
        window = window or self.result.section(ProbeSettings).window or DEFAULT_RATE_WINDOW
        rate_frames(window, FEWEST)
        physical, measure = self.physical, measure or MEASURES[0]
        if (gauge, measure) != (physical.gauge, physical.measure):
            physical = physical.with_strain(gauge, measure)
            strain_of_gradient(np.zeros((1, 2, 2)), np.zeros((1, 4, 4)), measure)
            _ = gauge is not None and physical.gauges
        return replace(self, physical=physical, since=since, rigid_removed=rigid_removed, window=window)

    @cached_property
    def quantities(self) -> dict[str, ResultQuantity]:
        """Every field by its name, displacements first; each that has an uncertainty is followed by it further down."""
        return map_quantities(self.physical.components, self.physical.quantities.values(), self._units)

    def field(self, name: str) -> ResultQuantity:
        """Return a field by its name.

        Parameters
        ----------
        name
            Name of the field.

        Returns
        -------
        ResultQuantity

        Raises
        ------
        InputError
            There is none of this name; the message lists all names.
        """
        if name not in self.quantities:
            raise InputError(f'there is no field "{name}"; the fields are {", ".join(self.quantities)}')
        return self.quantities[name]

    def processing_note(self, name: str) -> str:
        """Describe how a field is derived, for the text beside it: measure and gauge, reference, rates; may be empty.

        Parameters
        ----------
        name
            Name of the field, or of its uncertainty.

        Returns
        -------
        str
        """
        base = name.removesuffix("_std")
        field = self.field(base if base in self.quantities else name)
        since = "" if self.since is None else f"since frame {self.since}"
        phrases = list[str]()
        if field.group == "Displacement":
            phrases = [since, "rigid motion removed" if self.rigid_removed else ""]
        elif field.group == "Strain":
            phrases = [self.physical.strain_description(base), since]
        elif field.group == "Rates" and len(self._measured_frames) >= FEWEST:
            is_strain = not {*field.base_quantities} <= {*self.physical.components}
            strain = self.physical.strain_description(base) if is_strain else ""
            phrases = [strain, rate_words(self.window, len(self._measured_frames))]
        return ", ".join(filter(None, phrases))

    def read(self, name: str, frame: int) -> Field:
        """Read a field in one frame.

        Parameters
        ----------
        name
            Name of the field, one of `quantities`.
        frame
            Index of the frame.

        Returns
        -------
        Field
            At the nodes, shape (N,), with its standard uncertainty, NaN where it has none.

        Raises
        ------
        InputError
            There is no such field or frame, or too few frames for rates.
        ResultError
            The frame is damaged, or does not fit the mesh.
        """
        entry, base = self.field(name), name.removesuffix("_std")
        if not 0 <= frame < len(self.result):
            raise InputError(f"there is no frame {frame} in a result of {len(self.result)} frames")
        if base != name and base in self.quantities:
            field = Field(name=name, unit=entry.unit, dims=("node",), values=self.read(base, frame).uncertainty)
        elif entry.group == "Strain":
            field = self._strain(frame)[name]
        elif entry.group in ("Displacement", "Rates"):
            field = self._derived(entry, frame)
        else:
            field = self.physical.field(name, frame)
        return replace(field, std=field.uncertainty)

    def deformed_nodes(self, frame: int) -> FloatArray:
        """Compute the deformed places of the nodes, px of the image; NaN where not measured.

        Parameters
        ----------
        frame
            Index of the frame.

        Returns
        -------
        ndarray, shape (N, 2)
        """
        record = self.result.table.read(frame, UV)
        return np.asarray(self.result.nodes + np.stack([record[name] for name in UV], axis=1))

    def _derived(self, entry: ResultQuantity, frame: int) -> Field:
        """Compute a displacement or a rate in the reader's units."""
        source, names, covariance = self.physical, entry.base_quantities, None
        calibration = self._covariance.calibration if {*names} <= {*source.components} else None
        if entry.order:
            component: Callable[[str], Field] = partial(self._rates, frame=frame, order=entry.order)
        else:
            displacement = self.displacement(frame)
            component = {one.name: one for one in displacement.components}.__getitem__
            covariance = displacement.covariance
        field = component(names[0])
        if len(names) > 1:
            fields = [component(name) for name in names]
            vector, error = (
                np.stack(arrays, axis=1)
                for arrays in zip(*((one.values, one.uncertainty) for one in fields), strict=True)
            )
            matrix = error[:, :, None] ** 2 * np.eye(len(names))
            length, std = length_of(vector, matrix if covariance is None else np.moveaxis(covariance, 2, 0))
            field = replace(field, values=length, std=std, bias=None)
        if calibration is not None:  # of a length its slope by the components
            vector = np.stack([component(name).values for name in source.components])
            errors, rows = calibration.at_nodes(vector), [source.components.index(name) for name in names]
            slope = vector[rows] / np.maximum(np.linalg.norm(vector[rows], axis=0), np.finfo(float).tiny)
            field = field.with_common(
                errors[:, rows[0]] if len(rows) == 1 else np.einsum("in,min->mn", slope, errors[:, rows])
            )
        return replace(self._units.convert(field), name=entry.name, unit=entry.unit)

    def displacement(self, frame: int) -> Displacement:
        """Return the displacement of the nodes in the unit of the source, since `since`, the rigid motion removed.

        Parameters
        ----------
        frame
            Index of the frame.

        Returns
        -------
        Displacement
            Of the shape (c, N).
        """
        displacement = self._relative_displacement(frame)
        motion = self._rigid(displacement)
        return displacement if motion is None else motion.removed(self._covariance.points, displacement)

    def triangulate(self, field: ResultQuantity, values: FloatArray) -> tuple[FloatArray, npt.NDArray[np.int32]]:
        """Return nodal values as pictures draw them, linear in triangles, and the triangles.

        They are parts of the elements, or the elements of what has no sign: it stays within the values of its nodes.

        Parameters
        ----------
        field
            Whether it has a sign.
        values : ndarray, shape (N, C)
            At the nodes; NaN where a node has no data.

        Returns
        -------
        values : ndarray, shape (M, C)
            At the corners of the triangles.
        triangles : ndarray, shape (F, 3), int32
        """
        if not field.is_signed:
            return values, self.result.elements
        points, triangles = self._subdivision
        return points.read(values), triangles

    @cached_property
    def _subdivision(self) -> tuple[MeshPoints, npt.NDArray[np.int32]]:
        mesh = self.physical.mesh
        return MeshPoints.subdivide(mesh, int(np.clip((_PICTURE_TRIANGLES / len(mesh.elements)) ** 0.5, 1, 4)))

    def points_in_elements(self, points: FloatArray, element: IntArray) -> MeshPoints:
        """Take points of the image whose elements are known, to read nodal values there.

        Parameters
        ----------
        points : ndarray, shape (P, 2)
            Points (x, y) of the image, px.
        element : ndarray, shape (P,), int
            Their elements.

        Returns
        -------
        MeshPoints
        """
        return MeshPoints.within(Tri3Mesh(nodes=self.result.nodes, elements=self.result.elements), points, element)

    def strain_at(self, frame: int, x: float, y: float, length: float) -> Strain:
        """Compute the strain of one virtual gauge at a place of the image, px.

        Parameters
        ----------
        frame
            Index of the frame.
        x, y
            Middle of the gauge in px of the image.
        length
            Length of the gauge in px.

        Returns
        -------
        Strain
            Of the shape (1,).

        Raises
        ------
        InputError
            The place is outside the mesh, or the gauge is too short.
        """
        return self._strain_of(frame, self._gauge(*self.physical.rectified.probe_coordinates((x, y, length), 1)))

    @cached_property
    def _gauge(self) -> Callable[[float, float, float], StrainGauges]:
        """Virtual gauge at a place; those used last are kept: 15 ms each where there are 8,000 nodes."""
        return lru_cache(200)(
            lambda x, y, length: StrainGauges.at_points(self.physical.covariance, np.array([[x, y]]), length)
        )

    def _relative_displacement(self, frame: int) -> Displacement:
        """Return the displacement since the frame that is the reference here."""
        displacement = self.physical.displacement(frame)
        if self.since is None:
            return displacement
        return displacement.since(self._base_displacement, self._shared_fraction(frame))

    @cached_property
    def _base_displacement(self) -> Displacement:
        return self.physical.displacement(self.since or 0)

    def _shared_fraction(self, frame: int) -> float:
        """Return the fraction of the smaller variance that a frame has in common with the one of `since`."""
        if frame == self.since:
            return 1.0
        references = self.physical.references[[frame, self.since or 0]]
        return float(frame_covariance(np.ones(2), self.physical.common_fraction, references)[0, 1])

    @cached_property
    def _covariance(self) -> NodalCovariance:
        """Correlation of the nodes' errors, with the nodes where they are at the reference."""
        if self.since is None:
            return self.physical.covariance
        return self.physical.covariance.moved(self._base_displacement)

    def _rigid(self, displacement: Displacement) -> RigidMotion | None:
        """Fit the rigid motion that is removed; None where none is, or fewer than two nodes are measured."""
        fits = self.rigid_removed and displacement.is_measured.sum() > 1
        return RigidMotion.of(self._covariance, displacement) if fits else None

    @cached_property
    def _strain(self) -> Callable[[int], Strain]:
        """Strain of a frame; of the last two it is kept, for several fields of one frame."""
        return lru_cache(2)(lambda frame: self._strain_of(frame, self.physical.gauges))

    def _strain_of(self, frame: int, gauges: StrainGauges) -> Strain:
        displacement = self.physical.displacement(frame)
        if self.since is None:
            gradient, covariance = gauges.gradient(displacement)
        else:  # both gradients of the same nodes, which have data in both frames
            in_both_frames = displacement.is_measured & self._base_displacement.is_measured
            present, base = (
                one.with_arrays(lambda array: np.where(in_both_frames, array, np.nan))
                for one in (displacement, self._base_displacement)
            )
            shared = gauges.shared_covariance(present, base, self._shared_fraction(frame))
            gradient, covariance = _relative_gradient(gauges.gradient(present), gauges.gradient(base), shared)
        motion = self._rigid(self._relative_displacement(frame))
        if motion is not None:
            gradient, covariance = motion.removed_gradient(gradient, covariance)
        return strain_of_gradient(gradient, covariance, self.physical.measure)

    def _rates(self, name: str, frame: int, order: int) -> Field:
        """Return the derivative of an order of a field against the test's reference, shape (N,)."""
        positions = np.flatnonzero(self._measured_frames == frame)
        if not len(positions):  # not measured yet
            nothing, unit = np.full(len(self.result.nodes), np.nan), self.field(name).unit
            return Field(name=name, unit=unit, dims=("node",), values=nothing, std=nothing)
        block, row = divmod(int(positions[0]), _WINDOWS_PER_BLOCK * self.window)
        return self._block(name, block)[order - 1].isel(frame=row)

    @cached_property
    def _measured_frames(self) -> IntArray:
        return np.flatnonzero(self.result.finished)

    @cached_property
    def _units(self) -> Units:
        """Units with that of time, for which one frame is read: `_clock` reads all."""
        first_stamp = next(iter(self.result.iterate("time_ns", self._measured_frames[:1])), UNKNOWN_TIME)
        scale = self.physical.scale or self.result.scale
        rate = scale.frame_rate or self.result.provenance.get("frame_rate")
        return replace(self.physical.units, timed=bool(rate) or first_stamp != UNKNOWN_TIME)

    @cached_property
    def _clock(self) -> FloatArray:
        """Times of the frames that are measured, or their numbers where no time is known."""
        times = self.physical.seconds
        if times is None and self._units.timed:
            raise InputError(
                "rates need a time of each frame that is later than the one before: state frame_rate in [scale]"
            )
        clock = self.result.number if times is None else times
        return np.asarray(clock[self._measured_frames], dtype=np.float64)

    @cached_property
    def _block(self) -> Callable[[str, int], list[Field]]:
        """Velocity and acceleration (frames, N) in a block of frames; those used last are kept."""
        return lru_cache(4)(self._rates_of)

    def _rates_of(self, name: str, block: int) -> list[Field]:
        """Compute rates of a field from the frames of a block and those around: the same whichever is asked for."""
        window_frames = rate_frames(self.window, len(self._measured_frames))
        size = _WINDOWS_PER_BLOCK * self.window
        block_slice = slice(block * size, min((block + 1) * size, len(self._measured_frames)))
        padded_slice = slice(max(block_slice.start - size, 0), block_slice.stop + size)
        frames, clock = self._measured_frames[padded_slice], self._clock[padded_slice]
        maps = replace(self, since=None, rigid_removed=False)
        if name in self.physical.components:  # as they are, in px: the scale has no noise
            index = self.physical.components.index(name)
            fields = [self.physical.displacement(frame).components[index] for frame in frames.tolist()]
        else:
            fields = [maps.read(name, frame) for frame in frames.tolist()]
        series, rows = (
            Field.concatenate(fields),
            slice(block_slice.start - padded_slice.start, block_slice.stop - padded_slice.start),
        )
        options: dict[str, Any] = {
            "window": (window_frames - 1) * float(np.median(np.diff(self._clock))),
            "common_fraction": self.physical.common_fraction,
            "references": self.physical.references[frames],
        }
        starts = range(0, len(self.result.nodes), _NODES_PER_BATCH)
        parts = [rates(clock, series.isel(node=slice(start, start + _NODES_PER_BATCH)), **options) for start in starts]
        return [
            Field.concatenate([part[quantity].isel(frame=rows) for part in parts], "node")
            for quantity in ("velocity", "acceleration")
        ]


def _relative_gradient(
    present: tuple[FloatArray, FloatArray], base: tuple[FloatArray, FloatArray], shared: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Compute the displacement gradient from one state to another, ``F_now F_first⁻¹ - I``, and its covariance.

    With ``A = I ⊗ F_first⁻ᵀ`` and ``B = (F_now F_first⁻¹) ⊗ F_first⁻ᵀ`` its change is ``A d(now) - B d(first)``, both
    row by row; `shared` (G, 4, 4) is the covariance between both gradients.
    """
    inverse = np.linalg.inv(np.eye(2) + base[0])
    relative = (np.eye(2) + present[0]) @ inverse
    a = np.einsum("ij,glk->gikjl", np.eye(2), inverse).reshape(-1, 4, 4)
    b = np.einsum("gij,glk->gikjl", relative, inverse).reshape(-1, 4, 4)
    transposed = [np.swapaxes(matrix, 1, 2) for matrix in (a, b)]
    cross = a @ shared @ transposed[1]
    covariance = a @ present[1] @ transposed[0] + b @ base[1] @ transposed[1] - cross - np.swapaxes(cross, 1, 2)
    return relative - np.eye(2), covariance
