"""The TEST.toml that a page sets up: read as far as it goes, changed where the page says so, comments kept."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import tomlkit
from tomlkit.exceptions import TOMLKitError

from rgbmidic.errors import ConfigurationError
from rgbmidic.results.files import write_complete
from rgbmidic.settings import FrameSettings, RegionSettings, TestSettings, read_section, read_toml

__all__ = ["Draft"]

_FILES = (("calibration", "file"), ("region", "mask"), ("weights", "geometry"), ("weights", "height_map"))
"""Keys that name files, beside the frames."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Draft:
    """A test that is being set up.

    Attributes
    ----------
    file
        Where it is, or will be written.
    text
        What it says.
    """

    file: Path
    text: str

    @classmethod
    def of(cls, path: Path) -> Self:
        """Of a TEST.toml, or a new one ``TEST.toml`` here for frames: a movie, a folder or a pattern.

        Raises
        ------
        ConfigurationError
            The file is missing or not TOML, or says nothing of the frames.
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
        return cls(file=file, text="").changed({"frames": {"path": str(path.resolve())}})

    @property
    def document(self) -> dict[str, Any]:
        """The sections with their keys and plain values."""
        return tomllib.loads(self.text)

    def section(self, name: str) -> dict[str, Any]:
        """One section; empty where it is not there."""
        found = self.document.get(name, {})
        return found if isinstance(found, dict) else {}

    @property
    def frames(self) -> FrameSettings:
        """The frames; errors as `TestSettings.from_mapping`."""
        if "path" not in self.section("frames"):
            raise ConfigurationError("frames.path is missing")
        return read_section(FrameSettings, "frames", self.section("frames"), self.file.parent)

    @property
    def region(self) -> RegionSettings | None:
        """The region; None where there is none yet."""
        content = self.section("region")
        return read_section(RegionSettings, "region", content, self.file.parent) if content else None

    @property
    def settings(self) -> TestSettings:
        """All of it; errors as `TestSettings.from_mapping`."""
        return TestSettings.from_mapping(self.document, self.file.parent)

    def changed(self, sections: Mapping[str, Mapping[str, Any]]) -> Self:
        """With other values of some keys, None for a key that goes; comments and order stay.

        Raises
        ------
        ConfigurationError
            The file is written in a way in which that cannot be done.
        """
        expected = {name: dict(content) for name, content in self.document.items()}
        document = tomlkit.parse(self.text)
        try:
            for name, content in sections.items():
                section: Any = document.setdefault(name, tomlkit.table())
                for key, value in content.items():
                    _change(section, key, value)
                    _change(expected.setdefault(name, {}), key, value)
        except (TOMLKitError, TypeError, AttributeError) as error:
            raise ConfigurationError(f"{self.file} cannot be changed: {error}") from None
        changed = replace(self, text=tomlkit.dumps(document))
        if changed.document != expected:
            raise ConfigurationError(f"{self.file} cannot be changed without losing something; edit it by hand")
        return changed

    def at(self, file: Path) -> Self:
        """The same in another place.

        Raises
        ------
        ConfigurationError
            It would no longer find what it names relative to where it was, or the name does not end in .toml.
        """
        file = self.file.parent / file
        if file.suffix.lower() != ".toml":
            raise ConfigurationError(f"{file} must end in .toml")
        if file.parent != self.file.parent and any(not Path(text).is_absolute() for text in self._paths()):
            raise ConfigurationError(
                f"{file} must stay in {self.file.parent}: what it names is relative to that folder"
            )
        return replace(self, file=file)

    def _paths(self) -> list[str]:
        named = self.section("frames").get("path", [])
        texts = [named] if isinstance(named, str) else list(named)
        return texts + [text for section, key in _FILES if (text := self.section(section).get(key)) is not None]

    def write(self) -> None:
        """Write it, once it is a whole test.

        Raises
        ------
        ConfigurationError
            It is not; the message names the key.
        ResultError
            The disk refuses.
        """
        _ = self.settings
        write_complete(self.file, lambda file: file.write(self.text.encode("utf-8")))


def _change(section: Any, key: str, value: Any) -> None:
    if value is None:
        section.pop(key, None)
    elif section.get(key) != value:
        section[key] = value
