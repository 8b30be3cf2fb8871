"""Settings of a test, as TEST.toml states them: their schema, the conversion of its values, reading it."""

from rgbmidic.arguments import bounded, convert_value, read_range, to_plain
from rgbmidic.renamed import refuse_old_names
from rgbmidic.settings.conversion import (
    check_names,
    read_section,
    read_table,
    read_toml,
    unique_keys,
)
from rgbmidic.settings.schema import (
    PROBE_NAME,
    ChannelSettings,
    ProbeSettings,
    ScaleSettings,
    SetupSettings,
    TestSettings,
    read_test,
)
from rgbmidic.settings.sections import (
    BAYER_PATTERNS,
    ELEMENT_SIZE,
    LENGTH_UNITS,
    SMALLEST_HALVED,
    CalibrationSettings,
    FrameCheck,
    FrameKind,
    FrameSettings,
    IlluminationSettings,
    MeshSettings,
    RegionSettings,
    SolverOptions,
    SolverSettings,
    WeightSettings,
)

__all__ = [
    "BAYER_PATTERNS",
    "ELEMENT_SIZE",
    "LENGTH_UNITS",
    "PROBE_NAME",
    "SMALLEST_HALVED",
    "CalibrationSettings",
    "ChannelSettings",
    "FrameCheck",
    "FrameKind",
    "FrameSettings",
    "IlluminationSettings",
    "MeshSettings",
    "ProbeSettings",
    "RegionSettings",
    "ScaleSettings",
    "SetupSettings",
    "SolverOptions",
    "SolverSettings",
    "TestSettings",
    "WeightSettings",
    "bounded",
    "check_names",
    "convert_value",
    "read_range",
    "read_section",
    "read_table",
    "read_test",
    "read_toml",
    "to_plain",
    "unique_keys",
]

__getattr__ = refuse_old_names(__name__)
