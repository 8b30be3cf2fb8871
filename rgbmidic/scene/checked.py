"""The checks of what a scene consists of."""

from rgbmidic.errors import ConfigurationError, InputError
from rgbmidic.settings.conversion import CheckedSettings


class PartOfScene(CheckedSettings):
    """A part of a scene, checked as the settings of a test are: an `InputError` where a value is impossible."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Check the values."""
        try:
            super().__post_init__()
        except ConfigurationError as error:
            raise InputError(f"{type(self).__name__}: {error}") from None
