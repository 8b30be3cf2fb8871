"""Sections of a calibration from capture files, and several calibration files merged into one.

Noise, crosstalk and registration are often measured on different days, hence the merging.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.fields.plane import CameraCalibration
from rgbmidic.frames.data import Mosaic
from rgbmidic.illumination.calibration import Calibration, TargetLights
from rgbmidic.settings import FrameSettings
from rgbmidic_calibration.camera import LIMITS, CameraEstimate, estimate_lens, estimate_plane
from rgbmidic_calibration.captures import CaptureFiles, Captures, provenance
from rgbmidic_calibration.crosstalk import CrosstalkEstimate, estimate_crosstalk
from rgbmidic_calibration.noise import NoiseEstimate, photon_transfer
from rgbmidic_calibration.registration import RegistrationEstimate, estimate_registration
from rgbmidic_calibration.stereo import StereoEstimate, ViewPair, estimate_stereo
from rgbmidic_calibration.target import Target, View, find_view, find_views


def calibrate_crosstalk(
    captures: Captures, *, block: int = 16, order: int | None = None, allow: Sequence[str] = ()
) -> tuple[Calibration, CrosstalkEstimate]:
    """Crosstalk section from capture files; `order` and `allow` as in `estimate_crosstalk`, blocks of `block` px."""
    means = {name: files.means(block) for name, files in captures.lights.items()}
    dark = captures.dark.means(block) if captures.dark else []
    estimate = estimate_crosstalk(means, dark, order=order, allow=allow)
    unevenness = [frame.unevenness for frames in (*means.values(), dark) for frame in frames]
    details = {
        "block": block,
        "waived_checks": list(allow),
        "variation_over_field": {
            name: asdict(variation) for name, variation in zip(means, estimate.variations, strict=True)
        },
    }
    return _calibration("crosstalk", captures.groups, unevenness, details, estimate), estimate


def calibrate_noise(dark: str, flats: Sequence[str], user_metadata: FrameSettings) -> tuple[Calibration, NoiseEstimate]:
    """Return the noise section from capture files.

    Parameters
    ----------
    dark
        Pattern of the dark frames.
    flats
        Patterns of the flat frames. A pattern ``TIME=FILES`` is one exposure with its time; else the files of every
        folder are one exposure.
    user_metadata
        What is stated of the files.
    """
    groups = [CaptureFiles.find("dark", dark, user_metadata)]
    for text in flats:
        time, separator, pattern = text.partition("=")
        if not separator:
            groups += CaptureFiles.find(f"flat {text}", text, user_metadata).by_folder()
            continue
        try:
            seconds = float(time)
        except ValueError:
            raise ConfigurationError(f"`flats` are FILES or TIME=FILES with a number as time, not {text!r}") from None
        groups.append(replace(CaptureFiles.find(f"flat exposure {time}", pattern, user_metadata), exposure=seconds))
    dark_frames, *flat_stacks = [files.stack() for files in groups]
    estimate = photon_transfer(dark_frames, flat_stacks)
    details = {"exposures": [stack.exposure for stack in flat_stacks]}
    return _calibration("noise", groups, [stack.unevenness for stack in flat_stacks], details, estimate), estimate


def calibrate_registration(
    captures: Captures, *, region: Sequence[float] | None = None, element_size: float | None = None
) -> tuple[Calibration, RegistrationEstimate]:
    """Return the registration section from captures of a speckled target; the first light is the reference."""
    lights, dark = captures.stacks()
    estimate = estimate_registration(lights, dark, region=region, element_size=element_size)
    unevenness = [stack.unevenness for stack in lights.values()]
    details = {
        "region": None if region is None else list(region),
        "element_size": estimate.element_size,
        "residual_rms_px": {match.name: match.rms for match in estimate.matches},
    }
    return _calibration("registration", captures.groups, unevenness, details, estimate), estimate


def _calibration(
    section: str,
    groups: Sequence[CaptureFiles],
    unevenness: Sequence[float],
    details: Mapping[str, Any],
    estimate: CrosstalkEstimate | NoiseEstimate | RegistrationEstimate,
) -> Calibration:
    """A calibration of one section, with the camera's settings and where it comes from: date, version, input files.

    The settings are those of the first frame; levels that neither the file nor the user states stay open.
    """
    files, field = groups[0], "camera_noise" if section == "noise" else section
    header, (_, frame) = files.series.lights[0][0].stored(0), next(files.frames())
    levels: dict[str, Any] = {"black_level": float(frame.black_level.mean()), "white_level": frame.white_level}
    stated_levels = {
        name for name in levels for source in (header, files.user_metadata) if getattr(source, name) is not None
    }
    return Calibration(
        **{field: getattr(estimate, field)},
        provenance={section: provenance(section, groups, {**details, "warnings": list(estimate.warnings)})},
        kind="bayer" if isinstance(frame, Mosaic) else "rgb" if len(frame.values) == 3 else "monochrome",
        cfa=frame.cfa if isinstance(frame, Mosaic) else None,
        shape=(frame.values.shape[-2], frame.values.shape[-1]),
        unevenness=max(filter(np.isfinite, unevenness), default=None),
        **{name: level for name, level in levels.items() if name in stated_levels},
    )


def read_corners(corners: str, size: str, corner_std: float, shape: tuple[int, int]) -> View:
    """Read the corners of a rectangle on the specimen, in px, and its two sides in mm.

    Parameters
    ----------
    corners
        ``X0,Y0:X1,Y1:X2,Y2:X3,Y3`` in the order around the rectangle, beginning at its top left.
    size
        ``WIDTHxHEIGHTmm``.
    corner_std
        Standard uncertainty of a corner, px.
    shape
        Rows and columns of the frames.

    Raises
    ------
    ConfigurationError
        An option has another form, the corners lie outside the frame or do not go around a convex quadrilateral.
    """
    sides = re.fullmatch(r"([\d.]+)x([\d.]+)mm", size)
    groups = [corner.split(",") for corner in corners.split(":")]
    try:
        pixels = np.array([[float(number) for number in group] for group in groups])
        width, height = (float(side) for side in sides.groups()) if sides else (0.0, 0.0)
    except ValueError:
        pixels, width, height = np.zeros(0), 0.0, 0.0
    if pixels.shape != (4, 2) or not np.isfinite(pixels).all() or not (width > 0 and height > 0 and corner_std > 0):
        raise ConfigurationError(
            "`corners` are X0,Y0:X1,Y1:X2,Y2:X3,Y3 in px around a rectangle and `size` its WIDTHxHEIGHTmm, "
            f"`corner_std` is positive; not {corners!r}, {size!r}, {corner_std:g}"
        )
    if (pixels < -0.5).any() or (pixels > np.array(shape[::-1]) - 0.5).any():
        raise ConfigurationError(f"`corners` lie outside the frame of {shape[1]} x {shape[0]} px: {corners}")
    steps = np.roll(pixels, -1, axis=0) - pixels
    turns = steps[:, 0] * np.roll(steps[:, 1], -1) - steps[:, 1] * np.roll(steps[:, 0], -1)
    if not (turns > 0).all():
        raise ConfigurationError(
            f"`corners` must go around the rectangle clockwise from its top left; given: {corners}"
        )
    points = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    return View(name="corners", points=points, pixels=pixels, shape=shape)


def calibrate_camera(
    user_metadata: FrameSettings,
    target: Target | None,
    *,
    lens: str | CameraCalibration | None = None,
    plane: str | tuple[str, str, float] | None = None,
    lights: TargetLights | None = None,
) -> CameraEstimate:
    """Calibrate lens and plane, or either, from capture files.

    Parameters
    ----------
    user_metadata
        What is stated of the files.
    target
        The target; None where there are no photographs.
    lens
        Pattern of the photographs of the lens, or an earlier calibration, for its lens.
    plane
        Pattern of the photograph of the target on the specimen's plane (of several the points are averaged), or the
        first three arguments of `read_corners`.
    lights
        Lights under which all of these were photographed: the camera is then that of the first light's image, whose
        pixels the results are in. The covariance of the registration is part of that of the plane.

    Raises
    ------
    CalibrationError
        The photographs do not allow it.
    ConfigurationError
        Neither photographs of the lens nor a plane are given, or photographs without their target.
    """
    if (isinstance(lens, str) or isinstance(plane, str)) and target is None:
        raise ConfigurationError("photographs of lens or plane need `target`: what they show")
    groups, estimates = list[CaptureFiles](), list[CameraEstimate]()
    camera, view = None, None
    if isinstance(lens, str) and target:
        groups.append(CaptureFiles.find("views", lens, user_metadata))
        views, reasons = find_views(groups[-1], target)
        estimates.append(estimate_lens([_on_first_light(lens_view, lights) for lens_view in views], reasons))
        camera = estimates[-1].camera
    elif isinstance(lens, CameraCalibration):
        camera = _without_plane(lens, lights)
    if isinstance(plane, str) and target:
        groups.append(CaptureFiles.find("plane", plane, user_metadata))
        view = _mean_view(groups[-1], target)
    elif isinstance(plane, tuple):
        shape = camera.shape if camera is not None else user_metadata.shape
        if shape is None:
            raise ConfigurationError(
                "corners of the plane need the frames' size: state their `shape` (rows, columns), or a `lens`"
            )
        view = read_corners(*plane, shape)
    if view is not None:
        camera = camera or CameraCalibration(shape=view.shape)
        std = plane[2] if isinstance(plane, tuple) else None
        estimates.append(estimate_plane(_on_first_light(view, lights), camera, std))
        camera = estimates[-1].camera
    if camera is None or not estimates:
        raise ConfigurationError(
            "nothing to calibrate: state views of the lens, a photograph of the plane, or corners on it"
        )
    details = {**camera.details, "provenance": provenance("camera", groups, {})}
    if lights is not None:
        details |= {"lights": list(lights.names), "first_light": lights.first}
    residuals = tuple(points for estimate in estimates for points in estimate.residuals)
    return CameraEstimate(camera=replace(camera, details=details), residuals=residuals)


def find_view_pairs(
    files: tuple[CaptureFiles, CaptureFiles],
    target: Target,
    lights: tuple[TargetLights | None, TargetLights | None] = (None, None),
) -> tuple[list[ViewPair], tuple[str, ...]]:
    """Find the target in the photographs that two cameras took at one time.

    Photographs are paired by their times where the files of both state them, else by number.

    Parameters
    ----------
    files
        Photographs of the left and of the right camera.
    target
        What they show.
    lights
        Lights under which each camera's were taken.

    Returns
    -------
    pairs : list of ViewPair
    reasons : tuple of str
        Why other pairs are not used.

    Raises
    ------
    CalibrationError
        The numbers of photographs differ, or their times fit nowhere.
    """
    series = files[0].series, files[1].series
    pairs, reasons = list[ViewPair](), list[str]()
    times = [[frames.time_ns(index) for index in range(len(frames))] for frames in series]
    if None in times[0] or None in times[1]:
        if len(series[0]) != len(series[1]):
            raise CalibrationError(
                f"the left camera has {len(series[0])} photographs, the right {len(series[1])}: paired by number, both "
                "must have as many, of the same moments in the same order"
            )
        indices = [(index, index) for index in range(len(series[0]))]
    else:
        stamps = [np.array(values, dtype=np.float64) for values in times]
        delays = np.abs(stamps[1] - stamps[0][:, None])
        interval = float(np.median(np.diff(stamps[0]))) if len(stamps[0]) > 1 else np.inf
        nearest = delays.argmin(axis=1)
        indices = [(row, int(nearest[row])) for row in range(len(nearest)) if delays[row].min() < interval / 4]
        if not indices:
            raise CalibrationError(
                f"no photographs of the left and the right camera were taken at one time: the nearest are "
                f"{1e-9 * delays.min():.3g} s apart"
            )
        if alone := len(nearest) - len(indices):
            reasons.append(f"{alone} photographs of the left camera have none of the right one taken at the same time")
    for numbers in indices:
        try:
            views = [
                _on_first_light(find_view(frames.read(index)[0], target, frames.name(index)), light)
                for frames, index, light in zip(series, numbers, lights, strict=True)
            ]
            pairs.append(ViewPair.of(*views))
        except CalibrationError as error:
            reasons.append(str(error))
    return pairs, tuple(reasons)


def calibrate_stereo(
    user_metadata: FrameSettings,
    target: Target,
    patterns: tuple[str, str],
    lights: tuple[TargetLights | None, TargetLights | None] = (None, None),
) -> StereoEstimate:
    """Calibrate two cameras from capture files.

    Parameters
    ----------
    user_metadata
        What is stated of the files.
    target
        What they show.
    patterns
        Photographs of the left and of the right camera.
    lights
        Lights under which each camera's were taken; the lens is then that of the first light's image.

    Returns
    -------
    StereoEstimate

    Raises
    ------
    CalibrationError
        The photographs do not allow it.
    """
    roles = zip(("left", "right"), patterns, strict=True)
    left, right = (CaptureFiles.find(role, pattern, user_metadata) for role, pattern in roles)
    estimate = estimate_stereo(*find_view_pairs((left, right), target, lights))
    details = {**estimate.pair.details, "provenance": provenance("stereo", [left, right], {})}
    first, second = (
        replace(camera, details={} if light is None else {"first_light": light.first})
        for camera, light in zip(estimate.pair.cameras, lights, strict=True)
    )
    return replace(estimate, pair=replace(estimate.pair, left=first, right=second, details=details))


def _on_first_light(view: View, lights: TargetLights | None) -> View:
    """Return the target's points in px of the first light's image; as they are where no light is stated."""
    if lights is None:
        return view
    pixels, factor = lights.on_first_light(view.pixels, view.shape)
    return replace(view, pixels=pixels, factor=factor)


def _without_plane(camera: CameraCalibration, lights: TargetLights | None) -> CameraCalibration:
    """Return an earlier calibration without its plane.

    Raises
    ------
    CalibrationError
        It is of the image of another light.
    """
    earlier_light, present_light = camera.details.get("first_light"), None if lights is None else lights.first
    if earlier_light is not None and earlier_light != present_light:
        image = "with no light stated" if present_light is None else f"of light {present_light}'s image"
        raise CalibrationError(
            f"{camera.name} is of light {earlier_light}'s image, the plane {image}: state the same `lights` as for the "
            "lens"
        )
    covariance = np.pad(camera.covariance[:8, :8], (0, 8))
    return replace(camera, homography=None, covariance=covariance, details={"lens": camera.details.get("lens")})


def _mean_view(files: CaptureFiles, target: Target) -> View:
    """Return the points of the target, averaged over the photographs of one plane."""
    shots, reasons = find_views(files, target)
    if reasons:
        raise CalibrationError("; ".join(reasons))
    for shot in shots[1:]:
        if not np.array_equal(shot.points, shots[0].points):
            raise CalibrationError("plane: the photographs show different points of the target: state one of them")
        if (motion_px := float(np.abs(shot.pixels - shots[0].pixels).max())) > LIMITS.max_residual:
            raise CalibrationError(
                f"plane: from {shots[0].name} to {shot.name} the target moved by up to {motion_px:.2f} px, at most "
                f"{LIMITS.max_residual:g} may be: state photographs of one plane"
            )
    return replace(shots[0], pixels=np.mean([shot.pixels for shot in shots], axis=0))


def merge_files(paths: Sequence[Path]) -> Calibration:
    """Return one calibration with every section that any of the files has.

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
    sections: dict[tuple[str, str], tuple[Any, Path]] = {}
    for path in paths:
        for name, section in Calibration.read(path).to_document().items():
            for key, value in section.items() if name in ("camera", "provenance") else [("", section)]:
                earlier, earlier_path = sections.setdefault((name, key), (value, path))
                if key == "unevenness":
                    sections[name, key] = max(earlier, value), path
                elif earlier != value:
                    section_name = (
                        f"the provenance of {key}" if name == "provenance" else (key or name).replace("_", " ")
                    )
                    raise CalibrationError(
                        f"{earlier_path} and {path} differ in {section_name}: merge takes it from one file only, and "
                        "the camera settings must be the same in all"
                    )
    document: dict[str, Any] = {}
    for (name, key), (value, _) in sections.items():
        document[name] = document.get(name, {}) | {key: value} if key else value
    return Calibration.from_document(document)
