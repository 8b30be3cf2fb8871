"""The errors rgbmidic raises: one base class, so that a command can turn any of them into one clear line.

Every message says what is wrong, what is allowed and what was given, and names the file or key it is about.
"""

__all__ = [
    "CalibrationError",
    "ConfigurationError",
    "FrameError",
    "InputError",
    "RegionError",
    "ResultError",
    "RgbmidicError",
]


class RgbmidicError(Exception):
    """Base of all errors that rgbmidic raises on purpose."""


class InputError(RgbmidicError, ValueError):
    """An array or value handed to a function is not what the function accepts."""


class ConfigurationError(RgbmidicError, ValueError):
    """A configuration file has a missing, unknown, misspelt or contradictory entry."""


class FrameError(RgbmidicError, ValueError):
    """A frame file is missing, damaged, or not the raw frame it is said to be."""


class CalibrationError(RgbmidicError, ValueError):
    """A calibration file or capture is missing, damaged, outdated or unusable."""


class RegionError(RgbmidicError, ValueError):
    """A region of interest is empty, outside the image or too small for one element."""


class ResultError(RgbmidicError, ValueError):
    """A result folder is missing, damaged, or would be overwritten."""
