"""A set-up as SCENE.toml describes it: lamps, camera, body, paint, and where lights reflect; nothing is rendered."""

from rgbmidic.errors import ConfigurationError, InputError
from rgbmidic.settings.conversion import Checked


class Physical(Checked):
    """What a scene consists of: checked as the settings of a test are, and `InputError` where a value is impossible."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Check the values."""
        try:
            super().__post_init__()
        except ConfigurationError as error:
            raise InputError(f"{type(self).__name__}: {error}") from None
