"""The mesh of ``mesh.file`` for a test: read, placed on the image, and read back from a result."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rgbmidic.errors import ConfigurationError
from rgbmidic.frames import file_hash
from rgbmidic.mesh import MeshLabels, Region, Tri3Mesh
from rgbmidic.mesh.source import Plane
from rgbmidic.results.result_in_units import stored_camera
from rgbmidic.settings import MeshSettings
from rgbmidic.tools.finite_elements.files import read_mesh
from rgbmidic.tools.finite_elements.mesh import FiniteElementMesh
from rgbmidic.tools.finite_elements.placement import Placement, place_on_image

if TYPE_CHECKING:
    from rgbmidic.results import Result

logger = logging.getLogger(__name__)


class MeshFile:
    """Finite elements of ``mesh.file`` where ``mesh.points`` place them; a `rgbmidic.mesh.MeshSource`."""

    def place(
        self, settings: MeshSettings, region: Region, camera: Plane | None
    ) -> tuple[Tri3Mesh, Region, MeshLabels]:
        """Return the part of the file's mesh that is measured, the pixels that it covers, and its labels."""
        if settings.file is None:
            raise ConfigurationError("mesh.file names no mesh")
        placement = Placement.fit(settings.points or (), camera)
        logger.info("mesh.points: %s", placement.summary())
        whole_mesh = read_mesh(settings.file, unit=settings.unit or "mm", part=settings.part)
        fe_mesh, mesh, covered = place_on_image(whole_mesh, placement, region.mask.shape, region)
        return mesh, covered, labels_of(fe_mesh, placement)

    def scale(self, document: Mapping[str, Any]) -> tuple[float | None, float]:
        """Return the mm per px of the placement, and its standard uncertainty."""
        placement = Placement.from_document(document["placement"])
        return placement.mm_per_pixel, placement.mm_per_pixel_std


def labels_of(fe_mesh: FiniteElementMesh, placement: Placement) -> MeshLabels:
    """Return what a result keeps of the mesh of a file and of where it lies on the image."""
    document = {
        **{key: getattr(fe_mesh, key) for key in ("name", "axes", "unit_mm", "numbering")},
        "sha256": file_hash(Path(fe_mesh.name)),
        "placement": placement.to_document(),
    }
    return MeshLabels(
        name=fe_mesh.name,
        node_number=fe_mesh.node_numbers,
        element_number=fe_mesh.element_numbers,
        node_mm=fe_mesh.points,
        document=document,
    )


def placement_of(result: Result) -> Placement | None:
    """Return where the mesh of ``mesh.file`` lies on the image; None where the result has none.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    Placement or None

    Examples
    --------
    >>> from rgbmidic import Result
    >>> placement_of(Result.open("my_result")) is None  # its mesh is of no file
    True
    """
    document = result.provenance.get("finite_elements")
    return None if document is None else Placement.from_document(document["placement"], stored_camera(result))


def measured_mesh(result: Result) -> FiniteElementMesh | None:
    """Return the part of ``mesh.file`` that a result was measured on; None where it has none.

    Parameters
    ----------
    result
        The result.

    Returns
    -------
    FiniteElementMesh or None

    Examples
    --------
    >>> from rgbmidic import Result
    >>> measured_mesh(Result.open("my_result")) is None  # its mesh is of no file
    True
    """
    if result.node_number is None or result.element_number is None or result.node_mm is None:
        return None
    document = result.provenance["finite_elements"]
    return FiniteElementMesh(
        name=document["name"],
        points=result.node_mm,
        node_numbers=result.node_number,
        elements=result.elements,
        element_numbers=result.element_number,
        numbering=document["numbering"],
    )
