"""Sections of a calibration from capture files, and several calibration files merged into one.

Noise, crosstalk and registration are often measured on different days, hence the merging.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.frames.data import ChannelFrame, Mosaic, planes_of
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.frame_check import unevenness
from rgbmidic.settings import FrameSettings
from rgbmidic_calibration.captures import CaptureFiles, provenance, stack_frames
from rgbmidic_calibration.crosstalk import CrosstalkEstimate, estimate_crosstalk
from rgbmidic_calibration.noise import NoiseEstimate, photon_transfer
from rgbmidic_calibration.ratio import BlockMeans, block_means
from rgbmidic_calibration.registration import ELEMENT, RegistrationEstimate, estimate_registration

__all__ = [
    "calibrate_crosstalk",
    "calibrate_noise",
    "calibrate_registration",
    "captures_as_stated",
    "field_order",
    "find_groups",
    "merge_files",
]

LIT = 0.1
"""Mean above black, relative to the full scale, of a plane whose histogram is looked at: in the dark, noise is too
little to smooth it. Some cameras apply gains of their own to red and blue, so all planes are."""


def captures_as_stated(statement: Mapping[str, Any]) -> FrameSettings:
    """Settings of the captures as options state them (`rgbmidic.command.read_statement`).

    Raises
    ------
    ConfigurationError
        An option has a value that is not allowed; the option is named.
    """
    try:
        return FrameSettings(path=("captures",), **statement)
    except ConfigurationError as error:
        as_options = re.sub(r"frames\.(\w+)", lambda key: "--" + key[1].replace("_", "-"), str(error))
        raise ConfigurationError(as_options) from None


def field_order(text: str) -> int | None:
    """Degree that ``--field`` states; None for ``auto``."""
    if text == "auto":
        return None
    if not text.isdecimal():
        raise ConfigurationError(f"--field is auto or a degree from 0, not {text!r}")
    return int(text)


def find_groups(
    lights: Mapping[str, str], dark: str | None, stated: FrameSettings
) -> tuple[dict[str, CaptureFiles], CaptureFiles | None]:
    """Files of every light and of the dark frames."""
    found = {name: CaptureFiles.find(f"light {name}", pattern, stated) for name, pattern in lights.items()}
    return found, None if dark is None else CaptureFiles.find("dark", dark, stated)


def calibrate_crosstalk(
    lights: Mapping[str, str],
    dark: str | None,
    stated: FrameSettings,
    *,
    block: int = 16,
    order: int | None = None,
    allow: Sequence[str] = (),
) -> tuple[Calibration, CrosstalkEstimate]:
    """Crosstalk section from capture files: patterns by light, pattern of the dark frames, what is stated of them."""
    found, dark_files = find_groups(lights, dark, stated)
    uneven: list[float] = []
    means = {name: _reduce(files, block, uneven) for name, files in found.items()}
    dark_means = _reduce(dark_files, block, uneven) if dark_files else []
    groups = [*found.values(), *([dark_files] if dark_files else [])]
    labels = {group.role.removeprefix("light "): group.labels for group in groups}
    estimate = estimate_crosstalk(means, dark_means, order=order, allow=allow, labels=labels)
    details = {
        "block": block,
        "waived_checks": list(allow),
        "warnings": list(estimate.warnings),
        "variation_over_field": {
            fit.name: {"p_value": fit.variation.p_value, "rms": fit.variation.rms} for fit in estimate.lights
        },
    }
    calibration = Calibration(
        crosstalk=estimate.crosstalk,
        provenance={"crosstalk": provenance("crosstalk", groups, details)},
        **_camera(groups[0], uneven),
    )
    return calibration, estimate


def calibrate_noise(dark: str, flats: Sequence[str], stated: FrameSettings) -> tuple[Calibration, NoiseEstimate]:
    """Noise section from capture files.

    Parameters
    ----------
    dark
        Pattern of the dark frames.
    flats
        Patterns of the flat frames. A pattern ``TIME=FILES`` is one exposure with its time; else the files of every
        folder are one exposure.
    stated
        What is stated of the files.
    """
    dark_files = CaptureFiles.find("dark", dark, stated)
    groups = [group for text in flats for group in _exposures(text, stated)]
    dark_stack = stack_frames(dark_files.frames(), drifts=False, name="the dark frames")
    stacks = [stack_frames(files.frames(), exposure=time, name=files.role) for files, time in groups]
    estimate = photon_transfer(dark_stack, stacks)
    all_files = [dark_files, *(files for files, _ in groups)]
    details = {"warnings": list(estimate.warnings), "exposures": [time for _, time in groups]}
    uneven = [value for files, _ in groups for value in _unevenness(next(files.frames()))]
    return Calibration(
        camera_noise=estimate.camera_noise,
        provenance={"noise": provenance("noise", all_files, details)},
        **_camera(dark_files, uneven),
    ), estimate


def calibrate_registration(
    lights: Mapping[str, str],
    dark: str | None,
    stated: FrameSettings,
    *,
    region: Sequence[float] | None = None,
    element_size: float = ELEMENT,
) -> tuple[Calibration, RegistrationEstimate]:
    """Registration section from capture files of a speckled target: patterns by light, the first is the reference."""
    found, dark_files = find_groups(lights, dark, stated)
    dark_stack = stack_frames(dark_files.frames(), drifts=False, name="the dark frames") if dark_files else None
    stacks = {name: stack_frames(files.frames(), name=files.role) for name, files in found.items()}
    estimate = estimate_registration(stacks, dark_stack, region=region, element_size=element_size)
    groups = [*found.values(), *([dark_files] if dark_files else [])]
    details = {
        "warnings": list(estimate.warnings),
        "region": None if region is None else list(region),
        "element_size": element_size,
        "residual_rms_px": {match.name: match.rms for match in estimate.matches},
    }
    return Calibration(
        registration=estimate.registration,
        provenance={"registration": provenance("registration", groups, details)},
        **_camera(groups[0], [value for files in found.values() for value in _unevenness(next(files.frames()))]),
    ), estimate


def _exposures(text: str, stated: FrameSettings) -> list[tuple[CaptureFiles, float | None]]:
    time, separator, pattern = text.partition("=")
    if separator:
        try:
            return [(CaptureFiles.find(f"flat exposure {time}", pattern, stated), float(time))]
        except ValueError:
            raise ConfigurationError(f"--flat takes FILES or TIME=FILES with a number as time, not {text!r}") from None
    return [(files, None) for files in CaptureFiles.find(f"flat {text}", text, stated).by_folder()]


def _unevenness(capture: Mosaic | ChannelFrame) -> list[float]:
    """Unevenness of the histogram of every lit plane, where it can be determined."""
    found = []
    for plane, black in zip(*planes_of(capture)[1:], strict=True):
        if plane.mean() > black + LIT * (capture.white_level - black):
            found.append(unevenness(plane[plane < capture.white_level]))
    return [value for value in found if np.isfinite(value)]


def _camera(files: CaptureFiles, uneven: Sequence[float]) -> dict[str, Any]:
    """Camera settings of a calibration, from the first of its frames, and how even the grey levels of lit ones are.

    Levels that neither the file nor the user states stay open.
    """
    header, frame = files.series.lights[0][0].stored(0), next(files.frames())
    levels = {"black_level": float(frame.black_level.mean()), "white_level": frame.white_level}
    stated = {name for name in levels for source in (header, files.stated) if getattr(source, name) is not None}
    kind = "bayer" if isinstance(frame, Mosaic) else "rgb" if len(frame.values) == 3 else "monochrome"
    return {
        "kind": kind,
        "unevenness": max(uneven, default=None),
        "cfa": frame.cfa if isinstance(frame, Mosaic) else None,
        **{name: level for name, level in levels.items() if name in stated},
        "shape": (frame.values.shape[-2], frame.values.shape[-1]),
    }


def _reduce(files: CaptureFiles, block: int, uneven: list[float]) -> list[BlockMeans]:
    """Block averages of every file; how uneven the grey levels of each are is added to `uneven`."""
    means = []
    for frame in files.frames():
        uneven += _unevenness(frame)
        means.append(block_means(frame, block=block))
    return means


SECTIONS = ("crosstalk", "camera_noise", "noise", "registration")
CAMERA = ("kind", "cfa", "black_level", "white_level", "shape")


def merge_files(paths: Sequence[Path]) -> Calibration:
    """One calibration with every section that any of the files has.

    Raises
    ------
    ConfigurationError
        Fewer than two files are given.
    CalibrationError
        A file cannot be read, two files have the same section with different contents, or the files are of different
        cameras or lights.
    """
    if len(paths) < 2:
        raise ConfigurationError(f"merge needs at least two calibration files, given is {len(paths)}")
    read = {str(path): Calibration.read(path) for path in paths}
    chosen: dict[str, Any] = {name: _agreed(name, read) for name in (*SECTIONS, *CAMERA)}
    provenance: dict[str, Any] = {}
    extra: dict[str, Any] = {}
    for path, calibration in read.items():
        _add(provenance, calibration.provenance, f"provenance of {path}")
        _add(extra, calibration.extra, path)
    uneven = [calibration.unevenness for calibration in read.values() if calibration.unevenness is not None]
    return Calibration(**chosen, unevenness=max(uneven, default=None), provenance=provenance, extra=extra)


def _agreed(name: str, read: Mapping[str, Calibration]) -> Any:
    """The value of a section or camera setting; files that have it must agree."""
    found: tuple[str, Calibration] | None = None
    for path, calibration in read.items():
        if getattr(calibration, name) is None:
            continue
        if found and _document(calibration, name) != _document(found[1], name):
            raise CalibrationError(
                f"{found[0]} and {path} differ in {name.replace('_', ' ')}: merge takes it from one file only, and the "
                "camera settings must be the same in all"
            )
        found = found or (path, calibration)
    return getattr(found[1], name) if found else None


def _document(calibration: Calibration, name: str) -> Any:
    document = calibration.to_document()
    return document["camera"][name] if name in CAMERA else document["noise" if "noise" in name else name]


def _add(into: dict[str, Any], new: Mapping[str, Any], where: str) -> None:
    for key, value in new.items():
        if into.setdefault(key, value) != value:
            raise CalibrationError(f"{where}: section {key} differs from that of an earlier file")
