"""Draft of a TEST.toml, whose comments are kept, and its region of interest: marks on the image, drawn as lines."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import tomlkit
from tomlkit.exceptions import TOMLKitError

from rgbmidic.disk import write_text
from rgbmidic.errors import ConfigurationError
from rgbmidic.mesh import Region
from rgbmidic.results import Result
from rgbmidic.settings import FrameSettings, TestSettings, read_section, read_toml
from rgbmidic.tools.view.drawing import masks_of
from rgbmidic.tools.view.marks import Mark

_FILES = (
    *("frames.path", "calibration.file", "region.mask", "mesh.file", "scale.camera", "channels.file"),
    *("weights.geometry", "weights.height_map", "weights.images"),
)
"""Keys that name files."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Draft:
    """A test that is being set up.

    Attributes
    ----------
    file
        Path of the TEST.toml, which may not exist yet.
    text
        Its content.
    """

    file: Path
    text: str

    @classmethod
    def from_path(cls, path: Path, statement: Mapping[str, Any] | None = None) -> Self:
        """Read a TEST.toml, or begin one in the working directory for frames.

        Parameters
        ----------
        path
            A TEST.toml, or the frames: a movie, a folder or a pattern.
        statement
            Keys of ``[frames]`` that the files of frames do not state; a TEST.toml states its own.

        Returns
        -------
        Draft
            The draft.

        Raises
        ------
        ConfigurationError
            The file is missing, is not TOML, or does not name the frames; something stated is not allowed.
        """
        if path.suffix.lower() == ".toml":
            read_toml(path, "settings file")
            draft = cls(file=path.resolve(), text=path.read_text(encoding="utf-8-sig"))
            try:
                _ = draft.frames
            except (ConfigurationError, TypeError) as error:
                raise ConfigurationError(f"{path}: {error}") from None
            return draft
        file = Path.cwd() / "TEST.toml"
        keys = {key: list(value) if isinstance(value, tuple) else value for key, value in (statement or {}).items()}
        draft = cls(file=file, text="").with_values({"frames": {"path": str(path.resolve()), **keys}})
        _ = draft.frames
        return draft

    @classmethod
    def from_result(cls, result: Result, file: Path) -> Self:
        """Read a TEST.toml beside a result, or begin one with the settings that the result was measured with.

        Parameters
        ----------
        result
            The result.
        file
            The TEST.toml, relative to the folder of that of the result.

        Returns
        -------
        Draft
            The draft.

        Raises
        ------
        ConfigurationError
            As `from_path`; or the file lies neither beside the result nor in the folder of its test.
        """
        base = Path(result.provenance.get("base", result.path.parent))
        folders, file = {base.resolve(), result.path.resolve().parent}, (base / file).resolve()
        if file.suffix.lower() != ".toml" or file.parent not in folders:
            raise ConfigurationError(f"{file} must end in .toml and be in {' or '.join(sorted(map(str, folders)))}")
        if file.exists():
            return cls.from_path(file)
        stored_settings = result.provenance.get("settings", {})
        settings = {name: dict(section) for name, section in stored_settings.items() if section}
        frames = settings.setdefault("frames", {})
        frames["path"] = [str(base / path) for path in frames.get("path", ())]
        return cls(file=file, text="").with_values(settings)

    @property
    def is_file(self) -> bool:
        """True if the file has this content."""
        return self.file.exists() and self.file.read_text(encoding="utf-8-sig", errors="replace") == self.text

    @property
    def document(self) -> dict[str, Any]:
        """The sections with their keys and plain values."""
        return tomllib.loads(self.text)

    def section(self, name: str) -> dict[str, Any]:
        """Return one section; empty where it is not there."""
        content = self.document.get(name, {})
        return content if isinstance(content, dict) else {}

    @property
    def frames(self) -> FrameSettings:
        """The settings of the frames; errors as `TestSettings.from_mapping`."""
        return read_section(FrameSettings, "frames", self.section("frames"), self.file.parent)

    def with_values(self, sections: Mapping[str, Mapping[str, Any]]) -> Self:
        """Return the draft with other values of some keys; comments and order stay.

        Parameters
        ----------
        sections
            Values by section and key; None removes a key.

        Returns
        -------
        Draft
            The changed draft.

        Raises
        ------
        ConfigurationError
            The TOML is written in a form that cannot be changed without losing something.
        """
        expected = {name: dict(content) for name, content in self.document.items()}
        document = tomlkit.parse(self.text)
        try:
            for name, content in sections.items():
                section: Any = document.setdefault(name, tomlkit.table())
                for key, value in content.items():
                    for target in (section, expected.setdefault(name, {})):
                        if value is None:
                            target.pop(key, None)
                        elif target.get(key) != value:
                            target[key] = value
        except (TOMLKitError, TypeError, AttributeError) as error:
            raise ConfigurationError(f"{self.file} cannot be changed: {error}") from None
        edited = replace(self, text=tomlkit.dumps(document))
        if edited.document != expected:
            raise ConfigurationError(f"{self.file} cannot be changed without losing something; edit it by hand")
        return edited

    def with_path(self, file: Path) -> Self:
        """Return the draft at another path.

        Parameters
        ----------
        file
            Path of the TEST.toml, relative to the folder of the present one.

        Returns
        -------
        Draft
            The draft with that path.

        Raises
        ------
        ConfigurationError
            The name does not end in .toml, or files that the draft names by relative paths would not be found.
        """
        file = self.file.parent / file
        if file.suffix.lower() != ".toml":
            raise ConfigurationError(f"{file} must end in .toml")
        values = [self.section(section).get(key, []) for section, _, key in (name.partition(".") for name in _FILES)]
        names = [text for value in values for text in ([value] if isinstance(value, str) else value)]
        if file.parent != self.file.parent and any(not Path(text).is_absolute() for text in names):
            raise ConfigurationError(
                f"{file} must stay in {self.file.parent}: what it names is relative to that folder"
            )
        return replace(self, file=file)

    def with_masks(
        self, marks: Sequence[Mark], lights: Sequence[str], shape: tuple[int, int]
    ) -> tuple[Self, dict[Path, bytes]]:
        """Return the draft with the masks of lights that are drawn, and their files: a picture (PNG) for each light.

        A picture is 0 within the masks of its light, 255 elsewhere. Without a mask the draft stays as it is.

        Raises
        ------
        ConfigurationError
            A mask is of none of the lights.
        """
        if not (masks := masks_of(marks)):
            return self, {}
        if unknown_lights := [light for light in masks if light not in lights]:
            raise ConfigurationError(
                f"there is a mask of {', '.join(unknown_lights)}, but the lights are {', '.join(lights)}"
            )
        frame_region, files = Region.from_rectangle((0, 0, shape[1] - 1, shape[0] - 1), shape), dict[Path, bytes]()
        for number, light in enumerate(lights, 1):
            picture = np.uint8(255) * frame_region.without(masks.get(light, ())).mask.astype(np.uint8)
            name = f"{self.file.stem}_mask_{number}_{re.sub(r'[^A-Za-z0-9]+', '_', light)}.png"
            files[self.file.parent / name] = cv2.imencode(".png", picture)[1].tobytes()
        return self.with_values({"weights": {"method": "images", "images": [file.name for file in files]}}), files

    def check(self) -> None:
        """Check that the draft is a complete test; errors as `write`."""
        TestSettings.from_mapping(self.document, self.file.parent)

    def write(self) -> None:
        """Write the TEST.toml.

        Raises
        ------
        ConfigurationError
            The draft is not a complete test; the message names the key.
        ResultError
            The file cannot be written.
        """
        self.check()
        write_text(self.file, self.text)


class Confirmation:
    """Second press of a button, which lets files that exist be replaced."""

    def __init__(self) -> None:
        self._pending: object = None

    def question(self, files: Sequence[Path], subject: str) -> str:
        """Return what to confirm; empty where no file exists, or where the same was asked just before."""
        modification_times = {str(file): file.stat().st_mtime_ns for file in files if file.exists()}
        request = (
            (modification_times, subject)
            if modification_times and self._pending != (modification_times, subject)
            else None
        )
        self._pending = request
        return f"{', '.join(modification_times)} exists: press again to replace {subject}." if request else ""
