"""The settings of a test: frozen, read from TOML, validated once, here.

Paths in the file are relative to the file. Only ``frames.path``, a region and, for colour frames,
``calibration.file`` are needed; an unknown key is an error that names it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from rgbmidic.errors import ConfigurationError

__all__ = [
    "FrameKind",
    "FrameSettings",
    "IlluminationSettings",
    "RegionSettings",
    "ScaleSettings",
    "SolverSettings",
    "TestSettings",
    "WeightSettings",
]

FrameKind = Literal["bayer", "rgb", "monochrome"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSettings:
    """Where the frames are and what the files do not tell (``[frames]``).

    Attributes
    ----------
    path
        File patterns or folders, one per light fired in succession (monochrome); a single one otherwise.
    kind
        None: what the file tells, else ``"bayer"``.
    cfa, black_level, white_level
        None: what the file tells. A statement that contradicts the file is an error.
    reference
        Indices of the frames whose average is the reference.
    shape, dtype
        Rows and columns, and sample type, of headerless files.
    """

    path: tuple[str, ...]
    kind: FrameKind | None = None
    cfa: str | None = None
    black_level: float | None = None
    white_level: float | None = None
    reference: tuple[int, ...] = (0,)
    shape: tuple[int, int] | None = None
    dtype: Literal["uint8", "uint16", ">u2"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class IlluminationSettings:
    """How the frame becomes one image per light (``[illumination]``)."""

    demosaic: str = "malvar"


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionSettings:
    """The region of interest (``[region]``): exactly one of the three.

    Attributes
    ----------
    rectangle
        (x0, y0, x1, y1) in px.
    polygon
        Corners (x, y) in px.
    mask
        Image file; non-zero pixels belong to the region.
    """

    rectangle: tuple[float, float, float, float] | None = None
    polygon: tuple[tuple[float, float], ...] | None = None
    mask: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class WeightSettings:
    """How each light is weighted (``[weights]``), the paper's second method by default.

    Attributes
    ----------
    method
        ``"threshold"``: 0 where the blurred image exceeds `threshold`, 1 elsewhere; ``"none"``: 1 everywhere.
    threshold
        Fraction of the camera's dynamic range (the paper: 2/3).
    blur
        Standard deviation of the Gaussian blur in px; several speckles wide.
    """

    method: Literal["threshold", "none"] = "threshold"
    threshold: float = 2 / 3
    blur: float = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverSettings:
    """The MIDIC minimisation (``[solver]``).

    Attributes
    ----------
    prefilter
        Filter on reference and deformed images: ``"none"``, ``"binomial"`` ([1 2 1] in x and y, zero at the Bayer
        carriers) or ``"gaussian"`` (standard deviation 1 px).
    rigid
        Rigid functions per light after the first: ``"none"``, ``"translation"`` or ``"translation+rotation"``.
    search_radius
        Largest motion in px that the coarse start looks for.
    tolerance
        The iteration stops when no node moves by more than this (px).
    max_iterations
        Iterations before the frame counts as not converged.
    """

    prefilter: Literal["none", "binomial", "gaussian"] | None = None
    rigid: Literal["none", "translation", "translation+rotation"] = "none"
    search_radius: float = 64.0
    tolerance: float = 1e-3
    max_iterations: int = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleSettings:
    """Physical units (``[scale]``)."""

    mm_per_pixel: float | None = None
    frame_rate: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TestSettings:
    """Everything `rgbmidic.pipeline.measure` needs to know about a test."""

    __test__ = False

    frames: FrameSettings
    region: RegionSettings
    calibration_file: Path | None = None
    element_size: float = 25.0
    illumination: IlluminationSettings = field(default_factory=IlluminationSettings)
    weights: WeightSettings = field(default_factory=WeightSettings)
    solver: SolverSettings = field(default_factory=SolverSettings)
    scale: ScaleSettings = field(default_factory=ScaleSettings)
    base: Path = field(default_factory=Path)
