"""A quantity with its standard uncertainty, and what is read of a result.

Histories, profiles, maps, figures, movies, exports and reports pass each other `Field` objects, and read them from a
`FieldSource`. Neither knows how many components a displacement has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
import numpy.typing as npt

from rgbmidic.typing import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from rgbmidic.fields import NodalCovariance, Rectification, Units
    from rgbmidic.mesh import Tri3Mesh
    from rgbmidic.results import ResultQuantity


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Field:
    """A quantity with its standard uncertainty: at nodes, along a line, or over the frames.

    Attributes
    ----------
    name
        Such as ``"exx"`` of a map or ``"point_1_u"`` of a history.
    unit
        Empty where there is none.
    dims
        Name of each axis of the arrays, such as ``("frame", "node")``.
    values : ndarray
        NaN where not measured.
    std : ndarray of the same shape, or None
        Standard uncertainty; None for what has none, NaN where it is not known.
    bias : ndarray of the same shape, or None
        The part of `std` that nodes near each other have in common, which the bias of the lights leaves; None: nothing.
    common : ndarray, shape (M, ...), or None
        Errors, part of `std`, that M independent causes of a calibration make in all places and frames together.
    note
        What a reader should know of it, else empty.

    Examples
    --------
    >>> u = Field(name="point_1_u", unit="mm", dims=("frame",), values=np.array([0.0, 0.5]), std=np.array([0.0, 0.01]))
    >>> u.column, u.isel(frame=[1]).values
    ('point_1_u_mm', array([0.5]))
    """

    name: str
    values: FloatArray
    std: FloatArray | None = None
    unit: str = ""
    dims: tuple[str, ...] = ("frame",)
    bias: FloatArray | None = None
    common: FloatArray | None = None
    note: str = ""

    @property
    def column(self) -> str:
        """Name of its column in a table, with the unit."""
        return column(self.name, self.unit)

    @property
    def uncertainty(self) -> FloatArray:
        """The standard uncertainty as an array: NaN where there is none."""
        return np.full_like(self.values, np.nan) if self.std is None else self.std

    @property
    def bias_std(self) -> FloatArray:
        """The `bias` as an array: 0 where there is none."""
        return np.zeros_like(self.values) if self.bias is None else self.bias

    @property
    def noise(self) -> Self:
        """The field without the `common` errors in its uncertainty."""
        if self.common is None:
            return self
        variance = self.uncertainty**2 - (self.common**2).sum(axis=0)
        return replace(self, std=np.sqrt(np.maximum(variance, 0)), common=None)

    def with_common(self, errors: FloatArray) -> Self:
        """Return the field with errors that all places and frames have in common, as part of its uncertainty.

        Parameters
        ----------
        errors : ndarray, shape (M, ...)
            See `common`; the field has none so far.

        Returns
        -------
        Field
        """
        return replace(self, std=np.hypot(self.uncertainty, np.linalg.norm(errors, axis=0)), common=errors)

    def with_arrays(self, function: Callable[..., Any], *others: Self) -> Self:
        """Return the field with a function of each of its arrays, and of the same array of other fields.

        Parameters
        ----------
        function
            Takes the values, then the standard uncertainties and so on, each that the field has.
        *others
            Fields whose arrays are handed to the function too.

        Returns
        -------
        Field
        """
        names = [entry.name for entry in fields(self) if isinstance(getattr(self, entry.name), np.ndarray)]
        arrays = {name: function(*(getattr(one, name) for one in (self, *others))) for name in names}
        return replace(self, **arrays)

    def isel(self, **indices: int | slice | IntArray | BoolArray | list[int]) -> Self:
        """Select along axes by their names.

        Parameters
        ----------
        **indices
            Index of each axis: a number, which drops the axis, a slice or an array.

        Returns
        -------
        Field
        """
        selected = self
        for dim, index in indices.items():
            axis = selected.dims.index(dim) - len(selected.dims)  # from the end: a covariance has one more in front
            key = (..., index, *[slice(None)] * (-1 - axis))
            dims = tuple(name for name in selected.dims if name != dim or not isinstance(index, int | np.integer))
            selected = replace(selected.with_arrays(lambda array, key=key: array[key]), dims=dims)
        return selected

    @classmethod
    def concatenate(cls, parts: Sequence[Self], dim: str = "frame") -> Self:
        """Join fields along one of their axes, or along a new one before the last.

        Parameters
        ----------
        parts
            Fields of the same axes.
        dim
            Name of the axis.

        Returns
        -------
        Field
        """
        first, *others = parts
        if dim in first.dims:
            axis = first.dims.index(dim) - len(first.dims)
            return first.with_arrays(lambda *arrays: np.concatenate(arrays, axis=axis), *others)
        stacked = first.with_arrays(lambda *arrays: np.stack(arrays, axis=-2), *others)
        return replace(stacked, dims=(*first.dims[:-1], dim, first.dims[-1]))

    @property
    def is_doubtful(self) -> BoolArray:
        """Mask of the values that lie within two standard uncertainties of 0."""
        return np.asarray(np.abs(self.values) < 2 * self.uncertainty)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Displacement(Field):
    """Displacement of nodes: a `Field` whose first axis is that of its components, u and v, in space also w.

    Attributes
    ----------
    values, std, bias : ndarray, shape (c, ..., N)
        As of `Field`, for each of the c components.
    covariance : ndarray, shape (c, c, ..., N), or None
        Of the errors of the components at a node, whose diagonal is the square of `std`; None: they are independent.

    Examples
    --------
    >>> zero = np.zeros((1, 3))
    >>> still = Displacement.in_plane(zero, zero, zero + 0.01, zero + 0.01)  # of 3 nodes in a frame
    >>> [(component.name, component.dims, component.unit) for component in still.components]
    [('u', ('frame', 'node'), 'px'), ('v', ('frame', 'node'), 'px')]
    """

    name: str = "displacement"
    unit: str = "px"
    dims: tuple[str, ...] = ("component", "frame", "node")
    covariance: FloatArray | None = None

    @classmethod
    def in_plane(cls, u: npt.ArrayLike, v: npt.ArrayLike, *std: npt.ArrayLike) -> Self:
        """Take u and v, their standard uncertainties, and what the bias of the lights leaves of these.

        Parameters
        ----------
        u, v : array_like, shape (N,) or (T, N)
            Displacement in px; NaN where a node has no data.
        *std : array_like of the same shape
            u_std and v_std, u_bias and v_bias; those that are not given, or NaN at a node with data, are not known,
            or 0.

        Returns
        -------
        Displacement
        """
        pairs = [np.stack(np.broadcast_arrays(*pair)).astype(np.float64) for pair in ((u, v), std[:2], std[2:]) if pair]
        values, total, bias = [*pairs, None, None][:3]
        assert values is not None
        if bias is not None and total is not None:
            bias = np.where(np.isnan(bias) & np.isfinite(total), 0.0, bias)
        return cls(dims=("component", *("frame", "node")[3 - values.ndim :]), values=values, std=total, bias=bias)

    @property
    def components(self) -> tuple[Field, ...]:
        """Each component as a field, named u, v and w."""
        arrays = zip("uvw", self.values, self.uncertainty, self.bias_std, strict=False)
        more: dict[str, Any] = {"unit": self.unit, "dims": self.dims[1:]}
        return tuple(Field(name=name, values=values, std=std, bias=bias, **more) for name, values, std, bias in arrays)

    def smaller(self, second: Self) -> Self:
        """Return the displacement with the smaller one of the uncertainties of two, at each node.

        Parameters
        ----------
        second
            Of the same nodes.

        Returns
        -------
        Displacement
        """
        separate = replace(self, covariance=None).with_arrays(np.minimum, replace(second, covariance=None))
        separate = replace(separate, values=self.values)
        if self.covariance is None or second.covariance is None:
            return separate
        traces = (np.einsum("ii...->...", matrix) for matrix in (self.covariance, second.covariance))
        return replace(separate, covariance=np.where(np.less(*traces), self.covariance, second.covariance))

    def since(self, base: Self, common_fraction: float) -> Self:
        """Return the displacement since another frame.

        Parameters
        ----------
        base
            Displacement of the same nodes in that frame.
        common_fraction
            Fraction of the smaller variance that both have in common.

        Returns
        -------
        Displacement
        """
        smaller = self.smaller(base)

        def difference(std: FloatArray, base_std: FloatArray, smaller_std: FloatArray) -> FloatArray:
            return np.sqrt(np.maximum(std**2 + base_std**2 - 2 * common_fraction * smaller_std**2, 0))

        states = [replace(state, covariance=None) for state in (self, base, smaller)]
        relative = replace(states[0].with_arrays(difference, *states[1:]), values=self.values - base.values)
        if self.covariance is None or base.covariance is None or smaller.covariance is None:
            return relative
        covariance = self.covariance + base.covariance - 2 * common_fraction * smaller.covariance
        std = np.sqrt(np.maximum(np.einsum("ii...->i...", covariance), 0))
        return replace(relative, covariance=covariance, std=std)

    @property
    def error_factor(self) -> FloatArray:
        """Factor F of the covariance ``F F^T`` of the errors at a node, shape (c, c, ..., N); 0 where not known."""
        if self.covariance is None:
            std = np.nan_to_num(self.uncertainty)
            return np.asarray(np.einsum("ij,j...->ij...", np.eye(len(std)), std))
        variances, axes = np.linalg.eigh(np.moveaxis(np.nan_to_num(self.covariance), (0, 1), (-2, -1)))
        # the symmetric root: from node to node it changes as little as the covariance, and the errors are correlated
        root = (axes * np.sqrt(np.maximum(variances, 0))[..., None, :]) @ np.swapaxes(axes, -1, -2)
        return np.asarray(np.moveaxis(root, (-2, -1), (0, 1)))

    @property
    def is_measured(self) -> BoolArray:
        """Mask of the nodes all components of which are measured, shape (..., N)."""
        return np.asarray(np.isfinite(self.values + self.uncertainty).all(axis=0))


class FieldSource(Protocol):
    """A result with T frames and N nodes as histories, profiles, maps, figures, movies and reports read it.

    `rgbmidic.results.result_in_units.ResultInUnits` is one, with two components in a plane. A third component is added
    by another source, and by nothing else: its `displacement` has three rows and their covariance, `components` three
    names, `points` three coordinates in the unit of the displacement, while `mesh` stays flat, in px of an image. It is
    where probes and lines are placed, and where fields are interpolated between nodes.
    """

    @property
    def path(self) -> Path:
        """Folder or file of the result, for messages."""

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each frame, length T."""

    @property
    def number(self) -> IntArray:
        """Number of each frame, with gaps where frames are lost, shape (T,)."""

    @property
    def status(self) -> IntArray:
        """Status of each frame, shape (T,)."""

    @property
    def finished(self) -> BoolArray:
        """Mask of the frames that are measured, shape (T,)."""

    @property
    def references(self) -> BoolArray:
        """Mask of the frames that belong to the reference, shape (T,)."""

    @property
    def common_fraction(self) -> float:
        """Fraction of a frame's variance that all frames have in common, that of the reference."""

    @property
    def exposure(self) -> float:
        """Exposure of a frame in s; 0 where it is not known."""

    @property
    def remarks(self) -> Iterable[str]:
        """Remarks on the lengths, a line each."""

    @property
    def rectified(self) -> Rectification | None:
        """Change from px of the image, in which probes are placed, to those of `mesh`; None: they are the same."""

    @property
    def seconds(self) -> FloatArray | None:
        """Time of each frame in s, shape (T,); None where no time is known."""

    @property
    def units(self) -> Units:
        """Units of lengths and time."""

    @property
    def mesh(self) -> Tri3Mesh:
        """The mesh in the plane in which probes are placed."""

    @property
    def points(self) -> FloatArray:
        """Places of the nodes on the undeformed surface in the unit of the displacement, shape (N, 2) or (N, 3)."""

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the components of the displacement."""

    @property
    def covariance(self) -> NodalCovariance:
        """Correlation of the nodes' errors."""

    @property
    def quantities(self) -> Mapping[str, ResultQuantity]:
        """Every field that can be read, by its name."""

    def displacement(self, frame: int) -> Displacement:
        """Read the displacement of all nodes in a frame, in its own unit; axes ("component", "node")."""

    def field(self, name: str, frame: int) -> Field:
        """Read one of the `quantities` with its standard uncertainty in a frame, in the reader's unit."""


def column(name: str, unit: str) -> str:
    """Return the name of a column with its unit in plain letters: `u` in ``"mm/s²"`` is ``"u_mm_per_s2"``.

    Parameters
    ----------
    name
        Of the quantity.
    unit
        Its unit; empty for none.

    Returns
    -------
    str
    """
    plain = unit.replace("²", "2").replace(" √", "_sqrt_")
    over, _, below = plain.partition("/")
    words = [word for word in ("" if over == "1" else over, f"per_{below}" if below else "") if word]
    return "_".join([name, *words])
