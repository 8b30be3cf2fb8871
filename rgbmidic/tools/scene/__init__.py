"""A set-up as SCENE.toml describes it: lamps, camera, body, paint, and where lights reflect; nothing is rendered."""

from rgbmidic.errors import ConfigurationError, InputError
from rgbmidic.settings.conversion import CheckedSettings


class SceneSection(CheckedSettings):
    """A section of a scene, checked as the settings of a test are: an `InputError` where a value is impossible."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Check the values."""
        try:
            super().__post_init__()
        except ConfigurationError as error:
            raise InputError(f"{type(self).__name__}: {error}") from None
