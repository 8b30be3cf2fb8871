"""Where a mesh is from that is not made of the region: an object that places it on the image, and the labels it has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from rgbmidic.mesh.region import Region
from rgbmidic.mesh.tri3 import Tri3Mesh
from rgbmidic.settings import MeshSettings
from rgbmidic.typing import FloatArray, IntArray


class Plane(Protocol):
    """Map between px of the image and mm on a plane: `rgbmidic.CameraCalibration`, and `Placement` of a mesh."""

    def to_mm(self, points: FloatArray) -> FloatArray:
        """Return where points of the image lie on the plane.

        Parameters
        ----------
        points : ndarray, shape (N, 2)
            Points (x, y) of the image, px; NaN stays NaN.

        Returns
        -------
        ndarray, shape (N, 2)
            In mm, in the axes of the plane.
        """

    def to_px(self, points: FloatArray) -> FloatArray:
        """Return the inverse of `to_mm`.

        Parameters
        ----------
        points : ndarray, shape (N, 2)
            Points of the plane, mm.

        Returns
        -------
        ndarray, shape (N, 2)
            Points (x, y) of the image, px.
        """

    def jacobian(self, points: FloatArray) -> FloatArray:
        """Return the derivative of `to_mm` by the pixel: ``[n, mm axis, px axis]``.

        Parameters
        ----------
        points : ndarray, shape (N, 2)
            Points (x, y) of the image, px.

        Returns
        -------
        ndarray, shape (N, 2, 2)
            In mm per px.
        """


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshLabels:
    """Names and positions that nodes and elements of a mesh have where it is from; a result keeps them.

    Attributes
    ----------
    name : str
        The mesh in messages: its file.
    node_number : ndarray, shape (N,), int64
        Labels of the nodes.
    element_number : ndarray, shape (E,), int64
        Labels of the elements that the triangles come from.
    node_mm : ndarray, shape (N, 2), float64
        Positions of the nodes in mm, in the mesh's own axes.
    document : mapping
        Plain values for the provenance, from which the source states the scale.

    Examples
    --------
    >>> import numpy as np
    >>> corners = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]])
    >>> labels = MeshLabels(
    ...     name="plate.inp",
    ...     node_number=np.array([11, 12, 17]),
    ...     element_number=np.array([4]),
    ...     node_mm=corners,
    ...     document={},
    ... )
    >>> labels.node_number.tolist()
    [11, 12, 17]
    """

    name: str
    node_number: IntArray
    element_number: IntArray
    node_mm: FloatArray
    document: Mapping[str, Any]


class MeshSource(Protocol):
    """The mesh of a test, in place of the one that is made of its region (`rgbmidic.extensions.MESH_SOURCES`).

    Examples
    --------
    >>> from rgbmidic.extensions import MESH_SOURCES
    >>> source: MeshSource = MESH_SOURCES["finite_elements"]()
    >>> pairs = [[0, 0, 0, 100], [10, 0, 40, 100]]
    >>> document = {"placement": {"matrix": [[4, 0], [0, -4]], "shift": [0, 100], "pairs": pairs}}
    >>> [round(number, 6) for number in source.scale(document)]
    [0.25, 0.0]
    """

    def place(
        self, settings: MeshSettings, region: Region, camera: Plane | None
    ) -> tuple[Tri3Mesh, Region, MeshLabels]:
        """Return the mesh that is measured, in px of the frame, the pixels that it covers, and its labels.

        Parameters
        ----------
        settings
            The section ``[mesh]``.
        region
            What it is restricted to, on the whole frame.
        camera
            Lens and plane, where ``scale.camera`` states them.

        Returns
        -------
        tuple of Tri3Mesh, Region and MeshLabels
        """

    def scale(self, document: Mapping[str, Any]) -> tuple[float | None, float]:
        """Return the mm per px that the document of a mesh without a camera states, and its standard uncertainty.

        Parameters
        ----------
        document
            That of its `MeshLabels`.

        Returns
        -------
        tuple of float or None, and float
        """
