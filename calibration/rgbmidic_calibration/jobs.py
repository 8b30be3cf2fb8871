"""Sections of a calibration from capture files, and several calibration files merged into one.

Noise, crosstalk and registration are often measured on different days, hence the merging.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import rgbmidic
from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.frames.data import ChannelFrame, Mosaic, planes_of
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.frame_check import unevenness
from rgbmidic.settings import FrameSettings
from rgbmidic_calibration.captures import CaptureFiles, Captures, stack_frames
from rgbmidic_calibration.crosstalk import CrosstalkEstimate, estimate_crosstalk
from rgbmidic_calibration.noise import NoiseEstimate, photon_transfer
from rgbmidic_calibration.ratio import BlockMeans, block_means
from rgbmidic_calibration.registration import ELEMENT, RegistrationEstimate, estimate_registration

__all__ = ["calibrate_crosstalk", "calibrate_noise", "calibrate_registration", "merge_files"]

LIT = 0.1
"""Mean above black, relative to the full scale, of a plane whose histogram is looked at: in the dark, noise is too
little to smooth it. Some cameras apply gains of their own to red and blue, so all planes are."""


def calibrate_crosstalk(
    captures: Captures, *, block: int = 16, order: int | None = None, allow: Sequence[str] = ()
) -> tuple[Calibration, CrosstalkEstimate]:
    """Crosstalk section from capture files; `order` and `allow` as in `estimate_crosstalk`, blocks of `block` px."""
    uneven: list[float] = []

    def reduced(files: CaptureFiles | None) -> list[BlockMeans]:
        means = []
        for frame in files.frames() if files else ():
            uneven.extend(_unevenness(frame))
            means.append(block_means(frame, block=block))
        return means

    means = {name: reduced(files) for name, files in captures.lights.items()}
    labels = {group.role.removeprefix("light "): group.labels for group in captures.groups}
    estimate = estimate_crosstalk(means, reduced(captures.dark), order=order, allow=allow, labels=labels)
    details = {
        "block": block,
        "waived_checks": list(allow),
        "warnings": list(estimate.warnings),
        "variation_over_field": {
            fit.name: {"p_value": fit.variation.p_value, "rms": fit.variation.rms} for fit in estimate.lights
        },
    }
    return _calibration("crosstalk", captures.groups, uneven, details, crosstalk=estimate.crosstalk), estimate


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
    exposures: list[tuple[CaptureFiles, float | None]] = []
    for text in flats:
        time, separator, pattern = text.partition("=")
        if not separator:
            exposures += [(files, None) for files in CaptureFiles.find(f"flat {text}", text, stated).by_folder()]
            continue
        try:
            seconds = float(time)
        except ValueError:
            raise ConfigurationError(f"--flat takes FILES or TIME=FILES with a number as time, not {text!r}") from None
        exposures.append((CaptureFiles.find(f"flat exposure {time}", pattern, stated), seconds))
    dark_stack = stack_frames(dark_files.frames(), drifts=False, name="the dark frames")
    stacks = [stack_frames(files.frames(), exposure=time, name=files.role) for files, time in exposures]
    estimate = photon_transfer(dark_stack, stacks)
    groups = [dark_files, *(files for files, _ in exposures)]
    uneven = [value for files in groups[1:] for value in _unevenness(next(files.frames()))]
    details = {"warnings": list(estimate.warnings), "exposures": [time for _, time in exposures]}
    return _calibration("noise", groups, uneven, details, camera_noise=estimate.camera_noise), estimate


def calibrate_registration(
    captures: Captures, *, region: Sequence[float] | None = None, element_size: float = ELEMENT
) -> tuple[Calibration, RegistrationEstimate]:
    """Registration section from captures of a speckled target; the first light is the reference."""
    estimate = estimate_registration(*captures.stacks(), region=region, element_size=element_size)
    uneven = [value for files in captures.lights.values() for value in _unevenness(next(files.frames()))]
    details = {
        "warnings": list(estimate.warnings),
        "region": None if region is None else list(region),
        "element_size": element_size,
        "residual_rms_px": {match.name: match.rms for match in estimate.matches},
    }
    return _calibration("registration", captures.groups, uneven, details, registration=estimate.registration), estimate


def _unevenness(capture: Mosaic | ChannelFrame) -> list[float]:
    """Unevenness of the histogram of every lit plane, where it can be determined."""
    found = []
    for plane, black in zip(*planes_of(capture)[1:], strict=True):
        if plane.mean() > black + LIT * (capture.white_level - black):
            found.append(unevenness(plane[plane < capture.white_level]))
    return [value for value in found if np.isfinite(value)]


def _calibration(
    section: str, groups: Sequence[CaptureFiles], uneven: Sequence[float], details: Mapping[str, Any], **found: Any
) -> Calibration:
    """A calibration of one section, with the camera's settings and where it comes from: date, version, input files.

    The settings are those of the first frame; levels that neither the file nor the user states stay open.
    """
    files = groups[0]
    header, frame = files.series.lights[0][0].stored(0), next(files.frames())
    levels: dict[str, Any] = {"black_level": float(frame.black_level.mean()), "white_level": frame.white_level}
    known = {name for name in levels for source in (header, files.stated) if getattr(source, name) is not None}
    names = ("kind", "cfa", "black_level", "white_level", "shape", "dtype")
    stated = {name: getattr(files.stated, name) for name in names}
    provenance = {
        "command": f"rgbmidic-calibrate {section}",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "version": rgbmidic.__version__,
        "stated": {name: value for name, value in stated.items() if value is not None},
        "inputs": [
            {"role": group.role, "file": path, "sha256": fingerprint}
            for group in groups
            for path, fingerprint in group.fingerprints.items()
        ],
        **details,
    }
    return Calibration(
        **found,
        provenance={section: provenance},
        kind="bayer" if isinstance(frame, Mosaic) else "rgb" if len(frame.values) == 3 else "monochrome",
        cfa=frame.cfa if isinstance(frame, Mosaic) else None,
        shape=(frame.values.shape[-2], frame.values.shape[-1]),
        unevenness=max(uneven, default=None),
        **{name: level for name, level in levels.items() if name in known},
    )


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
