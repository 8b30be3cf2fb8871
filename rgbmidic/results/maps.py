"""Maps: nodal fields of a result in a frame, measured or derived, each with its unit and standard uncertainty.

Displacement and strain are those against the test's reference, or since a later frame (see `Maps.since`). Velocities,
accelerations and strain rates are those of `rgbmidic.fields.rates` at every node, always against the test's reference.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.fields.history import FEWEST, rate_frames, rate_words, rates
from rgbmidic.fields.interpolation import Places
from rgbmidic.fields.nodal import NodalCovariance, RigidMotion, frame_covariance
from rgbmidic.fields.strain import MEASURES, Strain, StrainGauges, length_of, strain_of_gradient
from rgbmidic.fields.units import Units
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.results.physical import (
    EDGE,
    MOVED,
    Physical,
    displacements,
    edge_std,
    frame_times,
    named,
    reference_frames,
    shared_part,
)
from rgbmidic.results.quantities import DERIVED, UNKNOWN_TIME, UV, WITH_ERROR, Quantity, map_quantities
from rgbmidic.results.result import Portable, Result
from rgbmidic.settings import MeshSettings, ProbeSettings, ScaleSettings
from rgbmidic.typing import BoolArray, FloatArray, IntArray

WINDOW = 9
"""Frames that a parabola takes in for rates where none are stated. Chosen: the noise of a velocity is then .13 of that
of a displacement per frame, and a change within 4 frames is still seen."""
_AROUND = 2
"""Windows of frames that are read at once, and on either side of these: the widest fit takes in 5/3 of a window."""
_PARTS = 80_000
"""Parts of the elements in a picture, each side in 4 at most: what a picture leaves out that is linear in the elements
is then a sixteenth."""
_AT_ONCE = 4096
"""Nodes whose rates are computed at once: 25 MB of results at the default window."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapValues:
    """A field in one frame.

    Attributes
    ----------
    values, std : ndarray, shape (N,)
        In the unit of the field; NaN where not known.
    moved : ndarray, shape (N, 2)
        Deformed places of the nodes, px of the image; NaN where not measured.
    status : ndarray, shape (N,), uint8
        `node_status`.
    """

    values: FloatArray
    std: FloatArray
    moved: FloatArray
    status: npt.NDArray[np.uint8]

    @property
    def doubtful(self) -> BoolArray:
        """Mask of the nodes whose value lies within two standard uncertainties of 0, shape (N,)."""
        return np.asarray(np.abs(self.values) < 2 * self.std)


