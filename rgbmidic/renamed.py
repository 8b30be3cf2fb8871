"""Names that changed since the last version: whoever uses an old one reads the new one in one line."""

from collections.abc import Callable, Mapping
from typing import Any, NoReturn, TypeVar

T = TypeVar("T")

_STRAIN = {
    f"{name}{suffix}": f"nodal_{name}{suffix}"
    for name in ("exx", "eyy", "exy")
    for suffix in ("", "_std", "_mesh_error")
}
_NAMES: Mapping[str, Mapping[str, str]] = {
    "rgbmidic.errors": {
        "legible": "printable",
        "shortened": "shorten",
        "optional": "import_optional",
        "disk_faults": "convert_disk_errors",
    },
    "rgbmidic.correlation": {"Start": "TrackingState", "find_start": "find_initial_guess"},
    "rgbmidic.typing": {"Progress": "ProgressCallback"},
    "rgbmidic.results": {
        "Quantity": "ResultQuantity",
        "shared_part": "common_variance_fraction",
        "History": "Field",
        "MapValues": "Field",
    },
    "rgbmidic.tools.finite_elements.comparison": {"QUANTITIES": "COMPARED_QUANTITIES", "WAYS": "VARIANTS"},
    "rgbmidic.tools.finite_elements.simulation": {"place": "find_placement", "places_among": "label_indices"},
    "rgbmidic.tools.report": {"Movie": "FieldMovie"},
    "rgbmidic.frames": {"Movie": "MovieSource", "known_formats": "frame_formats"},
    "rgbmidic.settings": {"regular": "rgbmidic.disk.require_regular_file", "plain": "to_plain"},
    "Deformed": {"pictures": "images_on_first_light", "partial": "nonuniform_weight_blocks"},
    "Reference": {"unfitted": "residual_leverage"},
    "Precision": {"bend": "loss_curvature"},
    "rgbmidic.fields": {"Places": "MeshPoints", "Nodal": "Displacement", "History": "Field"},
    "MeshPoints": {"parts": "subdivide", "where": "bounds_text"},
    "NodalCovariance": {"part": "subset"},
    "ProfileLine": {"places": "mesh_points", "even": "is_two_sided"},
    "Mean": {"least": "min_fraction"},
    "StrainGauges": {"whole": "full_weights"},
    "Rectification": {"place": "probe_coordinates"},
    "Statistics": {"own": "independent_fraction"},
    "FrameSource": {"stated": "user_metadata"},
    "Window": {"whole": "of_frame", "around": "around_points", "part_of": "slices_in"},
    "Tri3Mesh": {
        "part": "submesh",
        "places": "observation_points",
        "nearest": "nearest_nodes",
        "beside": "adjacent_nodes",
        "one_of_copies": "merged_index",
    },
    "Region": {"part": "crop"},
    "FiniteElementMesh": {"part": "subset"},
    "IlluminationImages": {"placed": "with_origin"},
    "Inspection": {"hidden": "lacks_contrast", "unmeasured": "unmeasured_fraction"},
    "Result": {**_STRAIN, "strain": "nodal_strain", "strain_std": "nodal_strain_std", "each": "iterate"},
    "FrameRecord": {**_STRAIN, "of": "from_values"},
    "Maps": {
        "of": "from_result",
        "all": "quantities",
        "chosen": "with_options",
        "how": "processing_note",
        "drawn": "triangulate",
        "places": "points_in_elements",
    },
    "Channels": {"named": "values_of", "shifted": "with_offset", "aligned": "align", "at": "interpolate"},
    "Profile": {"how": "processing_note", "kind": "covariance_key"},
    "Wave": {"what": "feature"},
    "ResultQuantity": {
        "meaning": "description",
        "parts": "base_quantities",
        "ends": "fixed_range",
        "text": "format",
        "of": "read_from",
        "in_units": "with_units",
        "signed": "is_signed",
        "logarithmic": "is_logarithmic",
        "stackable": "is_stackable",
        "estimated": "is_estimated",
    },
    "Comparison": {"each": "iterate", "left_out": "frames_outside", "timed": "has_times"},
    "Simulation": {"at": "interpolate"},
    "FieldMovie": {"chosen": "frame_indices", "stated": "stated_limits"},
    "Curve": {"timed": "has_times"},
}
"""New names by the old ones, of modules and classes; with its module where that is another one."""


def refuse_old_names(module: str) -> Callable[[str], NoReturn]:
    """Return a ``__getattr__`` for a module, whose error states the new name."""

    def refuse(name: str) -> NoReturn:
        if new := _NAMES[module].get(name):
            place = new if "." in new else f"{module}.{new}"
            raise ImportError(f"{module}.{name} is now {place}")  # an AttributeError would lose its message
        raise AttributeError(f"module {module!r} has no attribute {name!r}")

    return refuse


class _OldName:
    """An attribute that only states its new name."""

    def __init__(self, message: str) -> None:
        self._message = message

    def __get__(self, instance: object, owner: type[Any] | None = None) -> NoReturn:
        raise AttributeError(self._message)


def state_new_names(cls: type[T]) -> type[T]:
    """Decorate a class so that an old attribute raises an error with the new name."""
    for old, new in _NAMES[cls.__name__].items():
        setattr(cls, old, _OldName(f"{cls.__name__}.{old} is now {cls.__name__}.{new}"))
    return cls