@dataclass(frozen=True, kw_only=True, eq=False)
class Maps(Portable):
    """The nodal fields of a result.

    Attributes
    ----------
    result
        The result.
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
    """

    result: Result
    physical: Physical
    since: int | None = None
    rigid_removed: bool = False
    window: int = WINDOW

    @classmethod
    def of(cls, result: Result, scale: ScaleSettings | None = None, **choices: Any) -> Self:
        """Choose how fields are derived.

        Parameters
        ----------
        result
            The result; a run may still add to it.
        scale
            It replaces the ``[scale]`` that was kept with the result; None: that one.
        **choices
            `gauge`, `measure`, `since`, `rigid_removed` and `window`, as of `chosen`.

        Returns
        -------
        Maps

        Raises
        ------
        InputError
            As of `chosen`.
        """
        return cls(result=result, physical=Physical.untimed(result, scale)).chosen(**choices)

    def chosen(
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
        if since is not None and self.result.finished[since] and np.isnan((first := self.result.frame(since)).u).all():
            why = first.reason or "no node"
            raise InputError(f"nothing is known since frame {since}, in which nothing is measured: {why}")
        window = window or self.result.section(ProbeSettings).window or WINDOW
        rate_frames(window, FEWEST)
        physical, measure = self.physical, measure or MEASURES[0]
        if (gauge, measure) != (physical.gauge, physical.measure):
            physical = replace(physical, gauge=gauge, measure=measure)
            strain_of_gradient(np.zeros((1, 2, 2)), np.zeros((1, 4, 4)), measure)
            _ = gauge is not None and physical.gauges
        return replace(self, physical=physical, since=since, rigid_removed=rigid_removed, window=window)

    @cached_property
    def all(self) -> dict[str, Quantity]:
        """Every field by its name, displacements first; each that has an uncertainty is followed by it further down."""
        error = self.result.section(MeshSettings).error
        return map_quantities(self._units, self.result.lights, with_error=bool(error))

    def field(self, name: str) -> Quantity:
        """Return a field by its name.

        Parameters
        ----------
        name
            Name of the field.

        Returns
        -------
        Quantity

        Raises
        ------
        InputError
            There is none of this name; the message lists all names.
        """
        if name not in self.all:
            raise InputError(f'there is no field "{name}"; the fields are {", ".join(self.all)}')
        return self.all[name]

    def how(self, name: str) -> str:
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
        field = self.field(base if base in self.all else name)
        since = "" if self.since is None else f"since frame {self.since}"
        parts = list[str]()
        if field.group == "Displacement":
            parts = [since, "rigid motion removed" if self.rigid_removed else ""]
        elif field.group == "Strain":
            parts = [self.physical.strain_words(base), since]
        elif field.group == "Rates" and len(self._there) >= FEWEST:
            strain = "" if DERIVED[base].unit else self.physical.strain_words(base)
            parts = [strain, rate_words(self.window, len(self._there))]
        return ", ".join(filter(None, parts))

    def read(self, name: str, frame: int) -> MapValues:
        """Read a field in one frame.

        Parameters
        ----------
        name
            Name of the field, one of `all`.
        frame
            Index of the frame.

        Returns
        -------
        MapValues
            Its values, uncertainties and the places of the nodes.

        Raises
        ------
        InputError
            There is no such field or frame, or too few frames for rates.
        ResultError
            The frame is damaged, or does not fit the mesh.
        """
        kind = self.field(name).kind
        if not 0 <= frame < len(self.result):
            raise InputError(f"there is no frame {frame} in a result of {len(self.result)} frames")
        base = name.removesuffix("_std")
        derived = base in DERIVED or name in WITH_ERROR
        stored: tuple[str, ...] = () if derived or name in MOVED else EDGE if name in EDGE else (name,)
        if kind == "fraction":
            stored = ("light_fraction",)
        read = next(self.result.table.each(["u", "v", "node_status", *stored], [frame]))
        nothing = np.full(len(self.result.nodes), np.nan)
        if name in WITH_ERROR:
            values, std = self._with_error(WITH_ERROR[name], frame), nothing
        elif derived:
            values, std = self._derived(base, frame)
            values, std = (std, nothing) if base != name else (values, std)
        elif kind == "fraction":
            light = self.result.lights.index(name.removeprefix("fraction of "))
            values, std = np.where(read["node_status"] == 0, read["light_fraction"][:, light], np.nan), nothing
        elif name in MOVED:
            values, std = self.physical.length * next(self._displacements([frame]))[MOVED.index(name)], nothing
        elif name in EDGE:
            values, std = self.physical.length * edge_std(self.physical.rectified, read)[EDGE.index(name)], nothing
        else:
            values, std = np.asarray(read[name], dtype=np.float64), nothing
        return MapValues(
            values=np.ascontiguousarray(values, dtype=np.float64),
            std=np.asarray(std, dtype=np.float64),
            moved=self.result.nodes + np.stack([read["u"], read["v"]], axis=1),
            status=read["node_status"],
        )

    def _with_error(self, entry: Quantity, frame: int) -> FloatArray:
        """Compute a field of `WITH_ERROR` (N,) against the test's reference; NaN in frames without."""
        names = {f"{one}{end}": None for one in (*UV, *entry.parts) for end in ("", "_std", "_mesh_error")}
        read = next(self.result.table.each([*names], [frame]))
        if not read["u_mesh_error"].size:
            return np.full(len(self.result.nodes), np.nan)
        double = {key: np.asarray(values, dtype=np.float64) for key, values in read.items()}
        pairs = [(double[f"{one}_std"], double[f"{one}_mesh_error"]) for one in entry.parts]
        if len(pairs) > 1:
            return np.asarray(np.fmax.reduce([error / std for std, error in pairs]))
        std, error = pairs[0]
        if (one := entry.parts[0]) in UV:
            ends = ("_std", "_mesh_error")
            moved = ([double[f"{name}{part}"] for part in ("", end) for name in UV] for end in ends)
            rectified = (self.physical.rectified.displacement(*parts)[2 + UV.index(one)] for parts in moved)
            std, error = (self.physical.length * part for part in rectified)
        return error if entry.name.endswith("_error") else np.hypot(error, std)

    def _derived(self, name: str, frame: int) -> tuple[FloatArray, FloatArray]:
        """Compute a length, a strain or a rate, and its uncertainty, each (N,)."""
        entry = DERIVED[name]
        if entry.group == "Strain":
            return self._strain(frame)[name], self._strain(frame)[f"{name}_std"]
        if entry.order:
            parts = [self._rates(part, frame, entry.order) for part in entry.parts]
        else:
            moved = self.displacement(frame)
            parts = [moved[UV.index(part) : 4 : 2] for part in entry.parts]
        values, std = parts[0]
        if len(parts) > 1:
            vector, error = (np.stack(each, axis=1) for each in zip(*parts, strict=True))
            values, std = length_of(vector, error[:, :, None] ** 2 * np.eye(len(parts)))
        return self._units.lengths(values, std) if entry.unit else (values, std)

    def displacement(self, frame: int) -> FloatArray:
        """Return u, v, their standard uncertainties and what the lights' bias leaves of these, (6, N) in rectified px.

        They are those since `since`, the rigid motion removed.

        Parameters
        ----------
        frame
            Index of the frame.

        Returns
        -------
        ndarray, shape (6, N)
        """
        moved = self._since(frame)
        motion = self._rigid(moved)
        return moved if motion is None else motion.removed(self._covariance.mesh.nodes, moved)

    def drawn(self, field: Quantity, values: FloatArray) -> tuple[FloatArray, npt.NDArray[np.int32]]:
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
        if not field.signed:
            return values, self.result.elements
        places, parts = self._parts
        return places.read(values), parts

    @cached_property
    def _parts(self) -> tuple[Places, npt.NDArray[np.int32]]:
        mesh = self.physical.mesh
        return Places.parts(mesh, int(np.clip((_PARTS / len(mesh.elements)) ** 0.5, 1, 4)))

    def places(self, points: FloatArray, element: IntArray) -> Places:
        """Take points of the image whose elements are known, to read nodal values there.

        Parameters
        ----------
        points : ndarray, shape (P, 2)
            Points (x, y) of the image, px.
        element : ndarray, shape (P,), int
            Their elements.

        Returns
        -------
        Places
        """
        return Places.within(Tri3Mesh(nodes=self.result.nodes, elements=self.result.elements), points, element)

    def strain_at(self, frame: int, x: float, y: float, length: float) -> dict[str, FloatArray]:
        """Compute the strain of one virtual gauge at a place of the image, px; each quantity, (1,), by its name.

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
        dict of str to ndarray, shape (1,)

        Raises
        ------
        InputError
            The place is outside the mesh, or the gauge is too short.
        """
        return named(self._strain_of(frame, self._gauge(*self.physical.rectified.place((x, y, length), 1))))

    @cached_property
    def _gauge(self) -> Callable[[float, float, float], StrainGauges]:
        """Virtual gauge at a place; those used last are kept: 15 ms each where there are 8,000 nodes."""
        return lru_cache(200)(
            lambda x, y, length: StrainGauges.at_points(self.physical.covariance, np.array([[x, y]]), length)
        )

    def _displacements(self, frames: Iterable[int]) -> Iterator[FloatArray]:
        return displacements(self.result, self.physical.rectified, frames)  # `physical` may be of an earlier state

    def _since(self, frame: int) -> FloatArray:
        """Return u, v and their uncertainties (6, N) since the frame that is the reference here."""
        moved = next(self._displacements([frame]))
        if self.since is None:
            return moved
        first, factor = self._first, self._common(frame)
        variance = moved[2:] ** 2 + first[2:] ** 2 - 2 * factor * np.minimum(moved[2:], first[2:]) ** 2
        return np.concatenate([moved[:2] - first[:2], np.sqrt(np.maximum(variance, 0))])

    @cached_property
    def _first(self) -> FloatArray:
        return next(self._displacements([self.since or 0]))

    def _common(self, frame: int) -> float:
        """Return the fraction of the smaller variance that a frame has in common with the one of `since`."""
        if frame == self.since:
            return 1.0
        references = reference_frames(self.result)[[frame, self.since or 0]]
        return float(frame_covariance(np.ones(2), shared_part(self.result), references)[0, 1])

    @cached_property
    def _covariance(self) -> NodalCovariance:
        """Correlation of the nodes' errors, with the nodes where they are at the reference."""
        if self.since is None:
            return self.physical.covariance
        mesh = self.physical.mesh
        places = mesh.nodes + np.nan_to_num(self._first[:2].T)
        return replace(self.physical.covariance, mesh=Tri3Mesh(nodes=places, elements=mesh.elements))

    def _rigid(self, moved: FloatArray) -> RigidMotion | None:
        """Fit the rigid motion that is removed; None where none is, or fewer than two nodes are measured."""
        fits = self.rigid_removed and np.isfinite(moved).all(axis=0).sum() > 1
        return RigidMotion.of(self._covariance, *moved) if fits else None

    @cached_property
    def _strain(self) -> Callable[[int], Mapping[str, FloatArray]]:
        """Strain by name of a frame; of the last two it is kept, for several fields of one frame."""
        return lru_cache(2)(lambda frame: named(self._strain_of(frame, self.physical.gauges)))

    def _strain_of(self, frame: int, gauges: StrainGauges) -> Strain:
        moved = next(self._displacements([frame]))
        if self.since is None:
            gradient, covariance = gauges.gradient(*moved)
        else:  # both gradients of the same nodes, which have data in both frames
            both, factor = np.isfinite(moved + self._first).all(axis=0), self._common(frame)
            now, first = np.where(both, moved, np.nan), np.where(both, self._first, np.nan)
            smaller = np.sqrt(abs(factor)) * np.minimum(now[2:], first[2:])
            shared = np.sign(factor) * gauges.gradient(*now[:2], *smaller)[1]
            gradient, covariance = _composed(gauges.gradient(*now), gauges.gradient(*first), shared)
        motion = self._rigid(self._since(frame))
        if motion is not None:
            c, s = np.cos(motion.rotation), np.sin(motion.rotation)
            back = np.array([[c, s], [-s, c]])
            wide = np.kron(back, np.eye(2))
            gradient, covariance = back @ (np.eye(2) + gradient) - np.eye(2), wide @ covariance @ wide.T
        return strain_of_gradient(gradient, covariance, self.physical.measure)

    def _rates(self, name: str, frame: int, order: int) -> FloatArray:
        """Return the derivative of an order of a field against the test's reference, and its uncertainty, (2, N)."""
        places = np.flatnonzero(self._there == frame)
        if not len(places):  # not measured yet
            return np.full((2, len(self.result.nodes)), np.nan)
        block, row = divmod(int(places[0]), _AROUND * self.window)
        return self._block(name, block)[order - 1, :, row]

    @cached_property
    def _there(self) -> IntArray:
        return np.flatnonzero(self.result.finished)

    @cached_property
    def _units(self) -> Units:
        """Units with that of time, for which one frame is read: `_clock` reads all."""
        first = next(iter(self.result.each("time_ns", self._there[:1])), UNKNOWN_TIME)
        scale = self.physical.scale or self.result.section(ScaleSettings)
        rate = scale.frame_rate or self.result.provenance.get("frame_rate")
        return replace(self.physical.units, timed=bool(rate) or first != UNKNOWN_TIME)

    @cached_property
    def _clock(self) -> FloatArray:
        """Times of the frames that are measured, or their numbers where no time is known."""
        times = frame_times(self.result, self.physical.scale)
        if times is None and self._units.timed:
            raise InputError("rates need the times of all frames, of which some have none: state frame_rate in [scale]")
        clock = self.result.number if times is None else times
        return np.asarray(clock[self._there], dtype=np.float64)

    @cached_property
    def _block(self) -> Callable[[str, int], FloatArray]:
        """Rates (2 orders, value and uncertainty, frames, N) of a block of frames; those used last are kept."""
        return lru_cache(4)(self._rates_of)

    def _rates_of(self, name: str, block: int) -> FloatArray:
        """Compute rates of a field from the frames of a block and those around: the same whichever is asked for."""
        taken = rate_frames(self.window, len(self._there))
        size = _AROUND * self.window
        inner = slice(block * size, min((block + 1) * size, len(self._there)))
        outer = slice(max(inner.start - size, 0), inner.stop + size)
        frames, clock = self._there[outer], self._clock[outer]
        plain = replace(self, since=None, rigid_removed=False)
        if name in UV:
            each = (moved[UV.index(name) : 4 : 2] for moved in self._displacements(frames.tolist()))
        else:
            each = (np.stack(plain._derived(name, frame)) for frame in frames.tolist())
        series = np.stack([*each], axis=1)
        span = (taken - 1) * float(np.median(np.diff(self._clock)))
        common, references = shared_part(self.result), reference_frames(self.result)[frames]
        mine = slice(inner.start - outer.start, inner.stop - outer.start)
        found = np.empty((2, 2, inner.stop - inner.start, series.shape[2]))
        for start in range(0, series.shape[2], _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            made = rates(clock, *series[..., part], window=span, common_fraction=common, references=references)
            for order, quantity in enumerate(("velocity", "acceleration")):
                found[order, 0, :, part] = getattr(made, quantity)[mine]
                found[order, 1, :, part] = getattr(made, f"{quantity}_std")[mine]
        return found


def _composed(
    now: tuple[FloatArray, FloatArray], first: tuple[FloatArray, FloatArray], shared: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Compute the displacement gradient from one state to another, ``F_now F_first⁻¹ - I``, and its covariance.

    With ``A = I ⊗ F_first⁻ᵀ`` and ``B = (F_now F_first⁻¹) ⊗ F_first⁻ᵀ`` its change is ``A d(now) - B d(first)``, both
    row by row; `shared` (G, 4, 4) is the covariance between both gradients.
    """
    inverse = np.linalg.inv(np.eye(2) + first[0])
    whole = (np.eye(2) + now[0]) @ inverse
    a = np.einsum("ij,glk->gikjl", np.eye(2), inverse).reshape(-1, 4, 4)
    b = np.einsum("gij,glk->gikjl", whole, inverse).reshape(-1, 4, 4)
    turned = [np.swapaxes(part, 1, 2) for part in (a, b)]
    cross = a @ shared @ turned[1]
    covariance = a @ now[1] @ turned[0] + b @ first[1] @ turned[1] - cross - np.swapaxes(cross, 1, 2)
    return whole - np.eye(2), covariance
